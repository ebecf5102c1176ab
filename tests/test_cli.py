"""The command line."""

import json
import subprocess
import sys

import pytest

from clothgym import INTEGRATORS
from clothgym.cli import main
from clothgym.lab import bench
from clothgym.registration import ENVIRONMENTS


def test_list_names_what_there_is(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*ENVIRONMENTS, *INTEGRATORS, "cotton"))


def test_warmup_says_when_it_is_done(capsys):
    assert main(["warmup"]) == 0
    assert "every integrator are ready" in capsys.readouterr().out
    # and a process that comes after it finds every kernel of every environment
    done = subprocess.run([sys.executable, "-c", AN_EPISODE_OF_EACH], capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == list(ENVIRONMENTS) and not done.stderr, done.stderr


AN_EPISODE_OF_EACH = """
import gymnasium as gym
from clothgym.registration import ENVIRONMENTS
for env_id in ENVIRONMENTS:
    env = gym.make_vec("clothgym:" + env_id, num_envs=2)
    env.reset(seed=0)
    while not env.step(env.action_space.sample())[2].any():
        pass
    print(env_id)
"""


def test_bench_writes_what_it_prints(tmp_path, capsys, monkeypatch):
    """The measurements themselves are stood in for: a test must not depend on a clock."""
    monkeypatch.setattr(bench, "_process_seconds", lambda code, runs, **environment: 1.0)
    monkeypatch.setattr(bench, "seconds_per_call", lambda call, budget=0.5: (call(), 0.5)[1])
    assert main(["bench", "--quick", "--json", str(tmp_path / "bench.json")]) == 0
    results = json.loads((tmp_path / "bench.json").read_text())
    out = capsys.readouterr().out
    assert results["machine"]["versions"]["clothgym"] and "ns/spring" in out
    measured = {(row["environment"], row["envs"]) for row in results["environments"]}
    assert measured == {(env_id, envs) for env_id in ENVIRONMENTS for envs in (1, 64, 256)}
    assert sum("cold" in row["start"] for row in results["start"]) == len(ENVIRONMENTS)
    row = next(row for row in results["core"] if row["grid"] == "25x25" and row["envs"] == 64)
    assert row["frames/s"] == 128
    assert row["ns/spring"] == pytest.approx(0.5 * row["threads"] / (64 * row["substeps"] * 3502) * 1e9)


def test_a_wrong_command_lists_the_right_ones(capsys):
    with pytest.raises(SystemExit):
        main(["fold"])
    assert "warmup" in capsys.readouterr().err

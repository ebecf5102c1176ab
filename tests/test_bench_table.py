"""The table of speeds: its arithmetic, and that its groups run.  Nothing here is held against a clock."""

import json

import numpy as np
import pytest

from clothgym import cli, grid
from clothgym.lab import bench_cases, bench_episodes, bench_limits, bench_table
from clothgym.lab.bench_limits import PARTICLE, SPRING, PlainSheet, Work, stand
from clothgym.lab.bench_table import Case, in_turns, row_of, with_what_they_need

LIMITS = {
    "operations/s": 1e11,
    "inverse roots/s": 1e10,
    "bytes/s": {"L1": 2e11, "L2": 1e11, "L3": 5e10, "memory": 2e10},
    "cache bytes": {"L1": 1000, "L2": 10_000, "L3": 100_000},
}


def test_a_pass_stands_at_the_limit_that_it_is_nearest_to():
    work = Work(operations=400, roots=10, numbers=250, streamed=100, formula="")
    # ten springs at 1 ns: 40 operations, a root, and 100 or 40 bytes in a nanosecond
    near = stand(1.0, work, 10, 1000, LIMITS)
    assert near["shares"] == pytest.approx({"arithmetic": 0.4, "inverse roots": 0.1, "bandwidth of L1": 0.5})
    assert near["nearest"] == "bandwidth of L1" and near["bytes a spring"] == 100
    far = stand(1.0, work, 10, 1001, LIMITS)
    assert far["shares"]["bandwidth of L2"] == pytest.approx(0.4) and far["bytes a spring"] == 40
    assert "bandwidth of memory" in stand(1.0, work, 10, 100_001, LIMITS)["shares"]


def test_work_adds_up():
    work = SPRING.times(10).plus(PARTICLE.times(2))
    assert work.operations == 10 * SPRING.operations + 2 * PARTICLE.operations
    assert work.streamed == 10 * SPRING.streamed + 2 * PARTICLE.streamed
    assert work.formula.startswith("10 x (spring")


def test_the_plain_step_is_that_of_a_plain_loop():
    """Springs that wrap around a row's end pull at nothing."""
    side, h, f8 = 5, 1e-5, np.float64
    sheet, mesh = PlainSheet(side), grid(side, side, 1.0, 1.0)
    assert sheet.springs == len(mesh.springs.kind)
    x, v = sheet.x.astype(f8), sheet.v.astype(f8)
    for _ in range(20):
        force = np.zeros_like(x)
        for k, (rows, columns) in enumerate(bench_limits.KINDS):
            for p in np.flatnonzero(sheet.stiffness[k]):
                q = p + rows * side + columns
                d, u = x[:, q] - x[:, p], v[:, q] - v[:, p]
                pull = sheet.stiffness[k, p] * ((1 - sheet.rest[k] / np.linalg.norm(d)) + 1e-4 * (u @ d) / (d @ d)) * d
                force[:, p] += pull
                force[:, q] -= pull
        free = (v + h * (force * sheet.w + sheet.gravity[:, None])) * 0.99999
        v = np.where(sheet.w > 0, free, v)
        x += h * v
    sheet.step(20)
    assert np.allclose(sheet.x, x, atol=1e-7) and np.allclose(sheet.v, v, atol=2e-3 * np.abs(v).max())


def test_cases_take_turns_and_are_held_against_each_other():
    calls = []
    base = Case("one", "base", lambda: calls.append("base"), 1e6, "us")
    twice = Case("one", "twice", lambda: calls.append("twice"), 1e6, "times", over=base, goal=(1.5, base))
    cases = with_what_they_need([twice])
    assert cases == [base, twice]
    in_turns(cases, rounds=4)
    assert len(calls) == 10 and calls[2:4] == ["base", "twice"] and calls[-2:] == ["twice", "base"]
    row = twice.row({base: 1e-6, twice: 2e-6}, LIMITS)
    assert row["now"] == pytest.approx(2) and row["goal"] == pytest.approx(1.5) and not row["reached"]
    assert row_of("g", "w", 3000.0, "steps/s", 3000, least=True)["reached"]


def test_a_group_runs_by_itself(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench_table, "ROUNDS", 1)
    monkeypatch.setattr(bench_cases, "ENOUGH", 20_000)
    file = tmp_path / "table.json"
    assert cli.main(["bench", "--table", "--select", "springs", "--json", str(file)]) == 0
    results = json.loads(file.read_text())
    printed = capsys.readouterr().out
    assert {row["group"] for row in results["rows"]} == {"springs"}
    for row in results["rows"]:
        assert row["now"] > 0 and np.isfinite(row["now"]) and row["what"] in printed
        assert all(share > 0 for share in row["limits"]["shares"].values())
    bandwidth = results["limits"]["bytes/s"]
    assert results["limits"]["operations/s"] > 1e8 and all(speed > 1e7 for speed in bandwidth.values())


def test_an_unknown_group_is_refused(capsys):
    with pytest.raises(SystemExit):
        cli.main(["bench", "--table", "--select", "nonsense"])
    assert "springs" in capsys.readouterr().err


def test_episodes_have_the_physics_that_is_asked_for():
    us = bench_episodes.play({"as it is": {}, "sheet": bench_episodes.SHEET}, expert=True, num_envs=2, steps=2, rounds=1)
    assert us.keys() == {"as it is", "sheet"} and all(0 < one < np.inf for one in us.values())
    env = bench_episodes.make("ClothDrape-v0", contact="sheet", physics="fast")
    assert env.unwrapped.task.simulation.contact == "sheet"


def test_mujoco_is_told_to_be_missing(monkeypatch):
    monkeypatch.setattr(bench_episodes, "find_spec", lambda name: None)
    (row,) = bench_episodes.mujoco()
    assert "not installed" in row["what"]

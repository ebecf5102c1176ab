"""The command line."""

import json
import os
import subprocess
import sys

import gymnasium as gym
import pytest

import clothgym.envs
from clothgym import INTEGRATORS, Simulation, progress
from clothgym.cli import main
from clothgym.lab import bench
from clothgym.playground.episode import POLICIES
from clothgym.playground.gallery import Gallery
from clothgym.playground.stage import SceneStage
from clothgym.registration import ACTORS, ENVIRONMENTS


def test_no_command_prints_help_and_a_version_is_told(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(f"    {command} " in out for command in ("list", "view", "export", "compare", "bench", "warmup"))
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0 and capsys.readouterr().out == f"clothgym {clothgym.__version__}\n"


def test_the_program_is_called_as_it_was_called():
    done = subprocess.run([sys.executable, "-m", "clothgym"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("usage: python -m clothgym ") and not done.stderr


def test_list_names_environments_scenes_integrators_and_fabrics(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*ENVIRONMENTS, *INTEGRATORS, "cotton"))
    # an environment's line is the first of its page
    for env_id, (name, _) in ENVIRONMENTS.items():
        page = getattr(clothgym.envs, f"{name}Env").__doc__
        (line,) = [line for line in out.splitlines() if f"clothgym:{env_id} " in line]
        assert line.split(maxsplit=1)[1] == page.splitlines()[0]


# --- what is wrong is refused -----------------------------------------------------------------------------------------------

BY_VALUE = {
    "fold": "choose from",
    "view --port abc": "--port: 'abc': must be an integer from 0 to 65535",
    "view --replay gone.npz": "no such file",
    "view --policy nothing": "no policy 'nothing' (there are: noop, random, expert, the folder of a training run)",
    "export patch": "required: --out",
    "export patch --out a.gif --seconds -1": "--seconds: '-1': must be a positive number",
    "export patch --out a.gif --seconds inf": "--seconds: 'inf': must be a positive number",
    "export patch --out a.gif --set gravity": "must be NAME=VALUE",
    "export patch --out gone/a.gif": "there is no folder 'gone'",
    "bench --json gone/bench.json": "there is no folder 'gone'",
}
BY_NAME = {
    "view flagg": "no scene or environment 'flagg'; did you mean 'flag'?",
    "view --host 203.0.113.7": "cannot listen there",
    "export ClothReech-v0 --out a.gif": "did you mean 'ClothReach-v0'?",
    "export patch --out a.fbx": "must end in",
    "export patch --out a.gif --fps 100": "patch has 30 frames a second",
    "export patch --out a.gif --set gravty=1": "no setting 'gravty'; did you mean 'gravity'?",
    "export patch --out a.gif --set fabric=silc": "did you mean 'silk'?",
    "export ClothReach-v0 --out a.gif --policy .": "lacks config.json",
    "compare --scene stif_sheet": "did you mean 'stiff_sheet'?",
    "compare --integrators verlett": "no integrator 'verlett'; did you mean 'verlet'?",
}


def refusal(capsys, *arguments):
    """The sentence, of a command that ends as one with a wrong flag does."""
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    assert caught.value.code == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("usage: ") and "Traceback" not in said.err
    return said.err.splitlines()[-1]


@pytest.mark.parametrize("command", [*BY_VALUE, *BY_NAME])
def test_wrong_arguments_are_refused_before_any_simulation(command, tmp_path, monkeypatch, capsys):
    def never(*args, **kwargs):
        raise AssertionError("too late")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gym, "make", never)
    monkeypatch.setattr(Simulation, "__init__", never)
    sentence = refusal(capsys, *command.split())
    assert " error: " in sentence and (BY_VALUE | BY_NAME)[command] in sentence
    assert not list(tmp_path.iterdir())


def test_wrong_values_are_refused_without_numba_and_wrong_names_without_optional_libraries(tmp_path):
    done = subprocess.run([sys.executable, "-c", REFUSALS], capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.stdout.split() == [str(len(BY_VALUE)), str(len(BY_NAME))], done.stderr


REFUSALS = f"""
import sys
from clothgym.cli import main
def refused(commands, heavy):
    refused = 0
    for command in commands:
        try:
            main(command.split())
        except SystemExit as end:
            refused += end.code == 2
        loaded = [module for module in heavy if module in sys.modules]
        assert not loaded, (command, loaded)
    print(refused)
refused({list(BY_VALUE)}, ["numba", "clothgym.envs", "torch", "websockets", "matplotlib"])
refused({list(BY_NAME)}, ["torch", "stable_baselines3", "websockets", "matplotlib", "imageio", "mujoco"])
"""


def test_unwritable_outputs_are_refused(tmp_path, monkeypatch, capsys):
    """The user who runs the tests may be one who can write everywhere."""
    (tmp_path / "there.json").write_text("{}")
    monkeypatch.setattr(os, "access", lambda path, mode: not (mode & os.W_OK))
    for name in ("there.json", "new.json"):
        assert "cannot be written" in refusal(capsys, "bench", "--quick", "--json", tmp_path / name)
    assert (tmp_path / "there.json").read_text() == "{}" and len(list(tmp_path.iterdir())) == 1


def test_actors_have_the_same_names_in_all_commands():
    assert set(POLICIES) == set(ACTORS) == {"noop", "random", "expert"}
    assert Gallery(actor="noop").open("ClothReach-v0").policy == "noop"
    assert Gallery().open("ClothReach-v0").policy == "expert"


# --- while it runs ----------------------------------------------------------------------------------------------------------


def test_an_interrupted_command_ends_with_a_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("PIL")
    real, frames = SceneStage.advance, []

    def advance(stage):
        if len(frames) == 3:
            raise KeyboardInterrupt
        frames.append(real(stage))
        return frames[-1]

    monkeypatch.setattr(SceneStage, "advance", advance)
    assert main(["export", "patch", "--out", str(tmp_path / "a.gif"), "--size", "32"]) == 130
    said = capsys.readouterr()
    (line,) = [line for line in said.err.splitlines() if "compiling" not in line]
    assert line.startswith("stopped; ") and str(tmp_path / "a.part.gif") in line and said.out == ""


def test_a_line_counts_steps_on_a_terminal_and_nowhere_else(monkeypatch, capsys):
    progress.show("springs", 3, 12)
    progress.clear()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress.show("springs", 3, 12)
    assert capsys.readouterr().err == "\r" + f"{'#####---------------'} 3 of 12  springs".ljust(78)
    progress.show("frames", 7)
    progress.show("a long name " * 20)
    assert [line.rstrip() for line in capsys.readouterr().err.split("\r")[1:]] == ["7  frames", ("a long name " * 20)[:78].rstrip()]
    progress.clear()
    assert capsys.readouterr().err == "\r" + " " * 78 + "\r"


@pytest.mark.slow
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
    env.step(env.action_space.sample())
    env.unwrapped.task.episode["step"] = env.unwrapped.task.acting_steps - 2  # most of the time to act is over
    while not env.step(env.action_space.sample())[2].any():
        pass
    print(env_id)
"""


def test_bench_writes_its_printed_table(tmp_path, capsys, monkeypatch):
    """The measurements themselves are stood in for: a test must not depend on a clock."""
    monkeypatch.setattr(bench, "_process_seconds", lambda code, runs, **environment: 1.0)
    monkeypatch.setattr(bench, "seconds_per_call", lambda call, budget=0.5: (call(), 0.5)[1])
    few = ("ClothReach-v0",)
    monkeypatch.setattr(bench, "ENVIRONMENTS", few)
    monkeypatch.setattr(bench, "INTEGRATORS", ("semi_implicit_euler",))
    assert main(["bench", "--quick", "--json", str(tmp_path / "bench.json")]) == 0
    results = json.loads((tmp_path / "bench.json").read_text())
    out, err = capsys.readouterr()
    assert "\r" not in err  # no terminal looks on
    assert results["machine"]["versions"]["clothgym"] and "ns/spring" in out
    measured = {(row["environment"], row["envs"]) for row in results["environments"]}
    assert measured == {(env_id, envs) for env_id in few for envs in (1, 64, 256)}
    assert sum("cold" in row["start"] for row in results["start"]) == len(few)
    row = next(row for row in results["core"] if row["grid"] == "25x25" and row["envs"] == 64)
    assert row["frames/s"] == 128
    assert row["ns/spring"] == pytest.approx(0.5 * row["threads"] / (64 * row["substeps"] * 3502) * 1e9)

"""The scripts, run as a user runs them, on a few steps: a run's folder, resuming, evaluating, and their errors."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from training_runs import ROOT, run

import clothgym
from clothgym import files

SHORT = """
ClothReach-v0:
  n_envs: 16
  n_timesteps: !!float 800
  policy: MlpPolicy
  n_steps: 25
  batch_size: 100
  n_epochs: 1
  learning_rate: lin_0.001
  policy_kwargs: {net_arch: [8], log_std_init: -1.0}
"""
CONFIG = {
    "env": "ClothDrape-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": {}, "hyperparameters": {}, "num_envs": 4,
    "timesteps": 100, "seed": 0, "threads": 1, "clothgym": clothgym.__version__,
}  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    (folder / "short.yml").write_text(SHORT)
    options = ("--hyperparams", folder / "short.yml", "--evaluations", 2, "--eval-episodes", 4, "--final-episodes", 6)
    done = run("train.py", "--env", "ClothReach-v0", "--run", folder / "run", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    shutil.copytree(folder / "run", folder / "fresh")
    return folder, options


def test_a_run_leaves_its_story(trained):
    folder, _ = trained
    names = {path.name for path in (folder / "run").iterdir()}
    assert {
        "config.json",
        "checkpoint.pt",
        "model.zip",
        "policy.npz",
        "progress.jsonl",
        "evaluation.json",
        "learning_curve.png",
        "policy.gif",
    } <= names
    assert "tensorboard" in names
    scores = json.loads((folder / "run" / "evaluation.json").read_text())
    assert scores["episodes"] == 6 and 0 <= scores["success_rate"] <= 1 and scores["timesteps"] == 800
    assert scores["references"]["noop"]["success_rate"] == 0
    assert (folder / "run" / "policy.gif").read_bytes()[:3] == b"GIF"


@pytest.mark.slow
def test_a_run_is_resumed_and_never_overwritten(trained):
    folder, options = trained
    again = run("train.py", "--env", "ClothReach-v0", "--run", folder / "run", *options, cwd=folder)
    assert again.returncode == 2 and "holds a run already" in said(again.stderr)
    other = run("train.py", "--resume", folder / "run", "--seed", 5, cwd=folder)
    assert other.returncode == 2 and "--seed 5: the run that --resume goes on with has 0: drop --seed" in said(other.stderr)
    resumed = run("train.py", "--resume", folder / "run", "--timesteps", 1600, *options[2:], cwd=folder)
    assert resumed.returncode == 0, resumed.stderr
    assert "at 800 of 1,600 steps" in resumed.stdout
    lines = [json.loads(line) for line in (folder / "run" / "progress.jsonl").read_text().splitlines()]
    assert lines[-1]["timesteps"] == 1600
    assert lines[-1]["training_seconds"] > lines[0]["training_seconds"]


@pytest.mark.slow
def test_the_learned_policy_is_compared_with_the_references(trained):
    folder, _ = trained
    out = folder / "scores.json"
    reach = ("--env", "ClothReach-v0")
    done = run("evaluate.py", *reach, "--policy", "noop", folder / "run", "--episodes", 7, "--json", out, cwd=folder)
    assert done.returncode == 0, done.stderr
    scores = json.loads(out.read_text())
    assert scores["noop"]["success_rate"] == 0 and scores[str(folder / "run")]["episodes"] == 7
    one = run("evaluate.py", *reach, "--policy", "expert", "--episodes", 7, "--json", out, cwd=folder)
    assert one.returncode == 0 and json.loads(out.read_text())["success_rate"] > 0.5


# --- what is wrong, and Ctrl+C ---------------------------------------------------------------------------------------------

WRONG = {
    "train --env ClothDrap-v0": "no environment 'ClothDrap-v0'; did you mean 'ClothDrape-v0'?",
    "train --env ClothReach-v0 --algo ppo_lagrange": "has no hyperparameters for 'ClothReach-v0' (there are: ClothStrain-v0",
    "train --hyperparams gone.yml": "--hyperparams gone.yml: there is no such file",
    "train --hyperparams thin.yml": "thin.yml lacks n_envs, policy, n_steps for 'ClothDrape-v0'",
    "train --env ClothFold-v0 --hyperparams cheat.yml": "the curriculum of 'ClothFold-v0' begins with physics='fast', in which",
    'train --resume learned --env-kwargs {"rows":9}': "--resume goes on with the run's own: drop --env-kwargs",
    "train --resume gone": "'gone' is not the folder of a training run",
    "train --env-kwargs {": "'{' is not JSON",
    "evaluate --policy nothing": "no policy 'nothing' (there are: noop, random, expert, careless, learned, a file of a policy, the",
    "evaluate --policy careless": "careless: only ClothStrain-v0 has a careless expert",
    "evaluate --policy learned --env ClothReach-v0": "'learned' was trained on ClothDrape-v0, not on ClothReach-v0",
    "evaluate --policy old": "'old' was trained with clothgym 0.0.1",
    "evaluate --json .": "--json .: is a folder",
}


@pytest.fixture
def wrong(tmp_path, monkeypatch, scripts):
    """A folder with files to name, and no environment and no learner to be had in it."""
    (tmp_path / "thin.yml").write_text("ClothDrape-v0: {n_timesteps: 100}")
    (tmp_path / "cheat.yml").write_text(
        SHORT.replace("Reach", "Fold") + "  curriculum: {n_timesteps: 9, env_kwargs: {physics: fast}}"
    )
    for name, version in (("learned", clothgym.__version__), ("old", "0.0.1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "checkpoint.pt").touch()
        files.write_json(tmp_path / name / "config.json", CONFIG | {"clothgym": version})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gym, "make_vec", None)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)


def said(box):
    """What is in tyro's box, in one line."""
    return " ".join(line.strip("│╭╮╰╯─ ") for line in box.splitlines())


@pytest.mark.parametrize("command", WRONG)
def test_wrong_names_are_refused_as_wrong_flags_are_before_anything_slow(command, wrong, tmp_path, capsys):
    import evaluate
    import train
    import tyro

    before = sorted(tmp_path.rglob("*"))
    script, *arguments = command.split()
    with pytest.raises(SystemExit) as caught:
        tyro.cli({"train": train, "evaluate": evaluate}[script].Args, args=arguments)
    assert caught.value.code == 2 and WRONG[command] in said(capsys.readouterr().err)
    assert sorted(tmp_path.rglob("*")) == before


def test_custom_hyperparameters_warn_before_dropping_the_curriculum(wrong, capsys):
    import train

    Path("short.yml").write_text(SHORT.replace("ClothReach", "ClothDrape"))
    assert train.Args(hyperparams=Path("short.yml")).config["curriculum"] == {}
    assert "short.yml has no curriculum for ClothDrape-v0; to begin as ours does, add  curriculum: {n_timesteps: 7" in (
        capsys.readouterr().err
    )


def test_the_scripts_load_torch_only_when_they_begin():
    code = "import sys, train, evaluate; print([name for name in ('torch', 'stable_baselines3', 'numba') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "training", capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


def test_an_interrupted_run_says_how_to_go_on(scripts, tmp_path, monkeypatch, capsys):
    """What has been learned is saved first."""
    import endings
    import learning

    class Learner:
        n_steps = 5

        def learn(self, *args, **kwargs):
            raise KeyboardInterrupt

    saved = []
    monkeypatch.setattr(learning, "save_checkpoint", lambda folder, model, times: saved.append(folder))
    config = CONFIG | {"num_envs": 2}
    with pytest.raises(SystemExit) as caught, endings.stopped(lambda: ": go on"):
        learning.train(tmp_path, config, Learner(), None, 1, 1, 1)
    assert caught.value.code == 130 and saved == [tmp_path]
    assert capsys.readouterr().err.strip() == "stopped: go on"


def test_a_checkpoint_is_never_unpickled(trained, tmp_path):
    """A pickle in the place of the tensors is refused, not run."""
    import pickle

    folder, _ = trained
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "config.json").write_text((folder / "run" / "config.json").read_text())
    (tmp_path / "evil" / "checkpoint.pt").write_bytes(pickle.dumps(Path("/tmp")))
    done = run("evaluate.py", "--env", "ClothReach-v0", "--policy", tmp_path / "evil", "--episodes", 2, cwd=tmp_path)
    assert done.returncode == 2 and "is no checkpoint" in done.stderr and "Traceback" not in done.stderr


# --- what is damaged ------------------------------------------------------------------------------------------------------


@pytest.fixture
def broken(trained, tmp_path):
    """A copy of a finished run, to be damaged."""
    shutil.copytree(trained[0] / "fresh", tmp_path / "run")
    return tmp_path / "run"


def flip(path, place=1000):
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize(
    "damage", [flip, lambda path: path.write_bytes(path.read_bytes()[:2000]), Path.unlink, lambda path: flip(path, -9)]
)
def test_the_checkpoint_before_takes_the_place_of_a_damaged_one(broken, damage):
    from clothgym.adapters import runs

    # as a second evaluation would have left it
    state = runs.load_tensors(broken / "checkpoint.pt")
    runs.save_tensors(broken / "checkpoint.pt", state | {"num_timesteps": 900})
    assert runs.load_last(broken)["num_timesteps"] == 900
    damage(broken / "checkpoint.pt")
    with pytest.warns(UserWarning, match="using the one before it, checkpoint_before.pt, of step 800"):
        assert runs.load_last(broken)["num_timesteps"] == 800
    flip(broken / "checkpoint_before.pt")
    with pytest.raises(ValueError, match="checkpoint_before.pt' is no checkpoint .it is damaged.*: train again"):
        runs.load_last(broken)


def test_checkpoints_that_lack_something_or_hold_nonsense_are_a_sentence(broken):
    import torch

    from clothgym.adapters import runs

    (broken / "policy.npz").unlink()
    state = runs.load_tensors(broken / "checkpoint.pt")
    name = next(iter(state["policy"]))
    nan = state["policy"] | {name: state["policy"][name] * torch.nan}
    for other, said in (
        ({"policy": state["policy"]}, "does not hold policy, optimizer"),
        (state | {"policy": nan}, "a value that is not finite"),
        (state | {"num_timesteps": -3}, "number of steps is negative"),
    ):
        runs.save_tensors(broken / "checkpoint.pt", other)
        with pytest.raises(ValueError, match=f"checkpoint.pt' is no checkpoint .*{said}"):
            runs.load_tensors(broken / "checkpoint.pt")
    config = files.read_json(broken / "config.json", "", "")
    runs.save_tensors(broken / "checkpoint.pt", state)
    for layers in ([16], [8, 8], [10**9]):
        config["hyperparameters"]["policy_kwargs"]["net_arch"] = layers
        files.write_json(broken / "config.json", config)
        with pytest.raises(ValueError, match="config.json' is no configuration of the network in this run"):
            runs.learned(broken, "ClothReach-v0")


@pytest.mark.slow
def test_a_resumed_run_reports_dropped_lines(broken, trained):
    """A broken line and one from after the checkpoint, and a checkpoint that is gone."""
    _, options = trained
    lines = (broken / "progress.jsonl").read_text().splitlines()
    later = json.dumps(files.checked_in(files.checked_out(json.loads(lines[0])) | {"timesteps": 5000}))
    (broken / "progress.jsonl").write_text("\n".join([*lines, lines[1].replace("800", "900"), later, lines[0][:30]]))
    (broken / "checkpoint.pt").rename(broken / "checkpoint_before.pt")
    resumed = run("train.py", "--resume", broken, "--timesteps", 1200, *options[2:], cwd=broken.parent)
    assert resumed.returncode == 0, resumed.stderr
    assert "using the one before it" in resumed.stderr
    assert [n for n in range(9) if f"line {n} is broken, and is dropped" in resumed.stderr] == [3, 5]
    kept = [json.loads(line)["timesteps"] for line in (broken / "progress.jsonl").read_text().splitlines()]
    assert kept == [400, 800, 1200]
    assert not [path for path in broken.rglob("*") if ".part" in path.name or ".new" in path.name]

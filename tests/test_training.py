"""The scripts, run as a user runs them, on a few steps: a run's folder, resuming, evaluating, and their errors."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SHORT = """
ClothDrape-v0:
  n_envs: 16
  n_timesteps: !!float 800
  policy: MlpPolicy
  n_steps: 25
  batch_size: 100
  n_epochs: 1
  learning_rate: lin_0.001
  policy_kwargs: {net_arch: [8], log_std_init: -1.0}
"""


def run(script, *arguments, cwd):
    command = [sys.executable, str(ROOT / "training" / script), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    (folder / "short.yml").write_text(SHORT)
    options = ("--hyperparams", folder / "short.yml", "--eval-episodes", 4, "--final-episodes", 6)
    done = run("train.py", "--run", folder / "run", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, options


def test_a_run_leaves_its_story(trained):
    folder, _ = trained
    names = {path.name for path in (folder / "run").iterdir()}
    assert {
        "config.json",
        "checkpoint.pt",
        "model.zip",
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


def test_a_run_is_resumed_and_never_overwritten(trained):
    folder, options = trained
    again = run("train.py", "--run", folder / "run", *options, cwd=folder)
    assert again.returncode != 0 and "--resume" in again.stderr
    resumed = run("train.py", "--resume", folder / "run", "--timesteps", 1600, *options[2:], cwd=folder)
    assert resumed.returncode == 0, resumed.stderr
    assert "at 800 of 1,600 steps" in resumed.stdout
    lines = [json.loads(line) for line in (folder / "run" / "progress.jsonl").read_text().splitlines()]
    assert lines[-1]["timesteps"] == 1600
    assert lines[-1]["training_seconds"] > lines[0]["training_seconds"]


def test_the_learnt_policy_is_evaluated_beside_the_references(trained):
    folder, _ = trained
    out = folder / "scores.json"
    done = run("evaluate.py", "--policy", "noop", folder / "run", "--episodes", 7, "--json", out, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "noop" in done.stdout and "performance" in done.stdout
    scores = json.loads(out.read_text())
    assert scores["noop"]["success_rate"] == 0 and scores[str(folder / "run")]["episodes"] == 7
    one = run("evaluate.py", "--policy", "expert", "--episodes", 7, "--json", out, cwd=folder)
    assert one.returncode == 0 and json.loads(out.read_text())["success_rate"] > 0.5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--policy", "nowhere"), "neither noop, random, expert nor a run"),
        (("--episodes", "0"), "must be at least 1"),
    ],
)
def test_errors_are_sentences(arguments, sentence, tmp_path):
    done = run("evaluate.py", *arguments, cwd=tmp_path)
    assert done.returncode != 0 and sentence in done.stderr


def test_a_checkpoint_of_another_version_is_refused(trained, tmp_path):
    folder, _ = trained
    config = json.loads((folder / "run" / "config.json").read_text())
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "config.json").write_text(json.dumps(config | {"clothgym": "0.0.1"}))
    (tmp_path / "old" / "checkpoint.pt").write_bytes((folder / "run" / "checkpoint.pt").read_bytes())
    done = run("evaluate.py", "--policy", tmp_path / "old", "--episodes", 2, cwd=tmp_path)
    assert done.returncode != 0 and "0.0.1" in done.stderr


def test_a_checkpoint_is_never_unpickled(trained, tmp_path):
    """A pickle in the place of the tensors is refused, not run."""
    import pickle

    folder, _ = trained
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "config.json").write_text((folder / "run" / "config.json").read_text())
    (tmp_path / "evil" / "checkpoint.pt").write_bytes(pickle.dumps(Path("/tmp")))
    done = run("evaluate.py", "--policy", tmp_path / "evil", "--episodes", 2, cwd=tmp_path)
    assert done.returncode != 0 and "cannot be read as a checkpoint" in done.stderr

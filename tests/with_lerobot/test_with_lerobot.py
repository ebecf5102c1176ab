"""Sets read by LeRobot itself, its ACT trained on one, and evaluated by its command: make lerobot."""

import json
import subprocess
import sys

import numpy as np
import pytest
from training_runs import ROOT, run

pytest.importorskip("lerobot")
RECORD = ("--env", "ClothReach-v0", "--episodes", 3)
SMALL = (
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=32",
    "--policy.chunk_size=4",
    "--policy.n_action_steps=2",
)


def record(folder, name, *flags):
    done = run("record.py", *RECORD, "--out", name, *flags, cwd=folder)
    assert done.returncode == 0, done.stderr
    sys.path.insert(0, str(ROOT / "training"))
    import formats
    import recordings

    return list(formats.named("lerobot").read(folder / name, recordings.read_about(folder / name)))


def command(module, folder, *flags):
    done = subprocess.run([sys.executable, "-m", f"lerobot.scripts.{module}", *flags], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.mark.parametrize("flags", [(), ("--obs-mode", "rgb"), ("--obs-mode", "depth", "--env-kwargs", '{"image_size": 16}')])
def test_it_reads_the_arrays_that_were_written(tmp_path, flags):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    episodes, found = record(tmp_path, "set", *flags), LeRobotDataset("local/set", root=tmp_path / "set")
    frames = [(episode, step) for episode in episodes for step in range(len(episode["actions"]))]
    assert len(found) == len(frames) == 120 and found.meta.total_episodes == 3
    names = {"agent_pos": "observation.state", "environment_state": "observation.environment_state", "depth": "observation.depth"}
    for frame, (episode, step) in zip(found, frames):
        assert np.array_equal(frame["action"], episode["actions"][step])
        assert frame["next.reward"].item() == np.float32(episode["rewards"][step])  # LeRobot gives all numbers in float32
        assert frame["task"] == "Bring the free corner of a hanging sheet to rest at a goal."
        for key in episode.keys() & names.keys():
            assert np.array_equal(frame[names[key]], episode[key][step])
        if "pixels" in episode:
            assert np.array_equal(np.rint(frame["observation.image"].numpy() * 255), episode["pixels"][step].transpose(2, 0, 1))


def test_it_finds_each_picture_in_a_film(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    exact = record(tmp_path, "png", "--obs-mode", "rgb")
    record(tmp_path, "film", "--obs-mode", "rgb", "--pictures", "video")
    found = LeRobotDataset("local/film", root=tmp_path / "film")
    for episode, step in ((0, 0), (1, 0), (1, 39), (2, 20)):
        picture = found[40 * episode + step]["observation.image"].numpy().transpose(1, 2, 0) * 255
        assert np.abs(picture - exact[episode]["pixels"][step]).mean() < 5


def test_its_act_learns_from_a_set_and_is_evaluated(tmp_path):
    record(tmp_path, "set")
    flags = ("--dataset.repo_id=local/set", "--dataset.root=set", "--policy.type=act", "--policy.device=cpu", "--output_dir=run")
    flags += ("--policy.push_to_hub=false", "--policy.use_vae=false", "--steps=2", "--batch_size=4", "--num_workers=0", *SMALL)
    command("lerobot_train", tmp_path, *flags)
    flags = ("--policy.path=run/checkpoints/last/pretrained_model", "--policy.device=cpu", "--output_dir=scores")
    flags += ("--env.discover_packages_path=clothgym.adapters.lerobot", "--env.type=clothgym", "--env.task=ClothReach-v0")
    command("lerobot_eval", tmp_path, *flags, "--env.obs_mode=keypoints", "--eval.n_episodes=4", "--eval.batch_size=2")
    scores = json.loads((tmp_path / "scores" / "eval_info.json").read_text())
    assert scores["overall"]["n_episodes"] == 4 and len(list(tmp_path.glob("scores/videos/*/*.mp4"))) == 4
    assert all(-1 < value < 1.5 for value in scores["per_task"][0]["metrics"]["sum_rewards"])


def test_its_make_env_takes_the_file_of_a_hub():
    from lerobot.envs.utils import _call_make_env, _import_hub_module, _normalize_hub_result

    module = _import_hub_module(str(ROOT / "docs" / "hub" / "env.py"), "user/repository")
    ((suite, tasks),) = _normalize_hub_result(_call_make_env(module, n_envs=2, use_async_envs=False, cfg=None)).items()
    assert suite == "ClothFold-v0" and tasks[0].num_envs == 2

"""Recorded data sets, beside the same episodes run one by one; killed and resumed; and what the files of each format hold."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from training_runs import ROOT, call

from clothgym.envs.episode import TaskState

FORMATS = {"lerobot": ("pyarrow", "PIL"), "minari": ("minari", "h5py"), "robomimic": ("h5py",)}
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

# the script, killed at the nth call of a function, by a signal that no program can catch
KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv.pop(1))
import recordings, record, tyro
owner, name, calls = sys.argv.pop(1).split(".")
owner = getattr(recordings, owner)
original, count = getattr(owner, name), 0
def counted(*args, **kwargs):
    global count
    count += 1
    if count == int(calls):
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*args, **kwargs)
setattr(owner, name, counted)
record.main(tyro.cli(record.Args))
"""


@pytest.fixture
def recorded(scripts, tmp_path, monkeypatch):
    """Record a set with the script's flags; returns its folder, what it says of itself, and its episodes."""
    monkeypatch.chdir(tmp_path)

    def make(*flags, out="set", form="lerobot"):
        for library in FORMATS[form]:
            pytest.importorskip(library)
        done = call("record.py", "--out", out, "--format", form, *flags)
        assert done.returncode == 0, done.stderr
        return read(tmp_path / out)

    return make


def read(folder):
    import formats
    import recordings

    about = recordings.read_about(folder)
    return folder, about, list(formats.named(about["format"]).read(folder, about))


def played(env, actions, start):
    """Observations, attachments' positions and rewards of actions in a single environment, from a seed or a state."""
    if isinstance(start, TaskState):
        env.set_state(start)
        seen = [env.task.observation[0].copy()]
    else:
        seen = [env.reset(seed=start)[0]]
    held, rewards = [env.task.simulation.attachment_positions[0].ravel()], []
    for action in actions:
        observation, reward, terminated, _, info = env.step(action)
        seen.append(observation)
        held.append(env.task.simulation.attachment_positions[0].ravel())
        rewards.append(reward)
    return np.array(seen), np.array(held, np.float32), np.array(rewards), terminated, info


@pytest.mark.parametrize("form", FORMATS)
def test_a_set_holds_what_the_environment_gave(recorded, form):
    """Episodes of different lengths, more of them than environments in the batch."""
    flags = ("--env", "ClothDrape-v0", "--policy", "random", "--episodes", 5, "--num-envs", 3, "--seed", 7)
    folder, about, episodes = recorded(*flags, form=form)
    env = gym.make("ClothDrape-v0").unwrapped
    lengths = [len(episode["actions"]) for episode in episodes]
    assert len(set(lengths)) > 1 and len(lengths) == 5
    for index, episode in enumerate(episodes):
        for start in (7 + index, TaskState.load(folder / "states" / f"{index}.npz")):
            seen, held, rewards, terminated, info = played(env, episode["actions"], start)
            assert np.array_equal(episode["environment_state"], seen[:-1]) and np.array_equal(episode["agent_pos"], held[:-1])
            assert np.array_equal(episode["rewards"], rewards) and episode["rewards"].dtype == np.float64 and terminated
        listed = about["list"][index]
        assert (listed["seed"], listed["length"], listed["success"]) == (7 + index, lengths[index], info["is_success"])
        assert listed["return"] == pytest.approx(sum(rewards)) and np.abs(episode["actions"]).max() > 0.9


@pytest.mark.parametrize(
    ("form", "where"), [("lerobot", "Journal.add.4"), ("minari", "Journal.read.3"), ("robomimic", "Journal.add.2")]
)
def test_a_killed_recording_goes_on_to_the_same_set(recorded, tmp_path, form, where):
    flags = ("--env", "ClothReach-v0", "--policy", "random", "--episodes", 6, "--num-envs", 2)
    whole, about, expected = recorded(*flags, form=form, out="whole")
    command = [sys.executable, "-c", KILLED, ROOT / "training", where, *flags, "--format", form, "--out", "killed"]
    run = subprocess.run(list(map(str, command)), cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert run.returncode == -signal.SIGKILL, run.stderr
    kept = len(list((tmp_path / "killed.part" / "episodes").glob("*.npz")))
    assert not (tmp_path / "killed").exists() and kept == {"Journal.add.4": 3, "Journal.read.3": 6, "Journal.add.2": 1}[where]
    # another recording does not go on with it
    other = call("record.py", *flags, "--format", form, "--out", "killed", "--seed", 50)
    assert other.returncode == 2 and "seed=50" in other.stderr and "killed.part" in other.stderr
    folder, resumed, episodes = recorded(*flags, form=form, out="killed")
    assert not (tmp_path / "killed.part").exists() and resumed["list"] == about["list"]
    for episode, other in zip(episodes, expected, strict=True):
        assert all(np.array_equal(episode[name], other[name]) for name in {*episode, *other})
    if form == "lerobot":
        (data,) = folder.glob("data/*/*")
        assert data.read_bytes() == (whole / data.relative_to(folder)).read_bytes()


def test_minari_opens_a_set_by_its_name(recorded, tmp_path, monkeypatch):
    """In its root, by the names of the folders; and makes the environment again."""
    minari = pytest.importorskip("minari")
    flags = ("--env", "ClothFoldGoal-v0", "--policy", "random", "--episodes", 2, "--seed", 3)
    root = tmp_path / "cloth" / "fold"
    root.mkdir(parents=True)
    folder, _, _ = recorded(*flags, form="minari", out=str(root / "random-v0"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("cloth/fold/random-v0")
    assert dataset.spec.dataset_name == "random" and dataset.spec.version == 0
    env = dataset.recover_environment()
    assert env.spec.id == "ClothFoldGoal-v0" and env.observation_space == dataset.observation_space
    observation, info = env.reset(seed=4)
    for key, part in dataset[1].observations.items():
        assert np.array_equal(part[0], observation[key])
    assert dataset[1].infos["strain_max"][0] == info["strain_max"] and dataset[1].terminations[-1]


def test_robomimic_opens_a_set(recorded):
    pytest.importorskip("robomimic")
    from robomimic.utils import obs_utils
    from robomimic.utils.dataset import SequenceDataset

    keys = ("agent_pos", "environment_state")
    folder, _, episodes = recorded("--env", "ClothReach-v0", "--episodes", 2, form="robomimic")
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": list(keys), "rgb": []}})
    found = SequenceDataset(str(folder / "demo.hdf5"), obs_keys=keys, dataset_keys=("actions", "rewards", "dones"))
    frames = [(episode, step) for episode in episodes for step in range(len(episode["actions"]))]
    assert len(found) == len(frames) == 80
    for k, (episode, step) in enumerate(frames):
        frame = found[k]
        assert np.array_equal(frame["actions"][0], episode["actions"][step]) and frame["dones"][0] == (step == 39)
        assert frame["rewards"][0] == episode["rewards"][step]
        for key in keys:
            assert np.array_equal(frame["obs"][key][0], episode[key][step])
            assert step == 39 or np.array_equal(frame["next_obs"][key][0], episode[key][step + 1])


def test_failed_episodes_are_marked_or_left_out(recorded):
    flags = ("--env", "ClothReach-v0", "--policy", "expert", "--noise", 0.2, "--num-envs", 3)
    _, kept, _ = recorded(*flags, "--episodes", 12, "--failed", "keep", out="kept")
    successes = [one["seed"] for one in kept["list"] if one["success"]]
    assert 2 < len(successes) < 12  # the disturbance fails some
    _, dropped, episodes = recorded(*flags, "--episodes", 3, "--failed", "drop", out="dropped")
    assert [one["seed"] for one in dropped["list"]] == successes[:3] and len(episodes) == 3
    never = call("record.py", "--env", "ClothReach-v0", "--policy", "noop", "--episodes", 1, "--failed", "drop", "--out", "never")
    assert never.returncode == 2 and "0 of 11 episodes were successes, 1 are wanted" in never.stderr


def test_an_edited_episode_does_not_replay(recorded):
    pytest.importorskip("h5py")
    import h5py

    folder, *_ = recorded("--env", "ClothReach-v0", "--episodes", 3, form="robomimic")
    assert "3 of 3 episodes replay to the bit" in call("record.py", "--verify", folder).stdout
    with h5py.File(folder / "demo.hdf5", "a") as file:
        file["data/demo_1/actions"][20, 0] = np.nextafter(file["data/demo_1/actions"][20, 0], np.float32(2))
    refused = call("record.py", "--verify", folder)
    assert refused.returncode == 2 and "episodes [1] do not replay" in refused.stderr


def test_pictures_are_kept_as_they_are(recorded):
    kwargs = json.dumps({"privileged": True, "image_size": 16})
    flags = ("--env", "ClothReach-v0", "--episodes", 1, "--obs-mode", "rgb", "--env-kwargs", kwargs)
    folder, _, (episode,) = recorded(*flags)
    env = gym.make("ClothReach-v0", obs_mode="rgb", privileged=True, image_size=16)
    seen = env.reset(seed=0)[0]
    for action, picture, state in zip(episode["actions"], episode["pixels"], episode["environment_state"]):
        assert np.array_equal(picture, seen["observation"]) and np.array_equal(state, seen["state"])
        seen, *_ = env.step(action)
    stats = json.loads((folder / "meta" / "stats.json").read_text())["observation.image"]
    levels = episode["pixels"].reshape(-1, 3) / 255
    for name, value in (("mean", levels.mean(0)), ("std", levels.std(0)), ("max", levels.max(0)), ("q50", np.median(levels, 0))):
        assert np.ravel(stats[name]) == pytest.approx(value, abs=1e-6), name


def test_a_policy_on_state_vectors_acts_while_pictures_are_recorded(recorded):
    kwargs = json.dumps({"privileged": True, "image_size": 16})
    flags = ("--env", "ClothReach-v0", "--policy", "learned", "--episodes", 2)
    _, _, pictured = recorded(*flags, "--obs-mode", "rgb", "--env-kwargs", kwargs, out="pictures")
    _, _, plain = recorded(*flags, out="states")
    for one, other in zip(pictured, plain, strict=True):
        assert np.array_equal(one["actions"], other["actions"]) and np.array_equal(one["rewards"], other["rewards"])
    refused = call("record.py", *flags, "--obs-mode", "particles", "--out", "no")
    assert refused.returncode == 2 and "learned observes keypoints" in refused.stderr


def test_films_follow_the_pictures(recorded):
    av = pytest.importorskip("av")
    flags = ("--env", "ClothReach-v0", "--episodes", 2, "--obs-mode", "rgb")
    _, _, exact = recorded(*flags, out="png")
    folder, _, episodes = recorded(*flags, "--pictures", "video", out="films")
    assert "pixels" not in episodes[0]
    with av.open(folder / "videos/observation.image/chunk-000/file-000.mp4") as film:
        decoded = np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)])
    pictures = np.concatenate([episode["pixels"] for episode in exact])
    assert decoded.shape == pictures.shape and np.abs(decoded.astype(float) - pictures).mean() < 5
    # they change by less than this from one step to the next, where the sheet moves
    order = [np.abs(decoded[30].astype(float) - pictures[k]).mean() for k in (20, 30, 39)]
    assert order[1] == min(order)


def test_lerobot_files_index_each_other(recorded):
    folder, _, episodes = recorded("--env", "ClothReach-v0", "--episodes", 3, "--failed", "drop")
    import pyarrow.parquet as pq

    info = json.loads((folder / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["fps"]) == ("v3.0", 3, 120, 15)
    frames = pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    assert frames["index"] == list(range(120)) and frames["episode_index"] == [0] * 40 + [1] * 40 + [2] * 40
    assert frames["timestamp"][41] == np.float32(1 / 15) and sum(frames["next.done"]) == 3 and frames["next.success"][-1]
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [(0, 40), (40, 80), (80, 120)]
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks["task"].to_pylist() == ["Bring the free corner of a hanging sheet to rest at a goal."] == rows[0]["tasks"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    actions = np.concatenate([episode["actions"] for episode in episodes]).astype(float)
    for name, value in (("mean", actions.mean(0)), ("std", actions.std(0)), ("min", actions.min(0)), ("count", [120])):
        assert stats["action"][name] == pytest.approx(np.asarray(value)), name
    # the checksums of the metadata are those of the files
    about = json.loads((folder / "croissant.json").read_text())
    import hashlib

    for one in about["distribution"][:-1]:
        assert one["sha256"] == hashlib.sha256((folder / one["contentUrl"]).read_bytes()).hexdigest()
    assert {field["name"] for field in about["recordSet"][0]["field"]} == set(frames)


def test_wrong_flags_are_refused(recorded):
    for flags, said in (
        (("--pictures", "video"), "--pictures video: is for --format lerobot with --obs-mode rgb"),
        (("--seed", 999_990), "seeds are for evaluation"),
        (("--noise", 2), "--noise 2.0: must be from 0 to 1"),
        (("--noise", 0.1, "--policy", "random"), "--noise 0.1: the actions of --policy random are noise already"),
        (("--policy", "exprt"), "exprt"),
    ):
        done = call("record.py", *flags)
        assert done.returncode == 2 and said in " ".join(done.stderr.replace("│", "").split()), done.stderr
    pytest.importorskip("pyarrow")
    full = call("record.py", "--env", "ClothReach-v0", "--episodes", 2, "--max-gb", 1e-6, "--out", "full")
    assert full.returncode == 2 and "--max-gb" in full.stderr and not Path("full").exists()

"""Behavior cloning from a recorded set: the chunks that are fitted, how they are executed, and a short run."""

import json

import gymnasium as gym
import numpy as np
import pytest
from training_runs import call

from clothgym.adapters.runs import Chunks
from clothgym.policies import Policy

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_a_chunk_ends_where_actions_have_no_effect(scripts):
    from clone_set import samples

    # five steps, of which the last settles; an observation is the step and whether it settles, an action ten times the step
    episode = {"environment_state": np.array([[t, t == 4] for t in range(5)], float), "actions": 10.0 * np.arange(5)[:, None]}
    seen, actions, there = samples(episode, 3, slice(1, 2))
    assert seen[:, 0].tolist() == [0, 1, 2, 3]
    assert actions[..., 0].tolist() == [[0, 10, 20], [10, 20, 30], [20, 30, 30], [30, 30, 30]]
    assert there.tolist() == [[True] * 3, [True] * 3, [True, True, False], [True, False, False]]
    assert len(samples(episode, 3, None)[0]) == 5


def test_a_chunk_is_executed_in_order():
    """The network gives constants: actions 0, 0.25 and 0.5, of which the first two are executed."""
    env = gym.make_vec("ClothReach-v0", num_envs=2, autoreset_mode="Disabled")
    observations, _ = env.reset(seed=0)
    bias = np.repeat([0.0, 0.25, 0.5], 3).astype(np.float32)
    weights = np.zeros((observations.shape[1], 9), np.float32)
    policy = Chunks(Policy([(weights, bias)], about={"chunk": 3, "execute": 2}))
    acted = []
    for _ in range(5):
        actions = policy(env, observations)
        acted.append(float(actions[1, 2]))
        observations, *_ = env.step(actions)
    assert acted == [0, 0.25, 0, 0.25, 0] and actions.shape == (2, 3)
    # after five steps the second action is due, and the first in an environment whose episode begins
    observations, _ = env.reset(seed=1, options={"reset_mask": np.array([True, False])})
    assert policy(env, observations)[:, 0].tolist() == [0, 0.25]


def test_a_set_is_cloned_and_its_policy_is_scored(scripts, tmp_path, monkeypatch):
    for library in ("h5py", "stable_baselines3"):
        pytest.importorskip(library)
    monkeypatch.chdir(tmp_path)
    flags = ("--env", "ClothReach-v0", "--episodes", 40, "--out", "set", "--format", "robomimic")
    assert call("record.py", *flags).returncode == 0
    cloned = call("clone_set.py", "--data", "set", "--run", "run", "--epochs", 20, "--layers", 32, "--episodes", 50)
    assert "cloned 1,600 samples" in cloned.stdout, cloned.stderr
    row = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    # the expert brings the corner 0.96 of the way and more, no motion 0; 20 passes over 40 episodes learn most of it
    assert row["normalized_performance"] > 0.5 and row["episodes"] == 50 and row["seed"] == 0
    # the file is a policy for the other scripts
    scored = call("evaluate.py", "--env", "ClothReach-v0", "--policy", "run/policy.npz", "--episodes", 50, "--json", "again.json")
    assert scored.returncode == 0, scored.stderr
    assert json.loads((tmp_path / "again.json").read_text())["success_rate"] == row["success_rate"]
    pictures = call(
        "record.py", "--env", "ClothReach-v0", "--episodes", 1, "--obs-mode", "depth", "--out", "p", "--format", "robomimic"
    )
    refused = call("clone_set.py", "--data", "p")
    assert pictures.returncode == 0 and refused.returncode == 2 and "record one with --obs-mode keypoints" in refused.stderr

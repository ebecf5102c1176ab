"""Minari records datasets of our environments, with their infos, and makes the environment again (pip install "minari[hdf5]")."""

import gymnasium as gym
import numpy as np
import pytest
from page import run


@pytest.mark.filterwarnings("ignore")
def test_a_dataset_with_infos(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    pytest.importorskip("jax")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = run("Minari")["dataset"]
    episode = dataset[0]
    # the same episode, played without Minari
    env = gym.make("ClothReach-v0")
    strains, done = [env.reset(seed=0)[1]["strain_max"]], False
    while not done:
        *_, done, _, info = env.step(env.unwrapped.expert_action())
        strains.append(info["strain_max"])
    # an episode of ClothReach-v0 takes 40 steps, and is evaluated in the last
    assert dataset.total_steps == 40 and episode.terminations.tolist() == [False] * 39 + [True] and not episode.truncations.any()
    assert np.array_equal(episode.infos["strain_max"], strains) and episode.infos["is_success"][-1]
    assert dataset.recover_environment().spec.id == "ClothReach-v0"

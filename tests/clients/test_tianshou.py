"""Tianshou's own vector environments hold ours (pip install tianshou)."""

import gymnasium as gym
import numpy as np
import pytest
from page import run


@pytest.mark.filterwarnings("ignore")
def test_its_vector_environment_holds_ours():
    pytest.importorskip("tianshou.env")
    env, single = run("Tianshou")["env"], gym.make("ClothReach-v0")
    env.seed([5, 6])
    observations, _ = env.reset(seed=5)
    assert np.array_equal(observations[0], single.reset(seed=5)[0])
    for _ in range(40):
        observations, rewards, terminated, truncated, infos = env.step(np.zeros((2, 3), np.float32))
        expected = single.step(np.zeros(3, np.float32))
        assert np.array_equal(observations[0], expected[0]) and rewards[0] == expected[1]
    assert terminated.all() and not truncated.any()
    assert {key: infos[0][key] for key in expected[4]} == expected[4]

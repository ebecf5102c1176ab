"""skrl takes our batches, by the name of the interface (pip install skrl)."""

import gymnasium as gym
import pytest
from page import run


@pytest.mark.filterwarnings("ignore")
def test_a_batch():
    pytest.importorskip("skrl.envs.wrappers.torch")
    import torch

    env, own = run("skrl")["env"], gym.make_vec("ClothReach-v0", num_envs=64)
    env.reset(), own.reset(seed=0)
    for step in range(41):
        observation, reward, terminated, truncated, info = env.step(torch.zeros(64, 3))
        assert bool(terminated.all()) == (step == 39) and not truncated.any()
    assert observation.shape == (64, own.single_observation_space.shape[0]) and reward.shape == (64, 1)
    assert info["failure"].tolist() == [0] * 64

"""skrl takes our batches, by the name of the interface (pip install skrl)."""

import gymnasium as gym
import pytest

import clothgym  # noqa: F401 - registers the ids


@pytest.mark.filterwarnings("ignore")
def test_a_batch():
    wrappers = pytest.importorskip("skrl.envs.wrappers.torch")
    import torch

    env = wrappers.wrap_env(gym.make_vec("ClothReach-v0", num_envs=3), wrapper="gymnasium")
    own = gym.make_vec("ClothReach-v0", num_envs=3)
    env.reset(), own.reset(seed=0)
    for step in range(41):
        observation, reward, terminated, truncated, info = env.step(torch.zeros(3, 3))
        assert bool(terminated.all()) == (step == 39) and not truncated.any()
    assert observation.shape == (3, own.single_observation_space.shape[0]) and reward.shape == (3, 1)
    assert info["failure"].tolist() == [0, 0, 0]

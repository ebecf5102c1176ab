"""TorchRL takes our batches, with autoreset disabled or in the same step, and single environments (pip install torchrl)."""

import gymnasium as gym
import pytest
from page import run

STEPS = 45


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("mode", ["Disabled", "SameStep"])
def test_batches_roll_through_the_end_of_an_episode(mode):
    envs = pytest.importorskip("torchrl.envs")
    if mode == "Disabled":
        rolled = run("TorchRL")["data"]["next"]
    else:
        env = envs.GymWrapper(gym.make_vec("ClothReach-v0", num_envs=3, autoreset_mode=mode))
        rolled = env.rollout(STEPS, break_when_any_done=False)["next"]
    ends = rolled["terminated"][..., 0]
    assert ends.shape == (3, STEPS) and ends[:, 39].all() and ends.sum() == 3 and not rolled["truncated"].any()
    # a term of the reward is beside the reward
    terms = sum(rolled[f"reward/{name}"] for name in ("progress", "effort", "success", "failure"))
    running = ~ends if mode == "SameStep" else ends | ~ends  # in the same step the infos are of the reset
    assert (terms - rolled["reward"][..., 0])[running].abs().max() < 1e-6


@pytest.mark.filterwarnings("ignore")
def test_a_single_environment():
    pytest.importorskip("torchrl.envs")
    utils = pytest.importorskip("torchrl.envs.utils")
    env = run("TorchRL")["single"]
    utils.check_env_specs(env)
    assert env.rollout(STEPS).batch_size[0] == 40

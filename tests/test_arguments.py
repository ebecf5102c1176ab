"""Every argument that all ids share, and what touches in every id, through whole episodes and autoreset."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs.episode import DIVERGED

GRIPPER = "ClothDrapeGripper-v0"
VALUES = [
    *({"fabric": fabric} for fabric in ("silk", "denim")),
    {"integrator": "implicit_euler"},
    {"integrator": {"name": "xpbd", "iterations": 1}, "substeps": "auto"},
    *({"bending": model} for model in ("hinge", "quadratic")),
    {"strain_limit": 0.1},
    *({"self_collision": mode} for mode in ("fast", "strict", {"mode": "strict", "thickness": 0.004})),
    {"contact": "sheet"},
    {"physics": "true"},
    {"air_density": 1.2},
    {"obs_mode": "particles"},
    {"reward_mode": "sparse"},
    {"randomize": {"density": [0.1, 0.2]}},
    {"wind": {"speed": [0, 2], "gust": 0.5}},
    {"render_color": "strain"},
]
CONTACT = [kwargs for kwargs in VALUES if {"self_collision", "contact", "physics"} & set(kwargs)]
CASES = [("ClothReach-v0", kwargs) for kwargs in VALUES]
CASES += [(env_id, kwargs) for env_id in (GRIPPER, "ClothStrain-v0") for kwargs in CONTACT]
CASES += [(GRIPPER, kwargs) for kwargs in ({"grippers": 1}, {"slip_force": 0.5}, {"grippers": 1, "self_collision": "strict"})]


@pytest.mark.parametrize(("env_id", "kwargs"), CASES)
def test_every_argument_plays_episodes_through_autoreset(env_id, kwargs):
    """Experts and random actions side by side: finite, within the spaces, and whole; no value is refused in mid-play."""
    env = gym.make_vec(f"clothgym:{env_id}", num_envs=4, threads=1, **kwargs)
    task, random = env.unwrapped.task, np.random.default_rng(0)
    env.reset(seed=3)
    ended = 0
    for _ in range(task.acting_steps + task.settling_steps + 8):
        actions = random.uniform(-1, 1, env.action_space.shape)
        actions[::2] = env.unwrapped.expert_actions()[::2]
        observations, rewards, terminated, truncated, info = env.step(actions)
        ended += np.sum(terminated | truncated)
        assert np.isfinite(rewards).all() and env.observation_space.contains(observations)
        assert not np.any(info["failure"] == DIVERGED)
    assert ended >= 4
    if "strict" in str(kwargs.get("self_collision")) or "physics" in kwargs:
        assert not task.simulation.intersections().any()

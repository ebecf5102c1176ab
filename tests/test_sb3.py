"""The Stable-Baselines3 adapter against the native vector environment."""

import math

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor
from test_envs import flat

from clothgym.adapters.sb3 import make_sb3_vec_env
from clothgym.envs.answers import key_of
from clothgym.registration import ENVIRONMENTS

# a harder tier has its task's spaces
every_id = pytest.mark.parametrize("env_id", [env_id for env_id in ENVIRONMENTS if "-Hard" not in env_id])


@every_id
def test_it_gives_what_the_native_batch_gives(env_id):
    adapter = make_sb3_vec_env(env_id, 3, seed=4)
    native = gym.make_vec(f"clothgym:{env_id}", num_envs=3, autoreset_mode="SameStep")
    rng, task = np.random.default_rng(0), native.unwrapped.task
    observation, _ = native.reset(seed=4)
    assert np.array_equal(flat(adapter.reset()), flat(observation))
    ended, left = False, 20
    # most of the time to act is over already
    for one in (adapter.env.task, task):
        one.episode["step"] = one.acting_steps - left
    for _ in range(left + task.settling_steps + 2):
        actions = rng.uniform(-1, 1, native.action_space.shape).astype(np.float32)
        observation, rewards, dones, infos = adapter.step(actions)
        expected, reward, terminated, truncated, info = native.step(actions)
        assert np.array_equal(flat(observation), flat(expected)) and rewards.dtype == np.float32
        assert np.array_equal(rewards, reward.astype(np.float32)) and np.array_equal(dones, terminated | truncated)
        for i in range(3):
            # of a step within an episode there is nothing to tell but its cost, where the task has one
            assert dones[i] or infos[i] == ({"cost": info["cost"][i]} if "cost" in info else {})
            if dones[i]:
                ended = True
                assert np.array_equal(flat(infos[i]["terminal_observation"]), flat(info["final_obs"][i]))
                assert infos[i]["TimeLimit.truncated"] is False
                for key in ("normalized_performance", *(key_of(name) for name, *_ in task.evaluation), "strain_max", "failure"):
                    assert infos[i][key] == info["final_info"][key][i], key
                assert isinstance(infos[i]["reward/progress"], float)
    assert ended


@every_id
def test_sb3_trains_on_it_and_logs_episodes(env_id, monkeypatch):
    adapter = make_sb3_vec_env(env_id, 2, seed=0)
    env, task, reset = VecMonitor(adapter), adapter.env.task, adapter.reset

    def late():
        """Most of the time to act is over already."""
        observation = reset()
        task.episode["step"] += task.acting_steps - 10
        return observation

    monkeypatch.setattr(adapter, "reset", late)
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    model = PPO(policy, env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(2 * 32 * math.ceil((12 + task.settling_steps) / 32))
    assert len(model.ep_info_buffer) > 0
    assert all(np.isfinite(episode["r"]) for episode in model.ep_info_buffer)


@every_id
def test_attributes_methods_and_errors(env_id):
    env = make_sb3_vec_env(env_id, 2, seed=0, render_mode="rgb_array")
    env.reset()
    assert env.get_attr("num_envs") == [2, 2]
    assert env.get_attr("render_mode", indices=[1]) == ["rgb_array"]
    assert len(env.get_images()) == 2
    assert env.env_method("expert_actions", indices=[0])[0].shape == env.action_space.shape
    assert env.env_is_wrapped(gym.Wrapper) == [False, False]
    env.set_attr("render_mode", None)
    with pytest.raises(ValueError, match="whole batch"):
        env.set_attr("render_mode", None, indices=[0])
    with pytest.raises(ValueError, match=env_id):
        make_sb3_vec_env("CartPole-v1", 2)


@pytest.mark.parametrize("kind", [None, SubprocVecEnv])
def test_the_library_s_own_functions_work_with_default_arguments(kind):
    """``make_vec_env`` and ``evaluate_policy``: the mean of the returns of the same episodes, played one by one."""
    # worker processes import nothing but what the id names
    envs = make_vec_env("clothgym:ClothReach-v0", n_envs=2, seed=5, vec_env_cls=kind)
    model = PPO("MlpPolicy", envs, n_steps=20, batch_size=20, device="cpu", seed=0).learn(40)
    envs.seed(100)
    mean, deviation = evaluate_policy(model, envs)
    envs.close()
    returns = []
    for lane in range(2):
        env = gym.make("ClothReach-v0")
        # five episodes of each, the later ones drawn by the environment's generator
        for episode in range(5):
            observation, _ = env.reset(seed=100 + lane if episode == 0 else None)
            total, done = 0.0, False
            while not done:
                action, _ = model.predict(observation, deterministic=True)
                observation, reward, terminated, truncated, _ = env.step(action)
                total, done = total + reward, terminated or truncated
            returns.append(total)
    assert mean == pytest.approx(np.mean(returns), abs=1e-5) and deviation == pytest.approx(np.std(returns), abs=1e-5)

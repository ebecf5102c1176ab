"""LeRobot's interface, without LeRobot: the calls that its evaluator makes (0.6.1, scripts/lerobot_eval.py), in their order.

``make lerobot`` runs tests/with_lerobot/ with the library itself.
"""

import importlib.util

import gymnasium as gym
import numpy as np
import pytest
from training_runs import ROOT

from clothgym.adapters.lerobot import make_env
from clothgym.envs import ClothEnv
from clothgym.registration import ENVIRONMENTS


def preprocessed(observations):
    """What ``envs.utils.preprocess_observation`` does to a batch, and asserts of it, with arrays in place of tensors."""
    found = {}
    if "pixels" in observations:
        _, height, width, channels = observations["pixels"].shape
        assert channels < height and channels < width and observations["pixels"].dtype == np.uint8
        found["observation.image"] = observations["pixels"].transpose(0, 3, 1, 2).astype(np.float32) / 255
    names = {"environment_state": "observation.environment_state", "agent_pos": "observation.state"}
    for key in observations.keys() - {"pixels"}:
        found[names.get(key, f"observation.{key}")] = observations[key].astype(np.float32)
    return found


def rollout(env, policy, seeds):
    """``lerobot_eval.rollout``: observations as the policy gets them, rewards, successes and ends, (n_envs, steps)."""
    observation, info = env.reset(seed=seeds, options={"lerobot_new_rollout": True})
    frames = [np.stack(env.call("render")[:2])]
    max_steps = env.call("_max_episode_steps")[0]
    env.get_attr("task_description"), env.get_attr("task")
    done, step, seen, taken = np.array([False] * env.num_envs), 0, [], []
    while not np.all(done) and step < max_steps:
        policy_input = preprocessed(observation)
        policy_input["task"] = list(env.call("task_description"))
        seen.append(policy_input)
        observation, reward, terminated, truncated, info = env.step(policy(policy_input))
        frames.append(np.stack(env.call("render")[:2]))
        if "final_info" in info:
            assert isinstance(info["final_info"], dict)
            successes = info["final_info"]["is_success"].tolist()
        else:
            successes = info["is_success"].tolist()
        done = terminated | truncated | done
        if step + 1 == max_steps:
            done = np.ones_like(done, dtype=bool)
        taken.append((reward, successes, done))
        step += 1
    assert env.unwrapped.metadata["render_fps"] == 15 and isinstance(env, gym.vector.VectorEnv)
    return seen, [np.array(one).T for one in zip(*taken)], frames


def test_its_evaluator_finds_the_successes_of_single_environments():
    env = make_env(n_envs=3, use_async_envs=True, env_id="ClothReach-v0", obs_mode="keypoints")
    seen, (rewards, successes, done), frames = rollout(env, lambda seen: env.env.expert_actions(), [40, 41, 42])
    assert done[:, :-1].sum() == 0 and done[:, -1].all() and frames[0].shape == (2, 240, 240, 3) and len(frames) == 41
    for k, seed in enumerate((40, 41, 42)):
        single = gym.make("ClothReach-v0").unwrapped
        observation, _ = single.reset(seed=seed)
        for step in range(40):
            assert np.array_equal(seen[step]["observation.environment_state"][k], observation)
            assert np.array_equal(seen[step]["observation.state"][k], single.task.simulation.attachment_positions[0, 0])
            observation, reward, *_, info = single.step(single.expert_action())
            assert rewards[k, step] == reward and successes[k, step] == info["is_success"]
    assert successes[:, -1].all() and seen[0]["task"] == [ENVIRONMENTS["ClothReach-v0"][1]] * 3


def test_a_hub_repository_makes_a_batch():
    """The file as EnvHub loads it; its pictures are those of the environment itself."""
    spec = importlib.util.spec_from_file_location("hub_env_env_py", ROOT / "docs" / "hub" / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    env = module.make_env(n_envs=2, use_async_envs=False)
    assert env.spec.id == "ClothFold-v0" and env.num_envs == 2
    observation, _ = env.reset(seed=[3, 4])
    assert env.observation_space.contains(observation) and set(observation) == {"pixels", "agent_pos"}
    single = gym.make("ClothFold-v0", obs_mode="rgb")
    assert np.array_equal(observation["pixels"][1], single.reset(seed=4)[0])
    # two positions [m], and the open fingers
    grippers = single.unwrapped.task.simulation.grippers
    assert np.array_equal(observation["agent_pos"][1], np.append(grippers.positions[0].ravel(), [1, 1]).astype(np.float32))


@pytest.mark.parametrize(
    ("env_id", "sizes"), [("ClothStrain-v0", (6, 78)), ("ClothFoldGoal-v0", (8, 115)), ("ClothFling-v0", (8, 84))]
)
def test_observations_lie_in_their_space(env_id, sizes):
    """Also while grippers are pushed against floor and walls, and with goals, which come last."""
    env = make_env(2, env_id=env_id, obs_mode="keypoints")
    observation, _ = env.reset(seed=[3, 4])
    assert tuple(box.shape[0] for box in env.single_observation_space.values()) == sizes
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert env.observation_space.contains(observation)
        observation, *_ = env.step(np.sign(rng.uniform(-1, 1, env.action_space.shape)).astype(np.float32))
    goal = env.env.task.observed.batch()["desired_goal"] if env_id == "ClothFoldGoal-v0" else None
    assert goal is None or np.array_equal(observation["environment_state"][:, -12:], goal)


def test_a_configuration_names_the_environment():
    class Configuration:
        task, obs_mode, env_kwargs = "ClothReach-v0", "depth", {"image_size": 24, "privileged": True}

    env = make_env(2, cfg=Configuration())
    shapes = {key: box.shape for key, box in env.single_observation_space.spaces.items()}
    assert shapes == {"agent_pos": (3,), "depth": (24, 24, 1), "environment_state": (58,)}
    assert env.reset(seed=[0, 1])[0]["depth"].shape == (2, 24, 24, 1)
    with pytest.raises(ValueError, match="ClothDrape-v0"):
        make_env(1, env_id="ClothDrap-v0")
    with pytest.raises(ValueError, match="n_envs=0"):
        make_env(0)


def test_each_task_has_its_sentence():
    for env_id in ("ClothFold-Hard-v0", "ClothReach-v0"):
        sentence = ENVIRONMENTS[env_id][1]
        assert gym.make(env_id).get_wrapper_attr("task_description") == sentence
        assert gym.make_vec(env_id, num_envs=1).unwrapped.call("task_description") == (sentence,)
    from hang_towel import HangTowel

    class Towel(HangTowel):
        """Lift a towel to a height.

        Which is drawn.
        """

    assert type("TowelEnv", (ClothEnv,), {"task_class": Towel})().task_description == "Lift a towel to a height."

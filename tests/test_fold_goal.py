"""ClothFoldGoal-v0: its goals, its reward and what hindsight makes of it, against distances that are computed here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.adapters.sb3 import make_sb3_vec_env

ID, SIDE, NEAR = "clothgym:ClothFoldGoal-v0", 0.6, 0.075
CORNERS = [0, 16, 272, 288]  # of 17 x 17 particles


def batch(count, seed=1_000_000, **kwargs):
    """A batch that has been reset, and what was observed."""
    env = gym.make_vec(ID, num_envs=count, autoreset_mode=kwargs.pop("autoreset_mode", "Disabled"), **kwargs)
    return env, env.reset(seed=seed)[0]


def far(achieved, desired):
    """The largest distance of a corner from its goal, in sides, (...)."""
    return np.linalg.norm((achieved - desired).reshape(*achieved.shape[:-1], 4, 3), axis=-1).max(axis=-1)


def test_goals_are_the_corners_of_folds_of_the_sheet_that_lies_there():
    env, seen = batch(40)
    x = env.get_state().simulation.positions.astype(float)[:, CORNERS]
    assert all(seen[name].shape == (40, 12) for name in ("achieved_goal", "desired_goal"))
    lay, goal = (seen[name].reshape(40, 4, 3) * SIDE for name in ("achieved_goal", "desired_goal"))
    # where the corners are, relative to their middle
    assert lay == pytest.approx(x - x.mean(axis=1, keepdims=True) * (1, 1, 0), abs=1e-3)
    moved = np.linalg.norm((goal - lay)[..., :2], axis=2)
    carried = moved > 1e-3
    assert np.all(carried.sum(axis=1) == 2) and len({tuple(one) for one in carried}) == 4
    for k in range(40):
        a, b = np.flatnonzero(carried[k])
        way = (goal - lay)[k, a, :2]
        # a fold over a crease mirrors: both go by the same way, across the edge and at least half of the sheet, and not out of it
        assert (goal - lay)[k, b, :2] == pytest.approx(way, abs=1e-5)
        assert way @ (lay[k, a] - lay[k, b])[:2] == pytest.approx(0, abs=1e-4)
        assert 0.5 - 1e-3 <= np.linalg.norm(way) / SIDE <= 1 + 1e-3 and way @ lay[k, a, :2] < 0
    assert goal[..., 2].max() < 0.02


def test_the_reward_is_that_of_the_largest_distance_for_one_goal_and_for_many():
    env = gym.make(ID).unwrapped
    rng = np.random.default_rng(0)
    desired = rng.normal(size=(500, 12)).astype(np.float32)
    way = rng.normal(size=(500, 4, 3))
    # one corner is farther than the others, by as much as is drawn
    way *= (rng.uniform(0, 2 * NEAR, (500, 1)) * np.array([1, 0.5, 0.2, 0]) / np.linalg.norm(way, axis=2))[..., None]
    achieved = (desired + way.reshape(500, 12)).astype(np.float32)
    expected = -(far(achieved, desired) > NEAR).astype(float)
    assert 0.3 < -expected.mean() < 0.7
    assert np.array_equal(env.compute_reward(achieved, desired, {}), expected)
    assert np.array_equal(env.compute_reward(achieved.reshape(5, 100, 12), desired.reshape(5, 100, 12), {}).ravel(), expected)
    assert [env.compute_reward(*one, {}) for one in zip(achieved[:20], desired[:20])] == expected[:20].tolist()


def test_the_expert_brings_the_corners_and_each_step_s_reward_is_compute_reward():
    env, _ = batch(8)
    over, returns, success = np.zeros(8, bool), np.zeros(8), 0
    while not over.all():
        seen, reward, over, _, info = env.step(env.expert_actions())
        away = far(seen["achieved_goal"].astype(float), seen["desired_goal"].astype(float))
        assert info["distance_max"] == pytest.approx(away, abs=1e-5)
        assert np.array_equal(reward, env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info))
        assert np.array_equal(reward, -(info["distance_max"] > NEAR).astype(float))
        returns, success = returns + reward, info["is_success"]
    assert success.sum() >= 7 and info["success_held"].sum() >= 7 and not info["failure"].any()
    assert np.all(returns[success] > -80) and np.all(returns >= -120)


def test_each_gripper_sees_its_ways_to_the_corners():
    env, _ = batch(4)
    for _ in range(10):
        seen, *_ = env.step(env.expert_actions())
    state = env.get_state().simulation
    x, tips = state.positions.astype(float)[:, CORNERS], state.attachment_positions.astype(float)
    ways = seen["observation"][:, env.observation_slices["ways"]].reshape(4, 2, 4, 3)
    # in tenths of a side
    assert ways == pytest.approx((x[:, None] - tips[:, :, None]) / (SIDE / 10), abs=1e-4)


def test_the_potential_is_grasps_and_how_far_corners_have_come_and_success_asks_for_rest():
    env = gym.make(ID).unwrapped
    seen, _ = env.reset(seed=1_000_003)
    task = env.task

    def mean(seen):
        return np.linalg.norm((seen["achieved_goal"] - seen["desired_goal"]).reshape(4, 3), axis=1).mean()

    def taken():
        """Mean over both grippers: 1 for a corner that is held, less the farther its gripper is."""
        simulation, scores = task.simulation, []
        for tip, corner in zip(simulation.grippers.positions[0], np.array(CORNERS)[task.episode["carried"][0]]):
            away = np.linalg.norm(simulation.positions[0, corner].astype(float) - tip)
            scores.append(1 if simulation.grippers.holder[0, corner] >= 0 else 0.5 / (1 + (away / (0.15 * SIDE)) ** 2))
        return np.mean(scores)

    began, held = mean(seen), 0
    for step in range(task.acting_steps + task.settling_steps - 1):
        seen, *_, info = env.step(env.expert_action())
        if step % 10 == 0:
            assert task.episode["potential"][0] == pytest.approx(0.3 * taken() + 0.7 * (1 - mean(seen) / began), abs=1e-5)
            held = max(held, taken())
    assert held == 1
    state = env.get_state()
    for speed in (0.0, 0.6):
        state.simulation.velocities[0] = (0, 0, speed)
        env.set_state(state)
        seen, _, terminated, _, info = env.step(np.zeros(8))
        # as near either way
        assert terminated and far(seen["achieved_goal"], seen["desired_goal"]) < NEAR
        assert info["is_success"] == (speed == 0)


def test_doing_nothing_scores_nothing():
    env, _ = batch(8)
    over, total = np.zeros(8, bool), np.zeros(8)
    while not over.all():
        _, reward, over, _, info = env.step(np.zeros(env.action_space.shape))
        total += reward
    assert not info["is_success"].any() and info["normalized_performance"].max() < 0.02 and np.all(total == -120)


def test_tearing_the_sheet_does_not_raise_the_return():
    """With both hands holding it and going apart; all steps that are left have missed the goal, under any goal."""
    env, _ = batch(4)
    over, total, length, failure = np.zeros(4, bool), np.zeros(4), np.zeros(4), np.zeros(4, int)
    while not over.all():
        actions = env.expert_actions()
        held = (env.task.simulation.grippers.holder[:, CORNERS] >= 0).sum(axis=1) == 2
        tips = env.task.simulation.grippers.positions
        apart = np.sign(tips - tips[:, ::-1])
        actions.reshape(4, 2, 4)[held] = np.concatenate([apart, -np.ones((4, 2, 1))], axis=2)[held]
        seen, reward, terminated, _, info = env.step(actions)
        asked = [env.compute_reward(seen[name], seen["desired_goal"], info) for name in ("achieved_goal", "desired_goal")]
        assert np.array_equal(reward[~over], asked[0][~over])
        failed = ~over & terminated
        length, failure = length + ~over, failure + info["failure"] * ~over
        # whatever goal hindsight puts there: of one step, of a list of steps, and of the batch
        assert np.array_equal(asked[1][failed], -(120 - length)[failed])
        infos = [{"reward/failure": value} for value in info["reward/failure"]]
        assert np.array_equal(env.compute_reward(seen["desired_goal"], seen["desired_goal"], infos)[failed], asked[1][failed])
        total, over = total + reward, over | terminated
    assert np.all(failure == 2) and length.max() < 40 and np.all(total == -120)


def test_the_single_environment_and_the_batch_s_last_observations_are_dictionaries():
    env, one = batch(2, seed=5, autoreset_mode="SameStep")[0], gym.make(ID)
    env.action_space.seed(5)
    seen = one.reset(seed=5)[0]
    assert seen in one.observation_space
    for _ in range(120):
        actions = env.action_space.sample()
        together, _, over, _, info = env.step(actions)
        seen, reward, ended, _, _ = one.step(actions[0])
        assert reward == one.unwrapped.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})
        last = info["final_obs"][0] if over[0] else {name: part[0] for name, part in together.items()}
        assert all(np.array_equal(last[name], seen[name]) for name in seen)
    assert ended and over.all()


def test_hindsight_relabels_by_compute_reward():
    """SB3's buffer and a learner: rewards of relabeled goals are those that are computed here."""
    from stable_baselines3 import DDPG, HerReplayBuffer

    env = make_sb3_vec_env("ClothFoldGoal-v0", 4, seed=0)
    model = DDPG(
        "MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=500, train_freq=8, batch_size=64, seed=0,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"}, buffer_size=4000,
        policy_kwargs={"net_arch": [32]}, device="cpu",
    )  # fmt: skip
    model.learn(560)
    sample = model.replay_buffer.sample(256)
    achieved, desired = (sample.next_observations[name].numpy() for name in ("achieved_goal", "desired_goal"))
    rewards = sample.rewards.numpy().ravel()
    assert np.array_equal(rewards, -(far(achieved.astype(float), desired.astype(float)) > NEAR).astype(float))
    # what was reached later in an episode is often reached already, and what was asked for never
    assert 0 < np.mean(rewards == 0) < 1 and model._n_updates > 0


def test_an_unknown_reward_mode_is_refused():
    with pytest.raises(ValueError, match="reward_mode='dense': must be 'goal' or 'delta' or 'sparse'"):
        gym.make(ID, reward_mode="dense")

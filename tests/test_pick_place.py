"""Macro actions: where each gripper picks, where it places, how high it lifts."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from clothgym.envs import pick_place

ID, FLAT = "clothgym:ClothDrapeGripper-v0", {"rumpled": False}


def batch(num_envs=2, **kwargs):
    return gym.make_vec(ID, num_envs=num_envs, action_mode="pick_place", autoreset_mode="Disabled", **kwargs)


def to_places(env, places, goals, lift=-0.5):
    """The action that takes these particles to these points of the floor, (num_envs, grippers, 2)."""
    half = env.task.workspace * env.task.physics.side
    x = env.task.simulation.positions.astype(float)
    action = np.full((env.num_envs, 2, 5), lift)
    action[..., :2], action[..., 2:4] = x[:, places, :2] / half, goals / half
    return action.reshape(env.num_envs, -1)


def test_corners_end_where_they_were_to_be_placed():
    env = batch()
    env.reset(seed=3, options=FLAT)
    places = env.task.places
    goals = env.task.simulation.positions[:, places, :2] + np.array([[0.0, -0.1], [0.05, -0.2]])[:, None]
    *_, terminated, _, info = env.step(to_places(env, places, goals))
    after, tips = env.task.simulation.positions[:, places], env.task.simulation.grippers.positions
    assert np.abs(tips[..., :2] - goals).max() < 1e-3
    # the corner lies there, but for how it falls and springs back: it was 10 to 21 cm away
    assert np.abs(after[..., :2] - goals).max() < 0.08 and after[..., 2].max() < 0.05
    assert not terminated.any() and not env.task.simulation.grippers.held.any()
    assert env.task.episode["step"].tolist() == [pick_place.STEPS] * 2


def test_the_way_is_cut_by_its_length_and_goes_through_pick_and_place():
    tips = np.array([[[0.0, 0.0, 0.3]], [[0.6, 0.0, 0.3]]])
    actions = np.array([[[0.5, 0.0, -0.5, 0.0, 1.0]], [[0.5, 0.0, 0.6, 0.0, -1.0]]])
    cloth = np.array([[[0.3, 0.01, 0.1]], [[5.0, 5.0, 5.0]]])
    lift = (actions[..., 4] + 1) * 0.3
    path = pick_place.path_of(*pick_place.places_of(actions, cloth, half=0.6), tips, lift)
    # the first picks the top of the cloth that lies within 3 cm, the second the floor
    assert np.allclose(path.pick[:, 0], [[0.3, 0.0, 0.1], [0.3, 0.0, pick_place.LOWEST]])
    wanted = np.array([pick_place.wanted_at(path, k, side=0.6)[0][:, 0] for k in range(pick_place.STEPS)])
    opened = np.array([pick_place.wanted_at(path, k, side=0.6)[1][:, 0] for k in range(pick_place.STEPS)])
    for env in range(2):
        closed = np.flatnonzero(~opened[:, env])
        assert np.allclose(wanted[closed[0], env], path.pick[env, 0])
        assert np.allclose(wanted[closed[-1], env, :2], path.place[env, 0, :2])
        # nothing moves while the fingers close, nor faster than the grippers can
        assert np.allclose(np.diff(wanted[closed[0] - 1 : closed[0] + pick_place.FINGERS, env], axis=0), 0, atol=1e-12)
        assert np.linalg.norm(np.diff(wanted[:, env], axis=0), axis=1).max() * 30 < 2.0
    # a full lift is one side above the middle of both heights; the way back at the end is RETREAT sides above the place
    assert wanted[:, 0, 2].max() == pytest.approx((0.1 + pick_place.LOWEST) / 2 + 0.6, abs=5e-3)
    assert wanted[-1, 1, 2] == pytest.approx(pick_place.LOWEST + pick_place.RETREAT * 0.6)
    assert path.approach[0] < path.approach[1]


def test_rewards_add_up_and_the_sheet_settles_in_further_steps():
    env = batch()
    env.reset(seed=8, options=FLAT)
    before, rng, progress = env.task.episode["potential"].copy(), np.random.default_rng(0), np.zeros(2)
    for _ in range(env.task.picks + 1):
        assert not env.task.episode["over"].any()
        _, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, (2, 10)))
        terms = sum(info[key] for key in info if key.startswith("reward/"))
        assert reward == pytest.approx(terms, abs=1e-12) and not truncated.any()
        progress += info["reward/progress"]
    # 4 x 60 control steps of acting, and 60 of settling
    assert terminated.all() and env.task.episode["step"].tolist() == [300, 300]
    assert progress == pytest.approx(info["normalized_performance"] - before)
    kept = env.step(rng.uniform(-1, 1, (2, 10)))[1]
    assert kept.tolist() == [0, 0]


def test_an_environment_is_the_same_alone_and_in_a_batch():
    several, rng = batch(3), np.random.default_rng(1)
    one = gym.make(ID, action_mode="pick_place").unwrapped
    several.reset(seed=5)
    one.reset(seed=7)
    for _ in range(2):
        actions = rng.uniform(-1, 1, (3, 10)).astype(np.float32)
        seen, *_ = several.step(actions)
        assert np.array_equal(one.step(actions[2])[0], seen[2])


def test_a_bad_action_is_refused_before_anything_moves():
    env = gym.make(ID, action_mode="pick_place").unwrapped
    env.reset(seed=0)
    before = env.task.simulation.positions
    with pytest.raises(ValueError, match=r"action\[3\] of environment 0 is nan"):
        env.step(np.array([0, 0, 0, np.nan, 0, 0, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="action"):
        env.step(np.zeros(8))
    assert np.array_equal(env.task.simulation.positions, before) and env.task.episode["step"] == 0
    with pytest.raises(ValueError, match=r"action_mode='throw': must be 'velocity' or 'pick_place'"):
        gym.make(ID, action_mode="throw")


def test_it_is_an_environment_that_gymnasium_accepts_and_truncates_by_actions():
    check_env(gym.make(ID, action_mode="pick_place").unwrapped, skip_render_check=True)
    env = batch(max_episode_steps=2)
    env.reset(seed=0)
    ends = [env.step(np.zeros((2, 10)))[3].tolist() for _ in range(2)]
    assert ends == [[False, False], [True, True]]


def test_a_task_without_an_expert_that_picks_raises():
    env = gym.make(ID, action_mode="pick_place").unwrapped
    env.reset(seed=0)
    with pytest.raises(NotImplementedError, match="no scripted expert for action_mode='pick_place'"):
        env.expert_action()

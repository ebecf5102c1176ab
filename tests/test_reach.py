"""The reach: its reward, limits, observation and evaluation, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs.episode import OUT_OF_BOUNDS
from clothgym.envs.reach import HIGH, LOW, hanging

REACH = "clothgym:ClothReach-v0"
STEPS = 40
SIDE, DRIVEN, FREE, PINCH = 0.6, 72, 8, (72, 73, 63)  # of 9 x 9 particles, row by row
STEP, SPEED = 1 / 15, 0.5


def start(seed=3, options=None, **kwargs):
    env = gym.make(REACH, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed, options=options)
    return env, observation


def corner(env):
    """Free corner's distance to the goal and speed, in sides, from positions and velocities alone."""
    state = env.task.simulation.get_state()
    goal = env.task.episode["goal"][0]
    return (
        np.linalg.norm(state.positions[0, FREE].astype(float) - goal) / SIDE,
        np.linalg.norm(state.velocities[0, FREE].astype(float)) / SIDE,
    )


def potential(env, d0):
    """The potential of the manual page."""
    d, v = corner(env)
    return (max(0, 1 - d / d0) + 1 / (1 + (d / 0.15) ** 2) / (1 + (v / 0.2) ** 2)) / 2


def evaluated(env, distance, velocity=(0.0, 0.0, 0.0)):
    """The evaluation of an episode at whose end the free corner is this far from the goal, in sides, and moves like that [m/s].

    The sheet hangs at rest in a frame that moves with its attachment; without drag nothing tells it so.
    """
    env.reset(seed=3)
    task, velocity = env.task, np.asarray(velocity, float)
    task.simulation.set_parameters(air_drag=0)
    end = task.episode["goal"][0] + (0, distance * SIDE, 0) + hanging("true") - hanging("true")[FREE]
    task.simulation.reset(positions=end - velocity * STEP, velocities=velocity)
    task.episode["targets"][0, 0] = end[DRIVEN]
    task.episode["step"][0] = STEPS - 1
    *_, terminated, _, info = env.step(np.zeros(3))
    assert terminated and not info["failure"]
    return info


# --- reward ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["expert", "random"])
def test_return_is_performance_minus_initial_potential_with_penalties(policy):
    env, _ = start()
    rng = np.random.default_rng(0)
    d0, _ = corner(env)
    total, effort, before = 0.0, 0.0, potential(env, d0)
    assert env.task.episode["distance"][0] == pytest.approx(d0 * SIDE, rel=1e-6)
    for step in range(1, STEPS + 1):
        action = env.expert_action() if policy == "expert" else rng.uniform(-1, 1, 3)
        effort += 0.001 * np.sum(np.clip(action, -1, 1).astype(float) ** 2)
        _, reward, terminated, _, info = env.step(action)
        total += reward
        assert terminated == (step == STEPS)
        if step == 10:
            assert total == pytest.approx(potential(env, d0) - before - effort, abs=1e-5)
    assert info["is_success"] == (policy == "expert")
    assert total == pytest.approx(info["normalized_performance"] - before - effort + 0.25 * info["is_success"], abs=1e-5)


def test_a_failure_costs_the_potential_and_a_half():
    env, _ = start()
    d0, _ = corner(env)
    for _ in range(12):
        env.step(env.expert_action())
    before = potential(env, d0)
    env.task.simulation.reset(positions=env.task.simulation.positions[0] + (3.0, 0, 0))
    env.task.simulation.release()
    _, reward, terminated, _, info = env.step(np.zeros(3))
    assert terminated and info["failure"] == OUT_OF_BOUNDS
    assert reward == pytest.approx(-before - 0.5, abs=1e-5) and before > 0.2


# --- evaluation ------------------------------------------------------------------------------------------------------------


def test_performance_is_the_share_of_the_way_and_of_calm():
    env, _ = start()
    d0, _ = corner(env)
    for step in range(STEPS):
        action = env.expert_action() if step < 36 else np.array([1.0, -1.0, 0.3])
        *_, info = env.step(action)
    d, v = corner(env)
    assert v > 0.1 and 0.02 < d < 0.5
    assert info["goal_distance"] == pytest.approx(d, rel=1e-5) and info["corner_speed"] == pytest.approx(v, rel=1e-5)
    assert info["normalized_performance"] == pytest.approx((1 - d / d0) / (1 + (v / 0.2) ** 2), rel=1e-5)


@pytest.mark.parametrize(("distance", "success"), [(0.0, True), (0.049, True), (0.051, False), (0.3, False)])
def test_a_corner_at_rest_succeeds_within_a_twentieth_of_a_side(distance, success):
    env, _ = start()
    info = evaluated(env, distance)
    assert info["goal_distance"] == pytest.approx(distance, abs=5e-4) and info["corner_speed"] < 0.02
    assert info["is_success"] == success


@pytest.mark.parametrize(("speed", "success"), [(0.09, True), (0.11, False), (0.5, False), (1.5, False)])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -0.6, 0.8)])
def test_a_corner_that_passes_through_the_goal_is_no_success(direction, speed, success):
    """In the goal at the moment of the evaluation, but on its way through; speeds in sides a second."""
    env, _ = start(air_density=0.0)
    info = evaluated(env, 0.0, np.array(direction) * speed * SIDE)
    assert info["goal_distance"] < 5e-3 and info["corner_speed"] == pytest.approx(speed, abs=5e-3)
    assert info["is_success"] == success
    assert info["normalized_performance"] == pytest.approx(1 / (1 + (speed / 0.2) ** 2), rel=0.05)


# --- limits, observation, start, options ----------------------------------------------------------------------------------


def test_the_corner_moves_no_faster_than_the_limit_in_any_direction_and_stays_in_its_room():
    env, _ = start()
    for action in ([1, 1, 1], [-1, 0, 0], [0.3, 0, -0.4]):
        before = env.task.simulation.positions[0, DRIVEN]
        env.step(np.array(action, float))
        moved = env.task.simulation.positions[0, DRIVEN] - before
        length = np.linalg.norm(action)
        assert moved == pytest.approx(np.array(action) / max(1, length) * SPEED * STEP, abs=1e-5)
    env.reset(seed=0)
    for _ in range(39):
        env.step(np.array([1.0, 0, 1.0]))
    assert env.task.simulation.positions[0, DRIVEN, [0, 2]] == pytest.approx([0.8, 1.7], abs=1e-4)


def test_observations_match_the_manual_page():
    env, _ = start(seed=8)
    for _ in range(5):
        observation, *_ = env.step(np.array([0.5, 1, 0.2]))
    assert observation.shape == (58,)
    state, goal = env.task.get_state().simulation, env.task.episode["goal"][0]
    points = [0, 4, 8, 36, 40, 44, 72, 76, 80]
    assert observation[:27] == pytest.approx(((state.positions[0, points] - goal) / SIDE).ravel(), abs=1e-5)
    assert observation[27:54] == pytest.approx(state.velocities[0, points].ravel(), abs=1e-5)
    place = goal - hanging("true")[FREE]  # of the driven corner, when the free one rests in the goal
    assert observation[54:57] == pytest.approx((place - state.positions[0, DRIVEN]) / SIDE * 10, abs=5e-4)
    assert observation[57] == pytest.approx(35 / 40)
    particles, first = start(seed=8, obs_mode="particles")
    assert first.shape == (6 * 81 + 4,)
    assert first[: 3 * 81] == pytest.approx(
        ((particles.task.simulation.positions[0] - particles.task.episode["goal"][0]) / SIDE).ravel(), abs=1e-5
    )


def test_the_sheet_hangs_at_rest_by_a_pinch_of_one_corner():
    """Its weight pulls straight down through the pinch, the free corner is lowest, and nothing moves but the ripple."""
    env, _ = start()
    s = env.task.simulation
    shape, area = hanging("true"), env.task.physics.mesh.area
    center, pinch = (area @ shape / area.sum())[:2], shape[list(PINCH), :2]
    assert np.all(center > pinch.min(axis=0) - 0.01) and np.all(center < pinch.max(axis=0) + 0.01)
    assert shape[FREE, 2] == shape[:, 2].min() < -0.9 * np.sqrt(2) * SIDE and shape[DRIVEN, 2] == shape[:, 2].max()
    x = s.positions[0]
    assert np.abs(x - x[DRIVEN] - shape).max() < 8e-3
    for _ in range(30):
        env.step(np.zeros(3))
    after = s.positions[0]
    assert np.abs(after - after[DRIVEN] - shape).max() < 0.03
    assert after[FREE] - after[DRIVEN] == pytest.approx(shape[FREE], abs=0.015)


def test_starts_and_goals_are_drawn_from_the_ranges_of_the_manual_page():
    env = gym.make_vec(REACH, num_envs=300)
    env.reset(seed=0)
    task = env.unwrapped.task
    middle = np.array([0.0, 0.0, 1.3])
    driven = task.simulation.attachment_positions[:, 0] - middle
    goals = task.episode["goal"] - hanging("true")[FREE] - middle
    for places in (driven, goals):
        assert np.all(np.abs(places) <= np.array([0.3, 0.3, 0.15]) + 5e-3)
        assert np.all(np.abs(places).max(axis=0) > np.array([0.29, 0.29, 0.145]))
        assert np.abs(places.mean(axis=0)).max() < 0.04
    assert np.abs(np.corrcoef(driven.T, goals.T)[:3, 3:]).max() < 0.2
    sheets = task.simulation.positions - task.simulation.positions[:, DRIVEN][:, None]
    ripple = (sheets - hanging("true")).std()
    assert 0.5e-4 < ripple < 2e-4


def test_a_goal_is_obeyed_for_one_episode():
    goal = hanging("true")[FREE] + (0.25, -0.4, 1.2)
    env, observation = start(options={"goal": tuple(goal)})
    assert env.task.episode["goal"][0] == pytest.approx(goal)
    assert observation[6:9] == pytest.approx((env.task.simulation.positions[0, 8] - goal) / SIDE, abs=1e-5)
    for _ in range(STEPS):
        *_, info = env.step(env.expert_action())
    assert info["is_success"]
    assert np.linalg.norm(env.task.simulation.positions[0, FREE] - goal) < 0.05 * SIDE
    env.reset(seed=3)
    assert not np.allclose(env.task.episode["goal"][0], goal, atol=1e-3)


@pytest.mark.parametrize(
    ("goal", "name"),
    [
        ((0.0, 0.0), "goal"),
        ((0.0, 0.0, np.nan), "goal"),
        ("there", "goal"),
        ((0.0, 0.0, 1.3), "the free corner can rest from"),
        (lambda hangs: hangs + HIGH + (0.01, 0, 0), "the free corner can rest from"),
        (lambda hangs: hangs + LOW - (0, 0, 0.01), "the free corner can rest from"),
    ],
)
def test_bad_goals_are_named(goal, name):
    env, _ = start()
    before = env.get_state()
    goal = goal(hanging("true")[FREE]) if callable(goal) else goal
    with pytest.raises(ValueError, match=name):
        env.reset(seed=0, options={"goal": goal})
    assert np.array_equal(before.simulation.positions, env.get_state().simulation.positions)


# --- who succeeds ---------------------------------------------------------------------------------------------------------


def play(policy, num_envs=20, seed=100):
    """Evaluations of a policy, as arrays: the last info of each environment."""
    env = gym.make_vec(REACH, num_envs=num_envs, autoreset_mode="Disabled")
    env.reset(seed=seed)
    for _ in range(STEPS):
        *_, terminated, _, info = env.step(policy(env.unwrapped))
    assert terminated.all() and not any(info["failure"])
    return info


def test_the_expert_succeeds_from_every_start():
    info = play(lambda env: env.expert_actions())
    assert info["is_success"].all() and info["normalized_performance"].min() > 0.75
    assert info["normalized_performance"].mean() > 0.9


def test_no_action_scores_zero():
    """But for the centimeter by which the ripple moves the corner, perhaps towards the goal."""
    info = play(lambda env: np.zeros((20, 3)), seed=0)
    env = gym.make_vec(REACH, num_envs=20)
    env.reset(seed=0)
    assert np.all(info["normalized_performance"] * env.unwrapped.task.episode["distance"] < 0.015)
    assert np.median(info["normalized_performance"]) < 1e-3 and not info["is_success"].any()


def test_moving_away_from_the_goal_scores_zero():
    """The clip at 0 holds: far away is no worse than the start, and never negative."""

    def flee(env):
        way = env.task._way()
        return -np.sign(way)

    info = play(flee)
    assert not info["normalized_performance"].any() and not info["is_success"].any()
    assert info["goal_distance"].min() > 0.5


def test_random_actions_score_little():
    rng = np.random.default_rng(0)
    info = play(lambda env: rng.uniform(-1, 1, (60, 3)), num_envs=60)
    assert info["is_success"].mean() < 0.05 and info["normalized_performance"].mean() < 0.2

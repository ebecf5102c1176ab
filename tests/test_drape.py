"""The drape: its reward, limits, observation and evaluation, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import grid
from clothgym.envs.episode import TORN
from clothgym.envs.targets import Target

DRAPE = "clothgym:ClothDrape-v0"
SIDE = 0.6
SHEET = grid(17, 17, SIDE, SIDE)


# --- the reward, the limits and what is seen, against numbers made here --------------------------------------------------


def start(seed=3, **kwargs):
    env = gym.make(DRAPE, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed)
    return env, observation


def potential(env, reach=0.15):
    """The potential of the manual page, from positions and the target alone, in float64."""
    task, x = env.task, env.task.simulation.positions[0].astype(float)
    target = task.targets[0]
    points = target.upper_surface(32)
    points = points[np.arange(32) % len(points)]
    nearest = np.min(np.linalg.norm(points[:, None] - x[None], axis=2), axis=1)
    near = np.mean(1 / (1 + (nearest / (reach * SIDE)) ** 2))
    weights = SHEET.area / SHEET.area.sum()
    off = np.linalg.norm(weights @ x[:, :2] - target.center) / SIDE
    return (near + 1 / (1 + (off / 0.2) ** 2)) / 2


def test_return_is_performance_minus_initial_potential_with_penalties():
    env, _ = start()
    total, effort, before, terminated = 0.0, 0.0, potential(env), False
    for step in range(200):
        action = env.expert_action()
        acting = not env.task.episode["settling_since"][0] >= 0
        effort += 0.001 * np.sum(action.reshape(2, 4)[:, :3].astype(float) ** 2) * acting
        _, reward, terminated, _, info = env.step(action)
        total += reward
        if step == 10:
            assert total == pytest.approx(potential(env) - before - effort, abs=1e-5)
        if terminated:
            break
    assert info["is_success"] and info["normalized_performance"] > 0.8
    assert total == pytest.approx(info["normalized_performance"] - before - effort + 0.25, abs=1e-5)


def test_no_anchor_moves_faster_than_the_limit_in_any_direction():
    env, _ = start()
    anchors = list(env.task.physics.held)
    before = env.task.simulation.positions[0, anchors]
    env.step(np.array([1, 1, 1, -1, -1, 0.5, 0, -1.0]))
    moved = np.linalg.norm(env.task.simulation.positions[0, anchors] - before, axis=1)
    assert moved[0] == pytest.approx(1 / 30, rel=1e-3)
    assert moved[1] == pytest.approx(1 / 30, rel=1e-3)
    env.step(np.array([0.3, 0, 0, -1, 0, 0, 0, -1.0]))
    again = np.linalg.norm(env.task.simulation.positions[0, anchors] - before, axis=1)
    assert again[1] == pytest.approx(moved[1], rel=1e-3)


def outside(target, p):
    """Distance of points from a target [m], negative within it."""
    away = p[:, :2] - target.center
    if target.shape == "box":
        c, s = np.cos(target.yaw), np.sin(target.yaw)
        x, y = np.abs(away @ [[c, -s], [s, c]]).T
        beyond = np.stack([x - target.radius, y - target.radius, p[:, 2] - target.height], axis=1)
        return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    middle = target.height - target.radius
    up = p[:, 2] - (np.minimum(p[:, 2], middle) if target.shape == "post" else middle)
    return np.linalg.norm(np.column_stack([away, up]), axis=1) - target.radius


@pytest.mark.parametrize("shape", ["sphere", "box", "post"])
@pytest.mark.parametrize("physics", ["true", "fast"])
def test_solids_stop_hands(shape, physics):
    env, _ = start(physics=physics)
    env.reset(seed=4, options={"target": {"shape": shape, "center": (0.0, 0.0)}})
    task, nearest, lifted = env.task, [], False
    target = task.targets[0]
    for _ in range(58):
        # both corners are pulled to the middle of the solid, from above and from the side
        goal = np.array([(0.0, 0.02, target.height / 2), (0.02, 0.0, 0.7 * target.height)])
        way = goal - task.episode["targets"][0]
        action = np.concatenate([way / np.linalg.norm(way, axis=1)[:, None], [[-1], [-1]]], axis=1)
        if env.step(action.ravel().astype(np.float32))[2]:
            break
        nearest.append(outside(target, task.simulation.attachment_positions[0]).min())
        # where they are to go does not run ahead into the solid
        np.testing.assert_allclose(task.episode["targets"], task.simulation.attachment_positions, atol=0.01)
        # so they come away at once
        if task.simulation.blocked.all() and not lifted:
            x, lifted = task.simulation.attachment_positions[0], True
            env.step(np.float32([0, 0, 1, -1, 0, 0, 1, -1]))
            up = task.simulation.attachment_positions[0, :, 2] - x[:, 2]
            np.testing.assert_allclose(up, task.physics.attachment_speed * task.physics.time_step, rtol=1e-3)
    assert lifted
    assert -2e-5 < min(nearest) < 1e-3


@pytest.mark.parametrize(("grip", "held"), [(0.79, True), (0.81, False)])
def test_an_anchor_lets_go_above_four_fifths(grip, held):
    env, _ = start()
    env.step(np.array([0, 0, 0, grip, 0, 0, 0, -1.0]))
    assert env.task.simulation.attached[0].tolist() == [held, True]


def test_time_is_up_after_60_steps_and_the_evaluation_is_85_later():
    env, _ = start()
    for step in range(1, 146):
        *_, terminated, _, info = env.step(np.zeros(8))
        assert info["settling"] == (step >= 60) and terminated == (step == 145)


def test_a_sheet_that_still_moves_is_no_success():
    env = gym.make(DRAPE).unwrapped
    env.reset(seed=1, options={"target": {"shape": "box", "radius": 0.12, "center": (0.0, 0.0), "yaw": 0.0}})
    task = env.task
    task.simulation.reset(positions=SHEET.rest_positions + (0, 0, 0.246))
    task.simulation.release()
    task.episode["settling_since"][0], task.episode["step"][0] = 60, 144
    task.simulation.reset(positions=SHEET.rest_positions + (0, 0, 0.246), velocities=(0.3, 0, 0))
    task.simulation.release()
    *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated and info["coverage"] > 0.9 and info["off_center"] < 0.1
    assert info["rms_speed"] > 0.02 and not info["is_success"]
    still = 1 / (1 + (info["rms_speed"] / 0.1) ** 2)
    share = min(info["coverage"] / info["coverage_reference"], 1)
    flat = share * info["spread"]
    assert info["normalized_performance"] == pytest.approx(flat * still / (1 + (info["off_center"] / 0.2) ** 2), rel=1e-6)


def test_observations_match_the_manual_page():
    env, _ = start(seed=8)
    for _ in range(5):
        observation, *_ = env.step(np.array([0.5, 1, 0.2, -1, 0.3, 1, 0, -1.0]))
    task = env.task
    state, target = task.get_state().simulation, task.targets[0]
    top = np.array([*target.center, target.height])
    points = [0, 8, 16, 136, 144, 152, 272, 280, 288]
    assert observation[:27] == pytest.approx(((state.positions[0, points] - top) / SIDE).ravel(), abs=1e-5)
    assert observation[27:54] == pytest.approx(state.velocities[0, points].ravel(), abs=1e-5)
    center = (SHEET.area / SHEET.area.sum()) @ state.positions[0]
    assert observation[54:57] == pytest.approx((center - top) / SIDE, abs=1e-5)
    shapes = [float(target.shape == shape) for shape in ("sphere", "box", "post")]
    assert observation[57:].tolist() == pytest.approx(
        [1, 1, *shapes, target.radius / SIDE, target.height / SIDE, target.yaw * 4 / np.pi, 0, 140 / 145, 55 / 60], abs=1e-6
    )


def test_starts_are_drawn_from_the_ranges_of_the_manual_page():
    env = gym.make_vec(DRAPE, num_envs=200)
    env.reset(seed=0)
    task = env.unwrapped.task
    x = task.simulation.positions
    centers = np.array([target.center for target in task.targets])
    ahead = (centers[:, 1] - x[:, :, 1].mean(axis=1)) / SIDE
    assert 0.749 < ahead.min() < 0.77 and 0.88 < ahead.max() < 0.901
    assert np.abs((x[:, :, 0].mean(axis=1) - centers[:, 0]) / SIDE).max() < 0.101
    assert np.linalg.norm(centers, axis=1).max() <= 0.25 * SIDE
    assert 0.099 < x[:, :, 2].min() / SIDE < 0.11
    for shape, low, high in (("sphere", 0.2, 0.3), ("box", 0.15, 0.25), ("post", 0.1, 0.15)):
        radii = np.array([target.radius for target in task.targets if target.shape == shape]) / SIDE
        assert len(radii) > 40 and low <= radii.min() < 1.1 * low and 0.9 * high < radii.max() <= high
    heights = np.array([target.height for target in task.targets if target.shape == "post"]) / SIDE
    assert heights.min() >= 0.4 and heights.max() <= 0.6


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["noop", "random", "hover"])
def test_cheats_do_not_pay(policy):
    """Doing nothing, flailing, or holding the sheet over the target until time is up."""
    env = gym.make_vec(DRAPE, num_envs=40, autoreset_mode="Disabled")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    success, over = np.zeros(40, bool), np.zeros(40, bool)
    for _ in range(145):
        if policy == "hover":
            action = env.unwrapped.expert_actions()
            action[:, [3, 7]] = -1
            action[:, [2, 6]] = 0.3
        else:
            action = np.zeros((40, 8)) if policy == "noop" else rng.uniform(-1, 1, (40, 8))
        *_, terminated, _, info = env.step(action)
        success |= terminated & info["is_success"]
        over |= terminated
    assert over.all() and success.mean() < 0.05


@pytest.mark.slow
def test_the_expert_succeeds():
    env = gym.make_vec(DRAPE, num_envs=40, autoreset_mode="Disabled")
    env.reset(seed=500)
    success = np.zeros(40, bool)
    for _ in range(145):
        *_, terminated, _, info = env.step(env.unwrapped.expert_actions())
        success |= terminated & info["is_success"]
    assert success.mean() >= 0.9


# --- options and failures -------------------------------------------------------------------------------------------------


def test_a_target_is_obeyed_for_one_episode():
    env = gym.make(DRAPE).unwrapped
    env.reset(seed=0, options={"target": {"shape": "box", "radius": 0.1, "center": (0.05, 0.0), "yaw": 0.0}})
    assert env.task.targets[0] == Target("box", 0.1, 0.2, (0.05, 0.0), 0.0)
    env.reset(seed=0)
    assert env.task.targets[0] != Target("box", 0.1, 0.2, (0.05, 0.0), 0.0)


def test_pulling_the_corners_apart_tears():
    env = gym.make(DRAPE)
    env.reset(seed=0)
    for _ in range(60):
        *_, terminated, _, info = env.step(np.array([-1, 0, 0, -1, 1, 0, 0, -1]))
        if terminated:
            break
    assert info["failure"] == TORN and info["strain_max"] > 1 and not info["is_success"]

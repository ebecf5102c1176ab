"""Hanging over a rail: how a sheet hangs, the reward, the evaluation, hands and starts, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import grid
from clothgym.envs.hang import hang_of

HANG, HARD = "clothgym:ClothHang-v0", "clothgym:ClothHang-Hard-v0"
SIDE, RADIUS, REST = 0.6, 0.03, 0.006
SHEET = grid(17, 17, SIDE, SIDE)
SHARE = SHEET.area / SHEET.area.sum()
RAIL, YAW = np.array([0.05, -0.1, 0.5]), 0.4
TURN = np.array([np.cos(YAW), np.sin(YAW)])
LYING = 0.03


def start(env_id=HANG, seed=3, options=None, **kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed, options=options)
    return env, observation


def draped(mesh, offset=0.0, turned=0.0, along=0.0, rail=RAIL, turn=TURN):
    """A flat sheet laid over the rail and hanging straight down, its middle line ``offset`` beyond the rail, turned on it [m]."""
    p, q = mesh.rest_positions[:, :2].T
    u, s = np.cos(turned) * p - np.sin(turned) * q + along, np.sin(turned) * p + np.cos(turned) * q + offset
    r = RADIUS + REST
    arc = np.clip(s / r, -np.pi / 2, np.pi / 2)
    v, z = r * np.sin(arc), r * np.cos(arc) - np.maximum(np.abs(s) - r * np.pi / 2, 0)
    return np.stack([rail[0] + turn[0] * u - turn[1] * v, rail[1] + turn[1] * u + turn[0] * v, rail[2] + z], axis=1)


def hang(mesh, x):
    """What the kernel says of it: the shares beyond the rail and on the floor, and the length that the rail carries."""
    rest, triangles, out = np.ascontiguousarray(mesh.rest_positions[:, :2]), mesh.triangles.astype(np.int64), np.empty(3)
    areas = np.full(len(triangles), 1 / len(triangles))
    carried_within = RADIUS + REST + 0.05 * SIDE
    x = np.ascontiguousarray(x.T, np.float32)
    hang_of(x, triangles, rest, areas, SIDE, RAIL, TURN, 0.75 * SIDE, 0.0, carried_within, out)
    return out


def truth(offset, turned, along):
    """The same of the draped surface itself, from a million points of the flat sheet, and from its line over the rail."""
    line = (np.arange(1000) + 0.5) / 1000 * SIDE - SIDE / 2
    p, q = np.meshgrid(line, line)
    s = np.sin(turned) * p + np.cos(turned) * q + offset
    r = RADIUS + REST
    z = RAIL[2] + np.where(np.abs(s) < r * np.pi / 2, r * np.cos(s / r), r * np.pi / 2 - np.abs(s))
    # the line s = 0 of the flat sheet, in small steps, as far as it is in the square and between the posts
    way = np.linspace(-SIDE, SIDE, 100_001)
    p, q = np.cos(turned) * way - offset * np.sin(turned), -np.sin(turned) * way - offset * np.cos(turned)
    inside = (np.abs(p) <= SIDE / 2) & (np.abs(q) <= SIDE / 2) & (np.abs(way + along) <= 0.75 * SIDE)
    return [np.mean(s > 0), np.mean(z < LYING), min(inside.sum() * (way[1] - way[0]) / SIDE, 1)]


# --- how a sheet hangs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [13, 25, 49])
@pytest.mark.parametrize(
    ("offset", "turned", "along"),
    [(0, 0, 0), (0.1, 0, 0.1), (-0.22, 0.1, 0), (0.05, 0.6, 0), (0, np.pi / 4, 0), (0.17, 0.3, -0.1), (0, 0, 0.35), (0.25, 0.7, 0)],
)
def test_shares_and_length_are_those_of_the_surface_at_any_resolution(points, offset, turned, along):
    mesh = grid(points, points, SIDE, SIDE)
    assert hang(mesh, draped(mesh, offset, turned, along)) == pytest.approx(truth(offset, turned, along), abs=0.01)


@pytest.mark.parametrize("points", [13, 49])
def test_what_the_rail_does_not_carry_does_not_count(points):
    mesh = grid(points, points, SIDE, SIDE)
    flat = mesh.rest_positions + (*RAIL[:2], 0)
    for height in (0.002, RAIL[2] - 0.05, RAIL[2] + RADIUS + REST + 0.04):
        beyond, lying, carried = hang(mesh, flat + (0, 0, height))
        assert beyond == pytest.approx(0.5, abs=1e-6) and carried == 0 and lying == pytest.approx(float(height < LYING))
    # beside the posts, and wholly on one side
    assert hang(mesh, draped(mesh, along=1.0))[2] == 0
    assert hang(mesh, draped(mesh, offset=0.5))[0] == pytest.approx(1)


# --- reward and evaluation ----------------------------------------------------------------------------------------------------


def score(shares):
    beyond, lying, carried = shares
    return 2 * min(beyond, 1 - beyond) * carried * (1 - lying)


def potential(env):
    """That of the manual page."""
    task, x = env.task, env.task.simulation.positions[0].astype(float)
    (rail,), (turn,) = task.episode["rail"], task.episode["turn"]
    d = SHARE @ x - rail
    along = max(abs(turn @ d[:2]) - 0.25 * SIDE, 0)
    way = np.linalg.norm([along, turn[0] * d[1] - turn[1] * d[0], d[2] + SIDE / 4])
    return (score(task.episode["hang"][0]) + 1 / (1 + (way / (0.4 * SIDE)) ** 2)) / 2


def test_the_return_is_the_performance_and_success_lasts_five_seconds_after_letting_go():
    env, _ = start()
    total, effort, before, terminated, steps, held = 0.0, 0.0, potential(env), False, 0, []
    while not terminated:
        action, holds = env.expert_action(), env.task.simulation.attached[0].any()
        effort += 0.001 * np.sum(action.reshape(2, 4)[:, :3].astype(float) ** 2) * holds
        _, reward, terminated, _, info = env.step(action)
        total, steps = total + reward, steps + 1
        held.append(bool(env.task.simulation.attached[0].any()))
        if steps % 9 == 0 and not terminated:
            assert total == pytest.approx(potential(env) - before - effort, abs=2e-5)
        # held in the right place is not yet hanging
        assert info["first_success"] == -1 or not held[-1]
    x, v = env.task.simulation.positions[0].astype(float), env.task.simulation.velocities[0].astype(float)
    speed = np.sqrt(SHARE @ np.sum(v**2, axis=1))
    assert steps - held.index(False) - 1 == 150 and not any(held[held.index(False) :])
    assert info["is_success"] and info["success_held"] and 0 < info["first_success"] <= held.index(False) + 5
    assert info["rms_speed"] == pytest.approx(speed, rel=1e-3) and speed < 0.02 and info["support"] > 0.99 and info["lying"] == 0
    # both halves hang down, and nothing touches the floor
    (rail,), (turn,) = env.task.episode["rail"], env.task.episode["turn"]
    side = turn[0] * (x[:, 1] - rail[1]) - turn[1] * (x[:, 0] - rail[0])
    assert info["balance"] == pytest.approx(2 * min(SHARE[side > 0].sum(), SHARE[side <= 0].sum()), abs=0.1) and x[:, 2].min() > 0.1
    assert info["normalized_performance"] == pytest.approx(info["balance"] * info["support"] / (1 + (speed / 0.1) ** 2), abs=1e-5)
    assert info["best"] >= info["balance"] - 1e-6
    assert total == pytest.approx(info["normalized_performance"] - before - effort + 0.25, abs=2e-5)


@pytest.mark.parametrize(
    ("offset", "turned", "speed", "success"),
    [(0, 0, 0, True), (0.1, 0, 0, True), (0.14, 0, 0, False), (0, 0.5, 0, True), (0, 0, 0.1, False)],
)
def test_success_asks_for_three_tenths_on_either_side_at_rest(offset, turned, speed, success):
    """Sheets made here, at rest after five seconds, and pushed in the last step."""
    env, _ = start()
    env.step(np.tile([0, 0, 0, 1.0], 2))
    task, own = env.task, env.task.episode[0]
    task.simulation.reset(positions=draped(SHEET, offset, turned, rail=own["rail"], turn=own["turn"]))
    task.simulation.release()
    own["step"] = own["settling_since"] = 80
    for _ in range(149):
        env.step(np.zeros(8))
    state = env.get_state()
    state.simulation.velocities[0, :, :2] += speed * own["turn"]
    env.set_state(state)
    *_, terminated, _, info = env.step(np.zeros(8))
    share = truth(offset, turned, 0)[0]
    assert terminated and info["balance"] == pytest.approx(2 * min(share, 1 - share), abs=0.04)
    assert info["support"] > 0.95 and info["lying"] == 0 and info["is_success"] == success


def test_what_is_let_go_before_the_rail_or_held_there_until_the_end_scores_nothing():
    for action in (np.zeros(8), np.tile([0, 0, 0, 1.0], 2), np.tile([0, 0, 1.0, 0], 2)):
        env, terminated = start(seed=5)[0], False
        while not terminated:
            *_, terminated, _, info = env.step(action)
        assert info["normalized_performance"] == 0 and not info["is_success"] and info["best"] == 0 and info["first_success"] == -1


# --- hands, observation, starts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [HANG, HARD])
def test_the_rail_and_its_posts_stop_hands(env_id):
    """Straight at the rail, and at a post."""
    env, _ = start(env_id, options={"rail": {"yaw": 0.0, "center": (0.0, 0.0)}})
    task, side = env.task, env.task.physics.side
    (rail,), radius = task.episode["rail"], task.radius * env.task.physics.side
    goals, nearest = np.array([[0, 0.3, rail[2]], [0.75 * side, 0.3, 0.5 * rail[2]]]), np.inf
    for _ in range(70):
        hands = task.simulation.attachment_positions[0].astype(float)
        there = np.stack([goals[:, 0], np.where(abs(hands[:, 0] - goals[:, 0]) < 0.01, goals[:, 1], -0.2), goals[:, 2]], axis=1)
        env.step(np.concatenate([np.clip((there - hands) * 10, -1, 1), np.zeros((2, 1))], axis=1).ravel())
        hands = task.simulation.attachment_positions[0].astype(float)
        along = np.maximum(abs(hands[:, 0]) - 0.75 * side, 0)
        bar = np.linalg.norm([along, hands[:, 1], hands[:, 2] - rail[2]], axis=0)
        post = np.linalg.norm([abs(hands[:, 0]) - 0.75 * side, hands[:, 1], np.maximum(hands[:, 2] - rail[2], 0)], axis=0)
        nearest = min(nearest, bar.min(), post.min())
    assert radius - 2e-5 < nearest < radius + 0.02


@pytest.mark.parametrize("env_id", [HANG, HARD])
def test_the_observation_is_what_the_manual_page_says(env_id):
    env, _ = start(env_id, seed=8)
    for _ in range(5):
        observation, *_ = env.step(env.expert_action())
    task, seen = env.task, {name: observation[where] for name, where in env.observation_slices.items()}
    own, side, mesh = task.episode[0], task.physics.side, task.physics.mesh
    x = task.simulation.positions[0].astype(float)
    assert seen["center"] == pytest.approx(((mesh.area / mesh.area.sum()) @ x - own["rail"]) / side, abs=2e-5)
    assert seen["keypoints"][:3] == pytest.approx((x[0] - own["rail"]) / side, abs=2e-5)
    assert seen["rail_height"] == pytest.approx(own["rail"][2] / side) and seen["rail_turn"] == pytest.approx(own["turn"])
    steps = task.acting_steps
    assert [*seen["settling"], *seen["episode_left"], *seen["acting_left"]] == pytest.approx(
        [0, 1 - 5 / (steps + 150), 1 - 5 / steps]
    )
    assert seen["hang"] == pytest.approx(own["hang"]) and (seen["hang"][1] > 0.5) == (env_id == HARD)
    if env_id == HARD:
        tips, places = task.simulation.grippers.positions[0].astype(float), mesh.corners[2:]
        for k, row in enumerate(seen["grippers"].reshape(2, 8)):
            assert row[:3] == pytest.approx((tips[k] - own["rail"]) / side, abs=2e-5)
            assert row[3:6] == pytest.approx((x[places[k]] - tips[k]) * 10 / side, abs=2e-4) and row[6:].tolist() == [1, 0]
    else:
        assert seen["holds"].tolist() == [1, 1]


def test_starts_lie_before_the_rail_and_hands_hover_above_the_corners():
    env = gym.make_vec(HARD, num_envs=24, autoreset_mode="Disabled").unwrapped
    env.reset(seed=0)
    task, side = env.task, 0.8
    x, places = task.simulation.positions.astype(float), task.physics.mesh.corners[2:]
    across = task.in_frame(x)[..., 1]
    assert np.all(across.max(axis=1) < -0.13 * side) and np.all(x[..., 2].min(axis=1) > 0)
    flat = x[..., 2].max(axis=1) < 0.004
    assert 4 < flat.sum() < 20
    away = task.simulation.grippers.positions.astype(float) - x[:, places]
    assert np.all(abs(away[..., :2]) <= 0.1 * side + 1e-5) and np.all(
        (away[..., 2] >= 0.2 * side - 1e-5) & (away[..., 2] <= 0.35 * side)
    )
    assert np.all((0.75 * side <= task.episode["rail"][:, 2]) & (task.episode["rail"][:, 2] <= side))


@pytest.mark.parametrize(
    "options",
    [{"rail": {"height": 2.0}}, {"rail": {"yaw": 2.0}}, {"rail": {"center": (1, 1)}}, {"rail": {"radius": 0.1}}, {"rail": 3}],
)
def test_rails_that_there_cannot_be_are_refused(options):
    env, _ = start()
    with pytest.raises(ValueError, match="rail"):
        env.reset(options=options)

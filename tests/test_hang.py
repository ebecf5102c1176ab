"""Hanging over a rail: how a sheet hangs, success, and hands, against numbers worked out here."""

import numpy as np
import pytest
from test_hanging import HANG, HANG_HARD, settled, start

from clothgym import grid
from clothgym.envs.hang import hang_of

SIDE, RADIUS, REST = 0.6, 0.03, 0.006
SHEET = grid(17, 17, SIDE, SIDE)
RAIL, YAW = np.array([0.05, -0.1, 0.5]), 0.4
TURN = np.array([np.cos(YAW), np.sin(YAW)])
LYING = 0.03


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


@pytest.mark.parametrize("points", [13, 49])
@pytest.mark.parametrize(
    ("offset", "turned", "along"),
    [(0, 0, 0), (0.1, 0, 0.1), (-0.22, 0.1, 0), (0.05, 0.6, 0), (0, np.pi / 4, 0), (0.17, 0.3, -0.1), (0, 0, 0.35), (0.25, 0.7, 0)],
)
def test_shares_and_length_are_those_of_the_surface_at_any_resolution(points, offset, turned, along):
    mesh = grid(points, points, SIDE, SIDE)
    assert hang(mesh, draped(mesh, offset, turned, along)) == pytest.approx(truth(offset, turned, along), abs=0.01)


@pytest.mark.parametrize("points", [13, 49])
def test_cloth_that_the_rail_does_not_support_does_not_count(points):
    mesh = grid(points, points, SIDE, SIDE)
    flat = mesh.rest_positions + (*RAIL[:2], 0)
    for height in (0.002, RAIL[2] - 0.05, RAIL[2] + RADIUS + REST + 0.04):
        beyond, lying, carried = hang(mesh, flat + (0, 0, height))
        assert beyond == pytest.approx(0.5, abs=1e-6) and carried == 0 and lying == pytest.approx(float(height < LYING))
    # beside the posts, and wholly on one side
    assert hang(mesh, draped(mesh, along=1.0))[2] == 0
    assert hang(mesh, draped(mesh, offset=0.5))[0] == pytest.approx(1)


# --- reward and evaluation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("offset", "turned", "speed", "success"),
    [(0, 0, 0, True), (0.1, 0, 0, True), (0.14, 0, 0, False), (0, 0.5, 0, True), (0, 0, 0.1, False)],
)
def test_success_asks_for_three_tenths_on_either_side_at_rest(offset, turned, speed, success):
    """Sheets made here, at rest after five seconds, and pushed in the last step."""
    env, _ = start(HANG)
    own = env.task.episode[0]
    info = settled(env, draped(SHEET, offset, turned, rail=own["rail"], turn=own["turn"]), speed)
    share = truth(offset, turned, 0)[0]
    assert info["balance"] == pytest.approx(2 * min(share, 1 - share), abs=0.04)
    assert info["support"] > 0.95 and info["lying"] == 0 and info["is_success"] == success


# --- hands, observation, starts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [HANG, HANG_HARD])
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

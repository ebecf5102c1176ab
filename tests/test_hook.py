"""Hanging by a hole on a hook: the sheet, what is in its hole, success, and hands, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest
from test_hanging import HOOK, HOOK_HARD, ends_of, settled, start

from clothgym.envs.hook import sheet_with_hole, threads

SIDE = 0.6
SHEET = sheet_with_hole(17, SIDE, 4, 2, below=2)
REST = SHEET.mesh.rest_positions
LEFT, RIGHT, BOTTOM, TOP = -0.125 * SIDE, 0.125 * SIDE, 0.25 * SIDE, 0.375 * SIDE  # of the hole


def on_arm(env, below=0.0, along=0.5):
    """The flat sheet at right angles to the arm, which goes through the hole's middle, or so far above it [m]."""
    task = env.task
    own, side, cut = task.episode[0], task.physics.side, task.sheet_cut
    root, tip = ends_of(own, side)
    n = (tip - root) / np.linalg.norm(tip - root)
    across = np.array([*own["turn"], 0.0])
    rest = task.physics.mesh.rest_positions
    flat = rest - rest[cut.rim].mean(axis=0)
    return root + along * (tip - root) + flat[:, :1] * across + (flat[:, 1:2] - below) * np.cross(n, across)


# --- the sheet, and what is in its hole -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "width", "height", "below"), [(17, 4, 2, 2), (21, 2, 2, 2), (9, 2, 3, 1)])
def test_a_sheet_has_one_hole_of_the_size_and_place_that_were_asked_for(rows, width, height, below):
    cut, h = sheet_with_hole(rows, SIDE, width, height, below), SIDE / (rows - 1)
    mesh, x = cut.mesh, cut.mesh.rest_positions
    assert mesh.area.sum() == pytest.approx(SIDE**2 - width * height * h**2)
    assert x[cut.rim].min(axis=0)[:2] == pytest.approx([-width / 2 * h, SIDE / 2 - (below + height) * h])
    assert x[cut.rim].max(axis=0)[:2] == pytest.approx([width / 2 * h, SIDE / 2 - below * h])
    # a ring has as many edges as corners and triangles together, and its inner border is the rim, edge by edge
    edges, uses = np.unique(np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    assert len(x) - len(edges) + len(mesh.triangles) == 0
    border = {tuple(edge) for edge in edges[uses == 1].tolist()}
    around = {tuple(sorted(edge)) for edge in zip(cut.rim.tolist(), np.roll(cut.rim, -1).tolist())}
    assert len(around) == 2 * (width + height) and around < border and len(border - around) == 4 * (rows - 1)
    # the corners, and the particles that are observed
    far = SIDE / 2
    assert np.allclose(x[list(cut.corners), :2], [(-far, -far), (far, -far), (-far, far), (far, far)])
    assert len(set(cut.key.tolist())) == 12 and set(cut.key[8:].tolist()) < set(cut.rim.tolist())


def test_a_line_is_in_the_hole_of_a_flat_sheet_if_it_meets_the_rectangle():
    rng = np.random.default_rng(0)
    x, found = np.ascontiguousarray(REST.T, np.float32), 0
    for _ in range(2000):
        a, b = rng.uniform([-0.2, 0.05, -0.1], [0.2, 0.3, 0.1], (2, 3))
        meets = a[2] * b[2] < 0
        p = a + (b - a) * a[2] / (a[2] - b[2])
        inside = meets and LEFT < p[0] < RIGHT and BOTTOM < p[1] < TOP
        assert threads(x, SHEET.rim, a, b) == (0 if not inside else np.sign(b[2] - a[2]))
        found += inside
    assert found > 200


def test_how_often_a_long_line_is_in_a_crumpled_hole_is_how_often_the_rim_goes_around_it():
    """The winding number of the rim, seen along the line: the sum of the angles between its points."""
    rng, counts = np.random.default_rng(1), []
    for _ in range(500):
        x = (REST + rng.normal(scale=0.04, size=REST.shape)).T.astype(np.float32)
        middle, way = x[:, SHEET.rim].mean(axis=1) + rng.normal(scale=0.04, size=3), rng.normal(size=3)
        way /= np.linalg.norm(way)
        one = np.cross(way, [1, 0, 0])
        one /= np.linalg.norm(one)
        seen = (x[:, SHEET.rim].T - middle) @ np.stack([one, np.cross(way, one)], axis=1)
        angles = np.angle((z := seen[:, 0] + 1j * seen[:, 1])[np.arange(1, len(z) + 1) % len(z)] / z)
        counts.append(round(angles.sum() / (2 * np.pi)))
        assert threads(x, SHEET.rim, middle - way, middle + way) == counts[-1]
    assert {-1, 0, 1} <= set(counts)


# --- reward and evaluation ------------------------------------------------------------------------------------------------------


def winding(env):
    """How often the hole's rim goes around the arm, seen along it; and whether all of the rim lies between its root and its tip."""
    root, tip = ends_of(env.task.episode[0], env.task.physics.side)
    way = (tip - root) / np.linalg.norm(tip - root)
    rim = env.task.simulation.positions[0].astype(float)[env.task.sheet_cut.rim] - root
    one = np.cross(way, [0, 0, 1.0])
    one /= np.linalg.norm(one)
    z = rim @ one + 1j * (rim @ np.cross(way, one))
    return round(np.angle(np.roll(z, -1) / z).sum() / (2 * np.pi))


def test_a_sheet_put_on_the_arm_hangs_by_its_hole():
    for speed in (0.0, 0.1):
        env, _ = start(HOOK)
        info = settled(env, on_arm(env), speed)
        assert info["threaded"] and abs(winding(env)) == 1 and info["lying"] == 0
        # it has come to rest; a push at the end undoes that
        assert info["first_success"] > 0 and info["best"] == 1
    assert not info["is_success"]
    # and it is observed
    env.reset(seed=3)
    env.task.simulation.reset(positions=on_arm(env))
    assert env.step(np.zeros(8))[0][env.observation_slices["threaded"]] == 1


def test_a_sheet_over_the_arm_and_not_in_its_hole_scores_nothing():
    """It is held up, all of it off the floor, by the part below the hole."""
    env, _ = start(HOOK, options={"hook": {"yaw": 0.0}})
    root, tip = ends_of(env.task.episode[0], SIDE)
    # folded over the arm along its middle line, both halves hanging down
    p, q = REST[:, 0], REST[:, 1]
    r = 0.02 * SIDE + 0.012
    arc = np.clip(p / r, -np.pi / 2, np.pi / 2)
    u, w = r * np.sin(arc), r * np.cos(arc) - np.maximum(np.abs(p) - r * np.pi / 2, 0)
    along = 0.5 * (root + tip)
    x = np.stack([along[0] + u, along[1] - q - 0.2, along[2] + 0.08 + w], axis=1)
    task = env.task
    task.simulation.reset(positions=x)
    task.simulation.release()
    env.step(np.tile([0, 0, 0, 1.0], 2))
    assert task.episode["threaded"][0] == 0 and task.episode["lying"][0] == 0
    best, terminated = 0.0, False
    while not terminated:
        *_, terminated, _, info = env.step(np.zeros(8))
        best = max(best, info["best"])
    assert best == 0 and not info["is_success"] and info["normalized_performance"] == 0


def test_cloth_on_the_floor_lowers_the_score():
    """The share of a sheet in the arm that is lower than three centimeters, from points of its flat surface."""
    env, _ = start(HOOK)
    task = env.task
    x = on_arm(env)
    x[:, 2] += 0.03 - np.quantile(x[:, 2], 0.3)
    x[:, 2] = np.maximum(x[:, 2], 0.01)
    task.simulation.reset(positions=x)
    env.step(np.zeros(8))
    x = task.simulation.positions[0].astype(float)
    triangles, rng = task.physics.mesh.triangles, np.random.default_rng(0)
    area = np.linalg.norm(np.cross(*(REST[triangles[:, k]] - REST[triangles[:, 0]] for k in (1, 2))), axis=1)
    weights = rng.dirichlet((1, 1, 1), (len(triangles), 400))
    low = np.einsum("tnk,tk->tn", weights, x[triangles, 2]) < 0.03
    assert task.episode["lying"][0] == pytest.approx(area @ low.mean(axis=1) / area.sum(), abs=0.01)


@pytest.mark.parametrize(("lowest", "success"), [(0.022, True), (0.012, False)])
def test_success_asks_for_a_sheet_that_is_off_the_floor(lowest, success):
    """A sheet in the arm, at rest, whose lower edge is that high above the floor [m]: a strip lies lower than three centimeters.

    The arm rises by 30 degrees, so the flat sheet leans as much.  Both are put that low for the last step, without gravity.
    """
    env, _ = start(HOOK)
    task, own, x = env.task, env.task.episode[0], on_arm(env, along=0.8)
    env.step(np.tile([0, 0, 0, 1.0], 2))
    down = x[:, 2].min() - lowest
    own["root"][2] -= down
    task._place_colliders(np.array([0]))
    task.simulation.reset(positions=x - (0, 0, down))
    task.simulation.release()
    task.simulation.set_parameters(gravity=(0, 0, 0))
    own["settling_since"], own["step"] = task.acting_steps, task.acting_steps + 149
    *_, terminated, _, info = env.step(np.zeros(8))
    strip = (0.03 - lowest) / np.cos(np.pi / 6) * SIDE / task.physics.mesh.area.sum()
    assert terminated and info["threaded"] and info["rms_speed"] < 0.02
    assert info["lying"] == pytest.approx(strip, abs=2e-3)
    assert info["is_success"] == success


# --- hands, observation, starts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [HOOK, HOOK_HARD])
def test_arm_and_post_stop_hands(env_id):
    """One goes straight at the arm, the other at the post."""
    env, _ = start(env_id, options={"hook": {"yaw": 0.0, "center": (0.0, 0.0)}})
    task, side = env.task, env.task.physics.side
    root, tip = ends_of(task.episode[0], side)
    middle, nearest = (root + tip) / 2, np.full(2, np.inf)
    goals = np.stack([middle + [0, 0, 0.3], root - [0.3, 0, 0.2 * side]])
    for step in range(110):
        hands = task.simulation.attachment_positions[0].astype(float)
        aim = goals if step < 55 else np.stack([middle - [0, 0, 0.2], root + [0.3, 0, -0.2 * side]])
        env.step(np.concatenate([np.clip((aim - hands) * 10, -1, 1), np.zeros((2, 1))], axis=1).ravel())
        hands = task.simulation.attachment_positions[0].astype(float)
        share = np.clip((hands[0] - root) @ (tip - root) / (0.3 * side) ** 2, 0, 1)
        post = np.linalg.norm([*(hands[1] - root)[:2], max(hands[1, 2] - root[2] - 0.3 * side, 0)])
        nearest = np.minimum(nearest, [np.linalg.norm(hands[0] - root - share * (tip - root)), post])
    radii = side * np.array([0.02, 0.03])
    assert np.all((nearest > radii - 2e-5) & (nearest < radii + 0.02))


def test_rows_and_shear_stiffness_are_refused_for_a_triangle_mesh():
    with pytest.raises(ValueError, match="one mesh"):
        gym.make(HOOK, rows=25)
    with pytest.raises(ValueError, match="shear_stiffness has no effect"):
        gym.make(HOOK, randomize={"shear_stiffness": [10, 20]})

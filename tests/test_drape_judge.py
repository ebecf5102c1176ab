"""The judge of the drape: what is covered, in how many layers, and its reference, against numbers worked out here."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from clothgym import Material, grid
from clothgym._jit.cache import CacheFolder
from clothgym.envs import reference
from clothgym.envs.draping import PHYSICS
from clothgym.envs.measures import count_layers
from clothgym.envs.reference import layers_over, reference_coverage
from clothgym.envs.targets import Target

DRAPE = "clothgym:ClothDrape-v0"
SIDE = 0.6
SHEET = grid(17, 17, SIDE, SIDE)


BOX = Target("box", 0.12, 0.24, (0.0, 0.0))


def flat(height):
    """The sheet, flat at a height [m]."""
    return SHEET.rest_positions + (0, 0, height)


def folded(height):
    """The sheet doubled over along its middle, 4 mm apart, about the axis."""
    x = flat(height)
    over = x[:, 1] > 1e-9
    x[over] = x[over] * (1, -1, 1) + (0, 0, 0.004)
    return x + (0, SIDE / 4, 0)


def test_layers_against_the_equations_of_each_triangle():
    rng = np.random.default_rng(0)
    x = SHEET.rest_positions + rng.normal(scale=0.03, size=SHEET.rest_positions.shape)
    points, normals = rng.uniform(-0.2, 0.2, (200, 3)), rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    layers = np.zeros(200, np.int64)
    count_layers(x.T.copy(), SHEET.triangles.astype(np.int64), points, normals, np.array([0.01, 0.05, 0.1]), layers)
    a, b, c = (x[SHEET.triangles[:, m]] for m in range(3))
    expected = []
    for p, n in zip(points, normals):
        # a + s (b - a) + t (c - a) = p + h n
        ways = np.stack([b - a, c - a, np.broadcast_to(-n, a.shape)], axis=2)
        s, t, h = np.linalg.solve(ways, (p - a)[:, :, None])[:, :, 0].T
        h = h[(s >= 0) & (t >= 0) & (s + t <= 1)]
        covered = np.any((h >= -0.01) & (h <= 0.05)) and not np.any((h >= -0.05) & (h < -0.01))
        expected.append(np.sum((h >= -0.01) & (h <= 0.1)) * covered)
    assert layers.tolist() == expected and 20 < np.count_nonzero(layers) < 180 and layers.max() > 1


@pytest.mark.parametrize(
    ("sheet", "layers"),
    [
        (flat(0.242), 1),
        (flat(0.242) * (1, -1, 1), 1),  # the reverse side up
        (flat(0.24 - 0.0019), 1),
        (flat(0.24 - 0.003), 0),  # the box pokes through
        (flat(0.24 + 0.029), 1),
        (flat(0.24 + 0.031), 0),
        (folded(0.242), 2),
        (folded(0.24 - 0.003), 0),
    ],
)
def test_layers_of_flat_and_folded_sheets_over_a_box(sheet, layers):
    assert layers_over(BOX, sheet, SHEET.triangles, SIDE).tolist() == [layers] * 256


def test_a_line_through_edges_and_corners_of_triangles_meets_a_flat_sheet_once():
    """At all particles of the sheet within the margin, and at the middles of its edges and diagonals."""
    x, inner = flat(0.1), np.abs(SHEET.rest_positions[:, :2]).max(axis=1) < 0.29
    around = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (1, -1)]) * SIDE / (16 * 2)
    points = np.concatenate([x[inner] + (*way, -0.001) for way in around])
    for lean in (0.0, 0.5):
        normal = np.array([lean, lean, 1.0]) / np.sqrt(1 + 2 * lean**2)
        layers = np.zeros(len(points), np.int64)
        normals = np.tile(normal, (len(points), 1))
        count_layers(x.T.copy(), SHEET.triangles.astype(np.int64), points, normals, np.array([0.002, 0.03, 0.06]), layers)
        assert layers.tolist() == [1] * len(points)


def test_layers_over_a_sphere_and_outside_the_sheet():
    """Only what lies within the sheet's outline, and near enough along the normal, is covered."""
    sphere = Target("sphere", 0.15, 0.3, (0.1, 0.2))
    points = sphere.upper_surface(256) - (0.1, 0.2, 0.3)
    layers = layers_over(sphere, flat(0.3) + (0.1 + SIDE / 2, 0.2, 0), SHEET.triangles, SIDE)
    # along the normal (x, y, z + R) / R the plane z = 0 lies R z / (z + R) above a point, at x R / (z + R)
    across = 0.15 / (points[:, 2] + 0.15)
    expected = (points[:, 0] > 0) & (-points[:, 2] * across <= 0.03)
    assert np.array_equal(layers, expected) and 0.1 < expected.mean() < 0.4


def test_a_turned_target_has_turned_normals():
    turned = Target("sphere", 0.15, 0.3, (0.1, 0.2), 0.7)
    assert turned.upper_normals(50) == pytest.approx((turned.upper_surface(50) - (0.1, 0.2, 0.15)) / 0.15)


def test_upper_surface_lies_on_the_solid_and_is_spread_by_area():
    for target in (
        Target("sphere", 0.15, 0.3, (0.1, 0.2)),
        Target("post", 0.07, 0.3, (0.1, 0.2)),
        Target("box", 0.1, 0.2, (0.1, 0.2), 0.3),
    ):
        points = target.upper_surface(400)
        distance = np.linalg.norm(points - (0.1, 0.2, target.height - target.radius), axis=1)
        if target.shape == "box":
            assert np.all(points[:, 2] == 0.2) and np.abs(points - (0.1, 0.2, 0.2)).max() < 0.1 * np.sqrt(2)
        else:
            assert distance == pytest.approx(target.radius)
            slope = np.degrees(np.arccos((points[:, 2] - target.height + target.radius) / target.radius))
            assert slope.max() < 60
            # half of the cap's area lies above the mean of its bounding heights (Archimedes)
            assert np.mean(slope < np.degrees(np.arccos(0.75))) == pytest.approx(0.5, abs=0.01)


def test_reference_coverage_interpolates_the_table(monkeypatch):
    table = {
        "sphere": {"widths": [0.2, 0.3], "none": [0.0], "coverage": [[0.8], [0.9]]},
        "box": {"widths": [0.15, 0.25], "yaws": [0.0, 0.8], "coverage": [[0.5, 0.7], [0.6, 0.8]]},
        "post": {"widths": [0.1, 0.15], "heights": [0.4, 0.6], "coverage": [[0.5, 0.7], [0.6, 0.8]]},
    }
    monkeypatch.setattr("clothgym.envs.reference._table", lambda cloth: table)
    sphere, wide = (Target("sphere", w * SIDE, 2 * w * SIDE, (0, 0)) for w in (0.25, 0.4))
    box = Target("box", 0.15 * SIDE, 0.3 * SIDE, (0, 0), -0.4)
    post = Target("post", 0.125 * SIDE, 0.45 * SIDE, (0, 0))
    found = [reference_coverage(target, PHYSICS) for target in (sphere, wide, box, post)]
    assert found == pytest.approx([0.85, 0.9, 0.6, 0.6])


def test_reference_of_another_fabric_is_simulated_once_and_kept(monkeypatch, capsys, tmp_path):
    sphere, silk = Target("sphere", 0.15, 0.3, (0, 0)), replace(PHYSICS, material=Material.preset("silk", density=0.0831))
    simulated, table = [], {"sphere": {"widths": [0.2, 0.3], "none": [0.0], "coverage": [[0.8], [0.9]]}}
    monkeypatch.setattr(reference, "simulated", lambda cloth, rows, counts: simulated.append(cloth) or table)
    monkeypatch.setenv("CLOTHGYM_CACHE_DIR", str(tmp_path))
    folder = CacheFolder()
    monkeypatch.setattr(reference, "cache_folder", lambda: folder)
    for _ in range(2):
        reference._table.cache_clear()
        assert reference_coverage(sphere, silk) == pytest.approx(0.85)
    assert [cloth["density"] for cloth in simulated] == [0.0831] and capsys.readouterr().err.count("once") == 1
    reference_coverage(sphere, PHYSICS)
    assert len(simulated) == 1
    reference._table.cache_clear()


def test_flat_sheet_coverage_matches_its_simulation():
    """A coarse one, over a box and a post: it lies over all that slopes by at most 60 degrees, in one layer, at rest."""
    cloth = reference.cloth_of(PHYSICS)
    targets = [reference.target_of("box", 0.2, 0.4, SIDE), reference.target_of("post", 0.12, 0.5, SIDE)]
    sheets, triangles, speeds = reference.laid(targets, cloth, 13)
    for target, x in zip(targets, sheets):
        assert np.mean(layers_over(target, x, triangles, SIDE) == 1) > 0.97
    assert speeds[0] < 0.05


def laid(env, offset, sheet=flat):
    """Put the sheet on the target's top, ``offset`` sides beside it, held by nothing; let it settle and be evaluated."""
    env.reset(seed=1, options={"target": {"shape": "box", "radius": 0.12, "center": (0.0, 0.0), "yaw": 0.0}})
    task = env.unwrapped.task
    task.simulation.reset(positions=sheet(0.246) + (offset * SIDE, 0, 0))
    task.simulation.release()
    terminated = False
    while not terminated:
        *_, terminated, _, info = env.step(np.zeros(8))
    return info


def test_a_centered_sheet_succeeds_and_an_off_center_one_fails():
    env = gym.make(DRAPE)
    centered, aside = laid(env, 0.02), laid(env, 0.25)
    assert centered["is_success"] and centered["normalized_performance"] > 0.9
    # what hangs over has no width: the center of area comes nearer than it was laid
    assert 0.1 < aside["off_center"] < 0.25
    assert not aside["is_success"] and aside["normalized_performance"] < 0.8


def test_a_sheet_that_lies_doubled_over_is_no_success():
    info = laid(gym.make(DRAPE, contact="sheet", self_collision="strict"), 0.0, folded)
    assert info["coverage"] > 0.85 and info["off_center"] < 0.1 and info["rms_speed"] < 0.05
    assert info["spread"] < 0.1 and info["normalized_performance"] < 0.1 and not info["is_success"]

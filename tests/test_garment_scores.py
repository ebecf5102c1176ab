"""Scores of garments against closed forms; each criterion is met by an ideal fold, missed by the flat garment, and within reach."""

import numpy as np
import pytest

from clothgym import garments
from clothgym.envs.garment_scores import (
    coverage,
    flat_area,
    fold_over,
    funnels_distance,
    geodesic_distances,
    lehome_conditions,
    lehome_limits,
    overlap,
    softgym_coverage,
    vertex_distance,
)

SPACING, LAYER = 0.03, 0.003
FOLDED = 0.05  # vertex distance from which a garment counts as folded


@pytest.fixture(scope="module")
def shirt():
    return garments.tshirt(SPACING)


@pytest.fixture(scope="module")
def towel():
    return garments.towel(0.02, length=0.8, width=0.75)


def folded(garment):
    """The garment at rest after an ideal fold: sleeves inward, then the hem up; the legs up; or one half over the other."""
    x = garment.mesh.rest_positions
    at = {name: x[particle, :2] for name, particle in garment.key_points.items()}
    if garment.kind == "tshirt":
        for side, sign in (("left", -1), ("right", 1)):
            x = fold_over(x, 0.77 * at[f"shoulder_{side}"], (sign, 0), LAYER)
        return fold_over(x, (at["shoulder_left"] + at["waist_left"]) / 2, (0, -1), LAYER)
    if garment.kind == "trousers":
        return fold_over(x, (at["waist_left"] + at["pipe_outer_left"]) / 2, (0, -1), LAYER)
    return fold_over(x, (0, 0), (1, 0), LAYER)


def turned(x, angle=0.7, shift=(0.3, -0.2, 0)):
    """Turned about z, and shifted [m]."""
    c, s = np.cos(angle), np.sin(angle)
    return x @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + shift


def test_a_fold_mirrors_what_lies_beyond_the_line(towel):
    """A towel folded over x = 0.1: its right edge at 0.3 comes to -0.1, above; distances within each part are kept."""
    x = fold_over(towel.mesh.rest_positions, (0.1, 0), (2, 0), LAYER)
    right, left = towel.key_points["top_right"], towel.key_points["top_left"]
    assert x[right] == pytest.approx([-0.1, 0.4, LAYER]) and x[left] == pytest.approx([-0.3, 0.4, 0])
    assert x[:, 0].max() <= 0.1 + 1e-12


def test_vertex_distance_is_that_of_closed_forms(shirt):
    """0 however the garment is turned and shifted; a lifted one is that much away; a shrunk one a share of the mean radius."""
    x, area = shirt.mesh.rest_positions, flat_area(shirt)
    assert vertex_distance(turned(x), x, area) == pytest.approx(0, abs=1e-12)
    assert vertex_distance(turned(x) + [0, 0, 0.1], x, area) == pytest.approx(0.1 / np.sqrt(area))
    radius = np.linalg.norm((x - x.mean(axis=0))[:, :2], axis=1).mean()
    assert vertex_distance(x * [0.8, 0.8, 1], x, area) == pytest.approx(0.2 * radius / np.sqrt(area))


def test_areas_of_a_towel(towel):
    """Half the area when folded in half; shifted by a quarter of its width, 3/4 is shared and 5/4 covered."""
    x, triangles, area = towel.mesh.rest_positions, towel.mesh.triangles, flat_area(towel)
    assert area == pytest.approx(0.8 * 0.6, rel=0.01)
    half = fold_over(x, (0, 0), (1, 0), LAYER)
    assert coverage(half, triangles, area) == pytest.approx(0.5, abs=0.01)
    assert coverage(turned(x), triangles, area) == pytest.approx(1, abs=0.01)
    assert overlap(x + [0.15, 0, 0], x, triangles) == pytest.approx(3 / 5, abs=0.01)
    assert overlap(half, x, triangles) == pytest.approx(0.5, abs=0.01)
    # cells within 2 cm of a particle along both axes: the box around the particles, and so the same as the box
    assert softgym_coverage(half, x, 0.02) == pytest.approx(0.5, abs=1e-9)
    assert softgym_coverage(x, x) == 1


def test_cloth_funnels_distance_is_that_of_closed_forms(shirt):
    """A shift is pose alone, a shrunk garment shape and the same pose; a garment that lies mirrored is as good."""
    goal, area = shirt.mesh.rest_positions, flat_area(shirt)
    root = np.sqrt(area)
    assert funnels_distance(goal, goal, area) == pytest.approx((0, 0, 0), abs=1e-9)
    assert funnels_distance(goal * [-1, 1, 1], goal, area).weighted == pytest.approx(0, abs=1e-9)
    shifted = funnels_distance(goal + [0, 0.1, 0.3], goal, area)
    assert shifted == pytest.approx((0.35 * 0.1 / root, 0, 0.1 / root), abs=1e-9)
    radius = np.linalg.norm((goal - goal.mean(axis=0))[:, :2], axis=1).mean()
    shrunk = funnels_distance(goal * [0.8, 0.8, 1] + [0, 0.1, 0], goal, area)
    middle = 0.2 * goal[:, 1].mean()  # of the goal, which is not in the middle of its box
    assert shrunk.shape == pytest.approx(0.2 * radius / root, rel=1e-6)
    assert shrunk.pose == pytest.approx(abs(0.1 - middle) / root, rel=1e-6)


def by_singular_values(x, goal, inliers):
    """The source's way to superimpose, in space: Kabsch 1976."""
    one, two = x[inliers], goal[inliers]
    u, _, vt = np.linalg.svd((one - one.mean(axis=0)).T @ (two - two.mean(axis=0)))
    if np.linalg.det(vt.T @ u.T) < 0:
        vt[2] *= -1
    return (x - one.mean(axis=0)) @ (vt.T @ u.T).T + two.mean(axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_cloth_funnels_distance_is_that_of_rotations_of_space(shirt, seed):
    """Of crumpled shirts, half of which are turned over, against the source's way by singular values."""
    rng, goal = np.random.default_rng(seed), shirt.mesh.rest_positions * [1, 1, 0]
    x = turned(goal * [(-1) ** seed, 1, 0], 6 * rng.uniform(), (0.4, -0.2, 0)) * [1, 0.5, 0] + 0.1 * rng.normal(size=goal.shape)
    x, area = x * [1, 1, 0], flat_area(shirt)
    root = np.sqrt(area)
    shaped = by_singular_values(x, goal, np.ones(len(x), bool))
    for _ in range(5):
        shaped = by_singular_values(shaped, goal, np.linalg.norm(shaped - goal, axis=1) < 0.3 * root)
    posed = by_singular_values(goal, x, np.ones(len(x), bool))
    posed = by_singular_values(posed, x, np.linalg.norm(posed - x, axis=1) < 0.3 * root)
    shape, pose = (
        min(np.linalg.norm(own - way, axis=1).mean() for way in (goal, goal * [-1, 1, 1])) / root for own in (shaped, posed)
    )
    assert funnels_distance(x, goal, area) == pytest.approx((0.65 * shape + 0.35 * pose, shape, pose), rel=1e-9)


def test_cloth_funnels_leaves_outliers_out(shirt):
    """A sleeve far away does not turn the rest: the shape is the share of its particles times their distance."""
    goal, area = shirt.mesh.rest_positions, flat_area(shirt)
    x, sleeve = goal.copy(), goal[:, 0] > 0.3
    x[sleeve, 1] -= 0.5
    assert funnels_distance(turned(x), goal, area).shape == pytest.approx(sleeve.mean() * 0.5 / np.sqrt(area), rel=1e-6)


@pytest.mark.parametrize("kind", ["tshirt", "trousers", "shorts"])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_ideal_fold_meets_each_criterion_and_the_flat_garment_none(kind, seed):
    """No two key points of the fold are farther apart than along the cloth, nor is a lower limit of LeHome's conditions."""
    garment = garments.random_garment(kind, seed, SPACING)
    flat, ideal, area = garment.mesh.rest_positions, folded(garment), flat_area(garment)
    # ours, and the coverage of others
    assert vertex_distance(turned(ideal), ideal, area) < FOLDED < 0.15 < vertex_distance(flat, ideal, area)
    assert coverage(ideal, garment.mesh.triangles, area) < 0.65 < coverage(flat, garment.mesh.triangles, area)
    assert overlap(flat, ideal, garment.mesh.triangles) < 0.65
    assert funnels_distance(ideal, ideal, area).weighted < 1e-9 < 0.1 < funnels_distance(flat, ideal, area).weighted
    # LeHome's
    assert lehome_conditions(garment, turned(ideal)) == [True] * len(lehome_limits(garment))
    assert not all(lehome_conditions(garment, flat))
    # reach
    way = geodesic_distances(garment.mesh, garment.key_points)
    places = list(garment.key_points)
    particles = list(garment.key_points.values())
    apart = np.linalg.norm(ideal[particles][:, None] - ideal[particles], axis=2)
    assert np.all(apart <= way + 4 * LAYER)
    for first, second, at_most, limit in lehome_limits(garment):
        assert at_most or limit <= way[places.index(first), places.index(second)]


def test_geodesic_distances_are_those_along_edges(shirt, towel):
    """Across a towel of 0.6 by 0.8 m along its yarns and diagonals; between shoulders 50.2 cm apart hardly more than that."""
    ways = geodesic_distances(towel.mesh, towel.key_points)
    left, right, far = (list(towel.key_points).index(name) for name in ("bottom_left", "bottom_right", "top_right"))
    assert ways[left, right] == pytest.approx(0.6) and ways[left, far] == pytest.approx(0.6 * np.sqrt(2) + 0.2)
    shoulders = {name: shirt.key_points[name] for name in ("shoulder_left", "shoulder_right")}
    assert 0.975 * 0.515 <= geodesic_distances(shirt.mesh, shoulders)[0, 1] < 0.56


def test_wrong_shapes_are_refused(shirt):
    with pytest.raises(ValueError, match="x has shape"):
        vertex_distance(np.zeros((2, 5, 3)), shirt.mesh.rest_positions, 0.4)
    with pytest.raises(ValueError, match="no garment with conditions of LeHome 'skirt'"):
        lehome_limits(garments.skirt(SPACING))

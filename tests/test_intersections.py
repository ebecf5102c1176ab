"""The number of intersecting triangles, against pairs whose answer is known and against rational clipping."""

import numpy as np
import pytest
from exact_intersections import intersecting_pairs

from clothgym import disc, grid
from clothgym.geometry import exact_predicates
from clothgym.geometry.intersections import count_intersections, find_intersections, first_intersection

ONE_MORE, ONE_LESS = np.nextafter(1.0, 2.0), np.nextafter(1.0, 0.0)
FLOOR = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]  # the first triangle of the pairs below


def found(triangles, x):
    return {tuple(pair) for pair in find_intersections(triangles, x)[:, 1:].tolist()}


def turned(seed):
    """A rotation, (3, 3), as far as rounding allows."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        pytest.param([(1, 1, -1), (1, 1, 1), (3, 3, 1)], True, id="crosses"),
        pytest.param([(1, 1, 0), (1, 1, 1), (2, 1, 1)], True, id="stands on it"),
        pytest.param([(1, 1, 5e-324), (1, 1, 1), (2, 1, 1)], False, id="stands just above it"),
        pytest.param([(0, 0, 0), (-1, 0, 1), (-1, 0, -1)], True, id="touches a corner with a corner's place"),
        pytest.param([(2, 0, 1), (2, 0, -1), (2, -1, 0)], True, id="touches a side with a side"),
        pytest.param([(2, -5e-324, 1), (2, -5e-324, -1), (2, -1, 0)], False, id="just beside a side"),
        pytest.param([(1, 1, 0), (2, 1, 0), (1, 2, 0)], True, id="lies within it"),
        pytest.param([(-9, -9, 0), (29, -9, 0), (-9, 29, 0)], True, id="lies around it"),
        pytest.param([(-1, 1, 0), (5, 1, 0), (-1, 2, 0)], True, id="lies across it"),
        pytest.param([(4, 0, 0), (4, 4, 0), (0, 4, 0)], True, id="lies along a side"),
        pytest.param([(2, 2, 0), (5, 2, 0), (2, 5, 0)], True, id="lies with a corner on a side"),
        pytest.param([(2, np.nextafter(2.0, 3.0), 0), (5, 3, 0), (2, 5, 0)], False, id="lies just beside a side"),
        pytest.param([(1, 1, 1), (2, 1, 1), (1, 2, 1)], False, id="parallel"),
        pytest.param([(3, 3, -1), (3, 3, 1), (4, 4, 0)], False, id="boxes overlap, beside it"),
        pytest.param([(1, 1, -1), (1, 1, 1), (1, 1, 3)], True, id="a segment through it"),
        pytest.param([(3, 3, -1), (3, 3, 1), (3, 3, 3)], False, id="a segment beside it"),
        pytest.param([(1, 1, 0), (1, 1, 0), (1, 1, 0)], True, id="a point in it"),
        pytest.param([(-1, 0, 0), (1, 0, 0), (2, 0, 0)], True, id="a segment along a side"),
        pytest.param([(5, 0, 0), (6, 0, 0), (7, 0, 0)], False, id="a segment beyond a side"),
    ],
)
@pytest.mark.parametrize("turn", [0, 1, 2])
def test_two_triangles_without_a_common_vertex(other, expected, turn):
    x = np.roll([*FLOOR, *other], turn, axis=1)
    for triangles in ([(0, 1, 2), (3, 4, 5)], [(4, 5, 3), (2, 1, 0)]):
        assert count_intersections(triangles, x).tolist() == [expected]


@pytest.mark.parametrize(
    ("b1", "b2", "expected"),
    [
        pytest.param((-1, 0, 0), (0, -1, 0), False, id="opposite, in one plane"),
        pytest.param((-1, 0, 0), (-1, 1, 0), False, id="beside, in one plane"),
        pytest.param((-1, 0, 0), (0, 1, 0), True, id="side on side"),
        pytest.param((1, 1, 0), (-1, 1, 0), True, id="overlapping, in one plane"),
        pytest.param((1, 1, 0), (1, 2, 0), True, id="one within the other"),
        pytest.param((1, 1, 1), (1, 1, -1), True, id="cuts through"),
        pytest.param((1, 1, 1), (-1, -1, -1), True, id="common vertex within its own side"),
        pytest.param((1, 1, 0), (1, 1, 1), True, id="a side lies on it"),
        pytest.param((1, 1, 5e-324), (1, 1, 1), False, id="a side just above it"),
        pytest.param((-1, 0, 1), (-1, 0, -1), False, id="upright, beside"),
    ],
)
def test_two_triangles_with_one_common_vertex(b1, b2, expected):
    x = np.array([(0, 0, 0), (4, 0, 0), (0, 4, 0), b1, b2])
    assert count_intersections([(0, 1, 2), (3, 0, 4)], x).tolist() == [expected]
    assert count_intersections([(4, 3, 0), (1, 2, 0)], x).tolist() == [expected]


@pytest.mark.parametrize(
    ("d", "expected"), [((3, -1, 0), False), ((3, 1, 0), True), ((3, 1, 5e-324), False), ((3, 1e-9, 0), True), ((3, 0, 1), False)]
)
def test_two_triangles_with_a_common_edge(d, expected):
    x = np.array([(0, 0, 0), (4, 0, 0), (1, 2, 0), d])
    assert count_intersections([(0, 1, 2), (1, 0, 3)], x).tolist() == [expected]


def test_a_cell_folded_onto_its_neighbor():
    # 4 triangles with a mirrored diagonal: two lie on their images, and each touches along the diagonal the other's
    mesh = grid(2, 3, 2, 1)
    folded = mesh.rest_positions * (1, 1, 1)
    assert count_intersections(mesh.triangles, folded).tolist() == [0]
    folded[:, 0] = np.abs(folded[:, 0])
    assert count_intersections(mesh.triangles, folded).tolist() == [4]
    assert first_intersection(mesh.triangles, folded) == (0, 0, 2)


SOUPS = {
    "anywhere": lambda rng, n: rng.normal(size=(n, 3)),
    "on a lattice": lambda rng, n: rng.integers(0, 4, (n, 3)),
    "in a tilted plane": lambda rng, n: np.c_[rng.integers(0, 5, (n, 2)), np.zeros(n)] @ turned(n),
    "in the floor": lambda rng, n: np.c_[rng.normal(size=(n, 2)), np.full(n, 0.3)],
    "slivers in the floor": lambda rng, n: np.c_[rng.integers(0, 9, n) * (1 / 3), rng.integers(0, 9, n) / 3e7, np.zeros(n)],
    "slivers": lambda rng, n: rng.normal(size=(n, 3)) * (1, 1e-3, 1e-5) @ turned(n),
    "far away": lambda rng, n: 15.9 - rng.integers(0, 3, (n, 3)) * 0.05,
    "off a lattice by an ulp": lambda rng, n: np.nextafter(rng.integers(1, 4, (n, 3)), rng.integers(0, 2, (n, 3)) * 9.0),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("kind", SOUPS)
def test_soups_agree_with_rational_clipping(kind, dtype):
    total = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        particles = int(rng.integers(8, 18))
        x = SOUPS[kind](rng, particles).astype(dtype)
        triangles = np.array([rng.permutation(particles)[:3] for _ in range(18)])
        triangles = triangles[np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1]]
        a, b, c = (x[triangles[:, k]].astype(np.float64) for k in range(3))
        triangles = triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-8]
        expected = intersecting_pairs(triangles, x)
        total += len(expected)
        assert found(triangles, x) == expected
    assert total > 20


@pytest.mark.parametrize("seed", range(3))
def test_crumpled_sheets_agree_with_rational_clipping(seed):
    # folds of some cells, flattened: layers through each other, and on the floor in exactly one plane
    mesh = (grid(9, 9, 1.0, 1.0), disc(0.5, 5))[seed % 2]
    rng = np.random.default_rng(seed)
    u, v = mesh.rest_positions[:, 0] * 7, mesh.rest_positions[:, 1] * 5
    x = np.stack([np.sin(u) + 0.1 * v, np.sin(v + 0.3 * u), 0.3 * np.cos(u + v)], axis=1) * 0.1 + rng.normal(size=3)
    x[:, 2] = np.maximum(x[:, 2], np.median(x[:, 2]))
    x = x.astype(np.float32)
    expected = intersecting_pairs(mesh.triangles, x)
    assert len(expected) > 20
    assert found(mesh.triangles, x) == expected


@pytest.mark.parametrize("place", [(0, 0, 0), (0.1, 0.2, 0.3), (13, -15, 9)])
def test_smooth_sheets_are_cleared_without_exact_arithmetic(place, monkeypatch):
    def refuse(*args):
        raise AssertionError("a pair of a smooth sheet was not decided by floating point")

    monkeypatch.setattr(exact_predicates, "intersecting", refuse)
    for mesh in (grid(25, 25, 1, 1), disc(0.5, 12)):
        for turn in (np.eye(3), np.roll(np.eye(3), 1, axis=1), turned(0), turned(1)):
            x = (mesh.rest_positions @ turn + place).astype(np.float32)
            assert count_intersections(mesh.triangles, x).tolist() == [0]


def test_each_environment_is_counted_for_itself():
    mesh = grid(5, 5, 1, 1)
    folded = mesh.rest_positions.copy()
    folded[:, 0] = np.abs(folded[:, 0])
    batch = np.stack([folded, mesh.rest_positions, folded + 1.0])
    counts = count_intersections(mesh.triangles, batch)
    assert counts.tolist() == [len(intersecting_pairs(mesh.triangles, folded)), 0, counts[0]]
    assert first_intersection(mesh.triangles, batch[1:])[0] == 1
    assert first_intersection(mesh.triangles, batch[1]) is None


def test_no_pair_is_dropped_however_many_there_are():
    # every triangle contains the origin: all pairs intersect
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, 0.5, (60, 1)) + np.arange(3) * 2 * np.pi / 3
    corners = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=2) @ np.stack([turned(k) for k in range(60)])
    triangles = np.arange(180).reshape(60, 3)
    assert count_intersections(triangles, corners.reshape(-1, 3)).tolist() == [60 * 59 / 2]


@pytest.mark.parametrize("height", [ONE_LESS, 1.0, ONE_MORE])
def test_one_ulp_decides(height):
    # the tip of one triangle against the face of another that is tilted: heights of that face at the tip are exact
    x = np.array([(0, 0, 0), (4, 0, 2), (0, 4, 2), (1, 1, height), (1, 1, 2), (1, 0.5, 2)])
    assert count_intersections([(0, 1, 2), (3, 4, 5)], x).tolist() == [height <= 1.0]
    assert count_intersections([(0, 1, 2), (3, 4, 5)], -x).tolist() == [height <= 1.0]


@pytest.mark.parametrize(
    ("positions", "word"),
    [(np.zeros((2, 3)), "shape"), (np.zeros((1, 4, 2)), "shape"), (np.full((4, 3), np.nan), "not finite")],
)
def test_positions_that_make_no_sheet(positions, word):
    with pytest.raises(ValueError, match=word):
        count_intersections([(0, 1, 2), (1, 2, 3)], positions)

"""Closest points of triangles and edges, against points on a fine grid; without area or length, too."""

import numpy as np
import pytest

from clothgym.geometry.closest_points import closest_on_segments, closest_on_triangle

SHARES = np.linspace(0, 1, 41)


def shapes(kind, count=400):
    """Four points each: a point and a triangle, or two edges; corners on whole numbers meet, and lie in lines."""
    random = np.random.default_rng(0)
    points = random.normal(size=(count, 4, 3)) if kind == "any" else random.integers(-2, 3, (count, 4, 3)).astype(float)
    if kind == "without area":
        points[:, 3] = points[:, 1] + random.integers(0, 3, (count, 1)) * (points[:, 2] - points[:, 1])
    if kind == "without length":
        points[:, 1] = points[:, 2]
    return points


@pytest.mark.parametrize("kind", ["any", "whole numbers", "without area", "without length"])
def test_no_point_of_the_triangle_is_closer(kind):
    u, v = (grid.ravel() for grid in np.meshgrid(SHARES, SHARES))
    weights = np.stack([1 - u - v, u, v], axis=1)[u + v <= 1 + 1e-9]
    for p, a, b, c in shapes(kind):
        found = np.array(closest_on_triangle(*p, *a, *b, *c))
        assert found.min() >= -1e-12 and found.sum() == pytest.approx(1)
        sampled = np.linalg.norm(weights @ np.stack([a, b, c]) - p, axis=1).min()
        assert np.linalg.norm(found @ np.stack([a, b, c]) - p) <= sampled + 1e-9


@pytest.mark.parametrize("kind", ["any", "whole numbers", "without area", "without length"])
def test_no_points_of_the_edges_are_closer(kind):
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(SHARES, SHARES))
    for a, b, c, d in shapes(kind):
        one, other = closest_on_segments(*a, *b, *c, *d)
        assert 0 <= one <= 1 and 0 <= other <= 1
        sampled = np.linalg.norm(a + s * (b - a) - c - t * (d - c), axis=1).min()
        assert np.linalg.norm(a + one * (b - a) - c - other * (d - c)) <= sampled + 1e-9

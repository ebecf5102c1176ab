"""Which triangles of a sheet intersect, for tests: rational clipping of one triangle by the other, of all pairs whose boxes touch.

Shares no code and no method with ``clothgym.geometry.intersections``.
"""

from fractions import Fraction

import numpy as np


def intersecting_pairs(triangles, x):
    """Pairs that intersect beyond what they share, as a set of (first, second); x: one sheet, (particles, 3)."""
    x = np.asarray(x, np.float64)
    triangles = np.asarray(triangles)
    low, high = x[triangles].min(axis=1), x[triangles].max(axis=1)
    found = set()
    for i in range(len(triangles) - 1):
        near = np.all((low[i] <= high[i + 1 :]) & (low[i + 1 :] <= high[i]), axis=1)
        for j in np.flatnonzero(near & ~_beyond_a_plane(x[triangles[i]], x[triangles[i + 1 :]])) + i + 1:
            if clipped(triangles[i].tolist(), triangles[j].tolist(), x):
                found.add((i, int(j)))
    return found


def _beyond_a_plane(one, others):
    """Whether triangles, (n, 3, 3), lie on one side of the plane of another, (3, 3), by far more than any rounding."""
    normal = np.cross(one[1] - one[0], one[2] - one[0])
    height = (others - one[0]) @ normal
    far = 1e-9 * np.abs(normal).max() * (1e-300 + np.abs(others - one[0]).max(axis=(1, 2)))
    return np.all(height > far[:, None], axis=1) | np.all(height < -far[:, None], axis=1)


def clipped(first, second, x):
    """Whether something of triangle ``first`` is left within triangle ``second`` beyond what both share."""
    shared = sorted(set(first) & set(second))
    one, two = ([tuple(Fraction(float(c)) for c in x[p]) for p in t] for t in (first, second))
    normal = _cross(_minus(two[1], two[0]), _minus(two[2], two[0]))
    assert any(normal), "this checker knows no triangles without area"
    left = _clip(_clip(one, normal, two[0]), tuple(-c for c in normal), two[0])
    for n in range(3):
        left = _clip(left, _cross(normal, _minus(two[n], two[n - 1])), two[n])
    common = [tuple(Fraction(float(c)) for c in x[p]) for p in shared]
    if len(common) < 2:
        return any(point not in common for point in left)
    along = _minus(common[1], common[0])
    return any(any(_cross(_minus(point, common[0]), along)) for point in left)


def _clip(polygon, normal, origin):
    """What of a convex polygon lies on the side of a plane to which its normal points."""
    heights = [sum(n * (c - o) for n, c, o in zip(normal, point, origin)) for point in polygon]
    out = []
    for k in range(len(polygon)):
        (a, above), (b, below) = (polygon[k - 1], heights[k - 1]), (polygon[k], heights[k])
        if above * below < 0:
            share = above / (above - below)
            out.append(tuple(p + share * (q - p) for p, q in zip(a, b)))
        if below >= 0:
            out.append(b)
    return out


def _minus(a, b):
    return tuple(p - q for p, q in zip(a, b))


def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]

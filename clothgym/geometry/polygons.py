"""Polygons as triangles, by clipping ears (Meisters 1975, Polygons have ears).

A polygon is looked at along its mean normal (Newell's), so that corners need not lie in one plane.  No triangle lies outside of it,
each corner is a corner of some triangle, and none of these is without area, even where corners lie on a straight line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SLIMMEST = 1e-6  # twice a triangle's area over its longest side squared, below which it is no ear


def quads_as_triangles(x: NDArray, quads: NDArray) -> tuple[NDArray, NDArray]:
    """Triangles of faces of four corners, (quads, 2, 3), and for which of them they are right, (quads,).

    The diagonal from the first corner is taken unless only the other one lies within.  x: [m], (vertices, 3).  quads: (quads, 4).
    """
    p = x[quads]
    normal = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    longest = np.sum((p - np.roll(p, 1, axis=1)) ** 2, axis=2).max(axis=1)
    halves, fits = [], []
    for one in ((0, 1, 2, 0, 2, 3), (1, 2, 3, 1, 3, 0)):
        corners = p[:, one].reshape(-1, 2, 3, 3)
        twice = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        # both halves are on the side of the whole, and have an area
        along = np.einsum("qtc,qc->qt", twice, normal)
        fits.append(np.all(along > SLIMMEST * longest[:, None] * np.linalg.norm(normal, axis=1)[:, None], axis=1))
        halves.append(quads[:, one].reshape(-1, 2, 3))
    return np.where(fits[0][:, None, None], halves[0], halves[1]), fits[0] | fits[1]


def as_triangles(x: NDArray) -> list[tuple[int, int, int]] | None:
    """Triangles between the corners of one polygon, or None if it crosses itself or has no area; x: [m], (corners, 3)."""
    p = _in_its_plane(x)
    if p is None or crosses_itself(p):
        return None
    left, triangles = list(range(len(p))), []
    while len(left) > 3:
        ear = _best_ear(p[left])
        if ear is None:
            return None
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    a, b, c = left
    return [*triangles, (a, b, c)]


def without_area(x: NDArray) -> bool:
    """Whether all corners of a polygon lie on a straight line; x: [m], (corners, 3)."""
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= SLIMMEST * spread[0])


def _in_its_plane(x: NDArray) -> NDArray | None:
    """The corners seen along the mean normal, counter-clockwise, (corners, 2); None if there is no such normal."""
    away = x - x[0]
    normal = np.cross(away, np.roll(away, -1, axis=0)).sum(axis=0)
    size = np.linalg.norm(normal)
    if size <= SLIMMEST * np.sum(away**2, axis=1).max():
        return None
    normal /= size
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    return away @ np.stack([u, np.cross(normal, u)], axis=1)


def _cross(a: NDArray, b: NDArray) -> NDArray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def crosses_itself(p: NDArray) -> bool:
    """Whether two sides of a polygon cross between their ends; p: (corners, 2)."""
    ends = np.roll(p, -1, axis=0)
    for k in range(len(p) - 2):
        a, b, c, d = p[k], ends[k], p[k + 2 :], ends[k + 2 :]
        apart = _cross(b - a, c - a) * _cross(b - a, d - a) < 0
        if np.any(apart & (_cross(d - c, a - c) * _cross(d - c, b - c) < 0)):
            return True
    return False


def _best_ear(p: NDArray) -> int | None:
    """The corner at which the best shaped triangle can be cut off, None if there is none; p: (corners, 2), counter-clockwise."""
    before, after = np.roll(p, 1, axis=0), np.roll(p, -1, axis=0)
    twice = _cross(p - before, after - p)
    sides = np.stack([p - before, after - p, before - after])
    shape = twice / np.maximum(np.sum(sides**2, axis=2).max(axis=0), 1e-300)
    # the rest of the polygon must also have an area
    left = _cross(p - p[0], after - p[0]).sum() - twice
    fits = (shape > SLIMMEST) & (left > SLIMMEST * twice.max())
    for ear in np.argsort(-np.where(fits, shape, -np.inf), kind="stable").tolist():
        if not fits[ear]:
            return None
        # no other corner within or on its border; those at the place of one of its own may be there
        a, b, c = before[ear], p[ear], after[ear]
        least = -SLIMMEST * twice[ear]
        within = (_cross(b - a, p - a) >= least) & (_cross(c - b, p - b) >= least) & (_cross(a - c, p - c) >= least)
        own = np.all(p == a, axis=1) | np.all(p == b, axis=1) | np.all(p == c, axis=1)
        if not np.any(within & ~own):
            return ear
    return None

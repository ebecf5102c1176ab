"""Plane regions as well-shaped triangles of one spacing, with the borders kept.

Points of a hexagonal lattice fill the regions.  They move to the mean of their neighbors in the Delaunay triangulation, which is
renewed each time (Field 1988, Laplacian smoothing and Delaunay triangulations).  Points of borders stay where they are.

Generators that guarantee an angle insert points on borders, which panels that are sewn together share; Triangle is not free for
commercial use, and Gmsh is under the GPL.  Here a triangulation with a smaller angle than ``SMALLEST_ANGLE`` is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SMALLEST_ANGLE = 25.0  # of a triangle [degrees]
GOOD_ANGLE = 30.0  # from which no better triangulation is looked for [degrees]
CLEARANCES = (0.7, 0.6, 0.8, 0.5)  # distances of the lattice from borders that are tried, in spacings
OFFSETS = (0.0, 0.5)  # of its rows, in rows
ROUNDS = 12  # of smoothing
FLATTEST = 1e-6  # area of a triangle, over that of the largest, up to which it counts as none


def fill_regions(regions: Sequence[NDArray], spacing: float) -> tuple[NDArray, NDArray, NDArray]:
    """Triangles that fill plane regions without overlap.

    Args:
        regions: the border of each, as points about one spacing apart [m], (points, 2), counter-clockwise.  Two regions have the
            same points where they meet.
        spacing: of the triangulation [m].

    Returns:
        Points [m], (points, 2), of which those of the borders come first, without repetition; counter-clockwise triangles,
        (triangles, 3); and the region of each triangle, (triangles,).

    Raises:
        ValueError: a triangle has an angle of less than ``SMALLEST_ANGLE``, or a border is not in the triangulation.
    """
    fixed, index = np.unique(np.concatenate(regions), axis=0, return_inverse=True)
    rings = np.split(index.reshape(-1), np.cumsum([len(region) for region in regions])[:-1])
    borders = np.concatenate([np.stack([ring, np.roll(ring, -1)], axis=1) for ring in rings])
    best: tuple[float, tuple[NDArray, NDArray, NDArray]] | None = None
    for clearance in CLEARANCES:
        for offset in OFFSETS:
            found = _filled(fixed, borders, regions, spacing, clearance, offset)
            angle = smallest_angle(*found[:2])
            if _has_edges(found[1], borders) and (best is None or angle > best[0]):
                best = angle, found
            if best is not None and best[0] >= GOOD_ANGLE:
                return best[1]
    if best is None or best[0] < SMALLEST_ANGLE:
        problem = "a border would be lost" if best is None else f"the smallest angle would be {best[0]:.0f} degrees"
        raise ValueError(f"spacing={spacing:g} does not suit this outline ({problem}): give a smaller one, or blunter corners")
    return best[1]


def smallest_angle(points: NDArray, triangles: NDArray) -> float:
    """The smallest angle of triangles [degrees]; points: (points, 2) or (points, 3)."""
    corners = points[triangles]
    one, two = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cosine = np.sum(one * two, axis=2) / (np.linalg.norm(one, axis=2) * np.linalg.norm(two, axis=2))
    return float(np.degrees(np.arccos(np.clip(cosine.max(), -1, 1))))


def inside(points: NDArray, ring: NDArray) -> NDArray[np.bool_]:
    """Which points, (points, 2), lie within a closed polygon, (corners, 2): an odd number of its sides lies to their right."""
    (x, y), (ax, ay), (bx, by) = points.T[:, :, None], ring.T[:, None], np.roll(ring, -1, axis=0).T[:, None]
    between = (ay <= y) != (by <= y)
    rise = np.where(between, by - ay, 1.0)
    return np.sum(between & (x < ax + (y - ay) / rise * (bx - ax)), axis=1) % 2 == 1


def _filled(
    fixed: NDArray, borders: NDArray, regions: Sequence[NDArray], spacing: float, clearance: float, offset: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Points, triangles and their regions from one lattice, see ``fill_regions``; borders: edges of fixed points, (edges, 2)."""
    # the lattice, without what lies outside or near a border
    row = spacing * np.sqrt(3) / 2
    low, high = fixed.min(axis=0), fixed.max(axis=0)
    y, x = np.meshgrid(np.arange(low[1] + offset * row, high[1], row), np.arange(low[0], high[0] + spacing, spacing), indexing="ij")
    x = x + np.where(np.arange(len(x)) % 2, spacing / 2, 0.0)[:, None]
    lattice = np.stack([x.ravel(), y.ravel()], axis=1)
    within = np.any([inside(lattice, region) for region in regions], axis=0)
    lattice = lattice[within]
    lattice = lattice[_distances(lattice, fixed[borders]) >= clearance * spacing]
    points = np.concatenate([fixed, lattice])
    # to the middle of the neighbors
    for _ in range(ROUNDS):
        triangles, _ = _triangulated(points, regions)
        ends = triangles[:, [0, 1, 2, 1, 2, 0]].reshape(-1, 2, 3).transpose(0, 2, 1).reshape(-1, 2)
        count = np.bincount(ends[:, 0], minlength=len(points))
        for axis in range(2):
            total = np.bincount(ends[:, 0], weights=points[ends[:, 1], axis], minlength=len(points))
            points[len(fixed) :, axis] = (total / np.maximum(count, 1))[len(fixed) :]
    return points, *_triangulated(points, regions)


def _triangulated(points: NDArray, regions: Sequence[NDArray]) -> tuple[NDArray, NDArray]:
    """Delaunay's triangles within the regions, counter-clockwise, (triangles, 3), and the region of each, (triangles,)."""
    from scipy.spatial import Delaunay  # takes long to import

    triangles = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles[twice < 0] = triangles[twice < 0][:, ::-1]
    # rounding makes triangles without area of points on a straight border
    within = np.array([inside((a + b + c) / 3, region) for region in regions])
    kept = within.any(axis=0) & (np.abs(twice) > FLATTEST * np.abs(twice).max())
    return triangles[kept], within.argmax(axis=0)[kept]


def _distances(points: NDArray, segments: NDArray) -> NDArray:
    """Distance of each point, (points, 2), from the nearest segment, (segments, 2, 2) [m]."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    away = points[:, None] - start
    share = np.clip(np.sum(away * along, axis=2) / np.sum(along**2, axis=1), 0, 1)
    return np.linalg.norm(away - share[:, :, None] * along, axis=2).min(axis=1)


def _has_edges(triangles: NDArray, edges: NDArray) -> bool:
    """Whether all edges, (edges, 2), are sides of triangles."""
    size = triangles.max() + 1
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    own = np.sort(edges, axis=1)
    return bool(np.isin(own @ [size, 1], sides @ [size, 1]).all())

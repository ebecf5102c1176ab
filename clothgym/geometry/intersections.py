"""Intersecting triangles of a sheet, counted exactly: what self-collision must keep at zero, computed independently of it.

A pair of triangles counts

* if they share no vertex and have a point in common; touching counts;
* if they share one vertex and have another point in common;
* if they share an edge and are folded flat onto each other: in one plane, on the same side of the edge.

Each decision is the one that exact arithmetic on the given coordinates would make.  float64 decides nearly all of them: cells of a
grid find the pairs whose boxes overlap, projections on separating axes rule out pairs that are apart by more than the rounding
error, and signs of orientations larger than their error bound (Shewchuk 1997, Adaptive precision floating-point arithmetic, section
4.3) confirm crossings.  The rest is decided in integers, which floating-point coordinates are when scaled by a power of two.

A triangle without area counts as the segment or point that it is.  If the vertex that it shares with another lies within its
opposite side, the pair counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import kernel
from clothgym.checks import finite
from clothgym.geometry import exact_predicates
from clothgym.geometry.exact_predicates import UNSURE
from clothgym.geometry.filtered_predicates import TINY, decide

PAIRS = 256  # initial room for pairs; kernels return how many there are


def find_intersections(triangles: ArrayLike, positions: ArrayLike) -> NDArray[np.int64]:
    """All intersecting pairs: environment and two triangles, (pairs, 3), in this order.

    Args:
        triangles: of the mesh, (triangles, 3).
        positions: of its particles [m], (num_envs, particles, 3), or of one sheet, (particles, 3).

    Raises:
        ValueError: positions of another shape, or not finite.
    """
    x = finite("positions", positions)
    x = np.ascontiguousarray(x[None] if x.ndim == 2 else x)
    corners = np.ascontiguousarray(triangles, np.int64)
    if x.ndim != 3 or x.shape[2] != 3 or x.shape[1] <= corners.max(initial=-1):
        need = f"(num_envs, particles, 3) with at least {corners.max(initial=-1) + 1} particles"
        raise ValueError(f"positions have shape {np.shape(positions)}: must be {need}")
    # pairs that intersect or may; with more room if there was too little
    pairs = np.empty((PAIRS, 4), np.int64)
    found = find_pairs(x, corners, pairs)
    if found > len(pairs):
        pairs = np.empty((found, 4), np.int64)
        find_pairs(x, corners, pairs)
    # those that floating point cannot decide
    pairs = pairs[:found]
    intersecting = pairs[:, 3] == 1
    for row in np.flatnonzero(pairs[:, 3] == UNSURE):
        env, first, second = pairs[row, :3].tolist()
        intersecting[row] = exact_predicates.intersecting(corners[first].tolist(), corners[second].tolist(), x[env])
    pairs = pairs[intersecting, :3]
    return pairs[np.lexsort(pairs.T[::-1])]


def count_intersections(triangles: ArrayLike, positions: ArrayLike) -> NDArray[np.int64]:
    """Number of intersecting pairs of triangles, (num_envs,); arguments and errors as for ``find_intersections``."""
    sheets = len(positions) if np.ndim(positions) == 3 else 1  # type: ignore[arg-type]
    return np.bincount(find_intersections(triangles, positions)[:, 0], minlength=sheets)


def first_intersection(triangles: ArrayLike, positions: ArrayLike) -> tuple[int, int, int] | None:
    """Environment and two triangles of one intersection, or None; arguments and errors as for ``find_intersections``."""
    pairs = find_intersections(triangles, positions)
    return tuple(pairs[0].tolist()) if len(pairs) else None


@kernel
def find_pairs(x, triangles, pairs):
    """Find pairs of triangles that intersect or may: environment, both triangles, and 1 or UNSURE, ``pairs``, (room, 4).  Returns
    how many there are; only those for which there is room are written.

    x: [m], (num_envs, particles, 3).  A cell is as wide as the largest box, so boxes that overlap have their lower corners in the
    same cell or in adjacent ones.
    """
    count = triangles.shape[0]
    low, high = np.empty((count, 3)), np.empty((count, 3))
    cell, order = np.empty((count, 3), np.int64), np.empty(count, np.int64)
    origin, cells = np.empty(3), np.empty(3, np.int64)
    work = np.empty((12, 3))
    found = 0
    for env in range(x.shape[0] if count > 0 else 0):
        # bounding boxes, sorted into cells
        size = 0.0
        for t in range(count):
            i, j, k = triangles[t]
            for c in range(3):
                low[t, c] = min(x[env, i, c], x[env, j, c], x[env, k, c])
                high[t, c] = max(x[env, i, c], x[env, j, c], x[env, k, c])
                size = max(size, high[t, c] - low[t, c])
        starts = _sort_into_cells(low, size * (1 + 1e-6), origin, cells, cell, order)
        for t in range(count):
            # each pair of adjacent cells, and each pair within a cell, in one order only
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    for dz in range(-1, 2):
                        if dx < 0 or (dx == 0 and (dy < 0 or (dy == 0 and dz < 0))):
                            continue
                        i, j, k = cell[t, 0] + dx, cell[t, 1] + dy, cell[t, 2] + dz
                        if i >= cells[0] or j < 0 or j >= cells[1] or k < 0 or k >= cells[2]:
                            continue
                        place = (i * cells[1] + j) * cells[2] + k
                        within = dx == 0 and dy == 0 and dz == 0
                        for n in range(starts[place], starts[place + 1]):
                            other = order[n]
                            if within and other <= t:
                                continue
                            # boxes that overlap, then the triangles
                            overlap = low[t, 0] <= high[other, 0] and low[other, 0] <= high[t, 0]
                            overlap &= low[t, 1] <= high[other, 1] and low[other, 1] <= high[t, 1]
                            overlap &= low[t, 2] <= high[other, 2] and low[other, 2] <= high[t, 2]
                            if overlap:
                                first, second = min(t, other), max(t, other)
                                verdict = decide(x[env], triangles[first], triangles[second], work)
                                if verdict != 0:
                                    if found < pairs.shape[0]:
                                        pairs[found, 0], pairs[found, 1], pairs[found, 2] = env, first, second
                                        pairs[found, 3] = verdict
                                    found += 1
    return found


@kernel
def _sort_into_cells(low, size, origin, cells, cell, order):
    """Sort boxes into cells at least ``size`` wide by their lower corners ``low``, (boxes, 3).  Returns where each cell begins in
    ``order``.

    origin, cells: become the grid's corner and its cells along each axis, (3,).  cell: becomes the cell of each box, (boxes, 3).
    order: becomes the boxes, cell by cell, (boxes,).
    """
    count = low.shape[0]
    # the grid: cells wide enough that there are not many more than boxes
    extent = np.empty(3)
    for c in range(3):
        origin[c] = low[:, c].min()
        extent[c] = low[:, c].max() - origin[c]
    size = max(size, 1e-12 * max(extent[0], extent[1], extent[2]), TINY)
    while (extent[0] / size + 1) * (extent[1] / size + 1) * (extent[2] / size + 1) > 4 * count + 64:
        size *= 1.3
    for c in range(3):
        cells[c] = np.int64(extent[c] / size) + 1
    # count the boxes of each cell
    starts = np.zeros(cells[0] * cells[1] * cells[2] + 1, np.int64)
    for t in range(count):
        for c in range(3):
            cell[t, c] = np.int64((low[t, c] - origin[c]) / size)
        starts[(cell[t, 0] * cells[1] + cell[t, 1]) * cells[2] + cell[t, 2] + 1] += 1
    # where each cell begins
    for n in range(1, starts.shape[0]):
        starts[n] += starts[n - 1]
    # the boxes of each
    fill = starts.copy()
    for t in range(count):
        place = (cell[t, 0] * cells[1] + cell[t, 1]) * cells[2] + cell[t, 2]
        order[fill[place]] = t
        fill[place] += 1
    return starts

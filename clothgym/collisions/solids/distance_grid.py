"""Signed distances to a closed mesh, on a grid.

Distances to the triangles are exact in a band around the surface; beyond it each node takes over the nearest triangle of its
neighbors in sweeps (Bridson, SDFGen; Zhao 2005).  The sign is the winding number along lines parallel to x, counted where they pass
through the projections of the triangles.  Ties on shared edges and vertices are broken by an infinitesimal shear (simulation of
simplicity, Edelsbrunner and Muecke 1990), so that no crossing is counted twice or missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.collisions.solids.thin_walls import lost_wall
from clothgym.geometry.closest_points import closest_on_triangle

BAND = 2  # cells around a triangle's bounds in which distances to it are computed exactly
PADDING = 3  # cells around the mesh's bounds
SWEEPS = 2  # of all eight directions
MOST_NODES = 2e7  # building a grid takes about 70 bytes a node


class DistanceGrid(NamedTuple):
    """nodes: distance [m] and its gradient, (x, y, z, 4).  corner: lowest node [m], (3,).  cell: spacing [m]."""

    nodes: NDArray[np.float32]
    corner: NDArray[np.float64]
    cell: float


def distance_grid(vertices: NDArray, triangles: NDArray, resolution: int) -> DistanceGrid:
    """The distance grid of a closed surface, with ``resolution`` cells along its longest side.

    vertices: [m], (vertices, 3).  triangles: (triangles, 3).

    Raises:
        ValueError: a grid that is too large, a part of the surface that is inside out, or walls that the grid would lose.
    """
    # the grid: the bounds and some padding
    low = vertices.min(axis=0)
    cell, nodes = _size_of(vertices, resolution)
    corner = low - PADDING * cell
    if nodes.prod() > MOST_NODES:
        raise ValueError(
            f"resolution={resolution}: a grid of {nodes.prod():.2g} nodes, more than {MOST_NODES:.0g}: give a lower resolution"
        )
    sizes = nodes.astype(np.int64)
    # unsigned distances in cells: in a band, then by sweeps
    distance = np.full(sizes, 1e30)
    nearest = np.full(sizes, -1, np.int32)
    winding = np.zeros(sizes, np.int32)
    fill_band((vertices - corner) / cell, triangles, distance, nearest)
    for _ in range(SWEEPS):
        sweep_all((vertices - corner) / cell, triangles, distance, nearest)
    # winding numbers: a running sum of crossings along x
    count_crossings((vertices - corner) / cell, triangles, winding)
    winding = np.cumsum(winding, axis=0)
    if winding.min() < 0:
        where = corner + cell * np.array(np.unravel_index(np.argmin(winding), winding.shape))
        raise ValueError(f"a part of the mesh near {np.round(where, 4).tolist()} is inside out: turn its triangles round")
    # walls thinner than the cells
    signed = np.where(winding > 0, -distance, distance)
    lost = lost_wall((vertices - corner) / cell, triangles, signed, resolution)
    if lost is not None:
        enough, thickness, place = lost
        _refuse_lost(vertices, resolution, enough, cell * thickness, corner + cell * place)
    # distances and gradients in meters
    nodes = np.stack([cell * signed, *np.gradient(signed)], axis=-1).astype(np.float32)
    return DistanceGrid(np.ascontiguousarray(nodes), corner, cell)


def _size_of(vertices: NDArray, resolution: int) -> tuple[float, NDArray]:
    """The side of a cell [m], and how many nodes there are along each axis, (3,)."""
    size = np.ptp(vertices, axis=0)
    cell = float(size.max()) / resolution
    return cell, np.ceil(size / cell) + 1 + 2 * PADDING


def _refuse_lost(vertices: NDArray, resolution: int, enough: int, thickness: float, place: NDArray) -> None:
    """Refuse a grid that loses walls of this thickness [m] at this place [m]; enough: the resolution that would hold them."""
    cell = _size_of(vertices, resolution)[0]
    nodes = _size_of(vertices, enough)[1].prod()
    remedy = f"give resolution={enough}"
    if nodes > MOST_NODES:
        remedy = (
            f"resolution={enough} would do, but takes {nodes:.2g} nodes, more than {MOST_NODES:.0g}: make the walls thicker, or "
            "make the solid of several colliders"
        )
    raise ValueError(
        f"resolution={resolution}: its cells of {cell:.3g} m lose walls that are {thickness:.3g} m thick, for instance at "
        f"{np.round(place, 4).tolist()}: {remedy}"
    )


@kernel
def distance_to_triangle(px, py, pz, a, b, c):
    """Distance from point p to triangle abc, in the unit of its coordinates."""
    u, v, w = closest_on_triangle(px, py, pz, a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
    dx, dy, dz = px - u * a[0] - v * b[0] - w * c[0], py - u * a[1] - v * b[1] - w * c[1], pz - u * a[2] - v * b[2] - w * c[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def fill_band(x, triangles, distance, nearest):
    """Distances to each triangle at the nodes near it: ``distance`` and ``nearest``, by node.  x: vertices, in cells from the
    corner.
    """
    for t in range(len(triangles)):
        a, b, c = x[triangles[t, 0]], x[triangles[t, 1]], x[triangles[t, 2]]
        # the triangle's bounds and the band, within the grid
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for d in range(3):
            low[d] = max(int(np.floor(min(a[d], min(b[d], c[d])))) - BAND, 0)
            high[d] = min(int(np.floor(max(a[d], max(b[d], c[d])))) + 1 + BAND, distance.shape[d] - 1)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    found = distance_to_triangle(float(i), float(j), float(k), a, b, c)
                    if found < distance[i, j, k]:
                        distance[i, j, k] = found
                        nearest[i, j, k] = t


@kernel
def sweep_all(x, triangles, distance, nearest):
    """Sweep in all eight directions: each node tries the nearest triangles of the seven neighbors behind it.  x: as in
    ``fill_band``.
    """
    nx, ny, nz = distance.shape
    for direction in range(8):
        di, dj, dk = 1 - 2 * (direction & 1), 1 - (direction & 2), 1 - (direction & 4) // 2
        for i in range(1, nx):
            p = i if di > 0 else nx - 1 - i
            for j in range(1, ny):
                q = j if dj > 0 else ny - 1 - j
                for k in range(1, nz):
                    r = k if dk > 0 else nz - 1 - k
                    for step in range(1, 8):
                        t = nearest[p - di * (step & 1), q - dj * ((step >> 1) & 1), r - dk * (step >> 2)]
                        if t >= 0 and t != nearest[p, q, r]:
                            a, b, c = x[triangles[t, 0]], x[triangles[t, 1]], x[triangles[t, 2]]
                            found = distance_to_triangle(float(p), float(q), float(r), a, b, c)
                            if found < distance[p, q, r]:
                                distance[p, q, r] = found
                                nearest[p, q, r] = t


@kernel
def _sign_of_cross(ax, ay, bx, by):
    """Sign of the cross product of two vectors; an infinitesimal shear makes it nonzero unless they are equal."""
    area = ay * bx - ax * by
    if area != 0:
        return 1 if area > 0 else -1
    if by != ay:
        return 1 if by > ay else -1
    if ax != bx:
        return 1 if ax > bx else -1
    return 0


@kernel
def count_crossings(x, triangles, winding):
    """Count where lines along x cross triangles: +1 at the first node inside, -1 at the first node outside again.

    x: vertices, in cells from the corner.  winding: by node.
    """
    nx, ny, nz = winding.shape
    for t in range(len(triangles)):
        a, b, c = x[triangles[t, 0]], x[triangles[t, 1]], x[triangles[t, 2]]
        for j in range(max(int(np.floor(min(a[1], min(b[1], c[1])))), 0), min(int(max(a[1], max(b[1], c[1]))) + 1, ny - 1) + 1):
            for k in range(max(int(np.floor(min(a[2], min(b[2], c[2])))), 0), min(int(max(a[2], max(b[2], c[2]))) + 1, nz - 1) + 1):
                # whether the line lies within the projection of the triangle: it is on the same side of all three sides
                ay, az, by, bz, cy, cz = a[1] - j, a[2] - k, b[1] - j, b[2] - k, c[1] - j, c[2] - k
                one, two, three = _sign_of_cross(by, bz, cy, cz), _sign_of_cross(cy, cz, ay, az), _sign_of_cross(ay, az, by, bz)
                if one == 0 or one != two or two != three:
                    continue
                # the first node beyond the crossing
                u, v, w = bz * cy - by * cz, cz * ay - cy * az, az * by - ay * bz
                total = u + v + w
                if total == 0:
                    continue
                at = int(np.ceil((u * a[0] + v * b[0] + w * c[0]) / total))
                if at < nx:
                    # the x component of the outward normal has the opposite sign to the orientation of the projection
                    winding[max(at, 0), j, k] += one

"""Whether a distance grid holds the walls of its mesh.

A wall thinner than a cell may have no node within, and then the grid has no inside there.  This is looked for where cloth would be:
from many points of the surface a ray goes in until it leaves the solid again, and half way the grid must be clearly negative.  Near
the tip of a cone or the edge of a wedge it is not, whatever the resolution; such places count only where they taper so little that
the grid would lose a long part of them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.geometry.closest_points import closest_on_triangle

THICK = 2.0  # cells: walls of this thickness are always held
DEEP = 1 / 4  # share of the distance to the surface that the grid must have, with its sign, half way through a wall
WALL = 0.8  # half way through a wall the surface is no nearer than this share of half the thickness; at its rim it is
TAPER = 4.0  # cells that may be lost of a tip or an edge, or so many
TAPER_SHARE = 1 / 16  # of the longest side, if these are more
LOST = 1.25  # cells: walls that are thinner may be lost
LEAST_AREA = 4.0  # of walls that are lost [cells^2]: less is a detail
POINTS, WITHIN = 60_000, 4_000  # of the surface, about; and half way through walls, at most


def lost_wall(x: NDArray, triangles: NDArray, signed: NDArray, resolution: int) -> tuple[int, float, NDArray] | None:
    """The resolution that would hold the walls that a grid has lost, their thickness in cells, and a place among them, (3,).

    None if it holds all.  x: vertices, in cells from the grid's corner, (vertices, 3).  triangles: (triangles, 3).  signed: the
    distances in cells, by node.  resolution: cells along the longest side.
    """
    points, normals, share = _surface_points(x, triangles)
    # most of the surface is that of thick parts: one cell within, the grid is deep
    near = sampled(signed, points - normals) > -0.5
    points, normals, share = points[near], normals[near], share[near]
    thickness, slope = np.full(len(points), np.inf), np.zeros(len(points))
    cast_rays(x, triangles, points, normals, THICK - 1e-6, thickness, slope)
    # where half way through is outside, or next to it; tips and edges count if they taper over more than may be lost
    allowed = max(TAPER, TAPER_SHARE * resolution)
    found = np.flatnonzero((thickness < THICK) & (thickness > allowed * slope))
    middle = points[found] - thickness[found, None] / 2 * normals[found]
    found, middle = (array[sampled(signed, middle) > -DEEP / 2 * thickness[found]] for array in (found, middle))
    chosen = np.linspace(0, len(found) - 1, min(len(found), WITHIN)).astype(np.int64)
    weight = share[found].sum() / max(share[found[chosen]].sum(), 1e-300)
    found, middle = found[chosen], middle[chosen]
    distance = np.full(len(found), np.inf)
    nearest(x, triangles, middle, distance)
    lost = (distance > WALL / 2 * thickness[found]) & (sampled(signed, middle) > -DEEP * distance)
    if weight * share[found[lost]].sum() < LEAST_AREA:
        # all of a small solid may be a detail
        return None if signed.min() <= -DEEP else (2 * resolution, 1.0, x.mean(axis=0))
    # what each of them needs: more cells across, or a taper that is short compared with the whole
    thickness, slope, middle = thickness[found[lost]], slope[found[lost]], middle[lost]
    enough = np.minimum(resolution * THICK / thickness, LOST / TAPER_SHARE / np.maximum(slope, 1e-9))
    worst = int(np.argmax(enough))
    return math.ceil(enough[worst] - 1e-6), float(thickness[worst]), middle[worst]


def _surface_points(x: NDArray, triangles: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Points spread over the triangles and their outward normals, (points, 3), and the area of each [cells^2], (points,)."""
    p = x[triangles]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    longest = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).max(axis=1)
    spacing = max(1.0, math.sqrt(twice.sum() / 2 / POINTS))
    pieces = np.clip(np.ceil(longest / spacing), 1, 256).astype(np.int64)
    parts = []
    for m in np.unique(pieces).tolist():
        own = np.flatnonzero(pieces == m)
        i, j = np.nonzero(np.add.outer(np.arange(m), np.arange(m)) < m)
        u, v = (i + 1 / 3) / m, (j + 1 / 3) / m
        weights = np.stack([1 - u - v, u, v], axis=1)
        parts.append((
            np.einsum("wc,tcd->twd", weights, p[own]).reshape(-1, 3),
            np.repeat(cross[own] / twice[own, None], len(u), axis=0),
            np.repeat(twice[own] / 2 / len(u), len(u)),
        ))  # fmt: skip
    points, normals, share = (np.concatenate(arrays) for arrays in zip(*parts))
    return points, normals, share


def sampled(signed: NDArray, points: NDArray) -> NDArray:
    """The distances at points between the nodes, as kernels interpolate them, (points,)."""
    low = np.clip(np.floor(points).astype(np.int64), 0, np.array(signed.shape) - 2)
    t = points - low
    out = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, t, 1 - t), axis=1)
        out += weight * signed[tuple((low + corner).T)]
    return out


@kernel
def cast_rays(x, triangles, points, normals, most, thickness, slope):
    """How far it is from each point, against its normal, until the solid ends: ``thickness``, where it is less than ``most``; and
    the tangent of the angle between both surfaces: ``slope``.

    Ray and triangle after Moeller and Trumbore 1997.  points, normals: (points, 3).  thickness, slope: (points,).
    """
    for t in range(triangles.shape[0]):
        a, b, c = x[triangles[t, 0]], x[triangles[t, 1]], x[triangles[t, 2]]
        # two sides and the normal, and the bounds of the points that can hit it
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        size = np.sqrt(nx * nx + ny * ny + nz * nz)
        x0, x1 = min(a[0], min(b[0], c[0])) - most, max(a[0], max(b[0], c[0])) + most
        y0, y1 = min(a[1], min(b[1], c[1])) - most, max(a[1], max(b[1], c[1])) + most
        z0, z1 = min(a[2], min(b[2], c[2])) - most, max(a[2], max(b[2], c[2])) + most
        for k in range(points.shape[0]):
            px, py, pz = points[k, 0], points[k, 1], points[k, 2]
            if px < x0 or px > x1 or py < y0 or py > y1 or pz < z0 or pz > z1:
                continue
            dx, dy, dz = -normals[k, 0], -normals[k, 1], -normals[k, 2]
            facing = nx * dx + ny * dy + nz * dz
            if facing <= 1e-9 * size:
                continue
            # the distance to its plane, and the place there in terms of the two sides
            ox, oy, oz = px - a[0], py - a[1], pz - a[2]
            far = -(nx * ox + ny * oy + nz * oz) / facing
            if far <= 1e-9 or far >= min(most, thickness[k]):
                continue
            qx, qy, qz = ox + far * dx, oy + far * dy, oz + far * dz
            s = (nx * (qy * vz - qz * vy) + ny * (qz * vx - qx * vz) + nz * (qx * vy - qy * vx)) / (size * size)
            r = (nx * (uy * qz - uz * qy) + ny * (uz * qx - ux * qz) + nz * (ux * qy - uy * qx)) / (size * size)
            if s >= -1e-9 and r >= -1e-9 and s + r <= 1 + 1e-9:
                thickness[k] = far
                cosine = min(facing / size, 1.0)
                slope[k] = np.sqrt(1 - cosine * cosine) / cosine


@kernel
def nearest(x, triangles, points, distance):
    """The distance of each point to the nearest of all triangles, (points,)."""
    for t in range(triangles.shape[0]):
        a, b, c = x[triangles[t, 0]], x[triangles[t, 1]], x[triangles[t, 2]]
        for k in range(points.shape[0]):
            px, py, pz = points[k, 0], points[k, 1], points[k, 2]
            u, v, w = closest_on_triangle(px, py, pz, a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
            dx, dy, dz = (
                px - u * a[0] - v * b[0] - w * c[0],
                py - u * a[1] - v * b[1] - w * c[1],
                pz - u * a[2] - v * b[2] - w * c[2],
            )
            distance[k] = min(distance[k], np.sqrt(dx * dx + dy * dy + dz * dz))

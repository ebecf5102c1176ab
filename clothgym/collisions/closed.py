"""What makes a mesh of triangles a solid, and the sentences for one that is none."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import kernel
from clothgym.checks import finite
from clothgym.triangles import corners_of, directed_edges, refuse_degenerate

ROUNDING = 1e-12  # six times a tetrahedron's volume over the mesh's size cubed, below which its corners count as coplanar


def checked_solid(vertices: ArrayLike, triangles: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [m], (vertices, 3), and triangles, (triangles, 3), of a closed surface whose outside is where they are
    counter-clockwise.

    Raises:
        ValueError: not such arrays, a triangle without area, an open edge, one of more than two triangles or of two that disagree
            on which side is out, a surface inside out, or one that passes through itself.
    """
    x = finite("vertices", vertices)
    corners = corners_of(x, triangles)
    refuse_degenerate(x, corners)
    _refuse_open(corners)
    twice = np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]])
    middle = x.mean(axis=0)
    volume = float(np.sum((x[corners[:, 0]] - middle) * twice)) / 6
    if volume < 0:
        raise ValueError(f"the mesh is inside out (its volume is {volume:.3g} m^3): turn all triangles round, triangles[:, ::-1]")
    size = float(np.ptp(x, axis=0).max())
    order = np.argsort(x[corners, 0].min(axis=1), kind="stable")
    first, second = first_crossing(x - middle, corners, order, ROUNDING * size**3)
    if first >= 0:
        one, other = (f"{t}, {corners[t].tolist()}," for t in (first, second))
        remedy = "join its parts into one surface (a boolean union), or make them colliders of their own"
        raise ValueError(f"the mesh passes through itself: triangles {one} and {other} cross; {remedy}")
    return x, corners


def _refuse_open(corners: NDArray) -> None:
    """Refuse edges that are not between two triangles with the same side out."""
    directed = directed_edges(corners)
    edges, inverse, times = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    if np.any(times == 1):
        a, b = edges[np.argmax(times == 1)].tolist()
        count = int(np.sum(times == 1))
        raise ValueError(f"the mesh is open: edge {a}-{b} belongs to one triangle only ({count} such edges): close its holes")
    if np.any(times > 2):
        a, b = edges[np.argmax(times > 2)].tolist()
        raise ValueError(f"edge {a}-{b} belongs to {times.max()} triangles: a solid's belong to two, separate its parts there")
    forward = np.bincount(inverse.reshape(-1), weights=directed[:, 0] < directed[:, 1])
    if np.any(forward != 1):
        a, b = edges[np.argmax(forward != 1)].tolist()
        raise ValueError(f"the triangles beside edge {a}-{b} disagree on which side is out: turn one round")


@kernel
def _volume(a, b, c, d):
    """Six times the signed volume of a tetrahedron."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    return ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)


@kernel
def _pierces(p, q, a, b, c, rounding):
    """Whether the segment from p to q goes through the triangle's inside."""
    above, below = _volume(a, b, c, p), _volume(a, b, c, q)
    if not ((above > rounding and below < -rounding) or (above < -rounding and below > rounding)):
        return False
    u, v, w = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    return (u > rounding and v > rounding and w > rounding) or (u < -rounding and v < -rounding and w < -rounding)


@kernel
def _has(triangle, vertex):
    return triangle[0] == vertex or triangle[1] == vertex or triangle[2] == vertex


@kernel
def first_crossing(x, triangles, order, rounding):
    """Two triangles that cross, or (-1, -1); order: of the triangles by their lowest x.  Neighbours across an edge do not count."""
    low, high = np.empty((len(triangles), 3)), np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        for c in range(3):
            p, q, r = x[triangles[t, 0], c], x[triangles[t, 1], c], x[triangles[t, 2], c]
            low[t, c] = min(p, min(q, r))
            high[t, c] = max(p, max(q, r))
    for n in range(len(order)):
        i = order[n]
        for m in range(n + 1, len(order)):
            j = order[m]
            if low[j, 0] > high[i, 0]:
                break
            if low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1] or low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]:
                continue
            shared = 0
            for c in range(3):
                shared += _has(triangles[i], triangles[j, c])
            if shared > 1:
                continue
            for one, other in ((i, j), (j, i)):
                a, b, c = x[triangles[other, 0]], x[triangles[other, 1]], x[triangles[other, 2]]
                for side in range(3):
                    p, q = triangles[one, side], triangles[one, (side + 1) % 3]
                    if not _has(triangles[other], p) and not _has(triangles[other], q) and _pierces(x[p], x[q], a, b, c, rounding):
                        return i, j
    return -1, -1

"""What tasks measure on one sheet, as kernels: no number depends on who else is in the batch.

Sheets are (3, particles), contiguous: the particles are what vectorizes.  The least and the largest of numbers that are not
negative are found by their bits, which are in the same order, for integers may be compared in any order, and so side by side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel, uncounted
from clothgym.mesh import ClothMesh

# what ``summarize`` writes
CENTROID, SPEED2, STRETCH2, FINITE = 0, 3, 4, 5
SUMMARY = 6
FAR2 = 1e6  # a kilometer or a kilometer a second is no cloth [m^2, m^2/s^2]
MOST_STRAIN = 1e3  # stands for the strain of a sheet that has diverged
LARGEST_BITS = 0x7F7FFFFF  # of the largest float32

GROUP = 4  # triangles that share a box in ``count_layers``


@kernel
def squared_distance(p, q):
    """Of two points, in float64."""
    x, y, z = np.float64(p[0]) - q[0], np.float64(p[1]) - q[1], np.float64(p[2]) - q[2]
    return x * x + y * y + z * z


@kernel
def distance(p, q):
    """Of two points, in float64."""
    return np.sqrt(squared_distance(p, q))


@kernel
def length_of(v):
    """Of a vector, in float64."""
    x, y, z = np.float64(v[0]), np.float64(v[1]), np.float64(v[2])
    return np.sqrt(x * x + y * y + z * z)


@inlined
def _bits(value):
    """A float32's bits, as an integer."""
    return np.float32(value).view(np.int32)


@inlined
def _from_bits(bits):
    """The float32 of these bits."""
    return np.int32(bits).view(np.float32)


@inlined
def share_above(a, b, c):
    """Share of a triangle on which a linear function is positive that is a, b and c at the corners."""
    count = (a > 0) + (b > 0) + (c > 0)
    if count == 0 or count == 3:
        return count / 3
    # the one corner whose sign is its own: a triangle is cut off there, a^2 / ((a - b) (a - c)) of the whole
    if (b > 0) == (c > 0):
        alone, one, other = a, b, c
    elif (a > 0) == (c > 0):
        alone, one, other = b, a, c
    else:
        alone, one, other = c, a, b
    cut = (alone / (alone - one)) * (alone / (alone - other))
    return cut if count == 1 else 1 - cut


@uncounted
def summarize(x, v, share, ends, inverse2, out):
    """Summary of a sheet: (SUMMARY,).

    Center of area [m] (3), mean squared speed [m^2/s^2], largest squared stretch of the structural springs (length over
    rest length), and 1 where every position and velocity is finite and sane, else 0.
    share: each particle's share of the sheet's area, summing to 1, (particles,).  ends: of the structural springs, (2, springs);
    inverse2: one over the squares of their rest lengths [1/m^2], (springs,).
    """
    # center of area and mean squared speed, weighted by area
    cx = cy = cz = speed2 = np.float32(0)
    for p in range(x.shape[1]):
        cx += share[p] * x[0, p]
        cy += share[p] * x[1, p]
        cz += share[p] * x[2, p]
        speed2 += share[p] * (v[0, p] * v[0, p] + v[1, p] * v[1, p] + v[2, p] * v[2, p])
    # the largest squared stretch, found by its bits
    largest = np.int32(0)
    for s in range(inverse2.shape[0]):
        i, j = ends[0, s], ends[1, s]
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        largest = max(largest, _bits((dx * dx + dy * dy + dz * dz) * inverse2[s]))
    stretch2 = _from_bits(largest)
    out[CENTROID], out[CENTROID + 1], out[CENTROID + 2], out[SPEED2], out[STRETCH2] = cx, cy, cz, speed2, stretch2
    # comparisons with NaN are false
    out[FINITE] = cx * cx + cy * cy + cz * cz < FAR2 and speed2 < FAR2 and stretch2 < FAR2


@kernel
def largest_strain(summary):
    """Of the structural springs; MOST_STRAIN for a sheet that is not sane."""
    return np.sqrt(summary[STRETCH2]) - np.float32(1) if summary[FINITE] > 0 else np.float32(MOST_STRAIN)


@apart
def stretch_quantile(x, ends, inverse2, share):
    """Quantile ``share`` of the structural springs' stretch, length over rest length.

    By bisection, from 1 to twice that, to 2^-20: the least stretch (at least 1) that no more than ``1 - share`` of the springs
    exceed.
    """
    # each spring's stretch
    count = inverse2.shape[0]
    stretch = np.empty(count, np.float32)
    for s in range(count):
        i, j = ends[0, s], ends[1, s]
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        stretch[s] = np.sqrt((dx * dx + dy * dy + dz * dz) * inverse2[s])
    # halve the range that holds the quantile, twenty times
    allowed = int((1 - share) * count)
    low, step = np.float32(1), np.float32(0.5)
    for _ in range(20):
        middle, above = low + step, np.int32(0)
        for s in range(count):
            above += np.int32(stretch[s] > middle)
        low = middle if above > allowed else low
        step *= np.float32(0.5)
    return low


@uncounted
def soft_coverage(x, points, reach):
    """How near a sheet is to points of a surface [m], (points, 3): mean of ``1/(1 + (d/reach)^2)`` over them.

    d: distance [m] from the point to the nearest particle.
    """
    # each point's squared distance to the nearest particle, found by its bits, and its weight in the mean
    one, total = np.float32(1), np.float32(0)
    weight = one / (np.float32(reach) * np.float32(reach))
    for k in range(points.shape[0]):
        px, py, pz = np.float32(points[k, 0]), np.float32(points[k, 1]), np.float32(points[k, 2])
        nearest = np.int32(LARGEST_BITS)
        for p in range(x.shape[1]):
            dx, dy, dz = x[0, p] - px, x[1, p] - py, x[2, p] - pz
            nearest = min(nearest, _bits(dx * dx + dy * dy + dz * dz))
        total += one / (one + _from_bits(nearest) * weight)
    return total / np.float32(points.shape[0])


def centers_of_area(mesh: ClothMesh, positions: NDArray) -> NDArray:
    """Each sheet's center of area [m], (sheets, 3); positions: [m], (sheets, particles, 3).

    In one order of sums, so that its bits do not depend on how many sheets there are.
    """
    share = mesh.area / mesh.area.sum()
    return np.cumsum(positions * share[:, None], axis=1)[:, -1]


def key_particles(mesh: ClothMesh) -> NDArray:
    """Corners, middles of the edges, center of a grid: particles of a 3 x 3 subgrid, row by row, (9,).

    Of a triangle mesh: nine particles, evenly spaced in their order, or all if there are fewer.
    """
    if mesh.shape is None:
        return np.unique(np.linspace(0, mesh.num_particles - 1, 9).astype(np.int64))
    rows, columns = (np.array([0, n // 2, n - 1]) for n in mesh.grid_shape)
    return (rows[:, None] * mesh.grid_shape[1] + columns[None, :]).ravel()


@apart
def count_layers(x, triangles, points, normals, limits, layers):
    """Layers of a sheet over points of a solid's surface, (points,): 0 for a point that is not covered.

    The line through a point along its outward normal meets the sheet at heights t [m].  A point is covered if one of them lies in
    [-poking, near] and none in [-near, -poking): there it would stick out of the sheet.  Its layers are the heights in
    [-poking, far].

    points [m], normals: (points, 3), the normals of length 1.  limits: poking, near and far [m], far being the largest.
    float64 throughout: this is part of the evaluation, once an episode.
    """
    poking, near, far = limits
    count = triangles.shape[0]
    # a box about triangles that lie together
    corners, low, high = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    for first in range(0, count, GROUP):
        g = first // GROUP
        for c in range(3):
            least, most = np.inf, -np.inf
            for t in range(first, min(first + GROUP, count)):
                for m in range(3):
                    corners[t, m, c] = x[c, triangles[t, m]]
                    least, most = min(least, corners[t, m, c]), max(most, corners[t, m, c])
            low[g, c], high[g, c] = least, most
    # each point's segment, against the triangles in the boxes that it may meet
    ends, axes = np.empty((2, 3)), np.empty((3, 3))
    for k in range(points.shape[0]):
        for c in range(3):
            a, b = points[k, c] - near * normals[k, c], points[k, c] + far * normals[k, c]
            ends[0, c], ends[1, c] = min(a, b), max(a, b)
        _write_axes(normals[k], axes)
        over, within, pokes = 0, 0, 0
        for g in range((count + GROUP - 1) // GROUP):
            if (
                ends[1, 0] < low[g, 0] or ends[0, 0] > high[g, 0] or ends[1, 1] < low[g, 1] or ends[0, 1] > high[g, 1]
                or ends[1, 2] < low[g, 2] or ends[0, 2] > high[g, 2]
            ):  # fmt: skip
                continue
            for t in range(GROUP * g, min(GROUP * (g + 1), count)):
                height = _height_over(points[k], axes, corners[t])
                over += -poking <= height <= far
                within += -poking <= height <= near
                pokes += -near <= height < -poking
        layers[k] = over if within > 0 and pokes == 0 else 0


@kernel
def _write_axes(n, axes):
    """Two vectors at right angles to the unit vector n and to each other, and n, (3, 3), as rows.

    Duff and others, Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017.
    """
    sign = 1.0 if n[2] >= 0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    axes[0, 0], axes[0, 1], axes[0, 2] = 1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]
    axes[1, 0], axes[1, 1], axes[1, 2] = b, sign + n[1] * n[1] * a, -n[1]
    for c in range(3):
        axes[2, c] = n[c]


@kernel
def _height_over(p, axes, corners):
    """Where the line through p along the third axis meets a triangle, (3, 3): its height over p [m], or NaN if it misses.

    Of the triangles that share an edge or a corner, and do not fold over there, a line through it meets exactly one: the corners
    are projected along the line, which gives neighbors the same numbers, and an edge that it meets belongs to the triangle on one
    side of it (Woop, Benthin and Wald, Watertight Ray/Triangle Intersection, JCGT 2(1), 2013; the rule is the rasterizers').
    """
    ax, ay, az = _along(axes, p, corners[0])
    bx, by, bz = _along(axes, p, corners[1])
    cx, cy, cz = _along(axes, p, corners[2])
    # twice the areas that the line cuts the projected triangle into; a neighbor has the same with the other sign
    u, v, w = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    whole = u + v + w
    if whole < 0:
        inside = _on_side(-u, cx - bx, cy - by) and _on_side(-v, ax - cx, ay - cy) and _on_side(-w, bx - ax, by - ay)
    else:
        inside = _on_side(u, bx - cx, by - cy) and _on_side(v, cx - ax, cy - ay) and _on_side(w, ax - bx, ay - by)
    return (u * az + v * bz + w * cz) / whole if inside and whole != 0 else np.nan


@kernel
def _along(axes, p, q):
    """Components along three axes of the way from p to q."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    return (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )


@inlined
def _on_side(area, x, y):
    """Whether an area is positive; or, of an edge that goes against (x, y), none, and the edge is the triangle's own."""
    return area > 0 or (area == 0 and (y > 0 or (y == 0 and x > 0)))

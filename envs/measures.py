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

GROUP = 4  # triangles that share a box in ``covered_share``


@inlined
def _distance2(p, q):
    """Squared distance of two points."""
    return (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2


@kernel
def distance(p, q):
    """Of two points, in float64."""
    x, y, z = np.float64(p[0]) - q[0], np.float64(p[1]) - q[1], np.float64(p[2]) - q[2]
    return np.sqrt(x * x + y * y + z * z)


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


@kernel
def _distance2_to_triangle(p, a, b, c):
    """Squared distance [m^2] from point p to triangle abc (Ericson, Real-Time Collision Detection, 2005, section 5.1.5)."""
    # edges from a, the point from each corner, and its projections on these edges
    abx, aby, abz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    acx, acy, acz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    apx, apy, apz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    bpx, bpy, bpz = p[0] - b[0], p[1] - b[1], p[2] - b[2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    cpx, cpy, cpz = p[0] - c[0], p[1] - c[1], p[2] - c[2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    # the nearest point is a + s ab + t ac, with s and t by the region in which p lies
    if d1 <= 0 and d2 <= 0:  # the region of vertex a
        s, t = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:  # b
        s, t = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:  # c
        s, t = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:  # edge ab
        s, t = d1 / (d1 - d3), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:  # edge ac
        s, t = 0.0, d2 / (d2 - d6)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:  # edge bc
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:  # inside
        s, t = vb / (va + vb + vc), vc / (va + vb + vc)
    rx, ry, rz = apx - s * abx - t * acx, apy - s * aby - t * acy, apz - s * abz - t * acz
    return rx * rx + ry * ry + rz * rz


@apart
def covered_share(x, triangles, points, tolerance):
    """Share of points [m], (points, 3), that lie within ``tolerance`` [m] of a triangle of a sheet.

    float64 throughout: this is part of the evaluation, once an episode.
    """
    count = triangles.shape[0]
    # a box about triangles that lie together, within which a point is near enough
    corners, low, high = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    for first in range(0, count, GROUP):
        g = first // GROUP
        for c in range(3):
            least, most = np.inf, -np.inf
            for t in range(first, min(first + GROUP, count)):
                for m in range(3):
                    corners[t, m, c] = x[c, triangles[t, m]]
                    least, most = min(least, corners[t, m, c]), max(most, corners[t, m, c])
            low[g, c], high[g, c] = least - tolerance, most + tolerance
    # count the points that have a triangle near enough
    covered = 0
    for k in range(points.shape[0]):
        covered += _near_any(points[k], corners, low, high, tolerance * tolerance)
    return covered / points.shape[0]


@kernel
def _near_any(p, corners, low, high, tolerance2):
    """Whether a triangle is within the root of ``tolerance2`` [m^2] of point p; low, high: boxes of GROUP triangles each."""
    # triangles of a box that holds the point, until one is near enough
    x, y, z = p[0], p[1], p[2]
    for g in range((corners.shape[0] + GROUP - 1) // GROUP):
        if x < low[g, 0] or x > high[g, 0] or y < low[g, 1] or y > high[g, 1] or z < low[g, 2] or z > high[g, 2]:
            continue
        for t in range(GROUP * g, min(GROUP * (g + 1), corners.shape[0])):
            if _distance2_to_triangle(p, corners[t, 0], corners[t, 1], corners[t, 2]) <= tolerance2:
                return True
    return False

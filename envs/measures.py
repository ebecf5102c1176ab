"""What tasks measure on a batch of sheets: reductions as kernels, so that no figure depends on who else is in the batch.

Kernels that begin with ``first, last`` work on blocks ``(block, component, particle, lane)``; loops over particles are outer,
loops over lanes inner, and nothing is summed across lanes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.mesh import ClothMesh

# columns of ``summarize``'s output
CENTROID, SPEED2, STRETCH2, FINITE = 0, 3, 4, 5
SUMMARY = 6
MOST_STRAIN = 1e3  # what is told of a sheet that has diverged


@kernel
def summarize(first, last, x, v, share, springs, structural, out):
    """Summary of each sheet, (blocks, SUMMARY, lanes).

    Centre of area [m] (3), mean squared speed [m^2/s^2], largest squared stretch of the structural springs (length over
    rest length), and 1 where every position and velocity is finite and sane, else 0.
    share: each particle's share of the sheet's area, summing to 1, (particles,); structural: indices of springs.
    """
    ends, rest_length = springs[0], springs[1]
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    far2 = x.dtype.type(1e6)
    lanes = x.shape[3]
    for b in range(first, last):
        total = out[b]
        for c in range(SUMMARY):
            for l in range(lanes):
                total[c, l] = zero
        for p in range(x.shape[2]):
            a = share[p]
            for c in range(3):
                for l in range(lanes):
                    total[CENTROID + c, l] += a * x[b, c, p, l]
            for l in range(lanes):
                vx, vy, vz = v[b, 0, p, l], v[b, 1, p, l], v[b, 2, p, l]
                total[SPEED2, l] += a * (vx * vx + vy * vy + vz * vz)
        for s in structural:
            i, j = ends[s, 0], ends[s, 1]
            scale = one / (rest_length[s] * rest_length[s])
            for l in range(lanes):
                dx, dy, dz = x[b, 0, j, l] - x[b, 0, i, l], x[b, 1, j, l] - x[b, 1, i, l], x[b, 2, j, l] - x[b, 2, i, l]
                stretch2 = (dx * dx + dy * dy + dz * dz) * scale
                total[STRETCH2, l] = max(total[STRETCH2, l], stretch2)
        for l in range(lanes):
            # comparisons with NaN are false; a kilometre or a kilometre a second is no cloth
            c2 = total[0, l] * total[0, l] + total[1, l] * total[1, l] + total[2, l] * total[2, l]
            sane = c2 < far2 and total[SPEED2, l] < far2 and total[STRETCH2, l] < far2
            total[FINITE, l] = one if sane else zero


def largest_strain(summary: NDArray) -> NDArray:
    """Of the structural springs, from ``summarize``'s output as (SUMMARY, num_envs); MOST_STRAIN for a sheet that is not sane."""
    return np.where(summary[FINITE] > 0, np.sqrt(summary[STRETCH2]) - 1, MOST_STRAIN)


@kernel
def stretch_quantile(first, last, x, springs, structural, share, out):
    """Quantile ``share`` of the structural springs' stretch, length over rest length, (blocks, lanes).

    By bisection, from 1 to twice that, to 2^-20: the least stretch (at least 1) that no more than ``1 - share`` of the springs
    exceed.  No sorting: lanes stay side by side.
    """
    ends, rest_length = springs[0], springs[1]
    one = x.dtype.type(1)
    half = x.dtype.type(0.5)
    lanes = x.shape[3]
    allowed = int((1 - share) * structural.shape[0])
    stretch = np.empty((structural.shape[0], lanes), x.dtype)
    for b in range(first, last):
        for k in range(structural.shape[0]):
            s = structural[k]
            i, j, own = ends[s, 0], ends[s, 1], stretch[k]
            scale = one / rest_length[s]
            for l in range(lanes):
                dx, dy, dz = x[b, 0, j, l] - x[b, 0, i, l], x[b, 1, j, l] - x[b, 1, i, l], x[b, 2, j, l] - x[b, 2, i, l]
                own[l] = np.sqrt(dx * dx + dy * dy + dz * dz) * scale
        low = np.ones(lanes, x.dtype)
        step = half
        count = np.empty(lanes, np.int32)
        for _ in range(20):
            count[:] = 0
            for k in range(structural.shape[0]):
                own = stretch[k]
                for l in range(lanes):
                    count[l] += 1 if own[l] > low[l] + step else 0
            for l in range(lanes):
                low[l] = low[l] + step if count[l] > allowed else low[l]
            step *= half
        out[b] = low


@kernel
def see_points(first, last, x, v, particles, origin, scale, out):
    """Positions of some particles relative to ``origin`` [m], times ``scale``, and their velocities [m/s].

    particles: (count,); origin: (blocks, 3, lanes); out: (blocks, 6 * count, lanes).
    """
    count = len(particles)
    for b in range(first, last):
        for k in range(count):
            for c in range(3):
                xc, vc, here = x[b, c, particles[k]], v[b, c, particles[k]], origin[b, c]
                for l in range(x.shape[3]):
                    out[b, 3 * k + c, l] = (xc[l] - here[l]) * scale
                for l in range(x.shape[3]):
                    out[b, 3 * (count + k) + c, l] = vc[l]


def key_particles(mesh: ClothMesh) -> NDArray:
    """Corners, middles of the edges, centre of a grid: particles of a 3 x 3 subgrid, row by row, (9,)."""
    rows, columns = (np.array([0, n // 2, n - 1]) for n in mesh.grid_shape)
    return (rows[:, None] * mesh.grid_shape[1] + columns[None, :]).ravel()


@kernel
def soft_coverage(first, last, x, points, reach, out):
    """How near the sheet is to points of a surface: mean of ``1/(1 + (d/reach)^2)`` over them, (blocks, lanes).

    d: distance [m] from the point to the nearest particle.  points [m]: (blocks, points, 3, lanes).
    """
    one = x.dtype.type(1)
    share = one / x.dtype.type(points.shape[1])
    inverse_reach2 = one / (reach * reach)
    lanes = x.shape[3]
    for b in range(first, last):
        nearest = np.empty(lanes, x.dtype)
        out[b] = 0
        for k in range(points.shape[1]):
            px, py, pz = points[b, k, 0], points[b, k, 1], points[b, k, 2]
            nearest[:] = x.dtype.type(1e9)
            for p in range(x.shape[2]):
                xx, xy, xz = x[b, 0, p], x[b, 1, p], x[b, 2, p]
                for l in range(lanes):
                    dx, dy, dz = xx[l] - px[l], xy[l] - py[l], xz[l] - pz[l]
                    nearest[l] = min(nearest[l], dx * dx + dy * dy + dz * dz)
            for l in range(lanes):
                out[b, l] += share / (one + nearest[l] * inverse_reach2)


@kernel
def _distance2_to_triangle(p, a, b, c):
    """Squared distance [m^2] from point p to triangle abc (Ericson, Real-Time Collision Detection, 2005, section 5.1.5)."""
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


@kernel
def covered_share(sheet, triangles, points, tolerance):
    """Share of points [m], (points, 3), that lie within ``tolerance`` [m] of a triangle of one sheet, (particles, 3).

    float64 throughout: this is a judgement, made once an episode.
    """
    count = len(triangles)
    center = np.empty((count, 3))
    reach2 = np.empty(count)
    for t in range(count):
        a, b, c = sheet[triangles[t, 0]], sheet[triangles[t, 1]], sheet[triangles[t, 2]]
        far = 0.0
        for k in range(3):
            center[t, k] = (a[k] + b[k] + c[k]) / 3
        for corner in (a, b, c):
            d2 = 0.0
            for k in range(3):
                d2 += (corner[k] - center[t, k]) ** 2
            far = max(far, d2)
        reach2[t] = (np.sqrt(far) + tolerance) ** 2
    covered = 0
    for k in range(len(points)):
        p = points[k]
        for t in range(count):
            dx, dy, dz = p[0] - center[t, 0], p[1] - center[t, 1], p[2] - center[t, 2]
            if dx * dx + dy * dy + dz * dz > reach2[t]:
                continue
            a, b, c = sheet[triangles[t, 0]], sheet[triangles[t, 1]], sheet[triangles[t, 2]]
            if _distance2_to_triangle(p, a, b, c) <= tolerance * tolerance:
                covered += 1
                break
    return covered / len(points)

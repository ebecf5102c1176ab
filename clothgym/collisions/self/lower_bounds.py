"""Lower bounds of distances in float32, side by side in vectors: most pairs of primitives are ruled out without float64.

For any unit vector n, min n . x_first - max n . x_second bounds the distance from below (see ``narrow_phase``).  So a direction
that is roughly right does, and rounding is all that has to be allowed for: positions are taken relative to the first particle, so
that a coordinate is off by at most half a unit in the last place of the sheet's extent.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, inlined, uncounted

# rows of ``QueryScratch.near``
N_EXTRA, N_WIDE, N_STRETCH = 3, 4, 5
EPSILON = float(np.finfo(np.float32).eps)
# share of a bound that is kept, as directions are not quite of unit length, and what rounding may take, per extent of the sheet
SAFE, ROUNDING = 1 - 1e-5, 16 * EPSILON
UPWARDS = 1 + 1e-6  # makes a number in float32 no smaller than that in float64


@uncounted
def round_positions(p, extra, near):
    """Positions relative to the first particle and extras in float32: the first rows of ``near``.  Returns the extent [m]."""
    extent = 0.0
    for c in range(3):
        origin = p[0, c]
        for v in range(p.shape[0]):
            along = p[v, c] - origin
            near[c, v] = along
            extent = max(extent, abs(along))
    for v in range(p.shape[0]):
        near[N_EXTRA, v] = extra[v] * UPWARDS
    return extent


@disjoint
def _bound_edges(x, y, z, extra, first, second, third, fourth, lost, lower):
    """Lower bounds of the distances of edges, from first to second and from third to fourth vertex, less their extras [m].

    The direction is that of the closest points of the lines, clamped to the segments one after the other (Ericson, Real-Time
    Collision Detection, 2005, 5.1.9).  All but the row of vertices' coordinates: (pairs,).
    """
    zero, one, tiny, safe = np.float32(0), np.float32(1), np.float32(1e-12), np.float32(SAFE)
    for m in range(lower.shape[0]):
        i, j, k, l = first[m], second[m], third[m], fourth[m]
        # from the first vertex: u to the second, c to the third, v from there to the fourth
        ax, ay, az = x[i], y[i], z[i]
        ux, uy, uz = x[j] - ax, y[j] - ay, z[j] - az
        cx, cy, cz = x[k] - ax, y[k] - ay, z[k] - az
        vx, vy, vz = x[l] - x[k], y[l] - y[k], z[l] - z[k]
        # a u and c + b v are close to each other
        uu, vv, uv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
        uc, vc = ux * cx + uy * cy + uz * cz, vx * cx + vy * cy + vz * cz
        a = min(max((uc * vv - vc * uv) / (uu * vv - uv * uv + tiny * tiny), zero), one)
        b = min(max((uv * a - vc) / (vv + tiny), zero), one)
        a = min(max((uc + uv * b) / (uu + tiny), zero), one)
        nx, ny, nz = a * ux - cx - b * vx, a * uy - cy - b * vy, a * uz - cz - b * vz
        scale = one / np.sqrt(nx * nx + ny * ny + nz * nz + tiny * tiny)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        # min n . (0, u) - max n . (c, c + v)
        nu, nc, nv = nx * ux + ny * uy + nz * uz, nx * cx + ny * cy + nz * cz, nx * vx + ny * vy + nz * vz
        bound = min(zero, nu) - (nc + max(zero, nv))
        lower[m] = bound * safe - lost - (max(extra[i], extra[j]) + max(extra[k], extra[l]))


@disjoint
def _bound_vertices(x, y, z, extra, first, second, third, fourth, lost, lower):
    """Lower bounds of the distances of a vertex, the first, from a triangle, the others, less their extras [m].

    The direction is that of the closest point of the triangle's plane if it is inside, else of the closest of its edges.
    """
    zero, one, tiny, safe = np.float32(0), np.float32(1), np.float32(1e-12), np.float32(SAFE)
    for m in range(lower.shape[0]):
        v, i, j, k = first[m], second[m], third[m], fourth[m]
        # corners a, b and c from the vertex, and the sides u = b - a, w = c - a and e = c - b
        px, py, pz = x[v], y[v], z[v]
        ax, ay, az = x[i] - px, y[i] - py, z[i] - pz
        bx, by, bz = x[j] - px, y[j] - py, z[j] - pz
        cx, cy, cz = x[k] - px, y[k] - py, z[k] - pz
        ux, uy, uz, wx, wy, wz, ex, ey, ez = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az, cx - bx, cy - by, cz - bz
        uu, ww, uw = ux * ux + uy * uy + uz * uz, wx * wx + wy * wy + wz * wz, ux * wx + uy * wy + uz * wz
        ua, wa = -(ux * ax + uy * ay + uz * az), -(wx * ax + wy * ay + wz * az)
        # the closest point of the plane, a + s u + t w
        scale = one / (uu * ww - uw * uw + tiny * tiny)
        s, t = (ua * ww - wa * uw) * scale, (wa * uu - ua * uw) * scale
        inside = (s >= zero) & (t >= zero) & (s + t <= one)
        qx, qy, qz = ax + s * ux + t * wx, ay + s * uy + t * wy, az + s * uz + t * wz
        # the closest points of the edges
        s, t = min(max(ua / (uu + tiny), zero), one), min(max(wa / (ww + tiny), zero), one)
        r = min(max(-(ex * bx + ey * by + ez * bz) / (ex * ex + ey * ey + ez * ez + tiny), zero), one)
        fx, fy, fz = ax + s * ux, ay + s * uy, az + s * uz
        gx, gy, gz = ax + t * wx, ay + t * wy, az + t * wz
        hx, hy, hz = bx + r * ex, by + r * ey, bz + r * ez
        f, g, h = fx * fx + fy * fy + fz * fz, gx * gx + gy * gy + gz * gz, hx * hx + hy * hy + hz * hz
        on_f, on_g = (f <= g) & (f <= h), g <= h
        nx = qx if inside else (fx if on_f else (gx if on_g else hx))
        ny = qy if inside else (fy if on_f else (gy if on_g else hy))
        nz = qz if inside else (fz if on_f else (gz if on_g else hz))
        scale = one / np.sqrt(nx * nx + ny * ny + nz * nz + tiny * tiny)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        # the least of the corners along it
        na, nb, nc = nx * ax + ny * ay + nz * az, nx * bx + ny * by + nz * bz, nx * cx + ny * cy + nz * cz
        bound = min(na, min(nb, nc))
        lower[m] = bound * safe - lost - (extra[v] + max(extra[i], max(extra[j], extra[k])))


@inlined
def _keep(pairs, lower, number, reach):
    """Keep those of a batch that may be within reach, in their order.  Returns how many; what is not a number is kept."""
    kept = 0
    for m in range(number):
        # written without a branch: the next one takes the place of one that is ruled out
        pairs[0, kept], pairs[1, kept], pairs[2, kept] = pairs[0, m], pairs[1, m], pairs[2, m]
        kept += not lower[m] >= reach
    return kept


@uncounted
def keep_vertices(number, reach, extent, triangles, near, pairs, ends, lower):
    """Of the first ``number`` vertices and triangles of a batch, keep those that may be within reach [m].  Returns how many.

    reach: without the extras.  extent, near: see ``round_positions``.  pairs, ends, lower: see ``query_scratch.QueryScratch``.
    """
    for m in range(number):
        t = pairs[1, m]
        ends[0, m], ends[1, m], ends[2, m], ends[3, m] = pairs[0, m], triangles[t, 0], triangles[t, 1], triangles[t, 2]
    _bound_vertices(
        near[0], near[1], near[2], near[N_EXTRA], ends[0], ends[1], ends[2], ends[3], np.float32(ROUNDING * extent), lower[:number]
    )
    return _keep(pairs, lower, number, np.float32(reach * UPWARDS))


@uncounted
def keep_edges(number, reach, extent, edges, near, pairs, ends, lower):
    """The same for two edges."""
    for m in range(number):
        e, f = pairs[0, m], pairs[1, m]
        ends[0, m], ends[1, m], ends[2, m], ends[3, m] = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
    _bound_edges(
        near[0], near[1], near[2], near[N_EXTRA], ends[0], ends[1], ends[2], ends[3], np.float32(ROUNDING * extent), lower[:number]
    )
    return _keep(pairs, lower, number, np.float32(reach * UPWARDS))

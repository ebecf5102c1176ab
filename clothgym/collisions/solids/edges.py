"""Directions in which solids push a coarse sheet at their edges.

Cloth that is drawn over an edge turns in a small arc, and the edge pushes it along the bisector of what comes and what goes: both
tensions are then equal, but for friction.  A sheet of triangles turns at its particles alone.  If the edge pushed along the normal
of the triangle that it touches, the sheet would have to climb over it triangle by triangle, and where friction holds the particle
below the edge it would jam: a pull along the triangle presses that particle to the side of the solid.  (The finite element method
meets the same where one faceted surface slides on another, and takes smoothed normals: Puso and Laursen 2004, A mortar
segment-to-segment contact method for large deformation solid mechanics, section 1.)

So distances are measured along the solid's normal n, and impulses act along a direction e of their own, see ``contact_law``.  It is
the normal of the smoothed sheet, interpolated between normals at its particles, as far as the solid has normals of that direction
nearby: e lies between the solid's normals at two corners of one triangle.  On a flat side, in a hollow, at spheres and capsules,
and where the sheet does not lie along the edge, as it does not at a corner of a box, e is n.

A push along e can do work, which over a whole row of triangles adds up to nothing; at rest it may keep a sheet trembling.  So
particles that are pushed so also have a small drag.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, uncounted

WIDE = 0.71  # cosine of the angle between the solid's normals at two corners beyond which an edge is between them: 45 degrees
ASLANT = 0.3  # sine of the angle between the sheet's normal and the plane of the solid's normals beyond which e is n
EDGE_DRAG = 30.0  # rate at which particles that an edge pushes lose velocity relative to the solid [1/s]
LEAST_COSINE = 0.3  # between n and e; where it is less, e is n
# rows of scratch, one column a particle: normals of the solid, and of the sheet; the best direction so far, and its cosine with the
# sheet's normal, or UNBENT where no edge is near
E_SOLID, E_SHEET, E_PUSH, E_COSINE = 0, 3, 6, 9
EDGE_ROWS = 10
UNBENT = 2.0
# no point of a triangle is farther from all corners than this share of its longest side (1/sqrt(3) if equilateral)
NEAREST = 0.58


@inlined
def _bent(r, normals, i, j):
    """Whether a convex edge of the solid is between particles i and j: each is behind the solid's tangent at the other."""
    cosine = normals[0, i] * normals[0, j] + normals[1, i] * normals[1, j] + normals[2, i] * normals[2, j]
    if not cosine < r.dtype.type(WIDE):
        return False
    dx, dy, dz = r[0, j] - r[0, i], r[1, j] - r[1, i], r[2, j] - r[2, i]
    behind_i = dx * normals[0, i] + dy * normals[1, i] + dz * normals[2, i]
    behind_j = dx * normals[0, j] + dy * normals[1, j] + dz * normals[2, j]
    return (behind_i <= 0) & (behind_j >= 0)


@inlined
def _square(r, i, j):
    """Squared distance of particles i and j [m^2]."""
    dx, dy, dz = r[0, j] - r[0, i], r[1, j] - r[1, i], r[2, j] - r[2, i]
    return dx * dx + dy * dy + dz * dz


@inlined
def _between(sx, sy, sz, ax, ay, az, bx, by, bz, zero, aslant2):
    """The unit vector between unit vectors a and b that is closest to s, in their plane; a, where s is too far from that plane.

    aslant2: the least square of the part of s in the plane, over that of s.
    """
    # t: at right angles to a, towards b; b = cosine a + sine t
    cosine = ax * bx + ay * by + az * bz
    tx, ty, tz = bx - cosine * ax, by - cosine * ay, bz - cosine * az
    sine = np.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx / sine, ty / sine, tz / sine
    # s in the plane
    u, v = sx * ax + sy * ay + sz * az, sx * tx + sy * ty + sz * tz
    length = np.sqrt(u * u + v * v)
    if v <= zero or not u * u + v * v > aslant2 * (sx * sx + sy * sy + sz * sz):
        return ax, ay, az
    if cosine * v > sine * u:
        return bx, by, bz
    u, v = u / length, v / length
    return u * ax + v * tx, u * ay + v * ty, u * az + v * tz


@uncounted
def _add_sheet_normals(r, triangles, normals):
    """Unit normals of the sheet at its particles, to three rows: the sums over their triangles, weighted by area."""
    zero, one = r.dtype.type(0), r.dtype.type(1)
    normals[:] = zero
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = r[0, j] - r[0, i], r[1, j] - r[1, i], r[2, j] - r[2, i]
        bx, by, bz = r[0, k] - r[0, i], r[1, k] - r[1, i], r[2, k] - r[2, i]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for c in range(3):
            normals[0, triangles[t, c]] += nx
            normals[1, triangles[t, c]] += ny
            normals[2, triangles[t, c]] += nz
    for p in range(normals.shape[1]):
        length = np.sqrt(normals[0, p] * normals[0, p] + normals[1, p] * normals[1, p] + normals[2, p] * normals[2, p])
        scale = one / length if length > zero else zero
        normals[0, p] *= scale
        normals[1, p] *= scale
        normals[2, p] *= scale


@inlined
def _turn_particle(rows, i, j):
    """Turn the direction at particle i towards the sheet's normal, as far as the solid's normal at particle j."""
    zero, one, aslant2 = rows.dtype.type(0), rows.dtype.type(1), rows.dtype.type(1 - ASLANT * ASLANT)
    nx, ny, nz = rows[E_SOLID, i], rows[E_SOLID + 1, i], rows[E_SOLID + 2, i]
    sx, sy, sz = rows[E_SHEET, i], rows[E_SHEET + 1, i], rows[E_SHEET + 2, i]
    # either side of the sheet may face the solid
    side = one if sx * nx + sy * ny + sz * nz >= zero else -one
    sx, sy, sz = side * sx, side * sy, side * sz
    if rows[E_COSINE, i] == UNBENT:
        rows[E_PUSH, i], rows[E_PUSH + 1, i], rows[E_PUSH + 2, i] = nx, ny, nz
        rows[E_COSINE, i] = sx * nx + sy * ny + sz * nz
    ex, ey, ez = _between(sx, sy, sz, nx, ny, nz, rows[E_SOLID, j], rows[E_SOLID + 1, j], rows[E_SOLID + 2, j], zero, aslant2)
    cosine = sx * ex + sy * ey + sz * ez
    if cosine > rows[E_COSINE, i]:
        rows[E_PUSH, i], rows[E_PUSH + 1, i], rows[E_PUSH + 2, i] = ex, ey, ez
        rows[E_COSINE, i] = cosine


@uncounted
def find_edges(r, triangles, near, rows, out, within, bent):
    """Find the triangles that lie across an edge of the solid, and the directions in which it pushes their corners.

    r: positions [m], (3, particles).  near: triangles that may be near, (near,).  rows: (EDGE_ROWS, particles) with the solid's
    normals at all particles; the rest is written.
    out: signed distances of the particles from the solid [m]; only triangles that may come closer than ``within`` count.
    bent: becomes these triangles, (triangles,).  Returns how many.
    """
    normals, number, nearest2 = rows[E_SOLID : E_SOLID + 3], 0, r.dtype.type(NEAREST * NEAREST)
    for m in range(near.shape[0]):
        t = near[m]
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        # no point of the triangle is farther from all corners than NEAREST of its longest side
        beyond = min(out[i], min(out[j], out[k])) - within
        if beyond > 0:
            longest = max(_square(r, i, j), max(_square(r, j, k), _square(r, k, i)))
            if beyond * beyond > nearest2 * longest:
                continue
        if _bent(r, normals, i, j) or _bent(r, normals, j, k) or _bent(r, normals, k, i):
            bent[number] = t
            number += 1
    if number == 0:
        return 0
    # the directions at the particles, each the best of those between two corners of a triangle
    _add_sheet_normals(r, triangles, rows[E_SHEET : E_SHEET + 3])
    rows[E_COSINE] = UNBENT
    for n in range(number):
        for c in range(3):
            i, j = triangles[bent[n], c], triangles[bent[n], (c + 1) % 3]
            if _bent(r, normals, i, j):
                _turn_particle(rows, i, j)
                _turn_particle(rows, j, i)
    return number


@uncounted
def push_of_touch(r, triangle, weights, nx, ny, nz, rows):
    """The direction e in which a solid pushes a point of a triangle, with barycentric ``weights``, (3,), and normal of contact n.

    rows: as ``find_edges`` has left them.  Returns its three components; n where no edge is near.
    """
    zero, one, normals = r.dtype.type(0), r.dtype.type(1), rows[E_SOLID : E_SOLID + 3]
    aslant2 = r.dtype.type(1 - ASLANT * ASLANT)
    ex, ey, ez = nx, ny, nz
    # the smoothed sheet's normal
    sx, sy, sz = zero, zero, zero
    for c in range(3):
        sx += weights[c] * rows[E_SHEET, triangle[c]]
        sy += weights[c] * rows[E_SHEET + 1, triangle[c]]
        sz += weights[c] * rows[E_SHEET + 2, triangle[c]]
    side = one if sx * nx + sy * ny + sz * nz >= zero else -one
    sx, sy, sz = side * sx, side * sy, side * sz
    # the best direction between the solid's normals at two corners
    best = -one
    for c in range(3):
        i, j = triangle[c], triangle[(c + 1) % 3]
        if _bent(r, normals, i, j):
            tx, ty, tz = _between(
                sx,
                sy,
                sz,
                normals[0, i],
                normals[1, i],
                normals[2, i],
                normals[0, j],
                normals[1, j],
                normals[2, j],
                zero,
                aslant2,
            )
            # the triangle, too, must lie along the edge, whose direction is at right angles to both normals
            bx = normals[1, i] * normals[2, j] - normals[2, i] * normals[1, j]
            by = normals[2, i] * normals[0, j] - normals[0, i] * normals[2, j]
            bz = normals[0, i] * normals[1, j] - normals[1, i] * normals[0, j]
            along = nx * bx + ny * by + nz * bz
            cosine = sx * tx + sy * ty + sz * tz
            if cosine > best and along * along < r.dtype.type(ASLANT * ASLANT) * (bx * bx + by * by + bz * bz):
                best, ex, ey, ez = cosine, tx, ty, tz
    return ex, ey, ez

"""What touches do: the sheet between its particles is borne, pushed out and held by friction.

Until the next search (see ``triangle_contact``) a touch stands for a ball in the solid that moves with it.  Its core is the point
from which the search found the deepest point of the triangle: for a sphere the center, for a capsule a point of its axis.  In every
substep the triangle's point closest to the core is the touch, the direction to it the normal, and its distance less the ball's
radius the gap.  (Where these stay as they were found, a triangle that rolls on a ball swings up: its support lags behind.)  At a
mesh, whose edges may be sharper than any ball, they stay.

A touch keeps its impulse from substep to substep: that is applied again (a warm start), and then corrected, one touch after the
other (projected Gauss-Seidel; ``contact_law.touch_change``).  So what lies on a solid comes to rest, although touches share
corners.  The corners of the triangle share an impulse by barycentric weight times inverse mass.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.solids.contact_law import FASTEST, RELAXED, touch_change
from clothgym.collisions.solids.deepest_point import to_triangle
from clothgym.collisions.solids.edges import LEAST_COSINE
from clothgym.collisions.solids.shapes import R_FRICTION, R_POINT, R_REMAINDER, R_VELOCITY
from clothgym.collisions.solids.signed_distance import S_CONTACT, S_CORE, S_CORNERS, S_RHO, S_SPOT, S_WEIGHTS

# columns of a touch: three weights; offset of its plane from the solid's point along the normal; normal; impulse [N s]; the ball's
# core relative to the solid's point [m]; the ball's radius [m], not positive where weights and plane stay as they were found; the
# direction in which impulses act, see ``edges``
T_WEIGHTS, T_OFFSET, T_NORMAL, T_IMPULSE, T_CORE, T_RHO, T_PUSH = 0, 3, 4, 7, 10, 13, 14
TOUCH_COLUMNS = 17


@kernel
def move_solids(colliders, h):
    """Move each solid by its velocity for a substep h [s], with compensated summation (see ``integrators.base``).

    colliders: rows, (colliders, COLLIDER_ROWS, lanes).
    """
    for k in range(colliders.shape[0]):
        for c in range(3):
            for l in range(colliders.shape[2]):
                point = colliders[k, R_POINT + c, l]
                change = h * colliders[k, R_VELOCITY + c, l] + colliders[k, R_REMAINDER + c, l]
                now = point + change
                colliders[k, R_REMAINDER + c, l] = change - (now - point)
                colliders[k, R_POINT + c, l] = now


@inlined
def _to_ball(scratch):
    """The triangle's point closest to the core: its weights to S_WEIGHTS; the plane there, by its offset from the solid's point
    along the normal, and the normal to S_CONTACT.
    """
    to_triangle(scratch)
    one, tiny = scratch.dtype.type(1), scratch.dtype.type(1e-18)
    for l in range(scratch.shape[1]):
        px, py, pz = scratch[S_SPOT, l], scratch[S_SPOT + 1, l], scratch[S_SPOT + 2, l]
        dx, dy, dz = px - scratch[S_CORE, l], py - scratch[S_CORE + 1, l], pz - scratch[S_CORE + 2, l]
        length = np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
        scale = one / length
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        scratch[S_CONTACT, l] = length - scratch[S_RHO, l] - (dx * px + dy * py + dz * pz)
        scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l] = dx, dy, dz


@uncounted
def follow_touches(r, triangles, colliders, touches, which, scratch):
    """Write weights and planes of the touches for positions r [m], (3, particles), as many at a time as the scratch has columns.

    touches: (touches, TOUCH_COLUMNS).  which: triangle and solid of each, (touches, 2).
    """
    number, columns = touches.shape[0], scratch.shape[1]
    for begin in range(0, number, columns):
        # corners relative to the solids' points, and the balls; the last touch fills the columns that are left
        for l in range(columns):
            n = min(begin + l, number - 1)
            t, k = which[n, 0], which[n, 1]
            for e in range(3):
                point = colliders[k, R_POINT + e, 0]
                for corner in range(3):
                    scratch[S_CORNERS + 3 * corner + e, l] = r[e, triangles[t, corner]] - point
                scratch[S_CORE + e, l] = touches[n, T_CORE + e]
            scratch[S_RHO, l] = touches[n, T_RHO]
        _to_ball(scratch)
        for l in range(min(columns, number - begin)):
            touch = touches[begin + l]
            if touch[T_RHO] <= 0:
                continue
            for e in range(3):
                touch[T_WEIGHTS + e] = scratch[S_WEIGHTS + e, l]
            for e in range(4):
                touch[T_OFFSET + e] = scratch[S_CONTACT + e, l]


@inlined
def _move_corners(r, s, m, triangle, touch, dx, dy, dz, ux, uy, uz):
    """Move a triangle's corners by w_i b_i d [m], and change their velocities by w_i b_i u [m/s]."""
    for c in range(3):
        p = triangle[c]
        share = m[p] * touch[T_WEIGHTS + c]
        r[0, p] += share * dx
        r[1, p] += share * dy
        r[2, p] += share * dz
        s[0, p] += share * ux
        s[1, p] += share * uy
        s[2, p] += share * uz


@uncounted
def warm_start_touches(r, s, m, triangles, touches, which, lead):
    """Apply the touches' impulses j again: v_i += w_i b_i j, x_i += w_i b_i lead j.

    r: positions x [m], s: velocities v [m/s], (3, particles).  m: inverse masses w [1/kg], (particles,).  lead: time for which
    the velocity has already moved the positions [s].
    """
    for n in range(touches.shape[0]):
        jx, jy, jz = touches[n, T_IMPULSE], touches[n, T_IMPULSE + 1], touches[n, T_IMPULSE + 2]
        if jx != 0 or jy != 0 or jz != 0:
            _move_corners(r, s, m, triangles[which[n, 0]], touches[n], lead * jx, lead * jy, lead * jz, jx, jy, jz)


@uncounted
def solve_touches(r, s, m, triangles, colliders, touches, which, h, lead):
    """Correct the touches' impulses, one after the other; h: the substep [s], the rest as in ``warm_start_touches``."""
    zero, one = r.dtype.type(0), r.dtype.type(1)
    most_speed, relaxed, least_cosine = r.dtype.type(FASTEST), r.dtype.type(RELAXED), r.dtype.type(LEAST_COSINE)
    for n in range(touches.shape[0]):
        # the touch, and the signed distance of its point from its plane
        touch, triangle, c = touches[n], triangles[which[n, 0]], colliders[which[n, 1]]
        i, j, k = triangle[0], triangle[1], triangle[2]
        a, b, d = touch[T_WEIGHTS], touch[T_WEIGHTS + 1], touch[T_WEIGHTS + 2]
        gap, nx, ny, nz = touch[T_OFFSET], touch[T_NORMAL], touch[T_NORMAL + 1], touch[T_NORMAL + 2]
        gap += nx * (a * r[0, i] + b * r[0, j] + d * r[0, k] - c[R_POINT, 0])
        gap += ny * (a * r[1, i] + b * r[1, j] + d * r[1, k] - c[R_POINT + 1, 0])
        gap += nz * (a * r[2, i] + b * r[2, j] + d * r[2, k] - c[R_POINT + 2, 0])
        jx, jy, jz = touch[T_IMPULSE], touch[T_IMPULSE + 1], touch[T_IMPULSE + 2]
        if not (gap < zero or jx != zero or jy != zero or jz != zero):
            continue
        # velocity of the point relative to the solid, and its inverse mass
        ux = a * s[0, i] + b * s[0, j] + d * s[0, k] - c[R_VELOCITY, 0]
        uy = a * s[1, i] + b * s[1, j] + d * s[1, k] - c[R_VELOCITY + 1, 0]
        uz = a * s[2, i] + b * s[2, j] + d * s[2, k] - c[R_VELOCITY + 2, 0]
        inverse_mass = m[i] * a * a + m[j] * b * b + m[k] * d * d
        # the direction in which it pushes, its new impulse, and what the change moves
        ex, ey, ez = touch[T_PUSH], touch[T_PUSH + 1], touch[T_PUSH + 2]
        if not ex * nx + ey * ny + ez * nz > least_cosine:
            ex, ey, ez = nx, ny, nz
        px, py, pz, dx, dy, dz, qx, qy, qz = touch_change(
            gap, nx, ny, nz, ex, ey, ez, ux, uy, uz, jx, jy, jz, inverse_mass, c[R_FRICTION, 0], h, lead, zero, one, most_speed,
            relaxed,
        )  # fmt: skip
        touch[T_IMPULSE], touch[T_IMPULSE + 1], touch[T_IMPULSE + 2] = px, py, pz
        _move_corners(r, s, m, triangle, touch, lead * dx + qx, lead * dy + qy, lead * dz + qz, dx, dy, dz)

"""Points that are moved from outside, as hands are, and may not enter solids.

A point goes its way until something is in it; at a surface, without the thickness that cloth keeps, it loses the part of its way
that leads inward, and slides on with the rest.  Solids that move push it.  What is in a solid already may stay as deep as it is.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, kernel
from clothgym.collisions.solids.shapes import COLLIDER_ROWS, R_THICKNESS, R_VELOCITY
from clothgym.collisions.solids.signed_distance import S_CONTACT, S_SPOT, lay_out, measure, normal_to_world, to_axes

STEPS = 20  # along the way of a point, at most
SHORTEST = 1 / 16  # of the way is gone in a step at least: a wall that is thinner may be missed
AT_SURFACE = 1e-5  # [m]: nearer than this is at the surface


@kernel
def _room(x, collider, shapes, k, lane, spent, point, rows, scratch):
    """Distance of a point from one lane's solid, without its thickness [m]; its normal is left in S_CONTACT + 1 and on.

    spent: for how long the solid has moved [s].  point, rows, scratch: scratch, (3, 1, 1), (COLLIDER_ROWS, 1) and (SCRATCH_ROWS,
    1).
    """
    for r in range(COLLIDER_ROWS):
        rows[r, 0] = collider[r, lane]
    lay_out(rows, scratch)
    for c in range(3):
        point[c, 0, 0] = x[c] - spent * rows[R_VELOCITY + c, 0]
    to_axes(point, 0, scratch, S_SPOT)
    measure(scratch, S_SPOT, shapes, k, x.dtype.type(np.inf))
    normal_to_world(scratch)
    return scratch[S_CONTACT, 0] + scratch[R_THICKNESS, 0]


@apart
def stop_at_solids(x, way, colliders, shapes, lane, time_step, point, rows, scratch):
    """Take one point along its way, in which solids may be; return whether they changed it.

    x: where it is [m], (3,), moved on.  way: what it has to go, and then what it has gone [m], (3,).  colliders: rows of a block,
    (colliders, COLLIDER_ROWS, lanes).  point, rows, scratch: scratch, see ``_room``.
    """
    zero, one = x.dtype.type(0), x.dtype.type(1)
    touching, shortest = x.dtype.type(AT_SURFACE), x.dtype.type(SHORTEST)
    start_x, start_y, start_z = x[0], x[1], x[2]
    changed, deepest, done = False, zero, zero
    for n in range(STEPS + 1):
        step = one - done
        vx, vy, vz = way[0], way[1], way[2]
        for k in range(colliders.shape[0]):
            room = _room(x, colliders[k], shapes, k, lane, done * time_step, point, rows, scratch)
            nx, ny, nz = scratch[S_CONTACT + 1, 0], scratch[S_CONTACT + 2, 0], scratch[S_CONTACT + 3, 0]
            if n == 0:
                deepest = min(deepest, room)
            elif room < deepest:
                changed = True
                x[0] += (deepest - room) * nx
                x[1] += (deepest - room) * ny
                x[2] += (deepest - room) * nz
            rx = vx - rows[R_VELOCITY, 0] * time_step
            ry = vy - rows[R_VELOCITY + 1, 0] * time_step
            rz = vz - rows[R_VELOCITY + 2, 0] * time_step
            if room > touching:  # nothing is nearer than the distance
                closing = np.sqrt(rx * rx + ry * ry + rz * rz)
                if closing * step > room:
                    step = min(step, max(room / closing, shortest))
                continue
            inward = rx * nx + ry * ny + rz * nz
            if inward < zero:
                vx, vy, vz = vx - inward * nx, vy - inward * ny, vz - inward * nz
                if done < one:
                    changed = True
                    step = min(step, shortest)
        if done >= one or n == STEPS:
            break
        x[0] += vx * step
        x[1] += vy * step
        x[2] += vz * step
        done += step
    if changed:
        way[0], way[1], way[2] = x[0] - start_x, x[1] - start_y, x[2] - start_z
    return changed


@apart
def keep_out(start, way, colliders, shapes, lane, time_step, point, rows, scratch):
    """Change a way so that a point which goes it from ``start``, (3,), ends no deeper in any solid than it began.

    Return whether it was changed; the others are as for ``stop_at_solids``.
    """
    zero = start.dtype.type(0)
    end = np.empty(3, start.dtype)
    changed = False
    for k in range(colliders.shape[0]):
        before = min(_room(start, colliders[k], shapes, k, lane, zero, point, rows, scratch), zero)
        for c in range(3):
            end[c] = start[c] + way[c]
        lacking = before - _room(end, colliders[k], shapes, k, lane, time_step, point, rows, scratch)
        if lacking > start.dtype.type(AT_SURFACE):
            changed = True
            for c in range(3):
                way[c] += lacking * scratch[S_CONTACT + 1 + c, 0]
    return changed

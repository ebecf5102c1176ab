"""Contact with solids of attachments, and of what they take along: points that are moved from outside, and stop at surfaces.

A point follows its displacement until it meets a solid.  At the surface, without the thickness that cloth keeps, it loses the
inward part of what remains, and slides on with the rest.  Solids that move push it along.  A point that starts inside a solid may
stay as deep as it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, kernel
from clothgym.collisions.solids.shapes import COLLIDER_ROWS, R_THICKNESS, R_VELOCITY
from clothgym.collisions.solids.signed_distance import S_CONTACT, S_SPOT, SCRATCH_ROWS, lay_out, measure, normal_to_world, to_axes

STEPS = 20  # largest number of steps along a displacement
SHORTEST = 1 / 16  # least share of the displacement in a step: a thinner wall may be missed
AT_SURFACE = 1e-5  # distance below which a point is at the surface [m]
FAR = 4.0  # square of the ways to a solid beyond which it is not looked at again: distances between cells may rise faster than ways


class Probe(NamedTuple):
    """Scratch for one point in one lane.

    Of the caller: start, way, a point and its displacement; tried, another displacement [m], all (3,).  Of ``keep_out`` and
    ``stop_at_solids``: end, where the point ends [m], (3,); point, rows, scratch, for the distance to a solid, (3, 1, 1),
    (COLLIDER_ROWS, 1) and (SCRATCH_ROWS, 1).
    """

    start: NDArray
    way: NDArray
    tried: NDArray
    end: NDArray
    point: NDArray
    rows: NDArray
    scratch: NDArray


@kernel
def probe_of(x):
    """A ``Probe`` in the dtype of an array."""
    real = x.dtype
    return Probe(
        np.empty(3, real), np.empty(3, real), np.empty(3, real), np.empty(3, real), np.empty((3, 1, 1), real),
        np.empty((COLLIDER_ROWS, 1), real), np.empty((SCRATCH_ROWS, 1), real),
    )  # fmt: skip


@kernel
def _distance(x, collider, shapes, k, lane, spent, probe):
    """Distance of a point from the solid of one lane, without its thickness [m]; the normal is left in S_CONTACT + 1 and on.

    x: the point [m], (3,).  spent: time for which the solid has moved [s].
    """
    point, rows, scratch = probe.point, probe.rows, probe.scratch
    # the solid's rows, and the point relative to where it has moved
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
def stop_at_solids(x, way, colliders, shapes, lane, time_step, probe):
    """Move a point by a displacement, and stop it at solids.  Returns whether they changed its way.

    x: where the point is [m], (3,); becomes where it ends.  way: its displacement in this control step [m], (3,); becomes the
    actual one.
    colliders: rows of a block, (colliders, COLLIDER_ROWS, lanes).  time_step: [s].  probe: scratch, a ``Probe``.
    """
    rows, scratch = probe.rows, probe.scratch
    zero, one = x.dtype.type(0), x.dtype.type(1)
    touching, shortest = x.dtype.type(AT_SURFACE), x.dtype.type(SHORTEST)
    start_x, start_y, start_z = x[0], x[1], x[2]
    changed, deepest, done = False, zero, zero
    # conservative advancement: no step is longer than the distance to a solid at the speed of approach
    for n in range(STEPS + 1):
        step = one - done
        vx, vy, vz = way[0], way[1], way[2]
        for k in range(colliders.shape[0]):
            distance = _distance(x, colliders[k], shapes, k, lane, done * time_step, probe)
            nx, ny, nz = scratch[S_CONTACT + 1, 0], scratch[S_CONTACT + 2, 0], scratch[S_CONTACT + 3, 0]
            # a point that starts inside may stay as deep; later, one that has become deeper is pushed back
            if n == 0:
                deepest = min(deepest, distance)
            elif distance < deepest:
                changed = True
                x[0] += (deepest - distance) * nx
                x[1] += (deepest - distance) * ny
                x[2] += (deepest - distance) * nz
            # displacement relative to the solid
            rx = vx - rows[R_VELOCITY, 0] * time_step
            ry = vy - rows[R_VELOCITY + 1, 0] * time_step
            rz = vz - rows[R_VELOCITY + 2, 0] * time_step
            # away from the surface: shorten the step
            if distance > touching:
                closing = np.sqrt(rx * rx + ry * ry + rz * rz)
                if closing * step > distance:
                    step = min(step, max(distance / closing, shortest))
                continue
            # at the surface: lose the inward part, and go on in short steps
            inward = rx * nx + ry * ny + rz * nz
            if inward < zero:
                vx, vy, vz = vx - inward * nx, vy - inward * ny, vz - inward * nz
                if done < one:
                    changed = True
                    step = min(step, shortest)
        # take the step
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
def keep_out(start, way, colliders, shapes, lane, time_step, tolerance, probe):
    """Change a displacement so that a point which starts at ``start``, (3,) [m], ends no deeper in any solid than it began.

    Returns whether it was changed.  tolerance: how much deeper it may end [m]; up to AT_SURFACE it always may be.  The other
    arguments are those of ``stop_at_solids``.
    """
    zero, at_surface = start.dtype.type(0), start.dtype.type(AT_SURFACE)
    end, rows, scratch = probe.end, probe.rows, probe.scratch
    changed = False
    for k in range(colliders.shape[0]):
        # depth before; a solid that is farther away than twice the way to it cannot be met
        before = _distance(start, colliders[k], shapes, k, lane, zero, probe)
        length2 = zero
        for c in range(3):
            relative = way[c] - time_step * rows[R_VELOCITY + c, 0]
            length2 += relative * relative
        if before > zero and before * before > FAR * length2:
            continue
        # and after
        for c in range(3):
            end[c] = start[c] + way[c]
        after = _distance(end, colliders[k], shapes, k, lane, time_step, probe)
        lacking = min(before, zero) - after
        # push the end out by the difference
        if lacking > tolerance and after < -at_surface:
            changed = True
            for c in range(3):
                way[c] += lacking * scratch[S_CONTACT + 1 + c, 0]
    return changed

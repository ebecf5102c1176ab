"""Contact of the sheet between its particles: a small sphere, or a box's edge, does not come through a triangle.

For each triangle near a solid the point is sought that lies deepest in it (see ``deepest_point``).

Points are looked for from time to time (``simulation.SURFACE_INTERVAL``).  Until the next time each stands for a plane that moves
with the solid, and in every substep what has gone through its plane is pushed back, loses its inward velocity, and feels friction;
the corners of the triangle take it by their barycentric weights over their masses.  Friction must come in every substep: a sheet
that is left to itself for three creeps off a capsule within seconds, even if all that it moved is taken back on average.

Particles keep the whole thickness; the sheet between them may sink into the true surface by ``SINKS`` of the solid's least width.
Where it is fine enough for a solid its particles carry it alone, as quietly as particles do, and the points are there for what
these miss: many touches that share corners are solved one after the other, which leaves a jitter of some mm/s to cm/s.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.solids.contact_law import RELAXED, TINY, touch_change
from clothgym.collisions.solids.deepest_point import LYING, NONE, find_deepest, turn_normal
from clothgym.collisions.solids.shapes import (
    KIND_MESH,
    KIND_PLANE,
    R_FRICTION,
    R_HALF,
    R_POINT,
    R_RADIUS,
    R_REACH2,
    R_THICKNESS,
    R_VELOCITY,
)
from clothgym.collisions.solids.signed_distance import (
    S_CLEAR,
    S_CONTACT,
    S_CORE,
    S_CORNERS,
    S_MOTION,
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    S_YIELDING,
    lay_out,
    measure,
    normal_to_world,
    to_axes,
)

TOUCH_ROWS = 7  # rows of a touch: weights; gap, from the solid's point along the normal; normal
SINKS = 0.003  # of a solid's least width: how deep the sheet between its particles may lie in it


@kernel
def any_near(x, collider, scratch):
    """Whether any lane's sheet comes near the solid at all.  It only decides whether work can be skipped."""
    zero, none = x.dtype.type(0), x.dtype.type(NONE)
    for c in range(3):
        for l in range(x.shape[2]):
            scratch[S_CORNERS + c, l] = none
            scratch[S_SPOT + c, l] = -none
    for p in range(x.shape[1]):
        for c in range(3):
            for l in range(x.shape[2]):
                scratch[S_CORNERS + c, l] = min(scratch[S_CORNERS + c, l], x[c, p, l])
                scratch[S_SPOT + c, l] = max(scratch[S_SPOT + c, l], x[c, p, l])
    near = False
    for l in range(x.shape[2]):
        beyond = zero
        for c in range(3):
            at = collider[R_POINT + c, l]
            gap = max(max(scratch[S_CORNERS + c, l] - at, at - scratch[S_SPOT + c, l]), zero)
            beyond += gap * gap
        near |= beyond < collider[R_REACH2, l]
    return near


@inlined
def may_touch_triangle(scratch):
    """Whether any lane's triangle comes near the solid; its centre goes to S_SPOT, its radius to S_RHO, and to S_CLEAR whether it
    surely does not touch: its corners lie beyond one face of the box of half sides b + r, as those of cloth that lies on a box do.

    Near is the box of half sides b, all around which the distance is at most the radius.
    """
    third, zero, one = scratch.dtype.type(1 / 3), scratch.dtype.type(0), scratch.dtype.type(1)
    for l in range(scratch.shape[1]):
        ax, ay, az = scratch[S_CORNERS, l], scratch[S_CORNERS + 1, l], scratch[S_CORNERS + 2, l]
        bx, by, bz = scratch[S_CORNERS + 3, l], scratch[S_CORNERS + 4, l], scratch[S_CORNERS + 5, l]
        cx, cy, cz = scratch[S_CORNERS + 6, l], scratch[S_CORNERS + 7, l], scratch[S_CORNERS + 8, l]
        mx, my, mz = (ax + bx + cx) * third, (ay + by + cy) * third, (az + bz + cz) * third
        hx, hy, hz = scratch[R_HALF, l], scratch[R_HALF + 1, l], scratch[R_HALF + 2, l]
        radius = scratch[R_RADIUS, l]
        shrunk = radius * scratch.dtype.type(1 - LYING)
        beyond_x = max(min(ax, min(bx, cx)), -max(ax, max(bx, cx))) - hx
        beyond_y = max(min(ay, min(by, cy)), -max(ay, max(by, cy))) - hy
        beyond_z = max(min(az, min(bz, cz)), -max(az, max(bz, cz))) - hz
        clear = max(beyond_x, max(beyond_y, beyond_z)) >= shrunk
        ax, ay, az, bx, by, bz, cx, cy, cz = ax - mx, ay - my, az - mz, bx - mx, by - my, bz - mz, cx - mx, cy - my, cz - mz
        a2, b2, c2 = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
        wide = np.sqrt(max(a2, max(b2, c2)))
        ox, oy, oz = max(abs(mx) - hx, zero), max(abs(my) - hy, zero), max(abs(mz) - hz, zero)
        reach = radius + wide
        clear |= ox * ox + oy * oy + oz * oz >= reach * reach
        scratch[S_SPOT, l] = mx
        scratch[S_SPOT + 1, l] = my
        scratch[S_SPOT + 2, l] = mz
        scratch[S_RHO, l] = wide
        scratch[S_CLEAR, l] = one if clear else zero
    near = False
    for l in range(scratch.shape[1]):
        near |= scratch[S_CLEAR, l] == zero
    return near


@inlined
def _push_triangle_out(h, carried, scratch):
    """What the contact changes, per inverse mass and weight of a corner: of positions to S_SPOT, of velocities to S_MOTION."""
    zero, one = scratch.dtype.type(0), scratch.dtype.type(1)
    tiny, relaxed = scratch.dtype.type(TINY), scratch.dtype.type(RELAXED)
    for l in range(scratch.shape[1]):
        nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
        ux = scratch[S_MOTION, l] - scratch[R_VELOCITY, l]
        uy = scratch[S_MOTION + 1, l] - scratch[R_VELOCITY + 1, l]
        uz = scratch[S_MOTION + 2, l] - scratch[R_VELOCITY + 2, l]
        mx, my, mz, cx, cy, cz = touch_change(
            scratch[S_CONTACT, l],
            nx,
            ny,
            nz,
            ux,
            uy,
            uz,
            scratch[S_YIELDING, l],
            scratch[R_FRICTION, l],
            h,
            carried,
            zero,
            one,
            tiny,
            relaxed,
        )
        scratch[S_SPOT, l] = mx
        scratch[S_SPOT + 1, l] = my
        scratch[S_SPOT + 2, l] = mz
        scratch[S_MOTION, l] = cx
        scratch[S_MOTION + 1, l] = cy
        scratch[S_MOTION + 2, l] = cz


@inlined
def _move_corner(x, v, w, p, weight, scratch):
    for c in range(3):
        for l in range(scratch.shape[1]):
            x[c, p, l] += w[p, l] * weight[l] * scratch[S_SPOT + c, l]
        for l in range(scratch.shape[1]):
            v[c, p, l] += w[p, l] * weight[l] * scratch[S_MOTION + c, l]


@inlined
def _place(x, p, scratch, local):
    """A particle's place in the solid's axes."""
    to_axes(x, p, scratch, S_CORE)
    for c in range(3):
        for l in range(scratch.shape[1]):
            local[c, l] = scratch[S_CORE + c, l]


@inlined
def _fetch(rows, scratch, at):
    """Copy rows to the scratch; they lie side by side, so that one loop will do."""
    size = rows.shape[0] * rows.shape[1]
    source, target = rows.reshape(size), scratch[at : at + rows.shape[0]].reshape(size)
    for e in range(size):
        target[e] = source[e]


@kernel
def near_in_grid(scratch, shapes, k):
    """Whether any lane's triangle can reach a mesh, judged at its centre; S_CLEAR learns whose cannot."""
    measure(scratch, S_SPOT, shapes, k, scratch.dtype.type(0))
    near = False
    for l in range(scratch.shape[1]):
        if scratch[S_CONTACT, l] >= scratch[S_RHO, l]:
            scratch[S_CLEAR, l] = 1
        near |= scratch[S_CLEAR, l] == 0
    return near


@kernel
def room_for_touches(x, triangles, shapes):
    """Where ``find_touches`` writes, for one block: rows of each touch, its triangle and solid, how many there are, and scratch."""
    solids = 0
    for k in range(shapes.kinds.shape[0]):
        solids += shapes.kinds[k] != KIND_PLANE
    most = triangles.shape[0] * solids
    rows, scratch = np.empty((most, TOUCH_ROWS, x.shape[2]), x.dtype), np.empty((x.shape[1], 3, x.shape[2]), x.dtype)
    return rows, np.empty((most, 2), np.int64), np.zeros(1, np.int64), scratch


@apart
def find_touches(x, triangles, shapes, k, touches, scratch):
    """Find where one block's triangles touch the solid on the scratch, which is no plane, or soon may.

    x [m]: (3, particles, lanes); touches: as ``room_for_touches`` made them; scratch: (SCRATCH_ROWS, lanes).
    """
    rows, which, count, local = touches
    for l in range(scratch.shape[1]):
        half = min(scratch[R_HALF, l], min(scratch[R_HALF + 1, l], scratch[R_HALF + 2, l])) + scratch[R_RADIUS, l]
        scratch[R_RADIUS, l] -= scratch[R_THICKNESS, l] + scratch.dtype.type(2 * SINKS) * half
    for p in range(x.shape[1]):
        _place(x, p, scratch, local[p])
    for t in range(triangles.shape[0]):
        for c in range(3):
            _fetch(local[triangles[t, c]], scratch, S_CORNERS + 3 * c)
        if not may_touch_triangle(scratch):
            continue
        if shapes.kinds[k] == KIND_MESH and not near_in_grid(scratch, shapes, k):
            continue
        if find_deepest(scratch, shapes, k) and turn_normal(scratch):
            # the plane, as how far it is from the solid's point along the normal
            for l in range(scratch.shape[1]):
                nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
                scratch[S_CONTACT, l] -= nx * scratch[S_SPOT, l] + ny * scratch[S_SPOT + 1, l] + nz * scratch[S_SPOT + 2, l]
            normal_to_world(scratch)
            touch = rows[count[0]]
            for c in range(3):
                for l in range(scratch.shape[1]):
                    touch[c, l] = scratch[S_WEIGHTS + c, l]
            for c in range(4):
                for l in range(scratch.shape[1]):
                    touch[3 + c, l] = scratch[S_CONTACT + c, l]
            which[count[0], 0] = t
            which[count[0], 1] = k
            count[0] += 1


@apart
def press_touches(x, v, w, triangles, colliders, touches, h, carried, scratch):
    """Resolve the touches of one block.

    x [m], v [m/s]: (3, particles, lanes); w [1/kg]: (particles, lanes); h: the substep [s]; carried: how long the
    velocity that friction takes has moved the positions already [s]; scratch: (SCRATCH_ROWS, lanes).
    """
    rows, which, count, _ = touches
    solid = -1
    for n in range(count[0]):
        if which[n, 1] != solid:
            solid = which[n, 1]
            lay_out(colliders[solid], scratch)
        i, j, m = triangles[which[n, 0], 0], triangles[which[n, 0], 1], triangles[which[n, 0], 2]
        touch = rows[n]
        _fetch(touch[3:TOUCH_ROWS], scratch, S_CONTACT)
        a, b, c = touch[0], touch[1], touch[2]
        for e in range(3):
            for l in range(scratch.shape[1]):
                scratch[S_SPOT + e, l] = a[l] * x[e, i, l] + b[l] * x[e, j, l] + c[l] * x[e, m, l] - scratch[R_POINT + e, l]
        for l in range(scratch.shape[1]):
            nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
            scratch[S_CONTACT, l] += nx * scratch[S_SPOT, l] + ny * scratch[S_SPOT + 1, l] + nz * scratch[S_SPOT + 2, l]
        touching = False
        for l in range(scratch.shape[1]):
            touching |= scratch[S_CONTACT, l] < 0
        if touching:
            wi, wj, wm = w[i], w[j], w[m]
            for e in range(3):
                for l in range(scratch.shape[1]):
                    scratch[S_MOTION + e, l] = a[l] * v[e, i, l] + b[l] * v[e, j, l] + c[l] * v[e, m, l]
            for l in range(scratch.shape[1]):
                scratch[S_YIELDING, l] = wi[l] * a[l] * a[l] + wj[l] * b[l] * b[l] + wm[l] * c[l] * c[l]
            _push_triangle_out(h, carried, scratch)
            for corner in range(3):
                p = triangles[which[n, 0], corner]
                _move_corner(x, v, w, p, touch[corner], scratch)

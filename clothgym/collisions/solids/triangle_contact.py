"""Contact of the sheet between its particles: a small sphere, or the edge of a box, does not pass through a triangle.

For each triangle near a solid the point is found that lies deepest in it, its touch (see ``deepest_point``).

The search is repeated at intervals (``simulation.SURFACE_INTERVAL``).  In between, each touch stands for a plane that moves with
the solid.  In every substep a point beyond its plane is pushed back, loses its inward velocity and feels friction
(``contact_law``); the corners of the triangle share this by barycentric weight times inverse mass.  Friction must act in every
substep: a sheet that is left without it for three creeps off a capsule within seconds, even if its mean motion is taken back.

Particles keep the full thickness; between them the sheet may sink into the true surface by ``SINK`` of the solid's least width.
Where the sheet is fine enough its particles carry it alone and come to rest, and touches only catch what they miss.  Touches that
share corners are solved one after the other, which leaves a jitter of some mm/s to cm/s.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.solids.contact_law import RELAXED, TINY, touch_change
from clothgym.collisions.solids.deepest_point import LYING, NO_CONTACT, find_deepest, turn_normal
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
    S_INVERSE_MASS,
    S_MOTION,
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    lay_out,
    measure,
    normal_to_world,
    to_axes,
)

TOUCH_ROWS = 7  # rows of a touch: three weights; offset of the plane from the solid's point along the normal; normal
SINK = 0.003  # depth that the sheet between its particles may sink in, as a share of the solid's least width


@kernel
def may_touch_sheet(x, collider, scratch):
    """Whether the bounding box of any lane's sheet comes near the solid; only used to skip work."""
    zero, none = x.dtype.type(0), x.dtype.type(NO_CONTACT)
    # the bounding box: its lower corner in S_CORNERS, its upper one in S_SPOT
    for c in range(3):
        for l in range(x.shape[2]):
            scratch[S_CORNERS + c, l] = none
            scratch[S_SPOT + c, l] = -none
    for p in range(x.shape[1]):
        for c in range(3):
            for l in range(x.shape[2]):
                scratch[S_CORNERS + c, l] = min(scratch[S_CORNERS + c, l], x[c, p, l])
                scratch[S_SPOT + c, l] = max(scratch[S_SPOT + c, l], x[c, p, l])
    # its squared distance from the solid's point
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
    """Whether any lane's triangle may touch the solid.  Its center goes to S_SPOT, its radius to S_RHO, and to S_CLEAR whether it
    surely does not touch.

    A triangle is clear if its corners lie beyond one face of the box of half sides b + r, as those of cloth that lies on a box do,
    or if its bounding sphere is farther than r from the box of half sides b.
    """
    third, zero, one = scratch.dtype.type(1 / 3), scratch.dtype.type(0), scratch.dtype.type(1)
    for l in range(scratch.shape[1]):
        # the corners and their center
        ax, ay, az = scratch[S_CORNERS, l], scratch[S_CORNERS + 1, l], scratch[S_CORNERS + 2, l]
        bx, by, bz = scratch[S_CORNERS + 3, l], scratch[S_CORNERS + 4, l], scratch[S_CORNERS + 5, l]
        cx, cy, cz = scratch[S_CORNERS + 6, l], scratch[S_CORNERS + 7, l], scratch[S_CORNERS + 8, l]
        mx, my, mz = (ax + bx + cx) * third, (ay + by + cy) * third, (az + bz + cz) * third
        # beyond one face
        hx, hy, hz = scratch[R_HALF, l], scratch[R_HALF + 1, l], scratch[R_HALF + 2, l]
        radius = scratch[R_RADIUS, l]
        shrunk = radius * scratch.dtype.type(1 - LYING)
        beyond_x = max(min(ax, min(bx, cx)), -max(ax, max(bx, cx))) - hx
        beyond_y = max(min(ay, min(by, cy)), -max(ay, max(by, cy))) - hy
        beyond_z = max(min(az, min(bz, cz)), -max(az, max(bz, cz))) - hz
        clear = max(beyond_x, max(beyond_y, beyond_z)) >= shrunk
        # bounding sphere
        ax, ay, az, bx, by, bz, cx, cy, cz = ax - mx, ay - my, az - mz, bx - mx, by - my, bz - mz, cx - mx, cy - my, cz - mz
        a2, b2, c2 = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
        bound = np.sqrt(max(a2, max(b2, c2)))
        ox, oy, oz = max(abs(mx) - hx, zero), max(abs(my) - hy, zero), max(abs(mz) - hz, zero)
        reach = radius + bound
        clear |= ox * ox + oy * oy + oz * oz >= reach * reach
        scratch[S_SPOT, l] = mx
        scratch[S_SPOT + 1, l] = my
        scratch[S_SPOT + 2, l] = mz
        scratch[S_RHO, l] = bound
        scratch[S_CLEAR, l] = one if clear else zero
    near = False
    for l in range(scratch.shape[1]):
        near |= scratch[S_CLEAR, l] == zero
    return near


@inlined
def _push_triangle_out(h, carried, scratch):
    """The contact law at a touch, per inverse mass and weight of a corner: changes of positions to S_SPOT, of velocities to
    S_MOTION.
    """
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
            scratch[S_INVERSE_MASS, l],
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
    """Move corner p by its share of the change: x_p += w_p b dx and v_p += w_p b dv, with its barycentric weight b."""
    for c in range(3):
        for l in range(scratch.shape[1]):
            x[c, p, l] += w[p, l] * weight[l] * scratch[S_SPOT + c, l]
        for l in range(scratch.shape[1]):
            v[c, p, l] += w[p, l] * weight[l] * scratch[S_MOTION + c, l]


@inlined
def _to_local(x, p, scratch, local):
    """Position of particle p in the solid's axes [m]: ``local``, (3, lanes)."""
    to_axes(x, p, scratch, S_CORE)
    for c in range(3):
        for l in range(scratch.shape[1]):
            local[c, l] = scratch[S_CORE + c, l]


@inlined
def _fetch(rows, scratch, at):
    """Copy rows to the scratch from row ``at`` on; they are contiguous, so one loop does it."""
    size = rows.shape[0] * rows.shape[1]
    source, target = rows.reshape(size), scratch[at : at + rows.shape[0]].reshape(size)
    for e in range(size):
        target[e] = source[e]


@kernel
def may_touch_mesh(scratch, shapes, k):
    """Whether any lane's triangle may touch a mesh, by the distance of its center; triangles that cannot are marked in S_CLEAR."""
    measure(scratch, S_SPOT, shapes, k, scratch.dtype.type(0))
    near = False
    for l in range(scratch.shape[1]):
        if scratch[S_CONTACT, l] >= scratch[S_RHO, l]:
            scratch[S_CLEAR, l] = 1
        near |= scratch[S_CLEAR, l] == 0
    return near


@kernel
def room_for_touches(x, triangles, shapes):
    """Arrays for the touches of one block: rows, (touches, TOUCH_ROWS, lanes); triangle and solid of each, (touches, 2); their
    number, (1,); scratch for positions, (particles, 3, lanes).
    """
    solids = 0
    for k in range(shapes.kinds.shape[0]):
        solids += shapes.kinds[k] != KIND_PLANE
    most = triangles.shape[0] * solids
    rows, scratch = np.empty((most, TOUCH_ROWS, x.shape[2]), x.dtype), np.empty((x.shape[1], 3, x.shape[2]), x.dtype)
    return rows, np.empty((most, 2), np.int64), np.zeros(1, np.int64), scratch


@apart
def find_touches(x, triangles, shapes, k, touches, scratch):
    """Find where triangles of one block touch solid k, which is not a plane, or may soon touch it.

    x: [m], (3, particles, lanes).  touches: from ``room_for_touches``.  scratch: with the solid's rows, (SCRATCH_ROWS, lanes).
    """
    rows, which, count, local = touches
    # without its thickness, and less the depth that triangles may sink in
    for l in range(scratch.shape[1]):
        half = min(scratch[R_HALF, l], min(scratch[R_HALF + 1, l], scratch[R_HALF + 2, l])) + scratch[R_RADIUS, l]
        scratch[R_RADIUS, l] -= scratch[R_THICKNESS, l] + scratch.dtype.type(2 * SINK) * half
    # all particles in the axes of the solid
    for p in range(x.shape[1]):
        _to_local(x, p, scratch, local[p])
    for t in range(triangles.shape[0]):
        # triangles that may touch it
        for c in range(3):
            _fetch(local[triangles[t, c]], scratch, S_CORNERS + 3 * c)
        if not may_touch_triangle(scratch):
            continue
        if shapes.kinds[k] == KIND_MESH and not may_touch_mesh(scratch, shapes, k):
            continue
        # the deepest point, and the normal there
        if find_deepest(scratch, shapes, k) and turn_normal(scratch):
            # the plane, by its offset from the solid's point along the normal
            for l in range(scratch.shape[1]):
                nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
                scratch[S_CONTACT, l] -= nx * scratch[S_SPOT, l] + ny * scratch[S_SPOT + 1, l] + nz * scratch[S_SPOT + 2, l]
            normal_to_world(scratch)
            # write the touch
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
    """Resolve the touches of one block, one after the other.

    x: [m], v: [m/s], (3, particles, lanes).  w: inverse masses [1/kg], (particles, lanes).  h: the substep [s].  carried: time for
    which the velocity has already moved the positions [s].  scratch: (SCRATCH_ROWS, lanes).
    """
    rows, which, count, _ = touches
    solid = -1
    for n in range(count[0]):
        # the solid, when it changes
        if which[n, 1] != solid:
            solid = which[n, 1]
            lay_out(colliders[solid], scratch)
        # the touch
        i, j, m = triangles[which[n, 0], 0], triangles[which[n, 0], 1], triangles[which[n, 0], 2]
        touch = rows[n]
        _fetch(touch[3:TOUCH_ROWS], scratch, S_CONTACT)
        a, b, c = touch[0], touch[1], touch[2]
        # its point, and the signed distance from its plane
        for e in range(3):
            for l in range(scratch.shape[1]):
                scratch[S_SPOT + e, l] = a[l] * x[e, i, l] + b[l] * x[e, j, l] + c[l] * x[e, m, l] - scratch[R_POINT + e, l]
        for l in range(scratch.shape[1]):
            nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
            scratch[S_CONTACT, l] += nx * scratch[S_SPOT, l] + ny * scratch[S_SPOT + 1, l] + nz * scratch[S_SPOT + 2, l]
        # nothing to do if it is outside in all lanes
        touching = False
        for l in range(scratch.shape[1]):
            touching |= scratch[S_CONTACT, l] < 0
        if touching:
            # velocity and inverse mass of the point
            wi, wj, wm = w[i], w[j], w[m]
            for e in range(3):
                for l in range(scratch.shape[1]):
                    scratch[S_MOTION + e, l] = a[l] * v[e, i, l] + b[l] * v[e, j, l] + c[l] * v[e, m, l]
            for l in range(scratch.shape[1]):
                scratch[S_INVERSE_MASS, l] = wi[l] * a[l] * a[l] + wj[l] * b[l] * b[l] + wm[l] * c[l] * c[l]
            # correct the corners
            _push_triangle_out(h, carried, scratch)
            for corner in range(3):
                p = triangles[which[n, 0], corner]
                _move_corner(x, v, w, p, touch[corner], scratch)

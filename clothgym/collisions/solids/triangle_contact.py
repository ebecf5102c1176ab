"""Contact of the sheet between its particles: a small sphere, or the edge of a box, does not pass through a triangle.

For each triangle near a solid the point is found that lies deepest in it, its touch (see ``deepest_point``).

The search is repeated at intervals (``simulation.SURFACE_INTERVAL``).  In between, each touch stands for a ball in the solid that
moves with it: what the touch does is in ``touch_response``.

Particles keep the full thickness; between them the sheet may sink into the true surface by ``SINK`` of the solid's least width.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.solids.deepest_point import LYING, NO_CONTACT, find_deepest, turn_normal
from clothgym.collisions.solids.shapes import (
    KIND_MESH,
    KIND_PLANE,
    R_HALF,
    R_POINT,
    R_RADIUS,
    R_REACH2,
    R_THICKNESS,
)
from clothgym.collisions.solids.signed_distance import (
    S_CLEAR,
    S_CONTACT,
    S_CORE,
    S_CORNERS,
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    measure,
    normal_to_world,
    to_axes,
)
from clothgym.collisions.solids.touch_response import (
    T_CORE,
    T_IMPULSE,
    T_NORMAL,
    T_OFFSET,
    T_RHO,
    T_WEIGHTS,
    TOUCH_ROWS,
    copy_rows,
)

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
def _to_local(x, p, scratch, local):
    """Position of particle p in the solid's axes [m]: ``local``, (3, lanes)."""
    to_axes(x, p, scratch, S_CORE)
    for c in range(3):
        for l in range(scratch.shape[1]):
            local[c, l] = scratch[S_CORE + c, l]


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
    number, (1,); impulses of each triangle at each solid [N s], (colliders, triangles, 3, lanes); scratch for positions,
    (particles, 3, lanes).
    """
    solids = 0
    for k in range(shapes.kinds.shape[0]):
        solids += shapes.kinds[k] != KIND_PLANE
    most = triangles.shape[0] * solids
    rows, scratch = np.empty((most, TOUCH_ROWS, x.shape[2]), x.dtype), np.empty((x.shape[1], 3, x.shape[2]), x.dtype)
    kept = np.zeros((shapes.kinds.shape[0], triangles.shape[0], 3, x.shape[2]), x.dtype)
    return rows, np.empty((most, 2), np.int64), np.zeros(1, np.int64), kept, scratch


@apart
def find_touches(x, triangles, shapes, k, touches, scratch):
    """Find where triangles of one block touch solid k, which is not a plane, or may soon touch it.

    x: [m], (3, particles, lanes).  touches: from ``room_for_touches``.  scratch: with the solid's rows, (SCRATCH_ROWS, lanes).
    """
    rows, which, count, kept, local = touches
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
            copy_rows(local[triangles[t, c]], scratch, S_CORNERS + 3 * c)
        if not may_touch_triangle(scratch):
            continue
        if shapes.kinds[k] == KIND_MESH and not may_touch_mesh(scratch, shapes, k):
            continue
        # the deepest point, and the normal there
        if find_deepest(scratch, shapes, k) and turn_normal(scratch):
            normal_to_world(scratch)
            # write the touch: weights, plane, the impulse that it had, and its ball
            touch = rows[count[0]]
            for l in range(scratch.shape[1]):
                touch[T_OFFSET, l] = scratch[S_CONTACT, l]
            for c in range(3):
                i, j, m = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                for l in range(scratch.shape[1]):
                    wi, wj, wm = scratch[S_WEIGHTS, l], scratch[S_WEIGHTS + 1, l], scratch[S_WEIGHTS + 2, l]
                    spot = wi * x[c, i, l] + wj * x[c, j, l] + wm * x[c, m, l] - scratch[R_POINT + c, l]
                    touch[T_WEIGHTS + c, l], touch[T_NORMAL + c, l] = scratch[S_WEIGHTS + c, l], scratch[S_CONTACT + 1 + c, l]
                    touch[T_OFFSET, l] -= scratch[S_CONTACT + 1 + c, l] * spot
                    touch[T_CORE + c, l] = spot - scratch[S_RHO, l] * scratch[S_CONTACT + 1 + c, l]
                for l in range(scratch.shape[1]):
                    touches_it = scratch[S_CONTACT, l] < scratch.dtype.type(NO_CONTACT)
                    touch[T_IMPULSE + c, l] = kept[k, t, c, l] if touches_it else scratch.dtype.type(0)
            for l in range(scratch.shape[1]):
                ball = scratch[S_RHO, l] - scratch[S_CONTACT, l]
                touch[T_RHO, l] = scratch.dtype.type(-1) if shapes.kinds[k] == KIND_MESH else ball
            which[count[0], 0] = t
            which[count[0], 1] = k
            count[0] += 1

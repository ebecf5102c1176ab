"""Contact of the sheet between its particles: a small sphere, or a box's edge, does not come through a triangle.

For each triangle near a solid the point is sought that lies deepest in it, by alternating projections (von Neumann; Bauschke and
Borwein 1996): from the point to the solid's core, which is what is left of it below a depth ``rho``, and from there back to the
triangle.  They end at the shortest way between triangle and core, which is where the triangle is deepest, and whose direction is
the normal of contact: along the triangle's own normal where an edge or a corner of the solid pokes into it, across both edges where
two of them cross.  The core of a sphere is its centre and one round is exact; that of a capsule is its segment.

The core must lie deeper than any point of the triangle: where one turns out to lie deeper than half of ``rho``, this is doubled.
But on a solid with sharp edges a point of the triangle that is nearest to the core is not quite the deepest one: the difference is
up to a fifth of ``rho``.  So ``rho`` begins at two thicknesses, which keeps that error below half of one.

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

from clothgym._jit import apart, inlined, kernel, uncounted
from clothgym.collisions.contact_law import RELAXED, TINY, touch_change
from clothgym.collisions.distance import (
    BEFORE,
    BETWEEN,
    CLEAR,
    CONTACT,
    CORE,
    CORNERS,
    MOTION,
    RHO,
    SPOT,
    WEIGHTS,
    YIELDING,
    lay_out,
    measure,
    normal_to_world,
    to_axes,
)
from clothgym.collisions.shapes import FRICTION, HALF, MESH, PLANE, POINT, RADIUS, REACH2, THICKNESS, VELOCITY

TOUCH = 7  # rows of a touch: weights; gap, from the solid's point along the normal; normal
NONE = 1e9  # [m], the gap of a lane that does not touch
MESH_ROUNDS, BOX_STEPS = 3, 8
MOST = 0.98  # of the distance is left after a round, where a leap trusts the rounds
DEPTH = 2.0  # rho over the thickness, at first
SOON = 0.25  # gap over the thickness within which a triangle may touch before the next look
SINKS = 0.003  # of a solid's least width: how deep the sheet between its particles may lie in it
CELLS = 0.75  # rho below a mesh's thickness, in cells of its grid
TOUCHING = 1e-3  # share of the radius by which cloth may be in it and yet count as lying on it
SLANT = 0.5  # the least cosine between the normals of contact and of the solid: at a box's corner it is 0.58


@kernel
def any_near(x, collider, desk):
    """Whether any lane's sheet comes near the solid at all.  It only decides whether desk can be skipped."""
    zero, none = x.dtype.type(0), x.dtype.type(NONE)
    for c in range(3):
        for l in range(x.shape[2]):
            desk[CORNERS + c, l] = none
            desk[SPOT + c, l] = -none
    for p in range(x.shape[1]):
        for c in range(3):
            for l in range(x.shape[2]):
                desk[CORNERS + c, l] = min(desk[CORNERS + c, l], x[c, p, l])
                desk[SPOT + c, l] = max(desk[SPOT + c, l], x[c, p, l])
    near = False
    for l in range(x.shape[2]):
        beyond = zero
        for c in range(3):
            at = collider[POINT + c, l]
            gap = max(max(desk[CORNERS + c, l] - at, at - desk[SPOT + c, l]), zero)
            beyond += gap * gap
        near |= beyond < collider[REACH2, l]
    return near


@inlined
def may_touch_triangle(desk):
    """Whether any lane's triangle comes near the solid; its centre goes to SPOT, its radius to RHO, and to CLEAR whether it surely
    does not touch: its corners lie beyond one face of the box of half sides b + r, as those of cloth that lies on a box do.

    Near is the box of half sides b, all around which the distance is at most the radius.
    """
    third, zero, one = desk.dtype.type(1 / 3), desk.dtype.type(0), desk.dtype.type(1)
    for l in range(desk.shape[1]):
        ax, ay, az = desk[CORNERS, l], desk[CORNERS + 1, l], desk[CORNERS + 2, l]
        bx, by, bz = desk[CORNERS + 3, l], desk[CORNERS + 4, l], desk[CORNERS + 5, l]
        cx, cy, cz = desk[CORNERS + 6, l], desk[CORNERS + 7, l], desk[CORNERS + 8, l]
        mx, my, mz = (ax + bx + cx) * third, (ay + by + cy) * third, (az + bz + cz) * third
        hx, hy, hz = desk[HALF, l], desk[HALF + 1, l], desk[HALF + 2, l]
        radius = desk[RADIUS, l]
        shrunk = radius * desk.dtype.type(1 - TOUCHING)
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
        desk[SPOT, l] = mx
        desk[SPOT + 1, l] = my
        desk[SPOT + 2, l] = mz
        desk[RHO, l] = wide
        desk[CLEAR, l] = one if clear else zero
    near = False
    for l in range(desk.shape[1]):
        near |= desk[CLEAR, l] == zero
    return near


@kernel
def to_triangle(desk):
    """Move SPOT to the point of the triangle that is nearest to CORE; its barycentric weights go to WEIGHTS."""
    zero, one, tiny = desk.dtype.type(0), desk.dtype.type(1), desk.dtype.type(1e-30)
    for l in range(desk.shape[1]):
        ax, ay, az = desk[CORNERS, l], desk[CORNERS + 1, l], desk[CORNERS + 2, l]
        bx, by, bz = desk[CORNERS + 3, l] - ax, desk[CORNERS + 4, l] - ay, desk[CORNERS + 5, l] - az
        cx, cy, cz = desk[CORNERS + 6, l] - ax, desk[CORNERS + 7, l] - ay, desk[CORNERS + 8, l] - az
        qx, qy, qz = desk[CORE, l] - ax, desk[CORE + 1, l] - ay, desk[CORE + 2, l] - az
        bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
        qb, qc = qx * bx + qy * by + qz * bz, qx * cx + qy * cy + qz * cz
        area2 = bb * cc - bc * bc
        scale = one / max(area2, tiny)
        s, t = (cc * qb - bc * qc) * scale, (bb * qc - bc * qb) * scale
        within = s >= zero and t >= zero and s + t <= one
        # the nearest points of the sides, and how much less than |q|^2 their squared distances are
        on_b = min(max(qb / max(bb, tiny), zero), one)
        on_c = min(max(qc / max(cc, tiny), zero), one)
        side = bb - bc - bc + cc
        along = qc - qb - bc + bb
        on_s = min(max(along / max(side, tiny), zero), one)
        gain_b = on_b * (qb + qb - on_b * bb)
        gain_c = on_c * (qc + qc - on_c * cc)
        gain_s = qb + qb - bb + on_s * (along + along - on_s * side)
        first = gain_b >= gain_c and gain_b >= gain_s
        second = gain_c >= gain_s
        es = on_b if first else (zero if second else one - on_s)
        et = zero if first else (on_c if second else on_s)
        s = s if within else es
        t = t if within else et
        desk[WEIGHTS, l] = one - s - t
        desk[WEIGHTS + 1, l] = s
        desk[WEIGHTS + 2, l] = t
        desk[SPOT, l] = ax + s * bx + t * cx
        desk[SPOT + 1, l] = ay + s * by + t * cy
        desk[SPOT + 2, l] = az + s * bz + t * cz


@kernel
def _to_core_of_box(desk):
    """Move CORE to the core's point nearest to SPOT: the half sides of a rounded box, less by what rho exceeds its radius."""
    zero = desk.dtype.type(0)
    for c in range(3):
        for l in range(desk.shape[1]):
            half = max(desk[HALF + c, l] - max(desk[RHO, l] - desk[RADIUS, l], zero), zero)
            desk[CORE + c, l] = min(max(desk[SPOT + c, l], -half), half)


@kernel
def _to_core_of_mesh(desk, shapes, k):
    """Move CORE to where the distance is -rho, from SPOT along the normal, twice: behind an edge the normals are two."""
    zero = desk.dtype.type(0)
    for c in range(3):
        for l in range(desk.shape[1]):
            desk[CORE + c, l] = desk[SPOT + c, l]
    for _ in range(2):
        measure(desk, CORE, shapes, k, desk.dtype.type(np.inf))
        for c in range(3):
            for l in range(desk.shape[1]):
                desk[CORE + c, l] -= max(desk[CONTACT, l] + desk[RHO, l], zero) * desk[CONTACT + 1 + c, l]


@kernel
def _some_may_touch(desk):
    """Whether any lane's triangle may touch its rounded box; CLEAR learns which surely do not.

    The plane through the box's furthest point along the way from CORE to SPOT parts it from a triangle that is all beyond.
    """
    one, tiny = desk.dtype.type(1), desk.dtype.type(1e-18)
    for l in range(desk.shape[1]):
        nx, ny, nz = desk[SPOT, l] - desk[CORE, l], desk[SPOT + 1, l] - desk[CORE + 1, l], desk[SPOT + 2, l] - desk[CORE + 2, l]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        a = desk[CORNERS, l] * nx + desk[CORNERS + 1, l] * ny + desk[CORNERS + 2, l] * nz
        b = desk[CORNERS + 3, l] * nx + desk[CORNERS + 4, l] * ny + desk[CORNERS + 5, l] * nz
        c = desk[CORNERS + 6, l] * nx + desk[CORNERS + 7, l] * ny + desk[CORNERS + 8, l] * nz
        shrunk = desk[RADIUS, l] * desk.dtype.type(1 - TOUCHING)
        furthest = desk[HALF, l] * abs(nx) + desk[HALF + 1, l] * abs(ny) + desk[HALF + 2, l] * abs(nz) + shrunk * length
        desk[CLEAR, l] = one if min(a, min(b, c)) >= furthest + tiny else desk[CLEAR, l]
    some = False
    for l in range(desk.shape[1]):
        some |= desk[CLEAR, l] == 0
    return some


@kernel
def _leap(desk):
    """Write to CORE where the last two rounds lead (Aitken's extrapolation).

    Where a long edge of the solid runs at a small angle to the triangle, rounds alone come nearer by little each.
    """
    zero, one, tiny, most = desk.dtype.type(0), desk.dtype.type(1), desk.dtype.type(1e-18), desk.dtype.type(MOST)
    for l in range(desk.shape[1]):
        fx, fy, fz = desk[BETWEEN, l], desk[BETWEEN + 1, l], desk[BETWEEN + 2, l]
        px, py, pz = fx - desk[BEFORE, l], fy - desk[BEFORE + 1, l], fz - desk[BEFORE + 2, l]
        fx, fy, fz = desk[SPOT, l] - fx, desk[SPOT + 1, l] - fy, desk[SPOT + 2, l] - fz
        ratio = (fx * px + fy * py + fz * pz) / max(px * px + py * py + pz * pz, tiny)
        ratio = min(max(ratio, zero), most)
        leap = ratio / (one - ratio)
        desk[CORE, l] = desk[SPOT, l] + leap * fx
        desk[CORE + 1, l] = desk[SPOT + 1, l] + leap * fy
        desk[CORE + 2, l] = desk[SPOT + 2, l] + leap * fz


@uncounted
def find_deepest(desk, shapes, k):
    """Find the deepest point of the triangle in CORNERS, from SPOT on, all in the solid's axes; return whether any lane may touch.

    It is left in SPOT with its weights, and the core's in CORE; CONTACT has its signed distance and the solid's normal there.
    The steps stand in loops, each kernel at one place: they are inlined, and compilation takes its time for each place.
    """
    mesh, boxes = shapes.kinds[k] == MESH, False
    for c in range(3):
        for l in range(desk.shape[1]):
            boxes |= desk[HALF + c, l] > 0
    deep = shapes.cells[k] * desk.dtype.type(CELLS)
    for l in range(desk.shape[1]):
        desk[RHO, l] = desk[THICKNESS, l] + deep if mesh else desk.dtype.type(DEPTH) * desk[THICKNESS, l]
    # a sphere's core is a point, for which one round is all there is to do; a box has two rounds and a leap, twice, and one more
    steps = MESH_ROUNDS if mesh else (BOX_STEPS if boxes else 1)
    for step in range(steps):
        leaps = boxes and not mesh and (step == 3 or step == 6)
        if leaps:
            _leap(desk)
        elif mesh:
            _to_core_of_mesh(desk, shapes, k)
        else:
            for e in range(3):
                for l in range(desk.shape[1]):
                    desk[BEFORE + e, l] = desk[BETWEEN + e, l]
                for l in range(desk.shape[1]):
                    desk[BETWEEN + e, l] = desk[SPOT + e, l]
            _to_core_of_box(desk)
        to_triangle(desk)
        if step == 0 and boxes and not mesh and not _some_may_touch(desk):
            return False
        if step == 3 or step == steps - 1:
            measure(desk, SPOT, shapes, k, desk.dtype.type(np.inf))
        if step == 3:
            for l in range(desk.shape[1]):
                desk[RHO, l] = max(desk[RHO, l], desk.dtype.type(-2) * desk[CONTACT, l])
    return True


@kernel
def turn_normal(desk):
    """Turn CONTACT's normal into that of contact, and its distance into the gap along it; return whether any lane needs it.

    A lane whose gap is wider than a part of the thickness, or which surely does not touch, has none.
    """
    zero, one, tiny, none = desk.dtype.type(0), desk.dtype.type(1), desk.dtype.type(1e-18), desk.dtype.type(NONE)
    slant, soon = desk.dtype.type(SLANT), desk.dtype.type(SOON)
    for l in range(desk.shape[1]):
        nx, ny, nz = desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
        dx = desk[SPOT, l] - desk[CORE, l]
        dy = desk[SPOT + 1, l] - desk[CORE + 1, l]
        dz = desk[SPOT + 2, l] - desk[CORE + 2, l]
        scale = one / np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        cosine = dx * nx + dy * ny + dz * nz
        usable = cosine >= slant
        desk[CONTACT + 1, l] = dx if usable else nx
        desk[CONTACT + 2, l] = dy if usable else ny
        desk[CONTACT + 3, l] = dz if usable else nz
        gap = desk[CONTACT, l] / cosine if usable else desk[CONTACT, l]
        desk[CONTACT, l] = gap if (desk[CLEAR, l] == zero) & (gap < soon * desk[THICKNESS, l]) else none
    some = False
    for l in range(desk.shape[1]):
        some |= desk[CONTACT, l] < none
    return some


@inlined
def _push_out(h, carried, desk):
    """What the contact changes, per inverse mass and weight of a corner: of positions to SPOT, of velocities to MOTION."""
    zero, one = desk.dtype.type(0), desk.dtype.type(1)
    tiny, relaxed = desk.dtype.type(TINY), desk.dtype.type(RELAXED)
    for l in range(desk.shape[1]):
        nx, ny, nz = desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
        ux = desk[MOTION, l] - desk[VELOCITY, l]
        uy = desk[MOTION + 1, l] - desk[VELOCITY + 1, l]
        uz = desk[MOTION + 2, l] - desk[VELOCITY + 2, l]
        mx, my, mz, cx, cy, cz = touch_change(
            desk[CONTACT, l], nx, ny, nz, ux, uy, uz, desk[YIELDING, l], desk[FRICTION, l], h, carried, zero, one, tiny, relaxed
        )
        desk[SPOT, l] = mx
        desk[SPOT + 1, l] = my
        desk[SPOT + 2, l] = mz
        desk[MOTION, l] = cx
        desk[MOTION + 1, l] = cy
        desk[MOTION + 2, l] = cz


@inlined
def _move_corner(x, v, w, p, weight, desk):
    for c in range(3):
        for l in range(desk.shape[1]):
            x[c, p, l] += w[p, l] * weight[l] * desk[SPOT + c, l]
        for l in range(desk.shape[1]):
            v[c, p, l] += w[p, l] * weight[l] * desk[MOTION + c, l]


@inlined
def _place(x, p, desk, local):
    """A particle's place in the solid's axes."""
    to_axes(x, p, desk, CORE)
    for c in range(3):
        for l in range(desk.shape[1]):
            local[c, l] = desk[CORE + c, l]


@inlined
def _fetch(rows, desk, at):
    """Copy rows to the desk; they lie side by side, so that one loop will do."""
    size = rows.shape[0] * rows.shape[1]
    source, target = rows.reshape(size), desk[at : at + rows.shape[0]].reshape(size)
    for e in range(size):
        target[e] = source[e]


@kernel
def near_in_grid(desk, shapes, k):
    """Whether any lane's triangle can reach a mesh, judged at its centre; CLEAR learns whose cannot."""
    measure(desk, SPOT, shapes, k, desk.dtype.type(0))
    near = False
    for l in range(desk.shape[1]):
        if desk[CONTACT, l] >= desk[RHO, l]:
            desk[CLEAR, l] = 1
        near |= desk[CLEAR, l] == 0
    return near


@kernel
def room_for_touches(x, triangles, shapes):
    """Where ``find_touches`` writes, for one block: rows of each touch, its triangle and solid, how many there are, and scratch."""
    solids = 0
    for k in range(shapes.kinds.shape[0]):
        solids += shapes.kinds[k] != PLANE
    most = triangles.shape[0] * solids
    rows, scratch = np.empty((most, TOUCH, x.shape[2]), x.dtype), np.empty((x.shape[1], 3, x.shape[2]), x.dtype)
    return rows, np.empty((most, 2), np.int64), np.zeros(1, np.int64), scratch


@apart
def find_touches(x, triangles, shapes, k, touches, desk):
    """Find where one block's triangles touch the solid on the desk, which is no plane, or soon may.

    x [m]: (3, particles, lanes); touches: as ``room_for_touches`` made them; desk: (DESK, lanes).
    """
    rows, which, count, local = touches
    for l in range(desk.shape[1]):
        half = min(desk[HALF, l], min(desk[HALF + 1, l], desk[HALF + 2, l])) + desk[RADIUS, l]
        desk[RADIUS, l] -= desk[THICKNESS, l] + desk.dtype.type(2 * SINKS) * half
    for p in range(x.shape[1]):
        _place(x, p, desk, local[p])
    for t in range(triangles.shape[0]):
        for c in range(3):
            _fetch(local[triangles[t, c]], desk, CORNERS + 3 * c)
        if not may_touch_triangle(desk):
            continue
        if shapes.kinds[k] == MESH and not near_in_grid(desk, shapes, k):
            continue
        if find_deepest(desk, shapes, k) and turn_normal(desk):
            # the plane, as how far it is from the solid's point along the normal
            for l in range(desk.shape[1]):
                nx, ny, nz = desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
                desk[CONTACT, l] -= nx * desk[SPOT, l] + ny * desk[SPOT + 1, l] + nz * desk[SPOT + 2, l]
            normal_to_world(desk)
            touch = rows[count[0]]
            for c in range(3):
                for l in range(desk.shape[1]):
                    touch[c, l] = desk[WEIGHTS + c, l]
            for c in range(4):
                for l in range(desk.shape[1]):
                    touch[3 + c, l] = desk[CONTACT + c, l]
            which[count[0], 0] = t
            which[count[0], 1] = k
            count[0] += 1


@apart
def press(x, v, w, triangles, colliders, touches, h, carried, desk):
    """Resolve the touches of one block.

    x [m], v [m/s]: (3, particles, lanes); w [1/kg]: (particles, lanes); h: the substep [s]; carried: how long the
    velocity that friction takes has moved the positions already [s]; desk: (DESK, lanes).
    """
    rows, which, count, _ = touches
    solid = -1
    for n in range(count[0]):
        if which[n, 1] != solid:
            solid = which[n, 1]
            lay_out(colliders[solid], desk)
        i, j, m = triangles[which[n, 0], 0], triangles[which[n, 0], 1], triangles[which[n, 0], 2]
        touch = rows[n]
        _fetch(touch[3:TOUCH], desk, CONTACT)
        a, b, c = touch[0], touch[1], touch[2]
        for e in range(3):
            for l in range(desk.shape[1]):
                desk[SPOT + e, l] = a[l] * x[e, i, l] + b[l] * x[e, j, l] + c[l] * x[e, m, l] - desk[POINT + e, l]
        for l in range(desk.shape[1]):
            nx, ny, nz = desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
            desk[CONTACT, l] += nx * desk[SPOT, l] + ny * desk[SPOT + 1, l] + nz * desk[SPOT + 2, l]
        touching = False
        for l in range(desk.shape[1]):
            touching |= desk[CONTACT, l] < 0
        if touching:
            wi, wj, wm = w[i], w[j], w[m]
            for e in range(3):
                for l in range(desk.shape[1]):
                    desk[MOTION + e, l] = a[l] * v[e, i, l] + b[l] * v[e, j, l] + c[l] * v[e, m, l]
            for l in range(desk.shape[1]):
                desk[YIELDING, l] = wi[l] * a[l] * a[l] + wj[l] * b[l] * b[l] + wm[l] * c[l] * c[l]
            _push_out(h, carried, desk)
            for corner in range(3):
                p = triangles[which[n, 0], corner]
                _move_corner(x, v, w, p, touch[corner], desk)

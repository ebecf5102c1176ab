"""Contact of one sheet with solids, where its particles lie side by side: as ``particle_contact`` and ``triangle_contact`` do in
lanes.

Particles are measured all at once, from the first to the last that a solid may touch.  Triangles are selected by the cells of the
grid; those that may touch are gathered ``COLUMNS`` at a time into a scratch array with one triangle in each column (see
``signed_distance``).
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, inlined, kernel, uncounted
from clothgym.collisions.solids.contact_law import TINY, contact_change
from clothgym.collisions.solids.deepest_point import NO_CONTACT, find_deepest, turn_normal
from clothgym.collisions.solids.shapes import (
    KIND_MESH,
    KIND_PLANE,
    KIND_ROUNDED_BOX,
    R_AXES,
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
    S_CORNERS,
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    SCRATCH_ROWS,
    lay_out,
    measure_mesh,
    normal_to_world,
    rounded_box,
)
from clothgym.collisions.solids.touch_response import (
    T_CORE,
    T_IMPULSE,
    T_NORMAL,
    T_OFFSET,
    T_RHO,
    T_WEIGHTS,
    TOUCH_ROWS,
    bear_touches_on_sheet,
    follow_touches_on_sheet,
    move_solids,
    press_touches_on_sheet,
)
from clothgym.collisions.solids.triangle_contact import SINK, may_touch_mesh, may_touch_triangle

COLUMNS = 32  # triangles in a scratch array
PARTICLE_ROWS = 9  # rows of scratch: positions in the solid's axes, distance and normal, how near cells are
P_LOCAL, P_GAP, P_NORMAL, P_NEAR = 0, 3, 4, 7
NEAREST = 0.58  # no point of a triangle is farther from all corners than this share of its longest side (1/sqrt(3) if equilateral)


@kernel
def room_on_sheet(x, triangles, shapes):
    """Room for contact of one sheet: touches, (most, TOUCH_ROWS), their triangles and solids, (most, 2), how many, (1,); scratch
    for particles, (PARTICLE_ROWS, particles), and triangles, (triangles,); and for ``signed_distance``, (SCRATCH_ROWS, COLUMNS);
    impulses of each triangle at each solid [N s], (colliders, triangles, 3).
    """
    solids = 0
    for k in range(shapes.kinds.shape[0]):
        solids += shapes.kinds[k] != KIND_PLANE
    most = triangles.shape[0] * solids
    return (
        np.empty((most, TOUCH_ROWS), x.dtype), np.empty((most, 2), np.int64), np.zeros(1, np.int64),
        np.empty((PARTICLE_ROWS, x.shape[1]), x.dtype), np.empty(triangles.shape[0], np.int64), np.empty((SCRATCH_ROWS, COLUMNS),
    x.dtype), np.zeros((shapes.kinds.shape[0], triangles.shape[0], 3), x.dtype), )  # fmt: skip


# --- particles ----------------------------------------------------------------------------------------------------------


@disjoint
def _heights(x, y, z, px, py, pz, nx, ny, nz, radius, gap):
    """Signed distance of particles to a plane [m]: ``gap``, (particles,).  Returns how many are below it."""
    count, zero = 0, x.dtype.type(0)
    for p in range(x.shape[0]):
        gap[p] = (x[p] - px) * nx + (y[p] - py) * ny + (z[p] - pz) * nz - radius
        count += gap[p] < zero
    return count


@disjoint
def _beyond_reach(x, y, z, px, py, pz, reach2, gap):
    """Squared distance of particles from a solid's point less its squared reach [m^2]: ``gap``.  Returns how many are within."""
    count, zero = 0, x.dtype.type(0)
    for p in range(x.shape[0]):
        dx, dy, dz = x[p] - px, y[p] - py, z[p] - pz
        gap[p] = dx * dx + dy * dy + dz * dz - reach2
        count += gap[p] < zero
    return count


@inlined
def _span(gap):
    """Range from the first to one past the last value below zero."""
    first, last = 0, gap.shape[0]
    while first < last and gap[first] >= 0:
        first += 1
    while last > first and gap[last - 1] >= 0:
        last -= 1
    return first, last


@disjoint
def _to_axis(x, y, z, px, py, pz, ax, ay, az, out):
    """Coordinates of particles along one axis of a solid [m]: ``out``, (particles,)."""
    for p in range(out.shape[0]):
        out[p] = (x[p] - px) * ax + (y[p] - py) * ay + (z[p] - pz) * az


@disjoint
def _measure_boxes(x, y, z, hx, hy, hz, radius, gap, nx, ny, nz):
    """Signed distance [m] and normal of positions in the axes of a rounded box."""
    zero, one = x.dtype.type(0), x.dtype.type(1)
    for p in range(gap.shape[0]):
        gap[p], nx[p], ny[p], nz[p] = rounded_box(x[p], y[p], z[p], hx, hy, hz, radius, zero, one)


@disjoint
def _to_world(nx, ny, nz, xx, xy, xz, yx, yy, yz, zx, zy, zz):
    """Rotate normals from a solid's axes, x, y and z, to the world's."""
    for p in range(nx.shape[0]):
        ax, ay, az = nx[p], ny[p], nz[p]
        nx[p] = ax * xx + ay * yx + az * zx
        ny[p] = ax * xy + ay * yy + az * zy
        nz[p] = ax * xz + ay * yz + az * zz


@disjoint
def _respond(x, y, z, vx, vy, vz, w, gap, nx, ny, nz, sx, sy, sz, friction, carried):
    """Apply the contact law to particles at a solid that moves with velocity s [m/s]."""
    zero, one, tiny = x.dtype.type(0), x.dtype.type(1), x.dtype.type(TINY)
    for p in range(gap.shape[0]):
        mx, my, mz, cx, cy, cz = contact_change(
            gap[p], nx[p], ny[p], nz[p], vx[p] - sx, vy[p] - sy, vz[p] - sz, w[p], friction, carried, zero, one, tiny
        )
        x[p] += mx
        y[p] += my
        z[p] += mz
        vx[p] += cx
        vy[p] += cy
        vz[p] += cz


@disjoint
def _respond_to_plane(x, y, z, vx, vy, vz, w, gap, nx, ny, nz, sx, sy, sz, friction, carried):
    """The same with one normal for all particles."""
    zero, one, tiny = x.dtype.type(0), x.dtype.type(1), x.dtype.type(TINY)
    for p in range(gap.shape[0]):
        mx, my, mz, cx, cy, cz = contact_change(
            gap[p], nx, ny, nz, vx[p] - sx, vy[p] - sy, vz[p] - sz, w[p], friction, carried, zero, one, tiny
        )
        x[p] += mx
        y[p] += my
        z[p] += mz
        vx[p] += cx
        vy[p] += cy
        vz[p] += cz


@uncounted
def _resolve_particles(r, s, m, shapes, colliders, carried, rows, scratch):
    """Resolve one sheet's particles' contacts with solids.

    r: [m], s: [m/s], (3, particles).  m: inverse masses [1/kg], (particles,).  rows, scratch: from ``room_on_sheet``.
    """
    kinds = shapes.kinds
    for k in range(kinds.shape[0]):
        c = colliders[k].reshape(colliders.shape[1])
        px, py, pz = c[R_POINT], c[R_POINT + 1], c[R_POINT + 2]
        sx, sy, sz, friction = c[R_VELOCITY], c[R_VELOCITY + 1], c[R_VELOCITY + 2], c[R_FRICTION]
        # a plane: heights, then the particles from the first to the last below it
        if kinds[k] == KIND_PLANE:
            nx, ny, nz = c[R_AXES + 6], c[R_AXES + 7], c[R_AXES + 8]
            if _heights(r[0], r[1], r[2], px, py, pz, nx, ny, nz, c[R_RADIUS], rows[P_GAP]) > 0:
                a, b = _span(rows[P_GAP])
                _respond_to_plane(
                    r[0, a:b], r[1, a:b], r[2, a:b], s[0, a:b], s[1, a:b], s[2, a:b], m[a:b], rows[P_GAP, a:b], nx, ny, nz, sx, sy,
                    sz, friction, carried,
                )  # fmt: skip
            continue
        # any other solid: particles within its reach, from the first to the last
        if _beyond_reach(r[0], r[1], r[2], px, py, pz, c[R_REACH2], rows[P_GAP]) == 0:
            continue
        a, b = _span(rows[P_GAP])
        # positions in its axes, distances and normals there
        for e in range(3):
            q = R_AXES + 3 * e
            _to_axis(r[0, a:b], r[1, a:b], r[2, a:b], px, py, pz, c[q], c[q + 1], c[q + 2], rows[P_LOCAL + e, a:b])
        gap, nx, ny, nz = rows[P_GAP, a:b], rows[P_NORMAL, a:b], rows[P_NORMAL + 1, a:b], rows[P_NORMAL + 2, a:b]
        if kinds[k] == KIND_ROUNDED_BOX:
            _measure_boxes(
                rows[P_LOCAL, a:b], rows[P_LOCAL + 1, a:b], rows[P_LOCAL + 2, a:b], c[R_HALF], c[R_HALF + 1], c[R_HALF + 2],
                c[R_RADIUS], gap, nx, ny, nz,
            )  # fmt: skip
        else:
            _measure_in_scratch(rows, a, b, colliders[k], shapes, k, scratch)
        # normals in the world, and the contact law
        _to_world(
            nx, ny, nz, c[R_AXES], c[R_AXES + 1], c[R_AXES + 2], c[R_AXES + 3], c[R_AXES + 4], c[R_AXES + 5], c[R_AXES + 6],
            c[R_AXES + 7], c[R_AXES + 8],
        )  # fmt: skip
        _respond(
            r[0, a:b], r[1, a:b], r[2, a:b], s[0, a:b], s[1, a:b], s[2, a:b], m[a:b], gap, nx, ny, nz, sx, sy, sz, friction, carried
        )  # fmt: skip


@uncounted
def resolve_particles_on_sheet(x, v, w, triangles, shapes, colliders, h, carried, step, look_every, room):
    """Move the solids on, and resolve one sheet's particles' contacts with them after a substep; see
    ``particle_contact.resolve_particles``.

    x: [m], v: [m/s], (3, particles, 1).  w: inverse masses [1/kg], (particles, 1).  colliders: rows, (colliders, COLLIDER_ROWS,
    1).  h: the substep [s].  room: from ``room_on_sheet``.
    """
    n = x.shape[1]
    move_solids(colliders, h)
    _resolve_particles(x.reshape((3, n)), v.reshape((3, n)), w.reshape(n), shapes, colliders, carried, room[3], room[5])


@uncounted
def _measure_in_scratch(rows, first, last, collider, shapes, k, scratch):
    """Distance and normal of particles, whose positions are in rows P_LOCAL, to a mesh, ``COLUMNS`` at a time."""
    lay_out(collider, scratch)
    for begin in range(first, last, scratch.shape[1]):
        count = min(scratch.shape[1], last - begin)
        for e in range(3):
            for l in range(scratch.shape[1]):
                scratch[S_SPOT + e, l] = rows[P_LOCAL + e, begin + min(l, count - 1)]
        measure_mesh(scratch, S_SPOT, shapes, k, scratch.dtype.type(0))
        for e in range(4):
            for l in range(count):
                rows[P_GAP + e, begin + l] = scratch[S_CONTACT + e, l]


# --- triangles ----------------------------------------------------------------------------------------------------------


@disjoint
def _distances(x, y, z, hx, hy, hz, out):
    """Distance of positions in a solid's axes from the box of half sides h [m]: ``out``, (particles,)."""
    zero = x.dtype.type(0)
    for p in range(out.shape[0]):
        ox, oy, oz = max(abs(x[p]) - hx, zero), max(abs(y[p]) - hy, zero), max(abs(z[p]) - hz, zero)
        out[p] = np.sqrt(ox * ox + oy * oy + oz * oz)


@disjoint
def _near_cells(x, y, z, out, columns, radius, near):
    """Distance from the box of ``_distances`` to the points of each cell, at least, less the radius [m]: ``near``, (cells,).
    Returns how many cells may touch.

    out: distances of the corners [m].  No point of a triangle is farther from its closest corner than ``NEAREST`` of its longest
    side.
    """
    count, zero, share = 0, x.dtype.type(0), x.dtype.type(NEAREST)
    xb, xc, xd = x[1:], x[columns:], x[columns + 1 :]
    yb, yc, yd = y[1:], y[columns:], y[columns + 1 :]
    zb, zc, zd = z[1:], z[columns:], z[columns + 1 :]
    ob, oc, od = out[1:], out[columns:], out[columns + 1 :]
    for p in range(near.shape[0]):
        # both diagonals and four sides, squared
        one = (xd[p] - x[p]) * (xd[p] - x[p]) + (yd[p] - y[p]) * (yd[p] - y[p]) + (zd[p] - z[p]) * (zd[p] - z[p])
        two = (xc[p] - xb[p]) * (xc[p] - xb[p]) + (yc[p] - yb[p]) * (yc[p] - yb[p]) + (zc[p] - zb[p]) * (zc[p] - zb[p])
        ab = (xb[p] - x[p]) * (xb[p] - x[p]) + (yb[p] - y[p]) * (yb[p] - y[p]) + (zb[p] - z[p]) * (zb[p] - z[p])
        ac = (xc[p] - x[p]) * (xc[p] - x[p]) + (yc[p] - y[p]) * (yc[p] - y[p]) + (zc[p] - z[p]) * (zc[p] - z[p])
        bd = (xd[p] - xb[p]) * (xd[p] - xb[p]) + (yd[p] - yb[p]) * (yd[p] - yb[p]) + (zd[p] - zb[p]) * (zd[p] - zb[p])
        cd = (xd[p] - xc[p]) * (xd[p] - xc[p]) + (yd[p] - yc[p]) * (yd[p] - yc[p]) + (zd[p] - zc[p]) * (zd[p] - zc[p])
        # the closest corner less the largest distance from it
        longest = max(max(max(one, two), max(ab, ac)), max(bd, cd))
        nearest = min(min(out[p], ob[p]), min(oc[p], od[p]))
        near[p] = nearest - share * np.sqrt(longest) - radius
        count += near[p] < zero
    return count


@inlined
def _gather_corners(rows, triangles, chosen, begin, count, scratch):
    """Copy the corners of ``count`` chosen triangles to the columns of the scratch; the last fills those that are left."""
    for l in range(scratch.shape[1]):
        t = chosen[begin + min(l, count - 1)]
        for c in range(3):
            p = triangles[t, c]
            scratch[S_CORNERS + 3 * c, l] = rows[P_LOCAL, p]
            scratch[S_CORNERS + 3 * c + 1, l] = rows[P_LOCAL + 1, p]
            scratch[S_CORNERS + 3 * c + 2, l] = rows[P_LOCAL + 2, p]


@inlined
def _choose_triangles(rows, triangles, columns, radius, chosen, scratch):
    """List triangles that may touch the solid in the scratch, first by their cells, then each by itself.  Returns how many."""
    # cells that may touch, and their two triangles
    number, last = 0, rows.shape[1] - columns - 1
    near = rows[P_NEAR, :last]
    out = rows[P_GAP]
    if _near_cells(rows[P_LOCAL], rows[P_LOCAL + 1], rows[P_LOCAL + 2], out, columns, radius, near) == 0:
        return 0
    for p in range(last):
        # at the end of a row there is no cell
        if near[p] < 0 and p % columns < columns - 1:
            t = 2 * (p - p // columns)
            chosen[number], chosen[number + 1] = t, t + 1
            number += 2
    # of these, the triangles that may touch
    kept = 0
    for begin in range(0, number, scratch.shape[1]):
        count = min(scratch.shape[1], number - begin)
        _gather_corners(rows, triangles, chosen, begin, count, scratch)
        may_touch_triangle(scratch)
        for l in range(count):
            chosen[kept] = chosen[begin + l]
            kept += scratch[S_CLEAR, l] == 0
    return kept


@uncounted
def find_touches_on_sheet(x, triangles, shapes, k, collider, room):
    """Find where triangles of one sheet touch solid k, which is not a plane, or may soon touch it; see
    ``triangle_contact.find_touches``.

    The triangles of a grid come two to a cell, row by row.
    """
    touches, which, count, rows, chosen, scratch, kept = room
    n, c = x.shape[1], collider.reshape(collider.shape[0])
    r = x.reshape((3, n))
    # without its thickness, and less the depth that triangles may sink in
    lay_out(collider, scratch)
    least = min(c[R_HALF], min(c[R_HALF + 1], c[R_HALF + 2])) + c[R_RADIUS]
    radius = c[R_RADIUS] - (c[R_THICKNESS] + x.dtype.type(2 * SINK) * least)
    scratch[R_RADIUS] = radius
    # positions in the axes of the solid, and distances from its box
    for e in range(3):
        q = R_AXES + 3 * e
        _to_axis(r[0], r[1], r[2], c[R_POINT], c[R_POINT + 1], c[R_POINT + 2], c[q], c[q + 1], c[q + 2], rows[P_LOCAL + e])
    _distances(rows[P_LOCAL], rows[P_LOCAL + 1], rows[P_LOCAL + 2], c[R_HALF], c[R_HALF + 1], c[R_HALF + 2], rows[P_GAP])
    # the first triangle of the second row of cells begins at the second row of particles
    columns = triangles[0, 2] - 1
    # triangles that may touch, ``COLUMNS`` at a time: the deepest point of each, and the normal there
    number = _choose_triangles(rows, triangles, columns, radius, chosen, scratch)
    for begin in range(0, number, scratch.shape[1]):
        filled = min(scratch.shape[1], number - begin)
        _gather_corners(rows, triangles, chosen, begin, filled, scratch)
        if not may_touch_triangle(scratch) or (shapes.kinds[k] == KIND_MESH and not may_touch_mesh(scratch, shapes, k)):
            continue
        if not find_deepest(scratch, shapes, k) or not turn_normal(scratch):
            continue
        normal_to_world(scratch)
        # write the touches: weights, plane, the impulse that each had, and its ball
        for l in range(filled):
            if scratch[S_CONTACT, l] >= scratch.dtype.type(NO_CONTACT):
                continue
            t, rho, touch = chosen[begin + l], scratch[S_RHO, l], touches[count[0]]
            touch[T_OFFSET] = scratch[S_CONTACT, l]
            for e in range(3):
                spot, normal = -c[R_POINT + e], scratch[S_CONTACT + 1 + e, l]
                for corner in range(3):
                    spot += scratch[S_WEIGHTS + corner, l] * r[e, triangles[t, corner]]
                touch[T_WEIGHTS + e], touch[T_NORMAL + e] = scratch[S_WEIGHTS + e, l], normal
                touch[T_OFFSET] -= normal * spot
                touch[T_IMPULSE + e] = kept[k, t, e]
                touch[T_CORE + e] = spot - rho * normal
            touch[T_RHO] = -1 if shapes.kinds[k] == KIND_MESH else rho - scratch[S_CONTACT, l]
            which[count[0], 0], which[count[0], 1] = chosen[begin + l], k
            count[0] += 1


@uncounted
def resolve_on_sheet(x, v, w, triangles, shapes, colliders, h, carried, step, look_every, room):
    """Contact of one sheet, of its particles and between them; see ``particle_contact.resolve``.

    triangles: (triangles, 3).
    """
    touches, which, count, rows, _, scratch, kept = room
    kinds, n = shapes.kinds, x.shape[1]
    r, s, m = x.reshape((3, n)), v.reshape((3, n)), w.reshape(n)
    move_solids(colliders, h)
    # search for touches with all solids but planes, which touch particles first; those found again keep their impulses
    if step % look_every == 0:
        kept[:] = 0
        if step > 0:
            for t in range(count[0]):
                for e in range(3):
                    kept[which[t, 1], which[t, 0], e] = touches[t, T_IMPULSE + e]
        count[0] = 0
        for k in range(kinds.shape[0]):
            if kinds[k] != KIND_PLANE:
                find_touches_on_sheet(x, triangles, shapes, k, colliders[k], room)
    # where they are now; they bear what lies on them, and after the particles they are corrected
    number = count[0]
    follow_touches_on_sheet(r, triangles, colliders, touches[:number], which, scratch)
    bear_touches_on_sheet(r, s, m, triangles, touches[:number], which, carried)
    press_touches_on_sheet(r, s, m, triangles, colliders, touches[:number], which, h, carried)
    _resolve_particles(r, s, m, shapes, colliders, carried, rows, scratch)

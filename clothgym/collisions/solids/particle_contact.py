"""Contact of one sheet's particles with solids.

Particles are measured all at once, from the first to the last that a solid may touch.  The contact law (``contact_law``) is applied
after each substep to the positions and velocities that the integrator left.
"""

from __future__ import annotations

from clothgym._jit import disjoint, inlined, merged, uncounted
from clothgym.collisions.solids.contact_law import TINY, contact_change, edge_change
from clothgym.collisions.solids.edges import EDGE_DRAG, EDGE_ROWS, LEAST_COSINE
from clothgym.collisions.solids.shapes import (
    KIND_PLANE,
    KIND_ROUNDED_BOX,
    R_AXES,
    R_FRICTION,
    R_HALF,
    R_POINT,
    R_RADIUS,
    R_REACH2,
    R_VELOCITY,
)
from clothgym.collisions.solids.signed_distance import S_CONTACT, S_SPOT, lay_out, measure_mesh, rounded_box

# rows of scratch, one column a particle: position in the solid's axes, signed distance and normal, how near cells are, and those of
# ``edges``
P_LOCAL, P_GAP, P_NORMAL, P_NEAR, P_EDGES = 0, 3, 4, 7, 8
PARTICLE_ROWS = P_EDGES + EDGE_ROWS


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
def to_axis(x, y, z, px, py, pz, ax, ay, az, out):
    """Coordinates of particles along one axis of a solid [m]: ``out``, (particles,)."""
    for p in range(out.shape[0]):
        out[p] = (x[p] - px) * ax + (y[p] - py) * ay + (z[p] - pz) * az


@disjoint
def measure_boxes(x, y, z, hx, hy, hz, radius, gap, nx, ny, nz):
    """Signed distance [m] and normal of positions in the axes of a rounded box."""
    zero, one = x.dtype.type(0), x.dtype.type(1)
    for p in range(gap.shape[0]):
        gap[p], nx[p], ny[p], nz[p] = rounded_box(x[p], y[p], z[p], hx, hy, hz, radius, zero, one)


@disjoint
def to_world(nx, ny, nz, xx, xy, xz, yx, yy, yz, zx, zy, zz):
    """Rotate normals from a solid's axes, x, y and z, to the world's."""
    for p in range(nx.shape[0]):
        ax, ay, az = nx[p], ny[p], nz[p]
        nx[p] = ax * xx + ay * yx + az * zx
        ny[p] = ax * xy + ay * yy + az * zy
        nz[p] = ax * xz + ay * yz + az * zz


@disjoint
def _respond(x, y, z, vx, vy, vz, w, gap, nx, ny, nz, sx, sy, sz, friction, lead):
    """Apply the contact law to particles at a solid that moves with velocity s [m/s]."""
    zero, one, tiny = x.dtype.type(0), x.dtype.type(1), x.dtype.type(TINY)
    for p in range(gap.shape[0]):
        mx, my, mz, cx, cy, cz = contact_change(
            gap[p], nx[p], ny[p], nz[p], vx[p] - sx, vy[p] - sy, vz[p] - sz, w[p], friction, lead, zero, one, tiny
        )
        x[p] += mx
        y[p] += my
        z[p] += mz
        vx[p] += cx
        vy[p] += cy
        vz[p] += cz


@disjoint
def _respond_to_plane(x, y, z, vx, vy, vz, w, gap, nx, ny, nz, sx, sy, sz, friction, lead):
    """The same with one normal for all particles."""
    zero, one, tiny = x.dtype.type(0), x.dtype.type(1), x.dtype.type(TINY)
    for p in range(gap.shape[0]):
        mx, my, mz, cx, cy, cz = contact_change(
            gap[p], nx, ny, nz, vx[p] - sx, vy[p] - sy, vz[p] - sz, w[p], friction, lead, zero, one, tiny
        )
        x[p] += mx
        y[p] += my
        z[p] += mz
        vx[p] += cx
        vy[p] += cy
        vz[p] += cz


@uncounted
def measure_in_scratch(rows, first, last, collider, shapes, k, within, scratch):
    """Distance, and normal where that is below ``within``, of particles, whose positions are in rows P_LOCAL, to a mesh.

    They are measured as many at a time as the scratch has columns.
    """
    lay_out(collider, scratch)
    for begin in range(first, last, scratch.shape[1]):
        count = min(scratch.shape[1], last - begin)
        for e in range(3):
            for l in range(scratch.shape[1]):
                scratch[S_SPOT + e, l] = rows[P_LOCAL + e, begin + min(l, count - 1)]
        measure_mesh(scratch, S_SPOT, shapes, k, within)
        for e in range(4):
            for l in range(count):
                rows[P_GAP + e, begin + l] = scratch[S_CONTACT + e, l]


@uncounted
def _respond_at_edges(r, s, m, first, last, contacts, edges, pushes, sx, sy, sz, friction, h, lead):
    """Apply the contact law to those of particles ``first`` to ``last`` that are near an edge, and mark them as done.

    contacts: signed distances [m] and normals, (4, particles).  edges: particles, (edges,).  pushes: directions, (edges, 3).
    """
    zero, one, tiny = r.dtype.type(0), r.dtype.type(1), r.dtype.type(TINY)
    least_cosine, keep = r.dtype.type(LEAST_COSINE), one / (one + h * r.dtype.type(EDGE_DRAG))
    for n in range(edges.shape[0]):
        p = edges[n]
        if p < first or p >= last or not (contacts[0, p] < zero and m[p] > zero):
            continue
        nx, ny, nz = contacts[1, p], contacts[2, p], contacts[3, p]
        ex, ey, ez = pushes[n, 0], pushes[n, 1], pushes[n, 2]
        if not ex * nx + ey * ny + ez * nz > least_cosine:
            continue
        mx, my, mz, cx, cy, cz = edge_change(
            contacts[0, p],
            nx,
            ny,
            nz,
            ex,
            ey,
            ez,
            s[0, p] - sx,
            s[1, p] - sy,
            s[2, p] - sz,
            friction,
            lead,
            zero,
            one,
            tiny,
        )
        r[0, p] += mx
        r[1, p] += my
        r[2, p] += mz
        # a drag takes what the push along e may have added
        s[0, p] = sx + (s[0, p] + cx - sx) * keep
        s[1, p] = sy + (s[1, p] + cy - sy) * keep
        s[2, p] = sz + (s[2, p] + cz - sz) * keep
        contacts[0, p] = zero


@uncounted
def resolve_particles(r, s, m, shapes, colliders, h, lead, edges, pushes, counts, rows, scratch):
    """Resolve one sheet's particles' contacts with solids.

    r: positions [m], s: velocities [m/s], (3, particles).  m: inverse masses [1/kg], (particles,).  colliders: rows, (colliders,
    COLLIDER_ROWS, 1).  h: the substep [s].  lead: time for which the velocity has already moved the positions [s].
    edges: particles near an edge of each solid, (colliders, particles), and ``pushes``, the directions in which it pushes them,
    (colliders, particles, 3), see ``edges``; counts: how many, (colliders,).
    rows: scratch, (PARTICLE_ROWS, particles).  scratch: see ``signed_distance``.
    """
    kinds = shapes.kinds
    for k in range(kinds.shape[0]):
        c = merged(colliders[k])
        px, py, pz = c[R_POINT], c[R_POINT + 1], c[R_POINT + 2]
        sx, sy, sz, friction = c[R_VELOCITY], c[R_VELOCITY + 1], c[R_VELOCITY + 2], c[R_FRICTION]
        # a plane: heights, then the particles from the first to the last below it
        if kinds[k] == KIND_PLANE:
            nx, ny, nz = c[R_AXES + 6], c[R_AXES + 7], c[R_AXES + 8]
            if _heights(r[0], r[1], r[2], px, py, pz, nx, ny, nz, c[R_RADIUS], rows[P_GAP]) > 0:
                a, b = _span(rows[P_GAP])
                _respond_to_plane(
                    r[0, a:b], r[1, a:b], r[2, a:b], s[0, a:b], s[1, a:b], s[2, a:b], m[a:b], rows[P_GAP, a:b], nx, ny, nz, sx, sy,
                    sz, friction, lead,
                )  # fmt: skip
            continue
        # any other solid: particles within its reach, from the first to the last
        if _beyond_reach(r[0], r[1], r[2], px, py, pz, c[R_REACH2], rows[P_GAP]) == 0:
            continue
        a, b = _span(rows[P_GAP])
        # positions in its axes, distances and normals there
        for e in range(3):
            q = R_AXES + 3 * e
            to_axis(r[0, a:b], r[1, a:b], r[2, a:b], px, py, pz, c[q], c[q + 1], c[q + 2], rows[P_LOCAL + e, a:b])
        gap, nx, ny, nz = rows[P_GAP, a:b], rows[P_NORMAL, a:b], rows[P_NORMAL + 1, a:b], rows[P_NORMAL + 2, a:b]
        if kinds[k] == KIND_ROUNDED_BOX:
            measure_boxes(
                rows[P_LOCAL, a:b], rows[P_LOCAL + 1, a:b], rows[P_LOCAL + 2, a:b], c[R_HALF], c[R_HALF + 1], c[R_HALF + 2],
                c[R_RADIUS], gap, nx, ny, nz,
            )  # fmt: skip
        else:
            measure_in_scratch(rows, a, b, colliders[k], shapes, k, r.dtype.type(0), scratch)
        # normals in the world
        to_world(
            nx, ny, nz, c[R_AXES], c[R_AXES + 1], c[R_AXES + 2], c[R_AXES + 3], c[R_AXES + 4], c[R_AXES + 5], c[R_AXES + 6],
            c[R_AXES + 7], c[R_AXES + 8],
        )  # fmt: skip
        # the contact law: first of particles near an edge, then of the others
        if counts[k] > 0:
            _respond_at_edges(
                r, s, m, a, b, rows[P_GAP : P_GAP + 4], edges[k, : counts[k]], pushes[k], sx, sy, sz, friction, h, lead
            )
        _respond(
            r[0, a:b], r[1, a:b], r[2, a:b], s[0, a:b], s[1, a:b], s[2, a:b], m[a:b], gap, nx, ny, nz, sx, sy, sz, friction, lead
        )  # fmt: skip

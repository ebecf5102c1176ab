"""Contact of the sheet between its particles: a small sphere, or the edge of a box, does not pass through a triangle.

For each triangle near a solid the point is found that lies deepest in it, its touch (see ``deepest_point``).  Triangles that may
touch are gathered ``COLUMNS`` at a time into a scratch array with one triangle in each column (see ``signed_distance``).

The search is repeated at intervals (``simulation.SURFACE_INTERVAL``).  In between, each touch stands for a ball in the solid that
moves with it: what the touch does is in ``touch_response``.

Particles keep the full thickness; between them the sheet may sink into the true surface by ``SINK`` thicknesses, so that on a round
solid it lies on its particles where these are close enough.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, inlined, kernel, merged, placeholder, uncounted
from clothgym.collisions.solids.deepest_point import LYING, NO_CONTACT, find_deepest, turn_normal
from clothgym.collisions.solids.edges import E_COSINE, E_PUSH, E_SOLID, NEAREST, UNBENT, find_edges, push_of_touch
from clothgym.collisions.solids.particle_contact import (
    P_EDGES,
    P_GAP,
    P_LOCAL,
    P_NEAR,
    P_NORMAL,
    measure_boxes,
    measure_in_scratch,
    to_axis,
    to_world,
)
from clothgym.collisions.solids.shapes import (
    KIND_MESH,
    KIND_ROUNDED_BOX,
    R_AXES,
    R_HALF,
    R_POINT,
    R_RADIUS,
    R_THICKNESS,
)
from clothgym.collisions.solids.signed_distance import (
    S_CLEAR,
    S_CONTACT,
    S_CORNERS,
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    lay_out,
    measure,
    normal_to_world,
)
from clothgym.collisions.solids.touch_response import T_CORE, T_IMPULSE, T_NORMAL, T_OFFSET, T_PUSH, T_RHO, T_WEIGHTS

COLUMNS = 32  # triangles in a scratch array
SINK = 0.25  # depth that the sheet between its particles may sink below the surface, in thicknesses
LEAST_SINK = 5e-5  # added to it, so that cloth lies flat on its particles where there is no thickness [m]

choose_near = placeholder("choose_near", "of (rows, triangles, radius, chosen): lists triangles that may be near the solid")


@inlined
def _may_touch(scratch):
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


@kernel
def _may_touch_mesh(scratch, shapes, k):
    """Whether any lane's triangle may touch a mesh, by the distance of its center; triangles that cannot are marked in S_CLEAR."""
    measure(scratch, S_SPOT, shapes, k, scratch.dtype.type(0))
    near = False
    for l in range(scratch.shape[1]):
        if scratch[S_CONTACT, l] >= scratch[S_RHO, l]:
            scratch[S_CLEAR, l] = 1
        near |= scratch[S_CLEAR, l] == 0
    return near


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


@uncounted
def choose_by_cells(rows, triangles, radius, chosen):
    """List the triangles of a grid, two to a cell, whose cells may be near the solid.  Returns how many.

    rows: scratch with positions in the solid's axes and their distances, (PARTICLE_ROWS, particles).  radius: how near [m].
    chosen: becomes their indices, (triangles,).
    """
    # the first triangle of the first row of cells ends at the second row of particles
    columns = triangles[0, 2] - 1
    number, last = 0, rows.shape[1] - columns - 1
    near = rows[P_NEAR, :last]
    if _near_cells(rows[P_LOCAL], rows[P_LOCAL + 1], rows[P_LOCAL + 2], rows[P_GAP], columns, radius, near) == 0:
        return 0
    for p in range(last):
        # at the end of a row there is no cell
        if near[p] < 0 and p % columns < columns - 1:
            t = 2 * (p - p // columns)
            chosen[number], chosen[number + 1] = t, t + 1
            number += 2
    return number


@uncounted
def choose_one_by_one(rows, triangles, radius, chosen):
    """The same for any triangles, see ``choose_by_cells``."""
    share, number = rows.dtype.type(NEAREST), 0
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        longest = rows.dtype.type(0)
        for a, b in ((i, j), (j, k), (k, i)):
            dx, dy, dz = (
                rows[P_LOCAL, a] - rows[P_LOCAL, b],
                rows[P_LOCAL + 1, a] - rows[P_LOCAL + 1, b],
                rows[P_LOCAL + 2, a] - rows[P_LOCAL + 2, b],
            )
            longest = max(longest, dx * dx + dy * dy + dz * dz)
        # the closest corner less the largest distance from it
        if min(rows[P_GAP, i], min(rows[P_GAP, j], rows[P_GAP, k])) - share * np.sqrt(longest) < radius:
            chosen[number] = t
            number += 1
    return number


@inlined
def _keep_touching(rows, triangles, number, chosen, scratch):
    """Of the first ``number`` chosen triangles keep those that may touch the solid in the scratch.  Returns how many."""
    kept = 0
    for begin in range(0, number, scratch.shape[1]):
        count = min(scratch.shape[1], number - begin)
        _gather_corners(rows, triangles, chosen, begin, count, scratch)
        _may_touch(scratch)
        for l in range(count):
            chosen[kept] = chosen[begin + l]
            kept += scratch[S_CLEAR, l] == 0
    return kept


@inlined
def _find_edges(r, triangles, shapes, k, collider, near, edges, pushes, rows, bent, scratch):
    """List the particles near an edge of solid k, and the directions in which it pushes them.  Returns how many they are, or -1
    where no edge is between any particles.

    near: triangles that may come closer than the thickness, (near,).  edges: (particles,).  pushes: (particles, 3).
    rows: positions in the solid's axes, and distances from its box.  bent: scratch, (triangles,).
    """
    n, c = r.shape[1], merged(collider)
    # spheres and capsules have no edges
    if near.shape[0] == 0 or (shapes.kinds[k] == KIND_ROUNDED_BOX and c[R_RADIUS] > c[R_THICKNESS]):
        return -1
    # the distances and the solid's normals at all particles, in the world
    own = rows[P_EDGES:]
    if shapes.kinds[k] == KIND_ROUNDED_BOX:
        measure_boxes(
            rows[P_LOCAL], rows[P_LOCAL + 1], rows[P_LOCAL + 2], c[R_HALF], c[R_HALF + 1], c[R_HALF + 2], c[R_RADIUS], rows[P_GAP],
            own[E_SOLID], own[E_SOLID + 1], own[E_SOLID + 2],
        )  # fmt: skip
    else:
        measure_in_scratch(rows, 0, n, collider, shapes, k, r.dtype.type(np.inf), scratch)
        for e in range(3):
            for p in range(n):
                own[E_SOLID + e, p] = rows[P_NORMAL + e, p]
    to_world(
        own[E_SOLID], own[E_SOLID + 1], own[E_SOLID + 2], c[R_AXES], c[R_AXES + 1], c[R_AXES + 2], c[R_AXES + 3], c[R_AXES + 4],
        c[R_AXES + 5], c[R_AXES + 6], c[R_AXES + 7], c[R_AXES + 8],
    )  # fmt: skip
    # particles at corners of triangles that lie across an edge
    if find_edges(r, triangles, near, own, rows[P_GAP], c[R_THICKNESS], bent) == 0:
        return -1
    number = 0
    for p in range(n):
        if own[E_COSINE, p] != UNBENT:
            edges[number] = p
            for e in range(3):
                pushes[number, e] = own[E_PUSH + e, p]
            number += 1
    return number


def find_touches(r, triangles, shapes, k, collider, touches, which, count, edges, pushes, counts, kept, rows, chosen, scratch):
    """Find where triangles of one sheet touch solid k, which is not a plane, or may soon touch it, and the particles at its edges.

    r: positions [m], (3, particles).  triangles: (triangles, 3).  collider: rows of the solid, (COLLIDER_ROWS, 1).
    touches, which, count: found touches are added to these, (most, TOUCH_COLUMNS), with triangle and solid of each, (most, 2), and
    their number, (1,).
    edges, pushes, counts: as in ``particle_contact.resolve_particles``.  kept: impulses that triangles have had at each solid
    [N s], (colliders, triangles, 3).  rows, chosen, scratch: scratch.
    """
    c = merged(collider)
    # positions in the axes of the solid, and distances from its box
    for e in range(3):
        q = R_AXES + 3 * e
        to_axis(r[0], r[1], r[2], c[R_POINT], c[R_POINT + 1], c[R_POINT + 2], c[q], c[q + 1], c[q + 2], rows[P_LOCAL + e])
    _distances(rows[P_LOCAL], rows[P_LOCAL + 1], rows[P_LOCAL + 2], c[R_HALF], c[R_HALF + 1], c[R_HALF + 2], rows[P_GAP])
    # triangles that may come closer than the thickness, and edges among them; ``chosen`` has room behind the triangles
    number = choose_near(rows, triangles, c[R_RADIUS] + c[R_THICKNESS], chosen)
    at_edges = _find_edges(
        r, triangles, shapes, k, collider, chosen[:number], edges[k], pushes[k], rows, chosen[triangles.shape[0] :], scratch
    )
    # those that may touch the solid without its thickness, and less the depth that they may sink in
    inner = c[R_RADIUS] - (r.dtype.type(1 + SINK) * c[R_THICKNESS] + r.dtype.type(LEAST_SINK))
    lay_out(collider, scratch)
    scratch[R_RADIUS] = inner
    number = _keep_touching(rows, triangles, number, chosen, scratch)
    counts[k] = max(at_edges, 0)
    # the deepest point of each, and the normal there
    for begin in range(0, number, scratch.shape[1]):
        filled = min(scratch.shape[1], number - begin)
        _gather_corners(rows, triangles, chosen, begin, filled, scratch)
        if not _may_touch(scratch) or (shapes.kinds[k] == KIND_MESH and not _may_touch_mesh(scratch, shapes, k)):
            continue
        if not find_deepest(scratch, shapes, k) or not turn_normal(scratch, shapes.kinds[k] == KIND_MESH):
            continue
        normal_to_world(scratch)
        for l in range(filled):
            if scratch[S_CONTACT, l] < scratch.dtype.type(NO_CONTACT):
                t = chosen[begin + l]
                touch = touches[count[0]]
                _write_touch(r, triangles[t], c, scratch, l, shapes.kinds[k] == KIND_MESH, touch)
                for e in range(3):
                    touch[T_IMPULSE + e] = kept[k, t, e]
                nx, ny, nz = touch[T_NORMAL], touch[T_NORMAL + 1], touch[T_NORMAL + 2]
                if at_edges >= 0:
                    nx, ny, nz = push_of_touch(r, triangles[t], touch[T_WEIGHTS : T_WEIGHTS + 3], nx, ny, nz, rows[P_EDGES:])
                touch[T_PUSH], touch[T_PUSH + 1], touch[T_PUSH + 2] = nx, ny, nz
                which[count[0], 0], which[count[0], 1] = t, k
                count[0] += 1


@inlined
def _write_touch(r, triangle, c, scratch, l, mesh, touch):
    """Write weights, plane and ball of the touch in column l of the scratch; c: rows of the solid, (COLLIDER_ROWS,)."""
    rho = scratch[S_RHO, l]
    touch[T_OFFSET] = scratch[S_CONTACT, l]
    for e in range(3):
        spot, normal = -c[R_POINT + e], scratch[S_CONTACT + 1 + e, l]
        for corner in range(3):
            spot += scratch[S_WEIGHTS + corner, l] * r[e, triangle[corner]]
        touch[T_WEIGHTS + e], touch[T_NORMAL + e] = scratch[S_WEIGHTS + e, l], normal
        touch[T_OFFSET] -= normal * spot
        touch[T_CORE + e] = spot - rho * normal
    # the ball's radius, so that its surface is below the triangle by the gap; none at a mesh
    touch[T_RHO] = -1 if mesh else rho - scratch[S_CONTACT, l]

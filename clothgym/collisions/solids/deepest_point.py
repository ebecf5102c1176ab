"""The point of a triangle that lies deepest in a solid, and the normal of contact there.

It is found by alternating projections (von Neumann; Bauschke and Borwein 1996): from the point to the solid's core, which is what
is left of the solid below a depth ``rho``, and from there back to the triangle.  They converge to the shortest line between
triangle and core.  Its end on the triangle is the deepest point, and its direction is the normal of contact: along the triangle's
own normal where an edge or a corner of the solid pokes into it, and perpendicular to both edges where two cross.  The core of a
sphere is its center, and one round is exact; that of a capsule is its segment.

The core must lie deeper than any point of the triangle: if a point turns out to lie deeper than half of ``rho``, ``rho`` is set to
twice its depth.  At an edge or a corner of a box the triangle's point nearest to the core is not quite the one nearest to the edge.
So in the end the core's point moves out to the edge, and the triangle's point closest to that is taken: the gap along the normal is
then that of the box itself (``turn_normal``).  At a mesh, which has no such point, the error is up to a fifth of ``rho``.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel, uncounted
from clothgym.collisions.solids.shapes import (
    KIND_MESH,
    R_HALF,
    R_RADIUS,
    R_THICKNESS,
)
from clothgym.collisions.solids.signed_distance import (
    S_BEFORE,
    S_BETWEEN,
    S_CLEAR,
    S_CONTACT,
    S_CORE,
    S_CORNERS,
    S_LENGTH,
    S_RHO,
    S_SPOT,
    S_USABLE,
    S_WEIGHTS,
    measure,
)

NO_CONTACT = 1e9  # gap of a lane without contact [m]
MESH_ROUNDS, BOX_STEPS = 3, 8  # rounds at a mesh, and steps at a box with half sides, see ``find_deepest``
SLOW_ROUND = 0.98  # largest ratio of the moves of two rounds that the extrapolation assumes
DEPTH = 2.0  # initial rho, in thicknesses
SOON = 0.25  # gap, in thicknesses, within which a triangle may touch the solid before the next search
BALL = 5.0  # least radius of a ball that stands for the solid until the next search, in thicknesses
CELLS = 0.75  # rho below a mesh's thickness, in cells of its grid
LYING = 1e-3  # share of the radius by which cloth that lies on a solid may be inside
LEAST_COSINE = 0.5  # between the normals of contact and of the solid: at a box's corner it is 0.58


@kernel
def to_triangle(scratch):
    """Move S_SPOT to the point of the triangle closest to S_CORE; its barycentric weights go to S_WEIGHTS.

    With a as origin, b and c the other corners and q the core's point: p = s b + t c minimizes |p - q|^2.
    """
    zero, one, tiny = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-30)
    for l in range(scratch.shape[1]):
        # the corners and the point, from corner a on
        ax, ay, az = scratch[S_CORNERS, l], scratch[S_CORNERS + 1, l], scratch[S_CORNERS + 2, l]
        bx, by, bz = scratch[S_CORNERS + 3, l] - ax, scratch[S_CORNERS + 4, l] - ay, scratch[S_CORNERS + 5, l] - az
        cx, cy, cz = scratch[S_CORNERS + 6, l] - ax, scratch[S_CORNERS + 7, l] - ay, scratch[S_CORNERS + 8, l] - az
        qx, qy, qz = scratch[S_CORE, l] - ax, scratch[S_CORE + 1, l] - ay, scratch[S_CORE + 2, l] - az
        bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
        qb, qc = qx * bx + qy * by + qz * bz, qx * cx + qy * cy + qz * cz
        # the minimum in the triangle's plane
        area2 = bb * cc - bc * bc
        scale = one / max(area2, tiny)
        s, t = (cc * qb - bc * qc) * scale, (bb * qc - bc * qb) * scale
        within = s >= zero and t >= zero and s + t <= one
        # the closest point of each side, and by how much its squared distance is less than |q|^2
        on_b = min(max(qb / max(bb, tiny), zero), one)
        on_c = min(max(qc / max(cc, tiny), zero), one)
        side = bb - bc - bc + cc
        along = qc - qb - bc + bb
        on_s = min(max(along / max(side, tiny), zero), one)
        gain_b = on_b * (qb + qb - on_b * bb)
        gain_c = on_c * (qc + qc - on_c * cc)
        gain_s = qb + qb - bb + on_s * (along + along - on_s * side)
        # the best side, unless the minimum lies inside
        first = gain_b >= gain_c and gain_b >= gain_s
        second = gain_c >= gain_s
        es = on_b if first else (zero if second else one - on_s)
        et = zero if first else (on_c if second else on_s)
        s = s if within else es
        t = t if within else et
        # weights and position
        scratch[S_WEIGHTS, l] = one - s - t
        scratch[S_WEIGHTS + 1, l] = s
        scratch[S_WEIGHTS + 2, l] = t
        scratch[S_SPOT, l] = ax + s * bx + t * cx
        scratch[S_SPOT + 1, l] = ay + s * by + t * cy
        scratch[S_SPOT + 2, l] = az + s * bz + t * cz


@kernel
def _to_core_of_box(scratch):
    """Move S_CORE to the core's point closest to S_SPOT: the core is a box with half sides b - max(rho - r, 0)."""
    zero = scratch.dtype.type(0)
    for c in range(3):
        for l in range(scratch.shape[1]):
            half = max(scratch[R_HALF + c, l] - max(scratch[S_RHO, l] - scratch[R_RADIUS, l], zero), zero)
            scratch[S_CORE + c, l] = min(max(scratch[S_SPOT + c, l], -half), half)


@kernel
def _to_core_of_mesh(scratch, shapes, k):
    """Move S_CORE from S_SPOT along the normal to where the distance is -rho, in two steps: behind an edge the normal changes."""
    zero = scratch.dtype.type(0)
    for c in range(3):
        for l in range(scratch.shape[1]):
            scratch[S_CORE + c, l] = scratch[S_SPOT + c, l]
    for _ in range(2):
        measure(scratch, S_CORE, shapes, k, scratch.dtype.type(np.inf))
        for c in range(3):
            for l in range(scratch.shape[1]):
                scratch[S_CORE + c, l] -= max(scratch[S_CONTACT, l] + scratch[S_RHO, l], zero) * scratch[S_CONTACT + 1 + c, l]


@kernel
def _any_may_touch(scratch):
    """Whether any lane's triangle may touch its rounded box; those that surely do not are marked in S_CLEAR.

    A triangle is clear if it lies beyond the plane through the farthest point of the box along the line from S_CORE to S_SPOT.
    """
    one, tiny = scratch.dtype.type(1), scratch.dtype.type(1e-18)
    for l in range(scratch.shape[1]):
        nx, ny, nz = (
            scratch[S_SPOT, l] - scratch[S_CORE, l],
            scratch[S_SPOT + 1, l] - scratch[S_CORE + 1, l],
            scratch[S_SPOT + 2, l] - scratch[S_CORE + 2, l],
        )
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        # heights of the corners, and of the farthest point of the box, along the line
        a = scratch[S_CORNERS, l] * nx + scratch[S_CORNERS + 1, l] * ny + scratch[S_CORNERS + 2, l] * nz
        b = scratch[S_CORNERS + 3, l] * nx + scratch[S_CORNERS + 4, l] * ny + scratch[S_CORNERS + 5, l] * nz
        c = scratch[S_CORNERS + 6, l] * nx + scratch[S_CORNERS + 7, l] * ny + scratch[S_CORNERS + 8, l] * nz
        shrunk = scratch[R_RADIUS, l] * scratch.dtype.type(1 - LYING)
        farthest = (
            scratch[R_HALF, l] * abs(nx) + scratch[R_HALF + 1, l] * abs(ny) + scratch[R_HALF + 2, l] * abs(nz) + shrunk * length
        )
        scratch[S_CLEAR, l] = one if min(a, min(b, c)) >= farthest + tiny else scratch[S_CLEAR, l]
    any_left = False
    for l in range(scratch.shape[1]):
        any_left |= scratch[S_CLEAR, l] == 0
    return any_left


@kernel
def _extrapolate(scratch):
    """Write to S_CORE where the last two rounds lead (Aitken's extrapolation).

    Where a long edge of the solid runs at a small angle to the triangle, each round comes closer by only a little.
    """
    zero, one, tiny, most = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-18), scratch.dtype.type(SLOW_ROUND)
    for l in range(scratch.shape[1]):
        # the moves of the last two rounds
        fx, fy, fz = scratch[S_BETWEEN, l], scratch[S_BETWEEN + 1, l], scratch[S_BETWEEN + 2, l]
        px, py, pz = fx - scratch[S_BEFORE, l], fy - scratch[S_BEFORE + 1, l], fz - scratch[S_BEFORE + 2, l]
        fx, fy, fz = scratch[S_SPOT, l] - fx, scratch[S_SPOT + 1, l] - fy, scratch[S_SPOT + 2, l] - fz
        # a geometric series with the ratio of both moves
        ratio = (fx * px + fy * py + fz * pz) / max(px * px + py * py + pz * pz, tiny)
        ratio = min(max(ratio, zero), most)
        factor = ratio / (one - ratio)
        scratch[S_CORE, l] = scratch[S_SPOT, l] + factor * fx
        scratch[S_CORE + 1, l] = scratch[S_SPOT + 1, l] + factor * fy
        scratch[S_CORE + 2, l] = scratch[S_SPOT + 2, l] + factor * fz


@uncounted
def find_deepest(scratch, shapes, k):
    """Find the deepest point of the triangle in S_CORNERS, starting from S_SPOT, in the solid's axes.  Returns whether any lane may
    touch.

    S_SPOT becomes the point, S_WEIGHTS its weights, S_CORE the core's point, S_CONTACT the signed distance and the solid's normal
    there.  Each kernel is called at one place, in a loop: kernels are inlined, and each place takes its time to compile.
    """
    # does any lane have a box with sides
    mesh, boxes = shapes.kinds[k] == KIND_MESH, False
    for c in range(3):
        for l in range(scratch.shape[1]):
            boxes |= scratch[R_HALF + c, l] > 0
    # initial depth of the core
    deep = shapes.cells[k] * scratch.dtype.type(CELLS)
    for l in range(scratch.shape[1]):
        scratch[S_RHO, l] = scratch[R_THICKNESS, l] + deep if mesh else scratch.dtype.type(DEPTH) * scratch[R_THICKNESS, l]
    # one round for a sphere, whose core is a point; for a box three rounds, an extrapolation, two rounds, another, and a last round
    steps = MESH_ROUNDS if mesh else (BOX_STEPS if boxes else 1)
    for step in range(steps):
        # to the core: by extrapolation, or by projection, which keeps the last two positions
        extrapolate = boxes and not mesh and (step == 3 or step == 6)
        if extrapolate:
            _extrapolate(scratch)
        elif mesh:
            _to_core_of_mesh(scratch, shapes, k)
        else:
            for e in range(3):
                for l in range(scratch.shape[1]):
                    scratch[S_BEFORE + e, l] = scratch[S_BETWEEN + e, l]
                for l in range(scratch.shape[1]):
                    scratch[S_BETWEEN + e, l] = scratch[S_SPOT + e, l]
            _to_core_of_box(scratch)
        # and back to the triangle
        to_triangle(scratch)
        # a first round may show that nothing touches
        if step == 0 and boxes and not mesh and not _any_may_touch(scratch):
            return False
        # the distance after the fourth step corrects rho; that after the last is the result
        if step == 3 or step == steps - 1:
            measure(scratch, S_SPOT, shapes, k, scratch.dtype.type(np.inf))
        if step == 3:
            for l in range(scratch.shape[1]):
                scratch[S_RHO, l] = max(scratch[S_RHO, l], scratch.dtype.type(-2) * scratch[S_CONTACT, l])
    return True


@kernel
def turn_normal(scratch, mesh):
    """Replace the solid's normal in S_CONTACT by that of contact, from core to triangle, and the distance by the gap along it.
    At a rounded box (``mesh`` is false) S_SPOT and S_WEIGHTS become the point that is closest to the box's edge or corner.

    S_RHO becomes how far below the triangle the core of the touch's ball is to lie, at least ``BALL``.  Returns whether any lane
    has a contact.  A lane whose gap is wider than ``SOON`` thicknesses, or which surely does not touch, gets ``NO_CONTACT``.
    """
    zero, one, tiny, none = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-18), scratch.dtype.type(NO_CONTACT)
    least_cosine, soon, deep = scratch.dtype.type(LEAST_COSINE), scratch.dtype.type(SOON), scratch.dtype.type(BALL)
    for l in range(scratch.shape[1]):
        nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
        # the direction from the core; the solid's normal where the two differ too much
        dx = scratch[S_SPOT, l] - scratch[S_CORE, l]
        dy = scratch[S_SPOT + 1, l] - scratch[S_CORE + 1, l]
        dz = scratch[S_SPOT + 2, l] - scratch[S_CORE + 2, l]
        length = np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
        scale = one / length
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        cosine = dx * nx + dy * ny + dz * nz
        usable = cosine >= least_cosine
        scratch[S_CONTACT + 1, l] = dx if usable else nx
        scratch[S_CONTACT + 2, l] = dy if usable else ny
        scratch[S_CONTACT + 3, l] = dz if usable else nz
        scratch[S_CONTACT, l] = scratch[S_CONTACT, l] / cosine if usable else scratch[S_CONTACT, l]
        scratch[S_USABLE, l] = one if usable else zero
        scratch[S_LENGTH, l] = length
    if not mesh:
        # the core's point on an edge or a corner of the core moves out to that of the box, and the triangle's point follows
        for c in range(3):
            for l in range(scratch.shape[1]):
                q, side, b = scratch[S_CORE + c, l], scratch[S_CONTACT + 1 + c, l], scratch[R_HALF + c, l]
                half = max(b - max(scratch[S_RHO, l] - scratch[R_RADIUS, l], zero), zero)
                outer = b if side > zero else -b
                scratch[S_CORE + c, l] = outer if (abs(q) >= half) & (side != zero) else q
        to_triangle(scratch)
        for l in range(scratch.shape[1]):
            gap = -scratch[R_RADIUS, l]
            gap += scratch[S_CONTACT + 1, l] * (scratch[S_SPOT, l] - scratch[S_CORE, l])
            gap += scratch[S_CONTACT + 2, l] * (scratch[S_SPOT + 1, l] - scratch[S_CORE + 1, l])
            gap += scratch[S_CONTACT + 3, l] * (scratch[S_SPOT + 2, l] - scratch[S_CORE + 2, l])
            scratch[S_CONTACT, l] = gap if scratch[S_USABLE, l] > zero else scratch[S_CONTACT, l]
    any_contact = False
    for l in range(scratch.shape[1]):
        scratch[S_RHO, l] = max(scratch[S_LENGTH, l], deep * scratch[R_THICKNESS, l])
        gap = scratch[S_CONTACT, l]
        near = (scratch[S_CLEAR, l] == zero) & (gap < soon * scratch[R_THICKNESS, l])
        scratch[S_CONTACT, l] = gap if near else none
        any_contact |= near
    return any_contact

"""The point of a triangle that lies deepest in a solid, and the direction in which it is pushed out.

The point is sought by alternating projections (von Neumann; Bauschke and Borwein 1996): from the point to the solid's core, which
is what is left of it below a depth ``rho``, and from there back to the triangle.  They end at the shortest way between triangle and
core.  There the triangle is deepest, and the direction of that way is the normal of contact: along the triangle's own normal where
an edge or a corner of the solid pokes into it, across both edges where two of them cross.  The core of a sphere is its center, and
one round is exact; that of a capsule is its segment.

The core must lie deeper than any point of the triangle: where one turns out to lie deeper than half of ``rho``, this is doubled.
But on a solid with sharp edges a point of the triangle that is nearest to the core is not quite the deepest one: the difference is
up to a fifth of ``rho``.  So ``rho`` begins at two thicknesses, which keeps that error below half of one.
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
    S_RHO,
    S_SPOT,
    S_WEIGHTS,
    measure,
)

NONE = 1e9  # [m], the gap of a lane that does not touch
MESH_ROUNDS, BOX_STEPS = 3, 8
SLOW_ROUND = 0.98  # of the distance is left after a round, where a leap trusts the rounds
DEPTH = 2.0  # rho over the thickness, at first
SOON = 0.25  # gap over the thickness within which a triangle may touch before the next look
CELLS = 0.75  # rho below a mesh's thickness, in cells of its grid
LYING = 1e-3  # share of the radius by which cloth may be in it and yet count as lying on it
SLANT = 0.5  # the least cosine between the normals of contact and of the solid: at a box's corner it is 0.58


@kernel
def to_triangle(scratch):
    """Move S_SPOT to the point of the triangle that is nearest to S_CORE; its barycentric weights go to S_WEIGHTS."""
    zero, one, tiny = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-30)
    for l in range(scratch.shape[1]):
        ax, ay, az = scratch[S_CORNERS, l], scratch[S_CORNERS + 1, l], scratch[S_CORNERS + 2, l]
        bx, by, bz = scratch[S_CORNERS + 3, l] - ax, scratch[S_CORNERS + 4, l] - ay, scratch[S_CORNERS + 5, l] - az
        cx, cy, cz = scratch[S_CORNERS + 6, l] - ax, scratch[S_CORNERS + 7, l] - ay, scratch[S_CORNERS + 8, l] - az
        qx, qy, qz = scratch[S_CORE, l] - ax, scratch[S_CORE + 1, l] - ay, scratch[S_CORE + 2, l] - az
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
        scratch[S_WEIGHTS, l] = one - s - t
        scratch[S_WEIGHTS + 1, l] = s
        scratch[S_WEIGHTS + 2, l] = t
        scratch[S_SPOT, l] = ax + s * bx + t * cx
        scratch[S_SPOT + 1, l] = ay + s * by + t * cy
        scratch[S_SPOT + 2, l] = az + s * bz + t * cz


@kernel
def _to_core_of_box(scratch):
    """Move S_CORE to the core's point nearest to S_SPOT: the half sides of a rounded box, less by what rho exceeds its radius."""
    zero = scratch.dtype.type(0)
    for c in range(3):
        for l in range(scratch.shape[1]):
            half = max(scratch[R_HALF + c, l] - max(scratch[S_RHO, l] - scratch[R_RADIUS, l], zero), zero)
            scratch[S_CORE + c, l] = min(max(scratch[S_SPOT + c, l], -half), half)


@kernel
def _to_core_of_mesh(scratch, shapes, k):
    """Move S_CORE to where the distance is -rho, from S_SPOT along the normal, twice: behind an edge the normals are two."""
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
def _some_may_touch(scratch):
    """Whether any lane's triangle may touch its rounded box; S_CLEAR learns which surely do not.

    The plane through the box's furthest point along the way from S_CORE to S_SPOT parts it from a triangle that is all beyond.
    """
    one, tiny = scratch.dtype.type(1), scratch.dtype.type(1e-18)
    for l in range(scratch.shape[1]):
        nx, ny, nz = (
            scratch[S_SPOT, l] - scratch[S_CORE, l],
            scratch[S_SPOT + 1, l] - scratch[S_CORE + 1, l],
            scratch[S_SPOT + 2, l] - scratch[S_CORE + 2, l],
        )
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        a = scratch[S_CORNERS, l] * nx + scratch[S_CORNERS + 1, l] * ny + scratch[S_CORNERS + 2, l] * nz
        b = scratch[S_CORNERS + 3, l] * nx + scratch[S_CORNERS + 4, l] * ny + scratch[S_CORNERS + 5, l] * nz
        c = scratch[S_CORNERS + 6, l] * nx + scratch[S_CORNERS + 7, l] * ny + scratch[S_CORNERS + 8, l] * nz
        shrunk = scratch[R_RADIUS, l] * scratch.dtype.type(1 - LYING)
        furthest = (
            scratch[R_HALF, l] * abs(nx) + scratch[R_HALF + 1, l] * abs(ny) + scratch[R_HALF + 2, l] * abs(nz) + shrunk * length
        )
        scratch[S_CLEAR, l] = one if min(a, min(b, c)) >= furthest + tiny else scratch[S_CLEAR, l]
    some = False
    for l in range(scratch.shape[1]):
        some |= scratch[S_CLEAR, l] == 0
    return some


@kernel
def _leap(scratch):
    """Write to S_CORE where the last two rounds lead (Aitken's extrapolation).

    Where a long edge of the solid runs at a small angle to the triangle, rounds alone come nearer by little each.
    """
    zero, one, tiny, most = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-18), scratch.dtype.type(SLOW_ROUND)
    for l in range(scratch.shape[1]):
        fx, fy, fz = scratch[S_BETWEEN, l], scratch[S_BETWEEN + 1, l], scratch[S_BETWEEN + 2, l]
        px, py, pz = fx - scratch[S_BEFORE, l], fy - scratch[S_BEFORE + 1, l], fz - scratch[S_BEFORE + 2, l]
        fx, fy, fz = scratch[S_SPOT, l] - fx, scratch[S_SPOT + 1, l] - fy, scratch[S_SPOT + 2, l] - fz
        ratio = (fx * px + fy * py + fz * pz) / max(px * px + py * py + pz * pz, tiny)
        ratio = min(max(ratio, zero), most)
        leap = ratio / (one - ratio)
        scratch[S_CORE, l] = scratch[S_SPOT, l] + leap * fx
        scratch[S_CORE + 1, l] = scratch[S_SPOT + 1, l] + leap * fy
        scratch[S_CORE + 2, l] = scratch[S_SPOT + 2, l] + leap * fz


@uncounted
def find_deepest(scratch, shapes, k):
    """Find the deepest point of the triangle in S_CORNERS, from S_SPOT on, all in the solid's axes; return whether any lane may
    touch.

    It is left in S_SPOT with its weights, and the core's in S_CORE; S_CONTACT has its signed distance and the solid's normal there.
    The steps stand in loops, each kernel at one place: they are inlined, and compilation takes its time for each place.
    """
    mesh, boxes = shapes.kinds[k] == KIND_MESH, False
    for c in range(3):
        for l in range(scratch.shape[1]):
            boxes |= scratch[R_HALF + c, l] > 0
    deep = shapes.cells[k] * scratch.dtype.type(CELLS)
    for l in range(scratch.shape[1]):
        scratch[S_RHO, l] = scratch[R_THICKNESS, l] + deep if mesh else scratch.dtype.type(DEPTH) * scratch[R_THICKNESS, l]
    # a sphere's core is a point, for which one round is all there is to do; a box has two rounds and a leap, twice, and one more
    steps = MESH_ROUNDS if mesh else (BOX_STEPS if boxes else 1)
    for step in range(steps):
        leaps = boxes and not mesh and (step == 3 or step == 6)
        if leaps:
            _leap(scratch)
        elif mesh:
            _to_core_of_mesh(scratch, shapes, k)
        else:
            for e in range(3):
                for l in range(scratch.shape[1]):
                    scratch[S_BEFORE + e, l] = scratch[S_BETWEEN + e, l]
                for l in range(scratch.shape[1]):
                    scratch[S_BETWEEN + e, l] = scratch[S_SPOT + e, l]
            _to_core_of_box(scratch)
        to_triangle(scratch)
        if step == 0 and boxes and not mesh and not _some_may_touch(scratch):
            return False
        if step == 3 or step == steps - 1:
            measure(scratch, S_SPOT, shapes, k, scratch.dtype.type(np.inf))
        if step == 3:
            for l in range(scratch.shape[1]):
                scratch[S_RHO, l] = max(scratch[S_RHO, l], scratch.dtype.type(-2) * scratch[S_CONTACT, l])
    return True


@kernel
def turn_normal(scratch):
    """Turn S_CONTACT's normal into that of contact, and its distance into the gap along it; return whether any lane needs it.

    A lane whose gap is wider than a part of the thickness, or which surely does not touch, has none.
    """
    zero, one, tiny, none = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(1e-18), scratch.dtype.type(NONE)
    slant, soon = scratch.dtype.type(SLANT), scratch.dtype.type(SOON)
    for l in range(scratch.shape[1]):
        nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
        dx = scratch[S_SPOT, l] - scratch[S_CORE, l]
        dy = scratch[S_SPOT + 1, l] - scratch[S_CORE + 1, l]
        dz = scratch[S_SPOT + 2, l] - scratch[S_CORE + 2, l]
        scale = one / np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        cosine = dx * nx + dy * ny + dz * nz
        usable = cosine >= slant
        scratch[S_CONTACT + 1, l] = dx if usable else nx
        scratch[S_CONTACT + 2, l] = dy if usable else ny
        scratch[S_CONTACT + 3, l] = dz if usable else nz
        gap = scratch[S_CONTACT, l] / cosine if usable else scratch[S_CONTACT, l]
        scratch[S_CONTACT, l] = gap if (scratch[S_CLEAR, l] == zero) & (gap < soon * scratch[R_THICKNESS, l]) else none
    some = False
    for l in range(scratch.shape[1]):
        some |= scratch[S_CONTACT, l] < none
    return some

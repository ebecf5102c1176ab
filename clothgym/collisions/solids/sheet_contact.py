"""Contact of a sheet with solids, after each substep: prepare, warm start, solve, store.

It always works on one sheet, whose particles lie side by side in memory: a lane is gathered before, and scattered after.

1. Prepare: solids move on; every few substeps touches and edges are searched for (``triangle_contact``); then touches follow.
2. Warm start: touches apply the impulses of before, so that solids support the cloth on them.
3. Solve: these are corrected, one after the other (``touch_response``), and all particles are pushed out (``particle_contact``).
4. Store: at the next search, touches that are found again take over the impulses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel, merged, placeholder, specialize, uncounted
from clothgym.collisions.solids.particle_contact import PARTICLE_ROWS, resolve_particles
from clothgym.collisions.solids.shapes import COLLIDER_ROWS, KIND_PLANE, R_AXES, R_POINT, R_RADIUS, R_REACH2
from clothgym.collisions.solids.signed_distance import SCRATCH_ROWS
from clothgym.collisions.solids.touch_response import (
    T_IMPULSE,
    TOUCH_COLUMNS,
    follow_touches,
    move_solids,
    solve_touches,
    warm_start_touches,
)
from clothgym.collisions.solids.triangle_contact import COLUMNS, choose_by_cells, choose_one_by_one, find_touches

search = placeholder("search", "``triangle_contact.find_touches``, for a grid or for any triangles")
resolve_sheet = placeholder("resolve_sheet", "of (r, s, m, triangles, shapes, colliders, h, lead, step, look_every, room, lane)")


class Room(NamedTuple):
    """What contact of a block remembers until the next search, and its scratch.

    touches: of each lane, (lanes, most, TOUCH_COLUMNS); which: triangle and solid of each, (lanes, most, 2); number: how many,
    (lanes, 1).
    edges, pushes, counts: of each lane, see ``particle_contact.resolve_particles``.
    kept: impulses of triangles at solids [N s], (colliders, triangles, 3).  rows: (PARTICLE_ROWS, particles).  chosen: (2
    triangles,).  scratch: (SCRATCH_ROWS, COLUMNS).
    sheets: positions [m] and velocities [m/s] of lanes, (lanes, 6, particles).  masses: inverse masses [1/kg], (lanes, particles).
    own: the rows of one lane's solids, (colliders, COLLIDER_ROWS, 1).  bounds: of each lane's sheet [m], (6, lanes).  near: whether
    it may touch a solid, (lanes,).
    """

    touches: NDArray
    which: NDArray
    number: NDArray
    edges: NDArray
    pushes: NDArray
    counts: NDArray
    kept: NDArray
    rows: NDArray
    chosen: NDArray
    scratch: NDArray
    sheets: NDArray
    masses: NDArray
    own: NDArray
    bounds: NDArray
    near: NDArray


@kernel
def scratch_for_contact(x, triangles, shapes):
    """The ``Room`` of a block with positions x [m], (3, particles, lanes)."""
    dtype, particles, lanes, number = x.dtype, x.shape[1], x.shape[2], triangles.shape[0]
    solids, most = shapes.kinds.shape[0], 0
    for k in range(solids):
        most += number * (shapes.kinds[k] != KIND_PLANE)
    return Room(
        np.empty((lanes, most, TOUCH_COLUMNS), dtype),
        np.empty((lanes, most, 2), np.int64),
        np.zeros((lanes, 1), np.int64),
        np.empty((lanes, solids, particles), np.int64),
        np.empty((lanes, solids, particles, 3), dtype),
        np.zeros((lanes, solids), np.int64),
        np.zeros((solids, number, 3), dtype),
        np.empty((PARTICLE_ROWS, particles), dtype),
        np.empty(2 * number, np.int64),
        np.empty((SCRATCH_ROWS, COLUMNS), dtype),
        np.empty((lanes, 6, particles), dtype),
        np.empty((lanes, particles), dtype),
        np.empty((solids, COLLIDER_ROWS, 1), dtype),
        np.empty((6, lanes), dtype),
        np.empty(lanes, np.bool_),
    )


def _resolve_sheet(r, s, m, triangles, shapes, colliders, h, lead, step, look_every, room, lane):
    """Contact of one sheet, of its particles and between them.

    r: positions [m], s: velocities [m/s], (3, particles).  m: inverse masses [1/kg], (particles,); attached particles are left
    alone.  triangles: (triangles, 3).  colliders: rows, (colliders, COLLIDER_ROWS, 1), of solids that have moved on.
    h: the substep [s].  lead: time for which the velocity has already moved the positions [s].  step: of the control step,
    before which no touch has borne anything.  look_every: substeps after which touches are searched for again.
    """
    touches, which, number = room.touches[lane], room.which[lane], room.number[lane]
    edges, pushes, counts = room.edges[lane], room.pushes[lane], room.counts[lane]
    # search for touches with all solids but planes, which touch particles first; those found again keep their impulses
    if step % look_every == 0:
        kept = room.kept
        kept[:] = 0
        if step > 0:
            for n in range(number[0]):
                for e in range(3):
                    kept[which[n, 1], which[n, 0], e] = touches[n, T_IMPULSE + e]
        number[0] = 0
        for k in range(shapes.kinds.shape[0]):
            counts[k] = 0
            if shapes.kinds[k] != KIND_PLANE:
                search(
                    r, triangles, shapes, k, colliders[k], touches, which, number, edges, pushes, counts, kept, room.rows,
                    room.chosen, room.scratch,
                )  # fmt: skip
    # touches follow, bear what lies on them, and are corrected
    found = touches[: number[0]]
    follow_touches(r, triangles, colliders, found, which, room.scratch)
    warm_start_touches(r, s, m, triangles, found, which, lead)
    solve_touches(r, s, m, triangles, colliders, found, which, h, lead)
    # particles
    resolve_particles(r, s, m, shapes, colliders, h, lead, edges, pushes, counts, room.rows, room.scratch)


@uncounted
def _resolve_particles_alone(r, s, m, triangles, shapes, colliders, h, lead, step, look_every, room, lane):
    """The same for particles alone."""
    resolve_particles(
        r,
        s,
        m,
        shapes,
        colliders,
        h,
        lead,
        room.edges[lane],
        room.pushes[lane],
        room.counts[lane],
        room.rows,
        room.scratch,
    )


def _resolve_where_it_lies(x, v, w, triangles, shapes, colliders, h, lead, step, look_every, room):
    """Move the solids on, and resolve the contacts of a block that is one sheet; x, v: (3, particles, 1)."""
    move_solids(colliders, h)
    resolve_sheet(merged(x), merged(v), merged(w), triangles, shapes, colliders, h, lead, step, look_every, room, 0)


@uncounted
def _find_near(x, shapes, colliders, bounds, near):
    """Find the lanes in which the bounding box of the sheet comes near a solid: ``near``, (lanes,); bounds: scratch, (6, lanes)."""
    lanes, zero = x.shape[2], x.dtype.type(0)
    # the bounding boxes
    for c in range(3):
        for l in range(lanes):
            bounds[c, l] = bounds[3 + c, l] = x[c, 0, l]
        for p in range(1, x.shape[1]):
            for l in range(lanes):
                bounds[c, l] = min(bounds[c, l], x[c, p, l])
                bounds[3 + c, l] = max(bounds[3 + c, l], x[c, p, l])
    # the lowest corner over a plane, or the squared distance from the solid's point
    near[:] = False
    for k in range(shapes.kinds.shape[0]):
        plane = shapes.kinds[k] == KIND_PLANE
        for l in range(lanes):
            height, beyond = -colliders[k, R_RADIUS, l], -colliders[k, R_REACH2, l]
            for c in range(3):
                at, normal = colliders[k, R_POINT + c, l], colliders[k, R_AXES + 6 + c, l]
                low, high = bounds[c, l] - at, bounds[3 + c, l] - at
                height += normal * (low if normal > zero else high)
                gap = max(max(low, -high), zero)
                beyond += gap * gap
            near[l] |= (height if plane else beyond) < zero


def _resolve_lanes(x, v, w, triangles, shapes, colliders, h, lead, step, look_every, room):
    """The same for a block of many sheets, in lanes: those that may touch a solid, on a copy; x, v: (3, particles, lanes)."""
    lanes, particles = x.shape[2], x.shape[1]
    sheets, near, own = room.sheets, room.near, room.own
    move_solids(colliders, h)
    _find_near(x, shapes, colliders, room.bounds, near)
    any_near = False
    for l in range(lanes):
        any_near |= near[l]
        # what was found before the last search is not what is there now
        if not near[l] and step % look_every == 0:
            room.number[l, 0] = 0
            room.counts[l] = 0
    if not any_near:
        return
    # gather
    for c in range(3):
        for p in range(particles):
            for l in range(lanes):
                sheets[l, c, p] = x[c, p, l]
                sheets[l, 3 + c, p] = v[c, p, l]
    for p in range(particles):
        for l in range(lanes):
            room.masses[l, p] = w[p, l]
    for l in range(lanes):
        if near[l]:
            for k in range(colliders.shape[0]):
                for e in range(COLLIDER_ROWS):
                    own[k, e, 0] = colliders[k, e, l]
            resolve_sheet(sheets[l, :3], sheets[l, 3:], room.masses[l], triangles, shapes, own, h, lead, step, look_every, room, l)
    # scatter
    for c in range(3):
        for p in range(particles):
            for l in range(lanes):
                x[c, p, l] = sheets[l, c, p]
                v[c, p, l] = sheets[l, 3 + c, p]


@kernel
def resolve_nothing(x, v, w, triangles, shapes, colliders, h, lead, step, look_every, room):
    """``resolve`` without solids."""


@kernel
def no_scratch(x, triangles, shapes):
    """``scratch_for_contact`` without solids."""
    return (np.empty(0, x.dtype),)


def kernels_of(contact: str, layout: str) -> dict[str, Any]:
    """Kernels of contact, by the names under which the main loop calls them.

    contact: "sheet", with its "particles" alone, or with "nothing".  layout: see ``layout.Layout``.
    """
    if contact == "nothing":
        return {"resolve": resolve_nothing, "scratch_for_contact": no_scratch}
    where = _resolve_lanes if layout == "lanes" else _resolve_where_it_lies
    which = f"{contact}_{layout}"
    one: Any = _resolve_particles_alone
    if contact == "sheet":
        choose = {"choose_near": choose_by_cells if layout == "grid" else choose_one_by_one}
        one = specialize(
            uncounted(_resolve_sheet), f"resolve_{which}_one", search=specialize(uncounted(find_touches), f"find_{which}", **choose)
        )
    return {
        "resolve": specialize(uncounted(where), f"resolve_{which}", resolve_sheet=one),
        "scratch_for_contact": scratch_for_contact,
    }


def needed(contact: str, kinds: NDArray) -> str:
    """The least of ``kernels_of`` that solids of these kinds need, so that less is compiled; a plane touches particles first."""
    if not len(kinds):
        return "nothing"
    return contact if np.any(kinds != KIND_PLANE) else "particles"

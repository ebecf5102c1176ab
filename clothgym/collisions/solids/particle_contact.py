"""Contact of sheets with solids in lanes: of the particles here, of the triangles in ``triangle_contact``.

The contact law (``contact_law``) is applied after each substep to the positions and velocities that the integrator left.  For one
sheet whose particles lie side by side the same is in ``grid_contact``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel, placeholder, specialize
from clothgym.collisions.solids.contact_law import TINY, contact_change
from clothgym.collisions.solids.grid_contact import resolve_on_sheet, resolve_particles_on_sheet, room_on_sheet
from clothgym.collisions.solids.shapes import KIND_PLANE, KIND_ROUNDED_BOX, R_FRICTION, R_VELOCITY
from clothgym.collisions.solids.signed_distance import (
    S_CONTACT,
    S_INVERSE_MASS,
    S_MOTION,
    S_SPOT,
    SCRATCH_ROWS,
    Shapes,
    lay_out,
    may_touch_plane,
    may_touch_solid,
    measure_in_world,
    measure_mesh,
    measure_plane,
    measure_rounded_box,
    normal_to_world,
    to_axes,
)
from clothgym.collisions.solids.touch_response import T_IMPULSE, bear_touches, follow_touches, move_solids, press_touches
from clothgym.collisions.solids.triangle_contact import find_touches, may_touch_sheet, room_for_touches
from clothgym.state import Layout

may_touch = placeholder("may_touch", "of (x, p, collider): whether particle p of any lane may touch the solid")
measure_solid = placeholder(
    "measure_solid",
    "of (scratch, spot, shapes, k, thickness): writes the signed distance and the normal at a spot in the solid's axes to scratch",
)


@inlined
def _push_particle_out(x, v, w, p, carried, scratch):
    """Apply the contact law to particle p, for the distance and normal in S_CONTACT."""
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    # its velocity and inverse mass
    for c in range(3):
        for l in range(x.shape[2]):
            scratch[S_MOTION + c, l] = v[c, p, l]
    for l in range(x.shape[2]):
        scratch[S_INVERSE_MASS, l] = w[p, l]
    # the changes: of position to S_SPOT, of velocity to S_MOTION
    for l in range(x.shape[2]):
        nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
        ux = scratch[S_MOTION, l] - scratch[R_VELOCITY, l]
        uy = scratch[S_MOTION + 1, l] - scratch[R_VELOCITY + 1, l]
        uz = scratch[S_MOTION + 2, l] - scratch[R_VELOCITY + 2, l]
        mx, my, mz, cx, cy, cz = contact_change(
            scratch[S_CONTACT, l], nx, ny, nz, ux, uy, uz, scratch[S_INVERSE_MASS, l], scratch[R_FRICTION, l], carried, zero, one,
            tiny,
        )  # fmt: skip
        scratch[S_SPOT, l] = mx
        scratch[S_SPOT + 1, l] = my
        scratch[S_SPOT + 2, l] = mz
        scratch[S_MOTION, l] = cx
        scratch[S_MOTION + 1, l] = cy
        scratch[S_MOTION + 2, l] = cz
    # apply them
    for c in range(3):
        for l in range(x.shape[2]):
            x[c, p, l] += scratch[S_SPOT + c, l]
        for l in range(x.shape[2]):
            v[c, p, l] += scratch[S_MOTION + c, l]


def _resolve_solid(x, v, w, collider, shapes, k, carried, scratch):
    """Resolve the contacts of one block's particles with solid k, whose rows are in the scratch."""
    for p in range(x.shape[1]):
        if may_touch(x, p, collider):
            to_axes(x, p, scratch, S_SPOT)
            measure_solid(scratch, S_SPOT, shapes, k, x.dtype.type(0))
            normal_to_world(scratch)
            _push_particle_out(x, v, w, p, carried, scratch)


# one for each kind: a branch in the loop costs a single environment as much as the contact itself
_resolve_plane = specialize(_resolve_solid, "resolve_plane", may_touch=may_touch_plane, measure_solid=measure_plane)
_resolve_rounded_box = specialize(
    _resolve_solid, "resolve_rounded_box", may_touch=may_touch_solid, measure_solid=measure_rounded_box
)
_resolve_mesh = specialize(_resolve_solid, "resolve_mesh", may_touch=may_touch_solid, measure_solid=measure_mesh)


@apart
def _resolve_each(x, v, w, shapes, colliders, carried, scratch):
    """Resolve the contacts of one block's particles with each solid."""
    kinds = shapes.kinds
    for k in range(kinds.shape[0]):
        collider = colliders[k]
        lay_out(collider, scratch)
        if kinds[k] == KIND_PLANE:
            _resolve_plane(x, v, w, collider, shapes, k, carried, scratch)
        elif kinds[k] == KIND_ROUNDED_BOX:
            _resolve_rounded_box(x, v, w, collider, shapes, k, carried, scratch)
        else:
            _resolve_mesh(x, v, w, collider, shapes, k, carried, scratch)


@apart
def resolve_particles(x, v, w, triangles, shapes, colliders, h, carried, step, look_every, room):
    """Move the solids of one block on, and resolve its particles' contacts with them after a substep.

    x: [m], v: [m/s], (3, particles, lanes).  w: inverse masses [1/kg], (particles, lanes); attached particles are left alone.
    colliders: rows, (colliders, COLLIDER_ROWS, lanes).  h: the substep [s].  carried: time for which the velocity has already moved
    the positions [s].  room: from ``room_in_lanes``.  triangles, step and look_every are for ``resolve``.
    """
    move_solids(colliders, h)
    _resolve_each(x, v, w, shapes, colliders, carried, room[1])


@apart
def resolve(x, v, w, triangles, shapes, colliders, h, carried, step, look_every, room):
    """The same, and the sheet between the particles, see ``touch_response``.

    triangles: (triangles, 3).  step: of the control step, before which no touch has borne anything.  look_every: substeps after
    which touches are searched for again.
    """
    touches, scratch = room
    rows, which, count, kept, _ = touches
    kinds = shapes.kinds
    move_solids(colliders, h)
    # search for touches with all solids but planes, which touch particles first; those found again keep their impulses
    if step % look_every == 0:
        kept[:] = 0
        if step > 0:
            for n in range(count[0]):
                kept[which[n, 1], which[n, 0]] = rows[n, T_IMPULSE : T_IMPULSE + 3]
        count[0] = 0
        for k in range(kinds.shape[0]):
            if kinds[k] != KIND_PLANE and may_touch_sheet(x, colliders[k], scratch):
                lay_out(colliders[k], scratch)
                find_touches(x, triangles, shapes, k, touches, scratch)
    # where they are now; they bear what lies on them, and after the particles they are corrected
    follow_touches(x, triangles, colliders, touches, scratch)
    bear_touches(x, v, w, triangles, touches, carried)
    _resolve_each(x, v, w, shapes, colliders, carried, scratch)
    press_touches(x, v, w, triangles, colliders, touches, h, carried)


@kernel
def resolve_nothing(x, v, w, triangles, shapes, colliders, h, carried, step, look_every, room):
    """``resolve`` without solids."""


@kernel
def room_in_lanes(x, triangles, shapes):
    """Room for contact of one block, in lanes: for its touches, and scratch, (SCRATCH_ROWS, lanes)."""
    return room_for_touches(x, triangles, shapes), np.empty((SCRATCH_ROWS, x.shape[2]), x.dtype)


# contact with the sheet, with its particles alone, and with nothing: in lanes (False), and for one sheet whose particles lie side
# by side (True)
KERNELS = {
    False: {"sheet": resolve, "particles": resolve_particles, "nothing": resolve_nothing},
    True: {"sheet": resolve_on_sheet, "particles": resolve_particles_on_sheet, "nothing": resolve_nothing},
}
ROOM = {False: room_in_lanes, True: room_on_sheet}


def kernels_of(contact: str, by_particle: bool) -> dict[str, Any]:
    """Kernels of contact, by the names under which the main loop calls them."""
    return {"resolve": KERNELS[by_particle][contact], "room_for_contact": ROOM[by_particle]}


def needed(contact: str, kinds: NDArray) -> str:
    """The least of ``KERNELS`` that solids of these kinds need, so that less is compiled; a plane touches particles first."""
    if not len(kinds):
        return "nothing"
    return contact if np.any(kinds != KIND_PLANE) else "particles"


@kernel
def signed_distances(first, last, x, shapes, colliders, out):
    """Signed distance of each particle to each collider [m]: ``out``, (blocks, colliders, particles, lanes)."""
    for b in range(first, last):
        scratch = np.empty((SCRATCH_ROWS, x.shape[3]), x.dtype)
        for k in range(colliders.shape[1]):
            lay_out(colliders[b, k], scratch)
            for p in range(x.shape[2]):
                measure_in_world(x[b], p, scratch, shapes, k)
                out[b, k, p] = scratch[S_CONTACT]


class Contacts(NamedTuple):
    """Signed distance of particles to the nearest collider [m], inf without any, and its index, or -1, (num_envs, particles)."""

    distance: NDArray
    collider: NDArray


def contacts(layout: Layout, x: NDArray, shapes: Shapes, colliders: NDArray) -> Contacts:
    """Signed distances of a batch; x, (blocks, 3, particles, lanes) [m], and colliders in blocks."""
    count = colliders.shape[1]
    if not count:
        shape = (layout.num_envs, x.shape[2])
        return Contacts(np.full(shape, np.inf, x.dtype), np.full(shape, -1))
    out = np.empty((layout.blocks, count, x.shape[2], layout.lanes), x.dtype)
    signed_distances(0, layout.blocks, x, shapes, colliders, out)
    distances = layout.to_public(out)
    return Contacts(distances.min(axis=1), distances.argmin(axis=1))

"""Contact of sheets with solids: no penetration, no inward velocity, Coulomb friction (see ``contact_law``).

Applied after each substep to the positions and velocities that the integrator left, of the particles and of the sheet between them
(``surface``).  For one sheet whose particles lie side by side the same is in ``sheet_response``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel, specialize
from clothgym.collisions.contact_law import TINY, contact_change
from clothgym.collisions.distance import (
    CONTACT,
    DESK,
    MOTION,
    SPOT,
    YIELDING,
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
from clothgym.collisions.shapes import FRICTION, PLANE, POINT, ROUNDED_BOX, VELOCITY
from clothgym.collisions.sheet_response import resolve_on_sheet, resolve_particles_on_sheet, room_on_sheet
from clothgym.collisions.surface import any_near, find_touches, press, room_for_touches
from clothgym.state import Layout


@inlined
def _push_out(x, v, w, p, carried, desk):
    """Correct the position and velocity of particle ``p``, for the contact on the desk."""
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    for c in range(3):
        for l in range(x.shape[2]):
            desk[MOTION + c, l] = v[c, p, l]
    for l in range(x.shape[2]):
        desk[YIELDING, l] = w[p, l]
    for l in range(x.shape[2]):
        nx, ny, nz = desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
        ux = desk[MOTION, l] - desk[VELOCITY, l]
        uy = desk[MOTION + 1, l] - desk[VELOCITY + 1, l]
        uz = desk[MOTION + 2, l] - desk[VELOCITY + 2, l]
        mx, my, mz, cx, cy, cz = contact_change(
            desk[CONTACT, l], nx, ny, nz, ux, uy, uz, desk[YIELDING, l], desk[FRICTION, l], carried, zero, one, tiny
        )
        desk[SPOT, l] = mx
        desk[SPOT + 1, l] = my
        desk[SPOT + 2, l] = mz
        desk[MOTION, l] = cx
        desk[MOTION + 1, l] = cy
        desk[MOTION + 2, l] = cz
    for c in range(3):
        for l in range(x.shape[2]):
            x[c, p, l] += desk[SPOT + c, l]
        for l in range(x.shape[2]):
            v[c, p, l] += desk[MOTION + c, l]


def _resolve_solid(x, v, w, collider, shapes, k, carried, desk):
    """Resolve the contacts of one block's particles with the solid on the desk."""
    for p in range(x.shape[1]):
        if may_touch(x, p, collider):  # noqa: F821
            to_axes(x, p, desk, SPOT)
            measure_solid(desk, SPOT, shapes, k, x.dtype.type(0))  # noqa: F821
            normal_to_world(desk)
            _push_out(x, v, w, p, carried, desk)


# one for each family: a branch inside the loop costs a single environment as much as the contact itself
_resolve_plane = specialize(_resolve_solid, "resolve_plane", may_touch=may_touch_plane, measure_solid=measure_plane)
_resolve_rounded_box = specialize(
    _resolve_solid, "resolve_rounded_box", may_touch=may_touch_solid, measure_solid=measure_rounded_box
)
_resolve_mesh = specialize(_resolve_solid, "resolve_mesh", may_touch=may_touch_solid, measure_solid=measure_mesh)


@apart
def resolve_particles(x, v, w, triangles, shapes, colliders, h, carried, look, room):
    """Resolve the contacts of one block's particles after a substep of ``h`` [s], and move the solids on by their velocity.

    x [m], v [m/s]: (3, particles, lanes); w [1/kg]: (particles, lanes), held particles are left alone; colliders: rows of
    ``shapes``, (colliders, ROWS, lanes); carried: how long the velocity that friction takes has moved the positions already [s];
    room: of ``room_in_lanes``.  The others are for ``resolve``.
    """
    kinds, desk = shapes.kinds, room[1]
    for k in range(kinds.shape[0]):
        collider = colliders[k]
        for c in range(3):
            for l in range(x.shape[2]):
                collider[POINT + c, l] += h * collider[VELOCITY + c, l]
        lay_out(collider, desk)
        if kinds[k] == PLANE:
            _resolve_plane(x, v, w, collider, shapes, k, carried, desk)
        elif kinds[k] == ROUNDED_BOX:
            _resolve_rounded_box(x, v, w, collider, shapes, k, carried, desk)
        else:
            _resolve_mesh(x, v, w, collider, shapes, k, carried, desk)


@apart
def resolve(x, v, w, triangles, shapes, colliders, h, carried, look, room):
    """The same for the whole sheet.

    triangles: of the sheet; look: whether to look anew where it touches between its particles.
    """
    resolve_particles(x, v, w, triangles, shapes, colliders, h, carried, look, room)
    touches, desk = room
    kinds = shapes.kinds
    if look:
        touches[2][0] = 0
        for k in range(kinds.shape[0]):
            if kinds[k] != PLANE and any_near(x, colliders[k], desk):
                lay_out(colliders[k], desk)
                find_touches(x, triangles, shapes, k, touches, desk)
    press(x, v, w, triangles, colliders, touches, h, carried, desk)


@kernel
def resolve_nothing(x, v, w, triangles, shapes, colliders, h, carried, look, room):
    """The same where there are no solids."""


@kernel
def room_in_lanes(x, triangles, shapes):
    """Room for contact of one block, in lanes: touches, and a desk."""
    return room_for_touches(x, triangles, shapes), np.empty((DESK, x.shape[2]), x.dtype)


# the names that the main loop calls, for contact with the sheet, with its particles alone, and with nothing: in lanes, and for one
# sheet whose particles lie side by side
KERNELS = {
    False: {"sheet": resolve, "particles": resolve_particles, "nothing": resolve_nothing},
    True: {"sheet": resolve_on_sheet, "particles": resolve_particles_on_sheet, "nothing": resolve_nothing},
}
ROOM = {False: room_in_lanes, True: room_on_sheet}


def kernels_of(contact: str, by_particle: bool) -> dict[str, Any]:
    """Kernels of contact by the names that the main loop calls them by."""
    return {"resolve": KERNELS[by_particle][contact], "room_for_contact": ROOM[by_particle]}


def needed(contact: str, kinds: NDArray) -> str:
    """The least of ``KERNELS`` that does for solids of these kinds: less is to be compiled.  A plane touches particles first."""
    if not len(kinds):
        return "nothing"
    return contact if np.any(kinds != PLANE) else "particles"


@kernel
def signed_distances(first, last, x, shapes, colliders, out):
    """Signed distance of every particle to every collider [m], (blocks, colliders, particles, lanes)."""
    for b in range(first, last):
        desk = np.empty((DESK, x.shape[3]), x.dtype)
        for k in range(colliders.shape[1]):
            lay_out(colliders[b, k], desk)
            for p in range(x.shape[2]):
                measure_in_world(x[b], p, desk, shapes, k)
                out[b, k, p] = desk[CONTACT]


class Contacts(NamedTuple):
    """Contact of particles with colliders: signed distance to the nearest [m], and which it is, (num_envs, particles)."""

    distance: NDArray
    collider: NDArray


def contacts(layout: Layout, x: NDArray, shapes: Shapes, colliders: NDArray) -> Contacts:
    """Those of a batch; x and colliders in blocks."""
    count = colliders.shape[1]
    if not count:
        shape = (layout.num_envs, x.shape[2])
        return Contacts(np.full(shape, np.inf, x.dtype), np.full(shape, -1))
    out = np.empty((layout.blocks, count, x.shape[2], layout.lanes), x.dtype)
    signed_distances(0, layout.blocks, x, shapes, colliders, out)
    distances = layout.to_public(out)
    return Contacts(distances.min(axis=1), distances.argmin(axis=1))

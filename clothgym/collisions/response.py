"""Contact of a sheet with solids: no penetration, no inward velocity, Coulomb friction.

Applied after each substep to the positions and velocities that the integrator left, of the particles and of the sheet between them
(``surface``).  The normal impulse is the inward velocity that is taken away; friction takes at most ``mu`` times
as much from the tangential velocity (Bridson, Fedkiw and Anderson 2002: ``v_T <- max(1 - mu dv_N/|v_T|, 0) v_T``).  What friction
takes from the velocity is taken from the displacement too, as far as the integrator has moved by it, or a sheet at rest on a slope
would creep by ``h^2 g sin`` a substep.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel, specialize
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
from clothgym.collisions.surface import any_near, find_touches, press
from clothgym.state import Layout


@inlined
def _push_out(x, v, w, p, carried, desk):
    """Correct the position and velocity of particle ``p``, for the contact on the desk."""
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for c in range(3):
        for l in range(x.shape[2]):
            desk[MOTION + c, l] = v[c, p, l]
    for l in range(x.shape[2]):
        desk[YIELDING, l] = w[p, l]
    for l in range(x.shape[2]):
        distance, nx, ny, nz = desk[CONTACT, l], desk[CONTACT + 1, l], desk[CONTACT + 2, l], desk[CONTACT + 3, l]
        touching = distance < zero and desk[YIELDING, l] > zero
        # velocity relative to the solid, split along the normal
        ux = desk[MOTION, l] - desk[VELOCITY, l]
        uy = desk[MOTION + 1, l] - desk[VELOCITY + 1, l]
        uz = desk[MOTION + 2, l] - desk[VELOCITY + 2, l]
        un = ux * nx + uy * ny + uz * nz
        tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
        stopped = max(-un, zero)
        speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
        lost = min(desk[FRICTION, l] * stopped / speed, one)
        lost = lost if touching else zero
        stopped = stopped if touching else zero
        depth = -distance if touching else zero
        desk[SPOT, l] = depth * nx - carried * lost * tx
        desk[SPOT + 1, l] = depth * ny - carried * lost * ty
        desk[SPOT + 2, l] = depth * nz - carried * lost * tz
        desk[MOTION, l] = stopped * nx - lost * tx
        desk[MOTION + 1, l] = stopped * ny - lost * ty
        desk[MOTION + 2, l] = stopped * nz - lost * tz
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
def resolve_particles(x, v, w, triangles, shapes, colliders, h, carried, look, touches, desk):
    """Resolve the contacts of one block's particles after a substep of ``h`` [s], and move the solids on by their velocity.

    x [m], v [m/s]: (3, particles, lanes); w [1/kg]: (particles, lanes), held particles are left alone; colliders: rows of
    ``shapes``, (colliders, ROWS, lanes); carried: how long the velocity that friction takes has moved the positions already [s];
    desk: scratch, (DESK, lanes).  The others are for ``resolve``.
    """
    kinds = shapes.kinds
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
def resolve(x, v, w, triangles, shapes, colliders, h, carried, look, touches, desk):
    """The same for the whole sheet.

    triangles: of the sheet; look: whether to look anew where it touches between its particles, to ``touches``.
    """
    resolve_particles(x, v, w, triangles, shapes, colliders, h, carried, look, touches, desk)
    kinds = shapes.kinds
    if look:
        touches[2][0] = 0
        for k in range(kinds.shape[0]):
            if kinds[k] != PLANE and any_near(x, colliders[k], desk):
                lay_out(colliders[k], desk)
                find_touches(x, triangles, shapes, k, touches, desk)
    press(x, v, w, triangles, colliders, touches, h, carried, desk)


@kernel
def resolve_nothing(x, v, w, triangles, shapes, colliders, h, carried, look, touches, desk):
    """The same where there are no solids."""


# the name that the main loop calls, for contact with the sheet, with its particles alone, and with nothing
KERNELS = {"sheet": {"resolve": resolve}, "particles": {"resolve": resolve_particles}, "nothing": {"resolve": resolve_nothing}}


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

"""Contact of particles with solids: no penetration, no inward velocity, Coulomb friction.

Applied once after each substep, to the positions and velocities that the integrator left.  The normal impulse is the inward
velocity that is taken away; friction takes at most ``mu`` times as much from the tangential velocity (Bridson, Fedkiw and
Anderson 2002: ``v_T <- max(1 - mu dv_N/|v_T|, 0) v_T``).  What friction takes from the velocity is taken from the substep's
displacement too, as far as the integrator has moved by it, or a sheet at rest on a slope would creep by ``h^2 g sin`` a substep.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.collisions.shapes import AXES, FRICTION, HALF, PLANE, POINT, RADIUS, REACH2, VELOCITY
from clothgym.state import Layout


@kernel
def _may_touch(x, collider, kind):
    """Whether any lane's particle is inside the solid's bound.  It only decides whether work can be skipped."""
    zero = x.dtype.type(0)
    near = False
    if kind == PLANE:
        for l in range(x.shape[1]):
            height = zero
            for c in range(3):
                height += (x[c, l] - collider[POINT + c, l]) * collider[AXES + 6 + c, l]
            near |= height < zero
    else:
        for l in range(x.shape[1]):
            dx = x[0, l] - collider[POINT, l]
            dy = x[1, l] - collider[POINT + 1, l]
            dz = x[2, l] - collider[POINT + 2, l]
            near |= dx * dx + dy * dy + dz * dz < collider[REACH2, l]
    return near


@kernel
def distance_and_normal(x, collider, kind, out):
    """Signed distance [m] to ``out[0]`` and outward unit normal to ``out[1:4]``, each (lanes,), of one particle, (3, lanes).

    For the rounded box, with q the position in its axes and a = |q| - b: outside the inner box the distance is
    ``|max(a, 0)| - r``, inside it ``max(a) - r``.
    """
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    if kind == PLANE:
        for l in range(x.shape[1]):
            nx, ny, nz = collider[AXES + 6, l], collider[AXES + 7, l], collider[AXES + 8, l]
            dx, dy, dz = x[0, l] - collider[POINT, l], x[1, l] - collider[POINT + 1, l], x[2, l] - collider[POINT + 2, l]
            out[0, l] = dx * nx + dy * ny + dz * nz
            out[1, l] = nx
            out[2, l] = ny
            out[3, l] = nz
        return
    # position in the solid's axes
    for c in range(3):
        for l in range(x.shape[1]):
            dx, dy, dz = x[0, l] - collider[POINT, l], x[1, l] - collider[POINT + 1, l], x[2, l] - collider[POINT + 2, l]
            out[c, l] = dx * collider[AXES + 3 * c, l] + dy * collider[AXES + 3 * c + 1, l] + dz * collider[AXES + 3 * c + 2, l]
    # distance, and the normal in those axes
    for l in range(x.shape[1]):
        qx, qy, qz = out[0, l], out[1, l], out[2, l]
        ax, ay, az = abs(qx) - collider[HALF, l], abs(qy) - collider[HALF + 1, l], abs(qz) - collider[HALF + 2, l]
        ox, oy, oz = max(ax, zero), max(ay, zero), max(az, zero)
        outside = np.sqrt(ox * ox + oy * oy + oz * oz)
        deepest = max(ax, max(ay, az))
        beyond = outside > zero
        scale = one / outside if beyond else one
        # inside, the normal is that of the nearest face
        fx = one if ax >= deepest else zero
        fy = one if (ay >= deepest and ax < deepest) else zero
        fz = one - fx - fy
        out[0, l] = (outside if beyond else deepest) - collider[RADIUS, l]
        out[1, l] = (ox * scale if beyond else fx) * (one if qx >= zero else -one)
        out[2, l] = (oy * scale if beyond else fy) * (one if qy >= zero else -one)
        out[3, l] = (oz * scale if beyond else fz) * (one if qz >= zero else -one)
    # the normal in the world's axes
    for l in range(x.shape[1]):
        nx, ny, nz = out[1, l], out[2, l], out[3, l]
        out[1, l] = nx * collider[AXES, l] + ny * collider[AXES + 3, l] + nz * collider[AXES + 6, l]
        out[2, l] = nx * collider[AXES + 1, l] + ny * collider[AXES + 4, l] + nz * collider[AXES + 7, l]
        out[3, l] = nx * collider[AXES + 2, l] + ny * collider[AXES + 5, l] + nz * collider[AXES + 8, l]


@kernel
def _push_out(x, v, w, collider, carried, contact):
    """Correct one particle's position and velocity, (3, lanes), for the distance and normal in ``contact``."""
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for l in range(x.shape[1]):
        distance, nx, ny, nz = contact[0, l], contact[1, l], contact[2, l], contact[3, l]
        touching = distance < zero and w[l] > zero
        # velocity relative to the solid, split along the normal
        ux = v[0, l] - collider[VELOCITY, l]
        uy = v[1, l] - collider[VELOCITY + 1, l]
        uz = v[2, l] - collider[VELOCITY + 2, l]
        un = ux * nx + uy * ny + uz * nz
        tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
        stopped = max(-un, zero)
        speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
        lost = min(collider[FRICTION, l] * stopped / speed, one)
        lost = lost if touching else zero
        stopped = stopped if touching else zero
        depth = -distance if touching else zero
        x[0, l] += depth * nx - carried * lost * tx
        x[1, l] += depth * ny - carried * lost * ty
        x[2, l] += depth * nz - carried * lost * tz
        v[0, l] += stopped * nx - lost * tx
        v[1, l] += stopped * ny - lost * ty
        v[2, l] += stopped * nz - lost * tz


@kernel
def resolve(x, v, w, kinds, colliders, h, carried, contact):
    """Resolve the contacts of one block after a substep of ``h`` [s], and move the solids on by their velocity.

    x [m], v [m/s]: (particles, 3, lanes); w [1/kg]: (particles, lanes), held particles are left alone; kinds: (colliders,);
    colliders: rows of ``shapes``, (colliders, ROWS, lanes); carried: how long the velocity that friction takes has moved the
    positions already [s]; contact: scratch, (4, lanes).
    """
    for k in range(kinds.shape[0]):
        collider = colliders[k]
        for c in range(3):
            for l in range(x.shape[2]):
                collider[POINT + c, l] += h * collider[VELOCITY + c, l]
        for p in range(x.shape[0]):
            if _may_touch(x[p], collider, kinds[k]):
                distance_and_normal(x[p], collider, kinds[k], contact)
                _push_out(x[p], v[p], w[p], collider, carried, contact)


@kernel
def signed_distances(first, last, x, kinds, colliders, out):
    """Signed distance of every particle to every collider [m], (blocks, colliders, particles, lanes)."""
    for b in range(first, last):
        contact = np.empty((4, x.shape[3]), x.dtype)
        for k in range(kinds.shape[0]):
            for p in range(x.shape[1]):
                distance_and_normal(x[b, p], colliders[b, k], kinds[k], contact)
                out[b, k, p] = contact[0]


class Contacts(NamedTuple):
    """Contact of particles with colliders: signed distance to the nearest [m], and which it is, (num_envs, particles)."""

    distance: NDArray
    collider: NDArray


def contacts(layout: Layout, x: NDArray, kinds: NDArray, colliders: NDArray) -> Contacts:
    """Those of a batch; x and colliders in blocks."""
    if not len(kinds):
        shape = (layout.num_envs, x.shape[1])
        return Contacts(np.full(shape, np.inf, x.dtype), np.full(shape, -1))
    out = np.empty((layout.blocks, len(kinds), x.shape[1], layout.lanes), x.dtype)
    signed_distances(0, layout.blocks, x, kinds, colliders, out)
    distances = layout.to_public(out)
    return Contacts(distances.min(axis=1), distances.argmin(axis=1))

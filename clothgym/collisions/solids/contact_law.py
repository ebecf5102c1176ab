"""The contact law for solids: no inward velocity, Coulomb friction, and no penetration.

With the outward normal n and the velocity u relative to the solid, the normal impulse takes the inward velocity, dv_N = max(-u . n,
0).  Friction takes at most ``mu`` times as much from the tangential velocity (Bridson, Fedkiw and Anderson 2002):

    v_T <- max(1 - mu dv_N / |v_T|, 0) v_T.

The displacement loses what friction takes, too, for the time that the integrator has already moved by that velocity.  Otherwise a
sheet at rest on a slope would creep by ``h^2 g sin`` in each substep.

Both laws take and return scalars, so that lanes and single sheets share them.  zero, one, tiny: in the dtype of the others.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined

TINY = 1e-12  # speed that has no direction [m/s]
RELAXED = 0.05  # share of a point's depth, beyond what the last substep moved it inward, that is corrected in a substep


@inlined
def contact_change(distance, nx, ny, nz, ux, uy, uz, w, friction, carried, zero, one, tiny):
    """Changes of a particle's position [m] and velocity [m/s] by a contact; zero if it is outside the solid or attached.

    distance: signed distance to the solid [m].  n: outward normal.  u: velocity relative to the solid [m/s].  w: inverse mass
    [1/kg].
    carried: time for which the velocity has already moved the position [s].

        dx = -distance n - carried s v_T,    dv = dv_N n - s v_T,    s = min(mu dv_N / |v_T|, 1).
    """
    touching = (distance < zero) & (w > zero)
    # normal and tangential velocity
    un = ux * nx + uy * ny + uz * nz
    tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
    # what the contact takes from each
    dv_n = max(-un, zero)
    speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
    slowed = min(friction * dv_n / speed, one)
    # nothing without a contact
    slowed = slowed if touching else zero
    dv_n = dv_n if touching else zero
    depth = -distance if touching else zero
    mx, my, mz = depth * nx - carried * slowed * tx, depth * ny - carried * slowed * ty, depth * nz - carried * slowed * tz
    return mx, my, mz, dv_n * nx - slowed * tx, dv_n * ny - slowed * ty, dv_n * nz - slowed * tz


@inlined
def touch_change(gap, nx, ny, nz, ux, uy, uz, inverse_mass, friction, h, carried, zero, one, tiny, relaxed):
    """The same for a point of a triangle, per inverse mass and weight of a corner: corner i changes by w_i b_i times the result,
    with its barycentric weight b_i.

    gap: signed distance of the point [m].  inverse_mass: of the point, sum w_i b_i^2 [1/kg].  h: the substep [s].  relaxed: see
    ``RELAXED``.  Depth that the substep's inward velocity explains is corrected at once, the rest only by the share ``relaxed``.
    """
    # a contact, if the point is inside and can move
    depth = -gap
    share = one / inverse_mass if (depth > zero) & (inverse_mass > zero) else zero
    # normal and tangential velocity
    un = ux * nx + uy * ny + uz * nz
    tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
    # depth to correct, and what the contact takes from each velocity
    dv_n = max(-un, zero)
    moved = min(depth, dv_n * h)
    depth = moved + relaxed * (depth - moved)
    speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
    slowed = min(friction * dv_n / speed, one)
    mx = share * (depth * nx - carried * slowed * tx)
    my = share * (depth * ny - carried * slowed * ty)
    mz = share * (depth * nz - carried * slowed * tz)
    return mx, my, mz, share * (dv_n * nx - slowed * tx), share * (dv_n * ny - slowed * ty), share * (dv_n * nz - slowed * tz)

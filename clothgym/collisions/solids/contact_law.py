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
# largest inward velocity against which a touch bears [m/s]: between solids that close in, impulses would otherwise grow without end
FASTEST = 10.0
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
def touch_change(gap, nx, ny, nz, ux, uy, uz, jx, jy, jz, inverse_mass, friction, h, carried, zero, one, most_speed, relaxed):
    """The same for a point of a triangle that keeps an impulse j [N s] from substep to substep: its new impulse, its change, and a
    push [kg m], three components each.  Corner i moves by w_i b_i (carried dj + push) and its velocity changes by w_i b_i dj, with
    its barycentric weight b_i.

    gap: signed distance of the point [m], after j has acted.  u: its velocity relative to the solid [m/s], likewise.  inverse_mass:
    of the point, sum w_i b_i^2 = 1/m [1/kg].  h: the substep [s].  most_speed: see ``FASTEST``.  relaxed: see ``RELAXED``.

        j_n <- max(j_n + m (u* - u_n), 0),    j_t <- j_t - m u_t, shortened to mu j_n,

    where u* <= 0 is the velocity that closes the gap and no more.  Depth that the substep's inward velocity explains is corrected
    at once, the rest only by the share ``relaxed``.
    """
    jn_before = jx * nx + jy * ny + jz * nz
    # a contact, if the point is inside or was borne, and can move
    acts = ((gap < zero) | (jn_before > zero)) & (inverse_mass > zero)
    mass = one / inverse_mass if acts else zero
    # normal impulse
    un = ux * nx + uy * ny + uz * nz
    target = -max(gap - carried * un, zero) / h
    jn = min(max(jn_before + (target - un) * mass, zero), most_speed * mass)
    # friction
    tx, ty, tz = jx - jn_before * nx, jy - jn_before * ny, jz - jn_before * nz
    tx, ty, tz = tx - mass * (ux - un * nx), ty - mass * (uy - un * ny), tz - mass * (uz - un * nz)
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    share = friction * jn / length if length > friction * jn else one
    px, py, pz = jn * nx + share * tx, jn * ny + share * ty, jn * nz + share * tz
    px, py, pz = px if acts else zero, py if acts else zero, pz if acts else zero
    # depth that is left, and how much of it is corrected
    taken = (jn - jn_before) * inverse_mass
    depth = max(-(gap + carried * taken), zero)
    moved = min(depth, max(taken, zero) * (h - carried))
    push = mass * (moved + relaxed * (depth - moved))
    return px, py, pz, px - jx, py - jy, pz - jz, push * nx, push * ny, push * nz

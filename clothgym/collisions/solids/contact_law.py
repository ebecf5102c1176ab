"""The contact law for solids: no inward velocity, Coulomb friction, and no penetration.

With the outward normal n and the velocity u relative to the solid, the normal impulse takes the inward velocity, dv_N = max(-u . n,
0).  Friction takes at most ``mu`` times as much from the tangential velocity (Bridson, Fedkiw and Anderson 2002):

    v_T <- max(1 - mu dv_N / |v_T|, 0) v_T.

The displacement loses what friction takes, too, for the time that the integrator has already moved by that velocity.  Otherwise a
sheet at rest on a slope would creep by ``h^2 g sin`` in each substep.

At an edge of the solid the impulse acts along a direction e that is not n (see ``edges``): it takes the inward velocity, u . n, but
pushes along e, and friction acts at right angles to e.  Depth is always corrected along n.

The laws take and return scalars, so that particles and triangles share them.  zero, one, tiny: in the dtype of the others.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined

TINY = 1e-12  # speed that has no direction [m/s]
# largest inward velocity against which a touch bears [m/s]: between solids that close in, impulses would otherwise grow without end
FASTEST = 10.0
RELAXED = 0.05  # share of a point's depth, beyond what the last substep moved it inward, that is corrected in a substep


@inlined
def contact_change(distance, nx, ny, nz, ux, uy, uz, w, friction, lead, zero, one, tiny):
    """Changes of a particle's position [m] and velocity [m/s] by a contact; zero if it is outside the solid or attached.

    distance: signed distance to the solid [m].  n: outward normal.  u: velocity relative to the solid [m/s].  w: inverse mass
    [1/kg].
    lead: time for which the velocity has already moved the position [s].

        dx = -distance n - lead s v_T,    dv = dv_N n - s v_T,    s = min(mu dv_N / |v_T|, 1).
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
    mx, my, mz = (
        depth * nx - lead * slowed * tx,
        depth * ny - lead * slowed * ty,
        depth * nz - lead * slowed * tz,
    )
    return mx, my, mz, dv_n * nx - slowed * tx, dv_n * ny - slowed * ty, dv_n * nz - slowed * tz


@inlined
def edge_change(distance, nx, ny, nz, ex, ey, ez, ux, uy, uz, friction, lead, zero, one, tiny):
    """``contact_change`` of a free particle inside the solid that is pushed along e.

        dx = -distance n - lead s v_T,    dv = dv_E e - s v_T,    dv_E = max(-u . n, 0)/(e . n),    s = min(mu dv_E / |v_T|, 1),

    where v_T is the part of u at right angles to e.
    """
    un = ux * nx + uy * ny + uz * nz
    dv = max(-un, zero) / (ex * nx + ey * ny + ez * nz)
    # what friction takes
    ue = ux * ex + uy * ey + uz * ez
    tx, ty, tz = ux - ue * ex, uy - ue * ey, uz - ue * ez
    slowed = min(friction * dv / (np.sqrt(tx * tx + ty * ty + tz * tz) + tiny), one)
    mx, my, mz = (
        -distance * nx - lead * slowed * tx,
        -distance * ny - lead * slowed * ty,
        -distance * nz - lead * slowed * tz,
    )
    return mx, my, mz, dv * ex - slowed * tx, dv * ey - slowed * ty, dv * ez - slowed * tz


@inlined
def touch_change(
    gap, nx, ny, nz, ex, ey, ez, ux, uy, uz, jx, jy, jz, inverse_mass, friction, h, lead, zero, one, most_speed, relaxed
):  # fmt: skip
    """The same for a point of a triangle that keeps an impulse j [N s] from substep to substep: its new impulse, its change, and a
    push [kg m], three components each.  Corner i moves by w_i b_i (lead dj + push) and its velocity changes by w_i b_i dj, with
    its barycentric weight b_i.

    gap: signed distance of the point along n [m], after j has acted.  u: its velocity relative to the solid [m/s], likewise.
    inverse_mass: of the point, sum w_i b_i^2 = 1/m [1/kg].  h: the substep [s].  most_speed: see ``FASTEST``.  relaxed: see
    ``RELAXED``.

        j_e <- max(j_e + m (u* - u_n) / (e . n), 0),    j_t <- j_t - m u_t, shortened to mu j_e,

    where j_e is along e, and j_t and u_t at right angles to it, and u* <= 0 is the velocity that closes the gap and no more.  Depth
    that the substep's inward velocity explains is corrected at once, the rest only by the share ``relaxed``.
    """
    je_before = jx * ex + jy * ey + jz * ez
    # a contact, if the point is inside or was borne, and can move
    acts = ((gap < zero) | (je_before > zero)) & (inverse_mass > zero)
    mass = one / inverse_mass if acts else zero
    # impulse along e
    un, cosine = ux * nx + uy * ny + uz * nz, ex * nx + ey * ny + ez * nz
    target = -max(gap - lead * un, zero) / h
    je = min(max(je_before + (target - un) * mass / cosine, zero), most_speed * mass)
    # friction
    ue = ux * ex + uy * ey + uz * ez
    tx, ty, tz = jx - je_before * ex, jy - je_before * ey, jz - je_before * ez
    tx, ty, tz = tx - mass * (ux - ue * ex), ty - mass * (uy - ue * ey), tz - mass * (uz - ue * ez)
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    share = friction * je / length if length > friction * je else one
    px, py, pz = je * ex + share * tx, je * ey + share * ty, je * ez + share * tz
    px, py, pz = px if acts else zero, py if acts else zero, pz if acts else zero
    # depth that is left, and how much of it is corrected
    taken = (je - je_before) * inverse_mass * cosine
    depth = max(-(gap + lead * taken), zero)
    moved = min(depth, max(taken, zero) * (h - lead))
    push = mass * (moved + relaxed * (depth - moved))
    return px, py, pz, px - jx, py - jy, pz - jz, push * nx, push * ny, push * nz

"""What a contact with a solid does: no inward velocity, Coulomb friction, and the way out.

The normal impulse is the inward velocity that is taken away; friction takes at most ``mu`` times as much from the tangential
velocity (Bridson, Fedkiw and Anderson 2002: ``v_T <- max(1 - mu dv_N/|v_T|, 0) v_T``).  What friction takes from the velocity is
taken from the displacement too, as far as the integrator has moved by it, or a sheet at rest on a slope would creep by ``h^2 g
sin`` a substep.

Both laws take and give numbers, so that lanes and sheets share them.  zero, one and tiny: in the dtype of the others.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined

TINY = 1e-12  # [m/s]: a speed without direction
RELAXED = 0.05  # of the depth that the last substep's inward motion does not explain is taken back in a substep


@inlined
def contact_change(distance, nx, ny, nz, ux, uy, uz, w, friction, carried, zero, one, tiny):
    """Changes of a particle's position [m] and velocity [m/s], both nothing if it is outside or held.

    distance: to the solid [m]; n: the outward normal; u: velocity relative to the solid [m/s]; w: inverse mass [1/kg];
    carried: how long the velocity that friction takes has moved the position already [s].
    """
    touching = (distance < zero) & (w > zero)
    un = ux * nx + uy * ny + uz * nz
    tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
    stopped = max(-un, zero)
    speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
    lost = min(friction * stopped / speed, one)
    lost = lost if touching else zero
    stopped = stopped if touching else zero
    depth = -distance if touching else zero
    mx, my, mz = depth * nx - carried * lost * tx, depth * ny - carried * lost * ty, depth * nz - carried * lost * tz
    return mx, my, mz, stopped * nx - lost * tx, stopped * ny - lost * ty, stopped * nz - lost * tz


@inlined
def touch_change(gap, nx, ny, nz, ux, uy, uz, yielding, friction, h, carried, zero, one, tiny, relaxed):
    """The same for a point of a triangle, per inverse mass and weight of a corner; yielding: the point's own inverse mass [1/kg].

    Of its depth only what the substep of ``h`` [s] has moved it by is taken back at once, and of the rest a small share.
    """
    depth = -gap
    share = one / yielding if (depth > zero) & (yielding > zero) else zero
    un = ux * nx + uy * ny + uz * nz
    tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
    stopped = max(-un, zero)
    moved = min(depth, stopped * h)
    depth = moved + relaxed * (depth - moved)
    speed = np.sqrt(tx * tx + ty * ty + tz * tz) + tiny
    lost = min(friction * stopped / speed, one)
    mx = share * (depth * nx - carried * lost * tx)
    my = share * (depth * ny - carried * lost * ty)
    mz = share * (depth * nz - carried * lost * tz)
    return mx, my, mz, share * (stopped * nx - lost * tx), share * (stopped * ny - lost * ty), share * (stopped * nz - lost * tz)

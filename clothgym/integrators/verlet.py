"""Position Verlet (leapfrog): half a drift, a kick with the forces at the midpoint, half a drift.

Hairer, Lubich and Wanner 2003, Geometric numerical integration illustrated by the Stoermer-Verlet method, sections 1.1 and 1.5.

Order 2; order 1 in the damping along springs, which uses the velocities at the start of the substep.  Cost: one force pass per
substep.  Symplectic and symmetric without damping: an oscillator of angular frequency w keeps its amplitude, and its phase
advances by 2 asin(h w/2) per substep.  Its step matrix has the eigenvalues of semi-implicit Euler's, so it is stable under the
same conditions: h w <= 2, and with a damper of rate gamma ``(h w)^2 + 2 h gamma <= 4``.  Linear drag enters by the trapezoidal
rule.
"""

from __future__ import annotations

from clothgym._jit import disjoint, kernel, uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import add_spring_forces
from clothgym.integrators.base import Integrator, advance_positions, copy_to
from clothgym.integrators.semi_implicit_euler import largest_substep, surely_allowed


@disjoint
def _kick_one(v, w, f, g, slow, h):
    """One component of ``_kick`` for one sheet: v, w, f (particles,).  slow: ``h b/2``, the drag in half a substep."""
    one, zero = v.dtype.type(1), v.dtype.type(0)
    for p in range(v.shape[0]):
        gain, share = (h * (f[p] * w[p] + g), slow) if w[p] > zero else (zero, zero)
        v[p] = (v[p] * (one - share) + gain) / (one + share)


@kernel
def _kick(v, w, f, gravity, drag_rate, h):
    """``v <- (v (1 - h b/2) + h (w f + g)) / (1 + h b/2)`` for free particles, with the drag's rate b [1/s].

    v [m/s] and f [N]: (3, particles, lanes).
    """
    one, zero, half = v.dtype.type(1), v.dtype.type(0), v.dtype.type(0.5)
    particles, lanes = v.shape[1], v.shape[2]
    for c in range(3):
        if lanes == 1:
            vc, fc = v[c].reshape(particles), f[c].reshape(particles)
            _kick_one(vc, w.reshape(particles), fc, gravity[c, 0], half * h * drag_rate[0], h)
            continue
        for p in range(particles):
            for l in range(lanes):
                slow = half * h * drag_rate[l]
                free = (v[c, p, l] * (one - slow) + h * (f[c, p, l] * w[p, l] + gravity[c, l])) / (one + slow)
                v[c, p, l] = free if w[p, l] > zero else v[c, p, l]


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``x_1/2 = x_0 + h/2 v_0``, ``v_1 = v_0 + h (M^-1 f(x_1/2, v_0) + g - b (v_0 + v_1)/2)``, ``x_1 = x_1/2 + h/2 v_1``.

    b is the drag's rate.  Arguments, shapes and units are those of ``integrators.base``.
    """
    f = work.fields[0]
    half = x.dtype.type(0.5) * h
    # drift: half a substep with the old velocities
    advance_positions(x, v, half)
    # kick: a whole substep with the forces at the midpoint
    copy_to(f, push)
    add_spring_forces(x, v, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    _kick(v, w, f, gravity, drag_rate, h)
    # drift: half a substep with the new velocities
    advance_positions(x, v, half)


VERLET = Integrator(
    "verlet",
    color="#2f6fb5",
    order=2,
    cost="one force pass",
    damping="as an explicit force, in which it is of order 1",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    safety=0.8,
    carried=0.5,
)

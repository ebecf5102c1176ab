"""Position Verlet (leapfrog): half a drift, a kick with the forces in the middle, half a drift.

Order 2, and 1 in what damps along springs, whose velocities are those of the substep's start.  Cost: one force pass a substep.
Symplectic and symmetric without damping: amplitude 1, phase 2 asin(h w/2) a substep.  Stable as semi-implicit Euler is, whose
step matrix has the same eigenvalues: h w <= 2, damped ``(h w)^2 + 2 h gamma <= 4`` (Hairer, Lubich and Wanner 2003, Geometric
numerical integration illustrated by the Stoermer-Verlet method, 1.1 and 1.5).  Linear drag enters by the trapezoidal rule.
"""

from __future__ import annotations

from clothgym._jit import disjoint, kernel, uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import add_spring_forces
from clothgym.integrators.base import Integrator, advance_positions, copy_to
from clothgym.integrators.semi_implicit_euler import largest_substep, surely_allowed


@disjoint
def _kick_one(v, w, f, g, slow, h):
    """One component of one sheet, of whose velocity drag takes the share ``slow`` in half a substep."""
    one, zero = v.dtype.type(1), v.dtype.type(0)
    for p in range(v.shape[0]):
        gain, share = (h * (f[p] * w[p] + g), slow) if w[p] > zero else (zero, zero)
        v[p] = (v[p] * (one - share) + gain) / (one + share)


@kernel
def _kick(v, w, f, gravity, drag_rate, h):
    """``v <- (v (1 - h b/2) + h (f w + g)) / (1 + h b/2)`` for free particles, with b the drag's rate."""
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
    f = work.fields[0]
    half = x.dtype.type(0.5) * h
    advance_positions(x, v, half)
    copy_to(f, push)
    add_spring_forces(x, v, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    _kick(v, w, f, gravity, drag_rate, h)
    advance_positions(x, v, half)


VERLET = Integrator(
    "verlet",
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

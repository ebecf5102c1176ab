"""Position Verlet (leapfrog): half a drift, a kick with the forces in the middle, half a drift.

Order 2, and 1 in what damps along springs, whose velocities are those of the substep's start.  Cost: one force pass a substep.
Symplectic and symmetric without damping: amplitude 1, phase 2 asin(h w/2) a substep.  Stable as semi-implicit Euler is, whose
step matrix has the same eigenvalues: h w <= 2, damped ``(h w)^2 + 2 h gamma <= 4`` (Hairer, Lubich and Wanner 2003, Geometric
numerical integration illustrated by the Stoermer-Verlet method, 1.1 and 1.5).  Linear drag enters by the trapezoidal rule.
"""

from __future__ import annotations

from clothgym._jit import kernel
from clothgym.bending import add_bend_forces
from clothgym.forces import add_spring_forces
from clothgym.integrators.base import SCRATCH, Integrator, advance_positions
from clothgym.integrators.semi_implicit_euler import largest_substep, surely_allowed


@kernel
def _kick(v, w, f, gravity, drag_rate, h):
    """``v <- (v (1 - h b/2) + h (f w + g)) / (1 + h b/2)`` for free particles, with b the drag's rate."""
    one = v.dtype.type(1)
    half = v.dtype.type(0.5)
    for p in range(v.shape[0]):
        wp = w[p]
        for c in range(3):
            vc, fc, gc = v[p, c], f[p, c], gravity[c]
            for l in range(v.shape[2]):
                slow = half * h * drag_rate[l]
                free = (vc[l] * (one - slow) + h * (fc[l] * wp[l] + gc[l])) / (one + slow)
                vc[l] = free if wp[l] > 0 else vc[l]


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    stiffness, rigidity, damping_time = elastic
    f = work[: x.shape[0]]
    half = x.dtype.type(0.5) * h
    advance_positions(x, v, half)
    f[:] = push
    add_spring_forces(x, v, f, elements.springs, stiffness, damping_time, work[-1])
    add_bend_forces(x, v, f, elements.bends, rigidity, damping_time, work[-SCRATCH:])
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
    springs_by_particle=True,
    safety=0.8,
    carried=0.5,
)

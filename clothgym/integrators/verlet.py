"""Position Verlet (leapfrog): half a drift, a kick with the forces at the midpoint, half a drift.

Hairer, Lubich and Wanner 2003, Geometric numerical integration illustrated by the Stoermer-Verlet method, sections 1.1 and 1.5.

Order 2; order 1 in the damping along springs, which uses the velocities at the start of the substep.  Cost: one force pass per
substep.  Symplectic and symmetric without damping: an oscillator of angular frequency w keeps its amplitude, and its phase
advances by 2 asin(h w/2) per substep.  Its step matrix has the eigenvalues of semi-implicit Euler's, so it is stable under the
same conditions: h w <= 2, and with a damper of rate gamma ``(h w)^2 + 2 h gamma <= 4``.  Linear drag enters by the trapezoidal
rule.
"""

from __future__ import annotations

from clothgym._jit import uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import set_spring_forces
from clothgym.integrators.base import Integrator, advance, kick_and_drift
from clothgym.integrators.semi_implicit_euler import largest_substep, surely_allowed


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``x_1/2 = x_0 + h/2 v_0``, ``v_1 = v_0 + h (M^-1 f(x_1/2, v_0) + g - b (v_0 + v_1)/2)``, ``x_1 = x_1/2 + h/2 v_1``.

    b is the drag's rate.  Arguments, shapes and units are those of ``integrators.base``.
    """
    f = work.fields[0]
    share = x.dtype.type(0.5)
    # drift: half a substep with the old velocities
    advance(x, v, work.remainders[0], share * h)
    # kick: a whole substep with the forces at the midpoint; and drift: half a substep with the new velocities
    set_spring_forces(x, v, push, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    kick_and_drift(x, v, w, f, gravity, drag_rate, h, work, share, share * h)


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
    lead=0.5,
)

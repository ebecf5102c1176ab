"""Semi-implicit (symplectic) Euler: forces, then velocities, then positions with the new velocities.

Hairer, Lubich and Wanner 2006, Geometric Numerical Integration, section I.1.2.

Order 1.  Cost: one force pass per substep.  Without damping the energy oscillates but does not drift.  On a linear oscillator of
angular frequency w it is stable for h w <= 2; with a damper of rate gamma for ``(h w)^2 + 2 h gamma <= 4``, which follows from the
eigenvalues of its step matrix.  Damping along springs enters as an explicit force.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, frequency_bound, largest_frequency, set_spring_forces
from clothgym.integrators.base import Integrator, kick_and_drift


def stable_substep(w: float, damping_time: float) -> float:
    """Positive root h [s] of ``(h w)^2 + 2 h tau w^2 = 4``: the damper's rate at frequency w [rad/s] is tau w^2."""
    return float(np.sqrt(damping_time**2 + 4 / w**2) - damping_time)


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The bound [s] at the sheet's largest frequency, and the reason for it."""
    return stable_substep(largest_frequency(o), o.damping_time), "beyond it the stiffest mode of the sheet grows without bound"


def surely_allowed(o: Oscillators) -> float:
    """The bound [s] at a frequency that is certainly no smaller than the largest one."""
    return stable_substep(frequency_bound(o), o.damping_time)


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``v_1 = (v_0 + h (M^-1 f(x_0, v_0) + g)) / (1 + h b)``, ``x_1 = x_0 + h v_1``, with the drag's rate b.

    Arguments, shapes and units are those of ``integrators.base``.
    """
    # forces at the old positions and velocities
    f = work.fields[0]
    set_spring_forces(x, v, push, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    # velocities first: the positions advance with the new ones
    kick_and_drift(x, v, w, f, gravity, drag_rate, h, work, x.dtype.type(1), h)


# the bound is that of the flat sheet; stretched and folded sheets have slightly higher frequencies, hence the margin of a fifth
SEMI_IMPLICIT_EULER = Integrator(
    "semi_implicit_euler",
    color="#d1495b",
    order=1,
    cost="one force pass",
    damping="as an explicit force",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    safety=0.8,
)

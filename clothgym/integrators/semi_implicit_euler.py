"""Semi-implicit (symplectic) Euler: forces, then velocities, then positions with the new velocities.

Order 1.  Cost: one force pass a substep.  Undamped it neither loses nor gains energy on the average; on a linear oscillator
of frequency w it is stable for h w <= 2, with a damper of rate gamma for ``(h w)^2 + 2 h gamma <= 4`` (Hairer, Lubich and
Wanner, Geometric Numerical Integration, 2006, I.1.2; the damped bound follows from the eigenvalues of its step matrix).
Damping along springs enters as an explicit force.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, add_spring_forces, frequency_bound, largest_frequency
from clothgym.integrators.base import Integrator, advance_positions, advance_velocities, copy_to


def stable_substep(w: float, damping_time: float) -> float:
    """Positive root of ``(h w)^2 + 2 h tau w^2 = 4``: the damper's rate at frequency w [rad/s] is tau w^2."""
    return float(np.sqrt(damping_time**2 + 4 / w**2) - damping_time)


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The bound at the sheet's largest frequency."""
    return stable_substep(largest_frequency(o), o.damping_time), "beyond it the stiffest mode of the sheet grows without bound"


def surely_allowed(o: Oscillators) -> float:
    """The bound at a frequency that is certainly no smaller."""
    return stable_substep(frequency_bound(o), o.damping_time)


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    f = work.fields[0]
    copy_to(f, push)
    add_spring_forces(x, v, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    advance_velocities(v, w, f, gravity, drag_rate, h)
    advance_positions(x, v, h)


# the bound is that of the flat sheet; a fifth is kept for stretched and folded ones, whose frequencies are a little higher
SEMI_IMPLICIT_EULER = Integrator(
    "semi_implicit_euler",
    order=1,
    cost="one force pass",
    damping="as an explicit force",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    safety=0.8,
)

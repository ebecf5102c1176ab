"""Explicit (forward) Euler: positions advance with the old velocities, velocities with the forces at the old positions.

Hairer, Lubich and Wanner 2006, Geometric Numerical Integration, section I.1.2.

Order 1.  Cost: one force pass per substep.  It is here to show how it fails: in each substep the amplitude of an undamped
oscillator of angular frequency w grows by sqrt(1 + (h w)^2), however small the substep h is.  With dampers of retardation time tau
along the springs it is stable if ``h <= tau`` and ``(h w)^2 - 2 h tau w^2 + 4 >= 0``; this follows from the eigenvalues of its
step matrix.  Damping along springs enters as an explicit force.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, frequency_bound, largest_frequency, set_spring_forces
from clothgym.integrators.base import Integrator, advance, advance_velocities


def _stable_substep(w: float, damping_time: float) -> float:
    """tau [s], or the smaller root of ``(h w)^2 - 2 h tau w^2 + 4 = 0`` if that exists and is smaller; w [rad/s]."""
    oscillating = damping_time**2 - 4 / w**2
    return min(damping_time, damping_time - np.sqrt(oscillating)) if oscillating > 0 else damping_time


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The bound [s] at the sheet's largest frequency, and the reason for it."""
    why = "beyond it every mode of the sheet grows without bound" if o.damping_time else "without damping it grows at any substep"
    return float(_stable_substep(largest_frequency(o), o.damping_time)), why


def surely_allowed(o: Oscillators) -> float:
    """The bound [s] at a frequency that is certainly no smaller than the largest one."""
    return float(_stable_substep(frequency_bound(o), o.damping_time))


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``x_1 = x_0 + h v_0``, ``v_1 = (v_0 + h (M^-1 f(x_0, v_0) + g)) / (1 + h b)``, with the drag's rate b.

    Arguments, shapes and units are those of ``integrators.base``.
    """
    # forces at the old positions and velocities
    f = work.fields[0]
    set_spring_forces(x, v, push, f, elements, elastic, work.scratch)
    add_bend_forces(x, v, f, elements, elastic, work.scratch)
    # positions first: they must see the old velocities
    advance(x, v, work.remainders[0], h)
    advance_velocities(v, w, f, gravity, drag_rate, h, work)


EXPLICIT_EULER = Integrator(
    "explicit_euler",
    color="#8a8f98",
    order=1,
    cost="one force pass",
    damping="as an explicit force, and it alone can make the method stable",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    safety=0.8,
    lead=0.0,
)

"""Semi-implicit (symplectic) Euler: forces, then velocities, then positions with the new velocities.

Order 1.  Cost: one force pass a substep.  Undamped it neither loses nor gains energy on the average; on a linear oscillator
of frequency w it is stable for h w <= 2, with a damper of rate gamma for ``(h w)^2 + 2 h gamma <= 4`` (Hairer, Lubich and
Wanner, Geometric Numerical Integration, 2006, I.1.2; the damped bound follows from the eigenvalues of its step matrix).
Damping along springs enters as an explicit force.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.forces import add_spring_forces, frequency_bound, largest_frequency
from clothgym.integrators.base import Integrator, advance_positions, advance_velocities
from clothgym.mesh import ClothMesh


def _stable_substep(w: float, damping_time: float) -> float:
    """Positive root of ``(h w)^2 + 2 h tau w^2 = 4``: the damper's rate at frequency w [rad/s] is tau w^2."""
    return float(np.sqrt(damping_time**2 + 4 / w**2) - damping_time)


def largest_substep(mesh: ClothMesh, stiffness: NDArray, damping_time: float, inverse_mass: NDArray) -> tuple[float, str]:
    """The bound at the sheet's largest frequency."""
    h = _stable_substep(largest_frequency(mesh, stiffness, inverse_mass), damping_time)
    return h, "beyond it the stiffest mode of the sheet grows without bound"


def surely_allowed(mesh: ClothMesh, stiffness: NDArray, damping_time: float, inverse_mass: NDArray) -> float:
    """The bound at a frequency that is certainly no smaller."""
    return _stable_substep(frequency_bound(mesh, stiffness, inverse_mass), damping_time)


@kernel
def substep(x, v, w, springs, stiffness, damping_time, drag_rate, gravity, push, h, work):
    f = work[:-1]
    row = work[-1]
    f[:] = push
    add_spring_forces(x, v, f, springs, stiffness, damping_time, row)
    advance_velocities(v, w, f, gravity, drag_rate, h, row)
    advance_positions(x, v, h)


# the bound is that of the flat sheet; a fifth is kept for stretched and folded ones, whose frequencies are a little higher
SEMI_IMPLICIT_EULER = Integrator(
    "semi_implicit_euler",
    order=1,
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    safety=0.8,
    springs_by_particle=True,
)

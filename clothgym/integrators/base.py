"""The contract of an integrator.

To add one: write a file whose last function is its whole substep, a kernel with the signature

    substep(x, v, w, springs, stiffness, damping_time, drag_rate, gravity, push, h, work)

on one block of lanes, and describe it by an ``Integrator``.  The substep advances positions ``x`` [m] and velocities ``v``
[m/s], (particles, 3, lanes), by ``h`` [s].  ``w``: inverse masses [1/kg], (particles, lanes); a particle with ``w = 0`` is
held: it keeps its velocity, and moves with it.  ``push``: forces from outside [N], (particles, 3, lanes), of the air for
instance: slow against the springs, and not to be written to.  The other arguments are a block's part of
``state.SpringArrays`` and ``state.Fabric``; ``work`` is scratch, (particles + 1, 3, lanes), whose content does not outlive
the substep.
Contact is resolved after each substep, by the simulation, on the positions and velocities that the substep leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.mesh import ClothMesh


@dataclass(frozen=True)
class Integrator:
    """What an integrator says of itself.

    Attributes:
        name: its key in the table.
        order: order of accuracy in the substep.
        substep: the kernel, see the module's docstring.
        largest_substep: (mesh, stiffness by kind [N/m], damping time [s], inverse masses [1/kg]) to the largest substep
            [s] that the method should be used with, and why, as a clause of a sentence.
        surely_allowed: the same arguments to a substep [s] that is certainly no larger than that, found quickly.
        safety: share of ``largest_substep`` that ``substeps="auto"`` uses.
        limits_strain: whether it bounds the springs' stretch whatever the forces are.
        springs_by_particle: whether the result does not depend on the springs' order, so that the fastest one may be used.
    """

    name: str
    order: int
    substep: Any
    largest_substep: Callable[[ClothMesh, NDArray, float, NDArray], tuple[float, str]]
    surely_allowed: Callable[[ClothMesh, NDArray, float, NDArray], float]
    safety: float
    springs_by_particle: bool
    limits_strain: bool = False

    def automatic_substeps(self, time_step: float, largest: float) -> int:
        """Substeps of a control step [s] so that each is at most ``safety`` times the largest substep [s]."""
        return max(1, int(np.ceil(time_step / (self.safety * largest) - 1e-9)))


@kernel
def advance_velocities(v, w, f, gravity, drag_rate, h, row):
    """Add ``h (f w + gravity)``, then linear drag, implicitly: ``v <- v/(1 + h drag_rate)``.

    Held particles keep their velocity.  f [N], (particles, 3, lanes).  row: scratch, (1, lanes).
    """
    one = v.dtype.type(1)
    keep = row[0]
    for l in range(v.shape[2]):
        keep[l] = one / (one + h * drag_rate[l])
    for p in range(v.shape[0]):
        wp = w[p]
        for c in range(3):
            vc, fc, gc = v[p, c], f[p, c], gravity[c]
            for l in range(v.shape[2]):
                free = (vc[l] + h * (fc[l] * wp[l] + gc[l])) * keep[l]
                vc[l] = free if wp[l] > 0 else vc[l]


@kernel
def advance_positions(x, v, h):
    """``x <- x + h v``, held particles too."""
    for p in range(x.shape[0]):
        for c in range(3):
            xc, vc = x[p, c], v[p, c]
            for l in range(x.shape[2]):
                xc[l] += h * vc[l]

"""The contract of an integrator.

To add one: write a file whose last function is its whole substep, a kernel with the signature

    substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work)

on one block of lanes, and describe it by an ``Integrator``.  The substep advances positions ``x`` [m] and velocities ``v``
[m/s], (particles, 3, lanes), by ``h`` [s].

* ``w``: inverse masses [1/kg], (particles, lanes); a particle with ``w = 0`` is held: it keeps its velocity, and moves with it.
* ``elements``, ``elastic``: a ``state.Elements`` and a block's part of ``state.Elastic``.  Springs are at hand in ``forces``;
  ``add_bend_forces``, ``add_bend_products`` and ``project_bends``, imported from ``bending``, become the chosen model's.
* ``drag_rate`` [1/s], (lanes,), and ``gravity`` [m/s^2], (3, lanes).  ``push``: forces from outside [N], (particles, 3, lanes), of
  the air for instance: slow against the springs, and not to be written to.
* ``options``: the values of ``Integrator.options``, in that order.  ``plan``: what ``Integrator.prepare`` made.
* ``work``: scratch, ``Integrator.work_rows`` times (3, lanes), whose content does not outlive the substep.

Contact is resolved after each substep, by the simulation, on the positions and velocities that the substep leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.bending import BEND_SCRATCH
from clothgym.forces import Oscillators

Figures = frozenset[str]
SCRATCH = BEND_SCRATCH  # rows at the end of ``work``


class Preparation(NamedTuple):
    """What a method that factorises in advance is told: one environment's figures, the substep [s], and who may be held."""

    oscillators: Oscillators
    h: float
    holdable: NDArray


@dataclass(frozen=True)
class Integrator:
    """What an integrator says of itself.

    Attributes:
        name: its key in the table.
        order: order of accuracy in the substep; None for a method that does not converge.
        cost, damping: what a substep costs, and how damping along springs enters it, as clauses.
        substep: the kernel, see the module's docstring.
        largest_substep: the largest substep [s] that the method should be used with, and why, as a clause of a sentence; zero
            if there is none.
        surely_allowed: a substep [s] that is certainly no larger than that, found quickly.
        carried: share of the substep for which what is new in the velocity has already moved the positions, at a substep's end.
        springs_by_particle: whether the result does not depend on the springs' order, so that the fastest one may be used.
        safety: share of ``largest_substep`` that ``substeps="auto"`` uses.
        options: numbers that the kernel takes, by name, with the values they have now.
        fields: arrays of the particles' size that a substep needs as scratch.
        multipliers: whether it needs room for one multiplier an element when ``options["iterations"]`` exceeds 1.
        prepare: makes the kernel's ``plan``: arrays that follow from the figures and the substep.
        shared: figures of the material that must be the same in all environments.
        ignored: figures of the material that mean nothing to it.
        limits_strain: whether it bounds the springs' stretch whatever the forces are.
    """

    name: str
    order: int | None
    cost: str
    damping: str
    substep: Any
    largest_substep: Callable[[Oscillators], tuple[float, str]]
    surely_allowed: Callable[[Oscillators], float]
    springs_by_particle: bool
    safety: float = 1.0
    carried: float = 1.0
    options: Mapping[str, int | float] = field(default_factory=lambda: MappingProxyType({}))
    fields: int = 1
    multipliers: bool = False
    prepare: Callable[[Preparation], tuple[NDArray, ...]] | None = None
    shared: Figures = frozenset()
    ignored: Figures = frozenset()
    limits_strain: bool = False

    def automatic_substeps(self, time_step: float, largest: float) -> int:
        """Substeps of a control step [s] so that each is at most ``safety`` times the largest substep [s]."""
        return max(1, int(np.ceil(time_step / (self.safety * largest) - 1e-9)))

    def work_rows(self, particles: int, springs: int, bends: int) -> int:
        """Rows of (3, lanes) that ``work`` must have."""
        remembered = -(-springs // 3) + bends if self.multipliers and self.options["iterations"] > 1 else 0
        return self.fields * particles + remembered + SCRATCH

    def with_options(self, **options: float) -> Integrator:
        """The same method with other options.

        Raises:
            ValueError: an option that it does not have, or a value that makes no sense.
        """
        for name, value in options.items():
            if name not in self.options:
                known = f"has only {', '.join(self.options)}" if self.options else "has none"
                raise ValueError(f"{self.name} has no option {name!r}: it {known}")
            whole = isinstance(self.options[name], int)
            numeric = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, (bool, np.bool_))
            if not numeric or not np.isfinite(value):
                raise ValueError(f"{self.name}: {name}={value!r} must be a finite number")
            if whole and (value != int(value) or value < 1):
                raise ValueError(f"{self.name}: {name}={value!r} must be an integer of at least 1")
            if not whole and not 0 <= value <= 1:
                raise ValueError(f"{self.name}: {name}={value!r} must be from 0 to 1")
            options[name] = int(value) if whole else float(value)
        return replace(self, options=MappingProxyType({**self.options, **options}))


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
def predict_velocities(v, w, push, gravity, drag_rate, h, row):
    """What free particles' velocity would be without the elements: ``v <- v/(1 + h drag_rate) + h (push w + gravity)``.

    Only what was there is dragged, so that implicit methods come to rest where forces balance, whatever the substep is.
    push [N], (particles, 3, lanes).  row: scratch, (1, lanes).
    """
    one = v.dtype.type(1)
    keep = row[0]
    for l in range(v.shape[2]):
        keep[l] = one / (one + h * drag_rate[l])
    for p in range(v.shape[0]):
        wp = w[p]
        for c in range(3):
            vc, fc, gc = v[p, c], push[p, c], gravity[c]
            for l in range(v.shape[2]):
                free = vc[l] * keep[l] + h * (fc[l] * wp[l] + gc[l])
                vc[l] = free if wp[l] > 0 else vc[l]


@kernel
def advance_positions(x, v, h):
    """``x <- x + h v``, held particles too."""
    for p in range(x.shape[0]):
        for c in range(3):
            xc, vc = x[p, c], v[p, c]
            for l in range(x.shape[2]):
                xc[l] += h * vc[l]


@kernel
def move_on(x, v, start, h):
    """``x <- start + h v``, held particles too."""
    for p in range(x.shape[0]):
        for c in range(3):
            xc, vc, sc = x[p, c], v[p, c], start[p, c]
            for l in range(x.shape[2]):
                xc[l] = sc[l] + h * vc[l]


@kernel
def weigh(w, total, r, h):
    """``r <- h r - M total`` for free particles and zero for held ones: what is left of the backward Euler equations [N s]."""
    zero = r.dtype.type(0)
    for p in range(r.shape[0]):
        wp = w[p]
        for c in range(3):
            rc, tc = r[p, c], total[p, c]
            for l in range(r.shape[2]):
                rc[l] = h * rc[l] - tc[l] / wp[l] if wp[l] > zero else zero


@kernel
def add_to(a, b):
    """``a <- a + b``."""
    for p in range(a.shape[0]):
        for c in range(3):
            ac, bc = a[p, c], b[p, c]
            for l in range(a.shape[2]):
                ac[l] += bc[l]

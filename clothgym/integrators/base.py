"""The contract of an integrator.

To add one: write a file whose last function is its whole substep, a kernel with the signature

    substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work)

on one block of lanes, and describe it by an ``Integrator``.  The substep advances positions ``x`` [m] and velocities ``v``
[m/s], (3, particles, lanes), by ``h`` [s].

* ``w``: inverse masses [1/kg], (particles, lanes); a particle with ``w = 0`` is held: it keeps its velocity, and moves with it.
* ``elements``, ``elastic``: an ``elements.Elements`` and a block's part of ``elements.Elastic``.  ``add_spring_forces`` and
  ``add_spring_products``, imported from ``forces``, and ``add_bend_forces``, ``add_bend_products`` and ``project_bends``, imported
  from ``bending``, become those of the chosen model, for lanes or for particles that lie side by side (``specialized``).
* ``drag_rate`` [1/s], (lanes,), and ``gravity`` [m/s^2], (3, lanes).  ``push``: forces from outside [N], (3, particles, lanes), of
  the air for instance: slow against the springs, and not to be written to.
* ``options``: the values of ``Integrator.options``, in that order.  ``plan``: what ``Integrator.prepare`` made.
* ``work``: a ``Work``, whose content does not outlive the substep.

Contact is resolved after each substep, by the simulation, on the positions and velocities that the substep leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel
from clothgym.elements import Scratch, room_for_forces
from clothgym.forces import Oscillators

Figures = frozenset[str]


class Work(NamedTuple):
    """What a substep may write to.

    fields: arrays like positions, (fields, 3, particles, lanes).  of_springs, of_bends: multipliers, (springs, lanes) and (hinges,
    3, lanes), of methods that keep some.  scratch: for the forces of elements.
    """

    fields: NDArray
    of_springs: NDArray
    of_bends: NDArray
    scratch: Scratch


class Preparation(NamedTuple):
    """What a method that factorises in advance is told: one environment's figures, the substep [s], who may be held, and whether
    one sheet's particles lie side by side."""

    oscillators: Oscillators
    h: float
    holdable: NDArray
    by_particle: bool


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
        any_order: whether the result does not depend on the springs' order, so that a grid's particles may lie side by side.
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
    any_order: bool
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

    def room(self, springs: int, bends: int) -> tuple[int, int, int]:
        """Fields, and multipliers of springs and of bends, that ``Work`` must have room for."""
        remembers = self.multipliers and self.options["iterations"] > 1
        return (self.fields, springs, bends) if remembers else (self.fields, 0, 0)

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
def room_for_work(x, offset, room):
    """What a substep may write to, for one block; see ``elements.room_for_forces``, and ``Integrator.room``."""
    _, particles, lanes = x.shape
    fields, springs, bends = room
    return Work(
        np.empty((fields, 3, particles, lanes), x.dtype),
        np.empty((springs, lanes), x.dtype),
        np.empty((bends, 3, lanes), x.dtype),
        room_for_forces(x, offset),
    )


@disjoint
def _gain(v, w, f, g, keep, h):
    """``v <- (v + h (f w + g)) keep`` of what is free."""
    zero, one = v.dtype.type(0), v.dtype.type(1)
    for p in range(v.shape[0]):
        # a choice between new and old would be stored under a mask, which is slow on many processors
        gain, share = (h * (f[p] * w[p] + g), keep) if w[p] > zero else (zero, one)
        v[p] = (v[p] + gain) * share


@kernel
def advance_velocities(v, w, f, gravity, drag_rate, h):
    """Add ``h (f w + gravity)``, then linear drag, implicitly: ``v <- v/(1 + h drag_rate)``.

    Held particles keep their velocity.  f [N], (3, particles, lanes).
    """
    one, zero = v.dtype.type(1), v.dtype.type(0)
    particles, lanes = v.shape[1], v.shape[2]
    for c in range(3):
        vc, fc = v[c].reshape(particles * lanes), f[c].reshape(particles * lanes)
        if lanes == 1:
            _gain(vc, w.reshape(particles), fc, gravity[c, 0], one / (one + h * drag_rate[0]), h)
            continue
        for p in range(particles):
            for l in range(lanes):
                free = (v[c, p, l] + h * (f[c, p, l] * w[p, l] + gravity[c, l])) * (one / (one + h * drag_rate[l]))
                v[c, p, l] = free if w[p, l] > zero else v[c, p, l]


@disjoint
def _fall(v, w, f, g, keep, h):
    """``v <- v keep + h (f w + g)`` of what is free."""
    zero, one = v.dtype.type(0), v.dtype.type(1)
    for p in range(v.shape[0]):
        gain, share = (h * (f[p] * w[p] + g), keep) if w[p] > zero else (zero, one)
        v[p] = v[p] * share + gain


@kernel
def predict_velocities(v, w, push, gravity, drag_rate, h):
    """What free particles' velocity would be without the elements: ``v <- v/(1 + h drag_rate) + h (push w + gravity)``.

    Only what was there is dragged, so that implicit methods come to rest where forces balance, whatever the substep is.
    push [N], (3, particles, lanes).
    """
    one, zero = v.dtype.type(1), v.dtype.type(0)
    particles, lanes = v.shape[1], v.shape[2]
    for c in range(3):
        vc, fc = v[c].reshape(particles * lanes), push[c].reshape(particles * lanes)
        if lanes == 1:
            _fall(vc, w.reshape(particles), fc, gravity[c, 0], one / (one + h * drag_rate[0]), h)
            continue
        for p in range(particles):
            for l in range(lanes):
                free = v[c, p, l] * (one / (one + h * drag_rate[l])) + h * (push[c, p, l] * w[p, l] + gravity[c, l])
                v[c, p, l] = free if w[p, l] > zero else v[c, p, l]


@kernel
def advance_positions(x, v, h):
    """``x <- x + h v``, held particles too."""
    _advance(x.reshape(x.size), v.reshape(v.size), h)


@disjoint
def _advance(x, v, h):
    for e in range(x.shape[0]):
        x[e] += h * v[e]


@kernel
def move_on(x, v, start, h):
    """``x <- start + h v``, held particles too."""
    _move_on(x.reshape(x.size), v.reshape(v.size), start.reshape(start.size), h)


@disjoint
def _move_on(x, v, start, h):
    for e in range(x.shape[0]):
        x[e] = start[e] + h * v[e]


@kernel
def weigh(w, total, r, h):
    """``r <- h r - M total`` for free particles and zero for held ones: what is left of the backward Euler equations [N s]."""
    for c in range(3):
        _weigh(w.reshape(w.size), total[c].reshape(w.size), r[c].reshape(w.size), h)


@disjoint
def _weigh(w, total, r, h):
    zero, one = r.dtype.type(0), r.dtype.type(1)
    for e in range(r.shape[0]):
        left = h * r[e] - total[e] / (w[e] if w[e] > zero else one)
        r[e] = left if w[e] > zero else zero


@kernel
def add_to(a, b):
    """``a <- a + b``."""
    _add_to(a.reshape(a.size), b.reshape(b.size))


@disjoint
def _add_to(a, b):
    for e in range(a.shape[0]):
        a[e] += b[e]


@kernel
def copy_to(a, b):
    """``a <- b``."""
    _copy_to(a.reshape(a.size), b.reshape(b.size))


@disjoint
def _copy_to(a, b):
    for e in range(a.shape[0]):
        a[e] = b[e]

"""The contract of an integrator.

To add one, write a file whose last function is its whole substep, a kernel with the signature

    substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work)

on one block of lanes, and describe it by an ``Integrator``.  The substep advances positions ``x`` [m] and velocities ``v``
[m/s], (3, particles, lanes), by ``h`` [s].

* ``w``: inverse masses [1/kg], (particles, lanes).  A particle with ``w = 0`` is held: it keeps its velocity, and moves with it.
* ``elements``, ``elastic``: an ``elements.Elements`` and the block's ``elements.Elastic``.  Import ``add_spring_forces`` and
  ``add_spring_products`` from ``forces``, and ``add_bend_forces``, ``add_bend_products`` and ``project_bends`` from ``bending``.
  ``_jit.specialize`` replaces them with those of the chosen bending model and memory layout.
* ``drag_rate`` [1/s], (lanes,).  ``gravity`` [m/s^2], (3, lanes).
* ``push``: external forces [N], (3, particles, lanes), such as the air's.  They change slowly compared with the springs' forces.
  Read only.
* ``options``: the values of ``Integrator.options``, in that order.  ``plan``: what ``Integrator.prepare`` returned.
* ``work``: a ``Work``.  Its content is lost when the substep ends.

The simulation resolves contact after each substep, on the positions and velocities that the substep leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel
from clothgym.checks import count, number
from clothgym.elements import Scratch, room_for_forces
from clothgym.forces import Oscillators

Properties = frozenset[str]
MOST_ITERATIONS = 1_000_000


class Work(NamedTuple):
    """Scratch of a substep.

    fields: arrays of the positions' shape, (fields, 3, particles, lanes).  of_springs, of_bends: Lagrange multipliers, (springs,
    lanes) and (hinges, 3, lanes); empty for methods without them.  scratch: for the forces of elements.
    """

    fields: NDArray
    of_springs: NDArray
    of_bends: NDArray
    scratch: Scratch


class Preparation(NamedTuple):
    """What ``Integrator.prepare`` receives.

    oscillators: the properties of one environment.  h: the substep [s].  holdable: particles that may be held, (holdable,).
    by_particle: whether the particles of one sheet, not the lanes, are adjacent in memory.
    """

    oscillators: Oscillators
    h: float
    holdable: NDArray
    by_particle: bool


@dataclass(frozen=True)
class Integrator:
    """The description of an integrator.

    Attributes:
        name: its key in the table.
        order: order of accuracy in the substep; None for a method that does not converge.
        cost, damping: the cost of a substep, and how damping along springs enters it, as clauses of a sentence.
        substep: the kernel, see the module's docstring.
        largest_substep: the largest substep [s] that the method should be used with, or zero if no substep will do; and the
            reason, as a clause of a sentence.
        surely_allowed: a substep [s] that is certainly no larger than that, and quick to compute.
        carried: share of the substep for which the new velocity has already moved the positions when the substep ends.
        any_order: whether the result is independent of the order of the springs, so that a grid's particles may be adjacent in
            memory.
        safety: share of ``largest_substep`` that ``substeps="auto"`` uses.
        options: numbers that the kernel takes, by name, with their current values.
        fields: arrays of the positions' shape that a substep needs as scratch.
        multipliers: whether it needs one Lagrange multiplier for each element if ``options["iterations"]`` exceeds 1.
        prepare: returns the kernel's ``plan``: arrays that follow from the material properties and the substep.
        shared: material properties that must be the same in all environments.
        ignored: material properties that have no meaning for the method.
        limits_strain: whether the method bounds the springs' strain, whatever the forces are.
        color: of its lines in plots.
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
    shared: Properties = frozenset()
    ignored: Properties = frozenset()
    limits_strain: bool = False
    color: str = "#8a8f98"

    def automatic_substeps(self, time_step: float, largest: float) -> int:
        """Number of substeps in a control step [s], for each to be at most ``safety`` times the largest substep [s]."""
        return max(1, int(np.ceil(time_step / (self.safety * largest) - 1e-9)))

    def room(self, springs: int, bends: int) -> tuple[int, int, int]:
        """Sizes of a ``Work``: the number of fields, and of multipliers of springs and of hinges."""
        remembers = self.multipliers and self.options["iterations"] > 1
        return (self.fields, springs, bends) if remembers else (self.fields, 0, 0)

    def with_options(self, **options: float) -> Integrator:
        """The same method with other options.

        Raises:
            ValueError: an option that the method does not have, or a value out of range.
        """
        for name, value in options.items():
            if name not in self.options:
                known = f"has only {', '.join(self.options)}" if self.options else "has none"
                raise ValueError(f"{self.name} has no option {name!r}: it {known}")
            # an option whose default is an integer is a count; the others are shares or tolerances
            whole = isinstance(self.options[name], int)
            options[name] = value = number(f"{self.name}: {name}", value)
            if whole:
                options[name] = count(f"{self.name}: {name}", int(value) if value == int(value) else value, most=MOST_ITERATIONS)
            elif not 0 <= value <= 1:
                raise ValueError(f"{self.name}: {name}={value!r}: must be from 0 to 1")
        return replace(self, options=MappingProxyType({**self.options, **options}))

    def __reduce__(self) -> tuple[Callable[..., Integrator], tuple[Any, ...]]:
        """Copies and pickles of a method of the table are by its name and options: its kernels stay where they are."""
        from clothgym.integrators import INTEGRATORS, get  # the table lies above

        if self.name in INTEGRATORS and replace(INTEGRATORS[self.name], options=self.options) == self:
            return get, ({"name": self.name, **self.options},)
        return _rebuilt, ({**vars(self), "options": dict(self.options)},)


def _rebuilt(attributes: dict[str, Any]) -> Integrator:
    """A method that is not in the table, from a pickle, which knows no mapping proxies."""
    return Integrator(**{**attributes, "options": MappingProxyType(attributes["options"])})


@kernel
def room_for_work(x, offset, room):
    """The ``Work`` of one block with positions ``x``; offset: see ``elements.room_for_forces``; room: see ``Integrator.room``."""
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
    """``v <- (v + h (f w + g)) keep`` for the free particles of one sheet; v, w, f: one component each, (particles,)."""
    zero, one = v.dtype.type(0), v.dtype.type(1)
    for p in range(v.shape[0]):
        # choose between factors, not between results: that would be a masked store, which is slow on many processors
        gain, share = (h * (f[p] * w[p] + g), keep) if w[p] > zero else (zero, one)
        v[p] = (v[p] + gain) * share


@kernel
def advance_velocities(v, w, f, gravity, drag_rate, h):
    """``v <- (v + h (w f + g)) / (1 + h b)``: forces, gravity g, and linear drag of rate b, which is implicit.

    Held particles keep their velocity.  v [m/s] and f [N]: (3, particles, lanes).
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
    """``v <- v keep + h (f w + g)`` for the free particles of one sheet; v, w, f: one component each, (particles,)."""
    zero, one = v.dtype.type(0), v.dtype.type(1)
    for p in range(v.shape[0]):
        gain, share = (h * (f[p] * w[p] + g), keep) if w[p] > zero else (zero, one)
        v[p] = v[p] * share + gain


@kernel
def predict_velocities(v, w, push, gravity, drag_rate, h):
    """``v <- v/(1 + h b) + h (w push + g)``: the velocities of free particles without springs and bending.

    The drag of rate b acts on the old velocity only.  So implicit methods come to rest where the forces balance, whatever the
    substep is.  v [m/s] and push [N]: (3, particles, lanes).
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
    """``x <- x + h v``, for held particles too; (3, particles, lanes)."""
    _advance(x.reshape(x.size), v.reshape(v.size), h)


@disjoint
def _advance(x, v, h):
    """``advance_positions`` on flat arrays."""
    for e in range(x.shape[0]):
        x[e] += h * v[e]


@kernel
def move_on(x, v, start, h):
    """``x <- start + h v``, for held particles too; (3, particles, lanes)."""
    _move_on(x.reshape(x.size), v.reshape(v.size), start.reshape(start.size), h)


@disjoint
def _move_on(x, v, start, h):
    """``move_on`` on flat arrays."""
    for e in range(x.shape[0]):
        x[e] = start[e] + h * v[e]


@kernel
def weigh(w, total, r, h):
    """``r <- h r - M total`` for free particles, and zero for held ones: the residual of the backward Euler equations [N s].

    r: on entry the elements' force [N]; total: the change of velocity so far [m/s]; both (3, particles, lanes).
    """
    for c in range(3):
        _weigh(w.reshape(w.size), total[c].reshape(w.size), r[c].reshape(w.size), h)


@disjoint
def _weigh(w, total, r, h):
    """One component of ``weigh``, on flat arrays."""
    zero, one = r.dtype.type(0), r.dtype.type(1)
    for e in range(r.shape[0]):
        residual = h * r[e] - total[e] / (w[e] if w[e] > zero else one)
        r[e] = residual if w[e] > zero else zero


@kernel
def add_to(a, b):
    """``a <- a + b``, arrays of the same shape."""
    _add_to(a.reshape(a.size), b.reshape(b.size))


@disjoint
def _add_to(a, b):
    """``add_to`` on flat arrays."""
    for e in range(a.shape[0]):
        a[e] += b[e]


@kernel
def copy_to(a, b):
    """``a <- b``, arrays of the same shape."""
    _copy_to(a.reshape(a.size), b.reshape(b.size))


@disjoint
def _copy_to(a, b):
    """``copy_to`` on flat arrays."""
    for e in range(a.shape[0]):
        a[e] = b[e]

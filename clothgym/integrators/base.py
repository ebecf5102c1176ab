"""The contract of an integrator.

To add one, write a file whose last function is its whole substep, a kernel with the signature

    substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work)

on one block of lanes, and describe it by an ``Integrator``.  The substep advances positions ``x`` [m] and velocities ``v``
[m/s], (3, particles, lanes), by ``h`` [s].

In float32 the changes of a small substep are no larger than the last bit of x and v, and rounding would lose or double them, with
the same sign in thousands of substeps.  So sums over substeps are compensated (Kahan 1965): what x and v could not hold is kept in
``work.remainders``, and is a part of the next change.  ``advance`` and ``change_velocities`` do so.  A velocity must not be derived
from a difference of positions: their rounding over h is no small velocity.

* ``w``: inverse masses [1/kg], (particles, lanes).  A particle with ``w = 0`` is held: it keeps its velocity, and moves with it.
* ``elements``, ``elastic``: an ``elements.Elements`` and the block's ``elements.Elastic``.  Import ``set_spring_forces``,
  ``add_spring_forces`` and ``add_spring_products`` from ``forces``, and ``add_bend_forces``, ``add_bend_products`` and
  ``project_bends`` from ``bending``.  ``_jit.specialize`` replaces them with those of the chosen bending model and memory layout.
* ``drag_rate`` [1/s], (lanes,).  ``gravity`` [m/s^2], (3, lanes).
* ``push``: external forces [N], (3, particles, lanes), such as the air's.  They change slowly compared with the springs' forces.
  Read only.
* ``options``: the values of ``Integrator.options``, in that order.  ``plan``: what ``Integrator.prepare`` returned.
* ``work``: a ``Work``.  Its content is lost when the substep ends, but for the remainders.

The simulation resolves contact after each substep, on the positions and velocities that the substep leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel, merged, uncounted
from clothgym.checks import count, number
from clothgym.elements import Scratch, scratch_for_forces
from clothgym.forces import Oscillators

Properties = frozenset[str]
MOST_ITERATIONS = 1_000_000


class Work(NamedTuple):
    """Scratch of a substep.

    fields: arrays of the positions' shape, (fields, 3, particles, lanes).  of_springs, of_bends: Lagrange multipliers, (springs,
    lanes) and (hinges, 3, lanes); empty for methods without them.  scratch: for the forces of elements.  remainders: what
    positions [m] and velocities [m/s] could not hold, not scratch but a part of the state, (2, 3, particles, lanes).
    """

    fields: NDArray
    of_springs: NDArray
    of_bends: NDArray
    scratch: Scratch
    remainders: NDArray


class Preparation(NamedTuple):
    """What ``Integrator.prepare`` receives.

    oscillators: the properties of one environment.  h: the substep [s].  holdable: particles that may be held, (holdable,).
    regular: whether the sheet is a regular grid with its particles adjacent in memory.
    """

    oscillators: Oscillators
    h: float
    holdable: NDArray
    regular: bool


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
        lead: share of the substep for which the new velocity has already moved the positions when the substep ends.
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
    lead: float = 1.0
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

    def work_shape(self, springs: int, bends: int) -> tuple[int, int, int]:
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
def scratch_for_work(x, offset, shape):
    """The scratch of a ``Work`` of one block with positions ``x``, in its order.

    offset: see ``elements.scratch_for_forces``.  shape: see ``Integrator.work_shape``.
    """
    _, particles, lanes = x.shape
    fields, springs, bends = shape
    return (
        np.empty((fields, 3, particles, lanes), x.dtype),
        np.empty((springs, lanes), x.dtype),
        np.empty((bends, 3, lanes), x.dtype),
        scratch_for_forces(x, offset),
    )


@disjoint
def _change(v, w, f, remainder, g, share, loss):
    """One component of ``change_velocities`` for one sheet: v, w, f, remainder (particles,); g, share and loss are numbers."""
    zero = v.dtype.type(0)
    for p in range(v.shape[0]):
        change = share * (f[p] * w[p] + g) - loss * v[p] + remainder[p]
        # choose between changes, not between results: that would be a masked store, which is slow on many processors
        change = change if w[p] > zero else zero
        now = v[p] + change
        remainder[p] = change - (now - v[p])
        v[p] = now


@disjoint
def _change_in_lanes(v, w, f, remainder, g, share, loss):
    """``_change`` of one particle: all arrays (lanes,)."""
    zero = v.dtype.type(0)
    for l in range(v.shape[0]):
        change = share[l] * (f[l] * w[l] + g[l]) - loss[l] * v[l] + remainder[l]
        change = change if w[l] > zero else zero
        now = v[l] + change
        remainder[l] = change - (now - v[l])
        v[l] = now


@uncounted
def change_velocities(v, w, f, gravity, drag_rate, h, work, of_force, of_drag):
    """``v <- v + h (w f + g)/(1 + of_force h b) - h b v/(1 + of_drag h b)``, compensated: forces, gravity g, and drag of rate b.

    Held particles keep their velocity.  v [m/s] and f [N]: (3, particles, lanes).  of_force, of_drag: how implicit the drag is,
    numbers from 0 to 1.
    """
    one = v.dtype.type(1)
    particles, lanes = v.shape[1], v.shape[2]
    remainder, share, loss = work.remainders[1], work.scratch.rows[0], work.scratch.rows[1]
    for l in range(lanes):
        share[l] = h / (one + of_force * h * drag_rate[l])
        loss[l] = h * drag_rate[l] / (one + of_drag * h * drag_rate[l])
    for c in range(3):
        vc, fc, rc, gc = v[c], f[c], remainder[c], gravity[c]
        if lanes == 1:
            _change(merged(vc), merged(w), merged(fc), merged(rc), gc[0], share[0], loss[0])
            continue
        for p in range(particles):
            _change_in_lanes(vc[p], w[p], fc[p], rc[p], gc, share, loss)


@uncounted
def advance_velocities(v, w, f, gravity, drag_rate, h, work):
    """``v <- (v + h (w f + g)) / (1 + h b)``: the drag of rate b is implicit; see ``change_velocities``."""
    one = v.dtype.type(1)
    change_velocities(v, w, f, gravity, drag_rate, h, work, one, one)


@uncounted
def predict_velocities(v, w, push, gravity, drag_rate, h, work):
    """``v <- v/(1 + h b) + h (w push + g)``: the velocities of free particles without springs and bending.

    The drag of rate b acts on the old velocity only.  So implicit methods come to rest where the forces balance, whatever the
    substep is.  push: [N], see ``change_velocities``.
    """
    one = v.dtype.type(1)
    change_velocities(v, w, push, gravity, drag_rate, h, work, one - one, one)


@disjoint
def _kick_one(x, v, w, f, rx, rv, g, share, loss, reach):
    """One component of ``kick_and_drift`` for one sheet: arrays (particles,); g, share and loss are numbers."""
    zero = v.dtype.type(0)
    for p in range(v.shape[0]):
        change = share * (f[p] * w[p] + g) - loss * v[p] + rv[p]
        change = change if w[p] > zero else zero
        now = v[p] + change
        rv[p] = change - (now - v[p])
        v[p] = now
        change = reach * now + rx[p]
        there = x[p] + change
        rx[p] = change - (there - x[p])
        x[p] = there


@disjoint
def _kick_in_lanes(x, v, w, f, rx, rv, g, share, loss, reach):
    """``_kick_one`` of one particle: all arrays (lanes,)."""
    zero = v.dtype.type(0)
    for l in range(v.shape[0]):
        change = share[l] * (f[l] * w[l] + g[l]) - loss[l] * v[l] + rv[l]
        change = change if w[l] > zero else zero
        now = v[l] + change
        rv[l] = change - (now - v[l])
        v[l] = now
        change = reach * now + rx[l]
        there = x[l] + change
        rx[l] = change - (there - x[l])
        x[l] = there


@uncounted
def kick_and_drift(x, v, w, f, gravity, drag_rate, h, work, implicit, reach):
    """``change_velocities`` with both shares ``implicit``, and then ``x <- x + reach v``, in one pass, which is faster than two."""
    one = v.dtype.type(1)
    n, lanes = v.shape[1], v.shape[2]
    share, loss = work.scratch.rows[0], work.scratch.rows[1]
    for l in range(lanes):
        share[l] = h / (one + implicit * h * drag_rate[l])
        loss[l] = drag_rate[l] * share[l]
    for c in range(3):
        xc, vc, fc, rx, rv, g = x[c], v[c], f[c], work.remainders[0, c], work.remainders[1, c], gravity[c]
        if lanes == 1:
            _kick_one(
                merged(xc), merged(vc), merged(w), merged(fc), merged(rx), merged(rv), g[0], share[0], loss[0],
                reach,
            )  # fmt: skip
            continue
        for p in range(n):
            _kick_in_lanes(xc[p], vc[p], w[p], fc[p], rx[p], rv[p], g, share, loss, reach)


@uncounted
def advance(x, v, remainder, h):
    """``x <- x + h v``, compensated, for held particles too; x, v, remainder: (3, particles, lanes).

    What the sum could not hold is in ``remainder``, exactly so where the change is not larger than x.  Serves for velocities and
    their rates, too.
    """
    _advance(merged(merged(x)), merged(merged(v)), merged(merged(remainder)), h)


@disjoint
def _advance(x, v, remainder, h):
    """``advance`` on flat arrays."""
    for e in range(x.shape[0]):
        change = h * v[e] + remainder[e]
        now = x[e] + change
        remainder[e] = change - (now - x[e])
        x[e] = now


@kernel
def extrapolate(x, v, start, h):
    """``x <- start + h v``, for held particles too: where they would be at the end of a substep; (3, particles, lanes)."""
    _extrapolate(merged(merged(x)), merged(merged(v)), merged(merged(start)), h)


@disjoint
def _extrapolate(x, v, start, h):
    """``extrapolate`` on flat arrays."""
    for e in range(x.shape[0]):
        x[e] = start[e] + h * v[e]


@kernel
def euler_residual(w, total, r, h):
    """``r <- h r - M total`` for free particles, and zero for held ones: the residual of the backward Euler equations [N s].

    r: on entry the elements' force [N]; total: the change of velocity so far [m/s]; both (3, particles, lanes).
    """
    for c in range(3):
        _euler_residual(merged(w), merged(total[c]), merged(r[c]), h)


@disjoint
def _euler_residual(w, total, r, h):
    """One component of ``euler_residual``, on flat arrays."""
    zero, one = r.dtype.type(0), r.dtype.type(1)
    for e in range(r.shape[0]):
        residual = h * r[e] - total[e] / (w[e] if w[e] > zero else one)
        r[e] = residual if w[e] > zero else zero


@kernel
def add_to(a, b):
    """``a <- a + b``, arrays of the same shape."""
    _add_to(merged(merged(a)), merged(merged(b)))


@disjoint
def _add_to(a, b):
    """``add_to`` on flat arrays."""
    for e in range(a.shape[0]):
        a[e] += b[e]


@uncounted
def copy_to(a, b):
    """``a <- b``, arrays of the same shape."""
    _copy_to(merged(merged(a)), merged(merged(b)))


@disjoint
def _copy_to(a, b):
    """``copy_to`` on flat arrays."""
    for e in range(a.shape[0]):
        a[e] = b[e]

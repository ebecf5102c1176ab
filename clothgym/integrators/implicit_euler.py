"""Backward Euler, linearised once a substep and solved by conjugate gradients.

Baraff and Witkin 1998, Large Steps in Cloth Simulation.

With v* the velocity that gravity, drag and the air would leave, f the elements' force, K its stiffness and D its damping matrix,
a substep solves ``(M + h D + h^2 K) d = h f(x, v*) - h^2 K v*`` and takes ``v = v* + d``, ``x <- x + h v`` (their eq. 16, about v*
in place of v).  ``newton_iterations`` beyond 1 linearise again where the substep would end, ``M d = h f(x + h v, v) - M (v - v*)``:
that is Newton's method for the full backward Euler equations, with K without what would make it indefinite.

Conjugate gradients take the inverse masses as preconditioner.  A held particle's is zero, and that is the filter of their
section 5.3: its residual never enters, and its velocity stays exact after any number of iterations.  The residuals of a free sheet
sum to zero in every iteration, so that its momentum stays exact too.  Each lane has its own step lengths, and stops where its
residual is ``tolerance`` times the first: what the others do does not change its bits.

Order 1.  Cost: a force pass, and a product with the stiffness matrix for each iteration and one more.  Never unstable; a mode of
frequency w keeps 1/sqrt(1 + (h w)^2) of its amplitude a substep.  Damping along springs enters implicitly, in D.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import disjoint, kernel
from clothgym.bending import add_bend_forces, add_bend_products
from clothgym.forces import Oscillators, add_spring_forces, add_spring_products
from clothgym.integrators.base import Integrator, add_to, copy_to, move_on, predict_velocities, weigh

GRAVITY = 9.81
LOST = 0.02
PARTS = 16  # sums that one sheet's products are added up in, side by side


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """Where a swing loses a fiftieth of its amplitude in a period.

    ``(1 + (h w)^2)^(-1/2)`` a substep is ``exp(-pi h w)`` a period; w is that of a pendulum as long as the sheet's longest side.
    """
    length = float(np.ptp(o.positions, axis=0).max())
    return LOST / (np.pi * np.sqrt(GRAVITY / length)), "beyond it a swing loses more than 2 % a period (it is never unstable)"


def surely_allowed(o: Oscillators) -> float:
    """Any: it is taken for its large steps, and nobody need be warned of them."""
    return float("inf")


@disjoint
def _turn_all(w, r, p, q, share):
    """One component of ``_turn``, of one sheet."""
    one, zero = p.dtype.type(1), p.dtype.type(0)
    for i in range(p.shape[0]):
        p[i] = w[i] * r[i] + share * p[i]
        q[i] = one / (w[i] if w[i] > zero else one) * p[i]


@kernel
def _turn(w, r, p, q, share):
    """The next search direction, ``p = M^-1 r + share p``, and its product with the masses, ``q = M p``, in one pass.

    A held particle has neither.  share: (lanes,).
    """
    one, zero = p.dtype.type(1), p.dtype.type(0)
    particles, lanes = w.shape
    for c in range(3):
        if lanes == 1:
            _turn_all(w.reshape(particles), r[c].reshape(particles), p[c].reshape(particles), q[c].reshape(particles), share[0])
            continue
        for i in range(particles):
            wi, rc, pc, qc = w[i], r[c, i], p[c, i], q[c, i]
            for l in range(lanes):
                pc[l] = wi[l] * rc[l] + share[l] * pc[l]
                qc[l] = one / (wi[l] if wi[l] > zero else one) * pc[l]


@kernel
def _sum_of_products(a, b, out):
    """``a . b`` of each lane, (lanes,); a, b: (3, particles, lanes).

    A sum goes by ``PARTS`` sums of what lies that many places apart, and then over these, however many lanes there are.
    """
    lanes = out.shape[0]
    size = a.size // lanes
    whole = size - size % PARTS
    one, other, parts = a.reshape((size, lanes)), b.reshape((size, lanes)), np.zeros((PARTS, lanes), a.dtype)
    if lanes == 1:
        _add_in_parts(one[:whole].reshape(whole), other[:whole].reshape(whole), parts.reshape(PARTS))
    for e in range(whole if lanes == 1 else 0, size):
        for l in range(lanes):
            parts[e % PARTS, l] += one[e, l] * other[e, l]
    out[:] = 0
    for k in range(PARTS):
        for l in range(lanes):
            out[l] += parts[k, l]


@disjoint
def _add_in_parts(a, b, parts):
    for begin in range(0, a.shape[0], PARTS):
        for k in range(PARTS):
            parts[k] += a[begin + k] * b[begin + k]


@kernel
def _square(w, r, scaled, out):
    """``r . M^-1 r`` of each lane, (lanes,); scaled: becomes ``M^-1 r``."""
    for c in range(3):
        _scale(w.reshape(w.size), r[c].reshape(w.size), scaled[c].reshape(w.size))
    _sum_of_products(scaled, r, out)


@disjoint
def _scale(w, r, out):
    for e in range(r.shape[0]):
        out[e] = w[e] * r[e]


@disjoint
def _go(d, p, r, q, step):
    for e in range(d.shape[0]):
        d[e] += step * p[e]
        r[e] -= step * q[e]


@kernel
def _advance(d, p, q, r, step):
    """``d += step p``, ``r -= step q``; step: (lanes,)."""
    lanes = step.shape[0]
    if lanes == 1:
        _go(d.reshape(d.size), p.reshape(d.size), r.reshape(d.size), q.reshape(d.size), step[0])
        return
    for c in range(3):
        for i in range(p.shape[1]):
            dc, pc, qc, rc = d[c, i], p[c, i], q[c, i], r[c, i]
            for l in range(lanes):
                dc[l] += step[l] * pc[l]
            for l in range(lanes):
                rc[l] -= step[l] * qc[l]


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    stiffness, rigidity, damping_time = elastic
    t = x.dtype.type
    zero = t(0)
    lanes, scratch = x.shape[2], work.scratch
    newton_iterations, iterations, tolerance = options
    start, total, d = work.fields[0], work.fields[1], work.fields[2]
    r, p, q, scaled = work.fields[3], work.fields[4], work.fields[5], work.fields[6]
    goal, rho, step, after, bend = np.empty((5, lanes), x.dtype)
    along, across = np.empty_like(stiffness), np.empty_like(stiffness)
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            across[kind, l] = -stiffness[kind, l] * h * h
    predict_velocities(v, w, push, gravity, drag_rate, h)
    copy_to(start, x)
    total[:] = 0
    for newton in range(newton_iterations):
        if newton > 0:
            move_on(x, v, start, h)
        r[:] = 0
        add_spring_forces(x, v, r, elements, elastic, scratch)
        add_bend_forces(x, v, r, elements, elastic, scratch)
        weigh(w, total, r, h)
        if newton == 0:
            for l in range(lanes):
                bend[l] = -rigidity[l] * h * h
            add_spring_products(x, v, r, elements, across, across, bend, scratch)
            add_bend_products(x, v, r, elements, bend, scratch)
            for kind in range(stiffness.shape[0]):
                for l in range(lanes):
                    across[kind, l] = stiffness[kind, l] * h * h
                    along[kind, l] = stiffness[kind, l] * (h * h + h * damping_time[l])
        _square(w, r, scaled, rho)
        for l in range(lanes):
            bend[l] = rigidity[l] * (h * h + h * damping_time[l])
            goal[l] = rho[l] * t(tolerance) * t(tolerance)
            step[l] = zero
        d[:] = 0
        p[:] = 0
        for l in range(lanes):
            if not rho[l] < np.inf:
                d[0, 0, l] = rho[l]  # forces that are not finite must be seen: the loop below would take them for solved
        for _ in range(iterations):
            going = False
            for l in range(lanes):
                going |= rho[l] > goal[l]
            if not going:
                break
            _turn(w, r, p, q, step)
            add_spring_products(x, p, q, elements, along, across, bend, scratch)
            add_bend_products(x, p, q, elements, bend, scratch)
            _sum_of_products(p, q, step)
            for l in range(lanes):
                step[l] = rho[l] / step[l] if rho[l] > goal[l] and step[l] > zero else zero
            _advance(d, p, q, r, step)
            _square(w, r, scaled, after)
            for l in range(lanes):
                share = after[l] / rho[l] if rho[l] > zero else zero
                rho[l] = after[l] if step[l] > zero else zero
                step[l] = share
        add_to(v, d)
        add_to(total, d)
    move_on(x, v, start, h)


IMPLICIT_EULER = Integrator(
    "implicit_euler",
    order=1,
    cost="a force pass, and a matrix product for each iteration and one more",
    damping="implicitly, in the matrix",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    options=MappingProxyType({"newton_iterations": 1, "iterations": 200, "tolerance": 1e-2}),
    fields=7,
)

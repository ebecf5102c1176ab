"""Backward Euler, linearized once per substep and solved by conjugate gradients.

Baraff and Witkin 1998, Large Steps in Cloth Simulation.

Let v* be the velocity after gravity, drag and the air, f the elements' force, K its stiffness matrix and D its damping matrix.  A
substep solves ``(M + h D + h^2 K) d = h f(x, v*) - h^2 K v*`` for d and sets ``v = v* + d``, ``x <- x + h v``.  This is their eq.
16, with d for their delta v, expanded about v* in place of v_0.

With ``newton_iterations`` above 1 the equations are linearized again at the end of the substep found so far, with the residual
``h f(x + h v, v) - M (v - v*)`` on the right.  This is Newton's method for the full backward Euler equations, except that K lacks
the part that could make it indefinite.

The preconditioner of the conjugate gradients is M^-1.  It is zero for a held particle, which is the filter of their section 5.3:
its residual never enters, and its velocity is exact after any number of iterations.  The residuals of a free sheet sum to zero in
every iteration, so its momentum is exact too.  Each lane has its own step lengths, and stops when its residual is ``tolerance``
times the first.  So no lane affects the bits of another.

Order 1.  Cost: a force pass, one product with the stiffness matrix, and one more for each iteration.  Never unstable; a mode of
angular frequency w keeps 1/sqrt(1 + (h w)^2) of its amplitude in a substep.  Damping along springs enters implicitly, in D.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import disjoint, kernel, merged
from clothgym.bending import add_bend_forces, add_bend_products
from clothgym.forces import Oscillators, add_spring_forces, add_spring_products
from clothgym.integrators.base import Integrator, add_to, advance, copy_to, euler_residual, extrapolate, predict_velocities

GRAVITY = 9.81  # [m/s^2]
LOST = 0.02  # share of its amplitude that a swing may lose in a period
PARTS = 16  # partial sums of a scalar product, which one vector instruction can add to


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The substep [s] at which a swing loses a fiftieth of its amplitude in a period, and the reason for it.

    ``(1 + (h w)^2)^(-1/2)`` per substep is about ``exp(-pi h w)`` per period.  w is the frequency of a pendulum as long as the
    sheet's longest side.
    """
    length = float(np.ptp(o.positions, axis=0).max())
    return LOST / (np.pi * np.sqrt(GRAVITY / length)), "beyond it a swing loses more than 2 % a period (it is never unstable)"


def surely_allowed(o: Oscillators) -> float:
    """Any substep: the method is chosen for its large steps, so they need no warning."""
    return float("inf")


@disjoint
def _turn_all(w, r, p, q, share):
    """One component of ``_next_direction`` for one sheet: arrays (particles,)."""
    one, zero = p.dtype.type(1), p.dtype.type(0)
    for i in range(p.shape[0]):
        p[i] = w[i] * r[i] + share * p[i]
        q[i] = one / (w[i] if w[i] > zero else one) * p[i]


@kernel
def _next_direction(w, r, p, q, share):
    """The next search direction, ``p <- M^-1 r + share p``, and the masses' part of the product with it, ``q <- M p``, in one pass.

    For a held particle both are zero.  r, p, q: (3, particles, lanes).  share: (lanes,).
    """
    one, zero = p.dtype.type(1), p.dtype.type(0)
    particles, lanes = w.shape
    for c in range(3):
        if lanes == 1:
            _turn_all(merged(w), merged(r[c]), merged(p[c]), merged(q[c]), share[0])
            continue
        for i in range(particles):
            wi, rc, pc, qc = w[i], r[c, i], p[c, i], q[c, i]
            for l in range(lanes):
                pc[l] = wi[l] * rc[l] + share[l] * pc[l]
                qc[l] = one / (wi[l] if wi[l] > zero else one) * pc[l]


@kernel
def _sum_of_products(a, b, out):
    """``out <- a . b`` for each lane, (lanes,); a, b: (3, particles, lanes).

    Partial sum k adds the products at places k, k + PARTS, k + 2 PARTS, ...; then the partial sums are added up.  The order is the
    same for any number of lanes.
    """
    # places from the last multiple of PARTS on are added one by one
    lanes = out.shape[0]
    size = a.size // lanes
    whole = size - size % PARTS
    one, other, parts = a.reshape((size, lanes)), b.reshape((size, lanes)), np.zeros((PARTS, lanes), a.dtype)
    # the partial sums: of one sheet as vectors, else lane by lane
    if lanes == 1:
        _add_in_parts(merged(one[:whole]), merged(other[:whole]), merged(parts))
    for e in range(whole if lanes == 1 else 0, size):
        for l in range(lanes):
            parts[e % PARTS, l] += one[e, l] * other[e, l]
    # the sum of the partial sums
    out[:] = 0
    for k in range(PARTS):
        for l in range(lanes):
            out[l] += parts[k, l]


@disjoint
def _add_in_parts(a, b, parts):
    """``_sum_of_products`` of one sheet, up to the partial sums; the length of a and b is a multiple of PARTS."""
    for begin in range(0, a.shape[0], PARTS):
        for k in range(PARTS):
            parts[k] += a[begin + k] * b[begin + k]


@kernel
def _square(w, r, scaled, out):
    """``out <- r . M^-1 r`` for each lane, (lanes,), and ``scaled <- M^-1 r``; r, scaled: (3, particles, lanes)."""
    for c in range(3):
        _scale(merged(w), merged(r[c]), merged(scaled[c]))
    _sum_of_products(scaled, r, out)


@disjoint
def _scale(w, r, out):
    """``out <- M^-1 r``, one component, on flat arrays."""
    for e in range(r.shape[0]):
        out[e] = w[e] * r[e]


@disjoint
def _go(d, p, r, q, step):
    """``_advance`` for one sheet, on flat arrays."""
    for e in range(d.shape[0]):
        d[e] += step * p[e]
        r[e] -= step * q[e]


@kernel
def _advance(d, p, q, r, step):
    """``d <- d + step p`` and ``r <- r - step q``; d, p, q, r: (3, particles, lanes); step: (lanes,)."""
    lanes = step.shape[0]
    if lanes == 1:
        _go(merged(merged(d)), merged(merged(p)), merged(merged(r)), merged(merged(q)), step[0])
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
    """``(M + h D + h^2 K) d = h f(x, v*) - h^2 K v*``, then ``v = v* + d`` and ``x <- x + h v``; see the module's docstring.

    ``total = v - v*`` is the sum of d over the Newton iterations.  In each iteration r is the residual, p the search direction,
    q the matrix times p, ``rho = r . M^-1 r``, and step the step length along p.  Arguments, shapes and units are those of
    ``integrators.base``.
    """
    # names for options and scratch
    stiffness, rigidity, damping_time, size = elastic
    t = x.dtype.type
    zero = t(0)
    lanes, scratch = x.shape[2], work.scratch
    newton_iterations, iterations, tolerance = options
    start, total, d = work.fields[0], work.fields[1], work.fields[2]
    r, p, q, scaled = work.fields[3], work.fields[4], work.fields[5], work.fields[6]
    goal, rho, step, after, bend = np.empty((5, lanes), x.dtype)
    # the springs' coefficients along and across them, by kind: first those of -h^2 K, for the right side
    along, across = np.empty_like(stiffness), np.empty_like(stiffness)
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            across[kind, l] = -stiffness[kind, l] * h * h
    # v*
    predict_velocities(v, w, push, gravity, drag_rate, h, work)
    copy_to(start, x)
    total[:] = 0
    for newton in range(newton_iterations):
        # linearize at the start of the substep, and later at its end as found so far
        if newton > 0:
            extrapolate(x, v, start, h)
        # the right side: h f - M (v - v*)
        r[:] = 0
        add_spring_forces(x, v, r, elements, elastic, scratch)
        add_bend_forces(x, v, r, elements, elastic, scratch)
        euler_residual(w, total, r, h)
        # the first time also - h^2 K v*, as f is taken at the start; then the coefficients become those of h D + h^2 K
        if newton == 0:
            for l in range(lanes):
                bend[l] = -rigidity[l] * h * h
            add_spring_products(x, v, r, elements, size, across, across, bend, scratch)
            add_bend_products(x, v, r, elements, bend, scratch)
            for kind in range(stiffness.shape[0]):
                for l in range(lanes):
                    across[kind, l] = stiffness[kind, l] * h * h
                    along[kind, l] = stiffness[kind, l] * (h * h + h * damping_time[l])
        # begin with d = 0: the first search direction is M^-1 r
        _square(w, r, scaled, rho)
        for l in range(lanes):
            bend[l] = rigidity[l] * (h * h + h * damping_time[l])
            goal[l] = rho[l] * t(tolerance) * t(tolerance)
            step[l] = zero
        d[:] = 0
        p[:] = 0
        # forces that are not finite must show in the result: the loop below would take such a lane for solved
        for l in range(lanes):
            if not rho[l] < np.inf:
                d[0, 0, l] = rho[l]
        for _ in range(iterations):
            # stop when all lanes have reached their tolerance
            going = False
            for l in range(lanes):
                going |= rho[l] > goal[l]
            if not going:
                break
            # the search direction p, and q = (M + h D + h^2 K) p
            _next_direction(w, r, p, q, step)
            add_spring_products(x, p, q, elements, size, along, across, bend, scratch)
            add_bend_products(x, p, q, elements, bend, scratch)
            # the step length rho / (p . q), zero for lanes that are done
            _sum_of_products(p, q, step)
            for l in range(lanes):
                step[l] = rho[l] / step[l] if rho[l] > goal[l] and step[l] > zero else zero
            # take the step; the next direction keeps the share (new rho) / (old rho) of this one
            _advance(d, p, q, r, step)
            _square(w, r, scaled, after)
            for l in range(lanes):
                share = after[l] / rho[l] if rho[l] > zero else zero
                rho[l] = after[l] if step[l] > zero else zero
                step[l] = share
        # v = v* + total
        advance(v, d, work.remainders[1], t(1))
        add_to(total, d)
    # positions with the new velocities
    copy_to(x, start)
    advance(x, v, work.remainders[0], h)


IMPLICIT_EULER = Integrator(
    "implicit_euler",
    color="#3a8f4e",
    order=1,
    cost="a force pass, a matrix product, and one more for each iteration",
    damping="implicitly, in the matrix",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    options=MappingProxyType({"newton_iterations": 1, "iterations": 200, "tolerance": 1e-2}),
    fields=7,
)

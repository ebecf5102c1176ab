"""Extended position-based dynamics, by default with small steps: one Gauss-Seidel pass over the elements per substep.

Macklin, Mueller and Chentanez 2016, XPBD: position-based simulation of compliant constrained dynamics, eq. 18, with the damping of
eq. 26; Macklin et al. 2019, Small steps in physics simulation, for one pass per substep.

For a constraint C with multiplier lambda, inverse masses w, positions x and those at the start of the substep x^n, a projection is

    delta lambda = (-C - alpha~ lambda - gamma grad C . (x - x^n)) / ((1 + gamma) sum_i w_i |grad_i C|^2 + alpha~),
    lambda <- lambda + delta lambda,    x_i <- x_i + w_i grad_i C delta lambda.

For a spring ``C = |d| - r``, with d from the first end i to the second end j and r the rest length.  ``alpha~ = 1/(k h^2)`` is its
compliance over h^2, and ``gamma = alpha~ beta~/h = tau/h`` with the damping time tau.  The multipliers start from zero in each
substep.  One pass never reads them; with ``iterations`` above 1 they accumulate, and the passes converge to backward Euler.

In the code ``lam`` and ``delta_lambda`` have the opposite sign: they are positive where a spring pulls its ends together.

Order 1.  Cost: one projection pass per iteration.  On a lone spring it is backward Euler to rounding: a substep multiplies the
amplitude by 1/sqrt(1 + (h w)^2).  Never unstable, but soft when under-resolved: a chain of N links has the stiffness
k/(1 + q^2 (N - 1)/N) with q = h sqrt(k/m), which is 5 % too low at q = 0.229.  Damping along springs enters implicitly.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import apart, disjoint, kernel
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import Integrator, advance_positions, copy_to, predict_velocities

TINY = 1e-12  # added to a spring's squared length, which may be zero [m^2]
FIVE_PERCENT = 0.229  # h sqrt(k/m) at which one pass leaves a long chain 5 % too soft


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The substep [s] at which ``h sqrt(k/m)`` of a spring and its lighter end reaches 0.229 somewhere, and the reason for it."""
    springs = o.elements.springs
    k = springs.weight * o.stiffness[springs.kind]
    lightest = np.max(o.inverse_mass[springs.particles], axis=1)
    why = "beyond it a single pass leaves the sheet more than 5 % too soft, more iterations less so"
    return float(FIVE_PERCENT / np.sqrt(np.max(k * lightest))), why


def surely_allowed(o: Oscillators) -> float:
    """The same substep [s]: it is quick to compute."""
    return largest_substep(o)[0]


@disjoint
def _project(xi, yi, zi, xj, yj, zj, ai, bi, ci, aj, bj, cj, wi, wj, compliant, r, alpha_tilde, gamma):
    """Project one spring, in lanes; all arrays (lanes,).

    xi ... zj: components of both ends [m]; ai ... cj: the same at the start of the substep; wi, wj: inverse masses [1/kg].
    compliant: one over the spring's weight.  r: rest length [m].
    """
    one, tiny = xi.dtype.type(1), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        # d, and how it has changed since the start of the substep
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = dx - (aj[l] - ai[l]), dy - (bj[l] - bi[l]), dz - (cj[l] - ci[l])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        g = gamma[l]
        # eq. 26: the error is |d| (C + gamma grad C . (x - x^n)), and delta lambda is over |d|, as it multiplies d below
        error = d2 - r * np.sqrt(d2) + g * (ux * dx + uy * dy + uz * dz)
        delta_lambda = error / (d2 * ((one + g) * (wi[l] + wj[l]) + compliant * alpha_tilde[l]))
        px, py, pz = delta_lambda * dx, delta_lambda * dy, delta_lambda * dz
        # x <- x + w grad C delta lambda
        xi[l] += wi[l] * px
        yi[l] += wi[l] * py
        zi[l] += wi[l] * pz
        xj[l] -= wj[l] * px
        yj[l] -= wj[l] * py
        zj[l] -= wj[l] * pz


@apart
def project_springs(x, start, w, springs, alpha_tilde, gamma):
    """A single pass over the springs, in place: eq. 26 with lambda = 0.

    x, and start: positions at the start of the substep [m], (3, particles, lanes).  w [1/kg]: (particles, lanes).
    alpha_tilde: ``1/(k h^2)`` [1/kg], (kinds, lanes).  gamma: ``tau/h``, (lanes,).
    """
    # a single environment has its own loop: loops over one lane are slow
    if x.shape[2] == 1:
        rows = (3, x.shape[1])
        _project_springs_of_one(x.reshape(rows), start.reshape(rows), w[:, 0], springs, alpha_tilde[:, 0], gamma[0])
        return
    # spring by spring, each in all lanes
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    x0, x1, x2, s0, s1, s2 = x[0], x[1], x[2], start[0], start[1], start[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], s0[i], s1[i], s2[i], s0[j], s1[j], s2[j], w[i], w[j], one / weight[s],
            rest_length[s], alpha_tilde[kind[s]], gamma,
        )  # fmt: skip


@kernel
def _project_springs_of_one(x, start, w, springs, alpha_tilde, gamma):
    """``project_springs`` for one environment: x, start (3, particles), w (particles,), alpha_tilde (kinds,)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        # d, and how it has changed since the start of the substep
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        ux, uy, uz = dx - (start[0, j] - start[0, i]), dy - (start[1, j] - start[1, i]), dz - (start[2, j] - start[2, i])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        compliant = one / weight[s]
        # eq. 26 as in ``_project``, and the move
        error = d2 - rest_length[s] * np.sqrt(d2) + gamma * (ux * dx + uy * dy + uz * dz)
        delta_lambda = error / (d2 * ((one + gamma) * (w[i] + w[j]) + compliant * alpha_tilde[kind[s]]))
        px, py, pz = delta_lambda * dx, delta_lambda * dy, delta_lambda * dz
        x[0, i] += w[i] * px
        x[1, i] += w[i] * py
        x[2, i] += w[i] * pz
        x[0, j] -= w[j] * px
        x[1, j] -= w[j] * py
        x[2, j] -= w[j] * pz


@disjoint
def _project_undamped(xi, yi, zi, xj, yj, zj, wi, wj, compliant, r, alpha_tilde):
    """``_project`` with gamma = 0: eq. 18."""
    tiny = xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        delta_lambda = (d2 - r * np.sqrt(d2)) / (d2 * (wi[l] + wj[l] + compliant * alpha_tilde[l]))
        xi[l] += wi[l] * delta_lambda * dx
        yi[l] += wi[l] * delta_lambda * dy
        zi[l] += wi[l] * delta_lambda * dz
        xj[l] -= wj[l] * delta_lambda * dx
        yj[l] -= wj[l] * delta_lambda * dy
        zj[l] -= wj[l] * delta_lambda * dz


@kernel
def project_undamped_springs(x, w, springs, alpha_tilde):
    """``project_springs`` with gamma = 0: the same bits at half the cost."""
    if x.shape[2] == 1:
        _project_undamped_springs_of_one(x.reshape((3, x.shape[1])), w[:, 0], springs, alpha_tilde[:, 0])
        return
    # spring by spring, each in all lanes
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    x0, x1, x2 = x[0], x[1], x[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project_undamped(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], w[i], w[j], one / weight[s], rest_length[s], alpha_tilde[kind[s]]
        )


@kernel
def _project_undamped_springs_of_one(x, w, springs, alpha_tilde):
    """``project_undamped_springs`` for one environment: x (3, particles), w (particles,), alpha_tilde (kinds,)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        compliant = one / weight[s]
        delta_lambda = (d2 - rest_length[s] * np.sqrt(d2)) / (d2 * (w[i] + w[j] + compliant * alpha_tilde[kind[s]]))
        x[0, i] += w[i] * delta_lambda * dx
        x[1, i] += w[i] * delta_lambda * dy
        x[2, i] += w[i] * delta_lambda * dz
        x[0, j] -= w[j] * delta_lambda * dx
        x[1, j] -= w[j] * delta_lambda * dy
        x[2, j] -= w[j] * delta_lambda * dz


@disjoint
def _project_with_memory(xi, yi, zi, xj, yj, zj, ai, bi, ci, aj, bj, cj, wi, wj, weight, r, inverse_alpha_tilde, gamma, lam):
    """``_project`` with a multiplier, ``lam`` [kg m], (lanes,), which it updates; all arrays (lanes,)."""
    one, tiny = xi.dtype.type(1), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = dx - (aj[l] - ai[l]), dy - (bj[l] - bi[l]), dz - (cj[l] - ci[l])
        inverse = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        length = (dx * dx + dy * dy + dz * dz) * inverse
        g = gamma[l]
        # eq. 26 over alpha~: (C + gamma grad C . (x - x^n))/alpha~, and delta lambda
        k = weight * inverse_alpha_tilde[l]
        error = k * (length - r + g * (ux * dx + uy * dy + uz * dz) * inverse)
        delta_lambda = (error - lam[l]) / (k * (one + g) * (wi[l] + wj[l]) + one)
        lam[l] += delta_lambda
        # x <- x + w grad C delta lambda, with grad C = d/|d|
        p = delta_lambda * inverse
        xi[l] += wi[l] * p * dx
        yi[l] += wi[l] * p * dy
        zi[l] += wi[l] * p * dz
        xj[l] -= wj[l] * p * dx
        yj[l] -= wj[l] * p * dy
        zj[l] -= wj[l] * p * dz


@kernel
def project_springs_with_memory(x, start, w, springs, inverse_alpha_tilde, gamma, lam):
    """One of several passes over the springs, in place: eq. 26 with the multipliers ``lam`` [kg m], (springs, lanes).

    inverse_alpha_tilde: ``k h^2`` [kg], (kinds, lanes).  The equation is multiplied by it, so that a stiffness of zero is no
    division by zero.  Other arguments as for ``project_springs``.
    """
    ends, rest_length, kind, weight = springs
    x0, x1, x2, s0, s1, s2 = x[0], x[1], x[2], start[0], start[1], start[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project_with_memory(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], s0[i], s1[i], s2[i], s0[j], s1[j], s2[j], w[i], w[j], weight[s],
            rest_length[s], inverse_alpha_tilde[kind[s]], gamma, lam[s],
        )  # fmt: skip


@kernel
def predict(x, v, w, start, gravity, push, drag_rate, h):
    """``start <- x``, then ``x <- x + h v*``: free fall with drag and ``push`` [N]; held particles move with their velocity.

    x and start [m], v [m/s]: (3, particles, lanes).
    """
    predict_velocities(v, w, push, gravity, drag_rate, h)
    copy_to(start, x)
    advance_positions(x, v, h)


@disjoint
def _take_component(x, v, w, start, h, per_step):
    """One component of ``take_velocities``, on flat arrays.  per_step: ``1/h`` [1/s]."""
    zero = x.dtype.type(0)
    for e in range(x.shape[0]):
        projected = x[e] - (start[e] + h * v[e])
        v[e] += projected * per_step if w[e] > zero else zero


@kernel
def take_velocities(x, v, w, start, h):
    """``v <- (x - start)/h`` for free particles; x, start [m], v [m/s]: (3, particles, lanes).

    It is computed as ``v + (x - (start + h v))/h``, with v the predicted velocity.  The plain quotient in float32 would round
    gravity's ``g h^2`` to a multiple of the last bit of the position, and more so with smaller substeps.
    """
    for c in range(3):
        _take_component(
            x[c].reshape(w.size), v[c].reshape(w.size), w.reshape(w.size), start[c].reshape(w.size), h, x.dtype.type(1) / h
        )


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``x~ = x^n + h v*``; ``iterations`` passes of eq. 26 over springs, then hinges; ``v = (x - x^n)/h``.

    v* is the velocity after gravity, drag and the air, and x^n is ``start``.  Arguments, shapes and units are those of
    ``integrators.base``.
    """
    stiffness, rigidity, damping_time = elastic
    springs, bends = elements.springs, elements.bends
    one = x.dtype.type(1)
    lanes = x.shape[2]
    iterations = options[0]
    start = work.fields[0]
    # keep the positions, and predict new ones
    predict(x, v, w, start, gravity, push, drag_rate, h)
    # alpha~ and gamma: of springs by kind, and of bends
    inverse_alpha_tilde, alpha_tilde, gamma, inverse_alpha_tilde_bend = (
        np.empty_like(stiffness), np.empty_like(stiffness), np.empty_like(damping_time), np.empty_like(rigidity)
    )  # fmt: skip
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            inverse_alpha_tilde[kind, l] = stiffness[kind, l] * h * h
            alpha_tilde[kind, l] = one / (stiffness[kind, l] * h * h)
    damped = False
    for l in range(lanes):
        inverse_alpha_tilde_bend[l] = rigidity[l] * h * h
        gamma[l] = damping_time[l] / h
        damped |= gamma[l] > 0
    if iterations == 1:
        # a single pass: lambda is zero
        if damped:
            project_springs(x, start, w, springs, alpha_tilde, gamma)
        else:
            project_undamped_springs(x, w, springs, alpha_tilde)
        project_bends(x, start, w, bends, inverse_alpha_tilde_bend, gamma, one, work.of_bends, work.scratch)
    else:
        # several passes: lambda starts from zero, and accumulates
        work.of_springs[:] = 0
        work.of_bends[:] = 0
        for _ in range(iterations):
            project_springs_with_memory(x, start, w, springs, inverse_alpha_tilde, gamma, work.of_springs)
            project_bends(x, start, w, bends, inverse_alpha_tilde_bend, gamma, one, work.of_bends, work.scratch)
    # the velocities follow from the displacements
    take_velocities(x, v, w, start, h)


XPBD = Integrator(
    "xpbd",
    color="#edae49",
    order=1,
    cost="one projection pass for each iteration",
    damping="implicitly, in each projection",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=False,
    options=MappingProxyType({"iterations": 1}),
    multipliers=True,
)

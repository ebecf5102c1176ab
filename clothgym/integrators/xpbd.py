"""Extended position-based dynamics, by default with small steps: one Gauss-Seidel pass over the elements per substep.

Macklin, Mueller and Chentanez 2016, XPBD: position-based simulation of compliant constrained dynamics, eq. 18, with the damping of
eq. 26; Macklin et al. 2019, Small steps in physics simulation, for one pass per substep.

For a constraint C with multiplier lambda, inverse masses w, positions x and those at the start of the substep x^n, a projection is

    delta lambda = (-C - alpha~ lambda - gamma grad C . (x - x^n)) / ((1 + gamma) sum_i w_i |grad_i C|^2 + alpha~),
    lambda <- lambda + delta lambda,    x_i <- x_i + w_i grad_i C delta lambda.

In float32 the corrections of small substeps are not much more than the last bit of x, and their rounding over h would be a spurious
velocity.  The method therefore corrects the velocities ``u = (x - x^n)/h``, by ``w_i grad_i C delta lambda/h``, and updates x once,
at the end.  In the meantime lengths are over h, ``(x_j - x_i)/h = (y_j - y_i) + (u_j - u_i)`` with ``y = x^n/h``, and y and u are
relative to a particle in the middle: their bits do not depend on the position or the common velocity of the sheet.

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

from clothgym._jit import apart, disjoint, kernel, merged
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import Integrator, predict_velocities

TINY = 1e-12  # added to a spring's squared length, which may be zero [m^2]; over h^2 where lengths are over h
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
def _set_out_one(x, middle, remainder, v, v_middle, per_step, places, motion):
    """``set_out`` for one component of one sheet, (particles,); middle, v_middle: numbers."""
    for p in range(x.shape[0]):
        places[p] = ((x[p] - middle) + remainder[p]) * per_step
        motion[p] = v[p] - v_middle


@disjoint
def _set_out_lanes(x, middle, remainder, v, v_middle, per_step, places, motion):
    """``set_out`` for one component of one particle; all arrays (lanes,)."""
    for l in range(x.shape[0]):
        places[l] = ((x[l] - middle[l]) + remainder[l]) * per_step
        motion[l] = v[l] - v_middle[l]


@kernel
def set_out(x, v, w, gravity, push, drag_rate, h, work):
    """``v <- v*``, the velocity of free fall with drag and ``push`` [N]; and what projections go on from, see the module.

    Returns y: places over h, with what x could not hold, and u: velocities, both [m/s], (3, particles, lanes), as seen from the
    particle in the middle of the list.
    """
    predict_velocities(v, w, push, gravity, drag_rate, h, work)
    y, u, remainder = work.fields[0], work.fields[1], work.remainders[0]
    particles, lanes = w.shape
    m, per_step = particles // 2, x.dtype.type(1) / h
    for c in range(3):
        xc, vc, rc, yc, uc = x[c], v[c], remainder[c], y[c], u[c]
        if lanes == 1:
            _set_out_one(merged(xc), xc[m, 0], merged(rc), merged(vc), vc[m, 0], per_step, merged(yc), merged(uc))
            continue
        for p in range(particles):
            _set_out_lanes(xc[p], xc[m], rc[p], vc[p], vc[m], per_step, yc[p], uc[p])
    return y, u


@disjoint
def _arrive_one(x, v, rx, rv, u, v_middle, h):
    """``arrive`` for one component of one sheet, (particles,); v_middle: a number."""
    for p in range(x.shape[0]):
        # v and what projections have changed; then x
        change = (u[p] - (v[p] - v_middle)) + rv[p]
        now = v[p] + change
        rv[p] = change - (now - v[p])
        v[p] = now
        change = h * now + rx[p]
        there = x[p] + change
        rx[p] = change - (there - x[p])
        x[p] = there


@disjoint
def _arrive_lanes(x, v, rx, rv, u, v_middle, h):
    """``arrive`` for one component of one particle; all arrays (lanes,)."""
    for l in range(x.shape[0]):
        change = (u[l] - (v[l] - v_middle[l])) + rv[l]
        now = v[l] + change
        rv[l] = change - (now - v[l])
        v[l] = now
        change = h * now + rx[l]
        there = x[l] + change
        rx[l] = change - (there - x[l])
        x[l] = there


@kernel
def arrive(x, v, h, work):
    """What projections have changed of u is added to v, and ``x <- x + h v``; both compensated, see ``integrators.base``."""
    u, rx, rv = work.fields[1], work.remainders[0], work.remainders[1]
    particles, lanes = x.shape[1], x.shape[2]
    m, middle = particles // 2, work.scratch.rows[0]
    for c in range(3):
        for l in range(lanes):
            middle[l] = v[c, m, l]
        if lanes == 1:
            _arrive_one(merged(x[c]), merged(v[c]), merged(rx[c]), merged(rv[c]), merged(u[c]), middle[0], h)
            continue
        for p in range(particles):
            _arrive_lanes(x[c, p], v[c, p], rx[c, p], rv[c, p], u[c, p], middle, h)


@disjoint
def _project(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, mi, mj, compliant, r, size, tiny, alpha_tilde, gamma):
    """Project one spring, in lanes; all arrays (lanes,).

    xi ... zj: components of both ends' places over h [m/s]; ui ... wj: of their velocities [m/s]; mi, mj: inverse masses [1/kg].
    compliant: one over the spring's weight.  r: rest length of the mesh over h [m/s].  size: factor on it.  tiny: see ``TINY``.
    """
    one = xi.dtype.type(1)
    for l in range(xi.shape[0]):
        # how d changes in the substep, and d at its end, over h
        ux, uy, uz = uj[l] - ui[l], vj[l] - vi[l], wj[l] - wi[l]
        dx, dy, dz = (xj[l] - xi[l]) + ux, (yj[l] - yi[l]) + uy, (zj[l] - zi[l]) + uz
        d2 = dx * dx + dy * dy + dz * dz + tiny
        g = gamma[l]
        # eq. 26: the error is |d| (C + gamma grad C . (x - x^n)), and delta lambda is over |d|, as it multiplies d below
        error = d2 - r * size[l] * np.sqrt(d2) + g * (ux * dx + uy * dy + uz * dz)
        delta_lambda = error / (d2 * ((one + g) * (mi[l] + mj[l]) + compliant * alpha_tilde[l]))
        px, py, pz = delta_lambda * dx, delta_lambda * dy, delta_lambda * dz
        # u <- u + w grad C delta lambda
        ui[l] += mi[l] * px
        vi[l] += mi[l] * py
        wi[l] += mi[l] * pz
        uj[l] -= mj[l] * px
        vj[l] -= mj[l] * py
        wj[l] -= mj[l] * pz


@apart
def project_springs(y, u, w, springs, size, h, alpha_tilde, gamma):
    """A single pass over the springs, which changes u: eq. 26 with lambda = 0.

    y, u: see ``set_out``.  w [1/kg]: (particles, lanes).  alpha_tilde: ``1/(k h^2)`` [1/kg], (kinds, lanes).  gamma: ``tau/h``,
    (lanes,).
    """
    # a single environment has its own loop: loops over one lane are slow
    if y.shape[2] == 1:
        _project_springs_of_one(merged(y), merged(u), w[:, 0], springs, size[0], h, alpha_tilde[:, 0], gamma[0])
        return
    # spring by spring, each in all lanes
    ends, rest_length, kind, weight = springs
    one, per_step = y.dtype.type(1), y.dtype.type(1) / h
    tiny = y.dtype.type(TINY) * per_step * per_step
    y0, y1, y2, u0, u1, u2 = y[0], y[1], y[2], u[0], u[1], u[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project(
            y0[i], y1[i], y2[i], y0[j], y1[j], y2[j], u0[i], u1[i], u2[i], u0[j], u1[j], u2[j], w[i], w[j], one / weight[s],
            rest_length[s] * per_step, size, tiny, alpha_tilde[kind[s]], gamma,
        )  # fmt: skip


@kernel
def _project_springs_of_one(y, u, w, springs, size, h, alpha_tilde, gamma):
    """``project_springs`` for one environment: y, u (3, particles), w (particles,), alpha_tilde (kinds,)."""
    ends, rest_length, kind, weight = springs
    one, per_step = y.dtype.type(1), y.dtype.type(1) / h
    tiny = y.dtype.type(TINY) * per_step * per_step
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        # how d changes in the substep, and d at its end, over h
        ux, uy, uz = u[0, j] - u[0, i], u[1, j] - u[1, i], u[2, j] - u[2, i]
        dx, dy, dz = (y[0, j] - y[0, i]) + ux, (y[1, j] - y[1, i]) + uy, (y[2, j] - y[2, i]) + uz
        d2 = dx * dx + dy * dy + dz * dz + tiny
        compliant = one / weight[s]
        # eq. 26 as in ``_project``, and the change of velocities
        error = d2 - rest_length[s] * per_step * size * np.sqrt(d2) + gamma * (ux * dx + uy * dy + uz * dz)
        delta_lambda = error / (d2 * ((one + gamma) * (w[i] + w[j]) + compliant * alpha_tilde[kind[s]]))
        px, py, pz = delta_lambda * dx, delta_lambda * dy, delta_lambda * dz
        u[0, i] += w[i] * px
        u[1, i] += w[i] * py
        u[2, i] += w[i] * pz
        u[0, j] -= w[j] * px
        u[1, j] -= w[j] * py
        u[2, j] -= w[j] * pz


@disjoint
def _project_with_memory(
    xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, mi, mj, weight, r, size, tiny, inverse_alpha_tilde, gamma, lam
):  # fmt: skip
    """``_project`` with a multiplier, ``lam`` [kg m/s], (lanes,), which it updates; all arrays (lanes,)."""
    one = xi.dtype.type(1)
    for l in range(xi.shape[0]):
        ux, uy, uz = uj[l] - ui[l], vj[l] - vi[l], wj[l] - wi[l]
        dx, dy, dz = (xj[l] - xi[l]) + ux, (yj[l] - yi[l]) + uy, (zj[l] - zi[l]) + uz
        inverse = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        length = (dx * dx + dy * dy + dz * dz) * inverse
        g = gamma[l]
        # eq. 26 over alpha~: (C + gamma grad C . (x - x^n))/alpha~, and delta lambda
        k = weight * inverse_alpha_tilde[l]
        error = k * (length - r * size[l] + g * (ux * dx + uy * dy + uz * dz) * inverse)
        delta_lambda = (error - lam[l]) / (k * (one + g) * (mi[l] + mj[l]) + one)
        lam[l] += delta_lambda
        # u <- u + w grad C delta lambda, with grad C = d/|d|
        p = delta_lambda * inverse
        ui[l] += mi[l] * p * dx
        vi[l] += mi[l] * p * dy
        wi[l] += mi[l] * p * dz
        uj[l] -= mj[l] * p * dx
        vj[l] -= mj[l] * p * dy
        wj[l] -= mj[l] * p * dz


@kernel
def project_springs_with_memory(y, u, w, springs, size, h, inverse_alpha_tilde, gamma, lam):
    """One of several passes over the springs: eq. 26 with the multipliers ``lam`` over h [kg m/s], (springs, lanes).

    inverse_alpha_tilde: ``k h^2`` [kg], (kinds, lanes).  The equation is multiplied by it, so that a stiffness of zero is no
    division by zero.  Other arguments as for ``project_springs``.
    """
    ends, rest_length, kind, weight = springs
    per_step = y.dtype.type(1) / h
    tiny = y.dtype.type(TINY) * per_step * per_step
    y0, y1, y2, u0, u1, u2 = y[0], y[1], y[2], u[0], u[1], u[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project_with_memory(
            y0[i], y1[i], y2[i], y0[j], y1[j], y2[j], u0[i], u1[i], u2[i], u0[j], u1[j], u2[j], w[i], w[j], weight[s],
            rest_length[s] * per_step, size, tiny, inverse_alpha_tilde[kind[s]], gamma, lam[s],
        )  # fmt: skip


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``v = v*``; ``iterations`` passes of eq. 26 over springs, then hinges, at ``x^n + h v``; ``x = x^n + h v``.

    v* is the velocity after gravity, drag and the air.  Arguments, shapes and units are those of ``integrators.base``.
    """
    stiffness, rigidity, damping_time, size = elastic
    springs, bends = elements.springs, elements.bends
    one = x.dtype.type(1)
    lanes = x.shape[2]
    iterations = options[0]
    # v*, and what projections go on from
    y, u = set_out(x, v, w, gravity, push, drag_rate, h, work)
    # alpha~ and gamma: of springs by kind, and of bends
    inverse_alpha_tilde, alpha_tilde, gamma, inverse_alpha_tilde_bend = (
        np.empty_like(stiffness), np.empty_like(stiffness), np.empty_like(damping_time), np.empty_like(rigidity)
    )  # fmt: skip
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            inverse_alpha_tilde[kind, l] = stiffness[kind, l] * h * h
            alpha_tilde[kind, l] = one / (stiffness[kind, l] * h * h)
    for l in range(lanes):
        inverse_alpha_tilde_bend[l] = rigidity[l] * h * h
        gamma[l] = damping_time[l] / h
    if iterations == 1:
        # a single pass: lambda is zero
        project_springs(y, u, w, springs, size, h, alpha_tilde, gamma)
        project_bends(y, u, w, bends, h, inverse_alpha_tilde_bend, gamma, one, work.of_bends, work.scratch)
    else:
        # several passes: lambda starts from zero, and accumulates
        work.of_springs[:] = 0
        work.of_bends[:] = 0
        for _ in range(iterations):
            project_springs_with_memory(y, u, w, springs, size, h, inverse_alpha_tilde, gamma, work.of_springs)
            project_bends(y, u, w, bends, h, inverse_alpha_tilde_bend, gamma, one, work.of_bends, work.scratch)
    # the new velocities, and positions with them
    arrive(x, v, h, work)


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
    fields=2,
    multipliers=True,
)

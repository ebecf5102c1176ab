"""Extended position-based dynamics, by default with small steps: one Gauss-Seidel pass over the elements a substep.

Macklin, Mueller and Chentanez 2016 (XPBD), eq. 18 with the damping of eq. 26; Macklin et al. 2019 (Small Steps) for one pass
a substep, in which the multipliers start from zero and need no memory.  ``iterations`` beyond one accumulate them within the
substep, and converge to backward Euler.

Order 1.  Cost: one projection pass an iteration.  On one spring it is implicit Euler to rounding: amplitude 1/sqrt(1 + (h w)^2) a
substep.  Never unstable, but soft when under-resolved: a chain of N links has the stiffness k/(1 + q^2 (N - 1)/N) with
q = h sqrt(k/m), 5 % too little at q = 0.229.  Damping along springs enters implicitly.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import apart, disjoint, kernel
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import Integrator, advance_positions, copy_to, predict_velocities

TINY = 1e-12  # [m^2]: a spring of no length
FIVE_PERCENT = 0.229


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The substep at which ``h sqrt(k/m)`` of the stiffest spring on the lightest particle reaches 0.229."""
    springs = o.elements.springs
    k = springs.weight * o.stiffness[springs.kind]
    lightest = np.max(o.inverse_mass[springs.particles], axis=1)
    why = "beyond it a single pass leaves the sheet more than 5 % too soft, more iterations less so"
    return float(FIVE_PERCENT / np.sqrt(np.max(k * lightest))), why


def surely_allowed(o: Oscillators) -> float:
    """The formula is quick: the same."""
    return largest_substep(o)[0]


@disjoint
def _project(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, mi, mj, flexible, r, compliance, damping):
    """Move both ends of one spring, in lanes: components of positions, and of those at the substep's start; m: inverse masses."""
    one, tiny = xi.dtype.type(1), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = dx - (uj[l] - ui[l]), dy - (vj[l] - vi[l]), dz - (wj[l] - wi[l])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        g = damping[l]
        push = d2 - r * np.sqrt(d2) + g * (ux * dx + uy * dy + uz * dz)
        lam = push / (d2 * ((one + g) * (mi[l] + mj[l]) + flexible * compliance[l]))
        fx, fy, fz = lam * dx, lam * dy, lam * dz
        xi[l] += mi[l] * fx
        yi[l] += mi[l] * fy
        zi[l] += mi[l] * fz
        xj[l] -= mj[l] * fx
        yj[l] -= mj[l] * fy
        zj[l] -= mj[l] * fz


@apart
def project_springs(x, start, w, springs, compliance, damping):
    """Move both ends of each spring towards its rest length, in place.

    compliance: ``1/(k h^2)`` [1/kg], (kinds, lanes).  damping: ``tau/h``, (lanes,).  start: positions at the beginning of
    the substep, whose difference to ``x`` is the velocity that the damper sees.
    """
    if x.shape[2] == 1:
        rows = (3, x.shape[1])
        _project_springs_of_one(x.reshape(rows), start.reshape(rows), w[:, 0], springs, compliance[:, 0], damping[0])
        return
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    x0, x1, x2, s0, s1, s2 = x[0], x[1], x[2], start[0], start[1], start[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], s0[i], s1[i], s2[i], s0[j], s1[j], s2[j], w[i], w[j], one / weight[s],
            rest_length[s], compliance[kind[s]], damping,
        )  # fmt: skip


@kernel
def _project_springs_of_one(x, start, w, springs, compliance, damping):
    """The same arithmetic on a single environment, (3, particles)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        ux, uy, uz = dx - (start[0, j] - start[0, i]), dy - (start[1, j] - start[1, i]), dz - (start[2, j] - start[2, i])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        flexible = one / weight[s]
        push = d2 - rest_length[s] * np.sqrt(d2) + damping * (ux * dx + uy * dy + uz * dz)
        lam = push / (d2 * ((one + damping) * (w[i] + w[j]) + flexible * compliance[kind[s]]))
        fx, fy, fz = lam * dx, lam * dy, lam * dz
        x[0, i] += w[i] * fx
        x[1, i] += w[i] * fy
        x[2, i] += w[i] * fz
        x[0, j] -= w[j] * fx
        x[1, j] -= w[j] * fy
        x[2, j] -= w[j] * fz


@disjoint
def _project_undamped(xi, yi, zi, xj, yj, zj, mi, mj, flexible, r, compliance):
    """The same without a damper."""
    tiny = xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        lam = (d2 - r * np.sqrt(d2)) / (d2 * (mi[l] + mj[l] + flexible * compliance[l]))
        xi[l] += mi[l] * lam * dx
        yi[l] += mi[l] * lam * dy
        zi[l] += mi[l] * lam * dz
        xj[l] -= mj[l] * lam * dx
        yj[l] -= mj[l] * lam * dy
        zj[l] -= mj[l] * lam * dz


@kernel
def project_undamped_springs(x, w, springs, compliance):
    """``project_springs`` for damping zero: the same bits at half the cost."""
    if x.shape[2] == 1:
        _project_undamped_springs_of_one(x.reshape((3, x.shape[1])), w[:, 0], springs, compliance[:, 0])
        return
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    x0, x1, x2 = x[0], x[1], x[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project_undamped(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], w[i], w[j], one / weight[s], rest_length[s], compliance[kind[s]]
        )


@kernel
def _project_undamped_springs_of_one(x, w, springs, compliance):
    """The same arithmetic on a single environment, (3, particles)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(TINY)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx, dy, dz = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        flexible = one / weight[s]
        lam = (d2 - rest_length[s] * np.sqrt(d2)) / (d2 * (w[i] + w[j] + flexible * compliance[kind[s]]))
        x[0, i] += w[i] * lam * dx
        x[1, i] += w[i] * lam * dy
        x[2, i] += w[i] * lam * dz
        x[0, j] -= w[j] * lam * dx
        x[1, j] -= w[j] * lam * dy
        x[2, j] -= w[j] * lam * dz


@disjoint
def _project_with_memory(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, mi, mj, share, r, scale, damping, known):
    """The same with a multiplier, (lanes,) [kg m]."""
    one, tiny = xi.dtype.type(1), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = dx - (uj[l] - ui[l]), dy - (vj[l] - vi[l]), dz - (wj[l] - wi[l])
        inverse = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        length = (dx * dx + dy * dy + dz * dz) * inverse
        g = damping[l]
        k = share * scale[l]
        force = k * (length - r + g * (ux * dx + uy * dy + uz * dz) * inverse)
        change = (force - known[l]) / (k * (one + g) * (mi[l] + mj[l]) + one)
        known[l] += change
        lam = change * inverse
        xi[l] += mi[l] * lam * dx
        yi[l] += mi[l] * lam * dy
        zi[l] += mi[l] * lam * dz
        xj[l] -= mj[l] * lam * dx
        yj[l] -= mj[l] * lam * dy
        zj[l] -= mj[l] * lam * dz


@kernel
def project_springs_with_memory(x, start, w, springs, pull, damping, multipliers):
    """One of several passes: what earlier ones have put into the multipliers, (springs, lanes) [kg m], is kept in account.

    pull: ``k h^2`` [kg], (kinds, lanes): eq. 18 and 26 of the paper times it, so that no stiffness of zero is divided by.
    """
    ends, rest_length, kind, weight = springs
    x0, x1, x2, s0, s1, s2 = x[0], x[1], x[2], start[0], start[1], start[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _project_with_memory(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], s0[i], s1[i], s2[i], s0[j], s1[j], s2[j], w[i], w[j], weight[s],
            rest_length[s], pull[kind[s]], damping, multipliers[s],
        )  # fmt: skip


@kernel
def predict(x, v, w, start, gravity, push, drag_rate, h):
    """Keep the positions in ``start``, then fall freely but for ``push`` [N]; held particles move by their own velocity."""
    predict_velocities(v, w, push, gravity, drag_rate, h)
    copy_to(start, x)
    advance_positions(x, v, h)


@disjoint
def _take(x, v, w, start, h, per_step):
    zero = x.dtype.type(0)
    for e in range(x.shape[0]):
        projected = x[e] - (start[e] + h * v[e])
        v[e] += projected * per_step if w[e] > zero else zero


@kernel
def take_velocities(x, v, w, start, h):
    """The velocity of a free particle is what it did in the substep, ``(x - start)/h``.

    Written as the predicted velocity and the projections' share: in float32 the plain quotient would round gravity's
    ``g h^2`` to whole units in the last place of the position, and grow worse with smaller substeps.
    """
    for c in range(3):
        _take(x[c].reshape(w.size), v[c].reshape(w.size), w.reshape(w.size), start[c].reshape(w.size), h, x.dtype.type(1) / h)


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    stiffness, rigidity, damping_time = elastic
    springs, bends = elements.springs, elements.bends
    one = x.dtype.type(1)
    lanes = x.shape[2]
    iterations = options[0]
    start = work.fields[0]
    predict(x, v, w, start, gravity, push, drag_rate, h)
    pull, compliance, damping, bend = (
        np.empty_like(stiffness), np.empty_like(stiffness), np.empty_like(damping_time), np.empty_like(rigidity)
    )  # fmt: skip
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            pull[kind, l] = stiffness[kind, l] * h * h
            compliance[kind, l] = one / (stiffness[kind, l] * h * h)
    damped = False
    for l in range(lanes):
        bend[l] = rigidity[l] * h * h
        damping[l] = damping_time[l] / h
        damped |= damping[l] > 0
    if iterations == 1:
        if damped:
            project_springs(x, start, w, springs, compliance, damping)
        else:
            project_undamped_springs(x, w, springs, compliance)
        project_bends(x, start, w, bends, bend, damping, one, work.of_bends, work.scratch)
    else:
        work.of_springs[:] = 0
        work.of_bends[:] = 0
        for _ in range(iterations):
            project_springs_with_memory(x, start, w, springs, pull, damping, work.of_springs)
            project_bends(x, start, w, bends, bend, damping, one, work.of_bends, work.scratch)
    take_velocities(x, v, w, start, h)


XPBD = Integrator(
    "xpbd",
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

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

from clothgym._jit import apart, kernel
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import SCRATCH, Integrator

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


@apart
def project_springs(x, start, w, springs, compliance, damping, row):
    """Move both ends of each spring towards its rest length, in place.

    compliance: ``1/(k h^2)`` [1/kg], (kinds, lanes).  damping: ``tau/h``, (lanes,).  start: positions at the beginning of
    the substep, whose difference to ``x`` is the velocity that the damper sees.  row: scratch, (3, lanes): with as many rows to
    read as here, simple loops are faster than one that writes where it reads.
    """
    if x.shape[2] == 1:
        _project_springs_of_one(x[:, :, 0], start[:, :, 0], w[:, 0], springs, compliance[:, 0], damping[0])
        return
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        xi, xj, si, sj, wi, wj = x[i], x[j], start[i], start[j], w[i], w[j]
        a = compliance[kind[s]]
        flexible = one / weight[s]
        r = rest_length[s]
        for l in range(x.shape[2]):
            dx, dy, dz = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
            ux, uy, uz = dx - (sj[0, l] - si[0, l]), dy - (sj[1, l] - si[1, l]), dz - (sj[2, l] - si[2, l])
            d2 = dx * dx + dy * dy + dz * dz + tiny
            g = damping[l]
            push = d2 - r * np.sqrt(d2) + g * (ux * dx + uy * dy + uz * dz)
            lam = push / (d2 * ((one + g) * (wi[l] + wj[l]) + flexible * a[l]))
            row[0, l] = lam * dx
            row[1, l] = lam * dy
            row[2, l] = lam * dz
        for c in range(3):
            for l in range(x.shape[2]):
                xi[c, l] += wi[l] * row[c, l]
            for l in range(x.shape[2]):
                xj[c, l] -= wj[l] * row[c, l]


@kernel
def _project_springs_of_one(x, start, w, springs, compliance, damping):
    """The same arithmetic on a single environment, (particles, 3)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        ux, uy, uz = dx - (start[j, 0] - start[i, 0]), dy - (start[j, 1] - start[i, 1]), dz - (start[j, 2] - start[i, 2])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        flexible = one / weight[s]
        push = d2 - rest_length[s] * np.sqrt(d2) + damping * (ux * dx + uy * dy + uz * dz)
        lam = push / (d2 * ((one + damping) * (w[i] + w[j]) + flexible * compliance[kind[s]]))
        fx, fy, fz = lam * dx, lam * dy, lam * dz
        x[i, 0] += w[i] * fx
        x[i, 1] += w[i] * fy
        x[i, 2] += w[i] * fz
        x[j, 0] -= w[j] * fx
        x[j, 1] -= w[j] * fy
        x[j, 2] -= w[j] * fz


@kernel
def project_undamped_springs(x, w, springs, compliance):
    """``project_springs`` for damping zero: the same bits at half the cost."""
    if x.shape[2] == 1:
        _project_undamped_springs_of_one(x[:, :, 0], w[:, 0], springs, compliance[:, 0])
        return
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        xi, xj, wi, wj = x[i], x[j], w[i], w[j]
        a = compliance[kind[s]]
        flexible = one / weight[s]
        r = rest_length[s]
        for l in range(x.shape[2]):
            dx, dy, dz = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
            d2 = dx * dx + dy * dy + dz * dz + tiny
            lam = (d2 - r * np.sqrt(d2)) / (d2 * (wi[l] + wj[l] + flexible * a[l]))
            xi[0, l] += wi[l] * lam * dx
            xi[1, l] += wi[l] * lam * dy
            xi[2, l] += wi[l] * lam * dz
            xj[0, l] -= wj[l] * lam * dx
            xj[1, l] -= wj[l] * lam * dy
            xj[2, l] -= wj[l] * lam * dz


@kernel
def _project_undamped_springs_of_one(x, w, springs, compliance):
    """The same arithmetic on a single environment, (particles, 3)."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        flexible = one / weight[s]
        lam = (d2 - rest_length[s] * np.sqrt(d2)) / (d2 * (w[i] + w[j] + flexible * compliance[kind[s]]))
        x[i, 0] += w[i] * lam * dx
        x[i, 1] += w[i] * lam * dy
        x[i, 2] += w[i] * lam * dz
        x[j, 0] -= w[j] * lam * dx
        x[j, 1] -= w[j] * lam * dy
        x[j, 2] -= w[j] * lam * dz


@kernel
def project_springs_with_memory(x, start, w, springs, pull, damping, multipliers):
    """One of several passes: what earlier ones have put into the multipliers, (springs, lanes) [kg m], is kept in account.

    pull: ``k h^2`` [kg], (kinds, lanes): eq. 18 and 26 of the paper times it, so that no stiffness of zero is divided by.
    """
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        xi, xj, si, sj, wi, wj = x[i], x[j], start[i], start[j], w[i], w[j]
        scale = pull[kind[s]]
        share = weight[s]
        r = rest_length[s]
        known = multipliers[s]
        for l in range(x.shape[2]):
            dx, dy, dz = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
            ux, uy, uz = dx - (sj[0, l] - si[0, l]), dy - (sj[1, l] - si[1, l]), dz - (sj[2, l] - si[2, l])
            inverse = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
            length = (dx * dx + dy * dy + dz * dz) * inverse
            g = damping[l]
            k = share * scale[l]
            force = k * (length - r + g * (ux * dx + uy * dy + uz * dz) * inverse)
            change = (force - known[l]) / (k * (one + g) * (wi[l] + wj[l]) + one)
            known[l] += change
            lam = change * inverse
            xi[0, l] += wi[l] * lam * dx
            xi[1, l] += wi[l] * lam * dy
            xi[2, l] += wi[l] * lam * dz
            xj[0, l] -= wj[l] * lam * dx
            xj[1, l] -= wj[l] * lam * dy
            xj[2, l] -= wj[l] * lam * dz


@kernel
def predict(x, v, w, start, gravity, push, drag_rate, h, row):
    """Keep the positions in ``start``, then fall freely but for ``push`` [N]; held particles move by their own velocity.

    The velocity is that of ``base.predict_velocities``, in the same pass.
    """
    one = x.dtype.type(1)
    keep = row[0]
    for l in range(x.shape[2]):
        keep[l] = one / (one + h * drag_rate[l])
    for p in range(x.shape[0]):
        wp = w[p]
        for c in range(3):
            xc, vc, sc, fc, gc = x[p, c], v[p, c], start[p, c], push[p, c], gravity[c]
            for l in range(x.shape[2]):
                free = vc[l] * keep[l] + h * (fc[l] * wp[l] + gc[l])
                vc[l] = free if wp[l] > 0 else vc[l]
                sc[l] = xc[l]
                xc[l] += h * vc[l]


@kernel
def take_velocities(x, v, w, start, h):
    """The velocity of a free particle is what it did in the substep, ``(x - start)/h``.

    Written as the predicted velocity and the projections' share: in float32 the plain quotient would round gravity's
    ``g h^2`` to whole units in the last place of the position, and grow worse with smaller substeps.
    """
    per_step = x.dtype.type(1) / h
    for p in range(x.shape[0]):
        wp = w[p]
        for c in range(3):
            vc, xc, sc = v[p, c], x[p, c], start[p, c]
            for l in range(x.shape[2]):
                projected = xc[l] - (sc[l] + h * vc[l])
                vc[l] = vc[l] + projected * per_step if wp[l] > 0 else vc[l]


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    stiffness, rigidity, damping_time = elastic
    springs, bends = elements
    one = x.dtype.type(1)
    n, lanes = x.shape[0], x.shape[2]
    iterations = options[0]
    start = work[:n]
    predict(x, v, w, start, gravity, push, drag_rate, h, work[-1])
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
            project_springs(x, start, w, springs, compliance, damping, work[-1])
        else:
            project_undamped_springs(x, w, springs, compliance)
        project_bends(x, start, w, bends, bend, damping, one, work[:0], work[-SCRATCH:])
    else:
        rows = (springs.kind.shape[0] + 2) // 3
        of_springs = work[n : n + rows].reshape((3 * rows, lanes))
        of_bends = work[n + rows : n + rows + bends.weight.shape[0]]
        work[n : n + rows + bends.weight.shape[0]] = 0
        for _ in range(iterations):
            project_springs_with_memory(x, start, w, springs, pull, damping, of_springs)
            project_bends(x, start, w, bends, bend, damping, one, of_bends, work[-SCRATCH:])
    take_velocities(x, v, w, start, h)


XPBD = Integrator(
    "xpbd",
    order=1,
    cost="one projection pass for each iteration",
    damping="implicitly, in each projection",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    springs_by_particle=False,
    options=MappingProxyType({"iterations": 1}),
    multipliers=True,
)

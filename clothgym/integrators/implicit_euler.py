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

from clothgym._jit import kernel
from clothgym.bending import add_bend_forces, add_bend_products
from clothgym.forces import Oscillators, add_spring_forces, add_spring_products
from clothgym.integrators.base import SCRATCH, Integrator, add_to, move_on, predict_velocities, weigh

GRAVITY = 9.81
LOST = 0.02


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """Where a swing loses a fiftieth of its amplitude in a period.

    ``(1 + (h w)^2)^(-1/2)`` a substep is ``exp(-pi h w)`` a period; w is that of a pendulum as long as the sheet's longest side.
    """
    length = float(np.ptp(o.positions, axis=0).max())
    return LOST / (np.pi * np.sqrt(GRAVITY / length)), "beyond it a swing loses more than 2 % a period (it is never unstable)"


def surely_allowed(o: Oscillators) -> float:
    """Any: it is taken for its large steps, and nobody need be warned of them."""
    return float("inf")


@kernel
def _turn(w, r, p, q, share, mass):
    """The next search direction, ``p = M^-1 r + share p``, and its product with the masses, ``q = M p``, in one pass.

    A held particle has neither.  share: (lanes,); mass: scratch, (lanes,).
    """
    one, zero = p.dtype.type(1), p.dtype.type(0)
    for i in range(p.shape[0]):
        wi = w[i]
        for l in range(p.shape[2]):
            mass[l] = one / (wi[l] if wi[l] > zero else one)
        for c in range(3):
            rc, pc, qc = r[i, c], p[i, c], q[i, c]
            for l in range(p.shape[2]):
                pc[l] = wi[l] * rc[l] + share[l] * pc[l]
                qc[l] = mass[l] * pc[l]


@kernel
def _product_along(p, q, out):
    """``p . q`` of each lane, (lanes,)."""
    out[:] = 0
    for i in range(p.shape[0]):
        for c in range(3):
            pc, qc = p[i, c], q[i, c]
            for l in range(p.shape[2]):
                out[l] += pc[l] * qc[l]


@kernel
def _square(w, r, out):
    """``r . M^-1 r`` of each lane, (lanes,)."""
    out[:] = 0
    for i in range(r.shape[0]):
        wi = w[i]
        for c in range(3):
            rc = r[i, c]
            for l in range(r.shape[2]):
                out[l] += wi[l] * rc[l] * rc[l]


@kernel
def _advance(w, d, p, q, r, step, after):
    """``d += step p``, ``r -= step q``, and the new residual's square, (lanes,)."""
    after[:] = 0
    for i in range(p.shape[0]):
        wi = w[i]
        for c in range(3):
            dc, pc, qc, rc = d[i, c], p[i, c], q[i, c], r[i, c]
            for l in range(p.shape[2]):
                dc[l] += step[l] * pc[l]
                rc[l] -= step[l] * qc[l]
                after[l] += wi[l] * rc[l] * rc[l]


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    stiffness, rigidity, damping_time = elastic
    t = x.dtype.type
    zero = t(0)
    n, lanes = x.shape[0], x.shape[2]
    newton_iterations, iterations, tolerance = options
    start, total, d = work[:n], work[n : 2 * n], work[2 * n : 3 * n]
    r, p, q = work[3 * n : 4 * n], work[4 * n : 5 * n], work[5 * n : 6 * n]
    scratch = work[-SCRATCH:]
    goal, rho, step, after, mass, bend = np.empty((6, lanes), x.dtype)
    along, across = np.empty_like(stiffness), np.empty_like(stiffness)
    for kind in range(stiffness.shape[0]):
        for l in range(lanes):
            across[kind, l] = -stiffness[kind, l] * h * h
    predict_velocities(v, w, push, gravity, drag_rate, h, work[-1])
    start[:] = x
    total[:] = 0
    for newton in range(newton_iterations):
        if newton > 0:
            move_on(x, v, start, h)
        r[:] = 0
        add_spring_forces(x, v, r, elements.springs, stiffness, damping_time, work[-1])
        add_bend_forces(x, v, r, elements.bends, rigidity, damping_time, scratch)
        weigh(w, total, r, h)
        if newton == 0:
            for l in range(lanes):
                bend[l] = -rigidity[l] * h * h
            add_spring_products(x, v, r, elements.springs, across, across, work[-1])
            add_bend_products(x, v, r, elements.bends, bend, scratch)
            for kind in range(stiffness.shape[0]):
                for l in range(lanes):
                    across[kind, l] = stiffness[kind, l] * h * h
                    along[kind, l] = stiffness[kind, l] * (h * h + h * damping_time[l])
        _square(w, r, rho)
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
            _turn(w, r, p, q, step, mass)
            add_spring_products(x, p, q, elements.springs, along, across, work[-1])
            add_bend_products(x, p, q, elements.bends, bend, scratch)
            _product_along(p, q, step)
            for l in range(lanes):
                step[l] = rho[l] / step[l] if rho[l] > goal[l] and step[l] > zero else zero
            _advance(w, d, p, q, r, step, after)
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
    springs_by_particle=True,
    options=MappingProxyType({"newton_iterations": 1, "iterations": 200, "tolerance": 1e-2}),
    fields=6,
)

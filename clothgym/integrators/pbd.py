"""Position-based dynamics: Mueller, Heidelberger, Hennix and Ratcliff 2007.

Particles fall freely for a substep, then ``iterations`` Gauss-Seidel passes move the ends of each spring towards its rest length,
and velocities are what was moved.  A pass takes the share ``k' = 1 - (1 - k)^(1/iterations)`` of each constraint (their section
3.3), so that a lone one is left with 1 - k of its error whatever the number of passes.

It is here because it is everywhere.  It does not converge, and no material figure but the density means anything to it: the
stiffness k is a number from 0 to 1 a substep, ``stretch`` for threads and diagonals and ``bend`` for what bends, and twice the
substeps make another fabric.  A lone oscillator loses amplitude by sqrt(1 - k) a substep and turns by acos(sqrt(1 - k)), for any h.

Order: none.  Cost: one projection pass an iteration.  Never unstable.  Damping along springs does not enter: the projections
damp far more.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import disjoint, kernel
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import Integrator
from clothgym.integrators.xpbd import TINY, predict, take_velocities
from clothgym.mesh import SHEAR

USUAL = 1 / 300  # [s]
RIGID = 1e12  # a scale at which projecting a bend solves it whole


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """What is usual, for want of anything to hold it against."""
    return USUAL, "no substep is right for it: its stiffness depends on the substep and the iterations"


def surely_allowed(o: Oscillators) -> float:
    """Any: there is nothing to warn of that is not always so."""
    return float("inf")


@disjoint
def _project_rigid(xi, yi, zi, xj, yj, zj, mi, mj, share, r):
    """Move both ends of one spring, in lanes."""
    tiny = xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        d2 = dx * dx + dy * dy + dz * dz + tiny
        lam = share * (d2 - r * np.sqrt(d2)) / (d2 * (mi[l] + mj[l] + tiny))
        xi[l] += mi[l] * lam * dx
        yi[l] += mi[l] * lam * dy
        zi[l] += mi[l] * lam * dz
        xj[l] -= mj[l] * lam * dx
        yj[l] -= mj[l] * lam * dy
        zj[l] -= mj[l] * lam * dz


@kernel
def project_rigid_springs(x, w, springs, stretch, bend):
    """Move both ends of each spring by the share ``stretch``, or ``bend`` for what bends, of its error, in place."""
    ends, rest_length, kind, _ = springs
    x0, x1, x2 = x[0], x[1], x[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        share = bend if kind[s] > SHEAR else stretch
        _project_rigid(x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], w[i], w[j], share, rest_length[s])


@kernel
def share_of_a_pass(k, iterations):
    """``1 - (1 - k)^(1/iterations)``, by Newton's method on ``y^iterations = 1 - k`` from above: no power function in a kernel."""
    left = 1.0 - k
    if left <= 0.0:
        return 1.0
    y = 1.0
    for _ in range(60 * iterations):
        power = 1.0
        for _ in range(iterations - 1):
            power *= y
        change = (power * y - left) / (iterations * power)
        y -= change
        if change <= 1e-16:
            break
    return 1.0 - y


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    _, rigidity, damping_time = elastic
    t = x.dtype.type
    iterations, stretch, bend = options
    start = work.fields[0]
    scale, damping = np.empty_like(rigidity), np.empty_like(rigidity)
    scale[:] = RIGID
    damping[:] = 0
    along, across = t(share_of_a_pass(stretch, iterations)), t(share_of_a_pass(bend, iterations))
    predict(x, v, w, start, gravity, push, drag_rate, h)
    for _ in range(iterations):
        project_rigid_springs(x, w, elements.springs, along, across)
        project_bends(x, start, w, elements.bends, scale, damping, across, work.of_bends, work.scratch)
    take_velocities(x, v, w, start, h)


PBD = Integrator(
    "pbd",
    order=None,
    cost="one projection pass for each iteration",
    damping="not at all: the projections damp far more",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=False,
    options=MappingProxyType({"iterations": 10, "stretch": 0.9, "bend": 0.1}),
    ignored=frozenset({"stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time"}),
)

"""Position-based dynamics.

Mueller, Heidelberger, Hennix and Ratcliff 2007, Position based dynamics.

Particles fall freely for a substep.  Then ``iterations`` Gauss-Seidel passes move the ends of each spring towards its rest length,
and the velocities follow from the displacements.  A pass removes the share ``k' = 1 - (1 - k)^(1/iterations)`` of each constraint's
error (their section 3.3), so that a lone constraint is left with 1 - k of its error, whatever the number of passes.

It is here because it is widely used.  It does not converge, and density is the only material property that it uses.  Its stiffness
k is a number from 0 to 1: ``stretch`` for structural and shear springs, ``bend`` for bending springs and hinges.  It applies per
substep, so twice the substeps make another fabric.  In each substep a lone oscillator's amplitude is multiplied by sqrt(1 - k) and
its phase advances by acos(sqrt(1 - k)), for any h.

Order: none.  Cost: one projection pass per iteration.  Never unstable.  Damping along springs does not enter: the projections damp
far more.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from clothgym._jit import disjoint, kernel
from clothgym.bending import project_bends
from clothgym.forces import Oscillators
from clothgym.integrators.base import Integrator
from clothgym.integrators.xpbd import TINY, arrive, set_out
from clothgym.mesh import SHEAR

USUAL = 1 / 300  # a usual substep [s]
RIGID = 1e12  # 1/alpha_tilde of a bend [kg m^2]: so large that its projection solves the constraint entirely


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """A usual substep [s], as no bound exists, and the reason."""
    return USUAL, "no substep is right for it: its stiffness depends on the substep and the iterations"


def surely_allowed(o: Oscillators) -> float:
    """Any substep: what there is to warn of holds for every substep."""
    return float("inf")


@disjoint
def _project_rigid(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, mi, mj, share, r, size, tiny):
    """Project one spring, in lanes: ``dp_i = k' w_i/(w_i + w_j) (|d| - r) d/|d|``, ``dp_j = -w_j/w_i dp_i`` (their section 3.3).

    d: the vector from i to j at the end of the substep, over h.  xi ... zj: components of both ends' places over h [m/s]; ui ...
    wj: of their velocities [m/s], which change by dp/h; mi, mj: inverse masses [1/kg]; all (lanes,).  share: k'.  r: rest length
    of the mesh over h [m/s].  size: factor on it.  tiny: see ``xpbd.TINY``.
    """
    massless = xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = (xj[l] - xi[l]) + (uj[l] - ui[l]), (yj[l] - yi[l]) + (vj[l] - vi[l]), (zj[l] - zi[l]) + (wj[l] - wi[l])
        d2 = dx * dx + dy * dy + dz * dz + tiny
        # the change of velocity of a unit of inverse mass, over d
        s = share * (d2 - r * size[l] * np.sqrt(d2)) / (d2 * (mi[l] + mj[l] + massless))
        ui[l] += mi[l] * s * dx
        vi[l] += mi[l] * s * dy
        wi[l] += mi[l] * s * dz
        uj[l] -= mj[l] * s * dx
        vj[l] -= mj[l] * s * dy
        wj[l] -= mj[l] * s * dz


@kernel
def project_rigid_springs(y, u, w, springs, size, h, stretch, bend):
    """One pass over the springs, which changes u: remove the share ``stretch`` of each error, or ``bend`` for springs that bend.

    y, u: see ``xpbd.set_out``.  w [1/kg]: (particles, lanes).
    """
    ends, rest_length, kind, _ = springs
    per_step = y.dtype.type(1) / h
    tiny = y.dtype.type(TINY) * per_step * per_step
    y0, y1, y2, u0, u1, u2 = y[0], y[1], y[2], u[0], u[1], u[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        share = bend if kind[s] > SHEAR else stretch
        _project_rigid(
            y0[i], y1[i], y2[i], y0[j], y1[j], y2[j], u0[i], u1[i], u2[i], u0[j], u1[j], u2[j], w[i], w[j], share,
            rest_length[s] * per_step, size, tiny,
        )  # fmt: skip


@kernel
def share_of_a_pass(k, iterations):
    """``k' = 1 - (1 - k)^(1/iterations)``, the share of a constraint's error that one pass removes (their section 3.3).

    By Newton's method on ``y^iterations = 1 - k`` from above, as kernels call no power function.
    """
    # k = 1: each pass removes all of the error
    left = 1.0 - k
    if left <= 0.0:
        return 1.0
    # Newton's steps are positive until rounding ends them
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
    """``p = x + h v*``, then ``dp_i = -k' w_i grad_i C C / sum_j w_j |grad_j C|^2`` for each constraint C in turn, then
    ``v = (p - x)/h`` and ``x <- p`` (their sections 3.2 and 3.3).

    v* is the velocity after gravity, drag and the air.  As in ``xpbd``, velocities u stand for p: they change by dp/h.
    Arguments, shapes and units are those of ``integrators.base``.
    """
    _, rigidity, damping_time, size = elastic
    t = x.dtype.type
    iterations, stretch, bend = options
    # bends are projected as in xpbd: rigid, without damping, and by the share k'
    inverse_alpha_tilde, gamma = np.empty_like(rigidity), np.empty_like(rigidity)
    inverse_alpha_tilde[:] = RIGID
    gamma[:] = 0
    # k' of stretch and of bend
    share_stretch, share_bend = t(share_of_a_pass(stretch, iterations)), t(share_of_a_pass(bend, iterations))
    # v*; project the constraints; the new velocities and positions
    y, u = set_out(x, v, w, gravity, push, drag_rate, h, work)
    for _ in range(iterations):
        project_rigid_springs(y, u, w, elements.springs, size, h, share_stretch, share_bend)
        project_bends(y, u, w, elements.bends, h, inverse_alpha_tilde, gamma, share_bend, work.of_bends, work.scratch)
    arrive(x, v, h, work)


PBD = Integrator(
    "pbd",
    color="#8c6239",
    order=None,
    cost="one projection pass for each iteration",
    damping="not at all: the projections damp far more",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=False,
    options=MappingProxyType({"iterations": 10, "stretch": 0.9, "bend": 0.1}),
    fields=2,
    ignored=frozenset({"stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time"}),
)

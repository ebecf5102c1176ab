"""Floor 3: what resists bending: skip springs, or hinges between triangles.

A model is three kernels on one block of lanes, to which ``_jit.specialize`` binds the names ``add_bend_forces``,
``add_bend_products`` and ``project_bends`` wherever an integrator uses them:

    add_bend_forces(x, v, f, bends, rigidity, damping_time, scratch)
        adds the elements' and their dampers' forces to ``f`` [N], (particles, 3, lanes);
    add_bend_products(x, p, y, bends, scale, scratch)
        adds their stiffness matrix, without what could make it indefinite, times ``p``: ``y += scale K p``, with scale, (lanes,),
        the rigidity times whatever the caller needs;
    project_bends(x, start, w, bends, scale, damping, relaxation, multipliers, scratch)
        moves particles in place towards the elements' rest, one after the other, as extended position-based dynamics does (see
        ``integrators.xpbd``), with scale ``B h^2``, (lanes,), damping ``tau/h``, (lanes,), and the share
        ``relaxation`` of each move.  multipliers: (elements, 3, lanes),
        updated; or (0, 3, lanes), where they need no memory.

``bends`` is ``state.BendArrays``; scratch is (BEND_SCRATCH, 3, lanes), whose content does not outlive the call.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, kernel
from clothgym.mesh import ClothMesh
from clothgym.state import BendArrays

BEND_SCRATCH = 9

# arctan(z)/z by powers of z^2 for z^2 up to tan(pi/8)^2, interpolated at Chebyshev's points: error at most 8e-13
ARCTAN = (
    0.99999999999924476, -0.33333333276922492, 0.19999993053555814, -0.14285386553752139,
    0.11103456908947463, -0.089925529061509115, 0.06974197686595265, -0.037655106012914019,
)  # fmt: skip


# --- none: springs bend -------------------------------------------------------------------------------------------------


@kernel
def add_bend_forces(x, v, f, bends, rigidity, damping_time, scratch):
    """Nothing: skip springs are among the springs."""


@kernel
def add_bend_products(x, p, y, bends, scale, scratch):
    """Nothing."""


@kernel
def project_bends(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """Nothing."""


# --- quadratic: isometric bending, Bergou et al. 2006 -------------------------------------------------------------------


@kernel
def _combine(x, ends, q, out):
    """``sum_i q_i x_i`` of one element into ``out``, (3, lanes)."""
    a, b, c, d = x[ends[0]], x[ends[1]], x[ends[2]], x[ends[3]]
    qa, qb, qc, qd = q[0], q[1], q[2], q[3]
    for e in range(3):
        for l in range(x.shape[2]):
            out[e, l] = qa * a[e, l] + qb * b[e, l] + qc * c[e, l] + qd * d[e, l]


@kernel
def add_quadratic_forces(x, v, f, bends, rigidity, damping_time, scratch):
    """Of the energy ``B/2 |sum_i q_i x_i|^2``: constant curvature matrix, exact for a sheet that bends and does not stretch."""
    members, _, _, curves = bends
    curve, rate = scratch[0], scratch[1]
    for s in range(members.shape[0]):
        _combine(x, members[s], curves[s], curve)
        _combine(v, members[s], curves[s], rate)
        for e in range(3):
            for l in range(x.shape[2]):
                curve[e, l] = rigidity[l] * (curve[e, l] + damping_time[l] * rate[e, l])
        for m in range(4):
            fm = f[members[s, m]]
            q = curves[s, m]
            for e in range(3):
                for l in range(x.shape[2]):
                    fm[e, l] -= q * curve[e, l]


@kernel
def add_quadratic_products(x, p, y, bends, scale, scratch):
    """The matrix of the energy itself, which is constant."""
    members, _, _, curves = bends
    curve = scratch[0]
    for s in range(members.shape[0]):
        _combine(p, members[s], curves[s], curve)
        for m in range(4):
            ym = y[members[s, m]]
            q = curves[s, m]
            for e in range(3):
                for l in range(x.shape[2]):
                    ym[e, l] += q * scale[l] * curve[e, l]


@kernel
def project_quadratic(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """One vector of constraints an element, ``sum_i q_i x_i = 0``: linear, so a projection solves it exactly."""
    members, _, _, curves = bends
    one = x.dtype.type(1)
    curve, before, weigh = scratch[0], scratch[1], scratch[2]
    keeps = multipliers.shape[0] > 0
    for s in range(members.shape[0]):
        _combine(x, members[s], curves[s], curve)
        _combine(start, members[s], curves[s], before)
        q = curves[s]
        a, b, c, d = w[members[s, 0]], w[members[s, 1]], w[members[s, 2]], w[members[s, 3]]
        for l in range(x.shape[2]):
            mobility = q[0] * q[0] * a[l] + q[1] * q[1] * b[l] + q[2] * q[2] * c[l] + q[3] * q[3] * d[l]
            weigh[0, l] = one / (scale[l] * (one + damping[l]) * mobility + one)
        for e in range(3):
            if keeps:
                known = multipliers[s, e]
                for l in range(x.shape[2]):
                    pull = scale[l] * (curve[e, l] + damping[l] * (curve[e, l] - before[e, l]))
                    curve[e, l] = (pull - known[l]) * weigh[0, l]
                    known[l] += curve[e, l]
            else:
                for l in range(x.shape[2]):
                    pull = scale[l] * (curve[e, l] + damping[l] * (curve[e, l] - before[e, l]))
                    curve[e, l] = pull * weigh[0, l]
        for m in range(4):
            xm, wm = x[members[s, m]], w[members[s, m]]
            for e in range(3):
                for l in range(x.shape[2]):
                    xm[e, l] -= relaxation * wm[l] * q[m] * curve[e, l]


# --- hinge: the angle between triangles, Grinspun et al. 2003 -----------------------------------------------------------


@kernel
def _angle_and_slopes(x, ends, angle, slopes, rows):
    """The angle between two triangles [rad] into ``angle``, (lanes,), and its derivatives [1/m] into ``slopes``, (12, lanes).

    With e the edge, a and b the opposite corners seen from its first end, and the normals ``N = e x a`` and ``M = b x e``:
    ``tan(angle/2) = -|e| (N . b)/(|N| |M| + N . M)``.  Two more halvings bring it where a short polynomial is the arctangent.
    The derivatives are those of Bridson, Marino and Fedkiw 2003, section 4.  rows: scratch, (11, lanes).  Loops that write few rows
    vectorise: one loop for all this would take four times as long.
    """
    xi, xj, xk, xl = x[ends[0]], x[ends[1]], x[ends[2]], x[ends[3]]
    lanes = x.shape[2]
    t = x.dtype.type
    one, tiny, least = t(1), t(1e-30), t(1e-9)
    c0, c1, c2, c3 = t(ARCTAN[0]), t(ARCTAN[1]), t(ARCTAN[2]), t(ARCTAN[3])
    c4, c5, c6, c7 = t(ARCTAN[4]), t(ARCTAN[5]), t(ARCTAN[6]), t(ARCTAN[7])
    n, m = rows[0:3], rows[3:6]
    inverse, foot_k, foot_l, tilt_k, tilt_l = rows[6], rows[7], rows[8], rows[9], rows[10]
    for l in range(lanes):
        ex, ey, ez = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
        ax, ay, az = xk[0, l] - xi[0, l], xk[1, l] - xi[1, l], xk[2, l] - xi[2, l]
        n[0, l], n[1, l], n[2, l] = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
    for l in range(lanes):
        ex, ey, ez = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
        bx, by, bz = xl[0, l] - xi[0, l], xl[1, l] - xi[1, l], xl[2, l] - xi[2, l]
        m[0, l], m[1, l], m[2, l] = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
    for l in range(lanes):
        ex, ey, ez = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
        ax, ay, az = xk[0, l] - xi[0, l], xk[1, l] - xi[1, l], xk[2, l] - xi[2, l]
        inverse[l] = one / (ex * ex + ey * ey + ez * ez + tiny)
        foot_k[l] = (ax * ex + ay * ey + az * ez) * inverse[l]
    for l in range(lanes):
        ex, ey, ez = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
        bx, by, bz = xl[0, l] - xi[0, l], xl[1, l] - xi[1, l], xl[2, l] - xi[2, l]
        foot_l[l] = (bx * ex + by * ey + bz * ez) * inverse[l]
        angle[l] = bx * n[0, l] + by * n[1, l] + bz * n[2, l]
    for l in range(lanes):
        nx, ny, nz, mx, my, mz = n[0, l], n[1, l], n[2, l], m[0, l], m[1, l], m[2, l]
        n2, m2 = nx * nx + ny * ny + nz * nz + tiny, mx * mx + my * my + mz * mz + tiny
        length = one / np.sqrt(inverse[l])
        product = np.sqrt(n2) * np.sqrt(m2)
        below, lowest = product + (nx * mx + ny * my + nz * mz), least * product
        half = -length * angle[l] / (below if below > lowest else lowest)
        quarter = half / (one + np.sqrt(one + half * half))
        z = quarter / (one + np.sqrt(one + quarter * quarter))
        u = z * z
        series = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * (c6 + u * c7))))))
        angle[l] = t(8) * z * series
        tilt_k[l], tilt_l[l] = -length / n2, -length / m2
    for c in range(3):
        near, far, of_k, of_l, nc, mc = slopes[c], slopes[3 + c], slopes[6 + c], slopes[9 + c], n[c], m[c]
        for l in range(lanes):
            of_k[l] = tilt_k[l] * nc[l]
        for l in range(lanes):
            of_l[l] = tilt_l[l] * mc[l]
        for l in range(lanes):
            near[l] = (foot_k[l] - one) * of_k[l] + (foot_l[l] - one) * of_l[l]
        for l in range(lanes):
            far[l] = -foot_k[l] * of_k[l] - foot_l[l] * of_l[l]


@kernel
def _rate(p, ends, slopes, out):
    """Derivative of the angle along ``p``, (lanes,)."""
    out[:] = 0
    for m in range(4):
        pm, s = p[ends[m]], slopes[3 * m : 3 * m + 3]
        for l in range(p.shape[2]):
            out[l] += s[0, l] * pm[0, l] + s[1, l] * pm[1, l] + s[2, l] * pm[2, l]


@kernel
def _hinge_rows(scratch):
    """Rows of scratch that a hinge's kernels use: angle, rate, derivatives, geometry, and two more, (., lanes)."""
    rows = scratch.reshape((3 * scratch.shape[0], scratch.shape[2]))
    return rows[0], rows[1], rows[2:14], rows[14:25], rows[25], rows[26]


@apart
def add_hinge_forces(x, v, f, bends, rigidity, damping_time, scratch):
    """Of the energy ``B/2 weight (angle - rest angle)^2``."""
    members, weight, rest_angle, _ = bends
    angle, rate, slopes, geometry, _, _ = _hinge_rows(scratch)
    for s in range(members.shape[0]):
        _angle_and_slopes(x, members[s], angle, slopes, geometry)
        _rate(v, members[s], slopes, rate)
        share, rest = weight[s], rest_angle[s]
        for l in range(x.shape[2]):
            angle[l] = share * rigidity[l] * (angle[l] - rest + damping_time[l] * rate[l])
        for m in range(4):
            fm = f[members[s, m]]
            for e in range(3):
                for l in range(x.shape[2]):
                    fm[e, l] -= slopes[3 * m + e, l] * angle[l]


@apart
def add_hinge_products(x, p, y, bends, scale, scratch):
    """The part of the energy's matrix that is never negative: the derivatives' outer product (Gauss and Newton)."""
    members, weight, _, _ = bends
    angle, rate, slopes, geometry, _, _ = _hinge_rows(scratch)
    for s in range(members.shape[0]):
        _angle_and_slopes(x, members[s], angle, slopes, geometry)
        _rate(p, members[s], slopes, rate)
        share = weight[s]
        for l in range(x.shape[2]):
            rate[l] *= share * scale[l]
        for m in range(4):
            ym = y[members[s, m]]
            for e in range(3):
                for l in range(x.shape[2]):
                    ym[e, l] += rate[l] * slopes[3 * m + e, l]


@kernel
def project_hinges(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """The constraint ``angle = rest angle``; the damper sees what has been done along its derivative in the substep."""
    members, weight, rest_angle, _ = bends
    one = x.dtype.type(1)
    angle, rate, slopes, geometry, before, mobility = _hinge_rows(scratch)
    keeps = multipliers.shape[0] > 0
    for s in range(members.shape[0]):
        _angle_and_slopes(x, members[s], angle, slopes, geometry)
        _rate(x, members[s], slopes, rate)
        _rate(start, members[s], slopes, before)
        mobility[:] = 0
        for m in range(4):
            wm = w[members[s, m]]
            for e in range(3):
                for l in range(x.shape[2]):
                    mobility[l] += wm[l] * slopes[3 * m + e, l] * slopes[3 * m + e, l]
        share, rest = weight[s], rest_angle[s]
        for l in range(x.shape[2]):
            k = share * scale[l]
            pull = k * (angle[l] - rest + damping[l] * (rate[l] - before[l]))
            known = multipliers[s, 0, l] if keeps else x.dtype.type(0)
            angle[l] = (pull - known) / (k * (one + damping[l]) * mobility[l] + one)
        if keeps:
            for l in range(x.shape[2]):
                multipliers[s, 0, l] += angle[l]
        for m in range(4):
            xm, wm = x[members[s, m]], w[members[s, m]]
            for e in range(3):
                for l in range(x.shape[2]):
                    xm[e, l] -= relaxation * wm[l] * slopes[3 * m + e, l] * angle[l]


# --- the table ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bending:
    """A model of bending.

    Attributes:
        name: its key in the table.
        hinged: whether hinges resist bending; else skip springs do.
        isotropic: whether they resist displacements along the sheet as they do those across it, as they know no normal.
        kernels: by the names that integrators call them by.
    """

    name: str
    hinged: bool
    isotropic: bool
    kernels: dict[str, Any]

    def energy(self, bends: BendArrays, x: NDArray, rigidity: NDArray) -> NDArray:
        """Energy of the hinges [J], (num_envs,); x [m], (num_envs, particles, 3); rigidity [N m], (num_envs,)."""
        corners = x[:, bends.particles]
        if self.name == "quadratic":
            return rigidity / 2 * np.sum(np.einsum("sm,esmc->esc", bends.curves, corners) ** 2, axis=(1, 2))
        e, a, b = (corners[:, :, m] - corners[:, :, 0] for m in (1, 2, 3))
        one, two = np.cross(e, a), np.cross(b, e)
        angle = np.arctan2(-np.linalg.norm(e, axis=2) * np.sum(one * b, axis=2), np.sum(one * two, axis=2))
        return rigidity / 2 * np.sum(bends.weight * (angle - bends.rest_angle) ** 2, axis=1)


def _kernels(forces: Any, products: Any, project: Any) -> dict[str, Any]:
    return {"add_bend_forces": forces, "add_bend_products": products, "project_bends": project}


BENDING: dict[str, Bending] = {
    model.name: model
    for model in (
        Bending("springs", False, False, _kernels(add_bend_forces, add_bend_products, project_bends)),
        Bending("hinge", True, False, _kernels(add_hinge_forces, add_hinge_products, project_hinges)),
        Bending("quadratic", True, True, _kernels(add_quadratic_forces, add_quadratic_products, project_quadratic)),
    )
}


def model_of(name: str, mesh: ClothMesh) -> Bending:
    """The model of that name, for a mesh.

    Raises:
        ValueError: no such name; the message lists the right ones.  Or a model that cannot hold this mesh.
    """
    if not isinstance(name, str) or name not in BENDING:
        near = difflib.get_close_matches(str(name), BENDING, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"no bending model {name!r}{hint} (there are: {', '.join(BENDING)})")
    if name == "quadratic" and mesh.hinges.rest_angle.any():
        steepest = float(np.abs(mesh.hinges.rest_angle).max())
        raise ValueError(
            f"bending='quadratic' needs a sheet that is flat at rest, this one has angles up to {steepest:.3g} rad: take "
            "bending='hinge'"
        )
    return BENDING[name]

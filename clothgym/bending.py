"""Floor 3: what resists bending: skip springs, or hinges between triangles.

A model is three kernels on one block of lanes, to which ``_jit.specialize`` binds the names of the placeholders
below wherever an integrator uses them:

    add_bend_forces(x, v, f, elements, elastic, scratch)
        adds the hinges' and their dampers' forces to ``f`` [N], (3, particles, lanes);
    add_bend_products(x, p, y, elements, scale, scratch)
        adds their stiffness matrix, without what could make it indefinite, times ``p``: ``y += scale K p``, with scale, (lanes,),
        the rigidity times whatever the caller needs;
    project_bends(x, start, w, bends, scale, damping, relaxation, multipliers, scratch)
        moves particles in place towards the hinges' rest, one after the other, as extended position-based dynamics does (see
        ``integrators.xpbd``), with scale ``B h^2``, (lanes,), damping ``tau/h``, (lanes,), and the share ``relaxation`` of each
        move.  multipliers: (hinges, 3, lanes), updated; or (0, 3, lanes), where they need no memory.

``elements``, ``elastic``, ``scratch`` and ``bends`` are those of ``elements``.  For a grid whose particles lie side by side, the
same forces are in ``grid_forces``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, inlined, kernel, placeholder, uncounted
from clothgym.checks import known
from clothgym.elements import ROWS, BendArrays
from clothgym.mesh import ClothMesh

# arctan(z)/z by powers of z^2 for z^2 up to tan(pi/8)^2, interpolated at Chebyshev's points: error at most 8e-13
ARCTAN = (
    0.99999999999924476, -0.33333333276922492, 0.19999993053555814, -0.14285386553752139,
    0.11103456908947463, -0.089925529061509115, 0.06974197686595265, -0.037655106012914019,
)  # fmt: skip

add_bend_forces = placeholder(
    "add_bend_forces", "of (x, v, f, elements, elastic, scratch): adds the hinges' and their dampers' forces to f [N]"
)
add_bend_products = placeholder(
    "add_bend_products", "of (x, p, y, elements, scale, scratch): adds the hinges' stiffness matrix times p to y"
)
project_bends = placeholder(
    "project_bends",
    "of (x, start, w, bends, scale, damping, relaxation, multipliers, scratch): moves particles towards the hinges' rest",
)


# --- none: springs bend -------------------------------------------------------------------------------------------------


@kernel
def add_no_forces(x, v, f, elements, elastic, scratch):
    """Nothing: skip springs are among the springs."""


@kernel
def add_no_products(x, p, y, elements, scale, scratch):
    """Nothing."""


@kernel
def project_nothing(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """Nothing."""


# --- quadratic: isometric bending, Bergou et al. 2006 -------------------------------------------------------------------


@disjoint
def _combine(a, b, c, d, q, out):
    """One component of ``sum_i q_i x_i`` of one hinge, (lanes,)."""
    qa, qb, qc, qd = q[0], q[1], q[2], q[3]
    for l in range(out.shape[0]):
        out[l] = qa * a[l] + qb * b[l] + qc * c[l] + qd * d[l]


@uncounted
def add_quadratic_forces(x, v, f, elements, elastic, scratch):
    """Of the energy ``B/2 |sum_i q_i x_i|^2``: constant curvature matrix, exact for a sheet that bends and does not stretch."""
    members, curves = elements.bends.particles, elements.bends.curves
    rigidity, damping_time, rows = elastic.rigidity, elastic.damping_time, scratch.rows
    curve, rate = rows[0], rows[1]
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        for c in range(3):
            xc, vc, fc = x[c], v[c], f[c]
            _combine(xc[i], xc[j], xc[k], xc[m], curves[s], curve)
            _combine(vc[i], vc[j], vc[k], vc[m], curves[s], rate)
            for l in range(x.shape[2]):
                curve[l] = rigidity[l] * (curve[l] + damping_time[l] * rate[l])
            for a in range(4):
                own, q = fc[members[s, a]], curves[s, a]
                for l in range(x.shape[2]):
                    own[l] -= q * curve[l]


@uncounted
def add_quadratic_products(x, p, y, elements, scale, scratch):
    """The matrix of the energy itself, which is constant."""
    members, curves = elements.bends.particles, elements.bends.curves
    curve = scratch.rows[0]
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        for c in range(3):
            pc, yc = p[c], y[c]
            _combine(pc[i], pc[j], pc[k], pc[m], curves[s], curve)
            for a in range(4):
                own, q = yc[members[s, a]], curves[s, a]
                for l in range(x.shape[2]):
                    own[l] += q * scale[l] * curve[l]


@kernel
def project_quadratic(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """One vector of constraints an element, ``sum_i q_i x_i = 0``: linear, so a projection solves it exactly."""
    members, _, _, curves = bends
    one = x.dtype.type(1)
    curve, before, weigh = scratch.rows[0], scratch.rows[1], scratch.rows[2]
    keeps = multipliers.shape[0] > 0
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        q = curves[s]
        a, b, c, d = w[i], w[j], w[k], w[m]
        for l in range(x.shape[2]):
            mobility = q[0] * q[0] * a[l] + q[1] * q[1] * b[l] + q[2] * q[2] * c[l] + q[3] * q[3] * d[l]
            weigh[l] = one / (scale[l] * (one + damping[l]) * mobility + one)
        for e in range(3):
            xe, se = x[e], start[e]
            _combine(xe[i], xe[j], xe[k], xe[m], q, curve)
            _combine(se[i], se[j], se[k], se[m], q, before)
            if keeps:
                known = multipliers[s, e]
                for l in range(x.shape[2]):
                    pull = scale[l] * (curve[l] + damping[l] * (curve[l] - before[l]))
                    curve[l] = (pull - known[l]) * weigh[l]
                    known[l] += curve[l]
            else:
                for l in range(x.shape[2]):
                    pull = scale[l] * (curve[l] + damping[l] * (curve[l] - before[l]))
                    curve[l] = pull * weigh[l]
            for n in range(4):
                xn, wn = xe[members[s, n]], w[members[s, n]]
                for l in range(x.shape[2]):
                    xn[l] -= relaxation * wn[l] * q[n] * curve[l]


# --- hinge: the angle between triangles, Grinspun et al. 2003 -----------------------------------------------------------


@disjoint
def _first_normal(ix, iy, iz, jx, jy, jz, kx, ky, kz, nx, ny, nz, length, inverse, foot):
    """The normal ``N = e x a`` of the triangle over edge e with the corner a, ``|e|``, ``1/|e|^2``, and where a's foot is on the
    edge."""
    one, tiny = inverse.dtype.type(1), inverse.dtype.type(1e-30)
    for l in range(inverse.shape[0]):
        ex, ey, ez = jx[l] - ix[l], jy[l] - iy[l], jz[l] - iz[l]
        ax, ay, az = kx[l] - ix[l], ky[l] - iy[l], kz[l] - iz[l]
        nx[l], ny[l], nz[l] = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
        square = ex * ex + ey * ey + ez * ez + tiny
        length[l], inverse[l] = np.sqrt(square), one / square
        foot[l] = (ax * ex + ay * ey + az * ez) * inverse[l]


@disjoint
def _second_normal(ix, iy, iz, jx, jy, jz, kx, ky, kz, nx, ny, nz, inverse, mx, my, mz, foot, lift):
    """The same of the other triangle, ``M = b x e``, and how far its corner b rises over the first one, ``N . b``."""
    for l in range(foot.shape[0]):
        ex, ey, ez = jx[l] - ix[l], jy[l] - iy[l], jz[l] - iz[l]
        bx, by, bz = kx[l] - ix[l], ky[l] - iy[l], kz[l] - iz[l]
        mx[l], my[l], mz[l] = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
        foot[l] = (bx * ex + by * ey + bz * ez) * inverse[l]
        lift[l] = bx * nx[l] + by * ny[l] + bz * nz[l]


@disjoint
def _angles(nx, ny, nz, mx, my, mz, angle, tilt_k, tilt_l):
    """Turn ``N . b`` into the angle, and find what a corner's rise tilts its triangle by, over the normal.

    tilt_k: comes with the edge's length [m].
    """
    t = angle.dtype.type
    one, tiny, least = t(1), t(1e-30), t(1e-9)
    c0, c1, c2, c3 = t(ARCTAN[0]), t(ARCTAN[1]), t(ARCTAN[2]), t(ARCTAN[3])
    c4, c5, c6, c7 = t(ARCTAN[4]), t(ARCTAN[5]), t(ARCTAN[6]), t(ARCTAN[7])
    for l in range(angle.shape[0]):
        nn = nx[l] * nx[l] + ny[l] * ny[l] + nz[l] * nz[l] + tiny
        mm = mx[l] * mx[l] + my[l] * my[l] + mz[l] * mz[l] + tiny
        length = tilt_k[l]
        product = np.sqrt(nn) * np.sqrt(mm)
        below, lowest = product + (nx[l] * mx[l] + ny[l] * my[l] + nz[l] * mz[l]), least * product
        half = -length * angle[l] / (below if below > lowest else lowest)
        quarter = half / (one + np.sqrt(one + half * half))
        z = quarter / (one + np.sqrt(one + quarter * quarter))
        u = z * z
        series = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * (c6 + u * c7))))))
        angle[l] = t(8) * z * series
        tilt_k[l], tilt_l[l] = -length / nn, -length / mm


@disjoint
def _slopes(n, m, foot_k, foot_l, tilt_k, tilt_l, near, far, of_k, of_l):
    """One component of the angle's derivatives with respect to both ends of the edge and to both corners."""
    one = near.dtype.type(1)
    for l in range(near.shape[0]):
        k, o = tilt_k[l] * n[l], tilt_l[l] * m[l]
        of_k[l], of_l[l] = k, o
        near[l] = (foot_k[l] - one) * k + (foot_l[l] - one) * o
        far[l] = -foot_k[l] * k - foot_l[l] * o


@inlined
def hinge_angles(xi, xj, xk, xm, angle, slopes, rows):
    """The angle between two triangles [rad] into ``angle``, (lanes,), and its derivatives [1/m] into ``slopes``, (12, lanes).

    With e the edge, a and b the opposite corners seen from its first end, and the normals ``N = e x a`` and ``M = b x e``:
    ``tan(angle/2) = -|e| (N . b)/(|N| |M| + N . M)``.  Two more halvings bring it where a short polynomial is the arctangent.
    The derivatives are those of Bridson, Marino and Fedkiw 2003, section 4.  Corners: three components each, (lanes,), or
    (hinges,) where these lie side by side.  rows: scratch, (11, lanes).
    """
    nx, ny, nz, mx, my, mz = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    inverse, foot_k, foot_l, tilt_k, tilt_l = rows[6], rows[7], rows[8], rows[9], rows[10]
    _first_normal(xi[0], xi[1], xi[2], xj[0], xj[1], xj[2], xk[0], xk[1], xk[2], nx, ny, nz, tilt_k, inverse, foot_k)
    _second_normal(
        xi[0], xi[1], xi[2], xj[0], xj[1], xj[2], xm[0], xm[1], xm[2], nx, ny, nz, inverse, mx, my, mz, foot_l, angle
    )  # fmt: skip
    _angles(nx, ny, nz, mx, my, mz, angle, tilt_k, tilt_l)
    for c in range(3):
        _slopes(rows[c], rows[3 + c], foot_k, foot_l, tilt_k, tilt_l, slopes[c], slopes[3 + c], slopes[6 + c], slopes[9 + c])


@disjoint
def _rates(ix, iy, iz, jx, jy, jz, kx, ky, kz, mx, my, mz, s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, out):
    for l in range(out.shape[0]):
        ends = (s0[l] * ix[l] + s1[l] * iy[l] + s2[l] * iz[l]) + (s3[l] * jx[l] + s4[l] * jy[l] + s5[l] * jz[l])
        out[l] = (ends + (s6[l] * kx[l] + s7[l] * ky[l] + s8[l] * kz[l])) + (s9[l] * mx[l] + s10[l] * my[l] + s11[l] * mz[l])


@inlined
def hinge_rates(pi, pj, pk, pm, s, out):
    """Derivative of the angle along ``p``, (lanes,), with the slopes s; corners as for ``hinge_angles``."""
    _rates(
        pi[0], pi[1], pi[2], pj[0], pj[1], pj[2], pk[0], pk[1], pk[2], pm[0], pm[1], pm[2], s[0], s[1], s[2], s[3], s[4], s[5],
        s[6], s[7], s[8], s[9], s[10], s[11], out,
    )  # fmt: skip


@inlined
def hinge_rows(scratch, lanes):
    """Rows that a hinge's kernels use, of ``Scratch.rows``: angle, rate, derivatives, geometry and two more, (., lanes)."""
    rows = scratch.reshape(scratch.size)[: ROWS * lanes].reshape((ROWS, lanes))
    return rows[0], rows[1], rows[2:14], rows[14:25], rows[25], rows[26]


@inlined
def _at(x, p):
    """Components of one particle's vectors, (lanes,) each."""
    return x[0, p], x[1, p], x[2, p]


@uncounted
def add_hinge_forces(x, v, f, elements, elastic, scratch):
    """Of the energy ``B/2 weight (angle - rest angle)^2``."""
    members, weight, rest_angle, _ = elements.bends
    rigidity, damping_time = elastic.rigidity, elastic.damping_time
    angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, x.shape[2])
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        hinge_angles(_at(x, i), _at(x, j), _at(x, k), _at(x, m), angle, slopes, geometry)
        hinge_rates(_at(v, i), _at(v, j), _at(v, k), _at(v, m), slopes, rate)
        share, rest = weight[s], rest_angle[s]
        for l in range(x.shape[2]):
            angle[l] = share * rigidity[l] * (angle[l] - rest + damping_time[l] * rate[l])
        for corner in range(4):
            for e in range(3):
                fe, slope = f[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    fe[l] -= slope[l] * angle[l]


@uncounted
def add_hinge_products(x, p, y, elements, scale, scratch):
    """The part of the energy's matrix that is never negative: the derivatives' outer product (Gauss and Newton)."""
    members, weight, _, _ = elements.bends
    angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, x.shape[2])
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        hinge_angles(_at(x, i), _at(x, j), _at(x, k), _at(x, m), angle, slopes, geometry)
        hinge_rates(_at(p, i), _at(p, j), _at(p, k), _at(p, m), slopes, rate)
        share = weight[s]
        for l in range(x.shape[2]):
            rate[l] *= share * scale[l]
        for corner in range(4):
            for e in range(3):
                ye, slope = y[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    ye[l] += rate[l] * slope[l]


@kernel
def project_hinges(x, start, w, bends, scale, damping, relaxation, multipliers, scratch):
    """The constraint ``angle = rest angle``; the damper sees what has been done along its derivative in the substep."""
    members, weight, rest_angle, _ = bends
    one = x.dtype.type(1)
    angle, rate, slopes, geometry, before, mobility = hinge_rows(scratch.rows, x.shape[2])
    keeps = multipliers.shape[0] > 0
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        hinge_angles(_at(x, i), _at(x, j), _at(x, k), _at(x, m), angle, slopes, geometry)
        hinge_rates(_at(x, i), _at(x, j), _at(x, k), _at(x, m), slopes, rate)
        hinge_rates(_at(start, i), _at(start, j), _at(start, k), _at(start, m), slopes, before)
        mobility[:] = 0
        for corner in range(4):
            wm = w[members[s, corner]]
            for e in range(3):
                slope = slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    mobility[l] += wm[l] * slope[l] * slope[l]
        share, rest = weight[s], rest_angle[s]
        for l in range(x.shape[2]):
            stiff = share * scale[l]
            pull = stiff * (angle[l] - rest + damping[l] * (rate[l] - before[l]))
            known = multipliers[s, 0, l] if keeps else x.dtype.type(0)
            angle[l] = (pull - known) / (stiff * (one + damping[l]) * mobility[l] + one)
        if keeps:
            for l in range(x.shape[2]):
                multipliers[s, 0, l] += angle[l]
        for corner in range(4):
            wm = w[members[s, corner]]
            for e in range(3):
                xe, slope = x[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    xe[l] -= relaxation * wm[l] * slope[l] * angle[l]


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
        Bending("springs", False, False, _kernels(add_no_forces, add_no_products, project_nothing)),
        Bending("hinge", True, False, _kernels(add_hinge_forces, add_hinge_products, project_hinges)),
        Bending("quadratic", True, True, _kernels(add_quadratic_forces, add_quadratic_products, project_quadratic)),
    )
}


def model_of(name: str, mesh: ClothMesh) -> Bending:
    """The model of that name, for a mesh.

    Raises:
        ValueError: no such name; the message lists the right ones.  Or a model that cannot hold this mesh.
    """
    known("bending model", name, BENDING)
    if name == "quadratic" and mesh.hinges.rest_angle.any():
        steepest = float(np.abs(mesh.hinges.rest_angle).max())
        raise ValueError(
            f"bending='quadratic' needs a sheet that is flat at rest, this one has angles up to {steepest:.3g} rad: take "
            "bending='hinge'"
        )
    return BENDING[name]

"""Floor 3: models of bending: skip springs, the quadratic model, and hinges between triangles.

A model is three kernels on one block of lanes.  Where an integrator calls the placeholders below, ``_jit.specialize`` binds those
of the chosen model:

    add_bend_forces(x, v, f, elements, elastic, scratch)
        adds the forces of hinges and of their dampers to ``f`` [N], (3, particles, lanes).
    add_bend_products(x, p, y, elements, scale, scratch)
        ``y <- y + scale K p``, with K their stiffness matrix for a rigidity of 1, without the part that could make it indefinite.
        scale: the rigidity times a factor of the caller's, (lanes,).  p, y: (3, particles, lanes).
    project_bends(y, u, w, bends, h, inverse_alpha_tilde, gamma, relaxation, lam, scratch)
        one Gauss-Seidel pass of extended position-based dynamics over the hinges, which changes velocities u; the equations, y and
        u are those of ``integrators.xpbd``.  inverse_alpha_tilde: ``1/alpha~ = B h^2``, (lanes,).  gamma: ``tau/h``, (lanes,).
        relaxation: share of each correction that is applied.  lam: the multipliers, (hinges, 3, lanes), updated; or (0, 3, lanes)
        for a single pass, which needs none.

In all of them x [m] and v [m/s] are (3, particles, lanes), and w [1/kg] is (particles, lanes).  ``elements``, ``elastic``,
``scratch`` and ``bends`` are those of ``elements``.  Where particles are adjacent in memory the same forces are in ``grid_forces``,
for a grid, and in ``sheet_forces``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, inlined, kernel, placeholder, uncounted
from clothgym.checks import known
from clothgym.elements import WORK_ROWS, BendArrays
from clothgym.mesh import ClothMesh

# arctan(z)/z in powers of z^2, for z^2 up to tan(pi/8)^2, interpolated at Chebyshev points: error at most 8e-13
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
    "of (y, u, w, bends, h, inverse_alpha_tilde, gamma, relaxation, lam, scratch): changes velocities towards the hinges' rest",
)


# --- springs: skip springs resist bending, and are among the springs --------------------------------------------------------


@kernel
def add_no_forces(x, v, f, elements, elastic, scratch):
    """Adds nothing: skip springs are among the springs."""


@kernel
def add_no_products(x, p, y, elements, scale, scratch):
    """Adds nothing."""


@kernel
def project_nothing(y, u, w, bends, h, inverse_alpha_tilde, gamma, relaxation, lam, scratch):
    """Changes nothing."""


# --- quadratic: isometric bending, Bergou et al. 2006 -------------------------------------------------------------------


@disjoint
def _combine(a, b, c, d, q, out):
    """``out <- sum_i q_i x_i`` for one hinge: one component a, b, c, d of its four particles, (lanes,); q: (4,)."""
    qa, qb, qc, qd = q[0], q[1], q[2], q[3]
    for l in range(out.shape[0]):
        out[l] = qa * a[l] + qb * b[l] + qc * c[l] + qd * d[l]


@uncounted
def add_quadratic_forces(x, v, f, elements, elastic, scratch):
    """``f_i <- f_i - B q_i sum_j q_j (x_j + tau v_j)`` for each hinge.

    It is minus the gradient of ``B/2 |sum_i q_i x_i|^2``, and a damper of the same form.  The matrix ``B q q^T`` is constant.  The
    model is exact for a sheet that bends without stretching.
    """
    members, curves = elements.bends.particles, elements.bends.curves
    rigidity, damping_time, lanes = elastic.rigidity, elastic.damping_time, x.shape[2]
    curve, rate = scratch.rows[0, :lanes], scratch.rows[1, :lanes]
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        for c in range(3):
            # the hinge's curvature vector and its rate, one component
            xc, vc, fc = x[c], v[c], f[c]
            _combine(xc[i], xc[j], xc[k], xc[m], curves[s], curve)
            _combine(vc[i], vc[j], vc[k], vc[m], curves[s], rate)
            for l in range(x.shape[2]):
                curve[l] = rigidity[l] * (curve[l] + damping_time[l] * rate[l])
            # the force on each of its particles
            for a in range(4):
                own, q = fc[members[s, a]], curves[s, a]
                for l in range(x.shape[2]):
                    own[l] -= q * curve[l]


@uncounted
def add_quadratic_products(x, p, y, elements, scale, scratch):
    """``y_i <- y_i + scale q_i sum_j q_j p_j`` for each hinge: the energy's matrix is constant, and never indefinite."""
    members, curves = elements.bends.particles, elements.bends.curves
    curve = scratch.rows[0, : x.shape[2]]
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
def project_quadratic(y, u, w, bends, h, inverse_alpha_tilde, gamma, relaxation, lam, scratch):
    """One pass over the hinges with the constraint ``C = sum_i q_i x_i``, a vector: ``grad_i C = q_i`` in each component.

    C is linear, so one projection solves it exactly.  Equations as in ``integrators.xpbd``, over alpha~ and h, with its signs.
    """
    members, _, _, curves = bends
    one, zero = y.dtype.type(1), y.dtype.type(0)
    lanes = y.shape[2]
    curve, rate, inverse = scratch.rows[0, :lanes], scratch.rows[1, :lanes], scratch.rows[2, :lanes]
    keeps = lam.shape[0] > 0
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        q = curves[s]
        a, b, c, d = w[i], w[j], w[k], w[m]
        # one over the denominator, the same for all components; mobility: sum_i w_i |grad_i C|^2
        for l in range(y.shape[2]):
            mobility = q[0] * q[0] * a[l] + q[1] * q[1] * b[l] + q[2] * q[2] * c[l] + q[3] * q[3] * d[l]
            inverse[l] = one / (inverse_alpha_tilde[l] * (one + gamma[l]) * mobility + one)
        for e in range(3):
            # C/h at the start of the substep, and how it has changed
            ye, ue = y[e], u[e]
            _combine(ye[i], ye[j], ye[k], ye[m], q, curve)
            _combine(ue[i], ue[j], ue[k], ue[m], q, rate)
            # delta lambda, in place of C
            for l in range(y.shape[2]):
                error = inverse_alpha_tilde[l] * (curve[l] + (one + gamma[l]) * rate[l])
                curve[l] = (error - (lam[s, e, l] if keeps else zero)) * inverse[l]
            if keeps:
                for l in range(y.shape[2]):
                    lam[s, e, l] += curve[l]
            # u_i <- u_i + w_i grad_i C delta lambda
            for n in range(4):
                un, wn = ue[members[s, n]], w[members[s, n]]
                for l in range(y.shape[2]):
                    un[l] -= relaxation * wn[l] * q[n] * curve[l]


# --- hinge: the angle between triangles, Grinspun et al. 2003 -----------------------------------------------------------


@disjoint
def _first_normal(ix, iy, iz, jx, jy, jz, kx, ky, kz, nx, ny, nz, length, inverse, foot):
    """Geometry of the first triangle (i, j, k), with the edge ``e = x_j - x_i`` and ``a = x_k - x_i``; all arrays (lanes,).

    nx, ny, nz: the normal ``N = e x a``.  length: ``|e|``.  inverse: ``1/|e|^2``.  foot: ``a . e/|e|^2``, the foot of k's height.
    """
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
    """Geometry of the second triangle (j, i, k), whose corner is ``b = x_k - x_i``; all arrays (lanes,).

    mx, my, mz: the normal ``M = b x e``.  foot: ``b . e/|e|^2``.  lift: ``N . b``, positive if b is above the first triangle.
    """
    for l in range(foot.shape[0]):
        ex, ey, ez = jx[l] - ix[l], jy[l] - iy[l], jz[l] - iz[l]
        bx, by, bz = kx[l] - ix[l], ky[l] - iy[l], kz[l] - iz[l]
        mx[l], my[l], mz[l] = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
        foot[l] = (bx * ex + by * ey + bz * ez) * inverse[l]
        lift[l] = bx * nx[l] + by * ny[l] + bz * nz[l]


@disjoint
def _angles(nx, ny, nz, mx, my, mz, angle, tilt_k, tilt_l):
    """The angle [rad] from ``N . b``, and the factors ``-|e|/|N|^2`` and ``-|e|/|M|^2`` of its derivatives; all arrays (lanes,).

    angle: on entry ``N . b``.  tilt_k: on entry ``|e|``, then the first factor.  tilt_l: the second factor.
    """
    t = angle.dtype.type
    one, tiny, least = t(1), t(1e-30), t(1e-9)
    c0, c1, c2, c3 = t(ARCTAN[0]), t(ARCTAN[1]), t(ARCTAN[2]), t(ARCTAN[3])
    c4, c5, c6, c7 = t(ARCTAN[4]), t(ARCTAN[5]), t(ARCTAN[6]), t(ARCTAN[7])
    for l in range(angle.shape[0]):
        nn = nx[l] * nx[l] + ny[l] * ny[l] + nz[l] * nz[l] + tiny
        mm = mx[l] * mx[l] + my[l] * my[l] + mz[l] * mz[l] + tiny
        length = tilt_k[l]
        # tan(angle/2); the denominator is bounded from below for sheets that are folded flat
        product = np.sqrt(nn) * np.sqrt(mm)
        below, lowest = product + (nx[l] * mx[l] + ny[l] * my[l] + nz[l] * mz[l]), least * product
        half = -length * angle[l] / (below if below > lowest else lowest)
        # tan(angle/4) and tan(angle/8), and the polynomial for the arctangent
        quarter = half / (one + np.sqrt(one + half * half))
        z = quarter / (one + np.sqrt(one + quarter * quarter))
        u = z * z
        series = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * (c6 + u * c7))))))
        angle[l] = t(8) * z * series
        tilt_k[l], tilt_l[l] = -length / nn, -length / mm


@disjoint
def _slopes(n, m, foot_k, foot_l, tilt_k, tilt_l, near, far, of_k, of_l):
    """One component of the angle's derivatives [1/m] with respect to the ends of the edge and to both corners; all (lanes,).

    n, m: of N and M.  near, far: with respect to i and j.  of_k, of_l: with respect to the first and the second corner.
    """
    one = near.dtype.type(1)
    for l in range(near.shape[0]):
        k, o = tilt_k[l] * n[l], tilt_l[l] * m[l]
        of_k[l], of_l[l] = k, o
        near[l] = (foot_k[l] - one) * k + (foot_l[l] - one) * o
        far[l] = -foot_k[l] * k - foot_l[l] * o


@inlined
def hinge_angles(xi, xj, xk, xm, angle, slopes, rows):
    """The angle between two triangles [rad] into ``angle``, (lanes,), and its derivatives [1/m] into ``slopes``, (12, lanes).

    Let e be the edge, a and b the vectors from its first end to the opposite corners, ``N = e x a`` and ``M = b x e`` the normals.
    Then ``tan(angle/2) = -|e| (N . b)/(|N| |M| + N . M)``.  The angle is halved twice more; there a short polynomial replaces
    the arctangent.  The derivatives are those of Bridson, Marino and Fedkiw 2003, section 4.

    xi, xj: ends of the edge; xk, xm: opposite corners; three components each, (lanes,), or (hinges,) where hinges are adjacent in
    memory.  rows: scratch, (11, lanes).
    """
    # names for the scratch
    nx, ny, nz, mx, my, mz = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    inverse, foot_k, foot_l, tilt_k, tilt_l = rows[6], rows[7], rows[8], rows[9], rows[10]
    # both triangles; tilt_k carries |e|, and angle carries N . b, into ``_angles``
    _first_normal(xi[0], xi[1], xi[2], xj[0], xj[1], xj[2], xk[0], xk[1], xk[2], nx, ny, nz, tilt_k, inverse, foot_k)
    _second_normal(
        xi[0], xi[1], xi[2], xj[0], xj[1], xj[2], xm[0], xm[1], xm[2], nx, ny, nz, inverse, mx, my, mz, foot_l, angle
    )  # fmt: skip
    # the angle, and its derivatives component by component
    _angles(nx, ny, nz, mx, my, mz, angle, tilt_k, tilt_l)
    for c in range(3):
        _slopes(rows[c], rows[3 + c], foot_k, foot_l, tilt_k, tilt_l, slopes[c], slopes[3 + c], slopes[6 + c], slopes[9 + c])


@disjoint
def _rates(ix, iy, iz, jx, jy, jz, kx, ky, kz, mx, my, mz, s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, out):
    """``hinge_rates`` on components, (lanes,) each."""
    for l in range(out.shape[0]):
        ends = (s0[l] * ix[l] + s1[l] * iy[l] + s2[l] * iz[l]) + (s3[l] * jx[l] + s4[l] * jy[l] + s5[l] * jz[l])
        out[l] = (ends + (s6[l] * kx[l] + s7[l] * ky[l] + s8[l] * kz[l])) + (s9[l] * mx[l] + s10[l] * my[l] + s11[l] * mz[l])


@inlined
def hinge_rates(pi, pj, pk, pm, s, out):
    """``out <- sum_i (d angle/d x_i) . p_i``, (lanes,), with the slopes s, (12, lanes); pi ... pm as in ``hinge_angles``."""
    _rates(
        pi[0], pi[1], pi[2], pj[0], pj[1], pj[2], pk[0], pk[1], pk[2], pm[0], pm[1], pm[2], s[0], s[1], s[2], s[3], s[4], s[5],
        s[6], s[7], s[8], s[9], s[10], s[11], out,
    )  # fmt: skip


@inlined
def hinge_rows(scratch, lanes):
    """Parts of ``Scratch.rows`` for hinges: angle, rate, slopes (12, lanes), geometry (11, lanes), a row, corners (12, lanes)."""
    rows = scratch.reshape(scratch.size)[: WORK_ROWS * lanes].reshape((WORK_ROWS, lanes))
    return rows[0], rows[1], rows[2:14], rows[14:25], rows[25], rows[26:38]


@inlined
def _at(x, p):
    """The three components of particle p, (lanes,) each; x: (3, particles, lanes)."""
    return x[0, p], x[1, p], x[2, p]


@uncounted
def add_hinge_forces(x, v, f, elements, elastic, scratch):
    """``f_i <- f_i - B s (theta - theta_0 + tau dtheta/dt) grad_i theta`` for each hinge of angle theta and weight s.

    It is minus the gradient of ``B/2 s (theta - theta_0)^2`` (Grinspun et al. 2003), and a damper of the same form.
    """
    members, weight, rest_angle, _ = elements.bends
    rigidity, damping_time = elastic.rigidity, elastic.damping_time
    angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, x.shape[2])
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        hinge_angles(_at(x, i), _at(x, j), _at(x, k), _at(x, m), angle, slopes, geometry)
        hinge_rates(_at(v, i), _at(v, j), _at(v, k), _at(v, m), slopes, rate)
        # the moment [N m], in place of the angle
        share, rest = weight[s], rest_angle[s]
        for l in range(x.shape[2]):
            angle[l] = share * rigidity[l] * (angle[l] - rest + damping_time[l] * rate[l])
        # the force on each corner
        for corner in range(4):
            for e in range(3):
                fe, slope = f[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    fe[l] -= slope[l] * angle[l]


@uncounted
def add_hinge_products(x, p, y, elements, scale, scratch):
    """``y_i <- y_i + scale s grad_i theta (sum_j grad_j theta . p_j)`` for each hinge of angle theta and weight s.

    This is the Gauss-Newton part of the energy's Hessian, the outer product of the gradients.  It is never indefinite.
    """
    members, weight, _, _ = elements.bends
    angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, x.shape[2])
    for s in range(members.shape[0]):
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        hinge_angles(_at(x, i), _at(x, j), _at(x, k), _at(x, m), angle, slopes, geometry)
        hinge_rates(_at(p, i), _at(p, j), _at(p, k), _at(p, m), slopes, rate)
        # the scaled rate along p, and its product with the gradient at each corner
        share = weight[s]
        for l in range(x.shape[2]):
            rate[l] *= share * scale[l]
        for corner in range(4):
            for e in range(3):
                ye, slope = y[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(x.shape[2]):
                    ye[l] += rate[l] * slope[l]


@kernel
def project_hinges(y, u, w, bends, h, inverse_alpha_tilde, gamma, relaxation, lam, scratch):
    """One pass over the hinges with the constraint ``C = theta - theta_0``; equations as in ``integrators.xpbd``, over alpha~.

    A hinge of weight s has ``1/alpha~ = s B h^2``.  Signs as in the code there.  Angles are the same for lengths over h; their
    slopes are h times those of ``hinge_angles``.
    """
    members, weight, rest_angle, _ = bends
    one, zero, per_square = y.dtype.type(1), y.dtype.type(0), y.dtype.type(1) / (h * h)
    angle, rate, slopes, geometry, mobility, places = hinge_rows(scratch.rows, y.shape[2])
    keeps = lam.shape[0] > 0
    for s in range(members.shape[0]):
        # the corners at the end of the substep, as seen from the first: small numbers
        i, j, k, m = members[s, 0], members[s, 1], members[s, 2], members[s, 3]
        for row in range(12):
            e, p = row % 3, members[s, row // 3]
            for l in range(y.shape[2]):
                places[row, l] = (y[e, p, l] - y[e, i, l]) + (u[e, p, l] - u[e, i, l])
        # theta, grad theta, and grad C . (x - x^n)
        hinge_angles(places[:3], places[3:6], places[6:9], places[9:], angle, slopes, geometry)
        hinge_rates(_at(u, i), _at(u, j), _at(u, k), _at(u, m), slopes, rate)
        # sum_i w_i |grad_i C|^2 h^2
        mobility[:] = 0
        for corner in range(4):
            wm = w[members[s, corner]]
            for e in range(3):
                slope = slopes[3 * corner + e]
                for l in range(y.shape[2]):
                    mobility[l] += wm[l] * slope[l] * slope[l]
        # delta lambda, in place of the angle
        share, rest = weight[s], rest_angle[s]
        for l in range(y.shape[2]):
            stiff = share * inverse_alpha_tilde[l]
            error = stiff * (angle[l] - rest + gamma[l] * rate[l])
            angle[l] = (error - (lam[s, 0, l] if keeps else zero)) / (stiff * per_square * (one + gamma[l]) * mobility[l] + one)
        if keeps:
            for l in range(y.shape[2]):
                lam[s, 0, l] += angle[l]
        # u_i <- u_i + w_i grad_i C delta lambda/h
        for corner in range(4):
            wm = w[members[s, corner]]
            for e in range(3):
                ue, slope = u[e, members[s, corner]], slopes[3 * corner + e]
                for l in range(y.shape[2]):
                    ue[l] -= relaxation * wm[l] * slope[l] * (angle[l] * per_square)


# --- the table ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bending:
    """A model of bending.

    Attributes:
        name: its key in the table.
        hinged: whether hinges resist bending; otherwise skip springs do.
        isotropic: whether hinges resist displacements in the plane of the sheet as much as those across it, for want of a normal.
        kernels: by the names under which integrators call them.
    """

    name: str
    hinged: bool
    isotropic: bool
    kernels: dict[str, Any]

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """Copies and pickles are by name: its kernels stay where they are."""
        return _named, (self.name,)

    def energy(self, bends: BendArrays, x: NDArray, rigidity: NDArray) -> NDArray:
        """Energy of the hinges [J], (num_envs,); x [m], (num_envs, particles, 3); rigidity [N m], (num_envs,)."""
        # quadratic: B/2 |sum_i q_i x_i|^2
        corners = x[:, bends.particles]
        if self.name == "quadratic":
            return rigidity / 2 * np.sum(np.einsum("sm,esmc->esc", bends.curves, corners) ** 2, axis=(1, 2))
        # hinges: B/2 s (theta - theta_0)^2
        e, a, b = (corners[:, :, m] - corners[:, :, 0] for m in (1, 2, 3))
        one, two = np.cross(e, a), np.cross(b, e)
        angle = np.arctan2(-np.linalg.norm(e, axis=2) * np.sum(one * b, axis=2), np.sum(one * two, axis=2))
        return rigidity / 2 * np.sum(bends.weight * (angle - bends.rest_angle) ** 2, axis=1)


def _kernels(forces: Any, products: Any, project: Any) -> dict[str, Any]:
    """A model's kernels by the names under which integrators call them."""
    return {"add_bend_forces": forces, "add_bend_products": products, "project_bends": project}


BENDING: dict[str, Bending] = {
    "springs": Bending("springs", False, False, _kernels(add_no_forces, add_no_products, project_nothing)),
    "hinge": Bending("hinge", True, False, _kernels(add_hinge_forces, add_hinge_products, project_hinges)),
    "quadratic": Bending("quadratic", True, True, _kernels(add_quadratic_forces, add_quadratic_products, project_quadratic)),
}


def _named(name: str) -> Bending:
    return BENDING[name]


def model_of(name: str, mesh: ClothMesh) -> Bending:
    """The model of that name, for a mesh.

    Raises:
        ValueError: no such name (the message lists the right ones), or a model that does not fit this mesh.
    """
    known("bending model", name, BENDING)
    if name == "quadratic" and not mesh.flat:
        steepest = float(np.abs(mesh.hinges.rest_angle).max())
        raise ValueError(
            f"bending='quadratic' needs a sheet that is flat at rest, and this one has angles up to {steepest:.3g} rad: use "
            "bending='hinge'"
        )
    return BENDING[name]

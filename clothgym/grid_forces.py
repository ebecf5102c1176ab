"""Floor 3: forces on one sheet that is a grid, with its particles adjacent in memory.

The springs of one kind join particles p and p + o, with the same offset o for all of them.  So their forces F are one loop over p
without an index array.  The force on a particle is one sum over the kinds, in a fixed order,

    f[p] <- ((f[p] - F_0[p - o_0] + F_0[p]) - F_1[p - o_1] + F_1[p]) - ...,

which is the order in which a plain loop over the springs, by kind and then by particle, would add them.  Springs that would wrap
around the end of a row have weight zero.

The quadratic bending model is a constant matrix K, whose rows sum to zero.  So the force on p is ``B sum_q -K_pq (x_q - x_p)``,
that of springs of rest length zero.  They have the same six offsets, as the hinges of a grid reach no farther.

Arrays are those of ``forces`` with one lane: positions x [m] and velocities v [m/s] are (3, particles, 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym._jit import disjoint, inlined, merged, uncounted
from clothgym.bending import Bending, add_no_forces, add_no_products, hinge_angles, hinge_rates, hinge_rows
from clothgym.forces import TINY, add_lane_air_forces, add_lane_forces, add_lane_products, most_air, set_lane_forces
from clothgym.sheet_forces import (
    add_sheet_air_forces,
    add_sheet_forces,
    add_sheet_hinge_forces,
    add_sheet_quadratic_forces,
    set_sheet_forces,
)


@inlined
def rows_of(a):
    """The vectors of a single lane as (3, particles); a: (3, particles, 1)."""
    return merged(a)


# --- springs, and the quadratic bending model ------------------------------------------------------------------------------


@disjoint
def _spring_kind(x, y, z, vx, vy, vz, o, count, weight, stiffness, rest_length, tau, fx, fy, fz):
    """Forces of one kind of springs on their first ends [N]: ``g d``, with g from ``forces.add_lane_forces``.

    x ... vz: components of positions and velocities, (particles,); o: the kind's offset; weight, fx, fy, fz: (count,).
    """
    one, tiny = x.dtype.type(1), x.dtype.type(TINY)
    x1, y1, z1, vx1, vy1, vz1 = x[o:], y[o:], z[o:], vx[o:], vy[o:], vz[o:]
    for p in range(count):
        dx, dy, dz = x1[p] - x[p], y1[p] - y[p], z1[p] - z[p]
        ux, uy, uz = vx1[p] - vx[p], vy1[p] - vy[p], vz1[p] - vz[p]
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        g = weight[p] * stiffness * ((one - rest_length * q) + tau * (ux * dx + uy * dy + uz * dz) * q * q)
        fx[p], fy[p], fz[p] = g * dx, g * dy, g * dz


@disjoint
def _spring_and_curve_kind(x, y, z, vx, vy, vz, o, count, weight, stiffness, rest_length, curve, rigidity, tau, fx, fy, fz):
    """``_spring_kind``, plus the quadratic model's force along the same offset, ``B curve (d + tau u)``."""
    one, tiny = x.dtype.type(1), x.dtype.type(TINY)
    x1, y1, z1, vx1, vy1, vz1 = x[o:], y[o:], z[o:], vx[o:], vy[o:], vz[o:]
    for p in range(count):
        dx, dy, dz = x1[p] - x[p], y1[p] - y[p], z1[p] - z[p]
        ux, uy, uz = vx1[p] - vx[p], vy1[p] - vy[p], vz1[p] - vz[p]
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        g = weight[p] * stiffness * ((one - rest_length * q) + tau * (ux * dx + uy * dy + uz * dz) * q * q)
        b = curve[p] * rigidity
        fx[p], fy[p], fz[p] = g * dx + b * (dx + tau * ux), g * dy + b * (dy + tau * uy), g * dz + b * (dz + tau * uz)


@disjoint
def _curve_kind(x, v, o, count, curve, rigidity, tau, f):
    """The quadratic model's force ``B curve (d + tau u)`` alone, one component, along an offset without springs."""
    x1, v1 = x[o:], v[o:]
    for p in range(count):
        f[p] = curve[p] * rigidity * ((x1[p] - x[p]) + tau * (v1[p] - v[p]))


@disjoint
def _gather(f, before, g0, g1, g2, g3, g4, g5, o0, o1, o2, o3, o4, o5):
    """Add one component of the forces of six kinds to ``f``, (particles,), in the order of the module's docstring.

    g0 ... g5: forces of a kind on the first ends, (before + particles,), the first ``before`` of them zero.  o0 ... o5: offsets.
    """
    # a: forces on p as a first end, F[p]; b: as a second end, F[p - o]
    a0, a1, a2, a3, a4, a5 = g0[before:], g1[before:], g2[before:], g3[before:], g4[before:], g5[before:]
    b0, b1, b2, b3, b4, b5 = (
        g0[before - o0 :], g1[before - o1 :], g2[before - o2 :], g3[before - o3 :], g4[before - o4 :], g5[before - o5 :]
    )  # fmt: skip
    for p in range(f.shape[0]):
        f[p] = (
            f[p] - b0[p] + a0[p] - b1[p] + a1[p] - b2[p] + a2[p] - b3[p] + a3[p] - b4[p] + a4[p] - b5[p] + a5[p]
        )  # fmt: skip


@disjoint
def _gather_from(start, f, before, g0, g1, g2, g3, g4, g5, o0, o1, o2, o3, o4, o5):
    """``_gather`` with initial values ``start``, (particles,), instead of those in ``f``; both must not overlap."""
    a0, a1, a2, a3, a4, a5 = g0[before:], g1[before:], g2[before:], g3[before:], g4[before:], g5[before:]
    b0, b1, b2, b3, b4, b5 = (
        g0[before - o0 :], g1[before - o1 :], g2[before - o2 :], g3[before - o3 :], g4[before - o4 :], g5[before - o5 :]
    )  # fmt: skip
    for p in range(f.shape[0]):
        f[p] = (
            start[p] - b0[p] + a0[p] - b1[p] + a1[p] - b2[p] + a2[p] - b3[p] + a3[p] - b4[p] + a4[p] - b5[p] + a5[p]
        )  # fmt: skip


@inlined
def _gather_kinds(f, offset, kinds):
    """Add the forces of all kinds, (3, kinds, before + particles), to ``f``, (3, particles); see ``_gather``."""
    before = kinds.shape[2] - f.shape[1]
    for c in range(3):
        g = kinds[c]
        _gather(
            f[c], before, g[0], g[1], g[2], g[3], g[4], g[5],
            offset[0], offset[1], offset[2], offset[3], offset[4], offset[5],
        )  # fmt: skip


# the loops over kinds take plain arrays and have no branches.  Otherwise references to each row are counted, which takes as long
# as a row of forces


@inlined
def _spring_kinds(x, v, offset, weight, kind, rest_length, elastic, out, before):
    """Forces of all kinds of springs on their first ends [N]; x, v: (3, particles); out: (3, kinds, before + particles)."""
    stiffness, tau, size = elastic.stiffness, elastic.damping_time[0], elastic.size[0]
    for a in range(weight.shape[0]):
        _spring_kind(
            x[0], x[1], x[2], v[0], v[1], v[2], offset[a], x.shape[1] - offset[a], weight[a], stiffness[kind[a], 0],
            rest_length[a] * size, tau, out[0, a, before:], out[1, a, before:], out[2, a, before:],
        )  # fmt: skip


@inlined
def _spring_and_curve_kinds(x, v, offset, weight, kind, rest_length, curve, elastic, out, before):
    """``_spring_kinds``, plus the quadratic model's forces along the same offsets."""
    stiffness, tau, rigidity, size = elastic.stiffness, elastic.damping_time[0], elastic.rigidity[0], elastic.size[0]
    for a in range(weight.shape[0]):
        _spring_and_curve_kind(
            x[0], x[1], x[2], v[0], v[1], v[2], offset[a], x.shape[1] - offset[a], weight[a], stiffness[kind[a], 0],
            rest_length[a] * size, curve[a], rigidity, tau, out[0, a, before:], out[1, a, before:], out[2, a, before:],
        )  # fmt: skip


@inlined
def _curve_kinds(x, v, offset, begin, curve, rigidity, tau, out, before):
    """The quadratic model's forces along the offsets from ``begin`` on, where there are no springs."""
    for a in range(begin, curve.shape[0]):
        for c in range(3):
            _curve_kind(x[c], v[c], offset[a], x.shape[1] - offset[a], curve[a], rigidity, tau, out[c, a, before:])


@uncounted
def _force_kinds(x, v, elements, elastic, kinds):
    """The forces of each kind on the first ends, of springs and of the quadratic bending model if it is used, to ``kinds``."""
    # names for one lane's arrays
    offset, kind, rest_length, weight, curve, _, _ = elements
    r, s = rows_of(x), rows_of(v)
    before = kinds.shape[2] - r.shape[1]
    if curve.shape[0] > 0:
        _spring_and_curve_kinds(r, s, offset, weight, kind, rest_length, curve, elastic, kinds, before)
        _curve_kinds(r, s, offset, weight.shape[0], curve, elastic.rigidity[0], elastic.damping_time[0], kinds, before)
    else:
        _spring_kinds(r, s, offset, weight, kind, rest_length, elastic, kinds, before)


@uncounted
def add_grid_forces(x, v, f, elements, elastic, scratch):
    """Add the springs' forces, and those of the quadratic bending model if it is used, to ``f`` [N], (3, particles, 1).

    The formulas are those of ``forces.add_lane_forces`` and ``bending.add_quadratic_forces``.  elements: an ``elements.Grid``.
    """
    _force_kinds(x, v, elements, elastic, scratch.kinds)
    _gather_kinds(rows_of(f), elements.offset, scratch.kinds)


@uncounted
def set_grid_forces(x, v, start, f, elements, elastic, scratch):
    """``f`` is ``start``, (3, particles, 1), plus the forces of ``add_grid_forces`` [N]; faster than a copy and these."""
    kinds, o = scratch.kinds, elements.offset
    begin, total = rows_of(start), rows_of(f)
    before = kinds.shape[2] - total.shape[1]
    _force_kinds(x, v, elements, elastic, kinds)
    for c in range(3):
        g = kinds[c]
        _gather_from(
            begin[c], total[c], before, g[0], g[1], g[2], g[3], g[4], g[5], o[0], o[1], o[2], o[3], o[4], o[5]
        )  # fmt: skip


@disjoint
def _product_kind(x, y, z, px, py, pz, o, count, weight, along, across, rest_length, bend, curve, fx, fy, fz):
    """One kind's part of ``forces.add_lane_products`` on the first ends, plus ``bend curve u``; u is the difference of p.

    x ... pz: components of positions and of the vector p, (particles,); fx, fy, fz: (count,).  The caller gives along, across and
    bend the sign of a force.
    """
    one, zero, tiny = x.dtype.type(1), x.dtype.type(0), x.dtype.type(TINY)
    x1, y1, z1, px1, py1, pz1 = x[o:], y[o:], z[o:], px[o:], py[o:], pz[o:]
    for p in range(count):
        dx, dy, dz = x1[p] - x[p], y1[p] - y[p], z1[p] - z[p]
        ux, uy, uz = px1[p] - px[p], py1[p] - py[p], pz1[p] - pz[p]
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        stretched = one - rest_length * q
        aside = weight[p] * across * (stretched if stretched > zero else zero)
        g = (weight[p] * along - aside) * (ux * dx + uy * dy + uz * dz) * q * q
        aside += bend * curve[p]
        fx[p], fy[p], fz[p] = g * dx + aside * ux, g * dy + aside * uy, g * dz + aside * uz


@disjoint
def _curve_product_kind(p, o, count, curve, bend, f):
    """``bend curve u`` alone, one component, along an offset without springs."""
    p1 = p[o:]
    for i in range(count):
        f[i] = bend * curve[i] * (p1[i] - p[i])


@uncounted
def add_grid_products(x, p, y, elements, size, along, across, bend, scratch):
    """``y <- y + K p``, with K the stiffness matrix of springs and of the quadratic model if it is used; (3, particles, 1).

    along, across: see ``forces.add_lane_products``, (kinds, 1).  bend: coefficient of the quadratic model, (1,).
    """
    # names for one lane's arrays
    offset, kind, rest_length, weight, curve, _, _ = elements
    kinds = scratch.kinds
    r, s, total = rows_of(x), rows_of(p), rows_of(y)
    zero = x.dtype.type(0)
    before = kinds.shape[2] - r.shape[1]
    # kind by kind; the first are springs, with or without bending, and the others bend only
    for a in range(offset.shape[0]):
        o = offset[a]
        count = r.shape[1] - o
        fx, fy, fz = kinds[0, a, before:], kinds[1, a, before:], kinds[2, a, before:]
        if a < weight.shape[0]:
            n, t, rest = along[kind[a], 0], across[kind[a], 0], rest_length[a] * size[0]
            b, own = (bend[0], curve[a]) if curve.shape[0] > 0 else (zero, weight[a])
            _product_kind(
                r[0], r[1], r[2], s[0], s[1], s[2], o, count, weight[a], -n, -t, rest, -b, own, fx, fy, fz
            )  # fmt: skip
        elif curve.shape[0] > 0:
            _curve_product_kind(s[0], o, count, curve[a], -bend[0], fx)
            _curve_product_kind(s[1], o, count, curve[a], -bend[0], fy)
            _curve_product_kind(s[2], o, count, curve[a], -bend[0], fz)
    _gather_kinds(total, offset, kinds)


# --- hinges -------------------------------------------------------------------------------------------------------------


@disjoint
def _moments(angle, rate, weight, rigidity, tau):
    """``angle <- s B (angle + tau rate)``: moments [N m] of hinges of weight s, (count,); a grid is flat at rest."""
    for p in range(angle.shape[0]):
        angle[p] = weight[p] * rigidity * (angle[p] + tau * rate[p])


@disjoint
def _subtract_moment(fx, fy, fz, sx, sy, sz, moment):
    """Subtract ``moment s`` from the forces on one corner of each hinge, with the slopes s of the angle there, (count,)."""
    for p in range(moment.shape[0]):
        fx[p] -= sx[p] * moment[p]
        fy[p] -= sy[p] * moment[p]
        fz[p] -= sz[p] * moment[p]


@inlined
def _slices(rows, begin, count):
    """The three components of ``count`` particles from ``begin`` on, (count,) each; rows: (3, particles)."""
    return rows[0, begin : begin + count], rows[1, begin : begin + count], rows[2, begin : begin + count]


@uncounted
def add_grid_hinge_forces(x, v, f, elements, elastic, scratch):
    """The forces of ``bending.add_hinge_forces``: family by family, and within each corner by corner.

    A family is the hinges whose corners have the same offsets.  elements: an ``elements.Grid``.
    """
    grid, tau, rigidity = elements, elastic.damping_time[0], elastic.rigidity[0]
    r, s, total = rows_of(x), rows_of(v), rows_of(f)
    for family in range(grid.hinge.shape[0]):
        # a range of first ends whose hinges have all corners in the sheet; those that wrap around a row's end have weight zero
        j, k, l = grid.hinge[family, 0], grid.hinge[family, 1], grid.hinge[family, 2]
        low = max(0, -min(j, min(k, l)))
        count = r.shape[1] - max(0, max(j, max(k, l))) - low
        if count <= 0:
            continue
        # angles, their rates, and moments
        angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, count)
        hinge_angles(
            _slices(r, low, count), _slices(r, low + j, count), _slices(r, low + k, count), _slices(r, low + l, count), angle,
            slopes, geometry,
        )  # fmt: skip
        hinge_rates(
            _slices(s, low, count), _slices(s, low + j, count), _slices(s, low + k, count), _slices(s, low + l, count), slopes,
            rate,
        )  # fmt: skip
        _moments(angle, rate, grid.hinge_weight[family, low : low + count], rigidity, tau)
        # the forces on each corner
        for m, at in ((0, low), (1, low + j), (2, low + k), (3, low + l)):
            fx, fy, fz = _slices(total, at, count)
            _subtract_moment(fx, fy, fz, slopes[3 * m], slopes[3 * m + 1], slopes[3 * m + 2], angle)


@uncounted
def add_grid_hinge_products(x, p, y, elements, bend, scratch):
    """The products of ``bending.add_hinge_products``, in the order of ``add_grid_hinge_forces``."""
    grid, zero = elements, x.dtype.type(0)
    r, s, total = rows_of(x), rows_of(p), rows_of(y)
    for family in range(grid.hinge.shape[0]):
        # the hinges of this family, as for the forces
        j, k, l = grid.hinge[family, 0], grid.hinge[family, 1], grid.hinge[family, 2]
        low = max(0, -min(j, min(k, l)))
        count = r.shape[1] - max(0, max(j, max(k, l))) - low
        if count <= 0:
            continue
        # slopes, and the rate of the angle along p, which takes the angle's place
        angle, rate, slopes, geometry, _, _ = hinge_rows(scratch.rows, count)
        hinge_angles(
            _slices(r, low, count), _slices(r, low + j, count), _slices(r, low + k, count), _slices(r, low + l, count), angle,
            slopes, geometry,
        )  # fmt: skip
        hinge_rates(
            _slices(s, low, count), _slices(s, low + j, count), _slices(s, low + k, count), _slices(s, low + l, count), slopes,
            angle,
        )  # fmt: skip
        # scaled, with the opposite sign of a force, and added at each corner
        rate[:] = zero
        _moments(angle, rate, grid.hinge_weight[family, low : low + count], -bend[0], zero)
        for m, at in ((0, low), (1, low + j), (2, low + k), (3, low + l)):
            fx, fy, fz = _slices(total, at, count)
            _subtract_moment(fx, fy, fz, slopes[3 * m], slopes[3 * m + 1], slopes[3 * m + 2], angle)


# --- air ----------------------------------------------------------------------------------------------------------------


@inlined
def _air_force(px, py, pz, qx, qy, qz, ux, uy, uz, across, along, most, half, one, tiny):
    """Force on a triangle with sides p and q [m] in a relative wind u [m/s], in N; see ``forces.add_lane_air_forces``."""
    # normal times twice the area
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    twice = np.sqrt(nx * nx + ny * ny + nz * nz + tiny)
    speed = min(np.sqrt(ux * ux + uy * uy + uz * uz), most * (one / (half * twice)))
    skin = half * speed * along * twice
    face = half * speed * (across - along) * (ux * nx + uy * ny + uz * nz) * (one / twice)
    return face * nx + skin * ux, face * ny + skin * uy, face * nz + skin * uz


@disjoint
def _first_triangles(x, y, z, vx, vy, vz, c, even, sa, sb, sc, sd, wx, wy, wz, across, along, most, fx, fy, fz):
    """Forces on the first triangle of each cell, fx, fy, fz [N], (cells,): a, b, d in even cells, a, b, c in others.

    x ... vz: components of positions and velocities, (particles,).  c: particles in a row.  sa ... sd: the corners' shares of the
    triangle.  wx, wy, wz: the wind [m/s].  most: what area times speed may be [m^3/s].
    """
    # the corners b, c and d of the cell whose first corner is a = p
    half, zero, one, tiny = x.dtype.type(0.5), x.dtype.type(0), x.dtype.type(1), x.dtype.type(1e-18)
    xb, yb, zb, ub, vb, wb = x[1:], y[1:], z[1:], vx[1:], vy[1:], vz[1:]
    xc, yc, zc, uc, vc, wc = x[c:], y[c:], z[c:], vx[c:], vy[c:], vz[c:]
    xd, yd, zd, ud, vd, wd = x[c + 1 :], y[c + 1 :], z[c + 1 :], vx[c + 1 :], vy[c + 1 :], vz[c + 1 :]
    for p in range(fx.shape[0]):
        # the side that depends on the diagonal, and the wind relative to the triangle
        whole = even[p] > zero
        qx, qy, qz = (xd[p] if whole else xc[p]) - x[p], (yd[p] if whole else yc[p]) - y[p], (zd[p] if whole else zc[p]) - z[p]
        ux = wx - (sa[p] * vx[p] + sb[p] * ub[p] + sc[p] * uc[p] + sd[p] * ud[p])
        uy = wy - (sa[p] * vy[p] + sb[p] * vb[p] + sc[p] * vc[p] + sd[p] * vd[p])
        uz = wz - (sa[p] * vz[p] + sb[p] * wb[p] + sc[p] * wc[p] + sd[p] * wd[p])
        fx[p], fy[p], fz[p] = _air_force(
            xb[p] - x[p], yb[p] - y[p], zb[p] - z[p], qx, qy, qz, ux, uy, uz, across, along, most, half, one, tiny
        )  # fmt: skip


@disjoint
def _second_triangles(x, y, z, vx, vy, vz, c, even, sa, sb, sc, sd, wx, wy, wz, across, along, most, fx, fy, fz):
    """Forces on the second triangle of each cell: d, c, a in even cells, d, c, b in others; see ``_first_triangles``."""
    half, zero, one, tiny = x.dtype.type(0.5), x.dtype.type(0), x.dtype.type(1), x.dtype.type(1e-18)
    xb, yb, zb, ub, vb, wb = x[1:], y[1:], z[1:], vx[1:], vy[1:], vz[1:]
    xc, yc, zc, uc, vc, wc = x[c:], y[c:], z[c:], vx[c:], vy[c:], vz[c:]
    xd, yd, zd, ud, vd, wd = x[c + 1 :], y[c + 1 :], z[c + 1 :], vx[c + 1 :], vy[c + 1 :], vz[c + 1 :]
    for p in range(fx.shape[0]):
        whole = even[p] > zero
        qx, qy, qz = (x[p] if whole else xb[p]) - xd[p], (y[p] if whole else yb[p]) - yd[p], (z[p] if whole else zb[p]) - zd[p]
        ux = wx - (sa[p] * vx[p] + sb[p] * ub[p] + sc[p] * uc[p] + sd[p] * ud[p])
        uy = wy - (sa[p] * vy[p] + sb[p] * vb[p] + sc[p] * vc[p] + sd[p] * vd[p])
        uz = wz - (sa[p] * vz[p] + sb[p] * wb[p] + sc[p] * wc[p] + sd[p] * wd[p])
        fx[p], fy[p], fz[p] = _air_force(
            xc[p] - xd[p], yc[p] - yd[p], zc[p] - zd[p], qx, qy, qz, ux, uy, uz, across, along, most, half, one, tiny
        )  # fmt: skip


@disjoint
def _share_out(fx, fy, fz, own, others, ax, ay, az, bx, by, bz):
    """Add a corner's shares of the forces on both triangles of its cell, a and b, to the forces on it; all (cells,)."""
    for p in range(ax.shape[0]):
        fx[p] += own[p] * ax[p] + others[p] * bx[p]
        fy[p] += own[p] * ay[p] + others[p] * by[p]
        fz[p] += own[p] * az[p] + others[p] * bz[p]


@uncounted
def add_grid_air_forces(x, v, f, surface, resistance, wind, interval, scratch):
    """The forces of ``forces.add_lane_air_forces``, for all cells at once, and then corner by corner.

    The corners of a cell are a, b in one row and c, d in the next.  Its triangles are abd and adc if it is even, else abc and bdc.
    surface: an ``elements.GridSurface``.
    """
    # names for one lane's arrays; a and b: forces on the first and on the second triangles
    cell, even, s, area = surface
    across, along = resistance[0, 0], resistance[1, 0]
    most = area[0] * most_air(across, along, resistance[2, 0], interval, x.dtype.type(TINY))
    r, u, total, columns = rows_of(x), rows_of(v), rows_of(f), cell[2]
    count = r.shape[1] - columns - 1
    ax, ay, az = scratch.rows[0, :count], scratch.rows[1, :count], scratch.rows[2, :count]
    bx, by, bz = scratch.rows[3, :count], scratch.rows[4, :count], scratch.rows[5, :count]
    wx, wy, wz = wind[0, 0], wind[1, 0], wind[2, 0]
    # the forces on both triangles of each cell
    _first_triangles(
        r[0], r[1], r[2], u[0], u[1], u[2], columns, even, s[0], s[1], s[2], s[3], wx, wy, wz, across, along, most, ax, ay, az
    )  # fmt: skip
    _second_triangles(
        r[0], r[1], r[2], u[0], u[1], u[2], columns, even, s[4], s[5], s[6], s[7], wx, wy, wz, across, along, most, bx, by, bz
    )  # fmt: skip
    # the corners take their shares
    for corner in range(4):
        fx, fy, fz = _slices(total, cell[corner], count)
        _share_out(fx, fy, fz, s[corner], s[4 + corner], ax, ay, az, bx, by, bz)


# --- the table ----------------------------------------------------------------------------------------------------------


def kernels_of(model: Bending, layout: str) -> dict[str, Any]:
    """The force kernels for a bending model, by the names under which integrators and the main loop call them.

    layout: see ``layout.Layout``.
    """
    if layout == "lanes":
        return model.kernels | {
            "add_spring_forces": add_lane_forces, "add_spring_products": add_lane_products, "add_air_forces": add_lane_air_forces,
            "set_spring_forces": set_lane_forces,
        }  # fmt: skip
    if layout == "sheet":
        bends = {"springs": add_no_forces, "quadratic": add_sheet_quadratic_forces, "hinge": add_sheet_hinge_forces}
        return model.kernels | {
            "add_spring_forces": add_sheet_forces, "add_spring_products": add_lane_products, "add_air_forces": add_sheet_air_forces,
            "set_spring_forces": set_sheet_forces, "add_bend_forces": bends[model.name],
        }  # fmt: skip
    # the quadratic model is added together with the springs
    hinges = (add_grid_hinge_forces, add_grid_hinge_products) if model.name == "hinge" else (add_no_forces, add_no_products)
    return {
        "add_spring_forces": add_grid_forces, "add_spring_products": add_grid_products, "add_air_forces": add_grid_air_forces,
        "set_spring_forces": set_grid_forces, "add_bend_forces": hinges[0], "add_bend_products": hinges[1],
    }  # fmt: skip

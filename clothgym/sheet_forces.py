"""Floor 3: forces on one sheet of any triangles, with its particles adjacent in memory.

The kernels take springs, hinges and triangles ``BATCH`` at a time: what their formulas read is copied to rows, with one element in
each column, so that the formulas are vectorized over elements; then the forces are added to the particles one element after the
other, in the order of ``forces`` and ``bending``, and so with the same bits.

Arrays are those of ``forces`` with one lane: positions x [m] and velocities v [m/s] are (3, particles, 1).
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, inlined, merged, uncounted
from clothgym.bending import hinge_angles, hinge_rates, hinge_rows
from clothgym.elements import BATCH
from clothgym.forces import TINY, copy, most_air


@disjoint
def _read(x, members, rows):
    """Copy the components of the elements' particles to rows: 3 m + c is component c of member m.

    x: (3, particles).  members: (elements, M).  rows: (3 M, elements).
    """
    for m in range(members.shape[1]):
        for e in range(members.shape[0]):
            p = np.uint32(members[e, m])
            rows[3 * m, e], rows[3 * m + 1, e], rows[3 * m + 2, e] = x[0, p], x[1, p], x[2, p]


@disjoint
def _read_springs(x, v, ends, kind, weight, stiffness, rows):
    """Differences of the springs' ends, of their velocities, and the springs' stiffness [N/m]: ``rows``, (7, springs)."""
    for s in range(ends.shape[0]):
        i, j = np.uint32(ends[s, 0]), np.uint32(ends[s, 1])
        rows[0, s], rows[1, s], rows[2, s] = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        rows[3, s], rows[4, s], rows[5, s] = v[0, j] - v[0, i], v[1, j] - v[1, i], v[2, j] - v[2, i]
        rows[6, s] = weight[s] * stiffness[np.uint32(kind[s])]


@disjoint
def _pull(dx, dy, dz, ux, uy, uz, k, rest_length, size, tau):
    """The forces on the springs' first ends [N], in place of the differences; see ``forces.add_lane_forces``."""
    one, tiny = dx.dtype.type(1), dx.dtype.type(TINY)
    for s in range(rest_length.shape[0]):
        q = one / np.sqrt(dx[s] * dx[s] + dy[s] * dy[s] + dz[s] * dz[s] + tiny)
        g = k[s] * ((one - rest_length[s] * size * q) + tau * (ux[s] * dx[s] + uy[s] * dy[s] + uz[s] * dz[s]) * q * q)
        dx[s], dy[s], dz[s] = g * dx[s], g * dy[s], g * dz[s]


@disjoint
def _add_pulls(rows, ends, f):
    """Add the springs' forces, in the first rows, to their first ends, and subtract them from their second; f: (3, particles)."""
    for s in range(ends.shape[0]):
        i, j = np.uint32(ends[s, 0]), np.uint32(ends[s, 1])
        f[0, i] += rows[0, s]
        f[1, i] += rows[1, s]
        f[2, i] += rows[2, s]
        f[0, j] -= rows[0, s]
        f[1, j] -= rows[1, s]
        f[2, j] -= rows[2, s]


@uncounted
def add_sheet_forces(x, v, f, elements, elastic, scratch):
    """The forces of ``forces.add_lane_forces``."""
    ends, rest_length, kind, weight = elements.springs
    stiffness, tau, size, rows = elastic.stiffness[:, 0], elastic.damping_time[0], elastic.size[0], scratch.rows
    r, s, total = merged(x), merged(v), merged(f)
    for begin in range(0, ends.shape[0], BATCH):
        end = min(begin + BATCH, ends.shape[0])
        _read_springs(r, s, ends[begin:end], kind[begin:end], weight[begin:end], stiffness, rows)
        _pull(rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rest_length[begin:end], size, tau)
        _add_pulls(rows, ends[begin:end], total)


@uncounted
def set_sheet_forces(x, v, start, f, elements, elastic, scratch):
    """``f`` is ``start`` plus the forces of ``add_sheet_forces`` [N]; start, f: (3, particles, 1)."""
    copy(merged(merged(start)), merged(merged(f)))
    add_sheet_forces(x, v, f, elements, elastic, scratch)


@disjoint
def _subtract(rows, members, f):
    """Subtract the forces on the four members of each hinge, laid out as by ``_read``, from f, (3, particles)."""
    for e in range(members.shape[0]):
        i, j = np.uint32(members[e, 0]), np.uint32(members[e, 1])
        k, l = np.uint32(members[e, 2]), np.uint32(members[e, 3])
        for c in range(3):
            f[c, i] -= rows[c, e]
            f[c, j] -= rows[3 + c, e]
            f[c, k] -= rows[6 + c, e]
            f[c, l] -= rows[9 + c, e]


@disjoint
def _moments(angle, rate, weight, rest_angle, rigidity, tau):
    """``angle <- s B (angle - theta_0 + tau rate)``: moments [N m], (hinges,)."""
    for e in range(angle.shape[0]):
        angle[e] = weight[e] * rigidity * (angle[e] - rest_angle[e] + tau * rate[e])


@disjoint
def _multiply(factor, row):
    """``row <- row factor``, (elements,)."""
    for e in range(row.shape[0]):
        row[e] *= factor[e]


@inlined
def _member(rows, m):
    """The three components of member m of each element, (elements,) each; rows: see ``_read``."""
    return rows[3 * m], rows[3 * m + 1], rows[3 * m + 2]


@uncounted
def add_sheet_hinge_forces(x, v, f, elements, elastic, scratch):
    """The forces of ``bending.add_hinge_forces``."""
    members, weight, rest_angle, _ = elements.bends
    rigidity, tau = elastic.rigidity[0], elastic.damping_time[0]
    r, s, total = merged(x), merged(v), merged(f)
    for begin in range(0, members.shape[0], BATCH):
        end = min(begin + BATCH, members.shape[0])
        own = members[begin:end]
        # angles, then their rates, with the velocities in place of the positions
        angle, rate, slopes, geometry, _, places = hinge_rows(scratch.rows, end - begin)
        _read(r, own, places)
        hinge_angles(_member(places, 0), _member(places, 1), _member(places, 2), _member(places, 3), angle, slopes, geometry)
        _read(s, own, places)
        hinge_rates(_member(places, 0), _member(places, 1), _member(places, 2), _member(places, 3), slopes, rate)
        # the moments, and the forces on each corner
        _moments(angle, rate, weight[begin:end], rest_angle[begin:end], rigidity, tau)
        for row in range(12):
            _multiply(angle, slopes[row])
        _subtract(slopes, own, total)


@disjoint
def _subtract_curves(x, v, members, curves, rigidity, tau, f):
    """The forces of ``bending.add_quadratic_forces`` on one component, hinge by hinge; x, v, f: (particles,)."""
    for s in range(members.shape[0]):
        i, j = np.uint32(members[s, 0]), np.uint32(members[s, 1])
        k, m = np.uint32(members[s, 2]), np.uint32(members[s, 3])
        qi, qj, qk, qm = curves[s, 0], curves[s, 1], curves[s, 2], curves[s, 3]
        curve = qi * x[i] + qj * x[j] + qk * x[k] + qm * x[m]
        rate = qi * v[i] + qj * v[j] + qk * v[k] + qm * v[m]
        curve = rigidity * (curve + tau * rate)
        f[i] -= qi * curve
        f[j] -= qj * curve
        f[k] -= qk * curve
        f[m] -= qm * curve


@uncounted
def add_sheet_quadratic_forces(x, v, f, elements, elastic, scratch):
    """The forces of ``bending.add_quadratic_forces``."""
    members, curves = elements.bends.particles, elements.bends.curves
    r, s, total = merged(x), merged(v), merged(f)
    for c in range(3):
        _subtract_curves(r[c], s[c], members, curves, elastic.rigidity[0], elastic.damping_time[0], total[c])


@disjoint
def _blow(rows, shares, area, wx, wy, wz, across, along, per_area, ax, ay, az):
    """The air's force on each triangle [N], (triangles,) each; see ``forces.add_lane_air_forces``.

    rows: positions and velocities of the corners, laid out as by ``_read``, (18, triangles).  per_area: see ``most_air``.
    """
    t = ax.dtype.type
    half, tiny, one = t(0.5), t(1e-18), t(1)
    for e in range(ax.shape[0]):
        # sides from the first corner, and the normal times twice the area
        px, py, pz = rows[3, e] - rows[0, e], rows[4, e] - rows[1, e], rows[5, e] - rows[2, e]
        qx, qy, qz = rows[6, e] - rows[0, e], rows[7, e] - rows[1, e], rows[8, e] - rows[2, e]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        # the wind relative to the triangle
        a, b, c = shares[e, 0], shares[e, 1], shares[e, 2]
        ux = wx - (a * rows[9, e] + b * rows[12, e] + c * rows[15, e])
        uy = wy - (a * rows[10, e] + b * rows[13, e] + c * rows[16, e])
        uz = wz - (a * rows[11, e] + b * rows[14, e] + c * rows[17, e])
        # the terms along n and along u
        n2 = nx * nx + ny * ny + nz * nz + tiny
        twice = np.sqrt(n2)
        speed = min(np.sqrt(ux * ux + uy * uy + uz * uz), area[e] * per_area * (one / (half * twice)))
        skin = half * speed * along * twice
        face = half * speed * (across - along) * (ux * nx + uy * ny + uz * nz) * (one / twice)
        ax[e], ay[e], az[e] = face * nx + skin * ux, face * ny + skin * uy, face * nz + skin * uz


@disjoint
def _share_out(ax, ay, az, triangles, shares, f):
    """Add each triangle's force to its corners by their shares; f: (3, particles)."""
    for e in range(triangles.shape[0]):
        for m in range(3):
            p, share = np.uint32(triangles[e, m]), shares[e, m]
            f[0, p] += share * ax[e]
            f[1, p] += share * ay[e]
            f[2, p] += share * az[e]


@uncounted
def add_sheet_air_forces(x, v, f, surface, resistance, wind, interval, scratch):
    """The forces of ``forces.add_lane_air_forces``."""
    triangles, shares, area = surface
    across, along = resistance[0, 0], resistance[1, 0]
    per_area = most_air(across, along, resistance[2, 0], interval, x.dtype.type(TINY))
    r, s, total = merged(x), merged(v), merged(f)
    for begin in range(0, triangles.shape[0], BATCH):
        end = min(begin + BATCH, triangles.shape[0])
        n, own, parts = end - begin, triangles[begin:end], shares[begin:end]
        rows, ax, ay, az = scratch.rows[:18, :n], scratch.rows[18, :n], scratch.rows[19, :n], scratch.rows[20, :n]
        _read(r, own, rows[:9])
        _read(s, own, rows[9:])
        _blow(rows, parts, area[begin:end], wind[0, 0], wind[1, 0], wind[2, 0], across, along, per_area, ax, ay, az)
        _share_out(ax, ay, az, own, parts, total)

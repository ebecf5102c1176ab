"""Projective dynamics, written as a descent on the backward Euler equations.

Liu, Bargteil, O'Brien and Kavan 2013, Fast simulation of mass-spring systems; as a descent: Liu, Bouaziz and Kavan 2017.

The equations are ``M (v - v*) = h f(x + h v, v)``, with v* the velocity after gravity, drag and the air.  A local and a global step
together are one step of descent with a constant matrix ``A = M + (h^2 + h tau) sum k (e_i - e_j)(e_i - e_j)^T`` (their eq. 14, with
damping): compute the residual, solve with A, add the solution to v.  So the forces are those of all other integrators, including
dampers and hinges, and the fixed point is that of backward Euler.  A only decides how fast it is reached.  Bending enters A as the
quadratic model.

A is factorized once, at setup, and shared by all lanes: properties that enter it must be the same in all environments.  The held
particles S may differ between environments, and from step to step: ``d = A^-1 (r - E_S (A^-1_SS)^-1 (A^-1 r)_S)`` is exactly zero
on S.  This uses the columns of A^-1 that belong to particles that may be held; they are computed at setup.

Order 1, given enough iterations.  Cost: a force pass and two triangular solves per iteration.  Never unstable; with too few
iterations the sheet is sluggish.  A mode of angular frequency w keeps 1/sqrt(1 + (h w)^2) of its amplitude in a substep.  Damping
along springs enters implicitly.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel, merged, uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, add_spring_forces, largest_frequency
from clothgym.integrators import implicit_euler
from clothgym.integrators.base import (
    Integrator,
    Preparation,
    add_to,
    advance,
    copy_to,
    euler_residual,
    extrapolate,
    predict_velocities,
)

# h w of the stiffest mode up to which ten iterations come close enough to the fixed point (see docs/physics.md)
STIFFEST = 4.0


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """Backward Euler's bound [s], or the substep at which ``h w`` of the stiffest mode is 4 if that is smaller; and the reason."""
    swinging, why = implicit_euler.largest_substep(o)
    stiff = STIFFEST / largest_frequency(o)
    if swinging < stiff:
        return swinging, why
    return stiff, "beyond it some ten iterations leave the sheet sluggish (it is never unstable)"


def surely_allowed(o: Oscillators) -> float:
    """Any substep, as for backward Euler."""
    return float("inf")


def prepare(preparation: Preparation) -> tuple[NDArray, ...]:
    """Factors of A, and the columns of A^-1 of the particles that may be held.

    If the particles of one sheet are adjacent in memory, ``A = L D L^T`` in their order, as a band matrix, which is narrow enough.
    Otherwise ``P A P^T = L D L^T``, sparse, with a permutation P that keeps the factors sparse.

    Returns:
        below: entries of L below each diagonal entry, (particles, band), or (0, 0).
        before: entries of L left of each diagonal entry, (particles, band), or (0, 0).
        order: particle of each row, (particles,).
        starts, columns, values: L without its diagonal, by rows.
        row_starts, rows, row_values: the same by columns.
        inverse_diagonal: one over D, (particles,).
        slot: row of ``held`` for each particle that may be held, else -1, (particles,).
        held: columns of A^-1, (holdable, particles).
    """
    from scipy.sparse import coo_matrix, csc_matrix, diags  # imported here: scipy doubles the time of a warm start
    from scipy.sparse.linalg import splu

    # A: springs, the quadratic bending model, and masses
    o, h, holdable, regular = preparation
    springs, bends = o.elements
    n = len(o.positions)
    scale = h * h + h * o.damping_time
    i, j = springs.particles.T
    k = scale * springs.weight * o.stiffness[springs.kind]
    rows, columns, values = [i, j, i, j], [i, j, j, i], [k, k, -k, -k]
    for a in range(4):
        for b in range(4):
            rows.append(bends.particles[:, a])
            columns.append(bends.particles[:, b])
            values.append(scale * o.rigidity * bends.curves[:, a] * bends.curves[:, b])
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = csc_matrix(coo_matrix(entries, shape=(n, n)) + diags(1 / o.inverse_mass))
    # no pivoting: the matrix is positive definite, and U = D L^T
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    # columns of A^-1: solve for unit vectors
    unit = np.zeros((n, len(holdable)))
    unit[holdable, np.arange(len(holdable))] = 1
    slot = np.full(n, -1, np.int64)
    slot[holdable] = np.arange(len(holdable))
    held = factors.solve(unit).T.copy()
    # the factors as a band
    if regular:
        none = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
        below, before, diagonal = _bands(matrix)
        return below, before, none[0], *none, *none, 1 / diagonal, slot, held
    # or the sparse factors, without the unit diagonal, by columns and by rows
    by_column = csc_matrix(factors.L)
    by_column.setdiag(0)
    by_column.eliminate_zeros()
    by_row = by_column.tocsr()
    by_row.sort_indices()
    by_column.sort_indices()
    return (
        np.zeros((0, 0)), np.zeros((0, 0)), np.argsort(factors.perm_c), by_row.indptr, by_row.indices, by_row.data,
        by_column.indptr, by_column.indices, by_column.data, 1 / factors.U.diagonal(), slot, held,
    )  # fmt: skip


def _bands(matrix: Any) -> tuple[NDArray, NDArray, NDArray]:
    """L of ``matrix = L D L^T`` below and left of its diagonal, (particles, band) each, and D, (particles,); matrix: sparse."""
    from scipy.linalg import cholesky_banded

    # the lower triangle by diagonals, as LAPACK stores bands; its Cholesky factor L D^(1/2)
    entries = matrix.tocoo()
    n, band = matrix.shape[0], int(np.abs(entries.row - entries.col).max())
    lower = entries.row >= entries.col
    packed = np.zeros((band + 1, n))
    packed[(entries.row - entries.col)[lower], entries.col[lower]] = entries.data[lower]
    packed = cholesky_banded(packed, lower=True)
    below = (packed[1:] / packed[0]).T.copy()
    # place k of row i is the entry (i, i - band + k), which lies band - k below the diagonal of column i - band + k
    before = np.zeros((n, band))
    for k in range(band):
        before[band - k :, k] = below[: n - (band - k), band - k - 1]
    return below, before, packed[0] ** 2


@kernel
def _subtract_products(y, row, starts, columns, values):
    """``y[row] -= sum_e values[e] y[columns[e]]`` over the entries of that row; y: (particles, 3 lanes)."""
    own = y[row]
    for e in range(starts[row], starts[row + 1]):
        other = y[columns[e]]
        value = values[e]
        for l in range(own.shape[0]):
            own[l] -= value * other[l]


@disjoint
def _subtract(x, y, z, entries, a, b, c):
    """Subtract ``entries`` times a, b and c from the components x, y and z, all of the same length."""
    for k in range(entries.shape[0]):
        x[k] -= entries[k] * a
        y[k] -= entries[k] * b
        z[k] -= entries[k] * c


@disjoint
def _scale(x, by):
    """``x <- x by``, (particles,)."""
    for p in range(x.shape[0]):
        x[p] *= by[p]


@uncounted
def solve_bands(below, before, inverse_diagonal, r):
    """``r <- A^-1 r`` in place with ``A = L D L^T`` as bands, r: (3, particles).

    As soon as a particle's value is known, its part is subtracted from the right sides that depend on it.
    """
    # L y = r, by columns of L
    n, band = below.shape
    for i in range(n):
        m = min(band, n - 1 - i)
        a, b, c = r[0, i], r[1, i], r[2, i]
        _subtract(r[0, i + 1 : i + 1 + m], r[1, i + 1 : i + 1 + m], r[2, i + 1 : i + 1 + m], below[i, :m], a, b, c)
    # D z = y
    for c in range(3):
        _scale(r[c], inverse_diagonal)
    # L^T x = z, by rows of L, which are the columns of L^T
    for i in range(n - 1, -1, -1):
        m = min(band, i)
        _subtract(r[0, i - m : i], r[1, i - m : i], r[2, i - m : i], before[i, band - m :], r[0, i], r[1, i], r[2, i])


@kernel
def solve(plan, r, y):
    """``r <- A^-1 r`` by two triangular solves; r: (3, particles, lanes); y: scratch of the same shape; plan: see ``prepare``."""
    below, before, order, starts, columns, values, row_starts, rows, row_values, inverse_diagonal, _, _ = plan
    n, lanes = r.shape[1], r.shape[2]
    # as bands
    if below.shape[0] > 0:
        solve_bands(below, before, inverse_diagonal, merged(r))
        return
    # sparse, forwards: L y = P r.  A particle's components and lanes are adjacent in y, so each entry of L is read once for all
    flat_y = y.reshape((n, 3 * lanes))
    for i in range(n):
        for c in range(3):
            for l in range(lanes):
                flat_y[i, c * lanes + l] = r[c, order[i], l]
        _subtract_products(flat_y, i, starts, columns, values)
    # backwards: D L^T P x = y
    for i in range(n - 1, -1, -1):
        own = flat_y[i]
        for l in range(own.shape[0]):
            own[l] *= inverse_diagonal[i]
        _subtract_products(flat_y, i, row_starts, rows, row_values)
        for c in range(3):
            for l in range(lanes):
                r[c, order[i], l] = flat_y[i, c * lanes + l]


@kernel
def factorize_held(w, slot, held, members, count, lower):
    """List the held particles S of each lane, and factorize ``A^-1_SS = lower lower^T`` (Cholesky).

    slot, held: see ``prepare``.  members: held particles, (most, lanes), ``count`` of them, (lanes,).  lower: (most, most, lanes).
    """
    # the held particles of each lane
    count[:] = 0
    for p in range(w.shape[0]):
        for l in range(w.shape[1]):
            if w[p, l] == 0 and slot[p] >= 0:
                members[count[l], l] = p
                count[l] += 1
    # the Cholesky factor of their part of A^-1, row by row
    for l in range(w.shape[1]):
        for a in range(count[l]):
            for b in range(a + 1):
                value = held[slot[members[a, l]], members[b, l]]
                for c in range(b):
                    value -= lower[a, c, l] * lower[b, c, l]
                lower[a, b, l] = np.sqrt(value) if a == b else value / lower[b, b, l]


@kernel
def keep_held(d, slot, held, members, count, lower, force):
    """``d <- d - A^-1 E_S (A^-1_SS)^-1 d_S`` for ``d = A^-1 r``: held particles S stay where they are.  d: (3, particles, lanes).

    force: scratch, the impulses on the particles that may be held, (holdable, 3, lanes).  Other arguments: see ``factorize_held``.
    """
    # the impulses that hold S: (A^-1_SS)^-1 d_S, by forward and backward substitution
    force[:] = 0
    for l in range(d.shape[2]):
        m = count[l]
        for c in range(3):
            for a in range(m):
                value = d[c, members[a, l], l]
                for b in range(a):
                    value -= lower[a, b, l] * force[slot[members[b, l]], c, l]
                force[slot[members[a, l]], c, l] = value / lower[a, a, l]
            for a in range(m - 1, -1, -1):
                value = force[slot[members[a, l]], c, l]
                for b in range(a + 1, m):
                    value -= lower[b, a, l] * force[slot[members[b, l]], c, l]
                force[slot[members[a, l]], c, l] = value / lower[a, a, l]
    # subtract the displacements that they cause
    for k in range(held.shape[0]):
        nonzero = False
        for c in range(3):
            for l in range(d.shape[2]):
                nonzero |= force[k, c, l] != 0
        if nonzero:
            for c in range(3):
                for p in range(d.shape[1]):
                    share = held[k, p]
                    for l in range(d.shape[2]):
                        d[c, p, l] -= share * force[k, c, l]
    # zero up to rounding so far: now exactly
    for l in range(d.shape[2]):
        for a in range(count[l]):
            for c in range(3):
                d[c, members[a, l], l] = 0


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """From ``v = v*``, ``iterations`` times ``v <- v + A^-1 (h f(x + h v, v) - M (v - v*))``; then ``x <- x + h v``.

    ``total`` is ``v - v*``.  Arguments, shapes and units are those of ``integrators.base``.
    """
    slot, held = plan[10], plan[11]
    n, lanes = x.shape[1], x.shape[2]
    iterations = options[0]
    start, total, r, y = work.fields[0], work.fields[1], work.fields[2], work.fields[3]
    # the particles that are held now, and the factor with which their part of A^-1 is inverted
    most = 0
    for l in range(lanes):
        own = 0
        for p in range(n):
            own += 1 if w[p, l] == 0 else 0
        most = max(most, own)
    members, count = np.empty((most, lanes), np.int64), np.empty(lanes, np.int64)
    lower, force = np.empty((most, most, lanes), x.dtype), np.empty((held.shape[0], 3, lanes), x.dtype)
    factorize_held(w, slot, held, members, count, lower)
    # v*
    predict_velocities(v, w, push, gravity, drag_rate, h, work)
    copy_to(start, x)
    total[:] = 0
    for _ in range(iterations):
        # the residual at the end of the substep as found so far
        extrapolate(x, v, start, h)
        r[:] = 0
        add_spring_forces(x, v, r, elements, elastic, work.scratch)
        add_bend_forces(x, v, r, elements, elastic, work.scratch)
        euler_residual(w, total, r, h)
        # the global step, with the held particles in place
        solve(plan, r, y)
        keep_held(r, slot, held, members, count, lower, force)
        advance(v, r, work.remainders[1], x.dtype.type(1))
        add_to(total, r)
    # positions with the new velocities
    copy_to(x, start)
    advance(x, v, work.remainders[0], h)


PROJECTIVE_DYNAMICS = Integrator(
    "projective_dynamics",
    color="#12a5a5",
    order=1,
    cost="a force pass and two triangular solves for each iteration",
    damping="implicitly, in the matrix and in each iteration's forces",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    options=MappingProxyType({"iterations": 10}),
    fields=4,
    prepare=prepare,
    shared=frozenset({"density", "stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time"}),
)

"""Projective dynamics: Liu, Bargteil, O'Brien and Kavan 2013, Fast simulation of mass-spring systems.

The backward Euler equations ``M (v - v*) = h f(x + h v, v)`` are solved by ``iterations`` of a local and a global step.  Put
together these are a descent with a matrix that never changes, ``A = M + (h^2 + h tau) sum k (e_i - e_j)(e_i - e_j)^T`` (their eq.
14; Liu, Bouaziz and Kavan 2017 read it that way): evaluate what is left of the equations, solve with A, add.  So the forces are
those of all other integrators, dampers along springs and hinges included, and the fixed point is theirs of backward Euler; A only
says how fast it is reached.  What bends enters A as the quadratic model.

A is factorised once, at set-up, and shared by all lanes: figures that enter it must be the same in all environments.  Which
particles are held may differ, and change in every step: with S the held ones, ``d = A^-1 (r - E_S (A^-1_SS)^-1 (A^-1 r)_S)``
leaves them where they are exactly, from columns of A^-1 that are kept for those that can be held.

Order 1, where the iterations suffice.  Cost: a force pass and two triangular solves an iteration.  Never unstable; too few
iterations make it sluggish.  A mode of frequency w keeps 1/sqrt(1 + (h w)^2) of its amplitude a substep.  Damping along springs
enters implicitly.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel, uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, add_spring_forces, largest_frequency
from clothgym.integrators import implicit_euler
from clothgym.integrators.base import Integrator, Preparation, add_to, copy_to, move_on, predict_velocities, weigh

# h w of the stiffest mode up to which ten iterations come near enough to the fixed point (see docs/physics.md)
STIFFEST = 4.0


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """Backward Euler's, but no more than where ``h w`` of the stiffest mode reaches 4."""
    swinging, why = implicit_euler.largest_substep(o)
    stiff = STIFFEST / largest_frequency(o)
    if swinging < stiff:
        return swinging, why
    return stiff, "beyond it some ten iterations leave the sheet sluggish (it is never unstable)"


def surely_allowed(o: Oscillators) -> float:
    """Any, as for backward Euler."""
    return float("inf")


def prepare(preparation: Preparation) -> tuple[NDArray, ...]:
    """Factors of A, and the columns of A^-1 of those that can be held.

    Where one sheet's particles lie side by side, ``A = L D L^T`` in their order, as bands: their rows are few enough.  Elsewhere
    ``P A P^T = L D L^T``, sparse, with an order that leaves few entries.

    Returns:
        below: entries of L below each diagonal, (particles, band), or none; and before: those left of it.
        order: particle of each row, (particles,).
        starts, columns, values: L without its diagonal by rows; and rows_starts, rows, rows_values: by columns.
        inverse_diagonal: of D, (particles,).
        slot: column of ``held`` that a particle has, or -1, (particles,).
        held: columns of A^-1, (holdable, particles).
    """
    from scipy.sparse import coo_matrix, csc_matrix, diags  # imported here: they would double the time of a warm start
    from scipy.sparse.linalg import splu

    o, h, holdable, by_particle = preparation
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
    unit = np.zeros((n, len(holdable)))
    unit[holdable, np.arange(len(holdable))] = 1
    slot = np.full(n, -1, np.int64)
    slot[holdable] = np.arange(len(holdable))
    held = factors.solve(unit).T.copy()
    if by_particle:
        none = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
        below, before, diagonal = _bands(matrix)
        return below, before, none[0], *none, *none, 1 / diagonal, slot, held
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
    """L of ``L D L^T`` below and left of its diagonal, (particles, band) each, and D, (particles,); matrix: sparse."""
    from scipy.linalg import cholesky_banded

    entries = matrix.tocoo()
    n, band = matrix.shape[0], int(np.abs(entries.row - entries.col).max())
    lower = entries.row >= entries.col
    packed = np.zeros((band + 1, n))
    packed[(entries.row - entries.col)[lower], entries.col[lower]] = entries.data[lower]
    packed = cholesky_banded(packed, lower=True)
    below = (packed[1:] / packed[0]).T.copy()
    # row i has the entry (i, i - band + k) at k: from column i - band + k, band - k below its diagonal
    before = np.zeros((n, band))
    for k in range(band):
        before[band - k :, k] = below[: n - (band - k), band - k - 1]
    return below, before, packed[0] ** 2


@kernel
def _subtract_products(y, row, starts, columns, values):
    """``y[row] -= sum values y[columns]``; y: (particles, 3 lanes)."""
    own = y[row]
    for e in range(starts[row], starts[row + 1]):
        other = y[columns[e]]
        value = values[e]
        for l in range(own.shape[0]):
            own[l] -= value * other[l]


@disjoint
def _subtract(x, y, z, entries, a, b, c):
    """Take a row or column of entries times a, b and c from the components x, y and z."""
    for k in range(entries.shape[0]):
        x[k] -= entries[k] * a
        y[k] -= entries[k] * b
        z[k] -= entries[k] * c


@disjoint
def _scale(x, by):
    for p in range(x.shape[0]):
        x[p] *= by[p]


@uncounted
def solve_bands(below, before, inverse_diagonal, r):
    """``r <- A^-1 r`` in place, (3, particles): as soon as a particle is solved it is taken from those that depend on it."""
    n, band = below.shape
    for i in range(n):
        m = min(band, n - 1 - i)
        a, b, c = r[0, i], r[1, i], r[2, i]
        _subtract(r[0, i + 1 : i + 1 + m], r[1, i + 1 : i + 1 + m], r[2, i + 1 : i + 1 + m], below[i, :m], a, b, c)
    for c in range(3):
        _scale(r[c], inverse_diagonal)
    for i in range(n - 1, -1, -1):
        m = min(band, i)
        _subtract(r[0, i - m : i], r[1, i - m : i], r[2, i - m : i], before[i, band - m :], r[0, i], r[1, i], r[2, i])


@kernel
def solve(plan, r, y):
    """``r <- A^-1 r`` by two triangular solves, r: (3, particles, lanes); y: scratch of the same size."""
    below, before, order, starts, columns, values, row_starts, rows, row_values, inverse_diagonal, _, _ = plan
    n, lanes = r.shape[1], r.shape[2]
    if below.shape[0] > 0:
        solve_bands(below, before, inverse_diagonal, r.reshape((3, n)))
        return
    # a particle's components and lanes lie side by side here: each value of L is read once for all of them
    flat_y = y.reshape((n, 3 * lanes))
    for i in range(n):
        for c in range(3):
            for l in range(lanes):
                flat_y[i, c * lanes + l] = r[c, order[i], l]
        _subtract_products(flat_y, i, starts, columns, values)
    for i in range(n - 1, -1, -1):
        own = flat_y[i]
        for l in range(own.shape[0]):
            own[l] *= inverse_diagonal[i]
        _subtract_products(flat_y, i, row_starts, rows, row_values)
        for c in range(3):
            for l in range(lanes):
                r[c, order[i], l] = flat_y[i, c * lanes + l]


@kernel
def factorise_held(w, slot, held, members, count, lower):
    """List the held particles of each lane, and factorise their part of A^-1 (Cholesky): held, (holdable, particles)."""
    count[:] = 0
    for p in range(w.shape[0]):
        for l in range(w.shape[1]):
            if w[p, l] == 0 and slot[p] >= 0:
                members[count[l], l] = p
                count[l] += 1
    for l in range(w.shape[1]):
        for a in range(count[l]):
            for b in range(a + 1):
                value = held[slot[members[a, l]], members[b, l]]
                for c in range(b):
                    value -= lower[a, c, l] * lower[b, c, l]
                lower[a, b, l] = np.sqrt(value) if a == b else value / lower[b, b, l]


@kernel
def keep_held(d, slot, held, members, count, lower, force):
    """Take from ``d = A^-1 r`` what the held particles' own forces do, so that they stay: (3, particles, lanes)."""
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
    for k in range(held.shape[0]):
        anyone = False
        for c in range(3):
            for l in range(d.shape[2]):
                anyone |= force[k, c, l] != 0
        if anyone:
            for c in range(3):
                for p in range(d.shape[1]):
                    share = held[k, p]
                    for l in range(d.shape[2]):
                        d[c, p, l] -= share * force[k, c, l]
    for l in range(d.shape[2]):
        for a in range(count[l]):
            for c in range(3):
                d[c, members[a, l], l] = 0


@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    slot, held = plan[10], plan[11]
    n, lanes = x.shape[1], x.shape[2]
    iterations = options[0]
    start, total, r, y = work.fields[0], work.fields[1], work.fields[2], work.fields[3]
    most = 0
    for l in range(lanes):
        own = 0
        for p in range(n):
            own += 1 if w[p, l] == 0 else 0
        most = max(most, own)
    members, count = np.empty((most, lanes), np.int64), np.empty(lanes, np.int64)
    lower, force = np.empty((most, most, lanes), x.dtype), np.empty((held.shape[0], 3, lanes), x.dtype)
    factorise_held(w, slot, held, members, count, lower)
    predict_velocities(v, w, push, gravity, drag_rate, h)
    copy_to(start, x)
    total[:] = 0
    for _ in range(iterations):
        move_on(x, v, start, h)
        r[:] = 0
        add_spring_forces(x, v, r, elements, elastic, work.scratch)
        add_bend_forces(x, v, r, elements, elastic, work.scratch)
        weigh(w, total, r, h)
        solve(plan, r, y)
        keep_held(r, slot, held, members, count, lower, force)
        add_to(v, r)
        add_to(total, r)
    move_on(x, v, start, h)


PROJECTIVE_DYNAMICS = Integrator(
    "projective_dynamics",
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

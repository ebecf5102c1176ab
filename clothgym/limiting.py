"""Floor 4: strain limiting.  After each substep, structural and shear springs beyond a threshold are shortened to it.

Provot 1995, Deformation constraints in a mass-spring model to describe rigid cloth behavior.

A sweep visits the springs.  If one is too long, two free ends move by equal amounts, a single free end moves alone, and two held
ends stay.  One sweep is not enough, because each correction stretches the neighbors.  Sweeps continue until no spring exceeds the
threshold by more than ``TOLERANCE``, or ``SWEEPS`` are done.  The remaining strain is reported at the end of the control step,
after contact.  In the same visit, an impulse stops the ends of a spring at its limit from separating.  This can only remove kinetic
energy.

Particles on the border of a sheet have smaller masses than inner ones.  Equal displacements of unequal masses shift the center of
mass and slow the rotation of a free sheet.  This is Provot's rule, not a law of mechanics.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel, merged, placeholder, specialize
from clothgym.checks import positive
from clothgym.mesh import SHEAR

TOLERANCE = 0.005  # strain beyond the threshold at which the sweeps end
SWEEPS = 100  # at most, in a substep
# rows of a report
BEFORE, AFTER, USED = 0, 1, 2

largest_strain = placeholder(
    "largest_strain",
    "of (x, topology, size, largest): writes the largest strain of the structural and shear springs in each lane, (lanes,)",
)


def checked_limit(value: float | None) -> float | None:
    """A limit on strain, or None.

    Raises:
        ValueError: a value that is not positive, or above 1, as a percentage would be.
    """
    if value is None:
        return None
    if isinstance(value, (bool, np.bool_)) or positive("strain_limit", value) > 1:
        raise ValueError(f"strain_limit={value!r}: must be above 0 and at most 1; 10 % is 0.1")
    return float(value)


class Limiting(NamedTuple):
    """What strain limiting did in the last control step, (num_envs,) each.

    before: largest strain before limiting.  after: largest strain at the end of the control step.  sweeps: most in one substep.
    """

    before: NDArray
    after: NDArray
    sweeps: NDArray


def _limit_strain(x, v, w, topology, size, limit, report):
    """Shorten springs longer than ``1 + limit`` rest lengths to that length, in place.

    x [m], v [m/s]: (3, particles, lanes).  w [1/kg]: (particles, lanes).  topology: see ``elements.Topology``.  size: see
    ``elements.Elastic``.  report: rows BEFORE, AFTER and USED, (3, lanes).  BEFORE and USED keep the largest values of the control
    step.
    """
    lanes = x.shape[2]
    largest = np.empty(lanes, x.dtype)
    enough = x.dtype.type(limit + TOLERANCE)
    for sweep in range(SWEEPS + 1):
        largest_strain(x, topology, size, largest)
        # stop when all lanes are within the tolerance, or no sweep is left
        going = False
        for l in range(lanes):
            going |= largest[l] > enough
            report[AFTER, l] = largest[l]
            if sweep == 0:
                report[BEFORE, l] = max(report[BEFORE, l], largest[l])
        if not going or sweep == SWEEPS:
            return
        # one more sweep, over the lanes that need it
        for l in range(lanes):
            if largest[l] > enough:
                report[USED, l] = max(report[USED, l], x.dtype.type(sweep + 1))
        _sweep_springs(x, v, w, topology.springs, size, x.dtype.type(limit), enough, largest)


def _measure_strain(x, topology, size, report):
    """Report the largest strain at the end of a control step.  Contact comes before and ignores the limit."""
    largest_strain(x, topology, size, report[AFTER])


@disjoint
def _raise_to_stretch(x, y, z, o, weight, inverse, out):
    """``out <- max(out, |d|^2/r^2)`` for the springs of one kind on a grid, at their first ends, (particles,).

    x, y, z: components of positions, (particles,).  o: the kind's offset.  inverse: ``1/r^2`` [1/m^2].
    """
    x1, y1, z1, zero = x[o:], y[o:], z[o:], x.dtype.type(0)
    for p in range(x1.shape[0]):
        dx, dy, dz = x1[p] - x[p], y1[p] - y[p], z1[p] - z[p]
        square = (dx * dx + dy * dy + dz * dz) * inverse if weight[p] > zero else zero
        out[p] = max(out[p], square)


@kernel
def _largest_on_grid(x, topology, size, largest):
    """The largest strain of a grid's structural and shear springs, (1,); x: (3, particles, 1)."""
    offset, kind, rest_length, weight, _, _, _ = topology.elements
    # the largest squared stretch at each particle, kind by kind
    one, n = x.dtype.type(1), x.shape[1]
    r, out = merged(x), np.zeros(n, x.dtype)
    for a in range(weight.shape[0]):
        if kind[a] <= SHEAR:
            _raise_to_stretch(r[0], r[1], r[2], offset[a], weight[a], one / (rest_length[a] * rest_length[a]), out)
    # the largest of all, as a strain
    largest[0] = 0
    for p in range(n):
        largest[0] = max(largest[0], out[p])
    largest[0] = np.sqrt(largest[0]) / size[0] - one


@kernel
def _largest_in_lanes(x, topology, size, largest):
    """The largest strain of the structural and shear springs, (lanes,); x: (3, particles, lanes)."""
    # the largest squared stretch
    ends, rest_length, kind, _ = topology.springs
    one = x.dtype.type(1)
    largest[:] = 0
    for s in range(ends.shape[0]):
        if kind[s] > SHEAR:
            continue
        i, j = ends[s, 0], ends[s, 1]
        inverse = one / (rest_length[s] * rest_length[s])
        for l in range(x.shape[2]):
            dx, dy, dz = x[0, j, l] - x[0, i, l], x[1, j, l] - x[1, i, l], x[2, j, l] - x[2, i, l]
            largest[l] = max(largest[l], (dx * dx + dy * dy + dz * dz) * inverse)
    # as a strain
    for l in range(x.shape[2]):
        largest[l] = np.sqrt(largest[l]) / size[l] - one


@kernel
def _sweep_springs(x, v, w, springs, size, limit, enough, largest):
    """Visit each structural and shear spring, in the lanes whose largest strain exceeds ``enough``.

    With direction n from i to j and greatest length L, ``x_i <- x_i + s (|d| - L) n`` and ``x_j <- x_j - (1 - s) (|d| - L) n``.
    If both ends are free, s is 1/2 (Provot 1995).  Then both ends get the impulse ``max(n . (v_j - v_i), 0)/(w_i + w_j)`` along n,
    with opposite signs.
    """
    ends, rest_length, kind, _ = springs
    one, zero, half = x.dtype.type(1), x.dtype.type(0), x.dtype.type(0.5)
    for s in range(ends.shape[0]):
        if kind[s] > SHEAR:
            continue
        i, j = ends[s, 0], ends[s, 1]
        wi, wj = w[i], w[j]
        unscaled = (one + limit) * rest_length[s]
        for l in range(x.shape[2]):
            dx, dy, dz = x[0, j, l] - x[0, i, l], x[1, j, l] - x[1, i, l], x[2, j, l] - x[2, i, l]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            mobile, longest = wi[l] + wj[l], unscaled * size[l]
            if largest[l] > enough and length >= longest and mobile > zero:
                # positions: back to the greatest length
                nx, ny, nz = dx / length, dy / length, dz / length
                excess = length - longest
                own = half if wi[l] > zero and wj[l] > zero else (one if wi[l] > zero else zero)
                first, second = own * excess, (one - own) * excess
                x[0, i, l] += first * nx
                x[1, i, l] += first * ny
                x[2, i, l] += first * nz
                x[0, j, l] -= second * nx
                x[1, j, l] -= second * ny
                x[2, j, l] -= second * nz
                # velocities: the ends do not move apart
                parting = (v[0, j, l] - v[0, i, l]) * nx + (v[1, j, l] - v[1, i, l]) * ny + (v[2, j, l] - v[2, i, l]) * nz
                impulse = max(parting, zero) / mobile
                v[0, i, l] += wi[l] * impulse * nx
                v[1, i, l] += wi[l] * impulse * ny
                v[2, i, l] += wi[l] * impulse * nz
                v[0, j, l] -= wj[l] * impulse * nx
                v[1, j, l] -= wj[l] * impulse * ny
                v[2, j, l] -= wj[l] * impulse * nz


@kernel
def no_limit(x, v, w, topology, size, limit, report):
    """No limit: the springs stay as they are."""


@kernel
def no_measure(x, topology, size, report):
    """No limit: nothing is measured."""


@cache
def kernels_of(limits: bool, layout: str) -> dict[str, Any]:
    """The limiter's kernels, under the names that the main loop uses.

    limits: whether there is a limit.  layout: see ``layout.Layout``.
    """
    if not limits:
        return {"limit_strain": no_limit, "measure_strain": no_measure}
    largest, which = (_largest_on_grid, "on_grid") if layout == "grid" else (_largest_in_lanes, "in_lanes")
    return {
        "limit_strain": specialize(_limit_strain, f"limit_strain_{which}", apart=True, largest_strain=largest),
        "measure_strain": specialize(_measure_strain, f"measure_strain_{which}", apart=True, largest_strain=largest),
    }

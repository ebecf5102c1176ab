"""Floor 3: forces on one block of lanes, and what they say about the largest stable step.

In all kernels ``x``: positions [m] and ``v``: velocities [m/s] are (particles, 3, lanes); loops over lanes are innermost.
Two simple loops through a small scratch row beat one loop that reads and writes: LLVM tests every pair of rows of a loop
for overlap at run time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.mesh import ClothMesh
from clothgym.state import State

POWER_STEPS = 16


@kernel
def add_spring_forces(x, v, f, springs, stiffness, damping_time, row):
    """Add Hooke's force and the damper's along each spring to ``f`` [N], (particles, 3, lanes).

    On the first end, with d the vector to the second, u its velocity, r the rest length and tau the damping time:
    ``f = k ((1 - r/|d|) + tau (u . d)/|d|^2) d``.  stiffness: k [N/m], (kinds, lanes); damping_time [s], (lanes,);
    row: scratch, (3, lanes).
    """
    if x.shape[2] == 1:
        _add_spring_forces_of_one(x[:, :, 0], v[:, :, 0], f[:, :, 0], springs, stiffness[:, 0], damping_time[0])
        return
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    lanes = x.shape[2]
    # components and lanes of a particle lie side by side: one loop adds all three
    flat = f.reshape((x.shape[0], 3 * lanes))
    force = row.reshape(3 * lanes)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        xi, xj, vi, vj, fi, fj = x[i], x[j], v[i], v[j], flat[i], flat[j]
        k = stiffness[kind[s]]
        share = weight[s]
        r = rest_length[s]
        for l in range(lanes):
            dx = xj[0, l] - xi[0, l]
            dy = xj[1, l] - xi[1, l]
            dz = xj[2, l] - xi[2, l]
            ux = vj[0, l] - vi[0, l]
            uy = vj[1, l] - vi[1, l]
            uz = vj[2, l] - vi[2, l]
            q = one / np.sqrt(dx * dx + dy * dy + dz * dz)
            g = share * k[l] * ((one - r * q) + damping_time[l] * (ux * dx + uy * dy + uz * dz) * q * q)
            row[0, l] = g * dx
            row[1, l] = g * dy
            row[2, l] = g * dz
        for e in range(3 * lanes):
            fi[e] += force[e]
        for e in range(3 * lanes):
            fj[e] -= force[e]


@kernel
def _add_spring_forces_of_one(x, v, f, springs, stiffness, damping_time):
    """The same arithmetic on a single environment, (particles, 3), in less than half the time: no loops of one round."""
    ends, rest_length, kind, weight = springs
    one = x.dtype.type(1)
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        r = rest_length[s]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        ux, uy, uz = v[j, 0] - v[i, 0], v[j, 1] - v[i, 1], v[j, 2] - v[i, 2]
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz)
        g = weight[s] * stiffness[kind[s]] * ((one - r * q) + damping_time * (ux * dx + uy * dy + uz * dz) * q * q)
        fx, fy, fz = g * dx, g * dy, g * dz
        f[i, 0] += fx
        f[i, 1] += fy
        f[i, 2] += fz
        f[j, 0] -= fx
        f[j, 1] -= fy
        f[j, 2] -= fz


@kernel
def add_air_forces(x, v, f, surface, resistance, wind, row):
    """Add the air's force on each triangle to ``f`` [N], (particles, 3, lanes).

    With A the area, n the normal and u the wind relative to the triangle:
    ``rho/2 A |u| (C_D (u . n) n + C_F (u - (u . n) n))``.  Face on that is the drag ``rho/2 C_D A u^2``; at an angle the part
    across the wind is lift, of coefficient ``(C_D - C_F) sin cos`` as of a flat plate that has stalled (Hoerner, Fluid-Dynamic
    Drag, 1965, 3-15).  resistance: ``rho C_D/2`` and ``rho C_F/2`` [kg/m^3], (2, lanes); wind [m/s], (3, lanes); row: scratch,
    (3, lanes).
    """
    triangles, shares = surface
    half = x.dtype.type(0.5)
    tiny = x.dtype.type(1e-18)
    one = x.dtype.type(1)
    lanes = x.shape[2]
    across, along = resistance[0], resistance[1]
    flat = f.reshape((x.shape[0], 3 * lanes))
    force = row.reshape(3 * lanes)
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = shares[t, 0], shares[t, 1], shares[t, 2]
        xi, xj, xk, vi, vj, vk = x[i], x[j], x[k], v[i], v[j], v[k]
        for l in range(lanes):
            px, py, pz = xj[0, l] - xi[0, l], xj[1, l] - xi[1, l], xj[2, l] - xi[2, l]
            qx, qy, qz = xk[0, l] - xi[0, l], xk[1, l] - xi[1, l], xk[2, l] - xi[2, l]
            # normal times twice the area
            nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
            ux = wind[0, l] - (a * vi[0, l] + b * vj[0, l] + c * vk[0, l])
            uy = wind[1, l] - (a * vi[1, l] + b * vj[1, l] + c * vk[1, l])
            uz = wind[2, l] - (a * vi[2, l] + b * vj[2, l] + c * vk[2, l])
            n2 = nx * nx + ny * ny + nz * nz + tiny
            speed = np.sqrt(ux * ux + uy * uy + uz * uz)
            twice = np.sqrt(n2)
            skin = half * speed * along[l] * twice
            face = half * speed * (across[l] - along[l]) * (ux * nx + uy * ny + uz * nz) * (one / twice)
            row[0, l] = face * nx + skin * ux
            row[1, l] = face * ny + skin * uy
            row[2, l] = face * nz + skin * uz
        for corner in range(3):
            fp = flat[triangles[t, corner]]
            share = shares[t, corner]
            for e in range(3 * lanes):
                fp[e] += share * force[e]


def largest_frequency(mesh: ClothMesh, stiffness: NDArray, inverse_mass: NDArray) -> float:
    """Largest angular frequency of the sheet at rest [rad/s]: the root of the largest eigenvalue of M^-1 K.

    K is assembled from all springs, ``k n n^T`` each.  One spring's ``sqrt(k/m)`` is not enough: the neighbours add up.
    stiffness: by kind [N/m], (kinds,).  inverse_mass [1/kg], (particles,).
    """
    from scipy.sparse import coo_matrix, csr_matrix  # imported here: it would double the time of a warm start
    from scipy.sparse.linalg import eigsh

    springs = mesh.springs
    i, j = springs.particles.T
    rows = np.arange(len(i))
    n = (mesh.rest_positions[j] - mesh.rest_positions[i]) / springs.rest_length[:, None]
    root = np.sqrt(springs.weight * stiffness[springs.kind])[:, None] * n
    # M^-1/2 K M^-1/2 = B^T B, one row of B a spring
    scale = np.sqrt(inverse_mass)
    values = np.concatenate([(root * scale[j, None]).T.ravel(), (-root * scale[i, None]).T.ravel()])
    columns = np.concatenate([*(3 * j + c for c in range(3)), *(3 * i + c for c in range(3))])
    b = csr_matrix(coo_matrix((values, (np.tile(rows, 6), columns)), shape=(len(i), 3 * len(scale))))
    gram = b.T @ b
    # a fixed start vector: the same bound in every process
    start = np.random.default_rng(0).normal(size=gram.shape[0])
    return float(np.sqrt(eigsh(gram, k=1, which="LM", v0=start, tol=1e-4, return_eigenvectors=False)[0]))


def frequency_bound(mesh: ClothMesh, stiffness: NDArray, inverse_mass: NDArray) -> float:
    """An upper bound on ``largest_frequency`` [rad/s], some tenth above it, in a fraction of the time and without scipy.

    With A the magnitudes of M^-1 K, no eigenvalue exceeds the largest ``(A y)/y`` for any positive y (Collatz and Wielandt);
    a few steps of the power method make y a good one.  Arguments as there.
    """
    springs = mesh.springs
    i, j = springs.particles.T
    n = (mesh.rest_positions[j] - mesh.rest_positions[i]) / springs.rest_length[:, None]
    blocks = (springs.weight * stiffness[springs.kind])[:, None, None] * n[:, :, None] * n[:, None, :]
    own = np.zeros((mesh.num_particles, 3, 3))
    for end in (i, j):
        np.add.at(own, end, blocks)
    own, blocks = np.abs(own), np.abs(blocks)
    y = np.ones((mesh.num_particles, 3))
    bound = np.inf
    for _ in range(POWER_STEPS):
        z = np.einsum("pab,pb->pa", own, y)
        for end, other in ((i, j), (j, i)):
            np.add.at(z, end, np.einsum("sab,sb->sa", blocks, y[other]))
        z = z * inverse_mass[:, None] + 1e-9 * y  # stays positive in directions that no spring has
        bound = min(bound, float(np.max(z / y)))
        y = z / z.max()
    return float(np.sqrt(bound))


class Energy(NamedTuple):
    """Energies [J], (num_envs,) each; gravity's is zero at the origin."""

    kinetic: NDArray
    elastic: NDArray
    gravity: NDArray

    @property
    def total(self) -> NDArray:
        return self.kinetic + self.elastic + self.gravity


def energy(mesh: ClothMesh, state: State) -> Energy:
    """Kinetic, elastic and gravitational energy of each environment, in float64."""
    springs = mesh.springs
    x, v = state.positions.astype(np.float64), state.velocities.astype(np.float64)
    mass = 1 / state.free_inverse_mass.astype(np.float64)
    ends = x[:, springs.particles]
    stretch = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) - springs.rest_length
    k = springs.weight * state.stiffness.astype(np.float64)[:, springs.kind]
    return Energy(
        kinetic=np.sum(mass * np.sum(v**2, axis=2), axis=1) / 2,
        elastic=np.sum(k * stretch**2, axis=1) / 2,
        gravity=-np.einsum("ep,epc,ec->e", mass, x, state.gravity.astype(np.float64)),
    )

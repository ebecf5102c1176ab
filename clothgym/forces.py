"""Floor 3: forces on one block of lanes, and the largest frequency that follows from them.

In all kernels ``x`` stands for positions [m] and ``v`` for velocities [m/s], (3, particles, lanes).  Loops over lanes are
innermost.  For a grid whose particles are adjacent in memory the same forces are in ``grid_forces``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, inlined, merged, placeholder, uncounted
from clothgym.bending import Bending
from clothgym.elements import Elements
from clothgym.mesh import SHEAR, ClothMesh
from clothgym.state import State

POWER_STEPS = 16  # of the power method in ``frequency_bound``
TINY = 1e-30  # added to a spring's squared length [m^2]: a spring of length zero, as in a folded sheet, exerts no force

# what integrators, attachments and the main loop call; ``grid_forces.kernels_of`` tells which kernels stand for the names
add_spring_forces = placeholder(
    "add_spring_forces", "of (x, v, f, elements, elastic, scratch): adds the springs' and their dampers' forces to f [N]"
)
set_spring_forces = placeholder(
    "set_spring_forces", "of (x, v, start, f, elements, elastic, scratch): sets f to start and those forces [N]"
)
add_spring_products = placeholder(
    "add_spring_products",
    "of (x, p, y, elements, size, along, across, bend, scratch): adds the springs' stiffness matrix times p to y",
)
add_air_forces = placeholder(
    "add_air_forces", "of (x, v, f, surface, resistance, wind, interval, scratch): adds the air's force on each triangle to f [N]"
)


@disjoint
def _pull(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, k, share, r, size, tau, fi, gi, hi, fj, gj, hj):
    """Add one spring's force to both its ends, in lanes; all arrays (lanes,).

    xi ... zj: components of positions [m]; ui ... wj: of velocities [m/s]; fi ... hj: of forces [N].  k: stiffness of the kind
    [N/m]; share: the spring's weight; r: rest length of the mesh [m]; size: factor on it; tau: damping time [s].
    """
    one, tiny = xi.dtype.type(1), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = uj[l] - ui[l], vj[l] - vi[l], wj[l] - wi[l]
        # f = g d, with q = 1/|d|
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        g = share * k[l] * ((one - r * size[l] * q) + tau[l] * (ux * dx + uy * dy + uz * dz) * q * q)
        fx, fy, fz = g * dx, g * dy, g * dz
        fi[l] += fx
        gi[l] += fy
        hi[l] += fz
        fj[l] -= fx
        gj[l] -= fy
        hj[l] -= fz


@uncounted
def add_lane_forces(x, v, f, elements, elastic, scratch):
    """Add the force of each spring and of its damper to ``f`` [N], (3, particles, lanes).

    ``f_i = k ((1 - r/|d|) + tau (u . d)/|d|^2) d`` and ``f_j = -f_i``: Hooke's law, and a Kelvin-Voigt damper along the spring.  d
    is the vector from the first end i to the second end j, u its rate of change, r the rest length, that of the mesh times
    ``elastic.size``, and tau the damping time.
    The stiffness k [N/m] is the spring's weight times the row of its kind in ``elastic.stiffness``, (kinds, lanes).
    """
    # spring by spring, each in all lanes
    stiffness, damping_time, size = elastic.stiffness, elastic.damping_time, elastic.size
    ends, rest_length, kind, weight = elements.springs
    x0, x1, x2, v0, v1, v2, f0, f1, f2 = x[0], x[1], x[2], v[0], v[1], v[2], f[0], f[1], f[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _pull(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], v0[i], v1[i], v2[i], v0[j], v1[j], v2[j], stiffness[kind[s]], weight[s],
            rest_length[s], size, damping_time, f0[i], f1[i], f2[i], f0[j], f1[j], f2[j],
        )  # fmt: skip


@uncounted
def set_lane_forces(x, v, start, f, elements, elastic, scratch):
    """``f`` is ``start`` plus the forces of ``add_lane_forces`` [N]; start, f: (3, particles, lanes)."""
    copy(merged(merged(start)), merged(merged(f)))
    add_lane_forces(x, v, f, elements, elastic, scratch)


@disjoint
def copy(start, f):
    """``f <- start``, flat arrays."""
    for e in range(f.shape[0]):
        f[e] = start[e]


@disjoint
def _multiply(xi, yi, zi, xj, yj, zj, ui, vi, wi, uj, vj, wj, along, across, share, r, size, fi, gi, hi, fj, gj, hj):
    """One spring's part of ``add_spring_products``, in lanes; all arrays (lanes,).

    xi ... zj: components of positions [m]; ui ... wj: of the vector p; fi ... hj: of the result.  share: the spring's weight.
    r, size: see ``_pull``.
    """
    one, zero, tiny = xi.dtype.type(1), xi.dtype.type(0), xi.dtype.type(TINY)
    for l in range(xi.shape[0]):
        dx, dy, dz = xj[l] - xi[l], yj[l] - yi[l], zj[l] - zi[l]
        ux, uy, uz = uj[l] - ui[l], vj[l] - vi[l], wj[l] - wi[l]
        # across the spring: nothing where it is compressed
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        stretched = one - r * size[l] * q
        aside = share * across[l] * (stretched if stretched > zero else zero)
        # (along - aside) n n^T u + aside u
        g = (share * along[l] - aside) * (ux * dx + uy * dy + uz * dz) * q * q
        fx, fy, fz = g * dx + aside * ux, g * dy + aside * uy, g * dz + aside * uz
        fi[l] -= fx
        gi[l] -= fy
        hi[l] -= fz
        fj[l] += fx
        gj[l] += fy
        hj[l] += fz


@uncounted
def add_lane_products(x, p, y, elements, size, along, across, bend, scratch):
    """``y <- y + K p`` with the springs' stiffness matrix K, scaled separately along and across each spring; (3, particles, lanes).

    A spring's block of K is ``along n n^T + across max(1 - r/|d|, 0) (I - n n^T)``, with d the vector between its ends, r the rest
    length, and ``n = d/|d|``.  The second term is left out for compressed springs, so that K has no negative eigenvalue (Choi and
    Ko 2002).  along, across: coefficients by kind, which the spring's weight multiplies, (kinds, lanes).  bend: not used here; see
    ``grid_forces.add_grid_products``.
    """
    ends, rest_length, kind, weight = elements.springs
    x0, x1, x2, p0, p1, p2, y0, y1, y2 = x[0], x[1], x[2], p[0], p[1], p[2], y[0], y[1], y[2]
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        _multiply(
            x0[i], x1[i], x2[i], x0[j], x1[j], x2[j], p0[i], p1[i], p2[i], p0[j], p1[j], p2[j], along[kind[s]], across[kind[s]],
            weight[s], rest_length[s], size, y0[i], y1[i], y2[i], y0[j], y1[j], y2[j],
        )  # fmt: skip


@inlined
def most_air(across, along, density, interval, tiny):
    """What ``A |u|`` of a triangle of unit area at rest may be at most in its air force, see ``add_lane_air_forces`` [m/s]."""
    return density / max(max(across, along) * interval, tiny)


@uncounted
def add_lane_air_forces(x, v, f, surface, resistance, wind, interval, scratch):
    """Add the air's force on each triangle to ``f`` [N], (3, particles, lanes).

    ``F = rho/2 A |u| (C_D (u . n) n + C_F (u - (u . n) n))``, with the area A, the unit normal n, and the wind u relative to the
    triangle.  Face on to the wind this is the drag ``rho/2 C_D A u^2``.  At an angle the component across the wind is lift, with
    the coefficient ``(C_D - C_F) sin cos`` of a stalled flat plate (Hoerner 1965, Fluid-Dynamic Drag, 3-15).

    The force stands for an interval dt [s].  In it the air stops the sheet relative to the wind at most: with the mass per area
    ``rho_s`` and the area ``A_0`` at rest, ``A |u|`` counts as ``rho_s A_0/(dt rho/2 max(C_D, C_F))`` where it is more.  This is
    some 100 m/s for a sheet of cotton that is not stretched.  An explicit force beyond it would throw the sheet back faster than
    it came.

    surface: see ``elements.SurfaceArrays``.  resistance: ``rho C_D/2`` and ``rho C_F/2`` [kg/m^3], and ``rho_s`` [kg/m^2], (3,
    lanes).  wind: [m/s], (3, lanes).
    """
    triangles, shares, area = surface
    half = x.dtype.type(0.5)
    tiny = x.dtype.type(1e-18)
    one = x.dtype.type(1)
    least = x.dtype.type(TINY)
    lanes = x.shape[2]
    across, along, density = resistance[0], resistance[1], resistance[2]
    row = scratch.rows
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = shares[t, 0], shares[t, 1], shares[t, 2]
        # the force on the triangle
        for l in range(lanes):
            # sides from the first corner, and the normal times twice the area
            px, py, pz = x[0, j, l] - x[0, i, l], x[1, j, l] - x[1, i, l], x[2, j, l] - x[2, i, l]
            qx, qy, qz = x[0, k, l] - x[0, i, l], x[1, k, l] - x[1, i, l], x[2, k, l] - x[2, i, l]
            nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
            # the wind relative to the triangle
            ux = wind[0, l] - (a * v[0, i, l] + b * v[0, j, l] + c * v[0, k, l])
            uy = wind[1, l] - (a * v[1, i, l] + b * v[1, j, l] + c * v[1, k, l])
            uz = wind[2, l] - (a * v[2, i, l] + b * v[2, j, l] + c * v[2, k, l])
            # the terms along n and along u: A = twice/2, and (C_D - C_F) (u . n) n + C_F u is the bracket above
            n2 = nx * nx + ny * ny + nz * nz + tiny
            twice = np.sqrt(n2)
            most = area[t] * most_air(across[l], along[l], density[l], interval, least)
            speed = min(np.sqrt(ux * ux + uy * uy + uz * uz), most * (one / (half * twice)))
            skin = half * speed * along[l] * twice
            face = half * speed * (across[l] - along[l]) * (ux * nx + uy * ny + uz * nz) * (one / twice)
            row[0, l] = face * nx + skin * ux
            row[1, l] = face * ny + skin * uy
            row[2, l] = face * nz + skin * uz
        # its corners take their shares
        for corner in range(3):
            share = shares[t, corner]
            for e in range(3):
                fp, force = f[e, triangles[t, corner]], row[e]
                for l in range(lanes):
                    fp[l] += share * force[l]


class Oscillators(NamedTuple):
    """The properties of one environment that determine its largest substep, in float64.

    positions: at rest [m], (particles, 3).  stiffness: of springs by kind [N/m], (kinds,).  rigidity: of hinges [N m].
    isotropic: whether hinges resist displacements in the plane of the sheet as well, see ``bending.Bending``.  damping_time [s].
    inverse_mass [1/kg], (particles,).
    """

    positions: NDArray
    elements: Elements
    stiffness: NDArray
    rigidity: float
    isotropic: bool
    damping_time: float
    inverse_mass: NDArray


def energy_rows(o: Oscillators) -> list[tuple[NDArray, NDArray]]:
    """The elements' energy for small displacements u about rest, ``sum_rows (sum_m V_m . u_m)^2 / 2``.

    Returns, for each sort of element, particles (rows, m) and vectors V [(N/m)^(1/2)], (rows, m, 3).
    """
    # springs: k/2 (n . (u_j - u_i))^2
    springs, bends = o.elements
    i, j = springs.particles.T
    n = o.positions[j] - o.positions[i]
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), TINY)
    pull = np.sqrt(springs.weight * o.stiffness[springs.kind])[:, None] * n
    rows = [(springs.particles, np.stack([-pull, pull], axis=1))]
    if not len(bends.particles):
        return rows
    # the quadratic model: B/2 |sum_i q_i u_i|^2, one row for each component
    curves = np.sqrt(o.rigidity) * bends.curves
    if o.isotropic:
        rows += [(bends.particles, curves[:, :, None] * axis) for axis in np.eye(3)]
        return rows
    # hinges: the angle changes with the opposite corners along their triangles' normals, and with the ends along both
    xi, xj, xk, xl = (o.positions[bends.particles[:, m]] for m in range(4))
    e = xj - xi
    normals = [np.cross(e, xk - xi), np.cross(xl - xi, e)]
    normal_k, normal_l = (n / np.linalg.norm(n, axis=1, keepdims=True) for n in normals)
    foot_k, foot_l = (np.sum((q - xi) * e, axis=1) / np.sum(e * e, axis=1) for q in (xk, xl))
    at_k, at_l = curves[:, 2, None] * normal_k, curves[:, 3, None] * normal_l
    near = (foot_k - 1)[:, None] * at_k + (foot_l - 1)[:, None] * at_l
    far = -foot_k[:, None] * at_k - foot_l[:, None] * at_l
    return [*rows, (bends.particles, np.stack([near, far, at_k, at_l], axis=1))]


def largest_frequency(o: Oscillators) -> float:
    """Largest angular frequency of the sheet at rest [rad/s]: the square root of the largest eigenvalue of M^-1 K.

    K is the stiffness matrix of all elements.  ``sqrt(k/m)`` of one spring is too low, as the springs of a particle add up.
    """
    from scipy.sparse import coo_matrix, csr_matrix, vstack  # imported here: scipy doubles the time of a warm start
    from scipy.sparse.linalg import eigsh

    # M^-1/2 K M^-1/2 = B^T B, with the rows V M^-1/2 in B
    scale, parts = np.sqrt(o.inverse_mass), []
    for particles, vectors in energy_rows(o):
        values = vectors * scale[particles][:, :, None]
        columns = 3 * particles[:, :, None] + np.arange(3)
        rows = np.broadcast_to(np.arange(len(particles))[:, None, None], values.shape)
        shape = (len(particles), 3 * len(scale))
        parts.append(csr_matrix(coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)))
    b = vstack(parts, format="csr")
    gram = b.T @ b
    # a fixed start vector: the same bound in every process
    start = np.random.default_rng(0).normal(size=gram.shape[0])
    return float(np.sqrt(eigsh(gram, k=1, which="LM", v0=start, tol=1e-4, return_eigenvectors=False)[0]))


def frequency_bound(o: Oscillators) -> float:
    """An upper bound on ``largest_frequency`` [rad/s], about a tenth above it, in a fraction of the time and without scipy.

    Let A hold the magnitudes of the entries of M^-1 K.  For any positive vector y no eigenvalue exceeds the largest entry of
    ``(A y)/y`` (Collatz and Wielandt).  A few steps of the power method make y a good choice.
    """
    # the diagonal blocks of A, where the elements' contributions are added up before their magnitudes are taken
    families = energy_rows(o)
    own = np.zeros((len(o.positions), 3, 3))
    for particles, vectors in families:
        for m in range(particles.shape[1]):
            np.add.at(own, particles[:, m], vectors[:, m, :, None] * vectors[:, m, None, :])
    own = np.abs(own)
    # power method: z = A y, with the other blocks element by element
    y = np.ones((len(o.positions), 3))
    bound = np.inf
    for _ in range(POWER_STEPS):
        z = np.einsum("pab,pb->pa", own, y)
        for particles, vectors in families:
            sizes = np.abs(vectors)
            parts = np.sum(sizes * y[particles], axis=2)
            others = parts.sum(axis=1, keepdims=True) - parts
            for m in range(particles.shape[1]):
                np.add.at(z, particles[:, m], sizes[:, m] * others[:, m, None])
        z = z * o.inverse_mass[:, None] + 1e-9 * y  # stays positive in directions without any stiffness
        bound = min(bound, float(np.max(z / y)))
        y = z / z.max()
    return float(np.sqrt(bound))


def structural_strain(mesh: ClothMesh, x: NDArray, size: NDArray | float = 1.0) -> NDArray:
    """Strain ``|d|/r - 1`` of the structural springs, or edges, (num_envs, those springs).

    x: [m], (num_envs, particles, 3).  size: factors on the mesh's rest lengths, (num_envs,), or one.
    """
    springs = mesh.springs
    structural = springs.kind < SHEAR
    ends = x[:, springs.particles[structural]]
    rest = np.multiply.outer(size, springs.rest_length[structural]).astype(x.dtype)
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) / rest - 1


class Energy(NamedTuple):
    """Energies [J], (num_envs,) each; that of gravity is zero at the origin."""

    kinetic: NDArray
    elastic: NDArray
    gravity: NDArray

    @property
    def total(self) -> NDArray:
        """Their sum [J], (num_envs,)."""
        return self.kinetic + self.elastic + self.gravity


def energy(elements: Elements, bending: Bending, state: State) -> Energy:
    """Kinetic, elastic and gravitational energy of each environment, in float64."""
    springs = elements.springs
    x, v = state.positions.astype(np.float64), state.velocities.astype(np.float64)
    mass = 1 / state.free_inverse_mass.astype(np.float64)
    ends = x[:, springs.particles]
    rest = np.multiply.outer(state.size.astype(np.float64), springs.rest_length)
    stretch = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) - rest
    k = springs.weight * state.stiffness.astype(np.float64)[:, springs.kind]
    return Energy(
        kinetic=np.sum(mass * np.sum(v**2, axis=2), axis=1) / 2,
        elastic=np.sum(k * stretch**2, axis=1) / 2 + bending.energy(elements.bends, x, state.rigidity.astype(np.float64)),
        gravity=-np.einsum("ep,epc,ec->e", mass, x, state.gravity.astype(np.float64)),
    )

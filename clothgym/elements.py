"""Floor 2: springs, hinges and triangles as arrays for kernels; all environments share them."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.mesh import BEND_X, BEND_Y, SHEAR, STRUCTURAL_X, STRUCTURAL_Y, ClothMesh

WORK_ROWS = 38  # of ``Scratch.rows``
BATCH = 64  # elements that ``sheet_forces`` takes at a time
ALIKE = 1e-6  # relative difference up to which the springs of a kind count as equally long
# kinds of springs on a grid, with the rows and columns from the first end to the second
KINDS = ((STRUCTURAL_X, 0, 1), (STRUCTURAL_Y, 1, 0), (SHEAR, 1, 1), (SHEAR, 1, -1), (BEND_X, 0, 2), (BEND_Y, 2, 0))


class SpringArrays(NamedTuple):
    """The mesh's springs in the kernel's dtype, shared by all lanes.

    particles: ends, (springs, 2).  rest_length: [m].  kind, weight: see ``mesh.Springs``.  The last three are (springs,).
    """

    particles: NDArray
    rest_length: NDArray
    kind: NDArray
    weight: NDArray


class Grid(NamedTuple):
    """A grid's springs and hinges by kinds: those of a kind join particle p to particles at constant offsets from it.

    Where that would wrap around the end of a row the weight is zero.

    offset: from a spring's first end to its second, (kinds,).  stiffness: row of ``Elastic.stiffness``, (kinds,).  rest_length:
    [m], (kinds,).  weight: share of the stiffness, (kinds, particles), for the kinds that are springs.
    curve: coefficient of the quadratic bending model along each offset, for a rigidity of 1 [1/m^2], (kinds, particles), or (0,
    particles).
    hinge: offsets from a hinge's first end to its second and to both opposite corners, (families, 3).  hinge_weight: (families,
    particles).
    """

    offset: NDArray
    stiffness: NDArray
    rest_length: NDArray
    weight: NDArray
    curve: NDArray
    hinge: NDArray
    hinge_weight: NDArray


class GridSurface(NamedTuple):
    """A grid's triangles by cells; a cell has the index of the particle at its first corner.

    cell: offsets of the corners, (4,).  even: 1.0 for cells that are cut from their first corner to their last, (particles,).
    shares: the corners' shares of the first triangle, then of the second, (8, particles); zero where there is no cell.  area: of
    each triangle at rest [m^2], (1,).
    """

    cell: NDArray
    even: NDArray
    shares: NDArray
    area: NDArray


class BendArrays(NamedTuple):
    """The mesh's hinges in the kernel's dtype, shared by all lanes; empty if skip springs resist bending.

    particles: (hinges, 4).  weight, rest_angle [rad]: (hinges,); see ``mesh.Hinges``.  curves: coefficients q [1/m] of the
    quadratic model, whose energy is ``B/2 |sum_i q_i x_i|^2``, (hinges, 4).
    """

    particles: NDArray
    weight: NDArray
    rest_angle: NDArray
    curves: NDArray


class Elements(NamedTuple):
    """The springs and hinges of a sheet, one by one."""

    springs: SpringArrays
    bends: BendArrays


class Scratch(NamedTuple):
    """Scratch for the forces of elements.  The content of ``rows`` is lost when a call ends.

    rows: (WORK_ROWS, row), with room for the lanes, for ``BATCH`` elements, or for the particles of a grid that are adjacent in
    memory.  kinds: forces of a grid's springs by kind, (3, kinds, ``before`` + particles); the entries before a kind's first
    spring and after its last are zero, and stay so.
    """

    rows: NDArray
    kinds: NDArray


class Elastic(NamedTuple):
    """Coefficients of the elements' forces by lane, a part of ``state.Fabric``.

    stiffness: of springs by kind [N/m], (kinds, lanes).  rigidity: of hinges [N m], (lanes,).  damping_time: [s], (lanes,).
    size: factor on the mesh's rest lengths, (lanes,).
    """

    stiffness: NDArray
    rigidity: NDArray
    damping_time: NDArray
    size: NDArray


class SurfaceArrays(NamedTuple):
    """The mesh's triangles, (triangles, 3), the corners' shares of the force on each, (triangles, 3), and areas at rest [m^2]."""

    triangles: NDArray
    shares: NDArray
    area: NDArray


class Topology(NamedTuple):
    """Everything that exerts forces on a sheet, in the form that the memory layout needs.

    No array is the mesh's own, which are read-only: numba has another type for these, and copies and pickles of a simulation hold
    none, so that all kernels would be compiled once more for a copy.

    springs: one by one.  elements: springs and hinges, one by one or by kinds.  air: triangles, or cells.  triangles: (triangles,
    3).  offset: of the kinds, where the particles of a regular grid are adjacent in memory; otherwise empty.
    """

    springs: SpringArrays
    elements: Elements | Grid
    air: SurfaceArrays | GridSurface
    triangles: NDArray
    offset: NDArray


def element_arrays(mesh: ClothMesh, dtype: np.dtype, hinged: bool, any_order: bool) -> Elements:
    """The mesh's elements as arrays of this dtype; if ``hinged``, hinges resist bending, otherwise skip springs do.

    Springs are sorted by particle if ``any_order``, otherwise by color.  By particle is a fifth faster on wide blocks, as a
    particle's rows are still in the first cache when its next spring comes.  Gauss-Seidel methods need the colors, which prefer no
    direction.
    """
    # springs
    s, h = mesh.springs, mesh.hinges
    order = np.lexsort((s.particles.max(axis=1), s.particles.min(axis=1))) if any_order else np.arange(len(s.kind))
    if hinged:
        order = order[s.kind[order] <= SHEAR]
    springs = SpringArrays(s.particles[order], s.rest_length[order].astype(dtype), s.kind[order], s.weight[order].astype(dtype))
    # hinges, or none
    used = slice(None) if hinged else slice(0)
    curves = np.sqrt(h.weight)[used, None] * h.slopes[used]
    members, weight, rest_angle = h.particles[used].copy(), h.weight[used].astype(dtype), h.rest_angle[used].astype(dtype)
    return Elements(springs, BendArrays(members, weight, rest_angle, curves.astype(dtype)))


def topology_of(mesh: ClothMesh, elements: Elements, surface: SurfaceArrays, bending: str, regular: bool) -> Topology:
    """The topology of a mesh, from the mesh's ``elements`` and ``surface``; arguments as for ``grid_of``.

    regular: whether it is a regular grid whose particles are adjacent in memory.
    """
    dtype = surface.shares.dtype
    if not regular:
        return Topology(elements.springs, elements, surface, surface.triangles, np.zeros(0, np.int64))
    grid = grid_of(mesh, dtype, bending)
    return Topology(elements.springs, grid, grid_surface_of(mesh, dtype), surface.triangles, grid.offset)


def is_regular(mesh: ClothMesh) -> bool:
    """Whether a mesh has exactly the springs of a flat grid, of one length in each kind, so that they can be taken by kinds."""
    # a grid with both triangles in each cell
    if mesh.shape is None or mesh.hinges.rest_angle.any() or len(mesh.triangles) != 2 * (mesh.shape[0] - 1) * (mesh.shape[1] - 1):
        return False
    # each spring is of a known kind, as long as the others of its kind, and there only once
    columns, springs = mesh.shape[1], mesh.springs
    first, second = np.sort(springs.particles, axis=1).T
    down, right = second // columns - first // columns, second % columns - first % columns
    count = 0
    for kind, r, c in KINDS:
        own = (springs.kind == kind) & (down == r) & (right == c)
        count += own.sum()
        if own.any() and np.ptp(springs.rest_length[own]) > ALIKE * springs.rest_length[own].max():
            return False
    return bool(count == len(springs.kind)) and len(np.unique(first * mesh.num_particles + second)) == count


def grid_of(mesh: ClothMesh, dtype: np.dtype, bending: str) -> Grid:
    """A regular grid's elements by kinds; bending: "springs", "hinge" or "quadratic"."""
    # springs: weights by kind and first end
    columns, n = mesh.grid_shape[1], mesh.num_particles
    first, second = np.sort(mesh.springs.particles, axis=1).T
    kind = _kind_of(first, second, columns)
    weight, rest_length = np.zeros((len(KINDS), n)), np.ones(len(KINDS))
    weight[kind, first] = mesh.springs.weight
    rest_length[kind] = mesh.springs.rest_length
    # bending: families of hinges, or the coefficients of the quadratic model
    hinge, hinge_weight = np.zeros((0, 3), np.int64), np.zeros((0, n))
    curve = np.zeros((len(KINDS) if bending == "quadratic" else 0, n))
    if bending == "hinge":
        hinge, hinge_weight = _hinge_families(mesh)
    elif bending == "quadratic":
        # the energy |sum q_i x_i|^2/2 attracts particles i and j with -q_i q_j times their distance
        h = mesh.hinges
        q = np.sqrt(h.weight)[:, None] * h.slopes
        for a in range(4):
            for b in range(a):
                low, high = np.sort(h.particles[:, [a, b]], axis=1).T
                np.add.at(curve, (_kind_of(low, high, columns), low), -q[:, a] * q[:, b])
    springs = len(KINDS) if bending == "springs" else sum(kind <= SHEAR for kind, _, _ in KINDS)
    return Grid(
        offset=np.array([down * columns + right for _, down, right in KINDS]),
        stiffness=np.array([kind for kind, _, _ in KINDS]),
        rest_length=rest_length.astype(dtype),
        weight=weight[:springs].astype(dtype),
        curve=curve.astype(dtype),
        hinge=hinge,
        hinge_weight=hinge_weight.astype(dtype),
    )


def grid_surface_of(mesh: ClothMesh, dtype: np.dtype) -> GridSurface:
    """A regular grid's triangles by cells."""
    # cells, by the particle at the first corner; the last row and column have none
    rows, columns = mesh.grid_shape
    n = mesh.num_particles
    cell = np.array([0, 1, columns, columns + 1])
    row, column = np.divmod(np.arange(n), columns)
    first = np.repeat(np.flatnonzero((row < rows - 1) & (column < columns - 1)), 2)
    # the shares of both triangles, at the places of their corners in the cell
    surface, shares = surface_arrays(mesh, np.dtype(np.float64)), np.zeros((2, 4, n))
    for corner in range(3):
        place = np.searchsorted(cell, surface.triangles[:, corner] - first)
        shares[np.arange(len(place)) % 2, place, first] = surface.shares[:, corner]
    return GridSurface(
        cell, ((row + column) % 2 == 0).astype(dtype), shares.reshape(8, n).astype(dtype), surface.area[:1].astype(dtype)
    )


def _kind_of(first: NDArray, second: NDArray, columns: int) -> NDArray[np.int64]:
    """Index into ``KINDS`` of pairs of particles, ``first < second``, (pairs,)."""
    down, right = second // columns - first // columns, second % columns - first % columns
    known = {(r, c): k for k, (_, r, c) in enumerate(KINDS)}
    return np.array([known[pair] for pair in zip(down.tolist(), right.tolist())], np.int64)


def _hinge_families(mesh: ClothMesh) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Families of a grid's hinges, whose other corners have the same offsets from the first end.

    Returns the offsets, (families, 3), and the weights by first end, (families, particles).
    """
    columns, particles = mesh.grid_shape[1], mesh.hinges.particles.astype(np.int64)
    down, right = (part[:, 1:] - part[:, :1] for part in (particles // columns, particles % columns))
    families, family = np.unique(np.concatenate([down, right], axis=1), axis=0, return_inverse=True)
    weight = np.zeros((len(families), mesh.num_particles))
    weight[family.ravel(), particles[:, 0]] = mesh.hinges.weight
    return families[:, :3] * columns + families[:, 3:], weight


@kernel
def scratch_for_forces(x, offset):
    """The ``Scratch`` of one block; x: (3, particles, lanes); offset: see ``Topology``."""
    _, particles, lanes = x.shape
    before = 0
    for o in offset:
        before = max(before, o)
    row = particles if len(offset) > 0 else max(lanes, BATCH)
    return Scratch(np.empty((WORK_ROWS, row), x.dtype), np.zeros((3, offset.shape[0], before + particles), x.dtype))


def digest_of(mesh: ClothMesh, hinged: bool, contact: str) -> NDArray[np.uint64]:
    """A digest of a sheet: its mesh, whether hinges resist its bending, and how it collides with itself."""
    digest = hashlib.sha256(bytes([hinged]) + contact.encode())
    for array in (mesh.rest_positions, mesh.triangles, *mesh.springs, *mesh.hinges):
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest()[:8], np.uint64)[0].reshape(())


def surface_arrays(mesh: ClothMesh, dtype: np.dtype) -> SurfaceArrays:
    """The mesh's triangles and the corners' shares, in this dtype.

    A corner's share follows from the area that the particle stands for.  With thirds, every second particle of a grid, whose
    diagonals alternate, would receive twice the force of its neighbors.
    """
    triangles = mesh.triangles
    around = np.bincount(triangles.ravel(), minlength=mesh.num_particles)
    shares = mesh.area[triangles] / np.maximum(around, 1)[triangles]
    a, b, c = (mesh.rest_positions[triangles[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return SurfaceArrays(triangles.copy(), (shares / shares.sum(axis=1, keepdims=True)).astype(dtype), area.astype(dtype))

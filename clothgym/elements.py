"""Floor 2: what holds a sheet together, as arrays for kernels; shared by all environments."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.mesh import BEND_X, BEND_Y, SHEAR, STRUCTURAL_X, STRUCTURAL_Y, ClothMesh

ROWS = 27  # of scratch
ALIKE = 1e-6  # share of a length up to which springs of a kind are as long as each other
# rows and columns from a spring's first end to its second, for each kind of a grid's springs
KINDS = ((STRUCTURAL_X, 0, 1), (STRUCTURAL_Y, 1, 0), (SHEAR, 1, 1), (SHEAR, 1, -1), (BEND_X, 0, 2), (BEND_Y, 2, 0))


class SpringArrays(NamedTuple):
    """The mesh's springs in the kernel's dtype, shared by all lanes (see ``mesh.Springs``)."""

    particles: NDArray
    rest_length: NDArray
    kind: NDArray
    weight: NDArray


class Grid(NamedTuple):
    """A grid's springs and hinges by kinds: one of a kind joins particle p to those at constant offsets from it.

    Where that would wrap around the end of a row its weight is zero.

    offset, stiffness, rest_length: from a spring's first end to its second, the row of ``Elastic.stiffness``, and its rest length
    [m], (kinds,).  weight: share of that stiffness, (kinds, particles), for as many kinds as are springs.
    curve: what the quadratic bending model adds along each offset, over the rigidity [1/m^2], (kinds, particles) or none.
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
    """A grid's triangles by cells, each known by the particle p at its first corner.

    cell: offsets of its corners, (4,).  even: 1.0 for cells that are cut from their first corner to their last, (particles,).
    shares: of its first triangle that its corners stand for, and of its second, (8, particles), zero where there is no cell.
    """

    cell: NDArray
    even: NDArray
    shares: NDArray


class BendArrays(NamedTuple):
    """The mesh's hinges in the kernel's dtype, shared by all lanes (see ``mesh.Hinges``); none where skip springs bend instead.

    curves: coefficients q, (hinges, 4), with which the quadratic model's energy is ``B/2 |sum_i q_i x_i|^2``.
    """

    particles: NDArray
    weight: NDArray
    rest_angle: NDArray
    curves: NDArray


class Elements(NamedTuple):
    """All that holds a sheet together, one by one."""

    springs: SpringArrays
    bends: BendArrays


class Scratch(NamedTuple):
    """Room for the forces of elements, whose content does not outlive a call.

    rows: (ROWS, lanes), or (ROWS, particles) where particles lie side by side.  kinds: forces of a grid's springs by kind,
    (3, kinds, ``before`` + particles); what stands before a kind's first spring and after its last is zero, and stays so.
    """

    rows: NDArray
    kinds: NDArray


class Elastic(NamedTuple):
    """What the elements' forces scale with, by lane; a part of ``Fabric``."""

    stiffness: NDArray
    rigidity: NDArray
    damping_time: NDArray


class SurfaceArrays(NamedTuple):
    """The mesh's triangles, (triangles, 3), and the shares of each that its corners stand for, (triangles, 3)."""

    triangles: NDArray
    shares: NDArray


class Weave(NamedTuple):
    """What a sheet's forces go over, in the form that the layout wants.

    springs: one by one.  elements: all of them, or by kinds.  air: triangles, or cells.  triangles: (triangles, 3).
    offset: of the kinds, where particles lie side by side, or none.
    """

    springs: SpringArrays
    elements: Elements | Grid
    air: SurfaceArrays | GridSurface
    triangles: NDArray
    offset: NDArray


def element_arrays(mesh: ClothMesh, dtype: np.dtype, hinged: bool, any_order: bool) -> Elements:
    """The mesh's elements as a kernel of this dtype wants them: those that bend are hinges, or springs if not ``hinged``.

    Springs are sorted by color, or by particle if they may come in any order: the latter is a fifth faster on wide blocks, as a
    particle's rows are still in the first cache when its next spring comes.  Gauss-Seidel keeps the colors, which have no preferred
    direction.
    """
    s, h = mesh.springs, mesh.hinges
    order = np.lexsort((s.particles.max(axis=1), s.particles.min(axis=1))) if any_order else np.arange(len(s.kind))
    if hinged:
        order = order[s.kind[order] <= SHEAR]
    springs = SpringArrays(s.particles[order], s.rest_length[order].astype(dtype), s.kind[order], s.weight[order].astype(dtype))
    used = slice(None) if hinged else slice(0)
    curves = np.sqrt(h.weight)[used, None] * h.slopes[used]
    bends = BendArrays(h.particles[used], h.weight[used].astype(dtype), h.rest_angle[used].astype(dtype), curves.astype(dtype))
    return Elements(springs, bends)


def weave_of(mesh: ClothMesh, elements: Elements, surface: SurfaceArrays, bending: str, by_particle: bool) -> Weave:
    """A mesh's weave, of elements and a surface made for it."""
    dtype = surface.shares.dtype
    if not by_particle:
        return Weave(elements.springs, elements, surface, surface.triangles, np.zeros(0, np.int64))
    grid = grid_of(mesh, dtype, bending)
    return Weave(elements.springs, grid, grid_surface_of(mesh, dtype), surface.triangles, grid.offset)


def is_regular(mesh: ClothMesh) -> bool:
    """Whether a mesh's springs are those of a grid, of one length a kind: else they cannot be taken by kinds."""
    if mesh.shape is None or len(mesh.triangles) != 2 * (mesh.shape[0] - 1) * (mesh.shape[1] - 1):
        return False
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
    columns, n = mesh.grid_shape[1], mesh.num_particles
    first, second = np.sort(mesh.springs.particles, axis=1).T
    kind = _kind_of(first, second, columns)
    weight, rest_length = np.zeros((len(KINDS), n)), np.ones(len(KINDS))
    weight[kind, first] = mesh.springs.weight
    rest_length[kind] = mesh.springs.rest_length
    hinge, hinge_weight = np.zeros((0, 3), np.int64), np.zeros((0, n))
    curve = np.zeros((len(KINDS) if bending == "quadratic" else 0, n))
    if bending == "hinge":
        hinge, hinge_weight = _hinge_families(mesh)
    elif bending == "quadratic":
        # |sum q_i x_i|^2 of a hinge pulls each two of its particles together with -q_i q_j
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
    rows, columns = mesh.grid_shape
    n = mesh.num_particles
    cell = np.array([0, 1, columns, columns + 1])
    row, column = np.divmod(np.arange(n), columns)
    first = np.repeat(np.flatnonzero((row < rows - 1) & (column < columns - 1)), 2)
    surface, shares = surface_arrays(mesh, np.dtype(np.float64)), np.zeros((2, 4, n))
    for corner in range(3):
        place = np.searchsorted(cell, surface.triangles[:, corner] - first)
        shares[np.arange(len(place)) % 2, place, first] = surface.shares[:, corner]
    return GridSurface(cell, ((row + column) % 2 == 0).astype(dtype), shares.reshape(8, n).astype(dtype))


def _kind_of(first: NDArray, second: NDArray, columns: int) -> NDArray[np.int64]:
    """Place in ``KINDS`` of pairs of particles, the lower first."""
    down, right = second // columns - first // columns, second % columns - first % columns
    known = {(r, c): k for k, (_, r, c) in enumerate(KINDS)}
    return np.array([known[pair] for pair in zip(down.tolist(), right.tolist())], np.int64)


def _hinge_families(mesh: ClothMesh) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """A grid's hinges by where their other corners lie from their first end: offsets, and weights by that end."""
    columns, particles = mesh.grid_shape[1], mesh.hinges.particles.astype(np.int64)
    down, right = (part[:, 1:] - part[:, :1] for part in (particles // columns, particles % columns))
    families, family = np.unique(np.concatenate([down, right], axis=1), axis=0, return_inverse=True)
    weight = np.zeros((len(families), mesh.num_particles))
    weight[family.ravel(), particles[:, 0]] = mesh.hinges.weight
    return families[:, :3] * columns + families[:, 3:], weight


@kernel
def room_for_forces(x, offset):
    """Scratch for one block; x: (3, particles, lanes); offset: see ``Weave``."""
    _, particles, lanes = x.shape
    before = 0
    for o in offset:
        before = max(before, o)
    row = particles if len(offset) > 0 else lanes
    return Scratch(np.empty((ROWS, row), x.dtype), np.zeros((3, offset.shape[0], before + particles), x.dtype))


def digest_of(mesh: ClothMesh, hinged: bool, contact: str) -> NDArray[np.uint64]:
    """What tells one sheet, with what bends it and how it collides with itself, from another."""
    digest = hashlib.sha256(bytes([hinged]) + contact.encode())
    for array in (mesh.rest_positions, mesh.triangles, *mesh.springs, *mesh.hinges):
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest()[:8], np.uint64)[0].reshape(())


def surface_arrays(mesh: ClothMesh, dtype: np.dtype) -> SurfaceArrays:
    """The mesh's triangles as a kernel of this dtype wants them.

    A corner's share of a triangle follows from the area that the particle stands for: on a grid, whose diagonals alternate,
    thirds would give every second particle twice its neighbors' force.
    """
    triangles = mesh.triangles
    around = np.bincount(triangles.ravel(), minlength=mesh.num_particles)
    shares = mesh.area[triangles] / np.maximum(around, 1)[triangles]
    return SurfaceArrays(triangles, (shares / shares.sum(axis=1, keepdims=True)).astype(dtype))

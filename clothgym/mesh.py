"""Floor 1: the sheet as particles, springs and triangles: immutable, validated, in SI units."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import check_memory, count, indices, not_negative, number, positive, shown
from clothgym.mesh_repair import Repairs

Int = NDArray[np.int32]
Real = NDArray[np.float64]

# kinds of springs, each with a stiffness of its own (see material.spring_stiffness).  Those before SHEAR are structural: a grid's
# yarns, or the edges of a triangle mesh.  Those after SHEAR resist bending
STRUCTURAL_X, STRUCTURAL_Y, EDGE, SHEAR, BEND_X, BEND_Y, OPPOSITE = range(7)
NUM_KINDS = 7
FLAT = 1e-3  # largest angle at rest of a sheet that counts as flat [rad]: files of six digits make some 1e-4 of a plane


class Springs(NamedTuple):
    """Springs sorted by color: no two of one color share a particle.

    particles: ends, (springs, 2).  rest_length: [m], (springs,).  kind: index of the stiffness, (springs,).
    weight: factor of that stiffness, (springs,).  It is 1/2 for a spring on a grid's border, which stands for half a strip of
    cloth, and has the unit 1/m^2 for OPPOSITE, whose stiffness is in N m.
    """

    particles: Int
    rest_length: Real
    kind: Int
    weight: Real


class Hinges(NamedTuple):
    """The inner edges, across which two triangles bend, sorted by color; on a grid, those of both ways to cut its cells.

    particles: both ends of the edge, then the opposite corners of its triangles, (hinges, 4).
    weight: bending moment over rigidity times angle, (hinges,): e/h, with the length e of the edge and the distance h between
    parallel hinges.
    rest_angle: [rad], (hinges,), zero where the sheet is flat at rest.
    slopes: derivatives of the angle at rest with respect to displacements along the normal [1/m], (hinges, 4).
    """

    particles: Int
    weight: Real
    rest_angle: Real
    slopes: Real


@dataclass(frozen=True, eq=False)
class ClothMesh:
    """A sheet at rest: a grid in the plane z = 0 centered on the origin, or any mesh of triangles.

    Attributes:
        size: width along x and height along y [m].
        rest_positions: particles at rest [m], (particles, 3); in a grid row r, column c is particle ``r * columns + c``.
        springs: structural and shear springs, or edges; and skip springs, which resist bending.
        triangles: particle indices, (triangles, 3); a grid's are counter-clockwise seen from +z.
        area: share of the sheet's area that each particle stands for [m^2], (particles,).
        hinges: inner edges.
        shape: of a grid, particles along y and x (rows, columns); None for other meshes.
        repairs: what reading it from a file has changed; None for other meshes.
    """

    size: tuple[float, float]
    rest_positions: Real
    springs: Springs
    triangles: Int
    area: Real
    hinges: Hinges
    shape: tuple[int, int] | None = None
    repairs: Repairs | None = None

    def __repr__(self) -> str:
        particles = str(self.num_particles) if self.shape is None else " x ".join(map(str, self.shape))
        size = " x ".join(f"{side:.4g}" for side in np.ptp(self.rest_positions, axis=0)[: 2 if self.flat and self.shape else 3])
        pieces = f", {self.pieces} pieces" if self.pieces > 1 else ""
        return f"<ClothMesh of {particles} particles, {len(self.triangles)} triangles, {size} m{pieces}>"

    @property
    def num_particles(self) -> int:
        """Number of particles."""
        return len(self.rest_positions)

    @property
    def pieces(self) -> int:
        """Number of parts that no particle holds together."""
        return len(np.unique(self.piece_of))

    @cached_property
    def piece_of(self) -> Int:
        """Of each particle the lowest index in its piece, (particles,)."""
        # each particle takes over the lowest label of its triangles until nothing changes
        label, before = np.arange(self.num_particles), None
        while before is None or not np.array_equal(label, before):
            before = label.copy()
            np.minimum.at(label, self.triangles, label[self.triangles].min(axis=1, keepdims=True))
            label = label[label]
        return frozen(label.astype(np.int32))

    @property
    def flat(self) -> bool:
        """Whether the sheet is flat at rest: whether no angle at rest is beyond ``FLAT``."""
        return float(np.abs(self.hinges.rest_angle).max(initial=0)) <= FLAT

    @property
    def grid_shape(self) -> tuple[int, int]:
        """``shape`` of a grid.

        Raises:
            ValueError: the mesh is not a grid.
        """
        if self.shape is None:
            raise ValueError("this mesh is not a grid, so it has no rows, columns or corners; make a grid with clothgym.grid")
        return self.shape

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance at rest between neighbors in a grid, along x and y [m]."""
        rows, columns = self.grid_shape
        return self.size[0] / (columns - 1), self.size[1] / (rows - 1)

    @property
    def corners(self) -> tuple[int, int, int, int]:
        """A grid's particles at (-x, -y), (+x, -y), (-x, +y), (+x, +y)."""
        rows, columns = self.grid_shape
        return 0, columns - 1, (rows - 1) * columns, rows * columns - 1

    def scaled(self, size: float) -> ClothMesh:
        """The same sheet with all lengths at rest multiplied by a size.

        Raises:
            ValueError: a size that is not positive and finite.
        """
        size = positive("size", size)
        springs, hinges = self.springs, self.hinges
        # skip springs of triangles store their energy per curvature: their weight is one over an area
        weight = np.where(springs.kind == OPPOSITE, springs.weight / size**2, springs.weight)
        return replace(
            self,
            size=(size * self.size[0], size * self.size[1]),
            rest_positions=frozen(size * self.rest_positions),
            springs=springs._replace(rest_length=frozen(size * springs.rest_length), weight=frozen(weight)),
            area=frozen(size**2 * self.area),
            hinges=hinges._replace(slopes=frozen(hinges.slopes / size)),
        )

    def with_rest_angles(self, angle: float = 0.0, edges: ArrayLike | None = None, above: float = 0.0) -> ClothMesh:
        """The same sheet with another rest angle between the two triangles at some of its edges.

        A garment that was modeled folded, or sewn along sharp seams, then opens there.  Edges keep their lengths.
        Skip springs between opposite corners get their length at this angle.

        Args:
            angle: [rad], 0 for flat, positive and negative to the two sides.
            edges: ends of the edges, (edges, 2) particles; all inner edges by default.
            above: only edges whose angle at rest is larger than this, to either side [rad].

        Raises:
            ValueError: an angle beyond pi, or an edge that does not join two triangles.
        """
        angle, above = number("angle", angle), not_negative("above", above)
        if abs(angle) > np.pi:
            raise ValueError(f"angle={shown(angle)}: must be from -pi to pi")
        hinges = self.hinges
        chosen = np.abs(hinges.rest_angle) > above if above else np.ones(len(hinges.weight), bool)
        if edges is not None:
            chosen &= _named_hinges(hinges, indices("edges", np.ravel(edges), self.num_particles, "particles of this mesh"))
        rest_angle = np.where(chosen, angle, hinges.rest_angle)
        springs = self.springs if self.shape is not None else _refolded(self, chosen, angle)
        return replace(self, hinges=hinges._replace(rest_angle=frozen(rest_angle)), springs=springs)


def _named_hinges(hinges: Hinges, ends: NDArray) -> NDArray[np.bool_]:
    """Which hinges lie on the edges with these ends, two by two, (2 edges,).

    Raises:
        ValueError: an edge that is none of theirs, or an end without the other.
    """
    if len(ends) % 2:
        raise ValueError(f"edges={shown(ends.tolist())}: must be pairs of particles, (edges, 2)")
    wanted = {tuple(sorted(pair)) for pair in ends.reshape(-1, 2).tolist()}
    own = [tuple(sorted(pair)) for pair in hinges.particles[:, :2].tolist()]
    if missing := wanted.difference(own):
        a, b = min(missing)
        raise ValueError(f"edges: {a}-{b} is no edge between two triangles: name particles of inner edges")
    return np.array([pair in wanted for pair in own], bool)


def _refolded(mesh: ClothMesh, chosen: NDArray, angle: float) -> Springs:
    """The springs, with skip springs across the chosen hinges as long as their span at this angle; see ``triangle_mesh``."""
    particles, (ends, rest_length, kind, weight) = mesh.hinges.particles[chosen], mesh.springs
    # the hinges and the skip springs by their ends; both are in the order in which they were made where these are the same
    skip = np.flatnonzero(kind == OPPOSITE)
    size = mesh.num_particles
    keys = [np.sort(pairs, axis=1).astype(np.int64) @ [size, 1] for pairs in (mesh.hinges.particles[:, 2:], ends[skip])]
    hinge, spring = (np.argsort(key, kind="stable") for key in keys)
    spring_of = np.empty(len(skip), np.int64)
    spring_of[hinge] = skip[spring]
    own = spring_of[chosen]
    # heights of the opposite corners over the edge, and their distance along it
    xi, xj, xk, xl = (mesh.rest_positions[particles[:, c]] for c in range(4))
    along = (xj - xi) / np.linalg.norm(xj - xi, axis=1, keepdims=True)
    feet = [np.sum((corner - xi) * along, axis=1) for corner in (xk, xl)]
    heights = [np.linalg.norm(corner - xi - foot[:, None] * along, axis=1) for corner, foot in zip((xk, xl), feet)]
    span = np.sqrt(
        (feet[1] - feet[0]) ** 2 + heights[0] ** 2 + heights[1] ** 2 + 2 * heights[0] * heights[1] * np.cos(angle)
    )  # fmt: skip
    # their energy at a curvature depends on their length
    weight, rest_length = weight.copy(), rest_length.copy()
    weight[own] *= (rest_length[own] / span) ** 4
    rest_length[own] = span
    return mesh.springs._replace(rest_length=frozen(rest_length), weight=frozen(weight))


def grid(rows: int, cols: int, width: float, height: float) -> ClothMesh:
    """A rectangular sheet of ``rows`` x ``cols`` particles, ``width`` (along x) by ``height`` (along y) meters.

    The springs are those of Provot 1995: structural to the four neighbors, shear along both diagonals, and skip springs, which
    resist bending, to the second neighbors.

    Raises:
        ValueError: fewer than two rows or columns, or a side that is not positive and finite.
    """
    # bad arguments
    rows, cols = count("rows", rows, least=2), count("cols", cols, least=2)
    width, height = positive("width", width), positive("height", height)
    check_memory(f"rows={rows}, cols={cols}", rows * cols)
    # particles, row by row
    dx, dy = width / (cols - 1), height / (rows - 1)
    index = np.arange(rows * cols).reshape(rows, cols)
    y, x = np.meshgrid(np.arange(rows) * dy - height / 2, np.arange(cols) * dx - width / 2, indexing="ij")
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    # tributary widths: 1 inside, 1/2 on the border, so that area, mass and stiffness add up to those of the sheet
    across_y = np.where((np.arange(rows) == 0) | (np.arange(rows) == rows - 1), 0.5, 1.0)
    across_x = np.where((np.arange(cols) == 0) | (np.arange(cols) == cols - 1), 0.5, 1.0)
    # springs: kind, first ends, second ends, weights
    ones = np.ones((rows, cols))
    families = [
        (STRUCTURAL_X, index[:, :-1], index[:, 1:], ones[:, 1:] * across_y[:, None]),
        (STRUCTURAL_Y, index[:-1], index[1:], ones[1:] * across_x[None, :]),
        (SHEAR, index[:-1, :-1], index[1:, 1:], ones[1:, 1:]),
        (SHEAR, index[:-1, 1:], index[1:, :-1], ones[1:, 1:]),
        (BEND_X, index[:, :-2], index[:, 2:], ones[:, 2:] * across_y[:, None]),
        (BEND_Y, index[:-2], index[2:], ones[2:] * across_x[None, :]),
    ]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for _, a, b, _ in families])
    kind = np.concatenate([np.full(a.size, k) for k, a, _, _ in families])
    weight = np.concatenate([w.ravel() for *_, w in families])
    springs = colored_springs(positions, ends, kind, weight)

    # the diagonal alternates from cell to cell, so that the surface has no preferred direction
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    even = (np.add.outer(np.arange(rows - 1), np.arange(cols - 1)).ravel() % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    second = np.where(even, np.stack([a, d, c], 1), np.stack([b, d, c], 1))
    triangles = np.stack([first, second], axis=1).reshape(-1, 3).astype(np.int32)
    area = (dx * dy * np.outer(across_y, across_x)).ravel()

    # hinges of these triangles and of those with the other diagonal in each cell, each with half the weight.  With the former alone
    # every second particle differs from its neighbors and yields to a bend, which leaves a strip two thirds of its rigidity
    third = np.where(even, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    fourth = np.where(even, np.stack([b, d, c], 1), np.stack([a, d, c], 1))
    both = [colored_hinges(positions, t) for t in (triangles, np.stack([third, fourth], axis=1).reshape(-1, 3))]
    hinges = Hinges(*(np.concatenate(fields) for fields in zip(*both)))
    # e/h is right for the grid's lines.  Only the diagonals resist the twist of a cell, whose energy per area is B (d2u/dxdy)^2.
    # On square cells that needs half of e/h; then a bend stores the same energy in any direction
    diagonal = np.ptp(hinges.particles[:, :2] % cols, axis=1) * np.ptp(hinges.particles[:, :2] // cols, axis=1) > 0
    weights = np.where(diagonal, 2 * dx * dy / (dx * dx + dy * dy), hinges.weight) / 2
    hinges = Hinges(*(frozen(field) for field in hinges._replace(weight=weights)))
    return ClothMesh(
        (float(width), float(height)), frozen(positions), springs, frozen(triangles), frozen(area), hinges, (rows, cols)
    )


def colored_springs(positions: Real, ends: NDArray, kind: NDArray, weight: NDArray) -> Springs:
    """Springs between ``ends``, (springs, 2), sorted by color, at rest in these positions [m]; kind, weight: (springs,)."""
    order = np.argsort(_greedy_colors(ends, len(positions)), kind="stable")
    ends = ends[order]
    return Springs(
        particles=frozen(ends.astype(np.int32)),
        rest_length=frozen(np.linalg.norm(positions[ends[:, 0]] - positions[ends[:, 1]], axis=1)),
        kind=frozen(kind[order].astype(np.int32)),
        weight=frozen(weight[order].astype(np.float64)),
    )


def inner_edges(triangles: NDArray) -> NDArray[np.int64]:
    """Ends and opposite corners of the edges that two triangles share, (edges, 4).

    The edge (i, j, k, l) belongs to triangle (i, j, k), which has it from i to j, and to (j, i, l), which has it from j to i.
    """
    # every edge of every triangle, with its direction
    triangles = triangles.astype(np.int64)
    directed = np.concatenate([triangles[:, [0, 1, 2]], triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]])
    size = triangles.max(initial=0) + 1
    forward, backward = directed[:, 0] * size + directed[:, 1], directed[:, 1] * size + directed[:, 0]
    # the partner of an edge is the one in the opposite direction, if any; of the two, the one with i < j is kept
    order = np.argsort(forward)
    place = np.minimum(np.searchsorted(forward[order], backward), len(directed) - 1)
    partner = order[place]
    both = (forward[partner] == backward) & (directed[:, 0] < directed[:, 1])
    return np.concatenate([directed[both], directed[partner[both], 2:]], axis=1)


def colored_hinges(positions: Real, triangles: NDArray) -> Hinges:
    """The inner edges of triangles, sorted by color, flat or bent as they are in these positions [m].

    The weight is ``e/h``, with h the mean height of both triangles over the edge: ``e^2/(A_0 + A_1)``.  It is exact for a cylinder
    of equilateral triangles (Seung and Nelson 1988, eq. 13, ``kappa = sqrt(3)/2 kappa~``).
    """
    # no triangles, no hinges
    if not len(triangles):
        none = np.zeros(0)
        return Hinges(np.zeros((0, 4), np.int32), none, none, np.zeros((0, 4)))
    # the edges by color
    particles = inner_edges(triangles)
    particles = particles[np.argsort(_greedy_colors(particles, len(positions)), kind="stable")]
    # the angle at rest, as in ``bending.hinge_angles``
    xi, xj, xk, xl = (positions[particles[:, c]] for c in range(4))
    e, a, b = xj - xi, xk - xi, xl - xi
    length = np.linalg.norm(e, axis=1)
    one, two = np.cross(e, a), np.cross(b, e)  # normals times twice the areas
    one_size, two_size = np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1)
    angle = np.arctan2(-length * np.sum(one * b, axis=1), np.sum(one * two, axis=1))
    # displacing a corner at height h over the edge changes the angle by 1/h; the foot of the height divides the opposite change
    # between the ends
    tilt_k, tilt_l = -length / one_size, -length / two_size
    foot_k, foot_l = np.sum(a * e, axis=1) / length**2, np.sum(b * e, axis=1) / length**2
    slopes = np.stack([-(1 - foot_k) * tilt_k - (1 - foot_l) * tilt_l, -foot_k * tilt_k - foot_l * tilt_l, tilt_k, tilt_l], axis=1)
    return Hinges(
        particles=frozen(particles.astype(np.int32)),
        weight=frozen(length**2 / ((one_size + two_size) / 2)),
        rest_angle=frozen(np.where(np.abs(angle) < 1e-9, 0.0, angle)),
        slopes=frozen(slopes),
    )


def _greedy_colors(members: NDArray[np.int64], particles: int) -> NDArray[np.int64]:
    """Colors such that no two elements of one color share a particle, (elements,); members: (elements, particles of each).

    Element by element, each gets the smallest color that none of its particles has yet.
    """
    taken: list[set[int]] = [set() for _ in range(particles)]
    colors = np.empty(len(members), np.int64)
    for element, own in enumerate(members.tolist()):
        color = 0
        while any(color in taken[p] for p in own):
            color += 1
        for p in own:
            taken[p].add(color)
        colors[element] = color
    return colors


def frozen(array: NDArray) -> NDArray:
    """The same array, from now on read-only."""
    array.flags.writeable = False
    return array

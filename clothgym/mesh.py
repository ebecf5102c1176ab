"""Floor 1: the sheet as particles, springs and triangles: immutable, validated, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import positive

Int = NDArray[np.int32]
Real = NDArray[np.float64]

# spring kinds: each has a stiffness of its own (see material.spring_stiffness)
STRUCTURAL_X, STRUCTURAL_Y, SHEAR, BEND_X, BEND_Y = range(5)
NUM_KINDS = 5


class Springs(NamedTuple):
    """Springs sorted by colour: no two of one colour share a particle.

    particles: ends, (springs, 2).  rest_length: [m], (springs,).  kind: index of the stiffness, (springs,).
    weight: share of that stiffness, (springs,); a border spring stands for half a strip of cloth.
    """

    particles: Int
    rest_length: Real
    kind: Int
    weight: Real


@dataclass(frozen=True, eq=False)
class ClothMesh:
    """A rectangular sheet at rest in the plane z = 0, centred on the origin.

    Attributes:
        shape: particles along y and x (rows, columns).
        size: width along x and height along y [m].
        rest_positions: particles at rest [m], (particles, 3); row r, column c is particle ``r * columns + c``.
        springs: structural, shear and skip-one springs.
        triangles: particle indices, (triangles, 3), counter-clockwise seen from +z.
        area: share of the sheet's area that each particle stands for [m^2], (particles,).
    """

    shape: tuple[int, int]
    size: tuple[float, float]
    rest_positions: Real
    springs: Springs
    triangles: Int
    area: Real

    @property
    def num_particles(self) -> int:
        return len(self.rest_positions)

    @property
    def spacing(self) -> tuple[float, float]:
        """Rest distance of neighbours along x and y [m]."""
        return self.size[0] / (self.shape[1] - 1), self.size[1] / (self.shape[0] - 1)

    @property
    def corners(self) -> tuple[int, int, int, int]:
        """Particles at (-x, -y), (+x, -y), (-x, +y), (+x, +y)."""
        rows, columns = self.shape
        return 0, columns - 1, (rows - 1) * columns, rows * columns - 1


def grid(rows: int, cols: int, width: float, height: float) -> ClothMesh:
    """A rectangular sheet of ``rows`` x ``cols`` particles, ``width`` (along x) by ``height`` (along y) metres.

    Springs as in Provot 1995: structural to the four neighbours, shear along both diagonals, bend to the next but one.

    Raises:
        ValueError: fewer than two rows or columns, or a side that is not positive and finite.
    """
    for name, count in (("rows", rows), ("cols", cols)):
        if not isinstance(count, (int, np.integer)) or count < 2:
            raise ValueError(f"{name}={count!r}: a sheet needs at least 2 {name} of particles, as an integer")
    for name, side in (("width", width), ("height", height)):
        positive(name, side)
    rows, cols = int(rows), int(cols)
    dx, dy = width / (cols - 1), height / (rows - 1)
    index = np.arange(rows * cols).reshape(rows, cols)
    y, x = np.meshgrid(np.arange(rows) * dy - height / 2, np.arange(cols) * dx - width / 2, indexing="ij")
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    # tributary widths: 1 inside, 1/2 on the border, so that area, mass and stiffness all sum to the sheet's own
    across_y = np.where((np.arange(rows) == 0) | (np.arange(rows) == rows - 1), 0.5, 1.0)
    across_x = np.where((np.arange(cols) == 0) | (np.arange(cols) == cols - 1), 0.5, 1.0)
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
    order = np.argsort(_greedy_colours(ends, rows * cols), kind="stable")
    ends = ends[order]
    springs = Springs(
        particles=_frozen(ends.astype(np.int32)),
        rest_length=_frozen(np.linalg.norm(positions[ends[:, 0]] - positions[ends[:, 1]], axis=1)),
        kind=_frozen(kind[order].astype(np.int32)),
        weight=_frozen(weight[order]),
    )

    # the diagonal alternates from cell to cell, so that the surface has no preferred direction
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    even = (np.add.outer(np.arange(rows - 1), np.arange(cols - 1)).ravel() % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    second = np.where(even, np.stack([a, d, c], 1), np.stack([b, d, c], 1))
    triangles = np.stack([first, second], axis=1).reshape(-1, 3).astype(np.int32)
    area = (dx * dy * np.outer(across_y, across_x)).ravel()
    return ClothMesh((rows, cols), (float(width), float(height)), _frozen(positions), springs, _frozen(triangles), _frozen(area))


def _greedy_colours(ends: NDArray[np.int64], particles: int) -> NDArray[np.int64]:
    """Smallest colour that neither end of a spring has yet, spring by spring."""
    taken: list[set[int]] = [set() for _ in range(particles)]
    colours = np.empty(len(ends), np.int64)
    for spring, (a, b) in enumerate(ends.tolist()):
        colour = 0
        while colour in taken[a] or colour in taken[b]:
            colour += 1
        taken[a].add(colour)
        taken[b].add(colour)
        colours[spring] = colour
    return colours


def _frozen(array: NDArray) -> NDArray:
    array.flags.writeable = False
    return array

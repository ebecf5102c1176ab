"""The colliders of a batch, in the memory layout of the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import vectors
from clothgym.collisions.solids.mesh_collider import MeshCollider
from clothgym.collisions.solids.penetration import Contacts, contacts, deepest
from clothgym.collisions.solids.shapes import (
    COLLIDER_ROWS,
    R_AFTER,
    R_POINT,
    R_REMAINDER,
    R_VELOCITY,
    Collider,
    check_index,
    check_replacement,
    check_rows,
)
from clothgym.collisions.solids.signed_distance import Shapes
from clothgym.elements import SurfaceArrays
from clothgym.layout import Layout
from clothgym.state import State


class Solid(NamedTuple):
    """Solids as kernels see them.

    shapes: what all environments share.  rows: (blocks, colliders, COLLIDER_ROWS, lanes).
    """

    shapes: Shapes
    rows: NDArray


class Solids:
    """The colliders of a batch, each with its own pose in every environment.

    Attributes:
        colliders: as given.
        shapes: what all environments share.
        rows, homes: numbers that kernels read, now and after a reset, (blocks, colliders, COLLIDER_ROWS, lanes).
    """

    def __init__(self, layout: Layout, colliders: Sequence[Collider], time_step: float, dtype: np.dtype) -> None:
        self.layout, self.colliders, self.time_step, self.dtype = layout, tuple(colliders), time_step, dtype
        self.shapes = _shapes(self.colliders, dtype)
        self.rows: NDArray
        self.homes: NDArray

    @property
    def solid(self) -> Solid:
        """What kernels take."""
        return Solid(self.shapes, self.rows)

    def described(self) -> NDArray[np.float64]:
        """Rows of the colliders as given, (colliders, COLLIDER_ROWS)."""
        return np.array([c.rows() for c in self.colliders]).reshape(-1, COLLIDER_ROWS)

    def check(self, state: State) -> None:
        """Refuse numbers that no collider has, see ``check_rows``."""
        for name in ("colliders", "collider_homes"):
            check_rows(name, getattr(state, name))

    def restore(self, state: State) -> None:
        """Take over what a state holds of the colliders."""
        self.rows = self.layout.to_blocks(state.colliders, self.dtype)
        self.homes = self.layout.to_blocks(state.collider_homes, self.dtype)

    def public(self) -> dict[str, NDArray]:
        """What a state holds of the colliders, as fresh copies."""
        return {"colliders": self.layout.to_public(self.rows), "collider_homes": self.layout.to_public(self.homes)}

    def begin(self, block: NDArray, lane: NDArray) -> None:
        """Move the solids of some environments back to where they began."""
        self.rows[block, :, :, lane] = self.homes[block, :, :, lane]

    def replace(self, index: int, others: Sequence[Collider], block: NDArray, lane: NDArray) -> None:
        """Replace collider ``index`` by others of the same kind, one for each environment."""
        check_replacement(self.colliders, index, others, len(block))
        self.rows[block, index, :, lane] = self.homes[block, index, :, lane] = np.array([c.rows() for c in others])

    def move(self, index: int, targets: ArrayLike | None, velocities: ArrayLike | None, env: NDArray) -> None:
        """See ``Simulation.move_colliders``."""
        check_index(self.colliders, index)
        if targets is None and velocities is None:
            raise ValueError("move_colliders: give targets, velocities, or both")
        after = np.zeros((len(env), 3)) if velocities is None else vectors("velocities", velocities, len(env))
        block, lane = self.layout.at(env)
        now = after
        if targets is not None:
            x = vectors("targets", targets, len(env))
            point, remainder = (self.rows[block, index, first : first + 3, lane] for first in (R_POINT, R_REMAINDER))
            now = (x - point - remainder) / self.time_step
        self.rows[block, index, R_VELOCITY : R_VELOCITY + 3, lane] = now
        self.rows[block, index, R_AFTER : R_AFTER + 3, lane] = after

    def end_step(self, blocks: slice | list[int] = slice(None)) -> None:
        """Colliders of these blocks have reached their targets: each goes on with its velocity for afterwards."""
        self.rows[blocks, :, R_VELOCITY : R_VELOCITY + 3] = self.rows[blocks, :, R_AFTER : R_AFTER + 3]

    def positions(self) -> NDArray:
        """Position of each collider [m]: its center, or a point of a plane, (num_envs, colliders, 3)."""
        return self.layout.to_public(self.rows[:, :, R_POINT : R_POINT + 3])

    def contacts(self, x: NDArray) -> Contacts:
        """Signed distance from each particle to the nearest collider [m], and which one that is; x: in blocks [m]."""
        return contacts(self.layout, x, self.shapes, self.rows)

    def penetration(self, x: NDArray, surface: SurfaceArrays) -> NDArray:
        """Depth of the deepest point of the sheet's triangles in the colliders [m], (num_envs,); x: in blocks [m]."""
        out = np.zeros((self.layout.blocks, self.layout.lanes), x.dtype)
        deepest(0, self.layout.blocks, x, surface.triangles, self.shapes, self.rows, out)
        return self.layout.to_public(out)


def _shapes(colliders: Sequence[Collider], dtype: np.dtype) -> Shapes:
    """The kinds and distance grids of the colliders, for the kernels."""
    nodes: list[NDArray] = [np.zeros((0, 4))]
    first, sizes, corners, cells = [], [], [], []
    count = 0
    # all grids lie in one array, one after the other; other kinds have none
    for collider in colliders:
        first.append(count)
        grid = collider.grid if isinstance(collider, MeshCollider) else None
        sizes.append(grid.nodes.shape[:3] if grid is not None else (0, 0, 0))
        corners.append(grid.corner if grid is not None else np.zeros(3))
        cells.append(grid.cell if grid is not None else 1.0)
        if grid is not None:
            nodes.append(grid.nodes.reshape(-1, 4))
            count += len(nodes[-1])
    return Shapes(
        np.array([c.known_kind() for c in colliders], np.int64),
        np.concatenate(nodes).astype(dtype),
        np.array(first, np.int64),
        np.array(sizes, np.int64).reshape(-1, 3),
        np.array(corners, dtype).reshape(-1, 3),
        np.array(cells, dtype),
    )

"""The colliders of a batch, in the memory layout of the kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions.response import Contacts, contacts
from clothgym.collisions.shapes import ROWS, Collider, check_replacement
from clothgym.state import Layout, State


class Solids:
    """Solids, each in its place in every environment.

    Attributes:
        colliders: as they were given.
        kinds: of each, (colliders,).
        rows, homes: what the kernels know of each now, and at a reset, (block, colliders, ROWS, lane).
    """

    def __init__(self, layout: Layout, colliders: Sequence[Collider]) -> None:
        self.layout, self.colliders = layout, tuple(colliders)
        self.kinds = np.array([c.kind for c in colliders], np.int64)
        self.rows: NDArray
        self.homes: NDArray

    def described(self) -> NDArray[np.float64]:
        """The rows of the colliders as they were given, (colliders, ROWS)."""
        return np.array([c.rows() for c in self.colliders]).reshape(-1, ROWS)

    def restore(self, state: State, dtype: np.dtype) -> None:
        """Take over a state's part."""
        self.rows, self.homes = (self.layout.to_blocks(part, dtype) for part in (state.colliders, state.collider_homes))

    def public(self) -> dict[str, NDArray]:
        """A state's part, as fresh copies."""
        return {"colliders": self.layout.to_public(self.rows), "collider_homes": self.layout.to_public(self.homes)}

    def begin(self, block: NDArray, lane: NDArray) -> None:
        """Put solids that have moved back to where they began."""
        self.rows[block, :, :, lane] = self.homes[block, :, :, lane]

    def replace(self, index: int, others: Sequence[Collider], block: NDArray, lane: NDArray) -> None:
        """Put others of the same family in place of a collider, one an environment."""
        check_replacement(self.colliders, index, others, len(block))
        self.rows[block, index, :, lane] = self.homes[block, index, :, lane] = np.array([c.rows() for c in others])

    def contacts(self, x: NDArray) -> Contacts:
        """Signed distance of each particle to the nearest collider [m], and which it is; x in blocks."""
        return contacts(self.layout, x, self.kinds, self.rows)

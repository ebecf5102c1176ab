"""Floor 1: how a batch lies in memory.

Public arrays have the environment first, ``(num_envs, particles, 3)``.  Kernels see ``(block, component, particle, lane)``, and
vectorize over the elements that are adjacent in memory.

Under a method in which the order of the springs does not matter, that is the sheet's own particles: a block is one environment, of
one lane.  The springs of one kind of a regular grid are one loop with a constant offset (see ``grid_forces``); those of any other
sheet are gathered (see ``sheet_forces``).  One environment then costs no more than each of many.  For Gauss-Seidel methods, and for
large batches of triangle meshes, it is the environments: a block has many lanes, which share a spring's indices and rest length, so
that nothing is gathered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import as_array, indices, shown

# lanes in a block: wide enough to hide the loop's overhead, narrow enough that a 25 x 25 sheet stays near the L2 cache
WIDEST_BLOCK = 128
VECTOR = 16  # float32 lanes of the widest vector unit in use; blocks are padded to a multiple of it


class Layout(NamedTuple):
    """Which block and lane an environment has.  Lanes beyond ``num_envs`` are padding; they repeat the last environment.

    kind: "grid" or "sheet" where one sheet's particles lie side by side, and a block is one environment; or "lanes".
    """

    num_envs: int
    blocks: int
    lanes: int
    kind: str

    @property
    def by_particle(self) -> bool:
        """Whether one sheet's particles lie side by side."""
        return self.kind != "lanes"

    @staticmethod
    def choose(num_envs: int, threads: int, any_order: bool, regular: bool) -> Layout:
        """One lane a block where particles lie side by side; else as few and as wide blocks as give every thread the same number.

        any_order: whether the order of the springs does not matter to the method.  regular: whether the sheet is a regular grid.
        """
        if any_order and (regular or num_envs < VECTOR):
            return Layout(num_envs, num_envs, 1, "grid" if regular else "sheet")
        blocks = min(-(-num_envs // VECTOR), threads * -(-num_envs // (threads * WIDEST_BLOCK)))
        lanes = -(-num_envs // blocks)
        if lanes >= VECTOR:
            lanes = -(-lanes // VECTOR) * VECTOR
        return Layout(num_envs, -(-num_envs // lanes), lanes, "lanes")

    def to_blocks(self, public: NDArray, dtype: NDArray | np.dtype) -> NDArray:
        """(num_envs, ...) to a new contiguous (blocks, ..., lanes)."""
        if self.lanes == 1:
            return np.array(public[..., None], dtype=dtype, order="C")
        spare = self.blocks * self.lanes - self.num_envs
        padded = np.concatenate([public, np.repeat(public[-1:], spare, axis=0)]) if spare else public
        split = padded.reshape(self.blocks, self.lanes, *public.shape[1:])
        return np.array(np.moveaxis(split, 1, -1), dtype=dtype, order="C")

    def to_public(self, blocks: NDArray) -> NDArray:
        """(blocks, ..., lanes) to a new contiguous (num_envs, ...)."""
        if self.lanes == 1:  # an axis to drop, none to move
            return blocks[..., 0].copy()
        moved = np.moveaxis(blocks, -1, 1)
        return moved.reshape(self.blocks * self.lanes, *moved.shape[2:])[: self.num_envs].copy()

    def vectors_to_blocks(self, public: NDArray, dtype: NDArray | np.dtype) -> NDArray:
        """Vectors of particles, (num_envs, particles, 3), to a new contiguous (blocks, 3, particles, lanes)."""
        return self.to_blocks(np.swapaxes(public, 1, 2), dtype)

    def vectors_to_public(self, blocks: NDArray) -> NDArray:
        """(blocks, 3, particles, lanes) to a new contiguous (num_envs, particles, 3)."""
        if self.lanes == 1:
            return np.swapaxes(blocks[..., 0], 1, 2).copy()
        return np.ascontiguousarray(np.swapaxes(self.to_public(blocks), 1, 2))

    def at(self, envs: Any) -> tuple[Any, Any]:
        """Block and lane of an environment, or of several, (envs,): two integers, or two arrays of them."""
        return np.divmod(envs, self.lanes)

    def alone(self, envs: ArrayLike, method: str) -> list[int]:
        """Environments that are to be advanced without the others, under a method of that name; also their blocks.

        Raises:
            ValueError: there is no such environment, or they share their block with others.
        """
        chosen = self.chosen(envs).tolist()
        if not self.by_particle:
            raise ValueError(
                f"step(envs=...): with {method} on this mesh {self.num_envs} environments lie side by side in memory and advance "
                f"together; leave envs out, or take a grid, or less than {VECTOR} environments, with an integrator in which the "
                "order of the springs does not matter"
            )
        return chosen

    def chosen(self, envs: ArrayLike | None, once: bool = True) -> NDArray:
        """The environments that someone names: all of them, those of a mask, or by index; each but ``once``, or as often as wanted.

        Raises:
            ValueError: there is no such environment, one is named twice, or the mask is not one of this batch.
        """
        if envs is None:
            return np.arange(self.num_envs)
        index = as_array(envs)
        if index is not None and index.dtype == bool:
            if index.shape != (self.num_envs,):
                raise ValueError(f"envs: a mask of environments must have shape {(self.num_envs,)}, not {index.shape}")
            return np.flatnonzero(index)
        index = indices("envs", envs, self.num_envs, "this batch's environments")
        if once and len(index) > 1 and len(np.unique(index)) < len(index):
            raise ValueError(f"envs={shown(envs)}: names an environment twice")
        return index

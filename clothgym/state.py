"""Floor 2: how a batch lies in memory, and all that is needed to continue it bit for bit.

Public arrays have the environment first, ``(num_envs, particles, 3)``.  Kernels see blocks of lanes with the environment
last, ``(block, particle, component, lane)``: the inner loop of every kernel runs over lanes, with the spring's indices and
rest length shared by all of them, so that nothing is gathered and any integrator vectorises.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.mesh import ClothMesh

# lanes in a block: wide enough to hide the loop's overhead, narrow enough that a 25 x 25 sheet stays near the L2 cache
WIDEST_BLOCK = 128
VECTOR = 16  # float32 lanes of the widest vector unit in use; blocks are padded to a multiple of it


class SpringArrays(NamedTuple):
    """The mesh's springs in the kernel's dtype, shared by all lanes (see ``mesh.Springs``)."""

    particles: NDArray
    rest_length: NDArray
    kind: NDArray
    weight: NDArray


class Fabric(NamedTuple):
    """Parameters that may differ by lane.

    stiffness: spring constants by kind [N/m], (block, kinds, lane).  damping_time [s], (block, lane).
    drag_rate: air drag per mass [1/s], (block, lane).  gravity [m/s^2] and wind [m/s], (block, 3, lane).
    """

    stiffness: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    gravity: NDArray
    wind: NDArray


class Layout(NamedTuple):
    """Which block and lane an environment has.  Lanes beyond ``num_envs`` are padding; they repeat the last environment."""

    num_envs: int
    blocks: int
    lanes: int

    @staticmethod
    def choose(num_envs: int, threads: int) -> Layout:
        """As few and as wide blocks as give every thread the same number of them."""
        blocks = min(-(-num_envs // VECTOR), threads * -(-num_envs // (threads * WIDEST_BLOCK)))
        lanes = -(-num_envs // blocks)
        if lanes >= VECTOR:
            lanes = -(-lanes // VECTOR) * VECTOR
        return Layout(num_envs, -(-num_envs // lanes), lanes)

    def to_blocks(self, public: NDArray, dtype: NDArray | np.dtype) -> NDArray:
        """(num_envs, ...) to a new contiguous (blocks, ..., lanes)."""
        if self.num_envs == 1:
            return np.array(public[..., None], dtype=dtype, order="C")
        spare = self.blocks * self.lanes - self.num_envs
        padded = np.concatenate([public, np.repeat(public[-1:], spare, axis=0)]) if spare else public
        split = padded.reshape(self.blocks, self.lanes, *public.shape[1:])
        return np.array(np.moveaxis(split, 1, -1), dtype=dtype, order="C")

    def to_public(self, blocks: NDArray) -> NDArray:
        """(blocks, ..., lanes) to a new contiguous (num_envs, ...)."""
        if self.num_envs == 1:  # an axis to drop, none to move: the single environment asks often
            return blocks[..., 0].copy()
        moved = np.moveaxis(blocks, -1, 1)
        return moved.reshape(self.blocks * self.lanes, *moved.shape[2:])[: self.num_envs].copy()

    def place(self, envs: NDArray) -> tuple[NDArray, NDArray]:
        """Block and lane of each environment."""
        return np.divmod(envs, self.lanes)


@dataclass
class State:
    """A batch in mid-flight: restored with ``Simulation.set_state`` it continues bit for bit.

    Attributes (first axis is the environment unless said):
        positions, velocities: [m], [m/s], (num_envs, particles, 3).
        free_inverse_mass: inverse masses were nothing held [1/kg], (num_envs, particles).
        anchors: the anchored particles, (num_envs, anchors).
        attached: whether the anchor holds its particle, (num_envs, anchors).
        anchor_targets: where each anchor is going [m], (num_envs, anchors, 3).
        stiffness, damping_time, drag_rate, gravity, wind: see ``Fabric``.
        parameters: the material figures they came from, (num_envs, figures).
        colliders: pose, size, friction and velocity of each collider, (num_envs, colliders, rows).
        collider_homes: the same where they are put at a reset.
        steps: control steps since the environment's reset, (num_envs,).
    """

    positions: NDArray
    velocities: NDArray
    free_inverse_mass: NDArray
    anchors: NDArray
    attached: NDArray
    anchor_targets: NDArray
    stiffness: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    gravity: NDArray
    wind: NDArray
    parameters: NDArray
    colliders: NDArray
    collider_homes: NDArray
    steps: NDArray

    def save(self, path: str | Path) -> None:
        """Write as ``npz`` without pickle."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @staticmethod
    def load(path: str | Path) -> State:
        """Read what ``save`` wrote.

        Raises:
            ValueError: the file misses arrays, for instance because another version wrote it.
        """
        with np.load(path, allow_pickle=False) as file:
            missing = [field.name for field in fields(State) if field.name not in file]
            if missing:
                raise ValueError(f"{str(path)!r} is not a state of this version of clothgym: it lacks {', '.join(missing)}")
            return State(**{field.name: file[field.name] for field in fields(State)})


def spring_arrays(mesh: ClothMesh, dtype: np.dtype, by_particle: bool) -> SpringArrays:
    """The mesh's springs as a kernel of this dtype wants them: sorted by colour, or by particle if ``by_particle``.

    Where the order does not matter to the method, that by particle is a fifth faster on wide blocks: a particle's rows are
    still in the first cache when its next spring comes.  Gauss-Seidel keeps the colours, which have no preferred direction.
    """
    s = mesh.springs
    order = np.lexsort((s.particles.max(axis=1), s.particles.min(axis=1))) if by_particle else np.arange(len(s.kind))
    return SpringArrays(s.particles[order], s.rest_length[order].astype(dtype), s.kind[order], s.weight[order].astype(dtype))

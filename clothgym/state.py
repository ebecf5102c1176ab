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

from clothgym.mesh import NUM_KINDS, ClothMesh

# lanes in a block: wide enough to hide the loop's overhead, narrow enough that a 25 x 25 sheet stays near the L2 cache
WIDEST_BLOCK = 128
VECTOR = 16  # float32 lanes of the widest vector unit in use; blocks are padded to a multiple of it


class SpringArrays(NamedTuple):
    """The mesh's springs in the kernel's dtype, shared by all lanes (see ``mesh.Springs``)."""

    particles: NDArray
    rest_length: NDArray
    kind: NDArray
    weight: NDArray


class SurfaceArrays(NamedTuple):
    """The mesh's triangles, (triangles, 3), and the shares of each that its corners stand for, (triangles, 3)."""

    triangles: NDArray
    shares: NDArray


class Fabric(NamedTuple):
    """Parameters that may differ by lane.

    stiffness: spring constants by kind [N/m], (block, kinds, lane).  damping_time [s], (block, lane).
    drag_rate: linear drag per mass [1/s], (block, lane).  resistance: half the air's density times the coefficients
    of drag and skin friction [kg/m^3], (block, 2, lane).  gravity [m/s^2] and wind [m/s], (block, 3, lane).
    """

    stiffness: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    resistance: NDArray
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
        holder: which hand holds each particle, anchors first, then grippers; -1 if none does, (num_envs, particles).
        hand_positions, hand_targets: where each hand is and is going [m], (num_envs, hands, 3).
        openings, wanted_openings: of the grippers' fingers, from 0 to 1, (num_envs, hands).
        stiffness, damping_time, drag_rate, resistance, gravity, wind: see ``Fabric``.
        parameters: the material figures they came from, (num_envs, figures).
        colliders: pose, size, friction and velocity of each collider, (num_envs, colliders, rows).
        collider_homes: the same where they are put at a reset.
        steps: control steps since the environment's reset, (num_envs,).
    """

    positions: NDArray
    velocities: NDArray
    free_inverse_mass: NDArray
    anchors: NDArray
    holder: NDArray
    hand_positions: NDArray
    hand_targets: NDArray
    openings: NDArray
    wanted_openings: NDArray
    stiffness: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    resistance: NDArray
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


def at_rest(
    mesh: ClothMesh,
    num_envs: int,
    anchors: NDArray,
    hands: int,
    parameters: NDArray,
    gravity: NDArray,
    wind: NDArray,
    colliders: NDArray,
) -> State:
    """A batch at its rest positions that nothing holds yet; what follows from the parameters is still zero.

    anchors: particles, (anchors,).  hands: how many.  parameters: (figures,).  gravity, wind: (3,).  colliders: (colliders,
    rows).
    """

    def each(value: NDArray) -> NDArray:
        return np.broadcast_to(value, (num_envs, *np.shape(value)))

    return State(
        positions=each(mesh.rest_positions),
        velocities=np.zeros((num_envs, mesh.num_particles, 3)),
        free_inverse_mass=np.zeros((num_envs, mesh.num_particles)),
        anchors=each(anchors),
        holder=np.full((num_envs, mesh.num_particles), -1, np.int16),
        hand_positions=np.zeros((num_envs, hands, 3)),
        hand_targets=np.zeros((num_envs, hands, 3)),
        openings=np.zeros((num_envs, hands)),
        wanted_openings=np.zeros((num_envs, hands)),
        stiffness=np.zeros((num_envs, NUM_KINDS)),
        damping_time=np.zeros(num_envs),
        drag_rate=np.zeros(num_envs),
        resistance=np.zeros((num_envs, 2)),
        gravity=each(gravity),
        wind=each(wind),
        parameters=each(parameters),
        colliders=each(colliders),
        collider_homes=each(colliders),
        steps=np.zeros(num_envs, np.int64),
    )


def spring_arrays(mesh: ClothMesh, dtype: np.dtype, by_particle: bool) -> SpringArrays:
    """The mesh's springs as a kernel of this dtype wants them: sorted by colour, or by particle if ``by_particle``.

    Where the order does not matter to the method, that by particle is a fifth faster on wide blocks: a particle's rows are
    still in the first cache when its next spring comes.  Gauss-Seidel keeps the colours, which have no preferred direction.
    """
    s = mesh.springs
    order = np.lexsort((s.particles.max(axis=1), s.particles.min(axis=1))) if by_particle else np.arange(len(s.kind))
    return SpringArrays(s.particles[order], s.rest_length[order].astype(dtype), s.kind[order], s.weight[order].astype(dtype))


def surface_arrays(mesh: ClothMesh, dtype: np.dtype) -> SurfaceArrays:
    """The mesh's triangles as a kernel of this dtype wants them.

    A corner's share of a triangle follows from the area that the particle stands for: on a grid, whose diagonals alternate,
    thirds would give every second particle twice its neighbours' force.
    """
    triangles = mesh.triangles
    around = np.bincount(triangles.ravel(), minlength=mesh.num_particles)
    shares = mesh.area[triangles] / np.maximum(around, 1)[triangles]
    return SurfaceArrays(triangles, (shares / shares.sum(axis=1, keepdims=True)).astype(dtype))

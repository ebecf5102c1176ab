"""Floor 2: how a batch lies in memory, and all that is needed to continue it bit for bit.

Public arrays have the environment first, ``(num_envs, particles, 3)``.  Kernels see ``(block, component, particle, lane)``, and
what lies side by side is what they do at once.

For a grid under a method in which the order of the springs does not matter, that is the sheet's own particles: a block is one
environment, of one lane, and the springs of one kind are one loop with a constant offset (see ``grid_forces``).  One environment
then costs no more than each of many.  For triangle meshes and Gauss-Seidel methods it is the environments: a block has many lanes,
which share a spring's indices and rest length, so that nothing is gathered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import files
from clothgym.checks import LARGEST, as_array, fits, indices, shown
from clothgym.contact_memory import SAVED
from clothgym.elements import SpringArrays
from clothgym.mesh import NUM_KINDS, ClothMesh

# lanes in a block: wide enough to hide the loop's overhead, narrow enough that a 25 x 25 sheet stays near the L2 cache
WIDEST_BLOCK = 128
VERSION = 2  # of the format of files
# least and greatest values in a state; all others lie within LARGEST
NOT_NEGATIVE = ("free_inverse_mass", "stiffness", "rigidity", "damping_time", "drag_rate", "resistance", "parameters")
RANGES: dict[str, tuple[float, float]] = {name: (0, LARGEST) for name in NOT_NEGATIVE}
RANGES |= {"openings": (0, 1), "wanted_openings": (0, 1), "steps": (0, 2**62)}
# diverge with an environment; a reset mends them
MAY_DIVERGE = ("positions", "velocities", "remainders", "attachment_positions", "attachment_targets")
VECTOR = 16  # float32 lanes of the widest vector unit in use; blocks are padded to a multiple of it


class Fabric(NamedTuple):
    """Parameters that may differ by lane.

    stiffness: spring constants by kind [N/m], (block, kinds, lane).  rigidity: of the hinges [N m], (block, lane).
    damping_time [s], (block, lane).
    drag_rate: linear drag per mass [1/s], (block, lane). resistance: half the air's density times the coefficients of drag and
    skin friction [kg/m^3], and the sheet's mass per area [kg/m^2], (block, 3, lane). gravity [m/s^2] and wind [m/s], (block, 3,
    lane).
    """

    stiffness: NDArray
    rigidity: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    resistance: NDArray
    gravity: NDArray
    wind: NDArray


class View(NamedTuple):
    """The live memory of a simulation, for kernels that read it: see the module.

    x, v: [m], [m/s], (block, 3, particles, lane).
    attachments: where anchors and then grippers are [m], (block, attachments, 3, lane).  openings: of their fingers, (block,
    attachments, lane).
    blocked: whether solids stopped or deflected them in the last control step, (block, attachments, lane).
    holder: which of them holds each particle, or -1, (block, particles, lane).
    """

    x: NDArray
    v: NDArray
    springs: SpringArrays
    attachments: NDArray
    openings: NDArray
    blocked: NDArray
    holder: NDArray


class Orders(NamedTuple):
    """Targets for the next step, live: kernels write here what has been checked before.

    targets: where attachments are to be [m], (block, attachments, 3, lane).  openings: how far their fingers are to open, from 0 to
    1, (block, attachments, lane).  wind: velocity of the air [m/s], (block, 3, lane).
    """

    targets: NDArray
    openings: NDArray
    wind: NDArray


class Layout(NamedTuple):
    """Which block and lane an environment has.  Lanes beyond ``num_envs`` are padding; they repeat the last environment.

    by_particle: whether one sheet's particles lie side by side; then a block is one environment.
    """

    num_envs: int
    blocks: int
    lanes: int
    by_particle: bool

    @staticmethod
    def choose(num_envs: int, threads: int, by_particle: bool) -> Layout:
        """One lane a block where particles lie side by side; else as few and as wide blocks as give every thread the same
        number."""
        if by_particle:
            return Layout(num_envs, num_envs, 1, True)
        blocks = min(-(-num_envs // VECTOR), threads * -(-num_envs // (threads * WIDEST_BLOCK)))
        lanes = -(-num_envs // blocks)
        if lanes >= VECTOR:
            lanes = -(-lanes // VECTOR) * VECTOR
        return Layout(num_envs, -(-num_envs // lanes), lanes, False)

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
                f"step(envs=...): with {method} on this mesh environments lie side by side in memory and advance together; leave "
                "envs out, or take a grid with an integrator in which the order of the springs does not matter"
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


@dataclass
class State:
    """A batch in mid-flight: restored with ``Simulation.set_state`` it continues bit for bit.

    Attributes (first axis is the environment unless said):
        positions, velocities: [m], [m/s], (num_envs, particles, 3).
        remainders: what positions and velocities could not hold, see ``integrators.base``, (num_envs, 2, 3, particles).
        free_inverse_mass: inverse masses were nothing held [1/kg], (num_envs, particles).
        anchors: the anchored particles, (num_envs, anchors).
        holder: which attachment holds each particle, anchors first, then grippers; -1 if none does, (num_envs, particles).
        attachment_positions, attachment_targets: where each attachment is and is going [m], (num_envs, attachments, 3).
        openings, wanted_openings: of the grippers' fingers, from 0 to 1, (num_envs, attachments).
        stiffness, rigidity, damping_time, drag_rate, resistance, gravity, wind: see ``Fabric``.
        parameters: the material properties they came from, (num_envs, properties).
        colliders: pose, size, friction and velocity of each collider, (num_envs, colliders, rows).
        collider_homes: the same where they are put at a reset.
        self_contact: what the sheet's contact with itself remembers, by the names of ``contact_memory.SAVED``.
        steps: control steps since the environment's reset, (num_envs,).
        diverged: whether something was not finite, or faster than cloth can be, since then, (num_envs,).
        sheet: digest of the mesh and of what bends, the same for all, ().
    """

    positions: NDArray
    velocities: NDArray
    remainders: NDArray
    free_inverse_mass: NDArray
    anchors: NDArray
    holder: NDArray
    attachment_positions: NDArray
    attachment_targets: NDArray
    openings: NDArray
    wanted_openings: NDArray
    stiffness: NDArray
    rigidity: NDArray
    damping_time: NDArray
    drag_rate: NDArray
    resistance: NDArray
    gravity: NDArray
    wind: NDArray
    parameters: NDArray
    colliders: NDArray
    collider_homes: NDArray
    self_contact: dict[str, NDArray]
    steps: NDArray
    diverged: NDArray
    sheet: NDArray

    def arrays(self) -> dict[str, NDArray]:
        """All arrays by name; those of contact are ``self_contact.start`` and so on."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "self_contact"}
        return own | {f"self_contact.{name}": array for name, array in self.self_contact.items()}

    def save(self, path: str | Path) -> None:
        """Write as ``npz`` without pickle, whole or not at all.

        Raises:
            OSError: the disk is full, or the folder cannot be written.
        """
        files.write_arrays(path, "state", VERSION, self.arrays())

    @staticmethod
    def load(path: str | Path) -> State:
        """Read what ``save`` wrote; ``Simulation.set_state`` checks that it fits.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is no state, is damaged, or is of another version.
        """
        advice = "give a file that State.save wrote"
        arrays = files.read_arrays(path, "state", VERSION, advice)
        with files.naming(path, "state", advice):
            return State.of(arrays)

    @staticmethod
    def of(arrays: Mapping[str, NDArray]) -> State:
        """The state of which these are the ``arrays``.

        Raises:
            ValueError: some are missing, or are none of a state.
        """
        own = [field.name for field in fields(State) if field.name != "self_contact"]
        names = {*own, *(f"self_contact.{name}" for name in SAVED)}
        if names != set(arrays):
            lacks, more = ", ".join(sorted(names - set(arrays))), ", ".join(sorted(set(arrays) - names))
            raise ValueError(f"it lacks {lacks}" if lacks else f"it holds {more}")
        contact = {name: arrays[f"self_contact.{name}"] for name in SAVED}
        return State(**{name: arrays[name] for name in own}, self_contact=contact)


def check_fits(state: State, own: State) -> None:
    """Refuse to go on in another simulation, which has a state of its ``own``; see ``SelfCollision`` for what is contact's.

    Raises:
        ValueError: what differs.
    """
    advice = "give what get_state() gave, or State.load(path)"
    if not isinstance(state, State):
        raise ValueError(f"state={shown(state)}: {advice}")
    if not isinstance(state.self_contact, dict) or set(state.self_contact) != set(SAVED):
        raise ValueError(f"the state's self_contact must be a dict of {', '.join(SAVED)}: {advice}")
    # of another simulation: what differs first, by name
    for name in ("positions", "attachment_positions", "colliders", "anchors", "sheet"):
        if not isinstance(getattr(state, name), (np.ndarray, np.generic)):
            raise ValueError(f"the state's {name} is no array: {advice}")
    if state.positions.shape != own.positions.shape:
        raise ValueError(
            f"the state holds positions of shape {state.positions.shape}, this simulation (num_envs, particles, 3) = "
            f"{own.positions.shape}: {advice}"
        )
    if not np.array_equal(state.anchors, own.anchors):
        there, here = (np.atleast_1d(one.anchors)[:1].tolist() for one in (state, own))
        raise ValueError(f"the state has anchors {there}, this simulation {here}: {advice}")
    for name, what in (("attachment_positions", "attachments (anchors, then grippers)"), ("colliders", "colliders")):
        shape, given = getattr(own, name).shape, getattr(state, name).shape
        if len(given) == 3 and given[1] != shape[1]:
            raise ValueError(f"the state has {given[1]} {what}, this simulation {shape[1]}: {advice}")
    if not np.array_equal(state.sheet, own.sheet):
        raise ValueError(
            "the state is of a sheet of another shape or size, or of another bending model or self-collision than this "
            f"simulation's: {advice}"
        )
    # every array: its kind, shape and range
    fits("diverged", state.diverged, own.diverged, advice=advice)
    ranges = RANGES | {"holder": (-1, own.attachment_positions.shape[1] - 1)}
    for field in fields(State):
        if field.name not in ("self_contact", "sheet"):
            excused = state.diverged if field.name in MAY_DIVERGE else None
            given, kept = getattr(state, field.name), getattr(own, field.name)
            low, high = ranges.get(field.name, (-LARGEST, LARGEST))
            fits(field.name, given, kept, low, high, excused, advice)


def at_rest(
    mesh: ClothMesh,
    num_envs: int,
    anchors: NDArray,
    attachments: int,
    parameters: NDArray,
    gravity: NDArray,
    wind: NDArray,
    colliders: NDArray,
    contact: dict[str, NDArray],
    sheet: NDArray,
) -> State:
    """A batch at its rest positions that nothing holds yet; what follows from the parameters is still zero.

    anchors: particles, (anchors,).  attachments: how many.  parameters: (properties,).  gravity, wind: (3,).  colliders:
    (colliders, rows).  contact: of self-collision, see ``contact_memory.blank``.
    """

    def each(value: NDArray) -> NDArray:
        return np.broadcast_to(value, (num_envs, *np.shape(value)))

    return State(
        positions=each(mesh.rest_positions),
        velocities=np.zeros((num_envs, mesh.num_particles, 3)),
        remainders=np.zeros((num_envs, 2, 3, mesh.num_particles)),
        free_inverse_mass=np.zeros((num_envs, mesh.num_particles)),
        anchors=each(anchors),
        holder=np.full((num_envs, mesh.num_particles), -1, np.int32),
        attachment_positions=np.zeros((num_envs, attachments, 3)),
        attachment_targets=np.zeros((num_envs, attachments, 3)),
        openings=np.zeros((num_envs, attachments)),
        wanted_openings=np.zeros((num_envs, attachments)),
        stiffness=np.zeros((num_envs, NUM_KINDS)),
        rigidity=np.zeros(num_envs),
        damping_time=np.zeros(num_envs),
        drag_rate=np.zeros(num_envs),
        resistance=np.zeros((num_envs, 3)),
        gravity=each(gravity),
        wind=each(wind),
        parameters=each(parameters),
        colliders=each(colliders),
        collider_homes=each(colliders),
        self_contact=contact,
        steps=np.zeros(num_envs, np.int64),
        diverged=np.zeros(num_envs, bool),
        sheet=sheet,
    )

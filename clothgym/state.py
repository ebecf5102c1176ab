"""Floor 2: all that is needed to continue a batch bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.checks import LARGEST, fits, shown
from clothgym.contact_memory import SAVED
from clothgym.elements import SpringArrays
from clothgym.mesh import NUM_KINDS, ClothMesh
from clothgym.parameters import SIZES

VERSION = 3  # of the format of files
# least and greatest values in a state; all others lie within LARGEST
NOT_NEGATIVE = ("free_inverse_mass", "stiffness", "rigidity", "damping_time", "drag_rate", "resistance", "parameters")
RANGES: dict[str, tuple[float, float]] = {name: (0, LARGEST) for name in NOT_NEGATIVE}
RANGES |= {"size": SIZES, "openings": (0, 1), "wanted_openings": (0, 1), "steps": (0, 2**62)}
# diverge with an environment; a reset mends them
MAY_DIVERGE = ("positions", "velocities", "remainders", "attachment_positions", "attachment_targets")


class Fabric(NamedTuple):
    """Parameters that may differ by lane.

    stiffness: spring constants by kind [N/m], (block, kinds, lane).  rigidity: of the hinges [N m], (block, lane).
    damping_time [s], (block, lane).  size: factor on the mesh's rest lengths, (block, lane).
    drag_rate: linear drag per mass [1/s], (block, lane). resistance: half the air's density times the coefficients of drag and
    skin friction [kg/m^3], and the sheet's mass per area [kg/m^2], (block, 3, lane). gravity [m/s^2] and wind [m/s], (block, 3,
    lane).
    """

    stiffness: NDArray
    rigidity: NDArray
    damping_time: NDArray
    size: NDArray
    drag_rate: NDArray
    resistance: NDArray
    gravity: NDArray
    wind: NDArray


class View(NamedTuple):
    """The live memory of a simulation, for kernels that read it: see the module.

    x, v: [m], [m/s], (block, 3, particles, lane).  size: factor on the mesh's rest lengths, (block, lane).
    attachments: where anchors and then grippers are [m], (block, attachments, 3, lane).  openings: of their fingers, (block,
    attachments, lane).
    blocked: whether solids stopped or deflected them in the last control step, (block, attachments, lane).
    holder: which of them holds each particle, or -1, (block, particles, lane).
    """

    x: NDArray
    v: NDArray
    size: NDArray
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
        stiffness, rigidity, damping_time, size, drag_rate, resistance, gravity, wind: see ``Fabric``.
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
    size: NDArray
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
    """Check that a state belongs to this simulation, with the present state ``own``; ``SelfCollision`` checks the contact memory.

    Raises:
        ValueError: names the difference.
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
    size: float,
    gravity: NDArray,
    wind: NDArray,
    colliders: NDArray,
    contact: dict[str, NDArray],
    sheet: NDArray,
) -> State:
    """A batch at its rest positions that nothing holds yet; what follows from the parameters is still zero.

    anchors: particles, (anchors,).  attachments: how many.  parameters: (properties,).  size: of the sheet, a factor.  gravity,
    wind: (3,).  colliders: (colliders, rows).  contact: of self-collision, see ``contact_memory.blank``.
    """

    def each(value: NDArray) -> NDArray:
        return np.broadcast_to(value, (num_envs, *np.shape(value)))

    return State(
        positions=each(size * mesh.rest_positions),
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
        size=np.full(num_envs, size),
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

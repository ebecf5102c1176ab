"""What the tasks share in which a sheet is hung on something that stands on the floor, a rail or a hook, and let go.

A sheet is held by two corners of its upper edge, ``HangingTask``, or lies on the floor, ``FromFloorTask``.  An episode's record
says where the stand is, and its yaw; its frame is along, across and above it, and the sheet comes from where across is negative.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.checks import finite, number, shown
from clothgym.collisions import Collider, Plane
from clothgym.envs.episode import Fields
from clothgym.envs.experts import as_actions, carry_by_places
from clothgym.envs.framing import DirectedTask
from clothgym.envs.gripper_task import PickingTask, lying_sheet
from clothgym.envs.observing import POSITION_BOUND, Observation
from clothgym.envs.rumpled import UNEVEN, rumpled_sheets
from clothgym.envs.scoring import FOLLOWED, FOLLOWED_INFO, FOLLOWED_RANGES, follow, grasp, holds_nothing, observe_time
from clothgym.envs.targets import FRICTION, ON_FLOOR

LYING = 0.03  # cloth lower than this lies on the floor [m]
MOST_LYING = 0.02  # of a success, as a share of the sheet
GUIDE_SCALE = 0.4  # in sides: how the guidance falls with the way that is left
GUIDING = 0.5  # share of the potential that is for bringing the sheet to the stand
PICKING = 0.2  # share of it that is for taking hold
SPREAD, TURN = 0.15, np.pi / 4  # how far stands are from the origin along x and y, in sides; and turned at most [rad]


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def guided(guidance, score):
    """The potential of a held sheet, by how near it is and how well it hangs."""
    return GUIDING * guidance + (1 - GUIDING) * score


@inlined
def picked(own, rules, sheet, potential):
    """The potential of a sheet from the floor: how far the taking hold is along, and the hanging."""
    found = 0.0
    for k in range(rules.places.shape[0]):
        found += grasp(own.picked[k], rules, sheet, k)
    return PICKING * (found / rules.places.shape[0]) + (1 - PICKING) * potential


@inlined
def account_hanging(own, rules, sheet, info, score, hangs, running, failure):
    """The episode's best score, and since when the sheet hangs by itself and whether that has lasted; no reward terms."""
    follow(own, info, score, holds_nothing(own, rules, sheet) and hangs, running, failure)
    return 0.0


@inlined
def observe_held(own, rules, sheet, seen):
    """The time, and whether each corner is held."""
    observe_time(own, rules, seen)
    for k in range(sheet.holds.shape[0]):
        seen.holds[k] = sheet.holds[k] > 0


@inlined
def observe_picking(own, rules, sheet, seen):
    """The time, and each gripper: its tip, the way to its corner, its fingers, whether it holds anything."""
    observe_time(own, rules, seen)
    for k in range(rules.places.shape[0]):
        attachment, place = sheet.attachments[k], rules.places[k]
        for c in range(3):
            seen.grippers[k, c] = (attachment[c] - own.origin[c]) / rules.side
            seen.grippers[k, 3 + c] = (sheet.x[c, place] - attachment[c]) * (10 / rules.side)
        seen.grippers[k, 6], seen.grippers[k, 7] = sheet.openings[k], sheet.holds[k] > 0


HOLDS = Observation("holds", "whether each corner is held", (2,))


def grippers_seen(frame: str) -> Observation:
    """What ``observe_picking`` writes of both grippers, relative to the origin of the frame, which is named."""
    return Observation(
        "grippers",
        f"for each gripper its tip relative to {frame} [L], the way from its tip to the corner that it is meant "
        "to take [L/10], how far open its fingers are, and whether it holds anything",
        (2, 8),
        "",
        (*[POSITION_BOUND] * 3, *[10 * POSITION_BOUND] * 3, 1.0, 1.0),
        turns=2,
    )


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class HangingTask(DirectedTask):
    """Base of the hanging tasks, with starts of a held sheet.

    Attributes:
        stand: what the sheet is hung on, as ``reset(options=...)`` names it.
        frame_at: the field of an episode's record that says where that is [m].
        heights, heights_allowed: of this point above the floor, as drawn, and as options may ask for, in sides.
        extent: how far the stand reaches across to where the sheet comes from, in sides.
        away: how far before that the sheet hangs, in sides.
    """

    stand: ClassVar[str]
    frame_at: ClassVar[str]
    heights: ClassVar[tuple[float, float]]
    heights_allowed: ClassVar[tuple[float, float]]
    extent: ClassVar[float] = 0.0
    away: ClassVar[tuple[float, float]]
    actions_per_attachment = 4
    settling_steps = 150
    accounts: ClassVar[Fields] = FOLLOWED_INFO
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**FOLLOWED_RANGES, "turn": (-1.0, 1.0)}

    def remembers(self) -> Fields:
        # cosine and sine of the stand's yaw
        return [*super().remembers(), (self.frame_at, float, 3), ("turn", float, 2), *FOLLOWED]

    def constants(self) -> dict[str, Any]:
        mesh = self.physics.mesh
        a, b = (mesh.rest_positions[mesh.triangles[:, k]] - mesh.rest_positions[mesh.triangles[:, 0]] for k in (1, 2))
        areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        return super().constants() | {"areas": areas / areas.sum()}

    # --- the stand ------------------------------------------------------------------------------------------------------

    def solids_of(self, at: NDArray, turn: NDArray) -> list[Collider]:
        """What stands on the floor, with these records."""
        raise NotImplementedError

    def colliders(self) -> list[Collider]:
        """The floor, and a stand in whose place each episode has its own."""
        floor = Plane(friction=FRICTION, thickness=ON_FLOOR)
        return [floor, *self.solids_of(np.array([0, 0, self.physics.side]), np.array([1.0, 0.0]))]

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        own = self.episode[env]
        return dict(enumerate(self.solids_of(own[self.frame_at], own["turn"]), 1))

    def stands(self, own: Any) -> bool:
        """Whether there can be what an episode's record says of the stand."""
        raise NotImplementedError

    def check_episode(self, env: int, own: Any) -> None:
        super().check_episode(env, own)
        if abs(own["turn"] @ own["turn"] - 1) > 1e-9 or not self.stands(own):
            raise ValueError(
                f"no episode of this task has a {self.stand} at {own[self.frame_at].tolist()} with that turn: give what "
                "get_state() gave"
            )

    def check_options(self, options: Mapping[str, Any]) -> None:
        super().check_options(options)
        what, side = self.stand, self.physics.side
        wanted, known = options.get(what, {}), ("height", "center", "yaw")
        if not isinstance(wanted, Mapping):
            raise ValueError(f"reset option {what}={shown(wanted)}: must be a dict with any of {', '.join(known)}")
        unknown = set(wanted) - set(known)
        if unknown:
            raise ValueError(f"unknown key {sorted(unknown)[0]!r} of the reset option {what!r} (there are: {', '.join(known)})")
        low, high = (share * side for share in self.heights_allowed)
        if not low <= number(f"{what} height", wanted.get("height", low)) <= high:
            raise ValueError(f"{what} height={wanted['height']!r}: must be from {low:g} to {high:g} m, for the sheet to hang")
        if abs(number(f"{what} yaw", wanted.get("yaw", 0.0))) > np.pi / 2:
            raise ValueError(f"{what} yaw={wanted['yaw']!r}: must be within 90 degrees (pi/2)")
        center = finite(f"{what} center", wanted.get("center", (0.0, 0.0)))
        if center.shape != (2,) or np.abs(center).max() > 0.5 * side:
            raise ValueError(f"{what} center={shown(wanted['center'])}: must be two numbers within {0.5 * side:g} m of the origin")

    def draw_stand(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        """Draw an episode's stand, of which the options may want some properties, and write it into its record."""
        side, own, wanted = self.physics.side, self.episode[env], options.get(self.stand, {})
        height, center = side * rng.uniform(*self.heights), side * rng.uniform(-SPREAD, SPREAD, 2)
        yaw = float(wanted.get("yaw", rng.uniform(-TURN, TURN)))
        own[self.frame_at] = own["origin"] = *wanted.get("center", center), wanted.get("height", height)
        own["turn"] = np.cos(yaw), np.sin(yaw)

    # --- its frame ------------------------------------------------------------------------------------------------------

    def heading(self) -> NDArray[np.float64]:
        return self.episode["turn"]

    def in_frame(self, points: NDArray) -> NDArray:
        """World points as along, across and above it [m], (num_envs, points, 3)."""
        d, (c, s) = points - self.episode[self.frame_at][:, None], self.turns
        return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], d[..., 2]], axis=2)

    def out_of_frame(self, ways: NDArray) -> NDArray:
        """Ways along, across and above it as ways in the world, (num_envs, ways, 3)."""
        c, s = self.turns
        return np.stack([c * ways[..., 0] - s * ways[..., 1], s * ways[..., 0] + c * ways[..., 1], ways[..., 2]], axis=2)

    @property
    def turns(self) -> tuple[NDArray, NDArray]:
        """Cosines and sines of the yaws, each (num_envs, 1)."""
        return self.episode["turn"][:, :1], self.episode["turn"][:, 1:]

    def before(self, env: int, x: NDArray, across: float, along: float) -> NDArray:
        """A sheet about the origin [m], (particles, 3), turned with the stand and put before it."""
        own = self.episode[env]
        c, s = own["turn"]
        u, v = x[:, 0] + along, x[:, 1] + across
        return np.stack([own[self.frame_at][0] + c * u - s * v, own[self.frame_at][1] + s * u + c * v, x[:, 2]], axis=1)

    # --- starts and expert ----------------------------------------------------------------------------------------------

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_stand(env, rng, options)
        mesh, side = self.physics.mesh, self.physics.side
        away, sideways, clearance = side * rng.uniform(*self.away), side * rng.uniform(-0.15, 0.15), side * rng.uniform(0.1, 0.25)
        yaw, ripple = rng.uniform(-0.3, 0.3), rng.normal(scale=1e-3, size=mesh.num_particles)
        # the sheet hangs in a plane before the stand, its held edge up
        rest = mesh.rest_positions
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.stack([c * rest[:, 0] - s * ripple, s * rest[:, 0] + c * ripple, clearance + side / 2 + rest[:, 1]], axis=1)
        return self.before(env, x, -(self.extent * side + away), sideways)

    def ways(self, hands: NDArray) -> tuple[NDArray, NDArray, float | NDArray]:
        """Remaining displacements of two hands that hang the sheet up [m], in the frame, (num_envs, 2, 3); whether they have
        arrived, (num_envs, 1); and their speed, as ``as_actions`` takes it.

        hands: in the frame [m], (num_envs, 2, 3).
        """
        raise NotImplementedError

    def expert_actions(self) -> NDArray:
        """Move to the hanging position, and release.

        The expert has no memory: the positions of hands and sheet determine the phase.
        """
        way, there, speed = self.ways(self.in_frame(self.episode["targets"]))
        return as_actions(self, self.out_of_frame(way) / 2, np.where(there, 1.0, -1.0) * np.ones((1, 2)), speed)


class FromFloorTask(PickingTask, HangingTask):
    """Base of the tasks in which two grippers pick up their corners of a flat or rumpled sheet on the floor."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**PickingTask.ranges, **HangingTask.ranges}
    action_modes = ("velocity",)
    arguments: ClassVar = {**PickingTask.arguments, "action_mode": 'only "velocity": picking and placing ends on the floor'}

    def rumpled(self) -> NDArray:
        """Rumpled sheets about the origin [m], (sheets, particles, 3)."""
        return rumpled_sheets(*self.physics.mesh.grid_shape, self.physics.side)

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_stand(env, rng, options)
        side, sheets = self.physics.side, self.rumpled()
        gap, sideways, yaw = side * rng.uniform(0.1, 0.2), side * rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)
        x = lying_sheet(rng, sheets, self.physics.mesh, yaw, options)
        # completely in front of the stand
        x = self.before(env, x, -x[:, 1].max() - (self.extent * side + gap), sideways)
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        self.hover(env, rng, x[self.places])
        self.episode["picked"][env] = False
        return x

    def leaving(self, hands: NDArray) -> NDArray:
        """Ways of hands that have let go, out of the sheet's way, in the frame [m], (num_envs, 2, 3)."""
        raise NotImplementedError

    def expert_actions(self) -> NDArray:
        """Up with both corners, to where the sheet hangs, open, and away."""
        hands = self.in_frame(self.simulation.grippers.positions.astype(np.float64))
        way, there, speed = self.ways(hands)
        return carry_by_places(self, self.out_of_frame(way) / 2, there, self.out_of_frame(self.leaving(hands)), speed)

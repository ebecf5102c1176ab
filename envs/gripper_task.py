"""A task in which grippers pick up the sheet, the base of those that use them; and what its ids fix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.attachments import Gripper
from clothgym.checks import one_of, shown
from clothgym.collisions import Collider, Plane
from clothgym.envs import draping, pick_place
from clothgym.envs.episode import Fields
from clothgym.envs.observing import POSITION_BOUND, Observation
from clothgym.envs.physics import MEDIAN, chosen_fabric
from clothgym.envs.rumpled import UNEVEN
from clothgym.envs.scoring import FOLLOWED, FOLLOWED_INFO, FOLLOWED_RANGES, TIME, observe_time
from clothgym.envs.stepping import IN_NUMPY
from clothgym.envs.targets import FRICTION, ON_FLOOR
from clothgym.envs.task import Task
from clothgym.mesh import ClothMesh, grid

REACH = 0.03  # of the fingers [m]
# what the ids fix, see ``draping.PHYSICS``; and a larger sheet of silk, with the same short cuts but for the fabric
PHYSICS = replace(draping.PHYSICS, grippers=(Gripper(speed=2 * draping.PHYSICS.attachment_speed, reach=REACH),) * 2)
LARGE_SILK = replace(PHYSICS, mesh=grid(21, 21, 0.8, 0.8), material=chosen_fabric("silk", MEDIAN), fast={"air_density": 0.0})
CLOSES, OPENS = -0.5, 0.5  # actions below and above these close and open the fingers; between them they go on with the last
CORNERS = 4
FINGER, PALM = (90, 95, 110), (60, 65, 80)  # colors


@inlined
def close_or_open(move, wanted, acting):
    """Fingers do what the last action beyond a limit says, and open when time is up."""
    if not acting or move[3] > OPENS:
        return 1.0
    return 0.0 if move[3] < CLOSES else wanted


@inlined
def take(own, rules, sheet, move, free):
    """Remember which places have been taken; one gripper may take two that lie together."""
    for k in range(rules.places.shape[0]):
        if sheet.holder[rules.places[k]] >= 0:
            own.picked[k] = 1


@inlined
def observe_grippers(own, rules, sheet, seen):
    """Each gripper's tip, fingers and whether it holds anything; and the time."""
    for k in range(sheet.holds.shape[0]):
        for c in range(3):
            seen.grippers[k, c] = (sheet.attachments[k, c] - own.origin[c]) / rules.side
        seen.grippers[k, 3], seen.grippers[k, 4] = sheet.openings[k], sheet.holds[k] > 0
    observe_time(own, rules, seen)


@inlined
def observe_ways(rules, sheet, seen):
    """The ways from each gripper's tip to the corners."""
    for tip in range(sheet.holds.shape[0]):
        for k in range(CORNERS):
            for c in range(3):
                seen.ways[tip, k, c] = (sheet.x[c, rules.corners[k]] - sheet.attachments[tip, c]) * (10 / rules.side)


# what ``observe_ways`` writes, of tasks whose ``rules`` have the corners
WAYS = Observation(
    "ways", "for each gripper the ways from its tip to the corners", (2, CORNERS, 3), "L/10", 20 * POSITION_BOUND, turns=1
)


class GripperTask(Task):
    """Base of the tasks that use grippers, which are those of ``physics``; an action is a velocity and what fingers do, for each.

    Args:
        slip_force: pull at which the cloth slips out of a gripper [N]; None for the grippers' own.
        action_mode: "velocity", "pick_place", see the module ``pick_place``, or "throw", see ``throws``.

    Attributes:
        gripper_starts: where the grippers are as an episode begins [m], (num_envs, grippers, 3); ``begin`` may write it.
        picks: actions of an episode that picks and places, after which the sheet settles in one more step.
        workspace: half of the square in which these pick and place, in sides.
        action_modes: those that it has.
    """

    actions_per_attachment = 4
    kernels = IN_NUMPY._replace(fingers=close_or_open)
    picks: ClassVar[int] = 4
    workspace: ClassVar[float] = 1.25
    action_modes: ClassVar[tuple[str, ...]] = ("velocity", "pick_place")
    arguments: ClassVar = {
        "slip_force": "pull at which the cloth slips out of a gripper [N]",
        "action_mode": '"velocity", or "pick_place": an action is 60 control steps, and 5 numbers in [-1, 1] for each gripper: '
        "where it picks, x and y, where it places, x and y, in a square about the origin, and how high it lifts, from 0 to 1 side; "
        "an episode has $picks of these, and $rests in which the sheet settles",
    }

    def __init__(self, num_envs: int, slip_force: float | None = None, action_mode: str = "velocity", **kwargs: Any) -> None:
        one_of("action_mode", action_mode, *self.action_modes)
        self.action_mode = action_mode
        if slip_force is not None:
            grippers = tuple(replace(gripper, slip_force=slip_force) for gripper in self.physics.grippers)
            self.physics = replace(self.physics, grippers=grippers)  # type: ignore[misc]
        if action_mode == "pick_place":
            self.acting_steps = self.picks * pick_place.STEPS  # type: ignore[misc]
        super().__init__(num_envs, **kwargs)
        if action_mode == "pick_place":
            self.move_by(action_mode, pick_place.STEPS, pick_place.NUMBERS * self.num_attachments)
            # tips move as fast as the grippers can
            self.rules["reach"] = self.physics.time_step * min(gripper.speed for gripper in self.physics.grippers)
        self.gripper_starts = self.simulation.grippers.positions.astype(np.float64)

    def move_by(self, action_mode: str, steps: int, numbers: int) -> None:
        """Make an action a whole motion, of so many control steps and numbers.

        Raises:
            ValueError: an action is repeated, delayed or noisy.
        """
        if self.control_steps != 1:
            given = f"action_repeat={self.control_steps}"
            raise ValueError(f"{given}: must be 1 with action_mode={action_mode!r}, an action of which is {steps} control steps")
        for name in ("action_delay", "action_noise"):
            if name in self.disturbances.ranges:
                raise ValueError(f"randomize: no {name} with action_mode={action_mode!r}, whose motions are closed loops")
        self.action_mode, self.control_steps = action_mode, steps
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (numbers,), np.float32)

    def commands(self, actions: NDArray) -> Callable[[int], NDArray]:
        if self.action_mode == "velocity":
            return super().commands(actions)
        if not np.isfinite(actions).all():
            env, component = np.argwhere(~np.isfinite(actions))[0].tolist()
            raise ValueError(f"action[{component}] of environment {env} is {actions[env, component]}: actions must be finite")
        return self.motion(np.clip(actions, -1, 1))

    def motion(self, actions: NDArray) -> Callable[[int], NDArray]:
        """``commands`` of actions that are whole motions; actions: within [-1, 1]."""
        return pick_place.commands(self, actions)

    def expert(self) -> NDArray:
        return super().expert() if self.action_mode == "velocity" else self.expert_picks()

    def expert_picks(self) -> NDArray:
        """What the scripted expert does where an action is a whole motion, (num_envs, numbers); tasks that have one define it.

        Raises:
            NotImplementedError: this task has none.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no scripted expert for action_mode={self.action_mode!r}: take action_mode='velocity'"
        )

    def _drawn(self) -> list[NDArray]:
        return [*super()._drawn(), self.gripper_starts]

    def hover(self, env: int, rng: np.random.Generator, at: NDArray) -> None:
        """Draw where the grippers are as an episode begins, above these points of the sheet [m], (grippers, 3)."""
        count = len(at)
        away = np.concatenate([rng.uniform(-0.1, 0.1, (count, 2)), rng.uniform(0.2, 0.35, (count, 1))], axis=1)
        self.gripper_starts[env] = at + self.physics.side * away

    def place_attachments(self, envs: NDArray) -> None:
        """Put the grippers where their episodes begin with them."""
        self.simulation.grippers.place(self.gripper_starts[envs], envs)

    def marks(self, envs: NDArray) -> NDArray:
        """The grippers: two fingers and a palm each."""
        from clothgym.render.quick_solids import boxes  # imported here: training draws nothing

        grippers, count = self.simulation.grippers, len(self.physics.grippers)
        spans = np.array([gripper.span for gripper in self.physics.grippers])
        # fingers that hold cloth are drawn closed
        aside = 0.006 + np.where(grippers.held[envs] > 0, 0.0, grippers.openings[envs]) * spans / 2
        middles = np.repeat(grippers.positions[envs].astype(np.float64)[:, :, None], 3, axis=2)
        middles[:, :, 0, 0] -= aside
        middles[:, :, 1, 0] += aside
        middles[..., 2] += (0.025, 0.025, 0.065)
        half_sides = np.tile([(0.005, 0.01, 0.03), (0.005, 0.01, 0.03), (0.04, 0.014, 0.012)], (count, 1))
        return boxes(middles.reshape(len(envs), -1, 3), half_sides, (FINGER, FINGER, PALM) * count)


class PickingTask(GripperTask):
    """Base of the tasks in which each gripper picks up its place of a sheet on the floor, flat or rumpled, and carries it away.

    Attributes:
        places: the particles that each gripper is to take.
    """

    places: NDArray
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**GripperTask.ranges, "picked": (0, 1)}

    def remembers(self) -> Fields:
        # whether each place has ever been held
        return [*super().remembers(), ("picked", np.uint8, len(self.places))]

    def constants(self) -> dict[str, Any]:
        return super().constants() | {"places": self.places}

    def check_options(self, options: Mapping[str, Any]) -> None:
        super().check_options(options)
        if not isinstance(options.get("rumpled", False), (bool, np.bool_)):
            raise ValueError(f"reset option rumpled={shown(options['rumpled'])}: must be True or False")


def lying_sheet(
    rng: np.random.Generator, rumpled: NDArray, mesh: ClothMesh, yaw: float, options: Mapping[str, Any]
) -> NDArray[np.float64]:
    """Draw a sheet on the floor about the origin, turned by a yaw [m], (particles, 3): flat, or one of these rumpled ones."""
    chosen, number = bool(rng.uniform() < 0.5), int(rng.integers(len(rumpled)))
    x = rumpled[number].copy() if options.get("rumpled", chosen) else mesh.rest_positions + (0, 0, ON_FLOOR)
    c, s = np.cos(yaw), np.sin(yaw)
    x[:, :2] = x[:, :2] @ np.array([[c, s], [-s, c]])
    return x


class ManipulationTask(GripperTask):
    """Base of the tasks on a floor with a score after every step, and a success that has to last.

    The kernel ``account`` of each ends with ``follow``, ``observe`` begins with ``observe_grippers``.
    """

    physics = PHYSICS
    acting_steps = 120
    settling_steps = 40
    observations: ClassVar[tuple[Observation, ...]] = (
        Observation(
            "grippers",
            "for each gripper its tip [L], how far open its fingers are, and whether it holds anything",
            (2, 5),
            "",
            (POSITION_BOUND, POSITION_BOUND, POSITION_BOUND, 1.0, 1.0),
            turns=1,
        ),
        *TIME,
    )
    accounts: ClassVar[Fields] = FOLLOWED_INFO
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**GripperTask.ranges, **FOLLOWED_RANGES}

    def remembers(self) -> Fields:
        return [*super().remembers(), *FOLLOWED]

    def colliders(self) -> list[Collider]:
        return [Plane(friction=FRICTION, thickness=ON_FLOOR)]

    def working_area(self) -> tuple[NDArray, float]:
        return np.zeros(2), self.workspace * self.physics.side

    def lie_flat(self, env: int, rng: np.random.Generator, away: float, turned: float) -> tuple[NDArray, NDArray, NDArray]:
        """Draw a flat sheet on the floor [m], (particles, 3), its center [m], (2,), and cosine and sine of its yaw, (2,).

        away: how far the center may lie from the origin along x and y, in sides.  turned: by how much the sheet may be [rad].
        """
        yaw, center = rng.uniform(-turned, turned), self.physics.side * rng.uniform(-away, away, 2)
        flat = self.sizes()[env] * (self.physics.mesh.rest_positions - self.physics.mesh.rest_positions.mean(axis=0))
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = c * flat[:, 0] - s * flat[:, 1] + center[0], s * flat[:, 0] + c * flat[:, 1] + center[1]
        return np.stack([x, y, flat[:, 2] - flat[:, 2].min() + ON_FLOOR], axis=1), center, np.array([c, s])

    def uneven(self, x: NDArray, rng: np.random.Generator) -> NDArray:
        """A start [m], (particles, 3), with its particles raised by tenths of a millimeter."""
        x = x.copy()
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        return x

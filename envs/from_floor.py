"""Picking up: a task in which two grippers first take a sheet from the floor, before what it is to hang on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.checks import shown
from clothgym.envs.definition import POSITION_BOUND, Observation
from clothgym.envs.episode import Fields
from clothgym.envs.framed import FramedTask
from clothgym.envs.gripper_task import GripperTask
from clothgym.envs.measures import distance
from clothgym.envs.rumpled import UNEVEN
from clothgym.envs.targets import ON_FLOOR

PICK_SCALE = 0.15  # in sides: how the potential rises as a gripper nears its corner
REACH = 0.03  # of the fingers [m]


@inlined
def take(own, rules, sheet, move, free):
    """Remember which corners have been taken."""
    for k in range(rules.places.shape[0]):
        if sheet.holder[rules.places[k]] >= 0:
            own.picked[k] = 1


@inlined
def taken(own, rules, sheet):
    """How far the taking hold is along: the mean of 1 for a corner that has been taken, at most a half for one that its gripper
    is near."""
    found = 0.0
    for k in range(rules.places.shape[0]):
        place = rules.places[k]
        away = distance(sheet.x[:, place], sheet.attachments[k]) / (PICK_SCALE * rules.side)
        found += 1.0 if own.picked[k] else 0.5 / (1 + away**2)
    return found / rules.places.shape[0]


@inlined
def observe_picking(own, rules, sheet, seen):
    """Each gripper: its tip, the way to its corner, its fingers, whether it holds anything."""
    for k in range(rules.places.shape[0]):
        attachment, place = sheet.attachments[k], rules.places[k]
        for c in range(3):
            seen.grippers[k, c] = (attachment[c] - own.origin[c]) / rules.side
            seen.grippers[k, 3 + c] = (sheet.x[c, place] - attachment[c]) * (10 / rules.side)
        seen.grippers[k, 6], seen.grippers[k, 7] = sheet.openings[k], sheet.holds[k] > 0


def grippers_seen(frame: str) -> Observation:
    """What is observed of both grippers, relative to the origin of the frame, which is named."""
    return Observation(
        "grippers",
        f"for each gripper its tip relative to {frame} [L], the way from its tip to the corner that it is meant "
        "to take [L/10], how far open its fingers are, and whether it holds anything",
        (2, 8),
        "",
        (*[POSITION_BOUND] * 3, *[10 * POSITION_BOUND] * 3, 1.0, 1.0),
    )


class FromFloorTask(FramedTask, GripperTask):
    """Base of tasks in which each of two grippers picks up its corner of a sheet on the floor, flat or rumpled.

    Attributes:
        places: the particles that each gripper is to take: the corners of the sheet's upper edge.
    """

    places: NDArray
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**GripperTask.ranges, "picked": (0, 1)}
    arguments: ClassVar = {
        **GripperTask.arguments,
        "action_mode": '"velocity" alone: what is picked and placed ends on the floor',
    }

    def __init__(self, num_envs: int, action_mode: str = "velocity", **kwargs: Any) -> None:
        if action_mode != "velocity":
            raise ValueError(f"action_mode={shown(action_mode)}: must be 'velocity': what is picked and placed ends on the floor")
        super().__init__(num_envs, **kwargs)

    def remembers(self) -> Fields:
        # whether each corner has ever been held
        return [*super().remembers(), ("picked", np.uint8, len(self.places))]

    def constants(self) -> dict[str, Any]:
        return super().constants() | {"places": self.places}

    def check_options(self, options: Mapping[str, Any]) -> None:
        super().check_options(options)
        if not isinstance(options.get("rumpled", False), (bool, np.bool_)):
            raise ValueError(f"reset option rumpled={shown(options['rumpled'])}: must be True or False")

    def lie(self, env: int, rng: np.random.Generator, options: Mapping[str, Any], sheets: NDArray, away: float) -> NDArray:
        """Draw a sheet that lies before what it is to hang on, at least so far from its middle [m], and where the grippers are.

        sheets: rumpled ones about the origin [m], (sheets, particles, 3).
        """
        rest, side = self.physics.mesh.rest_positions, self.physics.side
        gap, sideways, yaw = side * rng.uniform(0.1, 0.2), side * rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)
        rumpled, number = bool(rng.uniform() < 0.5), int(rng.integers(len(sheets)))
        x = sheets[number].copy() if options.get("rumpled", rumpled) else rest + (0, 0, ON_FLOOR)
        c, s = np.cos(yaw), np.sin(yaw)
        x[:, :2] = x[:, :2] @ np.array([[c, s], [-s, c]])
        # all of it beside
        x = self.before(env, x, -x[:, 1].max() - (away + gap), sideways)
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        above = np.concatenate([rng.uniform(-0.1, 0.1, (2, 2)), rng.uniform(0.2, 0.35, (2, 1))], axis=1)
        self.gripper_starts[env] = x[self.places] + side * above
        self.episode["picked"][env] = False
        return x

    def hands(self) -> NDArray:
        """Where the tips are, in the frame [m], (num_envs, 2, 3)."""
        return self.in_frame(self.simulation.grippers.positions.astype(np.float64))

"""What the manipulation tasks share: a sheet on a floor, two grippers, a score after every step, and success that has to last.

Their tasks are ``ManipulationTask``.  A task's kernel ``account`` ends with ``follow``, which keeps the episode's best score and
whether a success has lasted; its kernel ``observe`` begins with ``observe_grippers``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.attachments import Gripper
from clothgym.collisions import Collider, Plane
from clothgym.envs import draping
from clothgym.envs.definition import POSITION_BOUND, Observation
from clothgym.envs.episode import FINE, Fields
from clothgym.envs.gripper_task import GripperTask
from clothgym.envs.targets import FRICTION, ON_FLOOR

CORNERS = 4
REACH = 0.03  # of the fingers [m]
# what the ids fix, see ``draping.PHYSICS``
PHYSICS = replace(draping.PHYSICS, grippers=(Gripper(speed=2 * draping.PHYSICS.attachment_speed, reach=REACH),) * 2)
# a sheet begins with its particles raised by about so much [m]: nothing flat can buckle
UNEVEN = 1e-4


@inlined
def observe_grippers(own, rules, sheet, seen):
    """Each gripper's tip, fingers and whether it holds anything; and the time."""
    for k in range(sheet.holds.shape[0]):
        for c in range(3):
            seen.grippers[k, c] = (sheet.attachments[k, c] - own.origin[c]) / rules.side
        seen.grippers[k, 3], seen.grippers[k, 4] = sheet.openings[k], sheet.holds[k] > 0
    seen.settling = own.settling_since >= 0
    seen.episode_left = 1 - own.step / (rules.acting_steps + rules.settling_steps)
    seen.acting_left = max(rules.acting_steps - own.step, 0) / rules.acting_steps


@inlined
def observe_ways(rules, sheet, seen):
    """The ways from each gripper's tip to the corners."""
    for tip in range(sheet.holds.shape[0]):
        for k in range(CORNERS):
            for c in range(3):
                seen.ways[tip, k, c] = (sheet.x[c, rules.corners[k]] - sheet.attachments[tip, c]) * (10 / rules.side)


@inlined
def follow(own, info, score, reached, running, failure):
    """Keep the episode's best score, the step of its first success, and whether that has lasted.

    score: how well the sheet lies now.  reached: whether that is enough, at rest or not.
    """
    if own.step == 0:
        own.best, own.first_success, own.lost = score, -1, 0
    elif running:
        own.best = max(own.best, score)
        if reached and own.first_success < 0:
            own.first_success = own.step
        if own.first_success >= 0 and (failure != FINE or not reached):
            own.lost = 1
    info.best, info.first_success = own.best, own.first_success
    info.success_held = own.first_success >= 0 and own.lost == 0


# what ``observe_ways`` writes, of tasks whose ``rules`` have the corners
WAYS = Observation("ways", "for each gripper the ways from its tip to the corners", (2, CORNERS, 3), "L/10", 20 * POSITION_BOUND)


class ManipulationTask(GripperTask):
    """Base of the manipulation tasks."""

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
        ),
        Observation("settling", "whether the sheet settles, and actions are ignored"),
        Observation("episode_left", "share of the episode left"),
        Observation("acting_left", "share of the acting time left"),
    )
    accounts: ClassVar[Fields] = (("best", float), ("first_success", np.int64), ("success_held", bool))
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        **GripperTask.ranges, "best": (0.0, 1.0), "first_success": (-1, 10_000), "lost": (0, 1),
    }  # fmt: skip

    def remembers(self) -> Fields:
        return [*super().remembers(), ("best", float), ("first_success", np.int64), ("lost", np.uint8)]

    def colliders(self) -> list[Collider]:
        return [Plane(friction=FRICTION, thickness=ON_FLOOR)]

    def working_area(self) -> tuple[NDArray, float]:
        return np.zeros(2), self.workspace * self.physics.side

    def uneven(self, x: NDArray, rng: np.random.Generator) -> NDArray:
        """A start [m], (particles, 3), with its particles raised by tenths of a millimeter."""
        x = x.copy()
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        return x

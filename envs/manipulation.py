"""What the manipulation tasks share: a sheet on a floor, two grippers, a score after every step, and success that has to last.

Their tasks are ``ManipulationTask``: the kernel ``account`` of each ends with ``follow``, ``observe`` begins with
``observe_grippers``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.collisions import Collider, Plane
from clothgym.envs.episode import Fields
from clothgym.envs.gripper_task import PHYSICS, GripperTask
from clothgym.envs.observing import POSITION_BOUND, Observation
from clothgym.envs.rumpled import UNEVEN
from clothgym.envs.scoring import FOLLOWED, FOLLOWED_INFO, FOLLOWED_RANGES, TIME, observe_time
from clothgym.envs.targets import FRICTION, ON_FLOOR

CORNERS = 4


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

    def lie_flat(self, rng: np.random.Generator, away: float, turned: float) -> tuple[NDArray, NDArray, NDArray]:
        """Draw a flat sheet on the floor [m], (particles, 3), its center [m], (2,), and cosine and sine of its yaw, (2,).

        away: how far the center may lie from the origin along x and y, in sides.  turned: by how much the sheet may be [rad].
        """
        yaw, center = rng.uniform(-turned, turned), self.physics.side * rng.uniform(-away, away, 2)
        flat = self.physics.mesh.rest_positions - self.physics.mesh.rest_positions.mean(axis=0)
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = c * flat[:, 0] - s * flat[:, 1] + center[0], s * flat[:, 0] + c * flat[:, 1] + center[1]
        return np.stack([x, y, flat[:, 2] + ON_FLOOR], axis=1), center, np.array([c, s])

    def uneven(self, x: NDArray, rng: np.random.Generator) -> NDArray:
        """A start [m], (particles, 3), with its particles raised by tenths of a millimeter."""
        x = x.copy()
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        return x

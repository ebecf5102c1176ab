"""ClothDrapeGripper-v0: pick up a flat or rumpled sheet next to a target, drape it over the target, and release it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.envs import draping
from clothgym.envs.draping import DrapingTask, covering, observe_target
from clothgym.envs.experts import carry_by_places
from clothgym.envs.gripper_task import PHYSICS, PickingTask, close_or_open, lying_sheet, take
from clothgym.envs.observing import POSITION_BOUND, Observation, View
from clothgym.envs.rumpled import UNEVEN, rumpled_sheets
from clothgym.envs.scoring import grasp
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels

PICKING = 0.3  # share of the potential for grasping

# the scripted expert's path, in sides: distance beyond the target, height above it on the way, depth below its top at the end, and
# height above it before it moves sideways
EXPERT_BEYOND, EXPERT_LIFT, EXPERT_DROP, EXPERT_CLEARS = 0.32, 0.42, 0.25, 0.15


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _potential(own, rules, sheet):
    """Progress of grasping, and nearness of the sheet to the target."""
    taken = 0.0
    for k in range(rules.places.shape[0]):
        taken += grasp(sheet.holder[rules.places[k]] >= 0, rules, sheet, k)
    return PICKING * taken / rules.places.shape[0] + (1 - PICKING) * covering(own, rules, sheet)


@inlined
def _observe(own, rules, sheet, seen):
    """The observations of both draping tasks, and for each gripper its tip, the displacement to its place, and its fingers."""
    observe_target(own, rules, sheet, seen)
    for k in range(rules.places.shape[0]):
        attachment, place = sheet.attachments[k], rules.places[k]
        for c in range(3):
            seen.grippers[k, c] = (attachment[c] - own.top[c]) / rules.side
            seen.grippers[k, 3 + c] = (sheet.x[c, place] - attachment[c]) * (10 / rules.side)
        seen.grippers[k, 6] = sheet.openings[k]


def _observations(grippers: int) -> tuple[Observation, ...]:
    """The observations with this number of grippers."""
    about = (
        "for each gripper its tip relative to the target's top [L], the displacement from its tip to its corner [L/10], and the "
        "opening of its fingers"
    )
    bounds = (*[POSITION_BOUND] * 3, *[10 * POSITION_BOUND] * 3, 1.0)
    own = Observation("grippers", about, (grippers, 7), "", bounds)
    return (*draping.observations(grippers, "whether each gripper holds anything"), own)


class DrapeGripperTask(DrapingTask, PickingTask):
    """The task of ``ClothDrapeGripper-v0``, see ``ClothDrapeGripperEnv``."""

    physics = PHYSICS
    # an agent is never done: it may grasp again until its time is up
    kernels = Kernels(
        _potential, draping.evaluate_cover, _observe, act=take, account=draping.account_reference, fingers=close_or_open
    )  # fmt: skip
    seen_from = View((1.75, -1.6, 1.2), (0.0, -0.33, 0.24), 36.0)
    acting_steps = 100
    settling_steps = 60
    observations = _observations(2)
    guide_reach = 0.4  # the sheet begins farther away than in ClothDrape-v0
    ranges: ClassVar = {**DrapingTask.ranges, **PickingTask.ranges}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "target", "rumpled")
    arguments: ClassVar = {
        **DrapingTask.arguments,
        **PickingTask.arguments,
        "grippers": "or 1, for the middle of the edge (4 actions, 74 observations; harder)",
        "slip_force": "pull at which the cloth slips out of a gripper [N]; the cloth weighs 0.70 N",
    }

    def __init__(self, num_envs: int, grippers: int = 2, **kwargs: Any) -> None:
        if isinstance(grippers, bool) or not isinstance(grippers, (int, np.integer)) or grippers not in (1, 2):
            raise ValueError(f"grippers={grippers!r}: must be 1 or 2")
        self.physics = replace(self.physics, grippers=self.physics.grippers[:grippers])  # type: ignore[misc]
        self.observations = _observations(int(grippers))  # type: ignore[misc]
        super().__init__(num_envs, **kwargs)

    @property
    def places(self) -> NDArray:  # type: ignore[override]
        """The particle for each gripper: both corners of the edge at the target, or its middle."""
        mesh = self.physics.mesh
        left, right = mesh.corners[2:]
        return np.array([left, right] if len(self.physics.grippers) == 2 else [left + mesh.grid_shape[1] // 2])

    # --- reset ----------------------------------------------------------------------------------------------------------

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        target, mesh, side = self.draw_target(env, rng, options.get("target", {})), self.physics.mesh, self.physics.side
        gap, sideways, yaw = side * rng.uniform(0.05, 0.15), side * rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)
        x = lying_sheet(rng, rumpled_sheets(*mesh.grid_shape, side), mesh, yaw, options)
        # before the target, whose half width is at most sqrt(2) radii
        edge = target.center[1] - np.sqrt(2) * target.radius - gap
        x += (target.center[0] + sideways, edge - x[:, 1].max(), 0)
        x[:, 2] += np.abs(rng.normal(scale=UNEVEN, size=len(x)))
        self.hover(env, rng, x[self.places])
        self.episode["picked"][env] = False
        return x

    # --- expert and picture ---------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """Move to the corners, close, lift, move over the target and a third of a side beyond it, lower, open, and leave.

        The expert has no memory: the positions of the grippers and the held particles determine the phase.
        """
        tips, tops, side = self.simulation.grippers.positions.astype(np.float64), self.episode["top"][:, None], self.physics.side
        # over the target, both at the height of the lower one, as far apart as the corners at rest
        beyond = tops[..., 1] + EXPERT_BEYOND * side
        low = np.maximum(tops[..., 2] - EXPERT_DROP * side, 0.02)
        arrived = np.abs(tips[..., 1].mean(axis=1, keepdims=True) - beyond) < 0.03
        lift = tops[..., 2] + EXPERT_LIFT * side
        high = tips[..., 2].min(axis=1, keepdims=True) > tops[..., 2] + EXPERT_CLEARS * side
        goal = np.empty_like(tips)
        goal[..., 0] = tops[..., 0] + self.physics.mesh.rest_positions[self.places, 0]
        goal[..., 1] = np.where(high | arrived, beyond, tips[..., 1])
        goal[..., 2] = np.where(arrived, low, lift)
        down = arrived & (np.abs(tips[..., 2] - low) < 0.03)
        return carry_by_places(self, (goal - tips) / 2, down, np.array([0.0, 0.0, 0.1]))


class ClothDrapeGripperEnv(ClothEnv):
    """Pick up a flat or rumpled sheet next to a target, drape it over the target, and release it.

    ## Description
    The sheet, the targets and the evaluation are the same as in ``ClothDrape-v0``.  Here the sheet lies on the floor, flat or
    rumpled, and two grippers hover above the corners of the edge next to the target.  The target stops their tips.  After 100 steps
    the grippers open, and the sheet settles for 60 steps, in which actions are ignored; then it is evaluated.  Holding the sheet in
    place until then is as good as releasing it earlier.

    $physics

    ## Rewards
    $rewards

    During the episode the potential is 0.7 times that of ``ClothDrape-v0`` (with 0.4 L instead of its 0.15 L), plus 0.3 times the
    mean over both corners of 1 for a held corner, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    As in ``ClothDrape-v0``, with the same ``info``.

    ## Starting State
    The sheet lies in front of the target, 0.05 to 0.15 L away from it, turned by up to 0.2 rad and up to 0.1 L to the side; in half
    of the episodes it is one of 64 rumpled sheets (``benchmarks/rumpled_sheets.py``).  The grippers are open, displaced from their
    corners by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.  The target's axis is within 0.25 L of the origin; a box is
    turned by up to 45 degrees.
    """

    task_class = DrapeGripperTask

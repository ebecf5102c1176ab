"""ClothHook-v0 and ClothHook-Hard-v0: hang a sheet by its hole on a hook, held by two corners or lying on the floor, and let go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.attachments import Gripper
from clothgym.envs import draping, hooking
from clothgym.envs.definition import Observation
from clothgym.envs.draping import holds_nothing, let_go
from clothgym.envs.experts import SPEED, as_actions, carry_by_places
from clothgym.envs.from_floor import (
    REACH,
    FromFloorTask,
    grippers_seen,
    observe_picking,
    take,
    taken,
)
from clothgym.envs.gripper_task import close_or_open
from clothgym.envs.hooking import (
    ARM,
    POST_RADIUS,
    RISE,
    HookingTask,
    guidance,
    hook_score,
    measure_hook,
    observe_hook,
    sheet_with_hole,
)
from clothgym.envs.physics import MEDIAN, chosen_fabric
from clothgym.envs.rumpled import rumpled_sheets
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels

GUIDING = 0.5  # share of the potential that is for bringing the hole to the hook
PICKING = 0.2  # share of it that is for taking hold
ROWS, ROWS_HARD = 17, 21  # of the grids that the sheets are cut from
SHEET = sheet_with_hole(ROWS, 0.6, 4, 2, below=2)
SHEET_HARD = sheet_with_hole(ROWS_HARD, 0.8, 2, 2, below=2)

# the scripted expert, in sides: how far before the tip it brings the hole; how far beside the arm's axis the hole's middle may be
# on its way along the arm; how near the root that way ends; where the hole's middle is below the axis when it lets go; and how far
# apart its hands are, as a share of the edge
EXPERT_BEFORE, EXPERT_WITHIN, EXPERT_NEAR, EXPERT_DROP, EXPERT_WIDE = 0.12, 0.03, 0.1, 0.03, 0.96
EXPERT_CARRIES = 0.4  # its speed along the arm, as a share of the limit
EXPERT_GAIN = 0.3  # share of the hole's way that the hands go at once: it swings below them


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _hooking(own, rules, sheet):
    """How well the sheet hangs, and how near it is to that."""
    return GUIDING * guidance(own, rules) + (1 - GUIDING) * hook_score(own)


@inlined
def _observe_held(own, rules, sheet, seen):
    """What is observed in both tasks, and whether each corner is held."""
    observe_hook(own, rules, sheet, seen)
    for k in range(sheet.holds.shape[0]):
        seen.holds[k] = sheet.holds[k] > 0


@inlined
def _picking_and_hooking(own, rules, sheet):
    """How far the taking hold is along, and the hooking."""
    return PICKING * taken(own, rules, sheet) + (1 - PICKING) * _hooking(own, rules, sheet)


@inlined
def _observe_grippers(own, rules, sheet, seen):
    """What is observed in both tasks, and each gripper."""
    observe_hook(own, rules, sheet, seen)
    observe_picking(own, rules, sheet, seen)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


def ways_onto(task: HookingTask, hands: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """What is left of the way of two hands that bring the hole onto the arm [m], in the hook's frame, (num_envs, 2, 3); whether
    they are there, (num_envs, 1); and their speed, as a share of the limit, (num_envs, 1).

    hands: in that frame [m], (num_envs, 2, 3).
    """
    side, episode = task.physics.side, task.episode
    u, v, w = np.moveaxis(task.in_frame(episode["hole"][:, None])[:, 0], 1, 0)
    out, threaded = ARM * np.cos(RISE) * side, episode["threaded"] == 1
    # the axis at the hole, and beyond the tip where it would go on
    axis = -np.minimum(v, 0) * np.tan(RISE)
    beside = np.hypot(u, w - axis)
    along = threaded | ((beside < EXPERT_WITHIN * side) & (v < 0))
    near = threaded & (v > -EXPERT_NEAR * side)
    # to a point before the tip; along the arm; and down
    before = out + EXPERT_BEFORE * side
    goal = np.stack([
        np.zeros_like(u),
        np.where(near, v, np.where(along, v + 0.1 * side, np.minimum(v + beside, -before))),
        np.where(near, axis - 3 * EXPERT_DROP * side, np.where(along, axis - 0.1 * side * np.tan(RISE), before * np.tan(RISE))),
    ], axis=1)  # fmt: skip
    common = goal - np.stack([u, v, w], axis=1)
    # level, and apart
    middle, aside = hands.mean(axis=1, keepdims=True), np.zeros((2, 3))
    aside[:, 0] = EXPERT_WIDE * task.physics.mesh.rest_positions[list(task.sheet_cut.corners[2:]), 0]
    ways = EXPERT_GAIN * common[:, None] + (middle + aside - hands)
    there = near & (w < axis - EXPERT_DROP * side)
    return ways, there[:, None], np.where(along, EXPERT_CARRIES, SPEED)[:, None]


class HookTask(HookingTask):
    """The task of ``ClothHook-v0``, see ``ClothHookEnv``."""

    sheet_cut = SHEET
    physics = replace(draping.PHYSICS, mesh=SHEET.mesh, anchors=SHEET.corners[2:], substeps=56)
    kernels = Kernels(
        _hooking, hooking.evaluate_hook, _observe_held, act=let_go, measure=measure_hook, done=holds_nothing,
        account=hooking.account_hook,
    )  # fmt: skip
    acting_steps = 100
    actions_per_attachment = 4
    observations = (*hooking.OBSERVATIONS, Observation("holds", "whether each corner is held", (2,)))

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_hook(env, rng, options.get("hook", {}))
        mesh, side = self.physics.mesh, self.physics.side
        away, sideways, clearance = side * rng.uniform(0.3, 0.5), side * rng.uniform(-0.15, 0.15), side * rng.uniform(0.1, 0.25)
        yaw, ripple = rng.uniform(-0.3, 0.3), rng.normal(scale=1e-3, size=mesh.num_particles)
        # the sheet hangs in a plane before the hook, its held edge up
        rest = mesh.rest_positions
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.stack([c * rest[:, 0] - s * ripple, s * rest[:, 0] + c * ripple, clearance + side / 2 + rest[:, 1]], axis=1)
        return self.before(env, x, -(ARM * side + away), sideways)

    def expert_actions(self) -> NDArray:
        """The hole before the tip, along the arm, and down until the rim lies on it, then let go.

        Without memory: where the hole is says which part of the way it is on.
        """
        goal, there, speed = ways_onto(self, self.in_frame(self.episode["targets"]))
        return as_actions(self, self.out_of_frame(goal) / 2, np.where(there, 1.0, -1.0) * np.ones((1, 2)), speed)


class HookHardTask(HookingTask, FromFloorTask):
    """The task of ``ClothHook-Hard-v0``, see ``ClothHookHardEnv``."""

    sheet_cut = SHEET_HARD
    physics = replace(
        draping.PHYSICS,
        mesh=SHEET_HARD.mesh,
        material=chosen_fabric("silk", MEDIAN),
        grippers=(Gripper(speed=2 * draping.PHYSICS.attachment_speed, reach=REACH),) * 2,
        substeps=46,
        fast={"air_density": 0.0},
    )
    # an agent is never done: it may take hold again until its time is up
    kernels = Kernels(
        _picking_and_hooking, hooking.evaluate_hook, _observe_grippers, act=take, measure=measure_hook,
        account=hooking.account_hook, fingers=close_or_open,
    )  # fmt: skip
    acting_steps = 160
    observations = (*hooking.OBSERVATIONS, grippers_seen("the arm's tip"))
    ranges: ClassVar = {**HookingTask.ranges, **FromFloorTask.ranges}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "hook", "rumpled")
    arguments: ClassVar = {**HookingTask.arguments, **FromFloorTask.arguments}
    places = np.array(SHEET_HARD.corners[2:])

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_hook(env, rng, options.get("hook", {}))
        side = self.physics.side
        sheets = rumpled_sheets(ROWS_HARD, ROWS_HARD, side)[:, self.sheet_cut.kept]
        return self.lie(env, rng, options, sheets, (POST_RADIUS + ARM) * side)

    def expert_actions(self) -> NDArray:
        """Up with both corners, the hole before the tip, along the arm, and down until the rim lies on it."""
        hands = self.hands()
        goal, there, speed = ways_onto(self, hands)
        aside = np.sign(self.physics.mesh.rest_positions[self.places, 0])[:, None] * (0.1, 0.0, 0.0)
        away = self.out_of_frame(np.broadcast_to(aside, hands.shape))
        return carry_by_places(self, self.out_of_frame(goal) / 2, there, away, speed)


class ClothHookEnv(ClothEnv):
    """Hang a sheet that is held by two corners by its hole on a hook, and let go of it.

    ## Description
    A square sheet of side L = 0.6 m has a hole, 0.25 L wide and 0.125 L high, 0.125 L below its upper edge and in the middle of it:
    a grid of 17 x 17 particles without 4 x 2 of its cells, 286 particles.  It hangs from its upper corners, 0.3 to 0.5 L before the
    tip of a hook: an arm of length 0.3 L and radius 0.02 L, which rises by 30 degrees from a post, radius 0.03 L.  The arm's root
    is 1.15 to 1.35 L above the floor, and the post ends 0.3 L higher.  The agent moves both corners and may let go of each.  When
    it holds none, or after 100 steps, at which both are let go, the sheet has five seconds, 150 steps, in which actions are
    ignored; then it is evaluated.  To hold it on the hook until then is as good as to let go.

    Cloth rests 10 mm from the hook's surface, about the height of the arm's arc over a side of a triangle, so that it does not
    tremble.  The mesh is one of triangles, whose edges are the springs; ``rows`` and ``side`` are fixed.

    $physics

    ## Action Space
    $actions corner

    ## Rewards
    $rewards

    On the way the potential is the mean of the score (below) and of ``1/(1 + (d/0.4 L)^2)``, with the way d that is left to the
    middle of the hole's rim: to the arm's root if the arm is in the hole, else to its tip and along the arm.

    ## Evaluation
    The arm is in the hole if its axis goes through it: triangles from the mean of the rim to the rim's edges span the hole, and the
    axis, from root to tip, meets them more often from one side than from the other.  F is the share of the sheet's area lower than
    3 cm.  The score after each step is 1 - F if the arm is in the hole, else 0.  So a sheet that lies over the arm or the post
    scores nothing.

    ``info["normalized_performance"]`` is this score over ``1 + (v / 0.1 m/s)^2``, with the rms speed v, after the five seconds.
    ``info["is_success"]``: the arm is in the hole, F <= 0.02 and v under 0.02 m/s.  ``info`` also has ``threaded``, whether the arm
    is in the hole, ``lying`` (F), ``rms_speed`` [m/s], which are 0 until then, and in each step ``best``, the episode's best score,
    ``first_success``, the first step after which the sheet hangs so and nothing holds it, or -1, ``success_held``, whether it has
    hung ever since, ``strain_max``, ``strain_before_limiting``, ``settling``, ``failure`` and the ``reward/...`` terms.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.15 L to the side, turned by up to 0.3 rad against
    the hook, with a ripple of a millimeter.  The post is within 0.15 L of the origin in x and y; the hook is turned by up to 45
    degrees.
    """

    task_class = HookTask


class ClothHookHardEnv(ClothEnv):
    """Pick up a silk sheet from the floor, flat or rumpled, hang it by its small hole on a hook, and let go.

    ## Description
    The hook and the evaluation are those of ``ClothHook-v0``.  But the sheet is larger, L = 0.8 m (21 x 21 particles but one), of
    silk (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), and its hole is a square of 0.1 L, 0.1 L below the upper
    edge, through which the arm must go with 14 mm to spare on either side.  The sheet lies on the floor, flat or rumpled, and
    two grippers hover above the corners of its upper edge.  After 160 steps they open, and the sheet has five seconds, 150 steps,
    in which actions are ignored; then it is evaluated.

    $physics

    ## Rewards
    $rewards

    On the way the potential is 0.8 times that of ``ClothHook-v0``, plus 0.2 times the mean over both corners of 1 for one that has
    been held, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    As in ``ClothHook-v0``, with the same ``info``.

    ## Starting State
    The sheet lies before the hook, all of it 0.1 to 0.2 L from the arm's tip, turned by up to 0.2 rad against it and up to 0.1 L to
    the side; in half of the episodes it is one of 64 rumpled sheets (``benchmarks/rumpled_sheets.py``), with the hole cut out.  The
    grippers are open, up to 0.1 L beside and 0.2 to 0.35 L above their corners.  The hook is drawn as in ``ClothHook-v0``.
    """

    task_class = HookHardTask

"""ClothHang-v0 and ClothHang-Hard-v0: hang a sheet over a rail, held by two corners or lying on the floor, and let go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.attachments import Gripper
from clothgym.envs import draping, hanging
from clothgym.envs.definition import Observation
from clothgym.envs.draping import holds_nothing, let_go
from clothgym.envs.experts import as_actions, carry_by_places
from clothgym.envs.from_floor import REACH, FromFloorTask, grippers_seen, observe_picking, take, taken
from clothgym.envs.gripper_task import close_or_open
from clothgym.envs.hanging import HangingTask, guidance, hang_score, measure_hang, observe_rail
from clothgym.envs.physics import MEDIAN, chosen_fabric
from clothgym.envs.rumpled import rumpled_sheets
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.mesh import grid

GUIDING = 0.5  # share of the potential that is for bringing the sheet to the rail
PICKING = 0.2  # share of it that is for taking hold

# the scripted expert's ways, in sides: how far above the rail on the way and how far beyond it; where it lets go, beyond the rail
# and below it; and how far above the rail it sets out
EXPERT_LIFT, EXPERT_BEYOND, EXPERT_AT, EXPERT_DROP, EXPERT_CLEARS = 0.42, 0.32, 0.14, 0.39, 0.15


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _hanging(own, rules, sheet):
    """How well the sheet hangs, and how near it is to that."""
    return GUIDING * guidance(own, rules, sheet) + (1 - GUIDING) * hang_score(own)


@inlined
def _observe_held(own, rules, sheet, seen):
    """What is observed in both tasks, and whether each corner is held."""
    observe_rail(own, rules, sheet, seen)
    for k in range(sheet.holds.shape[0]):
        seen.holds[k] = sheet.holds[k] > 0


@inlined
def _picking_and_hanging(own, rules, sheet):
    """How far the taking hold is along, and the hanging."""
    return PICKING * taken(own, rules, sheet) + (1 - PICKING) * _hanging(own, rules, sheet)


@inlined
def _observe_grippers(own, rules, sheet, seen):
    """What is observed in both tasks, and each gripper."""
    observe_rail(own, rules, sheet, seen)
    observe_picking(own, rules, sheet, seen)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


def ways_over(task: HangingTask, hands: NDArray, beside: NDArray) -> tuple[NDArray, NDArray]:
    """What is left of the way of two hands that carry an edge over the rail [m], in its frame, (num_envs, 2, 3), and whether they
    are there, (num_envs, 1).

    hands: in that frame [m], (num_envs, 2, 3).  beside: of each on the rail, at the end [m], (2,).
    """
    side = task.physics.side
    across, above = hands[..., 1].mean(axis=1, keepdims=True), hands[..., 2].min(axis=1, keepdims=True)
    high = above > EXPERT_CLEARS * side
    # over it; or, beyond the rail, down
    down = (across > (EXPERT_BEYOND - 0.04) * side) | ((across > 0.5 * EXPERT_AT * side) & ~high)
    goal = np.empty_like(hands)
    goal[..., 0] = beside
    goal[..., 1] = np.where(down, EXPERT_AT * side, np.where(high, EXPERT_BEYOND * side, hands[..., 1]))
    goal[..., 2] = np.where(down, -EXPERT_DROP * side, EXPERT_LIFT * side)
    # on the way down, outside first
    goal[..., 1] = np.where(down & high, EXPERT_BEYOND * side, goal[..., 1])
    there = down & (np.abs(above + EXPERT_DROP * side) < 0.02) & (np.abs(across - EXPERT_AT * side) < 0.02)
    return goal - hands, there


class HangTask(HangingTask):
    """The task of ``ClothHang-v0``, see ``ClothHangEnv``."""

    physics = replace(draping.PHYSICS, anchors=draping.upper_corners)
    kernels = Kernels(
        _hanging, hanging.evaluate_hang, _observe_held, act=let_go, measure=measure_hang, done=holds_nothing,
        account=hanging.account_hang,
    )  # fmt: skip
    acting_steps = 80
    actions_per_attachment = 4
    observations = (*hanging.OBSERVATIONS, Observation("holds", "whether each corner is held", (2,)))

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_rail(env, rng, options.get("rail", {}))
        mesh, side = self.physics.mesh, self.physics.side
        away, sideways, clearance = side * rng.uniform(0.5, 0.7), side * rng.uniform(-0.15, 0.15), side * rng.uniform(0.1, 0.25)
        yaw, ripple = rng.uniform(-0.3, 0.3), rng.normal(scale=1e-3, size=mesh.num_particles)
        # the sheet hangs in a plane before the rail, its held edge up
        rest = mesh.rest_positions
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.stack([c * rest[:, 0] - s * ripple, s * rest[:, 0] + c * ripple, clearance + side / 2 + rest[:, 1]], axis=1)
        return self.before(env, x, -away, sideways)

    def expert_actions(self) -> NDArray:
        """Up, over the rail, and down on its other side until half of the sheet is there, then let go.

        Without memory: where the anchors are says which part of the way they are on.
        """
        hands = self.episode["targets"]
        goal, there = ways_over(self, self.in_frame(hands), self.physics.mesh.rest_positions[list(self.physics.held), 0])
        return as_actions(self, self.out_of_frame(goal) / 2, np.where(there, 1.0, -1.0) * np.ones((1, 2)))


class HangHardTask(HangingTask, FromFloorTask):
    """The task of ``ClothHang-Hard-v0``, see ``ClothHangHardEnv``."""

    physics = replace(
        draping.PHYSICS,
        mesh=grid(21, 21, 0.8, 0.8),
        material=chosen_fabric("silk", MEDIAN),
        grippers=(Gripper(speed=2 * draping.PHYSICS.attachment_speed, reach=REACH),) * 2,
        fast={"air_density": 0.0},
    )
    # an agent is never done: it may take hold again until its time is up
    kernels = Kernels(
        _picking_and_hanging, hanging.evaluate_hang, _observe_grippers, act=take, measure=measure_hang,
        account=hanging.account_hang, fingers=close_or_open,
    )  # fmt: skip
    acting_steps = 130
    radius = 0.035
    rail_friction = 0.3
    rail_thickness = 0.007
    observations = (*hanging.OBSERVATIONS, grippers_seen("the middle of the rail"))
    ranges: ClassVar = {**HangingTask.ranges, **FromFloorTask.ranges}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "rail", "rumpled")

    @property
    def places(self) -> NDArray:  # type: ignore[override]
        """Both corners of the edge at the rail."""
        return np.array(self.physics.mesh.corners[2:])

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        self.draw_rail(env, rng, options.get("rail", {}))
        side = self.physics.side
        return self.lie(env, rng, options, rumpled_sheets(*self.physics.mesh.grid_shape, side), self.radius * side)

    def expert_actions(self) -> NDArray:
        """Up with both corners, over the rail, and down on its other side until half of the sheet is there."""
        hands = self.hands()
        goal, there = ways_over(self, hands, self.physics.mesh.rest_positions[self.places, 0])
        # when it hangs, out of its way
        away = self.out_of_frame(np.where((hands[..., 1] > 0)[..., None], (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)))
        return carry_by_places(self, self.out_of_frame(goal) / 2, there, away)


class ClothHangEnv(ClothEnv):
    """Hang a sheet that is held by two corners over a rail, and let go of it.

    ## Description
    A square sheet of side L = 0.6 m (17 x 17 particles) hangs from two held corners, 0.5 to 0.7 L in front of a rail: a rod of
    radius 0.05 L and length 1.6 L, level, on two posts of the same radius, its axis 0.75 to 1 L above the floor.  The agent moves
    both corners and may let go of each.  When it holds none, or after 80 steps, at which both are let go, the sheet has five
    seconds, 150 steps, in which actions are ignored; then it is evaluated.  To hold it in the right place until then is as good as
    to let go.

    $physics

    The fabric is the median of 618 measured ones, its linear drag that of filmed cloth.  Cloth rests 6 mm from the rail's surface,
    about the height of the rail's arc over a side of a triangle, so that particles carry it and it does not tremble.

    ## Action Space
    $actions corner

    ## Rewards
    $rewards

    On the way the potential is the mean of the score (below) and of ``1/(1 + (d/0.4 L)^2)``, with the distance d of the sheet's
    center of area from the nearest point L/4 below the rail at which the sheet does not reach beyond its ends.

    ## Evaluation
    The rail's vertical plane cuts the sheet.  Balance B is twice the smaller part's share of the area.  Support S is the length of
    the cut, measured on the flat sheet, that lies between the rail's posts, and between its axis and 0.05 L above the surface on
    which cloth rests: in sides, at most 1, since no line that halves a square is shorter.  F is the share of the area lower than
    3 cm.  All are of the triangles' surface, so another resolution of the same surface has the same.  The score after each step
    is B S (1 - F): 0 on the floor, beside or under the rail; 1 for a sheet that the rail halves.  So cloth that is held up without
    the rail, that lies beneath it, or that hangs by a corner scores nothing or little.

    ``info["normalized_performance"]`` = B S (1 - F) / (1 + (v / 0.1 m/s)^2), with the rms speed v, after the five seconds.
    ``info["is_success"]``: B >= 0.6 (3/10 of the sheet on either side), S >= 0.9, F <= 0.02 and v under 0.02 m/s.  ``info`` also
    has ``balance``, ``support``, ``lying`` (F), ``rms_speed`` [m/s], which are 0 until then, and in each step ``best``, the
    episode's best score, ``first_success``, the first step after which the sheet hangs so and nothing holds it, or -1,
    ``success_held``, whether it has hung ever since, ``strain_max``, ``strain_before_limiting``, ``settling``, ``failure`` and the
    ``reward/...`` terms.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.15 L to the side, turned by up to 0.3 rad against
    the rail, with a ripple of a millimeter.  The rail's middle is within 0.15 L of the origin in x and y; it is turned by up to
    45 degrees.
    """

    task_class = HangTask


class ClothHangHardEnv(ClothEnv):
    """Pick up a silk sheet from the floor, flat or rumpled, hang it over a thin rail, and let go.

    ## Description
    The rail and the evaluation are those of ``ClothHang-v0``.  But the sheet is larger, L = 0.8 m (21 x 21 particles), of silk
    (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), the rail is thinner, 0.035 L, its friction 0.3, and cloth rests 7
    mm from it.  The sheet lies on the floor, flat or rumpled, and two grippers hover above the corners of its edge at the rail,
    which stops their tips.  After 130 steps they open, and the sheet has five seconds, 150 steps, in which actions are ignored;
    then it is evaluated.

    $physics

    ## Rewards
    $rewards

    On the way the potential is 0.8 times that of ``ClothHang-v0``, plus 0.2 times the mean over both corners of 1 for one that has
    been held, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    As in ``ClothHang-v0``, with the same ``info``.

    ## Starting State
    The sheet lies before the rail, all of it 0.1 to 0.2 L away, turned by up to 0.2 rad against it and up to 0.1 L to the side; in
    half of the episodes it is one of 64 rumpled sheets (``benchmarks/rumpled_sheets.py``).  The grippers are open, up to 0.1 L
    beside and 0.2 to 0.35 L above their corners.  The rail is drawn as in ``ClothHang-v0``.
    """

    task_class = HangHardTask

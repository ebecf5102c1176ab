"""ClothHang-v0 and ClothHang-Hard-v0: hang a sheet over a rail, from two held corners or from the floor, and release it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined
from clothgym.collisions import Capsule, Collider
from clothgym.envs import draping
from clothgym.envs.draping import let_go
from clothgym.envs.episode import Fields
from clothgym.envs.experts import SPEED
from clothgym.envs.gripper_task import LARGE_SILK, close_or_open, take
from clothgym.envs.hanging import (
    GUIDE_SCALE,
    HOLDS,
    LYING,
    MOST_LYING,
    FromFloorTask,
    HangingTask,
    account_hanging,
    grippers_seen,
    guided,
    observe_held,
    observe_picking,
    picked,
)  # fmt: skip
from clothgym.envs.measures import CENTROID, SPEED2, share_above
from clothgym.envs.observing import POSITION_BOUND, Observation, View
from clothgym.envs.scoring import ENOUGH_REST, SPEED_SCALE, TIME, falloff, holds_nothing
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.targets import FRICTION

HALF_LENGTH = 0.75  # half the rail's length between the axes of its posts, in sides
OVER = 0.05  # cloth less than this above the rail's contact surface counts as supported, in sides
ENOUGH_BALANCE, ENOUGH_SUPPORT = 0.6, 0.9  # twice the smaller side's share; in sides

# the scripted expert's path, in sides: height above the rail and distance beyond it on the way; distance beyond and depth below the
# rail at the release; and height above the rail before it moves sideways
EXPERT_LIFT, EXPERT_BEYOND, EXPERT_AT, EXPERT_DROP, EXPERT_CLEARS = 0.42, 0.32, 0.14, 0.39, 0.15


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@apart
def hang_of(x, triangles, rest, areas, side, rail, turn, ends, low, high, out):
    """Write how a sheet hangs over a rail: share of its area beyond the rail, share on the floor, supported length in sides.

    The rail's vertical plane cuts the sheet's triangles.  Areas and lengths are those of the flat sheet, by linear functions on the
    triangles, so they do not depend on the triangulation of a surface.  A point of the cut is supported if it is between
    ``low`` and ``high`` above the rail's axis [m], and no farther than ``ends`` from its middle.  A line that halves a square is at
    least as long as a side: length beyond a side does not count.

    x: (3, particles) [m].  rest: (particles, 2) [m].  areas: of the triangles, summing to 1.  rail: middle of its axis [m].
    turn: cosine and sine of its yaw.
    """
    beyond, lying, carried = 0.0, 0.0, 0.0
    v, cut, d = np.empty(3), np.empty((2, 4)), np.empty(3)
    for t in range(triangles.shape[0]):
        # signed distances from the rail's plane, and the areas
        for m in range(3):
            p = triangles[t, m]
            v[m] = turn[0] * (np.float64(x[1, p]) - rail[1]) - turn[1] * (np.float64(x[0, p]) - rail[0])
            d[m] = LYING - np.float64(x[2, p])
        share = share_above(v[0], v[1], v[2])
        beyond += areas[t] * share
        lying += areas[t] * share_above(d[0], d[1], d[2])
        if share == 0 or share == 1:
            continue
        # the ends of the cut: along the rail, above it, and in the flat sheet
        found = 0
        for m in range(3):
            n = (m + 1) % 3
            if (v[m] > 0) != (v[n] > 0):
                s, p, q = v[m] / (v[m] - v[n]), triangles[t, m], triangles[t, n]
                for c in range(2):
                    cut[found, 2 + c] = rest[p, c] + s * (rest[q, c] - rest[p, c])
                here_x, here_y = x[0, p] + s * (x[0, q] - x[0, p]), x[1, p] + s * (x[1, q] - x[1, p])
                cut[found, 0] = turn[0] * (here_x - rail[0]) + turn[1] * (here_y - rail[1])
                cut[found, 1] = x[2, p] + s * (x[2, q] - x[2, p]) - rail[2]
                found += 1
        along, above = (cut[0, 0] + cut[1, 0]) / 2, (cut[0, 1] + cut[1, 1]) / 2
        if abs(along) <= ends and low <= above <= high:
            carried += np.sqrt((cut[1, 2] - cut[0, 2]) ** 2 + (cut[1, 3] - cut[0, 3]) ** 2)
    out[0], out[1], out[2] = beyond, lying, min(carried / side, 1.0)


@inlined
def measure_hang(own, rules, sheet):
    """Write how the sheet hangs, see ``hang_of``."""
    hang_of(
        sheet.x, sheet.mesh.triangles, rules.rest, rules.areas, rules.side, own.rail, own.turn, rules.ends, 0.0,
        rules.carried_within, own.hang,
    )  # fmt: skip


@inlined
def balance_of(own):
    """Twice the share of the sheet on the smaller side of the rail: 1 for halves."""
    return 2 * min(own.hang[0], 1 - own.hang[0])


@inlined
def hang_score(own):
    """Score of the hanging sheet, in [0, 1]: 1 if the rail supports it at its middle, and nothing is on the floor."""
    return balance_of(own) * own.hang[2] * (1 - own.hang[1])


@inlined
def hangs(own):
    """Whether the sheet hangs, at rest or not."""
    return balance_of(own) >= ENOUGH_BALANCE and own.hang[2] >= ENOUGH_SUPPORT and own.hang[1] <= MOST_LYING


@inlined
def _guidance(own, rules, sheet):
    """Nearness of the center of area to that of a hanging sheet, a quarter of a side below the rail, in [0, 1]."""
    x, y = sheet.summary[CENTROID] - own.rail[0], sheet.summary[CENTROID + 1] - own.rail[1]
    # anywhere along the rail where the sheet does not reach beyond its ends
    along = max(abs(own.turn[0] * x + own.turn[1] * y) - (rules.ends - rules.side / 2), 0.0)
    across, up = own.turn[0] * y - own.turn[1] * x, sheet.summary[CENTROID + 2] - own.rail[2] + rules.side / 4
    return 1 / (1 + (along * along + across * across + up * up) / (GUIDE_SCALE * rules.side) ** 2)


@inlined
def _hanging(own, rules, sheet):
    """Score of a held sheet, and its nearness to hanging."""
    return guided(_guidance(own, rules, sheet), hang_score(own))


@inlined
def _picking_and_hanging(own, rules, sheet):
    """Progress of grasping and of hanging."""
    return picked(own, rules, sheet, _hanging(own, rules, sheet))


@inlined
def _evaluate(own, rules, sheet, info):
    """Write the measures of the hanging sheet and its speed; returns the normalized performance."""
    info.balance, info.support, info.lying = balance_of(own), own.hang[2], own.hang[1]
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    info.is_success = hangs(own) and info.rms_speed < ENOUGH_REST
    return hang_score(own) / falloff(info.rms_speed, SPEED_SCALE)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    """Write the record of scores and of successes; no reward terms."""
    return account_hanging(own, rules, sheet, info, hang_score(own), hangs(own), running, failure)


@inlined
def _observe_rail(own, rules, sheet, seen):
    """The sheet's center, the measures of hanging, and the rail."""
    for c in range(3):
        seen.center[c] = (sheet.summary[CENTROID + c] - own.origin[c]) / rules.side
        seen.hang[c] = own.hang[c]
    seen.rail_height = own.rail[2] / rules.side
    seen.rail_turn[0], seen.rail_turn[1] = own.turn[0], own.turn[1]


@inlined
def _observe_held(own, rules, sheet, seen):
    """The observations of both tasks, and the held corners."""
    _observe_rail(own, rules, sheet, seen)
    observe_held(own, rules, sheet, seen)


@inlined
def _observe_grippers(own, rules, sheet, seen):
    """The observations of both tasks, and each gripper."""
    _observe_rail(own, rules, sheet, seen)
    observe_picking(own, rules, sheet, seen)


OBSERVATIONS = (
    Observation("center", "center of area, relative to the middle of the rail", (3,), "L", POSITION_BOUND, turns=1),
    Observation(
        "hang", "share of the sheet beyond the rail, share on the floor, length that the rail supports [L], at most 1", (3,)
    ),
    Observation("rail_height", "height of the rail's axis", (), "L", 2.0),
    Observation("rail_turn", "cosine and sine of its yaw", (2,)),
    *TIME,
)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class RailTask(HangingTask):
    """Base of both tasks.

    Attributes:
        radius: of the rail and its posts, in sides.  rail_friction: between them and the cloth.  rail_thickness: distance at which
            the cloth rests on them [m]: about the height of the arc over a side of a triangle, so that particles support the sheet.
    """

    stand = frame_at = "rail"
    direction = "the rail"
    heights, heights_allowed = (0.75, 1.0), (0.6, 1.2)
    radius: ClassVar[float] = 0.05
    rail_friction: ClassVar[float] = FRICTION
    rail_thickness: ClassVar[float] = 0.006
    seen_from = View((0.8, -2.0, 1.0), (0.0, -0.15, 0.36), 37.0, scales_from=0.6)
    points_relative_to = "the middle of the rail"
    evaluation = (("balance", float), ("support", float), ("lying", float), ("rms_speed", float))
    ranges: ClassVar = {**HangingTask.ranges, "hang": (-1e-6, 1 + 1e-6), "rail": (-2.0, 2.0)}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "rail")

    def remembers(self) -> Fields:
        # how the sheet hangs
        return [*super().remembers(), ("hang", float, 3)]

    def constants(self) -> dict[str, Any]:
        side, rest = self.physics.side, self.physics.mesh.rest_positions[:, :2]
        radius = self.radius * side
        return super().constants() | {
            "rest": np.ascontiguousarray(rest, np.float64), "ends": HALF_LENGTH * side, "radius": radius,
            "carried_within": radius + self.rail_thickness + OVER * side,
        }  # fmt: skip

    def solids_of(self, at: NDArray, turn: NDArray) -> list[Collider]:
        """A rail and its posts."""
        side, friction, thickness = self.physics.side, self.rail_friction, self.rail_thickness
        radius, half = self.radius * side, HALF_LENGTH * side
        x, y, z = at.tolist()
        along = (float(turn[0]), float(turn[1]), 0.0)
        bar = Capsule(
            center=(x, y, z), radius=radius, height=2 * (half + radius), axis=along, friction=friction, thickness=thickness
        )
        # the lower round end of a post is sunk, and its upper one is the rail's
        ends = [(x + way * half * along[0], y + way * half * along[1]) for way in (-1, 1)]
        posts = [
            Capsule(center=(*end, z / 2), radius=radius, height=z + 2 * radius, friction=friction, thickness=thickness)
            for end in ends
        ]
        return [bar, *posts]

    def stands(self, own: Any) -> bool:
        return bool(own["rail"][2] > self.radius * self.physics.side)

    def ways(self, hands: NDArray) -> tuple[NDArray, NDArray, float | NDArray]:
        """Lift, move over the rail, and lower on its other side until half of the sheet is there."""
        side, mesh = self.physics.side, self.physics.mesh
        across, above = hands[..., 1].mean(axis=1, keepdims=True), hands[..., 2].min(axis=1, keepdims=True)
        high = above > EXPERT_CLEARS * side
        # over the rail; or, beyond it, down
        down = (across > (EXPERT_BEYOND - 0.04) * side) | ((across > 0.5 * EXPERT_AT * side) & ~high)
        goal = np.empty_like(hands)
        goal[..., 0] = mesh.rest_positions[list(mesh.corners[2:]), 0]
        goal[..., 1] = np.where(down, EXPERT_AT * side, np.where(high, EXPERT_BEYOND * side, hands[..., 1]))
        goal[..., 2] = np.where(down, -EXPERT_DROP * side, EXPERT_LIFT * side)
        # on the way down, outside first
        goal[..., 1] = np.where(down & high, EXPERT_BEYOND * side, goal[..., 1])
        there = down & (np.abs(above + EXPERT_DROP * side) < 0.02) & (np.abs(across - EXPERT_AT * side) < 0.02)
        return goal - hands, there, SPEED


class HangTask(RailTask):
    """The task of ``ClothHang-v0``, see ``ClothHangEnv``."""

    physics = replace(draping.PHYSICS, anchors=draping.upper_corners)
    kernels = Kernels(
        _hanging, _evaluate, _observe_held, act=let_go, measure=measure_hang, done=holds_nothing, account=_account
    )  # fmt: skip
    acting_steps = 80
    away = (0.5, 0.7)
    observations = (*OBSERVATIONS, HOLDS)


class HangHardTask(RailTask, FromFloorTask):
    """The task of ``ClothHang-Hard-v0``, see ``ClothHangHardEnv``."""

    physics = LARGE_SILK
    # an agent is never done: it may grasp again until its time is up
    kernels = Kernels(
        _picking_and_hanging, _evaluate, _observe_grippers, act=take, measure=measure_hang, account=_account,
        fingers=close_or_open,
    )  # fmt: skip
    acting_steps = 130
    radius = extent = 0.035
    rail_friction = 0.3
    rail_thickness = 0.007
    observations = (*OBSERVATIONS, grippers_seen("the middle of the rail"))
    ranges: ClassVar = {**RailTask.ranges, **FromFloorTask.ranges}
    arguments: ClassVar = {**RailTask.arguments, **FromFloorTask.arguments}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "rail", "rumpled")

    @property
    def places(self) -> NDArray:  # type: ignore[override]
        """Both corners of the edge at the rail."""
        return np.array(self.physics.mesh.corners[2:])

    def leaving(self, hands: NDArray) -> NDArray:
        return np.where((hands[..., 1] > 0)[..., None], (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))


class ClothHangEnv(ClothEnv):
    """Hang a sheet, held by two corners, over a rail and release it.

    ## Description
    A square sheet of side L = 0.6 m (17 x 17 particles) hangs from two held corners, 0.5 to 0.7 L in front of a rail: a rod of
    radius 0.05 L and length 1.6 L, level, on two posts of the same radius, its axis 0.75 to 1 L above the floor.  The agent moves
    both corners and may release each.  After 80 steps both are released.  When no corner is held, the sheet settles for five
    seconds, 150 steps, in which actions are ignored; then it is evaluated.  Holding the sheet in place until then is as good as
    releasing it earlier.

    $physics

    The fabric is the median of 618 measured fabrics; its linear drag comes from filmed cloth.  Cloth rests 6 mm from the rail's
    surface, about the height of the rail's arc over a side of a triangle, so that particles support it and it does not tremble.

    ## Action Space
    $actions corner

    ## Rewards
    $rewards

    During the episode the potential is the mean of the score (below) and of ``1/(1 + (d/0.4 L)^2)``, with the distance d of the
    sheet's center of area from the nearest point L/4 below the rail at which the sheet does not reach beyond its ends.

    ## Evaluation
    The rail's vertical plane cuts the sheet.  Balance B is twice the smaller part's share of the area.  Support S is the length of
    the cut, measured on the flat sheet, that lies between the rail's posts, and between its axis and 0.05 L above the surface on
    which cloth rests: in sides, at most 1, since no line that halves a square is shorter.  F is the share of the area lower than
    3 cm.  All measures are of the triangles' surface, and do not depend on its resolution.  The score after each step
    is B S (1 - F): 0 on the floor, next to or under the rail; 1 for a sheet that the rail halves.  Cloth that is held up without
    the rail, lies beneath it, or hangs by a corner therefore scores nothing or little.

    ``info["normalized_performance"]`` = B S (1 - F) / (1 + (v / 0.1 m/s)^2), with the rms speed v, after the five seconds.
    ``info["is_success"]``: B >= 0.6 (3/10 of the sheet on either side), S >= 0.9, F <= 0.02 and v under 0.02 m/s.  ``info`` also
    has ``balance``, ``support``, ``lying`` (F), ``rms_speed`` [m/s], which are 0 until then, and in each step ``best``, the
    episode's best score, ``first_success``, the first step after which the sheet hangs in this way and is not held, or -1,
    ``success_held``, whether it has hung ever since, ``strain_max``, ``strain_before_limiting``, ``settling``, ``failure`` and the
    ``reward/...`` terms.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.15 L to the side, turned by up to 0.3 rad against
    the rail, with a ripple of a millimeter.  The rail's middle is within 0.15 L of the origin in x and y; it is turned by up to
    45 degrees.
    """

    task_class = HangTask


class ClothHangHardEnv(ClothEnv):
    """Pick up a flat or rumpled silk sheet from the floor, hang it over a thin rail, and release it.

    ## Description
    The task and the evaluation are the same as in ``ClothHang-v0``, with a larger sheet, L = 0.8 m (21 x 21 particles), of silk
    (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), and a thinner rail, 0.035 L, with a friction of 0.3; cloth rests 7
    mm from it.  The sheet lies on the floor, flat or rumpled, and two grippers hover above the corners of the edge next to the
    rail.  The rail stops their tips.  After 130 steps the grippers open, and the sheet settles for five seconds, 150 steps, in
    which actions are ignored; then it is evaluated.

    $physics

    ## Rewards
    $rewards

    During the episode the potential is 0.8 times that of ``ClothHang-v0``, plus 0.2 times the mean over both corners of 1 for a
    corner that has been held, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    As in ``ClothHang-v0``, with the same ``info``.

    ## Starting State
    The whole sheet lies in front of the rail, 0.1 to 0.2 L away, turned by up to 0.2 rad relative to it and up to 0.1 L to the
    side; in half of the episodes it is one of 64 rumpled sheets (``benchmarks/rumpled_sheets.py``).  The grippers are open,
    displaced from their corners by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.  The rail is drawn as in
    ``ClothHang-v0``.
    """

    task_class = HangHardTask

"""ClothHook-v0 and ClothHook-Hard-v0: hang a sheet on a hook by its hole, from two held corners or from the floor; release it.

A hook is an arm that rises from a post.  In the hook's frame the arm extends along negative y from the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

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
from clothgym.envs.measures import SPEED2, distance, share_above
from clothgym.envs.observing import POSITION_BOUND, Observation, View
from clothgym.envs.rumpled import rumpled_sheets
from clothgym.envs.scoring import ENOUGH_REST, SPEED_SCALE, TIME, falloff, holds_nothing
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.targets import FRICTION
from clothgym.mesh import ClothMesh, grid
from clothgym.triangles import triangle_mesh

# in sides: the arm's length; radii of arm and post; height of the post above the arm's root
ARM, ARM_RADIUS, POST_RADIUS, TOP = 0.3, 0.02, 0.03, 0.3
RISE = np.pi / 6  # slope of the arm [rad]
# distance at which cloth rests on them [m]: the height of the arc over a side of a triangle, so that it does not tremble
ON_HOOK = 0.01

# the scripted expert, in sides: distance in front of the tip to which it brings the hole; largest distance of the hole's middle
# from the arm's axis on its way along the arm; distance from the root at which that way ends; depth of the hole's middle below the
# axis at the release; and distance of its hands, as a share of the edge
EXPERT_BEFORE, EXPERT_WITHIN, EXPERT_NEAR, EXPERT_DROP, EXPERT_WIDE = 0.12, 0.03, 0.1, 0.03, 0.96
EXPERT_CARRIES = 0.4  # its speed along the arm, as a share of the limit
EXPERT_GAIN = 0.3  # share of the hole's displacement that the hands move in a step: the hole swings below them


# --- the sheet ----------------------------------------------------------------------------------------------------------------


class HoledSheet(NamedTuple):
    """A square sheet with a rectangular hole.

    mesh: its triangles.  kept: indices of its particles in the original grid, (particles,).  rim: its particles around the hole, in
    order, (rim,).  corners: as a grid's.  key: observed particles: corners, middles of the edges, corners of the hole.
    """

    mesh: ClothMesh
    kept: NDArray
    rim: NDArray
    corners: tuple[int, int, int, int]
    key: NDArray


def sheet_with_hole(rows: int, side: float, width: int, height: int, below: int) -> HoledSheet:
    """A sheet cut from a square grid with an odd number of rows.

    The hole has ``width`` x ``height`` cells, is centered along the upper edge, and starts ``below`` cells below it; width is even.
    """
    whole = grid(rows, rows, side, side)
    index = np.arange(rows * rows).reshape(rows, rows)
    left, top = (rows - 1 - width) // 2, rows - 1 - below
    right, bottom = left + width, top - height
    # a triangle is in the hole if its centroid is
    row, column = (whole.triangles // rows).mean(axis=1), (whole.triangles % rows).mean(axis=1)
    hole = (bottom < row) & (row < top) & (left < column) & (column < right)
    triangles = whole.triangles[~hole]
    kept = np.unique(triangles)
    new = np.full(rows * rows, -1)
    new[kept] = np.arange(len(kept))
    mesh = triangle_mesh(whole.rest_positions[kept], new[triangles])
    # around the hole, counter-clockwise
    rim = np.concatenate([
        index[bottom, left:right], index[bottom:top, right], index[top, right:left:-1], index[top:bottom:-1, left]
    ])  # fmt: skip
    middle, last = rows // 2, rows - 1
    edges = index[[0, middle, middle, last], [middle, 0, last, middle]]
    cut = index[[bottom, bottom, top, top], [left, right, left, right]]
    corners = tuple(int(new[corner]) for corner in whole.corners)
    return HoledSheet(mesh, kept, new[rim], corners, np.concatenate([corners, new[edges], new[cut]]))  # type: ignore[arg-type]


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@apart
def threads(x, rim, a, b):
    """Number of crossings of the segment from a to b through a hole, less those in the opposite direction.

    The hole is spanned by the fan of triangles from the mean of its rim to the rim's edges.  A line meets a triangle if it has
    all three edges on the same side: the signs of three volumes.  Two triangles that share an edge use the same volume for it.

    x: (3, particles) [m].  rim: particles around the hole, in order, (rim,).
    """
    count, n = 0, rim.shape[0]
    # relative to a: the segment's direction, and the hole's middle
    d, m = (b[0] - a[0], b[1] - a[1], b[2] - a[2]), np.zeros(3)
    for k in range(n):
        for c in range(3):
            m[c] += (np.float64(x[c, rim[k]]) - a[c]) / n
    q = (x[0, rim[n - 1]] - a[0], x[1, rim[n - 1]] - a[1], x[2, rim[n - 1]] - a[2])
    for k in range(n):
        p, q = q, (x[0, rim[k]] - a[0], x[1, rim[k]] - a[1], x[2, rim[k]] - a[2])
        # volumes that the segment's line makes with the triangle's edges
        u = _volume(d, p, q)
        v = _volume(d, q, m)
        w = _volume(d, m, p)
        if (u > 0) != (v > 0) or (v > 0) != (w > 0):
            continue
        # and whether the ends are on different sides of the triangle: their volumes with it
        before = _volume(p, q, m)
        after = before - (u + v + w)
        if (before > 0) != (after > 0):
            count += 1 if u > 0 else -1
    return count


@inlined
def _volume(p, q, r):
    """Six times the signed volume of the tetrahedron of the origin and three points."""
    return (
        p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0])
    )  # fmt: skip


@apart
def lying_of(x, triangles, areas):
    """Share of a sheet's area that is lower than ``LYING``; areas: of the flat sheet's triangles, summing to 1."""
    lying = 0.0
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        lying += areas[t] * share_above(LYING - np.float64(x[2, a]), LYING - np.float64(x[2, b]), LYING - np.float64(x[2, c]))
    return lying


@inlined
def measure_hook(own, rules, sheet):
    """Write whether the arm is in the hole, the hole's middle and normal, and the share of the sheet on the floor."""
    # the arm's ends
    own.tip[0] = own.root[0] + rules.arm_out * own.turn[1]
    own.tip[1] = own.root[1] - rules.arm_out * own.turn[0]
    own.tip[2] = own.root[2] + rules.arm_up
    own.threaded = threads(sheet.x, rules.rim, own.root, own.tip) != 0
    own.lying = lying_of(sheet.x, sheet.mesh.triangles, rules.areas)
    # middle of the rim; and the vector area of the rim
    n = rules.rim.shape[0]
    for c in range(3):
        own.hole[c] = own.facing[c] = 0.0
    for k in range(n):
        for c in range(3):
            own.hole[c] += np.float64(sheet.x[c, rules.rim[k]]) / n
    for k in range(n):
        p, q = rules.rim[k], rules.rim[(k + 1) % n]
        for c in range(3):
            i, j = (c + 1) % 3, (c + 2) % 3
            own.facing[c] += (np.float64(sheet.x[i, p]) - own.hole[i]) * (np.float64(sheet.x[j, q]) - own.hole[j])
            own.facing[c] -= (np.float64(sheet.x[j, p]) - own.hole[j]) * (np.float64(sheet.x[i, q]) - own.hole[i])
    size = np.sqrt(own.facing[0] ** 2 + own.facing[1] ** 2 + own.facing[2] ** 2)
    for c in range(3):
        own.facing[c] /= max(size, 1e-12)


@inlined
def hook_score(own):
    """The share of the sheet off the floor if the arm is in the hole, else 0."""
    return 1 - own.lying if own.threaded else 0.0


@inlined
def on_hook(own):
    """Whether the sheet hangs on the hook, at rest or not."""
    return own.threaded and own.lying <= MOST_LYING


@inlined
def _guidance(own, rules):
    """Falloff of the remaining path length of the hole's middle, in [0, 1]: from the tip along the arm to its root."""
    left = distance(own.hole, own.root) if own.threaded else distance(own.hole, own.tip) + rules.arm
    return 1 / falloff(left, GUIDE_SCALE * rules.side)


@inlined
def _hooking(own, rules, sheet):
    """Score of a held sheet, and its nearness to hanging."""
    return guided(_guidance(own, rules), hook_score(own))


@inlined
def _picking_and_hooking(own, rules, sheet):
    """Progress of grasping and of hooking."""
    return picked(own, rules, sheet, _hooking(own, rules, sheet))


@inlined
def _evaluate(own, rules, sheet, info):
    """Write the measures of the hanging sheet and its speed; returns the normalized performance."""
    info.threaded, info.lying, info.rms_speed = own.threaded, own.lying, np.sqrt(sheet.summary[SPEED2])
    info.is_success = on_hook(own) and info.rms_speed < ENOUGH_REST
    return hook_score(own) / falloff(info.rms_speed, SPEED_SCALE)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    """Write the record of scores and of successes; no reward terms."""
    return account_hanging(own, rules, sheet, info, hook_score(own), on_hook(own), running, failure)


@inlined
def _observe_hook(own, rules, sheet, seen):
    """The hole and the hook, relative to the arm's tip."""
    for c in range(3):
        seen.hole[c] = (own.hole[c] - own.tip[c]) / rules.side
        seen.hole_normal[c] = own.facing[c]
        seen.arm[c] = (own.root[c] - own.tip[c]) / rules.arm
    seen.tip_height, seen.threaded, seen.lying = own.tip[2] / rules.side, own.threaded, own.lying


@inlined
def _observe_held(own, rules, sheet, seen):
    """The observations of both tasks, and the held corners."""
    _observe_hook(own, rules, sheet, seen)
    observe_held(own, rules, sheet, seen)


@inlined
def _observe_grippers(own, rules, sheet, seen):
    """The observations of both tasks, and each gripper."""
    _observe_hook(own, rules, sheet, seen)
    observe_picking(own, rules, sheet, seen)


OBSERVATIONS = (
    Observation("hole", "middle of the hole's rim, relative to the arm's tip", (3,), "L", POSITION_BOUND, turns=1),
    Observation("hole_normal", "unit normal of the hole", (3,), turns=1),
    Observation("arm", "direction of the arm, from its tip to its root, a unit vector", (3,), turns=1),
    Observation("tip_height", "height of the arm's tip", (), "L", 2.0),
    Observation("threaded", "whether the arm is in the hole"),
    Observation("lying", "share of the sheet on the floor"),
    *TIME,
)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class HookingTask(HangingTask):
    """Base of both tasks.

    Attributes:
        sheet_cut: the sheet, whose mesh is that of ``physics``.
    """

    stand, frame_at = "hook", "root"
    heights, heights_allowed = (1.15, 1.35), (1.1, 1.5)
    extent = ARM
    sheet_cut: ClassVar[HoledSheet]
    seen_from = View((-2.0, -1.5, 1.05), (0.0, -0.3, 0.43), 38.0, scales_from=0.6)
    points_relative_to = "the arm's tip"
    key_points = "corners, middles of the edges, and corners of the hole"
    evaluation = (("threaded", bool), ("lying", float), ("rms_speed", float))
    ranges: ClassVar = {
        **HangingTask.ranges, "root": (-2.0, 2.0), "tip": (-2.5, 2.5), "threaded": (0, 1), "lying": (-1e-6, 1 + 1e-6),
        "facing": (-1.0, 1.0),
    }  # fmt: skip
    reset_options: ClassVar[tuple[str, ...]] = ("material", "hook")
    direction = "the horizontal at right angles to the arm"
    arguments: ClassVar = {
        **HangingTask.arguments, "rows": "not supported: the sheet has a fixed triangle mesh", "side": "fixed, as for ``rows``",
    }  # fmt: skip

    def remembers(self) -> Fields:
        # the end of the arm's axis [m]; the hole's middle [m] and normal; and the measures of hanging
        own: Fields = [("tip", float, 3), ("hole", float, 3), ("facing", float, 3), ("threaded", np.uint8), ("lying", float)]
        return [*super().remembers(), *own]

    def constants(self) -> dict[str, Any]:
        side = self.physics.side
        own = {"rim": self.sheet_cut.rim, "arm": ARM * side}
        own |= {"arm_out": ARM * side * float(np.cos(RISE)), "arm_up": ARM * side * float(np.sin(RISE))}
        return super().constants() | own

    def observed_particles(self, mesh: ClothMesh) -> NDArray:
        return self.sheet_cut.key

    def tip_of(self, root: NDArray, turn: NDArray) -> NDArray:
        """End of the arm with this root and turn [m]."""
        (c, s), side = turn, self.physics.side
        return root + ARM * side * np.array([np.cos(RISE) * s, -np.cos(RISE) * c, np.sin(RISE)])

    def solids_of(self, at: NDArray, turn: NDArray) -> list[Collider]:
        """Arm and post."""
        side, root, tip = self.physics.side, at, self.tip_of(at, turn)
        radius, high = POST_RADIUS * side, float(root[2]) + TOP * side
        arm = Capsule(
            center=tuple(((root + tip) / 2).tolist()), radius=ARM_RADIUS * side, height=(ARM + 2 * ARM_RADIUS) * side,
            axis=tuple((tip - root).tolist()), friction=FRICTION, thickness=ON_HOOK,
        )  # fmt: skip
        # the lower round end of the post is sunk
        post = Capsule(
            center=(float(root[0]), float(root[1]), high / 2), radius=radius, height=high + 2 * radius, friction=FRICTION,
            thickness=ON_HOOK,
        )  # fmt: skip
        return [arm, post]

    def stands(self, own: Any) -> bool:
        return own["root"][2] > 0 and np.allclose(own["tip"], self.tip_of(own["root"], own["turn"]))

    def draw_stand(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        super().draw_stand(env, rng, options)
        own = self.episode[env]
        own["tip"] = own["origin"] = self.tip_of(own["root"], own["turn"])

    def ways(self, hands: NDArray) -> tuple[NDArray, NDArray, float | NDArray]:
        """Move the hole in front of the tip, then along the arm, then down until the rim lies on it."""
        side, episode = self.physics.side, self.episode
        u, v, w = np.moveaxis(self.in_frame(episode["hole"][:, None])[:, 0], 1, 0)
        out, threaded = ARM * np.cos(RISE) * side, episode["threaded"] == 1
        # height of the axis at the hole, extrapolated beyond the tip
        axis = -np.minimum(v, 0) * np.tan(RISE)
        off_axis = np.hypot(u, w - axis)
        along = threaded | ((off_axis < EXPERT_WITHIN * side) & (v < 0))
        near = threaded & (v > -EXPERT_NEAR * side)
        # to a point in front of the tip; along the arm; and down
        before = out + EXPERT_BEFORE * side
        goal = np.stack([
            np.zeros_like(u),
            np.where(near, v, np.where(along, v + 0.1 * side, np.minimum(v + off_axis, -before))),
            np.where(near, axis - 3 * EXPERT_DROP * side, np.where(along, axis - 0.1 * side * np.tan(RISE), before * np.tan(RISE))),
        ], axis=1)  # fmt: skip
        common = goal - np.stack([u, v, w], axis=1)
        # level, and apart
        middle, aside = hands.mean(axis=1, keepdims=True), np.zeros((2, 3))
        aside[:, 0] = EXPERT_WIDE * self.physics.mesh.rest_positions[list(self.sheet_cut.corners[2:]), 0]
        ways = EXPERT_GAIN * common[:, None] + (middle + aside - hands)
        there = near & (w < axis - EXPERT_DROP * side)
        return ways, there[:, None], np.where(along, EXPERT_CARRIES, SPEED)[:, None]


class HookTask(HookingTask):
    """The task of ``ClothHook-v0``, see ``ClothHookEnv``."""

    sheet_cut = sheet_with_hole(17, 0.6, 4, 2, below=2)
    physics = replace(draping.PHYSICS, mesh=sheet_cut.mesh, anchors=sheet_cut.corners[2:], substeps=56)
    kernels = Kernels(
        _hooking, _evaluate, _observe_held, act=let_go, measure=measure_hook, done=holds_nothing, account=_account
    )  # fmt: skip
    acting_steps = 100
    away = (0.3, 0.5)
    observations = (*OBSERVATIONS, HOLDS)


class HookHardTask(HookingTask, FromFloorTask):
    """The task of ``ClothHook-Hard-v0``, see ``ClothHookHardEnv``."""

    sheet_cut = sheet_with_hole(21, 0.8, 2, 2, below=2)
    physics = replace(LARGE_SILK, mesh=sheet_cut.mesh, substeps=46)
    # an agent is never done: it may grasp again until its time is up
    kernels = Kernels(
        _picking_and_hooking, _evaluate, _observe_grippers, act=take, measure=measure_hook, account=_account,
        fingers=close_or_open,
    )  # fmt: skip
    acting_steps = 160
    extent = POST_RADIUS + ARM
    observations = (*OBSERVATIONS, grippers_seen("the arm's tip"))
    ranges: ClassVar = {**HookingTask.ranges, **FromFloorTask.ranges}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "hook", "rumpled")
    arguments: ClassVar = {**HookingTask.arguments, **FromFloorTask.arguments}
    places = np.array(sheet_cut.corners[2:])

    def rumpled(self) -> NDArray:
        return rumpled_sheets(21, 21, self.physics.side)[:, self.sheet_cut.kept]

    def leaving(self, hands: NDArray) -> NDArray:
        aside = np.sign(self.physics.mesh.rest_positions[self.places, 0])[:, None] * (0.1, 0.0, 0.0)
        return np.broadcast_to(aside, hands.shape)


class ClothHookEnv(ClothEnv):
    """Hang a sheet, held by two corners, on a hook by its hole and release it.

    ## Description
    A square sheet of side L = 0.6 m has a centered hole, 0.25 L wide and 0.125 L high, 0.125 L below its upper edge: a grid of
    17 x 17 particles without 4 x 2 of its cells, 286 particles.  It hangs from its upper corners, 0.3 to 0.5 L in front of the
    tip of a hook: an arm of length 0.3 L and radius 0.02 L, which rises by 30 degrees from a post, radius 0.03 L.  The arm's root
    is 1.15 to 1.35 L above the floor, and the post ends 0.3 L higher.  The agent moves both corners and may release each.  After
    100 steps both are released.  When no corner is held, the sheet settles for five seconds, 150 steps, in which actions are
    ignored; then it is evaluated.  Holding the sheet on the hook until then is as good as releasing it earlier.

    Cloth rests 10 mm from the hook's surface, about the height of the arm's arc over a side of a triangle, so that it does not
    tremble.  The mesh consists of triangles, whose edges are the springs; ``rows`` and ``side`` are fixed.

    $physics

    ## Action Space
    $actions corner

    ## Rewards
    $rewards

    During the episode the potential is the mean of the score (below) and of ``1/(1 + (d/0.4 L)^2)``, with the remaining path length
    d of the middle of the hole's rim: to the arm's root if the arm is in the hole, else to its tip and along the arm.

    ## Evaluation
    The arm is in the hole if its axis goes through it: triangles from the mean of the rim to the rim's edges span the hole, and the
    axis, from root to tip, meets them more often from one side than from the other.  F is the share of the sheet's area lower than
    3 cm.  The score after each step is 1 - F if the arm is in the hole, else 0.  A sheet that lies over the arm or the post
    therefore scores 0.

    ``info["normalized_performance"]`` is this score over ``1 + (v / 0.1 m/s)^2``, with the rms speed v, after the five seconds.
    ``info["is_success"]``: the arm is in the hole, F <= 0.02 and v under 0.02 m/s.  ``info`` also has ``threaded``, whether the arm
    is in the hole, ``lying`` (F), ``rms_speed`` [m/s], which are 0 until then, and in each step ``best``, the episode's best score,
    ``first_success``, the first step after which the sheet hangs in this way and is not held, or -1, ``success_held``, whether it
    has hung ever since, ``strain_max``, ``strain_before_limiting``, ``settling``, ``failure`` and the ``reward/...`` terms.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.15 L to the side, turned by up to 0.3 rad
    relative to the hook, with a ripple of a millimeter.  The post is within 0.15 L of the origin in x and y; the hook is turned by
    up to 45 degrees.
    """

    task_class = HookTask


class ClothHookHardEnv(ClothEnv):
    """Pick up a flat or rumpled silk sheet from the floor, hang it on a hook by its small hole, and release it.

    ## Description
    The hook and the evaluation are the same as in ``ClothHook-v0``, with a larger sheet, L = 0.8 m (21 x 21 particles except one),
    of silk (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), whose hole is a square of 0.1 L, 0.1 L below the upper
    edge.  The arm passes through it with a clearance of 14 mm on either side.  The sheet lies on the floor, flat or rumpled, and
    two grippers hover above the corners of its upper edge.  After 160 steps they open, and the sheet settles for five seconds, 150
    steps, in which actions are ignored; then it is evaluated.

    $physics

    ## Rewards
    $rewards

    During the episode the potential is 0.8 times that of ``ClothHook-v0``, plus 0.2 times the mean over both corners of 1 for a
    corner that has been held, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    As in ``ClothHook-v0``, with the same ``info``.

    ## Starting State
    The whole sheet lies in front of the hook, 0.1 to 0.2 L from the arm's tip, turned by up to 0.2 rad relative to it and up to 0.1
    L to the side; in half of the episodes it is one of 64 rumpled sheets (``benchmarks/rumpled_sheets.py``), with the hole cut out.
    The grippers are open, displaced from their corners by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.  The hook is drawn
    as in ``ClothHook-v0``.
    """

    task_class = HookHardTask

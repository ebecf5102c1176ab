"""ClothFoldGoal-v0 and ClothFoldGoal-Hard-v0: one fold, given by goals for the sheet's corners; for HER."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.checks import one_of
from clothgym.envs.episode import FINE, Fields, length
from clothgym.envs.experts import as_actions
from clothgym.envs.fold import EXPERT_DONE, EXPERT_LOW, EXPERT_NEAR, PICKING, FoldingTask, along_arc
from clothgym.envs.framing import DirectedTask
from clothgym.envs.gripper_task import (
    CORNERS,
    LARGE_SILK,
    REACH,
    WAYS,
    ManipulationTask,
    close_or_open,
    observe_grippers,
    observe_ways,
)
from clothgym.envs.measures import SPEED2, distance
from clothgym.envs.observing import POSITION_BOUND, Observation
from clothgym.envs.scoring import ENOUGH_REST, SPEED_SCALE, falloff, follow, taking
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.task import REWARD_MODES

ENOUGH_NEAR = 0.075  # largest distance of a corner from its goal, in sides
LAYER = 0.008  # height of the folded layer over the layer below [m]
LEAST, MOST = 0.5, 1.0  # range of a fold, as a share of the distance to the opposite edge or corner
# the corners in order around the sheet, as places in ``mesh.corners``: each edge joins one to the next
AROUND = (0, 1, 3, 2)
GOALS = ("achieved_goal", "desired_goal")


@inlined
def _measure(own, rules, sheet):
    """Mean and largest distance of the corners from their goals, in sides."""
    total, worst = 0.0, 0.0
    for k in range(CORNERS):
        away = distance(sheet.x[:, rules.corners[k]], own.goal[k]) / rules.side
        total += away
        worst = max(worst, away)
    own.away, own.worst = total / CORNERS, worst
    if own.step == 0:
        own.began = own.away


@inlined
def _near(own, rules, sheet):
    """Share of the initial mean distance that is covered, in [0, 1]."""
    return min(max(1 - own.away / own.began, 0.0), 1.0)


@inlined
def _potential(own, rules, sheet):
    """Progress of grasping the corners that are to be carried, and of the fold."""
    taken, carried = 0.0, 0
    for k in range(own.carried.shape[0]):
        if own.carried[k] >= 0:
            place, carried = rules.corners[own.carried[k]], carried + 1
            taken += taking(sheet.holder[place] >= 0, rules, sheet, place, k)
    return PICKING * taken / carried + (1 - PICKING) * _near(own, rules, sheet)


@inlined
def _evaluate(own, rules, sheet, info):
    """Write the sheet's speed, and whether it is folded to its goals; returns the normalized performance."""
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    info.is_success = own.worst <= ENOUGH_NEAR and info.rms_speed < ENOUGH_REST
    return _near(own, rules, sheet) / falloff(info.rms_speed, SPEED_SCALE)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    """The distances after this step, and whether a success lasts; no reward terms."""
    info.distance, info.distance_max = own.away, own.worst
    reached = failure == FINE and own.worst <= ENOUGH_NEAR
    follow(own, info, _near(own, rules, sheet), reached, running, failure)
    return 0.0


@inlined
def _observe(own, rules, sheet, seen):
    """The grippers and their displacements to the corners, and the positions and goals of the corners."""
    observe_grippers(own, rules, sheet, seen)
    observe_ways(rules, sheet, seen)
    for k in range(CORNERS):
        for c in range(3):
            seen.achieved_goal[k, c] = (sheet.x[c, rules.corners[k]] - own.origin[c]) / rules.side
            seen.desired_goal[k, c] = (own.goal[k, c] - own.origin[c]) / rules.side


def goal_reward(achieved: Any, desired: Any) -> NDArray[np.float32]:
    """0 where every corner is near its goal, else -1, (...).

    achieved, desired: of the corners, in sides, (..., 12).
    """
    way = np.asarray(achieved, np.float32) - np.asarray(desired, np.float32)
    away2 = np.square(way.reshape(*way.shape[:-1], CORNERS, 3)).sum(axis=-1)
    return -(away2.max(axis=-1) > np.float32(ENOUGH_NEAR**2)).astype(np.float32)


class FoldGoalTask(DirectedTask, ManipulationTask):
    """The task of ``ClothFoldGoal-v0``, see ``ClothFoldGoalEnv``.

    Args:
        reward_mode: "goal", or what ``Task`` takes.
    """

    kernels = Kernels(_potential, _evaluate, _observe, measure=_measure, account=_account, fingers=close_or_open)
    acting_steps = 80
    resizes = True
    settling_steps = 40
    obs_modes = ("keypoints", "particles")
    # the goals come last, for ``as_dict``
    observations = (
        *ManipulationTask.observations,
        WAYS,
        Observation(GOALS[0], "positions of the four corners", (CORNERS, 3), "L", POSITION_BOUND, turns=1),
        Observation(GOALS[1], "their goals", (CORNERS, 3), "L", POSITION_BOUND, turns=1),
    )
    goals = GOALS
    direction = "the edge of the carried corners, or from a single one to the next"
    points_relative_to = "the initial center of the sheet"
    evaluation = (("rms_speed", float),)
    accounts: ClassVar[Fields] = (("distance", float), ("distance_max", float), *ManipulationTask.accounts)
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {**ManipulationTask.ranges, "carried": (-1, CORNERS - 1)}
    arguments: ClassVar = {
        **ManipulationTask.arguments,
        **DirectedTask.arguments,
        "reward_mode": '-1, and 0 where every corner is near its goal; or ``"delta"`` or ``"sparse"``',
    }
    away: ClassVar[float] = 0.15  # largest distance of the sheet's center from the origin along x and y, in sides
    turned: ClassVar[float] = np.pi / 4  # largest yaw of the sheet [rad]
    single: ClassVar[float] = 0.0  # share of the episodes with only one carried corner, which tends to slide back

    def __init__(self, num_envs: int, reward_mode: str = "goal", **kwargs: Any) -> None:
        one_of("reward_mode", reward_mode, "goal", *REWARD_MODES)
        super().__init__(num_envs, reward_mode="sparse" if reward_mode == "goal" else reward_mode, **kwargs)
        self.reward_mode = reward_mode

    def remembers(self) -> Fields:
        # goals of the corners [m], the corner of each gripper, or -1, and the width of its arc [m]; mean and largest distance of
        # the corners from their goals, and the initial mean distance, in sides
        own: Fields = [("goal", float, (CORNERS, 3)), ("carried", np.int64, 2), ("width", float)]
        return [*super().remembers(), *own, ("away", float), ("worst", float), ("began", float)]

    def constants(self) -> dict[str, Any]:
        return {"corners": np.array(self.physics.mesh.corners)}

    def _around(self) -> NDArray[np.int64]:
        """The corners in order around the sheet, from the one of the first gripper on, (num_envs, 4), as places in ``AROUND``."""
        around = np.array(AROUND)
        first = np.argmax(around == self.episode["carried"][:, :1], axis=1)
        return (first[:, None] + np.arange(CORNERS)) % CORNERS

    def heading(self) -> NDArray[np.float64]:
        # the edge across from it stays where it is
        rows, (*_, beyond, before) = np.arange(self.num_envs), np.array(AROUND)[self._around()].T
        edge = self.episode["goal"][rows, beyond] - self.episode["goal"][rows, before]
        return edge[:, :2] / np.maximum(length(edge), 1e-9)[:, None]

    def order(self) -> NDArray[np.int64]:
        return self._orders[self._around()[:, 0]]

    @cached_property
    def _orders(self) -> NDArray[np.int64]:
        """``order`` for each place in ``AROUND`` of the first gripper's corner, (4, numbers).

        A quarter turn of the sheet takes its points to one another.
        """
        from scipy.spatial import cKDTree  # imported here: it takes longer than all of the task

        rest, slices = self.physics.mesh.rest_positions[:, :2], self.observation_slices
        flat = (rest - rest.mean(axis=0)) @ (1, 1j)
        points, corners = flat[self.particles], flat[list(self.physics.mesh.corners)]
        orders = np.tile(np.arange(self.observation.shape[1]), (CORNERS, 1))
        for quarters, order in enumerate(orders):
            for name, among, groups in (
                *((name, points, 1) for name in list(slices)[:2]), (WAYS.name, corners, 2), *((name, corners, 1) for name in GOALS),
            ):  # fmt: skip
                turned = 1j**quarters * among
                taken = cKDTree(np.stack([among.real, among.imag], axis=1)).query(np.stack([turned.real, turned.imag], axis=1))[1]
                numbers = np.arange(slices[name].start, slices[name].stop).reshape(groups, len(among), 3)
                order[slices[name]] = numbers[:, taken].ravel()
        return orders

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        mesh, side, own, size = self.physics.mesh, self.physics.side, self.episode[env], self.sizes()[env]
        x, center, _ = self.lie_flat(env, rng, self.away, self.turned)
        own["origin"] = *center, 0
        # the fold: an edge or a corner, its index, and its range
        corners, edge, first = x[list(mesh.corners)], rng.uniform() >= self.single, int(rng.integers(4))
        share = rng.uniform(LEAST, MOST)
        a, b, beyond, before = (AROUND[(first + k) % 4] for k in range(4))
        own["goal"] = corners
        if edge:
            # both move along the adjacent edges
            own["carried"], own["width"] = (a, b), share * size * side
            own["goal"][[a, b]] += share * (corners[[before, beyond]] - corners[[a, b]]) + (0, 0, LAYER)
        else:
            own["carried"], own["width"] = (a, -1), share * np.sqrt(2) * size * side
            own["goal"][a] += share * (corners[beyond] - corners[a]) + (0, 0, LAYER)
        # each gripper above its corner
        self.hover(env, rng, corners[[a, b]])
        return self.uneven(x, rng)

    def advance(self, actions: Any) -> None:
        running = ~self.episode["over"]
        super().advance(actions)
        if self.reward_mode == "goal":
            achieved, desired = (self.observation[:, self.observation_slices[name]] for name in GOALS)
            self.terms[...] = np.zeros((), self.terms.dtype)
            self.terms["progress"] = np.where(running, goal_reward(achieved, desired), 0)
            # without this cost, tearing the sheet would maximize the return
            failed, left = running & (self.outcome["failure"] != FINE), self.most_steps() - self.steps_taken()
            self.terms["failure"] = np.where(failed, -np.maximum(left, 0), 0)
            self.outcome["reward"] = np.where(failed, self.terms["progress"] + self.terms["failure"], self.terms["progress"])

    def expert_actions(self) -> NDArray:
        """Move each carried corner along an arc to its goal, and then leave upward.

        The expert has no memory: a corner that is near its goal and is not held is done, and so are corners that were near and have
        been released.
        """
        grippers, side, envs = self.simulation.grippers, self.physics.side, np.arange(self.num_envs)[:, None]
        tips, carried = grippers.positions.astype(np.float64), self.episode["carried"]
        place = np.array(self.physics.mesh.corners)[np.maximum(carried, 0)]
        x, goal = self.simulation.positions[envs, place].astype(np.float64), self.episode["goal"][envs, np.maximum(carried, 0)]
        used, held = carried >= 0, grippers.holder[envs, place] >= 0
        met = length(x - goal) < ENOUGH_NEAR * side
        step, left = along_arc(goal - tips, tips[..., 2], self.episode["width"][:, None], EXPERT_LOW[0])
        # grippers that hold their corner wait for the others, at the start and at the end
        all_held = np.logical_and.reduce(held | ~used, axis=1, keepdims=True)
        there = (left < EXPERT_NEAR * side) & (tips[..., 2] < EXPERT_LOW[0] + 0.02)
        all_there = np.logical_and.reduce(there | ~used, axis=1, keepdims=True)
        to_place = x - tips
        going = np.where((held & all_held)[..., None], step, np.where(held[..., None], 0.0, to_place / 2))
        brought = (self.episode["best"] > EXPERT_DONE) & ~np.logical_or.reduce(grippers.holder >= 0, axis=1)
        away = ~used | (met & ~held) | brought[:, None]
        move = np.where(away[..., None], (0.0, 0.0, 0.1), going)
        closed = used & ((((length(to_place) < REACH / 2) & ~away) | held) & ~all_there)
        return as_actions(self, move, np.where(closed, -1.0, 1.0))

    def camera(self) -> Any:
        return FoldingTask.camera(self)  # type: ignore[arg-type]


class FoldGoalHardTask(FoldGoalTask):
    """The task of ``ClothFoldGoal-Hard-v0``, see ``ClothFoldGoalHardEnv``."""

    physics = LARGE_SILK
    acting_steps = 100
    settling_steps = 50
    away = 0.25
    turned = np.pi
    single = 0.5


# --- the environments -----------------------------------------------------------------------------------------------------


class GoalReward:
    """The interface for hindsight experience replay."""

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any = None) -> NDArray[np.float32]:
        """0 where every corner is near its goal, else -1, (...), and less for a failure, for any goal.

        achieved_goal, desired_goal: (..., 12), for instance a batch of relabeled goals.
        info: of the step; its ``reward/failure`` is added.  For many steps a sequence of dictionaries, as ``HerReplayBuffer``
        stores
            them with ``copy_info_dict=True``.
        """
        if info is None or isinstance(info, Mapping):
            failure = (info or {}).get("reward/failure", 0.0)
        else:
            failure = [one.get("reward/failure", 0.0) for one in info]
        return goal_reward(achieved_goal, desired_goal) + np.asarray(failure, np.float32)


class ClothFoldGoalEnv(GoalReward, ClothEnv):
    """Bring the corners of a sheet on the floor to the goals of a random fold, with goal observations for HER.

    ## Description
    The sheet and both grippers are the same as in ``ClothFold-v0``.  Each episode draws one fold, and defines it by goals for the
    four corners: the corners of one edge are carried over the sheet, at least half the way to the opposite edge, and the others
    stay in place.  When the time is up the fingers open, and the sheet settles in steps whose actions are ignored.

    Observations and ``compute_reward`` follow Gymnasium-Robotics' goal environments, so that hindsight experience replay
    can relabel goals: SB3's ``HerReplayBuffer`` takes the single environment, and a
    batch from ``clothgym.adapters.sb3.make_sb3_vec_env``.

    $physics

    ## Observation Space
    ``Dict`` of ``observation``, ``achieved_goal`` and ``desired_goal``: ``observation`` has the numbers of this table without the
    last two rows, which are the goals.

    $observations

    ## Rewards
    ``reward_mode="goal"``: 0 after a step in which each corner is within 0.075 L of its goal, in the air or not, else -1: the value
    of ``compute_reward(achieved_goal, desired_goal, info)``, for one goal, (12,), or for many, (..., 12).  A failure also costs 1
    for each remaining step, so that it is never better than continuing.  ``HerReplayBuffer`` includes this cost with
    ``copy_info_dict=True``.
    $rewards

    During the episode the potential is 0.7 times ``1 - d/d0``, see below, plus 0.3 times the mean over the corners that are to be
    carried of 1 for a held corner, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    ``info["distance"]`` is the mean distance d of the corners from their goals, in sides, and ``distance_max`` the largest, after
    every step; at the end there is also ``rms_speed`` in m/s.  Only the corners count: ``ClothFold-v0`` evaluates the flatness of
    the rest.

    Success: ``distance_max`` at most 0.075 and ``rms_speed`` below 0.02 m/s, at the end, when the grippers are open.
    ``info["best"]`` is the episode's best ``1 - d/d0``, ``first_success`` the first step with every corner near, or -1, and
    ``success_held`` whether they have been near ever since.

    ``info["normalized_performance"]`` is ``(1 - d/d0) / (1 + (rms_speed/0.1)^2)``, with d0 of the start: 0 for no action, 1 for
    the ideal.

    ## Starting State
    The sheet's center is up to 0.15 L from the origin along x and y, and it is turned by up to 45 degrees.  One of the four edges
    is carried by 0.5 to 1 of the distance across, uniformly drawn.  The grippers are open, displaced from its corners by up to 0.1
    L along x and y and by 0.2 to 0.35 L upward.
    """

    task_class = FoldGoalTask


class ClothFoldGoalHardEnv(GoalReward, ClothEnv):
    """Bring the corners of a large silk sheet to the goals of a random fold, with goal observations for HER.

    ## Description
    This task differs from ``ClothFoldGoal-v0`` in the sheet and its start, which are those of ``ClothFold-Hard-v0``: L = 0.8 m
    (21 x 21 particles) of silk, its center up to 0.25 L from the origin along x and y, turned by any angle.  In half of the
    episodes only one corner is carried, at least half the way to the opposite one, and the other gripper, which starts above the
    next corner, has no task.  The time is 100 steps, and 50 of settling.

    $physics

    ## Observation Space
    ``Dict`` of ``observation``, ``achieved_goal`` and ``desired_goal``: ``observation`` has the numbers of this table without the
    last two rows, which are the goals.

    $observations

    ## Rewards
    As in ``ClothFoldGoal-v0``.

    ## Evaluation
    As in ``ClothFoldGoal-v0``, with the same ``info``.
    """

    task_class = FoldGoalHardTask

"""ClothFling-v0 and ClothFling-Hard-v0: swing a crumpled sheet, held by two grippers, and lay it flat in three throws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.attachments import Gripper
from clothgym.envs.episode import Fields, length
from clothgym.envs.flatten import (
    SpreadingTask,
    evaluate_spread,
    improvement,
    measure_coverage,
    observe_spread,
    spread_potential,
)
from clothgym.envs.fling_expert import SETS_OUT, THROWN, fling_actions
from clothgym.envs.gripper_task import PHYSICS, REACH, GripperTask, close_or_open
from clothgym.envs.observing import Observation, View
from clothgym.envs.physics import chosen_fabric
from clothgym.envs.pick_place import LOWEST
from clothgym.envs.rumpled import CRUMPLED, CRUMPLED_LARGE, Bank, rumpled_sheets
from clothgym.envs.scoring import follow
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.taking import CLEAR, EDGES, NEXT, corner_neighbors, observe_next, places_to_take
from clothgym.envs.throws import NUMBERS, Throw, throw_of
from clothgym.mesh import grid

SPEED = 2.0  # of the grippers [m/s]
THROWS = 3
CLOSING = 4  # steps in which the fingers close on the corners at the start of an episode
PERIODS = (12, 36, 108)  # of the observed waves [steps]
NO_THROW = -1.0  # coverage after a throw that has not been made
APART = 0.15  # least distance of the tips as an episode begins, in sides
NEARER = 0.75  # share of the distance at which tips take a corner otherwise: a sheet may stir as it is taken
# the box in which the tips move, from the origin, in sides: half along x, half along y, in which the sheet is thrown, and up
BOX = (0.9, 0.3, 1.25)


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _measure_throws(own, rules, sheet):
    """Coverage; the number of throws, and the coverage after each; and the grippers that may not close."""
    measure_coverage(own, rules, sheet)
    count = sheet.holds.shape[0]
    if own.step == 0:
        own.throws, own.throwing = 0, 0
        for i in range(THROWS):
            own.after[i] = NO_THROW
        for k in range(count):
            own.took[k], own.barred[k] = 0, 0
            for c in range(3):
                own.tips[k, c] = sheet.attachments[k, c]
    if own.over:
        return
    # a throw begins when the first gripper grasps the sheet, and ends when the sheet is released
    holding = 0
    for k in range(count):
        if sheet.holds[k] > 0:
            own.took[k], holding = 1, 1
    if own.throwing and not holding:
        own.throws += 1
        for k in range(count):
            own.took[k] = 0
    own.throwing = holding
    if not holding and own.throws > 0:
        own.after[own.throws - 1] = own.coverage
    # a gripper grasps once in a throw
    for k in range(count):
        own.barred[k] = own.throws >= THROWS or (own.took[k] == 1 and sheet.holds[k] == 0)


@inlined
def _tell(own, info):
    """Throws, and the coverage after each."""
    info.throws = own.throws
    info.coverage_after_1, info.coverage_after_2, info.coverage_after_3 = own.after[0], own.after[1], own.after[2]


@inlined
def _evaluate_fling(own, rules, sheet, info):
    """The evaluation of a spread sheet; the coverage after the last throw is the present one."""
    score = evaluate_spread(own, rules, sheet, info)
    if own.throws > 0:
        own.after[own.throws - 1] = info.coverage
    _tell(own, info)
    return score


@inlined
def _account_fling(own, rules, sheet, info, terms, running, failure):
    """Coverage now, at the start and after each throw, and the record of successes; only a released sheet counts."""
    info.coverage, info.coverage_start = own.coverage, own.coverage_start
    _tell(own, info)
    free = own.throws > 0 and own.throwing == 0
    score = improvement(own.coverage, own.coverage_start) if free else 0.0
    follow(own, info, score, free and own.coverage >= rules.enough, running, failure)
    return 0.0


@inlined
def _observe_fling(own, rules, sheet, seen):
    """Grippers, time, coverage, the remaining throws, the next grasp points; and waves that resolve the steps of a throw."""
    observe_spread(own, rules, sheet, seen)
    seen.next[:] = 0
    if own.throws < THROWS:
        observe_next(own, rules, sheet, seen, True)
    seen.throws_left = 1 - own.throws / THROWS
    for i in range(len(PERIODS)):
        period = PERIODS[i]
        for quarter in range(2):
            seen.clock[i, quarter] = 4 * abs((own.step + quarter * period // 4) % period / period - 0.5) - 1


class Start(NamedTuple):
    """Index of a sheet in ``rumpled_sheets``, and the tips that hold both corners of an edge of it [m], (2, 3)."""

    sheet: int
    tips: NDArray


@cache
def held_sheets(rows: int, columns: int, side: float, bank: Bank) -> tuple[NDArray, list[Start]]:
    """Crumpled sheets [m], (sheets, particles, 3), and their edges whose corners grippers can grasp without other cloth.

    If there are no such edges, those with the least other cloth.
    """
    sheets, mesh = rumpled_sheets(rows, columns, side, bank), grid(rows, columns, side, side)
    near, at = corner_neighbors(mesh) > 0, sheets[:, list(mesh.corners)]
    takes = at + NEARER * (places_to_take(sheets, mesh)[0] - at)
    takes[..., 2] = np.maximum(takes[..., 2], LOWEST)
    # number of other particles in each grasp, (sheets, 4)
    others = ((length(takes[:, :, None] - sheets[:, None]) < CLEAR) & ~near).sum(axis=2)
    # and by edge, and the horizontal distance of the tips
    tips = takes[:, EDGES]
    close = np.linalg.norm((tips[:, :, 1] - tips[:, :, 0])[..., :2], axis=2) < APART * side
    taken = others[:, EDGES].sum(axis=2) + 1000 * close
    return sheets, [Start(sheet, tips[sheet, edge]) for sheet, edge in np.argwhere(taken == taken.min()).tolist()]


class FlingTask(SpreadingTask):
    """The task of ``ClothFling-v0``, see ``ClothFlingEnv``."""

    physics = replace(PHYSICS, attachment_speed=SPEED, grippers=(Gripper(speed=2 * SPEED, reach=REACH),) * 2)
    kernels = Kernels(
        spread_potential, _evaluate_fling, _observe_fling, measure=_measure_throws, account=_account_fling, fingers=close_or_open,
    )  # fmt: skip
    seen_from = View((1.25, -0.9, 0.85), (0.0, 0.06, 0.31), 38.0, scales_from=0.6)
    acting_steps = 300
    # the expert's throw, and the steps at which it begins, see ``fling_expert``
    starts: ClassVar[tuple[int, ...]] = (95, 200, 266)
    throw: ClassVar[Throw] = Throw(
        (10.7, 20.0, 21.8, 29.2, 33.7),
        (0.05, -0.29, 0.29, 0.254, -0.108, -0.17),
        (1.2, 1.212, 1.064, 1.24, 0.515, 0.02),
    )
    settling_steps = 40
    enough = 0.9
    bank: ClassVar[Bank] = CRUMPLED
    turned: ClassVar[float] = 0.3  # largest angle between the line of the held corners and the x axis [rad]
    accounts: ClassVar[Fields] = (
        *SpreadingTask.accounts,
        ("throws", np.int64),
        *[(f"coverage_after_{i + 1}", float) for i in range(THROWS)],
    )
    observations = (
        *SpreadingTask.observations,
        Observation("throws_left", "share of remaining throws"),
        NEXT,
        Observation("clock", f"triangle waves of {PERIODS} steps, each also a quarter period earlier", (len(PERIODS), 2)),
    )
    ranges: ClassVar = {
        **SpreadingTask.ranges, "throws": (0, THROWS), "throwing": (0, 1), "after": (NO_THROW, 1.0), "took": (0, 1),
        "barred": (0, 1),
    }  # fmt: skip
    action_modes: ClassVar[tuple[str, ...]] = ("velocity", "throw")
    arguments: ClassVar = {
        **GripperTask.arguments,
        "action_mode": f'"velocity", or "throw": an action is a throw, of {THROWN} control steps and {NUMBERS} numbers in [-1, 1]; '
        "see the description",
    }

    def __init__(self, num_envs: int, action_mode: str = "velocity", **kwargs: Any) -> None:
        super().__init__(num_envs, action_mode=action_mode, **kwargs)
        if action_mode == "throw":
            self.move_by("throw", THROWN, NUMBERS)
        # the sheets of this resolution, before the first reset needs them
        held_sheets(*self.physics.mesh.grid_shape, self.physics.side, self.bank)

    def arena(self) -> tuple[NDArray, NDArray]:
        half = self.physics.side * np.array(BOX)
        return half * (-1, -1, 0) + (0, 0, 0.01), half

    def remembers(self) -> Fields:
        grippers = len(self.physics.grippers)
        return [
            *super().remembers(), ("throws", np.int64), ("throwing", np.uint8), ("after", float, THROWS),
            ("took", np.uint8, grippers), ("barred", np.uint8, grippers), ("tips", float, (grippers, 3)),
        ]  # fmt: skip

    def check_episode(self, env: int, own: Any) -> None:
        super().check_episode(env, own)
        if not np.array_equal(own["after"] > NO_THROW, np.arange(THROWS) < own["throws"]):
            raise ValueError(
                f"the state's episode {env} has {int(own['throws'])} throws and coverages {own['after'].tolist()} after them: give "
                "what get_state() gave"
            )

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        side, (low, high) = self.physics.side, self.arena()
        sheets, starts = held_sheets(*self.physics.mesh.grid_shape, side, self.bank)
        start = starts[int(rng.integers(len(starts)))]
        x, tips = sheets[start.sheet].copy(), start.tips.copy()
        # mirrored; turned so that the corners are on either side; and moved so that both are within reach
        if rng.uniform() < 0.5:
            x[:, 0] *= -1
            tips[:, 0] *= -1
        if rng.uniform() < 0.5:
            tips = tips[::-1]
        yaw = rng.uniform(-self.turned, self.turned)
        along = tips[1, :2] - tips[0, :2]
        c, s = along / np.sqrt(along[0] ** 2 + along[1] ** 2)
        turn = np.array([[c, -s], [s, c]]) @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        x[:, :2], tips[:, :2] = x[:, :2] @ turn, tips[:, :2] @ turn
        away = side * rng.uniform(-0.1, 0.1, 2) - tips[:, :2].mean(axis=0)
        away += np.maximum(low[:2] - (tips[:, :2] + away).min(axis=0), 0) - np.maximum(
            (tips[:, :2] + away).max(axis=0) - high[:2], 0
        )
        x[:, :2] += away
        tips[:, :2] += away
        self.gripper_starts[env] = tips
        self.episode["origin"][env] = 0.0
        return self.uneven(x, rng)

    def before_step(self, actions: NDArray) -> None:
        """Let grippers stay and close on the corners at the start, and keep barred fingers open."""
        block, lane = self._place
        wanted, targets = self.simulation.orders.openings, self.simulation.orders.targets
        first = np.flatnonzero(self.episode["step"] <= CLOSING)
        if first.size:
            targets[block[first], :, :, lane[first]] = self.episode["targets"][first] = self.episode["tips"][first]
        ordered = wanted[block, :, lane]
        ordered[self.episode["step"] <= CLOSING] = 0
        ordered[self.episode["barred"] == 1] = 1
        wanted[block, :, lane] = ordered

    def motion(self, actions: NDArray) -> Callable[[int], NDArray]:
        throws = [throw_of(action, BOX[1]) for action in actions]
        starts = [(step + SETS_OUT,) for step in self.episode["step"].tolist()]
        return lambda step: fling_actions(self, throws, starts)

    def expert_actions(self) -> NDArray:
        return fling_actions(self, [self.throw] * self.num_envs, [self.starts] * self.num_envs)

    def expert_picks(self) -> NDArray:
        return np.tile(self.throw.action(BOX[1]), (self.num_envs, 1))


class FlingHardTask(FlingTask):
    """The task of ``ClothFling-Hard-v0``, see ``ClothFlingHardEnv``."""

    physics = replace(
        FlingTask.physics, mesh=grid(21, 21, 0.8, 0.8), material=chosen_fabric("wool_tropical", PHYSICS.material), substeps="auto"
    )
    acting_steps = 320
    action_modes = ("velocity",)
    arguments: ClassVar = {**GripperTask.arguments, "action_mode": 'only "velocity"'}
    starts = (84, 200, 275)
    throw = Throw(
        (11.9, 22.8, 25.6, 35.7, 41.7),
        (0.05, -0.29, 0.29, 0.278, -0.13, -0.2),
        (1.2, 1.231, 1.01, 1.24, 0.514, 0.02),
    )
    bank = CRUMPLED_LARGE
    turned = 0.6


class ClothFlingEnv(ClothEnv):
    """Swing a crumpled sheet, held by two corners, and lay it flat on a table within three throws.

    ## Description
    A square sheet, L = 0.6 m, lies crumpled on a table, the plane z = 0.  Two grippers are at two neighboring corners: in the first
    four steps they stay there and close, whatever the action, and then hold these corners.  They work as in
    ``ClothDrapeGripper-v0``: when their fingers have closed, they hold the particles within 3 cm of their tips, including other
    layers.

    The reach is limited: the tips stay in a box about the origin, 0.3 L to either side along y, 0.9 L along x, and 1.25 L high.
    Along y, the direction of the throw, this reach is too short to lay a sheet down slowly: at 0.5 m/s, grippers reach a coverage
    of about 0.7.  A thrown sheet flies on, and the air supports it.

    With ``action_mode="throw"`` an action is a throw, as in FlingBot (Ha and Song 2021), of 100 control steps; an episode has three
    of these, and one more in which the sheet settles, with ``settling="steps"``.  Grippers that hold nothing take what ``next``
    shows, early in the action, if the sheet rests and covers less than 0.905.  They lift it and stretch it.  After 60 of these
    steps they follow a way through five places, both at the same height and the same place along y, and then let go; where the
    way takes more than 40 steps, they still hold the sheet at the end.  The numbers of an action are five times, from 1 to 13
    control steps, from one place to the next; then, from -0.3 to 0.3 L, six places along y, the first of them where the sheet is
    stretched; and their six heights, from 0.02 to 1.25 L.

    A throw begins when a gripper grasps the sheet, and ends when the sheet is released.  Each gripper grasps once in a throw: after
    its release it stays open until the throw has ended.  After the third throw the fingers do not close any more.  After 300 steps
    they open, and the sheet settles for 40 steps, in which actions are ignored; then it is evaluated.

    $physics

    ## Observation Space
    $observations

    ``next`` is a choice that the environment makes.  Free grippers grasp an edge that spans 0.1 m along x or more, the first
    gripper the end with the smaller x.  It is the nearest such edge, where each particle of other cloth in the grasp adds a meter
    to the distance.  If no such edge is within reach, they grasp the sides of one, where these come within reach; n is then 1000.
    While one gripper holds a corner, the other grasps a neighboring corner; this is given even for a gripper that may not close any
    more.  ``next`` is 0 for a gripper without a grasp point; for both after three throws; and while a released sheet covers 0.905
    or more.

    ## Rewards
    $rewards

    During the episode the potential is 0.9 times the coverage, plus 0.1 times the mean over both grippers of 1 for a gripper that
    holds cloth, else ``1/2 / (1 + (d/0.15 L)^2)`` with the distance d of its tip from the nearest particle.

    ## Evaluation
    The coverage c is the area of the union of the sheet's triangles, projected to the table, over that of the flat sheet, at most
    1, as in ``ClothFlatten-v0``.  The normalized performance is the normalized improvement ``(c - c0) / (1 - c0)`` over the start's
    c0, in [0, 1]; 1 if c is 0.99 or more, else 0 if c0 is.  In a success, the coverage is 0.9 or more, and the sheet is released
    and at rest (less than 0.02 m/s rms).  The threshold is lower than the 0.95 of ``ClothFlatten-v0``, as a throw cannot be
    corrected, and higher than the 0.8 of FlingBot's report.

    ``info`` has ``coverage`` and ``coverage_start`` in each step; ``throws``, the number of finished throws; ``coverage_after_1``,
    ``coverage_after_2`` and ``coverage_after_3``, the last coverage after each throw before the next grasp, -1 for
    a throw that has not been made; ``best``, the best normalized improvement so far of a released sheet after a throw;
    ``first_success``, the first step with enough coverage of a released sheet, or -1; and ``success_held``, whether this has lasted
    ever since.  At the evaluation it has ``is_success``, ``normalized_performance``, ``rms_speed`` [m/s] and
    ``softgym_coverage``, see ``ClothFlatten-v0``.

    ## Starting State
    One of the crumpled sheets of ``ClothFlatten-v0``, with an edge whose corners the grippers can grasp without other
    cloth, at least 0.15 L apart: 78 such edges, of 53 sheets.  It is mirrored or not, and turned so that this line is
    within 0.3 rad of the x axis, one gripper on either side; its middle is up to 0.1 L from the origin along x and y, or as near to
    that as both corners are within reach.  Held-out seeds draw from the same sheets, in new combinations.
    """

    task_class = FlingTask


class ClothFlingHardEnv(ClothEnv):
    """Swing a larger crumpled sheet, of a thinner fabric, and lay it flat on a table within three throws.

    ## Description
    This task differs from ``ClothFling-v0`` in the sheet, L = 0.8 m with 21 x 21 particles, its fabric, the tropical wool of
    ``Material.preset("wool_tropical")``, of 163 g/m^2 and half the rigidity, its start, and its time, 320 steps.  The grippers have
    the same speed, 2 m/s, which is less relative to the larger sheet, and the box has the same size in sides.

    $physics

    ## Observation Space
    $observations

    ``next`` is chosen as in ``ClothFling-v0``.

    ## Rewards
    As in ``ClothFling-v0``.

    ## Evaluation
    As in ``ClothFling-v0``, with the same ``info``.

    ## Starting State
    As in ``ClothFling-v0``, but one of the crumpled sheets of ``ClothFlatten-Hard-v0``, dropped three times: 55 edges of 41 sheets;
    and the line of both corners is within 0.6 rad of the x axis.
    """

    task_class = FlingHardTask

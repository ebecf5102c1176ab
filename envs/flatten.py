"""ClothFlatten-v0 and ClothFlatten-Hard-v0: spread a crumpled sheet on the floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.envs import flatten_expert
from clothgym.envs.coverage import CELL, FINE_CELL, covered_area, softgym_area
from clothgym.envs.episode import Fields
from clothgym.envs.gripper_task import CORNERS, PHYSICS, WAYS, ManipulationTask, close_or_open, observe_grippers, observe_ways
from clothgym.envs.measures import FINITE, SPEED2, STRETCH2, squared_distance
from clothgym.envs.observing import POSITION_BOUND, VELOCITY_BOUND, Observation, View
from clothgym.envs.physics import chosen_fabric
from clothgym.envs.rumpled import CRUMPLED, CRUMPLED_LARGE, Bank, rumpled_sheets
from clothgym.envs.scoring import ENOUGH_REST, falloff, follow, holds_nothing
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.taking import EDGES, LIFTED, NEXT, OPPOSITE, neighbors_of, observe_next
from clothgym.envs.targets import ON_FLOOR
from clothgym.envs.throws import NUMBERS, Hands, throw_of
from clothgym.mesh import grid

HOLDING = 0.1  # share of the potential for holding the sheet
HOLD_SCALE = 0.15  # in sides: length scale of that share as a gripper approaches the sheet
FLAT_ALREADY = 0.99  # coverage from which on a sheet counts as flat
TORN_STRETCH2 = 4.0  # squared stretch at which a sheet is torn
FARTHEST = 0.7  # place of a throw along ``out``, from the origin, in sides
SHORTEST = 1e-9  # least distance of tips in divisions [m]


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def improvement(coverage, start):
    """Normalized improvement: share of the initially uncovered area that is covered now, in [0, 1]."""
    if coverage >= FLAT_ALREADY:
        return 1.0
    return 0.0 if start >= FLAT_ALREADY else min(max((coverage - start) / (1 - start), 0.0), 1.0)


@inlined
def measure_raised(own, sheet):
    """Largest height of each gripper since its grasp."""
    for k in range(sheet.holds.shape[0]):
        own.raised[k] = max(own.raised[k], sheet.attachments[k, 2]) if sheet.holds[k] > 0 else 0.0


@inlined
def is_measured(own, sheet):
    """Whether there is a coverage to measure: a sheet that has failed keeps the last one."""
    return sheet.summary[FINITE] > 0 and sheet.summary[STRETCH2] <= TORN_STRETCH2 and not own.over


@inlined
def note_coverage(own, rules, area):
    """Store the coverage that an area amounts to; at the start, also as the starting coverage."""
    own.coverage = min(area / rules.flat_area, 1.0)
    if own.step == 0:
        own.coverage_start = own.coverage


@inlined
def measure_coverage(own, rules, sheet):
    """Heights of grippers, and the coverage, on the coarser grid except at the start."""
    measure_raised(own, sheet)
    if is_measured(own, sheet):
        note_coverage(own, rules, covered_area(sheet.unit, sheet.mesh.triangles, FINE_CELL if own.step == 0 else CELL))


@inlined
def spread_potential(own, rules, sheet):
    """Coverage, and for each gripper 1 if it holds cloth, else at most a half as it approaches it."""
    held = 0.0
    for k in range(sheet.holds.shape[0]):
        if sheet.holds[k] > 0:
            held += 1.0
            continue
        nearest = np.inf
        for p in range(sheet.x.shape[1]):
            nearest = min(nearest, squared_distance(sheet.x[:, p], sheet.attachments[k]))
        held += 0.5 / falloff(np.sqrt(nearest), HOLD_SCALE * rules.side)
    return HOLDING * held / sheet.holds.shape[0] + (1 - HOLDING) * own.coverage


@inlined
def evaluate_spread(own, rules, sheet, info):
    """Write the sheet's coverage and speed; returns the normalized improvement."""
    info.coverage = min(covered_area(sheet.unit, sheet.mesh.triangles, FINE_CELL) / rules.flat_area, 1.0)
    info.softgym_coverage = softgym_area(sheet.unit, rules.particle_radius) / rules.softgym_area
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    info.is_success = info.coverage >= rules.enough and info.rms_speed < ENOUGH_REST and holds_nothing(own, rules, sheet)
    return improvement(info.coverage, own.coverage_start)


@inlined
def account_spread(own, rules, sheet, info, terms, running, failure):
    """Coverage now and at the start, and the record of successes; no reward terms."""
    info.coverage, info.coverage_start = own.coverage, own.coverage_start
    score = improvement(own.coverage, own.coverage_start)
    follow(own, info, score, own.coverage >= rules.enough, running, failure)
    return 0.0


@inlined
def observe_spread(own, rules, sheet, seen):
    """Grippers, time, coverage, and the sheet's speed."""
    observe_grippers(own, rules, sheet, seen)
    seen.coverage, seen.speed = own.coverage, np.sqrt(sheet.summary[SPEED2])


@inlined
def _observe_held_edge(rules, sheet, seen):
    """While both grippers hold an edge: the direction of laying down, the far edge's position, and its speed, in those axes."""
    seen.out[:], seen.far[:], seen.swing = 0, 0, 0
    for e in range(len(EDGES)):
        for crossed in range(2):
            first, second = rules.corners[EDGES[e, crossed]], rules.corners[EDGES[e, 1 - crossed]]
            if sheet.holder[first] != 0 or sheet.holder[second] != 1:
                continue
            # unit vectors along the edge, and across it, toward the side on which the sheet lies with its front up
            x, y = sheet.attachments[1, 0] - sheet.attachments[0, 0], sheet.attachments[1, 1] - sheet.attachments[0, 1]
            long = max(np.sqrt(x * x + y * y), SHORTEST)
            x, y, side = x / long, y / long, 1 - 2 * crossed
            seen.out[0], seen.out[1] = -y * side, x * side
            for tip in range(2):
                corner = rules.corners[OPPOSITE[e, tip ^ crossed]]
                dx, dy = sheet.x[0, corner] - sheet.attachments[tip, 0], sheet.x[1, corner] - sheet.attachments[tip, 1]
                seen.far[tip, 0] = (dx * x + dy * y) / rules.side
                seen.far[tip, 1] = (dy * x - dx * y) * side / rules.side
                seen.far[tip, 2] = (sheet.x[2, corner] - sheet.attachments[tip, 2]) / rules.side
                seen.swing += (sheet.v[1, corner] * x - sheet.v[0, corner] * y) * side / 2
            return


@inlined
def _observe(own, rules, sheet, seen):
    """The observations of both spreading tasks; the next grasp points; the largest heights since the grasp; the far edge."""
    observe_spread(own, rules, sheet, seen)
    observe_ways(rules, sheet, seen)
    observe_next(own, rules, sheet, seen, False)
    for tip in range(sheet.holds.shape[0]):
        seen.raised[tip] = own.raised[tip] / rules.side
        for i in range(len(LIFTED)):
            seen.lifted[tip, i] = own.raised[tip] > LIFTED[i] * rules.side
        for k in range(CORNERS):
            seen.corners_held[tip, k] = sheet.holder[rules.corners[k]] == tip
    _observe_held_edge(rules, sheet, seen)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class SpreadingTask(ManipulationTask):
    """Base of the tasks that end with a sheet spread on the floor.

    Attributes:
        enough: coverage of a success.
    """

    enough: ClassVar[float]
    evaluation: ClassVar[Fields] = (("softgym_coverage", float), ("rms_speed", float))
    accounts: ClassVar[Fields] = (*ManipulationTask.accounts, ("coverage", float), ("coverage_start", float))
    observations: ClassVar[tuple[Observation, ...]] = (
        *ManipulationTask.observations,
        Observation("coverage", "covered area over the sheet's area"),
        Observation("speed", "rms speed of the sheet", (), "m/s", VELOCITY_BOUND),
    )
    ranges: ClassVar = {
        **ManipulationTask.ranges, "coverage": (0.0, 1.0), "coverage_start": (0.0, 1.0), "raised": (0.0, 10.0),
    }  # fmt: skip

    def remembers(self) -> Fields:
        grippers = len(self.physics.grippers)
        return [*super().remembers(), ("coverage", float), ("coverage_start", float), ("raised", float, grippers)]

    @property
    def corners(self) -> NDArray:
        """Particles that grippers take: of the flat sheet those at (-x, -y), (+x, -y), (-x, +y), (+x, +y), (4,)."""
        return np.array(self.physics.mesh.corners)

    @property
    def spacing(self) -> float:
        """Largest distance of neighboring particles at rest [m]."""
        return max(self.physics.mesh.spacing)

    def edge_costs(self) -> NDArray[np.float64]:
        """Extra cost of the edge between each pair of corners, in other particles, (4, 4), see ``taking.next_takes``."""
        return np.zeros((CORNERS, CORNERS))

    def flat_areas(self) -> tuple[float, float]:
        """Area that the flat sheet covers, and that by SoftGym's measure [m^2]."""
        width, height = self.physics.mesh.size
        return width * height, width * height

    def constants(self) -> dict[str, Any]:
        mesh = self.physics.mesh
        own = {"particle_radius": self.spacing, "enough": self.enough}
        areas = dict(zip(("flat_area", "softgym_area"), self.flat_areas()))
        neighbors = neighbors_of(mesh, self.corners, self.spacing)
        taken = {
            "corners": self.corners,
            "corner_neighbors": neighbors,
            "columns": (mesh.shape or (0, 0))[1],
            "edge_costs": self.edge_costs(),
        }
        return super().constants() | own | areas | taken


class FlattenTask(SpreadingTask):
    """The task of ``ClothFlatten-v0``, see ``ClothFlattenEnv``."""

    physics = PHYSICS
    kernels = Kernels(
        spread_potential, evaluate_spread, _observe, measure=measure_coverage, account=account_spread, fingers=close_or_open
    )  # fmt: skip
    seen_from = View((0.9, -1.5, 1.35), (0.0, 0.0, 0.14), 36.0, scales_from=0.6)
    acting_steps = 300
    resizes = True
    settling_steps = 40
    picks = 6
    throws: ClassVar[int] = 2  # actions of an episode that throws
    action_modes: ClassVar[tuple[str, ...]] = ("velocity", "pick_place", "throw")
    arguments: ClassVar = {
        **SpreadingTask.arguments,
        "action_mode": f'{SpreadingTask.arguments["action_mode"]}; or "throw": an action is a throw, of {flatten_expert.THROWN} '
        f"control steps and {NUMBERS} numbers in [-1, 1], see ``ClothFlatten-v0``, and an episode has $throws of these",
    }
    enough = 0.95
    bank: ClassVar[Bank] = CRUMPLED
    entangles: ClassVar[bool] = False  # whether the expert lifts one corner first, and pulls carefully
    observations = (
        *SpreadingTask.observations,
        WAYS,
        Observation("corners_held", "for each gripper whether it holds each of the corners", (2, CORNERS)),
        NEXT,
        Observation(
            "out",
            "while both hold the corners of an edge, the horizontal direction across it in which the sheet is laid flat",
            (2,),
        ),
        Observation(
            "far",
            "while both hold an edge, from each tip to the far corner of its side: along the edge, across it, and up",
            (2, 3),
            "L",
            POSITION_BOUND,
        ),
        Observation("swing", "while both hold an edge, speed of the far edge across it", (), "m/s", VELOCITY_BOUND),
        Observation("raised", "largest height of each gripper since its grasp, or 0", (2,), "L", POSITION_BOUND),
        Observation("lifted", f"for each gripper whether that is above {LIFTED[0]} L, and above {LIFTED[1]} L", (2, len(LIFTED))),
    )

    def __init__(self, num_envs: int, action_mode: str = "velocity", **kwargs: Any) -> None:
        if action_mode == "throw":
            self.acting_steps = self.throws * flatten_expert.THROWN  # type: ignore[misc]
        super().__init__(num_envs, action_mode=action_mode, **kwargs)
        if action_mode == "throw":
            self.move_by("throw", flatten_expert.THROWN, NUMBERS)
        self.sheets()  # before the first reset needs them

    def across(self) -> NDArray:
        """Distance at rest from each of ``EDGES`` to the opposite one [m], (4,)."""
        return np.full(len(EDGES), self.physics.side)

    def pose(self) -> NDArray | None:
        """Where the corners should lie [m], (4, 2), or None, if the sheet may lie anywhere."""
        return None

    def sheets(self) -> NDArray:
        """The sheets with which episodes begin [m], (sheets, particles, 3)."""
        return rumpled_sheets(*self.physics.mesh.grid_shape, self.physics.side, self.bank)

    def mirrored(self, x: NDArray) -> NDArray:
        """A sheet's mirror image [m], (particles, 3)."""
        return x * (-1, 1, 1)

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        side = self.physics.side
        sheets = self.sheets()
        size = self.sizes()[env]
        x = sheets[int(rng.integers(len(sheets)))] * size
        if size != 1:  # the lowest particles stay on the floor
            x[:, 2] += ON_FLOOR - x[:, 2].min()
        # mirrored, turned and moved
        x = x if rng.uniform() < 0.5 else self.mirrored(x)
        yaw = rng.uniform(-np.pi, np.pi)
        c, s = np.cos(yaw), np.sin(yaw)
        x[:, :2] = x[:, :2] @ np.array([[c, s], [-s, c]]) + side * rng.uniform(-0.2, 0.2, 2)
        for k, place in enumerate((-0.4, 0.4)):
            self.gripper_starts[env, k] = side * (np.array([place, 0.0, 0.5]) + rng.uniform(-0.1, 0.1, 3))
        self.episode["origin"][env] = 0.0
        return self.uneven(x, rng)

    def expert_actions(self) -> NDArray:
        return flatten_expert.flatten_actions(self)

    def expert_picks(self) -> NDArray:
        return flatten_expert.flatten_picks(self) if self.action_mode == "pick_place" else super().expert_picks()

    def motion(self, actions: NDArray) -> Callable[[int], NDArray]:
        if self.action_mode != "throw":
            return super().motion(actions)
        hands = [Hands(throw_of(action, FARTHEST)) for action in actions]
        return lambda step: flatten_expert.flatten_actions(self, hands)


class FlattenHardTask(FlattenTask):
    """The task of ``ClothFlatten-Hard-v0``, see ``ClothFlattenHardEnv``."""

    physics = replace(
        PHYSICS, mesh=grid(21, 21, 0.8, 0.8), material=chosen_fabric("wool_tropical", PHYSICS.material), substeps="auto"
    )
    acting_steps = 320
    bank = CRUMPLED_LARGE


class ClothFlattenEnv(ClothEnv):
    """Spread a crumpled sheet on the floor with two grippers and release it.

    ## Description
    A square sheet, L = 0.6 m, lies crumpled on the floor.  Two grippers can grasp it, including other layers.  After 300 steps they
    open, and the sheet settles for 40 steps, in which actions are ignored; then it is evaluated.

    With ``action_mode="throw"`` an action is a throw, as in ``ClothFling-v0``, of 150 control steps; an episode has two of these,
    and one more in which the sheet settles, with ``settling="steps"``.  Grippers that hold nothing take what ``next`` shows.  They
    lift a single corner until the other gripper can take its neighbor, lift the edge above 1.17 L, toward the first place, and
    stretch it.  Once it hangs still, or swings outward at less than 0.5 m/s rms, they move to the first place and through the five
    others, both at the same height and the same place along ``out``.  Then they let go, rise to 0.3 m, and wait until the action
    ends.  They move at 0.9 m/s at most, and more slowly while the sheet is strained; the clock of the way stops while they are more
    than 0.1 L from where they should be.  If the action ends before the way does, they keep the edge, and the next action starts a
    new way; what is held at the end of the last action is released.  Nothing is taken in the last 95 control steps, nor at a
    coverage of 0.955 or more.  The numbers of an action are those of ``ClothFling-v0``, but for places along ``out`` from -0.7 to
    0.7 L from the origin.

    $physics

    ## Observation Space
    $observations

    ``next`` is a choice that the environment makes: the nearest edge whose corners can both be grasped without other cloth; if
    there is none, the corner with the least other cloth, for one gripper; and while one gripper holds a corner, a neighboring
    corner for the other.  It is 0 for a gripper without a grasp point, and for both while a released sheet covers 0.955 or more.

    ## Rewards
    $rewards

    During the episode the potential is 0.9 times the coverage, plus 0.1 times the mean over both grippers of 1 for a gripper that
    holds cloth, else ``1/2 / (1 + (d/0.15 L)^2)`` with the distance d of its tip from the nearest particle.

    ## Evaluation
    The coverage c is the area of the union of the sheet's triangles, projected to the floor, over that of the flat sheet, limited
    to one.  It is measured on a fixed grid, with cells of 1 cm after each step, and of 2.5 mm at the start and at the evaluation.
    The normalized performance is the normalized improvement ``(c - c0) / (1 - c0)`` over the start's c0, in [0, 1]; 1 if c is 0.99
    or more, else 0 if c0 is.  In a success, the coverage is 0.95 or more, and the sheet is released and at rest (less than 0.02 m/s
    rms).

    ``info`` has ``coverage`` and ``coverage_start`` in each step; ``best``, the best normalized improvement so far;
    ``first_success``, the first step with enough coverage, or -1; and ``success_held``, whether it has been enough ever since.  At
    the evaluation it has ``is_success``, ``normalized_performance``, ``rms_speed`` [m/s] and ``softgym_coverage``, SoftGym's
    measure: it divides the particles' bounding box into 100 x 100 cells, and the area of the cells within one particle spacing of a
    particle by the flat sheet's area.  This measure depends on the orientation of the sheet, and may exceed 1.

    ## Starting State
    One of 128 crumpled sheets that cover 0.18 to 0.47 of their area (``benchmarks/rumpled_sheets.py``): lifted high at a
    random particle and dropped, twice.  It is turned by any angle, in half of the episodes mirrored, and moved by up to 0.2 L along
    x and y.  Held-out seeds draw from the same sheets, in new combinations.  The grippers are
    open, 0.3 to 0.5 L to the left and right of the origin, 0.4 to 0.6 L above the floor.
    """

    task_class = FlattenTask


class ClothFlattenHardEnv(ClothEnv):
    """Spread a larger crumpled sheet, of a thinner fabric, on the floor with two grippers and release it.

    ## Description
    A square sheet, L = 0.8 m, with 21 x 21 particles, lies crumpled on the floor.  Two grippers can grasp it, including other
    layers.  After 320 steps they open, and the sheet settles for 40 steps, in which actions are ignored; then it is evaluated.

    $physics

    The tropical wool has half the rigidity of the median fabric of ``ClothFlatten-v0``.

    ## Observation Space
    $observations

    ``next`` is chosen as in ``ClothFlatten-v0``.

    ## Rewards
    As in ``ClothFlatten-v0``.

    ## Evaluation
    As in ``ClothFlatten-v0``, with the same ``info``.

    ## Starting State
    One of 96 crumpled sheets that cover 0.12 to 0.42 of their area (``benchmarks/rumpled_sheets.py``): lifted high at a random
    particle and dropped, three times.  It is turned by any angle, in half of the episodes mirrored, and moved by up to 0.2 L along
    x and y.  Held-out seeds draw from the same sheets, in new combinations.  The grippers are open, 0.3 to 0.5 L to the left and
    right of the origin, 0.4 to 0.6 L above the floor.
    """

    task_class = FlattenHardTask

"""ClothStrain-v0: carry a stretchy sheet past a post to a goal, in gusts, without stretching it beyond a threshold."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym import integrators
from clothgym._jit import inlined
from clothgym.checks import LARGEST, not_negative, positive, shown
from clothgym.collisions import Capsule, Collider
from clothgym.envs.episode import FINE, Fields, length
from clothgym.envs.measures import FINITE, MOST_STRAIN, distance, largest_strain, length_of, stretch_quantile
from clothgym.envs.observing import Observation, View
from clothgym.envs.physics import Physics, settled
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.task import Task
from clothgym.envs.vector import ClothVectorEnv
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid
from clothgym.simulation import GRAVITY
from clothgym.wind import Wind

FABRIC = Material.preset("knit", damping_time=1e-3)
WIDE, DEEP = 1 / 6, 1 / 12  # a clip, in sides: 3 x 2 particles of 13 a side

POST_RADIUS, POST_HEIGHT = 0.06, 1.4  # [m]
FRICTION = 0.3
CLEARANCE = 0.35  # from the post's axis to the middle of the sheet at the first waypoint [m]
WAYPOINTS = 3  # next to the post, beyond it, and the goal
PASSED, ARRIVED = 0.1, 0.15  # mean distance of the clips from a waypoint [m]; of the farther clip from the goal [sides]
LOW, HIGH = np.array([-1.1, -1.1, 0.6]), np.array([1.1, 1.1, 1.5])  # arena of the clips [m]
MOST_YAW = 0.2  # of the held edge at the last two waypoints [rad]
TENSIONS = (("tension_left", float), ("tension_right", float))
MOST_PULL = float(np.finfo(float).max)  # [N]: of a sheet that is about to diverge any number
FAR = 10.0  # bound of observed distances, in sides

CAREFUL_SPEED, CAREFUL_ACCELERATION = 0.5, 2.0  # of the expert [m/s], [m/s^2]

WAYPOINT, GOAL = (150, 160, 175), (90, 170, 110)  # colors of the markers


def clips(mesh: ClothMesh) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The anchors, one at each end of the upper edge, its corner first."""
    rows, columns = mesh.grid_shape
    wide, deep = (round(share * (rows - 1)) + 1 for share in (WIDE, DEEP))
    down = range(rows - 1, rows - 1 - deep, -1)
    return (
        tuple(row * columns + column for row in down for column in range(wide)),
        tuple(row * columns + column for row in down for column in range(columns - 1, columns - 1 - wide, -1)),
    )


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _to_places(own, sheet):
    """Distance of each clip from its place at the next waypoint [m]."""
    places = own.places[own.next]
    return distance(places[0], sheet.attachments[0]), distance(places[1], sheet.attachments[1])


@inlined
def _pass_waypoint(own, rules, sheet, move, free):
    """Select the next waypoint when the clips have passed one."""
    left, right = _to_places(own, sheet)
    if own.next < WAYPOINTS - 1 and (left + right) / 2 < PASSED:
        own.next += 1


@inlined
def _measure(own, rules, sheet):
    """The strain's 95th percentile, the sheet's pull at each clip, and the origin of observed positions."""
    # strain and pulls; a sheet that has diverged pulls at nothing
    own.strain_p95 = stretch_quantile(sheet.x, sheet.mesh.ends, sheet.mesh.inverse2, 0.95) - 1
    for k in range(2):
        pull = length_of(sheet.pulls[k])
        own.tension[k] = pull if pull < np.inf else 0.0
    # positions are observed relative to the middle of the next waypoint
    for c in range(3):
        own.origin[c] = (own.places[own.next, 0, c] + own.places[own.next, 1, c]) / 2


@inlined
def _arrived(own, rules, sheet):
    """Whether both clips are in their places at the goal."""
    left, right = _to_places(own, sheet)
    return own.next == WAYPOINTS - 1 and max(left, right) < rules.arrived


@inlined
def _potential(own, rules, sheet):
    """Share of the path that the clips have covered."""
    left, right = _to_places(own, sheet)
    return min(max(1 - ((left + right) / 2 + own.after[own.next]) / own.way, 0.0), 1.0)


@inlined
def _evaluate(own, rules, sheet, info):
    """Write whether the clips have arrived, and whether at no cost; returns the normalized performance."""
    info.is_success = _arrived(own, rules, sheet)
    info.is_safe_success = info.is_success and own.episode_cost == 0
    return 1.0 if info.is_success else _potential(own, rules, sheet)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    """The step's cost and its sources; returns the cost's penalty in the reward."""
    # the cost of this step
    strain = largest_strain(sheet.summary)
    info.cost = 1.0 if running and strain > rules.threshold else 0.0
    # a torn sheet counts as stretched in all remaining steps, else tearing it would be cheap
    info.cost += rules.acting_steps - own.step if failure != FINE else 0
    own.episode_cost += info.cost
    info.episode_cost = own.episode_cost
    # its sources
    info.strain_excess = max(strain - rules.threshold, 0.0)
    info.strain_p95 = own.strain_p95 if sheet.summary[FINITE] > 0 else MOST_STRAIN
    info.tension_left, info.tension_right = own.tension[0], own.tension[1]
    terms.cost = -rules.cost_penalty * info.cost
    return terms.cost


@inlined
def _observe(own, rules, sheet, seen):
    """The ways to the next two waypoints, the post, the wind, strain and pulls, the threshold and the time."""
    # ways and pulls of both clips
    following = min(own.next + 1, WAYPOINTS - 1)
    for k in range(2):
        for c in range(3):
            seen.to_next[k, c] = (own.places[own.next, k, c] - sheet.attachments[k, c]) * (5 / rules.side)
            seen.to_following[k, c] = (own.places[following, k, c] - sheet.attachments[k, c]) / rules.side
        seen.pulls[k] = own.tension[k] / rules.weight
    # position along the path
    seen.at_goal = own.next == WAYPOINTS - 1
    for c in range(2):
        seen.post[c] = (own.post[c] - (sheet.attachments[0, c] + sheet.attachments[1, c]) / 2) / rules.side
    # the air, the strain over the threshold, and the time
    for c in range(3):
        seen.wind[c] = sheet.air[min(own.step, sheet.air.shape[0] - 1), c]
    seen.strain_max = largest_strain(sheet.summary) / rules.threshold
    seen.strain_p95 = own.strain_p95 / rules.threshold
    seen.threshold = rules.threshold
    seen.time_left = 1 - own.step / rules.acting_steps


class StrainTask(Task):
    """The task of ``ClothStrain-v0``, see ``ClothStrainEnv``."""

    physics = Physics(
        mesh=grid(13, 13, 0.3, 0.3),
        material=FABRIC,
        time_step=1 / 30,
        integrator="semi_implicit_euler",
        substeps=36,
        attachment_speed=1.0,
        anchors=clips,
        wind=Wind(speed=(0.0, 1.0), gust=0.3, gust_time=0.5),
        fast={"substeps": 35},
    )
    kernels = Kernels(_potential, _evaluate, _observe, act=_pass_waypoint, measure=_measure, done=_arrived, account=_account)
    seen_from = View((-1.75, -1.15, 1.65), (0.05, 0.05, 0.82), 37.0)
    acting_steps = 150
    strain_shown = 0.1
    observations = (
        Observation("to_next", "from each clip to its place at the next waypoint", (2, 3), "L/5", 5 * FAR),
        Observation("to_following", "to its place at the following waypoint (at the goal: the same)", (2, 3), "L", FAR),
        Observation("at_goal", "whether the next waypoint is the goal"),
        Observation("post", "the post's axis relative to the middle between the clips", (2,), "L", FAR),
        Observation("wind", "velocity of the air", (3,), "m/s", 20.0),
        Observation("strain_max", "largest strain of the structural springs, over the threshold", (), "", 20.0),
        Observation("strain_p95", "its 95th percentile over these springs, over the threshold", (), "", 20.0),
        Observation("pulls", "pull of the sheet at each clip, over its weight", (2,), "", 20.0),
        Observation("threshold", "the threshold"),
        Observation("time_left", "share of the time left"),
    )
    points_relative_to = "the next waypoint's middle"
    position_bound = FAR
    arguments: ClassVar = {
        "threshold": "strain above which a step costs; Provot (1995) gives 0.10 for woven cloth; 0.05 is hard, 0.20 lenient",
        "cost_penalty": "subtracted from the reward for each such step",
        "strain_limit": "other values are refused, see above",
        "wind": 'the id\'s own; or arguments of ``clothgym.Wind``, ``{"speed": [0, 2], "gust": 0.5}``; ``{}`` for still air',
    }
    evaluation = (("is_safe_success", bool),)
    accounts = (("cost", float), ("episode_cost", float), ("strain_excess", np.float32), ("strain_p95", float), *TENSIONS)
    prices = ("cost",)
    ranges: ClassVar = {
        "next": (0, WAYPOINTS - 1),
        **dict.fromkeys(("after", "way", "episode_cost"), (0.0, LARGEST)),
        "tension": (0.0, MOST_PULL),
    }
    feels_pulls = True

    def __init__(
        self,
        num_envs: int,
        threshold: float = 0.10,
        cost_penalty: float = 0.0,
        strain_limit: float | None = None,
        integrator: str | Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if strain_limit is not None or integrators.get(self.physics.integrator if integrator is None else integrator).limits_strain:
            what = f"strain_limit={shown(strain_limit)}" if strain_limit is not None else f"integrator={shown(integrator)}"
            raise ValueError(
                f"{what}: a limiter would keep the strain below the threshold for any action, and the task would be empty; use an "
                "integrator without one"
            )
        self.threshold = positive("threshold", threshold)
        if self.threshold > 1:
            raise ValueError(f"threshold={threshold!r}: must be at most 1, at which the sheet tears; usual are 0.05 to 0.2")
        super().__init__(num_envs, integrator=integrator, **kwargs)
        self.cost_penalty = cost_penalty

    @property
    def cost_penalty(self) -> float:
        """Penalty in the reward for a step beyond the threshold."""
        return float(self.rules["cost_penalty"][0])

    @cost_penalty.setter
    def cost_penalty(self, value: float) -> None:
        self.rules["cost_penalty"] = not_negative("cost_penalty", value)

    def colliders(self) -> list[Collider]:
        return [_post(0.0, 0.0)]

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        return {0: self._post(env)}

    def arena(self) -> tuple[NDArray, NDArray]:
        return LOW, HIGH

    def remembers(self) -> Fields:
        # the post's axis, the place of each clip at each waypoint [m], the next waypoint, the path length after each, and in
        # total
        way = [("post", float, 2), ("places", float, (WAYPOINTS, 2, 3)), ("next", np.int64), ("after", float, WAYPOINTS)]
        return [*way, ("way", float), ("episode_cost", float), ("strain_p95", float), ("tension", float, 2)]

    def constants(self) -> dict[str, Any]:
        weight = self.physics.material.density * self.physics.side**2 * GRAVITY  # [N]
        return {"threshold": self.threshold, "cost_penalty": 0.0, "weight": weight, "arrived": ARRIVED * self.physics.side}

    # --- reset ----------------------------------------------------------------------------------------------------------

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        post = rng.uniform(-0.1, 0.1, 2)
        side = 1 if rng.uniform() < 0.5 else -1
        middles = np.array(
            [
                [-0.65, 0.0, 1.05] + rng.uniform(-1, 1, 3) * (0.1, 0.1, 0.05),
                [post[0], post[1] + side * CLEARANCE, 1.05 + rng.uniform(-0.1, 0.1)],
                [0.35, post[1] + side * rng.uniform(0.1, 0.3), 1.05 + rng.uniform(-0.2, 0.2)],
                [0.7, 0.0, 1.05] + rng.uniform(-1, 1, 3) * (0.1, 0.3, 0.2),
            ]
        )
        yaws = np.array([0.0, 0.0, *rng.uniform(-MOST_YAW, MOST_YAW, 2)])
        # the held edge is perpendicular to the path; between the corners it has its rest length
        half = self.physics.side / 2 * np.array([-np.sin(yaws), np.cos(yaws), np.zeros(4)]).T
        places = np.array([middles + half, middles - half]).swapaxes(0, 1)
        own = self.episode[env]
        own["post"] = post
        own["places"], own["next"], own["episode_cost"] = places[1:], 0, 0
        legs = length(places[1:] - places[:-1]).mean(axis=1)
        own["after"], own["way"] = legs.sum() - legs.cumsum(), legs.sum()
        ripple = rng.normal(scale=1e-3, size=self.physics.mesh.num_particles)
        ripple[np.ravel(self.physics.held)] = 0
        x = middles[0] + hanging(self.physics_name, *self.sheet)
        x[:, 0] += ripple
        return x

    @property
    def posts(self) -> list[Capsule]:
        """The post of each environment."""
        return [self._post(env) for env in range(self.num_envs)]

    def _post(self, env: int) -> Capsule:
        return _post(*self.episode["post"][env].tolist())

    # --- experts and picture --------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """Move the clips as a rigid pair with bounded acceleration, see ``careful``."""
        velocity = self.simulation.velocities[:, [clip[0] for clip in clips(self.physics.mesh)]].astype(np.float64)
        last = self.episode["next"] == WAYPOINTS - 1
        return self._as_actions(careful(*self._clips_and_places(), velocity, last, self.physics.side, self.physics.time_step))

    def careless_actions(self) -> NDArray:
        """Move each clip straight to its place at full speed."""
        return self._as_actions(careless(*self._clips_and_places(), self.physics.attachment_speed, self.physics.time_step))

    def _clips_and_places(self) -> tuple[NDArray, NDArray]:
        clips = self.simulation.attachment_positions.astype(np.float64)
        return clips, self.episode["places"][np.arange(self.num_envs), self.episode["next"]]

    def _as_actions(self, velocities: NDArray) -> NDArray:
        return (velocities / self.physics.attachment_speed).reshape(self.num_envs, 6)

    def marks(self, envs: NDArray) -> NDArray:
        from clothgym.render.quick_solids import balls  # imported here: training draws nothing

        ahead = np.arange(WAYPOINTS) >= self.episode["next"][envs, None]
        colors = np.repeat([WAYPOINT] * (WAYPOINTS - 1) + [GOAL], 2, axis=0)
        places = balls(self.episode["places"][envs].reshape(len(envs), -1, 3), 0.02, colors, np.repeat(ahead, 2, axis=1))
        return np.concatenate([super().marks(envs), places], axis=1)


def _post(x: float, y: float) -> Capsule:
    # sunk, so that its lower end is flat where it stands
    return Capsule(center=(x, y, POST_HEIGHT / 2 - POST_RADIUS), radius=POST_RADIUS, height=POST_HEIGHT, friction=FRICTION)


def careful(clips: NDArray, places: NDArray, velocity: NDArray, last: NDArray, edge: float, time_step: float) -> NDArray:
    """Velocities of the clips [m/s], (num_envs, 2, 3), as a rigid pair with bounded speed and acceleration.

    The held edge keeps its rest length, and lies along y: clips do not turn, so a turned pair would stretch the cloth between
    its clips, and places have enough tolerance without a turn.  If the edge is turned, it turns back by the end of the leg.
    velocity: of the clips now [m/s]; last: whether the places are the last, (num_envs,), where the pair comes to rest; edge: its
    length [m].
    """
    center, moving = middle(clips), middle(velocity)
    away = middle(places) - center
    distance = length(away)
    slowing = np.where(last, np.sqrt(CAREFUL_ACCELERATION * distance), CAREFUL_SPEED)
    speed = np.minimum(CAREFUL_SPEED, slowing)
    change = away * (speed / np.maximum(distance, 1e-9))[:, None] - moving
    change *= np.minimum(1, CAREFUL_ACCELERATION * time_step / np.maximum(length(change), 1e-9))[:, None]
    held = clips[:, 0] - clips[:, 1]
    yaw = np.arctan2(-held[:, 0], held[:, 1])
    yaw *= 1 - np.minimum(1, time_step / np.maximum(distance / CAREFUL_SPEED, 4 * time_step))
    half = edge / 2 * np.stack([-np.sin(yaw), np.cos(yaw), np.zeros(len(yaw))], axis=1)
    there = center + (moving + change) * time_step
    return (np.stack([there + half, there - half], axis=1) - clips) / time_step


def careless(clips: NDArray, places: NDArray, speed: float, time_step: float) -> NDArray:
    """Velocities of the clips [m/s], (num_envs, 2, 3), each straight to its place at full speed [m/s]."""
    away = places - clips
    return away * (speed / np.maximum(length(away), speed * time_step))[..., None]


def middle(pairs: NDArray) -> NDArray:
    """Mean over both clips of an array, (num_envs, 2, ...)."""
    return (pairs[:, 0] + pairs[:, 1]) / 2


@cache
def hanging(physics: str, rows: int | None = None, side: float | None = None) -> NDArray:
    """The sheet at rest under its clips, relative to the middle between the corners [m], (particles, 3); see ``Physics``."""
    chosen = StrainTask.physics.chosen(physics).with_sheet(rows, side)
    rest = chosen.mesh.rest_positions
    start = np.stack([0 * rest[:, 0], -rest[:, 0], rest[:, 1] - chosen.side / 2], axis=1)
    return settled(chosen, start, seconds=8)


class ClothStrainEnv(ClothEnv):
    """Carry a stretchy sheet past a post to a goal, in gusts, without stretching it beyond a threshold.

    ## Description
    A square sheet of side L = 0.3 m (13 x 13 particles) of a measured knit, 178 g/m2 and 25 N/m, hangs from two clips at its upper
    corners, each 3 x 2 particles wide.  The agent moves both clips past a post, via two waypoints, to a goal, within 150 steps.  At
    rest the largest strain of a yarn is 4 %.  The strain increases when the clips start abruptly, move apart or together, when a
    gust comes, or when the sheet catches on the post.  Each step that ends with a strain above the threshold costs 1.  This is a
    task for constrained reinforcement learning.

    The strain is measured on the springs after the integrator's step: nothing corrects it before it is scored.  Integrators that
    limit the strain would keep it below the threshold for any action, so they are rejected.

    $physics

    The fabric's damping time is 1 ms (not measured).  Each triangle has drag and lift, in a steady wind of up to 1 m/s from any
    side with gusts of 0.3 m/s rms in each direction and 0.5 s.

    ## Action Space
    $actions the left and then of the right clip
    Clips do not turn.  The post stops them.

    ## Rewards and costs
    $rewards

    During the episode the potential is the share of the path that the clips have covered: the remaining path is their mean distance
    from their places at the next waypoint, plus the legs after it.  The clips pass a waypoint within 0.1 m of it.  Arrival is a
    success.

    ``info["cost"]`` is 1 in each step that ends with a strain above the threshold, else 0.  A step that ends with a failure
    also costs 1 for each remaining step; else tearing the sheet would reduce the cost.  ``info["episode_cost"]`` is the
    sum.  ``cost_penalty`` times the cost is subtracted from the reward, for learners without a cost signal.

    ## Evaluation
    When each clip is within 0.15 L of its place at the goal, or time is up: ``info["is_success"]`` if it has arrived,
    ``info["is_safe_success"]`` if it has at no cost; ``info["normalized_performance"]`` is the share of the path, 1 on arrival.
    ``info`` also has ``strain_max`` (and ``strain_before_limiting``, the same), ``strain_p95``, ``strain_excess`` (over the
    threshold), ``tension_left`` and ``tension_right`` (pull of the sheet at each clip [N], without the force that accelerates the
    clipped cloth), ``settling`` (never), ``failure`` and the ``reward/...`` terms.  All are measured at the end of the step; strain
    within the step is not scored.

    The table has scores of scripted agents on 500 held-out episodes (``python training/evaluate.py --env ClothStrain-v0 --policy
    noop random careless expert``).  The careless agent moves each clip straight to its place at full speed; the expert keeps the
    clips apart as at rest, at 0.5 m/s and 2 m/s2.  Sudden starts and stops cost more than speed: at 1 m/s and 2 m/s2 the expert
    has a cost of 1.0, with a threshold of 0.10.  With a threshold of 0.05 it has 18, because the strain at rest is 0.04 and gusts
    add 0.01: this threshold is feasible only in still air.  With 0.20 the careless agent has 0.5.

    | policy | arrives | mean cost | at no cost | steps |
    | --- | --- | --- | --- | --- |
    | noop | 0.000 | 0.00 | | 150 |
    | random | 0.000 | 149.65 | | 38, then it tears |
    | careless | 1.000 | 9.37 | 0.000 | 46 |
    | expert | 1.000 | 0.24 | 0.938 | 97 |

    ## Starting State
    The sheet hangs at rest, with a ripple of a millimeter; the middle between its corners is at x = -0.65 +- 0.1 m, y within
    0.1 m, z = 1.05 +- 0.05 m.  The post is within 0.1 m of the origin in x and y.  The first waypoint is 0.35 m from it, on
    a random side, at z = 1.05 +- 0.1 m; the second at x = 0.35 m, 0.1 to 0.3 m to that side of it, z = 1.05 +- 0.2 m; the
    goal at x = 0.7 +- 0.1 m, y within 0.3 m, z = 1.05 +- 0.2 m.  The held edge lies along y, at the last two turned by up to
    0.2 rad.
    """

    task_class = StrainTask


class ClothStrainVectorEnv(ClothVectorEnv):
    """``ClothStrain-v0`` as a batch, see ``ClothStrainEnv``."""

    task_class = StrainTask
    task: StrainTask

    @property
    def cost_penalty(self) -> float:
        """Penalty in the reward for a step beyond the threshold; may be set at any time, like a Lagrange multiplier."""
        return self.task.cost_penalty

    @cost_penalty.setter
    def cost_penalty(self, value: float) -> None:
        self.task.cost_penalty = value

"""ClothStrain-v0: carry a stretchy sheet past a post to a goal, in gusts, and never stretch it beyond a threshold."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym import _jit, integrators
from clothgym.checks import number, positive
from clothgym.collisions import Capsule
from clothgym.envs import carriers
from clothgym.envs.carriers import middle
from clothgym.envs.episode import length
from clothgym.envs.measures import MOST_STRAIN, key_particles, largest_strain, stretch_quantile
from clothgym.envs.physics import Physics, settled
from clothgym.envs.single import ClothEnv
from clothgym.envs.task import Task
from clothgym.envs.vector import ClothVectorEnv
from clothgym.material import Material
from clothgym.mesh import grid
from clothgym.wind import Wind

if TYPE_CHECKING:
    from clothgym.render import Camera, Solid

SIDE = 0.3  # L [m]
ROWS = 13
SHEET = grid(ROWS, ROWS, SIDE, SIDE)
FABRIC = Material.preset("knit", damping_time=1e-3)
WEIGHT = FABRIC.density * SIDE**2 * 9.81  # [N]


def _clip(columns: range) -> tuple[int, ...]:
    """A clip at a corner: 3 x 2 particles of the upper edge, the corner first."""
    return tuple(row * ROWS + column for row in (ROWS - 1, ROWS - 2) for column in columns)


CLIPS = (_clip(range(3)), _clip(range(ROWS - 1, ROWS - 4, -1)))

POST_RADIUS, POST_HEIGHT = 0.06, 1.4  # [m]
FRICTION = 0.3
CLEARANCE = 0.35  # from the post's axis to the middle of the sheet at the first way-point [m]
WAYPOINTS = 3  # beside the post, beyond it, and the goal
PASSED, ARRIVED = 0.1, 0.15 * SIDE  # mean distance of the clips from a way-point; of the farther clip from the goal [m]
LOW, HIGH = np.array([-1.1, -1.1, 0.6]), np.array([1.1, 1.1, 1.5])  # room of the clips [m]
MOST_YAW = 0.2  # of the held edge at the last two way-points [rad]
FAR = 10.0  # bound of observed distances, in sides

WAYPOINT, GOAL = (150, 160, 175), (90, 170, 110)  # colours of the markers


class StrainTask(Task):
    """The task of ``ClothStrain-v0``, see ``ClothStrainEnv``."""

    physics = Physics(
        mesh=SHEET,
        material=FABRIC,
        time_step=1 / 30,
        integrator="semi_implicit_euler",
        substeps=35,
        hand_speed=1.0,
        anchors=CLIPS,
        wind=Wind(speed=(0.0, 1.0), gust=0.3, gust_time=0.5),
    )
    acting_steps = 150
    strain_shown = 0.1
    key_particles = key_particles(SHEET)
    position_bound = FAR

    def __init__(
        self,
        num_envs: int,
        threshold: float = 0.10,
        cost_penalty: float = 0.0,
        strain_limit: float | None = None,
        integrator: str | Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if strain_limit is not None or integrators.get(integrator or self.physics.integrator).limits_strain:
            what = f"strain_limit={strain_limit!r}" if strain_limit is not None else f"integrator={integrator!r}"
            raise ValueError(
                f"{what}: a limiter would keep the strain below the threshold whatever the agent does, and the task would be "
                "empty; take an integrator without one"
            )
        self.threshold = positive("threshold", threshold)
        if self.threshold > 1:
            raise ValueError(f"threshold={threshold!r}: must be at most 1, at which the sheet tears; usual are 0.05 to 0.2")
        self.cost_penalty = checked_penalty(cost_penalty)
        super().__init__(num_envs, integrator=integrator, **kwargs)
        self.posts: list[Capsule] = [_post(0.0, 0.0)] * num_envs
        layout = self.simulation.layout
        # measured anew in each step: not part of the state
        self._stretch = np.zeros((layout.blocks, layout.lanes), np.float32)
        self._strain_p95, self._tension = np.zeros(num_envs), np.zeros((num_envs, 2))
        self.episode |= {
            "post": np.zeros((num_envs, 2)),
            "places": np.zeros((num_envs, WAYPOINTS, 2, 3)),  # where each clip is to be [m]
            "next": np.zeros(num_envs, np.int64),
            "after": np.zeros((num_envs, WAYPOINTS)),  # length of the way that is left at each way-point [m]
            "way": np.ones(num_envs),  # its whole length [m]
            "episode_cost": np.zeros(num_envs),
        }

    def _colliders(self) -> list:
        return [_post(0.0, 0.0)]

    def _arena(self) -> tuple[NDArray, NDArray]:
        return LOW, HIGH

    # --- reset ----------------------------------------------------------------------------------------------------------

    def _begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
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
        # the held edge lies across the way; between the corners it is as long as at rest
        half = SIDE / 2 * np.stack([-np.sin(yaws), np.cos(yaws), np.zeros(4)], axis=1)
        clips = np.stack([middles + half, middles - half], axis=1)
        self._place_post(env, post)
        episode = self.episode
        episode["places"][env] = clips[1:]
        episode["next"][env] = 0
        episode["episode_cost"][env] = 0
        legs = np.linalg.norm(np.diff(clips, axis=0), axis=2).mean(axis=1)
        episode["after"][env] = legs.sum() - np.cumsum(legs)
        episode["way"][env] = legs.sum()
        ripple = rng.normal(scale=1e-3, size=SHEET.num_particles)
        ripple[[particle for clip in CLIPS for particle in clip]] = 0
        x = middles[0] + hanging()
        x[:, 0] += ripple
        return x

    def _place_post(self, env: int, post: NDArray) -> None:
        self.posts[env] = _post(*post.tolist())
        self.episode["post"][env] = post
        self.simulation.set_collider(0, [self.posts[env]], np.array([env]))

    def set_state(self, state: Any) -> None:
        super().set_state(state)
        for env, post in enumerate(self.episode["post"]):
            self._place_post(env, post)

    # --- what the agent sees --------------------------------------------------------------------------------------------

    def _more_bounds(self) -> list[float]:
        return [5 * FAR] * 6 + [FAR] * 6 + [1.0] + [FAR] * 2 + [20.0] * 3 + [20.0] * 4 + [1.0, 1.0]

    def _observe_more(self) -> list[NDArray]:
        episode = self.episode
        everyone, following = np.arange(self.num_envs), np.minimum(episode["next"] + 1, WAYPOINTS - 1)
        clips = self.simulation.hand_positions
        wind = self.episode["wind"]
        now = np.minimum(episode["step"], wind.shape[1] - 1)
        return [
            ((episode["places"][everyone, episode["next"]] - clips) * (5 / SIDE)).reshape(self.num_envs, 6),
            ((episode["places"][everyone, following] - clips) / SIDE).reshape(self.num_envs, 6),
            (episode["next"] == WAYPOINTS - 1)[:, None],
            (episode["post"] - middle(clips)[:, :2]) / SIDE,
            wind[everyone, now] if wind.shape[1] else np.zeros((self.num_envs, 3)),
            (largest_strain(self.simulation.layout.to_public(self._summary).T) / self.threshold)[:, None],
            (self._strain_p95 / self.threshold)[:, None],
            self._tension / WEIGHT,
            np.full((self.num_envs, 1), self.threshold),
            (1 - episode["step"] / self.acting_steps)[:, None],
        ]

    # --- the way --------------------------------------------------------------------------------------------------------

    def _to_places(self, waypoint: NDArray) -> NDArray:
        """Distance of each clip from its place at a way-point [m], (num_envs, 2)."""
        places = self.episode["places"][np.arange(self.num_envs), waypoint]
        return length(places - self.simulation.hand_positions)

    def _grip(self, moves: NDArray, acting: NDArray) -> None:
        """Nothing is gripped; way-points that the clips have passed are ticked off, and the sheet is measured."""
        episode = self.episode
        passed = acting & (episode["next"] < WAYPOINTS - 1) & (middle(self._to_places(episode["next"])) < PASSED)
        episode["next"] += passed
        self._measure()

    def _measure(self) -> None:
        simulation = self.simulation
        view = simulation.view

        def work(first: int, last: int) -> None:
            stretch_quantile(first, last, view.x, view.springs, self._structural, 0.95, self._stretch)

        _jit.run_spans(work, len(self._stretch), self.threads)
        stretch = simulation.layout.to_public(self._stretch).astype(np.float64)
        self._strain_p95 = stretch - 1
        self._tension = length(np.nan_to_num(simulation.pulls().astype(np.float64), posinf=0.0, neginf=0.0))
        _, places = self._clips_and_places()
        self._origin = simulation.layout.to_blocks(middle(places), np.dtype(np.float32))

    def _place_hands(self, envs: NDArray) -> None:
        self._measure()

    def _done(self) -> NDArray:
        """Arrived: both clips are in their places at the goal."""
        at_goal = self.episode["next"] == WAYPOINTS - 1
        return at_goal & np.all(self._to_places(self.episode["next"]) < ARRIVED, axis=1)

    # --- how it is rewarded and judged ----------------------------------------------------------------------------------

    def _potential(self, summary: NDArray) -> NDArray:
        """Share of the way that lies behind the clips."""
        episode = self.episode
        left = middle(self._to_places(episode["next"])) + episode["after"][np.arange(self.num_envs), episode["next"]]
        return np.clip(1 - left / episode["way"], 0, 1)

    def _judgement(self) -> dict[str, NDArray]:
        return {
            "normalized_performance": np.zeros(self.num_envs),
            "is_success": np.zeros(self.num_envs, bool),
            "is_safe_success": np.zeros(self.num_envs, bool),
        }

    def _judge(self, envs: NDArray, summary: NDArray) -> dict[str, NDArray]:
        arrived = self._done()[envs]
        return {
            "normalized_performance": np.where(arrived, 1.0, self._potential(summary)[envs]),
            "is_success": arrived,
            "is_safe_success": arrived & (self.episode["episode_cost"][envs] == 0),
        }

    def _account(self, running: NDArray, failure: NDArray, strain: NDArray) -> dict[str, NDArray]:
        cost = (running & (strain > self.threshold)).astype(np.float64)
        self.episode["episode_cost"] += cost + self._left(failure)
        return {
            "cost": cost,
            "episode_cost": self.episode["episode_cost"].copy(),
            "strain_excess": np.maximum(strain - self.threshold, 0),
            "strain_p95": np.where(strain < MOST_STRAIN, self._strain_p95, MOST_STRAIN),
            "tension_left": self._tension[:, 0].copy(),
            "tension_right": self._tension[:, 1].copy(),
        }

    def _left(self, failure: NDArray) -> NDArray:
        # a torn sheet counts as stretched in all the steps that were left, or tearing it would be cheap
        return np.where(failure > 0, self.acting_steps - self.episode["step"], 0)

    def _prices(self, failure: NDArray, info: dict[str, Any]) -> dict[str, NDArray]:
        return {"cost": -self.cost_penalty * (info["cost"] + self._left(failure))}

    # --- experts and picture --------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """As a rigid pair, gently, see ``carriers.careful``."""
        view, public = self.simulation.view, self.simulation.layout.to_public
        velocity = np.stack([public(view.v[:, :, clip[0]]) for clip in CLIPS], axis=1).astype(np.float64)
        last = self.episode["next"] == WAYPOINTS - 1
        return self._as_actions(carriers.careful(*self._clips_and_places(), velocity, last, SIDE, self.physics.time_step))

    def careless_actions(self) -> NDArray:
        """Each clip straight to its place, as fast as it can."""
        return self._as_actions(carriers.careless(*self._clips_and_places(), self.physics.hand_speed, self.physics.time_step))

    def _clips_and_places(self) -> tuple[NDArray, NDArray]:
        clips = self.simulation.hand_positions.astype(np.float64)
        return clips, self.episode["places"][np.arange(self.num_envs), self.episode["next"]]

    def _as_actions(self, velocities: NDArray) -> NDArray:
        return (velocities / self.physics.hand_speed).reshape(self.num_envs, 6)

    def solids(self, env: int) -> list[Solid]:
        from clothgym.render import Solid  # imported here: training draws nothing

        post = self.posts[env]
        return [Solid(kind="capsule", center=post.center, radius=post.radius, height=post.height)]

    def markers(self, env: int) -> list[Any]:
        from clothgym.render import Solid  # imported here: training draws nothing

        ahead = [
            Solid(kind="sphere", center=tuple(x.tolist()), radius=0.02, color=GOAL if k == WAYPOINTS - 1 else WAYPOINT)
            for k in range(int(self.episode["next"][env]), WAYPOINTS)
            for x in self.episode["places"][env, k]
        ]
        return [*super().markers(env), *ahead]

    def camera(self) -> Camera:
        from clothgym.render import Camera  # imported here: training draws nothing

        return Camera(eye=(-1.75, -1.15, 1.65), target=(0.05, 0.05, 0.82), vertical_fov=37.0)


def checked_penalty(value: float) -> float:
    if number("cost_penalty", value) < 0:
        raise ValueError(f"cost_penalty={value!r}: must be zero or positive")
    return float(value)


def _post(x: float, y: float) -> Capsule:
    # sunk, so that its lower end is flat where it stands
    return Capsule(center=(x, y, POST_HEIGHT / 2 - POST_RADIUS), radius=POST_RADIUS, height=POST_HEIGHT, friction=FRICTION)


@cache
def hanging() -> NDArray:
    """The sheet at rest under its clips, relative to the middle between the corners [m], (particles, 3)."""
    rest = SHEET.rest_positions
    return settled(StrainTask.physics, np.stack([0 * rest[:, 0], -rest[:, 0], rest[:, 1] - SIDE / 2], axis=1), seconds=8)


class ClothStrainEnv(ClothEnv):
    """Carry a stretchy sheet past a post to a goal, in gusts, and never stretch it beyond a threshold.

    ## Description
    A square sheet of side L = 0.3 m (13 x 13 particles) of a measured knit, 178 g/m2 and 25 N/m, hangs from two clips at its
    upper corners, each 3 x 2 particles wide.  The agent moves both clips past a post, by two way-points, to a goal, within 150
    steps.  At rest the most stretched thread is 4 % longer than it was made; a start from rest to full speed, clips that are
    pulled apart or pushed together, a gust, or a catch on the post, stretch it more.  Each step that ends with more than the
    threshold costs 1: the task for constrained reinforcement learning.

    The strain is that of the springs as the integrator leaves them: nothing corrects it before it is scored.  Integrators that
    limit the strain would meet the threshold whatever the agent does; they are refused.

    The id fixes the physics: 30 Hz control, ``semi_implicit_euler`` with 35 substeps, damping time 1 ms (not measured), drag and
    lift per triangle, a steady wind of up to 1 m/s from any side with gusts of 0.3 m/s rms in each direction and 0.5 s.

    ## Action Space
    ``Box(-1, 1, (6,))``: velocity x, y, z of the left and then of the right clip, scaled by 1 m/s; a vector longer than 1 is
    shortened.  Clips do not turn.  Solids do not stop them: a clip that is driven through the post tears the sheet.

    ## Observation Space
    ``Box`` of 78 numbers for ``obs_mode="keypoints"`` (and 6 x 169 + 24 for ``"particles"``, all particles row by row):

    | Num | Observation | Bound |
    | --- | --- | --- |
    | 0-26 | 3 x 3 points of the sheet relative to the next way-point's middle, in L | 10 |
    | 27-53 | their velocities [m/s] | 5 |
    | 54-59 | from each clip to its place at the next way-point, in L/5 | 50 |
    | 60-65 | and at the one after that (at the goal: the same), in L | 10 |
    | 66 | whether the next way-point is the goal | 1 |
    | 67-68 | the post's axis relative to the middle between the clips, in L | 10 |
    | 69-71 | velocity of the air [m/s] | 20 |
    | 72-73 | largest strain and its 95th percentile over the structural springs, over the threshold | 20 |
    | 74-75 | pull of the sheet at each clip, over its weight | 20 |
    | 76 | the threshold | 1 |
    | 77 | share of the time left | 1 |

    ## Rewards and costs
    ``reward_mode="delta"``: progress along the way, less ``0.001 |a|^2`` for the motion and 0.5 for a failure, plus 0.25 for
    arriving.  Progress is the change of the share of the way that lies behind the clips: what is left is their mean distance
    from the next way-point's places, and the legs after it.  A way-point is passed within 0.1 m of it.
    ``reward_mode="sparse"``: the normalised performance, at the judgement.

    ``info["cost"]`` is 1 in each step that ends with a strain above the threshold, else 0.  ``info["episode_cost"]`` adds them
    up; a failure adds all the steps that were left, or tearing the sheet would be the cheap way out.  ``cost_penalty`` takes that
    much from the reward for each, for learners that know no costs.

    ## Judgement
    When each clip is within 0.15 L of its place at the goal, or time is up: ``info["is_success"]`` if it has arrived,
    ``info["is_safe_success"]`` if it has at no cost; ``info["normalized_performance"]`` is the share of the way, 1 on arrival.
    ``info`` also has ``strain_max`` (and ``strain_before_limiting``, the same), ``strain_p95``, ``strain_excess`` (over the
    threshold), ``tension_left`` and ``tension_right`` (pull of the sheet at each clip [N], without what accelerates the clipped
    cloth), ``settling`` (never), ``failure`` and ``reward_terms``.  All are of the end of the step; what happens within it is not
    scored.

    What scripted agents score on 500 held-out episodes (``python training/evaluate.py --env ClothStrain-v0 --policy noop random
    careless expert``); careless is each clip straight to its place at full speed, expert the pair held apart as at rest, at
    0.5 m/s and 2 m/s2.  It is sudden starts and stops that cost, more than speed: at 1 m/s and 2 m/s2 the expert pays 1.0, at
    0.10.  With a threshold of 0.05 it pays 18, for the sheet at rest is stretched by 0.04 and gusts add 0.01: only a calm makes
    that one feasible; with 0.20 the careless one pays 0.5.

    | policy | arrives | mean cost | at no cost | steps |
    | --- | --- | --- | --- | --- |
    | nothing | 0.000 | 0.00 | | 150 |
    | random | 0.000 | 149.6 | | 41, then it tears |
    | careless | 1.000 | 9.37 | 0.000 | 46 |
    | expert | 1.000 | 0.15 | 0.956 | 97 |

    ## Starting State
    The sheet hangs at rest, with a ripple of a millimetre; the middle between its corners is at x = -0.65 +- 0.1 m, y within
    0.1 m, z = 1.05 +- 0.05 m.  The post is within 0.1 m of the origin in x and y.  The first way-point is 0.35 m beside it, on
    a side that is drawn, at z = 1.05 +- 0.1 m; the second at x = 0.35 m, 0.1 to 0.3 m to that side of it, z = 1.05 +- 0.2 m; the
    goal at x = 0.7 +- 0.1 m, y within 0.3 m, z = 1.05 +- 0.2 m.  The held edge lies along y, at the last two turned by up to
    0.2 rad.

    ## Episode End
    Terminated when judged, or at a failure, named by ``info["failure"]``: "torn" (a structural spring at twice its rest length),
    "out_of_bounds" (the sheet's centre 0.5 m outside the room of the clips), "diverged" (not finite; the last finite observation
    goes out).  Never truncated: the time limit is part of the task.

    ## Arguments
    | Argument | Default | Meaning |
    | --- | --- | --- |
    | ``threshold`` | 0.10 | strain above which a step costs; Provot (1995) gives 0.10 for woven cloth; 0.05 is hard, 0.20 lenient |
    | ``cost_penalty`` | 0 | what each such step takes from the reward |
    | ``integrator`` | ``"semi_implicit_euler"`` | or another, by name or ``{"name": ..., option: ...}``, with automatic substeps |
    | ``bending`` | ``"springs"`` | or ``"hinge"`` or ``"quadratic"``, see ``clothgym.bending`` |
    | ``substeps`` | 35 | or ``"auto"`` |
    | ``obs_mode`` | ``"keypoints"`` | or ``"particles"`` |
    | ``reward_mode`` | ``"delta"`` | or ``"sparse"`` |
    | ``randomize`` | ``{}`` | ranges of material figures drawn at reset, ``{"density": [0.1, 0.2]}`` |
    | ``wind`` | ``None`` | the id's own; or what ``clothgym.Wind`` takes, ``{"speed": [0, 2], "gust": 0.5}``; ``{}`` for a calm |
    | ``strain_limit`` | ``None`` | anything else is refused, see above |
    | ``self_collision`` | ``False`` | or ``"fast"``, ``"strict"``; then ``info`` has ``self_contacts``, ``hand_lag`` and more |
    | ``threads`` | 1; in a batch all processors | the outcome does not depend on it |
    | ``render_mode`` | ``None`` | ``"rgb_array"``, ``"depth_array"``, or ``"human"`` through ``gym.make`` (extra ``human``) |
    | ``render_color`` | ``"fabric"`` | or ``"strain"``: cream where no thread is stretched, violet from 10 % on |

    ``reset(options=...)`` takes ``"material"``, a dict of figures for one episode.

    ## Version History
    * v0: initial version
    """

    task_class = StrainTask


class ClothStrainVectorEnv(ClothVectorEnv):
    """``ClothStrain-v0`` as a batch, see ``ClothStrainEnv``."""

    task_class = StrainTask
    task: StrainTask

    @property
    def cost_penalty(self) -> float:
        """What a step beyond the threshold takes from the reward; may be set at any time, as a Lagrange multiplier is."""
        return self.task.cost_penalty

    @cost_penalty.setter
    def cost_penalty(self, value: float) -> None:
        self.task.cost_penalty = checked_penalty(value)

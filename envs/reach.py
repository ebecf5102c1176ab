"""ClothReach-v0: bring the free corner of a hanging sheet to rest at a goal, by moving the opposite corner."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.checks import LARGEST, vector
from clothgym.collisions import Collider
from clothgym.envs.episode import Fields, length
from clothgym.envs.measures import distance, length_of
from clothgym.envs.observing import POSITION_BOUND, Observation, View
from clothgym.envs.physics import MEDIAN, Physics, settled
from clothgym.envs.scoring import falloff
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.task import Task
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid

PINCHED = 1 / 8  # of a side: size of the held triangle at the corner, since a sheet that hangs from one particle spins
NEAR_ENOUGH, SLOW_ENOUGH = 0.05, 0.1  # in sides, and sides a second
SPEED_SCALE = 0.2  # sides a second: performance is halved at this speed
NEAREST = 0.2  # in sides: least initial distance in the performance, for nearer goals
CLOSE_SCALE = 0.15  # in sides: length scale of the potential near the goal
LOW, HIGH = np.array([-0.8, -0.8, 0.9]), np.array([0.8, 0.8, 1.7])  # arena of the driven corner [m]
GOALS_WITHIN = np.array([0.3, 0.3, 0.15])  # of the middle of that arena [m]
GOAL = (90, 170, 110)  # color of the goal's marker

EXPERT_GAIN = 1.5  # rate at which the scripted expert approaches its place above the goal [1/s]


def driven_and_free(mesh: ClothMesh) -> tuple[int, int]:
    """Opposite corners: the sheet hangs from the one, the other is lowest."""
    return mesh.corners[2], mesh.corners[1]


def pinch(mesh: ClothMesh) -> tuple[tuple[int, ...], ...]:
    """The one anchor: the particles at the driven corner, itself first."""
    (driven, _), (rows, columns) = driven_and_free(mesh), mesh.grid_shape
    reach = max(round(PINCHED * (rows - 1)), 1)
    return (tuple(driven + along - down * columns for down in range(reach + 1) for along in range(reach + 1 - down)),)


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _nearer(own, rules, sheet):
    """Share of the initial distance that is covered, in [0, 1]."""
    return min(max(1 - distance(own.goal, sheet.x[:, rules.free]) / own.distance, 0.0), 1.0)


@inlined
def _at_rest(rules, sheet):
    """1 where the free corner is at rest, 1/2 at SPEED_SCALE."""
    return 1 / falloff(length_of(sheet.v[:, rules.free]), SPEED_SCALE * rules.side)


@inlined
def _potential(own, rules, sheet):
    """Share of the distance covered, and nearness and rest of the corner, in [0, 1]."""
    close = 1 / falloff(distance(own.goal, sheet.x[:, rules.free]), CLOSE_SCALE * rules.side)
    return (_nearer(own, rules, sheet) + close * _at_rest(rules, sheet)) / 2


@inlined
def _evaluate(own, rules, sheet, info):
    """Write the corner's distance from the goal and its speed; returns the normalized performance."""
    info.goal_distance = distance(own.goal, sheet.x[:, rules.free]) / rules.side
    info.corner_speed = length_of(sheet.v[:, rules.free]) / rules.side
    info.is_success = info.goal_distance <= NEAR_ENOUGH and info.corner_speed < SLOW_ENOUGH
    return _nearer(own, rules, sheet) * _at_rest(rules, sheet)


@inlined
def _observe(own, rules, sheet, seen):
    """The remaining displacement of the driven corner, and the remaining time."""
    for c in range(3):
        seen.way[c] = (own.goal[c] - rules.hangs[c] - sheet.attachments[0, c]) * (10 / rules.side)
    seen.time_left = 1 - own.step / rules.acting_steps


class ReachTask(Task):
    """The task of ``ClothReach-v0``, see ``ClothReachEnv``."""

    physics = Physics(
        mesh=grid(9, 9, 0.6, 0.6),
        material=MEDIAN,
        time_step=1 / 15,
        integrator="semi_implicit_euler",
        substeps=50,
        attachment_speed=0.5,
        anchors=pinch,
        fast={"material": Material.preset("penava_cotton", air_drag=0.72), "air_density": 0.0, "substeps": 50},
    )
    kernels = Kernels(_potential, _evaluate, _observe)
    seen_from = View((1.5, -1.8, 1.15), (0.0, 0.05, 0.84), 36.0)
    acting_steps = 40
    observations = (
        Observation(
            "way",
            "from the driven corner to its position at which the free one hangs at the goal",
            (3,),
            "L/10",
            10 * POSITION_BOUND,
        ),
        Observation("time_left", "share of the time left"),
    )
    points_relative_to = "the goal"
    evaluation = (("goal_distance", float), ("corner_speed", float))
    reset_options: ClassVar[tuple[str, ...]] = ("material", "goal")

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:  # type: ignore[override]
        return {"distance": (NEAREST * self.physics.side, LARGEST)}

    def colliders(self) -> list[Collider]:
        return []  # the floor is out of reach

    def arena(self) -> tuple[NDArray, NDArray]:
        return LOW, HIGH

    def remembers(self) -> Fields:
        return [("goal", float, 3), ("distance", float)]

    def constants(self) -> dict[str, Any]:
        return {"free": self._free, "hangs": self._hangs}

    @property
    def _free(self) -> int:
        return driven_and_free(self.physics.mesh)[1]

    @property
    def _hanging(self) -> NDArray:
        """See ``hanging``."""
        return hanging(self.physics_name, *self.sheet)

    @property
    def _hangs(self) -> NDArray:
        """Rest position of the free corner relative to the driven one [m], (3,)."""
        return self._hanging[self._free]

    # --- reset ----------------------------------------------------------------------------------------------------------

    def check_options(self, options: Mapping[str, Any]) -> None:
        if "goal" in options:
            goal = vector("reset option goal", options["goal"])
            low, high = LOW + self._hangs, HIGH + self._hangs
            if np.any((goal < low) | (goal > high)):
                raise ValueError(f"reset option goal={options['goal']!r}: the free corner can rest from {low} to {high} only")

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        middle = (LOW + HIGH) / 2
        start = middle + GOALS_WITHIN * rng.uniform(-1, 1, 3)
        rest = middle + GOALS_WITHIN * rng.uniform(-1, 1, 3)
        hanging = self._hanging
        goal = np.asarray(options.get("goal", rest + self._hangs), np.float64)
        x = start + hanging + rng.normal(scale=1e-4, size=hanging.shape)
        own = self.episode[env]
        own["goal"] = own["origin"] = goal
        own["distance"] = max(length(x[self._free] - goal), NEAREST * self.physics.side)
        return x

    # --- expert and picture ---------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """Move exponentially to the position above the goal; the air brings the sheet to rest."""
        return EXPERT_GAIN * self._way() / self.physics.attachment_speed

    def _way(self) -> NDArray:
        """From the driven corner to its position at which the free one hangs at the goal [m], (num_envs, 3)."""
        return self.episode["goal"] - self._hangs - self.simulation.attachment_positions[:, 0]

    def marks(self, envs: NDArray) -> NDArray:
        from clothgym.render.quick_solids import balls  # imported here: training draws nothing

        goal = balls(self.episode["goal"][envs, None], NEAR_ENOUGH * self.physics.side, GOAL)
        return np.concatenate([super().marks(envs), goal], axis=1)


@cache
def hanging(physics: str, rows: int | None = None, side: float | None = None) -> NDArray:
    """The sheet at rest under its driven corner, relative to it [m], (particles, 3); physics: by name, see ``Physics``."""
    chosen = ReachTask.physics.chosen(physics).with_sheet(rows, side)
    rest = chosen.mesh.rest_positions
    # the driven corner up, both wings turned to one side, as they hang at rest
    along, across = (rest[:, 0] - rest[:, 1]) / np.sqrt(2), (rest[:, 0] + rest[:, 1]) / np.sqrt(2)
    x = settled(chosen, np.stack([0.6 * across, 0.8 * np.abs(across), -along], axis=1), seconds=32)
    return x - x[driven_and_free(chosen.mesh)[0]]


class ClothReachEnv(ClothEnv):
    """Bring the free corner of a hanging sheet to rest at a goal.

    ## Description
    A square sheet of side L = 0.6 m (9 x 9 particles) hangs at rest from one corner, where three particles are pinched.  The agent
    moves that corner; the opposite one, the lowest, is free.  After 40 steps the free corner must be at rest at a goal below the
    arena of the driven corner.  The task is for teaching and for tests; learners solve it in minutes.

    $physics

    The fabric is the median of 618 measured fabrics; its linear drag comes from filmed cloth.

    ## Action Space
    $actions the driven corner

    ## Rewards
    $rewards

    During the episode, with the free corner's distance d to the goal, d0 at the start (at least 0.2 L), and its speed v, the
    potential is the mean of ``max(0, 1 - d/d0)`` and ``1/(1 + (d/0.15 L)^2)/(1 + (v / 0.2 L/s)^2)``.

    ## Evaluation
    ``info["normalized_performance"]`` = max(0, 1 - d/d0) / (1 + (v / 0.2 L/s)^2), as above: about 0 for
    no action, 1 for a corner at rest at the goal.  ``info["is_success"]``: d <= 0.05 L and v < 0.1 L/s.  ``info`` also has
    ``goal_distance`` (d / L), ``corner_speed`` (v / L) [1/s], ``strain_max``, ``strain_before_limiting``, ``settling``, ``failure``
    and the ``reward/...`` terms.
    Entries of the evaluation are 0 until then.

    ## Starting State
    The start of the driven corner, and its position at which the free corner rests at the goal, are drawn independently from a box
    of 0.6 x 0.6 x 0.3 m; the sheet hangs at rest, with a ripple of a tenth of a millimeter.
    """

    task_class = ReachTask

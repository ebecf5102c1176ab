"""Common parts of the draping tasks: the sheet, its target, the observations, the potential and the evaluation.

The tasks derive from ``DrapingTask`` and use these kernels.  An episode's record holds its target, see ``REMEMBERS``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel
from clothgym.checks import shown
from clothgym.collisions import Collider, Plane
from clothgym.envs.episode import Fields
from clothgym.envs.measures import CENTROID, SPEED2, count_layers, soft_coverage
from clothgym.envs.observing import POSITION_BOUND, Observation
from clothgym.envs.physics import MEDIAN, Physics
from clothgym.envs.reference import EVALUATED_POINTS, limits, reference_coverage
from clothgym.envs.scoring import ENOUGH_REST, SPEED_SCALE, TIME, falloff, observe_time
from clothgym.envs.targets import FRICTION, ON_FLOOR, SHAPES, THICKNESS, Target, placed, unit_normals, unit_surface
from clothgym.envs.task import Task
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid

# settings of both ids, without the attachments
PHYSICS = Physics(
    mesh=grid(17, 17, 0.6, 0.6),
    material=MEDIAN,
    time_step=1 / 30,
    integrator="semi_implicit_euler",
    substeps=50,
    attachment_speed=1.0,
    fast={"material": Material.preset("penava_cotton", air_drag=0.72), "air_density": 0.0, "substeps": 50},
)

GUIDE_POINTS = 32
CENTERING_SCALE = 0.2  # in sides: performance is halved at this distance
# of the reference's coverage; of the covered points under one layer; in sides
ENOUGH_COVERAGE, ENOUGH_SPREAD, ENOUGH_CENTERING = 0.9, 0.9, 0.1

RELEASE_ABOVE = 0.8  # an action above this opens the anchor; high, so that random actions seldom release the sheet early
BOX = SHAPES.index("box")
TARGET_SLOT = 1  # the target's place among ``colliders``

# of the target: index in SHAPES, size, highest point [m], yaw as an angle and as (cos, sin), and the reference coverage
REMEMBERS: Fields = [
    *[("solid", np.int64), ("radius", float), ("top", float, 3), ("yaw", float), ("turn", float, 2), ("reference", float)],
]


def observations(attachments: int, holds: str) -> tuple[Observation, ...]:
    """The observations in addition to the points of the sheet; holds: description of the flags of the attachments."""
    return (
        Observation("center", "center of area, relative to the target's top", (3,), "L", POSITION_BOUND),
        Observation("holds", holds, (attachments,)),
        Observation("target_shape", ", ".join(SHAPES), (len(SHAPES),)),
        Observation("target_radius", "the target's radius or half side", (), "L"),
        Observation("target_height", "its height", (), "L"),
        Observation("target_yaw", "its yaw", (), "45 degrees"),
        *TIME,
    )


def upper_corners(mesh: ClothMesh) -> tuple[int, ...]:
    """The particles at the ends of the edge that goes over the target first."""
    return mesh.corners[2:]


# --- anchors that may be opened -----------------------------------------------------------------------------------------------


@inlined
def let_go(own, rules, sheet, move, free):
    """Open the anchors that the action opens, or all when time is up."""
    for k in range(free.shape[0]):
        if sheet.holds[k] > 0 and (move[k, 3] > RELEASE_ABOVE or own.step >= rules.acting_steps):
            free[k], sheet.holds[k] = 1, 0


# --- the target of an episode -------------------------------------------------------------------------------------------------


def checked_shapes(shapes: Any) -> tuple[str, ...]:
    """Check shapes of targets: one name, or a sequence of several.

    Raises:
        ValueError: the sequence is empty or has an unknown shape.
    """
    given = (shapes,) if isinstance(shapes, str) else shapes
    if not isinstance(given, Sequence) or not given or any(shape not in SHAPES for shape in given):
        raise ValueError(f"shapes={shown(shapes)}: must be one or more of {', '.join(SHAPES)}")
    return tuple(given)


def recalled(own: Any) -> Target:
    """The target of an episode, from its record."""
    *center, height = own["top"].tolist()
    return Target(SHAPES[int(own["solid"])], float(own["radius"]), height, tuple(center), float(own["yaw"]))


class DrapingTask(Task):
    """Base of both tasks.

    Args:
        shapes: shapes of targets that episodes draw from.

    Attributes:
        guide_reach: distance at which a guide point counts half, in sides.
    """

    guide_reach: ClassVar[float]
    points_relative_to = "the target's top"
    evaluation = (
        *[("coverage", float), ("coverage_reference", float), ("spread", float), ("off_center", float), ("rms_speed", float)],
    )
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"solid": (0, len(SHAPES) - 1)}
    reset_options: ClassVar[tuple[str, ...]] = ("material", "target")
    arguments: ClassVar[Mapping[str, str]] = {"shapes": "shapes of targets that episodes draw from"}

    def __init__(self, num_envs: int, shapes: str | Sequence[str] = SHAPES, **kwargs: Any) -> None:
        self.shapes = checked_shapes(shapes)
        super().__init__(num_envs, **kwargs)

    @property
    def targets(self) -> list[Target]:
        """The targets of the episodes."""
        return [recalled(own) for own in self.episode]

    def colliders(self) -> list[Collider]:
        """The floor, and a target that each episode replaces by its own."""
        floor, side = Plane(friction=FRICTION, thickness=ON_FLOOR), self.physics.side
        return [floor, Target("sphere", 0.25 * side, 0.5 * side, (0.0, 0.0)).collider(FRICTION, THICKNESS)]

    def working_area(self) -> tuple[NDArray, float]:
        # the sheet starts in front of the target, which is near the origin
        return np.array([0.0, -0.35 * self.physics.side]), 1.3 * self.physics.side

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        return {TARGET_SLOT: recalled(self.episode[env]).collider(FRICTION, THICKNESS)}

    def remembers(self) -> Fields:
        return [*super().remembers(), *REMEMBERS]

    def check_episode(self, env: int, own: Any) -> None:
        target = recalled(own)
        turn = np.array([np.cos(target.yaw), np.sin(target.yaw)])
        if np.abs(own["turn"] - turn).max() > 1e-9 or own["reference"] != reference_coverage(target, self.physics):
            raise ValueError(
                "the state's target has another turn or reference than its size and yaw give: give what get_state() gave"
            )

    def constants(self) -> dict[str, Any]:
        guides, evaluated, normals = (
            np.stack([np.resize(unit(shape, count), (count, 3)) for shape in ("sphere", "box")])
            for unit, count in ((unit_surface, GUIDE_POINTS), (unit_surface, EVALUATED_POINTS), (unit_normals, EVALUATED_POINTS))
        )
        surface, side = {"guides": guides, "evaluated": evaluated, "normals": normals}, self.physics.side
        own = {"guide_reach": np.float32(self.guide_reach * side), "judged_within": limits(side)}
        return super().constants() | own | surface

    def draw_target(self, env: int, rng: np.random.Generator, wanted: Any) -> Target:
        """Draw the target of an environment's episode, with the properties in ``wanted`` fixed, and write it to its record.

        Raises:
            ValueError: ``wanted`` is no dict of a target's properties.
        """
        known = ("shape", "radius", "height", "center", "yaw")
        if not isinstance(wanted, Mapping):
            raise ValueError(f"reset option target={shown(wanted)}: must be a dict with any of {', '.join(known)}")
        unknown = set(wanted) - set(known)
        if unknown:
            raise ValueError(f"unknown key {sorted(unknown)[0]!r} of the reset option 'target' (there are: {', '.join(known)})")
        side, own = self.physics.side, self.episode[env]
        target = Target.draw(rng, side, 0.25 * side, wanted.get("shape"), self.shapes).changed(wanted)
        own["solid"], own["radius"], own["yaw"] = SHAPES.index(target.shape), target.radius, target.yaw
        own["top"] = own["origin"] = target.top
        own["turn"] = np.cos(target.yaw), np.sin(target.yaw)
        own["reference"] = reference_coverage(target, self.physics)
        return target


# --- kernels about one environment, see ``stepping`` --------------------------------------------------------------------------


@inlined
def _surface_of(own, units):
    """Points of the target's upper surface, as ``placed`` takes them; units: those of a round one and of a box."""
    return units[1 if own.solid == BOX else 0], own.top, own.radius, own.turn


@kernel
def _nearness(x, surface, reach):
    """Nearness of the sheet to points of the target's upper surface, see ``soft_coverage``."""
    points = placed(*surface)
    return soft_coverage(x, points, reach)


@kernel
def _coverage(x, triangles, surface, normals, within):
    """Share of the points of the target's upper surface that are covered, and of these the share under one layer of the sheet.

    normals: those of a unit surface.  within: see ``reference.limits``.
    """
    _, _, _, turn = surface
    layers = np.empty(normals.shape[0], np.int64)
    count_layers(x, triangles, placed(*surface), placed(normals, np.zeros(3), 1.0, turn), within, layers)
    # both shares
    covered, once = 0, 0
    for k in range(layers.shape[0]):
        covered += layers[k] > 0
        once += layers[k] == 1
    return covered / layers.shape[0], once / max(covered, 1)


@inlined
def _off_center(own, rules, sheet):
    """Horizontal distance of the sheet's center of area from the target's axis, in sides."""
    x, y = sheet.summary[CENTROID] - own.top[0], sheet.summary[CENTROID + 1] - own.top[1]
    return np.sqrt(x * x + y * y) / rules.side


@inlined
def covering(own, rules, sheet):
    """Nearness of the sheet to the target's upper surface, and its centering, in [0, 1]."""
    near = _nearness(sheet.x, _surface_of(own, rules.guides), rules.guide_reach)
    return (near + 1 / falloff(_off_center(own, rules, sheet), CENTERING_SCALE)) / 2


@inlined
def evaluate_cover(own, rules, sheet, info):
    """Write coverage, spread, centering and speed of the sheet; returns the normalized performance."""
    surface, normals = _surface_of(own, rules.evaluated), rules.normals[1 if own.solid == BOX else 0]
    info.coverage, info.spread = _coverage(sheet.x, sheet.mesh.triangles, surface, normals, rules.judged_within)
    info.off_center = _off_center(own, rules, sheet)
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    # success by thresholds; the performance is a smooth product of the same four
    share = info.coverage / own.reference
    covered, flat = share >= ENOUGH_COVERAGE, info.spread >= ENOUGH_SPREAD
    info.is_success = covered and flat and info.off_center <= ENOUGH_CENTERING and info.rms_speed < ENOUGH_REST
    performance = min(share, 1.0) * info.spread * (1 / falloff(info.off_center, CENTERING_SCALE))
    return performance / falloff(info.rms_speed, SPEED_SCALE)


@inlined
def account_reference(own, rules, sheet, info, terms, running, failure):
    """The reference coverage of this target; no reward terms."""
    info.coverage_reference = own.reference
    return 0.0


@inlined
def observe_target(own, rules, sheet, seen):
    """The sheet's center, its attachments, the target, and the time."""
    # the sheet and its attachments
    for c in range(3):
        seen.center[c] = (sheet.summary[CENTROID + c] - own.top[c]) / rules.side
    for k in range(sheet.holds.shape[0]):
        seen.holds[k] = sheet.holds[k] > 0
    # the target: its shape among all, size and yaw
    for k in range(len(SHAPES)):
        seen.target_shape[k] = own.solid == k
    seen.target_radius, seen.target_height = own.radius / rules.side, own.top[2] / rules.side
    seen.target_yaw = own.yaw * (4 / np.pi)
    observe_time(own, rules, seen)

"""ClothFold-v0 and ClothFold-Hard-v0: fold a sheet on the floor in half, along its diagonal, or twice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel
from clothgym.checks import one_of
from clothgym.envs import pick_place
from clothgym.envs.coverage import FINE_CELL, shared_area
from clothgym.envs.episode import FINE, Fields, length
from clothgym.envs.experts import as_actions
from clothgym.envs.framing import DirectedTask
from clothgym.envs.gripper_task import LARGE_SILK, PHYSICS, REACH, ManipulationTask, close_or_open, observe_grippers
from clothgym.envs.measures import SPEED2
from clothgym.envs.observing import Observation
from clothgym.envs.scoring import ENOUGH_REST, SPEED_SCALE, falloff, follow, grasp
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels

if TYPE_CHECKING:
    from clothgym.render import Camera

FOLDS = ("half", "diagonal", "quarter")
ACTING_STEPS = {"half": 80, "diagonal": 90, "quarter": 150}
# largest distance of a point of the sheet from its place and mean height over the floor, in sides
ENOUGH_FOLDED, ENOUGH_FLAT = {"half": 0.1, "diagonal": 0.1, "quarter": 0.15}, 0.05
PICKING = 0.3  # share of the potential for grasping

# the scripted expert: height of its arc relative to a half circle; distance from the end at which it opens, and distance at which
# points count as joined, in sides; look-ahead along the arc, and the arc's lowest height in each fold [m]: cloth pressed onto the
# layers below jumps when it is released
EXPERT_ARC, EXPERT_NEAR, EXPERT_MET = 0.9, 0.03, 0.1
EXPERT_STEP, EXPERT_LOW = 0.03, (0.015, 0.018)
EXPERT_DONE = 0.9  # best score of an episode above which the expert stops


# --- the ideal folds ----------------------------------------------------------------------------------------------------------


def ideals(fold: str, points: NDArray) -> NDArray[np.float64]:
    """Positions of a sheet's points in the ideal folds of that name, thin and flat [m], (ways, points, 2).

    points: in the flat sheet, about its center [m], (points, 2).  ways: the folds over each of four edges, corners or both.
    """
    u, v = points[:, 0], points[:, 1]
    if fold == "half":
        ways = [(u, -abs(v)), (u, abs(v)), (-abs(u), v), (abs(u), v)]
    elif fold == "diagonal":
        least, most = np.minimum(u, v), np.maximum(u, v)
        over = np.where(u + v > 0, (-v, -u), (u, v))
        ways = [tuple(over), (most, least), (least, most), tuple(np.where(u + v < 0, (-v, -u), (u, v)))]
    else:
        ways = [(a * abs(u), b * abs(v)) for a in (-1, 1) for b in (-1, 1)]
    return np.array([np.stack(way, axis=1) for way in ways])


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@kernel
def aligned(x, share, ideal, placed):
    """Align an ideal fold with a sheet, by a rotation and a translation in the plane; returns the mean distance.

    The motion minimizes the mean squared distance, in closed form in the plane: with both centered, the rotation's cosine and sine
    are proportional to the sums of dot and cross products (Umeyama 1991, in two dimensions, without scaling).
    x: of the sheet [m], (3, particles).  share: of the area, by particle.  ideal: (particles, 2).  placed: out, (3, particles).
    """
    # both centers
    cx = cy = px = py = 0.0
    for p in range(x.shape[1]):
        cx += share[p] * x[0, p]
        cy += share[p] * x[1, p]
        px += share[p] * ideal[p, 0]
        py += share[p] * ideal[p, 1]
    # the rotation
    dot, cross = 0.0, 0.0
    for p in range(x.shape[1]):
        a, b = ideal[p, 0] - px, ideal[p, 1] - py
        u, v = x[0, p] - cx, x[1, p] - cy
        dot += share[p] * (a * u + b * v)
        cross += share[p] * (a * v - b * u)
    size = max(np.sqrt(dot * dot + cross * cross), 1e-30)
    c, s = dot / size, cross / size
    # the aligned ideal, and the horizontal distance of the sheet's points from it
    total = 0.0
    for p in range(x.shape[1]):
        a, b = ideal[p, 0] - px, ideal[p, 1] - py
        placed[0, p], placed[1, p], placed[2, p] = cx + c * a - s * b, cy + s * a + c * b, 0.0
        total += share[p] * np.sqrt((x[0, p] - placed[0, p]) ** 2 + (x[1, p] - placed[1, p]) ** 2)
    return total


@kernel
def nearest_fold(x, share, folds, placed):
    """The least mean distance from the ideal folds [m], and the index of that fold; ``placed`` receives it, (3, particles)."""
    best, way = np.inf, 0
    for k in range(folds.shape[0]):
        error = aligned(x, share, folds[k], placed)
        if error < best:
            best, way = error, k
    aligned(x, share, folds[way], placed)
    return best, way


@apart
def fold_errors(x, share, folds):
    """Mean and largest horizontal distance of a sheet from the nearest ideal fold, and its mean height [m]."""
    placed = np.empty(x.shape, np.float64)
    error, _ = nearest_fold(x, share, folds, placed)
    worst, height = 0.0, 0.0
    for p in range(x.shape[1]):
        worst = max(worst, (x[0, p] - placed[0, p]) ** 2 + (x[1, p] - placed[1, p]) ** 2)
        height += share[p] * x[2, p]
    return error, np.sqrt(worst), height


@apart
def overlap(x, share, folds, triangles, cell):
    """Intersection over union of the floor areas below a sheet and the nearest ideal fold; cell: of the grid [m]."""
    placed = np.empty(x.shape, np.float64)
    nearest_fold(x, share, folds, placed)
    both, either = shared_area(x, placed, triangles, cell)
    return both / either


@inlined
def _measure(own, rules, sheet):
    """Distances of the sheet from its nearest ideal fold, and its height, in sides."""
    error, worst, height = fold_errors(sheet.unit, sheet.mesh.share, rules.folds)
    own.error, own.worst, own.height = error / rules.side, worst / rules.side, height / rules.side


@inlined
def _folded(own, rules):
    """Progress of the fold, in [0, 1]: 0 for the flat sheet, 1 for the ideal."""
    return min(max(1 - own.error / rules.unfolded, 0.0), 1.0)


@inlined
def _reached(own, rules):
    """Whether every point is near its place, and the sheet flat."""
    return own.worst <= rules.enough and own.height <= ENOUGH_FLAT


@inlined
def _potential(own, rules, sheet):
    """Progress of grasping and of the fold."""
    taken = 0.0
    for k in range(rules.places.shape[0]):
        taken += grasp(sheet.holder[rules.places[k]] >= 0, rules, sheet, k)
    return PICKING * taken / rules.places.shape[0] + (1 - PICKING) * _folded(own, rules)


@inlined
def evaluate_fold(own, rules, sheet, info):
    """Write the error of the fold, its overlap with the ideal and its speed; returns the normalized performance."""
    info.overlap = overlap(sheet.unit, sheet.mesh.share, rules.folds, sheet.mesh.triangles, FINE_CELL)
    info.fold_error_mm = 1000 * own.error * rules.side * sheet.size
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    info.is_success = _reached(own, rules) and info.rms_speed < ENOUGH_REST
    flat = 1 / (1 + (own.height / ENOUGH_FLAT) ** 4)
    return _folded(own, rules) * flat / falloff(info.rms_speed, SPEED_SCALE)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    """The errors after this step, and whether a success lasts; no reward terms."""
    info.fold_error, info.fold_error_max, info.height = own.error, own.worst, own.height
    follow(own, info, _folded(own, rules), failure == FINE and _reached(own, rules), running, failure)
    return 0.0


@inlined
def _observe(own, rules, sheet, seen):
    """The grippers, and the displacements from their tips to the corners that they grasp first."""
    observe_grippers(own, rules, sheet, seen)
    for k in range(rules.places.shape[0]):
        for c in range(3):
            seen.ways[k, c] = (sheet.x[c, rules.places[k]] - sheet.attachments[k, c]) * (10 / rules.side)


def along_arc(way: NDArray, height: NDArray, whole: NDArray, low: float) -> tuple[NDArray, NDArray]:
    """The expert's next step on an arc to a goal [m], (..., 3), and the remaining horizontal distance [m], (...).

    The step moves ``EXPERT_STEP`` ahead, to the arc's height there.  way: from each tip to its goal [m], (..., 3).  height: of the
    tips [m].  whole: width of the arcs [m].  low: height of their ends [m].
    """
    left = np.sqrt(way[..., 0] ** 2 + way[..., 1] ** 2)
    ahead = np.clip(left - EXPERT_STEP, 0, whole)
    step = way * np.minimum(1, EXPERT_STEP / np.maximum(left, 1e-9))[..., None]
    step[..., 2] = EXPERT_ARC * np.sqrt(ahead * (whole - ahead)) + low - height
    return step, left


class FoldingTask(DirectedTask, ManipulationTask):
    """Base of the tasks that end with a folded sheet on the floor.

    Attributes:
        stages: for each consecutive fold, the particle that each gripper takes, and the particle that it moves it to.
        below: the particles above which the grippers begin.
        enough: largest distance of a point of the sheet from its place, in sides.
        expert_low: lowest height of the expert's arc in each fold [m].
    """

    kernels = Kernels(_potential, evaluate_fold, _observe, measure=_measure, account=_account, fingers=close_or_open)
    settling_steps = 60
    resizes = True
    arguments: ClassVar = {**ManipulationTask.arguments, **DirectedTask.arguments}
    direction = "the sheet's own x axis as it lies at the start"
    observations = (
        *ManipulationTask.observations,
        Observation("ways", "from each tip to the corner that it grasps first", (2, 3), "L/10", 40.0, turns=1),
    )
    points_relative_to = "the initial center of the sheet"
    evaluation: ClassVar[Fields] = (("overlap", float), ("fold_error_mm", float), ("rms_speed", float))
    accounts: ClassVar[Fields] = (
        ("fold_error", float), ("fold_error_max", float), ("height", float), *ManipulationTask.accounts,
    )  # fmt: skip
    away: ClassVar[float] = 0.15  # largest distance of the sheet's center from the origin along x and y, in sides
    turned: ClassVar[float] = np.pi / 4  # largest yaw of the sheet [rad]
    stages: list[list[tuple[int, int]]]
    below: list[int]
    enough: float
    expert_low: ClassVar[tuple[float, ...]] = EXPERT_LOW

    def ideals(self, points: NDArray) -> NDArray[np.float64]:
        """Positions in the ideal folds [m], (ways, points, 2), of points of the flat sheet about its center [m], (points, 2)."""
        raise NotImplementedError

    def remembers(self) -> Fields:
        # the initial turn of the sheet, and the present errors
        return [*super().remembers(), ("turn", float, 2), ("error", float), ("worst", float), ("height", float)]

    def constants(self) -> dict[str, Any]:
        mesh = self.physics.mesh
        flat = mesh.rest_positions[:, :2] - mesh.rest_positions[:, :2].mean(axis=0)
        folds, share = self.ideals(flat), (mesh.area / mesh.area.sum()).astype(np.float32)
        x = np.ascontiguousarray(np.concatenate([flat, np.zeros((len(flat), 1))], axis=1).T)
        unfolded, _ = nearest_fold(x, share, folds, np.empty_like(x))
        places = np.array([taken for taken, _ in self.stages[0]])
        return {"folds": folds, "unfolded": unfolded / self.physics.side, "places": places, "enough": self.enough}

    # --- reset ----------------------------------------------------------------------------------------------------------

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        x, center, turn = self.lie_flat(env, rng, self.away, self.turned)
        self.episode["origin"][env], self.episode["turn"][env] = (*center, 0), turn
        self.hover(env, rng, x[self.below])
        return self.uneven(x, rng)

    def heading(self) -> NDArray[np.float64]:
        return self.episode["turn"]

    def _began(self) -> NDArray:
        """Initial positions of the sheet's points [m], (num_envs, particles, 3)."""
        rest, turn = self.physics.mesh.rest_positions, self.episode["turn"][:, None]
        u, v, _ = (rest - rest.mean(axis=0)).T
        across = np.stack([turn[..., 0] * u - turn[..., 1] * v, turn[..., 1] * u + turn[..., 0] * v, 0 * turn[..., 0] * u], axis=2)
        return self.episode["origin"][:, None] + self.sizes()[:, None, None] * across

    # --- expert and picture ---------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """Move each corner along an arc onto its goal, and then leave; one fold after the other.

        The expert has no memory: a fold is done when its particles are joined, and are not held apart from each other.
        """
        holder, side = self.simulation.grippers.holder, self.physics.side
        x, tips = self.simulation.positions.astype(np.float64), self.simulation.grippers.positions.astype(np.float64)
        # goals are initial positions of the sheet's points: the points there now may be dragged along, out of reach
        rest, began = self.physics.mesh.rest_positions, self._began()
        # up and open, except the grippers of the first unfinished fold
        move, closed = np.tile([0.0, 0.0, 0.1], (self.num_envs, 2, 1)), np.zeros((self.num_envs, 2), bool)
        # a finished and released fold is not grasped again
        found = (self.episode["best"] > EXPERT_DONE) & ~np.logical_or.reduce(holder >= 0, axis=1)
        for low, stage in zip(self.expert_low, self.stages):
            taken, goals = (np.array(part) for part in zip(*stage))
            count, whole = len(stage), self.sizes()[:, None] * length(rest[taken] - rest[goals])
            place, tip = x[:, taken], tips[:, :count]
            met, held = length(x[:, goals] - place) < EXPERT_MET * side, holder[:, taken] >= 0
            apart = held & (holder[:, goals] < 0)
            now = ~found & ~(np.logical_and.reduce(met, axis=1) & ~np.logical_or.reduce(apart, axis=1))
            found |= now
            step, left = along_arc(began[:, goals] - tip, tip[..., 2], whole, low)
            # grippers that hold their particle wait for the others, at the start and at the end
            to_place = place - tip
            all_held = np.logical_and.reduce(held, axis=1, keepdims=True)
            there = held & (left < EXPERT_NEAR * side) & (tip[..., 2] < low + 0.02)
            all_there = np.logical_and.reduce(there, axis=1, keepdims=True)
            going = np.where(all_held[..., None], step, np.where(held[..., None], 0.0, to_place / 2))
            away = met & ~held
            move[now, :count] = np.where(away[..., None], (0.0, 0.0, 0.1), going)[now]
            closed[now, :count] = (((length(to_place) < REACH / 2) & ~away | held) & ~all_there)[now]
        return as_actions(self, move, np.where(closed, -1.0, 1.0))

    def expert_picks(self) -> NDArray:
        """Pick the corners of the first unfinished fold and place them on their goals; else pick nothing, next to the sheet."""
        side, half = self.physics.side, self.workspace * self.physics.side
        x, rest, began = self.simulation.positions.astype(np.float64), self.physics.mesh.rest_positions, self._began()
        actions = np.ones((self.num_envs, len(self.physics.grippers), pick_place.NUMBERS))
        found = self.episode["best"] > EXPERT_DONE
        for stage in self.stages:
            taken, goals = (np.array(part) for part in zip(*stage))
            now = ~found & ~np.logical_and.reduce(length(x[:, goals] - x[:, taken]) < EXPERT_MET * side, axis=1)
            found |= now
            for k, (particle, goal) in enumerate(stage):
                lift = EXPERT_ARC / 2 * self.sizes()[now] * length(rest[particle] - rest[goal])
                actions[now, k, 0:2], actions[now, k, 2:4] = x[now, particle, :2] / half, began[now, goal, :2] / half
                actions[now, k, 4] = 2 * lift / side - 1
        return np.clip(actions, -1, 1).reshape(self.num_envs, -1)

    def camera(self) -> Camera:
        from clothgym.render import Camera  # imported here: training draws nothing

        far = self.physics.side / PHYSICS.side
        return Camera(eye=(0.9 * far, -1.35 * far, 1.05 * far), target=(0.0, 0.0, 0.05), vertical_fov=36.0)


class FoldTask(FoldingTask):
    """The task of ``ClothFold-v0``, see ``ClothFoldEnv``.

    Args:
        fold: one of ``FOLDS``.
    """

    arguments: ClassVar = {**FoldingTask.arguments, "fold": '``"half"``, ``"diagonal"`` or ``"quarter"``: in half twice'}
    acting: ClassVar[Mapping[str, int]] = ACTING_STEPS  # steps for each fold

    def __init__(self, num_envs: int, fold: str = "half", **kwargs: Any) -> None:
        one_of("fold", fold, *FOLDS)
        self.fold, self.acting_steps, self.enough = fold, self.acting[fold], ENOUGH_FOLDED[fold]  # type: ignore[misc]
        super().__init__(num_envs, **kwargs)

    @property
    def stages(self) -> list[list[tuple[int, int]]]:  # type: ignore[override]
        lower_left, lower_right, left, right = self.physics.mesh.corners
        if self.fold == "diagonal":
            return [[(right, lower_left)]]
        first = [(left, lower_left), (right, lower_right)]
        if self.fold == "half":
            return [first]
        # the ends of the crease and of the joined edges
        rows, columns = self.physics.mesh.grid_shape
        middle = (rows // 2) * columns
        return [first, [(middle, middle + columns - 1), (lower_left, lower_right)]]

    @property
    def below(self) -> list[int]:  # type: ignore[override]
        return list(self.physics.mesh.corners[2:])

    def ideals(self, points: NDArray) -> NDArray[np.float64]:
        return ideals(self.fold, points)


class FoldHardTask(FoldTask):
    """The task of ``ClothFold-Hard-v0``, see ``ClothFoldHardEnv``.

    Args:
        fold: as ``FoldTask`` takes it.
    """

    physics = LARGE_SILK
    acting: ClassVar[Mapping[str, int]] = {"half": 100, "diagonal": 120, "quarter": 190}
    settling_steps = 90
    away = 0.25
    turned = np.pi

    def __init__(self, num_envs: int, fold: str = "quarter", **kwargs: Any) -> None:
        super().__init__(num_envs, fold=fold, **kwargs)


class ClothFoldEnv(ClothEnv):
    """Fold a sheet on the floor in half; with fold=, along its diagonal or twice.

    ## Description
    A sheet of 0.6 m lies flat on the floor, turned and off center.  Two grippers hover above the corners of one edge.  ``fold``
    selects the fold: in half, over the diagonal, or in half twice.  When the time is up the fingers open, and the sheet settles
    for two seconds, in which actions are ignored; then it is evaluated.  Holding the fold in place until then is as good as
    releasing it earlier.

    $physics

    ## Rewards
    $rewards

    During the episode the potential is 0.7 times ``1 - e/e0``, see below, plus 0.3 times the mean over the first corners to be
    grasped of 1 for a held corner, else ``1/2 / (1 + (d/0.15 L)^2)`` with its gripper's distance d.

    ## Evaluation
    Each point of the sheet has a horizontal position in the ideal fold, which is thin and flat.  The ideal fold is the nearest one:
    over any of the four edges or corners, translated and rotated on the floor as a whole, so that the mean squared distance
    is least (Umeyama 1991).  ``info["fold_error"]`` is the mean horizontal distance e of the sheet's points from their positions,
    by area, in sides, ``fold_error_max`` the largest, ``height`` the mean height over the floor, all three after every step.  At
    the end there are also ``fold_error_mm``, in millimeters, ``overlap``, the intersection over union of the floor areas below the
    sheet and the ideal, and ``rms_speed`` in m/s.

    Success: ``fold_error_max`` at most 0.1 (0.15 for the quarter, of four layers), ``height`` at most 0.05, and ``rms_speed`` below
    0.02 m/s.  ``info["best"]`` is the episode's best ``1 - e/e0``, ``first_success`` the first step with both distances small
    enough, or -1, and ``success_held`` whether they have been small enough ever since.

    ``info["normalized_performance"]`` is ``(1 - e/e0) / (1 + (height/0.05)^4) / (1 + (rms_speed/0.1)^2)``, with the error e0 of the
    flat sheet: 0 for no action, 1 for the ideal.

    ## Starting State
    The sheet's center is up to 0.15 L from the origin along x and y, and it is turned by up to 45 degrees.  The grippers are open,
    displaced from their corners by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.
    """

    task_class = FoldTask


class ClothFoldHardEnv(ClothEnv):
    """Fold a large silk sheet on the floor, turned by any angle, in half twice.

    ## Description
    This task differs from ``ClothFold-v0`` in the sheet, L = 0.8 m (21 x 21 particles), its fabric, silk
    (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), its start, and the default of ``fold``, which is the quarter:
    two consecutive folds, the second of two layers.  The sheet settles for three seconds.

    $physics

    ## Rewards
    As in ``ClothFold-v0``.

    ## Evaluation
    As in ``ClothFold-v0``, with the same ``info``.

    ## Starting State
    The sheet's center is up to 0.25 L from the origin along x and y, and it is turned by any angle.  The grippers are open,
    displaced from the corners of one edge by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.
    """

    task_class = FoldHardTask

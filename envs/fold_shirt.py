"""ClothFoldShirt-v0 and ClothFoldShirt-Hard-v0: fold a T-shirt, shorts, trousers or a towel in half, left over right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined
from clothgym.checks import known, number, one_of, shown
from clothgym.envs.episode import Fields
from clothgym.envs.fold import FoldingTask, evaluate_fold
from clothgym.envs.gripper_task import PHYSICS
from clothgym.envs.physics import MEDIAN, chosen_fabric
from clothgym.envs.single import ClothEnv
from clothgym.envs.task import Task
from clothgym.garments import RANGES, USUAL_THICKNESS, Garment, make
from clothgym.mesh import ClothMesh

SPACING = 0.04  # of the particles [m]
# of each garment: sizes that are not the middles of their ranges, and the key points that grippers take, without their sides
SIZES: dict[str, dict[str, float]] = {"tshirt": {"chest_width": 0.42, "length": 0.64}, "shorts": {}, "trousers": {}, "towel": {}}
TAKEN = {
    "tshirt": ("sleeve_top", "waist"), "shorts": ("waist", "pipe_outer"), "trousers": ("waist", "pipe_outer"),
    "towel": ("top", "bottom"),
}  # fmt: skip


def garment_named(name: str, sizes: Mapping[str, float] | None = None) -> Garment:
    """The garment of that name in ``SIZES``; sizes: others than those, within the ranges of random garments.

    Raises:
        ValueError: unknown sizes, or out of these ranges.
    """
    if sizes is not None and not isinstance(sizes, Mapping):
        raise ValueError(f"sizes={shown(sizes)}: must be a dict, for instance {{'length': 0.7}}")
    chosen = {}
    for each, value in (sizes or {}).items():
        known(f"size of {name}", each, RANGES[name])
        low, high = RANGES[name][each]
        chosen[each] = number(f"sizes: {each}", value)
        if not low <= chosen[each] <= high:
            raise ValueError(f"sizes: {each}={shown(value)}: must be from {low:g} to {high:g}, the range of random garments")
    return _garment(name, tuple(sorted(chosen.items())))


@lru_cache(maxsize=64)
def _garment(name: str, sizes: tuple[tuple[str, float], ...]) -> Garment:
    return make(name, SPACING, sizes=SIZES[name] | dict(sizes))


def refuse_sheet(garment: Garment, kwargs: Mapping[str, Any]) -> None:
    """Refuse ``rows`` and ``side``, by which another grid would replace a towel's mesh; other garments' meshes refuse them."""
    given = [f"{name}={shown(kwargs[name])}" for name in ("rows", "side") if kwargs.get(name) is not None]
    if given and garment.mesh.shape is not None:
        raise ValueError(f"{', '.join(given)}: a garment has one mesh; leave them out")


# what episodes of the harder task draw
HARD = {"size": [0.85, 1.15], "density": [0.1, 0.2], "bend_rigidity": [3e-7, 3e-6], "friction": [0.3, 0.7]}


# --- the ideal folds, and the measures of others ------------------------------------------------------------------------------


def layers(garment: Garment) -> int:
    """Of cloth: two panels, or one of a towel."""
    return 1 if np.ptp(garment.mesh.rest_positions[:, 2]) == 0 else 2


def folded(garment: Garment) -> NDArray[np.float64]:
    """Positions of a garment folded in half, left over right and right over left, in thin layers [m], (2, particles, 3)."""
    u, v, z = garment.mesh.rest_positions.T
    thickness, count = USUAL_THICKNESS * SPACING, layers(garment)
    layer = thickness * (count - 1) * (z - z.min()) / max(np.ptp(z), 1e-30)
    top = (2 * count - 1) * thickness
    ways = [(np.maximum(u, -u), u < 0), (np.minimum(u, -u), u > 0)]
    return np.array([np.stack([across, v, np.where(over, top - layer, layer)], axis=1) for across, over in ways])


@apart
def compared(x, goals):
    """Least mean distance [m] and least mean squared coordinate error [m^2] of a sheet's particles from folded positions.

    Both after the best rotation about z and shift along the floor, for which the sum of squares is least; the second also after the
    best shift along z.  x: [m], (3, particles).  goals: (ways, particles, 3).
    """
    count = x.shape[1]
    nearest, least = np.inf, np.inf
    for way in range(goals.shape[0]):
        goal = goals[way]
        # both centers
        one, two = np.zeros(3), np.zeros(3)
        for p in range(count):
            for c in range(3):
                one[c] += x[c, p] / count
                two[c] += goal[p, c] / count
        # the rotation, in closed form as in ``fold.aligned``: sums of dot and cross products
        along, across = 0.0, 0.0
        for p in range(count):
            a, b = x[0, p] - one[0], x[1, p] - one[1]
            u, v = goal[p, 0] - two[0], goal[p, 1] - two[1]
            along += u * a + v * b
            across += u * b - v * a
        size = max(np.sqrt(along * along + across * across), 1e-30)
        c, s = along / size, across / size
        # the distances after it, and the squares also after the shift along z
        total, squares = 0.0, 0.0
        for p in range(count):
            u, v = goal[p, 0] - two[0], goal[p, 1] - two[1]
            dx = x[0, p] - one[0] - (c * u - s * v)
            dy = x[1, p] - one[1] - (s * u + c * v)
            dz = x[2, p] - goal[p, 2]
            shifted = dz - (one[2] - two[2])
            total += np.sqrt(dx * dx + dy * dy + dz * dz)
            squares += dx * dx + dy * dy + shifted * shifted
        nearest, least = min(nearest, total / count), min(least, squares / (3 * count))
    return nearest, least


@inlined
def _evaluate(own, rules, sheet, info):
    """Write what ``fold`` measures, and the distances from the folded garment; returns the normalized performance."""
    distance, info.peer_foldnet = compared(sheet.unit, rules.goals)
    info.vertex_distance = distance / rules.root_area
    return evaluate_fold(own, rules, sheet, info)


class FoldShirtTask(FoldingTask):
    """The task of ``ClothFoldShirt-v0``, see ``ClothFoldShirtEnv``.

    Args:
        garment: one of ``SIZES``.
        sizes: of the garment, others than those in ``SIZES``, in the units of ``clothgym.garments``.

    Raises:
        ValueError: an unknown garment, or sizes outside of the ranges of random garments.
    """

    garment = garment_named("tshirt")
    physics = replace(
        PHYSICS, mesh=garment.mesh, material=chosen_fabric("polyester", MEDIAN), substeps="auto",
        fast={"air_density": 0.0},
    )  # fmt: skip
    kernels = FoldingTask.kernels._replace(evaluate=_evaluate)
    acting_steps = 70
    settling_steps = 40
    picks = 2
    enough = 0.1
    expert_low = (0.03,)
    key_points = "key points of the garment, of ``clothgym.garments``"
    evaluation: ClassVar[Fields] = (*FoldingTask.evaluation, ("vertex_distance", float), ("peer_foldnet", float))
    arguments: ClassVar = {
        **FoldingTask.arguments,
        "garment": '``"tshirt"``, ``"shorts"``, ``"trousers"`` or ``"towel"``',
        "sizes": 'of the garment, by name, as ``clothgym.garments`` takes them: ``{"length": 0.7}``',
    }

    def __init__(self, num_envs: int, garment: str = "tshirt", sizes: Mapping[str, float] | None = None, **kwargs: Any) -> None:
        one_of("garment", garment, *SIZES)
        self.garment = garment_named(garment, sizes)
        refuse_sheet(self.garment, kwargs)
        self.physics = replace(self.physics, mesh=self.garment.mesh)  # type: ignore[misc]
        points = self.garment.key_points
        self.stages = [[(points[f"{name}_left"], points[f"{name}_right"]) for name in TAKEN[garment]]]
        self.below = [taken for taken, _ in self.stages[0]]
        super().__init__(num_envs, **kwargs)

    def observed_particles(self, mesh: ClothMesh) -> NDArray:
        """The garment's key points."""
        return np.array(list(self.garment.key_points.values()))

    def ideals(self, points: NDArray) -> NDArray[np.float64]:
        return folded(self.garment)[..., :2]

    def constants(self) -> dict[str, Any]:
        root_area = np.sqrt(self.physics.mesh.area.sum() / layers(self.garment))
        return {**super().constants(), "goals": folded(self.garment), "root_area": root_area}


class ShirtsDrawn(Task):
    """What harder tasks with garments share: episodes draw the size and fabric of the garment, and the floor's friction.

    Args:
        randomize: as all tasks take it; ``HARD`` by default.
    """

    def __init__(self, num_envs: int, randomize: Mapping[str, Sequence[float]] = HARD, **kwargs: Any) -> None:
        super().__init__(num_envs, randomize=randomize, **kwargs)


class FoldShirtHardTask(ShirtsDrawn, FoldShirtTask):
    """The task of ``ClothFoldShirt-Hard-v0``, see ``ClothFoldShirtHardEnv``."""

    acting_steps = 90
    away = 0.25
    turned = np.pi


class ClothFoldShirtEnv(ClothEnv):
    """Fold a T-shirt on the floor in half, left over right, with two grippers.

    ## Description
    A T-shirt of two layers lies flat on the floor, front up, turned and off center.  Two grippers hover above its left sleeve and
    the left end of its hem.  The task is to lay its left half over its right half.  When the time is up the fingers open, and the
    shirt settles, in steps whose actions are ignored; then it is evaluated.  ``garment`` selects shorts or trousers, which the
    grippers take by the left ends of waist and leg, or a towel of one layer, 0.63 m wide and 0.75 m long, by its left corners.

    The shirt is ``clothgym.garments.tshirt(0.04, chest_width=0.42, length=0.64)``: two panels, sewn along shoulders, sleeves and
    sides, and open at neck, hem and cuffs.  ``sizes`` gives it other measures.  All environments of a batch have the same
    proportions; ``randomize`` draws fabrics, and a factor on all lengths.

    $physics

    ## Observation Space
    $observations

    ## Rewards
    $rewards

    During the episode the potential is that of ``ClothFold-v0``.

    ## Evaluation
    Fold error, height, overlap, success, and the normalized performance are defined as for the half fold of ``ClothFold-v0``, with
    ``fold_error_max`` at most 0.1.  The ideal is the garment folded along its middle, left over right or right over left, whichever
    is nearer.  L is the garment's longer side: 0.76 m from cuff to cuff of the T-shirt, 0.64 m of shorts, 0.93 m of trousers, and
    0.75 m of a towel.

    At the end there are also measures of three-dimensional distance from the ideal, whose layers, four of a shirt, are one cloth
    thickness apart: ``info["vertex_distance"]`` is the mean distance of the particles after the best rotation about z and
    translation along the floor, divided by the square root of the area, as in ``clothgym.envs.garment_scores``.
    ``info["peer/foldnet"]`` is the measure of FoldNet: the mean squared error of a coordinate after the best rotation about z and
    translation, in m^2; FoldNet counts at most 0.001 as a success.

    ## Starting State
    The shirt's center is up to 0.15 L from the origin along x and y, and it is turned by up to 45 degrees.  The grippers are open,
    displaced from the points that they take by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.
    """

    task_class = FoldShirtTask


class ClothFoldShirtHardEnv(ClothEnv):
    """Fold a T-shirt of another size and fabric in each episode, turned by any angle, in half, left over right.

    ## Description
    This task differs from ``ClothFoldShirt-v0`` in its start, its time, 90 steps, and in what episodes draw, the default of
    ``randomize``: the size of the shirt, 0.85 to 1.15 times that of ``ClothFoldShirt-v0``; its weight, 100 to 200 g/m^2; its
    bending rigidity, 0.3 to 3 uN m; and the friction of the floor, 0.3 to 0.7.  These replace the values below, and those of a
    ``fabric`` of your own; a ``randomize`` of your own replaces all four ranges.  ``info`` has what was drawn, the observations
    have no number for it.

    $physics

    ## Rewards
    As in ``ClothFoldShirt-v0``.

    ## Evaluation
    As in ``ClothFoldShirt-v0``, with the same ``info``.  Errors are those of the shirt over its size.

    ## Starting State
    The shirt's center is up to 0.25 L from the origin along x and y, and it is turned by any angle.  The grippers are open,
    displaced from the points that they take by up to 0.1 L along x and y and by 0.2 to 0.35 L upward.
    """

    task_class = FoldShirtHardTask

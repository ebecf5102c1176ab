"""ClothFlattenShirt-v0 and ClothFlattenShirt-Hard-v0: spread a crumpled T-shirt, shorts, trousers or a towel on the floor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined
from clothgym.checks import one_of
from clothgym.envs import garment_scores
from clothgym.envs.coverage import softgym_area
from clothgym.envs.episode import Fields
from clothgym.envs.flatten import FlattenTask, evaluate_spread
from clothgym.envs.fold_shirt import SPACING, TAKEN, FoldShirtTask, ShirtsDrawn, garment_named, layers, refuse_sheet
from clothgym.envs.garment_scores import funnels
from clothgym.envs.gripper_task import GripperTask
from clothgym.envs.rumpled import GARMENTS, stored
from clothgym.envs.single import ClothEnv
from clothgym.envs.taking import EDGES, OPPOSITE
from clothgym.garments import Garment
from clothgym.mesh import ClothMesh

# extra costs of an edge by which two panels are lifted, in other particles: of a side, from which a sleeve or a leg hangs down, and
# of the ends of trousers' legs, which are long and swing apart
BY_THE_SIDE, BY_THE_LEGS = 8.0, 30.0


@apart
def facing_up(x, triangles, share):
    """Share of a panel that looks up; x: [m], (3, particles).  share: of the panel's area at rest, by triangle, 0 elsewhere."""
    total = 0.0
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        up = (x[0, b] - x[0, a]) * (x[1, c] - x[1, a]) - (x[1, b] - x[1, a]) * (x[0, c] - x[0, a])
        if up > 0:
            total += share[t]
    return total


@inlined
def evaluate_shirt(own, rules, sheet, info):
    """Write what ``flatten`` measures, the distance of Cloth Funnels, and how far the front looks up; returns the improvement."""
    info.peer_funnels, info.peer_funnels_shape, _ = funnels(sheet.unit, rules.canonical, np.sqrt(rules.flat_area))
    info.face_up = facing_up(sheet.x, sheet.mesh.triangles, rules.front)
    return evaluate_spread(own, rules, sheet, info)


class FlattenShirtTask(FlattenTask):
    """The task of ``ClothFlattenShirt-v0``, see ``ClothFlattenShirtEnv``.

    Args:
        garment: one of ``takes``.

    Raises:
        ValueError: another garment.

    Attributes:
        takes: the garments, of ``rumpled.GARMENTS``.
    """

    takes: ClassVar[tuple[str, ...]] = tuple(GARMENTS)

    garment: Garment = FoldShirtTask.garment
    physics = FoldShirtTask.physics
    kernels = FlattenTask.kernels._replace(evaluate=evaluate_shirt)
    acting_steps = 640
    throws = 4
    enough = 0.9
    entangles = True
    key_points = FoldShirtTask.key_points
    evaluation: ClassVar[Fields] = (
        *FlattenTask.evaluation, ("face_up", float), ("peer_funnels", float), ("peer_funnels_shape", float),
    )  # fmt: skip
    arguments: ClassVar = {**FlattenTask.arguments, "garment": FoldShirtTask.arguments["garment"]}

    def __init__(self, num_envs: int, garment: str = "tshirt", **kwargs: Any) -> None:
        one_of("garment", garment, *self.takes)
        self.garment, self.bank = garment_named(garment), GARMENTS[garment]  # type: ignore[misc]
        refuse_sheet(self.garment, kwargs)
        self.physics = replace(self.physics, mesh=self.garment.mesh)  # type: ignore[misc]
        super().__init__(num_envs, **kwargs)

    def observed_particles(self, mesh: ClothMesh) -> NDArray:
        """The garment's key points."""
        return np.array(list(self.garment.key_points.values()))

    @property
    def corners(self) -> NDArray:
        top, bottom = TAKEN[self.bank.garment]
        return np.array([self.garment.key_points[f"{end}_{side}"] for end in (bottom, top) for side in ("left", "right")])

    @property
    def spacing(self) -> float:
        return SPACING

    def flat_areas(self) -> tuple[float, float]:
        flat = np.ascontiguousarray(self.garment.mesh.rest_positions.T)
        return garment_scores.flat_area(self.garment), float(softgym_area(flat, SPACING))

    def edge_costs(self) -> NDArray[np.float64]:
        costs, legs = super().edge_costs(), BY_THE_LEGS if self.garment.kind == "trousers" else 0.0
        if layers(self.garment) == 2:
            for (one, other), cost in zip(EDGES, (legs, BY_THE_SIDE, 0.0, BY_THE_SIDE)):
                costs[one, other] = costs[other, one] = cost
        return costs

    def across(self) -> NDArray:
        at = self.garment.mesh.rest_positions[self.corners]
        return np.linalg.norm(at[EDGES].mean(axis=1) - at[OPPOSITE].mean(axis=1), axis=1)

    def constants(self) -> dict[str, Any]:
        mesh = self.garment.mesh
        a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * self.garment.front
        canonical = np.ascontiguousarray(mesh.rest_positions[:, :2].T)
        return super().constants() | {"canonical": canonical, "front": area / area.sum()}

    def sheets(self) -> NDArray:
        return stored(self.bank)

    def mirrored(self, x: NDArray) -> NDArray:
        # left particles take the places of right ones: the mirror image itself would be a shirt that is inside out
        return super().mirrored(x)[self.garment.mirror]

    def expert_picks(self) -> NDArray:
        return GripperTask.expert_picks(self)  # that of ``ClothFlatten-v0`` is for squares


class FlattenShirtHardTask(ShirtsDrawn, FlattenShirtTask):
    """The task of ``ClothFlattenShirt-Hard-v0``, see ``ClothFlattenShirtHardEnv``."""


class ClothFlattenShirtEnv(ClothEnv):
    """Spread a crumpled T-shirt on the floor with two grippers and release it.

    ## Description
    A T-shirt of two layers lies crumpled on the floor.  Two grippers can grasp it, including other layers.  After 640 steps they
    open, and the shirt settles for 40 steps, in which actions are ignored; then it is evaluated.  Either side may be up.

    The shirt is that of ``ClothFoldShirt-v0``, ``clothgym.garments.tshirt(0.04, chest_width=0.42, length=0.64)``: two panels, sewn
    along shoulders, sleeves and sides, and open at neck, hem and cuffs.  L is its width from cuff to cuff, 0.76 m.  All
    environments of a batch have the same proportions; ``randomize`` draws fabrics, and a factor on all lengths.  ``garment``
    selects shorts, trousers or a towel of the default sizes instead, for which L is 0.64, 0.93 and 0.75 m.

    $physics

    ## Observation Space
    $observations

    The corners are the left and right end of the hem, and of the sleeves' upper side; of shorts and trousers, those of the legs
    and of the waist; and those of a towel.  The edges between them are the hem, the sides, and the line from sleeve to sleeve.
    ``next`` is chosen as in ``ClothFlatten-v0``, with two exceptions.  A side of a garment with two panels is never the first edge,
    and counts as eight more particles where a gripper that holds a corner chooses its neighbor.  The edge between the ends of the
    trousers' legs is never the first one either, and counts as 30 more particles.  ``next`` is 0 for a released garment from a
    coverage of 0.905.

    ## Rewards
    As in ``ClothFlatten-v0``.

    ## Evaluation
    The coverage and the normalized performance are those of ``ClothFlatten-v0``, relative to the area that the flat garment covers:
    0.31 m^2 of the T-shirt, 0.19 m^2 of shorts, 0.45 m^2 of trousers, and 0.47 m^2 of a towel.  In a success, the coverage is 0.9
    or more, and the garment is released and at rest (less than 0.02 m/s rms).

    ``info`` is that of ``ClothFlatten-v0``; ``softgym_coverage`` is relative to the same measure of the flat garment.  At the
    evaluation it also has ``face_up``, the share of the front panel that looks up, and Cloth Funnels' distance from the canonical
    pose: the flat garment about the origin, its neck, waist or top toward +y.  ``peer/funnels`` is 0.65 times the distance in shape
    plus 0.35 times that in pose, and ``peer/funnels_shape`` is the distance in shape, see ``clothgym.envs.garment_scores``.

    ## Starting State
    One of 32 crumpled shirts that cover 0.24 to 0.47 of the flat shirt's area (``benchmarks/rumpled_sheets.py``): lifted high at a
    random particle and dropped.  Of the 32 shorts it is 0.26 to 0.47, of the 24 trousers 0.30 to 0.62, and of the 32 towels 0.22 to
    0.47.  It is turned by any angle, in half of the episodes mirrored, and moved by up to 0.2 L along x and
    y.  Held-out seeds draw from the same shirts, in new combinations.  The grippers are open, 0.3 to 0.5 L to the left and right of
    the origin, 0.4 to 0.6 L above the floor.
    """

    task_class = FlattenShirtTask


class ClothFlattenShirtHardEnv(ClothEnv):
    """Spread a crumpled T-shirt on the floor and release it; each episode draws its size and fabric.

    ## Description
    This task differs from ``ClothFlattenShirt-v0`` in what episodes draw, the default of ``randomize``: the size of the shirt, 0.85
    to 1.15 times the usual one; its weight, 100 to 200 g/m^2; its bending rigidity, 0.3 to 3 uN m; and the friction of the floor,
    0.3 to 0.7.  These replace the values below, and those of a ``fabric`` of your own; a ``randomize`` of your own replaces all
    four ranges.  ``info`` has what was drawn, the observations have no number for it.  L stays 0.76 m for all sizes: places and
    observations are in this unit.

    $physics

    ## Observation Space
    $observations

    ``corners`` and ``next`` are those of ``ClothFlattenShirt-v0``.

    ## Rewards
    As in ``ClothFlattenShirt-v0``.

    ## Evaluation
    As in ``ClothFlattenShirt-v0``, with the same ``info``.  Areas and distances are those of the shirt over its size.

    ## Starting State
    As in ``ClothFlattenShirt-v0``: the same crumpled garments, of the usual fabric, scaled to the size that was drawn.
    """

    task_class = FlattenShirtHardTask

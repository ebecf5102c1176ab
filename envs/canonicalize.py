"""ClothCanonicalize-v0 and ClothCanonicalize-Hard-v0: spread a crumpled T-shirt in one pose, front up, its neck toward +y."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined
from clothgym.envs.coverage import CELL, FINE_CELL, shared_area
from clothgym.envs.episode import Fields
from clothgym.envs.flatten import improvement, is_measured, measure_raised, note_coverage
from clothgym.envs.flatten_shirt import FlattenShirtTask, evaluate_shirt
from clothgym.envs.fold_shirt import ShirtsDrawn
from clothgym.envs.single import ClothEnv

ENOUGH_UP = 0.9  # share of the front panel that looks up, in a success


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _measure(own, rules, sheet):
    """Heights of grippers, and the coverage of the canonical outline, on the coarser grid except at the start."""
    measure_raised(own, sheet)
    if is_measured(own, sheet):
        both, _ = shared_area(sheet.unit, rules.flat, sheet.mesh.triangles, FINE_CELL if own.step == 0 else CELL)
        note_coverage(own, rules, both)


@inlined
def _evaluate(own, rules, sheet, info):
    """As ``ClothFlattenShirt-v0``, with the coverage of the canonical outline, and the overlap; returns the improvement."""
    evaluate_shirt(own, rules, sheet, info)
    both, either = shared_area(sheet.unit, rules.flat, sheet.mesh.triangles, FINE_CELL)
    info.coverage, info.overlap = min(both / rules.flat_area, 1.0), both / either
    # what covers so much of the outline covers at least as much of the floor; turned by half a circle it may, too
    left, right, top_left, top_right = rules.corners
    upright = sheet.unit[1, top_left] + sheet.unit[1, top_right] > sheet.unit[1, left] + sheet.unit[1, right]
    info.is_success = info.is_success and info.coverage >= rules.enough and info.face_up >= ENOUGH_UP and upright
    return improvement(info.coverage, own.coverage_start)


# --- the task -----------------------------------------------------------------------------------------------------------------


class CanonicalizeTask(FlattenShirtTask):
    """The task of ``ClothCanonicalize-v0``, see ``ClothCanonicalizeEnv``."""

    kernels = FlattenShirtTask.kernels._replace(measure=_measure, evaluate=_evaluate)
    enough = 0.8
    takes = tuple(name for name in FlattenShirtTask.takes if name != "towel")  # which has no front, and no end that differs
    evaluation: ClassVar[Fields] = (*FlattenShirtTask.evaluation, ("overlap", float))
    arguments: ClassVar = {**FlattenShirtTask.arguments, "garment": '``"tshirt"``, ``"shorts"`` or ``"trousers"``'}

    def constants(self) -> dict[str, Any]:
        # of the type of ``sheet.unit``, as ``shared_area`` takes both
        return super().constants() | {"flat": np.ascontiguousarray(self.garment.mesh.rest_positions.T, np.float32)}

    def pose(self) -> NDArray:
        return self.garment.mesh.rest_positions[self.corners, :2]


class CanonicalizeHardTask(ShirtsDrawn, CanonicalizeTask):
    """The task of ``ClothCanonicalize-Hard-v0``, see ``ClothCanonicalizeHardEnv``."""


class ClothCanonicalizeEnv(ClothEnv):
    """Spread a crumpled T-shirt on the floor in its canonical pose: about the origin, front up, neck toward +y.

    ## Description
    The T-shirt, its starts and the grippers are those of ``ClothFlattenShirt-v0``.  Here it has to lie in one pose, from which a
    fixed sequence of motions can fold it.  After 640 steps the grippers open, and the shirt settles for 40 steps, in which actions
    are ignored; then it is evaluated.  In the canonical pose the shirt lies flat, centered on the origin, its neck toward +y and
    its left sleeve toward -x.  With ``action_mode="throw"`` an episode has four throws, and the environment also turns a
    lifted edge to its direction in the canonical pose.  The places of a throw lie along the direction opposite to ``out``: a throw
    ends with the held edge ahead of the other one, and the front comes to lie up.  With ``garment="shorts"`` or ``"trousers"`` the
    waist takes the place of the neck, and the legs that of the hem.

    $physics

    ## Observation Space
    $observations

    ``coverage`` is the covered share of the canonical outline, as below.  ``next`` is chosen as in ``ClothFlattenShirt-v0``, until
    the coverage is 0.805.

    ## Rewards
    As in ``ClothFlatten-v0``, with the coverage of the canonical outline.

    ## Evaluation
    The coverage c is the area that the shirt covers inside the outline of the canonical pose, seen from above, over the area of
    that outline, 0.31 m^2.  It is measured as in ``ClothFlatten-v0``, and the normalized performance is the normalized improvement
    of c.  In a success, c is 0.8 or more, at least nine tenths of the front panel face up, the sleeves are farther along +y than
    the hem, and the shirt is released and at rest (less than 0.02 m/s rms).  Rewards, performance, ``first_success`` and
    ``success_held`` depend neither on the side that is up nor on this direction.

    ``info`` is that of ``ClothFlattenShirt-v0``, with this coverage.  At the evaluation it also has ``overlap``, the intersection
    over union of the covered area and the outline.  ``peer/funnels`` is Cloth Funnels' distance from this pose.

    ## Starting State
    As in ``ClothFlattenShirt-v0``.
    """

    task_class = CanonicalizeTask


class ClothCanonicalizeHardEnv(ClothEnv):
    """Spread a crumpled T-shirt in its canonical pose; each episode draws its size and fabric.

    ## Description
    This task differs from ``ClothCanonicalize-v0`` in what episodes draw: sizes, fabrics and the friction of the floor, as in
    ``ClothFlattenShirt-Hard-v0``.

    $physics

    ## Observation Space
    $observations

    ``corners``, ``coverage`` and ``next`` are those of ``ClothCanonicalize-v0``.

    ## Rewards
    As in ``ClothCanonicalize-v0``.

    ## Evaluation
    As in ``ClothCanonicalize-v0``, with the same ``info``.  Areas and distances are those of the shirt over its size.

    ## Starting State
    As in ``ClothCanonicalize-v0``: the same crumpled garments, of the usual fabric, scaled to the size that was drawn.
    """

    task_class = CanonicalizeHardTask

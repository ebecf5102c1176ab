"""ClothFold-Hard-v0: the folds of ClothFold-v0 in a larger sheet of silk that is turned by any angle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from clothgym.envs.fold import FoldTask
from clothgym.envs.manipulation import PHYSICS
from clothgym.envs.physics import MEDIAN, chosen_fabric
from clothgym.envs.single import ClothEnv
from clothgym.mesh import grid

# a larger sheet of silk, with the short cuts of the others but for their fabric
LARGE_SILK = replace(PHYSICS, mesh=grid(21, 21, 0.8, 0.8), material=chosen_fabric("silk", MEDIAN), fast={"air_density": 0.0})


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


class ClothFoldHardEnv(ClothEnv):
    """Fold a large sheet of silk, turned by any angle on the floor, in half twice.

    ## Description
    Everything is as in ``ClothFold-v0`` but for the sheet, L = 0.8 m (21 x 21 particles), its fabric, silk
    (``Material.preset("silk")``: 83 g/m^2, hardly any rigidity), its start, and the fold, which is the quarter unless ``fold`` says
    another: two folds after each other, the second of two layers.  The sheet settles for three seconds.

    $physics

    ## Rewards
    As in ``ClothFold-v0``.

    ## Evaluation
    As in ``ClothFold-v0``, with the same ``info``.

    ## Starting State
    The sheet's center is up to 0.25 L from the origin along x and y, and it is turned by any angle.  The grippers are open, up to
    0.1 L beside and 0.2 to 0.35 L above the corners of one edge.
    """

    task_class = FoldHardTask

"""The sheets with which episodes of ``ClothFling-v0`` begin: crumpled ones, and where two corners of each can be taken alone."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length
from clothgym.envs.pick_place import LOWEST
from clothgym.envs.rumpled import Bank, rumpled_sheets
from clothgym.envs.taking import CLEAR, EDGES, beside_corners, places_to_take
from clothgym.mesh import grid

APART = 0.15  # least distance of the tips as an episode begins, in sides
NEARER = 0.75  # share of the distance at which tips take a corner otherwise: a sheet may stir as it is taken


class Start(NamedTuple):
    """A sheet, by its place among ``rumpled_sheets``, and the tips that hold both corners of an edge of it [m], (2, 3)."""

    sheet: int
    tips: NDArray


@cache
def held_sheets(rows: int, columns: int, side: float, bank: Bank) -> tuple[NDArray, list[Start]]:
    """Crumpled sheets [m], (sheets, particles, 3), and their edges whose corners grippers can take without any other cloth.

    If there is none, those at which they take the least.
    """
    sheets, mesh = rumpled_sheets(rows, columns, side, bank), grid(rows, columns, side, side)
    near, at = beside_corners(mesh) > 0, sheets[:, list(mesh.corners)]
    takes = at + NEARER * (places_to_take(sheets, mesh)[0] - at)
    takes[..., 2] = np.maximum(takes[..., 2], LOWEST)
    # what is taken beside the corners, (sheets, 4)
    others = ((length(takes[:, :, None] - sheets[:, None]) < CLEAR) & ~near).sum(axis=2)
    # and by edge, and how far apart the tips are, seen from above
    tips = takes[:, EDGES]
    close = np.linalg.norm((tips[:, :, 1] - tips[:, :, 0])[..., :2], axis=2) < APART * side
    taken = others[:, EDGES].sum(axis=2) + 1000 * close
    return sheets, [Start(sheet, tips[sheet, edge]) for sheet, edge in np.argwhere(taken == taken.min()).tolist()]

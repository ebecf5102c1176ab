"""The sheets with which episodes may begin: those of ``benchmarks/rumpled_sheets.py``, at whatever resolution and side."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.draping import PHYSICS
from clothgym.envs.targets import ON_FLOOR
from clothgym.geometry.intersections import find_intersections
from clothgym.mesh import ClothMesh, grid

UNIT = 1e-4  # [m]: of coordinates in the file
UNEVEN = 1e-4  # a sheet begins with its particles raised by about so much [m]: nothing flat can buckle
TRIALS = 20  # uneven starts of each sheet that must be free of intersections


class Bank(NamedTuple):
    """A file of sheets: its name, the kind of ``starts.make``, how often each was dropped, rows, side [m], and how many.

    made: those of which the file keeps some.  garment: its name in ``fold_shirt.SIZES``, of a sheet without rows and a side.
    thickness: of its contact as it comes to rest [m].
    """

    file: str
    kind: str
    picks: int
    rows: int
    side: float
    made: int
    kept: int
    garment: str = ""
    thickness: float = 3 * ON_FLOOR


RUMPLED = Bank("rumpled.npz", "rumpled", 2, PHYSICS.mesh.grid_shape[0], PHYSICS.side, 256, 64)
CRUMPLED = Bank("crumpled.npz", "crumpled", 2, PHYSICS.mesh.grid_shape[0], PHYSICS.side, 192, 128)
CRUMPLED_LARGE = Bank("crumpled_large.npz", "crumpled", 3, 21, 0.8, 144, 96)
FILES = {"tshirt": "shirts", "shorts": "shorts", "trousers": "trousers", "towel": "towels"}  # of crumpled garments
GARMENTS = {name: Bank(f"crumpled_{file}.npz", "crumpled", 1, 0, 0.0, 48, 32, name) for name, file in FILES.items()}
GARMENTS["trousers"] = GARMENTS["trousers"]._replace(kept=24, thickness=0.004)  # legs too close for 6 mm
BANKS = {bank.file.removesuffix(".npz"): bank for bank in (RUMPLED, CRUMPLED, CRUMPLED_LARGE, *GARMENTS.values())}


@cache
def stored(bank: Bank) -> NDArray:
    """The sheets of a file [m], (sheets, particles, 3)."""
    with resources.as_file(resources.files("clothgym.envs").joinpath(bank.file)) as path, np.load(path) as file:
        return file["positions"] * UNIT


@cache
def rumpled_sheets(rows: int, columns: int, side: float, bank: Bank = RUMPLED) -> NDArray:
    """Sheets that were picked up and dropped, free of intersections, about the origin on the floor [m], (sheets, particles, 3).

    side: of the square sheet [m].  At another resolution than the file's they are points of the same surfaces, scaled to the side;
    those that intersect themselves then are left out.

    Raises:
        ValueError: all do.
    """
    sheets = stored(bank)
    own = grid(bank.rows, bank.rows, bank.side, bank.side)
    if (rows, columns) == own.grid_shape and side == bank.side:
        return sheets
    # the lowest particles stay on the floor
    mesh = grid(rows, columns, side, side)
    sheets = resampled(sheets, own, mesh) * (side / bank.side)
    sheets[:, :, 2] += ON_FLOOR - sheets[:, :, 2].min(axis=1, keepdims=True)
    sheets = sheets[robust(mesh, sheets)]
    if not len(sheets):
        remedy = ', or reset with options={"rumpled": False}' if bank is RUMPLED else ""
        raise ValueError(
            f"rows={rows}, side={side!r}: no {bank.kind} sheet of so few particles is free of intersections; take more rows{remedy}"
        )
    return sheets


def resampled(x: NDArray, mesh: ClothMesh, other: ClothMesh) -> NDArray:
    """Sheets x of one grid, (sheets, particles, 3), as the points of their triangles that are the particles of another grid."""
    (rows, columns), (new_rows, new_columns) = mesh.grid_shape, other.grid_shape
    corners = x.reshape(-1, rows, columns, 3)
    # the cell of each new particle, and its place in it along both sides
    r, c = np.meshgrid(np.linspace(0, rows - 1, new_rows), np.linspace(0, columns - 1, new_columns), indexing="ij")
    i, j = np.minimum(r.astype(int), rows - 2), np.minimum(c.astype(int), columns - 2)
    s, t = (r - i)[..., None], (c - j)[..., None]
    one, right, above, far = corners[:, i, j], corners[:, i, j + 1], corners[:, i + 1, j], corners[:, i + 1, j + 1]
    # a cell's diagonal goes from its first particle to the far one where row and column are both even or both odd, see ``grid``
    rising = np.where(t >= s, one + t * (right - one) + s * (far - right), one + s * (above - one) + t * (far - above))
    falling = np.where(
        s + t <= 1, one + t * (right - one) + s * (above - one), far + (1 - t) * (above - far) + (1 - s) * (right - far)
    )
    return np.where(((i + j) % 2 == 0)[..., None], rising, falling).reshape(len(x), -1, 3)


def robust(mesh: ClothMesh, x: NDArray) -> NDArray:
    """Whether each sheet, (sheets, particles, 3), stays free of intersections when its particles are raised unevenly."""
    fine, rng = np.ones(len(x), bool), np.random.default_rng(0)
    for _ in range(TRIALS):
        uneven = x + np.abs(rng.normal(scale=3 * UNEVEN, size=x.shape)) * (0, 0, 1)
        fine[np.unique(find_intersections(mesh.triangles, uneven)[:, 0])] = False
    return fine

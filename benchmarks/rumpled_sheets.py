"""The sheets with which episodes may begin: rumpled ones of ClothDrapeGripper-v0, crumpled ones of ClothFlatten-v0, garments too.

    python benchmarks/rumpled_sheets.py [rumpled crumpled crumpled_large crumpled_shirts ...]    # writes envs/NAME.npz, in minutes

Sheets that lie flat are lifted at a random particle, carried some way and dropped, twice or thrice, garments once, and come to
rest, in strict self-collision (``starts.make``): rumpled ones were lifted a little, crumpled ones high.  Of the rumpled ones
the most rumpled are kept, by mean height, of those whose two corners at the target can be taken: they lie half a side apart,
and no cloth from elsewhere is within a gripper's reach of them.  Of the crumpled ones those that cover least.  Layers of a kept
sheet are so far apart that neither rounding nor the unevenness of a task's start makes it intersect itself.  The file is in
tenths of a millimeter, relative to the middle of the sheet on the floor.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from clothgym import starts
from clothgym.envs.coverage import FINE_CELL, covered_area
from clothgym.envs.draping import PHYSICS
from clothgym.envs.fold_shirt import FoldShirtTask, garment_named
from clothgym.envs.gripper_task import REACH
from clothgym.envs.physics import Physics
from clothgym.envs.rumpled import BANKS, RUMPLED, UNIT, Bank, robust
from clothgym.envs.targets import ON_FLOOR
from clothgym.mesh import ClothMesh, grid

AT_ONCE = 16
FOLDER = Path(__file__).parent.parent / "envs"


def graspable(mesh: ClothMesh, x: NDArray) -> NDArray:
    """Whether each sheet, (sheets, particles, 3), can be taken by its corners at the target."""
    corners = mesh.corners[2:]
    left, right = (x[:, corner] for corner in corners)
    free = np.linalg.norm(left - right, axis=1) > max(mesh.size) / 2
    for corner in corners:
        along = np.linalg.norm(mesh.rest_positions - mesh.rest_positions[corner], axis=1)
        elsewhere = x[:, along > 2 * REACH + 2 * max(mesh.spacing)]
        free &= np.linalg.norm(elsewhere - x[:, corner, None], axis=2).min(axis=1) > REACH
    return free


def made(bank: Bank, mesh: ClothMesh, physics: Physics) -> NDArray:
    """Sheets at rest [m], (sheets, particles, 3); seeds of which one does not come to rest are left out with their batch."""
    options = {name: getattr(physics, name) for name in ("time_step", "substeps", "air_density", "bending", "contact")}
    sheets = []
    for seed in tqdm(range(0, bank.made, AT_ONCE), unit="batch"):
        try:
            x = starts.make(
                mesh, physics.material, bank.kind, AT_ONCE, seed=seed, thickness=bank.thickness, picks=bank.picks, **options
            )
        except RuntimeError as error:
            print(f"seeds {seed} to {seed + AT_ONCE - 1} are left out: {error}")
        else:
            sheets.append(x)
    return np.concatenate(sheets).astype(np.float64)


def write(bank: Bank) -> None:
    if bank.garment:
        mesh, physics = garment_named(bank.garment).mesh, FoldShirtTask.physics
    else:
        mesh, physics = grid(bank.rows, bank.rows, bank.side, bank.side), PHYSICS
    x = made(bank, mesh, physics)
    x[:, :, :2] -= x[:, :, :2].mean(axis=1, keepdims=True)
    x[:, :, 2] += ON_FLOOR - x[:, :, 2].min(axis=1, keepdims=True)
    x = np.round(x / UNIT) * UNIT
    fits = robust(mesh, x)
    print(f"of {len(x)} sheets {fits.sum()} bear unevenness")
    if bank is RUMPLED:
        fits &= graspable(mesh, x)
        print(f"{fits.sum()} can be taken by their corners, too")
        order = -x[fits][:, :, 2].mean(axis=1)
    else:
        triangles = mesh.triangles.astype(np.int64)
        sheets = np.ascontiguousarray(np.stack([mesh.rest_positions, *x[fits]]).transpose(0, 2, 1), np.float32)
        flat, *area = (covered_area(sheet, triangles, FINE_CELL) for sheet in sheets)
        order = np.array(area) / flat
    chosen = np.argsort(order, kind="stable")[: bank.kept]
    x = x[fits][chosen]
    print(
        f"{len(x)} are kept, by {'minus mean height [m]' if bank is RUMPLED else 'coverage'}: "
        f"{order[chosen].min():.4f} to {order[chosen].max():.4f}"
    )
    path = FOLDER / bank.file
    np.savez_compressed(path, positions=np.round(x / UNIT).astype(np.int16))
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", choices=tuple(BANKS), nargs="*", default=tuple(BANKS))
    for name in parser.parse_args().names:
        write(BANKS[name])


if __name__ == "__main__":
    main()

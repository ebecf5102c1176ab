"""The rumpled sheets with which ClothDrapeGripper-v0 may begin.

    python benchmarks/rumpled_sheets.py            # writes envs/rumpled.npz, in some minutes

Sheets that lie flat are lifted a little at a random particle, carried some way and dropped, twice, and come to rest, in strict
self-collision (``starts.make``).  Kept are the most rumpled ones, by mean height, of those whose two corners at the target can be
taken: they lie half a side apart, and no cloth from elsewhere is within a gripper's reach of them.  Layers of a kept sheet are so
far apart that neither rounding nor the unevenness of a task's start makes it intersect itself.  What is written is in tenths of a
millimeter, relative to the middle of the sheet on the floor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from clothgym import starts
from clothgym.envs.drape_gripper import REACH
from clothgym.envs.draping import PHYSICS
from clothgym.envs.rumpled import UNIT, robust
from clothgym.envs.targets import ON_FLOOR

KEPT, COUNT, AT_ONCE = 64, 256, 32
SHEET, SIDE = PHYSICS.mesh, PHYSICS.side
CORNERS = SHEET.corners[2:]
BANK = Path(__file__).parent.parent / "envs" / "rumpled.npz"


def graspable(x: NDArray) -> NDArray:
    """Whether each sheet, (sheets, particles, 3), can be taken by its corners at the target."""
    left, right = (x[:, corner] for corner in CORNERS)
    free = np.linalg.norm(left - right, axis=1) > SIDE / 2
    for corner in CORNERS:
        along = np.linalg.norm(SHEET.rest_positions - SHEET.rest_positions[corner], axis=1)
        elsewhere = x[:, along > 2 * REACH + 2 * max(SHEET.spacing)]
        free &= np.linalg.norm(elsewhere - x[:, corner, None], axis=2).min(axis=1) > REACH
    return free


def main() -> None:
    options = {name: getattr(PHYSICS, name) for name in ("time_step", "substeps", "air_density", "bending", "contact")}
    made = [
        starts.make(SHEET, PHYSICS.material, "rumpled", AT_ONCE, seed=seed, thickness=3 * ON_FLOOR, **options)
        for seed in tqdm(range(0, COUNT, AT_ONCE), unit="batch")
    ]
    x = np.concatenate(made).astype(np.float64)
    x[:, :, :2] -= x[:, :, :2].mean(axis=1, keepdims=True)
    x[:, :, 2] += ON_FLOOR - x[:, :, 2].min(axis=1, keepdims=True)
    x = np.round(x / UNIT) * UNIT
    can_be_taken, free = graspable(x), robust(SHEET, x)
    print(f"of {COUNT} sheets {can_be_taken.sum()} can be taken by their corners, {free.sum()} bear unevenness")
    x = x[can_be_taken & free]
    x = x[np.argsort(-x[:, :, 2].mean(axis=1), kind="stable")[:KEPT]]
    heights = x[:, :, 2].mean(axis=1) * 1000
    print(f"{len(x)} are kept, of mean heights {heights.min():.1f} to {heights.max():.1f} mm")
    np.savez_compressed(BANK, positions=np.round(x / UNIT).astype(np.int16))
    print(f"{BANK}: {BANK.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()

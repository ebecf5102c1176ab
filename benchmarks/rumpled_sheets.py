"""The rumpled sheets with which ClothDrapeGripper-v0 may begin.

    python benchmarks/rumpled_sheets.py            # writes envs/rumpled.npz, in a few seconds

Sheets that lie flat are picked up at a random particle, carried some way and dropped, twice, and settle.  Kept are the most
rumpled ones, by mean height, of those whose two corners at the target can be taken: they lie half a side apart, and no cloth
from elsewhere is within a gripper's reach of them.  What is written is in tenths of a millimeter, relative to the middle of the
sheet on the floor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clothgym import Gripper, Plane, Simulation
from clothgym.envs.drape import DrapeTask
from clothgym.envs.drape_gripper import REACH
from clothgym.envs.draping import FRICTION, SHEET, SIDE, THICKNESS

KEPT, COUNT, SEED = 64, 256, 0
CORNERS = SHEET.corners[2:]
BANK = Path(__file__).parent.parent / "envs" / "rumpled.npz"


def pick_and_drop(simulation: Simulation, rng: np.random.Generator) -> None:
    """Lift a particle of each sheet by 0.1 to 0.4 sides, carry it by up to 0.4 sides, and let go."""
    x = simulation.positions
    start = x[np.arange(COUNT), rng.integers(SHEET.num_particles, size=COUNT)]
    simulation.grippers.place(start[:, None])
    way = np.concatenate([rng.uniform(-0.4, 0.4, (COUNT, 2)), rng.uniform(0.1, 0.4, (COUNT, 1))], axis=1) * SIDE
    for share, opening in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)):
        for _ in range(20):
            simulation.grippers.move((start + share * way)[:, None], np.full((COUNT, 1), opening))
            simulation.step()
    simulation.step(40)


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
    rng = np.random.default_rng(SEED)
    physics = DrapeTask.physics
    simulation = Simulation(
        SHEET,
        physics.material,
        num_envs=COUNT,
        time_step=physics.time_step,
        substeps=physics.substeps,
        air_density=physics.air_density,
        colliders=[Plane(friction=FRICTION, thickness=THICKNESS)],
        grippers=[Gripper(speed=0.5)],
    )
    simulation.reset(positions=SHEET.rest_positions + (0, 0, THICKNESS))
    for _ in range(2):
        pick_and_drop(simulation, rng)
    x = simulation.positions
    x = x[graspable(x)]
    print(f"{len(x)} of {COUNT} can be taken by their corners")
    x = x[np.argsort(-x[:, :, 2].mean(axis=1), kind="stable")[:KEPT]]
    x[:, :, :2] -= x[:, :, :2].mean(axis=1, keepdims=True)
    heights = x[:, :, 2].mean(axis=1) * 1000
    print(
        f"mean heights {heights.min():.1f} to {heights.max():.1f} mm, largest speed: {np.abs(simulation.velocities).max():.2f} m/s"
    )
    np.savez_compressed(BANK, positions=np.round(x * 1e4).astype(np.int16))
    print(f"{BANK}: {BANK.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()

"""The ideal of ClothDrape-v0: the coverage that a fine sheet, laid flat and centered on a target, reaches.

    python benchmarks/drape_reference.py            # writes envs/drape_reference.json, about two minutes

A 49 x 49 sheet of the task's fabric is let down from just above the target's highest point, and settles for four seconds.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from clothgym import Material, Plane, Simulation, __version__, grid
from clothgym.envs.draping import COVERED_WITHIN, EVALUATED_POINTS, FRICTION, SIDE, THICKNESS
from clothgym.envs.measures import covered_share
from clothgym.envs.targets import SIZES, Target

ROWS = 49
SETTLE = 4.0  # [s]
TABLE = Path(__file__).parent.parent / "envs" / "drape_reference.json"


def targets(shape: str) -> tuple[list[float], list[float], list[Target]]:
    (low, high), heights = SIZES[shape]
    widths = np.linspace(low, high, 5).round(4).tolist()
    tall = np.linspace(*heights, 5).round(4).tolist() if heights else [0.0]
    solids = [Target(shape, w * SIDE, (h or 2 * w) * SIDE, (0.0, 0.0)) for w in widths for h in tall]
    return widths, tall, solids


def coverage(solids: list[Target]) -> list[float]:
    """Coverage [share of the upper surface] of each target after settling."""
    mesh = grid(ROWS, ROWS, SIDE, SIDE)
    material = replace(Material.preset("penava_cotton"), air_drag=1.0)
    colliders = [Plane(friction=FRICTION, thickness=THICKNESS), solids[0].collider(FRICTION, THICKNESS)]
    simulation = Simulation(mesh, material, num_envs=len(solids), time_step=1 / 60, air_density=0, colliders=colliders)
    simulation.set_collider(1, [solid.collider(FRICTION, THICKNESS) for solid in solids])
    start = np.array([mesh.rest_positions + (0, 0, solid.height + 2 * THICKNESS) for solid in solids])
    simulation.reset(positions=start)
    simulation.step(round(SETTLE * 60))
    speed = np.sqrt(np.mean(np.sum(simulation.velocities**2, axis=2), axis=1))
    print(f"  largest rms speed at the end: {speed.max() * 1000:.1f} mm/s")
    points = [solid.upper_surface(EVALUATED_POINTS) for solid in solids]
    sheets = simulation.positions.astype(float).transpose(0, 2, 1).copy()
    return [covered_share(sheet, mesh.triangles, p, COVERED_WITHIN * SIDE) for sheet, p in zip(sheets, points)]


def main() -> None:
    table = {}
    for shape in SIZES:
        print(shape)
        widths, tall, solids = targets(shape)
        values = np.array(coverage(solids)).reshape(len(widths), len(tall))
        print(values.round(3))
        table[shape] = {"widths": widths, "heights": tall, "coverage": values.round(4).tolist()}
    about = (
        f"made by benchmarks/drape_reference.py of clothgym {__version__}: {ROWS} x {ROWS} sheet; widths and heights in sheet sides"
    )
    TABLE.write_text(json.dumps({"about": about, "shapes": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()

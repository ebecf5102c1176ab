"""How accurate each task's own integrator and substeps are.

    python benchmarks/task_accuracy.py            # prints, and writes benchmarks/results/task_accuracy.json, in a minute

The task's sheet, flat and held by its anchors (the gripper task's by the drape's), swings for half a second of the task's control
steps; the error is the rms distance of its particles from a float64 run with sixteen times the substeps, by the sheet's side.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clothgym import Simulation
from clothgym.bench import machine
from clothgym.envs.drape import DrapeTask
from clothgym.envs.physics import Physics
from clothgym.envs.reach import ReachTask
from clothgym.envs.strain import StrainTask

RESULTS = Path(__file__).parent / "results" / "task_accuracy.json"
TASKS = {"ClothReach-v0": ReachTask, "ClothDrape-v0": DrapeTask, "ClothStrain-v0": StrainTask}
FINER = 16


def swing(physics: Physics, substeps: int, dtype: str) -> NDArray:
    """Positions after half a second [m], (particles, 3)."""
    cloth = Simulation(
        physics.mesh, physics.material, 1, physics.integrator, physics.time_step, substeps,
        air_density=physics.air_density, anchors=physics.anchors, dtype=dtype, threads=1,
    )  # fmt: skip
    cloth.step(round(0.5 / physics.time_step))
    return cloth.positions[0].astype(np.float64)


def main() -> None:
    rows = []
    for env_id, task in TASKS.items():
        physics = task.physics
        away = swing(physics, physics.substeps, "float32") - swing(physics, FINER * physics.substeps, "float64")
        error = float(np.sqrt(np.mean(np.sum(away**2, axis=1)))) * 1000
        row = {"environment": env_id, "integrator": physics.integrator, "substeps": physics.substeps}
        rows.append(row | {"control_hz": 1 / physics.time_step, "error_mm_per_m": error / max(physics.mesh.size)})
        print(f"{env_id}: {rows[-1]['error_mm_per_m']:.2f} mm per metre of sheet")
    RESULTS.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

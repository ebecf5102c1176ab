"""What rounding adds up to over thousands of small substeps in float32, far from the origin and near.

    python benchmarks/sums.py      # writes results/sums.json, and prints its tables

A free sheet of 5 x 5 particles, without gravity and air, in every method, over substeps of 1/60 s and distance from the origin.
Closed forms are the truth, with the center of mass in float64:

* drift: it glides at 2 cm/s; how far it is from where its velocity leads, as a share of the way.
* momentum: it turns in its plane at 1 rad/s; the speed that its center of mass has in the end, as a share of its rim's.
* gravity: it falls, and was at 7 m/s; the error of what gravity adds to its velocity, as a share of it.
* slow: a solid, an anchor and a gripper's particles are moved at 2 cm/s; the largest error of their way, as a share of it.

At a distance a way can only be read to the last bit of a position there, 4 micrometers at 100 m.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import INTEGRATORS, Gripper, Material, Simulation, Sphere, grid
from clothgym.lab.bench import machine

Row = dict[str, Any]
RESULT = Path(__file__).parent / "results" / "sums.json"
SUBSTEPS, DISTANCES = (64, 512, 4096), (0.0, 1.0, 10.0, 100.0)
# control steps; methods that iterate take longer
STEPS, SLOWER = {64: 60, 512: 30, 4096: 12}, {"implicit_euler": 2, "projective_dynamics": 4, "pbd": 2}
GLIDE, SPEED, RIM, G = np.array([0.012, -0.016, 0.0]), 0.02, 0.15, 9.81
MESH = grid(5, 5, 0.3, 0.3)
MEASURES = ("drift", "momentum", "gravity")


def sheet(name: str, substeps: int, gravity: float = 0.0, **settings: Any) -> Simulation:
    """A free sheet; explicit Euler, which grows at any substep, has a soft and damped one."""
    fabric = Material(stretch_stiffness=20, shear_stiffness=5, damping_time=1e-3) if name == "explicit_euler" else Material()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the bounds of substeps are of no interest here
        return Simulation(MESH, fabric, integrator=name, substeps=substeps, gravity=(0, 0, -gravity), air_density=0, **settings)


def center(simulation: Simulation, values: NDArray) -> NDArray[np.float64]:
    """The mean of ``values``, (1, particles, 3), with the masses as weights, (3,)."""
    mass = 1 / simulation.get_state().free_inverse_mass[0].astype(float)
    mean: NDArray[np.float64] = mass @ values[0].astype(float) / mass.sum()
    return mean


def free(name: str, substeps: int, distance: float) -> Row:
    """What a free sheet does by itself."""
    off, steps = np.array([distance, distance, 0]), max(2, STEPS[substeps] // SLOWER.get(name, 1))
    time = steps / 60
    # it glides
    simulation = sheet(name, substeps)
    simulation.reset(positions=MESH.rest_positions + off, velocities=GLIDE)
    begun = center(simulation, simulation.positions)
    simulation.step(steps)
    drift = np.linalg.norm(center(simulation, simulation.positions) - begun - GLIDE * time) / (SPEED * time)
    # it turns
    simulation.reset(positions=MESH.rest_positions + off, velocities=np.cross([0, 0, 1.0], MESH.rest_positions))
    simulation.step(steps)
    momentum = np.linalg.norm(center(simulation, simulation.velocities)) / RIM
    # it falls
    simulation = sheet(name, substeps, G)
    simulation.reset(positions=MESH.rest_positions + off, velocities=(0, 0, -7))
    simulation.step(steps)
    gained = -7 - center(simulation, simulation.velocities)[2]
    row = {"integrator": name, "substeps": substeps, "distance": distance, "seconds": time}
    return row | {"drift": float(drift), "momentum": float(momentum), "gravity": float(abs(gained / (G * time) - 1))}


def slow(substeps: int, distance: float) -> Row:
    """Errors of slowly moving solids and attachments."""
    off, steps = np.array([distance, distance, 0]), STEPS[substeps]
    corner, below = MESH.rest_positions[-1] + off, off - (0, 0, 2)
    simulation = sheet(
        "semi_implicit_euler", substeps, anchors=[0], colliders=[Sphere(center=tuple(below))],
        grippers=[Gripper(position=tuple(corner), reach=0.1, closing_time=1 / 60)],
    )  # fmt: skip
    simulation.reset(positions=MESH.rest_positions + off)
    simulation.grippers.move(corner[None], [0.0])
    simulation.step()
    gripped = np.flatnonzero(simulation.grippers.holder[0] == 0)
    begun, solid = simulation.positions[0].astype(float), simulation.collider_positions[0, 0].astype(float)
    simulation.move_colliders(0, velocities=GLIDE)
    for step in range(1, steps + 1):
        way = GLIDE * step / 60
        simulation.move_anchors((MESH.rest_positions[0] + off + way)[None])
        simulation.grippers.move((corner + way)[None], [0.0])
        simulation.step()
    moved = simulation.positions[0] - begun
    wrong = {"solid": simulation.collider_positions[0] - solid, "anchor": moved[[0]], "gripper": moved[gripped]}
    share = {name: float(np.linalg.norm(where - way, axis=1).max() / np.linalg.norm(way)) for name, where in wrong.items()}
    return {"substeps": substeps, "distance": distance, "seconds": steps / 60} | share


def measured() -> Row:
    """All rows."""
    rows, slowly = [], []
    for substeps in SUBSTEPS:
        for distance in DISTANCES:
            slowly.append(slow(substeps, distance))
            print(slowly[-1], flush=True)
            for name in INTEGRATORS:
                rows.append(free(name, substeps, distance))
                print(rows[-1], flush=True)
    return {"machine": machine(), "free": rows, "slow": slowly}


def tables(results: Row) -> str:
    """The tables in Markdown: the worst over distances, at each number of substeps."""
    lines = []
    for measure in MEASURES:
        lines += [
            "",
            f"| {measure}: substeps of 1/60 s | " + " | ".join(map(str, SUBSTEPS)) + " |",
            "| --- |" + " --- |" * len(SUBSTEPS),
        ]
        for name in INTEGRATORS:
            own = [row for row in results["free"] if row["integrator"] == name]
            worst = [max(row[measure] for row in own if row["substeps"] == substeps) for substeps in SUBSTEPS]
            lines.append(f"| `{name}` | " + " | ".join(f"{value:.1e}" for value in worst) + " |")
    lines += ["", "| slow: distance | " + " | ".join(f"{d:g} m" for d in DISTANCES) + " |", "| --- |" + " --- |" * len(DISTANCES)]
    for what in ("solid", "anchor", "gripper"):
        worst = [max(row[what] for row in results["slow"] if row["distance"] == distance) for distance in DISTANCES]
        lines.append(f"| {what} | " + " | ".join(f"{value:.1e}" for value in worst) + " |")
    return "\n".join(lines[1:])


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    results = measured()
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    print(tables(results))


if __name__ == "__main__":
    main()

"""How deep sheets are in the solids that they are draped over, and what contact between the particles costs.

    python benchmarks/contact.py                 # 17 x 17 and 50 x 50, about ten minutes on one core
    python benchmarks/contact.py --rows 17       # the coarse sheet alone

A sheet of 0.6 m of cotton is thrown at 1 m/s at a sphere, a capsule, a box that stands on its corner, a chair and a bowl, comes to
rest, and the solid moves at 1 m/s.  Depth is that of the deepest of many points of its triangles, by closed forms or brute force
over the mesh's triangles, over the solid's size.  Costs are medians of turns of a control step of 64 sheets on one thread, with
``ClothDrape-v0``'s sheet and substeps, against the same with its particles' contact alone.  Results go to ``results/contact.json``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import Box, Capsule, Material, MeshCollider, Plane, Simulation, Sphere, grid
from clothgym.collisions import Collider
from clothgym.envs.drape import DrapeTask
from clothgym.lab.bench import machine

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import solids  # the truths that the tests use

RESULT = Path(__file__).parent / "results" / "contact.json"
AXIS = (1.0, 0.3, 0.0)
CHAIR, BOWL = solids.chair(), solids.bowl()
TURNS = 31
# name, solid, its distance, height of its top, its size [m]
Case = tuple[str, Collider, Callable[[NDArray], NDArray], float, float]
CASES: tuple[Case, ...] = (
    ("sphere", Sphere(radius=0.12, friction=0.5), lambda x: solids.sphere_distance(x, 0.12), 0.12, 0.24),
    (
        "capsule",
        Capsule(radius=0.06, height=0.4, axis=AXIS, friction=0.5),
        lambda x: solids.capsule_distance(x, AXIS, 0.06, 0.4),
        0.06,
        0.12,
    ),
    (
        "box on its corner",
        Box(half_sides=(0.1, 0.1, 0.1), rotation=solids.ON_ITS_CORNER, friction=0.5),
        lambda x: solids.box_distance(x, 0.1, solids.rotation(*solids.ON_ITS_CORNER)),
        0.1 * 3**0.5,
        0.2,
    ),
    (
        "chair",
        MeshCollider(vertices=CHAIR[0], triangles=CHAIR[1], friction=0.5),
        lambda x: solids.mesh_distance(x, *CHAIR),
        0.45,
        0.4,
    ),
    ("bowl", MeshCollider(vertices=BOWL[0], triangles=BOWL[1], friction=0.5), lambda x: solids.mesh_distance(x, *BOWL), 0.0, 0.3),
)


def depths(rows: int, case: Case) -> dict[str, Any]:
    name, solid, distance, top, size = case
    mesh = grid(rows, rows, 0.6, 0.6)
    simulation = Simulation(mesh, Material.preset("penava_cotton", air_drag=0.2), colliders=[solid], threads=1)
    pieces = 2 if rows > 20 else 4

    def depth() -> float:
        return solids.depth(simulation.positions[0] - simulation.collider_positions[0, 0], mesh.triangles, distance, pieces) / size

    simulation.reset(positions=mesh.rest_positions + (0.013, 0.007, top + 0.03), velocities=(0, 0, -1.0))
    thrown = []
    for _ in range(6):
        simulation.step(2)
        thrown.append(depth())
    simulation.step(180)
    row: dict[str, Any] = {"solid": name, "rows": rows, "thrown": max(thrown), "rest": depth()}
    row["rms_speed"] = float(np.sqrt(np.mean(np.sum(simulation.velocities[0] ** 2, axis=1))))
    moved = []
    for velocity in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        simulation.move_colliders(0, velocities=velocity)
        for _ in range(3):
            simulation.step(2)
            moved.append(depth())
    row["moved"] = max(moved)
    return row


def cost(name: str, solid: Collider, height: float) -> dict[str, Any]:
    """Of a control step with contact between the particles, over one with theirs alone."""
    physics = DrapeTask.physics
    simulation = Simulation(
        physics.mesh, physics.material, 64, time_step=physics.time_step, substeps=physics.substeps, air_density=0, threads=1,
        colliders=[Plane(friction=0.5, thickness=0.002), solid],
    )  # fmt: skip
    offsets = np.concatenate([np.random.default_rng(0).uniform(-0.03, 0.03, (64, 1, 2)), np.full((64, 1, 1), height)], axis=2)
    simulation.reset(positions=physics.mesh.rest_positions + offsets)
    simulation.step(90)
    state, surface = simulation.get_state(), simulation._surface
    times: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(-1, TURNS):
        for whole in (False, True):
            simulation._surface = surface if whole else surface._replace(triangles=surface.triangles[:0])
            simulation.set_state(state)
            begun = time.perf_counter()
            simulation.step()
            if turn >= 0:
                times[whole].append(time.perf_counter() - begun)
    particles, whole = (1e3 * statistics.median(times[kind]) for kind in (False, True))
    return {"solid": name, "ms_particles_alone": particles, "ms": whole, "ratio": whole / particles}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", type=int, nargs="*", default=[17, 50], help="particles along a side of the sheets")
    args = parser.parse_args()
    rows = [depths(count, case) for count in args.rows for case in CASES]
    shared = {"thickness": 0.002, "friction": 0.5}
    costs = [
        cost("sphere", Sphere(center=(0, 0, 0.15), radius=0.15, **shared), 0.305),
        cost("box", Box(center=(0, 0, 0.1), half_sides=(0.1, 0.1, 0.1), **shared), 0.205),
        cost("chair", MeshCollider(vertices=CHAIR[0], triangles=CHAIR[1], **shared), 0.46),  # type: ignore[arg-type]
        cost("none near", Sphere(center=(3, 0, 0.15), radius=0.15, **shared), 3.0),
    ]
    RESULT.write_text(json.dumps({"machine": machine(), "depths": rows, "costs": costs}, indent=1) + "\n")
    for row in rows:
        shares = ", ".join(f"{key} {100 * row[key]:.2f} %" for key in ("thrown", "rest", "moved"))
        print(f"{row['rows']:>3} {row['solid']:<18} {shares}, rms speed at rest {1e3 * row['rms_speed']:.0f} mm/s")
    for row in costs:
        print(f"{row['solid']:<18} {row['ms_particles_alone']:.2f} ms, {row['ms']:.2f} ms: {row['ratio']:.2f} times")


if __name__ == "__main__":
    main()

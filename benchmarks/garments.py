"""Garments: how well random ones are triangulated, and what a T-shirt costs, next to a grid of as many particles.

    python benchmarks/garments.py                     # about half an hour on one core
    python benchmarks/garments.py --select frames     # some minutes

Sections of ``results/garments.json``:

* meshes: of random garments of each kind: the smallest angle of a triangle [degrees], the least, 5th percentile and median over
  garments; garments that were refused; those with intersections at rest, by the exact count; seconds to make one.
* frames: processor time of a control step of 1/60 s for each environment [ms], of a T-shirt and of a grid of as many particles that
  lie on the floor, without self-collision and with the strict one.  Springs are structural and shear springs, or edges.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from cases import Case, Row, fill, parsed, table

from clothgym import Plane, Simulation, grid
from clothgym.garments import RANGES, random_garment, tshirt
from clothgym.geometry.intersections import count_intersections
from clothgym.geometry.regions import smallest_angle
from clothgym.mesh import SHEAR

RESULT = Path(__file__).parent / "results" / "garments.json"
GARMENTS, SPACINGS, BATCHES = 200, (0.02, 0.03), (1, 16)
LYING, TIMED = 30, 10  # control steps until it lies, and that are timed


def meshes(kind: str, spacing: float, garments: int) -> Row:
    """Random garments of one kind, with seeds from 0."""
    angles, refused, intersecting, start = [], 0, 0, time.process_time()
    for seed in range(garments):
        try:
            mesh = random_garment(kind, seed, spacing).mesh
        except ValueError:
            refused += 1
            continue
        angles.append(smallest_angle(mesh.rest_positions, mesh.triangles))
        intersecting += int(count_intersections(mesh.triangles, mesh.rest_positions)[0] > 0)
    least, low, median = np.percentile(angles, [0, 5, 50]).tolist()
    seconds = (time.process_time() - start) / garments
    return {"least": least, "5 %": low, "median": median, "refused": refused, "intersecting": intersecting, "seconds": seconds}


def lying(sheet: str, spacing: float, num_envs: int, self_collision: str | bool) -> Row:
    """T-shirts of the default sizes, or grids, that lie on the floor."""
    mesh = tshirt(spacing).mesh
    if sheet == "grid":
        side = round(np.sqrt(mesh.num_particles))
        mesh = grid(side, side, spacing * (side - 1), spacing * (side - 1))
    cloth = Simulation(
        mesh, num_envs=num_envs, bending="quadratic", colliders=[Plane(point=(0, 0, -0.01), friction=0.5)],
        self_collision=self_collision, threads=1,
    )  # fmt: skip
    cloth.step(LYING)
    times = []
    for _ in range(TIMED):
        start = time.process_time()
        cloth.step()
        times.append((time.process_time() - start) / num_envs)
    springs, frame = int(np.sum(mesh.springs.kind <= SHEAR)), float(np.median(times))
    return {
        "particles": mesh.num_particles, "springs": springs, "hinges": len(mesh.hinges.weight), "substeps": cloth.substeps,
        "ms": 1e3 * frame, "ns per spring and substep": 1e9 * frame / springs / cloth.substeps,
        "intersections": int(cloth.intersections().sum()),
    }  # fmt: skip


def main() -> None:
    args = parsed(__doc__)
    kinds = [kind for kind in RANGES if kind != "towel"]
    made: list[Case] = [(meshes, {"kind": kind, "spacing": SPACINGS[0], "garments": GARMENTS}) for kind in kinds]
    frames: list[Case] = [
        (lying, {"sheet": sheet, "spacing": spacing, "num_envs": batch, "self_collision": mode})
        for spacing in SPACINGS for batch in BATCHES for mode in (False, "strict") for sheet in ("tshirt", "grid")
    ]  # fmt: skip
    results = fill(
        RESULT, {"meshes": made, "frames": frames}, args.select, args.fresh, {"time_step": 1 / 60, "bending": "quadratic"}
    )
    for section in ("meshes", "frames"):
        print(table(results.get(section, [])), end="\n\n")


if __name__ == "__main__":
    main()

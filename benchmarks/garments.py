"""Garments: how well random ones are triangulated, and what a T-shirt costs, next to a grid of as many particles.

    python benchmarks/garments.py                     # about half an hour on one core
    python benchmarks/garments.py --select frames     # some minutes

Sections of ``results/garments.json``:

* meshes: of random garments of each kind: the smallest angle of a triangle [degrees], the least, 5th percentile and median over
  garments; garments that were refused; those with intersections at rest, by the exact count; seconds to make one.
* frames: processor time of a control step of 1/60 s for each environment [ms], of a T-shirt and of a grid of as many particles that
  lie on the floor, without self-collision and with the strict one.  Springs are structural and shear springs, or edges.
* states: the same of T-shirts with strict self-collision that lie, are folded in half, hang from their shoulders, or have been
  crumpled: lifted at a sleeve and dropped.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from cases import Case, Row, fill, parsed, table

from clothgym import Plane, Simulation, grid
from clothgym.envs.coverage import FINE_CELL, covered_area
from clothgym.envs.garment_scores import flat_area
from clothgym.garments import RANGES, random_garment, tshirt
from clothgym.geometry.intersections import count_intersections
from clothgym.geometry.regions import smallest_angle
from clothgym.mesh import SHEAR

RESULT = Path(__file__).parent / "results" / "garments.json"
GARMENTS, SPACINGS, BATCHES = 200, (0.02, 0.03), (1, 16)
STATES = ("lying", "folded", "hanging", "crumpled")
LYING, TIMED = 30, 10  # control steps until it lies, and that are timed
HANGING, CRUMPLED = ("shoulder_left", "shoulder_right"), ("sleeve_top_left",)
FOLDED = ("sleeve_top_left", "sleeve_bottom_left", "waist_left")
FOLDING = 60  # control steps in which the left half is laid on the right one
LIFTED, FALLEN = 60, 90  # control steps for which it hangs, and after which it has come to rest on the floor


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
    return timed(cloth)


def shirts(state: str, num_envs: int) -> Row:
    """T-shirts of the default sizes in one of ``STATES``, each environment's a little moved, so that they differ."""
    garment = tshirt(SPACINGS[0])
    mesh, points = garment.mesh, garment.key_points
    x = mesh.rest_positions.copy()
    if state in ("hanging", "crumpled"):
        # upright, its front toward -y
        x = x[:, [0, 2, 1]] * (1, -1, 1) + (0, 0, 0.8)
    anchors = {"hanging": HANGING, "folded": FOLDED, "crumpled": CRUMPLED}.get(state, ())
    held = [points[name] for name in anchors]
    cloth = Simulation(
        mesh, num_envs=num_envs, bending="quadratic", colliders=[Plane(point=(0, 0, -0.01), friction=0.5)],
        self_collision="strict", anchors=held, threads=1,
    )  # fmt: skip
    moved = np.random.default_rng(0).uniform(0, 0.001, (num_envs, 1, 3)) * (1, 1, 0)
    cloth.reset(positions=x + moved)
    for step in range(FOLDING if state == "folded" else 0):
        # along half circles, over the garment
        angle = np.pi * (step + 1) / FOLDING
        ahead = x[held] * (np.cos(angle), 1, 1) + np.abs(x[held, :1]) * (0, 0, np.sin(angle)) + (0, 0, SPACINGS[0] / 4)
        cloth.move_anchors(ahead + moved)
        cloth.step()
    if state == "crumpled":
        cloth.step(LIFTED)
    if state in ("crumpled", "folded"):
        cloth.release()
    cloth.step({"hanging": LIFTED, "crumpled": FALLEN}.get(state, LYING))
    layers = covered_area(np.ascontiguousarray(cloth.positions[0].T), mesh.triangles, FINE_CELL) / flat_area(garment)
    return {"covers": float(layers)} | timed(cloth)


def timed(cloth: Simulation) -> Row:
    """What its control steps cost from now on."""
    mesh, num_envs, times = cloth.mesh, cloth.num_envs, []
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
    states: list[Case] = [(shirts, {"state": state, "num_envs": batch}) for batch in BATCHES for state in STATES]
    sections = {"meshes": made, "frames": frames, "states": states}
    results = fill(RESULT, sections, args.select, args.fresh, {"time_step": 1 / 60, "bending": "quadratic"})
    for section in sections:
        print(table(results.get(section, [])), end="\n\n")


if __name__ == "__main__":
    main()

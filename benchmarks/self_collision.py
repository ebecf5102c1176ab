"""Intersections of sheets that crumple, by how they collide with themselves: counted exactly after every control step.

    python benchmarks/self_collision.py                          # what the results lack, and the tables; hours, case by case
    python benchmarks/self_collision.py --select strict 25x25    # cases whose names hold all these words

Sections of ``results/self_collision.json``:

* maneuvers: those of ``clothgym.starts`` on sheets of a meter, five seeds each: frames (control steps of 1/60 s) with an
  intersection, the most pairs that intersected at once, the smallest gap and the largest lag that the simulation reported.  Modes:
  "none", "fast" and "strict" with a thickness; and "spheres", what peers do: particles are balls that push each other apart in
  every substep, but for those that are nearer at rest; as thick as the cloth, or "covering" it.
* substeps: the same with one sheet and a control step for each substep, so that the count follows every substep.
* drape: steps of random actions in ClothDrape-v0 with ``self_collision="strict"``, by target.

``clothgym.geometry.intersections`` defines the count, and is independent of self-collision.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
from cases import Case, Row, fill, parsed, table
from tqdm import tqdm

from clothgym import ClothMesh, Simulation, disc, grid
from clothgym._jit import kernel
from clothgym.geometry.intersections import count_intersections
from clothgym.starts import MANEUVERS, Maneuver

RESULT = Path(__file__).parent / "results" / "self_collision.json"
SEEDS, FRAME = 5, 1 / 60
FOLLOWED = ("13x13", "25x25")  # meshes that are counted after every substep
DRAGGING = 10.0  # seconds of the maneuvers without end
MESHES: dict[str, Callable[[], ClothMesh]] = {
    "13x13": lambda: grid(13, 13, 1.0, 1.0),
    "25x25": lambda: grid(25, 25, 1.0, 1.0),
    "disc": lambda: disc(0.5, 12),
    "37x37": lambda: grid(37, 37, 1.0, 1.0),
    "49x49": lambda: grid(49, 49, 1.0, 1.0),
}
COMPARED = "25x25"  # the mesh on which all modes are compared
THICKNESSES = (8, 4, 2)  # [mm]
TARGETS = {"box": "box", "sphere": "sphere", "capsule": "post"}  # the environment calls an upright capsule a post
STEPS, LANES = 20_000, 50


@kernel
def push_apart(x, v, held, rest, diameter):
    """Move particles that are nearer than ``diameter`` [m] to that distance, and take the velocity with which they approach.

    x [m], v [m/s]: (block, particle, 3, lane); held: (block, particle, lane); rest [m]: (particles, 3).  Pairs are found by sorting
    along x; those nearer than ``diameter`` at rest are left alone.
    """
    for b in range(x.shape[0]):
        for l in range(x.shape[3]):
            order = np.argsort(x[b, 0, :, l].copy())
            for m in range(len(order)):
                i = order[m]
                for n in range(m + 1, len(order)):
                    j = order[n]
                    if x[b, 0, j, l] - x[b, 0, i, l] >= diameter:
                        break
                    dx, dy, dz = x[b, 0, j, l] - x[b, 0, i, l], x[b, 1, j, l] - x[b, 1, i, l], x[b, 2, j, l] - x[b, 2, i, l]
                    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                    shares = (not held[b, i, l]) + (not held[b, j, l])
                    if distance >= diameter or distance == 0 or shares == 0:
                        continue
                    ex, ey, ez = rest[j, 0] - rest[i, 0], rest[j, 1] - rest[i, 1], rest[j, 2] - rest[i, 2]
                    if ex * ex + ey * ey + ez * ez <= diameter * diameter:
                        continue
                    closing = (v[b, 0, j, l] - v[b, 0, i, l]) * dx + (v[b, 1, j, l] - v[b, 1, i, l]) * dy
                    closing += (v[b, 2, j, l] - v[b, 2, i, l]) * dz
                    out = (diameter - distance) / distance / shares
                    stop = -min(closing, 0.0) / (distance * distance) / shares
                    for c, d in ((0, dx), (1, dy), (2, dz)):
                        if not held[b, i, l]:
                            x[b, c, i, l] -= out * d
                            v[b, c, i, l] -= stop * d
                        if not held[b, j, l]:
                            x[b, c, j, l] += out * d
                            v[b, c, j, l] += stop * d


def with_spheres(name: str, mesh: ClothMesh, seeds: range, thickness: float, diameter: float) -> Iterator[Maneuver]:
    """A maneuver after each of its frames, with particles as balls; a control step is a substep, between which they push."""
    substeps = Simulation(mesh, time_step=FRAME).substeps
    maneuver = MANEUVERS[name](mesh, seeds=seeds, thickness=thickness, time_step=FRAME / substeps, substeps=1)
    simulation = maneuver.simulation
    held = np.zeros((len(seeds), mesh.num_particles), bool)
    while not over(maneuver):
        for _ in range(substeps):
            maneuver.step()
            held[:, simulation.anchors] = simulation.attached
            blocks = simulation.layout.to_blocks(held, np.dtype(bool))
            push_apart(simulation.view.x, simulation.view.v, blocks, mesh.rest_positions, diameter)
        yield maneuver


def with_simulation(name: str, mesh: ClothMesh, seeds: range, thickness: float, options: Row) -> Iterator[Maneuver]:
    """A maneuver after each of its frames."""
    maneuver = MANEUVERS[name](mesh, seeds=seeds, thickness=thickness, **{"time_step": FRAME} | options)
    while not over(maneuver):
        maneuver.step()
        yield maneuver


def over(maneuver: Maneuver) -> bool:
    return maneuver.over or maneuver.time >= (DRAGGING if "drag" in type(maneuver).__name__.lower() else np.inf) - 1e-9


def measure_maneuver(maneuver: str, mesh: str, mode: str, thickness_mm: float) -> Row:
    """Frames of all seeds, and of how many each, and in how many something intersected."""
    sheet, thickness = MESHES[mesh](), thickness_mm / 1000
    given = maneuver, sheet, range(SEEDS), thickness
    if "spheres" in mode:
        spacing = float(sheet.springs.rest_length.min())
        frames = with_spheres(*given, 0.9 * spacing if "covering" in mode else thickness)
    else:
        option = {} if mode == "none" else {"self_collision": {"mode": mode, "thickness": thickness}}
        frames = with_simulation(*given, option)
    begun = time.perf_counter()
    bad, worst, count, gap, lag, clamped = np.zeros(SEEDS, int), 0, 0, np.inf, 0.0, 0
    for state in tqdm(frames, desc=f"{maneuver}, {mesh}, {mode}, {thickness_mm} mm", unit="frame", leave=False, disable=None):
        found = count_intersections(sheet.triangles, state.simulation.positions)
        bad += found > 0
        worst = max(worst, int(found.max()))
        count += 1
        if mode in ("fast", "strict"):
            report = state.simulation.self_contacts
            gap, lag = min(gap, float(report.gap.min())), max(lag, float(report.lag.max()))
            clamped += int(report.clamped.sum())
    row: Row = {"frames": count * SEEDS, "intersecting": int(bad.sum()), "by_seed": bad.tolist(), "worst": worst}
    if mode in ("fast", "strict"):
        row |= {"gap_mm": 1000 * gap, "lag_mm": 1000 * lag, "clamped": clamped}
    return row | {"diverged": int(state.simulation.diverged.sum()), "wall_s": round(time.perf_counter() - begun, 1)}


def measure_substeps(maneuver: str, mesh: str, thickness_mm: float) -> Row:
    """Substeps of one strict sheet, and in how many of them something intersected."""
    sheet, thickness = MESHES[mesh](), thickness_mm / 1000
    option: Row = {"self_collision": {"mode": "strict", "thickness": thickness}}
    # the substep is that of control steps of the usual length
    substeps = MANEUVERS[maneuver](sheet, seeds=[0], thickness=thickness, time_step=FRAME, **option).simulation.substeps
    option |= {"time_step": FRAME / substeps, "substeps": 1}
    begun, bad, count = time.perf_counter(), 0, 0
    frames = with_simulation(maneuver, sheet, range(1), thickness, option)
    for state in tqdm(frames, desc=f"{maneuver}, {mesh}, substeps", unit="substep", leave=False, disable=None):
        bad += int(count_intersections(sheet.triangles, state.simulation.positions)[0] > 0)
        count += 1
    return {"substeps": count, "intersecting": bad, "wall_s": round(time.perf_counter() - begun, 1)}


def measure_drape(target: str) -> Row:
    """Environment steps of random actions, summed over a batch; episodes begin again when they end."""
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=LANES, autoreset_mode="Disabled", self_collision="strict")
    options = {"target": {"shape": TARGETS[target]}}
    env.reset(seed=0, options=options)
    random = np.random.default_rng(0)
    simulation = env.unwrapped.task.simulation
    bad, worst, failures, gap = 0, 0, 0, np.inf
    for _ in tqdm(range(STEPS // LANES), desc=f"drape, {target}", leave=False, disable=None):
        _, _, terminated, truncated, info = env.step(random.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        found = count_intersections(simulation.mesh.triangles, simulation.positions)
        bad, worst = bad + int((found > 0).sum()), max(worst, int(found.max()))
        gap = min(gap, float(simulation.self_contacts.gap.min()))
        ended = terminated | truncated
        failures += int(np.count_nonzero(info["failure"][ended]))
        if ended.any():
            env.reset(options=options | {"reset_mask": ended})
    env.close()
    return {"steps": STEPS, "intersecting": bad, "worst": worst, "gap_mm": 1000 * gap, "failures": failures}


def cases() -> dict[str, list[Case]]:
    """All cases, those of coarse sheets first."""
    rows: list[Row] = []
    for mesh in MESHES:
        for name in MANEUVERS:
            for thickness in THICKNESSES:
                modes = ["strict"]
                if mesh == COMPARED:
                    modes += ["fast"] + (["none", "spheres", "covering spheres"] if thickness == THICKNESSES[0] else [])
                rows += [{"maneuver": name, "mesh": mesh, "mode": mode, "thickness_mm": thickness} for mode in modes]
    followed = [{"maneuver": name, "mesh": mesh, "thickness_mm": 4} for mesh in FOLLOWED for name in MANEUVERS]
    return {
        "maneuvers": [(measure_maneuver, row) for row in rows],
        "substeps": [(measure_substeps, row) for row in followed],
        "drape": [(measure_drape, {"target": target}) for target in TARGETS],
    }


ABOUT = {
    "frames": "control steps of 1/60 s of all seeds; intersecting: those in which two triangles had a point in common that they "
    "should not have; worst: most such pairs of one sheet in one frame",
    "spheres": "particles as balls, pushed apart fully in each substep without their approach velocity, no friction; diameter: the "
    "thickness, or 0.9 spacings where covering; pairs nearer than that at rest do not collide",
    "physics": "cotton, semi_implicit_euler, automatic substeps, sheets of 1 m, floor with friction 0.5",
}


def main() -> None:
    args = parsed(__doc__)
    results = fill(RESULT, cases(), args.select, args.fresh, ABOUT)
    for name in cases():
        if results.get(name):
            print(f"\n{name}\n{table(results[name])}")


if __name__ == "__main__":
    main()

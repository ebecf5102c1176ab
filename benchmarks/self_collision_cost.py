"""Cost of self-collision: relative to none, by number of particles, and compared with MuJoCo.

    pip install "mujoco-core>=4.0.1" matplotlib tqdm
    python benchmarks/self_collision_cost.py                      # measures what the results lack, prints tables, draws the plot
    python benchmarks/self_collision_cost.py --select cost alone  # cases whose names hold all these words

Sections of ``results/self_collision_cost.json``; all on one thread, semi-implicit Euler with automatic substeps, cotton, 8 mm
unless said:

* cost: milliseconds of a control step of 1/60 s per environment on 25 x 25, and ratios to none.  The modes take turns frame by
  frame in one process.  Of a state the median frame counts, of an episode the sum of all frames, the faster of two runs of each.
* growth: the same from 13 x 13 to 100 x 100 at the same spacing, of one environment; ``docs/self_collision.png`` shows it.
* mujoco: frames/s of a sheet of half a meter that falls on its edge, for two seconds, by MuJoCo's ``ipc`` mode, by its ordinary
  contacts, and by ours; and in how many frames something intersected, counted in all by the same exact method.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import matplotlib
import mujoco
import numpy as np
from cases import Case, Row, fill, parsed, table
from numpy.typing import NDArray
from tqdm import tqdm

from clothgym import ClothMesh, Material, Plane, Simulation, grid
from clothgym.geometry.intersections import count_intersections
from clothgym.starts import FRICTION, Drag, EdgeDrop, Fold, Heap, Maneuver, ZFold

matplotlib.use("Agg")
from matplotlib import pyplot as plt

RESULT = Path(__file__).parent / "results" / "self_collision_cost.json"
PICTURE = Path(__file__).parent.parent / "docs" / "self_collision.png"
THICKNESS, LANES = 0.008, 64
# the sheet that falls on its edge, here and in MuJoCo
FRAME, ROWS, SIDE, SECONDS, DROP, THIN = 1 / 60, 25, 0.5, 2.0, 0.05, 0.004
COTTON = Material.preset("penava_cotton")
YOUNG, POISSON, SHEET_THICKNESS = 0.821e6, 0.243, 0.318e-3  # from the source of the preset: [Pa], [m]
MODES = ("none", "fast", "strict")
WARM, TIMED = 20, 60  # frames of a state
ROUNDS = 2  # of an episode; of each frame the faster run counts
SETTLING = 4.0  # seconds after a maneuver
# what strict mode may cost, over none
LIMITS = {"hanging": 1.5, "flat": 1.5, "settled heap": 3.0, "settled three-layer fold": 6.0}
LIMITS |= {"falling": 10.0, "folding": 10.0, "dragging at 1 m/s": 10.0}
ALONE_LIMIT = 2.6
EPISODES: dict[str, Callable[..., Maneuver]] = {
    "falling": EdgeDrop,
    "folding": Fold,
    "dragging at 1 m/s": partial(Drag, speed=1.0, seconds=10.0),
}
SETTLED: dict[str, Callable[..., Maneuver]] = {"settled heap": Heap, "settled three-layer fold": partial(ZFold, leaves=3)}
SPACING = 1 / 24  # of the sheets that grow [m]
SIDES = (13, 17, 25, 35, 49, 71, 100)
LEAF = 8  # cells of a leaf of the folded sheet that grows

THEIRS = [
    {"engine": "MuJoCo", "contact": contact, "steps": steps}
    for contact, counts in (("ipc", (1, 4)), ("ordinary", (4,)))
    for steps in counts
]
TARGET_RATIO = 50  # times the frames/s of MuJoCo's ipc mode on one core

ABOUT = {
    "cost": "ms per environment and control step of 1/60 s; 64 environments with different seeds, or one alone; ratios to none. "
    "hanging: from two corners, at rest; flat: on the floor; falling: an upright sheet drops on its edge, 5 s; folding: in half, "
    "4 s; dragging: a corner at 1 m/s, 10 s",
    "growth": "spacing 41.7 mm at all sizes; folded: leaves of 8 cells, the first second of its fall; alone on one thread",
    "mujoco": "25 x 25, 0.5 m, cotton, upright, falls 5 cm on its edge, 2 s. MuJoCo 4: 2D flex, discrete integrator, Newton "
    "solver, flex radius 2 mm, selfcollide auto, plane below, contacts of ipc are frictionless; steps a frame of 1/60 s as stated. "
    "clothgym: strict, thickness 4 mm, friction 0.3 and 0.5 on the floor, automatic substeps; a batch's frames/s are summed",
}


def option(mode: str, thickness: float = THICKNESS) -> Row:
    return {"threads": 1} | ({} if mode == "none" else {"self_collision": {"mode": mode, "thickness": thickness}})


def interleaved(steps: dict[str, Callable[[], object]], frames: int) -> dict[str, list[float]]:
    """Seconds that each frame took, by mode; the modes take turns, and so does who begins."""
    times: dict[str, list[float]] = {mode: [] for mode in steps}
    for frame in tqdm(range(frames), unit="frame", leave=False, disable=None):
        order = list(steps)
        for mode in order[frame % len(order) :] + order[: frame % len(order)]:
            begun = time.perf_counter()
            steps[mode]()
            times[mode].append(time.perf_counter() - begun)
    return times


def row_of(seconds: dict[str, float], envs: int, limit: float) -> Row:
    """ms per environment, and ratios."""
    row: Row = {f"{mode}_ms": 1000 * s / envs for mode, s in seconds.items()}
    row |= {f"{mode}_ratio": s / seconds["none"] for mode, s in seconds.items() if mode != "none"}
    return row | {"limit": limit, "within": bool(row["strict_ratio"] <= limit)}


@lru_cache
def settled(name: str, side: int, envs: int) -> NDArray:
    """Sheets that have come to rest in strict mode [m], (envs, particles, 3)."""
    maneuver = SETTLED[name](grid(side, side, 1.0, 1.0), seeds=range(envs), thickness=THICKNESS, **option("strict"))
    while not maneuver.over:
        maneuver.step()
    maneuver.simulation.step(round(SETTLING / FRAME))
    return maneuver.simulation.positions


@lru_cache
def hung(side: int) -> NDArray:
    """A sheet that hangs by two corners and no longer swings [m], (particles, 3)."""
    mesh = grid(side, side, 1.0, 1.0)
    simulation = Simulation(mesh, anchors=list(mesh.corners[2:]), **option("strict"))
    simulation.reset(positions=mesh.rest_positions[:, [0, 2, 1]] + (0, 0, 0.7))
    simulation.step(round(2 * SETTLING / FRAME))
    return simulation.positions[0]


def of_a_state(mesh: ClothMesh, x: NDArray, envs: int, anchors: list[int], frames: int = TIMED) -> dict[str, float]:
    """Median seconds of a frame from those positions, by mode."""
    steps = {}
    for mode in MODES:
        simulation = Simulation(mesh, num_envs=envs, colliders=[Plane(friction=FRICTION)], anchors=anchors, **option(mode))
        simulation.reset(positions=x)
        simulation.step(WARM)
        steps[mode] = simulation.step
    return {mode: statistics.median(times) for mode, times in interleaved(steps, frames).items()}


def of_an_episode(make: Callable[[str], Maneuver], seconds: float = np.inf) -> dict[str, float]:
    """Mean seconds of a frame, by mode; of each frame the faster of several runs counts, and the attachments' scripts do not."""
    best: dict[str, NDArray] = {}
    for _ in range(ROUNDS):
        maneuvers = {mode: make(mode) for mode in MODES}
        times: dict[str, list[float]] = {mode: [] for mode in MODES}
        steps = {}
        for mode, maneuver in maneuvers.items():
            maneuver.simulation.step = _clocked(maneuver.simulation.step, times[mode])  # type: ignore[method-assign]
            steps[mode] = maneuver.step
        first = maneuvers["none"]
        interleaved(steps, round(min(first.seconds, seconds) / first.simulation.time_step))
        for mode in MODES:
            best[mode] = np.minimum(best.get(mode, np.inf), times[mode])
    return {mode: float(np.mean(times)) for mode, times in best.items()}


def _clocked(step: Callable[..., None], times: list[float]) -> Callable[..., None]:
    def clocked(n: int = 1) -> None:
        begun = time.perf_counter()
        step(n)
        times.append(time.perf_counter() - begun)

    return clocked


def measure_cost(case: str, envs: int) -> Row:
    mesh = grid(25, 25, 1.0, 1.0)
    limit = ALONE_LIMIT if envs == 1 else LIMITS[case]
    if case in EPISODES:
        loaded = EPISODES[case](mesh, seeds=[0])
        for mode in MODES:  # kernels are loaded before the clock runs
            Simulation(mesh, num_envs=envs, anchors=loaded.simulation.anchors.tolist(), **option(mode)).step()
        return row_of(
            of_an_episode(lambda mode: EPISODES[case](mesh, seeds=range(envs), thickness=THICKNESS, **option(mode))),
            envs,
            limit,
        )
    anchors: list[int] = []
    x = mesh.rest_positions + (0, 0, 0.001)
    if case == "hanging":
        anchors, x = list(mesh.corners[2:]), hung(25)
    elif case in SETTLED:
        x = settled(case, 25, envs)
    return row_of(of_a_state(mesh, x, envs, anchors), envs, limit)


def measure_growth(side: int, scene: str) -> Row:
    mesh = grid(side, side, (side - 1) * SPACING, (side - 1) * SPACING)
    if scene == "flat":
        seconds = of_a_state(mesh, mesh.rest_positions + (0, 0, 0.001), 1, [])
    else:
        for mode in MODES:
            Simulation(mesh, **option(mode)).step()
        leaves = max(1, (side - 1) // LEAF)
        seconds = of_an_episode(lambda mode: ZFold(mesh, thickness=THICKNESS, leaves=leaves, **option(mode)), TIMED * FRAME)
    return {"particles": side * side} | {f"{mode}_ms": 1000 * s for mode, s in seconds.items()}


def mujoco_model(contact: str, steps: int) -> Any:
    """The scene with MuJoCo's ``ipc`` contacts or its ordinary ones, with ``steps`` steps per frame."""
    spacing = SIDE / (ROWS - 1)
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco>
          <size memory="200M"/>
          <option timestep="{FRAME / steps!r}" integrator="discrete" solver="Newton" gravity="0 0 -9.81">
            <flag ipc="{"enable" if contact == "ipc" else "disable"}"/>
          </option>
          <worldbody>
            <geom type="plane" size="2 2 0.1"/>
            <flexcomp name="sheet" type="grid" dim="2" count="{ROWS} {ROWS} 1" spacing="{spacing!r} {spacing!r} 1"
                      radius="{THIN / 2!r}" pos="0 0 {SIDE / 2 + DROP!r}" euler="88 0 0">
              <contact selfcollide="auto"/>
              <elasticity young="{YOUNG!r}" poisson="{POISSON!r}" thickness="{SHEET_THICKNESS!r}" damping="{COTTON.damping_time!r}"
                          elastic2d="both"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    for body in spec.bodies[1:]:
        borders = int(np.sum(np.isclose(np.abs(body.pos[:2]), SIDE / 2)))
        body.mass = COTTON.density * spacing**2 / 2**borders
    return spec.compile()


def start_of(model: Any) -> Any:
    """Initial data, with a slightly uneven sheet."""
    data = mujoco.MjData(model)
    data.qpos[:] += np.random.default_rng(0).normal(scale=2e-5, size=model.nq)
    mujoco.mj_forward(model, data)
    return data


def measure_mujoco(engine: str, contact: str, steps: int) -> Row:
    """One sheet on one core; processor time, which other programs on the machine disturb least."""
    model = mujoco_model(contact, steps)
    triangles = model.flex_elem.reshape(-1, 3)
    best, counts, warned = np.full(round(SECONDS / FRAME), np.inf), [], 0
    for _ in range(ROUNDS):
        data = start_of(model)
        for frame in tqdm(range(len(best)), desc=f"{engine} {contact} {steps}", leave=False, disable=None):
            begun = time.process_time()
            mujoco.mj_step(model, data, nstep=steps)
            best[frame] = min(best[frame], time.process_time() - begun)
            counts.append(int(count_intersections(triangles, data.flexvert_xpos)[0]))
        warned = sum(warning.number for warning in data.warning)
    return _speeds(best, 1) | _counted(np.array(counts[-len(best) :])) | {"warnings": int(warned)}


def measure_ours(engine: str, contact: str, lanes: int) -> Row:
    """A batch of sheets on one core."""
    mesh = grid(ROWS, ROWS, SIDE, SIDE)
    maneuver = EdgeDrop(mesh, COTTON, seeds=range(lanes), thickness=THIN, **option(contact, THIN))
    simulation = maneuver.simulation
    simulation.step()  # loads the kernels
    best, counts = np.full(round(SECONDS / FRAME), np.inf), []
    for _ in range(ROUNDS):
        simulation.reset(positions=maneuver.start - (0, 0, 0.1 * SIDE - DROP))
        for frame in tqdm(range(len(best)), desc=f"{engine} {contact} {lanes}", leave=False, disable=None):
            begun = time.process_time()
            simulation.step()
            best[frame] = min(best[frame], time.process_time() - begun)
            counts.append(count_intersections(mesh.triangles, simulation.positions))
    return {"steps": simulation.substeps} | _speeds(best, lanes) | _counted(np.array(counts[-len(best) :]))


def _counted(counts: NDArray) -> Row:
    """Frames with an intersection, and the most pairs; counts: (frames, ...)."""
    return {"intersecting": int(np.sum(counts > 0)), "frames": counts.size, "worst": int(counts.max())}


def _speeds(times: NDArray, sheets: int) -> Row:
    """Frames/s over the whole run, in its slowest tenth and in its fastest; times of a batch's frames [s], (frames,)."""
    tenth = max(1, len(times) // 10)
    ordered = np.sort(times)
    speeds = {"frames/s": times.mean(), "slowest": ordered[-tenth:].mean(), "fastest": ordered[:tenth].mean()}
    return {name: float(sheets / seconds) for name, seconds in speeds.items()}


def cases() -> dict[str, list[Case]]:
    ours = [{"engine": "clothgym", "contact": "strict", "lanes": lanes} for lanes in (1, LANES)]
    return {
        "cost": [(measure_cost, {"case": case, "envs": envs}) for envs in (LANES, 1) for case in LIMITS],
        "growth": [(measure_growth, {"side": side, "scene": scene}) for side in SIDES for scene in ("flat", "folded")],
        "mujoco": [(measure_mujoco, key) for key in THEIRS] + [(measure_ours, key) for key in ours],
    }


def print_ratio(rows: list[Row]) -> None:
    """Our frames/s over those of MuJoCo's ipc mode."""
    ours = {row["lanes"]: row["frames/s"] for row in rows if row["engine"] == "clothgym"}
    for row in rows:
        if row["contact"] == "ipc":
            ratios = ", ".join(f"{lanes} lanes {speed / row['frames/s']:.0f} times" for lanes, speed in ours.items())
            print(f"over MuJoCo's ipc with {row['steps']} steps a frame: {ratios} (wanted: {TARGET_RATIO})")


def draw(rows: list[Row], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    colors = {"none": "#8d99ae", "fast": "#edae49", "strict": "#d1495b"}
    for scene, style in (("folded", {}), ("flat", {"ls": "--", "mfc": "white"})):
        chosen = sorted((row for row in rows if row["scene"] == scene), key=lambda row: row["particles"])
        for mode, color in colors.items():
            figures = [row[f"{mode}_ms"] for row in chosen]
            axes.plot(
                [r["particles"] for r in chosen],
                figures,
                marker="o",
                ms=3.5,
                lw=1.4,
                color=color,
                label=f"{mode}, {scene}",
                **style,
            )
    axes.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms per control step of 1/60 s, one core")
    axes.set_title("Cost of self-collision by size, one environment, spacing 42 mm", loc="left", fontsize=11)
    axes.legend(frameon=False, fontsize=8.5)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    args = parsed(__doc__)
    results = fill(RESULT, cases(), args.select, args.fresh, ABOUT | {"mujoco version": mujoco.__version__})
    for name in cases():
        if results.get(name):
            print(f"\n{name}\n{table(results[name])}")
    if results.get("mujoco"):
        print_ratio(results["mujoco"])
    if results.get("growth"):
        draw(results["growth"], PICTURE)


if __name__ == "__main__":
    main()

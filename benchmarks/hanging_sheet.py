"""A hanging sheet, compared with MuJoCo: error over cost on one core.

    pip install "mujoco-core>=4.0.1" matplotlib
    python benchmarks/hanging_sheet.py                    # measures what the results lack, prints the tables, draws the plot
    python benchmarks/hanging_sheet.py --select ours      # one section only: ours, mujoco or static
    python benchmarks/hanging_sheet.py --fresh            # measures again, about six minutes

A 25 x 25 sheet of cotton, 1 m, flat and at rest, falls for half a second while two neighboring corners are held; there is
neither contact nor air.  The error is the rms distance over particles, at the end, from the same simulator's converged run, so
that none is measured by another's discretization.  Frames of 1/60 s are timed on one thread, and the median counts; those of a
batch are summed over its environments.  Sections of ``results/hanging_sheet.json``:

* ours, mujoco: error [mm] and frames/s; claim: for each setting of MuJoCo, our fastest setting with no greater error;
* static: stretch under its own weight of a sheet held along one edge, over that of the converged run, minus one.
"""

from __future__ import annotations

import json
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib
import mujoco
import numpy as np
from cases import Case, Row, fill, parsed, table
from numpy.typing import NDArray

from clothgym import Material, Simulation, grid

matplotlib.use("Agg")
from matplotlib import pyplot as plt

RESULT = Path(__file__).parent / "results" / "hanging_sheet.json"
ROWS, SIDE, FRAME, FRAMES = 25, 1.0, 1 / 60, 30  # [m], [s]
ENOUGH = 1.5  # seconds of frames whose median counts
SHEET = grid(ROWS, ROWS, SIDE, SIDE)
COTTON = Material.preset("penava_cotton")
# where the preset comes from: Young's modulus [Pa], Poisson's ratio, thickness [m]
YOUNG, POISSON, THICKNESS = 0.821e6, 0.243, 0.318e-3

EULER, XPBD, DISCRETE, MUJOCO_EULER = "semi_implicit_euler", "xpbd", "MuJoCo discrete", "MuJoCo Euler"
DAMPED = COTTON.damping_time
OURS = [
    {"method": method, "damping_time": damping_time, "substeps": substeps}
    for method, damping_time, counts in (
        (EULER, DAMPED, (25, 28, 32, 36, 40, 48, 64, 80, 112, 160)),
        (XPBD, DAMPED, (10, 20, 40, 80, 160, 320)),
        (XPBD, 0.0, (10, 20, 40, 80, 160, 320)),
    )
    for substeps in counts
]
LANES = (1, 64, 128)
CONVERGED = 2560
MUJOCO = [
    {"method": method, "bending": bending, "substeps": substeps}
    for bending in (True, False)
    # fewer than 30 steps a frame are unstable with MuJoCo's Euler on this sheet
    for method, counts in ((DISCRETE, (1, 2, 4, 8, 16, 32)), (MUJOCO_EULER, (30, 32, 40, 64)))
    for substeps in counts
]
MUJOCO_CONVERGED = 160
ABOUT = {
    "scene": "25 x 25 particles, 1 m x 1 m, cotton (E t = 261 N/m, nu 0.243, 0.1503 kg/m^2, plate rigidity 2.34e-6 N m), flat "
    "and at rest at t = 0, two neighboring corners held, no contact, no air; error after 0.5 s",
    "clothgym": "spring grid, float32 (converged: float64, 2560 substeps a frame); damping along springs, damping_time as stated",
    "mujoco": "2D flex, float64: Saint Venant-Kirchhoff triangles with the same moduli, thickness and masses and, where 'bending', "
    "the same rigidity; Rayleigh damping 1e-4 s; Newton solver; contact off; converged: the same integrator at dt = 1/9600 s",
    "claim": "our fastest setting with the cotton's damping whose error is no larger; ratios of frames/s on one core: our batch's "
    "sum, and our single sheet, over MuJoCo's single sheet",
}


def rms(a: NDArray, b: NDArray) -> float:
    """Root of the mean squared distance of particles [mm]; positions [m], (particles, 3)."""
    return float(1e3 * np.sqrt(np.mean(np.sum((a.astype(np.float64) - b) ** 2, axis=1))))


def simulation(method: str, damping_time: float, substeps: int, air_drag: float = 0.0, **kwargs: Any) -> Simulation:
    material = replace(COTTON, damping_time=damping_time, air_drag=air_drag)
    defaults: dict[str, Any] = {"anchors": SHEET.corners[2:], "threads": 1, "time_step": FRAME, "air_density": 0.0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # settings beyond a method's bound are part of the plot
        return Simulation(SHEET, material, integrator=method, substeps=substeps, **defaults | kwargs)


def timed(step: Callable[[], object], frames: int) -> list[float]:
    """Processor time of each call [s], which other programs on the machine disturb less than the time on the clock."""
    times = []
    for _ in range(frames):
        begun = time.process_time()
        step()
        times.append(time.process_time() - begun)
    return times


@lru_cache
def converged(method: str, damping_time: float) -> NDArray:
    s = simulation(method, damping_time, CONVERGED, dtype="float64")
    s.step(FRAMES)
    return s.positions[0]


def measure_ours(method: str, damping_time: float, substeps: int, lanes: int) -> Row:
    s = simulation(method, damping_time, substeps, num_envs=lanes)
    s.step()  # loads the kernels
    times: list[float] = []
    while sum(times) < ENOUGH:
        s.reset()
        times += timed(s.step, FRAMES)
    return {"error_mm": rms(s.positions[0], converged(method, damping_time)), "frames/s": lanes / statistics.median(times)}


def mujoco_model(method: str, bending: bool, steps: int) -> Any:
    """The same sheet as a flex; the held corners are those of ours."""
    last, spacing = ROWS - 1, SIDE / (ROWS - 1)
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco>
          <option timestep="{FRAME / steps!r}" integrator="{method.split()[1]}" solver="Newton" gravity="0 0 -9.81"/>
          <worldbody>
            <flexcomp name="sheet" type="grid" dim="2" count="{ROWS} {ROWS} 1" spacing="{spacing!r} {spacing!r} 1" radius="0.001">
              <pin id="{last} {ROWS * ROWS - 1}"/>
              <contact contype="0" conaffinity="0" selfcollide="none"/>
              <elasticity young="{YOUNG!r}" poisson="{POISSON!r}" thickness="{THICKNESS!r}" damping="{DAMPED!r}"
                          elastic2d="{"both" if bending else "stretch"}"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    # flexcomp gives all particles the same mass; ours have their share of the area
    for body in spec.bodies[1:]:
        borders = int(np.sum(np.isclose(np.abs(body.pos[:2]), SIDE / 2)))
        body.mass = COTTON.density * spacing**2 / 2**borders
    return spec.compile()


def mujoco_run(method: str, bending: bool, steps: int) -> tuple[NDArray, list[float]]:
    """Positions at the end [m], ordered as ours, and the seconds that each frame took."""
    model = mujoco_model(method, bending, steps)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # by y, then by x
    order = np.lexsort(data.flexvert_xpos[:, :2].round(6).T)
    times = timed(lambda: mujoco.mj_step(model, data, nstep=steps), FRAMES)
    if any(warning.number for warning in data.warning):
        raise RuntimeError(f"{method} diverged with {steps} steps a frame")
    mujoco.mj_forward(model, data)
    return data.flexvert_xpos[order].copy(), times


@lru_cache
def mujoco_converged(method: str, bending: bool) -> NDArray:
    return mujoco_run(method, bending, MUJOCO_CONVERGED)[0]


def measure_mujoco(method: str, bending: bool, substeps: int) -> Row:
    end, times = mujoco_run(method, bending, substeps)
    while sum(times) < ENOUGH:
        times += mujoco_run(method, bending, substeps)[1]
    return {
        "error_mm": rms(end, mujoco_converged(method, bending)),
        "frames/s": 1 / statistics.median(times),
        "converged_from_ours_mm": rms(mujoco_converged(method, bending), converged(EULER, DAMPED)),
    }


def stretch(method: str, damping_time: float, substeps: int, dtype: str) -> float:
    """How far the lower edge of a sheet that hangs from its upper edge comes down under its weight [m]."""
    edge = np.arange(SHEET.num_particles - ROWS, SHEET.num_particles)
    # thick air: the slowest mode dies out within some tenths of a second
    s = simulation(method, damping_time, substeps, air_drag=10.0, dtype=dtype, anchors=edge)
    hanging = SHEET.rest_positions[:, [0, 2, 1]]
    s.reset(positions=hanging)
    s.step(60)
    return float(np.mean(hanging[:ROWS, 2] - s.positions[0, :ROWS, 2].astype(np.float64)))


def measure_static(method: str, damping_time: float, substeps: int) -> Row:
    reference = stretch(EULER, DAMPED, 160, "float64")  # explicit: its rest does not depend on the substep
    found = stretch(method, damping_time, substeps, "float32")
    return {"stretch_mm": 1e3 * found, "error": found / reference - 1}


def claims(results: Row) -> list[Row]:
    """For each of MuJoCo's settings our fastest that errs no more, in a batch and alone."""
    rows = []
    ours = [row for row in results.get("ours", []) if row["damping_time"] == DAMPED]
    for theirs in results.get("mujoco", []):
        row = {key: theirs[key] for key in ("method", "bending", "substeps", "error_mm", "frames/s")}
        for name, widest in (("batch", max(LANES)), ("single", 1)):
            fit = [r for r in ours if r["lanes"] <= widest and r["error_mm"] <= theirs["error_mm"]]
            best = max(fit, key=lambda r: r["frames/s"], default=None)
            row |= {name: best, f"{name}_ratio": best["frames/s"] / theirs["frames/s"] if best else None}
        rows.append(row)
    return rows


def draw(results: Row, path: Path) -> None:
    colors = {EULER: "#d1495b", XPBD: "#edae49", DISCRETE: "#2b2d42", MUJOCO_EULER: "#8d99ae"}
    figure, axes = plt.subplots(figsize=(8.4, 4.4), layout="constrained")

    def line(rows: list[Row], label: str, **style: Any) -> None:
        seconds = [1 / (FRAME * row["frames/s"]) for row in rows]
        style = {"marker": "o", "ms": 3.5, "lw": 1.4} | style
        axes.plot(seconds, [row["error_mm"] for row in rows], color=colors[rows[0]["method"]], label=label, **style)

    for method in (EULER, XPBD):
        for lanes, style in ((LANES[-1], {}), (1, {"ls": "--", "lw": 1.0, "mfc": "white"})):
            rows = [r for r in results["ours"] if (r["method"], r["lanes"], r["damping_time"]) == (method, lanes, DAMPED)]
            line(rows, f"clothgym {method}, " + ("alone" if lanes == 1 else f"one of {lanes}"), **style)
    for method in (DISCRETE, MUJOCO_EULER):
        for bending, style in ((True, {}), (False, {"ls": "--", "lw": 1.0, "mfc": "white"})):
            rows = [r for r in results["mujoco"] if (r["method"], r["bending"]) == (method, bending)]
            line(rows, method + ("" if bending else ", without bending"), **style)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds of one core per simulated second of one sheet",
        ylabel="rms error after 0.5 s [mm]",
    )
    axes.set_title("Hanging sheet, 25 x 25, cotton, 1 m", loc="left", fontsize=11)
    axes.legend(frameon=False, fontsize=8.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    args = parsed(__doc__)
    cases: dict[str, list[Case]] = {
        "ours": [(measure_ours, setting | {"lanes": lanes}) for setting in OURS for lanes in LANES],
        "mujoco": [(measure_mujoco, setting) for setting in MUJOCO],
        "static": [(measure_static, setting) for setting in OURS],
    }
    results = fill(RESULT, cases, args.select, args.fresh, ABOUT | {"mujoco version": mujoco.__version__})
    results["claim"] = claims(results)
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    for name in (*cases, "claim"):
        if results.get(name):
            print(f"\n{name}\n{table(results[name])}")
    if results.get("ours") and results.get("mujoco"):
        draw(results, RESULT.with_suffix(".png"))


if __name__ == "__main__":
    main()

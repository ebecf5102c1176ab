"""Which integrator, with how many substeps, each task should take: error against cost on the task's own sheet and control step.

    python benchmarks/task_accuracy.py            # measures what the results lack, prints the tables, draws the plot
    python benchmarks/task_accuracy.py --fresh    # measures again, some ten minutes

* swing: the sheet, flat and held by its anchors (the gripper task's by the drape's), swings for half a second; the error is the rms
  distance of its particles from a converged run (float64, ``rk4``), by the sheet's side.
* static: stretch under its own weight of the sheet held along one edge, over that of the converged run, minus one.
* cost: median time of a control step of 128 sheets on one thread, divided by 128.

A task takes the cheapest setting that errs by 5 mm per meter or less, is stiff to 5 %, and has a substep of at most 0.9 of its
stability bound, if it has one.  Iterative methods are swept with the stated numbers of iterations.
"""

from __future__ import annotations

import statistics
import time
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cases import Row, fill, parsed
from numpy.typing import NDArray

from clothgym import INTEGRATORS, Simulation
from clothgym.envs.drape import DrapeTask
from clothgym.envs.physics import Physics
from clothgym.envs.reach import ReachTask
from clothgym.envs.strain import StrainTask

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import NullFormatter

RESULTS = Path(__file__).parent / "results" / "task_accuracy.json"
PICTURE = Path(__file__).parent.parent / "docs" / "task_accuracy.png"
TASKS = {"ClothReach-v0": ReachTask.physics, "ClothDrape-v0": DrapeTask.physics, "ClothStrain-v0": StrainTask.physics}
METHODS: tuple[tuple[str, dict[str, float], tuple[float, ...]], ...] = (
    # name, options, substeps as multiples of the task's own
    ("explicit_euler", {}, (4.0, 8.0, 16.0)),
    ("semi_implicit_euler", {}, (0.8, 1.0, 1.5, 2.0, 4.0)),
    ("verlet", {}, (0.8, 1.0, 1.5, 2.0, 4.0)),
    ("rk4", {}, (0.6, 0.8, 1.0, 2.0)),
    ("implicit_euler", {}, (0.1, 0.2, 0.4, 0.8, 1.6)),
    ("projective_dynamics", {"iterations": 4}, (0.4, 0.8, 1.6)),
    ("projective_dynamics", {"iterations": 10}, (0.2, 0.4, 0.8)),
    ("xpbd", {}, (1.0, 2.0, 4.0, 8.0)),
    ("xpbd", {"iterations": 4}, (0.5, 1.0, 2.0)),
    ("pbd", {}, (0.25, 1.0)),
)
LANES, FRAMES = 128, 12
CONVERGED = 8  # times the task's substeps, of rk4
MOST_ERROR, MOST_SOFTNESS, MOST_OF_BOUND = 5.0, 0.05, 0.9  # the first in mm per meter
BOUNDED = ("explicit_euler", "semi_implicit_euler", "verlet", "rk4")


def simulation(physics: Physics, method: dict[str, Any] | str, substeps: int, **kwargs: Any) -> Simulation:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # settings beyond a method's bound are part of the plot
        return Simulation(
            physics.mesh, physics.material, integrator=method, time_step=physics.time_step, substeps=substeps,
            air_density=physics.air_density, threads=1, on_divergence="ignore", **kwargs,
        )  # fmt: skip


def swing(physics: Physics, method: dict[str, Any] | str, substeps: int, dtype: str) -> NDArray:
    """Positions after half a second [m], (particles, 3)."""
    cloth = simulation(physics, method, substeps, dtype=dtype, anchors=physics.held)
    cloth.step(round(0.5 / physics.time_step))
    return cloth.positions[0].astype(np.float64)


def stretch(physics: Physics, method: dict[str, Any] | str, substeps: int, dtype: str) -> float:
    """How far the lower edge of the sheet comes down under its weight when its upper edge is held [m]."""
    rows, columns = physics.mesh.grid_shape
    edge = np.arange((rows - 1) * columns, rows * columns)
    cloth = simulation(physics, method, substeps, dtype=dtype, anchors=edge)
    cloth.set_parameters(warn=False, air_drag=10.0)  # the slowest mode dies out within some tenths of a second
    hanging = physics.mesh.rest_positions[:, [0, 2, 1]]
    cloth.reset(positions=hanging)
    cloth.step(round(1.0 / physics.time_step))
    return float(np.mean(hanging[:columns, 2] - cloth.positions[0, :columns, 2].astype(np.float64)))


@lru_cache
def converged(task: str) -> tuple[NDArray, float]:
    physics = TASKS[task]
    substeps = CONVERGED * physics.substeps
    return swing(physics, "rk4", substeps, "float64"), stretch(physics, "rk4", substeps, "float64")


def measure(environment: str, integrator: str, options: dict[str, float], substeps: int) -> Row:
    physics = TASKS[environment]
    end, fall = converged(environment)
    method = {"name": integrator, **options}
    with np.errstate(all="ignore"):
        away = swing(physics, method, substeps, "float32") - end
        error = float(np.sqrt(np.mean(np.sum(away**2, axis=1)))) * 1000 / physics.side
        softness = stretch(physics, method, substeps, "float32") / fall - 1
    cloth = simulation(physics, method, substeps, num_envs=LANES, anchors=physics.held)
    cloth.step()
    times = []
    for _ in range(FRAMES):
        begun = time.perf_counter()
        cloth.step()
        times.append(time.perf_counter() - begun)
    stable = bool(np.isfinite(error) and error < 1000)
    return {
        "error_mm_per_m": error if stable else None,
        "softness": softness if stable and np.isfinite(softness) else None,
        "us_per_step": statistics.median(times) / LANES * 1e6,
        "share_of_bound": physics.time_step / substeps / cloth.largest_substep()[0] if integrator in BOUNDED else None,
    }


def fits(row: Row) -> bool:
    """Whether a task may take that setting."""
    if row["integrator"] == "pbd" or row["error_mm_per_m"] is None or row["softness"] is None:
        return False
    kept = row["share_of_bound"] is None or row["share_of_bound"] <= MOST_OF_BOUND
    return row["error_mm_per_m"] <= MOST_ERROR and abs(row["softness"]) <= MOST_SOFTNESS and kept


def print_table(task: str, rows: list[Row]) -> None:
    print(f"\n{task}: {TASKS[task].time_step * 1e3:.3g} ms a control step")
    print(f"{'integrator':<40} {'substeps':>8} {'error [mm/m]':>13} {'static':>8} {'us/step':>8}")
    best = min((row for row in rows if fits(row)), key=lambda row: row["us_per_step"], default=None)
    for row in rows:
        options = "".join(f", {value:g} {key}" for key, value in row["options"].items())
        error = "unstable" if row["error_mm_per_m"] is None else f"{row['error_mm_per_m']:.2f}"
        softness = "" if row["softness"] is None else f"{row['softness']:+.1%}"
        mark = "  <- cheapest that fits" if row is best else ""
        print(f"{row['integrator'] + options:<40} {row['substeps']:>8} {error:>13} {softness:>8} {row['us_per_step']:>8.1f}{mark}")


def draw(rows: list[Row]) -> None:
    """Error over cost, a panel a task."""
    figure, panels = plt.subplots(1, len(TASKS), figsize=(12.6, 4.2), layout="constrained", sharey=True)
    colors = dict(zip(INTEGRATORS, plt.get_cmap("tab10").colors))  # type: ignore[attr-defined]
    for axes, task in zip(panels, TASKS):
        for name, options, _ in METHODS:
            line = [r for r in rows if (r["environment"], r["integrator"], r["options"]) == (task, name, options)]
            line = [r for r in line if r["error_mm_per_m"] is not None]
            label = name + "".join(f", {value:g} {key}" for key, value in options.items())
            style = "-" if not options or options.get("iterations") == 10 else "--"
            axes.plot(
                [r["us_per_step"] for r in line], [r["error_mm_per_m"] for r in line], style, marker="o", ms=3.5, lw=1.3,
                color=colors[name], label=label,
            )  # fmt: skip
        axes.axhline(MOST_ERROR, color="#8d99ae", lw=0.8)
        axes.set(xscale="log", yscale="log", xlabel="µs of one core a control step", title=task)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("rms error after 0.5 s [mm per meter of sheet]")
    panels[-1].annotate("5 mm per meter", (0.72, MOST_ERROR), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    panels[-1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(PICTURE, dpi=130)
    plt.close(figure)


def main() -> None:
    args = parsed(__doc__)
    keys = [
        {"environment": task, "integrator": name, "options": options, "substeps": round(multiple * physics.substeps)}
        for task, physics in TASKS.items()
        for name, options, multiples in METHODS
        for multiple in multiples
    ]
    rows = fill(RESULTS, {"rows": [(measure, key) for key in keys]}, args.select, args.fresh, {})["rows"]
    for task in TASKS:
        print_table(task, [row for row in rows if row["environment"] == task])
    draw(rows)


if __name__ == "__main__":
    main()

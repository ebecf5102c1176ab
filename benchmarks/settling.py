"""What brings a draped sheet to rest: its speed over time, for dampings with a measurement behind them and for one of them alone.

python benchmarks/settling.py              # table and results/settling.json, which keeps the cases that are done

A sheet of 17 x 17 particles and 0.6 m of the median fabric is let go above a sphere of 0.15 m radius: contact of the whole sheet,
friction 0.5, ``bending="quadratic"``, quadratic air.  Four sheets start with slopes of their own.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import progress
from clothgym.collisions import Sphere
from clothgym.lab.bench import machine
from clothgym.material import Material
from clothgym.mesh import grid
from clothgym.simulation import Simulation

RESULT = Path(__file__).parent / "results" / "settling.json"
SIDE, ROWS, RADIUS, FRICTION = 0.6, 17, 0.15, 0.5
FABRIC = "median"
SHEETS, SLOPE = 4, 0.05  # sheets, and the largest slope of each at the start, in either direction
GAP = 0.03  # of the sheet's middle above the sphere at the start [m]
STEP = 1 / 60  # [s]
SECONDS = 10.0
TIMES = (0.5, 1.0, 2.0, 4.0, 10.0)  # at which the table has the speed [s]
REST = 0.02  # largest rms speed of a sheet at rest, mean of the sheets [m/s]


class Case(NamedTuple):
    """A choice of dampings: retardation time of springs and hinges [s], rate of the linear drag [1/s], and description."""

    damping_time: float
    drag_rate: float
    about: str
    self_collision: bool | str = False
    air_density: float = 1.2
    contact: str = "sheet"
    substeps: int | Literal["auto"] = "auto"


CASES = {
    "air": Case(1e-4, 0.0, "quadratic air and friction; stretch damped as the presets are"),
    "no air": Case(1e-4, 0.0, "friction alone", air_density=0.0),
    "stretch 0.6 ms": Case(6e-4, 0.0, "loss of a KES tensile cycle at the first stretching mode"),
    "ARCSim 1 ms": Case(1e-3, 0.0, "ARCSim's configurations"),
    "bending 20 ms": Case(2e-2, 0.0, "of bending: clothilde-sim, KES loops; here of the springs, too"),
    "drag 1/s": Case(1e-4, 1.0, "clothilde-sim, low"),
    "drag 2/s": Case(1e-4, 2.0, "clothilde-sim, default"),
    "drag 3/s": Case(1e-4, 3.0, "clothilde-sim, high"),
    "drag 4.8/s": Case(1e-4, 4.8, "0.72 N s/m³ on 150 g/m²"),
    "strict": Case(1e-4, 0.0, "as air, and the sheet touches itself", "strict"),
    "strict, drag 2/s": Case(1e-4, 2.0, "clothilde-sim, default, and the sheet touches itself", "strict"),
    "0.6 ms, 2/s": Case(6e-4, 2.0, "KES tensile cycle and clothilde-sim, default"),
    "1 ms, 2/s": Case(1e-3, 2.0, "ARCSim and clothilde-sim, default"),
    "strict, 0.6 ms, 2/s": Case(6e-4, 2.0, "the same, and the sheet touches itself", "strict"),
    "strict, 0.6 ms, 3/s": Case(6e-4, 3.0, "clothilde-sim, high, and the sheet touches itself", "strict"),
    "100 substeps, 2/s": Case(1e-4, 2.0, "what remains: shorter substeps", substeps=100),
    "particles, 2/s": Case(1e-4, 2.0, "what remains: contact with particles alone", contact="particles"),
}


def starts(sheet: NDArray) -> NDArray[np.float64]:
    """Flat sheets above the sphere, each with slopes of its own [m], (sheets, particles, 3)."""
    slopes = np.random.default_rng(0).uniform(-SLOPE, SLOPE, (SHEETS, 2))
    flat = sheet - sheet.mean(axis=0)
    raised = np.repeat(flat[None], SHEETS, axis=0)
    raised[:, :, 2] += RADIUS + GAP + np.einsum("sc,pc->sp", slopes, flat[:, :2])
    return raised


def moved(case: Case) -> tuple[NDArray[np.float64], float, int]:
    """Root mean square of the particles' speeds after each step [m/s], (steps, sheets); of their way in the last second [m]; and
    the substeps of a step.
    """
    mesh, fabric = grid(ROWS, ROWS, SIDE, SIDE), Material.preset(FABRIC)
    simulation = Simulation(
        mesh,
        Material.preset(FABRIC, damping_time=case.damping_time, air_drag=case.drag_rate * fabric.density),
        SHEETS,
        time_step=STEP,
        substeps=case.substeps,
        air_density=case.air_density,
        colliders=[Sphere(radius=RADIUS, friction=FRICTION)],
        bending="quadratic",
        contact=case.contact,
        self_collision={"mode": case.self_collision, "friction": FRICTION} if case.self_collision else False,
        threads=1,
    )
    simulation.reset(positions=starts(mesh.rest_positions))
    rms, steps = [], round(SECONDS / STEP)
    for step in range(steps):
        progress.show(f"{case.about}, {step * STEP:.1f} s")
        if step == steps - round(1 / STEP):
            before = simulation.positions.astype(np.float64)
        simulation.step()
        rms.append(np.sqrt(np.mean(np.sum(simulation.velocities.astype(np.float64) ** 2, axis=2), axis=1)))
    progress.clear()
    way = np.sqrt(np.mean(np.sum((simulation.positions - before) ** 2, axis=2)))
    return np.array(rms), float(way), simulation.substeps


def measure(case: Case) -> dict[str, Any]:
    """A row of the table: mean rms speed of the sheets at each of ``TIMES`` [m/s], and from when on it is at rest [s]."""
    rms, way, substeps = moved(case)
    moving = np.flatnonzero(rms.mean(axis=1) > REST)
    at_rest = float(moving[-1] + 2) * STEP if len(moving) else 0.0
    return {
        **case._asdict(),
        "substeps made": substeps,
        "speed": {f"{time:g}": float(rms[round(time / STEP) - 1].mean()) for time in TIMES},
        "way in the last second": way,
        "at rest": at_rest if at_rest <= SECONDS else None,
    }


def table(rows: dict[str, Any]) -> str:
    """As Markdown; speeds in mm/s."""
    shown = list(next(iter(rows.values()))["speed"])
    head = [
        "case",
        "τ [ms]",
        "drag [1/s]",
        "substeps",
        *(f"{time} s" for time in shown),
        "at rest [s]",
        "last second [mm]",
        "source",
    ]
    lines = [head, ["---", *["---:"] * (len(head) - 2), "---"]]
    for name, row in rows.items():
        speeds = [f"{1e3 * row['speed'][time]:.1f}" for time in shown]
        rest = "not" if row["at rest"] is None else f"{row['at rest']:.1f}"
        lines.append(
            [
                name,
                f"{1e3 * row['damping_time']:g}",
                f"{row['drag_rate']:g}",
                str(row["substeps made"]),
                *speeds,
                rest,
                f"{1e3 * row['way in the last second']:.2f}",
                row["about"],
            ]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    about = {"fabric": FABRIC, "sheets": SHEETS, "seconds": SECONDS, "rest": REST}
    kept = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    rows = kept.get("rows", {}) if kept.get("about") == about else {}
    for name, case in CASES.items():
        if name in rows and Case(**{key: rows[name][key] for key in Case._fields}) == case:
            continue
        rows[name] = measure(case)
        rows = {known: rows[known] for known in CASES if known in rows}
        RESULT.write_text(json.dumps({"machine": machine(), "about": about, "rows": rows}, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()

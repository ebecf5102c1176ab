"""What every integrator costs, beside a bare pass over the same springs.

    python benchmarks/integrator_speed.py --yardstick PATH/spring_loop.py     # a file with bare passes; ours alone without

A 25 x 25 sheet of cotton hangs from two corners, float32, one thread.  Costs are medians of turns, in nanoseconds per spring and
environment of one pass: a substep of methods that make one pass, a quarter of ``rk4``'s, and of those that iterate one iteration
more, from the difference between many and one.  The yardstick's pass is "force and damping" for those that evaluate forces or
products with the stiffness matrix, "xpbd, own parameters" for those that project.

Triangular solves are no pass over springs: for ``projective_dynamics`` the iteration's cost is also held against the floating-point
operations of its two solves (2 a nonzero, a solve, and a coordinate) at the rate at which the yardstick's force pass does its 34 a
spring.  Results are added to ``results/integrator_speed.json``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from clothgym import Material, Simulation, grid
from clothgym.lab.bench import machine

Row = dict[str, Any]
RESULT = Path(__file__).parent / "results" / "integrator_speed.json"
ROWS, LANES, SUBSTEPS, TURNS = 25, (1, 64, 128), 40, 15
FLOPS_OF_A_SPRING = 34
FORCES, PROJECTION = "force and damping", "xpbd, own parameters"
MANY = 9
# name, options of one pass, options of many (or how many passes a substep has), material's damping time, the yardstick's line
CASES: tuple[tuple[str, dict[str, float], dict[str, float] | int, float, str], ...] = (
    ("explicit_euler", {}, 1, 1e-4, FORCES),
    ("semi_implicit_euler", {}, 1, 1e-4, FORCES),
    ("verlet", {}, 1, 1e-4, FORCES),
    ("rk4", {}, 4, 1e-4, FORCES),
    ("implicit_euler", {"tolerance": 0.0, "iterations": 1}, {"tolerance": 0.0, "iterations": 1 + MANY}, 1e-4, FORCES),
    ("projective_dynamics", {"iterations": 1}, {"iterations": 1 + MANY}, 1e-4, FORCES),
    ("pbd", {"iterations": 1}, {"iterations": 1 + MANY}, 1e-4, PROJECTION),
    ("xpbd", {}, 1, 0.0, PROJECTION),
    ("xpbd", {}, 1, 1e-4, PROJECTION),
    ("xpbd", {"iterations": 2}, {"iterations": 2 + MANY}, 0.0, PROJECTION),
    ("xpbd", {"iterations": 2}, {"iterations": 2 + MANY}, 1e-4, PROJECTION),
)


def simulation(name: str, options: dict[str, float], damping_time: float, lanes: int) -> Simulation:
    sheet = grid(ROWS, ROWS, 1.0, 1.0)
    fabric = Material.preset("penava_cotton", damping_time=damping_time)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is timed need not be accurate
        return Simulation(
            sheet, fabric, lanes, {"name": name, **options}, substeps=SUBSTEPS, anchors=sheet.corners[2:], air_density=0, threads=1,
            on_divergence="ignore",
        )  # fmt: skip


def seconds(call: Callable[[], object]) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def bare_passes(path: Path, lanes: int) -> dict[str, Callable[[], None]]:
    """The yardstick's two lines, each a call of ``SUBSTEPS`` passes."""
    spec = importlib.util.spec_from_file_location("yardstick", path)
    assert spec is not None and spec.loader is not None
    loop = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loop)
    f4 = np.float32
    x, ends = loop.sheet(ROWS)
    rest = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1).astype(f4)
    x = np.repeat(x[:, :, None], lanes, 2) + np.random.default_rng(0).normal(scale=1e-3, size=(len(x), 3, lanes)).astype(f4)
    v, f, row, scratch = np.zeros_like(x), np.zeros_like(x), np.ones(lanes, f4), np.zeros((3, lanes), f4)
    moved, masses = x.copy(), np.ones((len(x), lanes), f4)

    def forces() -> None:
        for _ in range(SUBSTEPS):
            loop.force_pass(x, v, f, ends, rest, f4(1e-6), f4(1e-6), scratch)

    def projection() -> None:
        for _ in range(SUBSTEPS):
            loop.project_own(moved, masses, ends, rest, row, row * f4(0.05))

    return {FORCES: forces, PROJECTION: projection}


def measure(lanes: int, yardstick: Path | None) -> list[Row]:
    """All cases in turns, so that whatever else the machine does hits them alike."""
    bare = {} if yardstick is None else bare_passes(yardstick, lanes)
    pairs = []
    for name, one, many, damping_time, _ in CASES:
        first = simulation(name, one, damping_time, lanes)
        pairs.append((first, simulation(name, many, damping_time, lanes) if isinstance(many, dict) else None))
    calls: list[Callable[[], object]] = [*bare.values()]
    for call in calls:
        call()
    times: list[list[float]] = [[] for _ in pairs]
    more: list[list[float]] = [[] for _ in pairs]
    yard: dict[str, list[float]] = {line: [] for line in bare}
    for turn in range(-1, TURNS):  # the first turn loads the kernels
        for line, call in bare.items():
            yard[line].append(seconds(call))
        for (first, second), ones, manies in zip(pairs, times, more):
            first.reset()
            ones.append(seconds(first.step))
            if second is not None:
                second.reset()
                manies.append(seconds(second.step))
        if turn < 0:
            for record in (*yard.values(), *times, *more):
                record.clear()
    springs = len(pairs[0][0].mesh.springs.kind)
    scale = 1e9 / (SUBSTEPS * springs * lanes)
    rows = []
    for (name, one, many, damping_time, line), (first, _), ones, manies in zip(CASES, pairs, times, more):
        substep = statistics.median(ones) * scale
        a_pass = substep / many if isinstance(many, int) else (statistics.median(manies) * scale - substep) / MANY
        row: Row = {"integrator": name, "options": one, "damped": damping_time > 0, "lanes": lanes, "ns_per_pass": a_pass}
        row["ns_of_a_substep"] = substep
        if bare:
            pace = statistics.median(yard[line]) * scale
            row |= {"line": line, "yardstick_ns": pace, "ratio": a_pass / pace}
            if name == "projective_dynamics":
                row["nonzeros"] = len(first._plan[3])  # of the factor
                row["ratio_to_solves"] = a_pass * springs / (12 * row["nonzeros"] * pace / FLOPS_OF_A_SPRING)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="a spring_loop.py with bare spring passes")
    args = parser.parse_args()
    rows = []
    for lanes in LANES:
        rows += measure(lanes, args.yardstick)
    RESULT.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
    print(f"{'integrator':<40} {'lanes':>5} {'ns/pass':>8} {'yardstick':>9} {'ratio':>6} {'to solves':>9}")
    for row in rows:
        label = row["integrator"] + "".join(f", {value:g} {key}" for key, value in row["options"].items())
        label += ", damped" if row["damped"] and row["integrator"] == "xpbd" else ""
        figures = "".join(f" {row[key]:>9.2f}" for key in ("yardstick_ns", "ratio", "ratio_to_solves") if key in row)
        print(f"{label:<40} {row['lanes']:>5} {row['ns_per_pass']:>8.2f}{figures}")


if __name__ == "__main__":
    main()

"""Steps/s of ClothDrape-v0 over environments, threads and particles a side; and of springs alone, which no contact can exceed.

    python benchmarks/scaling.py            # some minutes; writes results/scaling.json and docs/speed.png
    python benchmarks/scaling.py --draw     # the picture alone

With one thread times are this thread's processor time, with more of them wall time.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import matplotlib
from speed import MANY, STEPS, Row, batch, hanging, in_turns, play, row

from clothgym import grid
from clothgym.lab.bench import machine

matplotlib.use("Agg")
from matplotlib import pyplot as plt

RESULTS = Path(__file__).parent / "results" / "scaling.json"
PICTURE = Path(__file__).parent.parent / "docs" / "speed.png"
BATCHES, SIDES, THREADS = (1, 4, 16, 64, 128, 512), (17, 25, 33, 49), (1, 2)
SIDE = 0.6  # of the sheet [m]


def environments() -> list[Row]:
    """Rows of the task, with expert and random actions."""
    rows = []
    for actor in ("expert", "random"):
        cases = [(n, 1, 17) for n in BATCHES] + [(MANY, threads, 17) for threads in THREADS[1:]] + [(16, 1, s) for s in SIDES[1:]]
        for num_envs, threads, side in cases:
            clock = time.thread_time if threads == 1 else time.perf_counter
            us = play(
                {"": {"threads": threads, "rows": side}},
                actor == "expert",
                num_envs,
                STEPS,
                rounds=2 if num_envs < 16 else 1,
                clock=clock,
            )[""]
            rows.append(row("scaling", f"{actor}, {num_envs} environments, {threads} threads, {side} a side", 1e6 / us, "steps/s"))
            print(f"{rows[-1]['what']:<60} {rows[-1]['now']:>10,.0f}", flush=True)
    return rows


def springs() -> list[Row]:
    """Rows of the springs of one sheet, in control steps per second."""
    rows = []
    for side in SIDES:
        control = batch("ClothDrape-v0", 1, rows=side).task.simulation
        sheet = hanging(grid(side, side, SIDE, SIDE), 1, time_step=control.time_step, substeps=control.substeps)
        rows.append(row("scaling", f"springs alone, {side} a side", 1 / in_turns({"": sheet.step})[""], "steps/s"))
    return rows


def draw(rows: list[Row]) -> None:
    """Steps/s over environments and over particles a side."""
    now = {one["what"]: one["now"] for one in rows}
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    for actor, color in (("expert", "#d1495b"), ("random", "#00798c")):
        one_core = [now[f"{actor}, {n} environments, 1 threads, 17 a side"] for n in BATCHES]
        left.plot(BATCHES, one_core, "o-", color=color, label=f"{actor}, one core")
        for threads in THREADS[1:]:
            many = now[f"{actor}, {MANY} environments, {threads} threads, 17 a side"]
            left.plot(MANY, many, "^", color=color, label=f"{actor}, {threads} cores")
        sizes = [now[f"{actor}, 16 environments, 1 threads, {side} a side"] for side in SIDES]
        right.plot(SIDES, sizes, "o-", color=color, label=f"{actor}, 16 environments")
    alone = [now[f"springs alone, {side} a side"] for side in SIDES]
    left.axhline(alone[0], color="#8a8f98", linestyle="--", label="springs alone, one core")
    right.plot(SIDES, alone, "--", color="#8a8f98", label="springs alone")
    left.set(xscale="log", yscale="log", xlabel="environments", ylabel="steps/s", title="17 x 17 particles")
    right.set(xscale="log", xlabel="particles a side", title="one core")
    right.set_xticks(SIDES, [str(side) for side in SIDES])
    right.minorticks_off()
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    if "--draw" not in sys.argv:
        RESULTS.write_text(json.dumps({"machine": machine(), "rows": environments() + springs()}, indent=1) + "\n")
    draw(json.loads(RESULTS.read_text())["rows"])


if __name__ == "__main__":
    main()

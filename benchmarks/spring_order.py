"""What the order of the springs costs: the same force pass with springs sorted by colour and by particle.

    python benchmarks/spring_order.py            # prints the table, writes benchmarks/results/spring_order.json
    python benchmarks/spring_order.py --rounds 200

One thread, float32; nanoseconds per spring and environment.  The two orders take turns, so that a slow moment of the machine
falls on both, and each figure is the median over the turns.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from clothgym import grid
from clothgym.bench import machine
from clothgym.forces import add_spring_forces
from clothgym.mesh import NUM_KINDS, ClothMesh
from clothgym.state import element_arrays

RESULT = Path(__file__).parent / "results" / "spring_order.json"
SIDES = (17, 25)
LANES = (1, 16, 64, 128)
TURN = 2e-3  # [s]: long beside the clock's own cost, short beside the machine's moods


def force_pass(mesh: ClothMesh, lanes: int, by_particle: bool) -> Callable[[], None]:
    """A call that adds all spring forces of a slightly rumpled sheet once."""
    f4 = np.dtype(np.float32)
    ripple = np.random.default_rng(0).normal(scale=1e-3, size=(mesh.num_particles, 3, lanes))
    x = (mesh.rest_positions[:, :, None] + ripple).astype(f4)
    v, f = np.zeros_like(x), np.zeros_like(x)
    springs = element_arrays(mesh, f4, hinged=False, by_particle=by_particle).springs
    # so soft that the sum of all calls stays small
    stiffness, damping_time = np.full((NUM_KINDS, lanes), 1e-6, f4), np.full(lanes, 1e-4, f4)
    row = np.zeros((3, lanes), f4)
    return lambda: add_spring_forces(x, v, f, springs, stiffness, damping_time, row)


def measure(side: int, lanes: int, rounds: int) -> dict[str, Any]:
    """Median cost of both orders [ns per spring and environment], and the share that the order by particle saves."""
    mesh = grid(side, side, 1.0, 1.0)
    orders = {"by colour": force_pass(mesh, lanes, False), "by particle": force_pass(mesh, lanes, True)}
    work = lanes * len(mesh.springs.kind)
    calls = max(1, round(TURN / (work * 3e-9)))
    times: dict[str, list[float]] = {name: [] for name in orders}
    for call in orders.values():
        call()
    for _ in range(rounds):
        for name, call in orders.items():
            begun = time.perf_counter()
            for _ in range(calls):
                call()
            times[name].append((time.perf_counter() - begun) / calls)
    ns = {name: statistics.median(t) / work * 1e9 for name, t in times.items()}
    return {"grid": f"{side}x{side}", "lanes": lanes, **ns, "saved": 1 - ns["by particle"] / ns["by colour"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=100, help="turns of each order")
    rounds = parser.parse_args().rounds
    rows = []
    print(f"{'grid':>6} {'lanes':>6} {'by colour':>10} {'by particle':>12} {'saved':>7}   [ns per spring and environment]")
    for side in SIDES:
        for lanes in LANES:
            row = measure(side, lanes, rounds)
            rows.append(row)
            print(
                f"{row['grid']:>6} {lanes:>6} {row['by colour']:>10.2f} {row['by particle']:>12.2f} {row['saved']:>7.1%}",
                flush=True,
            )
    RESULT.parent.mkdir(exist_ok=True)
    about = "float32, one thread, medians of interleaved turns; costs in ns per spring and environment, saved as a share"
    RESULT.write_text(json.dumps({"about": about, "machine": machine(), "rounds": rounds, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

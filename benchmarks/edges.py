"""Sheets that are drawn over the edge of a table, and that hang over it, against Euler's and Eytelwein's closed form.

    python benchmarks/edges.py               # a quarter of an hour on one core
    python benchmarks/edges.py --quick       # sheets of 9 and 17 particles a side, a minute once kernels are compiled

A sheet of 0.6 m lies on a table, and 40 % of it hang over the edge.  It is drawn back by 12 cm at 5 cm/s; the mean pull is compared
with the closed form (``tests/tables.py``).  Then friction falls slowly, and the sheet stays by itself or slides: the largest share
of its length that stays is between the largest of those tried that stays, and the smallest that slides.  Results go to
``results/edges.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

from clothgym.lab.bench import machine

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import tables  # the truths that the tests use

RESULT = Path(__file__).parent / "results" / "edges.json"
FRICTION = (0.0, 0.1, 0.3, 0.6)
OFFSETS = (-0.09, -0.06, -0.03, -0.015, 0.0, 0.015, 0.03, 0.06, 0.09)


def pulls(particles: int, fabric: str, radius: float, solid: str, thickness: float) -> dict[str, Any]:
    """Of one table, with each friction."""
    make = partial(tables.edge if solid == "box" else tables.mesh_edge, thickness=thickness)
    row: dict[str, Any] = {"particles": particles, "fabric": fabric, "radius": radius, "solid": solid, "thickness": thickness}
    runs = [tables.pull_back(make, particles, friction, radius, fabric, speed=0.05, way=0.12) for friction in FRICTION]
    return row | {"ratios": [run["ratio"] for run in runs], "depth": max(run["depth"] for run in runs)}


def hanging(particles: int, friction: float, thickness: float) -> dict[str, Any]:
    """The shares that stay and slide, less the closed form's."""
    share, make = tables.largest_share(friction), partial(tables.edge, thickness=thickness)
    slides = {offset: tables.slid(make, particles, friction, share + offset) > 0.02 for offset in OFFSETS if share + offset > 0.03}
    row = {"particles": particles, "friction": friction, "thickness": thickness, "share": share}
    stay = max((offset for offset, gone in slides.items() if not gone), default=None)
    return row | {"stays": stay, "slides": min((offset for offset, gone in slides.items() if gone), default=None)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse sheets alone")
    parser.add_argument("--json", type=Path, default=RESULT, help="where results go")
    args = parser.parse_args()
    spacings = (9, 17) if args.quick else (9, 17, 33, 49)
    cases = [(n, "cotton", radius, "box", 0.001) for n in spacings for radius in (0.0, 0.01, 0.03, 0.05)]
    cases += [(n, "cotton", 0.0, "box", 0.005) for n in spacings]
    cases += [(17, fabric, radius, "box", 0.001) for fabric in ("silk", "denim") for radius in (0.0, 0.03)]
    cases += [(17, "cotton", radius, "mesh", 0.001) for radius in (0.0, 0.03)]
    drawn, hung = [], []
    print(f"pull over the closed form's, with friction {FRICTION}")
    for case in cases:
        row = pulls(*case)
        drawn.append(row)
        ratios = " ".join(f"{ratio:7.3f}" for ratio in row["ratios"])
        print(f"{case[0]:>3} {case[1]:<7} edge {1e3 * case[2]:>3.0f} mm {case[3]:<4} thickness {1e3 * case[4]:.0f} mm: {ratios}, "
              f"depth {1e3 * row['depth']:.2f} mm", flush=True)  # fmt: skip
    print("largest share that stays by itself, less the closed form's")
    for n in spacings[:3]:
        for friction in FRICTION[1:]:
            for thickness in (0.001, 0.005):
                row = hanging(n, friction, thickness)
                hung.append(row)
                print(f"{n:>3} friction {friction}, thickness {1e3 * thickness:.0f} mm: stays at {row['stays']}, slides at "
                      f"{row['slides']}", flush=True)  # fmt: skip
    args.json.write_text(json.dumps({"machine": machine(), "friction": FRICTION, "pulls": drawn, "shares": hung}, indent=1) + "\n")


if __name__ == "__main__":
    main()

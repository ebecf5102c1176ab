"""How sheets slide on sheets: over the spacing of both grids, their turn, friction and curvature.

    python benchmarks/layers.py              # some minutes on one core

Sections of ``results/layers.json``, each with the modes "strict" and "fast", layers 4 mm thick:

* slope: a sheet of 14 x 10 cm on a large one, which is held, after 0.4 s; the truth is a block's speed.  Spacings are those below
  and above, in thicknesses.
* cylinder: a strip that hangs over a cylinder, itself a sheet, after 0.2 s; the truth is a chain's speed without friction, and
  with friction that of the same strip over a smooth solid.  Spacings in thicknesses, lengths in meters.

Where there is friction enough, the truth is rest.  ``clamped``: moves of a vertex that were cut short; ``intersecting``: pairs of
triangles at the end, by the exact count.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from cases import Case, Row, fill, table

from clothgym import Simulation

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import layers  # the scenes and truths that the tests use

RESULT = Path(__file__).parent / "results" / "layers.json"
MODES = ("strict", "fast")
MESHES = (((2.5, 2.5), 0.0), ((4, 4), 0.0), ((6, 6), 0.0), ((2.5, 6), 0.0), ((6, 2.5), 0.0), ((4, 4), 0.4), ((5, 5), np.pi / 4))
SLOPES = ((0.0, 10), (0.1, 15), (0.2, 20), (0.3, 25), (0.5, 35), (0.3, 15), (0.5, 25))  # friction and angle
CYLINDERS = ((0.05, (2.5, 2.5)), (0.1, (2.5, 2.5)), (0.1, (4, 4)), (0.1, (6, 6)), (0.1, (2.5, 6)), (0.1, (6, 2.5)), (0.2, (6, 6)))
STRIPS = ((0.0, (0.12, 0.34)), (0.1, (0.08, 0.35)), (0.3, (0.12, 1.2)), (0.5, (0.08, 1.2)))  # friction and tails


def run(simulation: Simulation, frames: int) -> Row:
    """Take some control steps, and return their report."""
    clamped = 0
    for _ in range(frames):
        simulation.step()
        clamped += int(simulation.self_contacts.clamped[0])
    return {"clamped": clamped, "intersecting": int(simulation.intersections()[0])}


def on_slope(spacings: tuple[float, float], turn: float, friction: float, degrees: float, mode: str) -> Row:
    """The speed of a sheet on a sheet, and a block's."""
    simulation, n = layers.flat_layers(spacings, turn, degrees, mode, friction)
    report = run(simulation, 24)
    speed = float(simulation.velocities[0, n:, 0].mean())
    return {"speed": speed, "truth": layers.speed_on_slope(degrees, friction, 0.4)} | report


def over_cylinder(radius: float, spacings: tuple[float, float], friction: float, tails: tuple[float, float], mode: str) -> Row:
    """The speed of a strip over a cylinder, and a chain's, or that of the strip over a smooth solid."""
    below, above = (layers.THICKNESS * s for s in spacings)
    case = layers.strip_over_cylinder(radius, (below, above), tails, mode, friction)
    report = run(case[0], 12)
    if friction == 0:
        truth = layers.speed_over_cylinder(radius + layers.THICKNESS, tails, 0.2)
    else:
        smooth = layers.strip_over_solid(radius, above, tails, friction)
        smooth[0].step(12)
        truth = layers.speed_along(*smooth)
    return {"speed": layers.speed_along(*case), "truth": truth} | report


def slope_cases() -> list[Row]:
    return [
        {"spacings": list(spacings), "turn": turn, "friction": friction, "degrees": degrees, "mode": mode}
        for spacings, turn in MESHES for friction, degrees in SLOPES for mode in MODES
    ]  # fmt: skip


def cylinder_cases() -> list[Row]:
    return [
        {"radius": radius, "spacings": list(spacings), "friction": friction, "tails": list(tails), "mode": mode}
        for radius, spacings in CYLINDERS for friction, tails in STRIPS for mode in MODES
    ]  # fmt: skip


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    sections: dict[str, list[Case]] = {
        "slope": [(on_slope, key) for key in slope_cases()],
        "cylinder": [(over_cylinder, key) for key in cylinder_cases()],
    }
    results = fill(RESULT, sections, [], True, {})
    for name in sections:
        print(f"\n{name}\n{table(results[name])}")


if __name__ == "__main__":
    main()

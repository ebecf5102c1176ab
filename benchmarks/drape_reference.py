"""The ideal of the draping tasks: the coverage that a fine sheet, let down flat and centered on a target, reaches.

    python benchmarks/drape_reference.py            # writes envs/drape_reference.json, in some minutes on one core

A 49 x 49 sheet of a task's cloth is let down from just above the target's highest point and settles for four seconds, in contact
with its whole surface, without passing through itself, with rigidity and in air: see ``envs/reference.py``.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from clothgym import __version__
from clothgym.envs.draping import PHYSICS
from clothgym.envs.reference import cloth_of, simulated

ROWS, COUNTS = 49, (5, 5)
TABLE = Path(__file__).parent.parent / "envs" / "drape_reference.json"


def main() -> None:
    cloths = []
    for physics in ("true", "fast"):
        cloth = cloth_of(PHYSICS.chosen(physics))
        if cloth in [known["cloth"] for known in cloths]:
            continue
        shapes = simulated(cloth, ROWS, COUNTS)
        cloths.append({"cloth": cloth, "shapes": shapes})
        for shape, table in shapes.items():
            print(f'the cloth of physics="{physics}" on a {shape}: rms speed at the end up to {1000 * table["rms_speed"]:.1f} mm/s')
            print(np.array(table["coverage"]))
    about = f"made by benchmarks/drape_reference.py of clothgym {__version__}: {ROWS} x {ROWS} sheet; sizes in sides, yaws in rad"
    TABLE.write_text(json.dumps({"about": about, "cloths": cloths}, indent=1) + "\n")


if __name__ == "__main__":
    main()

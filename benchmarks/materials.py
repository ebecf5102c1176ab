"""The presets in the tests of textile laboratories: droop of a strip, and the drape coefficient of a disc.

python benchmarks/materials.py            # table, docs/materials.png and results/materials.json
python benchmarks/materials.py --quick    # coarse specimens only, nothing written
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from clothgym.collisions import Capsule
from clothgym.lab.bench import machine
from clothgym.lab.scenes import Drape, bending_length, cantilever, cusick_drape
from clothgym.material import PRESETS, Material
from clothgym.render import Camera, Renderer

RESULT = Path(__file__).parent / "results" / "materials.json"
PICTURE = Path(__file__).parent.parent / "docs" / "materials.png"
RINGS = (10, 15)
SPECIMENS = 4  # each from waves of its own
OVERHANG = 0.04  # [m]
# published drape coefficients [%], see docs/materials.md; no source gives one for the knit
BANDS = {"cotton": (60, 76), "silk": (20, 40), "wool": (40, 70), "denim": (70, 90), "polyester": (20, 40)}
HEIGHT = 0.1  # of the supporting disc in the picture [m]
SIZE = 300

Row = dict[str, Any]


def measure(name: str, rings: tuple[int, ...]) -> tuple[Row, Drape]:
    """A row of the table, and the finest drape."""
    material = Material.preset(name)
    strip = cantilever(material, OVERHANG)
    row: Row = {
        "fabric": name,
        "density": material.density,
        "E t": material.stretch_stiffness,
        "B": material.bend_rigidity,
        "bending length": bending_length(material),
        "G": strip.weight,
        "droop": strip.droop,
        "elastica": strip.elastica,
        "drape": {},
    }
    for count in rings:
        drape = cusick_drape(material, count, SPECIMENS)
        percent = 100 * drape.coefficient
        row["drape"][str(count)] = {
            "mean": float(percent.mean()),
            "each": percent.tolist(),
            "fastest": float(drape.speed.max()),
            "seconds": drape.seconds,
        }
        print(f"{name}, {count} rings: {percent.round(1).tolist()} %, fastest {drape.speed.max():.1e} m/s", flush=True)
    row["float64"] = float(100 * cusick_drape(material, rings[0], SPECIMENS, dtype="float64").coefficient.mean())
    row["band"] = BANDS.get(name)
    return row, drape


def table(rows: list[Row]) -> str:
    """As Markdown."""
    rings = list(rows[0]["drape"])
    head = ["fabric", "density [g/m²]", "E t [N/m]", "B [µN m]", "c [mm]", "G", "droop [°]", "elastica [°]"]
    head += [f"DC, {count} rings [%]" for count in rings] + ["band [%]", "inside"]
    lines = [head, ["---", *["---:"] * (len(head) - 2), "---"]]
    for row in rows:
        finest = row["drape"][rings[-1]]["mean"]
        band = row["band"]
        lines.append(
            [
                row["fabric"],
                f"{1e3 * row['density']:.0f}",
                f"{row['E t']:.0f}",
                f"{1e6 * row['B']:.3g}",
                f"{1e3 * row['bending length']:.1f}",
                f"{row['G']:.3g}",
                f"{row['droop']:.1f}",
                f"{row['elastica']:.1f}",
                *(f"{np.mean(v['each']):.1f} ± {np.std(v['each']):.1f}" for v in row["drape"].values()),
                "none" if band is None else f"{band[0]}-{band[1]}",
                "" if band is None else "yes" if band[0] <= finest <= band[1] else "**no**",
            ]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(drapes: list[Drape]) -> NDArray[np.uint8]:
    """The specimens from above and from the side, (height, width, 3)."""
    mesh = drapes[0].mesh
    support = Capsule(center=(0.0, 0.0, HEIGHT / 2 - 0.005), radius=0.02, height=HEIGHT - 0.01)
    rows = []
    for eye in ((0.0, -0.02, 0.72), (0.0, -0.52, 0.2)):
        camera = Camera(eye, target=(0.0, 0.0, 0.06), vertical_fov=32.0)
        renderer = Renderer(mesh.triangles, mesh.rest_positions[:, :2], camera, SIZE, SIZE, antialias=3)
        rows.append(np.concatenate([renderer.rgb(d.positions[0] + (0, 0, HEIGHT), [support]) for d in drapes], axis=1))
    return np.concatenate(rows, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse specimens only, nothing written")
    args = parser.parse_args()
    measured = [measure(name, RINGS[:1] if args.quick else RINGS) for name in PRESETS]
    rows, drapes = [row for row, _ in measured], [drape for _, drape in measured]
    print(table(rows))
    if not args.quick:
        about = {"overhang": OVERHANG, "rings": RINGS, "specimens": SPECIMENS}
        RESULT.write_text(json.dumps({"machine": machine(), "about": about, "rows": rows}, indent=1) + "\n")
        iio.imwrite(PICTURE, draw(drapes))


if __name__ == "__main__":
    main()

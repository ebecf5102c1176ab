"""The presets in the tests of textile laboratories: droop of a strip, and the drape coefficient of a disc.

python benchmarks/materials.py            # table, docs/materials.webp and results/materials.json: some minutes
python benchmarks/materials.py --quick    # coarse specimens only, nothing written
python benchmarks/materials.py --draw     # docs/materials.webp alone
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.collisions import Capsule, MeshCollider
from clothgym.lab.bench import machine
from clothgym.lab.scenes import Drape, bending_length, cantilever, cusick_drape
from clothgym.material import PRESETS, Material, rigidity_percentile
from clothgym.render import Camera, Renderer
from clothgym.render.looks import LOOKS, PLAIN

RESULT = Path(__file__).parent / "results" / "materials.json"
PICTURE = Path(__file__).parent.parent / "docs" / "materials.webp"
RINGS = (10, 15)
SPECIMENS = 4  # each from waves of its own
OVERHANG = 0.04  # [m]
NAMES = [name for name in PRESETS if name != "cotton"]  # which is cotton_broad
# published drape coefficients [%] and numbers of folds, see docs/materials.md: of the same piece, or a band of its class of fabrics
PIECES = {"cotton_broad": (82.9, 2), "polyester_tropical": (50.7, 5), "wool_tropical": (49.8, 5), "polyester_faille": (28.3, 7)}
BANDS = {"penava_cotton": (60, 76), "silk": (20, 40), "wool": (40, 70), "denim": (70, 90), "polyester": (20, 40)}
HEIGHT = 0.17  # of the supporting disc in the picture [m]
SIZE, GAP = 300, 4
LARGE_DISC = 0.09  # radius of the disc [m]

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
        "percentile": rigidity_percentile(material.bend_rigidity),
        "bending length": bending_length(material),
        "G": strip.weight,
        "droop": strip.droop,
        "elastica": strip.elastica,
        "drape": {},
        "springs": {},
    }
    for count in rings:
        drape = cusick_drape(material, count, SPECIMENS)
        percent = 100 * drape.coefficient
        row["drape"][str(count)] = {
            "mean": float(percent.mean()),
            "each": percent.tolist(),
            "folds": drape.folds.tolist(),
            "fastest": float(drape.speed.max()),
            "seconds": drape.seconds,
        }
        row["springs"][str(count)] = (100 * cusick_drape(material, count, SPECIMENS, bending="springs").coefficient).tolist()
        print(f"{name}, {count} rings: {percent.round(1).tolist()} %, fastest {drape.speed.max():.1e} m/s", flush=True)
    # the disc is isotropic, with a shear modulus of 3/8 E t: once with the fabric's own
    own_shear = Material.preset(name, stretch_stiffness=8 / 3 * material.shear_stiffness)
    row["own shear"] = float(100 * cusick_drape(own_shear, rings[0], SPECIMENS).coefficient.mean())
    row["float64"] = float(100 * cusick_drape(material, rings[0], SPECIMENS, dtype="float64").coefficient.mean())
    row["piece"], row["band"] = PIECES.get(name), BANDS.get(name)
    return row, drape


def published(row: Row) -> tuple[str, str]:
    """The published drape coefficient and number of folds [%], and by how much the finest mesh misses the coefficient."""
    finest = list(row["drape"].values())[-1]["mean"]
    if row["piece"] is None and row["band"] is None:
        return "none", ""
    low, high = row["band"] or row["piece"][:1] * 2
    off = finest - min(max(finest, low), high)
    told = f"{low}-{high}" if row["band"] else f"{low}, {row['piece'][1]} folds"
    return told, f"{off:+.0f}" if round(off) else "inside"


def table(rows: list[Row]) -> str:
    """As Markdown."""
    rings = list(rows[0]["drape"])
    head = ["fabric", "density [g/m²]", "E t [N/m]", "B [µN m]", "percentile", "c [mm]", "G", "droop [°]", "elastica [°]"]
    head += [f"DC, {count} rings [%]" for count in rings]
    head += ["folds", "published DC [%]", "off by", "DC, own G t [%]", f"DC, springs, {' and '.join(rings)} rings [%]"]
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for row in rows:
        folds = list(row["drape"].values())[-1]["folds"]
        lines.append(
            [
                row["fabric"],
                f"{1e3 * row['density']:.0f}",
                f"{row['E t']:.0f}",
                f"{1e6 * row['B']:.3g}",
                f"{row['percentile']:.0f}",
                f"{1e3 * row['bending length']:.1f}",
                f"{row['G']:.3g}",
                f"{row['droop']:.1f}",
                f"{row['elastica']:.1f}",
                *(f"{np.mean(v['each']):.1f} ± {np.std(v['each']):.1f}" for v in row["drape"].values()),
                f"{min(folds)} to {max(folds)}",
                *published(row),
                f"{row['own shear']:.0f}",
                " and ".join(f"{np.mean(each):.0f}" for each in row["springs"].values()),
            ]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(drapes: dict[str, Drape]) -> None:
    """The specimens by name in two lines, each from above and below that from the side, on the disc of the tester and its foot."""
    from PIL import Image, ImageDraw, ImageFont

    columns = -(-len(drapes) // 2)
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = LARGE_DISC * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # a prism with two middles: the disc, closed
    levels = [np.column_stack([ring, np.full(64, z)]) for z in (-0.006, 0.0)]
    vertices = np.concatenate([*levels, [(0, 0, -0.006), (0, 0, 0)]])
    k, n = np.arange(64), (np.arange(64) + 1) % 64
    sides = [
        np.stack(three, axis=1)
        for three in ((k, n, 64 + n), (k, 64 + n, 64 + k), (n, k, 0 * k + 128), (64 + k, 64 + n, 0 * k + 129))
    ]
    disc = MeshCollider(vertices=vertices, triangles=np.concatenate(sides), center=(0.0, 0.0, HEIGHT - 0.004))
    foot = Capsule(center=(0.0, 0.0, HEIGHT / 2), radius=0.012, height=HEIGHT - 0.02)
    pixels = np.full((4 * (SIZE + GAP) - GAP, columns * (SIZE + GAP) - GAP, 3), 255, np.uint8)
    for view, eye in enumerate(((0.0, -0.02, 0.86), (0.0, -0.78, 0.17))):
        camera = Camera(eye, target=(0.0, 0.0, HEIGHT if view == 0 else 0.1), vertical_fov=28.0)
        for number, (name, drape) in enumerate(drapes.items()):
            front, back, check = LOOKS[name]
            # plain specimens lie in the middle of a stripe, and of a yarn
            triangles, uv = drape.mesh.triangles, drape.mesh.rest_positions[:, :2] + 0.525 * PLAIN
            renderer = Renderer(triangles, uv, camera, SIZE, SIZE, antialias=3, front=front, back=back, check=check)
            line, column = divmod(number, columns)
            top, left = (2 * line + view) * (SIZE + GAP), column * (SIZE + GAP)
            seen = renderer.rgb(drape.positions[0] + (0, 0, HEIGHT), [(disc, (120, 124, 132)), (foot, (120, 124, 132))])
            pixels[top : top + SIZE, left : left + SIZE] = seen
    picture, font = Image.fromarray(pixels), ImageFont.load_default(17)
    for number, name in enumerate(drapes):
        line, column = divmod(number, columns)
        place = (column * (SIZE + GAP) + 10, 2 * line * (SIZE + GAP) + 8)
        ImageDraw.Draw(picture).text(place, name, (43, 45, 66), font)
    picture.save(PICTURE, quality=80, method=6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="the picture alone")
    args = parser.parse_args()
    if args.draw:
        draw({name: cusick_drape(Material.preset(name), RINGS[-1], 1) for name in NAMES})
        return
    measured = [measure(name, RINGS) for name in NAMES]
    rows = [row for row, _ in measured]
    print(table(rows))
    about = {"overhang": OVERHANG, "rings": RINGS, "specimens": SPECIMENS}
    RESULT.write_text(json.dumps({"machine": machine(), "about": about, "rows": rows}, indent=1) + "\n")
    draw(dict(zip(NAMES, (drape for _, drape in measured))))


if __name__ == "__main__":
    main()

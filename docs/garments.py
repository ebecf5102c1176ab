"""The pictures of docs/garments.md.

python docs/garments.py                                  # garments.webp, and garment_shirts.webp
python docs/garments.py --kinds tshirt towel --seed 1    # garments.webp with some kinds and other sizes
python docs/garments.py --many                           # garments_many.webp: ten of each kind, with particles farther apart
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pictures import labeled, picture, side_by_side, write
from PIL import Image
from tqdm import tqdm

from clothgym import Plane, Simulation, Sphere
from clothgym.garments import RANGES, Garment, random_garment, tshirt
from clothgym.render import Camera

HERE = Path(__file__).parent
HELD = {"tshirt": "shoulder_left", "long_sleeve": "shoulder_left", "towel": "top_left"}  # key points; others hang from waist_left
GRASP = 0.025  # particles within this distance of a held one are held with it [m]
RESTING, HANGING, FALLING = 60, 240, 150  # control steps
AIR_DRAG = 1.5  # with which what hangs comes to rest
UNEVEN = 5e-4  # of what hangs [m]
SMALLER = 0.7  # of the pictures of all kinds
MANY, SPACING, TILE = 10, 0.03, 96  # garments of each kind, distance of their particles [m], and pixels of a small picture
EYES = {"flat": (0.0, -0.25, 1.6), "hanging": (0.5, -2.0, 0.9), "crumpled": (0.7, -0.8, 0.6)}


def simulation(garment: Garment, solids: Sequence[Any] = (), anchors: Sequence[Any] = ()) -> Simulation:
    """A garment above the floor, in strict contact."""
    solids = [Plane(friction=0.5), *solids]
    cloth = Simulation(garment.mesh, bending="quadratic", colliders=solids, anchors=anchors, self_collision="strict")
    cloth.set_parameters(air_drag=AIR_DRAG)
    return cloth


def after(cloth: Simulation, steps: int) -> NDArray[np.float32]:
    """Positions after so many steps [m], (particles, 3), without intersections by the exact count."""
    cloth.step(steps)
    if cloth.intersections().any():
        raise RuntimeError("the garment passes through itself")
    return cloth.positions[0]


def states(garment: Garment) -> dict[str, NDArray[np.float32]]:
    """Positions of a garment that lies flat, hangs from a key point, and has fallen from there [m], (particles, 3) each."""
    x = garment.mesh.rest_positions
    flat = simulation(garment)
    flat.reset(positions=x + [0, 0, 0.01])
    # upright, with the key point above
    held = garment.key_points[HELD.get(garment.kind, "waist_left")]
    near = np.linalg.norm(x - x[held], axis=1) < GRASP
    near[held] = False
    up = x[held, :2] / np.linalg.norm(x[held, :2])
    upright = np.stack([x[:, :2] @ [up[1], -up[0]], -x[:, 2], x[:, :2] @ up], axis=1)
    # a single layer in a vertical plane would stay in it
    upright[:, 1] += np.random.default_rng(0).normal(scale=UNEVEN, size=len(x))
    cloth = simulation(garment, anchors=[[held, *np.flatnonzero(near).tolist()]])
    cloth.reset(positions=upright + [0, 0, 0.1 - upright[:, 2].min()])
    hanging = after(cloth, HANGING)
    cloth.release()
    return {"flat": after(flat, RESTING), "hanging": hanging, "crumpled": after(cloth, FALLING)}


def _seen(garment: Garment, state: str, x: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A picture of a garment in a state, about the middle."""
    return picture(garment.mesh, x - x.mean(axis=0) * [1, 1, 0], Camera(EYES[state], (0, 0, 0.02)), [])


def draw_many(kinds: Sequence[str]) -> None:
    """Three rows for each kind, one a state, and a column for each random garment."""
    rows = []
    for kind in kinds:
        garments = [random_garment(kind, seed, SPACING) for seed in range(MANY)]
        of = [states(garment) for garment in tqdm(garments, desc=kind, disable=None)]
        for state in EYES:
            tiles = [Image.fromarray(_seen(garment, state, x[state])).resize((TILE, TILE)) for garment, x in zip(garments, of)]
            rows.append(side_by_side([np.asarray(tile) for tile in tiles]))
    write(HERE / "garments_many.webp", side_by_side(rows, axis=0))


def draw_kinds(kinds: Sequence[str], seed: int) -> None:
    """A row for each two kinds, with a random garment in each state."""
    strips = []
    for kind in kinds:
        garment = random_garment(kind, seed)
        images = []
        for state, x in states(garment).items():
            images.append(labeled(_seen(garment, state, x), f"{kind}, {state}"))
        strips.append(side_by_side(images))
    rows = [side_by_side(strips[k : k + 2]) for k in range(0, len(strips), 2)]
    whole = Image.fromarray(side_by_side(rows, axis=0))
    smaller = [round(SMALLER * side) for side in whole.size]
    write(HERE / "garments.webp", np.asarray(whole.resize(smaller, Image.Resampling.LANCZOS)))


def draw_shirts() -> None:
    """A T-shirt dropped over a ball, and one that hangs from its shoulders, a little closer together than they are at rest."""
    garment = tshirt()
    x = garment.mesh.rest_positions
    ball = Sphere(center=(0, 0, 0.2), radius=0.18, friction=0.4)
    cloth = simulation(garment, [ball])
    cloth.reset(positions=x + [0, 0, 0.45])
    over = labeled(picture(garment.mesh, after(cloth, FALLING), Camera((1.0, -1.4, 1.0), (0, 0, 0.1)), [ball]), "over a ball")
    shoulders = [garment.key_points["shoulder_left"], garment.key_points["shoulder_right"]]
    cloth = simulation(garment, anchors=shoulders)
    cloth.reset(positions=x[:, [0, 2, 1]] * [1, -1, 1] + [0, 0, 0.5])
    cloth.move_anchors(cloth.positions[0][shoulders] * [0.8, 1, 1])
    hung = labeled(picture(garment.mesh, after(cloth, HANGING), Camera((0.5, -2.0, 0.9), (0, 0, 0.5)), []), "from its shoulders")
    write(HERE / "garment_shirts.webp", side_by_side([over, hung]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="*", default=list(RANGES), choices=list(RANGES), help="of the rows")
    parser.add_argument("--seed", type=int, default=0, help="of their sizes")
    parser.add_argument("--many", action="store_true", help="only garments_many.webp")
    args = parser.parse_args()
    if args.many:
        draw_many(args.kinds)
    else:
        draw_kinds(args.kinds, args.seed)
        draw_shirts()


if __name__ == "__main__":
    main()

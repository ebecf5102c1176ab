"""The pictures of the README and of the pages.

python docs/pictures.py                                  # the strips: scripted agents in each task; and contact
python docs/pictures.py --strips reach.webp fold.webp    # some of them
python docs/pictures.py --contact                        # contact alone
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clothgym import Box, MeshCollider, Plane, Simulation, grid
from clothgym.forces import structural_strain
from clothgym.render import Camera, Drawn, Renderer
from clothgym.render.heat import heat_colors, largest_at_particles
from clothgym.render.solids import drawn
from clothgym.starts import MANEUVERS

HERE = Path(__file__).parent
SIZE, GAP = 300, 4  # pixels of a picture, and of the white between two
FILLED = 0.92  # share of a picture that what happens takes up
INK = (43, 45, 66)


# --- panels -------------------------------------------------------------------------------------------------------------


def labeled(image: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """A picture with a text in its upper left corner, on some paper."""
    picture = Image.fromarray(image)
    pen, font = ImageDraw.Draw(picture, "RGBA"), ImageFont.load_default(max(12, image.shape[0] // 20))
    left, top, right, bottom = pen.multiline_textbbox((9, 7), text, font)
    pen.rounded_rectangle((left - 4, top - 3, right + 4, bottom + 3), 4, fill=(255, 255, 255, 150))
    pen.multiline_text((9, 7), text, INK, font)
    return np.asarray(picture)


def side_by_side(images: Sequence[NDArray[np.uint8]], axis: int = 1) -> NDArray[np.uint8]:
    """Pictures in a row, or below each other with ``axis=0``, with white between them."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    return np.concatenate([part for image in images for part in (image, gap)][:-1], axis=axis)


def write(path: Path, image: NDArray[np.uint8]) -> None:
    """A picture, with a loss that cannot be seen."""
    Image.fromarray(image).save(path, quality=80, method=6)


def scale_of_strain(width: int, most: float) -> NDArray[np.uint8]:
    """The colors of strains from 0 to ``most``, with numbers, (height, width, 3)."""
    high, bar = 34, min(220, width // 2)
    image = np.full((high, width, 3), 255, np.uint8)
    left = (width - bar) // 2
    image[6:16, left : left + bar] = heat_colors(np.linspace(0, 1, bar))
    picture = Image.fromarray(image)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    for share in (0, 0.5, 1):
        pen.text((left + share * bar, 18), f"{100 * share * most:g} %", INK, font, anchor="mt")
    pen.text((left - 12, 11), "strain of the yarns", INK, font, anchor="rm")
    return np.asarray(picture)


# --- cameras --------------------------------------------------------------------------------------------------------------


def slopes(camera: Camera, points: NDArray) -> NDArray:
    """Where a camera sees these points [m], (points, 3): to the right and up, over the distance ahead, (points, 2)."""
    away = (points - np.asarray(camera.eye)) @ np.stack(list(map(np.asarray, camera.axes)), axis=1)
    return away[:, :2] / away[:, 2:]


def framed(camera: Camera, points: NDArray, aspect: float = 1.0) -> Camera:
    """A camera in the same place that has all these points [m], (points, 3), in its picture, and no more around them.

    aspect: width of the picture over its height.
    """
    eye = np.asarray(camera.eye)
    for _ in range(4):
        right, up, forward = map(np.asarray, camera.axes)
        seen = slopes(camera, points)
        low, high = seen.min(axis=0), seen.max(axis=0)
        x, y = (low + high) / 2
        half = float(((high - low) / (aspect, 1)).max()) / 2
        way = forward + x * right + y * up
        target = eye + camera.distance * way / np.linalg.norm(way)
        camera = replace(camera, target=tuple(target), vertical_fov=math.degrees(2 * math.atan(half / FILLED)))
    return camera


def corners(solids: Iterable[Drawn]) -> NDArray[np.float64]:
    """Points around solids [m], (points, 3)."""
    found = [np.empty((0, 3))]
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    for solid in solids:
        axes, half, radius = solid.rounded_box()
        found.append(np.asarray(solid.collider.center) + (signs * half) @ axes + signs * radius)
    return np.concatenate(found)


class Moment(NamedTuple):
    """positions: of the particles [m], (particles, 3); solids, which hold the sheet up, and markers."""

    time: float
    positions: NDArray[np.float32]
    solids: list[Drawn]
    markers: list[Drawn]


class Episode(NamedTuple):
    """An episode from its first moment to its last, one for each control step."""

    task: Any
    moments: list[Moment]

    def painter(self, size: int, antialias: int, color: str = "fabric") -> Callable[[Moment], NDArray[np.uint8]]:
        """What draws its moments, by a camera that has the sheet in sight in all of them."""
        # and solids and goals, but not grippers, which withdraw
        mesh, start = self.task.mesh_of(0), self.moments[0]
        seen = [corners([*start.solids, *(marker for marker in start.markers if marker.kind == "sphere")])]
        camera = framed(self.task.camera(), np.concatenate([*(moment.positions for moment in self.moments), *seen]))
        uv = mesh.rest_positions[:, :2]
        renderer = Renderer(mesh.triangles, uv, camera, size, size, antialias, threads=1, grid_shape=mesh.shape)

        def draw(moment: Moment) -> NDArray[np.uint8]:
            values = None
            if color == "strain":
                strain = structural_strain(mesh, moment.positions[None])
                values = largest_at_particles(mesh, strain)[0] / np.float32(self.task.strain_shown)
            return renderer.rgb(moment.positions, moment.solids, moment.markers, values)

        return draw


def played(env_id: str, seed: int, act: Any = None, options: dict[str, Any] | None = None, **kwargs: Any) -> Episode:
    """An episode of an agent, ``act(env, observation)``; of the scripted expert by default."""
    env: Any = gym.make(f"clothgym:{env_id}", **kwargs).unwrapped
    task, moments = env.task, []

    def look() -> None:
        solids, markers = (list(map(drawn, things)) for things in (task.solids(0), task.markers(0)))
        moments.append(Moment(len(moments) * task.physics.time_step, task.simulation.positions[0], solids, markers))

    def move(*args: Any) -> None:
        moved(*args)
        look()

    # a picking action is many control steps
    moved, task.move = task.move, move
    observation, _ = env.reset(seed=seed, options=options)
    look()
    over = False
    while not over:
        action = env.expert_action() if act is None else act(env, observation)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    return Episode(task, moments)


def careless(env: Any, observation: Any) -> Any:
    """Straight to the goal, at full speed."""
    return env.task.careless_actions()[0]


# --- strips -------------------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """An episode as a row of moments: after these numbers of steps, and at its end."""

    title: str
    env_id: str
    steps: tuple[int, ...]
    seed: int
    options: dict[str, Any] | None = None
    act: Any = None
    color: str = "fabric"
    kwargs: dict[str, Any] = {}  # noqa: RUF012 - never written to

    def draw(self) -> NDArray[np.uint8]:
        """(height, width, 3)."""
        episode = played(self.env_id, self.seed, self.act, self.options, **self.kwargs)
        draw = episode.painter(SIZE, 3, self.color)
        chosen = [episode.moments[step] for step in self.steps] + [episode.moments[-1]]
        labels = [self.title] + [f"{moment.time:.1f} s" for moment in chosen[1:]]
        return side_by_side([labeled(draw(moment), label) for moment, label in zip(chosen, labels)])


SHAPES = {shape: {"target": {"shape": shape, "center": (0.0, 0.0)}} for shape in ("sphere", "box", "post")}
STRIPS: dict[str, list[Row]] = {
    "drape.webp": [Row(shape, "ClothDrape-v0", (0, 22, 34), 7, target) for shape, target in SHAPES.items()],
    "gripper.webp": [
        Row("flat", "ClothDrapeGripper-v0", (0, 12, 28, 42), 9, {"rumpled": False}),
        Row("rumpled", "ClothDrapeGripper-v0", (0, 14, 30, 46), 9, {"rumpled": True}),
    ],
    "strain.webp": [
        Row("scripted expert", "ClothStrain-v0", (0, 30, 50, 75), 7, color="strain"),
        Row("straight, at full speed", "ClothStrain-v0", (0, 12, 22, 35), 7, act=careless, color="strain"),
    ],
    "hang.webp": [
        Row("ClothHang-v0", "ClothHang-v0", (0, 12, 18, 30), 7),
        Row("ClothHang-Hard-v0", "ClothHang-Hard-v0", (0, 24, 56, 72), 9, {"rumpled": True}),
    ],
    "hook.webp": [
        Row("ClothHook-v0", "ClothHook-v0", (0, 24, 46, 60), 7),
        Row("ClothHook-Hard-v0", "ClothHook-Hard-v0", (0, 30, 80, 112), 9, {"rumpled": True}),
    ],
    "flatten.webp": [
        Row("ClothFlatten-v0", "ClothFlatten-v0", (0, 40, 80, 110), 1_000_106),
        Row("ClothFlatten-Hard-v0", "ClothFlatten-Hard-v0", (0, 40, 80, 110), 1_000_000),
    ],
    "fling.webp": [
        Row("ClothFling-v0", "ClothFling-v0", (0, 40, 72, 78), 1_000_000),
        Row("ClothFling-Hard-v0", "ClothFling-Hard-v0", (0, 44, 82, 90), 1_000_001),
    ],
    "reach.webp": [Row("ClothReach-v0", "ClothReach-v0", (0, 6, 12, 18), 7)],
    "fold.webp": [
        Row("in half", "ClothFold-v0", (0, 16, 30, 44), 7, kwargs={"fold": "half"}),
        Row("diagonal", "ClothFold-v0", (0, 18, 36, 54), 7, kwargs={"fold": "diagonal"}),
        Row("ClothFold-Hard-v0: twice", "ClothFold-Hard-v0", (0, 30, 60, 100), 8),
    ],
}


def draw_strips(names: Iterable[str]) -> None:
    for name in names:
        picture = side_by_side([row.draw() for row in STRIPS[name]], axis=0)
        if STRIPS[name][0].color == "strain":
            picture = np.concatenate([picture, scale_of_strain(picture.shape[1], 0.1)])
        write(HERE / name, picture)


# --- contact ------------------------------------------------------------------------------------------------------------


def stool(width: float = 0.3, leg: float = 0.05, height: float = 0.25, thick: float = 0.04) -> tuple[Any, Any]:
    """Vertices and triangles of a seat on four legs: one closed surface, by the faces of the filled cells of a grid."""
    filled = np.zeros((5, 5, 4), bool)
    filled[1:4:2, 1:4:2, 1] = filled[1:4, 1:4, 2] = True
    side = np.array([0, leg, width - leg, width]) - width / 2
    vertices, triangles, seen = [], [], {}
    for cell in np.argwhere(filled):
        for axis in range(3):
            for way in (0, 1):
                if filled[tuple(cell + (2 * way - 1) * np.eye(3, dtype=int)[axis])]:
                    continue
                u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
                first = cell - 1 + way * np.eye(3, dtype=int)[axis]
                quad = [tuple(corner) for corner in (first, first + u, first + u + v, first + v)]
                for corner in quad:
                    if corner not in seen:
                        seen[corner] = len(vertices)
                        vertices.append((side[corner[0]], side[corner[1]], (0, height - thick, height)[corner[2]]))
                a, b, c, d = (seen[corner] for corner in (quad if way else quad[::-1]))
                triangles += [(a, b, c), (a, c, d)]
    return np.array(vertices), np.array(triangles)


def draw_contact() -> None:
    """A sheet over a stool and over the corner of a box; and a heap, without self-collision and with it."""
    mesh = grid(33, 33, 0.9, 0.9)
    above = mesh.rest_positions * [0.95, 0.95, 1] + [0, 0, 0.32]
    vertices, triangles = stool()
    on_corner = (0.88, 0.3647, -0.2798, 0.1159)  # a box whose diagonal stands upright
    solids = {
        "a stool": MeshCollider(vertices=vertices, triangles=triangles, friction=0.4),
        "a box on its corner": Box(center=(0, 0, 0.05), half_sides=(0.12, 0.12, 0.12), rotation=on_corner, friction=0.4),
    }
    camera = Camera(eye=(1.0, -1.1, 0.8), target=(0, 0, 0.1))
    images = []
    for title, solid in solids.items():
        cloth = Simulation(mesh, colliders=[Plane(friction=0.5), solid], self_collision="strict")
        cloth.set_parameters(air_drag=1.0)
        cloth.reset(positions=above)
        cloth.step(150)
        images.append(labeled(picture(mesh, cloth.positions[0], camera, [solid]), title))
    for title, mode in (("a heap, self_collision=False", False), ('a heap, self_collision="strict"', "strict")):
        heap = MANEUVERS["heap"](grid(33, 33, 1.0, 1.0), seeds=[3], self_collision=mode)
        while not heap.over:
            heap.step()
        x = heap.simulation.positions[0]
        x = x - x[:, :2].mean(axis=0) @ np.eye(2, 3)
        images.append(labeled(picture(heap.simulation.mesh, x, Camera(eye=(0.75, -0.8, 0.5), target=(0, 0, 0.02)), []), title))
    write(HERE / "contact.webp", side_by_side(images))


def picture(mesh: Any, positions: Any, camera: Camera, solids: list[Any]) -> Any:
    """One sheet, (height, width, 3), all of it in sight."""
    uv = mesh.rest_positions[:, :2]
    seen = framed(camera, positions)
    return Renderer(mesh.triangles, uv, seen, SIZE, SIZE, antialias=3, grid_shape=mesh.shape).rgb(positions, solids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strips", nargs="+", choices=STRIPS, metavar="WEBP", help="draw some strips alone")
    parser.add_argument("--contact", action="store_true", help="draw contact alone")
    options = parser.parse_args()
    if not options.contact:
        draw_strips(options.strips or STRIPS)
    if not options.strips:
        draw_contact()


if __name__ == "__main__":
    main()

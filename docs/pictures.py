"""The pictures of the README.

python docs/pictures.py                                            # the strips: scripted agents in each task; and contact
python docs/pictures.py --contact                                  # contact alone
python docs/pictures.py --folds                                    # a film of the three folds
python docs/pictures.py --learned ClothDrape-v0 drape.gif          # and a film of a committed policy
python docs/pictures.py --expert ClothHang-Hard-v0 hang.gif        # or of a scripted expert
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np

from clothgym import Box, MeshCollider, Plane, Simulation, grid
from clothgym.envs.pictures import draw, renderer_of
from clothgym.render.camera import Camera
from clothgym.render.renderer import Renderer
from clothgym.starts import MANEUVERS

HERE = Path(__file__).parent
SIZE, FILMED = 300, 220


def strip(
    env_id: str,
    moments: tuple[int, ...],
    seed: int,
    options: dict[str, Any] | None = None,
    careless: bool = False,
    **kwargs: Any,
) -> Any:
    """One episode of a scripted agent as a row of moments, the last of which is its end, (height, width, 3)."""
    env = gym.make(f"clothgym:{env_id}", **kwargs).unwrapped
    env.reset(seed=seed, options=options)
    renderer = renderer_of(env.task, SIZE, SIZE, antialias=3)
    frames, step, terminated = [], 0, False
    while not terminated:
        if step in moments:
            frames.append(draw(env.task, renderer, "rgb_array", [0])[0])
        action = env.task.careless_actions()[0] if careless else env.expert_action()
        *_, terminated, _, _ = env.step(action)
        step += 1
    return np.concatenate([*frames[: len(moments)], draw(env.task, renderer, "rgb_array", [0])[0]], axis=1)


def draw_strips() -> None:
    targets = [{"target": {"shape": shape, "center": (0.0, 0.0)}} for shape in ("sphere", "box", "post")]
    pictures = {
        "drape.png": [strip("ClothDrape-v0", (0, 22, 34), 7, target) for target in targets],
        "gripper.png": [
            strip("ClothDrapeGripper-v0", (0, 12, 28, 42), 9, {"rumpled": False}),
            strip("ClothDrapeGripper-v0", (0, 14, 30, 46), 9, {"rumpled": True}),
        ],
        "strain.png": [
            strip("ClothStrain-v0", (0, 30, 50, 75), 7),
            strip("ClothStrain-v0", (0, 12, 22, 35), 7, careless=True),
        ],
        "hang.png": [
            strip("ClothHang-v0", (0, 12, 18, 30), 7),
            strip("ClothHang-Hard-v0", (0, 24, 56, 72), 9, {"rumpled": True}),
        ],
        "hook.png": [
            strip("ClothHook-v0", (0, 24, 46, 60), 7),
            strip("ClothHook-Hard-v0", (0, 30, 80, 112), 9, {"rumpled": True}),
        ],
        "flatten.png": [
            strip("ClothFlatten-v0", (0, 40, 80, 110), 1_000_106),
            strip("ClothFlatten-Hard-v0", (0, 40, 80, 110), 1_000_003),
        ],
        "fling.png": [
            strip("ClothFling-v0", (0, 40, 72, 78), 1_000_000),
            strip("ClothFling-Hard-v0", (0, 44, 82, 90), 1_000_001),
        ],
        "reach.png": [strip("ClothReach-v0", (0, 6, 12, 18), 7)],
        "fold.png": fold_strips(),
    }
    for name, rows in pictures.items():
        iio.imwrite(HERE / name, np.concatenate(rows, axis=0))


def fold_strips() -> list[Any]:
    """A row for each fold."""
    return [
        strip("ClothFold-v0", (0, 16, 30, 44), 7, fold="half"),
        strip("ClothFold-v0", (0, 18, 36, 54), 7, fold="diagonal"),
        strip("ClothFold-Hard-v0", (0, 30, 60, 100), 8),
    ]


def draw_folds() -> None:
    """The strip of the folds, and their film, side by side: what has ended stands still."""
    from clothgym.render import write_video

    iio.imwrite(HERE / "fold.png", np.concatenate(fold_strips(), axis=0))
    columns = []
    for env_id, fold in (("ClothFold-v0", "half"), ("ClothFold-v0", "diagonal"), ("ClothFold-Hard-v0", "quarter")):
        env = gym.make(f"clothgym:{env_id}", fold=fold).unwrapped
        env.reset(seed=7)
        renderer = renderer_of(env.task, FILMED, FILMED, antialias=1)
        frames, terminated = [draw(env.task, renderer, "rgb_array", [0])[0]], False
        while not terminated:
            *_, terminated, _, _ = env.step(env.expert_action())
            frames.append(draw(env.task, renderer, "rgb_array", [0])[0])
        columns.append(frames)
    longest = max(map(len, columns))
    film = [np.concatenate([column[min(k, len(column) - 1)] for column in columns], axis=1) for k in range(0, longest, 4)]
    write_video(HERE / "fold.gif", film, fps=7.5)


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
    """A sheet over a stool and over the corner of a box; and a heap, without self-collision and with it, cut open."""
    mesh = grid(33, 33, 0.9, 0.9)
    above = mesh.rest_positions * [0.95, 0.95, 1] + [0, 0, 0.32]
    vertices, triangles = stool()
    on_corner = (0.88, 0.3647, -0.2798, 0.1159)  # a box whose diagonal stands upright
    solids = [
        MeshCollider(vertices=vertices, triangles=triangles, friction=0.4),
        Box(center=(0, 0, 0.05), half_sides=(0.12, 0.12, 0.12), rotation=on_corner, friction=0.4),
    ]
    camera = Camera(eye=(1.0, -1.1, 0.8), target=(0, 0, 0.1))
    frames = []
    for solid in solids:
        cloth = Simulation(mesh, colliders=[Plane(friction=0.5), solid], self_collision="strict")
        cloth.set_parameters(air_drag=1.0)
        cloth.reset(positions=above)
        cloth.step(150)
        frames.append(picture(mesh, cloth.positions, camera, [solid]))
    for mode in (False, "strict"):
        heap = MANEUVERS["heap"](grid(33, 33, 1.0, 1.0), seeds=[3], self_collision=mode)
        while not heap.over:
            heap.step()
        x = heap.simulation.positions - heap.simulation.positions[:, :, :2].mean(axis=1, keepdims=True) @ np.eye(2, 3)
        frames.append(picture(heap.simulation.mesh, x, Camera(eye=(0.75, -0.8, 0.5), target=(0, 0, 0.02)), []))
    iio.imwrite(HERE / "contact.png", np.concatenate(frames, axis=1))


def picture(mesh: Any, positions: Any, camera: Camera, solids: list[Any]) -> Any:
    """One sheet, (height, width, 3)."""
    renderer = Renderer(mesh.triangles, mesh.rest_positions[:, :2], camera, SIZE, SIZE, antialias=3, grid_shape=mesh.shape)
    return renderer.rgb(positions[0], solids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--learned", nargs=2, metavar=("ENV", "GIF"), help="id whose committed policy is filmed, and the film's name"
    )
    parser.add_argument("--expert", nargs=2, metavar=("ENV", "GIF"), help="id whose scripted expert is filmed, and the film's name")
    parser.add_argument("--contact", action="store_true", help="draw contact alone")
    parser.add_argument("--folds", action="store_true", help="draw and film the folds alone")
    options = parser.parse_args()
    if options.contact:
        draw_contact()
        return
    if options.folds:
        draw_folds()
        return
    if options.learned is None and options.expert is None:
        draw_strips()
        draw_contact()
        return
    sys.path.insert(0, str(HERE.parent / "training"))
    import drawing
    import policies

    if options.expert is not None:
        env_id, name = options.expert
        drawing.film(HERE / name, f"clothgym:{env_id}", policies.named("expert", env_id, 0), {}, episodes=2, stride=4)
        return
    env_id, name = options.learned
    kwargs = policies.env_kwargs(policies.COMMITTED, env_id)
    drawing.film(HERE / name, f"clothgym:{env_id}", policies.named(policies.COMMITTED, env_id, 0), kwargs, episodes=3, stride=2)


if __name__ == "__main__":
    main()

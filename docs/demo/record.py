"""The episodes of the demo: committed policies, recorded into files that docs/demo/index.html plays without a server.

python docs/demo/record.py                          # all of them, in a minute
python docs/demo/record.py drape-box strain         # some

A file is one line of JavaScript, so that a page opened from a disk may load it: a call with base64 of gzip.  Unpacked, it holds
the length of a JSON header (uint32), the header, and all positions as int16 in steps of ``QUANTUM``: first the high bytes of all
numbers, then the low ones.  The numbers are, coordinate by coordinate, the residual of each moment after linear extrapolation of
the two before it, in zigzag order (0, -1, 1, -2, ...): small numbers, which gzip packs well.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import json
import struct
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import clothgym
from clothgym.evaluation import FIRST_HELD_OUT
from clothgym.mesh import ClothMesh
from clothgym.playground.show import solid_of
from clothgym.registration import ENVIRONMENTS
from clothgym.render import Drawn
from clothgym.render.solids import drawn

FOLDER = Path(__file__).parent / "episodes"
INDEX = FOLDER / "index.js"
QUANTUM = 5e-5  # of a position [m]; int16 reaches 1.6 m to each side of the middle
LARGEST, LARGEST_TOGETHER = 300_000, 3_000_000  # bytes of a file, and of all
LEARNERS = {
    "bc": "behavior cloning",
    "bc_ppo": "behavior cloning, then PPO",
    "ppo": "PPO",
    "ppo_lagrange": "PPO, Lagrange multiplier",
    "sac": "SAC, started with expert episodes",
    "sac_scratch": "SAC, from scratch",
}


class Chosen(NamedTuple):
    """An episode: its title, an id, options of its reset, and how many control steps pass between two frames.

    The seed is the same for all: none was picked for its looks.
    """

    title: str
    env_id: str
    options: dict[str, Any] = {}  # noqa: RUF012 - never written to
    stride: int = 1


EPISODES = {
    "drape-sphere": Chosen("Drape a sphere", "ClothDrape-v0", {"target": {"shape": "sphere"}}),
    "drape-box": Chosen("Drape a box", "ClothDrape-v0", {"target": {"shape": "box"}}),
    "hang": Chosen("Hang over a rail", "ClothHang-v0"),
    "hook": Chosen("Hang on a hook", "ClothHook-v0"),
    "gripper": Chosen("Pick up and drape", "ClothDrapeGripper-v0"),
    "fold": Chosen("Fold", "ClothFold-v0"),
    "fold-goal": Chosen("Fold to goals", "ClothFoldGoal-v0"),
    "strain": Chosen("Carry without strain", "ClothStrain-v0"),
    "reach": Chosen("Swing to a goal", "ClothReach-v0"),
    "fling": Chosen("Fling flat", "ClothFling-v0"),
    "flatten": Chosen("Flatten", "ClothFlatten-v0", stride=2),
}


class Recorded(NamedTuple):
    """What an episode was.

    positions: of the particles of a full grid, and after them of the centers of the solids [m], (frames, points, 3).
    header: all else, as JSON has it.
    """

    positions: NDArray[np.float64]
    header: dict[str, Any]


def record(name: str) -> Recorded:
    """One of ``EPISODES``, played by its committed policy, from its first moment to its last."""
    title, env_id, options, stride = EPISODES[name]
    policy = clothgym.policies.load(env_id)
    env: Any = policy.make(settling="steps").unwrapped
    task = env.task
    sheets, things, infos = [], [], []

    def look() -> None:
        sheets.append(task.simulation.positions[0].astype(np.float64))
        things.append([(drawn(thing), holds) for holds in (True, False) for thing in (task.solids if holds else task.markers)(0)])
        infos.append({"strain": float(task.info["strain_max"][0]), "score": float(task.info["normalized_performance"][0])})

    def move(*args: Any) -> None:
        moved(*args)
        look()

    # a picking action is many control steps
    moved, task.move = task.move, move
    observation, info = env.reset(seed=FIRST_HELD_OUT, options=options or None)
    look()
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        over = terminated or truncated
    # every so many frames, and the last
    kept = np.unique(np.r_[np.arange(0, len(sheets), stride), len(sheets) - 1])
    sheets, things, infos = ([one[k] for k in kept] for one in (sheets, things, infos))
    mesh, camera, about = task.mesh_of(0), task.camera(), policy.about
    shape, place, holes = grid_of(mesh)
    solids, centers = tracks(things)
    header = {
        "title": title,
        "id": env_id,
        "goal": ENVIRONMENTS[env_id][1],
        "learner": LEARNERS[about["learner"]],
        "success_rate": about["success_rate"],
        "episodes": about["episodes"],
        "seed": FIRST_HELD_OUT,
        "options": options,
        "digest": about["digest"],
        "time_step": stride * task.physics.time_step,
        "shape": shape,
        "side": task.physics.side,
        "holes": holes,
        "camera": {"eye": camera.eye, "target": camera.target, "fov": camera.vertical_fov},
        "solids": solids,
        "strain_shown": task.strain_shown,
        "strain": [round(one["strain"], 5) for one in infos],
        "score": [round(one["score"], 4) for one in infos],
        "success": bool(info["is_success"]),
    }
    return Recorded(np.concatenate([filled(np.stack(sheets), shape, place), centers], axis=1), header)


def grid_of(mesh: ClothMesh) -> tuple[tuple[int, int], NDArray[np.int64], list[int]]:
    """Rows and columns of the grid that a sheet is part of, the place of each particle in it, and which of its cells are holes."""
    flat = mesh.rest_positions[:, :2].astype(np.float64)
    low, spacing = flat.min(axis=0), mesh.springs.rest_length.min()
    column, row = np.rint((flat - low) / spacing).astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    middles = flat[mesh.triangles].mean(axis=1)
    x, y = np.floor((middles - low) / spacing).astype(np.int64).T
    cells = np.arange((shape[0] - 1) * (shape[1] - 1))
    return shape, row * shape[1] + column, np.setdiff1d(cells, y * (shape[1] - 1) + x).tolist()


def filled(sheets: NDArray, shape: tuple[int, int], place: NDArray) -> NDArray[np.float64]:
    """Positions on the whole grid, (frames, rows * columns, 3): in a hole, halfway between the particles above and below."""
    whole = np.full((len(sheets), shape[0] * shape[1], 3), np.nan)
    whole[:, place] = sheets
    for missing in np.setdiff1d(np.arange(whole.shape[1]), place):
        whole[:, missing] = (whole[:, missing - shape[1]] + whole[:, missing + shape[1]]) / 2
    return whole


def tracks(things: list[list[tuple[Drawn, bool]]]) -> tuple[list[dict[str, Any]], NDArray[np.float64]]:
    """Solids by what does not change about them, and where each is in each frame [m], (frames, solids, 3).

    things: in each frame solids, and whether the cloth touches them.  A solid is a box swept by a ball: axes, a row each, half
    sides and radius [m]; "shown" are the frames in which it is there, each pair the first of them and the first without it.
    """
    found: dict[tuple[Drawn, bool, int], list[tuple[int, Any]]] = {}
    for frame, present in enumerate(things):
        seen: Counter[tuple[Drawn, bool]] = Counter()
        for thing, holds in present:
            key = (thing.at_origin, holds)
            seen[key] += 1
            found.setdefault((*key, seen[key]), []).append((frame, thing.collider.center))
    solids, centers = [], np.zeros((len(things), len(found), 3))
    for k, ((thing, holds, _), places) in enumerate(found.items()):
        frames, there = np.array([frame for frame, _ in places]), np.array([place for _, place in places])
        # where it is not there, it waits where it was last, or will be first
        centers[:, k] = there[np.clip(np.searchsorted(frames, np.arange(len(things)), "right") - 1, 0, None)]
        ends = np.flatnonzero(np.diff(frames) > 1)
        first, last = frames[np.r_[0, ends + 1]], frames[np.r_[ends, len(frames) - 1]]
        shown = np.stack([first, last + 1], axis=1).ravel().tolist()
        solids.append(solid_of(thing) | {"holds": holds, "shown": shown})
    return solids, centers


def packed(recorded: Recorded) -> bytes:
    """The content of a file.

    Raises:
        ValueError: something is too far from the middle.
    """
    x = recorded.positions
    middle = (x.min(axis=(0, 1)) + x.max(axis=(0, 1))) / 2
    steps = np.rint((x - middle) / QUANTUM)
    if np.abs(steps).max() > 32767:
        raise ValueError(
            f"positions reach {np.abs(x - middle).max():.2f} m from their middle: must be within {32767 * QUANTUM:.2f} m"
        )
    series = steps.astype(np.int16).reshape(len(x), -1).T
    # two differences in time, modulo 2^16: the first two moments are as they are, and their change
    left = np.diff(np.diff(series, axis=1, prepend=np.int16(0)), axis=1, prepend=np.int16(0))
    zigzag = ((left << 1) ^ (left >> 15)).view(np.uint16)
    sizes = {"frames": len(x), "points": x.shape[1], "quantum": QUANTUM, "middle": middle.tolist()}
    header = json.dumps(sizes | recorded.header, separators=(",", ":")).encode()
    planes = (zigzag >> 8).astype(np.uint8).tobytes() + (zigzag & 255).astype(np.uint8).tobytes()
    return gzip.compress(struct.pack("<I", len(header)) + header + planes, 9, mtime=0)


def written(name: str, recorded: Recorded, folder: Path = FOLDER) -> int:
    """Write an episode's file; returns its size."""
    path = folder / f"{name}.js"
    path.write_text(f'episodeLoaded("{name}", "{base64.b64encode(packed(recorded)).decode()}");\n')
    return path.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", choices=[[], *EPISODES], help=f"any of {', '.join(EPISODES)}; all by default"
    )
    FOLDER.mkdir(exist_ok=True)
    for name in parser.parse_args().names or EPISODES:
        recorded = record(name)
        size = written(name, recorded)
        score, success = recorded.header["score"][-1], recorded.header["success"]
        print(f"{name}: {len(recorded.positions)} frames, {size / 1e3:.0f} kB, score {score:.3f}, success: {success}", flush=True)
        if size > LARGEST:
            raise SystemExit(f"{name}.js has {size} bytes: must be at most {LARGEST}; record fewer frames")
    listed = [{"name": name, "title": chosen.title} for name, chosen in EPISODES.items()]
    INDEX.write_text(f"const EPISODES = {json.dumps(listed)};\n")
    together = sum(path.stat().st_size for path in FOLDER.glob("*.js"))
    print(f"{together / 1e6:.2f} MB in all")
    if together > LARGEST_TOGETHER:
        raise SystemExit(f"all files have {together} bytes: must be at most {LARGEST_TOGETHER}")


if __name__ == "__main__":
    main()

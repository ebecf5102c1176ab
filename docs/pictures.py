"""The pictures of the README, made anew.

python docs/pictures.py                                            # the strips: scripted agents in each task
python docs/pictures.py --run runs/ClothDrape-v0_0 drape.gif       # and a film of a learnt policy
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np

HERE = Path(__file__).parent
SIZE = 300


def strip(env_id: str, moments: tuple[int, ...], seed: int, options: dict[str, Any] | None = None, careless: bool = False) -> Any:
    """One episode of a scripted agent as a row of moments, the last of which is its end, (height, width, 3)."""
    env = gym.make(f"clothgym:{env_id}").unwrapped
    env.reset(seed=seed, options=options)
    renderer = env.task.renderer(SIZE, SIZE, antialias=3)
    frames, step, terminated = [], 0, False
    while not terminated:
        if step in moments:
            frames.append(env.task.draw(renderer, "rgb_array", [0])[0])
        action = env.task.careless_actions()[0] if careless else env.expert_action()
        *_, terminated, _, _ = env.step(action)
        step += 1
    return np.concatenate([*frames[: len(moments)], env.task.draw(renderer, "rgb_array", [0])[0]], axis=1)


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
        "reach.png": [strip("ClothReach-v0", (0, 6, 12, 18), 7)],
    }
    for name, rows in pictures.items():
        iio.imwrite(HERE / name, np.concatenate(rows, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs=2, metavar=("FOLDER", "GIF"), help="folder of a training run, and the film's name")
    options = parser.parse_args()
    if options.run is None:
        draw_strips()
        return
    sys.path.insert(0, str(HERE.parent / "training"))
    import policies
    import report

    folder = Path(options.run[0])
    config = policies.read_config(folder)
    report.film(HERE / options.run[1], config["env"], policies.learnt(folder, config["env"]), config["env_kwargs"], episodes=3)


if __name__ == "__main__":
    main()

"""The pictures of the README, made anew.

python docs/pictures.py                                   # docs/drape.png: the scripted expert on each target
python docs/pictures.py --run runs/ClothDrape-v0_0        # and docs/drape.gif: a learnt policy
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np

HERE = Path(__file__).parent
MOMENTS = (0, 22, 34, 60)  # steps of the episode that are shown, and its end
SHAPES = ("sphere", "box", "post")


def expert_strip(shape: str, size: int = 300) -> np.ndarray:
    """One episode of the scripted expert as a row of moments, (height, width, 3)."""
    env = gym.make("clothgym:ClothDrape-v0").unwrapped
    env.reset(seed=7, options={"target": {"shape": shape, "center": (0.0, 0.0)}})
    renderer = env.task.renderer(size, size, antialias=3)
    frames, step, terminated = [], 0, False
    while not terminated:
        if step in MOMENTS:
            frames.append(env.task.draw(renderer, "rgb_array", [0])[0])
        *_, terminated, _, _ = env.step(env.expert_action())
        step += 1
    return np.concatenate([*frames[: len(MOMENTS) - 1], env.task.draw(renderer, "rgb_array", [0])[0]], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="folder of a training run")
    options = parser.parse_args()
    iio.imwrite(HERE / "drape.png", np.concatenate([expert_strip(shape) for shape in SHAPES], axis=0))
    if options.run is not None:
        sys.path.insert(0, str(HERE.parent / "training"))
        import policies
        import report

        report.film(HERE / "drape.gif", "ClothDrape-v0", policies.learnt(options.run, "ClothDrape-v0"), {}, episodes=3)


if __name__ == "__main__":
    main()

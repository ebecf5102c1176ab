"""The picture of docs/observations.md, one moment in all modes of observation, from above and by the task's own camera; and its
table of how many pixels show the sheet.

python docs/observations.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clothgym.registration import ENVIRONMENTS
from clothgym.render import write_picture

OUT = Path(__file__).with_suffix(".png")
MODES = ("rgb", "depth", "rgbd", "heightmap", "pointcloud")
SIZE, SCALE, GAP, LINE = 64, 3, 6, 22  # pixels of a picture, and of each of its own; between pictures; of a line of labels
LABELS = {"rgbd": "rgbd: color | depth"}
STEPS = 62  # of the expert's episode
STARTS = 8  # episodes at whose start pixels are counted


def gray(values: NDArray) -> NDArray:
    """Numbers as gray colors, the largest white, (size, size, 3)."""
    low, high = float(values.min()), float(values.max())
    return np.repeat(np.rint(255 * (values - low) / max(high - low, 1e-9)).astype(np.uint8)[..., None], 3, axis=-1)


def shown(mode: str, seen: NDArray) -> NDArray:
    """An observation as a picture, (size, size, 3): near and high is white; points by their height, as seen from above."""
    if mode == "rgb":
        return seen
    if mode == "depth":
        return gray(-seen[..., 0])
    if mode == "rgbd":
        # left half colors, right half depths
        both = np.rint(255 * seen[..., :3]).astype(np.uint8)
        both[:, SIZE // 2 :] = gray(-seen[..., 3])[:, SIZE // 2 :]
        return both
    if mode == "heightmap":
        return gray(seen)
    picture = np.full((SIZE, SIZE, 3), 30, np.uint8)
    place = np.rint(SIZE / 2 + seen[:, :2] * (1, -1) * SIZE / 3).astype(int).clip(0, SIZE - 1)
    heights = (seen[:, 2] - seen[:, 2].min()) / max(float(np.ptp(seen[:, 2])), 1e-9)
    for (column, row), height in sorted(zip(place.tolist(), heights.tolist()), key=lambda one: one[1]):
        picture[row, column] = 90 + int(165 * height)
    return picture


def cloth_pixels(env_id: str, camera: str | None) -> int:
    """The mean number of pixels that show the sheet at the start of an episode: a cloud with room for all of them has each once."""
    env = gym.make_vec(
        f"clothgym:{env_id}", num_envs=STARTS, obs_mode="pointcloud", image_size=SIZE, num_points=SIZE * SIZE, camera=camera
    )
    clouds, _ = env.reset(seed=0)
    return round(np.mean([len(np.unique(cloud, axis=0)) for cloud in clouds]))


def main() -> None:
    for env_id in ENVIRONMENTS:
        # goals are of key points alone
        if "-Hard" not in env_id and "Goal" not in env_id:
            print(f"| `{env_id}` | {cloth_pixels(env_id, None)} | {cloth_pixels(env_id, 'task')} |", flush=True)
    rows = []
    for camera in (None, "task"):
        row = []
        for mode in MODES:
            kwargs: dict[str, Any] = {} if mode == "heightmap" else {"camera": camera}
            env = gym.make("clothgym:ClothDrapeGripper-v0", obs_mode=mode, image_size=SIZE, **kwargs)
            seen, _ = env.reset(seed=4)
            for _ in range(STEPS):
                seen, *_ = env.step(env.unwrapped.expert_action())  # type: ignore[attr-defined]
            row.append(np.kron(shown(mode, seen), np.ones((SCALE, SCALE, 1), np.uint8)))
        gap = np.full((SIZE * SCALE, GAP, 3), 255, np.uint8)
        rows.append(np.concatenate([part for one in row for part in (one, gap)][:-1], axis=1))
    lines = []
    for row, seen_from in zip(rows, ("from above", "by the task's camera")):
        line = Image.new("RGB", (row.shape[1], LINE), "white")
        for k, mode in enumerate(MODES):
            # a height map is always from above
            label = mode if mode == "heightmap" else f"{LABELS.get(mode, mode)}, {seen_from}" if k == 0 else LABELS.get(mode, mode)
            ImageDraw.Draw(line).text((k * (SIZE * SCALE + GAP) + 2, 3), label, (43, 45, 66), ImageFont.load_default(13))
        lines += [np.asarray(line), row]
    write_picture(OUT, np.concatenate(lines))


if __name__ == "__main__":
    main()

"""The pictures that a run leaves: a learning curve, and a film of what was learned."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import policies
import scoring

from clothgym import files
from clothgym.render import write_video

matplotlib.use("Agg")
from matplotlib import pyplot as plt

INK, ACCENT, QUIET = "#2b2d42", "#d1495b", "#8d99ae"


def draw_learning_curve(folder: Path, lines: list[dict[str, float]], references: dict[str, float]) -> None:
    """Held-out success and performance over training time, with the references as level lines; below it the cost, if any."""
    minutes = [line["training_seconds"] / 60 for line in lines]
    costly = all("cost" in line for line in lines) and bool(lines)
    figure, panels = plt.subplots(
        1 + costly, 1, figsize=(6.4, 5.4 if costly else 3.8), layout="constrained", sharex=True, squeeze=False
    )
    axes = panels[0, 0]
    axes.plot(minutes, [line["success_rate"] for line in lines], color=ACCENT, marker="o", ms=3, label="success rate")
    axes.plot(minutes, [line["normalized_performance"] for line in lines], color=INK, lw=1, label="normalized performance")
    for name, level in references.items():
        axes.axhline(level, color=QUIET, lw=0.8, ls="--")
        axes.annotate(name, (1.0, level), xycoords=("axes fraction", "data"), ha="right", va="bottom", color=QUIET, fontsize=8)
    axes.set(ylabel="held-out episodes", ylim=(-0.02, 1.02), title=folder.name)
    axes.legend(frameon=False, loc="center right")
    if costly:
        panels[1, 0].plot(minutes, [line["cost"] for line in lines], color=ACCENT, marker="o", ms=3)
        panels[1, 0].set(ylabel="mean cost of an episode", yscale="symlog", ylim=(0, None))
    panels[-1, 0].set(xlabel="training time [minutes]")
    for panel in panels[:, 0]:
        panel.spines[["top", "right"]].set_visible(False)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=150)
    plt.close(figure)
    files.write(folder / "learning_curve.png", picture.getvalue())


def film(
    path: Path,
    env_id: str,
    policy: policies.Policy,
    env_kwargs: dict[str, Any],
    episodes: int = 4,
    stride: int = 1,
    seed: int = scoring.HELD_OUT,
) -> None:
    """Some episodes, by default held-out ones, side by side with white between, each one's end standing still; every so many frames
    of them."""
    # a film shows how the sheet settles, too
    env_kwargs = env_kwargs | {"settling": "steps"}
    env = gym.make_vec(env_id, num_envs=episodes, autoreset_mode="Disabled", render_mode="rgb_array", **env_kwargs)
    observations, _ = env.reset(seed=seed)
    frames, running = [], np.ones(episodes, bool)
    still = [np.asarray(frame) for frame in env.render()]
    while running.any():
        frames.append(_row(still))
        observations, _, terminated, truncated, _ = env.step(policy(env, observations))
        fresh = env.render()
        still = [new if on else old for new, old, on in zip(fresh, still, running)]
        running &= ~(terminated | truncated)
    rate = env.metadata["render_fps"]
    # the end stands for half a second
    frames += [_row(still)] * max(1, round(rate / 2))
    env.close()
    write_video(path, frames[::stride], fps=rate / stride)


def _row(images: list[np.ndarray]) -> np.ndarray:
    """Pictures beside each other, with four white columns between them."""
    bordered = [np.pad(image, ((0, 0), (0, 4), (0, 0)), constant_values=255) for image in images]
    return np.concatenate(bordered, axis=1)[:, :-4]

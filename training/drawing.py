"""Pictures of learning: a run's learning curve and film, and the curves of all committed runs of an environment."""

from __future__ import annotations

import io
from itertools import product
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
CURVES = Path(__file__).parent.parent / "docs" / "curves"
# of learners, told apart by the color-blind, too (Okabe and Ito)
COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
# policies in the figure of all scores, by their name there: their words in the legend, and their color
SHOWN = {
    "random": ("random actions", QUIET),
    "expert": ("scripted expert", INK),
    "bc": ("behavior cloning", COLORS[1]),
    "scratch": ("RL from scratch", COLORS[0]),
}


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
    # a film shows every control step, and how the sheet settles
    repeat = env_kwargs.get("action_repeat", 1)
    env_kwargs = env_kwargs | {"settling": "steps", "action_repeat": 1}
    env = gym.make_vec(env_id, num_envs=episodes, autoreset_mode="Disabled", render_mode="rgb_array", **env_kwargs)
    observations, _ = env.reset(seed=seed)
    frames, running = [], np.ones(episodes, bool)
    still = [np.asarray(frame) for frame in env.render()]
    while running.any():
        if len(frames) % repeat == 0:
            action = policy(env, observations)
        frames.append(_row(still))
        observations, _, terminated, truncated, _ = env.step(action)
        fresh = env.render()
        still = [new if on else old for new, old, on in zip(fresh, still, running)]
        running &= ~(terminated | truncated)
    rate = env.metadata["render_fps"]
    # the end stands for half a second
    frames += [_row(still)] * max(1, round(rate / 2))
    env.close()
    write_video(path, frames[::stride], fps=rate / stride)


def _row(images: list[np.ndarray]) -> np.ndarray:
    """Pictures side by side, with four white columns between them."""
    bordered = [np.pad(image, ((0, 0), (0, 4), (0, 0)), constant_values=255) for image in images]
    return np.concatenate(bordered, axis=1)[:, :-4]


def draw_curves(env_id: str, results: list[dict[str, Any]]) -> None:
    """Held-out success of every seed over steps and over minutes, and its cost where there is one.

    A color for each learner: a thin line for each seed, a band over all of them, their median bold.  Behavior cloning
    without further learning is a point for each seed.
    """
    from results import groups, progress  # imported here: runs need no committed results

    found = [(label, rows) for (env, label), rows in groups(results).items() if env == env_id]
    curves = [(label.replace("`", ""), [progress(row["run"]) for row in rows]) for label, rows in found]
    shown = ["success_rate"] + ["cost"] * any("cost" in line for _, seeds in curves for seed in seeds for line in seed)
    figure, panels = plt.subplots(
        len(shown), 2, figsize=(9, 3.2 * len(shown)), layout="constrained", sharex="col", sharey="row", squeeze=False
    )
    for (row, what), (column, key, unit) in product(enumerate(shown), ((0, "timesteps", 1e6), (1, "core_seconds", 60))):
        for color, (label, seeds) in zip(COLORS, curves):
            _draw_seeds(panels[row, column], [[(line[key] / unit, line[what]) for line in seed] for seed in seeds], color, label)
        panels[row, column].spines[["top", "right"]].set_visible(False)
        panels[row, column].set(xlim=(0, None))
    figure.suptitle(env_id, fontsize=11)
    panels[0, 0].set(ylabel="success", ylim=(0, 1.02))
    if "cost" in shown:
        # an untrained policy's cost of 100 and the limit of 0.3 are both to be seen
        panels[1, 0].set_yscale("symlog", linthresh=1.0)
        panels[1, 0].set(
            ylabel="cost of an episode", ylim=(0, 160), yticks=(0, 0.3, 1, 10, 100), yticklabels=("0", "0.3", "1", "10", "100")
        )
    for panel, text in zip(panels[-1], ("environment steps [millions]", "training time [minutes of one core]")):
        panel.set(xlabel=text)
    figure.legend(*panels[0, 1].get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower center", ncols=3)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=110, metadata={"Software": None})  # the same curves make the same file with any version
    plt.close(figure)
    files.write(CURVES / f"{env_id}.png", picture.getvalue())


def draw_controls(results: list[dict[str, Any]]) -> None:
    """Success of each seed of the controls of SAC, by the mean action and with noise; a panel for each environment."""
    from results import by_setting  # imported here: runs need no committed results

    found = by_setting(results)
    names = sorted({setting.env for setting in found})
    of = {name: {setting: rows for setting, rows in found.items() if setting.env == name} for name in names}
    heights = [len(settings) for settings in of.values()]
    figure, panels = plt.subplots(
        len(of), 1, figsize=(7, 1.2 + 0.27 * sum(heights)), layout="constrained", sharex=True, squeeze=False, height_ratios=heights
    )
    for panel, (name, settings) in zip(panels[:, 0], of.items()):
        # controls differ from the setting of the most seeds, with few critics
        usual = max(settings, key=lambda setting: (len(settings[setting]), -setting.critics))
        for height, rows in enumerate(settings.values()):
            scores = [row["success_rate"] for row in rows], [row["with_noise"]["success_rate"] for row in rows]
            for up, values, color in zip((0.14, -0.14), scores, (COLORS[1], COLORS[0])):
                panel.plot(values, [height + up] * len(rows), ls="", marker="o", ms=4, alpha=0.7, color=color, clip_on=False)
                panel.plot([np.median(values)] * 2, [height + up - 0.13, height + up + 0.13], color=color, lw=2, clip_on=False)
        panel.set(title=name, xlim=(0, 1), ylim=(len(settings) - 0.5, -0.5))
        panel.set_yticks(range(len(settings)), [setting.said(usual) for setting in settings])
        panel.spines[["top", "right"]].set_visible(False)
    panels[-1, 0].set(xlabel="success: a dot for each seed, their median as a bar")
    words = [plt.Line2D([], [], ls="", marker="o", color=color, label=label) for color, label in
             ((COLORS[1], "mean action"), (COLORS[0], "with noise"))]  # fmt: skip
    figure.legend(handles=words, frameon=False, loc="outside upper right", ncols=2)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=110, metadata={"Software": None})
    plt.close(figure)
    files.write(CURVES / "controls.png", picture.getvalue())


def _draw_seeds(panel: Any, seeds: list[list[tuple[float, float]]], color: str, label: str) -> None:
    """What the seeds of one learner came to on the way; they are evaluated at the same steps."""
    common = min(map(len, seeds))
    # (seeds, evaluations, 2)
    points = np.array([seed[:common] for seed in seeds])
    if common == 1:
        panel.plot(*points[:, 0].T, ls="", marker="o", ms=4, color=color, label=f"{label} ({len(seeds)})", clip_on=False, zorder=5)
        return
    for curve in points:
        panel.plot(*curve.T, color=color, lw=0.7, alpha=0.5)
    middle = np.median(points, axis=0)
    # from the lowest to the highest of all seeds at each moment at which all of them were learning
    moments = np.linspace(points[:, 0, 0].max(), points[:, -1, 0].min(), 100)
    between = [np.interp(moments, *curve.T) for curve in points]
    panel.fill_between(moments, np.min(between, axis=0), np.max(between, axis=0), color=color, alpha=0.15, lw=0)
    panel.plot(*middle.T, color=color, lw=2, marker="o", ms=3, label=f"{label} ({len(seeds)})")


def scores_figure(environments: list[list[dict[str, Any]]]) -> str:
    """Success of policies as an SVG, narrow enough for a phone: one block for each environment, one line for each policy.

    It is written by hand, since the text of an SVG by matplotlib depends on its version, and a test compares this one.

    Args:
        environments: for each environment its scores, dicts with ``env``, ``policy`` (of ``SHOWN``), ``success`` (the estimate, and
            the ends of its 95 % interval) and ``present`` (filled dot, otherwise hollow).
    """
    left, width, top, block, line = 12, 376, 98, 61, 9
    bottom = top + block * len(environments)
    parts = [
        f'<text x="{left + width * tick / 5:g}" y="{y}" text-anchor="middle" font-size="13">{tick / 5:g}</text>'
        for tick in range(6)
        for y in (top - 6, bottom + 16)
    ]
    parts += [f'<path d="M{left + width * tick / 5:g} {top}V{bottom}" stroke="#e3e6ec" stroke-width="1"/>' for tick in range(6)]
    for number, (label, color) in enumerate(SHOWN.values()):
        x, y = left + 6 + 190 * (number % 2), 16 + 22 * (number // 2)
        parts += [_dot(x, y, color, True), f'<text x="{x + 11}" y="{y + 5}">{label}</text>']
    parts += [_dot(left + 6, 60, INK, False), f'<text x="{left + 17}" y="65">hollow: predates the latest physics</text>']
    for number, scores in enumerate(environments):
        y = top + block * number + 17
        parts.append(f'<text x="{left}" y="{y}" font-weight="600">{scores[0]["env"]}</text>')
        for one in scores:
            label, color = SHOWN[one["policy"]]
            at = y + 11 + line * list(SHOWN).index(one["policy"])
            mean, low, high = (left + width * value for value in one["success"])
            told = "{env}, {label}: {0:.3f} [{1:.3f}, {2:.3f}]".format(*one["success"], env=one["env"], label=label)
            interval = f'<path d="M{low:.1f} {at}H{high:.1f}" stroke="{color}" stroke-width="2"/>'
            parts.append(f"<g><title>{told}</title>{interval}{_dot(mean, at, color, one['present'])}</g>")
    parts.append(f'<text x="{left + width / 2:g}" y="{bottom + 36}" text-anchor="middle">success, with 95 % intervals</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 400 {bottom + 44}" width="440" '
    head += f'font-family="system-ui, sans-serif" font-size="15" fill="{INK}">\n<rect width="100%" height="100%" fill="#fff"/>\n'
    return head + "\n".join(parts) + "\n</svg>\n"


def _dot(x: float, y: float, color: str, filled: bool) -> str:
    return f'<circle cx="{x:.1f}" cy="{y}" r="4" fill="{color if filled else "#fff"}" stroke="{color}" stroke-width="1.6"/>'

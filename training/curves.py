"""Pictures of how runs learned: every seed of every learner, from committed results."""

from __future__ import annotations

import io
from itertools import product
from typing import Any

import numpy as np
from results import ROOT, Result, groups, progress

from clothgym import files

CURVES = ROOT / "docs" / "curves"
# of learners, told apart by the color-blind, too (Okabe and Ito)
COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def draw_curves(env_id: str, results: list[Result]) -> None:
    """Held-out success of every seed over steps and over minutes, and its cost where there is one.

    A color for each learner: a thin line for each seed, a band over all of them, their median bold.  A clone that learns no
    further is a point for each seed.
    """
    found = [(label, rows) for (env, label), rows in groups(results).items() if env == env_id]
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

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

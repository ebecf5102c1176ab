"""Do policies hold under another simulator?  Committed ones under other integrators, substeps, meshes, fabrics and physics.

    python benchmarks/transfer.py            # continues benchmarks/results/transfer.json; draws docs/transfer.png

Each policy was trained in the task as its id fixes it, and has not seen any of the others.  The same held-out episodes for all.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import clothgym.policies as committed
from clothgym import files
from clothgym.lab.bench import machine
from clothgym.lab.digests import digest_of

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "training"))
import policies  # noqa: E402 - scripts of training/
from scoring import HELD_OUT, run_episodes, wilson  # noqa: E402

RESULTS, PICTURE = ROOT / "benchmarks" / "results" / "transfer.json", ROOT / "docs" / "transfer.png"
EPISODES = 100
ACTORS = (
    ("ClothDrape-v0", "expert"),
    ("ClothDrape-v0", "learned:ppo"),
    ("ClothReach-v0", "learned:ppo"),
)
# changed arguments, by their label in the picture
VARIANTS: dict[str, dict[str, Any]] = {
    "as trained": {},
    "verlet": {"integrator": "verlet"},
    "implicit Euler": {"integrator": "implicit_euler"},
    "100 substeps": {"substeps": 100},
    "13 a side": {"rows": 13},
    "25 a side": {"rows": 25},
    "33 a side": {"rows": 33},
    "silk": {"fabric": "silk"},
    "cotton": {"fabric": "cotton"},
    "wool": {"fabric": "wool"},
    "density ± 30 %": {"randomize": {"density": [0.138, 0.256]}},
    "fast physics": {"physics": "fast"},
}


def cell(env_id: str, actor: str, kwargs: dict[str, Any]) -> dict[str, Any]:
    """Success of one policy in an environment with these arguments."""
    kwargs = {name: value for name, value in kwargs.items() if name != "settling"}
    episodes = run_episodes(env_id, policies.named(actor, env_id, HELD_OUT), list(range(HELD_OUT, HELD_OUT + EPISODES)), **kwargs)
    successes = int(episodes["is_success"].sum())
    return {
        "success_rate": successes / EPISODES,
        "success_rate_ci95": wilson(successes, EPISODES),
        "normalized_performance": float(episodes["normalized_performance"].mean()),
    }


def file_of(actor: str, env_id: str) -> str:
    """A digest of the file of a committed policy; of a scripted one nothing, which the environment's digest covers."""
    learner = actor.partition("learned:")[2]
    path = committed.FOLDER / f"{env_id}_{learner}.npz"
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12] if learner else ""


def draw(rows: dict[str, dict[str, Any]]) -> None:
    """A heat map: policies down, changes across; each cell with its interval.  The colors begin below the lowest success."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    names = [name for name in rows if rows[name]]
    rates = np.full((len(names), len(VARIANTS)), np.nan)
    for i, name in enumerate(names):
        for j, variant in enumerate(VARIANTS):
            rates[i, j] = rows[name].get(variant, {}).get("success_rate", np.nan)
    lowest = np.floor(10 * np.nanmin(rates)) / 10
    figure, axes = plt.subplots(figsize=(12, 0.62 * len(names) + 1.9), layout="constrained")
    # perceptually uniform from dark to light, and its order is seen without its legend
    shown = axes.imshow(rates, vmin=lowest, vmax=1, cmap="magma", aspect="auto")
    for i, name in enumerate(names):
        for j, variant in enumerate(VARIANTS):
            place = {"ha": "center", "va": "center"}
            if (found := rows[name].get(variant)) is None:
                axes.text(j, i, "not run", fontsize=7.5, color="#8d99ae", **place)
                continue
            low, high = found["success_rate_ci95"]
            color = "black" if rates[i, j] > lowest + 0.5 * (1 - lowest) else "white"
            axes.text(j, i - 0.12, f"{rates[i, j]:.2f}", fontsize=11, weight="bold", color=color, **place)
            axes.text(j, i + 0.24, f"{low:.2f}–{high:.2f}", fontsize=7.5, color=color, **place)
    axes.set_xticks(np.arange(len(VARIANTS) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", lw=2)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
    axes.set_xticks(range(len(VARIANTS)), list(VARIANTS), rotation=30, ha="right")
    axes.set_yticks(range(len(names)), [name.replace(" learned:", ", ") for name in names])
    figure.colorbar(shown, label=f"success in {EPISODES} episodes", pad=0.01)
    figure.savefig(PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="draw what there is, and evaluate nothing")
    options = parser.parse_args()
    rows: dict[str, dict[str, Any]] = {f"{env_id} {actor}": {} for env_id, actor in ACTORS}
    if RESULTS.exists():
        rows |= files.read_json(RESULTS, "table of transfers", "remove it, and make it anew")["rows"]
    for env_id, actor in ACTORS:
        policies.checked(actor, env_id)
    wanted = [(env_id, actor, variant) for env_id, actor in ACTORS for variant in VARIANTS]
    for env_id, actor, variant in tqdm([] if options.draw else wanted, unit="cell"):
        own = rows[f"{env_id} {actor}"]
        changed = {**policies.env_kwargs(actor, env_id), **VARIANTS[variant]}
        try:
            now = digest_of(env_id, changed)
        except ValueError as error:  # a change that this task does not take
            print(f"{env_id}, {variant}: {error}")
            continue
        # a cell of other code, or of another policy, is measured again
        made = {"digest": now, "policy": file_of(actor, env_id)}
        if made.items() <= own.get(variant, {}).items():
            continue
        own[variant] = cell(env_id, actor, changed) | made
        files.write_json(RESULTS, {"machine": machine(), "episodes": EPISODES, "variants": VARIANTS, "rows": rows})
    print(
        json.dumps({name: {variant: one["success_rate"] for variant, one in row.items()} for name, row in rows.items()}, indent=1)
    )
    draw(rows)


if __name__ == "__main__":
    main()

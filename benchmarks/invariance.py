"""Do scores depend on the solver?  Policies and the expert of ClothDrape-v0 on other substeps and other integrators.

    python benchmarks/invariance.py --runs runs/ClothDrape-v0_0                     # substeps doubled and quadrupled: minutes
    python benchmarks/invariance.py --runs runs/ClothDrape-v0_0 --matrix A B ...    # and runs trained elsewhere, on every method

Episodes are paired: episode ``i`` is that of seed ``HELD_OUT + i`` for each policy and each setting, 500 of them (200 in the
matrix).  Success may not move by more than 5 points when the substeps are doubled and quadrupled.  The runs of the matrix were
trained with

    python training/train.py --timesteps 1024000 --run FOLDER --env-kwargs '{"integrator": "xpbd", "substeps": 100}'

and the like; each is named by the integrator in its own configuration.  Results are written after each cell and taken up again;
``--fresh`` measures again.  They are in ``results/invariance.json``, and the matrix in ``docs/transfer.png``.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from clothgym.envs.drape import DrapeTask
from clothgym.lab.bench import machine

sys.path.insert(0, str(Path(__file__).parent.parent / "training"))
import evaluate
import policies

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ENV = "ClothDrape-v0"
RESULT = Path(__file__).parent / "results" / "invariance.json"
PICTURE = Path(__file__).parent.parent / "docs" / "transfer.png"
MULTIPLES = (1, 2, 4)
# what each integrator is tested with: the task's own substeps where they are stable, what is accurate to 5 mm a meter elsewhere
TESTED: dict[str, dict[str, Any]] = {
    "semi_implicit_euler": {},
    "verlet": {"integrator": "verlet", "substeps": 50},
    "rk4": {"integrator": "rk4", "substeps": 40},
    "explicit_euler": {"integrator": "explicit_euler", "substeps": 400},
    "xpbd": {"integrator": "xpbd", "substeps": 100},
    "implicit_euler": {"integrator": "implicit_euler", "substeps": 20},
    "projective_dynamics": {"integrator": "projective_dynamics", "substeps": 20},
    "pbd": {"integrator": "pbd", "substeps": 12},
}


def succeeded(policy: str, count: int, **kwargs: Any) -> list[bool]:
    """Whether each held-out episode succeeds."""
    seeds = list(range(evaluate.HELD_OUT, evaluate.HELD_OUT + count))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*substeps of.*")  # coarse settings are part of the question
        episodes = evaluate.run_episodes(ENV, policies.named(policy, ENV, seeds[0]), seeds, **kwargs)
    return [bool(one) for one in episodes["is_success"]]


def trained_on(run: str) -> str:
    """The integrator of a run's own environment, with what else it was given."""
    kwargs = policies.env_kwargs(run)
    method = kwargs.get("integrator", DrapeTask.physics.integrator)
    name, options = (method, {}) if isinstance(method, str) else (method["name"], {k: v for k, v in method.items() if k != "name"})
    described = [f"{kwargs.get('substeps', DrapeTask.physics.substeps)} substeps", *(f"{v:g} {k}" for k, v in options.items())]
    return f"{name} ({', '.join(described)})"


def print_invariance(rows: list[dict[str, Any]]) -> None:
    print(f"\n{'policy':<28} {'substeps':>8} {'success':>8} {'change':>8} {'episodes that change':>21}")
    for row in rows:
        first = next(r for r in rows if r["policy"] == row["policy"])
        now, then = np.array(row["succeeded"]), np.array(first["succeeded"])
        flips = f"{int(np.sum(now & ~then))} up, {int(np.sum(~now & then))} down"
        print(f"{row['policy']:<28} {row['substeps']:>8} {now.mean():>8.3f} {100 * (now.mean() - then.mean()):>+7.1f}p {flips:>21}")


def draw(rows: list[dict[str, Any]]) -> None:
    """Success of each run on each integrator."""
    sources, targets = list(dict.fromkeys(r["trained_on"] for r in rows)), list(TESTED)
    table = np.full((len(sources), len(targets)), np.nan)
    for row in rows:
        table[sources.index(row["trained_on"]), targets.index(row["tested_on"])] = np.mean(row["succeeded"])
    figure, axes = plt.subplots(figsize=(9.2, 1.8 + 0.42 * len(sources)), layout="constrained")
    axes.imshow(table, vmin=0, vmax=1, cmap="YlGnBu", aspect="auto")
    for i, j in np.argwhere(np.isfinite(table)):
        axes.text(j, i, f"{table[i, j]:.2f}", ha="center", va="center", color="white" if table[i, j] > 0.6 else "black", fontsize=9)
    axes.set_xticks(range(len(targets)), [t.replace("_", "\n") for t in targets], fontsize=8)
    axes.set_yticks(range(len(sources)), sources, fontsize=8)
    axes.set(xlabel="tested on", title="Success of policies trained on one integrator and tested on another")
    axes.set_ylabel("trained on")
    figure.savefig(PICTURE, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", nargs="+", required=True, help="folders of runs on the task as it is")
    parser.add_argument("--matrix", nargs="*", default=[], help="folders of runs trained on other integrators")
    parser.add_argument("--episodes", type=int, default=500, help="for each policy and setting")
    parser.add_argument("--matrix-episodes", type=int, default=200, help="for each cell of the matrix")
    parser.add_argument("--fresh", action="store_true", help="measure again what is there")
    args = parser.parse_args()
    known = json.loads(RESULT.read_text()) if RESULT.exists() and not args.fresh else {}
    results: dict[str, Any] = {"machine": machine(), "substeps": [], "matrix": []}

    def cell(section: str, count: int, key: dict[str, Any], policy: str, **kwargs: Any) -> None:
        row = next((row for row in known.get(section, []) if key.items() <= row.items()), None)
        results[section].append(row or key | {"succeeded": succeeded(policy, count, **kwargs)})
        RESULT.write_text(json.dumps(results) + "\n")

    for policy in ("expert", *args.runs):
        for multiple in MULTIPLES:
            substeps = multiple * DrapeTask.physics.substeps
            cell("substeps", args.episodes, {"policy": Path(policy).name, "substeps": substeps}, policy, substeps=substeps)
    print_invariance(results["substeps"])
    if args.matrix:
        for policy in ("expert", args.runs[0], *args.matrix):
            source = "(scripted expert)" if policy == "expert" else trained_on(policy)
            for target, kwargs in TESTED.items():
                cell("matrix", args.matrix_episodes, {"trained_on": source, "tested_on": target}, policy, **kwargs)
        draw(results["matrix"])


if __name__ == "__main__":
    main()

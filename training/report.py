"""Every table of scores in the README and in docs/, and every learning curve, from committed results.

    python training/report.py                                # write them anew
    python training/report.py --check                        # only say what is stale, with status 1
    python training/report.py --digests                      # first note what each environment does now: some minutes
    python training/report.py --add runs/ClothDrape-v0_*     # first take these runs' results, and the policies that are chosen

A result carries the digest of what its environment did when it was made (``clothgym.lab.digests``); the present ones are in
benchmarks/results/digests.json.  A row whose digest is another is shown as old, until it is made again.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import suite
import tyro
from endings import refused

from clothgym import files
from clothgym.adapters.runs import POLICY
from clothgym.lab.digests import WITHOUT_EFFECT, digest_of, name_of
from clothgym.registration import ENVIRONMENTS

ROOT = Path(__file__).parent.parent
RESULTS, CURVES = ROOT / "benchmarks" / "results", ROOT / "docs" / "curves"
RUNS, DIGESTS, SUITE = RESULTS / "training", RESULTS / "digests.json", RESULTS / "suite.json"
MAXIMIZERS = RESULTS / "maximizers.json"
COMMITTED = ROOT / "clothgym" / "policies"
KEPT = ("config.json", "evaluation.json", "progress.jsonl")
PAGES = ("README.md", "docs/results.md", "docs/cheats.md")
ADVICE = "make it with  python training/report.py --digests"
LABELS = {
    "ppo": "PPO", "ppo_penalty": "PPO, fixed price", "ppo_lagrange": "PPO, Lagrange multiplier", "bc": "clone of the expert",
    "bc_ppo": "clone of the expert, then PPO", "sac": "SAC", "her": "SAC with hindsight (HER)",
}  # fmt: skip
# of learners in a picture of curves, told apart by the color-blind, too (Okabe and Ito)
COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
Result = dict[str, Any]


@dataclass
class Args:
    """What to do before the pages are written, if anything."""

    add: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN ...")] = ()
    """Folders of finished runs whose results are to be committed."""
    digests: bool = False
    """Note what each environment does now."""
    check: bool = False
    """Write nothing; say which pages are stale."""


# --- results ------------------------------------------------------------------------------------------------------------------


def read_digests(path: Path = DIGESTS) -> dict[str, str]:
    """What each environment does now, by ``digests.name_of``."""
    return files.read_json(path, "list of digests", ADVICE)["digests"]


def is_present(row: Result, digests: dict[str, str]) -> bool:
    """Whether a result is of the code at hand."""
    return row.get("digest") == digests.get(name_of(row["env"], row["env_kwargs"]), "unknown")


def learned(folder: Path = RUNS) -> list[Result]:
    """The results of all runs that are committed."""
    return [json.loads(path.read_text()) | {"run": path.parent.name} for path in sorted(folder.glob("*/evaluation.json"))]


def groups(results: Iterable[Result]) -> dict[tuple[str, str], list[Result]]:
    """Results that differ in their seed only, by environment and by what was learned there and how."""
    found: dict[tuple[str, str], list[Result]] = {}
    for one in results:
        more = {name: value for name, value in one["env_kwargs"].items() if name not in WITHOUT_EFFECT}
        label = ", ".join([LABELS[one["learner"]], *(f"`{name}={value!r}`" for name, value in more.items())])
        found.setdefault((one["env"], label), []).append(one)
    return found


def interquartile_mean(values: Iterable[float]) -> float:
    """Mean without the lowest and the highest quarter, as rliable has it (Agarwal et al. 2021); of three values that of all."""
    from scipy.stats import trim_mean

    return float(trim_mean(list(values), 0.25))


def bootstrap(values: list[float], draws: int = 2000) -> tuple[float, float]:
    """95 % interval of the interquartile mean over seeds, by drawing them anew (percentiles)."""
    rng = np.random.default_rng(0)
    means = [interquartile_mean(rng.choice(values, len(values))) for _ in range(draws)]
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def add(folders: Iterable[Path]) -> None:
    """Copy what is committed of runs; of each id and learner the policy of the seed whose last evaluation on the way was best."""
    for folder in folders:
        if not (folder / "evaluation.json").is_file():
            raise ValueError(f"{str(folder)!r} holds no finished run, it lacks evaluation.json: finish it with --resume {folder}")
        target = RUNS / folder.resolve().name
        target.mkdir(parents=True, exist_ok=True)
        for name in KEPT:
            shutil.copyfile(folder / name, target / name)
        if (folder / POLICY).exists():
            shutil.copyfile(folder / POLICY, target / POLICY)
    choose()


def choose() -> None:
    """Of each id and learner the policy of the seed that was best on the episodes for choosing; the others are not kept."""
    from clothgym import policies

    for path in sorted(RUNS.glob(f"*/{POLICY}")):
        about = policies.read(path).about
        kept = COMMITTED / f"{about['env']}_{about['learner']}.npz"
        other = policies.read(kept).about if kept.exists() else about
        # one of the same seed, or of other code, is not compared with, but replaced
        if other["chosen_by"] <= about["chosen_by"] or other["seed"] == about["seed"] or other["digest"] != about["digest"]:
            shutil.copyfile(path, kept)
        path.unlink()


# --- tables -------------------------------------------------------------------------------------------------------------------


def _old(present: bool) -> str:
    return "" if present else " **(old)**"


def _counts(rows: list[Result]) -> str:
    return " / ".join(str(sum(row[name] for row in rows)) for name in ("torn", "diverged"))


def _minutes(rows: list[Result]) -> float:
    """Time of all cores together: runs take turns with other work on their machine, and these minutes do not count that."""
    return statistics.median(row["core_seconds"] for row in rows) / 60


def _collecting(rows: list[Result]) -> str:
    """The part of the time in which environments step and the policy acts; of a clone, whose expert acts, nothing is said."""
    parts = [row.get("collecting_seconds", 0.0) / max(row["training_seconds"], 1e-9) for row in rows]
    return f", {statistics.median(parts):.0%} collecting" if all(parts) else ""


def scripted_row(row: Result, digests: dict[str, str]) -> dict[str, str]:
    """What a table says of doing nothing, chance, or the expert."""
    low, high = row["success_rate_ci95"]
    return {
        "policy": f"`{row['policy']}`{_old(is_present(row, digests))}",
        "seeds": "",
        "success": f"{row['success_rate']:.3f} [{low:.3f}, {high:.3f}]",
        "median": "",
        "worst": "",
        "performance": f"{row['normalized_performance']:.3f}",
        "cost": f"{row['cost']:.2f}" if row.get("cost") is not None else "",
        "safe": f"{row['safe_success_rate']:.3f}" if row.get("cost") is not None else "",
        "torn / diverged": _counts([row]),
        "steps": "",
        "training": "",
    }


def learned_row(label: str, rows: list[Result], digests: dict[str, str]) -> dict[str, str]:
    """What a table says of a learner, over its seeds."""
    rates = [row["success_rate"] for row in rows]
    low, high = bootstrap(rates) if len(rows) > 1 else rows[0]["success_rate_ci95"]
    steps = statistics.median(row["timesteps"] for row in rows)
    return {
        "policy": f"{label}{_old(all(is_present(row, digests) for row in rows))}",
        "seeds": str(len(rows)),
        "success": f"{interquartile_mean(rates):.3f} [{low:.3f}, {high:.3f}]",
        "median": f"{statistics.median(rates):.3f}" if len(rows) > 1 else "",
        "worst": f"{min(rates):.3f}" if len(rows) > 1 else "",
        "performance": f"{statistics.median(row['normalized_performance'] for row in rows):.3f}",
        "cost": f"{statistics.median(row['cost'] for row in rows):.2f}" if "cost" in rows[0] else "",
        "safe": f"{statistics.median(row['safe_success_rate'] for row in rows):.3f}" if "cost" in rows[0] else "",
        "torn / diverged": _counts(rows),
        # a clone's samples are no steps of its own
        "steps": f"{steps / 1e6:.2f} M" if steps else "",
        "training": f"{_minutes(rows):.1f} min of one core{_collecting(rows)}",
    }


def markdown(rows: list[dict[str, str]]) -> str:
    """A table; columns in which nothing stands are left out."""
    columns = [name for name in rows[0] if any(row[name] for row in rows)]
    lines = [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]
    return "\n".join([*lines, *(f"| {' | '.join(row[name] for name in columns)} |" for row in rows)])


def table_of(env_id: str, results: list[Result], scripted: list[Result], digests: dict[str, str]) -> str:
    """The scores of one environment: scripted policies, and what was learned."""
    order = {"noop": 0, "random": 1, "careless": 2, "expert": 3}
    own = [row for row in scripted if row["env"] == env_id and row["policy"] in order and not row["env_kwargs"]]
    rows = [scripted_row(row, digests) for row in sorted(own, key=lambda row: order[row["policy"]])]
    rows += [learned_row(label, group, digests) for (env, label), group in groups(results).items() if env == env_id]
    return markdown(rows) if rows else "None yet."


def best_of(env_id: str, results: list[Result], digests: dict[str, str]) -> str:
    """How an environment is learned best, in a few words; where steps cost, only a success at none counts."""
    found = [(label, rows) for (env, label), rows in groups(results).items() if env == env_id]
    if not found:
        return "–"
    means = [interquartile_mean(row.get("safe_success_rate", row["success_rate"]) for row in rows) for _, rows in found]
    success, (label, rows) = max(zip(means, found), key=lambda one: one[0])
    old = _old(all(is_present(row, digests) for row in rows))
    at = " at no cost" if "safe_success_rate" in rows[0] else ""
    return f"{label}: {success:.2f}{at} in {max(_minutes(rows), 1):.0f} min{old}"


def maximizers_table(rows: list[Result], scripted: list[Result], digests: dict[str, str]) -> str:
    """What a planner has found on whole episodes, beside the scripted experts."""
    experts = {row["env"]: row for row in scripted if row["policy"] == "expert" and not row["env_kwargs"]}
    found = []
    for row in sorted(rows, key=lambda row: (list(ENVIRONMENTS).index(row["env"]), row["policy"])):
        begun = "the expert" if row["policy"] == "cem from expert" else "nothing"
        found.append({
            "environment": f"`{row['env']}`{_old(is_present(row, digests))}", "from": begun,
            "success": f"{round(row['success_rate'] * row['episodes'])} of {row['episodes']}",
            "performance": f"{row['normalized_performance']:.3f}", "return": f"{row['return']:.3f}",
            "steps of the model": f"{row['model_steps']:,}", "minutes": f"{row['seconds'] / 60:.1f}",
            "expert's performance": f"{experts[row['env']]['normalized_performance']:.3f}",
            "its success": f"{experts[row['env']]['success_rate']:.3f}",
        })  # fmt: skip
    return markdown(found)


# --- curves -------------------------------------------------------------------------------------------------------------------


def draw_curves(env_id: str, results: list[Result]) -> bytes | None:
    """Held-out success of every seed over steps and over minutes, and its cost where there is one.

    A color for each learner: a thin line for each seed, a band over all of them, their median bold.  A clone that learns no
    further is a point for each seed.
    """
    found = [(label, rows) for (env, label), rows in groups(results).items() if env == env_id]
    if not found:
        return None
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
    # without the version in it the same curves make the same file; by what is drawn a check knows it
    figure.savefig(picture, dpi=110, metadata={"Software": None, "Comment": drawn_from(env_id, results)})
    plt.close(figure)
    return picture.getvalue()


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


def drawn_from(env_id: str, results: list[Result]) -> str:
    """Digest of what the curves of an environment show."""
    shown = [
        (label, row["run"], progress(row["run"])) for (env, label), rows in groups(results).items() if env == env_id for row in rows
    ]
    return hashlib.sha256(json.dumps(shown, sort_keys=True).encode()).hexdigest()


def stale_curves(results: list[Result]) -> list[Path]:
    """Pictures of curves that are missing, or that show others."""
    from PIL import Image

    stale = []
    for env_id in {row["env"] for row in results}:
        path = CURVES / f"{env_id}.png"
        if not path.exists():
            stale.append(path)
            continue
        with Image.open(path) as picture:
            if picture.info.get("Comment") != drawn_from(env_id, results):
                stale.append(path)
    return sorted(stale)


def progress(run: str) -> list[dict[str, float]]:
    """The evaluations of a committed run on its way."""
    return [json.loads(line) for line in (RUNS / run / "progress.jsonl").read_text().splitlines()]


# --- pages --------------------------------------------------------------------------------------------------------------------


def sections(results: list[Result], scripted: list[Result], digests: dict[str, str]) -> dict[str, str]:
    """The text between ``<!-- NAME -->`` and ``<!-- end -->``, by name."""
    made = {f"scores of {env_id}": table_of(env_id, results, scripted, digests) for env_id in ENVIRONMENTS}
    for name in made:
        if (CURVES / f"{name.split()[-1]}.png").exists():
            made[name] += f"\n\n![Held-out success while learning](curves/{name.split()[-1]}.png)"
    return made | {"environments": environments(results, digests)}


def environments(results: list[Result], digests: dict[str, str]) -> str:
    """The README's table: what there is, and how it is learned."""
    lines = ["| id | goal | learned by: success, time on one core |", "| --- | --- | --- |"]
    for env_id, (_, goal) in ENVIRONMENTS.items():
        if "-Hard-" in env_id:
            continue
        hard = env_id.replace("-v0", "-Hard-v0")
        names = ", ".join(f"[`{name}`](docs/tasks/{name}.md)" for name in (env_id, hard) if name in ENVIRONMENTS)
        lines.append(f"| {names} | {goal.rstrip('.')} | {best_of(env_id, results, digests)} |")
    return "\n".join(lines)


def filled(text: str, made: dict[str, str]) -> str:
    """A page with its sections written anew.

    Raises:
        ValueError: a section that nothing makes.
    """

    def one(match: re.Match[str]) -> str:
        if match[1] not in made:
            raise ValueError(f"no section {match[1]!r} (there are: {', '.join(made)})")
        return f"<!-- {match[1]} -->\n{made[match[1]]}\n<!-- end -->"

    return re.sub(r"<!-- ([\w\- ]+) -->\n.*?\n?<!-- end -->", one, text, flags=re.DOTALL)


def pages() -> dict[Path, str]:
    """Every page as it is to be."""
    digests, scripted = read_digests(), suite.read(SUITE)
    made = sections(learned(), scripted, digests) | {"maximizers": maximizers_table(suite.read(MAXIMIZERS), scripted, digests)}
    return {ROOT / name: filled((ROOT / name).read_text(), made) for name in PAGES}


def note_digests() -> None:
    """Write what each environment does now, as it is and as committed results have it."""
    wanted = {name_of(env_id, {}): (env_id, {}) for env_id in ENVIRONMENTS}
    wanted |= {name_of(row["env"], row["env_kwargs"]): (row["env"], row["env_kwargs"]) for row in learned()}
    digests = {}
    for name, (env_id, kwargs) in wanted.items():
        digests[name] = digest_of(env_id, kwargs)
        print(name, digests[name], flush=True)
    files.write_json(DIGESTS, {"digests": digests})


def main(args: Args) -> None:
    with refused():
        add(args.add)
        if args.digests:
            note_digests()
        if not args.check:
            CURVES.mkdir(exist_ok=True)
            for path in stale_curves(learned()):
                picture = draw_curves(path.stem, learned())
                assert picture is not None
                files.write(path, picture)
        drawings = stale_curves(learned())
        for path in drawings:
            print(f"{path.relative_to(ROOT)}: stale")
        stale = {path: text for path, text in pages().items() if path.read_text() != text}
        for path, text in stale.items():
            print(f"{path.relative_to(ROOT)}: {'stale' if args.check else 'written'}")
            if not args.check:
                files.write(path, text)
    if args.check and (stale or drawings):
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Args))

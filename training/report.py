"""Write every table of scores in the README and in docs/, the figure of all scores, and every learning curve.

    python training/report.py                                # write them again
    python training/report.py --check                        # only list stale pages, with status 1
    python training/report.py --digests                      # first note the present behavior of each environment: some minutes
    python training/report.py --policies                     # first score committed policies of older code: some minutes
    python training/report.py --controls runs/repeat_*       # first add these controls' results
    python training/report.py --add runs/ClothDrape-v0_*     # first add these runs' results, and the best policies

All of them are made of committed results.  A result carries the digest of its environment's behavior (``clothgym.lab.digests``);
the present digests are in benchmarks/results/digests.json.  A row with another digest is marked as old, until it is made again.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import suite
import tyro
from drawing import CURVES, SHOWN, draw_controls, draw_curves, scores_figure
from endings import refused
from results import (
    FROM_SCRATCH,
    LABELS,
    RESULTS,
    ROOT,
    VARIANTS,
    Result,
    add,
    add_controls,
    by_setting,
    controls,
    groups,
    is_present,
    learned,
    note_digests,
    note_policies,
    read_digests,
)
from scoring import wilson

from clothgym import files
from clothgym.registration import ENVIRONMENTS

SUITE, MAXIMIZERS, CHEATS = (RESULTS / f"{name}.json" for name in ("suite", "maximizers", "cheats"))
PAGES = ("README.md", "docs/results.md", "docs/cheats.md", "docs/learning.md")
FIGURE = ROOT / "docs" / "scores.svg"


@dataclass
class Args:
    """Actions before the pages are written."""

    add: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN ...")] = ()
    """Folders of finished runs, whose results are committed."""
    controls: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN ...")] = ()
    """Folders of finished controls, whose results are committed, and whose policies are not."""
    digests: bool = False
    """Note the present behavior of each environment."""
    policies: bool = False
    """Score the committed policies of older code on the present code."""
    check: bool = False
    """Write nothing; list stale pages."""


# --- over seeds ---------------------------------------------------------------------------------------------------------------


def interquartile_mean(values: Iterable[float]) -> float:
    """Mean without the lowest and the highest quarter, as in rliable (Agarwal et al. 2021); the plain mean of three values."""
    from scipy.stats import trim_mean

    return float(trim_mean(list(values), 0.25))


def bootstrap(values: list[float], draws: int = 2000) -> tuple[float, float]:
    """95 % interval of the interquartile mean over seeds, by the percentile bootstrap."""
    from scipy.stats import trim_mean

    drawn = np.random.default_rng(0).choice(values, (draws, len(values)))
    low, high = np.percentile(trim_mean(drawn, 0.25, axis=1), [2.5, 97.5])
    return float(low), float(high)


# --- tables -------------------------------------------------------------------------------------------------------------------


def _old(present: bool) -> str:
    return "" if present else " **(old)**"


def _counts(rows: list[Result]) -> str:
    return " / ".join(str(sum(row[name] for row in rows)) for name in ("torn", "diverged"))


def _minutes(rows: list[Result]) -> float:
    """Median CPU time of the runs: unlike wall time, it does not include other work on the machine."""
    return statistics.median(row["core_seconds"] for row in rows) / 60


def _collecting(rows: list[Result]) -> str:
    """Share of the time in which environments step and the policy acts; empty for behavior cloning, where the expert acts."""
    parts = [row.get("collecting_seconds", 0.0) / max(row["training_seconds"], 1e-9) for row in rows]
    return f", {statistics.median(parts):.0%} collecting" if all(parts) else ""


def scripted_row(row: Result, digests: dict[str, str]) -> dict[str, str]:
    """The table's row for no action, random actions, or the expert."""
    low, high = row["success_rate_ci95"]
    return {
        "policy": f"`{row['policy']}`{_old(is_present(row, digests))}",
        "seeds": "",
        "success": f"{row['success_rate']:.3f} [{low:.3f}, {high:.3f}]",
        "with noise": "",
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
    """The table's row for a learner, over its seeds."""
    rates = [row["success_rate"] for row in rows]
    low, high = bootstrap(rates) if len(rows) > 1 else rows[0]["success_rate_ci95"]
    steps = statistics.median(row["timesteps"] for row in rows)
    return {
        "policy": f"{label}{_old(all(is_present(row, digests) for row in rows))}",
        "seeds": str(len(rows)),
        "success": f"{interquartile_mean(rates):.3f} [{low:.3f}, {high:.3f}]",
        "with noise": f"{statistics.median(row['with_noise']['success_rate'] for row in rows):.3f}"
        if "with_noise" in rows[0]
        else "",
        "median": f"{statistics.median(rates):.3f}" if len(rows) > 1 else "",
        "worst": f"{min(rates):.3f}" if len(rows) > 1 else "",
        "performance": f"{statistics.median(row['normalized_performance'] for row in rows):.3f}",
        "cost": f"{statistics.median(row['cost'] for row in rows):.2f}" if "cost" in rows[0] else "",
        "safe": f"{statistics.median(row['safe_success_rate'] for row in rows):.3f}" if "cost" in rows[0] else "",
        "torn / diverged": _counts(rows),
        # samples of behavior cloning are no steps of the learner
        "steps": f"{steps / 1e6:.2f} M" if steps else "",
        "training": f"{_minutes(rows):.1f} min of one core{_collecting(rows)}",
    }


def markdown(rows: list[dict[str, str]]) -> str:
    """A table without its empty columns."""
    if not rows:
        return "None yet."
    columns = [name for name in rows[0] if any(row[name] for row in rows)]
    lines = [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]
    return "\n".join([*lines, *(f"| {' | '.join(row[name] for name in columns)} |" for row in rows)])


def table_of(env_id: str, results: list[Result], scripted: list[Result], digests: dict[str, str]) -> str:
    """The scores of one environment: scripted and learned policies."""
    order = {"noop": 0, "random": 1, "careless": 2, "expert": 3}
    own = [row for row in scripted if row["env"] == env_id and row["policy"] in order and not row["env_kwargs"]]
    rows = [scripted_row(row, digests) for row in sorted(own, key=lambda row: order[row["policy"]])]
    rows += [learned_row(label, group, digests) for (env, label), group in groups(results).items() if env == env_id]
    return markdown(rows)


def _rates(rows: list[Result]) -> list[float]:
    """Success of each seed; with a cost, only a success at no cost counts."""
    return [row.get("safe_success_rate", row["success_rate"]) for row in rows]


def best_rows(
    env_id: str, results: list[Result], digests: dict[str, str], learners: Iterable[str]
) -> tuple[str, list[Result]] | None:
    """The label and the seeds of the best of some learners on the id's own task; present results, then states, go first."""
    found = [
        (label, rows)
        for (env, label), rows in groups(results).items()
        if env == env_id and rows[0]["learner"] in learners and not VARIANTS & rows[0]["env_kwargs"].keys()
    ]
    rank = {
        label: (
            all(is_present(row, digests) for row in rows),
            "obs_mode" not in rows[0]["env_kwargs"],
            interquartile_mean(_rates(rows)),
        )
        for label, rows in found
    }
    return max(found, key=lambda one: rank[one[0]], default=None)


def best_of(env_id: str, results: list[Result], digests: dict[str, str], from_scratch: bool) -> str:
    """The best learner of an environment, with its success, that of its worst seed, and its time.

    from_scratch: of those that see no expert, or else of those that do.
    """
    best = best_rows(env_id, results, digests, [name for name in LABELS if (name in FROM_SCRATCH) == from_scratch])
    if best is None:
        return "–"
    label, rows = best
    at = " at no cost" if "safe_success_rate" in rows[0] else ""
    old = _old(all(is_present(row, digests) for row in rows))
    worst = f" (worst of {len(rows)} seeds: {min(_rates(rows)):.2f})" if len(rows) > 1 else ""
    return f"{label}: {interquartile_mean(_rates(rows)):.2f}{at}{worst} in {max(_minutes(rows), 1):.0f} min{old}"


def scores_of(env_id: str, results: list[Result], scripted: list[Result], digests: dict[str, str]) -> list[dict[str, Any]]:
    """What the figure shows of one environment, one entry for each policy of ``SHOWN`` that has a result."""
    own = {row["policy"]: [row] for row in scripted if row["env"] == env_id and not row["env_kwargs"]}
    learners = {"bc": ("bc",), "scratch": FROM_SCRATCH}
    best = {name: best_rows(env_id, results, digests, some) for name, some in learners.items()}
    rows_of = own | {name: found[1] for name, found in best.items() if found}
    scores = []
    for name in [name for name in SHOWN if name in rows_of]:
        rows, rates, trials = rows_of[name], _rates(rows_of[name]), rows_of[name][0]["episodes"]
        interval = bootstrap(rates) if len(rows) > 1 else wilson(round(rates[0] * trials), trials)
        present = all(is_present(row, digests) for row in rows)
        scores.append({"env": env_id, "policy": name, "success": (interquartile_mean(rates), *interval), "present": present})
    return scores


def maximizers_table(rows: list[Result], scripted: list[Result], digests: dict[str, str]) -> str:
    """Scores of plans of whole episodes, and of the scripted experts."""
    experts = {row["env"]: row for row in scripted if row["policy"] == "expert" and not row["env_kwargs"]}
    found = []
    for row in sorted(rows, key=lambda row: (list(ENVIRONMENTS).index(row["env"]), row["policy"])):
        begun = "the expert" if row["policy"] == "cem from expert" else "no action"
        found.append({
            "environment": f"`{row['env']}`{_old(is_present(row, digests))}", "from": begun,
            "success": f"{round(row['success_rate'] * row['episodes'])} of {row['episodes']}",
            "performance": f"{row['normalized_performance']:.3f}", "return": f"{row['return']:.3f}",
            "steps of the model": f"{row['model_steps']:,}", "minutes": f"{row['seconds'] / 60:.1f}",
            "expert's performance": f"{experts[row['env']]['normalized_performance']:.3f}",
            "its success": f"{experts[row['env']]['success_rate']:.3f}",
        })  # fmt: skip
    return markdown(found)


def cheats_table(rows: list[Result], digests: dict[str, str]) -> str:
    """Scores of the cheats."""
    return markdown([
        {
            "environment": f"`{row['env']}`{_old(is_present(row, digests))}", "cheat": row["cheat"],
            "success": f"{row['success']:.2f}", "performance": f"{row['performance']:.3f}", "return": f"{row['return']:.3f}",
            "failed": f"{row['failed']:.2f}", "cost": f"{row['cost']:.1f}" if "cost" in row else "",
        }
        for row in rows
    ])  # fmt: skip


def controls_table(rows: list[Result], digests: dict[str, str]) -> str:
    """Scores of SAC with one thing changed, over seeds."""
    return markdown([
        {
            "environment": f"`{setting.env}`{_old(all(is_present(row, digests) for row in group))}",
            "control steps": f"{setting.timesteps / 1e6:.2f} M", "`action_repeat`": str(setting.action_repeat),
            "batch": str(setting.batch), "updates": str(setting.updates), "discount": f"{setting.discount:.3g}",
            "normalized": "yes" if setting.normalized else "no", "`frame`": setting.frame, "critics": str(setting.critics),
            "shaping": "sum" if setting.shaping == 1 else "discounted",
            "seeds": str(len(group)), "success": f"{interquartile_mean(row['success_rate'] for row in group):.3f}",
            "with noise": f"{interquartile_mean(row['with_noise']['success_rate'] for row in group):.3f}",
            "performance": f"{interquartile_mean(row['normalized_performance'] for row in group):.3f}",
            "training": f"{_minutes(group):.1f} min{_collecting(group)}",
        }
        for setting, group in by_setting(rows).items()
    ])  # fmt: skip


# --- pages --------------------------------------------------------------------------------------------------------------------


def sections(results: list[Result], scripted: list[Result], digests: dict[str, str]) -> dict[str, str]:
    """The text between ``<!-- NAME -->`` and ``<!-- end -->``, by name."""
    made = {f"scores of {env_id}": table_of(env_id, results, scripted, digests) for env_id in ENVIRONMENTS}
    for name in made:
        if (CURVES / f"{name.split()[-1]}.png").exists():
            made[name] += f"\n\n![Held-out success while learning](curves/{name.split()[-1]}.png)"
    return made | {"environments": environments(results, digests)}


def environments(results: list[Result], digests: dict[str, str]) -> str:
    """The README's table of environments, with the best learners of each: without an expert, and with one."""
    lines = ["| id | goal | learned from scratch: success, time on one core | with an expert |", "| --- | --- | --- | --- |"]
    for env_id, (_, goal) in ENVIRONMENTS.items():
        if "-Hard-" in env_id:
            continue
        hard = env_id.replace("-v0", "-Hard-v0")
        names = ", ".join(f"[`{name}`](docs/tasks/{name}.md)" for name in (env_id, hard) if name in ENVIRONMENTS)
        scratch, expert = (best_of(env_id, results, digests, from_scratch) for from_scratch in (True, False))
        lines.append(f"| {names} | {goal.rstrip('.')} | {scratch} | {expert} |")
    return "\n".join(lines)


def filled(text: str, made: dict[str, str]) -> str:
    """A page with its sections replaced.

    Raises:
        ValueError: an unknown section.
    """

    def one(match: re.Match[str]) -> str:
        if match[1] not in made:
            raise ValueError(f"no section {match[1]!r} (there are: {', '.join(made)})")
        return f"<!-- {match[1]} -->\n{made[match[1]]}\n<!-- end -->"

    return re.sub(r"<!-- ([\w\- ]+) -->\n.*?\n?<!-- end -->", one, text, flags=re.DOTALL)


def pages() -> dict[Path, str]:
    """The up-to-date text of every page, and of the figure."""
    digests, scripted, results = read_digests(), suite.read(SUITE), learned()
    made = sections(results, scripted, digests) | {"maximizers": maximizers_table(suite.read(MAXIMIZERS), scripted, digests)}
    made["controls"] = controls_table(controls(), digests)
    made["cheats"] = cheats_table(suite.read(CHEATS), digests)
    shown = [scores_of(env_id, results, scripted, digests) for env_id in ENVIRONMENTS if "-Hard-" not in env_id]
    figure = scores_figure([scores for scores in shown if scores])
    return {ROOT / name: filled((ROOT / name).read_text(), made) for name in PAGES} | {FIGURE: figure}


def main(args: Args) -> None:
    with refused():
        for env_id in add(args.add):
            draw_curves(env_id, learned())
        if args.controls:
            add_controls(args.controls)
            draw_controls(controls())
        if args.digests:
            note_digests()
        if args.policies:
            note_policies()
        stale = {path: text for path, text in pages().items() if path.read_text() != text}
        for path, text in stale.items():
            print(f"{path.relative_to(ROOT)}: {'stale' if args.check else 'written'}")
            if not args.check:
                files.write(path, text)
    if args.check and stale:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Args))

"""Committed results of training: the score of each run, the digest of its code, and the kept policies.

A result carries the digest of its environment's behavior (``clothgym.lab.digests``); the present digests are in
benchmarks/results/digests.json.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scoring import HELD_OUT

from clothgym import files
from clothgym.adapters.runs import POLICY, read_config
from clothgym.lab.bench import machine
from clothgym.lab.digests import WITHOUT_EFFECT, digest_of, name_of
from clothgym.registration import ENVIRONMENTS

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
CONTROLS = RESULTS / "controls"  # runs with one thing changed, of which no policy is kept
RUNS, DIGESTS, TODAY = RESULTS / "training", RESULTS / "digests.json", RESULTS / "policies.json"
COMMITTED = ROOT / "clothgym" / "policies"
KEPT = ("config.json", "evaluation.json", "progress.jsonl")
ADVICE = "make it with  python training/report.py --digests"
LABELS = {
    "ppo": "PPO", "ppo_penalty": "PPO, fixed price", "ppo_lagrange": "PPO, Lagrange multiplier", "bc": "behavior cloning",
    "bc_ppo": "behavior cloning, then PPO", "sac_scratch": "SAC", "sac": "SAC, started with expert episodes",
    "her": "SAC with hindsight (HER), started with expert episodes",
}  # fmt: skip
VARIANTS = {"fold", "garment", "sizes"}  # arguments that make another task of an id
FROM_SCRATCH = ("ppo", "ppo_penalty", "ppo_lagrange", "sac_scratch")  # learners that see no expert
Result = dict[str, Any]


def read_digests(path: Path = DIGESTS) -> dict[str, str]:
    """Digest of each environment's present behavior, by ``digests.name_of``."""
    return files.read_json(path, "list of digests", ADVICE)["digests"]


def is_present(row: Result, digests: dict[str, str]) -> bool:
    """Whether a result is from the present code."""
    return row.get("digest") == digests.get(name_of(row["env"], row["env_kwargs"]), "unknown")


def learned(folder: Path = RUNS) -> list[Result]:
    """The results of all committed runs."""
    return [json.loads(path.read_text()) | {"run": path.parent.name} for path in sorted(folder.glob("*/evaluation.json"))]


def groups(results: Iterable[Result]) -> dict[tuple[str, str], list[Result]]:
    """Results that differ only in their seed, by environment and label of the learner."""
    found: dict[tuple[str, str], list[Result]] = {}
    for one in results:
        more = {name: value for name, value in one["env_kwargs"].items() if name not in WITHOUT_EFFECT}
        if "started_from" in one:
            more["starts_from"] = one["started_from"]["env"]
        if "feels" in one:
            more["feels"] = ", ".join(one["feels"])
        label = ", ".join([LABELS[one["learner"]], *(f"`{name}={value!r}`" for name, value in more.items())])
        found.setdefault((one["env"], label), []).append(one)
    return found


def progress(run: str) -> list[dict[str, float]]:
    """The evaluations of a committed run during training."""
    return [json.loads(line) for line in (RUNS / run / "progress.jsonl").read_text().splitlines()]


def note_digests() -> None:
    """Write the digest of each environment, with its defaults and with the arguments of committed results."""
    wanted = {name_of(env_id, {}): (env_id, {}) for env_id in ENVIRONMENTS}
    wanted |= {name_of(row["env"], row["env_kwargs"]): (row["env"], row["env_kwargs"]) for row in [*learned(), *controls()]}
    digests = {}
    for name, (env_id, kwargs) in wanted.items():
        digests[name] = digest_of(env_id, kwargs)
        print(name, digests[name], flush=True)
    files.write_json(DIGESTS, {"digests": digests})


def first_successes(env_id: str, learner: str) -> int:
    """Number of successes of a committed policy in the first hundred held-out episodes, on the present code."""
    from clothgym import policies

    policy = policies.load(env_id, learner)
    env = policy.make_vec(100, autoreset_mode="Disabled")
    seen, _ = env.reset(seed=HELD_OUT)
    over = np.zeros(100, bool)
    while not over.all():
        seen, _, over, _, info = env.step(policy(seen))
    return int(info["is_success"].sum())


def note_policies() -> None:
    """Score committed policies of older code on the present code."""
    from clothgym import policies

    digests, noted = read_digests(), {}
    for env_id, learners in policies.available().items():
        for learner in learners:
            about = policies.load(env_id, learner).about
            if not is_present(about, digests):
                digest = digests[name_of(env_id, about["env_kwargs"])]
                noted[f"{env_id} {learner}"] = {"digest": digest, "first_successes": first_successes(env_id, learner)}
                print(env_id, learner, noted[f"{env_id} {learner}"], "then", about["first_successes"], flush=True)
    files.write_json(TODAY, {"machine": machine(), "policies": noted})


def controls() -> list[Result]:
    """The results of controls, and of the runs that they are compared with, with their hyperparameters."""
    folders = [path.parent for path in sorted(CONTROLS.glob("*/evaluation.json"))]
    envs = {read_config(folder, begun=False)["env"] for folder in folders}
    folders += [folder for env_id in sorted(envs) for folder in sorted(RUNS.glob(f"{env_id}_sac_scratch_*"))]
    return [
        json.loads((folder / "evaluation.json").read_text())
        | {"hyperparameters": read_config(folder, begun=False)["hyperparameters"]}
        for folder in folders
    ]


class Setting(NamedTuple):
    """By what runs of SAC differ, whose scores a control compares; shaping: the environment's ``gamma``."""

    env: str
    timesteps: int
    action_repeat: int
    batch: int
    updates: int
    discount: float
    normalized: bool
    frame: str
    critics: int
    shaping: float

    def said(self, usual: Setting) -> str:
        """What differs from the usual setting; updates and discount follow the action repeat and the batch."""
        if self == usual:
            return "usual"
        follow = {"env", "timesteps"} | ({"updates", "discount"} if self[2:4] != usual[2:4] else set())
        changes = {name: value for name, value in self._asdict().items() if name not in follow and value != getattr(usual, name)}
        words = {"normalized": "normalized" if self.normalized else "not normalized", "shaping": "discounted shaping"}
        return ", ".join(words.get(name, f"{name.replace('_', ' ')} {value}") for name, value in changes.items())


def by_setting(rows: Iterable[Result]) -> dict[Setting, list[Result]]:
    """Results of controls that differ only in their seed."""
    found: dict[Setting, list[Result]] = {}
    for row in rows:
        options, kwargs = row["hyperparameters"], row["env_kwargs"]
        setting = Setting(
            row["env"], row["timesteps"], kwargs.get("action_repeat", 1), options["n_envs"], options["updates"], options["gamma"],
            options["normalize"], kwargs.get("frame", "world"), options.get("critics", 2), kwargs.get("gamma", 1.0),
        )  # fmt: skip
        found.setdefault(setting, []).append(row)
    return dict(sorted(found.items()))


def add_controls(folders: Iterable[Path]) -> None:
    """Copy the committed files of controls."""
    for folder in folders:
        target = CONTROLS / folder.resolve().name
        target.mkdir(parents=True, exist_ok=True)
        for name in KEPT:
            shutil.copyfile(folder / name, target / name)


def add(folders: Iterable[Path]) -> set[str]:
    """Copy the committed files of runs, and keep their best policies (``choose``); returns the ids of the runs."""
    ids = set()
    for folder in folders:
        if not (folder / "evaluation.json").is_file():
            raise ValueError(f"{str(folder)!r} holds no finished run, it lacks evaluation.json: finish it with --resume {folder}")
        target = RUNS / folder.resolve().name
        target.mkdir(parents=True, exist_ok=True)
        for name in KEPT:
            shutil.copyfile(folder / name, target / name)
        if (folder / POLICY).exists():
            shutil.copyfile(folder / POLICY, target / POLICY)
        ids.add(json.loads((target / "evaluation.json").read_text())["env"])
    choose()
    return ids


def choose() -> None:
    """Keep the best policy of each id and learner, by its score on the episodes for choosing; delete the others."""
    from clothgym import policies

    for path in sorted(RUNS.glob(f"*/{POLICY}")):
        about = policies.read(path).about
        if not about["chosen_by"] or VARIANTS & about["env_kwargs"].keys():
            # a policy that never succeeds is not kept, nor one of a variant of the task
            path.unlink()
            continue
        kept = COMMITTED / f"{about['env']}_{about['learner']}.npz"
        other = policies.read(kept).about if kept.exists() else about
        # a policy of the same seed, or of other code, is replaced without a comparison
        if other["chosen_by"] <= about["chosen_by"] or other["seed"] == about["seed"] or other["digest"] != about["digest"]:
            shutil.copyfile(path, kept)
        path.unlink()

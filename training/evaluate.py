"""Score policies on held-out episodes: one table for noop, random, the scripted expert and what was learned.

    python training/evaluate.py --env ClothDrape-v0 --policy noop random expert runs/ClothDrape-v0_0 --episodes 500

Episode ``i`` is the one that seed ``seed + i`` gives, for every policy.  Training never uses seeds of a million or more.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import policies
import tyro
from endings import refused, stopped
from numpy.typing import NDArray
from tqdm import tqdm

from clothgym import files
from clothgym.registration import checked_id

HELD_OUT = 1_000_000
BATCH = 250


@dataclass
class Args:
    """What to score, and on what."""

    env: str = "ClothDrape-v0"
    """Id of the environment."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="{noop,random,expert,careless,PATH} ...")] = (
        "noop",
        "random",
        "expert",
    )
    """Policies: noop, random, expert, careless (of ClothStrain-v0), or the path of a run's folder."""
    episodes: int = 500
    """Episodes for each policy."""
    seed: int = HELD_OUT
    """Seed of the first episode."""
    env_kwargs: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"substeps": 100}'; a run's own otherwise."""
    json: Path | None = None
    """Where to write the scores, if anywhere."""

    def __post_init__(self) -> None:
        """Everything is checked here, before torch is imported; errors look like those of a wrong flag."""
        self.env = checked_id(self.env)
        if self.episodes < 1:
            raise ValueError(f"--episodes {self.episodes}: must be at least 1")
        if self.seed < 0:
            raise ValueError(f"--seed {self.seed}: must be zero or positive")
        if self.json is not None and self.json.is_dir():
            raise ValueError(f"--json {self.json}: is a folder, name a file in it")
        policies.parsed_kwargs(self.env_kwargs)
        for name in self.policy:
            policies.checked(name, self.env)


def run_episodes(
    env_id: str, policy: policies.Policy, seeds: list[int], progress: bool = True, **env_kwargs: Any
) -> dict[str, NDArray]:
    """One episode for each seed: return, length and what the last step's info says, arrays over the episodes."""
    env = gym.make_vec(env_id, num_envs=min(BATCH, len(seeds)), autoreset_mode="Disabled", **env_kwargs)
    batches = []
    with tqdm(total=len(seeds), unit="episode", disable=None if progress else True, leave=False) as bar:
        for first in range(0, len(seeds), env.num_envs):
            wanted = seeds[first : first + env.num_envs]
            # the last batch may be short: its spare environments run too, and are not counted
            padded = wanted + wanted[-1:] * (env.num_envs - len(wanted))
            episodes = _run_batch(env, policy, padded, bar, len(wanted))
            batches.append({key: value[: len(wanted)] for key, value in episodes.items()})
    env.close()
    return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}


def _run_batch(env: Any, policy: policies.Policy, seeds: list[int], bar: Any, count: int) -> dict[str, NDArray]:
    observations, _ = env.reset(seed=seeds)
    running = np.ones(env.num_envs, bool)
    total, length = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
    last: dict[str, NDArray] = {}
    while running.any():
        observations, reward, terminated, truncated, info = env.step(policy(env, observations))
        total += reward * running
        length += running
        done = running & (terminated | truncated)
        for key, value in info.items():
            if not key.startswith("_") and isinstance(value, np.ndarray):
                last[key] = np.where(done, value, last.get(key, value))
        running &= ~done
        bar.update(int(done[:count].sum()))
    return last | {"return": total, "length": length}


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """95 % confidence interval of a proportion (Wilson 1927)."""
    p = successes / trials
    middle = (p + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def score(episodes: dict[str, NDArray]) -> dict[str, Any]:
    """The row of the table: rates and means with their 95 % intervals, and the cumulated failures."""
    from clothgym.envs.episode import FAILURES  # imported here: flags are checked before numba is loaded

    count = len(episodes["return"])
    successes = int(episodes["is_success"].sum())
    row: dict[str, Any] = {"episodes": count, "success_rate": successes / count, "success_rate_ci95": wilson(successes, count)}
    for key in ("normalized_performance", "return"):
        values = episodes[key].astype(float)
        half = 1.96 * values.std(ddof=1) / math.sqrt(count) if count > 1 else math.nan
        row[key], row[f"{key}_ci95"] = values.mean(), (values.mean() - half, values.mean() + half)
    if "episode_cost" in episodes:
        costs = episodes["episode_cost"].astype(float)
        half = 1.96 * costs.std(ddof=1) / math.sqrt(count) if count > 1 else math.nan
        row["cost"], row["cost_ci95"] = costs.mean(), (costs.mean() - half, costs.mean() + half)
        row["safe_success_rate"] = float(episodes["is_safe_success"].mean())
    for code, failure in enumerate(FAILURES[1:], 1):
        row[failure] = int((episodes["failure"] == code).sum())
    row["mean_length"] = float(episodes["length"].mean())
    return row


def table(scores: dict[str, dict[str, Any]]) -> str:
    """The scores as text, one policy a line."""
    costly = any("cost" in row for row in scores.values())
    more = f" {'cost':>15} {'safe':>6}" if costly else ""
    rates, counts = f"{'success':>22} {'performance':>16} {'return':>16}", f"{'torn':>6} {'diverged':>9} {'steps':>6}"
    lines = [f"{'policy':<28} {'episodes':>8} {rates} {counts}{more}"]
    for name, row in scores.items():
        low, high = row["success_rate_ci95"]
        spread = [(row[f"{key}_ci95"][1] - row[f"{key}_ci95"][0]) / 2 for key in ("normalized_performance", "return")]
        lines.append(
            f"{name:<28} {row['episodes']:8d} {row['success_rate']:6.3f} [{low:.3f}, {high:.3f}] "
            f"{row['normalized_performance']:8.3f} ± {spread[0]:.3f} {row['return']:8.3f} ± {spread[1]:.3f} "
            f"{row['torn']:6d} {row['diverged']:9d} {row['mean_length']:6.1f}"
        )
        if costly:
            half = (row["cost_ci95"][1] - row["cost_ci95"][0]) / 2
            lines[-1] += f" {row['cost']:7.2f} ± {half:5.2f} {row['safe_success_rate']:6.3f}"
    return "\n".join(lines)


def write_json(path: Path, content: Any) -> None:
    """Write a file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, json.dumps(content, indent=1, default=float) + "\n")


def main(args: Args) -> None:
    scores = {}
    # a run is scored on the environment that it was trained on, and so are the references beside it
    kwargs: dict[str, Any] = {}
    for name in args.policy:
        kwargs |= policies.env_kwargs(name)
    kwargs |= policies.parsed_kwargs(args.env_kwargs)
    # what the environment or a checkpoint does not take is reported before anything runs
    with refused():
        chosen = {name: policies.named(name, args.env, args.seed) for name in args.policy}
        gym.make_vec(args.env, num_envs=1, **kwargs).close()
    for name, policy in chosen.items():
        episodes = run_episodes(args.env, policy, list(range(args.seed, args.seed + args.episodes)), **kwargs)
        scores[name] = {"policy": name, "env": args.env, "seed": args.seed} | score(episodes)
    given = f", {json.dumps(kwargs)}" if kwargs else ""
    print(f"{args.env}{given}, episodes from seed {args.seed}\n{table(scores)}")
    if args.json is not None:
        write_json(args.json, scores[args.policy[0]] if len(scores) == 1 else scores)
        print(f"written to {args.json}")


if __name__ == "__main__":
    with stopped():
        main(tyro.cli(Args))

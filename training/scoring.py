"""Episodes of a policy from seeds, and their scores: rates and means with 95 % intervals."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from policies import Policy
from tqdm import tqdm

from clothgym.evaluation import FIRST_HELD_OUT

HELD_OUT = FIRST_HELD_OUT
BATCH = 250


def run_episodes(env_id: str, policy: Policy, seeds: list[int], progress: bool = True, **env_kwargs: Any) -> dict[str, NDArray]:
    """One episode for each seed: return, length in control steps and what the last step's info says, arrays over the episodes."""
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


def _run_batch(env: Any, policy: Policy, seeds: list[int], bar: Any, count: int) -> dict[str, NDArray]:
    observations, _ = env.reset(seed=seeds)
    running = np.ones(env.num_envs, bool)
    total, length = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
    last: dict[str, NDArray] = {}
    while running.any():
        observations, reward, terminated, truncated, info = env.step(policy(env, observations))
        total += reward * running
        done = running & (terminated | truncated)
        length = np.where(done, env.unwrapped.task.control_steps_taken(), length)
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


def _mean(row: dict[str, Any], name: str, values: NDArray) -> None:
    """Put the mean of values and its 95 % interval into a row."""
    numbers, count = values.astype(float), len(values)
    half = 1.96 * numbers.std(ddof=1) / math.sqrt(count) if count > 1 else math.nan
    row[name], row[f"{name}_ci95"] = numbers.mean(), (numbers.mean() - half, numbers.mean() + half)


def score(episodes: dict[str, NDArray]) -> dict[str, Any]:
    """The row of a table: rates and means with their 95 % intervals, and the cumulated failures.

    Where a task's info says so: the best score of an episode, how many it was a success at some step of (``ever_success_rate``)
    and at which (``first_success``, the mean over these), and whether that held to the end; costs.
    """
    from clothgym.envs.episode import FAILURES  # imported here: flags are checked before numba is loaded

    count = len(episodes["return"])
    successes = int(episodes["is_success"].sum())
    row: dict[str, Any] = {"episodes": count, "success_rate": successes / count, "success_rate_ci95": wilson(successes, count)}
    for key in ("normalized_performance", "return"):
        _mean(row, key, episodes[key])
    if "success_held" in episodes:
        held = int(episodes["success_held"].astype(bool).sum())
        row["success_held_rate"], row["success_held_rate_ci95"] = held / count, wilson(held, count)
    if "best" in episodes:
        _mean(row, "best", episodes["best"])
    if "first_success" in episodes:
        first = episodes["first_success"]
        row["ever_success_rate"] = float((first >= 0).mean())
        row["first_success"] = float(first[first >= 0].mean()) if (first >= 0).any() else None
    if "episode_cost" in episodes:
        _mean(row, "cost", episodes["episode_cost"])
        row["safe_success_rate"] = float(episodes["is_safe_success"].mean())
    for code, failure in enumerate(FAILURES[1:], 1):
        row[failure] = int((episodes["failure"] == code).sum())
    row["mean_length"] = float(episodes["length"].mean())
    return row

"""Score policies on held-out episodes: one table for noop, random, the scripted expert and what was learned.

    python training/evaluate.py --env ClothDrape-v0 --policy noop random expert runs/ClothDrape-v0_0 --episodes 500
    python training/evaluate.py --suite --json runs/suite.json      # every environment; stopped and called again, it goes on

Episode ``i`` is the one that seed ``seed + i`` gives, for every policy.  Training never uses seeds of a million or more.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import policies
import suite
import tyro
from endings import refused, stopped
from scoring import HELD_OUT, run_episodes, score

from clothgym import files
from clothgym.folders import expand_paths
from clothgym.registration import ENVIRONMENTS, checked_id

__all__ = ["HELD_OUT", "run_episodes", "score"]


@dataclass
class Args:
    """What to score, and on what."""

    env: tuple[str, ...] = ()
    """Ids of the environments; several make a suite.  By default ClothDrape-v0, with --suite all of them."""
    suite: bool = False
    """Every policy on every id that it is for: one table, and one JSON file that keeps the rows that are finished."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="{noop,random,expert,careless,learned,PATH} ...")] = (
        "noop",
        "random",
        "expert",
    )
    """Policies: noop, random, expert, careless (of ClothStrain-v0); learned, the committed one, or learned:LEARNER; or the path of
    a run's folder or of a policy.npz."""
    episodes: int = 500
    """Episodes for each policy."""
    seed: int = HELD_OUT
    """Seed of the first episode."""
    env_kwargs: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"substeps": 100}'; a run's own otherwise."""
    json: Path | None = None
    """Where to write the scores, if anywhere; a suite goes on with those that are there."""
    anew: bool = False
    """Of a suite: score also what is in the file already."""
    threads: int | None = None
    """Threads of the environments, which change no score; all processors by default."""

    def __post_init__(self) -> None:
        """Everything is checked here, before torch is imported; errors look like those of a wrong flag."""
        expand_paths(self)
        self.suite = self.suite or len(self.env) > 1
        self.env = tuple(checked_id(one) for one in self.env or (ENVIRONMENTS if self.suite else ("ClothDrape-v0",)))
        if self.episodes < 1:
            raise ValueError(f"--episodes {self.episodes}: must be at least 1")
        if self.seed < 0:
            raise ValueError(f"--seed {self.seed}: must be zero or positive")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"--threads {self.threads}: must be at least 1")
        if self.json is not None and self.json.is_dir():
            raise ValueError(f"--json {self.json}: is a folder, name a file in it")
        kwargs = policies.parsed_kwargs(self.env_kwargs)
        if self.suite:
            suite.rows_of(self.env, self.policy, self.seed, kwargs)
            return
        if self.anew:
            raise ValueError("--anew: is for --suite; without it everything is scored anew")
        for name in self.policy:
            policies.checked(name, self.env[0])


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
    (score_suite if args.suite else score_one)(args)


def score_suite(args: Args) -> None:
    """All policies on all environments that they are for."""
    wanted = suite.rows_of(args.env, args.policy, args.seed, policies.parsed_kwargs(args.env_kwargs))
    rows = suite.run(wanted, args.episodes, args.json, args.anew, args.threads, say=lambda text: print(text, flush=True))
    print(f"{args.episodes} episodes from seed {args.seed}\n{suite.table(rows)}")
    if args.json is not None:
        print(f"written to {args.json}")


def score_one(args: Args) -> None:
    """Policies on one environment, with the same arguments."""
    scores, env_id = {}, args.env[0]
    # a run is scored on the environment that it was trained on, and so are the references beside it
    kwargs: dict[str, Any] = {}
    for name in args.policy:
        kwargs |= policies.env_kwargs(name, env_id)
    kwargs |= policies.parsed_kwargs(args.env_kwargs)
    threads = {} if args.threads is None else {"threads": args.threads}
    # what the environment or a checkpoint does not take is reported before anything runs
    with refused():
        chosen = {name: policies.named(name, env_id, args.seed) for name in args.policy}
        gym.make_vec(env_id, num_envs=1, **kwargs).close()
    for name, policy in chosen.items():
        seeds = list(range(args.seed, args.seed + args.episodes))
        episodes = run_episodes(env_id, policy, seeds, **(kwargs | threads))
        scores[name] = {"policy": name, "env": env_id, "seed": args.seed} | score(episodes)
    given = f", {json.dumps(kwargs)}" if kwargs else ""
    print(f"{env_id}{given}, episodes from seed {args.seed}\n{table(scores)}")
    if args.json is not None:
        write_json(args.json, scores[args.policy[0]] if len(scores) == 1 else scores)
        print(f"written to {args.json}")


def _how_to_go_on(args: Args) -> str:
    if not args.suite:
        return ""
    return f"; what is finished is in {args.json}, the same command goes on" if args.json else "; without --json nothing is kept"


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: _how_to_go_on(given)):
        main(given)

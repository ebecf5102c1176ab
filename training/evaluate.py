"""Score policies on held-out episodes: one table for noop, random, the scripted expert and what was learned.

    python training/evaluate.py --env ClothDrape-v0 --policy noop random expert runs/ClothDrape-v0_0 --episodes 500
    python training/evaluate.py --suite --json runs/suite.json      # every environment; stopped and called again, it goes on

Episode ``i`` is the one that seed ``seed + i`` gives, for every policy.  Training never uses seeds of a million or more.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import policies
import suite
import tyro
from endings import stopped
from scoring import HELD_OUT

from clothgym import files
from clothgym.folders import expand_paths
from clothgym.registration import ENVIRONMENTS, checked_id


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
    """For a suite: score again the rows that are already in the file."""
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
        if self.json is not None and suite.is_file(self.json):
            raise ValueError(f"--json {self.json}: holds a suite's rows, which would be lost: add --suite, or name another file")
        if self.anew:
            raise ValueError("--anew: is for --suite; without it everything is scored anew")
        for name in self.policy:
            policies.checked(name, self.env[0])


def main(args: Args) -> None:
    given = policies.parsed_kwargs(args.env_kwargs)
    if args.suite:
        wanted = suite.rows_of(args.env, args.policy, args.seed, given)
    else:
        # a run is scored on the environment that it was trained on, and so are the references next to it
        kwargs = {key: value for name in args.policy for key, value in policies.env_kwargs(name, args.env[0]).items()} | given
        row: suite.Row = {"env": args.env[0], "seed": args.seed, "env_kwargs": kwargs, "settings": {}}
        wanted = [row | {"policy": name} for name in args.policy]
    path = args.json if args.suite else None
    rows = suite.run(wanted, args.episodes, path, args.anew, args.threads, say=lambda text: print(text, flush=True))
    print(f"{args.episodes} episodes from seed {args.seed}\n{suite.table(rows)}")
    if args.json is not None:
        if not args.suite:
            scores = rows[0] if len(rows) == 1 else {row["policy"]: row for row in rows}
            args.json.parent.mkdir(parents=True, exist_ok=True)
            files.write(args.json, json.dumps(scores, indent=1, default=float) + "\n")
        print(f"written to {args.json}")


def _how_to_go_on(args: Args) -> str:
    if not args.suite:
        return ""
    return f"; {args.json} has finished rows, the same command continues" if args.json else "; without --json nothing is kept"


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: _how_to_go_on(given)):
        main(given)

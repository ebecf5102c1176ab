"""Digests of what a change of the core's layout, order or speed must not change, one a row.

    python benchmarks/bits.py --json FILE                 # half a minute: every row below
    python benchmarks/bits.py --compare FILE              # and which rows differ from that file's
    python benchmarks/bits.py --select Drape strict       # only rows whose names hold all these words
    python benchmarks/bits.py --batches                   # some minutes: is environment i the same in every batch?

Rows: each id with its expert in every other environment and random actions in the rest, without self-collision and with
"strict", its first 30 steps and 30 steps from the 41st on, when experts' sheets lie on their targets; each integrator with each
bending model on a sheet in the wind, and strain limits; each kind of collider, at rest and moving, under a falling sheet; and
sheets that are folded onto themselves.  A digest is of shapes, types and bytes: it tells -0.0 from 0.0.

With ``--batches`` environment ``i`` of each id is compared over a whole episode and the beginning of the next, in batches of 1, 7,
64 and 256, on one thread and on two, and restored in mid-episode.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from bits_scenes import Row, core
from tqdm import tqdm

from clothgym.lab.bench import machine
from clothgym.lab.digests import Digest
from clothgym.registration import ENVIRONMENTS

ENVS, STEPS, LATER = 20, 30, 40  # environments of an id, steps of a row, and how many go before the later row
BATCHES, BEYOND = (1, 7, 64, 256), 10  # steps of the next episode
VARIANTS: tuple[tuple[str, Row], ...] = (
    ("ClothReach-v0", {"wind": {"gust": 0.5}}),
    ("ClothDrape-v0", {"randomize": {"density": [0.15, 0.2]}, "obs_mode": "particles"}),
    ("ClothDrapeGripper-v0", {"slip_force": 0.3}),
)
RELEASE_ABOVE = 0.81  # random actions are below this, and so lets go in a step of a hundred


# --- environments -------------------------------------------------------------------------------------------------------------


class Episodes:
    """A batch of an id: the expert acts in even environments, odd ones get random actions, and ended episodes are reset."""

    def __init__(self, env_id: str, num_envs: int, threads: int, **kwargs: Any) -> None:
        self.env: Any = gym.make_vec(
            f"clothgym:{env_id}", num_envs=num_envs, autoreset_mode="Disabled", threads=threads, **kwargs
        ).unwrapped
        self.random = [np.random.default_rng([7, i]) for i in range(num_envs)]

    def reset(self, seed: int = 0) -> Row:
        observation, info = self.env.reset(seed=seed)
        return self._brought(observations=observation, infos=info)

    def step(self) -> Row:
        actions = np.array([random.uniform(-1, RELEASE_ABOVE, self.env.single_action_space.shape) for random in self.random])
        actions[::2] = self.env.expert_actions()[::2]
        observation, reward, terminated, truncated, info = self.env.step(actions)
        brought = self._brought(observations=observation, rewards=reward, infos={**info, "ends": terminated | 2 * truncated})
        over = terminated | truncated
        if over.any():
            self.env.reset(options={"reset_mask": over})
        return brought

    def _brought(self, **brought: Any) -> Row:
        simulation = self.env.task.simulation
        return {"positions": simulation.positions, "velocities": simulation.velocities, **brought}


def environments() -> Iterator[tuple[str, str, Row]]:
    """Each id, as it is and strict: name of the row, id, keywords."""
    for env_id in ENVIRONMENTS:
        yield env_id, env_id, {}
        yield f"{env_id} strict", env_id, {"self_collision": "strict"}
    for env_id, kwargs in VARIANTS:
        yield f"{env_id} {kwargs}", env_id, kwargs


def of_an_id(name: str, env_id: str, kwargs: Row) -> dict[str, Row]:
    """Both rows of an id."""
    episodes = Episodes(env_id, ENVS, 1, **kwargs)
    early, late = Digest(), Digest()
    early.add(**episodes.reset())
    for step in range(LATER + STEPS):
        brought = episodes.step()
        if step < STEPS:
            early.add(**brought)
        if step >= LATER:
            late.add(**brought)
    return {f"{name}, from 1": early.row(), f"{name}, from {LATER + 1}": late.row()}


# --- batches ------------------------------------------------------------------------------------------------------------------


def _environment(brought: Any, env: int) -> Any:
    return {key: _environment(value, env) for key, value in brought.items()} if isinstance(brought, dict) else brought[env]


def by_environment(episodes: Episodes, steps: int, count: int) -> list[str]:
    """A digest of what each of the first environments does in so many steps."""
    digests = [Digest() for _ in range(count)]
    for _ in range(steps):
        brought = episodes.step()
        for env, digest in enumerate(digests):
            digest.add(**_environment(brought, env))
    return [digest.row()["digest"] for digest in digests]


def batches(select: list[str]) -> bool:
    """Whether environment i does the same in all batches; prints a row for each."""
    same = True
    for name, env_id, kwargs in environments():
        if not all(word in name for word in select):
            continue
        start = partial(Episodes, env_id, **kwargs)
        task = start(1, 1).env.task
        half = (task.acting_steps + task.settling_steps) // 2
        reference: list[list[str]] = []
        for num_envs, threads in itertools.product(reversed(BATCHES), (1, 2)):
            episodes = start(num_envs, threads)
            episodes.reset()
            found = [by_environment(episodes, steps, num_envs) for steps in (half, half + BEYOND)]
            reference = reference or found
            same &= tell(f"{name}, {num_envs} environments, {threads} threads", found, reference)
        first, second = start(64, 1), start(64, 2)
        first.reset()
        by_environment(first, half, 0)
        second.reset(seed=77)
        second.env.set_state(first.env.get_state())
        second.random = first.random
        same &= tell(f"{name}, restored in mid-episode", [by_environment(second, half + BEYOND, 64)], reference[1:])
    return same


def tell(name: str, found: list[list[str]], reference: list[list[str]]) -> bool:
    """Print whether the environments of a batch behave as in the first run; halves of the run by environment."""
    differ = [[i for i, (a, b) in enumerate(zip(ours, theirs)) if a != b] for ours, theirs in zip(found, reference)]
    brought = "; ".join(f"part {k + 1}: {len(d)} of {len(found[0])} differ, {d[:5]}" for k, d in enumerate(differ) if d)
    print(f"{name:<66} {brought or 'same bits'}", flush=True)
    return not brought


# --- the command --------------------------------------------------------------------------------------------------------------


def differences(now: dict[str, Row], before: dict[str, Row]) -> list[str]:
    """A line for each row that is not the same in both."""
    lines = []
    for name in [*now, *(name for name in before if name not in now)]:
        if name not in now or name not in before:
            lines.append(f"{name}: only {'now' if name in now else 'before'}")
        elif now[name] != before[name]:
            ours, theirs = now[name].get("parts", {}), before[name].get("parts", {})
            parts = [part for part in ours if ours[part] != theirs.get(part)]
            lines.append(f"{name}: {before[name]['digest']} before, {now[name]['digest']} now; {', '.join(parts)}")
    return lines


def rows(select: list[str]) -> dict[str, Row]:
    """All rows whose names hold the words."""
    makers: list[tuple[str, Callable[[], Any]]] = [(case[0], partial(of_an_id, *case)) for case in environments()]
    makers += core()
    chosen = [(name, make) for name, make in makers if all(word in name for word in select)]
    made: dict[str, Row] = {}
    for name, make in (bar := tqdm(chosen, unit="scene", disable=None)):
        bar.set_postfix_str(name)
        row = make()
        made |= {name: row} if "digest" in row else row
    return made


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--select", nargs="*", default=[], metavar="WORD", help="only rows whose names hold all these words")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the digests there too")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="tell which rows differ from those of that file")
    parser.add_argument("--batches", action="store_true", help="compare batches of several sizes instead")
    args = parser.parse_args()
    warnings.simplefilter("ignore")  # of substeps that are too few for accuracy
    if args.batches:
        return 0 if batches(args.select) else 1
    made = rows(args.select)
    for name, row in made.items():
        print(f"{name:<50} {row['digest']}")
    if args.json:
        args.json.write_text(json.dumps({"machine": machine(), "rows": made}, indent=1) + "\n")
    if args.compare:
        before = json.loads(args.compare.read_text())["rows"]
        lines = differences(made, {name: row for name, row in before.items() if not args.select or name in made})
        print(f"\n{len(lines)} of {len(made)} rows differ from {args.compare}" + "".join(f"\n  {line}" for line in lines))
        return int(bool(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Scores of many environments and policies: one JSON file, which keeps finished rows, and one table.

A row is identified by its environment, policy, seed of the first episode, keyword arguments and settings.  The file
has a checksum, the machine and the versions; rows of another machine or other versions are not added.  One process at a time
writes to a file.
"""

from __future__ import annotations

import datetime
import json
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import policies
from endings import refused
from scoring import run_episodes, score

from clothgym import files

Row = dict[str, Any]
ADVICE = "name another file, or remove it"
IDENTITY = ("env", "policy", "seed", "env_kwargs", "settings")


# --- the file -----------------------------------------------------------------------------------------------------------------


def load(path: Path | None) -> list[Row]:
    """The rows that a file holds; none where there is no file.

    Raises:
        ValueError: it is another file, damaged, or of another machine or other versions.
    """
    if path is None or not path.exists():
        return []
    content = files.read_json(path, "file of a suite's scores", ADVICE)
    with files.naming(path, "file of a suite's scores", ADVICE):
        rows = content["rows"]
        if not all(isinstance(row, dict) and set(IDENTITY) <= set(row) for row in rows):
            raise ValueError(f"a row of it lacks one of {', '.join(IDENTITY)}")
        there, here = content["machine"], _machine()
        for name in ("processor", "versions"):
            if there[name] != here[name]:
                raise ValueError(f"its rows are of {there[name]}, this is {here[name]}: they would not be comparable")
    return rows


def read(path: Path) -> list[Row]:
    """The rows of a file, of whatever machine; none where there is no file.

    Raises:
        ValueError: it is another file, or damaged.
    """
    return files.read_json(path, "file of a suite's scores", ADVICE)["rows"] if path.exists() else []


def is_file(path: Path) -> bool:
    """Whether a path is a file of a suite's scores."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "rows" in content


def keep(path: Path | None, row: Row) -> None:
    """Put a row into a file, in the place of one of the same identity."""
    if path is None:
        return
    rows = load(path)
    for i, other in enumerate(rows):
        if is_same(other, row):
            rows[i] = row
            break
    else:
        rows.append(row)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_json(path, {"machine": _machine(), "rows": rows})


def is_same(row: Row, other: Row) -> bool:
    """Whether two rows are of the same thing."""
    return all(row[name] == other[name] for name in IDENTITY)


def found(rows: Iterable[Row], identity: Row) -> Row | None:
    """The row of an identity, if there is one."""
    return next((row for row in rows if is_same(row, identity)), None)


def today() -> str:
    return datetime.date.today().isoformat()


def _machine() -> Row:
    from clothgym.lab.bench import machine  # imported here: flags are checked before numba is loaded

    return machine()


# --- scores -------------------------------------------------------------------------------------------------------------------


def rows_of(ids: Iterable[str], names: Iterable[str], seed: int, env_kwargs: Row) -> list[Row]:
    """The identity of each row: every policy on every id that it is for; a run on its own id and with its own arguments.

    Raises:
        ValueError: a policy is for none of the ids.
    """
    ids, wanted = list(ids), []
    for name in names:
        fitting = [env_id for env_id in ids if policies.is_for(name, env_id)]
        if not fitting:
            raise ValueError(f"policy {name!r} is for none of {', '.join(ids)}: name one that is, or its environment")
        for env_id in fitting:
            kwargs = policies.env_kwargs(name, env_id) | env_kwargs
            wanted.append({"env": env_id, "policy": name, "seed": seed, "env_kwargs": kwargs, "settings": {}})
    return sorted(wanted, key=lambda row: ids.index(row["env"]))


def run(
    wanted: list[Row], episodes: int, path: Path | None, anew: bool, threads: int | None, say: Callable[[str], None]
) -> list[Row]:
    """Score rows that are not in the file yet, or all of them anew; ``say`` is told of each."""
    more = {} if threads is None else {"threads": threads}
    with refused():
        # what a file, an environment or a checkpoint does not take is reported before anything runs
        finished = load(path)
        finished = [] if anew else finished
        chosen = [policies.named(row["policy"], row["env"], row["seed"]) for row in wanted]
        for row in wanted:
            gym.make_vec(row["env"], num_envs=1, **row["env_kwargs"], **more).close()
    from clothgym.lab.digests import digest_of  # imported here: flags are checked before numba is loaded

    rows = []
    for number, (row, policy) in enumerate(zip(wanted, chosen), 1):
        what = f"{number} of {len(wanted)}: {row['env']} {row['policy']}"
        before, digest = found(finished, row), digest_of(row["env"], row["env_kwargs"])
        if before is not None and before["episodes"] == episodes and before.get("digest") == digest:
            rows.append(before)
            say(f"{what}: in the file already")
            continue
        kwargs = row["env_kwargs"] | more
        warm(row["env"], policy, kwargs)
        begun = time.perf_counter()
        result = score(run_episodes(row["env"], policy, list(range(row["seed"], row["seed"] + episodes)), **kwargs))
        rows.append(row | result | {"seconds": time.perf_counter() - begun, "date": today(), "digest": digest})
        keep(path, rows[-1])
        say(f"{what}: score {result['normalized_performance']:.3f}, {rows[-1]['seconds']:.1f} s")
    return rows


def warm(env_id: str, policy: policies.Policy, env_kwargs: Row) -> None:
    """Take a step of one environment: kernels are compiled, and starts made, before a clock runs."""
    env = gym.make_vec(env_id, num_envs=1, autoreset_mode="Disabled", **env_kwargs)
    observations, _ = env.reset(seed=0)
    env.step(policy(env, observations))
    env.close()


# --- the table ----------------------------------------------------------------------------------------------------------------


def _spread(row: Row, name: str) -> str:
    """A mean with half its interval; blank where the task has none."""
    if row.get(name) is None:
        return ""
    low, high = row[f"{name}_ci95"]
    # one episode has no interval
    return f"{row[name]:.3f}" if math.isnan(low) else f"{row[name]:.3f} ± {(high - low) / 2:.3f}"


def _rate(row: Row, name: str) -> str:
    """A rate with its interval; blank where the task has none."""
    if row.get(name) is None:
        return ""
    low, high = row[f"{name}_ci95"]
    return f"{row[name]:.3f} [{low:.3f}, {high:.3f}]"


def _failures(row: Row) -> str:
    counts = {name: row[name] for name in ("diverged", "torn", "out_of_bounds") if row[name]}
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "0"


def cells(row: Row) -> dict[str, str]:
    """What a table says of a row, by column; blank where a task has no such number."""
    first, steps = row.get("first_success"), row.get("model_steps")
    # of a run its folder's name
    name = ", ".join([Path(row["policy"]).name, *([row["about"]] if "about" in row else [])])
    return {
        "policy": " ".join([name, *(f"{key}={value}" for key, value in row["env_kwargs"].items())]),
        "episodes": str(row["episodes"]),
        "score": _spread(row, "normalized_performance"),
        "success": _rate(row, "success_rate"),
        "held": _rate(row, "success_held_rate"),
        "best": _spread(row, "best"),
        "first success": "" if first is None else f"{first:.1f}",
        "cost": _spread(row, "cost"),
        "failures": _failures(row),
        "return": _spread(row, "return"),
        "steps": f"{row['mean_length']:.1f}",
        "model steps": "" if steps is None else f"{steps:,}",
        "seconds": f"{row['seconds']:.1f}" if "seconds" in row else "",
    }


def table(rows: list[Row]) -> str:
    """Rows as text, a line each; columns in which nothing stands are left out."""
    lines = [{"environment": row["env"], **cells(row)} for row in rows]
    for line, row in zip(lines, rows):
        line["safe"] = f"{row['safe_success_rate']:.3f}" if "safe_success_rate" in row else ""
    columns = [name for name in lines[0] if any(line[name] for line in lines)]
    widths = [max(len(name), *(len(line[name]) for line in lines)) for name in columns]
    texts = [dict(zip(columns, columns)), *lines]
    return "\n".join("  ".join(f"{text[name]:<{width}}" for name, width in zip(columns, widths)).rstrip() for text in texts)

"""A campaign against everything that takes input: does anything break, hang, or make nonsense?

    python benchmarks/attack.py --minutes 30                      # every family, 30 minutes in all
    python benchmarks/attack.py --minutes 5 --only constructors   # one family
    python benchmarks/attack.py --run "TEXT"                      # one attack, by its line in the report

Attacks are drawn from a seed.  Each family is a module of ``attacks/``, in a process of its own with a limit on its memory.  Every
attack has one of these outcomes:

    fine        it was taken, and what came of it is sound
    clear       it was refused: a ValueError or TypeError that our own code raises, with the argument's name or what would do; or,
                where there is no file, a FileNotFoundError
    obscure     any other exception
    hang        it did not end within the time limit
    crash       the process died
    nonsense    it was taken, or refused after something had changed, and a check of the attack failed
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import json
import linecache
import multiprocessing
import re
import resource
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from attacks.values import run
from tqdm import tqdm

import clothgym.envs
from clothgym.lab.bench import machine

FAMILIES = ("constructors", "resets", "actions", "states", "files", "kills", "disk", "protocol")
OUTCOMES = ("fine", "clear", "obscure", "hang", "crash", "nonsense")
RESULTS = Path(__file__).parent / "results" / "attack.json"
LIMIT = 300.0  # of an attack [s]; a kernel may be compiled in it, beside others
MEMORY = 16 * 2**30  # of a process [bytes], most of which is address space that libraries reserve
LISTED = 20  # lines of a family's report, and findings that are kept of one line of code
OURS = tuple(str(Path(module.__file__ or "").resolve().parent) for module in (clothgym, clothgym.envs))
OURS = (*OURS, str(Path(__file__).resolve().parents[1] / "training"))
REMEDY = re.compile(
    r"\b(must|there (are|is|may)|give|takes?|need|needs|holds?|names?|check|reset|call|lower|use|set|write|choose|make|remove|"
    r"train|install)\b"
)

Finding = tuple[str, str, str]  # what to paste, the outcome, and what was said


# --- the outcome of an attack -------------------------------------------------------------------------------------------------


def outcome_of(text: str, error: BaseException | None) -> tuple[str, str]:
    """The class of what an attack has raised, and what it says."""
    if error is None:
        return "fine", ""
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    try:
        said = f"{type(error).__name__}: {error}"
    except Exception:
        said = type(error).__name__
    where = f"{said[:400]}  [{Path(last.filename).name}:{last.lineno}]"
    if isinstance(error, AssertionError) and Path(last.filename).parent.name == "attacks":
        return "nonsense", where
    if not isinstance(error, (ValueError, TypeError, FileNotFoundError)):
        return "obscure", where
    # raised on purpose, by us, and of use to whoever reads it
    ours = any(str(Path(last.filename).resolve()).startswith(f"{folder}/") for folder in OURS)
    on_purpose = linecache.getline(last.filename, last.lineno or 0).strip().startswith("raise")
    named = set(re.findall(r"[a-z_]{3,}", text)) & set(re.findall(r"[a-z_]{3,}", said)) or REMEDY.search(said)
    return ("clear" if ours and on_purpose and named else "obscure"), where


def tried(text: str, attack: Any) -> tuple[str, str]:
    """The outcome of an attack, here and now."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            attack()
    except Exception as error:
        return outcome_of(text, error)
    return "fine", ""


# --- a family in a process of its own -----------------------------------------------------------------------------------------


def _work(pipe: Connection, family: str, seed: Sequence[int]) -> None:
    """Tell each attack before it begins, and its outcome, until nobody listens."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.RLIM_INFINITY))
    warnings.simplefilter("ignore")
    with contextlib.suppress(BrokenPipeError, EOFError):
        for text, attack in importlib.import_module(f"attacks.{family}").attacks(np.random.default_rng(seed)):
            pipe.send(text)
            pipe.send(tried(text, attack))
            pipe.recv()


def findings(family: str, seed: int, limit: float = LIMIT) -> Iterator[Finding]:
    """Attacks of a family and their outcomes, without end; after a hang or a crash another process goes on with other attacks."""
    context, process, pipe = multiprocessing.get_context("spawn"), None, None
    starts = 0
    try:
        while True:
            # a process that is ready
            if process is None or pipe is None:
                pipe, other = context.Pipe()
                process = context.Process(target=_work, args=(other, family, (seed, FAMILIES.index(family), starts)), daemon=True)
                process.start()
                other.close()
                starts += 1
            # one attack
            text, found = "", ("hang", f"no end within {limit:g} s")
            try:
                text = pipe.recv()
                if pipe.poll(limit):
                    found = pipe.recv()
                    pipe.send(None)
            except (EOFError, ConnectionError):
                process.join()
                found = ("crash", f"the process ended with status {process.exitcode}")
            if found[0] in ("hang", "crash"):
                process.kill()
                process.join()
                process = None
            if not text:
                raise RuntimeError(f"the attacks of {family} do not begin: {found[1]}")
            yield text, *found
    finally:
        if process is not None:
            process.kill()
            process.join()


def attacked(family: str, seed: int, seconds: float, bar: Any, most: int = 0, limit: float = LIMIT) -> dict[str, Any]:
    """What a family of attacks finds in so many seconds, or in ``most`` attacks."""
    counts, places, notes = Counter(dict.fromkeys(OUTCOMES, 0)), Counter[tuple[str, str]](), []
    until = None
    for text, outcome, said in (found := findings(family, seed, limit)):
        until = until or time.monotonic() + seconds  # the first attack waits for imports and kernels
        counts[outcome] += 1
        place = outcome, said.rpartition("[")[2]
        places[place] += 1
        if outcome not in ("fine", "clear") and places[place] <= LISTED:
            notes.append({"outcome": outcome, "attack": text, "said": said})
        bar.update()
        if time.monotonic() > until or sum(counts.values()) == most:
            break
    found.close()  # type: ignore[attr-defined]
    return {"counts": dict(counts), "findings": notes}


# --- the command --------------------------------------------------------------------------------------------------------------


def present() -> list[str]:
    """The families whose modules are there."""
    return [family for family in FAMILIES if importlib.util.find_spec(f"attacks.{family}")]


def campaign(families: Sequence[str], seed: int, minutes: float, jobs: int = 1) -> dict[str, Any]:
    """All families, each for its share of the time, ``jobs`` of them at once."""
    share = 60 * minutes * jobs / len(families)
    with tqdm(unit=" attacks", disable=None) as bar, ThreadPoolExecutor(jobs) as pool:
        lock = threading.Lock()

        class Shared:
            def update(self) -> None:
                with lock:
                    bar.update()

        rows = list(pool.map(lambda family: attacked(family, seed, share, Shared()), families))
    return {"machine": machine(), "seed": seed, "minutes": minutes, "families": dict(zip(families, rows))}


def table(results: dict[str, Any]) -> str:
    """Families and outcomes, and a line to paste for everything that is not as it should be."""
    families = results["families"]
    total = {name: sum(row["counts"][name] for row in families.values()) for name in OUTCOMES}
    lines = [f"{'':<14}" + "".join(f"{name:>10}" for name in OUTCOMES)]
    for name, counts in [*((family, row["counts"]) for family, row in families.items()), ("all", total)]:
        lines.append(f"{name:<14}" + "".join(f"{counts[outcome]:>10}" for outcome in OUTCOMES))
    for family, row in families.items():
        listed = row["findings"][:LISTED]
        for one in listed:
            lines += [f"\n{one['outcome']}: {one['attack']}", f"    {one['said']}"]
        more = sum(row["counts"][name] for name in OUTCOMES[2:]) - len(listed)
        if more:
            lines.append(f"\n... and {more} more of {family}; --json has up to {LISTED} of each line of code")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="in all (default 30)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=present(), choices=present(), metavar="FAMILY", help=", ".join(present()))
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="families at once")
    parser.add_argument("--json", type=Path, default=RESULTS, metavar="FILE", help="where the results go")
    parser.add_argument("--run", metavar="TEXT", help="one attack, as its line says")
    args = parser.parse_args()
    if args.run:
        run(args.run)
        return 0
    results = campaign(args.only, args.seed, args.minutes, args.jobs)
    args.json.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))
    counts = [row["counts"] for row in results["families"].values()]
    return int(any(count[outcome] for count in counts for outcome in ("hang", "crash", "nonsense")))


if __name__ == "__main__":
    sys.exit(main())

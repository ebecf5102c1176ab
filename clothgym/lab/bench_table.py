"""The table of speeds: the cost of each case, beside its goal and the limits of the machine.

    python -m clothgym bench --table                                    # all of it, about half an hour
    python -m clothgym bench --table --select springs bending           # some groups; --json FILE writes the rows too

All cases run on one thread and are timed by its processor time ("start": by that of whole processes).  Cases that take
milliseconds take turns in rounds, and the median counts.  Other load on the machine affects them all alike, so ratios are more
reliable than times.  A case that takes seconds takes turns, frame by frame, with the case it is compared to.  Each of its rows also
has the time of a plain step in the same period.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from clothgym import progress
from clothgym.checks import known
from clothgym.lab.bench import machine
from clothgym.lab.bench_limits import PlainSheet, Work, measure_limits, stand

Row = dict[str, Any]
ROUNDS = 15


@dataclass(frozen=True, eq=False)
class Case:
    """A case that takes milliseconds.

    Attributes:
        group: of rows.
        what: a description.
        call: the timed function.
        scale: factor from seconds of a call to ``unit``.
        wanted: the goal in words, if it is not a number.
        over, beyond: another case; the result is the ratio to ``over``, or the difference from ``beyond``.
        goal: largest result wanted, or a factor and another case whose result it multiplies.
        visits: product of springs, substeps and environments in a call, for ns per spring.
        work, springs, size: of a substep, see ``bench_limits.stand``; with ``beyond``, of the difference.
    """

    group: str
    what: str
    call: Callable[[], object]
    scale: float
    unit: str
    wanted: str = ""
    over: Case | None = None
    beyond: Case | None = None
    goal: float | tuple[float, Case] | None = None
    visits: int = 0
    work: Work | None = None
    springs: int = 0
    size: int = 0

    def value(self, seconds: dict[Case, float]) -> float:
        if self.over is not None:
            return seconds[self] * self.scale / (seconds[self.over] * self.over.scale)
        less = seconds[self.beyond] * self.beyond.scale if self.beyond is not None else 0.0
        return seconds[self] * self.scale - less

    def row(self, seconds: dict[Case, float], limits: Row) -> Row:
        goal, wanted = self.goal, self.wanted
        if isinstance(goal, tuple):
            factor, other = goal
            goal = factor * other.value(seconds)
            wanted = f"{goal:.3g}: {factor:g} times {other.what}"
        row = row_of(self.group, self.what, self.value(seconds), self.unit, goal, wanted)
        if self.visits:
            row["ns a spring"] = 1e9 * (seconds[self] - (seconds[self.beyond] if self.beyond else 0.0)) / self.visits
        if self.work is not None:
            row["limits"] = stand(row["ns a spring"], self.work, self.springs, self.size, limits)
        return row


def row_of(group: str, what: str, now: float, unit: str, goal: float | None = None, wanted: str = "", least: bool = False) -> Row:
    """A row of the table.  goal: the largest result wanted, or the smallest if ``least``."""
    reached = None if goal is None else bool(now >= goal if least else now <= goal)
    wanted = wanted or ("" if goal is None else f"{goal:g}")
    return {"group": group, "what": what, "now": now, "unit": unit, "goal": goal, "wanted": wanted, "reached": reached}


def in_turns(cases: Sequence[Case], rounds: int) -> dict[Case, float]:
    """Median processor time of a call of each case [s].  The cases take turns, and each round starts with a different one."""
    times: dict[Case, list[float]] = {case: [] for case in cases}
    for case in cases:
        case.call()
    for turn in range(rounds):
        first = turn * len(cases) // rounds
        for case in (*cases[first:], *cases[:first]):
            begun = time.thread_time()
            case.call()
            times[case].append(time.thread_time() - begun)
        progress.show(f"rounds of {len(cases)} cases", turn + 1, rounds)
    return {case: statistics.median(taken) for case, taken in times.items()}


def with_what_they_need(cases: Iterable[Case]) -> list[Case]:
    """The cases and those that they are compared with, each listed once."""
    found: dict[Case, None] = {}

    def add(case: Case) -> None:
        if case not in found:
            others = (case.over, case.beyond, case.goal[1] if isinstance(case.goal, tuple) else None)
            for other in others:
                if other is not None:
                    add(other)
            found[case] = None

    for case in cases:
        add(case)
    return list(found)


class Pace:
    """The machine's speed during a long measurement, sampled by plain steps.  It makes two runs comparable."""

    def __init__(self) -> None:
        self.sheet = PlainSheet(25)
        self.times: list[float] = []

    def sample(self, steps: int = 40) -> None:
        begun = time.thread_time()
        self.sheet.step(steps)
        self.times.append((time.thread_time() - begun) * 1e9 / (steps * self.sheet.springs))

    def take(self) -> float | None:
        """Median time of a plain step per spring since the last call [ns]."""
        times, self.times = self.times, []
        return statistics.median(times) if times else None


@cache
def pace() -> Pace:
    return Pace()


def beat(text: str) -> None:
    """Show progress, and sample the machine's speed."""
    pace().sample()
    progress.show(text)


def run(select: Sequence[str] = (), rounds: int | None = None) -> dict[str, Any]:
    """All rows of the selected groups, or of all groups, with the machine and its limits.

    Raises:
        ValueError: an unknown group.
    """
    from clothgym.lab.bench_cases import GROUPS as SHORT  # imported here: these modules import this one
    from clothgym.lab.bench_episodes import GROUPS as LONG

    groups = {**SHORT, **LONG}
    for name in select:
        known("group", name, groups)
    chosen = list(select) or list(groups)
    results: dict[str, Any] = {"machine": machine(), "limits": measure_limits(), "rows": []}
    cases = with_what_they_need(case for name in chosen if name in SHORT for case in SHORT[name]())
    if cases:
        seconds = in_turns(cases, rounds or ROUNDS)
        results["rows"] += [case.row(seconds, results["limits"]) for case in cases]
    for name in chosen:
        if name in LONG:
            beat(name)
            rows = LONG[name]()
            beat(name)
            plain = pace().take()
            results["rows"] += [row | {"plain step ns": plain} for row in rows]
    progress.clear()
    return results


def table(results: dict[str, Any]) -> str:
    """The rows as text."""
    about, limits = results["machine"], results["limits"]
    lines = [f"{about['processor']}, {about['date']}; " + ", ".join(f"{k} {v}" for k, v in about["versions"].items())]
    bandwidth = ", ".join(f"{level} {speed / 1e9:.0f}" for level, speed in limits["bytes/s"].items())
    lines.append(
        f"one core: {limits['operations/s'] / 1e9:.0f} thousand million operations a second, "
        f"{limits['inverse roots/s'] / 1e9:.2f} inverse roots; GB/s: {bandwidth}"
    )
    group = ""
    for row in results["rows"]:
        if row["group"] != group:
            group = row["group"]
            lines += ["", f"{group:<66} {'now':>9} {'':<22} wanted"]
        mark = {True: "reached", False: "", None: ""}[row["reached"]]
        now = row["now"] if row["now"] is not None else float("nan")
        number = f"{now:,.0f}" if abs(now) >= 1000 else f"{now:.3g}"
        lines.append(f"  {row['what']:<64} {number:>9} {row['unit']:<22} {row['wanted']} {mark}".rstrip())
        if "limits" in row:
            shares = ", ".join(f"{100 * share:.0f} % of {name}" for name, share in row["limits"]["shares"].items())
            lines.append(f"  {'':<64} {'':>9} {shares}")
    return "\n".join(lines)

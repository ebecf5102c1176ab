"""What is said at the end of an episode: a success, or what was missed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from clothgym.envs import draping, fold_goal, hang, hanging, scoring
from clothgym.envs.episode import FAILURES

Info = Mapping[str, Any]
# the numbers that a task is judged by, whether they are enough, and what to say where they are not
Criterion = tuple[str, Callable[[Info], bool], Callable[[Info], str]]
CRITERIA: tuple[Criterion, ...] = (
    (
        "coverage_reference",
        lambda info: info["coverage"] >= draping.ENOUGH_COVERAGE * info["coverage_reference"],
        lambda info: f"it covers {info['coverage'] / info['coverage_reference']:.0%}, {draping.ENOUGH_COVERAGE:.0%} is enough",
    ),
    (
        "spread",
        lambda info: info["spread"] >= draping.ENOUGH_SPREAD,
        lambda info: f"{1 - info['spread']:.0%} of it lies doubled over",
    ),
    (
        "off_center",
        lambda info: info["off_center"] <= draping.ENOUGH_CENTERING,
        lambda info: f"it lies {info['off_center']:.0%} of its side off center, at most {draping.ENOUGH_CENTERING:.0%} is allowed",
    ),
    (
        "balance",
        lambda info: info["balance"] >= hang.ENOUGH_BALANCE,
        lambda info: "it hangs mostly on one side",
    ),
    (
        "threaded",
        lambda info: bool(info["threaded"]),
        lambda info: "the hook is not in its hole",
    ),
    (
        "lying",
        lambda info: info["lying"] <= hanging.MOST_LYING,
        lambda info: f"{info['lying']:.0%} of it lies on the floor",
    ),
    (
        "distance_max",
        lambda info: info["distance_max"] <= fold_goal.ENOUGH_NEAR,
        lambda info: f"a corner is {info['distance_max']:.0%} of a side from its goal, {fold_goal.ENOUGH_NEAR:.1%} is allowed",
    ),
    (
        "rms_speed",
        lambda info: info["rms_speed"] < scoring.ENOUGH_REST,
        lambda info: f"it still moves at {100 * info['rms_speed']:.1f} cm/s",
    ),
)


def judgement(info: Info, total: float) -> str:
    """A sentence on the last step's ``info`` and the return."""
    if info["failure"]:
        return f"The episode failed: {FAILURES[info['failure']].replace('_', ' ')}. Return {total:.2f}."
    score = f"performance {info['normalized_performance']:.2f}, return {total:.2f}"
    if info["is_success"]:
        return f"Evaluated: a success, {score}."
    missed = [say(info) for name, enough, say in CRITERIA if name in info and not enough(info)]
    return f"Evaluated: no success, {score}" + (f": {'; '.join(missed)}." if missed else ".")

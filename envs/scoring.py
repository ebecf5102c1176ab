"""What tasks share in their kernels: a score's shape, what counts as at rest, taking hold, a success that lasts, and the time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from clothgym._jit import inlined
from clothgym.envs.episode import FINE, Fields
from clothgym.envs.measures import distance
from clothgym.envs.observing import Observation

SPEED_SCALE = 0.1  # [m/s]: performance is halved at this rms speed
ENOUGH_REST = 0.02  # below this rms speed a sheet is at rest [m/s]
PICK_SCALE = 0.15  # in sides: how the potential rises as a gripper nears its place

# of tasks whose kernel ``account`` ends with ``follow``: what their episodes remember, within which ranges, and what info tells
FOLLOWED: Fields = (("best", float), ("first_success", np.int64), ("lost", np.uint8))
FOLLOWED_RANGES: Mapping[str, tuple[float, float]] = {"best": (0.0, 1.0), "first_success": (-1, 10_000), "lost": (0, 1)}
FOLLOWED_INFO: Fields = (("best", float), ("first_success", np.int64), ("success_held", bool))

# what ``observe_time`` writes
TIME = (
    Observation("settling", "whether the sheet settles, and actions are ignored"),
    Observation("episode_left", "share of the episode left"),
    Observation("acting_left", "share of the acting time left"),
)


@inlined
def falloff(distance, scale):
    """What a score is divided by: 1 at no distance, 2 at ``scale``; smooth, and with a gradient from afar."""
    return 1 + (distance / scale) ** 2


@inlined
def grasp(taken, rules, sheet, k):
    """1 for a gripper that has taken its place, at most a half for one that nears it."""
    return taking(taken, rules, sheet, rules.places[k], k)


@inlined
def taking(taken, rules, sheet, place, k):
    """The same of a gripper and any particle."""
    away = distance(sheet.x[:, place], sheet.attachments[k])
    return 1.0 if taken else 0.5 / falloff(away, PICK_SCALE * rules.side)


@inlined
def holds_nothing(own, rules, sheet):
    """Whether all anchors and grippers are open."""
    for k in range(sheet.holds.shape[0]):
        if sheet.holds[k] > 0:
            return False
    return True


@inlined
def follow(own, info, score, reached, running, failure):
    """Keep the episode's best score, the step of its first success, and whether that has lasted.

    score: how well the sheet lies now.  reached: whether that is enough, at rest or not.
    """
    if own.step == 0:
        own.best, own.first_success, own.lost = score, -1, 0
    elif running:
        own.best = max(own.best, score)
        if reached and own.first_success < 0:
            own.first_success = own.step
        if own.first_success >= 0 and (failure != FINE or not reached):
            own.lost = 1
    info.best, info.first_success = own.best, own.first_success
    info.success_held = own.first_success >= 0 and own.lost == 0


@inlined
def observe_time(own, rules, seen):
    """Whether the sheet settles, and the shares of the time that are left."""
    seen.settling = own.settling_since >= 0
    seen.episode_left = 1 - own.step / (rules.acting_steps + rules.settling_steps)
    seen.acting_left = max(rules.acting_steps - own.step, 0) / rules.acting_steps

"""``action_mode="pick_place"``: an action gives the pick position, the place position and the lift of each gripper.

One such action takes ``STEPS`` control steps in every environment, for any distance: the motion is spread evenly over them.  A
batch therefore stays synchronous, and no environment waits for another.  When the time is up the sheet settles in further steps,
whose actions are ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length

NUMBERS = 5  # of an action for each gripper: pick x, y; place x, y; lift
STEPS = 60  # control steps of an action
FINGERS, RESTING = 4, 8  # of these the fingers take to close, and to open; and that the sheet rests at the end
MOVING = STEPS - 2 * FINGERS - RESTING
RETREAT, LEAVING = 0.15, 4  # how far the grippers rise at the end, in sides, and in how many steps
PICK_RADIUS = 0.03  # horizontal radius around the pick position in which the top of the cloth sets the tip's height [m]
LOWEST = 0.012  # height of a tip that picks [m]


class Path(NamedTuple):
    """Ways of the grippers, each (num_envs, grippers, ...).

    start, pick, place: [m], (..., 3).  lift: of the arc from pick to place [m].  approach: control steps until the fingers close.
    """

    start: NDArray
    pick: NDArray
    place: NDArray
    lift: NDArray
    approach: NDArray


def places_of(actions: NDArray, cloth: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """Tips at the pick and at the place of an action [m], (num_envs, grippers, 3) each.

    actions: within [-1, 1], (num_envs, grippers, NUMBERS).  cloth: its particles [m], (num_envs, particles, 3).
    half: of the square about the origin in which they pick and place [m].
    """
    low = np.full((*actions.shape[:2], 1), LOWEST)
    pick, place = (np.concatenate([half * actions[..., i : i + 2], low], axis=2) for i in (0, 2))
    # a tip goes to the top of what lies there, and comes down to the floor at the place
    across = cloth[:, None, :, :2] - pick[:, :, None, :2]
    near = across[..., 0] ** 2 + across[..., 1] ** 2 <= PICK_RADIUS**2
    tops = np.where(near, cloth[:, None, :, 2], 0).max(axis=2)
    pick[..., 2] = np.maximum(tops, LOWEST)
    return pick, place


def path_of(pick: NDArray, place: NDArray, tips: NDArray, lift: NDArray) -> Path:
    """The way of tips over the pick to the place, each [m], (num_envs, grippers, 3).

    lift: of the arc between [m], (num_envs, grippers).
    """
    # the way to the place, an arc, has as much of the time as of the length; both ways have some of it.  The grippers of one sheet
    # close and open together, by the longest of their ways: one that lifts what the other still holds down tears it
    to_pick, to_place = (way.max(axis=1, keepdims=True) for way in (length(pick - tips), length(place - pick) + 2 * lift))
    share = np.broadcast_to(to_pick / np.maximum(to_pick + to_place, 1e-9), tips.shape[:2])
    approach = np.clip(np.rint(share * (MOVING - LEAVING)), 4, MOVING - LEAVING - 4).astype(np.int64)
    return Path(tips, pick, place, lift, approach)


def wanted_at(path: Path, step: int, side: float) -> tuple[NDArray, NDArray]:
    """Where the tips are to be after control step ``step`` of an action [m], (num_envs, grippers, 3), and whether fingers open,
    (num_envs, grippers)."""
    done = step + 1
    carrying = MOVING - LEAVING - path.approach
    # to the pick; then, when the fingers have closed, along the arc; then, when they have opened, up
    first = np.minimum(done / path.approach, 1.0)
    second = _eased(np.clip((done - path.approach - FINGERS) / carrying, 0, 1))
    third = np.clip((done - (MOVING - LEAVING) - 2 * FINGERS) / LEAVING, 0, 1)
    tips = np.where((first < 1)[..., None], path.start + first[..., None] * (path.pick - path.start), path.pick)
    tips += second[..., None] * (path.place - path.pick)
    tips[..., 2] += 4 * path.lift * second * (1 - second) + third * RETREAT * side
    opened = (done <= path.approach) | (done > MOVING - LEAVING + FINGERS)
    return tips, opened


def _eased(share: NDArray) -> NDArray:
    """From 0 to 1 with no speed at either end: a polynomial, for its bits do not depend on a library."""
    return share * share * (3 - 2 * share)


def commands(task: Any, actions: NDArray) -> Callable[[int], NDArray]:
    """The velocities and fingers of each control step of an action, (num_envs, grippers x 4), as a function of the control step.

    task: a ``GripperTask``.  actions: within [-1, 1], (num_envs, numbers).
    """
    grippers, side = task.num_attachments, task.physics.side
    limited = actions.reshape(task.num_envs, grippers, NUMBERS)
    tips, cloth = task.simulation.grippers.positions.astype(np.float64), task.simulation.positions.astype(np.float64)
    pick, place = places_of(limited, cloth, task.workspace * side)
    lift = (limited[..., 4] + 1) / 2 * side
    path = path_of(pick, place, tips, lift)
    reach = float(task.rules["reach"][0])

    def at(step: int) -> NDArray:
        wanted, opened = wanted_at(path, step, side)
        velocities = (wanted - task.episode["targets"]) / reach
        return np.concatenate([velocities, np.where(opened, 1.0, -1.0)[..., None]], axis=2).reshape(task.num_envs, -1)

    return at

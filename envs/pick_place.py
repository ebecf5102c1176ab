"""``action_mode="pick_place"``: an action gives the pick position, the place position and the lift of each gripper.

With ``"pick_particle"`` the pick position is a place of the flat sheet: the particle there is picked, wherever it lies (as in
Lin et al. 2021, "Learning visible connectivity dynamics for cloth smoothing"), and the place is relative to the origin of the
task's observations.  Every such pick takes hold of cloth, what an agent sees says where it places, and two grippers never pull
their particles farther apart than they are in the flat sheet.

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
ALONG = np.arange(0.05, 1, 0.05)  # shares of a way at which two tips may not be too far apart


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
    """Tips at the pick and at the place of an action with "pick_place" [m], (num_envs, grippers, 3) each.

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


def particles_of(actions: NDArray, flat: NDArray) -> NDArray[np.intp]:
    """The particles that actions with "pick_particle" pick, (num_envs, grippers): those nearest to a place of the flat sheet, of a
    garment those of its front.

    actions: (num_envs, grippers, NUMBERS), the first two from -1 to 1 across the flat sheet along x and y.
    flat: particles of the flat sheet [m], (particles, 3).
    """
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    at = low + (actions[..., :2] + 1) / 2 * (high - low)
    away = at[:, :, None] - flat[:, :2]
    return np.argmin(away[..., 0] ** 2 + away[..., 1] ** 2, axis=2)


def keep_together(pick: NDArray, place: NDArray, lift: NDArray, apart: NDArray) -> None:
    """Move the places and the lifts of two grippers toward each other, until their tips are never farther apart than they may be.

    pick, place: [m], (num_envs, 2, 3).  lift: [m], (num_envs, 2).  apart: the largest distance [m], at least that of the picks,
    (num_envs,).
    """
    between, middle = place[:, 1] - place[:, 0], place.mean(axis=1)
    between *= np.minimum(apart / np.maximum(length(between), 1e-9), 1)[:, None]
    place[:, 0], place[:, 1] = middle - between / 2, middle + between / 2
    # on the ways from pick to place the tips are ``(1 - s) (p1 - p0) + s (q1 - q0)`` apart, and the arcs add ``4 s (1 - s)`` of the
    # difference of the lifts to the height of that: what is left of the distance bounds it
    higher = lift[:, 1] - lift[:, 0]
    for s in ALONG:
        way = (1 - s) * (pick[:, 1] - pick[:, 0]) + s * between
        left, arc = np.sqrt(np.maximum(apart**2 - way[:, 0] ** 2 - way[:, 1] ** 2, 0)), 4 * s * (1 - s)
        higher = np.clip(higher, np.minimum((-left - way[:, 2]) / arc, 0), np.maximum((left - way[:, 2]) / arc, 0))
    lift[...] = lift.mean(axis=1, keepdims=True) + higher[:, None] * (-0.5, 0.5)


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
    if task.action_mode == "pick_particle":
        envs, flat = np.arange(task.num_envs)[:, None], task.physics.mesh.rest_positions
        chosen = particles_of(limited, flat)
        pick = cloth[envs, chosen]
        pick[..., 2] = np.maximum(pick[..., 2], LOWEST)
        place[..., :2] += task.episode["origin"][:, None, :2]
        if grippers == 2:
            keep_together(pick, place, lift, length(flat[chosen[:, 1]] - flat[chosen[:, 0]]))
    path = path_of(pick, place, tips, lift)
    reach = float(task.rules["reach"][0])

    def at(step: int) -> NDArray:
        wanted, opened = wanted_at(path, step, side)
        velocities = (wanted - task.episode["targets"]) / reach
        return np.concatenate([velocities, np.where(opened, 1.0, -1.0)[..., None]], axis=2).reshape(task.num_envs, -1)

    return at

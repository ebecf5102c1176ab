"""The scripted expert of ``ClothFling-v0``: take an edge by its corners, lift it, wait, swing, and lay the sheet down.

It sees the whole state, and has no memory: throws start at fixed steps, and the positions of the grippers determine the phase.
Except for the starting step, its actions are therefore a continuous function of the observation, which can be learned by behavior
cloning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length
from clothgym.envs.taking import FLAT, next_edges_of, next_takes_of
from clothgym.envs.throws import RATE, Throw, follow_way, rising, taut_length

LIFTING = 1.2  # speed of a tip on its way up, and to a corner [m/s]
TEARING = 0.5  # strain at which it lets go
NEAR = 0.006  # of a tip from its place, when the fingers close [m]
REST = 0.1  # rms speed below which it evaluates the throw [m/s]
LATE = 4  # steps by which a throw may be late
TIMED = 0.01  # weight of a step's time difference relative to the distance from the path, in sides
ASTRAY = 0.2  # distance from the way at which there is no throw, in sides
AGAIN = 52  # steps before a throw at which it still takes what lies there
FETCHING, CARRIED = 0.5, 0.04  # speed with which it fetches a sheet whose corners are out of reach, and the tips' height [m/s], [m]
THROWN, SETS_OUT = 100, 60  # control steps of an action that is a throw; and after how many of these the hands set out


def fling_actions(task: Any, throws: Sequence[Throw], starts: Sequence[Sequence[int]]) -> NDArray:
    """Velocities and fingers of all environments, (num_envs, 8).

    throws: of each of them.  starts: steps of its episode at which they begin.
    """
    mesh, side, grippers, n = task.physics.mesh, task.physics.side, task.simulation.grippers, task.num_envs
    corners, rest = np.array(mesh.corners), mesh.rest_positions
    v, tips = task.simulation.velocities.astype(np.float64), grippers.positions.astype(np.float64)
    speed = np.sqrt((v**2).sum(axis=2).mean(axis=1))
    holder, held = grippers.holder, grippers.held
    (edges, others), (goals, count) = next_edges_of(task), next_takes_of(task)
    high = task.arena()[1]
    latest = task.starts[-1] - AGAIN
    move, grip = np.zeros((n, 2, 3)), np.ones((n, 2))
    for e in range(n):
        own = task.episode[e]
        free = held[e] == 0
        if free.all():
            if own["throws"] == 0 and own["step"] < 6:
                grip[e] = -1
            elif own["throws"] < 3 and speed[e] < REST and own["coverage"] < task.enough + FLAT and own["step"] < latest:
                move[e], grip[e] = _take(tips[e], edges[e], others[e])
            else:
                move[e, :, 2] = np.where(tips[e, :, 2] < 0.25 * side, 0.4, 0)
            continue
        if free.any():
            # the other gripper comes, if it may
            k = int(np.argmax(free))
            grip[e, 1 - k] = -1
            if own["barred"][k] or count[e, k] < 0 or own["step"] < 6:
                grip[e] = 1 if own["step"] >= 6 else -1
                continue
            move[e, k] = 15 * (goals[e, k] - tips[e, k])
            grip[e, k] = -1 if np.linalg.norm(goals[e, k] - tips[e, k]) < NEAR else 1
            continue
        if not (holder[e, corners] >= 0).any():
            # what was out of reach is carried there, and let go of
            move[e] = np.stack([np.zeros(2), np.full(2, FETCHING), 12 * (CARRIED - tips[e, :, 2])], axis=1)
            grip[e] = 1 if tips[e, :, 1].max() > high[1] - 0.02 else -1
            continue
        hands = [np.flatnonzero(holder[e] == k) for k in range(2)]
        strain = float(task.info["strain_max"][e])
        move[e], grip[e] = _throw(throws[e], starts[e], tips[e], rest, hands, side, int(own["step"]), high, strain)
    # fingers that have closed on nothing open again
    grip[(grippers.openings == 0) & (held == 0)] = 1
    limit = task.physics.attachment_speed
    move /= np.maximum(length(move) / limit, 1)[..., None]
    return np.concatenate([move / limit, grip[..., None]], axis=2).reshape(n, -1)


def _take(tips: Any, goal: Any, count: Any) -> Any:
    """Go there, if there is anything to take, and close."""
    if count[0] < 0:
        return np.zeros((2, 3)), np.ones(2)
    way = goal - tips
    move = 12 * way
    # over the cloth, and then down
    aside = np.linalg.norm(way[:, :2], axis=1)
    move[:, 2] = np.where(aside > 0.05, 12 * (np.maximum(goal[:, 2], 0.06) - tips[:, 2]), move[:, 2])
    move /= np.maximum(length(move) / LIFTING, 1)[..., None]
    return move, -np.ones(2) if np.linalg.norm(way, axis=1).max() < NEAR else np.ones(2)


def _throw(throw: Throw, starts: Any, tips: Any, rest: Any, held: Any, side: float, step: int, high: Any, strain: float) -> Any:
    """Lift the edge, wait, swing it and lay the sheet down."""
    taut = taut_length(rest, held)
    middle, grip = tips.mean(axis=0), -np.ones(2)
    if strain > TEARING:
        return np.zeros((2, 3)), -grip
    # of the throw that is on or comes next
    times, places = throw.way()
    elapsed = step - next((start for start in starts if step <= start + times[-1] + LATE), step + 1)
    off = np.linalg.norm(places - middle[1:] / side, axis=1)
    nearest = int((off**2 + (TIMED * (times - elapsed)) ** 2).argmin())
    if elapsed >= 0 and off[nearest] < ASTRAY:
        now = times[nearest]
        if now > times[-1] - 1:
            return np.zeros((2, 3)), -grip
        move = np.zeros((2, 3))
        move[:, 1:] = follow_way((times, places), now, tips[:, 1:], side)
        return move, grip
    aside = float(np.clip(middle[0], -(high[0] - 0.55 * side), high[0] - 0.55 * side))
    apart = np.array([[-taut / 2, 0, 0], [taut / 2, 0, 0]])
    goal = apart + (aside, throw.along[0] * side, throw.above[0] * side)
    if np.abs(goal - tips).max() < 0.005:
        return RATE * (goal - tips), grip
    return rising(12 * (goal - tips), tips, taut, LIFTING) * np.clip(1.3 - 2 * strain, 0, 1), grip

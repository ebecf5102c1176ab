"""The scripted expert of ``ClothFling-v0``: take an edge by its corners, lift it, wait, swing, and lay the sheet down.

It sees the whole state, and has no memory: throws start at fixed steps, and the positions of the grippers determine the phase.
Except for the starting step, its actions are therefore a continuous function of the observation, which can be learned by behavior
cloning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length
from clothgym.envs.taking import FLAT, next_edges_of, next_takes_of

LIFTING = 1.2  # speed of a tip on its way up, and to a corner [m/s]
TAUT = 0.985  # share of the cloth's length between the grippers to which it is stretched
TEARING = 0.5  # strain at which it lets go
NEAR = 0.006  # of a tip from its place, when the fingers close [m]
REST = 0.1  # rms speed below which it evaluates the throw [m/s]
LATE = 4  # steps by which a throw may be late
TIMED = 0.01  # weight of a step's time difference relative to the distance from the path, in sides
ASTRAY = 0.2  # distance from the way at which there is no throw, in sides
BACK = 20.0  # speed toward the way, for each meter from it [1/s]
STEP = 0.25  # of the search along the way, in control steps
AGAIN = 52  # steps before a throw at which it still takes what lies there
FETCHING, CARRIED = 0.5, 0.04  # speed with which it fetches a sheet whose corners are out of reach, and the tips' height [m/s], [m]


# an action that is a throw: its control steps, and after how many of these the hands set out; and the least and the largest value
# of the steps from one place to the next, and of the places along and above [L]
STEPS, SETS_OUT, PLACES = 100, 60, 5
LASTING, ALONG, ABOVE = (1.0, 13.0), (-0.3, 0.3), (0.02, 1.25)
NUMBERS = PLACES + 2 * (1 + PLACES)


class Throw(NamedTuple):
    """When throws begin, and the way of the hands in one, from where they rest before it.

    starts: steps of the episode at which one begins.  steps: control steps after which they are at each further place, (places,).
    along, above: that and where they begin, along y from the origin and above the floor, in sides, (1 + places,).
    """

    starts: tuple[int, ...]
    steps: tuple[float, ...]
    along: tuple[float, ...]
    above: tuple[float, ...]

    def way(self) -> tuple[NDArray, NDArray]:
        """Times in control steps, (times,), and the places along y and above the floor then, in sides, (times, 2)."""
        steps = (0.0, *self.steps)
        times = np.arange(0, steps[-1] + STEP, STEP)
        return times, np.stack([np.interp(times, steps, self.along), np.interp(times, steps, self.above)], axis=1)

    def action(self) -> NDArray[np.float64]:
        """The way as an action, (NUMBERS,): the steps from one place to the next, and the places along and above, in [-1, 1]."""
        parts = (np.diff((0.0, *self.steps)), self.along, self.above)
        return np.concatenate([_scaled(part, bounds) for part, bounds in zip(parts, (LASTING, ALONG, ABOVE))])


def throw_of(action: NDArray, begins: int) -> Throw:
    """The throw that an action of an episode's step asks for; action: within [-1, 1], (NUMBERS,)."""
    lasting, along, above = (
        low + (part + 1) / 2 * (high - low)
        for part, (low, high) in zip(np.split(action, (PLACES, 2 * PLACES + 1)), (LASTING, ALONG, ABOVE))
    )
    return Throw((begins + SETS_OUT,), tuple(np.cumsum(lasting)), tuple(along), tuple(above))


def _scaled(values: Any, bounds: tuple[float, float]) -> NDArray[np.float64]:
    low, high = bounds
    return 2 * (np.asarray(values) - low) / (high - low) - 1


def fling_actions(task: Any, throws: Sequence[Throw]) -> NDArray:
    """Velocities and fingers of all environments, (num_envs, 8); throws: of each of them."""
    mesh, side, grippers, n = task.physics.mesh, task.physics.side, task.simulation.grippers, task.num_envs
    corners, rest = np.array(mesh.corners), mesh.rest_positions
    v, tips = task.simulation.velocities.astype(np.float64), grippers.positions.astype(np.float64)
    speed = np.sqrt((v**2).sum(axis=2).mean(axis=1))
    holder, held = grippers.holder, grippers.held
    (edges, others), (goals, count) = next_edges_of(task), next_takes_of(task)
    high = task.arena()[1]
    latest = task.throw.starts[-1] - AGAIN
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
        move[e], grip[e] = _throw(throws[e], tips[e], rest, hands, side, int(own["step"]), high, strain)
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


def _throw(throw: Throw, tips: Any, rest: Any, held: Any, side: float, step: int, high: Any, strain: float) -> Any:
    """Lift the edge, wait, swing it and lay the sheet down."""
    between = rest[held[0]][:, None] - rest[held[1]]
    taut = TAUT * np.linalg.norm(between, axis=2).min()
    middle, grip = tips.mean(axis=0), -np.ones(2)
    if strain > TEARING:
        return np.zeros((2, 3)), -grip
    # of the throw that is on or comes next
    times, way = throw.way()
    elapsed = step - next((start for start in throw.starts if step <= start + times[-1] + LATE), step + 1)
    off = np.linalg.norm(way - middle[1:] / side, axis=1)
    nearest = int((off**2 + (TIMED * (times - elapsed)) ** 2).argmin())
    if elapsed >= 0 and off[nearest] < ASTRAY:
        now = times[nearest]
        if now > times[-1] - 1:
            return np.zeros((2, 3)), -grip
        # along the way, and back to it
        here, next_ = (side * np.array([np.interp(t, times, way[:, c]) for c in range(2)]) for t in (now, now + 1))
        move = np.zeros((2, 3))
        move[:, 1:] = 30 * (next_ - here) + BACK * (here - tips[:, 1:])
        return move, grip
    aside = float(np.clip(middle[0], -(high[0] - 0.55 * side), high[0] - 0.55 * side))
    apart = np.array([[-taut / 2, 0, 0], [taut / 2, 0, 0]])
    goal = apart + (aside, throw.along[0] * side, throw.above[0] * side)
    if np.abs(goal - tips).max() < 0.005:
        return 30 * (goal - tips), grip
    move = 12 * (goal - tips)
    # upward before aside
    move[:, :2] *= 0.6
    move /= np.maximum(length(move) / LIFTING, 1)[:, None]
    # never farther apart than the cloth between them is long
    ahead = tips[1] + move[1] / 30 - tips[0] - move[0] / 30
    beyond = max(np.linalg.norm(ahead) - max(taut, 0.01), 0.0)
    pull = 15 * beyond * ahead / max(np.linalg.norm(ahead), 1e-9)
    return (move + np.stack([pull, -pull])) * np.clip(1.3 - 2 * strain, 0, 1), grip

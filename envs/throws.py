"""``action_mode="throw"``: an action is the way of both hands that hold an edge, as in FlingBot (Ha and Song 2021).

What goes before it, to take an edge, to lift it and to stretch it, is the environment's, see the experts of the tasks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length

# the places of a way after the first; and the numbers of an action
PLACES = 5
NUMBERS = PLACES + 2 * (1 + PLACES)
# the least and the largest control steps from one place to the next, and heights of places, in sides
LASTING, ABOVE = (1.0, 13.0), (0.02, 1.25)
STEP = 0.25  # of ``way``, in control steps
BACK = 20.0  # speed toward the way, for each meter from it [1/s]
RATE = 30.0  # control steps in a second
BEHIND = 0.1  # distance of hands from where they should be at which the time of their way stands still, in sides
TAUT = 0.985  # share of the cloth's length between the grippers to which it is stretched


class Throw(NamedTuple):
    """The way of the hands in a throw, from where they rest before it.

    steps: control steps after which they are at each further place, (places,).  along, above: that and where they begin, along the
    direction of the throw from the origin and above the floor, in sides, (1 + places,).
    """

    steps: tuple[float, ...]
    along: tuple[float, ...]
    above: tuple[float, ...]

    def way(self) -> tuple[NDArray, NDArray]:
        """Times in control steps, (times,), and the places along and above the floor then, in sides, (times, 2)."""
        steps = (0.0, *self.steps)
        times = np.arange(0, steps[-1] + STEP, STEP)
        return times, np.stack([np.interp(times, steps, self.along), np.interp(times, steps, self.above)], axis=1)

    def action(self, reach: float) -> NDArray[np.float64]:
        """The way as an action, (NUMBERS,): the steps from one place to the next, and the places along and above, in [-1, 1]."""
        parts = (np.diff((0.0, *self.steps)), self.along, self.above)
        return np.concatenate([_scaled(part, bounds) for part, bounds in zip(parts, (LASTING, (-reach, reach), ABOVE))])


def throw_of(action: NDArray, reach: float) -> Throw:
    """The throw that an action asks for.

    action: within [-1, 1], (NUMBERS,).  reach: the farthest place along, in sides.
    """
    lasting, along, above = (
        low + (part + 1) / 2 * (high - low)
        for part, (low, high) in zip(np.split(action, (PLACES, 2 * PLACES + 1)), (LASTING, (-reach, reach), ABOVE))
    )
    return Throw(tuple(np.cumsum(lasting)), tuple(along), tuple(above))


def _scaled(values: Any, bounds: tuple[float, float]) -> NDArray[np.float64]:
    low, high = bounds
    return 2 * (np.asarray(values) - low) / (high - low) - 1


def follow_way(way: tuple[NDArray, NDArray], now: float, at: NDArray, side: float) -> NDArray:
    """Velocity along a way at a time, and back to it, along and above [m/s], (..., 2).

    way: see ``Throw.way``.  now: in control steps.  at: places of the hands, along and above [m], (..., 2).
    """
    times, places = way
    here, ahead = (side * np.array([np.interp(t, times, places[:, c]) for c in range(2)]) for t in (now, now + 1))
    return RATE * (ahead - here) + BACK * (here - at)


class Hands:
    """The hands of an environment on the way of a throw, within an action.

    Attributes:
        begun: whether they have set out.  done: whether they have let go.
    """

    def __init__(self, throw: Throw) -> None:
        self.throw, self.way = throw, throw.way()
        self.now, self.begun, self.done = 0.0, False, False

    def velocity(self, at: NDArray, side: float) -> NDArray | None:
        """Of hands that are there, along and above [m/s], (2,), or None as they let go; at: [m], (2,).

        Time stands still while they are farther than BEHIND from where they should be now, as before they reach the first place.
        """
        times, places = self.way
        self.begun = True
        if self.now > times[-1] - 1:
            self.done = True
            return None
        here = side * np.array([np.interp(self.now, times, places[:, c]) for c in range(2)])
        if np.linalg.norm(here - at) > BEHIND * side:
            return BACK * (here - at)
        self.now += 1
        return follow_way(self.way, self.now - 1, at, side)


def taut_length(rest: NDArray, held: Any) -> float:
    """Distance at which two hands stretch the cloth between them [m]; rest: particles at rest [m]; held: those of each hand."""
    return float(TAUT * np.linalg.norm(rest[held[0]][:, None] - rest[held[1]], axis=2).min())


def rising(move: NDArray, tips: NDArray, taut: float, fastest: float) -> NDArray:
    """Velocities of two hands that rise with an edge [m/s], (2, 3): upward before aside, and never farther apart than it is long.

    move: wanted [m/s], (2, 3).  tips: [m], (2, 3).  taut: see ``taut_length``.  fastest: [m/s].
    """
    move = move * (0.6, 0.6, 1.0)
    move /= np.maximum(length(move) / fastest, 1)[:, None]
    ahead = tips[1] + move[1] / RATE - tips[0] - move[0] / RATE
    beyond = max(float(np.linalg.norm(ahead)) - max(taut, 0.01), 0.0)
    pull = 15 * beyond * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return move + np.stack([pull, -pull])

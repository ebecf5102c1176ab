"""Tasks with a direction of their own, in which ``frame="task"`` shows observations and takes actions along it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import one_of
from clothgym.envs.task import Task

FRAMES = ("world", "task")


def turned(x: NDArray, y: NDArray, cosine: NDArray, sine: NDArray) -> tuple[NDArray, NDArray]:
    """Vectors turned by an angle about z."""
    return cosine * x - sine * y, sine * x + cosine * y


class DirectedTask(Task):
    """Base of tasks with a direction, ``heading``.

    Args:
        frame: "world", or "task": vectors in the returned state vector are turned, so that x is along ``heading``, and points are
            in ``order``; velocities of actions are turned back.  Pictures do not turn.

    Attributes:
        direction: description of ``heading``, for the page.
    """

    arguments: ClassVar[Mapping[str, str]] = {
        "frame": '"world", or "task": x of observations and of velocities is along $direction; see docs/actions.md'
    }

    direction: ClassVar[str]

    def __init__(self, num_envs: int, frame: str = "world", **kwargs: Any) -> None:
        one_of("frame", frame, *FRAMES)
        self.frame = frame
        super().__init__(num_envs, **kwargs)
        if frame != "world" and (mode := getattr(self, "action_mode", "velocity")) != "velocity":
            raise ValueError(f"frame={frame!r}: must be 'world' with action_mode={mode!r}, whose places are the world's")
        # where in the state vector the first number of each vector lies
        points = len(self.particles)
        firsts = [np.arange(0, 6 * points, 3)]
        for one in self.observations:
            if one.turns:
                rows = np.arange(self.observation_slices[one.name].start, self.observation_slices[one.name].stop, one.shape[-1])
                firsts.append((rows[:, None] + 3 * np.arange(one.turns)).ravel())
        self._firsts = np.concatenate(firsts)

    def heading(self) -> NDArray[np.float64]:
        """Cosine and sine of the yaw of each episode's direction, (num_envs, 2)."""
        raise NotImplementedError

    def order(self) -> NDArray[np.int64] | None:
        """The number of the state vector that each of the returned ones is, (num_envs, numbers); None: all in their places."""
        return None

    def returned(self, state: NDArray, envs: int | slice) -> NDArray:
        if self.frame == "world":
            return state
        cosine, sine = np.moveaxis(self.heading()[envs, ..., None], -2, 0)
        if (order := self.order()) is not None:
            state = np.take_along_axis(state, order[envs], axis=-1)
        own, first = state.copy(), self._firsts
        own[..., first], own[..., first + 1] = turned(state[..., first], state[..., first + 1], cosine, -sine)
        return np.clip(own, -self.state_bound, self.state_bound)

    def commands(self, actions: NDArray) -> Callable[[int], NDArray]:
        if self.frame != "world" and np.isfinite(actions).all():  # others are refused later
            actions = self._turned(np.clip(actions, -1, 1), 1)
        return super().commands(actions)

    def from_world(self, actions: NDArray) -> NDArray:
        return actions if self.frame == "world" else self._turned(actions, -1)

    def expert(self) -> NDArray:
        return self.from_world(super().expert())

    def _turned(self, actions: NDArray, way: int) -> NDArray:
        """Actions whose velocities are turned from the task's frame to the world's, or back, (num_envs, numbers).

        way: 1, or -1 for back.
        """
        cosine, sine = self.heading()[..., None].transpose(1, 0, 2)
        own = actions.reshape(self.num_envs, -1, self.actions_per_attachment).copy()
        own[..., 0], own[..., 1] = turned(own[..., 0], own[..., 1], cosine, way * sine)
        return own.reshape(actions.shape)

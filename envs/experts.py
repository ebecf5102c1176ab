"""What scripted experts share: ways as actions; and to take a sheet by its places, to carry it and to let go."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length

SPEED = 0.8  # of the attachments, as a share of their limit


def as_actions(task: Any, ways: NDArray, last: NDArray, speed: float | NDArray = SPEED) -> NDArray:
    """Actions that take each attachment along its way, as far as the speed goes, (num_envs, numbers).

    ways: of this step [m], (num_envs, attachments, 3).  last: what comes after the velocity, (num_envs, attachments).
    speed: the largest, as a share of the limit, for all or (num_envs, 1).
    """
    move = ways / (task.physics.time_step * task.physics.attachment_speed)
    move *= np.minimum(1, speed / np.maximum(length(move), 1e-9))[..., None]
    return np.concatenate([move, last[..., None]], axis=2).reshape(task.num_envs, -1)


def carry_by_places(task: Any, carry: NDArray, there: NDArray, away: NDArray, speed: float | NDArray = SPEED) -> NDArray:
    """Actions of grippers that go to their places, close, carry the sheet when all hold theirs, open where it is there, and leave.

    The expert has no memory: the particles that are held, or have been held, determine the phase.
    task: a ``GripperTask`` with ``places``, whose episodes record ``picked``.  carry, away: displacements in this step [m]
    of grippers that carry, and of grippers that leave, (num_envs, grippers, 3).  there: whether to open, (num_envs, grippers or 1).
    speed: as of ``as_actions``.
    """
    grippers, places = task.simulation.grippers, task.places
    to_place = task.simulation.positions[:, places] - grippers.positions.astype(np.float64)
    own = grippers.holder[:, places] >= 0
    ready = np.logical_and.reduce(own, axis=1, keepdims=True)
    begun = np.logical_and.reduce(task.episode["picked"], axis=1, keepdims=True)
    # half of the way to a place in each step; who holds it waits for the other
    ways = np.where(ready[..., None], carry, np.where((begun & ~ready)[..., None], away, to_place / 2))
    ways = np.where((own & ~ready)[..., None], 0.0, ways)
    near = length(to_place) < task.physics.grippers[0].reach / 2
    grip = np.where(begun & (there | ~ready), 1.0, np.where(near | own, -1.0, 1.0))
    return as_actions(task, ways, grip, speed)

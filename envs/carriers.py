"""Two ways to carry a sheet by two clips: gently, as a rigid pair, and carelessly.  Scripted agents of ``ClothStrain-v0``.

clips: where they are [m], places: where they are to be [m], both (num_envs, 2, 3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length

CAREFUL_SPEED, CAREFUL_ACCELERATION = 0.5, 2.0  # [m/s], [m/s^2]


def careful(clips: NDArray, places: NDArray, velocity: NDArray, last: NDArray, edge: float, time_step: float) -> NDArray:
    """Velocities of the clips [m/s], (num_envs, 2, 3), as of a rigid pair: a bounded speed and a bounded change of it.

    The held edge is always as long as at rest, and lies along y: clips do not turn, so a pair that did would stretch the cloth
    between its clips, and places are wide enough without.  Where it is turned, that is undone by the end of the leg.  velocity: of
    the clips now [m/s]; last: whether the places are the last, (num_envs,), where the pair comes to rest; edge: its length [m].
    """
    center, moving = middle(clips), middle(velocity)
    away = middle(places) - center
    distance = length(away)
    slowing = np.where(last, np.sqrt(CAREFUL_ACCELERATION * distance), CAREFUL_SPEED)
    speed = np.minimum(CAREFUL_SPEED, slowing)
    change = away * (speed / np.maximum(distance, 1e-9))[:, None] - moving
    change *= np.minimum(1, CAREFUL_ACCELERATION * time_step / np.maximum(length(change), 1e-9))[:, None]
    held = clips[:, 0] - clips[:, 1]
    yaw = np.arctan2(-held[:, 0], held[:, 1])
    yaw *= 1 - np.minimum(1, time_step / np.maximum(distance / CAREFUL_SPEED, 4 * time_step))
    half = edge / 2 * np.stack([-np.sin(yaw), np.cos(yaw), np.zeros(len(yaw))], axis=1)
    there = center + (moving + change) * time_step
    return (np.stack([there + half, there - half], axis=1) - clips) / time_step


def careless(clips: NDArray, places: NDArray, speed: float, time_step: float) -> NDArray:
    """Velocities of the clips [m/s], (num_envs, 2, 3), each straight to its place at full speed [m/s]."""
    away = places - clips
    return away * (speed / np.maximum(length(away), speed * time_step))[..., None]


def middle(pairs: NDArray) -> NDArray:
    """Of what both clips have, (num_envs, 2, ...)."""
    return (pairs[:, 0] + pairs[:, 1]) / 2

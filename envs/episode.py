"""What an episode is made of: its state, the outcome of a step, and the ways in which it can fail."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.measures import CENTROID, FINITE, STRETCH2
from clothgym.simulation import Simulation
from clothgym.state import State

FAILURES = ("", "diverged", "torn", "out_of_bounds")
TORN = 2.0  # a structural spring at twice its rest length
BEYOND = 0.5  # how far the centre of the sheet may leave the arena [m]


@dataclass
class TaskState:
    """All that is needed to continue a batch of episodes bit for bit: physics, episode, random generators."""

    simulation: State
    episode: dict[str, NDArray]
    generators: list[str]


@dataclass
class Outcome:
    """What a step brought, arrays over the batch; ``info`` may nest one level."""

    reward: NDArray
    terminated: NDArray
    truncated: NDArray
    info: dict[str, Any]


def failures(summary: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Index into FAILURES, (num_envs,), from the batch's summary, (SUMMARY, num_envs), and the arena's corners [m]."""
    center = summary[CENTROID : CENTROID + 3].T
    outside = np.any((center < low - BEYOND) | (center > high + BEYOND), axis=1)
    torn = summary[STRETCH2] > TORN**2
    diverged = summary[FINITE] == 0
    return np.where(diverged, 1, np.where(torn, 2, np.where(outside, 3, 0)))


def physics_info(simulation: Simulation, strain: NDArray) -> dict[str, Any]:
    """What ``info`` tells of the physics, arrays (num_envs,): the largest strain, given, and the one before any limiting; with
    self-collision its contacts, the moves that it cut short, and the largest lag of what is held [m]."""
    limiting, contacts = simulation.limiting, simulation.self_contacts
    info = {"strain_max": strain, "strain_before_limiting": strain.copy() if limiting is None else limiting.before}
    if contacts is not None:
        info |= {"self_contacts": contacts.rows, "clamped_moves": contacts.clamped, "hand_lag": contacts.lag}
    return info


def within_ball(vectors: NDArray) -> NDArray:
    """Vectors in the cube [-1, 1]^3 shortened to length 1 where they are longer: the speed limit holds in every direction."""
    squares = vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2
    return vectors / np.sqrt(np.maximum(squares, 1.0))[..., None]


def length(vectors: NDArray) -> NDArray:
    """Euclidean length of vectors, (..., 3): written out, so that its bits do not depend on how many there are."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)

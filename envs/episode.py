"""What an episode is made of: its records, its state, and the ways in which it can fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.state import State

FAILURES = ("", "diverged", "torn", "out_of_bounds")
FINE, DIVERGED, TORN, OUT_OF_BOUNDS = range(4)
TWICE = 2.0  # the stretch at which a structural spring tears
BEYOND = 0.5  # how far the center of the sheet may leave the arena [m]

FAILURE_PENALTY = 0.5
SUCCESS_BONUS = 0.25
EFFORT_PRICE = 0.001

Fields = Sequence[tuple[Any, ...]]  # (name, type) or (name, type, shape)


@dataclass
class TaskState:
    """All that is needed to continue a batch of episodes bit for bit: physics, episode, random generators."""

    simulation: State
    episode: dict[str, NDArray]
    generators: list[str]


def records(count: int, fields: Fields) -> NDArray:
    """Records with these fields, all zero, (count,): kernels read ``record.name``, Python ``records["name"]``."""
    return np.zeros(count, np.dtype(list(fields), align=True))


def names_of(records: NDArray) -> tuple[str, ...]:
    """The records' fields."""
    return records.dtype.names or ()


def record_of(**constants: Any) -> NDArray:
    """One record of these numbers and arrays, (1,)."""
    values = {name: np.asarray(value) for name, value in constants.items()}
    record = records(1, [(name, value.dtype, value.shape) for name, value in values.items()])
    for name, value in values.items():
        record[name] = value
    return record


def length(vectors: NDArray) -> NDArray:
    """Euclidean length of vectors, (..., 3): written out, so that its bits do not depend on how many there are."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)


def within_ball(vectors: NDArray) -> NDArray:
    """Vectors in the cube [-1, 1]^3 shortened to length 1 where they are longer."""
    squares = vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2
    return vectors / np.sqrt(np.maximum(squares, 1.0))[..., None]

"""What an episode is made of: its records, its state, and the ways in which it can fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import checks
from clothgym.state import State

SHARED = ("sheet", "self_contact")  # fields of a simulation's state that are not one array with the environment first
FAILURES = ("", "diverged", "torn", "out_of_bounds")
FINE, DIVERGED, TORN, OUT_OF_BOUNDS = range(4)
TWICE = 2.0  # the stretch at which a structural spring tears
BEYOND = 0.5  # how far the center of the sheet may leave the arena [m]

FAILURE_PENALTY = 0.5
SUCCESS_BONUS = 0.25
EFFORT_PRICE = 0.001

LARGEST_SEED = 2**128 - 1  # as large as what NumPy draws where none is given

Fields = Sequence[tuple[Any, ...]]  # (name, type) or (name, type, shape)


@dataclass
class TaskState:
    """All that is needed to continue a batch of episodes bit for bit: physics, episode, random generators."""

    simulation: State
    episode: dict[str, NDArray]
    generators: list[str]

    def branch(self, count: int, env: int = 0) -> TaskState:
        """One environment's state, ``count`` times: ``vector_env.unwrapped.set_state(env.unwrapped.get_state().branch(8))``.

        Each goes on as that environment would have, with its random numbers too.

        Raises:
            ValueError: less than one, or no such environment.
        """
        checks.count("count", count)
        chosen = np.repeat(checks.indices("env", env, len(self.generators), "this state's environments"), count)
        physics = {field.name: getattr(self.simulation, field.name) for field in fields(State) if field.name not in SHARED}
        contact = {name: array[chosen] for name, array in self.simulation.self_contact.items()}
        return TaskState(
            replace(self.simulation, self_contact=contact, **{name: array[chosen] for name, array in physics.items()}),
            episode={name: array[chosen] for name, array in self.episode.items()},
            generators=[self.generators[one] for one in chosen],
        )


def checked_seeds(seeds: Sequence[Any]) -> list[int | None]:
    """Seeds that generators can have.

    Raises:
        ValueError: one that is neither None nor an integer of at least zero.
    """
    return [None if seed is None else checks.count("seed", seed, "None, or ", least=0, most=LARGEST_SEED) for seed in seeds]


def batch_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """A seed for each environment: those given, a sequence of integers and None; or the first, and those that follow it.

    Raises:
        ValueError: another number of seeds, or one that generators cannot have.
    """
    array = None if isinstance(seed, (list, tuple)) else checks.as_array(seed)
    given = seed if isinstance(seed, (list, tuple)) else array.tolist() if array is not None and array.ndim == 1 else None
    if given is None:
        (first,) = checked_seeds([seed])
        return [None if first is None else first + i for i in range(num_envs)]
    if len(given) != num_envs:
        raise ValueError(
            f"seed={checks.shown(seed)}: {len(given)} seeds for {num_envs} environments: give one each, or one integer"
        )
    return checked_seeds(given)


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

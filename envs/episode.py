"""What an episode is made of: its records, its state, and the ways in which it can fail."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.state import State

FAILURES = ("", "diverged", "torn", "out_of_bounds")
FINE, DIVERGED, TORN, OUT_OF_BOUNDS = range(4)
TWICE = 2.0  # the stretch at which a structural spring tears
BEYOND = 0.5  # how far the center of the sheet may leave the arena [m]

FAILURE_PENALTY = 0.5
SUCCESS_BONUS = 0.25
EFFORT_PRICE = 0.001

Fields = Sequence[tuple[Any, ...]]  # (name, type) or (name, type, shape)


VERSION = 1  # of the format of files


@dataclass
class TaskState:
    """All that is needed to continue a batch of episodes bit for bit.

    Attributes:
        simulation: the physics.
        episode: what is remembered of the episodes, by name; the environment is the first axis of each.
        generators: the random generators, one an environment, as JSON.
        task: what it belongs to, by name: the task, what is observed, and a digest of its arguments.  The digest of the mesh is
            ``simulation.sheet``.
    """

    simulation: State
    episode: dict[str, NDArray]
    generators: list[str]
    task: dict[str, str]

    def save(self, path: str | Path) -> None:
        """Write as ``npz`` without pickle, whole or not at all.

        Raises:
            OSError: the disk is full, or the folder cannot be written.
        """
        arrays = {f"simulation {name}": array for name, array in self.simulation.arrays().items()}
        arrays |= {f"episode {name}": array for name, array in self.episode.items()}
        arrays |= {f"task {name}": np.array(text) for name, text in self.task.items()}
        files.write_arrays(path, "task state", VERSION, arrays | {"generators": np.array(self.generators)})

    @staticmethod
    def load(path: str | Path) -> TaskState:
        """Read what ``save`` wrote; ``set_state`` checks that it fits.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is no state of a task, is damaged, or is of another version.
        """
        advice = "give a file that TaskState.save wrote"
        arrays = files.read_arrays(path, "task state", VERSION, advice)
        with files.naming(path, "task state", advice):
            parts: dict[str, dict[str, NDArray]] = {"simulation": {}, "episode": {}, "task": {}}
            generators = arrays.pop("generators").tolist()
            for name, array in arrays.items():
                part, _, own = name.partition(" ")
                parts[part][own] = array
            task = {name: str(text) for name, text in parts["task"].items()}
            return TaskState(State.of(parts["simulation"]), parts["episode"], generators, task)


def generator_of(text: Any) -> np.random.Generator:
    """The random generator that ``get_state`` has described in JSON.

    Raises:
        ValueError: the text describes none.
    """
    generator = np.random.default_rng(0)
    try:
        described = json.loads(text)
        generator.bit_generator.state = described
        described_whole = generator.bit_generator.state == described and described["state"]["inc"] % 2 == 1
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        described_whole = False
    if not described_whole:
        shown = repr(text) if len(repr(text)) < 100 else f"{repr(text)[:100]}..."
        raise ValueError(f"the state's generators hold {shown}, which is no PCG64 generator: give what get_state() gave")
    return generator


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

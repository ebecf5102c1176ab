"""What an episode is made of: its records, its state, and the ways in which it can fail."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import checks, files
from clothgym._jit import WITHOUT_JIT
from clothgym.checks import LARGEST, fits, shown
from clothgym.parameters import check_properties
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


VERSION = 3  # of the format of files
LAST = "last "  # begins the names of what a state remembers of the last step's info


@dataclass
class TaskState:
    """All that is needed to continue a batch of episodes bit for bit.

    Attributes:
        simulation: the physics.
        episode: variables of the episodes, by name; the environment is the first axis of each.
        generators: the random generators, one an environment, as JSON.
        task: identity of the task, by name: the task, its observations, and a digest of its arguments.  The digest of the mesh is
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
            task=self.task,
        )


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
        raise ValueError(f"the state's generators hold {shown(text)}, which is no PCG64 generator: give what get_state() gave")
    return generator


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
    # a shape of 1 is a row: older versions of numpy take it for a number
    whole = [(name, kind, *((size,) if isinstance(size, int) else size for size in shape)) for name, kind, *shape in fields]
    made = np.zeros(count, np.dtype(whole, align=True))
    # kernels that are not compiled read fields as attributes, too
    return made.view(np.recarray) if WITHOUT_JIT else made


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


def check_state(task: Any, state: TaskState) -> None:
    """Check a state's episodes and its task; ``Simulation.set_state`` checks the physics."""
    advice = "give what get_state() gave, or TaskState.load(path)"
    if not isinstance(state, TaskState) or not all(isinstance(part, dict) for part in (state.episode, state.task)):
        raise ValueError(f"state={shown(state)}: {advice}")
    # of another task
    for name, here in task._belongs.items():
        if (there := state.task.get(name)) != here:
            raise ValueError(
                f"the state's {name} is {shown(there)}, this environment's {here!r}: give a state of the same task, made with the "
                "same arguments"
            )
    memory = task._memory()
    if set(state.episode) != set(memory):
        raise ValueError(f"the state's episodes differ in {', '.join(sorted(set(state.episode) ^ set(memory)))}: {advice}")
    if not isinstance(state.generators, list) or len(state.generators) != task.num_envs:
        raise ValueError(f"the state has not one generator for each of {task.num_envs} environments: {advice}")
    # of episodes that there cannot be
    for name in ("over", "step", *memory):
        low, high = task._ranges.get(name, (-LARGEST, LARGEST))
        # info may hold any number: nothing follows from it
        excused = np.ones(task.num_envs, bool) if name.startswith(LAST) else None
        fits(name, state.episode[name], memory[name], low, high, excused, advice)
        if name == "step" and np.any(state.episode["over"] & (state.episode["step"] == 0)):
            raise ValueError("the state is from before the first reset: there is no episode to continue")
    ended = state.episode["terminated"] | state.episode["truncated"]
    if np.any(ended != state.episode["over"]):
        raise ValueError(f"the state's over differs from its terminated and truncated: {advice}")
    check_properties(task.physics.material, state.episode["material"])
    episodes = task.episode.copy()
    for name in names_of(episodes):
        episodes[name] = state.episode[name]
    for env in range(task.num_envs):
        task.check_episode(env, episodes[env])

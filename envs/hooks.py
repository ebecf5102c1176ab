"""What a task's own methods return, checked: what does not fit is refused with the method's name and the remedy.

Who uses ``Task`` writes these methods, so NumPy's own messages about shapes would point at lines that they have not written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import as_array, finite, members, numbers, shown, vector
from clothgym.collisions import Collider, Plane
from clothgym.envs.episode import Fields

if TYPE_CHECKING:
    from clothgym.envs.task import Task

SUNK = 1e-3  # how far below a plane an episode may start: what contact leaves of a sheet at rest [m]


def named(task: Task | type[Task], hook: str) -> str:
    """A method of a task, for messages."""
    return f"{(task if isinstance(task, type) else type(task)).__name__}.{hook}()"


def as_numbers(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Numbers of that shape, finite or not; yes and no count as 1 and 0.

    Raises:
        ValueError: something else.
    """
    array = as_array(value)
    if array is not None and array.dtype == bool:
        value = array.astype(float)
    return numbers(name, value, shape)


def as_flags(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Booleans of that shape.

    Raises:
        ValueError: something else; any number but 0 would count as yes.
    """
    array = as_array(value)
    if array is None or array.dtype != bool:
        what = shown(value) if array is None else f"an array of {array.dtype.name}"
        raise ValueError(f"{name} has returned {what}: must be {shape} of bool, as a comparison gives")
    if array.shape != shape:
        raise ValueError(f"{name} has returned an array of shape {array.shape}: must be {shape}, one for each environment")
    return array


# --- when a task is made --------------------------------------------------------------------------------------------------------


def colliders(task: Task) -> list[Collider]:
    """What ``colliders`` returns."""
    made = task.colliders()
    members(named(task, "colliders"), made, Collider, "solids; [] where there are none")
    return list(made)


def arena(task: Task) -> tuple[NDArray, NDArray]:
    """What ``arena`` returns."""
    name, corners = named(task, "arena"), task.arena()
    if not isinstance(corners, Sequence | np.ndarray) or len(corners) != 2:
        raise ValueError(f"{name}={shown(corners)}: must be two corners, the lowest and the highest [m]")
    low, high = vector(f"{name}[0]", corners[0]), vector(f"{name}[1]", corners[1])
    if not np.all(low < high):
        raise ValueError(f"{name}={shown(corners)}: the first corner must be below the second in each direction")
    return low, high


def fields(task: Task, hook: str, declared: Any, taken: Sequence[str] = ()) -> Fields:
    """Fields that a task declares, ``(name, type)`` or ``(name, type, shape)``; taken: names that all tasks have.

    Raises:
        TypeError: no such fields, or two of one name.
    """
    what = f"{type(task).__name__}.{hook}"
    if not isinstance(declared, Sequence) or isinstance(declared, str):
        raise TypeError(f'{what} is {shown(declared)}: must be a list of fields, as [("goal", float, 3)]')
    seen = set(taken)
    for field in declared:
        fits = isinstance(field, tuple) and 2 <= len(field) <= 3 and isinstance(field[0], str) and field[0].isidentifier()
        try:
            np.dtype([field] if fits else None)
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise TypeError(f'{what} holds {shown(field)}: must be (name, type) or (name, type, shape), as ("goal", float, 3)')
        if field[0] in seen:
            raise TypeError(f"{what} names {field[0]!r}, which there is already: give it another name")
        seen.add(field[0])
    return declared


# --- when an episode begins -----------------------------------------------------------------------------------------------------


def start(task: Task, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray[np.float64]:
    """What ``begin`` returns: a sheet that is nowhere below a floor, (particles, 3).

    Raises:
        ValueError: something else.
    """
    name, shape = named(task, "begin"), (task.physics.mesh.num_particles, 3)
    returned = task.begin(env, rng, options)
    if returned is None:
        raise ValueError(f"{name} has returned None: must return the sheet's particles at the start [m], {shape}")
    x = finite(name, returned)
    if x.shape != shape:
        raise ValueError(f"{name} has shape {x.shape}: must be the sheet's particles at the start [m], {shape}")
    own = task.episode_colliders(env)
    if not isinstance(own, Mapping):
        raise ValueError(f"{named(task, 'episode_colliders')}={shown(own)}: must be a dict of solids by their place in colliders()")
    for plane in (dict(enumerate(task.simulation.colliders)) | dict(own)).values():
        if isinstance(plane, Plane):
            normal = np.array(plane.normal) / np.sqrt(np.sum(np.square(plane.normal)))
            depth = float(-((x - plane.point) @ normal).min())
            if depth > SUNK:
                raise ValueError(f"{name} starts environment {env} {depth:.3g} m below {shown(plane)}: lift the sheet above it")
    return x


# --- after a step ---------------------------------------------------------------------------------------------------------------


def evaluate_in_numpy(task: Any) -> None:
    """Write what the methods of a task without kernels return, for the kernels of all tasks to read.

    Raises:
        ValueError: one of them has returned something that does not fit; the environments then need a reset.
    """
    count, episode = (task.num_envs,), task.episode
    # a sheet that has diverged makes numbers that are not finite: its failure is what counts
    with np.errstate(all="ignore"):
        episode["performance"] = np.clip(np.nan_to_num(as_numbers(named(task, "performance"), task.performance(), count)), 0, 1)
        episode["success"] = as_flags(named(task, "success"), task.success(), count)
        episode["done"] = as_flags(named(task, "done"), task.done(), count)
        for one in task.observations:
            if one.function is None:
                values = episode[one.name]
            else:
                name = f"{type(task).__name__}'s Observation {one.name!r}"
                values = as_numbers(name, one.function(task), (task.num_envs, *one.shape))
            task.seen[one.name] = np.reshape(values, (task.num_envs, *one.shape))


def expert(task: Any) -> NDArray[np.float32]:
    """What ``expert`` returns, (num_envs, numbers)."""
    shape = (task.num_envs, *task.single_action_space.shape)
    return as_numbers(named(task, "expert_actions"), task.expert(), shape).astype(np.float32)

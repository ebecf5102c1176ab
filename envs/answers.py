"""The result of a step as ``info``; an environment whose episode has ended repeats its last answer until it is reset.

An answer consists of the end of the episode, the record of info, and the info of the physics.  Quantities of a single step, which
are summed over an episode (the reward with its terms, and a cost), are zero after the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym.envs import randomization
from clothgym.envs.episode import LAST, names_of

if TYPE_CHECKING:
    from clothgym.envs.task import Task
    from clothgym.simulation import Simulation

ENDS = ("terminated", "truncated", "failure")  # fields of ``Task.outcome``: whether and how an episode has ended
COST = "cost"  # of a step, where a constraint is the task
PEER = "peer_"
# entries of ``info_of_physics`` in addition to the record of info
PHYSICAL = (("self_contacts", np.int64), ("clamped_moves", np.int64), ("attachment_lag", np.float64))


def info_of_physics(simulation: Simulation) -> dict[str, NDArray]:
    """With a limiter the strain before it; with self-collision its contacts, truncated displacements, and attachment lag [m]."""
    limiting, contacts = simulation.limiting, simulation.self_contacts
    info = {} if limiting is None else {"strain_before_limiting": limiting.before}
    if contacts is not None:
        info |= {"self_contacts": contacts.rows, "clamped_moves": contacts.clamped, "attachment_lag": contacts.lag}
    return info


def note_physics(task: Task, envs: NDArray) -> None:
    """Write the info of the physics of these environments, to the record of info or next to it."""
    for name, values in info_of_physics(task.simulation).items():
        record = task.info if name in names_of(task.info) else task.physical
        record[name][envs] = values[envs]


@contextmanager
def standing(task: Task, envs: NDArray) -> Iterator[None]:
    """Context of a control step of these environments: keeps the answers of those whose episodes had ended, and notes the others'.

    Environments that have no part in it, as others settle, keep what the step has brought them before.
    """
    over = task.episode["over"][envs]
    # the usual case, at once
    if not over.any():
        yield
        note_physics(task, envs)
        return
    ended = envs[over]
    kept_info, kept_ends = task.info[ended], {name: task.outcome[name][ended] for name in ENDS}
    yield
    note_physics(task, envs[~over])
    task.info[ended] = kept_info
    for name, values in kept_ends.items():
        task.outcome[name][ended] = values
    for array in _of_a_step(task):
        array[ended] = 0


@contextmanager
def added(task: Task, envs: NDArray) -> Iterator[None]:
    """Context of a further control step of these environments in the same step: rewards, their terms and costs are summed."""
    before = [array[envs] for array in _of_a_step(task)]
    yield
    for array, value in zip(_of_a_step(task), before):
        array[envs] += value


def _of_a_step(task: Task) -> list[NDArray]:
    """Quantities of a single step, live, each (num_envs,)."""
    costs = [task.info[COST]] if COST in names_of(task.info) else []
    return [task.outcome["reward"], *(task.terms[name] for name in names_of(task.terms)), *costs]


def key_of(name: str) -> str:
    """The key in info of a field: ``peer/NAME`` for ``peer_NAME``, the measures of other benchmarks."""
    return name.replace(PEER, "peer/", 1) if name.startswith(PEER) else name


def of_batch(task: Task) -> dict[str, Any]:
    """Info of the last step of each environment, or of the reset since then: arrays over the batch, fresh copies."""
    info: dict[str, Any] = {key_of(name): task.info[name].copy() for name in names_of(task.info)}
    if task.simulation.self_collision is not None:
        info |= {name: task.physical[name].copy() for name, _ in PHYSICAL}
    info["failure"] = task.outcome["failure"].copy()
    info |= randomization.told(task)
    return info | {f"reward/{name}": task.terms[name].copy() for name in names_of(task.terms)}


def of_one(task: Task, env: int) -> dict[str, Any]:
    """The same of one environment, as plain Python values."""
    info = dict(zip(map(key_of, names_of(task.info)), task.info[env].item()))
    if task.simulation.self_collision is not None:
        info |= dict(zip(names_of(task.physical), task.physical[env].item()))
    info["failure"] = task.outcome["failure"][env].item()
    info |= {name: values[env].item() for name, values in randomization.told(task).items()}
    return info | {f"reward/{name}": value for name, value in zip(names_of(task.terms), task.terms[env].item())}


def remembered(task: Task) -> dict[str, NDArray]:
    """All of the answers that a state must hold, live, by name."""
    own = {name: task.outcome[name] for name in ENDS}
    for record in (task.info, task.physical):
        own |= {LAST + name: record[name] for name in names_of(record)}
    return own

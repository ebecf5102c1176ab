"""``settling="at_once"``: the step in which an agent is done goes on until its sheet has settled and is evaluated."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import one_of
from clothgym.envs import answers

if TYPE_CHECKING:
    from clothgym.envs.task import Task

SETTLING = ("steps", "at_once")


def check(task: Task) -> None:
    """Refuse a batch whose environments advance together.

    Raises:
        ValueError: that, or an unknown mode.
    """
    one_of("settling", task.settling, *SETTLING)
    if task.settling == "at_once" and not task.simulation.layout.by_particle:
        raise ValueError(
            f"settling='at_once': with {task.simulation.integrator.name} on this sheet environments advance together; take "
            "settling='steps', or a grid, or less than 16 environments, with an integrator in which the order of the springs does "
            "not matter"
        )


def settle(task: Task) -> None:
    """Take the sheets whose agents are done to their ends, one control step after the other; the step's reward is the sum.

    The others stand still meanwhile: a batch goes on when all of its agents can act again.
    """
    still = np.zeros((task.num_envs, *task.single_action_space.shape))
    while True:
        envs = np.flatnonzero((task.episode["settling_since"] >= 0) & ~task.episode["over"])
        if not len(envs):
            return
        with answers.added(task, envs):
            task.move(still, envs)


@contextmanager
def restricted_to(task: Task, envs: NDArray | None) -> Iterator[None]:
    """Within it only these environments take a step, if any are named.

    A task's own methods process the whole batch: their changes to the other environments are undone.
    """
    if envs is None:
        yield
        return
    still = np.ones(task.num_envs, bool)
    still[envs] = False
    # where each environment has a block, blocks and environments have the same numbers
    kept = [(array, array[still]) for array in (task.episode, task.info, task.simulation.orders.openings)]
    yield
    for array, values in kept:
        array[still] = values

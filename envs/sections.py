"""Sections of an environment's page that follow from its task alone: its physics, actions, rewards, end and options.

Each function returns the lines that stand on a page for a mark, see ``pages``.  Every number comes from where the code has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions import Plane
from clothgym.envs.draping import LETS_GO, let_go
from clothgym.envs.episode import BEYOND, EFFORT_PRICE, FAILURE_PENALTY, FAILURES, SUCCESS_BONUS, TWICE
from clothgym.envs.gripper_task import CLOSES, OPENS, GripperTask
from clothgym.envs.physics import MEASURED, Physics
from clothgym.envs.stepping import Kernels
from clothgym.envs.task import Task
from clothgym.material import PRESETS, Material

WIDTH = 124  # of a line of prose
FAILED = {
    "torn": f"a structural spring {TWICE:g} times as long as at rest",
    "out_of_bounds": f"the sheet's center {BEYOND:g} m beyond the arena, $room",
    "diverged": "not finite; the last finite observation goes out",
}
# what ``reset(options=...)`` takes
OPTIONS = {
    "material": "a preset's name or a dict of properties",
    "target": "a dict with any of ``shape``, ``radius``, ``height``, ``center``, ``yaw``",
    "rail": "a dict with any of ``height`` (of its axis) [m], ``center`` [m], ``yaw`` [rad]",
    "hook": "a dict with any of ``height`` (of the arm's root) [m], ``center`` (of the post) [m], ``yaw`` [rad]",
    "rumpled": "True or False",
    "goal": "three coordinates [m]",
}


def _prose(text: str) -> list[str]:
    return wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def _unmade(task_class: type[Task]) -> Any:
    """A task of which there is only what its class says."""
    return object.__new__(task_class)


def _has(task_class: type[Task], kernel: str) -> bool:
    """Whether a task gives this kernel, see ``Kernels``."""
    return getattr(task_class.kernels, kernel) is not Kernels._field_defaults[kernel]


# --- physics ------------------------------------------------------------------------------------------------------------------


def physics_of(task_class: type[Task]) -> list[str]:
    """What an id's physics is, and what ``physics="fast"`` makes of it."""
    physics, fast = task_class.physics, task_class.physics.chosen("fast")
    solids = _unmade(task_class).colliders()
    floor = all(isinstance(one, Plane) for one in solids)
    touched = f"the whole sheet touches {'the floor' if floor else 'solids'} and, strictly, itself" if solids else ""
    frictions = sorted({one.friction for one in solids})
    stopped = "the floor stops what grippers hold" if floor else "solids stop what moves the sheet"
    own = [
        _fabric(physics.material),
        *([f"friction {' to '.join(f'{one:g}' for one in (frictions[0], frictions[-1])[: len(frictions)])}"] if solids else []),
        _air(physics),
        *([stopped] if solids else []),
        f"{round(1 / physics.time_step)} Hz control",
        f"``{physics.integrator}`` with {_substeps(physics)}",
    ]
    short = [
        *(["contact of particles alone"] if solids else []),
        "none of the sheet with itself" if solids else "no self-collision",
        "skip springs without rigidity",
        *([_fabric(fast.material)] if fast.material != physics.material else []),
        *([_air(fast)] if fast.air_density != physics.air_density else []),
        *([_substeps(fast)] if fast.substeps != physics.substeps else []),
    ]
    moves = f"moves through {'wind' if physics.wind else 'air'}"
    return [
        *_prose(
            f"True physics: {touched or 'the cloth touches itself strictly'}, bends with its rigidity, and {moves}.  The id fixes "
            f"it: {'; '.join(own)}."
        ),
        "",
        *_prose(f'``physics="fast"`` has short cuts: {", ".join(short)}.'),
    ]


def _fabric(material: Material) -> str:
    """A preset's name, and what a hand would feel."""
    names = [name for name, one in PRESETS.items() if all(getattr(one, each) == getattr(material, each) for each in MEASURED)]
    name = f'``Material.preset("{names[0]}")``' if names else "a fabric"
    return f"{name} ({1e3 * material.density:.3g} g/m^2, rigidity {1e6 * material.bend_rigidity:.3g} uN m)"


def _air(physics: Physics) -> str:
    """How the air acts on the sheet."""
    linear = physics.material.air_drag / physics.material.density
    slow = f"a linear drag of {linear:.2g} per second" if linear else ""
    if not physics.air_density:
        return f"no air but {slow}" if slow else "no air"
    return "quadratic air" + (f" and {slow}" if slow else "")


def _substeps(physics: Physics) -> str:
    return "automatic substeps" if physics.substeps == "auto" else f"{physics.substeps} substeps"


# --- actions and rewards ------------------------------------------------------------------------------------------------------


def actions_of(task_class: type[Task], whom: str = "") -> list[str]:
    """The action space; whom: what it moves, "corner" for each of them, or of tasks whose actions are velocities alone all."""
    physics, each = task_class.physics, task_class.actions_per_attachment
    count = len(physics.held) + len(physics.grippers)
    fourth = f"let go for good, if above {LETS_GO:g}" if task_class.kernels.act is let_go else "its own"
    if issubclass(task_class, GripperTask):
        seconds = f"the fingers take {physics.grippers[0].closing_time:g} s"
        fourth, whom = f"close if below {CLOSES:g}, open if above {OPENS:g}, else go on as before; {seconds}", whom or "gripper"
    velocity = f"scaled by {physics.attachment_speed:g} m/s; a vector longer than 1 is shortened"
    if each == 3:
        return _prose(f"``Box(-1, 1, ({3 * count},))``: velocity x, y, z of {whom or 'each anchor'}, {velocity}.")
    firsts = [each * k for k in range(count)]
    rows = [
        f"``Box(-1, 1, ({each * count},))``; for each {whom or 'anchor'}:",
        "",
        "| Num | Action | Range | Unit |",
        "| --- | --- | --- | --- |",
        f"| {', '.join(f'{first}-{first + 2}' for first in firsts)} | velocity x, y, z, {velocity} | [-1, 1] | m/s |",
        f"| {', '.join(str(first + 3) for first in firsts)} | {fourth} | [-1, 1] | |",
    ]
    if issubclass(task_class, GripperTask):
        rows += ["", *_prose(_gripper(physics))]
    return rows


def _gripper(physics: Physics) -> str:
    return (
        "A gripper is a kinematic body with two fingers.  When these have closed it holds the particles within "
        f"{100 * physics.grippers[0].reach:g} cm of its tip, of all layers; when they begin to open it lets go.  It may take "
        "hold as often as it likes.  The fingers do not push the cloth.  The floor stops what a gripper holds, and while its "
        "fingers move it does not sink."
    )


def rewards_of(task_class: type[Task]) -> list[str]:
    """What the reward modes of all tasks mean."""
    return [
        *_prose(
            f'``reward_mode="delta"``: the change of a potential in [0, 1], less ``{EFFORT_PRICE:g} |a|^2`` for the motion and '
            f"{FAILURE_PENALTY:g} for a failure, plus {SUCCESS_BONUS:g} for a success.  At the end the potential is the normalized "
            "performance, at a failure 0.  So a return is that performance, less the potential at the start and these terms: doing "
            "nothing may return less than 0."
        ),
        '``reward_mode="sparse"``: the normalized performance, at the evaluation.',
    ]


# --- the end, and reset's options ---------------------------------------------------------------------------------------------


def episode_end_of(task_class: type[Task]) -> list[str]:
    """When an episode ends, and how it fails."""
    names = ", ".join(f'"{name}" ({FAILED[name]})' for name in FAILURES[1:]).replace("$room", _room(*_unmade(task_class).arena()))
    return _prose(
        f'Terminated when evaluated, {_time(task_class)}; or at a failure, which ``env.metadata["failures"]`` names by the code '
        f'``info["failure"]``: {names}.  Never truncated: the time limit is part of the task.'
    )


def _time(task_class: type[Task]) -> str:
    """How many steps an episode has; of tasks with a fold, ``acting``, by its name."""
    acting: Mapping[str, int] = getattr(task_class, "acting", {"": task_class.acting_steps})
    *others, last = [f'{steps} ("{name}")' if name else f"{steps} steps" for name, steps in acting.items()]
    listed = f"{', '.join(others)} or {last} steps," if others else last
    early = "when the agent is done, at the latest after " if _has(task_class, "done") else "after "
    return f"{early}{listed}" + (f" and {task_class.settling_steps} of settling" if task_class.settling_steps else "")


def _room(low: NDArray, high: NDArray) -> str:
    """The arena's corners [m] in words."""
    spans = [f"{a:.3g} to {b:.3g}" for a, b in np.stack([low, high], axis=1).tolist()]
    across = f"x and y from {spans[0]}" if spans[0] == spans[1] else f"x from {spans[0]}, y from {spans[1]}"
    return f"{across} and z from {spans[2]} m"


def options_of(task_class: type[Task]) -> list[str]:
    """What a reset takes."""
    each = [f'``"{name}"``' + (f", {OPTIONS[name]}" if name in OPTIONS else "") for name in task_class.reset_options]
    return _prose(f"``reset(options=...)`` takes, for one episode: {'; '.join(each)}.")

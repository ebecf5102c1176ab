"""Manual pages of environments, and the check for unknown keywords.

The docstring of an environment's class is its page.  When the class is created, each line that begins with one of ``MARKS`` is
replaced by the lines that the mark's function returns for the task; the rest of the line is the function's argument.  A page with
the mark ``$physics`` also gets the missing sections of ``STANDARD``, which follow from the task.  Numbers are read from the code.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
from collections.abc import Callable, Mapping
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions import Plane
from clothgym.envs.draping import RELEASE_ABOVE, let_go
from clothgym.envs.episode import BEYOND, EFFORT_PRICE, FAILURE_PENALTY, FAILURES, SUCCESS_BONUS, TWICE
from clothgym.envs.gripper_task import CLOSES, OPENS, GripperTask
from clothgym.envs.observing import Observation, points_observed
from clothgym.envs.physics import MEASURED, Physics
from clothgym.envs.pick_place import STEPS
from clothgym.envs.stepping import Kernels
from clothgym.envs.task import OPTIONS, Task
from clothgym.material import PRESETS, Material
from clothgym.registration import ENVIRONMENTS

if TYPE_CHECKING:
    from clothgym.envs.single import TaskHolder

# sections that are added to pages, and the order of all sections
STANDARD = {
    "Action Space": "$actions",
    "Observation Space": "$observations",
    "Episode End": "$episode_end",
    "Arguments": "$arguments\n\n$options",
    "Version History": "* v0: initial version",
}
ORDER = (
    "Description", "Action Space", "Observation Space", "Rewards", "Rewards and costs", "Evaluation", "Starting State",
    "Episode End", "Arguments", "Vectorized environment", "Version History",
)  # fmt: skip

WIDTH = 124  # of a line of prose
FAILED = {
    "torn": f"a structural spring {TWICE:g} times as long as at rest",
    "out_of_bounds": f"the sheet's center {BEYOND:g} m beyond the arena, $room",
    "diverged": "not finite; the last finite observation is returned",
}

# default and meaning of the keywords that all environments take; $name: the task's own
COMMON: dict[str, tuple[str, str]] = {
    "rows": ("$rows", "particles along a side of the sheet; another number implies automatic substeps"),
    "side": ("$side", "L, the length of a side [m]; another length implies automatic substeps"),
    "fabric": (
        "``None``",
        "the task's own; or a preset's name (``python -m clothgym list``), for its measured properties, or a ``Material``; "
        "implies automatic substeps",
    ),
    "integrator": ("``$integrator``", "or another, by name or ``{\"name\": ..., option: ...}``, with automatic substeps"),
    "substeps": ("$substeps", 'substeps of a control step, or ``"auto"``'),
    "physics": (
        '``"true"``',
        "whole-sheet contact with solids, strict self-collision, bending rigidity; "
        'or ``"fast"``: contact of particles only, no self-collision, skip springs instead of bending rigidity',
    ),
    "bending": ("``None``", 'set by ``physics``; or ``"springs"``, ``"hinge"``, ``"quadratic"``, see ``clothgym.bending``'),
    "strain_limit": (
        "``None``", 'largest strain, enforced by a limiter; ``info["strain_before_limiting"]`` is the strain before it',
    ),
    "self_collision": (
        "``None``",
        'set by ``physics``; or ``False``, ``"fast"``, ``"strict"``, with ``self_contacts`` and ``attachment_lag`` in ``info``',
    ),
    "contact": (
        "``None``", 'set by ``physics``; or ``"particles"``: only particles collide with solids, or ``"sheet"``: the whole sheet',
    ),
    "air_density": ("$air_density", "[kg/m^3], for drag and lift per triangle; 1.2 if ``wind`` is given"),
    "obs_mode": (
        '``"keypoints"``',
        'or ``"particles"``, ``"heightmap"``, ``"pointcloud"``, ``"rgb"``, ``"depth"``, ``"rgbd"``, see docs/observations.md',
    ),
    "image_size": ("64", "pixels along a side of the image"),
    "camera": (
        "``None``",
        'straight down on the working area; ``"task"``, the camera of videos; or the arguments of ``clothgym.render.Camera``, '
        '``{"eye": [0, -1, 1], "target": [0, 0, 0]}``',
    ),
    "num_points": ("256", "points of a point cloud"),
    "privileged": (
        "``False``", 'whether images come with the state vector: ``Dict(observation=image, state=the numbers of "keypoints")``',
    ),
    "reward_mode": ('``"delta"``', 'or ``"sparse"``'),
    "settling": (
        '``"steps"``',
        'or ``"at_once"``: the step in which the agent is done continues until the sheet has settled and is evaluated, and returns '
        "the sum of the rewards, so that no action is ignored; for sheets without holes, see docs/actions.md",
    ),
    "action_repeat": (
        "1", "control steps for which an action is held; rewards and costs are summed, and ``info`` is of the last one",
    ),
    "gamma": (
        "1", "or a learner's discount: a step that does not end the episode gives ``gamma Phi' - Phi`` of the potential, a neutral "
        "shaping (Ng et al. 1999)",
    ),
    "randomize": (
        "``{}``",
        'ranges from which each episode draws material properties, ``{"density": [0.1, 0.2]}``, $sized``friction``, '
        "``action_delay`` (control steps), ``action_noise`` and ``observation_noise`` (standard deviations), and the camera and "
        "colors of pictures; info has what was drawn",
    ),
    "wind": (
        "``None``", 'the arguments of ``clothgym.Wind``, ``{"speed": [0, 2], "gust": 0.5}``: adds drag and lift per triangle',
    ),
    "threads": ("1; in a batch all cores", "number of threads; results do not depend on it"),
    "render_mode": ("``None``", '``"rgb_array"``, ``"depth_array"``, or ``"human"`` through ``gym.make`` (extra ``human``)'),
    "width": ("480; in a batch 240", "width in pixels of a frame that ``render`` returns"),
    "height": ("480; in a batch 240", "its height in pixels"),
    "render_color": (
        '``"fabric"``',
        'or ``"strain"``: cream where no yarn is stretched, violet from $strain_shown % on; or ``"depth"``, in gray',
    ),
}  # fmt: skip


def keywords_of(task_class: type[Task]) -> dict[str, Any]:
    """Default of each keyword of a task, first its own, then those of all tasks."""
    found: dict[str, Any] = {}
    for cls in task_class.__mro__:
        if "__init__" not in vars(cls) or cls is object:
            continue
        for name, parameter in list(inspect.signature(vars(cls)["__init__"]).parameters.items())[1:]:
            if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) and name != "num_envs":
                found.setdefault(name, parameter.default)
    return found


def _takers(name: str) -> list[str]:
    """The first two ids whose tasks take a keyword."""
    from clothgym import envs  # imported here: it imports this module

    tasks = {env_id: getattr(envs, f"{start}Env").task_class for env_id, (start, _) in ENVIRONMENTS.items()}
    return [env_id for env_id, task_class in tasks.items() if name in keywords_of(task_class)][:2]


def check_keywords(env: TaskHolder, given: Mapping[str, Any]) -> None:
    """Refuse keywords that an environment's task does not take.

    Raises:
        TypeError: names the first of them, and all that there are.
    """
    own = [name for name in inspect.signature(type(env)).parameters if name != "kwargs"]
    known = [*keywords_of(env.task_class), *own]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            if others := _takers(name):
                hint = f", which {' and '.join(others)} take{'s' if len(others) == 1 else ''}"
            raise TypeError(
                f"{type(env).__name__} got an unexpected keyword argument {name!r}{hint} (there are: {', '.join(known)})"
            )


def completed(page: str | None, task_class: type[Task] | None) -> str | None:
    """A page with its sections and tables, or the task's docstring and both tables; the page unchanged if there is no task."""
    if task_class is None:
        return page
    if page is None:
        page = f"{task_class.__doc__ or task_class.__name__}\n\n## Observation Space\n$observations\n\n## Arguments\n$arguments\n"
    page, lines = inspect.cleandoc(page), []
    for line in (_whole(page) if "$physics" in page else page).split("\n"):
        mark, _, words = line.partition(" ")
        if mark not in MARKS:
            lines.append(line)
        else:
            lines += [row.rstrip() for row in (MARKS[mark](task_class, words) if words else MARKS[mark](task_class))]
    return "\n".join(lines)


def _whole(page: str) -> str:
    """Add the missing sections of ``STANDARD`` to a page, in the order of ``ORDER``."""
    first, *parts = re.split(r"\n(?=## )", page)
    found = {part.partition("\n")[0][3:]: part.strip() for part in parts}
    for heading in (heading for heading in STANDARD if heading not in found):
        later = ORDER[ORDER.index(heading) :]
        place = next((k for k, other in enumerate(found) if other in later), len(found))
        new = (heading, f"## {heading}\n{STANDARD[heading]}")
        found = dict([*list(found.items())[:place], new, *list(found.items())[place:]])
    return "\n\n".join([first.strip(), *found.values()])


def observations_of(task_class: type[Task]) -> list[str]:
    """The lines of the table of observations, under a sentence on their number."""
    mesh = task_class.physics.mesh
    points = len(_unmade(task_class).observed_particles(mesh))
    declared = [*points_observed(task_class, "keypoints", points), *task_class.observations]
    ends = np.cumsum([int(np.prod(one.shape)) for one in declared]).tolist()
    rows = [
        f'``Box`` of {ends[-1]} numbers for ``obs_mode="keypoints"`` (and 6 x {mesh.num_particles} + {ends[-1] - ends[1]} for',
        '``"particles"``, all particles row by row).  ``env.unwrapped.observation_slices["keypoints"]`` has their slices, by name.',
        'Or an image of ``image_size`` pixels a side: ``"heightmap"`` [L] and ``"depth"`` [m], ``float32``, one channel;',
        '``"rgb"``, ``uint8``; ``"rgbd"``, ``float32``, four channels; or a ``"pointcloud"`` [L], (``num_points``, 3).',
        "",
        "| Num | Name | Observation | Unit | Bound |",
        "| --- | --- | --- | --- | --- |",
    ]
    for one, first, end in zip(declared, [0, *ends], ends):
        place = str(first) if end == first + 1 else f"{first}-{end - 1}"
        rows.append(f"| {place} | ``{one.name}`` | {_about(one)} | {one.unit} | {_bound(one.bound)} |")
    return rows


def _about(one: Observation) -> str:
    """Description of an observation, with its shape if it has more than one axis."""
    return f"{one.about}, {' x '.join(map(str, one.shape))}" if len(one.shape) > 1 else one.about


def _bound(bound: float | tuple[float, ...]) -> str:
    return ", ".join(f"{each:g}" for each in np.atleast_1d(bound))


def arguments_of(task_class: type[Task]) -> list[str]:
    """The lines of the table of keywords: the task's own, then those of all tasks."""
    physics, rows = task_class.physics, ["| Argument | Default | Meaning |", "| --- | --- | --- |"]
    own = {
        "$rows": str(physics.mesh.shape[0]) if physics.mesh.shape else "",
        "$side": f"{physics.side:g}",
        "$integrator": f'"{physics.integrator}"',
        "$substeps": str(physics.substeps),
        "$air_density": f"{physics.air_density:g}",
        "$strain_shown": f"{100 * task_class.strain_shown:g}",
        "$sized": "``size``, " if task_class.resizes else "",
        "$direction": getattr(task_class, "direction", ""),
        "$picks": str(getattr(task_class, "picks", "")),
        "$throws": str(getattr(task_class, "throws", "")),
        "$rests": str(-(-task_class.settling_steps // STEPS)),
    }
    inherited = keywords_of(Task)
    defaults = {**keywords_of(task_class), **{name: None for name in ("render_mode", "render_color", "width", "height")}}
    for name, default in defaults.items():
        if name in ("rows", "side") and not physics.mesh.shape:
            continue  # a mesh that is no grid has one size
        shown, meaning = COMMON.get(name, ("", ""))
        if not shown or (name in inherited and default != inherited[name]):  # a task may have another default than all others
            shown = f"``{json.dumps(default) if isinstance(default, str) else repr(default)}``"
        row = f"| ``{name}`` | {shown} | {task_class.arguments.get(name, meaning)} |"
        for mark, text in own.items():
            row = row.replace(mark, text)
        rows.append(row)
    return rows


def _prose(text: str) -> list[str]:
    return wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def _unmade(task_class: type[Task]) -> Any:
    """An instance without ``__init__``, for attributes of the class."""
    return object.__new__(task_class)


def _has(task_class: type[Task], kernel: str) -> bool:
    """Whether a task gives this kernel, see ``Kernels``."""
    return getattr(task_class.kernels, kernel) is not Kernels._field_defaults[kernel]


# --- physics ------------------------------------------------------------------------------------------------------------------


def physics_of(task_class: type[Task]) -> list[str]:
    """Description of an id's physics, and of the simplifications of ``physics="fast"``."""
    physics, fast = task_class.physics, task_class.physics.chosen("fast")
    solids = _unmade(task_class).colliders()
    floor = all(isinstance(one, Plane) for one in solids)
    others = "the floor" if floor else "solids"
    touched = f"the whole sheet collides with {others} and, in strict mode, with itself" if solids else ""
    frictions = sorted({one.friction for one in solids})
    stopped = "the floor stops grippers and held cloth" if floor else "solids stop anchors, grippers and held cloth"
    own = [
        _fabric(physics.material),
        *([f"friction {' to '.join(f'{one:g}' for one in (frictions[0], frictions[-1])[: len(frictions)])}"] if solids else []),
        _air(physics),
        *([stopped] if solids else []),
        f"{round(1 / physics.time_step)} Hz control",
        f"``{physics.integrator}`` with {_substeps(physics)}",
    ]
    short = [
        *(["contact of particles only"] if solids else []),
        "no self-collision",
        "skip springs instead of bending rigidity",
        *([_fabric(fast.material)] if fast.material != physics.material else []),
        *([_air(fast)] if fast.air_density != physics.air_density else []),
        *([_substeps(fast)] if fast.substeps != physics.substeps else []),
    ]
    moves = f"moves through {'wind' if physics.wind else 'air'}"
    return [
        *_prose(
            f"True physics: {touched or 'the sheet collides with itself in strict mode'}, bends with its rigidity, and {moves}.  "
            f"The id's settings: {'; '.join(own)}."
        ),
        "",
        *_prose(f'Simplifications of ``physics="fast"``: {", ".join(short)}.'),
    ]


def _fabric(material: Material) -> str:
    """A fabric preset, with its density and bending rigidity."""
    names = [name for name, one in PRESETS.items() if all(getattr(one, each) == getattr(material, each) for each in MEASURED)]
    name = f'``Material.preset("{names[0]}")``' if names else "a fabric"
    return f"{name} ({1e3 * material.density:.3g} g/m^2, rigidity {1e6 * material.bend_rigidity:.3g} uN m)"


def _air(physics: Physics) -> str:
    """Description of the air's drag."""
    linear = physics.material.air_drag / physics.material.density
    slow = f"a linear drag of {linear:.2g} per second" if linear else ""
    if not physics.air_density:
        return f"no air but {slow}" if slow else "no air"
    return "quadratic air drag" + (f" and {slow}" if slow else "")


def _substeps(physics: Physics) -> str:
    return "automatic substeps" if physics.substeps == "auto" else f"{physics.substeps} substeps"


# --- actions and rewards ------------------------------------------------------------------------------------------------------


def actions_of(task_class: type[Task], whom: str = "") -> list[str]:
    """The action space; whom: the name of one attachment, such as "corner"; if actions are only velocities, of all of them."""
    physics, each = task_class.physics, task_class.actions_per_attachment
    count = len(physics.held) + len(physics.grippers)
    fourth = f"release for good, if above {RELEASE_ABOVE:g}" if task_class.kernels.act is let_go else "its own"
    if issubclass(task_class, GripperTask):
        seconds = f"the fingers take {physics.grippers[0].closing_time:g} s"
        fourth, whom = f"close if below {CLOSES:g}, open if above {OPENS:g}, else continue; {seconds}", whom or "gripper"
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
        "A gripper is a kinematic body with two fingers.  When the fingers have closed it holds the particles within "
        f"{100 * physics.grippers[0].reach:g} cm of its tip, of all layers; when they begin to open it releases them.  The "
        "fingers do not push the cloth.  The floor stops held cloth, and a gripper does not sink "
        "while its fingers move."
    )


def rewards_of(task_class: type[Task]) -> list[str]:
    """The reward modes of all tasks."""
    return [
        *_prose(
            f'``reward_mode="delta"``: the change of a potential in [0, 1], less ``{EFFORT_PRICE:g} |a|^2`` for the motion and '
            f"{FAILURE_PENALTY:g} for a failure, plus {SUCCESS_BONUS:g} for a success.  At the end the potential is the normalized "
            "performance, at a failure 0.  A return is therefore the final performance minus the potential at the start, plus "
            "these terms: doing nothing may return less than 0."
        ),
        '``reward_mode="sparse"``: the normalized performance, at the evaluation.',
    ]


# --- the end, and reset's options ---------------------------------------------------------------------------------------------


def episode_end_of(task_class: type[Task]) -> list[str]:
    """The end of an episode, and its failures."""
    names = ", ".join(f'"{name}" ({FAILED[name]})' for name in FAILURES[1:]).replace("$room", _room(*_unmade(task_class).arena()))
    return _prose(
        f'Terminated when evaluated, {_time(task_class)}; or at a failure.  ``info["failure"]`` is its code, and '
        f'``env.metadata["failures"]`` has the names of the codes: {names}.  Never truncated: the time limit is part of the task.'
    )


def _time(task_class: type[Task]) -> str:
    """Number of steps of an episode; for tasks with ``acting`` the number for each fold."""
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
    """The options of ``reset``."""
    each = [f'``"{name}"``' + (f", {OPTIONS[name]}" if name in OPTIONS else "") for name in task_class.reset_options]
    return _prose(f"``reset(options=...)`` takes, for one episode: {'; '.join(each)}.")


MARKS: dict[str, Callable[..., list[str]]] = {
    "$observations": observations_of,
    "$arguments": arguments_of,
    "$physics": physics_of,
    "$actions": actions_of,
    "$rewards": rewards_of,
    "$episode_end": episode_end_of,
    "$options": options_of,
}

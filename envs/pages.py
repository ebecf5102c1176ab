"""What an environment's page says of its task's observations and keywords, and the refusal of keywords that there are not.

A class's docstring is its page.  Lines in it that begin with a mark are replaced when the class is made, by what follows from the
task: ``$observations`` by the table of its observations, ``$arguments`` by that of its keywords, and those of ``MARKS``, some with
words of their own, by what ``sections`` says.
"""

from __future__ import annotations

import difflib
import inspect
import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from clothgym.envs import sections
from clothgym.envs.definition import Observation, points_observed
from clothgym.envs.pick_place import STEPS
from clothgym.envs.task import Task

if TYPE_CHECKING:
    from clothgym.envs.single import ClothEnv
    from clothgym.envs.vector import ClothVectorEnv

# default and meaning of the keywords that all environments take; $name: the task's own
COMMON: dict[str, tuple[str, str]] = {
    "rows": ("$rows", "particles along a side of the sheet; of another number with automatic substeps"),
    "side": ("$side", "L, the length of a side [m], likewise"),
    "fabric": (
        "``None``",
        "the task's own; or a preset's name (``python -m clothgym list``), whose measured properties it takes, or a ``Material``; "
        "then with automatic substeps",
    ),
    "integrator": ("``$integrator``", "or another, by name or ``{\"name\": ..., option: ...}``, with automatic substeps"),
    "substeps": ("$substeps", 'substeps of a control step, or ``"auto"``'),
    "physics": (
        '``"true"``',
        "whole-sheet contact with solids, strict contact with itself, rigidity; "
        'or ``"fast"``: contact with particles alone, none of the sheet with itself, skip springs in the place of rigidity',
    ),
    "bending": ("``None``", 'that of ``physics``; or ``"springs"``, ``"hinge"``, ``"quadratic"``, see ``clothgym.bending``'),
    "strain_limit": (
        "``None``", 'largest strain, kept by a limiter; ``info["strain_before_limiting"]`` is what it met',
    ),
    "self_collision": (
        "``None``",
        'that of ``physics``; or ``False``, ``"fast"``, ``"strict"``, with ``self_contacts`` and ``attachment_lag`` in ``info``',
    ),
    "contact": (
        "``None``", 'that of ``physics``; what touches solids: ``"particles"``, or ``"sheet"``, the whole sheet',
    ),
    "air_density": ("$air_density", "[kg/m^3], of drag and lift per triangle; 1.2 where ``wind`` is given"),
    "obs_mode": (
        '``"keypoints"``',
        'or ``"particles"``, ``"heightmap"``, ``"pointcloud"``, ``"rgb"``, ``"depth"``, ``"rgbd"``, see docs/observations.md',
    ),
    "image_size": ("64", "pixels of a picture's side"),
    "camera": (
        "``None``",
        'straight down on the working area; ``"task"``, that of the films; or what ``clothgym.render.Camera`` takes, '
        '``{"eye": [0, -1, 1], "target": [0, 0, 0]}``',
    ),
    "num_points": ("256", "points of a point cloud"),
    "privileged": (
        "``False``", 'whether a picture comes with the state: ``Dict(observation=picture, state=the numbers of "keypoints")``',
    ),
    "reward_mode": ('``"delta"``', 'or ``"sparse"``'),
    "settling": (
        '``"steps"``',
        'or ``"at_once"``: the step in which the agent is done goes on until the sheet has settled and is evaluated, and brings '
        "the rewards of all of it, so that no action is ignored; for sheets without holes, see docs/actions.md",
    ),
    "randomize": ("``{}``", 'ranges of material properties drawn at reset, ``{"density": [0.1, 0.2]}``'),
    "wind": ("``None``", 'what ``clothgym.Wind`` takes, ``{"speed": [0, 2], "gust": 0.5}``: adds drag and lift per triangle'),
    "threads": ("1; in a batch all processors", "the outcome does not depend on it"),
    "render_mode": ("``None``", '``"rgb_array"``, ``"depth_array"``, or ``"human"`` through ``gym.make`` (extra ``human``)'),
    "width": ("480; in a batch 240", "pixels of a frame that ``render`` returns"),
    "height": ("480; in a batch 240", "likewise"),
    "render_color": (
        '``"fabric"``',
        'or ``"strain"``: cream where no yarn is stretched, violet from $strain_shown % on; or ``"depth"``, in gray',
    ),
}  # fmt: skip


def keywords_of(task_class: type[Task]) -> dict[str, Any]:
    """Default of each keyword that a task takes, its own before those of all tasks."""
    found: dict[str, Any] = {}
    for cls in task_class.__mro__:
        if "__init__" not in vars(cls) or cls is object:
            continue
        for name, parameter in list(inspect.signature(vars(cls)["__init__"]).parameters.items())[1:]:
            if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) and name != "num_envs":
                found.setdefault(name, parameter.default)
    return found


def check_keywords(env: ClothEnv | ClothVectorEnv, given: Mapping[str, Any]) -> None:
    """Refuse keywords that an environment's task does not take.

    Raises:
        TypeError: names the first of them, and all that there are.
    """
    own = [name for name in inspect.signature(type(env).__init__).parameters if name not in ("self", "kwargs")]
    known = [*keywords_of(env.task_class), *own]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise TypeError(
                f"{type(env).__name__} got an unexpected keyword argument {name!r}{hint} (there are: {', '.join(known)})"
            )


def completed(page: str | None, task_class: type[Task] | None) -> str | None:
    """A page with its tables; the task's docstring above both where there is no page, and nothing where there is no task."""
    if task_class is None:
        return page
    if page is None:
        page = f"{task_class.__doc__ or task_class.__name__}\n\n## Observation Space\n$observations\n\n## Arguments\n$arguments\n"
    lines = []
    for line in page.split("\n"):
        indent = line[: len(line) - len(line.lstrip())]
        mark, _, words = line.strip().partition(" ")
        if mark not in MARKS:
            lines.append(line)
            continue
        rows = MARKS[mark](task_class, words) if words else MARKS[mark](task_class)
        lines += [(indent + row).rstrip() for row in rows]
    return "\n".join(lines)


def observations_of(task_class: type[Task]) -> list[str]:
    """The lines of the table of observations, under a sentence on their number."""
    mesh = task_class.physics.mesh
    points = len(task_class.observed_particles(mesh))
    declared = [*points_observed(task_class, "keypoints", points), *task_class.observations]
    ends = np.cumsum([int(np.prod(one.shape)) for one in declared]).tolist()
    rows = [
        f'``Box`` of {ends[-1]} numbers for ``obs_mode="keypoints"`` (and 6 x {mesh.num_particles} + {ends[-1] - ends[1]} for',
        '``"particles"``, all particles row by row).  ``env.unwrapped.observation_slices["keypoints"]``: where they lie, by name.',
        'Or a picture of ``image_size`` pixels a side: ``"heightmap"`` [L] and ``"depth"`` [m], ``float32``, of one channel;',
        '``"rgb"``, ``uint8``; ``"rgbd"``, ``float32``, of four; or a ``"pointcloud"`` [L], (``num_points``, 3).',
        "",
        "| Num | Name | Observation | Unit | Bound |",
        "| --- | --- | --- | --- | --- |",
    ]
    for one, first, end in zip(declared, [0, *ends], ends):
        place = str(first) if end == first + 1 else f"{first}-{end - 1}"
        rows.append(f"| {place} | ``{one.name}`` | {_about(one)} | {one.unit} | {_bound(one.bound)} |")
    return rows


def _about(one: Observation) -> str:
    """What it is, with its shape if it has more than one axis."""
    return f"{one.about}, {' x '.join(map(str, one.shape))}" if len(one.shape) > 1 else one.about


def _bound(bound: float | tuple[float, ...]) -> str:
    return ", ".join(f"{each:g}" for each in np.atleast_1d(bound))


def arguments_of(task_class: type[Task]) -> list[str]:
    """The lines of the table of keywords: the task's own, then those of all tasks."""
    physics, rows = task_class.physics, ["| Argument | Default | Meaning |", "| --- | --- | --- |"]
    own = {
        "$rows": str(physics.mesh.shape[0]) if physics.mesh.shape else "–",
        "$side": f"{physics.side:g}",
        "$integrator": f'"{physics.integrator}"',
        "$substeps": str(physics.substeps),
        "$air_density": f"{physics.air_density:g}",
        "$strain_shown": f"{100 * task_class.strain_shown:g}",
        "$picks": str(getattr(task_class, "picks", "")),
        "$rests": str(-(-task_class.settling_steps // STEPS)),
    }
    inherited = keywords_of(Task)
    defaults = {**keywords_of(task_class), **{name: None for name in ("render_mode", "render_color", "width", "height")}}
    for name, default in defaults.items():
        shown, meaning = COMMON.get(name, ("", ""))
        if not shown or (name in inherited and default != inherited[name]):  # a task may have another default than all others
            shown = f"``{json.dumps(default) if isinstance(default, str) else repr(default)}``"
        row = f"| ``{name}`` | {shown} | {task_class.arguments.get(name, meaning)} |"
        for mark, text in own.items():
            row = row.replace(mark, text)
        rows.append(row)
    return rows


MARKS: dict[str, Callable[..., list[str]]] = {
    "$observations": observations_of,
    "$arguments": arguments_of,
    "$physics": sections.physics_of,
    "$actions": sections.actions_of,
    "$rewards": sections.rewards_of,
    "$episode_end": sections.episode_end_of,
    "$options": sections.options_of,
}

"""The Gymnasium environment, a task as a batch of one; and the common base of it and the vector environment."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, combinations
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym.checks import numbers
from clothgym.envs.episode import FAILURES, TaskState
from clothgym.envs.hooks import expert
from clothgym.envs.observing import mesh_edges
from clothgym.envs.pages import check_keywords, completed
from clothgym.envs.pictures import RENDER_MODES, check_render_mode, checked_frame_size, draw, frames_a_second, renderer_of
from clothgym.envs.task import Task
from clothgym.exclusive import CallGuard, exclusive
from clothgym.registration import ENVIRONMENTS
from clothgym.warning import warn_caller

IMAGE_SIZE = 480

# for ``gymnasium.utils.play``: what each key adds to an attachment's action, velocity along x, y and z and what comes after it, by
# which o opens, or lets go, and c closes
KEYS = {
    "d": (1, 0, 0, 0), "a": (-1, 0, 0, 0),
    "w": (0, 1, 0, 0), "s": (0, -1, 0, 0),
    "e": (0, 0, 1, 0), "q": (0, 0, -1, 0),
    "o": (0, 0, 0, 1), "c": (0, 0, 0, -1),
}  # fmt: skip


class TaskHolder:
    """What single and vector environments share: a task, and how it is drawn."""

    task_class: ClassVar[type[Task]]
    metadata: dict[str, Any]

    def _hold(
        self, num_envs: int, render_mode: str | None, render_color: str, size: tuple[int, int], kwargs: Mapping[str, Any]
    ) -> None:
        """Make the task with its keywords, when what concerns pictures has been checked."""
        check_keywords(self, kwargs)
        check_render_mode(render_mode, render_color)
        self.render_mode, self.render_color = render_mode, render_color
        self.frame_size = checked_frame_size(*size)
        self.task = self.task_class(num_envs, **kwargs)
        self.metadata = {**self.metadata, "render_fps": frames_a_second(self.task.step_seconds)}
        self._renderer: Any = None

    @property
    def turn(self) -> CallGuard:
        """Of the task: one thread at a time is in the environment."""
        return self.task.turn

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Where each observation lies in an environment's state vector, by its name on the page."""
        return dict(self.task.observation_slices)

    @property
    def task_description(self) -> str:
        """The task as a sentence, for policies conditioned on language: as its id is registered, or its docstring's first line."""
        registered = dict(ENVIRONMENTS.values()).get(type(self).__name__.removesuffix("Env").removesuffix("Vector"))
        return registered or (self.task_class.__doc__ or "").strip().partition("\n")[0]

    @property
    def mesh_edges(self) -> NDArray[np.int64]:
        """Particles at the ends of the structural springs, (edges, 2), for graph networks."""
        return mesh_edges(self.task.physics.mesh)

    def __getattr__(self, name: str) -> Any:
        where = ": it is env.unwrapped.task.simulation" if name == "simulation" else ""
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{where}")

    def __getstate__(self) -> dict[str, Any]:
        """What a copy or a pickle holds: all but the renderer, which is made when it is needed."""
        return vars(self) | {"_renderer": None}

    def get_state(self) -> TaskState:
        """All that is needed to continue the episodes bit for bit."""
        return self.task.get_state()

    def set_state(self, state: TaskState) -> None:
        """Continue from what ``get_state`` returned, here or in another environment, or batch, of the same kind and size."""
        self.task.set_state(state)


class ClothEnv(TaskHolder, gym.Env[Any, NDArray]):
    """Base of the single environments; a subclass names its ``Task``, and its docstring is completed by ``pages``.

    ``copy.deepcopy`` and ``pickle`` take an environment in the middle of an episode; the copy goes on with the same bits.
    """

    # failures: names of the codes in ``info["failure"]``
    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 30, "failures": FAILURES}  # noqa: RUF012 - Gymnasium's

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        task_class = getattr(cls, "task_class", None)
        cls.__doc__ = completed(cls.__doc__, task_class)
        if task_class is not None:
            cls.metadata = cls.metadata | {"render_fps": frames_a_second(task_class.physics.time_step)}

    def __init__(
        self,
        render_mode: str | None = None,
        render_color: str = "fabric",
        width: int = IMAGE_SIZE,
        height: int = IMAGE_SIZE,
        **kwargs: Any,
    ) -> None:
        self._hold(1, render_mode, render_color, (width, height), {"threads": 1, **kwargs})
        self.observation_space = self.task.observed.space
        self.action_space = self.task.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.task.reset(np.array([0]), [seed], options)
        return self.task.observed.one(0), self.task.info_of(0)

    @exclusive
    def step(self, action: NDArray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if type(action) is not np.ndarray or action.shape != self.action_space.shape:
            action = numbers("action", action, self.action_space.shape)  # type: ignore[arg-type]
        task = self.task
        task.advance(action[None])
        reward, terminated, *_ = task.outcome[0].item()
        brought = task.observed.one(0), reward, terminated, False, task.info_of(0)
        self.turn.unfinished = ()
        return brought

    # what Gymnasium's own np_random and np_random_seed read and write: the generator from which the environment draws its episodes

    @property
    def _np_random(self) -> np.random.Generator | None:  # type: ignore[override]
        return None if self._np_random_seed is None else self.task.generators[0]

    @_np_random.setter
    def _np_random(self, value: Any) -> None:
        self.task.generators.put([value])

    @property
    def _np_random_seed(self) -> int | None:  # type: ignore[override]
        return self.task.generators.seeds[0]

    @_np_random_seed.setter
    def _np_random_seed(self, value: Any) -> None:
        self.task.generators.seeds[0] = value

    def get_keys_to_action(self) -> dict[str, NDArray]:
        """For ``gymnasium.utils.play``: the action of every set of ``KEYS``, all attachments at once.

        Also of none: ``play`` does not know how to keep still in a box of numbers.
        """
        attachments, numbers = self.task.num_attachments, self.task.actions_per_attachment
        keys = [key for key, change in KEYS.items() if any(change[:numbers])]
        sets = chain.from_iterable(combinations(keys, count) for count in range(len(keys) + 1))
        sums = {"".join(held): np.array([KEYS[key] for key in held], np.float32).reshape(-1, 4).sum(axis=0) for held in sets}
        return {held: np.tile(change[:numbers], attachments) for held, change in sums.items()}

    def expert_action(self) -> NDArray:
        """What the task's scripted expert does now; it sees the whole state."""
        return expert(self.task)[0]

    def render(self) -> NDArray | None:  # type: ignore[override]
        if self.render_mode is None:
            warn_caller("render() without a render_mode does nothing; use gym.make(..., render_mode='rgb_array')")
            return None
        if self._renderer is None:
            self._renderer = renderer_of(self.task, *self.frame_size)
        return draw(self.task, self._renderer, self.render_mode, [0], self.render_color)[0]

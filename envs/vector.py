"""The native vector environment: a task as a batch of many, stepped in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from clothgym.checks import count, mask, shown
from clothgym.envs.episode import FAILURES, batch_seeds
from clothgym.envs.hooks import expert
from clothgym.envs.pictures import RENDER_MODES, draw, renderer_of
from clothgym.envs.single import ClothEnv, TaskHolder
from clothgym.exclusive import exclusive

IMAGE_SIZE = 240


class ClothVectorEnv(TaskHolder, VectorEnv):
    """Base of the vector environments; a subclass names its ``Task``.

    Args:
        num_envs: environments in the batch; environment ``i`` of a batch seeded ``s`` equals a single one seeded ``s + i``.
        autoreset_mode: "NextStep" (Gymnasium's default), "SameStep" or "Disabled", or an ``AutoresetMode``.  With "Disabled" an
            environment that is over gives its last answer, with a reward of zero, until ``reset`` begins it again; a wrapper that
            counts ends, as ``RecordEpisodeStatistics``, is to be reset before it counts one twice.
        render_mode: None, "rgb_array" or "depth_array"; ``render`` returns one frame an environment.
        render_color: "fabric", or "strain" or "depth" for their colors.
        width, height: of a frame [pixels].
        max_episode_steps: steps after which an episode is truncated, as by Gymnasium's ``TimeLimit``; None for the task's own end.
        kwargs: those of the task, see the page of the single environment.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "failures": FAILURES}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_color: str = "fabric",
        width: int = IMAGE_SIZE,
        height: int = IMAGE_SIZE,
        max_episode_steps: int | None = None,
        **kwargs: Any,
    ) -> None:
        self.num_envs = count("num_envs", num_envs)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except (ValueError, TypeError):  # TypeError: what cannot even be compared
            known = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode={shown(autoreset_mode)}: must be one of {known}") from None
        self.max_episode_steps = None if max_episode_steps is None else count("max_episode_steps", max_episode_steps, "None, or ")
        self._hold(self.num_envs, render_mode, render_color, (width, height), kwargs)
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.single_observation_space = self.task.observed.space
        self.single_action_space = self.task.single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes in all environments, or in those of ``options["reset_mask"]``, (num_envs,) of bool."""
        if not isinstance(options, Mapping | None):
            raise ValueError(f"reset options={shown(options)}: must be a dict, or None")
        options = dict(options or {})
        reset = mask("options['reset_mask']", options.pop("reset_mask", np.ones(self.num_envs, bool)), self.num_envs)
        seeds, envs = batch_seeds(seed, self.num_envs), np.flatnonzero(reset)
        self.task.reset(envs, [seeds[env] for env in envs], options)
        return self.task.observed.batch(), _with_masks(_only(self.task.infos(), reset), reset)

    @exclusive
    def step(self, actions: NDArray) -> tuple[Any, NDArray, NDArray, NDArray, dict[str, Any]]:
        """One control step of the batch; what happens to environments that are over depends on the autoreset mode."""
        task, everyone = self.task, np.ones(self.num_envs, bool)
        over, final = task.episode["over"].copy(), {}
        task.advance(actions)
        self._truncate(over)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            # those that ended in the last step begin again in this one: their actions were ignored
            task.reset(np.flatnonzero(over))
        reward, terminated, truncated = (task.outcome[name].copy() for name in ("reward", "terminated", "truncated"))
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            final = self._reset_ended(terminated | truncated)
        info = _with_masks(task.infos(), everyone) | final
        brought = self.task.observed.batch(), reward, terminated, truncated, info
        self.turn.unfinished = ()
        return brought

    def _truncate(self, over: NDArray) -> None:
        """End the episodes that have reached ``max_episode_steps`` in this step; over: those that had ended before it.

        Without that nothing is truncated: the time limit is part of the tasks.
        """
        if self.max_episode_steps is None:
            return
        truncated = ~over & (self.task.steps_taken() >= self.max_episode_steps)
        self.task.outcome["truncated"] |= truncated
        self.task.episode["over"] |= truncated

    def _reset_ended(self, ended: NDArray) -> dict[str, Any]:
        """Same-step mode: begin again; what was last, as ``final_info`` and ``final_obs``."""
        if not ended.any():
            return {}
        last = np.full(self.num_envs, None, dtype=object)
        for env in np.flatnonzero(ended):
            last[env] = self.task.observed.one(int(env))
        final = {"final_info": _with_masks(_only(self.task.infos(), ended), ended), "final_obs": last}
        self.task.reset(np.flatnonzero(ended))
        return _with_masks(final, ended)

    def render(self) -> tuple[NDArray, ...] | None:
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = renderer_of(self.task, *self.frame_size, antialias=1)
        return tuple(draw(self.task, self._renderer, self.render_mode, list(range(self.num_envs)), self.render_color))

    # --- what users of Gymnasium's own vector environments rely on ------------------------------------------------------

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method, or read an attribute, of the batch on behalf of each environment."""
        value = getattr(self, name)
        result = value(*args, **kwargs) if callable(value) else value
        each = name in ("render", "expert_actions", "np_random", "np_random_seed") and result is not None
        return tuple(result) if each else (result,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of the batch; a list must hold one value, the same for all environments."""
        if isinstance(values, (list, tuple)):
            if any(value != values[0] for value in values):
                raise ValueError(f"{name} belongs to the whole batch: {values!r} must be one value")
            values = values[0]
        setattr(self, name, values)

    @property  # type: ignore[override]
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The generators from which the environments draw their episodes, one each, as Gymnasium's own batches have them."""
        return tuple(self.task.generators.of(env) for env in range(self.num_envs))

    @np_random.setter
    def np_random(self, value: Any) -> None:
        self.task.generators.put(value)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Their seeds; -1 where a generator's is not known, as after ``set_state``."""
        return tuple(self.task.generators.seeds[env] for env, _ in enumerate(self.np_random))

    def expert_actions(self) -> NDArray:
        """What the task's scripted expert does now, (num_envs, actions)."""
        return expert(self.task)


def batched(env_class: type[ClothEnv]) -> type[ClothVectorEnv]:
    """The batch of a single environment's task: ``ClothReachVectorEnv`` of ``ClothReachEnv``, with its other bases."""
    name = env_class.__name__.removesuffix("Env") + "VectorEnv"
    others = [base for base in env_class.__bases__ if base is not ClothEnv]
    about = f"The task of ``{env_class.__name__}`` as a batch."
    own = {"__doc__": about, "__module__": env_class.__module__.rpartition(".")[0], "task_class": env_class.task_class}
    return type(name, (*others, ClothVectorEnv), own)


def _only(info: dict[str, Any], mask: NDArray) -> dict[str, Any]:
    """The info of some environments; the others' entries are zero, false or empty, as Gymnasium leaves them."""
    return {key: np.where(mask, value, np.zeros((), value.dtype)) for key, value in info.items()}


def _with_masks(info: dict[str, Any], mask: NDArray) -> dict[str, Any]:
    """Gymnasium's vector info: each entry together with a mask ``_key`` of its environments."""
    return info | {f"_{key}": mask.copy() for key in info}

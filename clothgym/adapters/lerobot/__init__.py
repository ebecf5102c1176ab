"""LeRobot: ``make_env`` as EnvHub calls it, and observations under LeRobot's names.  Neither needs LeRobot itself.

LeRobot's evaluator, ``lerobot-eval``, loads ``make_env`` from a file ``env.py`` of a hub repository, or finds the environments by
``--env.discover_packages_path=clothgym.adapters.lerobot --env.type=clothgym``, see ``config``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from clothgym.checks import count
from clothgym.envs.episode import BEYOND
from clothgym.envs.observing import PICTURES
from clothgym.envs.task import Task
from clothgym.envs.vector import ClothVectorEnv
from clothgym.registration import checked_id

# features of LeRobot's data sets and policies, by the keys of an environment's observation; others are "observation.KEY"
FEATURES = {
    "agent_pos": "observation.state",
    "environment_state": "observation.environment_state",
    "pixels": "observation.image",
}
FRAME = 240  # side of a film's frame [pixels]


def feature(key: str) -> str:
    """LeRobot's name of an entry of an observation."""
    return FEATURES.get(key, f"observation.{key}")


def agent_positions(task: Task) -> NDArray[np.float32]:
    """Position of each attachment [m], and then the opening of each gripper from 0 to 1, (num_envs, numbers)."""
    simulation = task.simulation
    positions = simulation.attachment_positions.reshape(task.num_envs, -1)
    return np.concatenate([positions, simulation.grippers.openings], axis=1).astype(np.float32)


def agent_space(task: Task) -> gym.spaces.Box:
    """The space of one environment's ``agent_positions``: the arena with a margin, as solids deflect grippers; the openings."""
    low, high = task.arena()
    grippers = len(task.physics.grippers)
    least = np.append(np.tile(low - BEYOND, task.num_attachments), np.zeros(grippers))
    greatest = np.append(np.tile(high + BEYOND, task.num_attachments), np.ones(grippers))
    return gym.spaces.Box(least.astype(np.float32), greatest.astype(np.float32), dtype=np.float32)


def agent_names(task: Task) -> list[str]:
    """Names of the numbers of ``agent_positions``."""
    grippers = range(task.num_attachments - len(task.physics.grippers), task.num_attachments)
    positions = [f"attachment_{k}_{axis}" for k in range(task.num_attachments) for axis in "xyz"]
    return positions + [f"attachment_{k}_opening" for k in grippers]


def named(obs_mode: str, observation: Any, agent_pos: NDArray) -> dict[str, NDArray]:
    """An observation by LeRobot's keys, with any leading axes.

    obs_mode, observation: as the environment gives them.  agent_pos: of ``agent_positions``.  Returns ``agent_pos`` and, of
    state vectors, ``environment_state``, with the goals at its end; of pictures, ``pixels`` (rgb) or an entry with the mode's name,
    and with ``privileged=True`` the ``environment_state``.
    """
    parts = dict(observation) if isinstance(observation, Mapping) else {"observation": observation}
    main = parts.pop("observation")
    if obs_mode not in PICTURES:
        return {"agent_pos": agent_pos, "environment_state": np.concatenate([main, *parts.values()], axis=-1)}
    keys = {"state": "environment_state"}
    shown = {"pixels" if obs_mode == "rgb" else obs_mode: main}
    return {"agent_pos": agent_pos} | shown | {keys.get(key, key): part for key, part in parts.items()}


class LeRobotVectorEnv(VectorWrapper):
    """A batch as LeRobot's evaluator steps it: dictionaries of observations, and ``call`` for what it asks of each environment.

    Attributes:
        task: the id.
        task_description: the task as a sentence.
    """

    env: ClothVectorEnv

    def __init__(self, env: ClothVectorEnv, env_id: str) -> None:
        super().__init__(env)
        self.task, self.task_description = env_id, env.task_description
        self._max_episode_steps = env.max_episode_steps or env.task.most_steps()
        space, agent, mode = env.single_observation_space, agent_space(env.task), env.task.obs_mode
        low, high = (named(mode, _ends(space, end), getattr(agent, end)) for end in ("low", "high"))
        boxes = {key: gym.spaces.Box(low[key], high[key], dtype=low[key].dtype.type) for key in low}
        self.single_observation_space = gym.spaces.Dict(boxes)  # type: ignore[arg-type]
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def _named(self, observation: Any) -> dict[str, NDArray]:
        return named(self.env.task.obs_mode, observation, agent_positions(self.env.task))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._named(observation), info

    def step(self, actions: Any) -> tuple[Any, NDArray, NDArray, NDArray, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        return self._named(observation), reward, terminated, truncated, info

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """An attribute of the wrapper, or of the batch, for each environment."""
        return (getattr(self, name),) * self.num_envs if name in vars(self) else self.env.call(name, *args, **kwargs)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)


def _ends(space: gym.Space, end: str) -> Any:
    """The lowest or highest observation of a space."""
    if isinstance(space, gym.spaces.Dict):
        return {key: getattr(one, end) for key, one in space.spaces.items()}
    return getattr(space, end)


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    cfg: Any = None,
    *,
    env_id: str = "ClothDrape-v0",
    obs_mode: str = "rgb",
    **kwargs: Any,
) -> LeRobotVectorEnv:
    """A batch of environments for LeRobot, ended ones reset in the same step.

    Args:
        n_envs: environments in the batch.
        use_async_envs: accepted, and without effect: the batch is stepped in one process, on threads.
        cfg: a configuration of LeRobot; its ``task``, ``obs_mode`` and ``env_kwargs`` replace those below, where it has them.
        env_id, obs_mode, kwargs: of the environment, see ``gym.make_vec``.

    Raises:
        ValueError: an id that is not ours, or less than one environment.
        TypeError: a keyword that the environment does not know.
    """
    env_id, obs_mode = checked_id(getattr(cfg, "task", None) or env_id), getattr(cfg, "obs_mode", None) or obs_mode
    own: dict[str, Any] = {"render_mode": "rgb_array", "width": FRAME, "height": FRAME} | kwargs
    own |= getattr(cfg, "env_kwargs", None) or {}
    env = gym.make_vec(
        env_id, num_envs=count("n_envs", n_envs), vectorization_mode="vector_entry_point", autoreset_mode="SameStep",
        obs_mode=obs_mode, **own,
    )  # fmt: skip
    assert isinstance(env, ClothVectorEnv)
    return LeRobotVectorEnv(env, env_id)

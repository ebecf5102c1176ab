"""Stable-Baselines3's VecEnv over the native batch.

SB3 takes no Gymnasium ``VectorEnv``; this is the thin coat it needs.  Infos are built for the environments that ended and, but
for a task's cost, for no others: filling a dictionary an environment and step would cost more than the physics of a small sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from clothgym.envs.vector import ClothVectorEnv
from clothgym.registration import checked_id

NUMBERS = ("heightmap", "depth", "rgbd")  # modes whose pictures are of numbers


def channels_first(mode: str, observation: Any) -> Any:
    """Pictures of numbers with their channels first, as SB3's CNN takes them; those of colors it turns round itself.

    mode: the environment's ``obs_mode``.  observation: as it gives them, of one environment or of a batch; a dictionary with
    ``privileged=True``.
    """
    if mode not in NUMBERS:
        return observation
    if isinstance(observation, dict):
        return observation | {"observation": channels_first(mode, observation["observation"])}
    return np.expand_dims(observation, -3) if mode == "heightmap" else np.moveaxis(observation, -1, -3)


def channels_first_space(mode: str, space: gym.Space) -> gym.Space:
    """The space of these."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({**space.spaces, "observation": channels_first_space(mode, space["observation"])})
    assert isinstance(space, gym.spaces.Box)
    return gym.spaces.Box(channels_first(mode, space.low), channels_first(mode, space.high), dtype=space.dtype)  # type: ignore[arg-type]


class ClothSB3VecEnv(VecEnv):
    """A ``ClothVectorEnv`` in same-step mode as an SB3 ``VecEnv``."""

    def __init__(self, env: ClothVectorEnv) -> None:
        if env.autoreset_mode.value != "SameStep":
            raise ValueError(f"autoreset_mode={env.autoreset_mode.value!r}: SB3 needs 'SameStep'")
        self.env = env
        self._actions: NDArray | None = None
        self._seed: int | None = None
        self._next_options: dict[str, Any] = {}
        self.render_mode = env.render_mode
        super().__init__(
            env.num_envs, channels_first_space(env.task.observed.mode, env.single_observation_space), env.single_action_space
        )
        # SB3's own has only render modes; its recorder of videos looks here for their rate
        self.metadata = dict(env.metadata)

    def reset(self) -> Any:
        observation, _ = self.env.reset(seed=self._seed, options=self._next_options)
        self._seed, self._next_options = None, {}
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return self._for_cnn(observation)

    def _for_cnn(self, observation: Any) -> Any:
        return channels_first(self.env.task.observed.mode, observation)

    def step_async(self, actions: NDArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray, NDArray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self.env.step(self._actions)  # type: ignore[arg-type]
        done = terminated | truncated
        # a constrained learner needs each step's cost
        infos: list[dict[str, Any]] = [{"cost": float(c)} for c in info["cost"]] if "cost" in info else [{} for _ in done]
        if done.any():
            for env in np.flatnonzero(done):
                final = info["final_info"]
                infos[env] = {key: value[env].item() for key, value in final.items() if not key.startswith("_")}
                infos[env]["terminal_observation"] = self._for_cnn(info["final_obs"][env])
                infos[env]["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env])
        return self._for_cnn(observation), reward.astype(np.float32), done, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset: environment ``i`` gets ``seed + i``."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def set_options(self, options: Any = None) -> None:
        """Options of the next reset, the same for all environments."""
        if isinstance(options, list):
            if any(option != options[0] for option in options):
                raise ValueError("the environments of a batch are reset with the same options")
            options = options[0]
        self._next_options = dict(options or {})

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[NDArray | None]:
        return list(self.env.render() or [])

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = self.env.get_attr(attr_name) if hasattr(self.env, attr_name) else (getattr(self, attr_name),) * self.num_envs
        return [value[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name} belongs to the whole batch: it cannot be set for some environments only")
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        results = self.env.call(method_name, *method_args, **method_kwargs)
        return [results[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def make_sb3_vec_env(env_id: str, num_envs: int = 64, seed: int | None = None, **kwargs: Any) -> ClothSB3VecEnv:
    """A batch of a clothgym environment for SB3: ``PPO("MlpPolicy", make_sb3_vec_env("ClothDrape-v0", 64, seed=0))``.

    Of pictures, ``rgb`` is for ``CnnPolicy`` as it is; those of numbers, ``heightmap``, ``depth`` and ``rgbd``, come with their
    channels first, for ``CnnPolicy`` with ``policy_kwargs={"normalize_images": False}``; and with ``privileged=True``, for
    ``MultiInputPolicy`` likewise.
    Put SB3's ``VecMonitor`` on it to have episodes logged.  ``env_id``: any registered id whose environment is a ``ClothEnv``, see
    ``registration.checked_id``.  ``kwargs`` go to the environment.

    Raises:
        ValueError: an id that is not ours, or without a vector entry point.
        TypeError: a keyword that the environment does not know.
    """
    env = gym.make_vec(
        checked_id(env_id), num_envs=num_envs, vectorization_mode="vector_entry_point", autoreset_mode="SameStep", **kwargs
    )
    if not isinstance(env, ClothVectorEnv):
        raise ValueError(f"env_id={env_id!r}: its vector_entry_point must be a subclass of ClothVectorEnv")
    vec_env = ClothSB3VecEnv(env)
    vec_env.seed(seed)
    return vec_env

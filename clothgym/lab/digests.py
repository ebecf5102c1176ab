"""Digests of what happens, bit for bit: whether a result is of the code at hand.

A score is moved by what moves bits: the core, a task, its expert.  So a result carries the digest of what its environment did when
it was made, and is old where the environment does something else now.  A comment changes no digest.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from clothgym.registration import checked_id

ENVS = 4  # the expert acts in every other one, and random actions in the rest
# more of them where jams are rare: four episodes did not see a change of contact that moved scores, by ``name_of``
MORE = {"ClothDrapeGripper-v0": 16, "ClothFoldGoal-v0": 16}
WITHOUT_EFFECT = (
    "settling",
    "threads",
    "render_mode",
    "render_color",
    "width",
    "height",
)  # keywords that move no bits of an episode


class Digest:
    """Of all that is added, by part."""

    def __init__(self) -> None:
        self.hashes: dict[str, Any] = {}

    def add(self, **parts: Any) -> None:
        for part, value in parts.items():
            _feed(self.hashes.setdefault(part, hashlib.sha256()), value)

    def row(self) -> dict[str, Any]:
        parts = {part: made.hexdigest()[:8] for part, made in self.hashes.items()}
        return {"digest": hashlib.sha256("".join(parts.values()).encode()).hexdigest()[:12], "parts": parts}


def _feed(made: Any, value: Any) -> None:
    """Shapes, types and bytes, so that integers are compared."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        for key in sorted(value):
            made.update(key.encode())
            _feed(made, value[key])
    elif value is not None:
        array = np.asarray(value)
        made.update(f"{array.dtype.str} {array.shape}".encode() + array.tobytes())


def name_of(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """Of what a digest is: the id, and the keywords that move bits, as JSON."""
    moving = {name: value for name, value in sorted(env_kwargs.items()) if name not in WITHOUT_EFFECT}
    if moving.get("action_repeat") == 1:  # as if it was not given
        del moving["action_repeat"]
    return " ".join([checked_id(env_id), *([json.dumps(moving)] if moving else [])])


def digest_of(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """The digest of an environment with these keyword arguments, as the code is."""
    name = name_of(env_id, env_kwargs)
    if name not in _found:
        _found[name] = _computed(checked_id(env_id), env_kwargs, MORE.get(name, ENVS))
    return _found[name]


_found: dict[str, str] = {}  # by ``name_of``: the code of a process does not change


def _computed(env_id: str, env_kwargs: Mapping[str, Any], envs: int) -> str:
    """Of whole episodes from seeds 0 to envs - 1, with the scripted expert, where there is one, and with random actions.

    Everything counts: observations, rewards and infos of every step, and the sheets at the end.
    """
    kwargs = {name: value for name, value in env_kwargs.items() if name not in WITHOUT_EFFECT}
    env: Any = gym.make_vec(env_id, num_envs=envs, autoreset_mode="Disabled", threads=1, **kwargs).unwrapped
    random, digest = np.random.default_rng(7), Digest()
    observation, info = env.reset(seed=0)
    digest.add(observations=observation, infos=info)
    while (running := ~env.task.episode["over"]).any():
        actions = random.uniform(-1, 1, (envs, *env.single_action_space.shape))
        with contextlib.suppress(NotImplementedError):  # with these arguments the task may have no expert
            actions[::2] = env.expert_actions()[::2]
        observation, reward, terminated, truncated, info = env.step(actions)
        # what an environment that was over before the step says again counts once
        infos = {**info, "ends": terminated | 2 * truncated}
        once = {name: np.where(running, value, np.zeros((), value.dtype)) for name, value in infos.items()}
        digest.add(observations=observation, rewards=reward, infos=once)
    digest.add(positions=env.task.simulation.positions)
    env.close()
    return digest.row()["digest"]

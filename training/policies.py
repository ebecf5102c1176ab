"""Policies to evaluate, and checkpoints that can be loaded without unpickling anything.

A checkpoint is a run's folder: ``config.json`` says how to build the learner, ``checkpoint.pt`` holds tensors and numbers only
and is read with ``weights_only=True``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.adapters.runs import BEST, CHECKPOINT, CONFIG, Policy, has_checkpoint, learned, read_config, save_tensors
from clothgym.registration import ACTORS, actor_named

if TYPE_CHECKING:
    from stable_baselines3 import PPO

__all__ = ["BEST", "CHECKPOINT", "CONFIG", "Policy", "has_checkpoint", "learned", "read_config"]


def noop(env: Any, observations: NDArray) -> NDArray:
    return np.zeros(env.action_space.shape, np.float32)


def expert(env: Any, observations: NDArray) -> NDArray:
    return env.expert_actions()


def careless(env: Any, observations: NDArray) -> NDArray:
    return env.unwrapped.task.careless_actions().astype(np.float32)


def random(seed: int) -> Policy:
    rng = np.random.default_rng(seed)
    return lambda env, observations: rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)


SCRIPTED: dict[str, Policy] = {"noop": noop, "expert": expert, "careless": careless}


def named(name: str, env_id: str, seed: int) -> Policy:
    """The policy called noop, random, expert or careless, or the learned one in the run's folder of that path.

    Raises:
        ValueError: no such policy, or a checkpoint of another environment or version.
    """
    checked(name, env_id)
    if name in SCRIPTED:
        return SCRIPTED[name]
    if name == "random":
        return random(seed)
    return learned(Path(name), env_id)


def checked(name: str, env_id: str) -> None:
    """A policy's name or a run's folder, for that environment; torch is not needed to say no.

    Raises:
        ValueError: no such policy, or a checkpoint of another environment or version.
    """
    if name == "careless" and env_id != "ClothStrain-v0":
        raise ValueError(f"careless: only ClothStrain-v0 has a careless expert, not {env_id}")
    if actor_named(name, "careless") not in (*ACTORS, "careless"):
        try:
            read_config(Path(name), env_id)
        except OSError as error:
            raise ValueError(str(error)) from error


def is_for(name: str, env_id: str) -> bool:
    """Whether a policy can act in an environment: a run in that which it was trained on.

    Raises:
        ValueError: no such policy, or a checkpoint of another version.
    """
    if name == "careless":
        return env_id == "ClothStrain-v0"
    if name in ACTORS:
        return True
    actor_named(name, "careless")
    try:
        return read_config(Path(name))["env"] == env_id
    except OSError as error:
        raise ValueError(str(error)) from error


def env_kwargs(name: str) -> dict[str, Any]:
    """Keyword arguments of the environment that a learned policy was trained on; none for the others."""
    return {} if name in (*ACTORS, "careless") else dict(read_config(Path(name))["env_kwargs"])


def parsed_kwargs(text: str) -> dict[str, Any]:
    """Keyword arguments of an environment from JSON.

    Raises:
        ValueError: the text is not JSON, or no object.
    """
    try:
        kwargs = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f'--env-kwargs {text!r} is not JSON ({error}); for instance \'{{"integrator": "xpbd"}}\'') from None
    if not isinstance(kwargs, dict):
        raise ValueError(f'--env-kwargs {text!r}: must be a JSON object, for instance \'{{"integrator": "xpbd"}}\'')
    return kwargs


def save_checkpoint(folder: Path, model: PPO, name: str = CHECKPOINT) -> None:
    """Write the learner's tensors; the checkpoint before is kept, whatever happens."""
    state = {
        "policy": model.policy.state_dict(),
        "optimizer": model.policy.optimizer.state_dict(),
        "num_timesteps": model.num_timesteps,
        "num_updates": model._n_updates,
    }
    save_tensors(folder / name, state)


def load_checkpoint(folder: Path, model: PPO, state: dict[str, Any]) -> None:
    """Put a run's tensors and counters into a learner built from its configuration.

    Raises:
        ValueError: they are of another network than its configuration describes.
    """
    with files.naming(folder, "run whose checkpoint is of the network in its configuration", "train again"):
        model.policy.load_state_dict(state["policy"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
    model.num_timesteps = int(state["num_timesteps"])
    model._n_updates = int(state["num_updates"])

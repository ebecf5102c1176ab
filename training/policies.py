"""Policies to evaluate, and checkpoints that can be loaded without unpickling anything.

A checkpoint is a run's folder: ``config.json`` says how to build the learner, ``checkpoint.pt`` holds tensors and numbers only
and is read with ``weights_only=True``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

import clothgym

CHECKPOINT, BEST, CONFIG = "checkpoint.pt", "best.pt", "config.json"
Policy = Callable[[Any, NDArray], NDArray]  # (vector env, observations) -> actions


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
    """The policy called noop, random, expert or careless, or the learnt one in the run's folder of that path.

    Raises:
        FileNotFoundError, ValueError: no such policy, or a checkpoint of another environment or version.
    """
    if name == "careless" and env_id != "ClothStrain-v0":
        raise ValueError(f"careless: only ClothStrain-v0 has a careless expert, not {env_id}")
    if name in SCRIPTED:
        return SCRIPTED[name]
    if name == "random":
        return random(seed)
    return learnt(Path(name), env_id)


def env_kwargs(name: str) -> dict[str, Any]:
    """Keyword arguments of the environment that a learnt policy was trained on; none for the others."""
    return {} if name in (*SCRIPTED, "random") else dict(read_config(Path(name))["env_kwargs"])


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


def read_config(folder: Path) -> dict[str, Any]:
    folder = folder.parent if folder.name == CHECKPOINT else folder
    if not (folder / CONFIG).is_file() or not (folder / CHECKPOINT).is_file():
        raise FileNotFoundError(
            f"{str(folder)!r} is neither noop, random, expert, careless nor a run's folder: it lacks {CONFIG} or {CHECKPOINT}. "
            "Train one with: python training/train.py --env ClothDrape-v0"
        )
    config = json.loads((folder / CONFIG).read_text())
    if config.get("clothgym") != clothgym.__version__:
        raise ValueError(
            f"{str(folder)!r} was trained with clothgym {config.get('clothgym')}, this is {clothgym.__version__}: "
            "its scores would not be comparable; train anew, or install that version"
        )
    # runs from before there was a choice of learners were PPO's
    return {"algo": "ppo", "lagrange": {}, "clone": {}} | config


def learnt(folder: Path, env_id: str) -> Policy:
    """The deterministic policy of a run: the best of its held-out evaluations, or the last while there is none."""
    config = read_config(folder)
    if config["env"] != env_id:
        raise ValueError(f"{str(folder)!r} was trained on {config['env']}, not on {env_id}")
    env = gym.make_vec(f"clothgym:{env_id}", num_envs=1, **config["env_kwargs"])
    policy = ActorCriticPolicy(
        env.single_observation_space, env.single_action_space, lambda _: 0.0, **config["hyperparameters"].get("policy_kwargs", {})
    )
    env.close()
    best = folder / BEST
    policy.load_state_dict(_load(folder, BEST if best.exists() else CHECKPOINT)["policy"])
    policy.set_training_mode(False)
    return lambda env, observations: policy.predict(observations, deterministic=True)[0]


def save_checkpoint(folder: Path, model: PPO, name: str = CHECKPOINT) -> None:
    """Write the learner's tensors; a crash in the middle leaves the previous checkpoint whole."""
    state = {
        "policy": model.policy.state_dict(),
        "optimizer": model.policy.optimizer.state_dict(),
        "num_timesteps": model.num_timesteps,
        "num_updates": model._n_updates,
    }
    scratch = folder / f"{name}.new"
    torch.save(state, scratch)
    os.replace(scratch, folder / name)


def load_checkpoint(folder: Path, model: PPO) -> None:
    """Put a run's tensors and counters into a learner built from its configuration."""
    state = _load(folder)
    model.policy.load_state_dict(state["policy"])
    model.policy.optimizer.load_state_dict(state["optimizer"])
    model.num_timesteps = int(state["num_timesteps"])
    model._n_updates = int(state["num_updates"])


def _load(folder: Path, name: str = CHECKPOINT) -> dict[str, Any]:
    folder = folder.parent if folder.name == CHECKPOINT else folder
    path = folder / name
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(f"{str(path)!r} cannot be read as a checkpoint ({error}): train anew") from error

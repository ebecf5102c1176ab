"""Training runs as policies: a run's folder holds a configuration, and tensors that are read without unpickling anything."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from numpy.typing import NDArray

import clothgym

CHECKPOINT, BEST, CONFIG = "checkpoint.pt", "best.pt", "config.json"
Policy = Callable[[Any, NDArray], NDArray]  # (environment, observations) -> actions


def read_config(folder: Path, env_id: str | None = None) -> dict[str, Any]:
    """How a run's learner is built.

    Raises:
        FileNotFoundError: the folder holds no run.
        ValueError: it was trained with another version, or on another environment than this.
    """
    folder = folder.parent if folder.name == CHECKPOINT else folder
    if not (folder / CONFIG).is_file() or not (folder / CHECKPOINT).is_file():
        raise FileNotFoundError(
            f"{str(folder)!r} is not the folder of a training run, it lacks {CONFIG} or {CHECKPOINT}: "
            "train one with  python training/train.py --env ClothDrape-v0"
        )
    config = json.loads((folder / CONFIG).read_text())
    if config.get("clothgym") != clothgym.__version__:
        raise ValueError(
            f"{str(folder)!r} was trained with clothgym {config.get('clothgym')}, this is {clothgym.__version__}: "
            "its scores would not be comparable; train again, or install that version"
        )
    if env_id not in (None, config["env"]):
        raise ValueError(f"{str(folder)!r} was trained on {config['env']}, not on {env_id}")
    # runs from before there was a choice of learners were PPO's
    return {"algo": "ppo", "lagrange": {}, "clone": {}} | config


def learned(folder: Path, env_id: str) -> Policy:
    """The deterministic policy of a run: the best of its held-out evaluations, or the last while there is none.

    Raises:
        FileNotFoundError, ValueError: no run, or one of another version or environment.
        ImportError: Stable-Baselines3 is missing; the message says how to get it.
    """
    config = read_config(folder, env_id)
    try:
        from stable_baselines3.common.policies import ActorCriticPolicy
    except ImportError as error:
        raise ImportError("a trained policy needs Stable-Baselines3: pip install 'clothgym[sb3]'") from error
    env = gym.make_vec(env_id, num_envs=1, **config["env_kwargs"])
    policy = ActorCriticPolicy(
        env.single_observation_space, env.single_action_space, lambda _: 0.0, **config["hyperparameters"].get("policy_kwargs", {})
    )
    env.close()
    best = folder / BEST
    policy.load_state_dict(load_tensors(folder, BEST if best.exists() else CHECKPOINT)["policy"])
    policy.set_training_mode(False)
    return lambda env, observations: policy.predict(observations, deterministic=True)[0]


def load_tensors(folder: Path, name: str = CHECKPOINT) -> dict[str, Any]:
    """What a run has saved: tensors and numbers only.

    Raises:
        ValueError: the file cannot be read as that.
    """
    import torch

    folder = folder.parent if folder.name == CHECKPOINT else folder
    path = folder / name
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(f"{str(path)!r} cannot be read as a checkpoint ({error}): train again") from error

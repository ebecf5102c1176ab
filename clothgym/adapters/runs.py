"""Training runs as policies: a run's folder holds a configuration, and tensors that are read without unpickling anything."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import clothgym
from clothgym import files, policies
from clothgym.registration import checked_id
from clothgym.warning import warn_caller

# the last checkpoint and the previous one, their configuration, and the exported policy of a finished run
CHECKPOINT, BEFORE, CONFIG, POLICY = "checkpoint.pt", "checkpoint_before.pt", "config.json", "policy.npz"
VERSION = 2  # of the format of checkpoints
ADVICE = "train again, or take another run"
FIELDS = {
    "env": str, "algo": str, "clone": dict, "curriculum": dict, "env_kwargs": dict, "hyperparameters": dict,
    "num_envs": int, "timesteps": int, "seed": int, "threads": int,
}  # fmt: skip
OFF_POLICY = ("sac", "her", "sac_scratch")
Policy = Callable[[Any, NDArray], NDArray]  # (environment, observations) -> actions


# --- configurations -----------------------------------------------------------------------------------------------------------


def read_config(folder: Path, env_id: str | None = None, begun: bool = True) -> dict[str, Any]:
    """How a run's learner is built; begun: whether there must be a checkpoint.

    Raises:
        FileNotFoundError: the folder holds no run.
        ValueError: it was trained with another version, or on another environment than this, or its configuration is damaged.
    """
    folder = _folder(folder)
    if not (folder / CONFIG).is_file() or (begun and not has_checkpoint(folder)):
        raise FileNotFoundError(
            f"{str(folder)!r} is not the folder of a training run, it lacks {CONFIG} or {CHECKPOINT}: "
            "train one with  python training/train.py --env ClothDrape-v0"
        )
    config = files.read_json(folder / CONFIG, "configuration of a run", ADVICE)
    if config.get("clothgym") != clothgym.__version__:
        raise ValueError(
            f"{str(folder)!r} was trained with clothgym {config.get('clothgym')}, this is {clothgym.__version__}: "
            "its scores would not be comparable; train again, or install that version"
        )
    with files.naming(folder / CONFIG, "configuration of a run", ADVICE):
        for name, kind in FIELDS.items():
            if type(config.get(name)) is not kind:
                raise ValueError(f"its {name} is {config.get(name)!r:.60}, not of type {kind.__name__}")
        for name, least in (("num_envs", 1), ("timesteps", 0), ("threads", 1)):
            if config[name] < least:
                raise ValueError(f"its {name} is {config[name]}, not at least {least}")
        checked_id(config["env"])
    if env_id not in (None, config["env"]):
        raise ValueError(f"{str(folder)!r} was trained on {config['env']}, not on {env_id}")
    return config


def has_checkpoint(folder: Path) -> bool:
    """Whether a run has a checkpoint to go on from."""
    return any((folder / name).is_file() for name in (CHECKPOINT, BEFORE))


def _folder(path: Path) -> Path:
    """A run's folder, or that of its checkpoint."""
    return path.parent if path.name == CHECKPOINT else path


# --- checkpoints --------------------------------------------------------------------------------------------------------------


def save_tensors(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all; the last one is kept as BEFORE.

    Raises:
        OSError: the disk is full, or the folder cannot be written.
    """
    import torch

    archive = io.BytesIO()
    torch.save(state, archive)
    with files.replacing(path, path.with_name(BEFORE) if path.name == CHECKPOINT else None) as part:
        part.write_bytes(files.marked(archive.getvalue(), "checkpoint", VERSION))


def load_tensors(path: Path) -> dict[str, Any]:
    """What ``save_tensors`` wrote: finite tensors and numbers only.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be read as that.
    """
    import torch

    with files.naming(path, "checkpoint", ADVICE):
        content = files.unmarked(files.read(path), "checkpoint", VERSION)
        files.opened(content).close()
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        parts = ("policy", "optimizer", "variables", "constraint", "times")
        kinds = dict.fromkeys(parts, dict) | {"num_timesteps": int, "num_updates": int}
        if not isinstance(state, dict) or any(not isinstance(state.get(name), kind) for name, kind in kinds.items()):
            raise ValueError(f"it does not hold {', '.join(kinds)}")
        if min(state["num_timesteps"], state["num_updates"]) < 0:
            raise ValueError("its number of steps is negative")
        if not all(isinstance(value, torch.Tensor) and torch.isfinite(value).all() for value in state["policy"].values()):
            raise ValueError("its policy has a value that is not finite")
        return state


def load_last(folder: Path) -> dict[str, Any]:
    """The last checkpoint of a run, or the one before if that is damaged, with a warning.

    Raises:
        FileNotFoundError: there is none.
        ValueError: none can be read.
    """
    folder = _folder(folder)
    try:
        return load_tensors(folder / CHECKPOINT)
    except (ValueError, FileNotFoundError) as error:
        if not (folder / BEFORE).is_file():
            raise
        state = load_tensors(folder / BEFORE)
        warn_caller(f"{error}; using the one before it, {BEFORE}, of step {state['num_timesteps']:,}")
        return state


# --- policies -----------------------------------------------------------------------------------------------------------------


def exported(path: Path) -> Policy:
    """The policy in a file, as ``clothgym.policies`` keeps it.

    Raises:
        FileNotFoundError, ValueError: there is none, or it is damaged.
    """
    policy = policies.read(path)
    return Chunks(policy) if "chunk" in policy.about else lambda env, observations: policy(observations)


class Chunks:
    """A policy whose network gives the actions of several steps at once.

    Of each chunk the first ``about["execute"]`` actions are executed, then the network is asked again.
    """

    def __init__(self, policy: policies.Policy) -> None:
        self.policy, self.execute = policy, policy.about["execute"]
        self.actions: NDArray = np.zeros(0)  # of the last chunk, (num_envs, chunk, numbers)

    def __call__(self, env: Any, observations: Any) -> NDArray:
        steps = env.unwrapped.task.steps_taken() % self.execute
        if (steps == 0).any():
            fresh = self.policy(observations).reshape(env.num_envs, self.policy.about["chunk"], -1)
            self.actions = np.where(steps[:, None, None] == 0, fresh, self.actions if self.actions.size else fresh)
        return self.actions[np.arange(len(steps)), steps]


def learned(folder: Path, env_id: str) -> Policy:
    """The deterministic policy of a run: the exported one of a finished run, else the last checkpoint.

    Raises:
        FileNotFoundError, ValueError: no run, or one that is damaged, of another version or environment.
        ImportError: Stable-Baselines3 is missing; the message says how to get it.
    """
    folder = _folder(folder)
    config = read_config(folder, env_id)
    if (folder / POLICY).exists():
        return exported(folder / POLICY)
    if config["algo"] in OFF_POLICY:
        raise ValueError(
            f"{str(folder)!r} is of {config['algo']} and has no {POLICY}: go on with it if it is not finished, for its policy is "
            "exported at the end; policies of pictures are not exported"
        )
    try:
        from stable_baselines3.common.policies import ActorCriticPolicy, MultiInputActorCriticPolicy

        from clothgym.adapters.pixels import DepthPolicy
        from clothgym.adapters.sb3 import channels_first, channels_first_space
    except ImportError as error:
        raise ImportError("a trained policy needs Stable-Baselines3: pip install 'clothgym[sb3]'") from error
    tensors = load_last(folder)["policy"]
    kwargs = config["hyperparameters"].get("policy_kwargs", {})
    env = gym.make_vec(env_id, num_envs=1, **config["env_kwargs"])
    with files.naming(folder / CONFIG, "configuration of the network in this run", ADVICE):
        # no layer is wider than the tensors are, before it is made
        widths = list(_numbers(kwargs))
        if len(widths) > 100 or max(widths, default=0) > max(max(tensor.shape, default=1) for tensor in tensors.values()):
            raise ValueError("policy_kwargs describe a larger one than the checkpoint holds")
        mode = env.unwrapped.task.observed.mode  # type: ignore[attr-defined]
        space = channels_first_space(mode, env.single_observation_space)
        made: Any = MultiInputActorCriticPolicy if isinstance(space, gym.spaces.Dict) else ActorCriticPolicy
        if config["hyperparameters"].get("policy") == DepthPolicy.__name__:
            made = DepthPolicy
        policy = made(space, env.single_action_space, lambda _: 0.0, **kwargs)
        policy.load_state_dict(tensors)
    env.close()
    policy.set_training_mode(False)
    return lambda env, observations: policy.predict(channels_first(mode, observations), deterministic=True)[0]


def _numbers(value: Any) -> Iterator[float]:
    """All numbers in JSON."""
    if isinstance(value, (list, dict)):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _numbers(one)
    elif isinstance(value, (int, float)):
        yield value

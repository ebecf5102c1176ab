"""Policies to evaluate, by their names: scripted ones, those that are committed, runs, and files that runs have exported.

A run is a folder: ``config.json`` says how to build the learner, ``checkpoint.pt`` holds tensors and numbers only and is read with
``weights_only=True``, ``policy.npz`` is what the finished run has exported.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

import clothgym.policies as committed
from clothgym.adapters.runs import CHECKPOINT, CONFIG, OFF_POLICY, Policy, exported, has_checkpoint, learned, read_config
from clothgym.registration import ACTORS, actor_named

Config = dict[str, Any]
__all__ = ["CHECKPOINT", "CONFIG", "OFF_POLICY", "Config", "Policy", "exported", "has_checkpoint", "learned", "read_config"]
COMMITTED = "learned"  # the name of the committed policy, of a certain learner with its name after a colon


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
    """The policy called noop, random, expert or careless; "learned", or "learned:ppo", a committed one; or that of a path.

    Raises:
        ValueError: no such policy, or a checkpoint of another environment or version.
    """
    checked(name, env_id)
    if name in SCRIPTED:
        return SCRIPTED[name]
    if name == "random":
        return random(seed)
    if is_committed(name):
        policy = _committed(name, env_id)
        return lambda env, observations: policy(observations)
    if name.endswith(".npz"):
        return exported(Path(name))
    return learned(Path(name), env_id)


def is_committed(name: str) -> bool:
    """Whether a name is of a policy that is committed."""
    return name.partition(":")[0] == COMMITTED and not Path(name).exists()


def _committed(name: str, env_id: str) -> committed.Policy:
    return committed.load(env_id, name.partition(":")[2] or None)


def checked(name: str, env_id: str) -> None:
    """A policy's name or path, for that environment; torch is not needed to say no.

    Raises:
        ValueError: no such policy, or one of another environment or version.
    """
    if name == "careless" and env_id != "ClothStrain-v0":
        raise ValueError(f"careless: only ClothStrain-v0 has a careless expert, not {env_id}")
    if name in (*ACTORS, "careless"):
        return
    found = _about(name, env_id)
    if found["env"] != env_id:
        raise ValueError(f"{name!r} was trained on {found['env']}, not on {env_id}")


def is_for(name: str, env_id: str) -> bool:
    """Whether a policy can act in an environment: one that was learned in that which it was trained on.

    Raises:
        ValueError: no such policy, or one of another version.
    """
    if name in (*ACTORS, "careless"):
        return name != "careless" or env_id == "ClothStrain-v0"
    if is_committed(name):
        learners, learner = committed.available().get(env_id, []), name.partition(":")[2]
        return learner in learners if learner else bool(learners)
    return _about(name, env_id)["env"] == env_id


def env_kwargs(name: str, env_id: str) -> dict[str, Any]:
    """Keyword arguments of the environment that a learned policy was trained on; none for the others."""
    return {} if name in (*ACTORS, "careless") else dict(_about(name, env_id)["env_kwargs"])


def _about(name: str, env_id: str) -> dict[str, Any]:
    """What a learned policy, by name or path, says of itself: its environment and the keyword arguments."""
    if is_committed(name):
        return _committed(name, env_id).about
    actor_named(name, "careless", f"{COMMITTED}, a file of a policy")
    try:
        return committed.read(name).about if name.endswith(".npz") else read_config(Path(name))
    except OSError as error:
        raise ValueError(str(error)) from error


def same_as(config: Config, args: Any, *names: str) -> None:
    """Check that arguments given with ``--resume`` equal those of the run.

    Raises:
        ValueError: it is neither that, nor the default.
    """
    for name in names:
        given = getattr(args, name)
        if given not in (config[name], type(args).__dataclass_fields__[name].default):
            raise ValueError(f"--{name} {given}: the run that --resume goes on with has {config[name]}: drop --{name}")


def own_only(args: Any, *names: str) -> None:
    """What ``--resume`` takes from the run alone.

    Raises:
        ValueError: one of these is given.
    """
    for name in names:
        if getattr(args, name) != type(args).__dataclass_fields__[name].default:
            raise ValueError(f"--resume goes on with the run's own: drop --{name.replace('_', '-')}")


def hyperparameters_of(path: Path, env_id: str, advice: str = "") -> dict[str, Any]:
    """What a file of hyperparameters, in rl_zoo3's format, says of an environment.

    Raises:
        ValueError: there is no such file, it is not YAML, or says nothing of the environment.
    """
    if not path.is_file():
        raise ValueError(f"--hyperparams {path}: there is no such file")
    try:
        table = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"--hyperparams {path}: it is no YAML ({' '.join(str(error).split())})") from error
    table = table if isinstance(table, dict) else {}
    if env_id not in table:
        raise ValueError(f"{path} has no hyperparameters for {env_id!r} (there are: {', '.join(map(str, table))}){advice}")
    if not isinstance(table[env_id], dict):
        raise ValueError(f"{path}: {env_id!r} has {table[env_id]!r}: must be a mapping, name: value")
    return dict(table[env_id])


def check_curriculum(env_id: str, curriculum: Config) -> None:
    """Refuse a curriculum of folding tasks that begins with sheets that pass through themselves.

    Raises:
        ValueError: says what would do.
    """
    kwargs = curriculum.get("env_kwargs", {})
    if "Fold" in env_id and kwargs.get("physics") == "fast" and "self_collision" not in kwargs:
        raise ValueError(
            f"the curriculum of {env_id!r} begins with physics='fast', in which sheets pass through themselves: what folds there "
            "does not fold in true physics; drop the curriculum, or add self_collision: strict to its env_kwargs"
        )


def parsed_kwargs(text: str, flag: str = "--env-kwargs") -> dict[str, Any]:
    """Keyword arguments, by default of an environment, from JSON.

    Raises:
        ValueError: the text is not JSON, or no object.
    """
    try:
        kwargs = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f'{flag} {text!r} is not JSON ({error}); for instance \'{{"integrator": "xpbd"}}\'') from None
    if not isinstance(kwargs, dict):
        raise ValueError(f'{flag} {text!r}: must be a JSON object, for instance \'{{"integrator": "xpbd"}}\'')
    return kwargs

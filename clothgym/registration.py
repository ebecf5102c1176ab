"""Gymnasium ids and where their environments are.  Strings only: nothing is imported until ``make`` needs it."""

from __future__ import annotations

import difflib
from importlib import import_module

import gymnasium as gym

ENVIRONMENTS = {
    "ClothReach-v0": "ClothReach",
    "ClothDrape-v0": "ClothDrape",
    "ClothDrapeGripper-v0": "ClothDrapeGripper",
    "ClothStrain-v0": "ClothStrain",
}


def register() -> None:
    """Register every id once; importing the package again, as worker processes do, changes nothing."""
    for env_id, name in ENVIRONMENTS.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=f"clothgym.envs:{name}Env", vector_entry_point=f"clothgym.envs:{name}VectorEnv")


def checked_id(env_id: str) -> str:
    """A registered id whose environment is ours or built on ours, as ``gym.make`` takes it, without our own namespace.

    env_id: "ClothDrape-v0", "clothgym:ClothDrape-v0", or "module:Id-v0" for an id that importing the module registers.

    Raises:
        ValueError: no such id, or its environment is no ``ClothEnv``.
    """
    bare = env_id.removeprefix("clothgym:")
    module, _, name = bare.rpartition(":")
    if module:
        try:
            import_module(module)
        except ImportError as error:
            raise ValueError(f"no environment {env_id!r}: {module!r} cannot be imported ({error})") from error
    if name not in gym.registry:
        near = difflib.get_close_matches(name, ENVIRONMENTS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        advice = 'a task of your own is registered with gym.register, and named "module:Id-v0"'
        raise ValueError(f"no environment {env_id!r}{hint} (there are: {', '.join(ENVIRONMENTS)}; {advice})")
    if name not in ENVIRONMENTS:
        from gymnasium.envs.registration import load_env_creator

        from clothgym.envs import ClothEnv

        entry = gym.spec(name).entry_point
        creator = load_env_creator(entry) if isinstance(entry, str) else entry
        if not (isinstance(creator, type) and issubclass(creator, ClothEnv)):
            known = ", ".join(ENVIRONMENTS)
            raise ValueError(
                f"environment {env_id!r} is no clothgym environment ({known}): its entry point must be a subclass of ClothEnv"
            )
    return bare

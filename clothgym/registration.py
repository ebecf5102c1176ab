"""Gymnasium ids and where their environments are.  Strings only: nothing is imported until ``make`` needs it."""

from __future__ import annotations

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

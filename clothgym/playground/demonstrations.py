"""Demonstrations: an episode that was played, as a file from which a policy can be cloned, and which can be played again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clothgym import files
from clothgym.playground.episode import EpisodeStage

KIND, VERSION = "demonstration", 1


def save(path: str | Path, stage: EpisodeStage) -> None:
    """Write what was played since the last reset as ``npz``, whole or not at all: for each step what was observed before it (an
    array for each part of a dictionary), the action and the reward; and as JSON which environment it was, with which arguments and
    seed, and how it was judged.

    ``gym.make(env, **env_kwargs)``, reset with ``seed``, gives the same observations and rewards for these actions, bit for bit.

    Raises:
        ValueError: nothing has been played, or settings have been changed: then it is no episode of that environment.
        OSError: the disk is full, or the folder cannot be written.
    """
    if not stage.played:
        raise ValueError("nothing has been played yet: drag the cloth, or let a policy act")
    if not stage.unchanged:
        raise ValueError("a setting has been changed, so this is no episode of the environment itself: open it again, and play")
    observations, actions, rewards = zip(*stage.played)
    about = {"env": stage.env_id, "env_kwargs": dict(stage.env_kwargs), "seed": stage.seed, "over": stage.over}
    about |= {"is_success": bool(stage.info["is_success"]), "performance": float(stage.info["normalized_performance"])}
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about)), "actions": np.stack(actions), "rewards": np.array(rewards)}
    if isinstance(observations[0], Mapping):
        arrays |= {f"observations: {name}": np.stack([one[name] for one in observations]) for name in observations[0]}
    else:
        arrays["observations"] = np.stack(observations)
    files.write_arrays(path, KIND, VERSION, arrays, compressed=True)

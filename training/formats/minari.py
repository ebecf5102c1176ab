"""Minari's format, by its own library: the folder ``data``, which ``minari.MinariDataset`` opens.

In a folder of Minari's root, ``~/.minari/datasets/cloth/fold/expert-v0``, the set also opens by its name, ``cloth/fold/expert-v0``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray
from recordings import Episode

from clothgym.adapters.lerobot import named

DATA = "data"
VERSIONED = re.compile(r"-v\d+$")  # as names of sets must be


def write(folder: Path, about: dict[str, Any], episodes: Iterator[Episode]) -> None:
    kwargs = about["env_kwargs"] | {"obs_mode": about["obs_mode"]}
    env = gym.make(about["env"], disable_env_checker=True, **kwargs)
    # without JPEG, which would change pictures; of a relative path Minari 0.5 makes another one
    storage = MinariStorage.new(folder.resolve() / DATA, env.observation_space, env.action_space, env.spec, jpeg_encoding=False)
    single = not isinstance(env.observation_space, gym.spaces.Dict)
    env.close()
    for episode in episodes:
        observations = episode.observations["observation"] if single else episode.observations
        own = {
            "rewards": episode.rewards, "terminations": episode.terminations, "truncations": episode.truncations,
            "infos": episode.infos | {"agent_pos": episode.agent_pos},
        }  # fmt: skip
        storage.update_episodes([EpisodeBuffer(seed=episode.seed, observations=observations, actions=episode.actions, **own)])
    storage.update_metadata(
        {
            "dataset_id": about["name"] if VERSIONED.search(about["name"]) else f"{about['name']}-v0",
            "algorithm_name": about["policy"],
            "description": f"{about['task']} Recorded with clothgym {about['versions']['clothgym']}.",
            "minari_version": minari.__version__,
            "requirements": ["clothgym"],
            "dataset_size": storage.get_size(),
        }
    )


def read(folder: Path, about: dict[str, Any]) -> Iterator[dict[str, NDArray]]:
    for episode in minari.MinariDataset(folder / DATA).iterate_episodes():
        steps = len(episode.actions)
        seen = named(about["obs_mode"], episode.observations, episode.infos["agent_pos"])
        own = {"actions": episode.actions, "rewards": episode.rewards}
        yield own | {key: array[:steps] for key, array in seen.items()}

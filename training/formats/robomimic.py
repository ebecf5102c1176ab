"""robomimic's HDF5: the file ``demo.hdf5``, a group an episode."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from recordings import Episode

NAME = "demo.hdf5"
GYM = 2  # robomimic's type of an environment that Gymnasium makes


def write(folder: Path, about: dict[str, Any], episodes: Iterator[Episode]) -> None:
    kwargs = about["env_kwargs"] | {"obs_mode": about["obs_mode"]}
    succeeded, failed, total = [], [], 0
    with h5py.File(folder / NAME, "w") as file:
        data = file.create_group("data")
        for index, episode in enumerate(episodes):
            name, steps = f"demo_{index}", len(episode)
            demo = data.create_group(name)
            demo.attrs["num_samples"], demo.attrs["seed"] = steps, episode.seed
            demo["actions"], demo["rewards"] = episode.actions, episode.rewards
            demo["dones"] = (episode.terminations | episode.truncations).astype(np.int64)
            for key, array in episode.named(about["obs_mode"]).items():
                options = {"compression": "gzip"} if array.dtype == np.uint8 else {}
                demo.create_dataset(f"obs/{key}", data=array[:-1], **options)
                demo.create_dataset(f"next_obs/{key}", data=array[1:], **options)
            (succeeded if episode.success else failed).append(name)
            total += steps
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps({"env_name": about["env"], "type": GYM, "env_kwargs": kwargs})
        for filter_key, names in (("success", succeeded), ("failed", failed)):
            if names:
                file[f"mask/{filter_key}"] = np.array(names, dtype="S")


def read(folder: Path, about: dict[str, Any]) -> Iterator[dict[str, NDArray]]:
    with h5py.File(folder / NAME) as file:
        for index in range(len(file["data"])):
            demo = file[f"data/demo_{index}"]
            own = {"actions": demo["actions"][:], "rewards": demo["rewards"][:]}
            yield own | {key: array[:] for key, array in demo["obs"].items()}

"""LeRobot's format, v3.0, by pyarrow, and by PyAV where pictures become films: frames as parquet, many episodes a file.

A frame is what was seen before a step, the action, and ``next.reward``, ``next.done`` and ``next.success`` after it.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image
from recordings import Episode

from clothgym.adapters.lerobot import FEATURES, feature

CODEBASE = "v3.0"
DATA, FILM = (
    "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
)
EPISODES, TASKS = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "meta/tasks.parquet"
CHUNK, DATA_MB, FILM_MB = 1000, 100, 200  # files in a folder, and sizes at which a new file begins
CODEC = {"codec": "libsvtav1", "pix_fmt": "yuv420p", "g": 2, "crf": 30}  # LeRobot's own
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
# columns that every data set has
INDICES = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}
KEYS = {name: key for key, name in FEATURES.items()}


def write(folder: Path, about: dict[str, Any], episodes: Iterator[Episode]) -> None:
    writer: _Writer | None = None
    for episode in episodes:
        columns = _columns(about, episode)
        if writer is None:
            writer = _Writer(folder, about, columns)
        writer.add(episode, columns)
    if writer is not None:
        writer.close()


def _columns(about: dict[str, Any], episode: Episode) -> dict[str, NDArray]:
    """The features of an episode's frames, (T, ...) each."""
    seen = {feature(key): part[:-1] for key, part in episode.named(about["obs_mode"]).items()}
    success = episode.infos["is_success"][1:].astype(bool)
    done = episode.terminations | episode.truncations
    return seen | {"action": episode.actions, "next.reward": episode.rewards, "next.done": done, "next.success": success}


class _Writer:
    """A set that grows by episodes, in files of bounded size."""

    def __init__(self, folder: Path, about: dict[str, Any], columns: dict[str, NDArray]) -> None:
        self.folder, self.about, self.fps = folder, about, about["fps"]
        self.features = {name: _feature(name, array, about) for name, array in columns.items()}
        self.films = [name for name, one in self.features.items() if one["dtype"] == "video"]
        self.features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in INDICES.items()}
        self.schema = pa.schema([(name, _arrow_type(one)) for name, one in self.features.items() if name not in self.films])
        self.rows: list[dict[str, Any]] = []
        self.frames, self.file = 0, -1
        self.parquet: pq.ParquetWriter | None = None
        self.streams = {name: _Film(folder, name, self.fps) for name in self.films}

    def add(self, episode: Episode, columns: dict[str, NDArray]) -> None:
        """Write the frames of an episode, as one group of rows, and note where they are."""
        steps, index = len(episode), len(self.rows)
        columns = columns | {
            "timestamp": (np.arange(steps) / self.fps).astype(np.float32),
            "frame_index": np.arange(steps),
            "episode_index": np.full(steps, index),
            "index": np.arange(self.frames, self.frames + steps),
            "task_index": np.zeros(steps, np.int64),
        }
        table = pa.table([_arrow(columns[name], self.schema.field(name).type) for name in self.schema.names], schema=self.schema)
        if self.parquet is None or self._path(DATA).stat().st_size > DATA_MB * 2**20:
            self._next_file()
        assert self.parquet is not None
        self.parquet.write_table(table, row_group_size=steps)
        row: dict[str, Any] = {"episode_index": index, "tasks": [self.about["task"]], "length": steps}
        row |= {"data/chunk_index": self.file // CHUNK, "data/file_index": self.file % CHUNK}
        row |= {"dataset_from_index": self.frames, "dataset_to_index": self.frames + steps}
        for name, stream in self.streams.items():
            row |= {f"videos/{name}/{key}": value for key, value in stream.add(columns[name]).items()}
        stats = {name: _stats(array, self.features[name]["dtype"]) for name, array in columns.items()}
        row |= {f"stats/{name}/{key}": value.tolist() for name, own in stats.items() for key, value in own.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        row |= {"clothgym/seed": episode.seed, "clothgym/success": episode.success}
        self.rows.append(row)
        self.frames += steps

    def _path(self, pattern: str) -> Path:
        path = self.folder / pattern.format(chunk_index=self.file // CHUNK, file_index=self.file % CHUNK)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _next_file(self) -> None:
        if self.parquet is not None:
            self.parquet.close()
        self.file += 1
        self.parquet = pq.ParquetWriter(self._path(DATA), self.schema, compression="snappy")

    def close(self) -> None:
        """Write what is known when the last episode has been added."""
        assert self.parquet is not None
        self.parquet.close()
        for name, stream in self.streams.items():
            self.features[name]["info"] = stream.close()
        path = self.folder / EPISODES.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self.rows), path, compression="snappy")
        pq.write_table(_tasks([self.about["task"]]), self.folder / TASKS)
        info = {
            "codebase_version": CODEBASE, "robot_type": "clothgym", "fps": self.fps, "features": self.features,
            "total_episodes": len(self.rows), "total_frames": self.frames, "total_tasks": 1,
            "chunks_size": CHUNK, "data_files_size_in_mb": DATA_MB, "video_files_size_in_mb": FILM_MB,
            "splits": {"train": f"0:{len(self.rows)}"}, "data_path": DATA, "video_path": FILM if self.films else None,
        }  # fmt: skip
        stats = {name: _pooled(self.rows, name) for name in self.features}
        for name, content in (("info", info), ("stats", stats)):
            (self.folder / f"meta/{name}.json").write_text(json.dumps(content, indent=1) + "\n")


# --- features -----------------------------------------------------------------------------------------------------------------


def _feature(name: str, array: NDArray, about: dict[str, Any]) -> dict[str, Any]:
    """A feature as ``meta/info.json`` describes it."""
    shape = list(array.shape[1:]) or [1]
    if array.dtype == np.uint8:
        return {
            "dtype": "video" if name in about["lossy_features"] else "image",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
    names: Any = {"observation.state": about["agent_pos"], "action": [f"action_{k}" for k in range(shape[0])]}.get(name)
    return {"dtype": str(array.dtype), "shape": shape, "names": names}


def _arrow_type(feature: dict[str, Any]) -> pa.DataType:
    if feature["dtype"] == "image":
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    kind = pa.from_numpy_dtype(np.dtype(feature["dtype"]))
    if feature["shape"] == [1]:
        return kind
    if len(feature["shape"]) == 1:
        return pa.list_(kind, feature["shape"][0])
    for _ in feature["shape"]:
        kind = pa.list_(kind)
    return kind


def _arrow(array: NDArray, kind: pa.DataType) -> pa.Array:
    """A column, (T, ...), as arrow keeps it."""
    if pa.types.is_struct(kind):
        return pa.array([{"bytes": _png(picture), "path": None} for picture in array], kind)
    if array.ndim == 1 or array.shape[1:] == (1,):
        return pa.array(array.reshape(len(array)))
    flat = pa.array(array.ravel())
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(flat, type=kind)
    for axis in range(array.ndim - 1, 0, -1):
        size = array.shape[axis]
        flat = pa.ListArray.from_arrays(pa.array(np.arange(0, len(flat) + 1, size, dtype=np.int32)), flat)
    return flat


def _png(picture: NDArray) -> bytes:
    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="PNG", compress_level=1)
    return content.getvalue()


def _tasks(tasks: list[str]) -> pa.Table:
    """The tasks' sentences, as the pandas table that LeRobot reads: indexed by the sentence."""
    about = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None},
            {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
        "pandas_version": "2.3.3",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


# --- statistics ---------------------------------------------------------------------------------------------------------------


def _stats(array: NDArray, dtype: str) -> dict[str, NDArray]:
    """Of an episode's column over its frames, (1,) or with the column's shape; of pictures each channel's, (3, 1, 1), in [0, 1]."""
    count = {"count": np.array([len(array)])}
    if dtype in ("image", "video"):
        shares = np.stack([np.bincount(array[..., c].ravel(), minlength=256) for c in range(array.shape[-1])]) / array[..., 0].size
        levels, below = np.arange(256) / 255, np.cumsum(shares, axis=1)
        mean = shares @ levels
        own = {"min": levels[(shares > 0).argmax(axis=1)], "max": levels[255 - (shares > 0)[:, ::-1].argmax(axis=1)], "mean": mean}
        own |= {"std": np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0))}
        own |= {name: levels[np.minimum((below < share - 1e-12).sum(axis=1), 255)] for name, share in QUANTILES.items()}
        return {name: value.reshape(-1, 1, 1) for name, value in own.items()} | count
    values = array.reshape(len(array), -1).astype(np.float64) if array.ndim == 1 else array.astype(np.float64)
    own = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    return own | dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values()), axis=0))) | count


def _pooled(rows: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Of all episodes' columns; quantiles are means of the episodes', weighted by their lengths, as LeRobot's own are."""
    parts = {
        key: np.array([row[f"stats/{name}/{key}"] for row in rows], float) for key in ("min", "max", "mean", "std", *QUANTILES)
    }
    lengths = np.array([row["length"] for row in rows])
    means = parts["mean"]
    pooled = {key: np.average(parts[key], axis=0, weights=lengths) for key in ("mean", *QUANTILES)}
    variance = np.average(parts["std"] ** 2 + (means - pooled["mean"]) ** 2, axis=0, weights=lengths)
    pooled |= {"min": parts["min"].min(axis=0), "max": parts["max"].max(axis=0), "std": np.sqrt(variance)}
    return {key: value.tolist() for key, value in pooled.items()} | {"count": [int(lengths.sum())]}


# --- films --------------------------------------------------------------------------------------------------------------------


class _Film:
    """Pictures of many episodes in films, one after another; every second picture is whole, so that any is found at once."""

    def __init__(self, folder: Path, name: str, fps: int) -> None:
        self.folder, self.name, self.fps, self.file = folder, name, fps, -1
        self.container: Any = None

    def add(self, pictures: NDArray) -> dict[str, Any]:
        """Append an episode's pictures, (T, height, width, 3); returns where they are."""
        import av

        if self.container is None or self.size > FILM_MB * 2**20:
            self._next_file(pictures.shape[1:3])
        first = self.frames
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = self.frames
            self._put(frame)
            self.frames += 1
        place = {"chunk_index": self.file // CHUNK, "file_index": self.file % CHUNK}
        return place | {"from_timestamp": first / self.fps, "to_timestamp": self.frames / self.fps}

    def _next_file(self, size: tuple[int, ...]) -> None:
        import av

        self._end()
        self.file, self.frames, self.size = self.file + 1, 0, 0
        path = self.folder / FILM.format(video_key=self.name, chunk_index=self.file // CHUNK, file_index=self.file % CHUNK)
        path.parent.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("SVT_LOG", "1")  # of the codec: errors only
        self.container = av.open(str(path), "w")
        self.stream = self.container.add_stream(
            CODEC["codec"], rate=self.fps, options={"g": str(CODEC["g"]), "crf": str(CODEC["crf"])}
        )
        self.stream.height, self.stream.width = size
        self.stream.pix_fmt = CODEC["pix_fmt"]

    def _put(self, frame: Any) -> None:
        """Encode a picture, or with None those that the codec still holds."""
        for packet in self.stream.encode(frame):
            self.container.mux(packet)
            self.size += packet.size

    def _end(self) -> None:
        if self.container is not None:
            self._put(None)
            self.container.close()

    def close(self) -> dict[str, Any]:
        """End the last file; returns what ``meta/info.json`` says of the films."""
        self._end()
        height, width = self.stream.height, self.stream.width
        about = {"height": height, "width": width, "codec": "av1", "pix_fmt": CODEC["pix_fmt"], "fps": self.fps, "channels": 3}
        return {f"video.{key}": value for key, value in about.items()} | {"is_depth_map": False, "has_audio": False}


# --- reading ------------------------------------------------------------------------------------------------------------------


def read(folder: Path, about: dict[str, Any]) -> Iterator[dict[str, NDArray]]:
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    names = [name for name in features if name.startswith("observation.") and features[name]["dtype"] != "video"]
    for path in sorted(folder.glob("data/*/*.parquet")):
        with pq.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                table = file.read_row_group(group, columns=[*names, "action", "next.reward"])
                own = {"actions": _array(table["action"], features["action"]), "rewards": table["next.reward"].to_numpy()}
                yield own | {_key(name): _array(table[name], features[name]) for name in names}


def _key(name: str) -> str:
    return KEYS.get(name, name.removeprefix("observation."))


def _array(column: pa.ChunkedArray, feature: dict[str, Any]) -> NDArray:
    """A column as an array, (T, ...)."""
    if feature["dtype"] == "image":
        return np.stack([np.asarray(Image.open(io.BytesIO(one["bytes"]))) for one in column.to_pylist()])
    values = column.combine_chunks()
    while not pa.types.is_primitive(values.type):
        values = values.flatten()
    return values.to_numpy().reshape(len(column), *feature["shape"])

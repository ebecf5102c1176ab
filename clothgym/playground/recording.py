"""Recordings: frames that can be shown again, saved to a file and loaded."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.checks import count, finite, members, positive
from clothgym.collisions import MeshCollider
from clothgym.mesh import ClothMesh, grid
from clothgym.render import Camera, Drawn
from clothgym.render.solids import KINDS, check_color
from clothgym.triangles import triangle_mesh

VERSION = 2  # of the format of files
FINEST = 128  # cells of a solid's mesh in a file
# arrays of a file: the kind of their numbers, and their shape by the sizes of the recording
ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "time": ("f", ("frames",)),
    "positions": ("f", ("frames", "sheets", "particles", 3)),
    "solids": ("f", ("rows", 5)),
    "rest_positions": ("f", ("particles", 3)),
    "triangles": ("i", ("triangles", 3)),
}
ADVICE = "give a file that the playground saved"


@dataclass(frozen=True)
class Frame:
    """One moment; the first axis of its arrays is the sheet, of which a comparison has several.

    Attributes:
        time: since the start [s].
        positions: [m], (sheets, particles, 3) float32.
        solids: drawn solids.
        readings: numbers by name, (sheets,) each.
        terms: reward terms by name; none outside an environment.
    """

    time: float
    positions: NDArray[np.float32]
    solids: tuple[Drawn, ...] = ()
    readings: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Recording:
    """Frames of one mesh.

    Attributes:
        title: of the scene or environment.
        mesh: the sheet; time_step: between frames [s]; camera: where it is seen from.
        labels: a name for each sheet.
        strained: strain at which the color scale ends.
        frames: in order.
        fabric: a name of ``material.PRESETS``, for its looks; "" for the renderer's own.
    """

    title: str
    mesh: ClothMesh
    time_step: float
    camera: Camera
    labels: Sequence[str] = ("",)
    strained: float = 0.05
    frames: list[Frame] = field(default_factory=list)
    fabric: str = ""

    def save(self, path: str | Path) -> None:
        """Write as ``npz`` without pickle, whole or not at all.

        Raises:
            ValueError: there are no frames.
            OSError: the disk is full, or the folder cannot be written.
        """
        frames = self.frames
        if not frames:
            raise ValueError(f"{str(path)!r}: there are no frames to save yet")
        shapes: dict[Drawn, int] = {}
        solids = [
            (number, shapes.setdefault(solid.at_origin, len(shapes)), *solid.collider.center)
            for number, frame in enumerate(frames)
            for solid in frame.solids
        ]
        arrays: dict[str, Any] = {
            "time": np.array([frame.time for frame in frames], np.float64),
            "positions": [frame.positions for frame in frames],
            "solids": np.array(solids, np.float64).reshape(-1, 5),
            "rest_positions": self.mesh.rest_positions,
            "triangles": self.mesh.triangles,
        }
        for kind in ("readings", "terms"):
            for name in sorted({name for frame in frames for name in getattr(frame, kind)}):
                arrays[f"{kind}: {name}"] = _column([getattr(frame, kind).get(name) for frame in frames])
        about = {
            "title": self.title, "time_step": self.time_step, "labels": list(self.labels), "strained": self.strained,
            "fabric": self.fabric, "camera": asdict(self.camera), "shapes": list(map(_as_text, shapes)), "grid": self.mesh.shape,
            "size": self.mesh.size,
        }  # fmt: skip
        files.write_arrays(path, "recording", VERSION, {"about": np.array(json.dumps(about)), **arrays}, compressed=True)

    @staticmethod
    def load(path: str | Path) -> Recording:
        """Read what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a recording, is damaged, or is of another version.
        """
        arrays = files.read_arrays(path, "recording", VERSION, ADVICE)
        with files.naming(path, "recording", ADVICE):
            return _from_arrays(arrays)


def _column(values: list[Any]) -> NDArray[np.float64]:
    """Numbers of successive frames, nan where there are none."""
    shape = np.shape(next(value for value in values if value is not None))
    return np.array([np.full(shape, np.nan) if value is None else value for value in values], np.float64)


def _from_arrays(arrays: dict[str, NDArray]) -> Recording:
    about = json.loads(str(arrays.pop("about")))
    members("labels", about["labels"], str, "names of the sheets")
    _check_arrays(arrays, len(about["labels"]))
    frames = len(arrays["time"])
    shapes = [_from_text(text) for text in about["shapes"]]
    solids: list[list[Drawn]] = [[] for _ in range(frames)]
    for number, shape, *center in arrays["solids"].tolist():
        solids[_place(number, frames)].append(shapes[_place(shape, len(shapes))].at(center))

    def of_frame(kind: str, k: int) -> dict[str, Any]:
        return {key.removeprefix(f"{kind}: "): value[k] for key, value in arrays.items() if key.startswith(f"{kind}: ")}

    time_step, strained = (positive(name, about[name]) for name in ("time_step", "strained"))
    return Recording(
        str(about["title"]), _mesh(arrays, about), time_step, Camera(**about["camera"]), about["labels"], strained,
        [
            Frame(
                float(arrays["time"][k]), arrays["positions"][k], tuple(solids[k]), of_frame("readings", k),
                {name: float(value) for name, value in of_frame("terms", k).items() if np.isfinite(value)},
            )
            for k in range(frames)
        ],
        str(about.get("fabric", "")),
    )  # fmt: skip


def _mesh(arrays: Mapping[str, NDArray], about: Mapping[str, Any]) -> ClothMesh:
    x, triangles = arrays["rest_positions"], arrays["triangles"]
    if not about["grid"]:
        return triangle_mesh(x, triangles)
    rows, columns = (count("grid", side, least=2, most=len(x)) for side in about["grid"])
    if rows * columns != len(x):
        raise ValueError(f"a grid of {rows} x {columns} has not {len(x)} particles")
    mesh = grid(rows, columns, *about["size"])
    if not (np.array_equal(mesh.rest_positions, x) and np.array_equal(mesh.triangles, triangles)):
        raise ValueError("its particles and triangles are not those of its grid")
    return mesh


def _check_arrays(arrays: Mapping[str, NDArray], sheets: int) -> None:
    """Refuse arrays that do not fit together, or that hold what no recording can.

    Raises:
        ValueError: names the array and its defect.
    """
    sizes: dict[str | int, int] = {"sheets": sheets}
    if lacking := sorted(set(ARRAYS) - set(arrays)):
        raise ValueError(f"it lacks {', '.join(lacking)}")
    for name, (kind, shape) in ARRAYS.items():
        array = arrays[name]
        for axis, length in zip(shape, array.shape):
            sizes.setdefault(axis, axis if isinstance(axis, int) else length)
        if array.dtype.kind != kind or array.shape != tuple(sizes.get(axis, -1) for axis in shape):
            raise ValueError(f"{name} have shape {array.shape} and kind {array.dtype}, not {shape}")
        if kind == "f":
            finite(name, array)
    if min(sizes["frames"], sizes["sheets"]) == 0:
        raise ValueError("it has no frames")
    # readings of every frame; nan where there were none, and anything where a sheet has burst
    each = {"readings": (sizes["frames"], sizes["sheets"]), "terms": (sizes["frames"],)}
    for name in sorted(set(arrays) - set(ARRAYS)):
        if arrays[name].shape != each.get(name.partition(": ")[0]) or arrays[name].dtype.kind != "f":
            raise ValueError(f"{name} is no reading of its frames")


def _place(value: float, end: int) -> int:
    """A place in a list of that length."""
    if not (value == int(value) and 0 <= value < end):
        raise ValueError(f"solids name frame or shape {value:g}, of {end}")
    return int(value)


def _as_text(solid: Drawn) -> str:
    collider = solid.collider
    written = {"kind": solid.kind, "color": solid.color} | {item.name: getattr(collider, item.name) for item in fields(collider)}
    if isinstance(collider, MeshCollider):  # its file may be gone when it is read
        vertices, triangles = collider.surface
        written |= {"path": None, "scale": 1.0, "vertices": vertices, "triangles": triangles}
    return json.dumps(written, default=lambda value: value.tolist())


def _from_text(text: str) -> Drawn:
    given: dict[str, Any] = json.loads(text)
    kind = KINDS[given["kind"]]
    own = {item.name: _tuple(given[item.name]) for item in fields(kind)}
    if own.get("path") is not None or own.get("resolution", 0) > FINEST:
        raise ValueError("a mesh must be in the recording itself, and be no finer than those that are saved")
    check_color("color", given["color"])
    return Drawn(kind(**own), _tuple(given["color"]))


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value

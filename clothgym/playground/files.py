"""Files that a visitor can save: a picture, a video, meshes, or the recording itself."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.playground import demonstrations
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.pictures import joined, painter, together, write_moving_mesh
from clothgym.playground.race import Race
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.stage import Stage
from clothgym.render import Camera, MeshSequence
from clothgym.render.export import write_picture, write_video

KINDS = {
    "png": "picture (PNG)",
    "gif": "film (GIF)",
    "mp4": "film (MP4)",
    "obj": "meshes (OBJ, zipped)",
    "glb": "moving mesh (glTF)",
    "npz": "recording (NPZ)",
    "demo": "demonstration (NPZ)",
}
PICTURE, FILM = 960, 480  # pixels of a side
LONGEST = 300  # frames of a film or of meshes, the last of the recording


def made(
    kind: str, stage: Stage, moment: int, camera: Any, color: str = "fabric", left: Callable[[], bool] = lambda: False
) -> tuple[str, bytes]:
    """A file's name and content: of the frame at ``moment``, or of the frames up to it, seen by a viewer's camera; color: of
    pictures and films, "fabric" or "strain"; left: whether the visitor has left, who then needs no file.

    Raises:
        ValueError: no such kind, or the visitor has left.
        ImportError: a library that this kind needs is missing; the message says how to get it.
    """
    if kind not in KINDS:
        raise ValueError(f"file kind={kind!r}: must be one of {', '.join(KINDS)}")
    recording = stage.recording
    frames = recording.frames[max(0, moment + 1 - LONGEST) : moment + 1]
    with tempfile.TemporaryDirectory() as folder:
        name = stage.name.replace("/", "_")
        path = Path(folder) / f"{name}.{kind}"
        if kind == "png":
            write_picture(path, painter(recording, PICTURE, 3, color, _seen(camera))(frames[-1]))
        elif kind in ("gif", "mp4"):
            draw = painter(recording, FILM, 2, color, _seen(camera))
            write_video(path, map(draw, _wanted(frames, left)), fps=1 / recording.time_step)
        elif kind == "glb":
            write_moving_mesh(path, recording, frames, 1 / recording.time_step)
        elif kind == "demo":
            played = stage.mine if isinstance(stage, Race) else stage
            if not isinstance(played, EpisodeStage):
                raise ValueError("a demonstration is of an environment: choose one, and play it")
            path = path.with_name(f"{name}_demonstration.npz")
            demonstrations.save(path, played)
        elif kind == "npz":
            recording.save(path)
        else:
            return f"{name}_obj.zip", _zipped(_sequence(Path(folder) / "frames", recording, _wanted(frames, left)))
        return path.name, path.read_bytes()


def _wanted(frames: Sequence[Frame], left: Callable[[], bool]) -> Iterator[Frame]:
    """The frames, as long as somebody waits for them."""
    for frame in frames:
        if left():
            raise ValueError("the visitor has left")
        yield frame


def _seen(camera: Any) -> Camera:
    """The viewer's camera, above the floor."""
    x, y, z = np.asarray(camera.position, float).tolist()
    fov = float(np.degrees(camera.fov))
    target = tuple(np.asarray(camera.look_at, float).tolist())
    return Camera(eye=(x, y, max(z, 0.02)), target=target, vertical_fov=fov)  # type: ignore[arg-type]


def _sequence(folder: Path, recording: Recording, frames: Iterator[Frame]) -> list[Path]:
    sequence = MeshSequence(folder, *joined(recording), "obj")
    return [sequence.add(together(frame), frame.solids) for frame in frames]


def _zipped(paths: list[Path]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            archive.write(path, path.name)
    return buffer.getvalue()

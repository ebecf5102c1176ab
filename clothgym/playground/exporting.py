"""``python -m clothgym export``, and what a visitor saves: a scene or an episode as a picture, a video, meshes or a recording."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.checks import count, one_of, positive
from clothgym.forces import structural_strain
from clothgym.playground.episode import EpisodeStage, Race
from clothgym.playground.gallery import Gallery, policies_of
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import FRAME, SCENES, scene_named
from clothgym.playground.show import look_of
from clothgym.playground.stage import STEPS, SceneStage, Stage
from clothgym.registration import ACTORS, actor_named
from clothgym.render import Camera, Drawn, MeshSequence, Renderer, write_animation, write_picture, write_video
from clothgym.render.heat import largest_at_particles
from clothgym.render.meshes import KINDS, without_frames
from clothgym.simulation import GRAVITY

SECONDS, FPS, SIZE, PICTURE = 5.0, 30.0, 480, 960  # of a scene; frames a second; pixels of a video's side and of a picture's
# to write a file with that ending; all in the extra "video"
NEEDED = {".png": "PIL", ".webp": "PIL", ".gif": "PIL", ".mp4": "imageio_ffmpeg"}
# what a visitor can save
SAVED = {
    "png": "picture (PNG)",
    "gif": "film (GIF)",
    "mp4": "film (MP4)",
    "obj": "meshes (OBJ, zipped)",
    "glb": "moving mesh (glTF)",
    "npz": "recording (NPZ)",
    "demo": "demonstration (NPZ)",
}
LONGEST = 300  # frames of a film or of meshes that a visitor saves, the last of the recording
Say = Callable[[int, int], None]


def painter(
    recording: Recording, size: int, antialias: int = 2, color: str = "fabric", camera: Camera | None = None
) -> Callable[[Frame], NDArray[np.uint8]]:
    """What draws a recording's frames, (size, size, 3) each, in the colors of the fabric or of the strain.

    camera: in place of the recording's own.
    """
    one_of("color", color, "fabric", "strain")
    mesh, seen = recording.mesh, camera or recording.camera
    look = look_of(recording)._asdict()
    renderer = Renderer(mesh.triangles, mesh.rest_positions[:, :2], seen, size, size, antialias, grid_shape=mesh.shape, **look)

    def draw(frame: Frame) -> NDArray[np.uint8]:
        pictures, depths = [], []
        for x in frame.positions:
            values = None if color == "fabric" else strain_shares(recording, x)
            pictures.append(renderer.rgb(x, frame.solids, values=values))
            if len(frame.positions) > 1:
                depths.append(renderer.depth(x, frame.solids))
        if len(pictures) == 1:
            return pictures[0]
        # in each pixel the nearest sheet; where there is none, the darkest picture, which has the shadows of all
        nearest, stack = np.argmin(depths, axis=0)[None, :, :, None], np.stack(pictures)
        away = np.max(depths, axis=0)[:, :, None] == np.min(depths, axis=0)[:, :, None]
        return np.where(away, stack.min(axis=0), np.take_along_axis(stack, nearest, axis=0)[0])

    return draw


def strain_shares(recording: Recording, x: NDArray) -> NDArray[np.float32]:
    """The largest strain of the yarns at each particle, as a share of that at which the color scale ends, (particles,)."""
    return largest_at_particles(recording.mesh, structural_strain(recording.mesh, x[None]))[0] / np.float32(recording.strained)


# --- meshes -------------------------------------------------------------------------------------------------------------


def joined(recording: Recording) -> tuple[NDArray, NDArray]:
    """The sheets of a recording as one mesh: triangles, and texture coordinates with which an image fills each sheet."""
    mesh, sheets = recording.mesh, len(recording.labels)
    triangles = np.concatenate([mesh.triangles + k * mesh.num_particles for k in range(sheets)])
    return triangles, np.tile(mesh.rest_positions[:, :2] / max(mesh.size) + 0.5, (sheets, 1))


def together(frame: Frame) -> NDArray[np.float32]:
    """Positions of all sheets [m], (sheets * particles, 3)."""
    return frame.positions.reshape(-1, 3)


def lasting(solids: Sequence[Sequence[Drawn]]) -> list[list[Drawn]]:
    """The solids that all frames have: those that come or go, as a gripper that opens, cannot be part of one moving mesh."""
    counts = [Counter(solid.at_origin for solid in things) for things in solids]
    kept = {shape for shape, number in counts[0].items() if all(other[shape] == number for other in counts)}
    return [[solid for solid in things if solid.at_origin in kept] for things in solids]


# --- stages ---------------------------------------------------------------------------------------------------------------


def stage_named(name: str, seed: int = 0, policy: str = "expert", settings: Mapping[str, Any] | None = None) -> Stage:
    """A scene of the playground or an environment, at its start.

    policy: who acts in an environment: "expert", "noop", "random", or the folder of a training run.  settings: of the
    playground, in place of the scene's own; a scene that begins without gravity gets it.

    Raises:
        ValueError, FileNotFoundError: an unknown scene, environment or policy, an invalid setting, or settings of an environment.
        ImportError: a trained policy needs Stable-Baselines3, and it is missing.
    """
    bare = Gallery().checked(name)
    runs = [] if actor_named(policy) in ACTORS else [policy]
    if bare in SCENES:
        own = scene_named(bare).settings
        return SceneStage(bare, own.changed(**{"gravity": own.gravity or GRAVITY, **(settings or {})}), seed)
    if settings:
        raise ValueError(f"settings={dict(settings)}: are of scenes; {bare} has its own, see the arguments on its page")
    _, learned = policies_of(runs, name)
    trained = learned.get(bare, {})
    if runs and not trained:
        raise ValueError(f"policy={policy!r}: was trained on {next(iter(learned))}, not on {bare}")
    return EpisodeStage(bare, trained, next(iter(trained), policy), seed)


def moments(stage: Stage, seconds: float | None = None, fps: float | None = None, say: Say | None = None) -> Iterator[Frame]:
    """Frames of a stage from where it stands, until an episode is over, or for that long [s].

    say: called with the number of frames so far and of all; of an episode they are not known before: 0.

    Raises:
        ValueError: fps is more than the stage has.
        RuntimeError: the sheet has blown up; the frames before it have been given.
    """
    stride = stride_for(stage.recording.title, stage.recording.time_step, fps)
    if seconds is None and isinstance(stage, SceneStage):
        seconds = SECONDS
    total = 0 if seconds is None else max(1, math.ceil(positive("seconds", seconds) / (stride * stage.recording.time_step)))
    given = 0
    while True:
        yield stage.frame
        given += 1
        if say is not None:
            say(given, total)
        if given == total or stage.over:
            return
        for _ in range(stride):
            stage.advance()
        if "burst" in stage.notes:
            raise RuntimeError(stage.notes["burst"].replace("**", ""))


def stride_for(title: str, time_step: float, fps: float | None) -> int:
    """Frames of a stage, a time step [s] apart, for one of a film that shows ``fps`` a second, or the next higher rate that
    divides its own; None for 30 a second, or its own if that is less."""
    own = 1 / time_step
    fps = min(FPS, own) if fps is None else fps
    if positive("fps", fps) > 1.01 * own:
        raise ValueError(f"fps={fps!r}: {title} has {own:.4g} frames a second; ask for that or fewer")
    return max(1, int(1.01 * own / fps))


def time_step_of(name: str) -> float:
    """Of the frames of a scene or an environment [s], which may be given another one when it is made."""
    if name in SCENES:
        return STEPS * FRAME
    entry: Any = gym.spec(name.rpartition(":")[2]).entry_point
    environment: Any = gym.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return environment.task_class.physics.time_step


# --- files ----------------------------------------------------------------------------------------------------------------


def export(
    name: str,
    out: str | Path,
    *,
    seconds: float | None = None,
    fps: float | None = None,
    size: int | None = None,
    seed: int = 0,
    color: str = "fabric",
    kind: str = "obj",
    policy: str = "expert",
    settings: Mapping[str, Any] | None = None,
    say: Say | None = None,
) -> str:
    """Write what happens in a scene or an environment; a sentence on what was written.

    Args:
        name: of a scene or an environment.
        out: ``.png`` for a picture of the end, ``.webp``, ``.gif`` or ``.mp4`` for a film, ``.glb`` for a mesh that moves; without
            an ending a folder of meshes, one for each frame.
        seconds: how long; a scene's 5 and an episode's whole length by default.
        fps: frames a second, 30 or the scene's own by default; size: pixels of a side.
        color: "fabric" or "strain".
        kind: of the meshes in a folder, "obj" or "glb".
        policy, settings: see ``stage_named``; say: see ``moments``.

    Raises:
        ValueError, FileExistsError, ImportError: something that does not fit, said before anything is simulated.
        RuntimeError: the sheet has blown up; what came before is kept.
    """
    path = Path(out).expanduser()
    if path.suffix not in ("", ".glb", *NEEDED):
        endings = ".png, .webp, .gif, .mp4 or .glb"
        raise ValueError(f"out={str(out)!r}: must end in {endings}, or be a folder (without an ending) for meshes")
    if path.suffix in ("", ".glb") and color != "fabric":
        raise ValueError(f"color={color!r}: meshes only have the fabric's color; ask for a picture or a film")
    if size is not None:
        count("size", size)
    one_of("kind", kind, *KINDS)
    one_of("color", color, "fabric", "strain")
    if path.suffix == "":
        without_frames(path)
    if path.suffix in NEEDED and find_spec(NEEDED[path.suffix]) is None:
        raise ImportError(f"out={str(out)!r}: a {path.suffix} needs {NEEDED[path.suffix]}: pip install 'clothgym[video]'")
    if seconds is not None:
        positive("seconds", seconds)
    # an invalid rate is refused first
    stride_for(name, time_step_of(Gallery().checked(name)), fps)
    stage = stage_named(name, seed, policy, settings)
    rate = 1 / (stage.recording.time_step * stride_for(name, stage.recording.time_step, fps))
    if path.suffix == ".png" and seconds is not None:
        seconds += 1 / rate  # the first frame is at 0
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(path, stage.recording, moments(stage, seconds, fps, say), rate, size, color, kind)


def write(
    path: Path,
    recording: Recording,
    frames: Iterable[Frame],
    rate: float,
    size: int | None = None,
    color: str = "fabric",
    kind: str = "obj",
    camera: Camera | None = None,
) -> str:
    """Write frames of a recording, ``rate`` a second, as the ending of the path says; see ``export``."""
    if path.suffix == "":
        sequence = MeshSequence(path, *joined(recording), kind)
        for frame in frames:
            sequence.add(together(frame), frame.solids)
        return f"{sequence.written} meshes, {rate:.4g} a second, in {path}"
    if path.suffix == ".glb":
        return _write_moving_mesh(path, recording, frames, rate)
    if path.suffix == ".png":
        side = size or PICTURE
        *_, last = frames
        write_picture(path, painter(recording, side, 3, color, camera)(last))
        return f"{path}: {side} x {side} pixels, {last.time:.3g} s from the start"
    drawn, draw = 0, painter(recording, size or SIZE, 2, color, camera)

    def film() -> Iterator[Any]:
        nonlocal drawn
        for frame in frames:
            drawn += 1
            yield draw(frame)

    write_video(path, film(), rate)
    return f"{path}: {drawn} frames, {drawn / rate:.3g} s"


def _write_moving_mesh(path: Path, recording: Recording, frames: Iterable[Frame], rate: float) -> str:
    """One ``.glb`` that moves, with the solids that are there throughout; of frames that end in an error, what came before it."""
    shown: list[Frame] = []

    def written(at: Path) -> None:
        solids = lasting([frame.solids for frame in shown])
        write_animation(at, np.stack([together(frame) for frame in shown]), *joined(recording), rate, solids)

    try:
        for frame in frames:
            shown.append(frame)
    except BaseException as error:
        part = path.with_name(f"{path.stem}.part.glb")
        written(part)
        error.add_note(f"the frames before it are kept in {part}")
        raise
    written(path)
    return f"{path}: {len(shown)} frames, {len(shown) / rate:.3g} s"


def saved(kind: str, stage: Stage, moment: int, camera: Camera, color: str = "fabric") -> tuple[str, bytes]:
    """A file's name and content, for a visitor: of the frame at ``moment``, or of the frames up to it.

    Raises:
        ValueError: no such kind, or nothing to save of that kind.
        ImportError: a library that this kind needs is missing; the message says how to get it.
    """
    one_of("kind", kind, *SAVED)
    recording, name = stage.recording, stage.name.replace("/", "_")
    frames = recording.frames[max(0, moment + 1 - LONGEST) : moment + 1]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.{kind}"
        if kind == "demo":
            path = path.with_name(f"{name}_demonstration.npz")
            save_demonstration(path, stage.mine if isinstance(stage, Race) else stage)
        elif kind == "npz":
            recording.save(path)
        elif kind == "obj":
            write(Path(folder) / "frames", recording, frames, 1 / recording.time_step)
            path = Path(shutil.make_archive(str(Path(folder) / f"{name}_obj"), "zip", Path(folder) / "frames"))
        else:
            write(path, recording, frames, 1 / recording.time_step, None, color, "obj", camera)
        return path.name, path.read_bytes()


def save_demonstration(path: str | Path, stage: Stage) -> None:
    """Write what was played since the last reset as ``npz``, whole or not at all: for each step what was observed before it (an
    array for each part of a dictionary), the action and the reward; and as JSON which environment it was, with which arguments and
    seed, and how it was judged.

    ``gym.make(env, **env_kwargs)``, reset with ``seed``, gives the same observations and rewards for these actions, bit for bit.

    Raises:
        ValueError: nothing has been played, or it is no environment.
        OSError: the disk is full, or the folder cannot be written.
    """
    if not isinstance(stage, EpisodeStage) or not stage.played:
        raise ValueError("a demonstration is of an environment that has been played: drag the cloth, or let a policy act")
    observations, actions, rewards = zip(*stage.played)
    about = {"env": stage.env_id, "env_kwargs": dict(stage.env_kwargs or {}), "seed": stage.seed, "over": stage.over}
    about |= {"is_success": bool(stage.info["is_success"]), "performance": float(stage.info["normalized_performance"])}
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about)), "actions": np.stack(actions), "rewards": np.array(rewards)}
    if isinstance(observations[0], Mapping):
        arrays |= {f"observations: {name}": np.stack([one[name] for one in observations]) for name in observations[0]}
    else:
        arrays["observations"] = np.stack(observations)
    files.write_arrays(path, "demonstration", 1, arrays, compressed=True)

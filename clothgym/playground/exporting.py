"""``python -m clothgym export``: a scene or an episode as a picture, a video or meshes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym.checks import count, one_of, positive
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.pictures import joined, painter, together, write_moving_mesh
from clothgym.playground.recording import Frame
from clothgym.playground.scenes import SCENES, scene_named
from clothgym.playground.server import Gallery, policies_of
from clothgym.playground.stage import STEPS, SceneStage, Stage
from clothgym.playground.world import FRAME, Settings
from clothgym.registration import ACTORS, actor_named
from clothgym.render import MeshSequence, write_picture, write_video
from clothgym.render.meshes import KINDS, without_frames
from clothgym.simulation import GRAVITY

SECONDS, FPS, SIZE, PICTURE = 5.0, 30.0, 480, 960  # of a scene; frames a second; pixels of a video's side and of a picture's
NEEDED = {".png": "PIL", ".gif": "PIL", ".mp4": "imageio_ffmpeg"}  # to write a file with that ending; all in the extra "video"
Say = Callable[[int, int], None]


def stage_named(name: str, seed: int = 0, policy: str = "expert", settings: Mapping[str, Any] | None = None) -> Stage:
    """A scene of the playground or an environment, at its start.

    policy: who acts in an environment: "expert", "noop", "random", or the folder of a training run.  settings: of the
    playground, in place of the scene's own; a scene that begins without gravity gets it.  All are checked before the stage is made.

    Raises:
        ValueError, FileNotFoundError: an unknown scene, environment or policy, or an invalid setting.
        ImportError: a trained policy needs Stable-Baselines3, and it is missing.
    """
    bare, changes = Gallery().checked(name), dict(settings or {})
    scene = scene_named(bare) if bare in SCENES else None
    (scene.settings if scene else Settings()).changed(**changes)
    runs = [] if actor_named(policy) in ACTORS else [policy]
    _, learned = policies_of(runs, name)
    if bare in SCENES:
        stage: Stage = SceneStage(bare, seed=seed)
        if stage.settings.gravity == 0:
            changes = {"gravity": GRAVITY} | changes
    else:
        own = learned.get(bare, {})
        if runs and not own:
            raise ValueError(f"policy={policy!r}: was trained on {next(iter(learned))}, not on {bare}")
        stage = EpisodeStage(bare, own, next(iter(own), policy), seed)
    if changes:
        stage.change(**changes)
        stage.reset(seed)
    return stage


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
    """Of the frames of a scene or an environment [s]."""
    if name in SCENES:
        return STEPS * FRAME
    entry: Any = gym.spec(name.rpartition(":")[2]).entry_point
    environment: Any = gym.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return environment.task_class.physics.time_step


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
        out: ``.png`` for a picture of the end, ``.gif`` or ``.mp4`` for a film, ``.glb`` for a mesh that moves; without an ending
            a folder of meshes, one for each frame.
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
    if path.suffix not in ("", ".png", ".gif", ".mp4", ".glb"):
        raise ValueError(f"out={str(out)!r}: must end in .png, .gif, .mp4 or .glb, or be a folder (without an ending) for meshes")
    meshes = path.suffix in ("", ".glb")
    if meshes and color != "fabric":
        raise ValueError(f"color={color!r}: meshes only have the fabric's color; ask for a picture or a film")
    side = count("size", size if size is not None else PICTURE if path.suffix == ".png" else SIZE)
    one_of("kind", kind, *KINDS)
    one_of("color", color, "fabric", "strain")
    if path.suffix == "":
        without_frames(path)
    if path.suffix in NEEDED and find_spec(NEEDED[path.suffix]) is None:
        raise ImportError(f"out={str(out)!r}: a {path.suffix} needs {NEEDED[path.suffix]}: pip install 'clothgym[video]'")
    if seconds is not None:
        positive("seconds", seconds)
    # a rate that there is not is said before anything is made
    stride_for(name, time_step_of(Gallery().checked(name)), fps)
    stage = stage_named(name, seed, policy, settings)
    recording = stage.recording
    # the actions of an environment may last longer than those of its id
    rate = 1 / (recording.time_step * stride_for(name, recording.time_step, fps))
    if path.suffix == ".png" and seconds is not None:
        seconds += 1 / rate  # the first frame is at 0
    frames = moments(stage, seconds, fps, say)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == "":
        sequence = MeshSequence(path, *joined(recording), kind)
        for frame in frames:
            sequence.add(together(frame), frame.solids)
        return f"{sequence.written} meshes, {rate:.4g} a second, in {path}"
    if path.suffix == ".glb":
        shown: list[Frame] = []
        try:
            for frame in frames:
                shown.append(frame)
        except BaseException as error:
            part = path.with_name(f"{path.stem}.part.glb")
            write_moving_mesh(part, recording, shown, rate)
            error.add_note(f"the frames before it are kept in {part}")
            raise
        write_moving_mesh(path, recording, shown, rate)
        return f"{path}: {len(shown)} frames, {len(shown) / rate:.3g} s"
    draw = painter(recording, side, 3 if path.suffix == ".png" else 2, color)
    if path.suffix == ".png":
        *_, last = frames
        write_picture(path, draw(last))
        return f"{path}: {side} x {side} pixels, {last.time:.3g} s from the start"
    drawn = 0

    def film() -> Iterator[NDArray[np.uint8]]:
        nonlocal drawn
        for frame in frames:
            drawn += 1
            yield draw(frame)

    write_video(path, film(), rate)
    return f"{path}: {drawn} frames, {drawn / rate:.3g} s"

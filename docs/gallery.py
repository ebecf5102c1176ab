"""The films of docs/gallery.md, of the tasks' pages and of the README: scenes of the playground, and policies in every task.

python docs/gallery.py                  # all of them, in about a quarter of an hour
python docs/gallery.py flag cape        # some
python docs/gallery.py --hero           # the README's alone
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pictures import FILLED, Moment, corners, framed, played, side_by_side, slopes  # a script in this folder
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

import clothgym
from clothgym.evaluation import FIRST_HELD_OUT
from clothgym.forces import structural_strain
from clothgym.mesh import ClothMesh
from clothgym.playground.exporting import moments, stage_named
from clothgym.render import Camera, Renderer, write_video
from clothgym.render.heat import largest_at_particles
from clothgym.render.looks import LOOKS, PLAIN

HERE = Path(__file__).parent / "gallery"
WIDTH, HEIGHT, FPS = 480, 360, 30
STEADY = 0.4  # how slowly the camera follows [s]
RESTS, HOLD = 0.15, 0.6  # a film ends where no particle moves faster than this until the end [m/s], and stands for so long [s]


class Clip(NamedTuple):
    """A clip of a scene for ``seconds`` from ``start`` on [s], or of an episode of an environment.

    policy: who acts: "expert", or "learned", the committed policy.  speed: seconds of the episode in a second of the film.
    loop: where the motion has no end, frames over which the sheet passes from the last moments into the first.  at_least: the clip
    is the piece, at least so long [s], that begins and ends most alike; None for all.  look: of the fabric, see ``LOOKS``, or
    "gingham".  color: "fabric" or "strain".  keeps: what stays in sight: "cloth", "goals", the spheres that mark
    them, too, or "solids", too.  settings: of a scene, see ``Settings``.
    """

    name: str
    seconds: float | None = None
    start: float = 0.0
    seed: int = FIRST_HELD_OUT
    policy: str = "learned"
    speed: int = 1
    loop: int = 0
    at_least: float | None = None
    look: str = "gingham"
    color: str = "fabric"
    keeps: str = "cloth"
    settings: dict[str, Any] = {}  # noqa: RUF012 - never written to


CLIPS = {
    "patch": Clip("patch", 3.0, color="strain", seed=0),
    "flag": Clip("flag", 9.0, start=1.0, seed=1, loop=16, at_least=2.5, look="silk"),
    "sphere": Clip("sphere", 2.4, seed=0),
    "box": Clip("box", 2.4, seed=0, look="cotton_broad"),
    "pawn": Clip("pawn", 2.6, seed=0, look="denim"),
    # a figure of eight
    "cape": Clip("cape", 2 * np.pi / 0.9 + 16 / FPS, start=3.0, loop=16, seed=0, look="polyester_faille", keeps="solids"),
    "fold": Clip("fold", 5.5, seed=0, look="denim"),
    "ClothReach-v0": Clip("ClothReach-v0", look="knit", keeps="goals"),
    "ClothDrape-v0": Clip("ClothDrape-v0"),
    "ClothDrapeGripper-v0": Clip("ClothDrapeGripper-v0", look="cotton_broad"),
    "ClothHang-v0": Clip("ClothHang-v0", look="silk"),
    "ClothHang-Hard-v0": Clip("ClothHang-Hard-v0", look="silk", policy="expert"),
    "ClothHook-v0": Clip("ClothHook-v0", look="denim"),
    "ClothStrain-v0": Clip("ClothStrain-v0", color="strain"),
    "ClothFold-v0": Clip("ClothFold-v0", look="wool_tropical"),
    "ClothFold-Hard-v0": Clip("ClothFold-Hard-v0", look="silk", policy="expert"),
    "ClothFoldShirt-v0": Clip("ClothFoldShirt-v0", look="polyester_tropical"),
    "ClothFoldShirt-Hard-v0": Clip("ClothFoldShirt-Hard-v0", look="polyester", policy="expert"),
    "ClothFlattenShirt-v0": Clip("ClothFlattenShirt-v0", seed=4, look="cotton_broad", policy="expert", speed=2),
    "ClothCanonicalize-v0": Clip("ClothCanonicalize-v0", seed=FIRST_HELD_OUT + 2, look="cotton_broad", policy="expert", speed=2),
    "ClothFlattenShirt-Hard-v0": Clip(
        "ClothFlattenShirt-Hard-v0", seed=FIRST_HELD_OUT + 1, look="cotton_broad", policy="expert", speed=2
    ),
    "ClothCanonicalize-Hard-v0": Clip(
        "ClothCanonicalize-Hard-v0", seed=FIRST_HELD_OUT + 1, look="cotton_broad", policy="expert", speed=2
    ),
    "ClothFoldGoal-v0": Clip("ClothFoldGoal-v0", look="polyester"),
    "ClothFlatten-v0": Clip("ClothFlatten-v0", look="polyester_faille", speed=3),
    "ClothFling-v0": Clip("ClothFling-v0"),
    "ClothFling-Hard-v0": Clip("ClothFling-Hard-v0", look="silk", policy="expert"),
}
HERO = ("ClothFling-v0", "ClothFold-v0", "ClothDrape-v0")  # side by side, each begins again when it is over
HERO_SIZE, HERO_FPS, HERO_SECONDS = (320, 240), 20, 7.0


@dataclass(frozen=True)
class Take:
    """Moments of a sheet, ``step`` apart [s]; camera: where they are seen from; strained: the strain at which its colors end."""

    mesh: ClothMesh
    step: float
    camera: Camera
    strained: float
    shots: list[Moment]


# --- what happens ---------------------------------------------------------------------------------------------------------


def taken(clip: Clip) -> Take:
    """Simulate a clip."""
    if not clip.name.startswith("Cloth"):
        stage = stage_named(clip.name, clip.seed, settings=clip.settings)
        for _ in range(round(clip.start / stage.recording.time_step)):
            stage.advance()
        shots = [Moment(frame.time, frame.positions[0], list(frame.solids), []) for frame in moments(stage, clip.seconds, FPS)]
        if clip.loop:
            shots = looped(shots, clip.loop, None if clip.at_least is None else round(clip.at_least * FPS))
        recording = stage.recording
        return Take(recording.mesh, 1 / FPS, recording.camera, recording.strained, shots)
    if clip.policy == "learned":
        policy = clothgym.policies.load(clip.name)
        # the sheet settles in steps, so that it can be seen
        kwargs = policy.about["env_kwargs"] | {"settling": "steps"}
        episode = played(clip.name, clip.seed, lambda env, seen: policy(seen), **kwargs)
    else:
        episode = played(clip.name, clip.seed)
    task = episode.task
    step = task.physics.time_step
    return Take(task.mesh_of(0), step, task.camera(), task.strain_shown, until_rest(episode.moments[:: clip.speed], step))


def until_rest(shots: list[Moment], step: float) -> list[Moment]:
    """The shots up to where the sheet lies still, which stands for a while; step: between them [s]."""
    last = len(shots) - 1
    while last > 1 and np.abs(shots[last].positions - shots[last - 1].positions).max() < RESTS * step:
        last -= 1
    return shots[: last + 1] + [shots[last]] * round(HOLD / step)


def looped(shots: Sequence[Moment], over: int, at_least: int | None) -> list[Moment]:
    """A piece of a motion whose last moments are moved towards what comes before its first: it is the sheet that is mixed, not its
    picture, so that nothing is seen twice.  at_least: moments of the piece, or None for all."""
    x = np.stack([shot.positions for shot in shots])
    first, last = over, len(shots)
    if at_least is not None:
        pairs = [(i, j) for i in range(over, len(x)) for j in range(i + max(at_least, over), len(x) + 1)]
        first, last = min(
            pairs, key=lambda pair: float(np.square(x[pair[0] - over : pair[0]] - x[pair[1] - over : pair[1]]).mean())
        )
    shares = (np.arange(over) + 1) / (over + 1)
    eased = shares * shares * (3 - 2 * shares)
    mixed = [
        shot._replace(positions=((1 - share) * shot.positions + share * before.positions).astype(np.float32))
        for share, shot, before in zip(eased, shots[last - over : last], shots[first - over : first])
    ]
    return [*shots[first : last - over], *mixed]


# --- how it is seen -------------------------------------------------------------------------------------------------------


def followed(camera: Camera, seen: Sequence[NDArray], aspect: float, step: float, closed: bool) -> list[Camera]:
    """Cameras in one place that turn and zoom with what moves, slowly, and always have it in sight.

    seen: points of each moment [m], (points, 3).  closed: whether the first moment follows the last.
    """
    mode, sigma, eye = "wrap" if closed else "nearest", STEADY / step, np.asarray(camera.eye)
    targets = np.stack([framed(camera, points, aspect).target for points in seen]) - eye
    ways = gaussian_filter1d(targets / np.linalg.norm(targets, axis=1, keepdims=True), sigma, axis=0, mode=mode)
    turned = [replace(camera, target=tuple(eye + camera.distance * way / np.linalg.norm(way))) for way in ways]
    halves = np.array([float((np.abs(slopes(one, points)) / (aspect, 1)).max()) for one, points in zip(turned, seen)])
    halves = gaussian_filter1d(maximum_filter1d(halves, 2 * math.ceil(2 * sigma) + 1, mode=mode), sigma, mode=mode) / FILLED
    return [replace(one, vertical_fov=math.degrees(2 * math.atan(half))) for one, half in zip(turned, halves)]


def film(clip: Clip, width: int = WIDTH, height: int = HEIGHT) -> tuple[list[NDArray[np.uint8]], float, float]:
    """Frames of a clip, (height, width, 3) each; the time between two [s]; and the mean share of the cloth in the pictures."""
    take = taken(clip)
    mesh, colors = take.mesh, {} if clip.look == "gingham" else LOOKS[clip.look]._asdict()
    # cloth of one color lies in the middle of a stripe, and of a yarn
    uv = mesh.rest_positions[:, :2] + (0.525 * PLAIN if colors.get("check") == PLAIN else 0)
    points: list[NDArray] = [shot.positions for shot in take.shots]
    if clip.keeps != "cloth":
        kept = [
            shot.solids if clip.keeps == "solids" else [ball for ball in shot.markers if ball.kind == "sphere"]
            for shot in take.shots
        ]
        points = [np.concatenate([seen, corners(found)]) for seen, found in zip(points, kept)]
    cameras = followed(take.camera, points, width / height, take.step, clip.loop > 0)
    frames, shares, last = [], [], None
    for number, (shot, camera) in enumerate(zip(take.shots, cameras)):
        if shot is not last:
            renderer = Renderer(mesh.triangles, uv, camera, width, height, 2, 1, grid_shape=mesh.shape, **colors)
            values = None
            if clip.color == "strain":
                strain = structural_strain(mesh, shot.positions[None])
                values = largest_at_particles(mesh, strain)[0] / np.float32(take.strained)
            frames.append(renderer.rgb(shot.positions, shot.solids, shot.markers, values))
            if number % 10 == 0:
                shares.append(share_of_cloth(renderer, shot))
        else:
            frames.append(frames[-1])
        last = shot
    return frames, take.step, float(np.mean(shares))


def share_of_cloth(renderer: Renderer, shot: Moment) -> float:
    """Share of the pixels in which a moment's sheet is seen."""
    x = shot.positions
    return float((renderer.depth(x, shot.solids) != renderer.depth(x - (0, 0, 100), shot.solids)).mean())


def hero() -> Iterator[NDArray[np.uint8]]:
    """Frames of the README's film: three clips side by side, each of which begins again when it is over."""
    reels = []
    for name in HERO:
        frames, step, _ = film(CLIPS[name], *HERO_SIZE)
        count = round(len(frames) * step * HERO_FPS)
        reels.append([frames[min(round(k / HERO_FPS / step), len(frames) - 1)] for k in range(count)])
    for k in range(round(HERO_SECONDS * HERO_FPS)):
        yield side_by_side([reel[k % len(reel)] for reel in reels])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*", metavar="NAME", choices=[[], *CLIPS], help=f"any of {', '.join(CLIPS)}; all by default")
    parser.add_argument("--hero", action="store_true", help="the README's film alone")
    options = parser.parse_args()
    HERE.mkdir(exist_ok=True)
    for name in [] if options.hero else options.clips or CLIPS:
        path = HERE / f"{name}.webp"
        frames, step, share = film(CLIPS[name])
        write_video(path, frames, 1 / step)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {1 / step:.0f} frames/s, {100 * share:.0f} % cloth", flush=True)
    if options.hero or not options.clips:
        write_video(HERE.parent / "hero.webp", hero(), HERO_FPS)


if __name__ == "__main__":
    main()

"""The moving pictures of docs/gallery.md and of the README: every scene of the playground and every task.

python docs/gallery.py                  # all of them, in some minutes
python docs/gallery.py flag cape        # some
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.playground.exporting import moments, painter, stage_named
from clothgym.playground.recording import Frame
from clothgym.render import write_video

HERE = Path(__file__).parent / "gallery"
SIZE, FPS = 320, 15
HOLD = 12  # frames for which the end of what comes to an end stands still


class Clip(NamedTuple):
    """A clip of a scene or an environment with a seed, for ``seconds``, or to its end; from ``start`` on [s].

    loop: where the motion has no end, frames over which the sheet passes from the last moments into the first.  at_least: the clip
    is the piece, at least so long [s], that begins and ends most alike; None for all.  settings: see ``Settings``.
    """

    name: str
    seconds: float | None = None
    start: float = 0.0
    seed: int = 0
    loop: int = 0
    at_least: float | None = None
    color: str = "fabric"
    settings: dict[str, Any] = {}  # noqa: RUF012 - never written to


CLIPS = {
    "patch": Clip("patch", 3.0, color="strain"),
    "flag": Clip("flag", 9.0, start=1.0, seed=1, loop=8, at_least=2.5),
    "sphere": Clip("sphere", 2.4),
    "box": Clip("box", 2.4),
    "pawn": Clip("pawn", 2.6),
    "cape": Clip("cape", 2 * np.pi / 0.9 + 8 / FPS, start=3.0, loop=8),  # a figure of eight
    "fold": Clip("fold", 5.5),
    "reach": Clip("ClothReach-v0", seed=7),
    "drape": Clip("ClothDrape-v0", seed=7),
    "gripper": Clip("ClothDrapeGripper-v0", seed=9),
    "strain": Clip("ClothStrain-v0", seed=7, color="strain"),
}


def looped(frames: Sequence[Frame], over: int, at_least: int | None) -> list[Frame]:
    """A piece of a motion whose last frames are moved towards what comes before its first: it is the sheet that is mixed, not its
    picture, so that nothing is seen twice.  at_least: frames of the piece, or None for all."""
    x = np.stack([frame.positions for frame in frames])
    first, last = over, len(frames)
    if at_least is not None:
        pairs = [(i, j) for i in range(over, len(x)) for j in range(i + max(at_least, over), len(x) + 1)]
        first, last = min(
            pairs, key=lambda pair: float(np.square(x[pair[0] - over : pair[0]] - x[pair[1] - over : pair[1]]).mean())
        )
    shares = (np.arange(over) + 1) / (over + 1)
    eased = shares * shares * (3 - 2 * shares)
    mixed = [
        replace(frame, positions=((1 - share) * frame.positions + share * before.positions).astype(np.float32))
        for share, frame, before in zip(eased, frames[last - over : last], frames[first - over : first])
    ]
    return [*frames[first : last - over], *mixed]


def film(clip: Clip) -> list[NDArray[np.uint8]]:
    """The frames of a clip, (SIZE, SIZE, 3) each, so that the last goes with the first, and with the sheet in sight in all."""
    from pictures import corners, framed  # a script in this folder

    stage = stage_named(clip.name, clip.seed, settings=clip.settings)
    for _ in range(round(clip.start / stage.recording.time_step)):
        stage.advance()
    frames = list(moments(stage, clip.seconds, FPS))
    if clip.loop:
        frames = looped(frames, clip.loop, None if clip.at_least is None else round(clip.at_least * FPS))
    large = [
        [solid for solid in frame.solids if max(solid.rounded_box()[1].max(), solid.rounded_box()[2]) > 0.05] for frame in frames
    ]
    points = [*(frame.positions.reshape(-1, 3) for frame in frames), *map(corners, large)]
    draw = painter(stage.recording, SIZE, 3, clip.color, framed(stage.recording.camera, np.concatenate(points)))
    return [draw(frame) for frame in frames] + ([] if clip.loop else [draw(frames[-1])] * HOLD)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*", metavar="NAME", choices=[[], *CLIPS], help=f"any of {', '.join(CLIPS)}; all by default")
    HERE.mkdir(exist_ok=True)
    for name in parser.parse_args().clips or CLIPS:
        path = HERE / f"{name}.gif"
        write_video(path, film(CLIPS[name]), FPS)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()

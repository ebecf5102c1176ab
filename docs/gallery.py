"""The moving pictures of docs/gallery.md and of the README: every scene of the playground and every task.

python docs/gallery.py                  # all of them, in some minutes
python docs/gallery.py flag cape        # some
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.playground.exporting import moments, stage_named
from clothgym.playground.pictures import painter
from clothgym.render import write_video

HERE = Path(__file__).parent / "gallery"
SIZE, FPS = 320, 15
HOLD = 12  # frames for which the end of what comes to an end stands still


class Clip(NamedTuple):
    """What is filmed: a scene or an environment from a seed on, for ``seconds``, or to its end; from ``start`` on [s].

    fade: frames over which the end passes into the beginning, where the motion has no end; settings: see ``Settings``.
    """

    name: str
    seconds: float | None = None
    start: float = 0.0
    seed: int = 0
    fade: int = 0
    color: str = "fabric"
    settings: dict[str, Any] = {}  # noqa: RUF012 - never written to


CLIPS = {
    "patch": Clip("patch", 3.0, color="strain"),
    "flag": Clip("flag", 4.0, start=1.0, seed=1, fade=10),
    "sphere": Clip("sphere", 2.4),
    "box": Clip("box", 2.4),
    "pawn": Clip("pawn", 2.6),
    "cape": Clip("cape", 2 * np.pi / 0.9 + 8 / FPS, start=3.0, fade=8),  # a figure of eight
    "fold": Clip("fold", 5.5),
    "reach": Clip("ClothReach-v0", seed=7),
    "drape": Clip("ClothDrape-v0", seed=7),
    "gripper": Clip("ClothDrapeGripper-v0", seed=9),
    "strain": Clip("ClothStrain-v0", seed=7, color="strain"),
}


def film(clip: Clip) -> list[NDArray[np.uint8]]:
    """The frames of a clip, (SIZE, SIZE, 3) each, so that the last goes with the first."""
    stage = stage_named(clip.name, clip.seed, settings=clip.settings)
    for _ in range(round(clip.start / stage.recording.time_step)):
        stage.advance()
    draw = painter(stage.recording, SIZE, 3, clip.color)
    frames = [draw(frame) for frame in moments(stage, clip.seconds, FPS)]
    if not clip.fade:
        return frames + frames[-1:] * HOLD
    shares = (np.arange(clip.fade) + 1) / (clip.fade + 1)
    ends = zip(shares, frames[-clip.fade :], frames[: clip.fade])
    mixed = [np.round((1 - share) * last + share * first).astype(np.uint8) for share, last, first in ends]
    return frames[clip.fade : -clip.fade] + mixed


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

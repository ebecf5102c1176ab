"""Frames to a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float = 30.0) -> None:
    """Write frames, (height, width, 3) uint8 each, as a looped ``.gif`` or an ``.mp4``.

    Raises:
        ValueError: another ending, no frames, frames of different sizes, or an fps that is not positive.
        ImportError: pillow (for a gif) or imageio-ffmpeg (for an mp4) is missing.
    """
    path = Path(path)
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"video path={str(path)!r}: must end in .gif or .mp4")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps={fps!r}: must be positive and finite")
    images = [np.asarray(frame) for frame in frames]
    if not images:
        raise ValueError("frames are empty: a video needs at least one")
    for number, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.shape != images[0].shape:
            raise ValueError(
                f"frame {number} has shape {image.shape} and dtype {image.dtype}: all must be (height, width, 3) uint8 of one size"
            )
    if path.suffix == ".gif":
        _write_gif(path, images, fps)
    else:
        _write_mp4(path, images, fps)


def _write_gif(path: Path, images: list[NDArray[np.uint8]], fps: float) -> None:
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError("a .gif needs pillow: pip install 'clothgym[video]'") from error
    # one palette for all frames, learned from some of them: with one each, the floor would flicker
    sample = np.concatenate(images[:: max(1, len(images) // 8)], axis=0)
    palette = Image.fromarray(sample).quantize(256, method=Image.Quantize.MEDIANCUT)
    pages = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for image in images]
    # a gif counts in hundredths of a second; players slow down anything below two of them
    hundredths = max(2, round(100 / fps))
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=10 * hundredths, loop=0, optimize=True)


def _write_mp4(path: Path, images: list[NDArray[np.uint8]], fps: float) -> None:
    try:
        from imageio_ffmpeg import write_frames
    except ImportError as error:
        raise ImportError("an .mp4 needs imageio-ffmpeg: pip install 'clothgym[video]'") from error
    height, width = images[0].shape[:2]
    # players want an even number of rows and columns
    extra = ((0, height % 2), (0, width % 2), (0, 0))
    writer = write_frames(str(path), (width + width % 2, height + height % 2), fps=fps, quality=8, macro_block_size=1)
    writer.send(None)
    try:
        for image in images:
            writer.send(np.ascontiguousarray(np.pad(image, extra, mode="edge")))
    finally:
        writer.close()

"""Pictures and films as files, each of which is written completely or not at all."""

from __future__ import annotations

import errno
import io
import itertools
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import files

QUALITY = 40  # of a webp, of 100


def write_picture(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write an image, (height, width, 3) uint8, as a ``.png``.

    Raises:
        ValueError: another ending, or an array that is not an image.
        ImportError: pillow is missing.
    """
    path = Path(path).expanduser()
    if path.suffix != ".png":
        raise ValueError(f"picture path={str(path)!r}: must end in .png")
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image has shape {image.shape} and dtype {image.dtype}: must be (height, width, 3) uint8")
    content = io.BytesIO()
    _pillow(".png").fromarray(image).save(content, "png", optimize=True)
    files.write(path, content.getvalue())


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float = 30.0) -> None:
    """Write frames, (height, width, 3) uint8 each, as a looped ``.webp`` or ``.gif``, or as an ``.mp4``.

    Frames may come from a generator, and are written to an ``.mp4`` one by one.  If it raises, the frames so far are kept next to
    ``path``, as ``NAME.part.mp4``, and the error says so.

    Raises:
        ValueError: another ending, no frames, frames of different sizes, or an fps that is not positive.
        OSError: the disk is full, or the folder cannot be written; then nothing is kept.
        ImportError: pillow (for a webp or a gif) or imageio-ffmpeg (for an mp4) is missing.
    """
    path = Path(path).expanduser()
    if path.suffix not in WRITERS:
        raise ValueError(f"video path={str(path)!r}: must end in .webp, .gif or .mp4")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps={fps!r}: must be positive and finite")
    images = _checked(frames)
    first = next(images, None)
    if first is None:
        raise ValueError("frames are empty: a video needs at least one")
    kept = path.with_name(f"{path.stem}.part{path.suffix}")
    with files.replacing(path) as scratch:
        try:
            WRITERS[path.suffix](scratch, first, images, fps)
        except OSError:
            raise
        except BaseException as error:
            if scratch.exists():
                scratch.replace(kept)
                error.add_note(f"the frames before it are kept in {kept}")
            raise


def _checked(frames: Iterable[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """The frames as arrays; raises ValueError for one that is not an image of the size of the first."""
    shape = None
    for number, frame in enumerate(frames):
        image = np.asarray(frame)
        shape = image.shape if shape is None else shape
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.shape != shape:
            raise ValueError(
                f"frame {number} has shape {image.shape} and dtype {image.dtype}: all must be (height, width, 3) uint8 of one size"
            )
        yield image


def _write_webp(path: Path, first: NDArray[np.uint8], others: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Each frame as what differs from the one before; times are rounded to milliseconds, and do not drift."""
    pillow = _pillow(".webp")
    pages = [pillow.fromarray(first)]
    try:
        pages.extend(map(pillow.fromarray, others))
    finally:
        ends = [round(1000 * (k + 1) / fps) for k in range(len(pages))]
        durations = [end - begin for begin, end in zip([0, *ends], ends)]
        pages[0].save(path, "webp", save_all=True, append_images=pages[1:], duration=durations, loop=0, quality=QUALITY, method=4)


def _pillow(suffix: str) -> Any:
    """``PIL.Image``; raises ImportError that names the ending and the extra."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(f"a {suffix} needs pillow: pip install 'clothgym[video]'") from error
    return Image


def _write_gif(path: Path, first: NDArray[np.uint8], others: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """All frames with one palette."""
    pillow = _pillow(".gif")
    images = [first]
    try:
        for image in others:
            images.append(image)
    finally:
        # one palette for all frames, from a sample of them: with one each, the floor would flicker
        sample = np.concatenate(images[:: max(1, len(images) // 8)], axis=0)
        palette = pillow.fromarray(_with_rare_colors(sample)).quantize(256, method=pillow.Quantize.MEDIANCUT)
        pages = [pillow.fromarray(image).quantize(palette=palette, dither=pillow.Dither.FLOYDSTEINBERG) for image in images]
        # a gif counts in hundredths of a second; players slow down anything below two of them
        hundredths, film = max(2, round(100 / fps)), io.BytesIO()
        pages[0].save(film, "gif", save_all=True, append_images=pages[1:], duration=10 * hundredths, loop=0, optimize=True)
        path.write_bytes(film.getvalue())


def _with_rare_colors(sample: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image, and below it all its colors on equal areas of the same size in total, so that small things keep their color."""
    _, first = np.unique((sample.reshape(-1, 3) >> 3).astype(np.uint32) @ [1024, 32, 1], return_index=True)
    colors = sample.reshape(-1, 3)[first]
    return np.concatenate([sample, np.resize(colors, sample.shape)], axis=0)


def _write_mp4(path: Path, first: NDArray[np.uint8], others: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Frames as they come; the last row and column are repeated where their number is odd."""
    try:
        from imageio_ffmpeg import write_frames
    except ImportError as error:
        raise ImportError("an .mp4 needs imageio-ffmpeg: pip install 'clothgym[video]'") from error
    height, width = first.shape[:2]
    # players need an even number of rows and columns
    extra = ((0, height % 2), (0, width % 2), (0, 0))
    writer = write_frames(str(path), (width + width % 2, height + height % 2), fps=fps, quality=8, macro_block_size=1)
    writer.send(None)
    try:
        for image in itertools.chain([first], others):
            writer.send(np.ascontiguousarray(np.pad(image, extra, mode="edge")))
    finally:
        writer.close()
        if not _is_whole(path):
            raise OSError(errno.EIO, "ffmpeg could not finish the film, for instance as the disk is full")


def _is_whole(path: Path) -> bool:
    """Whether an ``.mp4`` has its index, which ffmpeg writes last (ISO/IEC 14496-12: boxes of a size and a name)."""
    with open(path, "rb") as file:
        while len(head := file.read(16)) >= 8:
            size, name = struct.unpack(">I4s", head[:8])
            size = struct.unpack(">Q", head[8:])[0] if size == 1 and len(head) == 16 else size
            if name == b"moov" or size < 8:
                return name == b"moov"
            file.seek(size - len(head), io.SEEK_CUR)
    return False


WRITERS = {".webp": _write_webp, ".gif": _write_gif, ".mp4": _write_mp4}

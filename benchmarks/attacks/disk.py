"""A full disk: one sentence, what had the name before is whole, nothing half is left, and training goes on once there is room.

Each attack forks.  In the child no file may be longer than some size, which the operating system sees to; or the disk is full from
the n-th step of writing on, and stays so.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import resource
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
from attacks import kills
from attacks.files import _environment, _save_checkpoint, _simulation, _stage

from clothgym import cli, files
from clothgym.render.export import write_picture, write_video

HAS_TORCH = importlib.util.find_spec("torch") is not None
FILM = np.random.default_rng(0).integers(256, size=(4, 64, 64, 3)).astype(np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "state.npz": lambda path: _simulation().get_state().save(path),
    "task.npz": lambda path: _environment().get_state().save(path),
    "recording.npz": lambda path: _stage().recording.save(path),
    "object.json": lambda path: files.write_json(path, {"x" * 99: [1] * 999}),
    "image.png": lambda path: write_picture(path, FILM[0]),
    "film.gif": lambda path: write_video(path, FILM),
    "film.mp4": lambda path: write_video(path, FILM),
    **({"checkpoint.pt": _save_checkpoint} if HAS_TORCH else {}),
}
EXPORTS = ("picture.png", "film.gif", "film.mp4", "scene.glb")


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    forms = [(saved, list(WRITERS)), (exported, EXPORTS), *([(trained, ("from a step on", "by size"))] if HAS_TORCH else [])]
    while True:
        form, names = forms[rng.integers(len(forms))]
        name, seed = str(rng.choice(names)), int(rng.integers(2**31))
        yield f"attacks.disk.{form.__name__}({name!r}, {seed})", lambda form=form, name=name, seed=seed: form(name, seed)  # type: ignore[misc]


def saved(name: str, seed: int) -> None:
    """Write a file that has been there before to a disk on which it does not fit.

    Raises:
        AssertionError: another outcome than an error of the writer, with the file before whole and alone.
    """
    size = _size(name)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / name).write_bytes(b"before")

        def write() -> None:
            _limit(int(np.random.default_rng(seed).integers(size)))
            try:
                WRITERS[name](Path(folder) / name)
            except OSError as error:
                raise SystemExit(0 if "whole" in str(error) else 3) from None
            raise SystemExit(4)

        status, said = kills.forked(write)
        left = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    assert status == 0, f"status {status}: {said[-500:]}"
    assert left == {name: b"before"}, f"left: {list(left)}"


def exported(name: str, seed: int) -> None:
    """Export a scene to a disk on which the file does not fit.

    Raises:
        AssertionError: another outcome than one sentence, and nothing left.
    """
    with tempfile.TemporaryDirectory() as folder:
        arguments = ["export", "patch", "--seconds", "0.1", "--size", "64", "--out", f"{folder}/{name}"]

        def export() -> None:
            _limit(int(np.random.default_rng(seed).integers(1000)))
            raise SystemExit(cli.main(arguments))

        status, said = kills.forked(export)
        left = [path.name for path in Path(folder).iterdir()]
    assert status == 2 and "could not be written" in said and "Traceback" not in said, f"status {status}: {said[-500:]}"
    assert left == [], f"left: {left}"


def trained(form: str, seed: int) -> None:
    """Train on a disk that fills up, and go on when there is room.

    Raises:
        AssertionError: it ends otherwise than with a sentence, leaves half a file, or does not go on.
    """
    rng = np.random.default_rng(seed)
    if form == "by size":
        most = int(10 ** rng.uniform(1, 5))
        prepare: Callable[[], None] = lambda: _limit(most)  # noqa: E731
    else:
        step = int(rng.integers(kills.STEPS_OF_WRITING))
        prepare = lambda: _full_from(step)  # noqa: E731
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = folder / "run"
        status, said = kills.trained(folder, "--run", str(run), "--env", "ClothReach-v0", prepare=prepare)
        assert "Traceback" not in said, said[-500:]
        assert status == 0 or (status == 1 and "error:" in said), f"status {status}: {said[-500:]}"
        left = [path.name for path in run.rglob("*") if ".part" in path.name or path.suffix == ".new"] if run.exists() else []
        assert left == [], f"left: {left}"
        if (run / "config.json").exists():
            status, said = kills.trained(folder, "--resume", str(run))
            assert status == 0 and (run / "evaluation.json").exists(), f"resumed with status {status}: {said[-500:]}"


# --- a full disk ----------------------------------------------------------------------------------------------------------------


@cache
def _size(name: str) -> int:
    """Bytes of a file as it is written where there is room."""
    with tempfile.TemporaryDirectory() as folder:
        WRITERS[name](Path(folder) / name)
        return (Path(folder) / name).stat().st_size


def _limit(size: int) -> None:
    """No file may become longer than this from now on, in this process and in those that it starts."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def _full_from(step: int) -> None:
    """From the n-th step of writing on: half of the bytes, and no space left on the device."""
    left, write, sync = [step], Path.write_bytes, os.fsync

    def full() -> bool:
        left[0] -= 1
        return left[0] < 0

    def write_bytes(path: Path, content: bytes) -> int:
        if full():
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, content)

    def synced(file: int) -> None:
        if full():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(file)

    Path.write_bytes, os.fsync = write_bytes, synced  # type: ignore[method-assign, assignment]

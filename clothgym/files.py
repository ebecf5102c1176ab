"""Floor 0: the project's own files: written whole or not at all, and read with a bound, a version and a checksum.

Arrays are plain ``npz`` files, which ``numpy.load`` reads too.  Their archive comment is a mark: what the file is, the version of
its format, and the SHA-256 of every byte before that.  PyTorch's checkpoints are zip archives as well, and have the same mark.  A
JSON object has its checksum as one more entry.  The checksums find damage; they do not prove who wrote a file.  Files are therefore
read as untrusted: nothing is unpickled, and sizes are compared before memory is allocated.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import re
import stat
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST = 2**31  # bytes of a file, and of its unpacked content
LARGEST_JSON = 2**24
CHECKSUM = "sha256"
HEX = 64  # digits of a SHA-256
PLAIN = "biufU"  # kinds of arrays: booleans, integers, numbers and text
MARK = re.compile(rb"clothgym ([a-z ]{1,40}), version ([0-9]{1,9}), sha256 $")


class Unwritten(OSError):
    """A file could not be written; the message names the complete files and the remedy."""

    def __init__(self, path: Path, error: OSError) -> None:
        super().__init__(
            error.errno,
            f"{str(path)!r} could not be written ({error.strerror or error}): nothing of it is left, and what had that name before "
            "is whole; make room or name another place, and do it again",
        )

    def __str__(self) -> str:
        return str(self.strerror)


# --- writing ------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def replacing(path: str | Path, before: Path | None = None) -> Iterator[Path]:
    """A temporary file in the folder of ``path``.  At the end it is synced and renamed; after an error it is removed.

    before: where what had the name is kept; it is lost otherwise.

    Raises:
        ValueError: ``path`` is a device, a pipe or a folder.
        Unwritten: the disk is full, or the folder cannot be written.
    """
    path = Path(path).expanduser().resolve()
    if path.exists() and not path.is_file():
        raise ValueError(f"{str(path)!r} is no regular file: name one that can be replaced")
    part = path.with_name(f".{path.stem}.{os.urandom(4).hex()}.part{path.suffix}")
    try:
        yield part
        _sync(part, os.O_RDWR)
        if before is not None and path.exists():
            path.replace(before)
        part.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise Unwritten(path, error) from error
        raise
    # the name is in the folder; not every file system syncs one
    with contextlib.suppress(OSError):
        _sync(path.parent, os.O_RDONLY)


def write(path: str | Path, content: bytes | str) -> None:
    """Write a file, whole or not at all; see ``replacing``."""
    with replacing(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def _sync(path: Path, flags: int) -> None:
    file = os.open(path, flags)
    try:
        os.fsync(file)
    finally:
        os.close(file)


# --- reading ------------------------------------------------------------------------------------------------------------


def read(path: str | Path, most: int = LARGEST) -> bytes:
    """The content of a regular file of at most so many bytes; within ``naming``, which adds the file's name.

    Raises:
        OSError: there is none, or it cannot be read.
        ValueError: it is a device, a pipe or a folder, or too large.
    """
    path = Path(path).expanduser()
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("it is no regular file")
    with open(path, "rb") as file:
        content = file.read(most + 1) if about.st_size <= most else None
    if content is None or len(content) > most:
        raise ValueError(f"it is larger than the {most / 2**20:,.0f} MB that are read")
    return content


@contextlib.contextmanager
def naming(path: str | Path, kind: str, advice: str) -> Iterator[None]:
    """What goes wrong while a file is read, as one sentence with its name.

    Raises:
        FileNotFoundError: there is none.
        ValueError: anything else: libraries raise all kinds of errors on a file that they do not expect.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except Exception as error:
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        why = said.strip().splitlines() or [type(error).__name__]
        raise ValueError(f"{str(path)!r} is no {kind} ({why[0][:200]}): {advice}") from error


# --- archives with a mark -----------------------------------------------------------------------------------------------


def marked(archive: bytes, kind: str, version: int) -> bytes:
    """A zip archive without a comment, with the mark."""
    mark = f"clothgym {kind}, version {version}, {CHECKSUM} ".encode()
    # the archive ends with the length of its comment
    body = archive[:-2] + struct.pack("<H", len(mark) + HEX) + mark
    return body + hashlib.sha256(body).hexdigest().encode()


def unmarked(content: bytes, kind: str, version: int) -> bytes:
    """The archive, if its mark is right.

    Raises:
        ValueError: it has none, is damaged, or is something else.
    """
    found, view = MARK.search(content[-HEX - 100 : -HEX]), memoryview(content)
    if found is None:
        raise ValueError("its end lacks the mark of clothgym's files: it is cut off, or of another program or an older version")
    if hashlib.sha256(view[:-HEX]).hexdigest().encode() != content[-HEX:]:
        raise ValueError("it is damaged: its checksum is not that of its content")
    if found[1].decode() != kind:
        raise ValueError(f"it is a {found[1].decode()}")
    if int(found[2]) != version:
        raise ValueError(f"its format has version {int(found[2])}, this clothgym reads version {version}")
    return content


def opened(archive: bytes) -> zipfile.ZipFile:
    """An archive whose members are together not larger than LARGEST."""
    opened = zipfile.ZipFile(io.BytesIO(archive))
    if sum(member.file_size for member in opened.infolist()) > LARGEST:
        raise ValueError(f"unpacked it is larger than {LARGEST / 2**20:,.0f} MB")
    return opened


def write_arrays(path: str | Path, kind: str, version: int, arrays: Mapping[str, Any], compressed: bool = False) -> None:
    """Write arrays as ``npz`` without pickle, with a mark.

    Raises:
        ValueError: they are more than can be read again.
        Unwritten: the disk is full, or the folder cannot be written.
    """
    named = {name: np.asarray(value) for name, value in arrays.items()}
    for name, array in named.items():
        if array.dtype.kind not in PLAIN:
            raise ValueError(f"{name} is of {array.dtype}: a {kind} holds numbers and text only")
    size = sum(array.nbytes for array in named.values())
    if size > LARGEST // 2:
        raise ValueError(
            f"a {kind} of {size / 2**20:,.0f} MB is too large for a file, which holds {LARGEST / 2**21:,.0f} MB at most"
        )
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **named)  # type: ignore[arg-type]
    write(path, marked(buffer.getvalue(), kind, version))


def read_arrays(path: str | Path, kind: str, version: int, advice: str) -> dict[str, NDArray]:
    """What ``write_arrays`` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is something else, or damaged; the sentence has its name.
    """
    with naming(path, kind, advice), opened(unmarked(read(path), kind, version)) as archive:
        names = [member.filename.removesuffix(".npy") for member in archive.infolist()]
        if len(set(names)) < len(names):
            raise ValueError("two of its arrays have one name")
        return {name: _array(archive, member) for name, member in zip(names, archive.infolist())}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray:
    """One array, whose header is held against the member's size before memory is taken."""
    with archive.open(member) as file:
        read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
        shape, fortran, dtype = read_header[np.lib.format.read_magic(file)[0]](file)
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind not in PLAIN or min(shape, default=0) < 0 or size != member.file_size - file.tell():
            raise ValueError(f"{member.filename} has another size than its shape {shape} of {dtype} needs")
        content = bytearray(file.read(size))
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


# --- JSON with a checksum -----------------------------------------------------------------------------------------------


def checked_in(content: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with its checksum as one more entry."""
    plain = json.loads(json.dumps(dict(content), default=float))
    return plain | {CHECKSUM: _checksum(plain)}


def checked_out(content: Any) -> dict[str, Any]:
    """The object without its checksum.

    Raises:
        ValueError: it is no object, or its checksum is missing or another's.
    """
    if not isinstance(content, dict):
        raise ValueError(f"it holds {type(content).__name__} instead of an object")
    plain = {name: value for name, value in content.items() if name != CHECKSUM}
    if CHECKSUM not in content:
        raise ValueError("it has no checksum: it is of another program or an older version, or was edited")
    if content[CHECKSUM] != _checksum(plain):
        raise ValueError("it was damaged or edited after it was written: its checksum is not that of its content")
    return plain


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write an object with its checksum."""
    write(path, json.dumps(checked_in(content), indent=1) + "\n")


def read_json(path: str | Path, kind: str, advice: str) -> dict[str, Any]:
    """What ``write_json`` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is something else, or damaged; the sentence has its name.
    """
    with naming(path, kind, advice):
        return checked_out(json.loads(read(path, LARGEST_JSON)))


def _checksum(plain: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

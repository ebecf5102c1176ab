"""Floor 1: mesh files as they are written: polygons between numbered vertices.

Formats whose faces may have any number of corners, obj, off and ply, are read here: trimesh would cut each face into a fan of
triangles, which folds concave ones, and it renumbers the vertices of some.  trimesh reads other formats, whose faces are triangles.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import shown

# types of numbers in ply files, by both of their names
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_CORNERS = ("vertex_indices", "vertex_index")  # the property of a face that names its corners


class Polygons(NamedTuple):
    """The faces of a file.

    vertices: in the file's order and unit, (vertices, 3).  corners: vertices of all faces from 0, one face after the other,
    (corners,).  sizes: corners of each face, (faces,).  first: the number that the file gives to its first vertex and face.
    """

    vertices: NDArray[np.float64]
    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    first: int

    def faces(self) -> Iterator[NDArray[np.int64]]:
        """The corners of each face."""
        end = 0
        for size in self.sizes.tolist():
            yield self.corners[end : end + size]
            end += size


def read_polygons(path: str | Path, who: str, what: str) -> Polygons:
    """The faces of a mesh file.

    who, what: the caller and the kind of object that it reads, for error messages.

    Raises:
        ImportError: a format for which trimesh is needed, and it is missing.
        ValueError: there is no such file, it cannot be read or holds no faces, or a face names a vertex that is not there.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"path={shown(path)}: must be the name of a file")
    if not os.path.isfile(path):
        problem = "it is a folder: name a file in it" if os.path.isdir(path) else "there is no such file: check the path"
        raise ValueError(f"{shown(str(path))}: {problem}")
    ending = Path(path).suffix.lower()
    advice = f"export the {what} as a triangle mesh, for instance obj or ply"
    read = READERS.get(ending) or _with_trimesh(who, ending)
    try:
        found = read(path)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        raise ValueError(f"{str(path)!r} cannot be read as a mesh ({error or type(error).__name__}): {advice}") from error
    if found is None or not len(found.sizes):
        raise ValueError(f"{str(path)!r} holds no triangles: {advice}")
    _check_numbers(path, what, found)
    return found


def _check_numbers(path: str | Path, what: str, found: Polygons) -> None:
    """Refuse a face that names a vertex that is not there."""
    wrong = (found.corners < 0) | (found.corners >= len(found.vertices))
    if not wrong.any():
        return
    face = int(np.searchsorted(np.cumsum(found.sizes), np.argmax(wrong), side="right"))
    begin = int(found.sizes[:face].sum())
    corners = (found.corners[begin : begin + found.sizes[face]] + found.first).tolist()
    kind = "triangle" if len(corners) == 3 else "face"
    raise ValueError(
        f"{str(path)!r} is not a {what}: {kind} {face + found.first} is {shown(corners)}: must name vertices from {found.first} to "
        f"{len(found.vertices) - 1 + found.first}"
    )


def _with_trimesh(who: str, ending: str) -> Callable[[str | Path], Polygons | None]:
    """A reader of any other format.

    Raises:
        ImportError: trimesh is missing.
    """
    try:
        import trimesh
    except ImportError:
        raise ImportError(
            f"{who} reads files of the kind {ending!r} with trimesh: pip install 'clothgym[mesh]', or take obj, off or ply"
        ) from None

    def read(path: str | Path) -> Polygons | None:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        if not isinstance(loaded, trimesh.Trimesh):
            return None
        faces = np.array(loaded.faces, np.int64).reshape(-1, 3)
        return Polygons(np.array(loaded.vertices, np.float64), faces.ravel(), np.full(len(faces), 3), 0)

    return read


def _polygons(vertices: list[list[float]], faces: list[list[int]], first: int) -> Polygons:
    corners = np.array([corner for face in faces for corner in face], np.int64)
    return Polygons(
        np.array(vertices, np.float64).reshape(-1, 3), corners, np.array([len(face) for face in faces], np.int64), first
    )


def _lines(path: str | Path) -> Iterator[tuple[int, str, list[str]]]:
    """Number, text and words of each line of a text file, without comments; lines that end in a backslash go on in the next."""
    text, begun = Path(path).read_bytes().decode("utf-8-sig", errors="replace"), ""
    for number, line in enumerate(text.splitlines(), 1):
        line = begun + line.split("#", 1)[0].rstrip()
        begun = line[:-1] + " " if line.endswith("\\") else ""
        if not begun and (words := line.split()):
            yield number, line.strip(), words


def _three(number: int, line: str, words: list[str]) -> list[float]:
    """The position that a line gives."""
    try:
        x, y, z = map(float, words[:3])
    except ValueError:
        raise ValueError(f"line {number}, {shown(line)}, is no vertex of three numbers") from None
    return [x, y, z]


def _read_obj(path: str | Path) -> Polygons:
    """Vertices and faces of a Wavefront file; its numbers begin with 1, and negative ones count back from the last vertex."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, line, words in _lines(path):
        if words[0] == "v":
            vertices.append(_three(number, line, words[1:]))
        elif words[0] == "f":
            try:
                named = [int(word.split("/", 1)[0]) for word in words[1:]]
            except ValueError:
                raise ValueError(f"line {number}, {shown(line)}, is no face of vertices' numbers") from None
            if 0 in named:
                raise ValueError(f"line {number}, {shown(line)}, names vertex 0: the first is 1")
            faces.append([corner - 1 if corner > 0 else len(vertices) + corner for corner in named])
    return _polygons(vertices, faces, 1)


def _read_off(path: str | Path) -> Polygons:
    """Vertices and faces of an Object File Format file."""
    lines = _lines(path)
    _, header, words = next(lines, (0, "", [""]))
    if not words[0].endswith("OFF") or words[0].startswith(("4", "n")) or "BINARY" in words:
        raise ValueError(f"{shown(header)} is not how an off file of text begins")
    counts = words[1:] or next(lines, (0, "", []))[2]
    if len(counts) < 2 or not (counts[0] + counts[1]).isdigit():
        raise ValueError("it does not say how many vertices and faces there are")
    rows = [next(lines, None) for _ in range(int(counts[0]) + int(counts[1]))] if max(map(len, counts[:2])) < 9 else [None]
    if None in rows:
        raise ValueError(f"it ends before its {counts[0]} vertices and {counts[1]} faces")
    vertices = [_three(*row) for row in rows[: int(counts[0])] if row]
    faces = []
    for number, line, words in filter(None, rows[int(counts[0]) :]):
        size = int(words[0]) if words[0].isdigit() else 0
        if not 0 < size < len(words) or not all(word.removeprefix("-").isdigit() for word in words[1 : size + 1]):
            raise ValueError(f"line {number}, {shown(line)}, is no face of vertices' numbers")
        faces.append([int(word) for word in words[1 : size + 1]])
    return _polygons(vertices, faces, 0)


def _read_ply(path: str | Path) -> Polygons | None:
    """Vertices and faces of a Stanford polygon file, of text or binary."""
    data = Path(path).read_bytes()
    end = data.find(b"end_header")
    begin = data.find(b"\n", end) + 1
    header = [line.split() for line in data[: max(end, 0)].decode("latin-1").splitlines() if line.strip()]
    orders = [PLY_ORDERS.get(words[1]) for words in header[1:] if words[0] == "format" and len(words) > 1]
    if not header or header[0] != ["ply"] or len(orders) != 1 or orders[0] is None or not begin:
        raise ValueError("it does not begin with the header of a ply file")
    # the elements with their properties: name, type of the number, and of the length of a list
    elements: list[tuple[str, int, list[tuple[str, str, str]]]] = []
    for words in header:
        if words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            kinds = [PLY_TYPES[word] for word in (words[2:4] if words[1] == "list" else words[1:2])]
            elements[-1][2].append((words[-1], kinds[-1], kinds[0] if words[1] == "list" else ""))
    read = _ply_text(data[begin:]) if orders[0] == "" else _ply_bytes(data, begin, orders[0])
    columns = {name: read(count, properties) for name, count, properties in elements}
    faces = next((columns["face"][name] for name in PLY_CORNERS if name in columns.get("face", {})), None)
    if "vertex" not in columns or not faces:
        return None
    x = np.stack([np.asarray(columns["vertex"][axis], np.float64) for axis in "xyz"], axis=1)
    return _polygons(x.tolist(), [list(map(int, face)) for face in faces], 0)


Columns = Callable[[int, list[tuple[str, str, str]]], dict[str, list[Any]]]


def _ply_text(data: bytes) -> Columns:
    """A reader of so many elements of text with these properties, from where it was last time."""
    words = iter(data.split())

    def read(count: int, properties: list[tuple[str, str, str]]) -> dict[str, list[Any]]:
        columns: dict[str, list[Any]] = {name: [] for name, _, _ in properties}
        for _ in range(count):
            for name, _, length in properties:
                try:
                    value: Any = [float(next(words)) for _ in range(int(next(words)))] if length else float(next(words))
                except (StopIteration, RuntimeError):
                    raise ValueError("it ends early") from None
                columns[name].append(value)
        return columns

    return read


def _ply_bytes(data: bytes, at: int, order: str) -> Columns:
    """The same of bytes, from position ``at``; order: "<" or ">", of the bytes in a number."""

    def read(count: int, properties: list[tuple[str, str, str]]) -> dict[str, list[Any]]:
        nonlocal at
        # without lists all elements have one size
        if not any(length for _, _, length in properties):
            rows = np.frombuffer(data, [(name, order + kind) for name, kind, _ in properties], count, at)
            at += rows.nbytes
            return {name: rows[name].tolist() for name, _, _ in properties}
        columns: dict[str, list[Any]] = {name: [] for name, _, _ in properties}
        codes = {kind: struct.Struct(order + np.dtype(kind).char) for _, *kinds in properties for kind in kinds if kind}
        for _ in range(count):
            for name, kind, length in properties:
                if not length:
                    columns[name].append(codes[kind].unpack_from(data, at)[0])
                    at += codes[kind].size
                    continue
                size = codes[length].unpack_from(data, at)[0]
                at += codes[length].size
                columns[name].append(struct.unpack_from(f"{order}{size}{codes[kind].format[-1]}", data, at))
                at += size * codes[kind].size
        return columns

    return read


READERS: dict[str, Callable[[str | Path], Polygons | None]] = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}

"""Meshes as binary glTF 2.0 (Khronos 2021): one moment, or an animation that Blender and web viewers play.

Written without a library, since the file must hold exactly the simulated float32 values, and morph targets.  glTF is y up: the
positions stay z up, and their parent node is rotated.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.render.solids import Color, linear_color

Z_UP = (1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1)  # column by column: (x, y, z) to (x, z, -y)
MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class Part(NamedTuple):
    """A mesh of the file: the cloth, or a solid.

    positions [m] and unit normals, (moments, vertices, 3) float32; triangles, (triangles, 3); uv: texture coordinates,
    (vertices, 2), or None; color: sRGB.
    """

    name: str
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    uv: NDArray[np.float32] | None
    color: Color


class _File:
    """The binary chunk, and the tables of what lies where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray, shape: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array of float32 or uint32; returns the number of its accessor."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        if target is not None:
            view["target"] = target
        code = FLOAT if array.dtype == np.float32 else UNSIGNED_INT
        accessor: dict[str, Any] = {"bufferView": len(self.views), "componentType": code, "count": len(array), "type": shape}
        if bounds:
            accessor |= {
                name: np.atleast_1d(end.astype(float)).tolist() for name, end in (("min", array.min(0)), ("max", array.max(0)))
            }
        self.data += np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def primitive(self, part: Part) -> dict[str, Any]:
        """Append a part's arrays; returns its primitive.  A part that never moves has no morph targets."""
        x, normals = part.positions, part.normals
        attributes = {
            "POSITION": self.add(x[0], "VEC3", ARRAY_BUFFER, bounds=True),
            "NORMAL": self.add(normals[0], "VEC3", ARRAY_BUFFER),
        }
        if part.uv is not None:
            # v counts from the top of a texture in glTF, and from the bottom elsewhere
            flipped = np.stack([part.uv[:, 0], 1 - part.uv[:, 1]], axis=1)
            attributes["TEXCOORD_0"] = self.add(flipped, "VEC2", ARRAY_BUFFER)
        indices = self.add(part.triangles.astype(np.uint32).ravel(), "SCALAR", ELEMENT_ARRAY_BUFFER)
        primitive: dict[str, Any] = {"attributes": attributes, "indices": indices}
        if np.any(x != x[:1]):
            primitive["targets"] = [
                {
                    "POSITION": self.add(moment - x[0], "VEC3", ARRAY_BUFFER, bounds=True),
                    "NORMAL": self.add(normal - normals[0], "VEC3", ARRAY_BUFFER),
                }
                for moment, normal in zip(x[1:], normals[1:])
            ]
        return primitive


def glb(parts: Sequence[Part], fps: float = 30.0) -> bytes:
    """A ``.glb`` file.  The first moment is the mesh; the others are morph targets, each shown at its time.

    A morph target is a displacement from the first moment, so positions come back up to the rounding of float32.
    """
    file = _File()
    primitives = [file.primitive(part) for part in parts]
    moving = [number for number, primitive in enumerate(primitives) if "targets" in primitive]
    animation: dict[str, Any] = {}
    if moving:
        moments = len(parts[moving[0]].positions)
        times = file.add((np.arange(moments) / fps).astype(np.float32), "SCALAR", bounds=True)
        weights = file.add(np.eye(moments, dtype=np.float32)[:, 1:].ravel(), "SCALAR")
        channels = [{"sampler": 0, "target": {"node": number + 1, "path": "weights"}} for number in moving]
        samplers = [{"input": times, "output": weights, "interpolation": "LINEAR"}]
        animation = {"animations": [{"name": "simulation", "channels": channels, "samplers": samplers}]}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "clothgym"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "z_up", "matrix": Z_UP, "children": list(range(1, len(parts) + 1))},
            *({"name": part.name, "mesh": number} for number, part in enumerate(parts)),
        ],
        "meshes": [
            {"name": part.name, "primitives": [primitive | {"material": number}]}
            for number, (part, primitive) in enumerate(zip(parts, primitives))
        ],
        "materials": [_material(part) for part in parts],
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{"byteLength": len(file.data)}],
        **animation,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = b"".join(
        struct.pack("<II", len(content), kind) + content
        for kind, content in ((JSON_CHUNK, text + b" " * (-len(text) % 4)), (BINARY_CHUNK, bytes(file.data)))
    )
    return struct.pack("<III", MAGIC, VERSION, 12 + len(chunks)) + chunks


def _material(part: Part) -> dict[str, Any]:
    """The material of a part: rough, and seen from both sides."""
    surface = {"baseColorFactor": [*linear_color(part.color).tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": True}

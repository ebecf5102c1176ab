"""Solids to be drawn beside the cloth: named shapes, and the unit meshes that stand for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions.solids.shapes import UNTURNED, Quaternion, turned

KINDS = {"sphere": ("radius",), "box": ("half_sides",), "capsule": ("radius", "height"), "mesh": ("vertices", "triangles")}
WARM_GREY = (196, 189, 178)
SMALL = 0.03  # radius of a round solid, a marker say, that is drawn with the fewer segments [m]
BOX_EDGE = 0.01  # radius to which the edges of a box are rounded [m]
# around large solids and small ones, in large pictures and in small ones: 48 chords lie within 0.2 % of the radius, 32 within 0.5 %
SEGMENTS, FEW_SEGMENTS = (48, 20), (32, 12)
CREASE = 0.8  # cosine of the angle between a vertex's normal and a triangle's beyond which a mesh is drawn with an edge there

Vector = tuple[float, float, float]
Color = tuple[int, int, int]


class Mesh(NamedTuple):
    """positions [m] and unit normals, (vertices, 3) float32; triangles counter-clockwise from outside, (triangles, 3) int32."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A thing beside the cloth.

    Attributes:
        kind: "sphere" (radius), "box" (half_sides), "capsule" (radius, height; upright) or "mesh" (vertices, triangles).
        center: its middle [m].
        radius: of a sphere or a capsule [m].
        half_sides: half lengths of a box along its own x, y, z [m].
        height: of a capsule from end to end [m].
        vertices: of a mesh in its own axes [m], (vertices, 3), and triangles, (triangles, 3), counter-clockwise from outside.
        yaw: turn about z [rad], before rotation.
        rotation: a quaternion (w, x, y, z) of any length.
        color: sRGB, three numbers from 0 to 255.

    Raises:
        ValueError: an unknown kind, a size that is missing, not positive or of another kind, a color out of range.
    """

    kind: str
    center: Vector
    radius: float | None = None
    half_sides: Vector | None = None
    height: float | None = None
    vertices: NDArray | None = field(default=None, compare=False, repr=False)
    triangles: NDArray | None = field(default=None, compare=False, repr=False)
    yaw: float = 0.0
    rotation: Quaternion = UNTURNED
    color: Color = WARM_GREY

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"solid kind={self.kind!r}: must be one of {', '.join(KINDS)}")
        if np.shape(self.center) != (3,) or not np.all(np.isfinite(self.center)):
            raise ValueError(f"{self.kind} center={self.center!r}: must be three finite numbers")
        for name in ("radius", "half_sides", "height"):
            self._check_size(name, getattr(self, name))
        for name in ("vertices", "triangles"):
            self._check_corners(name, getattr(self, name))
        if self.kind == "capsule" and self.height < 2 * self.radius:  # type: ignore[operator]
            raise ValueError(f"capsule height={self.height!r}: must be at least twice the radius {self.radius!r}")
        if not math.isfinite(self.yaw):
            raise ValueError(f"{self.kind} yaw={self.yaw!r}: must be finite")
        if self.rotation is not UNTURNED:
            turned(f"{self.kind} rotation", self.rotation)
        check_color(f"{self.kind} color", self.color)

    def _check_size(self, name: str, size: float | Vector | None) -> None:
        if name not in KINDS[self.kind]:
            if size is not None:
                raise ValueError(f"{self.kind} {name}={size!r}: a {self.kind} has no {name}, leave it out")
            return
        shape = (3,) if name == "half_sides" else ()
        if size is None or np.shape(size) != shape or not np.all(np.isfinite(size)) or not np.all(np.greater(size, 0)):
            wanted = "three positive lengths" if shape else "a positive length"
            raise ValueError(f"{self.kind} {name}={size!r}: must be {wanted} in metres")

    def _check_corners(self, name: str, corners: NDArray | None) -> None:
        if (corners is None) != (name not in KINDS[self.kind]):
            raise ValueError(
                f"{self.kind} {name}: " + ("give them" if corners is None else f"a {self.kind} has none, leave them out")
            )
        if corners is not None and (np.ndim(corners) != 2 or np.shape(corners)[1] != 3 or not len(corners)):
            raise ValueError(f"{self.kind} {name} have shape {np.shape(corners)}: must be ({name}, 3)")

    @property
    def axes(self) -> NDArray[np.float32]:
        """The solid's own axes in the world, (3, 3), an axis a row."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        about_z = np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])
        return (about_z if self.rotation is UNTURNED else about_z @ turned("rotation", self.rotation)).astype(np.float32)

    @property
    def upright(self) -> bool:
        """Whether it is a rounded box that is turned about z alone."""
        return self.kind != "mesh" and self.rotation[1] == self.rotation[2] == self.rotation[3] == 0

    def rounded_box(self) -> tuple[Vector, float]:
        """The half sides of a box and the radius of a ball [m] that together, the ball swept over the box, make the solid."""
        if self.kind == "box":
            return tuple(map(float, self.half_sides)), 0.0  # type: ignore[arg-type, return-value]
        straight = 0.0 if self.kind == "sphere" else self.height / 2 - self.radius  # type: ignore[operator]
        return (0.0, 0.0, float(straight)), float(self.radius)  # type: ignore[arg-type]

    def mesh(self, coarse: bool = False) -> Mesh:
        """The solid's surface in the world, in fewer triangles for a small picture; a box has its edges rounded a little."""
        if self.kind == "mesh":
            corners = np.asarray(self.vertices, np.float32)[np.asarray(self.triangles)] @ self.axes
            normals = _creased_normals(corners, np.asarray(self.triangles), len(self.vertices))  # type: ignore[arg-type]
            positions = corners.reshape(-1, 3) + np.asarray(self.center, np.float32)
            return Mesh(positions, normals, np.arange(len(positions), dtype=np.int32).reshape(-1, 3))
        half, radius = self.rounded_box()
        if self.kind == "box":
            radius = min(BOX_EDGE, 0.25 * min(half))
            half = (half[0] - radius, half[1] - radius, half[2] - radius)
        ball = _ball_in_parts((FEW_SEGMENTS if coarse else SEGMENTS)[radius <= SMALL])
        local = ball.octants * np.asarray(half, np.float32) + np.float32(radius) * ball.normals
        axes = self.axes
        return Mesh(local @ axes + np.asarray(self.center, np.float32), ball.normals @ axes, ball.triangles)


def check_color(name: str, color: Color) -> None:
    """Raise a ValueError unless ``color`` is three numbers from 0 to 255."""
    if np.shape(color) != (3,) or not all(0 <= c <= 255 for c in color):
        raise ValueError(f"{name}={color!r}: must be three numbers from 0 to 255 (red, green, blue)")


def linear_color(color: Sequence[float]) -> NDArray[np.float32]:
    """An sRGB color, 0 to 255, as linear light, 0 to 1, (3,) (IEC 61966-2-1)."""
    c = np.asarray(color, np.float64) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _creased_normals(corners: NDArray[np.float32], triangles: NDArray, vertices: int) -> NDArray[np.float32]:
    """Unit normals at the corners of triangles, (3 triangles, 3): the vertex's, by the area of its triangles, or the triangle's
    own where those of the vertex meet in a crease.  corners: [m], (triangles, 3, 3)."""
    faces, place = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), triangles.ravel()
    joint = np.stack([np.bincount(place, np.repeat(faces[:, c], 3), vertices) for c in range(3)], axis=1)
    own, smooth = np.repeat(_unit(faces), 3, axis=0), _unit(joint.astype(np.float32))[place]
    least = np.ones(vertices, np.float32)
    np.minimum.at(least, place, np.sum(own * smooth, axis=1))
    return np.where(least[place, None] > CREASE, smooth, own)


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-20))


class _Ball(NamedTuple):
    """octants: signs of x, y, z of the octant that a vertex belongs to, (vertices, 3) float32; the others as in Mesh."""

    octants: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]


@lru_cache
def _ball_in_parts(segments: int) -> _Ball:
    """The unit sphere cut into octants that share no vertices, and the strips and faces that join them.

    With the octants moved apart it is a capsule or a rounded box; with them together, strips and faces have no area.
    """
    quarter = np.linspace(0, np.pi / 2, segments // 4 + 1)
    polar = np.concatenate([quarter, quarter + np.pi / 2])[:, None]
    around = np.concatenate([quarter + k * np.pi / 2 for k in range(4)])[None, :]
    normals = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], axis=-1)
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]).repeat(len(quarter), axis=0)
    octants = np.empty_like(normals)
    octants[..., :2] = signs
    octants[..., 2] = np.where(np.arange(len(polar)) < len(quarter), 1, -1)[:, None]

    index = np.arange(normals.shape[0] * normals.shape[1]).reshape(normals.shape[:2])
    index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    # the poles are edges of the upper and the lower face, one corner for each quadrant
    top, bottom = index[0, : -1 : len(quarter)], index[-1, : -1 : len(quarter)][::-1]
    faces = [face[[0, k, k + 1]] for face in (top, bottom) for k in (1, 2)]
    triangles = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1), np.stack(faces)])
    return _Ball(octants.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3).astype(np.float32), triangles.astype(np.int32))

"""Drawn solids: a collider with a color, and the mesh of its surface."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.collisions import Box, Capsule, Collider, MeshCollider, Sphere
from clothgym.collisions.solids.shapes import R_AXES, R_HALF

Shape = Sphere | Capsule | Box | MeshCollider
Color = tuple[int, int, int]
Drawable = Collider | tuple[Collider | Sequence[float], Color]

KINDS = {"sphere": Sphere, "capsule": Capsule, "box": Box, "mesh": MeshCollider}
WARM_GRAY = (196, 189, 178)
MARKER_RADIUS = 0.011  # of the sphere that stands for a position [m]
SMALL = 0.03  # radius of a round solid, a marker say, that is drawn with the fewer segments [m]
BOX_EDGE = 0.01  # radius to which the edges of a box are rounded [m]
# around large solids and small ones, in large pictures and in small ones: 48 chords lie within 0.2 % of the radius, 32 within 0.5 %
SEGMENTS, FEW_SEGMENTS = (48, 20), (32, 12)
CREASE = 0.8  # cosine of the angle between a vertex's normal and a triangle's beyond which a mesh is drawn with an edge there


class Mesh(NamedTuple):
    """positions [m] and unit normals, (vertices, 3) float32; triangles counter-clockwise from outside, (triangles, 3) int32."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]


class Drawn(NamedTuple):
    """A solid, where its ``center`` is, and its color, sRGB from 0 to 255."""

    collider: Shape
    color: Color = WARM_GRAY

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        return next(name for name, kind in KINDS.items() if isinstance(self.collider, kind))

    @property
    def at_origin(self) -> Drawn:
        """The same at the origin: equal for two that differ in place alone."""
        return self.at((0, 0, 0))

    def at(self, center: ArrayLike) -> Drawn:
        """The same with another center [m]."""
        there = copy(self.collider)  # a mesh keeps the surface and the grid that it has made
        object.__setattr__(there, "center", tuple(np.asarray(center, float).tolist()))
        return Drawn(there, self.color)

    def rounded_box(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Axes, (3, 3), an axis a row, half sides of a box [m], (3,), and radius of a ball [m]; the ball, swept over the box, makes
        the solid.  Of a mesh its axes, and a box around it."""
        rows = self.collider.rows()
        axes, half = rows[R_AXES : R_AXES + 9].reshape(3, 3), rows[R_HALF : R_HALF + 3]
        return axes, half, float(getattr(self.collider, "radius", 0.0))

    def mesh(self, coarse: bool = False) -> Mesh:
        """The solid's surface in the world, in fewer triangles for a small picture; a box has its edges rounded a little."""
        own, half, radius = self.rounded_box()
        axes, center = own.astype(np.float32), np.asarray(self.collider.center, np.float32)
        if isinstance(self.collider, MeshCollider):
            vertices, triangles = self.collider.surface
            corners = vertices.astype(np.float32)[triangles] @ axes
            positions = corners.reshape(-1, 3) + center
            separate = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
            return Mesh(positions, _creased_normals(corners, triangles, len(vertices)), separate)
        if isinstance(self.collider, Box):
            radius = min(BOX_EDGE, 0.25 * float(half.min()))
            half = half - radius
        ball = _ball_in_parts((FEW_SEGMENTS if coarse else SEGMENTS)[radius <= SMALL])
        local = ball.octants * half.astype(np.float32) + np.float32(radius) * ball.normals
        return Mesh(local @ axes + center, ball.normals @ axes, ball.triangles)


def drawn(thing: Drawable) -> Drawn:
    """What a collider (in gray), a (collider, color), or a (position [m], color), a small sphere, looks like.

    Raises:
        ValueError: none of these, a plane, or a color out of range.
    """
    pair = (thing, WARM_GRAY) if isinstance(thing, Collider) else thing
    if not isinstance(pair, tuple) or len(pair) != 2 or (isinstance(pair[0], Collider) and not isinstance(pair[0], Shape)):
        raise ValueError(
            f"{thing!r} cannot be drawn: must be a Sphere, Capsule, Box or MeshCollider, or (collider, color), or (position in "
            "meters, color); the floor z = 0 is always drawn"
        )
    solid, color = pair
    check_color(f"color of {solid!r}", color)
    if isinstance(solid, Shape):
        return Drawn(solid, color)
    return Drawn(Sphere(center=tuple(np.asarray(solid, float).tolist()), radius=MARKER_RADIUS), color)


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

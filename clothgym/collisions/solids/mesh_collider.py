"""A collider with the shape of a closed mesh."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import as_array, count, finite, not_negative, positive, shown, vector, warn
from clothgym.collisions.solids.distance_grid import DistanceGrid, distance_grid
from clothgym.collisions.solids.shapes import KIND_MESH, R_AXES, R_HALF, R_POINT, UNTURNED, Collider, Quaternion, Vector, turned
from clothgym.geometry.closed_mesh import checked_solid
from clothgym.triangles import read_triangles


@dataclass(frozen=True, eq=False)
class MeshCollider(Collider):
    """A solid whose surface is a closed triangle mesh, from a file or from arrays.

    Kernels read a grid of signed distances that is built once.  Edges are rounded, and details are lost, at the size of its cells,
    which is the mesh's longest side divided by ``resolution``.  Walls that are lost are refused, with the resolution that would do:
    those of two cells and more never are.

    Attributes:
        path: a mesh file in meters, read as by ``load_mesh``: what has no area is dropped, and a warning says what was changed.
        vertices: [m], (vertices, 3); triangles: between them, (triangles, 3), counter-clockwise seen from outside.
        center: position of the mesh's origin [m].
        rotation: a quaternion (w, x, y, z) of any length.
        scale: factor on the mesh's size.
        resolution: cells along the longest side.

    Raises:
        ImportError: a path without trimesh: ``pip install clothgym[mesh]``.
        ValueError: as for ``Collider``; neither or both of path and arrays; a surface that is not closed (``checked_solid``), or
            has walls that the grid would lose.
    """

    kind: ClassVar[int] = KIND_MESH
    path: str | Path | None = None
    vertices: ArrayLike | None = None
    triangles: ArrayLike | None = None
    center: Vector = (0.0, 0.0, 0.0)
    rotation: Quaternion = UNTURNED
    scale: float = 1.0
    resolution: int = 64

    def __post_init__(self) -> None:
        turned("MeshCollider rotation", self.rotation)
        plain: dict[str, Any] = {
            **{name: not_negative(f"MeshCollider {name}", getattr(self, name)) for name in ("friction", "thickness")},
            **{name: tuple(vector(f"MeshCollider {name}", getattr(self, name)).tolist()) for name in ("center", "velocity")},
            "rotation": tuple(finite("MeshCollider rotation", self.rotation).tolist()),
            "scale": positive("MeshCollider scale", self.scale),
            "resolution": count("MeshCollider resolution", self.resolution),
        }
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        if not isinstance(self.path, (str, Path, type(None))):
            kind = type(self.path).__name__
            raise ValueError(f"MeshCollider path is of type {kind}: must be a file name, give arrays as vertices=, triangles=")
        if (self.path is None) == (self.vertices is None or self.triangles is None) or (
            self.path is not None and (self.vertices is not None or self.triangles is not None)
        ):
            raise ValueError("MeshCollider: give either the path of a file, or vertices and triangles")
        self.grid  # noqa: B018 - a mesh that is not a solid is refused here

    def __repr__(self) -> str:
        shown = (f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name not in ("vertices", "triangles"))
        return f"MeshCollider({', '.join(shown)})"

    @cached_property
    def surface(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices in the solid's own axes, scaled [m], and triangles."""
        if self.path is not None:
            x, triangles, numbers, repairs = read_triangles(self.path, "MeshCollider", "solid", self.scale)
            if said := repairs.told():
                warn(f"{str(self.path)!r}: {'; '.join(said)}")
            with self._named():
                return _solid(*_frozen(x, triangles, numbers))
        assert self.vertices is not None and self.triangles is not None
        corners = as_array(self.triangles)
        if corners is None:
            raise ValueError(f"triangles={shown(self.triangles)}: must be an array of vertices' numbers, (triangles, 3)")
        return _solid(*_frozen(finite("vertices", self.vertices) * self.scale, corners))

    @cached_property
    def grid(self) -> DistanceGrid:
        """The distances to the surface, from a cache if it has them."""
        x, triangles = self.surface
        with self._named():
            return _grid(*_frozen(x, triangles), self.resolution)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Add the file's name to an error about its mesh."""
        try:
            yield
        except ValueError as error:
            if self.path is None:
                raise
            raise ValueError(f"{str(self.path)!r} is not a solid: {error}") from error

    def world_vertices(self) -> NDArray[np.float64]:
        """Positions of the vertices as long as the solid has not moved [m], (vertices, 3)."""
        return self.surface[0] @ turned("rotation", self.rotation) + np.asarray(self.center)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MeshCollider) and self.fits(other) and np.array_equal(self.rows(), other.rows())

    def __hash__(self) -> int:
        return hash(self.rows().tobytes())

    def fits(self, other: Collider) -> bool:
        """Whether the other has the same mesh: all environments share one distance grid."""
        return isinstance(other, MeshCollider) and other.grid is self.grid

    def _shape(self, rows: NDArray[np.float64]) -> None:
        rows[R_POINT : R_POINT + 3] = self.center
        rows[R_AXES : R_AXES + 9] = turned("rotation", self.rotation).ravel()
        rows[R_HALF : R_HALF + 3] = np.abs(self.surface[0]).max(axis=0)


class _Bytes:
    """An array that a cache can look up by its contents."""

    def __init__(self, array: NDArray) -> None:
        self.array = np.ascontiguousarray(array)
        self._key = (self.array.shape, self.array.dtype.str, self.array.tobytes())

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Bytes) and self._key == other._key


def _frozen(*arrays: NDArray) -> tuple[_Bytes, ...]:
    return tuple(map(_Bytes, arrays))


@lru_cache(maxsize=16)
def _solid(vertices: _Bytes, triangles: _Bytes, numbers: _Bytes | None = None) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    return checked_solid(vertices.array, triangles.array, None if numbers is None else numbers.array)


@lru_cache(maxsize=16)
def _grid(vertices: _Bytes, triangles: _Bytes, resolution: int) -> DistanceGrid:
    return distance_grid(vertices.array, triangles.array, resolution)

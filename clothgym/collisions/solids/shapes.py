"""Colliders as users describe them, and as rows of numbers for the kernels.

Sphere, capsule and box are one shape, a rounded box: a box with half sides b, swept by a ball of radius r.  A sphere has b = 0, a
capsule b = (0, 0, half its straight part), a box r = 0.  One distance function serves them all without a branch, and each lane of
a batch may have another of these shapes in the same slot.  The thickness is added to r.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import count, finite, members, not_negative, number, shown, vector

# rows of a collider: a point of it; its x, y and z axes; half sides b; radius r with the thickness; friction; velocity; squared
# distance from the point beyond which nothing touches it; thickness; velocity after the next control step; what the point could not
# hold of its motion [m]
R_POINT, R_AXES, R_HALF, R_RADIUS, R_FRICTION, R_VELOCITY, R_REACH2, R_THICKNESS, R_AFTER = 0, 3, 12, 15, 16, 17, 20, 21, 22
R_REMAINDER = 25
COLLIDER_ROWS = 28

STRAIGHT = 1e-4  # by how much products of a collider's axes, in float32, may differ from those of unit vectors at right angles

KIND_PLANE, KIND_ROUNDED_BOX, KIND_MESH = 0, 1, 2

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UNTURNED: Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Collider:
    """Base of all colliders.

    Attributes:
        friction: Coulomb's coefficient between cloth and solid.
        thickness: distance at which the cloth rests on the surface [m].
        velocity: of the solid, which carries the cloth along [m/s].  ``Simulation.move_colliders`` changes it.

    Raises:
        TypeError: another class, of a kind that the kernels do not know.
        ValueError: a size that is not positive, a negative friction or thickness, a vector that is not three finite numbers, or a
            direction or rotation of length zero.
    """

    kind: ClassVar[int] = -1
    friction: float = 0.3
    thickness: float = 0.001
    velocity: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.known_kind()
        for item in fields(self):
            name, value = f"{type(self).__name__} {item.name}", getattr(self, item.name)
            if value is item.default:
                continue
            plain: Any
            if item.name == "rotation":
                turned(name, value)
                plain = tuple(finite(name, value).tolist())
            elif isinstance(item.default, tuple):
                plain = tuple(vector(name, value).tolist())
            else:
                plain = (not_negative if item.name in ("friction", "thickness") else number)(name, value)
            object.__setattr__(self, item.name, plain)

    def known_kind(self) -> int:
        """Its kind; a class of somebody else's may have one that no kernel knows, or be a mesh without a grid of distances."""
        if self.kind not in ((KIND_MESH,) if hasattr(type(self), "grid") else (KIND_PLANE, KIND_ROUNDED_BOX)):
            name = type(self).__name__
            raise TypeError(f"{name} kind={self.kind!r}: unknown; derive {name} from Plane, Sphere, Capsule, Box or MeshCollider")
        return self.kind

    def _positive(self, **sizes: float) -> None:
        for name, size in sizes.items():
            if not np.all(np.asarray(size) > 0):
                raise ValueError(f"{type(self).__name__} {name}={size!r}: must be positive")

    def rows(self) -> NDArray[np.float64]:
        """The numbers that kernels read, (COLLIDER_ROWS,)."""
        rows = np.zeros(COLLIDER_ROWS)
        rows[R_AXES], rows[R_AXES + 4], rows[R_AXES + 8] = 1, 1, 1
        rows[R_FRICTION] = self.friction
        rows[R_VELOCITY : R_VELOCITY + 3] = rows[R_AFTER : R_AFTER + 3] = self.velocity
        rows[R_RADIUS] = rows[R_THICKNESS] = self.thickness
        self._shape(rows)
        rows[R_REACH2] = (np.linalg.norm(rows[R_HALF : R_HALF + 3]) + rows[R_RADIUS]) ** 2
        return rows

    def fits(self, other: Collider) -> bool:
        """Whether the other can take this one's place in some environments of a batch."""
        return other.kind == self.kind

    def _shape(self, rows: NDArray[np.float64]) -> None:
        """Write the rows that depend on the shape."""
        raise NotImplementedError


@dataclass(frozen=True)
class Plane(Collider):
    """A half-space: the solid lies on the side of ``point`` that ``normal`` points away from."""

    kind: ClassVar[int] = KIND_PLANE
    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.linalg.norm(self.normal) == 0:
            raise ValueError(f"Plane normal={self.normal!r}: must not be zero")

    def _shape(self, rows: NDArray[np.float64]) -> None:
        rows[R_POINT : R_POINT + 3] = self.point
        rows[R_AXES : R_AXES + 9] = _axes_along(*map(float, self.normal))


@dataclass(frozen=True)
class Sphere(Collider):
    """A ball."""

    kind: ClassVar[int] = KIND_ROUNDED_BOX
    center: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(radius=self.radius)

    def _shape(self, rows: NDArray[np.float64]) -> None:
        rows[R_POINT : R_POINT + 3] = self.center
        rows[R_RADIUS] = self.radius + self.thickness


@dataclass(frozen=True)
class Capsule(Collider):
    """A cylinder with round ends, upright unless ``axis`` says otherwise; ``height`` is from end to end [m]."""

    kind: ClassVar[int] = KIND_ROUNDED_BOX
    center: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.1
    height: float = 0.4
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(radius=self.radius, height=self.height)
        if self.height < 2 * self.radius:
            raise ValueError(f"Capsule height={self.height!r}: must be at least twice the radius {self.radius!r}")
        if np.linalg.norm(self.axis) == 0:
            raise ValueError(f"Capsule axis={self.axis!r}: must not be zero")

    def _shape(self, rows: NDArray[np.float64]) -> None:
        rows[R_POINT : R_POINT + 3] = self.center
        rows[R_AXES : R_AXES + 9] = _axes_along(*map(float, self.axis))
        rows[R_HALF + 2] = self.height / 2 - self.radius
        rows[R_RADIUS] = self.radius + self.thickness


@dataclass(frozen=True)
class Box(Collider):
    """A box, whose edges the thickness rounds.

    It is rotated by ``yaw`` about z [rad], and then by ``rotation``, a quaternion (w, x, y, z) of any length.
    """

    kind: ClassVar[int] = KIND_ROUNDED_BOX
    center: Vector = (0.0, 0.0, 0.0)
    half_sides: Vector = (0.1, 0.1, 0.1)
    yaw: float = 0.0
    rotation: Quaternion = UNTURNED

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(half_sides=self.half_sides)  # type: ignore[arg-type]

    def _shape(self, rows: NDArray[np.float64]) -> None:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        rows[R_POINT : R_POINT + 3] = self.center
        about_z = np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])
        rows[R_AXES : R_AXES + 9] = (about_z @ _axes_of(*map(float, self.rotation))).ravel()
        rows[R_HALF : R_HALF + 3] = self.half_sides


def turned(name: str, quaternion: ArrayLike) -> NDArray[np.float64]:
    """Axes of a solid rotated by a quaternion (w, x, y, z) of any length, (3, 3), one axis in each row.

    Raises:
        ValueError: not four finite numbers, or all zero.
    """
    q = finite(name, quaternion)
    if q.shape != (4,) or not np.linalg.norm(q) > 0:
        raise ValueError(f"{name}={shown(quaternion)}: must be a quaternion, four numbers (w, x, y, z) that are not all zero")
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
            (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
            (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
        ]
    )


@lru_cache
def _axes_of(*quaternion: float) -> NDArray[np.float64]:
    """The same from a cache: do not write to it."""
    return turned("rotation", quaternion)


@lru_cache
def _axes_along(*direction: float) -> NDArray[np.float64]:
    """x, y and z axis, the third along the given direction, (9,), from a cache: do not write to it."""
    z = np.array(direction) / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.concatenate([x, np.cross(z, x), z])


def check_rows(name: str, rows: NDArray) -> None:
    """Refuse numbers that no collider has, (..., COLLIDER_ROWS), finite; name: of the state's array.

    Raises:
        ValueError: axes that are no unit vectors at right angles, or a negative size, friction or thickness.
    """
    axes = rows[..., R_AXES : R_AXES + 9].reshape(*rows.shape[:-1], 3, 3).astype(np.float64)
    if rows.size and np.abs(axes @ np.swapaxes(axes, -1, -2) - np.eye(3)).max() > STRAIGHT:
        raise ValueError(f"the state's {name} holds axes that are no unit vectors at right angles: give what get_state() gave")
    sizes = rows[..., [*range(R_HALF, R_HALF + 3), R_RADIUS, R_FRICTION, R_REACH2, R_THICKNESS]]
    if np.any(sizes < 0):
        raise ValueError(f"the state's {name} holds {sizes.min():g} as a size, friction or thickness: give what get_state() gave")


def check_index(colliders: Sequence[Collider], index: int) -> None:
    """Raise ValueError for an index that no collider has."""
    if not colliders:
        raise ValueError(f"index={shown(index)}: must name a collider, and this simulation has 0 colliders")
    count("index", index, "the place of a collider, ", least=0, most=len(colliders) - 1)


def check_replacement(colliders: Sequence[Collider], index: int, others: Sequence[Collider], envs: int) -> None:
    """Refuse solids, one for each environment, that cannot take the place of collider ``index``.

    Raises:
        ValueError: there is no such collider, the number is wrong, or they are of another kind.
    """
    check_index(colliders, index)
    members("colliders", others, Collider, f"{envs} colliders, one for each environment")
    if len(others) != envs:
        raise ValueError(f"colliders={shown(others)}: give a sequence of {envs}, one for each environment")
    for other in others:
        if not colliders[index].fits(other):
            here, there = type(colliders[index]).__name__, type(other).__name__
            there = "MeshCollider of another mesh" if here == there else there
            raise ValueError(f"collider {index} is a {here}: a {there} cannot take its place")

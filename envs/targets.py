"""The solids that a sheet is draped over: drawn at reset, standing on the floor, with points on their upper surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.checks import finite, number, one_of, positive, shown
from clothgym.collisions import Box, Capsule, Collider, Sphere

LARGEST = 0.6  # [m]: sizes and distances beyond this leave no room to drape in
SHAPES = ("sphere", "box", "post")
# ranges of (width, height) by shape, in sides of the sheet: sphere radius, box half side, post radius; post height
SIZES = {"sphere": ((0.2, 0.3), None), "box": ((0.15, 0.25), None), "post": ((0.1, 0.15), (0.4, 0.6))}
FRICTION = 0.5
# distance at which the cloth rests on a target [m]: about the height of the arc of the narrowest post over a side of a triangle, so
# that particles carry the sheet.  With 2 mm triangles carry it, which share corners, and it trembles at 20 to 40 mm/s
THICKNESS = 0.005
ON_FLOOR = 0.002  # and on the floor [m]
# a surface is "upper" where it slopes by at most this: below, cloth hangs free of it in folds
UPPER_SLOPE = math.radians(60)
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Target:
    """A sphere, an upright box or a round-topped post on the floor.

    Attributes:
        shape: one of SHAPES.
        radius: of sphere and post, half side of the box [m].
        height: of its highest point [m]; a sphere's is twice its radius, a box's twice its half side.
        center: of its axis on the floor [m].
        yaw: of the box [rad].
    """

    shape: str
    radius: float
    height: float
    center: tuple[float, float]
    yaw: float = 0.0

    def __post_init__(self) -> None:
        one_of("target shape", self.shape, *SHAPES)
        for name in ("radius", "height"):
            object.__setattr__(self, name, positive(f"target {name}", getattr(self, name)))
            if getattr(self, name) > LARGEST:
                raise ValueError(f"target {name}={getattr(self, name)!r}: must be at most {LARGEST} m, to stand in the arena")
        center = finite("target center", self.center)
        if center.shape != (2,) or max(map(abs, center.tolist())) > LARGEST:
            raise ValueError(f"target center={shown(self.center)}: must be two numbers within {LARGEST} m of the origin")
        object.__setattr__(self, "center", tuple(center.tolist()))
        object.__setattr__(self, "yaw", number("target yaw", self.yaw))
        if abs(self.yaw) > math.pi / 4 + 1e-9:
            raise ValueError(f"target yaw={self.yaw!r}: must be within 45 degrees (pi/4); a box looks the same every 90")
        if self.shape in ("sphere", "box") and not math.isclose(self.height, 2 * self.radius, rel_tol=1e-6):
            raise ValueError(f"target height={self.height!r}: must be twice the radius {self.radius!r} of a {self.shape}")
        if self.shape == "post" and self.height < self.radius:
            raise ValueError(f"target height={self.height!r}: must be at least the radius {self.radius!r} of a post")

    @staticmethod
    def draw(
        rng: np.random.Generator, side: float, spread: float, shape: str | None = None, shapes: Sequence[str] = SHAPES
    ) -> Target:
        """A target for a sheet of that side [m], its axis within ``spread`` [m] of the origin; shapes: to draw one from."""
        shape = shape if shape is not None else shapes[int(rng.integers(len(shapes)))]
        one_of("target shape", shape, *SHAPES)
        widths, heights = SIZES[shape]
        radius = side * float(rng.uniform(*widths))
        height = side * float(rng.uniform(*heights)) if heights else 2 * radius
        distance, angle = spread * math.sqrt(float(rng.uniform())), 2 * math.pi * float(rng.uniform())
        yaw = float(rng.uniform(-math.pi / 4, math.pi / 4)) if shape == "box" else 0.0
        return Target(shape, radius, height, (distance * math.cos(angle), distance * math.sin(angle)), yaw)

    @property
    def top(self) -> tuple[float, float, float]:
        """Highest point of its axis [m]."""
        return (*self.center, self.height)

    def collider(self, friction: float, thickness: float) -> Collider:
        """The solid that it is."""
        x, y = self.center
        if self.shape == "sphere":
            return Sphere(center=(x, y, self.radius), radius=self.radius, friction=friction, thickness=thickness)
        if self.shape == "box":
            half = (self.radius, self.radius, self.radius)
            return Box(center=(x, y, self.radius), half_sides=half, yaw=self.yaw, friction=friction, thickness=thickness)
        # the lower round end is sunk, so that the post stands on the floor as a cylinder
        length = self.height + self.radius
        center = (x, y, self.height - length / 2)
        return Capsule(
            center=center, radius=self.radius, height=max(length, 2 * self.radius), friction=friction, thickness=thickness
        )

    def upper_surface(self, count: int) -> NDArray[np.float64]:
        """About ``count`` points, evenly by area, where the surface slopes by at most UPPER_SLOPE [m], (points, 3)."""
        turn = np.array([math.cos(self.yaw), math.sin(self.yaw)])
        return placed(unit_surface(self.shape, count), np.array(self.top), self.radius, turn)

    def upper_normals(self, count: int) -> NDArray[np.float64]:
        """The surface's outward normals at these points, (points, 3)."""
        turn = np.array([math.cos(self.yaw), math.sin(self.yaw)])
        return placed(unit_normals(self.shape, count), np.zeros(3), 1.0, turn)

    def changed(self, properties: Mapping[str, Any]) -> Target:
        """The same but for some properties; its height follows from its radius unless it is among them, or a post's."""
        if "radius" in properties and "height" not in properties and self.shape != "post":
            properties = {**properties, "height": 2 * positive("target radius", properties["radius"])}
        return replace(self, **properties) if properties else self


@lru_cache
def unit_surface(shape: str, count: int) -> NDArray[np.float64]:
    """The points of ``Target.upper_surface`` for a radius of 1, unturned, relative to its top, (points, 3)."""
    if shape == "box":
        # cell centers of the square [-1, 1]^2, count rounded to a square number
        n = max(1, round(math.sqrt(count)))
        line = (np.arange(n) + 0.5) / n * 2 - 1
        return np.stack([*(g.ravel() for g in np.meshgrid(line, line)), np.zeros(n * n)], axis=1)
    # Fibonacci points on the unit sphere's cap up to UPPER_SLOPE: equal steps in z are equal areas (Archimedes)
    k = np.arange(count)
    below = (1 - math.cos(UPPER_SLOPE)) * (k + 0.5) / count
    r = np.sqrt(1 - (1 - below) ** 2)
    return np.stack([r * np.cos(k * GOLDEN_ANGLE), r * np.sin(k * GOLDEN_ANGLE), -below], axis=1)


@lru_cache
def unit_normals(shape: str, count: int) -> NDArray[np.float64]:
    """The outward normals at the points of ``unit_surface``, (points, 3)."""
    points = unit_surface(shape, count)
    return np.tile((0.0, 0.0, 1.0), (len(points), 1)) if shape == "box" else points + (0, 0, 1)


@kernel
def placed(units, top, radius, turn):
    """Points of a unit surface, (points, 3), in their places on a target [m]; or its normals, about no top, with radius 1.

    top: see ``Target.top``.  turn: cosine and sine of the target's yaw, (2,).
    """
    points = np.empty(units.shape)
    for k in range(units.shape[0]):
        x, y = units[k, 0] * radius, units[k, 1] * radius
        points[k, 0] = top[0] + turn[0] * x - turn[1] * y
        points[k, 1] = top[1] + turn[1] * x + turn[0] * y
        points[k, 2] = top[2] + units[k, 2] * radius
    return points

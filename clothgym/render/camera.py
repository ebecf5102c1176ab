"""A pinhole camera, and the ray of each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


class View(NamedTuple):
    """A camera with an image size, as kernels read it.

    axes: right, up and forward, unit vectors.  rays: eye [m], then the ray of the image's corner (0, 0) and its change per pixel to
    the right and downwards; rays have length 1 along the view axis, so that eye plus depth [m] times ray is a point.
    scale: pixels per unit of slope.  width, height: [pixels].
    """

    axes: tuple[Vector, Vector, Vector]
    rays: tuple[Vector, Vector, Vector, Vector]
    scale: float
    width: int
    height: int


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: its position [m].
        target: the point in the middle of the image [m].
        up: direction that points upwards in the image.
        vertical_fov: angle between the image's lower and upper edge [degrees].
        near: depth below which nothing is drawn [m].

    Raises:
        ValueError: numbers that are not finite, an eye on its target, an up along the view axis, an angle outside (0, 180),
            or a near plane at or behind the eye.
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 0.0, 1.0)
    vertical_fov: float = 35.0
    near: float = 0.02

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            value = getattr(self, name)
            if np.shape(value) != (3,) or not np.all(np.isfinite(value)):
                raise ValueError(f"camera {name}={value!r}: must be three finite numbers")
            object.__setattr__(self, name, tuple(map(float, value)))  # arrays are accepted, and the camera stays hashable
        if not 0 < self.vertical_fov < 180:
            raise ValueError(f"camera vertical_fov={self.vertical_fov!r}: must lie between 0 and 180 degrees")
        if not (math.isfinite(self.near) and self.near > 0):
            raise ValueError(f"camera near={self.near!r}: must be a positive, finite depth in meters")
        if self.distance < 1e-6:
            raise ValueError(f"camera eye={self.eye!r}: must differ from its target {self.target!r}")
        forward = np.subtract(self.target, self.eye) / self.distance
        if np.linalg.norm(np.cross(forward, self.up)) < 1e-6 * max(float(np.linalg.norm(self.up)), 1e-300):
            raise ValueError(f"camera up={self.up!r}: must not point along the view axis {tuple(forward.tolist())!r}")

    @property
    def distance(self) -> float:
        """From eye to target [m]."""
        return float(np.linalg.norm(np.subtract(self.target, self.eye)))

    @property
    def axes(self) -> NDArray[np.float64]:
        """Right, up and forward as unit rows, (3, 3)."""
        forward = np.subtract(self.target, self.eye) / self.distance
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def reach(self) -> float:
        """Half the height that the image shows at the target [m], a measure of the size of the scene."""
        return self.distance * math.tan(math.radians(self.vertical_fov) / 2)

    def view(self, width: int, height: int) -> View:
        """The camera with an image of width x height pixels."""
        right, up, forward = self.axes
        scale = height / 2 / math.tan(math.radians(self.vertical_fov) / 2)
        corner = forward + (up * height - right * width) / (2 * scale)
        rays = self.eye, as_tuple(corner), as_tuple(right / scale), as_tuple(-up / scale)
        return View((as_tuple(right), as_tuple(up), as_tuple(forward)), rays, scale, width, height)


def as_tuple(vector: NDArray[np.float64]) -> Vector:
    """Three floats: kernels read them faster than an array, which might overlap with others."""
    return float(vector[0]), float(vector[1]), float(vector[2])

"""Where the observed pictures of each environment are taken from, and in which colors; ``randomize=`` draws them by episode.

* ``camera_yaw``, ``camera_tilt`` [degrees], ``camera_distance``: the eye turns about the picture's horizontal axis through the
  camera's target, toward the top of the picture if the tilt is positive, then about the vertical, counter-clockwise seen from above
  if the yaw is positive, and the distance between both is multiplied;
* ``brightness``: factor on all colors, as of an exposure;
* ``hue`` [degrees]: turn of the hues of the cloth's two sides.
"""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.randomization import OF_CAMERAS, OF_COLORS
from clothgym.render import quick
from clothgym.render.camera import Camera, as_tuple

if TYPE_CHECKING:
    from clothgym.envs.task import Task

CLEARANCE = 0.01  # least height of the eye over the floor [m]


class DrawnViews:
    """The views of a batch; they follow from what the present episodes have drawn.

    Args:
        camera: None for heights, which no camera takes.
        size: pixels of a square picture's side.
        sight: that of the camera.

    Raises:
        ValueError: a drawn camera could be below the floor.
    """

    def __init__(self, task: Task, camera: Camera | None, size: int, sight: quick.Sight) -> None:
        self.task, self.camera, self.size = task, camera, size
        self.names = [name for name in (*OF_CAMERAS, *OF_COLORS) if name in task.disturbances.ranges]
        every = [task.num_envs if any(name in names for name in self.names) else 1 for names in (OF_CAMERAS, OF_COLORS)]
        self._views = quick.views_from(sight, *every)
        self._drawn = np.full((task.num_envs, len(self.names)), np.nan)
        if camera is not None:
            _check_heights(camera, {name: task.disturbances.ranges[name] for name in OF_CAMERAS if name in self.names})

    def of(self, envs: NDArray) -> quick.Views:
        """The views of all environments, of which these are as their episodes have drawn them."""
        if self.names:
            drawn = np.stack([self.task.episode[name][envs] for name in self.names], axis=1)
            for k in np.flatnonzero((drawn != self._drawn[envs]).any(axis=1)).tolist():
                self._draw(int(envs[k]), dict(zip(self.names, drawn[k].tolist())))
            self._drawn[envs] = drawn
        return self._views

    def _draw(self, env: int, drawn: dict[str, float]) -> None:
        views = self._views
        if self.camera is not None and drawn.keys() & OF_CAMERAS:
            tilt, distance = drawn.get("camera_tilt", 0.0), drawn.get("camera_distance", 1.0)
            camera = turned(self.camera, drawn.get("camera_yaw", 0.0), tilt, distance)
            views.numbers[env], views.near[env], views.color[env] = quick.sight_of(camera, self.size)
        if drawn.keys() & OF_COLORS:
            views.brightness[env] = drawn.get("brightness", 1.0)
            views.cloth[env] = [with_hue(color, drawn.get("hue", 0.0)) for color in (quick.CORAL, quick.INDIGO)]


def turned(camera: Camera, yaw: float, tilt: float, distance: float) -> Camera:
    """A camera that looks at the same target from another side; yaw, tilt: [degrees], distance: as a factor."""
    _, up, forward = camera.axes
    # the eye moves toward the picture's top
    a, b = np.radians(tilt), np.radians(yaw)
    back, top = -np.cos(a) * forward + np.sin(a) * up, np.cos(a) * up + np.sin(a) * forward
    about_z = np.array([(np.cos(b), -np.sin(b), 0), (np.sin(b), np.cos(b), 0), (0, 0, 1)])
    eye = np.asarray(camera.target) + distance * camera.distance * (about_z @ back)
    return replace(camera, eye=as_tuple(eye), up=as_tuple(about_z @ top))


def _check_heights(camera: Camera, ranges: dict[str, tuple[float, float]]) -> None:
    """Refuse ranges of ``randomize`` in which the eye would come below the floor.

    Its height over the target, ``d (b cos a + u sin a)`` with the tilt a and the distance d, is least at an end of the range of a
    or opposite to the direction of (b, u), and at an end of that of d.
    """
    _, up, forward = camera.axes
    low, high = np.radians(ranges.get("camera_tilt", (0.0, 0.0))).tolist()
    lowest = math.atan2(up[2], -forward[2]) + math.pi
    tilts = [low, high, *(a for a in (lowest, lowest - 2 * math.pi) if low < a < high)]
    heights = [
        camera.target[2] + factor * camera.distance * (math.sin(a) * up[2] - math.cos(a) * forward[2])
        for factor in ranges.get("camera_distance", (1.0, 1.0)) for a in tilts
    ]  # fmt: skip
    if ranges and min(heights) < CLEARANCE:
        given = ", ".join(f"{name}={list(bounds)}" for name, bounds in ranges.items() if name != "camera_yaw")
        raise ValueError(
            f"randomize: {given or 'camera_yaw'}: the camera would be at z = {min(heights):.3g} m, below the floor; take a "
            "narrower range, or a camera whose eye is higher"
        )


def with_hue(color: tuple[int, int, int], turn: float) -> tuple[float, float, float]:
    """A color whose hue is turned [degrees]; from 0 to 255."""
    if not turn:
        return float(color[0]), float(color[1]), float(color[2])
    hue, saturation, value = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))
    red, green, blue = colorsys.hsv_to_rgb((hue + turn / 360) % 1.0, saturation, value)
    return 255 * red, 255 * green, 255 * blue

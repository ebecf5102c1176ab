"""Where the observed pictures of each environment are taken from, and in which colors; ``randomize=`` draws them by episode.

* ``camera_yaw``, ``camera_tilt`` [degrees], ``camera_distance``: the eye turns about the vertical through the camera's target, then
  about the picture's horizontal axis, upward if the tilt is positive, and the distance between both is multiplied;
* ``brightness``: factor on all colors, as of an exposure;
* ``hue`` [degrees]: turn of the hues of the cloth's two sides.
"""

from __future__ import annotations

import colorsys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.randomization import OF_CAMERAS, OF_COLORS
from clothgym.render import quick
from clothgym.render.camera import Camera, as_tuple

if TYPE_CHECKING:
    from clothgym.envs.task import Task


class Views:
    """The views of a batch; they follow from what the present episodes have drawn.

    Args:
        camera: None for heights, which no camera takes.
        size: pixels of a square picture's side.
        sight: that of the camera.

    Raises:
        ValueError: a drawn camera could see from below the floor.
    """

    def __init__(self, task: Task, camera: Camera | None, size: int, sight: quick.Sight) -> None:
        self.task, self.camera, self.size = task, camera, size
        self.names = [name for name in (*OF_CAMERAS, *OF_COLORS) if name in task.disturbances.ranges]
        self._views = quick.views_from(sight, task.num_envs if self.names else 1)
        self._drawn = np.full((task.num_envs, len(self.names)), np.nan)
        if camera is not None and (tilts := task.disturbances.ranges.get("camera_tilt")) is not None:
            for tilt in tilts:
                turned(camera, 0.0, tilt, 1.0)

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
        views.brightness[env] = drawn.get("brightness", 1.0)
        views.cloth[env] = [with_hue(color, drawn.get("hue", 0.0)) for color in (quick.CORAL, quick.INDIGO)]


def turned(camera: Camera, yaw: float, tilt: float, distance: float) -> Camera:
    """A camera that looks at the same target from another side; yaw, tilt: [degrees], distance: as a factor.

    Raises:
        ValueError: it would see from below the floor, or from beyond the vertical.
    """
    right, up, forward = camera.axes
    # upward: the eye moves toward the picture's top, about ``right``
    a, b = np.radians(tilt), np.radians(yaw)
    back, top = -np.cos(a) * forward + np.sin(a) * up, np.cos(a) * up + np.sin(a) * forward
    about_z = np.array([(np.cos(b), -np.sin(b), 0), (np.sin(b), np.cos(b), 0), (0, 0, 1)])
    eye = np.asarray(camera.target) + distance * camera.distance * (about_z @ back)
    if not eye[2] > 0:
        raise ValueError(f"randomize: camera_tilt={tilt:g} would put the camera below the floor, at z = {eye[2]:.3g} m")
    return replace(camera, eye=as_tuple(eye), up=as_tuple(about_z @ top))


def with_hue(color: tuple[int, int, int], turn: float) -> tuple[float, float, float]:
    """A color whose hue is turned [degrees]; from 0 to 255."""
    if not turn:
        return float(color[0]), float(color[1]), float(color[2])
    hue, saturation, value = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))
    red, green, blue = colorsys.hsv_to_rgb((hue + turn / 360) % 1.0, saturation, value)
    return 255 * red, 255 * green, 255 * blue

"""What stands between a point and the light: a shadow map, and how near the floor and the sky are covered.

All maps are square, lie around one centre and are rasterised anew for each frame with the kernels of the picture itself.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.render.camera import Camera, Vector, as_tuple
from clothgym.render.raster import project_orthographic, rasterise

NOTHING = -1e6  # nearness where a ray of light meets no surface [m]
CONTACT_HEIGHTS = (0.02, 0.14)  # a surface this high above the floor darkens it by half: touching, and hanging over it [m]
CONTACT_BLUR = (0.012, 0.05)  # half widths of the two shadows' soft edges [m]
SKY_BLUR = 0.03  # [m]
FAINTEST = 1 / 512  # contact shadow that no byte shows
DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
UP = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


Box = tuple[float, float, float, float]
Axes = tuple[Vector, Vector, Vector]

NOWHERE: Box = (0.0, -1.0, 0.0, -1.0)


class Rig(NamedTuple):
    """Where the maps lie; it does not move from frame to frame, so that shadows do not shimmer.

    axes: right, up and to the light, unit vectors.  center [m].  shadow_size and height_size: texels along a side;
    shadow_scale and height_scale: texels per metre.  Tuples, because an array passed within a kernel costs more than a look
    at the map.
    """

    axes: Axes
    center: Vector
    shadow_size: int
    shadow_scale: float
    height_size: int
    height_scale: float


class Maps(NamedTuple):
    """shadow: nearness to the light [m], (size, size).  heights, (size, size, 3): the floor's two contact shadows, 0 to 1,
    and the blurred height of the topmost surface [m].  The boxes: lowest and highest column and row where a look at
    the map can tell anything.  floor_box: lowest and highest x and y [m] of what they tell about the floor; most of the
    floor lies outside and is spared the look."""

    shadow: NDArray[np.float32]
    shadow_box: Box
    heights: NDArray[np.float32]
    heights_box: Box
    floor_box: Box


def studio_rig(camera: Camera, pixels: int) -> Rig:
    """Maps over what the camera sees, with a key light high behind its left shoulder, for a picture that many samples high."""
    right, _, forward = camera.axes
    # a camera may be rolled, its lamp is not
    sideways = right * (1, 1, 0) if abs(right[2]) < 0.9 else np.array([1.0, 0, 0])
    sideways /= np.linalg.norm(sideways)
    backward = np.cross(sideways, (0, 0, 1))
    if backward @ forward > 0:
        backward = -backward
    direction = 0.30 * backward - 0.62 * sideways + np.array([0, 0, 1.0])
    direction /= np.linalg.norm(direction)
    across = np.cross((0, 0, 1), direction)
    across /= np.linalg.norm(across)
    axes = as_tuple(across), as_tuple(np.cross(direction, across)), as_tuple(direction)
    width = 2.8 * camera.reach
    shadow_size, height_size = min(max(pixels // 2, 160), 512), min(max(pixels // 4, 72), 128)
    return Rig(axes, camera.target, shadow_size, shadow_size / width, height_size, height_size / width)


@kernel
def blur_turned(source, radius, out):
    """Mean over 2 radius + 1 neighbours along a row, written to the transposed place: four calls blur both ways twice."""
    size = source.shape[0]
    share = np.float32(1 / (2 * radius + 1))
    for row in range(size):
        total = np.float32(0)
        for column in range(-radius, size):
            if column + radius < size:
                total += source[row, column + radius]
            if column - radius - 1 >= 0:
                total -= source[row, column - radius - 1]
            if column >= 0:
                out[column, row] = total * share


@kernel
def contact_shadow(lowest, half_height, out):
    """How much a surface darkens the floor below it: 1 where it touches, 1/2 at ``half_height`` [m], 0 where there is none."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            h = max(-lowest[row, column], 0) / half_height
            out[row, column] = 1 / (1 + h * h)


def _blur(field: NDArray[np.float32], radius: int) -> None:
    other = np.empty_like(field)
    for _ in range(2):
        blur_turned(field, radius, other)
        blur_turned(other, radius, field)


def _box(filled: NDArray[np.bool_], before: int, after: int) -> Box:
    """Coordinates (columns, then rows) whose neighbours, ``before`` to ``after`` texels on, include a filled one."""
    ends: list[float] = []
    for axis in (0, 1):
        places = np.flatnonzero(filled.any(axis=axis))
        if len(places) == 0:
            return NOWHERE
        ends += [max(places[0] - after, before), min(places[-1] + before + 1, filled.shape[0] - after)]
    return float(ends[0]), float(ends[1]), float(ends[2]), float(ends[3])


def _corners_on_floor(box: Box, axes: Axes, center: Vector, scale: float, size: int) -> list[tuple[float, float]]:
    """Where the rays through the corners of a map's box meet the floor: (x, y) [m]."""
    (rx, ry, rz), (ux, uy, uz), (dx, dy, dz) = axes
    corners: list[tuple[float, float]] = []
    if box == NOWHERE:
        return corners
    for u, v in itertools.product(box[:2], box[2:]):
        right, up = (u + 0.5 - 0.5 * size) / scale, (0.5 * size - v - 0.5) / scale
        slide = (center[2] + right * rz + up * uz) / dz
        corners.append((center[0] + right * rx + up * ux - slide * dx, center[1] + right * ry + up * uy - slide * dy))
    return corners


def draw_maps(rig: Rig, x: NDArray[np.float32], triangles: NDArray[np.int32], num_cloth: int, bias: float) -> Maps:
    """The maps of one frame from vertices ``x`` [m], (vertices, 3), the first ``num_cloth`` of them cloth."""
    screen = np.empty((len(x), 2), np.int32)
    nearness = np.empty(len(x), np.float32)

    def seen_from(axes: Axes, center: Vector, scale: float, size: int, empty: float) -> NDArray[np.float32]:
        project_orthographic(x, axes, center, scale, size, num_cloth, bias, screen, nearness)
        buffer = np.full((size, size), empty, np.float32)
        rasterise(screen, nearness, triangles, len(triangles), buffer, np.empty((size, size), np.int32))
        return buffer

    shadow = seen_from(rig.axes, rig.center, rig.shadow_scale, rig.shadow_size, NOTHING)
    on_floor = (rig.center[0], rig.center[1], 0.0)
    lowest = seen_from(DOWN, on_floor, rig.height_scale, rig.height_size, NOTHING)
    fields = [seen_from(UP, on_floor, rig.height_scale, rig.height_size, 0.0)]
    _blur(fields[0], max(1, math.ceil(SKY_BLUR * rig.height_scale)))
    for half_height, width in zip(CONTACT_HEIGHTS[::-1], CONTACT_BLUR[::-1]):
        fields.insert(0, np.empty_like(lowest))
        contact_shadow(lowest, half_height, fields[0])
        _blur(fields[0], max(1, math.ceil(width * rig.height_scale)))
    heights = np.stack(fields, axis=-1)
    shadow_box = _box(shadow > NOTHING, 1, 2)
    heights_box = _box((fields[0] > FAINTEST) | (fields[1] > FAINTEST) | (fields[2] > FAINTEST), 0, 1)
    corners = _corners_on_floor(shadow_box, rig.axes, rig.center, rig.shadow_scale, rig.shadow_size)
    corners += _corners_on_floor(heights_box, UP, on_floor, rig.height_scale, rig.height_size)
    floor_box = NOWHERE
    if corners:
        along, across = zip(*corners)
        floor_box = (min(along), max(along), min(across), max(across))
    return Maps(shadow, shadow_box, heights, heights_box, floor_box)

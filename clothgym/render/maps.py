"""Maps of what lies between a point and the light: a shadow map, and how the floor and the sky are covered.

All maps are square, share one center and are rasterized for each frame with the kernels of the picture itself.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.render.camera import Camera, Vector, as_tuple
from clothgym.render.raster import project_orthographic, rasterize

NOTHING = -1e6  # nearness where a light ray meets no surface [m]
CONTACT_HEIGHTS = (0.02, 0.14)  # height above the floor at which a surface darkens it by half: touching, hanging over it [m]
CONTACT_BLUR = (0.012, 0.05)  # half widths of the two shadows' soft edges [m]
SKY_BLUR = 0.03  # [m]
CAST_BLUR = (0.008, 0.04)  # half widths of the blur of shadows on the floor: of objects on the floor, and far above it [m]
FAR_ABOVE = 0.6  # [m]
FAINTEST = 1 / 512  # contact shadow too faint for a byte
DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
UP = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


Box = tuple[float, float, float, float]
Axes = tuple[Vector, Vector, Vector]

NOWHERE: Box = (0.0, -1.0, 0.0, -1.0)


class Rig(NamedTuple):
    """Placement of the maps, the same in all frames, so that shadows do not shimmer.

    axes: right, up and to the light, unit vectors.  center [m].  shadow_size and height_size: texels along a side;
    shadow_scale and height_scale: texels per meter.  Tuples, because passing an array within a kernel costs more than
    reading the map.
    """

    axes: Axes
    center: Vector
    shadow_size: int
    shadow_scale: float
    height_size: int
    height_scale: float


class Maps(NamedTuple):
    """shadow: nearness to the light [m], (size, size).  cast: the lamp's shadow on the floor along the same rays, 0 to 1, at half
    that size.  heights, (size, size, 3): the floor's two contact shadows, 0 to 1, and the blurred height of the topmost surface
    [m].  The boxes: lowest and highest column and row where a map is not empty.  floor_box: lowest and highest x and y [m] of
    the floor where any is not; most of the floor lies outside, and needs no map."""

    shadow: NDArray[np.float32]
    shadow_box: Box
    cast: NDArray[np.float32]
    cast_box: Box
    heights: NDArray[np.float32]
    heights_box: Box
    floor_box: Box


def studio_rig(camera: Camera, pixels: int) -> Rig:
    """Maps over what the camera sees, with a key light high behind its left shoulder; pixels: samples along the image's side."""
    right, _, forward = camera.axes
    # a camera may be rolled, the lamp is not
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
    shadow_size, height_size = min(max(pixels // 4 * 2, 160), 512), min(max(pixels // 4, 72), 128)
    return Rig(axes, camera.target, shadow_size, shadow_size / width, height_size, height_size / width)


@kernel
def blur_turned(source, radius, out):
    """Mean of 2 radius + 1 neighbors along a row, written transposed: four calls blur both ways twice."""
    height, width = source.shape
    share = np.float32(1 / (2 * radius + 1))
    for row in range(height):
        total = np.float32(0)
        for column in range(-radius, width):
            if column + radius < width:
                total += source[row, column + radius]
            if column - radius - 1 >= 0:
                total -= source[row, column - radius - 1]
            if column >= 0:
                out[column, row] = total * share


@kernel
def contact_shadow(lowest, half_height, out):
    """How much a surface darkens the floor below it: 1 where it touches, 1/2 at ``half_height`` [m], 0 without a surface."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            h = max(-lowest[row, column], 0) / half_height
            out[row, column] = 1 / (1 + h * h)


@kernel
def split_shadow(shadow, axes, center, scale, left, top, near, far):
    """The lamp's shadow on the floor at half the resolution of ``shadow``, from column ``left`` and row ``top`` on, in two parts, 0
    to 1: of objects near the floor, and of objects ``FAR_ABOVE`` it or more along the ray."""
    size = shadow.shape[0] // 2
    for row in range(top, top + near.shape[0]):
        for column in range(left, left + near.shape[1]):
            right, up = (2 * column + 1 - size) / scale, (size - 2 * row - 1) / scale
            floor = -(center[2] + right * axes[0][2] + up * axes[1][2]) / axes[2][2]
            covered, share = np.float32(0), np.float32(0)
            for r in range(2 * row, 2 * row + 2):
                for c in range(2 * column, 2 * column + 2):
                    gap = shadow[r, c] - floor
                    if gap > 0:
                        covered += np.float32(0.25)
                        share += np.float32(0.25) * np.float32(min(gap / FAR_ABOVE, 1))
            near[row - top, column - left], far[row - top, column - left] = covered - share, share


def _blur(field: NDArray[np.float32], radius: int) -> None:
    """Blur a field in place, twice along each axis."""
    other = np.empty(field.shape[::-1], np.float32)
    for _ in range(2):
        blur_turned(field, radius, other)
        blur_turned(other, radius, field)


@kernel
def filled(field, threshold, channels):
    """First and last column, first and last row where one of the first ``channels`` exceeds the threshold; first > last if none."""
    rows, columns, _ = field.shape
    left, right, top, bottom = columns, -1, rows, -1
    for row in range(rows):
        for column in range(columns):
            for channel in range(channels):
                if field[row, column, channel] > threshold:
                    left, right = min(left, column), max(right, column)
                    top, bottom = min(top, row), max(bottom, row)
    return left, right, top, bottom


def _box(ends: tuple[int, int, int, int], before: int, after: int, size: int) -> Box:
    """Coordinates (columns, then rows) whose neighbors, ``before`` to ``after`` texels on, include a filled one."""
    if ends[0] > ends[1]:
        return NOWHERE
    low, high = (
        (max(float(end - after), before) for end in ends[::2]),
        (min(float(end + before + 1), size - after) for end in ends[1::2]),
    )
    (left, top), (right, bottom) = low, high
    return left, right, top, bottom


def _floor_shadow(rig: Rig, shadow: NDArray[np.float32], ends: tuple[int, int, int, int]) -> tuple[NDArray[np.float32], Box]:
    """The lamp's shadow on the floor, blurred more for higher objects, and its box."""
    size = rig.shadow_size // 2
    cast = np.zeros((size, size, 1), np.float32)
    if ends[0] > ends[1]:
        return cast, NOWHERE
    radii = [max(1, round(0.5 * width * rig.shadow_scale)) for width in CAST_BLUR]
    margin = 2 * max(radii) + 1
    left, top = (max(end // 2 - margin, 0) for end in ends[::2])
    right, bottom = (min(end // 2 + margin, size - 1) for end in ends[1::2])
    parts = np.empty((2, bottom + 1 - top, right + 1 - left), np.float32)
    split_shadow(shadow, rig.axes, rig.center, rig.shadow_scale, left, top, parts[0], parts[1])
    for part, radius in zip(parts, radii):
        _blur(part, radius)
    np.add(parts[0], parts[1], out=cast[top : bottom + 1, left : right + 1, 0])
    return cast, _box((left, right, top, bottom), 0, 1, size)


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
    """The maps of one frame; x: vertices [m], (vertices, 3), of which the first ``num_cloth`` are cloth."""
    screen = np.empty((len(x), 2), np.int32)
    nearness = np.empty(len(x), np.float32)

    def seen_from(axes: Axes, center: Vector, scale: float, size: int, empty: float) -> NDArray[np.float32]:
        project_orthographic(x, axes, center, scale, size, num_cloth, bias, screen, nearness)
        buffer = np.full((size, size), empty, np.float32)
        rasterize(screen, nearness, triangles, len(triangles), buffer, np.empty((size, size), np.int32))
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
    ends = filled(shadow[:, :, None], NOTHING, 1)
    shadow_box = _box(ends, 1, 2, rig.shadow_size)
    cast, cast_box = _floor_shadow(rig, shadow, ends)
    heights_box = _box(filled(heights, FAINTEST, 3), 0, 1, rig.height_size)
    corners = _corners_on_floor(cast_box, rig.axes, rig.center, 0.5 * rig.shadow_scale, rig.shadow_size // 2)
    corners += _corners_on_floor(heights_box, UP, on_floor, rig.height_scale, rig.height_size)
    floor_box = NOWHERE
    if corners:
        along, across = zip(*corners)
        floor_box = (min(along), max(along), min(across), max(across))
    return Maps(shadow, shadow_box, cast, cast_box, heights, heights_box, floor_box)

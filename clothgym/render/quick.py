"""Small pictures of a whole batch in one call, at the speed of learning: what environments observe, not what people look at.

Every pixel is one ray through its middle.  Cloth and meshes are triangles with a z-buffer, by edge functions in float64 that are
the same to the bit for both triangles of an edge (Pineda 1988); spheres, capsules, boxes and planes are met by the ray itself.
So a depth is that of the exact surface.  Surfaces are flat and matt, under one fixed light from above (Lambert); nothing casts a
shadow.

``Sight`` is a camera with a picture's size: a pinhole camera, or parallel rays straight down, for heights.  ``Views`` are
those of a batch: places and colors, of each one for all environments or one for each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel, uncounted
from clothgym.render.camera import Camera
from clothgym.render.quick_solids import (
    AXES,
    CENTER,
    COLOR,
    EYE,
    FORWARD,
    HALF_HEIGHT,
    HALF_WIDTH,
    HELD_BACK,
    NEAR,
    PERSPECTIVE,
    PLANE,
    RIGHT,
    ROUNDED_BOX,
    SCALE,
    SIGHT_ROWS,
    UP,
    draw_plane,
    draw_rounded_box,
    lambert,
)
from clothgym.render.shading import CORAL, INDIGO

NOTHING, CLOTH, SOLID = 0, 1, 2  # what a pixel shows
RGB, DEPTH, RGBD, HEIGHTS, POINTS = range(5)  # kinds of pictures
FLOOR_COLORS, SKY_COLOR = ((214, 208, 198), (202, 196, 186)), (226, 230, 234)
TILE = 0.1  # side of a tile of the floor [m]


class Sight(NamedTuple):
    """numbers: of a camera, see ``quick_solids``, (SIGHT_ROWS,).  near: the floor's nearness at each pixel, (height, width); color:
    its colors, (height, width, 3).  Nearness is the inverse depth [1/m] of a pinhole camera, and with parallel rays the height [m].
    """

    numbers: NDArray[np.float64]
    near: NDArray[np.float32]
    color: NDArray[np.uint8]


class Views(NamedTuple):
    """From where, in which colors and how bright the environments of a batch are drawn.

    numbers, near, color: as those of ``Sight``, with an axis of places before, one for all environments or one for each.
    cloth: colors of the front and the back, from 0 to 255, (looks, 2, 3).  brightness: factor on all colors, (looks,); one look for
    all environments, or one for each.
    """

    numbers: NDArray[np.float64]
    near: NDArray[np.float32]
    color: NDArray[np.uint8]
    cloth: NDArray[np.float64]
    brightness: NDArray[np.float64]


def views_from(sight: Sight, places: int = 1, looks: int = 1) -> Views:
    """So many views from the same place, in the usual colors."""
    cloth = np.tile(np.array([CORAL, INDIGO], np.float64), (looks, 1, 1))
    numbers, near, color = sight
    return Views(np.stack([numbers] * places), np.stack([near] * places), np.stack([color] * places), cloth, np.ones(looks))


def sight_of(camera: Camera, size: int) -> Sight:
    """A pinhole camera with square pictures of ``size`` pixels a side."""
    view = camera.view(size, size)
    numbers = np.zeros(SIGHT_ROWS)
    numbers[EYE : EYE + 3], numbers[RIGHT : RIGHT + 9] = camera.eye, camera.axes.ravel()
    numbers[SCALE], numbers[NEAR], numbers[HALF_WIDTH], numbers[HALF_HEIGHT] = view.scale, camera.near, size / 2, size / 2
    numbers[PERSPECTIVE] = 1
    # the floor: a ray of length 1 along the view axis meets it at the depth eye_z / -ray_z
    rays = _offsets(numbers, size) + camera.axes[2]
    down = -rays[..., 2] / camera.eye[2]
    seen = down > 1e-9
    at = np.asarray(camera.eye)[:2] + rays[..., :2] / np.where(seen, down, 1)[..., None]
    tiles = np.asarray(FLOOR_COLORS, np.uint8)[np.floor(at / TILE).sum(axis=-1).astype(np.int64) % 2]
    color = np.where(seen[..., None], tiles, np.asarray(SKY_COLOR, np.uint8))
    return Sight(numbers, np.where(seen, down, 0).astype(np.float32), color)


def straight_down(middle: NDArray, half: float, size: int) -> Sight:
    """Parallel rays straight down on a square of half side ``half`` [m] about ``middle`` [m], (2,); y points up in the picture."""
    numbers = np.zeros(SIGHT_ROWS)
    numbers[EYE : EYE + 2] = middle
    numbers[RIGHT : RIGHT + 9] = (1, 0, 0, 0, 1, 0, 0, 0, -1)
    numbers[SCALE], numbers[NEAR], numbers[HALF_WIDTH], numbers[HALF_HEIGHT] = size / (2 * half), -np.inf, size / 2, size / 2
    return Sight(numbers, np.zeros((size, size), np.float32), np.zeros((size, size, 3), np.uint8))


def _offsets(numbers: NDArray, size: int) -> NDArray[np.float64]:
    """Offset of the ray through the middle of each pixel from the view axis, (size, size, 3)."""
    across = (np.arange(size) + 0.5 - size / 2) / numbers[SCALE]
    return across[None, :, None] * numbers[RIGHT : RIGHT + 3] - across[:, None, None] * numbers[UP : UP + 3]


class Surfaces(NamedTuple):
    """Triangles of the cloth, (triangles, 3); of all mesh solids, with their vertices in the solid's axes [m], (vertices, 3); and
    where those of each solid begin, (solids + 1,): vertices and triangles."""

    cloth: NDArray[np.int64]
    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    first_vertex: NDArray[np.int64]
    first_triangle: NDArray[np.int64]


def surfaces_of(cloth: NDArray, meshes: list[tuple[NDArray, NDArray] | None]) -> Surfaces:
    """meshes: of each solid that is a mesh its vertices and triangles; None for the others."""
    found = [(np.zeros((0, 3)), np.zeros((0, 3), np.int64)) if mesh is None else mesh for mesh in meshes]
    return Surfaces(
        np.array(cloth, np.int64),
        np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in found)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(triangles for _, triangles in found)]).astype(np.int64),
        np.cumsum([0, *(len(vertices) for vertices, _ in found)]),
        np.cumsum([0, *(len(triangles) for _, triangles in found)]),
    )


@kernel
def draw_pictures(first, last, kind, envs, places, x, surfaces, things, views, measure, out):
    """Draw environments ``envs[first:last]``.

    kind: RGB, DEPTH [m], RGBD (colors from 0 to 1, depth [m]), HEIGHTS or POINTS (in sides).
    places: block and lane of each of ``envs``; x: [m], (block, 3, particles, lane).  surfaces, views: as these are called here.
    things: the shape of each solid, see ``quick_solids``, (solids,), and its rows, (len(envs), solids, SOLID_ROWS).
    measure: what points are relative to [m], (num_envs, 3); sides in a meter; and the farthest depth [m], or the largest height or
    coordinate, in sides.  out: to be written to, uint8 for colors and float32 for numbers, both (num_envs, ...), flat.
    """
    (block, lane), (origin, per_side, bound), (pictures, numbers) = places, measure, out
    places_seen_from, height, width = views.near.shape
    looks = views.brightness.shape[0]
    colored = kind in (RGB, RGBD)
    # one picture's memory, used for one after the other
    count = max(x.shape[2], surfaces[1].shape[0])
    world, screen = np.empty((count, 3)), np.empty((count, 3))
    near, what = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
    color = np.empty((height, width, 3), np.uint8)
    picture = near, what, color
    for i in range(first, last):
        e = envs[i]
        # the environment's own view, or that of all
        v, w = e if places_seen_from > 1 else 0, e if looks > 1 else 0
        view, brightness = (views.numbers[v], views.near[v], views.color[v], views.cloth[w]), views.brightness[w]
        draw_one(colored, i, block[i], lane[i], x, surfaces, things, view, world, screen, picture)
        if kind == RGB:
            write_colors(color, brightness, e, pictures)
        elif kind == POINTS:
            write_points(near, what, views.numbers[v], origin, per_side, bound, e, numbers)
        elif kind == HEIGHTS:
            write_heights(near, per_side, bound, e, numbers)
        elif kind == DEPTH:
            write_depths(near, bound, 1, e, numbers)
        else:
            write_shares(color, brightness, e, numbers)
            write_depths(near, bound, 4, e, numbers)


@uncounted
def draw_one(colored, i, b, l, x, surfaces, things, view, world, screen, picture):
    """One picture: the nearest surface at each pixel, ``near``; ``what`` it is; and its ``color``, if ``colored``."""
    cloth, vertices, triangles, first_vertex, first_triangle = surfaces
    (shapes, solids), (sight, background, floor, cloth_colors), (near, what, color) = things, view, picture
    height, width = near.shape
    for r in range(height):
        for c in range(width):
            near[r, c] = background[r, c]
    for r in range(height):
        for c in range(width):
            what[r, c] = NOTHING
    if colored:
        for r in range(height):
            for c in range(width):
                for k in range(3):
                    color[r, c, k] = floor[r, c, k]
    # solids, in their order
    for s in range(shapes.shape[0]):
        if shapes[s] == HELD_BACK or solids[i, s, COLOR] < 0:
            continue
        if shapes[s] == PLANE:
            draw_plane(colored, solids, i, s, sight, near, what, color)
        elif shapes[s] == ROUNDED_BOX:
            draw_rounded_box(colored, solids, i, s, sight, near, what, color)
        else:
            # a mesh, turned and moved to its place
            begin, end = first_vertex[s], first_vertex[s + 1]
            for v in range(begin, end):
                for c in range(3):
                    world[v - begin, c] = solids[i, s, CENTER + c]
                    for a in range(3):
                        world[v - begin, c] += vertices[v, a] * solids[i, s, AXES + 3 * a + c]
            project(world, end - begin, sight, screen)
            own = solids[i, s, COLOR], solids[i, s, COLOR + 1], solids[i, s, COLOR + 2]
            draw_triangles(colored, SOLID, own, own, triangles, first_triangle[s], first_triangle[s + 1], world, screen, picture)
    # the cloth
    particles = x.shape[2]
    for p in range(particles):
        for c in range(3):
            world[p, c] = x[b, c, p, l]
    project(world, particles, sight, screen)
    # its two sides in their colors
    front = cloth_colors[0, 0], cloth_colors[0, 1], cloth_colors[0, 2]
    back = cloth_colors[1, 0], cloth_colors[1, 1], cloth_colors[1, 2]
    draw_triangles(colored, CLOTH, front, back, cloth, 0, cloth.shape[0], world, screen, picture)


@uncounted
def project(world, count, sight, screen):
    """Positions of points in the image [pixels] and their nearness, (points, 3); NaN for points behind the near plane."""
    scale, nearest = sight[SCALE], sight[NEAR]
    for v in range(count):
        dx, dy, dz = world[v, 0] - sight[EYE], world[v, 1] - sight[EYE + 1], world[v, 2] - sight[EYE + 2]
        right = sight[RIGHT] * dx + sight[RIGHT + 1] * dy + sight[RIGHT + 2] * dz
        up = sight[UP] * dx + sight[UP + 1] * dy + sight[UP + 2] * dz
        depth = sight[FORWARD] * dx + sight[FORWARD + 1] * dy + sight[FORWARD + 2] * dz
        if sight[PERSPECTIVE] > 0:
            nearness = 1 / depth if depth > nearest else np.nan
            size = scale * nearness
        else:
            nearness, size = -depth, scale
        screen[v, 0] = sight[HALF_WIDTH] + size * right
        screen[v, 1] = sight[HALF_HEIGHT] - size * up
        screen[v, 2] = nearness


@uncounted
def draw_triangles(colored, mark, front_color, back_color, triangles, begin, end, world, screen, picture):
    """Draw ``triangles[begin:end]`` from both sides, each in the color of the side that is seen.

    The edge function of the edge from i to j at the sample s is (y_i - y_j) s_x + (x_j - x_i) s_y + x_i y_j - x_j y_i: taken from j
    to i it is the same number with the other sign, to the bit, so that no sample falls between two triangles.
    """
    near, what, color = picture
    height, width = near.shape
    for t in range(begin, end):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x0, y0, x1, y1, x2, y2 = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        # the samples within its bounds: most small triangles have none
        top = np.ceil(min(y0, min(y1, y2)) - 0.5)
        bottom = np.floor(max(y0, max(y1, y2)) - 0.5)
        left = np.ceil(min(x0, min(x1, x2)) - 0.5)
        right = np.floor(max(x0, max(x1, x2)) - 0.5)
        if not (top <= bottom and left <= right and right >= 0 and left < width and bottom >= 0 and top < height):
            continue
        # twice the area: rows count downwards, so it is negative for a front; NaN where a corner is not drawn
        a0, b0, c0 = y1 - y2, x2 - x1, x1 * y2 - x2 * y1
        a1, b1, c1 = y2 - y0, x0 - x2, x2 * y0 - x0 * y2
        a2, b2, c2 = y0 - y1, x1 - x0, x0 * y1 - x1 * y0
        area = b2 * a1 - a2 * b1
        if not abs(area) > 0:
            continue
        front = area < 0
        if front:
            a0, b0, c0, a1, b1, c1, a2, b2, c2 = -a0, -b0, -c0, -a1, -b1, -c1, -a2, -b2, -c2
        share = 1 / abs(area)
        n0, n1, n2 = screen[i, 2] * share, screen[j, 2] * share, screen[k, 2] * share
        red = green = blue = 0.0
        if colored:
            # flat: the normal of the side that is seen
            ux, uy, uz = world[j, 0] - world[i, 0], world[j, 1] - world[i, 1], world[j, 2] - world[i, 2]
            vx, vy, vz = world[k, 0] - world[i, 0], world[k, 1] - world[i, 1], world[k, 2] - world[i, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            sign = 1.0 if front else -1.0
            shade = lambert(sign * nx, sign * ny, sign * nz)
            red = shade * (front_color[0] if front else back_color[0])
            green = shade * (front_color[1] if front else back_color[1])
            blue = shade * (front_color[2] if front else back_color[2])
        low, high = int(max(left, 0.0)), int(min(right, width - 1.0))
        for r in range(int(max(top, 0.0)), int(min(bottom, height - 1.0)) + 1):
            sy = r + 0.5
            d0, d1, d2 = b0 * sy + c0, b1 * sy + c1, b2 * sy + c2
            for c in range(low, high + 1):
                sx = c + 0.5
                e0, e1, e2 = d0 + a0 * sx, d1 + a1 * sx, d2 + a2 * sx
                if e0 >= 0 and e1 >= 0 and e2 >= 0:
                    n = np.float32(e0 * n0 + e1 * n1 + e2 * n2)
                    if n > near[r, c]:
                        near[r, c] = n
                        what[r, c] = mark
                        if colored:
                            color[r, c, 0], color[r, c, 1], color[r, c, 2] = np.uint8(red), np.uint8(green), np.uint8(blue)


@uncounted
def write_colors(color, brightness, e, pictures):
    """Colors of a picture times its brightness, to its row."""
    height, width, _ = color.shape
    for r in range(height):
        for c in range(width):
            for k in range(3):
                pictures[e, 3 * (r * width + c) + k] = np.uint8(min(brightness * color[r, c, k], 255.0))


@uncounted
def write_heights(near, per_side, bound, e, numbers):
    """Heights in sides, to the picture's row, within their bounds."""
    height, width = near.shape
    scale, most = np.float32(per_side), np.float32(bound)
    for r in range(height):
        for c in range(width):
            n = near[r, c] * scale
            n = n if n > 0 else np.float32(0)
            numbers[e, r * width + c] = n if n < most else most


@uncounted
def write_depths(near, bound, channels, e, numbers):
    """Depths [m], the last of so many channels, to the picture's row; nothing is farther than the bound."""
    height, width = near.shape
    least = np.float32(1) / np.float32(bound)
    for r in range(height):
        for c in range(width):
            n = near[r, c]
            depth = np.float32(1) / n if n > least else np.float32(bound)
            numbers[e, channels * (r * width + c) + channels - 1] = depth


@uncounted
def write_shares(color, brightness, e, numbers):
    """Colors times brightness, from 0 to 1, the first three of four channels, to the picture's row."""
    height, width, _ = color.shape
    for r in range(height):
        for c in range(width):
            for k in range(3):
                numbers[e, 4 * (r * width + c) + k] = np.float32(min(brightness * color[r, c, k], 255.0)) / np.float32(255)


@uncounted
def write_points(near, what, sight, origin, per_side, bound, e, numbers):
    """Points of the cloth that are seen, relative to the origin, in sides, (points, 3), flat; zeros where none is.

    Of m pixels that show the cloth, in reading order, the points are number floor(k m / points): spread evenly, each once or, where
    there are too few, several times.
    """
    height, width = near.shape
    seen = 0
    for r in range(height):
        for c in range(width):
            seen += what[r, c] == CLOTH
    count = numbers.shape[1] // 3
    taken = passed = 0
    for r in range(height):
        for c in range(width):
            if what[r, c] != CLOTH:
                continue
            # all points whose number this pixel has
            across, down = (c + 0.5 - sight[HALF_WIDTH]) / sight[SCALE], (sight[HALF_HEIGHT] - r - 0.5) / sight[SCALE]
            depth = 1 / np.float64(near[r, c])
            while taken < count and taken * seen // count == passed:
                for k in range(3):
                    ray = sight[FORWARD + k] + across * sight[RIGHT + k] + down * sight[UP + k]
                    value = (sight[EYE + k] + depth * ray - origin[e, k]) * per_side
                    numbers[e, 3 * taken + k] = min(max(value, -bound), bound)
                taken += 1
            passed += 1
    for k in range(3 * taken, 3 * count):
        numbers[e, k] = 0

"""Where rays meet planes, spheres, capsules and boxes, and how these are lit: the solids of ``quick``.

A solid is a row of numbers: a point of it, its x, y and z axes, half sides b, radius r, and color; with a shape: a plane, whose
normal is the z axis, a rounded box (b = 0: a sphere; b = (0, 0, h): a capsule; r = 0: a box) or a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions import Box, Collider, Plane, Sphere
from clothgym.collisions.solids.shapes import KIND_MESH, KIND_PLANE, KIND_ROUNDED_BOX
from clothgym.render.solids import Color, Drawable, drawn

# numbers of a camera: eye [m], unit vectors to the right, up and forward, pixels per unit of slope (or per meter, with parallel
# rays), depth below which nothing is drawn [m], half of the picture [pixels], and whether it is a pinhole camera
EYE, RIGHT, UP, FORWARD, SCALE, NEAR, HALF_WIDTH, HALF_HEIGHT, PERSPECTIVE = 0, 3, 6, 9, 12, 13, 14, 15, 16
SIGHT_ROWS = 17
# numbers of a solid; a negative color is not drawn
CENTER, AXES, HALF, RADIUS, COLOR = 0, 3, 12, 15, 16
SOLID_ROWS = 19
HELD_BACK, PLANE, ROUNDED_BOX, MESH = -1, KIND_PLANE, KIND_ROUNDED_BOX, KIND_MESH  # shapes; the first is the floor, drawn already

SUN = (0.32, -0.41, 0.854)  # towards the light, about of length 1
AMBIENT, DIFFUSE = 0.45, 0.55  # of the color that a surface has in the light and out of it


def shape_of(collider: Collider) -> int:
    """How a collider is drawn: ``PLANE``, ``ROUNDED_BOX`` or ``MESH``; the floor is not."""
    if isinstance(collider, Plane) and collider.point[2] == 0 and collider.normal[:2] == (0, 0):
        return HELD_BACK
    return collider.kind


def solid_row(thing: Drawable) -> NDArray[np.float64]:
    """The numbers of a sphere, capsule or box, or of a marker, (SOLID_ROWS,).

    Raises:
        ValueError: it cannot be drawn, or is a mesh.
    """
    one, row = drawn(thing), np.zeros(SOLID_ROWS)
    if one.collider.kind == KIND_MESH:
        raise ValueError(f"{one.collider!r} cannot be a marker in pictures that are observed: take a Sphere, Capsule or Box")
    axes, half, radius = one.rounded_box()
    row[CENTER : CENTER + 3], row[AXES : AXES + 9], row[HALF : HALF + 3] = one.collider.center, axes.ravel(), half
    row[RADIUS], row[COLOR:] = radius, one.color
    return row


def hidden(environments: int, count: int) -> NDArray[np.float64]:
    """Rows of so many solids that are not drawn yet, unturned, (environments, count, SOLID_ROWS)."""
    rows = np.zeros((environments, count, SOLID_ROWS))
    rows[..., AXES : AXES + 9] = np.eye(3).ravel()
    rows[..., COLOR] = -1
    return rows


def balls(middles: NDArray, radius: float, color: Color | NDArray, there: NDArray | bool = True) -> NDArray[np.float64]:
    """Rows of balls; middles: [m], (environments, balls, 3); color: of all, or of each ball, (balls, 3); there: which of them there
    are, (environments, balls)."""
    rows = hidden(*middles.shape[:2])
    rows[..., CENTER : CENTER + 3], rows[..., RADIUS] = middles, radius
    rows[..., COLOR:] = np.where(np.expand_dims(there, -1), color, -1)
    return rows


def boxes(middles: NDArray, half_sides: NDArray, colors: Sequence[Color]) -> NDArray[np.float64]:
    """Rows of boxes along the axes; middles: [m], (environments, boxes, 3); half_sides: [m], (boxes, 3); colors: of each box."""
    rows = hidden(*middles.shape[:2])
    rows[..., CENTER : CENTER + 3], rows[..., HALF : HALF + 3], rows[..., COLOR:] = middles, half_sides, colors
    return rows


def drawables(rows: NDArray) -> list[Drawable]:
    """The balls, and boxes along the axes, of one environment's rows that are drawn."""
    found: list[Drawable] = []
    for row in rows[rows[:, COLOR] >= 0].tolist():
        center, half = tuple(row[CENTER : CENTER + 3]), tuple(row[HALF : HALF + 3])
        solid = Box(center=center, half_sides=half) if any(half) else Sphere(center=center, radius=row[RADIUS])
        found.append((solid, tuple(map(int, row[COLOR:]))))  # type: ignore[arg-type]
    return found


def solid_rows(things: Sequence[Sequence[Drawable]]) -> NDArray[np.float64]:
    """Those of several environments, (environments, most of any, SOLID_ROWS); what an environment has less of is not drawn."""
    rows = hidden(len(things), max(map(len, things), default=0))
    for env, own in enumerate(things):
        for k, thing in enumerate(own):
            rows[env, k] = solid_row(thing)
    return rows


@kernel
def lambert(x, y, z):
    """Share of its color that a surface has, by its normal of any length (Lambert's law under the light and a sky)."""
    length = np.sqrt(x * x + y * y + z * z)
    if not length > 0:
        return AMBIENT
    return AMBIENT + DIFFUSE * max(0.0, (SUN[0] * x + SUN[1] * y + SUN[2] * z) / length)


@uncounted
def draw_plane(colored, solids, i, s, sight, near, what, color):
    """Draw a half-space: t = n (p - o) / (n d) where the ray o + t d comes from outside."""
    height, width = near.shape
    nx, ny, nz = solids[i, s, AXES + 6], solids[i, s, AXES + 7], solids[i, s, AXES + 8]
    shade = lambert(nx, ny, nz)
    for r in range(height):
        for c in range(width):
            ox, oy, oz, dx, dy, dz = ray_of(sight, r, c)
            falls = nx * dx + ny * dy + nz * dz
            if not falls < 0:
                continue
            away = nx * (solids[i, s, 0] - ox) + ny * (solids[i, s, 1] - oy) + nz * (solids[i, s, 2] - oz)
            show(away / falls, shade, colored, solids, i, s, sight, r, c, near, what, color)


@uncounted
def draw_rounded_box(colored, solids, i, s, sight, near, what, color):
    """Draw a sphere, a capsule or a box, at the pixels within the bounds of the balls that reach farthest."""
    height, width = near.shape
    bx, by, bz, radius = solids[i, s, HALF], solids[i, s, HALF + 1], solids[i, s, HALF + 2], solids[i, s, RADIUS]
    mx, my, mz = solids[i, s, 0] - sight[EYE], solids[i, s, 1] - sight[EYE + 1], solids[i, s, 2] - sight[EYE + 2]
    # bounds of the balls at the corners, from depth d - r to d + r and within r to all sides: the solid is their convex hull
    first, last, upper, lower, whole = np.inf, -np.inf, np.inf, -np.inf, False
    for corner in range(8):
        cx, cy, cz = bx if corner & 1 else -bx, by if corner & 2 else -by, bz if corner & 4 else -bz
        x = mx + cx * solids[i, s, AXES] + cy * solids[i, s, AXES + 3] + cz * solids[i, s, AXES + 6]
        y = my + cx * solids[i, s, AXES + 1] + cy * solids[i, s, AXES + 4] + cz * solids[i, s, AXES + 7]
        z = mz + cx * solids[i, s, AXES + 2] + cy * solids[i, s, AXES + 5] + cz * solids[i, s, AXES + 8]
        right = sight[RIGHT] * x + sight[RIGHT + 1] * y + sight[RIGHT + 2] * z
        up = sight[UP] * x + sight[UP + 1] * y + sight[UP + 2] * z
        depth = sight[FORWARD] * x + sight[FORWARD + 1] * y + sight[FORWARD + 2] * z
        closest, farthest = depth - radius, depth + radius
        if sight[PERSPECTIVE] == 0:
            closest, farthest = 1.0, 1.0
        elif closest <= sight[NEAR]:
            # it reaches behind the near plane: anywhere in the picture
            whole = True
            break
        low, high = right - radius, right + radius
        first, last = min(first, min(low / closest, low / farthest)), max(last, max(high / closest, high / farthest))
        low, high = up - radius, up + radius
        upper, lower = min(upper, min(-high / closest, -high / farthest)), max(lower, max(-low / closest, -low / farthest))
    first_column, last_column, first_row, last_row = 0, width - 1, 0, height - 1
    if not whole:
        first, last = sight[HALF_WIDTH] + sight[SCALE] * first, sight[HALF_WIDTH] + sight[SCALE] * last
        upper, lower = sight[HALF_HEIGHT] + sight[SCALE] * upper, sight[HALF_HEIGHT] + sight[SCALE] * lower
        if not (last > 0 and first < width and lower > 0 and upper < height):
            return
        first_column, last_column = int(max(first, 0.0)), int(min(last, width - 1.0))
        first_row, last_row = int(max(upper, 0.0)), int(min(lower, height - 1.0))
    for r in range(first_row, last_row + 1):
        for c in range(first_column, last_column + 1):
            ox, oy, oz, dx, dy, dz = ray_of(sight, r, c)
            # the ray in the solid's own axes
            ox, oy, oz = ox - solids[i, s, 0], oy - solids[i, s, 1], oz - solids[i, s, 2]
            px, qx = turned_to(solids, i, s, 0, ox, oy, oz), turned_to(solids, i, s, 0, dx, dy, dz)
            py, qy = turned_to(solids, i, s, 1, ox, oy, oz), turned_to(solids, i, s, 1, dx, dy, dz)
            pz, qz = turned_to(solids, i, s, 2, ox, oy, oz), turned_to(solids, i, s, 2, dx, dy, dz)
            if bx == 0 and by == 0:
                t, nx, ny, nz = meet_capsule(px, py, pz, qx, qy, qz, bz, radius)
            else:
                t, nx, ny, nz = meet_box(px, py, pz, qx, qy, qz, bx + radius, by + radius, bz + radius)
            if not t < np.inf:
                continue
            shade = 0.0
            if colored:
                # the normal back in the world's axes
                x = nx * solids[i, s, AXES] + ny * solids[i, s, AXES + 3] + nz * solids[i, s, AXES + 6]
                y = nx * solids[i, s, AXES + 1] + ny * solids[i, s, AXES + 4] + nz * solids[i, s, AXES + 7]
                z = nx * solids[i, s, AXES + 2] + ny * solids[i, s, AXES + 5] + nz * solids[i, s, AXES + 8]
                shade = lambert(x, y, z)
            show(t, shade, colored, solids, i, s, sight, r, c, near, what, color)


@inlined
def turned_to(solids, i, s, axis, x, y, z):
    """A vector's component along an axis of a solid."""
    at = AXES + 3 * axis
    return x * solids[i, s, at] + y * solids[i, s, at + 1] + z * solids[i, s, at + 2]


@inlined
def ray_of(sight, r, c):
    """The ray of a pixel: where it begins [m], and its direction, of length 1 along the view axis."""
    across, up = (c + 0.5 - sight[HALF_WIDTH]) / sight[SCALE], (sight[HALF_HEIGHT] - r - 0.5) / sight[SCALE]
    sx, sy, sz = (
        across * sight[RIGHT] + up * sight[UP],
        across * sight[RIGHT + 1] + up * sight[UP + 1],
        across * sight[RIGHT + 2] + up * sight[UP + 2],
    )
    if sight[PERSPECTIVE] > 0:
        return sight[0], sight[1], sight[2], sight[FORWARD] + sx, sight[FORWARD + 1] + sy, sight[FORWARD + 2] + sz
    return sight[0] + sx, sight[1] + sy, sight[2] + sz, sight[FORWARD], sight[FORWARD + 1], sight[FORWARD + 2]


@kernel
def meet_box(px, py, pz, qx, qy, qz, bx, by, bz):
    """Where the ray p + t q enters the box of half sides b, and the normal there; infinity if it does not (Kay and Kajiya 1986).

    Between each pair of faces it is from one t to another: it is in the box from the last of the former to the first of the latter.
    """
    enter, leave = -np.inf, np.inf
    nx = ny = nz = 0.0
    for axis in range(3):
        p, q, b = (px, qx, bx) if axis == 0 else (py, qy, by) if axis == 1 else (pz, qz, bz)
        if q == 0:
            if abs(p) > b:
                return np.inf, 0.0, 0.0, 0.0
            continue
        side = -1.0 if q > 0 else 1.0
        begins, ends = (side * b - p) / q, (-side * b - p) / q
        if begins > enter:
            enter = begins
            nx, ny, nz = side if axis == 0 else 0.0, side if axis == 1 else 0.0, side if axis == 2 else 0.0
        leave = min(leave, ends)
    if enter > leave:
        return np.inf, 0.0, 0.0, 0.0
    return enter, nx, ny, nz


@kernel
def meet_capsule(px, py, pz, qx, qy, qz, half, radius):
    """The same for a capsule along z, whose ball's middle goes from -half to half; a sphere if that is 0.

    On the cylinder |p + t q|^2 = r^2 without the z components, where |z| <= half; on a ball |p + t q - c|^2 = r^2.
    """
    t, nx, ny, nz = np.inf, 0.0, 0.0, 0.0
    # the cylinder
    a, b = qx * qx + qy * qy, px * qx + py * qy
    square = b * b - a * (px * px + py * py - radius * radius)
    if half > 0 and a > 0 and square >= 0:
        found = (-b - np.sqrt(square)) / a
        if abs(pz + found * qz) <= half:
            t, nx, ny = found, px + found * qx, py + found * qy
    # the balls at its ends
    a, b = a + qz * qz, b + pz * qz
    for end in range(2 if half > 0 else 1):
        z = pz - (half if end == 0 else -half)
        along = px * qx + py * qy + z * qz
        square = along * along - a * (px * px + py * py + z * z - radius * radius)
        if square >= 0:
            found = (-along - np.sqrt(square)) / a
            if found < t:
                t, nx, ny, nz = found, px + found * qx, py + found * qy, z + found * qz
    return t, nx, ny, nz


@inlined
def show(t, shade, colored, solids, i, s, sight, r, c, near, what, color):
    """Draw a solid's point at t of the pixel's ray, if nothing is nearer."""
    if sight[PERSPECTIVE] > 0:
        if not t > sight[NEAR]:
            return
        n = np.float32(1 / t)
    else:
        n = np.float32(-t)
    if n > near[r, c]:
        near[r, c] = n
        what[r, c] = 2
        if colored:
            for k in range(3):
                color[r, c, k] = np.uint8(shade * solids[i, s, COLOR + k])

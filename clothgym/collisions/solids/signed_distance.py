"""Signed distance to one solid and its outward normal, in lanes.

A solid is described by rows of numbers, one value for each lane (``shapes``), and a mesh also by a distance grid that all lanes
share (``distance_grid``).

The kernels work in a scratch array, (SCRATCH_ROWS, lanes), which starts with a copy of the solid's rows, followed by points,
normals and other intermediate results.  Loops over rows of one array are vectorized; over rows of many arrays LLVM would have to
test too many pairs for overlap at run time, and gives up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel
from clothgym.collisions.solids.shapes import (
    COLLIDER_ROWS,
    KIND_PLANE,
    KIND_ROUNDED_BOX,
    R_AXES,
    R_HALF,
    R_POINT,
    R_RADIUS,
)

# rows of the scratch after those of the solid: a triangle's corners, a point, and a point of the solid's core, all in its axes;
# barycentric weights; signed distance and normal of contact; depth of the core; whether the direction from the core is the normal
# of contact, and its length; whether the lane is clear, that is surely without contact; and the point before the last two rounds
# of a search
S_CORNERS, S_SPOT, S_CORE, S_WEIGHTS = COLLIDER_ROWS, COLLIDER_ROWS + 9, COLLIDER_ROWS + 12, COLLIDER_ROWS + 15
S_CONTACT, S_RHO, S_USABLE, S_LENGTH, S_CLEAR = (
    COLLIDER_ROWS + 18,
    COLLIDER_ROWS + 22,
    COLLIDER_ROWS + 23,
    COLLIDER_ROWS + 24,
    COLLIDER_ROWS + 25,
)
S_BEFORE, S_BETWEEN = COLLIDER_ROWS + 26, COLLIDER_ROWS + 29
SCRATCH_ROWS = COLLIDER_ROWS + 32

LEAST_GRADIENT = 1e-3  # length below which the grid's gradient has no reliable direction


class Shapes(NamedTuple):
    """What kernels read of the colliders besides their rows.

    kinds: of each, (colliders,): KIND_PLANE, KIND_ROUNDED_BOX or KIND_MESH, see ``Collider.known_kind``.
    nodes: distance [m] and gradient at the nodes of all grids, (nodes, 4); first: index of each grid's first node, (colliders,).
    sizes: nodes of each grid along x, y and z, (colliders, 3); corners: its lowest corner in the solid's axes [m], (colliders, 3).
    cells: its spacing [m], (colliders,).
    """

    kinds: NDArray
    nodes: NDArray
    first: NDArray
    sizes: NDArray
    corners: NDArray
    cells: NDArray


@kernel
def lay_out(collider, scratch):
    """Copy a solid's rows, (rows, lanes), to the scratch, those of a single lane to all columns; mark all lanes as not clear."""
    last = collider.shape[1] - 1
    for r in range(collider.shape[0]):
        for l in range(scratch.shape[1]):
            scratch[r, l] = collider[r, min(l, last)]
    for l in range(scratch.shape[1]):
        scratch[S_CLEAR, l] = 0


@inlined
def to_axes(x, p, scratch, at):
    """Write particle p of x, (3, particles, lanes) [m], in the solid's axes to three rows of the scratch from ``at`` on."""
    for c in range(3):
        for l in range(scratch.shape[1]):
            scratch[at + c, l] = x[c, p, l] - scratch[R_POINT + c, l]
    for l in range(scratch.shape[1]):
        dx, dy, dz = scratch[at, l], scratch[at + 1, l], scratch[at + 2, l]
        scratch[at, l] = dx * scratch[R_AXES, l] + dy * scratch[R_AXES + 1, l] + dz * scratch[R_AXES + 2, l]
        scratch[at + 1, l] = dx * scratch[R_AXES + 3, l] + dy * scratch[R_AXES + 4, l] + dz * scratch[R_AXES + 5, l]
        scratch[at + 2, l] = dx * scratch[R_AXES + 6, l] + dy * scratch[R_AXES + 7, l] + dz * scratch[R_AXES + 8, l]


@inlined
def normal_to_world(scratch):
    """Rotate the normal in S_CONTACT from the solid's axes to the world's."""
    for l in range(scratch.shape[1]):
        nx, ny, nz = scratch[S_CONTACT + 1, l], scratch[S_CONTACT + 2, l], scratch[S_CONTACT + 3, l]
        scratch[S_CONTACT + 1, l] = nx * scratch[R_AXES, l] + ny * scratch[R_AXES + 3, l] + nz * scratch[R_AXES + 6, l]
        scratch[S_CONTACT + 2, l] = nx * scratch[R_AXES + 1, l] + ny * scratch[R_AXES + 4, l] + nz * scratch[R_AXES + 7, l]
        scratch[S_CONTACT + 3, l] = nx * scratch[R_AXES + 2, l] + ny * scratch[R_AXES + 5, l] + nz * scratch[R_AXES + 8, l]


@kernel
def measure(scratch, at, shapes, k, within):
    """Signed distance [m] and outward unit normal, in the solid's axes, of the point in three rows of the scratch from ``at`` on,
    to S_CONTACT.

    A mesh leaves out the normal where the distance is not below ``within`` [m], and skips lanes that are clear.
    """
    kind = shapes.kinds[k]
    if kind == KIND_PLANE:
        measure_plane(scratch, at, shapes, k, within)
    elif kind == KIND_ROUNDED_BOX:
        measure_rounded_box(scratch, at, shapes, k, within)
    else:
        measure_mesh(scratch, at, shapes, k, within)


@inlined
def measure_plane(scratch, at, shapes, k, within):
    """``measure`` at a plane: the height above it."""
    for l in range(scratch.shape[1]):
        scratch[S_CONTACT, l] = scratch[at + 2, l] - scratch[R_RADIUS, l]
        scratch[S_CONTACT + 1, l] = 0
        scratch[S_CONTACT + 2, l] = 0
        scratch[S_CONTACT + 3, l] = 1


@inlined
def measure_mesh(scratch, at, shapes, k, within):
    """``measure`` at a mesh, by its grid."""
    _, nodes, first, sizes, corners, cells = shapes
    _measure_in_grid(scratch, at, nodes[first[k] :], sizes[k], corners[k], cells[k], within)


@inlined
def rounded_box(qx, qy, qz, hx, hy, hz, radius, zero, one):
    """Signed distance [m] and outward normal of a point q at a rounded box with half sides h and radius r.

    With a = |q| - h, the distance is ``|max(a, 0)| - r`` outside the inner box and ``max(a) - r`` inside it.
    """
    # distances to the faces of the inner box
    ax, ay, az = abs(qx) - hx, abs(qy) - hy, abs(qz) - hz
    ox, oy, oz = max(ax, zero), max(ay, zero), max(az, zero)
    outside = np.sqrt(ox * ox + oy * oy + oz * oz)
    deepest = max(ax, max(ay, az))
    beyond = outside > zero
    scale = one / outside if beyond else one
    # inside, the normal is that of the closest face; outside, it points from the closest point
    fx = one if ax >= deepest else zero
    fy = one if (ay >= deepest and ax < deepest) else zero
    fz = one - fx - fy
    nx = (ox * scale if beyond else fx) * (one if qx >= zero else -one)
    ny = (oy * scale if beyond else fy) * (one if qy >= zero else -one)
    nz = (oz * scale if beyond else fz) * (one if qz >= zero else -one)
    return (outside if beyond else deepest) - radius, nx, ny, nz


@inlined
def measure_rounded_box(scratch, at, shapes, k, within):
    """``measure`` at a rounded box."""
    zero, one = scratch.dtype.type(0), scratch.dtype.type(1)
    for l in range(scratch.shape[1]):
        hx, hy, hz, radius = scratch[R_HALF, l], scratch[R_HALF + 1, l], scratch[R_HALF + 2, l], scratch[R_RADIUS, l]
        distance, nx, ny, nz = rounded_box(scratch[at, l], scratch[at + 1, l], scratch[at + 2, l], hx, hy, hz, radius, zero, one)
        scratch[S_CONTACT, l] = distance
        scratch[S_CONTACT + 1, l] = nx
        scratch[S_CONTACT + 2, l] = ny
        scratch[S_CONTACT + 3, l] = nz


@kernel
def _interpolate(grid, node, ny, nz, tx, ty, tz, c):
    """Trilinear value of column c in the cell above ``node``, at t from 0 to 1; ny, nz: nodes along y and z."""
    low = grid[node, c] + tz * (grid[node + 1, c] - grid[node, c])
    high = grid[node + nz, c] + tz * (grid[node + nz + 1, c] - grid[node + nz, c])
    near = low + ty * (high - low)
    far = node + ny * nz
    low = grid[far, c] + tz * (grid[far + 1, c] - grid[far, c])
    high = grid[far + nz, c] + tz * (grid[far + nz + 1, c] - grid[far + nz, c])
    return near + tx * ((low + ty * (high - low)) - near)


@kernel
def _measure_in_grid(scratch, at, grid, size, corner, cell, within):
    """Trilinear distance and, where that is below ``within``, normalized gradient, to S_CONTACT; lanes that are clear are skipped.

    Outside the grid, with c its closest point, ``sqrt(d(c)^2 + |q - c|^2)``.  That is never more than the distance: the angle at c
    between q and the surface is at least a right angle.
    """
    zero, one, faint = scratch.dtype.type(0), scratch.dtype.type(1), scratch.dtype.type(LEAST_GRADIENT)
    nx, ny, nz = size[0], size[1], size[2]
    last_x, last_y, last_z = scratch.dtype.type(nx - 1), scratch.dtype.type(ny - 1), scratch.dtype.type(nz - 1)
    per_cell = one / cell
    for l in range(scratch.shape[1]):
        if scratch[S_CLEAR, l] != zero:
            continue
        # the point in cells from the corner
        gx, gy = (scratch[at, l] - corner[0]) * per_cell, (scratch[at + 1, l] - corner[1]) * per_cell
        gz = (scratch[at + 2, l] - corner[2]) * per_cell
        # its closest point in the grid; NaN becomes zero
        cx, cy, cz = gx if gx > zero else zero, gy if gy > zero else zero, gz if gz > zero else zero
        cx, cy, cz = cx if cx < last_x else last_x, cy if cy < last_y else last_y, cz if cz < last_z else last_z
        # the cell, and the position within it
        i, j, k = min(int(cx), nx - 2), min(int(cy), ny - 2), min(int(cz), nz - 2)
        tx, ty, tz = cx - scratch.dtype.type(i), cy - scratch.dtype.type(j), cz - scratch.dtype.type(k)
        node = (i * ny + j) * nz + k
        # the distance, and what lies outside the grid
        distance = _interpolate(grid, node, ny, nz, tx, ty, tz, 0)
        dx, dy, dz = (gx - cx) * cell, (gy - cy) * cell, (gz - cz) * cell
        beyond = dx * dx + dy * dy + dz * dz
        if beyond > zero:
            inner = max(distance, zero)
            distance = np.sqrt(inner * inner + beyond)
        scratch[S_CONTACT, l] = distance - scratch[R_RADIUS, l]
        # the normal
        ux, uy, uz = zero, zero, one
        if scratch[S_CONTACT, l] < within:
            ux = _interpolate(grid, node, ny, nz, tx, ty, tz, 1)
            uy = _interpolate(grid, node, ny, nz, tx, ty, tz, 2)
            uz = _interpolate(grid, node, ny, nz, tx, ty, tz, 3)
            if beyond > zero:
                ux, uy, uz = inner * ux + dx, inner * uy + dy, inner * uz + dz
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            scale = one / length if length > faint else zero
            ux, uy, uz = ux * scale, uy * scale, uz * scale if length > faint else one
        scratch[S_CONTACT + 1, l] = ux
        scratch[S_CONTACT + 2, l] = uy
        scratch[S_CONTACT + 3, l] = uz


@kernel
def measure_in_world(x, p, scratch, shapes, k):
    """Signed distance [m] of particle p to S_CONTACT, and its outward unit normal in the world where it is negative."""
    to_axes(x, p, scratch, S_SPOT)
    measure(scratch, S_SPOT, shapes, k, x.dtype.type(0))
    normal_to_world(scratch)

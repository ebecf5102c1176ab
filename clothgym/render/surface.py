"""The cloth as it is drawn: a grid of particles refined to a smooth surface, with its normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel


@dataclass(frozen=True, eq=False)
class Surface:
    """The parts of a drawn surface that do not change from frame to frame.

    Attributes:
        index: particles of which a drawn vertex is a mean, (vertices, k) int32.
        weight: their weights, which sum to 1, (vertices, k) float32.
        triangles: (triangles, 3) int32.
        uv: material coordinates of the vertices [m], (vertices, 2) float32.
        cell: side of a drawn cell where the surface is refined [m]; 0 where triangles are drawn as they are.
    """

    index: NDArray[np.int32]
    weight: NDArray[np.float32]
    triangles: NDArray[np.int32]
    uv: NDArray[np.float32]
    cell: float = 0.0


def plain_surface(triangles: NDArray[np.int32], uv: NDArray[np.float32]) -> Surface:
    """The triangles of the mesh, unrefined."""
    particles = len(uv)
    return Surface(np.arange(particles, dtype=np.int32)[:, None], np.ones((particles, 1), np.float32), triangles, uv)


def smooth_surface(triangles: NDArray[np.int32], uv: NDArray[np.float32], grid_shape: tuple[int, int], cells: int) -> Surface:
    """A grid of particles (row by row) as a bicubic Catmull-Rom surface with at least ``cells`` cells along its longer side."""
    rows, cols = grid_shape
    factor = max(1, -(-cells // (max(rows, cols) - 1)))
    row_index, row_weight = _catmull_rom(rows, factor)
    col_index, col_weight = _catmull_rom(cols, factor)
    index = (row_index[:, None, :, None] * cols + col_index[None, :, None, :]).reshape(-1, 16).astype(np.int32)
    weight = (row_weight[:, None, :, None] * col_weight[None, :, None, :]).reshape(-1, 16).astype(np.float32)

    fine = np.arange(len(index)).reshape(len(row_index), len(col_index))
    a, b, c, d = (q.ravel() for q in (fine[:-1, :-1], fine[:-1, 1:], fine[1:, :-1], fine[1:, 1:]))
    quads = np.stack([np.stack([a, b, d], 1), np.stack([a, d, c], 1)], axis=1).reshape(-1, 3).astype(np.int32)
    # the given triangles define the front: these are counter-clockwise with columns along x and rows along y
    (r0, c0), (r1, c1), (r2, c2) = (divmod(int(corner), cols) for corner in triangles[0])
    if (c1 - c0) * (r2 - r0) < (c2 - c0) * (r1 - r0):
        quads = np.ascontiguousarray(quads[:, ::-1])
    fine_uv = np.einsum("vk,vkc->vc", weight, uv[index]).astype(np.float32)
    return Surface(index, weight, quads, fine_uv, float(np.linalg.norm(fine_uv[1] - fine_uv[0])))


def _catmull_rom(count: int, factor: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Four points and their weights for each point of a line refined ``factor`` times, two (points, 4).

    Catmull and Rom 1974; the line continues straight beyond its ends, so that flat stays flat.
    """
    place = np.arange((count - 1) * factor + 1)
    cell = np.minimum(place // factor, count - 2)
    t = place / factor - cell
    weights = np.stack([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2], axis=1) / 2
    index = cell[:, None] + np.arange(-1, 3)
    first, last = index[:, 0] < 0, index[:, 3] >= count
    # p[-1] = 2 p[0] - p[1] and its mirror image at the other end
    weights[first, 1] += 2 * weights[first, 0]
    weights[first, 2] -= weights[first, 0]
    weights[first, 0] = 0
    weights[last, 2] += 2 * weights[last, 3]
    weights[last, 1] -= weights[last, 3]
    weights[last, 3] = 0
    return np.clip(index, 0, count - 1), weights


@kernel
def place_vertices(x, index, weight, out):
    """Vertices [m], (vertices, 3), from particles ``x`` [m], (particles, 3)."""
    for v in range(index.shape[0]):
        sx = np.float32(0)
        sy = np.float32(0)
        sz = np.float32(0)
        for k in range(index.shape[1]):
            p = index[v, k]
            w = weight[v, k]
            sx += w * x[p, 0]
            sy += w * x[p, 1]
            sz += w * x[p, 2]
        out[v, 0] = sx
        out[v, 1] = sy
        out[v, 2] = sz


@kernel
def push_out(x, num_cloth, center, cos_yaw, sin_yaw, half, radius, lift, deepest):
    """Lift the first ``num_cloth`` vertices ``x`` [m], (vertices, 3), that lie in a solid to ``lift`` [m] above its surface.

    Particles rest on a solid, but straight cloth between them, and a drawn cell, cut off its edges.  A vertex deeper than
    ``deepest`` [m] stays: there the cloth is really inside.  The solid is a box of half sides ``half`` [m] swept
    by a ball of ``radius`` [m].
    """
    for v in range(num_cloth):
        dx, dy, dz = x[v, 0] - center[0], x[v, 1] - center[1], x[v, 2] - center[2]
        px, py = cos_yaw * dx + sin_yaw * dy, cos_yaw * dy - sin_yaw * dx
        # from the nearest point of the box to the vertex
        qx = px - min(max(px, -half[0]), half[0])
        qy = py - min(max(py, -half[1]), half[1])
        qz = dz - min(max(dz, -half[2]), half[2])
        length = np.sqrt(qx * qx + qy * qy + qz * qz)
        distance = length - radius
        if length == 0:
            # inside the box itself: out through the nearest face
            gx, gy, gz = half[0] - abs(px), half[1] - abs(py), half[2] - abs(dz)
            distance = -min(gx, gy, gz) - radius
            if gz <= gx and gz <= gy:
                qz = 1.0 if dz > 0 else -1.0
            elif gx <= gy:
                qx = 1.0 if px > 0 else -1.0
            else:
                qy = 1.0 if py > 0 else -1.0
            length = 1.0
        if -deepest < distance < lift:
            way = (lift - distance) / length
            x[v, 0] += way * (cos_yaw * qx - sin_yaw * qy)
            x[v, 1] += way * (sin_yaw * qx + cos_yaw * qy)
            x[v, 2] += way * qz


@kernel
def vertex_normals(x, triangles, out):
    """Unit normals, (vertices, 3): the mean over triangles, weighted by area."""
    out[:] = 0
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        bx, by, bz = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            out[v, 0] += nx
            out[v, 1] += ny
            out[v, 2] += nz
    for v in range(out.shape[0]):
        length = np.sqrt(out[v, 0] * out[v, 0] + out[v, 1] * out[v, 1] + out[v, 2] * out[v, 2])
        if length > 0:
            for c in range(3):
                out[v, c] /= length
        else:
            out[v, 2] = 1  # a collapsed patch has no normal


@kernel
def vertex_curvature(x, normals, triangles, out):
    """Mean curvature [1/m], (vertices,), positive where the neighbors lie above the tangent plane: in a hollow of the front.

    A neighbor at e lies H |e|^2 / 2 above the plane; H is the mean over edges, weighted by |e|^2.
    """
    squares = np.zeros(len(out), np.float32)
    out[:] = 0
    for t in range(triangles.shape[0]):
        for corner in range(3):
            i, j = triangles[t, corner], triangles[t, (corner + 1) % 3]
            ex, ey, ez = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            square = ex * ex + ey * ey + ez * ez
            out[i] += 2 * (ex * normals[i, 0] + ey * normals[i, 1] + ez * normals[i, 2])
            out[j] -= 2 * (ex * normals[j, 0] + ey * normals[j, 1] + ez * normals[j, 2])
            squares[i] += square
            squares[j] += square
    for v in range(len(out)):
        out[v] = out[v] / squares[v] if squares[v] > 0 else 0

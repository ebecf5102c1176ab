"""From triangles to samples: projections and the z-buffer.

Image positions are rounded to 1/256 pixel and edge functions are integers (Pineda 1988), so that neighbors with a common edge leave
no gap.  Nearness is linear on the image along a triangle: the inverse depth in a perspective view, the height along the light in an
orthographic one.  The larger nearness wins.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel

SUBPIXEL_BITS = 8
SUBPIXEL = 1 << SUBPIXEL_BITS
HALF_PIXEL = SUBPIXEL >> 1
FARTHEST_PIXEL = 1e6  # a vertex beyond it, or with a NaN coordinate, is not drawn
NOT_DRAWN = -(1 << 31)


@kernel
def _snap(pixel_x, pixel_y, screen, v):
    # not (... < ...) also holds for NaN
    """Round an image position to 1/256 pixel, or mark the vertex as not drawn."""
    if not (abs(pixel_x) < FARTHEST_PIXEL and abs(pixel_y) < FARTHEST_PIXEL):
        screen[v, 0] = NOT_DRAWN
        return
    screen[v, 0] = np.int32(np.floor(pixel_x * SUBPIXEL + 0.5))
    screen[v, 1] = np.int32(np.floor(pixel_y * SUBPIXEL + 0.5))


@kernel
def project_perspective(x, axes, eye, scale, width, height, near, num_cloth, bias, screen, inverse_depth, nearness):
    """Project vertices ``x`` [m], (vertices, 3), onto an image of width x height pixels.

    Writes screen: position [1/256 pixel], (vertices, 2) int32; inverse_depth [1/m] and nearness [1/m], (vertices,).  The
    first ``num_cloth`` vertices are cloth: for the z-buffer alone they are moved closer by ``bias`` [m], so that a solid does
    not show through between the particles that rest on it.  A triangle with a vertex in front of the near plane is not drawn.
    """
    for v in range(x.shape[0]):
        dx, dy, dz = x[v, 0] - eye[0], x[v, 1] - eye[1], x[v, 2] - eye[2]
        depth = axes[2][0] * dx + axes[2][1] * dy + axes[2][2] * dz
        if not depth > near:
            screen[v, 0] = NOT_DRAWN
            continue
        right = axes[0][0] * dx + axes[0][1] * dy + axes[0][2] * dz
        up = axes[1][0] * dx + axes[1][1] * dy + axes[1][2] * dz
        inverse_depth[v] = 1 / depth
        nearness[v] = 1 / max(depth - bias, 0.5 * near) if v < num_cloth else inverse_depth[v]
        _snap(0.5 * width + scale * right / depth, 0.5 * height - scale * up / depth, screen, v)


@kernel
def project_orthographic(x, axes, center, scale, size, num_cloth, bias, screen, nearness):
    """Project vertices ``x`` [m], (vertices, 3), onto a square map of size x size texels, seen from ``axes[2]``.

    scale: texels per meter; ``center`` [m] is projected to the middle.  nearness: height along ``axes[2]`` [m], (vertices,);
    that of the cloth is increased by ``bias`` [m].
    """
    for v in range(x.shape[0]):
        dx, dy, dz = x[v, 0] - center[0], x[v, 1] - center[1], x[v, 2] - center[2]
        right = axes[0][0] * dx + axes[0][1] * dy + axes[0][2] * dz
        up = axes[1][0] * dx + axes[1][1] * dy + axes[1][2] * dz
        nearness[v] = axes[2][0] * dx + axes[2][1] * dy + axes[2][2] * dz
        if v < num_cloth:
            nearness[v] += bias
        _snap(0.5 * size + scale * right, 0.5 * size - scale * up, screen, v)


@kernel
def rasterize(screen, nearness, triangles, num_two_sided, buffer, owner):
    """Draw triangles into ``buffer``: nearness of the nearest surface, and ``owner``: its triangle; both (height, width).

    The first ``num_two_sided`` triangles are drawn from both sides, the others only if their front (counter-clockwise on the
    image) faces the eye.
    """
    height, width = buffer.shape
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x0, y0 = np.int64(screen[i, 0]), np.int64(screen[i, 1])
        x1, y1 = np.int64(screen[j, 0]), np.int64(screen[j, 1])
        x2, y2 = np.int64(screen[k, 0]), np.int64(screen[k, 1])
        if x0 == NOT_DRAWN or x1 == NOT_DRAWN or x2 == NOT_DRAWN:
            continue
        n0, n1, n2 = nearness[i], nearness[j], nearness[k]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0 or (area > 0 and t >= num_two_sided):
            continue  # rows count downwards, so a positive area is clockwise
        if area < 0:
            x1, x2, y1, y2, n1, n2 = x2, x1, y2, y1, n2, n1
            area = -area
        # samples lie in the middle of their pixels
        left = max((min(x0, x1, x2) + HALF_PIXEL - 1) >> SUBPIXEL_BITS, 0)
        right = min((max(x0, x1, x2) - HALF_PIXEL) >> SUBPIXEL_BITS, width - 1)
        top = max((min(y0, y1, y2) + HALF_PIXEL - 1) >> SUBPIXEL_BITS, 0)
        bottom = min((max(y0, y1, y2) - HALF_PIXEL) >> SUBPIXEL_BITS, height - 1)
        if left > right or top > bottom:
            continue
        share = np.float32(1) / np.float32(area)
        px = (left << SUBPIXEL_BITS) + HALF_PIXEL
        py = (top << SUBPIXEL_BITS) + HALF_PIXEL
        # each edge function is zero on one edge and the whole area at the vertex opposite
        row0 = (x2 - x1) * (py - y1) - (y2 - y1) * (px - x1)
        row1 = (x0 - x2) * (py - y2) - (y0 - y2) * (px - x2)
        row2 = (x1 - x0) * (py - y0) - (y1 - y0) * (px - x0)
        for row in range(top, bottom + 1):
            e0, e1, e2 = row0, row1, row2
            for column in range(left, right + 1):
                if (e0 | e1 | e2) >= 0:
                    n = (np.float32(e0) * n0 + np.float32(e1) * n1 + np.float32(e2) * n2) * share
                    if n > buffer[row, column]:
                        buffer[row, column] = n
                        owner[row, column] = t
                e0 -= (y2 - y1) << SUBPIXEL_BITS
                e1 -= (y0 - y2) << SUBPIXEL_BITS
                e2 -= (y1 - y0) << SUBPIXEL_BITS
            row0 += (x2 - x1) << SUBPIXEL_BITS
            row1 += (x0 - x2) << SUBPIXEL_BITS
            row2 += (x1 - x0) << SUBPIXEL_BITS


@kernel
def sample_weights(screen, triangles, inverse_depth, t, px, py):
    """Perspective-correct weights of triangle t's vertices at a sample, the sample's inverse depth [1/m], and whether the triangle
    is seen from its back.

    px, py: the sample [1/256 pixel].
    """
    i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    x0, y0 = np.int64(screen[i, 0]), np.int64(screen[i, 1])
    x1, y1 = np.int64(screen[j, 0]), np.int64(screen[j, 1])
    x2, y2 = np.int64(screen[k, 0]), np.int64(screen[k, 1])
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    e1 = (x0 - x2) * (py - y2) - (y0 - y2) * (px - x2)
    e2 = (x1 - x0) * (py - y0) - (y1 - y0) * (px - x0)
    b1, b2 = e1 / area, e2 / area
    w0, w1, w2 = (1 - b1 - b2) * inverse_depth[i], b1 * inverse_depth[j], b2 * inverse_depth[k]
    total = w0 + w1 + w2
    return w0 / total, w1 / total, w2 / total, total, area > 0


@kernel
def floor_nearness(rays, out):
    """Nearness [1/m], (height, width), of the floor z = 0 wherever a ray meets it, 0 elsewhere: what a picture starts with.

    With rays of length 1 along the view axis it is ``-ray_z / eye_z``, linear on the image.
    """
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            z = rays[1][2] + (column + 0.5) * rays[2][2] + (row + 0.5) * rays[3][2]
            out[row, column] = max(-z / rays[0][2], 0)


@kernel
def depth_image(screen, inverse_depth, triangles, buffer, owner, out):
    """Depth along the view axis [m], (height, width), +inf where nothing is seen; without the cloth's bias."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            n = buffer[row, column]
            t = owner[row, column]
            if t >= 0:
                px = (np.int64(column) << SUBPIXEL_BITS) + HALF_PIXEL
                py = (np.int64(row) << SUBPIXEL_BITS) + HALF_PIXEL
                n = np.float32(sample_weights(screen, triangles, inverse_depth, t, px, py)[3])
            out[row, column] = 1 / n if n > 0 else np.inf

"""Whether a sheet is spread out: then no part of it is near another, and a query has nothing to look for.

Let f map the flat sheet at rest, a convex region of the plane, to where it is now, with the constant gradient F_t on triangle t.
Let Q be a 3 x 2 matrix with orthonormal columns, and lambda the smallest eigenvalue of the symmetric parts of all Q^T F_t.  The
segment between two points a and b of the flat sheet stays in the sheet, so that

    |f(a) - f(b)| |a - b| >= (f(a) - f(b)) . Q (a - b) = integral of (a - b)^T F^T Q (a - b) ds >= lambda |a - b|^2

along it: what is apart by d at rest is apart by at least lambda d.  (A map whose derivative is positive definite on a convex region
is one-to-one.)  Q is the isometry nearest to the mean of F, from its polar decomposition.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import disjoint, kernel, uncounted
from clothgym.mesh import ClothMesh

CONVEX = 1e-6  # share of the convex hull's area by which a sheet's may differ
SPREAD = 1e-6  # lambda from which rounding makes no sheet look spread out that is not


def to_rest(mesh: ClothMesh) -> NDArray[np.float64]:
    """What ``least_stretch`` reads of a mesh: the inverse of each triangle's edges at rest, row by row [1/m], (triangles, 4).

    Of a sheet that is not flat, not convex or overlaps itself at rest: (0, 4).
    """
    from scipy.spatial import ConvexHull  # takes long to import

    x, triangles = mesh.rest_positions.astype(np.float64), mesh.triangles
    edges = np.stack([x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]], axis=2)
    doubled = np.linalg.det(edges[:, :2])
    flat = np.ptp(x[:, 2]) == 0 and np.all(doubled * doubled[0] > 0)
    if not flat:
        return np.empty((0, 4))
    # triangles of one orientation that are as large as their convex hull fill it without overlap
    hull = ConvexHull(x[np.unique(triangles), :2]).volume
    if abs(abs(doubled).sum() / 2 - hull) > CONVEX * hull:
        return np.empty((0, 4))
    return np.ascontiguousarray(np.linalg.inv(edges[:, :2]).reshape(-1, 4))


@disjoint
def _gradients(p, triangles, inverses, xx, xy, xz, yx, yy, yz):
    """Gradients of the map from rest, row by row: along x and along y, (triangles,) each."""
    for t in range(xx.shape[0]):
        # as unsigned numbers, which can not count from the end
        i, j, k = np.uint64(triangles[t, 0]), np.uint64(triangles[t, 1]), np.uint64(triangles[t, 2])
        a, b, c, d = inverses[t, 0], inverses[t, 1], inverses[t, 2], inverses[t, 3]
        ux, uy, uz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        wx, wy, wz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
        xx[t], xy[t], xz[t] = ux * a + wx * c, uy * a + wy * c, uz * a + wz * c
        yx[t], yy[t], yz[t] = ux * b + wx * d, uy * b + wy * d, uz * b + wz * d


@disjoint
def _smallest(gradients, ux, uy, uz, vx, vy, vz, smallest):
    """The smaller eigenvalue of the symmetric part of Q^T F of each triangle, with the columns u and v of Q."""
    for t in range(smallest.shape[0]):
        a = ux * gradients[0, t] + uy * gradients[1, t] + uz * gradients[2, t]
        b = vx * gradients[3, t] + vy * gradients[4, t] + vz * gradients[5, t]
        c = vx * gradients[0, t] + vy * gradients[1, t] + vz * gradients[2, t]
        d = ux * gradients[3, t] + uy * gradients[4, t] + uz * gradients[5, t]
        smallest[t] = 0.5 * ((a + b) - np.sqrt((a - b) * (a - b) + (c + d) * (c + d)))


@uncounted
def least_stretch(p, triangles, inverses, gradients, smallest):
    """The lambda of a sheet, see above, or 0 where it is less or there is none; inverses: see ``to_rest``.

    p: positions [m], (particles, 3).  gradients, smallest: scratch, (6, triangles), (triangles,).
    """
    count = inverses.shape[0]
    if count == 0:
        return 0.0
    # the gradients, and their sum
    _gradients(p, triangles, inverses, gradients[0], gradients[1], gradients[2], gradients[3], gradients[4], gradients[5])
    ax, ay, az, bx, by, bz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(count):
        ax, ay, az = ax + gradients[0, t], ay + gradients[1, t], az + gradients[2, t]
        bx, by, bz = bx + gradients[3, t], by + gradients[4, t], bz + gradients[5, t]
    # its polar decomposition M = Q H, H = (S + sqrt(det S) I) / sqrt(tr S + 2 sqrt(det S)) with S = M^T M
    xx = ax * ax + ay * ay + az * az
    yy = bx * bx + by * by + bz * bz
    xy = ax * bx + ay * by + az * bz
    determinant = xx * yy - xy * xy
    if not determinant > 0.0:  # without triangles, or not finite
        return 0.0
    root = np.sqrt(determinant)
    scale = 1.0 / np.sqrt(xx + yy + 2.0 * root)
    hx, hy, hxy = (xx + root) * scale / root, (yy + root) * scale / root, xy * scale / root
    ux, uy, uz = ax * hy - bx * hxy, ay * hy - by * hxy, az * hy - bz * hxy
    vx, vy, vz = bx * hx - ax * hxy, by * hx - ay * hxy, bz * hx - az * hxy
    # the smallest eigenvalue of each symmetric part
    _smallest(gradients, ux, uy, uz, vx, vy, vz, smallest)
    least = np.inf
    for t in range(count):
        least = min(least, smallest[t])
    return max(least, 0.0)


@kernel
def spread_out(x, triangles, inverses):
    """Whether each sheet is spread out, and so free of intersections, (num_envs,); x: positions [m], (num_envs, particles, 3)."""
    out, gradients, smallest = np.zeros(x.shape[0], np.bool_), np.empty((6, triangles.shape[0])), np.empty(inverses.shape[0])
    for e in range(x.shape[0]):
        out[e] = least_stretch(x[e], triangles, inverses, gradients, smallest) > SPREAD
    return out

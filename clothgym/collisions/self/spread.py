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

from clothgym._jit import apart, kernel
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


@apart
def least_stretch(p, triangles, inverses):
    """The lambda of a sheet, see above, or 0 where it is less or there is none; inverses: see ``to_rest``.

    p: positions [m], (particles, 3).
    """
    count = inverses.shape[0]
    # the gradients, and their sum
    gradients, total = np.empty((6, count)), np.zeros(6)
    for t in range(count):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        for c in range(3):
            one, two = p[j, c] - p[i, c], p[k, c] - p[i, c]
            along_x, along_y = one * inverses[t, 0] + two * inverses[t, 2], one * inverses[t, 1] + two * inverses[t, 3]
            gradients[c, t], gradients[3 + c, t] = along_x, along_y
            total[c] += along_x
            total[3 + c] += along_y
    # its polar decomposition M = Q H, H = (S + sqrt(det S) I) / sqrt(tr S + 2 sqrt(det S)) with S = M^T M
    xx = total[0] * total[0] + total[1] * total[1] + total[2] * total[2]
    yy = total[3] * total[3] + total[4] * total[4] + total[5] * total[5]
    xy = total[0] * total[3] + total[1] * total[4] + total[2] * total[5]
    determinant = xx * yy - xy * xy
    if not determinant > 0.0:  # without triangles, or not finite
        return 0.0
    root = np.sqrt(determinant)
    scale = 1.0 / np.sqrt(xx + yy + 2.0 * root)
    hx, hy, hxy = (xx + root) * scale / root, (yy + root) * scale / root, xy * scale / root
    ux, uy, uz = total[0] * hy - total[3] * hxy, total[1] * hy - total[4] * hxy, total[2] * hy - total[5] * hxy
    vx, vy, vz = total[3] * hx - total[0] * hxy, total[4] * hx - total[1] * hxy, total[5] * hx - total[2] * hxy
    # the smallest eigenvalue of each symmetric part, a loop of its own so that the roots are vectorized
    smallest = np.empty(count)
    for t in range(count):
        a = ux * gradients[0, t] + uy * gradients[1, t] + uz * gradients[2, t]
        b = vx * gradients[3, t] + vy * gradients[4, t] + vz * gradients[5, t]
        c = vx * gradients[0, t] + vy * gradients[1, t] + vz * gradients[2, t]
        d = ux * gradients[3, t] + uy * gradients[4, t] + uz * gradients[5, t]
        smallest[t] = 0.5 * ((a + b) - np.sqrt((a - b) * (a - b) + (c + d) * (c + d)))
    least = np.inf
    for t in range(count):
        least = min(least, smallest[t])
    return max(least, 0.0)


@kernel
def spread_out(x, triangles, inverses):
    """Whether each sheet is spread out, and so free of intersections, (num_envs,); x: positions [m], (num_envs, particles, 3)."""
    out = np.zeros(x.shape[0], np.bool_)
    for e in range(x.shape[0]):
        out[e] = least_stretch(x[e], triangles, inverses) > SPREAD
    return out

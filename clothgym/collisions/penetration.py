"""How deep the sheet's surface is in the solids, without the thickness that contact keeps; on request only."""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel
from clothgym.collisions.distance import CLEAR, CONTACT, CORE, CORNERS, DESK, SPOT, lay_out, measure, to_axes
from clothgym.collisions.shapes import PLANE, THICKNESS
from clothgym.collisions.surface import find_deepest

FINENESS = 4  # points of a triangle with weights in quarters: 15


@kernel
def deepest(first, last, x, triangles, shapes, colliders, out):
    """Depth of the deepest point of each lane's triangles in any collider [m], at least 0, (blocks, lanes).

    Of the triangle's points with weights in quarters, the deepest is where ``find_deepest`` begins; the deeper of both counts.
    """
    zero = x.dtype.type(0)
    for b in range(first, last):
        desk = np.empty((DESK, x.shape[3]), x.dtype)
        start = np.empty((4, x.shape[3]), x.dtype)
        for k in range(colliders.shape[1]):
            lay_out(colliders[b, k], desk)
            for t in range(triangles.shape[0]):
                for c in range(3):
                    to_axes(x[b], triangles[t, c], desk, CORNERS + 3 * c)
                desk[CLEAR] = 0
                start[:] = x.dtype.type(np.inf)
                for i in range(FINENESS + 1):
                    for j in range(FINENESS + 1 - i):
                        _sample(desk, i, j, shapes, k, start)
                desk[SPOT : SPOT + 3] = start[1:4]
                if shapes.kinds[k] != PLANE and find_deepest(desk, shapes, k):
                    for l in range(x.shape[3]):
                        start[0, l] = min(start[0, l], desk[CONTACT, l])
                for l in range(x.shape[3]):
                    out[b, l] = max(out[b, l], max(-(start[0, l] + desk[THICKNESS, l]), zero))


@kernel
def _sample(desk, i, j, shapes, k, best):
    """Keep the point with weights ``i`` and ``j`` quarters where it is deeper than the best: distance and place, (4, lanes)."""
    u, v = desk.dtype.type(i / FINENESS), desk.dtype.type(j / FINENESS)
    w = desk.dtype.type((FINENESS - i - j) / FINENESS)
    for c in range(3):
        for l in range(desk.shape[1]):
            desk[CORE + c, l] = w * desk[CORNERS + c, l] + u * desk[CORNERS + 3 + c, l] + v * desk[CORNERS + 6 + c, l]
    measure(desk, CORE, shapes, k, desk.dtype.type(0))
    for l in range(desk.shape[1]):
        if desk[CONTACT, l] < best[0, l]:
            best[0, l] = desk[CONTACT, l]
            for c in range(3):
                best[1 + c, l] = desk[CORE + c, l]

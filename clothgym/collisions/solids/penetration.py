"""On request only: how far particles are from the solids, and how deep the sheet's surface lies in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.collisions.solids.deepest_point import find_deepest
from clothgym.collisions.solids.shapes import KIND_PLANE, R_THICKNESS
from clothgym.collisions.solids.signed_distance import (
    S_CLEAR,
    S_CONTACT,
    S_CORE,
    S_CORNERS,
    S_SPOT,
    SCRATCH_ROWS,
    Shapes,
    lay_out,
    measure,
    measure_in_world,
    to_axes,
)
from clothgym.layout import Layout

FINENESS = 4  # parts of a triangle's sides: 15 points with weights in quarters


@kernel
def deepest(first, last, x, triangles, shapes, colliders, out):
    """Depth of the deepest point of each lane's triangles in any collider [m], at least 0: ``out``, (blocks, lanes).

    Of the points of a triangle with weights in quarters, the deepest is where ``find_deepest`` starts.  The deeper of both counts.
    """
    zero = x.dtype.type(0)
    for b in range(first, last):
        scratch = np.empty((SCRATCH_ROWS, x.shape[3]), x.dtype)
        start = np.empty((4, x.shape[3]), x.dtype)
        for k in range(colliders.shape[1]):
            lay_out(colliders[b, k], scratch)
            for t in range(triangles.shape[0]):
                # the triangle in the solid's axes, and the deepest of fifteen points
                for c in range(3):
                    to_axes(x[b], triangles[t, c], scratch, S_CORNERS + 3 * c)
                scratch[S_CLEAR] = 0
                start[:] = x.dtype.type(np.inf)
                for i in range(FINENESS + 1):
                    for j in range(FINENESS + 1 - i):
                        _sample(scratch, i, j, shapes, k, start)
                # from there to the deepest of all; at a plane that is a corner
                scratch[S_SPOT : S_SPOT + 3] = start[1:4]
                if shapes.kinds[k] != KIND_PLANE and find_deepest(scratch, shapes, k):
                    for l in range(x.shape[3]):
                        start[0, l] = min(start[0, l], scratch[S_CONTACT, l])
                # depth below the surface itself
                for l in range(x.shape[3]):
                    out[b, l] = max(out[b, l], max(-(start[0, l] + scratch[R_THICKNESS, l]), zero))


@kernel
def _sample(scratch, i, j, shapes, k, best):
    """Replace ``best``, distance and position, (4, lanes), where the point with weights i, j and the rest in quarters is deeper."""
    u, v = scratch.dtype.type(i / FINENESS), scratch.dtype.type(j / FINENESS)
    w = scratch.dtype.type((FINENESS - i - j) / FINENESS)
    for c in range(3):
        for l in range(scratch.shape[1]):
            scratch[S_CORE + c, l] = (
                w * scratch[S_CORNERS + c, l] + u * scratch[S_CORNERS + 3 + c, l] + v * scratch[S_CORNERS + 6 + c, l]
            )
    measure(scratch, S_CORE, shapes, k, scratch.dtype.type(0))
    for l in range(scratch.shape[1]):
        if scratch[S_CONTACT, l] < best[0, l]:
            best[0, l] = scratch[S_CONTACT, l]
            for c in range(3):
                best[1 + c, l] = scratch[S_CORE + c, l]


@kernel
def signed_distances(first, last, x, shapes, colliders, out):
    """Signed distance of each particle to each collider [m]: ``out``, (blocks, colliders, particles, lanes)."""
    for b in range(first, last):
        scratch = np.empty((SCRATCH_ROWS, x.shape[3]), x.dtype)
        for k in range(colliders.shape[1]):
            lay_out(colliders[b, k], scratch)
            for p in range(x.shape[2]):
                measure_in_world(x[b], p, scratch, shapes, k)
                out[b, k, p] = scratch[S_CONTACT]


class Contacts(NamedTuple):
    """Signed distance of particles to the nearest collider [m], inf without any, and its index, or -1, (num_envs, particles)."""

    distance: NDArray
    collider: NDArray


def contacts(layout: Layout, x: NDArray, shapes: Shapes, colliders: NDArray) -> Contacts:
    """Signed distances of a batch; x, (blocks, 3, particles, lanes) [m], and colliders in blocks."""
    count = colliders.shape[1]
    if not count:
        shape = (layout.num_envs, x.shape[2])
        return Contacts(np.full(shape, np.inf, x.dtype), np.full(shape, -1))
    out = np.empty((layout.blocks, count, x.shape[2], layout.lanes), x.dtype)
    signed_distances(0, layout.blocks, x, shapes, colliders, out)
    distances = layout.to_public(out)
    return Contacts(distances.min(axis=1), distances.argmin(axis=1))

"""Whether a triangle mesh bounds a solid, and error messages for one that does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import finite
from clothgym.geometry.intersections import first_intersection
from clothgym.triangles import corners_of, directed_edges, refuse_degenerate


def checked_solid(vertices: ArrayLike, triangles: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [m], (vertices, 3), and triangles, (triangles, 3), of a closed surface, counter-clockwise seen from outside.

    Raises:
        ValueError: arrays of another shape, a triangle without area, an edge of one triangle only or of more than two, neighbors
            that disagree on which side is out, a surface that is inside out, or one that passes through itself.
    """
    # arrays, areas and edges
    x = finite("vertices", vertices)
    corners = corners_of(x, triangles)
    refuse_degenerate(x, corners)
    _refuse_open(corners)
    # the volume, from tetrahedra between each triangle and the mean vertex (divergence theorem)
    twice = np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]])
    middle = x.mean(axis=0)
    volume = float(np.sum((x[corners[:, 0]] - middle) * twice)) / 6
    if volume < 0:
        raise ValueError(f"the mesh is inside out (its volume is {volume:.3g} m^3): turn all triangles round, triangles[:, ::-1]")
    # intersections
    found = first_intersection(corners, x)
    if found is not None:
        one, other = (f"{t}, {corners[t].tolist()}," for t in found[1:])
        remedy = "join its parts into one surface (a boolean union), or make them colliders of their own"
        raise ValueError(f"the mesh passes through itself: triangles {one} and {other} cross; {remedy}")
    return x, corners


def _refuse_open(corners: NDArray) -> None:
    """Refuse an edge that does not join exactly two triangles with the same side out."""
    # how many triangles each edge has
    directed = directed_edges(corners)
    edges, inverse, times = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    if np.any(times == 1):
        a, b = edges[np.argmax(times == 1)].tolist()
        count = int(np.sum(times == 1))
        raise ValueError(f"the mesh is open: edge {a}-{b} belongs to one triangle only ({count} such edges): close its holes")
    if np.any(times > 2):
        a, b = edges[np.argmax(times > 2)].tolist()
        raise ValueError(
            f"edge {a}-{b} belongs to {times.max()} triangles, on a solid each belongs to two: separate its parts there"
        )
    # neighbors with the same side out run along their edge in opposite directions
    forward = np.bincount(inverse.reshape(-1), weights=directed[:, 0] < directed[:, 1])
    if np.any(forward != 1):
        a, b = edges[np.argmax(forward != 1)].tolist()
        raise ValueError(f"the triangles beside edge {a}-{b} disagree on which side is out: turn one round")

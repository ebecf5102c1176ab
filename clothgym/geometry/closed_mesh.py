"""Whether a triangle mesh bounds a solid, and error messages for one that does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import finite
from clothgym.geometry.intersections import first_intersection
from clothgym.mesh_repair import directed_edges
from clothgym.triangles import corners_of, refuse_degenerate


def checked_solid(
    vertices: ArrayLike, triangles: ArrayLike, numbers: NDArray | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [m], (vertices, 3), and triangles, (triangles, 3), of a closed surface, counter-clockwise seen from outside.

    numbers: of the vertices in their file, (vertices,), for messages.

    Raises:
        ValueError: arrays of another shape, a triangle without area, an edge of one triangle only or of more than two, neighbors
            that disagree on which side is out, a surface that is inside out, or one that passes through itself.
    """
    # arrays, areas and edges
    x = finite("vertices", vertices)
    corners = corners_of(x, triangles)
    refuse_degenerate(x, corners)
    _refuse_open(x, corners, numbers)
    # the volume, from tetrahedra between each triangle and the mean vertex (divergence theorem)
    twice = np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]])
    middle = x.mean(axis=0)
    volume = float(np.sum((x[corners[:, 0]] - middle) * twice)) / 6
    if volume < 0:
        raise ValueError(f"the mesh is inside out (its volume is {volume:.3g} m^3): turn all triangles round, triangles[:, ::-1]")
    # intersections
    found = first_intersection(corners, x)
    if found is not None:
        if numbers is None:
            one, other = (f"{t}, {corners[t].tolist()}," for t in found[1:])
        else:
            one, other = (f"{numbers[corners[t]].tolist()}, at {_place(x[corners[t]].mean(axis=0))} m," for t in found[1:])
        remedy = "join its parts into one surface (a boolean union), or make them colliders of their own"
        raise ValueError(f"the mesh passes through itself: triangles {one} and {other} cross; {remedy}")
    return x, corners


def _place(x: NDArray) -> str:
    return f"({', '.join(f'{c:.6g}' for c in x)})"


def _refuse_open(x: NDArray, corners: NDArray, numbers: NDArray | None) -> None:
    """Refuse an edge that does not join exactly two triangles with the same side out."""

    def named(edge: NDArray) -> str:
        a, b = edge.tolist()
        return f"edge {a}-{b}" if numbers is None else f"edge {numbers[a]}-{numbers[b]}, from {_place(x[a])} to {_place(x[b])} m,"

    # how many triangles each edge has
    directed = directed_edges(corners)
    edges, inverse, times = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    if np.any(times == 1):
        count, open_edge = int(np.sum(times == 1)), named(edges[np.argmax(times == 1)])
        raise ValueError(f"the mesh is open: {open_edge} belongs to one triangle only ({count} such edges): close its holes")
    if np.any(times > 2):
        crowded = named(edges[np.argmax(times > 2)])
        raise ValueError(f"{crowded} belongs to {times.max()} triangles, on a solid each belongs to two: separate its parts there")
    # neighbors with the same side out run along their edge in opposite directions
    forward = np.bincount(inverse.reshape(-1), weights=directed[:, 0] < directed[:, 1])
    if np.any(forward != 1):
        edge = named(edges[np.argmax(forward != 1)])
        raise ValueError(f"the triangles at {edge} have opposite orientations: flip one of them")

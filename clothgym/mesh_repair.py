"""Floor 1: from the polygons of a file to one surface: seams joined, what has no area dropped, one side up.

What cannot be decided for the user is refused, by the numbers and positions of the file's own vertices.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.geometry.polygons import as_triangles, quads_as_triangles, without_area
from clothgym.mesh_files import Polygons

FLATTEST = 1e-6  # twice a triangle's area over its longest side squared, below which it counts as degenerate
FARTHEST_SEAM = 0.1  # largest tolerance, as a share of the size of the mesh


class Repairs(NamedTuple):
    """What reading a mesh file has changed.

    merged: vertices that have become one particle with another.  joined: those of them that were not at exactly its place.
    collapsed: faces that this has left with fewer than three corners, dropped.  without_area: other triangles without area, dropped
    or shared out among their neighbors.  duplicates: triangles that were there before, dropped.  unused: vertices in no triangle,
    dropped.  turned: triangles turned round.  particle_of: the particle that each vertex of the file has become, or -1,
    (vertices,).
    """

    merged: int
    joined: int
    collapsed: int
    without_area: int
    duplicates: int
    unused: int
    turned: int
    particle_of: NDArray[np.int64]

    def told(self) -> list[str]:
        """What a user should know, as clauses of a sentence; that vertices at the same place are merged goes without saying."""
        clauses = [
            (self.joined, "joined {} that {} within merge_tolerance", "vertex", "vertices", "was", "were"),
            (self.collapsed, "dropped {} that {} left without three corners by merging vertices", "face", "faces", "was", "were"),
            (self.without_area, "took away {} that {} no area", "triangle", "triangles", "has", "have"),
            (self.duplicates, "dropped {} that {} there before", "triangle", "triangles", "was", "were"),
            (self.unused, "dropped {} that {} in no triangle", "vertex", "vertices", "is", "are"),
            (self.turned, "turned {} round that {} the other side up", "triangle", "triangles", "had", "had"),
        ]
        return [
            text.format(f"{count} {one if count == 1 else many}", is_ if count == 1 else are)
            for count, text, one, many, is_, are in clauses
            if count
        ]


class _Numbers:
    """How the file calls its vertices and faces."""

    def __init__(self, polygons: Polygons, scale: float) -> None:
        self.first, self.x, self.scale = polygons.first, polygons.vertices, scale

    def edge(self, a: int, b: int) -> str:
        """An edge between two of the vertices at hand."""
        return f"edge {a + self.first}-{b + self.first}, from {self.place(a)} to {self.place(b)},"

    def place(self, vertex: int) -> str:
        """Where the file puts one of its own vertices."""
        return f"({', '.join(f'{c:.6g}' for c in self.x[vertex])})"


def repaired(polygons: Polygons, scale: float, tolerance: float) -> tuple[NDArray, NDArray, NDArray, Repairs]:
    """Vertices [m], (vertices, 3), triangles, (triangles, 3), the file's numbers of these vertices, (vertices,), and what changed.

    Vertices at one place become one.  So do those within ``tolerance`` [m] that share an edge, or are both on a border: layers that
    lie close to each other stay apart.  scale: meters in the file's unit.

    Raises:
        ValueError: a vertex without a finite position, a face that crosses itself, vertices that would be joined in a chain, an
            edge of more than two triangles, or triangles that have no common side up.
    """
    numbers = _Numbers(polygons, scale)
    used = np.unique(polygons.corners)
    nowhere = used[~np.isfinite(polygons.vertices[used]).all(axis=1)]
    if len(nowhere):
        at = polygons.vertices[nowhere[0]].tolist()
        raise ValueError(f"vertex {nowhere[0] + polygons.first} is at {at}: give it a finite position")
    x = scale * polygons.vertices
    # vertices at one place, and then those within the tolerance
    place = _same_places(x, used)
    corners, sizes, repeated = _once(place[polygons.corners], polygons.sizes)
    triangles, collapsed = _triangulated(x, corners, sizes, numbers)
    joined = 0
    if tolerance > 0 and len(triangles):
        nearby = _nearby(x, triangles, tolerance, numbers)
        joined, place = int(np.sum(nearby != np.arange(len(x)))), nearby[place]
        triangles = nearby[triangles]
        whole = _has_three_corners(triangles)
        triangles, collapsed = triangles[whole], collapsed + int(np.sum(~whole))
    merged = len(used) - len(np.unique(place[used]))
    # what has no area, or is there twice
    triangles, without_area = _without_slivers(x, triangles, numbers)
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    duplicates, triangles = repeated + len(triangles) - len(first), triangles[np.sort(first)]
    if not len(triangles):
        raise ValueError("none of its triangles has an area")
    triangles, turned = _one_side_up(triangles, numbers)
    # the vertices that are left, in the file's order
    left = np.unique(triangles)
    particle = np.full(len(x), -1)
    particle[left] = np.arange(len(left))
    particle_of = np.where(np.isin(np.arange(len(x)), used), particle[place], -1)
    unused = len(x) - int(np.sum(particle_of >= 0))
    repairs = Repairs(merged, joined, collapsed, without_area, duplicates, unused, turned, particle_of)
    return x[left], particle[triangles], left + polygons.first, repairs


def _same_places(x: NDArray, used: NDArray) -> NDArray[np.int64]:
    """The first vertex at each one's place, (vertices,); vertices that are not used keep their own."""
    _, first, which = np.unique(x[used], axis=0, return_index=True, return_inverse=True)
    place = np.arange(len(x))
    place[used] = used[first][which.reshape(-1)]
    return place


def _once(corners: NDArray, sizes: NDArray) -> tuple[NDArray, NDArray, int]:
    """Corners and sizes of the faces without repetitions, and how many triangles less that makes.

    Repeated triangles are found later; those of faces of more corners may differ, as diagonals do.
    """
    begins, keep, repeated = np.cumsum(sizes) - sizes, np.ones(len(sizes), bool), 0
    for size in np.unique(sizes[sizes > 3]).tolist():
        own = np.flatnonzero(sizes == size)
        _, first = np.unique(np.sort(corners[begins[own][:, None] + np.arange(size)], axis=1), axis=0, return_index=True)
        keep[np.delete(own, first)] = False
        repeated += (len(own) - len(first)) * (size - 2)
    return corners[np.repeat(keep, sizes)], sizes[keep], repeated


def _has_three_corners(triangles: NDArray) -> NDArray[np.bool_]:
    return np.all(triangles != np.roll(triangles, 1, axis=1), axis=1)


def _triangulated(x: NDArray, corners: NDArray, sizes: NDArray, numbers: _Numbers) -> tuple[NDArray, int]:
    """Triangles of the faces, in their order, and how many faces have no three corners.  Corners that follow themselves are left
    out."""
    parts: list[tuple[NDArray, NDArray]] = []  # the faces, and their triangles
    begins, collapsed = np.cumsum(sizes) - sizes, 0
    # triangles and quads at once
    three = np.flatnonzero(sizes == 3)
    triangles = corners[begins[three][:, None] + np.arange(3)]
    whole = _has_three_corners(triangles)
    collapsed += int(np.sum(~whole))
    parts.append((three[whole], triangles[whole]))
    four = np.flatnonzero(sizes == 4)
    quads = corners[begins[four][:, None] + np.arange(4)]
    halves, right = quads_as_triangles(x, quads)
    parts.append((np.repeat(four[right], 2), halves[right].reshape(-1, 3)))
    # other faces one by one
    others = np.sort(np.concatenate([np.flatnonzero((sizes != 3) & (sizes != 4)), four[~right]]))
    for face in others.tolist():
        own = corners[begins[face] : begins[face] + sizes[face]]
        own = own[own != np.roll(own, 1)]
        if len(own) < 3 or len(np.unique(own)) < 3:
            collapsed += 1
            continue
        found = as_triangles(x[own])
        if found is None and without_area(x[own]):
            found = [(0, k, k + 1) for k in range(1, len(own) - 1)]
        if found is None:
            named = (own + numbers.first).tolist()
            raise ValueError(
                f"face {face + numbers.first}, with the vertices {named}, the first at {numbers.place(own[0])}, crosses itself: "
                "cut it into triangles"
            )
        parts.append((np.full(len(found), face), own[np.array(found)]))
    order = np.argsort(np.concatenate([faces for faces, _ in parts]), kind="stable")
    triangles = np.concatenate([found for _, found in parts])[order]
    whole = _has_three_corners(triangles)
    return triangles[whole], collapsed


def _nearby(x: NDArray, triangles: NDArray, tolerance: float, numbers: _Numbers) -> NDArray[np.int64]:
    """The vertex that each one is joined to, (vertices,); x: moved to the middle of those that are joined, in place."""
    from scipy.sparse import coo_matrix  # imported here: scipy doubles the time of a warm start
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    used = np.unique(triangles)
    size = np.ptp(x[used], axis=0).max()
    if tolerance > FARTHEST_SEAM * size:
        raise ValueError(f"merge_tolerance={tolerance:g} m: must be at most a tenth of its size, which is {size:.4g} m")
    # pairs on an edge, or both on the border
    edges, times = np.unique(np.sort(directed_edges(triangles), axis=1), axis=0, return_counts=True)
    border = np.zeros(len(x), bool)
    border[edges[times == 1]] = True
    close = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) <= tolerance
    rim = np.flatnonzero(border)
    pairs = rim[cKDTree(x[rim]).query_pairs(tolerance, output_type="ndarray")] if len(rim) else np.zeros((0, 2), np.int64)
    pairs = np.concatenate([edges[close], pairs])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(x), len(x)))
    _, group = connected_components(graph, directed=False)
    # each group is no larger than two tolerances, and meets in its middle
    _, first, which, members = np.unique(group, return_index=True, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    low, high = np.full((len(first), 3), np.inf), np.full((len(first), 3), -np.inf)
    np.minimum.at(low, which, x)
    np.maximum.at(high, which, x)
    extent = np.where(members > 1, np.linalg.norm(high - low, axis=1), 0)
    if np.any(extent > 2 * tolerance):
        worst = int(np.argmax(extent))
        raise ValueError(
            f"merge_tolerance={tolerance:g} m: joins a chain of {members[worst]} vertices over {extent[worst]:.3g} m, from vertex "
            f"{first[worst] + numbers.first} at {numbers.place(first[worst])} on: give less than the spacing of the vertices"
        )
    for axis in range(3):
        middle = np.bincount(which, weights=x[:, axis]) / members
        x[:, axis] = np.where(members[which] > 1, middle[which], x[:, axis])
    return first[which]


def directed_edges(triangles: NDArray) -> NDArray:
    """The edges of each triangle with their directions, (3 triangles, 2)."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def flat_triangles(x: NDArray, triangles: NDArray) -> NDArray[np.bool_]:
    """Which triangles have twice an area of at most FLATTEST times their longest side squared."""
    sides = [x[triangles[:, b]] - x[triangles[:, a]] for a, b in ((0, 1), (1, 2), (2, 0))]
    twice = np.linalg.norm(np.cross(sides[0], sides[2]), axis=1)
    return twice <= FLATTEST * np.max([np.sum(side**2, axis=1) for side in sides], axis=0)


def _without_slivers(x: NDArray, triangles: NDArray, numbers: _Numbers) -> tuple[NDArray, int]:
    """The triangles without degenerate ones, and the number of degenerate ones.

    If the shortest side is negligible relative to the longest, both its ends become one vertex.  Otherwise one corner lies on the
    longest side.  The triangle on the other side of it is cut in two there, so that the surface stays in one piece.
    """
    flat = np.flatnonzero(flat_triangles(x, triangles)).tolist()
    if not flat:
        return triangles, 0
    rows: dict[int, tuple[int, ...]] = {t: tuple(row) for t, row in enumerate(triangles.tolist())}
    around: dict[int, set[int]] = {}
    for t, row in rows.items():
        for corner in row:
            around.setdefault(corner, set()).add(t)

    def put(t: int, row: tuple[int, ...] | None) -> None:
        """Replace triangle t, or add it; without three corners it is gone."""
        for corner in rows.pop(t, ()):
            around[corner].discard(t)
        if row is None or len(set(row)) < 3:
            return
        rows[t] = row
        for corner in row:
            around[corner].add(t)
        if flat_triangles(x, np.array([row]))[0]:
            flat.append(t)

    taken, most, free = 0, 20 * len(flat) + 100, len(rows)
    while flat:
        t = flat.pop()
        if t not in rows or not flat_triangles(x, np.array([rows[t]]))[0]:
            continue
        if (taken := taken + 1) > most:
            named, at = [p + numbers.first for p in rows[t]], numbers.place(rows[t][0])
            raise ValueError(f"the triangle of the vertices {named}, the first at {at}, has no area: remove it")
        # the corner on the longest side, that side, and the shortest
        row = rows[t]
        sides = sorted((float(np.sum((x[row[k]] - x[row[k - 1]]) ** 2)), row[k - 1], row[k]) for k in range(3))
        (least, p, q), (most_of_all, a, c) = sides[0], sides[2]
        if least <= FLATTEST**2 * most_of_all:
            kept, gone = min(p, q), max(p, q)
            for other in list(around[gone]):
                put(other, tuple(kept if corner == gone else corner for corner in rows[other]))
            continue
        (b,) = set(row) - {a, c}
        put(t, None)
        for other in list(around[a] & around[c]):
            beyond = rows[other]
            if b not in beyond:
                put(other, tuple(b if corner == c else corner for corner in beyond))
                put(free, tuple(b if corner == a else corner for corner in beyond))
                free += 1
    return np.array([rows[t] for t in sorted(rows)], np.int64).reshape(-1, 3), taken


def _one_side_up(triangles: NDArray, numbers: _Numbers) -> tuple[NDArray, int]:
    """The triangles with one side up in each part that edges hold together, and how many were turned: the smaller share.

    Raises:
        ValueError: an edge of more than two triangles, or a part with one side only.
    """
    edges, inverse, times = np.unique(
        np.sort(directed_edges(triangles), axis=1), axis=0, return_inverse=True, return_counts=True
    )  # fmt: skip
    if np.any(times > 2):
        worst, count = int(np.argmax(times > 2)), int(np.sum(times > 2))
        raise ValueError(
            f"{numbers.edge(*edges[worst])} belongs to {times[worst]} triangles ({count} such edges): on a surface it belongs to "
            "one or two, remove the others, separate the parts there, or join narrow triangles by merge_tolerance= of load_mesh"
        )
    # both triangles of each inner edge, and whether they have it in one direction, which two with the same side up have not
    order = np.argsort(inverse.reshape(-1), kind="stable")
    begins = np.cumsum(times) - times
    inner = np.flatnonzero(times == 2)
    one, other = order[begins[inner]], order[begins[inner] + 1]
    forward = (directed_edges(triangles)[:, 0] < directed_edges(triangles)[:, 1]).astype(bool)
    differ = forward[one] == forward[other]
    if not differ.any():
        return triangles, 0
    one, other = one % len(triangles), other % len(triangles)
    adjacent: list[list[tuple[int, bool]]] = [[] for _ in range(len(triangles))]
    for s, t, turns in zip(one.tolist(), other.tolist(), differ.tolist()):
        adjacent[s].append((t, turns))
        adjacent[t].append((s, turns))
    # from each part's first triangle on
    turned = np.zeros(len(triangles), bool)
    seen = np.zeros(len(triangles), bool)
    for start in range(len(triangles)):
        if seen[start]:
            continue
        seen[start], part, waiting = True, [start], deque([start])
        while waiting:
            t = waiting.popleft()
            for neighbor, turns in adjacent[t]:
                if not seen[neighbor]:
                    seen[neighbor], turned[neighbor] = True, turned[t] ^ turns
                    part.append(neighbor)
                    waiting.append(neighbor)
        if 2 * int(turned[part].sum()) > len(part):
            turned[part] = ~turned[part]
    wrong = (turned[one] ^ turned[other]) != differ
    if wrong.any():
        where = numbers.edge(*edges[inner[np.argmax(wrong)]])
        raise ValueError(f"{where} lies in a part that has one side only, as a Moebius strip has: cut it there")
    triangles = triangles.copy()
    triangles[turned] = triangles[turned][:, ::-1]
    return triangles, int(turned.sum())

"""Whether two triangles intersect, in integer arithmetic: slow and exact, for the few pairs that floating point cannot decide.

Floating-point coordinates are integers times a power of two, and no predicate here depends on the scale.  Triangles may be
degenerate.  What counts as an intersection is defined in ``intersections``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Point = tuple[int, int, int]

UNSURE = 2  # answer of a kernel that cannot decide a pair


def intersecting(first: Sequence[int], second: Sequence[int], x: NDArray[np.float64]) -> bool:
    """Whether two triangles intersect apart from the vertices that they share; first, second: three indices into x."""
    # coordinates as integers, those of shared vertices first
    common = [p for p in first if p in second]
    one, two = [p for p in first if p not in common], [p for p in second if p not in common]
    particles = [*common, *one, *two]
    points = integers(x[particles])
    shared, a, b = points[: len(common)], points[len(common) : 3], points[3:]
    # no vertex in common: a side of one meets the other
    if len(common) == 0:
        return any(segment_meets_triangle(t[n - 1], t[n], other) for t, other in ((a, b), (b, a)) for n in range(3))
    if len(common) == 1:
        # on the line of intersection beyond the vertex one triangle ends first, at the side opposite the vertex
        return segment_meets_triangle(a[0], a[1], [*shared, *b]) or segment_meets_triangle(b[0], b[1], [*shared, *a])
    if len(common) == 2:
        # an edge in common: they intersect if they lie in one plane on the same side of it
        edge = minus(shared[1], shared[0])
        over, under = cross(edge, minus(a[0], shared[0])), cross(edge, minus(b[0], shared[0]))
        return orientation(shared[0], shared[1], a[0], b[0]) == 0 and dot(over, under) > 0
    return True


def integers(x: NDArray[np.float64]) -> list[Point]:
    """Coordinates, (points, 3), times a power of two that makes all of them integers."""
    mantissa, exponent = np.frexp(x)
    whole = (mantissa * 2.0**53).astype(np.int64)
    shift = exponent - exponent[mantissa != 0].min(initial=2000)
    shift[mantissa == 0] = 0
    return [(a << i, b << j, c << k) for (a, b, c), (i, j, k) in zip(whole.tolist(), shift.tolist())]


def minus(a: Point, b: Point) -> Point:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def cross(a: Point, b: Point) -> Point:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Point, b: Point) -> int:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def sign(value: int) -> int:
    """1, 0 or -1."""
    return (value > 0) - (value < 0)


def orientation(a: Point, b: Point, c: Point, d: Point) -> int:
    """Which side of plane abc point d is on: 1 or -1, 0 if in the plane."""
    return sign(dot(cross(minus(b, a), minus(c, a)), minus(a, d)))


def segment_meets_triangle(p: Point, q: Point, triangle: Sequence[Point]) -> bool:
    """Whether segment pq and a triangle, which may be degenerate, have a point in common."""
    a, b, c = triangle
    # which sides of the plane the ends are on
    side_p, side_q = orientation(a, b, c, p), orientation(a, b, c, q)
    # in the plane: the segment meets a side
    if side_p == side_q == 0:
        if any(segments_meet(p, q, triangle[n - 1], triangle[n]) for n in range(3)):
            return True
        # otherwise it is all inside or all outside; a triangle without area has no inside
        normal = cross(minus(b, a), minus(c, a))
        turns = {sign(dot(normal, cross(minus(triangle[n], triangle[n - 1]), minus(p, triangle[n - 1])))) for n in range(3)}
        return turns == {1}
    if side_p == side_q:
        return False
    # across the plane: its line passes all sides of the triangle on the same side
    return not {1, -1} <= {orientation(p, q, a, b), orientation(p, q, b, c), orientation(p, q, c, a)}


def segments_meet(p: Point, q: Point, a: Point, b: Point) -> bool:
    """Whether segments pq and ab, which may be points, have a point in common."""
    along, other, between = minus(q, p), minus(b, a), minus(a, p)
    normal = cross(along, other)
    if normal != (0, 0, 0):
        # not parallel: they cross at p + s along = a + t other; s and t here are multiplied by |normal|^2
        s, t, whole = dot(cross(between, other), normal), dot(cross(between, along), normal), dot(normal, normal)
        return dot(between, normal) == 0 and 0 <= s <= whole and 0 <= t <= whole
    # parallel: on one line, and overlapping along it
    line = along if along != (0, 0, 0) else other
    if cross(between, line) != (0, 0, 0):
        return False
    if line == (0, 0, 0):
        return between == line
    ends = sorted((dot(p, line), dot(q, line))), sorted((dot(a, line), dot(b, line)))
    return ends[0][0] <= ends[1][1] and ends[1][0] <= ends[0][1]

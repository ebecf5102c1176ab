"""Intersecting triangles of a sheet, counted exactly: what self-collision must keep at zero, computed independently of it.

A pair of triangles counts

* if they share no vertex and have a point in common; touching counts;
* if they share one vertex and have another point in common;
* if they share an edge and are folded flat onto each other: in one plane, on the same side of the edge.

Each decision is the one that exact arithmetic on the given coordinates would make.  float64 decides nearly all of them: cells of a
grid find the pairs whose boxes overlap, projections on separating axes rule out pairs that are apart by more than the rounding
error, and signs of orientations larger than their error bound (Shewchuk 1997, Adaptive precision floating-point arithmetic, section
4.3) confirm crossings.  The rest is decided in integers, which floating-point coordinates are when scaled by a power of two.

A triangle without area counts as the segment or point that it is.  If the vertex that it shares with another lies within its
opposite side, the pair counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import apart, kernel
from clothgym.checks import finite
from clothgym.geometry import exact_predicates
from clothgym.geometry.exact_predicates import UNSURE

# bounds of rounding errors, relative to the sum of absolute values: of orientations (7 units of 2^-53 are enough), of the
# difference of two projections, of the product of two normals; and what underflow may add
ORIENTATION, PROJECTION, NORMALS, TINY = 1e-15, 4e-15, 4e-15, 1e-290
PAIRS = 256  # initial room for pairs; kernels return how many there are


def find_intersections(triangles: ArrayLike, positions: ArrayLike) -> NDArray[np.int64]:
    """All intersecting pairs: environment and two triangles, (pairs, 3), in this order.

    Args:
        triangles: of the mesh, (triangles, 3).
        positions: of its particles [m], (num_envs, particles, 3), or of one sheet, (particles, 3).

    Raises:
        ValueError: positions of another shape, or not finite.
    """
    x = finite("positions", positions)
    x = np.ascontiguousarray(x[None] if x.ndim == 2 else x)
    corners = np.ascontiguousarray(triangles, np.int64)
    if x.ndim != 3 or x.shape[2] != 3 or x.shape[1] <= corners.max(initial=-1):
        need = f"(num_envs, particles, 3) with at least {corners.max(initial=-1) + 1} particles"
        raise ValueError(f"positions have shape {np.shape(positions)}: must be {need}")
    # pairs that intersect or may; with more room if there was too little
    pairs = np.empty((PAIRS, 4), np.int64)
    found = find_pairs(x, corners, pairs)
    if found > len(pairs):
        pairs = np.empty((found, 4), np.int64)
        find_pairs(x, corners, pairs)
    # those that floating point cannot decide
    pairs = pairs[:found]
    intersecting = pairs[:, 3] == 1
    for row in np.flatnonzero(pairs[:, 3] == UNSURE):
        env, first, second = pairs[row, :3].tolist()
        intersecting[row] = exact_predicates.intersecting(corners[first].tolist(), corners[second].tolist(), x[env])
    pairs = pairs[intersecting, :3]
    return pairs[np.lexsort(pairs.T[::-1])]


def count_intersections(triangles: ArrayLike, positions: ArrayLike) -> NDArray[np.int64]:
    """Number of intersecting pairs of triangles, (num_envs,); arguments and errors as for ``find_intersections``."""
    sheets = len(positions) if np.ndim(positions) == 3 else 1  # type: ignore[arg-type]
    return np.bincount(find_intersections(triangles, positions)[:, 0], minlength=sheets)


def first_intersection(triangles: ArrayLike, positions: ArrayLike) -> tuple[int, int, int] | None:
    """Environment and two triangles of one intersection, or None; arguments and errors as for ``find_intersections``."""
    pairs = find_intersections(triangles, positions)
    return tuple(pairs[0].tolist()) if len(pairs) else None


@kernel
def find_pairs(x, triangles, pairs):
    """Find pairs of triangles that intersect or may: environment, both triangles, and 1 or UNSURE, ``pairs``, (room, 4).  Returns
    how many there are; only those for which there is room are written.

    x: [m], (num_envs, particles, 3).  A cell is as wide as the largest box, so boxes that overlap have their lower corners in the
    same cell or in adjacent ones.
    """
    count = triangles.shape[0]
    low, high = np.empty((count, 3)), np.empty((count, 3))
    cell, order = np.empty((count, 3), np.int64), np.empty(count, np.int64)
    origin, cells = np.empty(3), np.empty(3, np.int64)
    work = np.empty((12, 3))
    found = 0
    for env in range(x.shape[0] if count > 0 else 0):
        # bounding boxes, sorted into cells
        size = 0.0
        for t in range(count):
            i, j, k = triangles[t]
            for c in range(3):
                low[t, c] = min(x[env, i, c], x[env, j, c], x[env, k, c])
                high[t, c] = max(x[env, i, c], x[env, j, c], x[env, k, c])
                size = max(size, high[t, c] - low[t, c])
        starts = _sort_into_cells(low, size * (1 + 1e-6), origin, cells, cell, order)
        for t in range(count):
            # each pair of adjacent cells, and each pair within a cell, in one order only
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    for dz in range(-1, 2):
                        if dx < 0 or (dx == 0 and (dy < 0 or (dy == 0 and dz < 0))):
                            continue
                        i, j, k = cell[t, 0] + dx, cell[t, 1] + dy, cell[t, 2] + dz
                        if i >= cells[0] or j < 0 or j >= cells[1] or k < 0 or k >= cells[2]:
                            continue
                        place = (i * cells[1] + j) * cells[2] + k
                        within = dx == 0 and dy == 0 and dz == 0
                        for n in range(starts[place], starts[place + 1]):
                            other = order[n]
                            if within and other <= t:
                                continue
                            # boxes that overlap, then the triangles
                            overlap = low[t, 0] <= high[other, 0] and low[other, 0] <= high[t, 0]
                            overlap &= low[t, 1] <= high[other, 1] and low[other, 1] <= high[t, 1]
                            overlap &= low[t, 2] <= high[other, 2] and low[other, 2] <= high[t, 2]
                            if overlap:
                                first, second = min(t, other), max(t, other)
                                verdict = _decide(x[env], triangles[first], triangles[second], work)
                                if verdict != 0:
                                    if found < pairs.shape[0]:
                                        pairs[found, 0], pairs[found, 1], pairs[found, 2] = env, first, second
                                        pairs[found, 3] = verdict
                                    found += 1
    return found


@kernel
def _sort_into_cells(low, size, origin, cells, cell, order):
    """Sort boxes into cells at least ``size`` wide by their lower corners ``low``, (boxes, 3).  Returns where each cell begins in
    ``order``.

    origin, cells: become the grid's corner and its cells along each axis, (3,).  cell: becomes the cell of each box, (boxes, 3).
    order: becomes the boxes, cell by cell, (boxes,).
    """
    count = low.shape[0]
    # the grid: cells wide enough that there are not many more than boxes
    extent = np.empty(3)
    for c in range(3):
        origin[c] = low[:, c].min()
        extent[c] = low[:, c].max() - origin[c]
    size = max(size, 1e-12 * max(extent[0], extent[1], extent[2]), TINY)
    while (extent[0] / size + 1) * (extent[1] / size + 1) * (extent[2] / size + 1) > 4 * count + 64:
        size *= 1.3
    for c in range(3):
        cells[c] = np.int64(extent[c] / size) + 1
    # count the boxes of each cell
    starts = np.zeros(cells[0] * cells[1] * cells[2] + 1, np.int64)
    for t in range(count):
        for c in range(3):
            cell[t, c] = np.int64((low[t, c] - origin[c]) / size)
        starts[(cell[t, 0] * cells[1] + cell[t, 1]) * cells[2] + cell[t, 2] + 1] += 1
    # where each cell begins
    for n in range(1, starts.shape[0]):
        starts[n] += starts[n - 1]
    # the boxes of each
    fill = starts.copy()
    for t in range(count):
        place = (cell[t, 0] * cells[1] + cell[t, 1]) * cells[2] + cell[t, 2]
        order[fill[place]] = t
        fill[place] += 1
    return starts


@apart
def _decide(x, first, second, work):
    """Whether two triangles, three indices into x each, intersect: 1, 0 or UNSURE.  work: scratch, (12, 3)."""
    # corners, in both triangles those that are shared first
    shared = 0
    a, b = work[0:3], work[3:6]
    i, j = 2, 2
    for n in range(3):
        twin = first[n] == second[0] or first[n] == second[1] or first[n] == second[2]
        place = shared if twin else i
        for c in range(3):
            a[place, c] = x[first[n], c]
        if twin:
            for c in range(3):
                b[shared, c] = x[first[n], c]
            shared += 1
        else:
            i -= 1
    for n in range(3):
        if second[n] != first[0] and second[n] != first[1] and second[n] != first[2]:
            for c in range(3):
                b[j, c] = x[second[n], c]
            j -= 1
    # the cases of the module
    if shared == 0:
        return _triangles(a, b, work[6:])
    if shared == 1:
        if _wedges_apart(a, b):
            return 0
        one = _segment_triangle(a[1:], b, work[6:])
        if one == 1:
            return 1
        two = _segment_triangle(b[1:], a, work[6:])
        return 1 if two == 1 else max(one, two)
    if shared == 2:
        return _folded_flat(a[0], a[1], a[2], b[2])
    return UNSURE


@kernel
def _apart(p, q, work):
    """Whether segment or triangle p, (2 or 3, 3), and triangle q, (3, 3), are surely disjoint: whether an axis separates them."""
    edges, normals, axis = work[0:3], work[3:5], work[5]
    # largest component relative to q[0], for the rounding error
    size = 0.0
    for n in range(3):
        for c in range(3):
            size = max(size, abs(q[n, c] - q[0, c]))
            if n < p.shape[0]:
                size = max(size, abs(p[n, c] - q[0, c]))
    # their normals
    planes = 1 if p.shape[0] == 2 else 2
    for n in range(planes):
        corners = q if n == 0 else p
        for c in range(3):
            edges[0, c], edges[1, c] = corners[1, c] - corners[0, c], corners[2, c] - corners[0, c]
        _cross(edges[0], edges[1], normals[n])
        if _separates(normals[n], p, q, size):
            return True
    # in the planes, perpendicular to each side
    sides_of_p = 1 if p.shape[0] == 2 else 3
    for n in range(planes):
        for e in range(3 + sides_of_p):
            _side(p, q, e, edges[0])
            _cross(normals[n], edges[0], axis)
            if _separates(axis, p, q, size):
                return True
    for e in range(3):
        _side(p, q, e, edges[0])
        for f in range(3, 3 + sides_of_p):
            _side(p, q, f, edges[1])
            _cross(edges[0], edges[1], axis)
            if _separates(axis, p, q, size):
                return True
    return False


@kernel
def _side(p, q, e, out):
    """The vector along side e of q, or side e - 3 of p: ``out``, (3,)."""
    corners = q if e < 3 else p
    start = e % 3
    end = (start + 1) % corners.shape[0]
    for c in range(3):
        out[c] = corners[end, c] - corners[start, c]


@kernel
def _cross(a, b, out):
    """``out`` = a x b, (3,) each."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def _separates(axis, p, q, size):
    """Whether the projections on an axis are farther apart than their rounding error; the axis itself need not be exact.

    size: largest component of the corners relative to q[0].
    """
    p_low, p_high, q_low, q_high = np.inf, -np.inf, np.inf, -np.inf
    for n in range(p.shape[0]):
        at = axis[0] * (p[n, 0] - q[0, 0]) + axis[1] * (p[n, 1] - q[0, 1]) + axis[2] * (p[n, 2] - q[0, 2])
        p_low, p_high = min(p_low, at), max(p_high, at)
    for n in range(3):
        at = axis[0] * (q[n, 0] - q[0, 0]) + axis[1] * (q[n, 1] - q[0, 1]) + axis[2] * (q[n, 2] - q[0, 2])
        q_low, q_high = min(q_low, at), max(q_high, at)
    error = PROJECTION * size * (abs(axis[0]) + abs(axis[1]) + abs(axis[2])) + TINY
    return p_low - q_high > error or q_low - p_high > error


@kernel
def _wedges_apart(a, b):
    """Whether a plane through the common corner a[0] = b[0] surely separates two triangles: the one perpendicular to the difference
    of their mean directions from there.
    """
    size = 0.0
    axis_x, axis_y, axis_z = 0.0, 0.0, 0.0
    for n in range(1, 3):
        for corners, sign in ((a, 1.0), (b, -1.0)):
            dx, dy, dz = corners[n, 0] - a[0, 0], corners[n, 1] - a[0, 1], corners[n, 2] - a[0, 2]
            size = max(size, abs(dx), abs(dy), abs(dz))
            scale = sign / np.sqrt(dx * dx + dy * dy + dz * dz)
            axis_x += dx * scale
            axis_y += dy * scale
            axis_z += dz * scale
    error = PROJECTION * size * (abs(axis_x) + abs(axis_y) + abs(axis_z)) + TINY
    for n in range(1, 3):
        one = axis_x * (a[n, 0] - a[0, 0]) + axis_y * (a[n, 1] - a[0, 1]) + axis_z * (a[n, 2] - a[0, 2])
        two = axis_x * (b[n, 0] - a[0, 0]) + axis_y * (b[n, 1] - a[0, 1]) + axis_z * (b[n, 2] - a[0, 2])
        if not (one > error and two < -error):
            return False
    return True


@apart
def _triangles(a, b, work):
    """Whether two triangles without a common vertex intersect, that is whether a side of one meets the other: 1, 0 or UNSURE."""
    # one lies on one side of the plane of the other
    a0, a1, a2 = _orientation(b[0], b[1], b[2], a[0]), _orientation(b[0], b[1], b[2], a[1]), _orientation(b[0], b[1], b[2], a[2])
    if a0 == a1 and a0 == a2 and (a0 == 1 or a0 == -1):
        return 0
    b0, b1, b2 = _orientation(a[0], a[1], a[2], b[0]), _orientation(a[0], a[1], a[2], b[1]), _orientation(a[0], a[1], a[2], b[2])
    if b0 == b1 and b0 == b2 and (b0 == 1 or b0 == -1):
        return 0
    if a0 == 0 and a1 == 0 and a2 == 0:
        return _in_one_plane(a, b, work)
    # separating axes are tried once: here, or below
    unsure = max(a0, a1, a2, b0, b1, b2) == UNSURE
    if unsure and _apart(a, b, work):
        return 0
    # each side of one against the other
    answer = 0
    for n in range(3):
        m = (n + 1) % 3
        over, under = (a0, a1) if n == 0 else (a1, a2) if n == 1 else (a2, a0)
        one = _pierces(a[n], a[m], b, over, under)
        over, under = (b0, b1) if n == 0 else (b1, b2) if n == 1 else (b2, b0)
        two = _pierces(b[n], b[m], a, over, under)
        if one == 1 or two == 1:
            return 1
        answer = max(answer, one, two)
    return 0 if answer == UNSURE and not unsure and _apart(a, b, work) else answer


@kernel
def _segment_triangle(p, t, work):
    """Whether a segment, (2, 3), meets a triangle, (3, 3): 1, 0 or UNSURE."""
    side_p, side_q = _orientation(t[0], t[1], t[2], p[0]), _orientation(t[0], t[1], t[2], p[1])
    if side_p == 0 and side_q == 0:
        return _in_one_plane(p, t, work)
    unsure = side_p == UNSURE or side_q == UNSURE
    if unsure and _apart(p, t, work):
        return 0
    answer = _pierces(p[0], p[1], t, side_p, side_q)
    return 0 if answer == UNSURE and not unsure and _apart(p, t, work) else answer


@kernel
def _pierces(p, q, t, over, under):
    """Whether segment pq meets triangle t: 1, 0 or UNSURE.  over, under: which sides of its plane p and q are on."""
    if over == UNSURE or under == UNSURE or (over == 0 and under == 0):
        return UNSURE
    if over == under:
        return 0
    # its line passes all sides of the triangle on the same side
    one, two, three = _orientation(p, q, t[0], t[1]), _orientation(p, q, t[1], t[2]), _orientation(p, q, t[2], t[0])
    if (one == 1 or two == 1 or three == 1) and (one == -1 or two == -1 or three == -1):
        return 0
    return UNSURE if one == UNSURE or two == UNSURE or three == UNSURE else 1


@kernel
def _orientation(a, b, c, d):
    """Sign of ``det(a - d, b - d, c - d)``, or UNSURE where it is below its rounding error."""
    ax, ay, az = a[0] - d[0], a[1] - d[1], a[2] - d[2]
    bx, by, bz = b[0] - d[0], b[1] - d[1], b[2] - d[2]
    cx, cy, cz = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    if (ax == 0 and bx == 0 and cx == 0) or (ay == 0 and by == 0 and cy == 0) or (az == 0 and bz == 0 and cz == 0):
        return 0  # exact, and frequent: cloth on a floor
    volume = az * (bx * cy - cx * by) + bz * (cx * ay - ax * cy) + cz * (ax * by - bx * ay)
    summed = abs(az) * (abs(bx * cy) + abs(cx * by)) + abs(bz) * (abs(cx * ay) + abs(ax * cy))
    summed += abs(cz) * (abs(ax * by) + abs(bx * ay))
    error = ORIENTATION * summed + TINY
    if volume > error:
        return 1
    return -1 if volume < -error else UNSURE


@kernel
def _in_one_plane(p, q, work):
    """Whether segment or triangle p and triangle q in one plane intersect: 1, 0 or UNSURE.

    In a plane x, y or z = constant the signs of turns decide.
    """
    for k in range(3):
        level = p[0, k] == q[0, k] and p[1, k] == q[0, k] and q[1, k] == q[0, k] and q[2, k] == q[0, k]
        # a side of one with all of the other beyond it
        if level and (p.shape[0] == 2 or p[2, k] == q[0, k]):
            i, j = (k + 1) % 3, (k + 2) % 3
            one = _divides(q, p, i, j)
            if one == 1:
                return 0
            two = _divides(p, q, i, j)
            if two == 1:
                return 0
            return 1 if one == 0 and two == 0 else UNSURE
    return 0 if _apart(p, q, work) else UNSURE


@kernel
def _divides(t, others, i, j):
    """Whether a side of triangle or segment t has all other points strictly beyond it, in the plane of axes i and j: 1, 0 or
    UNSURE.
    """
    answer = 0
    for n in range(3 if t.shape[0] == 3 else 1):
        m = (n + 1) % 3
        inner = _turn(t[n], t[m], t[3 - n - m], i, j) if t.shape[0] == 3 else -_turn(t[n], t[m], others[0], i, j)
        if inner != 1 and inner != -1:
            answer = UNSURE
            continue
        beyond, within = 0, 0
        for o in range(others.shape[0]):
            side = _turn(t[n], t[m], others[o], i, j)
            beyond += side == -inner
            within += side == inner
        if beyond == others.shape[0]:
            return 1
        if within == 0:
            answer = UNSURE
    return answer


@kernel
def _turn(a, b, c, i, j):
    """Sign of the turn from a via b to c in the plane of axes i and j, or UNSURE."""
    left, right = (a[i] - c[i]) * (b[j] - c[j]), (a[j] - c[j]) * (b[i] - c[i])
    error = ORIENTATION * (abs(left) + abs(right)) + TINY
    if left - right > error:
        return 1
    return -1 if left - right < -error else UNSURE


@kernel
def _folded_flat(a, b, c, d):
    """Whether triangles abc and abd are folded flat onto each other: 1, 0 or UNSURE."""
    # product of their normals: negative if they open out
    dot, summed = 0.0, 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        ei, ej = b[i] - a[i], b[j] - a[j]
        ci, cj, di, dj = c[i] - a[i], c[j] - a[j], d[i] - a[i], d[j] - a[j]
        dot += (ei * cj - ej * ci) * (ei * dj - ej * di)
        summed += (abs(ei * cj) + abs(ej * ci)) * (abs(ei * dj) + abs(ej * di))
    error = NORMALS * summed + TINY
    if dot < -error:
        return 0
    # and whether they lie in one plane
    sign = _orientation(a, b, c, d)
    if sign == 1 or sign == -1:
        return 0
    return 1 if sign == 0 and dot > error else UNSURE

"""Whether two triangles intersect, in float64, where that is certain: the filter before ``exact_predicates``.

A sign counts if it is larger than its rounding error, an axis separates if the projections are apart by more than theirs (Shewchuk
1997, Adaptive precision floating-point arithmetic, section 4.3).  All other answers are UNSURE.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, kernel
from clothgym.geometry.exact_predicates import UNSURE

# bounds of rounding errors, relative to the sum of absolute values: of orientations (7 units of 2^-53 are enough), of the
# difference of two projections, of the product of two normals; and what underflow may add
ORIENTATION, PROJECTION, NORMALS, TINY = 1e-15, 4e-15, 4e-15, 1e-290


@apart
def decide(x, first, second, work):
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
            _side_vector(p, q, e, edges[0])
            _cross(normals[n], edges[0], axis)
            if _separates(axis, p, q, size):
                return True
    for e in range(3):
        _side_vector(p, q, e, edges[0])
        for f in range(3, 3 + sides_of_p):
            _side_vector(p, q, f, edges[1])
            _cross(edges[0], edges[1], axis)
            if _separates(axis, p, q, size):
                return True
    return False


@kernel
def _side_vector(p, q, e, out):
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
        inner = (
            _turn_of_corner(t[n], t[m], t[3 - n - m], i, j) if t.shape[0] == 3 else -_turn_of_corner(t[n], t[m], others[0], i, j)
        )
        if inner != 1 and inner != -1:
            answer = UNSURE
            continue
        beyond, within = 0, 0
        for o in range(others.shape[0]):
            side = _turn_of_corner(t[n], t[m], others[o], i, j)
            beyond += side == -inner
            within += side == inner
        if beyond == others.shape[0]:
            return 1
        if within == 0:
            answer = UNSURE
    return answer


@kernel
def _turn_of_corner(a, b, c, i, j):
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

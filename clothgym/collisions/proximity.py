"""What of one sheet is close to what: the query of self-collision.

Each vertex has a start, where it was when it was last looked around, and a limit: how far it may go from there, in any direction,
before that must be done anew.  A motion that all vertices share changes no distance: places are told in a frame that moves with the
sheet.  In it each vertex and triangle, and every two edges, without a common vertex are certified, in one of two ways:

* far apart: their vertices' limits, all used up, do not bring them together;
* tied: else their distance along a direction n is looked at in each substep, and may shrink to ``stop``.  As long as no vertex has
  gone farther than its bound, a share of the distance to all that it is tied to, nothing need be looked at.

Both hold along the straight way from one certified state to the next.  So only vertices that ask are looked around: those that have
come to their limit, and those of ties that have come too close.  All pairs of the leaves at an asking vertex are found anew, with
the distance that they have in the last certified state; there such a vertex has gone no way, any other what it has gone from
its start, which counts beside its limit.  All other pairs stay as they are.

Distances are taken in float64 and certified: with n the unit vector between the closest points, the least ``n.a`` of one side less
the largest ``n.b`` of the other is a lower bound of the distance for any n at all, so nothing rests on the closest points
being right.  (Closest points of slivers in float32 overestimate by half a millimetre.)

Per-vertex bounds instead of continuous collision detection: Chen, Hsu, Liu, Macklin, Yang and Yuksel, Offset Geometric
Contact, ACM Transactions on Graphics 44(4), 2025.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, uncounted
from clothgym.collisions.candidates import (
    along,
    between,
    enclose,
    far_edges,
    far_leaves,
    far_vertices,
    gaps_of_leaves,
    is_ridge,
    near_candidates,
)
from clothgym.collisions.closest import closest_on_segments, closest_on_triangle, segments_apart

LAYERED = 0.8  # share of the distance of leaves' vertices that a plane between them must show to bound their edges too
SHARE = 0.45  # of a tied pair's distance that each side may use before it is looked at; below a half
INSIDE = 0.999  # of a bound or limit that is used, for rounding
SLOP = 0.01  # share of the thickness that contacts may sink in: at rest they touch, and their impulses last
# what is told of each environment, see ``self_contact.SelfContacts``
ROWS, TOUCHING, CLAMPED, QUERIES, DROPPED, GAP, LAG, UNCERTAIN = 0, 1, 2, 3, 4, 5, 6, 7
REPORT = 8
# what is kept of a contact: its four particles, and the leaves that it belongs to, (room, MEMBERS)
LEAF, MEMBERS = 4, 6
# and its figures, (room, FIGURES): the gap is n.(sum of weights times positions), with n a unit vector from the second primitive to
# the first; the thickness is the gap at which it acts [m]
NORMAL, THICKNESS, FIGURES = 4, 7, 8  # after the weights
# of a tied pair: a unit vector from the second primitive to the first, and the distance along it that it keeps [m], (room, 4)
KEPT = 3
# and how many vertices are the first primitive's, how many all are, substeps for which it is held before it asks again or -1, the
# leaves that it belongs to, and the vertices, (room, TIE)
OWN, NUMBER, HELD, OWNERS, VERTICES, TIE = 0, 1, 2, 3, 5, 13
MARGIN = 1e-5  # of the certified distance, kept for rounding in float32 within 16 m of the origin [m]


@inlined
def gap_of_vertex(p, v, i, j, k):
    """Barycentric weights of the point of triangle ijk that is closest to vertex v, and the way from it to v [m]."""
    px, py, pz = p[v, 0], p[v, 1], p[v, 2]
    ax, ay, az = p[i, 0], p[i, 1], p[i, 2]
    bx, by, bz = p[j, 0], p[j, 1], p[j, 2]
    cx, cy, cz = p[k, 0], p[k, 1], p[k, 2]
    a, b, c = closest_on_triangle(px, py, pz, ax, ay, az, bx, by, bz, cx, cy, cz)
    return a, b, c, px - (a * ax + b * bx + c * cx), py - (a * ay + b * by + c * cy), pz - (a * az + b * bz + c * cz)


@inlined
def gap_of_edges(p, i, j, k, l):
    """Where on edges ij and kl they are closest, from 0 to 1, and the way from the second to the first [m]."""
    ax, ay, az = p[i, 0], p[i, 1], p[i, 2]
    bx, by, bz = p[j, 0], p[j, 1], p[j, 2]
    cx, cy, cz = p[k, 0], p[k, 1], p[k, 2]
    dx, dy, dz = p[l, 0], p[l, 1], p[l, 2]
    s, t = closest_on_segments(ax, ay, az, bx, by, bz, cx, cy, cz, dx, dy, dz)
    nx = (ax + s * (bx - ax)) - (cx + t * (dx - cx))
    ny = (ay + s * (by - ay)) - (cy + t * (dy - cy))
    nz = (az + s * (bz - az)) - (cz + t * (dz - cz))
    return s, t, nx, ny, nz


@inlined
def write(i, j, k, l, one, two, wi, wj, wk, wl, nx, ny, nz, thickness, count, particles, figures):
    """Write a contact down."""
    particles[count, 0], particles[count, 1], particles[count, 2], particles[count, 3] = i, j, k, l
    particles[count, LEAF], particles[count, LEAF + 1] = one, two
    figures[count, 0], figures[count, 1], figures[count, 2], figures[count, 3] = wi, wj, wk, wl
    figures[count, NORMAL], figures[count, NORMAL + 1], figures[count, NORMAL + 2] = nx, ny, nz
    figures[count, THICKNESS] = thickness


@inlined
def restrict(v, gap, tied, moved, bounds, limits):
    """Lower a vertex's bound to its share of a distance, or where the pair cannot be tied its limit."""
    left = INSIDE * (SHARE * (gap - MARGIN) - moved[v])
    bounds[v] = min(bounds[v], left * left if left > 0.0 else -1.0)
    if not tied:
        limits[v] = min(limits[v], left * left if left > 0.0 else 0.0)


@inlined
def tie(i, j, k, l, own, one, two, nx, ny, nz, gap, stop, standoff, held, moved, bounds, limits, tight, ties, planes):
    """Tie a pair, if there is room: the first ``own`` of its vertices, and the others, may not come closer than ``stop`` along a
    direction, or than ``standoff`` if a hand holds any.  A direction along which it is not apart certifies nothing: there it stays
    as it is."""
    tied = tight < ties.shape[0]
    restrict(i, gap, tied, moved, bounds, limits)
    restrict(j, gap, tied, moved, bounds, limits)
    restrict(k, gap, tied, moved, bounds, limits)
    restrict(l, gap, tied, moved, bounds, limits)
    if tied:
        ties[tight, OWN], ties[tight, NUMBER], ties[tight, HELD] = own, 4, -1
        ties[tight, OWNERS], ties[tight, OWNERS + 1] = one, two
        ties[tight, VERTICES], ties[tight, VERTICES + 1], ties[tight, VERTICES + 2], ties[tight, VERTICES + 3] = i, j, k, l
        keep = standoff if held[i] | held[j] | held[k] | held[l] else stop
        planes[tight, 0], planes[tight, 1], planes[tight, 2] = nx, ny, nz
        planes[tight, KEPT] = min(gap, keep) if gap > 0.0 else np.inf


@inlined
def certify_vertex(p, v, i, j, k):
    """Weights of the point of a triangle that is closest to a vertex, a unit vector from there to it, and their distance along
    that [m]."""
    a, b, c, nx, ny, nz = gap_of_vertex(p, v, i, j, k)
    square = nx * nx + ny * ny + nz * nz
    scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    farthest = max(along(p, i, nx, ny, nz), max(along(p, j, nx, ny, nz), along(p, k, nx, ny, nz)))
    return a, b, c, nx, ny, nz, along(p, v, nx, ny, nz) - farthest


@inlined
def certify_edges(p, i, j, k, l):
    """The same of two edges, and where on them they are closest."""
    s, t, nx, ny, nz = gap_of_edges(p, i, j, k, l)
    square = nx * nx + ny * ny + nz * nz
    scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    nearest = min(along(p, i, nx, ny, nz), along(p, j, nx, ny, nz))
    return s, t, nx, ny, nz, nearest - max(along(p, k, nx, ny, nz), along(p, l, nx, ny, nz))


@uncounted
def vertex_contacts(
    p, candidates, number, pairs, thickness, kept, strict, reach, wide, held, moved, bounds, limits, closest, ends, found, particles,
    figures, ties, planes, report,
):  # fmt: skip
    """Certify vertices and triangles, tie those which their limits do not keep apart, and write the contacts down.

    kept: the least thickness of a contact: one that is closer than ``thickness`` is pushed apart only so far, and beyond it only kept
    from coming closer.  There is one contact for each closest feature: a face's inside, or a border that this triangle stands for;
    of two vertices, which meet twice, the one of the lower number has it.  closest, ends: become the smallest distance of each group
    of candidates [m], and its direction, (groups, 4), and where its ties end, (groups,).
    """
    triangles, triangle_edges, vertex_owner, edge_owner = (
        pairs.triangles, pairs.triangle_edges, pairs.vertex_owner, pairs.edge_owner
    )  # fmt: skip
    stop, standoff, close = reach.stop, reach.standoff, thickness + reach.margin
    count, tight, least, dropped = found[0], found[1], report[GAP], 0
    for m in range(number):
        v, t, one, two, group = candidates[m, 0], candidates[m, 1], candidates[m, 2], candidates[m, 3], candidates[m, 4]
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c, nx, ny, nz, gap = certify_vertex(p, v, i, j, k)
        if strict and gap < wide[v] + max(wide[i], max(wide[j], wide[k])) + MARGIN:
            least = min(least, max(gap, 0.0))
            tie(v, i, j, k, 1, one, two, nx, ny, nz, gap, stop, standoff, held, moved, bounds, limits, tight, ties, planes)
            dropped += tight == ties.shape[0]
            tight += tight < ties.shape[0]
        ends[group] = tight
        if gap < closest[group, 0]:
            closest[group, 0], closest[group, 1], closest[group, 2], closest[group, 3] = gap, nx, ny, nz
        if gap <= 0.0 or gap > close:
            continue
        if b == 0.0 and c == 0.0:
            mine = vertex_owner[i] == t and v < i
        elif a == 0.0 and c == 0.0:
            mine = vertex_owner[j] == t and v < j
        elif a == 0.0 and b == 0.0:
            mine = vertex_owner[k] == t and v < k
        elif a == 0.0:
            mine = edge_owner[triangle_edges[t, 0]] == t
        elif b == 0.0:
            mine = edge_owner[triangle_edges[t, 1]] == t
        elif c == 0.0:
            mine = edge_owner[triangle_edges[t, 2]] == t
        else:
            mine = True
        if mine and count < particles.shape[0]:
            own = min(thickness, max(kept, gap / (1.0 - SLOP)))
            write(v, i, j, k, one, two, 1.0, -a, -b, -c, nx, ny, nz, own, count, particles, figures)
            count += 1
        elif mine:
            dropped += 1
    found[0], found[1], report[GAP] = count, tight, least
    report[DROPPED] += dropped


@uncounted
def edge_contacts(
    p, candidates, number, pairs, thickness, strict, reach, wide, held, moved, bounds, limits, found, particles, figures, ties,
    planes, report,
):  # fmt: skip
    """The same for edges: ridges of which both insides are closest; elsewhere vertices and triangles say the same.

    Only vertices and triangles that do not hang together push each other apart.  Where cloth is pinched, near pairs have no room
    for their thickness, and edges that are close become ridges and cease to be: what pushed them would never rest.
    """
    edges, triangles, edge_triangles = pairs.edges, pairs.triangles, pairs.edge_triangles
    stop, standoff, close = reach.stop, reach.standoff, thickness + reach.margin
    count, tight, least, dropped = found[0], found[1], report[GAP], 0
    for m in range(number):
        e, f, one, two = candidates[m, 0], candidates[m, 1], candidates[m, 2], candidates[m, 3]
        i, j, k, l = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
        apart = max(wide[i], wide[j]) + max(wide[k], wide[l]) + MARGIN
        if segments_apart(
            p[i, 0], p[i, 1], p[i, 2], p[j, 0], p[j, 1], p[j, 2], p[k, 0], p[k, 1], p[k, 2], p[l, 0], p[l, 1], p[l, 2], max(apart, close)
        ):  # fmt: skip
            continue
        s, t, nx, ny, nz, gap = certify_edges(p, i, j, k, l)
        if strict and gap < apart:
            least = min(least, max(gap, 0.0))
            tie(i, j, k, l, 2, one, two, nx, ny, nz, gap, stop, standoff, held, moved, bounds, limits, tight, ties, planes)
            dropped += tight == ties.shape[0]
            tight += tight < ties.shape[0]
        inside = (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
        if not inside or gap <= 0.0 or gap > close or not is_ridge(p, triangles, edge_triangles, e):
            continue
        if not is_ridge(p, triangles, edge_triangles, f):
            continue
        if count < particles.shape[0]:
            own = min(thickness, gap / (1.0 - SLOP))
            write(i, j, k, l, one, two, 1.0 - s, s, t - 1.0, -t, nx, ny, nz, own, count, particles, figures)
            count += 1
        else:
            dropped += 1
    found[0], found[1], report[GAP] = count, tight, least
    report[DROPPED] += dropped


@uncounted
def tie_layers(
    p, corners, leaves, number, gaps, closest, ends, reach, held, moved, bounds, limits, layered, found, ties, planes, report
):
    """Tie pairs of leaves of which a plane shows about the distance that their vertices have, instead of their vertices and
    triangles.

    gaps: what planes of the leaves show, see ``gaps_of_leaves``; the plane across the closest vertex' way may show more.
    ends: where each pair's ties end, of those since the number that stands behind; layered: becomes which they are, (pairs,).
    """
    first, kept = ends[number], ends[number]
    for pair in range(number):
        leaf, other = leaves[pair, 0], leaves[pair, 1]
        nx, ny, nz = closest[pair, 1], closest[pair, 2], closest[pair, 3]
        least = max(LAYERED * min(closest[pair, 0], gaps[pair, 4]), reach.stop)
        if gaps[pair, 0] < least and closest[pair, 0] < np.inf:
            gap = between(p, corners, leaf, other, nx, ny, nz)
            if gap > gaps[pair, 0]:
                gaps[pair, 0], gaps[pair, 1], gaps[pair, 2], gaps[pair, 3] = gap, nx, ny, nz
        layered[pair] = gaps[pair, 0] >= least
        last = max(ends[pair], first)
        for t in range(first, last if not layered[pair] else first):
            if kept < t:
                for c in range(TIE):
                    ties[kept, c] = ties[t, c]
                for c in range(4):
                    planes[kept, c] = planes[t, c]
            kept += 1
        first = last
    for pair in range(number):
        gap = gaps[pair, 0]
        if not layered[pair] or gap >= gaps[pair, 4] + MARGIN:
            continue
        leaf, other = leaves[pair, 0], leaves[pair, 1]
        tied, some = kept < ties.shape[0], False
        report[GAP] = min(report[GAP], gap)
        for m in range(4):
            v, u = corners[leaf, m], corners[other, m]
            restrict(v, gap, tied, moved, bounds, limits)
            restrict(u, gap, tied, moved, bounds, limits)
            some |= held[v] | held[u]
        if not tied:
            report[DROPPED] += 1
            continue
        nx, ny, nz = gaps[pair, 1], gaps[pair, 2], gaps[pair, 3]
        # the direction is from the second leaf to the first
        sign = 1.0 if along(p, corners[leaf, 0], nx, ny, nz) > along(p, corners[other, 0], nx, ny, nz) else -1.0
        ties[kept, OWN], ties[kept, NUMBER], ties[kept, HELD], ties[kept, OWNERS], ties[kept, OWNERS + 1] = 4, 8, -1, leaf, other
        for m in range(4):
            ties[kept, VERTICES + m], ties[kept, VERTICES + 4 + m] = corners[leaf, m], corners[other, m]
        planes[kept, 0], planes[kept, 1], planes[kept, 2] = sign * nx, sign * ny, sign * nz
        planes[kept, KEPT] = min(gap, reach.standoff if some else reach.stop)
        kept += 1
    found[1] = kept


@uncounted
def keep_others(active, count, tight, particles, figures, impulses, ties, planes, lost, lost_impulses, found):
    """Take out all contacts and tied pairs of active leaves; the others move up.  Returns how many contacts that are taken out
    pressed: their particles, (count, 4), and impulses, (count, 3), are in ``lost`` and ``lost_impulses``."""
    kept, pressed = 0, 0
    for c in range(count):
        if active[particles[c, LEAF]] or active[particles[c, LEAF + 1]]:
            jx, jy, jz = impulses[c, 0], impulses[c, 1], impulses[c, 2]
            if jx != 0 or jy != 0 or jz != 0:
                for m in range(4):
                    lost[pressed, m] = particles[c, m]
                lost_impulses[pressed, 0], lost_impulses[pressed, 1], lost_impulses[pressed, 2] = jx, jy, jz
                pressed += 1
            continue
        if kept < c:
            for m in range(MEMBERS):
                particles[kept, m] = particles[c, m]
            for m in range(FIGURES):
                figures[kept, m] = figures[c, m]
            for m in range(3):
                impulses[kept, m] = impulses[c, m]
        kept += 1
    found[0], kept = kept, 0
    for t in range(tight):
        if active[ties[t, OWNERS]] or active[ties[t, OWNERS + 1]]:
            continue
        if kept < t:
            for m in range(TIE):
                ties[kept, m] = ties[t, m]
            for m in range(4):
                planes[kept, m] = planes[t, m]
        kept += 1
    found[1] = kept
    return pressed


@inlined
def query(
    p, start, wide, around, moved, held, pairs, reach, strict, active, stale, box, ball, hulls, bounds, limits, found, particles,
    figures, ties, planes, report,
):  # fmt: skip
    """Look around the vertices that ask, of one environment; contacts and tied pairs of the leaves around these are to be taken out
    before.

    p: certified positions in the sheet's frame [m], (particles, 3) in float64; start: there, where each was looked around last, of
    those that ask where they are, (3, particles).  moved: how far they have gone from there; wide: and may go from where they are;
    around: and from their start [m], (particles,).  held: particles that hands hold; active: leaves around those that ask.
    box, ball, hulls: see ``candidates``; if they are stale, none is as it was.  bounds, limits: the squares of how far each vertex may go from its start
    [m^2], (particles,), which become lower.  found: how many contacts and how many tied pairs there are, (2,); they are in
    ``particles``, ``figures``, ``ties`` and ``planes``.  report: (REPORT,).
    """
    near, far, size = reach.near_thickness, reach.far_thickness, pairs.corners.shape[0]
    vertices, sides = near_candidates(p, wide, near + reach.margin, pairs, active)
    closest, ends = np.zeros((1, 4)), np.zeros(1, np.int64)
    vertex_contacts(
        p, vertices, vertices.shape[0], pairs, near, 0.0, strict, reach, wide, held, moved, bounds, limits, closest, ends, found,
        particles, figures, ties, planes, report,
    )  # fmt: skip
    edge_contacts(
        p, sides, sides.shape[0], pairs, near, strict, reach, wide, held, moved, bounds, limits, found, particles, figures, ties,
        planes, report,
    )  # fmt: skip
    enclose(start, around, pairs.corners, pairs.nodes, active, stale, box, ball, hulls, np.empty(pairs.nodes.shape[0], np.bool_))
    leaves = np.empty((8 * size + 1, 2), np.int32)
    number = far_leaves(pairs, active, ball, box, hulls, leaves)
    if number >= leaves.shape[0]:
        leaves = np.empty((number + 1, 2), np.int32)
        far_leaves(pairs, active, ball, box, hulls, leaves)
    gaps = np.empty((number, 5))
    number = gaps_of_leaves(p, pairs, wide, far + reach.margin, number, leaves, gaps)
    vertices = np.empty((4 * number, 5), np.int32)
    count = far_vertices(start, around, pairs, box, leaves, number, vertices)
    if count > vertices.shape[0]:
        vertices = np.empty((count, 5), np.int32)
        far_vertices(start, around, pairs, box, leaves, number, vertices)
    closest, ends, layered = np.full((number, 4), np.inf), np.zeros(number + 1, np.int64), np.zeros(number, np.bool_)
    ends[number] = found[1]
    vertex_contacts(
        p, vertices, count, pairs, far, far, strict, reach, wide, held, moved, bounds, limits, closest, ends, found, particles,
        figures, ties, planes, report,
    )  # fmt: skip
    if strict:
        tie_layers(
            p,
            pairs.corners,
            leaves,
            number,
            gaps,
            closest,
            ends,
            reach,
            held,
            moved,
            bounds,
            limits,
            layered,
            found,
            ties,
            planes,
            report,
        )
    edge_box, ridge = np.empty((7, pairs.own_edges.shape[0])), np.empty(pairs.own_edges.shape[0], np.bool_)
    sides = np.empty((8 * number + 1, 4), np.int32)
    count = far_edges(p, start, around, pairs, leaves, layered, number, edge_box, ridge, sides)
    if count >= sides.shape[0]:
        sides = np.empty((count + 1, 4), np.int32)
        far_edges(p, start, around, pairs, leaves, layered, number, edge_box, ridge, sides)
    edge_contacts(
        p,
        sides,
        count,
        pairs,
        far,
        strict,
        reach,
        wide,
        held,
        moved,
        bounds,
        limits,
        found,
        particles,
        figures,
        ties,
        planes,
        report,
    )

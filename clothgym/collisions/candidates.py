"""Which primitives of one sheet may be close: the broad phase of self-collision's query.

Each leaf has a box and a ball around all places that its vertices may come to before they are looked around again; they change
only with a leaf that is looked around, and a tree of boxes above them is refitted where they did.  Near pairs (see ``pairs``) are
found by the distances of their vertices.  What is left out cannot touch within its vertices' limits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.pairs import BEGIN, END, LEAVES, NEXT

TINY = 1e-300
ALL = 2**LEAVES - 1  # a bit for each leaf of a node
FLAT = 0.2  # angle [rad] up to which neighbouring faces are taken for flat: there vertices alone keep layers apart


class Reach(NamedTuple):
    """Distances of a query [m].

    limit: how far a vertex may go before it is looked around again, at least; fast ones up to ``most``.  near_thickness,
    far_thickness: of the cloth between near pairs, and between all others.  margin: beyond the thickness within which a pair becomes
    a contact.  stop: at which tied pairs are held.  standoff: distance at which what is held stops.
    """

    limit: float
    most: float
    near_thickness: float
    far_thickness: float
    margin: float
    stop: float
    standoff: float


@inlined
def along(p, v, nx, ny, nz):
    """Place of a vertex along a direction [m]."""
    return nx * p[v, 0] + ny * p[v, 1] + nz * p[v, 2]


@uncounted
def enclose(start, wide, corners, nodes, active, stale, box, ball, hulls, fresh):
    """Boxes, (6, leaves), and balls (centre and radius), (4, leaves), around those leaves that are active, or all if they are
    stale, and the boxes of the nodes that hold them, (6, nodes).

    start: places of the vertices [m], (3, particles); wide: how far around them they may be [m], (particles,).  fresh: becomes which
    nodes have changed, (nodes,).
    """
    for leaf in range(corners.shape[0]):
        if not (stale or active[leaf]):
            continue
        for c in range(3):
            low, high, middle = np.inf, -np.inf, 0.0
            for m in range(4):
                v = corners[leaf, m]
                place = np.float64(start[c, v])
                low, high, middle = min(low, place - wide[v]), max(high, place + wide[v]), middle + 0.25 * place
            box[c, leaf], box[3 + c, leaf], ball[c, leaf] = low, high, middle
        radius = 0.0
        for m in range(4):
            v = corners[leaf, m]
            dx, dy, dz = start[0, v] - ball[0, leaf], start[1, v] - ball[1, leaf], start[2, v] - ball[2, leaf]
            radius = max(radius, np.sqrt(dx * dx + dy * dy + dz * dz) + wide[v])
        ball[3, leaf] = radius
    for k in range(nodes.shape[0] - 1, -1, -1):
        one, begin, end = k + 1, nodes[k, BEGIN], nodes[k, END]
        if one < nodes[k, NEXT]:
            two = nodes[one, NEXT]
            fresh[k] = fresh[one] | fresh[two]
            if fresh[k]:
                for c in range(3):
                    hulls[c, k], hulls[3 + c, k] = min(hulls[c, one], hulls[c, two]), max(hulls[3 + c, one], hulls[3 + c, two])
            continue
        fresh[k] = stale
        for leaf in range(begin, end):
            fresh[k] |= active[leaf]
        if fresh[k]:
            for c in range(3):
                low, high = box[c, begin], box[3 + c, begin]
                for leaf in range(begin + 1, end):
                    low, high = min(low, box[c, leaf]), max(high, box[3 + c, leaf])
                hulls[c, k], hulls[3 + c, k] = low, high


@inlined
def within(box, ball, leaf, first, number):
    """Which of ``number`` leaves, from ``first`` on, may come to touch a leaf, as bits.

    All fit in a vector, for which their number must not be known to the compiler, nor their places be signed.
    """
    lx, ly, lz, hx, hy, hz = box[0, leaf], box[1, leaf], box[2, leaf], box[3, leaf], box[4, leaf], box[5, leaf]
    bx, by, bz, br = ball[0, leaf], ball[1, leaf], ball[2, leaf], ball[3, leaf]
    bits = 0
    for m in range(number):
        other = np.uint64(first + m)
        dx, dy, dz, r = ball[0, other] - bx, ball[1, other] - by, ball[2, other] - bz, ball[3, other] + br
        beyond = (box[0, other] > hx) | (box[1, other] > hy) | (box[2, other] > hz)
        beyond |= (lx > box[3, other]) | (ly > box[4, other]) | (lz > box[5, other])
        bits |= ((not beyond) & (dx * dx + dy * dy + dz * dz <= r * r)) << m
    return bits


@inlined
def out_of_reach(lx, ly, lz, hx, hy, hz, b, j):
    """Whether a box and box j of ``b`` are apart along an axis."""
    apart = (lx > b[3, j]) | (ly > b[4, j]) | (lz > b[5, j])
    return apart | (b[0, j] > hx) | (b[1, j] > hy) | (b[2, j] > hz)


@uncounted
def far_leaves(pairs, active, ball, box, hulls, out):
    """Pairs of leaves without a common vertex, one of them active, that may come to touch; returns how many, though no more are
    written than fit with one to spare."""
    nodes, beside, beside_nodes, beside_leaves = pairs.nodes, pairs.beside, pairs.beside_nodes, pairs.beside_leaves
    count, last = 0, out.shape[0] - 1
    for one in range(nodes.shape[0]):
        if nodes[one, NEXT] > one + 1:
            continue
        begin, number = nodes[one, BEGIN], nodes[one, END] - nodes[one, BEGIN]
        # a box around those of its leaves that are active
        asking = 0
        lx, ly, lz, hx, hy, hz = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
        for leaf in range(begin, begin + number):
            if active[leaf]:
                asking |= 1 << (leaf - begin)
                lx, ly, lz = min(lx, box[0, leaf]), min(ly, box[1, leaf]), min(lz, box[2, leaf])
                hx, hy, hz = max(hx, box[3, leaf]), max(hy, box[4, leaf]), max(hz, box[5, leaf])
        if asking == 0:
            continue
        # the tree, and in the same order what is beside it; a node that is out of reach is passed over with all that is in it
        two, next_beside = 0, beside[one]
        while two < nodes.shape[0]:
            inside, two = two, nodes[two, NEXT]
            if out_of_reach(lx, ly, lz, hx, hy, hz, hulls, inside):
                continue
            if two > inside + 1:
                two = inside + 1
                continue
            while next_beside < beside[one + 1] and beside_nodes[next_beside] < inside:
                next_beside += 1
            known = 0
            if next_beside < beside[one + 1] and beside_nodes[next_beside] == inside:
                known = beside_leaves[next_beside]
            first, others = nodes[inside, BEGIN], nodes[inside, END] - nodes[inside, BEGIN]
            for k in range(number):
                leaf = begin + k
                if not (asking >> k) & 1 or out_of_reach(
                    box[0, leaf], box[1, leaf], box[2, leaf], box[3, leaf], box[4, leaf], box[5, leaf], hulls, inside
                ):
                    continue
                bits = within(box, ball, leaf, first, others) & ~(known >> (LEAVES * k)) & ALL
                m = 0
                while bits > 0:
                    if bits & 1 and not (active[first + m] and first + m < leaf):
                        place = min(count, last)
                        out[place, 0], out[place, 1] = leaf, first + m
                        count += 1
                    bits >>= 1
                    m += 1
    return count


@uncounted
def close_vertices(p, wide, least, pairs, asking, known, rows, close):
    """Near pairs of vertices, of which one asks, so close that some of their primitives may touch or come within ``least`` [m];
    returns how many.

    rows: what is asked of each, (particles, 2): how far its triangles' vertices may go, at most [m], and the largest (length over rest
    length)^2, at least 1, of these triangles' edges.  known: whether that is known, (particles,).
    """
    partners, partner, slack = pairs.partners, pairs.partner, pairs.slack
    triangles, edges, triangle_edges, rest_edges = pairs.triangles, pairs.edges, pairs.triangle_edges, pairs.rest_edges
    begins, around = pairs.vertex_triangles, pairs.around_triangles
    particles = p.shape[0]
    for i in range(particles):
        known[i] = asking[i]
    for i in range(particles):
        if asking[i]:
            for q in range(partners[i], partners[i + 1]):
                known[partner[q]] = True
    for v in range(particles):
        if not known[v]:
            continue
        most, stretch = 0.0, 1.0
        for n in range(begins[v], begins[v + 1]):
            t = around[n]
            for m in range(3):
                e = triangle_edges[t, m]
                j, k = edges[e, 0], edges[e, 1]
                dx, dy, dz = p[j, 0] - p[k, 0], p[j, 1] - p[k, 1], p[j, 2] - p[k, 2]
                most, stretch = max(most, wide[triangles[t, m]]), max(stretch, (dx * dx + dy * dy + dz * dz) * rest_edges[e])
        rows[v, 0], rows[v, 1] = most, stretch
    number = 0
    for i in range(particles):
        if not asking[i]:
            continue
        x, y, z, far, stretch = p[i, 0], p[i, 1], p[i, 2], rows[i, 0], rows[i, 1]
        for q in range(partners[i], partners[i + 1]):
            j = partner[q]
            dx, dy, dz = p[j, 0] - x, p[j, 1] - y, p[j, 2] - z
            reach = max(far + rows[j, 0], least)
            near = dx * dx + dy * dy + dz * dz <= reach * reach + slack[q] * max(stretch, rows[j, 1])
            close[number] = q
            # of two that ask, each finds the other
            number += near & ((j > i) | (not asking[j]))
    return number


@uncounted
def list_near(pairs, active, close, number, seen, vertices, sides):
    """List the primitive pairs of near pairs of vertices, with a leaf that is active, see ``far_vertices`` and ``far_edges``;
    returns how many of each.  seen: nothing, (near primitive pairs,)."""
    near, near_list, near_pairs, near_corners = pairs.near, pairs.near_list, pairs.near_pairs, pairs.near_corners
    first, second = 0, 0
    for c in range(number):
        for m in range(near[close[c], 0], near[close[c], 1]):
            n = near_list[m]
            one, two = near_pairs[n, 2], near_pairs[n, 3]
            if seen[n] or not (active[one] or active[two]):
                continue
            seen[n] = True
            if n < near_corners:
                vertices[first, 0], vertices[first, 1], vertices[first, 2], vertices[first, 3] = (
                    near_pairs[n, 0],
                    near_pairs[n, 1],
                    one,
                    two,
                )
                vertices[first, 4] = 0
                first += 1
            else:
                sides[second, 0], sides[second, 1], sides[second, 2], sides[second, 3] = (
                    near_pairs[n, 0],
                    near_pairs[n, 1],
                    one,
                    two,
                )
                second += 1
    return first, second


@kernel
def near_candidates(p, wide, least, pairs, active):
    """Near pairs of primitives, of which a leaf is active, that may come as close as their vertices may go, or ``least`` [m]: see
    ``far_vertices`` and ``far_edges``."""
    corners, near, particles = pairs.corners, pairs.near, p.shape[0]
    asking, close = np.zeros(particles, np.bool_), np.empty(pairs.partner.shape[0] + 1, np.int32)
    for leaf in range(corners.shape[0]):
        if active[leaf]:
            for m in range(4):
                asking[corners[leaf, m]] = True
    number = close_vertices(p, wide, least, pairs, asking, np.empty(particles, np.bool_), np.empty((particles, 2)), close)
    room = 0
    for c in range(number):
        room += near[close[c], 1] - near[close[c], 0]
    vertices, sides = np.empty((room, 5), np.int32), np.empty((room, 4), np.int32)
    seen = np.zeros(pairs.near_pairs.shape[0] if number > 0 else 0, np.bool_)
    first, second = list_near(pairs, active, close, number, seen, vertices, sides)
    return vertices[:first], sides[:second]


@inlined
def face(p, triangles, t):
    """Unit normal of a triangle."""
    i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    scale = 1.0 / np.sqrt(cx * cx + cy * cy + cz * cz + TINY)
    return cx * scale, cy * scale, cz * scale


@inlined
def is_ridge(p, triangles, edge_triangles, e):
    """Whether an edge is a ridge: on the border, or if its faces differ by more than ``FLAT``."""
    s, t = edge_triangles[e, 0], edge_triangles[e, 1]
    ax, ay, az = face(p, triangles, s)
    bx, by, bz = face(p, triangles, t)
    return (s == t) | (not ax * bx + ay * by + az * bz >= 1.0 - 0.5 * FLAT * FLAT)


@inlined
def between(p, corners, leaf, other, nx, ny, nz):
    """Distance along a unit direction of two leaves that it separates [m], on whichever side; else negative."""
    i, j, k, l = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2], corners[leaf, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    i, j, k, l = corners[other, 0], corners[other, 1], corners[other, 2], corners[other, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    return max(low - max(max(a, b), max(c, d)), min(min(a, b), min(c, d)) - high)


@uncounted
def gaps_of_leaves(p, pairs, wide, least, number, leaves, gaps):
    """Keep those of ``number`` pairs of leaves that no plane keeps apart, as far as their vertices may go or by ``least`` [m], with the
    distance that a plane shows, its normal, and the distance that the limits may use up, (pairs, 5).  Returns how many.

    The planes are square to either leaf's first triangle.
    """
    corners, triangles, begins, own_triangles = pairs.corners, pairs.triangles, pairs.leaf_triangles, pairs.own_triangles
    count = 0
    for pair in range(number):
        leaf, other = leaves[pair, 0], leaves[pair, 1]
        nx, ny, nz = face(p, triangles, own_triangles[begins[leaf]])
        gap = between(p, corners, leaf, other, nx, ny, nz)
        mx, my, mz = face(p, triangles, own_triangles[begins[other]])
        second = between(p, corners, leaf, other, mx, my, mz)
        if second > gap:
            gap, nx, ny, nz = second, mx, my, mz
        own, others = 0.0, 0.0
        for m in range(4):
            own, others = max(own, wide[corners[leaf, m]]), max(others, wide[corners[other, m]])
        if gap < max(own + others, least):
            leaves[count, 0], leaves[count, 1] = leaf, other
            gaps[count, 0], gaps[count, 1], gaps[count, 2], gaps[count, 3], gaps[count, 4] = gap, nx, ny, nz, own + others
            count += 1
    return count


@uncounted
def far_vertices(start, around, pairs, box, leaves, number, out):
    """Vertices and triangles of ``number`` pairs of leaves that may come to touch, these leaves, and the number of the pair, (..., 5);
    returns how many, though no more than fit are written."""
    leaf_vertices, own_vertices = pairs.leaf_vertices, pairs.own_vertices
    leaf_triangles, own_triangles = pairs.leaf_triangles, pairs.own_triangles
    count = 0
    for pair in range(number):
        for way in range(2):
            leaf, other = leaves[pair, way], leaves[pair, 1 - way]
            lx, ly, lz, hx, hy, hz = box[0, other], box[1, other], box[2, other], box[3, other], box[4, other], box[5, other]
            for m in range(leaf_vertices[leaf], leaf_vertices[leaf + 1]):
                v = own_vertices[m]
                x, y, z, r = start[0, v], start[1, v], start[2, v], around[v]
                if (lx <= x + r) & (ly <= y + r) & (lz <= z + r) & (x - r <= hx) & (y - r <= hy) & (z - r <= hz):
                    for n in range(leaf_triangles[other], leaf_triangles[other + 1]):
                        if count < out.shape[0]:
                            out[count, 0], out[count, 1], out[count, 2], out[count, 3] = v, own_triangles[n], leaf, other
                            out[count, 4] = pair
                        count += 1
    return count


@uncounted
def far_edges(p, start, around, pairs, leaves, layered, number, box, ridge, out):
    """Edges of ``number`` pairs of leaves that may come to touch, of layered pairs only ridges, and these leaves, (..., 4); returns how
    many, though no more are written than fit with one to spare.

    box, ridge: room for what is known of edges in their leaves' order, (7, edges), (edges,).
    """
    edges, leaf_edges, own_edges = pairs.edges, pairs.leaf_edges, pairs.own_edges
    triangles, edge_triangles = pairs.triangles, pairs.edge_triangles
    for leaf in range(leaf_edges.shape[0] - 1):
        box[6, leaf_edges[leaf]] = np.inf
    count, last = 0, out.shape[0] - 1
    for pair in range(number):
        for way in range(2):
            leaf = leaves[pair, way]
            if box[6, leaf_edges[leaf]] < np.inf:
                continue
            for m in range(leaf_edges[leaf], leaf_edges[leaf + 1]):
                i, j = edges[own_edges[m], 0], edges[own_edges[m], 1]
                for c in range(3):
                    a, b = np.float64(start[c, i]), np.float64(start[c, j])
                    box[c, m], box[3 + c, m] = min(a - around[i], b - around[j]), max(a + around[i], b + around[j])
                ridge[m] = is_ridge(p, triangles, edge_triangles, own_edges[m])
                box[6, m] = 0.0
        leaf, other, any_edge = leaves[pair, 0], leaves[pair, 1], not layered[pair]
        begin, end = leaf_edges[other], leaf_edges[other + 1]
        for m in range(leaf_edges[leaf], leaf_edges[leaf + 1]):
            if not (any_edge or ridge[m]):
                continue
            lx, ly, lz, hx, hy, hz = box[0, m], box[1, m], box[2, m], box[3, m], box[4, m], box[5, m]
            for n in range(begin, end):
                place = min(count, last)
                out[place, 0], out[place, 1], out[place, 2], out[place, 3] = own_edges[m], own_edges[n], leaf, other
                near = (lx <= box[3, n]) & (ly <= box[4, n]) & (lz <= box[5, n])
                near &= (box[0, n] <= hx) & (box[1, n] <= hy) & (box[2, n] <= hz)
                count += near & (any_edge | ridge[n])
    return count

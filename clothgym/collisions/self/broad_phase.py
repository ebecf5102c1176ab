"""Broad phase of self-collision: which primitives of one sheet may be close.

Near pairs (see ``topology``) are ruled out by the distances of their vertices; all others by the boxes of a tree, by boxes, balls
and planes of leaves, and by boxes of primitives.  What is ruled out is farther apart than the query's reach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.self.topology import NODE_BEGIN, NODE_END, NODE_LEAVES, NODE_NEXT

TINY = 1e-300  # keeps the normal of a degenerate triangle finite [m^4]
ALL_LEAVES = 2**NODE_LEAVES - 1  # a bit for each leaf of a node
V_WIDE, V_STRETCH = 3, 4  # columns of ``near_rows``, after the position
FLAT = 0.2  # angle between neighboring faces [rad] up to which their edge is no ridge: there vertices alone keep layers apart


class Reach(NamedTuple):
    """Distances of a query [m].

    near, far: within which near pairs, and all others, are found.  near_thickness, far_thickness: thickness of the cloth between
    them.
    margin: beyond the thickness within which a pair becomes a contact.  stop: that gap constraints keep.  standoff: that they keep
    where a vertex is attached.
    at_rest: shortest distance at rest of primitives that share no vertex.
    """

    near: float
    far: float
    near_thickness: float
    far_thickness: float
    margin: float
    stop: float
    standoff: float
    at_rest: float


@inlined
def along(p, v, nx, ny, nz):
    """Coordinate of vertex v along a direction, n . p_v [m]."""
    return nx * p[v, 0] + ny * p[v, 1] + nz * p[v, 2]


@kernel
def near_rows(p, pairs, extra, rows):
    """What a test of near pairs reads of each vertex, side by side: ``rows``, (particles, 5).

    Its position [m]; the largest extra of its triangles, where that of a triangle is the largest of its vertices [m]; and the
    largest (length / rest length)^2, at least 1, of the edges of its triangles.
    """
    edges, triangles, triangle_edges = pairs.edges, pairs.triangles, pairs.triangle_edges
    # the stretch of each edge
    ratio = np.empty(edges.shape[0])
    for e in range(edges.shape[0]):
        i, j = edges[e, 0], edges[e, 1]
        dx, dy, dz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        ratio[e] = max((dx * dx + dy * dy + dz * dz) * pairs.rest_edges[e], 1.0)
    # the position of each vertex
    for v in range(p.shape[0]):
        rows[v, 0], rows[v, 1], rows[v, 2], rows[v, V_WIDE], rows[v, V_STRETCH] = p[v, 0], p[v, 1], p[v, 2], 0.0, 1.0
    # the largest extra and stretch of its triangles
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        wide = max(extra[i], max(extra[j], extra[k]))
        stretch = max(ratio[triangle_edges[t, 0]], max(ratio[triangle_edges[t, 1]], ratio[triangle_edges[t, 2]]))
        for v in (i, j, k):
            rows[v, V_WIDE], rows[v, V_STRETCH] = max(rows[v, V_WIDE], wide), max(rows[v, V_STRETCH], stretch)


@kernel
def come_close(rows, partners, partner, slack, near, out):
    """List near pairs of vertices some of whose primitives may be within reach.  Returns how many.

    A pair is listed if |p_i - p_j|^2 <= R^2 + slack stretch, with R the reach and both extras, and the slack at rest times the
    larger stretch a bound of the slack now (see ``topology``).  out: room for all and one more.
    """
    count = 0
    for i in range(rows.shape[0]):
        x, y, z, wide, stretch = rows[i, 0], rows[i, 1], rows[i, 2], near + rows[i, V_WIDE], rows[i, V_STRETCH]
        for q in range(partners[i], partners[i + 1]):
            j = partner[q]
            dx, dy, dz, within = rows[j, 0] - x, rows[j, 1] - y, rows[j, 2] - z, wide + rows[j, V_WIDE]
            # written without a branch: the next one takes the place of one that is ruled out
            out[count] = q
            count += dx * dx + dy * dy + dz * dz <= within * within + slack[q] * max(stretch, rows[j, V_STRETCH])
    return count


@apart
def near_candidates(p, pairs, near, extra):
    """Near pairs that may be within reach: vertex, triangle and group 0, (candidates, 3), and two edges, (candidates, 2)."""
    near_pairs, begins, near_list, vertex_triangles = pairs.near_pairs, pairs.near, pairs.near_list, pairs.vertex_triangles
    # close pairs of vertices
    rows, close = np.empty((p.shape[0], 5)), np.empty(pairs.partner.shape[0] + 1, np.int32)
    near_rows(p, pairs, extra, rows)
    number = come_close(rows, pairs.partners, pairs.partner, pairs.slack, near, close)
    # room for all their primitive pairs
    room = 0
    for c in range(number):
        room += begins[close[c] + 1] - begins[close[c]]
    corners, edges = np.zeros((room, 3), np.int32), np.empty((room, 2), np.int32)
    # each primitive pair once
    first, second = 0, 0
    seen = np.zeros(near_pairs.shape[0] if number > 0 else 0, np.bool_)
    for c in range(number):
        for m in range(begins[close[c]], begins[close[c] + 1]):
            n = near_list[m]
            if seen[n]:
                continue
            seen[n] = True
            if n < vertex_triangles:
                corners[first, 0], corners[first, 1] = near_pairs[n, 0], near_pairs[n, 1]
                first += 1
            else:
                edges[second, 0], edges[second, 1] = near_pairs[n, 0], near_pairs[n, 1]
                second += 1
    return corners[:first], edges[:second]


@kernel
def enclose(p, corners, nodes, extra, wide, box, ball, hulls):
    """Boxes, (6, leaves), and balls, center and radius, (4, leaves), around leaves, and boxes around nodes, ``hulls``, (6, nodes)
    [m].

    A box is its lower corner and its upper one.  All are wider by the largest extra of a leaf's vertices, ``wide``, (leaves,).
    """
    # leaves
    for leaf in range(corners.shape[0]):
        i, j, k, l = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2], corners[leaf, 3]
        wide[leaf] = max(max(extra[i], extra[j]), max(extra[k], extra[l]))
        for c in range(3):
            a, b, d, e = p[i, c], p[j, c], p[k, c], p[l, c]
            box[c, leaf] = min(min(a, b), min(d, e)) - wide[leaf]
            box[3 + c, leaf] = max(max(a, b), max(d, e)) + wide[leaf]
            ball[c, leaf] = 0.25 * (a + b + d + e)
        # the ball around the mean of the vertices
        square = 0.0
        for m in range(4):
            v = corners[leaf, m]
            dx, dy, dz = p[v, 0] - ball[0, leaf], p[v, 1] - ball[1, leaf], p[v, 2] - ball[2, leaf]
            square = max(square, dx * dx + dy * dy + dz * dz)
        ball[3, leaf] = np.sqrt(square) + wide[leaf]
    # nodes, children before parents
    for k in range(nodes.shape[0] - 1, -1, -1):
        one, begin, end = k + 1, nodes[k, NODE_BEGIN], nodes[k, NODE_END]
        for c in range(3):
            if one < nodes[k, NODE_NEXT]:
                two = nodes[one, NODE_NEXT]
                low, high = min(hulls[c, one], hulls[c, two]), max(hulls[3 + c, one], hulls[3 + c, two])
            else:
                low, high = box[c, begin], box[3 + c, begin]
                for leaf in range(begin, end):
                    low, high = min(low, box[c, leaf]), max(high, box[3 + c, leaf])
            hulls[c, k] = low
            hulls[3 + c, k] = high


@inlined
def within(box, ball, leaf, first, number, far):
    """Which of ``number`` leaves, from ``first`` on, may be within ``far`` of a leaf, as bits.

    They fit in a vector.  For that the compiler must not know their number, and their indices must be unsigned.
    """
    lx, ly, lz = box[0, leaf] - far, box[1, leaf] - far, box[2, leaf] - far
    hx, hy, hz = box[3, leaf] + far, box[4, leaf] + far, box[5, leaf] + far
    bx, by, bz, br = ball[0, leaf], ball[1, leaf], ball[2, leaf], ball[3, leaf] + far
    bits = 0
    for m in range(number):
        other = np.uint64(first + m)
        dx, dy, dz, r = ball[0, other] - bx, ball[1, other] - by, ball[2, other] - bz, ball[3, other] + br
        beyond = (box[0, other] > hx) | (box[1, other] > hy) | (box[2, other] > hz)
        beyond |= (lx > box[3, other]) | (ly > box[4, other]) | (lz > box[5, other])
        bits |= ((not beyond) & (dx * dx + dy * dy + dz * dz <= r * r)) << m
    return bits


@inlined
def leaves_within(box, first, number, hulls, node, far):
    """Which of ``number`` leaves, from ``first`` on, may be within ``far`` of a node, as bits; vectorized, too."""
    lx, ly, lz = hulls[0, node] - far, hulls[1, node] - far, hulls[2, node] - far
    hx, hy, hz = hulls[3, node] + far, hulls[4, node] + far, hulls[5, node] + far
    bits = 0
    for m in range(number):
        leaf = np.uint64(first + m)
        beyond = (box[0, leaf] > hx) | (box[1, leaf] > hy) | (box[2, leaf] > hz)
        beyond |= (lx > box[3, leaf]) | (ly > box[4, leaf]) | (lz > box[5, leaf])
        bits |= (not beyond) << m
    return bits


@kernel
def far_leaves(pairs, far, ball, box, hulls, out):
    """Find pairs of leaves without a common vertex that may be within ``far``.  Returns how many: if ``out``, (pairs, 2), has no
    room for all and one more, the last row is overwritten.
    """
    nodes, beside, beside_nodes, beside_leaves = pairs.nodes, pairs.beside, pairs.beside_nodes, pairs.beside_leaves
    count, last = 0, out.shape[0] - 1
    for one in range(nodes.shape[0]):
        # only nodes without children
        if nodes[one, NODE_NEXT] > one + 1:
            continue
        begin, number = nodes[one, NODE_BEGIN], nodes[one, NODE_END] - nodes[one, NODE_BEGIN]
        # traverse the nodes from this one on, beside the list of adjacent ones, which is in the same order; a node that is out of
        # reach is skipped with its subtree
        two, next_beside = one, beside[one]
        while two < nodes.shape[0]:
            node, two = two, nodes[two, NODE_NEXT]
            if out_of_reach(hulls, one, hulls, node, far):
                continue
            # a node with children: go on with these
            if two > node + 1:
                two = node + 1
                continue
            # pairs of leaves that are not searched
            while next_beside < beside[one + 1] and beside_nodes[next_beside] < node:
                next_beside += 1
            excluded = 0
            if next_beside < beside[one + 1] and beside_nodes[next_beside] == node:
                excluded = beside_leaves[next_beside]
            # the leaves of this node that may be within reach of the other node, and then of its leaves
            first, others = nodes[node, NODE_BEGIN], nodes[node, NODE_END] - nodes[node, NODE_BEGIN]
            reached = leaves_within(box, begin, number, hulls, node, far)
            for k in range(number):
                searched = ~(excluded >> (NODE_LEAVES * k)) & ALL_LEAVES
                if not (reached >> k) & 1 or searched == 0:
                    continue
                bits = within(box, ball, begin + k, first, others, far) & searched
                if bits == 0:
                    continue
                # written without a branch, which would be unpredictable: the next one takes the place of one that is ruled out
                for m in range(NODE_LEAVES):
                    place = min(count, last)
                    out[place, 0], out[place, 1] = begin + k, first + m
                    count += (bits >> m) & 1
    return count


@inlined
def out_of_reach(a, i, b, j, far):
    """Whether box i of ``a`` and box j of ``b`` are farther apart than ``far`` along an axis; boxes: (6, boxes) [m]."""
    apart = (a[0, i] > b[3, j] + far) | (a[1, i] > b[4, j] + far) | (a[2, i] > b[5, j] + far)
    return apart | (b[0, j] > a[3, i] + far) | (b[1, j] > a[4, i] + far) | (b[2, j] > a[5, i] + far)


@kernel
def faces_of(p, triangles, faces):
    """Unit normals of triangles: ``faces``, (3, triangles)."""
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        faces[0, t], faces[1, t], faces[2, t] = cx, cy, cz
    # a loop of its own, so that the roots are vectorized
    for t in range(triangles.shape[0]):
        cx, cy, cz = faces[0, t], faces[1, t], faces[2, t]
        scale = 1.0 / np.sqrt(cx * cx + cy * cy + cz * cz + TINY)
        faces[0, t], faces[1, t], faces[2, t] = cx * scale, cy * scale, cz * scale


@kernel
def ridges_of(faces, edge_triangles, ridges):
    """Which edges are ridges, (edges,): those on the border, and those whose faces meet at an angle above ``FLAT``."""
    # cos FLAT to second order
    least = 1.0 - 0.5 * FLAT * FLAT
    for e in range(edge_triangles.shape[0]):
        s, t = edge_triangles[e, 0], edge_triangles[e, 1]
        turn = faces[0, s] * faces[0, t] + faces[1, s] * faces[1, t] + faces[2, s] * faces[2, t]
        ridges[e] = (s == t) | (not turn >= least)


@inlined
def between(p, corners, leaf, other, nx, ny, nz):
    """Distance of two leaves along a unit direction n [m], whichever is in front: min n . p of one less max n . p of the other.  It
    is negative where n does not separate them.
    """
    i, j, k, l = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2], corners[leaf, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    i, j, k, l = corners[other, 0], corners[other, 1], corners[other, 2], corners[other, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    return max(low - max(max(a, b), max(c, d)), min(min(a, b), min(c, d)) - high)


@kernel
def gaps_of_leaves(p, corners, faces, leaf_triangles, own_triangles, far, wide, found, number, gaps):
    """Keep those of the first ``number`` pairs of leaves in ``found`` that no plane shows to be out of reach.  Returns how many.

    The planes are parallel to the first triangle of either leaf.  gaps: becomes the larger distance that they certify [m], negative
    if neither separates the leaves, and its normal, (pairs, 4).
    """
    count = 0
    for pair in range(number):
        leaf, other = found[pair, 0], found[pair, 1]
        # the larger of both distances
        s, t = own_triangles[leaf_triangles[leaf]], own_triangles[leaf_triangles[other]]
        gap = between(p, corners, leaf, other, faces[0, s], faces[1, s], faces[2, s])
        second = between(p, corners, leaf, other, faces[0, t], faces[1, t], faces[2, t])
        if second > gap:
            gap, s = second, t
        # keep the pair
        if gap < far + wide[leaf] + wide[other]:
            found[count, 0], found[count, 1] = leaf, other
            gaps[count, 0], gaps[count, 1], gaps[count, 2], gaps[count, 3] = gap, faces[0, s], faces[1, s], faces[2, s]
            count += 1
    return count


@kernel
def far_vertices(p, leaves, box, far, wide, leaf_vertices, own_vertices, leaf_triangles, own_triangles, out):
    """Find vertices and triangles of pairs of leaves that may be close, with the number of the pair: ``out``, (candidates, 3).
    Returns how many there are; only those for which there is room are written.
    """
    count = 0
    for pair in range(leaves.shape[0]):
        for way in range(2):
            leaf, other = leaves[pair, way], leaves[pair, 1 - way]
            # the box of the other leaf, within reach
            r = far + wide[leaf]
            lx, ly, lz = box[0, other] - r, box[1, other] - r, box[2, other] - r
            hx, hy, hz = box[3, other] + r, box[4, other] + r, box[5, other] + r
            # each vertex in it, with all triangles of that leaf
            for m in range(leaf_vertices[leaf], leaf_vertices[leaf + 1]):
                v = own_vertices[m]
                x, y, z = p[v, 0], p[v, 1], p[v, 2]
                if (lx <= x) & (ly <= y) & (lz <= z) & (x <= hx) & (y <= hy) & (z <= hz):
                    for n in range(leaf_triangles[other], leaf_triangles[other + 1]):
                        if count < out.shape[0]:
                            out[count, 0], out[count, 1], out[count, 2] = v, own_triangles[n], pair
                        count += 1
    return count


@kernel
def far_edges(p, leaves, layered, ridges, far, extra, leaf_edges, own_edges, edges, out):
    """Find edges of pairs of leaves that may be close: ``out``, (candidates, 2); only ridges for a layered pair (see
    ``narrow_phase``).  Returns how many: if there is no room for all and one more, the last row is overwritten.
    """
    count, last, size = 0, out.shape[0] - 1, own_edges.shape[0]
    # boxes around edges, wider by their extra, in the order of the leaves
    box, ridge = np.empty((6, size)), np.empty(size, np.bool_)
    for m in range(size):
        e = own_edges[m]
        i, j = edges[e, 0], edges[e, 1]
        wide = max(extra[i], extra[j])
        for c in range(3):
            a, b = p[i, c], p[j, c]
            box[c, m], box[3 + c, m] = min(a, b) - wide, max(a, b) + wide
        ridge[m] = ridges[e]
    # edges whose boxes are within reach; written without a branch
    for pair in range(leaves.shape[0]):
        leaf, other, any_edge = leaves[pair, 0], leaves[pair, 1], not layered[pair]
        begin, end = leaf_edges[other], leaf_edges[other + 1]
        for m in range(leaf_edges[leaf], leaf_edges[leaf + 1]):
            if not (any_edge or ridge[m]):
                continue
            lx, ly, lz = box[0, m] - far, box[1, m] - far, box[2, m] - far
            hx, hy, hz = box[3, m] + far, box[4, m] + far, box[5, m] + far
            for n in range(begin, end):
                place = min(count, last)
                out[place, 0], out[place, 1] = own_edges[m], own_edges[n]
                near = (lx <= box[3, n]) & (ly <= box[4, n]) & (lz <= box[5, n])
                near &= (box[0, n] <= hx) & (box[1, n] <= hy) & (box[2, n] <= hz)
                count += near & (any_edge or ridge[n])
    return count


@apart
def far_pairs(p, pairs, far, extra, faces):
    """Pairs of leaves without a common vertex that may be within ``far``: (pairs, 2), the distance that a plane certifies [m] and
    its normal, (pairs, 4), and their vertices and triangles that may be close, with the number of the pair, (candidates, 3).
    """
    # boxes and balls
    corners, size = pairs.corners, pairs.corners.shape[0]
    box, ball = np.empty((6, size)), np.empty((4, size))
    hulls, wide = np.empty((6, pairs.nodes.shape[0])), np.empty(size)
    enclose(p, corners, pairs.nodes, extra, wide, box, ball, hulls)
    # pairs of leaves; with more room if there was too little
    found = np.empty((16 * size, 2), np.int32)
    number = far_leaves(pairs, far, ball, box, hulls, found)
    if number >= found.shape[0]:
        found = np.empty((number + 1, 2), np.int32)
        far_leaves(pairs, far, ball, box, hulls, found)
    # those that no plane rules out
    gaps = np.empty((number, 4))
    number = gaps_of_leaves(p, corners, faces, pairs.leaf_triangles, pairs.own_triangles, far, wide, found, number, gaps)
    leaves = found[:number]
    # their vertices and triangles
    vertices = np.empty((4 * number, 3), np.int32)
    owned = pairs.leaf_vertices, pairs.own_vertices, pairs.leaf_triangles, pairs.own_triangles
    count = far_vertices(p, leaves, box, far, wide, owned[0], owned[1], owned[2], owned[3], vertices)
    if count > vertices.shape[0]:
        vertices = np.empty((count, 3), np.int32)
        far_vertices(p, leaves, box, far, wide, owned[0], owned[1], owned[2], owned[3], vertices)
    return leaves, gaps[:number], vertices[:count]


@apart
def far_sides(p, pairs, leaves, layered, ridges, far, extra):
    """Edges of those pairs of leaves that may be close, (candidates, 2); only ridges for a layered pair."""
    sides = np.empty((4 * leaves.shape[0] + 1, 2), np.int32)
    count = far_edges(p, leaves, layered, ridges, far, extra, pairs.leaf_edges, pairs.own_edges, pairs.edges, sides)
    if count >= sides.shape[0]:
        sides = np.empty((count + 1, 2), np.int32)
        far_edges(p, leaves, layered, ridges, far, extra, pairs.leaf_edges, pairs.own_edges, pairs.edges, sides)
    return sides[:count]

"""Which primitives of one sheet may be close: the broad phase of self-collision's query.

Near pairs (see ``topology``) by the distances of their vertices; all others by the boxes of a tree, boxes, balls and planes of
leaves, and boxes of primitives.  What is left out is surely farther apart than the query's reach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.self.topology import NODE_BEGIN, NODE_END, NODE_LEAVES, NODE_NEXT

TINY = 1e-300
ALL_LEAVES = 2**NODE_LEAVES - 1  # a bit for each leaf of a node
V_WIDE, V_STRETCH = 3, 4  # in a row of ``near_rows``
FLAT = 0.2  # angle [rad] up to which neighbouring faces are taken for flat: there vertices alone keep layers apart


class Reach(NamedTuple):
    """Distances of a query [m].

    near, far: within which near pairs, and all others, are found.  near_thickness, far_thickness: of the cloth there.
    margin: beyond the thickness within which a pair becomes a contact.  stop: at which gap constraints are held.
    standoff: distance at which what is held stops.
    """

    near: float
    far: float
    near_thickness: float
    far_thickness: float
    margin: float
    stop: float
    standoff: float


@inlined
def along(p, v, nx, ny, nz):
    """Place of a vertex along a direction [m]."""
    return nx * p[v, 0] + ny * p[v, 1] + nz * p[v, 2]


@kernel
def near_rows(p, pairs, extra, rows):
    """What is asked of each vertex of a near pair, side by side, (particles, 5): its place [m]; the most that its triangles look
    farther, since a primitive's extra is the largest of its vertices [m]; and the largest (length over rest length)^2, at least 1,
    of the edges of its triangles."""
    edges, triangles, triangle_edges = pairs.edges, pairs.triangles, pairs.triangle_edges
    ratio = np.empty(edges.shape[0])
    for e in range(edges.shape[0]):
        i, j = edges[e, 0], edges[e, 1]
        dx, dy, dz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        ratio[e] = max((dx * dx + dy * dy + dz * dz) * pairs.rest_edges[e], 1.0)
    for v in range(p.shape[0]):
        rows[v, 0], rows[v, 1], rows[v, 2], rows[v, V_WIDE], rows[v, V_STRETCH] = p[v, 0], p[v, 1], p[v, 2], 0.0, 1.0
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        wide = max(extra[i], max(extra[j], extra[k]))
        stretch = max(ratio[triangle_edges[t, 0]], max(ratio[triangle_edges[t, 1]], ratio[triangle_edges[t, 2]]))
        for v in (i, j, k):
            rows[v, V_WIDE], rows[v, V_STRETCH] = max(rows[v, V_WIDE], wide), max(rows[v, V_STRETCH], stretch)


@kernel
def come_close(rows, partners, partner, slack, near, out):
    """Near pairs of vertices that are so close that some of their primitives may be within reach; returns how many."""
    count = 0
    for i in range(rows.shape[0]):
        x, y, z, wide, stretch = rows[i, 0], rows[i, 1], rows[i, 2], near + rows[i, V_WIDE], rows[i, V_STRETCH]
        for q in range(partners[i], partners[i + 1]):
            j = partner[q]
            dx, dy, dz, within = rows[j, 0] - x, rows[j, 1] - y, rows[j, 2] - z, wide + rows[j, V_WIDE]
            out[count] = q
            count += dx * dx + dy * dy + dz * dz <= within * within + slack[q] * max(stretch, rows[j, V_STRETCH])
    return count


@apart
def near_candidates(p, pairs, near, extra):
    """Near pairs of primitives of which some vertices have come close: vertices and triangles, (candidates, 3), and edges
    and edges, (candidates, 2)."""
    near_pairs, begins, near_list, vertex_triangles = pairs.near_pairs, pairs.near, pairs.near_list, pairs.vertex_triangles
    rows, close = np.empty((p.shape[0], 5)), np.empty(pairs.partner.shape[0] + 1, np.int32)
    near_rows(p, pairs, extra, rows)
    number = come_close(rows, pairs.partners, pairs.partner, pairs.slack, near, close)
    room = 0
    for c in range(number):
        room += begins[close[c] + 1] - begins[close[c]]
    corners, edges = np.zeros((room, 3), np.int32), np.empty((room, 2), np.int32)
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
    """Boxes, (6, leaves), and balls (centre and radius), (4, leaves), around leaves, wider by their extra, ``wide``, (leaves,), and
    boxes around nodes, (6, nodes)."""
    for leaf in range(corners.shape[0]):
        i, j, k, l = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2], corners[leaf, 3]
        wide[leaf] = max(max(extra[i], extra[j]), max(extra[k], extra[l]))
        for c in range(3):
            a, b, d, e = p[i, c], p[j, c], p[k, c], p[l, c]
            box[c, leaf] = min(min(a, b), min(d, e)) - wide[leaf]
            box[3 + c, leaf] = max(max(a, b), max(d, e)) + wide[leaf]
            ball[c, leaf] = 0.25 * (a + b + d + e)
        square = 0.0
        for m in range(4):
            v = corners[leaf, m]
            dx, dy, dz = p[v, 0] - ball[0, leaf], p[v, 1] - ball[1, leaf], p[v, 2] - ball[2, leaf]
            square = max(square, dx * dx + dy * dy + dz * dz)
        ball[3, leaf] = np.sqrt(square) + wide[leaf]
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
    """Which of ``number`` leaves, from ``first`` on, may be within a leaf's reach, as bits.

    All fit in a vector, for which their number must not be known to the compiler, nor their places be signed.
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
    """Which of ``number`` leaves, from ``first`` on, may be within reach of a node, as bits; a vector, too."""
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
    """Pairs of leaves without a common vertex that may be within reach; returns how many, though no more are written than fit
    with one to spare."""
    nodes, beside, beside_nodes, beside_leaves = pairs.nodes, pairs.beside, pairs.beside_nodes, pairs.beside_leaves
    count, last = 0, out.shape[0] - 1
    for one in range(nodes.shape[0]):
        if nodes[one, NODE_NEXT] > one + 1:
            continue
        begin, number = nodes[one, NODE_BEGIN], nodes[one, NODE_END] - nodes[one, NODE_BEGIN]
        # what comes after it in the tree, and of that, in the same order, what is beside it; a node that is out of reach is passed
        # over with all that is in it
        two, next_beside = one, beside[one]
        while two < nodes.shape[0]:
            inside, two = two, nodes[two, NODE_NEXT]
            if out_of_reach(hulls, one, hulls, inside, far):
                continue
            if two > inside + 1:
                two = inside + 1
                continue
            while next_beside < beside[one + 1] and beside_nodes[next_beside] < inside:
                next_beside += 1
            known = 0
            if next_beside < beside[one + 1] and beside_nodes[next_beside] == inside:
                known = beside_leaves[next_beside]
            first, others = nodes[inside, NODE_BEGIN], nodes[inside, NODE_END] - nodes[inside, NODE_BEGIN]
            some = leaves_within(box, begin, number, hulls, inside, far)
            for k in range(number):
                searched = ~(known >> (NODE_LEAVES * k)) & ALL_LEAVES
                if not (some >> k) & 1 or searched == 0:
                    continue
                bits = within(box, ball, begin + k, first, others, far) & searched
                if bits == 0:
                    continue
                # all are written, without a branch that no processor could foresee; the next takes the place of one not to be kept
                for m in range(NODE_LEAVES):
                    place = min(count, last)
                    out[place, 0], out[place, 1] = begin + k, first + m
                    count += (bits >> m) & 1
    return count


@inlined
def out_of_reach(a, i, b, j, far):
    """Whether box i of ``a`` and box j of ``b`` are farther apart than ``far`` along an axis."""
    apart = (a[0, i] > b[3, j] + far) | (a[1, i] > b[4, j] + far) | (a[2, i] > b[5, j] + far)
    return apart | (b[0, j] > a[3, i] + far) | (b[1, j] > a[4, i] + far) | (b[2, j] > a[5, i] + far)


@kernel
def faces_of(p, triangles, faces):
    """Unit normals of triangles, (3, triangles)."""
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        faces[0, t], faces[1, t], faces[2, t] = cx, cy, cz
    for t in range(triangles.shape[0]):  # side by side: roots of many at once
        cx, cy, cz = faces[0, t], faces[1, t], faces[2, t]
        scale = 1.0 / np.sqrt(cx * cx + cy * cy + cz * cz + TINY)
        faces[0, t], faces[1, t], faces[2, t] = cx * scale, cy * scale, cz * scale


@kernel
def ridges_of(faces, edge_triangles, ridges):
    """Which edges are ridges: those on the border, and those whose faces differ by more than ``FLAT``."""
    least = 1.0 - 0.5 * FLAT * FLAT
    for e in range(edge_triangles.shape[0]):
        s, t = edge_triangles[e, 0], edge_triangles[e, 1]
        turn = faces[0, s] * faces[0, t] + faces[1, s] * faces[1, t] + faces[2, s] * faces[2, t]
        ridges[e] = (s == t) | (not turn >= least)


@inlined
def between(p, corners, leaf, other, nx, ny, nz):
    """Distance along a unit direction of two leaves that it separates [m], on whichever side; else negative."""
    i, j, k, l = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2], corners[leaf, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    i, j, k, l = corners[other, 0], corners[other, 1], corners[other, 2], corners[other, 3]
    a, b, c, d = along(p, i, nx, ny, nz), along(p, j, nx, ny, nz), along(p, k, nx, ny, nz), along(p, l, nx, ny, nz)
    return max(low - max(max(a, b), max(c, d)), min(min(a, b), min(c, d)) - high)


@kernel
def gaps_of_leaves(p, corners, faces, leaf_triangles, own_triangles, far, wide, found, number, gaps):
    """Keep those of ``number`` pairs of leaves that no plane shows to be out of reach, with the distance that a plane shows, below
    zero if none does, and the plane's normal, (pairs, 4).  Returns how many.

    The planes are square to either leaf's first triangle.
    """
    count = 0
    for pair in range(number):
        leaf, other = found[pair, 0], found[pair, 1]
        s, t = own_triangles[leaf_triangles[leaf]], own_triangles[leaf_triangles[other]]
        gap = between(p, corners, leaf, other, faces[0, s], faces[1, s], faces[2, s])
        second = between(p, corners, leaf, other, faces[0, t], faces[1, t], faces[2, t])
        if second > gap:
            gap, s = second, t
        if gap < far + wide[leaf] + wide[other]:
            found[count, 0], found[count, 1] = leaf, other
            gaps[count, 0], gaps[count, 1], gaps[count, 2], gaps[count, 3] = gap, faces[0, s], faces[1, s], faces[2, s]
            count += 1
    return count


@kernel
def far_vertices(p, leaves, box, far, wide, leaf_vertices, own_vertices, leaf_triangles, own_triangles, out):
    """Vertices and triangles of leaves' pairs that may be close, with the number of the pair; returns how many, though no more than
    fit are written."""
    count = 0
    for pair in range(leaves.shape[0]):
        for way in range(2):
            leaf, other = leaves[pair, way], leaves[pair, 1 - way]
            r = far + wide[leaf]
            lx, ly, lz = box[0, other] - r, box[1, other] - r, box[2, other] - r
            hx, hy, hz = box[3, other] + r, box[4, other] + r, box[5, other] + r
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
    """Edges of leaves' pairs that may be close, of layered pairs only ridges; returns how many, though no more are written than fit
    with one to spare."""
    count, last, size = 0, out.shape[0] - 1, own_edges.shape[0]
    # boxes around edges, wider by their extra, in their leaves' order
    box, ridge = np.empty((6, size)), np.empty(size, np.bool_)
    for m in range(size):
        e = own_edges[m]
        i, j = edges[e, 0], edges[e, 1]
        wide = max(extra[i], extra[j])
        for c in range(3):
            a, b = p[i, c], p[j, c]
            box[c, m], box[3 + c, m] = min(a, b) - wide, max(a, b) + wide
        ridge[m] = ridges[e]
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
    """Pairs of leaves without a common vertex to look into, (pairs, 2), the distance that a plane shows them to have [m] and
    its normal, (pairs, 4), and their vertices and triangles that may be close, with the number of the pair, (candidates, 3)."""
    corners, size = pairs.corners, pairs.corners.shape[0]
    box, ball = np.empty((6, size)), np.empty((4, size))
    hulls, wide = np.empty((6, pairs.nodes.shape[0])), np.empty(size)
    enclose(p, corners, pairs.nodes, extra, wide, box, ball, hulls)
    found = np.empty((16 * size, 2), np.int32)
    number = far_leaves(pairs, far, ball, box, hulls, found)
    if number >= found.shape[0]:
        found = np.empty((number + 1, 2), np.int32)
        far_leaves(pairs, far, ball, box, hulls, found)
    gaps = np.empty((number, 4))
    number = gaps_of_leaves(p, corners, faces, pairs.leaf_triangles, pairs.own_triangles, far, wide, found, number, gaps)
    leaves = found[:number]
    vertices = np.empty((4 * number, 3), np.int32)
    owned = pairs.leaf_vertices, pairs.own_vertices, pairs.leaf_triangles, pairs.own_triangles
    count = far_vertices(p, leaves, box, far, wide, owned[0], owned[1], owned[2], owned[3], vertices)
    if count > vertices.shape[0]:
        vertices = np.empty((count, 3), np.int32)
        far_vertices(p, leaves, box, far, wide, owned[0], owned[1], owned[2], owned[3], vertices)
    return leaves, gaps[:number], vertices[:count]


@apart
def far_sides(p, pairs, leaves, layered, ridges, far, extra):
    """Edges of those pairs that may be close, (candidates, 2); of layered ones only ridges."""
    sides = np.empty((4 * leaves.shape[0] + 1, 2), np.int32)
    count = far_edges(p, leaves, layered, ridges, far, extra, pairs.leaf_edges, pairs.own_edges, pairs.edges, sides)
    if count >= sides.shape[0]:
        sides = np.empty((count + 1, 2), np.int32)
        far_edges(p, leaves, layered, ridges, far, extra, pairs.leaf_edges, pairs.own_edges, pairs.edges, sides)
    return sides[:count]

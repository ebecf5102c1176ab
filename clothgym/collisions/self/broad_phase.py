"""Broad phase of self-collision: which leaves of one sheet (see ``topology``) may be close.

Pairs of leaves are ruled out by the boxes of a tree, and by their own boxes, balls and planes: they are farther apart than the
query's reach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym._jit import disjoint, inlined, uncounted
from clothgym.collisions.self.topology import NODE_BEGIN, NODE_END, NODE_LEAVES, NODE_NEXT

TINY = 1e-300  # keeps the normal of a degenerate triangle finite [m^4]
ALL_LEAVES = 2**NODE_LEAVES - 1  # a bit for each leaf of a node
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


@disjoint
def _enclose_leaves(p, extra, corners, lx, ly, lz, hx, hy, hz, bx, by, bz, br, wide):
    """Boxes, lower and upper corner, and balls, center and radius, of all leaves, (leaves,) each [m]; see ``enclose``."""
    for leaf in range(wide.shape[0]):
        # as unsigned numbers, which can not count from the end
        i, j, k, l = (
            np.uint64(corners[leaf, 0]), np.uint64(corners[leaf, 1]), np.uint64(corners[leaf, 2]), np.uint64(corners[leaf, 3])
        )  # fmt: skip
        more = max(max(extra[i], extra[j]), max(extra[k], extra[l]))
        ax, bx_, cx, dx = p[i, 0], p[j, 0], p[k, 0], p[l, 0]
        ay, by_, cy, dy = p[i, 1], p[j, 1], p[k, 1], p[l, 1]
        az, bz_, cz, dz = p[i, 2], p[j, 2], p[k, 2], p[l, 2]
        lx[leaf], hx[leaf] = min(min(ax, bx_), min(cx, dx)) - more, max(max(ax, bx_), max(cx, dx)) + more
        ly[leaf], hy[leaf] = min(min(ay, by_), min(cy, dy)) - more, max(max(ay, by_), max(cy, dy)) + more
        lz[leaf], hz[leaf] = min(min(az, bz_), min(cz, dz)) - more, max(max(az, bz_), max(cz, dz)) + more
        # the ball around the mean of the vertices
        mx, my, mz = 0.25 * (ax + bx_ + cx + dx), 0.25 * (ay + by_ + cy + dy), 0.25 * (az + bz_ + cz + dz)
        a = (ax - mx) * (ax - mx) + (ay - my) * (ay - my) + (az - mz) * (az - mz)
        b = (bx_ - mx) * (bx_ - mx) + (by_ - my) * (by_ - my) + (bz_ - mz) * (bz_ - mz)
        c = (cx - mx) * (cx - mx) + (cy - my) * (cy - my) + (cz - mz) * (cz - mz)
        d = (dx - mx) * (dx - mx) + (dy - my) * (dy - my) + (dz - mz) * (dz - mz)
        bx[leaf], by[leaf], bz[leaf], br[leaf] = mx, my, mz, np.sqrt(max(max(a, b), max(c, d))) + more
        wide[leaf] = more


@uncounted
def enclose(p, corners, nodes, extra, wide, box, ball, hulls):
    """Boxes, (6, leaves), and balls, center and radius, (4, leaves), around leaves, and boxes around nodes, ``hulls``, (6, nodes)
    [m].

    A box is its lower corner and its upper one.  All are wider by the largest extra of a leaf's vertices, ``wide``, (leaves,).
    """
    _enclose_leaves(
        p, extra, corners, box[0], box[1], box[2], box[3], box[4], box[5], ball[0], ball[1], ball[2], ball[3], wide
    )  # fmt: skip
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


@uncounted
def far_leaves(tree, far, ball, box, hulls, begin_node, out):
    """Find pairs of leaves without a common vertex that may be within ``far``, from a node on.  Returns how many, and the node from
    which to go on when ``out``, (room, 2), is about to be full: it must have room for ``NODE_LEAVES`` pairs for each leaf and one.
    """
    nodes, adjacent, adjacent_nodes, adjacent_leaves = tree.nodes, tree.adjacent, tree.adjacent_nodes, tree.adjacent_leaves
    count, enough = 0, out.shape[0] - NODE_LEAVES * box.shape[1]
    for one in range(begin_node, nodes.shape[0]):
        if count >= enough:
            return count, one
        # only nodes without children
        if nodes[one, NODE_NEXT] > one + 1:
            continue
        begin, number = nodes[one, NODE_BEGIN], nodes[one, NODE_END] - nodes[one, NODE_BEGIN]
        # traverse the nodes from this one on, beside the list of adjacent ones, which is in the same order; a node that is out of
        # reach is skipped with its subtree
        two, next_adjacent = one, adjacent[one]
        while two < nodes.shape[0]:
            node, two = two, nodes[two, NODE_NEXT]
            if out_of_reach(hulls, one, hulls, node, far):
                continue
            # a node with children: go on with these
            if two > node + 1:
                two = node + 1
                continue
            # pairs of leaves that are not searched
            while next_adjacent < adjacent[one + 1] and adjacent_nodes[next_adjacent] < node:
                next_adjacent += 1
            excluded = 0
            if next_adjacent < adjacent[one + 1] and adjacent_nodes[next_adjacent] == node:
                excluded = adjacent_leaves[next_adjacent]
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
                    out[count, 0], out[count, 1] = begin + k, first + m
                    count += (bits >> m) & 1
    return count, nodes.shape[0]


@inlined
def out_of_reach(a, i, b, j, far):
    """Whether box i of ``a`` and box j of ``b`` are farther apart than ``far`` along an axis; boxes: (6, boxes) [m]."""
    apart = (a[0, i] > b[3, j] + far) | (a[1, i] > b[4, j] + far) | (a[2, i] > b[5, j] + far)
    return apart | (b[0, j] > a[3, i] + far) | (b[1, j] > a[4, i] + far) | (b[2, j] > a[5, i] + far)


@uncounted
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


@inlined
def is_ridge(faces, edge_triangles, e):
    """Whether edge e is a ridge: on the border, or where faces meet at an angle above ``FLAT``.  faces: see ``faces_of``."""
    s, t = edge_triangles[e, 0], edge_triangles[e, 1]
    turn = faces[0, s] * faces[0, t] + faces[1, s] * faces[1, t] + faces[2, s] * faces[2, t]
    # cos FLAT to second order
    return (s == t) | (not turn >= 1.0 - 0.5 * FLAT * FLAT)


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


@uncounted
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

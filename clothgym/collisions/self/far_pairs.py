"""Far pairs of a query: primitives of leaves that share no vertex (see ``topology``), by their boxes."""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, uncounted
from clothgym.collisions.self.broad_phase import enclose, far_leaves, gaps_of_leaves, is_ridge
from clothgym.collisions.self.narrow_phase import constrain_layers, edge_contacts, vertex_contacts
from clothgym.collisions.self.query_scratch import BATCH

MOST_OF_A_PAIR = 32  # pairs of primitives of two leaves, at most: four vertices or five edges and two triangles or five edges


@uncounted
def far_contacts(pairs, distances, extent, smooth, scratch, found):
    """Contacts and gap constraints of far pairs: vertices and triangles, layers, and then edges; arguments as in
    ``narrow_phase.vertex_contacts``."""
    tree, p, leaves, far = pairs.tree, scratch.p, scratch.leaves, distances.within
    enclose(p, tree.corners, tree.nodes, scratch.extra, scratch.wide, scratch.box, scratch.ball, scratch.hulls)
    # typed: a literal has a type of its own, for which what is called would be compiled again
    node, boxed = np.int64(0), False
    while node < tree.nodes.shape[0]:
        number, node = far_leaves(tree, far, scratch.ball, scratch.box, scratch.hulls, node, leaves)
        number = gaps_of_leaves(
            p, tree.corners, scratch.faces, tree.leaf_triangles, tree.own_triangles, far, scratch.wide, leaves, number, scratch.gaps
        )
        if number == 0:
            continue
        for pair in range(number):
            scratch.closest[pair, 0], scratch.closest[pair, 1], scratch.closest[pair, 2], scratch.closest[pair, 3] = (
                far,
                0.0,
                0.0,
                0.0,
            )
        first = found.counts[1]
        _far_vertices(number, pairs, distances, extent, smooth, scratch, found)
        constrain_layers(number, first, tree.corners, distances, scratch, found)
        if not boxed:
            scratch.boxed[:] = False
            boxed = True
        _far_edges(number, pairs, distances, extent, smooth, scratch, found)


@uncounted
def _far_vertices(number, pairs, distances, extent, smooth, scratch, found):
    """Vertices and triangles of the first ``number`` pairs of leaves, where a vertex is in the box of the other leaf."""
    tree, p, box, batch, filled = pairs.tree, scratch.p, scratch.box, scratch.pairs, np.int64(0)
    for pair in range(number):
        if filled > BATCH - MOST_OF_A_PAIR:
            vertex_contacts(filled, distances, pairs.parts, extent, smooth, scratch, found)
            filled = 0
        for way in range(2):
            leaf, other = scratch.leaves[pair, way], scratch.leaves[pair, 1 - way]
            # the box of the other leaf, within reach
            r = distances.within + scratch.wide[leaf]
            lx, ly, lz = box[0, other] - r, box[1, other] - r, box[2, other] - r
            hx, hy, hz = box[3, other] + r, box[4, other] + r, box[5, other] + r
            # each vertex in it, with all triangles of that leaf
            for m in range(tree.leaf_vertices[leaf], tree.leaf_vertices[leaf + 1]):
                v = tree.own_vertices[m]
                x, y, z = p[v, 0], p[v, 1], p[v, 2]
                if (lx <= x) & (ly <= y) & (lz <= z) & (x <= hx) & (y <= hy) & (z <= hz):
                    for n in range(tree.leaf_triangles[other], tree.leaf_triangles[other + 1]):
                        batch[0, filled], batch[1, filled], batch[2, filled] = v, tree.own_triangles[n], pair
                        filled += 1
    vertex_contacts(filled, distances, pairs.parts, extent, smooth, scratch, found)


@inlined
def _box_edges(leaf, tree, parts, scratch):
    """Boxes around the edges of a leaf, wider by their extra, and whether they are ridges, in the order of the leaves."""
    edges, p, extra, box = parts.edges, scratch.p, scratch.extra, scratch.edge_box
    for m in range(tree.leaf_edges[leaf], tree.leaf_edges[leaf + 1]):
        e = tree.own_edges[m]
        i, j = edges[e, 0], edges[e, 1]
        wide = max(extra[i], extra[j])
        scratch.ridges[m] = is_ridge(scratch.faces, parts.edge_triangles, e)
        for c in range(3):
            a, b = p[i, c], p[j, c]
            box[c, m], box[3 + c, m] = min(a, b) - wide, max(a, b) + wide


@uncounted
def _far_edges(number, pairs, distances, extent, smooth, scratch, found):
    """Edges of the first ``number`` pairs of leaves whose boxes are within reach; only ridges for a layered pair (see
    ``narrow_phase.constrain_layers``)."""
    tree, parts, box, ridges, batch, filled, far = (
        pairs.tree, pairs.parts, scratch.edge_box, scratch.ridges, scratch.pairs, np.int64(0), distances.within
    )  # fmt: skip
    for pair in range(number):
        if filled > BATCH - MOST_OF_A_PAIR:
            edge_contacts(filled, distances, parts, extent, smooth, scratch, found)
            filled = 0
        leaf, other, any_edge = scratch.leaves[pair, 0], scratch.leaves[pair, 1], not scratch.layered[pair]
        for one in (leaf, other):
            if not scratch.boxed[one]:
                scratch.boxed[one] = True
                _box_edges(one, tree, parts, scratch)
        for m in range(tree.leaf_edges[leaf], tree.leaf_edges[leaf + 1]):
            if not (any_edge or ridges[m]):
                continue
            e = tree.own_edges[m]
            lx, ly, lz = box[0, m] - far, box[1, m] - far, box[2, m] - far
            hx, hy, hz = box[3, m] + far, box[4, m] + far, box[5, m] + far
            for n in range(tree.leaf_edges[other], tree.leaf_edges[other + 1]):
                # written without a branch: the next one takes the place of one that is ruled out
                batch[0, filled], batch[1, filled] = e, tree.own_edges[n]
                near = (lx <= box[3, n]) & (ly <= box[4, n]) & (lz <= box[5, n])
                near &= (box[0, n] <= hx) & (box[1, n] <= hy) & (box[2, n] <= hz)
                filled += near & (any_edge | ridges[n])
    edge_contacts(filled, distances, parts, extent, smooth, scratch, found)

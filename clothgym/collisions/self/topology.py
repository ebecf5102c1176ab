"""Topology of self-collision: which vertices, edges and triangles of a sheet can touch, and their tree.  It follows from the mesh
alone.

Triangles are joined to leaves, two across an edge where possible (the quads of a grid).  Leaves are stored in the order of a k-d
tree of the flat sheet, so that a run of them, a node of the tree, is a compact patch.  Each vertex, edge and triangle belongs to
one leaf, so each pair of primitives is found in one pair of leaves only (after Curtis, Tamstorf and Manocha 2008).

Leaves that share a vertex always overlap.  Their pairs of primitives without a common vertex, the near pairs, are listed instead,
and a query rules them out by distances between vertices: for points P = sum a_i p_i and Q = sum b_j q_j with weights that sum to
one,

    |P - Q|^2 = sum a_i b_j |p_i - q_j|^2 - sum_{i<k} a_i a_k |p_i - p_k|^2 - sum_{j<l} b_j b_l |q_j - q_l|^2,

so the pair is farther than R apart if each ``|p_i - q_j|^2`` exceeds R^2 by the largest value of the last two sums, the slack.  The
largest value of such a sum is a quarter of the squared length for an edge, and for a triangle the squared radius of the smallest
circle around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions.self.spread import to_rest
from clothgym.mesh import ClothMesh

NODE_LEAVES = 8  # leaves in a node that is not split further, except the last: a vector of float64
NODE_BEGIN, NODE_END, NODE_NEXT = (
    0,
    1,
    2,
)  # columns of a node: its first leaf, one past its last, and the node that follows its subtree
MOST_OFFSETS = 32  # differences of near vertices' numbers: grids have 12
SAMPLES = 16  # vertices whose mean displacement stands for that of the whole sheet

Int = NDArray[np.int32]
Real = NDArray[np.float64]


class Parts(NamedTuple):
    """Primitives of a mesh and their neighbors.

    triangles, edges: vertices of each, (triangles, 3), (edges, 2); triangle_edges: the edge opposite each corner, (triangles, 3).
    edge_triangles: both triangles of each edge, (edges, 2), the same twice on the border.
    rest_edges: 1 / (rest length)^2 of each edge [1/m^2], (edges,).
    vertex_owner, edge_owner: the triangle that owns each in contacts, (particles,), (edges,).
    piece: which piece of the mesh each vertex belongs to, (particles,).
    around: where the triangles around each vertex begin in ``around_triangles``, (particles + 1,).
    """

    triangles: Int
    edges: Int
    triangle_edges: Int
    edge_triangles: Int
    rest_edges: Real
    vertex_owner: Int
    edge_owner: Int
    piece: Int
    around: Int
    around_triangles: Int


class Tree(NamedTuple):
    """Leaves and nodes of a mesh.  Ranges are given by where each begins, with the total at the end.

    corners: vertices of each leaf, the last repeated if there are three, (leaves, 4).
    leaf_vertices, leaf_edges, leaf_triangles: where those of each leaf begin in ``own_*``, (leaves + 1,).
    nodes: of the tree, each before its two children, the first of which follows it at once: see ``NODE_BEGIN``, (nodes, 3).
    adjacent: where the list of adjacent nodes begins for each node without children, itself and later ones, (nodes + 1,).
    adjacent_nodes: these lists; adjacent_leaves: for each entry the pairs of leaves not to be searched, as bits: leaf k of the
    first node and m of the second, which share a vertex or are found in the other order, are bit ``NODE_LEAVES * k + m``.
    """

    corners: Int
    leaf_vertices: Int
    own_vertices: Int
    leaf_edges: Int
    own_edges: Int
    leaf_triangles: Int
    own_triangles: Int
    nodes: Int
    adjacent: Int
    adjacent_nodes: Int
    adjacent_leaves: NDArray[np.int64]


class Near(NamedTuple):
    """Near pairs of vertices, and the near pairs of primitives that have them.

    first, second: vertices of each pair; slack: the largest of their primitive pairs, at rest [m^2], (near,).
    offsets: where the vertices of a grid are numbered by rows, the few differences of second and first vertex, (offsets,).  Then
    there is a row of pairs for each of them, with a pair for each first vertex, and a slack of -inf where there is none.
    begin: where the near pairs of each begin in ``which``, with the total at the end, (near + 1,); which: indices of
    ``primitives``, (list,).
    primitives: first and second, (near primitive pairs, 2): vertex and triangle for the first ``vertex_triangles``, then two edges.
    Both are filled up to multiples of eight with pairs that nothing refers to.
    neighbors: triangles around each vertex, (most, particles), those of a vertex that has fewer repeated.
    """

    first: Int
    second: Int
    slack: NDArray[np.float32]
    offsets: NDArray[np.int64]
    begin: Int
    which: Int
    primitives: Int
    vertex_triangles: int
    neighbors: Int


class Pairs(NamedTuple):
    """A mesh's primitives and pairs in the order of a query.

    samples: vertices that stand for the whole sheet, (SAMPLES,).  to_rest: see ``spread``.
    """

    parts: Parts
    tree: Tree
    near: Near
    samples: Int
    to_rest: Real


def pairs_of(mesh: ClothMesh) -> Pairs:
    """Primitives, tree and near pairs of a mesh."""
    # edges, and those of each triangle
    triangles, x = mesh.triangles, mesh.rest_positions
    sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    edges, inverse = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    triangle_edges = inverse.reshape(-1, 3)
    length2 = ((x[edges[:, 0]] - x[edges[:, 1]]) ** 2).sum(axis=1)
    # leaves in the order of the tree
    leaves = _leaves(triangles, triangle_edges, length2)
    order, nodes = _compact(np.array([x[np.unique(triangles[m])].mean(axis=0) for m in leaves]))
    leaves = [leaves[k] for k in order]
    leaf_of_triangle = np.zeros(len(triangles), np.int64)
    for leaf, own in enumerate(leaves):
        leaf_of_triangle[own] = leaf
    # owners: of each vertex and edge the first triangle that has it, and the leaf of that triangle
    vertex_owner = _first(triangles, len(x))
    edge_owner = _first(triangle_edges, len(edges))
    last = len(triangles) - 1 - _first(triangle_edges[::-1], len(edges))
    vertex_leaf, edge_leaf = leaf_of_triangle[vertex_owner], leaf_of_triangle[edge_owner]
    # leaves that share a vertex
    corners = np.array([_four(np.unique(triangles[m])) for m in leaves])
    leaves_around: list[list[int]] = [[] for _ in range(len(x))]
    for leaf, own in enumerate(corners):
        for vertex in set(own.tolist()):
            leaves_around[vertex].append(leaf)
    adjacent = [sorted({other for vertex in set(own.tolist()) for other in leaves_around[vertex]}) for own in corners]
    # near pairs
    vertex_triangle, edge_edge = _near_pairs(triangles, edges, leaves, adjacent, vertex_leaf, edge_leaf)
    # what belongs to each leaf, and which leaves are not searched
    counted = [_ranges(np.bincount(of, minlength=len(leaves))) for of in (vertex_leaf, edge_leaf, leaf_of_triangle)]
    by_leaf = [np.argsort(of, kind="stable") for of in (vertex_leaf, edge_leaf, leaf_of_triangle)]
    begins, adjacent_nodes, adjacent_leaves = _adjacent_nodes(np.array(nodes), adjacent)
    around = _ranges(np.bincount(triangles.ravel(), minlength=len(x)))
    around_triangles = np.argsort(triangles.ravel(), kind="stable") // 3
    both = np.stack([edge_owner, last], axis=1)
    parts = Parts(
        _int(triangles), _int(edges), _int(triangle_edges), _int(both), 1 / length2, _int(vertex_owner), _int(edge_owner),
        _int(mesh.piece_of), around, _int(around_triangles),
    )  # fmt: skip
    tree = Tree(
        _int(corners), counted[0], _int(by_leaf[0]), counted[1], _int(by_leaf[1]), counted[2], _int(by_leaf[2]),
        _int(np.array(nodes)), begins, adjacent_nodes, adjacent_leaves,
    )  # fmt: skip
    near = _near(triangles, edges, triangle_edges, length2, vertex_triangle, edge_edge, around, around_triangles)
    return Pairs(parts, tree, near, _int(np.linspace(0, len(x) - 1, SAMPLES).round()), to_rest(mesh))


def _int(values: NDArray) -> Int:
    """A contiguous copy as int32; of the mesh's own arrays, too, see ``elements.Topology``."""
    return np.array(values, np.int32, order="C")


def _ranges(counts: NDArray) -> Int:
    """Where ranges of given lengths begin, with the total at the end."""
    return _int(np.concatenate([[0], np.cumsum(counts)]))


def _first(parts: NDArray, count: int) -> NDArray[np.int64]:
    """For each of ``count`` numbers, the first row of ``parts`` that contains it."""
    first = np.full(count, len(parts))
    np.minimum.at(first, parts.ravel(), np.repeat(np.arange(len(parts)), parts.shape[1]))
    return first


def _four(vertices: NDArray) -> NDArray:
    """Three or four vertices as four, the last repeated."""
    return np.concatenate([vertices, np.repeat(vertices[-1:], 4 - len(vertices))])


def _leaves(triangles: NDArray, triangle_edges: NDArray, length2: NDArray) -> list[list[int]]:
    """Triangles joined in pairs across edges, the longest edges first; the others stay single."""
    # the triangles of each edge
    sides: list[list[int]] = [[] for _ in range(len(length2))]
    for t, own in enumerate(triangle_edges):
        for edge in own:
            sides[edge].append(t)
    # by length, to nine digits, so that rounding does not change the order
    free = np.ones(len(triangles), bool)
    leaves = []
    for edge in np.lexsort((np.arange(len(length2)), -np.round(length2 / length2.max(), 9))):
        if len(sides[edge]) == 2 and free[sides[edge]].all():
            free[sides[edge]] = False
            leaves.append(sides[edge])
    return leaves + [[t] for t in np.flatnonzero(free).tolist()]


def _compact(centers: NDArray) -> tuple[list[int], list[list[int]]]:
    """The order of leaves in a k-d tree, and its nodes.

    centers: of the leaves [m], (leaves, 3).  Nodes are halved along their longest side, at a multiple of ``NODE_LEAVES``.
    """
    order: list[int] = []
    nodes: list[list[int]] = []

    def halve(part: NDArray) -> None:
        """Append a node with the leaves ``part``, and its children."""
        begin, node = len(order), len(nodes)
        nodes.append([])
        if len(part) <= NODE_LEAVES:
            order.extend(part.tolist())
        else:
            along = part[np.argsort(centers[part, np.ptp(centers[part], axis=0).argmax()], kind="stable")]
            half = -(-len(part) // (2 * NODE_LEAVES)) * NODE_LEAVES
            halve(along[:half])
            halve(along[half:])
        nodes[node] = [begin, len(order), len(nodes)]

    halve(np.arange(len(centers)))
    return order, nodes


def _adjacent_nodes(nodes: NDArray, adjacent: list[list[int]]) -> tuple[Int, Int, NDArray[np.int64]]:
    """Adjacent nodes without children, and the pairs of their leaves not to be searched, as bits: see ``Tree.adjacent``."""
    # nodes without children, and the node of each leaf
    childless = np.flatnonzero(nodes[:, NODE_NEXT] == np.arange(len(nodes)) + 1).tolist()
    node_of = {leaf: k for k in childless for leaf in range(nodes[k, NODE_BEGIN], nodes[k, NODE_END])}
    counts, others, bits = np.zeros(len(nodes), np.int64), [], []
    # a leaf with itself, with those before it, and with those that share a vertex
    for node in childless:
        begin, end = nodes[node, [NODE_BEGIN, NODE_END]].tolist()
        bits_of = {node: 0}
        for leaf in range(begin, end):
            for other in {*range(begin, leaf + 1), *(other for other in adjacent[leaf] if other > leaf)}:
                bit = NODE_LEAVES * (leaf - begin) + other - int(nodes[node_of[other], NODE_BEGIN])
                bits_of[node_of[other]] = bits_of.get(node_of[other], 0) | 1 << bit
        counts[node] = len(bits_of)
        others += sorted(bits_of)
        bits += [bits_of[other] for other in sorted(bits_of)]
    return _ranges(counts), _int(np.array(others)), np.array(bits, np.uint64).view(np.int64)


def _near_pairs(
    triangles: NDArray, edges: NDArray, leaves: list[list[int]], adjacent: list[list[int]], vertex_leaf: NDArray, edge_leaf: NDArray
) -> tuple[NDArray, NDArray]:
    """Pairs of a vertex and a triangle, and of two edges, without a common vertex, of leaves that share one or are the same.

    Returns (pairs, 2) each.
    """
    vertices_of = [np.flatnonzero(vertex_leaf == leaf).tolist() for leaf in range(len(leaves))]
    edges_of = [np.flatnonzero(edge_leaf == leaf).tolist() for leaf in range(len(leaves))]
    corner_sets, end_sets = [set(t) for t in triangles.tolist()], [set(e) for e in edges.tolist()]
    vertex_triangle, edge_edge = [], []
    for leaf, others in enumerate(adjacent):
        for other in others:
            vertex_triangle += [(v, t) for v in vertices_of[leaf] for t in leaves[other] if v not in corner_sets[t]]
            edge_edge += [
                (e, f) for e in edges_of[leaf] for f in edges_of[other] if (leaf < other or e < f) and other >= leaf
                and not end_sets[e] & end_sets[f]
            ]  # fmt: skip
    return np.array(vertex_triangle, np.int64).reshape(-1, 2), np.array(edge_edge, np.int64).reshape(-1, 2)


def _near(
    triangles: NDArray, edges: NDArray, triangle_edges: NDArray, length2: NDArray, vertex_triangle: NDArray, edge_edge: NDArray,
    around: NDArray, around_triangles: NDArray,
) -> Near:  # fmt: skip
    """Pairs of vertices of near pairs, their slack [m^2], and the near pairs that each is in."""
    # squared radius of the smallest circle around each triangle: half its longest side if obtuse, else its circumcircle
    a, b, c = np.sort(length2[triangle_edges], axis=1).T
    doubled2 = (2 * (a * b + b * c + c * a) - a * a - b * b - c * c) / 4  # the square of twice the area (Heron)
    circle = np.where(a + b <= c, c / 4, a * b * c / (4 * doubled2))
    # all pairs of a vertex of the first primitive and one of the second, with the slack and number of their near pair
    v, t = vertex_triangle.T
    e, f = edge_edge.T
    first = [np.repeat(v, 3), edges[e][:, [0, 0, 1, 1]].ravel()]
    second = [triangles[t].ravel(), edges[f][:, [0, 1, 0, 1]].ravel()]
    slack = [np.repeat(circle[t], 3), np.repeat((length2[e] + length2[f]) / 4, 4)]
    which = np.concatenate([np.repeat(np.arange(len(v)), 3), len(v) + np.repeat(np.arange(len(e)), 4)])
    # each pair of vertices once, with its largest slack, and its near pairs in order
    both = np.sort(np.stack([np.concatenate(first), np.concatenate(second)], axis=1), axis=1)
    ends, pair = np.unique(both, axis=0, return_inverse=True)
    pair = pair.ravel()
    largest = np.zeros(len(ends))
    np.maximum.at(largest, pair, np.concatenate(slack))
    # of a grid they go by offset and first vertex
    first_vertex, second_vertex, offsets = *ends.T, np.unique(ends[:, 1] - ends[:, 0])
    if len(offsets) <= MOST_OFFSETS:
        particles = len(around) - 1
        place = np.searchsorted(offsets, second_vertex - first_vertex) * particles + first_vertex
        first_vertex = np.tile(np.arange(particles), len(offsets))
        second_vertex = np.minimum(first_vertex + np.repeat(offsets, particles), particles - 1)
        pair, slacks = place[pair], np.full(len(first_vertex), -np.inf)
        slacks[place] = largest
        largest = slacks
    else:
        offsets = offsets[:0]
    begin = _ranges(np.bincount(pair, minlength=len(first_vertex)))
    # the triangles around each vertex in columns of one length; a vertex without any takes the first
    counts = np.diff(around)
    column = around[:-1] + np.minimum(np.arange(max(counts.max(), 1))[:, None], np.maximum(counts - 1, 0))
    neighbors = np.where(counts > 0, np.append(around_triangles, 0)[column], 0)
    vertex_triangle, edge_edge = _in_eights(vertex_triangle), _in_eights(edge_edge)
    which = np.where(which < len(v), which, which + len(vertex_triangle) - len(v))[np.argsort(pair, kind="stable")]
    return Near(
        _int(first_vertex), _int(second_vertex), largest.astype(np.float32), offsets.astype(np.int64), begin, _int(which),
        _int(np.concatenate([vertex_triangle, edge_edge])), len(vertex_triangle), _int(neighbors),
    )  # fmt: skip


def _in_eights(rows: NDArray) -> NDArray:
    """Rows, the last repeated up to a multiple of eight."""
    return np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % 8, axis=0)])

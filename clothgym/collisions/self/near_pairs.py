"""Near pairs of a query (see ``topology``): those that no distance of vertices rules out go to the narrow phase.

A pair of vertices may be close if |p_i - p_j|^2 <= R^2 + s slack, with R the reach and both extras, and s the largest (length /
rest length)^2, at least 1, of the edges of the triangles around both: s times the slack at rest is a bound of the slack of now.  It
is tested in float32, side by side.  With e the error of a coordinate in float32 and d the distance, (d + e)^2 <= d^2 (1 + a) +
e^2 (1 + 1/a), so the right side is made larger by a share a, and by e^2 (1 + 1/a).
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, uncounted
from clothgym.collisions.self.lower_bounds import EPSILON, N_EXTRA, N_STRETCH, N_WIDE, UPWARDS
from clothgym.collisions.self.narrow_phase import edge_contacts, vertex_contacts
from clothgym.collisions.self.query_scratch import BATCH

LARGER = 1e-4  # a, see above
ERROR2 = (4 * EPSILON) ** 2 / LARGER  # e^2 (1 + 1/a), per square of the sheet's extent


@disjoint
def _stretches(x, y, z, edges, rest_edges, error2, stretch):
    """(length / rest length)^2 of each edge, at least 1, made larger by what rounding may take: ``stretch``, (edges,)."""
    one, larger = np.float32(1), np.float32(1 + LARGER)
    for e in range(stretch.shape[0]):
        i, j = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
        dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
        stretch[e] = max((larger * (dx * dx + dy * dy + dz * dz) + error2) * np.float32(rest_edges[e]), one)


@disjoint
def _around_triangles(extra, stretch, triangles, triangle_edges, wide, stretches):
    """The largest extra of each triangle's vertices, and the largest stretch of its edges, (triangles,)."""
    for t in range(wide.shape[0]):
        i, j, k = np.uint32(triangles[t, 0]), np.uint32(triangles[t, 1]), np.uint32(triangles[t, 2])
        e, f, g = np.uint32(triangle_edges[t, 0]), np.uint32(triangle_edges[t, 1]), np.uint32(triangle_edges[t, 2])
        wide[t] = max(extra[i], max(extra[j], extra[k]))
        stretches[t] = max(stretch[e], max(stretch[f], stretch[g]))


@disjoint
def _around_vertices(wide, stretches, neighbors, most_wide, most_stretch):
    """The largest of both of the triangles around each vertex, (particles,); neighbors: one of each vertex."""
    for v in range(neighbors.shape[0]):
        t = np.uint32(neighbors[v])
        most_wide[v] = max(most_wide[v], wide[t])
        most_stretch[v] = max(most_stretch[v], stretches[t])


@disjoint
def _come_close(x, y, z, wide, stretch, first, second, slack, reach, error2, close):
    """Whether pairs of vertices may be close, see the module: ``close``, (pairs,)."""
    larger = np.float32(1 + 2 * LARGER)
    for q in range(first.shape[0]):
        i, j = np.uint32(first[q]), np.uint32(second[q])
        dx, dy, dz, within = x[j] - x[i], y[j] - y[i], z[j] - z[i], reach + wide[i] + wide[j]
        most = within * within + slack[q] * max(stretch[i], stretch[j])
        close[q] = not dx * dx + dy * dy + dz * dz > larger * most + error2


@disjoint
def _come_close_at(x, y, z, wide, stretch, xs, ys, zs, wides, stretches, slack, reach, error2, close):
    """The same for vertices that follow each other, and their partners, which do so, too: no value is looked for; all (pairs,)."""
    larger = np.float32(1 + 2 * LARGER)
    for i in range(close.shape[0]):
        dx, dy, dz, within = xs[i] - x[i], ys[i] - y[i], zs[i] - z[i], reach + wide[i] + wides[i]
        most = within * within + slack[i] * max(stretch[i], stretches[i])
        close[i] = not dx * dx + dy * dy + dz * dz > larger * most + error2


@uncounted
def find_close(parts, near, reach, extent, scratch):
    """Mark the pairs of vertices that may be close in ``scratch.close``; reach: [m], extent: of the sheet [m]."""
    rows, around, error2 = scratch.near, scratch.around, np.float32(ERROR2 * extent * extent)
    x, y, z, wide, stretch = rows[0], rows[1], rows[2], rows[N_WIDE], rows[N_STRETCH]
    _stretches(x, y, z, parts.edges, parts.rest_edges, error2, scratch.stretch)
    _around_triangles(rows[N_EXTRA], scratch.stretch, parts.triangles, parts.triangle_edges, around[0], around[1])
    wide[:] = np.float32(0)
    stretch[:] = np.float32(1)
    for k in range(near.neighbors.shape[0]):
        _around_vertices(around[0], around[1], near.neighbors[k], wide, stretch)
    within, number = np.float32(reach * UPWARDS), x.shape[0]
    if near.offsets.shape[0] == 0:
        _come_close(x, y, z, wide, stretch, near.first, near.second, near.slack, within, error2, scratch.close)
    for k in range(near.offsets.shape[0]):
        o = near.offsets[k]
        begin, end = k * number, (k + 1) * number - o
        _come_close_at(
            x, y, z, wide, stretch, x[o:], y[o:], z[o:], wide[o:], stretch[o:], near.slack[begin:end], within, error2,
            scratch.close[begin:end],
        )  # fmt: skip


@uncounted
def near_contacts(pairs, distances, extent, smooth, scratch, found):
    """Contacts and gap constraints of near pairs, first of vertices and triangles, then of edges, in their order; arguments as in
    ``narrow_phase.vertex_contacts``."""
    near, close, seen = pairs.near, scratch.close, scratch.seen
    find_close(pairs.parts, near, distances.within, extent, scratch)
    # the primitives of all close vertices; eight pairs at a time, as in most places none is close
    seen[:] = False
    eights = close.view(np.uint64)
    for eight in range(eights.shape[0]):
        if eights[eight] != 0:
            for q in range(8 * eight, min(8 * eight + 8, near.first.shape[0])):
                if close[q]:
                    for m in range(near.begin[q], near.begin[q + 1]):
                        seen[near.which[m]] = True
    for edges in range(2):
        begin, end = (near.vertex_triangles, seen.shape[0]) if edges else (0, near.vertex_triangles)
        _judge_seen(edges, begin, end, pairs, distances, extent, smooth, scratch, found)


@uncounted
def _judge_seen(edges, begin, end, pairs, distances, extent, smooth, scratch, found):
    """The near pairs that were seen, in batches: whether of edges, and the range of them, in multiples of eight."""
    batch, seen, primitives, number = scratch.pairs, scratch.seen, pairs.near.primitives, np.int64(0)
    eights = seen.view(np.uint64)
    for eight in range(begin // 8, end // 8):
        if eights[eight] == 0:
            continue
        if number > BATCH - 9:
            if edges:
                edge_contacts(number, distances, pairs.parts, extent, smooth, scratch, found)
            else:
                vertex_contacts(number, distances, pairs.parts, extent, smooth, scratch, found)
            number = 0
        for n in range(8 * eight, 8 * eight + 8):
            # written without a branch: the next one takes the place of one that was not seen
            batch[0, number], batch[1, number], batch[2, number] = primitives[n, 0], primitives[n, 1], -1
            number += seen[n]
    if edges:
        edge_contacts(number, distances, pairs.parts, extent, smooth, scratch, found)
    else:
        vertex_contacts(number, distances, pairs.parts, extent, smooth, scratch, found)

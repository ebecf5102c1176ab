"""Narrow phase of self-collision: which pairs are close, and how far each vertex may move.

The query takes the positions of one environment.  It finds each vertex and triangle, and each two edges, that share no vertex and
are closer than the reach, and gives each vertex a displacement bound: how far it may move, in any direction, before the next query
is due.  If d is a lower bound of a pair's distance and each of its vertices moves by less than d / 2, the pair cannot touch,
whatever the paths.  So the bound of vertex v is

    b_v = gamma_p min d  over the pairs of v,    gamma_p = SHARE < 1/2,

less a margin for rounding.

Distances are certified, in float64.  With n the unit vector between the closest points a and b, the lower bound is

    d = min n . x_first - max n . x_second,

which holds for any n, so nothing depends on the closest points being accurate.  (In float32 the closest points of slivers
overestimate the distance by half a millimeter.)

Where layers touch, d is small, and such bounds would call for a query in almost every substep, even where the layers move
together.  So a pair closer than ``CLOSE`` times the reach becomes a gap constraint: once one of its vertices has left its bound,
the distance along n is evaluated, and must not fall below ``stop``.  The limits of the vertices, beyond which a query is due,
follow from the other pairs alone.  So each pair is certified in every state: by the bounds of its vertices, by their limits, or by
its constraint.

Per-vertex bounds instead of continuous collision detection: Chen, Hsu, Liu, Macklin, Yang and Yuksel, Offset Geometric
Contact, ACM Transactions on Graphics 44(4), 2025.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.self.broad_phase import along, between, is_ridge
from clothgym.collisions.self.contact_normals import on_edges, on_vertex, owns
from clothgym.collisions.self.lower_bounds import keep_edges, keep_vertices
from clothgym.contact_memory import (
    C_NORMAL,
    C_THICKNESS,
    G_GROUP,
    G_KEPT,
    G_NUMBER,
    G_OWN,
    G_SIZE,
    G_VERTICES,
    REPORT_DROPPED,
)
from clothgym.geometry.closest_points import closest_on_segments, closest_on_triangle

LAYERED = 0.8  # share of the distance between two leaves' vertices that a plane between the leaves must certify to stand for all
CLOSE = 0.8  # share of the reach within which a pair becomes a gap constraint
SHARE = 0.45  # gamma_p: share of a pair's distance that each side may move by; less than a half
SLOP = 0.01  # share of the thickness by which contacts may sink in: at rest they touch, and keep their impulses
GROUP_JAMMED = -2  # in place of the pair of leaves of a gap constraint: it has been enforced since the last query
DEEP = 0.5  # share of the thickness below which pairs push apart along their distance, whatever the smooth sheets do
MARGIN = 1e-5  # part of the certified distance kept for rounding in float32 within 16 m of the origin [m]


@inlined
def gap_of_vertex(p, v, i, j, k):
    """Barycentric weights of the point of triangle ijk that is closest to vertex v, and the vector from it to v [m]."""
    px, py, pz = p[v, 0], p[v, 1], p[v, 2]
    ax, ay, az = p[i, 0], p[i, 1], p[i, 2]
    bx, by, bz = p[j, 0], p[j, 1], p[j, 2]
    cx, cy, cz = p[k, 0], p[k, 1], p[k, 2]
    a, b, c = closest_on_triangle(px, py, pz, ax, ay, az, bx, by, bz, cx, cy, cz)
    return a, b, c, px - (a * ax + b * bx + c * cx), py - (a * ay + b * by + c * cy), pz - (a * az + b * bz + c * cz)


@inlined
def gap_of_edges(p, i, j, k, l):
    """Parameters s, t in [0, 1] of the closest points of edges ij and kl, and the vector from the second point to the first [m]."""
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
def write_contact(i, j, k, l, wi, wj, wk, wl, nx, ny, nz, thickness, count, particles, coefficients):
    """Write contact number ``count``: its vertices, their weights, its normal and its thickness [m]."""
    particles[count, 0], particles[count, 1], particles[count, 2], particles[count, 3] = i, j, k, l
    coefficients[count, 0], coefficients[count, 1], coefficients[count, 2], coefficients[count, 3] = wi, wj, wk, wl
    coefficients[count, C_NORMAL], coefficients[count, C_NORMAL + 1], coefficients[count, C_NORMAL + 2] = nx, ny, nz
    coefficients[count, C_THICKNESS] = thickness


@kernel
def distance_to_keep(gap, held, stop, standoff):
    """Distance that a gap constraint keeps [m]: ``stop``, or ``standoff`` with an attached vertex, or the gap if that is smaller.

    A direction along which the pair does not lie apart certifies nothing: the distance is infinite, and the pair stays in place.
    """
    return min(gap, standoff if held else stop) if gap > 0.0 else np.inf


@inlined
def write_constraint(i, j, k, l, own, group, nx, ny, nz, gap, held, stop, standoff, count, members, planes):
    """Write gap constraint number ``count``: of the vertices i, j, k and l the first ``own`` belong to the first primitive, and
    along the normal n their gap must not fall below the distance to keep.  gap: that of now [m].  held: attached particles,
    (particles,).
    """
    members[count, G_OWN], members[count, G_NUMBER], members[count, G_GROUP] = own, 4, group
    (
        members[count, G_VERTICES],
        members[count, G_VERTICES + 1],
        members[count, G_VERTICES + 2],
        members[count, G_VERTICES + 3],
    ) = i, j, k, l
    keep = distance_to_keep(gap, held[i] | held[j] | held[k] | held[l], stop, standoff)
    planes[count, 0], planes[count, 1], planes[count, 2], planes[count, G_KEPT] = nx, ny, nz, keep


@inlined
def lower_limits(i, j, k, l, certified, left, close, extra, limits):
    """Lower the limits of four vertices for a pair that is not a gap constraint.

    left: of the certified distance, what is left when the vertices use their extra [m].  A pair closer than ``close``, for which
    there was no room among the constraints, leaves them nothing beyond their extra.
    """
    for v in (i, j, k, l):
        limits[v] = min(limits[v], left if left >= close else certified - 2.0 * extra[v])


@inlined
def thickness_of(gap, rise, thickness, least):
    """Thickness of a contact [m], between smooth sheets that are closer than its vertices by ``rise``.

    A contact closer than the thickness keeps its present gap, but not less than ``least``.
    """
    rise = min(max(rise, -0.5 * thickness), 0.5 * thickness)
    return min(thickness + rise, max(least + rise, gap / (1.0 - SLOP)))


class Distances(NamedTuple):
    """Distances for one sort of pairs [m].

    within: pairs that matter are closer, but for their extras.  thickness: of the cloth between them.  least: the smallest
    thickness of a contact: a closer one is pushed apart only so far, and otherwise only kept from approaching.  margin: beyond the
    thickness within which a pair is a contact.  close: less the extras, within which a pair becomes a gap constraint.  stop,
    standoff: see ``distance_to_keep``.
    """

    within: float
    thickness: float
    least: float
    margin: float
    close: float
    stop: float
    standoff: float


@inlined
def near_distances(reach):
    """``Distances`` of near pairs, which have no room for their thickness where cloth is pinched: nothing pushes them apart."""
    close = CLOSE * min(reach.near, reach.far)
    return Distances(reach.near, reach.near_thickness, -np.inf, reach.margin, close, reach.stop, reach.standoff)


@inlined
def far_distances(reach):
    """``Distances`` of pairs that do not hang together."""
    close = CLOSE * min(reach.near, reach.far)
    return Distances(
        reach.far, reach.far_thickness, reach.far_thickness, reach.margin, close, reach.stop, reach.standoff
    )  # fmt: skip


@uncounted
def vertex_contacts(number, distances, parts, extent, smooth, scratch, found):
    """Evaluate a batch of vertices and triangles: certify their distances, lower the bounds of their vertices, and write contacts
    and gap constraints.

    number: of the pairs in ``scratch.pairs``: vertex, triangle and pair of leaves, -1 for near pairs.  extent: of the sheet [m].
    smooth: see ``contact_normals``; contacts between different pieces of a mesh are those of smooth sheets.

    ``scratch.extra``: how much farther than the reach pairs matter around each vertex, which is also how much more than its share
    it may move [m].  ``scratch.bounds``, ``scratch.limits``: become the smallest distances of each vertex, of all its pairs and of
    those without a constraint [m].  ``scratch.closest``: becomes the smallest distance in each pair of leaves [m] and its
    direction.
    """
    p, extra, held, bounds, limits, batch, closest = (
        scratch.p,
        scratch.extra,
        scratch.held,
        scratch.bounds,
        scratch.limits,
        scratch.pairs,
        scratch.closest,
    )
    particles, members, report, counts = found.particles, found.members, found.report, found.counts
    within, thickness, least, margin, close, stop, standoff = distances
    for m in range(keep_vertices(number, within, extent, parts.triangles, scratch.near, batch, scratch.ends, scratch.lower)):
        # the closest points, and whether they are within reach
        v, t, group = batch[0, m], batch[1, m], batch[2, m]
        i, j, k = parts.triangles[t, 0], parts.triangles[t, 1], parts.triangles[t, 2]
        a, b, c, nx, ny, nz = gap_of_vertex(p, v, i, j, k)
        square, extras = nx * nx + ny * ny + nz * nz, extra[v] + max(extra[i], max(extra[j], extra[k]))
        if not square < (within + extras) * (within + extras):
            continue
        # the certified distance along n
        scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        farthest = max(along(p, i, nx, ny, nz), max(along(p, j, nx, ny, nz), along(p, k, nx, ny, nz)))
        certified = along(p, v, nx, ny, nz) - farthest
        # it bounds all four vertices
        bounds[v], bounds[i], bounds[j], bounds[k] = (
            min(bounds[v], certified), min(bounds[i], certified), min(bounds[j], certified), min(bounds[k], certified)
        )  # fmt: skip
        # a close pair becomes a gap constraint; any other, or one for which there is no room, limits its vertices, too
        left = certified - extras
        if left < close and counts[1] < members.shape[0]:
            write_constraint(v, i, j, k, 1, group, nx, ny, nz, certified, held, stop, standoff, counts[1], members, found.planes)
            counts[1] += 1
        else:
            lower_limits(v, i, j, k, certified, left, close, extra, limits)
            report[REPORT_DROPPED] += left < close
        # the closest pair of two leaves
        if group >= 0 and certified < closest[group, 0]:
            closest[group, 0], closest[group, 1], closest[group, 2], closest[group, 3] = certified, nx, ny, nz
        # a contact, if it is certified and within the thickness, and belongs to this triangle
        if certified <= 0.0 or certified > thickness + margin:
            continue
        owned, is_closest, is_smooth = owns(p, v, t, i, j, k, a, b, c, nx, ny, nz, parts, smooth.kinds)
        others = parts.piece[v] != parts.piece[i]
        if not (owned and (is_closest or not others)):
            continue
        sa, sb, sc, mx, my, mz, gap, rise = a, b, c, nx, ny, nz, certified, 0.0
        if others:
            sa, sb, sc, gap, mx, my, mz, rise = on_vertex(p, v, i, j, k, a, b, c, certified, nx, ny, nz, is_smooth, parts, smooth)
        if gap > 0.0:
            a, b, c, nx, ny, nz, kept = sa, sb, sc, mx, my, mz, thickness_of(gap, rise, thickness, least)
        elif certified < DEEP * thickness:
            kept = thickness_of(certified, 0.0, thickness, least)
        else:
            continue
        if counts[0] < particles.shape[0]:
            write_contact(v, i, j, k, 1.0, -a, -b, -c, nx, ny, nz, kept, counts[0], particles, found.coefficients)
            counts[0] += 1
        else:
            report[REPORT_DROPPED] += 1


@uncounted
def edge_contacts(number, distances, parts, extent, smooth, scratch, found):
    """The same for a batch of two edges.

    Only ridges whose closest points both lie inside become contacts: elsewhere vertices and triangles cover the same contact.
    Nothing pushes them apart.  Where cloth is pinched, close edges become ridges and stop being ridges: what pushed them would
    never rest.
    """
    p, extra, held, bounds, limits, batch = scratch.p, scratch.extra, scratch.held, scratch.bounds, scratch.limits, scratch.pairs
    particles, members, report, counts = found.particles, found.members, found.report, found.counts
    within, thickness, _, margin, close, stop, standoff = distances
    for m in range(keep_edges(number, within, extent, parts.edges, scratch.near, batch, scratch.ends, scratch.lower)):
        # the closest points, and whether they are within reach
        e, f = batch[0, m], batch[1, m]
        i, j, k, l = parts.edges[e, 0], parts.edges[e, 1], parts.edges[f, 0], parts.edges[f, 1]
        extras = max(extra[i], extra[j]) + max(extra[k], extra[l])
        s, t, nx, ny, nz = gap_of_edges(p, i, j, k, l)
        square = nx * nx + ny * ny + nz * nz
        if not square < (within + extras) * (within + extras):
            continue
        # the certified distance along n
        scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        nearest = min(along(p, i, nx, ny, nz), along(p, j, nx, ny, nz))
        certified = nearest - max(along(p, k, nx, ny, nz), along(p, l, nx, ny, nz))
        # it bounds all four vertices
        bounds[i], bounds[j], bounds[k], bounds[l] = (
            min(bounds[i], certified), min(bounds[j], certified), min(bounds[k], certified), min(bounds[l], certified)
        )  # fmt: skip
        # a close pair becomes a gap constraint; any other, or one for which there is no room, limits its vertices, too
        left = certified - extras
        if left < close and counts[1] < members.shape[0]:
            write_constraint(i, j, k, l, 2, -1, nx, ny, nz, certified, held, stop, standoff, counts[1], members, found.planes)
            counts[1] += 1
        else:
            lower_limits(i, j, k, l, certified, left, close, extra, limits)
            report[REPORT_DROPPED] += left < close
        # a contact, if it is certified and within the thickness
        inside = s > 0.0 and s < 1.0 and t > 0.0 and t < 1.0
        if not (inside and certified > 0.0 and certified <= thickness + margin):
            continue
        if not (is_ridge(scratch.faces, parts.edge_triangles, e) and is_ridge(scratch.faces, parts.edge_triangles, f)):
            continue
        so, to, mx, my, mz, gap, rise = s, t, nx, ny, nz, certified, 0.0
        if parts.piece[i] != parts.piece[k]:
            so, to, gap, mx, my, mz, rise = on_edges(p, e, f, i, j, k, l, s, t, certified, nx, ny, nz, parts, smooth)
        if gap > 0.0:
            s, t, nx, ny, nz, kept = so, to, mx, my, mz, thickness_of(gap, rise, thickness, -np.inf)
        elif certified < DEEP * thickness:
            kept = thickness_of(certified, 0.0, thickness, -np.inf)
        else:
            continue
        if counts[0] < particles.shape[0]:
            write_contact(i, j, k, l, 1.0 - s, s, t - 1.0, -t, nx, ny, nz, kept, counts[0], particles, found.coefficients)
            counts[0] += 1
        else:
            report[REPORT_DROPPED] += 1


@uncounted
def constrain_layers(number, first, corners, distances, scratch, found):
    """Replace the gap constraints between the vertices and triangles of two leaves by one, where a plane between the leaves
    certifies about the same distance.

    number: of the pairs in ``scratch.leaves``.  first: the first gap constraint of their vertices and triangles.  corners: of
    leaves, (leaves, 4).  ``scratch.gaps``: the best distance certified by a plane of either leaf [m] and its normal; the plane
    normal to the closest pair of vertex and triangle, ``scratch.closest``, may certify more.  ``scratch.layered``: becomes which
    pairs of leaves have such a plane.
    """
    p, extra, held, bounds, limits = scratch.p, scratch.extra, scratch.held, scratch.bounds, scratch.limits
    leaves, gaps, closest, layered = scratch.leaves, scratch.gaps, scratch.closest, scratch.layered
    members, planes, report, counts = found.members, found.planes, found.report, found.counts
    close, stop, standoff = distances.close, distances.stop, distances.standoff
    # the pairs of leaves with such a plane
    for pair in range(number):
        leaf, other = leaves[pair, 0], leaves[pair, 1]
        layered[pair] = gaps[pair, 0] >= max(LAYERED * closest[pair, 0], stop)
        if not layered[pair]:
            gap = between(p, corners, leaf, other, closest[pair, 1], closest[pair, 2], closest[pair, 3])
            if gap >= max(LAYERED * closest[pair, 0], stop):
                layered[pair] = True
                gaps[pair, 0], gaps[pair, 1], gaps[pair, 2], gaps[pair, 3] = (
                    gap,
                    closest[pair, 1],
                    closest[pair, 2],
                    closest[pair, 3],
                )
    # drop the gap constraints of their vertices and triangles
    kept = first
    for t in range(first, counts[1]):
        if members[t, G_GROUP] >= 0 and layered[members[t, G_GROUP]]:
            continue
        if kept < t:
            for c in range(G_SIZE):
                members[kept, c] = members[t, c]
            for c in range(4):
                planes[kept, c] = planes[t, c]
        kept += 1
    # one gap constraint for each, or limits where there is no room or need
    for pair in range(number):
        if not layered[pair]:
            continue
        leaf, other, gap = leaves[pair, 0], leaves[pair, 1], gaps[pair, 0]
        own, others = 0.0, 0.0
        for m in range(4):
            own, others = max(own, extra[corners[leaf, m]]), max(others, extra[corners[other, m]])
        left = gap - own - others
        constrained = left < close and kept < members.shape[0]
        report[REPORT_DROPPED] += left < close and not constrained
        # the distance bounds all their vertices
        any_held = False
        for m in range(4):
            for v in (corners[leaf, m], corners[other, m]):
                bounds[v] = min(bounds[v], gap)
                any_held |= held[v]
                if not constrained:
                    limits[v] = min(limits[v], left if left >= close else gap - 2.0 * extra[v])
        # write the constraint
        if constrained:
            nx, ny, nz = gaps[pair, 1], gaps[pair, 2], gaps[pair, 3]
            # its normal points from the second leaf to the first
            along_n = along(p, corners[leaf, 0], nx, ny, nz) - along(p, corners[other, 0], nx, ny, nz)
            sign = 1.0 if along_n > 0.0 else -1.0
            members[kept, G_OWN], members[kept, G_NUMBER], members[kept, G_GROUP] = 4, 8, -1
            for m in range(4):
                members[kept, G_VERTICES + m], members[kept, G_VERTICES + 4 + m] = corners[leaf, m], corners[other, m]
            planes[kept, 0], planes[kept, 1], planes[kept, 2] = sign * nx, sign * ny, sign * nz
            planes[kept, G_KEPT] = min(gap, standoff if any_held else stop)
            kept += 1
    counts[1] = kept

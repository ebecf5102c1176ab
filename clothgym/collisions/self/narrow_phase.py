"""What of one sheet is close to what: the query of self-collision.

From the positions of one environment it finds every vertex and triangle, and every two edges, without a common vertex, that are
closer than the reach, and gives each vertex a bound: how far it may go, in any direction, before the query must be made anew.  If
d is a lower bound of the distance of a pair, and each of its vertices moves by less than half of d, the pair cannot touch,
whatever the paths are; so a vertex may move by ``SHARE`` times the smallest such distance, less a margin for rounding.

Distances are taken in float64 and certified: with n the unit vector between the closest points, the least ``n.a`` of one side less
the largest ``n.b`` of the other is a lower bound of the distance for any n at all, so nothing rests on the closest points
being right.  (Closest points of slivers in float32 overestimate by half a millimetre.)

Where layers touch, their distance is small, and bounds that are a share of it would call for a query with every step that
they take, even together.  So pairs that are closer than ``LOOSE`` times the reach are constrained: once one of their vertices has
left its bound, their distance along n is looked at, which may shrink to ``stop``; and what is left of the bounds, the limits,
follows from the other pairs alone.  So each pair is certified in every state: by the bounds of its vertices, or by their limits, or
by its constraint.

Per-vertex bounds instead of continuous collision detection: Chen, Hsu, Liu, Macklin, Yang and Yuksel, Offset Geometric
Contact, ACM Transactions on Graphics 44(4), 2025.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.self.broad_phase import along, between, faces_of, far_pairs, far_sides, near_candidates, ridges_of
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
    REPORT_GAP,
)
from clothgym.geometry.closest_points import closest_on_segments, closest_on_triangle, segments_apart

LAYERED = 0.8  # share of the distance of leaves' vertices that a plane between them must show to bound their edges too
LOOSE = 0.8  # of the reach below which pairs are constrained
SHARE = 0.45  # of a pair's distance that each side may use; below a half
SLOP = 0.01  # share of the thickness that contacts may sink in: at rest they touch, and their impulses last
GROUP_JAMMED = -2  # in the place of a pair of leaves: held since the last query
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
def write(i, j, k, l, wi, wj, wk, wl, nx, ny, nz, thickness, count, particles, coefficients):
    """Write a contact down."""
    particles[count, 0], particles[count, 1], particles[count, 2], particles[count, 3] = i, j, k, l
    coefficients[count, 0], coefficients[count, 1], coefficients[count, 2], coefficients[count, 3] = wi, wj, wk, wl
    coefficients[count, C_NORMAL], coefficients[count, C_NORMAL + 1], coefficients[count, C_NORMAL + 2] = nx, ny, nz
    coefficients[count, C_THICKNESS] = thickness


@kernel
def distance_to_keep(gap, held, stop, standoff):
    """Distance that a gap constraint keeps [m]; a direction along which it is not apart certifies nothing: it stays as it is."""
    return min(gap, standoff if held else stop) if gap > 0.0 else np.inf


@inlined
def constrain(i, j, k, l, own, group, nx, ny, nz, gap, held, stop, standoff, constraints, members, planes):
    """Write a pair down: the first ``own`` of its vertices, and the others, which may not come closer than ``stop`` along a
    direction, or than ``standoff`` if a hand holds any."""
    members[constraints, G_OWN], members[constraints, G_NUMBER], members[constraints, G_GROUP] = own, 4, group
    (
        members[constraints, G_VERTICES],
        members[constraints, G_VERTICES + 1],
        members[constraints, G_VERTICES + 2],
        members[constraints, G_VERTICES + 3],
    ) = i, j, k, l
    keep = distance_to_keep(gap, held[i] | held[j] | held[k] | held[l], stop, standoff)
    planes[constraints, 0], planes[constraints, 1], planes[constraints, 2], planes[constraints, G_KEPT] = nx, ny, nz, keep


@inlined
def set_free(i, j, k, l, certified, left, loose, extra, free):
    """Lower the room that a pair which is not constrained leaves its four vertices.

    left: of its certified distance, after what its vertices have beyond their shares.  Where there was no room to constrain a pair
    that is too close for that, they have nothing.
    """
    for v in (i, j, k, l):
        free[v] = min(free[v], left if left >= loose else certified - 2.0 * extra[v])


@apart
def vertex_contacts(
    p, candidates, triangles, triangle_edges, vertex_owner, edge_owner, reach, extra, thickness, kept, margin, loose, stop,
    standoff, held, room, free, closest, count, particles, coefficients, constraints, members, planes, report,
):  # fmt: skip
    """Certify vertices and triangles, lower the room of their vertices, and write the contacts down.  Returns the
    numbers of contacts and of gap constraints.

    extra: how much farther than ``reach`` is looked for each vertex, and how much more than its share it may go [m], (particles,).
    Pairs closer than ``loose``, and what their vertices have of that, are constrained, as far as there is room; ``free`` is the
    room that the others leave.  kept: the least thickness of a contact: one that is closer than ``thickness`` is pushed apart only
    so far, and beyond it only kept from coming closer.

    One contact for each closest feature: a face's inside, or a border that this triangle stands for; of two vertices, which meet
    twice, the one of the lower number has it.  closest: becomes the smallest distance
    of each group of candidates [m], and its direction, (groups, 4).
    """
    for m in range(candidates.shape[0]):
        v, t = candidates[m, 0], candidates[m, 1]
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c, nx, ny, nz = gap_of_vertex(p, v, i, j, k)
        square, more = nx * nx + ny * ny + nz * nz, extra[v] + max(extra[i], max(extra[j], extra[k]))
        if not square < (reach + more) * (reach + more):
            continue
        scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        farthest = max(along(p, i, nx, ny, nz), max(along(p, j, nx, ny, nz), along(p, k, nx, ny, nz)))
        certified = along(p, v, nx, ny, nz) - farthest
        room[v], room[i], room[j], room[k] = (
            min(room[v], certified), min(room[i], certified), min(room[j], certified), min(room[k], certified)
        )  # fmt: skip
        group = candidates[m, 2]
        left = certified - more
        if left < loose and constraints < members.shape[0]:
            constrain(v, i, j, k, 1, group, nx, ny, nz, certified, held, stop, standoff, constraints, members, planes)
            constraints += 1
        else:
            set_free(v, i, j, k, certified, left, loose, extra, free)
            report[REPORT_DROPPED] += left < loose
        if certified < closest[group, 0]:
            closest[group, 0], closest[group, 1], closest[group, 2], closest[group, 3] = certified, nx, ny, nz
        if certified <= 0.0 or certified > thickness + margin:
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
        if not mine:
            continue
        if count < particles.shape[0]:
            own = min(thickness, max(kept, certified / (1.0 - SLOP)))
            write(v, i, j, k, 1.0, -a, -b, -c, nx, ny, nz, own, count, particles, coefficients)
            count += 1
        else:
            report[REPORT_DROPPED] += 1
    return count, constraints


@apart
def edge_contacts(
    p, candidates, edges, ridges, reach, extra, thickness, kept, margin, loose, stop, standoff, held, room, free, count, particles,
    coefficients, constraints, members, planes, report,
):  # fmt: skip
    """The same for edges: ridges of which both insides are closest; elsewhere vertices and triangles say the same.

    Only vertices and triangles that do not hang together push each other apart.  Where cloth is pinched, near pairs have no room
    for their thickness, and edges that are close become ridges and cease to be: what pushed them would never rest.
    """
    for m in range(candidates.shape[0]):
        e, f = candidates[m, 0], candidates[m, 1]
        i, j, k, l = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
        more = max(extra[i], extra[j]) + max(extra[k], extra[l])
        if segments_apart(
            p[i, 0], p[i, 1], p[i, 2], p[j, 0], p[j, 1], p[j, 2], p[k, 0], p[k, 1], p[k, 2], p[l, 0], p[l, 1], p[l, 2], reach + more
        ):  # fmt: skip
            continue
        s, t, nx, ny, nz = gap_of_edges(p, i, j, k, l)
        square = nx * nx + ny * ny + nz * nz
        if not square < (reach + more) * (reach + more):
            continue
        scale = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        nearest = min(along(p, i, nx, ny, nz), along(p, j, nx, ny, nz))
        certified = nearest - max(along(p, k, nx, ny, nz), along(p, l, nx, ny, nz))
        room[i], room[j], room[k], room[l] = (
            min(room[i], certified), min(room[j], certified), min(room[k], certified), min(room[l], certified)
        )  # fmt: skip
        left = certified - more
        if left < loose and constraints < members.shape[0]:
            constrain(i, j, k, l, 2, -1, nx, ny, nz, certified, held, stop, standoff, constraints, members, planes)
            constraints += 1
        else:
            set_free(i, j, k, l, certified, left, loose, extra, free)
            report[REPORT_DROPPED] += left < loose
        inside = s > 0.0 and s < 1.0 and t > 0.0 and t < 1.0
        if inside and ridges[e] and ridges[f] and certified > 0.0 and certified <= thickness + margin:
            if count < particles.shape[0]:
                own = min(thickness, max(kept, certified / (1.0 - SLOP)))
                write(i, j, k, l, 1.0 - s, s, t - 1.0, -t, nx, ny, nz, own, count, particles, coefficients)
                count += 1
            else:
                report[REPORT_DROPPED] += 1
    return count, constraints


@apart
def constrain_layers(
    p, corners, leaves, gaps, closest, extra, loose, stop, standoff, held, room, free, layered, constraints, members, planes, report
):
    """Tie pairs of leaves of which a plane shows about the distance that their vertices have, instead of their vertices and
    triangles.  Returns the number of gap constraints.

    gaps: what planes of the leaves show [m], and their normals; the plane across the closest vertex' way may show more.
    layered: becomes which they are.
    """
    for pair in range(leaves.shape[0]):
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
    kept = 0
    for t in range(constraints):
        if members[t, G_GROUP] >= 0 and layered[members[t, G_GROUP]]:
            continue
        if kept < t:
            for c in range(G_SIZE):
                members[kept, c] = members[t, c]
            for c in range(4):
                planes[kept, c] = planes[t, c]
        kept += 1
    for pair in range(leaves.shape[0]):
        if not layered[pair]:
            continue
        leaf, other, gap = leaves[pair, 0], leaves[pair, 1], gaps[pair, 0]
        own, others = 0.0, 0.0
        for m in range(4):
            own, others = max(own, extra[corners[leaf, m]]), max(others, extra[corners[other, m]])
        left = gap - own - others
        constrained = left < loose and kept < members.shape[0]
        report[REPORT_DROPPED] += left < loose and not constrained
        some = False
        for m in range(4):
            for v in (corners[leaf, m], corners[other, m]):
                room[v] = min(room[v], gap)
                some |= held[v]
                if not constrained:
                    free[v] = min(free[v], left if left >= loose else gap - 2.0 * extra[v])
        if constrained:
            nx, ny, nz = gaps[pair, 1], gaps[pair, 2], gaps[pair, 3]
            # the direction is from the second leaf to the first
            way = along(p, corners[leaf, 0], nx, ny, nz) - along(p, corners[other, 0], nx, ny, nz)
            sign = 1.0 if way > 0.0 else -1.0
            members[kept, G_OWN], members[kept, G_NUMBER], members[kept, G_GROUP] = 4, 8, -1
            for m in range(4):
                members[kept, G_VERTICES + m], members[kept, G_VERTICES + 4 + m] = corners[leaf, m], corners[other, m]
            planes[kept, 0], planes[kept, 1], planes[kept, 2] = sign * nx, sign * ny, sign * nz
            planes[kept, G_KEPT] = min(gap, standoff if some else stop)
            kept += 1
    return kept


@inlined
def query(p, pairs, reach, extra, held, bounds, limits, particles, coefficients, members, planes, report):
    """Find what is close in one environment.  Returns the numbers of contacts, which are in ``particles`` and ``coefficients``, and
    of gap constraints, which are in ``members`` and ``planes``.

    p: positions in float64 [m], (particles, 3).  extra: how much farther than the reach is looked for each vertex [m],
    (particles,).  held: particles that hands hold, (particles,).  bounds: becomes how far each vertex may go before a gap
    constraint must be looked at, limits: before a query is due [m], (particles,).  report: (REPORT_SIZE,).
    """
    triangles, edges, triangle_edges = pairs.triangles, pairs.edges, pairs.triangle_edges
    vertex_owner, edge_owner = pairs.vertex_owner, pairs.edge_owner
    unlisted, margin, stop, standoff = min(reach.near, reach.far), reach.margin, reach.stop, reach.standoff
    loose = LOOSE * unlisted
    bounds[:] = unlisted
    limits[:] = unlisted
    faces, ridges = np.empty((3, triangles.shape[0])), np.empty(edges.shape[0], np.bool_)
    faces_of(p, triangles, faces)
    ridges_of(faces, pairs.edge_triangles, ridges)
    near, far, thin, thick = reach.near, reach.far, reach.near_thickness, reach.far_thickness
    corners, sides = near_candidates(p, pairs, near, extra)
    closest = np.zeros((1, 4))
    closest[0, 0] = near
    # a literal would have a type, and so a version of the kernel, of its own
    none = np.int64(0)
    count, constraints = vertex_contacts(
        p, corners, triangles, triangle_edges, vertex_owner, edge_owner, near, extra, thin, 0.0, margin, loose, stop, standoff,
        held, bounds, limits, closest, none, particles, coefficients, none, members, planes, report,
    )  # fmt: skip
    # these belong to no pair of leaves
    members[:constraints, G_GROUP] = -1
    count, constraints = edge_contacts(
        p, sides, edges, ridges, near, extra, thin, 0.0, margin, loose, stop, standoff, held, bounds, limits, count, particles,
        coefficients, constraints, members, planes, report,
    )  # fmt: skip
    leaves, gaps, corners = far_pairs(p, pairs, far, extra, faces)
    closest = np.zeros((leaves.shape[0], 4))
    closest[:, 0] = far
    count, constraints = vertex_contacts(
        p, corners, triangles, triangle_edges, vertex_owner, edge_owner, far, extra, thick, thick, margin, loose, stop, standoff,
        held, bounds, limits, closest, count, particles, coefficients, constraints, members, planes, report,
    )  # fmt: skip
    layered = np.empty(leaves.shape[0], np.bool_)
    constraints = constrain_layers(
        p, pairs.corners, leaves, gaps, closest, extra, loose, stop, standoff, held, bounds, limits, layered, constraints, members,
        planes, report,
    )  # fmt: skip
    sides = far_sides(p, pairs, leaves, layered, ridges, far, extra)
    count, constraints = edge_contacts(
        p, sides, edges, ridges, far, extra, thick, 0.0, margin, loose, stop, standoff, held, bounds, limits, count, particles,
        coefficients, constraints, members, planes, report,
    )  # fmt: skip
    least = unlisted
    for v in range(p.shape[0]):
        least = min(least, bounds[v])
        bounds[v] = SHARE * max(bounds[v] - MARGIN, 0.0)
        limits[v] = SHARE * max(limits[v] - MARGIN + 2.0 * extra[v], 0.0)
    if least < unlisted:
        report[REPORT_GAP] = min(report[REPORT_GAP], max(least, 0.0))
    return count, constraints

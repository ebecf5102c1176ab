"""Smooth contact: which pairs are contacts, along which direction they act, and how far apart the surfaces are along it.

Two surfaces touch where their distance has a local minimum.  There the direction n from the closest point b of the second to the
closest point a of the first lies in the normal cones of both, so that no neighbor is closer along n,

    n . (x - b) <= 0 for the second surface around b,    n . (x - a) >= 0 for the first around a.

Pairs of primitives have closest points elsewhere, too: a vertex that lies above one triangle is close to the edge of the next, and
a vertex of a lower layer to the border of an upper one that comes towards it.  Their directions are aslant, and impulses along them
would brake layers that slide on each other.  They are no contacts: other pairs are closer.

Triangles and edges stand for a smooth sheet through the particles, with a normal N_i at each.  At the point q = sum a_i p_i the
sheet has the direction of sum a_i N_i as its normal, and lies above the flat triangle or edge by

    rise = -1/2 sum a_i N_i . (q - p_i),

which is exact to second order in the size of a triangle, and half of what Phong tessellation takes (Boubekeur and Alexa 2008).
Without it, layers around a cylinder would bump over each other's facets.  Around a vertex at which faces meet at
sharp angles the sheet has no normal, and is as its faces are.  Contact with averaged normals: Puso and Laursen, A mortar
segment-to-segment contact method for large deformation solid mechanics, 2004.

A contact keeps its direction and its points from one query to the next.  They are those of the middle of this time, where the
sheets are *ahead*, if they go on as they did since the last query.  Normals of the start of the interval would lag by half of the
distance slid: on a cylinder this acts as friction, with a coefficient of that distance over twice the radius.

This is done between different pieces of a mesh, that is for sheets on sheets.  Within one sheet, whose folds are as sharp as its
triangles allow, which pairs are contacts would change from query to query, and sheets that are draped would not come to rest: there
contacts act along the distance of the closest points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.self.broad_phase import TINY, is_ridge
from clothgym.collisions.self.topology import Real

TOUCHING = 1e-5  # height up to which a neighbor counts as no closer, so that rounding drops no contact [m]
ALIGNED = 0.8  # cosine of the largest angle between a vertex's normal and the direction of a contact that it may turn
SHARP = 0.5  # angle between neighboring faces [rad] from which they meet at a crease, where the sheet is not smooth
SLOPE = 0.2  # steepest rise of a sheet from its border towards the other side of a contact
RIDGE_SLOPE = 0.05  # the same from a ridge within it
CROSSING = 0.2  # sine of the least angle between two edges whose contact is that of smooth sheets
SMOOTH, BORDER, CREASED = 0, 1, 2  # kinds of vertices


class SmoothSheet(NamedTuple):
    """What is known of the smooth sheet at a query.

    ahead: positions in the middle of the time until the next query [m]; normals: at each vertex, zero on creases, both (particles,
    3); kinds: of vertices, (particles,).
    """

    ahead: Real
    normals: Real
    kinds: NDArray[np.uint8]


@uncounted
def smooth_out(parts, faces, smooth):
    """Find the normals and kinds of the vertices of ``smooth``.  faces: unit normals of now, (3, triangles).

    A face with the sides e and f at a vertex has the normal e x f / (|e|^2 |f|^2) there (Max 1999: their sum is exact where the
    vertices lie on a sphere).
    """
    triangles, edges, edge_triangles = parts.triangles, parts.edges, parts.edge_triangles
    ahead, normals, kinds = smooth.ahead, smooth.normals, smooth.kinds
    normals[:] = 0.0
    kinds[:] = SMOOTH
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        # squared sides, each opposite a corner; of the weights all corners share a factor
        ux, uy, uz = ahead[j, 0] - ahead[i, 0], ahead[j, 1] - ahead[i, 1], ahead[j, 2] - ahead[i, 2]
        wx, wy, wz = ahead[k, 0] - ahead[i, 0], ahead[k, 1] - ahead[i, 1], ahead[k, 2] - ahead[i, 2]
        c, b = ux * ux + uy * uy + uz * uz, wx * wx + wy * wy + wz * wz
        a = b + c - 2.0 * (ux * wx + uy * wy + uz * wz)
        shared = 1.0 / (a * b * c + TINY)
        fx, fy, fz = shared * (uy * wz - uz * wy), shared * (uz * wx - ux * wz), shared * (ux * wy - uy * wx)
        for v, weight in ((i, a), (j, b), (k, c)):
            normals[v, 0], normals[v, 1], normals[v, 2] = (
                normals[v, 0] + weight * fx, normals[v, 1] + weight * fy, normals[v, 2] + weight * fz
            )  # fmt: skip
    # vertices on the border, and on creases
    least = np.cos(SHARP)
    for e in range(edges.shape[0]):
        if not is_ridge(faces, edge_triangles, e):
            continue
        s, t = edge_triangles[e, 0], edge_triangles[e, 1]
        turn = faces[0, s] * faces[0, t] + faces[1, s] * faces[1, t] + faces[2, s] * faces[2, t]
        kind = BORDER if s == t else (SMOOTH if turn >= least else CREASED)
        for v in (edges[e, 0], edges[e, 1]):
            kinds[v] = max(kinds[v], kind)
    for v in range(kinds.shape[0]):
        scale = 1.0 / np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2 + TINY) if kinds[v] != CREASED else 0.0
        normals[v, 0], normals[v, 1], normals[v, 2] = scale * normals[v, 0], scale * normals[v, 1], scale * normals[v, 2]


@kernel
def rises(p, v, nx, ny, nz, slope, triangles, around, around_triangles):
    """Whether the sheet rises from vertex v towards a neighbor, along n by more than ``slope`` times their distance."""
    for m in range(around[v], around[v + 1]):
        for c in range(3):
            q = triangles[around_triangles[m], c]
            dx, dy, dz = p[q, 0] - p[v, 0], p[q, 1] - p[v, 1], p[q, 2] - p[v, 2]
            if nx * dx + ny * dy + nz * dz > TOUCHING + slope * np.sqrt(dx * dx + dy * dy + dz * dz):
                return True
    return False


@inlined
def owns(p, v, t, i, j, k, a, b, c, nx, ny, nz, parts, kinds):
    """Whether triangle t = ijk owns its contact with vertex v, whose closest point has the barycentric weights a, b and c; whether
    no neighbor of that point is closer along the direction n; and whether the sheet is smooth there.

    A closest point inside the triangle belongs to this pair alone.  One on an edge or a corner is shared by several triangles: only
    the one that owns the edge or corner has the contact; of two vertices, which meet twice, only the one with the lower number.
    """
    # inside
    if a != 0.0 and b != 0.0 and c != 0.0:
        return True, True, True
    # on a corner
    if (a == 0.0) + (b == 0.0) + (c == 0.0) == 2:
        corner = i if a != 0.0 else (j if b != 0.0 else k)
        if parts.vertex_owner[corner] != t or v > corner:
            return False, False, False
        rising = rises(p, corner, nx, ny, nz, 0.0, parts.triangles, parts.around, parts.around_triangles)
        return True, not rising, kinds[corner] == SMOOTH
    # on an edge
    edge = parts.triangle_edges[t, 0] if a == 0.0 else (parts.triangle_edges[t, 1] if b == 0.0 else parts.triangle_edges[t, 2])
    if parts.edge_owner[edge] != t:
        return False, False, False
    one, two, other = parts.edges[edge, 0], parts.edges[edge, 1], parts.edge_triangles[edge, 1]
    rising = height(p, opposite(parts.triangles, other, one, two), one, nx, ny, nz) > TOUCHING
    return True, not rising, other != t and (kinds[one] != CREASED or kinds[two] != CREASED)


@inlined
def opposite(triangles, t, one, two):
    """The vertex of triangle t that is neither ``one`` nor ``two``."""
    return triangles[t, 0] + triangles[t, 1] + triangles[t, 2] - one - two


@inlined
def height(p, v, w, nx, ny, nz):
    """Height of vertex v above vertex w along n [m]."""
    return nx * (p[v, 0] - p[w, 0]) + ny * (p[v, 1] - p[w, 1]) + nz * (p[v, 2] - p[w, 2])


@inlined
def towards(mx, my, mz, nx, ny, nz):
    """The unit vector of m or -m, whichever is on the side of the unit vector n; n itself where m is not aligned with it."""
    scale = 1.0 / np.sqrt(mx * mx + my * my + mz * mz + TINY)
    share = scale * (mx * nx + my * ny + mz * nz)
    if not abs(share) >= ALIGNED:
        return nx, ny, nz
    scale = scale if share > 0.0 else -scale
    return scale * mx, scale * my, scale * mz


@inlined
def sided(normals, v, nx, ny, nz):
    """The same for the unit normal at vertex v, which is zero on a crease."""
    share = normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz
    if not abs(share) >= ALIGNED:
        return nx, ny, nz
    sign = 1.0 if share > 0.0 else -1.0
    return sign * normals[v, 0], sign * normals[v, 1], sign * normals[v, 2]


@inlined
def weights_of(dx, dy, dz, ux, uy, uz, wx, wy, wz, fx, fy, fz, square):
    """Barycentric weights of a point's second and third corner.

    d: from the first corner to the point; u, w: to the others; f = u x w, ``square`` = |f|^2.
    """
    b = (dy * wz - dz * wy) * fx + (dz * wx - dx * wz) * fy + (dx * wy - dy * wx) * fz
    c = (uy * dz - uz * dy) * fx + (uz * dx - ux * dz) * fy + (ux * dy - uy * dx) * fz
    return b / square, c / square


@inlined
def rise_at(p, normals, i, share, qx, qy, qz, nx, ny, nz):
    """Vertex i's part of how far the smooth sheet lies above the point q on the side of n [m]."""
    part = normals[i, 0] * (qx - p[i, 0]) + normals[i, 1] * (qy - p[i, 1]) + normals[i, 2] * (qz - p[i, 2])
    side = normals[i, 0] * nx + normals[i, 1] * ny + normals[i, 2] * nz
    return -0.5 * share * (part if side >= 0.0 else -part)


@inlined
def rise_of_triangle(p, normals, i, j, k, a, b, c, nx, ny, nz):
    """How far the smooth sheet lies above a point of triangle ijk's plane on the side of n [m], from its barycentric weights."""
    qx = a * p[i, 0] + b * p[j, 0] + c * p[k, 0]
    qy = a * p[i, 1] + b * p[j, 1] + c * p[k, 1]
    qz = a * p[i, 2] + b * p[j, 2] + c * p[k, 2]
    rise = rise_at(p, normals, i, a, qx, qy, qz, nx, ny, nz) + rise_at(p, normals, j, b, qx, qy, qz, nx, ny, nz)
    return rise + rise_at(p, normals, k, c, qx, qy, qz, nx, ny, nz)


@inlined
def on_vertex(p, v, i, j, k, a, b, c, gap, nx, ny, nz, is_smooth, parts, smooth):
    """The contact of vertex v with the sheet about triangle ijk, from the closest point's weights, gap [m] and direction.

    is_smooth: see ``owns``.  Returns the weights of the point of the triangle's plane below v along the contact's
    normal, the gap along it [m], which is 0 where there is no contact, the normal, and how far the smooth sheet lies
    above that point [m].
    """
    ahead, normals, kinds = smooth.ahead, smooth.normals, smooth.kinds
    # on a border or a crease: along the normal at v, if there is one near the direction; else along that, unless v's sheet rises
    if not is_smooth:
        share = normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz
        if abs(share) >= ALIGNED:
            sx, sy, sz = sided(normals, v, nx, ny, nz)
            return a, b, c, gap * abs(share), sx, sy, sz, rise_of_triangle(p, normals, i, j, k, a, b, c, sx, sy, sz)
        slipping = kinds[v] == SMOOTH
        if not slipping:
            slipping = rises(p, v, -nx, -ny, -nz, SLOPE, parts.triangles, parts.around, parts.around_triangles)
        return a, b, c, 0.0 if slipping else gap, nx, ny, nz, 0.0
    # the triangle's sides and normal, and the point of its plane that is next to v
    ux, uy, uz = ahead[j, 0] - ahead[i, 0], ahead[j, 1] - ahead[i, 1], ahead[j, 2] - ahead[i, 2]
    wx, wy, wz = ahead[k, 0] - ahead[i, 0], ahead[k, 1] - ahead[i, 1], ahead[k, 2] - ahead[i, 2]
    fx, fy, fz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    square = fx * fx + fy * fy + fz * fz + TINY
    dx, dy, dz = ahead[v, 0] - ahead[i, 0], ahead[v, 1] - ahead[i, 1], ahead[v, 2] - ahead[i, 2]
    sb, sc = weights_of(dx, dy, dz, ux, uy, uz, wx, wy, wz, fx, fy, fz, square)
    # the mean of the smooth sheets' normals there and at v
    hx, hy, hz = towards(fx, fy, fz, nx, ny, nz)
    ix, iy, iz = sided(normals, i, hx, hy, hz)
    jx, jy, jz = sided(normals, j, hx, hy, hz)
    kx, ky, kz = sided(normals, k, hx, hy, hz)
    sa = 1.0 - sb - sc
    mx, my, mz = sa * ix + sb * jx + sc * kx, sa * iy + sb * jy + sc * ky, sa * iz + sb * jz + sc * kz
    mx, my, mz = towards(mx, my, mz, hx, hy, hz)
    ex, ey, ez = sided(normals, v, mx, my, mz)
    mx, my, mz = towards(mx + ex, my + ey, mz + ez, mx, my, mz)
    steep = mx * fx + my * fy + mz * fz
    if not steep * steep >= ALIGNED * ALIGNED * square:
        return a, b, c, gap, nx, ny, nz, 0.0
    # down from v along it to the plane, so that impulses along it turn nothing
    down = (dx * fx + dy * fy + dz * fz) / steep
    dx, dy, dz = dx - down * mx, dy - down * my, dz - down * mz
    b, c = weights_of(dx, dy, dz, ux, uy, uz, wx, wy, wz, fx, fy, fz, square)
    a = 1.0 - b - c
    # how far the smooth sheet lies above it, and the gap of now
    rise = rise_of_triangle(ahead, normals, i, j, k, a, b, c, mx, my, mz)
    gap = a * height(p, v, i, mx, my, mz) + b * height(p, v, j, mx, my, mz) + c * height(p, v, k, mx, my, mz)
    return a, b, c, gap, mx, my, mz, rise


@inlined
def can_touch(p, e, i, j, nx, ny, nz, parts):
    """Whether edge e = ij may be in contact towards n: no adjacent face rises along n."""
    first, second = parts.edge_triangles[e, 0], parts.edge_triangles[e, 1]
    slope = SLOPE if first == second else RIDGE_SLOPE
    for t in (first, second):
        v = opposite(parts.triangles, t, i, j)
        dx, dy, dz = p[v, 0] - p[i, 0], p[v, 1] - p[i, 1], p[v, 2] - p[i, 2]
        if nx * dx + ny * dy + nz * dz > TOUCHING + slope * np.sqrt(dx * dx + dy * dy + dz * dz):
            return False
    return True


@inlined
def on_edges(p, e, f, i, j, k, l, s, t, gap, nx, ny, nz, parts, smooth):
    """The contact of edge e = ij with edge f = kl, from the parameters s and t of their closest points, gap [m] and direction n.

    Returns the parameters of the points that lie on each other along the contact's normal, the gap along it [m], which is 0 where
    there is no contact, the normal, and by how much less the smooth sheets are apart [m].
    """
    ahead, normals = smooth.ahead, smooth.normals
    # the mean of the sheets' normals
    mx, my, mz = 0.0, 0.0, 0.0
    for q, share in ((i, 1.0 - s), (j, s), (k, 1.0 - t), (l, t)):
        ex, ey, ez = sided(normals, q, nx, ny, nz)
        mx, my, mz = mx + share * ex, my + share * ey, mz + share * ez
    mx, my, mz = towards(mx, my, mz, nx, ny, nz)
    # the points on each other along it; edges that are nearly parallel have none, and touch only where no adjacent face rises
    ux, uy, uz = ahead[j, 0] - ahead[i, 0], ahead[j, 1] - ahead[i, 1], ahead[j, 2] - ahead[i, 2]
    wx, wy, wz = ahead[l, 0] - ahead[k, 0], ahead[l, 1] - ahead[k, 1], ahead[l, 2] - ahead[k, 2]
    cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    steep = mx * cx + my * cy + mz * cz
    if not steep * steep >= CROSSING * CROSSING * (ux * ux + uy * uy + uz * uz) * (wx * wx + wy * wy + wz * wz):
        touch = can_touch(p, e, i, j, -nx, -ny, -nz, parts) and can_touch(p, f, k, l, nx, ny, nz, parts)
        return s, t, gap if touch else 0.0, nx, ny, nz, 0.0
    dx, dy, dz = ahead[i, 0] - ahead[k, 0], ahead[i, 1] - ahead[k, 1], ahead[i, 2] - ahead[k, 2]
    down = (dx * cx + dy * cy + dz * cz) / steep
    s = -(dx * (wy * mz - wz * my) + dy * (wz * mx - wx * mz) + dz * (wx * my - wy * mx)) / steep
    t = -(dx * (uy * mz - uz * my) + dy * (uz * mx - ux * mz) + dz * (ux * my - uy * mx)) / steep
    # how far the smooth sheets lie between them
    qx, qy, qz = ahead[i, 0] + s * ux, ahead[i, 1] + s * uy, ahead[i, 2] + s * uz
    rise = rise_at(ahead, normals, i, 1.0 - s, qx, qy, qz, -mx, -my, -mz) + rise_at(ahead, normals, j, s, qx, qy, qz, -mx, -my, -mz)
    qx, qy, qz = qx - down * mx, qy - down * my, qz - down * mz
    rise += rise_at(ahead, normals, k, 1.0 - t, qx, qy, qz, mx, my, mz) + rise_at(ahead, normals, l, t, qx, qy, qz, mx, my, mz)
    gap = (1.0 - s) * height(p, i, k, mx, my, mz) + s * height(p, j, k, mx, my, mz) - t * height(p, l, k, mx, my, mz)
    return s, t, gap, mx, my, mz, rise

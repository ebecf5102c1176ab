"""Closed meshes, distances that the code under test did not produce, and the deepest point of a sheet by dense sampling."""

import numpy as np


def box_mesh(half=(0.1, 0.1, 0.1)):
    """The eight corners of a box, and its twelve triangles."""
    return rectilinear(np.ones((1, 1, 1), bool), *([-h, h] for h in half))


def chair(width=0.4, leg=0.03, seat=0.2, thick=0.03, height=0.45):
    """Four legs, a seat and a back."""
    filled = np.zeros((3, 3, 3), bool)
    filled[::2, ::2, 0] = filled[:, :, 1] = filled[:, 2, 2] = True
    side = [-width / 2, leg - width / 2, width / 2 - leg, width / 2]
    return rectilinear(filled, side, side, [0, seat, seat + thick, height])


def rectilinear(filled, xs, ys, zs):
    """Surface of the filled cells of a grid with those planes."""
    filled = np.pad(filled, 1)
    quads = []
    for cell in np.argwhere(filled):
        for axis in range(3):
            for side in (0, 1):
                beside = cell.copy()
                beside[axis] += 2 * side - 1
                if filled[tuple(beside)]:
                    continue
                corner = cell - 1
                corner[axis] += side
                u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
                quad = [corner, corner + u, corner + u + v, corner + v]
                quads.append(quad if side else quad[::-1])
    places, which = np.unique(np.array(quads).reshape(-1, 3), axis=0, return_inverse=True)
    quads = which.reshape(-1, 4)
    vertices = np.stack([np.asarray(line, float)[places[:, c]] for c, line in enumerate((xs, ys, zs))], axis=1)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def bowl(outer=0.15, inner=0.12, around=32, down=10):
    """The lower half of a thick shell, open at the top, with its middle at the origin."""
    angle = np.linspace(0, np.pi / 2, down + 1)
    profile = [(outer * np.sin(a), -outer * np.cos(a)) for a in angle] + [
        (inner * np.sin(a), -inner * np.cos(a)) for a in angle[::-1]
    ]
    turn = 2 * np.pi * np.arange(around) / around
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(around, z)], axis=1) for r, z in profile[1:-1]]
    vertices = np.concatenate([[(0, 0, profile[0][1])], *rings, [(0, 0, profile[-1][1])]])
    last, triangles = len(vertices) - 1, []
    for q in range(around):
        a, b = 1 + q, 1 + (q + 1) % around
        triangles.append((0, b, a))
        for k in range(0, (len(rings) - 1) * around, around):
            triangles += [(a + k, b + k, a + k + around), (b + k, b + k + around, a + k + around)]
        far = (len(rings) - 1) * around
        triangles.append((last, a + far, b + far))
    return vertices, np.array(triangles)


def rotation(w, x, y, z):
    """Matrix of a quaternion, by Rodrigues' formula."""
    w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


ON_ITS_CORNER = (0.8880738, 0.3250576, -0.3250576, 0.0)  # takes (1, 1, 1) to z


def sphere_distance(x, radius):
    return np.linalg.norm(x, axis=-1) - radius


def capsule_distance(x, axis, radius, height):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    along = np.clip(x @ axis, radius - height / 2, height / 2 - radius)
    return np.linalg.norm(x - along[..., None] * axis, axis=-1) - radius


def box_distance(x, half, turn):
    a = np.abs(x @ turn) - half
    return np.linalg.norm(np.maximum(a, 0), axis=-1) + np.minimum(a.max(axis=-1), 0)


def mesh_distance(x, vertices, triangles):
    """To the nearest of all triangles; inside where the solid angle is a whole sphere's (van Oosterom and Strackee 1983)."""
    from trimesh.triangles import closest_point

    out = []
    for some in np.array_split(x, max(1, len(x) * len(triangles) // 400_000)):
        points, corners = np.repeat(some, len(triangles), axis=0), np.tile(vertices[triangles], (len(some), 1, 1))
        distance = np.linalg.norm(closest_point(corners, points) - points, axis=1).reshape(len(some), -1).min(axis=1)
        a, b, c = (corners[:, k] - points for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        over = np.sum(a * np.cross(b, c), axis=1)
        under = la * lb * lc + np.sum(a * b, axis=1) * lc + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
        angle = 2 * np.arctan2(over, under).reshape(len(some), -1).sum(axis=1)
        out.append(np.where(angle > 2 * np.pi, -distance, distance))
    return np.concatenate(out)


def depth(x, triangles, distance, pieces=8):
    """How deep the deepest of many points of the sheet's triangles is [m]; x: (particles, 3)."""
    weights = np.array([(i, j, pieces - i - j) for i in range(pieces + 1) for j in range(pieces + 1 - i)]) / pieces
    points = np.einsum("bc,tcd->tbd", weights, np.asarray(x, float)[triangles]).reshape(-1, 3)
    return max(0.0, -float(distance(points).min()))

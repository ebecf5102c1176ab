"""How well a garment is flattened, put into its canonical pose or folded: our own measures, and those of other benchmarks.

All take positions of one garment [m], (particles, 3), z up, with the floor along x and y.  A goal is the positions that the same
particles should have: the garment at rest in the canonical pose, or an ideal fold, which ``fold_over`` makes.

* ours: ``vertex_distance``, ``overlap`` and ``coverage``;
* ``funnels_distance``: Canberk et al. 2022, Cloth Funnels (arXiv 2210.09347), ``deformable_distance`` of
  real-stanford/cloth-funnels at 1fb231e;
* ``softgym_coverage``: Lin et al. 2020, SoftGym (arXiv 2011.07215), its cloth_flatten task;
* ``lehome_conditions``: ``success_checker_garment_fold`` of lehome-official/lehome-challenge at 23127e9.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import apart, kernel
from clothgym.checks import finite, known, not_negative, numbers, positive
from clothgym.envs.coverage import FINE_CELL, covered_area, shared_area, softgym_area
from clothgym.garments import Garment
from clothgym.mesh import SHEAR, ClothMesh

SOFTGYM_RADIUS = 0.00625  # of SoftGym's particles [m]
OUTLIERS, PASSES, SHAPE = 0.3, 5, 0.65  # of Cloth Funnels: inliers in roots of the area, alignments, weight of the shape


class Condition(NamedTuple):
    """A condition of LeHome: the distance of two key points is at most, or at least, a limit [m]."""

    first: str
    second: str
    at_most: bool
    limit: float


# Each of LeHome's garments has limits of its own.  Here upper limits are the defaults of its source [m], lower limits shares of
# the distance on the flat garment, so that a garment of any size can reach them.  Both middle points of trousers are the crotch
NEAR, SLEEVES, WIDTH, KEPT = 0.10, 0.16, 0.4, 0.7
_TOP = (("shoulder_left", "waist_left", True, NEAR), ("sleeve_bottom_left", "sleeve_bottom_right", True, SLEEVES),
        ("shoulder_right", "waist_right", True, NEAR), ("shoulder_left", "shoulder_right", False, WIDTH),
        ("waist_left", "waist_right", False, WIDTH))  # fmt: skip
_TROUSERS = (("waist_left", "pipe_outer_left", True, NEAR), ("waist_left", "crotch", False, KEPT),
             ("waist_right", "crotch", False, KEPT), ("waist_right", "pipe_outer_right", True, NEAR))  # fmt: skip
_SHORTS = (("waist_left", "waist_right", True, NEAR), ("pipe_outer_left", "pipe_outer_right", True, NEAR),
           ("waist_left", "pipe_outer_left", False, KEPT), ("waist_right", "pipe_outer_right", False, KEPT))  # fmt: skip
LEHOME = {"tshirt": _TOP, "trousers": _TROUSERS, "shorts": _SHORTS}


def fold_over(x: ArrayLike, point: ArrayLike, normal: ArrayLike, layer: float) -> NDArray[np.float64]:
    """Positions after an ideal fold [m], (particles, 3): what lies beyond a line is mirrored at it, upside down.

    Args:
        x: flat positions [m], (particles, 3).
        point, normal: a point of the line [m], and the direction in the plane to the side that is folded, (2,) each.
        layer: height of the lowest folded particle above the highest of those that stay [m].

    Raises:
        ValueError: positions of another shape, a normal without a direction, or a negative layer.
    """
    x, point, normal = _sheet("x", x), numbers("point", point, (2,)), numbers("normal", normal, (2,))
    layer = not_negative("layer", layer)
    normal = normal / positive("length of normal", float(np.linalg.norm(normal)))
    beyond = (x[:, :2] - point) @ normal
    moved, folded = x.copy(), beyond > 0
    if folded.any() and not folded.all():
        moved[folded, :2] -= 2 * beyond[folded, None] * normal
        moved[folded, 2] = x[~folded, 2].max() + layer + x[folded, 2].max() - x[folded, 2]
    return moved


def flat_area(garment: Garment) -> float:
    """Area that the flat garment covers [m^2]: of one layer, not of the cloth."""
    return float(covered_area(_columns(garment.mesh.rest_positions), garment.mesh.triangles, FINE_CELL))


def vertex_distance(x: ArrayLike, goal: ArrayLike, area: float) -> float:
    """Mean distance of the particles from the goal over the root of the area, after the best rotation about z and horizontal shift.

    The rotation minimizes the sum of squares (Kabsch 1976, in the plane).  Times the root of the area, it is a fold's error [m].
    """
    x, goal, area = _sheet("x", x), _sheet("goal", goal), positive("area", area)
    one, two = x - x.mean(axis=0) * [1, 1, 0], goal - goal.mean(axis=0) * [1, 1, 0]
    along = np.sum(one[:, :2] * two[:, :2])
    across = np.sum(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    size = np.hypot(along, across)
    c, s = (along / size, across / size) if size > 0 else (1.0, 0.0)
    turned = np.stack([c * one[:, 0] - s * one[:, 1], s * one[:, 0] + c * one[:, 1], one[:, 2]], axis=1)
    return float(np.linalg.norm(turned - two, axis=1).mean() / np.sqrt(area))


def overlap(x: ArrayLike, goal: ArrayLike, triangles: NDArray, cell: float = FINE_CELL) -> float:
    """Intersection over union of the areas that garment and goal cover, seen from above, where they lie.

    triangles: of the mesh, (triangles, 3).  cell: side of the cells in which areas are counted [m].
    """
    both, either = shared_area(_columns(_sheet("x", x)), _columns(_sheet("goal", goal)), triangles, positive("cell", cell))
    return float(both / either)


def coverage(x: ArrayLike, triangles: NDArray, area: float, cell: float = FINE_CELL) -> float:
    """Covered area over that of the flat garment, at most 1; arguments as for ``overlap`` and ``flat_area``."""
    return min(float(covered_area(_columns(_sheet("x", x)), triangles, positive("cell", cell))) / positive("area", area), 1.0)


class FunnelsDistance(NamedTuple):
    """Cloth Funnels' distance over the root of the area: ``0.65 shape + 0.35 pose``, and both parts."""

    weighted: float
    shape: float
    pose: float


def funnels_distance(x: ArrayLike, goal: ArrayLike, area: float) -> FunnelsDistance:
    """Cloth Funnels' distance of a garment from a canonical pose that is symmetric in x, seen from above.

    shape: mean distance after the garment is superimposed on the goal; five passes leave out what is farther than 0.3 roots of the
    area.  pose: mean distance of the goal from itself, superimposed on the garment.  Each is the smaller of those from the goal and
    from the mirrored goal.  As in the source, rotations are those of space, so that a garment may be turned over.
    """
    x, goal, area = _columns(_sheet("x", x)), _columns(_sheet("goal", goal)), positive("area", area)
    return FunnelsDistance(*funnels(x, goal, np.sqrt(area)))


@kernel
def _superimpose(x, goal, limit):
    """Move points rigidly, in place, so that those that lie within a limit of their goals come closest to these (Kabsch 1976).

    A rotation of space takes the plane to itself by a rotation or a reflection.  The best of each has a closed form as in
    ``fold.aligned``; that of both is the one with the larger sum of products.  x, goal: [m], (2, particles).  limit: [m].
    """
    # both centers
    near, px, py, gx, gy = 0, 0.0, 0.0, 0.0, 0.0
    for p in range(x.shape[1]):
        if (x[0, p] - goal[0, p]) ** 2 + (x[1, p] - goal[1, p]) ** 2 < limit * limit:
            near, px, py, gx, gy = near + 1, px + x[0, p], py + x[1, p], gx + goal[0, p], gy + goal[1, p]
    if near == 0:
        return
    px, py, gx, gy = px / near, py / near, gx / near, gy / near
    # sums of products
    xx = xy = yx = yy = 0.0
    for p in range(x.shape[1]):
        if (x[0, p] - goal[0, p]) ** 2 + (x[1, p] - goal[1, p]) ** 2 < limit * limit:
            a, b, u, v = x[0, p] - px, x[1, p] - py, goal[0, p] - gx, goal[1, p] - gy
            xx, xy, yx, yy = xx + a * u, xy + a * v, yx + b * u, yy + b * v
    turned, mirrored = (xx + yy) ** 2 + (xy - yx) ** 2, (xx - yy) ** 2 + (xy + yx) ** 2
    way = 1.0 if turned >= mirrored else -1.0
    c, s = xx + way * yy, xy - way * yx
    size = max(np.sqrt(c * c + s * s), 1e-30)
    c, s = c / size, s / size
    for p in range(x.shape[1]):
        a, b = x[0, p] - px, x[1, p] - py
        x[0, p], x[1, p] = gx + c * a - way * s * b, gy + s * a + way * c * b


@kernel
def _away(x, goal):
    """Mean distance of points from their goals, or from these mirrored in x if that is less [m]."""
    one, other = 0.0, 0.0
    for p in range(x.shape[1]):
        across = (x[1, p] - goal[1, p]) ** 2
        one += np.sqrt((x[0, p] - goal[0, p]) ** 2 + across)
        other += np.sqrt((x[0, p] + goal[0, p]) ** 2 + across)
    return min(one, other) / x.shape[1]


@apart
def funnels(x, goal, root):
    """The numbers of ``FunnelsDistance``; x, goal: [m], (2 or 3, particles).  root: of the area [m]."""
    count, limit = x.shape[1], OUTLIERS * root
    own, shaped, posed, two = np.empty((2, count)), np.empty((2, count)), np.empty((2, count)), np.empty((2, count))
    for p in range(count):
        for c in range(2):
            own[c, p] = shaped[c, p] = x[c, p]
            two[c, p] = posed[c, p] = goal[c, p]
    _superimpose(shaped, two, np.inf)
    for _ in range(PASSES):
        _superimpose(shaped, two, limit)
    _superimpose(posed, own, np.inf)
    _superimpose(posed, own, limit)
    shape, pose = _away(shaped, two) / root, _away(posed, two) / root
    return SHAPE * shape + (1 - SHAPE) * pose, shape, pose


def softgym_coverage(x: ArrayLike, flat: ArrayLike, radius: float = SOFTGYM_RADIUS) -> float:
    """SoftGym's covered area over that of the flat garment: 100 x 100 cells in the bounding box of the particles, marked within a
    radius [m] of each.  It depends on the pose, and on the spacing of the particles if this exceeds the diameter."""
    radius = positive("radius", radius)
    return float(softgym_area(_columns(_sheet("x", x)), radius) / softgym_area(_columns(_sheet("flat", flat)), radius))


def lehome_limits(garment: Garment) -> list[Condition]:
    """LeHome's conditions for a fold of this garment, with limits that suit its size.

    Raises:
        ValueError: a kind of garment for which LeHome has none, or key points that are not there.
    """
    known("garment with conditions of LeHome", garment.kind, LEHOME)
    x, points = garment.mesh.rest_positions, garment.key_points
    found = []
    for first, second, at_most, value in LEHOME[garment.kind]:
        flat = float(np.linalg.norm(x[points[first]] - x[points[second]]))
        found.append(Condition(first, second, at_most, value if at_most else value * flat))
    return found


def lehome_conditions(garment: Garment, x: ArrayLike, conditions: list[Condition] | None = None) -> list[bool]:
    """Which of LeHome's conditions hold; those of ``lehome_limits`` by default.  The fold is a success if all do."""
    x = _sheet("x", x)
    held = []
    for first, second, at_most, limit in lehome_limits(garment) if conditions is None else conditions:
        distance = np.linalg.norm(x[garment.key_points[first]] - x[garment.key_points[second]])
        held.append(bool(distance <= limit if at_most else distance >= limit))
    return held


def geodesic_distances(mesh: ClothMesh, points: Mapping[str, int]) -> NDArray[np.float64]:
    """Lengths of the shortest ways between key points along edges [m], (points, points).

    No pose of a sheet that does not stretch has them farther apart, so that a larger lower limit cannot be reached.
    """
    from scipy.sparse import coo_matrix  # takes long to import
    from scipy.sparse.csgraph import dijkstra

    ends, length, kind, _ = mesh.springs
    edges = kind <= SHEAR
    graph = coo_matrix((length[edges], ends[edges].T), shape=(mesh.num_particles, mesh.num_particles))
    which = list(points.values())
    return dijkstra(graph, directed=False, indices=which)[:, which]


def _sheet(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Positions of one garment as an array, (particles, 3)."""
    x = finite(name, value)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise ValueError(f"{name} has shape {x.shape}: must be (particles, 3), of one garment")
    return x


def _columns(x: NDArray) -> NDArray[np.float64]:
    """Positions as kernels read them, (3, particles)."""
    return np.ascontiguousarray(x.T, np.float64)

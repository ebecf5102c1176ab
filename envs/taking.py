"""Next grasp points of two grippers on a rumpled sheet: both ends of an edge, or one corner and then a neighboring corner.

A gripper grasps all particles within its reach, so it approaches a corner from a direction with no other cloth within reach.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined, kernel
from clothgym.envs.gripper_task import CORNERS, REACH
from clothgym.envs.measures import distance, length_of, squared_distance
from clothgym.envs.observing import Observation
from clothgym.envs.pick_place import LOWEST
from clothgym.mesh import ClothMesh

AWAY = 0.85 * REACH  # distance of a tip from the corner that it grasps [m]
CLEAR = 1.1 * REACH  # distance from the tip within which no other cloth may be [m]
REACHED = 0.95 * REACH  # distance at which a tip that the floor has moved still grasps the corner [m]
NOT_REACHED = 1000  # penalty, in particles, of a grasp point from which the corner is out of reach
# corners of each edge, and of the opposite one, in matching order, as indices in ``mesh.corners``
EDGES = np.array([[0, 1], [1, 3], [3, 2], [2, 0]])
OPPOSITE = np.array([[2, 3], [0, 2], [1, 0], [3, 1]])
BEYOND = 0.008  # largest distance of a grasp point beyond the arena of the tips [m]
SPAN = 0.1  # least distance along x between the ends of an edge that is grasped with other cloth [m]
OUTSIDE = 10.0  # cost of a meter by which an end lies beyond the arena; grasping the sides costs as much as one meter
ABOVE = 0.015  # height of a tip above the particle of a side that it grasps [m]
TOO_CLOSE = 0.25  # distance of corners below which an edge counts as folded up, in sides
# heights of a gripper, in sides, above which it has lifted a single corner, and an edge, high enough
LIFTED = (0.9, 1.17)
FLAT = 0.005  # excess of the coverage over a success above which a sheet is left alone
NEXT_TO = 0.01  # length scale of the observed distance to a grasp point [m]
# costs of a distance of one side, and of a height of one side, in grasped other particles
WAY_TO_NEIGHBOR, WAY_TO_CORNER, HEIGHT_OF_CORNER = 0.5, 0.3, 2.0


def _directions() -> NDArray:
    """Unit vectors from a corner to possible tips: straight up, and in rings, (directions, 3)."""
    rings = [(0.0, 0.0, 1.0)]
    for up, count in ((0.75, 6), (0.35, 8), (0.0, 8)):
        angles = 2 * np.pi * (np.arange(count) + 0.5 * (up > 0.5)) / count
        out = np.sqrt(1 - up**2)
        rings += [(out * np.cos(a), out * np.sin(a), up) for a in angles]
    return np.array(rings)


DIRECTIONS = _directions()


def neighbors_of(mesh: ClothMesh, corners: NDArray, spacing: float) -> NDArray:
    """Neighbors of each corner, which a grasp may include, (4, particles), as 0 or 1: records hold no bool arrays.

    corners: their particles, (4,).  spacing: of the particles [m].
    """
    rest = mesh.rest_positions
    return (np.linalg.norm(rest[corners][:, None] - rest, axis=2) < 1.5 * spacing).astype(np.uint8)


def corner_neighbors(mesh: ClothMesh) -> NDArray:
    """The same of the corners of a grid."""
    return neighbors_of(mesh, np.array(mesh.corners), max(mesh.spacing))


@apart
def take_corners(x, corners, neighbors, places, others):
    """Tip positions that grasp each corner with the least other cloth [m], (4, 3), and the number of other particles, (4,), out.

    x: a sheet [m], (3, particles).  corners: their particles.  neighbors: see ``corner_neighbors``.
    """
    tips, count = np.empty(DIRECTIONS.shape), np.empty(len(DIRECTIONS), np.int64)
    for k in range(len(corners)):
        at = x[:, corners[k]]
        # the floor stops a tip, perhaps too far from the corner
        for d in range(len(DIRECTIONS)):
            for c in range(3):
                tips[d, c] = at[c] + AWAY * DIRECTIONS[d, c]
            tips[d, 2] = max(tips[d, 2], LOWEST)
            count[d] = 0 if squared_distance(tips[d], at) < REACHED**2 else NOT_REACHED
        # only particles near the corner can be within reach
        for p in range(x.shape[1]):
            if neighbors[k, p] == 0 and squared_distance(x[:, p], at) < (AWAY + CLEAR) ** 2:
                for d in range(len(DIRECTIONS)):
                    count[d] += squared_distance(tips[d], x[:, p]) < CLEAR**2
        # ties go to the first: straight up is best
        best = np.argmin(count)
        others[k] = count[best]
        for c in range(3):
            places[k, c] = tips[best, c]


@inlined
def _free_edge(x, corners, edge_costs, tips, places, others, side, goals, count):
    """Both ends of the nearest edge with free corners and no extra cost; returns whether there is one."""
    least, best, crossed = np.inf, -1, 0
    for e in range(EDGES.shape[0]):
        a, b = EDGES[e, 0], EDGES[e, 1]
        if others[a] + others[b] > 0 or edge_costs[a, b] > 0 or distance(x[:, corners[a]], x[:, corners[b]]) < TOO_CLOSE * side:
            continue
        straight = distance(tips[0], places[a]) + distance(tips[1], places[b])
        across = distance(tips[0], places[b]) + distance(tips[1], places[a])
        if min(straight, across) < least:
            least, best, crossed = min(straight, across), e, int(across < straight)
    if best < 0:
        return False
    for k in range(2):
        corner = EDGES[best, k ^ crossed]
        count[k] = others[corner]
        for c in range(3):
            goals[k, c] = places[corner, c]
    return True


@apart
def next_takes(x, corners, neighbors, edge_costs, holder, tips, side, low, high, goals, count):
    """Next grasp point of each gripper [m], (2, 3), and the number of other particles there, or -1 for no grasp point, (2,), out.

    Both go to the nearest edge with free corners that costs nothing extra.  If there is none, one goes to the corner with the least
    other cloth.  While one holds a corner, the other goes to a neighboring corner.

    x: a sheet [m], (3, particles).  edge_costs: extra cost of the edge between two corners, in other particles, (4, 4).  holder:
    gripper that holds each particle, or -1.  tips: [m], (2, 3).  side: L [m].  low, high: corners of the arena of the tips [m],
    (3,); a grasp from beyond the arena counts as one with 1000 others.
    """
    places, others = np.empty((CORNERS, 3)), np.empty(CORNERS, np.int64)
    take_corners(x, corners, neighbors, places, others)
    # corners out of reach are not free
    for i in range(CORNERS):
        for c in range(3):
            if not low[c] - BEYOND <= places[i, c] <= high[c] + BEYOND:
                others[i] += NOT_REACHED
    # whether each gripper holds something, and its first corner
    own = np.full(2, -1)
    holding = np.zeros(2, np.bool_)
    for p in range(len(holder)):
        if holder[p] >= 0:
            holding[holder[p]] = True
    for i in range(CORNERS):
        if holder[corners[i]] >= 0 and own[holder[corners[i]]] < 0:
            own[holder[corners[i]]] = i
    count[:] = -1
    # both hold something, or one holds something other than a corner
    if (holding[0] and holding[1]) or (holding[0] and own[0] < 0) or (holding[1] and own[1] < 0):
        return
    taker, which, least = -1, -1, np.inf
    if holding[0] or holding[1]:
        # the neighboring corner with the least cost
        taker = 1 if holding[0] else 0
        for i in range(CORNERS):
            if holder[corners[i]] >= 0 or i == CORNERS - 1 - own[1 - taker]:
                continue
            cost = others[i] + edge_costs[i, own[1 - taker]] + WAY_TO_NEIGHBOR * distance(places[i], tips[taker]) / side
            if cost < least:
                least, which = cost, i
    elif not _free_edge(x, corners, edge_costs, tips, places, others, side, goals, count):
        # the corner with the least cost, which decreases with height
        for i in range(CORNERS):
            ways = distance(tips[0], places[i]), distance(tips[1], places[i])
            cost = others[i] + WAY_TO_CORNER * min(ways[0], ways[1]) / side - HEIGHT_OF_CORNER * x[2, corners[i]] / side
            if cost < least:
                least, which, taker = cost, i, int(ways[1] < ways[0])
    if which >= 0:
        count[taker] = others[which]
        for c in range(3):
            goals[taker, c] = places[which, c]


@inlined
def _first_within(x, one, other, columns, low, high, place):
    """First point inside the arena along the side of a sheet from one corner to another; returns whether there is one."""
    step = (1 if abs(other - one) < columns else columns) * (1 if other > one else -1)
    for p in range(one, other + step, step):
        inside = low[0] < x[0, p] < high[0] and low[1] < x[1, p] < high[1] and x[2, p] < high[2]
        if inside:
            for c in range(3):
                place[c] = x[c, p]
            place[2] += ABOVE
            return True
    return False


@apart
def next_edge(x, corners, neighbors, columns, tips, low, high, goals, count):
    """Grasp points of both grippers on the next edge [m], (2, 3), and the number of other particles there, or -1, (2,), out.

    It is the edge with the least cost: the distances of both tips in meters, plus the other particles near both corners, plus
    OUTSIDE for each meter by which an end lies beyond the arena.  The first gripper takes the end with the smaller x, and the ends
    are at least SPAN apart along x.  If one lies farther than BEYOND outside, both grasp the sides that start at the ends, at their
    first points inside the arena: that costs as much as a meter outside, and counts as 1000 others.  Points are clipped to the
    arena.

    x: a sheet [m], (3, particles).  columns: particles along x of the flat sheet.  tips: [m], (2, 3).  low, high: corners of the
    arena of the tips [m], (3,).
    """
    places, others = np.empty((CORNERS, 3)), np.empty(CORNERS, np.int64)
    take_corners(x, corners, neighbors, places, others)
    ends = np.empty((2, 3))
    least = np.inf
    count[:] = -1
    for e in range(EDGES.shape[0]):
        crossed = int(x[0, corners[EDGES[e, 0]]] >= x[0, corners[EDGES[e, 1]]])
        outside, within = 0.0, True
        for k in range(2):
            corner = EDGES[e, k ^ crossed]
            for c in range(3):
                ends[k, c] = places[corner, c]
                outside = max(outside, low[c] - ends[k, c], ends[k, c] - high[c])
        if outside > BEYOND:
            outside = 1.0
            for k in range(2):
                one, other = corners[EDGES[e, k ^ crossed]], corners[OPPOSITE[e, k ^ crossed]]
                within = within and _first_within(x, one, other, columns, low, high, ends[k])
        if not within or ends[1, 0] - ends[0, 0] < SPAN:
            continue
        more = others[EDGES[e, 0]] + others[EDGES[e, 1]]
        cost = more + OUTSIDE * outside + distance(tips[0], ends[0]) + distance(tips[1], ends[1])
        if cost < least:
            least = cost
            for k in range(2):
                count[k] = others[EDGES[e, k ^ crossed]] if outside <= BEYOND else NOT_REACHED
                for c in range(3):
                    goals[k, c] = min(max(ends[k, c], low[c]), high[c])


@inlined
def _show_next(sheet, seen):
    """Convert the points and counts in ``seen.next`` to observations."""
    for tip in range(sheet.holds.shape[0]):
        others = seen.next[tip, 3]
        if others >= 0:
            seen.next[tip, 3] = 1 / (1 + others)
            for c in range(3):
                seen.next[tip, c] -= sheet.attachments[tip, c]
            # resolve small distances best: a direction, times a number that rises from 0 to 1
            far = length_of(seen.next[tip]) + NEXT_TO
            for c in range(3):
                seen.next[tip, c] /= far
        else:
            seen.next[tip] = 0


@inlined
def observe_next(own, rules, sheet, seen, edges):
    """Next grasp point of each gripper; zero while a released sheet is flat.

    edges: whether free grippers take an edge even with other cloth on it.
    """
    seen.next[:] = 0
    x, tips, low, high = sheet.x, sheet.attachments, rules.low, rules.high
    places, count = seen.next[:, :3], seen.next[:, 3]
    holding = sheet.holds.any()
    if not holding and own.coverage >= rules.enough + FLAT:
        return
    if edges and not holding:
        next_edge(x, rules.corners, rules.corner_neighbors, rules.columns, tips, low, high, places, count)
    else:
        next_takes(
            x, rules.corners, rules.corner_neighbors, rules.edge_costs, sheet.holder, tips, rules.side, low, high, places, count
        )
    _show_next(sheet, seen)


def _of(task: Any) -> tuple[Any, ...]:
    """Positions of a task's sheets [m], (num_envs, 3, particles), and tips [m]; their corners, and the neighbors of these."""
    simulation, rules = task.simulation, task.rules[0]
    x = np.ascontiguousarray(simulation.positions.transpose(0, 2, 1).astype(np.float64))
    return x, simulation.grippers.positions.astype(np.float64), rules["corners"], rules["corner_neighbors"]


@kernel
def _all_next_takes(x, corners, neighbors, edge_costs, holder, tips, side, low, high, goals, count):
    """``next_takes`` of many sheets, (sheets, 3, particles)."""
    for sheet in range(x.shape[0]):
        next_takes(
            x[sheet], corners, neighbors, edge_costs, holder[sheet], tips[sheet], side, low, high, goals[sheet], count[sheet]
        )


def next_takes_of(task: Any) -> tuple[NDArray, NDArray]:
    """Next grasp point of each gripper of a task [m], (num_envs, 2, 3), and ``count`` of ``next_takes``, (num_envs, 2)."""
    x, tips, corners, neighbors = _of(task)
    goals, count = np.zeros(tips.shape), np.empty(tips.shape[:2], np.int64)
    holder = np.ascontiguousarray(task.simulation.grippers.holder)
    _all_next_takes(
        x, corners, neighbors, task.rules[0]["edge_costs"], holder, tips, task.physics.side, *task.arena(), goals, count
    )
    return goals, count


@kernel
def _all_next_edges(x, corners, neighbors, columns, tips, low, high, goals, count):
    """``next_edge`` of many sheets, (sheets, 3, particles)."""
    for sheet in range(x.shape[0]):
        next_edge(x[sheet], corners, neighbors, columns, tips[sheet], low, high, goals[sheet], count[sheet])


def next_edges_of(task: Any) -> tuple[NDArray, NDArray]:
    """Grasp points of a task's grippers on the next edge [m], (num_envs, 2, 3), and ``count`` of ``next_edge``, (num_envs, 2)."""
    x, tips, corners, neighbors = _of(task)
    goals, count = np.zeros(tips.shape), np.empty(tips.shape[:2], np.int64)
    _all_next_edges(x, corners, neighbors, task.physics.mesh.grid_shape[1], tips, *task.arena(), goals, count)
    return goals, count


@kernel
def _take_all(x, corners, neighbors, places, others):
    """``take_corners`` of many sheets, (sheets, 3, particles)."""
    for sheet in range(x.shape[0]):
        take_corners(x[sheet], corners, neighbors, places[sheet], others[sheet])


def places_to_take(x: NDArray, mesh: ClothMesh) -> tuple[NDArray, NDArray]:
    """Grasp point of each corner [m], (sheets, 4, 3), and the number of other particles in the grasp, (sheets, 4).

    x: sheets of this mesh [m], (sheets, particles, 3).
    """
    places, others = np.empty((len(x), CORNERS, 3)), np.empty((len(x), CORNERS), np.int64)
    across = np.ascontiguousarray(x.transpose(0, 2, 1))
    _take_all(across, np.array(mesh.corners), corner_neighbors(mesh), places, others)
    return places, others


# what ``observe_next`` writes
NEXT = Observation(
    "next",
    "for each gripper d/(r + 1 cm), d the way to where it takes hold next, r long, and 1/(1 + n), n other particles there; or 0",
    (2, 4),
)

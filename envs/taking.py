"""Where a gripper can take hold of a corner of a rumpled sheet, and how much other cloth it would take along.

A gripper takes all particles within its reach, so a corner is neared from where no other cloth is within reach.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, kernel
from clothgym.envs.manipulation import CORNERS, REACH
from clothgym.envs.measures import squared_distance
from clothgym.mesh import ClothMesh

AWAY = 0.85 * REACH  # distance of a tip from the corner that it is to take [m]
CLEAR = 1.1 * REACH  # distance from it within which no other cloth may be [m]
LOWEST_TIP = 0.012  # height of a tip [m]
REACHED = 0.95 * REACH  # distance at which a tip that the floor has moved still takes the corner [m]
NOT_REACHED = 1000  # particles that one counts for from which the corner is farther


def _directions() -> NDArray:
    """From a corner to where a tip may be: straight up, and in rings, (directions, 3), of length 1."""
    rings = [(0.0, 0.0, 1.0)]
    for up, count in ((0.75, 6), (0.35, 8), (0.0, 8)):
        angles = 2 * np.pi * (np.arange(count) + 0.5 * (up > 0.5)) / count
        out = np.sqrt(1 - up**2)
        rings += [(out * np.cos(a), out * np.sin(a), up) for a in angles]
    return np.array(rings)


DIRECTIONS = _directions()


def beside_corners(mesh: ClothMesh) -> NDArray:
    """Which particles may be taken along with each corner, its neighbors, (4, particles): 0 or 1, for no record has bool arrays."""
    rest = mesh.rest_positions
    return (np.linalg.norm(rest[list(mesh.corners)][:, None] - rest, axis=2) < 1.5 * max(mesh.spacing)).astype(np.uint8)


@apart
def take_corners(x, corners, beside, places, others):
    """Where a tip takes each corner with the least other cloth [m], (4, 3), and how many other particles it takes, (4,), out.

    x: a sheet [m], (3, particles).  corners: their particles.  beside: see ``beside_corners``.
    """
    tips, count = np.empty(DIRECTIONS.shape), np.empty(len(DIRECTIONS), np.int64)
    for k in range(len(corners)):
        at = x[:, corners[k]]
        # the floor stops a tip, perhaps too far from the corner
        for d in range(len(DIRECTIONS)):
            for c in range(3):
                tips[d, c] = at[c] + AWAY * DIRECTIONS[d, c]
            tips[d, 2] = max(tips[d, 2], LOWEST_TIP)
            count[d] = 0 if squared_distance(tips[d], at) < REACHED**2 else NOT_REACHED
        # particles near the corner alone can be within reach
        for p in range(x.shape[1]):
            if beside[k, p] == 0 and squared_distance(x[:, p], at) < (AWAY + CLEAR) ** 2:
                for d in range(len(DIRECTIONS)):
                    count[d] += squared_distance(tips[d], x[:, p]) < CLEAR**2
        # of equals the first: straight up is best
        best = np.argmin(count)
        others[k] = count[best]
        for c in range(3):
            places[k, c] = tips[best, c]


@kernel
def _take_all(x, corners, beside, places, others):
    """``take_corners`` of many sheets, (sheets, 3, particles)."""
    for sheet in range(x.shape[0]):
        take_corners(x[sheet], corners, beside, places[sheet], others[sheet])


def places_to_take(x: NDArray, mesh: ClothMesh) -> tuple[NDArray, NDArray]:
    """Where tips take each corner [m], (sheets, 4, 3), and how many other particles they would take, (sheets, 4).

    x: sheets of this mesh [m], (sheets, particles, 3).
    """
    places, others = np.empty((len(x), CORNERS, 3)), np.empty((len(x), CORNERS), np.int64)
    across = np.ascontiguousarray(x.transpose(0, 2, 1))
    _take_all(across, np.array(mesh.corners), beside_corners(mesh), places, others)
    return places, others

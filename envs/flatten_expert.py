"""The scripted expert of the flattening tasks: take an edge by its corners, lift it, stretch it, lay the sheet down.

It sees the whole state, and has no memory: what the grippers hold, and how high they have been since, says where it is.  With
``action_mode="throw"`` it takes and lifts an edge for an agent, whose throw follows, see ``Hands``.  A garment gets entangled: it
is always lifted by one corner first, and the pull on the cloth that is held is limited.  Where a sheet has to lie in one pose, the
expert turns the edge, and carries it to where the sheet is laid down from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.episode import length
from clothgym.envs.pick_place import STEPS
from clothgym.envs.taking import EDGES, FLAT, LIFTED, OPPOSITE, next_takes_of
from clothgym.envs.throws import Hands, rising, taut_length

NEAR = 0.006  # of a tip from its place, when the fingers close [m]
LIFT_AT = 0.5  # where an edge is lifted, from the origin in the direction in which it is laid down, in sides
THROWN = 150  # control steps of an action that is a throw
LIFT, LIFT_ONE = 1.25, 0.95  # height that is aimed at with an edge, and with a corner alone, in sides; LIFTED is enough
CALM, CALM_ONE = 0.5, 0.7  # rms speed of the particles at which the sheet is laid down, and the other corner taken [m/s]
SPEED, LAYING = 0.9, 0.6  # of a gripper, as a share of its limit, and as the sheet is laid down [m/s]
# while the sheet is laid down, the far edge must move away by AHEAD for each meter that the grippers sink.  A deficit of up to
# NEARER [m] is corrected: for each meter of it the grippers move backward faster [1/s], and down more slowly, by this share [1/m]
AHEAD, NEARER, CORRECTION = 0.8, 0.05, 6.0
# share of its speed that strain leaves, ``first - second strain``, at most 1, and the strain at which both hands let go
SHEET_STRAINS, GARMENT_STRAINS = (1.3, 2.0, 0.5), (1.6, 4.0, 0.35)
ALMOST_TORN, OTHER_END = 0.85, 50  # of garments: strain anywhere that counts; steps after which an edge's other end is lifted first
# of a sheet that has to lie in one pose: how far it turns at once, and at most is askew [rad], and how far beyond the place of its
# far edge it hangs before it is laid down [m]
TURNING, ASKEW, HUNG = 0.2, 0.05, 0.32
AGAIN, AGAIN_IN_POSE = 95, 150  # steps before the end in which no other try begins, without and with a pose to lie in
# of picking and placing: the corners that are taken, and the others, pull by pull; first edges, then diagonals
PULLS = ((0, 1, 2, 3), (2, 3, 0, 1), (0, 3, 1, 2), (1, 2, 0, 3), (0, 3, 1, 2), (1, 2, 0, 3))
EDGES_FIRST = 2
PULLED = 0.98  # share of their distance in the flat sheet to which corners are pulled apart
LIFT_EDGE, LIFT_CORNER = 0.5, 0.2  # in sides


def flatten_actions(task: Any, hands: Sequence[Hands] | None = None) -> NDArray:
    """Actions of all environments, (num_envs, 8); hands: of each of them, which throw instead of laying a sheet down."""
    side, grippers, corners = task.physics.side, task.simulation.grippers, task.corners
    tips = grippers.positions.astype(np.float64)
    speed = np.sqrt((task.simulation.velocities.astype(np.float64) ** 2).sum(axis=2).mean(axis=1))
    holder, n = grippers.holder, task.num_envs
    goals, others = next_takes_of(task)
    move, grip = np.zeros((n, 2, 3)), np.ones((n, 2))
    last = task.acting_steps - (AGAIN if task.pose() is None else AGAIN_IN_POSE)
    for e in range(n):
        own, throwing = task.episode[e], hands[e] if hands is not None else None
        held = [np.flatnonzero(holder[e] == k) for k in range(2)]
        corner = [next((i for i in range(4) if holder[e, corners[i]] == k), -1) for k in range(2)]
        laid = own["raised"].max() > LIFTED[1] * side and max(tips[e, k, 2] for k in range(2)) < 0.06
        if throwing is not None and (throwing.done or (throwing.begun and min(corner) < 0)):
            # one throw in an action: the rest of its time the sheet comes to rest
            throwing.done = True
            move[e] = _up(tips[e])
        elif laid and min(corner) < 0:
            pass  # what has been laid down is let go of
        elif any(len(held[k]) and corner[k] < 0 for k in range(2)):
            # nothing is held by mistake
            move[e, :, 2], grip[e] = 0.3, [1.0 if corner[k] < 0 else -1.0 for k in range(2)]
        elif max(corner) >= 0:
            both = min(corner) >= 0
            if both:
                move[e], grip[e] = _spread(task, e, tips[e], held, corner, speed[e], throwing)
            else:
                move[e], grip[e] = _take_other(tips[e], goals[e], others[e], corner, side, own, speed[e])
            # entangled cloth is pulled slowly, and released before it tears
            if both or task.entangles:
                strain, (full, slope, most) = _strain(task, e), GARMENT_STRAINS if task.entangles else SHEET_STRAINS
                move[e] *= np.clip(full - slope * strain, 0.0, 1.0)
                grip[e] = 1 if strain > most else grip[e]
        elif own["coverage"] >= task.enough + FLAT or own["step"] > last:
            move[e] = _up(tips[e])
        else:
            if task.entangles and others[e].min() >= 0:
                others[e, own["step"] // OTHER_END % 2] = -1
            move[e], grip[e] = _take_first(tips[e], goals[e], others[e], side)
    # fingers that have closed on nothing open again
    grip[(grippers.openings == 0) & (grippers.held == 0)] = 1
    move /= np.maximum(length(move) / SPEED, 1)[..., None]
    return np.concatenate([move / task.physics.attachment_speed, grip[..., None]], axis=2).reshape(n, -1)


def flatten_picks(task: Any) -> NDArray:
    """Actions of all environments with "pick_place", (num_envs, 10): corners by their numbers, in a fixed order, are pulled apart.

    First both ends of an edge, and of the opposite one, to where the edge would lie were the sheet flat behind it; then the
    diagonals, one across the other.  It makes no choice among corners: except for the side of the corners, its actions are a smooth
    function of their positions and of time.  A flat sheet is left alone.
    """
    n, half = task.num_envs, task.workspace * task.physics.side
    side = task.physics.side * task.sizes()[:, None]
    p = task.simulation.positions[:, task.corners, :2].astype(np.float64)
    actions = np.ones((n, 2, 5))
    number = task.episode["step"] // STEPS
    for k, (a, b, c, d) in enumerate(PULLS):
        # along: the direction of the edge, or of the other diagonal; turned: across it, on the side of the corners
        on_edge = k < EDGES_FIRST
        along = (p[:, b] - p[:, a]) + (p[:, d] - p[:, c]) if on_edge else p[:, d] - p[:, c]
        along /= np.maximum(np.sqrt(along[:, 0] ** 2 + along[:, 1] ** 2), 1e-9)[:, None]
        turned = np.stack([-along[:, 1], along[:, 0]], axis=1)
        ahead = (p[:, a] + p[:, b] - p[:, c] - p[:, d]) / 2 if on_edge else p[:, b] - p[:, a]
        turned *= np.where(turned[:, 0] * ahead[:, 0] + turned[:, 1] * ahead[:, 1] < 0, -1.0, 1.0)[:, None]
        middle = (p[:, c] + p[:, d]) / 2
        if on_edge:
            middle, apart = middle + side * turned, PULLED * side / 2 * along
        else:
            apart = PULLED * np.sqrt(2) * side / 2 * turned
        now = (number == k) & (task.episode["coverage"] < task.enough + FLAT)
        for gripper, (pick, place) in enumerate(((p[:, a], middle - apart), (p[:, b], middle + apart))):
            actions[now, gripper, 0:2], actions[now, gripper, 2:4] = pick[now] / half, place[now] / half
            actions[now, gripper, 4] = 2 * (LIFT_EDGE if on_edge else LIFT_CORNER) - 1
    return np.clip(actions, -1, 1).reshape(n, -1)


def _to(goal: NDArray, tip: NDArray) -> NDArray:
    """Velocity that takes a tip half of the way in a step [m/s]."""
    return (goal - tip) * 15


def _up(tips: NDArray) -> NDArray:
    """Velocities with which empty hands get out of the way [m/s]."""
    return np.where(tips[:, 2:] < 0.3, 0.5, 0) * (0, 0, 1)


def _strain(task: Any, e: int) -> float:
    """Largest strain of an environment's sheet; of a garment that of the cloth that is held, unless it almost tears elsewhere."""
    largest = float(task.info["strain_max"][e])
    if not task.entangles or largest > ALMOST_TORN:
        return largest
    ends, rest, *_ = task.physics.mesh.springs
    x = task.simulation.positions[e].astype(np.float64)
    rest = rest * task.sizes()[e]
    pulled = (task.simulation.grippers.holder[e][ends] >= 0).any(axis=1)
    return float((length(x[ends[pulled, 1]] - x[ends[pulled, 0]]) / rest[pulled]).max()) - 1


def _take_first(tips: Any, goals: Any, others: Any, side: float) -> Any:
    """An edge by both corners where they lie free; else the corner that lies freest."""
    move, grip = _to(goals, tips), np.ones(2)
    near = np.linalg.norm(goals - tips, axis=1) < NEAR
    for k in range(2):
        if others[k] < 0:
            move[k] = (0.0, 0.0, 0.5 if tips[k, 2] < 0.4 * side else 0.0)
        else:
            # both at once
            grip[k] = -1 if near[others >= 0].all() else 1
    return move, grip


def _take_other(tips: Any, goals: Any, others: Any, corner: Any, side: float, own: Any, speed: float) -> Any:
    """Lift the corner that is held; then take a neighbor of it, in the air."""
    k = 0 if corner[0] >= 0 else 1
    move, grip = np.zeros((2, 3)), np.ones(2)
    grip[k] = -1
    goal, way = goals[1 - k], np.linalg.norm(goals[1 - k] - tips[1 - k])
    close = way < 0.05 and others[1 - k] == 0
    up = own["raised"][k] > LIFTED[0] * side
    if not up and not close:
        move[k] = _to(np.array([0.0, 0.0, LIFT_ONE * side]), tips[k])
        move[k, :2] *= 0.5
    if others[1 - k] < 0:
        pass  # both neighbors are held
    elif close or (up and speed < CALM_ONE):
        move[1 - k] = _to(goal, tips[1 - k])
        grip[1 - k] = -1 if way < NEAR else 1
    else:
        # wait next to it
        move[1 - k] = _to(goal + (0, 0, 0.1), tips[1 - k])
    return move, grip


class Aim(NamedTuple):
    """Where a held edge should lie: the yaw that it still has to turn, and the middle of it and of the far edge [m], (3,)."""

    angle: float
    near: NDArray
    far: NDArray


def _aim(task: Any, e: int, corner: Any, edge: int, along: NDArray) -> Aim | None:
    """Of a task whose sheets have to lie in one pose; corner: numbers of the held corners, edge: of their edge."""
    pose = task.pose()
    if pose is None:
        return None
    pose = task.sizes()[e] * pose
    wanted = pose[corner[1]] - pose[corner[0]]
    angle = np.arctan2(along[0] * wanted[1] - along[1] * wanted[0], along[:2] @ wanted)
    return Aim(float(angle), *(np.append(pose[of].mean(axis=0), 0.0) for of in (EDGES[edge], OPPOSITE[edge])))


def _turned(x: NDArray, angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]])


def _outward(ends: NDArray, others: NDArray, along: NDArray) -> NDArray:
    """From a held edge to where the far edge lies if the front is up, (3,); ends, others: of both at rest [m], (2, 3)."""
    turn = np.cross(ends[1] - ends[0], others.mean(axis=0) - ends.mean(axis=0))[2]
    return np.array([-along[1], along[0], 0.0]) * np.sign(turn)


def _spread(task: Any, e: int, tips: Any, held: Any, corner: Any, speed: float, throwing: Hands | None) -> Any:
    """Lift the edge, stretch it, lay the sheet down behind its far edge, or follow the way of a throw, and let go."""
    corners, size, side, own = task.corners, task.sizes()[e], task.physics.side, task.episode[e]
    rest = size * task.physics.mesh.rest_positions
    x, v = (of[e].astype(np.float64) for of in (task.simulation.positions, task.simulation.velocities))
    ends = corners[corner]
    taut = taut_length(rest, held)
    edge = next((i for i in range(4) if set(EDGES[i]) == set(corner)), -1)
    if edge < 0:  # a diagonal
        return np.zeros((2, 3)), np.array([-1.0, 1.0])
    deep = size * task.across()[edge]
    # along the edge, and across it
    along = (tips[1] - tips[0]) * (1, 1, 0)
    along /= max(np.linalg.norm(along), 1e-9)
    out = _outward(rest[ends], rest[corners[OPPOSITE[edge]]], along)
    middle = tips.mean(axis=0)
    aim = _aim(task, e, corner, edge, along)
    # a throw ends with the held edge ahead of the far one: it goes the other way, so that the front comes to lie up
    out = out if aim is None or throwing is None else -out
    ahead = along if aim is None else _turned(along, np.clip(aim.angle, -TURNING, TURNING))
    apart = np.stack([-ahead, ahead]) * taut / 2
    low = x[ends, 2].min()
    far = x[corners[OPPOSITE[edge]]].mean(axis=0)
    if own["raised"].min() <= LIFTED[1] * size * side:
        first = LIFT_AT if throwing is None else throwing.throw.along[0]
        return rising(_to(first * side * out + (0, 0, LIFT * size * side) + apart, tips), tips, taut, SPEED), -np.ones(2)
    # the tips keep the edge taut
    keep = (middle + apart - tips) * 10
    # begin as the far edge swings outward, or hangs still
    swing, reach = float(v[corners[OPPOSITE[edge]]].mean(axis=0) @ out), float((far - middle) @ out)
    sways = speed > CALM or (speed > 0.2 and (swing < 0 or reach < -0.02))
    waits = middle[2] > LIFTED[1] * size * side - 0.01 if throwing is None else not throwing.begun
    if waits and aim is not None:
        # first to where it is laid down from, turned as it should lie
        way = (aim.far + HUNG * out - middle) * (1, 1, 0) if throwing is None else ((aim.near - middle) @ along) * along
        if abs(aim.angle) > ASKEW or length(way) > 0.03:
            return keep + 4 * way, -np.ones(2)
    if waits and (sways or np.linalg.norm(tips[1] - tips[0]) < taut - 0.02):
        return keep, -np.ones(2)
    if aim is not None:
        # sideways to where the edge should lie
        keep = keep + 4 * ((aim.near - middle) @ along) * along
    if throwing is not None:
        way = throwing.velocity(np.array([middle @ out, middle[2]]), side)
        return (np.zeros((2, 3)), np.ones(2)) if way is None else (keep + way[0] * out + (0, 0, way[1]), -np.ones(2))
    height = x[ends, 2].mean()
    if low < 0.012:
        left = (aim.near - middle) @ out if aim is not None else 0.0
        if aim is not None and left < -0.01 and reach > 0.96 * deep:
            # the whole sheet is pulled backward to its place
            return keep + np.clip(4 * left, -0.3, 0) * out, -np.ones(2)
        arrived = reach > 0.96 * deep or -middle @ out > 1.3 * side if aim is None else left >= -0.01
        if arrived:
            return np.zeros((2, 3)), np.ones(2)
    # down behind the far edge, backward when it touches the floor; at the end slowly enough that cloth off the floor does not fold
    touching = far[2] < 0.03 or height < 0.5 * deep
    slack = float(np.clip(deep - 0.01 - AHEAD * height - reach, 0.0, NEARER)) if height < 0.5 * deep else 0.0
    back = LAYING * max(height / deep, 0.4 if reach < 0.97 * deep else 0.0) + CORRECTION * slack if touching else 0.4 * LAYING
    down = LAYING * max(reach / deep, 0.15) * (1 - CORRECTION * slack) if touching else 0.8 * LAYING
    return keep - back * out - (0, 0, down), -np.ones(2)

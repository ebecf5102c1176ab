"""Floor 4: the kernels of attachments: what they do at the start of a control step, and the cloth's pull on them at its end."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from clothgym._jit import apart, kernel, specialize, used
from clothgym.bending import Bending, add_bend_forces
from clothgym.collisions import COLLIDER_ROWS, SCRATCH_ROWS, keep_out, stop_at_solids
from clothgym.elements import Elastic, room_for_forces
from clothgym.forces import add_air_forces, add_spring_forces
from clothgym.grid_forces import kernels_of

# columns of ``Attachments.limits``: speed limit [m/s], change of the opening in a control step, and the squares of the reach [m^2]
# and of the slip force [N^2]
SPEED, FINGER_STEP, REACH2, SLIP2 = 0, 1, 2, 3
FREE = -1  # the holder of a particle that nothing holds


@kernel
def count_held(holder, anchors, out):
    """Number of particles that each gripper holds, (blocks, grippers, lanes); anchors: number of anchors."""
    out[:] = 0
    for b in range(holder.shape[0]):
        for p in range(holder.shape[1]):
            for l in range(holder.shape[2]):
                k = holder[b, p, l] - anchors
                if k >= 0:
                    out[b, k, l] += 1


@kernel
def move_fingers(first, last, x, w, free_w, tips, opening, wanted, holder, limits, anchors):
    """Begin a control step of blocks ``first`` to ``last``: fingers move by what ``limits`` allow, and grip or release.

    tips: positions of the attachments [m], (blocks, attachments, 3, lanes).  holder: (blocks, particles, lanes).  opening, wanted:
    (blocks, attachments, lanes).  limits: (attachments, 4).  anchors: the first particle of each anchor, (anchors,).
    """
    zero = x.dtype.type(0)
    for b in range(first, last):
        for k in range(anchors.shape[0], tips.shape[1]):
            step = limits[k, FINGER_STEP]
            for l in range(x.shape[3]):
                before = opening[b, k, l]
                now = min(max(wanted[b, k, l], before - step), before + step)
                opening[b, k, l] = now
                # they release as soon as they begin to open
                if now > zero and before <= zero:
                    for p in range(x.shape[2]):
                        if holder[b, p, l] == k:
                            holder[b, p, l] = FREE
                            w[b, p, l] = free_w[b, p, l]
                # they grip free particles within reach as soon as they have closed
                elif now <= zero and before > zero:
                    for p in range(x.shape[2]):
                        away2 = zero
                        for c in range(3):
                            away2 += (x[b, c, p, l] - tips[b, k, c, l]) ** 2
                        if away2 <= limits[k, REACH2] and holder[b, p, l] == FREE:
                            holder[b, p, l] = k
                            w[b, p, l] = zero


@apart
def steer(x, v, tips, targets, holder, limits, anchors, time_step):
    """Set the velocity of held particles of one block for a control step.

    ``v = (target - tip)/time_step``, shortened to the speed limit.  tips: positions of the attachments [m], (attachments, 3,
    lanes), advanced to the end of the control step.  targets: likewise.  holder: (particles, lanes).
    """
    one = x.dtype.type(1)
    lanes = x.shape[2]
    move = np.empty((3, lanes), x.dtype)
    for k in range(tips.shape[0]):
        # an anchor starts from its particle, so that rounding in the substeps does not accumulate
        if k < anchors.shape[0]:
            p = anchors[k]
            for c in range(3):
                for l in range(lanes):
                    tips[k, c, l] = x[c, p, l] if holder[p, l] == k else tips[k, c, l]
        # velocity towards the target, up to the speed limit
        for l in range(lanes):
            dx, dy, dz = (
                targets[k, 0, l] - tips[k, 0, l],
                targets[k, 1, l] - tips[k, 1, l],
                targets[k, 2, l] - tips[k, 2, l],
            )
            speed = np.sqrt(dx * dx + dy * dy + dz * dz) / time_step
            slow = one / (max(speed / limits[k, SPEED], one) * time_step)
            move[0, l], move[1, l], move[2, l] = dx * slow, dy * slow, dz * slow
        # the attachment moves on at once, and the held particles in the course of the substeps
        for c in range(3):
            for l in range(lanes):
                tips[k, c, l] += move[c, l] * time_step
        for p in range(x.shape[1]):
            for l in range(lanes):
                if holder[p, l] == k:
                    for c in range(3):
                        v[c, p, l] = move[c, l]


@kernel
def bar_blocks(first, last, x, tips, targets, holder, limits, anchors, time_step, colliders, shapes, allowed, blocked):
    """Write to ``allowed`` where each attachment may go in this control step without entering a solid, or carrying particles into
    it.

    If nothing is in its way this is its target.  tips, targets, allowed: [m], (blocks, attachments, 3, lanes).  blocked: (blocks,
    attachments, lanes).  colliders, shapes: see ``collisions.Solids``.  (A part of ``steer`` would be compiled again with each of
    its callers.)
    """
    # scratch: a point and a collider in a single lane; position and displacement of the attachment
    one = x.dtype.type(1)
    point, rows, scratch = np.empty((3, 1, 1), x.dtype), np.empty((COLLIDER_ROWS, 1), x.dtype), np.empty((SCRATCH_ROWS, 1), x.dtype)
    tip, way = np.empty(3, x.dtype), np.empty(3, x.dtype)
    for b in range(first, last):
        for k in range(tips.shape[1]):
            for l in range(x.shape[3]):
                # the way to the target, up to the speed limit
                held = k < anchors.shape[0] and holder[b, anchors[k], l] == k
                length2 = one - one
                for c in range(3):
                    tip[c] = x[b, c, anchors[k], l] if held else tips[b, k, c, l]
                    way[c] = targets[b, k, c, l] - tip[c]
                    length2 += way[c] * way[c]
                    allowed[b, k, c, l] = targets[b, k, c, l]
                slow = one / max(np.sqrt(length2) / (time_step * limits[k, SPEED]), one)
                for c in range(3):
                    way[c] *= slow
                # shorten or deflect it for the attachment itself, and then for each particle that it holds
                changed = stop_at_solids(tip, way, colliders[b], shapes, l, time_step, point, rows, scratch)
                for p in range(x.shape[2]):
                    if holder[b, p, l] == k:
                        for c in range(3):
                            tip[c] = x[b, c, p, l]
                        changed |= keep_out(tip, way, colliders[b], shapes, l, time_step, point, rows, scratch)
                # where it leads
                blocked[b, k, l] = changed
                if changed:
                    for c in range(3):
                        allowed[b, k, c, l] = (x[b, c, anchors[k], l] if held else tips[b, k, c, l]) + way[c]


@kernel
def steer_blocks(first, last, x, v, tips, targets, holder, limits, anchors, time_step):
    """``steer`` in blocks ``first`` to ``last``."""
    for b in range(first, last):
        steer(x[b], v[b], tips[b], targets[b], holder[b], limits, anchors, time_step)


def add_pulls(first, last, x, v, free_w, weave, fabric, holder, out):
    """``out <- sum_p (f_p + m_p g)`` over the particles p that each attachment holds [N], (blocks, attachments, 3, lanes).

    f: the forces of springs, bending and air.  Blocks ``first`` to ``last``.
    """
    stiffness, rigidity, damping_time, _, resistance, gravity, wind = fabric
    f, scratch = np.empty(x.shape[1:], x.dtype), room_for_forces(x[first], weave.offset)
    for b in range(first, last):
        # the forces on all particles of the block
        f[:] = 0
        elastic = Elastic(stiffness[b], rigidity[b], damping_time[b])
        add_spring_forces(x[b], v[b], f, weave.elements, elastic, scratch)
        add_bend_forces(x[b], v[b], f, weave.elements, elastic, scratch)
        add_air_forces(x[b], v[b], f, weave.air, resistance[b], wind[b], x.dtype.type(0), scratch)
        # their sum, with the weights, for each attachment
        out[b] = 0
        for p in range(x.shape[2]):
            for l in range(x.shape[3]):
                k = holder[b, p, l]
                if k >= 0:
                    for c in range(3):
                        out[b, k, c, l] += f[c, p, l] + gravity[b, c, l] / free_w[b, p, l]


@cache
def pulls_with(bending: Bending, by_particle: bool) -> Any:
    """``add_pulls`` with the forces of a bending model and a memory layout."""
    return specialize(add_pulls, f"add_pulls_{bending.name}_{by_particle}", **used(add_pulls, kernels_of(bending, by_particle)))


@kernel
def let_slip(pull, holder, w, free_w, limits):
    """Release the particles of attachments on which the cloth pulls with more than their slip force.

    pull: [N], (blocks, attachments, 3, lanes).  holder, w, free_w: (blocks, particles, lanes).  limits: (attachments, 4).
    """
    for b in range(holder.shape[0]):
        for p in range(holder.shape[1]):
            for l in range(holder.shape[2]):
                k = holder[b, p, l]
                if k >= 0:
                    px, py, pz = pull[b, k, 0, l], pull[b, k, 1, l], pull[b, k, 2, l]
                    if px * px + py * py + pz * pz > limits[k, SLIP2]:
                        holder[b, p, l] = FREE
                        w[b, p, l] = free_w[b, p, l]


@kernel
def settle_lag(first, last, lag, behind, holder, anchors, reach2, w, free_w):
    """Adjust the lag, by which contact kept held particles behind their attachments, before these move on.

    An anchor starts from its first particle, so the lag of its particles is counted from that one.  A particle whose lag exceeds
    the reach of its gripper has slipped out.

    lag: [m], (blocks, 3, particles, lanes).  behind: positive where a lane has any lag, (blocks, lanes).  holder: (blocks,
    particles, lanes).  anchors: first particle of each anchor, (anchors,).  reach2: square of the reach [m^2], (attachments,).
    """
    for b in range(first, last):
        for l in range(behind.shape[1]):
            if not behind[b, l] > 0:
                continue
            # the lag of each anchor's first particle
            own = np.zeros((anchors.shape[0], 3), lag.dtype)
            for k in range(anchors.shape[0]):
                for c in range(3):
                    own[k, c] = lag[b, c, anchors[k], l]
            # subtract it from the anchor's particles; release what has slipped out of a gripper
            for p in range(holder.shape[1]):
                k = holder[b, p, l]
                if k < 0:
                    continue
                if k < anchors.shape[0]:
                    for c in range(3):
                        lag[b, c, p, l] -= own[k, c]
                elif lag[b, 0, p, l] ** 2 + lag[b, 1, p, l] ** 2 + lag[b, 2, p, l] ** 2 > reach2[k]:
                    holder[b, p, l] = FREE
                    w[b, p, l] = free_w[b, p, l]
                    lag[b, 0, p, l] = lag[b, 1, p, l] = lag[b, 2, p, l] = 0

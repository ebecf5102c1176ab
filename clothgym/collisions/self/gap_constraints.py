"""Gap constraints of self-collision: pairs that are kept apart along a fixed direction, and certified so between queries.

A gap constraint (see ``narrow_phase``) is *active* if one of its vertices is outside its displacement bound, and *violated* if its
gap along its normal is smaller than the distance that it keeps.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.self.narrow_phase import GROUP_JAMMED
from clothgym.contact_memory import G_GROUP, G_KEPT, G_NUMBER, G_OWN, G_VERTICES, REPORT_CLAMPED, REPORT_LAG

PATIENCE = 4  # evaluations of all gap constraints after which a query, which gives the vertices new bounds, is cheaper
HALVINGS = 4  # times that the moves of a gap constraint's vertices are halved before they stay in place
GROWTHS = 8  # times that a zone takes in what it would violate a gap constraint with, at most
LEAST_MOVED = 3e-5  # distance that the gap constraints in a zone keep at least, if it moves: more than rounding can take [m]
ALIKE = 1e-6  # largest difference of the displacements of attached vertices in a zone that moves as they do [m]
INACTIVE_COST = 8  # inactive gap constraints that cost as much to skip as one active one to evaluate


@inlined
def _is_active(members, t, outside):
    """Whether a vertex of gap constraint t is outside its bound: the first four, which all have, are tested without a branch."""
    some = (
        outside[members[t, G_VERTICES]]
        | outside[members[t, G_VERTICES + 1]]
        | outside[members[t, G_VERTICES + 2]]
        | outside[members[t, G_VERTICES + 3]]
    )
    for m in range(4, members[t, G_NUMBER]):
        some |= outside[members[t, G_VERTICES + m]]
    return some


@kernel
def list_active(members, outside, active):
    """List the active gap constraints in ``active``, which has room for all, (constraints,).  Returns how many there are."""
    number = 0
    for t in range(active.shape[0]):
        # written without a branch: the next one takes the place of an inactive one
        active[number] = t
        number += _is_active(members, t, outside)
    return number


@kernel
def is_violated(x, members, planes, t, l):
    """Whether gap constraint t of lane l is violated: min n . x_first - max n . x_second < the distance that it keeps."""
    own = members[t, G_OWN]
    nx, ny, nz = planes[t, 0], planes[t, 1], planes[t, 2]
    nearest, farthest = np.inf, -np.inf
    for m in range(members[t, G_NUMBER]):
        p = members[t, G_VERTICES + m]
        place = nx * x[0, p, l] + ny * x[1, p, l] + nz * x[2, p, l]
        if m < own:
            nearest = min(nearest, place)
        else:
            farthest = max(farthest, place)
    # false for NaN: a diverged lane is left alone
    return nearest - farthest < planes[t, G_KEPT]


@uncounted
def evaluate_constraints(x, memory, block, l, active):
    """Whether a query is due because of the active gap constraints of lane l, and whether one of them is violated.

    active: their numbers.  Constraints that were enforced since the last query are jammed: a query would find the same again, so
    they cause none until evaluating has cost more than a query would.
    """
    members, planes, constraints = memory.members[block, l], memory.planes[block, l], memory.constraints[block, l]
    due, violated = False, False
    for c in range(active.shape[0]):
        if is_violated(x, members, planes, active[c], l):
            violated = True
            due |= members[active[c], G_GROUP] != GROUP_JAMMED
    # inactive constraints cost a little, too
    memory.looks[block, l] += constraints // INACTIVE_COST + active.shape[0]
    return due or memory.looks[block, l] > PATIENCE * constraints, violated


@uncounted
def enforce_gaps(x, v, w, memory, block, l, outside, active, number, scratch, bounded):
    """Enforce the gap constraints of lane l: halve the moves of the vertices of each violated one since the last certified
    positions, up to ``HALVINGS`` times, then leave them in place.  Their neighbors may follow.  What stays in place then moves as a
    whole, where it can, see ``_move_zones``.

    active: room for all gap constraints, (constraints,); the first ``number`` entries are the active ones.  outside: which vertices
    are outside their bounds; becomes which have been moved, too, (particles,).  scratch: a ``query_scratch.QueryScratch``.
    bounded: whether vertices must stay within their limits, ``scratch.squares``; the caller looks otherwise.
    """
    halvings, wish = scratch.halvings, scratch.wish
    old, lag, report = memory.old[block], memory.lag[block], memory.report[block, l]
    members, planes, constraints = memory.members[block, l], memory.planes[block, l], active.shape[0]
    zero, half = x.dtype.type(0), x.dtype.type(0.5)
    # mark the violated constraints as jammed
    again = False
    for c in range(number):
        if is_violated(x, members, planes, active[c], l):
            members[active[c], G_GROUP] = GROUP_JAMMED
            again = True
    halvings[:] = 0
    while again:
        # rounds over the active constraints, in their order; when a move activates others, the round goes on over all of them
        again, spread, c, t = False, False, 0, -1
        while c < number or spread:
            # the next constraint of this round
            if spread:
                t += 1
                if t == constraints:
                    break
                if not _is_active(members, t, outside):
                    continue
            else:
                t = active[c]
                c += 1
            if not is_violated(x, members, planes, t, l):
                continue
            # halve the moves of its vertices, those of attached particles into their lag
            for m in range(members[t, G_NUMBER]):
                p = members[t, G_VERTICES + m]
                if halvings[p] > HALVINGS:
                    continue
                if halvings[p] == 0:
                    report[REPORT_CLAMPED] += 1
                    for k in range(3):
                        wish[k, p], wish[3 + k, p] = x[k, p, l] - old[k, p, l], v[k, p, l]
                halvings[p] += 1
                again = True
                spread |= not outside[p]
                outside[p] = True
                share = half if halvings[p] <= HALVINGS else zero
                for k in range(3):
                    goal = old[k, p, l]
                    if share > zero:  # zero times a move that is not finite is not zero
                        goal += share * (x[k, p, l] - goal)
                    if w[p, l] <= zero:
                        lag[k, p, l] += x[k, p, l] - goal
                    else:
                        v[k, p, l] *= share
                    x[k, p, l] = goal
        if spread:
            number = list_active(members, outside, active)
    _move_zones(x, v, w, memory, block, l, outside, scratch, bounded)
    note_lag(w, memory, block, l)


@uncounted
def _move_zones(x, v, w, memory, block, l, outside, scratch, bounded):
    """Move what would stay in place: each zone, vertices that gap constraints join, by one displacement, which keeps its gaps.

    It is the mean of their displacements, and so is their velocity, weighted with their masses: a zone keeps its momentum (impact
    zones: Provot, "Collision and self-collision handling in cloth model dedicated to design garments", 1997; here without their
    rotation).  If it stayed in place, the cloth around it would hang from it as from a nail.
    """
    members, constraints, zone = memory.members[block, l], memory.constraints[block, l], scratch.zone
    # the vertices that would stay in place, each with the number of its zone; at first, each is one
    some = False
    for p in range(zone.shape[0]):
        zone[p] = p if scratch.halvings[p] > HALVINGS else -1
        some |= zone[p] >= 0
    # join the zones of each gap constraint
    spread = some
    while spread:
        spread = False
        for t in range(constraints):
            least = zone.shape[0]
            for m in range(members[t, G_NUMBER]):
                number = zone[members[t, G_VERTICES + m]]
                least = min(least, number) if number >= 0 else least
            for m in range(members[t, G_NUMBER]):
                p = members[t, G_VERTICES + m]
                if zone[p] > least:
                    zone[p] = least
                    spread = True
    if some:
        for root in range(zone.shape[0]):
            if zone[root] == root:
                _move_zone(root, x, v, w, memory, block, l, outside, scratch, bounded)


@uncounted
def _move_zone(root, x, v, w, memory, block, l, outside, scratch, bounded):
    """Move one zone.  It takes in what it would violate a gap constraint with, and all of it is left where it was if that does not
    end, if its attached vertices do not move alike, or if a gap in it is so small that rounding counts."""
    old, lag, zone, wish, before = memory.old[block], memory.lag[block], scratch.zone, scratch.wish, scratch.before_zone
    for p in range(zone.shape[0]):
        for k in range(3):
            before[k, p], before[3 + k, p] = x[k, p, l], v[k, p, l]
            if scratch.halvings[p] == 0:
                wish[k, p], wish[3 + k, p] = x[k, p, l] - old[k, p, l], v[k, p, l]
    moves, grows = True, True
    growths = 0
    while moves and grows:
        moves = _place_zone(root, x, v, w, old, l, outside, scratch, bounded)
        apart, grows = _take_in(root, x, memory, block, l, zone)
        growths += 1
        moves &= apart and (not grows or growths < GROWTHS)
    for p in range(zone.shape[0]):
        if zone[p] == root:
            for k in range(3):
                if not moves:
                    x[k, p, l], v[k, p, l] = before[k, p], before[3 + k, p]
                elif w[p, l] <= 0:
                    lag[k, p, l] -= x[k, p, l] - before[k, p]


@uncounted
def _place_zone(root, x, v, w, old, l, outside, scratch, bounded):
    """Place a zone: x <- old + d, v <- u, with the means d and u of the displacements and velocities that its vertices would have,
    weighted with their masses, or those of an attached vertex, if it has one.  Returns whether its attached vertices move alike."""
    zone, wish, mean = scratch.zone, scratch.wish, scratch.mean
    held, alike, total, limit = -1, True, 0.0, np.inf
    mean[:] = 0.0
    for p in range(zone.shape[0]):
        if zone[p] == root:
            limit = min(limit, scratch.squares[p])
            if w[p, l] > 0:
                total += 1.0 / w[p, l]
                for k in range(6):
                    mean[k] += wish[k, p] / w[p, l]
            else:
                held = p if held < 0 else held
                for k in range(3):
                    alike &= abs(wish[k, p] - wish[k, held]) <= ALIKE
    for k in range(6):
        mean[k] = mean[k] / total if held < 0 else wish[k, held]
    # no farther than the least limit
    square = mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]
    if bounded and square > limit:
        share = np.sqrt(limit / square)
        for k in range(6):
            mean[k] *= share
    for p in range(zone.shape[0]):
        if zone[p] == root:
            outside[p] = True
            for k in range(3):
                x[k, p, l] = old[k, p, l] + x.dtype.type(mean[k])
                if w[p, l] > 0:
                    v[k, p, l] = mean[3 + k]
    return alike


@uncounted
def _take_in(root, x, memory, block, l, zone):
    """Take into a zone what it violates a gap constraint with.  Returns whether it may move, and whether it has grown."""
    members, planes = memory.members[block, l], memory.planes[block, l]
    moves, grows = True, False
    for t in range(memory.constraints[block, l]):
        number, own = members[t, G_NUMBER], 0
        for m in range(number):
            own += zone[members[t, G_VERTICES + m]] == root
        if own == number:
            moves &= planes[t, G_KEPT] >= LEAST_MOVED
        elif own > 0 and is_violated(x, members, planes, t, l):
            grows = True
            for m in range(number):
                p = members[t, G_VERTICES + m]
                other = zone[p]
                zone[p] = root
                # another zone joins as a whole
                if other >= 0 and other != root:
                    for q in range(zone.shape[0]):
                        if zone[q] == other:
                            zone[q] = root
    return moves, grows


@uncounted
def note_lag(w, memory, block, l):
    """Note the largest lag of lane l [m]."""
    lag = memory.lag[block]
    largest = lag.dtype.type(0)
    for p in range(w.shape[0]):
        if w[p, l] <= 0:
            largest = max(largest, lag[0, p, l] * lag[0, p, l] + lag[1, p, l] * lag[1, p, l] + lag[2, p, l] * lag[2, p, l])
    memory.behind[block, l] = np.sqrt(largest)
    memory.report[block, l, REPORT_LAG] = max(memory.report[block, l, REPORT_LAG], np.float64(memory.behind[block, l]))

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
def enforce_gaps(x, v, w, memory, block, l, outside, active, number, halvings):
    """Enforce the gap constraints of lane l: halve the moves of the vertices of each violated one since the last certified
    positions, up to ``HALVINGS`` times, then leave them in place.  Their neighbors may follow.

    active: room for all gap constraints, (constraints,); the first ``number`` entries are the active ones.  outside: which vertices
    are outside their bounds; becomes which have been moved, too, (particles,).  halvings: scratch, (particles,).
    """
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
                report[REPORT_CLAMPED] += halvings[p] == 0
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
    note_lag(w, memory, block, l)


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

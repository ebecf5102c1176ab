"""Gap constraints of self-collision: pairs that are kept apart along a fixed direction, and certified so between queries.

A gap constraint (see ``narrow_phase``) is *active* if one of its vertices is outside its displacement bound, and *violated* if its
gap along its normal is smaller than the distance that it keeps.  A *zone* is what would stay in place because of violated gap
constraints, and moves as a whole.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import inlined, kernel, uncounted
from clothgym.collisions.self.narrow_phase import GROUP_JAMMED
from clothgym.collisions.solids.attachment_contact import keep_out
from clothgym.contact_memory import G_GROUP, G_KEPT, G_NUMBER, G_OWN, G_VERTICES, REPORT_CLAMPED, REPORT_LAG

PATIENCE = 4  # evaluations of all gap constraints after which a query, which gives the vertices new bounds, is cheaper
HALVINGS = 4  # times that the moves of a gap constraint's vertices are halved before they stay in place
GROWTHS = 8  # a zone that has taken in this many times what it would violate a gap constraint with stays in place
LEAST_MOVED = 3e-5  # least gap in a zone, at the last certified positions, with which it moves: more than rounding can take [m]
ALIKE = 1e-6  # largest difference of the displacements of attached vertices in a zone that moves as they do [m]
ROUNDED = 1e-6  # by how much deeper in a solid rounding may place a vertex that was kept out [m]
ROOM = 1.001  # squares of displacements over their limits that still are within them, see ``displacement_bounds.INSIDE``
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
def gap_of(x, members, planes, t, l):
    """Gap of constraint t of lane l along its normal [m]: min n . x_first - max n . x_second."""
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
    return nearest - farthest


@kernel
def is_violated(x, members, planes, t, l):
    """Whether gap constraint t of lane l is violated: its gap is less than the distance that it keeps."""
    # false for NaN: a diverged lane is left alone
    return gap_of(x, members, planes, t, l) < planes[t, G_KEPT]


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
def enforce_gaps(x, v, w, sheet, block, l, outside, active, number, scratch, h, bounded):
    """Enforce the gap constraints of lane l: halve the moves of the vertices of each violated one since the last certified
    positions, up to ``HALVINGS`` times, then leave them in place.  Their neighbors may follow.  What stays in place then moves as a
    whole, where it can, see ``_move_zones``.

    active: room for all gap constraints, (constraints,); the first ``number`` entries are the active ones.  outside: which vertices
    are outside their bounds; becomes which have been moved, too, (particles,).  scratch: a ``query_scratch.QueryScratch``.  h: the
    substep [s].  bounded: whether zones stay within their vertices' limits, ``scratch.squares``; otherwise the caller tests them.
    """
    memory = sheet.memory
    members, planes, constraints = memory.members[block, l], memory.planes[block, l], active.shape[0]
    # mark the violated constraints as jammed
    again = False
    for c in range(number):
        if is_violated(x, members, planes, active[c], l):
            members[active[c], G_GROUP] = GROUP_JAMMED
            again = True
    scratch.halvings[:] = 0
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
            halved, others = _halve_moves(t, x, v, w, memory, block, l, outside, scratch)
            again |= halved
            spread |= others
        if spread:
            number = list_active(members, outside, active)
    _move_zones(x, v, w, sheet, block, l, outside, scratch, h, bounded)
    note_lag(w, memory, block, l)


@uncounted
def _halve_moves(t, x, v, w, memory, block, l, outside, scratch):
    """Halve the moves of the vertices of gap constraint t, those of attached particles into their lag, or leave them in place.
    Returns whether there are moves, and whether one is of a vertex that was inside its bound."""
    halvings, wish, members = scratch.halvings, scratch.wish, memory.members[block, l]
    old, lag, report = memory.old[block], memory.lag[block], memory.report[block, l]
    zero, half, moved, spread = x.dtype.type(0), x.dtype.type(0.5), False, False
    for m in range(members[t, G_NUMBER]):
        p = members[t, G_VERTICES + m]
        if halvings[p] > HALVINGS:
            continue
        if halvings[p] == 0:
            report[REPORT_CLAMPED] += 1
            for k in range(3):
                wish[k, p], wish[3 + k, p] = x[k, p, l] - old[k, p, l], v[k, p, l]
        halvings[p] += 1
        moved = True
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
    return moved, spread


@uncounted
def _move_zones(x, v, w, sheet, block, l, outside, scratch, h, bounded):
    """Move what would stay in place: each zone, vertices that gap constraints join, by one displacement, which keeps its gaps:

        d = sum_p m_p d_p / sum_p m_p,   u = sum_p m_p u_p / sum_p m_p,

    the means of the displacements d_p and velocities u_p that its vertices would have, weighted with their masses m_p, so a zone
    keeps its momentum (impact zones: Provot, "Collision and self-collision handling in cloth model dedicated to design garments",
    1997; here without their rotation).  If it stayed in place, the cloth around it would hang from it as from a nail.
    """
    memory = sheet.memory
    members, constraints, old = memory.members[block, l], memory.constraints[block, l], memory.old[block]
    zone, wish = scratch.zone, scratch.wish
    # the vertices that would stay in place, each with the number of its zone; at first, each is one
    some = False
    for p in range(zone.shape[0]):
        zone[p] = p if scratch.halvings[p] > HALVINGS else -1
        some |= zone[p] >= 0
    if not some:
        return
    # what the others do, before any zone moves
    for p in range(zone.shape[0]):
        if scratch.halvings[p] == 0:
            for k in range(3):
                wish[k, p], wish[3 + k, p] = x[k, p, l] - old[k, p, l], v[k, p, l]
    # join the zones of each gap constraint: they take the least number among them, until no constraint joins two
    spread = True
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
    # one after the other: each begins and ends without a violated constraint
    for root in range(zone.shape[0]):
        if zone[root] == root:
            _move_zone(root, x, v, w, sheet, block, l, outside, scratch, h, bounded)


@uncounted
def _move_zone(root, x, v, w, sheet, block, l, outside, scratch, h, bounded):
    """Move one zone.  It takes in what it would violate a gap constraint with.

    All of it is left where it was if that does not end, if its attached vertices do not move alike, if solids leave it no way, or
    if a gap in it is so small that rounding counts.
    """
    memory = sheet.memory
    lag, zone, before, zone_before = memory.lag[block], scratch.zone, scratch.before_zone, scratch.zone_before
    # what to return to
    for p in range(zone.shape[0]):
        zone_before[p] = zone[p]
        for k in range(3):
            before[k, p], before[3 + k, p] = x[k, p, l], v[k, p, l]
    # place it, until it runs into nothing
    moves, grows, growths = True, True, 0
    while moves and grows:
        moves = _place_zone(root, x, v, w, sheet, block, l, outside, scratch, h, bounded)
        if moves:
            apart, grows = _take_in(root, x, memory, block, l, zone)
            growths += 1
            moves = apart and (not grows or growths < GROWTHS)
    # attached vertices lag less by the way that they have gone; or all is as before
    for p in range(zone.shape[0]):
        if zone[p] == root:
            for k in range(3):
                if not moves:
                    x[k, p, l], v[k, p, l] = before[k, p], before[3 + k, p]
                elif w[p, l] <= 0:
                    lag[k, p, l] -= x[k, p, l] - before[k, p]
        # what it had taken in is free to move
        if not moves:
            zone[p] = zone_before[p]


@uncounted
def _place_zone(root, x, v, w, sheet, block, l, outside, scratch, h, bounded):
    """Place a zone: x <- old + d, v <- u, with the means of ``_move_zones``, or with the displacement of an attached vertex, if it
    has one, and u = d / h; where this would press cloth into a solid, d is deflected, and u = d / h.  Returns whether the zone may
    move: its attached vertices move alike, solids leave it a way, and all numbers are finite."""
    old, zone, wish, mean = sheet.memory.old[block], scratch.zone, scratch.wish, scratch.mean
    held, alike, total, limit = -1, True, 0.0, np.inf
    mean[:] = 0.0
    # the sums over free vertices, the least limit, and the first attached vertex
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
    for k in range(3):
        mean[k] = mean[k] / total if held < 0 else wish[k, held]
        mean[3 + k] = mean[3 + k] / total if held < 0 else wish[k, held] / h
    # no farther than the least limit
    square = mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]
    if bounded and square > limit:
        share = np.sqrt(limit / square)
        for k in range(6):
            mean[k] *= share
    if not (alike and square < np.inf):
        return False
    # neither an attachment nor the cloth that a vertex is jammed with presses it into a solid
    limit = limit if bounded else np.inf
    if not _keep_zone_out(root, mean, old, w, l, zone, sheet.solid, block, scratch.probe, h, limit):
        return False
    for p in range(zone.shape[0]):
        if zone[p] == root:
            outside[p] = True
            for k in range(3):
                x[k, p, l] = old[k, p, l] + x.dtype.type(mean[k])
                if w[p, l] > 0:
                    v[k, p, l] = mean[3 + k]
    return True


@uncounted
def _keep_zone_out(root, mean, old, w, l, zone, solid, block, probe, h, limit):
    """Deflect a zone's displacement, and so its velocity, where it would carry a free vertex deeper into a solid.

    Returns whether it may move: the deflected displacement is within the limit, a square [m^2], and carries none of the vertices,
    attached ones included, deeper into a solid.  Solids do not push a zone out: they have moved on already, and act on it next.
    """
    real, way = old.dtype.type, probe.way
    for k in range(3):
        way[k] = mean[k]
    # one vertex after the other; then all again, if that has changed anything
    if not _keep_vertices_out(root, old, w, l, zone, solid, block, probe, real(0), True):
        return True
    if _keep_vertices_out(root, old, w, l, zone, solid, block, probe, real(ROUNDED), False):
        return False
    square = 0.0
    for k in range(3):
        mean[k], mean[3 + k] = way[k], way[k] / h
        square += mean[k] * mean[k]
    return square <= ROOM * limit


@uncounted
def _keep_vertices_out(root, old, w, l, zone, solid, block, probe, tolerance, free_only):
    """``keep_out`` of a zone's vertices, or of its free ones, with the displacement ``probe.way``; whether one has changed it."""
    start, zero, changed = probe.start, old.dtype.type(0), False
    for p in range(zone.shape[0]):
        if zone[p] == root and (w[p, l] > 0 or not free_only):
            for k in range(3):
                start[k] = old[k, p, l]
            changed |= keep_out(start, probe.way, solid.rows[block], solid.shapes, l, zero, tolerance, probe)
    return changed


@uncounted
def _take_in(root, x, memory, block, l, zone):
    """Take into a zone what it violates a gap constraint with.  Returns whether the gaps in it are large enough to move it, and
    whether it has grown."""
    members, planes, old = memory.members[block, l], memory.planes[block, l], memory.old[block]
    apart, grows = True, False
    for t in range(memory.constraints[block, l]):
        number, own = members[t, G_NUMBER], 0
        for m in range(number):
            own += zone[members[t, G_VERTICES + m]] == root
        # one displacement keeps a gap but for rounding
        if own == number:
            apart &= gap_of(old, members, planes, t, l) >= LEAST_MOVED
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
    return apart, grows


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

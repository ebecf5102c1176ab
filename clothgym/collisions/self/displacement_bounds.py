"""The bounds of self-collision: what has left its bound is looked at anew, and in strict mode drawn back.

Everything happens between two certified states, the positions at the end of two substeps.  A move is cut short on the straight way
from the first, which lies in every bound.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.self.narrow_phase import GROUP_JAMMED, SHARE, query
from clothgym.contact_memory import (
    G_GROUP,
    G_KEPT,
    G_NUMBER,
    G_OWN,
    G_VERTICES,
    REPORT_CLAMPED,
    REPORT_CONTACTS,
    REPORT_LAG,
    REPORT_QUERIES,
    REPORT_UNCERTAIN,
)

INSIDE = 0.999  # of a bound that is used, for rounding
REPAY = 1.0  # speed at which a particle that lags behind its hand catches up [m/s]
FARTHEST = 16.0  # distance from the origin within which float32 is certified [m]
PATIENCE = 4  # looks at all gap constraints after which a query, which frees the vertices again, is the cheaper
AHEAD = 8  # substeps for which a query shall last: for fast vertices it looks farther
FORESEEN = 1.0  # of the reach, the most that it looks beyond it for one
HALVES = 4  # times that the way of a gap constraint is halved before it stays
PASSING = 8  # gap constraints passed over, since none of their vertices is beyond its bound, that cost as much as a look at one


@inlined
def confine(x, v, w, sheet, block, h):
    """Keep one block's sheets within their bounds; see the module."""
    memory, setting, samples = sheet.memory, sheet.setting, sheet.pairs.samples
    start, bounds, limits, old = memory.start[block], memory.bounds[block], memory.limits[block], memory.old[block]
    lanes = x.shape[2]
    for l in range(memory.used[block]):
        if memory.behind[block, l] > 0:
            memory.behind[block, l] = _catch_up(x, w, memory.lag[block], l, h)
    left = np.empty((x.shape[1], lanes), np.bool_)
    out, far = np.zeros(lanes, np.bool_), np.zeros(lanes, np.bool_)
    if lanes == 1:
        out[0], far[0] = _mark(x, start, bounds, limits, samples, 0, left[:, 0])
    else:
        _leave(x, start, bounds, limits, samples, left, out, far)
    beyond = np.empty(x.shape[1], np.bool_)
    for l in range(memory.used[block]):
        # a query if something is beyond all bounds, or if a gap constraint has come close in the direction that it had at the last
        # one
        if not out[l]:
            continue
        due = far[l]
        if not due and setting.strict:
            for p in range(x.shape[1]):
                beyond[p] = left[p, l]
            affected = np.empty(memory.constraints[block, l], np.int32)
            number = _list_affected(memory.members[block, l], beyond, affected)
            due, close = _comes_close(x, memory, block, l, affected[:number])
            if close and not due:
                _hold_apart(x, v, w, sheet, block, l, beyond, affected, number)
                # what has stayed has not shared the motion of the others
                _, due = _mark(x, start, bounds, limits, samples, l, beyond)
        if due:
            _renew(x, v, w, sheet, block, l, h, beyond)
    old[:] = x


@kernel
def _leave(x, start, bounds, limits, samples, left, some, far):
    """Which vertices have left their bounds, (particles, lanes), in which lanes some have, and in which one has left its limit.

    A motion that all share does not count: it changes no distance.
    """
    lanes = x.shape[2]
    share = x.dtype.type(1 / samples.shape[0])
    mean = np.zeros((3, lanes), x.dtype)
    for s in range(samples.shape[0]):
        for c in range(3):
            xs, ss = x[c, samples[s]], start[c, samples[s]]
            for l in range(lanes):
                mean[c, l] += (xs[l] - ss[l]) * share
    for p in range(x.shape[1]):
        bp, lp, out = bounds[p], limits[p], left[p]
        for l in range(lanes):
            dx = x[0, p, l] - start[0, p, l] - mean[0, l]
            dy = x[1, p, l] - start[1, p, l] - mean[1, l]
            dz = x[2, p, l] - start[2, p, l] - mean[2, l]
            square = dx * dx + dy * dy + dz * dz
            inside, allowed = square <= bp[l], square <= lp[l]
            out[l] = not inside
            some[l] |= not inside
            far[l] |= not allowed


@kernel
def _shift(x, start, samples, l):
    """The motion of one lane that all its vertices share [m]: it changes no distance."""
    share = x.dtype.type(1 / samples.shape[0])
    mx, my, mz = x.dtype.type(0), x.dtype.type(0), x.dtype.type(0)
    for s in range(samples.shape[0]):
        p = samples[s]
        mx += (x[0, p, l] - start[0, p, l]) * share
        my += (x[1, p, l] - start[1, p, l]) * share
        mz += (x[2, p, l] - start[2, p, l]) * share
    return mx, my, mz


@kernel
def _mark(x, start, bounds, limits, samples, l, left):
    """The same of one lane; left: (particles,).  Without loops of one round."""
    mx, my, mz = _shift(x, start, samples, l)
    some, far = False, False
    for p in range(x.shape[1]):
        dx, dy, dz = x[0, p, l] - start[0, p, l] - mx, x[1, p, l] - start[1, p, l] - my, x[2, p, l] - start[2, p, l] - mz
        square = dx * dx + dy * dy + dz * dz
        inside, allowed = square <= bounds[p, l], square <= limits[p, l]
        left[p] = not inside
        some |= not inside
        far |= not allowed
    return some, far


@kernel
def _catch_up(x, w, lag, l, h):
    """Move what lags behind its hand on, as far as the speed for it allows; who has been let go lags no more.  Returns the largest
    lag that is left."""
    zero = x.dtype.type(0)
    left = zero
    most = x.dtype.type(REPAY) * h
    for p in range(x.shape[1]):
        if w[p, l] > zero:
            lag[0, p, l] = lag[1, p, l] = lag[2, p, l] = zero
            continue
        lx, ly, lz = lag[0, p, l], lag[1, p, l], lag[2, p, l]
        length = np.sqrt(lx * lx + ly * ly + lz * lz)
        if length > zero:
            share = min(most / length, x.dtype.type(1))
            for c in range(3):
                way = share * lag[c, p, l]
                x[c, p, l] += way
                lag[c, p, l] -= way
            left = max(left, length - share * length)
    return left


@inlined
def _renew(x, v, w, sheet, block, l, h, beyond):
    """Query one lane at its certified positions, and in strict mode draw what is beyond its bound back to it.

    Bounds are about the motion that all share, so that a sheet in flight keeps it.  Where something is held, by a constraint or
    since it may not move at all, they are about the place itself: there rounding must not add up.  So they are where what a hand
    holds does not go with the others: else a jam would carry the hands away.
    """
    memory, particles = sheet.memory, x.shape[1]
    place, limits, held = np.empty((particles, 3)), np.empty(particles, x.dtype), np.empty(particles, np.bool_)
    look_around(memory.old[block], v, w, sheet, block, l, h, place, limits, held)
    if sheet.setting.strict:
        start, zero = memory.start[block], x.dtype.type(0)
        mx, my, mz = _shift(x, start, sheet.pairs.samples, l)
        together = True
        for p in range(particles):
            together &= limits[p] > zero
            if held[p]:
                dx, dy, dz = x[0, p, l] - start[0, p, l] - mx, x[1, p, l] - start[1, p, l] - my, x[2, p, l] - start[2, p, l] - mz
                together &= dx * dx + dy * dy + dz * dz <= limits[p]
        if not together:
            mx, my, mz = zero, zero, zero
        _draw_back(x, v, memory, block, l, h, place, limits, held, mx, my, mz)
        members, planes, constraints, close = memory.members[block, l], memory.planes[block, l], memory.constraints[block, l], False
        for t in range(constraints):
            close |= _is_close(x, members, planes, t, l)
        if close:
            _draw_back(x, v, memory, block, l, h, place, limits, held, zero, zero, zero)
            beyond[:] = True
            affected = np.empty(constraints, np.int32)
            _hold_apart(x, v, w, sheet, block, l, beyond, affected, _list_affected(members, beyond, affected))
        _note_lag(w, memory, block, l)


@kernel
def _draw_back(x, v, memory, block, l, h, start, limits, held, mx, my, mz):
    """Draw one lane's vertices back to their limits about a common motion m since the query [m].

    start: where they were at the query, (particles, 3); limits: the squares of how far they may go [m^2], (particles,).
    """
    lag, report = memory.lag[block], memory.report[block, l]
    real = x.dtype.type
    for p in range(x.shape[1]):
        sx, sy, sz = real(start[p, 0]), real(start[p, 1]), real(start[p, 2])
        dx, dy, dz = x[0, p, l] - sx - mx, x[1, p, l] - sy - my, x[2, p, l] - sz - mz
        square = dx * dx + dy * dy + dz * dz
        if square > limits[p]:
            keep = np.sqrt(limits[p] / square)
            report[REPORT_CLAMPED] += 1
            for c, s, m, d in ((0, sx, mx, dx), (1, sy, my, dy), (2, sz, mz, dz)):
                # from the start, so that what may not move at all does not creep by rounding
                goal = s + (m + keep * d)
                if held[p]:
                    lag[c, p, l] += x[c, p, l] - goal
                else:
                    v[c, p, l] = m / h + keep * (v[c, p, l] - m / h)
                x[c, p, l] = goal


@inlined
def _is_affected(members, t, beyond):
    """Whether a gap constraint has a vertex beyond its bound: one of the first four, or of what others it has."""
    some = (
        beyond[members[t, G_VERTICES]]
        | beyond[members[t, G_VERTICES + 1]]
        | beyond[members[t, G_VERTICES + 2]]
        | beyond[members[t, G_VERTICES + 3]]
    )
    for m in range(4, members[t, G_NUMBER]):
        some |= beyond[members[t, G_VERTICES + m]]
    return some


@kernel
def _list_affected(members, beyond, affected):
    """List the gap constraints with a vertex beyond its bound, all there is room for; returns how many."""
    number = 0
    for t in range(affected.shape[0]):
        affected[number] = t
        number += _is_affected(members, t, beyond)
    return number


@kernel
def _is_close(x, members, planes, t, l):
    """Whether a gap constraint of one lane is closer than it may be."""
    own = members[t, G_OWN]
    nx, ny, nz = planes[t, 0], planes[t, 1], planes[t, 2]
    low, high = np.inf, -np.inf
    for m in range(members[t, G_NUMBER]):
        p = members[t, G_VERTICES + m]
        place = nx * x[0, p, l] + ny * x[1, p, l] + nz * x[2, p, l]
        if m < own:
            low = min(low, place)
        else:
            high = max(high, place)
    # not what is not a number: that has diverged, and is not held
    return low - high < planes[t, G_KEPT]


@kernel
def _comes_close(x, memory, block, l, affected):
    """Whether a query is due for gap constraints of one lane, and whether one that is affected is closer than it may be.

    Pairs that have been held since the last query are jammed, and it would say the same: for them none is due until more have been
    looked at than it is worth.
    """
    members, planes, constraints = memory.members[block, l], memory.planes[block, l], memory.constraints[block, l]
    due, close = False, False
    for c in range(affected.shape[0]):
        if _is_close(x, members, planes, affected[c], l):
            close = True
            due |= members[affected[c], G_GROUP] != GROUP_JAMMED
    memory.looks[block, l] += constraints // PASSING + affected.shape[0]
    return due or memory.looks[block, l] > PATIENCE * constraints, close


@apart
def _hold_apart(x, v, w, sheet, block, l, beyond, affected, number):
    """Where a gap constraint of one lane would come closer than it may, halve the way of its vertices, and in the end leave them
    where they were; others may follow.

    affected: room for all gap constraints; the first ``number`` are those with a vertex beyond its bound.
    """
    memory = sheet.memory
    old, lag, report = memory.old[block], memory.lag[block], memory.report[block, l]
    members, planes, constraints = memory.members[block, l], memory.planes[block, l], affected.shape[0]
    zero, half = x.dtype.type(0), x.dtype.type(0.5)
    going = False
    for c in range(number):
        if _is_close(x, members, planes, affected[c], l):
            members[affected[c], G_GROUP] = GROUP_JAMMED
            going = True
    halved = np.zeros(x.shape[1], np.int64)
    while going:
        # in their order, round by round; once others are affected, the rest of the round looks at all
        going, spread, c, t = False, False, 0, -1
        while c < number or spread:
            if spread:
                t += 1
                if t == constraints:
                    break
                if not _is_affected(members, t, beyond):
                    continue
            else:
                t = affected[c]
                c += 1
            if not _is_close(x, members, planes, t, l):
                continue
            for m in range(members[t, G_NUMBER]):
                p = members[t, G_VERTICES + m]
                if halved[p] > HALVES:
                    continue
                report[REPORT_CLAMPED] += halved[p] == 0
                halved[p] += 1
                going = True
                spread |= not beyond[p]
                beyond[p] = True
                share = half if halved[p] <= HALVES else zero
                for k in range(3):
                    place = old[k, p, l]
                    if share > zero:  # what is not finite stays, too
                        place += share * (x[k, p, l] - place)
                    if w[p, l] <= zero:
                        lag[k, p, l] += x[k, p, l] - place
                    else:
                        v[k, p, l] *= share
                    x[k, p, l] = place
        if spread:
            number = _list_affected(members, beyond, affected)
    _note_lag(w, memory, block, l)


@kernel
def _note_lag(w, memory, block, l):
    """The largest lag of one lane."""
    lag = memory.lag[block]
    largest = lag.dtype.type(0)
    for p in range(w.shape[0]):
        if w[p, l] <= 0:
            largest = max(largest, lag[0, p, l] * lag[0, p, l] + lag[1, p, l] * lag[1, p, l] + lag[2, p, l] * lag[2, p, l])
    memory.behind[block, l] = np.sqrt(largest)
    memory.report[block, l, REPORT_LAG] = max(memory.report[block, l, REPORT_LAG], np.float64(memory.behind[block, l]))


@inlined
def look_around(x, v, w, sheet, block, l, h, p, limits, held):
    """Query one lane at the given positions; where it is fast it looks farther.

    p, limits and held become its positions in float64 [m], (particles, 3), the squares of how far they may go before the next query
    [m^2], (particles,), and whether they are held, (particles,): lanes lie far apart, so what is read again is copied.
    """
    memory, setting = sheet.memory, sheet.setting
    start, bounds = memory.start[block], memory.bounds[block]
    particles = x.shape[1]
    room, free, extra = np.empty(particles), np.empty(particles), np.empty(particles)
    _foresee(v, sheet, l, h, extra)
    for k in range(particles):
        held[k] = w[k, l] <= 0
        for c in range(3):
            start[c, k, l] = x[c, k, l]
            p[k, c] = x[c, k, l]
    report = memory.report[block, l]
    report[REPORT_QUERIES] += 1
    before = memory.contacts[block, l]
    known, impulses = memory.particles[block, l, :before].copy(), memory.impulses[block, l, :before].copy()
    count, constraints = query(
        p, sheet.pairs, sheet.reach, extra, held, room, free, memory.particles[block, l], memory.coefficients[block, l],
        memory.members[block, l], memory.planes[block, l], report,
    )  # fmt: skip
    memory.constraints[block, l] = constraints
    if not setting.strict:
        room[:] = SHARE * min(sheet.reach.near, sheet.reach.far)
        free[:] = room + 2.0 * SHARE * extra
    for k in range(particles):
        bounds[k, l] = (INSIDE * room[k]) ** 2
        limits[k] = (INSIDE * free[k]) ** 2
        memory.limits[block, k, l] = limits[k]
    _take_over(known, impulses, memory.particles[block, l], memory.impulses[block, l], count, particles)
    memory.contacts[block, l] = count
    # what has been found is swept over at once
    memory.choices[block, l] = -1
    memory.looks[block, l] = memory.span[block, l] = 0
    if count == 0:
        memory.pressed[block, :, :, l] = 0
    report[REPORT_CONTACTS] = count


@kernel
def note_uncertain(x, report, used):
    """Note which of one block's sheets are too far from the origin to be certified; what is not finite has diverged."""
    farthest = np.zeros(x.shape[2], x.dtype)
    for p in range(x.shape[1]):
        for c in range(3):
            xc = x[c, p]
            for l in range(x.shape[2]):
                farthest[l] = max(farthest[l], abs(xc[l]))
    for l in range(used):
        if farthest[l] > FARTHEST and farthest[l] < np.inf:
            report[l, REPORT_UNCERTAIN] = 1


@kernel
def _foresee(v, sheet, l, h, extra):
    """How much farther than its reach a query of one lane looks for each vertex [m].

    It is what the vertex needs, at the speed that it has beside the whole sheet's, not to ask for the next one too soon: few are
    that fast.
    """
    samples, far = sheet.pairs.samples, sheet.reach.far
    mx, my, mz = 0.0, 0.0, 0.0
    for s in range(samples.shape[0]):
        p = samples[s]
        mx, my, mz = mx + v[0, p, l], my + v[1, p, l], mz + v[2, p, l]
    share, ahead, most = 1.0 / samples.shape[0], 0.5 * AHEAD * h / SHARE, FORESEEN * far
    for p in range(v.shape[1]):
        dx, dy, dz = v[0, p, l] - share * mx, v[1, p, l] - share * my, v[2, p, l] - share * mz
        extra[p] = dx * dx + dy * dy + dz * dz
    for p in range(v.shape[1]):  # side by side: roots of many at once
        extra[p] = min(max(ahead * np.sqrt(extra[p]) - 0.5 * far, 0.0), most)


@kernel
def _take_over(known, impulses, particles, fresh, count, vertices):
    """Give the contacts that a query has found the impulses which the same contacts had before it, so that stacks stay at rest.

    known, impulses: those of before; particles, fresh: of now, of which there are ``count``.
    """
    last, before = np.full(vertices, -1, np.int32), np.empty(len(known), np.int32)
    for k in range(len(known)):
        before[k] = last[known[k, 0]]
        last[known[k, 0]] = k
    for k in range(count):
        fresh[k, 0] = fresh[k, 1] = fresh[k, 2] = 0
        old = last[particles[k, 0]]
        while old >= 0:
            if known[old, 1] == particles[k, 1] and known[old, 2] == particles[k, 2] and known[old, 3] == particles[k, 3]:
                for c in range(3):
                    fresh[k, c] = impulses[old, c]
                break
            old = before[old]

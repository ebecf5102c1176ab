"""The limits of self-collision: what has come to its limit is looked around anew, and in strict mode drawn back.

Everything happens between two certified states, the positions at the end of two substeps.  A move is cut short on a straight way
that lies within the limits, in which also the first of them does.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined, kernel
from clothgym.collisions.proximity import (
    CLAMPED,
    DROPPED,
    HELD,
    INSIDE,
    KEPT,
    LAG,
    MARGIN,
    NUMBER,
    OWN,
    QUERIES,
    ROWS,
    UNCERTAIN,
    VERTICES,
    keep_others,
    query,
)

REPAY = 1.0  # speed at which a particle that lags behind its hand catches up [m/s]
FARTHEST = 16.0  # distance from the origin within which float32 is certified [m]
AHEAD = 12  # substeps for which a fast vertex' limit shall last
SOON = 0.7  # share of its limit from which on a vertex asks if others do
HALVES = 4  # times that the way of a tied pair is halved before it stays
PATIENCE = 16  # substeps for which a pair that is held is not looked around again: that would say the same


@inlined
def confine(x, v, w, sheet, block, l, h):
    """Keep one sheet within its limits; see the module.  Returns whether it has been moved."""
    memory, strict, samples = sheet.memory, sheet.setting.strict, sheet.pairs.samples
    start, bounds, limits = memory.start[block, l], memory.bounds[block, l], memory.limits[block, l]
    old, frame = memory.old[block, l], memory.frame[block, l]
    particles, clamped = x.shape[1], memory.report[block, l, CLAMPED]
    moved = memory.behind[block, l] > 0
    if moved:
        memory.behind[block, l] = _catch_up(x, w, memory.lag[block, :, :, l], h)
    # the frame goes with the motion that all share
    fx, fy, fz = _share(x, old, samples, 0), _share(x, old, samples, 1), _share(x, old, samples, 2)
    beyond = np.empty(particles, np.bool_)
    some, far = _leave(x, start, bounds, limits, frame[0] + fx, frame[1] + fy, frame[2] + fz, beyond)
    if some:
        ties, planes = memory.ties[block, l], memory.planes[block, l]
        asks = np.zeros(particles, np.bool_)
        close = False
        if strict:
            far_ties, close = _ask(x, ties, planes, memory.tight[block, l], beyond, asks)
            far |= far_ties
        if far:
            _add_those_soon(x, start, limits, frame[0] + fx, frame[1] + fy, frame[2] + fz, asks)
            look_around(v, w, sheet, block, l, h, asks)
        if strict and (far or close):
            if far and _is_torn(x, w, start, limits, frame[0] + fx, frame[1] + fy, frame[2] + fz):
                fx = fy = fz = x.dtype.type(0)
            if far:
                _draw_back(x, v, w, memory, block, l, h, asks, fx, fy, fz)
                _leave(x, start, bounds, limits, frame[0] + fx, frame[1] + fy, frame[2] + fz, beyond)
                close = _is_any_close(x, ties, planes, memory.tight[block, l], beyond)
            if close:
                # what is held does not share the motion of the others
                fx = fy = fz = x.dtype.type(0)
                _draw_back(x, v, w, memory, block, l, h, asks, fx, fy, fz)
                _leave(x, start, bounds, limits, frame[0], frame[1], frame[2], beyond)
                _hold_apart(x, v, w, memory, block, l, beyond)
            if memory.report[block, l, CLAMPED] > clamped:
                moved = True
                _note_lag(w, memory, block, l)
    frame[0], frame[1], frame[2] = frame[0] + fx, frame[1] + fy, frame[2] + fz
    old[:] = x
    return moved


@inlined
def _share(x, old, samples, c):
    """A component of the motion in a substep that all vertices share [m]: it changes no distance."""
    total = x.dtype.type(0)
    for s in range(samples.shape[0]):
        total += x[c, samples[s]] - old[c, samples[s]]
    return total * x.dtype.type(1 / samples.shape[0])


@kernel
def _leave(x, start, bounds, limits, fx, fy, fz, beyond):
    """Which vertices have left their bounds, with the frame at f; returns whether some have, and whether one has left its limit."""
    some, far = False, False
    for p in range(x.shape[1]):
        dx, dy, dz = x[0, p] - fx - start[0, p], x[1, p] - fy - start[1, p], x[2, p] - fz - start[2, p]
        square = dx * dx + dy * dy + dz * dz
        inside, allowed = square <= bounds[p], square <= limits[p]
        beyond[p] = not inside
        some |= not inside
        far |= not allowed
    return some, far


@kernel
def _add_those_soon(x, start, limits, fx, fy, fz, asks):
    """Let those ask, too, that have almost come to their limit."""
    soon = x.dtype.type(SOON * SOON)
    for p in range(x.shape[1]):
        dx, dy, dz = x[0, p] - fx - start[0, p], x[1, p] - fy - start[1, p], x[2, p] - fz - start[2, p]
        asks[p] |= not dx * dx + dy * dy + dz * dz <= soon * limits[p]


@kernel
def _is_torn(x, w, start, limits, fx, fy, fz):
    """Whether what a hand holds, or what may not move at all, does not go with the others: a jam would carry the hands away."""
    torn = False
    for p in range(x.shape[1]):
        dx, dy, dz = x[0, p] - fx - start[0, p], x[1, p] - fy - start[1, p], x[2, p] - fz - start[2, p]
        torn |= (limits[p] <= 0) | ((w[p] <= 0) & (not dx * dx + dy * dy + dz * dz <= limits[p]))
    return torn


@kernel
def _catch_up(x, w, lag, h):
    """Move what lags behind its hand on, as far as the speed for it allows; who has been let go lags no more.  Returns the largest
    lag that is left."""
    zero = x.dtype.type(0)
    left = zero
    most = x.dtype.type(REPAY) * h
    for p in range(x.shape[1]):
        if w[p] > zero:
            lag[0, p] = lag[1, p] = lag[2, p] = zero
            continue
        lx, ly, lz = lag[0, p], lag[1, p], lag[2, p]
        length = np.sqrt(lx * lx + ly * ly + lz * lz)
        if length > zero:
            share = min(most / length, x.dtype.type(1))
            for c in range(3):
                way = share * lag[c, p]
                x[c, p] += way
                lag[c, p] -= way
            left = max(left, length - share * length)
    return left


@kernel
def _draw_back(x, v, w, memory, block, l, h, asks, fx, fy, fz):
    """Draw one sheet's vertices back to their limits, with the frame moved by f in this substep [m]."""
    start, limits, old, frame = memory.start[block, l], memory.limits[block, l], memory.old[block, l], memory.frame[block, l]
    lag, report = memory.lag[block, :, :, l], memory.report[block, l]
    for p in range(x.shape[1]):
        dx, dy, dz = (
            x[0, p] - (frame[0] + fx) - start[0, p],
            x[1, p] - (frame[1] + fy) - start[1, p],
            x[2, p] - (frame[2] + fz) - start[2, p],
        )
        square = dx * dx + dy * dy + dz * dz
        if not square > limits[p]:
            continue
        keep = np.sqrt(limits[p] / square)
        report[CLAMPED] += 1
        for c, m in ((0, fx), (1, fy), (2, fz)):
            # what may not move at all must not creep by rounding
            home = m + (old[c, p] if asks[p] else start[c, p] + frame[c])
            goal = home + keep * (x[c, p] - home)
            if w[p] <= 0:
                lag[c, p] += x[c, p] - goal
            else:
                v[c, p] = m / h + keep * (v[c, p] - m / h)
            x[c, p] = goal


@inlined
def _touches(ties, t, beyond):
    """Whether a tied pair has a vertex beyond its bound: one of the first four, or of what others it has."""
    some = beyond[ties[t, VERTICES]] | beyond[ties[t, VERTICES + 1]] | beyond[ties[t, VERTICES + 2]] | beyond[ties[t, VERTICES + 3]]
    for m in range(4, ties[t, NUMBER]):
        some |= beyond[ties[t, VERTICES + m]]
    return some


@inlined
def _is_close(x, ties, planes, t):
    """Whether a tied pair is closer than it may be."""
    own = ties[t, OWN]
    nx, ny, nz = planes[t, 0], planes[t, 1], planes[t, 2]
    low, high = np.inf, -np.inf
    for m in range(ties[t, NUMBER]):
        p = ties[t, VERTICES + m]
        place = nx * x[0, p] + ny * x[1, p] + nz * x[2, p]
        if m < own:
            low = min(low, place)
        else:
            high = max(high, place)
    # not what is not a number: that has diverged, and is not held
    return low - high < planes[t, KEPT]


@kernel
def _ask(x, ties, planes, tight, beyond, asks):
    """Let the vertices of tied pairs that have come too close ask, unless the pair has been held for that lately; returns whether
    some do, and whether some are too close."""
    some, close = False, False
    for t in range(tight):
        if not _touches(ties, t, beyond) or not _is_close(x, ties, planes, t):
            continue
        close = True
        if ties[t, HELD] > 0:
            ties[t, HELD] -= 1
            continue
        some = True
        for m in range(ties[t, NUMBER]):
            asks[ties[t, VERTICES + m]] = True
    return some, close


@kernel
def _is_any_close(x, ties, planes, tight, beyond):
    """Whether a tied pair with a vertex beyond its bound is closer than it may be."""
    for t in range(tight):
        if _touches(ties, t, beyond) and _is_close(x, ties, planes, t):
            return True
    return False


@apart
def _hold_apart(x, v, w, memory, block, l, beyond):
    """Where a tied pair of one sheet would come closer than it may, halve the way of its vertices, and in the end leave them where
    they were; others may follow."""
    old, lag, report = memory.old[block, l], memory.lag[block, :, :, l], memory.report[block, l]
    ties, planes, tight = memory.ties[block, l], memory.planes[block, l], memory.tight[block, l]
    zero, half = x.dtype.type(0), x.dtype.type(0.5)
    halved, touched = np.zeros(x.shape[1], np.int64), np.empty(tight, np.int32)
    going, spread, number = True, True, 0
    while going:
        if spread:
            number = 0
            for t in range(tight):
                touched[number] = t
                number += _touches(ties, t, beyond)
        going, spread = False, False
        for c in range(number):
            t = touched[c]
            if not _is_close(x, ties, planes, t):
                continue
            if ties[t, HELD] < 0:
                ties[t, HELD] = PATIENCE
            for m in range(ties[t, NUMBER]):
                p = ties[t, VERTICES + m]
                if halved[p] > HALVES:
                    continue
                report[CLAMPED] += halved[p] == 0
                halved[p] += 1
                going = True
                spread |= not beyond[p]
                beyond[p] = True
                share = half if halved[p] <= HALVES else zero
                for k in range(3):
                    place = old[k, p]
                    if share > zero:  # what is not finite stays, too
                        place += share * (x[k, p] - place)
                    if w[p] <= zero:
                        lag[k, p] += x[k, p] - place
                    else:
                        v[k, p] *= share
                    x[k, p] = place


@kernel
def _note_lag(w, memory, block, l):
    """The largest lag of one sheet."""
    lag = memory.lag[block, :, :, l]
    largest = lag.dtype.type(0)
    for p in range(w.shape[0]):
        if w[p] <= 0:
            largest = max(largest, lag[0, p] * lag[0, p] + lag[1, p] * lag[1, p] + lag[2, p] * lag[2, p])
    memory.behind[block, l] = np.sqrt(largest)
    memory.report[block, l, LAG] = max(memory.report[block, l, LAG], np.float64(memory.behind[block, l]))


@apart
def look_around(v, w, sheet, block, l, h, asks):
    """Look around those of one sheet's vertices that ask, where they were last certified; fast ones get higher limits."""
    memory, pairs, reach = sheet.memory, sheet.pairs, sheet.reach
    start, bounds, limits = memory.start[block, l], memory.bounds[block, l], memory.limits[block, l]
    old, frame, report = memory.old[block, l], memory.frame[block, l], memory.report[block, l]
    ties, planes, impulses = memory.ties[block, l], memory.planes[block, l], memory.impulses[block, l]
    particles, figures = memory.particles[block, l], memory.figures[block, l]
    number = asks.shape[0]
    p, held, moved = np.empty((number, 3)), np.empty(number, np.bool_), np.zeros(number)
    wide, around, active = np.empty(number), np.empty(number), np.zeros(pairs.corners.shape[0], np.bool_)
    _foresee(v, sheet, h, wide)
    least = 0.5 * (reach.far_thickness + reach.margin)
    for k in range(number):
        held[k] = w[k] <= 0
        for c in range(3):
            if asks[k]:
                start[c, k] = old[c, k] - frame[c]
            p[k, c] = np.float64(old[c, k]) - frame[c]
        if asks[k]:
            bounds[k] = limits[k] = (INSIDE * wide[k]) ** 2
            for n in range(pairs.vertex_leaves[k], pairs.vertex_leaves[k + 1]):
                active[pairs.around_leaves[n]] = True
        else:
            dx, dy, dz = p[k, 0] - start[0, k], p[k, 1] - start[1, k], p[k, 2] - start[2, k]
            moved[k] = np.sqrt(dx * dx + dy * dy + dz * dz)
        wide[k] = np.sqrt(np.float64(limits[k])) / INSIDE
        around[k] = max(wide[k], least) + 0.5 * MARGIN
        wide[k] += moved[k]
    before = memory.contacts[block, l]
    lost, lost_impulses, found = np.empty((before, 4), np.int32), np.empty((before, 3), impulses.dtype), np.empty(2, np.int64)
    pressed = keep_others(
        active, before, memory.tight[block, l], particles, figures, impulses, ties, planes, lost, lost_impulses, found
    )
    kept, dropped = found[0], report[DROPPED]
    query(
        p, start, wide, around, moved, held, pairs, reach, sheet.setting.strict, active, memory.stale[block, l], memory.box[block, l],
        memory.ball[block, l], memory.hulls[block, l], bounds, limits, found, particles, figures, ties, planes, report,
    )  # fmt: skip
    _take_over(lost, lost_impulses, pressed, particles, impulses, kept, found[0], number)
    memory.tight[block, l], memory.contacts[block, l] = found[1], found[0]
    # boxes were made for limits that may have become lower
    memory.stale[block, l] = report[DROPPED] > dropped
    report[QUERIES] += 1
    report[ROWS] = found[0]
    if kept < before or kept < found[0]:
        # what has been found is swept over at once
        memory.choices[block, l] = -1
        memory.span[block, l] = 0
    if found[0] == 0:
        memory.pressed[block, :, :, l] = 0


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
            report[l, UNCERTAIN] = 1


@kernel
def _foresee(v, sheet, h, limits):
    """How far each vertex of one sheet may go before it is looked around again [m]: what is fast beside the whole sheet need not
    ask too soon."""
    samples, reach = sheet.pairs.samples, sheet.reach
    mx, my, mz = 0.0, 0.0, 0.0
    for s in range(samples.shape[0]):
        p = samples[s]
        mx, my, mz = mx + v[0, p], my + v[1, p], mz + v[2, p]
    share, ahead = 1.0 / samples.shape[0], AHEAD * h
    for p in range(v.shape[1]):
        dx, dy, dz = v[0, p] - share * mx, v[1, p] - share * my, v[2, p] - share * mz
        # not what is not a number
        limits[p] = min(max(ahead * np.sqrt(dx * dx + dy * dy + dz * dz), reach.limit), reach.most)


@kernel
def _take_over(known, impulses, count, particles, fresh, begin, end, vertices):
    """Give contacts that have been found the impulses which the same ones had before, so that stacks stay at rest.

    known, impulses: those of before, ``count`` of them; particles, fresh: of now, from ``begin`` to ``end``.
    """
    last, before = np.full(vertices if count > 0 else 0, -1, np.int32), np.empty(count, np.int32)
    for k in range(count):
        before[k] = last[known[k, 0]]
        last[known[k, 0]] = k
    for k in range(begin, end):
        fresh[k, 0] = fresh[k, 1] = fresh[k, 2] = 0
        old = last[particles[k, 0]] if count > 0 else -1
        while old >= 0:
            if known[old, 1] == particles[k, 1] and known[old, 2] == particles[k, 2] and known[old, 3] == particles[k, 3]:
                for c in range(3):
                    fresh[k, c] = impulses[old, c]
                break
            old = before[old]

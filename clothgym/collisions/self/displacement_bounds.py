"""Displacement bounds of self-collision: vertices that leave their bounds are checked, and in strict mode clamped.

Everything happens between two certified states, the positions at the end of two substeps.  A move that is cut short ends on the
straight line from the first state to the second; the first lies within every bound.  A zone of vertices that may not move by
themselves moves as a whole, and what that may violate is tested.

A vertex is *outside* if it has moved farther than its bound since the last query.  Then its gap constraints are evaluated (see
``gap_constraints``), or a query gives new bounds.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, kernel, merged, uncounted
from clothgym.collisions.self.gap_constraints import enforce_gaps, evaluate_constraints, is_violated, list_active, note_lag
from clothgym.collisions.self.narrow_phase import MARGIN, SHARE
from clothgym.collisions.self.query import query
from clothgym.collisions.self.query_scratch import Found
from clothgym.collisions.self.spread import least_stretch
from clothgym.contact_memory import REPORT_CLAMPED, REPORT_CONTACTS, REPORT_QUERIES, REPORT_UNCERTAIN

INSIDE = 0.999  # share of each bound that is used; the rest allows for rounding
CATCH_UP = 1.0  # speed at which a particle that lags behind its attachment catches up [m/s]
FARTHEST = 16.0  # distance from the origin within which float32 is certified [m]
AHEAD = 8  # substeps that a query should last: it looks farther around fast vertices
AHEAD_MOST = 1.0  # largest distance beyond the reach that it looks, as a share of the reach


@uncounted
def clamp_displacements(x, v, w, sheet, scratch, block, h):
    """Keep those of one block's sheets in their displacement bounds that have left them, as ``memory.any_outside`` says.

    x, v: [m], [m/s], (3, particles, lanes).  w: inverse masses [1/kg], (particles, lanes).  scratch: a
    ``query_scratch.QueryScratch``.  h: the substep [s].
    """
    memory, setting = sheet.memory, sheet.setting
    for l in range(memory.used[block]):
        if not memory.any_outside[block, l]:
            continue
        due, outside = memory.query_due[block, l], memory.outside[block, :, l]
        # within their limits, vertices are certified by their gap constraints: evaluate the active ones
        if not due and setting.strict:
            active = memory.active[block, l, : memory.constraints[block, l]]
            number = list_active(memory.members[block, l], outside, active)
            due, violated = evaluate_constraints(x, memory, block, l, active[:number])
            # jammed constraints are enforced without a query, which would find the same again
            if violated and not due:
                enforce_gaps(x, v, w, sheet, block, l, outside, active, number, scratch, h, False)
                # vertices that stayed in place or moved as a zone have left the common motion, and so perhaps their limits
                due = _any_beyond(x, memory.start[block], memory.limits[block], sheet.pairs.samples, l)
        # a query at the certified positions gives new bounds
        if due:
            _query_again(x, v, w, sheet, scratch, block, l, h, outside)


@disjoint
def keep(row, out):
    """Note certified positions: a loop of its own, so that it is vectorized; both flat."""
    for e in range(row.shape[0]):
        out[e] = row[e]


@kernel
def find_outside_in_lanes(x, start, bounds, limits, samples, outside, any_outside, query_due):
    """Find the vertices that have left their bounds since the last query, |x - start - m| > b, with the common motion m.

    m, the mean displacement of the samples, changes no distance.  outside: becomes which vertices, (particles, lanes); any_outside:
    in which lanes there are some; query_due: in which lanes one has left its limit, (lanes,).  Returns whether there are any.
    """
    lanes = x.shape[2]
    any_outside[:] = False
    query_due[:] = False
    # the common motion of each lane
    share = x.dtype.type(1 / samples.shape[0])
    mean = np.zeros((3, lanes), x.dtype)
    for s in range(samples.shape[0]):
        for c in range(3):
            xs, ss = x[c, samples[s]], start[c, samples[s]]
            for l in range(lanes):
                mean[c, l] += (xs[l] - ss[l]) * share
    # the displacements relative to it, squared
    for p in range(x.shape[1]):
        bp, lp, outside_p = bounds[p], limits[p], outside[p]
        for l in range(lanes):
            dx = x[0, p, l] - start[0, p, l] - mean[0, l]
            dy = x[1, p, l] - start[1, p, l] - mean[1, l]
            dz = x[2, p, l] - start[2, p, l] - mean[2, l]
            square = dx * dx + dy * dy + dz * dz
            within_bound, within_limit = square <= bp[l], square <= lp[l]
            outside_p[l] = not within_bound
            any_outside[l] |= not within_bound
            query_due[l] |= not within_limit
    some = False
    for l in range(lanes):
        some |= any_outside[l]
    return some


@kernel
def _common_motion(x, start, samples, l):
    """Motion of one lane since the last query that all its vertices share, the mean of the samples [m]: it changes no distance."""
    share = x.dtype.type(1 / samples.shape[0])
    mx, my, mz = x.dtype.type(0), x.dtype.type(0), x.dtype.type(0)
    for s in range(samples.shape[0]):
        p = samples[s]
        mx += (x[0, p, l] - start[0, p, l]) * share
        my += (x[1, p, l] - start[1, p, l]) * share
        mz += (x[2, p, l] - start[2, p, l]) * share
    return mx, my, mz


@uncounted
def find_outside_of_sheet(x, start, bounds, limits, samples, outside, any_outside, query_due):
    """The same for a block that is one sheet."""
    mx, my, mz = _common_motion(x, start, samples, 0)
    left, due = _find_outside(
        merged(x[0]), merged(x[1]), merged(x[2]), merged(start[0]), merged(start[1]), merged(start[2]),
        mx, my, mz, merged(bounds), merged(limits), merged(outside),
    )  # fmt: skip
    any_outside[0], query_due[0] = left > 0, due > 0
    return left > 0


@disjoint
def _find_outside(x, y, z, sx, sy, sz, mx, my, mz, bounds, limits, outside):
    """How many vertices of one sheet have left their bounds, and their limits; all (particles,)."""
    left, due = 0, 0
    for p in range(outside.shape[0]):
        dx, dy, dz = x[p] - sx[p] - mx, y[p] - sy[p] - my, z[p] - sz[p] - mz
        square = dx * dx + dy * dy + dz * dz
        outside[p] = not square <= bounds[p]
        left += not square <= bounds[p]
        due += not square <= limits[p]
    return left, due


@kernel
def _any_beyond(x, start, limits, samples, l):
    """Whether a vertex of lane l has left its limit."""
    mx, my, mz = _common_motion(x, start, samples, l)
    beyond = False
    for p in range(x.shape[1]):
        dx, dy, dz = x[0, p, l] - start[0, p, l] - mx, x[1, p, l] - start[1, p, l] - my, x[2, p, l] - start[2, p, l] - mz
        beyond |= not dx * dx + dy * dy + dz * dz <= limits[p, l]
    return beyond


@uncounted
def catch_up(x, w, lag, l, h):
    """Move lagging particles of lane l towards their attachments, at ``CATCH_UP`` at most.  A released particle lags no more.
    Returns the largest lag left [m].
    """
    zero = x.dtype.type(0)
    largest = zero
    longest_way = x.dtype.type(CATCH_UP) * h
    for p in range(x.shape[1]):
        # released
        if w[p, l] > zero:
            lag[0, p, l] = lag[1, p, l] = lag[2, p, l] = zero
            continue
        lx, ly, lz = lag[0, p, l], lag[1, p, l], lag[2, p, l]
        length = np.sqrt(lx * lx + ly * ly + lz * lz)
        if length > zero:
            share = min(longest_way / length, x.dtype.type(1))
            for c in range(3):
                way = share * lag[c, p, l]
                x[c, p, l] += way
                lag[c, p, l] -= way
            largest = max(largest, length - share * length)
    return largest


@uncounted
def _query_again(x, v, w, sheet, scratch, block, l, h, outside):
    """Query lane l at its certified positions, and in strict mode clamp the vertices to their new limits.

    Bounds are relative to the common motion, so that a sheet in flight keeps its speed.  They are relative to the positions
    themselves where a gap constraint acts or a vertex may not move at all: there rounding must not add up.  The same holds where
    attached particles do not move with the others: otherwise a jam would carry the attachments away.

    outside: scratch, (particles,).
    """
    memory, particles, limits, held = sheet.memory, x.shape[1], scratch.squares, scratch.held
    _look_around(memory.old[block], v, w, sheet, scratch, block, l, h)
    if sheet.setting.strict:
        # the common motion, unless a vertex may not move, or an attached one does not share it
        start, zero = memory.start[block], x.dtype.type(0)
        mx, my, mz = _common_motion(x, start, sheet.pairs.samples, l)
        in_common = True
        for p in range(particles):
            in_common &= limits[p] > zero
            if held[p]:
                dx, dy, dz = x[0, p, l] - start[0, p, l] - mx, x[1, p, l] - start[1, p, l] - my, x[2, p, l] - start[2, p, l] - mz
                in_common &= dx * dx + dy * dy + dz * dz <= limits[p]
        if not in_common:
            mx, my, mz = zero, zero, zero
        # clamp each vertex to its limit
        _clamp(x, v, memory, block, l, h, scratch.p, limits, held, mx, my, mz)
        # where that violates a gap constraint, clamp without the common motion, then enforce the constraints
        members, planes, constraints = memory.members[block, l], memory.planes[block, l], memory.constraints[block, l]
        violated = False
        for t in range(constraints):
            violated |= is_violated(x, members, planes, t, l)
        if violated:
            _clamp(x, v, memory, block, l, h, scratch.p, limits, held, zero, zero, zero)
            outside[:] = True
            active = memory.active[block, l, :constraints]
            enforce_gaps(x, v, w, sheet, block, l, outside, active, list_active(members, outside, active), scratch, h, True)
        note_lag(w, memory, block, l)


@uncounted
def _clamp(x, v, memory, block, l, h, start, limits, held, mx, my, mz):
    """Clamp the vertices of lane l to their limits: x <- s + m + (x - s - m) min(1, b / |x - s - m|).

    start: positions s at the query [m], (particles, 3).  limits: b^2 [m^2], (particles,).  held: attached particles, (particles,);
    what they lose is added to their lag.  m: common motion since the query [m].  The velocity relative to m / h is shortened by the
    same share.
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
                # reckoned from the start, so that a vertex that may not move does not creep by rounding
                goal = s + (m + keep * d)
                if held[p]:
                    lag[c, p, l] += x[c, p, l] - goal
                else:
                    v[c, p, l] = m / h + keep * (v[c, p, l] - m / h)
                x[c, p, l] = goal


@uncounted
def _look_around(x, v, w, sheet, scratch, block, l, h):
    """Query lane l at positions x, and farther around fast vertices.

    Of ``scratch``, ``p``, ``squares`` and ``held`` become its positions in float64 [m], the squares of how far each vertex may move
    before the next query [m^2], and which particles are attached.  They are copies: the values of a lane lie far apart.
    """
    memory, p, held = sheet.memory, scratch.p, scratch.held
    start, bounds, limits, squares = memory.start[block], memory.bounds[block], memory.limits[block], scratch.squares
    particles = x.shape[1]
    # copies of what the query reads; contacts are laid out where each vertex is after half of its way since the last query again
    for k in range(particles):
        held[k] = w[k, l] <= 0
        for c in range(3):
            p[k, c] = x[c, k, l]
            scratch.ahead[k, c] = p[k, c] + 0.5 * (p[k, c] - start[c, k, l])
            start[c, k, l] = x[c, k, l]
    report = memory.report[block, l]
    report[REPORT_QUERIES] += 1
    contacts, rows, impulses = memory.contacts[block, l], memory.particles[block, l], memory.impulses[block, l]
    for k in range(contacts):
        for c in range(4):
            scratch.known[k, c] = rows[k, c]
        for c in range(3):
            scratch.impulses[k, c] = impulses[k, c]
    # of a sheet that is spread out nothing is within reach, and until the next query nothing comes within the thickness
    reach, least = sheet.reach, min(sheet.reach.near, sheet.reach.far)
    found = Found(rows, memory.coefficients[block, l], memory.members[block, l], memory.planes[block, l], scratch.counts, report)
    clear = least_stretch(p, sheet.pairs.parts.triangles, sheet.pairs.to_rest, scratch.gradients, scratch.smallest) * reach.at_rest
    if clear >= max(reach.near, reach.far):
        scratch.extra[:] = 0.0
        scratch.bounds[:] = scratch.limits[:] = SHARE * (max(clear - reach.far_thickness, least) - MARGIN)
        found.counts[:] = 0
    # else find contacts and gap constraints, and bounds
    else:
        _look_ahead(v, sheet.pairs.samples, reach.far, l, h, scratch.extra)
        query(sheet.pairs, reach, scratch, found)
    count = found.counts[0]
    memory.constraints[block, l] = found.counts[1]
    # fast mode takes no notice of distances: it queries when something may have come within reach
    if not sheet.setting.strict:
        for k in range(particles):
            scratch.bounds[k] = SHARE * least
            scratch.limits[k] = scratch.bounds[k] + 2.0 * SHARE * scratch.extra[k]
    # bounds are compared with squared displacements
    for k in range(particles):
        bounds[k, l] = (INSIDE * scratch.bounds[k]) ** 2
        squares[k] = (INSIDE * scratch.limits[k]) ** 2
        limits[k, l] = squares[k]
    # contacts found again keep their impulses
    _keep_impulses(scratch.known[:contacts], scratch.impulses, rows, impulses, count, scratch.last, scratch.before)
    memory.contacts[block, l] = count
    # a sweep is due at once
    memory.choices[block, l] = -1
    memory.looks[block, l] = memory.span[block, l] = 0
    if count == 0:
        memory.pressed[block, :, :, l] = 0
    report[REPORT_CONTACTS] = count


@kernel
def note_uncertain(x, report, used):
    """Report the lanes of one block whose sheet is too far from the origin to be certified, unless it has diverged."""
    farthest = np.zeros(x.shape[2], x.dtype)
    for p in range(x.shape[1]):
        for c in range(3):
            xc = x[c, p]
            for l in range(x.shape[2]):
                farthest[l] = max(farthest[l], abs(xc[l]))
    for l in range(used):
        if farthest[l] > FARTHEST and farthest[l] < np.inf:
            report[l, REPORT_UNCERTAIN] = 1


@uncounted
def _look_ahead(v, samples, far, l, h, extra):
    """How much farther than its reach a query of lane l looks around each vertex [m]: ``extra``, (particles,).

    It is enough to last ``AHEAD`` substeps at the vertex's speed relative to the whole sheet.  Few vertices are fast enough to need
    any.  samples: vertices that stand for the sheet.  far: the reach [m].
    """
    # mean velocity of the samples
    mx, my, mz = 0.0, 0.0, 0.0
    for s in range(samples.shape[0]):
        p = samples[s]
        mx, my, mz = mx + v[0, p, l], my + v[1, p, l], mz + v[2, p, l]
    share, ahead, most = 1.0 / samples.shape[0], 0.5 * AHEAD * h / SHARE, AHEAD_MOST * far
    # speeds relative to it, squared
    for p in range(v.shape[1]):
        dx, dy, dz = v[0, p, l] - share * mx, v[1, p, l] - share * my, v[2, p, l] - share * mz
        extra[p] = dx * dx + dy * dy + dz * dz
    # a loop of its own, so that the roots are vectorized
    for p in range(v.shape[1]):
        extra[p] = min(max(ahead * np.sqrt(extra[p]) - 0.5 * far, 0.0), most)


@uncounted
def _keep_impulses(known, impulses, particles, fresh, count, last, before):
    """Give each contact found by a query the impulse that the same contact had before, so that stacks stay at rest.

    known, impulses: particles and impulses before, (contacts, 4), (contacts, 3).  particles, fresh: the same now, of which there
    are ``count``.  last, before: scratch, (vertices,), (contacts,).
    """
    # the contacts of each first particle, as a linked list
    last[:] = -1
    for k in range(known.shape[0]):
        before[k] = last[known[k, 0]]
        last[known[k, 0]] = k
    # the same four particles in the same order
    for k in range(count):
        fresh[k, 0] = fresh[k, 1] = fresh[k, 2] = 0
        old = last[particles[k, 0]]
        while old >= 0:
            if known[old, 1] == particles[k, 1] and known[old, 2] == particles[k, 2] and known[old, 3] == particles[k, 3]:
                for c in range(3):
                    fresh[k, c] = impulses[old, c]
                break
            old = before[old]

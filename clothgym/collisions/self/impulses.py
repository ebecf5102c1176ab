"""Contacts of a sheet with itself: impulses between what is closer than the thickness of the cloth.

Projected Gauss-Seidel on the velocities with a warm start: an impulse is kept from substep to substep, pressed on again before
anything else, and corrected by a sweep over the contacts, each substep, or every few where nothing had to be corrected by much.
Between sweeps, what all contacts press is one change of velocity for each particle.

The normal part leaves as much velocity of approach as closes the gap to the thickness, not more, and never pulls; it does not
switch on and off where the gap is the thickness.  The tangential part is what stops the sliding, as far as Coulomb's law allows.
So stacks come to rest, and friction between layers holds.  What is too close is pushed apart at a bounded speed, by its position
alone, so that no kinetic energy comes of it; springs that stand against it would make some again, so only what can give way is
pushed (see ``proximity.edge_contacts``).
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, disjoint, inlined, kernel
from clothgym.collisions.self.narrow_phase import SLOP
from clothgym.contact_memory import C_NORMAL, C_THICKNESS, REPORT_TOUCHING

RELAXED = 0.03  # share of what is too close by which a contact pushes apart in a substep: its neighbours push the same vertices
SPAN = 4  # substeps between two sweeps over contacts that have converged; over others a sweep goes in each
TOLERANCE = 0.005  # thicknesses by which a converged contact's correction moves it in the longest span, at most
CHOSEN_EVERY = 8  # substeps after which contacts are chosen anew that may act soon
# velocity of approach that a contact takes in a substep, at most [m/s]: in a jam, which takes all motion away, what is kept from
# substep to substep would grow for ever
FASTEST = 10.0
SOON = 0.05  # thicknesses beyond the thickness within which a contact may act soon


@apart
def press_again(x, v, w, sheet, block, carried):
    """What the contacts pressed at the last sweep, on one block's sheets; before the solids, so that these bear what lies on them.

    Where nothing presses, every bit stays.
    """
    memory = sheet.memory
    zero, some = x.dtype.type(0), False
    for l in range(memory.used[block]):
        some |= memory.contacts[block, l] > 0
    if not some:
        return
    # what changes no bit when it is added; two selects of x and v instead would keep the loop from being one of vectors
    nothing = -zero
    for c in range(3):
        _press(
            x[c].reshape(w.size), v[c].reshape(w.size), w.reshape(w.size), memory.pressed[block, c].reshape(w.size), carried,
            nothing
        )  # fmt: skip


@disjoint
def _press(x, v, w, pressed, carried, nothing):
    """One component of what contacts press, by particle and lane."""
    zero = x.dtype.type(0)
    for e in range(x.shape[0]):
        change = pressed[e] if (w[e] > zero) & (pressed[e] != zero) else nothing
        x[e] += carried * change
        v[e] += change


@apart
def repel(x, v, w, sheet, block, h, carried):
    """Contacts of one block's sheets with themselves, of those that a sweep is due for."""
    memory, number, lanes = sheet.memory, x.shape[1], x.shape[2]
    for l in range(memory.used[block]):
        if memory.contacts[block, l] == 0:
            continue
        memory.waited[block, l] += 1
        memory.aged[block, l] += 1
        if memory.waited[block, l] < memory.span[block, l]:
            continue
        if lanes == 1:
            _sweep(x.reshape(3, number), v.reshape(3, number), w.reshape(number), sheet, block, l, h, carried)
        else:  # lanes lie far apart, and contacts read each particle many times
            place, motion, mobility = x[:, :, l].copy(), v[:, :, l].copy(), w[:, l].copy()
            _sweep(place, motion, mobility, sheet, block, l, h, carried)
            x[:, :, l], v[:, :, l] = place, motion


@kernel
def _sweep(x, v, w, sheet, block, l, h, carried):
    """Sweep over one sheet's contacts; x, v: (3, particles), w: (particles,)."""
    memory, setting, count, waited = sheet.memory, sheet.setting, sheet.memory.contacts[block, l], sheet.memory.waited[block, l]
    particles, coefficients, impulses = memory.particles[block, l], memory.coefficients[block, l], memory.impulses[block, l]
    chosen = memory.chosen[block, l]
    if memory.aged[block, l] >= CHOSEN_EVERY or memory.choices[block, l] < 0:
        memory.choices[block, l] = _choose(x, v, particles, coefficients, impulses, chosen, count, h)
        memory.aged[block, l] = 0
    choices = memory.choices[block, l]
    touching, most = _correct(
        x, v, w, particles, coefficients, impulses, chosen, choices, carried, setting.friction, setting.push * h, h, waited
    )
    _add_up(w, particles, coefficients, impulses, chosen, choices, memory.pressed[block, :, :, l])
    memory.report[block, l, REPORT_TOUCHING] = touching
    memory.waited[block, l] = 0
    memory.span[block, l] = min(2 * waited, SPAN) if most * x.dtype.type(SPAN) * h < setting.tolerance else 1


@inlined
def _along(a, particles, coefficients, k, nx, ny, nz):
    """n.(sum of weights times positions or velocities) of contact k."""
    i, j, m, n = particles[k, 0], particles[k, 1], particles[k, 2], particles[k, 3]
    wi, wj, wm, wn = coefficients[k, 0], coefficients[k, 1], coefficients[k, 2], coefficients[k, 3]
    ax = wi * a[0, i] + wj * a[0, j] + wm * a[0, m] + wn * a[0, n]
    ay = wi * a[1, i] + wj * a[1, j] + wm * a[1, m] + wn * a[1, n]
    az = wi * a[2, i] + wj * a[2, j] + wm * a[2, m] + wn * a[2, n]
    return nx * ax + ny * ay + nz * az, ax, ay, az


@inlined
def _push(x, v, w, particles, coefficients, k, jx, jy, jz, carried, qx, qy, qz):
    """Add an impulse j [N s] to contact k's velocities, what of it has been carried on to its positions, and a push q to these."""
    for c in range(4):
        p = particles[k, c]
        share = w[p] * coefficients[k, c]
        v[0, p] += share * jx
        v[1, p] += share * jy
        v[2, p] += share * jz
        x[0, p] += share * (carried * jx + qx)
        x[1, p] += share * (carried * jy + qy)
        x[2, p] += share * (carried * jz + qz)


@kernel
def _choose(x, v, particles, coefficients, impulses, chosen, count, h):
    """List the contacts that may act soon; returns how many.  The others lose their impulses."""
    zero = x.dtype.type(0)
    ahead = x.dtype.type(CHOSEN_EVERY) * h
    beyond = x.dtype.type(1 + SOON)
    number = 0
    for k in range(count):
        nx, ny, nz = coefficients[k, C_NORMAL], coefficients[k, C_NORMAL + 1], coefficients[k, C_NORMAL + 2]
        gap, _, _, _ = _along(x, particles, coefficients, k, nx, ny, nz)
        speed, _, _, _ = _along(v, particles, coefficients, k, nx, ny, nz)
        if gap + ahead * min(speed, zero) < beyond * coefficients[k, C_THICKNESS]:
            chosen[number] = k
            number += 1
        else:
            impulses[k, 0] = impulses[k, 1] = impulses[k, 2] = zero
    return number


@kernel
def _add_up(w, particles, coefficients, impulses, chosen, choices, pressed):
    """What the impulses of a substep change each particle's velocity by [m/s], (3, particles)."""
    zero = pressed.dtype.type(0)
    pressed[:] = zero
    for c in range(choices):
        k = chosen[c]
        jx, jy, jz = impulses[k, 0], impulses[k, 1], impulses[k, 2]
        if jx != zero or jy != zero or jz != zero:
            for m in range(4):
                p = particles[k, m]
                share = w[p] * coefficients[k, m]
                pressed[0, p] += share * jx
                pressed[1, p] += share * jy
                pressed[2, p] += share * jz


@kernel
def _correct(x, v, w, particles, coefficients, impulses, chosen, choices, carried, friction, push, h, waited):
    """Correct the impulses of the last ``waited`` substeps, normal and tangential, and push apart.

    Returns how many contacts acted, and the most that the velocity along one's normal had to be corrected by [m/s].
    """
    zero, one = x.dtype.type(0), x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    sunk, relaxed = x.dtype.type(1 - SLOP), x.dtype.type(RELAXED)
    since, most_speed = x.dtype.type(waited), x.dtype.type(FASTEST)
    reach = x.dtype.type(SPAN) * h + carried
    touching, largest = 0, zero
    for c in range(choices):
        k = chosen[c]
        nx, ny, nz, thickness = (
            coefficients[k, C_NORMAL],
            coefficients[k, C_NORMAL + 1],
            coefficients[k, C_NORMAL + 2],
            coefficients[k, C_THICKNESS],
        )
        jx, jy, jz = since * impulses[k, 0], since * impulses[k, 1], since * impulses[k, 2]
        before = nx * jx + ny * jy + nz * jz
        gap, _, _, _ = _along(x, particles, coefficients, k, nx, ny, nz)
        un, ux, uy, uz = _along(v, particles, coefficients, k, nx, ny, nz)
        # the velocity of approach that closes the gap by the end of the longest span, and no sooner; what has been carried on is
        # taken back
        wanted = -max(gap - carried * un - sunk * thickness, zero) / reach
        if before == zero and un >= wanted and gap >= sunk * thickness:
            continue
        mobile = zero
        for m in range(4):
            mobile += w[particles[k, m]] * coefficients[k, m] * coefficients[k, m]
        if mobile <= zero:
            continue
        mass = one / mobile
        now = min(max(before + (wanted - un) * mass, zero), since * most_speed * mass)
        # what would stop the sliding, and as much of it as Coulomb allows
        tx = jx - before * nx - (ux - un * nx) * mass
        ty = jy - before * ny - (uy - un * ny) * mass
        tz = jz - before * nz - (uz - un * nz) * mass
        most = friction * now
        share = min(most / (np.sqrt(tx * tx + ty * ty + tz * tz) + tiny), one)
        px, py, pz = now * nx + share * tx, now * ny + share * ty, now * nz + share * tz
        impulses[k, 0], impulses[k, 1], impulses[k, 2] = px / since, py / since, pz / since
        largest = max(largest, abs(now - before) * mobile)
        # only what the impulse has not mended already is pushed
        lack = sunk * thickness - (gap + carried * (now - before) * mobile)
        out = since * min(relaxed * max(lack, zero), push) * mass
        _push(x, v, w, particles, coefficients, k, px - jx, py - jy, pz - jz, carried, out * nx, out * ny, out * nz)
        touching += 1
    return touching, largest

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
from clothgym.collisions.proximity import NORMAL, SLOP, THICKNESS, TOUCHING

RELAXED = 0.03  # share of what is too close by which a contact pushes apart in a substep: its neighbours push the same vertices
SPAN = 4  # substeps between two sweeps over contacts that are calm; over others a sweep goes in each
CALM = 0.005  # thicknesses by which a calm contact's correction moves it in the longest span, at most
CHOSEN_EVERY = 8  # substeps after which contacts are chosen anew that may act soon
# velocity of approach that a contact takes in a substep, at most [m/s]: in a jam, which takes all motion away, what is kept from
# substep to substep would grow for ever
MOST = 10.0
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
    memory, setting = sheet.memory, sheet.setting
    particles_count = x.shape[1]
    place, motion = np.empty((particles_count, 3), x.dtype), np.empty((particles_count, 3), x.dtype)
    mobility = np.empty(particles_count, x.dtype)
    for l in range(memory.used[block]):
        count = memory.contacts[block, l]
        if count == 0:
            continue
        memory.waited[block, l] += 1
        memory.aged[block, l] += 1
        waited = memory.waited[block, l]
        if waited < memory.span[block, l]:
            continue
        particles, figures = memory.particles[block, l], memory.figures[block, l]
        impulses, chosen, pressing = memory.impulses[block, l], memory.chosen[block, l], memory.pressing[block, l]
        pressed = memory.pressed[block, :, :, l]
        if memory.aged[block, l] >= CHOSEN_EVERY or memory.choices[block, l] < 0:
            memory.choices[block, l] = _choose(x[:, :, l].T, v[:, :, l].T, particles, figures, impulses, chosen, count, h)
            memory.pressers[block, l] = _list_particles(particles, chosen, memory.choices[block, l], pressing, x.shape[1])
            memory.aged[block, l] = 0
            pressed[:] = 0
        choices, pressing = memory.choices[block, l], pressing[: memory.pressers[block, l]]
        _take(x, v, w, l, pressing, place, motion, mobility)
        touching, most = _correct(
            place, motion, mobility, particles, figures, impulses, chosen, choices, carried, setting.friction, setting.push * h, h,
            waited,
        )  # fmt: skip
        _put_back(x, v, l, pressing, place, motion)
        _add_up(mobility, particles, figures, impulses, chosen, choices, pressing, motion)
        for m in range(pressing.shape[0]):
            p = pressing[m]
            for c in range(3):
                pressed[c, p] = motion[p, c]
        memory.report[block, l, TOUCHING] = touching
        memory.waited[block, l] = 0
        memory.span[block, l] = min(2 * waited, SPAN) if most * x.dtype.type(SPAN) * h < setting.calm else 1


@kernel
def _list_particles(particles, chosen, choices, pressing, number):
    """List the particles of the chosen contacts, in their order; returns how many."""
    some = np.zeros(number, np.bool_)
    for c in range(choices):
        for m in range(4):
            some[particles[chosen[c], m]] = True
    count = 0
    for p in range(number):
        if some[p]:
            pressing[count] = p
            count += 1
    return count


@kernel
def _take(x, v, w, l, pressing, place, motion, mobility):
    """Copy the particles of one lane that contacts press to where they lie side by side: contacts read each of them many times."""
    for m in range(pressing.shape[0]):
        p = pressing[m]
        mobility[p] = w[p, l]
        for c in range(3):
            place[p, c] = x[c, p, l]
            motion[p, c] = v[c, p, l]


@kernel
def _put_back(x, v, l, pressing, place, motion):
    """And back."""
    for m in range(pressing.shape[0]):
        p = pressing[m]
        for c in range(3):
            x[c, p, l] = place[p, c]
            v[c, p, l] = motion[p, c]


@inlined
def _along(a, particles, figures, k, nx, ny, nz):
    """n.(sum of weights times positions or velocities) of contact k."""
    i, j, m, n = particles[k, 0], particles[k, 1], particles[k, 2], particles[k, 3]
    wi, wj, wm, wn = figures[k, 0], figures[k, 1], figures[k, 2], figures[k, 3]
    ax = wi * a[i, 0] + wj * a[j, 0] + wm * a[m, 0] + wn * a[n, 0]
    ay = wi * a[i, 1] + wj * a[j, 1] + wm * a[m, 1] + wn * a[n, 1]
    az = wi * a[i, 2] + wj * a[j, 2] + wm * a[m, 2] + wn * a[n, 2]
    return nx * ax + ny * ay + nz * az, ax, ay, az


@inlined
def _push(x, v, w, particles, figures, k, jx, jy, jz, carried, qx, qy, qz):
    """Add an impulse j [N s] to contact k's velocities, what of it has been carried on to its positions, and a push q to these."""
    for c in range(4):
        p = particles[k, c]
        share = w[p] * figures[k, c]
        v[p, 0] += share * jx
        v[p, 1] += share * jy
        v[p, 2] += share * jz
        x[p, 0] += share * (carried * jx + qx)
        x[p, 1] += share * (carried * jy + qy)
        x[p, 2] += share * (carried * jz + qz)


@kernel
def _choose(x, v, particles, figures, impulses, chosen, count, h):
    """List the contacts that may act soon; returns how many.  The others lose their impulses."""
    zero = x.dtype.type(0)
    ahead = x.dtype.type(CHOSEN_EVERY) * h
    beyond = x.dtype.type(1 + SOON)
    number = 0
    for k in range(count):
        nx, ny, nz = figures[k, NORMAL], figures[k, NORMAL + 1], figures[k, NORMAL + 2]
        gap, _, _, _ = _along(x, particles, figures, k, nx, ny, nz)
        speed, _, _, _ = _along(v, particles, figures, k, nx, ny, nz)
        if gap + ahead * min(speed, zero) < beyond * figures[k, THICKNESS]:
            chosen[number] = k
            number += 1
        else:
            impulses[k, 0] = impulses[k, 1] = impulses[k, 2] = zero
    return number


@kernel
def _add_up(w, particles, figures, impulses, chosen, choices, pressing, pressed):
    """What the impulses of a substep change each particle's velocity by [m/s], (particles, 3)."""
    zero = pressed.dtype.type(0)
    for m in range(pressing.shape[0]):
        pressed[pressing[m]] = zero
    for c in range(choices):
        k = chosen[c]
        jx, jy, jz = impulses[k, 0], impulses[k, 1], impulses[k, 2]
        if jx != zero or jy != zero or jz != zero:
            for m in range(4):
                p = particles[k, m]
                share = w[p] * figures[k, m]
                pressed[p, 0] += share * jx
                pressed[p, 1] += share * jy
                pressed[p, 2] += share * jz


@kernel
def _correct(x, v, w, particles, figures, impulses, chosen, choices, carried, friction, push, h, waited):
    """Correct the impulses of the last ``waited`` substeps, normal and tangential, and push apart.

    Returns how many contacts acted, and the most that the velocity along one's normal had to be corrected by [m/s].
    """
    zero, one = x.dtype.type(0), x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    sunk, relaxed = x.dtype.type(1 - SLOP), x.dtype.type(RELAXED)
    since, most_speed = x.dtype.type(waited), x.dtype.type(MOST)
    reach = x.dtype.type(SPAN) * h + carried
    touching, largest = 0, zero
    for c in range(choices):
        k = chosen[c]
        nx, ny, nz, thickness = figures[k, NORMAL], figures[k, NORMAL + 1], figures[k, NORMAL + 2], figures[k, THICKNESS]
        jx, jy, jz = since * impulses[k, 0], since * impulses[k, 1], since * impulses[k, 2]
        before = nx * jx + ny * jy + nz * jz
        gap, _, _, _ = _along(x, particles, figures, k, nx, ny, nz)
        un, ux, uy, uz = _along(v, particles, figures, k, nx, ny, nz)
        # the velocity of approach that closes the gap by the end of the longest span, and no sooner; what has been carried on is
        # taken back
        wanted = -max(gap - carried * un - sunk * thickness, zero) / reach
        if before == zero and un >= wanted and gap >= sunk * thickness:
            continue
        mobile = zero
        for m in range(4):
            mobile += w[particles[k, m]] * figures[k, m] * figures[k, m]
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
        _push(x, v, w, particles, figures, k, px - jx, py - jy, pz - jz, carried, out * nx, out * ny, out * nz)
        touching += 1
    return touching, largest

"""Contacts of a sheet with itself: impulses between what is closer than the thickness of the cloth.

Projected Gauss-Seidel on the velocities, one sweep a substep, with a warm start: an impulse is kept from substep to substep,
pressed on again before anything else, and corrected.  The normal part leaves as much velocity of approach as closes the gap to the
thickness, not more, and never pulls; it does not switch on and off where the gap is the thickness.  The
tangential part is what stops the sliding, as far as Coulomb's law allows.  So stacks come to rest, and friction between layers
holds.  What is too close is pushed apart at a bounded speed, by its position alone, so that no kinetic energy comes of it.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel
from clothgym.collisions.proximity import NORMAL, THICKNESS, TOUCHING

SLOP = 0.01  # share of the thickness that contacts may sink in: at rest they touch, and their impulses last
RELAXED = 0.03  # share of what is too close by which a contact pushes apart in a substep: its neighbours push the same vertices
CHOSEN_EVERY = 8  # substeps after which contacts are chosen anew that may act soon
SOON = 0.05  # thicknesses beyond the thickness within which a contact may act soon


@kernel
def press_again(x, v, w, sheet, block, step, h, carried):
    """The impulses of the substep before, on one block's sheets; before the solids, so that these bear what lies on them."""
    memory = sheet.memory
    place, motion, mobility = np.empty(x.shape[:2], x.dtype), np.empty(x.shape[:2], x.dtype), np.empty(x.shape[0], x.dtype)
    for l in range(memory.used[block]):
        count = memory.contacts[block, l]
        if count == 0:
            continue
        particles, figures = memory.particles[block, l], memory.figures[block, l]
        impulses, chosen = memory.impulses[block, l], memory.chosen[block, l]
        _take(x, v, w, l, place, motion, mobility)
        if step % CHOSEN_EVERY == 0 or memory.choices[block, l] < 0:
            memory.choices[block, l] = _choose(place, motion, particles, figures, impulses, chosen, count, h)
        _apply_again(place, motion, mobility, particles, figures, impulses, chosen, memory.choices[block, l], carried)
        _put_back(x, v, l, place, motion)


@kernel
def repel(x, v, w, sheet, block, h, carried):
    """Contacts of one block's sheets with themselves."""
    memory, setting = sheet.memory, sheet.setting
    place, motion, mobility = np.empty(x.shape[:2], x.dtype), np.empty(x.shape[:2], x.dtype), np.empty(x.shape[0], x.dtype)
    for l in range(memory.used[block]):
        if memory.contacts[block, l] > 0:
            _take(x, v, w, l, place, motion, mobility)
            memory.report[block, l, TOUCHING] = _correct(
                place, motion, mobility, memory.particles[block, l], memory.figures[block, l], memory.impulses[block, l],
                memory.chosen[block, l], memory.choices[block, l], carried, setting.friction, setting.push * h, h,
            )  # fmt: skip
            _put_back(x, v, l, place, motion)


@kernel
def _take(x, v, w, l, place, motion, mobility):
    """Copy one lane to where its particles lie side by side: contacts read each of them many times."""
    for p in range(x.shape[0]):
        mobility[p] = w[p, l]
        for c in range(3):
            place[p, c] = x[p, c, l]
            motion[p, c] = v[p, c, l]


@kernel
def _put_back(x, v, l, place, motion):
    """And back."""
    for p in range(x.shape[0]):
        for c in range(3):
            x[p, c, l] = place[p, c]
            v[p, c, l] = motion[p, c]


@kernel
def _along(a, particles, figures, k, nx, ny, nz):
    """n.(sum of weights times positions or velocities) of contact k."""
    i, j, m, n = particles[k, 0], particles[k, 1], particles[k, 2], particles[k, 3]
    wi, wj, wm, wn = figures[k, 0], figures[k, 1], figures[k, 2], figures[k, 3]
    ax = wi * a[i, 0] + wj * a[j, 0] + wm * a[m, 0] + wn * a[n, 0]
    ay = wi * a[i, 1] + wj * a[j, 1] + wm * a[m, 1] + wn * a[n, 1]
    az = wi * a[i, 2] + wj * a[j, 2] + wm * a[m, 2] + wn * a[n, 2]
    return nx * ax + ny * ay + nz * az, ax, ay, az


@kernel
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
def _apply_again(x, v, w, particles, figures, impulses, chosen, choices, carried):
    """The impulses of the substep before."""
    zero = x.dtype.type(0)
    for c in range(choices):
        k = chosen[c]
        jx, jy, jz = impulses[k, 0], impulses[k, 1], impulses[k, 2]
        if jx != zero or jy != zero or jz != zero:
            _push(x, v, w, particles, figures, k, jx, jy, jz, carried, zero, zero, zero)


@kernel
def _correct(x, v, w, particles, figures, impulses, chosen, choices, carried, friction, push, h):
    """Correct the impulses, normal and tangential, and push apart; returns how many contacts acted."""
    zero, one = x.dtype.type(0), x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    sunk, relaxed = x.dtype.type(1 - SLOP), x.dtype.type(RELAXED)
    touching = 0
    for c in range(choices):
        k = chosen[c]
        nx, ny, nz, thickness = figures[k, NORMAL], figures[k, NORMAL + 1], figures[k, NORMAL + 2], figures[k, THICKNESS]
        jx, jy, jz = impulses[k, 0], impulses[k, 1], impulses[k, 2]
        before = nx * jx + ny * jy + nz * jz
        gap, _, _, _ = _along(x, particles, figures, k, nx, ny, nz)
        un, ux, uy, uz = _along(v, particles, figures, k, nx, ny, nz)
        # the velocity of approach that closes the gap by the next substep's end, and no sooner; what has been carried on is taken
        # back
        wanted = -max(gap - carried * un - sunk * thickness, zero) / (h + carried)
        if before == zero and un >= wanted and gap >= sunk * thickness:
            continue
        mobile = zero
        for m in range(4):
            mobile += w[particles[k, m]] * figures[k, m] * figures[k, m]
        if mobile <= zero:
            continue
        mass = one / mobile
        now = max(before + (wanted - un) * mass, zero)
        # what would stop the sliding, and as much of it as Coulomb allows
        tx = jx - before * nx - (ux - un * nx) * mass
        ty = jy - before * ny - (uy - un * ny) * mass
        tz = jz - before * nz - (uz - un * nz) * mass
        most = friction * now
        share = min(most / (np.sqrt(tx * tx + ty * ty + tz * tz) + tiny), one)
        px, py, pz = now * nx + share * tx, now * ny + share * ty, now * nz + share * tz
        impulses[k, 0], impulses[k, 1], impulses[k, 2] = px, py, pz
        # only what the impulse has not mended already is pushed
        lack = sunk * thickness - (gap + carried * (now - before) * mobile)
        out = min(relaxed * max(lack, zero), push) * mass
        _push(x, v, w, particles, figures, k, px - jx, py - jy, pz - jz, carried, out * nx, out * ny, out * nz)
        touching += 1
    return touching

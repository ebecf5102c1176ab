"""Impulses between parts of one sheet that are closer than the cloth's thickness.

Projected Gauss-Seidel on the velocities with a warm start.  A contact keeps its impulse from substep to substep: it is applied
again before anything else, and corrected by a sweep over the contacts, in every substep, or every few where the last correction was
small.  Between sweeps the impulses of all contacts are added up into one change of velocity for each particle.

A contact joins four vertices with weights c_i, those of the first primitive minus those of the second, and a unit normal n.  Its
gap and relative velocity are g = n . sum c_i x_i and u = sum c_i v_i; its effective mass is m = 1 / sum w_i c_i^2, with the inverse
masses w_i.

* Normal: j_n <- max(j_n + m (u* - u_n), 0), where the target u* <= 0 closes the gap to the thickness and no more.  It never pulls,
  and does not switch on and off where the gap equals the thickness.
* Tangential: j_t <- j_t - m u_t, which stops the sliding, shortened to |j_t| <= mu j_n (Coulomb).

So stacks come to rest, and friction between layers holds.  What is too close is pushed apart by positions alone, at a bounded
speed, so that no kinetic energy comes of it.  Springs that resist the push would make some again, so only what can give way is
pushed (see ``narrow_phase.edge_contacts``).
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, disjoint, inlined, kernel, merged, placeholder, uncounted
from clothgym.collisions.self.narrow_phase import SLOP
from clothgym.contact_memory import C_NORMAL, C_THICKNESS, REPORT_TOUCHING

RELAXED = 0.03  # share of the missing gap that a contact restores in a substep: its neighbors push the same vertices
SPAN = 4  # substeps between two sweeps over contacts that have converged; others are swept over in every substep
TOLERANCE = 0.005  # thicknesses by which the correction of a converged contact moves it in the longest span, at most
CHOSEN_EVERY = 8  # substeps after which the active contacts, those that may act soon, are chosen again
# largest velocity of approach that a contact removes in a substep [m/s]: in a jam, where bounds stop all motion, impulses would
# otherwise grow from substep to substep without end
FASTEST = 10.0
SOON = 0.05  # thicknesses beyond the thickness up to which a contact may act soon


sweep = placeholder("sweep", "of (x, v, w, sheet, block, l, h, lead): one sweep over the contacts of lane l, for a layout")


@uncounted
def apply_kept_impulses(x, v, w, pressed, lead):
    """Apply the impulses of the last sweep to one block's sheets, v_i += w_i sum_k c_i j_k, before the solids, which so carry what
    lies on them.

    x, v: [m], [m/s], (3, particles, lanes).  w: inverse masses [1/kg], (particles, lanes).  pressed: the changes of velocities
    [m/s], (3, particles, lanes).  lead: time for which a new velocity has already moved the positions [s].  Where no impulse
    acts, no bit changes.
    """
    # adding -0 changes no bit; selecting x and v instead would keep the loop from being vectorized
    negative_zero = -x.dtype.type(0)
    for c in range(3):
        _apply_impulses(merged(x[c]), merged(v[c]), merged(w), merged(pressed[c]), lead, negative_zero)


@disjoint
def _apply_impulses(x, v, w, pressed, lead, negative_zero):
    """Add one component of the impulses: v += change, x += lead change; each array (particles times lanes,)."""
    zero = x.dtype.type(0)
    for e in range(x.shape[0]):
        change = pressed[e] if (w[e] > zero) & (pressed[e] != zero) else negative_zero
        x[e] += lead * change
        v[e] += change


def solve_impulses(x, v, w, sheet, block, h, lead):
    """Correct the impulses of one block's sheets, in each lane in which a sweep is due.

    x, v, w, lead: as in ``apply_kept_impulses``.  h: the substep [s].
    """
    memory = sheet.memory
    for l in range(memory.used[block]):
        # lanes without contacts, and those whose contacts have converged, wait
        if memory.contacts[block, l] > 0 and memory.waited[block, l] >= memory.span[block, l]:
            sweep(x, v, w, sheet, block, l, h, lead)


@uncounted
def sweep_sheet(x, v, w, sheet, block, l, h, lead):
    """One sweep over the contacts of a block that is one sheet."""
    _sweep_contacts(merged(x), merged(v), merged(w), sheet, block, l, h, lead)


@apart
def sweep_lane(x, v, w, sheet, block, l, h, lead):
    """The same on a copy of lane l: contacts read each particle many times, and the values of a lane lie far apart."""
    own_x, own_v, own_w = x[:, :, l].copy(), v[:, :, l].copy(), w[:, l].copy()
    _sweep_contacts(own_x, own_v, own_w, sheet, block, l, h, lead)
    x[:, :, l], v[:, :, l] = own_x, own_v


@uncounted
def _sweep_contacts(x, v, w, sheet, block, l, h, lead):
    """One sweep over the contacts of one lane; x, v: [m], [m/s], (3, particles), w: [1/kg], (particles,)."""
    memory, setting, count, waited = sheet.memory, sheet.setting, sheet.memory.contacts[block, l], sheet.memory.waited[block, l]
    particles, coefficients, impulses = memory.particles[block, l], memory.coefficients[block, l], memory.impulses[block, l]
    chosen = memory.chosen[block, l]
    # choose the active contacts
    if memory.aged[block, l] >= CHOSEN_EVERY or memory.choices[block, l] < 0:
        memory.choices[block, l] = _choose_active(x, v, particles, coefficients, impulses, chosen, count, h)
        memory.aged[block, l] = 0
    # correct their impulses, and add them up for the substeps until the next sweep
    choices = memory.choices[block, l]
    touching, largest = _correct(
        x, v, w, particles, coefficients, impulses, chosen, choices, lead, setting.friction, setting.push * h, h, waited
    )
    _add_up(w, particles, coefficients, impulses, chosen, choices, memory.pressed[block, :, :, l])
    # the span doubles while corrections are within tolerance
    memory.report[block, l, REPORT_TOUCHING] = touching
    memory.waited[block, l] = 0
    memory.span[block, l] = min(2 * waited, SPAN) if largest * x.dtype.type(SPAN) * h < setting.tolerance else 1


@inlined
def _relative(a, particles, coefficients, k, nx, ny, nz):
    """For contact k, with a positions or velocities: n . sum c_i a_i, and sum c_i a_i by component."""
    i, j, m, n = particles[k, 0], particles[k, 1], particles[k, 2], particles[k, 3]
    wi, wj, wm, wn = coefficients[k, 0], coefficients[k, 1], coefficients[k, 2], coefficients[k, 3]
    ax = wi * a[0, i] + wj * a[0, j] + wm * a[0, m] + wn * a[0, n]
    ay = wi * a[1, i] + wj * a[1, j] + wm * a[1, m] + wn * a[1, n]
    az = wi * a[2, i] + wj * a[2, j] + wm * a[2, m] + wn * a[2, n]
    return nx * ax + ny * ay + nz * az, ax, ay, az


@inlined
def _push(x, v, w, particles, coefficients, k, jx, jy, jz, lead, qx, qy, qz):
    """Apply an impulse j [N s] and a push q [kg m] to contact k's vertices: v_i += w_i c_i j and x_i += w_i c_i (lead j + q)."""
    for c in range(4):
        p = particles[k, c]
        share = w[p] * coefficients[k, c]
        v[0, p] += share * jx
        v[1, p] += share * jy
        v[2, p] += share * jz
        x[0, p] += share * (lead * jx + qx)
        x[1, p] += share * (lead * jy + qy)
        x[2, p] += share * (lead * jz + qz)


@kernel
def _choose_active(x, v, particles, coefficients, impulses, chosen, count, h):
    """List the contacts that may act soon, and clear the impulses of the others.  Returns how many are listed."""
    zero = x.dtype.type(0)
    ahead = x.dtype.type(CHOSEN_EVERY) * h
    beyond = x.dtype.type(1 + SOON)
    number = 0
    for k in range(count):
        nx, ny, nz = coefficients[k, C_NORMAL], coefficients[k, C_NORMAL + 1], coefficients[k, C_NORMAL + 2]
        gap, _, _, _ = _relative(x, particles, coefficients, k, nx, ny, nz)
        speed, _, _, _ = _relative(v, particles, coefficients, k, nx, ny, nz)
        # at its present velocity of approach it is within the thickness before the next choice
        if gap + ahead * min(speed, zero) < beyond * coefficients[k, C_THICKNESS]:
            chosen[number] = k
            number += 1
        else:
            impulses[k, 0] = impulses[k, 1] = impulses[k, 2] = zero
    return number


@kernel
def _add_up(w, particles, coefficients, impulses, chosen, choices, pressed):
    """Change of each particle's velocity by all impulses of a substep, w_i sum_k c_i j_k [m/s]: ``pressed``, (3, particles)."""
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
def _correct(x, v, w, particles, coefficients, impulses, chosen, choices, lead, friction, push, h, waited):
    """Correct the impulses of the last ``waited`` substeps, normal and tangential, and push apart.

    chosen: the active contacts, the first ``choices`` of them.  friction: coefficient.  push: largest push in a substep [m].
    Returns how many contacts acted, and the largest correction of a velocity along a normal [m/s].  See the module for the
    formulas.
    """
    zero, one = x.dtype.type(0), x.dtype.type(1)
    tiny = x.dtype.type(1e-12)
    sunk, relaxed = x.dtype.type(1 - SLOP), x.dtype.type(RELAXED)
    since, most_speed = x.dtype.type(waited), x.dtype.type(FASTEST)
    horizon = x.dtype.type(SPAN) * h + lead
    touching, largest = 0, zero
    for c in range(choices):
        k = chosen[c]
        # normal and thickness, the impulse of all substeps since the last sweep, gap and velocity
        nx, ny, nz, thickness = (
            coefficients[k, C_NORMAL],
            coefficients[k, C_NORMAL + 1],
            coefficients[k, C_NORMAL + 2],
            coefficients[k, C_THICKNESS],
        )
        jx, jy, jz = since * impulses[k, 0], since * impulses[k, 1], since * impulses[k, 2]
        jn_before = nx * jx + ny * jy + nz * jz
        gap, _, _, _ = _relative(x, particles, coefficients, k, nx, ny, nz)
        un, ux, uy, uz = _relative(v, particles, coefficients, k, nx, ny, nz)
        # u*: the velocity of approach that closes the gap at the end of the longest span, from the position without this velocity
        target = -max(gap - lead * un - sunk * thickness, zero) / horizon
        # inactive: no impulse, not approaching too fast, and apart
        if jn_before == zero and un >= target and gap >= sunk * thickness:
            continue
        # m = 1 / sum w_i c_i^2; a contact between attached particles cannot move
        inverse_mass = zero
        for m in range(4):
            inverse_mass += w[particles[k, m]] * coefficients[k, m] * coefficients[k, m]
        if inverse_mass <= zero:
            continue
        mass = one / inverse_mass
        # normal part: j_n <- j_n + m (u* - u_n), at least zero
        jn = min(max(jn_before + (target - un) * mass, zero), since * most_speed * mass)
        # tangential part: j_t <- j_t - m u_t, shortened to mu j_n
        tx = jx - jn_before * nx - (ux - un * nx) * mass
        ty = jy - jn_before * ny - (uy - un * ny) * mass
        tz = jz - jn_before * nz - (uz - un * nz) * mass
        most_friction = friction * jn
        share = min(most_friction / (np.sqrt(tx * tx + ty * ty + tz * tz) + tiny), one)
        px, py, pz = jn * nx + share * tx, jn * ny + share * ty, jn * nz + share * tz
        # the impulse is kept per substep
        impulses[k, 0], impulses[k, 1], impulses[k, 2] = px / since, py / since, pz / since
        largest = max(largest, abs(jn - jn_before) * inverse_mass)
        # push apart by what is still missing after the impulse has moved the positions
        missing = sunk * thickness - (gap + lead * (jn - jn_before) * inverse_mass)
        shift = since * min(relaxed * max(missing, zero), push) * mass
        _push(x, v, w, particles, coefficients, k, px - jx, py - jy, pz - jz, lead, shift * nx, shift * ny, shift * nz)
        touching += 1
    return touching, largest

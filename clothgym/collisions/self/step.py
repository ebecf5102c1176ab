"""Self-collision: the work of one substep, and the guarantee of strict mode.

After each substep of any integrator, none of which it knows by name:

1. ``apply_kept_impulses``: each contact applies its impulse of the previous substep.  The solids follow, and so carry the cloth
   that lies on them.
2. ``solve_impulses``: the impulses are corrected.  Parts closer than the cloth's thickness no longer approach, slide only as far as
   Coulomb friction allows, and are pushed apart (see ``impulses``).
3. ``clamp_displacements``: a vertex that has left its bound (see ``narrow_phase``) causes a query at the last certified positions,
   which are known to be free of intersections.  In strict mode vertices beyond their new bounds are clamped to them, and gap
   constraints are enforced (see ``displacement_bounds``).

The guarantee of strict mode: if a sheet starts without intersections, then in every substep each vertex and triangle, and each two
edges, that share no vertex stay at a positive distance all along their paths, so none passes through another.  It holds for
attached particles, too: an attachment that would pull cloth through cloth is slowed, and its particles lag behind.  Not
guaranteed: a least thickness, the untangling of a sheet that starts with intersections, and that solids which squeeze cloth stay
outside it.  Mode "fast" does the same without clamping, and guarantees nothing.

Each lane, that is each environment of a block, is handled on its own: lanes share only the mesh.  A lane without contacts pays
only for the test of its bounds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel, merged, placeholder, specialize, uncounted
from clothgym.collisions.self.broad_phase import Reach
from clothgym.collisions.self.displacement_bounds import (
    catch_up,
    clamp_displacements,
    find_outside_in_lanes,
    find_outside_of_sheet,
    keep,
    note_uncertain,
)
from clothgym.collisions.self.impulses import apply_kept_impulses, solve_impulses, sweep_lane, sweep_sheet
from clothgym.collisions.self.query_scratch import scratch_for_queries
from clothgym.collisions.self.topology import Pairs
from clothgym.contact_memory import REPORT_CONTACTS, REPORT_GAP, REPORT_LAG

# of a layout
correct = placeholder("correct", "``impulses.solve_impulses``")
find_outside = placeholder(
    "find_outside", "of (x, start, bounds, limits, samples, outside, any_outside, query_due): whether a vertex has"
)

PUSH = 0.5  # largest speed at which parts that are too close are pushed apart [m/s]


class Memory(NamedTuple):
    """What contact remembers, in blocks.  All of it is part of the state, or follows from it.

    start: positions at the last query [m]; old: the last certified positions [m], both (blocks, 3, particles, lanes).
    bounds, limits: squares of how far each vertex may move from ``start`` before its gap constraints must be evaluated, and before
    a query is due [m^2], -1 where one is due, (blocks, particles, lanes).
    lag: from each attached particle to where its attachment would have it [m], (blocks, 3, particles, lanes); behind: the largest,
    (blocks, lanes).
    contacts: how many, (blocks, lanes); particles, coefficients: see ``contact_memory``, (blocks, lanes, room, 4), (..., C_SIZE).
    impulses: of each contact per substep [N s], (..., 3); pressed: the change of each particle's velocity by these [m/s], (blocks,
    3, particles, lanes).
    waited: substeps since the last sweep over the contacts; span: substeps between two sweeps; aged: substeps since the active
    contacts were chosen, (blocks, lanes).
    chosen: the active contacts, (blocks, lanes, room), of which there are ``choices``, (blocks, lanes).
    constraints: how many gap constraints; members, planes: see ``contact_memory``, (blocks, lanes, room, G_SIZE) and (..., 4);
    looks: evaluations of gap constraints since the last query, (blocks, lanes).
    outside: scratch, which vertices are outside their bounds, (blocks, particles, lanes); any_outside, query_due: whether one is,
    and whether a query is due, (blocks, lanes); active: the active gap constraints, (blocks, lanes, room).
    used: lanes that are not padding, (blocks,).  report: see ``contact_memory``, (blocks, lanes, REPORT_SIZE).
    """

    start: NDArray
    bounds: NDArray
    limits: NDArray
    old: NDArray
    lag: NDArray
    behind: NDArray
    contacts: NDArray
    particles: NDArray
    coefficients: NDArray
    impulses: NDArray
    pressed: NDArray
    waited: NDArray
    span: NDArray
    aged: NDArray
    constraints: NDArray
    members: NDArray
    planes: NDArray
    looks: NDArray
    outside: NDArray
    any_outside: NDArray
    query_due: NDArray
    active: NDArray
    chosen: NDArray
    choices: NDArray
    used: NDArray
    report: NDArray


class Setting(NamedTuple):
    """Options as kernels see them, in the simulation's dtype.

    strict: whether bounds are enforced.  single: whether positions are float32.  friction: coefficient.  push: speed at which what
    is too close is pushed apart [m/s].  tolerance: how far the correction of a converged contact may move it [m].
    """

    strict: bool
    single: bool
    friction: Any
    push: Any
    tolerance: Any


class Sheet(NamedTuple):
    """What the kernels need: the mesh's pairs, the distances of a query, the options, the memory, and the solids, a
    ``solids.owner.Solid``."""

    pairs: Pairs
    reach: Reach
    setting: Setting
    memory: Memory
    solid: Any


@inlined
def warm_start(x, v, w, sheet, block, step, lead):
    """Stage 1, before the solids: the contacts of one block apply their impulses of the previous substep.

    x, v: [m], [m/s], (3, particles, lanes).  w: inverse masses [1/kg], (particles, lanes).  step: of the control step.  lead:
    time for which a new velocity has already moved the positions at the end of a substep [s].

    Like ``solve_self_contact`` it is inlined into the main loop: passing all arrays of ``sheet`` to a kernel takes about 0.1 us, so
    a kernel is called only when it has work to do.
    """
    if step == 0:
        _begin(x, sheet, block)
    if _any_contact(sheet.memory.contacts, sheet.memory.used, block):
        apply_kept_impulses(x, v, w, sheet.memory.pressed[block], lead)


@uncounted
def _begin(x, sheet, block):
    """Each control step has its own report; contacts and lags from before go on."""
    memory = sheet.memory
    memory.choices[block] = -1
    for l in range(memory.used[block]):
        report = memory.report[block, l]
        report[:] = 0
        report[REPORT_GAP] = np.inf
        report[REPORT_CONTACTS] = memory.contacts[block, l]
        report[REPORT_LAG] = memory.behind[block, l]
    # float32 certifies distances only near the origin
    if sheet.setting.single:
        note_uncertain(x, memory.report[block], memory.used[block])


def solve_self_contact(x, v, w, sheet, scratch, block, h, lead):
    """Stages 2 and 3, after the solids: impulses, then bounds.  scratch: see ``query_scratch``.  The rest as in ``warm_start``."""
    memory = sheet.memory
    if _any_sweep_due(memory.contacts, memory.waited, memory.span, memory.aged, memory.used, block):
        correct(x, v, w, sheet, block, h, lead)
    # particles that lag behind their attachments catch up
    for l in range(memory.used[block]):
        if memory.behind[block, l] > 0:
            memory.behind[block, l] = catch_up(x, w, memory.lag[block], l, h)
    if find_outside(
        x, memory.start[block], memory.bounds[block], memory.limits[block], sheet.pairs.samples, memory.outside[block],
        memory.any_outside[block], memory.query_due[block],
    ):  # fmt: skip
        clamp_displacements(x, v, w, sheet, scratch, block, h)
    # these positions are certified now
    keep(merged(merged(x)), merged(merged(memory.old[block])))


@inlined
def _any_contact(contacts, used, block):
    """Whether a block has contacts."""
    some = False
    for l in range(used[block]):
        some |= contacts[block, l] > 0
    return some


@inlined
def _any_sweep_due(contacts, waited, span, aged, used, block):
    """Whether a sweep is due in a lane with contacts, in each of which a substep has passed."""
    due = False
    for l in range(used[block]):
        if contacts[block, l] > 0:
            waited[block, l] += 1
            aged[block, l] += 1
            due |= waited[block, l] >= span[block, l]
    return due


@kernel
def warm_start_nothing(x, v, w, sheet, block, step, lead):
    """Stage 1 of a simulation without self-collision."""


@kernel
def solve_nothing(x, v, w, sheet, scratch, block, h, lead):
    """Stages 2 and 3 of a simulation without self-collision."""


@kernel
def scratch_for_nothing(x, sheet):
    """Scratch of a simulation without self-collision."""
    return (np.empty(0, x.dtype),)


@kernel
def scratch_for_sheet(x, sheet):
    """Scratch of ``solve_self_contact``, a ``query_scratch.QueryScratch``."""
    return scratch_for_queries(sheet.pairs, sheet.memory.impulses[0, 0])


def kernels_of(collides: bool, layout: str) -> dict[str, Any]:
    """What the main loop calls by these names, with self-collision or without, for a layout (see ``layout.Layout``)."""
    if not collides:
        return {
            "warm_start": warm_start_nothing,
            "solve_self_contact": solve_nothing,
            "scratch_for_self_contact": scratch_for_nothing,
        }
    by_particle = layout != "lanes"
    which = "particles" if by_particle else "lanes"
    parts = {
        "correct": specialize(uncounted(solve_impulses), f"repel_{which}", sweep=sweep_sheet if by_particle else sweep_lane),
        "find_outside": find_outside_of_sheet if by_particle else find_outside_in_lanes,
    }
    kept = specialize(solve_self_contact, f"solve_self_contact_{which}", inline=True, **parts)
    return {"warm_start": warm_start, "solve_self_contact": kept, "scratch_for_self_contact": scratch_for_sheet}

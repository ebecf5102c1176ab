"""Self-collision: a sheet that keeps its distance to itself, and in strict mode does not pass through itself.

After each substep of any integrator, whose name it does not know:

1. ``press_again``: contacts press as they did at the end of the substep before.  Then the solids have their say, which so bear
   what lies on them.
2. ``repel``: those impulses are corrected, so that what is closer than the cloth's thickness no longer approaches, and slides no
   more than friction allows; what is too close is pushed apart (see ``impulses``).
3. ``confine``: where a vertex has left its bound (see ``narrow_phase``), the query is made anew at the last positions that are
   certified to be free of intersections, and in strict mode vertices that are beyond even their new bounds are drawn back to
   them, and gap constraints are held (see ``displacement_bounds``).

So in strict mode: if a sheet starts without intersections, then in every substep every vertex and triangle, and every two edges,
without a common vertex are at a positive distance all the way, so none has passed through another.  That holds for what hands
hold, too: a hand that would pull cloth through cloth is slowed, and its particles lag.  Not promised are a least thickness, the
untangling of a sheet that starts tangled, and that solids which squeeze cloth stay outside it.  Mode "fast" is the same without the
drawing back, and promises nothing.

Contacts go lane by lane: they share nothing but the mesh.  A lane without contacts costs the test of its bounds alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, kernel
from clothgym.collisions.self.broad_phase import Reach
from clothgym.collisions.self.displacement_bounds import confine, note_uncertain
from clothgym.collisions.self.impulses import press_again, repel
from clothgym.collisions.self.topology import Pairs
from clothgym.contact_memory import REPORT_CONTACTS, REPORT_GAP, REPORT_LAG

PUSH = 0.5  # speed at which what is too close is pushed apart [m/s]


class Memory(NamedTuple):
    """What contact remembers, in blocks; all of it belongs to the state, or follows from it.

    start: positions at the last query [m]; bounds, limits: squares of how far each vertex may go from there before gap constraints
    are looked at, and before a query is due [m^2], or -1; old: the last certified positions [m]; lag: how far what is held is
    behind its hand [m]; behind: the largest, (blocks, lanes).
    contacts: how many, (blocks, lanes); particles, coefficients: see ``narrow_phase``, (blocks, lanes, room, 4) and (..., C_SIZE);
    impulses: theirs of a substep [N s], (..., 3); pressed: what these change velocities by [m/s].  waited: substeps since the
    contacts were swept over; span: after how many they are again; aged: since some were chosen, (blocks, lanes).  constraints: how
    many gap constraints, (blocks, lanes); members, planes: see ``narrow_phase``, (..., 11) and (..., 4); looks: at these since the
    last query.
    chosen: contacts that may act soon, ``choices`` of them.
    used: lanes that are no padding, (blocks,).  report: see ``narrow_phase``, (blocks, lanes, REPORT_SIZE).
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
    chosen: NDArray
    choices: NDArray
    used: NDArray
    report: NDArray


class Setting(NamedTuple):
    """Options as kernels see them: friction, push speed [m/s], and by how much contacts may move and count as converged [m] in
    their dtype."""

    strict: bool
    single: bool
    friction: Any
    push: Any
    tolerance: Any


class Sheet(NamedTuple):
    """All that the kernels need."""

    pairs: Pairs
    reach: Reach
    setting: Setting
    memory: Memory


@apart
def press(x, v, w, sheet, block, step, h, carried):
    """What happens to one block's sheets before the solids have their say; see the module."""
    memory = sheet.memory
    if step == 0:
        memory.choices[block] = -1
        for l in range(memory.used[block]):
            report = memory.report[block, l]
            report[:] = 0
            report[REPORT_GAP] = np.inf
            report[REPORT_CONTACTS] = memory.contacts[block, l]
            report[REPORT_LAG] = memory.behind[block, l]
        if sheet.setting.single:
            note_uncertain(x, memory.report[block], memory.used[block])
    press_again(x, v, w, sheet, block, carried)


@apart
def keep_apart(x, v, w, sheet, block, h, carried):
    """And what happens after; see the module."""
    repel(x, v, w, sheet, block, h, carried)
    confine(x, v, w, sheet, block, h)


@kernel
def press_nothing(x, v, w, sheet, block, step, h, carried):
    """Sheets that know nothing of themselves."""


@kernel
def keep_nothing_apart(x, v, w, sheet, block, h, carried):
    """And may go anywhere."""


# the names that the main loop calls, without self-collision and with it
KERNELS = {
    False: {"press": press_nothing, "keep_apart": keep_nothing_apart},
    True: {"press": press, "keep_apart": keep_apart},
}

"""Floor 5: the main loop, which is all that happens in a control step.

``advance`` takes blocks one after the other, each through all its substeps.  The kernels that it calls are the placeholders below,
bound when a simulation is made (``compiled``), by its integrator, bending model, layout, limiter and contact.  Its scratch, which
it cannot make itself (see ``_jit.uncounted``), is made by ``room_for_block``.
"""

from __future__ import annotations

from functools import cache
from threading import local
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import limiting
from clothgym._jit import placeholder, specialize, uncounted, used
from clothgym.bending import Bending
from clothgym.collisions.self.step import kernels_of as self_contact_kernels
from clothgym.collisions.solids.sheet_contact import kernels_of as contact_kernels
from clothgym.elements import Elastic
from clothgym.forces import add_air_forces
from clothgym.grid_forces import kernels_of
from clothgym.guards import mark_diverged
from clothgym.integrators.base import Work, room_for_work

# of the integrator, see ``integrators.base``
substep = placeholder("substep", "of an integrator: moves a block on by h [s] under springs, bending, gravity, drag and push")
# of ``limiting``
restrain = placeholder("restrain", "of (x, v, w, weave, limit, limited): pulls springs beyond the strain limit back to it")
remeasure = placeholder("remeasure", "of (x, weave, limited): writes the largest strain at the end of a control step")
# of ``collisions.self.step``
press = placeholder("press", "of (x, v, w, sheet, block, step, carried): applies the impulses of contacts with itself")
keep_apart = placeholder(
    "keep_apart", "of (x, v, w, sheet, room, block, h, carried): corrects them, and keeps vertices in their bounds"
)
room_for_self_contact = placeholder("room_for_self_contact", "of (x, sheet): makes the scratch of ``keep_apart``")
# of ``collisions.solids.sheet_contact``
resolve = placeholder(
    "resolve", "of (x, v, w, triangles, shapes, colliders, h, carried, look, room): moves solids on, and the sheet out of them"
)
room_for_contact = placeholder("room_for_contact", "of (x, triangles, shapes): makes the scratch of ``resolve``")


class Motion(NamedTuple):
    """Positions x [m] and velocities v [m/s], (blocks, 3, particles, lanes), and inverse masses w, zero where something is held
    [1/kg], (blocks, particles, lanes).

    remainders: what positions and velocities could not hold, see ``integrators.base``, (blocks, 2, 3, particles, lanes).
    """

    x: NDArray
    v: NDArray
    w: NDArray
    remainders: NDArray


class Schedule(NamedTuple):
    """What is done when in a control step, and with what.

    h: a substep [s].  carried: for how long velocities have moved the positions when contact changes them [s].
    substeps: of a control step.  air_every, look_every: substeps after which the air's force is computed again, 0 for no air, and
    after which solids are looked for between particles.
    options, plan, room: of the integrator: numbers, matrices that it has factorized, and the size of its scratch.
    limit: largest strain.
    """

    h: Any
    carried: Any
    substeps: int
    air_every: int
    look_every: int
    options: tuple[Any, ...]
    plan: tuple[NDArray, ...]
    room: tuple[int, int, int]
    limit: float


class Solid(NamedTuple):
    """Solids as kernels see them: what all environments share, and a block's rows, (blocks, colliders, COLLIDER_ROWS, lanes)."""

    shapes: Any
    rows: NDArray


class Outcome(NamedTuple):
    """Strain met and left in a control step, (blocks, 3, lanes), and whether an environment has diverged, (blocks, lanes)."""

    limited: NDArray
    diverged: NDArray


def room_for_block(x, offset, room, triangles, shapes, sheet):
    """Scratch of ``advance``, which its blocks share one after the other: the integrator's, the air's force [N], and those of
    contact with solids and of the sheet with itself.

    x: positions of a block.  offset: see ``elements.room_for_forces``.  room: see ``Integrator.room``.
    """
    solids, itself = room_for_contact(x, triangles, shapes), room_for_self_contact(x, sheet)
    return room_for_work(x, offset, room), np.zeros(x.shape, x.dtype), solids, itself


def advance(first, last, motion, weave, fabric, solids, sheet, schedule, outcome, room):
    """One control step of blocks ``first`` to ``last``: a block does all its substeps before the next, and stays in cache."""
    h, carried, substeps, air_every, look_every, options, plan, _, limit = schedule
    (fields, of_springs, of_bends, scratch), push, touches, near = room
    shapes = solids.shapes
    for b in range(first, last):
        x, v, w, colliders, limited = motion.x[b], motion.v[b], motion.w[b], solids.rows[b], outcome.limited[b]
        work = Work(fields, of_springs, of_bends, scratch, motion.remainders[b])
        elastic = Elastic(fabric.stiffness[b], fabric.rigidity[b], fabric.damping_time[b])
        drag_rate, resistance, gravity, wind = fabric.drag_rate[b], fabric.resistance[b], fabric.gravity[b], fabric.wind[b]
        push[:] = 0
        limited[:] = 0
        for step in range(substeps):
            # the air's force is slow beside the springs': until it is computed again it is a constant push
            if air_every > 0 and step % air_every == 0:
                push[:] = 0
                add_air_forces(x, v, push, weave.air, resistance, wind, x.dtype.type(air_every) * h, work.scratch)
            # the integrator: springs, bending, gravity, drag and that push move the particles on
            substep(x, v, w, weave.elements, elastic, drag_rate, gravity, push, h, options, plan, work)
            # springs that are stretched beyond the limit are pulled back to it
            restrain(x, v, w, weave, limit, limited)
            # contacts of the sheet with itself press as before, so that solids bear what lies on them
            press(x, v, w, sheet, b, step, carried)
            # solids move on, and push out what is in them
            resolve(x, v, w, weave.triangles, shapes, colliders, h, carried, step, look_every, touches)
            # the contacts' impulses are corrected, and no vertex leaves its displacement bound
            keep_apart(x, v, w, sheet, near, b, h, carried)
        remeasure(x, weave, limited)
        mark_diverged(x, v, outcome.diverged[b])


class MainLoop:
    """``advance`` of one simulation, with the scratch of each of its threads."""

    def __init__(self, kernel: Any, make_room: Any) -> None:
        self.kernel, self.make_room = kernel, make_room
        # each thread has one, as long as it lives
        self.rooms = local()

    def __call__(
        self, first: int, last: int, motion: Motion, weave: Any, fabric: Any, solids: Solid, sheet: Any, schedule: Schedule,
        outcome: Outcome,
    ) -> None:  # fmt: skip
        """One control step of blocks ``first`` to ``last``."""
        if not hasattr(self.rooms, "own"):
            self.rooms.own = self.make_room(motion.x[first], weave.offset, schedule.room, weave.triangles, solids.shapes, sheet)
        self.kernel(first, last, motion, weave, fabric, solids, sheet, schedule, outcome, self.rooms.own)


@cache
def compiled(
    substep: Any, name: str, model: Bending, by_particle: bool, limits: bool, collides: bool, contact: str
) -> tuple[Any, Any]:
    """``advance`` around an integrator's substep: with the forces of a bending model and a layout, with a limiter or none, with
    contact of the sheet with itself or none, and with contact with solids (see ``sheet_contact.needed``); and its
    ``room_for_block``."""
    forces, layout = kernels_of(model, by_particle), "particles" if by_particle else "lanes"
    touching, itself = contact_kernels(contact, by_particle), self_contact_kernels(collides, by_particle)
    parts = limiting.kernels_of(limits, by_particle) | used(advance, forces | touching | itself)
    parts["substep"] = specialize(substep, f"{name}_{model.name}_{layout}", apart=True, **used(substep, forces))
    which = f"{name}_{model.name}_{layout}_{limits}_{collides}_{contact}"
    room = specialize(room_for_block, f"room_for_block_{layout}", **used(room_for_block, touching | itself))
    return specialize(uncounted(advance), f"advance_{which}", apart=True, **parts), room

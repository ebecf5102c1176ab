"""Floor 5: the main loop, which is all that happens in a control step.

``advance`` takes blocks one after the other, and ``advance_block`` takes one through all its substeps.  The kernels that they call
are the placeholders below, bound when a simulation is made (``compiled``), by its integrator, bending model, layout, limiter and
contact.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import limiting
from clothgym._jit import placeholder, specialize, uncounted, used
from clothgym.bending import Bending
from clothgym.collisions.self.step import KERNELS as SELF_CONTACT
from clothgym.collisions.solids.particle_contact import kernels_of as contact_kernels
from clothgym.elements import Elastic
from clothgym.forces import add_air_forces
from clothgym.grid_forces import kernels_of
from clothgym.guards import mark_diverged
from clothgym.integrators.base import room_for_work

# of the integrator, see ``integrators.base``
substep = placeholder("substep", "of an integrator: moves a block on by h [s] under springs, bending, gravity, drag and push")
# of ``limiting``
restrain = placeholder("restrain", "of (x, v, w, weave, limit, limited): pulls springs beyond the strain limit back to it")
remeasure = placeholder("remeasure", "of (x, weave, limited): writes the largest strain at the end of a control step")
# of ``collisions.self.step``
press = placeholder("press", "of (x, v, w, sheet, block, step, h, carried): applies the impulses of contacts with itself")
keep_apart = placeholder("keep_apart", "of (x, v, w, sheet, block, h, carried): corrects them, and keeps vertices in their bounds")
# of ``collisions.solids.particle_contact``
resolve = placeholder(
    "resolve", "of (x, v, w, triangles, shapes, colliders, h, carried, look, room): moves solids on, and the sheet out of them"
)
room_for_contact = placeholder("room_for_contact", "of (x, triangles, shapes): makes the scratch of ``resolve``")
# ``advance_block`` as it is compiled for all this
take_block = placeholder("take_block", "``advance_block``, with all kernels bound: takes a block through its substeps")


class Motion(NamedTuple):
    """Positions x [m] and velocities v [m/s], (blocks, 3, particles, lanes), and inverse masses w, zero where something is held
    [1/kg], (blocks, particles, lanes)."""

    x: NDArray
    v: NDArray
    w: NDArray


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


def advance_block(
    x, v, w, weave, elastic, drag_rate, resistance, gravity, wind, schedule, shapes, colliders, sheet, block, push, work, room,
    limited,
):  # fmt: skip
    """All substeps of one block."""
    h, carried, substeps, air_every, look_every, options, plan, _, limit = schedule
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
        press(x, v, w, sheet, block, step, h, carried)
        # solids move on, and push out what is in them
        resolve(x, v, w, weave.triangles, shapes, colliders, h, carried, step, look_every, room)
        # the contacts' impulses are corrected, and no vertex leaves its displacement bound
        keep_apart(x, v, w, sheet, block, h, carried)
    remeasure(x, weave, limited)


def advance(first, last, motion, weave, fabric, solids, sheet, schedule, outcome):
    """One control step of blocks ``first`` to ``last``: a block does all its substeps before the next, and stays in cache."""
    x, v, w = motion
    # scratch, which the blocks share one after the other
    work, push = room_for_work(x[first], weave.offset, schedule.room), np.zeros(x.shape[1:], x.dtype)
    room = room_for_contact(x[first], weave.triangles, solids.shapes)
    for b in range(first, last):
        push[:] = 0
        outcome.limited[b] = 0
        elastic = Elastic(fabric.stiffness[b], fabric.rigidity[b], fabric.damping_time[b])
        take_block(
            x[b], v[b], w[b], weave, elastic, fabric.drag_rate[b], fabric.resistance[b], fabric.gravity[b], fabric.wind[b],
            schedule, solids.shapes, solids.rows[b], sheet, b, push, work, room, outcome.limited[b],
        )  # fmt: skip
        mark_diverged(x[b], v[b], outcome.diverged[b])


@cache
def compiled(substep: Any, name: str, model: Bending, by_particle: bool, limits: bool, collides: bool, contact: str) -> Any:
    """``advance`` around an integrator's substep: with the forces of a bending model and a layout, with a limiter or none, with
    contact of the sheet with itself or none, and with contact with solids (see ``particle_contact.needed``)."""
    forces, layout = kernels_of(model, by_particle), "particles" if by_particle else "lanes"
    touching = contact_kernels(contact, by_particle)
    parts = limiting.kernels_of(limits, by_particle) | SELF_CONTACT[collides] | used(advance_block, forces | touching)
    parts["substep"] = specialize(substep, f"{name}_{model.name}_{layout}", apart=True, **used(substep, forces))
    which = f"{name}_{model.name}_{layout}_{limits}_{collides}_{contact}"
    block = specialize(uncounted(advance_block), f"advance_block_{which}", apart=True, **parts)
    return specialize(advance, f"advance_{which}", take_block=block, **used(advance, touching))

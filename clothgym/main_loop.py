"""Floor 5: the main loop, which is all that happens in a control step.

``advance`` takes blocks one after the other, each through all its substeps.  The kernels that it calls are the placeholders below,
bound when a simulation is made (``compiled``), by its integrator, bending model, layout, limiter and contact.  Its scratch, which
it cannot make itself (see ``_jit.uncounted``), is made by ``scratch_for_block``.
"""

from __future__ import annotations

from functools import cache
from threading import local
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import limiting
from clothgym._jit import callees_of, placeholder, specialize, uncounted
from clothgym.bending import Bending
from clothgym.collisions.self.step import kernels_of as self_contact_kernels
from clothgym.collisions.solids.owner import Solid
from clothgym.collisions.solids.sheet_contact import kernels_of as contact_kernels
from clothgym.elements import Elastic
from clothgym.forces import add_air_forces
from clothgym.grid_forces import kernels_of
from clothgym.guards import mark_diverged
from clothgym.integrators.base import Work, scratch_for_work

# of the integrator, see ``integrators.base``
substep = placeholder("substep", "of an integrator: moves a block on by h [s] under springs, bending, gravity, drag and push")
# of ``limiting``
limit_strain = placeholder(
    "limit_strain", "of (x, v, w, topology, size, limit, strain_report): pulls springs beyond the strain limit back to it"
)
measure_strain = placeholder(
    "measure_strain", "of (x, topology, size, strain_report): writes the largest strain at the end of a control step"
)
# of ``collisions.self.step``
warm_start = placeholder("warm_start", "of (x, v, w, sheet, block, step, lead): applies the impulses of contacts with itself")
solve_self_contact = placeholder(
    "solve_self_contact", "of (x, v, w, sheet, scratch, block, h, lead): corrects them, and keeps vertices in their bounds"
)
scratch_for_self_contact = placeholder("scratch_for_self_contact", "of (x, sheet): makes the scratch of ``solve_self_contact``")
# of ``collisions.solids.sheet_contact``
resolve = placeholder(
    "resolve",
    "of (x, v, w, triangles, shapes, colliders, h, lead, look, scratch): moves solids on, and the sheet out of them",
)
scratch_for_contact = placeholder("scratch_for_contact", "of (x, triangles, shapes): makes the scratch of ``resolve``")


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
    """The plan of a control step: substep, intervals, options of the integrator, strain limit.

    h: a substep [s].  lead: for how long velocities have moved the positions when contact changes them [s].
    substeps: of a control step.  air_every, look_every: substeps after which the air's force is computed again, 0 for no air, and
    after which solids are looked for between particles.
    options, plan, work_shape: of the integrator: numbers, matrices that it has factorized, and the size of its scratch.
    limit: largest strain.
    """

    h: Any
    lead: Any
    substeps: int
    air_every: int
    look_every: int
    options: tuple[Any, ...]
    plan: tuple[NDArray, ...]
    work_shape: tuple[int, int, int]
    limit: float


class Outcome(NamedTuple):
    """Strain met and left in a control step, (blocks, 3, lanes), and whether an environment has diverged, (blocks, lanes)."""

    strain_report: NDArray
    diverged: NDArray


def scratch_for_block(x, offset, shape, triangles, shapes, sheet):
    """Scratch of ``advance``, which its blocks share one after the other: the integrator's, the air's force [N], and those of
    contact with solids and of the sheet with itself.

    x: positions of a block.  offset: see ``elements.scratch_for_forces``.  shape: see ``Integrator.work_shape``.
    """
    solids, itself = scratch_for_contact(x, triangles, shapes), scratch_for_self_contact(x, sheet)
    return scratch_for_work(x, offset, shape), np.zeros(x.shape, x.dtype), solids, itself


def advance(first, last, motion, topology, fabric, solids, sheet, schedule, outcome, scratch):
    """One control step of blocks ``first`` to ``last``: a block does all its substeps before the next, and stays in cache."""
    h, lead, substeps, air_every, look_every, options, plan, _, limit = schedule
    (fields, of_springs, of_bends, of_forces), push, of_solids, of_itself = scratch
    shapes = solids.shapes
    for b in range(first, last):
        x, v, w, colliders, strain_report = motion.x[b], motion.v[b], motion.w[b], solids.rows[b], outcome.strain_report[b]
        work = Work(fields, of_springs, of_bends, of_forces, motion.remainders[b])
        elastic = Elastic(fabric.stiffness[b], fabric.rigidity[b], fabric.damping_time[b], fabric.size[b])
        drag_rate, resistance, gravity, wind = fabric.drag_rate[b], fabric.resistance[b], fabric.gravity[b], fabric.wind[b]
        push[:] = 0
        strain_report[:] = 0
        for step in range(substeps):
            # the air's force changes slowly compared with the springs': between computations it is a constant push
            if air_every > 0 and step % air_every == 0:
                push[:] = 0
                add_air_forces(x, v, push, topology.air, resistance, wind, x.dtype.type(air_every) * h, work.scratch)
            # the integrator: springs, bending, gravity, drag and that push move the particles on
            substep(x, v, w, topology.elements, elastic, drag_rate, gravity, push, h, options, plan, work)
            # springs that are stretched beyond the limit are pulled back to it
            limit_strain(x, v, w, topology, elastic.size, limit, strain_report)
            # contacts of the sheet with itself press as before, so that solids bear what lies on them
            warm_start(x, v, w, sheet, b, step, lead)
            # solids move on, and push the sheet out
            resolve(x, v, w, topology.triangles, shapes, colliders, h, lead, step, look_every, of_solids)
            # the contacts' impulses are corrected, and no vertex leaves its displacement bound
            solve_self_contact(x, v, w, sheet, of_itself, b, h, lead)
        measure_strain(x, topology, elastic.size, strain_report)
        mark_diverged(x, v, outcome.diverged[b])


class MainLoop:
    """``advance`` of one simulation, with the scratch of each of its threads."""

    def __init__(self, kernel: Any, make_scratch: Any) -> None:
        self.kernel, self.make_scratch = kernel, make_scratch
        # each thread has one, as long as it lives
        self.scratches = local()

    def __call__(
        self, first: int, last: int, motion: Motion, topology: Any, fabric: Any, solids: Solid, sheet: Any, schedule: Schedule,
        outcome: Outcome,
    ) -> None:  # fmt: skip
        """One control step of blocks ``first`` to ``last``."""
        if not hasattr(self.scratches, "own"):
            self.scratches.own = self.make_scratch(
                motion.x[first], topology.offset, schedule.work_shape, topology.triangles, solids.shapes, sheet
            )
        self.kernel(first, last, motion, topology, fabric, solids, sheet, schedule, outcome, self.scratches.own)


@cache
def compiled(substep: Any, name: str, model: Bending, layout: str, limits: bool, collides: bool, contact: str) -> tuple[Any, Any]:
    """``advance`` around an integrator's substep: with the forces of a bending model and a layout, with a limiter or none, with
    contact of the sheet with itself or none, and with contact with solids (see ``sheet_contact.needed``); and its
    ``scratch_for_block``."""
    forces, touching, itself = kernels_of(model, layout), contact_kernels(contact, layout), self_contact_kernels(collides, layout)
    parts = limiting.kernels_of(limits, layout) | callees_of(advance, forces | touching | itself)
    parts["substep"] = specialize(substep, f"{name}_{model.name}_{layout}", apart=True, **callees_of(substep, forces))
    which = f"{name}_{model.name}_{layout}_{limits}_{collides}_{contact}"
    scratch = specialize(scratch_for_block, f"scratch_for_block_{layout}", **callees_of(scratch_for_block, touching | itself))
    return specialize(uncounted(advance), f"advance_{which}", apart=True, **parts), scratch

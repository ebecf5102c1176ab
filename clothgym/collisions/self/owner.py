"""Self-collision of a batch: its options, its memory, and its report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym import contact_memory
from clothgym._jit import kernel
from clothgym.checks import not_negative, positive
from clothgym.collisions.self.broad_phase import Reach, faces_of
from clothgym.collisions.self.contact_normals import SmoothSheet
from clothgym.collisions.self.displacement_bounds import FARTHEST
from clothgym.collisions.self.far_pairs import far_contacts
from clothgym.collisions.self.impulses import TOLERANCE
from clothgym.collisions.self.lower_bounds import round_positions
from clothgym.collisions.self.narrow_phase import MARGIN, Distances, gap_of_edges, gap_of_vertex
from clothgym.collisions.self.query_scratch import Found, scratch_for_queries
from clothgym.collisions.self.spread import spread_out
from clothgym.collisions.self.step import PUSH, Memory, Setting, Sheet
from clothgym.collisions.self.topology import Pairs, pairs_of
from clothgym.collisions.solids.owner import Solid
from clothgym.contact_memory import (
    C_SIZE,
    G_SIZE,
    REPORT_GAP,
    REPORT_LAG,
    REPORT_SIZE,
    REPORT_UNCERTAIN,
)
from clothgym.geometry.intersections import first_intersection
from clothgym.layout import Layout
from clothgym.mesh import ClothMesh
from clothgym.state import State
from clothgym.warning import warn_caller

MODES = ("fast", "strict")
REACH = 1.4  # how far a query sees, in thicknesses
CONTACT = 0.5  # thicknesses beyond the thickness within which a pair becomes a contact
STOP = 0.125  # thicknesses at which gap constraints are held
STANDOFF = 0.25  # thicknesses at which what is held stops
USUAL = 0.28  # thickness where none is given, over the shortest distance at rest of what does not hang together
# largest thickness over such a distance: of near pairs, which are thinner if need be, and of others
NEAR_MOST, FAR_MOST = 0.35, 0.45
FRICTION = 0.3
THINNEST = 20 * MARGIN  # thickness that strict mode takes [m]: rounding takes a share of it
WANTED = "must be False, 'fast' or 'strict', or a dict with mode, thickness and friction"
BEYOND = (
    f"within {FARTHEST:g} m float32 can certify that a sheet does not intersect itself; move the scene to the origin, or take "
    "dtype='float64'"
)


class SelfContacts(NamedTuple):
    """Self-collision of each environment in the last control step, (num_envs,) each.

    rows: contacts within reach; touching: those at which something acted in the last substep.
    clamped: moves of a vertex in a substep that were cut short.  queries: made.
    dropped: contacts for which there was no room (they still bound their vertices), and pairs that found none to be constrained
    (what they have left is shared out with each query, and less of it each time).
    gap: smallest certified distance at a query [m], 0 where the directions that were tried certify none, inf if nothing was within
    reach or no query made.
    lag: how far the slowest held particle is behind its attachment [m].  uncertified: whether the sheet went farther from
    the origin than rounding allows.
    """

    rows: NDArray
    touching: NDArray
    clamped: NDArray
    queries: NDArray
    dropped: NDArray
    gap: NDArray
    lag: NDArray
    uncertified: NDArray


class Options(NamedTuple):
    """How a sheet collides with itself: mode, thickness [m] (None for the usual one) and friction coefficient."""

    mode: str
    thickness: float | None
    friction: float


def options_of(value: Any) -> Options | None:
    """What ``Simulation(self_collision=...)`` means; None for no self-collision.

    Raises:
        ValueError: an unknown mode or option, or a value that makes no sense.
    """
    if value is None or value is False:
        return None
    if not isinstance(value, (str, Mapping)):
        raise ValueError(f"self_collision={value!r}: {WANTED}")
    given = dict(value) if isinstance(value, Mapping) else {"mode": value}
    for name in given:
        if name not in Options._fields:
            raise ValueError(f"self_collision: no option {name!r} (there are: {', '.join(Options._fields)})")
    mode, thickness, friction = given.get("mode", "strict"), given.get("thickness"), given.get("friction", FRICTION)
    if not isinstance(mode, str) or mode not in MODES:
        raise ValueError(f"self_collision={mode!r}: {WANTED}")
    thickness = None if thickness is None else positive("self_collision: thickness", thickness)
    if thickness is not None and thickness < THINNEST and mode == "strict":
        raise ValueError(f"self_collision: thickness={thickness!r}: strict mode takes {THINNEST:g} m and more")
    return Options(mode, thickness, not_negative("self_collision: friction", friction))


class SelfCollision:
    """Self-collision of a batch.

    Attributes:
        options: what was asked for; None for none.
        thickness: distance that the cloth keeps to itself [m].
        sheet: what the main loop gives to the kernels, but for the solids, see ``sheet_with``.
    """

    def __init__(self, layout: Layout, mesh: ClothMesh, value: Any, dtype: np.dtype) -> None:
        self.layout, self.dtype, self.options = layout, dtype, options_of(value)
        self.sheet: Any = ()
        self.thickness = 0.0
        self._reported = np.zeros(layout.blocks * layout.lanes, bool)
        if self.options is None:
            return
        pairs = pairs_of(mesh)
        # a sheet that is flat and convex at rest, see ``spread``, cannot intersect itself there
        if not len(pairs.to_rest) and (found := first_intersection(mesh.triangles, mesh.rest_positions)) is not None:
            raise ValueError(
                f"self_collision: at rest this sheet intersects itself, for instance triangles {found[1]} and {found[2]}: give a "
                "mesh whose rest shape does not"
            )
        reach = reach_of(mesh, pairs, self.options.thickness, dtype)
        if self.options.mode == "strict" and reach.far_thickness < THINNEST:
            raise ValueError(
                f"self_collision: for this sheet a thickness of {reach.far_thickness:.2g} m is usual: strict mode takes "
                f"{THINNEST:g} m and more; give a larger sheet, or take 'fast'"
            )
        self.thickness = reach.far_thickness
        real = dtype.type
        friction, push, tolerance = real(self.options.friction), real(PUSH), real(TOLERANCE * self.thickness)
        setting = Setting(self.options.mode == "strict", dtype == np.float32, friction, push, tolerance)
        self.sheet = Sheet(pairs, reach, setting, memory_of(layout, mesh.num_particles, dtype), ())
        self.check(mesh.rest_positions[None], np.zeros(1, np.int64))

    @property
    def strict(self) -> bool:
        """Whether sheets are kept from passing through themselves."""
        return self.options is not None and self.options.mode == "strict"

    def sheet_with(self, solid: Solid) -> Any:
        """``sheet`` with the solids as they are now."""
        return () if self.options is None else self.sheet._replace(solid=solid)

    @property
    def lag(self) -> NDArray:
        """Lag of attached particles [m], (blocks, 3, particles, lanes), of no blocks where contact holds nothing back."""
        return self.sheet.memory.lag if self.strict else np.zeros((0, 3, 0, 0), self.dtype)

    def check(self, positions: NDArray, envs: NDArray) -> None:
        """Refuse starts that strict mode cannot keep apart; positions: of ``envs``, (envs, particles, 3), or one sheet for all [m].

        Raises:
            ValueError: a sheet that intersects itself, or that is too far from the origin to be certified.
        """
        if self.strict and self.dtype == np.float32 and (farthest := np.abs(positions).max(initial=0)) > FARTHEST:
            raise ValueError(f"positions: {farthest:.4g} m from the origin: {BEYOND}")
        self.check_apart(positions, envs)

    def check_apart(self, positions: NDArray, envs: NDArray) -> None:
        """The same, wherever they are: of a sheet that has gone too far, ``warn`` tells.

        Raises:
            ValueError: a sheet that intersects itself.
        """
        if not self.strict or len(positions) == 0:
            return
        # most starts are spread out, which rules intersections out without the exact check
        x, pairs = np.asarray(positions, self.dtype).reshape(-1, *positions.shape[-2:]), self.sheet.pairs
        near = np.flatnonzero(~spread_out(np.ascontiguousarray(x, np.float64), pairs.parts.triangles, pairs.to_rest))
        found = first_intersection(pairs.parts.triangles, x[near]) if len(near) else None
        if found is not None:
            which, one, two = envs[near[found[0]]], *found[1:]
            raise ValueError(
                f"positions: in environment {which} triangles {one} and {two} intersect: self_collision='strict' keeps apart "
                "what is apart, and does not untangle; start from another sheet (clothgym.starts.make makes some), or take "
                "self_collision='fast'"
            )

    def begin(self, block: NDArray, lane: NDArray, x: NDArray) -> None:
        """Forget some environments' contacts: a query is due at positions x in blocks [m]."""
        if self.options is not None:
            contact_memory.begin(self.sheet.memory, block, lane, x)
            self._reported[block * self.layout.lanes + lane] = False

    def blank(self) -> dict[str, NDArray]:
        """What a state holds where every query is due."""
        return contact_memory.blank(self.layout.num_envs, self._particles)

    def public(self) -> dict[str, NDArray]:
        """What a state holds of this batch."""
        return self.blank() if self.options is None else contact_memory.public(self.sheet.memory, self.layout)

    def check_memory(self, state: State) -> None:
        """Refuse contacts that this simulation cannot have had.

        Raises:
            ValueError: what is wrong.
        """
        contact_memory.check(state.self_contact, self.layout, self._particles, ~state.diverged)

    def restore(self, state: State, x: NDArray) -> None:
        """Take over from a state, with positions x in blocks [m]."""
        if self.options is not None:
            contact_memory.restore(self.sheet.memory, state.self_contact, self.layout, x)
            self._reported[:] = False

    @property
    def _particles(self) -> int:
        """How many particles contact remembers."""
        return 0 if self.options is None else self.sheet.memory.bounds.shape[1]

    def let_go(self, held: NDArray, holder: NDArray, blocks: slice = slice(None)) -> None:
        """Forget what contacts know of particles that are no longer held by what held them, (blocks, particles, lanes) each.

        Their lag ends with the attachment that they lagged behind.  And impulses that have borne what an attachment pressed would
        throw the pile up once it is free: where a particle that is free now takes part in a contact with an impulse, the contacts
        of its sheet begin without any.
        """
        if self.options is None:
            return
        memory, freed = self.sheet.memory, (held >= 0) & (holder < 0)
        if memory.behind[blocks].any():
            np.moveaxis(memory.lag[blocks], 1, 3)[holder != held] = 0
            memory.behind[blocks] = contact_memory.largest_lag(memory.lag[blocks])
        first = blocks.indices(len(memory.contacts))[0]
        for block, lane in np.argwhere(freed.any(axis=1)).tolist():
            contact_memory.forget_impulses(memory, first + block, lane, freed[block, :, lane])

    def warn(self, steps: NDArray) -> None:
        """Tell once of environments whose sheet has gone too far to be certified; steps: since their reset, (num_envs,)."""
        if not self.strict or not self.sheet.memory.report[:, :, REPORT_UNCERTAIN].any():
            return
        uncertain = self.sheet.memory.report[:, :, REPORT_UNCERTAIN].ravel() == 1
        new = np.flatnonzero(uncertain & ~self._reported)
        if len(new):
            self._reported[new] = True
            warn_caller(
                f"environment {new[0]}: in control step {steps[new[0]]} the sheet is more than {FARTHEST:g} m from the origin: "
                f"{BEYOND}",
                RuntimeWarning,
            )

    def report(self) -> SelfContacts | None:
        """What happened in the last control step."""
        if self.options is None:
            return None
        report = self.sheet.memory.report.reshape(-1, REPORT_SIZE)[: self.layout.num_envs]
        numbers = report.T.copy()
        rows, touching, clamped, queries, dropped = numbers[:REPORT_GAP].astype(np.int64)
        return SelfContacts(
            rows, touching, clamped, queries, dropped, numbers[REPORT_GAP], numbers[REPORT_LAG], numbers[REPORT_UNCERTAIN] > 0
        )


def memory_of(layout: Layout, particles: int, dtype: np.dtype) -> Memory:
    """Room for a batch."""
    used = np.clip(layout.num_envs - layout.lanes * np.arange(layout.blocks), 0, layout.lanes)
    return Memory(**contact_memory.allocate(layout, particles, dtype), used=used)


@kernel
def shortest_near(p, parts, primitives, vertex_triangles):
    """Shortest distance of a near pair of primitives [m]; the first ``vertex_triangles`` are vertices and triangles."""
    triangles, edges, shortest = parts.triangles, parts.edges, np.inf
    for n in range(primitives.shape[0]):
        i, j = primitives[n, 0], primitives[n, 1]
        if n < vertex_triangles:
            _, _, _, x, y, z = gap_of_vertex(p, i, triangles[j, 0], triangles[j, 1], triangles[j, 2])
        else:
            _, _, x, y, z = gap_of_edges(p, edges[i, 0], edges[i, 1], edges[j, 0], edges[j, 1])
        shortest = min(shortest, x * x + y * y + z * z)
    return np.sqrt(shortest)


@kernel
def least_far(p, pairs, distances, particles, coefficients, members, planes, report):
    """Shortest distance of primitives that do not hang together, or ``distances.within`` where none is within it [m].

    distances: without any thickness.  particles, coefficients, members, planes: without rows, so that nothing is kept;
    report: scratch.
    """
    scratch = scratch_for_queries(pairs, coefficients)
    scratch.p[:] = p
    scratch.bounds[:] = distances.within
    scratch.held[:] = False
    faces_of(p, pairs.parts.triangles, scratch.faces)
    extent = round_positions(p, scratch.extra, scratch.near)
    found = Found(particles, coefficients, members, planes, scratch.counts, report)
    far_contacts(pairs, distances, extent, SmoothSheet(scratch.p, scratch.normals, scratch.kinds), scratch, found)
    return scratch.bounds.min()


def reach_of(mesh: ClothMesh, pairs: Pairs, thickness: float | None, dtype: np.dtype) -> Reach:
    """Distances of the query for a cloth thickness [m], or for the usual one; dtype: of the simulation, whose kernels do for it.

    Raises:
        ValueError: the sheet is that close to itself at rest.
    """
    p = mesh.rest_positions.astype(np.float64)
    near = float(shortest_near(p, pairs.parts, pairs.near.primitives, pairs.near.vertex_triangles))
    nothing = np.empty((0, 4), np.int32), np.empty((0, C_SIZE), dtype), np.empty((0, G_SIZE), np.int32), np.empty((0, 4))
    # without a thickness there are no contacts, and with an infinite stop no layers
    bare = Distances(2 * near, 0.0, 0.0, 0.0, 0.0, np.inf, 0.0)
    apart = float(least_far(p, pairs, bare, *nothing, np.empty(REPORT_SIZE)))
    # of single triangles nothing is near, and of one alone nothing else
    shortest = np.sqrt(1 / pairs.parts.rest_edges.max())
    usual = USUAL * min(near, apart, shortest) if near == np.inf else USUAL * near
    own = usual if thickness is None else thickness
    if own > FAR_MOST * apart:
        raise ValueError(
            f"self_collision: thickness={own!r}: parts of this sheet that do not hang together are {apart:.3g} m apart at rest; "
            f"at most {FAR_MOST * apart:.2g} fits, {usual:.2g} is usual"
        )
    thin = min(own, NEAR_MOST * near)
    return Reach(REACH * thin, REACH * own, thin, own, CONTACT * thin, STOP * thin, STANDOFF * thin, min(near, apart))

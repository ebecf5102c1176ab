"""Floor 2: what a sheet's contact with itself remembers, as one table from which arrays, states and files follow.

What each array means is said where it is used: ``collisions.self.step.Memory`` lists them all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import LARGEST, fits
from clothgym.layout import Layout

MOST_CONTACTS = 12  # contacts for each vertex; more are counted as dropped
MOST_CONSTRAINTS = 24  # gap constraints for each vertex; more bound their vertices instead
# columns of a contact's coefficients: four weights, the normal from C_NORMAL on, and the thickness
C_NORMAL, C_THICKNESS, C_SIZE = 4, 7, 8
# columns of a gap constraint's members: how many vertices are the first primitive's, how many all are, the pair of leaves, the
# vertices; and of its plane: a unit normal, and the distance along it that is kept
G_OWN, G_NUMBER, G_GROUP, G_VERTICES, G_SIZE = 0, 1, 2, 3, 11
G_KEPT, PLANE_SIZE = 3, 4
# columns of the report on an environment
REPORT_CONTACTS, REPORT_TOUCHING, REPORT_CLAMPED, REPORT_QUERIES = 0, 1, 2, 3
REPORT_DROPPED, REPORT_GAP, REPORT_LAG, REPORT_UNCERTAIN, REPORT_SIZE = 4, 5, 6, 7, 8


class Kept(NamedTuple):
    """How one array is laid out.

    of: "vector" (three numbers a particle), "particle", "environment", or the rows of "contacts" or of "constraints".
    dtype: None for the simulation's.  columns: of a row.  start: where a query is due.  saved: whether it is part of the state.
    """

    of: str
    dtype: type | None = None
    columns: int = 0
    start: float = 0
    saved: bool = True


FIELDS = {
    "start": Kept("vector"),
    "bounds": Kept("particle", start=-1),
    "limits": Kept("particle", start=-1),
    "old": Kept("vector", saved=False),
    "lag": Kept("vector"),
    "behind": Kept("environment", saved=False),
    "contacts": Kept("environment", np.int32),
    "particles": Kept("contacts", np.int32, 4),
    "coefficients": Kept("contacts", None, C_SIZE),
    "impulses": Kept("contacts", None, 3),
    "pressed": Kept("vector"),
    "waited": Kept("environment", np.int32),
    "span": Kept("environment", np.int32),
    "aged": Kept("environment", np.int32, saved=False),
    "chosen": Kept("contacts", np.int32, saved=False),
    "choices": Kept("environment", np.int32, saved=False),
    "constraints": Kept("environment", np.int32),
    "members": Kept("constraints", np.int32, G_SIZE),
    "planes": Kept("constraints", np.float64, PLANE_SIZE),
    "looks": Kept("environment", np.int32),
    "outside": Kept("particle", np.bool_, saved=False),
    "any_outside": Kept("environment", np.bool_, saved=False),
    "query_due": Kept("environment", np.bool_, saved=False),
    "active": Kept("constraints", np.int32, saved=False),
    "report": Kept("environment", np.float64, REPORT_SIZE, saved=False),
}
MOST_PER_VERTEX = {"contacts": MOST_CONTACTS, "constraints": MOST_CONSTRAINTS}  # for each vertex
SAVED = {name: kept for name, kept in FIELDS.items() if kept.saved}


def allocate(layout: Layout, particles: int, dtype: np.dtype) -> dict[str, NDArray]:
    """All arrays of a batch, as kernels see them."""
    lanes = (layout.blocks, layout.lanes)
    arrays: dict[str, NDArray] = {}
    for name, kept in FIELDS.items():
        columns = (kept.columns,) if kept.columns else ()
        if kept.of in MOST_PER_VERTEX:
            # rows are written where they are needed only: an operating system gives no memory to what has never been touched
            arrays[name] = np.empty((*lanes, MOST_PER_VERTEX[kept.of] * particles, *columns), kept.dtype or dtype)
            continue
        shape = {"vector": (layout.blocks, 3, particles, layout.lanes), "particle": (layout.blocks, particles, layout.lanes)}
        arrays[name] = np.full(shape.get(kept.of, (*lanes, *columns)), kept.start, kept.dtype or dtype)
    return arrays


def begin(memory: Any, block: NDArray, lane: NDArray, x: NDArray) -> None:
    """Forget some environments' contacts: a query is due at positions x, in blocks [m]."""
    for name, kept in FIELDS.items():
        array = getattr(memory, name)
        if kept.of == "vector":
            array[block, :, :, lane] = x[block, :, :, lane] if name in ("start", "old") else kept.start
        elif kept.of == "particle":
            array[block, :, lane] = kept.start
        elif kept.of == "environment":
            array[block, lane] = kept.start


def forget_impulses(memory: Any, block: int, lane: int, freed: NDArray) -> None:
    """Let the contacts of a lane begin without impulses, if any that has one joins a particle that is ``freed``, (particles,)."""
    count = memory.contacts[block, lane]
    particles, impulses = memory.particles[block, lane, :count], memory.impulses[block, lane, :count]
    if np.any(freed[particles].any(axis=1) & (impulses != 0).any(axis=1)):
        impulses[:] = 0
        memory.pressed[block, :, :, lane] = 0
        memory.waited[block, lane] = memory.span[block, lane] = 0


def blank(num_envs: int, particles: int) -> dict[str, NDArray]:
    """What a state holds of a batch whose queries are all due; without particles where there is no self-collision."""
    return {name: np.full(_public_shape(kept, num_envs, particles, 0), kept.start, kept.dtype) for name, kept in SAVED.items()}


def public(memory: Any, layout: Layout) -> dict[str, NDArray]:
    """What a state holds of a batch; no more rows than some environment has."""
    state: dict[str, NDArray] = {}
    for name, kept in SAVED.items():
        array = getattr(memory, name)
        if kept.of not in MOST_PER_VERTEX:
            state[name] = (layout.vectors_to_public if kept.of == "vector" else layout.to_public)(array)
    for name, kept in SAVED.items():
        if kept.of in MOST_PER_VERTEX:
            array, count = getattr(memory, name), state[kept.of]
            used = array.reshape(-1, *array.shape[2:])[: layout.num_envs, : count.max()]
            there = np.arange(used.shape[1]) < count[:, None]
            state[name] = np.where(there[:, :, None], used, 0)
    # nothing has written what lies behind a pair's vertices
    members = state["members"]
    members[np.arange(G_SIZE) >= G_VERTICES + members[:, :, G_NUMBER, None]] = 0
    return state


def check(state: dict[str, NDArray], layout: Layout, particles: int, sound: NDArray) -> None:
    """Refuse contacts that no simulation of ``particles`` can have had: kernels would look for them beyond their arrays.

    sound: environments whose values must be finite, (num_envs,).

    Raises:
        ValueError: what is wrong.
    """
    advice = "give what get_state() of such a simulation gave"
    for name, kept in sorted(SAVED.items(), key=lambda item: item[1].of in MOST_PER_VERTEX):
        given = state[name]
        rows = given.shape[1] if kept.of in MOST_PER_VERTEX and np.ndim(given) > 1 else 0
        model: NDArray = np.broadcast_to(
            np.zeros((), kept.dtype or np.float64), _public_shape(kept, layout.num_envs, particles, rows)
        )
        low, high = (0, LARGEST) if kept.of == "environment" else (-LARGEST, LARGEST)
        # what a gap constraint may come no closer than is infinite where it may not move
        high = np.inf if name == "planes" else high
        fits(f"self_contact[{name!r}]", given, model, low, high, ~sound if model.dtype.kind == "f" else None, advice)
        # as many rows as the environments have, and as there is room for
        if kept.of in MOST_PER_VERTEX and not state[kept.of].max(initial=0) <= rows <= MOST_PER_VERTEX[kept.of] * particles:
            raise ValueError(f"the state's self_contact[{name!r}] has shape {given.shape}, which does not fit: {advice}")
    members = state["members"]
    for name, vertices in (("particles", state["particles"]), ("members", members[:, :, G_VERTICES:])):
        if np.any((vertices < 0) | (vertices >= particles)):
            raise ValueError(f"the state's self_contact[{name!r}] name particles beyond the {particles} of the sheet: {advice}")
    own, number = members[:, :, G_OWN], members[:, :, G_NUMBER]
    if np.any((own < 0) | (number < own) | (number > G_SIZE - G_VERTICES)):
        raise ValueError(f"the state's self_contact['members'] count more vertices than a pair has: {advice}")


def restore(memory: Any, state: dict[str, NDArray], layout: Layout, x: NDArray) -> None:
    """Take over what a state holds, with positions x in blocks [m]."""
    block, lane = layout.at(np.arange(layout.num_envs))
    begin(memory, block, lane, x)
    for name, kept in SAVED.items():
        array, given = getattr(memory, name), state[name]
        if kept.of in MOST_PER_VERTEX:
            array[block, lane, : given.shape[1]] = given
        elif kept.of == "environment":
            array[block, lane] = given
        elif name == "start":
            # where a query is due, it is about the positions of now
            due = np.any(state["bounds"] < 0, axis=1)
            array[block, :, :, lane] = np.where(due[:, None, None], x[block, :, :, lane], np.swapaxes(given, 1, 2))
        else:
            array[:] = (layout.vectors_to_blocks if kept.of == "vector" else layout.to_blocks)(given, array.dtype)
    memory.behind[:] = largest_lag(memory.lag)


def largest_lag(lag: NDArray) -> NDArray:
    """The largest length of the vectors of each lane [m], (blocks, lanes); lag: (blocks, 3, particles, lanes)."""
    return np.sqrt((lag**2).sum(axis=1)).max(axis=1)


def _public_shape(kept: Kept, num_envs: int, particles: int, rows: int) -> tuple[int, ...]:
    if kept.of in MOST_PER_VERTEX:
        return (num_envs, rows, kept.columns)
    return {"vector": (num_envs, particles, 3), "particle": (num_envs, particles)}.get(kept.of, (num_envs,))

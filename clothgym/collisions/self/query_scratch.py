"""Arrays that a query of one sheet writes: scratch, one set for each thread, and the contacts and gap constraints that it finds.

Kernels that allocate no arrays count no references (see ``_jit.uncounted``), so all scratch is allocated here, once.  Lists of
unknown length are processed in batches: ``BATCH`` pairs of primitives, and ``LEAF_PAIRS`` pairs of leaves for each leaf.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart
from clothgym.collisions.self.topology import NODE_LEAVES
from clothgym.collisions.solids.attachment_contact import Probe, probe_of

BATCH = 256  # pairs of primitives that are judged at a time
LEAF_PAIRS = 3 * NODE_LEAVES  # pairs of leaves in a batch, for each leaf; one node may add ``NODE_LEAVES`` for each


class Found(NamedTuple):
    """Contacts and gap constraints of one lane, see ``step.Memory``, with their numbers in ``counts``, (2,)."""

    particles: NDArray
    coefficients: NDArray
    members: NDArray
    planes: NDArray
    counts: NDArray
    report: NDArray


class QueryScratch(NamedTuple):
    """Scratch of a query; lengths are in particles, edges, triangles, leaves and nodes of the sheet.

    p: positions; ahead: those in the middle of the time until the next query [m], both (particles, 3).  extra: how much farther
    than its reach a query looks around each vertex [m]; bounds, limits: see ``narrow_phase`` [m]; squares: of the limits [m^2];
    held: whether attached; halvings, zone: see ``gap_constraints``, all (particles,).  wish: displacements and velocities that
    vertices would have without gap constraints; before_zone: positions and velocities before a zone moves, both (6,
    particles); zone_before: the zones then, (particles,).  mean: of a zone, (6,).  probe: for distances to solids.
    normals, kinds: see ``contact_normals.SmoothSheet``.  faces: unit normals of triangles, (3, triangles).
    gradients, smallest: see ``spread``, (6, triangles), (triangles,).
    near: positions relative to the first particle [m], extras [m], and the largest extra [m] and stretch around each vertex, in
    float32, (6, particles); stretch: of each edge, (edges,); around: the largest extra and stretch of each triangle, (2,
    triangles); close: whether near pairs of vertices may be close, (near + 8,); seen: near pairs of these, (near pairs,).
    box, ball, wide, hulls: see ``broad_phase.enclose``.  leaves: pairs of leaves, (room, 2); gaps: distance and normal of the
    planes between them; closest: of their closest primitives, (room, 4); layered: whether a plane stands for all, (room,).
    edge_box, ridges: boxes of edges, and whether they are ridges, in the order of the leaves, (6, edges), (edges,); boxed: leaves
    that have them, (leaves,).
    pairs: a batch of primitives, (3, BATCH); ends: their vertices, (4, BATCH); lower: bounds of their distances [m], (BATCH,).
    known, impulses: particles and impulses of contacts before a query, (contacts, 4), (contacts, 3); before, last: linked lists
    of these, (contacts,), (particles,).  counts: (2,).
    """

    p: NDArray
    ahead: NDArray
    extra: NDArray
    bounds: NDArray
    limits: NDArray
    squares: NDArray
    held: NDArray
    halvings: NDArray
    zone: NDArray
    wish: NDArray
    before_zone: NDArray
    zone_before: NDArray
    mean: NDArray
    probe: Probe
    normals: NDArray
    kinds: NDArray
    faces: NDArray
    gradients: NDArray
    smallest: NDArray
    near: NDArray
    stretch: NDArray
    around: NDArray
    close: NDArray
    seen: NDArray
    box: NDArray
    ball: NDArray
    wide: NDArray
    hulls: NDArray
    leaves: NDArray
    gaps: NDArray
    closest: NDArray
    layered: NDArray
    edge_box: NDArray
    ridges: NDArray
    boxed: NDArray
    pairs: NDArray
    ends: NDArray
    lower: NDArray
    known: NDArray
    impulses: NDArray
    before: NDArray
    last: NDArray
    counts: NDArray


@apart
def scratch_for_queries(pairs, contacts):
    """The ``QueryScratch`` for a sheet; contacts: an array with a row for each contact that is kept, of the simulation's dtype."""
    n, edges, triangles = pairs.parts.around.shape[0] - 1, pairs.parts.edges.shape[0], pairs.parts.triangles.shape[0]
    leaves, near = pairs.tree.corners.shape[0], pairs.near.first.shape[0]
    room = LEAF_PAIRS * leaves
    real, single, whole, most = contacts.dtype, np.float32, np.int32, contacts.shape[0]
    return QueryScratch(
        np.empty((n, 3)), np.empty((n, 3)), np.zeros(n), np.empty(n), np.empty(n), np.empty(n, real), np.empty(n, np.bool_),
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty((6, n), real), np.empty((6, n), real), np.empty(n, np.int64),
        np.empty(6), probe_of(contacts), np.empty((n, 3)), np.zeros(n, np.uint8), np.empty((3, triangles)),
        np.empty((6, triangles)),
        np.empty(triangles), np.empty((6, n), single), np.empty(edges, single), np.empty((2, triangles), single),
        np.zeros(near // 8 * 8 + 8, np.bool_), np.empty(pairs.near.primitives.shape[0], np.bool_), np.empty((6, leaves)),
        np.empty((4, leaves)), np.empty(leaves), np.empty((6, pairs.tree.nodes.shape[0])), np.empty((room, 2), whole),
        np.empty((room, 4)), np.empty((room, 4)), np.empty(room, np.bool_), np.empty((6, edges)), np.empty(edges, np.bool_),
        np.empty(leaves, np.bool_), np.empty((3, BATCH), whole), np.empty((4, BATCH), np.uint32), np.empty(BATCH, single),
        np.empty((most, 4), whole), np.empty((most, 3), real), np.empty(most, whole), np.empty(n, whole), np.zeros(2, np.int64),
    )  # fmt: skip

"""A query: the close pairs of one sheet, and how far each vertex may move before the next query (see ``narrow_phase``)."""

from __future__ import annotations

from clothgym._jit import uncounted
from clothgym.collisions.self.broad_phase import faces_of
from clothgym.collisions.self.contact_normals import SmoothSheet, smooth_out
from clothgym.collisions.self.far_pairs import far_contacts
from clothgym.collisions.self.lower_bounds import round_positions
from clothgym.collisions.self.narrow_phase import MARGIN, SHARE, far_distances, near_distances
from clothgym.collisions.self.near_pairs import near_contacts
from clothgym.contact_memory import REPORT_GAP


@uncounted
def query(pairs, reach, scratch, found):
    """Find the close pairs of one sheet: contacts and gap constraints go to ``found``, a ``query_scratch.Found``.

    It reads ``p``, ``ahead``, ``extra`` and ``held`` of ``scratch``.  ``bounds`` becomes how far each vertex may move before its
    gap constraints are evaluated; ``limits``: before a query is due [m].
    """
    extra, bounds, limits = scratch.extra, scratch.bounds, scratch.limits
    # pairs that are not found are farther apart than the least reach
    least_reach = min(reach.near, reach.far)
    bounds[:] = least_reach
    limits[:] = least_reach
    found.counts[:] = 0
    # unit normals, and smooth sheets where there are several pieces
    faces_of(scratch.p, pairs.parts.triangles, scratch.faces)
    smooth = SmoothSheet(scratch.ahead, scratch.normals, scratch.kinds)
    several = False
    for v in range(bounds.shape[0]):
        several |= pairs.parts.piece[v] != pairs.parts.piece[0]
    if several:
        smooth_out(pairs.parts, scratch.faces, smooth)
    # near pairs: parts that share a leaf or whose leaves share a vertex; then all others
    extent = round_positions(scratch.p, extra, scratch.near)
    near_contacts(pairs, near_distances(reach), extent, smooth, scratch, found)
    far_contacts(pairs, far_distances(reach), extent, smooth, scratch, found)
    # bounds and limits: gamma_p times the smallest distances, less the margin
    least = least_reach
    for v in range(bounds.shape[0]):
        least = min(least, bounds[v])
        bounds[v] = SHARE * max(bounds[v] - MARGIN, 0.0)
        limits[v] = SHARE * max(limits[v] - MARGIN + 2.0 * extra[v], 0.0)
    if least < least_reach:
        found.report[REPORT_GAP] = min(found.report[REPORT_GAP], max(least, 0.0))

"""Floor 4: what the cloth touches, solids and itself.

The contact work of one substep, in the order of the main loop (``clothgym/main_loop.py``):

1. ``warm_start`` (``self/step.py``): contacts of the sheet with itself apply their impulses of the previous substep.
2. ``resolve`` (``solids/sheet_contact.py``): solids move on and push cloth out: every particle
   (``solids/particle_contact.py``), and with ``contact="sheet"`` the points between particles, too
   (``solids/triangle_contact.py``).  One contact takes the inward velocity and Coulomb friction (``solids/contact_law.py``).
3. ``solve_self_contact`` (``self/step.py``): impulses between parts closer than the cloth's thickness (``self/impulses.py``), then
   the displacement bounds (``self/displacement_bounds.py``).  A vertex beyond its bound causes its gap constraints to be evaluated
   (``self/gap_constraints.py``), or a query (``self/query.py``): which pairs are close (``self/near_pairs.py``,
   ``self/far_pairs.py``), and how far each vertex may move from here (``self/narrow_phase.py``).

Once a control step anchors and grippers are stopped at solids (``solids/attachment_contact.py``).

The guarantee of ``self_collision="strict"``: a sheet that starts without intersections has none at the end of any substep.  It
holds for whatever the forces, the strain limiter, the solids and the grippers do; in float32 within 16 m of the origin.  A least
thickness is not promised, nor that a start with intersections is untangled.
"""

from clothgym.collisions.self.owner import SelfCollision, SelfContacts
from clothgym.collisions.solids.attachment_contact import AT_SURFACE, keep_out, probe_of, stop_at_solids
from clothgym.collisions.solids.mesh_collider import MeshCollider
from clothgym.collisions.solids.owner import Solid, Solids
from clothgym.collisions.solids.penetration import Contacts
from clothgym.collisions.solids.shapes import Box, Capsule, Collider, Plane, Sphere

__all__ = [
    "AT_SURFACE",
    "Box",
    "Capsule",
    "Collider",
    "Contacts",
    "MeshCollider",
    "Plane",
    "SelfCollision",
    "SelfContacts",
    "Solid",
    "Solids",
    "Sphere",
    "keep_out",
    "probe_of",
    "stop_at_solids",
]  # fmt: skip

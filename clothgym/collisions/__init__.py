"""Floor 4: solids that the cloth touches, and what happens there."""

from clothgym.collisions.blocking import keep_out, stop_at_solids
from clothgym.collisions.distance import DESK
from clothgym.collisions.mesh_collider import MeshCollider
from clothgym.collisions.response import Contacts, resolve
from clothgym.collisions.shapes import ROWS, Box, Capsule, Collider, Plane, Sphere
from clothgym.collisions.solids import Solids
from clothgym.collisions.surface import room_for_touches

__all__ = [
    "DESK", "ROWS", "Box", "Capsule", "Collider", "Contacts", "MeshCollider", "Plane", "Solids", "Sphere", "keep_out", "resolve",
    "room_for_touches", "stop_at_solids",
]  # fmt: skip

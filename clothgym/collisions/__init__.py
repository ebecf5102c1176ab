"""Floor 4: solids that the cloth touches, and what happens there."""

from clothgym.collisions.distance import DESK
from clothgym.collisions.mesh_collider import MeshCollider
from clothgym.collisions.response import Contacts, resolve
from clothgym.collisions.shapes import Box, Capsule, Collider, Plane, Sphere
from clothgym.collisions.solids import Solids
from clothgym.collisions.surface import room_for_touches

__all__ = [
    "DESK", "Box", "Capsule", "Collider", "Contacts", "MeshCollider", "Plane", "Solids", "Sphere", "resolve", "room_for_touches",
]  # fmt: skip

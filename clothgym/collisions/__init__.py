"""Floor 4: what the cloth touches, solids and itself, and what happens there."""

from clothgym.collisions.blocking import keep_out, stop_at_solids
from clothgym.collisions.distance import DESK
from clothgym.collisions.intersections import count_intersections
from clothgym.collisions.mesh_collider import MeshCollider
from clothgym.collisions.response import Contacts
from clothgym.collisions.self_contact import SelfCollision, SelfContacts
from clothgym.collisions.shapes import ROWS, Box, Capsule, Collider, Plane, Sphere
from clothgym.collisions.solids import Solids

__all__ = [
    "DESK", "ROWS", "Box", "Capsule", "Collider", "Contacts", "MeshCollider", "Plane", "SelfCollision", "SelfContacts", "Solids",
    "Sphere", "count_intersections", "keep_out", "stop_at_solids",
]  # fmt: skip

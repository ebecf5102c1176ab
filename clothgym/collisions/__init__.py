"""Floor 4: solids that the cloth touches, and what happens there."""

from clothgym.collisions.response import Contacts, resolve
from clothgym.collisions.shapes import Box, Capsule, Collider, Plane, Sphere
from clothgym.collisions.solids import Solids

__all__ = ["Box", "Capsule", "Collider", "Contacts", "Plane", "Solids", "Sphere", "resolve"]

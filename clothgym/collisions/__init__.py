"""Floor 4: solids that the cloth touches, and what happens there."""

from clothgym.collisions.response import Contacts, resolve, signed_distances
from clothgym.collisions.shapes import ROWS, Box, Capsule, Collider, Plane, Sphere

__all__ = ["ROWS", "Box", "Capsule", "Collider", "Contacts", "Plane", "Sphere", "resolve", "signed_distances"]

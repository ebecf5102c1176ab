"""Floor 4: solids that the cloth touches, and what happens there."""

from clothgym.collisions.response import Contacts, contacts, resolve
from clothgym.collisions.shapes import ROWS, Box, Capsule, Collider, Plane, Sphere, check_replacement

__all__ = ["ROWS", "Box", "Capsule", "Collider", "Contacts", "Plane", "Sphere", "check_replacement", "contacts", "resolve"]

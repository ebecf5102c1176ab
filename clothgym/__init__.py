"""Cloth that is fast enough to learn on: a batched mass-spring core under Gymnasium environments, on the CPU.

``import clothgym`` registers the environments and loads nothing else; the core's names are loaded when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from clothgym import folders
from clothgym.registration import register

if TYPE_CHECKING:
    from clothgym import evaluation as evaluation
    from clothgym import garments as garments
    from clothgym import policies as policies
    from clothgym.attachments import Gripper as Gripper
    from clothgym.collisions import Box as Box
    from clothgym.collisions import Capsule as Capsule
    from clothgym.collisions import MeshCollider as MeshCollider
    from clothgym.collisions import Plane as Plane
    from clothgym.collisions import Sphere as Sphere
    from clothgym.garments import load_garment as load_garment
    from clothgym.integrators import INTEGRATORS as INTEGRATORS
    from clothgym.material import Material as Material
    from clothgym.mesh import ClothMesh as ClothMesh
    from clothgym.mesh import grid as grid
    from clothgym.simulation import Simulation as Simulation
    from clothgym.state import State as State
    from clothgym.triangles import disc as disc
    from clothgym.triangles import load_mesh as load_mesh
    from clothgym.triangles import triangle_mesh as triangle_mesh
    from clothgym.wind import Wind as Wind

__version__ = "0.1.0"

_HOMES = {
    "Box": "clothgym.collisions",
    "Capsule": "clothgym.collisions",
    "ClothMesh": "clothgym.mesh",
    "Gripper": "clothgym.attachments",
    "INTEGRATORS": "clothgym.integrators",
    "Material": "clothgym.material",
    "MeshCollider": "clothgym.collisions",
    "Plane": "clothgym.collisions",
    "Simulation": "clothgym.simulation",
    "Sphere": "clothgym.collisions",
    "State": "clothgym.state",
    "Wind": "clothgym.wind",
    "disc": "clothgym.triangles",
    "grid": "clothgym.mesh",
    "load_garment": "clothgym.garments",
    "load_mesh": "clothgym.triangles",
    "triangle_mesh": "clothgym.triangles",
}
# packages that are loaded when first used, too
_PACKAGES = ("adapters", "collisions", "envs", "evaluation", "garments", "integrators", "policies", "render", "starts")

__all__ = [*_HOMES, "policies"]


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"clothgym.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'clothgym' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted([*_HOMES, *_PACKAGES, "__version__"])


folders.keep()
register()

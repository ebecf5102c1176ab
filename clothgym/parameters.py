"""Floor 2: the material properties of each environment, and the arrays for kernels that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import finite, known, spread
from clothgym.material import Material, spring_stiffness
from clothgym.mesh import ClothMesh

AIR_DENSITY = 1.2  # [kg/m^3]
PROPERTIES = (
    "density", "stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time",
    "drag_coefficient", "skin_friction", "air_drag",
)  # fmt: skip
FIELDS = ("gravity", "wind")
SIZES = 0.8, 1.25  # smallest and largest factor on the lengths of a mesh: the thickness of contact is that of the mesh


def of_material(material: Material) -> NDArray[np.float64]:
    """A fabric's properties, in the order of ``PROPERTIES``, (properties,)."""
    return np.array([getattr(material, name) for name in PROPERTIES])


def check_properties(material: Material, parameters: NDArray) -> None:
    """Refuse properties, (envs, properties), that ``Material`` would not accept.

    Raises:
        ValueError: names the property, its value, and the valid values.
    """
    for row in np.unique(parameters, axis=0):
        replace(material, **dict(zip(PROPERTIES, row.tolist())))


def changed(
    material: Material, parameters: NDArray, changes: Mapping[str, Any]
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Properties with some of them changed, (envs, properties); and the fields among the changes, (envs, 3), and sizes, (envs,).

    Raises:
        ValueError: an unknown name, or a value that ``Material`` would not accept.
    """
    parameters = parameters.copy()
    fields: dict[str, NDArray[np.float64]] = {}
    for name, value in changes.items():
        known("parameter", name, (*PROPERTIES, *FIELDS, "size"))
        if name in PROPERTIES:
            values = spread(name, finite(name, value), (len(parameters),))
            for one in np.unique(values):
                replace(material, **{name: float(one)})  # type: ignore[arg-type]
            parameters[:, PROPERTIES.index(name)] = values
        elif name == "size":
            fields[name] = checked_size(spread(name, finite(name, value), (len(parameters),)))
        else:
            fields[name] = spread(name, finite(name, value), (len(parameters), 3))
    return parameters, fields


def checked_size(size: NDArray) -> NDArray[np.float64]:
    """Sizes of sheets, as factors on the lengths of their mesh.

    Raises:
        ValueError: one beyond ``SIZES``.
    """
    low, high = SIZES
    for one in size[~((size >= low) & (size <= high))].tolist():
        raise ValueError(f"size={one!r}: must be from {low:g} to {high:g}, as a factor on the mesh's lengths; or make another mesh")
    return size


def fabric_rows(
    mesh: ClothMesh, parameters: NDArray, size: NDArray, hinged: bool, isotropic: bool, air_density: float
) -> dict[str, NDArray[np.float64]]:
    """The arrays of a ``state.Fabric`` without the fields, (envs, ...), from properties on a mesh, (envs, properties).

    hinged, isotropic: of the model of bending, see ``bending.Bending``; without hinges skip springs resist.  size: factors on the
    mesh's lengths, (envs,).  All arrays are for elements of the mesh as it is: the coefficients of skip springs and of the
    quadratic model fall with the square of the size, and the mass of a triangle grows with that square.  air_density: [kg/m^3].

    Raises:
        ValueError: no spring network on this mesh has these moduli.
    """
    density, stretch, shear, bend, damping_time, drag_coefficient, skin_friction, air_drag = parameters.T
    return {
        "stiffness": spring_stiffness(mesh, stretch, shear, 0 * bend if hinged else bend / size**2).T,
        "rigidity": (bend / size**2 if isotropic else bend) if hinged else 0 * bend,
        "damping_time": damping_time,
        "drag_rate": air_drag / density,
        "resistance": np.stack([drag_coefficient * air_density / 2, skin_friction * air_density / 2, density * size**2], axis=1),
    }


def inverse_masses(mesh: ClothMesh, parameters: NDArray, size: NDArray) -> NDArray[np.float64]:
    """Inverse masses of the particles without attachments [1/kg], (envs, particles); size: see ``fabric_rows``."""
    return 1 / (parameters[:, PROPERTIES.index("density"), None] * (size**2)[:, None] * mesh.area)

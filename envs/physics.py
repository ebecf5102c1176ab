"""What an id fixes, and the ranges of fabrics that may be drawn within it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clothgym.attachments import Gripper
from clothgym.checks import count, finite, number, one_of, positive, shown, warn
from clothgym.guards import not_flat, refusal
from clothgym.integrators import Integrator
from clothgym.material import PRESETS, Material, spring_stiffness
from clothgym.mesh import ClothMesh, grid
from clothgym.parameters import AIR_DENSITY, PROPERTIES
from clothgym.simulation import Simulation
from clothgym.wind import Wind

PHYSICS = ("true", "fast")
Held = tuple[int | tuple[int, ...], ...]  # particles that anchors hold, as ``Simulation`` takes them
ROWS, SIDES = (5, 49), (0.1, 1.0)  # that can be chosen: finer sheets take minutes to come to rest; in the tasks' arenas [m]
# the short cuts of most benchmarks
SHORT_CUTS: dict[str, Any] = {"contact": "particles", "self_collision": False, "bending": "springs"}
MEDIAN = Material.preset("median")
MEDIAN = replace(MEDIAN, air_drag=2 * MEDIAN.density)  # 2 per second, the middle of what was found for filmed cloth
MEASURED = ("density", "stretch_stiffness", "shear_stiffness", "bend_rigidity")  # what presets take from measurements


@dataclass(frozen=True)
class Physics:
    """What an id fixes.

    Attributes:
        mesh, material: the sheet and its fabric.
        time_step: control step [s].
        integrator, substeps: how it is advanced; substeps as ``Simulation`` takes them.
        attachment_speed: speed limit of anchors and grippers [m/s].
        anchors, grippers: see ``Simulation``; anchors may be a function of the mesh, so that its resolution can be chosen.
        air_density: [kg/m^3].
        wind: what the air does, unless the environment's keyword says otherwise.
        contact, self_collision, bending: as ``Simulation`` takes them.  Of a sheet that is not flat at rest hinges resist the
            bending, and a warning says so, unless an environment's keyword names another model.
        fast: changes of physics="fast" in addition to ``SHORT_CUTS``.
    """

    mesh: ClothMesh
    material: Material
    time_step: float
    integrator: str
    substeps: int | Literal["auto"]
    attachment_speed: float
    anchors: Held | Callable[[ClothMesh], Held] = ()
    grippers: tuple[Gripper, ...] = ()
    air_density: float = AIR_DENSITY
    wind: Wind | None = None
    contact: str = "sheet"
    self_collision: Any = "strict"
    bending: str = "quadratic"
    fast: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.mesh, ClothMesh) and not self.mesh.flat and self.bending != "hinge":
            warn(f"{not_flat(self.mesh)}: bending='hinge' is chosen in place of {self.bending!r}, which is for flat ones")
            object.__setattr__(self, "bending", "hinge")

    def chosen(self, name: str) -> Physics:
        """This, "true"; or "fast", with the short cuts that most benchmarks take.

        True: the whole sheet is in contact with solids and, strictly, with itself, and the sheet bends with its rigidity.  Fast:
        solids touch particles alone, the sheet passes through itself, skip springs, which have no rigidity in the flat state, stand
        for bending, and what the id has in ``fast``.

        Raises:
            ValueError: another name.
        """
        one_of("physics", name, *PHYSICS)
        return self if name == "true" else replace(self, **SHORT_CUTS, **self.fast)

    def with_sheet(self, rows: int | None, side: float | None) -> Physics:
        """This with a grid of so many rows, whose longer side is so long [m]; None: its own.  Substeps become automatic.

        Raises:
            ValueError: no such sheet, or the mesh is no grid, or its anchors are given as particles of this mesh alone.
        """
        # both are numbers before they are compared: an array has no truth value
        rows = None if rows is None else count("rows", rows, least=1)
        side = None if side is None else positive("side", side)
        if rows in (None, *(self.mesh.shape or ())[:1]) and side in (None, self.side):
            return self
        if self.mesh.shape is None or (self.anchors and not callable(self.anchors)):
            raise ValueError(
                f"rows={shown(rows)}, side={shown(side)}: this task has one mesh; leave them out, or make its mesh a grid, and "
                "Physics.anchors a function of the mesh"
            )
        (own_rows, columns), size = self.mesh.shape, self.mesh.size
        number_of_rows = own_rows if rows is None else count("rows", rows, least=ROWS[0], most=ROWS[1])
        longer = self.side if side is None else positive("side", side)
        if not SIDES[0] <= longer <= SIDES[1]:
            raise ValueError(f"side={shown(side)}: must be from {SIDES[0]} to {SIDES[1]} m, for which the tasks have room")
        across = round((columns - 1) * (number_of_rows - 1) / (own_rows - 1)) + 1
        width, height = (length * longer / self.side for length in size)
        return replace(self, mesh=grid(number_of_rows, across, width, height), substeps="auto")

    @property
    def side(self) -> float:
        """The sheet's longer side [m]."""
        return max(self.mesh.size)

    @property
    def held(self) -> Held:
        """Particles of this mesh that anchors hold."""
        return self.anchors(self.mesh) if callable(self.anchors) else self.anchors


def chosen_fabric(fabric: Any, own: Material) -> Material:
    """The fabric that someone asks for: a ``Material`` as it is; a preset's measured properties by name; None for the task's own.

    What presets do not measure, damping and what concerns the air, stays the task's.

    Raises:
        ValueError: it is neither, or no preset has that name.
    """
    if fabric is None or isinstance(fabric, Material):
        return own if fabric is None else fabric
    if not isinstance(fabric, str):
        raise ValueError(f"fabric={shown(fabric)}: must be a Material or a preset's name ({', '.join(PRESETS)})")
    return replace(own, **preset_properties(fabric), source=Material.preset(fabric).source)  # type: ignore[arg-type]


def preset_properties(name: str) -> dict[str, float]:
    """The measured properties of a preset."""
    preset = Material.preset(name)
    return {measured: getattr(preset, measured) for measured in MEASURED}


def checked_ranges(ranges: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Ranges of material properties, as pairs of floats.

    Raises:
        ValueError: a range whose ends ``Material`` does not take.
    """
    checked = {}
    for name, bounds in ranges.items():
        pair = finite(f"randomize: {name}", bounds)
        if pair.shape != (2,) or pair[0] > pair[1]:
            raise ValueError(f"randomize: {name}={shown(bounds)} must be a range [low, high] of finite numbers")
        low, high = pair.tolist()
        for bound in (low, high):
            Material(**{name: bound})  # type: ignore[arg-type]
        checked[name] = low, high
    return checked


def checked_wind(properties: Mapping[str, Any]) -> Wind:
    """A wind with these properties.

    Raises:
        ValueError: an unknown property, or one that makes no wind.
    """
    known = [field.name for field in fields(Wind)]
    if not isinstance(properties, Mapping):
        raise ValueError(f"wind={shown(properties)}: must be a dict with any of {', '.join(known)}")
    for name in properties:
        if name not in known:
            raise ValueError(f"wind: no property {name!r} (there are: {', '.join(known)})")
    return Wind(**properties)


def check_ranges(physics: Physics, ranges: Mapping[str, tuple[float, float]], integrator: Integrator, smallest: float) -> None:
    """Refuse ranges that the integrator or the sheet cannot have; smallest: size of a sheet, a factor."""
    if physics.mesh.shape is None and "shear_stiffness" in ranges:
        raise ValueError("randomize: shear_stiffness has no effect on a sheet of triangles; give a range of stretch_stiffness")
    for name in ranges:
        if name in integrator.shared | integrator.ignored:
            raise ValueError(f"randomize: {refusal(integrator, name)}")
    check_springs_exist(physics, ranges, smallest)


def check_springs_exist(physics: Physics, ranges: Mapping[str, tuple[float, float]], smallest: float) -> None:
    """Refuse ranges of which some corner is a fabric that no spring network on this sheet, or on the smallest, has."""
    if not ranges and smallest == 1:
        return
    values = [sorted(set(ranges.get(name, (getattr(physics.material, name),)))) for name in PROPERTIES]
    for corner in product(*values):
        fabric = Material(**dict(zip(PROPERTIES, corner)))
        stretch, shear, bend = fabric.stretch_stiffness, fabric.shear_stiffness, fabric.bend_rigidity
        spring_stiffness(physics.mesh, np.array(stretch), np.array(shear), np.array(bend) / min(smallest, 1.0) ** 2)


def checked_material_option(
    material: Any, physics: Physics, ranges: Mapping[str, tuple[float, float]], simulation: Simulation, smallest: float
) -> dict[str, float]:
    """Properties of one episode's fabric, given as such or by a preset's name; ranges: of those that are drawn; smallest: size.

    Raises:
        ValueError: they are none that an episode can have.
    """
    if isinstance(material, str):
        material = preset_properties(material)
        if physics.mesh.shape is None:
            del material["shear_stiffness"]  # which a triangle mesh has from its edges
    if not isinstance(material, Mapping):
        raise ValueError(
            f"reset option material={shown(material)}: must be a preset's name ({', '.join(PRESETS)}) or a dict of properties"
        )
    method, plain = simulation.integrator, {}
    for name, value in material.items():
        if name not in PROPERTIES:
            raise ValueError(f"reset option material: no property {name!r} (there are: {', '.join(PROPERTIES)})")
        plain[name] = number(f"reset option material: {name}", value)
        if name in method.ignored or (name in method.shared and simulation.num_envs > 1):
            raise ValueError(f"reset option material: {refusal(method, name)}")
    check_springs_exist(physics, {**ranges, **{name: (value, value) for name, value in plain.items()}}, smallest)
    return plain


def most_demanding(material: Material, ranges: Mapping[str, tuple[float, float]]) -> Material:
    """The fabric of the ranges that needs the smallest substeps: as light, stiff and damped as can be drawn."""
    properties = {name: getattr(material, name) for name in PROPERTIES}
    for name, (low, high) in ranges.items():
        properties[name] = low if name == "density" else high
    return replace(material, **properties)  # type: ignore[arg-type]


def settled(physics: Physics, start: NDArray, seconds: float) -> NDArray:
    """The sheet of an id at rest under its anchors [m], (particles, 3): a strongly damped simulation in still air."""
    cloth = Simulation(
        physics.mesh, physics.material, integrator=physics.integrator, time_step=physics.time_step, substeps=physics.substeps,
        anchors=physics.held, air_density=0, bending=physics.bending, threads=1,
        self_collision=physics.self_collision,
    )  # fmt: skip
    cloth.set_parameters(air_drag=1.0)
    cloth.reset(positions=start)
    cloth.step(round(seconds / physics.time_step))
    return cloth.positions[0].astype(np.float64)

"""Scenes and settings: a sheet, what holds and moves it, and what a visitor can change."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clothgym import integrators
from clothgym.bending import BENDING
from clothgym.checks import count, known, not_negative, one_of
from clothgym.collisions import Collider, Plane
from clothgym.limiting import checked_limit
from clothgym.material import Material
from clothgym.mesh import ClothMesh
from clothgym.render import Camera, Drawn
from clothgym.render.solids import WARM_GRAY, drawn
from clothgym.simulation import GRAVITY, Simulation

FRAME = 1 / 60  # control step [s]
Vector = tuple[float, float, float]
SLIDERS = ("stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time", "air_drag")  # of the fabric, by slider
# sliders: setting, label, largest value, step, the slider's unit in that of the setting, and a hint
WORLD = (
    ("gravity", "gravity m/s²", GRAVITY, 0.01, 1.0, "pull it: from none to that of the Earth"),
    ("wind", "wind m/s", 12.0, 0.1, 1.0, "how fast the air moves; gusts come on top"),
    ("gust", "gusts m/s", 4.0, 0.1, 1.0, "how much the wind changes: root mean square of each component"),
    ("friction", "friction", 1.0, 0.01, 1.0, "of solids, and of the sheet on itself: Coulomb's coefficient"),
)
CLOTH = (
    ("stretch_stiffness", "stretch stiffness N/m", 2000.0, 1.0, 1.0, "of its threads: Young's modulus times thickness"),
    (
        "shear_stiffness",
        "shear stiffness N/m",
        1000.0,
        1.0,
        1.0,
        "along its diagonals: shear modulus times thickness",
    ),
    ("bend_rigidity", "bending stiffness µN m", 200.0, 0.1, 1e-6, "plate rigidity"),
    ("damping_time", "damping ms", 5.0, 0.01, 1e-3, "retardation time of every spring"),
    ("air_drag", "air drag N s/m³", 3.0, 0.01, 1.0, "linear drag, which damps swinging"),
    ("strain_limit", "strain limit %", 30.0, 0.5, 1e-2, "largest strain, enforced by a strain limiter; zero for none"),
)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All that a visitor can change while it runs.

    Attributes:
        gravity: downwards [m/s^2].
        wind: speed of its steady part [m/s], and gust, the root mean square of each of the gusts' components [m/s].
        fabric: a name of ``material.PRESETS``, for the properties that are not given.
        stretch_stiffness, shear_stiffness, bend_rigidity, damping_time, air_drag: see ``Material``.
        friction: of the solids, and of the sheet on itself.
        integrator, bending, strain_limit, self_collision, substeps: see ``Simulation``; self_collision is "off",
            "fast" or "strict".

    Raises:
        ValueError: an invalid value; the message names it and what is valid.
    """

    gravity: float = GRAVITY
    wind: float = 0.0
    gust: float = 0.0
    fabric: str = "penava_cotton"
    stretch_stiffness: float | None = None
    shear_stiffness: float | None = None
    bend_rigidity: float | None = None
    damping_time: float | None = None
    air_drag: float | None = None
    friction: float = 0.4
    integrator: str = "semi_implicit_euler"
    bending: str = "springs"
    strain_limit: float | None = None
    self_collision: str = "off"
    substeps: int | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        for name in ("gravity", "wind", "gust", "friction"):
            not_negative(name, getattr(self, name))
        integrators.get(self.integrator)
        one_of("bending", self.bending, *BENDING)
        one_of("self_collision", self.self_collision, "off", "fast", "strict")
        checked_limit(self.strain_limit)
        if self.substeps != "auto":
            count("substeps", self.substeps, "'auto' or ")
        fabric = Material.preset(self.fabric)
        for name in SLIDERS:
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(fabric, name))
        self.material  # noqa: B018 - an invalid fabric is refused here

    @property
    def material(self) -> Material:
        return Material.preset(self.fabric, **{name: getattr(self, name) for name in SLIDERS})

    def changed(self, **changes: Any) -> Settings:
        """A copy with some settings changed; another fabric brings all its properties except the drag of the air.

        Raises:
            ValueError: an unknown name, or an invalid value.
        """
        for name in changes:
            known("setting", name, [item.name for item in fields(self)])
        if "fabric" in changes and changes["fabric"] != self.fabric:
            changes = {name: None for name in SLIDERS if name != "air_drag"} | changes
        return replace(self, **changes)


def number_within(label: str, value: Any, low: float, high: float) -> float:
    """A number that a browser has sent, clipped to its control's range.

    Raises:
        ValueError: it is not finite, or no number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{label}={str(value)[:20]}: must be a number from {low:g} to {high:g}")
    return min(max(number, low), high)


Targets = Mapping[int, NDArray]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A sheet and its world.

    Attributes:
        name: by which it is chosen; title: by which it is shown.
        about: what there is to see and to try, as a sentence.
        mesh: the sheet at rest; ``start``: initial positions [m], (particles, 3).
        settings: at the start.
        anchors: particles, or patches of them, that can be held; ``names`` of them; those ``held`` at first.
        handles: anchors that can be dragged.
        colliders: solids that the sheet feels; ``scenery``: solids that are drawn besides.
        colors: of the colliders that are drawn, by number.
        motion: where anchors are to be at a time [s], (anchors, 3) [m], and colliders, by number; None where nothing moves.
        rests: time at which moving anchors are released [s].
        camera: its view.
        strained: strain at which the color scale ends.
        downwind: where the steady wind blows, a unit vector.
    """

    name: str
    title: str
    about: str
    mesh: ClothMesh
    start: NDArray
    settings: Settings
    camera: Camera
    anchors: tuple[int | tuple[int, ...], ...] = ()
    names: tuple[str, ...] = ()
    held: tuple[int, ...] = ()
    handles: tuple[int, ...] = ()
    colliders: tuple[Collider, ...] = ()
    colors: Mapping[int, tuple[int, int, int]] = field(default_factory=dict)
    scenery: tuple[Drawn, ...] = ()
    motion: Callable[[float], tuple[NDArray, Targets]] | None = None
    rests: float = np.inf
    strained: float = 0.05
    downwind: Vector = (1.0, 0.0, 0.0)

    def simulation(self, settings: Settings | None = None, **options: Any) -> Simulation:
        """The scene at its start, with its own settings or others; options: of ``Simulation``, in place of theirs."""
        given = self.settings if settings is None else settings
        apart = {"mode": given.self_collision, "friction": given.friction}
        chosen: dict[str, Any] = {
            "integrator": given.integrator,
            "time_step": FRAME,
            "substeps": given.substeps,
            "gravity": (0, 0, -given.gravity),
            "colliders": [replace(c, friction=given.friction) for c in self.colliders],
            "anchors": self.anchors,
            "bending": given.bending,
            "strain_limit": given.strain_limit,
            "self_collision": given.self_collision != "off" and apart,
            "on_divergence": "ignore",
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # substeps beyond a bound are part of the show
            s = Simulation(self.mesh, given.material, **(chosen | options))
        begin(s, self)
        return s

    def solids(self, simulation: Simulation | None = None) -> list[Drawn]:
        """What is drawn beside the sheet and the floor: the solids where they are now, or at first."""
        visible = [
            (number, drawn((collider, self.colors.get(number, WARM_GRAY))))
            for number, collider in enumerate(self.colliders)
            if not isinstance(collider, Plane)
        ]
        if simulation is None:
            return [*(solid for _, solid in visible), *self.scenery]
        places = simulation.collider_positions[0]
        return [*(solid.at(places[number]) for number, solid in visible), *self.scenery]


def begin(simulation: Simulation, scene: Scene, seed: int | None = None) -> None:
    """Reset a scene's simulation to its start; a seed displaces the free particles by about a thousandth of a spacing."""
    x = scene.start.copy()
    if seed is not None:
        held = [particle for anchor in scene.held for particle in np.atleast_1d(scene.anchors[anchor])]
        noise = np.random.default_rng(seed).normal(scale=1e-3 * scene.mesh.springs.rest_length.min(), size=x.shape)
        noise[held] = 0
        x += noise
    simulation.reset(positions=x)
    free = [anchor for anchor in range(len(scene.anchors)) if anchor not in scene.held]
    if free:
        simulation.release([0] * len(free), free)


def drive(simulation: Simulation, scene: Scene, time: float, others: Targets | None = None) -> None:
    """Move a scene's anchors and solids to their targets for a time [s]; others: targets of dragged anchors, by number [m]."""
    targets = simulation.attachment_positions[:, : len(scene.anchors)]
    if scene.motion is not None and time <= scene.rests:
        targets[0], solids = scene.motion(time)
        for number, place in solids.items():
            simulation.move_colliders(number, targets=place)
    for anchor, place in (others or {}).items():
        targets[0, anchor] = place
    if targets.size:
        simulation.move_anchors(targets)
    if scene.rests < time <= scene.rests + FRAME:
        simulation.release([0] * len(scene.held), scene.held)

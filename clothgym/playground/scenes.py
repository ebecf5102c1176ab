"""Scenes and settings: a sheet, what holds and moves it, and what a visitor can change."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clothgym import integrators
from clothgym.bending import BENDING
from clothgym.checks import count, known, not_negative, one_of
from clothgym.collisions import Box, Capsule, Collider, MeshCollider, Plane, Sphere
from clothgym.limiting import checked_limit
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid
from clothgym.render import Camera, Drawn
from clothgym.render.solids import WARM_GRAY, drawn
from clothgym.simulation import GRAVITY, Simulation

FRAME = 1 / 60  # control step [s]
Vector = tuple[float, float, float]
SLIDERS = ("stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time", "air_drag")  # of the fabric, by slider
# sliders: setting, label, largest value, step, the slider's unit in that of the setting, and a hint
WORLD = (
    ("gravity", "Gravity, m/s²", GRAVITY, 0.01, 1.0, "pull it: from none to that of the Earth"),
    ("wind", "Wind, m/s", 12.0, 0.1, 1.0, "how fast the air moves; gusts come on top"),
    ("gust", "Gusts, m/s", 4.0, 0.1, 1.0, "how much the wind changes: root mean square of each component"),
    ("friction", "Friction", 1.0, 0.01, 1.0, "of solids, and of the sheet on itself: Coulomb's coefficient"),
)
CLOTH = (
    ("stretch_stiffness", "Stretch stiffness, N/m", 2000.0, 1.0, 1.0, "of its threads: Young's modulus times thickness"),
    ("shear_stiffness", "Shear stiffness, N/m", 1000.0, 1.0, 1.0, "along its diagonals: shear modulus times thickness"),
    ("bend_rigidity", "Bending stiffness, µN m", 200.0, 0.1, 1e-6, "plate rigidity"),
    ("damping_time", "Damping, ms", 5.0, 0.01, 1e-3, "retardation time of every spring"),
    ("air_drag", "Air drag, N s/m³", 3.0, 0.01, 1.0, "linear drag, which damps swinging"),
    ("strain_limit", "Strain limit, %", 30.0, 0.5, 1e-2, "largest strain, enforced by a strain limiter; zero for none"),
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
        ValueError: an invalid value; the message names it and the valid values.
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
    self_collision: str = "fast"
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


# names that are no words
TITLED = {
    "rk4": "Runge-Kutta 4", "pbd": "PBD", "xpbd": "XPBD", "penava_cotton": "Cotton", "cotton": "Cotton, broadcloth",
    "cotton_broad": "Cotton, broadcloth", "polyester_tropical": "Polyester, tropical", "polyester_faille": "Polyester, faille",
    "wool_tropical": "Wool, tropical", "median": "Median of 618 fabrics", "explicit_euler": "Explicit Euler",
    "implicit_euler": "Implicit Euler", "semi_implicit_euler": "Semi-implicit Euler",
    "off": "Ignored", "fast": "Fast", "strict": "Strict: never passes through", "noop": "Nobody", "expert": "Scripted expert",
    "random": "Random actions", "bc": "behavior cloning", "bc_ppo": "behavior cloning, then PPO", "ppo": "PPO",
    "ppo_lagrange": "PPO with a Lagrange multiplier", "sac": "SAC from expert episodes", "sac_scratch": "SAC from scratch",
}  # fmt: skip


def titled(name: str) -> str:
    """A name of the code as a person would write it."""
    own = TITLED.get(name)
    if own is None and name.startswith("learned, "):
        return f"Learned: {titled(name.removeprefix('learned, '))}"
    return own or name.replace("_", " ").capitalize()


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
        about: what there is to see and to try, as a sentence.
        mesh: the sheet at rest; ``start``: initial positions [m], (particles, 3).
        settings: at the start.
        anchors: particles, or patches of them, that are held at first.
        colliders: solids that the sheet feels; ``scenery``: solids that are drawn besides.
        colors: of the colliders that are drawn, by number.
        motion: where anchors are to be at a time [s], (anchors, 3) [m], and colliders, by number; None where nothing moves.
        rests: time at which moving anchors are released [s].
        camera: its view.
        strained: strain at which the color scale ends.
        downwind: where the steady wind blows, a unit vector.
    """

    about: str
    mesh: ClothMesh
    start: NDArray
    settings: Settings
    camera: Camera
    anchors: tuple[int | tuple[int, ...], ...] = ()
    colliders: tuple[Collider, ...] = ()
    colors: Mapping[int, tuple[int, int, int]] = field(default_factory=dict)
    scenery: tuple[Drawn, ...] = ()
    motion: Callable[[float], tuple[NDArray, Targets]] | None = None
    rests: float = np.inf
    strained: float = 0.1
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

    def solids(self, simulation: Simulation) -> list[Drawn]:
        """Drawn objects other than the sheet and the floor: the solids at their present poses, and the scenery."""
        places = simulation.collider_positions[0]
        solids = [
            drawn((collider, self.colors.get(number, WARM_GRAY))).at(places[number])
            for number, collider in enumerate(self.colliders)
            if not isinstance(collider, Plane)
        ]
        return [*solids, *self.scenery]


def begin(simulation: Simulation, scene: Scene, seed: int | None = None) -> None:
    """Reset a scene's simulation to its start; a seed displaces the free particles by about a thousandth of a spacing."""
    x = scene.start.copy()
    if seed is not None:
        held = [particle for anchor in scene.anchors for particle in np.atleast_1d(anchor)]
        noise = np.random.default_rng(seed).normal(scale=1e-3 * scene.mesh.springs.rest_length.min(), size=x.shape)
        noise[held] = 0
        x += noise
    simulation.reset(positions=x)


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
        simulation.release()


# --- the gallery ------------------------------------------------------------------------------------------------------


STEEL, OAK, CLAY, SAGE = (112, 118, 130), (190, 156, 116), (186, 136, 112), (148, 166, 150)  # colors of solids
BREATH = 0.7, 0.2  # steady wind that keeps a weightless sheet spread, and gusts that ripple it [m/s]
RIPPLE = 0.001  # [m]
PINNED = 0.75  # distance of two pins of a sheet, relative to its width: between them it hangs in folds
SWING_DRAG = 0.75  # linear drag that damps slow swinging [N s/m^3]


def turned_on_a_lathe(profile: NDArray, segments: int = 40) -> tuple[NDArray, NDArray]:
    """The solid of revolution of a profile of radii and heights [m], (points, 2), from the axis below to the axis above: vertices
    [m], (vertices, 3), and triangles, (triangles, 3), counter-clockwise seen from outside."""
    angles = np.arange(segments) * 2 * np.pi / segments
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    inner = profile[1:-1]
    rings = np.concatenate([inner[:, None, :1] * ring, np.broadcast_to(inner[:, None, 1:], (len(inner), segments, 1))], axis=2)
    poles = [(0.0, 0.0, profile[0, 1]), (0.0, 0.0, profile[-1, 1])]
    vertices = np.concatenate([rings.reshape(-1, 3), poles])
    k, after = np.arange(segments), np.roll(np.arange(segments), -1)
    triangles = []
    for row in range(len(inner) - 1):
        a, b = row * segments, (row + 1) * segments
        triangles += [np.stack([a + k, a + after, b + after], 1), np.stack([a + k, b + after, b + k], 1)]
    bottom, top, last = len(vertices) - 2, len(vertices) - 1, (len(inner) - 1) * segments
    triangles.append(np.stack([np.full(segments, bottom), after, k], 1))
    triangles.append(np.stack([np.full(segments, top), last + k, last + after], 1))
    return vertices, np.concatenate(triangles)


def pawn(height: float = 0.5) -> tuple[NDArray, NDArray]:
    """A chess pawn that stands on z = 0: vertices [m] and triangles."""
    angles = np.linspace(-0.3, 0.5, 11)[:-1] * np.pi
    ball = np.stack([0.16 * np.cos(angles), 0.84 + 0.16 * np.sin(angles)], axis=1)
    rise = np.linspace(0, 1, 8)
    waist = np.stack([0.12 + 0.2 * (1 - rise) ** 2, 0.2 + 0.42 * rise], axis=1)
    foot = np.array([(0, 0), (0.36, 0), (0.38, 0.04), (0.36, 0.12), (0.33, 0.15)])
    collar = np.array([(0.2, 0.64), (0.21, 0.665), (0.2, 0.69)])
    return turned_on_a_lathe(height * np.concatenate([foot, waist, collar, ball, [(0, 1)]]))


# --- what moves ---------------------------------------------------------------------------------------------------------


def walk(time: float) -> tuple[NDArray, float]:
    """Position [m], (3,), and heading [rad] of a person who walks a figure of eight, and starts slowly."""
    phase = 0.9 * (time - 1.2 * (1 - np.exp(-time / 1.2)))
    place = np.array([0.5 * np.sin(phase), 0.22 * np.sin(2 * phase), 0.012 * np.sin(8 * phase)])
    facing = np.arctan2(0.44 * np.cos(2 * phase), 0.5 * np.cos(phase))
    return place, float(facing)


COLLAR = np.linspace(-1.1, 1.1, 9)  # angles of the cape's anchors about the neck, from the back [rad]
SHOULDERS, HEM, NECK = 0.15, 0.34, 1.1  # radii of the cape at the collar and at the hem, and the height of the collar [m]
# of the figure: centers with the heading along x [m], and radius and height of a capsule each [m]; the head is a sphere
TORSO, HEAD, ARM, LEG = (0.0, 0.8, 0.135, 0.7), (0.0, 1.245, 0.105), (0.205, 0.79, 0.05, 0.6), (0.075, 0.31, 0.07, 0.6)
FIGURE = [(0.0, *TORSO), *((side * part[0], 0.0, *part[1:]) for part in (ARM, LEG) for side in (-1, 1))]


def figure_at(place: NDArray, facing: float) -> list[NDArray]:
    """Centers of the parts of the figure, and of its head [m], (3,) each."""
    aside = np.array([-np.sin(facing), np.cos(facing), 0.0])
    return [*(place + across * aside + (0, 0, height) for across, _, height, *_ in FIGURE), place + (0, 0, HEAD[1])]


def wear_the_cape(time: float) -> tuple[NDArray, Targets]:
    """The collar's anchors around the neck of a walking person, and the person's parts."""
    place, facing = walk(time)
    way = facing + np.pi + COLLAR
    collar = np.stack([SHOULDERS * np.cos(way), SHOULDERS * np.sin(way), np.full(len(way), NECK)], axis=1)
    return place + collar, dict(enumerate(figure_at(place, facing), 1))


def lay_down(time: float) -> tuple[NDArray, Targets]:
    """Two corners that sway while they are lowered to the floor, so that the sheet lies down on itself."""
    height = max(0.64 - 0.16 * time, 0.02)
    sway = 0.13 * np.sin(2 * np.pi * time / 2.0) * min(time, 1.0)
    return np.array([(-0.3, sway, height), (0.3, sway, height)]), {}


# --- the gallery --------------------------------------------------------------------------------------------------------


def hung(mesh: ClothMesh, top: float) -> NDArray:
    """Positions of a grid that hangs straight down from its last row, around the plane y = 0 [m], (particles, 3)."""
    x = rippled(mesh)[:, [0, 2, 1]]
    return x + (0, 0, top - x[:, 2].max())


def rippled(mesh: ClothMesh) -> NDArray:
    """A flat sheet with a millimeter of ripple [m], (particles, 3): one that is exactly flat never buckles where it is pushed."""
    x = mesh.rest_positions.copy()
    across, along = (x[:, :2] / max(mesh.size)).T
    x[:, 2] += RIPPLE * np.sin(9.0 * across + 1.0) * np.cos(7.0 * along + 2.0 * across)
    return x


def gathered(mesh: ClothMesh, share: float, waves: int) -> NDArray:
    """A sheet in waves along x, on which it is as long as at rest, that take a share of its width [m], (particles, 3)."""
    width = mesh.size[0]
    place = np.linspace(0, 1, 2001)

    def along(height: float) -> NDArray:
        """Length from the edge on, of waves of that height [m]."""
        slope = height * 2 * np.pi * waves * np.cos(2 * np.pi * waves * place)
        return np.concatenate([[0], np.cumsum(np.hypot(share * width, 0.5 * (slope[1:] + slope[:-1]))) / 2000])

    heights = np.linspace(0, width / waves, 400)
    height = heights[np.searchsorted([along(one)[-1] for one in heights], width)]
    x = rippled(mesh)
    at = np.interp(x[:, 0] / width + 0.5, along(height) / along(height)[-1], place)
    x[:, 2] += height * np.sin(2 * np.pi * waves * at)
    x[:, 0] = share * width * (at - 0.5)
    return x


def pinned_patch() -> Scene:
    mesh = grid(33, 33, 0.6, 0.6)
    return Scene(
        about="A patch of cloth in a breath of air. Pull the gravity slider, and see which threads light up.",
        mesh=mesh,
        start=gathered(mesh, PINNED, 2) + (0, 0, 0.8),
        settings=Settings(gravity=0.0, wind=BREATH[0], gust=BREATH[1], air_drag=SWING_DRAG),
        anchors=mesh.corners[2:],
        camera=Camera(eye=(0.8, -1.3, 1.15), target=(0.0, 0.0, 0.56), vertical_fov=38.0),
        downwind=(0.0, -1.0, 0.0),  # away from the pins
    )


def flag() -> Scene:
    mesh = grid(33, 49, 0.9, 0.6)
    columns = mesh.grid_shape[1]
    hoist = tuple(range((mesh.grid_shape[0] - 1) * columns, -1, -columns))
    start = hung(mesh, 1.5)
    pole = Drawn(Capsule(center=(-0.462, 0.0, 0.79), radius=0.012, height=1.58), STEEL)
    return Scene(
        about="A flag of silk. The wind has a steady part and gusts; turn either down and the flag sinks to the pole.",
        mesh=mesh,
        start=start,
        settings=Settings(wind=6.0, gust=1.5, fabric="silk", self_collision="off"),  # it flutters too fast for real time otherwise
        anchors=(hoist,),
        scenery=(pole,),
        camera=Camera(eye=(1.15, -1.9, 1.5), target=(0.02, 0.05, 1.02)),
    )


def sheet_over(about: str, solid: Sphere | Box | MeshCollider, color: tuple[int, int, int], top: float, side: int = 41) -> Scene:
    """A sheet of so many particles a side that falls onto a solid."""
    mesh = grid(side, side, 0.9, 0.9)
    return Scene(
        about=about,
        mesh=mesh,
        start=rippled(mesh) + (0.02, 0.03, top + 0.14),
        settings=Settings(air_drag=0.5),
        colliders=(Plane(), solid),
        colors={1: color},
        camera=Camera(eye=(1.15, -1.3, 0.95), target=(0.0, 0.0, 0.2)),
    )


def sphere() -> Scene:
    about = "A sheet falls over a ball. Drag it off."
    return sheet_over(about, Sphere(center=(0, 0, 0.24), radius=0.22), SAGE, 0.46)


def box() -> Scene:
    solid = Box(center=(0, 0, 0.18), half_sides=(0.18, 0.18, 0.18), yaw=0.4)
    return sheet_over("A sheet falls over a box, and folds at its corners.", solid, OAK, 0.36)


def sheet_over_pawn() -> Scene:
    vertices, triangles = pawn()
    solid = MeshCollider(vertices=vertices, triangles=triangles)
    about = "A sheet falls over a chess pawn, a mesh of triangles."
    return sheet_over(about, solid, CLAY, 0.5, 33)


def cape() -> Scene:
    mesh = grid(41, 37, 0.72, 0.8)
    rows, columns = mesh.grid_shape
    top = (rows - 1) * columns
    row, column = np.divmod(np.arange(mesh.num_particles), columns)
    across, down = 2 * column / (columns - 1) - 1, 1 - row / (rows - 1)
    place, facing = walk(0.0)
    # part of a cone around the torso, wider at the hem
    way, out = facing + np.pi + COLLAR[-1] * across, SHOULDERS + (HEM - SHOULDERS) * np.sqrt(down)
    start = place + np.stack([out * np.cos(way), out * np.sin(way), NECK - 0.79 * down], axis=1)
    return Scene(
        about="A cape on the shoulders of a person who walks a figure of eight.",
        mesh=mesh,
        start=start,
        settings=Settings(fabric="wool", air_drag=0.2, friction=0.2),
        anchors=tuple(np.linspace(top, top + columns - 1, len(COLLAR)).round().astype(int).tolist()),
        colliders=(
            Plane(),
            *(Capsule(center=tuple(at), radius=part[3], height=part[4]) for part, at in zip(FIGURE, figure_at(place, facing))),
            Sphere(center=tuple(place + (0, 0, HEAD[1])), radius=HEAD[2]),
        ),
        colors=dict.fromkeys(range(1, 6), STEEL) | {6: (222, 190, 164)},
        motion=wear_the_cape,
        camera=Camera(eye=(-1.0, -2.9, 1.6), target=(0.0, 0.0, 0.68)),
    )


def folding() -> Scene:
    mesh = grid(33, 33, 0.6, 0.6)
    return Scene(
        about="Two corners lower a sheet while they sway: it lies down on itself, and never passes through.",
        mesh=mesh,
        start=hung(mesh, 0.64),
        settings=Settings(self_collision="strict", air_drag=0.5),
        anchors=mesh.corners[2:],
        colliders=(Plane(),),
        motion=lay_down,
        rests=4.4,
        camera=Camera(eye=(0.85, -1.05, 0.75), target=(0.0, 0.02, 0.24)),
    )


SCENES = {
    "patch": ("Pinned patch", pinned_patch),
    "flag": ("Flag in gusty wind", flag),
    "sphere": ("Sheet over a sphere", sphere),
    "box": ("Sheet over a box", box),
    "pawn": ("Sheet over a mesh", sheet_over_pawn),
    "cape": ("Cape on moving shoulders", cape),
    "fold": ("Cloth that folds on itself", folding),
}
TITLES = {name: title for name, (title, _) in SCENES.items()}


@cache
def scene_named(name: str) -> Scene:
    """The scene of that name.

    Raises:
        ValueError: an unknown name; the message lists the known ones.
    """
    known("scene", name, SCENES)
    return SCENES[name][1]()

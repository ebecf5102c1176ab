"""Scenes that show differences between integrators.  Each is named after its difficulty."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import known
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid
from clothgym.simulation import GRAVITY, Simulation

FRAME = 1 / 60  # control step [s]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """A grid of cloth, its start, and when it is evaluated.

    Attributes:
        breaks: what happens, and which methods have trouble with it.
        size: rows, columns, width [m], height [m].
        material: the fabric; ``damping_time`` and ``air_drag`` are the scene's own.
        held: particles that stay where they are.
        seconds: from the start to the evaluation [s].
        substeps: numbers of substeps to try, in a control step of 1/60 s.
        shown: the entry of ``substeps`` that the picture uses.
        reference_substeps: of the converged run.
        eye, target: of the picture's camera [m].
        altitude: height of the sheet's center above the floor at the start [m].
        upright: starts in the plane y = 0 instead of flat.
        gravity: downward [m/s^2].
        spin: angular velocity about the vertical through the center at the start [rad/s].
        bending: see ``Simulation``.
        spring_constant: of all springs, instead of the material's [N/m].
        heavy: particles whose mass is multiplied by ``heavier``.
        variants: other models of the same sheet, as arguments of ``Simulation`` by label; they share the reference.
        settled: whether it is at rest at the end, so that its strain is static.
        conserves: whether energy and angular momentum should be conserved.
    """

    name: str
    breaks: str
    size: tuple[int, int, float, float]
    material: Material
    held: tuple[int, ...]
    seconds: float
    substeps: tuple[int, ...]
    shown: int
    reference_substeps: int
    eye: Vector
    target: Vector
    altitude: float
    upright: bool = False
    gravity: float = GRAVITY
    spin: float = 0.0
    bending: str = "springs"
    spring_constant: float | None = None
    heavy: tuple[int, ...] = ()
    heavier: float = 1.0
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    settled: bool = False
    conserves: bool = False

    @cached_property
    def mesh(self) -> ClothMesh:
        return grid(*self.size)

    @property
    def frames(self) -> int:
        return round(self.seconds / FRAME)

    @property
    def start(self) -> tuple[NDArray, NDArray]:
        """Positions [m] and velocities [m/s] at the start, (particles, 3)."""
        x = self.mesh.rest_positions
        if self.upright:
            x = x[:, [0, 2, 1]]
        return x + (0, 0, self.altitude), np.cross((0, 0, self.spin), x)

    def simulation(
        self,
        integrator: str | Mapping[str, Any],
        substeps: int,
        variant: str = "",
        num_envs: int = 1,
        dtype: str = "float32",
        time_step: float = FRAME,
    ) -> Simulation:
        """The scene at its start, in vacuum and on one thread; ``time_step`` is that of its substeps together [s]."""
        model: dict[str, Any] = {"bending": self.bending} | (dict(self.variants[variant]) if variant else {})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # substeps beyond a method's stability bound are part of the comparison
            s = Simulation(
                self.mesh,
                self.material,
                num_envs,
                integrator,
                time_step,
                substeps,
                gravity=(0, 0, -self.gravity),
                air_density=0,
                anchors=self.held,
                on_divergence="ignore",
                dtype=dtype,
                threads=1,
                **model,
            )
        state = s.get_state()
        if self.spring_constant is not None:
            state.stiffness[:] = self.spring_constant
        state.free_inverse_mass[:, list(self.heavy)] /= self.heavier
        s.set_state(state)
        s.reset(positions=self.start[0], velocities=self.start[1])
        return s


def _particles(size: tuple[int, int, float, float], rows: slice, columns: slice) -> tuple[int, ...]:
    """Particles in the given rows and columns of a grid."""
    return tuple(np.arange(size[0] * size[1]).reshape(size[:2])[rows, columns].ravel().tolist())


SHEET = (17, 17, 1.0, 1.0)
TOP_CORNERS = (272, 288)
STRIP = (4, 13, 0.24, 0.06)
RIBBON = (5, 61, 1.2, 0.08)

SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene(
            name="stiff_sheet",
            breaks="cotton, held by two corners, swings down for half a second: large explicit steps blow up",
            size=SHEET,
            material=Material.preset("penava_cotton"),
            held=TOP_CORNERS,
            seconds=0.5,
            substeps=(5, 10, 20, 40, 80, 160, 320),
            shown=10,
            reference_substeps=320,
            eye=(1.6, -1.9, 1.35),
            target=(0.06, 0.55, 0.68),
            altitude=1.2,
        ),
        Scene(
            name="soft_corner",
            breaks="Provot's sheet of soft springs, 1 N/m, hung by two corners: yarns stretch far beyond what cloth does, "
            "converged or not, unless strain is limited",
            size=SHEET,
            material=Material(density=0.1, damping_time=0.0, air_drag=0.5),
            held=TOP_CORNERS,
            seconds=3.0,
            substeps=(1, 2, 4, 8, 16, 32, 64),
            shown=4,
            reference_substeps=64,
            eye=(0.9, -4.2, 1.6),
            target=(0.0, 0.0, 1.15),
            altitude=1.5,
            upright=True,
            spring_constant=1.0,
            variants={"strain limit 0.1": {"strain_limit": 0.1}},
            settled=True,
        ),
        Scene(
            name="heavy_corner",
            breaks="a light sheet carries a patch fifty times heavier: methods that go spring by spring leave it too soft",
            size=SHEET,
            material=Material.preset("penava_cotton", air_drag=0.75),
            held=TOP_CORNERS,
            seconds=3.0,
            substeps=(5, 10, 20, 40, 80, 160, 320),
            shown=10,
            reference_substeps=320,
            eye=(0.8, -3.4, 1.2),
            target=(0.0, 0.0, 0.75),
            altitude=0.85,
            upright=True,
            heavy=_particles(SHEET, slice(0, 3), slice(14, 17)),
            heavier=50.0,
            settled=True,
        ),
        Scene(
            name="thin_strip",
            breaks="a stiff strip, clamped at one end, bows under its weight: its shape is all bending, which skip springs miss",
            size=STRIP,
            material=Material(density=0.05, bend_rigidity=2e-4, air_drag=0.5),
            held=_particles(STRIP, slice(None), slice(0, 2)),
            seconds=2.0,
            substeps=(5, 10, 20, 40, 80, 160),
            shown=20,
            reference_substeps=160,
            eye=(0.12, -0.6, 0.42),
            target=(0.0, 0.0, 0.24),
            altitude=0.32,
            bending="hinge",
            variants={"skip springs": {"bending": "springs"}},
        ),
        Scene(
            name="free_spin",
            breaks="a free sheet turns without gravity or damping: dissipative methods lose its energy and its spin",
            size=(13, 13, 0.6, 0.6),
            material=Material.preset("knit", damping_time=0.0),
            held=(),
            seconds=1.0,
            substeps=(2, 5, 10, 20, 40, 80, 160),
            shown=10,
            reference_substeps=160,
            eye=(0.0, -1.1, 1.5),
            target=(0.0, 0.0, 0.4),
            altitude=0.4,
            gravity=0.0,
            spin=10.0,
            conserves=True,
        ),
        Scene(
            name="long_ribbon",
            breaks="sixty links in a row swing down from one end: a correction that travels one link a pass does not arrive",
            size=RIBBON,
            material=Material.preset("penava_cotton", air_drag=0.15),
            held=_particles(RIBBON, slice(None), slice(0, 2)),
            seconds=0.5,
            substeps=(5, 10, 20, 40, 80, 160, 320),
            shown=10,
            reference_substeps=320,
            eye=(0.5, -1.9, 1.6),
            target=(-0.26, 0.0, 0.87),
            altitude=1.4,
        ),
    )
}


def scene_named(name: str) -> Scene:
    """The scene with this name.

    Raises:
        ValueError: an unknown name; the message lists the known ones.
    """
    known("scene", name, SCENES)
    return SCENES[name]

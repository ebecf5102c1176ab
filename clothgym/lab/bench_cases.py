"""Table rows that take milliseconds each: passes over one sheet, or over several in lanes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from clothgym.lab.bench_limits import (
    DAMPED_PROJECTION,
    HINGE,
    PARTICLE,
    PROJECTION,
    SPRING,
    STENCIL,
    TRIANGLE,
    PlainSheet,
    Work,
)
from clothgym.lab.bench_table import Case
from clothgym.material import Material
from clothgym.mesh import SHEAR, ClothMesh, grid
from clothgym.simulation import Simulation
from clothgym.triangles import disc

SIDES, BATCHES = (17, 25, 50, 100), (16, 64, 128)
STEP = 1e-5  # substep of the passes, too short to be unstable [s]
ENOUGH = 1_500_000  # approximate product of springs, substeps and environments in a call
DRAPE_SUBSTEPS = 50  # in a control step of ClothDrape-v0
SHARED = 1.15  # goal, in times of a plain step
NUMBERS = 13  # float32 values of a particle that a substep reads and writes: x, v, f, external force, and w


def hanging(mesh: ClothMesh, num_envs: int = 1, damping_time: float = 1e-4, **world: Any) -> Simulation:
    """Slightly uneven sheets that hang upright by their upper corners.  A disc hangs by particles of its rim."""
    held = mesh.corners[2:] if mesh.shape is not None else (mesh.num_particles - 4, mesh.num_particles - 1)
    fabric = Material.preset("penava_cotton", damping_time=damping_time, air_drag=0.72)
    world = {"anchors": held, "air_density": 0.0, "threads": 1, "on_divergence": "ignore", **world}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # timings need no accuracy
        simulation = Simulation(mesh, fabric, num_envs, **world)
    ripple = np.random.default_rng(0).normal(scale=1e-4, size=(num_envs, mesh.num_particles, 3))
    simulation.reset(positions=mesh.rest_positions[:, [0, 2, 1]] + ripple)
    return simulation


def pass_of(mesh: ClothMesh, spring: Work = SPRING) -> Work:
    """Work of a substep with springs alone."""
    return spring.times(len(mesh.springs.kind)).plus(PARTICLE.times(mesh.num_particles))


def bare(
    group: str, what: str, mesh: ClothMesh, num_envs: int = 1, passes: int = 1, work: Work | None = None, wanted: str = "",
    goal: tuple[float, Case] | None = None, **world: Any,
) -> Case:  # fmt: skip
    """A case of substeps alone, in ns per spring and environment of a pass."""
    springs = len(mesh.springs.kind)
    substeps = max(8, ENOUGH // (springs * num_envs * passes))
    simulation = hanging(mesh, num_envs, time_step=substeps * STEP, substeps=substeps, **world)
    visits, size = substeps * springs * num_envs * passes, 4 * mesh.num_particles * NUMBERS
    work = work if work is not None else pass_of(mesh)
    return Case(
        group, what, simulation.step, 1e9 / visits, "ns a spring", wanted, goal=goal, visits=visits, work=work, springs=springs,
        size=size,
    )  # fmt: skip


# --- springs ------------------------------------------------------------------------------------------------------------------


@cache
def plain(side: int) -> Case:
    """The plain step, the reference for all other cases."""
    sheet = PlainSheet(side)
    steps = max(8, ENOUGH // sheet.springs)
    work, visits = pass_of(grid(side, side, 1.0, 1.0)), steps * sheet.springs
    return Case(
        "springs", f"plain step, {side} x {side}", lambda: sheet.step(steps), 1e9 / visits, "ns a spring", "the measure",
        visits=visits, work=work, springs=sheet.springs, size=sheet.bytes,
    )  # fmt: skip


DRAPE = grid(17, 17, 0.6, 0.6)  # the sheet of ClothDrape-v0, and its working set
DRAPE_SPRINGS, DRAPE_SIZE = len(DRAPE.springs.kind), 4 * DRAPE.num_particles * NUMBERS


def control_step(
    group: str,
    what: str,
    num_envs: int,
    unit: str,
    work: Work | None,
    ahead: int = 0,
    world: dict[str, Any] | None = None,
    **shown: Any,
) -> Case:
    """A case of control steps of ClothDrape-v0's sheet without solids, in us per environment.  ahead: warm-up steps."""
    simulation = hanging(DRAPE, num_envs, time_step=1 / 30, substeps=DRAPE_SUBSTEPS, **(world or {}))
    simulation.step(1 + ahead)
    visits = DRAPE_SUBSTEPS * DRAPE_SPRINGS * num_envs
    return Case(
        group, f"{what}, {_each(num_envs)}", simulation.step, 1e6 / num_envs, unit, visits=visits, work=work,
        springs=DRAPE_SPRINGS, size=DRAPE_SIZE, **shown,
    )  # fmt: skip


@cache
def base(num_envs: int) -> Case:
    """ClothDrape-v0's sheet with springs alone."""
    return control_step("springs", "control step of ClothDrape-v0's sheet, springs alone", num_envs, "us", pass_of(DRAPE), goal=115)


def _each(num_envs: int) -> str:
    """Name of a batch in a row."""
    return "one" if num_envs == 1 else f"each of {num_envs}"


def springs() -> Iterator[Case]:
    for side in SIDES:
        yield bare("springs", f"explicit, one, {side} x {side}", grid(side, side, 1.0, 1.0), goal=(SHARED, plain(side)))
    mesh = grid(25, 25, 1.0, 1.0)
    for num_envs in BATCHES:
        yield bare("springs", f"explicit, each of {num_envs}, 25 x 25", mesh, num_envs, goal=(SHARED, plain(25)))
    for name, passes in (("explicit_euler", 1), ("verlet", 1), ("rk4", 4)):
        what = f"{name}, one, 25 x 25" + (", a quarter" if passes > 1 else "")
        yield bare("springs", what, mesh, passes=passes, goal=(SHARED, plain(25)), integrator=name)
    for num_envs in (1, 64):
        yield bare(
            "springs", f"explicit, a disc of 631, {_each(num_envs)}", disc(0.5, 14), num_envs, wanted="no slower than before"
        )
    yield from (base(1), base(128))


# --- what comes on top --------------------------------------------------------------------------------------------------------


def bending() -> Iterator[Case]:
    n = DRAPE.num_particles
    # without skip springs
    springs = SPRING.times(int(np.sum(DRAPE.springs.kind <= SHEAR))).plus(PARTICLE.times(n))
    models = (("quadratic", STENCIL.times(n), 1.15), ("hinge", HINGE.times(len(DRAPE.hinges.weight)), 5.0))
    for model, work, times in models:
        for num_envs in (1, 128):
            yield control_step(
                "bending", model, num_envs, "times the base", springs.plus(work), world={"bending": model}, over=base(num_envs),
                goal=times,
            )  # fmt: skip


def air() -> Iterator[Case]:
    work = TRIANGLE.times(len(DRAPE.triangles) / 3)  # every third substep
    blown = {"air_density": 1.2, "wind": (1.0, 0.5, 0.2)}
    for num_envs in (1, 128):
        yield control_step(
            "air", "air forces on every triangle", num_envs, "us more", work, world=blown, beyond=base(num_envs), goal=20
        )  # fmt: skip


def limiter() -> Iterator[Case]:
    shown: dict[str, Any] = {"wanted": "no slower than before", "beyond": base(1)}
    cases: tuple[tuple[str, dict[str, Any]], ...] = (
        ("nothing to limit", {}),
        ("ten times the weight", {"gravity": (0.0, 0.0, -98.1)}),
    )
    for what, changes in cases:
        world = {"strain_limit": 0.1, **changes}
        yield control_step("limiter", f"strain limit of 10 %, {what}", 1, "us more", None, 60, world, **shown)


# --- other methods ------------------------------------------------------------------------------------------------------------


def implicit() -> Iterator[Case]:
    mesh, substeps = grid(25, 25, 1.0, 1.0), 4
    count = len(mesh.springs.kind)
    third = "a third of before"
    cases: tuple[tuple[str, dict[str, Any], int], ...] = (
        ("implicit_euler", {"tolerance": 0.0, "iterations": 20}, 22),
        ("implicit_euler", {}, 0),
        ("projective_dynamics", {}, 0),
    )
    for name, options, passes in cases:
        simulation = hanging(mesh, integrator={"name": name, **options}, time_step=1 / 60, substeps=substeps)
        if passes:
            what = f"{name}, one, 25 x 25, a substep of 20 iterations: each pass"
            visits = substeps * count * passes
            yield Case("implicit", what, simulation.step, 1e9 / visits, "ns a spring", third, visits=visits)
        else:
            yield Case("implicit", f"{name}, one, 25 x 25, a substep", simulation.step, 1e6 / substeps, "us", third)


def gauss_seidel() -> Iterator[Case]:
    mesh = grid(25, 25, 1.0, 1.0)
    cases: tuple[tuple[str, Any, float, Work], ...] = (
        ("pbd", {"name": "pbd", "iterations": 1}, 1e-4, PROJECTION),
        ("xpbd", "xpbd", 1e-4, DAMPED_PROJECTION),
        ("xpbd, undamped", "xpbd", 0.0, PROJECTION),
    )
    for what, integrator, damping_time, spring in cases:
        for num_envs in (1, 64, 128):
            yield bare(
                "gauss_seidel", f"{what}, {_each(num_envs)}, 25 x 25", mesh, num_envs, wanted="no slower than before",
                work=pass_of(mesh, spring), integrator=integrator, damping_time=damping_time,
            )  # fmt: skip


GROUPS: dict[str, Callable[[], Iterator[Case]]] = {
    "springs": springs,
    "bending": bending,
    "air": air,
    "implicit": implicit,
    "gauss_seidel": gauss_seidel,
    "limiter": limiter,
}

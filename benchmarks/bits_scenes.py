"""The scenes of ``bits.py`` that are no environments."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from clothgym import INTEGRATORS, Box, Capsule, ClothMesh, MeshCollider, Plane, Simulation, Sphere, disc, grid
from clothgym.lab.digests import Digest

Row = dict[str, Any]
# of a control step, stable on the sheets below
SUBSTEPS = {"explicit_euler": 400, "implicit_euler": 10, "projective_dynamics": 20, "pbd": 5, "xpbd": 60}
BENDING = ("springs", "hinge", "quadratic")


def watch(simulation: Simulation, steps: int, before: Callable[[int], None] = lambda step: None) -> Row:
    """The row of a simulation that does so many steps."""
    digest = Digest()
    for step in range(steps):
        before(step)
        simulation.step()
        seen = {"limiting": simulation.limiting, "contacts": simulation.self_contacts, "hands": simulation.attachment_positions}
        seen |= {"penetration": simulation.penetration(), "solids": simulation.collider_positions}
        digest.add(positions=simulation.positions, velocities=simulation.velocities, infos=seen)
    row = digest.row()
    return row | ({"digest": row["digest"] + " (diverged)"} if simulation.diverged.any() else {})


def in_the_wind(mesh: ClothMesh, held: tuple[int, int], integrator: str, options: Row | None = None, **world: Any) -> Row:
    """Four fabrics, as far as the method with its options allows, that hang from two particles; one of these is let go."""
    simulation = Simulation(
        mesh, num_envs=4, integrator={"name": integrator, **(options or {})}, substeps=SUBSTEPS.get(integrator, 100),
        anchors=held, threads=1, on_divergence="ignore", **world,
    )  # fmt: skip
    even = np.linspace(0, 1, 4)
    properties = {
        "density": 0.12 + 0.1 * even, "stretch_stiffness": 180 + 80 * even, "shear_stiffness": 60 + 40 * even,
        "bend_rigidity": 2e-6 + 2e-5 * even, "damping_time": 1e-4 * even, "drag_coefficient": 1 + even, "air_drag": 0.3 * even,
    }  # fmt: skip
    method = INTEGRATORS[integrator]
    no_properties = method.shared | method.ignored | ({"shear_stiffness"} if mesh.shape is None else set())
    allowed = {name: values for name, values in properties.items() if name not in no_properties}
    wind = np.outer(1 + even, (1.0, 2.0, 0.5))
    simulation.set_parameters(warn=False, wind=wind, gravity=np.outer(8 + 2 * even, (0.1, 0, -1)), **allowed)

    def before(step: int) -> None:
        simulation.move_anchors(simulation.attachment_positions[:, :2] + (0.002, 0, 0.004))
        if step == 6:
            simulation.release([1, 3], [0, 1])

    return watch(simulation, 12, before)


def falling(mesh: ClothMesh, solids: list, contact: str, moving: bool, **world: Any) -> Row:
    """Three sheets fall on a solid, which may move, steadily at first and then to places."""
    world = {"substeps": 40, "integrator": "semi_implicit_euler"} | world
    simulation = Simulation(mesh, num_envs=3, colliders=solids, contact=contact, threads=1, **world)
    offsets = np.array([(0.01, 0.02, 0.12), (-0.07, 0.03, 0.13), (0.1, -0.1, 0.12)])
    simulation.reset(positions=mesh.rest_positions + offsets[:, None], velocities=(0.1, 0, -1.0))

    def before(step: int) -> None:
        if moving and step == 4:
            simulation.move_colliders(0, velocities=(0.3, -0.2, 0.4))
        if moving and step == 12:
            simulation.move_colliders(0, targets=simulation.collider_positions[:, 0] - (0.01, 0, 0.005))

    return watch(simulation, 20, before)


def folding(mesh: ClothMesh, held: tuple[int, int], mode: str, **world: Any) -> Row:
    """Two sheets on a floor are folded in half by two particles of their far edge, which is then let go."""
    options = {"mode": mode, "thickness": 0.006}
    world = {"substeps": 50, "colliders": [Plane(friction=0.5)], "self_collision": options, "anchors": held, "threads": 1} | world
    simulation = Simulation(mesh, num_envs=2, **world)
    ripple = np.random.default_rng(0).normal(scale=2e-4, size=(2, mesh.num_particles, 3))
    simulation.reset(positions=mesh.rest_positions + ripple + (0, 0, 0.003))
    start = simulation.attachment_positions

    def before(step: int) -> None:
        if step < 45:
            angle = np.pi * min(1.0, (step + 1) / 40)
            out, up = start[:, :, 1] * np.cos(angle), start[:, :, 1] * np.sin(angle)
            simulation.move_anchors(np.stack([start[:, :, 0], out, start[:, :, 2] + up + 0.01], axis=2))
        elif step == 45:
            simulation.release()

    row = watch(simulation, 70, before)
    return row | {"intersections": int(simulation.intersections().sum())}


def octahedron(moving: dict[str, Any]) -> MeshCollider:
    corners = 0.12 * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return MeshCollider(vertices=corners, triangles=faces, resolution=24, friction=0.4, **moving)


def core() -> Iterator[tuple[str, Callable[[], Row]]]:
    """Name and maker of each row of the core."""
    sheet, narrow, round_ = grid(13, 13, 0.6, 0.6), grid(9, 13, 0.6, 0.4), disc(0.3, 6)
    corners, rim = (narrow.corners[2], narrow.corners[3]), (round_.num_particles - 30, round_.num_particles - 24)
    for name, bending in itertools.product(INTEGRATORS, BENDING):
        yield f"wind, {name}, {bending}", partial(in_the_wind, narrow, corners, name, bending=bending)
    for name, bending in itertools.product(("semi_implicit_euler", "xpbd"), BENDING):
        yield f"wind, disc, {name}, {bending}", partial(in_the_wind, round_, rim, name, bending=bending)
    for rows, columns in ((2, 7), (3, 3), (40, 31)):
        other = grid(rows, columns, 0.05 * (columns - 1), 0.05 * (rows - 1))
        ends = (other.corners[2], other.corners[3])
        yield f"wind, {rows} x {columns}", partial(in_the_wind, other, ends, "semi_implicit_euler")
    yield "wind, xpbd, 3 iterations", partial(in_the_wind, narrow, corners, "xpbd", {"iterations": 3})
    yield "wind, implicit_euler, Newton", partial(in_the_wind, narrow, corners, "implicit_euler", {"newton_iterations": 2})
    yield "wind, float64", partial(in_the_wind, narrow, corners, "semi_implicit_euler", dtype="float64")
    for name, limit in (("semi_implicit_euler", 0.005), ("verlet", 0.002), ("xpbd", 0.01)):
        yield f"wind, {name}, strain limit", partial(in_the_wind, narrow, corners, name, strain_limit=limit)
    yield "wind, disc, strain limit", partial(in_the_wind, round_, rim, "semi_implicit_euler", strain_limit=0.005)
    makers: dict[str, Callable[[dict[str, Any]], Any]] = {
        "plane": lambda moving: Plane(point=(0, 0, 0.1), normal=(0.1, 0, 1), friction=0.4, **moving),
        "sphere": lambda moving: Sphere(radius=0.1, friction=0.4, **moving),
        "capsule": lambda moving: Capsule(radius=0.08, height=0.4, axis=(1, 0.3, 0), friction=0.4, **moving),
        "box": lambda moving: Box(half_sides=(0.1, 0.07, 0.1), rotation=(1, 0.1, 0.2, 0.1), friction=0.4, **moving),
        "mesh": octahedron,
    }
    for (name, make), contact, moving in itertools.product(makers.items(), ("sheet", "particles"), (False, True)):
        solids = [make({"velocity": (0.2, 0.1, 0.3)} if moving else {})]
        yield f"fall, {name}{' moving' * moving}, {contact}", partial(falling, sheet, solids, contact, moving)
    several = [Plane(point=(0, 0, -0.1)), *(makers[name]({}) for name in ("sphere", "capsule", "box", "mesh"))]
    for contact in ("sheet", "particles"):
        yield f"fall, disc, all solids, {contact}", partial(falling, round_, several, contact, True)
    yield (
        "fall, implicit_euler, all solids",
        partial(falling, sheet, several, "sheet", True, integrator="implicit_euler", substeps=10),
    )
    sides, ends = (sheet.corners[2], sheet.corners[3]), (round_.num_particles - 29, round_.num_particles - 25)
    for mode in ("fast", "strict"):
        yield f"fold, {mode}", partial(folding, sheet, sides, mode)
        yield f"fold, {mode}, disc", partial(folding, round_, ends, mode)
    yield "fold, strict, hinge", partial(folding, sheet, sides, "strict", bending="hinge")
    yield "fold, strict, xpbd", partial(folding, sheet, sides, "strict", integrator="xpbd")
    ball = [Plane(friction=0.5), Sphere(center=(0, -0.1, 0), radius=0.06, friction=0.4)]
    yield "fold, strict, over a sphere", partial(folding, sheet, sides, "strict", colliders=ball)

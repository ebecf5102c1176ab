"""Arguments that nobody expects, of all that is constructed or called: each is refused, or what is made is sound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from attacks.values import call, run, with_hostile

import clothgym
from clothgym.registration import ENVIRONMENTS

MESH = "clothgym.grid(5, 5, 0.3, 0.3)"
TETRAHEDRON = {
    "vertices": "[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]",
    "triangles": "[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]",
}
SURFACE = {"friction": "0.3", "thickness": "0.001", "velocity": "(0, 0, 1)"}
TURN = {"center": "(0, 0, 0)", "rotation": "(1, 0, 0, 0)"}
BODY = "attacks.constructors.body()"
SHARED = {
    "rows": "7", "side": "0.3",
    "fabric": "'silk'", "integrator": "'semi_implicit_euler'", "substeps": "50", "bending": "'hinge'", "strain_limit": "0.1",
    "self_collision": "'fast'", "contact": "'particles'", "air_density": "1.2", "obs_mode": "'particles'",
    "reward_mode": "'sparse'",
    "randomize": "{'density': [0.1, 0.2]}", "wind": "{'speed': [0, 2], 'gust': 0.5}", "threads": "1", "render_mode": "None",
    "render_color": "'fabric'",
}  # fmt: skip
VECTOR = {"num_envs": "2", "autoreset_mode": "'SameStep'"}

# what is called, and sound arguments; those whose name begins with a star are always given, by their place
SOUND: tuple[tuple[str, dict[str, str]], ...] = (
    ("clothgym.grid", {"*rows": "5", "*cols": "5", "*width": "0.3", "*height": "0.3"}),
    ("clothgym.disc", {"*radius": "0.2", "*rings": "2"}),
    ("clothgym.triangle_mesh", {"*vertices": "[[0, 0, 0], [1, 0, 0], [0, 1, 0]]", "*triangles": "[[0, 1, 2]]"}),
    ("clothgym.load_mesh", {"*path": "'no such file.obj'"}),
    ("clothgym.Material", {
        "density": "0.2", "stretch_stiffness": "200.0", "shear_stiffness": "50.0", "bend_rigidity": "1e-6",
        "damping_time": "1e-4",
        "drag_coefficient": "1.2", "skin_friction": "0.02", "air_drag": "0.1", "source": "'mine'",
    }),
    ("clothgym.Material.preset", {"*name": "'cotton'", "density": "0.2"}),
    ("clothgym.Wind", {"speed": "(0, 2)", "direction": "(0, 1)", "gust": "0.5", "gust_time": "0.5"}),
    ("clothgym.Gripper", {
        "position": "(0, 0, 0.5)", "speed": "1.0", "reach": "0.03", "span": "0.06", "closing_time": "0.1", "slip_force": "0.5",
    }),
    ("clothgym.Plane", {"point": "(0, 0, 0)", "normal": "(0, 0, 1)", **SURFACE}),
    ("clothgym.Sphere", {"center": "(0, 0, 0)", "radius": "0.1", **SURFACE}),
    ("clothgym.Capsule", {"center": "(0, 0, 0)", "radius": "0.1", "height": "0.4", "axis": "(0, 0, 1)", **SURFACE}),
    ("clothgym.Box", {"half_sides": "(0.1, 0.1, 0.1)", "yaw": "0.1", **TURN, **SURFACE}),
    ("clothgym.MeshCollider", {**TETRAHEDRON, "path": "None", "scale": "0.1", "resolution": "4", **TURN, **SURFACE}),
    ("clothgym.Simulation", {
        "*mesh": MESH, "material": "clothgym.Material()", "num_envs": "2", "integrator": "'semi_implicit_euler'",
        "time_step": "1 / 60",
        "substeps": "20", "gravity": "(0, 0, -9.81)", "wind": "(1, 0, 0)", "air_density": "1.2",
        "colliders": "[clothgym.Plane()]",
        "anchors": "[0, 4]", "anchor_speed": "10.0", "grippers": "[clothgym.Gripper()]", "bending": "'springs'",
        "contact": "'particles'",
        "self_collision": "False", "strain_limit": "None", "on_divergence": "'ignore'", "dtype": "'float32'", "threads": "1",
    }),
    (f"{BODY}.step", {"n": "1"}),
    (f"{BODY}.largest_substep", {"env": "1"}),
    (f"{BODY}.move_anchors", {"*targets": "np.zeros((2, 1, 3))"}),
    (f"{BODY}.release", {"envs": "[0]", "anchors": "[0]"}),
    (f"{BODY}.attach", {"envs": "[0]", "anchors": "[0]"}),
    (f"{BODY}.set_wind", {"*wind": "(1, 0, 0)", "envs": "[1]"}),
    (f"{BODY}.reset", {"envs": "[0]", "positions": f"{MESH}.rest_positions", "velocities": "np.zeros(3)"}),
    (f"{BODY}.set_parameters", {"envs": "[0]", "density": "0.2", "bend_rigidity": "[1e-6]", "gravity": "(0, 0, -1)",
    "warn": "False"}),
    (f"{BODY}.set_collider", {"*index": "0", "*colliders": "[clothgym.Plane()]", "envs": "[1]"}),
    (f"{BODY}.move_colliders", {"*index": "0", "targets": "np.zeros((1, 3))", "velocities": "np.zeros((1, 3))", "envs": "[0]"}),
    (f"{BODY}.set_state", {"*state": f"{BODY}.get_state()"}),
    (f"{BODY}.grippers.move", {"*targets": "np.zeros((2, 1, 3))", "*openings": "np.zeros((2, 1))"}),
    (f"{BODY}.grippers.place", {"*positions": "np.zeros((1, 1, 3))", "envs": "[0]"}),
    ("attacks.constructors.maneuver", {"*name": "'z-fold'", "*mesh": MESH, "seeds": "[0]", "thickness": "0.008"}),
    ("attacks.constructors.bending_length", {"*material": "clothgym.Material()"}),
    ("attacks.constructors.projected_area", {"*positions": f"{MESH}.rest_positions", "*triangles": f"{MESH}.triangles"}),
    *((f"clothgym.envs.{name}Env", SHARED) for name, _ in ENVIRONMENTS.values()),
    *((f"clothgym.envs.{name}VectorEnv", {**VECTOR, **SHARED}) for name, _ in ENVIRONMENTS.values()),
    ("clothgym.envs.ClothDrapeEnv", {"shapes": "('box', 'post')", **SHARED}),
    ("clothgym.envs.ClothDrapeGripperEnv", {"grippers": "1", "shapes": "'sphere'", "slip_force": "0.5", **SHARED}),
    ("clothgym.envs.ClothStrainEnv", {"threshold": "0.1", "cost_penalty": "0.5", **SHARED}),
)  # fmt: skip


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        name, sound = SOUND[rng.integers(len(SOUND))]
        text = f"attacks.constructors.use({call(name, with_hostile(sound, rng))})"
        if any(f".step(n={many})" in text for many in ("10**9", "2**31 - 1")):
            continue  # they would take a day, as asked for
        yield text, partial(run, text)


def use(made: Any) -> None:
    """What has been made is sound.

    Raises:
        AssertionError: it is not.
    """
    if isinstance(made, clothgym.ClothMesh):
        assert made.rest_positions.shape == (len(made.area), 3) and np.isfinite(made.rest_positions).all(), "positions of a mesh"
        assert np.isfinite(made.springs.rest_length).all() and np.isfinite(made.springs.weight).all(), "springs of a mesh"
        assert all(np.isfinite(field).all() for field in made.hinges), "hinges of a mesh"
    elif isinstance(made, clothgym.Material):
        assert all(np.isfinite(value) for name, value in vars(made).items() if name != "source"), f"{made} is not finite"
    elif isinstance(made, clothgym.Wind):
        assert np.isfinite(made.series(np.random.default_rng(0), 5, 1 / 60)).all(), "wind that is not finite"
    elif hasattr(made, "rows"):
        assert np.isfinite(made.rows()).all(), "a solid that is not finite"
    elif isinstance(made, clothgym.Simulation):
        _step(made)
    elif isinstance(made, (gym.Env, gym.vector.VectorEnv)):
        _play(made)
    elif isinstance(made, float):
        assert np.isfinite(made), f"{made} is not finite"
    elif made is None:  # of a method
        _step(body())


_body: list[clothgym.Simulation] = []


def body() -> clothgym.Simulation:
    """A simulation whose methods are called; the same until it is stepped."""
    if not _body:
        mesh, world = clothgym.grid(5, 5, 0.3, 0.3), {"colliders": [clothgym.Plane(point=(0, 0, -0.2))], "contact": "particles"}
        world |= {"anchors": [0], "grippers": [clothgym.Gripper()], "substeps": 20, "on_divergence": "ignore", "threads": 1}
        _body.append(clothgym.Simulation(mesh, num_envs=2, **world))  # type: ignore[arg-type]
    return _body[0]


def maneuver(name: str, mesh: Any, **options: Any) -> clothgym.Simulation:
    """The simulation of a maneuver at its start."""
    from clothgym.starts import MANEUVERS

    made = MANEUVERS[name if isinstance(name, str) and name in MANEUVERS else "heap"](mesh, **options)
    made.step()
    return made.simulation


def bending_length(material: Any) -> float:
    """That of ``clothgym.lab.scenes``."""
    from clothgym.lab import scenes

    return scenes.bending_length(material)


def projected_area(positions: Any, triangles: Any) -> float:
    """That of ``clothgym.lab.scenes``."""
    from clothgym.lab import scenes

    return scenes.projected_area(positions, triangles)


def _step(simulation: clothgym.Simulation) -> None:
    """Two steps: sheets are finite, or reported as diverged."""
    _body.clear()
    simulation.step(2)
    x, v = simulation.positions, simulation.velocities
    shape = (simulation.num_envs, simulation.mesh.num_particles, 3)
    assert x.shape == v.shape == shape, f"positions of shape {x.shape}, not {shape}"
    fine = np.isfinite(x).all(axis=(1, 2)) & np.isfinite(v).all(axis=(1, 2))
    assert (fine | simulation.diverged).all(), "a sheet is not finite, and has not been reported"


def _play(env: Any) -> None:
    """The beginning of an episode: observations within their space, finite rewards."""
    observation, _ = env.reset(seed=0)
    for _ in range(2):
        assert env.observation_space.contains(observation), "an observation has left its space"
        observation, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert np.isfinite(reward).all(), f"the reward is {reward}"
    env.close()

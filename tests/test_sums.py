"""Sums over thousands of small substeps: in float32 momentum, drift and slow motion are those of the closed forms, anywhere.

``x += h v`` in float32 is lost where ``h v`` is less than half the last bit of x, and up to twice as much where it is more.
"""

import warnings
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from clothgym import INTEGRATORS, Box, Capsule, Gripper, Material, MeshCollider, Plane, Simulation, Sphere, disc, grid
from clothgym.state import State

NAMES = list(INTEGRATORS)
FAR = [(0.0, 0.0, 0.0), (1.0, -1.0, 1.0), (10.0, 10.0, 10.0), (-100.0, 100.0, 100.0)]
G = 9.81
SLOW = np.array([0.01, -0.02, 0.005])


def mesh_of(kind):
    """A grid, whose particles lie side by side under most methods, and the same as a mesh of triangles; or another sheet."""
    mesh = grid(5, 5, 0.3, 0.3)
    return {"grid": mesh, "triangles": replace(mesh, shape=None), "disc": disc(0.15, 2)}[kind]


def free_sheet(name, substeps, kind="grid", gravity=0.0, **settings):
    """A sheet that nothing holds; explicit Euler, which grows at any substep, has a soft and damped one."""
    fabric = Material(stretch_stiffness=20, shear_stiffness=5, damping_time=1e-3) if name == "explicit_euler" else Material()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Simulation(
            mesh_of(kind), fabric, integrator=name, substeps=substeps, gravity=(0, 0, -gravity), air_density=0, **settings
        )


def center(simulation, field="positions"):
    """The center of mass [m], or its velocity [m/s], (num_envs, 3), in float64."""
    mass = 1 / simulation.get_state().free_inverse_mass.astype(float)
    return np.einsum("ep,epc->ec", mass, getattr(simulation, field).astype(float)) / mass.sum(axis=1)[:, None]


def resolution(far):
    """The last bit of positions there, by which a difference of two of them can be wrong [m]."""
    return float(np.spacing(np.float32(np.abs(far).max() + 0.2)))


# few control steps: the old sums were wrong from the first on
STEPS = {16: 24, 256: 12, 4096: 3}


@pytest.mark.parametrize("far", FAR, ids=lambda far: f"{abs(far[0]):g}m")
@pytest.mark.parametrize("substeps", STEPS)
@pytest.mark.parametrize("name", NAMES)
def test_a_sheet_that_glides_slowly_goes_as_far_as_its_velocity_says(name, substeps, far):
    simulation = free_sheet(name, substeps)
    simulation.reset(positions=simulation.mesh.rest_positions + far, velocities=SLOW)
    begun, seconds = center(simulation), STEPS[substeps] / 60
    simulation.step(STEPS[substeps])
    assert np.abs(center(simulation, "velocities") - SLOW).max() < 1e-3 * np.abs(SLOW).max()
    assert np.abs(center(simulation) - begun - SLOW * seconds).max() < 1e-3 * np.abs(SLOW).max() * seconds + resolution(far)


@pytest.mark.parametrize("substeps", STEPS)
@pytest.mark.parametrize("name", NAMES)
def test_a_sheet_that_turns_makes_no_momentum(name, substeps):
    simulation = free_sheet(name, substeps)
    simulation.reset(velocities=np.cross([0, 0, 1.0], simulation.mesh.rest_positions))
    simulation.step(4 * STEPS[substeps])
    # of a rim that moves at 0.15 m/s
    assert np.abs(center(simulation, "velocities")).max() < 1e-4 * 0.15
    assert np.abs(center(simulation)).max() < 1e-3 * 0.15 * 4 * STEPS[substeps] / 60


@pytest.mark.parametrize("speed", [0.0, 7.0])
@pytest.mark.parametrize("substeps", [256, 4096])
@pytest.mark.parametrize("name", NAMES)
def test_a_falling_sheet_gains_gravity_at_any_speed(name, substeps, speed):
    """Near 8 m/s a substep's ``g h`` of 4e-5 m/s is 84 of the last bits of v, or 83."""
    simulation, steps = free_sheet(name, substeps, gravity=G), STEPS[substeps]
    simulation.reset(velocities=(0, 0, -speed))
    simulation.step(steps)
    gained = -center(simulation, "velocities")[0, 2] - speed
    assert gained == pytest.approx(G * steps / 60, rel=1e-4)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", NAMES)
def test_drag_slows_as_its_rate_says(name, dtype):
    """The factor of a substep, 1 - 8e-7, is no number of float32."""
    simulation = free_sheet(name, 4096, dtype=dtype)
    simulation.set_parameters(air_drag=0.2 * simulation.material.density, warn=False)
    simulation.reset(velocities=(1, 0, 0))
    simulation.step(6)
    assert 1 - center(simulation, "velocities")[0, 0] == pytest.approx(1 - np.exp(-0.2 * 0.1), rel=1e-3)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("kind", ["triangles", "disc"])
@pytest.mark.parametrize("name", ["semi_implicit_euler", "verlet", "rk4", "xpbd", "pbd"])
def test_triangle_meshes_and_lanes_do_the_same(name, kind, num_envs):
    """Environments with their own velocities; each with the bits that it has alone."""
    simulation = free_sheet(name, 1024, kind, num_envs=num_envs)
    velocities = SLOW * np.arange(1, num_envs + 1)[:, None, None] * np.ones((simulation.mesh.num_particles, 1))
    simulation.reset(positions=simulation.mesh.rest_positions + FAR[1], velocities=velocities)
    begun = center(simulation)
    simulation.step(6)
    assert np.abs(center(simulation) - begun - velocities[:, 0] / 10).max() < 1e-3 * 0.002 + resolution(FAR[1])
    alone = free_sheet(name, 1024, kind)
    alone.reset(positions=simulation.mesh.rest_positions + FAR[1], velocities=velocities[-1])
    alone.step(6)
    assert np.array_equal(alone.positions[0], simulation.positions[-1])
    assert np.array_equal(alone.get_state().remainders[0], simulation.get_state().remainders[-1])


@pytest.mark.parametrize("bending", ["hinge", "quadratic"])
@pytest.mark.parametrize("name", ["semi_implicit_euler", "xpbd", "pbd"])
def test_models_of_bending_make_no_momentum(name, bending):
    simulation = free_sheet(name, 1024, bending=bending)
    x = simulation.mesh.rest_positions
    simulation.reset(positions=x + np.outer(x[:, 0] ** 2, [0, 0, 0.01]) + FAR[1], velocities=SLOW)
    simulation.step(12)
    assert np.abs(center(simulation, "velocities") - SLOW).max() < 1e-3 * np.abs(SLOW).max()


# --- what moves the sheet -------------------------------------------------------------------------------------------------


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.2
FACES = [
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
]  # fmt: skip
SOLIDS = {
    "plane": lambda at: Plane(point=at),
    "sphere": lambda at: Sphere(center=at),
    "capsule": lambda at: Capsule(center=at),
    "box": lambda at: Box(center=at),
    "mesh": lambda at: MeshCollider(vertices=CUBE, triangles=np.array(FACES), center=at, resolution=12),
}


@pytest.mark.parametrize("how", ["velocities", "targets"])
@pytest.mark.parametrize("substeps", [16, 4096])
@pytest.mark.parametrize("far", FAR, ids=lambda far: f"{abs(far[0]):g}m")
@pytest.mark.parametrize("solid", ["plane", "box"])
def test_solids_move_as_slowly_as_they_are_told(solid, far, substeps, how):
    at = tuple(np.subtract(far, (0, 0, 2)))
    simulation = free_sheet("semi_implicit_euler", substeps, colliders=[SOLIDS[solid](at)])
    simulation.reset(positions=simulation.mesh.rest_positions + far)
    begun, steps = simulation.collider_positions[0, 0].astype(float), 12
    for step in range(1, steps + 1):
        if how == "targets":
            simulation.move_colliders(0, targets=begun + SLOW * step / 60)
        elif step == 1:
            simulation.move_colliders(0, velocities=SLOW)
        simulation.step()
    moved = simulation.collider_positions[0, 0] - begun
    assert np.abs(moved - SLOW * steps / 60).max() < 1e-3 * np.abs(SLOW).max() * steps / 60 + resolution(at)


@pytest.mark.parametrize("solid", SOLIDS)
def test_solids_of_each_kind_move_evenly_within_a_control_step(solid):
    """A thousandth of the last bit of their position in a substep, for two seconds; and a reset puts them back."""
    at = (60.0, 0.0, 0.0)
    simulation = free_sheet("semi_implicit_euler", 512, colliders=[SOLIDS[solid](at)])
    simulation.reset(positions=simulation.mesh.rest_positions + (50, 0, 0))
    begun = simulation.collider_positions[0, 0].astype(float)
    simulation.move_colliders(0, velocities=(1e-3, 0, 0))
    simulation.step(30)
    assert simulation.collider_positions[0, 0, 0] - begun[0] == pytest.approx(5e-4, abs=resolution(at))
    simulation.reset()
    assert np.array_equal(simulation.collider_positions[0, 0], begun.astype(np.float32))


@pytest.mark.parametrize("far", FAR, ids=lambda far: f"{abs(far[0]):g}m")
@pytest.mark.parametrize("substeps", [16, 4096])
@pytest.mark.parametrize("name", ["semi_implicit_euler", "xpbd"])
def test_what_is_held_follows_slow_anchors_and_grippers(name, substeps, far):
    """A patch, and a gripper's handful: each of their particles."""
    mesh = mesh_of("grid")
    corner = mesh.rest_positions[-1] + far
    gripper = Gripper(position=tuple(corner), reach=0.1, closing_time=1 / 60)
    simulation = free_sheet(name, substeps, anchors=[[0, 1]], grippers=[gripper])
    simulation.reset(positions=mesh.rest_positions + far)
    simulation.grippers.move(corner[None], [0.0])
    simulation.step()
    held = np.flatnonzero(simulation.get_state().holder[0] >= 0)
    assert len(held) >= 4
    begun, steps = simulation.positions[0].astype(float), 12
    for step in range(1, steps + 1):
        simulation.move_anchors((mesh.rest_positions[0] + far + SLOW * step / 60)[None])
        simulation.grippers.move((corner + SLOW * step / 60)[None], [0.0])
        simulation.step()
    moved = (simulation.positions[0] - begun)[held]
    assert np.abs(moved - SLOW * steps / 60).max() < 1e-3 * np.abs(SLOW).max() * steps / 60 + 1.5 * resolution(far)


@pytest.mark.parametrize("substeps", [64, 4096])
@pytest.mark.parametrize("solid", ["plane", "box"])
def test_a_sheet_rides_on_a_slow_solid(solid, substeps):
    """A meter from the origin; until friction has brought it to the solid's speed it lags by v^2/(2 mu g)."""
    far, speed, steps = np.array([1.0, 1.0, 1.0]), 0.02, 12
    under = Plane(point=tuple(far), friction=0.6) if solid == "plane" else Box(
        center=tuple(far - (0, 0, 0.5)), half_sides=(0.5, 0.5, 0.5), friction=0.6
    )  # fmt: skip
    simulation = free_sheet("semi_implicit_euler", substeps, gravity=G, colliders=[under])
    simulation.reset(positions=simulation.mesh.rest_positions + far + (0, 0, 1e-3))
    simulation.step(6)
    begun = center(simulation)
    simulation.move_colliders(0, velocities=(speed, 0, 0))
    simulation.step(steps)
    wanted = speed * steps / 60 - speed**2 / (2 * 0.6 * G)
    assert (center(simulation) - begun)[0, 0] == pytest.approx(wanted, abs=1e-3 * speed * steps / 60 + resolution(far))


@pytest.mark.parametrize("limit", [None, 0.05])
def test_wind_pushes_as_in_float64(limit):
    """From rest, by 5 mm/s of wind: what it moves the sheet by in a substep is a millionth of the last bit of its place."""
    moved = {}
    for dtype in ("float32", "float64"):
        simulation = Simulation(
            mesh_of("grid"), Material(), substeps=2048, gravity=(0, 0, 0), wind=(0, 0, 0.5), strain_limit=limit, dtype=dtype
        )
        simulation.reset(positions=simulation.mesh.rest_positions + FAR[1])
        begun = center(simulation)
        simulation.step(6)
        moved[dtype] = (center(simulation) - begun)[0, 2], center(simulation, "velocities")[0, 2]
    assert moved["float32"][1] == pytest.approx(moved["float64"][1], rel=1e-3)
    assert moved["float32"][0] == pytest.approx(moved["float64"][0], abs=1e-3 * moved["float64"][0] + resolution(FAR[1]))


# --- the remainders are a part of the state -------------------------------------------------------------------------------


def gliding(**settings):
    simulation = free_sheet("semi_implicit_euler", 1024, colliders=[Sphere(center=(60.0, 0, 0))], num_envs=2, **settings)
    simulation.reset(positions=simulation.mesh.rest_positions + FAR[1], velocities=SLOW)
    simulation.move_colliders(0, velocities=[SLOW, -SLOW])
    return simulation


def bits(simulation):
    return [array.tobytes() for array in simulation.get_state().arrays().values()]


def test_a_state_goes_on_bit_for_bit_with_what_was_left_over(tmp_path):
    simulation = gliding()
    simulation.step(2)
    state = simulation.get_state()
    assert np.abs(state.remainders).max() > 0
    state.save(tmp_path / "state.npz")
    copy, restored = deepcopy(simulation), gliding()
    restored.set_state(State.load(tmp_path / "state.npz"))
    for one in (simulation, copy, restored):
        one.step(2)
    assert bits(simulation) == bits(copy) == bits(restored)


def test_a_reset_begins_without_remainders():
    simulation = gliding()
    simulation.step(2)
    simulation.reset(envs=[1])
    state = simulation.get_state()
    assert np.abs(state.remainders[0]).max() > 0 and not state.remainders[1].any()
    fresh = gliding()
    for one in (simulation, fresh):
        one.reset(positions=one.mesh.rest_positions + FAR[1], velocities=SLOW)
        one.move_colliders(0, velocities=[SLOW, -SLOW])
        one.step()
    assert bits(simulation)[:3] == bits(fresh)[:3]


def test_a_state_of_an_older_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("clothgym.state.VERSION", 1)
    gliding().get_state().save(tmp_path / "old.npz")
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"old\.npz.*its format has version 1, this clothgym reads version 3"):
        State.load(tmp_path / "old.npz")


def test_the_threads_change_no_bit():
    one, two = gliding(threads=1), gliding(threads=2)
    for simulation in (one, two):
        simulation.step(3)
    assert bits(one) == bits(two)

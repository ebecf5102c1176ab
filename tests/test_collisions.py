"""Contact against geometry and Coulomb's law."""

import numpy as np
import pytest

from clothgym import INTEGRATORS, Box, Capsule, Material, Plane, Simulation, Sphere, grid
from clothgym.collisions.solids.shapes import KIND_MESH, Collider

NAMES = list(INTEGRATORS)
# explicit Euler moves on with the velocity of before: what gravity has just added is stopped a substep later
LATE = {"explicit_euler"}
G = 9.81


def distances(collider, points):
    """Signed distances that the kernel finds for points given as the particles of a sheet."""
    points = np.asarray(points, float)
    side = round(len(points) ** 0.5)
    mesh = grid(side, side, 1.0, 1.0)
    simulation = Simulation(mesh, colliders=[collider], dtype="float64")
    simulation.reset(positions=points)
    return simulation.contacts().distance[0]


def points_around(seed=0, count=400, scale=0.5):
    return np.random.default_rng(seed).uniform(-scale, scale, (count, 3))


def test_plane_distance():
    normal = np.array([1.0, 2.0, 2.0]) / 3
    x = points_around()
    assert distances(Plane(point=(0.1, 0, 0), normal=(1, 2, 2), thickness=0.01), x) == pytest.approx(
        (x - (0.1, 0, 0)) @ normal - 0.01
    )


@pytest.mark.parametrize("kind", [3, -1, KIND_MESH])
def test_shapes_that_no_kernel_knows_are_refused(kind):
    """Of another kind, or a mesh without a grid; and in a simulation too, should a class of somebody's own leave out the checks."""
    message = f"Cone kind={kind}: .* Plane, Sphere, Capsule, Box or MeshCollider"
    cone = type("Cone", (Collider,), {"kind": kind, "_shape": lambda self, rows: None})
    with pytest.raises(TypeError, match=message):
        cone()
    cone.__post_init__ = lambda self: None
    with pytest.raises(TypeError, match=message):
        Simulation(grid(2, 2, 1.0, 1.0), colliders=[cone()])
    with pytest.raises(ValueError, match="is a Sphere: a Cone cannot take its place"):
        Simulation(grid(2, 2, 1.0, 1.0), colliders=[Sphere()]).set_collider(0, [cone()])


def test_sphere_distance():
    x = points_around()
    expected = np.linalg.norm(x - (0.1, 0.0, 0.2), axis=1) - 0.15
    assert distances(Sphere(center=(0.1, 0, 0.2), radius=0.15, thickness=0), x) == pytest.approx(expected)


def test_capsule_distance_to_its_segment():
    x = points_around()
    axis = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    along = np.clip(x @ axis, -0.15, 0.15)
    expected = np.linalg.norm(x - along[:, None] * axis, axis=1) - 0.1
    found = distances(Capsule(radius=0.1, height=0.5, axis=(1, 1, 0), thickness=0), x)
    outside = expected > -0.1  # on the segment itself the normal is not defined, the distance is
    assert found[outside] == pytest.approx(expected[outside], abs=1e-12)


def test_box_distance_to_its_nearest_point():
    x = points_around()
    half, yaw = np.array([0.2, 0.1, 0.15]), 0.4
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    local = x @ turn.T
    outside = np.linalg.norm(local - np.clip(local, -half, half), axis=1)
    inside = np.min(half - np.abs(local), axis=1)
    expected = np.where(inside > 0, -inside, outside)
    assert distances(Box(half_sides=tuple(half), yaw=yaw, thickness=0), x) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "collider",
    [
        Plane(),
        Sphere(center=(0, 0, -1), radius=1),
        Box(center=(0, 0, -1), half_sides=(1, 1, 1)),
        Capsule(center=(0, 0, -1), radius=1, height=2.0),
    ],
)
def test_inward_velocity_is_killed_and_nothing_is_inside(name, collider):
    """A small sheet thrown at a solid: after the step of contact no particle moves into it or lies in it."""
    mesh = grid(3, 3, 0.02, 0.02)
    simulation = Simulation(mesh, integrator=name, colliders=[collider], time_step=1 / 60, air_density=0, dtype="float64")
    simulation.reset(positions=mesh.rest_positions + (0, 0, 0.005), velocities=(0.3, 0, -3.0))
    simulation.step()
    x, v = simulation.positions[0], simulation.velocities[0]
    assert simulation.contacts().distance.min() > -1e-9
    outward = np.array([0, 0, 1.0]) if isinstance(collider, (Plane, Box)) else None
    normals = (
        np.broadcast_to(outward, x.shape)
        if outward is not None
        else (x - (0, 0, -1)) / np.linalg.norm(x - (0, 0, -1), axis=1)[:, None]
    )
    touching = simulation.contacts().distance[0] < 1e-9
    assert touching.any()
    inward = 1.01 * G * simulation.time_step / simulation.substeps if name in LATE else 1e-8
    assert np.min(np.sum(v * normals, axis=1)[touching]) > -inward


def slope(name, angle, friction, seconds=1.0):
    """A small sheet on a tilted plane (the gravity is tilted instead): distance traveled and final speed."""
    mesh = grid(4, 4, 0.06, 0.06)
    simulation = Simulation(
        mesh,
        Material(),
        air_density=0,
        integrator=name,
        gravity=(G * np.sin(angle), 0, -G * np.cos(angle)),
        colliders=[Plane(friction=friction, thickness=0)],
        time_step=1 / 60,
        dtype="float64",
    )
    simulation.step(round(60 * seconds))
    return np.mean(simulation.positions[0, :, 0]), np.mean(simulation.velocities[0, :, 0])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("friction", [0.3, 0.5])
def test_a_sheet_rests_or_slides_on_either_side_of_the_angle_of_friction(name, friction):
    angle = np.arctan(friction)
    still, _ = slope(name, np.arctan(0.98 * friction), friction)
    gone, _ = slope(name, np.arctan(1.02 * friction), friction)
    assert abs(still) < (5e-4 if name in LATE else 1e-6)
    assert gone > 0.5 * 0.5 * G * 0.02 * friction * np.cos(angle)


@pytest.mark.parametrize("name", NAMES)
def test_sliding_acceleration(name):
    """a = g (sin - mu cos)."""
    angle, friction = np.radians(35), 0.4
    _, speed = slope(name, angle, friction)
    assert speed == pytest.approx(G * (np.sin(angle) - friction * np.cos(angle)), rel=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_a_moving_plate_drags_the_sheet(name):
    """mu g until it moves with the plate: v(t) = mu g t, then the plate's."""
    mesh = grid(4, 4, 0.06, 0.06)
    plate = Box(center=(0, 0, -0.1), half_sides=(2, 2, 0.1), friction=0.2, thickness=0, velocity=(0.5, 0, 0))
    simulation = Simulation(mesh, Material(), air_density=0, integrator=name, colliders=[plate], time_step=1 / 60, dtype="float64")
    simulation.step(6)
    assert simulation.velocities[0, :, 0].mean() == pytest.approx(0.2 * G * 0.1, rel=0.03)
    simulation.step(60)
    assert simulation.velocities[0, :, 0].mean() == pytest.approx(0.5, abs=1e-6)


def test_held_particles_are_not_pushed():
    mesh = grid(3, 3, 0.1, 0.1)
    simulation = Simulation(mesh, colliders=[Plane(point=(0, 0, 0.05))], anchors=[0])
    simulation.step(3)
    assert np.array_equal(simulation.positions[0, 0], mesh.rest_positions[0].astype(np.float32))
    assert simulation.positions[0, 1:, 2].min() > 0.04


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Sphere(radius=0), "radius"),
        (lambda: Sphere(friction=-0.1), "friction"),
        (lambda: Plane(normal=(0, 0, 0)), "normal"),
        (lambda: Box(half_sides=(1, 0, 1)), "half_sides"),
        (lambda: Capsule(radius=0.2, height=0.3), "height"),
        (lambda: Sphere(center=(0, np.nan, 0)), "center"),
        (lambda: Sphere(velocity=(0, 0, 1e39)), r"Sphere velocity holds 1e\+39: must lie within"),
        (lambda: Sphere(thickness=np.inf), "thickness"),
    ],
)
def test_bad_solids_are_named(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_lanes_may_have_different_solids():
    mesh = grid(2, 2, 0.01, 0.01)
    simulation = Simulation(mesh, num_envs=2, colliders=[Sphere(center=(0, 0, 0), radius=1.0)], dtype="float64")
    simulation.set_collider(0, [Box(half_sides=(0.5, 0.5, 0.25), thickness=0.0)], envs=[1])
    simulation.reset(positions=mesh.rest_positions + (0, 0, 2.0))
    found = simulation.contacts().distance
    assert found[0] == pytest.approx(1.0 - 0.001, abs=1e-4)
    assert found[1] == pytest.approx(1.75, abs=1e-9)
    with pytest.raises(ValueError, match="Plane"):
        simulation.set_collider(0, [Plane()], envs=[0])
    for wrong in (None, ["Sphere", "Box"]):
        with pytest.raises(ValueError, match="must be a sequence of 2 colliders"):
            simulation.set_collider(0, wrong)


@pytest.mark.parametrize("name", NAMES)
def test_a_rising_floor_lifts_the_sheet(name):
    """It moves along its normal: the sheet lies on it, at z0 + v t, with its speed."""
    mesh = grid(4, 4, 0.06, 0.06)
    floor = Plane(thickness=0, velocity=(0, 0, 0.5))
    simulation = Simulation(mesh, Material(), air_density=0, integrator=name, colliders=[floor], time_step=1 / 60, dtype="float64")
    simulation.step(30)
    assert simulation.positions[0, :, 2] == pytest.approx(0.25, abs=1e-6)
    assert simulation.velocities[0, :, 2] == pytest.approx(0.5, abs=1e-3)
    simulation.reset()
    simulation.step(30)
    assert simulation.positions[0, :, 2] == pytest.approx(0.25, abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_linear_drag_slows_a_free_sheet(name):
    """v = v0 exp(-b t), b = drag / density, whatever the wind is: it has its own law."""
    mesh = grid(4, 4, 0.06, 0.06)
    material = Material(air_drag=0.5, density=0.1, drag_coefficient=0, skin_friction=0)
    simulation = Simulation(mesh, material, integrator=name, wind=(2, 0, 1), gravity=(0, 0, 0), time_step=1 / 60, dtype="float64")
    simulation.reset(velocities=(2.0, 0, 1.0))
    simulation.step(30)
    expected = np.array([2, 0, 1]) * np.exp(-5 * 0.5)
    assert simulation.velocities[0] == pytest.approx(np.broadcast_to(expected, (16, 3)), abs=2e-2)


@pytest.mark.parametrize("name", NAMES)
def test_a_sheet_that_lies_flat_stays_where_it_is_in_the_wind(name):
    """Skin friction, 0.05 N/m^2 at 2 m/s, against 0.7 N/m^2 of the floor's."""
    simulation = Simulation(
        grid(5, 5, 0.2, 0.2), Material(air_drag=0.72), integrator=name, wind=(2, 0, 0), colliders=[Plane(friction=0.5)],
        dtype="float64",
    )  # fmt: skip
    simulation.reset(positions=simulation.mesh.rest_positions + (0, 0, 0.001))
    before = simulation.positions
    simulation.step(120)
    assert np.abs(simulation.positions - before).max() < 1e-3

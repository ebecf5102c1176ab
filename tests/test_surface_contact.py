"""Contact of the sheet, not only of its particles: how deep its triangles are in solids, by samples and closed forms."""

import numpy as np
import pytest
from solids import ON_ITS_CORNER, bowl, box_distance, capsule_distance, chair, depth, mesh_distance, rotation, sphere_distance

from clothgym import Box, Capsule, Gripper, Material, MeshCollider, Plane, Simulation, Sphere, grid

COTTON = Material.preset("penava_cotton", air_drag=0.2)
AXIS = (1, 0.3, 0)
CHAIR, BOWL = chair(), bowl()
# a solid, its distance, the height of its top above its center, and its size [m]
SOLIDS = {
    "sphere": (Sphere(radius=0.12, friction=0.5), lambda x: sphere_distance(x, 0.12), 0.12, 0.24),
    "capsule": (
        Capsule(radius=0.06, height=0.4, axis=AXIS, friction=0.5),
        lambda x: capsule_distance(x, AXIS, 0.06, 0.4),
        0.06,
        0.12,
    ),
    "box on its corner": (
        Box(half_sides=(0.1, 0.1, 0.1), rotation=ON_ITS_CORNER, friction=0.5),
        lambda x: box_distance(x, 0.1, rotation(*ON_ITS_CORNER)),
        0.1 * np.sqrt(3),
        0.2,
    ),
    "chair": (
        MeshCollider(vertices=CHAIR[0], triangles=CHAIR[1], friction=0.5),
        lambda x: mesh_distance(x, *CHAIR),
        0.45,
        0.4,
    ),
}


def sheet_above(solid, height, rows=17, num_envs=1, **options):
    """A sheet of 0.6 m, not quite in the middle, that lies flat above a solid at the origin."""
    mesh = grid(rows, rows, 0.6, 0.6)
    simulation = Simulation(mesh, COTTON, num_envs, colliders=[solid], **options)
    simulation.reset(positions=mesh.rest_positions + (0.013, 0.007, height))
    return simulation


@pytest.mark.parametrize("name", SOLIDS)
def test_draped_sheet_stays_out(name):
    """Thrown at 1 m/s, at rest, and while the solid moves on at 1 m/s."""
    solid, distance, top, size = SOLIDS[name]
    simulation = sheet_above(solid, top + 0.02)
    triangles = simulation.mesh.triangles
    simulation.reset(positions=simulation.positions, velocities=(0, 0, -1.0))
    moving = []
    for _ in range(12):
        simulation.step()
        moving.append(depth(simulation.positions[0], triangles, distance, pieces=3))
    assert max(moving) < 0.05 * size
    simulation.step(120)
    assert depth(simulation.positions[0], triangles, distance, pieces=6) < 0.01 * size
    # what presses the sheet between its particles may press these into the next part of a solid with corners
    assert simulation.contacts().distance.min() > -1e-4
    for velocity in ((1.0, 0, 0), (0, 0, 1.0)):
        simulation.move_colliders(0, velocities=velocity)
        simulation.step(6)
        x = simulation.positions[0] - simulation.collider_positions[0, 0]
        assert depth(x, triangles, distance, pieces=3) < 0.05 * size


def test_sheet_lies_in_a_bowl():
    """It goes down into the hollow, and not through its wall."""
    solid = MeshCollider(vertices=BOWL[0], triangles=BOWL[1], friction=0.1)
    mesh = grid(13, 13, 0.2, 0.2)
    simulation = Simulation(mesh, COTTON, colliders=[solid])
    simulation.reset(positions=mesh.rest_positions + (0.013, 0.007, 0.01))
    simulation.step(90)
    x = simulation.positions[0]
    assert x[:, 2].min() < -0.09
    assert np.linalg.norm(x, axis=1).max() < 0.16
    assert depth(x, mesh.triangles, lambda p: mesh_distance(p, *BOWL), pieces=3) < 0.01 * 0.3


@pytest.mark.parametrize("lift", [0.0, 0.3, 0.5])
def test_small_sphere_does_not_come_through_between_particles(lift):
    """A ball of a quarter of the spacing rises at 0.5 m/s under a sheet that is held by its border."""
    mesh = grid(9, 9, 0.32, 0.32)
    at = np.abs(mesh.rest_positions).max(axis=1) > 0.159
    ball = Sphere(center=(lift * 0.04, 0.3 * lift * 0.04, -0.02), radius=0.01, velocity=(0, 0, 0.5), friction=0.2)
    simulation = Simulation(mesh, COTTON, anchors=[np.flatnonzero(at)], colliders=[ball], gravity=(0, 0, 0))
    simulation.step(8)
    x = simulation.positions[0]
    center = simulation.collider_positions[0, 0]
    assert center[2] == pytest.approx(-0.02 + 0.5 * 8 / 60, abs=1e-4)
    # it presses into a taut sheet: what lies deeper than it moved in a substep is taken back gently
    assert depth(x, mesh.triangles, lambda p: sphere_distance(p - center, 0.01)) < 0.1 * 0.02
    # the sheet is above the ball, not around it
    near = np.linalg.norm(x[:, :2] - center[:2], axis=1) < 0.05
    assert x[near, 2].max() > center[2]


def test_box_edge_does_not_come_through_between_particles():
    """An edge that rises between two rows of particles, parallel to them."""
    mesh = grid(9, 9, 0.32, 0.32)
    held = np.flatnonzero(np.abs(mesh.rest_positions[:, 0]) > 0.159)
    quarter = (np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0)
    box = Box(center=(0.02, 0, -0.06), half_sides=(0.03, 0.3, 0.03), rotation=quarter, velocity=(0, 0, 0.5))
    simulation = Simulation(mesh, COTTON, anchors=[held], colliders=[box], gravity=(0, 0, 0))
    simulation.step(8)
    center = simulation.collider_positions[0, 0]
    turn = rotation(*quarter)
    assert depth(simulation.positions[0], mesh.triangles, lambda p: box_distance(p - center, 0.03, turn)) < box.thickness
    assert simulation.positions[0, :, 2].max() > center[2] + 0.03


def test_penetration_is_that_of_the_surface():
    """Corners around a small ball: no particle is in it, the triangle is, by its radius; and particles in a plane."""
    mesh = grid(2, 2, 0.2, 0.2)
    for center, expected in (((0.05, -0.04, 0.004), 0.006), ((0.05, -0.04, 0.3), 0.0)):
        simulation = Simulation(mesh, num_envs=3, colliders=[Sphere(center=center, radius=0.01)], dtype="float64")
        assert simulation.contacts().distance.min() > 0.01
        assert simulation.penetration() == pytest.approx(np.full(3, expected), abs=1e-9)
    simulation = Simulation(mesh, colliders=[Plane(point=(0, 0, 0.02), normal=(1, 0, 1))], dtype="float64")
    assert simulation.penetration()[0] == pytest.approx((0.1 + 0.02) / np.sqrt(2))
    corner = Box(center=(0.03, 0.02, -0.1 * np.sqrt(3) + 0.004), half_sides=(0.1, 0.1, 0.1), rotation=ON_ITS_CORNER)
    simulation = Simulation(mesh, colliders=[corner], dtype="float64")
    # a plane cuts off a corner of height h: its deepest point is h/sqrt(3) below each of the three faces
    assert simulation.penetration()[0] == pytest.approx(0.004 / np.sqrt(3), rel=0.02)
    assert Simulation(mesh).penetration()[0] == 0


def test_bits_do_not_depend_on_who_else_touches():
    """A lane that touches the box and one that is far off, together and alone."""
    solid = SOLIDS["box on its corner"][0]
    both = sheet_above(solid, 0.2, rows=9, num_envs=2)
    x = both.positions
    x[1, :, 2] += 5
    both.reset(positions=x)
    both.step(20)
    for env in (0, 1):
        alone = sheet_above(solid, 0.2, rows=9)
        alone.reset(positions=x[env])
        alone.step(20)
        assert np.array_equal(alone.positions[0], both.positions[env])


def test_attachment_slides_along_a_solid_and_says_so():
    """It goes round a ball onto the floor, stops at a wall at 10 m/s, and is free again on the way back."""
    mesh = grid(2, 2, 0.02, 0.02)
    solids = [Plane(), Sphere(center=(0, 0, 0.1), radius=0.1), Box(center=(0.4, 0, 0.5), half_sides=(0.02, 1, 0.5))]
    simulation = Simulation(mesh, num_envs=2, colliders=solids, grippers=[Gripper(position=(0.03, 0, 0.4), speed=10.0)])
    simulation.reset(positions=mesh.rest_positions + (0, 0, 5))
    for target, end in (((0.03, 0, -1), (0.1, 0)), ((2.0, 0, 0), (0.38, 0))):
        for _ in range(60):
            simulation.grippers.move(target, 1.0)
            simulation.step()
            tip = simulation.grippers.positions[:, 0]
            assert (
                sphere_distance(tip - (0, 0, 0.1), 0.1).min() > -1e-5 and tip[:, 2].min() > -1e-6 and tip[:, 0].max() < 0.38 + 1e-5
            )
        assert simulation.blocked.all()
        assert tip[:, 2] == pytest.approx(end[1], abs=1e-4) and (tip[:, 0] >= end[0] - 0.08).all()
    assert tip[:, 0] == pytest.approx(0.38, abs=1e-4)
    simulation.grippers.move((0.3, 0.0, 0.2), 1.0)
    simulation.step()
    assert not simulation.blocked.any()
    simulation.reset()
    assert not simulation.blocked.any()


def test_held_particles_are_not_dragged_into_a_solid():
    """The tip passes above the table's edge, what hangs in the hold would go through it."""
    mesh = grid(5, 5, 0.1, 0.1)
    wall = Box(center=(0.3, 0, 0), half_sides=(0.1, 1, 0.1))
    simulation = Simulation(mesh, colliders=[wall], anchors=[list(range(5))], gravity=(0, 0, 0))
    for _ in range(40):
        simulation.move_anchors(np.array([[[1.0, -0.05, 0.0]]]))
        simulation.step()
    assert simulation.blocked.all()
    assert simulation.positions[0, :5, 0].max() == pytest.approx(0.2, abs=1e-3)
    assert np.isfinite(simulation.positions).all()


def test_rising_table_lifts_the_attachment():
    simulation = Simulation(
        grid(2, 2, 0.02, 0.02), colliders=[Plane(velocity=(0, 0, 0.3))], grippers=[Gripper(position=(0, 0, 0.05))]
    )
    simulation.reset(positions=simulation.mesh.rest_positions + (0, 0, 1))
    for _ in range(30):
        simulation.grippers.move(simulation.grippers.positions, 1.0)
        simulation.step()
    assert simulation.grippers.positions[0, 0, 2] == pytest.approx(0.15, abs=1e-4)


def test_rising_table_lifts_what_hangs_below_the_tip():
    """A particle that is held a centimeter below it meets the table first, and takes the gripper along."""
    mesh = grid(3, 3, 0.1, 0.1)
    tip = Gripper(position=(0, 0, 0.05), reach=0.015, closing_time=1e-3)
    simulation = Simulation(mesh, colliders=[Plane(velocity=(0, 0, 0.3), thickness=0)], grippers=[tip])
    simulation.reset(positions=mesh.rest_positions + (0, 0, 0.04))
    for step in range(30):
        simulation.grippers.move((0, 0, 0.05), 0.0)
        simulation.step()
        assert np.flatnonzero(simulation.grippers.holder[0] == 0).tolist() == [4]
        assert simulation.positions[0, 4, 2] == pytest.approx(max(0.04, 0.005 * (step + 1)), abs=1e-4)
    assert simulation.blocked.all()
    assert simulation.grippers.positions[0, 0, 2] == pytest.approx(0.16, abs=1e-4)


def test_a_sheet_that_its_triangles_bear_comes_to_rest():
    """On a ball whose arc over a triangle's diagonal is higher than the thickness.  Where touches stay as they were found, such a
    sheet trembles at 12 to 60 mm/s for ever."""
    mesh, material = grid(17, 17, 0.6, 0.6), Material.preset("median", air_drag=0.394)
    ball = Sphere(radius=0.08, friction=0.5, thickness=0.002)
    simulation = Simulation(mesh, material, 4, time_step=1 / 30, bending="quadratic", colliders=[ball])
    aside = np.array([[0.01, 0.02, 0], [0.02, -0.01, 0], [-0.03, 0.005, 0], [0, 0.03, 0]])
    simulation.reset(positions=mesh.rest_positions + aside[:, None] + (0, 0, 0.085))
    simulation.step(150)
    speed = np.sqrt(np.mean(np.sum(simulation.velocities.astype(float) ** 2, axis=2), axis=1))
    assert speed.max() < 5e-3

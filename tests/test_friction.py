"""Coulomb's law where the answer is known: a slope, a belt around a cylinder, a plate that moves."""

import numpy as np
import pytest

from clothgym import INTEGRATORS, Box, Capsule, Material, Plane, Simulation, Sphere, grid

G = 9.81
# explicit Euler moves on with the velocity of before: what gravity has just added is stopped a substep later
LATE = {"explicit_euler"}


def slope(name, angle, friction, solid, seconds=0.5):
    """A small sheet on a solid's flat side, gravity tilted instead of it: displacement [m] and speed [m/s] down the slope."""
    simulation = Simulation(
        grid(4, 4, 0.06, 0.06), Material(), integrator=name, gravity=(G * np.sin(angle), 0, -G * np.cos(angle)), air_density=0,
        colliders=[solid(friction)], dtype="float64",
    )  # fmt: skip
    simulation.step(round(60 * seconds))
    return simulation.positions[0, :, 0].mean(), simulation.velocities[0, :, 0].mean()


def plane(friction):
    return Plane(friction=friction, thickness=0)


def table(friction):
    return Box(center=(0, 0, -0.101), half_sides=(3, 3, 0.1), friction=friction)


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("solid", [plane, table])
def test_slope_within_two_percent_of_the_angle_of_friction(name, solid):
    friction = 0.4
    still, _ = slope(name, np.arctan(0.98 * friction), friction, solid)
    gone, _ = slope(name, np.arctan(1.02 * friction), friction, solid)
    assert abs(still) < (5e-4 if name in LATE else 1e-6)
    assert gone > 0.5 * 0.5 * G * 0.02 * friction * 0.5**2 * np.cos(np.arctan(friction))
    _, speed = slope(name, np.radians(40), friction, solid)
    assert speed == pytest.approx(0.5 * G * (np.sin(np.radians(40)) - friction * np.cos(np.radians(40))), rel=0.03)


@pytest.mark.parametrize("angle", [np.pi / 2, 0.8 * np.pi])
@pytest.mark.parametrize("friction", [0.2, 0.4])
def test_belt_around_a_cylinder(angle, friction):
    """Pulled steadily over it, its tensions have the ratio exp(mu angle) (Euler, Eytelwein)."""
    radius, length = 0.1, 0.1 * angle + 0.2
    mesh = grid(31, 2, 0.01, length)
    fabric = Material(stretch_stiffness=20, shear_stiffness=2, bend_rigidity=1e-9, damping_time=3e-3, density=0.1)
    along = 1.01 * mesh.rest_positions[:, 1]
    turn = np.clip(along / radius, -angle / 2, angle / 2)
    beyond = along - turn * radius
    x = np.stack(
        [
            mesh.rest_positions[:, 0],
            radius * np.sin(turn) + beyond * np.cos(turn),
            radius * np.cos(turn) - beyond * np.sin(turn),
        ],
        axis=1,
    )
    ends = [np.flatnonzero(along == along.min()), np.flatnonzero(along == along.max())]
    cylinder = Capsule(radius=radius - 0.001, height=1, axis=(1, 0, 0), friction=friction)
    simulation = Simulation(mesh, fabric, gravity=(0, 0, 0), air_density=0, colliders=[cylinder], anchors=ends, dtype="float64")
    simulation.reset(positions=x)
    out = np.array([[0, side * np.cos(angle / 2), -np.sin(angle / 2)] for side in (-1, 1)])
    start, tensions = simulation.attachment_positions[0], []
    for step in range(75):
        gone = 0.04 * (step + 1) / 60
        simulation.move_anchors((start + gone * np.array([[-1], [1]]) * out)[None])
        simulation.step()
        tensions.append(-np.sum(simulation.pulls()[0] * out, axis=1))
    slack, tight = np.mean(tensions[-30:], axis=0)
    assert tight / slack == pytest.approx(np.exp(friction * angle), rel=0.05)


def test_plate_that_is_moved_carries_the_sheet():
    """There and back by targets, at less than mu g; it comes along with all its particles, and stops with it."""
    mesh = grid(5, 5, 0.1, 0.1)
    plate = Box(center=(0, 0, -0.02), half_sides=(0.2, 0.2, 0.019), friction=0.4)
    simulation = Simulation(mesh, Material(), num_envs=2, colliders=[plate], air_density=0, dtype="float64")
    simulation.step(5)
    before = simulation.positions
    for step in range(60):  # 0.2 m and a rest, at accelerations of at most 0.2 * (pi)^2 / 2 = 1 m/s^2
        way = 0.1 * (1 - np.cos(np.pi * min(step + 1, 60) / 60))
        simulation.move_colliders(0, targets=[[way, 0, -0.02], [0, -way, -0.02]])
        simulation.step()
        assert simulation.collider_positions[0, 0] == pytest.approx([way, 0, -0.02], abs=1e-12)
    assert simulation.positions[0] - before[0] == pytest.approx(np.broadcast_to([0.2, 0, 0], (25, 3)), abs=1e-3)
    assert simulation.positions[1] - before[1] == pytest.approx(np.broadcast_to([0, -0.2, 0], (25, 3)), abs=1e-3)
    simulation.step(10)
    assert np.abs(simulation.velocities).max() < 1e-3
    assert simulation.collider_positions[0, 0] == pytest.approx([0.2, 0, -0.02], abs=1e-12)


def test_draped_sheet_stays_on_a_ball_that_holds_it_between_its_particles():
    """The ball touches inside of triangles only; friction holds the sheet as it would by particles."""
    mesh = grid(2, 2, 0.1, 0.1)
    moved = {}
    for friction in (0.0, 0.5):
        simulation = Simulation(
            mesh, Material(), gravity=(0.5, 0, -9.8), colliders=[Sphere(center=(0.02, 0, -10.0), radius=10.0, friction=friction)]
        )
        simulation.reset(positions=mesh.rest_positions + (0, 0, 0.001))
        simulation.step(30)
        moved[friction] = simulation.positions[0, :, 0].mean()
    assert moved[0.0] == pytest.approx(0.5 * 0.5 * 0.5**2, rel=0.1)
    assert abs(moved[0.5]) < 1e-3


def test_moves_are_checked():
    simulation = Simulation(grid(2, 2, 0.1, 0.1), num_envs=3, colliders=[Sphere(), Plane()])
    before = simulation.get_state()
    for arguments, message in (
        ({"index": 2, "targets": (0, 0, 0)}, "index=2: must be the place of a collider, an integer of at most 1"),
        ({"index": 0}, "targets, velocities, or both"),
        ({"index": 0, "targets": (0, np.nan, 0)}, "not finite"),
        ({"index": 0, "targets": np.zeros((2, 3))}, r"shape \(2, 3\)"),
        ({"index": 0, "velocities": (0, 0)}, "velocities has shape"),
        ({"index": 0, "velocities": (0, 0, -1e39)}, r"velocities holds -1e\+39: must lie within 1e\+30"),
        ({"index": 0, "targets": 0.5}, r"targets has shape \(\): must be \(3,\)"),
        ({"index": 1, "velocities": (0, 0, 1), "envs": [3]}, "envs"),
    ):
        with pytest.raises(ValueError, match=message):
            simulation.move_colliders(**arguments)
    assert np.array_equal(simulation.get_state().colliders, before.colliders)
    simulation.move_colliders(0, targets=(1, 0, 0), velocities=(0, 0, 0.6), envs=[1])
    simulation.step(2)
    assert simulation.collider_positions[:, 0] == pytest.approx(np.array([(0, 0, 0), (1, 0, 0.01), (0, 0, 0)]), abs=1e-6)
    simulation.reset()
    assert simulation.collider_positions[:, 0] == pytest.approx(np.zeros((3, 3)))
    simulation.step()
    assert simulation.collider_positions[:, 0] == pytest.approx(np.zeros((3, 3)))

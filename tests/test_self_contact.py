"""Self-collision at the door: its state, its batch, other integrators, environments, and bad input."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from exact_intersections import intersecting_pairs
from folded import SIDE, sheet, three_layers

import clothgym
from clothgym.starts import MANEUVERS


def test_a_restored_state_goes_on_to_the_bit(tmp_path):
    mesh = sheet(13)
    made = MANEUVERS["z-fold"](mesh, seeds=range(2), self_collision="strict")
    for _ in range(25):
        made.step()
    first = made.simulation
    assert first.self_contacts.rows.min() > 10
    state = first.get_state()
    assert not state.self_contact["members"][state.self_contact["members"][:, :, 1] == 4][:, 7:].any()
    state.save(tmp_path / "state.npz")
    first.step(20)
    other = MANEUVERS["z-fold"](mesh, seeds=range(2), self_collision="strict").simulation
    other.set_state(clothgym.State.load(tmp_path / "state.npz"))
    other.step(20)
    np.testing.assert_array_equal(first.positions, other.positions)


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("self_contact particles", lambda a: a + 169, "name particles beyond the 169"),
        ("self_contact members", lambda a: np.where(np.arange(11) == 1, 9, a), "more vertices than a pair has"),
        ("self_contact coefficients", lambda a: a[:, :1], r"self_contact\[\'coefficients\'\] has shape \(1, 1, 8\)"),
        ("self_contact impulses", lambda a: np.tile(a, (1, 999, 1)), "impulses.* has shape"),
        ("self_contact contacts", lambda a: a + 1000, "particles.* has shape"),
        ("self_contact contacts", lambda a: a + 0.5, "contacts.* is no array of int32"),
        ("self_contact bounds", lambda a: a + np.inf, "bounds.* holds a value that is not finite"),
        ("self_contact planes", lambda a: a * np.nan, "planes.* holds a value that is not finite"),
        ("self_contact span", lambda a: a - 100, "span.* holds -"),
        ("self_contact lag", lambda a: None, "lag.* is no array"),
        ("holder", lambda a: a + 32000, "holder holds 31999: it must be from -1 to -1"),
        ("free_inverse_mass", lambda a: -a, "free_inverse_mass holds -"),
        ("gravity", lambda a: a * np.nan, "gravity holds a value that is not finite"),
        ("gravity", lambda a: a[0, 0], r"gravity has shape \(\), this simulation's \(1, 3\)"),
        ("diverged", lambda a: a[:0], r"diverged has shape \(0,\), this simulation's \(1,\)"),
        ("free_inverse_mass", lambda a: a[:, 1:], r"free_inverse_mass has shape \(1, 168\), this simulation's \(1, 169\)"),
    ],
)
def test_a_state_with_contacts_of_another_sheet_is_refused_and_changes_nothing(name, spoil, message):
    made = MANEUVERS["z-fold"](sheet(13), self_collision="strict")
    for _ in range(25):
        made.step()
    state, before = made.simulation.get_state(), made.simulation.positions
    table, _, part = name.partition(" ")
    if part:
        state.self_contact[part] = spoil(state.self_contact[part])
    else:
        setattr(state, table, spoil(getattr(state, table)))
    state.positions = state.positions + 1
    with pytest.raises(ValueError, match=message):
        made.simulation.set_state(state)
    np.testing.assert_array_equal(made.simulation.positions, before)


def test_a_state_in_which_one_environment_has_diverged_is_taken():
    simulation = clothgym.Simulation(sheet(7), num_envs=2, self_collision="strict", air_density=0)
    simulation.set_parameters([0], warn=False, gravity=(0, 0, -1e28))
    with pytest.warns(RuntimeWarning, match="environment 0"):
        simulation.step()
    assert simulation.diverged.tolist() == [True, False]
    state, before = simulation.get_state(), simulation.positions
    simulation.reset()
    simulation.set_state(state)
    np.testing.assert_array_equal(simulation.positions, before)


def test_a_state_of_a_sheet_beyond_what_can_be_certified_is_taken_too():
    simulation = clothgym.Simulation(sheet(5), num_envs=2, self_collision="strict")
    velocities = np.zeros((2, 25, 3))
    velocities[1, :, 0] = 60.0
    simulation.reset(positions=simulation.mesh.rest_positions + (15.5, 0, 0), velocities=velocities)
    with pytest.warns(RuntimeWarning, match="environment 1: .* more than 16 m"):
        simulation.step(4)
    state = simulation.get_state()
    simulation.set_state(state)
    np.testing.assert_array_equal(simulation.get_state().self_contact["start"], state.self_contact["start"])
    # the one that intersects is named by its own number
    state.diverged[0], state.positions[1] = True, state.positions[1] * (1, 0, 0)
    with pytest.raises(ValueError, match="in environment 1 triangles"):
        simulation.set_state(state)


def test_what_another_attachment_takes_does_not_lag():
    """A corner lags behind the gripper that pulls it at the sheet; another takes it there, and carries it as far as it goes."""
    mesh = sheet(13)
    away = np.abs(mesh.rest_positions[:, :2] - mesh.rest_positions[0, :2]).max(axis=1)
    grippers = [clothgym.Gripper(position=(0, 0, z), reach=0.05, speed=2, closing_time=1e-3) for z in (0.5, 0.6)]
    simulation = clothgym.Simulation(
        mesh, anchors=np.flatnonzero(away > 0.3).tolist(), self_collision="strict", gravity=(0, 0, 0), grippers=grippers
    )

    def go(first, second, openings, frames):
        for _ in range(frames):
            simulation.grippers.move([[first, second]], [openings])
            simulation.step()

    corner, far = simulation.positions[0, 0], np.array([0, 0, 0.6])
    simulation.grippers.place([[corner, far]])
    go(corner, far, (0, 1), 2)
    for place, frames in (((0, 0, 0.15), 30), ((0.12, 0.12, 0.1), 30), ((0.12, 0.12, -0.02), 14)):
        go(place, far, (0, 1), frames)
    assert simulation.self_contacts.lag[0] > 0.01
    place, first = simulation.positions[0, 0], simulation.grippers.positions[0, 0]
    simulation.grippers.place([[first, place]])
    go(first, place, (1, 0), 1)
    assert simulation.grippers.holder[0, 0] == 1
    assert simulation.self_contacts.lag[0] == 0
    before = simulation.positions[0, 0]
    go(first, place + (0, 0, 0.15), (1, 0), 40)
    np.testing.assert_allclose(simulation.positions[0, 0] - before, (0, 0, 0.15), atol=1e-4)


def test_what_collides_with_itself_does_not_sink_into_the_floor():
    """It has the last word in a substep, and pushes what lies below down: by less than a tenth of the cloth's thickness."""
    drop, deepest = MANEUVERS["edge drop"](clothgym.grid(13, 13, 1.0, 1.0), self_collision="strict", time_step=1 / 60), 0.0
    thickness = drop.simulation._contact.thickness
    while drop.time < 3:
        drop.step()
        deepest = max(deepest, drop.simulation.penetration()[0])
    assert drop.simulation.self_contacts.rows[0] > 10
    assert deepest < 0.1 * thickness


def test_an_environment_does_not_feel_its_batch():
    mesh = sheet(9)
    together = MANEUVERS["z-fold"](mesh, seeds=range(19), self_collision="strict")
    alone = MANEUVERS["z-fold"](mesh, seeds=[7], self_collision="strict")
    for _ in range(30):
        together.step()
        alone.step()
    assert alone.simulation.self_contacts.rows[0] > 0
    np.testing.assert_array_equal(together.simulation.positions[7], alone.simulation.positions[0])


@pytest.mark.parametrize("name", ["verlet", "xpbd", "projective_dynamics"])
def test_other_integrators_take_part(name):
    """One of each kind: explicit, by projections, implicit; the module knows none of them."""
    mesh = sheet(9)
    simulation = clothgym.Simulation(
        mesh, integrator=name, substeps=16 if name == "projective_dynamics" else "auto",
        colliders=[clothgym.Plane(friction=0.5)], self_collision="strict",
    )  # fmt: skip
    simulation.reset(positions=three_layers(mesh, 0.06))
    simulation.step(45)
    assert not intersecting_pairs(mesh.triangles, simulation.positions[0])
    assert not simulation.diverged[0]
    assert np.ptp(simulation.positions[0, :, 2]) > 1.8 * 0.28 * SIDE / 8 / np.sqrt(2)  # three layers


def test_an_environment_takes_it_and_tells_of_it():
    env = gym.make("clothgym:ClothDrape-v0", self_collision="strict")
    env.reset(seed=0)
    for _ in range(8):
        *_, info = env.step(np.array([0.5, 0.2, -1, -0.5, -0.2, -1, 0.3, 0.3], np.float32)[: env.action_space.shape[0]])
    assert {"self_contacts", "clamped_moves", "attachment_lag"} <= set(info)
    assert env.unwrapped.task.simulation.intersections()[0] == 0


# --- bad input --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("strickt", "'fast' or 'strict'"),
        ({"mode": "strict", "thickness": -1.0}, "thickness"),
        ({"mode": "strict", "friction": -0.1}, "friction"),
        ({"mode": "strict", "thicknes": 0.01}, "no option 'thicknes'"),
        ({"mode": "strict", "thickness": 0.05}, "at most"),
        ({"mode": "strict", "thickness": 1e-5}, "strict mode takes 0.0002 m and more"),
        (True, "must be False, 'fast' or 'strict'"),
        (np.array(["strict", "fast"]), "must be False, 'fast' or 'strict'"),
    ],
)
def test_bad_options_are_named(value, message):
    with pytest.raises(ValueError, match=message):
        clothgym.Simulation(sheet(), self_collision=value)


def test_a_start_in_intersection_is_refused_and_changes_nothing():
    simulation = clothgym.Simulation(sheet(), self_collision="strict")
    before = simulation.positions
    x = three_layers(sheet(), 0.02)
    x[:, 2] = np.abs(x[:, 2] - 0.02)
    with pytest.raises(ValueError, match="triangles .* intersect"):
        simulation.reset(positions=x)
    np.testing.assert_array_equal(simulation.positions, before)


def test_a_sheet_that_flies_too_far_is_reported():
    simulation = clothgym.Simulation(sheet(5), gravity=(0, 0, 0), self_collision="strict")
    simulation.reset(velocities=np.full((1, 25, 3), (60.0, 0.0, 0.0)))
    with pytest.warns(RuntimeWarning, match="16 m from the origin"):
        simulation.step(40)
    assert simulation.self_contacts.uncertified[0]


def test_a_sheet_too_far_from_the_origin_is_reported():
    simulation = clothgym.Simulation(sheet(), self_collision="strict")
    far = sheet().rest_positions + [20.0, 0, 0]
    with pytest.raises(ValueError, match="16 m"):
        simulation.reset(positions=far)
    simulation.reset(positions=sheet().rest_positions + [15.5, 0, 0], velocities=np.array([10.0, 0, 0]))
    with pytest.warns(RuntimeWarning, match="16 m"):
        simulation.step(20)
    clothgym.Simulation(sheet(), self_collision="strict", dtype="float64").reset(positions=far)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e25])
def test_a_diverged_lane_neither_hangs_nor_touches_its_neighbors(value):
    mesh = sheet(9)
    x = np.stack([three_layers(mesh, 0.03)] * 3)
    runs = []
    for gone in (False, True):
        simulation = clothgym.Simulation(mesh, num_envs=3, self_collision="strict", on_divergence="ignore")
        simulation.reset(positions=x)
        simulation.step(2)
        if gone:
            state = simulation.get_state()
            state.diverged[1], state.positions[1, 40], state.velocities[1, 40] = True, value, value
            simulation.set_state(state)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a sheet that is far away
            simulation.step(5)
        runs.append(simulation)
    np.testing.assert_array_equal(runs[1].diverged, [False, True, False])
    np.testing.assert_array_equal(runs[0].positions[[0, 2]], runs[1].positions[[0, 2]])


def test_sheets_that_strict_mode_cannot_keep_apart_are_named():
    with pytest.raises(ValueError, match="for this sheet a thickness of 9.9e-05 m is usual: strict mode takes 0.0002 m and more"):
        clothgym.Simulation(clothgym.grid(9, 9, 0.004, 0.004), self_collision="strict")
    crossing = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, -0.5], [0.3, 0.3, 0.5], [0.6, 0.6, 0.5]], float)
    with pytest.raises(ValueError, match="at rest this sheet intersects itself, for instance triangles 0 and 1"):
        clothgym.Simulation(clothgym.triangle_mesh(crossing, [[0, 1, 2], [3, 4, 5]]), self_collision="strict")
    apart = clothgym.triangle_mesh(crossing + np.outer([0, 0, 0, 1, 1, 1], [0, 0, 0.7]), [[0, 1, 2], [3, 4, 5]])
    simulation = clothgym.Simulation(apart, self_collision="strict")
    # 0.2 m from the first triangle to the lowest corner of the second
    assert simulation.get_state().self_contact["bounds"].shape == (1, 6)
    assert simulation._contact.thickness == pytest.approx(0.28 * 0.2)
    assert np.isfinite(
        clothgym.Simulation(clothgym.triangle_mesh(crossing[:3], [[0, 1, 2]]), self_collision="strict")._contact.thickness
    )

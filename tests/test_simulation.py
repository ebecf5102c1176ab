"""The main loop's door: anchors, state, parameters, automatic substeps, and what is said to bad input."""

import warnings

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Plane, Simulation, State, files, grid
from clothgym.state import VERSION

NAMES = list(INTEGRATORS)
MESH = grid(5, 5, 0.2, 0.2)


def simulation(**kwargs):
    return Simulation(MESH, **({"anchors": [0, 4], "time_step": 1 / 30} | kwargs))


@pytest.mark.parametrize("name", NAMES)
def test_held_corners_stay_to_the_last_bit(name):
    s = simulation(integrator=name)
    before = s.positions[0, [0, 4]]
    s.step(30)
    assert np.array_equal(s.positions[0, [0, 4]], before)
    assert s.positions[0, 12, 2] < -0.01


@pytest.mark.parametrize("name", NAMES)
def test_anchors_reach_their_targets_at_a_bounded_speed(name):
    s = simulation(integrator=name, anchor_speed=1.0)
    start = s.positions[:, [0, 4]]
    near, far = start + (0.01, 0, 0.02), start + (0, 0, 3.0)
    s.move_anchors(near)
    s.step()
    assert s.positions[:, [0, 4]] == pytest.approx(near, abs=2e-6)
    s.move_anchors(far)
    s.step()
    assert s.positions[:, [0, 4], 2] == pytest.approx(near[..., 2] + 1 / 30, abs=1e-5)


def test_release_and_attach_by_environment():
    s = simulation(num_envs=3)
    s.release(envs=[1], anchors=[0])
    assert s.attached.tolist() == [[True, True], [False, True], [True, True]]
    s.step(5)
    assert s.positions[1, 0, 2] < s.positions[0, 0, 2]
    s.attach(envs=[1], anchors=[0])
    held = s.positions[1, 0]
    s.step(5)
    assert s.positions[1, 0] == pytest.approx(held, abs=1e-7)


def test_reset_puts_one_environment_back_and_leaves_the_others():
    s = simulation(num_envs=2)
    s.step(5)
    moved = s.positions[1]
    s.reset(envs=[0])
    assert np.array_equal(s.positions[0], MESH.rest_positions.astype(np.float32))
    assert np.array_equal(s.positions[1], moved)


@pytest.mark.parametrize("name", NAMES)
def test_a_restored_state_goes_on_bit_for_bit(name, tmp_path):
    s = simulation(integrator=name, num_envs=3, colliders=[Plane(point=(0, 0, -0.1), velocity=(0.1, 0, 0))])
    s.set_parameters([1], gravity=(0, 1, -5))
    if name != "projective_dynamics":
        s.set_parameters([1], density=0.3)
    s.move_anchors(s.positions[:, [0, 4]] + 0.05)
    s.step(7)
    s.release([2], [1])
    s.get_state().save(tmp_path / "state.npz")
    s.step(9)
    other = simulation(integrator=name, num_envs=3, colliders=[Plane()])
    other.set_state(State.load(tmp_path / "state.npz"))
    other.step(9)
    assert np.array_equal(other.positions, s.positions)
    assert np.array_equal(other.velocities, s.velocities)


def test_a_state_that_does_not_fit_is_refused(tmp_path):
    s = simulation(num_envs=2)
    for other, name in (
        (simulation(num_envs=3), "positions"),
        (simulation(num_envs=2, anchors=[1, 4]), "anchors"),
        (simulation(num_envs=2, colliders=[Plane()]), "colliders"),
    ):
        with pytest.raises(ValueError, match=name):
            s.set_state(other.get_state())
    with pytest.raises(ValueError, match="envs=.0, 0.: names an environment twice"):
        s.reset(envs=[0, 0])
    files.write_arrays(tmp_path / "old.npz", "state", VERSION, {"positions": np.zeros(3)})
    with pytest.raises(ValueError, match="old.npz' is no state .it lacks anchors"):
        State.load(tmp_path / "old.npz")


def test_properties_are_fresh_copies():
    s = simulation()
    s.positions[:] = 7
    assert np.array_equal(s.positions[0], MESH.rest_positions.astype(np.float32))


def test_a_tenfold_time_step_is_subdivided():
    """The same second of physics, in steps ten times as long: as many substeps, the same bits."""
    short = simulation(time_step=1 / 50)
    long = simulation(time_step=1 / 5)
    assert long.substeps == pytest.approx(10 * short.substeps, rel=0.1)
    short.step(50)
    long.step(5)
    assert long.positions == pytest.approx(short.positions, abs=2e-3)


def test_too_few_substeps_warn_with_the_number_that_would_do():
    enough = simulation().substeps
    with pytest.warns(UserWarning, match=f"substeps={enough}"):
        simulation(substeps=5)


def test_parameters_differ_by_lane():
    s = simulation(num_envs=4)
    s.set_parameters([1, 3], density=[0.15, 0.30], gravity=[[0, 0, -9.81], [0, 0, 0.0]])
    s.step(10)
    alone = simulation(material=Material.preset("penava_cotton", density=0.15))
    alone.step(10)
    assert s.positions[1] == pytest.approx(alone.positions[0], abs=1e-5)
    assert s.positions[3] == pytest.approx(MESH.rest_positions, abs=1e-6)
    assert not np.array_equal(s.positions[0], s.positions[3])


def test_stiffness_beyond_the_bound_warns_when_it_is_set():
    s = simulation(num_envs=2)
    with pytest.warns(UserWarning, match="too few for semi_implicit_euler"):
        s.set_parameters([1], stretch_stiffness=261e3)


def test_a_diverging_lane_leaves_its_neighbors_bits_alone():
    s, sound = (simulation(num_envs=3, on_divergence="ignore") for _ in range(2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        s.set_parameters([1], stretch_stiffness=261e3)
    for each in (s, sound):
        each.reset(positions=MESH.rest_positions + np.random.default_rng(0).normal(scale=1e-3, size=(25, 3)))
        each.step(20)
    assert not np.isfinite(s.positions[1]).all()
    assert np.array_equal(s.positions[[0, 2]], sound.positions[[0, 2]])


def test_strain_energy_and_contacts_of_a_stretched_sheet():
    s = simulation(dtype="float64", colliders=[Plane(point=(0, 0, -1), thickness=0)])
    s.reset(positions=MESH.rest_positions * (1.1, 1, 1))
    strain = s.strain()
    assert strain.shape == (1, 40)
    assert np.sort(strain[0])[[0, -1]] == pytest.approx([0, 0.1], abs=1e-12)
    assert s.energy().kinetic[0] == 0 and s.energy().elastic[0] > 0
    assert s.contacts().distance[0] == pytest.approx(1.0)
    assert s.energy().gravity[0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"num_envs": 0}, "num_envs=0"),
        ({"num_envs": 1.5}, "num_envs"),
        ({"integrator": "euler"}, "semi_implicit_euler"),
        ({"substeps": 0}, "substeps=0"),
        ({"substeps": "many"}, "substeps='many'"),
        ({"time_step": -1}, "time_step"),
        ({"dtype": "float16"}, "float32"),
        ({"anchors": [99]}, "0 to 24"),
        ({"anchors": [3, 3]}, "twice"),
        ({"gravity": (0, 0)}, "gravity"),
        ({"gravity": (0, 0, np.nan)}, "gravity"),
        ({"threads": 0}, "threads"),
        ({"threads": 1.5}, "threads"),
        ({"substeps": True}, "substeps"),
        ({"anchors": [0.7]}, "anchors"),
        ({"time_step": "a"}, "time_step"),
        ({"material": "cotton"}, "Material.preset"),
        ({"colliders": Plane()}, "sequence"),
        ({"anchor_speed": 0}, "anchor_speed"),
    ],
)
def test_bad_arguments_are_named(kwargs, name):
    with pytest.raises(ValueError, match=name):
        simulation(**kwargs)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda s: s.move_anchors(np.zeros((1, 3, 3))), "targets"),
        (lambda s: s.move_anchors(np.full((1, 2, 3), np.nan)), "targets"),
        (lambda s: s.reset(positions=np.zeros((4, 3))), "positions"),
        (lambda s: s.reset(velocities=np.full((25, 3), np.inf)), "velocities"),
        (lambda s: s.set_parameters(stretch_stiffness=-1), "stretch_stiffness"),
        (lambda s: s.set_parameters(stifness=1), "no parameter 'stifness'"),
        (lambda s: s.release(envs=[5]), "environments are 0 to 0"),
        (lambda s: s.release(envs=[0], anchors=[2]), "anchors are 0 to 1"),
        (lambda s: s.set_collider(0, [Plane()]), "0 colliders"),
        (lambda s: s.step(-1), "n=-1"),
        (lambda s: s.release(envs=[0.9]), "integers"),
        (lambda s: s.set_parameters(density=[0.1, 0.2]), "density has shape"),
    ],
)
def test_bad_calls_are_named_and_change_nothing(call, name):
    s = simulation()
    before = s.get_state()
    with pytest.raises(ValueError, match=name):
        call(s)
    after = s.get_state()
    assert np.array_equal(before.positions, after.positions) and np.array_equal(before.stiffness, after.stiffness)

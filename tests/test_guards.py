"""What keeps a simulation from going wrong unseen: divergence found in its very step, reported, and kept from the neighbors."""

import warnings

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Plane, Simulation, State, disc, grid
from clothgym.forces import frequency_bound, largest_frequency

MESH = grid(5, 5, 0.2, 0.2)


def batch(num_envs=5, wild=2, factor=40.0, **kwargs):
    """Sheets of which one is too stiff for the substeps."""
    simulation = Simulation(MESH, num_envs=num_envs, anchors=[0, 4], **kwargs)
    if wild is not None:
        simulation.set_parameters([wild], warn=False, stretch_stiffness=factor * 261.0)
    simulation.reset(positions=MESH.rest_positions + np.random.default_rng(0).normal(scale=1e-4, size=(25, 3)))
    return simulation


def gone_wrong(simulation):
    """By its own look at what everybody can see: not finite, or faster than ten kilometers a second."""
    x, v = simulation.positions, simulation.velocities
    with np.errstate(invalid="ignore"):
        return ~(np.isfinite(x).all(axis=(1, 2)) & (np.abs(v) < 1e4).all(axis=(1, 2)))


@pytest.mark.parametrize("factor", [6.0, 40.0, 1000.0])
def test_divergence_is_found_in_the_very_step(factor):
    """Never before the state itself shows it, and never a step later; once found it stays said."""
    simulation = batch(factor=factor, on_divergence="ignore")
    ever = np.zeros(5, bool)
    for _ in range(30):
        simulation.step()
        ever |= gone_wrong(simulation)
        assert np.array_equal(simulation.diverged, ever)
    assert ever.tolist() == [False, False, True, False, False]


def test_the_warning_names_environment_step_and_remedy_and_comes_once():
    silent, loud = batch(on_divergence="ignore"), batch()
    step = 0
    while not silent.diverged.any():
        silent.step()
        step += 1
    loud.step(step - 1) if step > 1 else None
    with pytest.warns(RuntimeWarning) as said:
        loud.step()
    text = str(said[0].message)
    assert text.startswith(f"environment 2 diverged in control step {step}: semi_implicit_euler with {loud.substeps} substeps")
    assert "Use more substeps" in text and "reset() restarts them" in text
    loud.step(5)  # warnings are errors here: it is not reported twice


def test_several_environments_are_told_in_one_sentence():
    simulation = batch(wild=None)
    simulation.set_parameters([1, 3], warn=False, stretch_stiffness=1e6)
    with pytest.warns(RuntimeWarning, match="environments 1, 3 diverged in control step"):
        simulation.step(10)


def test_raise_stops_and_the_next_step_may_go_on_after_a_reset():
    simulation = batch(on_divergence="raise")
    with pytest.raises(FloatingPointError, match="environment 2 diverged"):
        simulation.step(60)
    simulation.reset([2])
    simulation.set_parameters([2], stretch_stiffness=261.0)
    simulation.step(3)
    assert not simulation.diverged.any() and np.isfinite(simulation.positions).all()


def test_a_wrong_on_divergence_option_lists_the_valid_ones():
    with pytest.raises(ValueError, match="warn or .*raise|'warn'"):
        batch(on_divergence="stop")


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "explicit_euler"])
def test_neighbors_of_a_diverged_environment_keep_their_bits(integrator):
    """The others of the batch, against a batch in which nothing goes wrong."""
    kwargs = {"integrator": integrator, "on_divergence": "ignore", "colliders": [Plane(point=(0, 0, -0.1))]}
    with_one, without = batch(factor=1000.0, **kwargs), batch(wild=None, **kwargs)
    with_one.step(20)
    without.step(20)
    others = [0, 1, 3, 4]
    assert with_one.diverged.tolist() == [False, False, True, False, False]
    assert np.array_equal(with_one.positions[others], without.positions[others])
    assert np.array_equal(with_one.velocities[others], without.velocities[others])


def test_reset_clears_the_flag_and_the_next_divergence_is_told_again():
    simulation = batch(factor=1000.0)
    for _ in range(2):
        with pytest.warns(RuntimeWarning, match="environment 2"):
            simulation.step(20)
        assert simulation.diverged[2]
        simulation.reset([2])
        assert not simulation.diverged.any()


def test_a_speed_beyond_ten_kilometers_a_second_is_divergence():
    simulation = Simulation(MESH, num_envs=5, on_divergence="ignore", gravity=(0, 0, 0), air_density=0)
    velocities = np.zeros((5, 25, 3))
    velocities[1], velocities[3] = 11000.0, 4000.0
    simulation.reset(velocities=velocities)
    simulation.step()
    assert simulation.diverged.tolist() == [False, True, False, False, False]


# --- the bound on the substep ---------------------------------------------------------------------------------------------


def sheet_of_triangles():
    mesh = disc(0.15, 5)
    rng = np.random.default_rng(0)
    return mesh, mesh.rest_positions + rng.normal(scale=1e-9, size=mesh.rest_positions.shape)


@pytest.mark.parametrize(
    ("integrator", "bending", "rigidity"),
    [("semi_implicit_euler", "hinge", 100.0), ("semi_implicit_euler", "quadratic", 1e-2), ("rk4", "springs", 0.0)],
)
def test_the_bound_of_a_triangle_mesh_is_sharp(integrator, bending, rigidity):
    """A disturbance of the flat disc stays below 0.99 times the bound, and grows at 1.01 times it.  For hinges the
    bound adds what the quadratic model would do in the plane: it is sharp where bending alone decides."""
    mesh, start = sheet_of_triangles()
    material = Material(bend_rigidity=rigidity, damping_time=0.0)
    growth = []
    for share in (0.99, 1.01):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            simulation = Simulation(
                mesh, material, integrator=integrator, bending=bending, gravity=(0, 0, 0), air_density=0, dtype="float64",
                time_step=1e-3, on_divergence="ignore",
            )  # fmt: skip
        simulation.time_step, simulation.substeps = 200 * share * simulation.largest_substep()[0], 200
        simulation.reset(positions=start)
        simulation.step(5)
        growth.append(np.abs(simulation.positions[0] - mesh.rest_positions).max() / 1e-9)
    assert growth[0] < 200
    assert not growth[1] < 1e4  # or not a number


@pytest.mark.parametrize("bending", ["springs", "hinge", "quadratic"])
def test_the_quick_bound_is_never_below_the_largest_frequency(bending):
    for mesh in (grid(6, 6, 0.3, 0.3), disc(0.15, 4)):
        simulation = Simulation(mesh, Material(bend_rigidity=1e-3 if bending != "springs" else 1e-6), bending=bending)
        oscillators = simulation._oscillators(0)
        exact = largest_frequency(oscillators)
        assert exact <= frequency_bound(oscillators) < 1.6 * exact


def test_too_few_substeps_for_a_triangle_mesh_warn_with_the_number_that_would_do():
    mesh = disc(0.15, 5)
    enough = Simulation(mesh, bending="hinge").substeps
    with pytest.warns(UserWarning, match=f"substeps={enough}"):
        Simulation(mesh, bending="hinge", substeps=2)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_sheet_may_begin_folded_on_itself(name):
    """Springs of no length have no direction: they must not pull anywhere, and above all not make numbers that are none."""
    sheet = grid(5, 5, 0.2, 0.2)
    folded = sheet.rest_positions * (1, 1, 1)
    folded[:, 0] = -np.abs(folded[:, 0])
    simulation = Simulation(sheet, integrator=name, anchors=[0], substeps=200, on_divergence="raise")
    simulation.reset(positions=folded)
    simulation.step(10)
    assert simulation.strain().max() < 0.2


def test_forces_that_are_not_finite_are_seen_through_conjugate_gradients():
    """Alone: in a batch a neighbor's iterations would carry them on."""
    simulation = Simulation(MESH, integrator="implicit_euler", anchors=[0], on_divergence="ignore")
    simulation._fabric.stiffness[:] = np.nan
    simulation.step()
    assert simulation.diverged.all()


def test_divergence_is_part_of_the_state():
    simulation = batch(factor=1000.0, on_divergence="ignore")
    simulation.step(5)
    other = Simulation(MESH, num_envs=5, anchors=[0, 4], on_divergence="raise")
    other.set_state(simulation.get_state())
    assert other.diverged.tolist() == [False, False, True, False, False]
    other.step()  # what was known before is not reported again


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (lambda: Simulation(grid(5, 5, 2.0, 2.0), anchors=[0]).get_state(), "another shape or size"),
        (lambda: Simulation(MESH, anchors=[0], bending="hinge").get_state(), "another bending model"),
        (lambda: None, "state=None: give what get_state"),
    ],
)
def test_a_state_of_another_sheet_is_refused(state, said):
    with pytest.raises(ValueError, match=said):
        Simulation(MESH, anchors=[0]).set_state(state())


def test_a_matrix_for_all_refuses_a_state_of_many_fabrics():
    many = Simulation(MESH, num_envs=2)
    many.set_parameters(stretch_stiffness=[100.0, 200.0])
    with pytest.raises(ValueError, match="factorizes one matrix"):
        Simulation(MESH, num_envs=2, integrator="projective_dynamics").set_state(many.get_state())


def test_a_file_that_is_no_state_is_named(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("not arrays")
    with pytest.raises(ValueError, match="notes.txt.*State.save"):
        State.load(path)


def test_shear_means_nothing_on_triangles():
    with pytest.raises(ValueError, match="stretch_stiffness and Poisson's ratio"):
        Simulation(disc(0.1, 2)).set_parameters(shear_stiffness=3.0)

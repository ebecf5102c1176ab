"""The table of integrators: names, options, what each refuses, and what all have in common beside cloth."""

import warnings

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Simulation, grid
from clothgym.integrators import Integrator, get

NAMES = list(INTEGRATORS)
SHEET = grid(4, 4, 0.3, 0.3)


def test_the_table_matches_the_readme():
    assert NAMES == [
        "explicit_euler", "semi_implicit_euler", "verlet", "rk4", "implicit_euler", "projective_dynamics", "pbd", "xpbd",
    ]  # fmt: skip
    assert {name: method.order for name, method in INTEGRATORS.items() if method.order != 1} == {"verlet": 2, "rk4": 4, "pbd": None}
    for name, method in INTEGRATORS.items():
        assert isinstance(method, Integrator) and method.name == name and method.cost and method.damping


def test_names_and_objects_are_accepted_and_a_wrong_name_lists_the_right_ones():
    assert get("xpbd") is INTEGRATORS["xpbd"] is get(INTEGRATORS["xpbd"])
    with pytest.raises(ValueError, match="did you mean 'xpbd'.*semi_implicit_euler"):
        get("xpdb")
    with pytest.raises(ValueError, match="must have a 'name', one of explicit_euler"):
        get({"iterations": 3})


def test_options_are_taken_over():
    method = get({"name": "implicit_euler", "tolerance": 1e-6, "iterations": np.int64(3)})
    assert dict(method.options) == {"newton_iterations": 1, "iterations": 3, "tolerance": 1e-6}
    assert INTEGRATORS["implicit_euler"].options["tolerance"] > 1e-6  # the table's own is as it was
    assert Simulation(SHEET, integrator={"name": "xpbd", "iterations": 4}).integrator.options["iterations"] == 4


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"name": "xpbd", "iteratons": 4}, "xpbd has no option 'iteratons': it has only iterations"),
        ({"name": "rk4", "stages": 4}, "rk4 has no option 'stages': it has none"),
        ({"name": "xpbd", "iterations": 0}, "iterations=0: must be an integer of at least 1"),
        ({"name": "xpbd", "iterations": 1.5}, "iterations=1.5: must be an integer of at least 1"),
        ({"name": "xpbd", "iterations": True}, "iterations=True: must be a finite number"),
        ({"name": "pbd", "stretch": 1.1}, "stretch=1.1: must be from 0 to 1"),
        ({"name": "pbd", "stretch": "stiff"}, "stretch='stiff': must be a finite number"),
        ({"name": "implicit_euler", "tolerance": float("nan")}, "tolerance=nan: must be a finite number"),
    ],
)
def test_wrong_options_are_named(given, match):
    with pytest.raises(ValueError, match=match):
        Simulation(SHEET, integrator=given)


def test_an_option_of_another_method_is_ignored_with_a_warning():
    with pytest.warns(UserWarning, match=r"xpbd has no option 'tolerance' \(implicit_euler has\): it is ignored"):
        method = get({"name": "xpbd", "tolerance": 1e-3, "iterations": 2})
    assert dict(method.options) == {"iterations": 2}
    with pytest.warns(UserWarning, match=r"verlet has no option 'iterations' \(implicit_euler, projective_dynamics, pbd, xpbd has"):
        assert get({"name": "verlet", "iterations": 2}) == INTEGRATORS["verlet"]


# --- what they refuse -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changed_property", ["density", "stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time"])
def test_projective_dynamics_refuses_properties_that_differ(changed_property):
    """One matrix for all: a property may change for all environments, and then it does."""
    simulation = Simulation(SHEET, num_envs=3, integrator="projective_dynamics", anchors=[0], substeps=40, dtype="float64")
    simulation.step()
    before, properties = simulation.positions, simulation.parameters
    with pytest.raises(
        ValueError, match=f"factorizes one matrix for all environments: {changed_property} cannot differ between them"
    ):
        simulation.set_parameters(envs=[1], **{changed_property: 1.5 * getattr(simulation.material, changed_property)})
    assert np.array_equal(simulation.parameters, properties)
    changed = {changed_property: 1.5 * getattr(simulation.material, changed_property)}
    simulation.set_parameters(**changed)
    simulation.reset()
    simulation.step()
    fresh = Simulation(
        SHEET, Material.preset("penava_cotton", **changed), integrator="projective_dynamics", anchors=[0], dtype="float64",
        substeps=40,
    )  # fmt: skip
    fresh.step()
    assert np.array_equal(simulation.positions[2], fresh.positions[0])
    assert (changed_property == "bend_rigidity") or not np.array_equal(simulation.positions, before)


def test_projective_dynamics_accepts_randomized_properties_outside_its_matrix():
    simulation = Simulation(SHEET, num_envs=2, integrator="projective_dynamics", air_density=0, dtype="float64")
    simulation.set_parameters(gravity=[(0, 0, -9.81), (0, 0, 5.0)], air_drag=[0.0, 0.3])
    simulation.step(6)
    fallen = simulation.velocities[:, :, 2].mean(axis=1)
    assert fallen[0] == pytest.approx(-0.981, rel=1e-6)
    b = 0.3 / simulation.material.density
    assert fallen[1] == pytest.approx(5.0 / b * (1 - np.exp(-b * 0.1)), rel=5e-3)


@pytest.mark.parametrize("changed_property", ["stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time"])
def test_pbd_refuses_properties_that_mean_nothing_to_it(changed_property):
    simulation = Simulation(SHEET, num_envs=2, integrator="pbd")
    with pytest.raises(
        ValueError, match=rf"pbd does not use {changed_property}: its options \(iterations, stretch, bend\) set its stiffness"
    ):
        simulation.set_parameters(**{changed_property: 1.5 * getattr(simulation.material, changed_property)})
    simulation.set_parameters(density=[0.1, 0.2])


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("projective_dynamics", "pbd")])
def test_all_others_take_figures_by_environment(name):
    simulation = Simulation(SHEET, num_envs=2, integrator=name, anchors=[0], substeps=300, dtype="float64")
    simulation.set_parameters(stretch_stiffness=[100.0, 261.1], shear_stiffness=[40.0, 105.0], density=[0.1503, 0.2])
    simulation.step(5)
    cotton = Material.preset("penava_cotton", density=0.2)
    alone = Simulation(SHEET, cotton, integrator=name, anchors=[0], substeps=300, dtype="float64")
    alone.step(5)
    assert np.array_equal(simulation.positions[1], alone.positions[0])
    assert not np.array_equal(simulation.positions[0], alone.positions[0])


def test_explicit_euler_has_no_automatic_substeps_without_damping():
    material = Material(damping_time=0.0)
    with pytest.raises(
        ValueError, match="substeps='auto': explicit_euler has no bound here, without damping it grows at any substep"
    ):
        Simulation(SHEET, material, integrator="explicit_euler")
    with pytest.warns(UserWarning, match="too few for explicit_euler.*Use another integrator, or a fabric with damping_time"):
        simulation = Simulation(SHEET, material, integrator="explicit_euler", substeps=10)
    assert simulation.largest_substep()[0] == 0
    assert Simulation(SHEET, integrator="explicit_euler").substeps > 100


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("pbd", "implicit_euler", "projective_dynamics")])
def test_too_few_substeps_warn_with_the_number_that_would_do(name):
    enough = Simulation(SHEET, integrator=name).substeps
    with pytest.warns(UserWarning, match=f"1 substeps of .* too few for {name}.* Use substeps={enough} or substeps='auto'"):
        Simulation(SHEET, integrator=name, substeps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(SHEET, integrator=name, substeps=enough)


@pytest.mark.parametrize("name", ["pbd", "implicit_euler", "projective_dynamics"])
def test_methods_that_are_taken_for_large_steps_do_not_warn_of_them(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(SHEET, integrator=name, substeps=1)


# --- falling ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_sheet_falls_as_linear_drag_says(name):
    """v = -(g / b) (1 - exp(-b t)) with b = drag / density, on a sheet that stays flat."""
    drag, density, g, t = 0.5, 0.2, 9.81, 0.8
    simulation = Simulation(
        SHEET,
        Material(air_drag=drag, density=density),
        air_density=0,
        integrator=name,
        time_step=0.01,
        substeps=120,
        dtype="float64",
    )
    simulation.step(80)
    b = drag / density
    assert simulation.velocities[0, :, 2] == pytest.approx(-g / b * (1 - np.exp(-b * t)), rel=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_float32_falls_as_fast_in_small_substeps(name):
    """g h^2 is below half a unit in the last place of the height here: it must not be lost in the velocity."""
    simulation = Simulation(grid(3, 3, 0.1, 0.1), Material(), air_density=0, integrator=name, time_step=1 / 60, substeps=640)
    simulation.reset(positions=simulation.mesh.rest_positions + (0, 0, 3.0))
    simulation.step(12)
    assert simulation.velocities[0, :, 2] == pytest.approx(-9.81 * 0.2, rel=2e-3)

"""What every integrator keeps: momentum, the choice of axes, and energy, as far as it can."""

import warnings
from functools import partial

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Simulation, grid

NAMES = list(INTEGRATORS)
CONSISTENT = [name for name in NAMES if INTEGRATORS[name].order is not None]
KEEPS_ANGULAR = ["semi_implicit_euler", "verlet"]
# each model of bending with an explicit and an implicit method, or one that projects
BENT = [("semi_implicit_euler", "hinge"), ("xpbd", "hinge"), ("implicit_euler", "quadratic"), ("projective_dynamics", "quadratic")]
MODELS = [*((name, "springs") for name in NAMES), *BENT]


def thrown_sheet(name, h, bending="springs", damping_time=1e-4):
    """A free sheet, out of shape, moving and turning."""
    mesh = grid(6, 6, 0.3, 0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulation = Simulation(
            mesh, Material(damping_time=damping_time, bend_rigidity=1e-5), integrator=name, time_step=h, substeps=1,
            gravity=(0, 0, 0), air_density=0, bending=bending, dtype="float64",
        )  # fmt: skip
    rng = np.random.default_rng(1)
    x = mesh.rest_positions + rng.normal(scale=2e-3, size=(36, 3))
    simulation.reset(positions=x, velocities=np.cross((3, -2, 4), x) + (1, 2, -1) + rng.normal(scale=0.2, size=(36, 3)))
    return simulation, 1 / simulation.get_state().free_inverse_mass[0]


def angular_momentum(simulation, mass):
    return np.sum(mass[:, None] * np.cross(simulation.positions[0], simulation.velocities[0]), axis=0)


@pytest.mark.parametrize(("name", "bending"), MODELS)
def test_a_free_sheet_keeps_its_momentum(name, bending):
    simulation, mass = thrown_sheet(name, 1e-4, bending)
    before = mass @ simulation.velocities[0]
    simulation.step(300)
    scale = np.sum(mass[:, None] * np.abs(simulation.velocities[0]))
    assert np.max(np.abs(mass @ simulation.velocities[0] - before)) < 1e-12 * scale


@pytest.mark.parametrize(("name", "bending"), [*((name, "springs") for name in KEEPS_ANGULAR), ("semi_implicit_euler", "hinge")])
def test_symplectic_methods_keep_the_angular_momentum(name, bending):
    simulation, mass = thrown_sheet(name, 1e-4, bending)
    before = angular_momentum(simulation, mass)
    simulation.step(300)
    assert np.linalg.norm(angular_momentum(simulation, mass) - before) < 1e-12 * np.linalg.norm(before)


def angular_drift(name, h, seconds=0.02):
    """Share of the angular momentum that is lost or gained."""
    simulation, mass = thrown_sheet({"name": name, "tolerance": 1e-8} if name == "implicit_euler" else name, h)
    before = angular_momentum(simulation, mass)
    simulation.step(round(seconds / h))
    return np.linalg.norm(angular_momentum(simulation, mass) - before) / np.linalg.norm(before)


@pytest.mark.parametrize("name", [name for name in CONSISTENT if name not in KEEPS_ANGULAR])
def test_angular_momentum_of_the_others_drifts_with_the_step(name):
    """In proportion to h, and to h^5 for rk4, one order better than its positions."""
    steps = (1e-4, 5e-5) if name == "rk4" else (1e-5, 5e-6)
    coarse, fine = (angular_drift(name, h) for h in steps)
    print(f"{name}: {coarse:.3g} at h = {steps[0]}, {fine:.3g} at half of it")
    assert np.log2(coarse / fine) == pytest.approx(5 if name == "rk4" else 1, abs=0.1)
    assert coarse < 0.01


def turned(name, bending, turn):
    """A hanging sheet after 0.1 s, in a world that is turned; and turned back."""
    mesh = grid(6, 6, 0.3, 0.3)
    noise = np.random.default_rng(2).normal(size=(2, 36, 3))
    method = {"name": name, "tolerance": 1e-13} if name == "implicit_euler" else name
    simulation = Simulation(
        mesh, Material(bend_rigidity=1e-5), integrator=method, time_step=0.01, gravity=turn @ (0, 0, -9.81),
        wind=turn @ (1, 2, 0.5), anchors=[0, 5], bending=bending, dtype="float64",
    )  # fmt: skip
    simulation.reset(positions=(mesh.rest_positions + 1e-3 * noise[0]) @ turn.T, velocities=0.1 * noise[1] @ turn.T)
    simulation.step(10)
    return simulation.positions[0] @ turn


@pytest.mark.parametrize(("name", "bending"), MODELS)
def test_no_direction_is_preferred(name, bending):
    """Start, gravity and wind turned by a random rotation: the outcome turns with them, to 1e-10 m."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    straight, back = turned(name, bending, np.eye(3)), turned(name, bending, turn)
    assert np.max(np.abs(straight - back)) < 1e-10
    assert np.max(np.abs(straight - grid(6, 6, 0.3, 0.3).rest_positions)) > 0.01


def sheet_of_energy(name, share, **world):
    """Of 7 x 7 particles, in one substep a step: that share of the method's bound.  Undamped but for the method that needs it."""
    mesh, damping_time = grid(7, 7, 0.3, 0.3), 1e-4 if name == "explicit_euler" else 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make = partial(
            Simulation,
            mesh,
            Material(damping_time=damping_time),
            integrator=name,
            substeps=1,
            air_density=0,
            dtype="float64",
            **world,
        )
        return make(time_step=share * make(time_step=1.0).largest_substep()[0])


def energies(simulation, seconds):
    """Total energy from substep to substep."""
    total = [simulation.energy().total[0]]
    for _ in range(round(seconds / simulation.time_step)):
        simulation.step()
        total.append(simulation.energy().total[0])
    return np.array(total)


def stretched_and_let_go(method, share, seconds):
    """A free sheet, 5 % longer and wider than it wants to be, and not quite flat: its corners' fastest modes swing first."""
    simulation = sheet_of_energy(method, share, gravity=(0, 0, 0))
    rest = simulation.mesh.rest_positions
    simulation.reset(positions=rest * (1.05, 1.05, 1) + np.random.default_rng(4).normal(scale=1e-4, size=rest.shape))
    return energies(simulation, seconds)


# share of the bound at which the energy itself, not the one near it that a symplectic method keeps, stays within a hundredth
STRETCHED = {"explicit_euler": 0.3, "semi_implicit_euler": 0.02, "verlet": 0.1, "rk4": 0.99}


@pytest.mark.parametrize("name", CONSISTENT)
def test_energy_of_a_stretched_sheet_is_never_a_hundredth_above_the_first(name):
    total = stretched_and_let_go(name, STRETCHED.get(name, 1.0), 0.03)
    print(f"{name}: {total.max() / total[0]:.6f}, at last {total[-1] / total[0]:.4f}, in {len(total) - 1} substeps")
    assert total.max() <= 1.01 * total[0]


@pytest.mark.parametrize("name", CONSISTENT)
def test_energy_of_a_hanging_sheet_is_never_a_hundredth_above_the_first(name):
    """By weight times side, at 0.8 of each method's bound: a sheet that falls from two corners, and swings for 0.6 s."""
    simulation = sheet_of_energy(name, 0.8, anchors=[0, 6])
    total = energies(simulation, 0.6)
    scale = simulation.material.density * 0.3**2 * 9.81 * 0.3
    print(f"{name}: {(total.max() - total[0]) / scale:.2e}, at last {(total[-1] - total[0]) / scale:.4f}")
    assert total.max() - total[0] <= 0.01 * scale


@pytest.mark.parametrize(
    "method", ["implicit_euler", {"name": "projective_dynamics", "iterations": 100}, "xpbd"], ids=["implicit_euler", "pd", "xpbd"]
)
def test_energy_never_grows_in_a_dissipative_method(method):
    """From substep to substep, at the largest one, to less than a hundredth; projective dynamics where it has converged."""
    total = stretched_and_let_go(method, 1.0, 0.1)
    assert np.all(np.diff(total) < 0)
    assert total[-1] < 0.01 * total[0]

"""Chains and sheets at rest, against closed forms, plane elasticity and minima found by scipy."""

import dataclasses
import warnings
from functools import cache

import numpy as np
import pytest
from conftest import line_mesh
from equilibria import G, catenary, lumped_catenary, rest_shape, sheet_network, strains

from clothgym import INTEGRATORS, Material, Simulation, disc, grid, triangle_mesh
from clothgym.mesh import BEND_X, BEND_Y, SHEAR, STRUCTURAL_X, STRUCTURAL_Y

CONSISTENT = [name for name, method in INTEGRATORS.items() if method.order is not None]
# converged in every substep: the tests are of where things rest
IMPLICIT = {
    "implicit_euler": {"name": "implicit_euler", "iterations": 2000, "tolerance": 1e-10},
    "projective_dynamics": {"name": "projective_dynamics", "iterations": 30},
    "xpbd": {"name": "xpbd", "iterations": 64},
}
PASS = 100  # substeps of a control step


def simulation_of(mesh, name, h, mass, stiffness, gravity, anchors, damping_time=0.0, drag_rate=0.0, options=None):
    """In float64, with particles' masses [kg] and springs' constants by kind [N/m] set directly; ``PASS`` substeps h a step."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the substep is of the default fabric, and chosen on purpose
        simulation = Simulation(
            mesh, Material(shear_stiffness=0, bend_rigidity=0), integrator=options or IMPLICIT.get(name, name), air_density=0,
            time_step=PASS * h, substeps=PASS, gravity=gravity, anchors=anchors, dtype="float64",
        )  # fmt: skip
    state = simulation.get_state()
    state.stiffness[:] = 0
    for kind, k in stiffness.items():
        state.stiffness[:, kind] = k
    state.free_inverse_mass[:] = 1 / np.asarray(mass)
    state.damping_time[:] = damping_time
    state.drag_rate[:] = drag_rate
    simulation.set_state(state)
    return simulation


# --- chains ---------------------------------------------------------------------------------------------------------------

LINKS, K, M = 6, 500.0, 0.1
TENSION = M * G * np.arange(LINKS, 0, -1)


def hanging_chain(name, h, damping_time=0.0, options=None):
    chain = line_mesh(LINKS + 1)
    return simulation_of(chain, name, h, M, {STRUCTURAL_X: K}, (G, 0, 0), [0], damping_time, options=options)


def stretch_at_rest(simulation, seconds):
    simulation.step(round(seconds / simulation.time_step))
    return np.diff(simulation.positions[0, :, 0]) - 1


@pytest.mark.parametrize("name", CONSISTENT)
def test_a_hanging_chain_is_as_long_as_the_exact_solution(name):
    """Elongation m g N (N + 1)/(2 k), and of each spring m g (N - i + 1)/k."""
    simulation = hanging_chain(name, 0.02) if name in IMPLICIT else hanging_chain(name, 5e-4, damping_time=0.05)
    stretch = stretch_at_rest(simulation, 16 if name in IMPLICIT else 4)
    assert stretch == pytest.approx(TENSION / K, rel=1e-8)
    assert stretch.sum() == pytest.approx(M * G * LINKS * (LINKS + 1) / (2 * K), rel=1e-8)


def test_implicit_euler_tolerance_bounds_the_residual():
    """The residual is compared with the weight: at a tolerance of 1e-3, a thousandth of it may be left."""
    simulation = hanging_chain("implicit_euler", 5e-4, 0.05, {"name": "implicit_euler", "tolerance": 1e-3})
    assert stretch_at_rest(simulation, 4) == pytest.approx(TENSION / K, rel=1e-3)


@pytest.mark.parametrize("h", [5e-3, 1e-2])
def test_a_hanging_chain_of_one_xpbd_pass_is_as_soft_as_its_formula(h):
    """A spring of the second color leaves a substep at T/k; one of the first is then drawn longer by its neighbors'
    corrections, h^2 T/m each."""
    softer = TENSION / K
    for first in range(0, LINKS, 2):
        softer[first] += h * h / M * (TENSION[first + 1] + (TENSION[first - 1] if first else 0))
    simulation = hanging_chain("xpbd", h, options={"name": "xpbd", "iterations": 1})
    assert stretch_at_rest(simulation, 40) == pytest.approx(softer, rel=1e-8)


def cable(length, softness, links):
    """A lumped elastic cable of weight 1 N over a span of 1 m at rest, which began as a parabola."""
    across = np.linspace(0, 1, links + 1)
    depth = 3 * catenary(length, softness).sag * across * (1 - across)
    mass = np.full(links + 1, 1 / links / G)
    mass[[0, -1]] /= 2
    simulation = simulation_of(
        line_mesh(links + 1, length / links), "implicit_euler", 0.03, mass, {STRUCTURAL_X: links / length / softness}, (0, 0, -G),
        anchors=[0, links],
    )  # fmt: skip
    simulation.reset(positions=np.stack([across, 0 * across, -depth], axis=1))
    simulation.step(3)
    return simulation


CABLES = {
    (1.0, 1e-3): (3.456022, 0.036106, 3.492004), (1.0, 1e-2): (1.586167, 0.078190, 1.663107),
    (1.0, 1e-1): (0.699764, 0.172777, 0.860040), (1.2, 1e-3): (0.390582, 0.292818, 0.634471),
    (1.2, 1e-2): (0.384460, 0.297014, 0.630721), (1.2, 1e-1): (0.337601, 0.333842, 0.603303),
}  # fmt: skip


@pytest.mark.parametrize(("length", "softness"), CABLES)
def test_a_cable_hangs_as_the_elastic_catenary(length, softness):
    """H, sag and end tension: the formula gives the published table, and 32 links hang within a thousandth of it."""
    truth = catenary(length, softness)
    assert truth == pytest.approx(CABLES[length, softness], abs=1e-6)
    simulation = cable(length, softness, 32)
    pulls = simulation.pulls()[0]
    assert np.abs(pulls[:, 0]) == pytest.approx(truth.horizontal, rel=2e-3)
    assert np.linalg.norm(pulls, axis=1) == pytest.approx(truth.end_tension, rel=2e-3)
    assert -simulation.positions[0, :, 2].min() == pytest.approx(truth.sag, rel=1e-3)


def test_cable_sag_converges_at_order_2():
    """To the catenary's, and at each number of links it is that of straight links in equilibrium."""
    truth, errors = catenary(1.2, 1e-3).sag, []
    for links in (4, 8, 16, 32, 64):
        sag = -cable(1.2, 1e-3, links).positions[0, :, 2].min()
        assert sag == pytest.approx(lumped_catenary(1.2, 1e-3, links).sag, abs=1e-8)
        errors.append(sag - truth)
    assert errors == pytest.approx([9.98e-3, 2.39e-3, 5.91e-4, 1.475e-4, 3.68e-5], rel=2e-3)
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(2, abs=0.01)


# --- moduli of triangle meshes --------------------------------------------------------------------------------------------


def lattice(columns=9, rows=8, side=0.05):
    """Equilateral triangles."""
    r, c = np.divmod(np.arange(rows * columns), columns)
    points = np.stack([side * (c + r / 2), side * np.sqrt(3) / 2 * r, 0 * r], axis=1)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, d, e = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return triangle_mesh(points, np.concatenate([np.stack([a, b, d], axis=1), np.stack([b, e, d], axis=1)]))


def energy_of_strain(mesh, strain, young=300.0):
    """Elastic energy per area of the homogeneously strained sheet [J/m^2], strain: (2, 2)."""
    stretch = np.eye(3)
    stretch[:2, :2] += strain
    simulation = Simulation(mesh, Material(stretch_stiffness=young, bend_rigidity=0), dtype="float64")
    simulation.reset(positions=mesh.rest_positions @ stretch.T)
    return simulation.energy().elastic[0] / mesh.area.sum()


def plane_energy(strain, young=300.0, poisson=1 / 3):
    """Of plane stress: E/(2 (1 - nu^2)) ((1 - nu) e:e + nu (tr e)^2)."""
    return young / (2 * (1 - poisson**2)) * ((1 - poisson) * np.sum(strain**2) + poisson * np.trace(strain) ** 2)


@pytest.mark.parametrize("degrees", [0, 15, 40, 90])
def test_equilateral_triangles_have_the_young_modulus_and_contract_by_a_third(degrees):
    """Uniaxial stress in any direction stores E e^2/2 at Poisson's ratio 1/3, and more at any other; shear stores 3/8 E."""
    mesh, tiny = lattice(), 1e-5
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    along, across, shear = (turn @ np.array(e) @ turn.T for e in ([[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 0.5], [0.5, 0]]))
    stored = {nu: energy_of_strain(mesh, tiny * (along - nu * across)) for nu in (0.30, 1 / 3, 0.36)}
    assert stored[1 / 3] == pytest.approx(300 * tiny**2 / 2, rel=1e-4)
    assert stored[1 / 3] < min(stored[0.30], stored[0.36])
    assert energy_of_strain(mesh, tiny * shear) == pytest.approx(300 * 3 / 8 * tiny**2 / 2, rel=1e-4)


@pytest.mark.parametrize("rings", [4, 12])
def test_disc_has_the_young_modulus(rings):
    """Its triangles are not equilateral, its six sectors make up for that: against plane stress with nu = 1/3."""
    for degrees in (0, 15, 30, 45):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        strain = 1e-5 * np.array([[c * c, c * s], [c * s, s * s]])
        assert energy_of_strain(disc(0.15, rings), strain) == pytest.approx(plane_energy(strain), rel=1e-4)


# --- the seed cases of the field ------------------------------------------------------------------------------------------


@cache
def seed_case(rows, side, k, mass):
    """A square sheet hung by two corners: its mesh, every spring of which counts whole, masses, pins and rest shape."""
    mesh = grid(rows, rows, side, side)
    mesh = dataclasses.replace(mesh, springs=mesh.springs._replace(weight=np.ones(len(mesh.springs.kind))))
    network = sheet_network(rows, side / (rows - 1), k, k, k)
    masses = np.full(rows * rows, mass) if mass else 0.1 * mesh.area
    pins = [0, rows - 1]
    # a sheet buckles where it is compressed, this way or that
    wavy = mesh.rest_positions + 1e-2 * side / rows * np.random.default_rng(0).normal(size=mesh.rest_positions.shape)
    wavy[pins] = mesh.rest_positions[pins]
    shape, firmness = rest_shape(network, masses, (0, G, 0), wavy, pins)
    assert firmness > 0
    return mesh, network, masses, pins, shape


PATCH = (3, 2.0, 4.0, 0.1)  # 1 m apart, 0.1 kg each
PROVOT = (17, 1.0, 1.0, None)  # 0.1 kg/m^2


def distance_at_rest(name, case, h):
    """Largest distance of a particle to the minimum [m] after eight seconds with drag, which began a fiftieth of a spacing off."""
    mesh, _, masses, pins, shape = seed_case(*case)
    k = dict.fromkeys((STRUCTURAL_X, STRUCTURAL_Y, SHEAR, BEND_X, BEND_Y), case[2])
    simulation = simulation_of(mesh, name, h, masses, k, (0, G, 0), pins, 0 if name in IMPLICIT else 5e-3, drag_rate=4.0)
    push = 0.02 * mesh.spacing[0] * np.random.default_rng(1).uniform(-1, 1, shape.shape)
    push[pins] = 0
    simulation.reset(positions=shape + push)
    simulation.step(round(8 / simulation.time_step))
    return np.linalg.norm(simulation.positions[0] - shape, axis=1).max()


# of explicit Euler, drag alone damps what moves across the springs: its rate must exceed h w^2 of that
SUBSTEP = {"explicit_euler": 2e-4, "implicit_euler": 5e-3, "projective_dynamics": 5e-3}


@pytest.mark.parametrize("case", [PATCH, PROVOT], ids=["patch", "provot"])
@pytest.mark.parametrize("name", [name for name in CONSISTENT if name != "xpbd"])
def test_seed_cases_rest_where_scipy_finds_the_minimum(case, name):
    assert distance_at_rest(name, case, SUBSTEP.get(name, 2e-3)) < 1e-6 * case[1]


@pytest.mark.parametrize("case", [PATCH, PROVOT], ids=["patch", "provot"])
def test_xpbd_approaches_the_energy_minimum_with_smaller_substeps(case):
    """Springs turn within a substep while their multipliers add up: of first order in h^2, however many iterations."""
    far, near = (distance_at_rest("xpbd", case, h) for h in (8e-3, 4e-3))
    assert near < 5e-4 * case[1]
    assert far / near > 3.6


@pytest.mark.parametrize("case", [PATCH, PROVOT], ids=["patch", "provot"])
def test_the_most_strained_spring_is_the_side_edge_below_a_pin(case):
    """Not of the top row, as popular accounts have it; and soft springs stretch far beyond a tenth."""
    rows = case[0]
    _, network, _, _, shape = seed_case(*case)
    strain = strains(network, shape)
    assert strain.max() > 0.3
    assert sorted(network.ends[np.argmax(strain)].tolist()) in ([0, rows], [rows - 1, 2 * rows - 1])
    top = (network.ends < rows).all(axis=1)
    assert strain[top].max() < 0.9 * strain.max()

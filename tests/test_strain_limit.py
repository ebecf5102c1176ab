"""Strain limiting after Provot: lone springs by hand, soft sheets that stay short, and energy that never grows."""

import dataclasses

import numpy as np
import pytest
from conftest import line_mesh
from equilibria import G, sheet_network, strains

from clothgym import Material, Simulation, Sphere, grid
from clothgym.elements import element_arrays, surface_arrays, topology_of
from clothgym.limiting import AFTER, BEFORE, TOLERANCE, USED, kernels_of
from clothgym.mesh import BEND_X, BEND_Y, SHEAR, STRUCTURAL_X, STRUCTURAL_Y

LIMIT = 0.1


def limited(mesh, x, v, w, limit=LIMIT, size=1.0):
    """What the kernel makes of one lane: positions, velocities and its report."""
    x, v, w = x.T[:, :, None].copy(), v.T[:, :, None].copy(), np.asarray(w, float)[:, None]
    real = np.dtype(np.float64)
    elements = element_arrays(mesh, real, hinged=False, any_order=False)
    topology = topology_of(mesh, elements, surface_arrays(mesh, real), "springs", regular=False)
    report = np.zeros((3, 1))
    kernels_of(True, "lanes")["limit_strain"](x, v, w, topology, np.full(1, size), limit, report)
    return x[:, :, 0].T, v[:, :, 0].T, report[:, 0]


@pytest.mark.parametrize(
    ("w", "ends"),
    [((0, 1), (0.0, 1.10)), ((1, 0), (0.15, 1.25)), ((1, 1), (0.075, 1.175)), ((1, 0.25), (0.075, 1.175)), ((0, 0), (0.0, 1.25))],
)
def test_a_spring_of_125_percent_comes_back_by_its_free_ends(w, ends):
    """One free end moves alone, two move equally, two held ones stay."""
    x, _, report = limited(line_mesh(2), np.array([[0, 0, 0], [1.25, 0, 0]]), np.zeros((2, 3)), w)
    assert x[:, 0] == pytest.approx(ends, abs=1e-12)
    assert report[BEFORE] == pytest.approx(0.25) and report[AFTER] == pytest.approx(ends[1] - ends[0] - 1)
    assert report[USED] == (1 if any(w) else 100)


def test_the_limit_is_of_the_rest_length_times_the_size():
    x, _, report = limited(line_mesh(2), np.array([[0, 0, 0], [1.25, 0, 0]]), np.zeros((2, 3)), (0, 1), size=0.8)
    assert x[:, 0] == pytest.approx((0, 0.88), abs=1e-12)
    assert report[BEFORE] == pytest.approx(1.25 / 0.8 - 1) and report[AFTER] == pytest.approx(LIMIT)


@pytest.mark.parametrize(("speed", "along"), [(0.5, (0.4, 0.4)), (-0.5, (0.0, -0.5))])
def test_ends_of_a_long_spring_move_no_farther_apart_and_may_approach(speed, along):
    """Masses of 1 and 4 kg that part go on together, with the momentum that they had; on their way back nothing stops them."""
    v = np.array([[0, 0.2, 0], [speed, -0.3, 0.1]])
    _, after, _ = limited(line_mesh(2), np.array([[0, 0, 0], [1.25, 0, 0]]), v, (1, 0.25))
    assert after[:, 0] == pytest.approx(along, abs=1e-12)
    assert after[:, 1:] == pytest.approx(v[:, 1:], abs=1e-12)


def test_a_simulation_s_spring_comes_back_by_its_free_end():
    simulation = Simulation(
        line_mesh(2), Material(stretch_stiffness=1e-6, shear_stiffness=0, bend_rigidity=0), gravity=(0, 0, 0), air_density=0,
        anchors=[0], strain_limit=LIMIT, dtype="float64",
    )  # fmt: skip
    simulation.reset(positions=[[0, 0, 0], [1.25, 0, 0]])
    simulation.step()
    assert simulation.positions[0, :, 0] == pytest.approx([0, 1.10], abs=1e-6)
    assert simulation.limiting.before == pytest.approx(0.25, abs=1e-6)
    assert simulation.limiting.after == pytest.approx(LIMIT, abs=1e-6)


def test_short_springs_and_bend_springs_are_left_as_they_are():
    mesh = grid(4, 4, 0.3, 0.3)
    x, v = 0.7 * mesh.rest_positions, np.random.default_rng(0).normal(size=(16, 3))
    after, speeds, report = limited(mesh, x, v, np.ones(16))
    assert np.array_equal(after, x) and np.array_equal(speeds, v)
    assert report[USED] == 0


def stretched(seed):
    """A grid drawn out at random, moving at random, with particles of different masses and two held."""
    mesh, rng = grid(5, 6, 0.5, 0.4), np.random.default_rng(seed)
    x = mesh.rest_positions * rng.uniform(1, 1.4, 3) + rng.normal(scale=0.01, size=mesh.rest_positions.shape)
    w = rng.uniform(0.5, 2, mesh.num_particles)
    w[[0, 5]] = 0
    v = rng.normal(size=x.shape)
    v[[0, 5]] = 0
    return mesh, x, v, w


@pytest.mark.parametrize("seed", range(5))
def test_limiting_takes_kinetic_energy_and_never_adds(seed):
    mesh, x, v, w = stretched(seed)
    _, after, report = limited(mesh, x, v, w)
    free = w > 0
    kinetic = [np.sum(u[free] ** 2 / w[free, None]) / 2 for u in (v, after)]
    assert report[USED] > 0
    assert kinetic[1] <= kinetic[0]
    assert not after[~free].any()


def test_limiting_a_free_sheet_keeps_its_momentum():
    mesh, x, v, w = stretched(0)
    w[:] = np.random.default_rng(1).uniform(0.5, 2, len(w))
    _, after, _ = limited(mesh, x, v, w)
    assert np.sum(after / w[:, None], axis=0) == pytest.approx(np.sum(v / w[:, None], axis=0), abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_one_sweep_is_not_enough_and_more_are_reported(seed):
    """Each correction stretches the neighbors: sweeps go on until the largest strain of yarns and diagonals, worked out here
    from the positions, is within the tolerance."""
    mesh, x, v, w = stretched(seed)
    x[[0, 5]] = mesh.rest_positions[[0, 5]]
    after, _, report = limited(mesh, x, v, w)
    yarns = mesh.springs.kind <= SHEAR
    i, j = mesh.springs.particles[yarns].T
    left = (np.linalg.norm(after[j] - after[i], axis=1) / mesh.springs.rest_length[yarns]).max() - 1
    assert report[AFTER] == pytest.approx(left, abs=1e-12)
    assert 1 < report[USED] < 100
    assert left <= LIMIT + TOLERANCE


# --- Provot's sheet -------------------------------------------------------------------------------------------------------


def provot(strain_limit, **kwargs):
    """17 x 17 particles on 1 m, every spring of 1 N/m, 0.1 kg/m^2, hung level by two corners; drag as air's."""
    mesh = grid(17, 17, 1.0, 1.0)
    mesh = dataclasses.replace(mesh, springs=mesh.springs._replace(weight=np.ones(len(mesh.springs.kind))))
    material = Material(0.1, 1.0, 0.3, 0.0, damping_time=0.0, air_drag=0.0)
    simulation = Simulation(
        mesh, material, air_density=0, anchors=[0, 16], strain_limit=strain_limit, substeps=12, dtype="float64", **kwargs
    )
    state = simulation.get_state()
    for kind in (STRUCTURAL_X, STRUCTURAL_Y, SHEAR, BEND_X, BEND_Y):
        state.stiffness[:, kind] = 1.0
    simulation.set_state(state)
    return simulation


def threads_and_diagonals(x):
    network = sheet_network(17, 1 / 16, 1, 1, 0)
    return strains(network, x)[network.k > 0]


def test_provot_s_soft_sheet_stretches_twofold_and_a_limited_one_stays_at_a_tenth():
    """After a swing of three seconds; the limit holds at the end of every control step, and it says what it met and left."""
    soft, kept = provot(None), provot(LIMIT)
    most = 0.0
    for step in range(180):
        soft.step()
        kept.step()
        largest = threads_and_diagonals(kept.positions[0]).max()
        assert kept.limiting.after[0] == pytest.approx(largest, abs=1e-9)
        assert largest <= LIMIT + TOLERANCE, step
        most = max(most, kept.limiting.sweeps[0])
        assert kept.limiting.before[0] >= largest - 1e-12 or kept.limiting.sweeps[0] == 0
    assert soft.limiting is None
    assert threads_and_diagonals(soft.positions[0]).max() > 1
    assert 1 < most < 100


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "xpbd"])
def test_a_limited_sheet_s_energy_never_exceeds_what_it_began_with(integrator):
    """Springs, weight and motion, over a swing of two seconds without any damping, in shares of the weight times the side."""
    simulation = provot(LIMIT, integrator=integrator)
    start = simulation.energy().total[0]
    totals = []
    for _ in range(120):
        simulation.step()
        totals.append(simulation.energy().total[0] - start)
    assert max(totals) < 1e-4 * 0.1 * G


def test_what_contact_leaves_is_what_is_reported():
    """Contact comes after limiting and knows nothing of it: the report is of the strain that everybody can see."""
    mesh = grid(9, 9, 0.3, 0.3)
    solids = [Sphere(center=(0, 0, -0.2), radius=0.1)]
    simulation = Simulation(mesh, strain_limit=0.05, colliders=solids, substeps=30, dtype="float64")
    simulation.reset(velocities=(0, 0, -9.0))
    worst = 0.0
    for _ in range(3):
        simulation.step()
        x, springs = simulation.positions[0], mesh.springs
        ends = x[springs.particles[springs.kind <= SHEAR]]
        seen = np.max(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / springs.rest_length[springs.kind <= SHEAR]) - 1
        assert simulation.limiting.after[0] == pytest.approx(seen, rel=1e-9)
        worst = max(worst, seen)
    assert worst > 0.05 + 2 * TOLERANCE  # or contact had nothing to say
    simulation.reset()
    assert not np.any(simulation.limiting)


@pytest.mark.parametrize("limit", [0, -0.1, 10, True, np.nan])
def test_limits_that_make_no_sense_are_named(limit):
    with pytest.raises(ValueError, match="strain_limit"):
        Simulation(grid(3, 3, 0.1, 0.1), strain_limit=limit)

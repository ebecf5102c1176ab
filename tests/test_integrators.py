"""Every integrator against closed forms: oscillators, chains, falls; the truths are in the formulae, not in the code."""

import warnings

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Simulation, grid
from clothgym.forces import frequency_bound, largest_frequency
from clothgym.integrators import get

NAMES = list(INTEGRATORS)


def test_names_and_objects_are_accepted_and_a_wrong_name_lists_the_right_ones():
    assert get("xpbd") is INTEGRATORS["xpbd"] is get(INTEGRATORS["xpbd"])
    with pytest.raises(ValueError, match="did you mean 'xpbd'.*semi_implicit_euler"):
        get("xpdb")


# (amplitude factor, phase advance) of a step at q = h sqrt(k/m)
CLOSED_FORMS = {
    "semi_implicit_euler": lambda q: (1.0, 2 * np.arcsin(q / 2)),
    "xpbd": lambda q: (1 / np.sqrt(1 + q * q), np.arctan(q)),  # on one spring it is implicit Euler
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("q", [0.05, 0.3683, 1.2])
def test_oscillator_has_the_closed_form_s_amplitude_and_phase(chain, name, q):
    """Eigenvalues of the step matrix, fitted to three successive positions: x2 = 2 a cos(p) x1 - a^2 x0."""
    h, k, m = 0.01, 1000.0, 1000.0 * (0.01 / q) ** 2
    simulation = chain(2, name, h, k, m)
    simulation.reset(positions=[[0, 0, 0], [1.2, 0, 0]])
    x = []
    for _ in range(40):
        x.append(simulation.positions[0, 1, 0] - 1.0)
        simulation.step()
    x = np.array(x)
    (trace, minus_det), *_ = np.linalg.lstsq(np.stack([x[1:-1], x[:-2]], axis=1), x[2:], rcond=None)
    amplitude, phase = CLOSED_FORMS[name](q)
    assert np.sqrt(-minus_det) == pytest.approx(amplitude, rel=1e-6)
    assert trace / 2 == pytest.approx(amplitude * np.cos(phase), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_stated_order_is_measured(chain, name):
    """Error of position and velocity of an oscillator after a radian against cosine and sine, at h and h/2."""
    errors = []
    for steps in (400, 800):
        h = 1 / steps
        simulation = chain(2, name, h, 1.0, 1.0)
        simulation.reset(positions=[[0, 0, 0], [1.1, 0, 0]])
        simulation.step(steps)
        x, v = simulation.positions[0, 1, 0] - 1, simulation.velocities[0, 1, 0]
        errors.append(np.hypot(x - 0.1 * np.cos(1), v + 0.1 * np.sin(1)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(INTEGRATORS[name].order, abs=0.1)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("damping_time", [0.01, 0.05])
def test_damping_time_is_the_same_physics_for_all(chain, name, damping_time):
    """A Kelvin-Voigt spring decays by exp(-tau w^2 t / 2)."""
    w, h, steps = 5.0, 2e-4, 5000
    simulation = chain(2, name, h, w * w, 1.0, damping_time=damping_time)
    simulation.reset(positions=[[0, 0, 0], [1.1, 0, 0]])
    values = []
    for _ in range(steps):
        simulation.step()
        values.append(simulation.positions[0, 1, 0] - 1)
    t = h * np.arange(1, steps + 1)
    rate = damping_time * w * w / 2
    wd = np.sqrt(w * w - rate * rate)
    exact = 0.1 * np.exp(-rate * t) * (np.cos(wd * t) + rate / wd * np.sin(wd * t))
    assert np.max(np.abs(values - exact)) < 6e-4


@pytest.mark.parametrize("name", NAMES)
def test_hanging_chain_has_the_exact_length(chain, name):
    """Elongation m g N (N + 1) / (2 k) at rest."""
    n, k, m, g = 6, 500.0, 0.1, 9.81
    simulation = chain(n + 1, name, 1e-3, k, m, gravity=(g, 0, 0), drag_rate=8.0)
    simulation.step(6000)
    elongation = simulation.positions[0, -1, 0] - n
    tolerance = {"semi_implicit_euler": 1e-6, "xpbd": 2e-2}[name]  # xpbd: softer by q^2 (N - 1)/N, see below
    assert elongation == pytest.approx(m * g * n * (n + 1) / (2 * k), rel=tolerance)


@pytest.mark.parametrize("q2", [2.17, 0.136, 0.0085])
def test_xpbd_is_as_soft_as_its_formula_says(chain, q2):
    """One pass a substep: measured over nominal stiffness r = 1/(1 + q^2 (N - 1)/N) under an end load."""
    n, m, h = 8, 1.0, 0.01
    k = q2 * m / h**2
    simulation = chain(n + 1, "xpbd", h, k, m)
    # an end load: gravity on the last particle only, the others without weight of their own
    load, drag = 0.01 * k, 3.0
    state = simulation.get_state()
    state.drag_rate[:] = drag
    simulation.set_state(state)
    simulation._fabric.gravity[:] = 0
    for _ in range(30000):
        # the substep's drag takes its share of the push as well
        simulation._v[0, -1, 0, 0] += h * load / m * (1 + h * drag)
        simulation.step()
    measured = load * n / (simulation.positions[0, -1, 0] - n)
    assert measured / k == pytest.approx(1 / (1 + q2 * (n - 1) / n), rel=2e-3)


def sheet_and_bound():
    mesh = grid(9, 9, 0.3, 0.3)
    simulation = Simulation(
        mesh, Material(damping_time=0.0), air_density=0, integrator="semi_implicit_euler", gravity=(0, 0, 0), dtype="float64"
    )
    state = simulation.get_state()
    return mesh, state.stiffness[0], state.free_inverse_mass[0], simulation.largest_substep()[0]


def growth(mesh, h):
    """Growth of a small random in-plane disturbance over 400 substeps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulation = Simulation(
            mesh, Material(damping_time=0.0), air_density=0, gravity=(0, 0, 0), dtype="float64", time_step=h, substeps=1
        )
    noise = np.random.default_rng(0).normal(size=(mesh.num_particles, 3)) * (1e-9, 1e-9, 0)
    simulation.reset(positions=mesh.rest_positions + noise)
    simulation.step(800)
    return np.max(np.abs(simulation.positions[0] - mesh.rest_positions)) / 1e-9


def test_explicit_bound_of_a_sheet_is_sharp():
    mesh, stiffness, inverse_mass, bound = sheet_and_bound()
    assert growth(mesh, 0.99 * bound) < 100
    assert not growth(mesh, 1.01 * bound) < 1e6  # or not a number
    # one spring's 2 sqrt(m/k) would be too generous
    assert 2 / np.sqrt(np.max(stiffness) * np.median(inverse_mass)) > 1.3 * bound


@pytest.mark.parametrize("shape", [(5, 5, 0.3, 0.3), (9, 6, 0.2, 0.35), (2, 2, 0.1, 0.1)])
def test_frequencies_against_a_dense_eigenvalue(shape):
    """K by finite differences of the elastic energy, in float64, at random stiffness and mass."""
    mesh = grid(*shape)
    rng = np.random.default_rng(0)
    stiffness, mass = rng.uniform(50, 300, 5), rng.uniform(1e-4, 1e-3, mesh.num_particles)
    k = mesh.springs.weight * stiffness[mesh.springs.kind]
    i, j = mesh.springs.particles.T

    def gradient(x):
        d = x[j] - x[i]
        length = np.linalg.norm(d, axis=1, keepdims=True)
        f = k[:, None] * (length - mesh.springs.rest_length[:, None]) * d / length
        out = np.zeros_like(x)
        np.add.at(out, j, f)
        np.add.at(out, i, -f)
        return out.ravel()

    size, step = 3 * mesh.num_particles, 1e-6
    hessian = np.empty((size, size))
    for q in range(size):
        shift = np.zeros(size)
        shift[q] = step
        shift = shift.reshape(-1, 3)
        hessian[q] = (gradient(mesh.rest_positions + shift) - gradient(mesh.rest_positions - shift)) / (2 * step)
    scale = np.repeat(mass**-0.5, 3)
    exact = np.sqrt(np.linalg.eigvalsh((hessian + hessian.T) / 2 * scale[:, None] * scale).max())
    assert largest_frequency(mesh, stiffness, 1 / mass) == pytest.approx(exact, rel=1e-4)
    assert exact <= frequency_bound(mesh, stiffness, 1 / mass) < 1.5 * exact


def test_damped_bound_is_sharp(chain):
    """(h w)^2 + 2 h tau w^2 = 4 on one spring."""
    w2, tau = 100.0, 0.02
    bound = np.sqrt(tau**2 + 4 / w2) - tau
    for share, grows in ((0.99, False), (1.01, True)):
        simulation = chain(2, "semi_implicit_euler", share * bound, w2, 1.0, damping_time=tau)
        simulation.reset(positions=[[0, 0, 0], [1 + 1e-9, 0, 0]])
        simulation.step(800)
        assert (abs(simulation.positions[0, 1, 0] - 1) > 1e-7) == grows


@pytest.mark.parametrize("name", NAMES)
def test_a_free_sheet_keeps_its_momentum(name):
    mesh = grid(7, 7, 0.3, 0.3)
    simulation = Simulation(mesh, Material(), air_density=0, integrator=name, gravity=(0, 0, 0), dtype="float64")
    rng = np.random.default_rng(1)
    simulation.reset(positions=mesh.rest_positions + rng.normal(scale=2e-3, size=(49, 3)), velocities=rng.normal(size=(49, 3)))
    mass = 1 / simulation.get_state().free_inverse_mass[0]
    before = mass @ simulation.velocities[0]
    simulation.step(30)
    assert np.max(np.abs(mass @ simulation.velocities[0] - before)) < 1e-12 * np.sum(
        mass[:, None] * np.abs(simulation.velocities[0])
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_sheet_falls_as_linear_drag_says(name):
    """v = -(g / b) (1 - exp(-b t)) with b = drag / density, on a sheet that stays flat."""
    drag, density, g, t = 0.5, 0.2, 9.81, 0.8
    simulation = Simulation(
        grid(4, 4, 0.3, 0.3),
        Material(air_drag=drag, density=density),
        air_density=0,
        integrator=name,
        time_step=0.01,
        dtype="float64",
    )
    simulation.step(80)
    b = drag / density
    assert simulation.velocities[0, :, 2] == pytest.approx(-g / b * (1 - np.exp(-b * t)), rel=3e-3)


@pytest.mark.parametrize("name", NAMES)
def test_undamped_energy_stays_within_a_hundredth(name):
    simulation = Simulation(
        grid(9, 9, 0.3, 0.3), Material(damping_time=0.0), air_density=0, integrator=name, anchors=[0, 8], dtype="float64"
    )
    highest = simulation.energy().total[0]
    scale = abs(0.15 * 0.09 * 9.81 * 0.3)  # weight times side
    for _ in range(60):
        simulation.step()
        assert simulation.energy().total[0] <= highest + 0.01 * scale


def test_integrators_agree_as_the_substep_shrinks():
    """A hanging sheet after 0.2 s: the two methods' distance falls in proportion to the substep (both are of order one)."""
    mesh = grid(7, 7, 0.3, 0.3)
    distances = []
    for substeps in (100, 200, 400):
        final = []
        for name in NAMES:
            simulation = Simulation(mesh, integrator=name, anchors=[0, 6], time_step=1 / 50, substeps=substeps, dtype="float64")
            simulation.step(10)
            final.append(simulation.positions[0])
        distances.append(np.sqrt(np.mean(np.sum((final[0] - final[1]) ** 2, axis=1))))
    assert distances[0] < 5e-3
    assert distances[1] == pytest.approx(distances[0] / 2, rel=0.35)
    assert distances[2] == pytest.approx(distances[1] / 2, rel=0.35)


@pytest.mark.parametrize("name", NAMES)
def test_automatic_substeps_follow_stiffness(name):
    """A hundredfold stiffness needs tenfold substeps."""
    mesh = grid(5, 5, 0.3, 0.3)
    soft, stiff = (
        Simulation(
            mesh,
            Material(stretch_stiffness=k, shear_stiffness=0.4 * k, bend_rigidity=0, damping_time=0.0),
            integrator=name,
            time_step=1.0,
        ).substeps
        for k in (200.0, 20000.0)
    )
    assert stiff == pytest.approx(10 * soft, rel=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_float32_falls_as_fast_in_small_substeps(name):
    """g h^2 is below half a unit in the last place of the height here: it must not be lost in the velocity."""
    simulation = Simulation(grid(3, 3, 0.1, 0.1), Material(), air_density=0, integrator=name, time_step=1 / 60, substeps=640)
    simulation.reset(positions=simulation.mesh.rest_positions + (0, 0, 3.0))
    simulation.step(12)
    assert simulation.velocities[0, :, 2] == pytest.approx(-9.81 * 0.2, rel=2e-3)

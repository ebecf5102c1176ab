"""Every integrator on one spring, against closed forms: amplitude and phase, order, damping."""

import numpy as np
import pytest
from conftest import line_mesh

from clothgym import INTEGRATORS, Material, Simulation
from clothgym.triangles import triangle_mesh

NAMES = list(INTEGRATORS)
CONSISTENT = [name for name in NAMES if INTEGRATORS[name].order is not None]
# steps in a radian at which the measured order is the asymptotic one, and rounding is still far below the error
STEPS = {1: 400, 2: 100, 4: 20}
TOLERANCE = {1: 2e-4, 2: 2e-5, 4: 1e-12}  # of a damped oscillation of 0.1 through 5 rad, in steps of 1e-3 rad


def backward_euler(q):
    return 1 / np.sqrt(1 + q * q), np.arctan(q)


def symplectic(q):
    return 1.0, 2 * np.arcsin(q / 2)


def runge_kutta(q):
    real, imaginary = 1 - q**2 / 2 + q**4 / 24, q - q**3 / 6
    return np.hypot(real, imaginary), np.arctan2(imaginary, real)


# (amplitude factor, phase advance) of a step at q = h sqrt(k/m)
CLOSED_FORMS = {
    "explicit_euler": lambda q: (np.sqrt(1 + q * q), np.arctan(q)),
    "semi_implicit_euler": symplectic,
    "verlet": symplectic,
    "rk4": runge_kutta,
    "implicit_euler": backward_euler,
    "projective_dynamics": backward_euler,  # along the spring its matrix is the exact one
    "xpbd": backward_euler,
}


def amplitude_and_phase(simulation, steps=12):
    """Of the step matrix, from successive positions of an oscillator: x2 = 2 a cos(p) x1 - a^2 x0."""
    simulation.reset(positions=[[0, 0, 0], [1.001, 0, 0]])
    x = []
    for _ in range(steps):
        x.append(simulation.positions[0, 1, 0] - 1.0)
        simulation.step()
    x = np.array(x)
    (trace, minus_det), *_ = np.linalg.lstsq(np.stack([x[1:-1], x[:-2]], axis=1), x[2:], rcond=None)
    amplitude = np.sqrt(-minus_det)
    return amplitude, np.arccos(trace / 2 / amplitude)


@pytest.mark.parametrize("name", CONSISTENT)
@pytest.mark.parametrize("q", [0.05, 0.3683, 1.2])
def test_oscillator_matches_closed_form(chain, name, q):
    h, k = 0.01, 1000.0
    simulation = chain(2, name, h, k, mass=k * (h / q) ** 2)
    assert amplitude_and_phase(simulation) == pytest.approx(CLOSED_FORMS[name](q), rel=1e-7)


@pytest.mark.parametrize("h", [0.001, 0.01])
@pytest.mark.parametrize("stretch", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("iterations", [1, 5, 20])
def test_pbd_knows_neither_step_nor_stiffness_nor_passes(chain, h, stretch, iterations):
    """x <- (1 - k)(x + h v), v <- what was moved: amplitude sqrt(1 - k), phase acos(sqrt(1 - k)), for any h and any iterations."""
    method = {"name": "pbd", "iterations": iterations, "stretch": stretch}
    for stiffness in (10.0, 1e5):
        measured = amplitude_and_phase(chain(2, method, h, stiffness, mass=0.1), steps=8)
        assert measured == pytest.approx((np.sqrt(1 - stretch), np.arccos(np.sqrt(1 - stretch))), rel=1e-7)


def error_after_a_radian(chain, name, steps, damping_time=0.0):
    """Of position and velocity of an oscillator of frequency 1, let go at 0.1."""
    simulation = chain(2, name, 1 / steps, 1.0, 1.0, damping_time=damping_time)
    simulation.reset(positions=[[0, 0, 0], [1.1, 0, 0]])
    simulation.step(steps)
    rate = damping_time / 2
    w = np.sqrt(1 - rate * rate)
    x = 0.1 * np.exp(-rate) * (np.cos(w) + rate / w * np.sin(w))
    v = -0.1 * np.exp(-rate) * np.sin(w) / w
    return np.hypot(simulation.positions[0, 1, 0] - 1 - x, simulation.velocities[0, 1, 0] - v)


@pytest.mark.parametrize("name", CONSISTENT)
@pytest.mark.parametrize("damping_time", [0.0, 0.3])
def test_stated_order_is_measured(chain, name, damping_time):
    """Error after a radian at h and h/2; Verlet takes the damper's velocities from the substep's start: order 1 in it."""
    order = 1 if name == "verlet" and damping_time else INTEGRATORS[name].order
    steps = STEPS[order]
    errors = [error_after_a_radian(chain, name, n, damping_time) for n in (steps, 2 * steps)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("name", CONSISTENT)
def test_stated_order_is_that_of_linear_drag_too(chain, name):
    """A free particle slows as exp(-b t); error of position and velocity at b t = 1, at h and h/2."""
    errors = []
    for steps in (20, 40):
        simulation = chain(2, name, 1 / steps, 0.0, drag_rate=1.0, anchors=())
        simulation.reset(positions=[[0, 0, 0], [1, 0, 0]], velocities=(0, 1, 0))
        simulation.step(steps)
        errors.append((simulation.velocities[0, :, 1] - np.exp(-1), simulation.positions[0, :, 1] - (1 - np.exp(-1))))
    assert np.log2(np.abs(np.divide(*errors))) == pytest.approx(INTEGRATORS[name].order, abs=0.1)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_spring_and_its_damper_pull_with_the_stretch_and_its_rate(num_envs):
    """``k (l - r + tau dl/dt)`` along a spring of 0.3 m that is 0.5 m long and turns while it grows, alone and in a batch: what one
    tiny substep gives to its ends."""
    h, k, tau, mass = 1e-7, 30.0, 0.02, 0.4
    simulation = Simulation(
        line_mesh(2, 0.3), Material(stretch_stiffness=1e-9, shear_stiffness=0, bend_rigidity=0), num_envs, "semi_implicit_euler",
        time_step=h, substeps=1, gravity=(0, 0, 0), air_density=0, dtype="float64",
    )  # fmt: skip
    state = simulation.get_state()
    state.stiffness[:], state.damping_time[:], state.drag_rate[:], state.free_inverse_mass[:] = k, tau, 0, 1 / mass
    simulation.set_state(state)
    velocities = np.array([[0.1, -0.2, 0.3], [1.0, 0.6, -0.4]])
    simulation.reset(positions=[[0.2, 0, 0], [0.5, 0.4, 0]], velocities=velocities)
    simulation.step()
    direction = np.array([0.6, 0.8, 0])
    pull = k * (0.5 - 0.3 + tau * direction @ (velocities[1] - velocities[0])) * direction
    for one in simulation.velocities:
        assert mass * (one - velocities) / h == pytest.approx(np.array([pull, -pull]), rel=1e-5, abs=1e-6)


def test_pbd_does_not_converge(chain):
    """A hundredfold smaller step leaves as much error as the oscillator was let go with."""
    assert INTEGRATORS["pbd"].order is None
    for steps in (10, 100, 1000):
        assert error_after_a_radian(chain, "pbd", steps) > 0.09


@pytest.mark.parametrize("name", CONSISTENT)
@pytest.mark.parametrize("damping_time", [0.01, 0.05])
def test_damping_time_is_the_same_physics_for_all(chain, name, damping_time):
    """A Kelvin-Voigt spring decays by exp(-tau w^2 t / 2): its motion through 1 s."""
    w, h, every = 5.0, 2e-4, 50
    simulation = chain(2, name, h, w * w, 1.0, damping_time=damping_time, time_step=every * h)
    simulation.reset(positions=[[0, 0, 0], [1.1, 0, 0]])
    values = []
    for _ in range(100):
        simulation.step()
        values.append(simulation.positions[0, 1, 0] - 1)
    t = every * h * np.arange(1, 101)
    rate = damping_time * w * w / 2
    wd = np.sqrt(w * w - rate * rate)
    exact = 0.1 * np.exp(-rate * t) * (np.cos(wd * t) + rate / wd * np.sin(wd * t))
    assert np.max(np.abs(values - exact)) < TOLERANCE[INTEGRATORS[name].order]


@pytest.mark.parametrize(("name", "iterations"), [("xpbd", 1), ("xpbd", 4), ("projective_dynamics", 1), ("projective_dynamics", 4)])
@pytest.mark.parametrize("damping_time", [0.0, 0.004, 0.1])
@pytest.mark.parametrize("q", [0.1, 0.8, 5.0])
def test_one_spring_is_implicit_euler_to_rounding(chain, damping_time, q, name, iterations):
    """Trajectories along a spring of 100 m, beside which the 1e-12 m^2 that keep a projection from dividing by zero are nothing.

    The first iteration solves a lone spring's equation, and more change nothing.
    """
    paths = []
    for method in ({"name": name, "iterations": iterations}, "implicit_euler"):
        simulation = chain(2, method, 0.01, (q / 0.01) ** 2, damping_time=damping_time, spacing=100.0)
        simulation.reset(positions=[[0, 0, 0], [100.3, 0, 0]], velocities=[[0, 0, 0], [-0.4, 0, 0]])
        path = []
        for _ in range(60):
            simulation.step()
            path.append(simulation.positions[0, 1, 0])
        paths.append(np.array(path))
    assert paths[0] == pytest.approx(paths[1], rel=0, abs=1e-12)
    assert np.max(np.abs(paths[0] - 100.3)) > 0.01


@pytest.mark.parametrize("damping_time", [0.0, 0.004, 0.1])
@pytest.mark.parametrize("bending", ["hinge", "quadratic"])
@pytest.mark.parametrize(
    "method", ["implicit_euler", "xpbd", {"name": "xpbd", "iterations": 4}], ids=["implicit_euler", "xpbd", "xpbd in 4 passes"]
)
def test_one_hinge_is_a_damped_oscillator_in_implicit_euler_s_steps(method, bending, damping_time):
    """A square of two triangles, its ends up and its corners down by z: each side's height over the edge is 1/sqrt(2), so the angle
    is 4 sqrt(2) z, and ``z'' = -8 B s/m (z + tau z')`` with the hinge's weight s."""
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0]])
    mesh, h, mass, rigidity = triangle_mesh(square, np.array([[0, 1, 3], [0, 3, 2]])), 0.01, 0.5, 5.0
    method = {"name": method, "tolerance": 1e-13} if method == "implicit_euler" else method
    simulation = Simulation(
        mesh, Material(stretch_stiffness=1e-9, shear_stiffness=0, bend_rigidity=1e-9, damping_time=1e3), integrator=method,
        time_step=h, substeps=1, gravity=(0, 0, 0), air_density=0, bending=bending, dtype="float64",
    )  # fmt: skip
    state = simulation.get_state()
    state.stiffness[:], state.rigidity[:], state.damping_time[:], state.drag_rate[:] = 0, rigidity, damping_time, 0
    state.free_inverse_mass[:] = 1 / mass
    simulation.set_state(state)
    (weight,), sign = mesh.hinges.weight, np.array([1, -1, -1, 1])
    z, speed, k = 1e-5, 0.0, 8 * rigidity * weight / mass
    simulation.reset(positions=square + z * sign[:, None] * np.array([0, 0, 1.0]))
    for _ in range(60):
        speed = (speed - h * k * z) / (1 + h * k * damping_time + h * h * k)
        z += h * speed
        simulation.step()
        assert simulation.positions[0, :, 2] == pytest.approx(z * sign, abs=1e-12)
    assert abs(z) < 0.9e-5

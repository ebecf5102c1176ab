"""Methods that solve for the end of the substep: against scipy's backward Euler, and what their iterations may not change."""

import numpy as np
import pytest
from scipy.optimize import root

from clothgym import Material, Simulation, grid

FABRIC = Material(stretch_stiffness=60, shear_stiffness=24, bend_rigidity=2e-5, damping_time=2e-3)
EXACT = {"name": "implicit_euler", "newton_iterations": 30, "tolerance": 1e-12}


# --- xpbd -----------------------------------------------------------------------------------------------------------------


def measured_over_nominal_stiffness(chain, q2, iterations, links=8):
    """Of a chain with one end held, at rest under a load on the other."""
    m, h = 1.0, 0.01
    k = q2 * m / h**2
    drag = 4 * np.sqrt(k / m) * np.sin(np.pi / (4 * links + 2))  # stops the slowest swing soonest
    simulation = chain(links + 1, {"name": "xpbd", "iterations": iterations}, h, k, m, drag_rate=drag)
    load = 0.01 * k
    for _ in range(round(60 / (h * drag)) + 100):
        # a push on the last particle; the substep's drag takes its share of it
        simulation._v[0, 0, -1, 0] += h * load / m * (1 + h * drag)
        simulation.step()
    assert np.max(np.abs(simulation.velocities)) < 1e-7
    return load * links / (simulation.positions[0, -1, 0] - links) / k


@pytest.mark.parametrize("q2", [2.17, 0.5, 0.136, 0.0085])
def test_xpbd_in_one_pass_matches_its_softness_formula(chain, q2):
    """r = 1/(1 + q^2 (N - 1)/N) for N links."""
    assert measured_over_nominal_stiffness(chain, q2, 1) == pytest.approx(1 / (1 + q2 * 7 / 8), rel=0.02)


def test_xpbd_converges_to_the_fabric_stiffness_with_more_passes(chain):
    """At q^2 = 2.17, where one pass leaves a third of it; without multipliers that remember, it would grow beyond all bounds."""
    ratios = {n: measured_over_nominal_stiffness(chain, 2.17, n) for n in (1, 2, 4, 8, 16, 64)}
    print(", ".join(f"{n}: {ratio:.4f}" for n, ratio in ratios.items()))
    assert ratios[64] == pytest.approx(1, rel=0.02)
    assert ratios[8] == pytest.approx(1, rel=0.1)
    assert ratios[1] < ratios[2] < ratios[4] < ratios[8]


# --- backward Euler, found by scipy -----------------------------------------------------------------------------------------


def forces(x, v, mesh, state, hinged):
    """Of springs with dampers, and of the energy B/2 weight |sum_i slope_i x_i|^2 with dampers, (particles, 3)."""
    s, h, tau = mesh.springs, mesh.hinges, state.damping_time[0]
    out = np.zeros_like(x)
    i, j = s.particles.T
    d = x[j] - x[i]
    length = np.linalg.norm(d, axis=1, keepdims=True)
    n = d / length
    k = (s.weight * state.stiffness[0, s.kind])[:, None]
    pull = k * (length - s.rest_length[:, None] + tau * np.sum((v[j] - v[i]) * n, axis=1, keepdims=True)) * n
    np.add.at(out, i, pull)
    np.add.at(out, j, -pull)
    if hinged:
        curve = np.einsum("sm,smc->sc", h.slopes, (x + tau * v)[h.particles])
        for m in range(4):
            np.add.at(out, h.particles[:, m], -state.rigidity[0] * (h.weight * h.slopes[:, m])[:, None] * curve)
    return out


def backward_euler(x, v, held, h, mesh, state, hinged):
    """Positions and velocities with ``M (v' - v) = h (M g + f(x + h v', v'))``; held particles keep their velocity."""
    free = np.setdiff1d(np.arange(len(x)), held)
    mass = 1 / state.free_inverse_mass[0, free, None]
    start = v[free] + h * state.gravity[0]

    def left(flat):
        v[free] = flat.reshape(-1, 3)
        return (v[free] - start - h / mass * forces(x + h * v, v, mesh, state, hinged)[free]).ravel()

    v = v.copy()
    found = root(left, start.ravel(), tol=1e-13).x
    assert np.max(np.abs(left(found))) < 1e-10
    return x + h * v, v


@pytest.mark.parametrize(
    "method",
    [{"name": "projective_dynamics", "iterations": 600}, {"name": "implicit_euler", "newton_iterations": 60, "tolerance": 1e-13}],
    ids=lambda method: method["name"],
)
@pytest.mark.parametrize("bending", ["springs", "quadratic"])
def test_the_fixed_point_is_backward_euler_s(method, bending):
    """One substep and eight, of a sheet that is out of shape and held at two corners, one of which moves."""
    mesh, h = grid(4, 4, 0.3, 0.3), 5e-3
    simulation = Simulation(
        mesh, FABRIC, integrator=method, anchors=[0, 3], time_step=h, substeps=1, air_density=0, bending=bending, dtype="float64"
    )
    noise = np.random.default_rng(0).normal(size=(2, 16, 3))
    simulation.reset(positions=mesh.rest_positions + 5e-3 * noise[0], velocities=0.3 * noise[1])
    state = simulation.get_state()
    x, v = state.positions[0], state.velocities[0]
    goal = x[[0, 3]]
    for _ in range(8):
        goal = goal + ((0, 0, 0), (0, 2e-3, 1e-3))
        simulation.move_anchors(goal)
        v[[0, 3]] = (goal - x[[0, 3]]) / h
        x, v = backward_euler(x, v, [0, 3], h, mesh, state, hinged=bending != "springs")
        simulation.step()
        assert np.max(np.abs(simulation.positions[0] - x)) < 1e-8
        assert np.max(np.abs(simulation.velocities[0] - v)) < 1e-8 / h
    assert np.max(np.abs(x - mesh.rest_positions)) > 0.015


# --- held particles -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_held_particles_are_exact_after_one_iteration_as_after_a_hundred(dtype):
    """Bit for bit on the line of their attachment, as particles without cloth would be: x <- x + h v, by Kahan's sum."""
    mesh = grid(5, 5, 0.3, 0.3)
    paths = []
    for iterations in (1, 100):
        method = {"name": "implicit_euler", "iterations": iterations, "tolerance": 1e-6}
        simulation = Simulation(mesh, integrator=method, anchors=[0, 4], time_step=1 / 60, substeps=7, dtype=dtype)
        x = simulation.positions[0, [0, 4]]
        left, free = np.zeros_like(x), []
        for step in range(20):
            simulation.move_anchors(mesh.rest_positions[[0, 4]] + np.array([1e-3, 2e-3, 3e-3]) * (step + 1))
            simulation.step()
            v = simulation.velocities[0, [0, 4]]
            for _ in range(7):
                change = simulation.dtype.type(1 / 60 / 7) * v + left
                left, x = change - ((x + change) - x), x + change
            assert np.array_equal(simulation.positions[0, [0, 4]], x)
            free.append(simulation.positions[0, 12])
        paths.append(np.array(free))
    assert np.abs(paths[0] - paths[1]).max() > 1e-5  # the iterations do matter to the others


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_conjugate_gradients_of_a_lane_do_not_see_the_others(dtype):
    """Seventeen lanes, one of which becomes a thousand times stiffer, and needs many more iterations: sixteen keep their bits."""
    mesh = grid(6, 6, 0.3, 0.3)
    batches = []
    for stiffness in (100.0, 1e5):
        simulation = Simulation(mesh, num_envs=17, integrator="implicit_euler", anchors=[0], substeps=5, dtype=dtype)
        simulation.set_parameters(envs=[3], warn=False, stretch_stiffness=stiffness, shear_stiffness=0.4 * stiffness)
        simulation.reset(positions=mesh.rest_positions + np.random.default_rng(0).normal(scale=2e-3, size=(36, 3)))
        simulation.step(20)
        batches.append(simulation.positions)
    others = np.arange(17) != 3
    assert np.array_equal(batches[0][others], batches[1][others])
    assert np.abs(batches[0][3] - batches[1][3]).max() > 1e-4


def test_projective_dynamics_lets_go_and_takes_hold_in_each_environment():
    """Anchors of three environments that let go and take hold at different times, while they move, against Newton's method."""
    mesh, batches = grid(4, 4, 0.3, 0.3), []
    for method in ({"name": "projective_dynamics", "iterations": 300}, EXACT):
        simulation = Simulation(
            mesh, FABRIC, num_envs=3, integrator=method, anchors=[0, 3, 13], time_step=0.02, substeps=4, dtype="float64"
        )
        path = []
        for step in range(12):
            if step == 2:
                simulation.release(envs=[1], anchors=[0])
                simulation.release(envs=[2])
            if step == 6:
                simulation.release(envs=[0], anchors=[2])
                simulation.attach(envs=[2, 1], anchors=[1, 0])
            simulation.move_anchors(simulation.attachment_positions[:, :3] + (1e-3, 0, 2e-3))
            simulation.step()
            path.append(simulation.positions)
        batches.append(np.array(path))
    assert np.abs(batches[0] - batches[1]).max() < 1e-8
    assert batches[0][-1, 1, 0, 2] > batches[0][6, 1, 0, 2] + 5e-3  # taken hold of again, and carried
    assert np.abs(batches[0][-1, 0] - batches[0][-1, 1]).max() > 0.01

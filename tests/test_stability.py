"""Each method's bound on the substep: sharp on one spring and on a sheet, whatever decides on it."""

import warnings

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Simulation, grid
from clothgym.elements import element_arrays
from clothgym.forces import Oscillators, frequency_bound, largest_frequency
from clothgym.triangles import triangle_mesh

EXPLICIT = ["explicit_euler", "semi_implicit_euler", "verlet", "rk4"]
UNCONDITIONAL = ["implicit_euler", "projective_dynamics", "pbd", "xpbd"]


# --- one spring -----------------------------------------------------------------------------------------------------------


def step_matrix(name, h, w2, damping_time):
    """Of (x, v) of a damped oscillator, x'' = -w^2 (x + tau x'), over h."""
    a = np.array([[0, 1], [-w2, -damping_time * w2]])
    one = np.eye(2)
    kick, drift = one + h * a * [[0], [1]], one + h * a * [[1], [0]]
    half = one + h / 2 * a * [[1], [0]]
    return {
        "explicit_euler": one + h * a,
        "semi_implicit_euler": drift @ kick,
        "verlet": half @ kick @ half,
        "rk4": one + h * a @ (one + h / 2 * a @ (one + h / 3 * a @ (one + h / 4 * a))),
    }[name]


def stable_step(name, w2, damping_time):
    """Largest h up to which no eigenvalue of the step matrix leaves the unit circle."""

    def stable(h):
        return np.abs(np.linalg.eigvals(step_matrix(name, h, w2, damping_time))).max() <= 1 + 1e-12

    steps = np.geomspace(1e-3, 10, 4000) / np.sqrt(w2)
    beyond = next(n for n, h in enumerate(steps) if not stable(h))
    low, high = steps[beyond - 1], steps[beyond]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def outgrows(simulation, steps):
    """Whether a stretch of 1e-9 m becomes a million times longer."""
    simulation.reset(positions=[[0, 0, 0], [1 + 1e-9, 0, 0]])
    for _ in range(40):
        simulation.step(-(-steps // 40))
        if not abs(simulation.positions[0, 1, 0] - 1) < 1e-3:
            return True
    return False


@pytest.mark.parametrize(("name", "factor"), [("semi_implicit_euler", 2), ("verlet", 2), ("rk4", 2 * np.sqrt(2))])
def test_undamped_bound_on_one_spring(chain, name, factor):
    """factor sqrt(m/k), and of two free masses, of which the reduced one swings."""
    k, m = 100.0, 0.25
    for share, grows in ((0.99, False), (1.01, True)):
        h = share * factor * np.sqrt(m / k)
        assert outgrows(chain(2, name, h, k, m), 800) == grows
    assert chain(2, name, 1e-3, k, m).largest_substep()[0] == pytest.approx(factor * np.sqrt(m / 2 / k), rel=1e-6)


def test_undamped_explicit_euler_grows_at_any_step(chain):
    """sqrt(1 + q^2) a step: far below every other's bound, and to that formula."""
    q, steps = 0.1, 2400
    simulation = chain(2, "explicit_euler", q, 1.0)
    assert simulation.largest_substep()[0] == 0
    simulation.reset(positions=[[0, 0, 0], [1 + 1e-9, 0, 0]])
    simulation.step(steps)
    swing = np.hypot(simulation.positions[0, 1, 0] - 1, simulation.velocities[0, 1, 0])
    assert swing == pytest.approx(1e-9 * (1 + q * q) ** (steps / 2), rel=1e-5)


@pytest.mark.parametrize("name", EXPLICIT)
@pytest.mark.parametrize("damping_time", [0.02, 0.13, 0.5])
def test_damped_bound_on_one_spring(chain, name, damping_time):
    """Eigenvalues of the step matrix, for a damping ratio of 0.1, 0.65 and 2.5."""
    w2 = 100.0
    bound = stable_step(name, w2, damping_time)
    beyond = np.abs(np.linalg.eigvals(step_matrix(name, 1.01 * bound, w2, damping_time))).max()
    steps = int(40 / np.log(beyond))
    for share, grows in ((0.99, False), (1.01, True)):
        assert outgrows(chain(2, name, share * bound, w2, 1.0, damping_time=damping_time), steps) == grows
    # two free masses, each twice as heavy, swing as one does; rk4 is not asked for more than it can without damping
    free = chain(2, name, 1e-3, w2, 2.0, damping_time=damping_time)
    stated = min(bound, 2 * np.sqrt(2 / w2)) if name == "rk4" else bound
    assert free.largest_substep()[0] == pytest.approx(stated, rel=1e-6)


# --- a sheet --------------------------------------------------------------------------------------------------------------


def sheet(name, h, material, bending="springs"):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Simulation(
            grid(6, 6, 0.3, 0.3), material, integrator=name, time_step=h, substeps=1, gravity=(0, 0, 0), air_density=0,
            bending=bending, on_divergence="ignore", dtype="float64",
        )  # fmt: skip


def growth(simulation, directions, steps=2000):
    """Of a small random disturbance along some axes; at the first sight of a millionfold it has seen enough."""
    rest = simulation.mesh.rest_positions
    simulation.reset(positions=rest + np.random.default_rng(0).normal(scale=1e-9, size=rest.shape) * directions)
    for _ in range(steps // 40):
        simulation.step(40)
        share = np.max(np.abs(simulation.positions[0] - rest)) / 1e-9
        if not share < 1e6:
            return np.inf
    return share


SPRINGS = Material(damping_time=0.0)
# so rigid that hinges swing faster than springs, which then are ten times softer than cotton's
RIGID = Material(stretch_stiffness=26.1, shear_stiffness=10.5, bend_rigidity=0.1, damping_time=0.0)


@pytest.mark.parametrize(
    ("name", "bending", "damping"),
    [
        *(
            (name, "springs", damping)
            for name in EXPLICIT
            for damping in (0.0, 1.5, 3.0)
            if (name, damping) != ("explicit_euler", 0)
        ),
        ("semi_implicit_euler", "hinge", 0.0),
        ("rk4", "quadratic", 0.0),
    ],
)
def test_bound_of_a_sheet_is_sharp(name, bending, damping):
    """Damping: retardation time of the stiffest mode by its frequency."""
    material = SPRINGS if bending == "springs" else RIGID
    directions = (1, 1, 0) if bending == "springs" else (0, 0, 1)
    simulation = sheet("verlet", 1e-5, material, bending)
    fastest = 2 / simulation.largest_substep()[0]
    material = Material(**{**vars(material), "damping_time": damping / fastest})
    bound = sheet(name, 1e-9, material, bending).largest_substep()[0]
    below, above = (growth(sheet(name, share * bound, material, bending), directions) for share in (0.99, 1.01))
    assert below < 100
    assert above == np.inf
    if damping == 0:  # one spring's 2 sqrt(m/k) would be too generous, and springs say nothing of hinges
        state = simulation.get_state()
        lone = 1 / np.sqrt(np.max(state.stiffness) * np.median(state.free_inverse_mass))
        assert lone * bound * fastest > 1.3 * bound


@pytest.mark.parametrize(("name", "factor"), [*((name, 10) for name in (*EXPLICIT, "xpbd")), ("implicit_euler", 1), ("pbd", 1)])
def test_automatic_substeps_follow_stiffness(name, factor):
    """A hundredfold stiffness, with dampers as near to critical: ten times the substeps; implicit Euler follows swings only."""
    mesh = grid(5, 5, 0.3, 0.3)
    soft, stiff = (
        Simulation(
            mesh,
            Material(stretch_stiffness=k, shear_stiffness=0.4 * k, bend_rigidity=0, damping_time=0.02 / np.sqrt(k)),
            integrator=name,
            time_step=1.0,
        ).substeps
        for k in (200.0, 20000.0)
    )
    assert stiff == pytest.approx(factor * soft, rel=0.01)


@pytest.mark.parametrize("name", UNCONDITIONAL)
def test_no_step_is_too_large_for_an_implicit_method(name):
    """Crumpled, at a hundred times the explicit bound: never larger than twice the sheet's diagonal, nor faster than at first."""
    bound = sheet("semi_implicit_euler", 1e-5, SPRINGS).largest_substep()[0]
    simulation = sheet(name, 100 * bound, SPRINGS)
    rest = simulation.mesh.rest_positions
    noise = np.random.default_rng(0).normal(size=(2, *rest.shape))
    simulation.reset(positions=rest + 0.01 * noise[0], velocities=noise[1])
    for _ in range(100):
        simulation.step()
        x = simulation.positions[0]
        assert np.max(np.linalg.norm(x - x.mean(axis=0), axis=1)) < 2 * np.hypot(0.3, 0.3)
        assert np.max(np.linalg.norm(simulation.velocities[0], axis=1)) < np.max(np.linalg.norm(noise[1], axis=1))


# --- the largest frequency --------------------------------------------------------------------------------------------------


def bend_angles(x, hinges):
    """Angle between the normals of both triangles at each hinge, (sheets, hinges), from their cross and dot products."""
    i, j, k, l = (x[:, hinges.particles[:, m]] for m in range(4))
    one, two = np.cross(j - i, k - i), np.cross(l - i, j - i)
    edge = (j - i) / np.linalg.norm(j - i, axis=2, keepdims=True)
    return np.arctan2(np.sum(np.cross(two, one) * edge, axis=2), np.sum(one * two, axis=2))


def elastic_energy(x, mesh, springs, stiffness, rigidity, bending, slopes):
    """Of sheets, (sheets, particles, 3): Hooke's, and B/2 weight (angle - rest angle)^2, or its square form in the positions."""
    i, j = springs.particles.T
    stretch = np.linalg.norm(x[:, j] - x[:, i], axis=2) - springs.rest_length
    total = np.sum(springs.weight * stiffness[springs.kind] * stretch**2, axis=1) / 2
    hinges = mesh.hinges
    if bending == "hinge":
        angles = bend_angles(x, hinges) - bend_angles(mesh.rest_positions[None], hinges)
        total = total + rigidity / 2 * np.sum(hinges.weight * angles**2, axis=1)
    if bending == "quadratic":
        total = total + rigidity / 2 * np.sum(
            hinges.weight[:, None] * np.einsum("sm,esmc->esc", slopes, x[:, hinges.particles]) ** 2, axis=(1, 2)
        )
    return total


def flat_slopes(mesh, step=1e-7):
    """Derivative of each angle by its four corners' heights, (hinges, 4), by differences."""
    slopes = np.empty(mesh.hinges.particles.shape)
    for hinge, corners in enumerate(mesh.hinges.particles):
        for m, corner in enumerate(corners):
            x = np.array([mesh.rest_positions] * 2)
            x[:, corner, 2] += (-step, step)
            low, high = bend_angles(x, mesh.hinges)[:, hinge]
            slopes[hinge, m] = (high - low) / (2 * step)
    return slopes


def dense_frequency(energy, rest, mass):
    """Root of the largest eigenvalue of M^-1/2 H M^-1/2, with H by second differences of an energy in float64."""
    size, step = rest.size, 1e-6
    shifts = step * np.eye(size)
    hessian = np.empty((size, size))
    for row in range(size):
        total = [
            energy((rest.ravel() + one * shifts[row] + other * shifts).reshape(size, *rest.shape))
            for one, other in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        ]
        hessian[row] = (total[0] - total[1] - total[2] + total[3]) / (4 * step**2)
    scale = np.repeat(mass**-0.5, 3)
    return np.sqrt(np.linalg.eigvalsh(hessian * scale[:, None] * scale).max())


def saddle():
    """A mesh of triangles that is bent at rest."""
    flat = grid(4, 5, 0.3, 0.3)
    x, y, _ = flat.rest_positions.T
    return triangle_mesh(np.stack([x, y, 2 * x * x - 3 * y * y], axis=1), flat.triangles)


@pytest.mark.parametrize(
    ("mesh", "bending", "rigidity"),
    [
        (grid(5, 5, 0.3, 0.3), "springs", 0.0),
        (grid(5, 4, 0.2, 0.35), "springs", 0.0),
        (grid(2, 2, 0.1, 0.1), "springs", 0.0),
        (grid(5, 4, 0.2, 0.2), "hinge", 1e-5),
        (grid(5, 4, 0.2, 0.2), "hinge", 0.1),
        (grid(5, 4, 0.2, 0.2), "quadratic", 0.1),
        (saddle(), "springs", 0.0),
        (saddle(), "hinge", 0.1),
    ],
)
def test_frequencies_against_a_dense_eigenvalue(mesh, bending, rigidity):
    rng = np.random.default_rng(0)
    stiffness, mass = rng.uniform(50, 300, 7), rng.uniform(1e-4, 1e-3, mesh.num_particles)
    stiffness[6] = 1e-4  # of springs between opposite corners, in N m
    elements = element_arrays(mesh, np.dtype(np.float64), bending != "springs", any_order=False)
    slopes = flat_slopes(mesh)
    exact = dense_frequency(
        lambda x: elastic_energy(x, mesh, elements.springs, stiffness, rigidity, bending, slopes), mesh.rest_positions, mass
    )
    o = Oscillators(mesh.rest_positions, elements, stiffness, rigidity, bending == "quadratic", 0.0, 1 / mass)
    assert largest_frequency(o) == pytest.approx(exact, rel=3e-4)
    assert 0.9999 * exact <= frequency_bound(o) < 1.6 * exact


# --- violence ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("side", "meters", "limit"), [(9, 3, None), (12, 3, None), (15, 3, None), (9, 10, None), (9, 10, 0.1)])
@pytest.mark.parametrize("name", [name for name in INTEGRATORS if name != "explicit_euler"])
def test_a_corner_that_is_torn_meters_away_in_one_step_comes_back(name, side, meters, limit):
    """At 180 and 600 m/s, with the automatic substeps: half a second there, and three seconds later the sheet hangs as before.

    verlet comes back from 7 m; from 10 m it keeps shaking where nothing limits the strain.
    """
    simulation = Simulation(
        grid(side, side, 0.6, 0.6), integrator=name, anchors=(0, side - 1), anchor_speed=1e4, strain_limit=limit, threads=1
    )
    simulation.step(5)
    home, way = simulation.attachment_positions, min(meters, 7) if name == "verlet" and limit is None else meters
    for place, steps in ((home + [(0, 0, 0), (way, 0, 0)], 30), (home, 180)):
        for _ in range(steps):
            simulation.move_anchors(place)
            simulation.step()
    assert not simulation.diverged.any()
    assert simulation.strain().max() < 0.4 and np.abs(simulation.positions).max() < 0.65
    assert np.sqrt((simulation.velocities**2).sum(axis=2).mean()) < 0.5

"""What resists bending: its forces against its energy, its energy against the plate's, and strips against the elastica."""

import numpy as np
import pytest
from equilibria import G, heavy_elastica
from scipy.optimize import brentq

from clothgym import Material, Simulation, disc, grid, triangle_mesh
from clothgym.bending import BENDING
from clothgym.elements import Elastic, element_arrays, scratch_for_forces
from clothgym.forces import add_lane_forces
from clothgym.mesh import BEND_X, NUM_KINDS, STRUCTURAL_X

HINGED = [name for name, model in BENDING.items() if model.hinged]
B = 3e-4


def lanes_of(x, lanes):
    """(particles, 3) as (3, particles, lanes), the same in each lane."""
    return np.repeat(x.T[:, :, None], lanes, axis=2)


def no_springs(lanes, damping_time=0.0):
    """What forces scale with where hinges alone hold."""
    return Elastic(np.zeros((NUM_KINDS, lanes)), np.full(lanes, B), np.full(lanes, damping_time), np.ones(lanes))


def room(x):
    return scratch_for_forces(x, np.zeros(0, np.int64))


def bend_forces(model, mesh, x, lanes=1, v=None, damping_time=0.0):
    """Of all hinges [N], (particles, 3, lanes); v [m/s]."""
    elements = element_arrays(mesh, np.dtype(np.float64), hinged=True, any_order=False)
    at, rate = lanes_of(x, lanes), lanes_of(np.zeros_like(x) if v is None else v, lanes)
    f = np.zeros_like(at)
    BENDING[model].kernels["add_bend_forces"](at, rate, f, elements, no_springs(lanes, damping_time), room(at))
    return np.swapaxes(f, 0, 1)


def bend_matrix(model, mesh, x):
    """What ``add_bend_products`` multiplies with [N/m], column by column, (3 particles, 3 particles)."""
    elements = element_arrays(mesh, np.dtype(np.float64), hinged=True, any_order=False)
    lanes = x.size  # a unit vector in each lane
    at, p = lanes_of(x, lanes), np.swapaxes(np.eye(lanes).reshape(len(x), 3, lanes), 0, 1).copy()
    y = np.zeros_like(p)
    BENDING[model].kernels["add_bend_products"](at, p, y, elements, np.full(lanes, B), room(at))
    return np.swapaxes(y, 0, 1).reshape(lanes, lanes)


def angles(mesh, x):
    """Between the triangles at each inner edge [rad], by the arc cosine of their normals, positive as a ridge seen from above."""
    i, j, k, l = mesh.hinges.particles.T
    one, two = np.cross(x[j] - x[i], x[k] - x[i]), np.cross(x[l] - x[i], x[j] - x[i])
    cosine = np.sum(one * two, axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
    return -np.sign(np.sum(one * (x[l] - x[i]), axis=1)) * np.arccos(np.clip(cosine, -1, 1))


def hinge_energy(mesh, x):
    return B / 2 * np.sum(mesh.hinges.weight * (angles(mesh, x) - mesh.hinges.rest_angle) ** 2)


def derivative(function, x, step=1e-6):
    """By central differences, (function's shape, particles, 3)."""
    shifts = step * np.eye(x.size).reshape(-1, *x.shape)
    columns = [(function(x + shift) - function(x - shift)) / (2 * step) for shift in shifts]
    return np.moveaxis(np.array(columns), 0, -1).reshape(*np.shape(columns[0]), *x.shape)


def folded(angle, rng):
    """Two triangles of random shape that make an angle [rad]."""
    tips = rng.uniform(0.3, 0.7, 2)
    heights = rng.uniform(0.6, 1.2, 2)
    one = [tips[0], heights[0], 0]
    other = [tips[1], -heights[1] * np.cos(angle), -heights[1] * np.sin(angle)]
    return np.array([[0, 0, 0], [1, 0, 0], one, other], float)


PAIR = [[0, 1, 2], [1, 0, 3]]


@pytest.mark.parametrize("rest", [0.0, 0.7, -1.9])
@pytest.mark.parametrize("angle", [0.0, 1e-3, -0.5, 1.5, -2.5, 3.0])
def test_a_hinge_s_force_is_minus_the_slope_of_its_energy(angle, rest):
    """Of B/2 e/h (angle - rest angle)^2, by central differences, strongly folded ones and bent rest shapes too."""
    rng = np.random.default_rng(0)
    mesh = triangle_mesh(folded(rest, rng), PAIR)
    assert mesh.hinges.rest_angle == pytest.approx(rest, abs=1e-9)
    x = folded(angle, rng)
    assert angles(mesh, x) == pytest.approx(angle, abs=1e-6)
    if angle == 0:  # where the arc cosine has no slope
        x = folded(1e-2, rng)
    slope = derivative(lambda q: hinge_energy(mesh, q), x)
    assert bend_forces("hinge", mesh, x)[:, :, 0] == pytest.approx(-slope, abs=2e-8 + 1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("model", HINGED)
def test_a_bent_sheet_s_forces_and_energy_belong_together(model):
    """On a rumpled grid; the energy is the simulation's, and for hinges that of the angles."""
    mesh = grid(4, 5, 0.3, 0.3)
    simulation = Simulation(mesh, Material(bend_rigidity=B), bending=model, dtype="float64", substeps=1000)

    def energy(x):
        simulation.reset(positions=x)
        springs = simulation.mesh.springs
        stretch = np.linalg.norm(x[springs.particles[:, 1]] - x[springs.particles[:, 0]], axis=1) - springs.rest_length
        k = springs.weight * simulation.get_state().stiffness[0, springs.kind] * (springs.kind < BEND_X)
        return simulation.energy().elastic[0] - np.sum(k * stretch**2) / 2

    x = mesh.rest_positions + np.random.default_rng(0).normal(scale=0.02, size=mesh.rest_positions.shape)
    if model == "hinge":
        assert energy(x) == pytest.approx(hinge_energy(mesh, x), rel=1e-9)
    slope = derivative(energy, x)
    assert bend_forces(model, mesh, x)[:, :, 0] == pytest.approx(-slope, abs=1e-5 * np.abs(slope).max())


@pytest.mark.parametrize("model", HINGED)
def test_the_product_is_of_a_symmetric_matrix_without_negative_eigenvalues(model):
    """Of Gauss and Newton: sum of B w times the outer square of what is bent; for the quadratic model the Hessian itself."""
    mesh = grid(3, 3, 0.2, 0.2)
    x = mesh.rest_positions + np.random.default_rng(1).normal(scale=0.02, size=mesh.rest_positions.shape)
    matrix = bend_matrix(model, mesh, x)
    if model == "hinge":
        slopes = derivative(lambda q: angles(mesh, q), x).reshape(-1, x.size)
        exact = B * slopes.T @ (mesh.hinges.weight[:, None] * slopes)
    else:
        exact = -derivative(lambda q: bend_forces(model, mesh, q)[:, :, 0].ravel(), x).reshape(x.size, x.size)
    size = np.abs(exact).max()
    assert matrix == pytest.approx(exact, abs=1e-6 * size)
    assert matrix == pytest.approx(matrix.T, abs=1e-12 * size)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12 * size


@pytest.mark.parametrize("model", HINGED)
def test_dampers_turn_the_same_matrix(model):
    """A velocity u draws the force -tau K u, with K of the product."""
    mesh = grid(3, 3, 0.2, 0.2)
    rng = np.random.default_rng(2)
    x, u = mesh.rest_positions + rng.normal(scale=0.02, size=(9, 3)), rng.normal(size=(9, 3))
    damper = (bend_forces(model, mesh, x, v=u, damping_time=0.3) - bend_forces(model, mesh, x))[:, :, 0]
    assert damper.ravel() == pytest.approx(-0.3 * bend_matrix(model, mesh, x) @ u.ravel(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("model", HINGED)
def test_one_lane_and_five_agree_to_the_last_bit(model):
    mesh = grid(4, 5, 0.3, 0.3)
    x = mesh.rest_positions + np.random.default_rng(0).normal(scale=0.02, size=mesh.rest_positions.shape)
    alone, among = (bend_forces(model, mesh, x, lanes, v=x[::-1], damping_time=1e-3) for lanes in (1, 5))
    assert np.array_equal(np.repeat(alone, 5, axis=2), among)


# --- the energy of a cylinder ---------------------------------------------------------------------------------------------


def cylinder(mesh, curvature, degrees):
    """The sheet rolled without stretch about an axis across the direction of ``degrees``."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along = mesh.rest_positions @ (c, s, 0)
    across = mesh.rest_positions @ (-s, c, 0)
    rolled, lifted = np.sin(curvature * along) / curvature, (1 - np.cos(curvature * along)) / curvature
    return np.stack([rolled * c - across * s, rolled * s + across * c, lifted], axis=1)


def bend_energy(model, mesh, x):
    """The bending elements' part alone [J]: the springs' stretch is kept from counting by its stiffness."""
    tiny = Material(stretch_stiffness=1e-12, shear_stiffness=0, bend_rigidity=B)
    simulation = Simulation(mesh, tiny, bending=model, dtype="float64", substeps=1000)
    simulation.reset(positions=x)
    return simulation.energy().elastic[0]


@pytest.mark.parametrize("model", HINGED)
def test_a_grid_s_cylinder_along_its_lines_stores_the_plate_s_energy(model):
    """B kappa^2/2 an area times (N - 2)/(N - 1), as the first and last column cannot bend."""
    columns, curvature = 21, 0.5
    mesh = grid(11, columns, 1.0, 0.5)
    expected = B * curvature**2 / 2 * 0.5 * (columns - 2) / (columns - 1)
    assert bend_energy(model, mesh, cylinder(mesh, curvature, 0)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("model", HINGED)
@pytest.mark.parametrize("degrees", [0, 10, 22.5, 45, 70])
def test_a_grid_s_cylinder_costs_the_same_in_any_direction(model, degrees):
    """A sheet of twice the sides without two of the smaller: what is left has no border, and stores B kappa^2/2 an area."""
    small, large = grid(21, 21, 0.5, 0.5), grid(41, 41, 1.0, 1.0)
    one, four = (bend_energy(model, mesh, cylinder(mesh, 0.5, degrees)) for mesh in (small, large))
    assert (four - 2 * one) / 0.5 == pytest.approx(B * 0.5**2 / 2, rel=5e-3)


@pytest.mark.parametrize("model", HINGED)
def test_a_disc_s_cylinder_stores_the_plate_s_energy(model):
    """Of all its hinges, whose weights are set by the mean over directions; the border's half-hinges are missing."""
    for rings in (8, 16):
        mesh = disc(0.5, rings)
        ratios = [
            bend_energy(model, mesh, cylinder(mesh, 0.5, degrees)) / (B * 0.5**2 / 2 * mesh.area.sum())
            for degrees in (0, 11, 22.5, 30, 45)
        ]
        assert ratios == pytest.approx(np.ones(5), rel=0.1)
        assert np.mean(ratios) == pytest.approx(1, abs=1.5 / rings)


def test_skip_springs_have_no_rigidity_in_the_flat_state():
    """Energy k kappa^4 a^4/32 an area: halve the curvature and a sixteenth is left, where a plate has a quarter."""
    mesh, k = grid(3, 201, 10.0, 0.1), 200.0
    energies = []
    for curvature in (1.0, 0.5, 0.25):
        simulation = Simulation(mesh, Material(shear_stiffness=0, bend_rigidity=0), dtype="float64", substeps=1000)
        state = simulation.get_state()
        state.stiffness[:] = 0
        state.stiffness[:, BEND_X] = k
        # a polygon of sides at their rest length, each turned by a spacing over the radius against the last
        turn = curvature * 0.05 * (np.arange(200) + 0.5)
        x = mesh.rest_positions.reshape(3, 201, 3).copy()
        x[:, 1:, 0] = x[:, :1, 0] + 0.05 * np.cumsum(np.cos(turn))
        x[:, 1:, 2] = 0.05 * np.cumsum(np.sin(turn))
        state.positions[0] = x.reshape(-1, 3)
        simulation.set_state(state)
        energies.append(simulation.energy().elastic[0])
        assert energies[-1] == pytest.approx(k * curvature**4 * 0.05**4 / 32 * (199 * 2 * 0.05**2), rel=2e-3)
    assert energies[0] / energies[1] == pytest.approx(16, rel=2e-3)


# --- strips against the elastica ------------------------------------------------------------------------------------------

TABLE = {  # G: X/L, Y/L, chord and tip [deg]
    0.5: (0.99778, 0.06231, 3.573, 4.763), 1: (0.99125, 0.12347, 7.100, 9.460), 2: (0.96689, 0.23851, 13.857, 18.426),
    4: (0.89011, 0.42516, 25.531, 33.724), 8: (0.72442, 0.64063, 41.487, 53.865), 15: (0.52957, 0.78604, 56.031, 70.750),
    30: (0.34276, 0.87309, 68.566, 82.972),
}  # fmt: skip


@pytest.mark.parametrize("gravity", TABLE)
def test_the_heavy_elastica_s_equation_gives_the_published_table(gravity):
    assert tuple(heavy_elastica(gravity)) == pytest.approx(TABLE[gravity], rel=2e-4)


@pytest.mark.parametrize("model", HINGED)
def test_a_strip_hangs_as_the_heavy_elastica(model):
    """Reach, droop, and angles of chord and end at G from 0.5 to 30, each a lane of its own: 2 % are asked for, and 30 spacings
    keep within half a percent.

    A hinge stands for the curvature of half a spacing on both sides: held by its first two columns, the strip is clamped midway
    between them.
    """
    columns, loads = 31, np.array(list(TABLE))
    length = 1.0
    a = length / (columns - 1.5)
    mesh = grid(2, columns, a * (columns - 1), a)
    # weight per area 1 N/m^2, and a hundredth of a percent of stretch under it
    material = Material(1 / G, 1e3, 4e2, 1 / loads[0], damping_time=0.0, air_drag=6.0 / G)
    simulation = Simulation(
        mesh, material, len(loads), bending=model, air_density=0, anchors=[0, 1, columns, columns + 1], dtype="float64", threads=1
    )
    simulation.set_parameters(bend_rigidity=1 / loads, warn=False)
    simulation.step(round(4 / simulation.time_step))
    x = simulation.positions[:, :columns]
    clamp = (x[:, 0] + x[:, 1]) / 2
    run = x[:, -1] - clamp
    for lane, load in enumerate(loads):
        truth = heavy_elastica(load)
        reach, droop = run[lane, 0], -run[lane, 2]
        last = x[lane, -1] - x[lane, -2]
        found = (reach, droop, np.degrees(np.arctan2(droop, reach)), np.degrees(np.arctan2(-last[2], last[0])))
        assert found == pytest.approx(tuple(truth), rel=5e-3)


@pytest.mark.parametrize("model", HINGED)
@pytest.mark.parametrize(("rows", "width"), [(3, 0.05), (3, 0.15), (7, 0.15)])
def test_a_pinned_strip_buckles_under_euler_s_load(model, rows, width):
    """pi^2 B/L^2 per width: the compression at which the flat state's stiffness across the plane loses its first eigenvalue,
    by central differences of the kernels' forces; narrow or wide, of square or oblong cells."""
    columns, length, young = 41, 1.0, 1e3
    mesh = grid(rows, columns, length, width)
    elements = element_arrays(mesh, np.dtype(np.float64), hinged=True, any_order=False)
    # threads along the strip only: their tension is all the load
    stiffness = np.zeros(NUM_KINDS)
    stiffness[STRUCTURAL_X] = young * mesh.spacing[1] / mesh.spacing[0]
    n, step = mesh.num_particles, 1e-7
    index = np.arange(n).reshape(rows, columns)
    free = np.setdiff1d(index, index[:, [0, -1]])

    def forces(x):
        """In one lane for each shift, (particles, 3, lanes)."""
        x, lanes = np.swapaxes(x, 0, 1).copy(), x.shape[2]
        f, zero = np.zeros_like(x), np.zeros_like(x)
        elastic = no_springs(lanes)._replace(stiffness=np.repeat(stiffness[:, None], lanes, axis=1))
        add_lane_forces(x, zero, f, elements, elastic, room(x))
        BENDING[model].kernels["add_bend_forces"](x, zero, f, elements, elastic, room(x))
        return np.swapaxes(f, 0, 1)

    def compressed(strain):
        return mesh.rest_positions * (1 - strain, 1, 1)

    def firmness(strain):
        shift = np.zeros((n, 3, len(free)))
        shift[free, 2, np.arange(len(free))] = step
        x = compressed(strain)[:, :, None]
        matrix = -(forces(x + shift) - forces(x - shift))[free, 2] / (2 * step)
        return np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]

    euler = np.pi**2 * B / length**2
    strain = brentq(firmness, 0.5 * euler / young, 1.5 * euler / young, rtol=1e-4)
    load = -forces(compressed(strain)[:, :, None])[index[:, 0], 0, 0].sum() / width
    assert load == pytest.approx(euler, rel=3e-3)

"""The sheet's topology, and the moduli that its springs give it, against counts and energies worked out by hand."""

import numpy as np
import pytest

from clothgym import Material, Simulation, grid
from clothgym.material import spring_stiffness
from clothgym.mesh import BEND_X, SHEAR, STRUCTURAL_X, STRUCTURAL_Y


def test_counts_of_a_17_by_17_sheet():
    mesh = grid(17, 17, 0.6, 0.6)
    assert mesh.num_particles == 289
    assert len(mesh.triangles) == 2 * 16 * 16
    counts = np.bincount(mesh.springs.kind)
    assert counts.tolist() == [17 * 16, 17 * 16, 0, 2 * 16 * 16, 17 * 15, 17 * 15]  # no edges: those are of triangle meshes


def test_25_by_25_has_3502_springs():
    assert len(grid(25, 25, 1, 1).springs.kind) == 3502


def test_areas_and_triangles_cover_the_sheet():
    mesh = grid(5, 8, 0.7, 0.4)
    assert mesh.area.sum() == pytest.approx(0.28, rel=1e-12)
    a, b, c = (mesh.rest_positions[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert np.all(normals[:, 2] > 0)
    assert normals[:, 2].sum() / 2 == pytest.approx(0.28, rel=1e-12)


def test_no_two_springs_of_a_color_share_a_particle():
    springs = grid(6, 7, 1, 1).springs.particles
    # colors are runs: a run ends where a particle comes back
    seen, runs = set(), 1
    for a, b in springs.tolist():
        if a in seen or b in seen:
            seen, runs = set(), runs + 1
        seen |= {a, b}
    assert runs <= 2 * 12  # greedy coloring of a graph of degree 12


def test_the_mesh_cannot_be_changed():
    mesh = grid(3, 3, 1, 1)
    with pytest.raises(ValueError):
        mesh.rest_positions[0, 0] = 1
    with pytest.raises(ValueError):
        mesh.springs.rest_length[0] = 1


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((1, 5, 1, 1), "rows"),
        ((5, 1, 1, 1), "cols"),
        ((5, 5, 0, 1), "width"),
        ((5, 5, 1, -2), "height"),
        ((5, 5, np.nan, 1), "width"),
        ((2.5, 5, 1, 1), "rows"),
    ],
)
def test_bad_sheets_are_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        grid(*arguments)


@pytest.mark.parametrize("shape", [(9, 9, 0.4, 0.4), (9, 13, 0.5, 0.4), (3, 4, 0.3, 0.25)])
def test_springs_have_the_fabric_s_moduli(shape):
    """Energy of a homogeneously strained sheet against plane elasticity: exact on the border too, at any grid."""
    mesh = grid(*shape)
    young, shear, tiny = 300.0, 90.0, 1e-4
    material = Material(stretch_stiffness=young, shear_stiffness=shear, bend_rigidity=0.0)
    simulation = Simulation(mesh, material, dtype="float64", substeps=1000)
    c11 = (young + np.sqrt(young**2 + 4 * shear**2)) / 2  # from Young's modulus = C11 - C12^2 / C11 with C12 = C66
    area = shape[2] * shape[3]
    for strain, stiffness in (
        (np.diag([1 + tiny, 1, 1]), c11),
        (np.diag([1, 1 + tiny, 1]), c11),
        (np.array([[1, tiny, 0], [0, 1, 0], [0, 0, 1]]), shear),
        # uniaxial stress: the sheet contracts across by Poisson's ratio C12 / C11, and answers with Young's modulus
        (np.diag([1 + tiny, 1 - tiny * shear / c11, 1]), young),
    ):
        simulation.reset(positions=mesh.rest_positions @ strain.T)
        assert simulation.energy().elastic[0] == pytest.approx(stiffness * tiny**2 * area / 2, rel=1e-3)


def test_bend_springs_store_the_plate_s_energy_at_two_spacings():
    """Structural springs at rest, each turned by a spacing over the radius against the next: B kappa^2 / 2 an area."""
    mesh = grid(41, 3, 0.1, 2.0)
    rigidity, spacing = 1e-4, 0.05
    k = spring_stiffness(mesh, np.array(300.0), np.array(0.0), np.array(rigidity))
    radius = 2 * spacing
    chord = 2 * spacing * np.cos(spacing / radius / 2)  # between next but one neighbors
    energy = k[BEND_X + 1] * (2 * spacing - chord) ** 2 / 2 / (spacing * 0.05)
    assert energy == pytest.approx(rigidity / radius**2 / 2, rel=0.03)


def test_square_cells_follow_the_published_formula():
    """k_s + k_d + 4 k_b = C11, k_d = C66 on square cells."""
    mesh = grid(5, 5, 1, 1)
    k = spring_stiffness(mesh, np.array(261.0), np.array(105.0), np.array(0.01))
    c11 = k[STRUCTURAL_X] + k[SHEAR] + 4 * k[BEND_X]
    assert k[SHEAR] == pytest.approx(105.0)
    assert c11 - k[SHEAR] ** 2 / c11 == pytest.approx(261.0)
    assert k[STRUCTURAL_X] == pytest.approx(k[STRUCTURAL_Y])


def test_impossible_moduli_are_refused_with_a_remedy():
    with pytest.raises(ValueError, match="more nearly square"):
        Simulation(grid(5, 21, 0.1, 1.0), Material(stretch_stiffness=10.0, shear_stiffness=1000.0))


@pytest.mark.parametrize(
    "field", ["density", "stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time", "drag_coefficient", "air_drag"]
)
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_bad_material_properties_are_named(field, value):
    with pytest.raises(ValueError, match=field):
        Material(**{field: value})


def test_unknown_preset_lists_the_known():
    with pytest.raises(ValueError, match="cotton"):
        Material.preset("coton")
    assert Material.preset("cotton", density=0.2).density == 0.2


def test_cotton_has_the_mass_and_stiffness_of_its_source():
    cotton = Material.preset("penava_cotton")
    thickness, modulus, poisson = 0.318e-3, 0.821e6, 0.243
    assert cotton.density == pytest.approx(472.64 * thickness, rel=1e-3)
    assert cotton.stretch_stiffness == pytest.approx(modulus * thickness, rel=1e-3)
    assert cotton.shear_stiffness == pytest.approx(modulus * thickness / 2 / (1 + poisson), rel=1e-2)
    assert cotton.bend_rigidity == pytest.approx(modulus * thickness**3 / 12 / (1 - poisson**2), rel=1e-2)
    assert cotton.source

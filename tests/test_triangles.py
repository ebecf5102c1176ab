"""Sheets of triangles: from files in several formats, refused ones, the disc, and every integrator on a loaded sheet."""

import sys

import numpy as np
import pytest

from clothgym import INTEGRATORS, Gripper, Material, Plane, Simulation, disc, load_mesh, triangle_mesh
from clothgym.mesh import EDGE
from clothgym.render import Camera, Renderer

G = 9.81
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
PAIR = np.array([[0, 1, 2], [1, 3, 2]])
FABRIC = Material(density=0.2, stretch_stiffness=50.0, shear_stiffness=19.0, bend_rigidity=1e-5, damping_time=1e-3)
CYLINDER = 0.1  # radius [m]


def write(path, x, triangles):
    """A mesh file by hand, in the format that its name says; stl repeats the vertices of every triangle."""
    rows = [" ".join(map(repr, row)) for row in np.asarray(x).tolist()]
    faces = np.asarray(triangles)
    if path.suffix == ".obj":
        lines = [f"v {row}" for row in rows] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    elif path.suffix == ".off":
        lines = ["OFF", f"{len(rows)} {len(faces)} 0", *rows, *(f"3 {a} {b} {c}" for a, b, c in faces)]
    elif path.suffix == ".ply":
        lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property double {axis}" for axis in "xyz")]
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", *rows]
        lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    else:
        lines = ["solid sheet"]
        for face in faces:
            lines += ["facet normal 0 0 1", "outer loop", *(f"vertex {rows[p]}" for p in face), "endloop", "endfacet"]
        lines += ["endsolid sheet"]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def loaded(tmp_path):
    """A disc of 10 cm radius that has been through a file."""
    mesh = disc(0.1, 3)
    return load_mesh(write(tmp_path / "disc.obj", mesh.rest_positions, mesh.triangles))


def cylinder(columns=9, rows=5, angle=1.2):
    """Part of a cylinder's wall as triangles: its flat panels meet at ``angle/(columns - 1)``."""
    across, along = np.meshgrid(np.linspace(-angle / 2, angle / 2, columns), np.arange(rows) * 0.015, indexing="xy")
    x = np.stack([CYLINDER * np.sin(across), along, CYLINDER * np.cos(across)], axis=-1).reshape(-1, 3)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return triangle_mesh(x, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]))


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off"])
def test_every_format_gives_the_same_sheet(tmp_path, suffix):
    """Counts and area of the disc that was written, pi R^2 of its polygon; places in the file's order, but for stl's."""
    mesh = disc(0.1, 3)
    read = load_mesh(write(tmp_path / f"disc.{suffix}", mesh.rest_positions, mesh.triangles))
    assert (read.num_particles, len(read.triangles), len(read.springs.kind)) == (37, 54, len(mesh.springs.kind))
    assert read.area.sum() == pytest.approx(9 * 0.1**2 * np.sin(np.pi / 9), rel=1e-6)
    assert read.shape is None
    if suffix != "stl":
        np.testing.assert_allclose(read.rest_positions, mesh.rest_positions, atol=1e-7)
        np.testing.assert_array_equal(read.triangles, mesh.triangles)


def test_vertices_at_one_place_are_one_particle(tmp_path):
    """Two triangles that share an edge by place, not by number: a seam of the texture does not cut the cloth."""
    apart = write(tmp_path / "seam.obj", SQUARE[[0, 1, 2, 1, 3, 2]], [[0, 1, 2], [3, 4, 5]])
    mesh = load_mesh(apart)
    assert mesh.num_particles == 4 and len(mesh.hinges.weight) == 1


ABOVE = np.vstack([SQUARE, [[0.0, 0.0, 1.0]]])
NOWHERE = SQUARE + np.array([[0.0], [0.0], [0.0], [np.nan]])
REFUSED = {
    "an edge of three": (".obj", ABOVE, [[0, 1, 2], [1, 0, 3], [0, 1, 4]], "edge 1-2, from .* belongs to 3 triangles.*remove"),
    "not a number": (".obj", NOWHERE, PAIR, "vertex 4 is at .*nan.*finite position"),
    "infinite": (".ply", np.where(SQUARE == 1, np.inf, SQUARE), PAIR, "vertex 1 is at .*inf.*finite position"),
    "out of range": (".ply", SQUARE, [[0, 1, 2], [1, 9, 2]], r"triangle 1 is \[1, 9, 2\].*0 to 3"),
    "out of range in obj": (".obj", SQUARE, [[0, 1, 2], [1, 9, 2]], r"triangle 2 is \[2, 10, 3\].*1 to 4"),
    "points only": (".ply", SQUARE, np.zeros((0, 3), int), "holds no triangles.*export the sheet"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_invalid_sheets_are_refused_with_a_remedy(tmp_path, case):
    suffix, x, triangles, message = REFUSED[case]
    path = write(tmp_path / f"sheet{suffix}", x, triangles)
    with pytest.raises(ValueError, match=message) as refusal:
        load_mesh(path)
    assert path.name in str(refusal.value)


@pytest.mark.parametrize("name", ["text.obj", "text.ply", "text.stl", "text.off", "text.glb", "text.xyzzy", "text"])
@pytest.mark.parametrize("content", ["", "hello world\n"])
def test_invalid_mesh_files_are_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=f"{name}.*(cannot be read|holds no triangles).*export the sheet as a triangle mesh"):
        load_mesh(path)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.obj.*no such file.*check the path"):
        load_mesh(tmp_path / "gone.obj")
    with pytest.raises(ValueError, match="folder.*name a file"):
        load_mesh(tmp_path)


def test_without_trimesh_the_extra_is_named_where_it_is_needed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"pip install 'clothgym\[mesh\]', or take obj, off or ply"):
        load_mesh(write(tmp_path / "sheet.stl", SQUARE, PAIR))
    for suffix in ("obj", "off", "ply"):
        assert load_mesh(write(tmp_path / f"sheet.{suffix}", SQUARE, PAIR)).num_particles == 4


@pytest.mark.parametrize(
    ("x", "triangles", "message"),
    [
        (np.vstack([SQUARE, [[2.0, 0.0, 0.0]]]), [*PAIR, [0, 1, 4]], r"triangle 2, \[0, 1, 4\].*remove it"),
        (SQUARE, [[0, 1, 2], [0, 1, 2], [1, 3, 2]], r"\[0, 1, 2\] is there 2 times.*remove"),
        (SQUARE, [[0, 1, 2], [1, 2, 3]], "edge 1-2 have opposite orientations: flip one"),
        (ABOVE, [[0, 1, 2], [1, 0, 3], [0, 1, 4]], "edge 0-1 belongs to 3 triangles.*remove"),
        (np.vstack([SQUARE, [[9.0, 9.0, 9.0]]]), PAIR, "vertex 4 belongs to no triangle.*remove it"),
        (SQUARE[:, :2], PAIR, r"shape \(4, 2\).*\(particles, 3\)"),
        (SQUARE, PAIR.astype(float), "float64.*integers"),
        (SQUARE, [[0, 1, -1]], r"\[0, 1, -1\].*0 to 3"),
        (SQUARE, [], r"must be \(triangles, 3\)"),
    ],
)
def test_arrays_that_are_no_triangles_are_refused(x, triangles, message):
    with pytest.raises(ValueError, match=message):
        triangle_mesh(x, triangles)


@pytest.mark.parametrize("rings", [1, 4, 9])
def test_disc_has_its_counts_and_area(rings):
    """1 + 3 n (n + 1) particles, 6 n^2 triangles, Euler's number of edges, all facing up; the area of a polygon of 6 n sides."""
    mesh = disc(0.2, rings)
    particles, triangles = 1 + 3 * rings * (rings + 1), 6 * rings**2
    assert (mesh.num_particles, len(mesh.triangles)) == (particles, triangles)
    assert np.sum(mesh.springs.kind == EDGE) == particles + triangles - 1
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)
    assert mesh.area.sum() == pytest.approx(3 * rings * 0.2**2 * np.sin(np.pi / (3 * rings)), rel=1e-12)


@pytest.mark.parametrize("arguments", [(0.0, 3), (np.nan, 3), (0.1, 0), (0.1, 2.5)])
def test_disc_names_the_wrong_argument(arguments):
    with pytest.raises(ValueError, match="radius=|rings="):
        disc(*arguments)


@pytest.mark.parametrize(("axis", "other"), [(0, 1), (1, 0)])
def test_equilateral_triangles_have_the_young_modulus_and_poisson_ratio_one_third(axis, other):
    """Van Gelder 1998: strain e stores E t e^2/(2 (1 - nu^2)) an area across, and nu times the cross term; small strains."""
    rows, columns, a = 9, 9, 0.01
    r, c = np.divmod(np.arange(rows * columns), columns)
    x = np.stack([a * (c + r / 2), a * np.sqrt(0.75) * r, 0.0 * r], axis=1)
    i = np.arange(rows * columns).reshape(rows, columns)
    p, q, s, t = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    mesh = triangle_mesh(x, np.concatenate([np.stack([p, q, s], 1), np.stack([q, t, s], 1)]))
    simulation = Simulation(mesh, FABRIC, dtype="float64", bending="hinge", gravity=(0, 0, 0))

    def stored(e_axis, e_other):
        y = x.copy()
        y[:, axis] *= 1 + e_axis
        y[:, other] *= 1 + e_other
        simulation.reset(positions=y)
        return simulation.energy().elastic[0] / mesh.area.sum()

    e = 1e-6
    plate = FABRIC.stretch_stiffness / (1 - 1 / 9)
    assert stored(e, 0) == pytest.approx(plate * e * e / 2, rel=1e-4)
    assert stored(e, e) - stored(e, 0) - stored(0, e) == pytest.approx(plate / 3 * e * e, rel=1e-4)


def free_sheet(mesh, integrator, bending, **options):
    """A loaded sheet, a little crumpled, with nothing to hold it."""
    s = Simulation(
        mesh,
        FABRIC,
        integrator=integrator,
        bending=bending,
        dtype="float64",
        air_density=0,
        time_step=1 / 120,
        substeps=8,
        **options,
    )
    random = np.random.default_rng(0)
    s.reset(positions=mesh.rest_positions + random.normal(scale=1e-4, size=mesh.rest_positions.shape), velocities=(0.3, -0.2, 0.1))
    return s


CASES = [(name, "springs") for name in INTEGRATORS]
CASES += [(name, "hinge") for name in ("verlet", "implicit_euler", "xpbd")]
CASES += [(name, "quadratic") for name in ("semi_implicit_euler", "projective_dynamics")]


@pytest.mark.parametrize(("integrator", "bending"), CASES)
@pytest.mark.filterwarnings("ignore:.*too few for:UserWarning")
def test_a_loaded_sheet_falls_as_all_things_do(loaded, integrator, bending):
    """Momentum m (v + g t) to rounding; the center v t + g t^2/2, or a first-order method's g t (t + h)/2, or between."""
    s = free_sheet(loaded, integrator, bending)
    mass = 1 / s.get_state().free_inverse_mass[0]
    center = mass @ s.positions[0] / mass.sum()
    s.step(6)
    t, h = 6 / 120, 1 / 960
    fallen = mass @ s.positions[0] / mass.sum() - center
    np.testing.assert_allclose(mass @ s.velocities[0] / mass.sum(), (0.3, -0.2, 0.1 - G * t), atol=1e-9)
    np.testing.assert_allclose(fallen[:2], (0.3 * t, -0.2 * t), atol=1e-9)
    assert abs(fallen[2] - (0.1 * t - G * t * t / 2)) <= G * t * h / 2 + 1e-9
    assert np.abs(s.strain()).max() < 0.1
    assert not s.diverged.any()


def test_everything_that_a_grid_can_do_a_loaded_sheet_can(loaded):
    """Anchors and a gripper hold, wind blows to leeward, strain is limited, the floor holds, state goes on bit for bit."""
    s = Simulation(
        loaded,
        FABRIC,
        num_envs=2,
        anchors=[0],
        grippers=[Gripper(position=tuple(loaded.rest_positions[-1] + [0, 0, 0.2]), reach=0.01, closing_time=1 / 60)],
        colliders=[Plane(point=(0, 0, 0.12))],
        wind=(3.0, 0.0, 0.0),
        strain_limit=0.1,
        time_step=1 / 60,
    )
    s.reset(positions=loaded.rest_positions + (0, 0, 0.2))
    s.grippers.move(s.grippers.positions, openings=[[0.0], [1.0]])  # one closes, the other stays open
    s.step(20)
    x = s.positions
    np.testing.assert_allclose(x[:, 0], np.tile(loaded.rest_positions[0] + [0, 0, 0.2], (2, 1)), atol=1e-6)
    assert s.grippers.held[:, 0].tolist() == [1, 0]
    assert np.linalg.norm(x[0, -1] - loaded.rest_positions[-1] - [0, 0, 0.2]) < 0.02 < np.linalg.norm(x[0, -1] - x[1, -1])
    assert x[1].mean(axis=0)[0] > 1e-3
    assert x[:, :, 2].min() > 0.12 and s.contacts().distance.min() > -1e-6
    assert s.strain().max() < 0.106
    energy = s.energy()
    assert np.all(np.isfinite(energy.total)) and np.all(energy.elastic > 0)

    state = s.get_state()
    s.step(5)
    after = s.positions
    s.set_state(state)
    s.step(5)
    np.testing.assert_array_equal(s.positions, after)

    camera = Camera((0.0, -0.6, 0.4), (0.0, 0.0, 0.15))
    draw = Renderer(loaded.triangles, loaded.rest_positions[:, :2], camera, 60, 60).rgb
    assert np.abs(draw(after[0]).astype(int) - draw(after[0] + (0, 0, 5))).max() > 50


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "implicit_euler"])
def test_a_bent_sheet_rests_at_its_angles(integrator):
    """Panels of a cylinder meet at angle/(columns - 1); left alone the sheet stays, flattened it springs back."""
    mesh = cylinder()
    bent = mesh.hinges.rest_angle[np.abs(mesh.hinges.rest_angle) > 1e-6]
    np.testing.assert_allclose(np.abs(bent), 1.2 / 8, rtol=1e-6)
    assert len(np.unique(np.sign(bent))) == 1
    fabric = Material(density=0.2, stretch_stiffness=50.0, shear_stiffness=19.0, bend_rigidity=1e-3, air_drag=4.0)
    s = Simulation(mesh, fabric, integrator=integrator, bending="hinge", gravity=(0, 0, 0), air_density=0, dtype="float64")
    s.step(5)
    np.testing.assert_allclose(s.positions[0], mesh.rest_positions, atol=1e-12)
    assert s.energy().elastic[0] < 1e-20
    flat = mesh.rest_positions.copy()
    flat[:, 0], flat[:, 2] = CYLINDER * np.arctan2(flat[:, 0], flat[:, 2]), CYLINDER
    s.reset(positions=flat)
    before = s.energy().elastic[0]
    assert before == pytest.approx(fabric.bend_rigidity / 2 * np.sum(mesh.hinges.weight * mesh.hinges.rest_angle**2), rel=0.05)
    s.step(120)
    assert s.energy().elastic[0] < 1e-3 * before


def test_a_bent_sheet_is_refused_by_the_flat_model_with_the_remedy():
    with pytest.raises(ValueError, match=r"flat at rest.*0\.15 rad.*bending='hinge'"):
        Simulation(cylinder(), FABRIC, bending="quadratic")

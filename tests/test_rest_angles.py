"""Sheets that are not flat at rest: the bending model that is chosen for them, and angles at rest that are changed."""

import inspect
import warnings

import numpy as np
import pytest

import clothgym
from clothgym import Material, Simulation, disc, grid, load_mesh, triangle_mesh
from clothgym.envs.physics import Physics

FOLD = 1.1  # angle between the two halves of a folded sheet [rad]
STIFF = Material(density=0.2, stretch_stiffness=50.0, shear_stiffness=19.0, bend_rigidity=1e-3, damping_time=1e-3, air_drag=4.0)


def folded(angle=FOLD, columns=3, rows=5):
    """A sheet of 8 x 8 cm, folded along its middle line x = 0 by this angle."""
    side = np.arange(-columns + 1, columns) * 0.04 / (columns - 1)
    s, y = (q.ravel() for q in np.meshgrid(side, np.arange(rows) * 0.02))
    x = np.stack([s * np.cos(angle / 2), y, np.abs(s) * np.sin(angle / 2)], axis=1)
    i = np.arange(len(x)).reshape(rows, 2 * columns - 1)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return x, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def crease(mesh):
    """Ends of the edges on the line x = 0 that lie along it, (edges, 2)."""
    ends = mesh.hinges.particles[:, :2]
    return ends[np.all(np.abs(mesh.rest_positions[ends][:, :, 0]) < 1e-9, axis=1)]


def angle_of(x):
    """The angle between the halves of a sheet of ``folded``, from its outer columns and its middle one [rad]."""
    x = np.asarray(x, float).reshape(5, 5, 3)
    left, right = (x[:, k] - x[:, 2] for k in (0, 4))
    along = np.sum(left * right, axis=1) / np.linalg.norm(left, axis=1) / np.linalg.norm(right, axis=1)
    return float(np.mean(np.pi - np.arccos(np.clip(along, -1, 1))))


@pytest.mark.parametrize("angle", [0.01, FOLD, -2.5])
def test_hinges_are_chosen_for_a_sheet_that_is_not_flat_with_a_word(angle):
    mesh = triangle_mesh(*folded(angle))
    with pytest.warns(
        UserWarning, match=rf"not flat at rest \(angles up to {abs(angle):.3g} rad\): bending='hinge' is chosen"
    ) as said:
        simulation, line = Simulation(mesh, STIFF), inspect.currentframe().f_lineno
    assert simulation.bending.name == "hinge" and not mesh.flat
    assert [(w.filename, w.lineno) for w in said] == [(__file__, line)]


@pytest.mark.parametrize("make", [lambda: grid(5, 5, 0.1, 0.1), lambda: disc(0.1, 3), lambda: triangle_mesh(*folded(2e-4))])
def test_flat_sheets_keep_their_springs_without_a_word(make):
    """Angles of rounding, as a file of six digits has them, are none; such a sheet can have the quadratic model."""
    assert Simulation(make()).bending.name == "springs" and make().flat
    assert Simulation(make(), bending="quadratic").bending.name == "quadratic"


@pytest.mark.parametrize("name", ["springs", "hinge"])
def test_a_model_that_is_named_is_taken(name):
    assert Simulation(triangle_mesh(*folded()), STIFF, bending=name).bending.name == name


def test_the_flat_model_by_name_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"flat at rest.*1\.1 rad.*bending='hinge'"):
        Simulation(triangle_mesh(*folded()), STIFF, bending="quadratic")
    with pytest.raises(ValueError, match=r"no bending model 'hinges'; did you mean 'hinge'\? \(there are: auto, springs"):
        Simulation(grid(3, 3, 0.1, 0.1), bending="hinges")


def test_a_task_s_sheet_that_is_not_flat_has_hinges():
    """Its default is the quadratic model, and skip springs with physics="fast"."""
    mesh = triangle_mesh(*folded())
    with pytest.warns(UserWarning, match="bending='hinge' is chosen in place of 'quadratic'") as said:
        physics = Physics(mesh, STIFF, 1 / 60, "semi_implicit_euler", "auto", 0.5)
    assert physics.bending == "hinge" and said[0].filename == __file__
    with pytest.warns(UserWarning, match="bending='hinge' is chosen in place of 'springs'"):
        assert physics.chosen("fast").bending == "hinge"
    assert Physics(disc(0.1, 3), STIFF, 1 / 60, "semi_implicit_euler", "auto", 0.5).bending == "quadratic"


def test_angles_at_rest_are_those_that_were_asked_for():
    """Of all edges, of some by their ends in either order, of those that are sharper than an angle; nothing else changes."""
    mesh = triangle_mesh(*folded())
    named = crease(mesh)
    assert len(named) == 4 and np.sum(np.abs(mesh.hinges.rest_angle) > 1e-6) == 4
    for flat in (mesh.with_rest_angles(), mesh.with_rest_angles(0.0, edges=named[:, ::-1]), mesh.with_rest_angles(above=0.5)):
        assert flat.flat and not mesh.flat
        assert np.array_equal(flat.rest_positions, mesh.rest_positions) and np.array_equal(flat.hinges.slopes, mesh.hinges.slopes)
    part = mesh.with_rest_angles(-0.3, edges=named[:1])
    assert np.sum(np.isclose(part.hinges.rest_angle, -0.3)) == 1 and np.sum(np.isclose(np.abs(part.hinges.rest_angle), FOLD)) == 3
    assert mesh.with_rest_angles(above=2.0).hinges.rest_angle.tolist() == mesh.hinges.rest_angle.tolist()


@pytest.mark.parametrize("angle", [0.0, 0.6, -FOLD])
def test_skip_springs_get_the_length_of_their_angle(angle):
    """Those of the sheet that was made with this angle: lengths and weights, spring by spring."""
    other, mesh = triangle_mesh(*folded(angle)), triangle_mesh(*folded())
    sign = np.sign(mesh.hinges.rest_angle[np.argmax(np.abs(mesh.hinges.rest_angle))])
    changed = mesh.with_rest_angles(sign * angle, edges=crease(mesh))
    np.testing.assert_array_equal(changed.springs.particles, other.springs.particles)
    np.testing.assert_allclose(changed.springs.rest_length, other.springs.rest_length, rtol=1e-12)
    np.testing.assert_allclose(changed.springs.weight, other.springs.weight, rtol=1e-12)
    np.testing.assert_allclose(changed.hinges.rest_angle, other.hinges.rest_angle, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"angle": 4.0}, "angle=4.0: must be from -pi to pi"),
        ({"angle": np.nan}, "angle=nan"),
        ({"edges": [[0, 24]]}, "edges: 0-24 is no edge between two triangles"),
        ({"edges": [[0, 99]]}, "edges="),
        ({"edges": [0, 1, 2]}, "must be pairs of particles"),
        ({"above": -1}, "above=-1"),
    ],
)
def test_angles_and_edges_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        triangle_mesh(*folded()).with_rest_angles(**arguments)


@pytest.mark.parametrize("bending", ["hinge", "quadratic", "springs"])
def test_a_folded_file_unfolds(tmp_path, bending):
    """Left alone it opens from its angle to 0; with the file's angles at rest it stays."""
    x, triangles = folded()
    path = tmp_path / "folded.obj"
    rows = [f"v {' '.join(map(repr, p))}" for p in x.tolist()] + [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    path.write_text("\n".join(rows) + "\n")
    mesh = load_mesh(path)
    options = {"gravity": (0, 0, 0), "air_density": 0, "time_step": 1 / 60}
    opened = Simulation(mesh.with_rest_angles(0.0), STIFF, bending=bending, **options)
    assert angle_of(opened.positions) == pytest.approx(FOLD)
    opened.step(240)
    # skip springs hardly resist small angles
    assert angle_of(opened.positions) < (0.35 if bending == "springs" else 0.03)
    assert np.abs(opened.strain()).max() < 0.01
    if bending != "quadratic":
        kept = Simulation(mesh, STIFF, bending=bending, **options)
        kept.step(60)
        assert angle_of(kept.positions) == pytest.approx(FOLD, abs=1e-4)


def test_a_grid_folds_to_its_angle_at_rest():
    """Its hinges along the middle column, at 0.6 rad; skip springs of a grid stay, and are not used with hinges."""
    mesh = grid(5, 5, 0.08, 0.08)
    middle = np.arange(5) * 5 + 2
    bent = mesh.with_rest_angles(0.6, edges=np.stack([middle[:-1], middle[1:]], axis=1))
    assert not bent.flat and bent.shape == (5, 5) and np.sum(bent.hinges.rest_angle == 0.6) == 8
    simulation = Simulation(bent, STIFF, bending="hinge", gravity=(0, 0, 0), air_density=0)
    simulation.step(240)
    assert angle_of(simulation.positions) == pytest.approx(0.6, abs=0.03)


def test_the_names_are_public():
    assert "with_rest_angles" in dir(clothgym.ClothMesh) and "flat" in dir(clothgym.ClothMesh)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert clothgym.grid(3, 3, 0.1, 0.1).flat

"""What cannot be represented is said: walls thinner than a grid's cells, many anchors, tiny edges, fine grids, places far away."""

import inspect
import re
import warnings

import numpy as np
import pytest
from solids import ON_ITS_CORNER, bowl, box_mesh, rectilinear, rotation

from clothgym import Material, MeshCollider, Simulation, disc, grid, triangle_mesh

# --- walls of solids ------------------------------------------------------------------------------------------------------


def plate(thickness, turn=None):
    vertices, triangles = box_mesh((0.5, 0.3, thickness / 2))
    return (vertices if turn is None else vertices @ rotation(*turn).T), triangles


def angle(thickness):
    """An L: a thick floor and a thin wall on it."""
    filled = np.ones((2, 1, 2), bool)
    filled[1, 0, 1] = False
    return rectilinear(filled, [0, thickness, 1], [0, 0.6], [0, 0.25, 1])


def hollow(thickness):
    """A closed box around a cavity."""
    (x, triangles), (y, inner) = box_mesh((0.5, 0.5, 0.5)), box_mesh((0.5 - thickness,) * 3)
    return np.concatenate([x, y]), np.concatenate([triangles, inner[:, ::-1] + 8])


def rod(radius):
    """Eight sides around x."""
    turn = np.arange(8) * np.pi / 4
    ring = np.stack([0 * turn, radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    x = np.concatenate([ring - (0.5, 0, 0), ring + (0.5, 0, 0), [(-0.5, 0, 0), (0.5, 0, 0)]])
    k, after = np.arange(8), (np.arange(8) + 1) % 8
    sides = np.concatenate([np.stack([k, after, 8 + k], 1), np.stack([after, 8 + after, 8 + k], 1)])
    ends = np.concatenate([np.stack([after, k, 0 * k + 16], 1), np.stack([8 + k, 8 + after, 0 * k + 17], 1)])
    triangles = np.concatenate([sides, ends])
    return x, triangles


def cone(radius, around=16):
    turn = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=1)
    k, after = np.arange(around), (np.arange(around) + 1) % around
    x = np.concatenate([ring, [(0, 0, 0), (0, 0, 1)]])
    return x, np.concatenate([np.stack([after, k, 0 * k + around], 1), np.stack([k, after, 0 * k + around + 1], 1)])


def wedge(degrees):
    """A ramp of a meter that ends in an edge."""
    h = np.tan(np.radians(degrees))
    x = np.array([(0, 0, 0), (1, 0, 0), (1, 0, h), (0, 0.4, 0), (1, 0.4, 0), (1, 0.4, h)])
    return x, np.array([(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (0, 2, 5), (0, 5, 3), (1, 4, 5), (1, 5, 2)])


# name: mesh, resolution, thickness of what is lost [m], a place half way through it
LOST = {
    "a plate": (plate(0.02), 40, 0.02, (0.1, 0.1, 0)),
    "a plate of one cell": (plate(0.025), 40, 0.025, (0.1, 0.1, 0)),
    "a film": (plate(0.004), 40, 0.004, (0.1, 0.1, 0)),
    "a plate on its corner": (plate(0.015, ON_ITS_CORNER), 40, 0.015, (0, 0, 0)),
    "the wall of an L": (angle(0.015), 40, 0.015, (0.0075, 0.3, 0.6)),
    "a closed box": (hollow(0.018), 32, 0.018, (0.491, 0.1, 0.1)),
    "a rod": (rod(0.015), 40, 0.03 * np.cos(np.pi / 8), (0, 0, 0)),
    "a thin bowl": (bowl(0.5, 0.48), 40, 0.02, None),
    "all of a box": (box_mesh((0.1, 0.1, 0.1)), 1, 0.2, (0, 0, 0)),
}


@pytest.mark.parametrize("case", LOST)
def test_walls_that_a_grid_would_lose_are_refused_with_the_resolution_that_holds_them(case):
    """At the resolution that is named the solid is there: half way through the wall the distance is minus half its thickness."""
    (vertices, triangles), resolution, thickness, place = LOST[case]
    with pytest.raises(ValueError, match=rf"resolution={resolution}: its cells of .* lose walls that are") as refusal:
        MeshCollider(vertices=vertices, triangles=triangles, resolution=resolution)
    said = re.search(r"walls that are ([\d.]+) m thick.*give resolution=(\d+)", str(refusal.value))
    assert float(said[1]) == pytest.approx(thickness, rel=0.08)
    enough = MeshCollider(vertices=vertices, triangles=triangles, resolution=int(said[2]), thickness=0)
    cell = np.ptp(vertices, axis=0).max() / int(said[2])
    assert 1.9 * cell <= thickness < 2.2 * cell
    if place is not None:
        simulation = Simulation(grid(2, 2, 0.1, 0.1), colliders=[enough])
        x = simulation.mesh.rest_positions
        simulation.reset(positions=x - x[0] + place)
        assert simulation.contacts().distance[0, 0] == pytest.approx(-thickness / 2, abs=0.5 * cell)


HELD = {
    "a plate of two cells": (plate(0.05), 40),
    "a plate of two cells on its corner": (plate(0.05, ON_ITS_CORNER), 40),
    "the wall of an L": (angle(0.05), 40),
    "a closed box": (hollow(0.0625), 32),
    "a cone": (cone(0.4), 40),
    "a slender cone": (cone(0.15), 40),
    "a ramp": (wedge(20), 40),
    "a coarse box": (box_mesh((0.1, 0.1, 0.1)), 2),
}


@pytest.mark.parametrize("case", HELD)
def test_solids_that_the_grid_resolves_are_accepted(case):
    """Tips and edges, too, which are rounded by a few cells."""
    (vertices, triangles), resolution = HELD[case]
    MeshCollider(vertices=vertices, triangles=triangles, resolution=resolution)


def test_a_wall_for_which_no_grid_is_fine_enough_is_told_so():
    vertices, triangles = hollow(1e-4)
    with pytest.raises(ValueError, match=r"1e-04|0\.0001 m thick.*more than 2e\+07: make the walls thicker, or make the solid of"):
        MeshCollider(vertices=vertices, triangles=triangles, resolution=16)


# --- anchors --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*too few for:UserWarning")
def test_more_anchors_than_a_small_integer_counts_all_hold():
    mesh = grid(182, 182, 1.0, 1.0)
    simulation = Simulation(mesh, Material(bend_rigidity=1e-9), anchors=range(mesh.num_particles), substeps=400)
    state = simulation.get_state()
    assert mesh.num_particles > 2**15 and simulation.attached.all()
    assert np.array_equal(state.holder[0], np.arange(mesh.num_particles))
    simulation.release()
    assert not simulation.attached.any()
    simulation.set_state(state)
    assert simulation.attached.all()


def test_a_state_with_small_integer_holders_is_accepted():
    simulation = Simulation(grid(3, 3, 0.1, 0.1), anchors=[0, 8])
    state = simulation.get_state()
    state.holder = state.holder.astype(np.int16)
    simulation.set_state(state)
    assert simulation.attached.all()


# --- what one edge costs ----------------------------------------------------------------------------------------------------


def tiny_edge(length):
    """A sheet of triangles with edges of 6 cm, but one."""
    flat = grid(11, 11, 0.6, 0.6)
    x = flat.rest_positions.copy()
    x[61] = x[60] + [length * np.cos(0.3), length * np.sin(0.3), 0]
    return triangle_mesh(x, flat.triangles)


@pytest.mark.parametrize(
    ("length", "integrator", "bending"),
    [
        (1e-5, "semi_implicit_euler", "springs"),
        (1e-4, "semi_implicit_euler", "hinge"),
        (1e-4, "verlet", "quadratic"),
        (1e-5, "xpbd", "springs"),
    ],
)
def test_an_edge_that_costs_many_substeps_is_named(length, integrator, bending):
    """The edge, what it costs, and what would do without it: at most what the same sheet needs without such an edge."""
    usual = Simulation(triangle_mesh(*(lambda m: (m.rest_positions, m.triangles))(grid(11, 11, 0.6, 0.6))), integrator=integrator,
                       bending=bending).substeps  # fmt: skip
    with pytest.warns(UserWarning, match="edge 60-61 of the mesh") as said:
        simulation, line = Simulation(tiny_edge(length), integrator=integrator, bending=bending), inspect.currentframe().f_lineno
    assert len(said) == 1 and (said[0].filename, said[0].lineno) == (__file__, line)
    found = re.search(r"needs (\d+) substeps in a control step, where (\d+) would do", str(said[0].message))
    assert int(found[1]) == simulation.substeps > 10 * int(found[2]) and int(found[2]) <= 1.2 * usual
    assert f"{length:.3g} m long" in str(said[0].message) and "join its ends" in str(said[0].message)


def test_an_edge_that_costs_too_many_is_named_in_the_refusal():
    with pytest.raises(
        ValueError, match=r"needs \d+ substeps .* without edge 60-61 of the mesh, 2e-07 m long.*the most are 100000"
    ):
        Simulation(tiny_edge(2e-7))


def test_meshes_of_uneven_edges_are_no_news():
    """A disc, and a grid whose columns are up to five times as far apart as others."""
    flat = grid(9, 9, 1.0, 1.0)
    x = flat.rest_positions.copy()
    x[:, 0] = np.sign(x[:, 0]) * np.abs(2 * x[:, 0]) ** 1.5
    for mesh in (disc(0.1, 4), triangle_mesh(x, flat.triangles)):
        assert Simulation(mesh).substeps > 1


@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")
def test_masses_beyond_the_numbers_are_refused():
    with pytest.raises(ValueError, match=r"particle 0 stands for .* m\^2: its mass, or one over it, is beyond float32"):
        Simulation(grid(3, 3, 1e25, 1e25))


# --- fine grids -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cells", [1.0, 1.25, 0.8])
def test_a_grid_too_fine_for_skip_springs_names_an_alternative(cells):
    """Hinges, and the largest rigidity that springs can have there: both are taken, and a little more rigidity is not."""
    mesh, cotton = grid(12, 12, 0.03, 0.03 * cells), Material.preset("cotton")
    with pytest.raises(ValueError, match="bending='hinge' or 'quadratic'") as refusal:
        Simulation(mesh, cotton, substeps=100_000)
    most = float(re.search(r"lower the rigidity to ([\d.e-]+) N m", str(refusal.value))[1])
    for model in ("hinge", "quadratic"):
        assert Simulation(mesh, cotton, bending=model).substeps > 1
    properties = {name: getattr(cotton, name) for name in ("density", "stretch_stiffness", "shear_stiffness")}
    assert Simulation(mesh, Material(**properties, bend_rigidity=0.99 * most)).substeps > 1
    with pytest.raises(ValueError, match="no springs on cells"):
        Simulation(mesh, Material(**properties, bend_rigidity=1.01 * most))


def test_hinges_are_not_named_where_they_do_not_help():
    """Cells so oblong that no springs have this shear; and cells so small that hinges would need too many substeps."""
    with pytest.raises(ValueError, match="lower the shear stiffness, or make the cells more nearly square") as refusal:
        Simulation(grid(5, 5, 0.2, 0.04), Material())
    assert "hinge" not in str(refusal.value)
    with pytest.raises(ValueError, match=r"m: lower the rigidity to .* N m, or use a coarser grid"):
        Simulation(grid(5, 5, 1e-5, 1e-5))


# --- far away ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("away", "dtype", "told"), [(1e2, "float32", 0), (1e3, "float32", 1), (1e4, "float32", 1), (1e4, "float64", 0)]
)
def test_positions_that_rounding_would_stretch_are_told(away, dtype, told):
    simulation = Simulation(grid(9, 9, 0.3, 0.3), dtype=dtype)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        simulation.reset(positions=simulation.mesh.rest_positions + [away, 0, 0])
    assert len(said) == told and all("start nearer to the origin, or take dtype='float64'" in str(w.message) for w in said)
    assert all(w.filename == __file__ for w in said)

"""Colliders of any closed mesh: their distances against brute force, and refusals that say what to do."""

from dataclasses import replace

import numpy as np
import pytest
from solids import ON_ITS_CORNER, bowl, box_distance, box_mesh, chair, mesh_distance, rotation

from clothgym import Box, Material, MeshCollider, Plane, Simulation, grid


def distances(solid, points, dtype="float64"):
    """What the kernel finds for points given as the particles of a sheet."""
    side = round(len(points) ** 0.5)
    simulation = Simulation(grid(side, side, 1.0, 1.0), colliders=[solid], dtype=dtype)
    simulation.reset(positions=points)
    return simulation.contacts().distance[0]


@pytest.mark.parametrize("shape", [box_mesh, chair, bowl])
def test_distance_is_that_of_brute_force(shape):
    """To a part of a cell, near the surface and far inside and out."""
    vertices, triangles = shape()
    solid = MeshCollider(vertices=vertices, triangles=triangles, thickness=0.002, resolution=48)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cell = (high - low).max() / 48
    x = np.random.default_rng(0).uniform(low - 2 * cell, high + 2 * cell, (400, 3))
    expected = mesh_distance(x, vertices, triangles) - 0.002
    assert (expected < 0).sum() > 20 and (expected > 0).sum() > 20
    assert np.abs(distances(solid, x) - expected).max() < 0.4 * cell


def test_pose_and_scale():
    """Those of the same box as a Box; outside of the grid the distance is never too large."""
    vertices, triangles = box_mesh((0.1, 0.05, 0.02))
    pose = {"center": (0.3, 0.1, -0.2), "rotation": ON_ITS_CORNER, "thickness": 0.0}
    solid = MeshCollider(vertices=vertices, triangles=triangles, scale=2.0, resolution=80, **pose)
    x = np.random.default_rng(1).uniform(-1, 1, (400, 3))
    expected = box_distance(x - pose["center"], np.array([0.2, 0.1, 0.04]), rotation(*ON_ITS_CORNER))
    assert distances(Box(half_sides=(0.2, 0.1, 0.04), **pose), x) == pytest.approx(expected, abs=1e-12)
    found = distances(solid, x)
    assert np.all(found < expected + 0.002) and np.all(found > np.where(expected > 0, 0.8, 1.0) * expected - 0.003)
    assert solid.world_vertices() == pytest.approx(2 * vertices @ rotation(*ON_ITS_CORNER).T + pose["center"])


def test_made_within_two_seconds_and_once():
    vertices, triangles = chair()
    first, again = (MeshCollider(vertices=vertices, triangles=triangles, center=(z, 0, 0)) for z in (0, 1))
    assert first.grid is again.grid and first.fits(again)
    assert first.grid.nodes.dtype == np.float32 and max(first.grid.nodes.shape[:3]) == 64 + 7


def test_read_from_a_file(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    vertices, triangles = chair()
    path = tmp_path / "chair.stl"  # which repeats vertices
    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    solid = MeshCollider(path=path)
    assert len(solid.surface[0]) == len(vertices) and len(solid.surface[1]) == len(triangles)
    (tmp_path / "not.obj").write_text("# nothing\n")
    for name, message in (("none.obj", "no such file"), ("not.obj", "no triangles|cannot be read")):
        with pytest.raises(ValueError, match=message):
            MeshCollider(path=tmp_path / name)
    trimesh.Trimesh(vertices, triangles[1:], process=False).export(tmp_path / "open.ply")
    with pytest.raises(ValueError, match=r"open.ply' is not a solid: the mesh is open"):
        MeshCollider(path=tmp_path / "open.ply")


def crossing():
    """Two boxes, one pushed into the other."""
    a, b = box_mesh(), box_mesh((0.05, 0.05, 0.2))
    return np.concatenate([a[0], b[0] + 0.01]), np.concatenate([a[1], b[1] + 8])


def cavity_inside_out():
    a, b = box_mesh(), box_mesh((0.02, 0.02, 0.02))
    return np.concatenate([a[0], b[0] + (0.5, 0, 0)]), np.concatenate([a[1], b[1][:, ::-1] + 8])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda v, t: (v, t[1:]), r"open: edge \d-\d belongs to one triangle only \(3 such edges\): close its holes"),
        (lambda v, t: (v, t[:, ::-1]), r"inside out .*volume is -0.008 m\^3\): turn all triangles round"),
        (lambda v, t: (v, np.concatenate([t[:1, ::-1], t[1:]])), "have opposite orientations"),
        (lambda v, t: cavity_inside_out(), "a part of the mesh near .* is inside out"),
        (lambda v, t: crossing(), r"passes through itself: triangles \d+, .* and \d+, .* cross; join"),
        (lambda v, t: (np.where(v > 0, np.nan, v), t), "not finite"),
        (lambda v, t: (v, np.concatenate([t, [[0, 0, 1]]])), "degenerate"),
        (lambda v, t: (v, t + 1), "must name vertices from 0 to 7"),
        (lambda v, t: (v[:, :2], t), r"must be \(particles, 3\)"),
    ],
)
def test_meshes_that_are_no_solids_are_refused(make, message):
    vertices, triangles = make(*box_mesh())
    with pytest.raises(ValueError, match=message):
        MeshCollider(vertices=vertices, triangles=triangles)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "path of a file, or vertices and triangles"),
        ({"path": "a.obj", "vertices": box_mesh()[0]}, "path of a file, or vertices and triangles"),
        ({"vertices": box_mesh()[0], "triangles": box_mesh()[1], "rotation": (0, 0, 0, 0)}, "rotation"),
        ({"vertices": box_mesh()[0], "triangles": box_mesh()[1], "scale": 0}, "scale"),
        ({"vertices": box_mesh()[0], "triangles": box_mesh()[1], "resolution": 0}, "resolution"),
        ({"vertices": box_mesh()[0], "triangles": box_mesh()[1], "resolution": 10**5}, "resolution=100000: a grid of .*e.1. nodes"),
        ({"vertices": box_mesh()[0] + 1j, "triangles": box_mesh()[1]}, "must be numbers"),
        ({"path": box_mesh()[0], "vertices": box_mesh()[1]}, "path is of type ndarray.*give arrays as vertices="),
        ({"vertices": box_mesh()[0], "triangles": box_mesh()[1], "friction": -1}, "friction"),
    ],
)
def test_bad_numbers_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        MeshCollider(**arguments)


def test_places_in_a_batch():
    """Each environment its own pose of the same mesh; another mesh is refused."""
    vertices, triangles = box_mesh()
    solid = MeshCollider(vertices=vertices, triangles=triangles)
    simulation = Simulation(grid(2, 2, 0.01, 0.01), Material(), num_envs=2, colliders=[solid], dtype="float64")
    simulation.set_collider(0, [MeshCollider(vertices=vertices, triangles=triangles, center=(0, 0, -0.2))], envs=[1])
    simulation.reset(positions=simulation.mesh.rest_positions + (0, 0, 0.11))
    assert simulation.contacts().distance[:, 0] == pytest.approx([0.009, 0.209], abs=0.01)
    other = MeshCollider(vertices=1.1 * vertices, triangles=triangles)
    for wrong, message in ((other, "MeshCollider of another mesh"), (Plane(), "Plane")):
        with pytest.raises(ValueError, match=message):
            simulation.set_collider(0, [wrong], envs=[0])
    again = MeshCollider(vertices=vertices.copy(), triangles=triangles.copy())
    assert again == solid and hash(again) == hash(solid) and solid not in (other, replace(solid, center=(0, 0, 1)))
    state = simulation.get_state()
    simulation.step(3)
    after = simulation.positions
    simulation.set_state(state)
    simulation.step(3)
    assert np.array_equal(simulation.positions, after)


def test_diverged_neighbor_does_no_harm():
    vertices, triangles = box_mesh()
    simulation = Simulation(
        grid(3, 3, 0.1, 0.1), num_envs=2, on_divergence="ignore", colliders=[MeshCollider(vertices=vertices, triangles=triangles)]
    )
    x = np.repeat(simulation.mesh.rest_positions[None] + (0, 0, 0.105), 2, axis=0)
    simulation.reset(positions=x)
    simulation.step(5)
    alone = simulation.positions[0]
    simulation.reset(positions=x, velocities=np.where(np.arange(2)[:, None, None] == 1, 1e30, np.zeros((2, 9, 3))))
    simulation.step(5)
    assert simulation.diverged.tolist() == [False, True]
    assert np.array_equal(simulation.positions[0], alone)

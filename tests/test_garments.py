"""Garments: outlines, meshes and seams, random ones, one in strict contact, files, and what is refused."""

import re

import numpy as np
import pytest
from exact_intersections import intersecting_pairs

from clothgym import Material, Plane, Simulation, garments, load_garment
from clothgym.geometry.intersections import count_intersections
from clothgym.geometry.regions import SMALLEST_ANGLE, fill_regions, inside
from clothgym.mesh import EDGE, OPPOSITE

SPACING = 0.03
OPENINGS = {"tshirt": 4, "long_sleeve": 4, "shorts": 3, "trousers": 3, "skirt": 2, "towel": 1}


@pytest.fixture(scope="module")
def made():
    """One garment of each kind, of the default sizes."""
    return {kind: garments.make(kind, SPACING) for kind in garments.RANGES}


def angles(x, triangles):
    """All angles of triangles [degrees], by the law of cosines."""
    a, b, c = (np.linalg.norm(x[triangles[:, i]] - x[triangles[:, j]], axis=1) for i, j in ((1, 2), (2, 0), (0, 1)))
    cosines = [(q * q + r * r - p * p) / (2 * q * r) for p, q, r in ((a, b, c), (b, c, a), (c, a, b))]
    return np.degrees(np.arccos(cosines))


def loops(triangles):
    """How many closed lines the edges of single triangles form."""
    edges, times = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    following = {}
    for a, b in edges[times == 1].tolist():
        following.setdefault(a, []).append(b)
        following.setdefault(b, []).append(a)
    assert all(len(both) == 2 for both in following.values())
    count, left = 0, set(following)
    while left:
        count, waiting = count + 1, [left.pop()]
        while waiting:
            near = [other for other in following[waiting.pop()] if other in left]
            left.difference_update(near)
            waiting += near
    return count


def shoelace(points):
    """Area of a polygon [m^2]."""
    x, y = np.transpose(points)
    return abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


@pytest.mark.parametrize(("kind", "openings"), OPENINGS.items())
def test_openings_and_genus(made, kind, openings):
    """A sphere with so many holes: V - E + F is 2 less the openings, each of which is one closed line."""
    mesh = made[kind].mesh
    edges = np.unique(np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert mesh.num_particles - len(edges) + len(mesh.triangles) == 2 - openings
    assert loops(mesh.triangles) == openings and mesh.pieces == 1


def tshirt_corners(chest=0.5, shoulder=1.0, neck=0.5, sleeve=0.3, sleeve_length=0.2, length=0.72, chest_length=0.7, waist=1.0):
    """Right corners of a T-shirt without angles: its sleeves are horizontal rectangles."""
    top = length - 0.02
    return [
        (waist * chest / 2, 0), (chest / 2, chest_length * top), (shoulder * chest / 2 + sleeve_length, top - sleeve * chest),
        (shoulder * chest / 2 + sleeve_length, top), (shoulder * chest / 2, top), (neck * chest / 2, top),
    ]  # fmt: skip


def test_areas_are_those_of_the_pattern():
    """A T-shirt without angles, by the shoelace formula: less half an ellipse on the front, two thirds of a box on the back."""
    sizes = {"chest_width": 0.5, "shoulder_width": 1.0, "neck_width": 0.5, "neck_depth": 0.08, "sleeve_width": 0.3,
             "sleeve_length": 0.2, "length": 0.72, "chest_length": 0.7, "waist_width": 1.0, "sleeve_angle": 0.0,
             "sleeve_inner_angle": 0.0, "shoulder_angle": 0.0}  # fmt: skip
    shirt = garments.tshirt(0.01, **sizes)
    right = tshirt_corners()
    whole = shoelace(right + [(-x, y) for x, y in right[::-1]])
    x, triangles = shirt.mesh.rest_positions[:, :2], shirt.mesh.triangles
    u, v = x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    assert area[shirt.front].sum() == pytest.approx(whole - np.pi / 2 * 0.125 * 0.08, rel=1e-3)
    assert area[~shirt.front].sum() == pytest.approx(whole - 2 / 3 * 0.25 * 0.02, rel=1e-3)
    # the layers come together at the seams, which takes hardly more cloth
    assert shirt.mesh.area.sum() == pytest.approx(area.sum(), rel=5e-3)
    # key points where the pattern has them, from the middle of the box around it
    names = ("waist", "armpit", "sleeve_bottom", "sleeve_top", "shoulder", "neck")
    for name, place in zip(names, right):
        for side, sign in (("right", 1), ("left", -1)):
            at = shirt.mesh.rest_positions[shirt.key_points[f"{name}_{side}"]]
            assert at == pytest.approx([sign * place[0], place[1] - 0.35, 0], abs=1e-9)


def test_leg_areas_are_those_of_the_pattern():
    """Shorts without angles, whose legs meet at the crotch, by the shoelace formula."""
    shorts = garments.shorts(
        0.01, waist_width=0.5, crotch_height=0.2, pipe_width=0.4, length=0.4, waist_pipe_angle=0, pipe_outer_angle=0
    )
    pattern = [(0.25, 0), (0.25, -0.4), (0.05, -0.4), (0, -0.2), (-0.05, -0.4), (-0.25, -0.4), (-0.25, 0)]
    assert shorts.mesh.area.sum() / 2 == pytest.approx(shoelace(pattern), rel=5e-3)
    assert shorts.mesh.rest_positions[shorts.key_points["crotch"]] == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.parametrize("kind", garments.RANGES)
def test_garments_are_symmetric_and_have_two_sides(made, kind):
    """The mirrored particle lies in the mirrored place, and mirrored triangles are triangles; fronts look up, backs down."""
    garment = made[kind]
    mesh, x = garment.mesh, garment.mesh.rest_positions
    assert np.abs(x[garment.mirror] - x * [-1, 1, 1]).max() < 1e-12
    if kind != "towel":  # the diagonals of a grid alternate
        own, image = (
            {tuple(sorted(t)) for t in triangles.tolist()} for triangles in (mesh.triangles, garment.mirror[mesh.triangles])
        )
        assert own == image
    a, b, c = (x[mesh.triangles[:, k]] for k in range(3))
    up = np.cross(b - a, c - a)[:, 2] > 0
    assert np.array_equal(up, garment.front)
    left = {name for name in garment.key_points if name.endswith("left")}
    assert left and all(garment.mirror[garment.key_points[name]] == garment.key_points[name[:-4] + "right"] for name in left)


def test_panels_are_flat_at_rest_and_seams_bend_freely(made):
    """Every inner edge but those of seams has a hinge and a skip spring, which joins particles of one panel."""
    for kind in ("tshirt", "shorts"):
        mesh = made[kind].mesh
        assert mesh.flat
        x = mesh.rest_positions
        edges, times = np.unique(np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
        seams = (times == 2) & (x[edges, 2] == 0).all(axis=1)
        hinged = np.unique(np.sort(mesh.hinges.particles[:, :2], axis=1), axis=0)
        assert seams.any() and np.array_equal(hinged, edges[(times == 2) & ~seams])
        skip = mesh.springs.particles[mesh.springs.kind == OPPOSITE]
        assert len(skip) == len(hinged)
        assert np.linalg.norm(x[skip[:, 0]] - x[skip[:, 1]], axis=1).min() > SPACING


def test_the_back_of_the_neck_is_higher(made):
    """Where the middle of each panel ends: the depth of the neckline below the neck, a quarter of it on the back."""
    shirt = made["tshirt"]
    x = shirt.mesh.rest_positions
    ends = [x[np.unique(shirt.mesh.triangles[which])] for which in (shirt.front, ~shirt.front)]
    tops = [part[np.abs(part[:, 0]) < 1e-12, 1].max() for part in ends]
    neck = x[shirt.key_points["neck_left"], 1]
    assert [neck - top for top in tops] == pytest.approx([0.075, 0.075 / 4], abs=1e-9)


@pytest.mark.parametrize("kind", [kind for kind in garments.RANGES if kind != "towel"])
def test_random_garments_are_well_shaped(kind):
    """Angles, edges near the spacing, no intersections by the exact count; a seed draws the same sizes, within their ranges."""
    for seed in range(3):
        garment = garments.random_garment(kind, seed, SPACING)
        mesh = garment.mesh
        assert angles(mesh.rest_positions, mesh.triangles).min() > SMALLEST_ANGLE - 1
        edges = mesh.springs.rest_length[mesh.springs.kind == EDGE]
        assert edges.min() > 0.5 * SPACING and edges.max() < 1.8 * SPACING
        assert count_intersections(mesh.triangles, mesh.rest_positions)[0] == 0
        assert all(low <= garment.sizes[name] <= high for name, (low, high) in garments.RANGES[kind].items())
    again = garments.random_garment(kind, np.random.default_rng(2), SPACING)
    assert again.sizes == garment.sizes and np.array_equal(again.mesh.rest_positions, mesh.rest_positions)


def test_a_shirt_falls_quietly_and_without_intersections(made):
    """Dropped 5 cm in strict contact, whose usual thickness is a tenth of the spacing: one layer comes to lie on the other."""
    shirt = made["tshirt"]
    floor = Plane(point=(0, 0, -0.05), friction=0.5)
    cloth = Simulation(shirt.mesh, Material.preset("cotton"), bending="quadratic", colliders=[floor], self_collision="strict")
    for _ in range(6):
        cloth.step(5)
        assert cloth.intersections()[0] == 0
    x, v = cloth.positions[0], cloth.velocities[0]
    assert not intersecting_pairs(shirt.mesh.triangles, x)
    assert np.sqrt(np.mean(np.sum(v**2, axis=1))) < 0.02
    height = x[:, 2] + 0.05
    assert height.max() < 0.012
    layers = [height[np.unique(shirt.mesh.triangles[which])].mean() for which in (shirt.front, ~shirt.front)]
    assert 0.5 * 0.1 * SPACING < layers[0] - layers[1] < 2 * 0.1 * SPACING


def test_a_region_is_filled_to_its_borders():
    """An L of area 3, whose corner points inward; all triangles within, and the area is that of the polygon."""
    corners = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    ring = np.concatenate([a + (b - a) * np.linspace(0, 1, 5)[:-1, None] for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    points, triangles, region = fill_regions([ring], 0.25)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2
    assert area.sum() == pytest.approx(3, rel=1e-12) and area.min() > 0 and not region.any()
    assert inside(np.array([(1.5, 1.5), (0.5, 1.5), (-0.1, 0.5)]), corners).tolist() == [False, True, False]


@pytest.mark.filterwarnings("ignore:.*dropped")  # each panel's vertices that only the other has
def test_a_garment_from_a_file(tmp_path, made):
    """The panels of a skirt, written with vertices of their own at the seams; key points by the file's numbers."""
    skirt = made["skirt"]
    mesh = skirt.mesh
    fronts, backs = mesh.triangles[skirt.front], mesh.triangles[~skirt.front]
    lines = [f"v {x} {y} {z}" for x, y, z in np.tile(100 * mesh.rest_positions, (2, 1)).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in np.concatenate([fronts + 1, backs + 1 + mesh.num_particles]).tolist()]
    path = tmp_path / "skirt.obj"
    path.write_text("\n".join(lines))
    read = load_garment(path, {"waist": skirt.key_points["waist_left"] + mesh.num_particles}, scale=0.01)
    assert read.kind == "skirt.obj" and read.mesh.num_particles == mesh.num_particles and loops(read.mesh.triangles) == 2
    assert read.front.sum() == skirt.front.sum() and read.mirror is None
    at = read.mesh.rest_positions[read.key_points["waist"]]
    assert at == pytest.approx(mesh.rest_positions[skirt.key_points["waist_left"]], abs=1e-9)
    with pytest.raises(ValueError, match="key_points"):
        load_garment(path, {"waist": 10**6}, scale=0.01)
    with pytest.raises(ValueError, match="in no triangle"):
        load_garment(path, {"waist": int(np.setdiff1d(np.arange(mesh.num_particles), fronts)[0])}, scale=0.01)


@pytest.mark.parametrize(
    ("kind", "wrong", "message"),
    [
        ("tshirt", {"chest": 0.5}, "no size of a tshirt 'chest'"),
        ("tshirt", {"chest_width": -0.5}, "chest_width=-0.5: must be positive"),
        ("tshirt", {"chest_length": 1.2}, "crosses itself with chest_width=0.515"),
        ("tshirt", {"spacing": 0.2}, "spacing=0.2"),
        ("tshirt", {"thickness": 0.01}, "thickness=0.01: must be at most 0.0028 m at spacing=0.02"),
        ("shorts", {"crotch_height": 0.4}, "inseam is"),
        ("shorts", {"pipe_width": 0.99}, "pipe_inner reaches the middle"),
        ("skirt", {"spacing": float("nan")}, "spacing=nan"),
    ],
)
def test_what_is_impossible_is_refused(kind, wrong, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        getattr(garments, kind)(**wrong)


def test_kinds_that_are_unknown_are_refused():
    with pytest.raises(ValueError, match=r"no garment 'tshirts'; did you mean 'tshirt'\?"):
        garments.random_garment("tshirts", 0)

"""Mesh files as modelers export them: what each becomes, what is said of it, and what is refused, by the file's own numbers."""

import inspect
import struct
import warnings

import numpy as np
import pytest

from clothgym import MeshCollider, Simulation, grid, load_mesh
from clothgym.geometry.polygons import as_triangles

U = [(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)]  # of area 5
STAR = [(np.cos(k * np.pi / 5) * (1, 0.4)[k % 2], np.sin(k * np.pi / 5) * (1, 0.4)[k % 2]) for k in range(10)]
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def obj(x, faces):
    """Text of a file with these vertices and faces, numbered from 0 here and from 1 there."""
    rows = ["v " + " ".join(f"{c:.9g}" for c in (*p, 0.0)[:3]) for p in x]
    return "\n".join([*rows, *("f " + " ".join(str(v + 1) for v in face) for face in faces)]) + "\n"


def off(x, faces):
    rows = [" ".join(f"{c:.9g}" for c in (*p, 0.0)[:3]) for p in x]
    return "\n".join(["OFF", f"{len(x)} {len(faces)} 0", *rows, *(f"{len(f)} " + " ".join(map(str, f)) for f in faces)]) + "\n"


def ply(x, faces, form="ascii"):
    """Bytes of a ply file; of text, or binary in either order, with colors beside the positions."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    header = ["ply", f"format {form} 1.0", "comment by hand", f"element vertex {len(x)}"]
    header += [f"property double {axis}" for axis in "xyz"] + ["property uchar red", f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", "property uchar red", "end_header", ""]
    out = "\n".join(header).encode()
    x = [(*p, 0.0)[:3] for p in x]
    if not order:
        rows = [" ".join(f"{c:.9g}" for c in p) + " 7" for p in x]
        rows += [f"{len(f)} " + " ".join(map(str, f)) + " 7" for f in faces]
        return out + "\n".join(rows).encode() + b"\n"
    out += b"".join(struct.pack(order + "3dB", *p, 7) for p in x)
    return out + b"".join(struct.pack(f"{order}B{len(f)}iB", len(f), *f, 7) for f in faces)


def panel(columns=4, rows=3, origin=0.0, first=0):
    """Vertices and quads of a panel of squares of 10 cm."""
    x = [(origin + 0.1 * c, 0.1 * r, 0.0) for r in range(rows) for c in range(columns)]
    faces = [
        (first + r * columns + c, first + r * columns + c + 1, first + (r + 1) * columns + c + 1, first + (r + 1) * columns + c)
        for r in range(rows - 1)
        for c in range(columns - 1)
    ]
    return x, faces


def sewn(gap=0.0, strip=True):
    """Two panels of 30 x 20 cm side by side, ``gap`` apart, with faces across the seam."""
    (x, faces), (y, others) = panel(), panel(origin=0.3 + gap, first=12)
    across = [(4 * r + 3, 12 + 4 * r, 12 + 4 * r + 4, 4 * r + 7) for r in range(2)] if strip else []
    return x + y, [*faces, *others, *across]


def moebius(n=12):
    """A strip with half a turn."""
    x = []
    for k in range(n):
        a = 2 * np.pi * k / n
        x += [((1 + s * np.cos(a / 2)) * np.cos(a), (1 + s * np.cos(a / 2)) * np.sin(a), s * np.sin(a / 2)) for s in (-0.2, 0.2)]
    quads = [(2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1) for k in range(n - 1)]
    return x, [*quads, (2 * n - 2, 1, 0, 2 * n - 1)]


def turned(faces, *which):
    return [face[::-1] if k in which else face for k, face in enumerate(faces)]


def scaled(x, factor):
    return [tuple(factor * c for c in p) for p in x]


SEWN = sewn()
BENT = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.3)]
NEEDLE = [*SQUARE, (1 + 1e-8, 0.5, 0), (1, 0.5, 0), (2, 0.5, 0)]
# name: text of the file; particles, triangles, area [m^2]; pieces; clauses of what is said
TAKEN = {
    "plain": (obj(*panel()), 12, 12, 0.06, 1, []),
    "quads and triangles": (obj(*(lambda x, f: (x, [*f[:-1], f[-1][:3], (*f[-1][2:], f[-1][0])]))(*panel())), 12, 12, 0.06, 1, []),
    "a seam with faces across": (obj(*SEWN), 21, 24, 0.12, 1, ["dropped 2 faces that were left without three corners"]),
    "a seam without": (obj(*sewn(strip=False)), 21, 24, 0.12, 1, []),
    "a seam by triangles": (
        obj(SEWN[0], [*SEWN[1][:12], *(half for a, b, c, d in SEWN[1][12:] for half in ((a, b, c), (a, c, d)))]),
        21, 24, 0.12, 1, ["dropped 4 faces that were left without three corners"],
    ),
    "mixed winding": (obj(panel()[0], turned(panel()[1], 1, 4)), 12, 12, 0.06, 1, ["turned 4 triangles round"]),
    "most turned": (obj(panel()[0], turned(panel()[1], 0, 1, 2, 3, 5)), 12, 12, 0.06, 1, ["turned 2 triangles round"]),
    "a concave face": (obj(U, [range(8)]), 8, 6, 5.0, 1, []),
    "a concave face of the other side up": (obj(U, [range(7, -1, -1)]), 8, 6, 5.0, 1, []),
    "a concave face in off": (off(U, [range(8)]), 8, 6, 5.0, 1, []),
    "a concave quad": (obj([(0, 0), (2, 0), (0.5, 0.5), (0, 2)], [range(4)]), 4, 2, 1.0, 1, []),
    "a star": (obj(STAR, [range(10)]), 10, 8, 10 * 0.4 * np.sin(np.pi / 5) / 2, 1, []),
    "corners on a straight side": (obj([(0, 0), (1, 0), (2, 0), (2, 1), (0, 1)], [range(5)]), 5, 3, 2.0, 1, []),
    "a quad out of its plane": (obj(BENT, [range(4)]), 4, 2, 0.5 + np.sqrt(1 + 2 * 0.3**2) / 2, 1, []),
    "pieces of mixed winding": (
        obj(*(lambda x, f: (x, turned(f, 1, 4, 7, 10)))(*sewn(gap=0.2, strip=False))), 24, 24, 0.12, 2,
        ["the sheet has 2 pieces", "turned 8 triangles round"],
    ),
    "pieces": (obj(*sewn(gap=0.2, strip=False)), 24, 24, 0.12, 2, ["the sheet has 2 pieces"]),
    "duplicate faces": (
        obj(panel()[0], [*panel()[1], panel()[1][0], panel()[1][3][::-1]]), 12, 12, 0.06, 1, ["dropped 4 triangles that were there"]
    ),
    "unused vertices": (obj([(9, 9, 9), *SQUARE, (8, 8, 8)], [(1, 2, 3, 4)]), 4, 2, 1.0, 1, ["dropped 2 vertices that are in no"]),
    "unused vertices in off": (off([*SQUARE, (9, 9, 9)], [(0, 1, 2, 3)]), 4, 2, 1.0, 1, ["dropped 1 vertex that is in"]),
    "a corner on a neighbor's side": (
        obj([*SQUARE, (1, 0.5, 0), (2, 0.5, 0)], [(0, 1, 2, 3), (1, 4, 2), (1, 5, 4), (4, 5, 2)]), 6, 5, 1.5, 1,
        ["took away 1 triangle that has no area"],
    ),
    "a side of no length beside the others": (
        obj(NEEDLE, [(0, 1, 5), (0, 5, 2, 3), (5, 1, 4), (1, 6, 4), (4, 6, 2), (5, 4, 2)]), 6, 5, 1.5, 1, ["took away"]
    ),
    "centimeters": (obj(*(lambda x, f: (scaled(x, 200.0), f))(*panel())), 12, 12, 2400.0, 1, ["60 m across", "scale=0.01 if"]),
    "millimeters": (obj(*(lambda x, f: (scaled(x, 2000.0), f))(*panel())), 12, 12, 240000.0, 1, ["600 m across", "scale=0.001"]),
    "another unit": (obj(*(lambda x, f: (scaled(x, 1e-3), f))(*panel())), 12, 12, 6e-8, 1, ["0.0003 m across"]),
    "folded flat": (
        obj([*SQUARE[:3], (0.8, 0.1, 0)], [(0, 1, 2), (0, 2, 3)]), 4, 2, 0.85, 1,
        ["1 edge is folded flat at rest, and may flip to the other side: with_rest_angles(above=3) opens them"],
    ),
    "texture, normals, comments and a line that goes on": (
        "o a\nv 0 0 0 # first\nv 1 0 0\nv 1 1 0\nvt 0 0\nvn 0 0 1\nv 0 1 0\ns off\nf -4/1/1 -3//1 \\\n 3/1 4\n", 4, 2, 1.0, 1, []
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", TAKEN)
def test_mesh_files_are_read_and_repaired(tmp_path, case):
    """Particles, triangles, area and pieces, known from how the file was made; one warning at the caller's line, or none."""
    text, particles, triangles, area, pieces, clauses = TAKEN[case]
    path = tmp_path / ("sheet.off" if text.startswith("OFF") else "sheet.obj")
    path.write_text(text)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mesh, line = load_mesh(path), inspect.currentframe().f_lineno
    assert (mesh.num_particles, len(mesh.triangles), mesh.pieces) == (particles, triangles, pieces)
    assert mesh.area.sum() == pytest.approx(area, rel=1e-6)
    normals = np.cross(*(mesh.rest_positions[mesh.triangles[:, k]] - mesh.rest_positions[mesh.triangles[:, 0]] for k in (1, 2)))
    assert np.linalg.norm(normals, axis=1).min() > 1e-3 * area / triangles
    assert len(said) == (1 if clauses else 0)
    for warning in said:
        assert (warning.filename, warning.lineno, warning.category) == (__file__, line, UserWarning)
        assert str(warning.message).startswith(repr(str(path)))
        assert all(clause in str(warning.message) for clause in clauses)


REFUSED = {
    "an edge of three": (
        obj([*SQUARE, (0.5, 0.5, 1)], [(0, 1, 2), (0, 2, 3), (0, 2, 4)]),
        r"edge 1-3, from \(0, 0, 0\) to \(1, 1, 0\)",
    ),
    "an edge of three in a seam": (
        obj([(5, 5, 5), *SEWN[0], (0.4, 0.1, 0.1)], [tuple(v + 1 for v in f) for f in SEWN[1]] + [(4, 8, 25)]),
        r"edge 5-9, from \(0.3, 0, 0\) to \(0.3, 0.1, 0\), belongs to 3 triangles \(1 such edges\).*remove the others",
    ),
    "a moebius strip": (
        obj(*moebius()),
        r"edge \d+-\d+, from \(.*\) to \(.*\), lies in a part that has one side only.*cut it there",
    ),
    "a moebius strip in off": (off(*moebius()), r"one side only"),
    "a face that crosses itself": (obj([(0, 0), (1, 1), (1, 0), (0, 1)], [range(4)]), r"face 1, .*\[1, 2, 3, 4\].*crosses itself"),
    "a larger one": (obj([(0, 0), (2, 0), (0, 1), (2, 1), (1, -1)], [range(5)]), "face 1.*crosses itself: cut it into triangles"),
    "no area at all": (obj([(0, 0), (1, 0), (2, 0)], [range(3)]), "none of its triangles has an area"),
    "vertex 0": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4, 'f 0 1 2', names vertex 0: the first is 1"),
    "a vertex that is not there": (
        obj(SQUARE, [(0, 1, 2), (1, 7, 2)]),
        r"triangle 2 is \[2, 8, 3\]: must name vertices from 1 to 4",
    ),
    "not there in off": (off(SQUARE, [(0, 1, 2), (1, 7, 2)]), r"triangle 1 is \[1, 7, 2\]: must name vertices from 0 to 3"),
    "no number": ("v 0 0 0\nv 1 x 0\nv 0 1 0\nf 1 2 3\n", "line 2, 'v 1 x 0', is no vertex of three numbers"),
    "a corner that is none": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 b 3\n", "line 4, 'f 1 b 3', is no face"),
    "not a number": (obj([*SQUARE[:3], (0, np.nan, 0)], [range(4)]), "vertex 4 is at .*nan.*finite position"),
    "short": ("OFF\n4 2 0\n0 0 0\n1 0 0\n", "ends before its 4 vertices and 2 faces"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_files_name_their_own_vertices(tmp_path, case):
    text, message = REFUSED[case]
    path = tmp_path / ("sheet.off" if text.startswith("OFF") else "sheet.obj")
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        load_mesh(path)
    assert str(path) in str(refusal.value)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_of_every_form(tmp_path, form):
    """Faces of 8 and of 3 corners in one file, with other properties beside them."""
    path = tmp_path / "u.ply"
    path.write_bytes(ply([*U, (4, 0)], [range(8), (1, 8, 2)], form))
    mesh = load_mesh(path)
    assert (mesh.num_particles, len(mesh.triangles)) == (9, 7) and mesh.area.sum() == pytest.approx(6)
    path.write_bytes(ply(*panel(), form))
    assert load_mesh(path).area.sum() == pytest.approx(0.06)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"u\.ply' (cannot be read|is not a sheet)"):
        load_mesh(path)


@pytest.mark.parametrize("turn", range(8))
@pytest.mark.parametrize("seed", range(3))
def test_a_concave_polygon_has_its_area_however_it_lies(seed, turn):
    """Shoelace's area of a star-shaped polygon of random radii: areas of folded triangles would add up to more."""
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, 9 + 6 * seed))
    p = np.roll(np.stack([np.cos(angle), np.sin(angle)], axis=1) * random.uniform(0.2, 1, (len(angle), 1)), turn, axis=0)
    shoelace = np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1)) / 2
    turning, _ = np.linalg.qr(random.normal(size=(3, 3)))
    x = np.pad(p, [(0, 0), (0, 1)]) @ turning + 3
    found = as_triangles(x)
    areas = [np.linalg.norm(np.cross(x[b] - x[a], x[c] - x[a])) / 2 for a, b, c in found]
    assert (
        len(found) == len(p) - 2
        and np.sum(areas) == pytest.approx(shoelace, rel=1e-9)
        and set(np.ravel(found)) == set(range(len(p)))
    )


@pytest.mark.parametrize(("gap", "strip"), [(1e-4, False), (1e-4, True), (1e-3, True)])
def test_seams_are_joined_within_a_tolerance(tmp_path, gap, strip):
    """Three pairs of vertices across the seam; the joined ones meet half way.  Without the argument the panels stay apart."""
    path = tmp_path / "seam.obj"
    path.write_text(obj(*sewn(gap, strip)))
    with pytest.warns(UserWarning, match="joined 3 vertices that were within merge_tolerance"):
        mesh = load_mesh(path, merge_tolerance=2 * gap)
    assert (mesh.num_particles, len(mesh.triangles), mesh.pieces) == (21, 24, 1)
    assert np.sum(np.isclose(mesh.rest_positions[:, 0], 0.3 + gap / 2, atol=1e-12)) == 3
    assert mesh.repairs.joined == 3 and mesh.repairs.collapsed == (4 if strip else 0)
    if strip:
        assert load_mesh(path).num_particles == 24
    else:
        with pytest.warns(UserWarning, match="2 pieces that nothing holds together"):
            assert load_mesh(path).pieces == 2


def test_layers_closer_than_the_tolerance_stay_apart_inside(tmp_path):
    """A front and a back 1 mm apart: only their borders meet, as a pillow's."""
    (x, faces), (y, others) = panel(), panel(first=12)
    path = tmp_path / "pillow.obj"
    path.write_text(obj([*x, *((a, b, 1e-3) for a, b, _ in y)], [*faces, *(face[::-1] for face in others)]))
    with pytest.warns(UserWarning, match="joined 10 vertices"):
        mesh = load_mesh(path, merge_tolerance=2e-3)
    assert (mesh.num_particles, len(mesh.triangles)) == (14, 24)


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        (-1.0, "merge_tolerance=-1.0"),
        (0.5, "must be at most a tenth of its size"),
        (0.06, "joins a chain of 26 vertices over 0.57"),
    ],
)
def test_a_tolerance_that_makes_no_sense_is_refused(tmp_path, tolerance, message):
    path = tmp_path / "fine.obj"
    mesh = grid(14, 14, 0.65, 0.65)
    path.write_text(obj(mesh.rest_positions.tolist(), mesh.triangles.tolist()))
    with pytest.raises(ValueError, match=message.replace("26", r"\d+").replace("0.57", "")):
        load_mesh(path, merge_tolerance=tolerance)


def test_scale_is_the_file_unit_in_meters(tmp_path):
    path = tmp_path / "cm.obj"
    path.write_text(obj(scaled(panel()[0], 100.0), panel()[1]))
    mesh = load_mesh(path, scale=0.01)
    assert mesh.area.sum() == pytest.approx(0.06) and mesh.size == pytest.approx((0.3, 0.2))


def test_repairs_are_reported(tmp_path):
    """Counts, and the particle that each vertex of the file has become."""
    path = tmp_path / "sheet.obj"
    path.write_text(obj([(7, 7, 7), *SEWN[0]], [tuple(v + 1 for v in face) for face in turned([*SEWN[1], SEWN[1][0]], 2)]))
    with pytest.warns(UserWarning, match="dropped 2 faces.*dropped 2 triangles.*dropped 1 vertex.*turned 2 triangles"):
        mesh = load_mesh(path)
    found = mesh.repairs
    assert (found.merged, found.joined, found.collapsed, found.duplicates, found.unused, found.turned) == (3, 0, 2, 2, 1, 2)
    assert found.particle_of[0] == -1 and len(found.particle_of) == 25
    np.testing.assert_allclose(mesh.rest_positions[found.particle_of[1:]], SEWN[0], atol=1e-8)
    assert grid(3, 3, 1.0, 1.0).repairs is None


def test_a_mesh_is_printed_in_one_line(tmp_path):
    path = tmp_path / "pieces.obj"
    path.write_text(obj(*sewn(gap=0.2, strip=False)))
    with pytest.warns(UserWarning, match="pieces"):
        mesh = load_mesh(path)
    assert repr(mesh) == "<ClothMesh of 24 particles, 24 triangles, 0.8 x 0.2 x 0 m, 2 pieces>"
    assert repr(grid(17, 9, 0.6, 0.3)) == "<ClothMesh of 17 x 9 particles, 256 triangles, 0.6 x 0.3 m>"


def cube(turn=()):
    """Vertices and quads of a cube of 20 cm, counter-clockwise from outside."""
    x = [(0.1 * a, 0.1 * b, 0.1 * c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x, turned(faces, *turn)


def test_solids_are_read_in_the_same_way(tmp_path):
    """Quads, a face turned round and a vertex that is not used; a concave face of a solid as a step."""
    x, faces = cube(turn=(2,))
    path = tmp_path / "cube.obj"
    path.write_text(obj([*x, (5, 5, 5)], faces))
    with pytest.warns(UserWarning, match=r"cube\.obj': dropped 1 vertex that is in no triangle; turned 2 triangles round"):
        solid = MeshCollider(path=path, resolution=16)
    sides = np.moveaxis(solid.surface[0][solid.surface[1]], 1, 0)
    assert np.einsum("tc,tc->t", sides[0], np.cross(sides[1], sides[2])).sum() / 6 == pytest.approx(0.008)
    low, high = [(a, b, 0) for a, b in U], [(a, b, 1) for a, b in U]
    walls = [(k, (k + 1) % 8, 8 + (k + 1) % 8, 8 + k) for k in range(8)]
    path.write_text(obj([*low, *high], [range(7, -1, -1), range(8, 16), *walls]))
    solid = MeshCollider(path=path, resolution=16)
    sides = np.moveaxis(solid.surface[0][solid.surface[1]], 1, 0)
    assert np.einsum("tc,tc->t", sides[0], np.cross(sides[1], sides[2])).sum() / 6 == pytest.approx(5)


def test_an_open_solid_names_the_vertices_of_its_file(tmp_path):
    x, faces = cube()
    path = tmp_path / "open.obj"
    path.write_text(obj([x[0], *x], [tuple(v + 1 for v in face) for face in faces[1:]]))
    with (
        pytest.warns(UserWarning, match="dropped 1 vertex"),
        pytest.raises(ValueError, match=r"open: edge 2-3, from \(-0.1, -0.1, -0.1\) to \(-0.1, -0.1, 0.1\) m, belongs to one"),
    ):
        MeshCollider(path=path)


@pytest.mark.parametrize("case", ["a seam with faces across", "a corner on a neighbor's side", "a star"])
def test_loaded_meshes_fall_in_one_piece(tmp_path, case):
    path = tmp_path / "sheet.obj"
    path.write_text(TAKEN[case][0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulation = Simulation(load_mesh(path), air_density=0, on_divergence="raise")
    simulation.step(6)
    h = simulation.time_step / simulation.substeps
    assert simulation.positions[0, :, 2].mean() == pytest.approx(-9.81 * 0.1 * (0.1 + h) / 2, rel=1e-3)
    assert np.abs(simulation.strain()).max() < 0.01

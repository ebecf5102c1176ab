"""Floor 1: garments as two panels of one outline, sewn along their seams; and garments from files.

Outlines, key points and ranges of sizes of T-shirts, shorts and towels are those of Lips et al. 2024, Learning keypoints for
robotic cloth manipulation using synthetic data (arXiv 2401.01734), in the MIT-licensed tlpss/synthetic-cloth-data
(``geometric_templates.py``, ``cloth_meshes.py``).  Long sleeves, trousers and skirts are additions, and so is the neckline, which
is higher on the back.

A garment lies flat, centered on the origin, with its front up and its neck or waist toward +y.  "left" and "right" are -x and +x.
The right half of a panel is triangulated, mirrored, and copied for the other panel.  Panels resist bending, seams do not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import indices, known, number, positive, shown, vector
from clothgym.geometry.polygons import crosses_itself
from clothgym.geometry.regions import fill_regions
from clothgym.mesh import OPPOSITE, ClothMesh, Hinges, Springs, frozen, grid
from clothgym.triangles import load_mesh, triangle_mesh

SPACING = 0.02  # of the particles [m]
USUAL_THICKNESS = 0.1  # that the cloth keeps to itself, in spacings
LAYERS = 1 / 0.28  # distance of the layers at rest, in thicknesses: the usual thickness of self-collision is then the same
STEEPEST = 0.25  # largest distance of a layer from the seams' plane, in spacings
MOST_DRAWS = 1000  # of sizes until an outline is possible
NECKLINE_POINTS = 64  # of the polygon that stands for a neckline
BACK_SHARE = 0.25  # depth of the back's neckline over that of the front's
LEAST_INSEAM = 0.05  # of legs [m]
LEAST_GAP = 0.01  # between the legs [m]

# ranges of the sizes, from which random garments are drawn, and whose middles are the defaults; their meanings and units are in the
# docstrings of the garments
TSHIRT = {
    "chest_width": (0.38, 0.65), "shoulder_width": (0.9, 1.05), "neck_width": (0.45, 0.55), "neck_depth": (0.05, 0.1),
    "sleeve_width": (0.25, 0.3), "sleeve_length": (0.19, 0.2), "length": (0.62, 0.75), "chest_length": (0.65, 0.7),
    "waist_width": (0.95, 1.1), "sleeve_angle": (0.3, 0.6), "sleeve_inner_angle": (-0.1, 0.1), "shoulder_angle": (0.0, 0.2),
}  # fmt: skip
SHORTS = {
    "waist_width": (0.4, 0.6), "crotch_height": (0.1, 0.25), "pipe_width": (0.4, 0.6), "length": (0.2, 0.5),
    "waist_pipe_angle": (0.1, 0.3), "pipe_outer_angle": (0.0, 0.2),
}  # fmt: skip
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "tshirt": TSHIRT,
    "long_sleeve": {**TSHIRT, "sleeve_width": (0.2, 0.25), "sleeve_length": (0.45, 0.55)},
    "shorts": SHORTS,
    "trousers": {**SHORTS, "crotch_height": (0.2, 0.28), "pipe_width": (0.35, 0.5), "length": (0.8, 1.05),
                 "waist_pipe_angle": (0.02, 0.08), "pipe_outer_angle": (0.0, 0.1)},
    "skirt": {"waist_width": (0.3, 0.45), "length": (0.35, 0.7), "side_angle": (0.05, 0.3)},
    "towel": {"length": (0.5, 1.0), "width": (2 / 3, 1.0)},
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment at rest.

    Attributes:
        kind: a name of ``RANGES``, or the file's name.
        mesh: the cloth; ``Simulation`` takes it.
        key_points: particles by name.
        front: which triangles belong to the front, (triangles,).
        mirror: the particle in the mirrored place of each, left for right, (particles,); None if it was read from a file.
        sizes: what the outline was drawn with, see ``RANGES``; empty if it was read from a file.
    """

    kind: str
    mesh: ClothMesh
    key_points: Mapping[str, int]
    front: NDArray[np.bool]  # not np.bool_: reStructuredText takes that for a link
    mirror: NDArray[np.int32] | None
    sizes: Mapping[str, float]

    def __repr__(self) -> str:
        return f"<Garment {self.kind}: {self.mesh.num_particles} particles, {len(self.key_points)} key points>"


class _Side(NamedTuple):
    """A side of half an outline: its name and that of the key point at its end (or none), its points [m], (points, 2), and whether
    the panels are sewn there."""

    name: str
    key_point: str
    points: NDArray[np.float64]
    sewn: bool


class _Half(NamedTuple):
    """The right half of a panel, counter-clockwise from where the border leaves the axis x = 0 to where it comes back.

    front: sides of the front.  back: of the last side, the neckline, the back's; None if both panels are the same.
    first: the key point where the first side begins, if it is one.
    """

    front: list[_Side]
    back: _Side | None = None
    first: str = ""


def tshirt(spacing: float = SPACING, thickness: float | None = None, **sizes: float) -> Garment:
    """A T-shirt: open at neck, hem and cuffs; the neckline of the back is higher.

    Args:
        spacing: of the particles [m].
        thickness: that the cloth keeps to itself by default with ``self_collision="strict"`` [m], usually a tenth of the spacing.
            At rest the layers are 3.6 times as far apart.
        sizes: chest_width, sleeve_length, length and neck_depth [m]; shoulder_width, neck_width, sleeve_width and waist_width over
            chest_width; chest_length (from the hem to the armpits) over length less 2 cm; sleeve_angle and shoulder_angle below
            the horizontal, and sleeve_inner_angle of the cuff [rad].  The middle of each range in ``RANGES`` by default.

    Raises:
        ValueError: an unknown size, a value that makes no sense, an outline that crosses itself, or a spacing or thickness that
            does not suit it.
    """
    return make("tshirt", spacing, thickness, sizes)


def long_sleeve(spacing: float = SPACING, thickness: float | None = None, **sizes: float) -> Garment:
    """A T-shirt with long sleeves; see ``tshirt``."""
    return make("long_sleeve", spacing, thickness, sizes)


def shorts(spacing: float = SPACING, thickness: float | None = None, **sizes: float) -> Garment:
    """Shorts: open at waist and legs.

    sizes: waist_width, crotch_height (from the crotch up to the waist) and length [m]; pipe_width (of a leg at its end) over
    waist_width; waist_pipe_angle of the outer sides from the vertical, and pipe_outer_angle of the legs' ends from the horizontal
    [rad].  Others, and errors: see ``tshirt``.
    """
    return make("shorts", spacing, thickness, sizes)


def trousers(spacing: float = SPACING, thickness: float | None = None, **sizes: float) -> Garment:
    """Long trousers; see ``shorts``."""
    return make("trousers", spacing, thickness, sizes)


def skirt(spacing: float = SPACING, thickness: float | None = None, **sizes: float) -> Garment:
    """A skirt: open at waist and hem.

    sizes: waist_width and length [m], and side_angle of the sides from the vertical [rad].  Others, and errors: see ``tshirt``.
    """
    return make("skirt", spacing, thickness, sizes)


def towel(spacing: float = SPACING, **sizes: float) -> Garment:
    """A towel: a ``grid`` of one layer, with its corners as key points.

    sizes: length [m], and width over length.  Others, and errors: see ``tshirt``.
    """
    return make("towel", spacing, None, sizes)


def random_garment(kind: str, seed: int | np.random.Generator, spacing: float = SPACING, thickness: float | None = None) -> Garment:
    """A garment whose sizes are drawn uniformly from ``RANGES``, again until its outline is possible.

    kind: a name of ``RANGES``.  seed: of a generator, or a generator, from which the sizes are drawn.  Others, and errors: see
    ``tshirt``.
    """
    known("garment", kind, RANGES)
    rng = np.random.default_rng(seed)
    for _ in range(MOST_DRAWS):
        drawn = {name: float(rng.uniform(low, high)) for name, (low, high) in RANGES[kind].items()}
        if kind == "towel" or _flaw(OUTLINES[kind](drawn)) is None:
            return make(kind, spacing, thickness, drawn)
    raise RuntimeError(f"no possible {kind} within {MOST_DRAWS} draws")


def make(
    kind: str, spacing: float = SPACING, thickness: float | None = None, sizes: Mapping[str, float] | None = None
) -> Garment:  # fmt: skip
    """A garment of a kind of ``RANGES``; arguments and errors as for ``tshirt``."""
    # sizes
    known("garment", kind, RANGES)
    spacing = positive("spacing", spacing)
    thickness = USUAL_THICKNESS * spacing if thickness is None else positive("thickness", thickness)
    chosen = {name: (low + high) / 2 for name, (low, high) in RANGES[kind].items()}
    for name, value in (sizes or {}).items():
        known(f"size of a {kind}", name, chosen)
        chosen[name] = number(name, value) if name.endswith("angle") else positive(name, value)
    if kind == "towel":
        return _towel(spacing, chosen)
    # the outline
    half = OUTLINES[kind](chosen)
    if flaw := _flaw(half):
        given = ", ".join(f"{name}={value:.4g}" for name, value in chosen.items())
        raise ValueError(f"{kind}: {flaw} with {given}: choose sizes nearer to their ranges in clothgym.garments.RANGES")
    if LAYERS * thickness / 2 > STEEPEST * spacing:
        raise ValueError(
            f"thickness={thickness:g}: must be at most {2 * STEEPEST / LAYERS * spacing:.2g} m at spacing={spacing:g}, so that the "
            "layers meet at the seams without a sharp bend"
        )
    return _sewn(kind, half, spacing, LAYERS * thickness, chosen)


def load_garment(
    path: str | Path, key_points: Mapping[str, int], scale: float = 1.0, merge_tolerance: float = 0.0,
    facing: ArrayLike = (0.0, 0.0, 1.0),
) -> Garment:  # fmt: skip
    """A garment from a mesh file, see ``load_mesh``.

    Args:
        path: the file.
        key_points: vertices of the file, counted from 0, by name.
        scale, merge_tolerance: see ``load_mesh``.
        facing: the direction in which the front looks, in the file: triangles whose normals at rest point that way are the
            front, (3,).

    Raises:
        ImportError, ValueError: see ``load_mesh``; or a key point that is no vertex of the sheet.
    """
    facing = vector("facing", facing)
    if not isinstance(key_points, Mapping):
        raise ValueError(f"key_points={shown(key_points)}: must be a mapping from names to vertices of the file")
    mesh = load_mesh(path, scale, merge_tolerance)
    assert mesh.repairs is not None
    particle_of = mesh.repairs.particle_of
    vertices = indices("key_points", list(key_points.values()), len(particle_of), "vertices of the file, from 0")
    for name, vertex in zip(key_points, vertices.tolist()):
        if particle_of[vertex] < 0:
            raise ValueError(f"key_points: {name!r} is vertex {vertex}, which is in no triangle: name another")
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    front = np.cross(b - a, c - a) @ facing > 0
    points = {name: int(particle_of[vertex]) for name, vertex in zip(key_points, vertices.tolist())}
    return Garment(Path(path).name, mesh, points, frozen(front), None, {})


# --- outlines -------------------------------------------------------------------------------------------------------------------


def _tshirt_half(sizes: Mapping[str, float]) -> _Half:
    """Half a T-shirt from the hem, on y = 0."""
    chest, shoulder_height = sizes["chest_width"], sizes["length"] - 0.02
    waist = np.array([sizes["waist_width"] * chest / 2, 0.0])
    armpit = np.array([chest / 2, sizes["chest_length"] * shoulder_height])
    shoulder = np.array([sizes["shoulder_width"] * chest / 2, shoulder_height])
    neck = shoulder + (sizes["shoulder_width"] - sizes["neck_width"]) * chest / 2 * _direction(np.pi - sizes["shoulder_angle"])
    sleeve_top = shoulder + sizes["sleeve_length"] * _direction(-sizes["sleeve_angle"])
    cuff = -(sizes["sleeve_angle"] + np.pi / 2 + sizes["sleeve_inner_angle"])
    sleeve_bottom = sleeve_top + sizes["sleeve_width"] * chest * _direction(cuff)
    front = [
        _line("hem", "waist", [0.0, 0.0], waist, False),
        _line("side", "armpit", waist, armpit, True),
        _line("underarm", "sleeve_bottom", armpit, sleeve_bottom, True),
        _line("cuff", "sleeve_top", sleeve_bottom, sleeve_top, False),
        _line("upper sleeve", "shoulder", sleeve_top, shoulder, True),
        _line("shoulder", "neck", shoulder, neck, True),
        _Side("neckline", "", _neckline(neck, sizes["neck_depth"], round_=True), False),
    ]
    return _Half(front, _Side("back neckline", "", _neckline(neck, BACK_SHARE * sizes["neck_depth"], round_=False), False))


def _legs_half(sizes: Mapping[str, float]) -> _Half:
    """Half a pair of shorts or trousers from the crotch, at the origin."""
    waist = np.array([sizes["waist_width"] / 2, sizes["crotch_height"]])
    outer = waist + sizes["length"] * _direction(sizes["waist_pipe_angle"] - np.pi / 2)
    inner = outer - sizes["pipe_width"] * sizes["waist_width"] * _direction(sizes["pipe_outer_angle"])
    front = [
        _line("inseam", "pipe_inner", [0.0, 0.0], inner, True),
        _line("leg", "pipe_outer", inner, outer, False),
        _line("side", "waist", outer, waist, True),
        _line("waist", "", waist, [0.0, waist[1]], False),
    ]
    return _Half(front, first="crotch")


def _skirt_half(sizes: Mapping[str, float]) -> _Half:
    """Half a skirt from the hem, on y = 0."""
    waist = np.array([sizes["waist_width"] / 2, sizes["length"]])
    side = sizes["length"] / _direction(sizes["side_angle"])[0]
    hem = waist + side * _direction(sizes["side_angle"] - np.pi / 2)
    front = [
        _line("hem", "hem", [0.0, 0.0], hem, False),
        _line("side", "waist", hem, waist, True),
        _line("waist", "", waist, [0.0, waist[1]], False),
    ]
    return _Half(front)


OUTLINES: dict[str, Callable[[Mapping[str, float]], _Half]] = {
    "tshirt": _tshirt_half, "long_sleeve": _tshirt_half, "shorts": _legs_half, "trousers": _legs_half, "skirt": _skirt_half,
}  # fmt: skip


def _direction(angle: float) -> NDArray[np.float64]:
    """The unit vector at an angle from +x [rad], (2,), rounded: the last bits of sines depend on the processor."""
    return np.round(np.array([np.cos(angle), np.sin(angle)]), 12)


def _line(name: str, key_point: str, start: ArrayLike, end: ArrayLike, sewn: bool) -> _Side:
    return _Side(name, key_point, np.array([start, end], np.float64), sewn)


def _neckline(neck: NDArray, depth: float, round_: bool) -> NDArray[np.float64]:
    """From the neck to the middle, ``depth`` below it [m], (points, 2): half an ellipse, or a parabola, which leaves a wide angle
    between both at the neck."""
    share = np.linspace(0, 1, NECKLINE_POINTS)
    if round_:
        along, down = (1 - share**2) / (1 + share**2), 2 * share / (1 + share**2)
    else:
        along, down = 1 - share, share * (2 - share)
    return np.stack([neck[0] * along, neck[1] - depth * down], axis=1)


def _flaw(half: _Half) -> str | None:
    """What is wrong with an outline, as a clause; None if nothing is."""
    ring = np.concatenate([side.points[:-1] for side in half.front] + [half.front[-1].points[-1:]])
    beyond = [side.key_point for side in half.front if side.key_point and side.points[-1, 0] < LEAST_GAP / 2]
    if beyond:
        return f"the key point {beyond[0]} reaches the middle"
    seam = half.front[0]
    if seam.name == "inseam" and -seam.points[-1, 1] < LEAST_INSEAM:
        return f"the inseam is {-seam.points[-1, 1]:.3g} m high, less than {LEAST_INSEAM:g} m"
    if ring[-1, 1] <= ring[0, 1] or crosses_itself(ring):
        return "the outline crosses itself"
    return None


# --- from an outline to a mesh --------------------------------------------------------------------------------------------------


def _spaced(points: NDArray, spacing: float) -> NDArray[np.float64]:
    """Points at equal intervals of about a spacing along a line of points, with both its ends, (points, 2)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0, lengths[-1], max(round(lengths[-1] / spacing), 1) + 1)
    spaced = np.stack([np.interp(places, lengths, points[:, axis]) for axis in range(2)], axis=1)
    spaced[[0, -1]] = points[[0, -1]]
    return spaced


def _panel(half: _Half, spacing: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """The whole panel of the back: points [m], (points, 2), triangles, which of them the front has, and which points are sewn."""
    # half of it, with the part between the necklines as a region of its own
    sides = [_spaced(side.points, spacing) for side in half.front]
    axis = _spaced(np.array([sides[-1][-1], sides[0][0]]), spacing)
    regions = [np.concatenate([side[:-1] for side in [*sides, axis]])]
    if half.back is not None:
        back = _spaced(half.back.points, spacing)
        down = _spaced(np.array([back[-1], sides[-1][-1]]), spacing)
        regions.append(np.concatenate([back[:-1], down[:-1], sides[-1][::-1][:-1]]))
    points, triangles, region = fill_regions(regions, spacing)
    # the left half; points on the axis belong to both
    on_axis = points[:, 0] == 0
    image = np.where(on_axis, np.arange(len(points)), len(points) + np.cumsum(~on_axis) - 1)
    whole = np.concatenate([points, points[~on_axis] * [-1, 1]])
    both = np.concatenate([triangles, image[triangles][:, ::-1]])
    seams = np.concatenate([side for side, own in zip(sides, half.front) if own.sewn])
    sewn = (points[:, None] == seams).all(axis=2).any(axis=1)
    return whole, both, np.tile(region == 0, 2), np.concatenate([sewn, sewn[~on_axis]])


def _sewn(kind: str, half: _Half, spacing: float, apart: float, sizes: Mapping[str, float]) -> Garment:
    """Both panels as one mesh, with the layers ``apart`` [m]."""
    points, triangles, fronts, sewn = _panel(half, spacing)
    # a side of a triangle that joins two seams would be in both panels, and so in four triangles
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, times = np.unique(sides, axis=0, return_counts=True)
    if np.any(sewn[edges].all(axis=1) & (times > 1)):
        narrow = points[edges[np.argmax(sewn[edges].all(axis=1) & (times > 1))]].mean(axis=0)
        raise ValueError(
            f"spacing={spacing:g}: the {kind} is a single triangle wide at ({narrow[0]:.3g}, {narrow[1]:.3g}) m: give a smaller one"
        )
    # particles row by row, so that neighbors have near numbers: the front's with the seams, then the others of the back
    order = np.lexsort((points[:, 0], np.round(points[:, 1] / spacing)))
    place = np.empty(len(points), np.int64)
    place[order] = np.arange(len(points))
    points, sewn, triangles = points[order], sewn[order], place[triangles]
    has_front = np.zeros(len(points), bool)
    has_front[triangles[fronts]] = True
    front_of = np.where(has_front, np.cumsum(has_front) - 1, -1)
    back_of = np.where(sewn, front_of, has_front.sum() + np.cumsum(~sewn) - 1)
    corners = np.concatenate([front_of[triangles[fronts]], back_of[triangles][:, ::-1]])
    # places: the front above, the back below, the seams between
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    x = np.zeros((back_of.max() + 1, 3))
    for of, height in ((front_of[has_front], apart / 2), (back_of, -apart / 2)):
        own = points[has_front] if height > 0 else points
        x[of, :2], x[of, 2] = own - middle, height
    x[front_of[sewn], 2] = 0
    # the mirrored points, and so the mirrored particles
    image = np.empty(len(points), np.int64)
    image[np.lexsort(points.T)] = np.lexsort((points * [-1, 1]).T)
    mirror = np.empty(len(x), np.int32)
    mirror[back_of] = back_of[image]
    mirror[front_of[has_front]] = front_of[image][has_front]
    key_points: dict[str, int] = {}
    for name, point in [(half.first, half.front[0].points[0]), *((side.key_point, side.points[-1]) for side in half.front)]:
        right = int(front_of[np.argmin(np.sum((points - point) ** 2, axis=1))])
        left = int(mirror[right])
        if name:
            key_points |= {name: right} if left == right else {f"{name}_left": left, f"{name}_right": right}
    front = np.arange(len(corners)) < fronts.sum()
    mesh = _with_free_seams(triangle_mesh(x, corners), x[:, 2] == 0)
    return Garment(kind, mesh, key_points, frozen(front), frozen(mirror), sizes)


def _with_free_seams(mesh: ClothMesh, sewn: NDArray[np.bool_]) -> ClothMesh:
    """The mesh with panels that are flat at rest, and seams that bend freely: no hinges or skip springs across them.

    The garment then rests flat, as if pressed, and all bending models take it.  sewn: which particles lie at seams, (particles,).
    """
    mesh = mesh.with_rest_angles(0.0)
    hinges, springs = mesh.hinges, mesh.springs
    seam = sewn[hinges.particles[:, :2]].all(axis=1)
    across, ends = (np.sort(pairs, axis=1) @ [mesh.num_particles, 1] for pairs in (hinges.particles[seam, 2:], springs.particles))
    kept = (springs.kind != OPPOSITE) | ~np.isin(ends, across)
    return replace(
        mesh,
        springs=Springs(*(frozen(field[kept]) for field in springs)),
        hinges=Hinges(*(frozen(field[~seam]) for field in hinges)),
    )


def _towel(spacing: float, sizes: Mapping[str, float]) -> Garment:
    """One layer of cloth, as a grid."""
    width, length = sizes["width"] * sizes["length"], sizes["length"]
    rows, columns = (max(round(side / spacing), 1) + 1 for side in (length, width))
    mesh = grid(rows, columns, width, length)
    names = ("bottom_left", "bottom_right", "top_left", "top_right")
    mirror = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)[:, ::-1].ravel()
    return Garment(
        "towel", mesh, dict(zip(names, mesh.corners)), frozen(np.ones(len(mesh.triangles), bool)), frozen(mirror), sizes
    )  # fmt: skip

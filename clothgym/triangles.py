"""Floor 1: sheets of triangles: from arrays, from files, and the disk of the drape test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import as_array, check_memory, count, finite, not_negative, positive, shown, warn
from clothgym.mesh import EDGE, OPPOSITE, ClothMesh, Hinges, colored_hinges, colored_springs, frozen
from clothgym.mesh_files import read_polygons
from clothgym.mesh_repair import Repairs, directed_edges, flat_triangles, repaired

USUAL_SIZES = 0.01, 10.0  # of sheets in meters: beyond them a file is probably in another unit [m]
SHUT = 3.0  # angle at rest from which two triangles lie on each other [rad]: the angle may jump between pi and -pi
MILLIMETERS = 200.0  # size from which its unit is rather a millimeter than a centimeter [m]


def triangle_mesh(vertices: ArrayLike, triangles: ArrayLike) -> ClothMesh:
    """A sheet that at rest has the shape of these triangles, flat or not.

    Its edges are springs with the weight ``(A_0 + A_1)/e^2`` of Van Gelder 1998, Approximate simulation of elastic membranes by
    triangulated spring meshes.  They give equilateral triangles the fabric's Young's modulus, and Poisson's ratio 1/3.

    Args:
        vertices: [m], (particles, 3).
        triangles: indices of vertices, (triangles, 3), all with the same side up.

    Raises:
        ValueError: other shapes or types; a triangle without area; an edge of more than two triangles, or of two that disagree on
            which side is up; or a vertex that belongs to no triangle.  The message names it.
    """
    # the edges, and the area of the triangles at each
    x = finite("vertices", vertices)
    corners = _checked(x, triangles)
    edges, inverse = np.unique(np.sort(directed_edges(corners), axis=1), axis=0, return_inverse=True)
    twice = np.linalg.norm(np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]]), axis=1)
    edge_area = np.bincount(inverse, weights=np.tile(twice / 2, 3))
    hinges = _calibrated(colored_hinges(x, corners), x)
    # skip springs between opposite corners at a distance l: they store B kappa^2 / 2 per area where the radius of curvature is l.
    # A spring stores half its constant times (l^3 kappa^2 / 32)^2, on a third of both triangles
    across = hinges.particles[:, 2:]
    span = np.linalg.norm(x[across[:, 1]] - x[across[:, 0]], axis=1)
    area = np.bincount(corners.ravel(), weights=np.repeat(twice / 6, 3), minlength=len(x))
    around = _area_at(hinges.particles[:, :2], edges, edge_area)
    springs = colored_springs(
        x,
        np.concatenate([edges, across]),
        np.repeat([EDGE, OPPOSITE], [len(edges), len(across)]),
        np.concatenate([edge_area / np.sum((x[edges[:, 1]] - x[edges[:, 0]]) ** 2, axis=1), around / 3 / span**4]),
    )
    width, height = np.ptp(x[:, 0]), np.ptp(x[:, 1])
    return ClothMesh(
        (float(width), float(height)), frozen(x.copy()), springs, frozen(corners.astype(np.int32)), frozen(area), hinges
    )


def disc(radius: float, rings: int) -> ClothMesh:
    """A round sheet, flat at z = 0 and centered on the origin; the first particle is the center, and ring ``r`` has ``6 r``.

    Raises:
        ValueError: a radius that is not positive, or fewer than one ring.
    """
    radius, rings = positive("radius", radius), count("rings", rings)
    check_memory(f"rings={rings}", 1 + 3 * rings * (rings + 1))
    # ring by ring: its particles, and the triangles between it and the ring within, in six sectors
    points, triangles = [np.zeros((1, 3))], []
    for ring in range(1, rings + 1):
        angle = np.arange(6 * ring) * 2 * np.pi / (6 * ring)
        points.append(radius * ring / rings * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1))
        inner, outer = 1 + 3 * (ring - 1) * (ring - 2), 1 + 3 * ring * (ring - 1)
        for sector in range(6):
            for k in range(ring):
                a, b = outer + sector * ring + k, outer + (sector * ring + k + 1) % (6 * ring)
                c = inner + (sector * (ring - 1) + k) % (6 * (ring - 1)) if ring > 1 else 0
                triangles.append((a, b, c))
                if k < ring - 1:
                    d = inner + (sector * (ring - 1) + k + 1) % (6 * (ring - 1))
                    triangles.append((b, d, c))
    return triangle_mesh(np.concatenate(points), triangles)


def load_mesh(path: str | Path, scale: float = 1.0, merge_tolerance: float = 0.0) -> ClothMesh:
    """A sheet from a mesh file (obj, ply, off, stl, glb, ...); its shape in the file is its shape at rest.

    Vertices at exactly the same position become one particle.  Faces of any number of corners are cut into triangles, faces and
    vertices that mean nothing are dropped, and triangles that disagree on which side is up are turned round.  One warning says what
    was changed, and ``repairs`` of the mesh says it in numbers, with the particle that each vertex of the file has become.  The
    angles between the triangles of the file are those at rest, until ``ClothMesh.with_rest_angles``.

    Args:
        path: the file.  obj, ply and off are read as they are; other formats need trimesh.
        scale: meters in the file's unit; 0.01 for centimeters.
        merge_tolerance: vertices that are no farther apart are joined as well, on edges that are as short, and where both lie on a
            border, as those of a seam [m].

    Raises:
        ImportError: trimesh is missing, and the format needs it: ``pip install clothgym[mesh]``.
        ValueError: there is no such file, it cannot be read or holds no triangles, or they form no sheet.  The message names the
            file's own vertices and their positions.
    """
    x, triangles, _, repairs = read_triangles(path, "load_mesh", "sheet", positive("scale", scale), merge_tolerance)
    try:
        mesh = replace(triangle_mesh(x, triangles), repairs=repairs)
    except ValueError as error:
        raise ValueError(f"{str(path)!r} is not a sheet: {error}") from error
    # repairs, and probable mistakes
    said, size = repairs.told(), float(np.ptp(x, axis=0).max())
    if mesh.pieces > 1:
        said.append(f"the sheet has {mesh.pieces} pieces that nothing holds together")
    if shut := int(np.sum(np.abs(mesh.hinges.rest_angle) > SHUT)):
        edges = "1 edge is" if shut == 1 else f"{shut} edges are"
        said.append(f"{edges} folded flat at rest, and may flip to the other side: with_rest_angles(above={SHUT:g}) opens them")
    if size > USUAL_SIZES[1]:
        unit, guess = ("millimeters", 0.001) if size >= MILLIMETERS else ("centimeters", 0.01)
        said.append(
            f"the sheet is {size:.4g} m across, as files are in meters: give scale={scale * guess:g} if this one is in {unit}"
        )
    elif size < USUAL_SIZES[0]:
        said.append(f"the sheet is {size:.4g} m across, as files are in meters: give scale= if this one is in a larger unit")
    if said:
        warn(f"{str(path)!r}: {'; '.join(said)}")
    return mesh


def read_triangles(
    path: str | Path, who: str, what: str, scale: float = 1.0, merge_tolerance: float = 0.0
) -> tuple[NDArray, NDArray, NDArray, Repairs]:
    """Vertices [m], (vertices, 3), triangles, (triangles, 3), the file's numbers of the vertices, (vertices,), and the repairs.

    who, what: the caller and the kind of object that it reads, for error messages.  Others: see ``load_mesh``.

    Raises:
        ImportError: trimesh is missing.
        ValueError: there is no such file, it cannot be read or holds no triangles, or they form no surface, see ``repaired``.
    """
    tolerance = not_negative("merge_tolerance", merge_tolerance)
    polygons = read_polygons(path, who, what)
    try:
        return repaired(polygons, scale, tolerance)
    except ValueError as error:
        raise ValueError(f"{str(path)!r} is not a {what}: {error}") from error


def _calibrated(hinges: Hinges, x: NDArray) -> Hinges:
    """The hinges with their weights scaled by a common factor, so that cylinders store B kappa^2 / 2 per area.

    This is the mean over the directions of the cylinders.  A hinge stands for a third of both its triangles.  Unfold these into a
    plane with x along the edge.  A surface of curvature K then turns the hinge by ``a K_xx + b K_yy + 2 c K_xy``.  For a cylinder
    the mean square of this over all directions is ``3/8 (a^2 + b^2) + ab/4 + c^2/2``, times kappa^2.
    """
    # both opposite corners in the plane of the unfolded triangles
    xi, xj, xk, xl = (x[hinges.particles[:, c]] for c in range(4))
    length = np.linalg.norm(xj - xi, axis=1)
    along = (xj - xi) / length[:, None]
    unfolded = []
    for corner, side in ((xk, 1), (xl, -1)):
        foot = np.sum((corner - xi) * along, axis=1)
        unfolded.append((foot, side * np.sqrt(np.maximum(np.sum((corner - xi) ** 2, axis=1) - foot**2, 0))))
    zero = np.zeros_like(length)
    px = np.stack([zero, length, unfolded[0][0], unfolded[1][0]], axis=1)
    py = np.stack([zero, zero, unfolded[0][1], unfolded[1][1]], axis=1)
    # the turn of each hinge, and its mean square
    a, b, c = (np.sum(hinges.slopes * q, axis=1) / 2 for q in (px * px, py * py, px * py))
    square = 3 / 8 * (a * a + b * b) + a * b / 4 + c * c / 2
    area = (length * (np.abs(py[:, 2]) + np.abs(py[:, 3])) / 2).sum() / 3
    return hinges._replace(weight=frozen(hinges.weight * (area / max((hinges.weight * square).sum(), 1e-300))))


def _area_at(ends: NDArray, edges: NDArray, area: NDArray) -> NDArray:
    """Area of the triangles at the edges with these ends [m^2], (len(ends),); edges and their areas are sorted by ends."""
    size = edges.max() + 1
    ends = np.sort(ends, axis=1).astype(np.int64)
    return area[np.searchsorted(edges[:, 0] * size + edges[:, 1], ends[:, 0] * size + ends[:, 1])]


def corners_of(x: NDArray, triangles: ArrayLike) -> NDArray[np.int64]:
    """``triangles`` as int64, (triangles, 3), if each vertex of x, (vertices, 3), is in one of them.

    Raises:
        ValueError: other shapes or types, an index that is out of range, or a vertex in no triangle.
    """
    if x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise ValueError(f"vertices have shape {x.shape}: must be (particles, 3)")
    corners = triples(x, triangles)
    loose = np.setdiff1d(np.arange(len(x)), corners)
    if len(loose):
        raise ValueError(f"vertex {loose[0]} belongs to no triangle: remove it ({len(loose)} such vertices)")
    return corners


def triples(x: NDArray, triangles: ArrayLike) -> NDArray[np.int64]:
    """``triangles`` as int64, (triangles, 3), if they name vertices of x, (vertices, 3).

    Raises:
        ValueError: other shapes or types, or an index that is out of range.
    """
    corners = as_array(triangles)
    if corners is None:
        raise ValueError(f"triangles={shown(triangles)}: must be (triangles, 3) integers")
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or corners.dtype.kind not in "iu":
        raise ValueError(f"triangles have shape {corners.shape} of {corners.dtype}: must be (triangles, 3) integers")
    if corners.min() < 0 or corners.max() >= len(x):
        wrong = int(np.flatnonzero((corners < 0).any(axis=1) | (corners >= len(x)).any(axis=1))[0])
        raise ValueError(f"triangle {wrong} is {corners[wrong].tolist()}: must name vertices from 0 to {len(x) - 1}")
    return corners.astype(np.int64)


def refuse_degenerate(x: NDArray, corners: NDArray) -> None:
    """Refuse triangles without area.

    Raises:
        ValueError: a triangle without area, see ``flat_triangles``; the message names it.
    """
    flat = flat_triangles(x, corners)
    if np.any(flat):
        worst = int(np.flatnonzero(flat)[0])
        raise ValueError(f"triangle {worst}, {corners[worst].tolist()}, is degenerate (no area): remove it, or merge its corners")


def _checked(x: NDArray, triangles: ArrayLike) -> NDArray[np.int64]:
    """``triangles`` as int64, (triangles, 3), if they form a sheet.

    Raises:
        ValueError: they do not, see ``triangle_mesh``.
    """
    # each triangle has an area, and is there once
    corners = corners_of(x, triangles)
    refuse_degenerate(x, corners)
    _, first, again = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True)
    if np.any(again > 1):
        twin = corners[first[np.argmax(again > 1)]].tolist()
        raise ValueError(f"triangle {twin} is there {again.max()} times: remove all but one")
    # each directed edge belongs to one triangle
    directed, times = np.unique(directed_edges(corners), axis=0, return_counts=True)
    if np.any(times > 1):
        a, b = directed[np.argmax(times > 1)].tolist()
        total = int(np.sum(np.all(np.sort(directed_edges(corners), axis=1) == sorted((a, b)), axis=1)))
        if total > 2:
            raise ValueError(f"edge {a}-{b} belongs to {total} triangles: a sheet's has one or two, remove the others")
        raise ValueError(f"the triangles at edge {a}-{b} have opposite orientations: flip one of them")
    return corners

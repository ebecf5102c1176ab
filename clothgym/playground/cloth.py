"""One sheet as the page draws it: a smooth surface through the particles, in the stripes of its weave, with a hem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.mesh import ClothMesh
from clothgym.playground.colors import mixed
from clothgym.render import Drawn
from clothgym.render.renderer import DEEPEST, HIGHEST_LIFT
from clothgym.render.solids import Color
from clothgym.render.surface import Surface, place_vertices, plain_surface, push_out, smooth_surface

CELLS = 48  # along the longer side of the drawn surface, at least
STRIPES = 12  # along the longer side, as in pictures
CHECKED = 0.6  # share of the light color in a light stripe, as in pictures
DARK, DARK_BACK = (70, 76, 98), (58, 60, 78)  # the sheet where something else is colored
TONES = (0.0, 0.5, 1.0)  # lightness where two dark stripes, a dark and a light one, and two light ones cross
HEM = (40, 30, 34), 0.22  # color and share of it in the seam around the sheet


class Part(NamedTuple):
    """Cells of one tone: the drawn vertices that they use, (vertices,), and triangles of these, (triangles, 3)."""

    vertices: NDArray[np.int64]
    triangles: NDArray[np.int32]


def surface_of(mesh: ClothMesh) -> Surface:
    """The surface that is drawn: smooth for a grid."""
    uv = np.ascontiguousarray(mesh.rest_positions[:, :2], np.float32)
    triangles = np.ascontiguousarray(mesh.triangles, np.int32)
    if mesh.shape is None:
        return plain_surface(triangles, uv)
    return smooth_surface(triangles, uv, mesh.shape, CELLS)


def parts_of(surface: Surface, mesh: ClothMesh) -> list[Part]:
    """The surface cut into its dark, middle and light cells, and the hem; a mesh that is no grid is all dark."""
    triangles = surface.triangles
    if mesh.shape is None:
        tones = np.zeros(len(triangles), int)
    else:
        rows, columns = (side - 1 for side in mesh.shape)
        factor = max(1, -(-CELLS // max(rows, columns)))
        row, column = np.divmod(np.arange(rows * columns * factor**2), columns * factor)
        stripe = max(1, round(max(rows, columns) * factor / STRIPES))
        cells = row // stripe % 2 + column // stripe % 2
        edge = (row == 0) | (row == rows * factor - 1) | (column == 0) | (column == columns * factor - 1)
        tones = np.repeat(np.where(edge, len(TONES), cells), 2)
    parts = []
    for tone in range(len(TONES) + 1):
        vertices, own = np.unique(triangles[tones == tone], return_inverse=True)
        parts.append(Part(vertices, own.reshape(-1, 3).astype(np.int32)))
    return parts


class DrawnSheet:
    """The nodes of one sheet in a viewer's scene.

    Args:
        scene: viser's, or a null viewer's.
        name: of the nodes.
        x: positions of the particles [m], (particles, 3).
        held: called with each event of a drag on the sheet.
    """

    def __init__(self, scene: Any, name: str, mesh: ClothMesh, x: NDArray, held: Callable[[Any], Any]) -> None:
        self.surface = surface_of(mesh)
        self.parts = parts_of(self.surface, mesh)
        self.x = np.empty((len(self.surface.uv), 3), np.float32)
        self.palette: list[tuple[Color, Color]] = [(DARK, DARK_BACK)] * len(self.parts)
        self._place(x, ())
        self.nodes: list[tuple[int, int, Any]] = []
        for number, part in enumerate(self.parts):
            for side, side_name in enumerate(("front", "back")) if len(part.vertices) else ():
                node = scene.add_mesh_simple(
                    f"/{name}/{side_name}{number}", self.x[part.vertices], part.triangles, color=DARK, side=side_name
                )
                node.on_drag("left")(held)
                self.nodes.append((number, side, node))

    def wear(self, front: Color, back: Color, light: Color) -> None:
        """Take on the colors of a fabric."""
        self.palette = []
        for tone in TONES:
            share = CHECKED * tone
            self.palette.append((mixed(front, light, share), mixed(back, light, share)))
        self.palette.append((mixed(front, *HEM), mixed(back, *HEM)))

    def draw(self, x: NDArray, solids: Sequence[Drawn], plain: bool) -> None:
        """Show the sheet at its particles' positions [m]; plain: dark, so that what is drawn upon it is seen."""
        self._place(x, solids)
        for number, side, node in self.nodes:
            node.vertices = self.x[self.parts[number].vertices]
            color = (DARK, DARK_BACK)[side] if plain else self.palette[number][side]
            if tuple(node.color) != color:
                node.color = color

    def _place(self, x: NDArray, solids: Sequence[Drawn]) -> None:
        """Set the drawn vertices, none of which lies in a solid that the particles rest upon."""
        place_vertices(np.ascontiguousarray(x, np.float32), self.surface.index, self.surface.weight, self.x)
        lift = min(0.6 * self.surface.cell, HIGHEST_LIFT)
        for solid in (solid for solid in solids if lift > 0 and solid.kind != "mesh"):
            (axes, half, radius), center = solid.rounded_box(), tuple(map(float, solid.collider.center))
            if axes[2, 2] == 1:  # turned about z alone
                push_out(self.x, len(self.x), center, axes[0, 0], axes[0, 1], tuple(half.tolist()), radius, lift, DEEPEST)

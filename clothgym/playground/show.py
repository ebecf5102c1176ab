"""A frame as nodes of a viewer's scene: sheets, threads, solids, and held points."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.forces import structural_strain
from clothgym.mesh import SHEAR, ClothMesh
from clothgym.playground.recording import Frame, Recording
from clothgym.render import Drawn
from clothgym.render.renderer import DEEPEST, HIGHEST_LIFT
from clothgym.render.shading import CORAL, CREAM, INDIGO
from clothgym.render.solids import Color, linear_color
from clothgym.render.surface import Surface, place_vertices, plain_surface, push_out, smooth_surface, vertex_normals

# colors of compressed, idle and loaded springs: at minus one, zero, a third, two thirds and the whole of the scale
STOPS = np.array([-1.0, 0.0, 0.33, 0.66, 1.0])
RAMP = np.array([(84, 150, 255), (112, 118, 138), (255, 206, 92), (255, 122, 40), (232, 20, 56)], float)
LINEAR = (255 * linear_color(range(256)) + 0.5).astype(np.uint8)
# front and back of a fabric, and of its lighter stripes; others are the renderer's gingham
GINGHAM = (CORAL, INDIGO, CREAM)
FABRICS: dict[str, tuple[Color, Color, Color]] = {
    "denim": ((44, 66, 118), (150, 168, 196), (78, 102, 156)),
    "silk": ((226, 178, 84), (238, 206, 140), (250, 232, 184)),
    "wool": ((92, 104, 84), (116, 122, 104), (150, 152, 128)),
    "wool_tropical": ((104, 96, 110), (128, 120, 132), (168, 160, 168)),
    "polyester": ((40, 132, 140), (84, 160, 164), (206, 236, 232)),
}
# where a scale may end: round numbers of percent
ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)


def ramp(values: NDArray) -> NDArray[np.uint8]:
    """sRGB colors of shares of the scale, (...) to (..., 3)."""
    return np.stack([np.interp(values, STOPS, RAMP[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)


def linear(colors: NDArray) -> NDArray[np.uint8]:
    """sRGB as linear light, in which a browser expects the colors of lines."""
    return LINEAR[colors]


def mixed(first: Color, second: Color, share: float) -> Color:
    """A color between two, as light mixes."""
    light = linear_color(first) * (1 - share) + linear_color(second) * share
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return tuple(int(c) for c in np.round(255 * encoded))  # type: ignore[return-value]


def round_up(value: float) -> float:
    """The next round number."""
    if not value > 0:
        return 0.0
    unit = 10.0 ** np.floor(np.log10(value))
    return next((step * unit for step in ROUND if step * unit >= value), 10 * unit)


# --- a frame ----------------------------------------------------------------------------------------------------------


MODES = ("fabric", "strain")
HOLD = (36, 44, 70)  # color of held points
GROUND, SKY, HORIZON = (236, 232, 225), (222, 228, 236), (247, 245, 241)
INSET = 0.003  # solids are drawn smaller by this: the sheet's triangles are chords of round solids [m]
BOLD, RAISED = 0.0042, 0.003  # thickness of threads, and how high they lie on the drawn surface [m]
CELLS = 48  # along the longer side of the drawn surface, at least
STRIPES = 12  # along the longer side, as in pictures
CHECKED = 0.6  # share of the light color in a light stripe, as in pictures
DARK, DARK_BACK = (70, 76, 98), (58, 60, 78)  # the sheet where its threads are colored
TONES = (0.0, 0.5, 1.0)  # lightness where two dark stripes, a dark and a light one, and two light ones cross
HEM = (40, 30, 34), 0.22  # color and share of it in the seam around the sheet
LIT = 0.25  # share of the scale from which on a thread lights up in the fabric's own colors
SHRINKS, STEADY = 0.4, 45  # share of the scale below which all strains must be, and for how many frames, for it to end earlier
LEAST = 0.005  # strain at which a scale ends at least
Held = Callable[[str, NDArray, NDArray], None]


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
    """The nodes of one sheet: a smooth surface through the particles, in the stripes of its weave, with a hem.

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
        self.palette: list[tuple[Color, Color]] = []
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
        shares = [CHECKED * tone for tone in TONES]
        self.palette = [(mixed(front, light, share), mixed(back, light, share)) for share in shares]
        self.palette.append((mixed(front, *HEM), mixed(back, *HEM)))

    def draw(self, x: NDArray, solids: Sequence[Drawn], plain: bool) -> None:
        """Show the sheet at its particles' positions [m]; plain: dark, so that drawings on top are visible."""
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


class Show:
    """The nodes of one recording in a viewer's scene.

    Args:
        scene: viser's, or a null viewer's.
        held: called with the phase of a drag on the sheet ("start", "update" or "end"), where it began and where it is [m].

    Attributes:
        strained: strain at which the colors of threads end.
    """

    def __init__(self, scene: Any, recording: Recording, held: Held) -> None:
        self.scene, self.recording = scene, recording
        self.strained, self._small = recording.strained, 0
        scene.reset()
        scene.set_background_image(sky(), format="png")  # for each visitor: a reset removes the shared one
        scene.add_grid(
            "/ground", 8.0, 8.0, cell_size=0.1, section_size=0.5, cell_color=(226, 221, 213), section_color=(208, 202, 193),
            cell_thickness=0.6, section_thickness=1.0, plane_color=GROUND, plane_opacity=1.0, shadow_opacity=0.3,
            fade_distance=9.0, fade_strength=1.5, fade_from="origin",
        )  # fmt: skip
        x, mesh = recording.frames[0].positions, recording.mesh

        async def grabbed(event: Any) -> None:  # async, since threads of a pool would not keep the order
            held(event.phase, np.array(event.start_position, float), np.array(event.end_position, float))

        self.sheets = [DrawnSheet(scene, f"sheet{number}", mesh, one, grabbed) for number, one in enumerate(x)]
        self.wear("")
        self._ends = mesh.springs.particles[mesh.springs.kind < SHEAR]
        points = x[0][self._ends]
        self.threads = [
            scene.add_line_segments(f"/threads{number}", points, np.zeros_like(points, np.uint8), thickness=BOLD)
            for number in range(len(self.sheets))
        ]
        self._dots = scene.add_point_cloud(
            "/held", np.zeros((1, 3)), HOLD, point_size=0.02, point_shape="circle", precision="float32", visible=False
        )
        self._solids: dict[Drawn, list[Any]] = defaultdict(list)

    def wear(self, fabric: str) -> None:
        """Show another fabric."""
        for sheet in self.sheets:
            sheet.wear(*FABRICS.get(fabric, GINGHAM))

    def draw(self, frame: Frame, mode: str, eye: ArrayLike) -> None:
        """Show a frame, colored by one of ``MODES``; eye: where it is seen from [m], (3,)."""
        strains = structural_strain(self.recording.mesh, frame.positions.astype(np.float64))
        self._fit(strains[~np.isnan(frame.readings["strain"])])
        for sheet, lines, x, strain in zip(self.sheets, self.threads, frame.positions, strains):
            sheet.draw(x, frame.solids, mode == "strain")
            points = (x + RAISED * toward(eye, x, self.recording.mesh.triangles))[self._ends]
            shares = strain / self.strained
            if mode == "fabric":
                # threads light up where they are strained; a thread without length is not drawn
                points[shares < LIT] = points[shares < LIT, :1]
            lines.points = points
            lines.colors = np.repeat(linear(ramp(shares))[:, None], 2, axis=1)
        self._place(frame.solids)

    def _fit(self, strains: NDArray) -> None:
        """Let the scale end at a round number above the largest strain; it grows at once, and shrinks later."""
        if strains.size:
            largest = float(strains.max())
            self._small = self._small + 1 if largest < SHRINKS * self.strained else 0
            if largest > self.strained or self._small > STEADY:
                self.strained, self._small = max(round_up(largest), LEAST), 0

    def draw_held(self, points: NDArray) -> None:
        """Mark where the sheets are held [m], (points, 3)."""
        self._dots.visible = bool(len(points))
        if len(points):
            self._dots.points = points

    def _place(self, solids: Sequence[Drawn]) -> None:
        """Each solid has a node of its shape; those without a solid now are hidden."""
        used: dict[Drawn, int] = defaultdict(int)
        for solid in solids:
            shape = solid.at_origin
            nodes = self._solids[shape]
            if used[shape] == len(nodes):
                mesh = shape.mesh()
                name = f"/solids/{sum(map(len, self._solids.values()))}"
                vertices = mesh.positions - INSET * mesh.normals
                nodes.append(self.scene.add_mesh_simple(name, vertices, mesh.triangles, color=solid.color, flat_shading=False))
            node = nodes[used[shape]]
            node.position, node.visible = solid.collider.center, True
            used[shape] += 1
        for shape, nodes in self._solids.items():
            for node in nodes[used[shape] :]:
                node.visible = False


def toward(eye: ArrayLike, x: NDArray, triangles: NDArray) -> NDArray[np.float32]:
    """Unit normals at particles on that side of the sheet which an eye sees, (particles, 3); x: [m], (particles, 3)."""
    normals = np.empty((len(x), 3), np.float32)
    vertex_normals(np.ascontiguousarray(x, np.float32), triangles, normals)
    return normals * np.where(np.sum((np.asarray(eye) - x) * normals, axis=1) < 0, -1, 1).astype(np.float32)[:, None]


def furnish(scene: Any) -> None:
    """Set up the light, which all visitors share: a lamp whose shadows are seen, the sky and the floor."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)  # softer, but slow without a graphics card
    scene.add_light_directional("/lamp", color=(255, 246, 232), intensity=2.3, cast_shadow=True, position=(-1.1, -1.5, 2.6))
    scene.add_light_directional("/fill", color=(226, 234, 255), intensity=0.5, position=(1.6, -1.0, 0.8))
    scene.add_light_hemisphere("/sky", sky_color=HORIZON, ground_color=GROUND, intensity=1.5)
    scene.world_axes.visible = False


def sky() -> NDArray[np.uint8]:
    """A soft background, (256, 8, 3)."""
    height = np.linspace(0, 1, 256)[:, None]
    colors = np.round(np.array(SKY) * (1 - height) + np.array(HORIZON) * height)
    return np.broadcast_to(colors[:, None], (256, 8, 3)).astype(np.uint8)

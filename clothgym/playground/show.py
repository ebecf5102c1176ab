"""A frame as nodes of a viewer's scene: sheets, yarns, solids, particles in contact, and handles to drag."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.integrators import INTEGRATORS
from clothgym.mesh import EDGE, STRUCTURAL_X
from clothgym.playground.recording import Frame, Recording, strains, tensions, yarns
from clothgym.playground.stage import UNLIMITED, Attachment
from clothgym.render import Drawn
from clothgym.render.shading import CORAL, INDIGO
from clothgym.render.solids import linear_color

MODES = ("fabric", "strain", "tension", "contact")
DARK, DARK_BACK = (70, 76, 98), (58, 60, 78)  # the sheet where something else is colored
WEAVE = (232, 156, 138)  # yarns in the mode "fabric"
TOUCH, HOLD = (240, 140, 30), (250, 200, 60)  # particles that touch a solid, and anchored ones
# colors of compressed, idle and loaded springs: at minus one, zero, a third, two thirds and the whole of the scale
STOPS = np.array([-1.0, 0.0, 0.33, 0.66, 1.0])
RAMP = np.array([(84, 150, 255), (112, 118, 138), (255, 206, 92), (255, 122, 40), (232, 20, 56)], float)
IDLE = (112, 118, 138)
PALE = 225  # gray mixed into the color of a sheet without the strain limit
GROUND, SKY, HORIZON = (236, 232, 225), (222, 228, 236), (247, 245, 241)
LINEAR = (255 * linear_color(range(256)) + 0.5).astype(np.uint8)
INSET = 0.003  # solids are drawn smaller by this: the sheet's triangles are chords of round solids [m]
LIGHT = 0.8  # intensity of the ambient light
THIN, BOLD = 0.0016, 0.0042  # thickness of yarns [m]


def ramp(values: NDArray) -> NDArray[np.uint8]:
    """sRGB colors of shares of the scale, (...) to (..., 3)."""
    return np.stack([np.interp(values, STOPS, RAMP[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)


def linear(colors: NDArray) -> NDArray[np.uint8]:
    """sRGB as linear light, in which a browser expects the colors of lines."""
    return LINEAR[colors]


def spring_values(recording: Recording, frame: Frame, sheet: int, mode: str, springs: NDArray) -> tuple[NDArray, float]:
    """Strains, or tensions [N], of a sheet's springs, and the end of their scale."""
    x, mesh = frame.positions[sheet], recording.mesh
    if mode == "tension":
        kind = EDGE if mesh.shape is None else STRUCTURAL_X
        full = recording.strained * frame.stiffness[sheet, kind] * float(np.median(mesh.springs.rest_length[yarns(mesh)]))
        return tensions(mesh, x, springs, frame.stiffness[sheet]), full
    return strains(mesh, x, springs), recording.strained


def own_color(label: str) -> tuple[int, int, int] | None:
    """Color of a compared sheet: that of its integrator, paler without a strain limit; None if the label is not an integrator."""
    method = INTEGRATORS.get(label.removesuffix(UNLIMITED))
    if method is None:
        return None
    red, green, blue = (int(method.color[k : k + 2], 16) for k in (1, 3, 5))
    if label.endswith(UNLIMITED):
        red, green, blue = (round(0.35 * c + 0.65 * PALE) for c in (red, green, blue))
    return red, green, blue


def sides(label: str, compared: bool) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Colors of a sheet's front and back: those of the fabric, or its own if several are compared."""
    front = own_color(label) if compared else None
    return (CORAL, INDIGO) if front is None else (front, tuple(round(0.6 * c) for c in front))  # type: ignore[return-value]


class Show:
    """The nodes of one recording in a viewer's scene.

    Args:
        scene: viser's, or a null viewer's.
        dragged: called with an attachment and its position [m], (3,), while it is dragged, and with None at the end.
    """

    def __init__(self, scene: Any, recording: Recording, dragged: Callable[[int, NDArray | None], None]) -> None:
        self.scene, self.recording, self._dragged = scene, recording, dragged
        self._held: set[int] = set()  # attachments that the visitor drags now
        scene.reset()
        scene.set_background_image(sky(), format="png")  # for each visitor: a reset removes the shared one
        scene.add_grid(
            "/ground", 8.0, 8.0, cell_size=0.1, section_size=0.5, cell_color=(226, 221, 213), section_color=(208, 202, 193),
            cell_thickness=0.6, section_thickness=1.0, plane_color=GROUND, plane_opacity=1.0, shadow_opacity=0.22,
            fade_distance=9.0, fade_strength=1.5, fade_from="origin",
        )  # fmt: skip
        frame, mesh = recording.frames[0], recording.mesh
        compared = len(recording.labels) > 1
        self._sheets = []
        for number, (label, x) in enumerate(zip(recording.labels, frame.positions)):
            colors = sides(label, compared)
            pair = [
                scene.add_mesh_simple(f"/sheet{number}/{side}", x, mesh.triangles, color=color, side=side)
                for side, color in zip(("front", "back"), colors)
            ]
            self._sheets.append((pair, colors))
        springs = yarns(mesh)
        points = frame.positions[0][mesh.springs.particles[springs]]
        self._yarns = [
            scene.add_line_segments(f"/sheet{number}/yarns", points, np.zeros_like(points, np.uint8), thickness=THIN)
            for number in range(len(self._sheets))
        ]
        self._dots = {
            name: scene.add_point_cloud(
                f"/{name}", np.zeros((1, 3)), color, point_size=size, point_shape="circle", precision="float32", visible=False
            )
            for name, color, size in (("touching", TOUCH, 0.011), ("held", HOLD, 0.018))
        }
        self._solids: dict[Drawn, list[Any]] = defaultdict(list)
        self._handles: dict[int, Any] = {}

    def draw(self, frame: Frame, mode: str, diagonals: bool = False) -> None:
        """Show a frame, colored by one of ``MODES``."""
        mesh = self.recording.mesh
        springs = yarns(mesh, diagonals)
        bold = mode in ("strain", "tension")
        for number, ((pair, colors), lines) in enumerate(zip(self._sheets, self._yarns)):
            x = frame.positions[number]
            for node, color, dark in zip(pair, colors, (DARK, DARK_BACK)):
                node.vertices = x
                node.color = color if mode == "fabric" else dark
            lines.points = x[mesh.springs.particles[springs]]
            lines.thickness = BOLD if bold else THIN
            if bold:
                values, full = spring_values(self.recording, frame, number, mode, springs)
                lines.colors = np.repeat(linear(ramp(values / full))[:, None], 2, axis=1)
            else:
                weave = WEAVE if mode == "fabric" else IDLE
                if mode == "fabric" and len(self._sheets) > 1:
                    weave = tuple(round(0.75 * c + 60) for c in colors[0])  # type: ignore[assignment]
                lines.colors = np.broadcast_to(linear(np.array(weave)), (len(springs), 2, 3))
        self._dot("touching", frame.positions[frame.touching] if mode == "contact" else np.zeros((0, 3)))
        self._place(frame.solids)

    def _dot(self, name: str, points: NDArray) -> None:
        self._dots[name].visible = bool(len(points))
        if len(points):
            self._dots[name].points = np.asarray(points, np.float32)

    def _place(self, solids: Sequence[Drawn]) -> None:
        """Each solid has a node of its shape; those without a solid now are hidden."""
        used: dict[Drawn, int] = defaultdict(int)
        for solid in solids:
            shape = solid.at_origin
            nodes = self._solids[shape]
            if used[shape] == len(nodes):
                mesh = shape.mesh()
                name = f"/solids/{len(self._solids)}_{len(nodes)}"
                nodes.append(
                    self.scene.add_mesh_simple(
                        name, mesh.positions - INSET * mesh.normals, mesh.triangles, color=solid.color, flat_shading=False
                    )
                )
            node = nodes[used[shape]]
            node.position, node.visible = solid.collider.center, True
            used[shape] += 1
        for shape, nodes in self._solids.items():
            for node in nodes[used[shape] :]:
                node.visible = False

    def draw_attachments(self, attachments: Sequence[Attachment], draggable: bool) -> None:
        """Mark what is held, and show a handle at each attachment that can be dragged, if wanted."""
        self._dot("held", np.array([attachment.position for attachment in attachments if attachment.holds]).reshape(-1, 3))
        for number, attachment in enumerate(attachments):
            wanted = draggable and attachment.draggable
            if wanted and number not in self._handles:
                self._handles[number] = self._made_handle(number, attachment)
            if number in self._handles:
                self._handles[number].visible = wanted
                if number not in self._held:
                    self._handles[number].position = tuple(float(c) for c in attachment.position)

    def _made_handle(self, number: int, attachment: Attachment) -> Any:
        handle = self.scene.add_transform_controls(
            f"/attachments/{number}", scale=0.09, line_width=3.0, disable_rotations=True, depth_test=False, opacity=0.85,
            position=tuple(float(c) for c in attachment.position),
        )  # fmt: skip

        @handle.on_update
        async def _(event: Any) -> None:  # async, since threads of a pool would not keep the order
            if event.phase == "end":
                self._held.discard(number)
                self._dragged(number, None)
            else:
                self._held.add(number)
                self._dragged(number, np.array(event.target.position))

        return handle


def furnish(scene: Any) -> None:
    """Set up the ambient light, which all visitors share."""
    # an environment map would be softer, but is slow without a graphics card
    scene.add_light_hemisphere("/sky", sky_color=HORIZON, ground_color=GROUND, intensity=LIGHT)
    scene.world_axes.visible = False


def sky() -> NDArray[np.uint8]:
    """A soft background, (256, 8, 3)."""
    height = np.linspace(0, 1, 256)[:, None]
    return (
        np.broadcast_to(np.round(np.array(SKY) * (1 - height) + np.array(HORIZON) * height), (256, 3))[:, None]
        .repeat(8, 1)
        .astype("u1")
    )

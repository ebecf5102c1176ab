"""A frame as nodes of a viewer's scene: sheets, threads, solids, particles in contact, handles to drag, and what is said of it."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.playground.cloth import DrawnSheet
from clothgym.playground.colors import IDLE, LIT, Scale, linear, ramp, sides, spring_values
from clothgym.playground.recording import Frame, Recording, yarns
from clothgym.playground.sheets import Attachment
from clothgym.render import Drawn
from clothgym.render.surface import vertex_normals

MODES = ("fabric", "strain", "tension", "contact")
TOUCH, HOLD, PIN = (240, 140, 30), (250, 200, 60), (36, 44, 70)  # particles that touch a solid, anchored ones, and pinned ones
GROUND, SKY, HORIZON = (236, 232, 225), (222, 228, 236), (247, 245, 241)
INSET = 0.003  # solids are drawn smaller by this: the sheet's triangles are chords of round solids [m]
THIN, BOLD, RAISED = 0.0016, 0.0042, 0.003  # thickness of threads, and how high they lie on the drawn surface [m]
ABOVE, LINE = 0.06, 52  # height of what is said above the sheets [m], and letters in a line of it
Dragged = Callable[[int, NDArray | None], None]
Held = Callable[[str, NDArray, NDArray], None]


class Show:
    """The nodes of one recording in a viewer's scene.

    Args:
        scene: viser's, or a null viewer's.
        fabric: of the sheets, unless they are of several.
        dragged: called with an attachment and its position [m], (3,), while it is dragged, and with None at the end.
        held: called with the phase of a drag on the sheet ("start", "update" or "end"), where it began and where it is [m].
    """

    def __init__(self, scene: Any, recording: Recording, fabric: str, dragged: Dragged, held: Held) -> None:
        self.scene, self.recording, self._dragged = scene, recording, dragged
        self.scale = Scale(recording.strained)
        self._held: set[int] = set()  # attachments that the visitor drags now
        scene.reset()
        scene.set_background_image(sky(), format="png")  # for each visitor: a reset removes the shared one
        scene.add_grid(
            "/ground", 8.0, 8.0, cell_size=0.1, section_size=0.5, cell_color=(226, 221, 213), section_color=(208, 202, 193),
            cell_thickness=0.6, section_thickness=1.0, plane_color=GROUND, plane_opacity=1.0, shadow_opacity=0.3,
            fade_distance=9.0, fade_strength=1.5, fade_from="origin",
        )  # fmt: skip
        frame, mesh = recording.frames[0], recording.mesh

        async def grabbed(event: Any) -> None:  # async, since threads of a pool would not keep the order
            held(event.phase, np.array(event.start_position, float), np.array(event.end_position, float))

        self.sheets = [DrawnSheet(scene, f"sheet{number}", mesh, x, grabbed) for number, x in enumerate(frame.positions)]
        self.wear(fabric)
        springs = yarns(mesh)
        points = frame.positions[0][mesh.springs.particles[springs]]
        self.threads = [
            scene.add_line_segments(f"/threads{number}", points, np.zeros_like(points, np.uint8), thickness=THIN)
            for number in range(len(self.sheets))
        ]
        self._dots = {
            name: scene.add_point_cloud(
                f"/{name}", np.zeros((1, 3)), color, point_size=size, point_shape="circle", precision="float32", visible=False
            )
            for name, color, size in (("touching", TOUCH, 0.011), ("held", HOLD, 0.018), ("pinned", PIN, 0.02))
        }
        self._said: tuple[str, Any] = "", None
        self._solids: dict[Drawn, list[Any]] = defaultdict(list)
        self._handles: dict[int, Any] = {}

    def wear(self, fabric: str) -> None:
        """Show another fabric, on sheets that have no color of their own."""
        for sheet, label in zip(self.sheets, self.recording.labels):
            sheet.wear(*sides(label, len(self.sheets) > 1, fabric))

    def draw(self, frame: Frame, mode: str, diagonals: bool = False, eye: ArrayLike = (0.0, 0.0, 9.0)) -> None:
        """Show a frame, colored by one of ``MODES``; eye: where it is seen from [m], (3,)."""
        mesh = self.recording.mesh
        springs = yarns(mesh, diagonals)
        self.scale.fit(self.recording, frame)
        for number, (sheet, lines) in enumerate(zip(self.sheets, self.threads)):
            x = frame.positions[number]
            sheet.draw(x, frame.solids, mode in ("strain", "tension"))
            points = (x + RAISED * toward(eye, x, mesh.triangles))[mesh.springs.particles[springs]]
            shares = spring_values(self.recording, frame, number, mode, springs)
            shares = shares / self.scale.end(self.recording, frame, number, mode)
            colors = np.broadcast_to(np.array(IDLE), (len(springs), 3)) if mode == "contact" else ramp(shares)
            if mode == "fabric":
                # threads light up where they are strained; a thread without length is not drawn
                points[shares < LIT] = points[shares < LIT, :1]
            lines.points = points
            lines.thickness = THIN if mode == "contact" else BOLD
            lines.colors = np.repeat(linear(colors)[:, None], 2, axis=1)
        self._dot("touching", frame.positions[frame.touching] if mode == "contact" else np.zeros((0, 3)))
        self._place(frame.solids)

    def say(self, words: str, frame: Frame) -> None:
        """Let a sentence stand over the sheets, or nothing."""
        if self._said[0] == words:
            return
        if self._said[1] is not None:
            self._said[1].remove()
        label = None
        if words:
            x = frame.positions.reshape(-1, 3)
            above = (float(x[:, 0].mean()), float(x[:, 1].mean()), float(x[:, 2].max()) + ABOVE)
            lines = "\n".join(textwrap.wrap(words.replace("*", ""), LINE))
            label = self.scene.add_label("/said", lines, position=above, anchor="bottom-center")
        self._said = words, label

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
                name = f"/solids/{sum(map(len, self._solids.values()))}"
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

    def draw_held(self, attachments: Sequence[Attachment], draggable: bool, pinned: NDArray) -> None:
        """Mark what is held and pinned, and show a handle at each attachment that can be dragged, if wanted."""
        self._dot("held", np.array([attachment.position for attachment in attachments if attachment.holds]).reshape(-1, 3))
        self._dot("pinned", pinned)
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
        async def _(event: Any) -> None:
            if event.phase == "end":
                self._held.discard(number)
                self._dragged(number, None)
            else:
                self._held.add(number)
                self._dragged(number, np.array(event.target.position))

        return handle


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
    return (
        np.broadcast_to(np.round(np.array(SKY) * (1 - height) + np.array(HORIZON) * height), (256, 3))[:, None]
        .repeat(8, 1)
        .astype("u1")
    )

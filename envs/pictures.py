"""What ``render`` returns: a task's sheets, in their fabric's colors or in their strain's, or their depths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import count, one_of, shown
from clothgym.envs.task import Task
from clothgym.forces import structural_strain

if TYPE_CHECKING:
    from clothgym.render import Renderer

RENDER_MODES = ["rgb_array", "depth_array"]
RENDER_COLORS = ("fabric", "strain", "depth")
LARGEST_FRAME = 8192  # pixels of a side


def frames_a_second(seconds: float) -> float:
    """The rate of a film with a frame after each step of so long [s], as an int where it is whole: ``metadata["render_fps"]``."""
    rate = 1 / seconds
    return round(rate) if abs(rate - round(rate)) < 1e-6 * rate else rate


def check_render_mode(render_mode: str | None, render_color: str) -> None:
    """Refuse what ``draw`` cannot do."""
    if render_mode is not None and not (isinstance(render_mode, str) and render_mode in RENDER_MODES):
        raise ValueError(f"render_mode={shown(render_mode)}: must be None or one of {', '.join(RENDER_MODES)}")
    one_of("render_color", render_color, *RENDER_COLORS)


def checked_frame_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of a frame [pixels], whole numbers."""
    return count("width", width, most=LARGEST_FRAME), count("height", height, most=LARGEST_FRAME)


def renderer_of(task: Task, width: int, height: int, antialias: int = 2) -> Renderer:
    """A renderer for a task's sheet and camera."""
    from clothgym.render import Renderer  # imported here: training draws nothing

    mesh, uv = task.physics.mesh, task.physics.mesh.rest_positions[:, :2]
    return Renderer(mesh.triangles, uv, task.camera(), width, height, antialias, task.threads, grid_shape=mesh.shape)


def draw(task: Task, renderer: Renderer, mode: str, envs: Sequence[int], color: str = "fabric") -> NDArray:
    """Frames: (envs, height, width, 3) uint8 for "rgb_array", (envs, height, width) [m] for "depth_array".

    color: "fabric"; "strain": cream where no yarn is stretched, violet where one is by the task's ``strain_shown`` or more; or
    "depth": gray, for films of depths, from white at half the camera's distance from its target to black at twice that and beyond.
    """
    positions = task.simulation.positions[list(envs)]
    solids, markers = [task.solids(env) for env in envs], [task.markers(env) for env in envs]
    if mode == "depth_array" or color == "depth":
        depths = renderer.depth_batch(positions, solids, markers)
        return depths if mode == "depth_array" else _gray(depths / np.float32(renderer.camera.distance))
    values = None
    if color == "strain":
        from clothgym.render.heat import largest_at_particles  # imported here: training draws nothing

        mesh = task.physics.mesh
        strain = structural_strain(mesh, positions, task.simulation.size[list(envs)])
        values = largest_at_particles(mesh, strain) / np.float32(task.strain_shown)
    return renderer.rgb_batch(positions, solids, markers, values)


def _gray(depths: NDArray) -> NDArray:
    """Depths, (..., height, width), in distances of the camera from its target, as gray pictures, (..., height, width, 3) uint8."""
    near, far = 0.5, 2.0
    shade = np.clip((far - np.minimum(depths, far)) / (far - near), 0, 1)
    return np.repeat(np.rint(255 * shade).astype(np.uint8)[..., None], 3, axis=-1)

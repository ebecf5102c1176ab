"""What ``render`` returns: a task's sheets, in their fabric's colors or in their strain's, or their depths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import one_of
from clothgym.envs.task import Task
from clothgym.forces import structural_strain

if TYPE_CHECKING:
    from clothgym.render import Renderer

RENDER_MODES = ["rgb_array", "depth_array"]
RENDER_COLORS = ("fabric", "strain")


def check_render_mode(render_mode: str | None, render_color: str) -> None:
    """Refuse what ``draw`` cannot do."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode={render_mode!r}: must be None or one of {', '.join(RENDER_MODES)}")
    one_of("render_color", render_color, *RENDER_COLORS)


def renderer_of(task: Task, width: int, height: int, antialias: int = 2) -> Renderer:
    """A renderer for a task's sheet and camera."""
    from clothgym.render import Renderer  # imported here: training draws nothing

    mesh, uv = task.physics.mesh, task.physics.mesh.rest_positions[:, :2]
    return Renderer(mesh.triangles, uv, task.camera(), width, height, antialias, task.threads, grid_shape=mesh.shape)


def draw(task: Task, renderer: Renderer, mode: str, envs: Sequence[int], color: str = "fabric") -> NDArray:
    """Frames: (envs, height, width, 3) uint8 for "rgb_array", (envs, height, width) [m] for "depth_array".

    color: "fabric", or "strain": cream where no yarn is stretched, violet where one is by the task's ``strain_shown`` or more.
    """
    positions = task.simulation.positions[list(envs)]
    solids, markers = [task.solids(env) for env in envs], [task.markers(env) for env in envs]
    if mode == "depth_array":
        return renderer.depth_batch(positions, solids, markers)
    values = None
    if color == "strain":
        from clothgym.render.heat import largest_at_particles  # imported here: training draws nothing

        mesh = task.physics.mesh
        values = largest_at_particles(mesh, structural_strain(mesh, positions)) / np.float32(task.strain_shown)
    return renderer.rgb_batch(positions, solids, markers, values)

"""Frames of a recording as pictures and as meshes, for the page and for the command line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import one_of
from clothgym.forces import structural_strain
from clothgym.playground.colors import sides
from clothgym.playground.recording import Frame, Recording
from clothgym.render import Camera, Drawn, Renderer, write_animation
from clothgym.render.heat import largest_at_particles

COLORS = ("fabric", "strain")


def painter(
    recording: Recording, size: int, antialias: int = 2, color: str = "fabric", camera: Camera | None = None
) -> Callable[[Frame], NDArray[np.uint8]]:
    """What draws a recording's frames, (size, size, 3) each, in the colors of the fabric or of the strain.

    camera: in place of the recording's own.
    """
    one_of("color", color, *COLORS)
    mesh, seen = recording.mesh, camera or recording.camera
    renderers = []
    for label in recording.labels:
        front, back, _ = sides(label, len(recording.labels) > 1)
        uv = mesh.rest_positions[:, :2]
        renderers.append(Renderer(mesh.triangles, uv, seen, size, size, antialias, grid_shape=mesh.shape, front=front, back=back))

    def draw(frame: Frame) -> NDArray[np.uint8]:
        pictures, depths = [], []
        for renderer, x in zip(renderers, frame.positions):
            values = None if color == "fabric" else strain_shares(recording, x)
            pictures.append(renderer.rgb(x, frame.solids, values=values))
            if len(renderers) > 1:
                depths.append(renderer.depth(x, frame.solids))
        if len(pictures) == 1:
            return pictures[0]
        # in each pixel the nearest sheet; where there is none, the darkest picture, which has the shadows of all
        nearest, stack = np.argmin(depths, axis=0)[None, :, :, None], np.stack(pictures)
        away = np.max(depths, axis=0)[:, :, None] == np.min(depths, axis=0)[:, :, None]
        return np.where(away, stack.min(axis=0), np.take_along_axis(stack, nearest, axis=0)[0])

    return draw


def strain_shares(recording: Recording, x: NDArray) -> NDArray[np.float32]:
    """The largest strain of the yarns at each particle, as a share of that at which the color scale ends, (particles,)."""
    return largest_at_particles(recording.mesh, structural_strain(recording.mesh, x[None]))[0] / np.float32(recording.strained)


# --- meshes -------------------------------------------------------------------------------------------------------------


def joined(recording: Recording) -> tuple[NDArray, NDArray]:
    """The sheets of a recording as one mesh: triangles, and texture coordinates with which an image fills each sheet."""
    mesh, sheets = recording.mesh, len(recording.labels)
    triangles = np.concatenate([mesh.triangles + k * mesh.num_particles for k in range(sheets)])
    return triangles, np.tile(mesh.rest_positions[:, :2] / max(mesh.size) + 0.5, (sheets, 1))


def together(frame: Frame) -> NDArray[np.float32]:
    """Positions of all sheets [m], (sheets * particles, 3)."""
    return frame.positions.reshape(-1, 3)


def write_moving_mesh(path: Path, recording: Recording, frames: Sequence[Frame], rate: float) -> None:
    """Frames of a recording, ``rate`` a second, as one ``.glb`` that moves, with the solids that are there throughout."""
    solids = lasting([frame.solids for frame in frames])
    write_animation(path, np.stack([together(frame) for frame in frames]), *joined(recording), rate, solids)


def lasting(solids: Sequence[Sequence[Drawn]]) -> list[list[Drawn]]:
    """The solids that all frames have: those that come or go, as a gripper that opens, cannot be part of one moving mesh."""
    counts = [Counter(solid.at_origin for solid in things) for things in solids]
    kept = {shape for shape, number in counts[0].items() if all(other[shape] == number for other in counts)}
    return [[solid for solid in things if solid.at_origin in kept] for things in solids]

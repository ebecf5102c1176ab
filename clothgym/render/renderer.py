"""The renderer: one cloth mesh, one camera, any number of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import default_threads, run_spans
from clothgym.render.camera import Camera, View
from clothgym.render.heat import heat_palette
from clothgym.render.maps import draw_maps, studio_rig
from clothgym.render.raster import depth_image, floor_nearness, project_perspective, rasterize
from clothgym.render.shading import (
    CORAL,
    INDIGO,
    STEEPEST,
    cloth_and_floor_palette,
    draw_studio,
    encode,
    shade_floor,
    shade_surfaces,
    survey,
)
from clothgym.render.solids import Color, Drawable, Drawn, check_color, drawn, linear_color
from clothgym.render.surface import place_vertices, plain_surface, push_out, smooth_surface, vertex_curvature, vertex_normals

BIAS = 0.006  # distance by which the cloth is drawn closer to the eye [m]
HIGHEST_LIFT, DEEPEST = 0.006, 0.03  # smooth cloth up to this deep in a solid is drawn above it, at most so high [m]
FINE_CELLS, COARSE_CELLS = 64, 32  # cells along the longer side of the drawn cloth, in large and in small pictures
LARGE_PICTURE = 400  # samples along the shorter side of a large picture
HEAT = heat_palette()


class _Things(NamedTuple):
    """What comes with the cloth's positions in one frame: solids, which hold it up, markers, which need not, and a number of each
    drawn vertex to show as a color, (vertices,), or none."""

    solids: list[Drawn]
    markers: list[Drawn]
    values: NDArray[np.float32]


class _Scene(NamedTuple):
    """Cloth and solids of one frame as one mesh: positions [m] and normals, (vertices, 3); surface: 0 for the cloth's
    triangles, 1 + number of the solid for the others, (triangles,)."""

    x: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    surface: NDArray[np.int32]


class Renderer:
    """Draws a cloth, solids and the floor z = 0.

    The same positions give the same pixels, alone or in a batch, on any number of threads.

    Args:
        triangles: of the cloth mesh, counter-clockwise seen from its front, (triangles, 3) int32.
        uv: material coordinates for the pattern [m], (particles, 2).
        camera: with its eye above the floor.
        width, height: of the image [pixels].
        antialias: samples per pixel and direction.
        threads: for batches; None takes the processors at hand.
        grid_shape: (rows, columns) if the particles are a grid, row by row: the cloth is then drawn as a smooth surface
            through them.
        front, back: colors of the fabric's sides, sRGB from 0 to 255.
        check: width of a stripe of the pattern [m]; None for a twelfth of the longer side.

    Raises:
        ValueError: an argument that does not fit.
    """

    def __init__(
        self,
        triangles: ArrayLike,
        uv: ArrayLike,
        camera: Camera,
        width: int = 480,
        height: int = 480,
        antialias: int = 2,
        threads: int | None = None,
        *,
        grid_shape: tuple[int, int] | None = None,
        front: Color = CORAL,
        back: Color = INDIGO,
        check: float | None = None,
    ) -> None:
        for name, value, most in (("width", width, 8192), ("height", height, 8192), ("antialias", antialias, 8)):
            if not isinstance(value, (int, np.integer)) or not 1 <= value <= most:
                raise ValueError(f"{name}={value!r}: must be an integer from 1 to {most}")
        if threads is not None and (not isinstance(threads, (int, np.integer)) or threads < 1):
            raise ValueError(f"threads={threads!r}: must be a positive integer, or None for all processors")
        if camera.eye[2] <= 0:
            raise ValueError(f"camera eye={camera.eye!r}: must be above the floor z = 0")
        check_color("front", front)
        check_color("back", back)
        uv, triangles = _checked_mesh(uv, triangles, grid_shape)
        if check is not None and not (np.isfinite(check) and check > 0):
            raise ValueError(f"check={check!r}: must be a positive, finite length in meters, or None")
        self.camera, self.width, self.height, self.antialias = camera, int(width), int(height), int(antialias)
        self.threads = default_threads() if threads is None else int(threads)
        self._particles = len(uv)
        self._check = float(np.ptp(uv, axis=0).max()) / 12 or 1.0 if check is None else float(check)
        samples = min(width, height) * antialias
        self._coarse = samples < LARGE_PICTURE
        if grid_shape is None:
            self._cloth = plain_surface(triangles, uv)
        else:
            cells = COARSE_CELLS if self._coarse else FINE_CELLS
            self._cloth = smooth_surface(triangles, uv, grid_shape, cells)
        self._palette = cloth_and_floor_palette(front, back)
        self._rig = studio_rig(camera, samples)
        self._pixel_view = camera.view(self.width, self.height)
        self._sample_view = camera.view(self.width * self.antialias, self.height * self.antialias)
        self._pixel_floor, self._sample_floor = _floor(self._pixel_view), _floor(self._sample_view)
        self._studio = np.empty((self.height, self.width, 3), np.float32)
        draw_studio(self._sample_view.rays, camera.reach, self._rig.center, self._palette, self.antialias, self._studio)

    def rgb(
        self,
        positions: ArrayLike,
        solids: Sequence[Drawable] = (),
        markers: Sequence[Drawable] = (),
        values: ArrayLike | None = None,
    ) -> NDArray[np.uint8]:
        """A picture, (height, width, 3) sRGB.

        positions: of the particles [m], (particles, 3).  solids: colliders, each alone or as (collider, color).  markers: the
        same, which the cloth need not lie upon, or small spheres, each a (position [m], color).
        values: a number of each particle, (particles,), that colors the fabric instead of its pattern, from the cream of
        ``heat.heat_colors`` at 0 and below to its violet at 1 and above.
        """
        x = self._checked_positions(positions, 2)
        out = np.empty((self.height, self.width, 3), np.uint8)
        self._draw_rgb(x, self._checked_things(solids, markers, self._checked_values(values, x.shape[:1])), out)
        return out

    def depth(self, positions: ArrayLike, solids: Sequence[Drawable] = (), markers: Sequence[Drawable] = ()) -> NDArray[np.float32]:
        """Depth along the view axis at the middle of each pixel [m], (height, width); +inf where nothing is seen.

        The floor is seen up to its horizon.  Arguments as for ``rgb``.
        """
        x = self._checked_positions(positions, 2)
        out = np.empty((self.height, self.width), np.float32)
        self._draw_depth(x, self._checked_things(solids, markers), out)
        return out

    def rgb_batch(
        self,
        positions: ArrayLike,
        solids: Sequence[Sequence[Drawable]] | None = None,
        markers: Sequence[Sequence[Drawable]] | None = None,
        values: ArrayLike | None = None,
    ) -> NDArray[np.uint8]:
        """Pictures of many environments, (environments, height, width, 3), with the pixels of ``rgb``.

        positions [m], (environments, particles, 3).  solids, markers: a sequence for each environment, or None.  values:
        (environments, particles), or None.
        """
        x, things = self._checked_batch(positions, solids, markers, values)
        out = np.empty((len(x), self.height, self.width, 3), np.uint8)
        self._spread(self._draw_rgb, x, things, out)
        return out

    def depth_batch(
        self,
        positions: ArrayLike,
        solids: Sequence[Sequence[Drawable]] | None = None,
        markers: Sequence[Sequence[Drawable]] | None = None,
    ) -> NDArray[np.float32]:
        """Depths of many environments [m], (environments, height, width), with the values of ``depth``."""
        x, things = self._checked_batch(positions, solids, markers)
        out = np.empty((len(x), self.height, self.width), np.float32)
        self._spread(self._draw_depth, x, things, out)
        return out

    def _spread(self, draw: Callable[..., None], x: NDArray[np.float32], things: list[_Things], out: NDArray[Any]) -> None:
        def work(first: int, last: int) -> None:
            for environment in range(first, last):
                draw(x[environment], things[environment], out[environment])

        run_spans(work, len(x), self.threads)

    def _draw_rgb(self, x: NDArray[np.float32], things: _Things, out: NDArray[np.uint8]) -> None:
        scene = self._scene(x, things)
        cloth, rig, view = self._cloth, self._rig, self._sample_view
        screen, inverse_depth, buffer, owner = self._rasterized(scene, view, self._sample_floor)
        maps = draw_maps(rig, scene.x, scene.triangles, len(cloth.uv), BIAS)
        curvature = np.empty(len(cloth.uv), np.float32)
        vertex_curvature(scene.x, scene.normals, cloth.triangles, curvature)
        palette = np.concatenate([self._palette, *(linear_color(solid.color)[None] for solid in [*things.solids, *things.markers])])
        mesh = (screen, inverse_depth, scene.triangles, scene.normals, cloth.uv, scene.surface, curvature, things.values)
        # a texel of the shadow map is flat: a slanted surface must not shadow itself
        slack = BIAS + 2.0 / rig.shadow_scale
        places = (rig.axes, rig.center, rig.shadow_scale, rig.height_scale, slack)
        look = (palette, self._check, HEAT)
        light, seen = np.empty((self.height, self.width, 3), np.float32), np.empty((self.height, self.width), np.int32)
        survey(screen, owner, buffer, scene.surface, self.antialias, STEEPEST * self.antialias / view.scale, seen)
        lens = (self._pixel_view.axes, self._pixel_view.scale, self.camera.near)
        shade_floor(view.rays, lens, tuple(maps), places, self._studio, self.antialias, seen, light)
        shade_surfaces(view.rays, look, mesh, tuple(maps), places, self.antialias, owner, seen, light)
        encode(light, out)

    def _draw_depth(self, x: NDArray[np.float32], things: _Things, out: NDArray[np.float32]) -> None:
        scene = self._scene(x, things)
        screen, inverse_depth, buffer, owner = self._rasterized(scene, self._pixel_view, self._pixel_floor)
        depth_image(screen, inverse_depth, scene.triangles, buffer, owner, out)

    def _scene(self, x: NDArray[np.float32], things: _Things) -> _Scene:
        cloth = self._cloth
        meshes = [solid.mesh(self._coarse) for solid in [*things.solids, *things.markers]]
        first = np.cumsum([len(cloth.uv), *(len(mesh.positions) for mesh in meshes)])
        vertices = np.empty((first[-1], 3), np.float32)
        normals = np.empty((first[-1], 3), np.float32)
        place_vertices(x, cloth.index, cloth.weight, vertices)
        lift = min(0.6 * cloth.cell, HIGHEST_LIFT)  # a cell across a sharp edge then just spans it
        for solid in (solid for solid in things.solids if lift > 0 and solid.kind != "mesh"):
            (axes, half, radius), center = solid.rounded_box(), tuple(map(float, solid.collider.center))
            if axes[2, 2] == 1:  # turned about z alone
                push_out(vertices, len(cloth.uv), center, axes[0, 0], axes[0, 1], tuple(half.tolist()), radius, lift, DEEPEST)
        vertex_normals(vertices[: first[0]], cloth.triangles, normals[: first[0]])
        for mesh, start, end in zip(meshes, first, first[1:]):
            vertices[start:end], normals[start:end] = mesh.positions, mesh.normals
        triangles = np.concatenate([cloth.triangles, *(mesh.triangles + np.int32(start) for mesh, start in zip(meshes, first))])
        counts = [len(cloth.triangles), *(len(mesh.triangles) for mesh in meshes)]
        return _Scene(vertices, normals, triangles, np.repeat(np.arange(len(counts), dtype=np.int32), counts))

    def _rasterized(self, scene: _Scene, view: View, floor: NDArray[np.float32]) -> tuple[NDArray[Any], ...]:
        """screen and inverse depth of the vertices; nearness and triangle of the samples.  floor: nearness to start with."""
        cloth, count = self._cloth, len(scene.x)
        screen, inverse_depth, nearness = np.empty((count, 2), np.int32), np.empty(count, np.float32), np.empty(count, np.float32)
        project_perspective(
            scene.x, view.axes, view.rays[0], view.scale, view.width, view.height, self.camera.near, len(cloth.uv), BIAS,
            screen, inverse_depth, nearness,
        )  # fmt: skip
        buffer, owner = floor.copy(), np.full(floor.shape, -1, np.int32)
        rasterize(screen, nearness, scene.triangles, len(cloth.triangles), buffer, owner)
        return screen, inverse_depth, buffer, owner

    def _checked_positions(self, positions: ArrayLike, dimensions: int) -> NDArray[np.float32]:
        x = np.asarray(positions)
        wanted = (self._particles, 3)
        if x.ndim != dimensions or x.shape[-2:] != wanted:
            shape = wanted if dimensions == 2 else ("environments", *wanted)
            raise ValueError(f"positions have shape {x.shape}: this renderer's cloth needs {shape}")
        with np.errstate(over="ignore"):
            x = np.ascontiguousarray(x, np.float32)
        if not np.all(np.isfinite(x)):
            place = tuple(np.argwhere(~np.isfinite(x))[0, :-1].tolist())
            raise ValueError(
                f"positions[{', '.join(map(str, place))}]={x[place].tolist()}: cloth that is not finite cannot be drawn; "
                "draw the last finite state instead"
            )
        return x

    def _checked_values(self, values: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        if values is None:
            return None
        numbers = np.asarray(values, np.float32)
        if numbers.shape != shape or not np.all(np.isfinite(numbers)):
            raise ValueError(f"values have shape {numbers.shape}: must be finite numbers, {shape}, one for each particle")
        return numbers

    def _checked_things(
        self, solids: Sequence[Drawable], markers: Sequence[Drawable], values: NDArray[np.float32] | None = None
    ) -> _Things:
        cloth = self._cloth
        shown = np.empty(0, np.float32) if values is None else np.sum(cloth.weight * values[cloth.index], axis=1)
        return _Things(list(map(drawn, solids)), list(map(drawn, markers)), shown)

    def _checked_batch(
        self,
        positions: ArrayLike,
        solids: Sequence[Sequence[Drawable]] | None,
        markers: Sequence[Sequence[Drawable]] | None,
        values: ArrayLike | None = None,
    ) -> tuple[NDArray[np.float32], list[_Things]]:
        x = self._checked_positions(positions, 3)
        solids = [()] * len(x) if solids is None else solids
        markers = [()] * len(x) if markers is None else markers
        for name, lists in (("solids", solids), ("markers", markers)):
            if len(lists) != len(x):
                raise ValueError(f"{name} has {len(lists)} entries for {len(x)} environments: give one sequence for each")
        numbers = self._checked_values(values, x.shape[:2])
        each = [None] * len(x) if numbers is None else list(numbers)
        return x, [self._checked_things(*one) for one in zip(solids, markers, each)]


def _floor(view: View) -> NDArray[np.float32]:
    nearness = np.empty((view.height, view.width), np.float32)
    floor_nearness(view.rays, nearness)
    return nearness


def _checked_mesh(
    uv: ArrayLike, triangles: ArrayLike, grid_shape: tuple[int, int] | None
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    uv = np.ascontiguousarray(uv, np.float32)
    if uv.ndim != 2 or uv.shape[1] != 2 or not np.all(np.isfinite(uv)):
        raise ValueError(f"uv has shape {uv.shape}: must be (particles, 2), finite, in meters")
    corners = np.asarray(triangles)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) == 0 or not np.issubdtype(corners.dtype, np.integer):
        raise ValueError(f"triangles have shape {corners.shape} and dtype {corners.dtype}: must be (triangles, 3) integers")
    if corners.min() < 0 or corners.max() >= len(uv):
        raise ValueError(f"triangles name particles {corners.min()} to {corners.max()}: uv has particles 0 to {len(uv) - 1}")
    fits = grid_shape is None or (np.shape(grid_shape) == (2,) and min(grid_shape) >= 2 and math.prod(grid_shape) == len(uv))
    if not fits:
        raise ValueError(f"grid_shape={grid_shape!r}: must be (rows, columns), at least 2 each, that make {len(uv)} particles")
    return uv, np.ascontiguousarray(corners, np.int32)

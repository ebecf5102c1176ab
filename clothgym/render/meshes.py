"""Cloth and solids to mesh files that Blender opens: a numbered sequence of ``.obj`` or ``.glb``, or one ``.glb`` that plays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import files
from clothgym.checks import finite, one_of, positive
from clothgym.render.gltf import Part, glb
from clothgym.render.shading import CORAL
from clothgym.render.solids import Color, Drawable, check_color, drawn
from clothgym.render.surface import vertex_normals

KINDS = ("obj", "glb")


class _Cloth(NamedTuple):
    """triangles, (triangles, 3); uv: (particles, 2) or None; color: sRGB."""

    triangles: NDArray[np.int32]
    uv: NDArray[np.float32] | None
    color: Color


def without_frames(folder: Path) -> Path:
    """The folder, to which frames may be written.

    Raises:
        FileExistsError: it is a file, or holds frames already.
    """
    if folder.is_file():
        raise FileExistsError(f"{str(folder)!r} is a file: name a folder for the meshes")
    others = sorted(file.name for ending in KINDS for file in folder.glob(f"frame_*.{ending}"))
    if others:
        raise FileExistsError(
            f"{str(folder)!r} holds {len(others)} frames already ({others[0]} to {others[-1]}), which would be mixed with "
            "the new ones: name another folder, or remove them first"
        )
    return folder


class MeshSequence:
    """A folder of ``frame_00000.obj`` (or ``.glb``) and so on, written one by one; finished files stay if a later one fails.

    Positions are z up.  A ``.glb`` says so, and holds exactly the given float32 values.  An ``.obj`` cannot say so (in
    Blender's import choose Forward Y, Up Z); its nine digits give the same float32 back when they are read.

    Args:
        folder: created if missing.
        triangles: of the cloth, counter-clockwise seen from its front, (triangles, 3).
        uv: texture coordinates, (particles, 2), or None.
        kind: "obj" or "glb".
        color: of the cloth, sRGB from 0 to 255; an ``.obj`` has none.

    Raises:
        ValueError: an argument that does not fit.
        FileExistsError: the folder holds frames already.
    """

    def __init__(
        self, folder: str | Path, triangles: ArrayLike, uv: ArrayLike | None = None, kind: str = "obj", color: Color = CORAL
    ) -> None:
        one_of("mesh kind", kind, *KINDS)
        self.folder, self.kind, self.written = Path(folder).expanduser(), kind, 0
        self._cloth = _checked_cloth(triangles, uv, color)
        without_frames(self.folder).mkdir(parents=True, exist_ok=True)

    def add(self, positions: ArrayLike, solids: Sequence[Drawable] = ()) -> Path:
        """Write the next frame, the cloth at ``positions`` [m], (particles, 3), and the solids; where it went.

        Raises:
            ValueError: positions of another shape, or not finite; nothing is written then.
        """
        parts = _parts(_checked_frames(np.asarray(positions)[None], self._cloth), [solids], self._cloth)
        path = self.folder / f"frame_{self.written:05d}.{self.kind}"
        files.write(path, glb(parts) if self.kind == "glb" else _obj(parts))
        self.written += 1
        return path


def write_meshes(
    folder: str | Path,
    positions: ArrayLike,
    triangles: ArrayLike,
    uv: ArrayLike | None = None,
    kind: str = "obj",
    solids: Sequence[Sequence[Drawable]] | None = None,
) -> list[Path]:
    """Write a ``MeshSequence`` in one call; its files.

    positions: [m], (frames, particles, 3); if any are wrong nothing is written.  solids: a sequence for each frame, or None.
    """
    frames = _checked_frames(positions, _checked_cloth(triangles, uv))
    things = _checked_solids(solids, len(frames))
    sequence = MeshSequence(folder, triangles, uv, kind)
    return [sequence.add(*pair) for pair in zip(frames, things)]


def write_animation(
    path: str | Path,
    positions: ArrayLike,
    triangles: ArrayLike,
    uv: ArrayLike | None = None,
    fps: float = 30.0,
    solids: Sequence[Sequence[Drawable]] | None = None,
    color: Color = CORAL,
) -> None:
    """Write one ``.glb`` in which cloth and solids move; Blender plays it as it is.

    The first frame is the mesh; the others are morph targets (shape keys), which come back to the rounding of float32.
    Arguments as for ``write_meshes``; fps: frames a second.

    Raises:
        ValueError: another ending, positions that do not fit, or solids that change in number or kind on the way.
    """
    path = Path(path).expanduser()
    if path.suffix != ".glb":
        raise ValueError(f"animation path={str(path)!r}: must end in .glb")
    cloth = _checked_cloth(triangles, uv, color)
    frames = _checked_frames(positions, cloth)
    files.write(path, glb(_parts(frames, _checked_solids(solids, len(frames)), cloth), positive("fps", fps)))


def _parts(frames: NDArray[np.float32], solids: Sequence[Sequence[Drawable]], cloth: _Cloth) -> list[Part]:
    """The cloth, and each solid, through all frames."""
    normals = np.empty_like(frames)
    for x, out in zip(frames, normals):
        vertex_normals(x, cloth.triangles, out)
    parts = [Part("cloth", frames, normals, cloth.triangles, cloth.uv, cloth.color)]
    shown = [[drawn(solid) for solid in things] for things in solids]
    if len({tuple(solid.kind for solid in things) for things in shown}) > 1:
        raise ValueError("the solids change in number or kind from frame to frame: an animation needs the same ones throughout")
    for number, same in enumerate(zip(*shown)):
        meshes = [solid.mesh() for solid in same]
        x, n = (np.stack([getattr(mesh, name) for mesh in meshes]) for name in ("positions", "normals"))
        parts.append(Part(f"{same[0].kind}_{number}", x, n, meshes[0].triangles, None, same[0].color))
    return parts


def _obj(parts: Sequence[Part]) -> bytes:
    """Wavefront's text: one object a part, of the first moment."""
    lines, before, before_uv = ["# clothgym: meters, z up"], 1, 1
    for part in parts:
        lines.append(f"o {part.name}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.positions[0].tolist()]
        corners = part.triangles + before
        if part.uv is None:
            lines += [f"f {i} {j} {k}" for i, j, k in corners.tolist()]
        else:
            lines += [f"vt {u:.9g} {v:.9g}" for u, v in part.uv.tolist()]
            both = np.repeat(corners, 2, axis=1)
            both[:, 1::2] += before_uv - before
            lines += [f"f {a}/{b} {c}/{d} {e}/{f}" for a, b, c, d, e, f in both.tolist()]
            before_uv += len(part.uv)
        before += part.positions.shape[1]
    return ("\n".join(lines) + "\n").encode()


def _checked_cloth(triangles: ArrayLike, uv: ArrayLike | None, color: Color = CORAL) -> _Cloth:
    corners = np.asarray(triangles)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) == 0 or corners.dtype.kind not in "iu" or corners.min() < 0:
        raise ValueError(f"triangles have shape {corners.shape} and dtype {corners.dtype}: must be (triangles, 3) particles")
    check_color("color", color)
    if uv is not None:
        uv = finite("uv", uv).astype(np.float32)
        if uv.ndim != 2 or uv.shape[1] != 2 or len(uv) <= corners.max():
            raise ValueError(f"uv have shape {uv.shape}: must be (particles, 2)")
    return _Cloth(np.ascontiguousarray(corners, np.int32), uv, color)


def _checked_frames(positions: ArrayLike, cloth: _Cloth) -> NDArray[np.float32]:
    frames = np.ascontiguousarray(positions, np.float32)
    particles = int(cloth.triangles.max()) + 1 if cloth.uv is None else len(cloth.uv)
    fits = frames.ndim == 3 and frames.shape[2] == 3 and len(frames) and frames.shape[1] >= particles
    if not fits or (cloth.uv is not None and frames.shape[1] != particles):
        need = "at least " * (cloth.uv is None) + str(particles)
        raise ValueError(
            f"positions have shape {frames.shape}: must be (frames, particles, 3) with {need} particles, as the mesh has"
        )
    if not np.all(np.isfinite(frames)):
        frame, particle = np.argwhere(~np.isfinite(frames))[0, :2]
        raise ValueError(
            f"positions of particle {particle} in frame {frame} are {frames[frame, particle].tolist()}: a mesh that is not finite "
            "cannot be written; end with the last finite frame"
        )
    return frames


def _checked_solids(solids: Sequence[Sequence[Drawable]] | None, frames: int) -> Sequence[Sequence[Drawable]]:
    solids = [()] * frames if solids is None else solids
    if len(solids) != frames:
        raise ValueError(f"solids has {len(solids)} entries for {frames} frames: give one sequence for each")
    return solids

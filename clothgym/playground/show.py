"""A stage as the browser draws it: its scene and solids as JSON has them, and its frames as numbers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import titled
from clothgym.render import Drawn
from clothgym.render.looks import LOOKS, PLAIN, Look
from clothgym.render.shading import CORAL, INDIGO

MODES = ("fabric", "strain")
LARGER = 2.0  # gingham of a sheet, relative to that of a specimen of cloth
SIGHT = 1.15  # half the width that the lamp reaches, relative to what the scene's own camera shows


def look_of(recording: Recording) -> Look:
    """Of a recording's fabric; where none is named a gingham with sides in two colors, a twelfth of the sheet in a stripe."""
    twelfth = max(recording.mesh.size) / 12
    own = LOOKS.get(recording.fabric, Look(CORAL, INDIGO, twelfth))
    return own._replace(check=PLAIN if own.check == PLAIN else min(LARGER * own.check, twelfth))


def scene_of(recording: Recording) -> dict[str, Any]:
    """What the page needs to know before the first frame."""
    mesh, camera = recording.mesh, recording.camera
    flat = mesh.rest_positions[:, :2] - mesh.rest_positions[:, :2].min(axis=0)
    grid = {"shape": mesh.shape} if mesh.shape else {"triangles": mesh.triangles.ravel().tolist(), "uv": rounded(flat)}
    return {
        **grid,
        "sheets": len(recording.labels),
        "labels": list(map(titled, recording.labels)) if len(recording.labels) > 1 else [],
        "size": np.ptp(flat, axis=0).tolist(),
        "camera": {"eye": camera.eye, "target": camera.target},
        "slope": camera.reach / camera.distance,
        "middle": camera.target,
        "reach": SIGHT * camera.reach + 0.5 * camera.target[2],
        "look": look_of(recording)._asdict(),
        "strain_shown": recording.strained,
        "time_step": recording.time_step,
        "solids": [],
    }


def solid_of(solid: Drawn) -> dict[str, Any]:
    """A solid: a box swept by a ball, or a mesh, around the origin."""
    axes, half, radius = solid.rounded_box()
    told: dict[str, Any] = {"kind": solid.kind, "half": rounded(half), "color": solid.color}
    if solid.kind != "mesh":
        return told | {"axes": rounded(axes), "radius": round(radius, 5), "holds": True}
    mesh = solid.mesh()
    return told | {
        "positions": rounded(mesh.positions),
        "normals": rounded(mesh.normals),
        "triangles": mesh.triangles.ravel().tolist(),
    }


def rounded(numbers: NDArray) -> list[float]:
    """Numbers with as many digits as a picture has."""
    return np.round(np.asarray(numbers, np.float64).ravel(), 5).tolist()


class Show:
    """The solids of one recording, by the numbers that the browser knows them by."""

    def __init__(self) -> None:
        self._numbers: dict[Drawn, list[int]] = defaultdict(list)
        self._count = 0

    def draw(self, frame: Frame, held: NDArray) -> tuple[list[dict[str, Any]], bytes]:
        """Solids that the browser does not know yet, and a frame, as float32: the time [s] and the number of solids; the particles
        of all sheets; the solids, not a number where one is not there; and held points, [m] each."""
        new, places = self._placed(frame.solids)
        head = np.array([frame.time, self._count], np.float32)
        parts = (head, frame.positions, places, held)
        return new, np.concatenate([np.ravel(part) for part in parts]).astype("<f4").tobytes()

    def _placed(self, solids: Sequence[Drawn]) -> tuple[list[dict[str, Any]], NDArray[np.float32]]:
        new, used, places = [], dict[Drawn, int](), {}
        for solid in solids:
            shape = solid.at_origin
            numbers, number = self._numbers[shape], used.get(shape, 0)
            used[shape] = number + 1
            if number == len(numbers):
                numbers.append(self._count)
                self._count += 1
                new.append(solid_of(shape))
            places[numbers[number]] = solid.collider.center
        centers = np.full((self._count, 3), np.nan, np.float32)
        for number, center in places.items():
            centers[number] = center
        return new, centers

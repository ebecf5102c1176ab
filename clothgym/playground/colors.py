"""Colors: of fabrics, of compared sheets, and of strained springs with the scale that they are measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym.integrators import INTEGRATORS
from clothgym.mesh import EDGE, STRUCTURAL_X
from clothgym.playground.recording import Frame, Recording, strains, tensions, yarns
from clothgym.playground.sheets import UNLIMITED
from clothgym.render.shading import CORAL, CREAM, INDIGO
from clothgym.render.solids import Color, linear_color

# colors of compressed, idle and loaded springs: at minus one, zero, a third, two thirds and the whole of the scale
STOPS = np.array([-1.0, 0.0, 0.33, 0.66, 1.0])
RAMP = np.array([(84, 150, 255), (112, 118, 138), (255, 206, 92), (255, 122, 40), (232, 20, 56)], float)
LINEAR = (255 * linear_color(range(256)) + 0.5).astype(np.uint8)
IDLE = (112, 118, 138)
PALE = 225  # gray mixed into the color of a sheet without the strain limit
LIT = 0.25  # share of the scale from which on a thread lights up in the fabric's own colors
# front and back of a fabric, and of its lighter stripes; others are the renderer's gingham
GINGHAM = (CORAL, INDIGO, CREAM)
FABRICS: dict[str, tuple[Color, Color, Color]] = {
    "denim": ((44, 66, 118), (150, 168, 196), (78, 102, 156)),
    "silk": ((226, 178, 84), (238, 206, 140), (250, 232, 184)),
    "wool": ((92, 104, 84), (116, 122, 104), (150, 152, 128)),
    "wool_tropical": ((104, 96, 110), (128, 120, 132), (168, 160, 168)),
    "polyester": ((40, 132, 140), (84, 160, 164), (206, 236, 232)),
}
# where a scale may end: round numbers of percent, or of any other unit
ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
SHRINKS = 0.4  # share of the scale below which everything must be for it to end earlier
LEAST = 0.005  # strain at which a scale ends at least
STEADY = 45  # frames for which it must be so


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


def own_color(label: str) -> Color | None:
    """Color of a compared sheet: that of its integrator, paler without a strain limit; None if the label is not an integrator."""
    method = INTEGRATORS.get(label.removesuffix(UNLIMITED))
    if method is None:
        return FABRICS[label][0] if label in FABRICS else None
    red, green, blue = (int(method.color[k : k + 2], 16) for k in (1, 3, 5))
    if label.endswith(UNLIMITED):
        red, green, blue = (round(0.35 * c + 0.65 * PALE) for c in (red, green, blue))
    return red, green, blue


def sides(label: str, compared: bool, fabric: str = "") -> tuple[Color, Color, Color]:
    """Colors of a sheet's front, its back and its light stripes: those of the fabric, or its own if several are compared."""
    front = own_color(label) if compared and label not in FABRICS else None
    if front is None:
        return FABRICS.get(label if compared else fabric, GINGHAM)
    return front, tuple(round(0.6 * c) for c in front), CREAM  # type: ignore[return-value]


def spring_values(recording: Recording, frame: Frame, sheet: int, mode: str, springs: NDArray) -> NDArray:
    """Tensions [N] of a sheet's springs in that mode, or else strains."""
    x, mesh = frame.positions[sheet], recording.mesh
    if mode == "tension":
        return tensions(mesh, x, springs, frame.stiffness[sheet])
    return strains(mesh, x, springs)


class Scale:
    """Where the colors of springs end: at a round number not far above the largest value that is shown.

    It grows at once, and shrinks when it has been too large for a while.

    Args:
        strained: strain at which it ends at first.
    """

    def __init__(self, strained: float) -> None:
        self.strained = strained
        self._small = 0

    def fit(self, recording: Recording, frame: Frame) -> None:
        """Fit it to the strains of a frame's sheets; those that are not finite do not count."""
        springs = yarns(recording.mesh)
        broken = np.isnan(frame.readings.get("strain", np.zeros(len(frame.positions))))
        whole = [strains(recording.mesh, x, springs).max() for x, burst in zip(frame.positions, broken) if not burst]
        if not whole:
            return
        largest = max(whole)
        self._small = self._small + 1 if largest < SHRINKS * self.strained else 0
        if largest > self.strained or self._small > STEADY:
            self.strained, self._small = max(round_up(float(largest)), LEAST), 0

    def end(self, recording: Recording, frame: Frame, sheet: int, mode: str) -> float:
        """Where the scale of a mode ends: a strain, or a tension [N] of a yarn so strained."""
        if mode != "tension":
            return self.strained
        kind = EDGE if recording.mesh.shape is None else STRUCTURAL_X
        typical = float(np.median(recording.mesh.springs.rest_length[yarns(recording.mesh)]))
        return self.strained * float(frame.stiffness[sheet, kind]) * typical


def round_up(value: float) -> float:
    """The next round number."""
    if not value > 0:
        return 0.0
    unit = 10.0 ** np.floor(np.log10(value))
    return next((step * unit for step in ROUND if step * unit >= value), 10 * unit)

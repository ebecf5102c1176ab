"""Readings of a frame in words and as a table, and the legend of its colors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clothgym.playground.colors import RAMP, STOPS, Scale
from clothgym.playground.recording import Frame, Recording, strains, yarns
from clothgym.playground.sheets import Stability

NOTHING = "–"  # where there is nothing to read
FLAT = 0.35  # height of a sheet, as a share of its width, below which it lies rather than hangs
THIRDS = (0.33, 0.67)


def readings_table(recording: Recording, frame: Frame, stabilities: Sequence[Stability]) -> str:
    """The readings as a table, a column for each sheet; stabilities: empty if nothing is simulated."""
    readings = frame.readings
    rows = [("time", [f"{frame.time:.2f} s"]), ("largest stretch", percent(readings["strain"]))]
    if "strain before limiting" in readings:
        rows.append(("before the limit", percent(readings["strain before limiting"])))
    rows.append(("where", [most_strained(recording, frame, sheet) for sheet in range(len(frame.positions))]))
    rows.append(("energy", numbers(1e3 * readings["energy"], "{:.4g} mJ")))
    rows.append(("deepest in a solid", numbers(1e3 * readings["penetration"], "{:.2f} mm")))
    rows.append(("1/60 s is computed in" if stabilities else "computed in", numbers(1e3 * readings["cost"], "{:.2f} ms")))
    if stabilities:
        rows.append(("substep", [f"{1e3 * s.substep:.3g} ms" for s in stabilities]))
        rows.append(("its bound", [f"{1e3 * s.bound:.3g} ms" if s.bound > 0 else "none" for s in stabilities]))
        rows.append(("stability", [f"**{s.verdict}**" if s.verdict == "unstable" else s.verdict for s in stabilities]))
    rows += [(f"reward: {name}", [signed(value)]) for name, value in frame.terms.items()]
    count = len(recording.labels)
    head = "| |" + "|".join(label.replace("_", " ") for label in recording.labels) + "|\n|---|" + "---:|" * count
    lines = [f"| {name} | " + " | ".join([*cells] + [""] * (count - len(cells))) + " |" for name, cells in rows]
    return "\n".join([head, *lines])


def glance(recording: Recording, frame: Frame) -> str:
    """The one reading that is always in sight; of several sheets, each one's."""
    stretched = percent(frame.readings["strain"])
    if len(stretched) == 1:
        if stretched[0] == NOTHING:
            return "The sheet has burst."
        return f"Stretched by **{stretched[0]}** at most: {most_strained(recording, frame, 0)}."
    each = ", ".join(f"{label.replace('_', ' ')} **{value}**" for label, value in zip(recording.labels, stretched))
    return f"Stretched at most: {each}."


def most_strained(recording: Recording, frame: Frame, sheet: int) -> str:
    """Where the most stretched thread of a sheet is, as seen by the recording's camera."""
    if not np.isfinite(frame.readings["strain"][sheet]):
        return NOTHING
    mesh, x = recording.mesh, frame.positions[sheet].astype(np.float64)
    springs = yarns(mesh)
    ends = mesh.springs.particles[springs[np.argmax(strains(mesh, x, springs))]]
    ahead = np.subtract(recording.camera.target, recording.camera.eye) * (1, 1, 0)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    right = np.array([ahead[1], -ahead[0], 0.0])
    across, deep, high = (_share(x @ axis, ends) for axis in (right, ahead, np.array([0.0, 0.0, 1.0])))
    hangs = np.ptp(x[:, 2]) > FLAT * np.ptp(x @ right)
    side = _named(across, "left", "middle", "right")
    level = _named(high, "near the bottom", "halfway up", "near the top")
    if not hangs:
        level = _named(deep, "in front", "halfway back", "behind")
    if mesh.shape is not None and side != "middle" and _on_border(mesh.shape, ends):
        return f"{side} edge, {level}"
    return f"{side}, {level}"


def _share(values: NDArray, ends: NDArray) -> float:
    """Where the mean of the values at ``ends`` lies between the least and the largest, from 0 to 1."""
    return float((values[ends].mean() - values.min()) / max(float(np.ptp(values)), 1e-9))


def _named(share: float, low: str, middle: str, high: str) -> str:
    return low if share < THIRDS[0] else high if share > THIRDS[1] else middle


def _on_border(shape: tuple[int, int], ends: NDArray) -> bool:
    """Whether both ends are in the first or last row, or in the first or last column."""
    row, column = np.divmod(ends, shape[1])
    return bool(np.all(row == row[0]) and row[0] in (0, shape[0] - 1)) or bool(
        np.all(column == column[0]) and column[0] in (0, shape[1] - 1)
    )


def percent(values: NDArray) -> list[str]:
    return numbers(100 * np.asarray(values), "{:.2f} %")


def numbers(values: NDArray, form: str) -> list[str]:
    """Each number in that form; nothing where there is none."""
    return [form.format(value) if np.isfinite(value) else NOTHING for value in values]


def signed(value: float) -> str:
    """A number with its sign, and zero without one."""
    rounded = round(value, 4)
    return f"{rounded:+.4f}" if rounded else "0"


def legend(recording: Recording, frame: Frame, mode: str, scale: Scale) -> str:
    """The legend of the colors, as HTML."""
    if mode == "contact":
        return "<small>orange: where it touches a solid; yellow: where it is held</small>"
    full = scale.end(recording, frame, 0, mode)
    end = f"{1e3 * full:.3g} mN" if mode == "tension" else f"{100 * full:.3g} %"
    # in the fabric's own colors only what is strained lights up
    low = -1.0 if mode != "fabric" else 0.0
    stops = ", ".join(
        f"rgb({r:.0f},{g:.0f},{b:.0f}) {100 * (s - low) / (1 - low):.0f}%" for s, (r, g, b) in zip(STOPS, RAMP) if s >= low
    )
    bar = f'<div style="height:8px;border-radius:4px;background:linear-gradient(to right, {stops})"></div>'
    row = '<div style="display:flex;justify-content:space-between;font-size:0.75em">'
    words = "<span>pushed together</span><span>at rest</span>" if mode != "fabric" else "<span>threads at rest</span>"
    return f'<div style="margin:0 12px">{bar}{row}{words}<span>pulled: {end}</span></div></div>'

"""Readings of a frame as a table, and the legend of its colors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clothgym.playground.recording import Frame, Recording, strains, yarns
from clothgym.playground.show import RAMP, STOPS, spring_values
from clothgym.playground.stage import Stability


def readings_table(recording: Recording, frame: Frame, stabilities: Sequence[Stability]) -> str:
    """The readings as a table, a column for each sheet; stabilities: empty if nothing is simulated."""
    springs = yarns(recording.mesh)
    most = int(np.argmax(strains(recording.mesh, frame.positions[0], springs)))
    i, j = recording.mesh.springs.particles[springs[most]].tolist()
    readings = frame.readings
    rows = [("time", [f"{frame.time:.2f} s"]), ("largest strain", percent(readings["strain"]))]
    if "strain before limiting" in readings:
        rows.append(("before the limit", percent(readings["strain before limiting"])))
    rows.append(("most strained yarn", [f"{i} to {j}"]))
    rows.append(("energy", [f"{1e3 * value:.4g} mJ" for value in readings["energy"]]))
    rows.append(("deepest in a solid", [f"{1e3 * value:.2f} mm" for value in readings["penetration"]]))
    rows.append(("a step costs", [f"{1e3 * value:.2f} ms" for value in readings["cost"]]))
    if stabilities:
        rows.append(("substep", [f"{1e3 * s.substep:.3g} ms" for s in stabilities]))
        rows.append(("its bound", [f"{1e3 * s.bound:.3g} ms" if s.bound > 0 else "none" for s in stabilities]))
        rows.append(("stability", [f"**{s.verdict}**" if s.verdict == "unstable" else s.verdict for s in stabilities]))
    rows += [(f"reward: {name}", [f"{value:+.4f}"]) for name, value in frame.terms.items()]
    count = len(recording.labels)
    head = "| |" + "|".join(label.replace("_", " ") for label in recording.labels) + "|\n|---|" + "---:|" * count
    lines = [f"| {name} | " + " | ".join([*cells] + [""] * (count - len(cells))) + " |" for name, cells in rows]
    return "\n".join([head, *lines])


def percent(values: NDArray) -> list[str]:
    return [f"{100 * value:.2f} %" if np.isfinite(value) else "none" for value in values]


def legend(recording: Recording, frame: Frame, mode: str) -> str:
    """The legend of the colors, as HTML."""
    if mode == "fabric":
        return ""
    if mode == "contact":
        return "<small>orange: particles that touch a solid; yellow: those that are held</small>"
    _, full = spring_values(recording, frame, 0, mode, np.zeros(1, int))
    end = f"{100 * full:.0f} %" if mode == "strain" else f"{1e3 * full:.3g} mN"
    stops = ", ".join(f"rgb({r:.0f},{g:.0f},{b:.0f}) {50 * (s + 1):.0f}%" for s, (r, g, b) in zip(STOPS, RAMP))
    bar = f'<div style="height:8px;border-radius:4px;background:linear-gradient(to right, {stops})"></div>'
    row = '<div style="display:flex;justify-content:space-between;font-size:0.75em">'
    return f'<div style="margin:0 12px">{bar}{row}<span>pushed</span><span>0</span><span>{end}</span></div></div>'

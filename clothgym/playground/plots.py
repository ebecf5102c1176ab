"""Small plots over time: strain, energy, and the terms of a reward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from clothgym.lab.compare_pictures import INK
from clothgym.playground.colors import own_color
from clothgym.playground.recording import Frame, Recording
from clothgym.render.shading import CORAL

POINTS = 300  # frames in a plot
HEIGHT = 130  # of a plot [pixels]
SPAN = 2.0  # plots start and end at multiples of this [s]: a new range for each frame would be costly
READINGS = {"largest strain [%]": ("strain", 100.0), "energy [mJ]": ("energy", 1e3)}
REWARD = "reward terms"
TERMS = ("#d1495b", "#2f6fb5", "#3a8f4e", "#edae49", "#7b4fa3", "#8c6239", "#12a5a5", "#8a8f98")
Lines = tuple[tuple[str, str], ...]  # labels and colors


class Plots:
    """The plots of one recording at a time.  Unused ones are hidden, not removed: updates may still be on their way.

    Args:
        gui: viser's, or a null viewer's; plots are added to its current container.
    """

    def __init__(self, gui: Any) -> None:
        self.gui, self.folder = gui, gui.add_folder(None)
        self.made: dict[tuple[str, Lines], Any] = {}
        self.shown: dict[str, Any] = {}
        self.ends: dict[int, tuple[float, ...]] = {}  # of each plot's scales

    def begin(self, recording: Recording) -> None:
        """Show the plots of these sheets."""
        compared = len(recording.labels) > 1
        hexed = "#{:02x}{:02x}{:02x}".format
        self.lines = tuple((label, hexed(*(own_color(label) or CORAL))) for label in recording.labels)
        if not compared:
            self.lines = (("sheet", INK),)
        for plot in self.shown.values():
            plot.visible = False
        self.shown = {}

    def draw(self, frames: Sequence[Frame]) -> None:
        """Plot the last ``POINTS`` of these frames."""
        shown = frames[-POINTS:]
        times = np.array([frame.time for frame in shown])
        for title, (name, unit) in READINGS.items():
            self._draw(title, self.lines, times, np.array([frame.readings[name] for frame in shown]) * unit)
        terms = sorted({name for frame in shown for name in frame.terms})
        if terms:
            lines = tuple((name, TERMS[k % len(TERMS)]) for k, name in enumerate(terms))
            self._draw(REWARD, lines, times, np.array([[frame.terms.get(name, np.nan) for name in terms] for frame in shown]))

    def _draw(self, title: str, lines: Lines, times: np.ndarray, values: np.ndarray) -> None:
        if (title, lines) not in self.made:
            series = ({"label": "s"}, *({"label": label.replace("_", " "), "stroke": ink, "width": 1.6} for label, ink in lines))
            with self.folder:
                self.made[title, lines] = self.gui.add_uplot(
                    (np.zeros(1),) * len(series), series, title=title, height=HEIGHT, legend={"show": len(lines) > 1},
                    scales={"x": {"time": False}},
                )  # fmt: skip
        plot = self.made[title, lines]
        if self.shown.get(title) is not plot:
            if title in self.shown:
                self.shown[title].visible = False
            self.shown[title], plot.visible = plot, True
        plot.data = (times, *values.T)
        self._scale(plot, times, values)

    def _scale(self, plot: Any, times: np.ndarray, values: np.ndarray) -> None:
        """Scale from zero, so that cloth at rest has a flat line, and rescale only if values leave the scale or shrink in it."""
        finite = values[np.isfinite(values)]
        low, high = min(0.0, float(finite.min(initial=0.0))), max(1e-2, float(finite.max(initial=0.0)))
        # the plot's own choice of a time range after a single frame would be long, and stay
        begin, end = SPAN * np.floor(times[0] / SPAN), SPAN * max(1.0, np.ceil(times[-1] / SPAN))
        now = self.ends.get(id(plot), (0.0, 0.0, 0.0, 0.0))
        if low < now[0] or high > now[1] or (high - low) < 0.3 * (now[1] - now[0]):
            now = 1.2 * low, 1.2 * high, *now[2:]
        now = *now[:2], float(begin), float(end)
        if now != self.ends.get(id(plot)):
            self.ends[id(plot)] = now
            plot.scales = {"x": {"time": False, "range": now[2:]}, "y": {"range": now[:2]}}

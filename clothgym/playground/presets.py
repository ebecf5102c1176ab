"""Presets: what a button of the page does at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from clothgym.simulation import GRAVITY


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A scene with some of its settings changed.

    Attributes:
        scene: name of what to open; "" to change the scene that is open, or the first one where none is.
        changes: of settings; of the scene's own where it is opened.
        compared: what has a sheet each.
    """

    scene: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    compared: tuple[str, ...] = ()


AGAIN = "start again"
PRESETS: dict[str, Preset] = {
    AGAIN: Preset(),
    "storm": Preset(changes={"gravity": GRAVITY, "wind": 9.0, "gust": 4.0, "fabric": "penava_cotton", "air_drag": 0.4}),
    # 4 substeps of 4.2 ms are far beyond what an explicit method bears with yarns as stiff as denim's
    "make it explode": Preset(
        changes={"gravity": GRAVITY, "fabric": "denim", "integrator": "semi_implicit_euler", "self_collision": "off", "substeps": 4}
    ),
    "silk and denim": Preset(scene="flag", changes={"wind": 5.0, "gust": 1.5}, compared=("silk", "denim")),
    "race": Preset(scene="race"),
}

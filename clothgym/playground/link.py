"""A link that restores the page: its scene, settings and seed, and the pins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any
from urllib.parse import parse_qsl, urlencode

import numpy as np

from clothgym.playground.scenes import Settings
from clothgym.playground.stage import SceneStage, Stage

TEXTS = ("fabric", "integrator", "bending", "self_collision")  # settings that are names; others are numbers


@dataclass(frozen=True)
class Link:
    """What a link says: a scene's name, changes of its settings, a seed, pinned particles, and who acts."""

    scene: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    pins: tuple[int, ...] = ()
    policy: str = ""


def read(query: str) -> Link:
    """The query of a page's address.  Whether there is such a scene, and whether it takes these settings, is not said here.

    Raises:
        ValueError: a number is none.
    """
    given = dict(parse_qsl(query))

    def meant(name: str, text: str) -> Any:
        if name in TEXTS or text == "auto":
            return text
        if text == "none":
            return None
        return int(text) if name == "substeps" else float(text)

    return Link(
        scene=given.get("scene", ""),
        changes={item.name: meant(item.name, given[item.name]) for item in fields(Settings) if item.name in given},
        seed=int(given["seed"]) if "seed" in given else None,
        pins=tuple(int(one) for one in given.get("pins", "").split(".") if one),
        policy=given.get("policy", ""),
    )


def write(stage: Stage) -> str:
    """The query of a link to a stage as it is."""
    told: dict[str, Any] = {"scene": stage.name}
    if isinstance(stage, SceneStage):
        if stage.settings.fabric != stage.scene.settings.fabric:
            told["fabric"] = stage.settings.fabric
        begun = stage.scene.settings.changed(fabric=stage.settings.fabric)
        for item in fields(Settings):
            value = getattr(stage.settings, item.name)
            if value != getattr(begun, item.name):
                told[item.name] = "none" if value is None else value
        told["pins"] = ".".join(map(str, np.flatnonzero(stage.simulation.grippers.holder[0] > 0)))
    told |= {"policy": stage.policy, "seed": stage.seed}
    return urlencode({name: value for name, value in told.items() if value not in ("", None) and (name, value) != ("seed", 0)})

"""A link that opens the page as it is: what is shown, its settings and seed, what is compared, and where the sheet is pinned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any
from urllib.parse import parse_qsl, urlencode

import numpy as np

from clothgym.playground.episode import EpisodeStage
from clothgym.playground.sheets import Sheet
from clothgym.playground.stage import SceneStage, Stage
from clothgym.playground.world import Settings

TEXTS = ("fabric", "integrator", "bending", "self_collision")  # settings that are names; others are numbers


@dataclass(frozen=True)
class Link:
    """What a link says.

    Attributes:
        scene: a name, or "".
        changes: of its settings.
        seed: of its start.
        compared: integrators or fabrics side by side.
        pins: particles that are pinned.
        policy: who acts.
    """

    scene: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    compared: tuple[str, ...] = ()
    pins: tuple[int, ...] = ()
    policy: str = ""


def read(query: str) -> Link:
    """The query of a page's address.  Whether there is such a scene, and whether it takes these settings, is not said here.

    Raises:
        ValueError: a number is none.
    """
    given = dict(parse_qsl(query))
    changes: dict[str, Any] = {}
    for item in fields(Settings):
        if item.name in given:
            text = given[item.name]
            if item.name in TEXTS or text == "auto":
                changes[item.name] = text
            elif text == "none":
                changes[item.name] = None
            else:
                changes[item.name] = int(text) if item.name == "substeps" else float(text)
    return Link(
        scene=given.get("scene", ""),
        changes=changes,
        seed=int(given["seed"]) if "seed" in given else None,
        compared=tuple(filter(None, given.get("compared", "").split("."))),
        pins=tuple(int(one) for one in given.get("pins", "").split(".") if one),
        policy=given.get("policy", ""),
    )


def write(stage: Stage) -> str:
    """The query of a link to a stage as it is."""
    told: dict[str, Any] = {"scene": stage.name}
    if isinstance(stage, SceneStage):
        begun = stage.scene.settings.changed(fabric=stage.settings.fabric)
        for item in fields(Settings):
            value = getattr(stage.settings, item.name)
            if value != getattr(begun, item.name) or (item.name == "fabric" and value != stage.scene.settings.fabric):
                told[item.name] = "none" if value is None else value
        if stage.compared:
            told["compared"] = ".".join(stage.compared)
        pins = pinned(stage.sheets[0])
        if pins:
            told["pins"] = ".".join(map(str, pins))
    elif isinstance(stage, EpisodeStage):
        told["policy"] = stage.policy
    if stage.seed:
        told["seed"] = stage.seed
    return urlencode(told)


def pinned(sheet: Sheet) -> list[int]:
    """The particles that the visitor has pinned."""
    holder = sheet.simulation.grippers.holder[0]
    return [int(particle) for particle in np.flatnonzero(holder > 0)]

"""The controls of a page as data: the browser draws them, and tells which one was turned."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.bending import BENDING
from clothgym.integrators import INTEGRATORS
from clothgym.material import PRESETS as FABRICS
from clothgym.playground.exporting import SAVED
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import CLOTH, WORLD, number_within, titled
from clothgym.playground.show import MODES
from clothgym.playground.stage import SceneStage, Stability, Stage
from clothgym.simulation import GRAVITY

MOST_SUBSTEPS = 400
IN_SIGHT = 2  # sliders of WORLD that are not in a folder
GUSTS, FABRIC, METHOD, COLORS, READINGS, SAVE = (
    "Gusts and friction", "The fabric in numbers", "How it is computed", "Hands and colors", "Readings", "Save and share"
)  # fmt: skip
CLICKS = ("pins it, or frees it", "blows on it")
ADVICE = "Drag the cloth to pull and throw it; click it to pin it or to free it."
# what a button does at once: the scene that it opens, "" for the one that is open, and changes of its settings
AGAIN = "Start again"
PRESETS: dict[str, tuple[str, Mapping[str, Any]]] = {
    AGAIN: ("", {}),
    "Storm": ("", {"gravity": GRAVITY, "wind": 5.0, "gust": 3.0, "fabric": "penava_cotton", "air_drag": 0.4}),
    # 4 substeps of 4.2 ms are far beyond what an explicit method bears with yarns as stiff as denim's
    "Make it explode": (
        "",
        {"gravity": GRAVITY, "fabric": "denim", "integrator": "semi_implicit_euler", "self_collision": "off", "substeps": 4},
    ),
    "Race a policy": ("race", {}),
}
Order = Callable[[str, Any], None]


@dataclass
class Control:
    """What the browser draws for one thing that can be turned or read.

    Attributes:
        kind: "slider", "number", "menu", "switch", "chips" or "button"; or "told", for what is only read.
        label, hint: in words; folder: that it is in, "" for those in sight.
        value: at present; low, high, step: of a slider or a number; options: values and their titles.
    """

    kind: str
    label: str = ""
    value: Any = None
    hint: str = ""
    folder: str = ""
    low: float = 0.0
    high: float = 1.0
    step: float = 1.0
    options: list[tuple[str, str]] = field(default_factory=list)
    visible: bool = True
    disabled: bool = False

    def __post_init__(self) -> None:
        self.turned: Callable[[Any], None] = lambda value: None
        self.known: dict[str, Any] = {}  # what the browser knows of it


class Controls(dict[str, Control]):
    """Controls by name.

    Args:
        order: queues what a visitor wants.
        setting: the present value of one.
        choices: names of scenes and environments, by title.
    """

    def __init__(self, order: Order, setting: Callable[[str], float | None], choices: Mapping[str, str]) -> None:
        super().__init__()
        self._order, self._setting = order, setting
        self._now = 1  # substeps at present
        scenes = [(name, title) for title, name in choices.items()]
        self._add("scene", Control("menu", "Scene", None, "a scene, or a task with its policies", options=scenes), "open")
        self._add("policy", Control("menu", "Who acts", None, "in this task"), "choose")
        self._add_sliders(WORLD[:IN_SIGHT], "")
        self._add_menu("fabric", "Fabric", FABRICS, "what the sheet is made of: measured fabrics")
        self._add_menu("integrator", "Integrator", INTEGRATORS, "the method that moves the cloth on in time")
        self._add("drop", Control("button", "Let go", hint="of the cloth: it falls, and is judged"), "drop")
        self._add("presets", Control("chips", options=[(label, label) for label in PRESETS if label != AGAIN]), "preset")
        self._add_sliders(WORLD[IN_SIGHT:], GUSTS)
        self._add_sliders(CLOTH, FABRIC)
        self._add_method()
        self["click"] = Control(
            "menu", "A click", CLICKS[0], "a shift-click does the other", COLORS, options=[(c, c) for c in CLICKS]
        )
        modes = [(MODES[0], "Fabric, strained threads light up"), (MODES[1], "Strain of all threads")]
        self["show"] = Control("menu", "Color by", MODES[0], "what the colors of the cloth say", COLORS, options=modes)
        self["seed"] = Control("number", "Seed", 0, "of the next start: other gusts, another episode", COLORS, high=2**31 - 1)
        self["kind"] = Control("menu", "As", "png", "what is saved", SAVE, options=list(SAVED.items()))
        self._add("save", Control("button", "Save", folder=SAVE), "save")
        for name in ("about", "strain", "readings", "verdict", "link", "time"):
            self[name] = Control("told")
        self._add("play", Control("told"), "press")
        self._add("moment", Control("told"), "scrub")

    def turn(self, name: Any, value: Any) -> None:
        """A visitor has turned a control; what that means is queued.

        Raises:
            KeyError, TypeError: there is no such control.
        """
        control = self[name]
        control.value = control.known["value"] = value
        control.turned(value)

    def news(self) -> dict[str, dict[str, Any]]:
        """What the browser does not know yet: properties that have changed, by control."""
        news = {}
        for name, control in self.items():
            now = {item.name: getattr(control, item.name) for item in fields(control)}
            if new := {key: value for key, value in now.items() if key not in control.known or control.known[key] != value}:
                news[name], control.known = new, now
        return news

    # --- of the open stage ------------------------------------------------------------------------------------------------

    def suit(self, stage: Stage) -> None:
        """Show the controls of a stage that has just been opened."""
        scene = isinstance(stage, SceneStage)
        self["about"].value = f"{stage.about} {ADVICE}" if scene else stage.about
        self["scene"].value = stage.name
        for name, control in self.items():
            if name in ("gravity", "wind", "fabric", "integrator", "click") or control.folder in (GUSTS, FABRIC, METHOD):
                control.visible = scene
        self["drop"].visible = stage.drops
        self["seed"].value = stage.seed
        self["policy"].visible = bool(stage.policies)
        if stage.policies:
            self["policy"].options = [(name, titled(name)) for name in stage.policies]
            self["policy"].value = stage.policy

    def fill(self, stage: SceneStage) -> None:
        """Set the controls to a scene's settings, which queues no orders."""
        settings = stage.settings
        for name, _, largest, _, unit, _ in (*WORLD, *CLOTH):
            value = round((getattr(settings, name) or 0.0) / unit, 9)
            self[name].high = max(largest, value)
            self[name].value = value
        for name in ("fabric", "integrator", "bending", "self_collision"):
            self[name].value = getattr(settings, name)
        self._now = now = stage.simulation.substeps
        self["auto"].value = self["substeps"].disabled = settings.substeps == "auto"
        self["substeps"].high = max(MOST_SUBSTEPS, now)
        self["substeps"].value = now

    # --- how they are made ------------------------------------------------------------------------------------------------

    def _add(self, name: str, control: Control, what: str, meant: Callable[[Any], Any] = lambda value: value) -> None:
        """Let a control queue an order when a visitor turns it."""
        self[name] = control

        def turned(value: Any) -> None:
            try:
                self._order(what, meant(value))
            except ValueError as error:
                self._order("refuse", str(error))

        control.turned = turned

    def _add_sliders(self, sliders: tuple[Any, ...], folder: str) -> None:
        for name, label, largest, step, unit, hint in sliders:

            def meant(
                value: Any, name: str = name, label: str = label, largest: float = largest, unit: float = unit
            ) -> dict[str, float | None]:
                # a preset may lie beyond the slider
                present = (self._setting(name) or 0.0) / unit
                given = round(number_within(label, value, 0.0, max(largest, present)) * unit, 12)
                return {name: None if name == "strain_limit" and not given else given}

            self._add(name, Control("slider", label, 0.0, hint, folder, high=largest, step=step), "change", meant)

    def _add_menu(self, name: str, label: str, names: Any, hint: str, folder: str = "") -> None:
        options = [(one, titled(one)) for one in names]
        self._add(name, Control("menu", label, None, hint, folder, options=options), "change", lambda value: {name: value})

    def _add_method(self) -> None:
        self._add_menu("bending", "Bending", BENDING, "how the sheet resists being bent", METHOD)
        hint = "whether the sheet feels itself"
        self._add_menu("self_collision", "Self-collision", ("off", "fast", "strict"), hint, METHOD)
        auto = Control("switch", "Safe substeps", True, "as many as the method needs to be stable", METHOD)
        hint = "into which 1/60 s is divided; too few, and an explicit method explodes"
        for name, control in (("auto", auto), ("substeps", Control("slider", "Substeps", 1, hint, METHOD, 1, MOST_SUBSTEPS))):
            self._add(name, control, "change", lambda _: {"substeps": self._substeps()})

    def _substeps(self) -> int | str:
        """What the controls say, within their range."""
        if self["auto"].value:
            return "auto"
        return int(number_within("substeps", self["substeps"].value, 1, max(MOST_SUBSTEPS, self._now)))


# --- readings ---------------------------------------------------------------------------------------------------------


NOTHING = "–"  # where there is nothing to read


def readings_table(recording: Recording, frame: Frame, stability: Stability | None = None) -> list[list[str]]:
    """The readings as rows of a name and a cell for each sheet; stability: of a scene's."""
    readings = frame.readings
    rows = [["", *map(titled, recording.labels)]] if len(recording.labels) > 1 else []
    rows += [
        ["Largest stretch", *numbers(100 * readings["strain"], "{:.2f} %")],
        ["Energy", *numbers(1e3 * readings["energy"], "{:.4g} mJ")],
        ["Cost of a step", *numbers(1e3 * readings["cost"], "{:.2f} ms")],
    ]
    if stability is not None:
        rows.append(["Substep", f"{1e3 * stability.substep:.3g} ms"])
        rows.append(["Its bound", f"{1e3 * stability.bound:.3g} ms" if stability.bound > 0 else "none"])
        rows.append(["Stability", stability.verdict])
    return rows + [[f"Reward: {name.replace('_', ' ')}", f"{value:+.4f}"] for name, value in frame.terms.items()]


def numbers(values: NDArray, form: str) -> list[str]:
    """Each number in that form; nothing where there is none."""
    return [form.format(value) if np.isfinite(value) else NOTHING for value in values]

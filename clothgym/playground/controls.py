"""The controls of a page: five in sight, presets, and all others in folders; readings and a legend."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.bending import BENDING
from clothgym.integrators import INTEGRATORS
from clothgym.material import PRESETS as FABRICS
from clothgym.playground.exporting import SAVED
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import CLOTH, WORLD, number_within
from clothgym.playground.show import MODES, RAMP, STOPS
from clothgym.playground.stage import SceneStage, Stability, Stage
from clothgym.simulation import GRAVITY

MOST_SUBSTEPS = 400
IN_SIGHT = 2  # sliders of WORLD that are not in a folder
WIDTH = 320  # of the panel [pixels]
CLICKS = ("pins it, or frees it", "blows on it")
ADVICE = "**Drag** the cloth to pull and throw it. **Click** it to pin it or to free it, **shift-click** to blow on it."
# what a button does at once: the scene that it opens, "" for the one that is open, and changes of its settings
AGAIN = "start again"
PRESETS: dict[str, tuple[str, Mapping[str, Any]]] = {
    AGAIN: ("", {}),
    "storm": ("", {"gravity": GRAVITY, "wind": 9.0, "gust": 4.0, "fabric": "penava_cotton", "air_drag": 0.4}),
    # 4 substeps of 4.2 ms are far beyond what an explicit method bears with yarns as stiff as denim's
    "make it explode": (
        "",
        {"gravity": GRAVITY, "fabric": "denim", "integrator": "semi_implicit_euler", "self_collision": "off", "substeps": 4},
    ),
    "race": ("race", {}),
}
Order = Callable[[str, Any], None]


class Controls(dict[str, Any]):
    """Handles by name.

    Args:
        gui: viser's, or a null viewer's.
        order: queues what a visitor wants.
        setting: the present value of one.
        choices: names of scenes and environments, by title.
    """

    def __init__(self, gui: Any, order: Order, setting: Callable[[str], float | None], choices: Mapping[str, str]) -> None:
        super().__init__()
        self._gui, self._order, self._setting, self._choices = gui, order, setting, choices
        self._now = 1  # substeps at present
        self["about"] = gui.add_markdown("")
        self._add("scene", gui.add_dropdown("scene", tuple(choices), hint="a scene, or a task with its policies"), "open")
        self._add("policy", gui.add_dropdown("who acts", ("expert",), hint="in this task"), "choose")
        self._add_sliders(WORLD[:IN_SIGHT])
        self._add_menu("fabric", "fabric", FABRICS, "what the sheet is made of: measured fabrics")
        self._add_menu("integrator", "integrator", INTEGRATORS, "the method that moves the cloth on in time")
        self._add("drop", gui.add_button("Let go", hint="of the cloth: it falls, and is judged"), "drop")
        self._add("presets", gui.add_button_group("", tuple(PRESETS)), "preset")
        self["glance"], self["legend"], self["notes"] = gui.add_markdown(""), gui.add_html(""), gui.add_markdown("")
        with gui.add_folder("Time", expand_by_default=False):
            self._add("time", gui.add_button_group("", ("play / pause", "step", "reset")), "press")
            self["state"] = gui.add_markdown("")
            self["seed"] = gui.add_number("seed", 0, min=0, step=1, hint="of the next reset: other gusts, another episode")
            self._add("moment", gui.add_slider("moment", 0, 1, 1, 0, hint="frames so far; drag back to see them again"), "scrub")
        self["World"] = gui.add_folder("Gusts and friction", expand_by_default=False)
        with self["World"]:
            self._add_sliders(WORLD[IN_SIGHT:])
        self["Cloth"] = gui.add_folder("The fabric in numbers", expand_by_default=False)
        with self["Cloth"]:
            self._add_sliders(CLOTH)
        self["Method"] = gui.add_folder("How it is computed", expand_by_default=False)
        with self["Method"]:
            self._add_method()
        with gui.add_folder("Hands and colors", expand_by_default=False):
            self["click"] = gui.add_dropdown("a click", CLICKS, hint="a shift-click does the other")
            hint = "fabric: strained threads light up; strain: all threads are colored"
            self._add("show", gui.add_dropdown("color by", MODES, hint=hint), "look")
        with gui.add_folder("Readings", expand_by_default=False):
            self["readings"] = gui.add_markdown("")
        with gui.add_folder("Save", expand_by_default=False):
            self["kind"] = gui.add_dropdown("as", tuple(SAVED.values()))
            hint = "copy this link to open the page with the present scene, settings, seed and pins"
            self["link"] = gui.add_text("link", "", hint=hint)
            kinds = {label: kind for kind, label in SAVED.items()}
            self._add("save", gui.add_button("Save"), "save", lambda _: kinds.get(str(self["kind"].value), "png"))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)

    # --- of the open stage ------------------------------------------------------------------------------------------------

    def suit(self, stage: Stage) -> None:
        """Show the controls of a stage that has just been opened."""
        scene = isinstance(stage, SceneStage)
        self["about"].content = f"{stage.about}\n\n{ADVICE}" if scene else stage.about
        self["scene"].value = next(title for title, name in self._choices.items() if name == stage.name)
        for name in ("gravity", "wind", "fabric", "integrator", "World", "Cloth", "Method"):
            self[name].visible = scene
        self["drop"].visible = stage.drops
        self["click"].visible = scene
        self["seed"].value = stage.seed
        self["policy"].visible = bool(stage.policies)
        if stage.policies:
            self["policy"].options = tuple(stage.policies)
            self["policy"].value = stage.policy
        self["show"].value = MODES[0]

    def fill(self, stage: SceneStage) -> None:
        """Set the controls to a scene's settings, which queues no orders."""
        settings = stage.settings
        for name, _, largest, _, unit, _ in (*WORLD, *CLOTH):
            value = round((getattr(settings, name) or 0.0) / unit, 9)
            self[name].max = max(largest, value)
            self[name].value = value
        for name in ("fabric", "integrator", "bending", "self_collision"):
            self[name].value = getattr(settings, name)
        self._now = now = stage.simulation.substeps
        self["auto"].value = self["substeps"].disabled = settings.substeps == "auto"
        self["substeps"].max = max(MOST_SUBSTEPS, now)
        self["substeps"].value = now

    # --- how they are made ------------------------------------------------------------------------------------------------

    def _add(self, name: str, control: Any, what: str, meant: Callable[[Any], Any] = lambda value: value) -> None:
        """Let a control queue an order when a visitor moves it, not when the page sets it."""
        self[name] = control

        def turned(event: Any) -> None:
            if event.client_id is not None:
                try:
                    self._order(what, meant(event.target.value))
                except ValueError as error:
                    self._order("refuse", str(error))

        (control.on_click if hasattr(control, "on_click") else control.on_update)(turned)

    def _add_sliders(self, sliders: tuple[Any, ...]) -> None:
        for name, label, largest, step, unit, hint in sliders:
            slider = self._gui.add_slider(label, 0.0, largest, step, 0.0, hint=hint)

            def meant(
                value: Any, name: str = name, label: str = label, largest: float = largest, unit: float = unit
            ) -> dict[str, float | None]:
                # a preset may lie beyond the slider
                present = (self._setting(name) or 0.0) / unit
                given = round(number_within(label, value, 0.0, max(largest, present)) * unit, 12)
                return {name: None if name == "strain_limit" and not given else given}

            self._add(name, slider, "change", meant)

    def _add_menu(self, name: str, label: str, names: Any, hint: str) -> None:
        self._add(name, self._gui.add_dropdown(label, tuple(names), hint=hint), "change", lambda value: {name: value})

    def _add_method(self) -> None:
        self._add_menu("bending", "bending", BENDING, "how the sheet resists being bent")
        self._add_menu("self_collision", "touches itself", ("off", "fast", "strict"), "strict: it never passes through itself")
        auto = self._gui.add_checkbox("safe substeps", True, hint="as many as the method needs to be stable")
        hint = "into which 1/60 s is divided; too few, and an explicit method explodes"
        for name, control in (("auto", auto), ("substeps", self._gui.add_slider("substeps", 1, MOST_SUBSTEPS, 1, 1, hint=hint))):
            self._add(name, control, "change", lambda _: {"substeps": self._substeps()})

    def _substeps(self) -> int | str:
        """What the controls say, within their range."""
        if self["auto"].value:
            return "auto"
        return int(number_within("substeps", self["substeps"].value, 1, max(MOST_SUBSTEPS, self._now)))


# --- readings ---------------------------------------------------------------------------------------------------------


NOTHING = "–"  # where there is nothing to read


def readings_table(recording: Recording, frame: Frame, stability: Stability | None = None) -> str:
    """The readings as a table, a column for each sheet; stability: of a scene's."""
    readings = frame.readings
    rows = [
        ("time", [f"{frame.time:.2f} s"]),
        ("largest stretch", numbers(100 * readings["strain"], "{:.2f} %")),
        ("energy", numbers(1e3 * readings["energy"], "{:.4g} mJ")),
        ("a step is computed in", numbers(1e3 * readings["cost"], "{:.2f} ms")),
    ]
    if stability is not None:
        rows.append(("substep", [f"{1e3 * stability.substep:.3g} ms"]))
        rows.append(("its bound", [f"{1e3 * stability.bound:.3g} ms" if stability.bound > 0 else "none"]))
        rows.append(("stability", [stability.verdict]))
    rows += [(f"reward: {name}", [f"{value:+.4f}"]) for name, value in frame.terms.items()]
    count = len(recording.labels)
    head = "| |" + "|".join(label.replace("_", " ") for label in recording.labels) + "|\n|---|" + "---:|" * count
    lines = [f"| {name} | " + " | ".join([*cells] + [""] * (count - len(cells))) + " |" for name, cells in rows]
    return "\n".join([head, *lines])


def glance(recording: Recording, frame: Frame) -> str:
    """The one reading that is always in sight: the largest strain of each sheet."""
    stretched = numbers(100 * frame.readings["strain"], "{:.2f} %")
    labels = [f"{label.replace('_', ' ')} " for label in recording.labels] if len(stretched) > 1 else [""]
    return "Stretched at most: " + ", ".join(f"{label}**{value}**" for label, value in zip(labels, stretched)) + "."


def numbers(values: NDArray, form: str) -> list[str]:
    """Each number in that form; nothing where there is none."""
    return [form.format(value) if np.isfinite(value) else NOTHING for value in values]


def legend(mode: str, strained: float) -> str:
    """The legend of the colors, as HTML; strained: where they end."""
    # in the fabric's own colors only strained threads light up
    low, words = (
        (0.0, "<span>threads at rest</span>") if mode == "fabric" else (-1.0, "<span>compressed</span><span>at rest</span>")
    )
    stops = ", ".join(
        f"rgb({r:.0f},{g:.0f},{b:.0f}) {100 * (s - low) / (1 - low):.0f}%" for s, (r, g, b) in zip(STOPS, RAMP) if s >= low
    )
    bar = f'<div style="height:8px;border-radius:4px;background:linear-gradient(to right, {stops})"></div>'
    row = '<div style="display:flex;justify-content:space-between;font-size:0.75em">'
    return f'<div style="margin:0 12px">{bar}{row}{words}<span>stretched: {100 * strained:.3g} %</span></div></div>'

"""The controls of a page: five in sight, presets, and all others in folders that are closed at first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from clothgym.bending import BENDING
from clothgym.integrators import INTEGRATORS
from clothgym.material import PRESETS as FABRICS
from clothgym.playground import files
from clothgym.playground.plots import Plots
from clothgym.playground.presets import PRESETS
from clothgym.playground.race import Race
from clothgym.playground.show import MODES
from clothgym.playground.stage import SceneStage, Stage
from clothgym.playground.world import CLOTH, WORLD, Settings, number_within

NONE = "none"
ATTACHMENTS = 4  # anchors and grippers that a visitor can close and open
MOST_SUBSTEPS = 400
IN_SIGHT = ("gravity", "wind")  # sliders that are not in a folder
WIDTH = 320  # of the panel [pixels]
CLICKS = ("pins it, or frees it", "blows on it")
ADVICE = "**Drag** the cloth to pull and throw it. **Click** it to pin it or to free it, **shift-click** to blow on it."
Order = Callable[[str, Any], None]


class Controls(dict[str, Any]):
    """Handles by name.

    Args:
        gui: viser's, or a null viewer's.
        order: queues what a visitor wants.
        settings: those that hold now.
        choices: names of scenes and environments, by title.
    """

    def __init__(self, gui: Any, order: Order, settings: Callable[[], Settings], choices: Mapping[str, str]) -> None:
        super().__init__()
        self._order, self._settings, self._choices = order, settings, choices
        self._now = 1  # substeps at present
        add = self._add
        add("about", gui.add_markdown(""))
        scene = add("scene", gui.add_dropdown("scene", tuple(choices), hint="what is shown: a scene, or a task with its policies"))
        self._ordered(scene, "open")
        self._ordered(add("policy", gui.add_dropdown("who acts", ("expert",), hint="in this task")), "choose")
        self._add_sliders(gui, [slider for slider in WORLD if slider[0] in IN_SIGHT])
        self._menu(gui, "fabric", "fabric", FABRICS, "what the sheet is made of: measured fabrics")
        self._menu(gui, "integrator", "integrator", INTEGRATORS, "the method that moves the cloth on in time")
        drop = add("drop", gui.add_button("Let go", hint="of the cloth: it falls, and is judged"))
        self._ordered(drop, "drop")
        presets = add("presets", gui.add_button_group("", tuple(PRESETS)))
        self._ordered(presets, "preset")
        add("glance", gui.add_markdown(""))
        add("legend", gui.add_html(""))
        add("working", gui.add_progress_bar(100.0, animated=True, visible=False))
        add("notes", gui.add_markdown(""))
        with gui.add_folder("Time", expand_by_default=False):
            self._add_time(gui)
        with add("World", gui.add_folder("Gusts and friction", expand_by_default=False)):
            self._add_sliders(gui, [slider for slider in WORLD if slider[0] not in IN_SIGHT])
        with add("Cloth", gui.add_folder("The fabric in numbers", expand_by_default=False)):
            self._add_sliders(gui, CLOTH)
            hint = "restarts with a second, pale sheet: the same without the limit"
            self._ordered(add("unlimited", gui.add_checkbox("without the limit, too", False, hint=hint)), "compare")
        with add("Method", gui.add_folder("How it is computed", expand_by_default=False)):
            self._add_method(gui)
        with add("Compare", gui.add_folder("Integrators side by side", expand_by_default=False)):
            self._add_comparison(gui)
        with gui.add_folder("Hands and colors", expand_by_default=False):
            self._add_view(gui)
        with gui.add_folder("Readings", expand_by_default=False):
            add("readings", gui.add_markdown(""))
            self.plots = Plots(gui)
        with gui.add_folder("Save", expand_by_default=False):
            kinds = add("kind", gui.add_dropdown("as", tuple(files.KINDS.values()), initial_value=files.KINDS["png"]))
            names = {label: kind for kind, label in files.KINDS.items()}
            hint = "copy it: it opens the page with what is shown now, its settings, seed and pins"
            add("link", gui.add_text("link", "", hint=hint))
            self._ordered(add("save", gui.add_button("Save")), "save", lambda _: names.get(kinds.value, "png"))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)

    # --- of the open stage ------------------------------------------------------------------------------------------------

    def suit(self, stage: Stage) -> None:
        """Show the controls of a stage that has just been opened."""
        simulated = bool(stage.stabilities())
        scene = isinstance(stage, SceneStage)
        self["about"].content = f"{stage.about}\n\n{ADVICE}" if scene else stage.about
        self["scene"].value = next(title for title, name in self._choices.items() if name == stage.name)
        for name in ("gravity", "wind", "fabric", "integrator", "World", "Cloth", "Method"):
            self[name].visible = simulated
        self["drop"].visible = isinstance(stage, Race)
        self["Compare"].visible = self["click"].visible = scene
        self["compare"].value = self["unlimited"].value = False
        self["seed"].value = stage.seed
        policies = tuple(getattr(stage, "policies", ()))
        self["policy"].visible = bool(policies)
        if policies:
            self["policy"].options = policies
            self["policy"].value = stage.policy  # type: ignore[attr-defined]
        attachments = dict(enumerate(attachment for attachment in stage.attachments()[:ATTACHMENTS] if attachment.draggable))
        self["handles"].visible = bool(attachments)
        self["handles"].value = False
        for number in range(ATTACHMENTS):
            self[f"attachment {number}"].visible = number in attachments
            if number in attachments:
                self[f"attachment {number}"].label = f"{attachments[number].name} holds"
                self[f"attachment {number}"].value = attachments[number].holds
        self["show"].value = "fabric"

    def fill(self, stage: Stage) -> None:
        """Set the controls to a stage's settings, which queues no orders."""
        settings = stage.settings
        for name, _, largest, _, unit, _ in (*WORLD, *CLOTH):
            value = round((getattr(settings, name) or 0.0) / unit, 9)
            self[name].max = max(largest, value)
            self[name].value = value
        for name in ("fabric", "integrator", "bending", "self_collision"):
            self[name].value = getattr(settings, name)
        compared = stage.compared if isinstance(stage, SceneStage) else ()
        stabilities = stage.stabilities()
        self["unlimited"].visible = isinstance(stage, SceneStage) and settings.strain_limit is not None and not compared
        self["integrator"].visible = bool(stabilities) and not (compared and compared[0] in INTEGRATORS)
        self["fabric"].visible = bool(stabilities) and not (compared and compared[0] in FABRICS)
        if stabilities:
            self._now = now = round(stabilities[0].time_step / stabilities[0].substep)
            self["auto"].value = settings.substeps == "auto"
            self["substeps"].disabled = settings.substeps == "auto"
            self["substeps"].max = max(MOST_SUBSTEPS, now)
            self["substeps"].value = now

    @property
    def chosen_integrators(self) -> list[str]:
        """Those to be compared, if any."""
        names = [self[f"compared {k}"].value for k in range(4)]
        return [name for name in names if name != NONE] if self["compare"].value else []

    # --- how they are made ------------------------------------------------------------------------------------------------

    def _add(self, name: str, control: Any) -> Any:
        self[name] = control
        return control

    def _ordered(self, control: Any, what: str, meant: Callable[[Any], Any] = lambda value: value) -> None:
        """Let a control queue an order when a visitor moves it, not when the page sets it."""

        def turned(event: Any) -> None:
            if event.client_id is not None:
                try:
                    self._order(what, meant(event.target.value))
                except ValueError as error:
                    self._order("refuse", str(error))

        (control.on_click if hasattr(control, "on_click") else control.on_update)(turned)

    def _add_time(self, gui: Any) -> None:
        buttons = gui.add_button_group("", ("play / pause", "step", "reset"))
        self._ordered(self._add("time", buttons), "press")
        self._add("state", gui.add_markdown(""))
        self._add("seed", gui.add_number("seed", 0, min=0, step=1, hint="of the next reset: other gusts, another episode"))
        scrub = self._add("moment", gui.add_slider("moment", 0, 1, 1, 0, hint="frames so far; drag back to see them again"))
        self._ordered(scrub, "scrub")

    def _add_sliders(self, gui: Any, sliders: list[Any] | tuple[Any, ...]) -> None:
        for name, label, largest, step, unit, hint in sliders:
            slider = self._add(name, gui.add_slider(label, 0.0, largest, step, 0.0, hint=hint))

            def meant(
                value: Any, name: str = name, label: str = label, largest: float = largest, unit: float = unit
            ) -> dict[str, float | None]:
                # a preset may lie beyond the slider
                present = (getattr(self._settings(), name) or 0.0) / unit
                given = round(number_within(label, value, 0.0, max(largest, present)) * unit, 12)
                return {name: None if name == "strain_limit" and not given else given}

            self._ordered(slider, "change", meant)

    def _menu(self, gui: Any, name: str, label: str, names: Any, hint: str | None = None) -> None:
        menu = self._add(name, gui.add_dropdown(label, tuple(names), hint=hint))
        self._ordered(menu, "change", lambda value: {name: value})

    def _add_method(self, gui: Any) -> None:
        self._menu(gui, "bending", "bending", BENDING, "how the sheet resists being bent")
        self._menu(gui, "self_collision", "touches itself", ("off", "fast", "strict"), "strict: it never passes through itself")
        auto = self._add("auto", gui.add_checkbox("safe substeps", True, hint="as many as the method needs to be stable"))
        hint = "into which 1/60 s is divided; too few, and an explicit method explodes"
        substeps = self._add("substeps", gui.add_slider("substeps", 1, MOST_SUBSTEPS, 1, 1, hint=hint))

        for control in (auto, substeps):
            self._ordered(control, "change", lambda _: {"substeps": self._substeps()})

    def _substeps(self) -> int | str:
        """What the controls say, within their range."""
        if self["auto"].value:
            return "auto"
        return int(number_within("substeps", self["substeps"].value, 1, max(MOST_SUBSTEPS, self._now)))

    def _add_comparison(self, gui: Any) -> None:
        on = self._add(
            "compare", gui.add_checkbox("compare", False, hint="two to four integrators, a sheet each, with the same settings")
        )
        self._ordered(on, "compare")
        for k, first in enumerate(("semi_implicit_euler", "xpbd", NONE, NONE)):
            menu = self._add(f"compared {k}", gui.add_dropdown(f"sheet {k + 1}", (NONE, *INTEGRATORS), initial_value=first))
            self._ordered(menu, "compare")

    def _add_view(self, gui: Any) -> None:
        hint = "a shift-click does the other"
        self._add("click", gui.add_dropdown("a click", CLICKS, hint=hint))
        hint = "fabric: strained threads light up; strain and tension: all threads; contact: where it touches a solid"
        self._add("show", gui.add_dropdown("color by", MODES, hint=hint))
        self._add("diagonals", gui.add_checkbox("show diagonals", False, hint="the threads that resist shear, too"))
        self._add("handles", gui.add_checkbox("handles to drag", False, hint="at what holds the sheet"))
        for name in ("show", "diagonals", "handles"):
            self._ordered(self[name], "look")
        for number in range(ATTACHMENTS):
            box = self._add(f"attachment {number}", gui.add_checkbox("holds", False))
            self._ordered(box, "hold", lambda holds, number=number: (number, bool(holds)))  # type: ignore[misc]

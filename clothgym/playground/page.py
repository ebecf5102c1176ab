"""The page of one visitor: controls, readings and what is saved.  It knows a viewer's interface, not the library behind it."""

from __future__ import annotations

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from clothgym.bending import BENDING
from clothgym.integrators import INTEGRATORS
from clothgym.material import PRESETS
from clothgym.playground import files
from clothgym.playground.plots import Plots
from clothgym.playground.readings import legend, readings_table
from clothgym.playground.show import MODES, Show
from clothgym.playground.stage import REBUILDS, SceneStage, Stage
from clothgym.playground.world import CLOTH, WORLD, number_within

NONE = "none"
SIDE_BY_SIDE = 0.55  # share of its distance by which the eye moves back for each further sheet
NARROWER = 0.35  # and for each further sheet whose readings make the view narrower
ROOM = 1.25  # distance of the page's eye relative to that of a picture, since panels make the view narrower
ATTACHMENTS = 4  # anchors and grippers that a visitor can close and open
MOST_SUBSTEPS, LARGEST_SEED = 400, 2**31 - 1
FRAME_BUDGET = 0.5  # of orders, and of computing, for one frame [s]
MOST_ORDERS = 10_000  # that wait; a drag gives sixty a second, and compiling takes a minute
LEFT, COLUMN = 290, 75  # width of the left panel, and added to it for the readings of a third and a fourth sheet [pixels]
READ_EVERY = 0.2  # between two updates of numbers and plots [s]


class Page:
    """One visitor's page.

    Args:
        client: viser's, or a ``NullClient``.
        open_stage: makes the stage of a name.
        choices: names of scenes and environments, by title.
        start: the name shown first.
        left: whether the visitor has left.

    ``tick`` is called by one thread only; a visitor's actions come in a queue.  A browser may send anything, and may change a
    control's range: what it sends is checked here, against ranges of our own.
    """

    def __init__(
        self,
        client: Any,
        open_stage: Callable[[str], Stage],
        choices: Mapping[str, str],
        start: str,
        left: Callable[[], bool] = lambda: False,
    ) -> None:
        self._left = left
        self.client, self._open_stage, self.choices = client, open_stage, dict(choices)
        self._orders: Queue[tuple[str, Any]] = Queue(MOST_ORDERS)
        self.playing, self.moment = True, 0
        self._stale = True  # whether the view must be drawn again
        self._waiting: Any = None  # notification that the next frame takes a while
        self._fresh = False  # whether the stage has not advanced since it was built, and may have to compile first
        self.controls: dict[str, Any] = {}
        self._now = 1  # substeps at present
        self.stage: Stage
        self.open(start)

    # --- what a visitor does --------------------------------------------------------------------------------------------

    def order(self, what: str, value: Any = None) -> None:
        """Queue what a visitor wants, for the next tick; too many orders are dropped."""
        with contextlib.suppress(Full):
            self._orders.put_nowait((what, value))

    def tick(self) -> None:
        """Carry out the orders, advance if playing, and show what has changed; nothing more once the visitor has left."""
        changes: dict[str, Any] = {}
        until = time.monotonic() + FRAME_BUDGET
        # orders that take longer wait for the next tick
        while not self._left() and time.monotonic() < until:
            try:
                what, value = self._orders.get_nowait()
            except Empty:
                break
            if what == "drag":
                self._do(self.stage.drag, *value)
            elif what == "change":
                changes |= value
            else:
                self._do(getattr(self, f"_{what}"), value)
        if self._left():
            return
        self._change(changes)
        if self.playing and not self._at_the_end:
            self.playing = self._do(self._advance)
        if self._stale:
            self._do(self._draw)
            self._stale = False
        if self._waiting is not None:
            self._waiting.remove()
            self._waiting = None

    @property
    def _at_the_end(self) -> bool:
        """Whether the last frame is shown and the stage is over."""
        return self.stage.over and self.moment == len(self.stage.recording.frames) - 1

    def _advance(self) -> None:
        """Advance to the next frame; when the stage is over, to the next one recorded."""
        if self.stage.over:
            self.moment = min(self.moment + 1, len(self.stage.recording.frames) - 1)
            return
        if self._fresh:
            self._wait("Rebuilding.")
        self._fresh = False
        self.stage.advance()
        self.moment = len(self.stage.recording.frames) - 1

    def _wait(self, why: str) -> None:
        """Show a notification until the next frame is there: what was rebuilt may have to be compiled first."""
        self._fresh = True
        if self._waiting is None:
            words = f"{why} The first time on a machine it is compiled, which takes up to a minute."
            self._waiting = self.client.add_notification("One moment", words, loading=True)

    def _do(self, deed: Callable[..., Any], *values: Any) -> bool:
        """Do something; returns whether it worked.  If not, a notification says why."""
        self._stale = True
        try:
            deed(*values)
        except (ValueError, OSError, ImportError) as error:
            self.client.add_notification("Not possible", str(error), color="orange", auto_close_seconds=12.0)
        except Exception as error:  # policies and recordings come from users
            traceback.print_exc(file=sys.stderr)
            self.playing = False
            words = f"Stopped: {type(error).__name__}, {error}. Reset, or choose another policy or another scene."
            self.client.add_notification("Something failed", words, color="red", auto_close_seconds=20.0)
        else:
            return True
        return False

    def _change(self, changes: Mapping[str, Any]) -> None:
        changes = {name: value for name, value in changes.items() if getattr(self.stage.settings, name) != value}
        if not changes:
            return
        if any(name in REBUILDS for name in changes):
            self._wait("Rebuilding.")
        self._do(lambda: self.stage.change(**changes))
        if "strain_limit" in changes and isinstance(self.stage, SceneStage):
            self._do(self._compare)
        self._fill()

    def open(self, name: str) -> None:
        """Show another scene, environment or recording."""
        self.stage = self._open_stage(name)
        self.stage.left, self.stage.budget = self._left, FRAME_BUDGET
        self.playing, self.moment = True, 0
        if not self.controls:
            self._build()
        self._suit()
        self._see()

    def _open(self, title: str) -> None:
        name = self.choices.get(title, self.stage.name)
        if name != self.stage.name:
            self._wait(f"Opening {name}.")
            self.open(name)

    def _press(self, button: str) -> None:
        if button == "reset":
            self.stage.reset(int(number_within("seed", self.controls["seed"].value, 0, LARGEST_SEED)))
            self.moment, self.playing = 0, True
        elif button == "step":
            self.playing = False
            self._advance()
        else:
            self.playing = not self.playing

    def _scrub(self, moment: float) -> None:
        """Show an earlier frame."""
        last = len(self.stage.recording.frames) - 1
        self.playing, self.moment = False, int(number_within("moment", moment, 0, last))

    def _compare(self, _: Any = None) -> None:
        assert isinstance(self.stage, SceneStage)
        names = [self.controls[f"compared {k}"].value for k in range(4)]
        chosen = [name for name in names if name != NONE] if self.controls["compare"].value else []
        limit = self.stage.settings.strain_limit
        unlimited = bool(self.controls["unlimited"].value) and limit is not None and not chosen
        if (tuple(chosen), unlimited) != (self.stage.compared, self.stage.unlimited):
            self._wait("Comparing." if chosen or unlimited else "Rebuilding.")
            self.stage.compare(chosen, unlimited)
            self.moment = 0
            self.controls["show"].value = "fabric"  # in which each method has its color
            more = len(self.stage.sheets) - 1
            self._stand_back(1 + SIDE_BY_SIDE * more + NARROWER * max(0, more - 1))
            self.panel.set_width(LEFT + COLUMN * max(0, more - 1))
            self._see()

    def _choose(self, policy: str) -> None:
        before = self.stage.recording
        self.stage.choose(policy)  # type: ignore[attr-defined]
        if self.stage.recording is not before:  # the policy was trained in an environment with other options
            self.moment = 0
            self._see()

    def _hold(self, value: tuple[int, bool]) -> None:
        number, holds = value
        attachments = self.stage.attachments()[:ATTACHMENTS]
        if number >= len(attachments):  # only a browser of a stranger sends this
            raise ValueError(f"attachment={number}: this sheet has {len(attachments)}")
        if attachments[number].holds != holds:
            self.stage.hold(number, holds)

    def _refuse(self, why: str) -> None:
        """Set the controls back to what holds, and say why."""
        self._fill()
        raise ValueError(why)

    def _look(self, _: Any = None) -> None:
        """Draw again: only the view has changed."""

    def _save(self, kind: str) -> None:
        waiting = self.client.add_notification("One moment", f"Making {files.KINDS[kind]}.", loading=True)
        color = "strain" if self.controls["show"].value == "strain" else "fabric"
        try:
            name, content = files.made(kind, self.stage, self.moment, self.client.camera, color, self._left)
        finally:
            waiting.remove()
        self.client.send_file_download(name, content)

    # --- controls -------------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Create all controls, once; ``_suit`` shows those of the open stage."""
        gui, add = self.client.gui, self._add
        add("about", gui.add_markdown(""))
        add("scene", gui.add_dropdown("scene", tuple(self.choices)))
        self._ordered(self.controls["scene"], "open")
        add("notes", gui.add_markdown(""))
        with gui.add_folder("Time"):
            self._add_time(gui)
        with add("World", gui.add_folder("World")):
            self._add_sliders(gui, WORLD)
        with add("Cloth", gui.add_folder("Cloth")):
            self._menu(gui, "fabric", "fabric", PRESETS)
            self._add_sliders(gui, CLOTH)
            hint = "restarts with a second, pale sheet: the same without the limit"
            self._ordered(self._add("unlimited", gui.add_checkbox("without the limit, too", False, hint=hint)), "compare")
        with add("Method", gui.add_folder("Method")):
            self._add_method(gui)
        with add("Compare", gui.add_folder("Compare")):
            self._add_comparison(gui)
        with gui.add_folder("Save"):
            kinds = add("kind", gui.add_dropdown("as", tuple(files.KINDS.values()), initial_value=files.KINDS["png"]))
            names = {label: kind for kind, label in files.KINDS.items()}
            self._ordered(add("save", gui.add_button("Save")), "save", lambda _: names.get(kinds.value, "png"))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)
        panel = self.panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(LEFT)
        with panel.add_tab("What it does"):
            self._add_view(gui)
            add("readings", gui.add_markdown(""))
            self.plots = Plots(gui)

    def _suit(self) -> None:
        """Show the controls of the open stage, at its settings, and place the camera."""
        stage, controls = self.stage, self.controls
        simulated = bool(stage.stabilities())
        controls["about"].content = stage.about
        controls["scene"].value = next(title for title, name in self.choices.items() if name == stage.name)
        for name, shown in (
            ("World", simulated),
            ("Cloth", simulated),
            ("Method", simulated),
            ("Compare", isinstance(stage, SceneStage)),
        ):
            controls[name].visible = shown
        controls["compare"].value = controls["unlimited"].value = False
        controls["seed"].value = stage.seed
        policies = tuple(getattr(stage, "policies", ()))
        controls["policy"].visible = bool(policies)
        if policies:
            controls["policy"].options = policies
            controls["policy"].value = stage.policy  # type: ignore[attr-defined]
        attachments = dict(enumerate(attachment for attachment in stage.attachments()[:ATTACHMENTS] if attachment.draggable))
        controls["handles"].visible = bool(attachments)
        controls["handles"].value = any(attachment.holds for attachment in attachments.values()) and isinstance(stage, SceneStage)
        for number in range(ATTACHMENTS):
            controls[f"attachment {number}"].visible = number in attachments
            if number in attachments:
                controls[f"attachment {number}"].label = f"{attachments[number].name} holds"
                controls[f"attachment {number}"].value = attachments[number].holds
        controls["show"].value = "strain" if stage.name == "patch" else "fabric"
        self.panel.set_width(LEFT)
        self._stand_back(1.0)

    def _stand_back(self, share: float) -> None:
        """Place the camera where the stage is seen well, at ``share`` times that distance."""
        camera = self.stage.recording.camera
        back = np.subtract(camera.eye, camera.target) * ROOM * share
        self.client.camera.position, self.client.camera.look_at = tuple(camera.target + back), camera.target
        self.client.camera.near = 0.1  # a sheet is close to its solid, so depth must be resolved
        self.client.camera.fov = float(np.radians(camera.vertical_fov))

    def _add(self, name: str, control: Any) -> Any:
        self.controls[name] = control
        return control

    def _ordered(self, control: Any, what: str, meant: Callable[[Any], Any] = lambda value: value) -> None:
        """Let a control queue an order when a visitor moves it, not when the page sets it."""

        def turned(event: Any) -> None:
            if event.client_id is not None:
                try:
                    self.order(what, meant(event.target.value))
                except ValueError as error:
                    self.order("refuse", str(error))

        (control.on_click if hasattr(control, "on_click") else control.on_update)(turned)

    def _add_time(self, gui: Any) -> None:
        buttons = gui.add_button_group("", ("play / pause", "step", "reset"))
        self._ordered(self._add("time", buttons), "press")
        self._add("state", gui.add_markdown(""))
        self._add("seed", gui.add_number("seed", 0, min=0, step=1, hint="of the next reset"))
        scrub = self._add("moment", gui.add_slider("moment", 0, 1, 1, 0, hint="frames so far; drag back to see them again"))
        self._ordered(scrub, "scrub")
        menu = self._add("policy", gui.add_dropdown("who acts", ("expert",)))
        self._ordered(menu, "choose")

    def _add_sliders(self, gui: Any, sliders: tuple[tuple[str, str, float, float, float, str], ...]) -> None:
        for name, label, largest, step, unit, hint in sliders:
            slider = self._add(name, gui.add_slider(label, 0.0, largest, step, 0.0, hint=hint))

            def meant(
                value: Any, name: str = name, label: str = label, largest: float = largest, unit: float = unit
            ) -> dict[str, float | None]:
                # a preset may lie beyond the slider
                present = (getattr(self.stage.settings, name) or 0.0) / unit
                given = round(number_within(label, value, 0.0, max(largest, present)) * unit, 12)
                return {name: None if name == "strain_limit" and not given else given}

            self._ordered(slider, "change", meant)

    def _menu(self, gui: Any, name: str, label: str, names: Any, hint: str | None = None) -> None:
        menu = self._add(name, gui.add_dropdown(label, tuple(names), hint=hint))
        self._ordered(menu, "change", lambda value: {name: value})

    def _add_method(self, gui: Any) -> None:
        self._menu(gui, "integrator", "integrator", INTEGRATORS)
        self._menu(gui, "bending", "bending", BENDING)
        self._menu(gui, "self_collision", "with itself", ("off", "fast", "strict"), "contact of the sheet with itself")
        auto = self._add("auto", gui.add_checkbox("by the bound", True, hint="substeps follow the integrator's bound"))
        substeps = self._add("substeps", gui.add_slider("substeps", 1, MOST_SUBSTEPS, 1, 1))

        for control in (auto, substeps):
            self._ordered(control, "change", lambda _: {"substeps": self._substeps()})

    def _substeps(self) -> int | str:
        """What the controls say, within their range."""
        if self.controls["auto"].value:
            return "auto"
        return int(number_within("substeps", self.controls["substeps"].value, 1, max(MOST_SUBSTEPS, self._now)))

    def _add_comparison(self, gui: Any) -> None:
        on = self._add(
            "compare", gui.add_checkbox("compare", False, hint="two to four integrators, a sheet each, with the same settings")
        )
        self._ordered(on, "compare")
        for k, first in enumerate(("semi_implicit_euler", "xpbd", NONE, NONE)):
            menu = self._add(f"compared {k}", gui.add_dropdown(f"sheet {k + 1}", (NONE, *INTEGRATORS), initial_value=first))
            self._ordered(menu, "compare")

    def _add_view(self, gui: Any) -> None:
        self._add("show", gui.add_dropdown("color by", MODES))
        self._add("legend", gui.add_html(""))
        self._add("diagonals", gui.add_checkbox("show diagonals", False))
        self._add("handles", gui.add_checkbox("handles to drag", False))
        for name in ("show", "diagonals", "handles"):
            self._ordered(self.controls[name], "look")
        for number in range(ATTACHMENTS):
            box = self._add(f"attachment {number}", gui.add_checkbox("holds", False))
            self._ordered(box, "hold", lambda holds, number=number: (number, bool(holds)))  # type: ignore[misc]

    # --- what is shown --------------------------------------------------------------------------------------------------

    def _see(self) -> None:
        """Create the nodes of the stage's recording."""
        self.show = Show(self.client.scene, self.stage.recording, lambda attachment, place: self.order("drag", (attachment, place)))
        self.plots.begin(self.stage.recording)
        self._stale, self._read_at = True, -READ_EVERY
        self._fill()

    def _fill(self) -> None:
        """Set the controls to the settings, which queues no orders."""
        settings, controls = self.stage.settings, self.controls
        for name, _, largest, _, unit, _ in (*WORLD, *CLOTH):
            value = round((getattr(settings, name) or 0.0) / unit, 9)
            controls[name].max = max(largest, value)
            controls[name].value = value
        for name in ("fabric", "integrator", "bending", "self_collision"):
            controls[name].value = getattr(settings, name)
        compared = isinstance(self.stage, SceneStage) and bool(self.stage.compared)
        controls["unlimited"].visible = isinstance(self.stage, SceneStage) and settings.strain_limit is not None and not compared
        controls["integrator"].visible = not compared
        stabilities = self.stage.stabilities()
        if stabilities:
            self._now = now = round(stabilities[0].time_step / stabilities[0].substep)
            controls["auto"].value = settings.substeps == "auto"
            controls["substeps"].disabled = settings.substeps == "auto"
            controls["substeps"].max = max(MOST_SUBSTEPS, now)
            controls["substeps"].value = now

    def _draw(self) -> None:
        frames = self.stage.recording.frames
        self.moment = min(self.moment, len(frames) - 1)
        mode = self.controls["show"].value if self.controls["show"].value in MODES else MODES[0]
        with self.client.atomic():
            self.show.draw(frames[self.moment], mode, bool(self.controls["diagonals"].value))
            if self.moment == len(frames) - 1:
                self.show.draw_attachments(self.stage.attachments(), bool(self.controls["handles"].value))
        state = "■ over: reset to start again" if self._at_the_end else "▶ playing" if self.playing else "❚❚ paused"
        if self.controls["state"].content != state:
            self.controls["state"].content = state
        now = time.monotonic()
        if now - self._read_at >= READ_EVERY or not self.playing or self._at_the_end:
            self._read_at = now
            self._read(mode)

    def _read(self, mode: str) -> None:
        """Numbers, plots and notes."""
        frames, controls = self.stage.recording.frames, self.controls
        frame = frames[self.moment]
        controls["moment"].max = max(1, len(frames) - 1)
        controls["moment"].value = self.moment
        controls["notes"].content = "\n\n".join(f"> {note}" for note in self.stage.notes.values())
        controls["readings"].content = readings_table(self.stage.recording, frame, self.stage.stabilities())
        controls["legend"].content = legend(self.stage.recording, frame, mode)
        for number, attachment in enumerate(self.stage.attachments()[:ATTACHMENTS]):
            controls[f"attachment {number}"].value = attachment.holds
        self.plots.draw(frames[: self.moment + 1])

"""The page of one visitor: what they do, and what is shown of it.  It knows a viewer's interface, not the library behind it."""

from __future__ import annotations

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from clothgym.playground import files, hands, link
from clothgym.playground.controls import ATTACHMENTS, CLICKS, Controls
from clothgym.playground.presets import AGAIN, PRESETS
from clothgym.playground.race import Race
from clothgym.playground.readings import glance, legend, readings_table
from clothgym.playground.show import MODES, Show
from clothgym.playground.stage import REBUILDS, SceneStage, Stage
from clothgym.playground.world import number_within

SIDE_BY_SIDE = 0.4  # share of its distance by which the eye moves back for each further sheet
ROOM = 1.15  # distance of the page's eye relative to that of a picture, since the panel makes the view narrower
NARROW = 0.75  # width of a window relative to its height below which the eye moves back
LARGEST_SEED = 2**31 - 1
FRAME_BUDGET = 0.5  # of orders, and of computing, for one frame [s]
MOST_ORDERS = 10_000  # that wait; a drag gives twenty a second, and compiling takes a minute
READ_EVERY = 0.2  # between two updates of numbers and plots [s]
FIRST = "patch"  # the scene that a preset opens where none is open


class Page:
    """One visitor's page.

    Args:
        client: viser's, or a ``NullClient``.
        open_stage: makes the stage of a name.
        choices: names of scenes and environments, by title.
        start: the name shown first.
        left: whether the visitor has left.
        asked: query of the page's address, see ``link``; address: of the page, to which the link leads.

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
        asked: str = "",
        address: str = "",
    ) -> None:
        self._address = address
        self._left = left
        self.client, self._open_stage, self.choices = client, open_stage, dict(choices)
        self._orders: Queue[tuple[str, Any]] = Queue(MOST_ORDERS)
        self._later: list[tuple[str, Any]] = []  # orders that the last tick had no time for
        self.playing, self.moment = True, 0
        self._stale = True  # whether the view must be drawn again
        self._waiting: Any = None  # notification that the next frame takes a while
        self._fresh = False  # whether the stage has not advanced since it was built, and may have to compile first
        asked_for, refused = self._asked_for(asked)
        self.stage = self._open_stage(asked_for.scene or start)
        self.controls = Controls(client.gui, self.order, lambda: self.stage.settings, self.choices)
        self.plots = self.controls.plots
        for modifier in (None, "shift"):
            client.scene.on_click(modifier=modifier)(self._clicked)
        self._begin()
        if refused:
            self.client.add_notification("Not possible", refused, color="orange", auto_close_seconds=12.0)
        self._do(lambda: self._go_to(asked_for))

    def _asked_for(self, query: str) -> tuple[link.Link, str]:
        """What a link says, and why it cannot be followed."""
        try:
            asked = link.read(query)
        except ValueError as error:
            return link.Link(), f"The link is not understood: {error}."
        if asked.scene and asked.scene not in self.choices.values():
            return link.Link(), f"The link is to {asked.scene[:40]!r}, which is not shown here."
        return asked, ""

    def _go_to(self, asked: link.Link) -> None:
        """Change the stage that has been opened to what a link says."""
        if asked.policy in getattr(self.stage, "policies", ()):
            self._choose(asked.policy)
            self.controls["policy"].value = asked.policy
        self._change(asked.changes)
        if asked.compared and isinstance(self.stage, SceneStage):
            self._show_compared(asked.compared)
        if asked.seed is not None:
            self.controls["seed"].value = asked.seed
            self._press("reset")
        for particle in asked.pins[: hands.PINS]:
            if isinstance(self.stage, SceneStage):
                self.stage.pin_particle(particle)

    # --- what a visitor does --------------------------------------------------------------------------------------------

    def order(self, what: str, value: Any = None) -> None:
        """Queue what a visitor wants, for the next tick; too many orders are dropped."""
        with contextlib.suppress(Full):
            self._orders.put_nowait((what, value))

    def tick(self) -> None:
        """Carry out the orders, advance if playing, and show what has changed; nothing more once the visitor has left."""
        changes: dict[str, Any] = {}
        until = time.monotonic() + FRAME_BUDGET
        waiting = self._waiting_orders()
        # orders that take longer wait for the next tick
        while waiting and not self._left() and time.monotonic() < until:
            what, value = waiting.pop(0)
            if what == "drag":
                self._do(self.stage.drag, *value)
            elif what == "change":
                changes |= value
            else:
                self._do(getattr(self, f"_{what}"), value)
        self._later = waiting
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
            self.controls["working"].visible = False

    def _waiting_orders(self) -> list[tuple[str, Any]]:
        """The orders that have come; of several scenes picked in a row the last one counts."""
        waiting = list(self._later)
        with contextlib.suppress(Empty):
            while True:
                waiting.append(self._orders.get_nowait())
        last = max((place for place, (what, _) in enumerate(waiting) if what == "open"), default=0)
        return waiting[last:]

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
        """Show that the next frame takes a while, as what was rebuilt may have to be compiled first; nothing old is read."""
        self._fresh = True
        for name in ("glance", "readings", "notes", "legend"):
            self.controls[name].content = ""
        self.controls["working"].visible = True
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
        if "fabric" in changes:
            self.show.wear(self.stage.settings.fabric)
        self.controls.fill(self.stage)

    def open(self, name: str) -> None:
        """Show another scene, environment or recording."""
        self.stage = self._open_stage(name)
        self._begin()

    def _begin(self) -> None:
        """Show the stage that has been opened."""
        self.stage.left, self.stage.budget = self._left, FRAME_BUDGET
        self.playing, self.moment = True, 0
        self.controls.suit(self.stage)
        self._stand_back(1.0)
        self._see()

    def _open(self, title: str) -> None:
        name = self.choices.get(title, self.stage.name)
        if name != self.stage.name:
            self._wait(f"Opening {name}.")
            self.open(name)

    def _preset(self, label: str) -> None:
        preset = PRESETS.get(label) if isinstance(label, str) else None
        if preset is None:  # only a browser of a stranger sends this
            return
        if label == AGAIN:
            if isinstance(self.stage, SceneStage):
                self.open(self.stage.name)
            else:
                self._press("reset")
            return
        name = preset.scene or (self.stage.name if isinstance(self.stage, SceneStage) else FIRST)
        again = name != self.stage.name or preset.scene or "burst" in self.stage.notes or self._compared
        if again:
            self._wait(f"Opening {name}.")
            self.open(name)
        if preset.changes:
            self._change(preset.changes)
        if preset.compared:
            self._show_compared(preset.compared)

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

    @property
    def _compared(self) -> tuple[str, ...]:
        return self.stage.compared if isinstance(self.stage, SceneStage) else ()

    def _compare(self, _: Any = None) -> None:
        self._show_compared(self.controls.chosen_integrators)

    def _show_compared(self, names: Any) -> None:
        assert isinstance(self.stage, SceneStage)
        limited = self.stage.settings.strain_limit is not None
        unlimited = bool(self.controls["unlimited"].value) and limited and not names
        if (tuple(names), unlimited) == (self.stage.compared, self.stage.unlimited):
            return
        self._wait("Comparing." if names or unlimited else "Rebuilding.")
        self.stage.compare(names, unlimited)
        self.moment = 0
        self.controls["show"].value = "fabric"  # in which each sheet has its color
        self._stand_back(1 + SIDE_BY_SIDE * (len(self.stage.sheets) - 1))
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

    async def _clicked(self, event: Any) -> None:
        """A click anywhere: ``async``, since threads of a pool would not keep the order."""
        other = event.modifier == "shift"
        blows = (self.controls["click"].value == CLICKS[1]) != other
        ray = np.array(event.ray_origin, float), np.array(event.ray_direction, float)
        self.order("blow" if blows else "pin", ray)

    def _pin(self, ray: Any) -> None:
        if self._touchable:
            self.stage.pin(*ray)

    def _blow(self, ray: Any) -> None:
        if self._touchable:
            self.stage.blow(*ray)

    def _grasp(self, value: tuple[str, Any, Any]) -> None:
        """A drag on the sheet: where it began, and where it is now [m]."""
        phase, start, end = value
        if phase == "end":
            self.stage.let_go()
        elif self.moment == len(self.stage.recording.frames) - 1:
            if phase == "start":
                self.stage.grab(start)
            self.stage.pull(end)

    def _drop(self, _: Any = None) -> None:
        """Let go of the cloth in a race."""
        if isinstance(self.stage, Race):
            self.stage.drop()

    @property
    def _touchable(self) -> bool:
        """Whether a click can mean the sheet as it is now."""
        return isinstance(self.stage, SceneStage) and self.moment == len(self.stage.recording.frames) - 1

    def _refuse(self, why: str) -> None:
        """Set the controls back to what holds, and say why."""
        self.controls.fill(self.stage)
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

    # --- what is shown --------------------------------------------------------------------------------------------------

    def _stand_back(self, share: float) -> None:
        """Place the camera where the stage is seen well, at ``share`` times that distance."""
        camera, seen = self.stage.recording.camera, self.client.camera
        shape = seen.image_width / max(seen.image_height, 1)
        share *= ROOM * max(1.0, NARROW / max(shape, 0.1))
        back = np.subtract(camera.eye, camera.target) * share
        seen.position, seen.look_at = tuple(camera.target + back), camera.target
        seen.near = 0.1  # a sheet is close to its solid, so depth must be resolved
        seen.fov = float(np.radians(camera.vertical_fov))

    def _see(self) -> None:
        """Create the nodes of the stage's recording."""
        self.show = Show(
            self.client.scene, self.stage.recording, self.stage.settings.fabric,
            lambda attachment, place: self.order("drag", (attachment, place)), lambda *drag: self.order("grasp", drag),
        )  # fmt: skip
        self.plots.begin(self.stage.recording)
        self._stale, self._read_at = True, -READ_EVERY
        self.controls.fill(self.stage)

    def _draw(self) -> None:
        frames = self.stage.recording.frames
        self.moment = min(self.moment, len(frames) - 1)
        mode = self.controls["show"].value if self.controls["show"].value in MODES else MODES[0]
        with self.client.atomic():
            self.show.draw(frames[self.moment], mode, bool(self.controls["diagonals"].value), self.client.camera.position)
            if self.moment == len(frames) - 1:
                self.show.draw_held(self.stage.attachments(), bool(self.controls["handles"].value), self.stage.pinned())
            self.show.say(self.stage.saying if self.moment == len(frames) - 1 else "", frames[self.moment])
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
        controls["glance"].content = glance(self.stage.recording, frame)
        controls["readings"].content = readings_table(self.stage.recording, frame, self.stage.stabilities())
        controls["legend"].content = legend(self.stage.recording, frame, mode, self.show.scale)
        for number, attachment in enumerate(self.stage.attachments()[:ATTACHMENTS]):
            controls[f"attachment {number}"].value = attachment.holds
        controls["link"].value = f"{self._address}{'&' if '?' in self._address else '?'}{link.write(self.stage)}"
        self.plots.draw(frames[: self.moment + 1])

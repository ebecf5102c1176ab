"""The page of one visitor: their input, and the display.  It uses a viewer's interface and does not import its library."""

from __future__ import annotations

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from clothgym.checks import known
from clothgym.playground import hands, link
from clothgym.playground.controls import AGAIN, CLICKS, PRESETS, Controls, glance, legend, readings_table
from clothgym.playground.exporting import SAVED, saved
from clothgym.playground.gallery import Gallery
from clothgym.playground.scenes import number_within
from clothgym.playground.show import MODES, Show
from clothgym.playground.stage import SceneStage
from clothgym.render import Camera

ROOM = 1.15  # distance of the page's eye relative to that of a picture, since the panel makes the view narrower
NARROW = 0.75  # width of a window relative to its height below which the eye moves back
LARGEST_SEED = 2**31 - 1
FRAME_BUDGET = 0.5  # of orders, and of computing, for one frame [s]
MOST_ORDERS = 10_000  # that wait; a drag gives twenty a second, and compiling takes a minute
READ_EVERY = 0.2  # between two updates of numbers [s]
COMPILED = ("integrator", "bending", "strain_limit", "self_collision")  # settings that change the compiled loop
FIRST = "patch"  # the scene that a preset opens where none is open


class Page:
    """One visitor's page.

    Args:
        client: viser's, or a null one.
        gallery: what can be shown.
        start: the name shown first.
        left: whether the visitor has left.
        asked: query of the page's address, see ``link``; address: of the page, to which the link leads.

    ``tick`` is called by one thread only; a visitor's actions come in a queue.  A browser may send anything, and may change a
    control's range: its input is checked here, against the server's own ranges.
    """

    def __init__(
        self,
        client: Any,
        gallery: Gallery,
        start: str,
        left: Callable[[], bool] = lambda: False,
        asked: str = "",
        address: str = "",
    ) -> None:
        self.client, self.gallery, self.choices = client, gallery, dict(gallery.titles)
        self._left, self._address = left, address
        self.playing, self.moment = True, 0
        self._stale = True  # whether the view must be drawn again
        self._orders: Queue[tuple[str, Any]] = Queue(MOST_ORDERS)
        self._later: list[tuple[str, Any]] = []  # orders that the last tick had no time for
        self._waiting: Any = None  # notification that the next frame takes a while
        self._fresh = False  # whether the stage has not advanced since it was built, and may have to compile first
        asked_for, refused = self._asked_for(asked)
        self.stage = gallery.open(asked_for.scene or start)
        self.controls = Controls(client.gui, self.order, self._setting, self.choices)
        for modifier in (None, "shift"):
            client.scene.on_click(modifier=modifier)(self._clicked)
        self._begin()
        if refused:
            self._say("Not possible", refused, "orange")
        self._do(self._go_to, asked_for)

    def _setting(self, name: str) -> float | None:
        """The present value of a scene's setting."""
        return getattr(self.stage.settings, name) if isinstance(self.stage, SceneStage) else None

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
        if asked.policy in self.stage.policies:
            self._choose(asked.policy)
            self.controls["policy"].value = asked.policy
        self._change(asked.changes)
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
            if what == "change":
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

    def _waiting_orders(self) -> list[tuple[str, Any]]:
        """The orders that have come; of several scenes picked in a row the last one counts."""
        waiting = list(self._later)
        with contextlib.suppress(Empty):
            while True:
                waiting.append(self._orders.get_nowait())
        last = max((place for place, (what, _) in enumerate(waiting) if what == "open"), default=0)
        return waiting[last:]

    @property
    def _last(self) -> int:
        """Number of the last frame."""
        return len(self.stage.recording.frames) - 1

    @property
    def _at_the_end(self) -> bool:
        """Whether the last frame is shown and the stage is over."""
        return self.stage.over and self.moment == self._last

    def _advance(self) -> None:
        """Advance to the next frame; when the stage is over, to the next one recorded."""
        if self.stage.over:
            self.moment = min(self.moment + 1, self._last)
            return
        if self._fresh:
            self._wait("Rebuilding.")
        self._fresh = False
        self.stage.advance()
        self.moment = self._last

    def _wait(self, why: str) -> None:
        """Show that the next frame takes a while, as what was rebuilt may have to be compiled first; nothing old is read."""
        self._fresh = True
        for name in ("glance", "readings", "notes", "legend"):
            self.controls[name].content = ""
        if self._waiting is None:
            words = f"{why} The first time on a machine it is compiled, which takes up to a minute."
            self._waiting = self.client.add_notification("One moment", words, loading=True)

    def _say(self, title: str, words: str, color: str) -> None:
        self.client.add_notification(title, words, color=color, auto_close_seconds=15.0)

    def _do(self, deed: Callable[..., Any], *values: Any) -> bool:
        """Do something; returns whether it worked.  If not, a notification says why."""
        self._stale = True
        try:
            deed(*values)
        except (ValueError, OSError, ImportError) as error:
            self._say("Not possible", str(error), "orange")
        except Exception as error:  # policies and recordings come from users
            traceback.print_exc(file=sys.stderr)
            self.playing = False
            words = f"Stopped: {type(error).__name__}, {error}. Reset, or choose another policy or another scene."
            self._say("Something failed", words, "red")
        else:
            return True
        return False

    def _change(self, changes: Mapping[str, Any]) -> None:
        """Change settings of a scene."""
        stage = self.stage
        if not isinstance(stage, SceneStage):
            return
        changes = {name: value for name, value in changes.items() if getattr(stage.settings, name) != value}
        if any(name in COMPILED for name in changes):
            self._wait("Rebuilding.")
        if changes:
            self._do(lambda: stage.change(**changes))
            self.show.wear(stage.settings.fabric)
            self.controls.fill(stage)

    def _begin(self, name: str = "") -> None:
        """Show another scene, environment or recording, or the stage that has just been opened."""
        if name:
            self._wait(f"Opening {name}.")
            self.stage = self.gallery.open(name)
        self.stage.budget = FRAME_BUDGET
        self.playing, self.moment = True, 0
        self.controls.suit(self.stage)
        self._see()

    def _open(self, title: Any) -> None:
        name = self.choices.get(str(title), self.stage.name)
        if name != self.stage.name:
            self._begin(name)

    def _preset(self, label: Any) -> None:
        known("preset", str(label), PRESETS)
        scene, changes = PRESETS[label]
        if label == AGAIN and not isinstance(self.stage, SceneStage):
            return self._press("reset")
        self._begin(scene or (self.stage.name if isinstance(self.stage, SceneStage) else FIRST))
        self._change(changes)

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
        self.playing, self.moment = False, int(number_within("moment", moment, 0, self._last))

    def _choose(self, policy: str) -> None:
        before = self.stage.recording
        self.stage.choose(policy)  # type: ignore[attr-defined]
        if self.stage.recording is not before:  # the policy was trained in an environment with other options
            self.moment = 0
            self._see()

    async def _clicked(self, event: Any) -> None:
        """A click anywhere: ``async``, since threads of a pool would not keep the order."""
        blows = (self.controls["click"].value == CLICKS[1]) != (event.modifier == "shift")
        self.order("touch", (blows, np.array(event.ray_origin, float), np.array(event.ray_direction, float)))

    def _touch(self, value: tuple[bool, Any, Any]) -> None:
        """A click on the sheet as it is now."""
        blows, *ray = value
        if self.moment == self._last:
            (self.stage.blow if blows else self.stage.pin)(*ray)

    def _grasp(self, value: tuple[str, Any, Any]) -> None:
        """A drag on the sheet: where it began, and where it is now [m]."""
        phase, start, end = value
        if phase == "end":
            self.stage.let_go()
        elif self.moment == self._last:
            if phase == "start":
                self.stage.grab(start)
            self.stage.pull(end)

    def _drop(self, _: Any) -> None:
        """Let go of the cloth in a task."""
        self.stage.drop()

    def _refuse(self, why: str) -> None:
        """Set the controls back to what holds, and say why."""
        if isinstance(self.stage, SceneStage):
            self.controls.fill(self.stage)
        raise ValueError(why)

    def _look(self, _: Any) -> None:
        """Draw again: only the view has changed."""

    def _save(self, kind: str) -> None:
        waiting = self.client.add_notification("One moment", f"Making {SAVED[kind]}.", loading=True)
        seen = self.client.camera
        (x, y, z), target = np.asarray(seen.position, float).tolist(), np.asarray(seen.look_at, float).tolist()
        camera = Camera(eye=(x, y, max(z, 0.02)), target=tuple(target), vertical_fov=float(np.degrees(seen.fov)))
        try:
            name, content = saved(kind, self.stage, self.moment, camera, self._mode)
        finally:
            waiting.remove()
        self.client.send_file_download(name, content)

    # --- display --------------------------------------------------------------------------------------------------------

    @property
    def _mode(self) -> str:
        """How the sheets are colored."""
        return self.controls["show"].value if self.controls["show"].value in MODES else MODES[0]

    def _see(self) -> None:
        """Create the nodes of the stage's recording, and place the camera where they are seen well."""
        camera, seen = self.stage.recording.camera, self.client.camera
        shape = seen.image_width / max(seen.image_height, 1)
        share = ROOM * max(1.0, NARROW / max(shape, 0.1))
        seen.position, seen.look_at = tuple(camera.target + np.subtract(camera.eye, camera.target) * share), camera.target
        seen.near = 0.1  # a sheet is close to its solid, so depth must be resolved
        seen.fov = float(np.radians(camera.vertical_fov))
        self.show = Show(self.client.scene, self.stage.recording, lambda *drag: self.order("grasp", drag))
        self._stale, self._read_at = True, -READ_EVERY
        if isinstance(self.stage, SceneStage):
            self.show.wear(self.stage.settings.fabric)
            self.controls.fill(self.stage)

    def _draw(self) -> None:
        frames, now = self.stage.recording.frames, time.monotonic()
        self.moment = min(self.moment, self._last)
        frame = frames[self.moment]
        with self.client.atomic():
            self.show.draw(frame, self._mode, self.client.camera.position)
            if self.moment == self._last:
                self.show.draw_held(self.stage.held())
        state = "■ over: reset to start again" if self._at_the_end else "▶ playing" if self.playing else "❚❚ paused"
        if self.controls["state"].content != state:
            self.controls["state"].content = state
        if now - self._read_at >= READ_EVERY or not self.playing or self._at_the_end:
            self._read_at = now
            controls, recording = self.controls, self.stage.recording
            controls["moment"].max = max(1, self._last)
            controls["moment"].value = self.moment
            controls["notes"].content = "\n\n".join(f"> {note}" for note in self.stage.notes.values())
            controls["glance"].content = glance(recording, frame)
            controls["readings"].content = readings_table(
                recording, frame, self.stage.stability() if isinstance(self.stage, SceneStage) else None
            )
            controls["legend"].content = legend(self._mode, self.show.strained)
            controls["link"].value = f"{self._address}{'&' if '?' in self._address else '?'}{link.write(self.stage)}"

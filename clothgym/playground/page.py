"""The page of one visitor: what they want, and what their browser is to show."""

from __future__ import annotations

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from clothgym.checks import known, vector
from clothgym.playground import hands, link
from clothgym.playground.controls import AGAIN, CLICKS, PRESETS, Controls, numbers, readings_table
from clothgym.playground.exporting import SAVED, saved
from clothgym.playground.gallery import Gallery
from clothgym.playground.scenes import number_within
from clothgym.playground.show import MODES, Show, look_of, scene_of
from clothgym.playground.stage import SceneStage
from clothgym.render import Camera

LARGEST_SEED = 2**31 - 1
FRAME_BUDGET = 0.5  # of orders, and of computing, for one frame [s]
MOST_ORDERS = 10_000  # that wait; a drag gives twenty a second, and compiling takes a minute
READ_EVERY = 0.2  # between two updates of numbers [s]
COMPILED = ("integrator", "bending", "strain_limit", "self_collision")  # settings that change the compiled loop
NOWHERE = np.zeros((0, 3), np.float32)  # no held points
FIRST = "patch"  # the scene that a preset opens where none is open


class Page:
    """One visitor's page.

    Args:
        client: their browser: ``tell(what, content)``, ``draw(frame)`` and ``give(name, content)``, see ``server.Client``.
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
        self._waiting = False  # whether the browser says that the next frame takes a while
        self._ended = 0.0  # for how long the end has been shown [s]
        self._fresh = False  # whether the stage has not advanced since it was built, and may have to compile first
        asked_for, refused = self._asked_for(asked)
        self.stage = gallery.open(asked_for.scene or start)
        self.controls = Controls(self.order, self._setting, self.choices)
        self._begin()
        if refused:
            self._say("Not possible", refused)
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

    def take(self, message: Any) -> None:
        """A message of the browser: a control and its value, a drag, a click, or the view that is to be saved.

        Raises:
            ValueError, KeyError, TypeError: it makes no sense.
        """
        what, value = message
        if what == "turn":
            self.controls.turn(*value)
        elif what == "touch":
            shift, place, direction = value
            self.order(what, ((self.controls["click"].value == CLICKS[1]) != bool(shift), place, direction))
        elif what == "grasp":
            phase, place = value
            self.order(what, (phase, place))
        else:
            raise ValueError(f"{str(what)[:20]!r} is no message")

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
        if self.playing and self._at_the_end:
            self._do(self._stay)
        elif self.playing:
            self.playing, self._ended = self._do(self._advance), 0.0
        if self._stale:
            self._do(self._draw)
            self._stale = False
        if self._waiting:
            self.client.tell("wait", "")
            self._waiting = False

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

    def _stay(self) -> None:
        """Show the end for a while, and begin again."""
        self._ended += self.stage.recording.time_step
        if self._ended > self.stage.patience:
            self._ended, self.moment = 0.0, 0
            self.stage.begin_again()
            self.controls["seed"].value = self.stage.seed
            if isinstance(self.stage, SceneStage):
                self.controls.fill(self.stage)

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
        """Tell that the next frame takes a while, as what was rebuilt may have to be compiled first."""
        self._fresh = self._waiting = True
        self.client.tell("wait", f"{why} The first time on a machine it is compiled, which takes up to a minute.")

    def _say(self, title: str, words: str) -> None:
        self.client.tell("say", [title, words])

    def _do(self, deed: Callable[..., Any], *values: Any) -> bool:
        """Do something; returns whether it worked.  If not, a notification says why."""
        self._stale = True
        try:
            deed(*values)
        except (ValueError, OSError, ImportError) as error:
            self._say("Not possible", str(error))
        except Exception as error:  # policies and recordings come from users
            traceback.print_exc(file=sys.stderr)
            self.playing = False
            words = f"Stopped: {type(error).__name__}, {error}. Reset, or choose another policy or another scene."
            self._say("Something failed", words)
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
            self.client.tell("look", look_of(stage.recording)._asdict())
            self.controls.fill(stage)

    def _begin(self, name: str = "") -> None:
        """Show another scene, environment or recording, or the stage that has just been opened."""
        if name:
            self._wait(f"Opening {next(title for title, one in self.choices.items() if one == name)}.")
            self.stage = self.gallery.open(name)
        self.stage.budget = FRAME_BUDGET
        self.playing, self.moment = True, 0
        self.controls.suit(self.stage)
        self._see()

    def _open(self, name: Any) -> None:
        if name not in self.choices.values():
            raise ValueError(f"there is no scene {str(name)[:40]!r}")
        if name != self.stage.name:
            self._begin(str(name))

    def _preset(self, label: Any) -> None:
        known("preset", str(label), PRESETS)
        scene, changes = PRESETS[label]
        if label == AGAIN and not isinstance(self.stage, SceneStage):
            return self._press("reset")
        self._begin(scene or (self.stage.name if isinstance(self.stage, SceneStage) else FIRST))
        self._change(changes)

    def _press(self, button: str) -> None:
        self._ended = 0.0
        if button == "reset":
            self.stage.reset(int(number_within("seed", self.controls["seed"].value, 0, LARGEST_SEED)))
            self.moment, self.playing = 0, True
        elif button == "step":
            self.playing = False
            self._advance()
        elif self._at_the_end:
            self.playing, self._ended = True, self.stage.patience
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

    def _touch(self, value: tuple[bool, Any, Any]) -> None:
        """A click on the sheet as it is now."""
        blows, place, direction = value
        if self.moment == self._last:
            self.stage.blow(place, direction) if blows else self.stage.pin(place)

    def _grasp(self, value: tuple[str, Any]) -> None:
        """A drag on the sheet: its phase, and where it is [m]."""
        phase, place = value
        if phase == "end":
            self.stage.let_go()
        elif self.moment == self._last:
            if phase == "start":
                self.stage.grab(place)
            self.stage.pull(place)

    def _drop(self, _: Any) -> None:
        """Let go of the cloth in a task."""
        self.stage.drop()

    def _refuse(self, why: str) -> None:
        """Set the controls back to what holds, and say why."""
        if isinstance(self.stage, SceneStage):
            self.controls.fill(self.stage)
        raise ValueError(why)

    def _save(self, view: Any) -> None:
        """Give the visitor a file, of what they see: the eye, the target [m] and the vertical field of view [degrees]."""
        kind = str(self.controls["kind"].value)
        known("kind", kind, SAVED)
        self.client.tell("wait", f"Making a {SAVED[kind]}.")
        self._waiting = True
        eye, target, fov = view
        (x, y, z), looked = vector("eye", eye).tolist(), vector("target", target).tolist()
        camera = Camera(eye=(x, y, max(z, 0.02)), target=tuple(looked), vertical_fov=number_within("view", fov, 1.0, 120.0))
        self.client.give(*saved(kind, self.stage, self.moment, camera, self._mode))

    # --- display --------------------------------------------------------------------------------------------------------

    @property
    def _mode(self) -> str:
        """How the sheets are colored."""
        return self.controls["show"].value if self.controls["show"].value in MODES else MODES[0]

    def _see(self) -> None:
        """Show the stage's recording from its own camera."""
        self.show, self._seen = Show(), self.stage.recording
        self.client.tell("open", scene_of(self.stage.recording))
        self._stale, self._read_at = True, -READ_EVERY
        if isinstance(self.stage, SceneStage):
            self.controls.fill(self.stage)

    def _draw(self) -> None:
        if self.stage.recording is not self._seen:  # an episode with a sheet of another size
            self._see()
        frames, now, controls = self.stage.recording.frames, time.monotonic(), self.controls
        self.moment = min(self.moment, self._last)
        frame = frames[self.moment]
        new, drawn = self.show.draw(frame, self.stage.held() if self.moment == self._last else NOWHERE)
        controls["play"].value = "over" if self._at_the_end else "playing" if self.playing else "paused"
        controls["verdict"].value = list(self.stage.notes.items())
        if now - self._read_at >= READ_EVERY or not self.playing or self._at_the_end:
            self._read_at = now
            stability = self.stage.stability() if isinstance(self.stage, SceneStage) else None
            controls["strain"].value = numbers(100 * frame.readings["strain"], "{:.1f} %")[0]
            controls["readings"].value = readings_table(self.stage.recording, frame, stability)
            controls["moment"].high, controls["moment"].value = max(1, self._last), self.moment
            controls["time"].value = f"{frame.time:.1f} s"
            controls["link"].value = f"{self._address}{'&' if '?' in self._address else '?'}{link.write(self.stage)}"
        if new:
            self.client.tell("solids", new)
        if news := controls.news():
            self.client.tell("set", news)
        self.client.draw(drawn)

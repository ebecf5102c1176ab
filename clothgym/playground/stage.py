"""One visitor's cloth: a scene whose settings change while it runs, with one sheet, or one for each of several integrators."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import integrators
from clothgym.checks import indices, vector
from clothgym.guards import refusal
from clothgym.material import PRESETS
from clothgym.playground import hands
from clothgym.playground.recording import Frame, Recording, stiffness
from clothgym.playground.scenes import scene_named
from clothgym.playground.sheets import (
    Attachment,
    Sheet,
    Stability,
    carried_over,
    changed_properties,
    own,
    set_in_place,
    simulated,
    stability,
    visible,
    within_view,
)
from clothgym.playground.world import FRAME, Scene, Settings, Targets, begin, drive
from clothgym.wind import Wind

STEPS = 2  # control steps of a scene between two frames
GUSTS = 3600  # control steps after which the gusts repeat
LOOK_EVERY = 6  # frames between two measurements of penetration, which cost as much as a control step
KEPT = 1800  # most recent frames that are kept
MOST_COMPARED = 4
REMEDY = "Take more substeps, a softer fabric or another integrator, and reset."
# settings that change the compiled loop or a method's plan: they need a new simulation of the same sheet
REBUILDS = ("integrator", "bending", "strain_limit", "self_collision")
UNTOUCHED = "Nothing can be {} here: choose a scene."


class Stage:
    """What the page shows: something that advances from frame to frame, and records its frames.

    Attributes:
        name: as it was asked for; about: a sentence.
        recording: its frames, the last of which is the current one.
        notes: sentences for the visitor, by subject.
    """

    name: str
    about: str
    settings: Settings
    recording: Recording
    seed: int

    def __init__(self) -> None:
        self.notes: dict[str, str] = {}
        self.left: Callable[[], bool] = lambda: False  # whether the visitor has left, who need not be waited for
        self.budget = np.inf  # of computing, for one frame [s]

    @property
    def frame(self) -> Frame:
        """The current frame."""
        return self.recording.frames[-1]

    @property
    def saying(self) -> str:
        """What stands over the sheets: why one has burst, or how an episode ended."""
        return self.notes.get("burst", "") or self.notes.get("evaluation", "")

    @property
    def over(self) -> bool:
        """Whether nothing more happens until a reset."""
        return False

    def advance(self) -> Frame:
        """Advance to the next frame."""
        raise NotImplementedError

    def reset(self, seed: int | None = None) -> None:
        """Start again, with that seed or the same."""
        raise NotImplementedError

    def change(self, **changes: Any) -> None:
        """Change settings.

        Raises:
            ValueError: an unknown name or an invalid value; nothing is changed.
        """
        raise NotImplementedError

    def attachments(self) -> list[Attachment]:
        """The anchors and grippers."""
        return []

    def drag(self, attachment: int, place: ArrayLike | None) -> None:
        """Move an attachment to a position [m], (3,), or stop moving it with None."""
        raise NotImplementedError

    def hold(self, attachment: int, holds: bool) -> None:
        """Close or open an attachment."""
        raise NotImplementedError

    def stabilities(self) -> list[Stability]:
        """The stability of each sheet; empty if nothing is simulated."""
        return []

    # --- the visitor's hand -----------------------------------------------------------------------------------------------

    def grab(self, place: ArrayLike) -> None:
        """Take hold of the sheet where it is nearest to a position [m], (3,)."""
        raise ValueError(UNTOUCHED.format("held"))

    def pull(self, place: ArrayLike) -> None:
        """Move what is held to a position [m], (3,)."""

    def let_go(self) -> None:
        """Let go of what is held, which flies on."""

    def pin(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Pin the sheet where a ray from ``origin`` [m] meets it, or take away the pin that is there."""
        raise ValueError(UNTOUCHED.format("pinned"))

    def blow(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Blow on the sheet along a ray from ``origin`` [m]."""
        raise ValueError(UNTOUCHED.format("blown"))

    def pinned(self) -> NDArray[np.float32]:
        """Where the visitor holds and has pinned the sheets [m], (points, 3)."""
        return np.zeros((0, 3), np.float32)

    def _keep(self, frame: Frame) -> Frame:
        self.recording.frames.append(frame)
        del self.recording.frames[:-KEPT]
        return frame


class SceneStage(Stage):
    """A scene of the gallery.

    Args:
        scene: its name, or a ``Scene``.
        settings: instead of the scene's own.
        compared: two to four integrators, or fabrics, a sheet each; none for one sheet with the settings' own.

    Raises:
        ValueError: no such scene, integrator or fabric, or a number of them that cannot be compared.
    """

    def __init__(self, scene: str | Scene, settings: Settings | None = None, compared: Sequence[str] = (), seed: int = 0) -> None:
        super().__init__()
        self.scene = scene_named(scene) if isinstance(scene, str) else scene
        self.name, self.about = self.scene.name, self.scene.about
        self.settings = self.scene.settings if settings is None else settings
        self.seed = seed
        self.steps = 0
        self._dragged: dict[int, NDArray] = {}
        self._held_anchor: int | None = None  # of the scene, that the visitor holds by the sheet
        self._breath: tuple[float, NDArray, NDArray] | None = None  # until when, through where and along which way
        self._gusts = np.zeros((1, 3))
        self._bounds: list[Stability] | None = None
        self.sheets: list[Sheet] = []
        self.compare(compared)

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self.steps * FRAME

    # --- going on -------------------------------------------------------------------------------------------------------

    def advance(self) -> Frame:
        begun = time.perf_counter()
        for _ in range(STEPS):
            # a frame that takes too long is cut short: then the cloth moves slowly, but the page answers
            if self.left() or time.perf_counter() - begun > self.budget:
                break
            gust = self.settings.gust * self._gusts[self.steps % len(self._gusts)]
            wind = self.settings.wind * np.array(self.scene.downwind) + gust
            for sheet in self.sheets:
                if not sheet.burst and not self.left():
                    drive(sheet.simulation, self.scene, self.time, self._targets())
                    sheet.hand.follow()
                    sheet.simulation.set_wind(wind)
                    if self._breath is not None and self.time < self._breath[0]:
                        hands.blow(sheet.simulation, *self._breath[1:], FRAME)
                    sheet.step(1)
            self.steps += 1
        bursts = [sheet.burst for sheet in self.sheets if sheet.burst]
        if bursts:
            self.notes["burst"] = " ".join([*bursts, REMEDY])
        return self._keep(self._look())

    def reset(self, seed: int | None = None) -> None:
        self.seed = self.seed if seed is None else int(seed)
        self.steps = 0
        self._dragged.clear()
        self._held_anchor = self._breath = None
        self.notes.pop("burst", None)
        self._gusts = Wind(gust=1.0).series(np.random.default_rng(self.seed), GUSTS, FRAME)
        for sheet in self.sheets:
            sheet.burst, sheet.cost, sheet.penetration, sheet.shredded = "", 0.0, 0.0, False
            begin(sheet.simulation, self.scene, self.seed or None)
        self.recording.frames[:] = [self._look()]

    def compare(self, names: Sequence[str], unlimited: bool = False) -> None:
        """Start again with a sheet for each of these integrators, or of these fabrics, two to four.  Without names, with one sheet
        for the integrator of the settings, and with ``unlimited`` beside it the same without the strain limit.

        Raises:
            ValueError: another number, integrators beside fabrics, or names with ``unlimited``.
        """
        names = [name if name in PRESETS else integrators.get(name).name for name in dict.fromkeys(names)]
        if len(names) == 1 or len(names) > MOST_COMPARED:
            raise ValueError(f"compared={names!r}: choose two to {MOST_COMPARED} integrators or fabrics")
        if len({name in PRESETS for name in names}) > 1:
            raise ValueError(f"compared={names!r}: compare integrators or fabrics, not both")
        if names and unlimited:
            raise ValueError(f"compared={names!r}, unlimited=True: compare integrators, or one with and without its strain limit")
        methods = [(name, True) for name in names] or [(self.settings.integrator, True)]
        if unlimited:
            methods.append((self.settings.integrator, False))
        settings = self.settings
        self.sheets = [Sheet(name, simulated(self.scene, own(settings, name, limited)), limited) for name, limited in methods]
        self.compared, self.unlimited = tuple(names), unlimited
        apart = 1.25 * self.scene.mesh.size[0]
        self.offsets = np.array([((k - (len(methods) - 1) / 2) * apart, 0.0, 0.0) for k in range(len(methods))])
        labels = tuple(sheet.label for sheet in self.sheets)
        self.recording = Recording(self.scene.title, self.scene.mesh, STEPS * FRAME, self.scene.camera, labels, self.scene.strained)
        self._bounds = None
        self.reset()

    def _look(self) -> Frame:
        due = not self.recording.frames or self.steps % (STEPS * LOOK_EVERY) == 0
        for sheet in self.sheets:
            sheet.look(due)
        readings = [sheet.readings for sheet in self.sheets]
        return Frame(
            time=self.time,
            positions=np.stack([sheet.positions for sheet in self.sheets]) + self.offsets[:, None].astype("f"),
            stiffness=np.stack([stiffness(sheet.simulation) for sheet in self.sheets]),
            touching=np.stack([sheet.touching for sheet in self.sheets]),
            solids=tuple(
                solid.at(np.add(solid.collider.center, offset))
                for sheet, offset in zip(self.sheets, self.offsets)
                for solid in self.scene.solids(sheet.simulation)
            ),
            # a sheet without a limit has no strain before limiting
            readings={name: np.array([one.get(name, np.nan) for one in readings]) for name in readings[0]},
        )

    # --- settings -------------------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> None:
        after = self.settings.changed(**changes)
        before, self.notes = self.settings, {k: v for k, v in self.notes.items() if k == "burst"}
        rebuilt = {name for name in REBUILDS if getattr(after, name) != getattr(before, name)}
        if after.self_collision != "off" and after.friction != before.friction:
            rebuilt.add("friction")
        made = []
        for sheet in self.sheets:
            name = sheet.name if self.compared else after.integrator
            old, new = (own(settings, name, sheet.limited) for settings in (before, after))
            method = integrators.get(new.integrator)
            properties = changed_properties(old, new)
            ignored = properties & method.ignored
            if ignored:
                self.notes["ignored"] = refusal(method, sorted(ignored)[0]).capitalize() + "."
            if rebuilt or ignored:
                made.append((name, carried_over(sheet.simulation, self.scene, new)))
            else:
                unbounded = set_in_place(sheet.simulation, old, new)
                if unbounded:
                    self.notes["substeps"] = unbounded
                made.append((name, sheet.simulation))
        # recorded positions and readings stay: a sheet that has blown up is not measured again before a reset
        for sheet, (name, simulation) in zip(self.sheets, made):
            sheet.name = name
            if simulation is not sheet.simulation:
                sheet.use(simulation)
        self.settings, self._bounds = after, None
        self.recording.labels = tuple(sheet.label for sheet in self.sheets)

    def stabilities(self) -> list[Stability]:
        if self._bounds is None:
            self._bounds = [stability(sheet.simulation) for sheet in self.sheets]
        return self._bounds

    # --- attachments ----------------------------------------------------------------------------------------------------

    def attachments(self) -> list[Attachment]:
        s = self.sheets[0].simulation
        held, places = s.attached[0], s.attachment_positions[0, : len(s.anchors)]
        # an open anchor is shown at its particle
        for attachment in np.flatnonzero(~held):
            places[attachment] = s.positions[0, s.anchors[attachment]]
        return [
            Attachment(name, visible(place) + self.offsets[0], bool(holds), attachment in self.scene.handles)
            for attachment, (name, place, holds) in enumerate(zip(self.scene.names, places, held))
        ]

    def drag(self, attachment: int, place: ArrayLike | None) -> None:
        self._checked(attachment)
        if place is None:
            self._dragged.pop(attachment, None)
            return
        self._dragged[attachment] = within_view(vector("place", place)) - self.offsets[0]
        self.hold(attachment, True)

    def hold(self, attachment: int, holds: bool) -> None:
        self._checked(attachment)
        for sheet in self.sheets:
            if holds and not sheet.simulation.attached[0, attachment]:
                sheet.simulation.attach([0], [attachment])
            elif not holds:
                sheet.simulation.release([0], [attachment])
        if not holds:
            self._dragged.pop(attachment, None)

    # --- the visitor's hand -----------------------------------------------------------------------------------------------

    def grab(self, place: ArrayLike) -> None:
        where = within_view(vector("place", place))
        number = int(np.argmin([((sheet.positions + offset - where) ** 2).sum(axis=1).min() for sheet, offset in self._placed()]))
        particle = hands.nearest(self.sheets[number].positions, where - self.offsets[number])
        anchor = self._anchor_of(particle)
        if anchor is not None:
            self._held_anchor = anchor
            return
        if not self.sheets[number].burst:
            for sheet in self.sheets:
                sheet.hand.take(hands.HAND, particle)
            # sheets beside the one that is held are held alike
            self._apart = self.offsets[number]

    def pull(self, place: ArrayLike) -> None:
        where = within_view(vector("place", place))
        where[2] = max(where[2], 0.0)
        if self._held_anchor is not None:
            self._dragged[self._held_anchor] = where - self.offsets[0]
            return
        for sheet in self.sheets:
            if sheet.hand.held[hands.HAND]:
                sheet.hand.goals[hands.HAND] = where - self._apart

    def let_go(self) -> None:
        self._held_anchor = None
        for sheet in self.sheets:
            sheet.hand.let_go(hands.HAND)

    def pin(self, origin: ArrayLike, direction: ArrayLike) -> None:
        seen = self._seen(origin, direction)
        if seen is None:
            return
        number, where = seen
        sheet = self.sheets[number]
        particle = hands.nearest(sheet.positions, where)
        anchor = self._anchor_of(particle)
        if anchor is not None:
            return self.hold(anchor, False)
        near = [
            pin for pin in np.flatnonzero(sheet.hand.held)
            if pin != hands.HAND and np.linalg.norm(sheet.hand.goals[pin] - where) < hands.CLICK
        ]  # fmt: skip
        for one in self.sheets if near else ():
            one.hand.let_go(int(near[0]))
        if not near:
            self.pin_particle(particle)

    def pin_particle(self, particle: int) -> None:
        """Pin a particle of all sheets where it is, with the scene's own anchor where it has one.

        Raises:
            ValueError: there is no such particle.
        """
        indices("pins", [particle], self.scene.mesh.num_particles, "the particles of this sheet")
        own_anchor = next((k for k, first in enumerate(self.sheets[0].simulation.anchors) if first == particle), None)
        if own_anchor is not None:
            return self.hold(own_anchor, True)
        for sheet in self.sheets:
            free = np.flatnonzero(~sheet.hand.held[1:])
            sheet.hand.take(int(free[0]) + 1 if len(free) else 1, particle)

    def blow(self, origin: ArrayLike, direction: ArrayLike) -> None:
        seen = self._seen(origin, direction)
        if seen is not None:
            way = vector("direction", direction)
            self._breath = self.time + hands.BREATH_TIME, seen[1], way / max(float(np.linalg.norm(way)), 1e-9)

    def pinned(self) -> NDArray[np.float32]:
        places = [sheet.hand.goals[sheet.hand.held] + offset for sheet, offset in self._placed()]
        for place, sheet in zip(places, self.sheets):
            if sheet.hand.held[hands.HAND]:
                place[0] = sheet.simulation.grippers.positions[0, hands.HAND] + self.offsets[self.sheets.index(sheet)]
        return visible(np.concatenate(places))

    def _placed(self) -> list[tuple[Sheet, NDArray]]:
        return list(zip(self.sheets, self.offsets))

    def _seen(self, origin: ArrayLike, direction: ArrayLike) -> tuple[int, NDArray] | None:
        """The sheet that a ray meets first, and where in its own place [m]."""
        start, way = within_view(vector("origin", origin)), vector("direction", direction)
        hits = [hands.hit(sheet.positions, self.scene.mesh.triangles, start - offset, way) for sheet, offset in self._placed()]
        met = [(found[1], number, found[0]) for number, found in enumerate(hits) if found is not None]
        return min(met)[1:] if met else None

    def _anchor_of(self, particle: int) -> int | None:
        """The scene's anchor that holds a particle of the first sheet."""
        s = self.sheets[0].simulation
        holder = int(s.get_state().holder[0, particle])
        return holder if 0 <= holder < len(s.anchors) else None

    def _checked(self, attachment: int) -> None:
        indices("attachment", [attachment], len(self.scene.anchors), "the attachments of this scene")

    def _targets(self) -> Targets:
        return self._dragged

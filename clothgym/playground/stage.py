"""One visitor's cloth: a scene whose settings change while it runs, with one sheet, or one for each of several integrators."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import integrators
from clothgym.checks import indices, vector
from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.guards import BURST, refusal
from clothgym.parameters import PROPERTIES, of_material
from clothgym.playground.recording import Frame, Recording, read, stiffness, touching
from clothgym.playground.scenes import scene_named
from clothgym.playground.world import FRAME, Scene, Settings, Targets, begin, drive
from clothgym.simulation import Simulation
from clothgym.wind import Wind

STEPS = 2  # control steps of a scene between two frames
GUSTS = 3600  # control steps after which the gusts repeat
LOOK_EVERY = 6  # frames between two measurements of penetration, which cost as much as a control step
EDGE_OF_VIEW = 9.0  # of each coordinate [m]
KEPT = 1800  # most recent frames that are kept
MOST_COMPARED = 4
REMEDY = "Take more substeps, a softer fabric or another integrator, and reset."
UNLIMITED = ", no limit"  # ends the label of a sheet without the others' strain limit
SHREDS = 0.12  # largest displacement at which a sheet that has blown up is drawn [m]: its real position is out of sight
EXPLICIT = ("explicit_euler", "semi_implicit_euler", "verlet", "rk4")  # beyond their bounds a sheet blows up
# settings that change the compiled loop or a method's plan: they need a new simulation of the same sheet
REBUILDS = ("integrator", "bending", "strain_limit", "self_collision")


class Attachment(NamedTuple):
    """An anchor or gripper as a visitor sees it: name, position [m], whether it holds anything, and whether it can be dragged."""

    name: str
    position: NDArray
    holds: bool
    draggable: bool


class Stability(NamedTuple):
    """The present substep [s], the largest that the integrator should be used with (0 if there is none), why, the control step
    [s], and whether a sheet beyond the bound blows up, or is only inaccurate as it moves."""

    substep: float
    bound: float
    why: str
    time_step: float
    explicit: bool = True

    @property
    def share(self) -> float:
        """Of the bound that the substep takes; above 1 it is beyond it."""
        return self.substep / self.bound if self.bound > 0 else np.inf

    @property
    def verdict(self) -> str:
        """What the bound says of the substep."""
        if self.explicit:
            return "stable" if self.share <= 1 else "unstable"
        return "accurate" if self.share <= 1 else "stable, coarse"


def stability(simulation: Simulation) -> Stability:
    explicit = simulation.integrator.name in EXPLICIT
    return Stability(simulation.time_step / simulation.substeps, *simulation.largest_substep(), simulation.time_step, explicit)


def why_it_burst(name: str, at: Stability) -> str:
    """A sentence on a sheet that has blown up."""
    if at.bound <= 0:
        return f"**{name}** burst: it has no bound here, {at.why}."
    step, bound = f"{1e3 * at.substep:.3g} ms", f"{1e3 * at.bound:.3g} ms"
    if at.share > 1:
        return f"**{name}** burst: its substep of {step} is beyond its bound of {bound}: {at.why}."
    return f"**{name}** burst, though its substep of {step} is within the bound of {bound} for a sheet at rest."


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

    def _keep(self, frame: Frame) -> Frame:
        self.recording.frames.append(frame)
        del self.recording.frames[:-KEPT]
        return frame


@dataclass
class Sheet:
    """One simulation on a stage.

    Attributes:
        name: of its integrator.
        limited: whether it has the settings' strain limit.
        simulation: a batch of one.
        cost: of its last control step [s].
        burst: why it has blown up, or ""; it is not advanced any more then.
        penetration: how deep it was in a solid when last measured [m].
        shredded: whether its last positions were set after it blew up.
        positions, touching, readings: when last measured, see ``Frame``.
    """

    name: str
    simulation: Simulation
    limited: bool = True
    cost: float = 0.0
    burst: str = ""
    penetration: float = 0.0
    shredded: bool = False
    positions: NDArray[np.float32] = field(init=False)
    touching: NDArray[np.bool_] = field(init=False)
    readings: dict[str, float] = field(init=False)

    @property
    def label(self) -> str:
        return self.name if self.limited else self.name + UNLIMITED

    def step(self, n: int) -> None:
        begun = time.perf_counter()
        for _ in range(n):
            self.simulation.step()
        self.cost = (time.perf_counter() - begun) / n
        with np.errstate(all="ignore"):
            strain = self.simulation.strain().max()
        if self.simulation.diverged[0] or not strain <= BURST:
            self.burst = why_it_burst(self.name, stability(self.simulation))

    def look(self, penetration: bool) -> None:
        """Update positions and readings.  A sheet that has blown up keeps its readings, and is drawn in shreds."""
        s = self.simulation
        if self.burst:
            if not self.shredded:
                away = np.nan_to_num(s.positions[0] - self.positions, nan=0.0, posinf=SHREDS, neginf=-SHREDS)
                self.positions, self.shredded = self.positions + np.clip(away, -SHREDS, SHREDS).astype(np.float32), True
            return
        if penetration and s.colliders:
            self.penetration = float(s.penetration()[0])
        self.positions, self.touching = visible(s.positions[0]), touching(s)
        self.readings = read(s, self.cost, self.penetration)


class SceneStage(Stage):
    """A scene of the gallery.

    Args:
        scene: its name, or a ``Scene``.
        settings: instead of the scene's own.
        compared: two to four integrators, a sheet each; none for one sheet with the settings' integrator.

    Raises:
        ValueError: no such scene or integrator, or a number of them that cannot be compared.
    """

    def __init__(self, scene: str | Scene, settings: Settings | None = None, compared: Sequence[str] = (), seed: int = 0) -> None:
        super().__init__()
        self.scene = scene_named(scene) if isinstance(scene, str) else scene
        self.name, self.about = self.scene.name, self.scene.about
        self.settings = self.scene.settings if settings is None else settings
        self.seed = seed
        self.steps = 0
        self._dragged: dict[int, NDArray] = {}
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
            wind = np.array([self.settings.wind, 0, 0]) + self.settings.gust * self._gusts[self.steps % len(self._gusts)]
            for sheet in self.sheets:
                if not sheet.burst and not self.left():
                    drive(sheet.simulation, self.scene, self.time, self._targets())
                    sheet.simulation.set_wind(wind)
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
        self.notes.pop("burst", None)
        self._gusts = Wind(gust=1.0).series(np.random.default_rng(self.seed), GUSTS, FRAME)
        for sheet in self.sheets:
            sheet.burst, sheet.cost, sheet.penetration, sheet.shredded = "", 0.0, 0.0, False
            begin(sheet.simulation, self.scene, self.seed or None)
        self.recording.frames[:] = [self._look()]

    def compare(self, names: Sequence[str], unlimited: bool = False) -> None:
        """Start again with a sheet for each of these integrators, two to four.  Without names, with one sheet for the integrator of
        the settings, and with ``unlimited`` beside it the same without the strain limit.

        Raises:
            ValueError: another number of integrators, or names with ``unlimited``.
        """
        names = list(dict.fromkeys(names))
        if len(names) == 1 or len(names) > MOST_COMPARED:
            raise ValueError(f"compared={names!r}: choose two to {MOST_COMPARED} integrators")
        if names and unlimited:
            raise ValueError(f"compared={names!r}, unlimited=True: compare integrators, or one with and without its strain limit")
        methods = [(integrators.get(name).name, True) for name in names] or [(self.settings.integrator, True)]
        if unlimited:
            methods.append((self.settings.integrator, False))
        settings = self.settings
        self.sheets = [Sheet(name, self.scene.simulation(own(settings, name, limited)), limited) for name, limited in methods]
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
            properties = changed_properties(before, after)
            ignored = properties & integrators.get(name).ignored
            if ignored:
                self.notes["ignored"] = refusal(integrators.get(name), sorted(ignored)[0]).capitalize() + "."
            if rebuilt or ignored:
                made.append((name, carried_over(sheet.simulation, self.scene, own(after, name, sheet.limited))))
            else:
                unbounded = set_in_place(sheet.simulation, before, after)
                if unbounded:
                    self.notes["substeps"] = unbounded
                made.append((name, sheet.simulation))
        # recorded positions and readings stay: a sheet that has blown up is not measured again before a reset
        for sheet, (name, simulation) in zip(self.sheets, made):
            sheet.name, sheet.simulation = name, simulation
        self.settings, self._bounds = after, None
        self.recording.labels = tuple(sheet.label for sheet in self.sheets)

    def stabilities(self) -> list[Stability]:
        if self._bounds is None:
            self._bounds = [stability(sheet.simulation) for sheet in self.sheets]
        return self._bounds

    # --- attachments ----------------------------------------------------------------------------------------------------

    def attachments(self) -> list[Attachment]:
        s = self.sheets[0].simulation
        held, places = s.attached[0], s.attachment_positions[0]
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

    def _checked(self, attachment: int) -> None:
        indices("attachment", [attachment], len(self.scene.anchors), "the attachments of this scene")

    def _targets(self) -> Targets:
        return self._dragged


def own(settings: Settings, integrator: str, limited: bool) -> Settings:
    """The settings of one of several sheets."""
    return settings.changed(integrator=integrator, **({} if limited else {"strain_limit": None}))


# --- changing a simulation ----------------------------------------------------------------------------------------------


def changed_properties(before: Settings, after: Settings) -> set[str]:
    """Properties of the fabric in which two settings differ."""
    pairs = zip(PROPERTIES, of_material(before.material), of_material(after.material))
    return {name for name, old, new in pairs if old != new}


def set_in_place(simulation: Simulation, before: Settings, after: Settings) -> str:
    """Change a running simulation in place.  Returns a sentence if its substeps stay since there is no bound, else ""."""
    properties: dict[str, Any] = {name: getattr(after.material, name) for name in changed_properties(before, after)}
    if after.gravity != before.gravity:
        properties["gravity"] = (0, 0, -after.gravity)
    if properties:
        simulation.set_parameters(warn=False, **properties)
    if after.friction != before.friction:
        state = simulation.get_state()
        state.colliders[:, :, R_FRICTION] = state.collider_homes[:, :, R_FRICTION] = after.friction
        simulation.set_state(state)
    if after.substeps != "auto":
        simulation.substeps = after.substeps
        return ""
    largest, why = simulation.largest_substep()
    if largest > 0:
        simulation.substeps = simulation.integrator.automatic_substeps(simulation.time_step, largest)
        return ""
    return f"{simulation.integrator.name} has no bound here, {why}: it goes on with {simulation.substeps} substeps."


def carried_over(simulation: Simulation, scene: Scene, settings: Settings) -> Simulation:
    """A new simulation of a scene's sheet with other settings, with the positions, velocities and attachments of the old one."""
    old = simulation.get_state()
    new = scene.simulation(settings)
    finite = np.isfinite(old.positions).all() and np.isfinite(old.velocities).all()
    if not finite:
        return new
    new.reset(positions=old.positions, velocities=old.velocities)
    state = new.get_state()
    for name in ("holder", "attachment_positions", "attachment_targets", "colliders", "collider_homes", "steps", "diverged"):
        setattr(state, name, getattr(old, name))
    state.colliders[:, :, R_FRICTION] = state.collider_homes[:, :, R_FRICTION] = settings.friction
    new.set_state(state)
    new.set_wind(old.wind)
    return new


def visible(x: NDArray) -> NDArray[np.float32]:
    """Positions that can be drawn [m]: values that are not finite or far away are clipped to the edge of the view."""
    return within_view(np.nan_to_num(x, nan=0.0)).astype(np.float32)


def within_view(x: NDArray) -> NDArray:
    """Positions [m] clipped to the edge of the view."""
    return np.clip(x, -EDGE_OF_VIEW, EDGE_OF_VIEW)

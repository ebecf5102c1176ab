"""One visitor's cloth: a scene whose settings change while it runs."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import indices, vector
from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.guards import BURST
from clothgym.playground import hands
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import FRAME, TITLES, Settings, begin, drive, scene_named, titled
from clothgym.simulation import Simulation
from clothgym.wind import Wind

STEPS = 2  # control steps of a scene between two frames
GUSTS = 3600  # control steps after which the gusts repeat
KEPT = 900  # most recent frames that are kept: half a minute, 26 MB of a sheet of 49 x 49
EDGE_OF_VIEW = 9.0  # of each coordinate [m]
# how far the shreds of a sheet that has blown up fly [m], in how many frames, and particles along a side of one
SHREDS, FLYING, SHRED = 0.35, 30, 6
EXPLICIT = ("explicit_euler", "semi_implicit_euler", "verlet", "rk4")  # beyond their bounds a sheet blows up
REMEDY = "Take more substeps, a softer fabric or another integrator."
# parts of a state that go on in a new simulation of the same sheet
CARRIED = (
    "holder", "attachment_positions", "attachment_targets", "openings", "wanted_openings", "colliders", "collider_homes", "steps",
    "diverged",
)  # fmt: skip


class Stability(NamedTuple):
    """The present substep [s], the largest that the integrator should be used with (0 if there is none), why, and whether a sheet
    beyond the bound blows up, or is only inaccurate as it moves."""

    substep: float
    bound: float
    why: str
    explicit: bool

    @property
    def verdict(self) -> str:
        """Where the substep is relative to the bound."""
        within = self.bound > 0 and self.substep <= self.bound
        if self.explicit:
            return "stable" if within else "unstable"
        return "accurate" if within else "stable, coarse"


def why_it_burst(name: str, at: Stability) -> str:
    """A sentence on a sheet that has blown up."""
    if at.bound <= 0:
        return f"{name} burst: it has no bound here, {at.why}. {REMEDY}"
    step, bound = f"{1e3 * at.substep:.3g} ms", f"{1e3 * at.bound:.3g} ms"
    if at.substep > at.bound:
        return f"{name} burst: its substep of {step} is beyond its bound of {bound}: {at.why}. {REMEDY}"
    return f"{name} burst, though its substep of {step} is within the bound of {bound} for a sheet at rest. {REMEDY}"


def measured(simulation: Simulation, cost: float) -> dict[str, NDArray]:
    """The readings of a sheet: largest strain of its yarns, energy [J], and a control step's cost [s], (1,) each."""
    return {"strain": simulation.strain().max(axis=1), "energy": simulation.energy().total, "cost": np.array([cost])}


def visible(x: NDArray) -> NDArray[np.float32]:
    """Positions that can be drawn [m]: values that are not finite or far away are clipped to the edge of the view."""
    return within_view(np.nan_to_num(x, nan=0.0)).astype(np.float32)


def within_view(x: NDArray) -> NDArray:
    """Positions [m] clipped to the edge of the view."""
    return np.clip(x, -EDGE_OF_VIEW, EDGE_OF_VIEW)


class Stage:
    """What the page shows: something that advances from frame to frame, and records its frames.

    Attributes:
        name: as it was asked for; about: a sentence.
        recording: its frames, the last of which is the current one.
        notes: sentences for the visitor, by subject.
        policies: who can act, by name, and policy, who does.
        drops: whether a visitor can let the sheet fall, see ``drop``.
        budget: of computing, for one frame [s].
        patience: how long the end is shown before it begins again by itself [s].
    """

    name: str
    about: str
    recording: Recording
    seed: int
    policies: Any = ()
    policy: str = ""
    drops: bool = False
    patience: float = 4.0

    def __init__(self) -> None:
        self.notes: dict[str, str] = {}
        self.budget = np.inf

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

    def begin_again(self) -> None:
        """After the end: with the next seed, so that something else happens."""
        self.reset(self.seed + 1)

    def grab(self, place: ArrayLike) -> None:
        """Take hold of the sheet where it is nearest to a position [m], (3,)."""

    def pull(self, place: ArrayLike) -> None:
        """Move the held cloth to a position [m], (3,)."""

    def let_go(self) -> None:
        """Release the held cloth, which flies on."""

    def pin(self, place: ArrayLike) -> None:
        """Pin the sheet where it is nearest to a position [m], (3,), or take away the pin that is there."""

    def blow(self, place: ArrayLike, direction: ArrayLike) -> None:
        """Blow through a position [m] along a direction, (3,) each."""

    def drop(self) -> None:
        """Open the grippers of a task."""

    def held(self) -> NDArray[np.float32]:
        """Where the sheets are held [m], (points, 3)."""
        return np.zeros((0, 3), np.float32)

    def _keep(self, frame: Frame) -> Frame:
        self.recording.frames.append(frame)
        del self.recording.frames[:-KEPT]
        return frame


class SceneStage(Stage):
    """A scene of the gallery.

    Args:
        name: of the scene.
        settings: instead of the scene's own.

    Raises:
        ValueError: no such scene, or an invalid setting.
    """

    hand: hands.Hand
    patience = 8.0
    _gusts: NDArray[np.float64]
    _shreds: list[Frame]

    def __init__(self, name: str, settings: Settings | None = None, seed: int = 0) -> None:
        super().__init__()
        self.scene = scene = scene_named(name)
        self.name, self.about, self.seed = name, scene.about, seed
        self.settings = scene.settings if settings is None else settings
        self.simulation = self._simulated(self.settings)
        self.recording = Recording(TITLES[name], scene.mesh, STEPS * FRAME, scene.camera, ("sheet",), scene.strained)
        self.recording.fabric = self.settings.fabric
        self.reset()

    def _simulated(self, settings: Settings) -> Simulation:
        """A simulation of the scene that a visitor can take hold of."""
        return self.scene.simulation(settings, grippers=hands.grippers(self.scene.mesh, FRAME))

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self.steps * FRAME

    @property
    def over(self) -> bool:
        """Whether the sheet has blown up, and its shreds have come to rest."""
        return "burst" in self.notes and not self._shreds

    # --- going on -------------------------------------------------------------------------------------------------------

    def advance(self) -> Frame:
        begun, s = time.perf_counter(), self.simulation
        if "burst" in self.notes:
            return self._keep(self._shreds.pop()) if self._shreds else self.frame
        for _ in range(STEPS):
            # a frame that takes too long is cut short: then the cloth moves slowly, but the page answers
            if time.perf_counter() - begun > self.budget:
                break
            gust = self.settings.gust * self._gusts[self.steps % len(self._gusts)]
            drive(s, self.scene, self.time, self._dragged)
            self.hand.follow()
            s.set_wind(self.settings.wind * np.array(self.scene.downwind) + gust)
            if self._breath is not None and self.time < self._breath[0]:
                hands.blow(s, *self._breath[1:], FRAME)
            before = time.perf_counter()
            s.step()
            self.cost = time.perf_counter() - before
            self.steps += 1
            with np.errstate(all="ignore"):
                strain = s.strain().max()
            if s.diverged[0] or not strain <= BURST:
                self.notes["burst"] = why_it_burst(titled(s.integrator.name), self.stability())
                self._shreds = self._torn()
                return self._keep(self._shreds.pop())
        return self._keep(self._look())

    def reset(self, seed: int | None = None) -> None:
        self.seed = self.seed if seed is None else int(seed)
        self.steps, self.cost = 0, 0.0
        self._dragged: dict[int, NDArray] = {}  # where the visitor has drawn the scene's anchors [m]
        self._held_anchor: int | None = None  # that the visitor holds by the sheet
        self._breath: tuple[float, NDArray, NDArray] | None = None  # until when, through where and along which way
        self._gusts = Wind(gust=1.0).series(np.random.default_rng(self.seed), GUSTS, FRAME)
        self._shreds = []  # frames of a sheet that has blown up, the next one last
        self.notes.pop("burst", None)
        begin(self.simulation, self.scene, self.seed or None)
        self.hand = hands.Hand(self.simulation)
        self.recording.frames[:] = [self._look()]

    def begin_again(self) -> None:
        """With as many substeps as the method needs: the sheet has just blown up."""
        self.change(substeps="auto")
        self.reset()

    def _look(self) -> Frame:
        s = self.simulation
        return Frame(self.time, visible(s.positions), tuple(self.scene.solids(s)), measured(s, self.cost))

    def _torn(self) -> list[Frame]:
        """The sheet that has just blown up, the last frame first: its shreds fly apart over a second, slower and slower.

        Each is a square of the grid, and flies where its first particle went.
        """
        before, (_, columns) = self.frame, self.scene.mesh.grid_shape
        row, column = np.divmod(np.arange(self.scene.mesh.num_particles), columns)
        first = row // SHRED * SHRED * columns + column // SHRED * SHRED
        away = np.nan_to_num(self.simulation.positions - before.positions, nan=0.0, posinf=SHREDS, neginf=-SHREDS)
        scattered = np.random.default_rng(self.seed).uniform(0.1, 1.0, (len(first), 1))[first]
        away = (scattered * np.clip(away[:, first], -SHREDS, SHREDS)).astype(np.float32)
        nothing = {name: np.array([np.nan]) for name in before.readings}
        shares = 1 - (1 - np.arange(1, FLYING + 1, dtype=np.float32) / FLYING) ** 2
        return [Frame(self.time, before.positions + share * away, before.solids, nothing) for share in shares[::-1]]

    # --- settings -------------------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> None:
        """Change settings: all but the wind in a new simulation, which goes on with the positions and velocities of the old one.

        Raises:
            ValueError: an unknown name or an invalid value; nothing is changed.
        """
        after = self.settings.changed(**changes)
        if replace(after, wind=0.0, gust=0.0) != replace(self.settings, wind=0.0, gust=0.0):
            self._carry_over(after)
        self.settings = after
        self.recording.fabric = after.fabric

    def _carry_over(self, after: Settings) -> None:
        old, new = self.simulation.get_state(), self._simulated(after)
        if np.isfinite(old.positions).all() and np.isfinite(old.velocities).all():
            new.reset(positions=old.positions, velocities=old.velocities)
            state = new.get_state()
            for name in CARRIED:
                setattr(state, name, getattr(old, name))
            state.colliders[:, :, R_FRICTION] = state.collider_homes[:, :, R_FRICTION] = after.friction
            new.set_state(state)
        goals = self.hand.goals
        self.simulation, self.hand = new, hands.Hand(new)
        self.hand.goals = goals

    def stability(self) -> Stability:
        """How the present substep compares with the integrator's bound."""
        s = self.simulation
        return Stability(s.time_step / s.substeps, *s.largest_substep(), s.integrator.name in EXPLICIT)

    # --- the visitor's hand -----------------------------------------------------------------------------------------------

    def grab(self, place: ArrayLike) -> None:
        particle = hands.nearest(self.frame.positions[0], within_view(vector("place", place)))
        self._held_anchor = self._anchor_of(particle)
        if self._held_anchor is None and "burst" not in self.notes:
            self.hand.take(hands.HAND, particle)

    def pull(self, place: ArrayLike) -> None:
        where = within_view(vector("place", place))
        where[2] = max(where[2], 0.0)
        if self._held_anchor is not None:
            self._dragged[self._held_anchor] = where
        elif self.hand.held[hands.HAND]:
            self.hand.goals[hands.HAND] = where

    def let_go(self) -> None:
        self._held_anchor = None
        self.hand.let_go(hands.HAND)

    def pin(self, place: ArrayLike) -> None:
        where = within_view(vector("place", place))
        particle = hands.nearest(self.frame.positions[0], where)
        anchor = self._anchor_of(particle)
        away = np.linalg.norm(self.hand.goals - where, axis=1)
        near = np.flatnonzero(self.hand.held & (away < hands.CLICK))
        near = near[near != hands.HAND]
        if anchor is not None:
            self._dragged.pop(anchor, None)
            self.simulation.release([0], [anchor])
        elif len(near):
            self.hand.let_go(int(near[0]))
        else:
            self.pin_particle(particle)

    def pin_particle(self, particle: int) -> None:
        """Pin a particle where it is.

        Raises:
            ValueError: there is no such particle.
        """
        indices("pins", [particle], self.scene.mesh.num_particles, "the particles of this sheet")
        free = np.flatnonzero(~self.hand.held[1:])
        self.hand.take(int(free[0]) + 1 if len(free) else 1, particle)

    def blow(self, place: ArrayLike, direction: ArrayLike) -> None:
        where, way = within_view(vector("place", place)), vector("direction", direction)
        self._breath = self.time + hands.BREATH_TIME, where, way / max(float(np.linalg.norm(way)), 1e-9)

    def held(self) -> NDArray[np.float32]:
        s, goals = self.simulation, self.hand.goals.copy()
        goals[hands.HAND] = s.grippers.positions[0, hands.HAND]
        anchors = s.attachment_positions[0, : len(s.anchors)][s.attached[0]]
        return visible(np.concatenate([anchors, goals[self.hand.held]]))

    def _anchor_of(self, particle: int) -> int | None:
        """The scene's anchor that holds a particle."""
        holder = int(self.simulation.get_state().holder[0, particle])
        return holder if 0 <= holder < len(self.simulation.anchors) else None

"""One sheet of a stage: its simulation, what is measured on it, whether it has blown up, and how its settings change."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.guards import BURST
from clothgym.material import PRESETS
from clothgym.parameters import PROPERTIES, of_material
from clothgym.playground import hands
from clothgym.playground.recording import read, touching
from clothgym.playground.world import FRAME, Scene, Settings
from clothgym.simulation import Simulation

EDGE_OF_VIEW = 9.0  # of each coordinate [m]
UNLIMITED = ", no limit"  # ends the label of a sheet without the others' strain limit
SHREDS = 0.12  # largest displacement at which a sheet that has blown up is drawn [m]: its real position is out of sight
EXPLICIT = ("explicit_euler", "semi_implicit_euler", "verlet", "rk4")  # beyond their bounds a sheet blows up


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


@dataclass
class Sheet:
    """One simulation on a stage.

    Attributes:
        name: of its integrator, or of its fabric where fabrics are compared.
        limited: whether it has the settings' strain limit.
        simulation: a batch of one.
        cost: of its last control step [s].
        burst: why it has blown up, or ""; it is not advanced any more then.
        penetration: how deep it was in a solid when last measured [m].
        shredded: whether its last positions were set after it blew up.
        hand: what the visitor holds it with.
        positions, touching, readings: when last measured, see ``Frame``.
    """

    name: str
    simulation: Simulation
    limited: bool = True
    cost: float = 0.0
    burst: str = ""
    penetration: float = 0.0
    shredded: bool = False
    hand: hands.Hand = field(init=False)
    positions: NDArray[np.float32] = field(init=False)
    touching: NDArray[np.bool_] = field(init=False)
    readings: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        self.use(self.simulation)

    @property
    def label(self) -> str:
        return self.name if self.limited else self.name + UNLIMITED

    def use(self, simulation: Simulation) -> None:
        """Go on with this simulation; what the visitor holds goes where it went before."""
        goals = self.hand.goals if hasattr(self, "hand") else None
        self.simulation, self.hand = simulation, hands.Hand(simulation)
        if goals is not None:
            self.hand.goals = goals

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
        """Update positions and readings.  A sheet that has blown up has no readings any more, and is drawn in shreds."""
        s = self.simulation
        if self.burst:
            self.readings = dict.fromkeys(self.readings, np.nan)
            if not self.shredded:
                away = np.nan_to_num(s.positions[0] - self.positions, nan=0.0, posinf=SHREDS, neginf=-SHREDS)
                self.positions, self.shredded = self.positions + np.clip(away, -SHREDS, SHREDS).astype(np.float32), True
            return
        if penetration and s.colliders:
            self.penetration = float(s.penetration()[0])
        self.positions, self.touching = visible(s.positions[0]), touching(s)
        self.readings = read(s, self.cost, self.penetration)


def own(settings: Settings, name: str, limited: bool = True) -> Settings:
    """The settings of one of several sheets, of an integrator's or a fabric's name."""
    changes: dict[str, Any] = {"fabric" if name in PRESETS else "integrator": name}
    return settings.changed(**changes, **({} if limited else {"strain_limit": None}))


def simulated(scene: Scene, settings: Settings) -> Simulation:
    """A simulation of a scene that a visitor can take hold of."""
    return scene.simulation(settings, grippers=hands.grippers(scene.mesh, FRAME))


# parts of a state that go on in a simulation of the same sheet with another method
CARRIED = (
    "holder", "attachment_positions", "attachment_targets", "openings", "wanted_openings", "colliders", "collider_homes", "steps",
    "diverged",
)  # fmt: skip

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
    new = simulated(scene, settings)
    finite = np.isfinite(old.positions).all() and np.isfinite(old.velocities).all()
    if not finite:
        return new
    new.reset(positions=old.positions, velocities=old.velocities)
    state = new.get_state()
    for name in CARRIED:
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

"""What a visitor's hand does to a sheet: hold it anywhere, drag and throw it, pin it, and blow on it.

The hand and the pins are grippers of the core.  Out of use they are open and far away.  To take hold of a particle a gripper is
placed at it, and closes in the next control step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym.attachments import Gripper
from clothgym.mesh import ClothMesh
from clothgym.render.surface import vertex_normals
from clothgym.simulation import Simulation

PINS = 8  # that a visitor can set; a further one takes the place of the first
HAND = 0  # the gripper that drags; the others are pins
AWAY = (0.0, 0.0, 50.0)  # where an open gripper waits [m]
GRASP, PIN = 1.2, 0.6  # reach of the hand and of a pin, in spacings of the mesh
FASTEST = 12.0  # of the hand [m/s]
FOLLOWS = 0.4  # share of the way to the pointer that the hand goes in a control step: pointers come 20 times a second, in jumps
CLICK = 0.05  # distance from a pin within which a click is meant for it [m]
BREATH_SPEED, BREATH_RADIUS, BREATH_TIME = 5.0, 0.1, 0.2  # of the air that a visitor blows: [m/s], [m], and for how long [s]
AIR_DENSITY = 1.2  # [kg/m^3]


def grippers(mesh: ClothMesh, time_step: float) -> tuple[Gripper, ...]:
    """The visitor's hand and pins, for a simulation of this mesh."""
    spacing = float(np.median(mesh.springs.rest_length[mesh.springs.kind == mesh.springs.kind.min()]))
    made = {"position": AWAY, "speed": FASTEST, "closing_time": 0.5 * time_step}
    return (Gripper(reach=GRASP * spacing, **made), *[Gripper(reach=PIN * spacing, **made)] * PINS)  # type: ignore[arg-type]


class Hand:
    """The grippers of one simulation, as the visitor uses them.

    Attributes:
        goals: where each gripper is to go [m], (grippers, 3).
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.goals = simulation.grippers.positions[0]

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which grippers hold something, or are about to, (grippers,)."""
        return self.simulation.grippers.wanted[0] == 0

    def take(self, gripper: int, particle: int) -> None:
        """Close a gripper on a particle."""
        s = self.simulation
        places = s.grippers.positions
        places[0, gripper] = self.goals[gripper] = s.positions[0, particle]
        s.grippers.place(places)
        self._close(gripper, 0.0)

    def let_go(self, gripper: int) -> None:
        """Open a gripper; the released cloth flies on."""
        self._close(gripper, 1.0)

    def _close(self, gripper: int, opening: float) -> None:
        wanted = self.simulation.grippers.wanted
        wanted[0, gripper] = opening
        self.simulation.grippers.move(self.simulation.grippers.positions, wanted)

    def follow(self) -> None:
        """Before a control step: the hand goes a part of its way to its goal, and pins stay."""
        grip = self.simulation.grippers
        targets, held = grip.positions, self.held
        targets[0, HAND] += FOLLOWS * (self.goals[HAND] - targets[0, HAND]) * held[HAND]
        # an open gripper goes home when it has let go
        away = ~held & (grip.openings[0] >= 1)
        if np.any(targets[0, away] != AWAY):
            places = targets.copy()
            places[0, away] = targets[0, away] = AWAY
            grip.place(places)
        grip.move(targets, grip.wanted)


# --- where a visitor points ---------------------------------------------------------------------------------------------


def nearest(x: NDArray, place: NDArray) -> int:
    """The particle that is nearest to a position [m]; x: [m], (particles, 3)."""
    return int(np.argmin(((x - place) ** 2).sum(axis=1)))


# --- breath -------------------------------------------------------------------------------------------------------------


def blow(simulation: Simulation, place: NDArray, direction: NDArray, time_step: float) -> None:
    """Change velocities as a jet of air would in a control step: narrow, through ``place`` [m] along the unit vector ``direction``.

    The jet's speed falls with the square of the distance from its axis as ``exp(-(d/r)^2)``.  On a particle of area A and mass m,
    whose normal meets the air at relative speed u, it presses with ``rho/2 u |u| A``.  The core's own air is one for a whole sheet.
    """
    state, mesh = simulation.get_state(), simulation.mesh
    x, v, free = state.positions[0].astype(np.float64), state.velocities[0].astype(np.float64), state.holder[0] < 0
    aside = np.cross(x - place, direction)
    air = BREATH_SPEED * np.exp(-(aside**2).sum(axis=1) / BREATH_RADIUS**2)[:, None] * direction
    normals = np.empty_like(x)
    vertex_normals(x, mesh.triangles, normals)
    relative = np.einsum("ij,ij->i", air - v, normals)
    push = 0.5 * AIR_DENSITY * np.abs(relative) * relative * mesh.area * state.free_inverse_mass[0] * time_step
    # the air cannot make the cloth faster than itself
    change = np.clip(push, -np.abs(relative), np.abs(relative)) * (np.linalg.norm(air, axis=1) > 0.05 * BREATH_SPEED)
    v[free] += (change[:, None] * normals)[free]
    state.velocities[0] = v
    simulation.set_state(state)

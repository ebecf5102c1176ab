"""Floor 5: properties and measurements of a running simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import guards
from clothgym.attachments import Attachments
from clothgym.bending import Bending
from clothgym.checks import count
from clothgym.collisions import Contacts, SelfCollision, SelfContacts, Solids
from clothgym.elements import Elements, SurfaceArrays, Weave
from clothgym.forces import Energy, Oscillators, energy, structural_strain
from clothgym.geometry.intersections import count_intersections
from clothgym.integrators import Integrator
from clothgym.limiting import Limiting
from clothgym.mesh import ClothMesh
from clothgym.state import Fabric, Layout, Orders, State, View


class Observed:
    """The properties and measurements of a ``Simulation``; all are fresh copies, except ``view`` and ``orders``."""

    mesh: ClothMesh
    integrator: Integrator
    layout: Layout
    bending: Bending
    strain_limit: float | None
    threads: int
    _attachments: Attachments
    _solids: Solids
    _contact: SelfCollision
    _x: NDArray
    _v: NDArray
    _free_w: NDArray
    _elements: Elements
    _exact_elements: Elements
    _surface: SurfaceArrays
    _weave: Weave
    _fabric: Fabric
    _parameters: NDArray
    _diverged: NDArray
    _limited: NDArray

    def get_state(self) -> State:
        """Everything that is needed to continue bit for bit."""
        raise NotImplementedError

    @property
    def positions(self) -> NDArray:
        """Positions of the particles [m], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._x)

    @property
    def velocities(self) -> NDArray:
        """Velocities of the particles [m/s], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._v)

    @property
    def view(self) -> View:
        """Positions, velocities, springs and attachments in the memory of the kernels.  It is not a copy, and is read only."""
        attachments = self._attachments
        held = attachments.x, attachments.opening, attachments.blocked, attachments.holder
        return View(self._x, self._v, self._elements.springs, *held)

    @property
    def orders(self) -> Orders:
        """Targets of attachments and fingers, and the wind, in the memory of the kernels.

        ``move_anchors``, ``grippers.move`` and ``set_wind`` write to them after checking their arguments.
        """
        return Orders(self._attachments.targets, self._attachments.wanted, self._fabric.wind)

    @property
    def parameters(self) -> NDArray:
        """Material properties in the order of ``parameters.PROPERTIES``, (num_envs, properties); a fresh copy."""
        return self._parameters.copy()

    @property
    def diverged(self) -> NDArray:
        """Whether an environment has diverged since its reset, (num_envs,): a position was not finite, or a speed above 10 km/s."""
        return self.layout.to_public(self._diverged)

    @property
    def limiting(self) -> Limiting | None:
        """The strains that strain limiting met and left in the last control step; None without a ``strain_limit``."""
        return None if self.strain_limit is None else Limiting(*self.layout.to_public(self._limited).T)

    @property
    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors); a fresh copy."""
        return self._attachments.attached()

    @property
    def attachment_positions(self) -> NDArray:
        """Positions of the attachments, anchors and then grippers [m], (num_envs, attachments, 3); a fresh copy."""
        return self.layout.to_public(self._attachments.x)

    @property
    def blocked(self) -> NDArray:
        """Whether solids stopped or deflected an attachment in the last control step, (num_envs, attachments)."""
        return self.layout.to_public(self._attachments.blocked)

    def pulls(self, envs: ArrayLike | None = None) -> NDArray:
        """Force of the cloth on each attachment, anchors and then grippers [N], (len(envs), attachments, 3).

        It is the sum of the forces of springs, bending, weight and air on the particles that it holds, without their inertia.
        """
        if envs is None:
            return self.layout.to_public(self._pulls())
        chosen = self.layout.chosen(envs)
        return self.layout.to_public(self._pulls(self.layout.at(chosen)[0].tolist()))[chosen]

    def _pulls(self, blocks: list[int] | None = None) -> NDArray:
        return self._attachments.pulls(
            self._x, self._v, self._free_w, self._weave, self.bending, self._fabric, self.threads, blocks
        )

    def largest_substep(self, env: int = 0) -> tuple[float, str]:
        """Largest substep [s] that the integrator should be used with in that environment, and why; zero if there is none."""
        return self.integrator.largest_substep(self._oscillators(count("env", env, least=0, most=self.layout.num_envs - 1)))

    def _oscillators(self, env: int) -> Oscillators:
        """What decides on an environment's substep."""
        sheet = self.mesh, self._exact_elements, self.bending
        return guards.oscillators(*sheet, self._fabric, self._free_w, *self.layout.at(env))

    def strain(self) -> NDArray:
        """Length over rest length, minus one, of the structural springs or edges, (num_envs, those springs)."""
        return structural_strain(self.mesh, self.positions)

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy of each environment [J], (num_envs,) each, in float64."""
        return energy(self._exact_elements, self.bending, self.get_state())

    def contacts(self) -> Contacts:
        """Signed distance of each particle to the nearest collider, which is negative inside."""
        return self._solids.contacts(self._x)

    @property
    def collider_positions(self) -> NDArray:
        """Centers of the colliders, or a plane's point [m], (num_envs, colliders, 3); a fresh copy."""
        return self._solids.positions()

    def penetration(self) -> NDArray:
        """Depth of the sheet's deepest point below the surface of a collider [m], (num_envs,).

        The point may lie anywhere on the triangles.  It is 0 outside all colliders, and NaN where positions are not finite.  The
        thickness that contact keeps is not part of a collider.
        """
        depth = self._solids.penetration(self._x, self._surface)
        return np.where(np.isfinite(self.positions).all(axis=(1, 2)), depth, np.nan)

    @property
    def self_collision(self) -> str | None:
        """How the sheet collides with itself, "fast" or "strict", or None."""
        return None if self._contact.options is None else self._contact.options.mode

    @property
    def self_contacts(self) -> SelfContacts | None:
        """Contacts of each sheet with itself in the last control step; None without ``self_collision``."""
        return self._contact.report()

    def intersections(self) -> NDArray:
        """Number of pairs of triangles that intersect, (num_envs,); -1 where positions are not finite.

        The count is exact, and shares no code with self-collision.
        """
        x = self.positions
        counts, finite = np.full(len(x), -1), np.isfinite(x).all(axis=(1, 2))
        counts[finite] = count_intersections(self.mesh.triangles, x[finite])
        return counts

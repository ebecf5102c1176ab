"""Floor 5: what can be seen of a simulation while it runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.bending import Bending
from clothgym.collisions import Contacts, SelfCollision, SelfContacts, Solids
from clothgym.elements import Elements, SurfaceArrays, Weave
from clothgym.forces import Energy, energy, structural_strain
from clothgym.geometry.intersections import count_intersections
from clothgym.hands import Hands
from clothgym.limiting import Limiting
from clothgym.mesh import ClothMesh
from clothgym.state import Fabric, Layout, Orders, State, View


class Observed:
    """The properties and measurements of a ``Simulation``: fresh copies, but for ``view`` and ``orders``."""

    mesh: ClothMesh
    layout: Layout
    bending: Bending
    strain_limit: float | None
    threads: int
    _hands: Hands
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
        """All that is needed to go on bit for bit."""
        raise NotImplementedError

    @property
    def positions(self) -> NDArray:
        """[m], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._x)

    @property
    def velocities(self) -> NDArray:
        """[m/s], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._v)

    @property
    def view(self) -> View:
        """Positions, velocities, springs and hands as the kernels see them; not a copy, and not to be written to."""
        hands = self._hands
        return View(self._x, self._v, self._elements.springs, hands.x, hands.opening, hands.holder)

    @property
    def orders(self) -> Orders:
        """Where hands and fingers are to be, and the wind, as the kernels see them: what ``move_anchors``, ``grippers.move`` and
        ``set_wind`` write once they have checked it."""
        return Orders(self._hands.targets, self._hands.wanted, self._fabric.wind)

    @property
    def parameters(self) -> NDArray:
        """Material properties of each environment, in the order of ``parameters.PROPERTIES``, (num_envs, properties)."""
        return self._parameters.copy()

    @property
    def diverged(self) -> NDArray:
        """Environments in which something was not finite, or faster than cloth can be, since their reset, (num_envs,)."""
        return self.layout.to_public(self._diverged)

    @property
    def limiting(self) -> Limiting | None:
        """What strain limiting did in the last control step; None without a ``strain_limit``."""
        return None if self.strain_limit is None else Limiting(*self.layout.to_public(self._limited).T)

    @property
    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors); a fresh copy."""
        return self._hands.attached()

    @property
    def hand_positions(self) -> NDArray:
        """Where each anchor and then each gripper is [m], (num_envs, hands, 3); a fresh copy."""
        return self.layout.to_public(self._hands.x)

    @property
    def blocked(self) -> NDArray:
        """Which hands, anchors and then grippers, solids stopped or turned aside in the last control step, (num_envs, hands)."""
        return self.layout.to_public(self._hands.blocked)

    def pulls(self, envs: ArrayLike | None = None) -> NDArray:
        """Force with which the cloth pulls at each anchor and then each gripper [N], (len(envs), hands, 3): the springs',
        the weight's and the air's on the particles that it holds; not what accelerates these."""
        if envs is None:
            return self.layout.to_public(self._pulls())
        chosen = self.layout.chosen(envs)
        return self.layout.to_public(self._pulls(self.layout.at(chosen)[0]))[chosen]

    def _pulls(self, blocks: NDArray | None = None) -> NDArray:
        return self._hands.pulls(self._x, self._v, self._free_w, self._weave, self.bending, self._fabric, self.threads, blocks)

    def strain(self) -> NDArray:
        """Stretch over rest length, minus one, of the structural springs (threads or edges), (num_envs, those springs)."""
        return structural_strain(self.mesh, self.positions)

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy [J], in float64."""
        return energy(self._exact_elements, self.bending, self.get_state())

    def contacts(self) -> Contacts:
        """Signed distance of each particle to the nearest collider; negative would be inside."""
        return self._solids.contacts(self._x)

    @property
    def collider_positions(self) -> NDArray:
        """Where the center of each collider is, or a plane's point [m], (num_envs, colliders, 3); a fresh copy."""
        return self._solids.positions()

    def penetration(self) -> NDArray:
        """How deep the deepest point of the sheet, on its triangles too, is in the colliders' surface [m], (num_envs,); 0 if it
        is in none, and NaN where positions are not finite.  The thickness that contact keeps does not count as part of a
        collider."""
        depth = self._solids.penetration(self._x, self._surface)
        return np.where(np.isfinite(self.positions).all(axis=(1, 2)), depth, np.nan)

    @property
    def self_contacts(self) -> SelfContacts | None:
        """The sheets' contacts with themselves in the last control step; None without ``self_collision``."""
        return self._contact.told()

    def intersections(self) -> NDArray:
        """Number of pairs of triangles that intersect, (num_envs,): an exact count, that self-collision has no part in; -1 where
        positions are not finite."""
        x = self.positions
        counts, finite = np.full(len(x), -1), np.isfinite(x).all(axis=(1, 2))
        counts[finite] = count_intersections(self.mesh.triangles, x[finite])
        return counts

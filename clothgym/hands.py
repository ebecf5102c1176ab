"""Floor 4: what holds the cloth from outside.

A hand is a point that moves at a bounded speed and carries the particles that it holds.  An anchor is a hand bound to one
particle, or to a patch of them, as a clip is; a gripper takes what lies between its fingers when they close.  Held particles
have no inverse mass: nothing but their hand moves them.  A hand does not enter solids, nor does it take what it holds into them: it
stops at the surface, and slides along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import apart, kernel, run_spans, specialize, used
from clothgym.bending import Bending, add_bend_forces
from clothgym.checks import finite, indices, number, spread, vector
from clothgym.collisions import COLLIDER_ROWS, SCRATCH_ROWS, Solids, keep_out, stop_at_solids
from clothgym.elements import Elastic, Weave, room_for_forces
from clothgym.forces import add_air_forces, add_spring_forces
from clothgym.grid_forces import kernels_of
from clothgym.state import Fabric, Layout, State

# columns of what a kernel must know of each hand
SPEED, FINGER_STEP, REACH2, SLIP2 = 0, 1, 2, 3
FREE = -1


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper with two fingers, a kinematic body: it moves as told, stopped by solids only; its fingers do not push the cloth.

    Attributes:
        position: of its tip, where it begins [m].
        speed: its speed limit [m/s].
        reach: particles within this distance of the tip when the fingers have closed are held [m].
        span: distance of the open fingers [m], for the picture.
        closing_time: of the fingers, from open to closed [s].
        slip_force: pull of the cloth beyond which it slips out of the fingers [N]; None for a firm hold.

    Raises:
        ValueError: a property that is not positive, or a position that is not three finite numbers.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.5)
    speed: float = 1.0
    reach: float = 0.03
    span: float = 0.06
    closing_time: float = 0.1
    slip_force: float | None = None

    def __post_init__(self) -> None:
        vector("Gripper position", self.position)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "position" or (field.name == "slip_force" and value is None):
                continue
            if number(f"Gripper {field.name}", value) <= 0:
                raise ValueError(f"Gripper {field.name}={value!r}: must be positive")


class Hands:
    """The anchors and then the grippers of a batch, in the memory layout of the kernels.

    Attributes:
        x, targets: where each hand is, and is to be [m], (block, hands, 3, lane).
        opening, wanted: of the fingers, from 0 (closed) to 1, (block, hands, lane); an anchor's is 0.
        holder: which hand holds each particle, or FREE, (block, particles, lane).
        allowed: where each may go in this control step [m], (block, hands, 3, lane).
        blocked: which hands solids have stopped or turned aside in the last control step, (block, hands, lane).
    """

    def __init__(
        self,
        layout: Layout,
        patches: Sequence[NDArray],
        anchor_speed: float,
        grippers: Sequence[Gripper],
        time_step: float,
        dtype: np.dtype,
    ) -> None:
        self.layout, self.grippers, self.time_step = layout, tuple(grippers), time_step
        self.members = np.concatenate([np.zeros(0, np.int64), *patches])
        self.member_of = np.repeat(np.arange(len(patches)), [len(patch) for patch in patches])
        if len(set(self.members.tolist())) < len(self.members) or not all(len(patch) for patch in patches):
            raise ValueError(f"anchors={[patch.tolist() for patch in patches]}: a particle is named twice, or an anchor has none")
        # an anchor is where its patch's first particle is
        self.anchors = anchors = np.array([patch[0] for patch in patches], np.int64)
        self.count = len(anchors) + len(self.grippers)
        # anchors have no fingers and never slip
        rows = [(anchor_speed, 0.0, 0.0, np.inf)] * len(anchors)
        for g in self.grippers:
            slip = np.inf if g.slip_force is None else g.slip_force**2
            rows.append((g.speed, time_step / g.closing_time, g.reach**2, slip))
        self.limits = np.array(rows, dtype).reshape(-1, 4)
        self.can_slip = bool(np.isfinite(self.limits[:, SLIP2]).any())
        self.allowed = np.zeros((layout.blocks, self.count, 3, layout.lanes), dtype)
        self.blocked = np.zeros((layout.blocks, self.count, layout.lanes), bool)
        self.homes = np.array([g.position for g in self.grippers]).reshape(-1, 3)

    def restore(self, state: State) -> None:
        """Take over a state's part."""
        blocks, dtype = self.layout.to_blocks, self.limits.dtype
        self.x, self.targets = blocks(state.hand_positions, dtype), blocks(state.hand_targets, dtype)
        self.opening, self.wanted = blocks(state.openings, dtype), blocks(state.wanted_openings, dtype)
        self.holder = blocks(state.holder, np.dtype(np.int16))

    def public(self) -> dict[str, NDArray]:
        """A state's part, as fresh copies."""
        public = self.layout.to_public
        return {
            "anchors": np.repeat(self.members[None], self.layout.num_envs, axis=0),
            "holder": public(self.holder),
            "hand_positions": public(self.x),
            "hand_targets": public(self.targets),
            "openings": public(self.opening),
            "wanted_openings": public(self.wanted),
        }

    def begin(self, block: NDArray, lane: NDArray, particles: NDArray) -> None:
        """Put hands back: anchors hold their particles where these are, grippers are open and at home.

        particles: positions of environments' particles [m], (len(block), particles, 3).
        """
        count = len(self.anchors)
        self.holder[block, :, lane] = FREE
        self.holder[block[:, None], self.members, lane[:, None]] = self.member_of
        for array in (self.x, self.targets):
            array[block, :count, :, lane] = particles[:, self.anchors]
        self.blocked[block, :, lane] = False
        self.place(block, lane, self.homes)
        self.opening[block, count:, lane] = self.wanted[block, count:, lane] = 1

    def place(self, block: NDArray, lane: NDArray, positions: NDArray) -> None:
        """Put grippers somewhere at once [m], (grippers, 3) or (len(block), grippers, 3)."""
        for array in (self.x, self.targets):
            array[block, len(self.anchors) :, :, lane] = positions

    def move(self, which: slice, targets: NDArray) -> None:
        """Where some hands are to be at the end of the next step [m], (num_envs, hands, 3)."""
        self.targets[:, which] = self.layout.to_blocks(targets, self.x.dtype)

    def hold(self, block: NDArray, anchor: NDArray, lane: NDArray, x: NDArray) -> None:
        """Make anchors hold their particles, where these now are, but for those that something holds already."""
        for k, first in enumerate(self.anchors):
            b, l = block[anchor == k], lane[anchor == k]
            loose = self.holder[b, first, l] == FREE
            self.x[b[loose], k, :, l[loose]] = self.targets[b[loose], k, :, l[loose]] = x[b[loose], :, first, l[loose]]
            for particle in self.members[self.member_of == k]:
                free = self.holder[b, particle, l] == FREE
                self.holder[b[free], particle, l[free]] = k

    def let_go(self, block: NDArray, anchor: NDArray, lane: NDArray) -> None:
        """Make anchors let go of their particles."""
        for k in range(len(self.anchors)):
            b, l = block[anchor == k], lane[anchor == k]
            for particle in self.members[self.member_of == k]:
                held = self.holder[b, particle, l] == k
                self.holder[b[held], particle, l[held]] = FREE

    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors)."""
        return self.layout.to_public(self.holder[:, self.anchors] == np.arange(len(self.anchors))[:, None])

    def take_up_lag(self, first: int, last: int, lag: NDArray, behind: NDArray, w: NDArray, free_w: NDArray) -> None:
        """Begin a control step of blocks ``first`` to ``last`` after one in which what is held may have been held up."""
        settle_lag(first, last, lag, behind, self.holder, self.anchors, self.limits[:, REACH2], w, free_w)

    def steer(self, first: int, last: int, x: NDArray, v: NDArray, w: NDArray, free_w: NDArray, solids: Solids) -> None:
        """Begin a control step of blocks ``first`` to ``last``."""
        allowed, time_step = self.targets, x.dtype.type(self.time_step)
        if len(solids.colliders) and self.count:
            allowed = self.allowed
            bar_blocks(
                first, last, x, self.x, self.targets, self.holder, self.limits, self.anchors, time_step, solids.rows, solids.shapes,
                allowed, self.blocked,
            )  # fmt: skip
        steer_blocks(
            first, last, x, v, w, free_w, self.x, allowed, self.opening, self.wanted, self.holder, self.limits, self.anchors,
            time_step,
        )  # fmt: skip

    def pulls(
        self,
        x: NDArray,
        v: NDArray,
        free_w: NDArray,
        weave: Weave,
        bending: Bending,
        fabric: Fabric,
        threads: int,
        blocks: NDArray | None = None,
    ) -> NDArray:
        """Force of the cloth on each hand [N], (blocks, hands, 3, lanes); in these blocks, or in all of them."""
        out, add = np.empty_like(self.x), _pulls_with(bending, self.layout.by_particle)

        def work(first: int, last: int) -> None:
            add(first, last, x, v, free_w, weave, fabric, self.holder, out)

        if blocks is None:
            run_spans(work, self.layout.blocks, threads)
            return out
        for block in set(blocks.tolist()):
            work(block, block + 1)
        return out

    def slip(self, pull: NDArray, w: NDArray, free_w: NDArray) -> None:
        """Let go of what pulls harder than its gripper can hold."""
        let_slip(pull, self.holder, w, free_w, self.limits)


class Grippers:
    """The grippers of a simulation, as ``simulation.grippers``: move them, and see where they are."""

    def __init__(self, hands: Hands) -> None:
        self._hands = hands
        self._first = len(hands.anchors)

    def __len__(self) -> int:
        return len(self._hands.grippers)

    @property
    def positions(self) -> NDArray:
        """Of the tips [m], (num_envs, grippers, 3); a fresh copy."""
        return self._hands.layout.to_public(self._hands.x)[:, self._first :]

    @property
    def openings(self) -> NDArray:
        """How far the fingers are open, from 0 to 1, (num_envs, grippers); a fresh copy."""
        return self._hands.layout.to_public(self._hands.opening)[:, self._first :]

    @property
    def wanted(self) -> NDArray:
        """How far the fingers were told to open, from 0 to 1, (num_envs, grippers); a fresh copy."""
        return self._hands.layout.to_public(self._hands.wanted)[:, self._first :]

    @property
    def holder(self) -> NDArray:
        """Which gripper holds each particle, -1 if none does, (num_envs, particles)."""
        holder = self._hands.layout.to_public(self._hands.holder)
        return np.where(holder >= self._first, holder - self._first, -1)

    @property
    def held(self) -> NDArray:
        """Number of particles in each gripper's hold, (num_envs, grippers)."""
        holder = self._hands.holder
        count = np.empty((holder.shape[0], len(self), holder.shape[2]), np.int64)
        count_held(holder, self._first, count)
        return self._hands.layout.to_public(count)

    def move(self, targets: ArrayLike, openings: ArrayLike) -> None:
        """Where the tips are to be at the end of the next step [m], (num_envs, grippers, 3), as far as their speed allows, and
        how far open, from 0 to 1, (num_envs, grippers), as far as the fingers' speed does.

        Fingers take hold of what is in reach when they have closed, and let go when they begin to open.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or an opening that is not from 0 to 1.
        """
        hands, num_envs = self._hands, self._hands.layout.num_envs
        x = spread("targets", finite("targets", targets), (num_envs, len(self), 3))
        wanted = spread("openings", finite("openings", openings), (num_envs, len(self)))
        if np.any((wanted < 0) | (wanted > 1)):
            raise ValueError(f"openings hold {wanted[(wanted < 0) | (wanted > 1)][0]}: must be from 0 to 1")
        hands.move(slice(self._first, None), x)
        hands.wanted[:, self._first :] = hands.layout.to_blocks(wanted, hands.x.dtype)

    def place(self, positions: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Put tips somewhere at once [m], (len(envs), grippers, 3); what they hold stays where it is.

        Raises:
            ValueError: a wrong shape, or a value that is not finite.
        """
        layout = self._hands.layout
        env = np.arange(layout.num_envs) if envs is None else indices("envs", envs, layout.num_envs, "this batch's environments")
        x = spread("positions", finite("positions", positions), (len(env), len(self), 3))
        self._hands.place(*layout.at(env), x)


@kernel
def count_held(holder, anchors, out):
    """Particles in each gripper's hold, (blocks, grippers, lanes)."""
    out[:] = 0
    for b in range(holder.shape[0]):
        for p in range(holder.shape[1]):
            for l in range(holder.shape[2]):
                k = holder[b, p, l] - anchors
                if k >= 0:
                    out[b, k, l] += 1


@apart
def steer(x, v, w, free_w, hand, targets, opening, wanted, holder, limits, anchors, time_step):
    """Begin a control step of one block: move fingers, take hold or let go, and set the velocity of what is held.

    hand: moved on to where it is at the end of the step.  limits: (hands, 4).  anchors: where an anchor is, (anchors,) particles;
    its position is taken from there, so that rounding in the substeps does not add up.
    """
    one = x.dtype.type(1)
    zero = x.dtype.type(0)
    lanes = x.shape[2]
    move = np.empty((3, lanes), x.dtype)
    for k in range(hand.shape[0]):
        if k < anchors.shape[0]:
            p = anchors[k]
            for c in range(3):
                for l in range(lanes):
                    hand[k, c, l] = x[c, p, l] if holder[p, l] == k else hand[k, c, l]
        else:
            step = limits[k, FINGER_STEP]
            for l in range(lanes):
                before = opening[k, l]
                now = min(max(wanted[k, l], before - step), before + step)
                opening[k, l] = now
                if now > zero and before <= zero:
                    for p in range(x.shape[1]):
                        if holder[p, l] == k:
                            holder[p, l] = FREE
                            w[p, l] = free_w[p, l]
                elif now <= zero and before > zero:
                    for p in range(x.shape[1]):
                        dx, dy, dz = x[0, p, l] - hand[k, 0, l], x[1, p, l] - hand[k, 1, l], x[2, p, l] - hand[k, 2, l]
                        near = dx * dx + dy * dy + dz * dz <= limits[k, REACH2]
                        if near and holder[p, l] == FREE:
                            holder[p, l] = k
                            w[p, l] = zero
        for l in range(lanes):
            dx, dy, dz = targets[k, 0, l] - hand[k, 0, l], targets[k, 1, l] - hand[k, 1, l], targets[k, 2, l] - hand[k, 2, l]
            speed = np.sqrt(dx * dx + dy * dy + dz * dz) / time_step
            slow = one / (max(speed / limits[k, SPEED], one) * time_step)
            move[0, l], move[1, l], move[2, l] = dx * slow, dy * slow, dz * slow
        for c in range(3):
            for l in range(lanes):
                hand[k, c, l] += move[c, l] * time_step
        for p in range(x.shape[1]):
            for l in range(lanes):
                if holder[p, l] == k:
                    for c in range(3):
                        v[c, p, l] = move[c, l]


@kernel
def bar_blocks(first, last, x, hand, targets, holder, limits, anchors, time_step, colliders, shapes, allowed, blocked):
    """Write to ``allowed`` where each hand may go in this control step, so that neither it nor what it holds enters a solid.

    Where nothing is in its way that is its target.  (In ``steer`` it would be compiled once more with each caller.)
    """
    one = x.dtype.type(1)
    point, rows, scratch = np.empty((3, 1, 1), x.dtype), np.empty((COLLIDER_ROWS, 1), x.dtype), np.empty((SCRATCH_ROWS, 1), x.dtype)
    tip, way = np.empty(3, x.dtype), np.empty(3, x.dtype)
    for b in range(first, last):
        for k in range(hand.shape[1]):
            for l in range(x.shape[3]):
                held = k < anchors.shape[0] and holder[b, anchors[k], l] == k
                length2 = one - one
                for c in range(3):
                    tip[c] = x[b, c, anchors[k], l] if held else hand[b, k, c, l]
                    way[c] = targets[b, k, c, l] - tip[c]
                    length2 += way[c] * way[c]
                    allowed[b, k, c, l] = targets[b, k, c, l]
                slow = one / max(np.sqrt(length2) / (time_step * limits[k, SPEED]), one)
                for c in range(3):
                    way[c] *= slow
                changed = stop_at_solids(tip, way, colliders[b], shapes, l, time_step, point, rows, scratch)
                for p in range(x.shape[2]):
                    if holder[b, p, l] == k:
                        for c in range(3):
                            tip[c] = x[b, c, p, l]
                        changed |= keep_out(tip, way, colliders[b], shapes, l, time_step, point, rows, scratch)
                blocked[b, k, l] = changed
                if changed:
                    for c in range(3):
                        allowed[b, k, c, l] = (x[b, c, anchors[k], l] if held else hand[b, k, c, l]) + way[c]


@kernel
def steer_blocks(first, last, x, v, w, free_w, hand, targets, opening, wanted, holder, limits, anchors, time_step):
    for b in range(first, last):
        steer(x[b], v[b], w[b], free_w[b], hand[b], targets[b], opening[b], wanted[b], holder[b], limits, anchors, time_step)


def add_pulls(first, last, x, v, free_w, weave, fabric, holder, out):
    """Force of the cloth on each hand [N], (blocks, hands, 3, lanes): elements, weight and air of the particles that it holds."""
    stiffness, rigidity, damping_time, _, resistance, gravity, wind = fabric
    f, scratch = np.empty(x.shape[1:], x.dtype), room_for_forces(x[first], weave.offset)
    for b in range(first, last):
        f[:] = 0
        elastic = Elastic(stiffness[b], rigidity[b], damping_time[b])
        add_spring_forces(x[b], v[b], f, weave.elements, elastic, scratch)
        add_bend_forces(x[b], v[b], f, weave.elements, elastic, scratch)
        add_air_forces(x[b], v[b], f, weave.air, resistance[b], wind[b], scratch)
        out[b] = 0
        for p in range(x.shape[2]):
            for l in range(x.shape[3]):
                k = holder[b, p, l]
                if k >= 0:
                    for c in range(3):
                        out[b, k, c, l] += f[c, p, l] + gravity[b, c, l] / free_w[b, p, l]


@cache
def _pulls_with(bending: Bending, by_particle: bool) -> Any:
    return specialize(add_pulls, f"add_pulls_{bending.name}_{by_particle}", **used(add_pulls, kernels_of(bending, by_particle)))


@kernel
def let_slip(pull, holder, w, free_w, limits):
    """Let go of what pulls harder than its gripper can hold."""
    for b in range(holder.shape[0]):
        for p in range(holder.shape[1]):
            for l in range(holder.shape[2]):
                k = holder[b, p, l]
                if k >= 0:
                    px, py, pz = pull[b, k, 0, l], pull[b, k, 1, l], pull[b, k, 2, l]
                    if px * px + py * py + pz * pz > limits[k, SLIP2]:
                        holder[b, p, l] = FREE
                        w[b, p, l] = free_w[b, p, l]


@kernel
def settle_lag(first, last, lag, behind, holder, anchors, reach2, w, free_w):
    """Before the hands move: an anchor goes on from where its particle is, and so owes nothing for it; what has come out of the
    reach of a gripper's fingers has slipped.

    lag: (blocks, 3, particles, lanes).  behind: (blocks, lanes).  holder: (blocks, particles, lanes).  anchors: their particles.
    reach2: squares of what the hands reach [m^2], (hands,).
    """
    for b in range(first, last):
        for l in range(behind.shape[1]):
            if not behind[b, l] > 0:
                continue
            own = np.zeros((anchors.shape[0], 3), lag.dtype)
            for k in range(anchors.shape[0]):
                for c in range(3):
                    own[k, c] = lag[b, c, anchors[k], l]
            for p in range(holder.shape[1]):
                k = holder[b, p, l]
                if k < 0:
                    continue
                if k < anchors.shape[0]:
                    for c in range(3):
                        lag[b, c, p, l] -= own[k, c]
                elif lag[b, 0, p, l] ** 2 + lag[b, 1, p, l] ** 2 + lag[b, 2, p, l] ** 2 > reach2[k]:
                    holder[b, p, l] = FREE
                    w[b, p, l] = free_w[b, p, l]
                    lag[b, 0, p, l] = lag[b, 1, p, l] = lag[b, 2, p, l] = 0

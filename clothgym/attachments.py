"""Floor 4: attachments, which hold the cloth from outside: anchors and grippers.

An attachment is a point that moves at a bounded speed and carries the particles that it holds.  An anchor is bound to one
particle or to a patch of particles, like a clip.  A gripper takes the particles between its fingers when they
close.  Held particles have inverse mass zero: only their attachment moves them.  An attachment does not enter solids, and does not
carry particles into them: it stops at the surface, and slides along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym._jit import apart, callees_of, kernel, run_spans, specialize
from clothgym.bending import Bending, add_bend_forces
from clothgym.checks import finite, indices, positive, spread, vector
from clothgym.collisions import AT_SURFACE, Solids, keep_out, probe_of, stop_at_solids
from clothgym.elements import Elastic, Topology, scratch_for_forces
from clothgym.forces import add_air_forces, add_spring_forces
from clothgym.grid_forces import kernels_of
from clothgym.layout import Layout
from clothgym.state import Fabric, State

# columns of ``Attachments.limits``: speed limit [m/s], change of the opening in a control step, and the squares of the reach [m^2]
# and of the slip force [N^2]
SPEED, FINGER_STEP, REACH2, SLIP2 = 0, 1, 2, 3
FREE = -1  # the holder of a particle that nothing holds


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper with two fingers.  It is kinematic: it follows its commands, only solids stop it, and its fingers do not push
    cloth.

    Attributes:
        position: initial position of the tip [m].
        speed: speed limit [m/s].
        reach: particles within this distance of the tip are held when the fingers have closed [m].
        span: distance between the open fingers [m], for rendering only.
        closing_time: time in which the fingers close from fully open [s].
        slip_force: force of the cloth above which it slips out of the fingers [N]; None for a firm grip.

    Raises:
        ValueError: a number that is not positive, or a position that is not three finite numbers.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.5)
    speed: float = 1.0
    reach: float = 0.03
    span: float = 0.06
    closing_time: float = 0.1
    slip_force: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(vector("Gripper position", self.position).tolist()))
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "position" or (field.name == "slip_force" and value is None):
                continue
            object.__setattr__(self, field.name, positive(f"Gripper {field.name}", value))


class Attachments:
    """The attachments of a batch, anchors and then grippers, in the memory layout of the kernels.

    Attributes:
        x, targets: positions, and targets for the end of the next control step [m], (block, attachments, 3, lane).
        opening, wanted: present and commanded opening of the fingers, from 0 (closed) to 1, 0 for anchors,
            (block, attachments, lane).
        holder: index of the attachment that holds each particle, or FREE, (block, particles, lane).
        allowed: targets that solids permit in this control step [m], (block, attachments, 3, lane).
        blocked: whether solids stopped or deflected the attachment in the last control step, (block, attachments, lane).
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
        # particles of the anchors, and which anchor each belongs to
        self.members = np.concatenate([np.zeros(0, np.int64), *patches])
        self.member_of = np.repeat(np.arange(len(patches)), [len(patch) for patch in patches])
        if len(set(self.members.tolist())) < len(self.members) or not all(len(patch) for patch in patches):
            raise ValueError(f"anchors={[patch.tolist() for patch in patches]}: a particle is named twice, or an anchor has none")
        # the position of an anchor is that of its patch's first particle
        self.anchors = anchors = np.array([patch[0] for patch in patches], np.int64)
        self.count = len(anchors) + len(self.grippers)
        # limits; anchors have no fingers and never slip
        rows = [(anchor_speed, 0.0, 0.0, np.inf)] * len(anchors)
        for g in self.grippers:
            slip = np.inf if g.slip_force is None else g.slip_force**2
            rows.append((g.speed, time_step / g.closing_time, g.reach**2, slip))
        self.limits = np.array(rows, dtype).reshape(-1, 4)
        self.can_slip = bool(np.isfinite(self.limits[:, SLIP2]).any())
        self.allowed = np.zeros((layout.blocks, self.count, 3, layout.lanes), dtype)
        self.blocked = np.zeros((layout.blocks, self.count, layout.lanes), bool)
        self.homes = np.array([g.position for g in self.grippers]).reshape(-1, 3)

    def check(self, state: State) -> None:
        """Refuse anchors that hold other particles than their own.

        Raises:
            ValueError: the particle and the anchor.
        """
        anchor_of = np.full(state.holder.shape[1], FREE)
        anchor_of[self.members] = self.member_of
        wrong = np.argwhere((state.holder >= 0) & (state.holder < len(self.anchors)) & (state.holder != anchor_of))
        if len(wrong):
            env, particle = wrong[0].tolist()
            raise ValueError(
                f"the state's holder says that anchor {state.holder[env, particle]} holds particle {particle}, which is not its "
                "own: give what get_state() gave"
            )

    def restore(self, state: State) -> None:
        """Copy the attachments of a state."""
        blocks, dtype = self.layout.to_blocks, self.limits.dtype
        self.x, self.targets = blocks(state.attachment_positions, dtype), blocks(state.attachment_targets, dtype)
        self.opening, self.wanted = blocks(state.openings, dtype), blocks(state.wanted_openings, dtype)
        self.holder = blocks(state.holder, np.dtype(np.int32))
        self.blocked[:] = False

    def public(self) -> dict[str, NDArray]:
        """The attachments as fields of a ``State``; fresh copies."""
        public = self.layout.to_public
        return {
            "anchors": np.repeat(self.members[None], self.layout.num_envs, axis=0),
            "holder": public(self.holder),
            "attachment_positions": public(self.x),
            "attachment_targets": public(self.targets),
            "openings": public(self.opening),
            "wanted_openings": public(self.wanted),
        }

    def begin(self, block: NDArray, lane: NDArray, particles: NDArray) -> None:
        """Reset attachments: anchors hold their particles in place, and grippers are open, at their initial positions.

        block, lane: the environments.  particles: positions in them [m], (len(block), particles, 3).
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
        """Place grippers at these positions, with no motion in between [m], (grippers, 3) or (len(block), grippers, 3)."""
        for array in (self.x, self.targets):
            array[block, len(self.anchors) :, :, lane] = positions

    def move(self, which: slice, targets: NDArray) -> None:
        """Set targets of some attachments for the end of the next control step [m], (num_envs, attachments, 3)."""
        self.targets[:, which] = self.layout.to_blocks(targets, self.x.dtype)

    def hold(self, block: NDArray, anchor: NDArray, lane: NDArray, x: NDArray) -> None:
        """Attach anchors to their particles at the present positions, except to particles that are held already.

        block, anchor, lane: the anchors, (count,).  x: positions [m], (blocks, 3, particles, lanes).
        """
        for k, first in enumerate(self.anchors):
            b, l = block[anchor == k], lane[anchor == k]
            loose = self.holder[b, first, l] == FREE
            self.x[b[loose], k, :, l[loose]] = self.targets[b[loose], k, :, l[loose]] = x[b[loose], :, first, l[loose]]
            for particle in self.members[self.member_of == k]:
                free = self.holder[b, particle, l] == FREE
                self.holder[b[free], particle, l[free]] = k

    def let_go(self, block: NDArray, anchor: NDArray, lane: NDArray) -> None:
        """Release the particles of anchors; block, anchor, lane: the anchors, (count,)."""
        for k in range(len(self.anchors)):
            b, l = block[anchor == k], lane[anchor == k]
            for particle in self.members[self.member_of == k]:
                held = self.holder[b, particle, l] == k
                self.holder[b[held], particle, l[held]] = FREE

    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors)."""
        return self.layout.to_public(self.holder[:, self.anchors] == np.arange(len(self.anchors))[:, None])

    def take_up_lag(self, first: int, last: int, lag: NDArray, behind: NDArray, w: NDArray, free_w: NDArray) -> None:
        """Begin a control step of blocks ``first`` to ``last`` with the lag of the last one, see ``settle_lag``."""
        settle_lag(first, last, lag, behind, self.holder, self.anchors, self.limits[:, REACH2], w, free_w)

    def steer(
        self, first: int, last: int, x: NDArray, v: NDArray, w: NDArray, free_w: NDArray, solids: Solids, lag: NDArray
    ) -> None:  # fmt: skip
        """Begin a control step of blocks ``first`` to ``last``: grips, and velocities of held particles, see ``steer``.

        lag: of held particles [m], (blocks, 3, particles, lanes), or of no blocks without strict contact.
        """
        # what grippers take hold of now is carried, and kept out of solids, from this step on
        if self.grippers:
            move_fingers(first, last, x, w, free_w, self.x, self.opening, self.wanted, self.holder, self.limits, self.anchors)
        # where solids let the attachments go
        allowed, time_step = self.targets, x.dtype.type(self.time_step)
        if len(solids.colliders) and self.count:
            allowed = self.allowed
            bar_blocks(
                first, last, x, lag, self.x, self.targets, self.holder, self.limits, self.anchors, time_step, solids.solid, allowed,
                self.blocked,
            )  # fmt: skip
        steer_blocks(first, last, x, v, self.x, allowed, self.holder, self.limits, self.anchors, time_step)

    def pulls(
        self,
        x: NDArray,
        v: NDArray,
        free_w: NDArray,
        topology: Topology,
        bending: Bending,
        fabric: Fabric,
        threads: int,
        blocks: list[int] | None = None,
    ) -> NDArray:
        """Force of the cloth on each attachment [N], (blocks, attachments, 3, lanes), in these blocks, or in all of them."""
        out, add = np.empty_like(self.x), pulls_with(bending, self.layout.kind)

        def work(first: int, last: int) -> None:
            add(first, last, x, v, free_w, topology, fabric, self.holder, out)

        if blocks is None:
            run_spans(work, self.layout.blocks, threads)
            return out
        for block in set(blocks):
            work(block, block + 1)
        return out

    def slip(self, pull: NDArray, blocks: list[int] | None, w: NDArray, free_w: NDArray) -> None:
        """In these blocks, or in all, release particles of grippers on which the cloth pulls with more than their slip force, see
        ``let_slip``; pull: [N], (blocks, attachments, 3, lanes)."""
        for part in [slice(None)] if blocks is None else [slice(block, block + 1) for block in blocks]:
            let_slip(pull[part], self.holder[part], w[part], free_w[part], self.limits)


class Grippers:
    """The grippers of a simulation, as ``simulation.grippers``: commands and measurements."""

    def __init__(self, attachments: Attachments) -> None:
        self._attachments = attachments
        self._first = len(attachments.anchors)

    def __len__(self) -> int:
        return len(self._attachments.grippers)

    @property
    def positions(self) -> NDArray:
        """Positions of the tips [m], (num_envs, grippers, 3); a fresh copy."""
        return self._attachments.layout.to_public(self._attachments.x)[:, self._first :]

    @property
    def openings(self) -> NDArray:
        """Opening of the fingers, from 0 (closed) to 1, (num_envs, grippers); a fresh copy."""
        return self._attachments.layout.to_public(self._attachments.opening)[:, self._first :]

    @property
    def wanted(self) -> NDArray:
        """Commanded opening of the fingers, from 0 (closed) to 1, (num_envs, grippers); a fresh copy."""
        return self._attachments.layout.to_public(self._attachments.wanted)[:, self._first :]

    @property
    def holder(self) -> NDArray:
        """Index of the gripper that holds each particle, -1 if none does, (num_envs, particles)."""
        holder = self._attachments.layout.to_public(self._attachments.holder)
        return np.where(holder >= self._first, holder - self._first, -1)

    @property
    def held(self) -> NDArray:
        """Number of particles that each gripper holds, (num_envs, grippers)."""
        holder = self._attachments.holder
        count = np.empty((holder.shape[0], len(self), holder.shape[2]), np.int64)
        count_held(holder, self._first, count)
        return self._attachments.layout.to_public(count)

    def move(self, targets: ArrayLike, openings: ArrayLike) -> None:
        """Command the positions of the tips and the openings of the fingers for the end of the next control step.

        targets: [m], (num_envs, grippers, 3); openings: from 0 (closed) to 1, (num_envs, grippers).  Grippers and fingers go as far
        as their speeds allow.  Fingers grip the particles within reach when they have closed, and release them when they begin to
        open.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or an opening that is not from 0 to 1.
        """
        attachments, num_envs = self._attachments, self._attachments.layout.num_envs
        x = spread("targets", finite("targets", targets), (num_envs, len(self), 3))
        wanted = spread("openings", finite("openings", openings), (num_envs, len(self)))
        if np.any((wanted < 0) | (wanted > 1)):
            raise ValueError(f"openings hold {wanted[(wanted < 0) | (wanted > 1)][0]}: must be from 0 to 1")
        attachments.move(slice(self._first, None), x)
        attachments.wanted[:, self._first :] = attachments.layout.to_blocks(wanted, attachments.x.dtype)

    def place(self, positions: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Place the tips at these positions, with no motion in between [m], (len(envs), grippers, 3).

        Held particles stay where they are.

        Raises:
            ValueError: a wrong shape, or a value that is not finite.
        """
        layout = self._attachments.layout
        env = np.arange(layout.num_envs) if envs is None else indices("envs", envs, layout.num_envs, "this batch's environments")
        x = spread("positions", finite("positions", positions), (len(env), len(self), 3))
        self._attachments.place(*layout.at(env), x)


# --- kernels: what attachments do at the start of a control step, and the cloth's pull on them at its end ----------------------


@kernel
def count_held(holder, anchors, out):
    """Number of particles that each gripper holds, (blocks, grippers, lanes); anchors: number of anchors."""
    out[:] = 0
    for b in range(holder.shape[0]):
        for p in range(holder.shape[1]):
            for l in range(holder.shape[2]):
                k = holder[b, p, l] - anchors
                if k >= 0:
                    out[b, k, l] += 1


@kernel
def move_fingers(first, last, x, w, free_w, tips, opening, wanted, holder, limits, anchors):
    """Begin a control step of blocks ``first`` to ``last``: fingers move by what ``limits`` allow, and grip or release.

    tips: positions of the attachments [m], (blocks, attachments, 3, lanes).  holder: (blocks, particles, lanes).  opening, wanted:
    (blocks, attachments, lanes).  limits: (attachments, 4).  anchors: the first particle of each anchor, (anchors,).
    """
    zero = x.dtype.type(0)
    for b in range(first, last):
        for k in range(anchors.shape[0], tips.shape[1]):
            step = limits[k, FINGER_STEP]
            for l in range(x.shape[3]):
                before = opening[b, k, l]
                now = min(max(wanted[b, k, l], before - step), before + step)
                opening[b, k, l] = now
                # they release as soon as they begin to open
                if now > zero and before <= zero:
                    for p in range(x.shape[2]):
                        if holder[b, p, l] == k:
                            holder[b, p, l] = FREE
                            w[b, p, l] = free_w[b, p, l]
                # they grip free particles within reach as soon as they have closed
                elif now <= zero and before > zero:
                    for p in range(x.shape[2]):
                        away2 = zero
                        for c in range(3):
                            away2 += (x[b, c, p, l] - tips[b, k, c, l]) ** 2
                        if away2 <= limits[k, REACH2] and holder[b, p, l] == FREE:
                            holder[b, p, l] = k
                            w[b, p, l] = zero


@apart
def steer(x, v, tips, targets, holder, limits, anchors, time_step):
    """Set the velocity of held particles of one block for a control step.

    ``v = (target - tip)/time_step``, shortened to the speed limit.  tips: positions of the attachments [m], (attachments, 3,
    lanes), advanced to the end of the control step.  targets: likewise.  holder: (particles, lanes).
    """
    one = x.dtype.type(1)
    lanes = x.shape[2]
    move = np.empty((3, lanes), x.dtype)
    for k in range(tips.shape[0]):
        # an anchor starts from its particle, so that rounding in the substeps does not accumulate
        if k < anchors.shape[0]:
            p = anchors[k]
            for c in range(3):
                for l in range(lanes):
                    tips[k, c, l] = x[c, p, l] if holder[p, l] == k else tips[k, c, l]
        # velocity towards the target, up to the speed limit
        for l in range(lanes):
            dx, dy, dz = (
                targets[k, 0, l] - tips[k, 0, l],
                targets[k, 1, l] - tips[k, 1, l],
                targets[k, 2, l] - tips[k, 2, l],
            )
            speed = np.sqrt(dx * dx + dy * dy + dz * dz) / time_step
            slow = one / (max(speed / limits[k, SPEED], one) * time_step)
            move[0, l], move[1, l], move[2, l] = dx * slow, dy * slow, dz * slow
        # the attachment moves on at once, and the held particles in the course of the substeps
        for c in range(3):
            for l in range(lanes):
                tips[k, c, l] += move[c, l] * time_step
        for p in range(x.shape[1]):
            for l in range(lanes):
                if holder[p, l] == k:
                    for c in range(3):
                        v[c, p, l] = move[c, l]


@kernel
def keep_held_out(k, x, lag, holder, way, l, time_step, solid, b, probe):
    """Change the way of attachment k in lane l of block b so that no particle which it holds ends deeper in a solid than it began,
    and that neither does the place to which a lagging one will catch up.

    Returns whether it was changed.  way: [m], (3,).  probe: a ``Probe``, whose ``start`` is overwritten.  The rest as in
    ``bar_blocks``.
    """
    start, tolerance, changed = probe.start, x.dtype.type(AT_SURFACE), False
    for p in range(x.shape[2]):
        if holder[b, p, l] != k:
            continue
        for c in range(3):
            start[c] = x[b, c, p, l]
        changed |= keep_out(start, way, solid.rows[b], solid.shapes, l, time_step, tolerance, probe)
        # contact may have held it back: it catches up
        if lag.shape[0] > 0 and (lag[b, 0, p, l] != 0 or lag[b, 1, p, l] != 0 or lag[b, 2, p, l] != 0):
            for c in range(3):
                start[c] += lag[b, c, p, l]
            changed |= keep_out(start, way, solid.rows[b], solid.shapes, l, time_step, tolerance, probe)
    return changed


@kernel
def bar_blocks(first, last, x, lag, tips, targets, holder, limits, anchors, time_step, solid, allowed, blocked):
    """Write to ``allowed`` where each attachment may go in this control step without entering a solid, or carrying particles into
    it.

    If nothing is in its way this is its target.  lag: of held particles [m], see ``settle_lag``; of no blocks where there is none.
    tips, targets, allowed: [m], (blocks, attachments, 3, lanes).  blocked: (blocks, attachments, lanes).  solid: a
    ``collisions.Solid``.
    """
    one = x.dtype.type(1)
    probe = probe_of(x)
    start, way, tried = probe.start, probe.way, probe.tried
    for b in range(first, last):
        for k in range(tips.shape[1]):
            for l in range(x.shape[3]):
                # the way to the target, up to the speed limit
                held = k < anchors.shape[0] and holder[b, anchors[k], l] == k
                length2 = one - one
                for c in range(3):
                    start[c] = x[b, c, anchors[k], l] if held else tips[b, k, c, l]
                    way[c] = targets[b, k, c, l] - start[c]
                    length2 += way[c] * way[c]
                    allowed[b, k, c, l] = targets[b, k, c, l]
                slow = one / max(np.sqrt(length2) / (time_step * limits[k, SPEED]), one)
                for c in range(3):
                    way[c] *= slow
                # shorten or deflect it for the attachment itself, and then for each particle that it holds
                changed = stop_at_solids(start, way, solid.rows[b], solid.shapes, l, time_step, probe)
                changed |= keep_held_out(k, x, lag, holder, way, l, time_step, solid, b, probe)
                # solids that push back in turn may push into each other, as in a sharp corner: then it stays
                if changed:
                    for c in range(3):
                        start[c] = x[b, c, anchors[k], l] if held else tips[b, k, c, l]
                        tried[c] = way[c]
                    caught = keep_out(start, tried, solid.rows[b], solid.shapes, l, time_step, x.dtype.type(AT_SURFACE), probe)
                    if caught or keep_held_out(k, x, lag, holder, tried, l, time_step, solid, b, probe):
                        way[:] = 0
                # where it leads
                blocked[b, k, l] = changed
                if changed:
                    for c in range(3):
                        allowed[b, k, c, l] = (x[b, c, anchors[k], l] if held else tips[b, k, c, l]) + way[c]


@kernel
def steer_blocks(first, last, x, v, tips, targets, holder, limits, anchors, time_step):
    """``steer`` in blocks ``first`` to ``last``."""
    for b in range(first, last):
        steer(x[b], v[b], tips[b], targets[b], holder[b], limits, anchors, time_step)


def add_pulls(first, last, x, v, free_w, topology, fabric, holder, out):
    """``out <- sum_p (f_p + m_p g)`` over the particles p that each attachment holds [N], (blocks, attachments, 3, lanes).

    f: the forces of springs, bending and air.  Blocks ``first`` to ``last``.
    """
    stiffness, rigidity, damping_time, size, _, resistance, gravity, wind = fabric
    f, scratch = np.empty(x.shape[1:], x.dtype), scratch_for_forces(x[first], topology.offset)
    for b in range(first, last):
        # the forces on all particles of the block
        f[:] = 0
        elastic = Elastic(stiffness[b], rigidity[b], damping_time[b], size[b])
        add_spring_forces(x[b], v[b], f, topology.elements, elastic, scratch)
        add_bend_forces(x[b], v[b], f, topology.elements, elastic, scratch)
        add_air_forces(x[b], v[b], f, topology.air, resistance[b], wind[b], x.dtype.type(0), scratch)
        # their sum, with the weights, for each attachment
        out[b] = 0
        for p in range(x.shape[2]):
            for l in range(x.shape[3]):
                k = holder[b, p, l]
                if k >= 0:
                    for c in range(3):
                        out[b, k, c, l] += f[c, p, l] + gravity[b, c, l] / free_w[b, p, l]


@cache
def pulls_with(bending: Bending, layout: str) -> Any:
    """``add_pulls`` with the forces of a bending model and a memory layout."""
    return specialize(add_pulls, f"add_pulls_{bending.name}_{layout}", **callees_of(add_pulls, kernels_of(bending, layout)))


@kernel
def let_slip(pull, holder, w, free_w, limits):
    """Release the particles of attachments on which the cloth pulls with more than their slip force.

    pull: [N], (blocks, attachments, 3, lanes).  holder, w, free_w: (blocks, particles, lanes).  limits: (attachments, 4).
    """
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
    """Adjust the lag, by which contact kept held particles behind their attachments, before these move on.

    An anchor starts from its first particle, so the lag of its particles is counted from that one.  A particle whose lag exceeds
    the reach of its gripper has slipped out.

    lag: [m], (blocks, 3, particles, lanes).  behind: positive where a lane has any lag, (blocks, lanes).  holder: (blocks,
    particles, lanes).  anchors: first particle of each anchor, (anchors,).  reach2: square of the reach [m^2], (attachments,).
    """
    for b in range(first, last):
        for l in range(behind.shape[1]):
            if not behind[b, l] > 0:
                continue
            # the lag of each anchor's first particle
            own = np.zeros((anchors.shape[0], 3), lag.dtype)
            for k in range(anchors.shape[0]):
                for c in range(3):
                    own[k, c] = lag[b, c, anchors[k], l]
            # subtract it from the anchor's particles; release what has slipped out of a gripper
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

"""Floor 6: crumpled, folded and rumpled initial sheets, and the maneuvers that make them.

A maneuver is a batch of sheets above a floor, with a script for their anchors or grippers.  Each environment has a seed:

    heap = MANEUVERS["heap"](grid(25, 25, 1.0, 1.0), seeds=range(5), self_collision="strict")
    while not heap.over:
        heap.step()

Lengths scale with the sheet's side, its larger extent at rest.  Durations suit a sheet of about one meter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym import checks
from clothgym.attachments import Gripper
from clothgym.collisions import Plane
from clothgym.geometry.intersections import find_intersections
from clothgym.material import Material
from clothgym.mesh import ClothMesh
from clothgym.simulation import Simulation

FRICTION = 0.5  # coefficient between cloth and floor
TILT = np.radians(3)  # approximate angle by which a seed tilts the start [rad]
ROUGHNESS = 1e-3  # approximate displacement of each particle, in lengths of the shortest spring
SETTLING_DRAG = 5.0  # rate of the linear drag under which starts come to rest [1/s]
REST_SPEED = 5e-3  # rms speed below which a start is at rest [m/s]
LONG_SETTLING, TREMBLING = 20.0, 0.05  # after this time [s], this speed [m/s] counts as rest: squeezed folds keep trembling


class Maneuver:
    """A scripted maneuver with a batch of sheets.

    Args:
        mesh: the sheet, flat at rest.
        material: the fabric.
        seeds: one for each environment.  A seed varies the start slightly, and all random choices.
        thickness: distance between layers, at the start and where anchors place them [m].
        options: for ``Simulation``, such as ``self_collision``.

    Attributes:
        simulation: the batch.  seconds: duration [s].
    """

    seconds: float
    grippers: ClassVar[Sequence[Gripper]] = ()

    def __init__(
        self,
        mesh: ClothMesh,
        material: Material | None = None,
        seeds: Sequence[int] = (0,),
        thickness: float = 0.008,
        **options: Any,
    ) -> None:
        if not isinstance(mesh, ClothMesh):
            raise ValueError(f"mesh={checks.shown(mesh)}: must be a ClothMesh, as grid() and disc() make")
        if own := {"num_envs", "colliders", "anchors", "grippers"} & set(options):
            raise ValueError(f"{', '.join(sorted(own))}: set by the maneuver itself, leave them out")
        # the sheet, centered at the origin, and a random generator for each environment
        self.mesh = mesh
        self.random = [np.random.default_rng(seed) for seed in checks.indices("seeds", seeds, 2**63 - 1, "seeds")]
        self.thickness = checks.positive("thickness", thickness)
        self.rest = mesh.rest_positions - (mesh.rest_positions.max(axis=0) + mesh.rest_positions.min(axis=0)) / 2
        self.side = float(np.ptp(self.rest, axis=0).max())
        self.frames = 0
        # the batch, at its varied start
        world = {"colliders": [Plane(friction=FRICTION)], "anchors": self._anchors().tolist(), "grippers": self.grippers}
        self.simulation = Simulation(mesh, material, num_envs=len(self.random), **world, **options)
        self.start = self._varied(*self._start())
        self.simulation.reset(positions=self.start)
        self.held = self.simulation.positions[:, self.simulation.anchors].astype(np.float64)

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.frames * self.simulation.time_step

    @property
    def over(self) -> bool:
        """Whether the maneuver has ended."""
        return self.time >= self.seconds - 1e-9

    def step(self) -> None:
        """Advance by one control step."""
        self._steer(self.time + self.simulation.time_step)
        self.simulation.step()
        self.frames += 1

    def _anchors(self) -> NDArray:
        """Anchored particles, in the order of ``held``."""
        return np.zeros(0, np.int64)

    def _start(self) -> tuple[NDArray, float]:
        """Initial positions [m], (particles, 3), and the height of the lowest particle above the floor [m]."""
        raise NotImplementedError

    def _steer(self, time: float) -> None:
        """Move the anchors or grippers to their targets at this time [s]."""

    def _varied(self, x: NDArray, height: float) -> NDArray:
        """The start of each environment, slightly tilted and uneven [m], (num_envs, particles, 3).

        The lowest particle is at ``height`` [m].
        """
        short = self.mesh.springs.rest_length.min()
        sheets = []
        for random in self.random:
            sheet = x @ _rotation(random.normal(size=3), TILT * random.uniform(0.2, 1.0)).T
            sheet += np.clip(random.normal(size=x.shape), -2, 2) * ROUGHNESS * short
            sheets.append(sheet + (0, 0, height - sheet[:, 2].min()))
        return np.array(sheets)

    def _near(self, x: float, y: float) -> int:
        """The particle nearest to a point of the bounding box; (1, 1) is a corner, and (1, 0) the middle of a side."""
        place = np.array([x, y, 0]) * np.ptp(self.rest, axis=0) / 2
        return int(np.argmin(np.linalg.norm(self.rest - place, axis=1)))


class EdgeDrop(Maneuver):
    """An upright sheet falls on its edge."""

    seconds = 5.0

    def _start(self) -> tuple[NDArray, float]:
        return self.rest[:, [0, 2, 1]] * (1, -1, 1), 0.1 * self.side


class ZFold(Maneuver):
    """A sheet folded in zigzag falls.

    Its height rises evenly along the sheet.  It is the graph of a function over an upright plane, so it does not intersect itself.
    """

    seconds = 5.0

    def __init__(self, *args: Any, leaves: int = 8, **options: Any) -> None:
        self.leaves = checks.count("leaves", leaves)
        super().__init__(*args, **options)

    def _start(self) -> tuple[NDArray, float]:
        along, lowest = self.rest[:, 0] - self.rest[:, 0].min(), 0.1 * self.side
        length = np.ptp(self.rest[:, 0])
        # creases at equal distances; on a grid they follow columns of particles
        creases = np.linspace(0, length, self.leaves + 1)
        spacing = float(np.median(self.mesh.springs.rest_length[self.mesh.springs.kind <= 2]))
        if self.mesh.shape is None:
            slope = 0.5  # creases cut through triangles, and a smaller slope would shorten these much more
        else:
            columns = np.unique(along.round(9))
            creases = np.unique(columns[np.abs(columns[:, None] - creases).argmin(axis=0)])
            # next to a crease two columns are twice slope times spacing apart
            slope = min(max(0.13, 0.75 * self.thickness / spacing), 0.9)
        # the leaf of each particle, and its position across the leaves
        leaf = np.clip(np.searchsorted(creases, along, side="right") - 1, 0, len(creases) - 2)
        within = along - creases[leaf]
        across = np.concatenate([[0.0], np.cumsum(np.diff(creases) * np.where(np.arange(len(creases) - 1) % 2, -1, 1))])
        x = (across[leaf] + np.where(leaf % 2, -1, 1) * within) * np.sqrt(1 - slope**2)
        return np.stack([x - x.mean(), self.rest[:, 1], slope * along], axis=1), lowest


class Heap(Maneuver):
    """A sheet that hangs by a corner is released."""

    seconds, release = 7.0, 3.0

    def _anchors(self) -> NDArray:
        return np.array([self._near(1, 1)])

    def _start(self) -> tuple[NDArray, float]:
        across, up = self.rest[:, 0] - self.rest[:, 1], self.rest[:, 0] + self.rest[:, 1]
        return np.stack([across, np.zeros_like(across), up], axis=1) / np.sqrt(2), 0.1 * self.side

    def _steer(self, time: float) -> None:
        self.simulation.move_anchors(self.held)
        if time >= self.release:
            self.simulation.release()


class Fold(Maneuver):
    """A sheet on the floor is folded in half by its corners, in alternating directions."""

    carrying, holding, resting = 1.5, 0.3, 0.7  # [s]
    # for each fold: the direction of the carried side, and the directions of the particles held there; later folds hold the corners
    # of all layers, and the ends of creases, which were the middle of a side
    FOLDS = (
        ((0, 1), ((-1, 1), (1, 1))),
        ((1, 0), ((1, -1), (1, 0), (1, 1))),
        ((0, -1), ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, -1), (0, 1))),
    )

    def __init__(self, *args: Any, times: int = 1, **options: Any) -> None:
        self.times = checks.count("times", times)
        if times > len(self.FOLDS):
            raise ValueError(f"times={checks.shown(times)}: a sheet can be folded {len(self.FOLDS)} times at most")
        self.seconds = (self.carrying + self.holding + self.resting) * times + 1.5
        self.directions = sorted({d for _, held in self.FOLDS[:times] for d in held})
        super().__init__(*args, **options)
        self.targets = self.held.copy()
        self.miss = np.array([random.uniform(-0.02, 0.02) * self.side for random in self.random])
        self.simulation.release()

    def _anchors(self) -> NDArray:
        return np.array([self._near(*d) for d in self.directions])

    def _start(self) -> tuple[NDArray, float]:
        return self.rest, 0.5 * self.thickness

    def _varied(self, x: NDArray, height: float) -> NDArray:
        sheets = super()._varied(x, height)
        sheets[:, :, 2] = height  # flat, because a sheet standing on a corner would slip
        return sheets

    def _steer(self, time: float) -> None:
        fold, passed = divmod(time - 1e-9, self.carrying + self.holding + self.resting)
        if fold >= self.times:
            return
        direction, held = self.FOLDS[int(fold)]
        anchors = [self.directions.index(d) for d in held]
        step = self.simulation.time_step
        # a new fold attaches its anchors at their particles; at its end it releases them
        if passed <= step:
            for anchor in anchors:
                self.simulation.attach(None, [anchor])
            self.held = self.simulation.positions[:, self.simulation.anchors].astype(np.float64)
            self.axis, self.top = self._crease(np.array(direction, float)), self.held[:, anchors, 2].max(axis=1)
        elif passed > self.carrying + self.holding:
            self.simulation.release()
            return
        # held particles turn about the crease
        angle = np.pi * _eased(min(passed / self.carrying, 1.0))
        out = self.held[:, :, :2] @ np.array(direction) - self.axis[:, None]
        up = self.held[:, :, 2] - (self.top + self.thickness)[:, None]
        turned = np.cos(angle) * out - np.sin(angle) * up
        self.targets[:] = self.held
        self.targets[:, :, :2] += (turned - out)[:, :, None] * direction
        self.targets[:, :, 2] += np.sin(angle) * out + (np.cos(angle) - 1) * up
        self.simulation.move_anchors(self.targets)

    def _crease(self, direction: NDArray) -> NDArray[np.float64]:
        """Position of each crease along the direction [m], (num_envs,), near the middle of the current sheet."""
        along = self.simulation.positions[:, :, :2].astype(np.float64) @ direction
        return (along.max(axis=1) + along.min(axis=1)) / 2 + self.miss


class Wring(Maneuver):
    """Two opposite edges are twisted against each other and moved closer.  Particles around the middle of each edge are held.

    turns: of one edge against the other.  turning: duration of the twist [s]; afterwards the edges stay in place.  share: held part
    of each edge.  approach: share of their distance by which the edges come closer.
    """

    holding = 2.0  # [s]

    def __init__(
        self, *args: Any, turns: float = 3.0, turning: float = 9.0, share: float = 0.25, approach: float = 0.15, **options: Any
    ) -> None:
        self.turns, self.turning, self.share, self.approach = turns, checks.positive("turning", turning), share, approach
        self.seconds = turning + self.holding
        super().__init__(*args, **options)

    def _anchors(self) -> NDArray:
        x, y = self.rest[:, 0], self.rest[:, 1]
        # on a disc, the part of the rim within a fifth of the radius of the extreme point
        reach = 1e-6 if self.mesh.shape is not None else 0.1 * self.side
        width = (0.5 * self.share + 1e-6) * self.side
        edges = [np.flatnonzero((end * x >= x.max() - reach) & (np.abs(y) <= width)) for end in (-1, 1)]
        rim = np.unique(_rim(self.mesh.triangles))
        return np.concatenate([np.intersect1d(edge, rim) for edge in edges])

    def _start(self) -> tuple[NDArray, float]:
        return self.rest, 0.7 * self.side

    def _steer(self, time: float) -> None:
        share = min(time / self.turning, 1.0)
        middle = self.held.mean(axis=1, keepdims=True)
        offset = self.held - middle
        angle = np.where(offset[:, :, 0] > 0, 1, -1) * np.pi * self.turns * share
        c, s = np.cos(angle), np.sin(angle)
        y, z = offset[:, :, 1], offset[:, :, 2]
        turned = np.stack([offset[:, :, 0] * (1 - self.approach * share), c * y - s * z, s * y + c * z], axis=2)
        self.simulation.move_anchors(middle + turned)


class Drag(Maneuver):
    """A sheet above the floor is dragged by a corner at ``speed`` [m/s], from one random point to the next."""

    def __init__(self, *args: Any, speed: float = 1.0, seconds: float = 30.0, **options: Any) -> None:
        self.speed, self.seconds = checks.positive("speed", speed), checks.positive("seconds", seconds)
        super().__init__(*args, **options)
        self.target, self.goal = self.held[:, 0].copy(), self.held[:, 0].copy()

    def _anchors(self) -> NDArray:
        return np.array([self._near(1, 1)])

    def _start(self) -> tuple[NDArray, float]:
        return self.rest, 0.05 * self.side

    def _steer(self, time: float) -> None:
        for env, random in enumerate(self.random):
            # path length of this control step, which may pass several points
            left = self.speed * self.simulation.time_step
            while left > 0:
                way = self.goal[env] - self.target[env]
                length = float(np.linalg.norm(way))
                if length > left:
                    self.target[env] += way * (left / length)
                    break
                self.target[env], left = self.goal[env], left - length
                self.goal[env] = random.uniform((-0.5, -0.5, 0.02), (0.5, 0.5, 0.7)) * self.side
        self.simulation.move_anchors(self.target[:, None])


class PickAndDrop(Maneuver):
    """A sheet on the floor is picked up at a random point, carried and dropped, ``picks`` times.

    lift: lowest and highest lift, in sides.  carry: largest distance along x and y, in sides.
    """

    grippers = (Gripper(speed=1.0),)
    closing, dropping = 0.15, 1.0  # [s]

    def __init__(
        self, *args: Any, picks: int = 2, lift: tuple[float, float] = (0.1, 0.4), carry: float = 0.4, **options: Any
    ) -> None:
        self.lift, self.carry = lift, carry
        super().__init__(*args, **options)
        self.lifting = 1.5 * self.side * np.hypot(lift[1], np.sqrt(2) * carry) / self.grippers[0].speed
        self.turn = self.closing + self.lifting + self.dropping
        self.seconds = checks.count("picks", picks) * self.turn

    def _start(self) -> tuple[NDArray, float]:
        return self.rest, 0.5 * self.thickness

    def _steer(self, time: float) -> None:
        passed = (time - 1e-9) % self.turn
        grippers, step = self.simulation.grippers, self.simulation.time_step
        # a new pick: a random particle and a random goal
        if passed <= step:
            x = self.simulation.positions.astype(np.float64)
            self.taken = np.array([x[env, random.integers(len(self.rest))] for env, random in enumerate(self.random)])
            low, high = (-self.carry, -self.carry, self.lift[0]), (self.carry, self.carry, self.lift[1])
            self.goal = np.array([random.uniform(low, high) for random in self.random]) * self.side
            self.goal[:, 2] += self.taken[:, 2]
            grippers.place(self.taken[:, None])
        share = _eased(min(max(passed - self.closing, 0.0) / self.lifting, 1.0))
        opening = float(passed > self.closing + self.lifting)
        grippers.move((self.taken + share * (self.goal - self.taken))[:, None], np.full((len(self.random), 1), opening))


MANEUVERS: dict[str, Callable[..., Maneuver]] = {
    "edge drop": EdgeDrop,
    "z-fold": ZFold,
    "heap": Heap,
    "fold": Fold,
    "fold twice": partial(Fold, times=2),
    "fold three times": partial(Fold, times=3),
    "wring": Wring,
    "impossible wring": partial(Wring, turns=5.0, turning=5.0, share=1.0, approach=0.0),
    "drag at 1 m/s": Drag,
    "drag at 3 m/s": partial(Drag, speed=3.0),
}
STARTS: dict[str, Callable[..., Maneuver]] = {
    "crumpled": partial(PickAndDrop, lift=(0.7, 1.1), carry=0.2),
    "folded": partial(Fold, times=2),
    "rumpled": PickAndDrop,
}


def make(
    mesh: ClothMesh,
    material: Material | None = None,
    kind: str = "crumpled",
    count: int = 1,
    seed: int = 0,
    thickness: float = 0.008,
    **options: Any,
) -> NDArray:
    """Sheets at rest on a floor at z = 0, free of intersections [m], (count, particles, 3).

    Args:
        mesh: the sheet, flat at rest.
        material: the fabric.
        kind: "crumpled", "folded" or "rumpled".  A crumpled sheet was lifted high at a random point and dropped, twice.  A
            folded one was folded in half twice.  A rumpled one was lifted slightly and dropped, twice.
        count: number of sheets.
        seed: sheet i of seed s is the first sheet of seed s + i.
        thickness: of the cloth in self-contact [m].
        options: for ``Simulation``; by default ``self_collision`` is "strict" with this thickness.

    Raises:
        ValueError: an unknown kind, or options that ``Simulation`` refuses.
        RuntimeError: a sheet that still moves faster than ``TREMBLING`` after ``LONG_SETTLING``, or that intersects itself.
    """
    checks.one_of("kind", kind, *STARTS)
    checks.count("count", count)
    checks.count("seed", seed, least=0)
    options = {"self_collision": {"mode": "strict", "thickness": thickness}} | options
    maneuver = STARTS[kind](mesh, material, range(seed, seed + count), thickness, **options)
    while not maneuver.over:
        maneuver.step()
    simulation = maneuver.simulation
    simulation.set_parameters(air_drag=SETTLING_DRAG * simulation.material.density)
    # take each sheet when it comes to rest, independently of the others
    x, moving = simulation.positions, np.ones(count, bool)
    while moving.any():
        late = maneuver.time > maneuver.seconds + LONG_SETTLING
        speed = np.where(moving, np.sqrt((simulation.velocities.astype(np.float64) ** 2).sum(axis=2).mean(axis=1)), 0)
        if late and speed.max() > TREMBLING:
            raise RuntimeError(
                f"{kind} sheet of seed {seed + int(speed.argmax())} does not come to rest, it moves at {speed.max():.2g} m/s: take "
                "another seed or fabric"
            )
        settled = moving & (speed <= (TREMBLING if late else REST_SPEED))
        x[settled] = simulation.positions[settled]
        moving &= ~settled
        simulation.step(6)
        maneuver.frames += 6
    found = find_intersections(mesh.triangles, x)
    if len(found):
        env, first, second = found[0].tolist()
        raise RuntimeError(
            f"{kind} sheet of seed {seed + env} intersects itself {np.sum(found[:, 0] == env)} times, at triangles {first} and "
            f"{second} for instance: use self_collision='strict', and a thickness that fits the mesh"
        )
    return x


def _eased(share: float) -> float:
    """Smooth progress, from 0 to 1, at a share of the duration from 0 to 1."""
    return (1 - float(np.cos(np.pi * share))) / 2


def _rotation(axis: NDArray, angle: float) -> NDArray[np.float64]:
    """Rotation matrix about an axis, (3, 3), by Rodrigues' formula; angle: [rad]."""
    cross = np.cross(np.eye(3), axis / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _rim(triangles: NDArray) -> NDArray:
    """Edges that belong to one triangle only, (edges, 2)."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    edges, times = np.unique(edges, axis=0, return_counts=True)
    return edges[times == 1]

"""What the hook tasks share: the sheet with a hole, the hook, whether it is in the hole, what is observed, and the evaluation.

A hook is an arm that rises from a post.  Its tasks are ``HookingTask``; an episode's hook is kept in its record.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined
from clothgym.checks import finite, number, shown
from clothgym.collisions import Capsule, Collider, Plane
from clothgym.envs.definition import POSITION_BOUND, Observation
from clothgym.envs.episode import Fields
from clothgym.envs.framed import FramedTask
from clothgym.envs.hanging import LYING, SPEED_SCALE
from clothgym.envs.manipulation import follow
from clothgym.envs.measures import SPEED2, distance, share_above
from clothgym.envs.targets import FRICTION, ON_FLOOR
from clothgym.mesh import ClothMesh, grid
from clothgym.triangles import triangle_mesh

if TYPE_CHECKING:
    from clothgym.render import Camera

# in sides: the arm's length; radii of arm and post; height of the arm's root above the floor, and of the post above it; how far the
# post is from the origin
ARM, ARM_RADIUS, POST_RADIUS, HEIGHTS, TOP, SPREAD = 0.3, 0.02, 0.03, (1.15, 1.35), 0.3, 0.15
RISE, TURN = np.pi / 6, np.pi / 4  # [rad]: the arm rises by this; a hook is turned by at most that
ARM_SLOT, POST_SLOT = 1, 2  # places among ``colliders``
ON_HOOK = (
    0.01  # distance at which cloth rests on them [m]: the height of the arc over a side of a triangle, so that it does not tremble
)

GUIDE_SCALE = 0.4  # in sides: how the guidance falls with the way that is left
MOST_LYING, ENOUGH_REST = 0.02, 0.02  # share of the sheet; [m/s]


# --- the sheet ----------------------------------------------------------------------------------------------------------------


class HoledSheet(NamedTuple):
    """A square sheet with a rectangular hole.

    mesh: its triangles.  kept: its particles in the grid that it is cut from, (particles,).  rim: its particles around the hole, in
    order, (rim,).  corners: as a grid's.  key: particles that are observed: corners, middles of the edges, corners of the hole.
    """

    mesh: ClothMesh
    kept: NDArray
    rim: NDArray
    corners: tuple[int, int, int, int]
    key: NDArray


def sheet_with_hole(rows: int, side: float, width: int, height: int, below: int) -> HoledSheet:
    """A sheet cut from a square grid of an odd number of rows: without ``width`` x ``height`` of its cells, amid them, ``below`` so
    many cells from the upper edge; width is even."""
    whole = grid(rows, rows, side, side)
    index = np.arange(rows * rows).reshape(rows, rows)
    left, top = (rows - 1 - width) // 2, rows - 1 - below
    right, bottom = left + width, top - height
    # a triangle is in the hole if its middle is
    row, column = (whole.triangles // rows).mean(axis=1), (whole.triangles % rows).mean(axis=1)
    hole = (bottom < row) & (row < top) & (left < column) & (column < right)
    triangles = whole.triangles[~hole]
    kept = np.unique(triangles)
    new = np.full(rows * rows, -1)
    new[kept] = np.arange(len(kept))
    mesh = triangle_mesh(whole.rest_positions[kept], new[triangles])
    # around the hole, counter-clockwise
    rim = np.concatenate([
        index[bottom, left:right], index[bottom:top, right], index[top, right:left:-1], index[top:bottom:-1, left]
    ])  # fmt: skip
    middle, last = rows // 2, rows - 1
    edges = index[[0, middle, middle, last], [middle, 0, last, middle]]
    cut = index[[bottom, bottom, top, top], [left, right, left, right]]
    corners = tuple(int(new[corner]) for corner in whole.corners)
    return HoledSheet(mesh, kept, new[rim], corners, np.concatenate([corners, new[edges], new[cut]]))  # type: ignore[arg-type]


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@apart
def threads(x, rim, a, b):
    """How often the segment from a to b goes through a hole, less how often it comes back.

    The hole is spanned by the fan of triangles from the mean of its rim to the rim's edges.  A line meets a triangle where it has
    all three edges on the same side: the signs of three volumes.  Of two triangles that share an edge, both have the same numbers.

    x: (3, particles) [m].  rim: particles around the hole, in order, (rim,).
    """
    count, n = 0, rim.shape[0]
    # all from a: along the segment, and to the hole's middle
    d, m = (b[0] - a[0], b[1] - a[1], b[2] - a[2]), np.zeros(3)
    for k in range(n):
        for c in range(3):
            m[c] += (np.float64(x[c, rim[k]]) - a[c]) / n
    q = (x[0, rim[n - 1]] - a[0], x[1, rim[n - 1]] - a[1], x[2, rim[n - 1]] - a[2])
    for k in range(n):
        p, q = q, (x[0, rim[k]] - a[0], x[1, rim[k]] - a[1], x[2, rim[k]] - a[2])
        # volumes that the segment's line makes with the triangle's edges
        u = _volume(d, p, q)
        v = _volume(d, q, m)
        w = _volume(d, m, p)
        if (u > 0) != (v > 0) or (v > 0) != (w > 0):
            continue
        # and whether both ends are on different sides of the triangle: their volumes with it
        before = _volume(p, q, m)
        after = before - (u + v + w)
        if (before > 0) != (after > 0):
            count += 1 if u > 0 else -1
    return count


@inlined
def _volume(p, q, r):
    """Six times the signed volume of the tetrahedron of the origin and three points."""
    return (
        p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0])
    )  # fmt: skip


@apart
def lying_of(x, triangles, areas):
    """Share of a sheet's area that is lower than ``LYING``; areas: of the flat sheet's triangles, summing to 1."""
    lying = 0.0
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        lying += areas[t] * share_above(LYING - np.float64(x[2, a]), LYING - np.float64(x[2, b]), LYING - np.float64(x[2, c]))
    return lying


@inlined
def measure_hook(own, rules, sheet):
    """Write whether the arm is in the hole, the hole's middle and normal, and the share of the sheet on the floor."""
    # the arm's ends
    own.tip[0] = own.root[0] + rules.arm_out * own.turn[1]
    own.tip[1] = own.root[1] - rules.arm_out * own.turn[0]
    own.tip[2] = own.root[2] + rules.arm_up
    own.threaded = threads(sheet.x, rules.rim, own.root, own.tip) != 0
    own.lying = lying_of(sheet.x, sheet.mesh.triangles, rules.areas)
    # middle of the rim; and the area that it goes around, as a vector
    n = rules.rim.shape[0]
    for c in range(3):
        own.hole[c] = own.facing[c] = 0.0
    for k in range(n):
        for c in range(3):
            own.hole[c] += np.float64(sheet.x[c, rules.rim[k]]) / n
    for k in range(n):
        p, q = rules.rim[k], rules.rim[(k + 1) % n]
        for c in range(3):
            i, j = (c + 1) % 3, (c + 2) % 3
            own.facing[c] += (np.float64(sheet.x[i, p]) - own.hole[i]) * (np.float64(sheet.x[j, q]) - own.hole[j])
            own.facing[c] -= (np.float64(sheet.x[j, p]) - own.hole[j]) * (np.float64(sheet.x[i, q]) - own.hole[i])
    size = np.sqrt(own.facing[0] ** 2 + own.facing[1] ** 2 + own.facing[2] ** 2)
    for c in range(3):
        own.facing[c] /= max(size, 1e-12)


@inlined
def hook_score(own):
    """The share of the sheet off the floor if the arm is in the hole, else 0."""
    return 1 - own.lying if own.threaded else 0.0


@inlined
def on_hook(own):
    """Whether the sheet hangs on the hook, at rest or not."""
    return own.threaded and own.lying <= MOST_LYING


@inlined
def guidance(own, rules):
    """How short the way is that is left to the hole's middle, in [0, 1]: along the arm to its root, from before its tip."""
    left = distance(own.hole, own.root) if own.threaded else distance(own.hole, own.tip) + rules.arm
    return 1 / (1 + (left / (GUIDE_SCALE * rules.side)) ** 2)


@inlined
def evaluate_hook(own, rules, sheet, info):
    """Write how the sheet hangs and how much it is at rest; returns the normalized performance."""
    info.threaded, info.lying, info.rms_speed = own.threaded, own.lying, np.sqrt(sheet.summary[SPEED2])
    info.is_success = on_hook(own) and info.rms_speed < ENOUGH_REST
    return hook_score(own) / (1 + (info.rms_speed / SPEED_SCALE) ** 2)


@inlined
def account_hook(own, rules, sheet, info, terms, running, failure):
    """The episode's best score, and since when the sheet hangs by itself and whether that has lasted; no reward terms."""
    free = True
    for k in range(sheet.holds.shape[0]):
        free = free and sheet.holds[k] == 0
    follow(own, info, hook_score(own), free and on_hook(own), running, failure)
    return 0.0


@inlined
def observe_hook(own, rules, sheet, seen):
    """The hole and the hook, relative to the arm's tip, and the time."""
    for c in range(3):
        seen.hole[c] = (own.hole[c] - own.tip[c]) / rules.side
        seen.hole_normal[c] = own.facing[c]
        seen.arm[c] = (own.root[c] - own.tip[c]) / rules.arm
    seen.tip_height, seen.threaded, seen.lying = own.tip[2] / rules.side, own.threaded, own.lying
    seen.settling = own.settling_since >= 0
    seen.episode_left = 1 - own.step / (rules.acting_steps + rules.settling_steps)
    seen.acting_left = max(rules.acting_steps - own.step, 0) / rules.acting_steps


OBSERVATIONS = (
    Observation("hole", "middle of the hole's rim, relative to the arm's tip", (3,), "L", POSITION_BOUND),
    Observation("hole_normal", "unit normal of the hole", (3,)),
    Observation("arm", "direction of the arm, from its tip to its root, a unit vector", (3,)),
    Observation("tip_height", "height of the arm's tip", (), "L", 2.0),
    Observation("threaded", "whether the arm is in the hole"),
    Observation("lying", "share of the sheet on the floor"),
    Observation("settling", "whether the sheet settles, and actions are ignored"),
    Observation("episode_left", "share of the episode left"),
    Observation("acting_left", "share of the acting time left"),
)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class HookingTask(FramedTask):
    """Base of the hook tasks.  In the hook's frame the arm is across from 0 to before it, and what is held comes from there.

    Attributes:
        sheet_cut: the sheet, whose mesh is that of ``physics``.
    """

    frame_at = "root"
    sheet_cut: ClassVar[HoledSheet]
    settling_steps = 150
    points_relative_to = "the arm's tip"
    key_points = "corners, middles of the edges, and corners of the hole"
    evaluation = (("threaded", bool), ("lying", float), ("rms_speed", float))
    accounts: ClassVar[Fields] = (("best", float), ("first_success", np.int64), ("success_held", bool))
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "best": (0.0, 1.0), "first_success": (-1, 10_000), "lost": (0, 1), "turn": (-1.0, 1.0), "root": (-2.0, 2.0),
        "tip": (-2.5, 2.5), "threaded": (0, 1), "lying": (-1e-6, 1 + 1e-6), "facing": (-1.0, 1.0),
    }  # fmt: skip
    reset_options: ClassVar[tuple[str, ...]] = ("material", "hook")
    arguments: ClassVar = {"rows": "none: the sheet has one mesh, of triangles", "side": "none other, as for ``rows``"}

    def remembers(self) -> Fields:
        # ends of the arm's axis [m], cosine and sine of its yaw; the hole's middle [m] and normal; and how the sheet hangs
        own: Fields = [
            ("root", float, 3), ("turn", float, 2), ("tip", float, 3), ("hole", float, 3), ("facing", float, 3),
            ("threaded", np.uint8), ("lying", float),
        ]  # fmt: skip
        return [*super().remembers(), *own, ("best", float), ("first_success", np.int64), ("lost", np.uint8)]

    def check_episode(self, env: int, own: Any) -> None:
        super().check_episode(env, own)
        if abs(own["turn"] @ own["turn"] - 1) > 1e-9 or own["root"][2] <= 0 or not np.allclose(own["tip"], self.tip_of(own)):
            raise ValueError(f"the state's hook at {own['root'].tolist()}, its tip or its turn is none: give what get_state() gave")

    def constants(self) -> dict[str, Any]:
        mesh, side = self.physics.mesh, self.physics.side
        a, b = (mesh.rest_positions[mesh.triangles[:, k]] - mesh.rest_positions[mesh.triangles[:, 0]] for k in (1, 2))
        areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        own = {"areas": areas / areas.sum(), "rim": self.sheet_cut.rim, "arm": ARM * side}
        own |= {"arm_out": ARM * side * float(np.cos(RISE)), "arm_up": ARM * side * float(np.sin(RISE))}
        return super().constants() | own

    @classmethod
    def observed_particles(cls, mesh: ClothMesh) -> NDArray:
        return cls.sheet_cut.key

    # --- the hook -------------------------------------------------------------------------------------------------------

    def tip_of(self, own: Any) -> NDArray:
        """Where the arm of an episode's record ends [m]."""
        (c, s), side = own["turn"], self.physics.side
        return own["root"] + ARM * side * np.array([np.cos(RISE) * s, -np.cos(RISE) * c, np.sin(RISE)])

    def colliders(self) -> list[Collider]:
        """The floor, and arm and post, in whose places each episode has its own."""
        turn = np.array([1.0, 0.0])
        root = np.array([0, 0, self.physics.side])
        return [Plane(friction=FRICTION, thickness=ON_FLOOR), *self.hook({"root": root, "turn": turn})]

    def hook(self, own: Any) -> list[Collider]:
        """Arm and post of an episode's record."""
        side, root, tip = self.physics.side, own["root"], self.tip_of(own)
        radius, high = POST_RADIUS * side, float(root[2]) + TOP * side
        arm = Capsule(
            center=tuple(((root + tip) / 2).tolist()), radius=ARM_RADIUS * side, height=(ARM + 2 * ARM_RADIUS) * side,
            axis=tuple((tip - root).tolist()), friction=FRICTION, thickness=ON_HOOK,
        )  # fmt: skip
        # the lower round end of the post is sunk
        post = Capsule(
            center=(float(root[0]), float(root[1]), high / 2), radius=radius, height=high + 2 * radius, friction=FRICTION,
            thickness=ON_HOOK,
        )  # fmt: skip
        return [arm, post]

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        return dict(zip((ARM_SLOT, POST_SLOT), self.hook(self.episode[env])))

    def check_options(self, options: Mapping[str, Any]) -> None:
        super().check_options(options)
        wanted, side = options.get("hook", {}), self.physics.side
        known = ("height", "center", "yaw")
        if not isinstance(wanted, Mapping):
            raise ValueError(f"reset option hook={shown(wanted)}: must be a dict with any of {', '.join(known)}")
        unknown = set(wanted) - set(known)
        if unknown:
            raise ValueError(f"unknown key {sorted(unknown)[0]!r} of the reset option 'hook' (there are: {', '.join(known)})")
        if not 1.1 * side <= number("hook height", wanted.get("height", 1.2 * side)) <= 1.5 * side:
            raise ValueError(f"hook height={wanted['height']!r}: must be from {1.1 * side:g} to {1.5 * side:g} m, to hang free")
        if abs(number("hook yaw", wanted.get("yaw", 0.0))) > np.pi / 2:
            raise ValueError(f"hook yaw={wanted['yaw']!r}: must be within 90 degrees (pi/2)")
        center = finite("hook center", wanted.get("center", (0.0, 0.0)))
        if center.shape != (2,) or np.abs(center).max() > 0.5 * side:
            raise ValueError(f"hook center={shown(wanted['center'])}: must be two numbers within {0.5 * side:g} m of the origin")

    def draw_hook(self, env: int, rng: np.random.Generator, wanted: Mapping[str, Any]) -> None:
        """Draw the hook of an environment's episode, of which some properties may be wanted, and write it into its record."""
        side, own = self.physics.side, self.episode[env]
        height, center, yaw = side * rng.uniform(*HEIGHTS), side * rng.uniform(-SPREAD, SPREAD, 2), rng.uniform(-TURN, TURN)
        x, y = wanted.get("center", center)
        yaw = float(wanted.get("yaw", yaw))
        own["root"], own["turn"] = (x, y, wanted.get("height", height)), (np.cos(yaw), np.sin(yaw))
        own["tip"] = own["origin"] = self.tip_of(own)

    def camera(self) -> Camera:
        from clothgym.render import Camera  # imported here: training draws nothing

        far = self.physics.side / 0.6
        return Camera(eye=(-2.0 * far, -1.5 * far, 1.05 * far), target=(0.0, -0.3 * far, 0.43 * far), vertical_fov=38.0)

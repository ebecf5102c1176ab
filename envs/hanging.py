"""What the hanging tasks share: the rail on its posts, how a sheet hangs over it, what is observed, and the evaluation.

Their tasks are ``HangingTask``, and name these kernels; the rail of an episode is kept in its record, see ``remembers``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, inlined
from clothgym.checks import finite, number, shown
from clothgym.collisions import Capsule, Collider, Plane
from clothgym.envs.definition import POSITION_BOUND, Observation
from clothgym.envs.episode import Fields
from clothgym.envs.framed import FramedTask
from clothgym.envs.manipulation import follow
from clothgym.envs.measures import CENTROID, SPEED2, share_above
from clothgym.envs.targets import FRICTION, ON_FLOOR

if TYPE_CHECKING:
    from clothgym.render import Camera

# in sides: half the rail's length between the axes of its posts; heights of its axis; how far its middle is from the origin
HALF_LENGTH, HEIGHTS, SPREAD = 0.75, (0.75, 1.0), 0.15
TURN = np.pi / 4  # [rad]: a rail is turned by at most this
RAIL_SLOT, POSTS = 1, (2, 3)  # places among ``colliders``

LYING = 0.03  # cloth lower than this lies on the floor [m]
OVER = 0.05  # cloth less than this above the rail's contact surface rests on it, in sides
GUIDE_SCALE = 0.4  # in sides: how the guidance falls with the center's distance from where it should be
SPEED_SCALE = 0.1  # [m/s]: performance is halved at this rms speed
# twice the smaller side's share; in sides; share of the sheet; [m/s]
ENOUGH_BALANCE, ENOUGH_SUPPORT, MOST_LYING, ENOUGH_REST = 0.6, 0.9, 0.02, 0.02


# --- how a sheet hangs --------------------------------------------------------------------------------------------------------


@apart
def hang_of(x, triangles, rest, areas, side, rail, turn, ends, low, high, out):
    """How a sheet hangs over a rail: (share of it beyond the rail, share on the floor, length that the rail carries, in sides).

    The rail's vertical plane cuts the sheet's triangles.  Areas and lengths are those of the flat sheet, by linear functions on the
    triangles, so that the same surface in other triangles has the same shares.  A point of the cut is carried if it is between
    ``low`` and ``high`` above the rail's axis [m], and no farther than ``ends`` from its middle.  A line that halves a square is as
    long as a side or longer: length beyond that counts for nothing.

    x: (3, particles) [m].  rest: (particles, 2) [m].  areas: of the triangles, summing to 1.  rail: middle of its axis [m].
    turn: cosine and sine of its yaw.
    """
    beyond, lying, carried = 0.0, 0.0, 0.0
    v, cut, d = np.empty(3), np.empty((2, 4)), np.empty(3)
    for t in range(triangles.shape[0]):
        # signed distances from the rail's plane, and the areas
        for m in range(3):
            p = triangles[t, m]
            v[m] = turn[0] * (np.float64(x[1, p]) - rail[1]) - turn[1] * (np.float64(x[0, p]) - rail[0])
            d[m] = LYING - np.float64(x[2, p])
        share = share_above(v[0], v[1], v[2])
        beyond += areas[t] * share
        lying += areas[t] * share_above(d[0], d[1], d[2])
        if share == 0 or share == 1:
            continue
        # the ends of the cut: along the rail, above it, and in the flat sheet
        found = 0
        for m in range(3):
            n = (m + 1) % 3
            if (v[m] > 0) != (v[n] > 0):
                s, p, q = v[m] / (v[m] - v[n]), triangles[t, m], triangles[t, n]
                for c in range(2):
                    cut[found, 2 + c] = rest[p, c] + s * (rest[q, c] - rest[p, c])
                here_x, here_y = x[0, p] + s * (x[0, q] - x[0, p]), x[1, p] + s * (x[1, q] - x[1, p])
                cut[found, 0] = turn[0] * (here_x - rail[0]) + turn[1] * (here_y - rail[1])
                cut[found, 1] = x[2, p] + s * (x[2, q] - x[2, p]) - rail[2]
                found += 1
        along, above = (cut[0, 0] + cut[1, 0]) / 2, (cut[0, 1] + cut[1, 1]) / 2
        if abs(along) <= ends and low <= above <= high:
            carried += np.sqrt((cut[1, 2] - cut[0, 2]) ** 2 + (cut[1, 3] - cut[0, 3]) ** 2)
    out[0], out[1], out[2] = beyond, lying, min(carried / side, 1.0)


@inlined
def measure_hang(own, rules, sheet):
    """Write how the sheet hangs, see ``hang_of``."""
    hang_of(
        sheet.x, sheet.mesh.triangles, rules.rest, rules.areas, rules.side, own.rail, own.turn, rules.ends, 0.0,
        rules.carried_within, own.hang,
    )  # fmt: skip


@inlined
def balance_of(own):
    """Twice the share of the sheet on the smaller side of the rail: 1 for halves."""
    return 2 * min(own.hang[0], 1 - own.hang[0])


@inlined
def hang_score(own):
    """How well the sheet hangs, in [0, 1]: 1 for halves on both sides that the rail carries, and nothing on the floor."""
    return balance_of(own) * own.hang[2] * (1 - own.hang[1])


@inlined
def hangs(own):
    """Whether it hangs, at rest or not."""
    return balance_of(own) >= ENOUGH_BALANCE and own.hang[2] >= ENOUGH_SUPPORT and own.hang[1] <= MOST_LYING


@inlined
def guidance(own, rules, sheet):
    """How near the center of area is to that of a sheet that hangs, in [0, 1]: a quarter of a side below the rail."""
    x, y = sheet.summary[CENTROID] - own.rail[0], sheet.summary[CENTROID + 1] - own.rail[1]
    # anywhere along the rail where the sheet does not reach beyond its ends
    along = max(abs(own.turn[0] * x + own.turn[1] * y) - (rules.ends - rules.side / 2), 0.0)
    across, up = own.turn[0] * y - own.turn[1] * x, sheet.summary[CENTROID + 2] - own.rail[2] + rules.side / 4
    return 1 / (1 + (along * along + across * across + up * up) / (GUIDE_SCALE * rules.side) ** 2)


@inlined
def evaluate_hang(own, rules, sheet, info):
    """Write how the sheet hangs and how much it is at rest; returns the normalized performance."""
    info.balance, info.support, info.lying = balance_of(own), own.hang[2], own.hang[1]
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    info.is_success = hangs(own) and info.rms_speed < ENOUGH_REST
    return hang_score(own) / (1 + (info.rms_speed / SPEED_SCALE) ** 2)


@inlined
def account_hang(own, rules, sheet, info, terms, running, failure):
    """The episode's best score, and since when the sheet hangs by itself and whether that has lasted; no reward terms."""
    free = True
    for k in range(sheet.holds.shape[0]):
        free = free and sheet.holds[k] == 0
    follow(own, info, hang_score(own), free and hangs(own), running, failure)
    return 0.0


@inlined
def observe_rail(own, rules, sheet, seen):
    """The sheet's center and how it hangs, the rail, and the time."""
    for c in range(3):
        seen.center[c] = (sheet.summary[CENTROID + c] - own.origin[c]) / rules.side
        seen.hang[c] = own.hang[c]
    seen.rail_height = own.rail[2] / rules.side
    seen.rail_turn[0], seen.rail_turn[1] = own.turn[0], own.turn[1]
    seen.settling = own.settling_since >= 0
    seen.episode_left = 1 - own.step / (rules.acting_steps + rules.settling_steps)
    seen.acting_left = max(rules.acting_steps - own.step, 0) / rules.acting_steps


OBSERVATIONS = (
    Observation("center", "center of area, relative to the middle of the rail", (3,), "L", POSITION_BOUND),
    Observation(
        "hang", "share of the sheet beyond the rail, share on the floor, length that the rail carries [L], at most 1", (3,)
    ),
    Observation("rail_height", "height of the rail's axis", (), "L", 2.0),
    Observation("rail_turn", "cosine and sine of its yaw", (2,)),
    Observation("settling", "whether the sheet settles, and actions are ignored"),
    Observation("episode_left", "share of the episode left"),
    Observation("acting_left", "share of the acting time left"),
)


# --- the tasks ----------------------------------------------------------------------------------------------------------------


class HangingTask(FramedTask):
    """Base of the hanging tasks.

    Attributes:
        radius: of the rail and its posts, in sides.  rail_friction: between them and the cloth.  rail_thickness: distance at which
            the cloth rests on them [m]: about the height of the arc over a side of a triangle, so that particles carry the sheet.
    """

    frame_at = "rail"
    radius: ClassVar[float] = 0.05
    rail_friction: ClassVar[float] = FRICTION
    rail_thickness: ClassVar[float] = 0.006
    settling_steps = 150
    points_relative_to = "the middle of the rail"
    evaluation = (("balance", float), ("support", float), ("lying", float), ("rms_speed", float))
    accounts: ClassVar[Fields] = (("best", float), ("first_success", np.int64), ("success_held", bool))
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "best": (0.0, 1.0), "first_success": (-1, 10_000), "lost": (0, 1), "turn": (-1.0, 1.0), "hang": (-1e-6, 1 + 1e-6),
        "rail": (-2.0, 2.0),
    }  # fmt: skip
    reset_options: ClassVar[tuple[str, ...]] = ("material", "rail")

    def remembers(self) -> Fields:
        # the middle of the rail's axis [m], cosine and sine of its yaw, and how the sheet hangs
        own: Fields = [("rail", float, 3), ("turn", float, 2), ("hang", float, 3)]
        return [*super().remembers(), *own, ("best", float), ("first_success", np.int64), ("lost", np.uint8)]

    def check_episode(self, env: int, own: Any) -> None:
        super().check_episode(env, own)
        if abs(own["turn"] @ own["turn"] - 1) > 1e-9 or own["rail"][2] <= self.radius * self.physics.side:
            raise ValueError(f"the state's rail {own['rail'].tolist()} or its turn is none: give what get_state() gave")

    def constants(self) -> dict[str, Any]:
        mesh, side = self.physics.mesh, self.physics.side
        rest = mesh.rest_positions[:, :2]
        a, b = rest[mesh.triangles[:, 1]] - rest[mesh.triangles[:, 0]], rest[mesh.triangles[:, 2]] - rest[mesh.triangles[:, 0]]
        areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        own = {"rest": np.ascontiguousarray(rest, np.float64), "areas": areas / areas.sum(), "ends": HALF_LENGTH * side}
        radius = self.radius * side
        return super().constants() | own | {"radius": radius, "carried_within": radius + self.rail_thickness + OVER * side}

    # --- the rail -------------------------------------------------------------------------------------------------------

    def colliders(self) -> list[Collider]:
        """The floor, the rail and its posts, in whose places each episode has its own."""
        floor = Plane(friction=FRICTION, thickness=ON_FLOOR)
        return [floor, *self.frame(np.array([0, 0, self.physics.side]), np.array([1.0, 0.0]))]

    def frame(self, rail: NDArray, turn: NDArray) -> list[Collider]:
        """A rail and its posts, with these records."""
        side, friction, thickness = self.physics.side, self.rail_friction, self.rail_thickness
        radius, half = self.radius * side, HALF_LENGTH * side
        x, y, z = rail.tolist()
        along = (float(turn[0]), float(turn[1]), 0.0)
        bar = Capsule(
            center=(x, y, z), radius=radius, height=2 * (half + radius), axis=along, friction=friction, thickness=thickness
        )
        # the lower round end of a post is sunk, and its upper one is the rail's
        ends = [(x + way * half * along[0], y + way * half * along[1]) for way in (-1, 1)]
        posts = [
            Capsule(center=(*end, z / 2), radius=radius, height=z + 2 * radius, friction=friction, thickness=thickness)
            for end in ends
        ]
        return [bar, *posts]

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        own = self.episode[env]
        return dict(zip((RAIL_SLOT, *POSTS), self.frame(own["rail"], own["turn"])))

    def check_options(self, options: Mapping[str, Any]) -> None:
        super().check_options(options)
        wanted, side = options.get("rail", {}), self.physics.side
        known = ("height", "center", "yaw")
        if not isinstance(wanted, Mapping):
            raise ValueError(f"reset option rail={shown(wanted)}: must be a dict with any of {', '.join(known)}")
        unknown = set(wanted) - set(known)
        if unknown:
            raise ValueError(f"unknown key {sorted(unknown)[0]!r} of the reset option 'rail' (there are: {', '.join(known)})")
        if not 0.6 * side <= number("rail height", wanted.get("height", side)) <= 1.2 * side:
            raise ValueError(f"rail height={wanted['height']!r}: must be from {0.6 * side:g} to {1.2 * side:g} m, to hang over")
        if abs(number("rail yaw", wanted.get("yaw", 0.0))) > np.pi / 2:
            raise ValueError(f"rail yaw={wanted['yaw']!r}: must be within 90 degrees (pi/2)")
        center = finite("rail center", wanted.get("center", (0.0, 0.0)))
        if center.shape != (2,) or np.abs(center).max() > 0.5 * side:
            raise ValueError(f"rail center={shown(wanted['center'])}: must be two numbers within {0.5 * side:g} m of the origin")

    def draw_rail(self, env: int, rng: np.random.Generator, wanted: Mapping[str, Any]) -> None:
        """Draw the rail of an environment's episode, of which some properties may be wanted, and write it into its record."""
        side, own = self.physics.side, self.episode[env]
        height, center, yaw = side * rng.uniform(*HEIGHTS), side * rng.uniform(-SPREAD, SPREAD, 2), rng.uniform(-TURN, TURN)
        x, y = wanted.get("center", center)
        yaw = float(wanted.get("yaw", yaw))
        own["rail"] = own["origin"] = x, y, wanted.get("height", height)
        own["turn"] = np.cos(yaw), np.sin(yaw)

    def camera(self) -> Camera:
        from clothgym.render import Camera  # imported here: training draws nothing

        far = self.physics.side / 0.6
        return Camera(eye=(0.8 * far, -2.0 * far, 1.0 * far), target=(0.0, -0.15 * far, 0.36 * far), vertical_fov=37.0)

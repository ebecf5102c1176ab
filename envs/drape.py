"""ClothDrape-v0: lay a hanging sheet over a target, let go, and be judged when it has settled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel
from clothgym.collisions import Plane
from clothgym.envs.episode import Fields
from clothgym.envs.measures import CENTROID, SPEED2, covered_share, key_particles, soft_coverage
from clothgym.envs.physics import Physics
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.targets import SHAPES, Target, placed, reference_coverage, unit_surface
from clothgym.envs.task import POSITION_BOUND, Task
from clothgym.envs.vector import ClothVectorEnv
from clothgym.material import Material
from clothgym.mesh import grid

if TYPE_CHECKING:
    from clothgym.render import Camera, Solid

SIDE = 0.6  # L [m]
ROWS = 17
SHEET = grid(ROWS, ROWS, SIDE, SIDE)

FRICTION = 0.5
THICKNESS = 0.002  # [m]: the cloth rests this far above the solid, so that its flat triangles stay outside of a round one
JUDGED_POINTS = 256
GUIDE_POINTS = 32
COVERED_WITHIN = 0.02  # in sides
GUIDE_REACH = 0.15 * SIDE
CENTRING_SCALE = 0.2  # in sides: performance is halved at this distance
CALM_SCALE = 0.1  # [m/s]: performance is halved at this rms speed
ENOUGH_COVERAGE, ENOUGH_CENTRING, ENOUGH_REST = 0.9, 0.1, 0.05

# the scripted expert's ways, in sides: how far beyond the target, above it on the way and below its top at the end
EXPERT_BEYOND, EXPERT_LIFT, EXPERT_DROP = 0.25, 0.55, 0.25
EXPERT_SPEED = 0.8  # share of the anchors' speed limit

LETS_GO = 0.8  # an action above this opens the anchor: chance seldom lets go before the agent has seen why it should hold


BOX = SHAPES.index("box")


# --- a step of one environment, see ``stepping`` ------------------------------------------------------------------------------


@inlined
def _let_go(own, rules, sheet, move, free):
    """Open the anchors that the action opens, or all when time is up."""
    for k in range(free.shape[0]):
        if sheet.holds[k] > 0 and (move[k, 3] > LETS_GO or own.step >= rules.acting_steps):
            free[k], sheet.holds[k] = 1, 0


@inlined
def _holds_nothing(own, rules, sheet):
    for k in range(sheet.holds.shape[0]):
        if sheet.holds[k] > 0:
            return False
    return True


@inlined
def _surface_of(own, units):
    """Points of the target's upper surface, as ``place_points`` takes them; units: those of a round one and of a box."""
    return units[1 if own.solid == BOX else 0], own.top, own.radius, own.turn


@kernel
def _nearness(x, surface, reach):
    points = placed(*surface)
    return soft_coverage(x, points, reach)


@kernel
def _coverage(x, triangles, surface, tolerance):
    points = placed(*surface)
    return covered_share(x, triangles, points, tolerance)


@inlined
def _off_center(own, rules, sheet):
    """Horizontal distance of the sheet's centre of area from the target's axis, in sides."""
    x, y = sheet.summary[CENTROID] - own.top[0], sheet.summary[CENTROID + 1] - own.top[1]
    return np.sqrt(x * x + y * y) / rules.side


@inlined
def _centring(off_center):
    """1 in the centre, 1/2 at CENTRING_SCALE sides: smooth, and with a gradient from afar."""
    return 1 / (1 + (off_center / CENTRING_SCALE) ** 2)


@inlined
def covering(own, rules, sheet):
    """How near the sheet is to the target's upper surface, and how central, in [0, 1]."""
    near = _nearness(sheet.x, _surface_of(own, rules.guides), rules.guide_reach)
    return (near + _centring(_off_center(own, rules, sheet))) / 2


@inlined
def _judge(own, rules, sheet, info):
    surface = _surface_of(own, rules.judged)
    info.coverage = _coverage(sheet.x, sheet.mesh.triangles, surface, COVERED_WITHIN * rules.side)
    info.off_center = _off_center(own, rules, sheet)
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    share = info.coverage / own.reference
    central, calm = info.off_center <= ENOUGH_CENTRING, info.rms_speed < ENOUGH_REST
    info.is_success = share >= ENOUGH_COVERAGE and central and calm
    return min(share, 1.0) * _centring(info.off_center) / (1 + (info.rms_speed / CALM_SCALE) ** 2)


@inlined
def _account(own, rules, sheet, info, terms, running, failure):
    info.coverage_reference = own.reference
    return 0.0


@inlined
def observe_target(own, rules, sheet, seen):
    for c in range(3):
        seen.center[c] = (sheet.summary[CENTROID + c] - own.top[c]) / rules.side
    for k in range(sheet.holds.shape[0]):
        seen.holds[k] = sheet.holds[k] > 0
    for k in range(len(SHAPES)):
        seen.solid[k] = own.solid == k
    seen.radius, seen.height, seen.yaw = own.radius / rules.side, own.top[2] / rules.side, own.yaw * (4 / np.pi)
    seen.settling = own.settling_since >= 0
    seen.episode_left = 1 - own.step / (rules.acting_steps + rules.settling_steps)
    seen.acting_left = max(rules.acting_steps - own.step, 0) / rules.acting_steps


class DrapeTask(Task):
    """The task of ``ClothDrape-v0``, see ``ClothDrapeEnv``."""

    physics = Physics(
        mesh=SHEET,
        material=Material.preset("cotton", air_drag=0.72),
        time_step=1 / 30,
        integrator="semi_implicit_euler",
        substeps=50,
        hand_speed=1.0,
        anchors=(SHEET.corners[2], SHEET.corners[3]),
        air_density=0.0,
    )
    kernels = Kernels(covering, _judge, observe_target, act=_let_go, done=_holds_nothing, account=_account)
    acting_steps = 60
    settling_steps = 40
    hand_actions = 4
    guide_reach: ClassVar[float] = GUIDE_REACH
    key_particles = key_particles(SHEET)
    judgement = (("coverage", float), ("coverage_reference", float), ("off_center", float), ("rms_speed", float))
    reset_options: ClassVar[tuple[str, ...]] = ("material", "target")

    def _colliders(self) -> list:
        floor = Plane(friction=FRICTION, thickness=THICKNESS)
        return [floor, Target("sphere", 0.25 * SIDE, 0.5 * SIDE, (0.0, 0.0)).collider(FRICTION, THICKNESS)]

    def _arena(self) -> tuple[NDArray, NDArray]:
        return np.array([-1.2, -1.2, 0.01]), np.array([1.2, 1.2, 1.2])

    def _remembers(self) -> Fields:
        # of the target: its place in SHAPES, its size, its highest point [m], how it is turned, and the most that can be covered
        target = [("solid", np.int64), ("radius", float), ("top", float, 3), ("yaw", float), ("turn", float, 2)]
        return [*target, ("reference", float)]

    def _figures(self) -> dict[str, Any]:
        guides, judged = (
            np.stack([np.resize(unit_surface(shape, count), (count, 3)) for shape in ("sphere", "box")])
            for count in (GUIDE_POINTS, JUDGED_POINTS)
        )
        return {"guide_reach": np.float32(self.guide_reach), "guides": guides, "judged": judged}

    def _observes(self) -> Fields:
        what = [("center", POSITION_BOUND, 3), ("holds", 1.0, self.num_hands), ("solid", 1.0, len(SHAPES))]
        return what + [(name, 1.0) for name in ("radius", "height", "yaw", "settling", "episode_left", "acting_left")]

    # --- reset ----------------------------------------------------------------------------------------------------------

    def _begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        target = self._draw_target(rng, options.get("target", {}))
        distance = SIDE * float(rng.uniform(0.75, 0.9))
        sideways = SIDE * float(rng.uniform(-0.1, 0.1))
        clearance = SIDE * float(rng.uniform(0.1, 0.25))
        ripple = rng.normal(scale=1e-3, size=SHEET.num_particles)
        self._place_target(env, target)
        # the sheet hangs in a plane across the way to the target, its held edge up
        rest = SHEET.rest_positions
        x = target.center[0] + sideways + rest[:, 0]
        y = target.center[1] - distance + ripple
        z = clearance + SIDE / 2 + rest[:, 1]
        return np.stack([x, y, z], axis=1)

    @staticmethod
    def _draw_target(rng: np.random.Generator, wanted: Mapping[str, Any]) -> Target:
        known = ("shape", "radius", "height", "center", "yaw")
        if not isinstance(wanted, Mapping):
            raise ValueError(f"reset option target={wanted!r}: must be a dict with any of {', '.join(known)}")
        unknown = set(wanted) - set(known)
        if unknown:
            raise ValueError(f"unknown key {sorted(unknown)[0]!r} of the reset option 'target' (there are: {', '.join(known)})")
        return Target.draw(rng, SIDE, 0.25 * SIDE, wanted.get("shape")).changed(wanted)

    def _place_target(self, env: int, target: Target) -> None:
        own = self.episode[env]
        own["solid"], own["radius"], own["yaw"] = SHAPES.index(target.shape), target.radius, target.yaw
        own["top"] = own["origin"] = target.top
        own["turn"] = np.cos(target.yaw), np.sin(target.yaw)
        own["reference"] = reference_coverage(target, SIDE)

    @property
    def targets(self) -> list[Target]:
        """Those of the episodes."""
        return [self._target(env) for env in range(self.num_envs)]

    def _target(self, env: int) -> Target:
        own = self.episode[env]
        *center, height = own["top"].tolist()
        return Target(SHAPES[int(own["solid"])], float(own["radius"]), height, tuple(center), float(own["yaw"]))

    def _furnish(self, envs: NDArray) -> None:
        self.simulation.set_collider(1, [self._target(env).collider(FRICTION, THICKNESS) for env in envs], envs)

    # --- expert and picture ---------------------------------------------------------------------------------------------

    def expert_actions(self) -> NDArray:
        """Over the target in one straight line, beyond it by a quarter of a side, down, and let go.

        Without memory: where the anchors are says which of the two ways they are on.
        """
        tops = self.episode["top"]
        middle = self.episode["targets"].mean(axis=1)
        beyond = tops[:, 1] + EXPERT_BEYOND * SIDE
        arrived = np.abs(middle[:, 1] - beyond) < 0.02
        low = np.maximum(tops[:, 2] - EXPERT_DROP * SIDE, 0.02)
        goal = np.stack([tops[:, 0], beyond, np.where(arrived, low, tops[:, 2] + EXPERT_LIFT * SIDE)], axis=1)
        # half of the way in each step, as far as the speed goes
        move = (goal - middle) / (2 * self.physics.time_step * self.physics.hand_speed)
        length = np.sqrt(move[:, 0] ** 2 + move[:, 1] ** 2 + move[:, 2] ** 2)
        move *= np.minimum(1, EXPERT_SPEED / np.maximum(length, 1e-9))[:, None]
        release = arrived & (np.abs(middle[:, 2] - low) < 0.02)
        actions = np.empty((self.num_envs, self.num_hands, 4))
        actions[:, :, :3] = move[:, None]
        actions[:, :, 3] = np.where(release, 1.0, -1.0)[:, None]
        return actions.reshape(self.num_envs, -1)

    def solids(self, env: int) -> list[Solid]:
        return [self._target(env).solid()]

    def camera(self) -> Camera:
        from clothgym.render import Camera  # imported here: training draws nothing

        return Camera(eye=(1.6, -1.3, 1.05), target=(0.0, -0.19, 0.27), vertical_fov=33.0)


class ClothDrapeEnv(ClothEnv):
    """Lay a hanging sheet over a target and let go of it.

    ## Description
    A square cotton sheet of side L = 0.6 m (17 x 17 particles) hangs from two held corners, 0.75 to 0.9 L in front of a target
    that stands on the floor: a sphere (radius 0.2 to 0.3 L), a box (side 0.3 to 0.5 L) or a round-topped post (radius 0.1 to
    0.15 L, height 0.4 to 0.6 L).  The agent moves both corners and may let go of each.  When it holds none, or after 60
    steps, the sheet settles for 40 steps, in which actions are ignored; then it is judged.

    The id fixes the physics: 30 Hz control, ``semi_implicit_euler`` with 50 substeps, friction 0.5, linear air drag.
    (Settling takes 40 steps, not fewer, because the corners that hang from a thin post swing for more than a second.)

    ## Action Space
    ``Box(-1, 1, (8,))``; for each corner:

    | Num | Action | Range | Unit |
    | --- | --- | --- | --- |
    | 0-2, 4-6 | velocity x, y, z, scaled by 1 m/s; a vector longer than 1 is shortened | [-1, 1] | m/s |
    | 3, 7 | let go for good, if above 0.8 | [-1, 1] | |

    ## Observation Space
    ``Box`` of 68 numbers for ``obs_mode="keypoints"`` (and 6 x 289 + 14 for ``"particles"``, all particles row by row):

    | Num | Observation | Bound |
    | --- | --- | --- |
    | 0-26 | 3 x 3 points of the sheet (corners, edge middles, centre) relative to the target's top, in L | 4 |
    | 27-53 | their velocities [m/s] | 5 |
    | 54-56 | centre of area relative to the target's top, in L | 4 |
    | 57-58 | whether each corner is held | 1 |
    | 59-61 | sphere, box, post | 1 |
    | 62-64 | target's radius or half side and height, in L; its yaw over 45 degrees | 1 |
    | 65-67 | settling; share of the episode left; share of the acting time left | 1 |

    ## Rewards
    ``reward_mode="delta"``: the change of a potential in [0, 1], less ``0.001 |a|^2`` for the motion and 0.5 for a failure,
    plus 0.25 for a success.
    While the episode runs the potential is the mean of how near the sheet is to 32 points of the target's upper surface,
    ``1/(1 + (d/0.15 L)^2)``, and of how central its centre of area is, ``1/(1 + (e/0.2 L)^2)``.  At the end it is the
    normalised performance, at a failure 0: the return is the score, less the start's potential and the small terms.
    ``reward_mode="sparse"``: the normalised performance, at the judgement.

    ## Judgement
    Coverage C is the share of 256 points, spread evenly over that part of the target's surface which slopes by at most 60
    degrees, that lie within 0.02 L of a triangle of the sheet; C_ref is that of a fine (49 x 49) sheet let down flat and
    centred on the same target (``benchmarks/drape_reference.py``); e is the horizontal distance of the sheet's centre of area
    from the target's axis.

    ``info["normalized_performance"]`` = min(C / C_ref, 1) / (1 + (e / 0.2 L)^2) / (1 + (v / 0.1 m/s)^2), with the rms speed v:
    0 for a sheet that does not touch the target's top, 1 for the fine sheet's coverage, dead centre and at rest.
    ``info["is_success"]``: C >= 0.9 C_ref, e <= 0.1 L and v under 0.05 m/s.  ``info`` also has ``coverage``,
    ``coverage_reference``, ``off_center`` (e / L), ``rms_speed`` [m/s], ``strain_max``, ``strain_before_limiting``, ``settling``,
    ``failure`` and ``reward_terms``.  What belongs to the judgement is 0 until then.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.1 L to the side, with a ripple of a
    millimetre; the target's axis is within 0.25 L of the origin; a box is turned by up to 45 degrees.

    ## Episode End
    Terminated when judged, or at a failure, named by ``info["failure"]``: "torn" (a structural spring at twice its rest length),
    "out_of_bounds" (the sheet's centre 0.5 m beyond the arena of 2.4 m), "diverged" (not finite; the last finite observation
    goes out).  Never truncated: the time limit is part of the task.

    ## Arguments
    | Argument | Default | Meaning |
    | --- | --- | --- |
    | ``integrator`` | ``"semi_implicit_euler"`` | or another, by name or ``{"name": ..., option: ...}``, with automatic substeps |
    | ``bending`` | ``"springs"`` | or ``"hinge"`` or ``"quadratic"``, see ``clothgym.bending`` |
    | ``strain_limit`` | ``None`` | largest strain, kept by a limiter; ``info["strain_before_limiting"]`` is what it met |
    | ``self_collision`` | ``False`` | or ``"fast"``, ``"strict"``; then ``info`` has ``self_contacts``, ``hand_lag`` and more |
    | ``substeps`` | 50 | or ``"auto"`` |
    | ``obs_mode`` | ``"keypoints"`` | or ``"particles"`` |
    | ``reward_mode`` | ``"delta"`` | or ``"sparse"`` |
    | ``randomize`` | ``{}`` | ranges of material figures drawn at reset, ``{"density": [0.1, 0.2]}`` |
    | ``wind`` | ``None`` | what ``clothgym.Wind`` takes, ``{"speed": [0, 2], "gust": 0.5}``: adds drag and lift per triangle |
    | ``threads`` | 1; in a batch all processors | the outcome does not depend on it |
    | ``render_mode`` | ``None`` | ``"rgb_array"``, ``"depth_array"``, or ``"human"`` through ``gym.make`` (extra ``human``) |
    | ``render_color`` | ``"fabric"`` | or ``"strain"``: cream where no thread is stretched, violet from 5 % on |

    ``reset(options=...)`` takes ``"target"``, a dict with any of ``shape``, ``radius``, ``height``, ``center``, ``yaw`` (the
    rest is drawn), and ``"material"``, a dict of figures for one episode.

    ## Vectorized environment
    ``gym.make_vec("clothgym:ClothDrape-v0", num_envs=256)``; environment ``i`` seeded ``s`` equals a single one seeded
    ``s + i``, bit for bit.

    ## Version History
    * v0: initial version
    """

    task_class = DrapeTask


class ClothDrapeVectorEnv(ClothVectorEnv):
    """``ClothDrape-v0`` as a batch, see ``ClothDrapeEnv``."""

    task_class = DrapeTask

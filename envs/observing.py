"""What ``reset`` and ``step`` return: the state vector of a task, or pictures of it, which are drawn when they are asked for.

The state vector is ``Task.observation``, part of what ``get_state`` remembers.  Pictures follow from the state: an environment
whose state has changed is ``stale`` until it is drawn.  One that is over keeps its last picture, one that diverges the one before;
from a restored state it is drawn as its sheet is then, and a sheet that is not finite not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym import _jit
from clothgym.checks import count, flag, shown
from clothgym.collisions.solids.shapes import KIND_MESH, R_HALF, R_POINT, R_RADIUS, R_THICKNESS
from clothgym.envs.episode import DIVERGED
from clothgym.mesh import SHEAR, ClothMesh

if TYPE_CHECKING:
    from clothgym.envs.task import Task
    from clothgym.render import Camera

POSITION_BOUND, VELOCITY_BOUND = 4.0, 5.0  # of observed points, in sides unless a task says otherwise, and in m/s
PICTURES = ("heightmap", "pointcloud", "rgb", "depth", "rgbd")
CAMERA = ("rgb", "depth", "rgbd", "pointcloud")  # of these the modes that a camera takes
LARGEST_PICTURE, MOST_POINTS = 1024, 100_000
FAR = 2.0  # depths end at so many distances of the camera from its target
DISTANCE = 3.0  # of the camera straight above the working area, in halves of its side; then it sees 37 degrees
HIGHEST = 2.0  # heights end so many sides above the arena
PICTURES_A_THREAD = 4  # fewer are not worth another thread


class Observation(NamedTuple):
    """An observation in addition to the points of the sheet: a number, or an array of numbers.

    name: its key in ``observation_slices``.  about, unit: for the page; "L" is the sheet's longer side.  shape: of the array.
    bound: largest magnitude, one for all or one for each number along the last axis.  function: its values from the task,
    (num_envs, ...); without one they are the field of ``Task.episode`` of that name, or written by the task's kernel ``observe``.
    turns: so many vectors, x, y and z, are the first numbers along the last axis, see ``framing``.
    """

    name: str
    about: str
    shape: tuple[int, ...] = ()
    unit: str = ""
    bound: float | tuple[float, ...] = 1.0
    function: Callable[[Any], NDArray] | None = None
    turns: int = 0


class View(NamedTuple):
    """Where films see a task from, as ``render.Camera`` takes it; scales_from: the side for which it is, if it scales [m]."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    vertical_fov: float
    scales_from: float | None = None


def points_observed(task: Task | type[Task], obs_mode: str, count: int) -> list[Observation]:
    """The observations of this number of points of the sheet, "particles" or "keypoints": their positions and velocities."""
    what = task.key_points if obs_mode == "keypoints" else "all particles, row by row"
    return [
        Observation(obs_mode, f"{what}, relative to {task.points_relative_to}", (count, 3), "L", task.position_bound),
        Observation("velocities", "their velocities", (count, 3), "m/s", VELOCITY_BOUND),
    ]


class StateVector:
    """Where each number of a task's state vector lies, and its bound.

    Attributes:
        particles: those that are observed.
        slices: where each observation lies, by its name.
        bound: largest magnitude of each number, float32.
    """

    def __init__(self, task: Task, mode: str) -> None:
        mesh = task.physics.mesh
        self.particles = np.arange(mesh.num_particles) if mode == "particles" else task.observed_particles(mesh)
        declared = [*points_observed(task, mode, len(self.particles)), *task.observations]
        ends = np.cumsum([int(np.prod(one.shape)) for one in declared]).tolist()
        self.slices = {one.name: slice(first, end) for one, first, end in zip(declared, [0, *ends], ends)}
        if len(self.slices) < len(declared):
            raise TypeError(f"{type(task).__name__}.observations: two have the same name, in {[one.name for one in declared]}")
        self.bound = np.concatenate([np.broadcast_to(one.bound, one.shape).ravel() for one in declared]).astype(np.float32)


def mesh_edges(mesh: ClothMesh) -> NDArray[np.int64]:
    """The structural springs' particles, (edges, 2): the yarns of a grid, or the edges of a triangle mesh; for graph networks."""
    return mesh.springs.particles[mesh.springs.kind < SHEAR].astype(np.int64)


class Observer:
    """The observations that a task returns.

    Args:
        mode: "keypoints" or "particles", the state vector; or one of ``PICTURES``.
        image_size: pixels of a square picture's side.
        camera: of ``CAMERA`` modes: None, straight down on the working area; "task"; or what ``clothgym.render.Camera`` takes.
        num_points: of a point cloud.
        privileged: whether a picture comes with the state vector.

    Attributes:
        space: of one environment.
        pictures: the last ones, (num_envs, ...), or None.
        stale: environments whose picture is older than their state, (num_envs,).

    Raises:
        ValueError: a keyword that is out of range, or says nothing in this mode.
    """

    def __init__(self, task: Task, mode: str, image_size: int, camera: Any, num_points: int, privileged: bool) -> None:
        self.task, self.mode, self.privileged = task, mode, flag("privileged", privileged)
        size = count("image_size", image_size, most=LARGEST_PICTURE)
        points = count("num_points", num_points, most=MOST_POINTS)
        if camera is not None and mode not in CAMERA:
            raise ValueError(f"camera={shown(camera)}: obs_mode={mode!r} takes none; it is for {', '.join(CAMERA)}")
        if self.privileged and mode not in PICTURES:
            raise ValueError(f"privileged=True: obs_mode={mode!r} is the state already; it is for {', '.join(PICTURES)}")
        self.pictures: NDArray | None = None
        self.stale = np.zeros(task.num_envs, bool)
        # goals are the last numbers of the state vector
        self._goals = {name: task.observation_slices[name] for name in task.goals}
        self._own = slice(0, min((one.start for one in self._goals.values()), default=None))
        own = _part(task.state_space, self._own)
        if mode in PICTURES:
            own = self._prepare(size, camera, points)
            self.pictures = np.zeros((task.num_envs, *own.shape), own.dtype)
        parts = {"observation": own} | ({"state": task.state_space} if self.privileged else {})
        parts |= {name: _part(task.state_space, where) for name, where in self._goals.items()}
        self.space: gym.Space = gym.spaces.Dict(parts) if len(parts) > 1 else own  # type: ignore[arg-type]

    def _prepare(self, size: int, camera: Any, points: int) -> gym.spaces.Box:
        """Where the scene is seen from, and what kernels need of it; returns the space of a picture."""
        from clothgym.envs.views import DrawnViews  # imported here, as all that draws: who observes the state draws nothing
        from clothgym.render import quick, quick_solids

        task, mode = self.task, self.mode
        middle, half = task.working_area()
        kinds = {"heightmap": quick.HEIGHTS, "pointcloud": quick.POINTS, "rgb": quick.RGB, "depth": quick.DEPTH}
        self._kind = kinds.get(mode, quick.RGBD)
        colliders = task.simulation.colliders
        self._drawn_by_task = has_own(task, "solids")
        seen = [] if self._drawn_by_task else colliders
        self._shapes = np.array([quick_solids.shape_of(one) for one in seen], np.int64)
        meshes = [one.surface if one.kind == KIND_MESH else None for one in seen]  # type: ignore[attr-defined]
        self._surfaces = quick.surfaces_of(task.physics.mesh.triangles, meshes)
        side = task.physics.side
        if mode == "heightmap":
            self._views = DrawnViews(task, None, size, quick.straight_down(middle, half, size))
            self._bound = float(np.float32(task.arena()[1][2] / side + HIGHEST))
            return gym.spaces.Box(0.0, self._bound, (size, size), np.float32)
        chosen = checked_camera(task, camera)
        self._views = DrawnViews(task, chosen, size, quick.sight_of(chosen, size))
        if mode == "pointcloud":
            self._bound = float(task.position_bound)
            return gym.spaces.Box(-self._bound, self._bound, (points, 3), np.float32)
        self._bound = float(np.float32(FAR * chosen.distance))
        if mode == "depth":
            return gym.spaces.Box(0.0, self._bound, (size, size, 1), np.float32)
        if mode == "rgb":
            return gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        high = np.broadcast_to(np.array([1, 1, 1, self._bound], np.float32), (size, size, 4))
        return gym.spaces.Box(np.zeros_like(high), high, dtype=np.float32)

    # --- what has changed -----------------------------------------------------------------------------------------------

    def begun(self, envs: NDArray) -> None:
        """These environments have a new state."""
        self.stale[envs] = self.pictures is not None

    def stepped(self, envs: NDArray) -> None:
        """Those of these environments that were not over before it have made a step."""
        if self.pictures is None:
            return
        over, outcome = self.task.episode["over"], self.task.outcome
        self.stale[envs] |= ((~over | outcome["terminated"]) & (outcome["failure"] != DIVERGED))[envs]
        # what goes on after an episode's end is not observed
        self._draw(np.flatnonzero(self.stale & over))

    # --- returned observations ------------------------------------------------------------------------------------------

    def batch(self) -> Any:
        """The observations of all environments, a fresh copy."""
        self._draw(np.flatnonzero(self.stale))
        return self._given(slice(None))

    def one(self, env: int) -> Any:
        """The same of one environment."""
        if self.stale[env]:
            self._draw(np.array([env]))
        return self._given(env)

    def _given(self, which: int | slice) -> Any:
        """Picture or state vector, and what goes with it."""
        state = self.task.returned(self.task.observation[which], which)
        own = (state[..., self._own] if self.pictures is None else self.pictures[which]).copy()
        if not self._goals and not self.privileged:
            return own
        given = {"observation": own} | ({"state": state.copy()} if self.privileged else {})
        return given | {name: state[..., where].copy() for name, where in self._goals.items()}

    # --- pictures -------------------------------------------------------------------------------------------------------

    def _draw(self, envs: NDArray) -> None:
        """Draw environments as they are now."""
        if not len(envs):
            return
        from clothgym.render.quick import draw_pictures

        task, pictures = self.task, self.pictures
        assert pictures is not None
        things = self._things(envs)
        flat = pictures.reshape(task.num_envs, -1)
        out = (flat, _NO_NUMBERS) if pictures.dtype == np.uint8 else (_NO_COLORS, flat)
        places = task.simulation.layout.at(envs)
        measure = np.ascontiguousarray(task.episode["origin"]), float(task.rules["per_side"][0]), self._bound
        x, views = task.simulation.view.x, self._views.of(envs)

        def work(first: int, last: int) -> None:
            draw_pictures(first, last, self._kind, envs, places, x, self._surfaces, things, views, measure, out)

        _jit.run_spans(work, len(envs), min(task.threads, max(1, len(envs) // PICTURES_A_THREAD)))
        self.stale[envs] = False

    def _things(self, envs: NDArray) -> tuple[NDArray, NDArray]:
        """Shapes and rows of solids and markers of environments, see ``quick_solids``; a height map has no markers."""
        from clothgym.render import quick_solids

        task = self.task
        if self._drawn_by_task:
            parts = [quick_solids.solid_rows([task.solids(env) for env in envs.tolist()])]
            shapes = [np.ones(parts[0].shape[1], np.int64)]
        else:
            parts, shapes = [self._solids(envs)], [self._shapes]
        if self.mode in ("rgb", "depth", "rgbd"):
            parts.append(marks(task, envs))
            shapes.append(np.ones(parts[1].shape[1], np.int64))
        return np.concatenate(shapes), np.concatenate(parts, axis=1)

    def _solids(self, envs: NDArray) -> NDArray:
        """The simulation's own solids, where they are now, without the thickness that contact keeps."""
        from clothgym.render import quick_solids
        from clothgym.render.solids import WARM_GRAY

        simulation = self.task.simulation
        block, lane = simulation.layout.at(envs)
        own = simulation._solids.rows[block, :, :, lane].astype(np.float64)
        solids = np.empty((*own.shape[:2], quick_solids.SOLID_ROWS))
        # a point, axes and half sides come first in both
        solids[..., : quick_solids.RADIUS] = own[..., R_POINT : R_HALF + 3]
        solids[..., quick_solids.RADIUS] = np.maximum(own[..., R_RADIUS] - own[..., R_THICKNESS], 0)
        solids[..., quick_solids.COLOR :] = WARM_GRAY
        return solids


def _part(space: gym.spaces.Box, where: slice) -> gym.spaces.Box:
    """Of a space of numbers."""
    return gym.spaces.Box(space.low[where], space.high[where], dtype=np.float32)


_NO_COLORS, _NO_NUMBERS = np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.float32)


def has_own(task: Task, hook: str) -> bool:
    """Whether a task gives a method that ``Task`` has a default of."""
    from clothgym.envs.task import Task

    return getattr(type(task), hook) is not getattr(Task, hook)


def marks(task: Task, envs: NDArray) -> NDArray:
    """What ``markers`` draws of environments, as rows of ``quick_solids``: by the task's own ``marks``, unless a class derived from
    the one that defines it has given ``markers`` in its place."""
    classes = type(task).__mro__
    first = {name: next(k for k, cls in enumerate(classes) if name in vars(cls)) for name in ("marks", "markers")}
    if first["marks"] <= first["markers"]:
        return task.marks(envs)
    from clothgym.render.quick_solids import solid_rows

    return solid_rows([task.markers(env) for env in envs.tolist()])


def checked_camera(task: Task, camera: Any) -> Camera:
    """Where pictures are taken from.

    Raises:
        ValueError: neither None, "task" nor what a ``Camera`` takes; or an eye that is not above the floor.
    """
    from clothgym.render import Camera

    if camera is None:
        middle, half = task.working_area()
        x, y = map(float, middle)
        height = max(DISTANCE * half, float(task.arena()[1][2]) + half)
        fov = float(np.degrees(2 * np.arctan(half / height)))
        return Camera(eye=(x, y, height), target=(x, y, 0.0), up=(0.0, 1.0, 0.0), vertical_fov=fov)
    if isinstance(camera, Mapping):
        try:
            chosen = Camera(**camera)
        except TypeError as error:
            raise ValueError(
                f"camera={shown(camera)}: must have eye and target, and may have up, vertical_fov, near ({error})"
            ) from None
    elif isinstance(camera, str) and camera == "task":
        chosen = task.camera()
    else:
        raise ValueError(f'camera={shown(camera)}: must be None, "task", or a dict with eye, target, up, vertical_fov, near')
    if not chosen.eye[2] > 0:
        raise ValueError(f"camera={shown(camera)}: its eye must be above the floor z = 0")
    return chosen

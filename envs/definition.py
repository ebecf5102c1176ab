"""What makes a task: the attributes and methods that one defines, each with its default.

``Task`` is the rest, which all tasks share.  A task in plain NumPy needs ``physics``, ``acting_steps``, ``performance`` and
``success``; most draw a start and a goal in ``begin``, keep the goal in a field that ``remembers`` names, and declare what is
observed of it in ``observations``.  A task that must be fast gives ``kernels`` in place of ``performance``, ``success``, ``done``
and ``after_step``, see ``stepping``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import shown
from clothgym.collisions import Collider, Plane
from clothgym.envs.episode import Fields
from clothgym.envs.measures import centers_of_area, key_particles
from clothgym.envs.physics import Physics
from clothgym.envs.stepping import IN_NUMPY, Kernels
from clothgym.mesh import ClothMesh
from clothgym.simulation import Simulation

if TYPE_CHECKING:
    from clothgym.render import Camera, Drawable

HELD = (250, 200, 60)  # color of the anchors' markers
POSITION_BOUND, VELOCITY_BOUND = 4.0, 5.0  # of observed points, in sides unless a task says otherwise, and in m/s


class Observation(NamedTuple):
    """What is observed beside the points of the sheet: a number, or an array of numbers.

    name: its key in ``observation_slices``.  about, unit: for the page; "L" is the sheet's longer side.  shape: of the array.
    bound: largest magnitude, one for all or one for each number along the last axis.  function: its values from the task,
    (num_envs, ...); without one they are the field of ``Task.episode`` of that name, or written by the task's kernel ``observe``.
    """

    name: str
    about: str
    shape: tuple[int, ...] = ()
    unit: str = ""
    bound: float | tuple[float, ...] = 1.0
    function: Callable[[Any], NDArray] | None = None


def time_left(task: TaskDefinition) -> NDArray:
    """Share of the episode that is left, (num_envs,)."""
    return 1 - task.episode["step"] / (task.acting_steps + task.settling_steps)


class TaskDefinition:
    """The attributes and methods that a task defines; the environment is the first axis of every array.

    Attributes:
        physics: the sheet, its fabric, what holds it, and how time is stepped.
        control_steps: control steps of a step, one unless an action says otherwise.
        acting_steps: control steps after which the agent's time is up.
        settling_steps: those that follow, in which actions are ignored.
        actions_per_attachment: numbers of an action for each attachment (anchor or gripper): a velocity, and what comes after it.
        observations: what is observed beside the points of the sheet, in that order.
        goals: names of the last of these, which are given apart, in a dictionary, as goal environments have it.
        key_points: what the observed points of the sheet are with obs_mode="keypoints", for the page.
        points_relative_to: what the observed points of the sheet are relative to, ``episode["origin"]``, for the page.
        position_bound: of these points, in sides.
        evaluation: fields of info that an evaluation writes, zero until then, beside performance and success.
        accounts: fields of info that each step writes.
        prices: names of the task's own reward terms.
        feels_pulls: whether its kernels must know how the sheet pulls at the attachments.
        reset_options: what ``reset(options=...)`` takes.
        arguments: meaning of the task's own keywords, for the page, and of those that mean something else than elsewhere.
        ranges: least and greatest value of the fields that episodes remember, for ``set_state``; of others any finite number does.
        strain_shown: where the colors of render_color="strain" end.
    """

    physics: ClassVar[Physics]
    acting_steps: ClassVar[int]
    settling_steps: ClassVar[int] = 0
    control_steps: int = 1
    actions_per_attachment: ClassVar[int] = 3
    kernels: ClassVar[Kernels] = IN_NUMPY
    obs_modes: ClassVar[tuple[str, ...]] = ("keypoints", "particles", "heightmap", "pointcloud", "rgb", "depth", "rgbd")
    observations: ClassVar[tuple[Observation, ...]] = (Observation("time_left", "share of the time left", function=time_left),)
    goals: ClassVar[tuple[str, ...]] = ()
    key_points: ClassVar[str] = "3 x 3 points of the sheet (corners, edge middles, center)"
    points_relative_to: ClassVar[str] = "the origin"
    position_bound: ClassVar[float] = POSITION_BOUND
    evaluation: ClassVar[Fields] = ()
    accounts: ClassVar[Fields] = ()
    prices: ClassVar[tuple[str, ...]] = ()
    feels_pulls: ClassVar[bool] = False
    reset_options: ClassVar[tuple[str, ...]] = ("material",)
    arguments: ClassVar[Mapping[str, str]] = {}
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    strain_shown: ClassVar[float] = 0.05

    # what ``Task`` keeps, and these methods read and write
    num_envs: int
    num_attachments: int
    simulation: Simulation
    episode: NDArray
    info: NDArray

    @property
    def step_seconds(self) -> float:
        """How long a step lasts in the simulation [s]."""
        return self.control_steps * self.physics.time_step

    # --- start ----------------------------------------------------------------------------------------------------------

    def check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse a reset's options that no episode can have, with a ValueError, before anything is changed."""

    def remembers(self) -> Fields:
        """Fields of ``episode`` beside those that all tasks have: what its episodes remember."""
        return ()

    def check_episode(self, env: int, own: Any) -> None:
        """Refuse a record of an episode, whose fields are within ``ranges``, that no episode can have, with a ValueError."""

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        """Draw one environment's episode into ``episode[env]``; returns the sheet's particles at the start [m], (particles, 3).

        By default the sheet lies flat about the origin, a centimeter above the floor.
        """
        return self.physics.mesh.rest_positions + (0.0, 0.0, 0.01)

    def colliders(self) -> list[Collider]:
        """The scene's solids; by default a floor."""
        return [Plane()]

    def episode_colliders(self, env: int) -> Mapping[int, Collider]:
        """Solids of one environment's episode, by their place among ``colliders``, which they replace; by default none."""
        return {}

    def place_attachments(self, envs: NDArray) -> None:
        """Put grippers where episodes begin with them; anchors hold their particles, and need nothing."""

    def arena(self) -> tuple[NDArray, NDArray]:
        """Lowest and highest corner of the room in which attachments move [m]; the sheet is out of bounds 0.5 m beyond it.

        By default it reaches two sides of the sheet from the origin in each direction, and down to a centimeter above the floor.
        """
        far = 2 * self.physics.side
        return np.array([-far, -far, 0.01]), np.array([far, far, far])

    def constants(self) -> dict[str, Any]:
        """Numbers and arrays that its kernels must know, the same for all environments: fields of ``rules``."""
        return {}

    # --- step -----------------------------------------------------------------------------------------------------------

    def before_step(self, actions: NDArray) -> None:
        """Before the physics of each step: what actions do beside moving the attachments, which know where to go already.

        actions: as they were given, (num_envs, numbers), finite.
        """

    def after_step(self) -> None:
        """After the physics of each step, before it is scored: what the task writes into ``episode`` and ``info``."""

    def performance(self) -> NDArray:
        """How far along each environment is, in [0, 1], (num_envs,): 0 for doing nothing, 1 for the ideal.

        Its change is the reward on the way, its value at the end the normalized performance.  No kernel needs it.
        """
        raise NotImplementedError

    def success(self) -> NDArray:
        """Whether an episode that ended now would be a success, (num_envs,).  No kernel needs it."""
        raise NotImplementedError

    def done(self) -> NDArray:
        """Whether the agent is done before its time is up, (num_envs,); by default it never is.  No kernel needs it."""
        return np.zeros(self.num_envs, bool)

    def centers(self) -> NDArray:
        """Each sheet's center of area [m], (num_envs, 3), with the same bits in a batch of any size."""
        return centers_of_area(self.physics.mesh, self.simulation.positions)

    def expert_actions(self) -> NDArray:
        """What a scripted expert does now, (num_envs, numbers); it sees the whole state.  By default it keeps still."""
        return np.zeros((self.num_envs, self.actions_per_attachment * self.num_attachments))

    def expert(self) -> NDArray:
        """The scripted expert's action as ``step`` takes it, (num_envs, numbers)."""
        return self.expert_actions()

    # --- picture --------------------------------------------------------------------------------------------------------

    @classmethod
    def observed_particles(cls, mesh: ClothMesh) -> NDArray:
        """The particles that are observed with ``obs_mode="keypoints"``."""
        return key_particles(mesh)

    def solids(self, env: int) -> list[Drawable]:
        """What the renderer draws beside the sheet and the floor: by default all solids but planes, where they are now."""
        from clothgym.render.solids import drawn  # imported here: training draws nothing

        colliders = dict(enumerate(self.simulation.colliders)) | dict(self.episode_colliders(env))
        places = self.simulation.collider_positions[env]
        return [drawn(one).at(places[k]) for k, one in colliders.items() if not isinstance(one, Plane)]

    def markers(self, env: int) -> list[Any]:
        """What is drawn and casts no shadow: by default what ``marks`` says."""
        from clothgym.render.quick_solids import drawables  # imported here: training draws nothing

        return drawables(self.marks(np.array([env]))[0])

    def marks(self, envs: NDArray) -> NDArray:
        """The same of many environments at once, as rows of ``render.quick_solids``, (len(envs), marks, SOLID_ROWS): by default the
        anchors that hold the sheet.  A task that gives ``markers`` in its place is drawn more slowly."""
        from clothgym.render.quick_solids import balls  # imported here: training draws nothing
        from clothgym.render.solids import MARKER_RADIUS

        attached = self.simulation.attached[envs]
        return balls(self.simulation.attachment_positions[envs, : attached.shape[1]], MARKER_RADIUS, HELD, attached)

    def working_area(self) -> tuple[NDArray, float]:
        """The square that pictures from above show, by default the arena's: its middle [m], (2,), and half of its side [m]."""
        low, high = self.arena()
        return (low[:2] + high[:2]) / 2, float(max(high[:2] - low[:2])) / 2

    def camera(self) -> Camera:
        """Where the scene is seen from; by default the whole arena from the front and right."""
        from clothgym.render import Camera  # imported here: training draws nothing

        low, high = self.arena()
        far = float(max(high - low))
        return Camera(eye=(0.7 * far, -0.6 * far, 0.45 * far), target=(0.0, 0.0, 0.15 * far), vertical_fov=40.0)


def points_observed(task: TaskDefinition | type[TaskDefinition], obs_mode: str, count: int) -> list[Observation]:
    """What is observed of so many points of the sheet, "particles" or "keypoints": where they are, and their velocities."""
    what = task.key_points if obs_mode == "keypoints" else "all particles, row by row"
    return [
        Observation(obs_mode, f"{what}, relative to {task.points_relative_to}", (count, 3), "L", task.position_bound),
        Observation("velocities", "their velocities", (count, 3), "m/s", VELOCITY_BOUND),
    ]


def check_definition(task: TaskDefinition, in_numpy: bool) -> None:
    """Refuse a task that lacks what every task must say, cannot be evaluated or has nothing to observe."""
    for name, kind, what in (("physics", Physics, "a Physics"), ("acting_steps", int, "a number of control steps")):
        if not isinstance(value := getattr(task, name, None), kind) or value == 0:
            raise TypeError(f"{type(task).__name__}.{name} is {shown(value)}: must be {what}")
    missing = [name for name in ("performance", "success") if getattr(type(task), name) is getattr(TaskDefinition, name)]
    if in_numpy and missing:
        raise TypeError(f"{type(task).__name__} does not define {' and '.join(missing)}(): a task without kernels needs both")
    if not task.observations:
        raise TypeError(f"{type(task).__name__}.observations is empty: declare at least one Observation")

"""A task, written once for a batch: what ``ClothEnv`` (a batch of one) and ``ClothVectorEnv`` (a batch of many) both run.

An episode: the agent moves its attachments (anchors or grippers) until it is done, at the latest until its time is up; then, in
the tasks that have it so, the sheet settles for a fixed number of steps, in which actions are ignored; then it is evaluated, which
terminates.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym import _jit, integrators
from clothgym.checks import count, not_negative, number, numbers, one_of, shown
from clothgym.collisions import Collider, Plane
from clothgym.envs import answers, hooks, randomization
from clothgym.envs.episode import Fields, TaskState, check_state, checked_seeds, generator_of, names_of, record_of, records
from clothgym.envs.generators import Generators
from clothgym.envs.measures import centers_of_area, key_particles
from clothgym.envs.observing import POSITION_BOUND, Observation, Observer, StateVector, View, has_own
from clothgym.envs.physics import (
    Physics,
    check_ranges,
    checked_material_option,
    checked_wind,
    chosen_fabric,
    most_demanding,
)  # fmt: skip
from clothgym.envs.settling import check as check_settling
from clothgym.envs.settling import restricted_to, settle
from clothgym.envs.stepping import IN_NUMPY, Kernels, compiled, mesh_arrays
from clothgym.exclusive import CallGuard, exclusive
from clothgym.guards import refuse_sizes
from clothgym.material import Material
from clothgym.mesh import ClothMesh
from clothgym.parameters import AIR_DENSITY, PROPERTIES, of_material
from clothgym.simulation import Simulation

if TYPE_CHECKING:
    from clothgym.render import Camera, Drawable

HELD = (250, 200, 60)  # color of the anchors' markers
REWARD_MODES = ("delta", "sparse")
ROUNDING = 1e-6  # by which a share may leave [0, 1]
ENVS_A_THREAD = 16  # fewer are not worth another thread


def _time_left(task: Task) -> NDArray:
    """Share of the episode that is left, (num_envs,)."""
    return 1 - task.episode["step"] / (task.acting_steps + task.settling_steps)


# options of ``reset`` of all tasks, as their manual pages describe them
OPTIONS = {
    "material": "a preset's name or a dict of properties",
    "target": "a dict with any of ``shape``, ``radius``, ``height``, ``center``, ``yaw``",
    "rail": "a dict with any of ``height`` (of its axis) [m], ``center`` [m], ``yaw`` [rad]",
    "hook": "a dict with any of ``height`` (of the arm's root) [m], ``center`` (of the post) [m], ``yaw`` [rad]",
    "rumpled": "True or False",
    "goal": "three coordinates [m]",
}


class Task:
    """Base of all tasks; the environment is the first axis of every array.

    A task defines the first attributes and methods below, which have defaults.  A task in plain NumPy needs ``physics``,
    ``acting_steps``, ``performance`` and ``success``; most tasks draw a start and a goal in ``begin``, keep the goal in a field
    that ``remembers`` names, and declare its observations in ``observations``.  A task that must be fast defines ``kernels`` in
    place of ``performance``, ``success``, ``done`` and ``after_step``, see ``stepping``.

    Args:
        num_envs: environments in the batch.
        rows, side: particles along a side of the sheet, and its length [m]; other values than the task's imply automatic substeps.
        fabric: another fabric than the task's own, a ``Material`` or a preset's name; substeps are then chosen automatically.
        integrator: another integrator than the task's own; its substeps are then chosen automatically.
        substeps: substeps of a control step, or "auto"; the task's own number by default.
        physics: "true", or "fast", with simplifications, see ``Physics.chosen``.
        bending, strain_limit, self_collision, contact, air_density: as ``Simulation`` takes them; they override ``physics``.
        obs_mode, image_size, camera, num_points, privileged: kind of the returned observations, see ``Observer``.
        reward_mode: "delta" (change of the performance, see the task's page) or "sparse" (only the evaluation).
        action_repeat: control steps for which an action is held; their rewards, terms of rewards and costs are summed.  An episode
            that ends within them ends there.
        gamma: discount of the agent's steps to which the shaping is adapted: a step that does not end the episode gives
            ``gamma Phi' - Phi`` as the potential goes from Phi to Phi', so that no policy gains by it (Ng et al. 1999).
        randomize: ranges from which each episode draws material properties, the delay and noise of actions and observations, and
            the camera and colors of pictures, ``{"density": [0.1, 0.2], "action_delay": [0, 2]}``, see ``randomization``; what was
            drawn is in info.
        settling: "steps", or "at_once": the agent's last step continues until its sheet has settled and is evaluated.
        wind: arguments of ``clothgym.Wind``, ``{"speed": [0, 2], "gust": 0.5}``; None for the task's own air, ``{}`` for still air.
        threads: threads to use; all cores by default for a batch.

    Attributes:
        physics: the sheet, its fabric, its attachments, and the time integration.
        control_steps: control steps of a step.
        acting_steps: control steps after which the agent's time is up.
        settling_steps: following control steps, in which actions are ignored.
        actions_per_attachment: numbers of an action for each attachment (anchor or gripper): a velocity, and further numbers.
        observations: observations in addition to the points of the sheet, in that order.
        goals: names of the last of these, which goal environments return separately in a dictionary.
        key_points: description of the observed points of the sheet with obs_mode="keypoints", for the page.
        points_relative_to: description of the origin of observed points, ``episode["origin"]``, for the page.
        position_bound: of these points, in sides.
        evaluation: fields of info that an evaluation writes, zero until then, in addition to performance and success.
        accounts: fields of info that each step writes.
        prices: names of the task's own reward terms.
        feels_pulls: whether its kernels need the sheet's pulls on the attachments.
        reset_options: keys of ``reset(options=...)``.
        arguments: meaning of the task's own keywords, for the page, and of keywords with a different meaning in this task.
        ranges: least and greatest value of the fields of episodes, for ``set_state``; other fields may have any finite value.
        strain_shown: upper end of the colors of render_color="strain".
        resizes: whether episodes can draw the size of the sheet: its start and its measures follow ``sizes``, or ``Sheet.unit``.
        seen_from: camera position of films.
        simulation: the batch of sheets.
        sheet: rows and side as given.
        episode: records of the episodes' variables, (num_envs,): ``episode["step"]``, and the others of ``remembers``; with
            ``observation``, (num_envs, numbers), and ``air``, the wind of each step [m/s], (num_envs, steps, 3), part of the state.
        observation_slices: slice of each observation in ``observation[env]``, the state vector, by its name.
        state_bound: largest magnitude of each number in the state vector.
        disturbances: what ``randomize`` draws beside the fabric's properties.
        observed: the observations that ``reset`` and ``step`` return.
        rules: one record of numbers that all environments share.
        outcome, info, physical, terms: records of the results of the last step or reset, (num_envs,), see ``answers``.
        turn: one thread at a time is in the task; ``turn.unfinished`` are the environments that need a reset.

    Raises:
        ValueError: an unknown mode, property, fabric or integrator, or an invalid range; the message says what would do.
        TypeError: the task has neither kernels nor the methods that stand for them.
    """

    physics: ClassVar[Physics]
    acting_steps: ClassVar[int]
    settling_steps: ClassVar[int] = 0
    actions_per_attachment: ClassVar[int] = 3
    kernels: ClassVar[Kernels] = IN_NUMPY
    obs_modes: ClassVar[tuple[str, ...]] = ("keypoints", "particles", "heightmap", "pointcloud", "rgb", "depth", "rgbd")
    observations: ClassVar[tuple[Observation, ...]] = (Observation("time_left", "share of the time left", function=_time_left),)
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
    seen_from: ClassVar[View | None] = None
    resizes: ClassVar[bool] = False

    def __init__(
        self,
        num_envs: int,
        rows: int | None = None,
        side: float | None = None,
        fabric: str | Material | None = None,
        integrator: str | Mapping[str, Any] | None = None,
        substeps: int | str | None = None,
        physics: str = "true",
        bending: str | None = None,
        strain_limit: float | None = None,
        self_collision: bool | str | Mapping[str, Any] | None = None,
        contact: str | None = None,
        air_density: float | None = None,
        obs_mode: str = "keypoints",
        image_size: int = 64,
        camera: str | Mapping[str, Any] | None = None,
        num_points: int = 256,
        privileged: bool = False,
        reward_mode: str = "delta",
        settling: str = "steps",
        action_repeat: int = 1,
        gamma: float = 1.0,
        randomize: Mapping[str, Sequence[float]] | None = None,
        wind: Mapping[str, Any] | None = None,
        threads: int | None = None,
    ) -> None:
        one_of("obs_mode", obs_mode, *self.obs_modes)
        one_of("reward_mode", reward_mode, *REWARD_MODES)
        self.obs_mode, self.reward_mode, self.settling = obs_mode, reward_mode, settling
        self.control_steps = count("action_repeat", action_repeat)
        self.gamma = checked_gamma(gamma, reward_mode)
        self._in_numpy = self.kernels.potential is IN_NUMPY.potential
        check_definition(self, self._in_numpy)
        # the fabric, the air and how time is stepped: the task's own, or what the keywords say
        own, self.physics_name = self.physics.chosen(physics), physics
        sized, self.sheet = own.with_sheet(rows, side), (rows, side)
        fixed = self.physics = replace(sized, material=chosen_fabric(fabric, own.material))  # type: ignore[misc]
        self.randomize, self.disturbances = randomization.checked({} if randomize is None else randomize)
        self.disturbances.check_observed(obs_mode)
        self.wind = fixed.wind if wind is None else checked_wind(wind)
        if air_density is None:
            air_density = fixed.air_density if wind is None else AIR_DENSITY
        method = integrators.get(integrator if integrator is not None else fixed.integrator)
        check_ranges(fixed, self.randomize, method, self.disturbances.smallest)
        refuse_sizes(method, np.array(self.disturbances.ranges.get("size", (1.0,))))
        if substeps is None:
            as_tuned = method.name == fixed.integrator and fixed.material == own.material
            as_tuned &= not self.randomize and "size" not in self.disturbances.ranges
            substeps = fixed.substeps if as_tuned else "auto"
        self.simulation = Simulation(
            fixed.mesh,
            # substeps follow from the stiffest, lightest and smallest sheet that can be drawn, not from one that was
            material=most_demanding(fixed.material, self.randomize),
            size=self.disturbances.smallest,
            num_envs=num_envs,
            integrator=method,
            time_step=fixed.time_step,
            substeps=substeps,  # type: ignore[arg-type]
            colliders=hooks.colliders(self),
            contact=fixed.contact if contact is None else contact,
            air_density=not_negative("air_density", air_density),
            anchors=fixed.held,
            anchor_speed=2 * fixed.attachment_speed,
            grippers=fixed.grippers,
            bending=fixed.bending if bending is None else bending,
            strain_limit=strain_limit,
            self_collision=fixed.self_collision if self_collision is None else self_collision,
            threads=threads,
            on_divergence="ignore",  # a step's outcome says so
        )
        check_settling(self)
        if "size" in self.disturbances.ranges and not self.resizes:
            raise ValueError("randomize: no size in this task: its start and its measures are of one sheet (Task.resizes)")
        if "friction" in self.disturbances.ranges and not self.simulation.colliders:
            raise ValueError("randomize: no friction in a task without solids")
        self.num_envs, self.threads = num_envs, self.simulation.threads
        self.num_attachments = len(fixed.held) + len(fixed.grippers)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (self.actions_per_attachment * self.num_attachments,), np.float32)
        self._prepare_records()
        self.generators = Generators(num_envs)
        self._begun = np.zeros(num_envs, bool)
        self.turn = CallGuard("environment", error=gym.error.ResetNeeded)
        self.state_space = gym.spaces.Box(-self.state_bound, self.state_bound, dtype=np.float32)
        self.observed = Observer(self, obs_mode, image_size, camera, num_points, privileged)

    def _prepare_records(self) -> None:
        """Make the records of episodes, steps and observations, and the kernels that process them."""
        physics, count = self.physics, self.num_envs
        points = "particles" if self.obs_mode == "particles" else "keypoints"
        vector = StateVector(self, points)
        self.particles, self.observation_slices, self.state_bound = vector.particles, vector.slices, vector.bound
        self.observation = np.zeros((count, len(vector.bound)), np.float32)
        # what the task declares, as records for its kernels and as the numbers in them
        self.seen = records(count, [(one.name, np.float32, one.shape) for one in self.observations])
        attachment, (low, high) = (self.num_attachments, 3), hooks.arena(self)
        # what an episode remembers
        memory: list[tuple[Any, ...]] = [("step", np.int64), ("settling_since", np.int64), ("over", bool)]
        memory += [("targets", float, attachment), ("potential", float)]
        memory += [("origin", np.float32, 3), ("material", float, len(PROPERTIES))]
        memory += self.disturbances.remembers(self.single_action_space.shape[0])
        if self._in_numpy:
            memory += [("performance", float), ("success", bool), ("done", bool)]
        memory += hooks.fields(self, "remembers()", self.remembers(), [name for name, *_ in memory])
        self.episode = records(count, memory)
        self.episode["over"] = True
        steps = self.acting_steps + self.settling_steps if self.wind is not None else 0
        self.air = np.zeros((count, steps, 3))
        # valid ranges of the state, and its identity
        share, bound = (-ROUNDING, 1 + ROUNDING), self.state_bound
        self._ranges: dict[str, Any] = {
            "step": (0, self.acting_steps + self.settling_steps), "settling_since": (-1, self.acting_steps), "potential": share,
            "performance": share, "observation": (-bound, bound), **self.disturbances.ranges, **self.ranges,
        }  # fmt: skip
        # what all environments share
        self.rules = record_of(
            low=low, high=high, reach=physics.attachment_speed * physics.time_step, per_side=np.float32(1 / physics.side),
            acting_steps=self.acting_steps, settling_steps=self.settling_steps, sparse=self.reward_mode == "sparse",
            side=physics.side, **self.constants(),
        )  # fmt: skip
        numbers = [f"{name}={value:.6g}" for name, value in sorted(self.constants().items()) if np.ndim(value) == 0]
        digest = hashlib.sha256(" ".join(numbers).encode()).hexdigest()[:16]
        self._belongs = {"task": type(self).__name__, "observation mode": points, "digest of the arguments": digest}
        # what a step brings
        brought: list[tuple[Any, ...]] = [("reward", float), ("terminated", bool), ("truncated", bool), ("failure", np.int64)]
        brought += [("moves", float, (self.num_attachments, self.actions_per_attachment)), ("free", np.uint8, self.num_attachments)]
        self.outcome = records(count, brought)
        told: list[tuple[Any, ...]] = [("strain_max", np.float32), ("strain_before_limiting", np.float32), ("settling", bool)]
        told += [("normalized_performance", float), ("is_success", bool)]
        for hook in ("evaluation", "accounts"):
            told += hooks.fields(self, hook, getattr(self, hook), [name for name, *_ in told])
        self.info = records(count, told)
        self.physical = records(count, answers.PHYSICAL)
        self.terms = records(count, [(name, float) for name in ("progress", "effort", "success", "failure", *self.prices)])
        # further arguments of the kernels
        self._mesh = mesh_arrays(physics.mesh, self.particles)
        self._everyone, self._no_pulls = np.arange(count), np.zeros((count, *attachment))
        self._place = self.simulation.layout.at(self._everyone)
        self._compile()

    def _compile(self) -> None:
        """The kernels of a step, and ``seen`` as the numbers in it."""
        self._apply_actions, self._finish_step = compiled(type(self).__name__, self.kernels)
        self._more = self.seen.view(np.float32).reshape(self.num_envs, -1)

    def __getstate__(self) -> dict[str, Any]:
        """What a copy or a pickle holds: all but compiled code and views."""
        return {name: value for name, value in vars(self).items() if name not in ("_apply_actions", "_finish_step", "_more")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._compile()

    @property
    def step_seconds(self) -> float:
        """How long a step lasts in the simulation [s]."""
        return self.control_steps * self.physics.time_step

    def sizes(self) -> NDArray[np.float64]:
        """Factor on all lengths of each sheet that its episode has drawn, (num_envs,)."""
        return self.episode["size"].copy() if "size" in self.disturbances.ranges else np.ones(self.num_envs)

    def mesh_of(self, env: int) -> ClothMesh:
        """The mesh in the size of an environment's sheet."""
        size = float(self.simulation.size[env])
        return self.physics.mesh if size == 1 else self.physics.mesh.scaled(size)

    # --- what a task defines: start -----------------------------------------------------------------------------------

    def check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse a reset's options that no episode can have, with a ValueError, before anything is changed."""

    def remembers(self) -> Fields:
        """Fields of ``episode`` in addition to those of all tasks: the variables of its episodes."""
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

    # --- what a task defines: step ------------------------------------------------------------------------------------

    def before_step(self, actions: NDArray) -> None:
        """Called before the physics of each step: apply actions other than motion; targets of attachments are already set.

        actions: (num_envs, numbers), finite; late and noisy where ``randomize`` says so.
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

    # --- what a task defines: picture ---------------------------------------------------------------------------------

    def observed_particles(self, mesh: ClothMesh) -> NDArray:
        """The particles that are observed with ``obs_mode="keypoints"``."""
        return key_particles(mesh)

    def solids(self, env: int) -> list[Drawable]:
        """Drawn objects other than the sheet and the floor: by default all solids except planes, at their present poses."""
        from clothgym.render.solids import drawn  # imported here: training draws nothing

        colliders = dict(enumerate(self.simulation.colliders)) | dict(self.episode_colliders(env))
        places = self.simulation.collider_positions[env]
        return [drawn(one).at(places[k]) for k, one in colliders.items() if not isinstance(one, Plane)]

    def markers(self, env: int) -> list[Any]:
        """Drawn objects without shadows: by default those of ``marks``."""
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
        """Where the scene is seen from: ``seen_from``; by default the whole arena from the front and right."""
        from clothgym.render import Camera  # imported here: training draws nothing

        if self.seen_from is not None:
            eye, target, fov, side = self.seen_from
            far = 1.0 if side is None else self.physics.side / side
            return Camera(eye=tuple(far * c for c in eye), target=tuple(far * c for c in target), vertical_fov=fov)  # type: ignore[arg-type]
        low, high = self.arena()
        far = float(max(high - low))
        return Camera(eye=(0.7 * far, -0.6 * far, 0.45 * far), target=(0.0, 0.0, 0.15 * far), vertical_fov=40.0)

    # --- episode --------------------------------------------------------------------------------------------------------

    @exclusive
    def reset(self, envs: NDArray, seeds: Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None) -> None:
        """Begin new episodes; a seed of None goes on with the environment's generator.

        Raises:
            ValueError: seeds, options or starts that no episode can have; nothing is changed then.
            RuntimeError: another thread is in a call.
        """
        seeds = checked_seeds([None] * len(envs) if seeds is None else seeds)
        options = self._checked_options({} if options is None else options)
        if not len(envs):
            return
        # draw new episodes; restore everything if one is refused
        drawn = self._drawn()
        before = [array[envs] for array in drawn]
        generators = self.generators.kept(envs)
        try:
            start = self.simulation.checked_start(envs, self._draw(envs, seeds, options))
        except BaseException:
            for array, value in zip(drawn, before):
                array[envs] = value
            self.generators.put_back(generators)
            raise
        # then change
        self.turn.begin(envs.tolist())
        self.simulation.begin(*start)
        self._begin(envs, warn="material" in options)
        self.turn.finish(envs.tolist())

    def _drawn(self) -> list[NDArray]:
        """All arrays that drawing an episode writes, except the generators, live, (num_envs, ...)."""
        return [self.episode, self.air, self._begun]

    def _draw(self, envs: NDArray, seeds: Sequence[int | None], options: Mapping[str, Any]) -> NDArray:
        """Draw each episode from its own generator; returns the sheets [m], (len(envs), particles, 3)."""
        starts = np.empty((len(envs), self.physics.mesh.num_particles, 3))
        for k, (env, seed) in enumerate(zip(envs.tolist(), seeds)):
            generator = self.generators.of(env, seed)
            self._begun[env] = True
            self._draw_material(env, options.get("material", {}))
            self.disturbances.draw_size(self.episode[env], generator)
            if self.wind is not None:
                self.air[env] = self.wind.series(generator, self.air.shape[1], self.physics.time_step)
            starts[k] = hooks.start(self, env, generator, options)
            # last, so that a seeded start is what it is without them
            self.disturbances.draw(self.episode[env], generator)
        return starts

    def _begin(self, envs: NDArray, warn: bool) -> None:
        """Put fabric, air, solids and attachments of environments as their episodes have drawn them, and observe them."""
        simulation, material = self.simulation, self.episode["material"][envs]
        size = self.sizes()[envs].astype(simulation.dtype)
        if not np.array_equal(material, simulation.parameters[envs]) or not np.array_equal(size, simulation.size[envs]):
            # the declared ranges were held against the integrator's bound at construction; one episode's fabric is now
            properties = {name: material[:, i] for i, name in enumerate(PROPERTIES)}
            simulation.set_parameters(envs, warn=warn, size=size, **properties)
        if self.wind is not None:
            simulation.set_wind(self.air[envs, 0], envs)
        self._place_colliders(envs)
        self.place_attachments(envs)
        for name, value in (("step", 0), ("settling_since", -1), ("over", False)):
            self.episode[name][envs] = value
        for brought in (self.outcome, self.info, self.physical, self.terms):
            brought[envs] = np.zeros((), brought.dtype)
        self._score_and_observe(envs, begins=True)
        self.disturbances.observed(self, envs)
        answers.note_physics(self, envs)
        self.observed.begun(envs)

    def _checked_options(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """A reset's options, with the properties of a fabric that was named; refuses those that no episode can have."""
        if not isinstance(options, Mapping):
            raise ValueError(f"reset options={shown(options)}: must be a dict with any of {', '.join(self.reset_options)}")
        # evaluators and wrappers pass options of their own; but a misspelled option, or one of another task, would have no effect
        for name in [name for name in options if isinstance(name, str) and name not in self.reset_options]:
            near = difflib.get_close_matches(name, OPTIONS.keys() | set(self.reset_options), n=1)
            if near:
                guess = f": did you mean {near[0]!r}?" if near[0] != name else " in this task"
                raise ValueError(f"no reset option {name!r}{guess} (there are: {', '.join(self.reset_options)})")
        checked = {name: value for name, value in options.items() if name in self.reset_options}
        if "material" in options:
            checked["material"] = checked_material_option(
                options["material"], self.physics, self.randomize, self.simulation, self.disturbances.smallest
            )
        self.check_options(checked)
        return checked

    def _draw_material(self, env: int, fixed: Mapping[str, float]) -> None:
        """Set the fabric of one environment's episode: the task's own, with randomized properties and the reset's options."""
        properties = of_material(self.physics.material)
        for name, (low, high) in self.randomize.items():
            properties[PROPERTIES.index(name)] = self.generators[env].uniform(low, high)
        for name, value in fixed.items():
            properties[PROPERTIES.index(name)] = value
        self.episode["material"][env] = properties

    def _place_colliders(self, envs: NDArray) -> None:
        """Put solids where ``begin`` has drawn them, with the friction that was drawn."""
        each = [dict(self.episode_colliders(env)) for env in envs.tolist()]
        if "friction" in self.disturbances.ranges:
            for own, friction in zip(each, self.episode["friction"][envs].tolist()):
                solids = dict(enumerate(self.simulation.colliders)) | own
                own |= {index: replace(one, friction=friction) for index, one in solids.items()}
        for index in each[0] if each else ():
            self.simulation.set_collider(index, [own[index] for own in each], envs)

    @exclusive
    def step(self, actions: Any) -> None:
        """One control step of all environments that are not over; the others give their last answer again, and no reward.

        Raises:
            ValueError: actions, (num_envs, numbers), of a wrong shape or not finite; nothing has moved then.
            gymnasium.error.ResetNeeded: not all environments have been reset, or a step was interrupted.
            RuntimeError: another thread is in a call.
        """
        self.advance(actions)
        self.turn.unfinished = ()

    def advance(self, actions: Any) -> None:
        """The same as a part of a longer step: whoever calls it sets ``turn.unfinished`` to nothing at the end."""
        self.check_ready()
        command = self.commands(self._checked(actions))
        self._control_step(command(0))
        for step in range(1, self.control_steps):
            if self.episode["over"].all():
                break
            with answers.added(self, self._everyone):
                self._control_step(command(step))
        if self.gamma < 1:
            # gamma Phi' - Phi, of which Phi' - Phi has been given; an episode's end has no potential but its performance
            discount = np.where(self.episode["over"], 0, (1 - self.gamma) * self.episode["potential"])
            self.terms["progress"] -= discount
            self.outcome["reward"] -= discount

    def returned(self, state: NDArray, envs: int | slice) -> NDArray:
        """State vectors as observations have them, of one environment, (numbers,), or of several, (..., numbers)."""
        return state

    def from_world(self, actions: NDArray) -> NDArray:
        """Actions as an agent gives them, of those whose velocities are along the world's axes, (num_envs, numbers)."""
        return actions

    def commands(self, actions: NDArray) -> Callable[[int], NDArray]:
        """What each control step of a step is given as its action, a function of the control step: by default the same.

        actions: (num_envs, numbers), float64.
        """
        return lambda step: actions

    def _control_step(self, actions: NDArray) -> None:
        self.move(actions)
        if self.settling == "at_once":
            settle(self)

    def check_ready(self) -> None:
        """Refuse a step of a batch that has not been reset, or was interrupted."""
        if not self._begun.all():
            raise gym.error.ResetNeeded(f"environment {int(np.argmin(self._begun))} has not been reset yet: call reset() first")
        self.turn.check_consistent()
        self.simulation.turn.check_consistent()

    def move(self, actions: NDArray, envs: NDArray | None = None) -> None:
        """One control step of all environments, or of some while the others stand still.

        actions: velocities of the attachments and further numbers, (num_envs, numbers), float64.
        """
        simulation, chosen = self.simulation, self._everyone if envs is None else envs
        self.turn.unfinished = range(self.num_envs)
        running = chosen[~self.episode["over"][chosen]] if self.disturbances.ranges else chosen
        actions = self.disturbances.applied(self, actions, running)
        wrong = self._apply_actions(
            chosen, actions, *self._place, self.rules, self.episode, self.air, self.outcome, *simulation.orders
        )
        if wrong >= 0:
            self.turn.unfinished = ()
            env, component = divmod(wrong, actions.shape[1])
            raise ValueError(f"action[{component}] of environment {env} is {actions[env, component]}: actions must be finite")
        with answers.standing(self, chosen):
            with restricted_to(self, envs):
                self.before_step(actions)
                simulation.step(envs=envs)
                self.info[chosen] = np.zeros((), self.info.dtype)
                self.after_step()
            self._score_and_observe(chosen, begins=False)
            self.disturbances.observed(self, running)
            # anchors that an action has opened let go after the step in which it did
            if self.outcome["free"].any():
                simulation.release(*np.nonzero(self.outcome["free"]))
                self.outcome["free"] = 0
            self.observed.stepped(chosen)

    def steps_taken(self) -> NDArray:
        """Calls of ``step`` since each episode's start, (num_envs,)."""
        return -(-self.control_steps_taken() // self.control_steps)

    def control_steps_taken(self) -> NDArray:
        """Control steps since each episode's start, without those in which a sheet settles at once, (num_envs,)."""
        step, settling = self.episode["step"], self.episode["settling_since"]
        return np.where(settling >= 0, settling, step) if self.settling == "at_once" else step

    def most_steps(self) -> int:
        """Calls of ``step`` that an episode takes at most."""
        return -(-(self.acting_steps + (self.settling_steps if self.settling == "steps" else 0)) // self.control_steps)

    def _checked(self, actions: Any) -> NDArray:
        """Actions as an array of the right shape, float64."""
        shape = (self.num_envs, *self.single_action_space.shape)
        # the usual case, at once
        if type(actions) is np.ndarray and actions.dtype.kind == "f" and actions.shape == shape:
            return np.ascontiguousarray(actions, np.float64)
        return np.ascontiguousarray(numbers("action", actions, shape))

    def _score_and_observe(self, envs: NDArray, begins: bool) -> None:
        """Score and observe environments after a step, all of them, or as their episodes begin."""
        view, mesh = self.simulation.view, self._mesh
        everyone = envs is self._everyone
        block, lane = self._place if everyone else self.simulation.layout.at(envs)
        pulls = self.simulation.pulls(None if everyone else envs) if self.feels_pulls else self._no_pulls
        if self._in_numpy:
            hooks.evaluate_in_numpy(self)

        def work(first: int, last: int) -> None:
            self._finish_step(
                first, last, envs, block, lane, begins, view.x, view.v, view.size, view.holder, view.attachments, view.openings,
                view.blocked, pulls, mesh, self.rules, self.episode, self.air, self.outcome, self.info, self.terms, self.seen,
                self._more, self.state_bound, self.observation,
            )  # fmt: skip

        _jit.run_spans(work, len(envs), min(self.threads, max(1, len(envs) // ENVS_A_THREAD)))

    # --- what a step has brought ----------------------------------------------------------------------------------------

    def infos(self) -> dict[str, Any]:
        """Info of the last step, or of the reset since then: arrays over the batch.

        ``failure`` is a place in ``FAILURES``; the reward's terms are ``reward/NAME``.
        """
        return answers.of_batch(self)

    def info_of(self, env: int) -> dict[str, Any]:
        """The same of one environment, as plain Python values."""
        return answers.of_one(self, env)

    # --- state ----------------------------------------------------------------------------------------------------------

    @exclusive
    def get_state(self) -> TaskState:
        """All that is needed to continue the batch bit for bit.

        Raises:
            RuntimeError, gymnasium.error.ResetNeeded: another thread is in a call, or one was interrupted.
        """
        self.turn.check_consistent()
        return TaskState(
            simulation=self.simulation.get_state(),
            episode={name: value.copy() for name, value in self._memory().items()},
            generators=[json.dumps(g.bit_generator.state) for g in self.generators],
            task=self._belongs.copy(),
        )

    def _memory(self) -> dict[str, NDArray]:
        """All that is remembered of the episodes, live."""
        own = {name: self.episode[name] for name in names_of(self.episode)} | {"observation": self.observation, "wind": self.air}
        return own | answers.remembered(self)

    @exclusive
    def set_state(self, state: TaskState) -> None:
        """Continue from a state of the same task with as many environments.

        Raises:
            ValueError: the state is another task's or of another size, or holds what no episode can have; nothing is changed then.
        """
        check_state(self, state)
        generators = list(map(generator_of, state.generators))
        self.simulation.set_state(state.simulation)
        self.turn.begin(range(self.num_envs))
        for name, value in self._memory().items():
            value[...] = state.episode[name]
        self.generators.put(generators)
        self._begun[:] = True
        # a reward is of a step, and belongs to no state
        self.outcome["reward"], self.terms[...] = 0, np.zeros((), self.terms.dtype)
        self.observed.begun(self._everyone)
        self.turn.unfinished = ()


def checked_gamma(gamma: Any, reward_mode: str) -> float:
    """A discount of rewards with the potential's change; the other modes have no such rewards."""
    value = number("gamma", gamma)
    if not 0 < value <= 1:
        raise ValueError(f"gamma={shown(gamma)}: must be above 0, and at most 1")
    if value < 1 and reward_mode != "delta":
        raise ValueError(f"gamma={shown(gamma)}: must be 1 with reward_mode={reward_mode!r}, whose rewards have no shaping")
    return value


def check_definition(task: Task, in_numpy: bool) -> None:
    """Refuse a task that lacks what every task must say, cannot be evaluated or has nothing to observe."""
    for name, kind, what in (("physics", Physics, "a Physics"), ("acting_steps", int, "a number of control steps")):
        if not isinstance(value := getattr(task, name, None), kind) or value == 0:
            raise TypeError(f"{type(task).__name__}.{name} is {shown(value)}: must be {what}")
    missing = [name for name in ("performance", "success") if not has_own(task, name)]
    if in_numpy and missing:
        raise TypeError(f"{type(task).__name__} does not define {' and '.join(missing)}(): a task without kernels needs both")
    if not task.observations:
        raise TypeError(f"{type(task).__name__}.observations is empty: declare at least one Observation")

"""A task, written once for a batch: what ``ClothEnv`` (a batch of one) and ``ClothVectorEnv`` (a batch of many) both run.

An episode: the agent moves its hands (anchors or grippers) until it is done, at the latest until its time is up; then, in the
tasks that have it so, the sheet settles for a fixed number of steps, in which actions are ignored; then it is judged, which
terminates.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from clothgym import _jit, integrators
from clothgym.envs.episode import FAILURES, Outcome, TaskState, failures, physics_info, within_ball
from clothgym.envs.measures import SUMMARY, largest_strain, see_points, summarize
from clothgym.envs.physics import Physics, check_material_option, check_ranges, checked_ranges, checked_wind, most_demanding
from clothgym.mesh import SHEAR
from clothgym.parameters import AIR_DENSITY, FIGURES, of_material
from clothgym.simulation import Simulation

if TYPE_CHECKING:
    from clothgym.render import Camera, Solid

REWARD_MODES = ("delta", "sparse")
FAILURE_PENALTY = 0.5
SUCCESS_BONUS = 0.25
EFFORT_PRICE = 0.001
HELD = (250, 200, 60)  # colour of the anchors' markers
POSITION_BOUND, VELOCITY_BOUND = 4.0, 5.0  # of observed points, in sides unless a task says otherwise, and in m/s


class Task(ABC):
    """Base of all tasks.

    Args:
        num_envs: environments in the batch.
        integrator: another integrator than the task's own; its substeps are then chosen automatically.
        substeps: substeps of a control step, or "auto"; the task's own number by default.
        bending, strain_limit, self_collision: as ``Simulation`` takes them.
        obs_mode: one of ``obs_modes``.
        reward_mode: "delta" (change of the performance, see the task's page) or "sparse" (the judgement alone).
        randomize: ranges of material figures drawn at each reset, ``{"density": [0.1, 0.2]}``.
        wind: what ``clothgym.Wind`` takes, ``{"speed": [0, 2], "gust": 0.5}``; None for the task's own air, ``{}`` for a calm.
        threads: threads to use; all processors by default for a batch.

    Raises:
        ValueError: an unknown mode, figure or integrator, or a range that is none; the message says what would do.
    """

    physics: ClassVar[Physics]
    acting_steps: ClassVar[int]
    settling_steps: ClassVar[int] = 0
    hand_actions: ClassVar[int] = 3  # numbers for each hand: a velocity, and what comes after it
    key_particles: ClassVar[NDArray]  # those that are observed with obs_mode="keypoints"
    obs_modes: ClassVar[tuple[str, ...]] = ("keypoints", "particles")
    position_bound: ClassVar[float] = POSITION_BOUND
    reset_options: ClassVar[tuple[str, ...]] = ("material",)
    strain_shown: ClassVar[float] = 0.05  # where the colours of render_color="strain" end

    def __init__(
        self,
        num_envs: int,
        integrator: str | Mapping[str, Any] | None = None,
        substeps: int | str | None = None,
        bending: str = "springs",
        strain_limit: float | None = None,
        self_collision: bool | str | Mapping[str, Any] = False,
        obs_mode: str = "keypoints",
        reward_mode: str = "delta",
        randomize: Mapping[str, Sequence[float]] | None = None,
        wind: Mapping[str, Any] | None = None,
        threads: int | None = None,
    ) -> None:
        for name, value, known in (("obs_mode", obs_mode, self.obs_modes), ("reward_mode", reward_mode, REWARD_MODES)):
            if value not in known:
                raise ValueError(f"{name}={value!r}: must be one of {', '.join(known)}")
        self.obs_mode, self.reward_mode = obs_mode, reward_mode
        self.randomize = checked_ranges(randomize or {})
        physics = self.physics
        self.wind = physics.wind if wind is None else checked_wind(wind)
        method = integrators.get(integrator if integrator is not None else physics.integrator)
        check_ranges(physics, self.randomize, method)
        if substeps is None:
            substeps = physics.substeps if method.name == physics.integrator and not self.randomize else "auto"
        self.simulation = Simulation(
            physics.mesh,
            # substeps follow from the stiffest and lightest fabric that can be drawn, not from one that was
            material=most_demanding(physics.material, self.randomize),
            num_envs=num_envs,
            integrator=method,
            time_step=physics.time_step,
            substeps=substeps,  # type: ignore[arg-type]
            colliders=self._colliders(),
            contact="particles",  # what the tasks were made and scored with
            air_density=physics.air_density if wind is None else AIR_DENSITY,
            anchors=physics.anchors,  # type: ignore[arg-type]
            anchor_speed=2 * physics.hand_speed,
            grippers=physics.grippers,
            bending=bending,
            strain_limit=strain_limit,
            self_collision=self_collision,
            threads=threads,
            on_divergence="ignore",  # a step's outcome says so
        )
        self.num_envs = num_envs
        self.threads = self.simulation.threads
        self.num_hands = len(physics.anchors) + len(physics.grippers)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (self.hand_actions * self.num_hands,), np.float32)
        self.particles = self.key_particles if obs_mode == "keypoints" else np.arange(physics.mesh.num_particles)
        bound = self._observation_bound()
        self.single_observation_space = gym.spaces.Box(-bound, bound, dtype=np.float32)
        self.generators: list[np.random.Generator] = [np.random.default_rng(0)] * num_envs
        self._seeded = np.zeros(num_envs, bool)

        mesh = physics.mesh
        self._share = (mesh.area / mesh.area.sum()).astype(np.float32)
        self._structural = np.flatnonzero(self.simulation.view.springs.kind < SHEAR)
        layout = self.simulation.layout
        self._summary = np.zeros((layout.blocks, SUMMARY, layout.lanes), np.float32)
        self._origin = np.zeros((layout.blocks, 3, layout.lanes), np.float32)
        self._seen = np.zeros((layout.blocks, 6 * len(self.particles), layout.lanes), np.float32)
        # the episode: arrays over the batch, all of them part of the state
        self.episode: dict[str, NDArray] = {
            "step": np.zeros(num_envs, np.int64),
            "settling_since": np.full(num_envs, -1, np.int64),
            "over": np.ones(num_envs, bool),
            "targets": np.zeros((num_envs, self.num_hands, 3)),
            "potential": np.zeros(num_envs),
            "observation": np.zeros((num_envs, len(bound)), np.float32),
            "material": np.tile(of_material(self.simulation.material), (num_envs, 1)),
            "wind": np.zeros((num_envs, self.acting_steps + self.settling_steps if self.wind is not None else 0, 3)),
        }

    # --- what each task says --------------------------------------------------------------------------------------------

    @abstractmethod
    def _colliders(self) -> list:
        """The scene's solids; those that change at reset are replaced by ``_begin``."""

    @abstractmethod
    def _more_bounds(self) -> list[float]:
        """Largest magnitude of each component of ``_observe_more``."""

    @abstractmethod
    def _begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        """Draw one environment's scene; the sheet's particles at the start [m], (particles, 3)."""

    @abstractmethod
    def _observe_more(self) -> list[NDArray]:
        """What is observed beside the points of the sheet, arrays (num_envs, size)."""

    @abstractmethod
    def _potential(self, summary: NDArray) -> NDArray:
        """How far along each environment is, in [0, 1], (num_envs,); its change is the reward on the way."""

    def _order(self, targets: NDArray, moves: NDArray, acting: NDArray) -> None:
        """Tell the simulation where the hands are to be [m], (num_envs, hands, 3)."""
        self.simulation.move_anchors(targets)

    def _grip(self, moves: NDArray, acting: NDArray) -> None:  # noqa: B027 - some only move
        """Do what an action says beside where to move, after the step; all must have let go where the time for acting is up."""

    def _account(self, running: NDArray, failure: NDArray, strain: NDArray) -> dict[str, NDArray]:
        """What else ``info`` tells of a step, (num_envs,) each; strain: the largest of the structural springs', (num_envs,)."""
        return {}

    def _prices(self, failure: NDArray, info: dict[str, Any]) -> dict[str, NDArray]:
        """Reward terms of the task's own, (num_envs,) each; failure: index into FAILURES."""
        return {}

    def _done(self) -> NDArray:
        """Whether each environment's agent is done before its time is up, (num_envs,)."""
        return np.zeros(self.num_envs, bool)

    @abstractmethod
    def _judge(self, envs: NDArray, summary: NDArray) -> dict[str, NDArray]:
        """Judge environments at the end of their episodes: at least "normalized_performance" and "is_success", (len(envs),)."""

    @abstractmethod
    def _judgement(self) -> dict[str, NDArray]:
        """The keys of ``_judge`` for an environment that has not been judged."""

    @abstractmethod
    def _arena(self) -> tuple[NDArray, NDArray]:
        """Lowest and highest corner of the room in which hands move [m]; the sheet is out of bounds 0.5 m beyond it."""

    @abstractmethod
    def expert_actions(self) -> NDArray:
        """What a scripted expert does now, (num_envs, actions); it sees the whole state."""

    @abstractmethod
    def solids(self, env: int) -> list[Solid]:
        """What the renderer draws beside the sheet and the floor."""

    @abstractmethod
    def camera(self) -> Camera:
        """Where the scene is seen from."""

    # --- episode --------------------------------------------------------------------------------------------------------

    def reset(self, envs: NDArray, seeds: Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None) -> None:
        """Begin new episodes; a seed of None goes on with the environment's generator."""
        options = {} if options is None else options
        self._check_options(options)
        if not len(envs):
            return
        starts = np.empty((len(envs), self.physics.mesh.num_particles, 3))
        length = self.episode["wind"].shape[1]
        for k, env in enumerate(envs):
            seed = seeds[k] if seeds is not None else None
            if seed is not None or not self._seeded[env]:
                self.generators[env] = seeding.np_random(seed)[0]
                self._seeded[env] = True
            self._draw_material(env, options.get("material", {}))
            if self.wind is not None:
                self.episode["wind"][env] = self.wind.series(self.generators[env], length, self.physics.time_step)
            starts[k] = self._begin(env, self.generators[env], options)
        material = self.episode["material"][envs]
        if not np.array_equal(material, self.simulation.parameters[envs]):
            # the declared ranges were held against the integrator's bound at construction; one episode's figures are now
            figures = {name: material[:, i] for i, name in enumerate(FIGURES)}
            self.simulation.set_parameters(envs, warn="material" in options, **figures)
        self.simulation.reset(envs, positions=starts)
        if self.wind is not None:
            self.simulation.set_wind(self.episode["wind"][envs, 0], envs)
        self._place_hands(envs)
        episode = self.episode
        episode["step"][envs] = 0
        episode["settling_since"][envs] = -1
        episode["over"][envs] = False
        episode["targets"][envs] = self.simulation.hand_positions[envs]
        summary = self._summarize()
        episode["potential"][envs] = self._potential(summary)[envs]
        episode["observation"][envs] = self._clipped_observation()[envs]

    def _place_hands(self, envs: NDArray) -> None:  # noqa: B027 - anchors need nothing
        """Put grippers where an episode begins with them; anchors hold their particles."""

    def _check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse options that no episode can have, before anything is changed."""
        if not isinstance(options, Mapping):
            raise ValueError(f"reset options={options!r}: must be a dict with any of {', '.join(self.reset_options)}")
        unknown = set(options) - set(self.reset_options)
        if unknown:
            raise ValueError(f"unknown reset option {sorted(unknown)[0]!r} (there are: {', '.join(self.reset_options)})")
        check_material_option(options.get("material", {}), self.physics, self.randomize, self.simulation)

    def _draw_material(self, env: int, fixed: Mapping[str, float]) -> None:
        figures = {name: getattr(self.physics.material, name) for name in FIGURES}
        for name, (low, high) in self.randomize.items():
            figures[name] = float(self.generators[env].uniform(low, high))
        self.episode["material"][env] = list((figures | dict(fixed)).values())

    def check_actions(self, actions: Any) -> NDArray:
        """Actions as float64, clipped to [-1, 1], (num_envs, actions).

        Raises:
            ValueError: a wrong shape or a value that is not finite; nothing has moved then.
        """
        try:
            array = np.asarray(actions, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"action {actions!r}: must be an array of numbers") from None
        shape = (self.num_envs, *self.single_action_space.shape)
        if array.shape != shape:
            raise ValueError(f"action has shape {array.shape}: must be {shape}")
        if not np.isfinite(array).all():
            env, component = np.argwhere(~np.isfinite(array))[0]
            raise ValueError(f"action[{component}] of environment {env} is {array[env, component]}: actions must be finite")
        return np.clip(array, -1.0, 1.0)

    def step(self, actions: NDArray) -> Outcome:
        """One control step of all environments that are not over; the others keep still and get no reward."""
        if not self._seeded.all():
            raise gym.error.ResetNeeded(f"environment {int(np.argmin(self._seeded))} has not been reset yet: call reset() first")
        actions = self.check_actions(actions)
        episode, simulation = self.episode, self.simulation
        running = ~episode["over"]
        acting = running & (episode["settling_since"] < 0)
        moves = actions.reshape(self.num_envs, self.num_hands, self.hand_actions)
        self._move_hands(moves, acting)
        if self.wind is not None:
            now = np.minimum(episode["step"], episode["wind"].shape[1] - 1)  # those that are over wait at the end of theirs
            simulation.set_wind(episode["wind"][np.arange(self.num_envs), now])
        simulation.step()
        episode["step"][running] += 1
        self._grip(moves, acting)

        summary = self._summarize()
        failure = failures(summary, *self._arena())
        done = acting & (self._done() | (episode["step"] >= self.acting_steps))
        episode["settling_since"][done] = episode["step"][done]
        settled = (episode["settling_since"] >= 0) & (episode["step"] - episode["settling_since"] >= self.settling_steps)
        failure[~running] = 0
        judged = running & settled & (failure == 0)
        terminated = judged | (failure > 0)
        strain = largest_strain(summary)
        info: dict[str, Any] = physics_info(self.simulation, strain)
        info |= self._account(running, failure, strain) | self._judgement()
        for key, value in self._judge(np.flatnonzero(judged), summary).items():
            info[key][judged] = value
        terms = self._reward_terms(moves, acting, running, judged, failure, summary, info) | self._prices(failure, info)
        reward = np.zeros(self.num_envs)
        for term in terms.values():
            reward += term

        fresh = self._clipped_observation()
        keep = ~running | (failure == 1)
        episode["observation"] = np.where(keep[:, None], episode["observation"], fresh)
        episode["over"] |= terminated
        info |= {
            "reward_terms": terms,
            "settling": episode["settling_since"] >= 0,
            "failure": np.array(FAILURES)[failure],
        }
        return Outcome(reward, terminated, np.zeros(self.num_envs, bool), info)

    def _move_hands(self, moves: NDArray, acting: NDArray) -> None:
        low, high = self._arena()
        reach = self.physics.hand_speed * self.physics.time_step
        targets = self.episode["targets"]
        wanted = np.clip(targets + reach * within_ball(moves[:, :, :3]), low, high)
        self.episode["targets"] = np.where(acting[:, None, None], wanted, targets)
        self._order(self.episode["targets"], moves, acting)

    def _summarize(self) -> NDArray:
        """Summary of the batch, (SUMMARY, num_envs) (see ``measures.summarize``)."""
        view = self.simulation.view

        def work(first: int, last: int) -> None:
            summarize(first, last, view.x, view.v, self._share, view.springs, self._structural, self._summary)

        _jit.run_spans(work, len(self._summary), self.threads)
        return self.simulation.layout.to_public(self._summary).T

    def _reward_terms(
        self,
        moves: NDArray,
        acting: NDArray,
        running: NDArray,
        judged: NDArray,
        failure: NDArray,
        summary: NDArray,
        info: dict[str, Any],
    ) -> dict[str, NDArray]:
        """Reward terms, (num_envs,) each: the potential's change, which ends at the judged performance, and small ones."""
        performance = info["normalized_performance"]
        with np.errstate(invalid="ignore", over="ignore"):
            potential = np.where(judged, performance, np.where(failure > 0, 0.0, self._potential(summary)))
        previous = self.episode["potential"]
        self.episode["potential"] = np.where(running, potential, previous)
        if self.reward_mode == "sparse":
            nothing = np.zeros(self.num_envs)
            return {"progress": performance * judged, "effort": nothing, "success": nothing.copy(), "failure": nothing.copy()}
        squares = moves[:, :, 0] ** 2 + moves[:, :, 1] ** 2 + moves[:, :, 2] ** 2
        effort = squares[:, 0].copy()
        for a in range(1, self.num_hands):
            effort += squares[:, a]
        return {
            "progress": np.where(running, potential - previous, 0.0),
            "effort": -EFFORT_PRICE * effort * acting,
            "success": SUCCESS_BONUS * (info["is_success"] & judged),
            "failure": -FAILURE_PENALTY * (failure > 0),
        }

    def _observation_bound(self) -> NDArray:
        points = 3 * len(self.particles)
        return np.array([self.position_bound] * points + [VELOCITY_BOUND] * points + self._more_bounds(), np.float32)

    def _clipped_observation(self) -> NDArray:
        """Points of the sheet relative to the origin, in sides, their velocities [m/s], and more; within the bounds."""
        view, scale = self.simulation.view, np.float32(1 / max(self.physics.mesh.size))

        def work(first: int, last: int) -> None:
            see_points(first, last, view.x, view.v, self.particles, self._origin, scale, self._seen)

        _jit.run_spans(work, len(self._seen), self.threads)
        space = self.single_observation_space
        with np.errstate(invalid="ignore", over="ignore"):
            seen = [self.simulation.layout.to_public(self._seen), *self._observe_more()]
            return np.clip(np.concatenate(seen, axis=1, dtype=np.float32, casting="unsafe"), space.low, space.high)

    def _set_origin(self, env: int, origin: ArrayLike) -> None:
        """Observe an environment's positions relative to this point [m]."""
        block, lane = divmod(env, self.simulation.layout.lanes)
        self._origin[block, :, lane] = origin

    # --- pictures -------------------------------------------------------------------------------------------------------

    def markers(self, env: int) -> list[Any]:
        """What is drawn and casts no lift on the sheet: hands that hold it, and what else a task shows."""
        hands, attached = self.simulation.hand_positions[env], self.simulation.attached[env]
        return [(x, HELD) for x, held in zip(hands, attached) if held]

    # --- state ----------------------------------------------------------------------------------------------------------

    def get_state(self) -> TaskState:
        return TaskState(
            simulation=self.simulation.get_state(),
            episode={name: value.copy() for name, value in self.episode.items()},
            generators=[json.dumps(g.bit_generator.state) for g in self.generators],
        )

    def set_state(self, state: TaskState) -> None:
        """Continue from a state of the same task with as many environments.

        Raises:
            ValueError: the state is another task's or of another size; nothing is changed then.
        """
        missing = {
            name
            for name in {*self.episode, *state.episode}
            if np.shape(self.episode.get(name, ())) != np.shape(state.episode.get(name, ()))
        }
        if missing or len(state.generators) != self.num_envs:
            raise ValueError(
                f"the state is of {len(state.generators)} environments of another task, observation mode or size: "
                f"it differs in {', '.join(sorted(missing)) or 'their number'}"
            )
        if np.any(state.episode["over"] & (state.episode["step"] == 0)):
            raise ValueError("the state is from before the first reset: there is no episode to continue")
        self.simulation.set_state(state.simulation)
        self.episode = {name: value.copy() for name, value in state.episode.items()}
        for env, text in enumerate(state.generators):
            self.generators[env] = np.random.default_rng()
            self.generators[env].bit_generator.state = json.loads(text)
        self._seeded[:] = True

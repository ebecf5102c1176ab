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
from numpy.typing import NDArray

from clothgym import _jit, integrators
from clothgym.envs.episode import FAILURES, Fields, TaskState, names_of, record_of, records
from clothgym.envs.physics import Physics, check_material_option, check_ranges, checked_ranges, checked_wind, most_demanding
from clothgym.envs.stepping import Kernels, compiled, mesh_arrays
from clothgym.parameters import AIR_DENSITY, FIGURES, of_material
from clothgym.simulation import Simulation

if TYPE_CHECKING:
    from clothgym.render import Camera, Solid

REWARD_MODES = ("delta", "sparse")
HELD = (250, 200, 60)  # colour of the anchors' markers
POSITION_BOUND, VELOCITY_BOUND = 4.0, 5.0  # of observed points, in sides unless a task says otherwise, and in m/s
ENVS_A_THREAD = 16  # fewer are not worth another thread


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

    Attributes:
        episode: records of what the episodes are about, (num_envs,): ``episode["step"]``, and the others of ``_remembers``; with
            ``observation``, (num_envs, numbers), and ``air``, the wind of each step [m/s], (num_envs, steps, 3), part of the state.
        rules: one record of figures that all environments share.
        outcome, info, terms: records of what the last step has brought, (num_envs,).

    Raises:
        ValueError: an unknown mode, figure or integrator, or a range that is none; the message says what would do.
    """

    physics: ClassVar[Physics]
    kernels: ClassVar[Kernels]  # what a step is about, see ``stepping``
    acting_steps: ClassVar[int]
    settling_steps: ClassVar[int] = 0
    hand_actions: ClassVar[int] = 3  # numbers for each hand: a velocity, and what comes after it
    key_particles: ClassVar[NDArray]  # those that are observed with obs_mode="keypoints"
    obs_modes: ClassVar[tuple[str, ...]] = ("keypoints", "particles")
    position_bound: ClassVar[float] = POSITION_BOUND
    judgement: ClassVar[Fields]  # what info tells of the judgement, zero until then, beside performance and success
    accounts: ClassVar[Fields] = ()  # what else it tells of each step
    prices: ClassVar[tuple[str, ...]] = ()  # reward terms of the task's own
    feels_pulls: ClassVar[bool] = False  # whether its kernels must know how the sheet pulls at the hands
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
        self._prepare_observation()
        self._prepare_records()
        self.generators: list[np.random.Generator] = [np.random.default_rng(0)] * num_envs
        self._seeded = np.zeros(num_envs, bool)

    def _prepare_observation(self) -> None:
        """Space and memory of what is observed: the sheet's points, and what the task declares."""
        points, declared = 3 * len(self.particles), self._observes()
        bounds = [np.full(points, self.position_bound), np.full(points, VELOCITY_BOUND)]
        bounds += [np.broadcast_to(bound, size[0] if size else 1).ravel() for _, bound, *size in declared]
        self._bound = np.concatenate(bounds).astype(np.float32)
        self.single_observation_space = gym.spaces.Box(-self._bound, self._bound, dtype=np.float32)
        self.observation = np.zeros((self.num_envs, len(self._bound)), np.float32)
        self._seen = records(self.num_envs, [(name, np.float32, *size) for name, _, *size in declared])
        self._more = self._seen.view(np.float32).reshape(self.num_envs, -1)

    def _prepare_records(self) -> None:
        """Records of the episodes and their steps, and the kernels that go through them."""
        physics, count = self.physics, self.num_envs
        hand, low, high = (self.num_hands, 3), *self._arena()
        memory: list[tuple[Any, ...]] = [("step", np.int64), ("settling_since", np.int64), ("over", bool), ("targets", float, hand)]
        memory += [("potential", float)]
        memory += [("origin", np.float32, 3), ("material", float, len(FIGURES)), *self._remembers()]
        self.episode = records(count, memory)
        self.episode["over"] = True
        steps = self.acting_steps + self.settling_steps if self.wind is not None else 0
        self.air = np.zeros((count, steps, 3))
        self.rules = record_of(
            low=low, high=high, reach=physics.hand_speed * physics.time_step, per_side=np.float32(1 / max(physics.mesh.size)),
            acting_steps=self.acting_steps, settling_steps=self.settling_steps, sparse=self.reward_mode == "sparse",
            side=max(physics.mesh.size), **self._figures(),
        )  # fmt: skip
        brought: list[tuple[Any, ...]] = [("reward", float), ("terminated", bool), ("failure", np.int64)]
        brought += [("moves", float, (self.num_hands, self.hand_actions)), ("free", np.uint8, self.num_hands)]
        self.outcome = records(count, brought)
        told = [("strain_max", np.float32), ("strain_before_limiting", np.float32), ("settling", bool)]
        self.info = records(
            count, [*told, ("normalized_performance", float), ("is_success", bool), *self.judgement, *self.accounts]
        )
        self.terms = records(count, [(name, float) for name in ("progress", "effort", "success", "failure", *self.prices)])
        self._mesh = mesh_arrays(physics.mesh, self.particles)
        self._everyone, self._no_pulls = np.arange(count), np.zeros((count, *hand))
        self._order, self._conclude = compiled(type(self).__name__, self.kernels)

    # --- what each task says --------------------------------------------------------------------------------------------

    @abstractmethod
    def _colliders(self) -> list:
        """The scene's solids; those that change at reset are replaced by ``_begin``."""

    @abstractmethod
    def _arena(self) -> tuple[NDArray, NDArray]:
        """Lowest and highest corner of the room in which hands move [m]; the sheet is out of bounds 0.5 m beyond it."""

    @abstractmethod
    def _remembers(self) -> Fields:
        """What its episodes remember: fields of ``episode`` beside those that all have."""

    def _figures(self) -> dict[str, Any]:
        """Figures that its kernels must know: fields of ``rules``, numbers or arrays."""
        return {}

    @abstractmethod
    def _observes(self) -> Fields:
        """What is observed beside the points of the sheet, in that order: a number's name and largest magnitude, or those of some
        numbers and how many they are."""

    @abstractmethod
    def _begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        """Draw one environment's scene; the sheet's particles at the start [m], (particles, 3)."""

    def _furnish(self, envs: NDArray) -> None:  # noqa: B027 - some have none
        """Put solids where ``_begin`` has drawn them, or a state has them."""

    def _place_hands(self, envs: NDArray) -> None:  # noqa: B027 - anchors need nothing
        """Put grippers where an episode begins with them; anchors hold their particles."""

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
        simulation = self.simulation
        starts = np.empty((len(envs), self.physics.mesh.num_particles, 3))
        for k, env in enumerate(envs.tolist()):
            seed = seeds[k] if seeds is not None else None
            if seed is not None or not self._seeded[env]:
                self.generators[env] = seeding.np_random(seed)[0]
                self._seeded[env] = True
            self._draw_material(env, options.get("material", {}))
            if self.wind is not None:
                self.air[env] = self.wind.series(self.generators[env], self.air.shape[1], self.physics.time_step)
            starts[k] = self._begin(env, self.generators[env], options)
        material = self.episode["material"][envs]
        if not np.array_equal(material, simulation.parameters[envs]):
            # the declared ranges were held against the integrator's bound at construction; one episode's figures are now
            figures = {name: material[:, i] for i, name in enumerate(FIGURES)}
            simulation.set_parameters(envs, warn="material" in options, **figures)
        simulation.reset(envs, positions=starts)
        if self.wind is not None:
            simulation.set_wind(self.air[envs, 0], envs)
        self._furnish(envs)
        self._place_hands(envs)
        self._look(envs, begins=True)

    def _check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse options that no episode can have, before anything is changed."""
        if not isinstance(options, Mapping):
            raise ValueError(f"reset options={options!r}: must be a dict with any of {', '.join(self.reset_options)}")
        unknown = set(options) - set(self.reset_options)
        if unknown:
            raise ValueError(f"unknown reset option {sorted(unknown)[0]!r} (there are: {', '.join(self.reset_options)})")
        if "material" in options:
            check_material_option(options["material"], self.physics, self.randomize, self.simulation)

    def _draw_material(self, env: int, fixed: Mapping[str, float]) -> None:
        figures = of_material(self.physics.material)
        for name, (low, high) in self.randomize.items():
            figures[FIGURES.index(name)] = self.generators[env].uniform(low, high)
        for name, value in fixed.items():
            figures[FIGURES.index(name)] = value
        self.episode["material"][env] = figures

    def step(self, actions: Any) -> None:
        """One control step of all environments that are not over; the others keep still and get no reward.

        Raises:
            ValueError: actions, (num_envs, numbers), of a wrong shape or not finite; nothing has moved then.
        """
        if not self._seeded.all():
            raise gym.error.ResetNeeded(f"environment {int(np.argmin(self._seeded))} has not been reset yet: call reset() first")
        actions, simulation = self._checked(actions), self.simulation
        wrong = self._order(actions, simulation.layout.lanes, self.rules, self.episode, self.air, self.outcome, *simulation.orders)
        if wrong >= 0:
            env, component = divmod(wrong, actions.shape[1])
            raise ValueError(f"action[{component}] of environment {env} is {actions[env, component]}: actions must be finite")
        simulation.step()
        self._look(self._everyone, begins=False)
        if self.outcome["free"].any():
            simulation.release(*np.nonzero(self.outcome["free"]))

    def _checked(self, actions: Any) -> NDArray:
        try:
            array = np.ascontiguousarray(actions, np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"action {actions!r}: must be an array of numbers") from None
        shape = (self.num_envs, *self.single_action_space.shape)
        if array.shape != shape:
            raise ValueError(f"action has shape {array.shape}: must be {shape}")
        return array

    def _look(self, envs: NDArray, begins: bool) -> None:
        """Score and observe environments after a step, all of them, or where their episodes begin."""
        view, lanes, mesh = self.simulation.view, self.simulation.layout.lanes, self._mesh
        pulls = self.simulation.pulls(envs if begins else None) if self.feels_pulls else self._no_pulls
        if not begins:
            self.info = np.zeros(self.num_envs, self.info.dtype)

        def work(first: int, last: int) -> None:
            self._conclude(
                first, last, envs, begins, lanes, view.x, view.v, view.holder, view.hands, view.openings, pulls, mesh, self.rules,
                self.episode, self.air, self.outcome, self.info, self.terms, self._seen, self._more, self._bound, self.observation,
            )  # fmt: skip

        _jit.run_spans(work, len(envs), min(self.threads, max(1, len(envs) // ENVS_A_THREAD)))

    # --- what a step has brought ----------------------------------------------------------------------------------------

    def told(self) -> dict[str, Any]:
        """What info tells of the last step: arrays over the batch, and a dict of them for the reward's terms."""
        info: dict[str, Any] = {name: self.info[name].copy() for name in names_of(self.info)} | self._told_by_physics()
        info["failure"] = np.array(FAILURES)[self.outcome["failure"]]
        info["reward_terms"] = {name: self.terms[name].copy() for name in names_of(self.terms)}
        return info

    def told_of(self, env: int) -> dict[str, Any]:
        """The same of one environment, as plain Python values."""
        info = dict(zip(names_of(self.info), self.info[env].item()))
        info |= {name: value[env].item() for name, value in self._told_by_physics().items()}
        info["failure"] = FAILURES[self.outcome["failure"][env]]
        info["reward_terms"] = dict(zip(names_of(self.terms), self.terms[env].item()))
        return info

    def _told_by_physics(self) -> dict[str, NDArray]:
        """With a limiter the strain that it met; with self-collision its contacts, the moves that it cut short, and the largest lag
        of what is held [m]."""
        limiting, contacts = self.simulation.limiting, self.simulation.self_contacts
        info = {} if limiting is None else {"strain_before_limiting": limiting.before}
        if contacts is not None:
            info |= {"self_contacts": contacts.rows, "clamped_moves": contacts.clamped, "hand_lag": contacts.lag}
        return info

    # --- pictures -------------------------------------------------------------------------------------------------------

    def markers(self, env: int) -> list[Any]:
        """What is drawn and casts no lift on the sheet: hands that hold it, and what else a task shows."""
        hands, attached = self.simulation.hand_positions[env], self.simulation.attached[env]
        return [(x, HELD) for x, held in zip(hands, attached) if held]

    # --- state ----------------------------------------------------------------------------------------------------------

    def get_state(self) -> TaskState:
        return TaskState(
            simulation=self.simulation.get_state(),
            episode={name: value.copy() for name, value in self._memory().items()},
            generators=[json.dumps(g.bit_generator.state) for g in self.generators],
        )

    def _memory(self) -> dict[str, NDArray]:
        """All that is remembered of the episodes, live."""
        return {name: self.episode[name] for name in names_of(self.episode)} | {"observation": self.observation, "wind": self.air}

    def set_state(self, state: TaskState) -> None:
        """Continue from a state of the same task with as many environments.

        Raises:
            ValueError: the state is another task's or of another size; nothing is changed then.
        """
        memory = self._memory()
        missing = {
            name for name in {*memory, *state.episode} if np.shape(memory.get(name, ())) != np.shape(state.episode.get(name, ()))
        }
        if missing or len(state.generators) != self.num_envs:
            raise ValueError(
                f"the state is of {len(state.generators)} environments of another task, observation mode or size: "
                f"it differs in {', '.join(sorted(missing)) or 'their number'}"
            )
        if np.any(state.episode["over"] & (state.episode["step"] == 0)):
            raise ValueError("the state is from before the first reset: there is no episode to continue")
        self.simulation.set_state(state.simulation)
        for name, value in memory.items():
            value[...] = state.episode[name]
        self._furnish(self._everyone)
        for env, text in enumerate(state.generators):
            self.generators[env] = np.random.default_rng()
            self.generators[env].bit_generator.state = json.loads(text)
        self._seeded[:] = True

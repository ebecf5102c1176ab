"""Stages that are not scenes: an environment with a policy, and a recording that is shown again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import indices, known, vector
from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.envs.episode import within_ball
from clothgym.material import PRESETS
from clothgym.playground.judgement import judgement
from clothgym.playground.recording import Frame, Recording, read, stiffness, touching
from clothgym.playground.sheets import Attachment, Stability, set_in_place, stability, visible, within_view
from clothgym.playground.stage import Stage
from clothgym.playground.world import SLIDERS, Settings
from clothgym.registration import checked_id
from clothgym.render.solids import drawn
from clothgym.simulation import Simulation
from clothgym.wind import Wind

Policy = Callable[[Any, NDArray], NDArray]  # (environment, observation) -> action
BOXED = ("integrator", "bending", "strain_limit", "self_collision", "wind", "gust")  # settings that need a new environment


KEPT_NOTES = ("evaluation", "run", "air")  # notes that a change of settings does not affect


def expert(env: Any, observation: NDArray) -> NDArray:
    """What the task's scripted expert does."""
    return env.expert_action()


def noop(env: Any, observation: NDArray) -> NDArray:
    """What keeps the attachments where they are."""
    return np.zeros(env.action_space.shape, np.float32)


def random(env: Any, observation: NDArray) -> NDArray:
    """Random actions, drawn from the action space's own generator."""
    return env.action_space.sample()


POLICIES: dict[str, Policy] = {"expert": expert, "noop": noop, "random": random}


class EpisodeStage(Stage):
    """An environment, and who acts in it.

    Args:
        env_id: a registered id, with or without its namespace.
        policies: who may act, by name, besides those of ``POLICIES``.
        policy: who does at first.
        name: under which it was asked for, the id if it is empty.

    Attributes:
        info: of the last step.
        played: what the environment observed, was told and gave in each step of the episode.

    Raises:
        ValueError: no such environment or policy.
    """

    def __init__(
        self, env_id: str, policies: Mapping[str, Policy] | None = None, policy: str = "expert", seed: int = 0, name: str = ""
    ) -> None:
        super().__init__()
        self.env_id, self.seed = checked_id(env_id), seed
        self.name = name or self.env_id
        self.info: Mapping[str, Any] = {}
        self.played: list[tuple[Any, NDArray, float]] = []
        self.policies = {**POLICIES, **(policies or {})}
        self._given: dict[str, Any] | None = None
        self.choose(policy)
        if self._given is None:
            self._begin({})

    def _begin(self, given: Mapping[str, Any]) -> None:
        """Open the environment with these options."""
        self._options = dict(given)
        self.env = self._made()
        self._given = dict(given)
        task = self.env.task
        self.about = f"{(type(self.env).__doc__ or '').strip().splitlines()[0]}"
        s = task.simulation
        self._own = self.settings = settings_of(s, task.wind)
        self.recording = Recording(self.env_id, s.mesh, task.step_seconds, task.camera(), (s.integrator.name,), task.strain_shown)
        self.reset()

    def _made(self) -> Any:
        return gym.make(self.env_id, **self._options).unwrapped

    @property
    def simulation(self) -> Simulation:
        return self.env.task.simulation

    @property
    def over(self) -> bool:
        return self._over

    @property
    def env_kwargs(self) -> Mapping[str, Any]:
        """With which the environment was made at first."""
        return self._given or {}

    @property
    def unchanged(self) -> bool:
        """Whether the settings are the environment's own."""
        return self.settings == self._own

    def choose(self, policy: str) -> None:
        """Use another policy from now on; if it was trained with other options, in a new environment with these.

        Raises:
            ValueError: nobody has that name.
        """
        known("policy", policy, self.policies)
        trained = getattr(self.policies[policy], "env_kwargs", None)
        if trained is not None and trained != self._given:
            self._begin(trained)
            options = ", ".join(f"{name}={value!r}" for name, value in trained.items()) or "the environment's own options"
            self.notes["run"] = f"As {policy} was trained, with {options}."
        self.policy = policy

    def reset(self, seed: int | None = None) -> None:
        self.seed = self.seed if seed is None else int(seed)
        self._observation, _ = self.env.reset(seed=self.seed)
        self.env.action_space.seed(self.seed)
        # an episode starts with the task's own parameters
        set_in_place(self.simulation, self._own, self.settings)
        self._dragged: dict[int, NDArray] = {}
        self._grabbed: dict[int, NDArray] = {}  # ways from the visitor's pointer to the attachments that follow it [m]
        self.played, self.info = [], {}
        self._closed = np.full(
            len(self.attachments()), self.env.task.actions_per_attachment > 3 and not len(self.simulation.grippers)
        )
        self._over, self._time, self._cost, self.total = False, 0.0, 0.0, 0.0
        self.notes.pop("evaluation", None)
        wind = self.env.task.wind
        if wind is not None and wind.speed[0] != wind.speed[1]:
            self.notes["air"] = "Each episode draws its wind, at most what the sliders show, from any side."
        else:
            self.notes.pop("air", None)
        self.recording.frames[:] = [self._look({})]

    def advance(self) -> Frame:
        if self._over:
            return self.frame
        action = np.asarray(self.policies[self.policy](self.env, self._observation), np.float32)
        if self._dragged:
            action = self._steered(action)
        begun = time.perf_counter()
        before = self._observation
        self._observation, reward, terminated, truncated, info = self.env.step(action)
        self.played.append((before, action, float(reward)))
        self.info = info
        self._cost = time.perf_counter() - begun
        self._time += self.env.task.step_seconds
        self.total += reward
        self._over = terminated or truncated
        if self._over:
            self.notes["evaluation"] = judgement(info, self.total)
        terms = {key.removeprefix("reward/"): value for key, value in info.items() if key.startswith("reward/")}
        return self._keep(self._look(terms))

    def _look(self, terms: Mapping[str, float]) -> Frame:
        s, task = self.simulation, self.env.task
        return Frame(
            time=self._time,
            positions=visible(s.positions),
            stiffness=stiffness(s)[None],
            touching=touching(s)[None],
            solids=tuple(map(drawn, [*task.solids(0), *task.markers(0)])),
            readings={
                name: np.array([value])
                for name, value in read(s, self._cost, float(s.penetration()[0]) if s.colliders else 0.0).items()
            },
            terms={name: float(value) for name, value in terms.items()},
        )

    # --- settings -------------------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> None:
        before = self.settings
        if changes.get("integrator", before.integrator) != before.integrator:
            changes = {"substeps": "auto"} | changes  # the task's number is for its own method
        after = before.changed(**changes)
        self.notes = {k: v for k, v in self.notes.items() if k in KEPT_NOTES}
        if any(getattr(after, name) != getattr(before, name) for name in BOXED):
            self._rebuild(after)
        unbounded = set_in_place(self.simulation, before, after)
        if unbounded:
            self.notes["substeps"] = unbounded
        self.settings = after
        self.recording.labels = (self.simulation.integrator.name,)

    def _rebuild(self, after: Settings) -> None:
        """Make a new environment, and continue the episode if its state fits; else restart it."""
        old, options, state = self.env, self._options, self.env.get_state()
        self._options = (self._given or {}) | {
            "integrator": after.integrator,
            "bending": after.bending,
            "strain_limit": after.strain_limit,
            "self_collision": after.self_collision != "off" and after.self_collision,
        }
        if (after.wind, after.gust) != (self._own.wind, self._own.gust):
            self._options["wind"] = {"speed": [after.wind, after.wind], "direction": [0.0, 0.0], "gust": after.gust}
        try:
            self.env = self._made()
            self.env.reset(seed=self.seed)
        except ValueError:
            self.env, self._options = old, options
            raise
        blows = (after.wind, after.gust) != (self.settings.wind, self.settings.gust)  # an episode's wind is drawn as it begins
        if blows or not self._goes_on(state):
            self.reset()
            self.notes["restart"] = "This cannot change within an episode: it has started again."

    def _goes_on(self, state: Any) -> bool:
        """Continue from a state; returns whether it fits."""
        try:
            self.env.set_state(state)
        except ValueError:
            return False
        return True

    def stabilities(self) -> list[Stability]:
        return [stability(self.simulation)]

    # --- attachments ----------------------------------------------------------------------------------------------------

    def attachments(self) -> list[Attachment]:
        s = self.simulation
        anchors, grippers = len(s.anchors), len(s.grippers)
        holds = [*s.attached[0], *(s.grippers.held[0] > 0 if grippers else [])]
        names = [f"clip {k + 1}" for k in range(anchors)] + [f"gripper {k + 1}" for k in range(grippers)]
        return [
            Attachment(name, x, bool(h), k >= anchors or bool(h))
            for k, (name, x, h) in enumerate(zip(names, s.attachment_positions[0], holds))
        ]

    def drag(self, attachment: int, place: ArrayLike | None) -> None:
        indices("attachment", [attachment], self.env.task.num_attachments, "the attachments of this task")
        if place is None:
            self._dragged.pop(attachment, None)
        else:
            self._dragged[attachment] = within_view(vector("place", place))

    def grab(self, place: ArrayLike) -> None:
        """Take the attachment that is nearest to where the visitor holds the sheet."""
        where = within_view(vector("place", place))
        attachments = self.attachments()
        able = [k for k, attachment in enumerate(attachments) if attachment.draggable]
        if able:
            nearest = min(able, key=lambda k: float(((attachments[k].position - where) ** 2).sum()))
            self.grab_these([nearest], where)

    def grab_these(self, which: Sequence[int], where: NDArray) -> None:
        """Let these attachments follow the visitor's pointer, which is at a position [m], (3,)."""
        self._grabbed = {k: self.attachments()[k].position - where for k in which}

    def pull(self, place: ArrayLike) -> None:
        for attachment, away in self._grabbed.items():
            self.drag(attachment, vector("place", place) + away)

    def let_go(self) -> None:
        for attachment in self._grabbed:
            self.drag(attachment, None)
        self._grabbed = {}

    def hold(self, attachment: int, holds: bool) -> None:
        indices("attachment", [attachment], self.env.task.num_attachments, "the attachments of this task")
        self._closed[attachment] = holds
        self._dragged.setdefault(attachment, self.simulation.attachment_positions[0, attachment])

    def _steered(self, action: NDArray) -> NDArray:
        """The action with dragged attachments moving to the visitor's positions, as fast as the task allows."""
        task = self.env.task
        moves = action.reshape(task.num_attachments, task.actions_per_attachment).copy()
        for attachment, place in self._dragged.items():
            away = place - task.episode["targets"][0, attachment]
            moves[attachment, :3] = within_ball(away / (task.physics.attachment_speed * task.physics.time_step))
            if task.actions_per_attachment > 3:
                moves[attachment, 3] = -1.0 if self._closed[attachment] else 1.0
        return moves.ravel().astype(np.float32)


class Replay(Stage):
    """A recording that is shown again: all frames are there, and nothing can be changed."""

    def __init__(self, recording: Recording, name: str = "replay") -> None:
        super().__init__()
        self.name, self.seed = name, 0
        count = len(recording.frames)
        self.about = f"A recording of {recording.title}: {count} frames, {count * recording.time_step:.1f} s."
        self.settings, self.recording = Settings(), recording

    @property
    def over(self) -> bool:
        return True

    def advance(self) -> Frame:
        return self.frame

    def reset(self, seed: int | None = None) -> None:
        """Nothing to do: a recording does not change."""

    def change(self, **changes: Any) -> None:
        raise ValueError("a recording cannot be changed: choose a scene or an environment")


def settings_of(simulation: Simulation, wind: Wind | None = None) -> Settings:
    """The settings of a task's simulation; for a wind that each episode draws, the largest speed."""
    material, state = simulation.material, simulation.get_state()
    return Settings(
        gravity=round(-float(state.gravity[0, 2]), 6),
        wind=0.0 if wind is None else float(wind.speed[1]),
        gust=0.0 if wind is None else float(wind.gust),
        fabric=next((name for name, preset in PRESETS.items() if preset.source == material.source), Settings.fabric),
        **{name: getattr(material, name) for name in SLIDERS},
        friction=round(float(state.colliders[0, 0, R_FRICTION]), 6) if simulation.colliders else 0.4,
        integrator=simulation.integrator.name,
        bending=simulation.bending.name,
        strain_limit=simulation.strain_limit,
        self_collision=simulation.self_collision or "off",
        substeps=simulation.substeps,
    )

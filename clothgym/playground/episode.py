"""Stages that are not scenes: an environment with a policy, a race against one, and a recording that is shown again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import known, vector
from clothgym.envs.episode import FAILURES, within_ball
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.scenes import titled
from clothgym.playground.stage import Stage, measured, visible, within_view
from clothgym.registration import checked_id
from clothgym.render import Camera
from clothgym.render.solids import drawn
from clothgym.simulation import Simulation

Policy = Callable[[Any, NDArray], NDArray]  # (environment, observation) -> action


FAILED = {"diverged": "blew up", "torn": "tore", "out_of_bounds": "was carried out of reach"}
POLICIES: dict[str, Policy] = {
    "expert": lambda env, observation: env.expert_action(),
    "noop": lambda env, observation: np.zeros(env.action_space.shape, np.float32),  # attachments stay where they are
    "random": lambda env, observation: env.action_space.sample(),
}


@dataclass(frozen=True)
class Learnt:
    """A policy in the environment that it was trained in.

    Attributes:
        act: actions of a batch, from the environment and the observations.
        env_kwargs: with which the environment was made.
    """

    act: Callable[[Any, Any], NDArray]
    env_kwargs: Mapping[str, Any]

    def __call__(self, env: Any, observation: Any) -> NDArray:
        if isinstance(observation, Mapping):  # of a goal task
            return self.act(env, {name: part[None] for name, part in observation.items()})[0]
        return self.act(env, observation[None])[0]


class EpisodeStage(Stage):
    """An environment, and who acts in it.

    Args:
        env_id: a registered id, with or without its namespace.
        policies: who may act, by name, besides those of ``POLICIES``.
        policy: who does at first.
        name: under which it was asked for, the id if it is empty.

    Attributes:
        env_kwargs: with which the environment was made at first.
        info: of the last step.
        played: what the environment observed, was told and gave in each step of the episode.

    Raises:
        ValueError: no such environment or policy.
    """

    env: Any
    env_kwargs: Mapping[str, Any] | None = None

    def __init__(
        self, env_id: str, policies: Mapping[str, Policy] | None = None, policy: str = "expert", seed: int = 0, name: str = ""
    ) -> None:
        super().__init__()
        self.env_id, self.seed = checked_id(env_id), seed
        self.name = name or self.env_id
        self.policies = {**POLICIES, **(policies or {})}
        self.choose(policy)
        if self.env_kwargs is None:
            self._begin({})

    def _begin(self, env_kwargs: Mapping[str, Any]) -> None:
        """Open the environment with these options."""
        self.env_kwargs = dict(env_kwargs)
        self.env = gym.make(self.env_id, **env_kwargs).unwrapped
        task = self.env.task
        self.drops = task.actions_per_attachment > 3
        self.about = f"{(type(self.env).__doc__ or '').strip().splitlines()[0]}"
        s = task.simulation
        self.recording = Recording(self.env_id, s.mesh, task.step_seconds, task.camera(), ("sheet",), task.strain_shown)
        self.reset()

    @property
    def simulation(self) -> Simulation:
        return self.env.task.simulation

    @property
    def over(self) -> bool:
        return self._over

    def choose(self, policy: str) -> None:
        """Use another policy from now on; if it was trained with other options, in a new environment with these.

        Raises:
            ValueError: nobody has that name.
        """
        known("policy", policy, self.policies)
        trained = getattr(self.policies[policy], "env_kwargs", None)
        if trained is not None and trained != self.env_kwargs:
            self._begin(trained)
            options = ", ".join(f"{name}={value!r}" for name, value in trained.items()) or "the environment's own options"
            self.notes["run"] = f"As {titled(policy)} was trained, with {options}."
        self.policy = policy

    def reset(self, seed: int | None = None) -> None:
        self.seed = self.seed if seed is None else int(seed)
        self._observation, _ = self.env.reset(seed=self.seed)
        self.env.action_space.seed(self.seed)
        self._dragged: dict[int, NDArray] = {}  # where the visitor's pointer draws attachments [m]
        self._grabbed: dict[int, NDArray] = {}  # ways from that pointer to the attachments [m]
        self._over = self._dropped = False
        self._time, self._cost, self._total = 0.0, 0.0, 0.0
        self.played: list[tuple[Any, NDArray, float]] = []
        self.info: Mapping[str, Any] = {}
        self.notes.pop("evaluation", None)
        mesh = self.env.task.mesh_of(0)
        if mesh is not self.recording.mesh:  # a sheet of another size
            self.recording = replace(self.recording, mesh=mesh, frames=[])
        self.recording.frames[:] = [self._look()]

    def advance(self) -> Frame:
        if self._over:
            return self.frame
        action = self._steered(np.asarray(self.policies[self.policy](self.env, self._observation), np.float32))
        begun, before = time.perf_counter(), self._observation
        self._observation, reward, terminated, truncated, self.info = self.env.step(action)
        self._cost = time.perf_counter() - begun
        self.played.append((before, action, float(reward)))
        self._time += self.env.task.step_seconds
        self._total += reward
        self._over = terminated or truncated
        if self._over:
            self.notes["evaluation"] = judgement(self.info, self._total)
        return self._keep(self._look())

    def _look(self) -> Frame:
        s, task = self.simulation, self.env.task
        return Frame(
            time=self._time,
            positions=visible(s.positions),
            solids=tuple(map(drawn, [*task.solids(0), *task.markers(0)])),
            readings=measured(s, self._cost),
            terms={name.removeprefix("reward/"): float(self.info[name]) for name in self.info if name.startswith("reward/")},
        )

    # --- the visitor's hand -----------------------------------------------------------------------------------------------

    @property
    def holding(self) -> NDArray[np.bool_]:
        """Which attachments hold the sheet, anchors first, (attachments,)."""
        s = self.simulation
        return np.concatenate([s.attached[0], s.grippers.held[0] > 0 if len(s.grippers) else []]).astype(bool)

    @property
    def places(self) -> NDArray:
        """Where the attachments are [m], (attachments, 3)."""
        return self.simulation.attachment_positions[0]

    def grab(self, place: ArrayLike) -> None:
        """Take the attachment that is nearest to where the visitor holds the sheet: any gripper, or an anchor that holds it."""
        where = within_view(vector("place", place))
        able = np.flatnonzero(self.holding | (np.arange(len(self.places)) >= len(self.simulation.anchors)))
        if len(able):
            self.grab_these([int(able[((self.places[able] - where) ** 2).sum(axis=1).argmin()])], where)

    def grab_these(self, which: Sequence[int], where: NDArray) -> None:
        """Let these attachments follow the visitor's pointer, which is at a position [m], (3,)."""
        self._grabbed = {k: self.places[k] - where for k in which}

    def pull(self, place: ArrayLike) -> None:
        for attachment, away in self._grabbed.items():
            self._dragged[attachment] = within_view(vector("place", place) + away)

    def let_go(self) -> None:
        """The pointer lets go: the policy acts again, and the sheet is still held."""
        self._grabbed, self._dragged = {}, {}

    def drop(self) -> None:
        self._dropped = True

    def held(self) -> NDArray[np.float32]:
        return visible(self.places[self.holding])

    def _steered(self, action: NDArray) -> NDArray:
        """The action with dragged attachments moving to the visitor's positions, as fast as the task allows."""
        if not (self._dragged or self._dropped):
            return action
        task = self.env.task
        moves = action.reshape(task.num_attachments, task.actions_per_attachment).copy()
        drags = np.zeros(moves.shape)
        for attachment, place in self._dragged.items():
            away = place - task.episode["targets"][0, attachment]
            drags[attachment, :3] = within_ball(away / (task.physics.attachment_speed * task.physics.time_step))
        dragged = list(self._dragged)
        moves[dragged, :3] = task.from_world(drags.reshape(1, -1)).reshape(moves.shape)[dragged, :3]
        if self._dropped:
            moves[:, 3:] = 1.0
        return moves.ravel().astype(np.float32)


def judgement(info: Mapping[str, Any], total: float) -> str:
    """A sentence on the last step's ``info`` and the return."""
    if info["failure"]:
        return f"The episode failed: the sheet {FAILED[FAILURES[info['failure']]]}."
    success = "Success" if info["is_success"] else "No success"
    return f"{success}: a score of {info['normalized_performance']:.2f}, and a return of {total:.2f}."


class Replay(Stage):
    """A recording that is shown again: all frames are there, and nothing can be changed."""

    over, patience = True, 2.0

    def __init__(self, recording: Recording, name: str = "recording") -> None:
        super().__init__()
        self.name, self.seed, self.recording = name, 0, recording
        count = len(recording.frames)
        self.about = f"A recording of {recording.title}: {count} frames, {count * recording.time_step:.1f} s."

    def advance(self) -> Frame:
        return self.frame

    def reset(self, seed: int | None = None) -> None:
        """Nothing to do: a recording does not change."""

    def begin_again(self) -> None:
        """Nothing to do: the page goes back to the first frame."""


# --- a race -----------------------------------------------------------------------------------------------------------


RACE, TASK = "race", "ClothDrape-v0"
TITLE = f"Race a policy at {TASK}"
YOU = "you"
SLOWLY = 5.0  # times slower than time itself: the task gives a hand two seconds
APART = 0.95  # between the lanes [m]
OFFSETS = np.array([(0.5 * APART, 0, 0), (-0.5 * APART, 0, 0)], np.float32)  # of the visitor's sheet and of the policy's
CAMERA = Camera(eye=(2.35, -1.55, 1.4), target=(0.05, -0.2, 0.26), vertical_fov=33.0)  # the way is to the right


class Race(Stage):
    """Two environments with the same seed, the visitor's in front.

    Time passes while the visitor drags their sheet, and when they have let go of it: ``drop``.  A pointer moves in the plane of
    the screen, so the visitor says how far and how high; sideways the lane leads the sheet to the middle of the target.

    Args:
        policies: the opponents, by name.  The race starts with the first of those that act most often: the visitor acts as often.

    Raises:
        ValueError: there is no policy.
    """

    drops, patience = True, 12.0
    about = (
        "You in front, a learned policy behind: drag your sheet over the target, and press Let go when it hangs right. Time passes "
        "slowly, and only while you drag."
    )

    def __init__(self, policies: Mapping[str, Policy], seed: int = 0) -> None:
        super().__init__()
        if not policies:
            raise ValueError(f"{TASK} has no learned policy here to race against")
        self.name, self.seed, self.policies = RACE, seed, dict(policies)
        self.choose(min(policies, key=lambda name: getattr(policies[name], "env_kwargs", {}).get("action_repeat", 1)))

    def choose(self, policy: str) -> None:
        """Race against another policy, from the start."""
        self.theirs = EpisodeStage(TASK, self.policies, policy, self.seed)
        # attachments stay where they are, until the visitor moves them
        still = Learnt(lambda env, seen: np.zeros((1, *env.action_space.shape), np.float32), self.theirs.env_kwargs or {})
        self.mine = EpisodeStage(TASK, {YOU: still}, YOU, self.seed)
        self.policy, of = policy, self.mine.recording
        self.recording = Recording(TITLE, of.mesh, SLOWLY * of.time_step, CAMERA, (YOU, policy), of.strained)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        self.seed = self.seed if seed is None else int(seed)
        self._pulled = self._dropped = False
        self.notes.clear()
        for stage in (self.mine, self.theirs):
            stage.reset(self.seed)
        self.recording.frames[:] = [self._look()]

    @property
    def over(self) -> bool:
        return self.mine.over and self.theirs.over

    def advance(self) -> Frame:
        if self.over or not (self._pulled or self._dropped):
            return self.frame
        for stage in (self.mine, self.theirs):
            stage.advance()
        if self.over:
            mine, theirs = (float(stage.info["normalized_performance"]) for stage in (self.mine, self.theirs))
            first = "You win" if mine > theirs else "A draw" if mine == theirs else "The policy wins"
            self.notes["evaluation"] = f"{first}: you score {mine:.2f}, the policy {theirs:.2f}."
        return self._keep(self._look())

    def grab(self, place: ArrayLike) -> None:
        self._pulled = True
        self._from = within_view(vector("place", place)) - OFFSETS[0]
        self.mine.grab_these(np.flatnonzero(self.mine.holding).tolist(), self._from)
        self._way = self.mine.env.task.episode["top"][0] - self.mine.places.mean(axis=0)

    def pull(self, place: ArrayLike) -> None:
        if self._pulled:
            where = within_view(vector("place", place)) - OFFSETS[0]
            share = np.clip((where[1] - self._from[1]) / max(self._way[1], 0.01), 0.0, 1.0)
            where[0] = self._from[0] + share * self._way[0]
            self.mine.pull(where)

    def let_go(self) -> None:
        """The visitor's pointer lets go: the sheet is still held where it is."""
        self._pulled = False
        self.mine.let_go()

    def drop(self) -> None:
        """Open what holds the visitor's sheet: it falls, and is judged."""
        self._dropped = True
        self.mine.drop()

    def held(self) -> NDArray[np.float32]:
        return np.concatenate([stage.held() + offset for stage, offset in zip((self.mine, self.theirs), OFFSETS)])

    def _look(self) -> Frame:
        mine, theirs = self.mine.frame, self.theirs.frame
        return replace(
            mine,
            positions=np.concatenate([mine.positions + OFFSETS[0], theirs.positions + OFFSETS[1]]),
            solids=tuple(
                solid.at(np.add(solid.collider.center, offset))
                for frame, offset in zip((mine, theirs), OFFSETS)
                for solid in frame.solids
            ),
            readings={name: np.concatenate([mine.readings[name], theirs.readings[name]]) for name in mine.readings},
        )

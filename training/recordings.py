"""Recorded episodes: run in batches, kept one by one as they end, and replayed from their first states.

A set is made in the folder ``OUT.part``.  Each episode that has ended is a file there, so that a killed recording loses only the
episodes that were running; when all have ended, they are written in the wanted format, and the whole is renamed to ``OUT``.
"""

from __future__ import annotations

import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import croissant
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from policies import Policy

import clothgym
from clothgym import files
from clothgym.adapters.lerobot import agent_names, agent_positions, named
from clothgym.envs.episode import FAILURES, TaskState

ABOUT, STATES, EPISODES = "recording.json", "states", "episodes"
ADVICE = "record it again"
VERSION = 1  # of the files of episodes
LARGEST_BATCH = 2**32  # bytes of the observations of a batch
OF_A_STEP = ("actions", "rewards", "terminations", "truncations")


@dataclass
class Episode:
    """One episode of T steps.

    Attributes:
        seed: of its reset.
        actions: as given to the environment, (T, numbers), float32.
        rewards, terminations, truncations: of each step, (T,).
        observations: the environment's own by their keys, "observation" if it has but one, (T + 1, ...); the first is the reset's.
        agent_pos: attachments' positions [m] and openings of grippers, (T + 1, numbers).
        infos: numbers of info, (T + 1,) each; the first are those of the reset.
        state: from which it begins, of one environment; None for what is read from a set.
    """

    seed: int
    actions: NDArray
    rewards: NDArray
    terminations: NDArray
    truncations: NDArray
    observations: dict[str, NDArray]
    agent_pos: NDArray
    infos: dict[str, NDArray]
    state: TaskState | None = None

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def success(self) -> bool:
        return bool(self.infos["is_success"][-1])

    def summary(self) -> dict[str, Any]:
        """The episode in the list of the set's metadata."""
        failure = FAILURES[int(self.infos["failure"][-1])]
        return {
            "seed": self.seed, "length": len(self), "return": float(self.rewards.sum()),
            "success": self.success, "failure": failure,
            "normalized_performance": float(self.infos["normalized_performance"][-1]),
        }  # fmt: skip

    def named(self, obs_mode: str) -> dict[str, NDArray]:
        """Observations by LeRobot's keys, (T + 1, ...) each."""
        return named(obs_mode, self.observations, self.agent_pos)


# --- what is recorded ---------------------------------------------------------------------------------------------------------


def make_batch(about: dict[str, Any], num_envs: int, threads: int | None = None) -> Any:
    """The batch of environments that a recording describes; an environment that is over waits for its next seed."""
    kwargs = about["env_kwargs"] | {"obs_mode": about["obs_mode"]}
    env = gym.make_vec(about["env"], num_envs=num_envs, autoreset_mode="Disabled", threads=threads, **kwargs)
    task = env.unwrapped.task  # type: ignore[attr-defined]
    space = env.single_observation_space
    boxes = space.spaces.values() if isinstance(space, gym.spaces.Dict) else (space,)
    size = sum(int(np.prod(box.shape)) * box.dtype.itemsize for box in boxes) * (task.most_steps() + 1)
    if size * num_envs > LARGEST_BATCH:
        raise ValueError(
            f"--num-envs {num_envs}: their observations need {size * num_envs / 2**30:.0f} GB of memory; give at most "
            f"{max(1, LARGEST_BATCH // size)}, or smaller pictures"
        )
    return env


def describe(about: dict[str, Any], env: Any) -> dict[str, Any]:
    """A recording's arguments with what the environment and the machine add."""
    task = env.unwrapped.task
    return about | {
        "task": env.unwrapped.task_description,
        "fps": env.unwrapped.metadata["render_fps"],
        "agent_pos": agent_names(task),
        "observation_keys": list(getattr(env.single_observation_space, "spaces", ())),
        "observation_slices": {name: [at.start, at.stop] for name, at in task.observation_slices.items()},
        "versions": {name: metadata.version(name) for name in ("numpy", "numba", "gymnasium")}
        | {"clothgym": clothgym.__version__, "python": platform.python_version()},
        "machine": f"{platform.system()}, {platform.machine()}",
    }


class Journal:
    """The episodes that have ended, in the folder ``OUT.part``.

    Args:
        out: folder of the set.
        about: arguments of the recording, JSON.
        most: bytes that the folder may take, with the set that is made of it.

    Raises:
        ValueError: there is another recording in the folder, or the set exists.
    """

    def __init__(self, out: Path, about: dict[str, Any], most: float) -> None:
        self.folder, self.most = out.with_name(out.name + ".part"), most
        if out.exists():
            raise ValueError(f"--out {out}: exists; name another folder, or remove it")
        (self.folder / EPISODES).mkdir(parents=True, exist_ok=True)
        (self.folder / STATES).mkdir(exist_ok=True)
        path = self.folder / ABOUT
        if path.exists():
            before = files.read_json(path, "recording", f"remove {self.folder}")
            for name in about:
                if before.get(name) != about[name]:
                    raise ValueError(
                        f"{name}={about[name]!r}: the recording begun in {self.folder} has {before.get(name)!r}; "
                        "give the same arguments, or remove that folder"
                    )
        else:
            files.write_json(path, about)
        self.ended = {int(one.stem): self._success(one) for one in sorted((self.folder / EPISODES).glob("[0-9]*.npz"))}
        self.size = sum(one.stat().st_size for one in self.folder.rglob("*") if one.is_file())

    def _success(self, path: Path) -> bool:
        return bool(files.read_arrays(path, "recorded episode", VERSION, ADVICE)["info is_success"][-1])

    def add(self, episode: Episode, whole: bool) -> None:
        """Keep an episode, or of one that will be left out only that it failed.

        Raises:
            OSError: the folder would become larger than it may.
        """
        arrays = {"info is_success": episode.infos["is_success"]}
        if whole:
            arrays = {f"observation {name}": part for name, part in episode.observations.items()}
            arrays |= {f"info {name}": part for name, part in episode.infos.items()} | {"agent_pos": episode.agent_pos}
            arrays |= {name: getattr(episode, name) for name in OF_A_STEP}
            assert episode.state is not None
            episode.state.save(self.folder / STATES / f"{episode.seed}.npz")
        pictures = any(part.dtype == np.uint8 for part in episode.observations.values())
        path = self.folder / EPISODES / f"{episode.seed}.npz"
        files.write_arrays(path, "recorded episode", VERSION, arrays, compressed=pictures)
        self.ended[episode.seed] = episode.success
        self.size += path.stat().st_size + ((self.folder / STATES / path.name).stat().st_size if whole else 0)
        if 2 * self.size > self.most:
            raise OSError(
                f"{self.folder} has {self.size / 1e9:.2f} GB after {len(self.ended)} episodes, and the set needs as much again: "
                f"more than the {self.most / 1e9:g} GB of --max-gb; give more and go on, or record fewer or smaller episodes"
            )

    def read(self, seed: int) -> Episode:
        """An episode that was kept whole."""
        arrays = files.read_arrays(self.folder / EPISODES / f"{seed}.npz", "recorded episode", VERSION, ADVICE)
        parts: dict[str, dict[str, NDArray]] = {"observation": {}, "info": {}}
        for key, array in arrays.items():
            kind, _, name = key.partition(" ")
            if name:
                parts[kind][name] = array
        own = {name: arrays[name] for name in OF_A_STEP}
        return Episode(seed, **own, observations=parts["observation"], agent_pos=arrays["agent_pos"], infos=parts["info"])


# --- the batch ------------------------------------------------------------------------------------------------------------------


class Lanes:
    """The environments of a batch, each with an episode of its own, and what has been recorded of them."""

    def __init__(self, env: Any) -> None:
        self.env, self.task = env, env.unwrapped.task
        self.seeds = np.full(env.num_envs, -1)  # of the episode that runs in each; -1 where none does
        self.steps = np.zeros(env.num_envs, int)
        self.states: list[TaskState | None] = [None] * env.num_envs
        self.generators = [np.random.default_rng(0)] * env.num_envs
        self.strengths = np.zeros(env.num_envs)  # of the disturbance of each episode's actions, relative to the largest
        self._parts: dict[str, NDArray] = {}
        self._everyone = np.arange(env.num_envs)
        self.observations: Any = None

    def begin(self, lanes: NDArray, seeds: list[int]) -> None:
        """Begin episodes in some environments."""
        mask = np.zeros(len(self.seeds), bool)
        mask[lanes] = True
        all_seeds: list[int | None] = [None] * len(mask)
        for lane, seed in zip(lanes.tolist(), seeds):
            all_seeds[lane] = seed
            self.generators[lane] = np.random.default_rng([1, seed])  # another one than that of the environment
            self.strengths[lane] = self.generators[lane].uniform()
        self.observations, info = self.env.reset(seed=all_seeds, options={"reset_mask": mask})
        state = self.env.unwrapped.get_state()
        for lane, seed in zip(lanes.tolist(), seeds):
            self.seeds[lane], self.steps[lane], self.states[lane] = seed, 0, state.branch(1, lane)
        self._write(lanes, self.observations, info)

    def _write(self, lanes: NDArray, observations: Any, info: dict[str, Any], more: dict[str, NDArray] | None = None) -> None:
        """Write what an environment has after each lane's step into the arrays of the batch."""
        given = observations if isinstance(observations, dict) else {"observation": observations}
        parts = {f"observation {name}": part for name, part in given.items()} | {"agent_pos": agent_positions(self.task)}
        parts |= {f"info {name}": part for name, part in info.items() if not name.startswith("_")} | (more or {})
        for name, part in parts.items():
            if name not in self._parts:
                self._parts[name] = np.zeros((len(self.seeds), self.task.most_steps() + 1, *part.shape[1:]), part.dtype)
            self._parts[name][lanes, self.steps[lanes]] = part[lanes]

    def _act(self, policy: Policy | None, noise: float) -> NDArray:
        """Actions of all; what is random comes from each episode's own generator, and does not depend on the others."""
        shape = self.task.single_action_space.shape
        if policy is None:
            return np.stack([one.uniform(-1, 1, shape) for one in self.generators]).astype(np.float32)
        actions = policy(self.env, self.observations)
        if noise:
            actions = actions + np.stack(
                [noise * level * one.standard_normal(shape) for level, one in zip(self.strengths, self.generators)]
            )
        return np.clip(actions, -1, 1).astype(np.float32)

    def step(self, policy: Policy | None, noise: float) -> list[Episode]:
        """One step of all; returns the episodes that it has ended.

        policy: None for random actions.  noise: largest standard deviation of the disturbance of actions; each episode draws its
        own.
        """
        actions = self._act(policy, noise)
        running = np.flatnonzero(self.seeds >= 0)
        self.observations, rewards, terminated, truncated, info = self.env.step(actions)
        given = dict(zip(OF_A_STEP, (actions, rewards, terminated, truncated)))
        self.steps[running] += 1
        self._write(running, self.observations, info, given)
        ended = running[(terminated | truncated)[running]]
        return [self._end(lane) for lane in ended.tolist()]

    def _end(self, lane: int) -> Episode:
        """The episode of an environment, which is then free."""
        steps, seed, self.seeds[lane] = self.steps[lane], int(self.seeds[lane]), -1
        parts: dict[str, dict[str, NDArray]] = {"observation": {}, "info": {}}
        for key, array in self._parts.items():
            kind, _, name = key.partition(" ")
            if name:
                parts[kind][name] = array[lane, : steps + 1].copy()
        own = {name: self._parts[name][lane, 1 : steps + 1].copy() for name in OF_A_STEP}
        return Episode(
            seed, **own, observations=parts["observation"], agent_pos=self._parts["agent_pos"][lane, : steps + 1].copy(),
            infos=parts["info"], state=self.states[lane],
        )  # fmt: skip


def chosen(ended: dict[int, bool], first: int, episodes: int, drop_failed: bool) -> list[int] | None:
    """Seeds of the episodes of the set, the first that will do; None while one of them has not ended.

    ended: whether each episode that has ended was a success, by its seed.
    """
    if not drop_failed:
        wanted = list(range(first, first + episodes))
        return wanted if all(seed in ended for seed in wanted) else None
    found, seed = [], first
    while seed in ended and len(found) < episodes:
        found += [seed] if ended[seed] else []
        seed += 1
    return found if len(found) == episodes else None


def record(env: Any, policy: Policy | None, journal: Journal, about: dict[str, Any], bar: Any) -> list[int]:
    """Run the episodes that are missing; returns the seeds of those of the set, in order.

    Episodes do not depend on each other, so the set is the same whatever the batch, and whether it was interrupted: with a policy
    that acts alike in batches of any size.

    policy: None for random actions.

    Raises:
        ValueError: with failed episodes left out, ten times as many episodes do not hold enough successes.
        OSError: the disk is full, or the folder larger than it may be.
    """
    first, episodes, drop = about["seed"], about["episodes"], about["failed"] == "drop"
    lanes, after = Lanes(env), first
    while (seeds := chosen(journal.ended, first, episodes, drop)) is None:
        free, begun = np.flatnonzero(lanes.seeds < 0), []
        while len(begun) < len(free) and (drop or after < first + episodes):
            if after not in journal.ended:
                begun.append(after)
            after += 1
        if after > first + 10 * episodes + env.num_envs:
            good = sum(journal.ended.values())
            raise ValueError(
                f"{good} of {len(journal.ended)} episodes were successes, {episodes} are wanted: choose another policy, or keep "
                "failed episodes with --failed keep"
            )
        if begun:
            # a batch steps only when all of it has been reset: at first the spare environments repeat the last episode
            spare = len(free) - len(begun) if lanes.observations is None else 0
            lanes.begin(free[: len(begun) + spare], begun + begun[-1:] * spare)
            lanes.seeds[free[len(begun) :]] = -1
        for episode in lanes.step(policy, about["noise"]):
            journal.add(episode, whole=episode.success or not drop)
            bar.update(episode.success or not drop)
    return seeds


# --- a set --------------------------------------------------------------------------------------------------------------------


def finish(journal: Journal, about: dict[str, Any], seeds: list[int], write: Any, out: Path) -> None:
    """Write the set of these episodes, and rename it to its place.

    write: of a format, called with the folder, what the recording is, and the episodes.
    """
    made = journal.folder / "set"
    shutil.rmtree(made, ignore_errors=True)  # of an interrupted run
    (made / STATES).mkdir(parents=True)
    summaries: list[dict[str, Any]] = []

    def episodes() -> Iterator[Episode]:
        for index, seed in enumerate(seeds):
            episode = journal.read(seed)
            shutil.copyfile(journal.folder / STATES / f"{seed}.npz", made / STATES / f"{index}.npz")
            summaries.append(episode.summary())
            yield episode

    write(made, about, episodes())
    files.write_json(made / ABOUT, about | {"list": summaries})
    croissant.describe(made, about)
    made.replace(out)
    shutil.rmtree(journal.folder)


def read_about(folder: Path) -> dict[str, Any]:
    """What a finished set says of itself.

    Raises:
        FileNotFoundError, ValueError: it is no set, or damaged.
    """
    return files.read_json(folder / ABOUT, "data set of training/record.py", ADVICE)


def replays(folder: Path, index: int, episode: dict[str, NDArray]) -> bool:
    """Whether an episode of a set, run again from its first state, gives the recorded rewards and observations to the bit.

    episode: as a format's ``read`` gives it.
    """
    about = read_about(folder)
    kwargs = about["env_kwargs"] | {"obs_mode": about["obs_mode"]}
    env: Any = gym.make(about["env"], disable_env_checker=True, **kwargs).unwrapped
    env.set_state(TaskState.load(folder / STATES / f"{index}.npz"))
    seen = [name for name in episode if name not in ("actions", "rewards")]
    observation = env.task.observed.one(0)
    for step, action in enumerate(episode["actions"]):
        again = named(about["obs_mode"], observation, agent_positions(env.task)[0])
        if not all(np.array_equal(episode[name][step], again[name]) for name in seen):
            return False
        observation, reward, *_ = env.step(action)
        if reward != episode["rewards"][step]:
            return False
    return True

"""What can be shown, by name: scenes, environments with their policies, the race, and a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from numpy.typing import NDArray

from clothgym import policies
from clothgym.adapters import runs
from clothgym.checks import known
from clothgym.playground.episode import RACE, TASK, TITLE, EpisodeStage, Learnt, Policy, Race, Replay
from clothgym.playground.recording import Recording
from clothgym.playground.scenes import SCENES, TITLES, titled
from clothgym.playground.stage import SceneStage, Stage
from clothgym.registration import ACTORS, ENVIRONMENTS, checked_id

REPLAY = "recording"


class Gallery:
    """What can be shown, by name.

    Args:
        recording: to show again.
        policies: policies for each environment besides its expert, by id and then by name.
        actor: who acts at first in an environment without such a policy.

    Attributes:
        titles: names by title.
    """

    def __init__(
        self,
        recording: Recording | None = None,
        policies: Mapping[str, Mapping[str, Policy]] | None = None,
        actor: str = "expert",
    ) -> None:
        self.recording, self.policies, self.actor = recording, policies or {}, actor
        self.titles = {title: name for name, title in TITLES.items()} | {TITLE: RACE}
        for env_id in ENVIRONMENTS:
            self.titles[env_id] = env_id
            for name in committed_policies(env_id):
                learner = name.removeprefix("learned, ")
                self.titles[f"{env_id}, {titled(learner)}"] = f"{env_id}/{learner}"
        if recording is not None:
            self.titles = {f"recording of {recording.title}": REPLAY} | self.titles

    def checked(self, name: str) -> str:
        """The name without its namespace.

        Raises:
            ValueError: there is nothing of that name.
        """
        bare = name.removeprefix("clothgym:")
        if bare in self.titles.values():
            return bare
        if ":" not in bare and bare not in gym.registry:
            known("scene or environment", bare, self.titles.values())
        # an id that somebody else has registered, which the page lists from now on
        bare = checked_id(bare)
        self.titles = {**self.titles, bare: bare}
        return bare

    def open(self, name: str) -> Stage:
        """A new stage of that name."""
        name = self.checked(name)
        if name == REPLAY and self.recording is not None:
            return Replay(self.recording)
        if name in SCENES:
            return SceneStage(name)
        if name == RACE:
            return Race(committed_policies(TASK))
        env_id, _, learner = name.partition("/")
        own = self.policies.get(env_id, {})
        actor = f"learned, {learner}" if learner else next(iter(own), self.actor)
        return EpisodeStage(env_id, {**committed_policies(env_id), **own}, actor, name=name)


def policies_of(names: Sequence[str], start: str) -> tuple[str, dict[str, dict[str, Policy]]]:
    """The initial scene, by default the first run's environment; and the runs' policies, by environment and folder.

    names: the runs' folders; actors of all environments are ignored.

    Raises:
        ImportError: Stable-Baselines3 is missing; the message says how to get it.
        FileNotFoundError, ValueError: a folder without a run that can be used here.
    """
    # check all of them before loading the first, which takes seconds
    configs = {name: runs.read_config(Path(name)) for name in names if name not in ACTORS}
    found: dict[str, dict[str, Policy]] = {}
    for run, config in configs.items():
        env_id = config["env"]
        act = runs.learned(Path(run), env_id)
        own = found.setdefault(env_id, {})
        name = Path(run).resolve().name
        # runs of the same name are distinguished by their full paths
        own[name if name not in own else str(Path(run).resolve())] = Learnt(act, config["env_kwargs"])
        start = start or env_id
    return start, found


@cache
def committed_policies(env_id: str) -> dict[str, Policy]:
    """The policies that come with the project, by name; without those whose steps are too long to watch."""
    found: dict[str, Policy] = {}
    for learner in policies.available().get(env_id, []):
        policy = policies.load(env_id, learner)
        # a sheet settles before the visitor's eyes
        kwargs = {name: value for name, value in policy.about["env_kwargs"].items() if name != "settling"}
        if "action_mode" not in kwargs:
            found[f"learned, {learner}"] = Learnt(partial(_decided, policy), kwargs)
    return found


def _decided(policy: policies.Policy, env: Any, observations: Any) -> NDArray:
    return policy(observations)

"""A race: the visitor plays a task by hand beside a policy that has learned it, from the same start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import vector
from clothgym.playground.episode import EpisodeStage, Policy
from clothgym.playground.recording import Frame, Recording
from clothgym.playground.sheets import within_view
from clothgym.playground.stage import Stage
from clothgym.render import Camera

RACE, TASK = "race", "ClothDrape-v0"
TITLE = f"Race a policy at {TASK}"
YOU = "you"
SLOWLY = 2.0  # times slower than time itself: the task gives a hand two seconds
APART = 0.95  # between the lanes [m]
CAMERA = Camera(eye=(2.35, -1.55, 1.4), target=(0.05, -0.2, 0.26), vertical_fov=33.0)  # the way is to the right


class Race(Stage):
    """Two environments with the same seed, the visitor's in front.

    Time passes while the visitor drags their sheet, and when they have let go of it: ``drop``.  A pointer moves in the plane of
    the screen, so the visitor says how far and how high; sideways the lane leads the sheet to the middle of the target.

    Args:
        policies: what is raced against, by name; the first one at first.

    Raises:
        ValueError: there is no policy.
    """

    def __init__(self, policies: Mapping[str, Policy], seed: int = 0) -> None:
        super().__init__()
        if not policies:
            raise ValueError(f"{TASK} has no learned policy here to race against")
        self.name, self.seed, self.policies = RACE, seed, dict(policies)
        self.about = (
            "**You** in front, the learned policy behind: lay your sheet over the target. Drag it: time passes slowly while "
            "you do. **Let go** when it hangs right."
        )
        self.choose(next(iter(policies)))

    def choose(self, policy: str) -> None:
        """Race against another policy, from the start."""
        self.policy = policy
        self.theirs = EpisodeStage(TASK, self.policies, policy, self.seed)
        self.mine = EpisodeStage(TASK, {YOU: Still(self.theirs.env_kwargs)}, YOU, self.seed)
        self.settings = self.mine.settings
        of = self.mine.recording
        labels = (YOU, policy)
        self.recording = Recording(TITLE, of.mesh, SLOWLY * of.time_step, CAMERA, labels, of.strained)
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
        if self.over or not (self._pulled or self._dropped or not self._holding):
            return self.frame
        for stage in (self.mine, self.theirs):
            stage.advance()
        if self.over:
            self.notes["evaluation"] = self._judged()
        return self._keep(self._look())

    def change(self, **changes: Any) -> None:
        raise ValueError("a race is run as it is: choose a scene or an environment to change settings")

    # --- the visitor's hand -----------------------------------------------------------------------------------------------

    @property
    def _holding(self) -> list[int]:
        """The visitor's attachments that hold the sheet."""
        return [k for k, attachment in enumerate(self.mine.attachments()) if attachment.holds]

    def grab(self, place: ArrayLike) -> None:
        self._pulled = True
        self._from = within_view(vector("place", place)) - self._offsets[0]
        self.mine.grab_these(self._holding, self._from)
        held = [attachment.position for attachment in self.mine.attachments()]
        self._way = self.mine.env.task.episode["top"][0] - np.mean(held, axis=0)

    def pull(self, place: ArrayLike) -> None:
        if self._pulled:
            where = within_view(vector("place", place)) - self._offsets[0]
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
        for attachment in self._holding:
            self.mine.hold(attachment, False)

    # --- what is seen -------------------------------------------------------------------------------------------------------

    @property
    def _offsets(self) -> NDArray[np.float32]:
        return np.array([(0.5 * APART, 0, 0), (-0.5 * APART, 0, 0)], np.float32)

    def _look(self) -> Frame:
        mine, theirs = self.mine.frame, self.theirs.frame
        return replace(
            mine,
            positions=np.concatenate([mine.positions + self._offsets[0], theirs.positions + self._offsets[1]]),
            stiffness=np.concatenate([mine.stiffness, theirs.stiffness]),
            touching=np.concatenate([mine.touching, theirs.touching]),
            solids=tuple(
                solid.at(np.add(solid.collider.center, offset))
                for frame, offset in zip((mine, theirs), self._offsets)
                for solid in frame.solids
            ),
            readings={name: np.concatenate([mine.readings[name], theirs.readings[name]]) for name in mine.readings},
        )

    def _judged(self) -> str:
        scores = [float(stage.info["normalized_performance"]) for stage in (self.mine, self.theirs)]
        first = "You win" if scores[0] > scores[1] else "A draw" if scores[0] == scores[1] else "The policy wins"
        return f"**{first}: {scores[0]:.2f} to {scores[1]:.2f}.** Yours: {self.mine.notes['evaluation']}"

    def pinned(self) -> NDArray[np.float32]:
        held = [
            attachment.position + offset
            for stage, offset in zip((self.mine, self.theirs), self._offsets)
            for attachment in stage.attachments()
            if attachment.holds
        ]
        return np.array(held, np.float32).reshape(-1, 3)


class Still:
    """Keeps attachments where they are, in the environment in which a policy was trained; the visitor moves them.

    Attributes:
        env_kwargs: of that environment.
    """

    def __init__(self, env_kwargs: Mapping[str, Any]) -> None:
        self.env_kwargs = dict(env_kwargs)

    def __call__(self, env: Any, observation: Any) -> NDArray:
        return np.zeros(env.action_space.shape, np.float32)

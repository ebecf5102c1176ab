"""The random generators from which the environments of a batch draw their episodes, one each, and their seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from clothgym.checks import members

UNKNOWN = -1  # stands for the seed of a generator that was given, as in Gymnasium


class Generators(list[np.random.Generator]):
    """Generators of a batch, by environment.

    Attributes:
        seeds: their seeds, (num_envs,); None for one that is still to be made.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__([np.random.default_rng(0)] * num_envs)
        self.seeds = np.full(num_envs, None, object)

    def of(self, env: int, seed: int | None = None) -> np.random.Generator:
        """An environment's: a new one where a seed is given or none has been made yet."""
        if seed is not None or self.seeds[env] is None:
            self[env], self.seeds[env] = seeding.np_random(seed)
        return self[env]

    def put(self, generators: Any) -> None:
        """Take these, whose seeds are not known, in place of all.

        Raises:
            ValueError: another number of them, or something else.
        """
        members("np_random", generators, np.random.Generator, "NumPy's generators, one for each environment")
        if len(generators) != len(self):
            raise ValueError(f"np_random: {len(generators)} generators for {len(self)} environments: give one each")
        self[:], self.seeds[:] = generators, UNKNOWN

    def kept(self, envs: NDArray) -> list[tuple[Any, ...]]:
        """These environments' generators as they are now, for ``put_back``."""
        return [(env, self[env], self[env].bit_generator.state, self.seeds[env]) for env in envs.tolist()]

    def put_back(self, kept: list[tuple[Any, ...]]) -> None:
        """Undo what has been drawn since."""
        for env, generator, state, seed in kept:
            self[env], generator.bit_generator.state, self.seeds[env] = generator, state, seed

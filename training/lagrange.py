"""PPO with a Lagrange multiplier: dual ascent on the price of a step that breaks the constraint.

The learner maximizes ``return - multiplier * cost``; after each rollout the multiplier moves by ``rate * (J - limit)`` with the
mean cost J of the episodes that ended in it, by no more than that of an excess of ``CLIP``, and never below zero (Ray, Achiam and
Amodei 2019, Benchmarking Safe Exploration, "PPO-Lagrangian", here without a critic of the cost's own).  The price is the
environment's own ``cost_penalty``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from clothgym import files
from clothgym.checks import not_negative

FILE = "multiplier.json"
CLIP = 10.0  # an untrained policy breaks the constraint all the time: its excess must not freeze it before it has learned to move


def known_multiplier(path: Path) -> float:
    """The multiplier that a run has come to.

    Raises:
        ValueError: the file is damaged.
    """
    advice = "remove it to begin with the price that the configuration names"
    content = files.read_json(path, "multiplier", advice)
    with files.naming(path, "multiplier", advice):
        return not_negative("multiplier", content.get("multiplier"))


class LagrangeMultiplier(BaseCallback):
    """Moves ``cost_penalty`` of the training environments.

    Args:
        folder: of the run; the multiplier is kept there, so that a resumed run goes on with it.
        cost_limit: mean cost of an episode that is allowed.
        rate: of the dual ascent, per unit of cost.
        start: the multiplier at first.
        most: its upper bound.
    """

    def __init__(self, folder: Path, cost_limit: float, rate: float, start: float = 0.0, most: float = 10.0) -> None:
        super().__init__()
        self.path = folder / FILE
        self.cost_limit, self.rate, self.most = cost_limit, rate, most
        self.multiplier = known_multiplier(self.path) if self.path.exists() else start
        self.costs: list[float] = []

    def _on_training_start(self) -> None:
        self.training_env.set_attr("cost_penalty", self.multiplier)

    def _on_step(self) -> bool:
        self.costs += [self.locals["infos"][env]["episode_cost"] for env in np.flatnonzero(self.locals["dones"])]
        return True

    def _on_rollout_end(self) -> None:
        if self.costs:
            mean = float(np.mean(self.costs))
            self.multiplier = float(np.clip(self.multiplier + self.rate * min(mean - self.cost_limit, CLIP), 0, self.most))
            self.training_env.set_attr("cost_penalty", self.multiplier)
            self.logger.record("lagrange/episode_cost", mean)
            self.logger.record("lagrange/multiplier", self.multiplier)
            files.write_json(self.path, {"multiplier": self.multiplier})
        self.costs = []

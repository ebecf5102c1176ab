"""Somebody else's task: bring a hanging towel's center of area to a height that is drawn."""

import gymnasium as gym
import numpy as np

from clothgym import Material, grid
from clothgym.envs import ClothEnv, ClothVectorEnv, Observation, Physics, Task

TOWEL, START, NEAR = grid(9, 9, 0.4, 0.4), 0.3, 0.05  # heights in [m]


class HangTowel(Task):
    physics = Physics(
        TOWEL, Material.preset("wool"), 1 / 30, "semi_implicit_euler", 60, attachment_speed=0.5, anchors=TOWEL.corners[2:]
    )
    acting_steps = 40
    observations = (Observation("goal", "its height", (), "m"), Observation("way", "up to it", (), "m", function=lambda t: t.way()))

    def remembers(self):
        return [("goal", float)]

    def begin(self, env, rng, options):
        self.episode["goal"][env] = rng.uniform(0.5, 0.7)
        x, y, ripple = TOWEL.rest_positions.T + rng.normal(scale=1e-3, size=(3, 81)) * [[0], [0], [1]]
        return np.stack([x, ripple, START + y], axis=1)

    def way(self):
        return self.episode["goal"] - self.centers()[:, 2]

    def performance(self):
        return 1 - abs(self.way()) / (self.episode["goal"] - START)

    def success(self):
        return abs(self.way()) < NEAR


class HangTowelEnv(ClothEnv):
    task_class = HangTowel


class HangTowelVectorEnv(ClothVectorEnv):
    task_class = HangTowel


gym.register("HangTowel-v0", entry_point="hang_towel:HangTowelEnv", vector_entry_point="hang_towel:HangTowelVectorEnv")

"""Frames a second of the renderer on one core: small ones of a batch, as learning from pixels takes them, and large single ones.

python benchmarks/rendering.py
"""

from __future__ import annotations

import time

import gymnasium as gym
import numpy as np

from clothgym.envs.pictures import draw, renderer_of
from clothgym.registration import ENVIRONMENTS

KINDS = {"84 x 84, a batch of 16": (84, 1), "480 x 480, antialiased": (480, 2)}  # pixels of a side, samples a pixel and way
MOMENTS, ROUNDS = 4, 7


def main() -> None:
    costs: dict[str, dict[str, list[float]]] = {env_id: {kind: [] for kind in KINDS} for env_id in ENVIRONMENTS}
    for env_id in ENVIRONMENTS:
        env = gym.make_vec(f"clothgym:{env_id}", num_envs=16, threads=1)
        env.reset(seed=0)
        task = env.unwrapped.task
        renderers = {kind: renderer_of(task, size, size, samples) for kind, (size, samples) in KINDS.items()}
        for _ in range(MOMENTS):
            for _ in range(task.acting_steps // (MOMENTS + 1)):
                env.step(env.unwrapped.expert_actions())
            for kind, renderer in renderers.items():
                envs = range(16) if renderer.width < 100 else range(4)
                draw(task, renderer, "rgb_array", envs)
                for _ in range(ROUNDS):
                    begun = time.perf_counter()
                    draw(task, renderer, "rgb_array", envs)
                    costs[env_id][kind].append((time.perf_counter() - begun) / len(envs))
        env.close()
    print("| frames/s on one core | " + " | ".join(KINDS) + " |\n| --- |" + " --- |" * len(KINDS))
    for env_id, kinds in costs.items():
        print(f"| `{env_id}` | " + " | ".join(f"{1 / np.median(seconds):,.0f}" for seconds in kinds.values()) + " |", flush=True)


if __name__ == "__main__":
    main()

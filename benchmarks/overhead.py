"""What everything that is not physics costs: observation, reward, evaluation, resets and the Stable-Baselines3 adapter.

    python benchmarks/overhead.py                    # prints, and writes benchmarks/results/overhead.json
    python benchmarks/overhead.py ClothDrape-v0      # some environments only: prints

One thread; random actions over whole episodes, resets included.  The time inside ``Simulation.step`` is taken off.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import gymnasium as gym
import numpy as np

from clothgym.adapters.sb3 import make_sb3_vec_env
from clothgym.lab.bench import machine
from clothgym.registration import ENVIRONMENTS
from clothgym.simulation import Simulation

RESULTS = Path(__file__).parent / "results" / "overhead.json"


class Stopwatch:
    """Adds up the time spent in a simulation's steps [s]."""

    def __init__(self, simulation: Simulation) -> None:
        self.seconds = 0.0
        self._step = simulation.step
        simulation.step = self.step  # type: ignore[method-assign]

    def step(self, n: int = 1) -> None:
        begun = time.perf_counter()
        self._step(n)
        self.seconds += time.perf_counter() - begun


def batch(env_id: str, num_envs: int, steps: int) -> tuple[float, float]:
    """Microseconds per environment step: beside the physics, and of the physics."""
    env = make_sb3_vec_env(env_id, num_envs, seed=0, threads=1)
    rng = np.random.default_rng(0)
    env.reset()
    # where an action lets go, it does in a step of a hundred, so that the episodes' ends spread over time
    actions = rng.uniform(-1, 0.81, (steps, num_envs, *env.action_space.shape)).astype(np.float32)
    for action in actions[:110]:
        env.step(action)
    watch = Stopwatch(env.env.task.simulation)
    begun = time.perf_counter()
    for action in actions:
        env.step(action)
    total = time.perf_counter() - begun
    per_step = 1e6 / (steps * num_envs)
    return (total - watch.seconds) * per_step, watch.seconds * per_step


def single(env_id: str, steps: int) -> tuple[float, float]:
    """The same for ``gym.make``."""
    env = gym.make(f"clothgym:{env_id}")
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    watch = Stopwatch(env.unwrapped.task.simulation)
    actions = rng.uniform(-1, 0.81, (steps, *env.action_space.shape)).astype(np.float32)
    begun = time.perf_counter()
    for action in actions:
        if env.step(action)[2]:
            env.reset()
    total = time.perf_counter() - begun
    return (total - watch.seconds) / steps * 1e6, watch.seconds / steps * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description="What everything that is not physics costs.")
    parser.add_argument("ids", nargs="*", choices=[*ENVIRONMENTS, []], metavar="ID", help="environments; all by default")
    chosen = parser.parse_args().ids
    rows = []
    for env_id in chosen or ENVIRONMENTS:
        for envs in (1, 64, 256):
            measured = [single(env_id, 1500) if envs == 1 else batch(env_id, envs, 250) for _ in range(3)]
            beside, physics = (round(float(value), 2) for value in np.median(measured, axis=0))
            rows.append({"environment": env_id, "envs": envs, "beside physics [us]": beside, "physics [us]": physics})
            print(f"{env_id}, {envs:4d}: {beside:7.1f} us beside the physics, {physics:7.1f} us of physics, per environment step")
    if not chosen:
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

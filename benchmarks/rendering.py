"""Pictures a second on one core: what environments observe, 64 x 64 of a batch of 256; and frames of the renderer for films.

python benchmarks/rendering.py                      # the table, and benchmarks/results/rendering.json
python benchmarks/rendering.py --films              # frames of the renderer too

At moments of the scripted expert's episodes; modes in turn, the median of rounds; seconds of the processor, on one thread.  The
time is that from a state to what ``step`` returns: where solids and grippers are, the picture, and the copy that goes out.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from clothgym.envs.observing import PICTURES
from clothgym.envs.pictures import draw, renderer_of
from clothgym.registration import ENVIRONMENTS

OUT = Path(__file__).parent / "results" / "rendering.json"
KINDS = {"84 x 84, a batch of 16": (84, 1), "480 x 480, antialiased": (480, 2)}  # pixels of a side, samples a pixel and way
MOMENTS, ROUNDS = 4, 7
NUM_ENVS, SIZE = 256, 64


def moments_of(env: Any) -> Any:
    """Stop at some moments of the expert's episodes."""
    task = env.unwrapped.task
    env.reset(seed=0)
    for _ in range(MOMENTS):
        for _ in range(task.acting_steps // (MOMENTS + 1)):
            env.step(env.unwrapped.expert_actions())
        yield task


def observed(env_id: str) -> dict[str, float]:
    """Seconds that an environment's observation adds to a step, by mode."""
    modes = ("keypoints", *PICTURES)
    model = gym.make_vec(f"clothgym:{env_id}", num_envs=NUM_ENVS, threads=1)
    particles = gym.make_vec(f"clothgym:{env_id}", num_envs=NUM_ENVS, threads=1, obs_mode="particles")
    kwargs: dict[str, Any] = {"num_envs": NUM_ENVS, "threads": 1, "image_size": SIZE}
    envs = {mode: gym.make_vec(f"clothgym:{env_id}", obs_mode=mode, **kwargs) for mode in modes}
    envs["particles"] = particles
    seconds: dict[str, list[float]] = {mode: [] for mode in envs}
    particles.reset(seed=0)
    for _ in moments_of(model):
        state = model.unwrapped.get_state()
        for mode, env in envs.items():
            if mode != "particles":
                env.unwrapped.set_state(state)
        for _ in range(ROUNDS):
            for mode, env in envs.items():
                observer = env.unwrapped.task.observed
                observer.begun(np.arange(NUM_ENVS))
                begun = time.thread_time()
                observer.batch()
                seconds[mode].append((time.thread_time() - begun) / NUM_ENVS)
    return {mode: float(np.median(each)) for mode, each in seconds.items()}


def films() -> None:
    costs: dict[str, dict[str, list[float]]] = {env_id: {kind: [] for kind in KINDS} for env_id in ENVIRONMENTS}
    for env_id in ENVIRONMENTS:
        env = gym.make_vec(f"clothgym:{env_id}", num_envs=16, threads=1)
        renderers = {}
        for task in moments_of(env):
            renderers = renderers or {kind: renderer_of(task, size, size, samples) for kind, (size, samples) in KINDS.items()}
            for kind, renderer in renderers.items():
                envs = range(16) if renderer.width < 100 else range(4)
                draw(task, renderer, "rgb_array", envs)
                for _ in range(ROUNDS):
                    begun = time.thread_time()
                    draw(task, renderer, "rgb_array", envs)
                    costs[env_id][kind].append((time.thread_time() - begun) / len(envs))
        env.close()
    print("| frames/s on one core | " + " | ".join(KINDS) + " |\n| --- |" + " --- |" * len(KINDS))
    for env_id, kinds in costs.items():
        print(f"| `{env_id}` | " + " | ".join(f"{1 / np.median(seconds):,.0f}" for seconds in kinds.values()) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--films", action="store_true", help="also frames of the renderer for films")
    parser.add_argument("--ids", nargs="+", default=list(ENVIRONMENTS), help="environments")
    options = parser.parse_args()
    found: dict[str, dict[str, float]] = {}
    for env_id in options.ids:
        seconds = observed(env_id)
        if not found:
            print("| us an environment | " + " | ".join(seconds) + " |\n| --- |" + " --- |" * len(seconds))
        found[env_id] = {mode: round(1e6 * each, 2) for mode, each in seconds.items()}
        print(f"| `{env_id}` | " + " | ".join(f"{each:.1f}" for each in found[env_id].values()) + " |", flush=True)
    report = {"processor": platform.processor() or platform.machine(), "num_envs": NUM_ENVS, "image_size": SIZE, "threads": 1}
    OUT.write_text(json.dumps(report | {"microseconds": found}, indent=1) + "\n")
    if options.films:
        films()


if __name__ == "__main__":
    main()

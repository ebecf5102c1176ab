"""How fast it is here: the bare core, the environments, and the start.

Units: a frame is a control step of 1/60 s in the core and of the task's own length in an environment; frames, particle
substeps and environment steps are summed over the batch; nanoseconds are per spring, substep and environment, on one thread.
"""

from __future__ import annotations

import datetime
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numba
import numpy as np

import clothgym
from clothgym import _jit
from clothgym.integrators import INTEGRATORS
from clothgym.mesh import grid
from clothgym.registration import ENVIRONMENTS
from clothgym.simulation import Simulation

Row = dict[str, Any]


def machine() -> Row:
    """What the figures were taken on."""
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo") as file:
            name = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), name)
    return {
        "processor": name,
        "threads": _jit.default_threads(),
        "system": platform.platform(terse=True),
        "date": datetime.date.today().isoformat(),
        "versions": {
            "clothgym": clothgym.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "numba": numba.__version__,
            "gymnasium": gym.__version__,
        },
    }


def seconds_per_call(call: Callable[[], object], budget: float = 0.5) -> float:
    """Median time of a call after one to warm up [s]; as many calls as fit the budget [s], three at least."""
    call()
    times: list[float] = []
    while len(times) < 3 or sum(times) < budget:
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def core_rows(quick: bool) -> Iterator[Row]:
    """A sheet of a metre, hanging from two corners in air at 60 Hz, with automatic substeps."""
    sides = (17, 25) if quick else (13, 17, 25, 35, 50)
    batches = (1, 64) if quick else (1, 16, 64, 256)
    for integrator in INTEGRATORS:
        for side in sides:
            mesh = grid(side, side, 1.0, 1.0)
            for num_envs in batches:
                for threads in sorted({1, _jit.default_threads()}) if num_envs > 16 else (1,):
                    s = Simulation(mesh, num_envs=num_envs, integrator=integrator, anchors=mesh.corners[2:], threads=threads)
                    seconds = seconds_per_call(s.step, 0.2 if quick else 0.5)
                    work = num_envs * s.substeps
                    yield {
                        "integrator": integrator,
                        "grid": f"{side}x{side}",
                        "envs": num_envs,
                        "threads": threads,
                        "substeps": s.substeps,
                        "frames/s": num_envs / seconds,
                        "particle-substeps/s": work * mesh.num_particles / seconds,
                        "ns/spring": seconds * threads / (work * len(mesh.springs.kind)) * 1e9,
                    }


def env_rows(quick: bool) -> Iterator[Row]:
    """Environment steps a second with random actions, resets and rewards included, by batch size."""
    for env_id in ENVIRONMENTS:
        env = gym.make(env_id)
        env.reset(seed=0)
        env.action_space.seed(0)

        def steps_of_one(env: gym.Env = env) -> None:
            for _ in range(100):
                if env.step(env.action_space.sample())[2]:
                    env.reset()

        seconds = seconds_per_call(steps_of_one, 1.0) / 100
        yield {"environment": env_id, "envs": 1, "threads": 1, "env-steps/s": 1 / seconds}
        for num_envs in (64, 256) if quick else (16, 64, 256, 1024):
            for threads in sorted({1, _jit.default_threads()}):
                vector = gym.make_vec(env_id, num_envs=num_envs, threads=threads, autoreset_mode="SameStep")
                vector.reset(seed=0)
                actions = np.random.default_rng(0).uniform(-1, 0.81, vector.action_space.shape)
                steps = max(1, (20 if quick else 100) * 64 // num_envs)
                seconds = seconds_per_call(lambda v=vector, a=actions, n=steps: [v.step(a) for _ in range(n)], 1.0)  # type: ignore[misc]
                yield {
                    "environment": env_id,
                    "envs": num_envs,
                    "threads": threads,
                    "env-steps/s": num_envs * steps / seconds,
                }


FIRST_STEP = "import gymnasium as gym; e = gym.make('clothgym:{}'); e.reset(seed=0); e.step(e.action_space.sample())"


def start_rows(quick: bool) -> Iterator[Row]:
    """Seconds from the start of Python to its end, whole process: the first step cold and warm, and bare imports."""
    runs = 3 if quick else 7
    yield {"start": "import numba, gymnasium", "seconds": _process_seconds("import numba, gymnasium", runs)}
    yield {"start": "import clothgym", "seconds": _process_seconds("import clothgym", runs)}
    for env_id in ENVIRONMENTS:
        code = FIRST_STEP.format(env_id)
        with tempfile.TemporaryDirectory() as folder:
            cold = _process_seconds(code, 1, CLOTHGYM_CACHE_DIR=folder)
            yield {"start": f"{env_id}, first step, cold cache", "seconds": cold}
            yield {"start": f"{env_id}, first step, warm cache", "seconds": _process_seconds(code, runs, CLOTHGYM_CACHE_DIR=folder)}


def _process_seconds(code: str, runs: int, **environment: str) -> float:
    times = []
    for _ in range(runs):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=os.environ | environment)
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def run(quick: bool = False) -> dict[str, Any]:
    """All measurements, with the machine's description."""
    sections = {"start": start_rows, "environments": env_rows, "core": core_rows}
    results: dict[str, Any] = {"machine": machine()}
    for name, rows in sections.items():
        results[name] = []
        for row in rows(quick):
            results[name].append(row)
            print(f"\r{name}: {len(results[name])} cases", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
    return results


def table(results: dict[str, Any]) -> str:
    """The measurements as text."""
    about = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    lines = [f"{about['processor']}, {about['threads']} threads, {about['date']}; {versions}"]
    for section in ("start", "environments", "core"):
        rows = results[section]
        widths = {key: max(len(key), *(len(_cell(row[key])) for row in rows)) for key in rows[0]}
        lines += ["", "  ".join(key.rjust(width) for key, width in widths.items())]
        lines += ["  ".join(_cell(row[key]).rjust(width) for key, width in widths.items()) for row in rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.2f}"
    return str(value)

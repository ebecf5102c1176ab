"""Speed on this machine: the bare core, the environments, and the start.

A frame is one control step: 1/60 s in the core, and the task's own length in an environment.  Frames, particle substeps and
environment steps are summed over the batch.  Nanoseconds are per spring, substep and environment, on one thread.
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
from functools import partial
from typing import Any

import gymnasium as gym
import numba
import numpy as np

import clothgym
from clothgym import _jit, progress
from clothgym.integrators import INTEGRATORS
from clothgym.mesh import grid
from clothgym.registration import ENVIRONMENTS
from clothgym.simulation import Simulation

Row = dict[str, Any]
Case = tuple[str, Callable[[], list[Row]]]  # name of a measurement, and its rows


def machine() -> Row:
    """Description of the machine, and the versions of the packages."""
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
    """Median time of a call after one warm-up call [s].  At least three calls are timed, and as many as fit the budget [s]."""
    call()
    times: list[float] = []
    while len(times) < 3 or sum(times) < budget:
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def core_cases(quick: bool) -> Iterator[Case]:
    """A 1 m sheet that hangs from two corners in air at 60 Hz, with automatic substeps."""
    for integrator in INTEGRATORS:
        for side in (17, 25) if quick else (13, 17, 25, 35, 50):
            for num_envs in (1, 64) if quick else (1, 16, 64, 256):
                for threads in sorted({1, _jit.default_threads()}) if num_envs > 16 else (1,):
                    what = f"{integrator}, {side} x {side} particles, sheets {num_envs}, threads {threads}"
                    yield what, partial(core_row, integrator, side, num_envs, threads, 0.2 if quick else 0.5)


def core_row(integrator: str, side: int, num_envs: int, threads: int, budget: float) -> list[Row]:
    mesh = grid(side, side, 1.0, 1.0)
    s = Simulation(mesh, num_envs=num_envs, integrator=integrator, anchors=mesh.corners[2:], threads=threads)
    seconds = seconds_per_call(s.step, budget)
    work = num_envs * s.substeps
    return [
        {
            "integrator": integrator,
            "grid": f"{side}x{side}",
            "envs": num_envs,
            "threads": threads,
            "substeps": s.substeps,
            "frames/s": num_envs / seconds,
            "particle-substeps/s": work * mesh.num_particles / seconds,
            "ns/spring": seconds * threads / (work * len(mesh.springs.kind)) * 1e9,
        }
    ]


def env_cases(quick: bool) -> Iterator[Case]:
    """Environment steps per second by batch size, with random actions, resets and rewards included."""
    for env_id in ENVIRONMENTS:
        yield f"{env_id}, alone", partial(env_row, env_id)
        for num_envs in (64, 256) if quick else (16, 64, 256, 1024):
            for threads in sorted({1, _jit.default_threads()}):
                steps = max(1, (20 if quick else 100) * 64 // num_envs)
                what = f"{env_id}, environments {num_envs}, threads {threads}"
                yield what, partial(batch_row, env_id, num_envs, threads, steps)


def env_row(env_id: str) -> list[Row]:
    env = gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)

    def steps_of_one() -> None:
        for _ in range(100):
            if env.step(env.action_space.sample())[2]:
                env.reset()

    seconds = seconds_per_call(steps_of_one, 1.0) / 100
    return [{"environment": env_id, "envs": 1, "threads": 1, "env-steps/s": 1 / seconds}]


def batch_row(env_id: str, num_envs: int, threads: int, steps: int) -> list[Row]:
    vector = gym.make_vec(env_id, num_envs=num_envs, threads=threads, autoreset_mode="SameStep")
    vector.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 0.81, vector.action_space.shape)
    seconds = seconds_per_call(lambda: [vector.step(actions) for _ in range(steps)], 1.0)
    return [{"environment": env_id, "envs": num_envs, "threads": threads, "env-steps/s": num_envs * steps / seconds}]


FIRST_STEP = "import gymnasium as gym; e = gym.make('clothgym:{}'); e.reset(seed=0); e.step(e.action_space.sample())"


def start_cases(quick: bool) -> Iterator[Case]:
    """Wall time of whole Python processes [s]: the first step with a cold and a warm cache, and bare imports."""
    runs = 3 if quick else 7
    for code in ("import numba, gymnasium", "import clothgym"):
        yield code, partial(import_row, code, runs)
    for env_id in ENVIRONMENTS:
        yield f"{env_id}, first step, cold and warm", partial(first_step_rows, env_id, runs)


def import_row(code: str, runs: int) -> list[Row]:
    return [{"start": code, "seconds": _process_seconds(code, runs)}]


def first_step_rows(env_id: str, runs: int) -> list[Row]:
    code = FIRST_STEP.format(env_id)
    with tempfile.TemporaryDirectory() as folder:
        times = {cache: _process_seconds(code, n, CLOTHGYM_CACHE_DIR=folder) for cache, n in (("cold", 1), ("warm", runs))}
    return [{"start": f"{env_id}, first step, {cache} cache", "seconds": seconds} for cache, seconds in times.items()]


def _process_seconds(code: str, runs: int, **environment: str) -> float:
    times = []
    for _ in range(runs):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=os.environ | environment)
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def run(quick: bool = False) -> dict[str, Any]:
    """All measurements, with a description of the machine."""
    sections = {"start": start_cases, "environments": env_cases, "core": core_cases}
    results: dict[str, Any] = {"machine": machine()}
    for name, cases_of in sections.items():
        results[name] = []
        cases = list(cases_of(quick))
        for place, (what, rows_of) in enumerate(cases):
            progress.show(f"{name}: {what}", place, len(cases))
            results[name] += rows_of()
    progress.clear()
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

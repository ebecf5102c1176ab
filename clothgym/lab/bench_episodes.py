"""Table rows that take seconds each: episodes of the tasks, maneuvers, MuJoCo, and whole processes."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym.lab.bench_mujoco import measure_mujoco, measure_ours
from clothgym.lab.bench_table import Row, beat, row_of
from clothgym.mesh import grid
from clothgym.registration import ENVIRONMENTS
from clothgym.simulation import Simulation
from clothgym.starts import Fold, Maneuver, ZFold

DRAPE = "ClothDrape-v0"
MANY, STEPS = 128, 100  # environments and steps of an episode
LETS_GO = 0.81  # upper bound of random actions, so that they release in one step of a hundred
SPACING, LEAF = 1 / 24, 8  # of the sheets that grow [m], and cells of a leaf
FRAME, THICKNESS = 1 / 60, 0.008


def make(env_id: str, num_envs: int | None = None, **options: Any) -> Any:
    """An environment or a batch."""
    if num_envs is None:
        return gym.make(f"clothgym:{env_id}", **options)
    return gym.make_vec(f"clothgym:{env_id}", **{"autoreset_mode": "SameStep"} | options, num_envs=num_envs, threads=1)


class Stopwatch:
    """Sums the processor time that this thread spends in a simulation's steps [s]."""

    def __init__(self, simulation: Simulation) -> None:
        self.seconds = 0.0
        self.step = simulation.step
        simulation.step = self  # type: ignore[method-assign, assignment]

    def __call__(self, n: int = 1) -> None:
        begun = time.thread_time()
        self.step(n)
        self.seconds += time.thread_time() - begun


# --- batches of ClothDrape-v0 -------------------------------------------------------------------------------------------------


def play(variants: dict[str, Row], expert: bool, num_envs: int = MANY, steps: int = STEPS, rounds: int = 2) -> dict[str, float]:
    """Time of an environment step by variant [us].  Variants take turns, and the fastest round of each step counts."""
    best: dict[str, NDArray] = {name: np.full(steps, np.inf) for name in variants}
    envs = {name: make(DRAPE, num_envs, **options).unwrapped for name, options in variants.items()}
    for turn in range(rounds):
        random = np.random.default_rng(0)
        for env in envs.values():
            env.reset(seed=0)
        for step in range(steps):
            drawn = random.uniform(-1, LETS_GO, next(iter(envs.values())).action_space.shape).astype(np.float32)
            for name, env in envs.items():
                action = env.expert_actions() if expert else drawn
                begun = time.thread_time()
                env.step(action)
                best[name][step] = min(best[name][step], time.thread_time() - begun)
            beat(f"{DRAPE} {'expert' if expert else 'random'}: round {turn + 1} of {rounds}, step {step + 1} of {steps}")
    return {name: float(times.mean()) * 1e6 / num_envs for name, times in best.items()}


# the short cuts, with solids that touch the whole sheet; with strict self-collision, too; and what the id has
FAST: Row = {"physics": "fast"}
SHEET, STRICT, TRUE = {**FAST, "contact": "sheet"}, {**FAST, "contact": "sheet", "self_collision": "strict"}, {"physics": "true"}


def contact() -> list[Row]:
    us = play({"particles": FAST, "sheet": SHEET}, expert=True)
    return [
        row_of("contact", f"{DRAPE}, fast physics, expert, {MANY}", 1e6 / us["particles"], "steps/s"),
        row_of("contact", f"{DRAPE}, the same and sheet contact, expert, {MANY}", 1e6 / us["sheet"], "steps/s"),
        row_of("contact", f"{DRAPE}, sheet instead of particles, expert, {MANY}", us["sheet"] - us["particles"], "us more", 40),
    ]


def strict() -> list[Row]:
    expert = play({"without": SHEET, "with": STRICT, "true": TRUE}, expert=True)
    random = play({"without": SHEET, "with": STRICT}, expert=False)
    name, rows = f"{DRAPE}, strict self-collision", []
    for actor, us, goal in (("expert", expert, 120), ("random", random, 350)):
        rows.append(row_of("strict", f"{name}, {actor}, {MANY}", us["with"] - us["without"], "us more", goal))
    rows.append(row_of("strict", f"{name}, sheet contact, skip springs, expert, {MANY}", 1e6 / expert["with"], "steps/s"))
    return [*rows, row_of("strict", f"{DRAPE}, true physics, expert, {MANY}", 1e6 / expert["true"], "steps/s", 3000, least=True)]


# --- single environments, and what is not physics -----------------------------------------------------------------------------


def env() -> list[Row]:
    """Steps per second of ``gym.make``, with resets."""
    rows = []
    kinds = ("true", "fast")
    cases = [(env_id, physics, actor) for env_id in ENVIRONMENTS for physics in kinds for actor in ("random", "expert")]
    made = {case: make(case[0], physics=case[1]) for case in cases}
    times: dict[tuple[str, str, str], list[float]] = {case: [] for case in cases}
    for turn in range(6):
        for case, one in made.items():
            one.action_space.seed(0)
            one.reset(seed=turn)
            seconds = 0.0
            for _ in range(STEPS):
                action = one.unwrapped.expert_action() if case[2] == "expert" else one.action_space.sample()
                begun = time.thread_time()
                if one.step(action)[2]:
                    one.reset()
                seconds += time.thread_time() - begun
            if turn:
                times[case].append(seconds / STEPS)
        beat(f"gym.make: turn {turn + 1} of 6")
    for (env_id, physics, actor), taken in times.items():
        goal = 3000.0 if (env_id, physics) == (DRAPE, "fast") else None
        what = f"gym.make({env_id!r}), {physics} physics, {actor}"
        rows.append(row_of("env", what, 1 / statistics.median(taken), "steps/s", goal, least=True))
    return rows


def overhead() -> list[Row]:
    """Cost of everything but physics: the time of environment steps minus that of the simulation."""
    rows = []
    for env_id in ENVIRONMENTS:
        ways: list[tuple[str, int, float, Callable[[], Any]]] = [
            ("one", 1, 80, partial(make, env_id)),
            ("each of 256", 256, 10, partial(make, env_id, 256)),
        ]
        if find_spec("stable_baselines3") is not None:
            from clothgym.adapters.sb3 import make_sb3_vec_env

            ways.append(("each of 256, SB3", 256, 10, partial(make_sb3_vec_env, env_id, 256, seed=0, threads=1)))
        for what, num_envs, goal, maker in ways:
            us = beside_physics(maker(), num_envs, 400 if num_envs == 1 else 40)
            rows.append(row_of("overhead", f"{env_id}, beside the physics, {what}", us, "us", goal))
    return rows


def beside_physics(one: Any, num_envs: int, steps: int, rounds: int = 3) -> float:
    """Median time of an environment step without its physics [us], with random actions, resets included."""
    random, adapted = np.random.default_rng(0), not isinstance(one, gym.Env | gym.vector.VectorEnv)
    simulation = (one.env if adapted else one).unwrapped.task.simulation
    one.reset() if adapted else one.reset(seed=0)
    shape = (num_envs, *one.action_space.shape) if adapted else one.action_space.shape

    def act(count: int) -> float:
        total = 0.0
        for _ in range(count):
            action = random.uniform(-1, LETS_GO, shape).astype(np.float32)
            begun = time.thread_time()
            if np.all(one.step(action)[2]) and num_envs == 1:
                one.reset()
            total += time.thread_time() - begun
        beat("beside the physics")
        return total

    act(110 if num_envs > 1 else 1)  # until episodes end at different times
    watch, taken = Stopwatch(simulation), []
    for _ in range(rounds):
        before = watch.seconds
        taken.append(act(steps) - (watch.seconds - before))
    return statistics.median(taken) * 1e6 / (steps * num_envs)


# --- sheets that touch themselves ---------------------------------------------------------------------------------------------


def frames(maneuvers: Mapping[str, Maneuver], count: int) -> dict[str, float]:
    """Mean time of a frame of each maneuver, physics alone [ms].  They take turns frame by frame."""
    watches = {name: Stopwatch(maneuver.simulation) for name, maneuver in maneuvers.items()}
    for frame in range(count):
        for maneuver in maneuvers.values():
            maneuver.step()
        beat(f"{', '.join(maneuvers)}: frame {frame + 1} of {count}")
    return {name: 1e3 * watch.seconds / count for name, watch in watches.items()}


def _options(mode: str) -> Row:
    return {"threads": 1} | ({} if mode == "none" else {"self_collision": {"mode": mode, "thickness": THICKNESS}})


def fold(num_envs: int = 64) -> list[Row]:
    mesh, modes = grid(25, 25, 1.0, 1.0), ("none", "strict")
    made = {mode: Fold(mesh, seeds=range(num_envs), thickness=THICKNESS, **_options(mode)) for mode in modes}
    for mode in modes:  # loads compiled code
        Fold(mesh, seeds=[0], thickness=THICKNESS, **_options(mode)).step()
    ms = {mode: time / num_envs for mode, time in frames(made, round(made["none"].seconds / FRAME)).items()}
    return [
        row_of("fold", f"folding in half, 25 x 25, strict, {num_envs}", ms["strict"], "ms a frame, each", 0.6),
        row_of("fold", f"folding in half, 25 x 25, without self-collision, {num_envs}", ms["none"], "ms a frame, each"),
    ]


def growth(sides: tuple[int, int] = (25, 100), count: int = 60) -> list[Row]:
    """The first second of a falling folded sheet, by size."""
    made = {}
    for side in sides:
        mesh = grid(side, side, (side - 1) * SPACING, (side - 1) * SPACING)
        for name in ("falling", "warm"):
            made[f"{name} {side}"] = ZFold(mesh, thickness=THICKNESS, leaves=(side - 1) // LEAF, **_options("strict"))
        made.pop(f"warm {side}").simulation.step()
    ms = frames(made, count)
    small, large = (ms[f"falling {side}"] for side in sides)
    rows = [
        row_of("growth", f"a folded sheet that falls, {side} x {side}, strict", ms[f"falling {side}"], "ms a frame")
        for side in sides
    ]
    times = f"the same, {sides[0]} x {sides[0]} to {sides[1]} x {sides[1]}"
    return [*rows, row_of("growth", times, large / small, "times", 20)]


def mujoco() -> list[Row]:
    if find_spec("mujoco") is None:
        return [row_of("mujoco", "MuJoCo is not installed: pip install 'mujoco>=4'", float("nan"), "")]
    name = "a sheet that falls on its edge"
    ours = {lanes: measure_ours(lanes) for lanes in (1, 64)}
    rows = [row_of("mujoco", f"{name}, strict, {lanes} at once", speed, "frames/s") for lanes, speed in ours.items()]
    for steps, goal in ((1, 50), (4, 120)):
        theirs = measure_mujoco("ipc", steps)
        rows.append(row_of("mujoco", f"{name}, MuJoCo's ipc, {steps} a frame", theirs, "frames/s"))
        rows.append(
            row_of("mujoco", f"64 at once over MuJoCo's ipc, {steps} a frame", ours[64] / theirs, "times", goal, least=True)
        )
    return rows


# --- whole processes ----------------------------------------------------------------------------------------------------------

FIRST_STEP = "import gymnasium as gym; e = gym.make('clothgym:{}'); e.reset(seed=0); e.step(e.action_space.sample())"


def start(runs: int = 7) -> list[Row]:
    imports, first, times = "import numba, gymnasium", FIRST_STEP.format(DRAPE), []
    with tempfile.TemporaryDirectory() as folder:
        cold = process_seconds(first, folder)
        for run in range(runs):
            times.append((process_seconds(imports, folder), process_seconds(first, folder)))
            beat(f"start: run {run + 1} of {runs}")
    bare, warm = (statistics.median(taken) for taken in zip(*times))
    name = f"first step of {DRAPE}"
    return [
        row_of("start", f"cold, {name}", cold, "s", 20),
        row_of("start", imports, bare, "s"),
        row_of("start", f"warm, {name}", warm, "s"),
        row_of("start", "the same over those imports", statistics.median(b / a for a, b in times), "times", 1.3),
    ]


def process_seconds(code: str, cache: str) -> float:
    """Processor time of a whole process [s], or wall time where the system does not report it."""
    begun, before = time.perf_counter(), os.times()
    environment = os.environ | {"CLOTHGYM_CACHE_DIR": cache}
    # bytecode is written, as is usual; otherwise each process compiles every Python module again
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment)
    after = os.times()
    used = after.children_user - before.children_user + after.children_system - before.children_system
    return used or time.perf_counter() - begun


GROUPS: dict[str, Callable[[], list[Row]]] = {
    "contact": contact,
    "strict": strict,
    "env": env,
    "overhead": overhead,
    "fold": fold,
    "growth": growth,
    "mujoco": mujoco,
    "start": start,
}

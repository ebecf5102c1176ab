"""What the parts of a step cost on one thread: springs, methods, bending, air, contact, and what environments add.

    python benchmarks/speed.py                              # all groups, about half an hour; writes results/speed.json
    python benchmarks/speed.py --select springs drape       # some groups: prints only

Times are this thread's processor time.  The cases of a group take turns, so other load on the machine affects all of them alike.
Ratios are therefore more reliable than times.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym import ClothMesh, Material, Simulation, grid
from clothgym.lab.bench import machine
from clothgym.registration import ENVIRONMENTS
from clothgym.triangles import disc

Row = dict[str, Any]
RESULTS = Path(__file__).parent / "results" / "speed.json"
ROUNDS = 15
VISITS = 1_500_000  # approximate product of springs, substeps and environments in a call
DRAPE, DRAPE_SUBSTEPS = grid(17, 17, 0.6, 0.6), 50  # the sheet of ClothDrape-v0, and the substeps of its control step
MANY, STEPS = 128, 100  # environments and steps of an episode
RARE = 0.81  # upper bound of random actions, so that they release in one step of a hundred


def row(group: str, what: str, now: float, unit: str) -> Row:
    return {"group": group, "what": what, "now": now, "unit": unit}


def in_turns(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median processor time of each call [s].  The first round loads compiled code and does not count."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS + 1):
        for name, call in calls.items():
            begun = time.thread_time()
            call()
            times[name].append(time.thread_time() - begun)
    return {name: statistics.median(taken[1:]) for name, taken in times.items()}


def hanging(mesh: ClothMesh, num_envs: int = 1, damping_time: float = 1e-4, **world: Any) -> Simulation:
    """Slightly uneven sheets that hang upright by their upper corners.  A disc hangs by particles of its rim."""
    held = mesh.corners[2:] if mesh.shape is not None else (mesh.num_particles - 4, mesh.num_particles - 1)
    fabric = Material.preset("penava_cotton", damping_time=damping_time, air_drag=0.72)
    world = {"anchors": held, "air_density": 0.0, "threads": 1, "on_divergence": "ignore", **world}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # timings need no accuracy
        simulation = Simulation(mesh, fabric, num_envs, **world)
    ripple = np.random.default_rng(0).normal(scale=1e-4, size=(num_envs, mesh.num_particles, 3))
    simulation.reset(positions=mesh.rest_positions[:, [0, 2, 1]] + ripple)
    return simulation


def each(num_envs: int) -> str:
    return "one" if num_envs == 1 else f"each of {num_envs}"


def springs() -> list[Row]:
    """Passes over the springs, by size, batch and method, with substeps that are too short to be unstable."""
    square = grid(25, 25, 1.0, 1.0)
    cases = [(f"explicit, one, {side} x {side}", grid(side, side, 1.0, 1.0), 1, 1, {}) for side in (17, 25, 50, 100)]
    cases += [(f"explicit, {each(n)}, a disc of 631", disc(0.5, 14), n, 1, {}) for n in (1, 64)]
    methods: tuple[tuple[str, int, Row], ...] = (
        ("explicit", 1, {}),
        ("explicit_euler", 1, {"integrator": "explicit_euler"}),
        ("verlet", 1, {"integrator": "verlet"}),
        ("rk4, a quarter", 4, {"integrator": "rk4"}),
        ("implicit_euler, a pass", 22, {"integrator": {"name": "implicit_euler", "tolerance": 0.0, "iterations": 20}}),
        ("pbd", 1, {"integrator": {"name": "pbd", "iterations": 1}}),
        ("xpbd", 1, {"integrator": "xpbd"}),
        ("xpbd, undamped", 1, {"integrator": "xpbd", "damping_time": 0.0}),
    )
    for name, passes, world in methods:
        cases += [(f"{name}, {each(n)}, 25 x 25", square, n, passes, world) for n in (1, 64, 128)]
    calls, visits = {}, {}
    for what, mesh, num_envs, passes, world in cases:
        count = len(mesh.springs.kind) * num_envs * passes
        substeps = max(4, VISITS // count)
        step = 1 / 240 if passes > 4 else 1e-5  # [s]
        calls[what] = hanging(mesh, num_envs, time_step=substeps * step, substeps=substeps, **world).step
        visits[what] = count * substeps
    rows = [row("springs", what, 1e9 * seconds / visits[what], "ns a spring") for what, seconds in in_turns(calls).items()]
    implicit = ("implicit_euler", "projective_dynamics")
    whole = in_turns({name: hanging(square, integrator=name, time_step=1 / 60, substeps=4).step for name in implicit})
    return rows + [row("springs", f"{name}, one, 25 x 25, a substep", 1e6 * s / 4, "us") for name, s in whole.items()]


def drape() -> list[Row]:
    """A control step of ClothDrape-v0's sheet without solids: springs, and what bending models and air add."""
    worlds: dict[str, Row] = {
        "springs alone": {},
        "quadratic": {"bending": "quadratic"},
        "hinge": {"bending": "hinge"},
        "air": {"air_density": 1.2, "wind": (1.0, 0.5, 0.2)},
    }
    rows = []
    for n in (1, MANY):
        made = {name: hanging(DRAPE, n, time_step=1 / 30, substeps=DRAPE_SUBSTEPS, **world) for name, world in worlds.items()}
        us = {name: 1e6 * seconds / n for name, seconds in in_turns({name: s.step for name, s in made.items()}).items()}
        base = us["springs alone"]
        rows.append(row("drape", f"springs alone, {each(n)}", base, "us a control step"))
        rows += [row("drape", f"{model} bending, {each(n)}", us[model] / base, "times") for model in ("quadratic", "hinge")]
        rows.append(row("drape", f"air forces on every triangle, {each(n)}", us["air"] - base, "us more"))
    return rows


def play(
    variants: dict[str, Row],
    expert: bool,
    num_envs: int = MANY,
    steps: int = STEPS,
    rounds: int = 2,
    clock: Callable[[], float] = time.thread_time,
) -> dict[str, float]:
    """Time of an environment step of ClothDrape-v0 by variant [us].  The fastest round of each step counts."""
    best: dict[str, NDArray] = {name: np.full(steps, np.inf) for name in variants}
    envs: dict[str, Any] = {name: batch("ClothDrape-v0", num_envs, **options) for name, options in variants.items()}
    for _ in range(rounds):
        random = np.random.default_rng(0)
        for env in envs.values():
            env.reset(seed=0)
        for step in range(steps):
            drawn = random.uniform(-1, RARE, next(iter(envs.values())).action_space.shape).astype(np.float32)
            for name, env in envs.items():
                action = env.expert_actions() if expert else drawn
                begun = clock()
                env.step(action)
                best[name][step] = min(best[name][step], clock() - begun)
    return {name: float(times.mean()) * 1e6 / num_envs for name, times in best.items()}


def batch(env_id: str, num_envs: int, **options: Any) -> Any:
    options = {"autoreset_mode": "SameStep", "threads": 1} | options
    return gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, **options).unwrapped


def contact() -> list[Row]:
    """Batches of ClothDrape-v0: true physics, the short cuts, and what contact of the whole sheet and strict self-collision add."""
    fast: Row = {"physics": "fast"}
    sheet, strict = {**fast, "contact": "sheet"}, {**fast, "contact": "sheet", "self_collision": "strict"}
    expert = play({"fast": fast, "sheet": sheet, "strict": strict, "true": {"physics": "true"}}, expert=True)
    random = play({"sheet": sheet, "strict": strict}, expert=False)
    names = {
        "fast": "fast physics",
        "sheet": "sheet contact",
        "strict": "strict self-collision, skip springs",
        "true": "true physics",
    }
    rows = [row("contact", f"{name}, expert", 1e6 / expert[key], "steps/s") for key, name in names.items()]
    return rows + [
        row("contact", "sheet contact instead of particles, expert", expert["sheet"] - expert["fast"], "us more"),
        row("contact", "strict self-collision, expert", expert["strict"] - expert["sheet"], "us more"),
        row("contact", "strict self-collision, random", random["strict"] - random["sheet"], "us more"),
    ]


def env() -> list[Row]:
    """Steps per second of ``gym.make``, with resets."""
    cases = [(env_id, physics, actor) for env_id in ENVIRONMENTS for physics in ("true", "fast") for actor in ("random", "expert")]
    rows = []
    for env_id, physics, actor in cases:
        one: Any = gym.make(f"clothgym:{env_id}", physics=physics)
        one.action_space.seed(0)
        times = []
        for turn in range(6):
            one.reset(seed=turn)
            seconds = 0.0
            for _ in range(STEPS):
                action = one.unwrapped.expert_action() if actor == "expert" else one.action_space.sample()
                begun = time.thread_time()
                if one.step(action)[2]:
                    one.reset()
                seconds += time.thread_time() - begun
            times.append(seconds / STEPS)
        rows.append(row("env", f"{env_id}, {physics} physics, {actor}", 1 / statistics.median(times[1:]), "steps/s"))
    return rows


def overhead() -> list[Row]:
    """Time of an environment step without that of the simulation: observation, reward, evaluation and resets."""
    rows = []
    for env_id in ENVIRONMENTS:
        for num_envs in (1, 256):
            us = without_physics(env_id, num_envs, 400 if num_envs == 1 else 40)
            rows.append(row("overhead", f"{env_id}, {each(num_envs)}", us, "us"))
    return rows


def without_physics(env_id: str, num_envs: int, steps: int, rounds: int = 3) -> float:
    """Median time of an environment step without its physics [us], with random actions."""
    one: Any = gym.make(f"clothgym:{env_id}") if num_envs == 1 else batch(env_id, num_envs)
    random, simulation, inside = np.random.default_rng(0), one.unwrapped.task.simulation, [0.0]
    step = simulation.step

    def timed(*args: Any, **kwargs: Any) -> None:
        begun = time.thread_time()
        step(*args, **kwargs)
        inside[0] += time.thread_time() - begun

    def act(count: int) -> float:
        outside, before = 0.0, inside[0]
        for _ in range(count):
            action = random.uniform(-1, RARE, one.action_space.shape).astype(np.float32)
            begun = time.thread_time()
            if np.all(one.step(action)[2]) and num_envs == 1:
                one.reset()
            outside += time.thread_time() - begun
        return outside - (inside[0] - before)

    simulation.step = timed
    one.reset(seed=0)
    act(110 if num_envs > 1 else 1)  # until episodes end at different times
    return statistics.median(act(steps) for _ in range(rounds)) * 1e6 / (steps * num_envs)


GROUPS: dict[str, Callable[[], list[Row]]] = {
    "springs": springs,
    "drape": drape,
    "contact": contact,
    "env": env,
    "overhead": overhead,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--select", nargs="+", choices=tuple(GROUPS), metavar="GROUP", help=", ".join(GROUPS))
    selected = parser.parse_args().select
    rows: list[Row] = []
    for group in selected or GROUPS:
        for measured in GROUPS[group]():
            rows.append(measured)
            print(f"{group:<9} {measured['what']:<58} {measured['now']:>10,.4g} {measured['unit']}")
    if not selected:
        RESULTS.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Seeds and options that nobody expects: each is refused whole, or begins an episode that is sound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np
from attacks.values import run, value

from clothgym.registration import ENVIRONMENTS

VICTIMS = (*ENVIRONMENTS, *(f"{env_id} x 3" for env_id in ENVIRONMENTS))
SEEDS = ("None", "0", "2**63", "[1, 2, 3]", "[1, None, 3]", "np.arange(3)", "np.int64(5)", "(1, 2)", "[5, -1, 5]", "[1, 1.5, 2]")
OPTIONS = {
    "material": ("'silk'", "{{'density': {0}}}", "{{'stretch_stiffness': {0}, 'bend_rigidity': {1}}}", "{{{0!r}: 1}}"),
    "target": ("{{'shape': 'box'}}", "{{'radius': {0}}}", "{{'shape': {0}, 'height': {1}}}", "{{'center': {0}}}", "{{'yaw': {0}}}",
               "{{'center': [{0}, {1}]}}", "{{{0!r}: 1}}"),
    "goal": ("[0.3, 0.1, 0.5]", "[{0}, {1}, 0.5]", "(0, {0}, 1)"),
    "rumpled": ("True", "np.bool_(False)"),
    "reset_mask": ("[True, False, True]", "np.zeros(3, bool)", "np.array([True, True, False])", "[{0}, True, True]"),
    "threshold": ("0.1",),
}  # fmt: skip


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        name = str(rng.choice(VICTIMS))
        seed = str(rng.choice(SEEDS)) if rng.random() < 0.7 else value(rng)
        options = value(rng) if rng.random() < 0.1 else _options(name, rng)
        text = f"attacks.resets.reset({name!r}, {seed}, {options})"
        yield text, partial(run, text)


def _options(name: str, rng: np.random.Generator) -> str:
    """A dict with some of an environment's own options, or another's."""
    own = [*victim(name).unwrapped.task.reset_options, *["reset_mask"] * ("x" in name)]
    chosen = rng.choice(own if rng.random() < 0.9 else list(OPTIONS), size=rng.integers(3))
    return "{" + ", ".join(f"{key!r}: {_option(key, rng)}" for key in sorted(set(chosen.tolist()))) + "}"


def _option(key: str, rng: np.random.Generator) -> str:
    forms = OPTIONS.get(key, ())
    if not forms or rng.random() < 0.3:
        return value(rng)
    return forms[rng.integers(len(forms))].format(value(rng), value(rng))


def reset(name: str, seed: Any, options: Any) -> None:
    """Reset one of VICTIMS, and go on for two steps.

    Raises:
        ValueError, TypeError: what ``reset`` says.
        AssertionError: it has changed something before, or what it has begun makes nonsense.
    """
    env = victim(name)
    before = _remembered(env)
    try:
        observation, _ = env.reset(seed=seed, options=options)
    except BaseException:
        assert _remembered(env) == before, "the reset was refused after something had changed"
        raise
    for _ in range(3):
        assert env.observation_space.contains(observation), "an observation has left its space"
        simulation = env.unwrapped.task.simulation
        fine = np.isfinite(simulation.positions).all(axis=(1, 2)) | simulation.diverged
        assert fine.all(), "a sheet is not finite, and has not been reported"
        observation, reward, *_ = env.step(env.action_space.sample())
        assert np.isfinite(reward).all() and np.abs(reward).max() < 1e6, f"the reward is {reward}"


@cache
def victim(name: str) -> Any:
    """One of VICTIMS, in an episode."""
    env_id, _, count = name.partition(" x ")
    env: Any = gym.make_vec(env_id, num_envs=int(count), threads=1) if count else gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    return env


def _remembered(env: Any) -> tuple[Any, ...]:
    """What a refusal must not change."""
    task = env.unwrapped.task
    generators = [str(generator.bit_generator.state) for generator in task.generators]
    simulation = task.simulation
    return (task.episode.tobytes(), task.air.tobytes(), simulation.positions.tobytes(), simulation.parameters.tobytes(), generators)

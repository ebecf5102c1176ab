"""Actions that nobody expects: each is refused, and nothing has moved, or leads to a step that is sound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from attacks.resets import VICTIMS, victim
from attacks.values import HAS_TORCH, run, value

# of the right shape, by an expression S for it
SHAPED = (
    "np.zeros(S)", "np.zeros(S, np.float32)", "np.ones(S, int)", "np.zeros(S).tolist()", "np.full(S, np.nan)",
    "np.full(S, np.inf)",
    "np.full(S, 1e300)", "np.full(S, -1e30)", "np.full(S, 5e-324)", "np.zeros(S, complex)", "np.full(S, '1')",
    "np.full(S, '1').tolist()",
    "np.full(S, None)", "np.zeros(S, object)", "np.zeros(S, bool)", "np.zeros(S, np.float16)", "np.zeros(S, np.longdouble)",
    "np.zeros(S, 'M8[s]')", "np.full(S, 2**64 - 1, np.uint64)", "np.asfortranarray(np.zeros(S))", "np.zeros((2, *S))[1]",
    "np.zeros(S)[..., ::-1]",
    "np.zeros((1, *S))", "np.zeros(S)[..., :-1]", "np.zeros(S)[..., None]", "np.zeros(S).ravel()", "np.zeros(S).T",
    "np.zeros((0, *S))",
    "np.where(np.arange(S[-1]) == 1, np.nan, np.zeros(S))", "[np.zeros(S), np.zeros(2)]", "iter(np.zeros(S))",
    "np.ma.array(np.zeros(S), mask=True)",
    "np.array(np.zeros(S), dtype='>f4')", "memoryview(np.zeros(S))", "{0: np.zeros(S)}", "np.full(S, {value})",
    "[{value}] * S[-1]",
)  # fmt: skip
TENSORS = (
    "torch.zeros(S)", "torch.zeros(S, requires_grad=True)", "torch.zeros(S, device='meta')", "torch.zeros(S).to_sparse()",
    "torch.zeros(S, dtype=torch.bfloat16)", "torch.zeros(S, dtype=torch.cfloat)", "torch.zeros(S)[..., :2]",
    "torch.full(S, torch.nan)",
    "list(torch.zeros(S))", "torch.zeros(S).conj()", "torch.zeros(S, dtype=torch.int8)",
)  # fmt: skip


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    shaped = (*SHAPED, *(TENSORS if HAS_TORCH else ()))
    while True:
        name = str(rng.choice(VICTIMS))
        if rng.random() < 0.3:
            text = f"attacks.actions.play({name!r}, {int(rng.integers(2**31))})"
        else:
            form = str(rng.choice(shaped)).replace("{value}", value(rng)) if rng.random() < 0.8 else value(rng)
            text = f"attacks.actions.step({name!r}, lambda S: {form})"
        yield text, partial(run, text)


def step(name: str, action: Callable[[tuple[int, ...]], Any]) -> None:
    """Step one of VICTIMS with an action, from a function of its shape.

    Raises:
        ValueError, TypeError: what ``step`` says.
        AssertionError: something has moved before, or nonsense came out.
    """
    env = victim(name)
    env.reset(seed=0)
    try:
        given = action(env.action_space.shape)
    except Exception:
        return  # there is no such action
    simulation = env.unwrapped.task.simulation
    before = simulation.positions.tobytes(), env.unwrapped.task.episode.tobytes()
    try:
        brought = env.step(given)
    except BaseException:
        assert (simulation.positions.tobytes(), env.unwrapped.task.episode.tobytes()) == before, "refused, but something has moved"
        raise
    _check(env, *brought)


def play(name: str, seed: int) -> None:
    """Thirty steps as violent as they can be: each component at its end, for a time that is drawn.

    Raises:
        AssertionError: nonsense came out.
    """
    env, rng = victim(name), np.random.default_rng(seed)
    env.reset(seed=int(rng.integers(2**31)))
    for t in range(30):
        if t == 0 or rng.random() < 0.3:
            actions = rng.choice([-1e30, -1, -1, -0.5, 0, 1, 1, 1e30], env.action_space.shape).astype(np.float32)
        brought = env.step(actions)
        _check(env, *brought)
        if "x" not in name and brought[2]:
            env.reset()


def _check(env: Any, observation: Any, reward: Any, *others: Any) -> None:
    assert env.observation_space.contains(observation), "an observation has left its space"
    assert np.isfinite(reward).all() and np.abs(reward).max() < 1e6, f"the reward is {reward}"
    assert not env.unwrapped.task.simulation.diverged.any() or np.any(others[0]), "a sheet has diverged, and goes on"

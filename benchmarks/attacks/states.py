"""States that somebody has edited: each is refused whole, or harmless.

An attack takes an environment, or a simulation that touches itself, in mid-episode, edits what ``get_state`` gave in one to three
places and gives it to ``set_state``.  A refusal must have changed nothing.  What is taken must go on with observations within their
space and rewards that are finite.
"""

from __future__ import annotations

import copy
import hashlib
import json
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import clothgym
from clothgym.registration import ENVIRONMENTS
from clothgym.starts import MANEUVERS

STRICT = "self_collision='strict'"  # the victim that is a simulation, not an environment
VICTIMS = (*ENVIRONMENTS, *(f"{env_id} x 3" for env_id in ENVIRONMENTS), STRICT)
NUMBERS = (np.nan, np.inf, -np.inf, 1e35, -1e35, 1e30, -1e30, 1e20, 5e-324, -5e-324, 0.0, -0.0, -1.0, 0.5, 1.0, 2.0, 99.0, 1e9)
INTEGERS = (-1, 0, 1, 7, 99, 2**31 - 1, 2**31, 2**40, -(2**31) - 1, 2**63 - 1, -(2**63))
DTYPES = ("f8", "f4", "f2", "i8", "i1", "u8", "?", "c16", "U8", "O")
WHOLE = (None, 0, [], {}, "state", 1e300, [1, 2, 3], np.zeros(0), np.zeros((1, 1, 1, 1)), np.array(None), np.array("text"))
TEXTS = ("", "{}", "[]", "null", "{" * 5000, "1" * 5000, '{"bit_generator": "MT19937"}', "NaN")


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        name, seed = str(rng.choice(VICTIMS)), int(rng.integers(2**31))
        yield f"attacks.states.edit({name!r}, {seed})", lambda name=name, seed=seed: edit(name, seed)  # type: ignore[misc]


def edit(name: str, seed: int) -> None:
    """Edit the state of one of VICTIMS, and set it.

    Raises:
        ValueError, TypeError: what ``set_state`` says.
        AssertionError: it has changed something before, or what it has taken makes nonsense.
    """
    rng = np.random.default_rng(seed)
    victim, sound = _victim(name)
    victim.set_state(sound)
    state = copy.deepcopy(sound)
    for _ in range(rng.integers(1, 4)):
        _edit(state, rng)
    before = digest(victim.get_state())
    try:
        victim.set_state(state)
    except BaseException:
        assert digest(victim.get_state()) == before, "the state was refused after something had changed"
        raise
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        _go_on(victim, rng)


@cache
def _victim(name: str) -> tuple[Any, Any]:
    """What is attacked, and its state in mid-episode."""
    if name == STRICT:
        made = MANEUVERS["z-fold"](clothgym.grid(9, 9, 0.3, 0.3), seeds=range(2), self_collision="strict")
        for _ in range(25):
            made.step()
        return made.simulation, made.simulation.get_state()
    env_id, _, count = name.partition(" x ")
    env: Any = gym.make_vec(env_id, num_envs=int(count)).unwrapped if count else gym.make(env_id).unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
    return env, env.get_state()


def _go_on(victim: Any, rng: np.random.Generator) -> None:
    """A few steps with what has been taken."""
    for _ in range(3):
        if isinstance(victim, clothgym.Simulation):
            victim.step()
            fine = np.isfinite(victim.positions).all(axis=(1, 2)) & np.isfinite(victim.velocities).all(axis=(1, 2))
            assert (fine | victim.diverged).all(), "a sheet is not finite, and has not been reported"
            continue
        seen, reward, *_ = victim.step(rng.uniform(-1, 1, victim.action_space.shape).astype(np.float32))
        assert victim.observation_space.contains(seen), "an observation has left its space"
        assert np.isfinite(reward).all() and np.abs(reward).max() < 1e6, f"the reward is {reward}"


def digest(state: Any) -> str:
    """Of all that a state holds."""
    code = hashlib.sha256()
    for name, array in sorted(_arrays(state).items()):
        code.update(f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    code.update(json.dumps(getattr(state, "generators", None)).encode())
    return code.hexdigest()


def _arrays(state: Any) -> dict[str, NDArray]:
    if hasattr(state, "simulation"):
        return _arrays(state.simulation) | {f"episode {name}": array for name, array in state.episode.items()}
    return {name: np.asarray(array) for name, array in state.arrays().items()}


# --- edits --------------------------------------------------------------------------------------------------------------------


def _edit(state: Any, rng: np.random.Generator) -> None:
    """One edit, somewhere."""
    places: list[tuple[Any, str]] = []
    physics = getattr(state, "simulation", state)
    if isinstance(physics, clothgym.State):
        places += [(physics, name) for name in vars(physics) if name != "self_contact"]
        if isinstance(physics.self_contact, dict):
            places += [(physics.self_contact, name) for name in physics.self_contact]
    if physics is not state:
        places += [(state.episode, name) for name in state.episode] * 2
        places += [(state.generators, 0)] * (3 if isinstance(state.generators, list) and state.generators else 0)  # type: ignore[list-item]
        places += [(state.task, name) for name in state.task]
        if rng.random() < 0.02:
            places = [(state, name) for name in ("simulation", "generators")]
    where, name = places[rng.integers(len(places))]
    old = where[name] if isinstance(where, (dict, list)) else getattr(where, name)
    new = _other(old, rng)
    if isinstance(where, dict) and rng.random() < 0.03:
        del where[name]
    elif isinstance(where, (dict, list)):
        where[name] = new  # type: ignore[call-overload]
    else:
        setattr(where, name, new)


def _other(old: Any, rng: np.random.Generator) -> Any:
    """Something in the place of an array or a text."""
    if isinstance(old, str):
        cut = int(rng.integers(len(old) + 1))
        digits = "".join(rng.choice(list("0123456789"), 20))
        return [str(rng.choice(TEXTS)), old[:cut], old[:cut] + digits + old[cut:], old[::-1], None, 3][rng.integers(6)]
    if not isinstance(old, (np.ndarray, np.generic)) or old.dtype.kind not in "fiub" or rng.random() < 0.05:
        return WHOLE[rng.integers(len(WHOLE))]
    new, form = np.array(old), rng.integers(6)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if form == 0:  # another kind of numbers
            return (
                np.nan_to_num(new).astype(str(rng.choice(DTYPES))) if new.dtype.kind == "f" else new.astype(str(rng.choice(DTYPES)))
            )
        if form == 1 and new.size and new.ndim:  # another shape
            axis = int(rng.integers(new.ndim))
            shapes = new[..., None], new[None], new.ravel(), new[:0], new.T, np.repeat(new, 2, axis), np.delete(new, 0, axis)
            return shapes[rng.integers(len(shapes))]
        # other values: of all, or of one
        real = new.dtype.kind == "f"
        value = NUMBERS[rng.integers(len(NUMBERS))] if real else INTEGERS[rng.integers(len(INTEGERS))]
        if new.dtype.kind == "u" or rng.random() < 0.5:
            new = new.astype(np.float64 if real else np.int64)
        if new.dtype.itemsize < 8 and not real:
            value = value % 100
        if form == 2:
            return new * value if rng.random() < 0.5 else new + value
        if new.size:
            new.flat[rng.integers(new.size)] = value
        return new

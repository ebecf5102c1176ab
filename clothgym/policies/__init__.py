"""Policies that have been learned, one file for each environment and learner: they need neither torch nor Stable-Baselines3.

    policy = clothgym.policies.load("ClothDrape-v0")
    env = policy.make()
    action, _ = policy.predict(env.reset(seed=0)[0])

A file holds the network in half precision, with its training setup and its scores.  It is read without
unpickling anything.  The network is evaluated in a fixed order of plain operations, see ``network``, so an episode is the same to
the last bit on any machine and in any batch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.checks import one_of
from clothgym.registration import checked_id

__all__ = ["Policy", "available", "load", "read"]

FOLDER = Path(__file__).parent
KIND, VERSION = "policy", 1
ADVICE = "name another file, or export it again from its run"
ACTIVATIONS = ("tanh", "relu")
MOST_LAYERS, WIDEST = 10, 4096
FAR = np.float32(8)  # standard deviations: what lies beyond is no farther to a network with normalized observations


class Policy:
    """A deterministic policy; callable on observations, of one environment or of a batch.

    Attributes:
        about: training setup and scores: "env", "env_kwargs", "learner", "seed", "digest" and more.
        keys: parts of an observation that is a dictionary, in the order in which the network takes them; empty for a plain one.
        layers: weights, (inputs, outputs), and biases, (outputs,), float32.
        activation: of all layers but the last, "tanh" or "relu"; squashed: whether a tanh bounds the actions.
        normalization: what is subtracted from observations, and what they are then multiplied by, (inputs,) each, float32; or None.
    """

    def __init__(
        self,
        layers: Sequence[tuple[NDArray, NDArray]],
        activation: str = "tanh",
        squashed: bool = False,
        keys: Sequence[str] = (),
        about: Mapping[str, Any] | None = None,
        normalization: tuple[NDArray, NDArray] | None = None,
    ) -> None:
        one_of("activation", activation, *ACTIVATIONS)
        # rounded as in a file, so that scores are those of the loaded policy
        self.layers = [(as_kept(weight), as_kept(bias)) for weight, bias in layers]
        check_layers(self.layers)
        self.normalization = None if normalization is None else checked_normalization(normalization, self.layers[0][0].shape[0])
        self.activation, self.squashed, self.keys, self.about = activation, bool(squashed), tuple(keys), dict(about or {})

    def make(self, **kwargs: Any) -> gym.Env:
        """The environment that it was trained for, with the same keyword arguments, and these."""
        return gym.make(self.about["env"], **(self.about["env_kwargs"] | kwargs))

    def make_vec(self, num_envs: int, **kwargs: Any) -> gym.vector.VectorEnv:
        """A batch of it."""
        return gym.make_vec(self.about["env"], num_envs=num_envs, **(self.about["env_kwargs"] | kwargs))

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Actions, (numbers,) or (num_envs, numbers)."""
        return self.predict(observation)[0]

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions within [-1, 1] and the state, which it has none of, as Stable-Baselines3's ``predict`` returns them.

        observation: of one environment or of a batch; a dictionary where it was trained on one.

        Raises:
            ValueError: an observation of another size, or ``deterministic=False``: the file holds no noise.
        """
        if not deterministic:
            raise ValueError("deterministic=False: a committed policy is its mean; train one to sample from it")
        if self.keys:
            if not isinstance(observation, Mapping) or not set(self.keys) <= set(observation):
                raise ValueError(f"observation: must be a dict with {', '.join(self.keys)}, as that of {self.about.get('env')}")
            x = np.concatenate([np.asarray(observation[key], np.float32) for key in self.keys], axis=-1)
        else:
            x = np.asarray(observation, np.float32)
        from clothgym.policies.network import forward  # imported here: names are checked before numba is loaded

        size = self.layers[0][0].shape[0]
        if x.ndim not in (1, 2) or x.shape[-1] != size:
            raise ValueError(f"observation of shape {x.shape}: must be ({size},) or (num_envs, {size})")
        if self.normalization is not None:
            x = normalized(x, self.normalization)
        action = forward(np.atleast_2d(x), self.layers, self.activation, self.squashed)
        return (action if x.ndim == 2 else action[0]), state

    def save(self, path: str | Path) -> None:
        """Write it, whole or not at all."""
        arrays: dict[str, Any] = {"about": json.dumps(self.about, default=float), "activation": self.activation}
        arrays |= {"squashed": self.squashed, "keys": json.dumps(self.keys)}
        for number, (weight, bias) in enumerate(self.layers):
            arrays[f"weight_{number}"], arrays[f"bias_{number}"] = weight.astype(np.float16), bias.astype(np.float16)
        if self.normalization is not None:
            arrays["shift"], arrays["factor"] = self.normalization
        files.write_arrays(path, KIND, VERSION, arrays, compressed=True)


def as_kept(array: NDArray) -> NDArray[np.float32]:
    """Numbers as a file holds them, in half precision; those beyond its range are infinite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(np.asarray(array, np.float16), np.float32)


def normalized(x: NDArray, normalization: tuple[NDArray, NDArray]) -> NDArray[np.float32]:
    """``(x - shift) factor``, within ±8, number by number, so that no batch changes a bit; x: float32, (..., inputs)."""
    shift, factor = normalization
    return np.clip((x - shift) * factor, -FAR, FAR)


def checked_normalization(normalization: tuple[NDArray, NDArray], size: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Both in single precision.

    Raises:
        ValueError: they do not fit the network, or are not finite.
    """
    shift, factor = (np.ascontiguousarray(part, np.float32) for part in normalization)
    if shift.shape != (size,) or factor.shape != (size,):
        raise ValueError(f"its normalization has the shapes {shift.shape} and {factor.shape}, its network takes {size} numbers")
    if not (np.isfinite(shift).all() and np.isfinite(factor).all()):
        raise ValueError("its normalization has a value that is not finite")
    return shift, factor


def check_layers(layers: Sequence[tuple[NDArray, NDArray]]) -> None:
    """Refuse layers that do not fit together.

    Raises:
        ValueError: what does not fit.
    """
    if not 1 <= len(layers) <= MOST_LAYERS:
        raise ValueError(f"it has {len(layers)} layers, not from 1 to {MOST_LAYERS}")
    inputs = None
    for number, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or max(weight.shape) > WIDEST or not weight.size:
            raise ValueError(f"layer {number} has weights of shape {weight.shape} and biases of {bias.shape}")
        if inputs not in (None, weight.shape[0]):
            raise ValueError(f"layer {number} takes {weight.shape[0]} numbers, the one before it gives {inputs}")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise ValueError(f"layer {number} has a value that is not finite")
        inputs = weight.shape[1]


def available() -> dict[str, list[str]]:
    """The learners of which policies are committed, best first, by environment id.

    By success rate; where steps cost, only a success at no cost counts.
    """
    found: dict[str, list[tuple[float, str]]] = {}
    for path in sorted(FOLDER.glob("*.npz")):
        about = read(path).about
        found.setdefault(about["env"], []).append((-about.get("safe_success_rate", about["success_rate"]), about["learner"]))
    return {env_id: [learner for _, learner in sorted(learners)] for env_id, learners in found.items()}


def load(env_id: str, learner: str | None = None) -> Policy:
    """The committed policy of an environment; of several learners' the best, see ``available``, or that which is named.

    Raises:
        ValueError: no such environment, or none of it is committed; the message says which are.
    """
    env_id, known = checked_id(env_id), available()
    if env_id not in known:
        raise ValueError(f"no policy of {env_id!r} is committed (there are: {', '.join(known)}): train one with training/train.py")
    if learner is None:
        learner = known[env_id][0]
    one_of("learner", learner, *known[env_id])
    return read(FOLDER / f"{env_id}_{learner}.npz")


def read(path: str | Path) -> Policy:
    """A policy from a file.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is something else, damaged, or describes no policy.
    """
    arrays = files.read_arrays(path, KIND, VERSION, ADVICE)
    with files.naming(path, KIND, ADVICE):
        count = sum(name.startswith("weight_") for name in arrays)
        layers = [(arrays[f"weight_{number}"], arrays[f"bias_{number}"]) for number in range(count)]
        keys, about = json.loads(str(arrays["keys"])), json.loads(str(arrays["about"]))
        if not (isinstance(about, dict) and isinstance(about.get("env_kwargs"), dict)):
            raise ValueError("it does not say for which environment it is")
        checked_id(about.get("env", ""))
        normalization = (arrays["shift"], arrays["factor"]) if "shift" in arrays else None
        return Policy(layers, str(arrays["activation"]), bool(arrays["squashed"]), keys, about, normalization)

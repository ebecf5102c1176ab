"""Values that nobody expects, as text that can be pasted, and what a pasted line may name."""

from __future__ import annotations

import contextlib
import fractions
import importlib
import importlib.util
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

import clothgym

SCALARS = (
    "None", "True", "False", "0", "1", "2", "3", "-1", "7", "0.5", "1.5", "-0.5", "1e-3", "0.0", "-0.0", "1e9", "10**9",
    "2**31 - 1",
    "2**31", "2**53 + 1", "2**63", "2**64", "-(2**63)", "10**400", "-(10**400)", "5e-324", "1e-300", "1e-30", "1e29", "1e300",
    "float('nan')", "float('inf')", "-float('inf')", "1j", "complex(0.5)", "fractions.Fraction(1, 2)",
)  # fmt: skip
WORDS = ("''", "'1'", "'0.2'", "'nan'", "'auto'", "'cotton'", "'xpbd'", "'strict'", "'no such'", "'\\0'", "'x' * 10**6", "b'1'")
NUMPY = (
    "np.float32(0.5)", "np.float64(2)", "np.float16('inf')", "np.longdouble('1e4000')", "np.int8(3)", "np.uint64(2**63)",
    "np.bool_(True)", "np.complex64(1)", "np.str_('1')", "np.datetime64('2026-01-01')", "np.array(2)", "np.array(0.5)",
    "np.array([])", "np.array([2])", "np.array([0, 0, 1])", "np.array([0.5, 1, 2], np.float32)", "np.array(['1', '2', '3'])",
    "np.array([1j, 0, 0])", "np.array([None, 1, 2])", "np.array([1, 2, 3], object)", "np.array('1')", "np.array(None)",
    "np.zeros((3, 3))", "np.zeros((0, 3))", "np.full(3, np.nan)", "np.zeros(3, bool)", "np.zeros(3, 'M8[s]')",
    "np.zeros((9,) * 6)",
    "np.zeros(3, [('a', 'f8')])", "np.ma.masked", "np.ma.array([1.0, 2, 3], mask=True)",
    "np.lib.stride_tricks.as_strided([1.0], (3,), (0,))",
)  # fmt: skip
THINGS = (
    "[]", "()", "{}", "set()", "[0]", "[1.0]", "[0, 1]", "[0, 0]", "[0.1, 0.2]", "(0.2, 0.1)", "[0, 0, 1]", "(0.0, 0.0, 0.0)",
    "[1, 2, 3, 4]", "['1', '2', '3']", "[True, 0, 0]", "[1e300] * 3", "[10**400, 0, 0]", "[[1, 2], [3]]", "[[], [1]]",
    "[[0], [1, 2]]",
    "[None] * 3", "[[[]]]", "range(3)", "range(10**12)", "iter([1, 2, 3])", "{1, 2}", "{'a': 1}", "{None: 1}", "{'name': 'xpbd'}",
    "{'name': 3}", "{'density': 'heavy'}", "slice(3)", "...", "object()", "object", "len", "attacks.values.BAD",
    "attacks.values.LOOP",
    "clothgym.Plane()", "clothgym.Material()", "[clothgym.Plane()]", "[clothgym.Plane]",
)  # fmt: skip
TENSORS = (
    "torch.tensor(0.5)", "torch.tensor(2)", "torch.tensor(0.5, requires_grad=True)", "torch.zeros(3, requires_grad=True)",
    "torch.tensor([])", "torch.zeros(3, device='meta')", "torch.tensor(0.5, dtype=torch.bfloat16)", "torch.tensor(True)",
    "torch.zeros(3).to_sparse()", "torch.tensor(1j)",
)  # fmt: skip
HAS_TORCH = importlib.util.find_spec("torch") is not None
VALUES = (*SCALARS, *WORDS, *NUMPY, *THINGS, *(TENSORS if HAS_TORCH else ()))


class _Bad:
    """An object that cannot even be printed, compared or counted."""

    def __repr__(self) -> str:
        raise RuntimeError("not to be printed")

    __len__ = __float__ = __iter__ = __eq__ = __bool__ = __repr__  # type: ignore[assignment]
    __hash__ = None  # type: ignore[assignment]


BAD = _Bad()
LOOP: list[Any] = [0.0, 0.0]
LOOP.append(LOOP)


def value(rng: np.random.Generator) -> str:
    """One of VALUES; a number in every other case."""
    return str(rng.choice(SCALARS if rng.random() < 0.3 else VALUES))


def call(name: str, arguments: Mapping[str, str]) -> str:
    """The call of a function with these arguments; one whose name begins with a star is given by its place."""
    return f"{name}({', '.join(text if key.startswith('*') else f'{key}={text}' for key, text in arguments.items())})"


def with_hostile(sound: Mapping[str, str], rng: np.random.Generator, most: int = 2) -> dict[str, str]:
    """Some of the sound arguments, of which one or more have been exchanged for hostile ones."""
    names = list(sound)
    chosen = {name: sound[name] for name in names if rng.random() < 0.5 or name.startswith("*")}
    for name in rng.choice(names, size=rng.integers(1, most + 1)):
        chosen[str(name)] = value(rng)
    return {name: chosen[name] for name in names if name in chosen}


def run(text: str) -> Any:
    """The value of a pasted line."""
    names: dict[str, Any] = {"np": np, "gym": gym, "clothgym": clothgym, "fractions": fractions}
    if "torch" in text:
        names["torch"] = importlib.import_module("torch")
    names["attacks"] = importlib.import_module("attacks")
    for module in ("values", "constructors", "resets", "actions", "states", "files", "kills", "disk", "protocol"):
        if f"attacks.{module}." in text:
            with contextlib.suppress(AttributeError):
                setattr(names["attacks"], module, importlib.import_module(f"attacks.{module}"))
    return eval(text, names)

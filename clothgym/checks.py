"""Floor 0: checks of arguments.  They raise a ValueError that names the argument, its value and what it must be."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST = 1e30  # magnitude in an array: its differences over a control step are still finite in float32


def number(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number."""
    # the usual case, at once
    if type(value) is float and math.isfinite(value):
        return value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != () or not np.isfinite(array) or isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}={value!r}: must be a finite number")
    return float(array)


def positive(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number above zero."""
    if number(name, value) <= 0:
        raise ValueError(f"{name}={value!r}: must be positive and finite")
    return float(value)


def not_negative(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number of at least zero."""
    if number(name, value) < 0:
        raise ValueError(f"{name}={value!r}: must be zero or positive")
    return float(value)


def count(name: str, value: Any, what: str = "", least: int = 1) -> int:
    """``value`` as an int, if it is an integer of at least ``least``; what: begins the description in the message."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"{name}={value!r}: must be {what}an integer of at least {least}")
    return int(value)


def members(name: str, value: Any, kind: type, what: str) -> None:
    """Check that ``value`` is a sequence of instances of the class ``kind``; what: their name in the message."""
    if not isinstance(value, Sequence) or not all(isinstance(one, kind) for one in value):
        raise ValueError(f"{name}={value!r}: must be a sequence of {what}")


def one_of(name: str, value: Any, *known: str) -> None:
    """Check that ``value`` is one of the known words."""
    if value not in known:
        raise ValueError(f"{name}={value!r}: must be {' or '.join(map(repr, known))}")


def known(what: str, name: Any, names: Iterable[str]) -> None:
    """Check that ``name`` is one of ``names``; the message suggests the closest one, and lists them all."""
    names = list(names)
    if not isinstance(name, str) or name not in names:
        near = difflib.get_close_matches(str(name), names, n=1)
        guess = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"no {what} {name!r}{guess} (there are: {', '.join(names)})")


def finite(name: str, value: ArrayLike) -> NDArray:
    """``value`` as a float64 array, if it holds finite numbers of a magnitude up to LARGEST."""
    # numbers
    try:
        array = np.asarray(value)
        if array.dtype.kind == "c":
            raise TypeError
        array = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}={value!r}: must be numbers") from None
    # within range; NaN is not
    within = np.abs(array) <= LARGEST
    if within.all():
        return array
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds a value that is not finite: {array[~np.isfinite(array)][0]}")
    raise ValueError(f"{name} holds {array[~within][0]:g}: must lie within {LARGEST:g}")


def vector(name: str, value: ArrayLike) -> NDArray:
    """``value`` as an array, (3,), if it is three finite numbers."""
    # the usual case, at once
    if type(value) is tuple and len(value) == 3 and all(type(each) is float and abs(each) <= LARGEST for each in value):
        return np.array(value)
    array = finite(name, value)
    if array.shape != (3,):
        raise ValueError(f"{name}={value!r}: must be three numbers")
    return array


def vectors(name: str, value: ArrayLike, number: int) -> NDArray:
    """``value`` broadcast to (number, 3), if it is one finite vector for all, or ``number`` of them."""
    array = finite(name, value)
    if array.shape not in ((3,), (1, 3), (number, 3)):
        raise ValueError(f"{name} has shape {array.shape}: must be (3,), for all, or {(number, 3)}")
    return np.broadcast_to(array, (number, 3))


def spread(name: str, value: NDArray, shape: tuple[int, ...]) -> NDArray:
    """``value`` broadcast to ``shape``, if it can be."""
    if value.shape == shape:
        return value
    try:
        return np.broadcast_to(value, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {value.shape}: must be one value for all, or {shape}") from None


def sheets(name: str, value: ArrayLike, shape: tuple[int, ...], *others: tuple[int, ...]) -> NDArray:
    """``value`` as an array, if it is finite and has ``shape``, (envs, particles, 3), its last two axes, or one of the others."""
    array = finite(name, value)
    if array.shape not in (shape, shape[1:], *others):
        raise ValueError(f"{name} has shape {array.shape}: must be {shape} or {shape[1:]}")
    return array


def indices(name: str, value: ArrayLike, end: int, what: str) -> NDArray:
    """``value`` as an int64 array, (count,), if it holds integers from 0 to ``end - 1``; what: their name in the message."""
    array = np.atleast_1d(np.asarray(value))
    if array.size == 0:
        return np.zeros(0, np.int64)
    if array.dtype.kind not in "iu" or array.ndim != 1 or array.min() < 0 or array.max() >= end:
        raise ValueError(f"{name}={value!r}: must be integers, {what} are 0 to {end - 1}")
    return array.astype(np.int64)

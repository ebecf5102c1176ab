"""Floor 0: checks of numbers that people give, with sentences that name them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def positive(name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}={value!r}: must be positive and finite")
    return float(value)


def finite(name: str, value: ArrayLike) -> NDArray:
    array = np.asarray(value, dtype=np.float64)
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds a value that is not finite: {array[~np.isfinite(array)][0]}")
    return array


def vector(name: str, value: ArrayLike) -> NDArray:
    array = finite(name, value)
    if array.shape != (3,):
        raise ValueError(f"{name}={value!r}: must be three numbers")
    return array

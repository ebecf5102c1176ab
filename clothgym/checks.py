"""Floor 0: checks of arguments.  They raise a ValueError that names the argument, its value and the valid values."""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

ALIKE = {"f": "fiu", "i": "iu", "u": "iu", "b": "b"}  # kinds of arrays that can take the place of one, by its kind
LARGEST = 1e30  # magnitude of a number: its differences over a control step are still finite in float32
LONGEST = 200  # characters of a value in a message
SMALLEST = 1e-30  # of what must be positive: its inverse is still finite in float32
MOST = 2**31 - 1  # of a count
MOST_PARTICLES = 10_000_000  # of a batch; a million of them need about a gigabyte
MOST_NUMBERS = 1_000_000_000  # of an argument
WITHIN = ("clothgym", "gymnasium", "functools", "contextlib")  # modules that lie between a warning and the line that it is about


def number(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number of a magnitude up to LARGEST; a tensor without axes is one."""
    # the usual case, at once
    if type(value) is float and abs(value) <= LARGEST:
        return value
    array = _as_numbers(value)
    if array is None or array.shape != () or not np.isfinite(array) or isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}={shown(value)}: must be a finite number")
    if not abs(array) <= LARGEST:
        raise ValueError(f"{name}={shown(value)}: must lie within {LARGEST:g}")
    return float(array)


def positive(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number from SMALLEST to LARGEST."""
    plain = number(name, value)
    if plain <= 0:
        raise ValueError(f"{name}={shown(value)}: must be positive and finite")
    if plain < SMALLEST:
        raise ValueError(f"{name}={shown(value)}: must be at least {SMALLEST:g}")
    return plain


def not_negative(name: str, value: Any) -> float:
    """``value`` as a float, if it is a finite number of at least zero."""
    plain = number(name, value)
    if plain < 0:
        raise ValueError(f"{name}={shown(value)}: must be zero or positive")
    return plain


def count(name: str, value: Any, what: str = "", least: int = 1, most: int = MOST) -> int:
    """``value`` as an int, if it is an integer from ``least`` to ``most``; what: begins the description in the message."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
    if not whole or value < least:
        raise ValueError(f"{name}={shown(value)}: must be {what}an integer of at least {least}")
    if value > most:
        raise ValueError(f"{name}={shown(value)}: must be {what}an integer of at most {most}")
    return int(value)


def check_memory(what: str, particles: int) -> None:
    """Check that so many particles fit into memory; what: names the arguments that ask for them, with their values."""
    if particles > MOST_PARTICLES:
        raise ValueError(
            f"{what}: {shown(particles)} particles need about {shown(particles // 1_000_000)} GB of memory; there may be "
            f"{MOST_PARTICLES} in a batch"
        )


def shown(value: Any) -> str:
    """``repr(value)``, shortened where it is long."""
    try:
        text = repr(value)
    except Exception:  # an integer of more digits than Python prints, or an object whose repr fails
        return f"<{type(value).__name__}>"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 20]} ... {text[-14:]}"


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn with the line outside of this package from which it was called."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in WITHIN:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _as_numbers(value: Any) -> NDArray[np.float64] | None:
    """A number, list, array or tensor as a float64 array, None where it is not of real numbers."""
    array = as_array(value)
    if array is None:
        return None
    if array.dtype.kind == "O" and all(type(one) is int for one in array.ravel()):
        # integers beyond 64 bits
        try:
            return array.astype(np.float64)
        except OverflowError:
            return None
    if array.dtype.kind not in "iuf" and array.size and not _is_short_float(array.dtype):
        return None
    with np.errstate(over="ignore"):  # numbers beyond float64 become infinite, and are refused
        return array.astype(np.float64, copy=False) if array.size else np.zeros(array.shape)


def _is_short_float(kind: np.dtype) -> bool:
    """Whether numbers are of a type that a library has added to NumPy's, as bfloat16 of JAX: NumPy has no letter for its kind."""
    return kind.kind == "V" and kind.names is None and "float" in kind.name and np.can_cast(kind, np.float64)


def as_array(value: Any) -> NDArray | None:
    """A number, list, array or tensor as an array of whatever it holds, None where it is none: ragged, masked or without end."""
    if type(value) is np.ndarray:
        return value
    if isinstance(value, range) and len(value) > MOST_NUMBERS:
        return None
    try:
        array = np.asarray(_plain(value) if hasattr(value, "detach") else value)
    except Exception:  # ragged, or an object or tensor whose own conversion fails
        return None
    return None if np.ma.is_masked(value) else array


def _plain(tensor: Any) -> Any:
    """A tensor whose numbers NumPy can take: detached from its gradients, on the processor, and of a type that NumPy has."""
    tensor = tensor.detach().cpu()
    try:
        return np.asarray(tensor)
    except TypeError:  # bfloat16 and shorter ones
        return tensor.float() if tensor.is_floating_point() else tensor


def _dtype_of(value: Any) -> str:
    """What a message says of the type of an array's or a tensor's elements, where it may be why that is refused."""
    kind = getattr(value, "dtype", None)
    return "" if kind is None or str(kind).endswith(("float32", "float64")) else f", not of {shown(kind)}: convert it to float32"


def numbers(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """``value`` as a float64 array, if it holds real numbers, finite or not, and has that shape."""
    array = _as_numbers(value)
    if array is None:
        raise ValueError(f"{name}={shown(value)}: must be an array of numbers, {shape}{_dtype_of(value)}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: must be {shape}")
    return array


def flag(name: str, value: Any) -> bool:
    """``value`` as a bool, if it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}={shown(value)}: must be True or False")
    return bool(value)


def mask(name: str, value: Any, length: int) -> NDArray[np.bool_]:
    """``value`` as a bool array, (length,), if it is one with at least one True."""
    array = as_array(value)
    if array is None or array.shape != (length,) or array.dtype != bool or not array.any():
        raise ValueError(f"{name} must be {length} booleans with at least one True, not {shown(value)}")
    return array


def members(name: str, value: Any, kind: type, what: str) -> None:
    """Check that ``value`` is a sequence of instances of the class ``kind``; what: their name in the message."""
    if not isinstance(value, Sequence) or len(value) > MOST_PARTICLES or not all(isinstance(one, kind) for one in value):
        raise ValueError(f"{name}={shown(value)}: must be a sequence of {what}")


def one_of(name: str, value: Any, *known: str) -> None:
    """Check that ``value`` is one of the known words."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name}={shown(value)}: must be {' or '.join(map(repr, known))}")


def known(what: str, name: Any, names: Iterable[str]) -> None:
    """Check that ``name`` is one of ``names``; the message suggests the closest one, and lists them all."""
    names = list(names)
    if not isinstance(name, str) or name not in names:
        near = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
        guess = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"no {what} {shown(name)}{guess} (there are: {', '.join(names)})")


def finite(name: str, value: ArrayLike) -> NDArray:
    """``value`` as a float64 array, if it holds finite numbers of a magnitude up to LARGEST."""
    array = _as_numbers(value)
    if array is None:
        raise ValueError(f"{name}={shown(value)}: must be numbers{_dtype_of(value)}")
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
        raise ValueError(f"{name}={shown(value)}: must be three numbers")
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
    array = as_array(value)
    array = np.full(1, np.nan) if array is None else np.atleast_1d(array)
    if array.shape == (0,):
        return np.zeros(0, np.int64)
    if array.dtype.kind not in "iu" or array.ndim != 1 or array.min() < 0 or array.max() >= end:
        raise ValueError(f"{name}={shown(value)}: must be integers, {what} are 0 to {end - 1}")
    return array.astype(np.int64)


def fits(
    name: str,
    given: Any,
    kept: NDArray,
    low: Any = -LARGEST,
    high: Any = LARGEST,
    excused: NDArray | None = None,
    advice: str = "give what get_state() gave",
) -> None:
    """Check that ``given`` can take the place of ``kept``: an array of that shape and kind, finite and from ``low`` to ``high``.

    excused: environments, (num_envs,), whose numbers may be anything.  An integer must also be one that the kept array can hold.
    """
    if not isinstance(given, (np.ndarray, np.generic)) or given.dtype.kind not in ALIKE[kept.dtype.kind]:
        raise ValueError(f"the state's {name} is no array of {kept.dtype.name}: {advice}")
    if given.shape != kept.shape:
        raise ValueError(f"the state's {name} has shape {given.shape}, this simulation's {kept.shape}: {advice}")
    if kept.dtype.kind == "b":
        return
    # floating point is compared as float64, integers exactly; NaN is neither above nor below anything
    numbers: NDArray = np.asarray(given)
    if kept.dtype.kind in "iu":
        holds = np.iinfo(kept.dtype)
        wrong = np.array((numbers < int(max(low, holds.min))) | (numbers > int(min(high, holds.max))))
    else:
        wrong = np.array(~((numbers >= np.float64(low)) & (numbers <= np.float64(high))))
    if excused is not None:
        wrong[excused] = False
    if wrong.any():
        value, least, most = (np.broadcast_to(each, given.shape)[wrong][0] for each in (given, low, high))
        why = "a value that is not finite" if not np.isfinite(value) else f"{value:g}: it must be from {least:g} to {most:g}"
        raise ValueError(f"the state's {name} holds {why}; {advice}")

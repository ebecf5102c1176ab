"""The sorts of kernels, and how each is compiled.

All of them: plain IEEE arithmetic (no fast-math), so that an environment's bits do not depend on who else is in its batch.
Compiled code is kept on disk (see ``cache``) by numba's own means and by some that are private to it (``numba_internals``).
Where numba is of a version with which those were not tested, or refuses them, kernels are compiled by its public means alone:
with the same results, and slower to start.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple, cast

import numba
import numpy as np

from clothgym._jit.cache import cache_folder, name_of
from clothgym.warning import warn_caller

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": False, "nogil": True, "boundscheck": False}
# NUMBA_DISABLE_JIT=1: kernels are plain Python, for debuggers and coverage
WITHOUT_JIT = bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]


class Flags(NamedTuple):
    """Compiler flags of a kind of kernels.  All are set: numba takes unset flags from the calling kernel.

    nrt: whether references to arrays are counted.  noalias: whether arguments are promised not to overlap.
    """

    nrt: bool
    noalias: bool


COUNTED, UNCOUNTED, DISJOINT = Flags(nrt=True, noalias=False), Flags(nrt=False, noalias=False), Flags(nrt=False, noalias=True)


def _with_internals(function: FunctionType, apart: bool, flags: Flags) -> Any:
    """A dispatcher with its flags, which loads and saves through the locked cache."""
    from clothgym._jit import numba_internals

    return numba_internals.arrange(function, apart, flags._asdict(), OPTIONS)


def _plainly(function: FunctionType, apart: bool, flags: Flags) -> Any:
    """A dispatcher by numba's public interface: its callees are linked into it, and ``flags`` are numba's own.

    numba tells kernels of one file apart by their name and line.  Here each has a folder of its own, as specialized ones share
    their lines, within the folder that is named by the digest of all sources: numba itself does not see an edit in a callee.
    """
    folder, before = cache_folder(), numba.config.CACHE_DIR  # type: ignore[attr-defined]
    if not folder.writable:
        return numba.njit(**OPTIONS)(function)
    try:
        # nothing in it has a checksum: it is closed to others
        plain = folder.folder_of(function.__module__) / "plain"
        plain.mkdir(mode=0o700, exist_ok=True)
        numba.config.CACHE_DIR = str(plain / name_of(function))  # type: ignore[attr-defined]
        return numba.njit(cache=True, **OPTIONS)(function)
    except (OSError, RuntimeError):  # no place to cache it, or it has been typed in, and lies in no file
        return numba.njit(**OPTIONS)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


def _choose() -> Callable[[FunctionType, bool, Flags], Any]:
    """How this process makes dispatchers.  CLOTHGYM_PLAIN_NUMBA=1: plainly; =0: with internals, whether tested or not."""
    wish = os.environ.get("CLOTHGYM_PLAIN_NUMBA", "")
    if wish == "1" or WITHOUT_JIT:
        return _plainly
    try:
        from clothgym._jit import numba_internals

        numba_internals.check(tested_only=wish != "0")
        return _with_internals
    except (ImportError, AttributeError, TypeError) as error:
        warn_caller(
            f"clothgym does not know numba {numba.__version__} ({error}): kernels are compiled plainly, which changes no results, "
            "but the first start of each scene takes minutes. Install a tested version, or set CLOTHGYM_PLAIN_NUMBA=1 to accept "
            "this without a warning."
        )
        return _plainly


_make = _choose()


def _in_python(function: Callable[..., Any], flags: Flags) -> Any:
    """A kernel that is not compiled: it divides by zero without a word, as a compiled one does."""

    @functools.wraps(function)
    def uncompiled(*args: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*args)

    uncompiled.py_func, uncompiled.flags = function, flags  # type: ignore[attr-defined]
    return uncompiled


def is_kept(compiled: Any) -> bool:
    """Whether the cache has some version of a kernel that is called from Python, as far as can be told."""
    if _make is _plainly:
        return True
    from clothgym._jit import numba_internals

    return numba_internals.is_kept(compiled)


def kernel(function: Callable[..., Any], apart: bool = False, flags: Flags = COUNTED) -> Any:
    """Compile ``function`` by the project's policy, at its first call, through the cache.

    Kernels take arrays and typed scalars only; they must not reduce across lanes (see ``docs/architecture.md``).

    apart: compile it once for all its callers, which jump to it.  Code of other kernels is linked into each calling kernel, and
    optimized again there.  This suits short kernels, but takes minutes in total for long kernels with many callers.
    flags: of the compiler, see ``disjoint``.
    """
    if WITHOUT_JIT:
        return _in_python(function, flags)
    dispatcher = _make(cast(FunctionType, function), apart, flags)
    dispatcher.flags = flags
    return dispatcher


def uncounted(function: Callable[..., Any]) -> Any:
    """An ``apart`` kernel that makes no arrays, and so does not count references to any.

    A count is an atomic addition for each array that is taken from a tuple or sliced: many of them take longer than a small
    sheet's forces.  It must not call counted kernels that return arrays, nor return any: ``inlined`` ones may.
    """
    return kernel(function, apart=True, flags=UNCOUNTED)


def disjoint(function: Callable[..., Any]) -> Any:
    """A ``kernel`` of loops over long rows that makes no arrays, and promises that its outputs do not overlap its other arguments.

    Without the promise every call tests all pairs of rows for overlap, which takes as long as a row of a hundred numbers.
    """
    return kernel(function, flags=DISJOINT)


def inlined(function: Callable[..., Any]) -> Any:
    """A part of the kernels that call it, by the same policy: for a long one with one caller, and for the shortest.

    It is compiled there alone.  A kernel's code is optimized again in each kernel above it, so a chain of long ones with one caller
    each would be optimized as often as it is long.
    """
    if WITHOUT_JIT:
        return function
    return numba.njit(inline="always", **OPTIONS)(function)


def apart(function: Callable[..., Any]) -> Any:
    """A ``kernel`` that is compiled once for all its callers."""
    return kernel(function, apart=True)

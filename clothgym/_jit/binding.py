"""One kernel from the code of another with other callees: how one substep loop serves every integrator without a copy.

numba's disk cache misses in each new process when a dispatcher is an argument or a closure variable, and hits when it is a
global.  So a function's code is taken with other globals.  The names that are to be bound so are declared with ``placeholder``.
"""

from __future__ import annotations

import dis
import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

from numba.extending import typeof_impl

from clothgym._jit.cache import package_folders
from clothgym._jit.policy import COUNTED, inlined, kernel


class _Placeholder:
    """A kernel that is not bound yet: calling it, or compiling a call of it, raises an error that says how to bind it."""

    def __init__(self, name: str, meaning: str) -> None:
        self.sentence = (
            f"{name} is a placeholder for a kernel ({meaning}): take the kernel itself, or call {name} in a function that is "
            f"compiled by specialize(function, name, {name}=kernel)"
        )

    def __call__(self, *args: Any) -> Any:
        raise TypeError(self.sentence)


@typeof_impl.register(_Placeholder)
def _refuse(unbound: _Placeholder, context: Any) -> Any:
    """What numba calls for the type of a global."""
    raise ValueError(unbound.sentence)


def placeholder(name: str, meaning: str) -> Callable[..., Any]:
    """Declare a name that ``specialize`` binds to a kernel, at the top of the module whose functions call it.

    meaning: description of the kernel's arguments and effect.
    """
    return _Placeholder(name, meaning)


def callees_of(function: Any, callees: Mapping[str, Any]) -> dict[str, Any]:
    """Those of ``callees`` whose names ``function`` uses."""
    names = _globals_of(getattr(function, "py_func", function))
    return {name: callee for name, callee in callees.items() if name in names}


def specialize(function: Any, name: str, apart: bool = False, inline: bool = False, **callees: Any) -> Any:
    """A ``kernel`` with the code of ``function`` in which the global names ``callees`` stand for the given kernels.

    Its name is ``name`` and a digest of who the callees are, so that the cache keeps all combinations apart.  A ``function`` that
    is a kernel already is made with its flags.  apart: see ``kernel``; inline: whether it is ``inlined``.

    Raises:
        ValueError: a name that the function does not use, by which nothing would change.
    """
    flags, function = getattr(function, "flags", COUNTED), getattr(function, "py_func", function)
    unused = callees.keys() - _globals_of(function)
    if unused:
        raise ValueError(
            f"{function.__qualname__} does not use {', '.join(sorted(unused))}, so nothing can be bound to it; it uses "
            f"{', '.join(sorted(_globals_of(function)))}"
        )
    name += "_" + _digest_of(callees)
    code = function.__code__.replace(co_name=name, co_qualname=name)
    bound = FunctionType(code, {**function.__globals__, **callees}, name)
    bound.__qualname__ = name
    bound.__module__ = function.__module__
    return inlined(bound) if inline else kernel(bound, apart, flags)


def _globals_of(function: FunctionType) -> set[str]:
    return {step.argval for step in dis.get_instructions(function) if step.opname == "LOAD_GLOBAL"}


def _digest_of(callees: Mapping[str, Any]) -> str:
    """Of their names, and of the sources of those from outside the package, which the name of the cache's folder does not cover."""
    digest = hashlib.sha256()
    for name, callee in sorted(callees.items()):
        callee = getattr(callee, "py_func", callee)
        digest.update(f"{name} {callee.__module__}.{callee.__qualname__} ".encode())
        path = Path(callee.__code__.co_filename)
        if not any(path.is_relative_to(folder) for folder in package_folders().values()):
            digest.update(path.read_bytes() if path.is_file() else os.urandom(8))
    return digest.hexdigest()[:12]

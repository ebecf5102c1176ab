"""One kernel from the code of another with other callees: how one substep loop serves every integrator without a copy.

numba's disk cache misses in each new process when a dispatcher is an argument or a closure variable, and hits when it is a
global.  So a function's code is taken with other globals.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from types import FunctionType
from typing import Any

from clothgym._jit.cache import package_folders
from clothgym._jit.policy import COUNTED, kernel


def specialize(function: Any, name: str, apart: bool = False, **callees: Any) -> Any:
    """A ``kernel`` with the code of ``function`` in which the global names ``callees`` stand for the given kernels.

    Its name is ``name`` and a digest of who the callees are, so that the cache keeps all combinations apart.  A ``function`` that
    is a kernel already is made with its flags.
    """
    flags, function = getattr(function, "flags", COUNTED), getattr(function, "py_func", function)
    name += "_" + _digest_of(callees)
    code = function.__code__.replace(co_name=name, co_qualname=name)
    bound = FunctionType(code, {**function.__globals__, **callees}, name)
    bound.__qualname__ = name
    bound.__module__ = function.__module__
    return kernel(bound, apart, flags)


def _digest_of(callees: dict[str, Any]) -> str:
    """Of their names, and of the sources of those from outside the package, which the name of the cache's folder does not cover."""
    digest = hashlib.sha256()
    for name, callee in sorted(callees.items()):
        callee = getattr(callee, "py_func", callee)
        digest.update(f"{name} {callee.__module__}.{callee.__qualname__} ".encode())
        path = Path(callee.__code__.co_filename)
        if not any(path.is_relative_to(folder) for folder in package_folders().values()):
            digest.update(path.read_bytes() if path.is_file() else os.urandom(8))
    return digest.hexdigest()[:12]

"""Floor 8: adapters to other libraries' interfaces. Each needs its library, and is imported on first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = ("lagrange", "lerobot", "pixels", "runs", "sb3")


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'clothgym.adapters' has no attribute {name!r}")
    return import_module(f"clothgym.adapters.{name}")


def __dir__() -> list[str]:
    return list(_MODULES)

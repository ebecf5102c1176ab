"""Floor 0: folders that environment variables and arguments name, as they were meant."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

CACHE = "CLOTHGYM_CACHE_DIR"


def keep() -> None:
    """Write the cache's folder into the environment as it is now, absolute and without ``~``.

    A program may change its own folder between the import and the first kernel, and start processes there.
    """
    value = os.environ.get(CACHE)
    if value and not (expanded := os.path.expanduser(value)).startswith("~"):
        os.environ[CACHE] = os.path.abspath(expanded)


def named(variable: str) -> Path | None:
    """The folder that an environment variable names, absolute and without ``~``; None where it names none.

    Raises:
        RuntimeError: ``~`` has no meaning here: there is no home folder.
    """
    value = os.environ.get(variable)
    return Path(value).expanduser().absolute() if value else None


def expand_paths(arguments: Any) -> None:
    """Put the home folder in the place of ``~`` in a script's arguments, a dataclass: no shell does in ``--run=~/runs``."""
    for field in dataclasses.fields(arguments):
        value = getattr(arguments, field.name, None)
        if isinstance(value, Path):
            setattr(arguments, field.name, value.expanduser())

"""Formats of data sets, a module each, which needs its library.

``write(folder, about, episodes)`` writes a set into an empty folder, one episode in memory at a time; about: what the recording is.
``read(folder, about)`` gives its episodes: ``actions``, (T, numbers), ``rewards``, (T,), and observations by LeRobot's keys,
(T, ...) each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

FORMATS = {"lerobot": "pyarrow", "minari": "minari", "robomimic": "h5py"}


class Format(NamedTuple):
    """The functions of a format's module."""

    write: Callable[[Path, dict[str, Any], Iterator[Any]], None]
    read: Callable[[Path, dict[str, Any]], Iterator[dict[str, NDArray]]]


def named(name: str) -> Format:
    """A format by its name.

    Raises:
        ImportError: its library is missing; the message says how to get it.
    """
    try:
        module = import_module(f"formats.{name}")
    except ImportError as error:
        raise ImportError(f"--format {name} needs {FORMATS[name]} ({error}): pip install 'clothgym[record]'") from error
    return Format(module.write, module.read)

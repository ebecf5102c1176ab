"""Floor 0: warnings that point at the line of whoever called the package."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

# packages whose lines nobody looks for: this one, and those that call it on somebody's behalf, as ``gymnasium.make`` does
BETWEEN = frozenset(
    ("clothgym", "gymnasium", "minari", "numba", "ray", "rl_zoo3", "skrl", "stable_baselines3", "tianshou", "torchrl")
)


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn, at the innermost line that is neither the package's nor one of those between; at the outermost, if all of them are.

    Python 3.12 has ``skip_file_prefixes`` for that.
    """
    frame = sys._getframe(1)
    while _is_between(frame) and frame.f_back is not None:
        frame = frame.f_back
    space = frame.f_globals
    registry = space.setdefault("__warningregistry__", {})
    name = str(space.get("__name__") or "<unknown>")
    warnings.warn_explicit(message, category, frame.f_code.co_filename, frame.f_lineno, name, registry)


def _is_between(frame: FrameType) -> bool:
    top = str(frame.f_globals.get("__name__") or "").partition(".")[0]
    return top in BETWEEN or top in sys.stdlib_module_names

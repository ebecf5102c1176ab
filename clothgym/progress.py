"""Floor 0: progress in the terminal's last line, with a count of steps; no output if stderr is no terminal."""

from __future__ import annotations

import sys

LENGTH, WIDTH = 20, 78  # of a bar and of the whole line, in characters


def show(what: str, done: int = 0, total: int = 0) -> None:
    """Rewrite the line: ``done`` steps of ``total``, as a bar if the total is known, and the present activity."""
    count = f"{'#' * (LENGTH * done // total):-<{LENGTH}} {done} of {total}  " if total else f"{done}  " if done else ""
    if sys.stderr.isatty():
        print(f"\r{(count + what)[:WIDTH]:<{WIDTH}}", end="", file=sys.stderr, flush=True)


def clear() -> None:
    """Clear the line."""
    if sys.stderr.isatty():
        print(f"\r{'':<{WIDTH}}\r", end="", file=sys.stderr, flush=True)

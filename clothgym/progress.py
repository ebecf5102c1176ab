"""Floor 0: the terminal's last line says what is being done and counts steps; where stderr is no terminal there is silence."""

from __future__ import annotations

import sys

LENGTH, WIDTH = 20, 78  # of a bar and of the whole line, in characters


def show(what: str, done: int = 0, total: int = 0) -> None:
    """Rewrite the line: ``done`` steps of ``total``, as a bar if the total is known, and what is being done now."""
    count = f"{'#' * (LENGTH * done // total):-<{LENGTH}} {done} of {total}  " if total else f"{done}  " if done else ""
    if sys.stderr.isatty():
        print(f"\r{(count + what)[:WIDTH]:<{WIDTH}}", end="", file=sys.stderr, flush=True)


def clear() -> None:
    """Leave the line empty, for what is printed next."""
    if sys.stderr.isatty():
        print(f"\r{'':<{WIDTH}}\r", end="", file=sys.stderr, flush=True)

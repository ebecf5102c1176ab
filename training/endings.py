"""How a script ends on an error: with a line on stderr, without a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from clothgym.adapters.runs import CONFIG


@contextmanager
def refused() -> Iterator[None]:
    """What was given wrongly, found while it is put to use: a sentence, and the status of a wrong flag."""
    try:
        yield
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


@contextmanager
def stopped(remedy: Callable[[], str] = lambda: "") -> Iterator[None]:
    """Ctrl+C: a word, what to do next, and the status that shells have for it.  A full disk: a sentence, and what to do next."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"\nstopped{remedy()}", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        print(f"error: {error}{remedy()}", file=sys.stderr)
        raise SystemExit(1) from None


def going_on(script: str, folder: Path) -> str:
    """The remedy of a run that has begun: how to go on with it."""
    return f": go on with  python training/{script} --resume {folder}" if (folder / CONFIG).exists() else ""

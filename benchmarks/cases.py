"""Cases of a benchmark, in a file that keeps those that are measured, and their table."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from clothgym.lab.bench import machine

Row = dict[str, Any]
Case = tuple[Callable[..., Row], Row]  # what measures, and the arguments by which the row is known again


def parsed(description: str | None) -> argparse.Namespace:
    """``--select`` and ``--fresh``, as ``fill`` takes them."""
    parser = argparse.ArgumentParser(description=(description or "").split("\n")[0])
    parser.add_argument("--select", nargs="*", default=[], metavar="WORD", help="only cases whose names hold all these words")
    parser.add_argument("--fresh", action="store_true", help="measure existing cases again")
    return parser.parse_args()


def fill(path: Path, sections: dict[str, list[Case]], select: list[str], fresh: bool, about: Row) -> Row:
    """Measure the missing cases of the file, and write each at once, so that an interrupted run can continue."""
    path.parent.mkdir(exist_ok=True)
    results: Row = {"machine": machine(), "about": about} | (json.loads(path.read_text()) if path.exists() and not fresh else {})
    wanted = [(name, *case) for name, rows in sections.items() for case in rows]
    wanted = [(name, measure, key) for name, measure, key in wanted if all(word in f"{name} {key}" for word in select)]
    for name, measure, key in tqdm(wanted, unit="case", disable=None):
        rows = results.setdefault(name, [])
        if not any(key.items() <= row.items() for row in rows):
            rows.append(key | measure(**key))
            part = path.with_suffix(".part")
            part.write_text(json.dumps(results, indent=1) + "\n")
            part.replace(path)
    return results


def table(rows: list[Row]) -> str:
    """Rows as text, one column a key."""
    heads = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[f"{v:.4g}" if isinstance(v := row.get(key, ""), float) else str(v) for key in heads] for row in rows]
    widths = [max(len(line[k]) for line in [heads, *cells]) for k in range(len(heads))]
    return "\n".join("  ".join(text.rjust(width) for text, width in zip(line, widths)) for line in [heads, *cells])

"""The scripts of docs/clients.md."""

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "clients.md").read_text()
SECTIONS = {part.partition("\n")[0]: part for part in PAGE.split("\n## ")[1:]}  # by their headings


def script(heading: str) -> str:
    """The one script below the heading that begins so."""
    (text,) = (text for name, text in SECTIONS.items() if name.startswith(heading))
    (found,) = re.findall(r"```(?:python)?\n(.*?)```", text, re.DOTALL)
    return found


def run(heading: str) -> dict[str, Any]:
    """Run it, and return the names that it leaves."""
    names: dict[str, Any] = {}
    exec(compile(script(heading), f"docs/clients.md, {heading}", "exec"), names)
    return names

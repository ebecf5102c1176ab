"""The training scripts, run as a user runs them, and within the tests' own process."""

import contextlib
import importlib
import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

ROOT = Path(__file__).parent.parent


def run(script, *arguments, cwd):
    command = [sys.executable, str(ROOT / "training" / script), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def call(script, *arguments):
    """The same without a process of its own, which would import torch anew: needs the fixture ``scripts``."""
    import tyro

    module, code = importlib.import_module(script.removesuffix(".py")), 0
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            module.main(tyro.cli(module.Args, args=list(map(str, arguments))))
        except SystemExit as end:
            code = end.code
    return SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue(), returncode=code)

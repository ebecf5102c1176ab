"""Training runs that are killed at any moment, half of them while a file is written: each goes on with ``--resume``.

Each attack forks, so that torch and kernels are loaded once.  A child trains for a second or so and is killed: by the clock, or by
itself at the n-th step of writing files (half of the bytes written, not yet synced, not yet renamed).  Another one resumes, and
must come to the end.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

SCRIPTS = Path(__file__).resolve().parents[2] / "training"
SHORT = """
ClothReach-v0:
  {n_envs: 4, n_timesteps: 160, policy: MlpPolicy, n_steps: 10, batch_size: 40, n_epochs: 1, policy_kwargs: {net_arch: [8]}}
"""
STEPS_OF_WRITING = 60  # more than a run has
SECONDS = 0.5  # in which most of a run lies, from its configuration on


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        form, seed = (killed_by_the_clock, killed_while_writing)[rng.integers(2)], int(rng.integers(2**31))
        yield f"attacks.kills.{form.__name__}({seed})", lambda form=form, seed=seed: form(seed)  # type: ignore[misc]


def killed_by_the_clock(seed: int) -> None:
    """Kill a run after some time, and resume it.

    Raises:
        AssertionError: it does not come to the end.
    """
    _kill_and_resume(seconds=float(np.random.default_rng(seed).uniform(0, SECONDS)))


def killed_while_writing(seed: int) -> None:
    """Kill a run at some step of writing a file, and resume it.

    Raises:
        AssertionError: it does not come to the end.
    """
    _kill_and_resume(step=int(np.random.default_rng(seed).integers(STEPS_OF_WRITING)))


def _kill_and_resume(seconds: float | None = None, step: int | None = None) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "short.yml").write_text(SHORT)
        child = _child(folder, step, "--run", str(folder / "run"), "--env", "ClothReach-v0")
        if seconds is not None:
            # from its configuration on there is something to go on with
            while not (folder / "run" / "config.json").exists() and not os.waitid(
                os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT
            ):
                time.sleep(0.002)
            time.sleep(seconds)
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        if not (folder / "run" / "config.json").exists():
            return  # nothing had begun
        _, status = os.waitpid(_child(folder, None, "--resume", str(folder / "run")), 0)
        said = (folder / "said").read_text()
        assert status == 0 and (folder / "run" / "evaluation.json").exists(), f"status {status}: {said[-500:]}"
        assert "Traceback" not in said, said[-500:]


def _child(folder: Path, step: int | None, *arguments: str) -> int:
    """Train in another process; its number."""
    _preloaded()
    child = os.fork()
    if child:
        return child
    try:
        file = os.open(folder / "said", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.chdir(folder)
        if step is not None:
            _die_at(step)
        _train(arguments)
        status = 0
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        status = 1
    os._exit(status)


@cache
def _preloaded() -> Any:
    """What takes seconds to load, and is not in every installation; with the kernels of an episode."""
    if str(SCRIPTS) not in sys.path:
        sys.path.insert(0, str(SCRIPTS))
    import learning
    import torch._dynamo
    import torch.utils.tensorboard  # noqa: F401

    learning.evaluate.run_episodes("ClothReach-v0", learning.policies.expert, [0], progress=False)
    return learning


def _train(arguments: tuple[str, ...]) -> None:
    """``training/train.py``, with an evaluation after each rollout and without pictures."""
    learning = _preloaded()
    import train
    import tyro

    begin = learning.HeldOutEvaluation.__init__

    def often(watch: Any, folder: Path, config: Any, every: int, *others: Any) -> None:
        begin(watch, folder, config, 1, *others)

    learning.HeldOutEvaluation.__init__ = often
    learning.film = learning.draw_learning_curve = lambda *ignored: None
    common = ("--hyperparams", "short.yml", "--eval-episodes", "1", "--final-episodes", "1")
    train.main(tyro.cli(train.Args, args=(*arguments, *common)))


def _die_at(step: int) -> None:
    """Be killed at the n-th step of writing: after half of the bytes, before they are synced, or before or after a renaming."""
    left = [step]

    def count() -> bool:
        left[0] -= 1
        return left[0] < 0

    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    write, replace, sync = Path.write_bytes, Path.replace, os.fsync

    def write_bytes(path: Path, content: bytes) -> int:
        if count():
            write(path, content[: len(content) // 2])
            die()
        return write(path, content)

    def renamed(path: Path, target: Any) -> Any:
        if count():
            die()
        result = replace(path, target)
        if count():
            die()
        return result

    def synced(file: int) -> None:
        if count():
            die()
        sync(file)

    Path.write_bytes, Path.replace, os.fsync = write_bytes, renamed, synced  # type: ignore[method-assign, assignment]

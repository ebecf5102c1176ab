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
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

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
        config = folder / "run" / "config.json"

        def watch(child: int) -> None:
            # from its configuration on there is something to go on with
            while not config.exists() and not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                time.sleep(0.002)
            time.sleep(seconds or 0.0)
            os.kill(child, signal.SIGKILL)

        trained(
            folder, "--run", str(folder / "run"), "--env", "ClothReach-v0", "--hyperparams", "short.yml",
            prepare=None if step is None else lambda: _die_at(step), watch=None if seconds is None else watch,
        )  # fmt: skip
        if not config.exists():
            return  # nothing had begun
        status, said = trained(folder, "--resume", str(folder / "run"))
        assert status == 0 and (folder / "run" / "evaluation.json").exists(), f"status {status}: {said[-500:]}"
        assert "Traceback" not in said, said[-500:]


def trained(
    folder: Path, *arguments: str, prepare: Callable[[], None] | None = None, watch: Callable[[int], None] | None = None
) -> tuple[int, str]:
    """``training/train.py`` in another process, within a folder; see ``forked``.  prepare: what the process does first."""
    _preloaded()
    (folder / "short.yml").write_text(SHORT)

    def train() -> None:
        os.chdir(folder)
        if prepare is not None:
            prepare()
        _train(arguments)

    return forked(train, watch)


def forked(work: Callable[[], None], watch: Callable[[int], None] | None = None) -> tuple[int, str]:
    """Exit status and output of some work in another process.  watch: what is done meanwhile, with the number of that process."""
    read, write = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(write, 1)
        os.dup2(write, 2)
        _work(work)
    os.close(write)
    with open(read, "rb") as pipe, ThreadPoolExecutor(1) as reader:
        said = reader.submit(pipe.read)
        if watch is not None:
            watch(child)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return status, said.result().decode(errors="replace")


def _work(work: Callable[[], None]) -> NoReturn:
    """Work, and end this process with the status of a script."""
    status = 0
    try:
        work()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        print(ended.code if isinstance(ended.code, str) else "", file=sys.stderr, flush=True)
    except BaseException:
        traceback.print_exc()
        status = 70
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
    import endings
    import train
    import tyro

    learning.film = learning.draw_learning_curve = lambda *ignored: None
    common = ("--evaluations", "4", "--eval-episodes", "1", "--final-episodes", "1")
    with endings.stopped():
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

"""Training runs that are killed, or whose disk fills up, at any moment: each goes on with ``--resume``.

    python benchmarks/kills.py --count 100 --seed 0
    python benchmarks/kills.py --count 20 --script sac_single_file

Each run is a fork of a process that has loaded torch and the kernels.  It trains for a second or so.  It is killed by the clock, or
by itself at the n-th step of writing files (half of the bytes written, not yet synced, not yet renamed); or from that step on the
disk is full.  Then another run resumes, and must come to the end.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

SCRIPTS = Path(__file__).resolve().parents[1] / "training"
SHORT = """
ClothReach-v0:
  {n_envs: 4, n_timesteps: 160, policy: MlpPolicy, n_steps: 10, batch_size: 40, n_epochs: 1, policy_kwargs: {net_arch: [8]}}
"""
OPTIONS = (
    '{"n_envs": 4, "random_decisions": 100, "timesteps": 1600, "updates": 1, "batch_size": 16, "net_arch": [8], "buffer_size": 300}'
)
# arguments of a new run, by script
BEGIN = {
    "train": ("--env", "ClothReach-v0", "--hyperparams", "short.yml"),
    "sac_single_file": ("--env", "ClothReach-v0", "--options", OPTIONS),
}
STEPS_OF_WRITING = 60  # more than a run has
SECONDS = 0.5  # in which most of a run lies, from its configuration on


def killed_by_the_clock(rng: np.random.Generator, script: str = "train") -> None:
    """Kill a run after some time, and resume it."""
    seconds = rng.uniform(0, SECONDS)

    def watch(child: int, config: Path) -> None:
        # from its configuration on there is something to go on with
        while not config.exists() and not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            time.sleep(0.002)
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)

    _interrupt_and_resume(script, watch=watch)


def killed_while_writing(rng: np.random.Generator, script: str = "train") -> None:
    """Kill a run at some step of writing a file, and resume it."""
    step = int(rng.integers(STEPS_OF_WRITING))
    _interrupt_and_resume(script, lambda: _from_a_step_of_writing_on(step, lambda: os.kill(os.getpid(), signal.SIGKILL)))


def full_disk(rng: np.random.Generator, script: str = "train") -> None:
    """Train on a disk that is full from some step of writing on, and resume when there is room."""
    step = int(rng.integers(STEPS_OF_WRITING))

    def full() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    status, said, left = _interrupt_and_resume(script, lambda: _from_a_step_of_writing_on(step, full))
    assert status == 0 or (status == 1 and "error:" in said), f"status {status}: {said[-500:]}"
    assert "Traceback" not in said and left == [], f"left {left}: {said[-500:]}"


FORMS = (killed_by_the_clock, killed_while_writing, full_disk)


def _interrupt_and_resume(
    script: str, prepare: Callable[[], None] = lambda: None, watch: Callable[[int, Path], None] | None = None
) -> tuple[int, str, list[str]]:
    """How the first run ends: its status, its output, and half-written files that it leaves.

    Raises:
        AssertionError: the second one does not come to its end.
    """
    _preloaded()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "short.yml").write_text(SHORT)
        run, config = folder / "run", folder / "run" / "config.json"

        def begin() -> None:
            os.chdir(folder)
            prepare()
            _train(script, "--run", str(run), *BEGIN[script])

        status, said = _forked(begin, (lambda child: watch(child, config)) if watch is not None else None)
        left = [path.name for path in run.rglob("*") if ".part" in path.name or path.suffix == ".new"]
        if config.exists():
            ended, heard = _forked(lambda: _train(script, "--resume", str(run)))
            assert ended == 0 and (run / "evaluation.json").exists(), f"resumed with status {ended}: {heard[-500:]}"
            assert "Traceback" not in heard, heard[-500:]
        return status, said, left


def _forked(work: Callable[[], None], watch: Callable[[int], None] | None = None) -> tuple[int, str]:
    """Exit status and output of some work in another process.  watch: called meanwhile with the id of that process."""
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
    except BaseException:
        traceback.print_exc()
        status = 70
    sys.stdout.flush()
    os._exit(status)


@cache
def _preloaded() -> Any:
    """What takes seconds to load, with the kernels of an episode."""
    sys.path.insert(0, str(SCRIPTS))
    import learning
    import torch._dynamo
    import torch.utils.tensorboard

    torch.set_num_threads(1)  # the threads of OpenMP are lost in a fork, and waited for
    learning.scoring.run_episodes("ClothReach-v0", learning.policies.expert, [0], progress=False)
    return learning


def _train(script: str, *arguments: str) -> None:
    """A script of ``training/``, with few episodes in its evaluations and without pictures."""
    learning = _preloaded()
    import endings
    import sac_single_file
    import train
    import tyro

    learning.film = learning.draw_learning_curve = lambda *ignored: None
    module, work = (train, train.main) if script == "train" else (sac_single_file, sac_single_file.train)
    common = ("--evaluations", "4", "--eval-episodes", "1", "--final-episodes", "1")
    with endings.stopped():
        work(tyro.cli(module.Args, args=(*arguments, *common)))


def _from_a_step_of_writing_on(step: int, act: Callable[[], None]) -> None:
    """Act at the n-th step of writing and at all later ones: after half of the bytes, before a sync, before or after a renaming."""
    left = [step]

    def count() -> bool:
        left[0] -= 1
        return left[0] < 0

    write, replace, sync = Path.write_bytes, Path.replace, os.fsync

    def write_bytes(path: Path, content: bytes) -> int:
        if count():
            write(path, content[: len(content) // 2])
            act()
        return write(path, content)

    def renamed(path: Path, target: Any) -> Any:
        if count():
            act()
        result = replace(path, target)
        if count():
            act()
        return result

    def synced(file: int) -> None:
        if count():
            act()
        sync(file)

    Path.write_bytes, Path.replace, os.fsync = write_bytes, renamed, synced  # type: ignore[method-assign, assignment]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="runs (default 100)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--script", choices=BEGIN, default="train", help="the script that is killed (default train)")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    for one in range(args.count):
        form = FORMS[rng.integers(len(FORMS))]
        form(rng, args.script)
        print(f"{one + 1} of {args.count}: {form.__name__}", flush=True)


if __name__ == "__main__":
    main()

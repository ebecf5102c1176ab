"""A Ray cluster of two nodes on this machine, one of which is killed and comes back while training/rllib_train.py goes on.

    python benchmarks/rllib_cluster.py          # writes benchmarks/results/rllib.json, draws docs/cluster.png
    python benchmarks/rllib_cluster.py --draw   # draws what there is

Two runs of ClothReach-v0 with the hyperparameters of training/hyperparams/ppo.yml.  One has a runner on each of two
nodes; after some iterations all processes of the second node get SIGKILL, later a new node joins, and Ray starts the runner there.
The other has one runner, on one node.  Both nodes listen on loopback only.  Needs pip install ".[rllib]".
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from clothgym import files
from clothgym.lab.bench import machine

ROOT = Path(__file__).parent.parent
RESULTS, PICTURE = ROOT / "benchmarks" / "results" / "rllib.json", ROOT / "docs" / "cluster.png"
ENV = "ClothReach-v0"
WARM_UP = 1  # iterations, left out of the medians
PHASE = 6  # iterations before the node is killed, without it, and with the new one
LONGEST = 900  # seconds to wait for an iteration


class Run:
    """A training run on a cluster, watched through its progress.jsonl."""

    def __init__(self, address: str, runners: int, folder: Path) -> None:
        # by itself it would learn for longer than it is watched
        flags = ("--env", ENV, "--address", address, "--runners", runners, "--run", folder, "--timesteps", 10**6)
        command = [sys.executable, ROOT / "training" / "rllib_train.py", *flags]
        self.path = folder / "progress.jsonl"
        self.process = subprocess.Popen([str(part) for part in command], stdout=subprocess.DEVNULL)

    def lines(self) -> list[dict[str, Any]]:
        text = self.path.read_text() if self.path.exists() else ""
        return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]

    def wait(self, enough: Any) -> None:
        """Until ``enough(lines)``.

        Raises:
            RuntimeError: the run has ended before that, or an iteration takes longer than LONGEST.
        """
        last, begun = 0, time.monotonic()
        while not enough(lines := self.lines()):
            if len(lines) > last:
                last, begun = len(lines), time.monotonic()
            if self.process.poll() is not None or time.monotonic() - begun > LONGEST:
                raise RuntimeError(f"the run has ended, or hangs, after {last} iterations; its status is {self.process.poll()}")
            time.sleep(0.2)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()


def joined(cluster: Any) -> Any:
    """A node more.  Ray gives up on one that has not started within half a minute, as happens on a busy machine."""
    for _ in range(10):
        try:
            return cluster.add_node(num_cpus=1)
        except Exception as error:
            print(f"trying again: {error}")
    raise RuntimeError("no node has started")


def kill(node: Any) -> int:
    """SIGKILL to all of a node's processes, as if its machine had lost power; how many there were."""
    (raylet,) = [one.process for one in node.all_processes["raylet"]]
    children = Path(f"/proc/{raylet.pid}/task/{raylet.pid}/children").read_text().split()
    for pid in (raylet.pid, *map(int, children)):
        os.kill(pid, signal.SIGKILL)
    raylet.wait()
    return 1 + len(children)


def speeds(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Steps per second of some iterations: median, lowest and highest."""
    numbers = [line["steps_per_second"] for line in lines]
    return {"iterations": len(numbers), "median": statistics.median(numbers), "lowest": min(numbers), "highest": max(numbers)}


def alone(folder: Path) -> dict[str, Any]:
    """Steps per second with one runner on one node."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    run = Run(cluster.address, 1, folder)
    try:
        run.wait(lambda lines: len(lines) >= WARM_UP + PHASE)
    finally:
        run.stop()
        cluster.shutdown()
    return speeds(run.lines()[WARM_UP:])


def with_a_lost_node(folder: Path) -> dict[str, Any]:
    """Steps per second before, during and after a node's absence, and what each iteration did."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    node = joined(cluster)
    run = Run(cluster.address, 2, folder)
    try:
        run.wait(lambda lines: len(lines) >= WARM_UP + PHASE)
        killed_at, processes = len(run.lines()), kill(node)
        run.wait(lambda lines: sum(line["runners"] == 1 for line in lines) >= PHASE)
        joined_at = len(run.lines())
        joined(cluster)
        run.wait(lambda lines: len(lines) > joined_at + PHASE and all(line["runners"] == 2 for line in lines[-PHASE:]))
    finally:
        run.stop()
        cluster.shutdown()
    lines = run.lines()
    before, during = lines[WARM_UP:killed_at], [line for line in lines[killed_at + 1 : joined_at] if line["runners"] == 1]
    steps = [line["timesteps"] for line in lines]
    return {
        "processes_killed": processes,
        "killed_after_iteration": killed_at,
        "joined_after_iteration": joined_at,
        "back_after_iteration": max(line["iteration"] for line in lines if line["runners"] == 1),
        "seconds_of_the_iteration_with_the_kill": lines[killed_at]["training_seconds"] - lines[killed_at - 1]["training_seconds"],
        "steps_each_iteration": sorted({b - a for a, b in zip([0, *steps], steps)}),
        "steps_per_second": {"before": speeds(before), "during": speeds(during), "after": speeds(lines[-PHASE:])},
        "lines": lines,
    }


def draw(result: dict[str, Any]) -> None:
    """Steps per second over the run with the lost node, and against the number of runners."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    lost = result["lost_node"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained", width_ratios=(3, 1), sharey=True)
    seconds = [line["training_seconds"] for line in lost["lines"]]
    left.step(seconds, [line["steps_per_second"] for line in lost["lines"]], where="pre", color="tab:blue")
    for name, iteration, color in (("node killed", "killed", "tab:red"), ("node joins", "joined", "tab:green")):
        at = seconds[lost[f"{iteration}_after_iteration"] - 1]
        left.axvline(at, color=color)
        left.text(at, 0, f" {name}", color=color, va="bottom")
    back = seconds[lost["back_after_iteration"] - 1]
    left.axvspan(seconds[lost["killed_after_iteration"] - 1], back, color="tab:red", alpha=0.1, label="one runner of two")
    left.set(xlabel="training time [s]", ylabel="environment steps / s", ylim=(0, None))
    left.legend(loc="upper right")
    rows = [result["runners"][name] for name in ("1", "2")]
    middle = [row["median"] for row in rows]
    spread = [[row["median"] - row["lowest"] for row in rows], [row["highest"] - row["median"] for row in rows]]
    right.bar(("1", "2"), middle, yerr=spread, color="tab:blue", width=0.5, capsize=4)
    right.set(xlabel="runners", title=f"on {result['cores']} core{'s' * (result['cores'] > 1)}")
    figure.savefig(PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="draw what there is, and measure nothing")
    parser.add_argument("--note", default="", help="what else is to be said of the machine")
    options = parser.parse_args()
    if options.draw:
        draw(files.read_json(RESULTS, "measurement on a cluster", "remove it, and make it anew"))
        return
    # Ray: no usage statistics, its servers on loopback only, and processes no nicer than others
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_worker_niceness": "0"}
    import ray
    import torch

    about = machine()
    about["versions"] |= {"ray": ray.__version__, "torch": torch.__version__}
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        lost, one = with_a_lost_node(Path(folder) / "lost"), alone(Path(folder) / "alone")
    result = {"machine": about, "cores": cores, "note": options.note, "env": ENV, "lost_node": lost}
    result["runners"] = {"1": one, "2": lost["steps_per_second"]["before"]}
    files.write_json(RESULTS, result)
    print(json.dumps(lost | {"lines": len(lost["lines"]), "one runner": one}, indent=1))
    draw(result)


if __name__ == "__main__":
    main()

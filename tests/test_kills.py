"""benchmarks/kills.py: runs of ClothReach-v0 that are killed, or whose disk fills up, go on."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train", "sac_single_file"])
def test_interrupted_runs_go_on(name):
    script = Path(__file__).parents[1] / "benchmarks" / "kills.py"
    done = subprocess.run(
        [sys.executable, script, "--count", "6", "--seed", "1", "--script", name], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert {line.rpartition(" ")[2] for line in done.stdout.split("\n")} >= {"killed_while_writing", "full_disk"}, done.stdout

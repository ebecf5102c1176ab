"""RL Baselines3 Zoo trains with our hyperparameter files, and optimizes them (pip install rl_zoo3 pandas)."""

import os
import shlex
import subprocess
import sys

import pytest
from page import ROOT, script

SHORT = ("-n", "600", "--eval-freq", "300", "--eval-episodes", "2", "--n-eval-envs", "1", "-params", "n_envs:2")
OPTIMIZE = ("--optimize", "--n-trials", "2", "--sampler", "random", "--pruner", "none", "--n-evaluations", "1")


@pytest.mark.parametrize(("more", "written"), [((), "ppo/ClothReach-v0_1/ClothReach-v0.zip"), (OPTIMIZE, "ppo/report_*.csv")])
def test_it_trains_and_optimizes(tmp_path, more, written):
    pytest.importorskip("rl_zoo3", exc_type=ImportError)
    pytest.importorskip("pandas")
    # the page's command, elsewhere than in the checkout, which would be imported in place of what is installed
    python, *words = shlex.split(
        script("RL Baselines3 Zoo").replace("training/hyperparams", str(ROOT / "training" / "hyperparams"))
    )
    assert python == "python"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *words, "--log-folder", tmp_path, *SHORT, *more]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    assert list(tmp_path.glob(written))

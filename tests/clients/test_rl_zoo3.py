"""RL Baselines3 Zoo trains with our hyperparameter files, and optimizes them (pip install rl_zoo3 pandas)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HYPERPARAMETERS = Path(__file__).parents[2] / "training" / "hyperparams" / "ppo.yml"
SHORT = ("-n", "600", "--eval-freq", "300", "--eval-episodes", "2", "--n-eval-envs", "1", "-params", "n_envs:2")
OPTIMIZE = ("--optimize", "--n-trials", "2", "--sampler", "random", "--pruner", "none", "--n-evaluations", "1")


@pytest.mark.parametrize(("more", "written"), [((), "ppo/ClothReach-v0_1/ClothReach-v0.zip"), (OPTIMIZE, "ppo/report_*.csv")])
def test_it_trains_and_optimizes(tmp_path, more, written):
    pytest.importorskip("rl_zoo3", exc_type=ImportError)
    pytest.importorskip("pandas")
    command = [sys.executable, "-m", "rl_zoo3.train", "--algo", "ppo", "--env", "ClothReach-v0", "--gym-packages", "clothgym"]
    given = ["--conf-file", HYPERPARAMETERS, "--log-folder", tmp_path, *SHORT, *more]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.run([*command, *given], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    assert list(tmp_path.glob(written))

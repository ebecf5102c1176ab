"""training/rllib_train.py: a short run on a Ray of this machine, resumed and exported, and with a runner killed; make rllib."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from training_runs import ROOT, run

import clothgym

ray = pytest.importorskip("ray")
STEPS = 32 * 40  # of an iteration on ClothReach-v0, as training/hyperparams/ppo.yml has it


def test_a_run_is_exported_and_goes_on(tmp_path):
    import torch
    from ray.rllib.core.rl_module.rl_module import RLModule

    def steps(*arguments):
        done = run("rllib_train.py", "--env", "ClothReach-v0", "--run", "short", *arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return [json.loads(line)["timesteps"] for line in (tmp_path / "short" / "progress.jsonl").read_text().splitlines()]

    assert steps("--timesteps", 2 * STEPS) == [STEPS, 2 * STEPS]
    assert steps("--timesteps", 3 * STEPS, "--resume") == [STEPS, 2 * STEPS, 3 * STEPS]
    again = run("rllib_train.py", "--env", "ClothReach-v0", "--run", "short", cwd=tmp_path)
    assert again.returncode and "--resume" in again.stderr
    # the file does what the network does
    (kept,) = (tmp_path / "short").glob("checkpoint_*")
    network = RLModule.from_checkpoint(kept / "learner_group" / "learner" / "rl_module" / "default_policy")
    policy = clothgym.policies.read(tmp_path / "short" / "policy.npz")
    seen, _ = policy.make_vec(50).reset(seed=3)
    wanted = network.forward_inference({"obs": torch.from_numpy(seen)})["action_dist_inputs"][:, :3].detach().numpy()
    assert np.abs(wanted).max() > 0.001
    np.testing.assert_allclose(policy.predict(seen)[0], np.clip(wanted, -1, 1), atol=2e-3)  # the file is in half precision


def test_runners_meet_other_episodes(scripts):
    import gymnasium as gym
    from rllib_train import RunnerBatch

    # seeds of neighboring runners, as RLlib gives them
    seen = [RunnerBatch(gym.make_vec("ClothReach-v0", num_envs=4)).reset(seed=seed)[0] for seed in (5, 6, 5)]
    np.testing.assert_array_equal(seen[0], seen[2])
    assert len(np.unique(np.concatenate(seen[:2]), axis=0)) == 8


KILLED = """
import os, signal
import policies, ray, rllib_train
args = rllib_train.Args(env="ClothReach-v0", runners=2, timesteps=10**6)
ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
algo = rllib_train.build(args, policies.hyperparameters_of(args.hyperparams, args.env), {}, 0)
def step():
    sampled = algo.train()["env_runners"]["num_env_steps_sampled"]
    return int(sampled), algo.env_runner_group.num_healthy_remote_workers()
print(step())
os.kill(algo.env_runner_group.foreach_env_runner(lambda runner: os.getpid(), local_env_runner=False)[0], signal.SIGKILL)
counts = [step() for _ in range(3)]
while counts[-1][1] < 2 and len(counts) < 100:
    counts.append(step())
print(min(steps for steps, _ in counts), min(runners for _, runners in counts), counts[-1][1])
"""


def test_a_killed_runner_comes_back_and_its_share_is_not_missing():
    paths = [str(ROOT / "training"), str(ROOT), os.environ.get("PYTHONPATH", "")]  # of the runners, too
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "RAY_USAGE_STATS_ENABLED": "0"}
    done = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    # Ray has lines of its own there
    assert {f"({STEPS}, 2)", f"{STEPS} 1 2"} <= set(done.stdout.splitlines()), done.stdout

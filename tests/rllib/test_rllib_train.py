"""training/rllib_train.py: a short run on a Ray of this machine, resumed, exported, and with a runner killed; make rllib."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from training_runs import ROOT, run

import clothgym
from clothgym.adapters.runs import load_last

STEPS = 32 * 40  # of an iteration on ClothReach-v0, as training/hyperparams/ppo.yml has it
SHORT = ("--runners", 1, "--checkpoint-seconds", 0, "--final-episodes", 4)
WRONG = {
    "--runners 3": "--runners 3: does not divide the 32 environments",
    "--learners 7": "--learners 7: does not divide the 320 samples of a minibatch",
    "--env ClothReech-v0": "no environment 'ClothReech-v0'; did you mean 'ClothReach-v0'?",
    "--checkpoint-seconds nan": "--checkpoint-seconds nan: must be at least 0",
    "--resume sb3": "it is of ppo, not of this script: go on with train.py --resume",
    "--resume gone": "'gone' is not the folder of a training run",
}


@pytest.fixture
def module(scripts):
    return pytest.importorskip("rllib_train")


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """The folder of a run of two iterations."""
    pytest.importorskip("ray")
    folder = tmp_path_factory.mktemp("rllib")
    done = run("rllib_train.py", "--env", "ClothReach-v0", "--run", "short", "--timesteps", 2 * STEPS, *SHORT, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "short"


def progress(folder):
    return [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]


def adam_steps(state):
    return {one["step"] for one in state["optimizer"]["default_policy_default_optimizer"]["state"]["state"].values()}


@pytest.mark.parametrize("given", WRONG)
def test_what_is_wrong_is_said_before_ray_is_needed(given, module, tmp_path, monkeypatch, capsys):
    import tyro

    monkeypatch.chdir(tmp_path)
    (tmp_path / "sb3").mkdir()
    config = {"clothgym": clothgym.__version__, "env": "ClothReach-v0", "algo": "ppo", "num_envs": 32, "timesteps": 1, "seed": 0}
    config |= {"threads": 1, "clone": {}, "curriculum": {}, "env_kwargs": {}, "hyperparameters": {}}
    clothgym.files.write_json(tmp_path / "sb3" / "config.json", config)
    with pytest.raises(SystemExit):
        tyro.cli(module.Args, args=["--env", "ClothReach-v0", *given.split()])
    # tyro draws a box around its message, and breaks lines
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert WRONG[given] in said


def test_a_run_counts_its_steps_and_is_exported(finished):
    lines = progress(finished)
    assert [line["timesteps"] for line in lines] == [STEPS, 2 * STEPS]
    assert all(np.isfinite(line["loss"]) and line["runners"] == 1 for line in lines)
    state = load_last(finished)
    assert state["num_timesteps"] == 2 * STEPS and state["num_updates"] == 2
    score = json.loads((finished / "evaluation.json").read_text())
    assert score["episodes"] == 4 and score["timesteps"] == 2 * STEPS and score["core_seconds"] > 0


def test_the_exported_policy_does_what_the_module_does(finished, module):
    import gymnasium as gym
    import torch

    spec = pytest.importorskip("ray.rllib.core.rl_module.rl_module").RLModuleSpec
    env = gym.make_vec("ClothReach-v0", num_envs=50)
    spaces = {"observation_space": env.single_observation_space, "action_space": env.single_action_space}
    hyperparameters = json.loads((finished / "config.json").read_text())["hyperparameters"]
    network = spec(module_class=module.actor_critic(), model_config=hyperparameters["policy_kwargs"], **spaces).build()
    network.load_state_dict(load_last(finished)["policy"])
    seen, _ = env.reset(seed=3)
    wanted = network.forward_inference({"obs": torch.from_numpy(seen)})["action_dist_inputs"][:, :3].detach().numpy()
    assert np.abs(wanted).max() > 0.01
    acted, _ = clothgym.policies.read(finished / "policy.npz").predict(seen)
    np.testing.assert_allclose(acted, np.clip(wanted, -1, 1), atol=2e-3)  # the file is in half precision


def test_a_run_goes_on_where_it_was(finished):
    before = load_last(finished)
    done = run("rllib_train.py", "--resume", "short", "--timesteps", 3 * STEPS, *SHORT, cwd=finished.parent)
    assert done.returncode == 0, done.stderr
    assert f"going on with short at {2 * STEPS:,} of {3 * STEPS:,} steps" in done.stdout
    assert [line["timesteps"] for line in progress(finished)] == [STEPS, 2 * STEPS, 3 * STEPS]
    after = load_last(finished)
    (earlier,), (later,) = adam_steps(before), adam_steps(after)
    updates = later - earlier
    assert earlier > 1.5 * updates > 0
    # Adam moves a weight by about the learning rate in an update, here at most a third of 0.0015; other initial ones are 0.5 away
    moved = max((after["policy"][name] - tensor).abs().max().item() for name, tensor in before["policy"].items())
    assert 0 < moved < 0.1


def test_runners_meet_other_episodes(module):
    pytest.importorskip("ray")
    # seeds of neighboring runners, as RLlib gives them
    seen = [module.make_batch({"id": "clothgym:ClothReach-v0", "num_envs": 4}).reset(seed=seed)[0] for seed in (5, 6, 5)]
    np.testing.assert_array_equal(seen[0], seen[2])
    assert len(np.unique(np.concatenate(seen[:2]), axis=0)) == 8


def test_advantages_are_standardized_over_the_steps_that_were_taken(module, monkeypatch):
    torch = pytest.importorskip("torch")
    theirs = pytest.importorskip("ray.rllib.algorithms.ppo.torch.ppo_torch_learner").PPOTorchLearner
    monkeypatch.setattr(theirs, "compute_loss_for_module", lambda self, *, batch, **kwargs: batch["advantages"])
    made = module.learner()
    batch = {"advantages": torch.tensor([1.0, 3.0, 50.0]), "loss_mask": torch.tensor([True, True, False])}
    learned = made.compute_loss_for_module(object.__new__(made), batch=batch)
    torch.testing.assert_close(learned[:2], torch.tensor([-1.0, 1.0]) / 2**0.5)


KILLED = """
import os, signal
import rllib_train
args = rllib_train.Args(env="ClothReach-v0", runners=2)
with rllib_train.cluster(args):
    algo = rllib_train.build(args, {}, 0)
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
    pytest.importorskip("ray")
    command = [sys.executable, "-c", KILLED]
    paths = [str(ROOT / "training"), str(ROOT), os.environ.get("PYTHONPATH", "")]  # of the runners, too
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    )
    assert done.returncode == 0, done.stderr
    # Ray has lines of its own there
    assert {f"({STEPS}, 2)", f"{STEPS} 1 2"} <= set(done.stdout.splitlines()), done.stdout


def test_lines_after_the_checkpoint_and_half_ones_are_dropped(module, tmp_path):
    path = tmp_path / "progress.jsonl"
    path.write_text('{"iteration": 1, "timesteps": 1280}\n{"iteration": 2, "timesteps": 2560}\n[]\n{"iteration": 3, "times')
    module.drop_unkept(path, 1280)
    assert path.read_text() == '{"iteration": 1, "timesteps": 1280}\n'

"""What training has beside PPO: a price on cost, and a clone of the expert to begin with."""

import json

import gymnasium as gym
import numpy as np
import pytest
from training_runs import call, run

import clothgym
from clothgym import files

CONSTRAINED = """
ClothStrain-v0:
  n_envs: 4
  n_timesteps: !!float 400
  policy: MlpPolicy
  n_steps: 50
  batch_size: 100
  n_epochs: 1
  learning_rate: lin_0.0001
  policy_kwargs: {net_arch: [8], log_std_init: 0.0}
  cost_limit: 0.5
  multiplier_rate: 0.01
  excess_clip: 10.0
  env_kwargs: {physics: fast}
"""
CLONED = """
ClothReach-v0:
  n_envs: 64
  n_timesteps: !!float 2560
  policy: MlpPolicy
  n_steps: 40
  batch_size: 2560
  n_epochs: 1
  learning_rate: lin_0.0000001
  policy_kwargs: {net_arch: [64, 64], log_std_init: -2.0}
  clone: {episodes: 4, noise: 0.3, epochs: 40, batch_size: 1024, learning_rate: 0.003}
"""


@pytest.fixture
def unfilmed(scripts, monkeypatch):
    """The scripts without their films, which take seconds; test_training.py has one."""
    import learning

    monkeypatch.setattr(learning, "film", lambda *arguments: None)


# --- a Lagrange multiplier ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_constrained_run_prices_costs_and_goes_on_with_its_price(unfilmed, tmp_path):
    (tmp_path / "short.yml").write_text(CONSTRAINED)
    options = ("--hyperparams", tmp_path / "short.yml", "--eval-episodes", 2, "--final-episodes", 3, "--threads", 1)
    common = ("--env", "ClothStrain-v0", "--algo", "ppo_lagrange")
    done = call("train.py", *common, "--run", tmp_path / "run", *options)
    # a policy of pure noise costs far more than the excess of 10 that counts: 0.01 times that for each of two rollouts
    assert multiplier(tmp_path / "run") == pytest.approx(2 * 0.01 * 10)
    assert "cost" in done.stdout and "careless" in done.stdout
    scores = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert scores["references"]["careless"]["cost"] > 3 > scores["references"]["expert"]["cost"]
    assert json.loads((tmp_path / "run" / "progress.jsonl").read_text().splitlines()[-1])["cost"] >= 0
    call("train.py", "--resume", tmp_path / "run", "--timesteps", 600, *options[2:6])
    assert multiplier(tmp_path / "run") == pytest.approx(3 * 0.01 * 10)


def multiplier(folder):
    """Of a constrained run's last checkpoint."""
    from clothgym.adapters.runs import load_last

    return float(load_last(folder)["constraint"]["multiplier"])


def test_costs_are_evaluated(tmp_path):
    out = tmp_path / "scores.json"
    command = ("--env", "ClothStrain-v0", "--policy", "noop", "careless", "--episodes", 5, "--seed", 50, "--json", out)
    done = run("evaluate.py", *command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scores = json.loads(out.read_text())
    costs, safe = [], []
    for seed in range(50, 55):
        env = gym.make("clothgym:ClothStrain-v0").unwrapped
        env.reset(seed=seed)
        terminated, cost = False, 0
        while not terminated:
            *_, terminated, _, info = env.step(env.task.careless_actions()[0].astype(np.float32))
            cost += info["cost"]
        costs.append(cost)
        safe.append(info["is_success"] and cost == 0)
    assert scores["careless"]["cost"] == pytest.approx(np.mean(costs)) and np.mean(costs) > 3
    half = 1.96 * np.std(costs, ddof=1) / np.sqrt(5)
    assert scores["careless"]["cost_ci95"] == pytest.approx([np.mean(costs) - half, np.mean(costs) + half])
    assert scores["careless"]["safe_success_rate"] == np.mean(safe) and scores["careless"]["success_rate"] == 1
    assert scores["noop"]["cost"] == 0 and scores["noop"]["safe_success_rate"] == 0


# --- cloning the expert ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_demonstrations_are_the_unperturbed_actions_of_the_expert(scripts, noise):
    """The reach's expert goes to its place at 1.5 times the distance a second: what it does can be read off what is seen."""
    from clone import demonstrations
    from stable_baselines3.common.vec_env import VecMonitor

    from clothgym.adapters.sb3 import make_sb3_vec_env

    env = VecMonitor(make_sb3_vec_env("ClothReach-v0", 4, seed=0))
    observations, actions = demonstrations(env, 2, noise, seed=0)
    assert observations.shape == (2 * 40 * 4, 58) and actions.shape == (2 * 40 * 4, 3)
    way = observations[:, 54:57] * 0.6 / 10
    assert actions == pytest.approx(np.clip(1.5 * way / 0.5, -1, 1), abs=1e-4)
    # the batch is seen step by step: where an action was followed, the way grows shorter by it
    steps = way.reshape(80, 4, 3)[:39], way.reshape(80, 4, 3)[1:40]
    wanted = actions.reshape(80, 4, 3)[:39]
    wanted = wanted / np.maximum(1, np.linalg.norm(wanted, axis=2, keepdims=True)) * 0.5 / 15
    strayed = np.abs(steps[0] - steps[1] - wanted).mean(axis=(0, 2)) / (0.5 / 15)
    # where it is disturbed, each environment is so by a noise of its own strength
    assert strayed.max() < 1e-3 if noise == 0 else 0.1 < strayed.max() < 0.6 and strayed.max() > 2 * strayed.min()


def test_settling_steps_are_not_demonstrated(scripts):
    from clone import demonstrations

    from clothgym.adapters.sb3 import make_sb3_vec_env

    observations, actions = demonstrations(make_sb3_vec_env("ClothDrapeGripper-v0", 2, seed=0), 1, 0.3, seed=0)
    assert observations.shape == (200, 82) and actions.shape == (200, 8)
    assert not observations[:, 65].any() and np.abs(actions).max() <= 1


def test_behavior_cloning_of_a_goal_task_survives_saving_and_loading(scripts, tmp_path):
    from clone import clone, demonstrations
    from learners import save_checkpoint
    from stable_baselines3 import PPO

    from clothgym.adapters.runs import learned
    from clothgym.adapters.sb3 import make_sb3_vec_env

    env = make_sb3_vec_env("ClothFoldGoal-v0", 4, seed=0)
    seen, actions = demonstrations(env, 1, 0.2, seed=0)
    assert {name: part.shape for name, part in seen.items() if name != "observation"} == {
        "achieved_goal": (4 * 80, 12), "desired_goal": (4 * 80, 12),
    }  # fmt: skip
    assert len(seen["observation"]) == len(actions) == 4 * 80
    # a goal is the same throughout an episode, and four environments have four
    assert len(np.unique(seen["desired_goal"], axis=0)) == 4
    kwargs = {"net_arch": [64]}
    model = PPO("MultiInputPolicy", env, n_steps=10, batch_size=40, policy_kwargs=kwargs, seed=0, device="cpu")
    error = clone(model, seen, actions, epochs=100, batch_size=320, learning_rate=0.01)
    # it tells moments apart: a policy that always does the mean of the actions has their variance as its error
    assert error < 0.25 * actions.var(axis=0).mean()
    config = {
        "env": "ClothFoldGoal-v0", "algo": "bc_ppo", "clone": {}, "curriculum": {}, "env_kwargs": {}, "num_envs": 4, "timesteps": 1,
        "hyperparameters": {"policy_kwargs": kwargs}, "seed": 0, "threads": 1, "clothgym": clothgym.__version__,
    }  # fmt: skip
    files.write_json(tmp_path / "config.json", config)
    save_checkpoint(tmp_path, model, {})
    few = {name: part[:7] for name, part in seen.items()}
    assert np.array_equal(learned(tmp_path, "ClothFoldGoal-v0")(env, few), model.predict(few, deterministic=True)[0])


@pytest.mark.slow
def test_a_cloned_policy_succeeds_before_it_has_learned_and_is_not_cloned_again(unfilmed, tmp_path):
    (tmp_path / "short.yml").write_text(CLONED)
    options = ("--hyperparams", tmp_path / "short.yml", "--eval-episodes", 40, "--final-episodes", 10, "--threads", 1)
    done = call("train.py", "--env", "ClothReach-v0", "--algo", "bc_ppo", "--run", tmp_path / "run", *options)
    assert "cloned the expert from 10,240 samples" in done.stdout
    lines = [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").read_text().splitlines()]
    assert [line["timesteps"] for line in lines] == [0, 2560]
    assert lines[0]["success_rate"] > 0.5 and lines[0]["training_seconds"] > 0
    assert lines[1]["success_rate"] > 0.5  # one small step of PPO unlearns nothing
    resumed = call("train.py", "--resume", tmp_path / "run", "--timesteps", 5120, *options[2:6])
    assert "cloned the expert" not in resumed.stdout
    scores = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert scores["timesteps"] == 5120 and scores["success_rate"] > 0.5 > scores["references"]["random"]["success_rate"]


def test_only_the_critic_of_a_cloned_policy_learns_at_first(scripts):
    """For one rollout; the next one moves the policy, too."""
    from learning import FrozenPolicy
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import CallbackList

    from clothgym.adapters.sb3 import make_sb3_vec_env

    model = PPO(
        "MlpPolicy", make_sb3_vec_env("ClothReach-v0", 4, seed=0), n_steps=8, batch_size=32, n_epochs=2, seed=0, device="cpu"
    )
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(32, callback=CallbackList([FrozenPolicy(1)]))
    moved = {name for name, value in model.policy.state_dict().items() if not value.equal(before[name])}
    assert moved and all("value" in name for name in moved)
    frozen = FrozenPolicy(1)
    model.learn(64, callback=frozen, reset_num_timesteps=False)
    assert {"action_net.weight", "log_std"} <= {
        name for name, value in model.policy.state_dict().items() if not value.equal(before[name])
    }


def test_a_curriculum_continues_with_the_arguments_of_the_run(scripts):
    """Where the first part ends the learner's environments are others, just begun; a resumed run begins where it belongs."""
    import learning
    from learners import build

    config = {"env": "ClothReach-v0", "algo": "ppo", "num_envs": 4, "env_kwargs": {}, "seed": 0, "threads": 1, "hyperparameters": {
        "policy": "MlpPolicy", "n_steps": 8, "batch_size": 32, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}},
        "curriculum": {"n_timesteps": 64, "env_kwargs": {"physics": "fast"}}}  # fmt: skip
    model = build(learning.Path("unused"), config, 0, 0)
    model.tensorboard_log = None
    seen = []

    class Note(learning.BaseCallback):
        def _on_step(self):
            task = self.training_env.unwrapped.env.task
            seen.append((task.physics_name, int(task.episode["step"][0])))
            return True

    model.learn(128, callback=[learning.Curriculum(config, 64), Note()])
    assert seen == [("fast", step) for step in range(1, 17)] + [("true", step) for step in range(1, 17)]
    assert build(learning.Path("unused"), config, 0, 64).env.unwrapped.env.task.physics_name == "true"


@pytest.mark.slow
def test_resumed_behavior_cloning_is_scored_again_without_another_fit(unfilmed, tmp_path):
    """Killed before its score, and finished."""
    (tmp_path / "short.yml").write_text(CLONED.replace("!!float 2560", "0"))
    options = ("--eval-episodes", 5, "--final-episodes", 10)
    given = ("--env", "ClothReach-v0", "--algo", "bc", "--hyperparams", tmp_path / "short.yml")
    done = call("train.py", *given, "--run", tmp_path / "run", *options)
    before = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    for name in ("model.zip", "policy.npz", "evaluation.json"):
        (tmp_path / "run" / name).unlink()
    again = call("train.py", "--resume", tmp_path / "run", *options)
    assert "cloned" in done.stdout and "cloned" not in again.stdout
    after = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert after["return"] == before["return"] and after["training_seconds"] == pytest.approx(before["training_seconds"])


@pytest.mark.parametrize("env_id", ["ClothReach-v0", "ClothFoldGoal-v0"])
def test_a_replay_buffer_is_filled_with_expert_transitions(env_id, scripts):
    """The transitions are those of a batch that is stepped by hand with the same actions, episode by episode."""
    from clone import fill
    from stable_baselines3 import SAC, HerReplayBuffer

    from clothgym.adapters.sb3 import make_sb3_vec_env

    goals = env_id == "ClothFoldGoal-v0"
    kwargs = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 4}} if goals else {}
    env, other = (make_sb3_vec_env(env_id, 3, seed=0) for _ in range(2))
    model = SAC(
        "MultiInputPolicy" if goals else "MlpPolicy", env, seed=0, device="cpu", learning_starts=0, buffer_size=3000, **kwargs
    )
    fill(model, 1, noise=0.2, seed=0)
    steps, buffer = env.env.task.most_steps(), model.replay_buffer
    assert buffer.pos == steps and not buffer.full
    seen = other.reset()
    for step in range(steps):
        wanted = np.clip(other.env.task.expert(), -1, 1)
        # where the noise did not reach the actions' bounds, it is smaller than four deviations of it
        assert np.abs(buffer.actions[step] - wanted).max() < 0.2 * 4.5
        stored = {key: part[step] for key, part in buffer.observations.items()} if goals else buffer.observations[step]
        assert all(np.array_equal(stored[key], seen[key]) for key in seen) if goals else np.array_equal(stored, seen)
        seen, rewards, dones, _ = other.step(buffer.actions[step])
        assert np.array_equal(buffer.rewards[step], rewards) and np.array_equal(buffer.dones[step].astype(bool), dones)
    assert buffer.dones.sum() == 3 and model._last_obs is None
    model.learn(9)
    assert model._n_updates > 0 and model.num_timesteps == 9


def test_the_first_weights_are_the_same_on_machines_of_any_number_of_cores(scripts, tmp_path):
    import torch
    from learners import build

    config = {
        "env": "ClothReach-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": {}, "num_envs": 2, "threads": 1,
        "hyperparameters": {"policy": "MlpPolicy", "n_steps": 8, "batch_size": 16, "policy_kwargs": {"net_arch": [128, 128]}},
        "seed": 0,
    }  # fmt: skip
    found = []
    for threads in (1, 2):
        # as torch begins on a machine of so many cores
        torch.set_num_threads(threads)
        found.append(build(tmp_path, config, 0, 0).policy.state_dict())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])

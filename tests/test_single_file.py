"""PPO in a single file: what a run leaves, the same bits from the same seed, and each part beside numbers from elsewhere."""

import json
import sys
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
import yaml
from training_runs import ROOT, run

SHORT = ("--env", "ClothReach-v0", "--timesteps", 2500, "--n-epochs", 2, "--final-episodes", 6, "--seed", 3)
TABLE = yaml.safe_load((ROOT / "training" / "hyperparams" / "ppo.yml").read_text())
NAMES = {f"mlp_extractor.{net}_net.{i}.{part}" for net in ("policy", "value") for i in (0, 2) for part in ("weight", "bias")}
NAMES |= {f"{net}_net.{part}" for net in ("action", "value") for part in ("weight", "bias")} | {"log_std"}


@pytest.fixture
def single(scripts):
    """The script as a module."""
    import ppo_single_file

    return ppo_single_file


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("single")
    done = run("ppo_single_file.py", *SHORT, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("ClothReach-v0: success 0.") and "%|" not in done.stderr  # no bar where there is no terminal
    return folder / "runs" / "ClothReach-v0_single_file_3"


def weights_of(folder):
    with np.load(folder / "policy.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def test_a_run_leaves_weights_a_score_and_a_log(trained):
    weights = weights_of(trained)
    assert set(weights) == NAMES and all(np.isfinite(array).all() for array in weights.values())
    assert weights["mlp_extractor.value_net.0.weight"].shape == (64, 58) and weights["log_std"].shape == (3,)
    assert (weights["log_std"] != -1.5).all()  # it has moved from where ppo.yml begins
    row = json.loads((trained / "evaluation.json").read_text())
    assert row["episodes"] == 6 and row["mean_length"] == 40 and row["seed"] == 3
    # two rollouts of 32 environments and 40 steps reach 2,500 steps; what is not a flag is ppo.yml's
    assert (row["timesteps"], row["n_epochs"], row["learning_rate"]) == (2560, 2, "lin_0.0015")
    assert all(row[name] == TABLE["ClothReach-v0"][name] for name in ("batch_size", "gamma", "gae_lambda"))
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(trained / "tensorboard")).Reload()
    assert [entry.step for entry in log.Scalars("rollout/ep_len_mean")] == [1280, 2560]
    # the rate of what remains: of the second rollout nothing does
    assert [entry.value for entry in log.Scalars("train/learning_rate")] == pytest.approx([0.0015 * (1 - 1280 / 2500), 0])


@pytest.mark.slow
def test_the_same_seed_learns_the_same_bits(trained, single, tmp_path):
    """In another process, where torch has drawn other numbers before."""
    import torch

    torch.manual_seed(99)
    options = {"env": "ClothReach-v0", "timesteps": 2500, "n_epochs": 2, "final_episodes": 1}
    weights = {}
    for seed in (3, 4):
        single.train(single.Args(seed=seed, run=tmp_path / str(seed), **options))
        weights[seed] = weights_of(tmp_path / str(seed))
    for name, array in weights_of(trained).items():
        assert (array == weights[3][name]).all(), name
    assert (weights[3]["log_std"] != weights[4]["log_std"]).all()


def test_advantages_end_with_a_termination_and_go_on_after_a_truncation(single):
    """Three environments: one terminates, one is truncated, both with the second of three steps; one goes on."""
    gamma, gae_lambda, last = 0.5, 0.5, np.array([8.0, 8.0, 8.0])
    batch = {
        "reward": np.tile([[1.0], [2.0], [3.0]], 3),
        "value": np.tile([[4.0], [6.0], [2.0]], 3),
        "ended": np.array([[0.0, 0, 0], [1, 1, 0], [0, 0, 0]]),
        "final_value": np.array([[0.0, 0, 0], [0, 10, 0], [0, 0, 0]]),
    }
    # last step, all: 3 + 8/2 - 2 = 5.  Second: 2 - 6 = -4; 2 + 10/2 - 6 = 1; 2 + 2/2 - 6 + 5/4 = -1.75.
    # first: 1 + 6/2 - 4 = 0, and a quarter of the second's
    hand = np.array([[-1.0, 0.25, -0.4375], [-4, 1, -1.75], [5, 5, 5]])
    assert (single.advantages_of(batch, last, gamma, gae_lambda) == hand).all()


def test_truncated_episodes_bootstrap_from_their_last_observation(single):
    """Beside the same actions in environments that are not reset."""
    import torch

    torch.manual_seed(0)
    args = single.Args(env="ClothReach-v0", n_envs=2, n_steps=7, log_std_init=1.0)
    agent, episodes = single.ActorCritic(58, 3, (8,), args.log_std_init), deque()
    env = gym.make_vec("clothgym:ClothReach-v0", num_envs=2, autoreset_mode="SameStep", max_episode_steps=3)
    seeds = []
    reset = env.reset
    env.reset = lambda seed: seeds.append(seed) or reset(seed=seed)
    batch = next(single.rollouts(env, agent, args, 0, episodes))
    assert (np.flatnonzero(batch["ended"].all(axis=1)) == [2, 5]).all() and batch["ended"].sum() == 4
    assert ((batch["final_value"] != 0) == (batch["ended"] == 1)).all()
    assert [length for _, length, _ in episodes] == [3, 3, 3, 3]
    assert 0 <= seeds[0] < 1_000_000 - 1  # held-out seeds begin there
    # the noise has exceeded the bounds, and is kept as it was drawn
    assert np.abs(batch["action"]).max() > 1
    again = gym.make_vec("clothgym:ClothReach-v0", num_envs=2, autoreset_mode="Disabled")
    again.reset(seed=seeds[0])
    rewards = []
    for t in range(3):
        observation, reward, *_ = again.step(np.clip(batch["action"][t], -1, 1))
        rewards.append(reward)
    with torch.no_grad():
        assert batch["final_value"][2] == pytest.approx(agent.value(torch.as_tensor(observation)).numpy(), rel=1e-5)
    assert batch["reward"][:3] == pytest.approx(np.array(rewards), abs=1e-6)
    assert [total for total, *_ in list(episodes)[:2]] == pytest.approx(np.sum(rewards, axis=0), abs=1e-6)


def test_a_curriculum_begins_with_other_arguments(single, tmp_path, monkeypatch):
    """Until the first rollout that ends beyond its steps; the score is of the task's own."""
    row = TABLE["ClothReach-v0"] | {"n_envs": 4, "n_steps": 10, "n_epochs": 1, "env_kwargs": {"substeps": 60}}
    curricula = {"ppo": {"ClothReach-v0": {"n_timesteps": 50, "env_kwargs": {"physics": "fast"}}}}
    # of the two files only that of curricula names learners
    monkeypatch.setattr(single.yaml, "safe_load", lambda text: curricula if "\nppo:\n" in text else {"ClothReach-v0": row})
    begun, scored, collect = [], [], single.rollouts
    monkeypatch.setattr(single, "rollouts", lambda env, *rest: begun.append((env, rest[2])) or collect(env, *rest))
    monkeypatch.setattr(single, "run_episodes", lambda *args, **kwargs: scored.append(kwargs) or run_episodes(*args, **kwargs))
    run_episodes = sys.modules["scoring"].run_episodes
    made, make_vec = [], gym.make_vec
    monkeypatch.setattr(gym, "make_vec", lambda *args, **kwargs: made.append(kwargs.get("physics")) or make_vec(*args, **kwargs))
    single.train(single.Args(env="ClothReach-v0", timesteps=100, final_episodes=1, run=tmp_path / "long"))
    assert made == ["fast", None, None] and scored == [{"substeps": 60}]
    assert [done for _, done in begun] == [0, 80] and begun[0][0] is not begun[1][0]
    assert json.loads((tmp_path / "long" / "evaluation.json").read_text())["timesteps"] == 120
    # a run that is shorter than its first part ends there
    assert single.Args(env="ClothReach-v0", timesteps=50).stages == [({"substeps": 60, "physics": "fast"}, 50)]


def test_an_update_is_that_of_stable_baselines3(single):
    """On one rollout with ends of both kinds, and log probabilities off by enough to be clipped."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    from clothgym.adapters.sb3 import make_sb3_vec_env

    args = single.Args(env="ClothReach-v0", n_envs=8, n_steps=16, batch_size=128, n_epochs=4, net_arch=(16, 16))
    kwargs = {"net_arch": [16, 16], "log_std_init": -1.5}
    options = {"n_steps": 16, "batch_size": 128, "n_epochs": 4, "learning_rate": 0.001, "gamma": 0.99, "gae_lambda": 0.95}
    model = PPO("MlpPolicy", make_sb3_vec_env("ClothReach-v0", 8), policy_kwargs=kwargs, seed=0, device="cpu", **options)
    agent = single.ActorCritic(58, 3, args.net_arch, args.log_std_init)
    model.policy.load_state_dict(agent.net.state_dict())
    rng = np.random.default_rng(0)
    shapes = {"observation": (58,), "action": (3,), "reward": (), "value": (), "log_prob": ()}
    batch = {name: rng.normal(size=(16, 8, *shape)).astype(np.float32) for name, shape in shapes.items()}
    batch["ended"] = (rng.random((16, 8)) < 0.2).astype(np.float32)
    batch["final_value"] = batch["ended"] * (rng.random((16, 8)) < 0.5) * rng.normal(size=(16, 8)).astype(np.float32)
    with torch.no_grad():
        drawn = agent.distribution(torch.as_tensor(batch["observation"])).sample()
        batch["action"] = drawn.numpy()
        true = agent.distribution(torch.as_tensor(batch["observation"])).log_prob(drawn).sum(-1).numpy()
    batch["log_prob"] = true + 0.3 * batch["log_prob"]
    last = rng.normal(size=8).astype(np.float32)
    # there the value of a truncated episode's last observation is added to the reward
    starts = np.ones(8, np.float32)
    for t in range(16):
        reward = batch["reward"][t] + 0.99 * batch["final_value"][t]
        tensors = [torch.as_tensor(batch[name][t]) for name in ("value", "log_prob")]
        model.rollout_buffer.add(batch["observation"][t], batch["action"][t], reward, starts, *tensors)
        starts = batch["ended"][t]
    model.rollout_buffer.compute_returns_and_advantage(torch.as_tensor(last), starts)
    batch["advantage"] = single.advantages_of(batch, last, 0.99, 0.95)
    batch["return"] = batch["advantage"] + batch["value"]
    assert batch["return"] == pytest.approx(model.rollout_buffer.returns, abs=1e-5)
    model.set_logger(Logger(None, []))
    model.train()
    optimizer = torch.optim.Adam(agent.net.parameters(), lr=0.001, eps=single.ADAM_EPS)
    log = single.update(agent, optimizer, batch, args, rng)
    for name, part in model.policy.state_dict().items():
        assert agent.net.state_dict()[name].numpy() == pytest.approx(part.numpy(), abs=2e-6), name
    for name in ("train/value_loss", "train/policy_gradient_loss", "train/entropy_loss", "train/clip_fraction"):
        assert log[name] == pytest.approx(model.logger.name_to_value[name], abs=1e-5), name
    assert 0.1 < log["train/clip_fraction"] < 0.9


def test_rollouts_and_updates_are_those_of_stable_baselines3_bit_for_bit(single, monkeypatch):
    """From the same weights, with the same noise and the same minibatches: three rollouts of whole episodes, each learned from."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from clothgym.adapters.sb3 import make_sb3_vec_env

    torch.set_num_threads(1)
    args = single.Args(env="ClothReach-v0", n_envs=8, n_steps=40, batch_size=80, n_epochs=3, net_arch=(16, 16))
    agent = single.ActorCritic(58, 3, args.net_arch, args.log_std_init)
    first = {name: part.clone() for name, part in agent.net.state_dict().items()}
    optimizer = torch.optim.Adam(agent.net.parameters(), lr=0.001, eps=single.ADAM_EPS)
    env, seeds = gym.make_vec("clothgym:ClothReach-v0", num_envs=8, autoreset_mode="SameStep"), []
    reset = env.reset
    env.reset = lambda seed: seeds.append(seed) or reset(seed=seed)

    drawn = [np.random.default_rng(number).permutation(320) for number in range(9)]

    class SameSamples:
        """SB3 has the steps of an environment after one another, and this script the environments of a step."""

        def __init__(self):
            self.left = list(drawn)

        def permutation(self, count):
            places = self.left.pop(0)
            return places % 40 * 8 + places // 40

    rollouts, samples, weights = single.rollouts(env, agent, args, 0, deque()), SameSamples(), []
    for number in range(3):
        torch.manual_seed(number)
        batch = next(rollouts)
        single.update(agent, optimizer, batch, args, samples)
        weights.append({name: part.clone() for name, part in agent.net.state_dict().items()})

    class SameDraws(BaseCallback):
        """Begins each rollout with the numbers above."""

        number = 0

        def _on_step(self):
            return True

        def _on_rollout_start(self):
            torch.manual_seed(self.number)

        def _on_rollout_end(self):
            self.number += 1
            seen.append({name: part.clone() for name, part in self.model.policy.state_dict().items()})

    seen = []
    kwargs = {"net_arch": [16, 16], "log_std_init": args.log_std_init}
    options = {"n_steps": 40, "batch_size": 80, "n_epochs": 3, "learning_rate": 0.001, "gamma": args.gamma}
    same = make_sb3_vec_env("ClothReach-v0", 8, seed=seeds[0])
    model = PPO("MlpPolicy", same, policy_kwargs=kwargs, seed=seeds[0], device="cpu", **options)
    monkeypatch.setattr(np.random, "permutation", lambda count: drawn.pop(0))
    model.policy.load_state_dict(first)
    model.learn(3 * 320, callback=SameDraws())
    found = [*seen[1:], model.policy.state_dict()]
    for one, other in zip(weights, found):
        assert all(one[name].equal(other[name]) for name in first)
    assert not weights[0]["log_std"].equal(weights[2]["log_std"])


WRONG = {
    "--env ClothFoldGoal-v0": "has no hyperparameters for 'ClothFoldGoal-v0' (there are: ClothDrape-v0",
    "--gamma nan": "--gamma nan: must be from 0 to 1",
    "--learning-rate cos_0.1": "--learning-rate cos_0.1: must be a number, or lin_NUMBER",
    "--run taken": "taken holds a run already: choose another folder with --run",
}


@pytest.mark.parametrize("command", WRONG)
def test_wrong_arguments_are_refused_as_wrong_flags_are(command, single, tmp_path, monkeypatch, capsys):
    import tyro

    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "policy.npz").touch()
    with pytest.raises(SystemExit) as caught:
        tyro.cli(single.Args, args=command.split())
    # without the frame around it and its line breaks
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert caught.value.code == 2 and WRONG[command] in said

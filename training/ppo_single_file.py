"""PPO in one file, to be read from top to bottom: native vector environments, torch for the nets, and no learner's library.

    python training/ppo_single_file.py --env ClothReach-v0          # runs/ClothReach-v0_single_file_0
    python training/ppo_single_file.py --env ClothReach-v0 --seed 1 --timesteps 500000 --learning-rate lin_0.002

Schulman et al., "Proximal Policy Optimization Algorithms" (2017), with the details of Stable-Baselines3 and the hyperparameters of
train.py; a flag overrides one.  The folder holds evaluation.json (final score and settings), the TensorBoard log, and policy.npz:
``model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in np.load("policy.npz").items()})`` with SB3's PPO.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
import yaml
from endings import stopped
from numpy.typing import NDArray
from scoring import HELD_OUT, run_episodes, score
from tqdm import tqdm

from clothgym import files
from clothgym.registration import checked_id

# Stable-Baselines3's defaults, which no environment of ours changes
CLIP_RANGE, ENT_COEF, VF_COEF, MAX_GRAD_NORM, ADAM_EPS = 0.2, 0.0, 0.5, 0.5, 1e-5
# the least and the largest value of each number, and of each entry of net_arch
LIMITS = {
    "timesteps": (1, 10**12), "n_envs": (1, 10**5), "n_steps": (1, 10**6), "batch_size": (1, 10**9), "n_epochs": (1, 10**4),
    "gamma": (0, 1), "gae_lambda": (0, 1), "log_std_init": (-20, 2), "net_arch": (1, 10**4), "final_episodes": (1, 10**6),
    "seed": (0, 2**32 - 1),
}  # fmt: skip


@dataclass
class Args:
    """Options of the training.  None means the environment's value in hyperparams/ppo.yml."""

    env: str = "ClothDrape-v0"  # id of the environment
    seed: int = 0  # of the nets, the noise, the minibatches and the environments
    run: Path | None = None  # folder of the run; runs/ENV_single_file_SEED by default
    final_episodes: int = 500  # held-out episodes of the final evaluation
    timesteps: int | None = None  # environment steps; the last rollout is finished
    n_envs: int | None = None  # environments in the batch
    n_steps: int | None = None  # steps of each environment in a rollout, after which the policy is updated
    batch_size: int | None = None  # samples in a minibatch
    n_epochs: int | None = None  # how many times each rollout is learned from
    learning_rate: str | None = None  # of Adam: a number, or lin_NUMBER to go from there to zero
    gamma: float | None = None  # discount of a step
    gae_lambda: float | None = None  # of the advantages: 0 trusts the value net, 1 the returns
    log_std_init: float | None = None  # logarithm of the standard deviation of the actions at the beginning
    net_arch: tuple[int, ...] | None = None  # sizes of the hidden layers, of the policy net and of the value net

    def __post_init__(self) -> None:
        """Everything is checked here, before torch is imported; errors look like those of a wrong flag."""
        self.env = checked_id(self.env)
        # one description of an environment's hyperparameters: the file that train.py reads
        path = Path(__file__).parent / "hyperparams" / "ppo.yml"
        table = yaml.safe_load(path.read_text())
        if self.env not in table:
            raise ValueError(f"{path} has no hyperparameters for {self.env!r} (there are: {', '.join(table)})")
        row = dict(table[self.env])
        row |= row.pop("policy_kwargs") | {"timesteps": int(row.pop("n_timesteps"))}
        own = row.pop("env_kwargs", {})
        first = yaml.safe_load(path.with_name("curricula.yml").read_text()).get("ppo", {}).get(self.env)
        if row.pop("policy") != "MlpPolicy" or not set(row) <= {*LIMITS, "learning_rate"}:
            raise ValueError(f"--env {self.env}: this script does not do all that {path} says of it; train.py does")
        for name, value in row.items():
            setattr(self, name, value if getattr(self, name) is None else getattr(self, name))
        for name, (least, most) in LIMITS.items():
            for value in np.atleast_1d(getattr(self, name)):
                if not least <= value <= most:  # NaN is not, either
                    raise ValueError(f"--{name.replace('_', '-')} {value}: must be from {least} to {most}")
        if not re.fullmatch(r"(lin_)?(\d*\.)?\d+(e-\d+)?", str(self.learning_rate)):
            raise ValueError(f"--learning-rate {self.learning_rate}: must be a number, or lin_NUMBER")
        # arguments of the environment, and the step until which they hold; a curriculum begins with others, say cheaper physics
        self.stages = [(own, self.timesteps)]
        if first:
            later = self.stages if first["n_timesteps"] < self.timesteps else []
            self.stages = [(own | first["env_kwargs"], min(first["n_timesteps"], self.timesteps)), *later]
        self.env_kwargs = own
        self.folder = self.run.expanduser() if self.run else Path("runs") / f"{self.env}_single_file_{self.seed}"
        if (self.folder / "policy.npz").exists() or (self.folder / "config.json").exists():  # the latter is of train.py
            raise ValueError(f"{self.folder} holds a run already: choose another folder with --run")


class ActorCritic:
    """Two nets that share nothing: the mean of a normal distribution of actions, and the value of an observation."""

    def __init__(self, observations: int, actions: int, net_arch: tuple[int, ...], log_std_init: float) -> None:
        import torch  # imported in functions: it takes seconds, after all checks of arguments
        from torch import nn

        def linear(inputs: int, outputs: int, gain: float) -> Any:
            layer = nn.Linear(inputs, outputs)
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
            return layer

        def hidden() -> Any:
            return nn.Sequential(*(one for two in pairwise(sizes) for one in (linear(*two, gain=math.sqrt(2)), nn.Tanh())))

        # the gain of 0.01 makes the first actions nearly independent of the observation: exploration starts without a preference
        sizes, self.net = (observations, *net_arch), nn.Module()
        self.net.log_std = nn.Parameter(torch.full((actions,), float(log_std_init)))
        self.net.mlp_extractor = nn.ModuleDict({"policy_net": hidden(), "value_net": hidden()})
        self.net.action_net, self.net.value_net = linear(sizes[-1], actions, 0.01), linear(sizes[-1], 1, 1.0)

    def distribution(self, observation: Any) -> Any:
        """Of the actions: a mean for each observation, and a spread that is the same for all."""
        from torch.distributions import Normal

        mean = self.net.action_net(self.net.mlp_extractor["policy_net"](observation))
        return Normal(mean, self.net.log_std.exp().expand_as(mean), validate_args=False)

    def value(self, observation: Any) -> Any:
        return self.net.value_net(self.net.mlp_extractor["value_net"](observation)).squeeze(-1)


def advantages_of(batch: dict[str, NDArray], last_value: NDArray, gamma: float, gae_lambda: float) -> NDArray[np.float32]:
    """Generalized advantage estimation (Schulman et al. 2016, eq. 16), (n_steps, n_envs), backward in time:

    ``A_t = delta_t + gamma lambda A_(t+1)``, ``delta_t = r_t + gamma V(s_(t+1)) - V(s_t)``.  Neither goes beyond an episode's end:
    after a termination nothing more is earned; what was only cut off would have gone on, and V of its last observation says how.

    batch: reward, value V(s_t), ended (1 if the episode ended with step t), and final_value, V of its last observation if it was
    truncated and not terminated, else 0.  last_value: V of the observations after the last step, (n_envs,).
    """
    advantages, following, next_value = np.zeros_like(batch["value"]), np.zeros_like(last_value), last_value
    for t in reversed(range(len(advantages))):
        goes_on = 1 - batch["ended"][t]
        delta = batch["reward"][t] + gamma * (goes_on * next_value + batch["final_value"][t]) - batch["value"][t]
        following = advantages[t] = delta + gamma * gae_lambda * goes_on * following
        next_value = batch["value"][t]
    return advantages


def rollouts(
    env: Any, agent: ActorCritic, args: Args, done: int, episodes: deque[tuple[float, ...]]
) -> Iterator[dict[str, NDArray]]:
    """Endlessly: n_steps of every environment, arrays (n_steps, n_envs, ...).  What ended on the way is added to ``episodes``.

    done: environment steps of the run before these.
    """
    import torch

    shapes = {"observation": env.single_observation_space.shape, "action": env.single_action_space.shape}
    shapes |= dict.fromkeys(("log_prob", "value", "reward", "ended", "final_value"), ())
    # environment i begins with seed + i, below all held-out seeds, and goes on with a generator of its own
    seed = int(np.random.SeedSequence([args.seed, done]).generate_state(1)[0]) % (HELD_OUT - args.n_envs)
    observation, _ = env.reset(seed=seed)
    total, length = np.zeros(args.n_envs), np.zeros(args.n_envs)
    while True:
        batch = {name: np.zeros((args.n_steps, args.n_envs, *shape), np.float32) for name, shape in shapes.items()}
        for t in range(args.n_steps):
            with torch.no_grad():
                seen = torch.as_tensor(observation)
                distribution, batch["observation"][t], batch["value"][t] = agent.distribution(seen), seen, agent.value(seen)
                action = distribution.sample()
                batch["action"][t], batch["log_prob"][t] = action, distribution.log_prob(action).sum(-1)
            # noise may exceed the bounds: the environment gets the clipped action, the update uses the drawn one
            observation, reward, terminated, truncated, info = env.step(np.clip(action.numpy(), -1, 1))
            ended, cut_off = terminated | truncated, truncated & ~terminated
            batch["reward"][t], batch["ended"][t] = reward, ended
            # in same-step mode ``observation`` is the next episode's first already; what this one ended with is in ``final_obs``
            if cut_off.any():
                with torch.no_grad():
                    batch["final_value"][t, cut_off] = agent.value(torch.as_tensor(np.stack(info["final_obs"][cut_off])))
            # each episode's account, for the log
            total, length = total + reward, length + 1
            for i in np.flatnonzero(ended):
                episodes.append((total[i], length[i], float(info["final_info"]["is_success"][i])))
            total[ended], length[ended] = 0, 0
        with torch.no_grad():
            last_value = agent.value(torch.as_tensor(observation)).numpy()
        batch["advantage"] = advantages_of(batch, last_value, args.gamma, args.gae_lambda)
        # what the value net shall say: the return, as TD(lambda) estimates it
        batch["return"] = batch["advantage"] + batch["value"]
        yield batch


def update(agent: ActorCritic, optimizer: Any, batch: dict[str, NDArray], args: Args, rng: np.random.Generator) -> dict[str, float]:
    """Learn from one rollout; returns the means of logged values."""
    import torch

    # steps and environments become one axis of samples
    samples = {name: torch.as_tensor(array.reshape(-1, *array.shape[2:])) for name, array in batch.items()}
    log = []
    for _ in range(args.n_epochs):
        for chosen in torch.as_tensor(rng.permutation(len(samples["value"]))).split(args.batch_size):
            part = {name: values[chosen] for name, values in samples.items()}
            distribution = agent.distribution(part["observation"])
            log_ratio = distribution.log_prob(part["action"]).sum(-1) - part["log_prob"]
            ratio = log_ratio.exp()
            # normalized in each minibatch: steps do not depend on the scale of the rewards; a single sample has no spread
            advantage = part["advantage"]
            if len(advantage) > 1:
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            # the worse of the gain and the clipped gain (eq. 7): nothing is won by going far from the old policy
            gain = torch.min(advantage * ratio, advantage * ratio.clamp(1 - CLIP_RANGE, 1 + CLIP_RANGE)).mean()
            value_loss = (agent.value(part["observation"]) - part["return"]).square().mean()
            entropy = distribution.entropy().sum(-1).mean()
            optimizer.zero_grad()
            (-gain - ENT_COEF * entropy + VF_COEF * value_loss).backward()
            # one unlucky minibatch must not throw the policy far away
            torch.nn.utils.clip_grad_norm_(agent.net.parameters(), MAX_GRAD_NORM)
            optimizer.step()
            with torch.no_grad():
                moved, beyond = (ratio - 1 - log_ratio).mean(), ((ratio - 1).abs() > CLIP_RANGE).float().mean()
            log.append([number.item() for number in (-gain, value_loss, -entropy, moved, beyond)])
    names = ("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction")
    return {f"train/{name}": mean for name, mean in zip(names, np.mean(log, axis=0))}


def train(args: Args) -> None:
    """Learn, save the weights, and score them."""
    import torch
    from torch.utils.tensorboard import SummaryWriter

    # all that is random comes from the seed, and one thread adds in one order: the same command again gives the same bits
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    envs = [gym.make_vec(args.env, num_envs=args.n_envs, autoreset_mode="SameStep", **kwargs) for kwargs, _ in args.stages]
    sizes = *envs[0].single_observation_space.shape, *envs[0].single_action_space.shape
    agent = ActorCritic(*sizes, args.net_arch, args.log_std_init)
    optimizer = torch.optim.Adam(agent.net.parameters(), eps=ADAM_EPS)
    # rl_zoo3's way to write a rate that goes to zero over the run: lin_0.001
    linear, rate = str(args.learning_rate).startswith("lin_"), float(str(args.learning_rate).removeprefix("lin_"))

    # a rollout, an update and an entry of the log, until the steps are done; names as in Stable-Baselines3's logs
    begun, done, episodes = time.perf_counter(), 0, deque(maxlen=100)
    writer = SummaryWriter(str(args.folder / "tensorboard"), purge_step=0)  # hides what an interrupted run has left there
    with writer, tqdm(total=args.timesteps, unit="step", unit_scale=True, disable=None) as bar:
        for env, (_, until) in zip(envs, args.stages):
            for batch in rollouts(env, agent, args, done, episodes):
                done += args.n_steps * args.n_envs
                optimizer.param_groups[0]["lr"] = rate * max(1 - done / args.timesteps, 0.0) if linear else rate
                log = update(agent, optimizer, batch, args, rng) | {"train/learning_rate": optimizer.param_groups[0]["lr"]}
                log |= {"train/std": agent.net.log_std.exp().mean().item(), "time/fps": done / (time.perf_counter() - begun)}
                if episodes:
                    log |= zip(("rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate"), np.mean(episodes, axis=0))
                for name, number in log.items():
                    writer.add_scalar(name, number, done)
                bar.set_postfix_str(f"success {log.get('rollout/success_rate', math.nan):.2f}", refresh=False)
                bar.update(args.n_steps * args.n_envs)
                if done >= until:
                    break
            env.close()
    weights = {name: part.numpy() for name, part in agent.net.state_dict().items()}
    files.write_arrays(args.folder / "policy.npz", "weights", 1, weights)
    result = asdict(args) | {
        "env_kwargs": args.env_kwargs,
        "run": str(args.folder),
        "timesteps": done,
        "training_seconds": time.perf_counter() - begun,
    }

    # the score of the policy without its noise, on the episodes that every policy is scored on
    def policy(env: Any, observation: NDArray) -> NDArray:
        with torch.no_grad():
            return agent.distribution(torch.as_tensor(observation)).mean.clamp(-1, 1).numpy()

    seeds = list(range(HELD_OUT, HELD_OUT + args.final_episodes))
    row = score(run_episodes(args.env, policy, seeds, **args.env_kwargs))
    files.write(args.folder / "evaluation.json", json.dumps(row | result, indent=1, default=float) + "\n")
    print(f"{args.env}: success {row['success_rate']:.3f} in {row['episodes']} held-out episodes; see {args.folder}")


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: f": {'the' if (given.folder / 'policy.npz').exists() else 'no'} weights are in {given.folder}"):
        train(given)

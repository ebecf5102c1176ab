"""Behavior cloning: teach a policy what the scripted expert does, before PPO, or instead of it.

The expert's actions are perturbed during demonstrations, with a different noise strength in each episode, and the targets are its
unperturbed actions (Laskey et al. 2017, DART): the learner thus also sees corrections.  In further rounds the learner acts, and the
expert labels the observations with its actions (Ross et al. 2011, DAgger).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, HerReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

Observations = NDArray | dict[str, NDArray]


def demonstrations(env: VecEnv, episodes: int, noise: float, seed: int, learner: PPO | None = None) -> tuple[Observations, NDArray]:
    """Observations and the expert's actions, (samples, size) each, from some episodes of each environment of a batch; of a goal
    task a dictionary of observations.

    noise: largest standard deviation of the disturbance; each environment draws its own for each of the rounds.
    learner: policy that acts instead of the expert, if any; the recorded actions are the expert's.
    """
    rng = np.random.default_rng(seed)
    task = env.unwrapped.env.task  # type: ignore[attr-defined]
    observations, actions = [], []
    seen: Any = env.reset()
    for _ in tqdm(range(episodes), unit="episode of each", desc="demonstrations", leave=False, disable=None):
        strength = noise * rng.uniform(size=(env.num_envs, 1))
        for _ in range(task.most_steps()):
            wanted = np.clip(task.expert(), -1, 1).astype(np.float32)
            # actions while the sheet settles have no effect, and would only disturb the fit
            acting = task.episode["settling_since"] < 0
            observations.append({key: part[acting] for key, part in seen.items()} if isinstance(seen, dict) else seen[acting])
            actions.append(wanted[acting])
            done = wanted if learner is None else learner.predict(seen, deterministic=True)[0]
            disturbed = done + strength * rng.standard_normal(wanted.shape)
            seen, *_ = env.step(np.clip(disturbed, -1, 1).astype(np.float32))
    if isinstance(seen, dict):
        return {key: np.concatenate([part[key] for part in observations]) for key in seen}, np.concatenate(actions)
    return np.concatenate(observations), np.concatenate(actions)


def fill(model: OffPolicyAlgorithm, episodes: int, noise: float, seed: int) -> None:
    """Put some episodes of each environment, in which a disturbed expert acts, into the learner's replay buffer.

    noise: as of ``demonstrations``; the buffer stores the perturbed actions.
    """
    rng, env, buffer = np.random.default_rng(seed), model.env, model.replay_buffer
    assert env is not None and buffer is not None
    task = env.unwrapped.env.task  # type: ignore[attr-defined]
    model._last_obs = env.reset()  # type: ignore[assignment]
    for _ in tqdm(range(episodes), unit="episode of each", desc="demonstrations", leave=False, disable=None):
        strength = noise * rng.uniform(size=(env.num_envs, 1))
        for _ in range(task.most_steps()):
            disturbed = task.expert() + strength * rng.standard_normal((env.num_envs, *task.single_action_space.shape))
            done = np.clip(disturbed, -1, 1).astype(np.float32)
            model._store_transition(buffer, done, *env.step(done))  # type: ignore[arg-type]
    # episodes that have not ended are cut, and learning begins with new ones
    if isinstance(buffer, HerReplayBuffer):
        buffer.truncate_last_trajectory()
    model._last_obs = None


def joined(one: tuple[Observations, NDArray], other: tuple[Observations, NDArray]) -> tuple[Observations, NDArray]:
    """Both samples as one."""
    (seen, actions), (more, others) = one, other
    if isinstance(seen, dict):
        return {key: np.concatenate([part, more[key]]) for key, part in seen.items()}, np.concatenate([actions, others])
    return np.concatenate([seen, more]), np.concatenate([actions, others])


def clone(model: PPO, observations: Observations, actions: NDArray, epochs: int, batch_size: int, learning_rate: float) -> float:
    """Fit the mean of the policy to the actions by least squares; the mean squared error over the last tenth of the fit."""
    policy = model.policy
    parts = observations if isinstance(observations, dict) else {"": observations}
    x, y = {key: torch.as_tensor(part) for key, part in parts.items()}, torch.as_tensor(actions)
    networks = (policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net)

    def error(batch: torch.Tensor) -> torch.Tensor:
        seen: Any = {key: part[batch] for key, part in x.items()} if isinstance(observations, dict) else x[""][batch]
        return torch.mean((policy.get_distribution(seen).distribution.mean - y[batch]) ** 2)

    return fit(networks, error, len(y), epochs, batch_size, learning_rate, model.seed or 0)


def fit(
    networks: Iterable[torch.nn.Module],
    error: Callable[[torch.Tensor], torch.Tensor],
    samples: int,
    epochs: int,
    batch_size: int,
    learning_rate: float,
    seed: int,
) -> float:
    """Minimize an error by Adam, at a rate that falls to a fiftieth; the mean error over the last tenth of the fit.

    error: of the samples with these indices, (batch_size,).
    """
    optimizer = torch.optim.Adam([parameter for network in networks for parameter in network.parameters()], learning_rate)
    steps = max(1, epochs * samples // batch_size)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, steps)
    generator, errors = torch.Generator().manual_seed(seed), []
    for _ in tqdm(range(steps), desc="cloning", leave=False, disable=None):
        loss = error(torch.randint(samples, (batch_size,), generator=generator))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        errors.append(loss.item())
    return float(np.mean(errors[-max(1, steps // 10) :]))

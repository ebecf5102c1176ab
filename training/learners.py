"""Learners of Stable-Baselines3 from a run's configuration, and their tensors, as checkpoints and exported policies hold them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from policies import Config
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecMonitor

from clothgym import files
from clothgym.adapters.lagrange import LagrangianPPO
from clothgym.adapters.pixels import DepthPolicy
from clothgym.adapters.runs import CHECKPOINT, save_tensors
from clothgym.adapters.sb3 import make_sb3_vec_env
from clothgym.policies import Policy

LEARNERS: dict[str, type[BaseAlgorithm]] = {
    "ppo": PPO, "ppo_penalty": PPO, "ppo_lagrange": LagrangianPPO, "bc": PPO, "bc_ppo": PPO, "sac": SAC, "her": SAC,
}  # fmt: skip
OWN_POLICIES = {one.__name__: one for one in (DepthPolicy,)}  # in addition to SB3's own, by their names in hyperparameter files
SCHEDULES = ("learning_rate", "clip_range")  # options that may be written lin_VALUE
ADVICE = "train again"


def environments(config: Config, env_kwargs: dict[str, Any], seed: int) -> VecMonitor:
    """A batch of a configuration's environments."""
    return VecMonitor(make_sb3_vec_env(config["env"], config["num_envs"], seed=seed, **env_kwargs))


def build(folder: Path, config: Config, seed: int, done: int) -> BaseAlgorithm:
    """The learner of a configuration, on its own batch of environments; done: environment steps of the run so far."""
    # the first weights come from a factorization whose rounding depends on the number of threads
    torch.set_num_threads(config["threads"])
    options = dict(config["hyperparameters"])
    policy = OWN_POLICIES.get(options["policy"], options["policy"])
    del options["policy"]
    for key in SCHEDULES:
        if isinstance(options.get(key), str):
            options[key] = _linear(options[key])
    if config["algo"] == "her":
        from stable_baselines3 import HerReplayBuffer

        options["replay_buffer_class"] = HerReplayBuffer
    first = config["curriculum"]
    kwargs = config["env_kwargs"] | (first["env_kwargs"] if first and done < first["n_timesteps"] else {})
    env = environments(config, kwargs, seed)
    return LEARNERS[config["algo"]](policy, env, seed=seed, device="cpu", tensorboard_log=str(folder / "tensorboard"), **options)


def _linear(text: str) -> Any:
    """rl_zoo3's "lin_0.001": from there to zero over the run.

    The last rollout may end beyond the steps that were asked for, as in rl_zoo3; its updates have a rate just below zero.
    """
    kind, _, value = text.partition("_")
    if kind != "lin":
        raise ValueError(f"hyperparameter {text!r}: a schedule is written lin_VALUE")
    start = float(value)
    return lambda remaining: start * remaining


# --- checkpoints --------------------------------------------------------------------------------------------------------------


def save_checkpoint(folder: Path, model: Any, times: dict[str, float]) -> None:
    """Write the learner's tensors, and the time that it has taken [s]; the checkpoint before is kept, whatever happens.

    A replay buffer is not part of it: a learner that has one fills it anew.
    """
    parameters = model.get_parameters()
    state = {
        "policy": parameters.pop("policy"),
        "optimizer": parameters,
        "variables": {name: getattr(model, name).detach() for name in _variables(model)},
        "constraint": model.constraint_state() if isinstance(model, LagrangianPPO) else {},
        "num_timesteps": model.num_timesteps,
        "num_updates": model._n_updates,
        "times": times,
    }
    save_tensors(folder / CHECKPOINT, state)


def load_checkpoint(folder: Path, model: Any, state: dict[str, Any]) -> None:
    """Put a run's tensors and counters into a learner built from its configuration.

    Raises:
        ValueError: they are of another network than its configuration describes.
    """
    with files.naming(folder, "run whose checkpoint is of the network in its configuration", ADVICE):
        model.set_parameters({"policy": state["policy"], **state["optimizer"]}, device="cpu")
        for name in _variables(model):
            getattr(model, name).data = state["variables"][name]
        if isinstance(model, LagrangianPPO):
            model.set_constraint_state(state["constraint"])
    model.num_timesteps = int(state["num_timesteps"])
    model._n_updates = int(state["num_updates"])
    if isinstance(model, SAC):
        # its replay buffer is empty: it acts at random again until there is something to learn from, if it did at first
        model.learning_starts += model.num_timesteps


def _variables(model: Any) -> list[str]:
    """Names of the learner's tensors that belong to no module, SAC's log_ent_coef for instance."""
    return model._get_torch_save_params()[1]


# --- exported policies --------------------------------------------------------------------------------------------------------


def exported(model: Any, config: Config, about: dict[str, Any]) -> Policy | None:
    """The policy network without its training state; None if it takes images, or has activations other than tanh."""
    space = model.observation_space
    plain = list(space.values()) if isinstance(space, gym.spaces.Dict) else [space]
    if any(len(part.shape or ()) != 1 for part in plain):
        return None
    keys = tuple(space.keys()) if isinstance(space, gym.spaces.Dict) else ()
    about = {"env": config["env"], "env_kwargs": config["env_kwargs"], "learner": config["algo"], "seed": config["seed"]} | about
    policy = model.policy
    if isinstance(model, SAC):
        actor = policy.actor
        return Policy(_layers([*actor.latent_pi, actor.mu]), "relu", squashed=True, keys=keys, about=about)
    if policy.activation_fn is not torch.nn.Tanh or model.use_sde:
        return None
    return Policy(_layers([*policy.mlp_extractor.policy_net, policy.action_net]), "tanh", keys=keys, about=about)


def _layers(modules: Any) -> list[tuple[Any, Any]]:
    """Weights, (inputs, outputs), and biases of the linear ones."""
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    return [(one.weight.detach().numpy().T, one.bias.detach().numpy()) for one in linear]

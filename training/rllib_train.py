"""Train by RLlib's PPO, on this machine or on a Ray cluster: runners step batches of environments, a learner updates the network.

    python training/rllib_train.py --env ClothReach-v0 --runners 2                   # runs/ClothReach-v0_rllib_0
    python training/rllib_train.py --env ClothDrape-v0 --address auto --runners 16   # on the cluster that `ray start` has made
    python training/rllib_train.py --env ClothReach-v0 --runners 2 --resume          # after an interruption

Hyperparameters are those of train.py, without curricula: the runners share n_envs environments.  The run's folder holds
progress.jsonl, RLlib's last checkpoint, and at the end policy.npz.  See docs/cluster.md.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import policies
import ray
import torch
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.tune import register_env
from scoring import HELD_OUT
from torch import nn

from clothgym.policies import Policy
from clothgym.registration import checked_id

ALGO = "rllib_ppo"


@dataclass
class Args:
    """What to train, for how long, and on what."""

    env: str = "ClothDrape-v0"
    seed: int = 0
    timesteps: int | None = None  # environment steps; the hyperparameter file's number by default
    run: Path | None = None  # folder of the run; runs/ENV_rllib_SEED by default
    resume: bool = False  # go on from the last checkpoint in that folder, which holds pickles: it must be your own
    hyperparams: Path = Path(__file__).parent / "hyperparams" / "ppo.yml"
    address: str = "local"  # of the cluster: HOST:PORT, or auto on one of its machines; local makes one that only this machine sees
    runners: int = 1  # processes that step environments
    envs_per_runner: int | None = None  # by default the runners share the hyperparameters' n_envs


class RunnerBatch(gym.vector.VectorWrapper):
    """The batch of one runner."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """RLlib seeds runner i with seed + i, and batches do so with environments.  Hashed seeds keep runners' episodes apart."""
        if seed is not None:
            seed = int(np.random.SeedSequence(seed).generate_state(1)[0]) % (HELD_OUT - self.num_envs)
        return self.env.reset(seed=seed, options=options)[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Without infos: RLlib would keep and send all of them."""
        return *self.env.step(actions)[:4], {}


class ActorCritic(DefaultPPOTorchRLModule):
    """RLlib's network, begun as Stable-Baselines3 begins its own."""

    def setup(self) -> None:
        super().setup()
        nn.init.constant_(self.pi.log_std, self.model_config["log_std_init"])
        for head, gain in ((self.pi, 0.01), (self.vf, 1.0)):
            nn.init.orthogonal_(head.net.mlp[0].weight, gain)
            nn.init.zeros_(head.net.mlp[0].bias)


class Learner(PPOTorchLearner):
    """RLlib's learner with Stable-Baselines3's Adam, and advantages standardized over the steps that were taken.

    RLlib adds a step to each episode for the last value, and standardizes over these steps too, which are many deviations away.
    """

    def compute_loss_for_module(self, *, batch: dict[str, Any], **kwargs: Any) -> Any:
        taken = batch["advantages"][batch["loss_mask"]]
        batch["advantages"] = (batch["advantages"] - taken.mean()) / (taken.std() + 1e-8)
        return super().compute_loss_for_module(batch=batch, **kwargs)

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        params = self.get_parameters(self.module[module_id])
        adam = torch.optim.Adam(params, eps=1e-5)
        self.register_optimizer(module_id=module_id, optimizer=adam, params=params, lr_or_lr_schedule=config.lr)


def build(args: Args, given: dict[str, Any], env_kwargs: dict[str, Any], done: int) -> Any:
    """RLlib's PPO, with Stable-Baselines3's defaults where the hyperparameters ``given`` say nothing."""
    rate = str(given["learning_rate"])  # lin_0.001: from there to zero over the run
    rates: Any = [[0, float(rate[4:])], [args.timesteps, 0.0]] if rate.startswith("lin_") else float(rate)
    envs = args.envs_per_runner or given["n_envs"] // args.runners
    env_id = args.env if ":" in args.env else f"clothgym:{args.env}"  # other machines import the module
    register_env(ALGO, lambda kwargs: RunnerBatch(gym.make_vec(vectorization_mode="vector_entry_point", **kwargs)))
    made = PPOConfig().environment(ALGO, env_config={"id": env_id, "threads": 1, **env_kwargs})
    made.normalize_actions, made.clip_actions = False, True
    made.env_runners(num_env_runners=args.runners, num_envs_per_env_runner=envs,
                     gym_env_vectorize_mode="vector_entry_point", rollout_fragment_length=given["n_steps"],
                     sample_timeout_s=600.0)  # fmt: skip
    made.training(learner_class=Learner, train_batch_size_per_learner=envs * args.runners * given["n_steps"], lr=rates,
                  minibatch_size=given["batch_size"], num_epochs=given["n_epochs"], gamma=given["gamma"], use_kl_loss=False,
                  lambda_=given["gae_lambda"], clip_param=0.2, vf_loss_coeff=0.5, vf_clip_param=float("inf"), grad_clip=0.5,
                  grad_clip_by="global_norm")  # fmt: skip
    network = {"fcnet_hiddens": given["policy_kwargs"]["net_arch"], "log_std_init": given["policy_kwargs"]["log_std_init"],
               "fcnet_activation": "tanh", "fcnet_kernel_initializer": "orthogonal_", "fcnet_bias_initializer": "zeros_",
               "fcnet_kernel_initializer_kwargs": {"gain": 2**0.5}, "vf_share_layers": False, "free_log_std": True}  # fmt: skip
    made.rl_module(rl_module_spec=RLModuleSpec(module_class=ActorCritic, model_config=network))
    # a lost runner is started again where there is room; until then the others collect its share
    made.fault_tolerance(restart_failed_env_runners=True, num_consecutive_env_runner_failures_tolerance=10**6,
                         env_runner_health_probe_timeout_s=1.0, env_runner_restore_timeout_s=60.0)  # fmt: skip
    return made.debugging(seed=args.seed + done, log_level="ERROR").build_algo()


def main(args: Args) -> None:
    args.env = checked_id(args.env)
    given = policies.hyperparameters_of(args.hyperparams, args.env)
    env_kwargs, args.timesteps = given.get("env_kwargs", {}), args.timesteps or int(given["n_timesteps"])
    folder = args.run or Path("runs") / f"{args.env.rpartition(':')[2]}_rllib_{args.seed}"
    kept = sorted(folder.glob("checkpoint_*"))
    if kept and not args.resume:
        raise SystemExit(f"{folder} holds a run already: go on with --resume, or choose another folder with --run")
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "part", ignore_errors=True)  # of a run that was killed
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    local: dict[str, Any] = {"num_cpus": args.runners, "include_dashboard": False} if args.address == "local" else {}
    if local:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # Ray's switch for laptops: all of its servers listen on 127.0.0.1
    ray.init(address=args.address, logging_level="ERROR", log_to_driver=False, **local)
    done, begun = int(kept[-1].name.rpartition("_")[2]) if kept else 0, time.perf_counter()
    algo = build(args, given, env_kwargs, done)
    if kept:
        algo.restore_from_path(kept[-1].resolve())
    while done < args.timesteps:
        sampled = algo.train().get("env_runners", {})
        steps = int(sampled.get("num_env_steps_sampled", 0))  # none, if all runners are lost
        done += steps
        line = {"timesteps": done, "seconds": time.perf_counter() - begun}
        line |= {"runners": algo.env_runner_group.num_healthy_remote_workers(), "return": sampled.get("episode_return_mean")}
        print(line, flush=True)
        with open(folder / "progress.jsonl", "a") as file:
            file.write(json.dumps(line, default=float) + "\n")
        if steps:
            algo.save_to_path((folder / "part").resolve())
            (folder / "part").rename(folder / f"checkpoint_{done:012d}")
        for old in sorted(folder.glob("checkpoint_*"))[:-1]:
            shutil.rmtree(old)
    network = algo.learner_group.get_state()["learner"]["rl_module"]["default_policy"]
    hidden = [name.removesuffix(".weight") for name in network if re.fullmatch(r"encoder.actor_encoder.*weight", name)]
    layers = [(network[f"{name}.weight"].T, network[f"{name}.bias"]) for name in (*hidden, "pi.net.mlp.0")]
    about = {"env": args.env, "env_kwargs": env_kwargs, "seed": args.seed, "learner": ALGO, "timesteps": args.timesteps}
    Policy(layers, "tanh", about=about).save(folder / "policy.npz")
    print(f"python training/evaluate.py --env {args.env} --policy {folder}/policy.npz  scores what was learned")


if __name__ == "__main__":
    main(tyro.cli(Args))

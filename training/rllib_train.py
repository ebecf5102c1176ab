"""Train a policy by RLlib's PPO, on this machine or on a Ray cluster: runners step batches of environments, a learner learns.

    python training/rllib_train.py --env ClothReach-v0 --runners 2                   # runs/ClothReach-v0_rllib_0
    python training/rllib_train.py --env ClothDrape-v0 --address auto --runners 16   # on the cluster that `ray start` has made
    python training/rllib_train.py --resume runs/ClothReach-v0_rllib_0               # after an interruption

Hyperparameters are those of train.py, from hyperparams/ppo.yml: n_envs environments, shared among the runners, take n_steps each,
then the learner makes its updates.  A runner that is lost with its machine is started again where there is room; until then the
others collect its share.  The folder holds: config.json, checkpoint.pt and checkpoint_before.pt, tensors only, with the names of
Stable-Baselines3's policy, progress.jsonl (one iteration a line), and at the end policy.npz and its score, evaluation.json.
See docs/cluster.md.
"""

from __future__ import annotations

import json
import math
import os
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import evaluate
import gymnasium as gym
import numpy as np
import policies
import tyro
from endings import going_on, refused, stopped
from rllib_args import ALGO, Args
from scoring import HELD_OUT, run_episodes, score

from clothgym import files
from clothgym.adapters.runs import CHECKPOINT, load_last, save_tensors
from clothgym.policies import Policy

POLICY, PROGRESS, EVALUATION = "policy.npz", "progress.jsonl", "evaluation.json"
MODULE = "default_policy"  # RLlib's name of a network that is the only one
# Stable-Baselines3's defaults, which train.py learns with
CLIP_RANGE, VF_COEF, MAX_GRAD_NORM, ADAM_EPS = 0.2, 0.5, 0.5, 1e-5


# --- environments and network ----------------------------------------------------------------------------------------------


class RunnerBatch(gym.vector.VectorWrapper):
    """The batch of one runner, with seeds of its own, and quiet but for how an episode ended."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """RLlib seeds runner i with seed + i, and our batches do so with environments: runners would meet the same episodes.

        So each runner's seed is hashed, to one below all held-out ones.  A runner that replaces a lost one begins with another.
        """
        import ray

        if seed is not None:
            context = ray.get_runtime_context() if ray.is_initialized() else None
            again = context and context.get_actor_id() and context.was_current_actor_reconstructed
            made = np.random.SeedSequence(None if again else seed).generate_state(1)[0]
            seed = int(made) % (HELD_OUT - self.num_envs)
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """RLlib keeps and sends all that an info says of each step: here one number of each episode."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        ended = {"is_success": info["is_success"], "_is_success": terminated | truncated}
        return observation, reward, terminated, truncated, ended


def make_batch(context: dict[str, Any]) -> RunnerBatch:
    """A runner's environments; context: its keyword arguments, with the id and, from RLlib, their number."""
    kwargs = dict(context)
    # Gymnasium's default autoreset mode, next step, is the one that RLlib expects
    return RunnerBatch(gym.make_vec(kwargs.pop("id"), vectorization_mode="vector_entry_point", **kwargs))


def actor_critic() -> type:
    """The class of the network, which is Stable-Baselines3's; made in a function, it travels to machines without this file."""
    import torch
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.distribution.torch.torch_distribution import TorchDiagGaussian
    from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
    from ray.rllib.core.rl_module.torch import TorchRLModule
    from torch import nn

    class ActorCritic(TorchRLModule, ValueFunctionAPI):
        """Two nets that share nothing: the mean of a normal distribution of actions, and the value of an observation."""

        def setup(self) -> None:
            def linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
                layer = nn.Linear(inputs, outputs)
                nn.init.orthogonal_(layer.weight, gain)
                nn.init.zeros_(layer.bias)
                return layer

            def hidden() -> nn.Sequential:
                return nn.Sequential(*(one for two in pairwise(sizes) for one in (linear(*two, gain=2**0.5), nn.Tanh())))

            actions, sizes = self.action_space.shape[0], (self.observation_space.shape[0], *self.model_config["net_arch"])
            self.log_std = nn.Parameter(torch.full((actions,), float(self.model_config["log_std_init"])))
            self.mlp_extractor = nn.ModuleDict({"policy_net": hidden(), "value_net": hidden()})
            # the gain of 0.01 makes the first actions nearly independent of what is seen
            self.action_net, self.value_net = linear(sizes[-1], actions, 0.01), linear(sizes[-1], 1, 1.0)
            self.action_dist_cls = TorchDiagGaussian

        def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
            mean = self.action_net(self.mlp_extractor["policy_net"](batch[Columns.OBS]))
            return {Columns.ACTION_DIST_INPUTS: torch.cat([mean, self.log_std.expand_as(mean)], -1)}

        def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
            return self.value_net(self.mlp_extractor["value_net"](batch[Columns.OBS])).squeeze(-1)

    return ActorCritic


def learner() -> type:
    """The class of the learner: RLlib's, with advantages standardized, and Adam set, as in train.py."""
    import torch
    from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner

    class Learner(PPOTorchLearner):
        """RLlib adds a step to each episode, for the value of what came last.  The loss leaves it out, but the mean and deviation
        of the advantages do not, and its own, an episode's whole value, is many times theirs: all others became negative.
        """

        def compute_loss_for_module(self, *, batch: dict[str, Any], **kwargs: Any) -> Any:
            taken = batch["advantages"][batch["loss_mask"]]
            batch["advantages"] = (batch["advantages"] - taken.mean()) / (taken.std() + 1e-8)
            return super().compute_loss_for_module(batch=batch, **kwargs)

        def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
            """Adam with Stable-Baselines3's eps; RLlib's default is torch's."""
            params = self.get_parameters(self.module[module_id])
            optimizer = torch.optim.Adam(params, eps=ADAM_EPS)
            self.register_optimizer(module_id=module_id, optimizer=optimizer, params=params, lr_or_lr_schedule=config.lr)

    return Learner


# --- the algorithm ---------------------------------------------------------------------------------------------------------


def note_success(episode: Any, metrics_logger: Any, **kwargs: Any) -> None:
    """RLlib's callback at an episode's end: the rate of success of the last hundred."""
    metrics_logger.log_value("success", float(episode.get_infos(-1)["is_success"]), window=100)


def build(args: Args, env_kwargs: dict[str, Any], done: int) -> Any:
    """RLlib's PPO with the run's hyperparameters, after so many environment steps."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec
    from ray.tune import register_env

    config, given = args.config, args.config["hyperparameters"]
    runners, learners = max(args.runners, 1), max(args.learners, 1)
    # lin_0.001: from there to zero over the run; RLlib counts the steps of this algorithm only, from zero
    rate, left = float(str(given["learning_rate"]).removeprefix("lin_")), config["timesteps"] - done
    linear = str(given["learning_rate"]).startswith("lin_")
    schedule = [[0, rate * left / config["timesteps"]], [left, 0.0]] if linear else rate
    register_env(ALGO, make_batch)
    # other episodes after an interruption than at the beginning
    seed = int(np.random.SeedSequence([config["seed"], done]).generate_state(1)[0]) % 2**31
    made = PPOConfig()
    made.environment(
        ALGO,
        # a runner on another machine imports the module that registers the id
        env_config={"id": config["env"] if ":" in config["env"] else f"clothgym:{config['env']}"}
        | {"threads": args.cpus_per_runner} | env_kwargs,
        # what is executed is clipped, what is learned from is the action that was drawn
        normalize_actions=False, clip_actions=True,
    )  # fmt: skip
    made.env_runners(
        num_env_runners=args.runners, num_envs_per_env_runner=config["num_envs"] // runners,
        num_cpus_per_env_runner=args.cpus_per_runner, gym_env_vectorize_mode="vector_entry_point",
        rollout_fragment_length=given["n_steps"],
        sample_timeout_s=600.0,  # a runner may be slow; one that is lost is mostly reported by Ray long before
    )  # fmt: skip
    made.learners(num_learners=args.learners)
    made.training(
        learner_class=learner(), train_batch_size_per_learner=config["num_envs"] * given["n_steps"] // learners,
        minibatch_size=given["batch_size"] // learners, num_epochs=given["n_epochs"], lr=schedule, gamma=given["gamma"],
        lambda_=given["gae_lambda"], clip_param=CLIP_RANGE, vf_loss_coeff=VF_COEF, grad_clip=MAX_GRAD_NORM,
        grad_clip_by="global_norm",
        # what RLlib has beyond that is turned off
        vf_clip_param=float("inf"), use_kl_loss=False,
    )  # fmt: skip
    made.rl_module(rl_module_spec=RLModuleSpec(module_class=actor_critic(), model_config=dict(given["policy_kwargs"])))
    made.fault_tolerance(
        restart_failed_env_runners=True, num_consecutive_env_runner_failures_tolerance=10**6,
        env_runner_health_probe_timeout_s=1.0,  # each iteration waits so long for a runner that is not back
        env_runner_restore_timeout_s=60.0,  # and so long for one that is back to take the network: it may be lost again
    )  # fmt: skip
    made.callbacks(on_episode_end=note_success).debugging(seed=seed, log_level="ERROR")
    return made.build_algo()


def state_of(algo: Any, done: int, iterations: int, times: dict[str, float]) -> dict[str, Any]:
    """What a checkpoint holds: tensors of the network and of Adam, and counters."""
    import torch
    import tree

    kept = algo.learner_group.get_state()["learner"]
    tensors = tree.map_structure(lambda x: torch.from_numpy(x.copy()) if isinstance(x, np.ndarray) else x, kept["optimizer"])
    network = {name: torch.from_numpy(array.copy()) for name, array in kept["rl_module"][MODULE].items()}
    counters = {"num_timesteps": done, "num_updates": iterations, "times": times}
    return {"policy": network, "optimizer": tensors, "variables": {}, "constraint": {}} | counters


def restore(algo: Any, state: dict[str, Any]) -> None:
    """Put a checkpoint's tensors into the learners, and into the runners."""
    network = {name: tensor.numpy() for name, tensor in state["policy"].items()}
    # Adam's moments are the checkpoint's, its learning rate is the schedule's: the run may have been given other steps
    optimizers = algo.learner_group.get_state()["learner"]["optimizer"]
    for name, optimizer in optimizers.items():
        optimizer["state"] |= {"state": state["optimizer"][name]["state"]["state"]}
    algo.learner_group.set_state({"learner": {"rl_module": {MODULE: network}, "optimizer": optimizers}})
    algo.env_runner_group.sync_weights(from_worker_or_learner_group=algo.learner_group, inference_only=True)


@contextmanager
def cluster(args: Args) -> Iterator[None]:
    """Ray: the cluster of the address, or one of this machine alone."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    local = args.address == "local"
    if local:  # Ray's switch for laptops, on Linux as well: all of its servers listen on 127.0.0.1
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with refused():
        import ray  # imported here: it takes seconds, and what is wrong has been said by now

        here = (
            {"num_cpus": max(args.runners * args.cpus_per_runner + args.learners, 1), "include_dashboard": False} if local else {}
        )
        try:
            ray.init(address=args.address, logging_level="ERROR", log_to_driver=False, **here)
        except Exception as error:  # a bare one, if it has not started within half a minute
            raise OSError(f"Ray: {error}") from error
    try:
        yield
    except ray.exceptions.RayError as error:
        raise OSError(f"Ray: {(str(error).strip() or type(error).__name__).splitlines()[-1]}") from error
    finally:
        ray.shutdown()


# --- the run ---------------------------------------------------------------------------------------------------------------


def train(args: Args, state: dict[str, Any] | None) -> dict[str, Any]:
    """Learn, with a checkpoint a minute; the last state.  state: of the checkpoint to go on from."""
    config, first = args.config, args.config["curriculum"]
    # a curriculum begins with other arguments of the environment: another algorithm, which goes on with the first one's state
    stages = [(config["env_kwargs"] | first["env_kwargs"], first["n_timesteps"])] if first else []
    for env_kwargs, until in [*stages, (config["env_kwargs"], config["timesteps"])]:
        done = state["num_timesteps"] if state else 0
        if done >= min(until, config["timesteps"]):
            continue
        algo = build(args, env_kwargs, done)
        if state:
            restore(algo, state)
        state = learn(args, algo, state, min(until, config["timesteps"]))
        algo.stop()
    assert state is not None
    return state


def learn(args: Args, algo: Any, state: dict[str, Any] | None, until: int) -> dict[str, Any]:
    """Iterations until so many environment steps are done, each with a line that says so; the state at the end."""
    done, iterations = (state["num_timesteps"], state["num_updates"]) if state else (0, 0)
    before = state["times"] if state else {"training_seconds": 0.0, "core_seconds": 0.0}
    begun = kept = time.perf_counter()
    cores = core_seconds(algo)
    while done < until:
        last = time.perf_counter()
        result = algo.train()
        now = time.perf_counter()
        ran = result.get("env_runners", {})
        steps = int(ran.get("num_env_steps_sampled", 0))  # none, if all runners are lost
        done, iterations = done + steps, iterations + 1
        runners, seconds = algo.env_runner_group.num_healthy_remote_workers(), before["training_seconds"] + now - begun
        line = {"iteration": iterations, "timesteps": done, "training_seconds": seconds, "runners": runners}
        numbers = {
            "steps_per_second": steps / (now - last),
            "return": ran.get("episode_return_mean"),
            "success": ran.get("success"),
        }
        numbers |= {"loss": result.get("learners", {}).get(MODULE, {}).get("total_loss")}
        # what there is none of yet, the return before an episode has ended for instance, RLlib leaves out or calls NaN
        line |= {name: float(value) for name, value in numbers.items() if value is not None and math.isfinite(value)}
        with open(args.folder / PROGRESS, "a") as file:
            file.write(json.dumps(line) + "\n")
        came = "".join(f", {name} {line[name]:.3f}" for name in ("return", "success") if name in line)
        speed = f"{line['steps_per_second']:,.0f} steps/s on {runners} of {args.runners} runners"
        print(f"iteration {iterations}: {done:,} steps in {seconds / 60:.1f} min, {speed}{came}", flush=True)
        if now - kept >= args.checkpoint_seconds or done >= until:
            times = {"training_seconds": seconds, "core_seconds": before["core_seconds"] + core_seconds(algo) - cores}
            kept, state = now, state_of(algo, done, iterations, times)
            save_tensors(args.folder / CHECKPOINT, state)
    assert state is not None
    return state


def drop_unkept(path: Path, done: int) -> None:
    """Leave the lines of iterations up to the checkpoint; a run that was killed has others, and perhaps a half one."""
    whole = []
    for text in path.read_text(errors="replace").splitlines() if path.exists() else ():
        with suppress(ValueError, KeyError, TypeError):
            if json.loads(text)["timesteps"] <= done:
                whole.append(text)
    files.write(path, "".join(f"{text}\n" for text in whole))


def core_seconds(algo: Any) -> float:
    """Processors' time of this process and of the runners that are there [s]."""
    return time.process_time() + sum(
        algo.env_runner_group.foreach_env_runner(lambda runner: time.process_time(), local_env_runner=False)
    )


def finish(args: Args, state: dict[str, Any]) -> None:
    """Export the policy, and score what was exported on seeds that training never saw."""
    from clothgym.lab.bench import machine
    from clothgym.lab.digests import digest_of

    config = args.config
    about = {name: config[name] for name in ("env", "env_kwargs", "seed")} | {"learner": ALGO, "timesteps": state["num_timesteps"]}
    about |= {"digest": digest_of(config["env"], config["env_kwargs"]), "machine": machine()} | state["times"]
    policy = exported(state["policy"], about)
    seeds = list(range(HELD_OUT, HELD_OUT + args.final_episodes))
    scored = score(run_episodes(config["env"], lambda env, seen: policy(seen), seeds, **config["env_kwargs"]))
    policy.about |= {name: scored[name] for name in ("success_rate", "normalized_performance", "episodes")}
    policy.save(args.folder / POLICY)
    evaluate.write_json(args.folder / EVALUATION, scored | about | {"runners": args.runners, "num_envs": config["num_envs"]})
    print(f"{config['env']}, held-out episodes\n{evaluate.table({str(args.folder): scored})}")
    took = " and ".join(f"{state['times'][name] / 60:.1f} {name.partition('_')[0]} minutes" for name in state["times"])
    print(f"{took}; clothgym.policies.read({str(args.folder / POLICY)!r}) loads the policy")


def exported(network: dict[str, Any], about: dict[str, Any]) -> Policy:
    """The layers that decide, hidden ones first, without what they were trained with."""
    names = sorted(name.removesuffix(".weight") for name in network if re.fullmatch(r"mlp_extractor.policy_net.\d+.weight", name))
    pairs = [(network[f"{name}.weight"].numpy().T, network[f"{name}.bias"].numpy()) for name in [*names, "action_net"]]
    return Policy(pairs, "tanh", about=about)


def main(args: Args) -> None:
    with refused():
        space = gym.make_vec(args.env, num_envs=1, **args.config["env_kwargs"]).single_observation_space
        if space.shape is None or len(space.shape) != 1:
            raise ValueError(f"{args.env} with {args.config['env_kwargs']}: the network takes vectors, not {space}")
        state = load_last(args.folder) if args.resume and policies.has_checkpoint(args.folder) else None
    done = state["num_timesteps"] if state else 0
    if args.resume:
        print(f"going on with {args.folder} at {done:,} of {args.config['timesteps']:,} steps")
    args.folder.mkdir(parents=True, exist_ok=True)
    files.write_json(args.folder / policies.CONFIG, args.config)
    if done < args.config["timesteps"]:
        # what the run has exported before is of another policy now
        for name in (POLICY, EVALUATION):
            (args.folder / name).unlink(missing_ok=True)
        drop_unkept(args.folder / PROGRESS, done)
        with cluster(args):
            state = train(args, state)
    assert state is not None
    finish(args, state)


if __name__ == "__main__":
    np.seterr(all="ignore")
    warnings.filterwarnings("ignore", module="ray|gymnasium")  # RLlib warns of its own deprecated calls
    given = tyro.cli(Args)
    with stopped(lambda: going_on("rllib_train.py", given.folder)):
        main(given)

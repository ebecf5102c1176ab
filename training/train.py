"""Train PPO on a clothgym environment, evaluate it on held-out seeds, and leave a folder that tells the story.

    python training/train.py --env ClothDrape-v0                    # runs/ClothDrape-v0_0
    python training/train.py --env ClothDrape-v0 --seed 1 --timesteps 500000
    python training/train.py --env ClothStrain-v0 --algo ppo_lagrange   # runs/ClothStrain-v0_ppo_lagrange_0
    python training/train.py --env ClothDrapeGripper-v0 --algo bc_ppo   # runs/ClothDrapeGripper-v0_bc_ppo_0
    python training/train.py --resume runs/ClothDrape-v0_0          # go on after an interruption; a finished run is scored anew

The folder holds: config.json, checkpoint.pt (the last) and best.pt (by held-out success), which hold tensors only, model.zip
(Stable-Baselines3's own format, for ``PPO.load``), progress.jsonl (one held-out evaluation a line), evaluation.json (the final
score, of best.pt), learning_curve.png, policy.gif, and the TensorBoard log.  Hyperparameters are read from
hyperparams/ALGO.yml, in the format of rl_zoo3.
"""

from __future__ import annotations

import json
import math
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import evaluate
import numpy as np
import policies
import torch
import tyro
import yaml
from clone import clone, demonstrations
from lagrange import LagrangeMultiplier
from report import draw_learning_curve, film
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import clothgym
from clothgym.adapters.sb3 import make_sb3_vec_env
from clothgym.registration import checked_id

HERE = Path(__file__).parent


@dataclass
class Args:
    """What to train, for how long, and where to keep it."""

    env: str = "ClothDrape-v0"
    """Id of the environment."""
    seed: int = 0
    """Seed of the learner and of its environments."""
    algo: Literal["ppo", "ppo_penalty", "ppo_lagrange", "bc_ppo"] = "ppo"
    """PPO; with a fixed price, or a Lagrange multiplier, on cost; or after a clone of the scripted expert."""
    timesteps: int | None = None
    """Environment steps; the hyperparameter file's number by default."""
    run: Path | None = None
    """Folder of the run; runs/ENV_SEED by default, or runs/ENV_ALGO_SEED."""
    resume: Path | None = None
    """Folder of a run to go on with; its configuration is used."""
    hyperparams: Path | None = None
    """Hyperparameters by environment id, in rl_zoo3's format; hyperparams/ALGO.yml by default."""
    env_kwargs: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"integrator": "xpbd"}'; over those of the hyperparameter file."""
    eval_episodes: int = 200
    """Held-out episodes of each evaluation on the way."""
    final_episodes: int = 500
    """Held-out episodes of the final evaluation."""
    threads: int = 1
    """Threads of torch while it learns; two gain little on nets as small as these, and wait for each other on a busy machine."""

    def __post_init__(self) -> None:
        self.env = checked_id(self.env)
        for name in ("timesteps", "eval_episodes", "final_episodes", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')} {value}: must be at least 1")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed {self.seed}: must be from 0 to 2^32 - 1")


class HeldOutEvaluation(BaseCallback):
    """Every so many rollouts: score the policy on held-out seeds, append a line to progress.jsonl, save a checkpoint."""

    def __init__(self, folder: Path, config: dict[str, Any], every: int, episodes: int) -> None:
        super().__init__()
        self.folder, self.config, self.every, self.episodes = folder, config, every, episodes
        self.rollouts = 0
        self.best = max((_rank(line, config) for line in _lines(folder)), default=-math.inf)
        self.trained_before = float(_lines(folder)[-1]["training_seconds"]) if _lines(folder) else 0.0
        self.evaluating = 0.0
        self.started = time.perf_counter()

    @property
    def training_seconds(self) -> float:
        """Time spent on training, evaluations left out."""
        return self.trained_before + time.perf_counter() - self.started - self.evaluating

    def _on_training_start(self) -> None:
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # OpenMP's idle workers spin: while the environments run, torch must not have any
        torch.set_num_threads(1)
        if self.rollouts % self.every == 0 and (self.rollouts or self.config["clone"]):
            self.evaluate()
        self.rollouts += 1

    def _on_rollout_end(self) -> None:
        torch.set_num_threads(self.config["threads"])

    def evaluate(self) -> None:
        begun = time.perf_counter()
        policies.save_checkpoint(self.folder, self.model)

        def policy(env: Any, observations: Any) -> Any:
            return self.model.predict(observations, deterministic=True)[0]

        # the tail of the held-out seeds: the final score's are others
        first = evaluate.HELD_OUT + 1_000_000
        seeds = list(range(first, first + self.episodes))
        episodes = evaluate.run_episodes(self.config["env"], policy, seeds, progress=False, **self.config["env_kwargs"])
        line = {
            "timesteps": self.num_timesteps,
            "training_seconds": self.training_seconds - (time.perf_counter() - begun),
            "success_rate": float(episodes["is_success"].mean()),
            "normalized_performance": float(episodes["normalized_performance"].mean()),
            "return": float(episodes["return"].mean()),
        }
        if "episode_cost" in episodes:
            line["cost"] = float(episodes["episode_cost"].mean())
        if _rank(line, self.config) >= self.best:
            self.best = _rank(line, self.config)
            policies.save_checkpoint(self.folder, self.model, policies.BEST)
        with open(self.folder / "progress.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")
        for key in line.keys() - {"timesteps", "training_seconds"}:
            self.logger.record(f"held_out/{key}", line[key])
        self.evaluating += time.perf_counter() - begun


def configure(args: Args) -> tuple[Path, dict[str, Any]]:
    """The run's folder and configuration: a new one, or that of the run to go on with."""
    if args.resume is not None:
        config = policies.read_config(args.resume)
        if args.run is not None:
            raise ValueError("--resume goes on in the run's own folder: leave --run away")
        if args.timesteps is not None:
            config["timesteps"] = args.timesteps
        return args.resume, config
    path = args.hyperparams or HERE / "hyperparams" / f"{args.algo}.yml"
    table = yaml.safe_load(path.read_text())
    if args.env not in table:
        raise ValueError(
            f"{path} has no hyperparameters for {args.env!r} (there are: {', '.join(table)}): give a file with --hyperparams"
        )
    hyperparameters = dict(table[args.env])
    config = {
        "clothgym": clothgym.__version__,
        "env": args.env,
        "algo": args.algo,
        "lagrange": hyperparameters.pop("lagrange", {}),
        "clone": hyperparameters.pop("clone", {}),
        "env_kwargs": hyperparameters.pop("env_kwargs", {}) | policies.parsed_kwargs(args.env_kwargs),
        "num_envs": hyperparameters.pop("n_envs"),
        "timesteps": args.timesteps if args.timesteps is not None else int(hyperparameters["n_timesteps"]),
        "seed": args.seed,
        "threads": args.threads,
        "hyperparameters": {key: value for key, value in hyperparameters.items() if key != "n_timesteps"},
        "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
    }
    bare = args.env.rpartition(":")[2]
    name = bare if args.algo == "ppo" else f"{bare}_{args.algo}"
    folder = args.run or Path("runs") / f"{name}_{args.seed}"
    if (folder / policies.CHECKPOINT).exists():
        raise FileExistsError(f"{folder} holds a run already: go on with --resume {folder}, or choose another folder with --run")
    folder.mkdir(parents=True, exist_ok=True)
    evaluate.write_json(folder / policies.CONFIG, config)
    return folder, config


def training_seed(seed: int, done: int, num_envs: int) -> int:
    """Seed of the first environment, below all held-out ones; a resumed run meets new episodes, not its beginning's again."""
    return int(np.random.SeedSequence([seed, done]).generate_state(1)[0]) % (evaluate.HELD_OUT - num_envs)


def build(folder: Path, config: dict[str, Any], seed: int) -> PPO:
    """The learner of a configuration, on its own batch of environments."""
    options = dict(config["hyperparameters"])
    policy = options.pop("policy")
    for key in ("learning_rate", "clip_range"):
        if isinstance(options.get(key), str):
            options[key] = _linear(options[key])
    env = VecMonitor(make_sb3_vec_env(config["env"], config["num_envs"], seed=seed, **config["env_kwargs"]))
    return PPO(policy, env, seed=seed, device="cpu", tensorboard_log=str(folder / "tensorboard"), **options)


def _linear(text: str) -> Any:
    """rl_zoo3's "lin_0.001": from there to zero over the run."""
    kind, _, value = text.partition("_")
    if kind != "lin":
        raise ValueError(f"hyperparameter {text!r}: a schedule is written lin_VALUE")
    start = float(value)
    return lambda remaining: start * remaining


def _rank(line: dict[str, float], config: dict[str, Any]) -> float:
    """What makes an evaluation the best: its success; a constrained learner's cost must first be within its limit, and where
    costs have a price the return tells."""
    if config["env_kwargs"].get("cost_penalty"):
        return line["return"]
    limit = config["lagrange"].get("cost_limit", math.inf)
    return line["success_rate"] if line.get("cost", 0.0) <= limit else -line["cost"]


def _lines(folder: Path) -> list[dict[str, float]]:
    path = folder / "progress.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def train(args: Args) -> Path:
    folder, config = configure(args)
    done = 0
    if args.resume is not None:
        done = int(torch.load(folder / policies.CHECKPOINT, weights_only=True)["num_timesteps"])
    model = build(folder, config, training_seed(config["seed"], done, config["num_envs"]))
    if args.resume is not None:
        policies.load_checkpoint(folder, model)
        print(f"going on with {folder} at {done:,} of {config['timesteps']:,} steps")
    per_rollout = config["num_envs"] * model.n_steps
    watch = HeldOutEvaluation(folder, config, max(1, round(200_000 / per_rollout)), args.eval_episodes)
    if config["clone"] and done == 0:
        watch.trained_before += learn_from_expert(model, config)
    callbacks: list[BaseCallback] = [watch]
    if config["algo"] == "ppo_lagrange":
        callbacks.append(LagrangeMultiplier(folder, **config["lagrange"]))
    seconds = watch.trained_before
    if config["timesteps"] > done:
        try:
            # learn() counts its steps on top of those done when the counter is not reset
            left = config["timesteps"] - done
            model.learn(left, callback=callbacks, progress_bar=True, reset_num_timesteps=False, tb_log_name="ppo")
        except KeyboardInterrupt:
            policies.save_checkpoint(folder, model)
            raise SystemExit(f"interrupted: go on with  python training/train.py --resume {folder}") from None
        seconds = watch.training_seconds
        watch.evaluate()
        model.save(folder / "model.zip")
    finish(folder, config, seconds, args.final_episodes)
    return folder


def learn_from_expert(model: PPO, config: dict[str, Any]) -> float:
    """Clone the scripted expert into the policy; the time it took [s]."""
    begun = time.perf_counter()
    options = dict(config["clone"])
    samples = demonstrations(model.env, options.pop("episodes"), options.pop("noise"), config["seed"])  # type: ignore[arg-type]
    torch.set_num_threads(config["threads"])
    error = clone(model, *samples, **options)
    print(f"cloned the expert from {len(samples[0]):,} samples: mean squared error {error:.4f}")
    return time.perf_counter() - begun


def finish(folder: Path, config: dict[str, Any], seconds: float, episodes: int) -> None:
    """Final score beside the references, learning curve and film."""
    scores = {}
    names = ["noop", "random", "expert", str(folder)]
    if config["env"] == "ClothStrain-v0":
        names.insert(3, "careless")
    for name in names:
        policy = policies.named(name, config["env"], evaluate.HELD_OUT)
        seeds = list(range(evaluate.HELD_OUT, evaluate.HELD_OUT + episodes))
        scores[name] = evaluate.score(evaluate.run_episodes(config["env"], policy, seeds, **config["env_kwargs"]))
    print(f"{config['env']}, {episodes} held-out episodes\n{evaluate.table(scores)}")
    learnt = scores[str(folder)] | {"env": config["env"], "seed": config["seed"], "training_seconds": seconds}
    evaluate.write_json(folder / "evaluation.json", learnt | {"timesteps": config["timesteps"], "references": scores})
    draw_learning_curve(folder, _lines(folder), {name: scores[name]["success_rate"] for name in ("noop", "expert")})
    film(folder / "policy.gif", config["env"], policies.learnt(folder, config["env"]), config["env_kwargs"])
    print(f"trained for {seconds / 60:.1f} minutes; see {folder}/learning_curve.png and {folder}/policy.gif")


if __name__ == "__main__":
    np.seterr(all="ignore")
    train(tyro.cli(Args))

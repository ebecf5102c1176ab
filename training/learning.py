"""How ``train.py`` learns: the learner of a configuration, held-out evaluations on the way, and the final score."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import evaluate
import lagrange
import numpy as np
import policies
import torch
from clone import clone, demonstrations, joined
from endings import refused
from lagrange import LagrangeMultiplier
from report import draw_learning_curve, film
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from clothgym import files
from clothgym.adapters.runs import load_last, load_tensors
from clothgym.adapters.sb3 import make_sb3_vec_env
from clothgym.checks import number as finite_number

PROGRESS, MODEL = "progress.jsonl", "model.zip"
SCORES = ("timesteps", "training_seconds", "success_rate", "normalized_performance", "return")  # in each of its lines
REFERENCE_EPISODES = 100  # of noop, random and the expert, beside which a learned policy is scored


class HeldOutEvaluation(BaseCallback):
    """Every so many rollouts: score the policy on held-out seeds, add a line to progress.jsonl, save a checkpoint.

    done: environment steps of the checkpoint that it goes on from; evaluations after it are dropped.
    """

    def __init__(self, folder: Path, config: dict[str, Any], every: int, episodes: int, done: int) -> None:
        super().__init__()
        self.folder, self.config, self.every, self.episodes = folder, config, every, episodes
        self.rollouts = 0
        self.lines = [line for line in read_progress(folder) if line["timesteps"] <= done]
        ranks = [_rank(line, config) for line in self.lines] if (folder / policies.BEST).exists() else []
        self.best = max(ranks, default=-math.inf)
        self.trained_before = self.lines[-1]["training_seconds"] if self.lines else 0.0
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
        self.lines.append(line)
        files.write(self.folder / PROGRESS, "".join(json.dumps(files.checked_in(one)) + "\n" for one in self.lines))
        for key in line.keys() - {"timesteps", "training_seconds"}:
            self.logger.record(f"held_out/{key}", line[key])
        self.evaluating += time.perf_counter() - begun


class Curriculum(BaseCallback):
    """Begins on environments with other arguments, with ``physics="fast"`` for instance, and goes on with the run's own.

    steps: environment steps of the first part.
    """

    def __init__(self, config: dict[str, Any], steps: int) -> None:
        super().__init__()
        self.config, self.steps = config, steps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps < self.steps or self.model.env is None:
            return
        self.steps = sys.maxsize
        config, seed = self.config, training_seed(self.config["seed"], self.num_timesteps, self.config["num_envs"])
        self.model.env.close()
        self.model.set_env(environments(config, config["env_kwargs"], seed), force_reset=False)
        # the next rollout begins with these; the one that has just ended is learned from all the same
        self.model._last_obs = self.model.env.reset()  # type: ignore[assignment]
        self.model._last_episode_starts = np.ones(config["num_envs"], bool)


def environments(config: dict[str, Any], env_kwargs: dict[str, Any], seed: int) -> VecMonitor:
    """A batch of a configuration's environments."""
    return VecMonitor(make_sb3_vec_env(config["env"], config["num_envs"], seed=seed, **env_kwargs))


def training_seed(seed: int, done: int, num_envs: int) -> int:
    """Seed of the first environment, below all held-out ones; a resumed run meets new episodes, not its beginning's again."""
    return int(np.random.SeedSequence([seed, done]).generate_state(1)[0]) % (evaluate.HELD_OUT - num_envs)


def build(folder: Path, config: dict[str, Any], seed: int, done: int) -> PPO:
    """The learner of a configuration, on its own batch of environments; done: environment steps of the run so far."""
    options = dict(config["hyperparameters"])
    policy = options.pop("policy")
    for key in ("learning_rate", "clip_range"):
        if isinstance(options.get(key), str):
            options[key] = _linear(options[key])
    first = config["curriculum"]
    kwargs = config["env_kwargs"] | (first["env_kwargs"] if first and done < first["n_timesteps"] else {})
    env = environments(config, kwargs, seed)
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


def read_progress(folder: Path) -> list[dict[str, float]]:
    """The held-out evaluations of a run; a line that is broken is dropped with a word."""
    path, lines = folder / PROGRESS, []
    if not path.exists():
        return []
    with files.naming(path, "list of evaluations", "remove it to go on without"):
        texts = files.read(path, files.LARGEST_JSON).decode(errors="replace").splitlines()
    for number, text in enumerate(texts, 1):
        try:
            line = files.checked_out(json.loads(text))
            lines.append({name: finite_number(name, line[name]) for name in (*SCORES, *(set(line) - set(SCORES)))})
        except (ValueError, KeyError, RecursionError):
            print(f"{path}: line {number} is broken, and is dropped", file=sys.stderr)
    return lines


def learner(folder: Path, config: dict[str, Any], resume: bool) -> tuple[PPO, int]:
    """The learner of a new run, or of one that goes on, and the environment steps that it has done.

    Raises:
        ValueError, TypeError: the environment or the learner does not take one of its options, or no checkpoint can be read.
    """
    state = load_last(folder) if resume and policies.has_checkpoint(folder) else None
    done = int(state["num_timesteps"]) if state is not None else 0
    model = build(folder, config, training_seed(config["seed"], done, config["num_envs"]), done)
    if state is not None:
        policies.load_checkpoint(folder, model, state)
        print(f"going on with {folder} at {done:,} of {config['timesteps']:,} steps")
        drop_damaged_best(folder)
    elif resume:
        print(f"{folder} has no checkpoint yet: beginning anew")
    return model, done


def drop_damaged_best(folder: Path) -> None:
    """Remove a best policy that cannot be read, with a word: the next evaluation is the best then."""
    best = folder / policies.BEST
    try:
        load_tensors(best)
    except FileNotFoundError:
        return
    except ValueError as error:
        best.unlink()
        print(f"{error}; it is removed, and the best from now on takes its place", file=sys.stderr)


def train(folder: Path, config: dict[str, Any], model: PPO, done: int, eval_episodes: int, final_episodes: int) -> None:
    """Learn, with held-out evaluations on the way, and score what was learned."""
    per_rollout = config["num_envs"] * model.n_steps
    if done == 0:
        (folder / lagrange.FILE).unlink(missing_ok=True)  # of a run that was interrupted before its first checkpoint
    with refused():
        watch = HeldOutEvaluation(folder, config, max(1, round(200_000 / per_rollout)), eval_episodes, done)
        callbacks: list[BaseCallback] = [watch]
        if config["algo"] == "ppo_lagrange":
            callbacks.append(LagrangeMultiplier(folder, **config["lagrange"]))
    if config["curriculum"] and done < config["curriculum"]["n_timesteps"]:
        callbacks.append(Curriculum(config, config["curriculum"]["n_timesteps"]))
    if config["clone"] and done == 0:
        watch.trained_before += learn_from_expert(model, config)
    seconds = watch.trained_before
    if config["timesteps"] > done:
        try:
            # learn() counts its steps on top of those done when the counter is not reset
            left = config["timesteps"] - done
            seen = sys.stdout.isatty() and sys.stderr.isatty()
            model.learn(left, callback=callbacks, progress_bar=seen, reset_num_timesteps=False, tb_log_name="ppo")
        except KeyboardInterrupt:
            policies.save_checkpoint(folder, model)
            raise
        seconds = watch.training_seconds
        watch.evaluate()
    if config["timesteps"] > done or not (folder / MODEL).exists():
        with files.replacing(folder / MODEL) as part:
            model.save(part)
    finish(folder, config, watch.lines, seconds, final_episodes)


def learn_from_expert(model: PPO, config: dict[str, Any]) -> float:
    """Clone the scripted expert into the policy; the time it took [s]."""
    begun = time.perf_counter()
    options = dict(config["clone"])
    env: Any = model.env
    episodes, noise, rounds = options.pop("episodes"), options.pop("noise"), options.pop("rounds", 0)
    samples = demonstrations(env, episodes, noise, config["seed"])
    torch.set_num_threads(config["threads"])
    for number in range(rounds + 1):
        if number:
            samples = joined(samples, demonstrations(env, 1, noise, config["seed"] + number, model))
        error = clone(model, *samples, **options)
        print(f"cloned the expert from {len(samples[1]):,} samples: mean squared error {error:.4f}")
    return time.perf_counter() - begun


def finish(folder: Path, config: dict[str, Any], lines: list[dict[str, float]], seconds: float, episodes: int) -> None:
    """Final score beside the references, learning curve and film."""
    scores = {}
    names = ["noop", "random", "expert", str(folder)]
    if config["env"] == "ClothStrain-v0":
        names.insert(3, "careless")
    for name in names:
        policy = policies.named(name, config["env"], evaluate.HELD_OUT)
        number = episodes if name == str(folder) else min(episodes, REFERENCE_EPISODES)
        seeds = list(range(evaluate.HELD_OUT, evaluate.HELD_OUT + number))
        try:
            scores[name] = evaluate.score(evaluate.run_episodes(config["env"], policy, seeds, **config["env_kwargs"]))
        except NotImplementedError as missing:  # with these arguments the task has no scripted expert
            print(missing)
    print(f"{config['env']}, held-out episodes\n{evaluate.table(scores)}")
    learned = scores[str(folder)] | {"env": config["env"], "seed": config["seed"], "training_seconds": seconds}
    evaluate.write_json(folder / "evaluation.json", learned | {"timesteps": config["timesteps"], "references": scores})
    draw_learning_curve(folder, lines, {name: scores[name]["success_rate"] for name in ("noop", "expert") if name in scores})
    film(folder / "policy.gif", config["env"], policies.learned(folder, config["env"]), config["env_kwargs"])
    print(f"trained for {seconds / 60:.1f} minutes; see {folder}/learning_curve.png and {folder}/policy.gif")

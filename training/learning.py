"""How ``train.py`` learns: held-out evaluations on the way, checkpoints, and the final score."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import policies
import results
import scoring
import suite
import torch
from clone import clone, demonstrations, fill, joined
from drawing import draw_learning_curve, film
from endings import refused
from learners import build, environments, exported, load_checkpoint, save_checkpoint
from policies import Config
from stable_baselines3.common.callbacks import BaseCallback

from clothgym import files
from clothgym.adapters.runs import POLICY, load_last
from clothgym.adapters.sb3 import channels_first
from clothgym.checks import number as finite_number
from clothgym.lab.bench import machine
from clothgym.lab.digests import digest_of

PROGRESS, MODEL, EVALUATION = "progress.jsonl", "model.zip", "evaluation.json"
SCORES = (
    "timesteps",
    "training_seconds",
    "core_seconds",
    "success_rate",
    "normalized_performance",
    "return",
)  # in each of its lines
REFERENCE_EPISODES = 100  # of noop, random and the expert, for comparison with a learned policy
CHOOSING_EPISODES = 500  # of the last evaluation on the way, by which one of several seeds may be chosen
FIRST = 100  # of the final episodes, whose successes the exported policy notes, for a test to count them again
CHECKPOINT_SECONDS = 60.0  # of training between two checkpoints, at most a rollout more


class Clock:
    """Time spent on training: by the wall, and by all cores together [s]; evaluations are left out."""

    def __init__(self, wall: float = 0.0, cores: float = 0.0) -> None:
        self.spent = np.array([wall, cores])
        self.begun: Any = None

    def start(self) -> None:
        self.begun = np.array([time.perf_counter(), time.process_time()])

    def stop(self) -> None:
        if self.begun is not None:
            self.spent, self.begun = self.spent + np.array([time.perf_counter(), time.process_time()]) - self.begun, None


class Record:
    """What is noted of a run: its held-out scores, a line each in progress.jsonl, its checkpoints, and the time that it has taken.

    state: of the checkpoint that it goes on from; lines after it are dropped.
    """

    def __init__(self, folder: Path, config: Config, state: dict[str, Any] | None) -> None:
        self.folder, self.config = folder, config
        before = state or {"num_timesteps": 0, "times": {}}
        self.lines = [line for line in read_progress(folder) if line["timesteps"] <= before["num_timesteps"]]
        self.clock = Clock(before["times"].get("training_seconds", 0.0), before["times"].get("core_seconds", 0.0))
        self.saved = time.perf_counter()
        # time in which environments step [s]; PPO also chooses actions in it, and SAC from scratch is updated meanwhile
        self.collecting = before["times"].get("collecting_seconds", 0.0)

    def times(self) -> dict[str, float]:
        """Time spent on training so far [s]."""
        wall, cores = map(float, self.clock.spent)
        return {"training_seconds": wall, "core_seconds": cores, "collecting_seconds": self.collecting}

    def is_due(self) -> bool:
        """Whether it is time for another checkpoint."""
        return time.perf_counter() - self.saved > CHECKPOINT_SECONDS

    def note(self, acting: policies.Policy, timesteps: int, episodes: int) -> dict[str, Any]:
        """Score a policy after so many steps; returns the line."""
        # the tail of the held-out seeds: the final score's are others
        first = scoring.HELD_OUT + 1_000_000
        seeds = list(range(first, first + episodes))
        found = scoring.run_episodes(self.config["env"], acting, seeds, progress=False, **self.config["env_kwargs"])
        line = {"timesteps": timesteps, **self.times(), "episodes": episodes}
        line |= {"success_rate": float(found["is_success"].mean())}
        line |= {name: float(found[name].mean()) for name in ("normalized_performance", "return")}
        if "episode_cost" in found:
            line["cost"] = float(found["episode_cost"].mean())
        self.lines.append(line)
        files.write(self.folder / PROGRESS, "".join(json.dumps(files.checked_in(one)) + "\n" for one in self.lines))
        return line

    def kept(self) -> dict[str, Any]:
        """The line of the policy that the run keeps: the last one, or the best one where its hyperparameters say so."""
        if self.config["hyperparameters"].get("keeps") != "best":
            return self.lines[-1]
        return max(reversed(self.lines), key=lambda line: (line["success_rate"], line["normalized_performance"]))


class Watch(Record, BaseCallback):
    """Between rollouts: a checkpoint each minute, and every so many steps a score on held-out seeds.

    every: environment steps between two scores.
    """

    def __init__(self, folder: Path, config: Config, every: int, episodes: int, state: dict[str, Any] | None) -> None:
        BaseCallback.__init__(self)
        Record.__init__(self, folder, config, state)
        self.every, self.episodes = every, episodes
        # a cloned policy is scored before it is trained further
        self.next = 0 if config["clone"] and not self.lines else int(self.lines[-1]["timesteps"] if self.lines else 0) + every
        self.collects_since = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # OpenMP's idle workers spin: while the environments run, torch must not have any
        torch.set_num_threads(1)
        self.clock.stop()
        if self.num_timesteps >= self.next:
            self.next = self.num_timesteps + self.every
            self.evaluate(self.episodes)
        elif self.is_due():
            self.save()
        self.clock.start()
        self.collects_since = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self.collecting += time.perf_counter() - self.collects_since
        torch.set_num_threads(self.config["threads"])

    def save(self) -> None:
        save_checkpoint(self.folder, self.model, self.times())
        self.saved = time.perf_counter()

    def evaluate(self, episodes: int) -> None:
        """Score the policy as it is, and save a checkpoint."""
        self.save()
        line = self.note(acting_of(self.model), self.num_timesteps, episodes)
        for key in line.keys() - set(SCORES[:3]):
            self.logger.record(f"held_out/{key}", line[key])
        self.saved = time.perf_counter()


def acting_of(model: Any) -> policies.Policy:
    """What the learner's policy does without exploring, on observations as environments give them."""

    def act(env: Any, observations: Any) -> Any:
        seen = channels_first(env.unwrapped.task.observed.mode, observations)
        return model.predict(seen, deterministic=True)[0]

    return act


class FrozenPolicy(BaseCallback):
    """Train only the critic for some rollouts: an untrained critic would make a cloned policy worse."""

    def __init__(self, rollouts: int) -> None:
        super().__init__()
        self.left = rollouts

    def _freeze(self, frozen: bool) -> None:
        policy: Any = self.model.policy
        for network in (policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net):
            network.requires_grad_(not frozen)
        policy.log_std.requires_grad_(not frozen)

    def _on_training_start(self) -> None:
        self._freeze(self.left > 0)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        # the update from this rollout follows
        self._freeze(self.left > 0)
        self.left -= 1


class Curriculum(BaseCallback):
    """Begins on environments with other arguments, with ``physics="fast"`` for instance, and goes on with the run's own.

    steps: environment steps of the first part.
    """

    def __init__(self, config: Config, steps: int) -> None:
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


def training_seed(seed: int, done: int, num_envs: int) -> int:
    """Seed of the first environment, below all held-out ones; a resumed run meets new episodes, not its beginning's again."""
    return int(np.random.SeedSequence([seed, done]).generate_state(1)[0]) % (scoring.HELD_OUT - num_envs)


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


def learner(folder: Path, config: Config, resume: bool) -> tuple[Any, dict[str, Any] | None]:
    """The learner of a new run, or of one that goes on, with the checkpoint that it goes on from.

    Raises:
        ValueError, TypeError: the environment or the learner does not take one of its options, or no checkpoint can be read.
    """
    state = load_last(folder) if resume and policies.has_checkpoint(folder) else None
    done = int(state["num_timesteps"]) if state is not None else 0
    model = build(folder, config, training_seed(config["seed"], done, config["num_envs"]), done)
    if state is not None:
        load_checkpoint(folder, model, state)
        print(f"going on with {folder} at {done:,} of {config['timesteps']:,} steps")
    elif resume:
        print(f"{folder} has no checkpoint yet: beginning anew")
    return model, state


def train(
    folder: Path,
    config: Config,
    model: Any,
    state: dict[str, Any] | None,
    eval_episodes: int,
    evaluations: int,
    final_episodes: int,
) -> None:
    """Learn, with held-out evaluations on the way, and score what was learned; state: of the checkpoint that it goes on from."""
    done = 0 if state is None else int(state["num_timesteps"])
    with refused():
        watch = Watch(folder, config, max(1, config["timesteps"] // evaluations), eval_episodes, state)
        callbacks: list[BaseCallback] = [watch]
    if config["curriculum"] and done < config["curriculum"]["n_timesteps"]:
        callbacks.append(Curriculum(config, config["curriculum"]["n_timesteps"]))
    if config["clone"]:
        if state is None:
            watch.clock.start()
            with refused():
                learn_from_expert(model, config)
            watch.clock.stop()
        rollouts = done // (config["num_envs"] * model.n_steps)
        callbacks.append(FrozenPolicy(config["clone"].get("critic_rollouts", 0) - rollouts))
    if config.get("demonstrations") and config["timesteps"] > done:
        # a run that goes on has lost its buffer
        watch.clock.start()
        with refused():
            fill(model, **config["demonstrations"], seed=config["seed"])
        watch.clock.stop()
    if config["timesteps"] > done:
        # what the run has exported before is of another policy now
        for name in (POLICY, MODEL, EVALUATION):
            (folder / name).unlink(missing_ok=True)
        try:
            # learn() counts its steps on top of those done when the counter is not reset
            left = config["timesteps"] - done
            seen = sys.stdout.isatty() and sys.stderr.isatty()
            model.learn(left, callback=callbacks, progress_bar=seen, reset_num_timesteps=False, tb_log_name=config["algo"])
        except KeyboardInterrupt:
            watch.clock.stop()
            save_checkpoint(folder, model, watch.times())
            raise
        watch.clock.stop()
    else:  # only behavior cloning, or a run that was killed before its score
        watch.init_callback(with_logger(model))
        watch.num_timesteps = done
    if config["timesteps"] > done or not (folder / MODEL).exists() or not watch.lines:
        watch.evaluate(max(eval_episodes, min(CHOOSING_EPISODES, final_episodes)))
        with files.replacing(folder / MODEL) as part:
            model.save(part)
    finish(folder, config, model, watch, final_episodes)


def with_logger(model: Any) -> Any:
    """A learner that does not learn has none yet."""
    from stable_baselines3.common.logger import Logger

    model.set_logger(Logger(None, []))
    return model


def learn_from_expert(model: Any, config: Config) -> None:
    """Clone the scripted expert into the policy."""
    options = {name: value for name, value in config["clone"].items() if name != "critic_rollouts"}
    env: Any = model.env
    episodes, noise, rounds = options.pop("episodes"), options.pop("noise"), options.pop("rounds", 0)
    try:
        samples = demonstrations(env, episodes, noise, config["seed"])
    except NotImplementedError as missing:
        raise ValueError(str(missing)) from missing
    torch.set_num_threads(config["threads"])
    for number in range(rounds + 1):
        if number:
            samples = joined(samples, demonstrations(env, 1, noise, config["seed"] + number, model))
        error = clone(model, *samples, **options)
        print(f"cloned the expert from {len(samples[1]):,} samples: mean squared error {error:.4f}")


def finish(folder: Path, config: Config, model: Any, watch: Watch, final_episodes: int) -> None:
    """Export the policy, and conclude the run with its score."""
    policy = exported(model, config, account_of(watch))
    acting = acting_of(model)
    if policy is not None:
        policy.save(folder / POLICY)
        acting = policies.exported(folder / POLICY)
    own = conclude(watch, acting, final_episodes)
    if policy is not None:
        policy.about |= own
        policy.save(folder / POLICY)


def account_of(record: Record) -> dict[str, Any]:
    """What a run's results say of how they were made."""
    config, times = record.config, record.times()
    return {
        "digest": digest_of(config["env"], config["env_kwargs"]),
        "timesteps": config["timesteps"],
        **times,
        "chosen_by": record.kept()["success_rate"],
        "machine": machine(),
    }


def known_references(config: Config, episodes: int) -> dict[str, Any]:
    """The scores of so many episodes of the references, from a committed run on an environment that does the same, bit for bit;
    empty if there is none."""
    about = {"env_kwargs": config["env_kwargs"], "digest": digest_of(config["env"], config["env_kwargs"])}
    for path in sorted(results.RUNS.glob(f"{config['env']}_*/{EVALUATION}")):
        row = json.loads(path.read_text())
        known = row.get("references", {})
        if about == {name: row.get(name) for name in about} and all(one["episodes"] == episodes for one in known.values()):
            return known
    return {}


def conclude(record: Record, acting: policies.Policy, final_episodes: int, more: dict[str, Any] | None = None) -> dict[str, Any]:
    """Score a policy and the references, write them with ``more``, draw the learning curve and a film.

    Returns what the policy's file says of its score.
    """
    folder, config = record.folder, record.config
    names = ["noop", "random", "expert"] + ["careless"] * (config["env"] == "ClothStrain-v0")
    scores = known_references(config, min(final_episodes, REFERENCE_EPISODES))
    for name in [*([] if scores else names), str(folder)]:
        act = acting if name == str(folder) else policies.named(name, config["env"], scoring.HELD_OUT)
        number = final_episodes if name == str(folder) else min(final_episodes, REFERENCE_EPISODES)
        seeds = list(range(scoring.HELD_OUT, scoring.HELD_OUT + number))
        try:
            episodes = scoring.run_episodes(config["env"], act, seeds, **config["env_kwargs"])
            scores[name] = scoring.score(episodes)
        except NotImplementedError as missing:  # with these arguments the task has no scripted expert
            print(missing)
    identity = {"env": config["env"], "env_kwargs": config["env_kwargs"]}
    print(f"held-out episodes\n{suite.table([identity | {'policy': name} | row for name, row in scores.items()])}")
    own = scores.pop(str(folder)) | {"env": config["env"], "env_kwargs": config["env_kwargs"], "learner": config["algo"]}
    own |= {"seed": config["seed"], "references": scores} | account_of(record) | (more or {})
    files.write(folder / EVALUATION, json.dumps(own, indent=1, default=float) + "\n")
    levels = {name: scores[name]["success_rate"] for name in ("noop", "expert") if name in scores}
    draw_learning_curve(folder, record.lines, levels)
    film(folder / "policy.gif", config["env"], acting, config["env_kwargs"])
    minutes = record.times()["training_seconds"] / 60
    print(f"trained for {minutes:.1f} minutes; see {folder}/learning_curve.png and {folder}/policy.gif")
    # the file contains its scores
    said = ("success_rate", "safe_success_rate", "normalized_performance", "episodes")
    return {name: own[name] for name in said if name in own} | {"first_successes": int(episodes["is_success"][:FIRST].sum())}

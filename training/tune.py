"""Search PPO's hyperparameters with Optuna, for the best policy after so many steps; what was found is printed as YAML.

    python training/tune.py --env ClothReach-v0 --timesteps 130000 --trials 40      # runs/tuning/ClothReach-v0.log
    python training/tune.py --env ClothReach-v0 --timesteps 130000 --show           # the best of a study, and its plot

The study is Optuna's journal, a file of JSON lines: a search that is stopped and called again goes on with its finished trials, and
the committed hyperparameters are its first one.  A trial is scored on episodes that neither training nor final scores use; the best
of many trials has had luck, so train what was found with other seeds before you believe it.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import train
import tyro
import yaml
from endings import refused, stopped
from scoring import HELD_OUT, run_episodes

VALIDATION = HELD_OUT + 2_000_000  # first seed of the episodes by which trials are compared


@dataclass
class Args:
    """What to tune, and for how long."""

    env: str = "ClothReach-v0"
    """Id of the environment."""
    timesteps: int = 130_000
    """Environment steps of each trial."""
    trials: int = 40
    """Finished trials that the study is to have."""
    episodes: int = 300
    """Episodes by which a trial is scored."""
    seeds: int = 2
    """Runs of each trial, of different seeds, whose mean is its score."""
    study: Path | None = None
    """The study's journal; runs/tuning/ENV.log by default."""
    show: bool = False
    """Only show what the study has found."""

    def __post_init__(self) -> None:
        for name in ("timesteps", "trials", "episodes", "seeds"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)}: must be at least 1")
        # the committed configuration, which checks the id and the steps
        self.config = train.Args(env=self.env, timesteps=self.timesteps, run=Path("runs") / "tuning").config
        self.journal = self.study or Path("runs") / "tuning" / f"{self.config['env']}.log"
        if self.show and not self.journal.is_file():
            raise ValueError(f"{self.journal}: there is no such study: call without --show first")


def proposed(trial: Any, committed: dict[str, Any]) -> dict[str, Any]:
    """A configuration with the numbers that a trial proposes."""
    num_envs = trial.suggest_categorical("n_envs", [16, 32, 64, 128])
    steps, batches = trial.suggest_categorical("n_steps", [10, 20, 40]), trial.suggest_categorical("minibatches", [1, 2, 4, 8])
    hyperparameters = committed["hyperparameters"] | {
        "n_steps": steps,
        "batch_size": num_envs * steps // batches,
        "n_epochs": trial.suggest_int("n_epochs", 3, 12),
        "learning_rate": f"lin_{trial.suggest_float('learning_rate', 3e-4, 6e-3, log=True):.3g}",
        "gamma": trial.suggest_categorical("gamma", [0.9, 0.95, 0.97, 0.99]),
        "gae_lambda": trial.suggest_categorical("gae_lambda", [0.8, 0.9, 0.95, 0.98]),
        "clip_range": trial.suggest_categorical("clip_range", [0.1, 0.2, 0.3]),
    }
    std = trial.suggest_float("log_std_init", -2.5, -0.5)
    hyperparameters["policy_kwargs"] = committed["hyperparameters"]["policy_kwargs"] | {"log_std_init": round(std, 2)}
    return committed | {"num_envs": num_envs, "hyperparameters": hyperparameters}


def starting_point(committed: dict[str, Any]) -> dict[str, Any]:
    """The committed numbers, as ``proposed`` asks for them."""
    own, num_envs = committed["hyperparameters"], committed["num_envs"]
    rate = own["learning_rate"]
    return {
        "n_envs": num_envs,
        "minibatches": num_envs * own["n_steps"] // own["batch_size"],
        "learning_rate": float(rate.partition("_")[2]) if isinstance(rate, str) else rate,
        "log_std_init": own["policy_kwargs"]["log_std_init"],
        "clip_range": own.get("clip_range", 0.2),
    } | {name: own[name] for name in ("n_steps", "n_epochs", "gamma", "gae_lambda")}


def score(config: dict[str, Any], seed: int, episodes: int) -> tuple[float, float]:
    """Success after training, and the processor's seconds that training took."""
    import torch
    from learners import build
    from learning import acting_of, training_seed

    with tempfile.TemporaryDirectory() as folder:
        model = build(Path(folder), config | {"seed": seed}, training_seed(seed, 0, config["num_envs"]), 0)
        torch.set_num_threads(1)
        begun = time.process_time()
        model.learn(config["timesteps"])
        taken = time.process_time() - begun
    seeds = list(range(VALIDATION, VALIDATION + episodes))
    found = run_episodes(config["env"], acting_of(model), seeds, progress=False, **config["env_kwargs"])
    return float(found["is_success"].mean()), taken


def as_yaml(config: dict[str, Any]) -> str:
    """A configuration as a file of hyperparameters has it."""
    first = {"n_envs": config["num_envs"], "n_timesteps": config["timesteps"], "policy": config["hyperparameters"]["policy"]}
    return yaml.safe_dump({config["env"]: first | config["hyperparameters"]}, sort_keys=False)


def draw(study: Any, path: Path) -> None:
    """Scores of the trials over the order in which they were made, and the best so far."""
    import matplotlib.pyplot as plt

    done = [trial for trial in study.trials if trial.value is not None]
    numbers, values = [trial.number for trial in done], [trial.value for trial in done]
    best = [max(values[: i + 1]) for i in range(len(values))]
    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    axes.plot(numbers, values, "o", color="0.55", label="trial")
    axes.step(numbers, best, where="post", color="C0", label="best so far")
    axes.axhline(values[0], color="C3", linestyle=":", label="committed before")
    axes.set(xlabel="trial", ylabel="success", ylim=(-0.02, 1.02))
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(args: Args) -> None:
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState

    args.journal.parent.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = JournalStorage(JournalFileBackend(str(args.journal)))
    study = optuna.create_study(study_name=args.config["env"], storage=storage, direction="maximize", load_if_exists=True)
    if not study.trials:
        study.enqueue_trial(starting_point(args.config))

    def objective(trial: Any) -> float:
        config = proposed(trial, args.config)
        scores = [score(config, seed, args.episodes) for seed in range(args.seeds)]
        success, seconds = (sum(column) / args.seeds for column in zip(*scores))
        trial.set_user_attr("core_seconds", round(seconds, 1))
        print(f"trial {trial.number}: success {success:.3f}, {seconds:.0f} s of one core, {trial.params}", flush=True)
        return success

    # the sampler goes on where its finished trials are, with other random numbers
    finished = len(study.get_trials(states=(TrialState.COMPLETE,)))
    study.sampler = optuna.samplers.TPESampler(seed=finished, multivariate=True)
    if not args.show and finished < args.trials:
        study.optimize(objective, n_trials=args.trials - finished)
    best = study.best_trial
    print(f"of {len(study.trials)} trials number {best.number} is best: success {best.value:.3f} after {args.timesteps:,} steps")
    print(as_yaml(proposed(optuna.trial.FixedTrial(best.params), args.config)))
    draw(study, args.journal.with_suffix(".png"))


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: f": the study {given.journal} goes on with the same command"), refused():
        main(given)

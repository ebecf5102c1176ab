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

from clothgym.folders import expand_paths

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
        expand_paths(self)
        for name in ("timesteps", "trials", "episodes", "seeds"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)}: must be at least 1")
        # the committed configuration, which checks the id and the steps; trials are short, and have no curriculum
        self.config = train.Args(env=self.env, timesteps=self.timesteps, run=Path("runs") / "tuning").config | {"curriculum": {}}
        self.journal = self.study or Path("runs") / "tuning" / f"{self.config['env']}.log"
        if self.journal.suffix == ".png":
            raise ValueError(f"--study {self.journal}: this is where its plot goes: give another suffix, .log for instance")
        if self.show and not self.journal.is_file():
            raise ValueError(f"{self.journal}: there is no such study: call without --show first")


def proposed(trial: Any, committed: dict[str, Any]) -> dict[str, Any]:
    """A configuration with the numbers that a trial proposes: the usual ones, and the committed ones."""
    first = starting_point(committed)

    def one_of(name: str, *usual: float) -> Any:
        return trial.suggest_categorical(name, sorted({*usual, first[name]}))

    num_envs, steps, batches = one_of("n_envs", 16, 32, 64, 128), one_of("n_steps", 10, 20, 40), one_of("minibatches", 1, 2, 4, 8)
    hyperparameters = committed["hyperparameters"] | {
        "n_steps": steps,
        "batch_size": num_envs * steps // batches,
        "n_epochs": trial.suggest_int("n_epochs", 3, 12),
        "learning_rate": f"lin_{trial.suggest_float('learning_rate', 3e-4, 6e-3, log=True):.3g}",
        "gamma": one_of("gamma", 0.9, 0.95, 0.97, 0.99),
        "gae_lambda": one_of("gae_lambda", 0.8, 0.9, 0.95, 0.98),
        "clip_range": one_of("clip_range", 0.1, 0.2, 0.3),
    }
    std = trial.suggest_float("log_std_init", -2.5, -0.5)
    hyperparameters["policy_kwargs"] = committed["hyperparameters"]["policy_kwargs"] | {"log_std_init": round(std, 2)}
    return committed | {"num_envs": num_envs, "hyperparameters": hyperparameters}


def starting_point(committed: dict[str, Any]) -> dict[str, Any]:
    """The committed numbers, as ``proposed`` asks for them."""
    own, num_envs = committed["hyperparameters"], committed["num_envs"]
    return {
        "n_envs": num_envs,
        "minibatches": num_envs * own["n_steps"] // own["batch_size"],
        "learning_rate": float(str(own["learning_rate"]).removeprefix("lin_")),
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
        model.env.close()
    seeds = list(range(VALIDATION, VALIDATION + episodes))
    found = run_episodes(config["env"], acting_of(model), seeds, progress=False, **config["env_kwargs"])
    return float(found["is_success"].mean()), taken


def as_yaml(config: dict[str, Any]) -> str:
    """A configuration as a file of hyperparameters has it."""
    first = {"n_envs": config["num_envs"], "n_timesteps": config["timesteps"], "policy": config["hyperparameters"]["policy"]}
    first |= {"env_kwargs": config["env_kwargs"]} if config["env_kwargs"] else {}
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
    for trial in done:
        if "fixed_params" in trial.system_attrs:
            axes.axhline(trial.value, color="C3", linestyle=":", label="committed")
    axes.set(xlabel="trial", ylabel="success", ylim=(-0.02, 1.02))
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def opened(args: Args) -> Any:
    """The study of a journal, new if there is none, with the committed numbers waiting as its first trial.

    Raises:
        ImportError: Optuna is not there.
        ValueError: the file is something else, or its trials are of other steps, episodes or seeds.
    """
    try:
        import optuna
    except ImportError:
        raise ImportError("a search needs Optuna: pip install 'clothgym[tune]'") from None
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    name, settings = args.config["env"], {"timesteps": args.timesteps, "episodes": args.episodes, "seeds": args.seeds}
    args.journal.parent.mkdir(parents=True, exist_ok=True)
    try:
        storage = JournalStorage(JournalFileBackend(str(args.journal)))
        if args.show:
            study = optuna.load_study(study_name=name, storage=storage)
        else:
            study = optuna.create_study(study_name=name, storage=storage, direction="maximize", load_if_exists=True)
    except (ValueError, KeyError, AssertionError):
        raise ValueError(f"{args.journal} is no journal of a study of {name}: name another file with --study") from None
    kept = study.user_attrs.get("settings")
    if kept is None:
        study.set_user_attr("settings", settings)
    elif kept != settings:
        given = " ".join(f"--{option} {value}" for option, value in kept.items())
        raise ValueError(f"the trials of {args.journal} have {given}: give these, or another file with --study")
    if not study.get_trials(states=(TrialState.COMPLETE, TrialState.WAITING)):
        if args.show:
            raise ValueError(f"{args.journal} has no finished trial")
        study.enqueue_trial(starting_point(args.config))
    return study


def main(args: Args) -> None:
    with refused():
        study = opened(args)
    import optuna
    from optuna.trial import TrialState

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
    finished, best = len(study.get_trials(states=(TrialState.COMPLETE,))), study.best_trial
    print(f"of {finished} trials number {best.number} is best: success {best.value:.3f} after {args.timesteps:,} steps")
    print(as_yaml(proposed(optuna.trial.FixedTrial(best.params), args.config)))
    draw(study, args.journal.with_suffix(".png"))


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: f": the study {given.journal} goes on with the same command"):
        main(given)

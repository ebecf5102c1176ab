"""The command line of ``rllib_train.py``, and the configuration of a run that follows from it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import policies
import yaml

import clothgym
from clothgym.folders import expand_paths
from clothgym.registration import checked_id

HERE = Path(__file__).parent
ALGO = "rllib_ppo"
NEEDED = {"n_envs", "n_timesteps", "policy", "n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda",
          "policy_kwargs"}  # fmt: skip


@dataclass
class Args:
    """What to train, for how long, on what, and where to keep it."""

    env: str = "ClothDrape-v0"  # id of the environment
    seed: int = 0  # of the network and of the environments
    timesteps: int | None = None  # environment steps; the hyperparameter file's number by default
    run: Path | None = None  # folder of the run; runs/ENV_rllib_SEED by default
    resume: Path | None = None  # folder of a run to go on with; its configuration is used, on the runners that are given now
    hyperparams: Path = HERE / "hyperparams" / "ppo.yml"  # by environment id, in rl_zoo3's format
    env_kwargs: str = "{}"  # keyword arguments of the environment, as JSON; over those of the hyperparameter file
    address: str = "local"  # of the cluster: HOST:PORT, or auto on one of its machines; local makes one that only this machine sees
    runners: int = 1  # processes that step environments; 0 steps them in the learner's
    envs_per_runner: int | None = None  # environments of each; by default the hyperparameters' n_envs are shared among them
    cpus_per_runner: int = 1  # processors of each, and threads of its environments
    learners: int = 0  # processes that learn, each from its part of a minibatch; 0 learns in this one
    checkpoint_seconds: float = 60.0  # between checkpoints; 0 for one after each iteration
    final_episodes: int = 500  # held-out episodes of the final evaluation
    folder: Path = field(init=False)
    config: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        """Everything is checked here, before what is slow is imported; errors look like those of a wrong flag."""
        expand_paths(self)
        self.env = checked_id(self.env)
        for name, least in {"timesteps": 1, "runners": 0, "envs_per_runner": 1, "cpus_per_runner": 1, "learners": 0,
                            "checkpoint_seconds": 0, "final_episodes": 1}.items():  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise ValueError(f"--{name.replace('_', '-')} {value}: must be at least {least}")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed {self.seed}: must be from 0 to 2^32 - 1")
        try:
            self.folder, self.config = self.new_run() if self.resume is None else self.resumed_run(self.resume)
        except OSError as error:
            raise ValueError(str(error)) from error
        if self.timesteps is not None:
            self.config["timesteps"] = self.timesteps
        if self.envs_per_runner is not None:
            self.config["num_envs"] = self.envs_per_runner * max(self.runners, 1)
        for name, shared in (("runners", self.config["num_envs"]), ("learners", self.config["hyperparameters"]["batch_size"])):
            if shared % max(getattr(self, name), 1):
                what = "environments" if name == "runners" else "samples of a minibatch"
                raise ValueError(f"--{name} {getattr(self, name)}: does not divide the {shared} {what}; take another number")

    def resumed_run(self, folder: Path) -> tuple[Path, dict[str, Any]]:
        """Folder and configuration of the run to go on with."""
        config = policies.read_config(folder, begun=False)
        if config["algo"] != ALGO:
            raise ValueError(f"--resume {folder}: it is of {config['algo']}, not of this script: go on with train.py --resume")
        if self.run is not None:
            raise ValueError("--resume goes on in the run's own folder: drop --run")
        policies.same_as(config, self, "env", "seed")
        policies.own_only(self, "hyperparams", "env_kwargs")
        return folder, config

    def new_run(self) -> tuple[Path, dict[str, Any]]:
        """Folder and configuration of a new one."""
        row = policies.hyperparameters_of(self.hyperparams, self.env)
        own = row.pop("env_kwargs", {})
        if set(row) != NEEDED or row["policy"] != "MlpPolicy" or set(row["policy_kwargs"]) != {"log_std_init", "net_arch"}:
            needed = f"{', '.join(sorted(NEEDED))}, an MlpPolicy of log_std_init and net_arch"
            raise ValueError(f"{self.hyperparams}: of {self.env!r} this script takes {needed}, and nothing else")
        if not re.fullmatch(r"(lin_)?(\d*\.)?\d+(e-\d+)?", str(row["learning_rate"])):
            raise ValueError(f"{self.hyperparams}: learning_rate {row['learning_rate']!r}: must be a number, or lin_NUMBER")
        folder = self.run or Path("runs") / f"{self.env.rpartition(':')[2]}_rllib_{self.seed}"
        if policies.has_checkpoint(folder):
            raise ValueError(f"{folder} holds a run already: go on with --resume {folder}, or choose another folder with --run")
        first = yaml.safe_load((HERE / "hyperparams" / "curricula.yml").read_text())["ppo"].get(self.env, {})
        return folder, {
            "clothgym": clothgym.__version__,
            "env": self.env,
            "algo": ALGO,
            "clone": {},
            "curriculum": first if self.hyperparams == Args.hyperparams else {},
            "env_kwargs": own | policies.parsed_kwargs(self.env_kwargs),
            "num_envs": row.pop("n_envs"),
            "timesteps": int(row.pop("n_timesteps")),
            "seed": self.seed,
            "threads": 1,
            "hyperparameters": row,
        }

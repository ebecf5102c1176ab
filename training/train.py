"""Train a policy, by PPO unless another learner is named, evaluate it on held-out seeds, and leave a folder that tells the story.

    python training/train.py --env ClothDrape-v0                    # runs/ClothDrape-v0_0
    python training/train.py --env ClothReach-v0 --seed 1 --timesteps 500000
    python training/train.py --env ClothStrain-v0 --algo ppo_lagrange   # runs/ClothStrain-v0_ppo_lagrange_0
    python training/train.py --env ClothDrapeGripper-v0 --algo bc_ppo   # runs/ClothDrapeGripper-v0_bc_ppo_0
    python training/train.py --resume runs/ClothDrape-v0_0          # go on after an interruption; a finished run is scored again

The folder holds: config.json, checkpoint.pt, one a minute, and checkpoint_before.pt, which hold tensors only, model.zip
(Stable-Baselines3's own format, for ``PPO.load``), progress.jsonl (one held-out evaluation a line), policy.npz (the last policy,
for ``clothgym.policies.read``), evaluation.json (its score), learning_curve.png, policy.gif, and the TensorBoard log.
Hyperparameters are read from hyperparams/ALGO.yml, in the format of rl_zoo3.
"""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import policies
import tyro
import yaml
from endings import going_on, refused, stopped

import clothgym
from clothgym import files
from clothgym.folders import expand_paths
from clothgym.registration import checked_id

HERE = Path(__file__).parent
# what these parts of the hyperparameters must have
PARTS = {
    "clone": ("episodes", "noise", "epochs", "batch_size", "learning_rate"),
    "curriculum": ("n_timesteps", "env_kwargs"),
    "demonstrations": ("episodes", "noise"),
}


@dataclass
class Args:
    """What to train, for how long, and where to keep it."""

    env: str = "ClothDrape-v0"
    """Id of the environment."""
    seed: int = 0
    """Seed of the learner and of its environments."""
    algo: Literal["ppo", "ppo_penalty", "ppo_lagrange", "bc", "bc_ppo", "sac", "her"] = "ppo"
    """PPO; with a fixed price, or a Lagrange multiplier, on cost; behavior cloning, alone or before PPO; SAC, or SAC
    with hindsight (HER) on a task of goals."""
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
    evaluations: int = 6
    """Evaluations on the way."""
    eval_episodes: int = 200
    """Held-out episodes of each of them."""
    final_episodes: int = 500
    """Held-out episodes of the final evaluation."""
    threads: int = 1
    """Threads of torch while it learns; two gain little on nets as small as these, and wait for each other on a busy machine."""
    folder: Path = field(init=False)
    config: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        """Check all arguments before slow imports; errors look like those of a wrong flag."""
        expand_paths(self)
        self.env = checked_id(self.env)
        for name in ("timesteps", "evaluations", "eval_episodes", "final_episodes", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')} {value}: must be at least 1")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed {self.seed}: must be from 0 to 2^32 - 1")
        try:
            self.folder, self.config = self.new_run() if self.resume is None else self.resumed_run(self.resume)
        except OSError as error:
            raise ValueError(str(error)) from error

    def resumed_run(self, folder: Path) -> tuple[Path, dict[str, Any]]:
        """Folder and configuration of the run to go on with."""
        config = policies.read_config(folder, begun=False)
        if self.run is not None:
            raise ValueError("--resume goes on in the run's own folder: drop --run")
        policies.same_as(config, self, "env", "seed", "algo", "threads")
        policies.own_only(self, "hyperparams", "env_kwargs")
        if self.timesteps is not None:
            config["timesteps"] = self.timesteps
        return folder, config

    def new_run(self) -> tuple[Path, dict[str, Any]]:
        """Folder and configuration of a new one."""
        path = self.hyperparams or HERE / "hyperparams" / f"{self.algo}.yml"
        hyperparameters = policies.hyperparameters_of(path, self.env, ": give a file with --hyperparams")
        needed = ("n_envs", "n_timesteps", "policy", "train_freq" if self.algo in policies.OFF_POLICY else "n_steps")
        missing = [key for key in needed if key not in hyperparameters]
        for part, keys in PARTS.items():
            if part in hyperparameters and not isinstance(hyperparameters[part], dict):
                raise ValueError(f"{path}: {part} of {self.env!r} must have {', '.join(keys)}")
            missing += [f"{part}'s {key}" for key in keys if part in hyperparameters and key not in hyperparameters[part]]
        if missing:
            raise ValueError(f"{path} lacks {', '.join(missing)} for {self.env!r}")
        config = {
            "clothgym": clothgym.__version__,
            "env": self.env,
            "algo": self.algo,
            "clone": hyperparameters.pop("clone", {}),
            "demonstrations": hyperparameters.pop("demonstrations", {}),
            "curriculum": hyperparameters.pop("curriculum") if "curriculum" in hyperparameters else self.curriculum(),
            "env_kwargs": hyperparameters.pop("env_kwargs", {}) | policies.parsed_kwargs(self.env_kwargs),
            "num_envs": hyperparameters.pop("n_envs"),
            "timesteps": self.timesteps if self.timesteps is not None else int(hyperparameters["n_timesteps"]),
            "seed": self.seed,
            "threads": self.threads,
            "hyperparameters": {key: value for key, value in hyperparameters.items() if key != "n_timesteps"},
            "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
        }
        policies.check_curriculum(self.env, config["curriculum"])
        bare = self.env.rpartition(":")[2]
        name = bare if self.algo == "ppo" else f"{bare}_{self.algo}"
        folder = self.run or Path("runs") / f"{name}_{self.seed}"
        first = config["curriculum"].get("n_timesteps", 0)
        if first >= config["timesteps"] > 0:
            print(f"all {config['timesteps']:,} steps are of the curriculum's first part, which has {first:,}", file=sys.stderr)
        if policies.has_checkpoint(folder):
            raise ValueError(f"{folder} holds a run already: go on with --resume {folder}, or choose another folder with --run")
        return folder, config

    def curriculum(self) -> dict[str, Any]:
        """What a run with our own hyperparameters begins with, if anything; a file of one's own says that itself, or is told."""
        table = yaml.safe_load((HERE / "hyperparams" / "curricula.yml").read_text())
        ours = dict(table.get(self.algo, {}).get(self.env, {}))
        if self.hyperparams is None or not ours:
            return ours
        part = f"curriculum: {{n_timesteps: {ours['n_timesteps']}, env_kwargs: {json.dumps(ours['env_kwargs'])}}}"
        print(f"{self.hyperparams} has no curriculum for {self.env}; to begin as ours does, add  {part}", file=sys.stderr)
        return {}


def main(args: Args) -> None:
    from learning import learner, train  # imported here: torch takes seconds, after all checks of arguments

    folder, config = args.folder, args.config
    with refused():
        model, state = learner(folder, config, args.resume is not None)
    # a run that goes on may have been given other steps
    folder.mkdir(parents=True, exist_ok=True)
    files.write_json(folder / policies.CONFIG, config)
    train(folder, config, model, state, args.eval_episodes, args.evaluations, args.final_episodes)


if __name__ == "__main__":
    np.seterr(all="ignore")
    given = tyro.cli(Args)
    with stopped(lambda: going_on("train.py", given.folder)):
        main(given)

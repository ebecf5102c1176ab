"""Behavior cloning from a recorded set: a network gives the actions of the next steps at once, a chunk (Zhao et al. 2023, ACT).

    python training/record.py --env ClothFold-v0 --episodes 200 --noise 0.2 --failed drop --out data/fold
    python training/clone_set.py --data data/fold --run runs/fold_clone
    python training/evaluate.py --env ClothFold-v0 --policy runs/fold_clone/policy.npz --episodes 500

A multilayer perceptron is fitted by least squares, and scored on held-out episodes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import formats
import numpy as np
import recordings
import torch
import tyro
from clone import fit
from endings import refused
from numpy.typing import NDArray
from scoring import HELD_OUT, run_episodes, score

from clothgym import files
from clothgym.adapters.runs import POLICY, exported
from clothgym.folders import expand_paths
from clothgym.lab.bench import machine
from clothgym.policies import Policy


@dataclass
class Args:
    """What to clone, and how."""

    data: Path
    """Folder of a set of training/record.py, with state vectors as observations."""
    run: Path = Path("runs/clone_set")
    """Folder for policy.npz and evaluation.json."""
    chunk: int = 8
    """Actions that the network gives at once."""
    execute: int = 4
    """How many of them are executed before it is asked again."""
    layers: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers."""
    epochs: int = 60
    """Passes over the set."""
    batch_size: int = 256
    """Samples of a gradient."""
    learning_rate: float = 1e-3
    """First rate of Adam, which falls to a fiftieth."""
    seed: int = 0
    """Seed of the network and of the batches."""
    episodes: int = 500
    """Held-out episodes that score it."""

    def __post_init__(self) -> None:
        expand_paths(self)
        for name in ("chunk", "execute", "epochs", "batch_size", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} {getattr(self, name)}: must be at least 1")
        if self.execute > self.chunk:
            raise ValueError(f"--execute {self.execute}: must be at most --chunk {self.chunk}")


def samples(episode: dict[str, NDArray], chunk: int, settling: slice | None) -> tuple[NDArray, NDArray, NDArray]:
    """Observations, (samples, numbers), actions from there on, (samples, chunk, numbers), and which of these there are.

    settling: where the state vector says that the sheet settles, when actions have no effect.
    """
    seen, actions = episode["environment_state"], episode["actions"]
    acting = len(seen) if settling is None else int((seen[:, settling].ravel() == 0).sum())
    steps = np.arange(acting)[:, None] + np.arange(chunk)
    return seen[:acting], actions[np.minimum(steps, acting - 1)], steps < acting


def clone_set(args: Args, about: dict[str, Any]) -> tuple[Policy, float]:
    """The policy, and its mean squared error on the last samples."""
    place = about["observation_slices"].get("settling")
    settling = None if place is None else slice(*place)
    episodes = formats.named(about["format"]).read(args.data, about)
    parts = zip(*(samples(episode, args.chunk, settling) for episode in episodes))
    seen, actions, there = (torch.as_tensor(np.concatenate(part)) for part in parts)
    torch.manual_seed(args.seed)
    widths = [seen.shape[1], *args.layers, args.chunk * actions.shape[2]]
    layers = [torch.nn.Linear(one, other) for one, other in pairwise(widths)]
    network = torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.Tanh())))

    def error(batch: torch.Tensor) -> torch.Tensor:
        differences = network(seen[batch]).reshape(len(batch), args.chunk, -1) - actions[batch]
        return (differences**2)[there[batch]].mean()

    left = fit([network], error, len(seen), args.epochs, args.batch_size, args.learning_rate, args.seed)
    own = {"env": about["env"], "env_kwargs": about["env_kwargs"] | {"obs_mode": about["obs_mode"]}, "learner": "behavior cloning"}
    own |= {"data": about["name"], "samples": len(seen), "seed": args.seed, "chunk": args.chunk, "execute": args.execute}
    weights = [(layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in layers]
    return Policy(weights, squashed=True, keys=about["observation_keys"], about=own), left


def main(args: Args) -> None:
    torch.set_num_threads(1)
    with refused():
        about = recordings.read_about(args.data)
        if about["obs_mode"] not in ("keypoints", "particles"):
            raise ValueError(f"--data {args.data}: has observations {about['obs_mode']!r}; record one with --obs-mode keypoints")
        policy, left = clone_set(args, about)
    args.run.mkdir(parents=True, exist_ok=True)
    policy.save(args.run / POLICY)
    print(f"cloned {policy.about['samples']:,} samples of {args.data}: mean squared error {left:.4f}", flush=True)
    seeds = [HELD_OUT + k for k in range(args.episodes)]
    row = score(run_episodes(about["env"], exported(args.run / POLICY), seeds, **policy.about["env_kwargs"]))
    row |= policy.about | {"machine": machine()}
    files.write(args.run / "evaluation.json", json.dumps(row, indent=1, default=float) + "\n")
    low, high = row["success_rate_ci95"]
    print(f"{about['env']}: success {row['success_rate']:.3f} ({low:.3f} to {high:.3f}) in {args.episodes} held-out episodes")


if __name__ == "__main__":
    main(tyro.cli(Args))

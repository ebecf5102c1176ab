"""The recipe of training/sac_single_file.py in other learners: SAC of Stable-Baselines3, and CrossQ and TQC of sb3-contrib.

    pip install sb3-contrib
    python benchmarks/off_policy.py             # what results/off_policy.json lacks, and the table

All take the recipe's batch, action repeat, updates, discount, entropy, learning rate and reward scale, and normalize observations.
CrossQ (Bhatt et al., "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and Simplicity",
2024) has no target nets, and critics twice as wide.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from cases import Case, Row, fill, parsed, table
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from clothgym.adapters.sb3 import make_sb3_vec_env

sys.path.insert(0, str(Path(__file__).parent.parent / "training"))

RESULT = Path(__file__).parent / "results" / "off_policy.json"
TASKS = ("ClothReach-v0", "ClothFold-v0")
LEARNERS = ("SAC", "CrossQ", "TQC")
EPISODES = 200  # held out
ABOUT = {"scene": "one seed, one thread; minutes of CPU time, beside other work"}


class Scaled(VecEnvWrapper):
    """Rewards times a factor."""

    def __init__(self, inner: Any, factor: float) -> None:
        super().__init__(inner)
        self.factor = factor

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, self.factor * rewards, dones, infos


def recipe(env: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of sac_single_file.py for a task, and its environments' arguments."""
    import policies
    from sac_single_file import ALGO, Options

    row = policies.hyperparameters_of(Path(policies.__file__).parent / "hyperparams" / f"{ALGO}.yml", env)
    kwargs = row.pop("env_kwargs")
    return vars(Options(**row)), kwargs


def learner(name: str, env: Any, options: dict[str, Any]) -> Any:
    """A learner of SB3 or sb3-contrib with these options.

    Raises:
        ImportError: sb3-contrib is not installed.
    """
    rate, wide = options["learning_rate"], list(options["net_arch"])
    common = {
        "learning_rate": lambda left: rate * max(left, 0.05), "batch_size": options["batch_size"], "gamma": options["gamma"],
        "buffer_size": options["buffer_size"], "gradient_steps": options["updates"], "seed": 0, "device": "cpu",
        "learning_starts": options["random_decisions"], "ent_coef": f"auto_{options['first_alpha']}",
        "target_entropy": options["target_entropy"] * env.action_space.shape[0],
    }  # fmt: skip
    if name == "SAC":
        return SAC("MlpPolicy", env, tau=options["tau"], policy_kwargs={"net_arch": wide}, **common)
    import sb3_contrib

    if name == "TQC":
        return sb3_contrib.TQC("MlpPolicy", env, tau=options["tau"], policy_kwargs={"net_arch": wide}, **common)
    nets = {"net_arch": {"pi": wide, "qf": [2 * size for size in wide]}}
    return sb3_contrib.CrossQ("MlpPolicy", env, policy_delay=options["policy_delay"], policy_kwargs=nets, **common)


def measure(env: str, name: str) -> Row:
    """Train one learner, and score its mean action on held-out episodes."""
    from scoring import HELD_OUT, run_episodes, score

    torch.set_num_threads(1)
    options, kwargs = recipe(env)
    inner = make_sb3_vec_env(env, options["n_envs"], seed=0, **kwargs)
    envs = VecNormalize(Scaled(inner, options["reward_scale"]), norm_reward=False)
    model = learner(name, envs, options)
    begun = time.process_time()
    model.learn(options["timesteps"] // kwargs["action_repeat"])
    minutes = (time.process_time() - begun) / 60

    def act(_: Any, observations: Any) -> Any:
        return model.predict(envs.normalize_obs(observations), deterministic=True)[0]

    row = score(run_episodes(env, act, list(range(HELD_OUT, HELD_OUT + EPISODES)), **kwargs))
    return {"success": row["success_rate"], "performance": row["normalized_performance"], "minutes": minutes}


def main() -> None:
    args = parsed(__doc__)
    cases: dict[str, list[Case]] = {"learners": [(measure, {"env": env, "name": name}) for env in TASKS for name in LEARNERS]}
    results = fill(RESULT, cases, args.select, args.fresh, ABOUT)
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results["learners"]))


if __name__ == "__main__":
    main()

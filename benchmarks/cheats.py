"""What does not pay: ways to score without doing the task, in each environment.

    python benchmarks/cheats.py            # prints, and writes benchmarks/results/cheats.json; half an hour of one core
    python benchmarks/cheats.py --env ClothFold-v0 ClothFold-Hard-v0       # these anew, and the others as they were

never: do nothing. hold: the scripted expert, but it never lets go. apart: pull the attachments apart as fast as they go. away:
push the sheet against the arena's wall. shake: full speed to and fro, to pump a reward for change. Where the sheet has to be taken
first, the expert does that.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray

from clothgym import files
from clothgym.lab.bench import machine
from clothgym.lab.digests import digest_of
from clothgym.registration import ENVIRONMENTS, checked_id

Cheat = Callable[[Any, int, NDArray], NDArray]
RESULTS = Path(__file__).parent / "results" / "cheats.json"
EPISODES, SEED = 100, 1_000_000


def moves(env: Any, velocity: NDArray) -> NDArray:
    """An action that moves each attachment at a velocity, (attachments, 3), and keeps hold."""
    task = env.unwrapped.task
    each = np.full((env.num_envs, task.num_attachments, task.actions_per_attachment), -1.0)
    each[:, :, :3] = velocity
    return each.reshape(env.num_envs, -1)


class Taken:
    """Which attachments have held cloth in their episodes, (num_envs, attachments): grippers must take it first."""

    def __init__(self, env: Any) -> None:
        self.grippers = env.unwrapped.task.simulation.grippers
        self.ever = np.full((env.num_envs, env.unwrapped.task.num_attachments), not len(self.grippers))

    def look(self) -> NDArray:
        if len(self.grippers):
            self.ever |= self.grippers.held > 0
        return self.ever


def never(env: Any, step: int, taken: NDArray) -> NDArray:
    return np.zeros(env.action_space.shape)


def hold(env: Any, step: int, taken: NDArray) -> NDArray:
    task = env.unwrapped.task
    actions = task.expert_actions().reshape(env.num_envs, task.num_attachments, task.actions_per_attachment).copy()
    if task.actions_per_attachment == 4:
        # a gripper must open first to take anything
        actions[:, :, 3] = np.where(taken, -1.0, actions[:, :, 3])
    return actions.reshape(env.num_envs, -1)


def apart(env: Any, step: int, taken: NDArray) -> NDArray:
    task = env.unwrapped.task
    attachments = task.simulation.attachment_positions
    away = attachments - attachments.mean(axis=1, keepdims=True) if task.num_attachments > 1 else attachments
    return moves(env, away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-9))


def away(env: Any, step: int, taken: NDArray) -> NDArray:
    return moves(env, np.array([0.0, -1.0, 0.0]))


def shake(env: Any, step: int, taken: NDArray) -> NDArray:
    return moves(env, np.array([0.0, 0.0, 1.0 if step % 10 < 5 else -1.0]))


CHEATS: tuple[Cheat, ...] = (never, hold, apart, away, shake)


def with_the_sheet(env: Any, step: int, taken: NDArray, cheat: Cheat) -> NDArray:
    """Where there is something to take hold of, the expert does that first."""
    actions = cheat(env, step, taken)
    if cheat is never or taken.all():
        return actions
    return np.where(taken.all(axis=1)[:, None], actions, env.unwrapped.task.expert_actions())


def score(env_id: str, cheat: Cheat) -> dict[str, Any]:
    env = gym.make_vec(f"clothgym:{env_id}", num_envs=EPISODES, autoreset_mode="Disabled")
    env.reset(seed=SEED)
    running, total, step, last, taken = np.ones(EPISODES, bool), np.zeros(EPISODES), 0, {}, Taken(env)
    while running.any():
        _, reward, terminated, _, info = env.step(np.clip(with_the_sheet(env, step, taken.look(), cheat), -1, 1))
        total += reward * running
        for key in ("is_success", "normalized_performance", "failure", "episode_cost"):
            if key in info:
                last[key] = np.where(running, info[key], last.get(key, info[key]))
        running &= ~terminated
        step += 1
    row = {"env": env_id, "env_kwargs": {}, "cheat": cheat.__name__, "digest": digest_of(env_id, {})}
    row |= {"success": float(last["is_success"].mean()), "performance": float(last["normalized_performance"].mean())}
    row |= {"return": float(total.mean()), "failed": float((last["failure"] != 0).mean())}
    if "episode_cost" in last:
        row["cost"] = float(last["episode_cost"].mean())
    return row


def main(env: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()) -> None:
    """Score every cheat, in all environments or in those that are named."""
    rows = files.read_json(RESULTS, "list of cheats", "remove it to begin anew")["rows"] if RESULTS.exists() else []
    for env_id in [checked_id(one) for one in env] or ENVIRONMENTS:
        found = []
        for cheat in CHEATS:
            found.append(score(env_id, cheat))
            print("  ".join(f"{key} {value:.3f}" if isinstance(value, float) else str(value) for key, value in found[-1].items()))
        # keep finished rows if the run is interrupted
        rows = [row for row in rows if row["env"] != env_id] + found
        rows.sort(key=lambda row: list(ENVIRONMENTS).index(row["env"]))
        files.write_json(RESULTS, {"machine": machine(), "episodes": EPISODES, "seed": SEED, "rows": rows})


if __name__ == "__main__":
    tyro.cli(main)

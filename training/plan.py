"""Plan with the cross-entropy method (CEM) on the true simulator: a vector environment is the model.

    python training/plan.py --env ClothReach-v0 --episodes 20 --json runs/suite.json
    python training/plan.py --env ClothDrape-v0 --from-expert --horizon 0 --execute 0 --repeat 4      # one plan for a whole episode

In each held-out episode the state is branched into a batch.  Each of the batch follows one sequence of actions, the best ones
(elites) are what the next are drawn around, and the best of all is executed, of which the first actions, before it is planned anew.
The row goes to the same file as those of ``evaluate.py --suite``.  A plan is executed as predicted, bit for bit: steps
with another reward are counted, ``mispredicted``.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
import numpy as np
import policies
import suite
import tyro
from endings import refused, stopped
from numpy.typing import NDArray
from scoring import HELD_OUT, score
from tqdm import tqdm

from clothgym.folders import expand_paths
from clothgym.registration import checked_id

NARROWEST = 0.05  # least standard deviation of an action that is drawn
SETTINGS = (
    "population", "elites", "iterations", "horizon", "execute", "repeat", "spread", "warm_start", "from_expert", "model_steps",
)  # fmt: skip


@dataclass
class Args:
    """What to plan in, and how hard."""

    env: str = "ClothReach-v0"
    """Id of the environment."""
    episodes: int = 20
    """Episodes."""
    seed: int = HELD_OUT
    """Seed of the first episode."""
    population: int = 64
    """Sequences of actions that are tried at once: environments of the model."""
    elites: int = 8
    """The best of them, around which the next are drawn."""
    iterations: int = 4
    """How often they are drawn for a plan."""
    horizon: int = 10
    """Actions of a plan; 0: to the end of the episode, evaluation included."""
    execute: int = 1
    """Actions of a plan that are executed before it is planned anew; 0: all of them."""
    repeat: int = 2
    """Control steps for which each action is repeated."""
    spread: float = 0.5
    """Standard deviation of the actions that are drawn first."""
    warm_start: bool = True
    """Whether a plan starts from the rest of the previous one."""
    from_expert: bool = False
    """Whether it starts from the scripted expert's actions instead of no action."""
    model_steps: int | None = None
    """Environment steps that may be simulated for an episode; then what was planned is followed, and nothing or the expert."""
    env_kwargs: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"action_mode": "pick_place"}'."""
    threads: int | None = None
    """Threads of the model, which change no score; all processors by default."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """File of a suite's scores to put the row into, after each episode; it goes on with those that are there."""

    film: Path | None = None
    """Film of the first four episodes that this call plans, a .gif or .mp4."""

    def __post_init__(self) -> None:
        """Everything is checked here, before numba is loaded; errors look like those of a wrong flag."""
        expand_paths(self)
        self.env = checked_id(self.env)
        least = {"episodes": 1, "seed": 0, "population": 2, "elites": 1, "iterations": 1, "horizon": 0, "execute": 0, "repeat": 1}
        for name, low in (least | {"threads": 1, "model_steps": 1}).items():
            if (value := getattr(self, name)) is not None and value < low:
                raise ValueError(f"--{name.replace('_', '-')} {value}: must be at least {low}")
        if self.elites > self.population:
            raise ValueError(f"--elites {self.elites}: must be at most the population, {self.population}")
        if self.horizon and self.execute > self.horizon:
            raise ValueError(f"--execute {self.execute}: must be at most the horizon, {self.horizon}")
        if not 0 < self.spread <= 10:
            raise ValueError(f"--spread {self.spread}: must be in (0, 10]")
        for name, path in (("json", self.json), ("film", self.film)):
            if path is not None and path.is_dir():
                raise ValueError(f"--{name} {path}: is a folder, name a file in it")
        policies.parsed_kwargs(self.env_kwargs)


class Plan(NamedTuple):
    """Actions, (any, numbers), and the reward that is predicted of each step while they last, (any,)."""

    actions: NDArray
    rewards: NDArray


class Planner:
    """CEM on copies of an environment.

    Args:
        args: how hard to plan.
        env: the environment that is planned for, a batch of one with ``autoreset_mode="Disabled"``.
        env_kwargs: its keyword arguments, those of the model too.

    Attributes:
        model: the batch in which sequences of actions are tried.
        spent: environment steps simulated for the present episode.
        taken: actions executed in it, one a step.
    """

    def __init__(self, args: Args, env: Any, **env_kwargs: Any) -> None:
        self.args, self.env = args, env.unwrapped
        if args.threads is not None:
            env_kwargs["threads"] = args.threads
        made = gym.make_vec(args.env, num_envs=args.population, autoreset_mode="Disabled", **env_kwargs)
        self.model = made.unwrapped
        self.shape = self.env.single_action_space.shape
        self.spent = 0
        self.taken: list[NDArray] = []

    def horizon(self) -> int:
        """Actions of a plan from now on: as many as asked for, but none after the time to act is up."""
        task = self.env.task
        left = -(-(task.acting_steps - int(task.episode["step"][0])) // (self.args.repeat * self.steps_per_action()))
        return min(left, self.args.horizon or left)

    def affords(self) -> bool:
        """Whether the whole population may be tried once more."""
        task, limit = self.env.task, self.args.model_steps
        rest = 0 if self.args.horizon else -(-task.settling_steps // self.steps_per_action())
        return limit is None or self.spent + self.args.population * (self.horizon() * self.args.repeat + rest) <= limit

    def steps_per_action(self) -> int:
        """Control steps of one call of ``step``: more than one for macro actions."""
        return self.env.task.control_steps

    def plan(self, before: NDArray, rng: np.random.Generator) -> Plan:
        """The best sequence of actions found from the present state.

        before: actions that were planned already from now on, (any, numbers).
        """
        args, state = self.args, self.env.get_state()
        mean, length = self.first_guess(before, state), self.horizon()
        spread = np.full_like(mean, args.spread)
        copies, best, highest = state.branch(args.population), Plan(mean, np.zeros(0)), -np.inf
        for _ in range(args.iterations):
            if not self.affords():
                break
            tried = np.clip(mean + spread * rng.standard_normal((args.population, length, *self.shape)), -1, 1)
            # the mean itself is one of them, so no plan is worse than its start
            tried[0] = mean
            tried = tried.astype(np.float32)
            rewards = self.predicted(copies, tried)
            totals = running_sum(rewards)
            order = np.argsort(-totals, kind="stable")[: args.elites]
            if totals[order[0]] > highest:
                highest, best = totals[order[0]], Plan(tried[order[0]], rewards[:, order[0]])
            mean, spread = tried[order].mean(axis=0), np.maximum(tried[order].std(axis=0), NARROWEST)
        return best

    def first_guess(self, before: NDArray, state: Any) -> NDArray:
        """Start of a plan, (horizon, numbers): the rest of the previous one, then the expert's actions, or zeros."""
        length = self.horizon()
        guess = np.zeros((length, *self.shape), np.float32)
        known = min(len(before), length)
        guess[:known] = before[:known]
        if self.args.from_expert and known < length:
            # the environment itself is the model of one; it is put back as it was
            for i in range(length):
                if i >= known:
                    guess[i] = np.clip(self.env.expert_actions()[0], -1, 1)
                for _ in range(self.args.repeat):
                    self.env.step(guess[i : i + 1])
                    self.spent += 1
            self.env.set_state(state)
        return guess

    def predicted(self, copies: Any, tried: NDArray) -> NDArray:
        """Rewards of sequences, (control steps, population); tried: (population, horizon, numbers).

        With ``horizon=0`` the episodes are followed to their ends.
        """
        model, rewards = self.model, []
        model.set_state(copies)
        still = np.zeros_like(tried[:, 0])
        while not model.task.episode["over"].all():
            index = len(rewards) // self.args.repeat
            if index >= tried.shape[1] and self.args.horizon:
                break
            reward = model.step(tried[:, index] if index < tried.shape[1] else still)[1]
            rewards.append(reward)
            self.spent += model.num_envs
        return np.array(rewards).reshape(-1, model.num_envs)


def running_sum(rewards: NDArray) -> NDArray:
    """Sums over the steps, (population,), added one after the other as an episode's return is."""
    total = np.zeros(rewards.shape[1])
    for reward in rewards:
        total += reward
    return total


def episode(planner: Planner, seed: int) -> dict[str, Any]:
    """Plan and act in one episode; returns the info of its last step, and the effort."""
    env, args, begun = planner.env, planner.args, time.perf_counter()
    env.reset(seed=[seed])
    planner.spent, planner.taken = 0, []
    total, length, mispredicted, over, info = 0.0, 0, 0, False, {}
    # the present plan, and the number of its executed actions and steps
    plan, age, followed = Plan(np.zeros((0, *planner.shape), np.float32), np.zeros(0)), 0, 0
    bar = tqdm(total=env.task.acting_steps + env.task.settling_steps, unit="step", desc=f"seed {seed}", leave=False, disable=None)
    while not over:
        acting = int(env.task.episode["settling_since"][0]) < 0 and planner.horizon() > 0
        left = plan.actions[age:]
        if acting and (not len(left) or age >= (args.execute or len(plan.actions))) and planner.affords():
            begin = left if args.warm_start else left[:0]
            plan = planner.plan(begin, np.random.default_rng([seed, length]))
            age = followed = 0
        if age < len(plan.actions):
            action = plan.actions[age]
        else:
            wanted = acting and args.from_expert
            action = np.clip(env.expert_actions()[0], -1, 1) if wanted else np.zeros(planner.shape)
        for _ in range(args.repeat):
            planner.taken.append(action.astype(np.float32))
            _, reward, terminated, truncated, info = env.step(planner.taken[-1][None])
            if followed < len(plan.rewards):
                mispredicted += bool(reward[0] != plan.rewards[followed])
            total, length, followed = total + float(reward[0]), length + 1, followed + 1
            over = bool(terminated[0] or truncated[0])
            if over:
                break
        age += 1
        bar.update(int(env.task.episode["step"][0]) - bar.n)
    bar.close()
    last = {key: value[0].item() for key, value in info.items() if not key.startswith("_") and value.ndim == 1}
    result = {"seed": seed, "return": total, "length": length, "model_steps": planner.spent, "mispredicted": mispredicted}
    return last | result | {"seconds": time.perf_counter() - begun}


def summary(row: suite.Row, results: list[dict[str, Any]], digest: str) -> suite.Row:
    """A row of the suite from its episodes, which it keeps."""
    whole = score({name: np.array([one[name] for one in results]) for name in results[0]})
    sums = {name: sum(one[name] for one in results) for name in ("model_steps", "mispredicted", "seconds")}
    return row | whole | sums | {"date": suite.today(), "digest": digest, "by_episode": results}


def draw(path: Path, env_id: str, env_kwargs: dict[str, Any], seed: int, taken: list[list[NDArray]]) -> None:
    """A film of episodes side by side, from their actions."""
    import drawing  # imported here: it draws, and planning does not

    steps = iter(range(max(map(len, taken))))

    def policy(env: Any, observations: Any) -> NDArray:
        step = next(steps, -1)
        return np.stack([actions[min(step, len(actions) - 1)] for actions in taken])

    drawing.film(path, env_id, policy, env_kwargs, episodes=len(taken), seed=seed)
    print(f"film: {path}")


def main(args: Args) -> None:
    from clothgym.lab.digests import digest_of  # imported here: flags are checked before numba is loaded

    kwargs = policies.parsed_kwargs(args.env_kwargs)
    row: suite.Row = {"env": args.env, "policy": "cem from expert" if args.from_expert else "cem", "seed": args.seed}
    row |= {"env_kwargs": kwargs, "settings": {name: value for name, value in asdict(args).items() if name in SETTINGS}}
    row["about"] = f"{args.population} x {args.iterations}, {args.horizon or 'all'} actions of {args.repeat} steps"
    with refused():
        before = suite.found(suite.load(args.json), row)
        env = gym.make_vec(args.env, num_envs=1, autoreset_mode="Disabled", **(kwargs | {"threads": 1}))
        planner = Planner(args, env, **kwargs)
    # episodes of other code are not gone on with
    digest = digest_of(args.env, kwargs)
    results = list(before["by_episode"]) if before is not None and before.get("digest") == digest else []
    if results:
        print(f"{args.env}: {len(results)} episodes are in the file already")
    suite.warm(args.env, policies.noop, kwargs)
    first, taken = args.seed + len(results), []
    for number in range(len(results), args.episodes):
        results.append(episode(planner, args.seed + number))
        one = results[-1]
        taken.append(planner.taken)
        scored = f"score {one['normalized_performance']:.3f}, return {one['return']:.3f}"
        print(f"seed {one['seed']}: {scored}, {one['seconds']:.1f} s", flush=True)
        suite.keep(args.json, summary(row, results, digest))
    if args.film is not None and taken:
        draw(args.film, args.env, kwargs, first, taken[:4])
    if not results:
        return
    whole = summary(row, results, digest)
    print(f"from seed {args.seed}\n{suite.table([whole])}")
    if whole["mispredicted"]:
        print(f"{whole['mispredicted']} steps were not as predicted: the model is not the environment")
    if args.json is not None:
        print(f"written to {args.json}")


if __name__ == "__main__":
    given = tyro.cli(Args)
    kept = f"; the episodes that are finished are in {given.json}, the same command goes on" if given.json else ""
    with stopped(lambda: kept or "; nothing is kept without --json"):
        main(given)

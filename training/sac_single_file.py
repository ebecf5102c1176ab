"""SAC in one file, to be read from top to bottom: from scratch, on a batch of native environments, on a CPU.

    python training/sac_single_file.py --env ClothReach-v0          # runs/ClothReach-v0_sac_scratch_0
    python training/sac_single_file.py --resume runs/ClothReach-v0_sac_scratch_0

Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018), with the temperature of its section 5.  Three changes make
it learn on 32 and more environments at once: several updates go with each step of the batch, critics have layer normalization (Ba
et al. 2016), as in CrossQ's and DroQ's line of work (Hiraoka et al. 2022), and observations are normalized by running statistics.
With more than two ``critics`` targets take the least of two that are drawn at random, and the policy maximizes the mean (REDQ;
Chen et al., "Randomized Ensembled Double Q-Learning: Learning Fast Without a Model", 2021).
Where costs are limited, two more critics learn the cost to come, and a Lagrange multiplier is its price (Ha et al., "Learning to
Walk in the Real World with Minimal Human Effort", 2020).  With ``obs_mode="depth", privileged=True`` the policy sees pictures
and what it ``feels`` beside them, for instance its own grippers, and critics the state alone (Pinto et al., "Asymmetric Actor
Critic for Image-Based Robot Learning", 2018).

The environments step in a thread of their own while the nets are updated from the transitions before.
A run may begin with another task's policy, as far as both see the same (``starts_from``).  Rates depend on counts of steps, not on
time, so the same command again gives the same policy, on any number of cores.

The folder holds what ``train.py`` leaves: config.json, checkpoint.pt, one a minute, with the replay buffer, progress.jsonl,
policy.npz (of states; a policy of pictures is in the checkpoint alone), evaluation.json, learning_curve.png and policy.gif.  A run
that goes on begins new episodes.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import policies
import tyro
from endings import going_on, refused, stopped
from numpy.typing import NDArray
from scoring import HELD_OUT
from tqdm import tqdm

import clothgym
from clothgym import files
from clothgym.registration import checked_id

ALGO = "sac_scratch"
LOG_STD = (-5.0, 2.0)  # range of the logarithm of an action's standard deviation, before the tanh
FOLLOWING = {"observation": "following", "picture": "following_picture"}  # names in the replay buffer
NOISY_EPISODES = 200  # of the final evaluation with noise, at most
LEAST_RATE = 0.05  # share of the learning rate that is left at the end
EPISODES = 200  # training episodes whose mean is shown, and whose mean cost sets the multiplier
KEEPS = ("last", "best")
SPREAD = 1e-4  # added to the variances by which observations are normalized
CRITICS_FIRST = 1_000  # updates of the critics alone, where a run begins with a given policy, which they do not know yet
MOST_EXCESS = 1.0  # of a mean cost over its limit: an untrained policy tears sheets, and is not to learn from it to stand still
# the least and the largest value of each number, and of each entry of net_arch
LIMITS = {
    "timesteps": (1, 10**12), "n_envs": (1, 10**5), "random_decisions": (1, 10**8), "updates": (1, 10**4),
    "policy_delay": (1, 10**4), "batch_size": (1, 10**6), "buffer_size": (1, 10**8), "learning_rate": (0, 1), "gamma": (0, 1),
    "tau": (0, 1), "first_log_std": LOG_STD, "first_alpha": (1e-6, 10), "target_entropy": (-100, 0), "reward_scale": (1e-6, 1e6),
    "least_reward": (-1e6, 0), "bounded_for": (0, 1), "cost_limit": (0, 1e6), "multiplier_rate": (0, 1), "net_arch": (1, 10**4),
    "critics": (2, 100), "seed": (0, 2**32 - 1), "evaluations": (1, 10**4), "eval_episodes": (1, 10**6),
    "final_episodes": (1, 10**6),
}  # fmt: skip


@dataclass
class Options:
    """Hyperparameters.  A flag overrides the environment's value in hyperparams/sac_scratch.yml, and that one the value here."""

    timesteps: int = 200_000  # control steps of all environments, without those in which sheets settle at once
    n_envs: int = 32  # environments in the batch
    random_decisions: int = 3_000  # before the first update
    updates: int = 8  # updates of the critics after each step of the batch
    policy_delay: int = 2  # of these, the policy and the temperature are updated in every such one
    batch_size: int = 256  # transitions in an update
    buffer_size: int = 400_000  # transitions in the replay buffer
    learning_rate: float = 0.001  # of Adam, at the beginning; it decays linearly over the run
    gamma: float = 0.95  # discount of a decision, that is, of action_repeat control steps
    tau: float = 0.01  # share of the critics that their targets take over in an update
    first_log_std: float = -1.5  # logarithm of an action's standard deviation, before the tanh, at the beginning
    first_alpha: float = 0.05  # temperature, the price of entropy, at the beginning
    target_entropy: float = -1.0  # of each number of an action; less means less noise
    reward_scale: float = 10.0  # rewards are a hundredth a step, values of an untrained net about one
    least_reward: float = -1e6  # of a decision: what is lost by a release, or at an episode's end, weighs no more than this
    bounded_for: float = 1.0  # share of the control steps for which least_reward holds
    cost_limit: float | None = None  # the mean cost of an episode that is allowed
    multiplier_rate: float = 0.0005  # of the price of costs, for each unit of cost over the limit, in each step of the batch
    critics: int = 2  # of the reward to come; more than two (REDQ) where decisions are few and updates many
    keeps: str = "last"  # of the policies that were evaluated on the way; "best" where scores differ much between evaluations
    normalize: bool = True  # whether observations are normalized
    sees: tuple[str, ...] = ()  # names of the observations that the nets see, of a state; of all by default
    feels: tuple[str, ...] = ()  # names of the observations that a policy of pictures receives beside them
    starts_from: str = ""  # id of a task with whose committed policy of this script the run begins, or a policy file
    net_arch: tuple[int, ...] = (128, 128)  # sizes of the hidden layers, of the policy net and of the critics


@dataclass
class Args:
    """What to train, for how long, and where to keep it."""

    env: str = "ClothReach-v0"
    """Id of the environment."""
    seed: int = 0
    """Seed of the nets, the noise, the minibatches and the environments."""
    run: Path | None = None
    """Folder of the run; runs/ENV_sac_scratch_SEED by default."""
    resume: Path | None = None
    """Folder of a run to go on with; its configuration is used."""
    env_kwargs: str = "{}"
    """Keyword arguments of the environment, as JSON: '{"action_repeat": 2}'; over those of the hyperparameter file."""
    options: str = "{}"
    """Hyperparameters, as JSON: '{"timesteps": 100000, "gamma": 0.9}'; over those of the hyperparameter file."""
    evaluations: int = 10
    """Evaluations on the way."""
    eval_episodes: int = 50
    """Held-out episodes of each of them."""
    final_episodes: int = 500
    """Held-out episodes of the final evaluation, by the mean action; the first 200 of them also with noise."""
    folder: Path = field(init=False)
    config: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        """Everything is checked here, before torch is imported; errors look like those of a wrong flag."""
        self.env = checked_id(self.env)
        _within_limits("--", {name: getattr(self, name) for name in ("seed", "evaluations", "eval_episodes", "final_episodes")})
        if self.resume is not None:
            self.folder, self.config = self.resume, policies.read_config(self.resume, begun=False)
            policies.same_as(self.config, self, "env", "seed")
            policies.own_only(self, "run", "env_kwargs", "options")
            if self.config["algo"] != ALGO:
                raise ValueError(f"--resume {self.resume}: is a run of {self.config['algo']}, which train.py goes on with")
            return
        path = Path(__file__).parent / "hyperparams" / f"{ALGO}.yml"
        row = policies.hyperparameters_of(path, self.env)
        kwargs = row.pop("env_kwargs", {}) | policies.parsed_kwargs(self.env_kwargs)
        curriculum = row.pop("curriculum", {})
        policies.check_curriculum(self.env, curriculum)
        options = row | policies.parsed_kwargs(self.options, "--options")
        if unknown := set(options) - set(Options.__dataclass_fields__):
            raise ValueError(f"--options: no {', '.join(sorted(unknown))} (there are: {', '.join(Options.__dataclass_fields__)})")
        chosen = asdict(Options(**options))
        _of_their_types(chosen)
        started = {}
        if chosen["starts_from"]:
            if not chosen["sees"] or not chosen["normalize"]:
                raise ValueError("--options: starts_from needs normalized observations, and sees: the names of what carries over")
            policy, digest = first_policy(chosen["starts_from"])
            started = {"started_from": {"env": policy.about["env"], "seed": policy.about.get("seed"), "sha256": digest}}
        free = {"normalize", "sees", "feels", "keeps", "starts_from"} | ({"cost_limit"} if chosen["cost_limit"] is None else set())
        _within_limits("--options: ", {name: value for name, value in chosen.items() if name not in free})
        self.folder = (self.run or Path("runs") / f"{self.env}_{ALGO}_{self.seed}").expanduser()
        if policies.has_checkpoint(self.folder) or (self.folder / policies.CONFIG).exists():
            raise ValueError(f"{self.folder} holds a run already: go on with --resume {self.folder}, or choose another with --run")
        self.config = {
            "clothgym": clothgym.__version__, "env": self.env, "algo": ALGO, "clone": {}, "env_kwargs": kwargs,
            "num_envs": chosen["n_envs"], "timesteps": chosen["timesteps"], "seed": self.seed, "threads": 1,
            "curriculum": curriculum, "hyperparameters": chosen,
        } | started  # fmt: skip


def _of_their_types(chosen: dict[str, Any]) -> None:
    """Refuse options of another type than that of their defaults."""
    for name, value in chosen.items():
        if name in ("sees", "feels"):
            if type(value) not in (list, tuple) or not all(isinstance(one, str) for one in value):
                raise ValueError(f"--options: {name} {value!r}: must be a list of names")
            continue
        if name == "starts_from":
            if not isinstance(value, str):
                raise ValueError(f"--options: starts_from {value!r}: must be an id, or the name of a file")
            continue
        if name == "keeps":
            if value not in KEEPS:
                raise ValueError(f"--options: keeps {value!r}: must be {' or '.join(KEEPS)}")
            continue
        default = Options.__dataclass_fields__[name].default
        kinds, wanted = {
            bool: ({bool}, "true or false"), int: ({int}, "a count"), tuple: ({list, tuple}, "a list of counts"),
        }.get(type(default), ({int, float, type(default)}, "a number"))  # fmt: skip
        counts = value if type(value) in (list, tuple) else ()
        if type(value) not in kinds or {type(one) for one in counts} - {int} or (kinds == {list, tuple} and not counts):
            raise ValueError(f"--options: {name} {value!r}: must be {wanted}")


def _within_limits(prefix: str, numbers: dict[str, Any]) -> None:
    for name, value in numbers.items():
        least, most = LIMITS[name]
        for one in value if isinstance(value, (list, tuple)) else [value]:
            if not (isinstance(one, (int, float)) and least <= one <= most):  # NaN is not, either
                raise ValueError(f"{prefix}{name.replace('_', '-')} {value}: must be from {least} to {most}")


# --- the nets -----------------------------------------------------------------------------------------------------------------


class Agent:
    """A policy, its critics and their slow copies, the targets; and the temperature, which a policy of less entropy lowers.

    critics: of the reward; where costs are limited, two of the cost follow.  multiplier: price of a cost, in scaled rewards.
    """

    def __init__(
        self, observations: int, actions: int, options: Options, pictures: Any = None, felt: NDArray | None = None
    ) -> None:
        """pictures: the space of an observation with a picture; None where the policy sees what critics see.

        felt: places in the observation of the numbers that a policy of pictures receives, too.
        """
        import torch  # imported in functions: it takes seconds, after all checks of arguments
        from torch import nn

        def net(inputs: int, outputs: int, normalized: bool) -> Any:
            layers, sizes = [], (inputs, *options.net_arch)
            for size, following in pairwise(sizes):
                layers += [nn.Linear(size, following), *([nn.LayerNorm(following)] if normalized else []), nn.ReLU()]
            return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))

        self.options, self.target_entropy, self.multiplier = options, options.target_entropy * actions, 0.0
        # the policy's outputs: means, then logarithms of standard deviations
        if pictures is None:
            head = self.policy = net(observations, 2 * actions, normalized=False)
        else:
            from clothgym.adapters.pixels import DepthActor, DepthEncoder

            encoder, numbers = DepthEncoder(pictures), [] if felt is None else felt.tolist()
            head = net(encoder.features_dim + len(numbers), 2 * actions, normalized=False)
            self.policy = DepthActor(encoder, head, numbers)
        nn.init.constant_(head[-1].bias[actions:], options.first_log_std)
        count = options.critics + (0 if options.cost_limit is None else 2)
        self.critics, self.targets = (
            nn.ModuleList(net(observations + actions, 1, normalized=True) for _ in range(count)) for _ in range(2)
        )
        self.targets.load_state_dict(self.critics.state_dict())
        self.log_alpha = torch.tensor(math.log(options.first_alpha), requires_grad=True)
        parts = {"policy": self.policy.parameters(), "critics": self.critics.parameters(), "alpha": [self.log_alpha]}
        self.optimizers = {name: torch.optim.Adam(part, options.learning_rate, fused=True) for name, part in parts.items()}

    def act(self, seen: Any) -> tuple[Any, Any]:
        """Actions drawn from the policy, (batch, numbers), and the logarithms of their probability densities, (batch,).

        ``a = tanh(u)`` with u from a normal distribution; ``log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u))``.
        """
        import torch
        from torch.nn.functional import softplus

        mean, log_std = self.policy(seen).chunk(2, dim=-1)
        log_std = log_std.clamp(*LOG_STD)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi) - 2 * (math.log(2) - u - softplus(-2 * u))
        return torch.tanh(u), density.sum(-1)

    def said(self, critics: Any, observation: Any, action: Any) -> Any:
        """What each critic says of the reward, or cost, to come, (critics, batch)."""
        import torch

        pair = torch.cat([observation, action], dim=-1)
        return torch.stack([critic(pair).squeeze(-1) for critic in critics])

    def values(self, said: Any) -> list[Any]:
        """From what critics say: the reward to come, the least of two or the mean of more, and the cost to come, at most, each
        (batch,)."""
        count = self.options.critics
        rewards, costs = said[:count], said[count:]
        return [rewards.amin(0) if count == 2 else rewards.mean(0), *([costs.amax(0)] if len(costs) else [])]

    def wanted(self, batch: dict[str, Any], alpha: Any) -> list[Any]:
        """What critics should say, each (batch,): what was earned, or what it cost, and what the targets say of what follows, of
        the reward the least of two, which are drawn where there are more; to the reward the worth of entropy is added."""
        import torch

        following, density = self.act(_policy_sees(batch, FOLLOWING["picture"], "following"))
        count, targets = self.options.critics, list(self.targets)
        drawn = [0, 1] if count == 2 else torch.randperm(count)[:2].tolist()
        said = self.said([targets[i] for i in drawn] + targets[count:], batch["following"], following)
        later = self.options.gamma * batch["goes_on"]
        wanted = batch["reward"] + later * (said[:2].amin(0) - alpha * density)
        return [wanted] * count + ([batch["cost"] + later * said[2:].amax(0)] * 2 if len(said) > 2 else [])

    def update(self, batch: dict[str, Any], with_policy: bool) -> None:
        """Learn from a minibatch: observation, action, reward, cost, following observation, and 0 after an episode's end.

        With the pictures of both observations, the policy sees these, and of the states what it feels.
        """
        import torch

        alpha = self.log_alpha.detach().exp()
        if with_policy:
            action, log_density = self.act(_policy_sees(batch, "picture", "observation"))
            # the temperature falls while the entropy is above its target, and rises below it
            loss = -(self.log_alpha * (log_density.detach() + self.target_entropy)).mean()
            self._step("alpha", loss, [self.log_alpha])
        # critics: towards what they should say
        with torch.no_grad():
            wanted = self.wanted(batch, alpha)
        said = self.said(self.critics, batch["observation"], batch["action"])
        errors = [0.5 * (one - other).square().mean() for one, other in zip(said, wanted)]
        self._step("critics", sum(errors), list(self.critics.parameters()))
        # the policy: towards actions that the critics value, at the price of their costs, and towards entropy; the division keeps
        # the size of gradients
        if with_policy:
            values = self.values(self.said(self.critics, batch["observation"], action))
            value = values[0] if len(values) == 1 else (values[0] - self.multiplier * values[1]) / (1 + self.multiplier)
            self._step("policy", (alpha * log_density - value).mean(), list(self.policy.parameters()))
        with torch.no_grad():
            for target, one in zip(self.targets.parameters(), self.critics.parameters()):
                target.lerp_(one, self.options.tau)

    def _step(self, name: str, loss: Any, parameters: list[Any]) -> None:
        """Descend; only the gradients of these parameters are computed."""
        import torch

        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters)):
            parameter.grad = gradient
        self.optimizers[name].step()

    def set_rate(self, rate: float) -> None:
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = rate

    def exported(self, about: dict[str, Any], keys: tuple[str, ...], normalizer: Normalizer) -> Any:
        """The mean action as a policy that needs no torch."""
        from clothgym.policies import Policy

        linear = [(one.weight.detach().numpy().T, one.bias.detach().numpy()) for one in self.policy[::2]]
        weight, bias = linear[-1]
        linear[-1] = weight[:, : weight.shape[1] // 2], bias[: len(bias) // 2]
        return Policy(linear, "relu", squashed=True, keys=keys, about=about, normalization=normalizer.numbers())


def _policy_sees(batch: dict[str, Any], picture: str, state: str) -> Any:
    """The state, or pictures and states where the batch has pictures."""
    return (batch[picture], batch[state]) if picture in batch else batch[state]


# --- experience ---------------------------------------------------------------------------------------------------------------


class Normalizer:
    """Running mean and variance of all observations so far (Chan et al. 1979).

    seen: 1 for each number of an observation that the nets see, and 0 for the others, whose normalized value is 0.  fixed: whether
    it stays as it is.
    """

    def __init__(self, size: int, active: bool, seen: NDArray | None = None, fixed: bool = False) -> None:
        self.mean, self.variance, self.count, self.active, self.fixed = np.zeros(size), np.ones(size), 0.0, active, fixed
        self.seen = np.ones(size) if seen is None else seen

    def see(self, observation: NDArray) -> None:
        """observation: (any, numbers)."""
        if self.fixed or not self.active or not len(observation):
            return
        count, away = len(observation), observation.mean(axis=0, dtype=float) - self.mean
        total = self.count + count
        squares = self.variance * self.count + observation.var(axis=0, dtype=float) * count
        self.variance = (squares + away**2 * self.count * count / total) / total
        self.mean, self.count = self.mean + away * count / total, total

    def numbers(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """What is subtracted from observations, and what they are then multiplied by; None where they are left as they are."""
        if not self.active:
            return None
        return self.mean.astype(np.float32), (self.seen / np.sqrt(self.variance + SPREAD)).astype(np.float32)

    def __call__(self, observation: NDArray) -> Any:
        import torch

        from clothgym.policies import normalized

        numbers = self.numbers()
        return torch.as_tensor(observation if numbers is None else normalized(observation, numbers))


class Replay:
    """The last transitions, row after row: arrays (buffer_size, ...); pictures, of a shape, in half precision."""

    def __init__(self, size: int, observations: int, actions: int, picture: tuple[int, ...] | None = None) -> None:
        shapes: dict[str, tuple[int, ...]] = {"observation": (observations,), "action": (actions,), "following": (observations,)}
        shapes |= dict.fromkeys(("reward", "cost", "goes_on"), ())
        self.rows = {name: np.zeros((size, *shape), np.float32) for name, shape in shapes.items()}
        if picture is not None:
            self.rows |= {name: np.zeros((size, *picture), np.float16) for name in ("picture", FOLLOWING["picture"])}
        self.size, self.added = size, 0

    @property
    def filled(self) -> int:
        return min(self.added, self.size)

    def add(self, **transitions: NDArray) -> None:
        """One transition of each environment, the oldest ones make room."""
        places = (self.added + np.arange(len(transitions["reward"]))) % self.size
        for name, rows in self.rows.items():
            rows[places] = transitions[name]
        self.added += len(places)

    def minibatches(self, count: int, size: int, rng: np.random.Generator, normalizer: Normalizer) -> Iterator[dict[str, Any]]:
        """So many, of transitions drawn with replacement, their observations normalized."""
        import torch

        drawn = rng.integers(0, self.filled, count * size)
        parts = {name: rows[drawn] for name, rows in self.rows.items()}
        tensors = {
            name: normalizer(part) if name in ("observation", "following") else torch.as_tensor(part)
            for name, part in parts.items()
        }
        for first in range(0, count * size, size):
            yield {name: tensor[first : first + size] for name, tensor in tensors.items()}


# --- the run ------------------------------------------------------------------------------------------------------------------


def first_policy(name: str) -> tuple[Any, str]:
    """The committed policy of an id, as this script learned it, or that of a file; and the hash of its file.

    Raises:
        ValueError: there is none.
    """
    from clothgym.policies import FOLDER, available, read

    path = Path(name).expanduser()
    if path.suffix != ".npz":
        env_id = checked_id(name)
        if ALGO not in available().get(env_id, []):
            raise ValueError(f"--options: starts_from {name}: no policy of this script is committed for it; name the file of one")
        path = FOLDER / f"{env_id}_{ALGO}.npz"
    try:
        return read(path), hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"--options: starts_from: {error}") from None


class Run:
    """A learner on its batch of environments.

    Attributes:
        done: control steps so far.  updates: of the critics so far.
        easy: whether the environments are those of the curriculum.
        last: each environment's last decision; settling: whether its sheet settles since then.
        collecting: seconds in which environments stepped.
        episodes: success, performance and cost of the last training episodes, which have noise.
        kept: the policy that the run keeps, of those that were evaluated, and its normalization.
    """

    def __init__(self, config: dict[str, Any], state: dict[str, Any] | None) -> None:
        import torch

        if unknown := set(config["hyperparameters"]) - set(Options.__dataclass_fields__):
            raise ValueError(f"{', '.join(sorted(unknown))}: hyperparameters of another version of the script; train again")
        self.config, self.options = config, Options(**config["hyperparameters"])
        self.done = 0 if state is None else int(state["num_timesteps"])
        self.updates = 0 if state is None else int(state["num_updates"])
        # all that is random comes from the seed, and one thread adds in one order: the same command again gives the same bits
        torch.set_num_threads(config["threads"])
        torch.manual_seed(self.seeds()[1])
        self.rng = np.random.default_rng([config["seed"], self.done])
        self.enter()
        numbers, actions = self.now["observation"].shape[1], self.env.single_action_space.shape[0]
        space, picture = (self.env.single_observation_space, self.now["picture"].shape[1:]) if self.pictured else (None, None)
        if self.options.feels and not self.pictured:
            raise ValueError("feels: is for policies of pictures; a policy of states sees what sees names")
        felt = self.named_numbers("feels", numbers)
        if unseen := set(self.options.feels) - set(self.options.sees or self.options.feels):
            raise ValueError(f"feels: {', '.join(sorted(unseen))}: not in sees, which names all that the nets receive")
        self.agent = Agent(numbers, actions, self.options, space, None if felt is None else np.flatnonzero(felt))
        seen = self.named_numbers("sees", numbers)
        self.normalizer = Normalizer(numbers, self.options.normalize, seen, bool(self.options.starts_from))
        self.replay = Replay(self.options.buffer_size, numbers, actions, picture)
        if (size := sum(rows.nbytes for rows in self.replay.rows.values())) > files.LARGEST:
            much = f"{size / 2**30:.1f} GiB, and a checkpoint holds {files.LARGEST / 2**30:.0f}"
            advice = "choose a smaller one in --options, or a smaller image_size in --env-kwargs"
            raise ValueError(f"buffer_size={self.options.buffer_size}: {much}: {advice}")
        self.last = Replay(self.options.n_envs, numbers, actions, picture).rows
        self.kept: dict[str, dict[str, Any]] = {}
        self.thread = ThreadPoolExecutor(1)
        self.collecting = 0.0 if state is None else float(state["times"]["collecting_seconds"])
        if state is not None:
            self.restore(state)
        elif self.options.starts_from:
            policy, digest = first_policy(self.options.starts_from)
            if digest != config["started_from"]["sha256"]:
                raise ValueError(f"starts_from: {self.options.starts_from} has changed since the run began; begin another run")
            self.begin_as(policy)

    def named_numbers(self, option: str, count: int) -> NDArray | None:
        """1 for the numbers of an observation that the option names, 0 for the others; None where it names none.

        Raises:
            ValueError: there is no observation of that name, observations are not normalized, or they have goals.
        """
        if not (names := getattr(self.options, option)):
            return None
        slices, named = self.env.task.observation_slices, np.zeros(count)
        if unknown := set(names) - set(slices):
            raise ValueError(f"{option}: no observation {', '.join(sorted(unknown))} (there are: {', '.join(slices)})")
        if (self.keys and not self.pictured) or not self.options.normalize:
            raise ValueError(f"{option}: is for normalized observations without goals")
        for name in names:
            named[slices[name]] = 1
        return named

    def begin_as(self, policy: Any) -> None:
        """Act as another task's policy does where what the nets see is there too, by name, and the rest as on average there.

        Raises:
            ValueError: it is of other nets or actions, of another kind of observation, or did not see all that these nets see.
        """
        import torch

        about, actions = policy.about, self.env.single_action_space.shape[0]
        sizes, wanted = [weight.shape[1] for weight, _ in policy.layers], [*self.options.net_arch, actions]
        begins = f"starts_from: the policy of {about['env']}"
        if self.keys or policy.keys:
            advice = "a run begins with a policy of plain states, or with none, {'starts_from': ''}"
            raise ValueError(f"{begins} or the run has goals or pictures: {advice}")
        if sizes != wanted or not policy.squashed or policy.normalization is None:
            raise ValueError(f"{begins} has layers of {sizes}, not of {wanted}, or is not of this script")
        for name in ("action_mode", "frame"):
            one, other = (kwargs.get(name) for kwargs in (about["env_kwargs"], self.config["env_kwargs"]))
            if one != other:
                raise ValueError(f"{begins} has {name}={one!r}, the run {other!r}: its actions or observations mean something else")
        source, slices = policy.make().unwrapped.task.observation_slices, self.env.task.observation_slices
        shift, factor = policy.normalization
        for name in self.options.sees:
            if name not in source or not factor[source[name]].all():
                raise ValueError(f"{begins} did not see {name!r}, which the option sees lists")
            if (one := len(factor[source[name]])) != (other := slices[name].stop - slices[name].start):
                raise ValueError(f"{begins} saw {one} numbers of {name!r}, here there are {other}")
        # the means of actions; their noise is new
        for number, (layer, (weight, bias)) in enumerate(zip(self.agent.policy[::2], policy.layers)):
            layer.bias.data[: len(bias)] = torch.tensor(bias)
            for name in self.options.sees if number == 0 else ():
                layer.weight.data[: len(bias), slices[name]] = torch.tensor(weight[source[name]].T)
            if number:
                layer.weight.data[: len(bias)] = torch.tensor(weight.T)
        # observations are normalized as they were there
        for name in self.options.sees:
            self.normalizer.mean[slices[name]] = shift[source[name]]
            self.normalizer.variance[slices[name]] = 1 / factor[source[name]].astype(float) ** 2 - SPREAD

    def seeds(self) -> list[int]:
        """Of the first environment and of torch, others after other numbers of steps."""
        return np.random.SeedSequence([self.config["seed"], self.done]).generate_state(2).tolist()

    def enter(self) -> None:
        """Begin episodes in new environments: those of the curriculum until its steps are done, then the run's own."""
        from clothgym.envs.observing import PICTURES  # imported here: it loads the tasks

        config, curriculum = self.config, self.config["curriculum"]
        self.easy = self.done < curriculum.get("n_timesteps", 0)
        kwargs = config["env_kwargs"] | (curriculum["env_kwargs"] if self.easy else {})
        made = gym.make_vec(config["env"], num_envs=self.options.n_envs, autoreset_mode="SameStep", **kwargs)
        self.env: Any = made.unwrapped
        space = self.env.single_observation_space
        self.keys = tuple(space.keys()) if isinstance(space, gym.spaces.Dict) else ()
        self.pictured = "state" in self.keys
        self.middle = space["observation"].high.max() / 2 if self.pictured else None  # depth of the camera's target [m]
        mode = self.env.task.obs_mode
        if mode in PICTURES and not (self.pictured and mode == "depth"):
            raise ValueError(f"obs_mode={mode!r}: of pictures the script takes obs_mode='depth', with privileged=True")
        # environment i begins with seed + i, below all held-out seeds
        observation, info = self.env.reset(seed=self.seeds()[0] % (HELD_OUT - self.options.n_envs))
        if self.options.cost_limit is not None and "cost" not in info:
            raise ValueError(f"cost_limit={self.options.cost_limit}: {config['env']} has no costs")
        self.now = self.parts(observation)
        self.settling = np.zeros(self.options.n_envs, bool)
        self.episodes: deque[tuple[float, float, float]] = deque(maxlen=EPISODES)

    def parts(self, observation: Any) -> dict[str, NDArray]:
        """An observation as one array, of goals as well; with a picture, the state, and heights above the camera's target.

        They are in half precision, where a depth of 2 m would be as coarse as a layer of cloth.
        """
        if self.pictured:
            heights = self.middle - np.moveaxis(observation["observation"], -1, -3)
            return {"observation": observation["state"], "picture": heights.astype(np.float16)}
        return {"observation": np.concatenate([observation[key] for key in self.keys], axis=-1) if self.keys else observation}

    def seen(self, parts: dict[str, NDArray]) -> Any:
        """What the policy sees of an observation, as a tensor."""
        import torch

        state = self.normalizer(parts["observation"])
        return (torch.as_tensor(parts["picture"]), state) if self.pictured else state

    def steps(self) -> Iterator[int]:
        """A step of the batch and its updates, again and again, until the control steps are done; yields how many were done."""
        options, least = self.options, self.options.random_decisions
        while self.done < self.config["timesteps"]:
            learns = self.replay.added >= least
            action = self.choose(at_random=not learns)
            stepping = self.thread.submit(self.step, action)
            if learns:
                self.agent.set_rate(options.learning_rate * max(1 - self.done / self.config["timesteps"], LEAST_RATE))
                for batch in self.minibatches():
                    self.updates += 1
                    is_turn = self.updates % options.policy_delay == 0
                    self.agent.update(batch, with_policy=is_turn and self.updates > (CRITICS_FIRST if options.starts_from else 0))
            self.keep(action, *stepping.result())
            self.set_multiplier()
            self.done += options.n_envs * self.env.task.control_steps
            yield options.n_envs * self.env.task.control_steps
            if self.easy and self.config["curriculum"]["n_timesteps"] <= self.done < self.config["timesteps"]:
                self.enter()

    def minibatches(self) -> Iterator[dict[str, Any]]:
        """Those of a step of the batch; losses weigh no more than they may, until it is time to learn what they are."""
        options, least = self.options, self.options.reward_scale * self.options.least_reward
        bounded = self.done < options.bounded_for * self.config["timesteps"]
        for batch in self.replay.minibatches(options.updates, options.batch_size, self.rng, self.normalizer):
            yield batch | {"reward": batch["reward"].clamp(min=least)} if bounded else batch

    def set_multiplier(self) -> None:
        """Dual ascent: the price of costs grows while the mean cost of the last training episodes is above its limit."""
        # the first episodes to end are the shortest ones
        if self.options.cost_limit is not None and len(self.episodes) >= self.options.n_envs:
            excess = min(float(np.mean([cost for *_, cost in self.episodes])) - self.options.cost_limit, MOST_EXCESS)
            self.agent.multiplier = max(self.agent.multiplier + self.options.multiplier_rate * excess, 0.0)

    def choose(self, at_random: bool) -> NDArray:
        """A decision of each environment."""
        import torch

        observation = self.now["observation"]
        self.normalizer.see(observation[~self.settling])
        if at_random and not self.options.starts_from:
            return self.rng.uniform(-1, 1, (len(observation), *self.env.single_action_space.shape)).astype(np.float32)
        with torch.no_grad():
            return self.agent.act(self.seen(self.now))[0].numpy()

    def step(self, action: NDArray) -> tuple[Any, ...]:
        """What the environments give for their decisions."""
        begun = time.perf_counter()
        given = self.env.step(action)
        self.collecting += time.perf_counter() - begun
        return given

    def keep(self, action: NDArray, observation: Any, reward: NDArray, terminated: NDArray, truncated: NDArray, info: Any) -> None:
        """Decisions and what followed, into the replay buffer.

        While a sheet settles actions have no effect: what it earns then is of the last decision before, as with
        ``settling="at_once"``, which not every sheet takes.  A torn sheet costs, as discounted here, what one would that costs in
        all steps to come.
        """
        options, before, last, acting = self.options, self.now, self.last, ~self.settling
        self.now = self.parts(observation)
        following = {name: part.copy() for name, part in self.now.items()}
        cost = info.get("cost", np.zeros(len(reward))).copy()
        # in same-step mode an environment that has ended shows the next episode's first observation already
        if (ended := np.flatnonzero(terminated | truncated)).size:
            final = info["final_info"]
            for i in ended:
                for name, part in self.parts(info["final_obs"][i]).items():
                    following[name][i] = part
            cost[ended] = final.get("cost", cost)[ended]
            scores = (final["is_success"], final["normalized_performance"], final.get("episode_cost", np.zeros(len(reward))))
            self.episodes.extend(zip(*(score[ended].tolist() for score in scores)))
        cost = np.minimum(cost, self.env.task.control_steps / (1 - min(options.gamma, 0.999)))
        for name, part in before.items():
            last[name][acting], last[FOLLOWING[name]] = part[acting], following[name]
        last["action"][acting], last["goes_on"] = action[acting], ~terminated
        for name, earned in (("reward", options.reward_scale * reward), ("cost", cost)):
            last[name][acting] = 0
            last[name] += earned
        self.settling = info["settling"]
        self.replay.add(**{name: part[~self.settling] for name, part in last.items()})

    def policy(self, about: dict[str, Any]) -> Any:
        """The mean action as it is now, as a file holds it; None of a policy that sees pictures."""
        config = self.config
        if self.pictured:
            return None
        own = {"env": config["env"], "env_kwargs": config["env_kwargs"], "learner": ALGO, "seed": config["seed"]}
        own |= {name: config[name] for name in ("started_from",) if name in config}
        return self.agent.exported(own | about, self.keys, self.normalizer)

    def acts(self, env: Any, observations: Any) -> NDArray:
        """The mean action."""
        import torch

        with torch.no_grad():
            return torch.tanh(self.agent.policy(self.seen(self.parts(observations))).chunk(2, dim=-1)[0]).numpy()

    def noisy(self, env: Any, observations: Any) -> NDArray:
        """Actions with the noise of the policy."""
        import torch

        with torch.no_grad():
            return self.agent.act(self.seen(self.parts(observations)))[0].numpy()

    def keep_policy(self) -> None:
        """Keep a copy of the policy as it is, with its normalization."""
        import torch

        numbers = {name: torch.tensor(getattr(self.normalizer, name)) for name in ("mean", "variance")}
        self.kept = {"policy": {name: part.clone() for name, part in self.agent.policy.state_dict().items()}, "normalizer": numbers}

    def take_kept(self) -> None:
        """Act as the policy that was kept, from now on."""
        self.agent.policy.load_state_dict(self.kept["policy"])
        for name, numbers in self.kept["normalizer"].items():
            setattr(self.normalizer, name, numbers.numpy())

    def state(self, times: dict[str, float]) -> dict[str, Any]:
        """All that a run needs to go on, but for the episodes."""
        import torch

        agent, normalizer, filled = self.agent, self.normalizer, self.replay.filled
        parts = {name: torch.as_tensor(rows[:filled]) for name, rows in self.replay.rows.items()}
        parts |= {"added": torch.tensor(self.replay.added), "log_alpha": agent.log_alpha.detach()}
        parts |= {name: torch.as_tensor(getattr(normalizer, name)) for name in ("mean", "variance", "count")}
        return {
            "policy": agent.policy.state_dict(),
            "optimizer": {name: one.state_dict() for name, one in agent.optimizers.items()}
            | {"of critics": agent.critics.state_dict(), "of targets": agent.targets.state_dict()},
            "variables": parts, "kept": self.kept, "constraint": {"multiplier": agent.multiplier},
            "num_timesteps": self.done, "num_updates": self.updates, "times": times,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state.

        Raises:
            ValueError: it is of other nets than the configuration describes.
        """
        agent, parts, optimizers = self.agent, dict(state["variables"]), dict(state["optimizer"])
        with files.naming(Path(policies.CHECKPOINT), "checkpoint of the networks in its configuration", "train again"):
            agent.policy.load_state_dict(state["policy"])
            agent.critics.load_state_dict(optimizers.pop("of critics"))
            agent.targets.load_state_dict(optimizers.pop("of targets"))
            for name, one in agent.optimizers.items():
                one.load_state_dict(optimizers[name])
            agent.log_alpha.data, agent.multiplier = parts["log_alpha"], state["constraint"]["multiplier"]
            for name in ("mean", "variance"):
                setattr(self.normalizer, name, parts[name].numpy())
            self.kept = state["kept"]
            self.normalizer.count, self.replay.added = float(parts["count"]), int(parts["added"])
            for name, rows in self.replay.rows.items():
                rows[: self.replay.filled] = parts[name].numpy()


def acting(run: Run, policy: Any) -> policies.Policy:
    """The mean action as evaluations take it: by the exported policy, if there is one."""
    return run.acts if policy is None else lambda env, observations: policy(observations)


def train(args: Args) -> None:
    """Learn, with held-out evaluations on the way, and score what was learned."""
    import learning  # imported here: torch takes seconds, after all checks of arguments
    from scoring import run_episodes, score

    from clothgym.adapters.runs import load_last, save_tensors

    folder, config = args.folder, args.config
    with refused():
        state = load_last(folder) if args.resume is not None and policies.has_checkpoint(folder) else None
        run, record = Run(config, state), learning.Record(folder, config, state)
    folder.mkdir(parents=True, exist_ok=True)
    files.write_json(folder / policies.CONFIG, config)
    every = max(1, config["timesteps"] // args.evaluations)
    with tqdm(total=config["timesteps"], initial=run.done, unit="step", unit_scale=True, disable=None) as bar:
        record.clock.start()
        for count in run.steps():
            bar.update(count)
            if run.episodes:
                shown = "success {:.2f}, performance {:.2f}, cost {:.2f}".format(*np.mean(run.episodes, axis=0))
                bar.set_postfix_str(shown, refresh=False)
            is_last = run.done >= config["timesteps"]
            evaluated = is_last or run.done // every > (run.done - count) // every
            if evaluated or record.is_due():
                record.clock.stop()
                record.collecting = run.collecting
                if evaluated:
                    line = record.note(acting(run, run.policy({})), run.done, args.eval_episodes)
                    tqdm.write(f"{run.done:,} steps: success {line['success_rate']:.3f}, {line['normalized_performance']:.3f}")
                    if record.kept() is line:
                        run.keep_policy()
                save_tensors(folder / policies.CHECKPOINT, run.state(record.times()))
                record.saved = time.perf_counter()
                record.clock.start()
    run.take_kept()
    save_tensors(folder / policies.CHECKPOINT, run.state(record.times()))  # a policy of pictures is in the checkpoint alone
    policy = run.policy(learning.account_of(record))
    seeds = list(range(HELD_OUT, HELD_OUT + min(args.final_episodes, NOISY_EPISODES)))
    noisy = score(run_episodes(config["env"], run.noisy, seeds, **config["env_kwargs"]))
    said = {name: noisy[name] for name in ("episodes", "success_rate", "success_rate_ci95", "normalized_performance")}
    print(f"with noise: success {said['success_rate']:.3f}, performance {said['normalized_performance']:.3f}")
    more = {"with_noise": said} | {name: config[name] for name in ("started_from",) if name in config}
    more |= {"feels": list(run.options.feels)} if run.options.feels else {}
    about = learning.conclude(record, acting(run, policy), args.final_episodes, more)
    if policy is not None:
        policy.about |= about
        policy.save(folder / learning.POLICY)


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: going_on("sac_single_file.py", given.folder)):
        train(given)

"""PPO under a constraint on cost: a Lagrange multiplier, and a separate critic for the cost, on Stable-Baselines3's PPO.

Maximize the return subject to  J <= d,  with the mean cost J of an episode, the sum of its steps' costs, and the limit d.  PPO
climbs along the advantage  (A_r - lambda A_c) / (1 + lambda)  with the advantages A_r of the reward and A_c of the cost (Ray,
Achiam and Amodei 2019, Benchmarking Safe Exploration in Deep Reinforcement Learning, "PPO-Lagrangian").  SB3 normalizes the
combination, not its parts: thus lambda stays the price of a unit of cost in units of the return.

Once a rollout, before the policy moves, a controller sets lambda (Stooke, Achiam and Abbeel 2020, Responsive Safety in
Reinforcement Learning by PID Lagrangian Methods, Algorithm 2, where J' is the mean cost before, at first 0):

    e = J - d        I <- (I + e)_+        lambda <- (K_P e + K_I I + K_D (J - J')_+)_+

With K_P = K_D = 0 this is dual ascent at the rate K_I.

Early in training the policy incurs costs without solving the task, and a multiplier that is large enough to enforce the limit
suppresses all motion.  So the limit may begin at d_0, and be tightened to d geometrically over a share f of the training: at the
share s of it

    d(s) = d_0^(1 - min(s/f, 1)) d^min(s/f, 1)
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.policies import ActorCriticPolicy, BaseModel
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from clothgym.checks import count, not_negative, number, positive, shown

ADVICE = "give what constraint_state() gave, of a learner with the same features and cost_net_arch"


@dataclass
class CostRollout:
    """What SB3's ``RolloutBuffer`` holds of the rewards, of the costs.

    costs, values, dones: of each step an array, (num_envs,); to the cost of a step that a time limit cut off, the discounted value
    of what would have followed is added.  ended: costs of the episodes that ended.  advantages, returns: (steps, num_envs), of
    which the returns are the critic's targets.
    """

    costs: list[NDArray] = field(default_factory=list)
    values: list[NDArray] = field(default_factory=list)
    dones: list[NDArray] = field(default_factory=list)
    ended: list[float] = field(default_factory=list)
    advantages: NDArray = field(default_factory=lambda: np.zeros((0, 0)))
    returns: NDArray = field(default_factory=lambda: np.zeros((0, 0)))

    def finish(self, last_values: NDArray, gamma: float, gae_lambda: float) -> None:
        """Compute advantages and returns; last_values: of the observations after the last step, (num_envs,)."""
        values = np.array(self.values)
        self.advantages = generalized_advantages(np.array(self.costs), values, np.array(self.dones), last_values, gamma, gae_lambda)
        self.returns = self.advantages + values


def generalized_advantages(
    costs: NDArray, values: NDArray, dones: NDArray, last_values: NDArray, gamma: float, gae_lambda: float
) -> NDArray:
    """Generalized advantage estimation (Schulman et al. 2016, equation 16), as SB3 has it for rewards.

    costs, values, dones: (steps, num_envs); the value is that before the step, done says that the episode ended with it.
    last_values: those after the last step, (num_envs,).  Returns (steps, num_envs).
    """
    advantages = np.zeros(values.shape)
    following, advantage = last_values, np.zeros(last_values.shape)
    for step in reversed(range(len(costs))):
        goes_on = 1.0 - dones[step]
        error = costs[step] + gamma * goes_on * following - values[step]
        advantage = error + gamma * gae_lambda * goes_on * advantage
        advantages[step] = advantage
        following = values[step]
    return advantages


class _FinishCosts(BaseCallback):
    """Takes the cost's values after the last step of a rollout, of what its environments show then."""

    model: LagrangianPPO

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model = self.model
        assert model._last_obs is not None
        last_values = model.predict_cost_values(obs_as_tensor(model._last_obs, model.device))
        model.cost_rollout.finish(last_values, model.cost_gamma, model.cost_gae_lambda)


class LagrangianPPO(PPO):
    """``stable_baselines3.PPO`` under a constraint: the mean cost of an episode is to be at most a limit.

    It takes any environment whose ``infos`` have each step's ``"cost"``, and what PPO takes.  The critic of the cost is an MLP on
    the features that the policy's own critic sees.  It trains apart from the policy, and does not move the features.  As long as
    the multiplier is 0, the learner does what PPO does, bit for bit.

    Logs ``constraint/multiplier``, ``constraint/limit``, ``constraint/cost_value_loss``, and ``constraint/cost``, the mean of the
    episodes that ended in the rollout.

    Args:
        policy, env: as of PPO.
        cost_limit: mean cost of an episode that is allowed.
        initial_cost_limit: initial limit, d_0; with None ``cost_limit`` holds from the beginning.
        tightening: share of the training over which the limit falls from there to ``cost_limit``, f.
        multiplier_rate: K_I, rate of the dual ascent, in multiplier per unit of excess cost and rollout.
        kp, kd: K_P and K_D of the PID controller, in multiplier per unit of cost; with 0 there is only dual ascent.
        multiplier_start: the multiplier at first.
        multiplier_most: its upper bound, and that of the integral's part in it.
        excess_clip: an excess J - d counts up to this; an untrained policy's must not freeze it before it has learned to move.
        cost_gamma: discount factor of the cost.
        cost_gae_lambda: trade-off of bias and variance in the advantages of the cost.
        cost_learning_rate: of the cost's critic.
        cost_net_arch: widths of its hidden layers.
        kwargs: PPO's own: learning_rate, n_steps, batch_size, ...

    Raises:
        ValueError: an argument out of its range; when it learns, an environment that gives no cost.
        TypeError: an argument that PPO does not know.
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        *,
        # None only while SB3 loads a learner, whose limit then comes from the file
        cost_limit: float | None = None,
        initial_cost_limit: float | None = None,
        tightening: float = 0.5,
        multiplier_rate: float = 0.05,
        kp: float = 0.0,
        kd: float = 0.0,
        multiplier_start: float = 0.0,
        multiplier_most: float = 100.0,
        excess_clip: float = 10.0,
        cost_gamma: float = 0.99,
        cost_gae_lambda: float = 0.95,
        cost_learning_rate: float = 1e-3,
        cost_net_arch: Sequence[int] = (64, 64),
        **kwargs: Any,
    ) -> None:
        self.cost_limit, self.multiplier_rate, self.kp, self.kd = cost_limit, multiplier_rate, kp, kd
        self.initial_cost_limit, self.tightening = initial_cost_limit, tightening
        self.multiplier_start, self.multiplier_most, self.excess_clip = multiplier_start, multiplier_most, excess_clip
        self.cost_gamma, self.cost_gae_lambda = cost_gamma, cost_gae_lambda
        self.cost_learning_rate, self.cost_net_arch = cost_learning_rate, cost_net_arch
        # the controller's memory; the integral is kept as K_I I, so that a change of the rate does not make the multiplier jump
        self.multiplier = self.integral = multiplier_start
        self.last_cost = 0.0
        self.episode_costs: NDArray = np.zeros(0)
        super().__init__(policy, env, **kwargs)

    # --- construction ---------------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        self._check_arguments()
        super()._setup_model()
        # the policy's random numbers must be PPO's
        with torch.random.fork_rng(devices=[]):
            layers = create_mlp(self.policy.features_dim, 1, list(self.cost_net_arch), self.policy.activation_fn)
        self.cost_critic = torch.nn.Sequential(*layers).to(self.device)
        self.cost_optimizer = torch.optim.Adam(self.cost_critic.parameters(), lr=self.cost_learning_rate, eps=1e-5)
        self.cost_rollout = CostRollout()
        # a loaded learner goes on with its episodes, unless it got another number of environments
        if len(self.episode_costs) != self.n_envs:
            self.episode_costs = np.zeros(self.n_envs)

    def _check_arguments(self) -> None:
        """Here, not in the constructor, because ``load`` takes new values for them, too."""
        if self.cost_limit is None:
            raise ValueError("cost_limit is missing: give the mean cost of an episode that is allowed")
        for name in ("cost_limit", "kp", "kd", "multiplier_start"):
            not_negative(name, getattr(self, name))
        for name in ("multiplier_rate", "multiplier_most", "excess_clip", "cost_learning_rate"):
            positive(name, getattr(self, name))
        if not 0 < number("tightening", self.tightening) <= 1:
            raise ValueError(f"tightening={shown(self.tightening)}: must be greater than 0, and at most 1")
        if self.initial_cost_limit is not None:
            positive("initial_cost_limit", self.initial_cost_limit)
            if not 0 < self.cost_limit <= self.initial_cost_limit:
                raise ValueError(
                    f"cost_limit={shown(self.cost_limit)}: must be greater than 0 and at most initial_cost_limit="
                    f"{shown(self.initial_cost_limit)}: the limit is tightened by a factor"
                )
        if self.multiplier_start > self.multiplier_most:
            raise ValueError(
                f"multiplier_start={self.multiplier_start!r}: must be at most multiplier_most={self.multiplier_most!r}"
            )
        for name in ("cost_gamma", "cost_gae_lambda"):
            if not 0 <= number(name, getattr(self, name)) <= 1:
                raise ValueError(f"{name}={shown(getattr(self, name))}: must lie from 0 to 1")
        if isinstance(self.cost_net_arch, str) or not isinstance(self.cost_net_arch, Sequence):
            raise ValueError(f"cost_net_arch={shown(self.cost_net_arch)}: must be a sequence of widths, for instance (64, 64)")
        for width in self.cost_net_arch:
            count("cost_net_arch", width, "a sequence of widths, each ")

    # --- a rollout ------------------------------------------------------------------------------------------------------------

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int) -> bool:
        # discard the rest of a rollout that a callback stopped
        self.cost_rollout = CostRollout()
        # the callbacks of a rollout's end may put other environments in the place of these
        first = CallbackList([_FinishCosts(), callback])
        first.model = first.callbacks[0].model = self
        return super().collect_rollouts(env, first, rollout_buffer, n_rollout_steps)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: NDArray | None = None) -> None:
        """SB3 calls this with each step's infos, while ``_last_obs`` is still what the policy acted on."""
        super()._update_info_buffer(infos, dones)
        assert dones is not None and self._last_obs is not None and self._last_episode_starts is not None
        costs = _costs(infos)
        self.episode_costs = np.where(self._last_episode_starts, 0.0, self.episode_costs) + costs
        rollout = self.cost_rollout
        rollout.ended += self.episode_costs[dones.astype(bool)].tolist()
        # a time limit is no end of the task: the value of what would have followed stands for it, as SB3 has it for rewards
        for env in np.flatnonzero(dones):
            last = infos[env].get("terminal_observation")
            if last is not None and infos[env].get("TimeLimit.truncated", False):
                costs[env] += self.cost_gamma * self.predict_cost_values(self.policy.obs_to_tensor(last)[0])[0]
        rollout.costs.append(costs)
        rollout.values.append(self.predict_cost_values(obs_as_tensor(self._last_obs, self.device)))
        rollout.dones.append(dones.astype(float))

    def predict_cost_values(self, observations: PyTorchObs) -> NDArray:
        """The discounted cost to come, by the critic; observations: tensors of a batch, (num, ...).  Returns (num,)."""
        with torch.no_grad():
            return self.cost_critic(self._features(observations)).flatten().cpu().numpy().astype(np.float64)

    def _features(self, observations: PyTorchObs) -> torch.Tensor:
        # the class's own, because ActorCriticPolicy's gives both extractors' where they are not shared
        with torch.no_grad():
            return BaseModel.extract_features(self.policy, observations, self.policy.vf_features_extractor)

    # --- learning -------------------------------------------------------------------------------------------------------------

    def train(self) -> None:
        """Set the multiplier, train the policy on the combined advantages, and then the cost's critic."""
        rollout, buffer = self.cost_rollout, self.rollout_buffer
        if rollout.ended:
            mean = float(np.mean(rollout.ended))
            self.update_multiplier(mean)
            self.logger.record("constraint/cost", mean)
        self.logger.record("constraint/limit", self.present_limit())
        self.logger.record("constraint/multiplier", self.multiplier)

        self.policy.set_training_mode(False)
        combined = (buffer.advantages - self.multiplier * rollout.advantages) / (1 + self.multiplier)
        buffer.advantages = combined.astype(np.float32)
        super().train()
        self._train_cost_critic()

    def present_limit(self) -> float:
        """The mean cost of an episode that is allowed now, d(s)."""
        assert self.cost_limit is not None
        if self.initial_cost_limit is None:
            return self.cost_limit
        tightened = min((1 - self._current_progress_remaining) / self.tightening, 1.0)
        return float(self.initial_cost_limit ** (1 - tightened) * self.cost_limit**tightened)

    def update_multiplier(self, cost: float) -> None:
        """Move the multiplier by Algorithm 2 of Stooke et al. (2020); cost: mean of the episodes that ended in a rollout, J.

        The excess is clipped, and the integral is limited with the multiplier (anti-windup): otherwise it would have to unwind
        before the multiplier could fall.
        """
        excess = min(cost - self.present_limit(), self.excess_clip)
        rise = max(cost - self.last_cost, 0.0)
        self.integral = float(np.clip(self.integral + self.multiplier_rate * excess, 0.0, self.multiplier_most))
        self.multiplier = float(np.clip(self.kp * excess + self.integral + self.kd * rise, 0.0, self.multiplier_most))
        self.last_cost = cost

    def _train_cost_critic(self) -> None:
        """Fit the critic to the returns of the cost, with PPO's epochs and batches."""
        self.policy.set_training_mode(False)
        update_learning_rate(self.cost_optimizer, self.cost_learning_rate)
        # the order of the buffer's samples, which PPO has flattened
        targets = torch.as_tensor(RolloutBuffer.swap_and_flatten(self.cost_rollout.returns), dtype=torch.float32).flatten()
        # a generator of its own leaves PPO its random numbers, and needs no memory in a checkpoint
        rng = np.random.default_rng(self._n_updates)
        losses = []
        for _ in range(self.n_epochs):
            for batch in np.array_split(rng.permutation(len(targets)), -(-len(targets) // self.batch_size)):
                features = self._features(self.rollout_buffer._get_samples(batch).observations)
                loss = torch.nn.functional.mse_loss(self.cost_critic(features).flatten(), targets[batch].to(self.device))
                self.cost_optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.cost_critic.parameters(), self.max_grad_norm)
                self.cost_optimizer.step()
                losses.append(loss.item())
        self.logger.record("constraint/cost_value_loss", float(np.mean(losses)))

    # --- checkpoints ----------------------------------------------------------------------------------------------------------

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        modules, variables = super()._get_torch_save_params()
        return [*modules, "cost_critic", "cost_optimizer"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "cost_rollout"]

    def constraint_state(self) -> dict[str, Any]:
        """State for a checkpoint in addition to PPO's: copies of tensors and plain numbers, for ``torch.load(weights_only=True)``.

        It does not include the costs of unfinished episodes: a run that resumes from a checkpoint resets its environments.
        """
        return {
            "multiplier": float(self.multiplier),
            "integral": float(self.integral),
            "last_cost": float(self.last_cost),
            "cost_critic": copy.deepcopy(self.cost_critic.state_dict()),
            "cost_optimizer": copy.deepcopy(self.cost_optimizer.state_dict()),
        }

    def set_constraint_state(self, state: dict[str, Any]) -> None:
        """Go on from what ``constraint_state`` gave.

        Raises:
            ValueError: it is something else, or of another network; the learner is as it was.
        """
        if not isinstance(state, dict) or state.keys() != self.constraint_state().keys():
            raise ValueError(f"state={shown(state)}: {ADVICE}")
        multiplier, integral = (not_negative(f"the state's {name}", state[name]) for name in ("multiplier", "integral"))
        last_cost = number("the state's last_cost", state["last_cost"])
        if _shapes(state["cost_critic"]) != _shapes(self.cost_critic.state_dict()):
            raise ValueError(f"the state's cost_critic is of another network: {ADVICE}")
        try:
            # it looks at the sizes before it changes anything; a copy, or learners of the same state would share their momenta
            self.cost_optimizer.load_state_dict(copy.deepcopy(state["cost_optimizer"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the state's cost_optimizer is of another network: {ADVICE}") from error
        self.cost_critic.load_state_dict(state["cost_critic"])
        self.multiplier, self.integral, self.last_cost = multiplier, integral, last_cost


def _costs(infos: list[dict[str, Any]]) -> NDArray:
    """The costs of a step, (num_envs,)."""
    for env, info in enumerate(infos):
        if "cost" not in info:
            raise ValueError(
                f"infos[{env}] has no 'cost': take an environment that gives each step's cost, such as ClothStrain-v0, or wrap it"
            )
        number(f"infos[{env}]['cost']", info["cost"])
    return np.array([float(info["cost"]) for info in infos])


def _shapes(tensors: Any) -> dict[str, Any]:
    """Shapes of a network's tensors, by name; empty for other objects."""
    return {name: getattr(tensor, "shape", None) for name, tensor in tensors.items()} if isinstance(tensors, dict) else {}

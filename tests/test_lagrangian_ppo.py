"""PPO under a constraint, on problems whose constrained optimum and multiplier are known in closed form."""

import io

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from clothgym.adapters.lagrange import LagrangianPPO, generalized_advantages
from clothgym.adapters.sb3 import make_sb3_vec_env

BEST = np.array([0.5, 1.0, 1.0])  # actions of the largest return, step by step
NOISE = 0.1  # standard deviation of the policy, held fixed
START, LAST = np.eye(3, dtype=np.float32), np.full(3, 0.5, np.float32)  # what is observed before each step, and after the last


class Steps(VecEnv):
    """Episodes of three steps, each with reward 2 b a - a^2 and cost a^2, where b is ``BEST``.

    dict_observations: whether the step is observed within a Dict.  cut_off: environments whose episodes a time limit ends.
    cost: another one, of the action; None for an environment that gives none.  Steps cost what ``costs`` says, (num_envs,) each.
    """

    render_mode = None

    def __init__(self, num_envs, dict_observations=False, cut_off=(), cost=np.square):
        step = gym.spaces.Box(0, 1, (3,))
        self.dict_observations, self.cut_off, self.cost, self.costs = dict_observations, cut_off, cost, []
        space = gym.spaces.Dict({"nothing": gym.spaces.Discrete(2), "step": step}) if dict_observations else step
        super().__init__(num_envs, space, gym.spaces.Box(-2, 2, (1,)))

    def observed(self, step):
        """What is observed, (..., 3), as the space has it."""
        return {"nothing": np.zeros(step.shape[:-1], np.int64), "step": step} if self.dict_observations else step

    def reset(self):
        self.step_index = np.arange(self.num_envs) % 3  # so that episodes do not end together
        return self.observed(START[self.step_index])

    def step_async(self, actions):
        self.actions = actions[:, 0].astype(float)

    def step_wait(self):
        rewards = 2 * BEST[self.step_index] * self.actions - self.actions**2
        done = self.step_index == 2
        infos = [{} if self.cost is None else {"cost": self.cost(action)} for action in self.actions]
        self.costs.append([info.get("cost") for info in infos])
        for env in np.flatnonzero(done):
            infos[env] |= {"terminal_observation": self.observed(LAST), "TimeLimit.truncated": env in self.cut_off}
        self.step_index = np.where(done, 0, self.step_index + 1)
        return self.observed(START[self.step_index]), rewards.astype(np.float32), done, infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def learner(env=None, algorithm=LagrangianPPO, noise=NOISE, **kwargs):
    """A small one, whose rollout is one of its batches."""
    env = Steps(64) if env is None else env
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    options = {"n_steps": 3, "n_epochs": 4, "gamma": 1.0, "seed": 0, "device": "cpu"} | kwargs
    options["policy_kwargs"] = {"net_arch": [16], "log_std_init": float(np.log(noise))}
    if algorithm is LagrangianPPO:
        options = {"cost_limit": 0.5, "cost_gamma": 1.0, "cost_net_arch": (16,)} | options
    model = algorithm(policy, env, batch_size=options["n_steps"] * env.num_envs, **options)
    model.policy.log_std.requires_grad_(False)
    model.set_logger(Logger(None, []))
    return model


def learn(model, rollouts, **kwargs):
    return model.learn(rollouts * model.n_steps * model.n_envs, log_interval=None, **kwargs)


def mean_actions(model):
    """Of the policy, before each step, (3,)."""
    return model.predict(model.env.observed(START), deterministic=True)[0][:, 0]


def falling(left):
    """A learning rate that ends with small steps."""
    return 8e-3 * left + 1e-5


def same(one, other):
    """Whether nested states are equal, bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


# --- problems with a known answer -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("controller", "dict_observations"),
    [({"multiplier_rate": 0.2}, False), ({"multiplier_rate": 0.2, "kp": 0.5, "kd": 0.5}, True)],
    ids=["dual ascent", "PID, Dict"],
)
def test_it_finds_the_constrained_optimum_and_the_multiplier_of_the_problem(controller, dict_observations):
    """With mean actions m the return is sum(2 b m - m^2), the cost sum(m^2), each less or more a constant of the noise.

    Where 2 b - 2 m = lambda 2 m, that is m = b / (1 + lambda), the Lagrangian is stationary; the cost is
    sum(b^2) / (1 + lambda)^2 + 3 noise^2, which meets the limit below with lambda = 1.
    """
    limit = np.sum(BEST**2) / 4 + 3 * NOISE**2
    model = learner(Steps(64, dict_observations), cost_limit=limit, learning_rate=falling, cost_learning_rate=5e-3, **controller)
    multipliers = []
    learn(model, 100, callback=lambda *_: multipliers.append(model.multiplier) or True)
    assert np.mean(multipliers[-60:]) == pytest.approx(1, abs=0.05)
    assert mean_actions(model) == pytest.approx(BEST / 2, abs=0.04)
    assert np.mean(np.sum(model.env.costs[-60:], axis=0)) / 20 == pytest.approx(limit, rel=0.05)
    # the cost to come, of which noise^2 falls to each step
    to_come = np.cumsum((BEST / 2)[::-1] ** 2 + NOISE**2)[::-1]
    observations, _ = model.policy.obs_to_tensor(model.env.observed(START))
    assert model.predict_cost_values(observations) == pytest.approx(to_come, abs=0.05)


def test_with_a_loose_limit_it_is_ppo_bit_for_bit_and_finds_the_best_actions():
    model = learn(learner(cost_limit=5.0, learning_rate=falling), 60)
    assert model.multiplier == 0 and model.integral == 0
    assert mean_actions(model) == pytest.approx(BEST, abs=0.05)
    ppo = learn(learner(algorithm=PPO, learning_rate=falling), 60)
    assert same(dict(model.policy.state_dict()), dict(ppo.policy.state_dict()))


# --- advantages -----------------------------------------------------------------------------------------------------------


def test_advantages_of_the_cost_against_numbers_computed_by_hand():
    # two environments, discount 1/2 and lambda 1/2; the first's episode ends with the second step
    costs, values = np.array([[1.0, 2.0], [3.0, 0.0], [0.0, 4.0]]), np.array([[2.0, 1.0], [1.0, 2.0], [4.0, 0.0]])
    dones, last_values = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), np.array([6.0, 2.0])
    # errors: 1 + 1/2 - 2, 3 - 1, 0 + 3 - 4;  2 + 1 - 1, 0 + 0 - 2, 4 + 1 - 0
    expected = [[-0.5 + 2 / 4, 2 - 0.75 / 4], [2.0, -2 + 5 / 4], [-1.0, 5.0]]
    assert generalized_advantages(costs, values, dones, last_values, 0.5, 0.5) == pytest.approx(np.array(expected))


@pytest.mark.parametrize("dict_observations", [False, True])
def test_an_end_is_an_end_a_time_limit_is_none_and_the_policy_learns_from_both_advantages(dict_observations):
    env = Steps(2, dict_observations, cut_off=(1,), cost=lambda action: 1.0)
    model = learner(env, multiplier_start=3.0, multiplier_rate=1e-9, cost_gamma=0.5, cost_gae_lambda=0.5, cost_net_arch=())
    with torch.no_grad():
        # 1, 2 and 3 before the three steps, and 3 after the last
        model.cost_critic[0].weight[:] = torch.tensor([0.0, 0.0, 1.0, 2.0, 3.0][-model.policy.features_dim :])
        model.cost_critic[0].bias[:] = 0
    learn(model, 1)
    # from the first step to the end:            errors  1 + 1 - 1,  1 + 3/2 - 2,  1 - 3
    # from the second to the time limit, and on: errors  1 + 3/2 - 2,  1 + 3/2 - 3,  1 + 1 - 1
    expected = np.array([[1.0 + 0 / 4, 0.5 - 2 / 4, -2.0], [0.5 - 0.5 / 4, -0.5, 1.0]]).T
    assert model.cost_rollout.advantages == pytest.approx(expected, abs=1e-6)
    values = np.array([[1.0, 2, 3], [2, 3, 1]]).T
    assert model.cost_rollout.returns == pytest.approx(expected + values, abs=1e-6)
    # PPO has flattened its buffer, environment by environment, and left the returns of the reward as they were
    buffer = model.rollout_buffer
    reward = (buffer.returns - buffer.values).flatten()
    assert buffer.advantages.flatten() == pytest.approx((reward - 3 * expected.T.flatten()) / 4, abs=1e-5)


# --- the multiplier -------------------------------------------------------------------------------------------------------


def test_the_multiplier_of_the_pid_controller_against_numbers_computed_by_hand():
    model = learner(cost_limit=2.0, multiplier_rate=0.1, kp=0.5, kd=0.25, multiplier_most=3.0, excess_clip=4.0)
    # mean cost, K_P e, K_I I, K_D (J - J')_+
    for cost, proportional, integral, derivative in [
        (3.0, 0.5, 0.1, 0.75),  # the cost before the first is 0
        (0.5, -0.75, 0.0, 0.0),  # a fall of the cost counts for nothing, and the integral of 0.1 - 0.15 neither
        (4.0, 1.0, 0.2, 0.875),
        (3.5, 0.75, 0.35, 0.0),
        (20.0, 2.0, 0.75, 4.125),  # an excess of 18 counts as 4
        (1.5, -0.25, 0.7, 0.0),
    ]:
        model.update_multiplier(cost)
        assert model.integral == pytest.approx(integral) and model.last_cost == cost
        assert model.multiplier == pytest.approx(min(max(proportional + integral + derivative, 0), 3))


def test_dual_ascent_starts_where_it_is_told_and_turns_at_its_bound():
    model = learner(cost_limit=2.0, multiplier_rate=1.0, multiplier_start=0.5, multiplier_most=15.0, excess_clip=10.0)
    seen = [model.multiplier]
    for cost in (4.0, 100.0, 100.0, 1.0, 0.0):
        model.update_multiplier(cost)
        seen.append(model.multiplier)
    assert seen == [0.5, 2.5, 12.5, 15.0, 14.0, 12.0]


def test_the_limit_is_tightened_by_a_factor_and_the_excess_is_over_that_of_now():
    """Of three steps at a cost of 1 the limits after each quarter of a training are 6 (1/4)^(1/2), and then 6/4."""
    model = learner(Steps(1, cost=lambda action: 1.0), cost_limit=1.5, initial_cost_limit=6.0, tightening=0.5, multiplier_rate=0.1)
    seen = []
    note = lambda *_: seen.append((model.present_limit(), model.multiplier)) or True  # noqa: E731
    assert model.present_limit() == 6
    learn(model, 4, callback=note)
    note()
    # the last of three steps, before the multiplier moves, and after the last rollout
    assert np.array(seen[2::3]) == pytest.approx(np.array([(6.0, 0.0), (3.0, 0.0), (1.5, 0.15), (1.5, 0.3)]))
    assert seen[-1] == pytest.approx((1.5, 0.45)) and model.logger.name_to_value["constraint/limit"] == 1.5


def test_it_moves_when_episodes_have_ended_by_their_whole_cost():
    env = Steps(1, cost=lambda action: 1 + action**2)
    model = learner(env, n_steps=2, cost_limit=1.0, multiplier_rate=0.5)
    learn(model, 1)
    assert model.multiplier == 0 and "constraint/cost" not in model.logger.name_to_value
    # the second rollout ends the episode that the first began, and begins another
    learn(model, 1, reset_num_timesteps=False)
    total = np.sum(env.costs[:3])
    assert model.multiplier == pytest.approx(0.5 * (total - 1)) and model.logger.name_to_value["constraint/cost"] == total
    # what comes after a reset is a new episode
    learn(model, 2)
    assert model.last_cost == pytest.approx(np.sum(env.costs[4:7]))


# --- checkpoints ----------------------------------------------------------------------------------------------------------


def through_save_and_load(model, env):
    stored = io.BytesIO()
    model.save(stored)
    stored.seek(0)
    other = LagrangianPPO.load(stored, env=env, device="cpu")
    other.policy.log_std.requires_grad_(False)
    return other


def through_constraint_state(model, env):
    stored = io.BytesIO()
    torch.save({"policy": model.policy.state_dict(), "optimizer": model.policy.optimizer.state_dict()}, stored)
    torch.save(model.constraint_state(), constraint := io.BytesIO())
    stored.seek(0), constraint.seek(0)
    other = learner(env, kp=0.5, kd=0.5, seed=7)
    state = torch.load(stored, weights_only=True)
    other.policy.load_state_dict(state["policy"])
    other.policy.optimizer.load_state_dict(state["optimizer"])
    other.set_constraint_state(torch.load(constraint, weights_only=True))
    other._n_updates = model._n_updates
    return other


@pytest.mark.parametrize("through", [through_save_and_load, through_constraint_state])
def test_a_loaded_learner_goes_on_as_the_saved_one_would_have(through):
    make = lambda: Steps(64, cost=lambda action: 1 + action**2)  # noqa: E731
    model = learn(learner(make(), kp=0.5, kd=0.5), 3)
    other = through(model, make())
    before = model.constraint_state()
    assert before["multiplier"] > 0 and before["integral"] > 0 and before["last_cost"] > 0
    assert same(other.constraint_state(), before)
    for each in (model, other):
        each.set_logger(Logger(None, []))
        each.set_random_seed(3)
        learn(each, 2)
    # what was taken before is of that time
    assert not same(before["cost_critic"], model.constraint_state()["cost_critic"])
    assert same(other.constraint_state(), model.constraint_state())
    assert same(dict(other.policy.state_dict()), dict(model.policy.state_dict()))


def test_a_state_of_something_else_is_refused_and_changes_nothing():
    model = learn(learner(), 1)
    before, state = model.constraint_state(), learn(learner(), 2).constraint_state()
    other = learner(cost_net_arch=(8,)).constraint_state()
    deep = learner(cost_net_arch=(16, 16)).constraint_state()
    for wrong, told in [
        ({"multiplier": 1.0}, "give what constraint_state"),
        (state | {"multiplier": float("nan")}, "multiplier=nan: must be a finite number"),
        (state | {"integral": -1.0}, "integral=-1.0: must be zero or positive"),
        (state | {"last_cost": None}, "last_cost=None: must be a finite number"),
        (other, "cost_critic is of another network"),
        (state | {"cost_critic": None}, "cost_critic is of another network"),
        (state | {"cost_optimizer": deep["cost_optimizer"]}, "cost_optimizer is of another network"),
        (state | {"cost_optimizer": {}}, "cost_optimizer is of another network"),
    ]:
        with pytest.raises(ValueError, match=told):
            model.set_constraint_state(wrong)
        assert same(model.constraint_state(), before)


# --- what is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ({"cost_limit": None}, "cost_limit is missing: give the mean cost"),
        ({"cost_limit": -1.0}, "cost_limit=-1.0: must be zero or positive"),
        ({"initial_cost_limit": 0.25}, "cost_limit=0.5: must be greater than 0 and at most initial_cost_limit=0.25"),
        (
            {"initial_cost_limit": 1.0, "cost_limit": 0.0},
            "cost_limit=0.0: must be greater than 0 and at most initial_cost_limit=1.0",
        ),
        ({"cost_net_arch": (64, 0)}, "cost_net_arch=0: must be a sequence of widths, each an integer of at least 1"),
    ],
    ids=str,
)
def test_arguments_out_of_range_are_refused(argument, told):
    with pytest.raises(ValueError, match=told):
        learner(**argument)


def test_a_limit_out_of_range_is_refused_while_loading_and_a_new_one_counts():
    model = learner()
    model.save(stored := io.BytesIO())
    stored.seek(0)
    with pytest.raises(ValueError, match="cost_limit=-1: must be zero or positive"):
        LagrangianPPO.load(stored, cost_limit=-1)
    stored.seek(0)
    other = LagrangianPPO.load(stored, cost_limit=2.0, multiplier_rate=0.5)
    other.update_multiplier(3.0)
    assert other.multiplier == 0.5


def test_what_follows_a_rollout_is_of_its_own_environments_whatever_takes_their_place():
    """As a curriculum does at the end of a rollout."""

    class Others(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            self.followed = self.model.predict_cost_values(torch.as_tensor(self.model._last_obs))
            self.model._last_obs = np.full((6, 3), 9.0, np.float32)

    model, others = learner(Steps(6), n_steps=4, cost_gamma=0.9), Others()
    learn(model, 1, callback=others)
    rollout = model.cost_rollout
    goes_on = 1 - rollout.dones[-1]
    assert 0 < goes_on.mean() < 1
    assert rollout.returns[-1] == pytest.approx(rollout.costs[-1] + 0.9 * goes_on * others.followed)


@pytest.mark.parametrize(("cost", "told"), [(None, r"infos\[0\] has no 'cost'"), (lambda _: np.nan, r"infos\[0\]\['cost'\]=nan")])
def test_an_environment_without_costs_is_refused(cost, told):
    with pytest.raises(ValueError, match=told):
        learn(learner(Steps(2, cost=cost)), 1)


# --- the task -------------------------------------------------------------------------------------------------------------


def test_it_learns_on_the_strain_task_whose_costs_it_adds_up():
    env = make_sb3_vec_env("ClothStrain-v0", 2, seed=0, threshold=0.02)
    model = learner(env, noise=0.01, n_steps=100, n_epochs=1, cost_limit=0.0, multiplier_rate=0.001, excess_clip=1e3)
    told = []
    learn(model, 2, callback=lambda local, _: told.extend(local["infos"][env] for env in np.flatnonzero(local["dones"])) or True)
    # the task counts for itself
    assert len(told) == 2 and all(info["failure"] == 0 and info["episode_cost"] > 0 for info in told)
    assert model.last_cost == pytest.approx(np.mean([info["episode_cost"] for info in told]))
    assert model.multiplier == pytest.approx(0.001 * model.last_cost)
    assert np.isfinite(model.logger.name_to_value["constraint/cost_value_loss"])

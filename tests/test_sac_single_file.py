"""SAC in a single file: an update beside Stable-Baselines3's, its parts beside numbers from elsewhere, and runs that go on."""

import copy
import json
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import clothgym
from clothgym import policies

SIZES = 58, 3


@pytest.fixture
def single(scripts):
    """The script as a module."""
    import sac_single_file

    return sac_single_file


def options(single, **kwargs):
    return single.Options(**{"net_arch": (16, 16), "updates": 2, "batch_size": 32, "buffer_size": 1000, **kwargs})


def collect(run):
    """A decision at random of each environment, into the replay buffer."""
    action = run.choose(at_random=True)
    run.keep(action, *run.step(action))


def transitions(count, seed=0):
    rng = np.random.default_rng(seed)
    shapes = {"observation": (58,), "action": (3,), "reward": (), "following": (58,), "goes_on": (), "cost": ()}
    drawn = {name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in shapes.items()}
    return drawn | {"action": np.tanh(drawn["action"]), "goes_on": (drawn["goes_on"] < 1).astype(np.float32)}


def test_an_update_is_that_of_stable_baselines3(single):
    """Three of them, from the same weights and with the same noise; there, critics are given layer normalization."""
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.buffers import ReplayBufferSamples
    from stable_baselines3.common.logger import Logger

    from clothgym.adapters.sb3 import make_sb3_vec_env

    torch.manual_seed(0)
    agent = single.Agent(*SIZES, options(single, gamma=0.9, tau=0.1, first_alpha=0.3))
    settings = {"learning_rate": 0.001, "gamma": 0.9, "tau": 0.1, "ent_coef": "auto_0.3", "batch_size": 64}
    model = SAC("MlpPolicy", make_sb3_vec_env("ClothReach-v0", 2), policy_kwargs={"net_arch": [16, 16]}, device="cpu", **settings)
    actor, mine = model.actor, agent.policy
    for k in (0, 2):
        actor.latent_pi[k].load_state_dict(mine[k].state_dict())
    for head, part in ((actor.mu, slice(0, 3)), (actor.log_std, slice(3, 6))):
        head.load_state_dict({"weight": mine[4].weight[part].detach(), "bias": mine[4].bias[part].detach()})
    for critic, nets in ((model.critic, agent.critics), (model.critic_target, agent.targets)):
        for k in range(2):
            critic.q_networks[k] = copy.deepcopy(nets[k])
            setattr(critic, f"qf{k}", critic.q_networks[k])
    model.critic.optimizer = torch.optim.Adam(model.critic.parameters(), 0.001)
    model.set_logger(Logger(None, []))

    batch = {name: torch.as_tensor(part) for name, part in transitions(64).items()}
    ends = 1 - batch["goes_on"][:, None]
    samples = ReplayBufferSamples(batch["observation"], batch["action"], batch["following"], ends, batch["reward"][:, None])
    model.replay_buffer.sample = lambda *args, **kwargs: samples
    torch.manual_seed(1)
    model.train(gradient_steps=3, batch_size=64)
    before = [parameter.detach().clone() for parameter in mine.parameters()]
    torch.manual_seed(1)
    for _ in range(3):
        agent.update(batch, with_policy=True)

    assert agent.log_alpha.item() == pytest.approx(model.log_ent_coef.item(), abs=1e-6)
    assert agent.log_alpha.item() != pytest.approx(np.log(0.3), abs=1e-3)
    found = [*agent.critics.parameters(), *agent.targets.parameters(), *mine[:4].parameters()]
    want = [*model.critic.parameters(), *model.critic_target.parameters(), *actor.latent_pi.parameters()]
    for one, other in zip(found, want, strict=True):
        assert one.detach().numpy() == pytest.approx(other.detach().numpy(), abs=2e-5)
    assert mine[4].weight[3:].detach().numpy() == pytest.approx(actor.log_std.weight.detach().numpy(), abs=2e-5)
    assert all((one - other).abs().max() > 1e-3 for one, other in zip(mine.parameters(), before))


def test_a_rate_and_a_delay_are_kept(single):
    import torch

    agent = single.Agent(*SIZES, options(single))
    batch = {name: torch.as_tensor(part) for name, part in transitions(32).items()}
    before = copy.deepcopy(agent.policy.state_dict()), agent.log_alpha.item(), copy.deepcopy(agent.critics.state_dict())
    agent.set_rate(0.0)
    agent.update(batch, with_policy=True)
    assert all(part.equal(agent.critics.state_dict()[name]) for name, part in before[2].items())
    agent.set_rate(0.001)
    agent.update(batch, with_policy=False)
    assert all(part.equal(agent.policy.state_dict()[name]) for name, part in before[0].items())
    assert agent.log_alpha.item() == before[1]
    assert not any(part.equal(agent.critics.state_dict()[name]) for name, part in before[2].items() if name.endswith("weight"))


def test_a_normalizer_knows_the_mean_and_deviation_of_all_that_it_saw(single):
    seen, normalizer = np.random.default_rng(0).normal(3, 2, (5, 40, 58)).astype(np.float32), single.Normalizer(58, active=True)
    for part in seen:
        normalizer.see(part)
    whole = seen.reshape(-1, 58).astype(float)
    want = np.clip((seen[0] - whole.mean(axis=0)) / np.sqrt(whole.var(axis=0) + 1e-4), -8, 8)
    assert normalizer(seen[0]).numpy() == pytest.approx(want, abs=1e-5)
    off = single.Normalizer(58, active=False)
    off.see(seen[0])
    assert np.array_equal(off(seen[1]).numpy(), seen[1]) and off.numbers() is None


def test_nets_see_the_named_observations_and_zero_for_the_others(single):
    config = {"env": "ClothReach-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}, "env_kwargs": {}}
    run = single.Run(config | {"hyperparameters": single.asdict(options(single, n_envs=2, sees=["time_left", "way"]))}, None)
    slices, drawn = run.env.task.observation_slices, np.random.default_rng(0).normal(size=(9, 58)).astype(np.float32)
    run.normalizer.see(drawn)
    seen, shown = run.normalizer(drawn).numpy(), np.zeros(58, bool)
    for name in ("time_left", "way"):
        shown[slices[name]] = True
    assert 0 < shown.sum() < 58 and np.array_equal((seen != 0).all(axis=0), shown) and not seen[:, ~shown].any()
    # of a pictured run the critics, which see the state
    pictured = {"physics": "fast", "obs_mode": "depth", "privileged": True, "image_size": 16}
    config["hyperparameters"] = single.asdict(options(single, n_envs=2, sees=["way"]))
    run = single.Run(config | {"env_kwargs": pictured}, None)
    run.normalizer.see(drawn)
    assert np.array_equal(np.flatnonzero(run.normalizer(drawn).numpy().any(axis=0)), np.arange(58)[slices["way"]])
    config["env_kwargs"] = {}
    with pytest.raises(ValueError, match="sees: no observation wind"):
        single.Run(config | {"hyperparameters": single.asdict(options(single, n_envs=2, sees=["wind"]))}, None)


def test_a_policy_of_pictures_receives_the_numbers_that_it_feels_and_no_others(single):
    kwargs = {"physics": "fast", "obs_mode": "depth", "privileged": True, "image_size": 16}
    config = {"env": "ClothFold-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}, "env_kwargs": kwargs}
    config["hyperparameters"] = single.asdict(options(single, n_envs=2, feels=["grippers", "acting_left"]))
    run = single.Run(config, None)
    slices, (image,) = run.env.task.observation_slices, run.env.reset(seed=0)[0]["observation"][:1]
    states = np.eye(73, dtype=np.float32)
    acts = run.acts(None, {"state": np.vstack([np.zeros_like(states[:1]), states]), "observation": np.array([image] * 74)})
    felt = np.flatnonzero(np.abs(acts[1:] - acts[0]).max(axis=1))
    names = np.arange(73)
    assert np.array_equal(felt, [*names[slices["grippers"]], *names[slices["acting_left"]]])
    # its weights, and what it feels, are those of a resumed run
    state = run.state({"training_seconds": 1.0, "core_seconds": 1.0, "collecting_seconds": 1.0})
    seen = {"state": states, "observation": np.array([image] * 73)}
    assert np.array_equal(single.Run(config, state).acts(None, seen), acts[1:])
    # what sees leaves out no net receives, and a policy of states has no picture beside which it could feel anything
    for chosen, own, message in (
        ({"feels": ["grippers"], "sees": ["ways"]}, kwargs, "feels: grippers: not in sees"),
        ({"feels": ["wind"]}, kwargs, "feels: no observation wind"),
        ({"feels": ["grippers"]}, {}, "feels: is for policies of pictures"),
        ({"feels": ["grippers"], "normalize": False}, {}, "feels: is for policies of pictures"),
    ):
        hyperparameters = single.asdict(options(single, n_envs=2, **chosen))
        with pytest.raises(ValueError, match=message):
            single.Run(config | {"env_kwargs": own, "hyperparameters": hyperparameters}, None)


def test_a_sheet_on_the_floor_stands_out_from_it_in_half_precision(single):
    # 2 mm thick, seen from 2.25 m, where depths in half precision are multiples of 2 mm
    kwargs = {"physics": "fast", "obs_mode": "depth", "privileged": True}
    config = {"env": "ClothFold-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}, "env_kwargs": kwargs}
    run = single.Run(config | {"hyperparameters": single.asdict(options(single, n_envs=2))}, None)
    pictures = run.now["picture"].astype(float)
    sheet = (pictures > 0.0005) & (pictures < 0.01)
    assert (np.abs(pictures[pictures < 0.0005]) < 1e-6).all() and sheet.sum() > 1000
    assert pictures[sheet] == pytest.approx(0.0021, abs=0.0002)


def started(single, env="ClothFlattenShirt-v0", env_kwargs="{}", **chosen):
    """A run that begins with the committed policy of ClothFlatten-v0."""
    options = {"n_envs": 2, "sees": ["coverage"], "critics": 5, "starts_from": "ClothFlatten-v0", **chosen}
    args = single.Args(env=env, env_kwargs=env_kwargs, options=json.dumps(options))
    return single.Run(args.config, None)


def test_a_run_that_starts_from_a_policy_acts_as_it_does_on_the_average_of_what_it_does_not_see(single):
    import clothgym

    run, policy = started(single), clothgym.policies.load("ClothFlatten-v0", "sac_scratch")
    here, there = run.env.task.observation_slices["coverage"], policy.make().unwrapped.task.observation_slices["coverage"]
    own = np.random.default_rng(0).normal(size=(9, run.now["observation"].shape[1])).astype(np.float32)
    others = np.tile(policy.normalization[0], (9, 1))
    own[:, here] = others[:, there] = np.linspace(0.1, 1.0, 9)[:, None]
    assert here != there and run.acts(None, own) == pytest.approx(policy(others), abs=1e-5)
    # the first decisions are its own with noise, and do not move the normalization
    numbers = run.normalizer.numbers()
    drawn = run.choose(at_random=True)
    assert np.abs(drawn - run.acts(None, run.now["observation"])).mean() < 0.25
    assert np.array_equal(run.normalizer.numbers(), numbers)
    assert run.config["started_from"]["env"] == "ClothFlatten-v0" and len(run.config["started_from"]["sha256"]) == 64


def test_critics_learn_first_where_a_run_starts_from_a_policy_and_a_resumed_run_goes_on_with_its_own(single, monkeypatch):
    monkeypatch.setattr(single, "CRITICS_FIRST", 4)
    kwargs = '{"action_mode": "throw", "rows": 9, "physics": "fast"}'
    chosen = {"updates": 4, "random_decisions": 2, "batch_size": 8, "buffer_size": 100, "timesteps": 1200}
    run = started(single, "ClothFlatten-v0", kwargs, **chosen)
    steps, weights = run.steps(), run.agent.policy[0].weight
    first = weights.detach().clone()
    for _ in range(2):
        next(steps)
    assert run.updates == 4 and weights.equal(first)
    next(steps)
    assert run.updates == 8 and not weights.equal(first)
    state = run.state({"training_seconds": 1.0, "core_seconds": 1.0, "collecting_seconds": 1.0})
    again = single.Run(run.config, state)
    assert again.agent.policy[0].weight.equal(weights) and np.array_equal(again.normalizer.numbers(), run.normalizer.numbers())
    again.choose(at_random=False)
    assert np.array_equal(again.normalizer.numbers(), run.normalizer.numbers())
    # a run whose first policy is another one by now, and that had no checkpoint yet
    with pytest.raises(ValueError, match="ClothFlatten-v0 has changed since the run began"):
        single.Run(run.config | {"started_from": {"sha256": "0" * 64}}, None)


def test_policies_that_a_run_cannot_start_from_are_refused(single):
    throw = '{"action_mode": "throw"}'
    for chosen, message in (
        ({"sees": ["coverage", "speed"]}, "policy of ClothFlatten-v0 did not see 'speed', which the option sees lists"),
        ({"net_arch": [64]}, r"has layers of \[128, 128, 17\], not of \[64, 17\]"),
        ({"starts_from": "ClothFling-v0", "sees": ["grippers"]}, "policy of ClothFling-v0 did not see 'grippers'"),
        ({"starts_from": "ClothFoldGoal-v0"}, "has goals or pictures"),
        ({"env_kwargs": '{"obs_mode": "depth", "privileged": true}', "buffer_size": 100}, "has goals or pictures"),
        (
            {"env": "ClothFlatten-v0", "env_kwargs": '{"action_mode": "velocity"}', "net_arch": [128, 128]},
            "has layers of .* 17.*, not of .* 8",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            started(single, **({"env_kwargs": throw} | chosen))


def test_a_buffer_draws_from_the_last_transitions(single):
    replay, rng = single.Replay(10, *SIZES), np.random.default_rng(0)
    for first in range(0, 16, 4):
        rows = transitions(4, seed=first) | {"reward": np.arange(first, first + 4)}
        replay.add(**rows)
    assert replay.filled == 10 and sorted(replay.rows["reward"]) == list(range(6, 16))
    batches = list(replay.minibatches(3, 50, rng, single.Normalizer(58, active=False)))
    assert [len(batch["action"]) for batch in batches] == [50] * 3
    assert set(np.concatenate([batch["reward"].numpy() for batch in batches])) == set(range(6, 16))
    # the rows of a transition stay together
    last = replay.rows["reward"] >= 12
    assert replay.rows["observation"][last] == pytest.approx(transitions(4, seed=12)["observation"])


def test_an_episode_s_end_is_followed_by_its_own_last_observation(single, monkeypatch):
    """And not by the next one's first; a termination is marked, a truncation is not."""
    config = {"env": "ClothReach-v0", "seed": 0, "threads": 1, "timesteps": 10**6, "curriculum": {}}
    more = {"n_envs": 4, "normalize": False}
    for kwargs, goes_on in (({"action_repeat": 40}, False), ({"action_repeat": 40, "max_episode_steps": 1}, False)):
        run = single.Run(config | {"env_kwargs": kwargs, "hyperparameters": single.asdict(options(single, **more))}, None)
        made = gym.make_vec("clothgym:ClothReach-v0", num_envs=4, autoreset_mode="Disabled", action_repeat=40)
        begun = np.random.SeedSequence([0, 0]).generate_state(2)[0] % (single.HELD_OUT - 4)
        first, _ = made.reset(seed=int(begun))
        collect(run)
        rows = {name: part[:4] for name, part in run.replay.rows.items()}
        last, reward, terminated, *_ = made.step(rows["action"])
        assert np.array_equal(rows["observation"], first) and np.array_equal(rows["following"], last) and terminated.all()
        assert rows["reward"] == pytest.approx(10 * reward) and rows["goes_on"].tolist() == [goes_on] * 4
        assert not np.array_equal(run.now["observation"], last) and len(run.episodes) == 4
    kwargs = {"action_repeat": 4, "max_episode_steps": 1}
    run = single.Run(config | {"env_kwargs": kwargs, "hyperparameters": single.asdict(options(single, **more))}, None)
    collect(run)
    assert run.replay.rows["goes_on"][:4].tolist() == [1] * 4 and len(run.episodes) == 4
    assert not np.array_equal(run.now["observation"], run.replay.rows["following"][:4])


def test_a_torn_sheet_costs_as_much_as_all_steps_to_come_and_a_loss_no_more_than_the_least_reward(single):
    """The sheet is torn: corners move apart at full speed, and each remaining step costs 1, of 150."""
    config = {"env": "ClothStrain-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}}
    # the discounted sum of 30 a decision: 30 / (1 - gamma)
    for gamma, most in ((0.9, 150), (0.7, 100)):
        own = {"n_envs": 2, "cost_limit": 0.3, "least_reward": -0.02, "bounded_for": 0.5, "gamma": gamma}
        hyperparameters = single.asdict(options(single, **own))
        run = single.Run(config | {"env_kwargs": {"action_repeat": 30}, "hyperparameters": hyperparameters}, None)
        tear = np.array([[0, 1, 0, 0, -1, 0], [0, 0, 0, 0, 0, 0]], float)
        run.rng = SimpleNamespace(uniform=lambda low, high, size, tear=tear: tear, integers=run.rng.integers)
        collect(run)
        assert run.replay.rows["cost"][:2].tolist() == pytest.approx([most, 0]) and run.replay.rows["goes_on"][:2].tolist() == [
            0,
            1,
        ]
        # of rewards ten times as large, the bound holds for half of the steps
        lost = run.replay.rows["reward"][0]
        assert lost < -1 and run.replay.rows["reward"][1] > -0.2
        for run.done, least in ((499, -0.2), (500, lost)):
            assert min(batch["reward"].min() for batch in run.minibatches()) == pytest.approx(least)


def test_a_policy_pays_the_price_of_its_costs(single):
    """Of an action a the reward is a, and the cost a^2: best is a = 1 / (2 multiplier)."""
    import torch

    for multiplier, want in ((0.0, 1.0), (1.0, 0.5), (2.0, 0.25)):
        torch.manual_seed(0)
        agent = single.Agent(1, 1, options(single, cost_limit=0.1, first_alpha=1e-4, target_entropy=-3.0, learning_rate=0.01))
        agent.multiplier = multiplier
        for _ in range(400):
            action = 2 * torch.rand(64, 1) - 1
            seen, goes_on = torch.zeros(64, 1), torch.zeros(64)
            batch = {"observation": seen, "following": seen, "action": action, "reward": action[:, 0], "cost": action[:, 0] ** 2}
            agent.update(batch | {"goes_on": goes_on}, with_policy=True)
        found = torch.tanh(agent.policy(torch.zeros(1, 1))[0, 0]).item()
        assert found == pytest.approx(want, abs=0.06), multiplier
        reward, cost = (one.item() for one in agent.values(agent.said(agent.critics, torch.zeros(1, 1), torch.tensor([[0.5]]))))
        assert (reward, cost) == pytest.approx((0.5, 0.25), abs=0.05)


def test_targets_take_the_least_of_two_critics_and_the_policy_the_mean(single):
    import torch

    torch.manual_seed(0)
    agent = single.Agent(1, 1, options(single, critics=3, gamma=0.5))
    for target, value in zip(agent.targets, (0.0, 9.0, 4.0)):
        target[-1].weight.data.zero_()
        target[-1].bias.data.fill_(value)
    batch = {"following": torch.zeros(2, 1), "reward": torch.tensor([10.0, 20.0]), "goes_on": torch.tensor([1.0, 0.0])}
    drawn = [agent.wanted(batch, alpha=0.0) for _ in range(300)]
    assert all(len(wanted) == 3 and all(torch.equal(wanted[0], one) for one in wanted) for wanted in drawn)
    # the least of three pairs is 0, 0 and 4; nothing follows an episode's end
    first, second = torch.stack([wanted[0] for wanted in drawn]).T.tolist()
    assert set(first) == {10.0, 12.0} and set(second) == {20.0} and first.count(12.0) == pytest.approx(100, abs=25)
    assert agent.values(torch.tensor([[0.0], [9.0], [5.0]]))[0].tolist() == pytest.approx([14 / 3])
    # where costs are limited, the last two critics are of the cost, of which the most counts
    agent = single.Agent(1, 1, options(single, critics=3, gamma=0.5, cost_limit=1.0))
    for target, value in zip(agent.targets, (0.0, 9.0, 4.0, 6.0, 8.0)):
        target[-1].weight.data.zero_()
        target[-1].bias.data.fill_(value)
    wanted = agent.wanted(batch | {"cost": torch.tensor([1.0, 2.0])}, alpha=0.0)
    assert len(wanted) == 5 and all(one.tolist() == [5.0, 2.0] for one in wanted[3:])
    assert [one.tolist() for one in agent.values(torch.tensor([[0.0], [9.0], [3.0], [6.0], [8.0]]))] == [[4.0], [8.0]]


def test_the_price_follows_the_costs_of_the_last_episodes(single):
    config = {"env": "ClothStrain-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}, "env_kwargs": {}}
    own = {"n_envs": 1, "cost_limit": 1.0, "multiplier_rate": 0.01}
    run = single.Run(config | {"hyperparameters": single.asdict(options(single, **own))}, None)
    run.set_multiplier()
    assert run.agent.multiplier == 0
    # over the limit by a half, then by more than counts, then twice under it by 1
    for costs, want in (([1.2, 1.8], 0.005), ([40, 40], 0.015), ([0], 0.005), ([0], 0.0)):
        run.episodes.clear()
        run.episodes.extend((1.0, 1.0, cost) for cost in costs)
        run.set_multiplier()
        assert run.agent.multiplier == pytest.approx(want)


def test_decisions_that_a_settling_sheet_ignores_are_left_out(single):
    """The buffer is that of an environment that settles at once."""
    config, found = {"env": "ClothDrape-v0", "seed": 0, "threads": 1, "timesteps": 10**6, "curriculum": {}}, {}
    for settling, steps in (("at_once", 15), ("steps", 37)):
        kwargs = {"physics": "fast", "action_repeat": 4, "settling": settling}
        run = single.Run(config | {"env_kwargs": kwargs, "hyperparameters": single.asdict(options(single, n_envs=1))}, None)
        # it is never let go: the episode takes all of its 60 control steps, and settles for 85
        run.rng = SimpleNamespace(uniform=lambda low, high, size: np.full(size, -0.1))
        for _ in range(steps):
            collect(run)
        found[settling] = {name: part[: run.replay.added] for name, part in run.replay.rows.items()}
        assert len(run.episodes) == 1 and run.replay.added == 15
    for name, part in found["at_once"].items():
        assert part == pytest.approx(found["steps"][name], abs=1e-5), name


def test_of_pictures_the_policy_sees_nothing_else_and_critics_see_the_state(single):
    import torch

    config = {"env": "ClothReach-v0", "seed": 0, "threads": 1, "timesteps": 1000, "curriculum": {}}
    kwargs = {"physics": "fast", "obs_mode": "depth", "privileged": True, "image_size": 16}
    run = single.Run(config | {"env_kwargs": kwargs, "hyperparameters": single.asdict(options(single, n_envs=3))}, None)
    made = gym.make_vec("clothgym:ClothReach-v0", num_envs=3, autoreset_mode="Disabled", **kwargs)
    first = made.reset(seed=int(np.random.SeedSequence([0, 0]).generate_state(2)[0] % (single.HELD_OUT - 3)))[0]
    middle = made.single_observation_space["observation"].high.max() / 2
    seen = torch.as_tensor(middle - first["observation"][..., 0][:, None]).half(), torch.zeros(3, 58)
    torch.manual_seed(0)
    want = run.agent.act(seen)[0].detach().numpy()
    torch.manual_seed(0)
    action = run.choose(at_random=False)
    assert np.array_equal(action, want) and np.ptp(want, axis=0).min() > 0
    run.keep(action, *run.step(action))
    rows, second = run.replay.rows, made.step(action)[0]
    for name, observation in (("", first), ("following_", second)):
        heights = middle - np.moveaxis(observation["observation"], -1, 1)
        assert np.array_equal(rows[f"{name}picture"][:3], heights.astype(np.float16))
        assert np.array_equal(rows["following" if name else "observation"][:3], observation["state"])
    # an update moves the encoder, too
    encoder = run.agent.policy.encoder
    before = encoder.linear[0].weight.clone()
    (batch,) = run.replay.minibatches(1, 8, run.rng, run.normalizer)
    run.agent.update(batch, with_policy=True)
    assert not encoder.linear[0].weight.equal(before)
    assert np.array_equal(run.acts(made, first), torch.tanh(run.agent.policy(seen))[:, :3].detach().numpy())


SHORT = {
    "timesteps": 1600,
    "normalize": True,
    "n_envs": 8,
    "updates": 2,
    "batch_size": 32,
    "net_arch": [16, 16],
    "buffer_size": 300,
    "random_decisions": 64,
}


def trained(single, monkeypatch, folder, *, stop_at=None, resume=False, evaluations=2, env_kwargs='{"physics": "fast"}'):
    """A short run; stop_at: updates after which it is interrupted."""
    import learning

    monkeypatch.setattr(learning, "film", lambda *args, **kwargs: None)
    kwargs = {"evaluations": evaluations, "eval_episodes": 2, "final_episodes": 4}
    if resume:
        args = single.Args(resume=folder, **kwargs)
    else:
        args = single.Args(seed=3, run=folder, options=json.dumps(SHORT), env_kwargs=env_kwargs, **kwargs)
    update, count = single.Agent.update, [0]

    def counted(agent, *given, **more):
        count[0] += 1
        if count[0] == stop_at:
            raise KeyboardInterrupt
        update(agent, *given, **more)

    monkeypatch.setattr(single.Agent, "update", counted)
    if stop_at is None:
        single.train(args)
    else:
        with pytest.raises(KeyboardInterrupt):
            single.train(args)
    monkeypatch.setattr(single.Agent, "update", update)
    return count[0]


def test_a_run_leaves_its_story_and_the_same_bits_again(single, tmp_path, monkeypatch):
    updates = trained(single, monkeypatch, tmp_path / "one")
    # on any number of threads
    trained(single, monkeypatch, tmp_path / "other", env_kwargs='{"physics": "fast", "threads": 1}')
    # 50 decisions of each environment, the first 8 of them at random
    assert updates == 2 * (50 - 8)
    one, other = (policies.read(tmp_path / name / "policy.npz") for name in ("one", "other"))
    for (weight, bias), (again, too) in zip(one.layers, other.layers):
        assert np.array_equal(weight, again) and np.array_equal(bias, too)
    assert all(np.array_equal(part, again) for part, again in zip(one.normalization, other.normalization))
    assert one.about["env_kwargs"] == {"action_repeat": 4, "physics": "fast"} and one.about["learner"] == "sac_scratch"
    scores = json.loads((tmp_path / "one" / "evaluation.json").read_text())
    assert scores["episodes"] == scores["with_noise"]["episodes"] == 4 and scores["timesteps"] == 1600
    assert one.about["success_rate"] == scores["success_rate"] and scores["training_seconds"] > scores["collecting_seconds"] > 0
    lines = [json.loads(line) for line in (tmp_path / "one" / "progress.jsonl").read_text().splitlines()]
    assert [line["timesteps"] for line in lines] == [800, 1600] and scores["chosen_by"] == lines[-1]["success_rate"]
    # the file acts as the net did
    env = one.make_vec(4)
    assert one(env.reset(seed=0)[0]).shape == (4, 3)


def test_references_are_taken_from_a_committed_run_on_the_same_environment(single, tmp_path, monkeypatch):
    import learning

    def committed(digest, episodes):
        scores = {name: {"episodes": episodes, "success_rate": 0.5} for name in ("noop", "random")}
        return {"env_kwargs": {"action_repeat": 4, "physics": "fast"}, "digest": digest, "references": scores}

    monkeypatch.setattr(learning.results, "RUNS", tmp_path)
    monkeypatch.setattr(learning, "digest_of", lambda env_id, env_kwargs: "now")
    rows = {
        "ClothReach-v0_old": committed("before", 4), "ClothFold-v0_0": committed("now", 4),
        "ClothReach-v0_short": committed("now", 3),
        "ClothReach-v0_other": committed("now", 4) | {"env_kwargs": {"action_repeat": 4}},
    }  # fmt: skip
    for name, row in rows.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "evaluation.json").write_text(json.dumps(row))
    config = {"env": "ClothReach-v0", "env_kwargs": {"action_repeat": 4, "physics": "fast"}}
    assert learning.known_references(config, 4) == {}
    rows["ClothReach-v0_old"]["digest"] = "now"
    (tmp_path / "ClothReach-v0_old" / "evaluation.json").write_text(json.dumps(rows["ClothReach-v0_old"]))
    assert learning.known_references(config, 4) == rows["ClothReach-v0_old"]["references"]


def test_an_interrupted_run_goes_on_with_its_buffer(single, tmp_path, monkeypatch):
    from clothgym.adapters.runs import load_last

    folder = tmp_path / "run"
    trained(single, monkeypatch, folder, stop_at=50)
    state = load_last(folder)
    # 25 decisions of each environment were done at the evaluation
    assert state["num_timesteps"] == 800 and state["num_updates"] == 34 and int(state["variables"]["added"]) == 200
    state["constraint"]["multiplier"] = 0.7
    run = single.Run(single.policies.read_config(folder), state)
    assert run.replay.filled == 200 and run.done == 800 and run.updates == 34 and run.agent.multiplier == 0.7
    again = run.state(state["times"])
    for part in ("of critics", "of targets"):
        assert all(value.equal(state["optimizer"][part][name]) for name, value in again["optimizer"][part].items()), part
    for part in ("policy", "variables"):
        assert all(value.equal(state[part][name]) for name, value in again[part].items())
    for part in ("critics", "policy", "alpha"):
        moments = again["optimizer"][part]["state"]
        assert all(moments[0][name].equal(value) for name, value in state["optimizer"][part]["state"][0].items()), part
    # it learns at once, and to the end
    assert trained(single, monkeypatch, folder, resume=True) == 50
    lines = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    assert [line["timesteps"] for line in lines] == [800, 1600] and (folder / "policy.npz").exists()
    # a run that has ended is scored again, and takes no step
    assert trained(single, monkeypatch, folder, resume=True) == 0


@pytest.mark.parametrize(("keeps", "kept"), [("best", 1), ("last", 3)])
def test_a_run_keeps_the_policy_of_its_best_evaluation(single, tmp_path, monkeypatch, keeps, kept):
    import learning

    # the last evaluation has the successes of the second, and less of its performance
    scores = iter([(0.1, 0.2), (0.6, 0.5), (0.2, 0.9), (0.6, 0.4)])
    seen, acted = np.full((1, 58), 0.1, np.float32), []

    def note(record, acting, timesteps, episodes):
        acted.append(acting(None, seen))
        success, performance = next(scores)
        line = dict.fromkeys(learning.SCORES, 0.0) | {"timesteps": timesteps}
        record.lines.append(line | {"success_rate": success, "normalized_performance": performance})
        return record.lines[-1]

    monkeypatch.setattr(learning.Record, "note", note)
    monkeypatch.setitem(SHORT, "keeps", keeps)
    trained(single, monkeypatch, tmp_path, evaluations=4)
    policy, config = policies.read(tmp_path / "policy.npz"), single.policies.read_config(tmp_path)
    assert [np.array_equal(policy(seen), one) for one in acted] == [i == kept for i in range(4)]
    assert policy.about["chosen_by"] == 0.6
    # a checkpoint of the run that has ended acts like the file
    run = single.Run(config, learning.load_last(tmp_path))
    assert np.allclose(run.acts(None, seen), policy(seen), atol=2e-3)


def test_a_curriculum_ends_with_the_arguments_of_the_run(single):
    config = {
        "env": "ClothReach-v0", "seed": 0, "threads": 1, "timesteps": 24, "env_kwargs": {"action_repeat": 2},
        "curriculum": {"n_timesteps": 12, "env_kwargs": {"physics": "fast"}},
        "hyperparameters": single.asdict(options(single, n_envs=4, random_decisions=10**6)),
    }  # fmt: skip
    run, seen = single.Run(config, None), []
    for _ in run.steps():
        seen.append((run.done, run.env.task.physics_name))
    assert seen == [(8, "fast"), (16, "fast"), (24, "true")] and run.replay.added == 12
    assert single.Run(config, None).env.task.physics_name == "fast"


def test_goals_are_observed_by_the_policy(single):
    config = {
        "env": "ClothFoldGoal-v0", "seed": 0, "threads": 1, "timesteps": 100, "env_kwargs": {"physics": "fast", "action_repeat": 4},
        "curriculum": {}, "hyperparameters": single.asdict(options(single, n_envs=2)),
    }  # fmt: skip
    run = single.Run(config, None)
    policy = run.policy({})
    assert run.keys == policy.keys == ("achieved_goal", "desired_goal", "observation")
    batch, _ = policy.make_vec(2).reset(seed=1)
    assert np.array_equal(policy(batch), policy.predict({key: part[:2] for key, part in batch.items()})[0])
    assert run.noisy(None, batch).shape == (2, 8)


WRONG = {
    "--env ClothHang-Hard-v0": "has no hyperparameters for 'ClothHang-Hard-v0' (there are: ClothReach-v0",
    '--options {"gamma":2}': "--options: gamma 2: must be from 0 to 1",
    '--options {"updates":2.5}': "--options: updates 2.5: must be a count",
    '--options {"n_envs":true}': "--options: n_envs True: must be a count",
    '--options {"normalize":"no"}': "--options: normalize 'no': must be true or false",
    '--options {"cost_limit":true}': "--options: cost_limit True: must be a number",
    '--options {"net_arch":[64,true]}': "--options: net_arch [64, True]: must be a list of counts",
    '--options {"net_arch":64}': "--options: net_arch 64: must be a list of counts",
    '--options {"feels":[3]}': "--options: feels [3]: must be a list of names",
    '--options {"sees":"way"}': "--options: sees 'way': must be a list of names",
    '--options {"keeps":"first"}': "--options: keeps 'first': must be last or best",
    '--options {"critics":1}': "--options: critics 1: must be from 2 to 100",
    '--options {"starts_from":"ClothFlatten-v0"}': "--options: starts_from needs normalized observations, and sees",
    '--options {"starts_from":3}': "--options: starts_from 3: must be an id, or the name of a file",
    '--options {"starts_from":"ClothFlaten-v0","sees":["coverage"],"normalize":true}': "did you mean 'ClothFlatten-v0'",
    '--options {"starts_from":"ClothHook-Hard-v0","sees":["coverage"],"normalize":true}': "no policy of this script is",
    '--options {"starts_from":"nowhere.npz","sees":["coverage"],"normalize":true}': "--options: starts_from: ",
    '--options {"n_steps":2}': "--options: no n_steps (there are: timesteps, n_envs",
    "--run taken": "taken holds a run already: go on with --resume taken",
    "--resume taken": "is a run of ppo, which train.py goes on with",
}


@pytest.mark.parametrize("command", WRONG)
def test_wrong_arguments_are_refused_as_wrong_flags_are(command, single, tmp_path, monkeypatch, capsys):
    import tyro

    from clothgym import files

    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    config = {
        "env": "ClothReach-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": {}, "hyperparameters": {},
        "num_envs": 4, "timesteps": 100, "seed": 0, "threads": 1, "clothgym": clothgym.__version__,
    }  # fmt: skip
    files.write_json(tmp_path / "taken" / "config.json", config)
    with pytest.raises(SystemExit) as caught:
        tyro.cli(single.Args, args=command.split(" "))
    # without the frame around it and its line breaks
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert caught.value.code == 2 and WRONG[command] in said

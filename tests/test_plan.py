"""The planner: what it executes is what it has predicted, it is the same each time, and better than doing nothing."""

import json

import gymnasium as gym
import numpy as np
import pytest

ENV = "ClothReach-v0"
SMALL = {"population": 12, "elites": 4, "iterations": 2, "horizon": 0, "execute": 0, "repeat": 4, "threads": 1}
HELD_OUT = 1_000_000


@pytest.fixture
def planner(scripts):
    """Make a planner with these settings, and its environment."""
    import plan

    def make(env_kwargs=None, **settings):
        args = plan.Args(env=ENV, **(SMALL | settings))
        kwargs = env_kwargs or {}
        env = gym.make_vec(ENV, num_envs=1, autoreset_mode="Disabled", **kwargs)
        return plan.Planner(args, env, **kwargs)

    return make


def returns_of(policy, seeds):
    """Returns of episodes in the single environment; policy: of (environment, step)."""
    env, totals = gym.make(ENV), []
    for seed in seeds:
        env.reset(seed=seed)
        total, step, terminated = 0.0, 0, False
        while not terminated:
            _, reward, terminated, _, _ = env.step(policy(env, step))
            total, step = total + reward, step + 1
        totals.append(total)
    return totals


@pytest.mark.parametrize("env_kwargs", [{}, {"wind": {"speed": [0.5, 1.0], "gust": 0.3}}], ids=["still air", "wind"])
def test_the_plan_of_an_episode_is_executed_as_predicted(planner, env_kwargs):
    """In the single environment, from the same seed, the actions' return is what the best branch has promised, to the bit."""
    import plan

    made = planner(env_kwargs)
    made.env.reset(seed=[HELD_OUT])
    found = made.plan(np.zeros((0, 3), np.float32), np.random.default_rng(1))
    assert len(found.actions) == 10 and len(found.rewards) == 40
    env = gym.make(ENV, **env_kwargs)
    env.reset(seed=HELD_OUT)
    rewards = [env.step(found.actions[step // 4])[1] for step in range(40)]
    assert rewards == found.rewards.tolist()
    total = 0.0
    for reward in rewards:
        total += reward
    assert plan.running_sum(found.rewards[:, None]) == [total]


def test_planning_leaves_the_environment_where_it_was(planner):
    made = planner(from_expert=True)
    made.env.reset(seed=[HELD_OUT])
    before = made.env.get_state()
    made.plan(np.zeros((0, 3), np.float32), np.random.default_rng(1))
    after = made.env.get_state()
    for name, array in before.simulation.arrays().items():
        assert np.array_equal(array, after.simulation.arrays()[name]), name
    assert before.generators == after.generators and np.array_equal(before.episode["step"], after.episode["step"])


def test_it_beats_doing_nothing_and_repeats_itself(planner):
    """A moving horizon: nothing is mispredicted, also where it is planned anew; other threads, the same bits."""
    import plan

    settings = {"horizon": 4, "execute": 1, "iterations": 2}
    first = [plan.episode(planner(**settings), HELD_OUT + i) for i in range(2)]
    again = [plan.episode(planner(**settings, threads=2), HELD_OUT + i) for i in range(2)]
    for one, other in zip(first, again):
        assert {**one, "seconds": 0} == {**other, "seconds": 0}
        assert one["mispredicted"] == 0 and one["length"] == 40
        # ten plans; the last ones reach only to the end
        assert one["model_steps"] == 12 * 2 * 4 * (7 * 4 + 3 + 2 + 1)
    nothing = returns_of(lambda env, step: np.zeros(3), [HELD_OUT, HELD_OUT + 1])
    assert all(one["return"] > zero + 0.2 for one, zero in zip(first, nothing))


def test_a_plan_from_the_expert_is_not_worse_than_the_expert(planner):
    """The expert, acting as seldom, is the first sequence that is tried."""
    import plan

    acted = []

    def seldom(env, step):
        if step % 4 == 0:
            acted.append(np.clip(env.unwrapped.expert_action(), -1, 1))
        return acted[-1]

    (expert,) = returns_of(seldom, [HELD_OUT])
    made = planner(from_expert=True)
    planned = plan.episode(made, HELD_OUT)
    assert planned["return"] >= expert > 0.9
    # nothing but the expert where no more steps of the model are to be had
    made = planner(from_expert=True, model_steps=1)
    assert plan.episode(made, HELD_OUT)["return"] == expert and made.spent == 0


@pytest.mark.slow
def test_it_goes_on_with_the_episodes_that_are_in_the_file(scripts, tmp_path, monkeypatch):
    import plan

    args = {"env": ENV, "json": tmp_path / "rows.json", **SMALL}
    whole = plan.Args(**(args | {"episodes": 3, "json": tmp_path / "whole.json"}))
    plan.main(whole)
    asked, before = [], plan.episode
    monkeypatch.setattr(plan, "episode", lambda made, seed: asked.append(seed) or before(made, seed))
    plan.main(plan.Args(**args, episodes=1))
    plan.main(plan.Args(**args, episodes=3))
    assert asked == [HELD_OUT, HELD_OUT + 1, HELD_OUT + 2]
    rows = [json.loads((tmp_path / name).read_text())["rows"] for name in ("rows.json", "whole.json")]
    assert len(rows[0]) == 1 and rows[0][0]["episodes"] == 3
    # but for when they were made
    when = {"seconds": 0, "date": ""}
    timeless = [{**row, **when, "by_episode": [{**one, "seconds": 0} for one in row["by_episode"]]} for (row,) in rows]
    assert timeless[0] == timeless[1]
    # other settings are another row; its film
    plan.main(plan.Args(**(args | {"iterations": 1}), episodes=1, film=tmp_path / "film.gif"))
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    assert [row["episodes"] for row in json.loads(args["json"].read_text())["rows"]] == [3, 1]

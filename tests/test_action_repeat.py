"""``action_repeat``: an action held for several control steps; and ``gamma``: a shaping that is neutral under that discount."""

import gymnasium as gym
import numpy as np
import pytest

SUMMED = ("reward/", "cost")
CASES = (  # the number of control steps of none is a multiple of the repeat: each ends within a step
    ("ClothReach-v0", 7, {}),
    ("ClothStrain-v0", 7, {"physics": "fast", "cost_penalty": 0.01, "threshold": 0.03}),
    ("ClothDrapeGripper-v0", 30, {"physics": "fast", "settling": "at_once"}),
)


def actions_of(env, seed):
    rng = np.random.default_rng(seed)
    while True:
        yield rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)


def by_hand(env_id, seed, repeat, **kwargs):
    """Each step's observation, sums and info, of an environment that is stepped in a loop; and its control steps."""
    env = gym.make(f"clothgym:{env_id}", **kwargs)
    env.reset(seed=seed)
    found, over, control_steps, actions = [], False, 0, actions_of(env, seed)
    while not over:
        action, total, sums = next(actions), 0.0, {}
        for _ in range(repeat):
            seen, reward, over, _, info = env.step(action)
            control_steps += 1
            total += reward
            sums = {key: sums.get(key, 0.0) + value for key, value in info.items() if key.startswith(SUMMED)}
            if over:
                break
        found.append((seen, total, over, info | sums))
    return found, control_steps


@pytest.mark.parametrize(("env_id", "repeat", "kwargs"), CASES)
def test_a_held_action_is_that_of_a_loop_alone_and_in_a_batch(env_id, repeat, kwargs):
    loop, control_steps = by_hand(env_id, 5, repeat, **kwargs)
    single = gym.make(f"clothgym:{env_id}", action_repeat=repeat, **kwargs)
    batch = gym.make_vec(
        f"clothgym:{env_id}", num_envs=3, action_repeat=repeat, autoreset_mode="Disabled", threads=2, **kwargs
    ).unwrapped
    single.reset(seed=5)
    batch.reset(seed=4)
    others = [actions_of(single, 4), actions_of(single, 6)]
    for (seen, reward, over, info), action in zip(loop, actions_of(single, 5)):
        alone = single.step(action)
        together = batch.step(np.stack([next(others[0]), action, next(others[1])]))
        for got_seen, got_reward, got_over in (alone[:3], [part[1] for part in together[:3]]):
            assert np.array_equal(got_seen, seen) and got_reward == reward and got_over == over
        assert alone[4] == info and all(together[4][key][1] == value for key, value in info.items())
    assert over and single.unwrapped.task.control_steps_taken()[0] == control_steps
    assert single.unwrapped.task.steps_taken()[0] == len(loop) <= single.unwrapped.task.most_steps()
    if "cost" in info:
        assert any(info["cost"] > 1 for *_, info in loop)
    # one that is over gives its last answer, and nothing more
    seen, reward, over, *_ = single.step(action)
    assert np.array_equal(seen, loop[-1][0]) and reward == 0 and over


def test_a_neutral_shaping_adds_the_same_to_the_discounted_returns_of_all_actions():
    """The sum of ``gamma^t r_t`` less that of the effort is ``gamma^(T-1) (P + bonus) - Phi_0`` (Ng et al. 1999)."""
    env = gym.make("clothgym:ClothReach-v0", gamma=0.9, action_repeat=3)
    for seed in range(2):
        env.reset(seed=seed)
        first, total, over, t = env.unwrapped.task.episode["potential"][0], 0.0, False, 0
        for action in actions_of(env, seed):
            _, reward, over, _, info = env.step(0.2 * action)
            total += 0.9**t * (reward - info["reward/effort"])
            if over:
                break
            t += 1
        assert t == 13 and total == pytest.approx(0.9**13 * (info["normalized_performance"] + 0.25 * info["is_success"]) - first)


def test_lengths_of_scored_episodes_are_control_steps(scripts):
    from policies import noop
    from scoring import run_episodes

    found = run_episodes("ClothReach-v0", noop, [1, 2, 3], progress=False, action_repeat=7, physics="fast")
    assert found["length"].tolist() == [40, 40, 40]


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"action_repeat=0: must be an integer of at least 1"):
        gym.make("clothgym:ClothReach-v0", action_repeat=0)
    with pytest.raises(ValueError, match=r"action_repeat=2: must be 1 with action_mode='pick_place', an action of which is 60"):
        gym.make("clothgym:ClothFold-v0", action_repeat=2, action_mode="pick_place")
    with pytest.raises(ValueError, match=r"gamma=1\.5: must be above 0, and at most 1"):
        gym.make("clothgym:ClothReach-v0", gamma=1.5)
    with pytest.raises(ValueError, match=r"gamma=0\.9: must be 1 with reward_mode='sparse', whose rewards have no shaping"):
        gym.make("clothgym:ClothReach-v0", gamma=0.9, reward_mode="sparse")

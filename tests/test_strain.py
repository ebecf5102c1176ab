"""The strain task: its costs, tension, way, reward, limits and observation, against numbers worked out here."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from strain_truths import (
    APART,
    CLIPS,
    INDEX,
    LEFT,
    RIGHT,
    SIDE,
    SPEED,
    STEP,
    STEPS,
    STRAIN,
    WEIGHT,
    batch,
    careless,
    clip_forces,
    p95,
    play,
    positions,
    potential,
    start,
    strains,
    to_places,
    whole_way,
)  # fmt: skip

from clothgym import INTEGRATORS
from clothgym.envs.episode import TORN

# --- strain and cost ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["careless", "random"])
def test_the_strain_is_that_of_the_threads_and_more_than_the_threshold_costs(policy):
    env, rng, threshold = batch(6, threshold=0.08), np.random.default_rng(0), 0.08
    total, over, costs = np.zeros(6), np.zeros(6, bool), []
    for _ in range(40):
        *_, terminated, _, info = env.step(careless(env) if policy == "careless" else rng.uniform(-0.25, 0.25, (6, 6)))
        now = strains(positions(env))
        on = ~over
        assert info["strain_max"][on] == pytest.approx(now.max(axis=1)[on], abs=2e-6)
        assert info["strain_p95"][on] == pytest.approx([p95(row) for row in now[on]], abs=1e-5)
        assert info["strain_excess"][on] == pytest.approx(np.maximum(now.max(axis=1) - threshold, 0)[on], abs=2e-6)
        sure = on & (np.abs(now.max(axis=1) - threshold) > 2e-6)
        expected = (now.max(axis=1) > threshold).astype(float)
        assert np.array_equal(info["cost"][sure], expected[sure])
        assert not info["cost"][over].any()
        total += info["cost"]
        assert np.array_equal(info["episode_cost"][on], total[on])
        costs += expected[on].tolist()
        over |= terminated
    assert 0.1 < np.mean(costs) < 0.9


def test_a_new_episode_begins_with_no_cost():
    env = gym.make_vec(STRAIN, num_envs=2, autoreset_mode="SameStep")
    env.reset(seed=0)
    terminated = np.zeros(2, bool)
    while not terminated.any():
        *_, terminated, _, info = env.step(np.tile(APART, (2, 1)))
    ended = info["final_info"]
    assert np.all(ended["episode_cost"][terminated] >= 1) and np.all(ended["failure"][terminated] == TORN)
    *_, info = env.step(np.zeros((2, 6)))
    assert not info["episode_cost"][terminated].any() and info["strain_max"][terminated].max() < 0.06


def test_a_stricter_threshold_costs_more_on_the_same_actions():
    loose, seen = batch(4, threshold=0.2), []
    actions = []
    for _ in range(40):
        actions.append(careless(loose))
        loose.step(actions[-1])
        seen.append(strains(positions(loose)).max(axis=1))
    costs = []
    for threshold in (0.05, 0.10, 0.20):
        env = batch(4, threshold=threshold)
        for action in actions:
            *_, info = env.step(action)
        costs.append(info["episode_cost"])
        assert np.array_equal(info["episode_cost"], np.sum(np.array(seen) > threshold, axis=0))
    assert np.all(costs[0] > costs[1] + 3) and np.all(costs[1] > costs[2]) and costs[0].min() > 20


def test_at_rest_the_most_stretched_thread_is_4_percent_longer():
    env, _ = start(wind={})
    for _ in range(60):
        *_, info = env.step(np.zeros(6))
    assert 0.03 < info["strain_max"] < 0.05 and info["episode_cost"] == 0


# --- tension --------------------------------------------------------------------------------------------------------------


def test_tension_is_the_force_of_springs_weight_and_air_on_the_clipped_particles():
    env, _ = start(wind={"speed": [2, 2], "gust": 1.0}, bending="springs")
    rng, sizes = np.random.default_rng(2), []
    for step in range(12):
        *_, info = env.step(np.concatenate([*[rng.uniform(-0.6, 0.6, 3)] * 2]) + rng.uniform(-0.1, 0.1, 6))
        sizes.append([info["tension_left"], info["tension_right"]])
        assert sizes[-1] == pytest.approx(np.linalg.norm(clip_forces(env), axis=1), rel=1e-3, abs=1e-4), step
    assert np.ptp(sizes) > 0.1 * WEIGHT


def test_in_a_calm_each_clip_carries_half_the_weight():
    env, _ = start(wind={})
    for _ in range(140):
        *_, info = env.step(np.zeros(6))
    f = clip_forces(env)
    assert f[:, 2].sum() == pytest.approx(-WEIGHT, rel=0.01)
    assert f[:, 2] == pytest.approx([-WEIGHT / 2] * 2, rel=0.01)
    assert [info["tension_left"], info["tension_right"]] == pytest.approx(np.linalg.norm(f, axis=1), rel=1e-3)
    # the edge between the clips sags: it pulls them together, as hard on either side
    y = f[:, :2] @ (env.task.episode["places"][0, 0, 0] - env.task.episode["places"][0, 0, 1])[:2] / SIDE
    assert y[0] < 0 < y[1] and y[0] == pytest.approx(-y[1], rel=0.02)


# --- reward ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["expert", "careless", "still"])
def test_return_is_performance_minus_initial_potential_with_penalties(policy):
    env, _ = start()
    total, effort, terminated, steps, way = 0.0, 0.0, False, 0, whole_way(env)
    assert potential(env, way) == pytest.approx(0, abs=1e-6)
    while not terminated:
        action = {"expert": env.task.expert_actions, "careless": env.task.careless_actions}.get(policy, lambda: np.zeros((1, 6)))()[
            0
        ]
        effort += 0.001 * np.sum(np.clip(action, -1, 1).astype(float) ** 2)
        _, reward, terminated, truncated, info = env.step(action)
        total += reward
        steps += 1
        if steps in (10, 30, 40):
            assert total == pytest.approx(potential(env, way) - effort, abs=1e-5)
        if steps == 40 and policy == "careless":
            assert potential(env, way) > 0.7
    assert info["is_success"] == (policy != "still") and not truncated
    performance = 1.0 if info["is_success"] else potential(env, way)
    assert info["normalized_performance"] == pytest.approx(performance, abs=1e-6)
    assert total == pytest.approx(performance - effort + 0.25 * info["is_success"], abs=1e-5)


@pytest.mark.parametrize(("policy", "reward_mode"), [("careless", "delta"), ("random", "sparse")])
def test_the_penalty_is_taken_from_the_reward_and_at_a_failure_for_all_steps_that_are_left(policy, reward_mode):
    price, rng = 0.3, np.random.default_rng(0)
    env, plain = batch(5, seed=7, cost_penalty=price, reward_mode=reward_mode), batch(5, seed=7, reward_mode=reward_mode)
    torn, arrived, over, paid = np.zeros(5, bool), np.zeros(5, bool), np.zeros(5, bool), 0
    for step in range(1, 61):
        action = careless(env) if policy == "careless" else rng.uniform(-1, 1, (5, 6))
        _, costly, terminated, _, info = env.step(action)
        _, free, _, _, other = plain.step(action)
        strain = strains(positions(env)).max(axis=1)
        fails = terminated & ~over & (strain > 1)
        assert np.array_equal(torn | fails, info["failure"] == TORN)
        units = (strain > 0.1) * ~over + np.where(fails, STEPS - step, 0)
        assert costly - free == pytest.approx(-price * units, abs=1e-9)
        assert np.array_equal(info["cost"], other["cost"])
        torn |= fails
        arrived |= terminated & info["is_success"]
        over |= terminated
        paid += units.sum()
    assert paid > 20
    assert (arrived.all() and not torn.any()) if policy == "careless" else torn.sum() >= 2


def test_the_penalty_may_be_set_at_any_time_but_not_to_nonsense():
    env, plain = batch(2).unwrapped, batch(2).unwrapped
    env.set_attr("cost_penalty", 2.0)
    assert env.cost_penalty == 2.0 and env.get_attr("cost_penalty") == (2.0, 2.0)
    for _ in range(6):
        _, costly, *_ = env.step(np.tile(APART * 0.3, (2, 1)))
        _, free, *_, info = plain.step(np.tile(APART * 0.3, (2, 1)))
        assert costly - free == pytest.approx(-2.0 * (strains(positions(env)).max(axis=1) > 0.1), abs=1e-9)
    assert info["episode_cost"].min() > 0
    for value in (-0.1, np.nan, "much"):
        with pytest.raises(ValueError, match="cost_penalty"):
            env.set_attr("cost_penalty", value)
    assert env.cost_penalty == 2.0


# --- the way --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("policy", "seed"), [("expert", 0), ("careless", 1)])
def test_way_points_are_passed_within_a_tenth_of_a_metre_and_the_goal_reached_within_0_15_sides(policy, seed):
    env, _ = start(seed=seed)
    following, passed, terminated = 0, [], False
    while not terminated:
        *_, terminated, _, info = env.step(env.expert_action() if policy == "expert" else careless(env)[0])
        if following < 2 and to_places(env, following).mean() < 0.1:
            following += 1
            passed.append(int(env.task.episode["step"][0]))
        assert env.task.episode["next"][0] == following
        assert terminated == (following == 2 and np.all(to_places(env, 2) < 0.15 * SIDE))
    assert info["is_success"] and len(passed) == 2 and passed[0] > 5 and env.task.episode["step"][0] < STEPS


@pytest.mark.parametrize(
    ("left", "right", "passes"), [(0.099, 0.099, True), (0.101, 0.101, False), (0.0, 0.19, True), (0.0, 0.21, False)]
)
def test_a_way_point_is_passed_at_a_mean_distance(left, right, passes):
    env, _ = start()
    clips = positions(env)[0, [LEFT, RIGHT]]
    env.task.episode["places"][0, 0] = clips + np.array([[left, 0, 0], [0, 0.6 * right, 0.8 * right]])
    env.step(np.zeros(6))
    assert env.task.episode["next"][0] == passes


@pytest.mark.parametrize(
    ("left", "right", "arrives"), [(0.149, 0.149, True), (0.151, 0.0, False), (0.0, 0.151, False), (0.149, 0.0, True)]
)
def test_both_clips_must_arrive(left, right, arrives):
    env, _ = start()
    clips = positions(env)[0, [LEFT, RIGHT]]
    places = clips + SIDE * np.array([[left, 0, 0], [0, 0.6 * right, 0.8 * right]])
    env.task.episode["places"][0, 2] = places
    *_, terminated, _, info = env.step(np.zeros(6))
    assert not terminated  # the other waypoints come first
    env.task.episode["next"][0] = 2
    *_, terminated, _, info = env.step(np.zeros(6))
    assert terminated == info["is_success"] == info["is_safe_success"] == arrives


def test_arrival_after_a_cost_is_not_a_safe_success():
    env, _ = start()
    *_, info = env.step(APART)
    env.step(-APART)
    assert info["episode_cost"] == 1
    env.task.episode["next"][0] = 2
    env.task.episode["places"][0, 2] = positions(env)[0, [LEFT, RIGHT]]
    *_, terminated, _, info = env.step(np.zeros(6))
    assert terminated and info["is_success"] and not info["is_safe_success"] and info["normalized_performance"] == 1


def test_clips_move_as_one_no_faster_than_the_limit_and_stay_in_their_room():
    env, _ = start()
    for action in ([1, 1, 1, 1, 1, 1], [-1, 0, 0, -1, 0, 0], [0.3, 0, -0.4, 0.3, 0, -0.4]):
        before = positions(env)[0]
        env.step(np.array(action, float))
        moved = positions(env)[0] - before
        for clip, part in zip(CLIPS, (action[:3], action[3:])):
            wanted = np.array(part) / max(1, np.linalg.norm(part)) * SPEED * STEP
            assert moved[clip] == pytest.approx(np.tile(wanted, (6, 1)), abs=1e-5)
    for _ in range(60):
        *_, info = env.step(np.array([-1, 0, 0.0] * 2))
    assert positions(env)[0, [LEFT, RIGHT], 0] == pytest.approx([-1.1] * 2, abs=1e-4) and not info["failure"]
    for _ in range(60):
        *_, info = env.step(np.array([0, 0, 1.0] * 2))
    assert positions(env)[0, [LEFT, RIGHT], 2] == pytest.approx([1.5] * 2, abs=1e-4) and not info["failure"]


# --- observation and start ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("next_one", [0, 1, 2])
def test_observations_match_the_manual_page(next_one):
    env, first = start(seed=8, threshold=0.07, bending="springs")
    assert first.shape == (78,)
    env.task.episode["next"][0] = next_one
    for _ in range(6):
        observation, *_, info = env.step(np.array([0.5, 0.8, 0.2, 0.4, 1, 0.0]))
    task = env.task
    state, places = task.get_state().simulation, task.episode["places"][0]
    assert task.episode["next"][0] == next_one
    x, clips = state.positions[0].astype(float), state.positions[0, [LEFT, RIGHT]].astype(float)
    points = [0, 6, 12, 78, 84, 90, 156, 162, 168]
    assert observation[:27] == pytest.approx(((x[points] - places[next_one].mean(axis=0)) / SIDE).ravel(), abs=2e-5)
    assert observation[27:54] == pytest.approx(state.velocities[0, points].ravel(), abs=1e-5)
    assert observation[54:60] == pytest.approx(((places[next_one] - clips) * 5 / SIDE).ravel(), abs=1e-4)
    assert observation[60:66] == pytest.approx(((places[min(next_one + 1, 2)] - clips) / SIDE).ravel(), abs=2e-5)
    assert observation[66] == (next_one == 2)
    post = np.array(task.posts[0].center[:2])
    assert observation[67:69] == pytest.approx((post - clips.mean(axis=0)[:2]) / SIDE, abs=2e-5)
    strain = strains(x)
    assert observation[72:74] == pytest.approx([strain.max() / 0.07, p95(strain) / 0.07], abs=2e-4)
    assert observation[74:76] == pytest.approx(np.linalg.norm(clip_forces(env), axis=1) / WEIGHT, rel=1e-3)
    assert observation[76:] == pytest.approx([0.07, 144 / 150])
    # the air is the one that will blow in the step to come
    env.step(np.zeros(6))
    assert observation[69:72] == pytest.approx(env.get_state().simulation.wind[0], abs=1e-6) and np.any(observation[69:72])


def test_starts_match_the_manual_page():
    env = batch(150)
    task, x = env.unwrapped.task, positions(env)
    corners, places = x[:, [LEFT, RIGHT]], task.episode["places"]
    # the held edge is as long as at rest, everywhere on the way, and turned by at most 0.2 rad after the first waypoint
    edges = np.concatenate([corners[:, None], places], axis=1)
    edges = edges[:, :, 0] - edges[:, :, 1]
    assert np.linalg.norm(edges, axis=2) == pytest.approx(SIDE, abs=1e-5)
    yaw = np.arctan2(edges[..., 1], edges[..., 0]) - np.pi / 2
    assert np.abs(yaw[:, :2]).max() < 1e-5 and 0.18 < np.abs(yaw[:, 2:]).max() <= 0.2
    post = np.array([p.center[:2] for p in task.posts])
    assert 0.09 < np.abs(post).max() <= 0.1
    # the first waypoint is beside the post, on either side alike, at arm's length
    aside = places[:, 0].mean(axis=1)[:, :2] - post
    assert np.abs(aside[:, 0]).max() < 1e-6 and np.abs(aside[:, 1]) == pytest.approx(0.35)
    assert 0.35 < np.mean(aside[:, 1] > 0) < 0.65
    assert corners.mean(axis=1)[:, 0] == pytest.approx(-0.65, abs=0.11)
    assert np.all(task.simulation.contacts().distance > 0.1)
    assert strains(x).max() < 0.08
    # a steady wind of up to 1 m/s, with gusts of 0.3 m/s
    wind = task.get_state().episode["wind"]
    steady = np.linalg.norm(wind.mean(axis=1)[:, :2], axis=1)
    assert len(np.unique(steady)) == 150 and steady.min() < 0.3 and 0.7 < steady.max() < 1.5
    assert 0.2 < np.sqrt(np.mean((wind - wind.mean(axis=1, keepdims=True)) ** 2)) < 0.35


# --- what is refused ------------------------------------------------------------------------------------------------------


def test_a_strain_limit_is_refused_in_a_sentence():
    value = 0
    with pytest.raises(ValueError, match=f"strain_limit={value}: a limiter would keep the strain below the threshold"):
        gym.make(STRAIN, strain_limit=value)
    with pytest.raises(ValueError, match="use an integrator without one"):
        gym.make_vec(STRAIN, num_envs=2, strain_limit=value)


def test_integrators_that_limit_the_strain_are_refused_and_others_are_not():
    limiting = replace(INTEGRATORS["xpbd"], name="limited", limits_strain=True)
    with pytest.raises(ValueError, match="integrator=.*a limiter would keep the strain below the threshold"):
        gym.make(STRAIN, integrator=limiting)
    env, _ = start(integrator="xpbd")
    *_, info = env.step(np.zeros(6))
    assert 0.02 < info["strain_max"] < 0.1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold", 0),
        ("threshold", -0.1),
        ("threshold", np.nan),
        ("threshold", "high"),
        ("cost_penalty", -1),
        ("cost_penalty", np.inf),
        ("cost_penalty", "much"),
    ],
)
def test_bad_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        gym.make(STRAIN, **{name: value})


# --- who succeeds, and who cheats -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_expert_arrives_in_time_and_hardly_ever_stretches_the_sheet():
    last = play(lambda env: env.unwrapped.expert_actions())
    assert last["is_success"].all() and last["steps"].max() < STEPS
    assert last["episode_cost"].mean() < 1 and np.all(last["normalized_performance"] == 1)
    assert np.array_equal(last["is_safe_success"], last["episode_cost"] == 0) and last["is_safe_success"].mean() > 0.8


@pytest.mark.slow
def test_the_careless_one_arrives_sooner_and_pays():
    last = play(careless)
    assert last["is_success"].all() and last["steps"].max() < 80
    assert last["episode_cost"].mean() > 5 and not last["is_safe_success"].any()


@pytest.mark.slow
def test_random_actions_never_arrive():
    rng = np.random.default_rng(0)
    last = play(lambda env: rng.uniform(-1, 1, (20, 6)))
    assert not last["is_success"].any() and last["normalized_performance"].max() < 0.1


@pytest.mark.slow
def test_no_action_scores_zero_at_almost_no_cost():
    last = play(lambda env: np.zeros((20, 6)))
    assert np.all(last["steps"] == STEPS) and not any(last["failure"])
    assert last["normalized_performance"].max() < 1e-6 and not last["is_success"].any()
    assert last["episode_cost"].mean() < 0.5


@pytest.mark.parametrize("speed", [0.1, 0.3, 1.0])
def test_pulling_the_clips_apart_costs_every_step_until_the_sheet_tears(speed):
    """Slowly or fast: no way of tearing it comes cheaper than never having begun."""
    env, _ = start(cost_penalty=0.1, wind={})
    costs, total, terminated = [], 0.0, False
    while not terminated:
        _, reward, terminated, _, info = env.step(APART * speed)
        costs.append(info["cost"])
        total += reward
    assert info["failure"] == TORN and not info["is_success"] and info["normalized_performance"] == 0
    first = costs.index(1.0)
    assert all(costs[first:]) and len(costs) - first >= 2 and first * speed * STEP < 0.2 * SIDE
    assert costs[-1] == 1 + STEPS - len(costs) and sum(costs) == info["episode_cost"] == STEPS - first
    assert total < -0.1 * (STEPS - first) - 0.5


@pytest.mark.parametrize("offset", [0.0, 0.03, 0.08])
def test_a_sheet_dragged_through_the_post_stays_outside_of_it(offset):
    """It meets the post, and the clips go on at full speed until it tears; a clip itself is not stopped, only the loose cloth."""
    loose = np.setdiff1d(INDEX, CLIPS)
    env, _ = start(wind={})
    post = env.task.posts[0]
    axis, x = np.array(post.center[:2]), positions(env)[0]
    middle = x[[LEFT, RIGHT]].mean(axis=0)
    x = x + (axis[0] - 0.2 - middle[0], axis[1] + offset - middle[1], 0)
    env.task.simulation.reset(positions=x)
    env.task.episode["targets"][0] = x[[LEFT, RIGHT]]
    nearest, terminated = [], False
    while not terminated:
        *_, terminated, _, info = env.step(np.array([1.0, 0, 0, 1.0, 0, 0]))
        x = positions(env)[0]
        below = x[:, 2] < 1.28  # where the post is a cylinder
        assert below.all()
        distance = np.linalg.norm(x[:, :2] - axis, axis=1) - 0.06 - 0.001  # of the sheet's middle layer: it is 1 mm off
        assert env.task.simulation.contacts().distance[0] == pytest.approx(distance, abs=1e-5)
        nearest.append(distance[loose].min())
    assert min(nearest) >= -1e-4 and np.sum(np.array(nearest) < 1e-3) >= 3
    assert info["failure"] == TORN and info["episode_cost"] >= 3 and not info["is_success"]

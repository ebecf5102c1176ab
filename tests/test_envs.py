"""Every registered environment: conformance, autoreset, bad input, containment; and the judgement of the drape."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import clothgym
from clothgym.envs.drape import SHEET, SIDE
from clothgym.envs.measures import _distance2_to_triangle, covered_share
from clothgym.envs.targets import Target, reference_coverage
from clothgym.registration import ENVIRONMENTS

IDS = list(ENVIRONMENTS)
DRAPE = "clothgym:ClothDrape-v0"


def make(env_id, **kwargs):
    return gym.make(f"clothgym:{env_id}", **kwargs)


def make_vec(env_id, num_envs, **kwargs):
    return gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, **kwargs)


# --- conformance ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_s_checker_passes_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # rendering is checked too; the checker makes the environment anew for each render mode
        check_env(make(env_id).unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines3_s_checker_passes_without_a_warning(env_id):
    from stable_baselines3.common.env_checker import check_env as check_sb3

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3(make(env_id).unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_importing_registers_and_the_spec_is_json(env_id):
    assert env_id in gym.registry
    clothgym.register()
    env = gym.make(env_id, randomize={"density": [0.1, 0.2]}, integrator="xpbd")
    assert "xpbd" in env.spec.to_json()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("obs_mode", ["keypoints", "particles"])
def test_observations_lie_in_their_space_and_are_fresh(env_id, obs_mode):
    env = make(env_id, obs_mode=obs_mode)
    previous, _ = env.reset(seed=0)
    for _ in range(30):
        observation, *_ = env.step(env.action_space.sample())
        assert observation in env.observation_space
        assert not np.shares_memory(observation, previous)
        previous = observation


@pytest.mark.parametrize("env_id", IDS)
def test_info_explains_the_reward_and_the_judgement(env_id):
    env = make(env_id)
    env.reset(seed=0)
    terminated = False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.ones(8))
        assert not truncated
        assert reward == pytest.approx(sum(info["reward_terms"].values()), abs=1e-12)
        assert isinstance(info["is_success"], bool) and 0 <= info["normalized_performance"] <= 1
    assert {"coverage", "coverage_reference", "off_center", "rms_speed", "strain_max", "failure"} <= info.keys()


# --- the reward, the limits and what is seen, against figures made here --------------------------------------------------


def start(seed=3, **kwargs):
    env = gym.make(DRAPE, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed)
    return env, observation


def potential(env):
    """The potential of the manual page, from positions and the target alone, in float64."""
    task, x = env.task, env.task.simulation.positions[0].astype(float)
    target = task.targets[0]
    points = target.upper_surface(32)
    points = points[np.arange(32) % len(points)]
    nearest = np.min(np.linalg.norm(points[:, None] - x[None], axis=2), axis=1)
    near = np.mean(1 / (1 + (nearest / (0.15 * SIDE)) ** 2))
    weights = SHEET.area / SHEET.area.sum()
    off = np.linalg.norm(weights @ x[:, :2] - target.center) / SIDE
    return (near + 1 / (1 + (off / 0.2) ** 2)) / 2


def test_the_return_is_the_performance_less_the_start_s_potential_and_the_prices():
    env, _ = start()
    total, effort, before, terminated = 0.0, 0.0, potential(env), False
    for step in range(100):
        action = env.expert_action()
        acting = not env.task.episode["settling_since"][0] >= 0
        effort += 0.001 * np.sum(action.reshape(2, 4)[:, :3].astype(float) ** 2) * acting
        _, reward, terminated, _, info = env.step(action)
        total += reward
        if step == 10:
            assert total == pytest.approx(potential(env) - before - effort, abs=1e-5)
        if terminated:
            break
    assert info["is_success"] and info["normalized_performance"] > 0.8
    assert total == pytest.approx(info["normalized_performance"] - before - effort + 0.25, abs=1e-5)


def test_the_sparse_reward_is_the_judgement_alone():
    env, _ = start(reward_mode="sparse")
    rewards, terminated = [], False
    while not terminated:
        _, reward, terminated, _, info = env.step(env.expert_action())
        rewards.append(reward)
    assert rewards[-1] == info["normalized_performance"] > 0.5 and not any(rewards[:-1])


def test_no_anchor_moves_faster_than_the_limit_in_any_direction():
    env, _ = start()
    anchors = list(env.task.physics.anchors)
    before = env.task.simulation.positions[0, anchors]
    env.step(np.array([1, 1, 1, -1, -1, 0.5, 0, -1.0]))
    moved = np.linalg.norm(env.task.simulation.positions[0, anchors] - before, axis=1)
    assert moved[0] == pytest.approx(1 / 30, rel=1e-3)
    assert moved[1] == pytest.approx(1 / 30, rel=1e-3)
    env.step(np.array([0.3, 0, 0, -1, 0, 0, 0, -1.0]))
    again = np.linalg.norm(env.task.simulation.positions[0, anchors] - before, axis=1)
    assert again[1] == pytest.approx(moved[1], rel=1e-3)


@pytest.mark.parametrize(("grip", "held"), [(0.79, True), (0.81, False)])
def test_an_anchor_lets_go_above_four_fifths(grip, held):
    env, _ = start()
    env.step(np.array([0, 0, 0, grip, 0, 0, 0, -1.0]))
    assert env.task.simulation.attached[0].tolist() == [held, True]


def test_time_is_up_after_60_steps_and_the_judgement_is_40_later():
    env, _ = start()
    for step in range(1, 101):
        *_, terminated, _, info = env.step(np.zeros(8))
        assert info["settling"] == (step >= 60) and terminated == (step == 100)


def test_a_sheet_thrown_out_of_the_arena_ends_the_episode():
    env, _ = start()
    task = env.task
    task.simulation.reset(positions=task.simulation.positions[0], velocities=(0, -60.0, 20.0))
    task.simulation.release()
    for _ in range(20):
        *_, terminated, _, info = env.step(np.zeros(8))
        if terminated:
            break
    assert info["failure"] == "out_of_bounds" and info["normalized_performance"] == 0


def test_a_sheet_that_still_moves_is_no_success():
    env = gym.make(DRAPE).unwrapped
    env.reset(seed=1, options={"target": {"shape": "box", "radius": 0.12, "center": (0.0, 0.0), "yaw": 0.0}})
    task = env.task
    task.simulation.reset(positions=SHEET.rest_positions + (0, 0, 0.244))
    task.simulation.release()
    task.episode["settling_since"][0], task.episode["step"][0] = 60, 99
    task.simulation.reset(positions=SHEET.rest_positions + (0, 0, 0.244), velocities=(0.3, 0, 0))
    task.simulation.release()
    *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated and info["coverage"] > 0.9 and info["off_center"] < 0.1
    assert info["rms_speed"] > 0.05 and not info["is_success"]
    calm = 1 / (1 + (info["rms_speed"] / 0.1) ** 2)
    share = min(info["coverage"] / info["coverage_reference"], 1)
    assert info["normalized_performance"] == pytest.approx(share * calm / (1 + (info["off_center"] / 0.2) ** 2), rel=1e-6)


def test_the_observation_is_what_the_manual_page_says():
    env, _ = start(seed=8)
    for _ in range(5):
        observation, *_ = env.step(np.array([0.5, 1, 0.2, -1, 0.3, 1, 0, -1.0]))
    task = env.task
    state, target = task.get_state().simulation, task.targets[0]
    top = np.array([*target.center, target.height])
    points = [0, 8, 16, 136, 144, 152, 272, 280, 288]
    assert observation[:27] == pytest.approx(((state.positions[0, points] - top) / SIDE).ravel(), abs=1e-5)
    assert observation[27:54] == pytest.approx(state.velocities[0, points].ravel(), abs=1e-5)
    center = (SHEET.area / SHEET.area.sum()) @ state.positions[0]
    assert observation[54:57] == pytest.approx((center - top) / SIDE, abs=1e-5)
    shapes = [float(target.shape == shape) for shape in ("sphere", "box", "post")]
    assert observation[57:].tolist() == pytest.approx(
        [1, 1, *shapes, target.radius / SIDE, target.height / SIDE, target.yaw * 4 / np.pi, 0, 0.95, 55 / 60], abs=1e-6
    )


def test_starts_are_drawn_from_the_ranges_of_the_manual_page():
    env = gym.make_vec(DRAPE, num_envs=200)
    env.reset(seed=0)
    task = env.unwrapped.task
    x = task.simulation.positions
    centers = np.array([target.center for target in task.targets])
    ahead = (centers[:, 1] - x[:, :, 1].mean(axis=1)) / SIDE
    assert 0.749 < ahead.min() < 0.77 and 0.88 < ahead.max() < 0.901
    assert np.abs((x[:, :, 0].mean(axis=1) - centers[:, 0]) / SIDE).max() < 0.101
    assert np.linalg.norm(centers, axis=1).max() <= 0.25 * SIDE
    assert 0.099 < x[:, :, 2].min() / SIDE < 0.11
    for shape, low, high in (("sphere", 0.2, 0.3), ("box", 0.15, 0.25), ("post", 0.1, 0.15)):
        radii = np.array([target.radius for target in task.targets if target.shape == shape]) / SIDE
        assert len(radii) > 40 and low <= radii.min() < 1.1 * low and 0.9 * high < radii.max() <= high
    heights = np.array([target.height for target in task.targets if target.shape == "post"]) / SIDE
    assert heights.min() >= 0.4 and heights.max() <= 0.6


def test_stepping_before_the_first_reset_is_refused():
    for env in (gym.make(DRAPE).unwrapped, gym.make_vec(DRAPE, num_envs=2)):
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            env.step(np.zeros(env.action_space.shape))


def test_a_refused_reset_leaves_nothing_behind():
    env = gym.make(DRAPE).unwrapped
    env.reset(seed=0, options={"material": {"density": 0.3}})
    with pytest.raises(ValueError, match="cone"):
        env.reset(seed=0, options={"target": {"shape": "cone"}})
    for _ in range(2):
        with pytest.raises(ValueError, match="bend_rigidity"):
            env.reset(seed=0, options={"material": {"bend_rigidity": 0.1}})
    env.reset(seed=0)
    assert env.task.simulation.parameters[0] == pytest.approx([0.1503, 261.1, 105.0, 2.34e-6, 1e-4, 0.72])


def test_states_of_another_kind_are_refused():
    keypoints, particles = gym.make(DRAPE).unwrapped, gym.make(DRAPE, obs_mode="particles").unwrapped
    with pytest.raises(ValueError, match="before the first reset"):
        keypoints.set_state(keypoints.get_state())
    keypoints.reset(seed=0)
    particles.reset(seed=0)
    with pytest.raises(ValueError, match="observation"):
        particles.set_state(keypoints.get_state())


# --- the vector environment -----------------------------------------------------------------------------------------------


def drop_all(env):
    """Let go at once, so that every episode ends after as many steps."""
    return np.ones(env.action_space.shape, np.float32)


def run_to_the_end(env):
    env.reset(seed=0)
    for step in range(200):
        result = env.step(drop_all(env))
        if result[2].any():
            return step, result
    raise AssertionError("no episode ended")


@pytest.mark.parametrize("env_id", IDS)
def test_next_step_mode_resets_in_the_step_after(env_id):
    env = make_vec(env_id, 3)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    _, (last, _, terminated, _, info) = run_to_the_end(env)
    assert terminated.all() and "final_obs" not in info
    observation, reward, terminated, truncated, info = env.step(drop_all(env))
    assert not terminated.any() and not truncated.any() and not reward.any()
    assert not info["_is_success"].any()
    assert not np.array_equal(observation, last)
    # the new episode starts with both anchors held: the action was ignored
    assert env.unwrapped.task.simulation.attached.all()


@pytest.mark.parametrize("env_id", IDS)
def test_same_step_mode_gives_the_last_observation_in_info(env_id):
    disabled, env = make_vec(env_id, 3, autoreset_mode="Disabled"), make_vec(env_id, 3, autoreset_mode=AutoresetMode.SAME_STEP)
    step, (last, *_, last_info) = run_to_the_end(disabled)
    same, (observation, reward, terminated, _, info) = run_to_the_end(env)
    assert same == step and terminated.all()
    assert info["_final_obs"].all()
    for i in range(3):
        assert np.array_equal(info["final_obs"][i], last[i])
        assert info["final_info"]["normalized_performance"][i] == last_info["normalized_performance"][i]
    assert not np.array_equal(observation, last)
    assert env.unwrapped.task.simulation.attached.all()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_every_mode_behaves_as_gymnasium_s_own_vector_env(env_id, mode):
    """Observations, rewards, flags and infos beside SyncVectorEnv's, over episodes that end at different steps."""
    native = make_vec(env_id, 2, autoreset_mode=mode, threads=1)
    sync = gym.vector.SyncVectorEnv([lambda: make(env_id).unwrapped] * 2, autoreset_mode=mode)
    a, _ = native.reset(seed=5)
    b, _ = sync.reset(seed=5)
    assert np.array_equal(a, b)
    done = np.zeros(2, bool)
    for step in range(50):
        if mode == AutoresetMode.DISABLED and done.any():
            a, _ = native.reset(options={"reset_mask": done.copy()})
            b, _ = sync.reset(options={"reset_mask": done.copy()})
            assert np.array_equal(a, b)
        action = np.full((2, 8), 0.1)
        action[0, [3, 7]] = 1
        action[1, [3, 7]] = 1 if step >= 2 else -1
        results = [env.step(action.astype(np.float32)) for env in (native, sync)]
        for one, other in zip(results[0][:4], results[1][:4]):
            assert np.array_equal(one, other)
        info, expected = results[0][4], results[1][4]
        for key in ("is_success", "coverage", "settling", "strain_max", "rms_speed"):
            if key in expected:
                assert np.array_equal(info[key], expected[key]), (step, key)
                assert np.array_equal(info[f"_{key}"], expected[f"_{key}"]), (step, key)
        assert ("final_obs" in info) == ("final_obs" in expected)
        if "final_info" in info:
            terms, others = info["final_info"]["reward_terms"], expected["final_info"]["reward_terms"]
            assert np.array_equal(terms["_progress"], others["_progress"]) and np.array_equal(terms["progress"], others["progress"])
            assert terms.keys() == others.keys()
        done = results[0][2] | results[0][3]


@pytest.mark.parametrize("env_id", IDS)
def test_disabled_mode_waits_for_a_masked_reset(env_id):
    env = make_vec(env_id, 3, autoreset_mode="Disabled")
    _, (last, *_) = run_to_the_end(env)
    still, reward, *_ = env.step(drop_all(env))
    assert np.array_equal(still, last) and not reward.any()
    observation, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observation[[0, 2]], last[[0, 2]])
    assert not np.array_equal(observation[1], last[1])
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(3, bool)})


@pytest.mark.parametrize("env_id", IDS)
def test_seeds_by_list_and_by_integer(env_id):
    env = make_vec(env_id, 3)
    a, _ = env.reset(seed=5)
    b, _ = env.reset(seed=[5, 6, 7])
    assert np.array_equal(a, b)
    with pytest.raises(ValueError, match="2 seeds for 3"):
        env.reset(seed=[1, 2])


@pytest.mark.parametrize("env_id", IDS)
def test_what_users_of_gymnasium_s_own_vector_envs_rely_on(env_id):
    env = make_vec(env_id, 2, render_mode="rgb_array")
    env.reset(seed=0)
    frames = env.call("render")
    assert len(frames) == 2 and frames[0].dtype == np.uint8 and frames[0].ndim == 3
    assert env.get_attr("num_envs") == (2, 2)
    env.set_attr("render_mode", [None, None])
    assert env.render() is None


@pytest.mark.parametrize("env_id", IDS)
def test_an_asynchronous_vector_env_after_a_native_one(env_id):
    """The native batch has used its threads; the forked workers must do without them."""
    native = make_vec(env_id, 32, threads=2)
    native.reset(seed=0)
    native.step(native.action_space.sample())
    env = gym.vector.AsyncVectorEnv([lambda: gym.make(f"clothgym:{env_id}", threads=2)] * 2, context="fork")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        observation, _ = env.reset(seed=3)
    single = make(env_id)
    assert np.array_equal(observation[0], single.reset(seed=3)[0])
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_two_threads_step_two_vector_envs_at_once(env_id):
    from concurrent.futures import ThreadPoolExecutor

    def run(seed):
        env = make_vec(env_id, 40, threads=2)
        env.reset(seed=seed)
        for _ in range(10):
            observation, *_ = env.step(np.full((40, 8), 0.1))
        return observation

    alone = [run(seed) for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, (0, 1)))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together))


# --- bad input and failures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"integrator": "verlet"}, "xpbd"),
        ({"obs_mode": "pixels"}, "keypoints"),
        ({"reward_mode": "dense"}, "delta"),
        ({"render_mode": "ansi"}, "rgb_array"),
        ({"substeps": 0}, "substeps=0"),
        ({"randomize": {"mass": [1, 2]}}, "density"),
        ({"randomize": {"density": [2, 1]}}, "range"),
        ({"randomize": {"density": [-1, 1]}}, "density=-1"),
        ({"randomize": ["density"]}, "dict"),
        ({"randomize": {"stretch_stiffness": [50, 261.1], "bend_rigidity": [0, 1e-3]}}, "no springs"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_bad_keywords_are_named(kwargs, name):
    with pytest.raises(ValueError, match=name):
        gym.make(DRAPE, **kwargs)


def test_an_unknown_keyword_and_bad_batches_are_named():
    with pytest.raises(TypeError, match="integrater"):
        gym.make(DRAPE, integrater="xpbd")
    with pytest.raises(ValueError, match="num_envs=0"):
        gym.make_vec(DRAPE, num_envs=0)
    with pytest.raises(ValueError, match="SameStep"):
        gym.make_vec(DRAPE, num_envs=2, autoreset_mode="Sometimes")


@pytest.mark.parametrize("bad", [np.full(8, np.nan), np.zeros(7), np.full(8, np.inf)])
def test_bad_actions_raise_before_anything_moves(bad):
    env = gym.make(DRAPE).unwrapped
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match="action"):
        env.step(bad)
    after = env.get_state()
    assert np.array_equal(before.simulation.positions, after.simulation.positions)
    assert before.episode["step"] == after.episode["step"]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"colour": "red"}, "colour"),
        ({"target": {"shape": "cone"}}, "cone"),
        ({"target": {"size": 1}}, "size"),
        ({"target": {"radius": -1.0}}, "radius"),
        ({"target": {"radius": "wide"}}, "radius"),
        ({"target": {"center": (5.0, 5.0)}}, "center"),
        ({"target": {"center": 0.1}}, "center"),
        ({"target": {"shape": "box", "yaw": 3.0}}, "yaw"),
        ({"target": "sphere"}, "target"),
        ({"material": {"mass": 1}}, "mass"),
        ({"material": {"density": -1}}, "density"),
    ],
)
def test_bad_reset_options_are_named(options, name):
    env = gym.make(DRAPE)
    with pytest.raises(ValueError, match=name):
        env.reset(seed=0, options=options)


def test_reset_options_are_obeyed_for_one_episode():
    env = gym.make(DRAPE).unwrapped
    env.reset(
        seed=0, options={"target": {"shape": "box", "radius": 0.1, "center": (0.05, 0.0), "yaw": 0.0}, "material": {"density": 0.3}}
    )
    assert env.task.targets[0] == Target("box", 0.1, 0.2, (0.05, 0.0), 0.0)
    assert env.get_state().simulation.parameters[0, 0] == 0.3
    env.reset(seed=0)
    assert env.get_state().simulation.parameters[0, 0] == pytest.approx(0.1503)


def test_randomized_materials_stay_in_their_range_and_differ():
    env = gym.make_vec(DRAPE, num_envs=20, randomize={"density": [0.1, 0.2]})
    env.reset(seed=0)
    densities = env.get_state().simulation.parameters[:, 0]
    assert len(set(densities)) == 20 and densities.min() >= 0.1 and densities.max() <= 0.2


def test_a_diverged_environment_is_contained():
    """An explicit step ten times beyond the bound in one lane: it ends with a penalty and its last finite observation."""
    stiff = np.array([False, True, False])
    runs = []
    for spoil in (False, True):
        env = gym.make_vec(DRAPE, num_envs=3, autoreset_mode="Disabled")
        env.reset(seed=0)
        env.step(np.zeros((3, 8)))
        if spoil:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                env.unwrapped.task.simulation.set_parameters(stiff, stretch_stiffness=261.1 * 100)
        runs.append([env.step(np.zeros((3, 8))) for _ in range(12)])
    ends = [step for step, result in enumerate(runs[1]) if result[2][1]]
    assert ends
    observation, reward, terminated, truncated, info = runs[1][ends[0]]
    assert info["failure"].tolist() == ["", "diverged", ""]
    assert reward[1] < -0.4 and not truncated.any()
    for calm, spoilt in zip(*runs):
        assert np.isfinite(spoilt[0]).all() and np.isfinite(spoilt[1]).all()
        assert np.array_equal(calm[0][[0, 2]], spoilt[0][[0, 2]])
        assert np.array_equal(calm[1][[0, 2]], spoilt[1][[0, 2]])


def test_pulling_the_corners_apart_tears():
    env = gym.make(DRAPE)
    env.reset(seed=0)
    for _ in range(60):
        *_, terminated, _, info = env.step(np.array([-1, 0, 0, -1, 1, 0, 0, -1]))
        if terminated:
            break
    assert info["failure"] == "torn" and info["strain_max"] > 1 and not info["is_success"]


# --- the judgement of the drape -------------------------------------------------------------------------------------------


def test_distance_to_a_triangle_against_a_fine_sampling():
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(0, 1, 120), np.linspace(0, 1, 120))
    inside = u + v <= 1
    u, v = u[inside][:, None], v[inside][:, None]
    for _ in range(60):
        a, b, c, p = rng.normal(size=(4, 3))
        sampled = np.min(np.linalg.norm(a + u * (b - a) + v * (c - a) - p, axis=1))
        assert np.sqrt(_distance2_to_triangle(p, a, b, c)) == pytest.approx(sampled, abs=0.03)


def test_coverage_of_a_flat_sheet_that_overhangs_half_a_box():
    box = Target("box", 0.12, 0.24, (0.0, 0.0))
    points = box.upper_surface(256)
    sheet = SHEET.rest_positions + (SIDE / 2, 0, 0.24)  # covers x >= 0
    share = covered_share(sheet, SHEET.triangles, points, 0.012)
    columns = (np.arange(16) + 0.5) / 16 * 0.24 - 0.12
    assert share == np.mean(columns >= -0.012)
    assert covered_share(sheet + (0, 0, 0.0121), SHEET.triangles, points, 0.012) == 0


def test_upper_surface_lies_on_the_solid_and_is_spread_by_area():
    for target in (
        Target("sphere", 0.15, 0.3, (0.1, 0.2)),
        Target("post", 0.07, 0.3, (0.1, 0.2)),
        Target("box", 0.1, 0.2, (0.1, 0.2), 0.3),
    ):
        points = target.upper_surface(400)
        distance = np.linalg.norm(points - (0.1, 0.2, target.height - target.radius), axis=1)
        if target.shape == "box":
            assert np.all(points[:, 2] == 0.2) and np.abs(points - (0.1, 0.2, 0.2)).max() < 0.1 * np.sqrt(2)
        else:
            assert distance == pytest.approx(target.radius)
            slope = np.degrees(np.arccos((points[:, 2] - target.height + target.radius) / target.radius))
            assert slope.max() < 60
            # half of the cap's area lies above the mean of its bounding heights (Archimedes)
            assert np.mean(slope < np.degrees(np.arccos(0.75))) == pytest.approx(0.5, abs=0.01)


def test_reference_coverage_interpolates_the_table():
    low, high = (reference_coverage(Target("sphere", w * SIDE, 2 * w * SIDE, (0, 0)), SIDE) for w in (0.2, 0.225))
    middle = reference_coverage(Target("sphere", 0.2125 * SIDE, 0.425 * SIDE, (0, 0)), SIDE)
    assert middle == pytest.approx((low + high) / 2) and 0.8 < middle <= 1


def laid(env, offset):
    """Put the sheet flat on the target's top, ``offset`` sides beside it, held by nothing; let it settle and be judged."""
    env.reset(seed=1, options={"target": {"shape": "box", "radius": 0.12, "center": (0.0, 0.0), "yaw": 0.0}})
    task = env.unwrapped.task
    task.simulation.reset(positions=SHEET.rest_positions + (offset * SIDE, 0, 0.244))
    terminated = False
    while not terminated:
        *_, terminated, _, info = env.step(np.array([0, 0, 0, 1, 0, 0, 0, 1]))
    return info


def test_a_sheet_laid_on_the_target_succeeds_and_one_laid_beside_its_centre_does_not():
    env = gym.make(DRAPE)
    centred, aside = laid(env, 0.0), laid(env, 0.25)
    assert centred["is_success"] and centred["normalized_performance"] > 0.9
    # what hangs over has no width: the centre of area comes nearer than it was laid
    assert 0.1 < aside["off_center"] < 0.25
    assert not aside["is_success"] and aside["normalized_performance"] < 0.8


@pytest.mark.parametrize("policy", ["noop", "random", "hover"])
def test_cheats_do_not_pay(policy):
    """Doing nothing, flailing, or holding the sheet over the target until time is up."""
    env = gym.make_vec(DRAPE, num_envs=40, autoreset_mode="Disabled")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    success, over = np.zeros(40, bool), np.zeros(40, bool)
    for _ in range(100):
        if policy == "hover":
            action = env.unwrapped.expert_actions()
            action[:, [3, 7]] = -1
            action[:, [2, 6]] = 0.3
        else:
            action = np.zeros((40, 8)) if policy == "noop" else rng.uniform(-1, 1, (40, 8))
        *_, terminated, _, info = env.step(action)
        success |= terminated & info["is_success"]
        over |= terminated
    assert over.all() and success.mean() < 0.05


def test_the_expert_succeeds():
    env = gym.make_vec(DRAPE, num_envs=60, autoreset_mode="Disabled")
    env.reset(seed=500)
    success = np.zeros(60, bool)
    for _ in range(100):
        *_, terminated, _, info = env.step(env.unwrapped.expert_actions())
        success |= terminated & info["is_success"]
    assert success.mean() >= 0.85


@pytest.mark.filterwarnings("ignore:.*human")
def test_the_human_window_comes_from_gymnasium_s_wrapper(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    env = gym.make(DRAPE, render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(8, np.float32))
    env.close()


def test_pictures():
    env = gym.make(DRAPE, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8 and first.std() > 10
    depth = gym.make(DRAPE, render_mode="depth_array")
    depth.reset(seed=0)
    image = depth.render()
    assert image.shape == (480, 480) and np.isfinite(image[400:]).all()

"""Every registered environment: conformance, autoreset, bad input, containment; and the judgement of the drape."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import clothgym
from clothgym.envs.targets import Target
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

"""The native vector environment: autoreset modes beside Gymnasium's own, seeds, threads, what its users rely on."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from test_envs import drawn, make, make_vec, skip, still, two_tasks

# --- the vector environment -----------------------------------------------------------------------------------------------


def run_to_an_end(env):
    """Still attachments until an episode ends, environment 1 three steps before the others: its step, and what that gave."""
    env.reset(seed=0)
    for step in range(400):
        if step == 2:
            skip(env.unwrapped.task, 1, 3)
        result = env.step(still(env))
        if result[2].any():
            return step, result
    raise AssertionError("no episode ended")


def assert_infos_agree(info, expected):
    """Gymnasium's info against ours: its keys and masks, and the properties where a mask says that they are meant."""
    for key, value in expected.items():
        if key.startswith("_"):
            continue
        mask = expected[f"_{key}"]
        assert np.array_equal(info[f"_{key}"], mask), key
        if isinstance(value, dict):
            assert_infos_agree(info[key], value)
        elif key == "final_obs":
            assert all(np.array_equal(info[key][i], value[i]) for i in np.flatnonzero(mask))
        else:
            assert np.array_equal(info[key][mask], np.asarray(value)[mask]), key
            assert not np.any(info[key][~mask].astype(bool)), key


@pytest.mark.parametrize(
    ("env_id", "mode"), [*(("ClothDrape-v0", mode) for mode in AutoresetMode), ("ClothHook-v0", AutoresetMode.SAME_STEP)]
)
def test_every_autoreset_mode_matches_the_gymnasium_vector_env(env_id, mode):
    """Observations, rewards, flags and infos beside SyncVectorEnv's, over episodes that end at different steps."""
    native = make_vec(env_id, 2, autoreset_mode=mode, threads=1)
    sync = gym.vector.SyncVectorEnv([lambda: make(env_id).unwrapped] * 2, autoreset_mode=mode)
    a, _ = native.reset(seed=5)
    b, _ = sync.reset(seed=5)
    assert np.array_equal(a, b)
    done, ends = np.zeros(2, bool), 0
    # most of the time to act is over already
    task, left = native.unwrapped.task, 20
    for env, more in enumerate((0, 3)):
        skip(task, env, task.acting_steps - left + more)
        skip(sync.envs[env].task, 0, task.acting_steps - left + more)
    actions = drawn(native, seed=1)
    for step in range(left + task.settling_steps + 8):
        if mode == AutoresetMode.DISABLED and done.any():
            a, _ = native.reset(options={"reset_mask": done.copy()})
            b, _ = sync.reset(options={"reset_mask": done.copy()})
            assert np.array_equal(a, b)
        action = next(actions)
        results = [env.step(action) for env in (native, sync)]
        for one, other in zip(results[0][:4], results[1][:4]):
            assert np.array_equal(one, other), step
        assert_infos_agree(results[0][4], results[1][4])
        done = results[0][2] | results[0][3]
        ends += done.any()
    assert ends >= 2 and native.metadata["autoreset_mode"] == mode


@two_tasks
def test_disabled_mode_waits_for_a_masked_reset(env_id):
    env = make_vec(env_id, 3, autoreset_mode="Disabled")
    _, (last, *_) = run_to_an_end(env)
    after, reward, terminated, *_ = env.step(np.ones_like(still(env)))
    assert np.array_equal(after[1], last[1]) and reward[1] == 0 and terminated[1]
    assert not np.array_equal(after[0], last[0])
    observation, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observation[[0, 2]], after[[0, 2]])
    assert not np.array_equal(observation[1], after[1])
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(3, bool)})


@two_tasks
def test_seeds_by_list_and_by_integer(env_id):
    env = make_vec(env_id, 3)
    a, _ = env.reset(seed=5)
    b, _ = env.reset(seed=[5, 6, 7])
    assert np.array_equal(a, b)
    assert not np.array_equal(a[0], a[1])
    with pytest.raises(ValueError, match="2 seeds for 3"):
        env.reset(seed=[1, 2])


@two_tasks
def test_the_gymnasium_vector_interface_is_complete(env_id):
    env = make_vec(env_id, 2, render_mode="rgb_array")
    env.reset(seed=0)
    frames = env.call("render")
    assert len(frames) == 2 and frames[0].dtype == np.uint8 and frames[0].ndim == 3
    assert env.get_attr("num_envs") == (2, 2)
    env.set_attr("render_mode", [None, None])
    assert env.render() is None


@two_tasks
def test_an_asynchronous_vector_env_after_a_native_one(env_id):
    """The native batch has used its threads; the forked workers must do without them."""
    native = make_vec(env_id, 32, threads=2)
    native.reset(seed=0)
    native.step(still(native))
    env = gym.vector.AsyncVectorEnv([lambda: gym.make(f"clothgym:{env_id}", threads=2)] * 2, context="fork")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        observation, _ = env.reset(seed=3)
    single = make(env_id)
    assert np.array_equal(observation[0], single.reset(seed=3)[0])
    env.close()


@two_tasks
def test_two_threads_step_two_vector_envs_at_once(env_id):
    from concurrent.futures import ThreadPoolExecutor

    def run(seed):
        env = make_vec(env_id, 40, threads=2)
        env.reset(seed=seed)
        for _, action in zip(range(8), drawn(env, seed)):
            observation, *_ = env.step(action)
        return observation

    alone = [run(seed) for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, (0, 1)))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together))

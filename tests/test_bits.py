"""An environment's bits do not depend on its company: batch size, threads, what ran before, save and restore."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import INTEGRATORS, Plane, Simulation, Sphere, grid

NAMES = list(INTEGRATORS)
STEPS = 16


def flatten(info):
    for key, value in info.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{name}", each) for name, each in flatten(value))
        else:
            yield key, value


def actions(num_envs, steps=STEPS, seed=0):
    """The same actions for environment i whatever the batch; some let go early, so that all phases are met."""
    each = [np.random.default_rng([seed, i]).uniform(-1, 0.85, (steps, 8)) for i in range(num_envs)]
    return np.stack(each, axis=1)


def rollout(env, sequence, first=0):
    """All that a vector env gives, step by step, from environment ``first`` on."""
    records = []
    for action in sequence:
        observation, reward, terminated, truncated, info = env.step(action)
        record = {"observation": observation, "reward": reward, "terminated": terminated, "truncated": truncated} | dict(
            flatten(info)
        )
        records.append({key: np.asarray(value)[first:] for key, value in record.items()})
    return records


def assert_same(a, b, count):
    """The first ``count`` environments of both, bit for bit; keys that only one has are of episodes' ends elsewhere."""
    for one, other in zip(a, b):
        for key in one.keys() & other.keys():
            left, right = one[key][:count], other[key][:count]
            same = (
                all(np.array_equal(p, q) for p, q in zip(left, right))
                if left.dtype == object
                else np.array_equal(left, right, equal_nan=left.dtype.kind == "f")
            )
            assert same, key


def make(num_envs, name, **kwargs):
    kwargs = {"integrator": name, "autoreset_mode": "SameStep", "substeps": 60 if name == "semi_implicit_euler" else 220} | kwargs
    return gym.make_vec("clothgym:ClothDrape-v0", num_envs=num_envs, **kwargs)


@pytest.mark.parametrize("name", NAMES)
def test_batches_of_1_7_64_and_256_and_threads_agree(name):
    steps = STEPS if name == "semi_implicit_euler" else 6
    reference = make(256, name, threads=2)
    reference.reset(seed=3)
    whole = rollout(reference, actions(256, steps))
    for num_envs, threads in ((1, 1), (7, 1), (7, 2), (64, 1), (64, 2), (256, 1)):
        env = make(num_envs, name, threads=threads)
        env.reset(seed=3)
        assert_same(rollout(env, actions(num_envs, steps)), whole, num_envs)


@pytest.mark.parametrize("name", NAMES)
def test_single_environment_equals_the_batch(name):
    steps = 10
    vector = make(3, name)
    start, _ = vector.reset(seed=11)
    records = rollout(vector, actions(3, steps))
    for i in range(3):
        env = gym.make("clothgym:ClothDrape-v0", integrator=name, substeps=60 if name == "semi_implicit_euler" else 220)
        observation, _ = env.reset(seed=11 + i)
        assert np.array_equal(observation, start[i])
        for action, record in zip(actions(3, steps)[:, i], records):
            observation, reward, terminated, _, info = env.step(action.astype(np.float64))
            assert reward == record["reward"][i] and terminated == record["terminated"][i]
            if not terminated:
                assert np.array_equal(observation, record["observation"][i])
                assert info["strain_max"] == record["strain_max"][i]


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_after_other_episodes(name):
    env = make(5, name)
    env.reset(seed=0)
    first = rollout(env, actions(5, 8))
    rollout(env, actions(5, 8, seed=9))
    env.reset(seed=0)
    assert_same(rollout(env, actions(5, 8)), first, 5)


def test_whole_episodes_with_resets_agree():
    """To the end and beyond: settling, judgement and the next episodes, in batches of 2 and 40."""
    sequence = actions(40, 130)
    small, large = make(2, NAMES[0]), make(40, NAMES[0])
    small.reset(seed=5)
    large.reset(seed=5)
    a, b = rollout(small, sequence[:, :2]), rollout(large, sequence)
    assert any(record["terminated"][:2].any() for record in a)
    assert_same(a, b, 2)


@pytest.mark.parametrize("name", NAMES)
def test_state_restored_in_mid_episode(name):
    env, other = make(4, name), make(4, name)
    env.reset(seed=2)
    rollout(env, actions(4, 5))
    state = env.get_state()
    rest = rollout(env, actions(4, 8, seed=1))
    other.reset(seed=77)
    other.set_state(state)
    assert_same(rollout(other, actions(4, 8, seed=1)), rest, 4)
    env.set_state(state)
    assert_same(rollout(env, actions(4, 8, seed=1)), rest, 4)


def test_state_restored_before_a_reset_draws_the_same_episode():
    env = make(2, NAMES[0])
    env.reset(seed=4)
    state = env.get_state()
    first = rollout(env, actions(2, 110, seed=1))
    env.set_state(state)
    again = rollout(env, actions(2, 110, seed=1))
    assert any(record["terminated"].any() for record in first)
    assert_same(again, first, 2)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_core_lanes_of_different_fabrics(name, dtype):
    """One lane of its own and the same lane among sixteen others of other fabrics: the scalar branch and the wide one."""
    mesh = grid(6, 6, 0.3, 0.3)
    solids = [Plane(point=(0, 0, -0.05)), Sphere(center=(0, 0, -0.1), radius=0.08)]
    positions = mesh.rest_positions + np.random.default_rng(0).normal(scale=1e-3, size=(36, 3))
    densities = np.linspace(0.12, 0.3, 17)
    batch = Simulation(mesh, num_envs=17, integrator=name, colliders=solids, anchors=[0], dtype=dtype, threads=1, substeps=150)
    batch.set_parameters(density=densities)
    batch.reset(positions=positions)
    batch.step(20)
    for lane in (0, 9, 16):
        alone = Simulation(mesh, integrator=name, substeps=batch.substeps, colliders=solids, anchors=[0], dtype=dtype)
        alone.set_parameters(density=densities[lane])
        alone.reset(positions=positions)
        alone.step(20)
        assert np.array_equal(alone.positions[0], batch.positions[lane])

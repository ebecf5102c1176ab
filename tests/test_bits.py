"""An environment's bits do not depend on its company: batch size, threads, what ran before, save and restore."""

import gymnasium as gym
import numpy as np
import pytest
from test_envs import TASKS, flat

from clothgym import INTEGRATORS, Plane, Simulation, Sphere, grid
from clothgym.registration import ENVIRONMENTS

NAMES = list(INTEGRATORS)
IDS = list(ENVIRONMENTS)
STEPS = 16
# substeps that are few and stable on the environments' sheets
SUBSTEPS = {"semi_implicit_euler": 60, "implicit_euler": 12, "xpbd": 220}
# one environment with integrators of each kind, the others as they are
CASES = [(IDS[0], name) for name in SUBSTEPS] + [(env_id, None) for env_id in IDS[1:]]
every_case = pytest.mark.parametrize(("env_id", "name"), CASES)


def flatten(info):
    for key, value in info.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{name}", each) for name, each in flatten(value))
        else:
            yield key, value


def actions(env, steps=STEPS, seed=0):
    """The same actions for environment i whatever the batch; some let go early, so that all phases are met."""
    size = env.action_space.shape[-1]
    each = [np.random.default_rng([seed, i]).uniform(-1, 0.85, (steps, size)) for i in range(env.unwrapped.task.num_envs)]
    return np.stack(each, axis=1)


def rollout(env, sequence, first=0):
    """All that a vector env gives, step by step, from environment ``first`` on."""
    records = []
    for action in sequence:
        observation, reward, terminated, truncated, info = env.step(action)
        record = {"observation": flat(observation), "reward": reward, "terminated": terminated, "truncated": truncated} | dict(
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
                all(np.array_equal(flat(p), flat(q)) for p, q in zip(left, right))
                if left.dtype == object
                else np.array_equal(left, right, equal_nan=left.dtype.kind == "f")
            )
            assert same, key


def options(name):
    return {} if name is None else {"integrator": name, "substeps": SUBSTEPS[name]}


def make(env_id, num_envs, name=None, **kwargs):
    return gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, **({"autoreset_mode": "SameStep"} | options(name) | kwargs))


@every_case
def test_batches_of_any_size_and_threads_agree(env_id, name):
    """Environments share blocks in lanes alone, which one task shows in batches of several blocks; elsewhere 32 are enough."""
    steps, most = STEPS if name == "semi_implicit_euler" else 6, 256 if name else 32
    reference = make(env_id, most, name, threads=2)
    reference.reset(seed=3)
    whole = rollout(reference, actions(reference, steps))
    for num_envs, threads in ((1, 1), (7, 2), (most // 4, 1)):
        env = make(env_id, num_envs, name, threads=threads)
        env.reset(seed=3)
        assert_same(rollout(env, actions(env, steps)), whole, num_envs)


@every_case
def test_single_environment_equals_the_batch(env_id, name):
    steps = 10
    vector = make(env_id, 3, name)
    start, _ = vector.reset(seed=11)
    sequence = actions(vector, steps)
    records = rollout(vector, sequence)
    for i in range(3):
        env = gym.make(f"clothgym:{env_id}", **options(name))
        observation, _ = env.reset(seed=11 + i)
        assert np.array_equal(flat(observation), flat(start)[i])
        for action, record in zip(sequence[:, i], records):
            observation, reward, terminated, _, info = env.step(action)
            assert reward == record["reward"][i] and terminated == record["terminated"][i]
            if terminated:
                break
            assert np.array_equal(flat(observation), record["observation"][i])
            for key, value in flatten(info):
                assert value == record[key][i], key


@every_case
def test_the_same_seed_after_other_episodes(env_id, name):
    env = make(env_id, 5, name)
    env.reset(seed=0)
    first = rollout(env, actions(env, 8))
    rollout(env, actions(env, 8, seed=9))
    env.reset(seed=0)
    assert_same(rollout(env, actions(env, 8)), first, 5)


@pytest.mark.parametrize("env_id", TASKS)
def test_whole_episodes_with_resets_agree(env_id):
    """To the end and beyond: settling, evaluation and the next episodes, in batches of 2 and 7, of a garment 18, in lanes."""
    small, large = make(env_id, 2), make(env_id, 18 if env_id == "ClothFoldShirt-v0" else 7)
    small.reset(seed=5)
    large.reset(seed=5)
    task = large.unwrapped.task
    # most of the time to act is over already
    for env in (small, large):
        env.unwrapped.task.episode["step"] = task.acting_steps - 25
    sequence = actions(large, 25 + task.settling_steps + 30)
    a, b = rollout(small, sequence[:, :2]), rollout(large, sequence)
    assert any(record["terminated"][:2].any() for record in a)
    assert_same(a, b, 2)


@every_case
def test_state_restored_in_mid_episode(env_id, name):
    env, other = make(env_id, 4, name), make(env_id, 4, name)
    env.reset(seed=2)
    rollout(env, actions(env, 5))
    state = env.get_state()
    rest = rollout(env, actions(env, 8, seed=1))
    other.reset(seed=77)
    other.set_state(state)
    assert_same(rollout(other, actions(env, 8, seed=1)), rest, 4)
    env.set_state(state)
    assert_same(rollout(env, actions(env, 8, seed=1)), rest, 4)


@pytest.mark.parametrize("env_id", TASKS)
def test_state_restored_before_a_reset_draws_the_same_episode(env_id):
    env = make(env_id, 2)
    env.reset(seed=4)
    # most of the time to act is over already
    env.unwrapped.task.episode["step"] += env.unwrapped.task.acting_steps - 20
    state, steps = env.get_state(), 20 + env.unwrapped.task.settling_steps + 10
    first = rollout(env, actions(env, steps, seed=1))
    env.set_state(state)
    again = rollout(env, actions(env, steps, seed=1))
    assert any(record["terminated"].any() for record in first)
    assert_same(again, first, 2)


# of each method, on the sheet below
CORE_SUBSTEPS = {"explicit_euler": 400, "implicit_euler": 20, "projective_dynamics": 20, "pbd": 5, "xpbd": 150}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_core_lanes_of_different_fabrics(name, dtype):
    """One lane of its own and the same lane among sixteen others of other fabrics: the scalar branch and the wide one.

    Projective dynamics has one fabric for all: there gravity differs.
    """
    mesh = grid(6, 6, 0.3, 0.3)
    solids = [Plane(point=(0, 0, -0.05)), Sphere(center=(0, 0, -0.1), radius=0.08)]
    positions = mesh.rest_positions + np.random.default_rng(0).normal(scale=1e-3, size=(36, 3))
    world = {"integrator": name, "anchors": [0], "dtype": dtype, "substeps": CORE_SUBSTEPS.get(name, 150)}
    # in single precision others are without solids, as other tests compile them
    if dtype == "float64" or name == "semi_implicit_euler":
        world |= {"colliders": solids, "contact": "sheet"}
    densities = np.linspace(0.12, 0.3, 17)
    properties = {"gravity": densities[:, None] * (5, 0, -40)} if name == "projective_dynamics" else {"density": densities}
    batch = Simulation(mesh, num_envs=17, threads=1, **world)
    batch.set_parameters(**properties)
    batch.reset(positions=positions)
    batch.step(20)
    assert not batch.diverged.any()
    for lane in (0, 9, 16):
        alone = Simulation(mesh, **world)
        alone.set_parameters(**{one: values[lane] for one, values in properties.items()})
        alone.reset(positions=positions)
        alone.step(20)
        assert np.array_equal(alone.positions[0], batch.positions[lane])


@pytest.mark.parametrize(
    ("name", "bending", "limit"),
    [
        ("semi_implicit_euler", "hinge", 0.02),
        ("implicit_euler", "quadratic", None),
        ("projective_dynamics", "quadratic", None),
        ("xpbd", "hinge", None),
    ],
)
def test_lanes_that_bend_and_are_limited(name, bending, limit):
    """Each lane has another start, so that it needs other sweeps and iterations than its neighbors; restored in mid-run, too."""
    mesh = grid(6, 6, 0.3, 0.3)
    world = {
        "integrator": name, "bending": bending, "strain_limit": limit, "anchors": [0],
        "substeps": CORE_SUBSTEPS.get(name, 150), "dtype": "float32" if limit else "float64",
    }  # fmt: skip
    starts = mesh.rest_positions * np.linspace(0.9, 1.1, 7)[:, None, None]
    starts = starts + np.random.default_rng(0).normal(scale=1e-3, size=(7, 36, 3))
    batch = Simulation(mesh, num_envs=7, threads=1, **world)
    batch.reset(positions=starts)
    batch.step(4)
    middle = batch.get_state()
    batch.step(4)
    other = Simulation(mesh, num_envs=7, threads=1, **world)
    other.set_state(middle)
    other.step(4)
    assert np.array_equal(other.positions, batch.positions) and not batch.diverged.any()
    for lane in (0, 6):
        alone = Simulation(mesh, **world)
        alone.reset(positions=starts[lane])
        alone.step(8)
        assert np.array_equal(alone.positions[0], batch.positions[lane])
        assert limit is None or np.array_equal(np.array(alone.limiting)[:, 0], np.array(batch.limiting)[:, lane])


@pytest.mark.parametrize("name", NAMES)
def test_core_state_and_threads(name):
    """Saved in mid-run and restored elsewhere, with an anchor let go; on one thread and on two."""
    mesh = grid(5, 5, 0.3, 0.3)
    world = {"integrator": name, "num_envs": 40, "anchors": [0, 4], "substeps": CORE_SUBSTEPS.get(name, 150)}
    ends = []
    for threads in (1, 2):
        simulation = Simulation(mesh, threads=threads, **world)
        simulation.step(3)
        simulation.release(envs=[1, 30], anchors=[1, 0])
        state = simulation.get_state()
        simulation.step(5)
        other = Simulation(mesh, threads=threads, **world)
        other.set_state(state)
        other.step(5)
        assert np.array_equal(simulation.positions, other.positions) and np.array_equal(simulation.velocities, other.velocities)
        ends.append(simulation.positions)
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0][0], ends[0][1])

"""Nothing half done: refused resets change nothing, an interrupted step is known, and two threads do not share an environment."""

import hashlib
import json
import threading
from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest
from test_envs import TWO, drawn, every_task, make, make_vec, still, two_tasks

import clothgym
from clothgym.envs import episode

ANY = "ClothReach-v0"
OF_ALL = [
    {"materials": "silk"},
    {"material": {"density": -1}},
    {"material": "corduroy"},
    {"material": None},
    5,
]
OF_A_TARGET = [
    {"target": {"radius": 9}},
    {"target": {"radius": 0.2, "height": 0.1}},
    {"target": {"center": (5, 5)}},
    {"target": {"yaw": 3}},
    {"target": {"shape": "cone"}},
    {"target": {"color": 1}},
    {"target": 7},
]
OPTIONS = {
    "ClothReach-v0": [{"goal": (9, 9, 9)}, {"goal": (0, np.nan, 0)}, {"goal": 1.0}],
    "ClothDrape-v0": OF_A_TARGET,
    "ClothDrapeGripper-v0": [*OF_A_TARGET, {"rumpled": 1}],
    "ClothHang-v0": [{"rail": {"height": 9}}, {"rail": {"yaw": 2}}, {"rail": {"color": 1}}, {"rail": 7}],
    "ClothHang-Hard-v0": [{"rail": {"center": (5, 5)}}, {"rumpled": 1}],
    "ClothStrain-v0": [{"target": {}}],
    "ClothFold-v0": [{"target": {}}],
    "ClothFoldShirt-v0": [{"target": {}}],
    "ClothFlatten-v0": [{"rumpled": True}],
    "ClothFlattenShirt-v0": [{"rumpled": True}],
    "ClothCanonicalize-v0": [{"rumpled": True}],
    "ClothHook-v0": [{"hook": {"height": 9}}, {"hook": {"yaw": 2}}, {"hook": {"color": 1}}, {"hook": 7}],
    "ClothHook-Hard-v0": [{"hook": {"center": (5, 5)}}, {"rumpled": 1}],
    "ClothFling-v0": [{"rumpled": True}],
}
# no grid has springs for it; a triangle mesh bends by its hinges
OF_GRIDS = [{"material": {"bend_rigidity": 0.1}}]
SEEDS = [-1, 1.5, "1", True]
BATCH_SEEDS = [*SEEDS, [5, -1, 5], [5, 6, 7.5], [5, 6], [1, 2, 3, 4]]
MASKS = [np.zeros(3, bool), np.ones(2, bool), np.ones(3), [1, 0, 1]]


def digest(env):
    """Of an environment's state, and of its generators as they are."""
    task, found = env.unwrapped.task, hashlib.sha256()
    state = task.get_state()
    arrays = state.simulation.arrays() | state.episode
    for name, array in sorted(arrays.items()):
        found.update(name.encode() + np.ascontiguousarray(array).tobytes())
    found.update("".join(state.generators).encode())
    found.update(json.dumps(env.unwrapped.np_random.bit_generator.state if task.num_envs == 1 else "").encode())
    return found.hexdigest()


def advanced(env, steps=3):
    env.reset(seed=7)
    for _, action in zip(range(steps), drawn(env)):
        env.step(action)
    return env


@every_task
@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_refused_reset_changes_nothing(env_id, num_envs):
    env = advanced((make(env_id) if num_envs is None else make_vec(env_id, 3, autoreset_mode="Disabled")).unwrapped)
    before, generator, own = digest(env), env.task.generators[0], OPTIONS[env_id]
    # options that no task takes, and seeds and masks, on two tasks; each task's own on all
    shared = OF_ALL + OF_GRIDS if env_id == TWO[0] else OF_ALL if env_id == TWO[1] else []
    refused = [{"options": options} for options in shared + own]
    refused += [{"seed": seed} for seed in (SEEDS if num_envs is None else BATCH_SEEDS) if shared]
    # a seed that is fine does not count where the options are not
    if num_envs is None:
        refused += [{"seed": 3, "options": options} for options in own]
    else:
        refused += [{"options": {"reset_mask": mask}} for mask in MASKS if shared]
        refused += [{"seed": [1, 2, 3], "options": {"reset_mask": np.array([True, False, True]), **own[0]}}]
    for arguments in refused:
        with pytest.raises(ValueError):
            env.reset(**arguments)
        assert digest(env) == before, arguments
        assert env.task.generators[0] is generator and env.task.generators.seeds[0] == 7
    env.reset()
    assert digest(env) != before and env.task.generators[0] is generator


def test_a_start_that_strict_mode_refuses_changes_nothing():
    env = advanced(make(ANY, self_collision="strict").unwrapped)
    before, begin = digest(env), env.task.begin

    def tangled(*given):
        x = begin(*given)
        return x[np.random.default_rng(0).permutation(len(x))]

    env.task.begin = tangled
    with pytest.raises(ValueError, match="intersect"):
        env.reset(seed=5)
    assert digest(env) == before


def test_a_refused_reset_leaves_where_grippers_start():
    env = advanced(make("ClothDrapeGripper-v0").unwrapped)
    before, begin = env.task.gripper_starts.copy(), env.task.begin
    env.task.begin = lambda *given: begin(*given) * np.nan
    with pytest.raises(ValueError):
        env.reset(seed=5)
    assert np.array_equal(env.task.gripper_starts, before)


# --- interruptions ----------------------------------------------------------------------------------------------------------------


def interrupt(monkeypatch, owner, name, after):
    """Ctrl+C once, before or after what that method does; returns its undoing."""
    original = getattr(owner, name)

    def stopped(*args, **kwargs):
        if after:
            original(*args, **kwargs)
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, name, stopped)
    return lambda: monkeypatch.setattr(owner, name, original)


PLACES = [("before_step", False), ("after_step", False), ("_score_and_observe", True)]
OF_PHYSICS = [("_advance", True), ("_advance", False)]


@two_tasks
@pytest.mark.parametrize(("place", "after"), PLACES + OF_PHYSICS)
def test_an_interrupted_step_is_not_gone_on_from(env_id, place, after, monkeypatch):
    for env in (make(env_id).unwrapped, make_vec(env_id, 2).unwrapped):
        advanced(env)
        state, task = env.get_state(), env.task
        owner = task.simulation if (place, after) in OF_PHYSICS else task
        mend = interrupt(monkeypatch, owner, place, after)
        with pytest.raises(KeyboardInterrupt):
            env.step(still(env))
        mend()
        # until a state is restored, or all is reset, nothing goes on
        for refused in (lambda env=env: env.step(still(env)), env.get_state):
            with pytest.raises((gym.error.ResetNeeded, RuntimeError), match=r"interrupted.*reset\(\)"):
                refused()
        env.set_state(state)
        twin = type(env)(**({"num_envs": 2} if task.num_envs == 2 else {}))
        twin.set_state(state)
        assert np.array_equal(env.step(still(env))[0], twin.step(still(env))[0])


def test_an_interruption_while_a_sheet_settles_is_not_gone_on_from(monkeypatch):
    env = make_vec("ClothDrape-v0", 2, settling="at_once").unwrapped
    env.reset(seed=4)
    state, original, calls = env.get_state(), env.task.simulation._advance, []

    def stopped(*args, **kwargs):
        calls.append(None)
        if len(calls) == 5:
            raise KeyboardInterrupt
        original(*args, **kwargs)

    monkeypatch.setattr(env.task.simulation, "_advance", stopped)
    # the first environment lets go of its sheet, which settles for longer than five control steps
    lets_go = np.array([[0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0, -1, 0, 0, 0, -1.0]])
    with pytest.raises(KeyboardInterrupt):
        env.step(lets_go)
    with pytest.raises((gym.error.ResetNeeded, RuntimeError), match=r"interrupted.*reset\(\)"):
        env.step(lets_go)
    env.set_state(state)
    twin = make_vec("ClothDrape-v0", 2, settling="at_once").unwrapped
    twin.set_state(state)
    assert np.array_equal(env.step(lets_go)[0], twin.step(lets_go)[0]) and len(calls) > 5


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_an_interrupted_autoreset_is_not_gone_on_from(mode, monkeypatch):
    env = make_vec(ANY, 2, autoreset_mode=mode).unwrapped
    env.reset(seed=0)
    env.task.episode["step"][1] = 39
    if mode == "NextStep":
        env.step(still(env))
    mend = interrupt(monkeypatch, env.task, "reset", after=False)
    with pytest.raises(KeyboardInterrupt):
        env.step(still(env))
    mend()
    with pytest.raises(gym.error.ResetNeeded, match="interrupted"):
        env.step(still(env))


def test_after_an_interruption_every_environment_needs_its_reset(monkeypatch):
    env = make_vec(ANY, 3, autoreset_mode="Disabled").unwrapped
    env.reset(seed=0)
    mend = interrupt(monkeypatch, env.task.simulation, "_advance", after=True)
    with pytest.raises(KeyboardInterrupt):
        env.step(still(env))
    mend()
    env.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(gym.error.ResetNeeded, match="environment 1"):
        env.step(still(env))
    env.reset(options={"reset_mask": np.array([False, True, False])})
    env.step(still(env))


@pytest.mark.parametrize("place", ["_draw", "_begin"])
def test_an_interrupted_reset_is_undone_or_has_to_be_repeated(place, monkeypatch):
    env = advanced(make(ANY).unwrapped)
    before = digest(env)
    mend = interrupt(monkeypatch, env.task, place, after=True)
    with pytest.raises(KeyboardInterrupt):
        env.reset(seed=3)
    mend()
    if place == "_draw":
        assert digest(env) == before
        env.step(still(env))
        return
    with pytest.raises(gym.error.ResetNeeded, match="interrupted"):
        env.step(still(env))
    assert np.array_equal(env.reset(seed=3)[0], make(ANY).reset(seed=3)[0])


def test_a_simulation_knows_its_interruptions(monkeypatch):
    cloth = clothgym.Simulation(clothgym.grid(5, 5, 0.3, 0.3), num_envs=2, threads=1)
    cloth.step()
    state = cloth.get_state()
    mend = interrupt(monkeypatch, cloth, "_advance", after=True)
    with pytest.raises(KeyboardInterrupt):
        cloth.step(2)
    mend()
    for refused in (cloth.step, cloth.get_state):
        with pytest.raises(RuntimeError, match="environment 0 between two steps"):
            refused()
    cloth.reset([0])
    with pytest.raises(RuntimeError, match="environment 1 between two steps"):
        cloth.step()
    cloth.set_state(state)
    cloth.step()
    assert cloth.get_state().steps.tolist() == [2, 2]


def test_a_failure_that_is_only_reported_leaves_whole_steps():
    """With on_divergence="raise" the step that diverged has been taken."""
    cloth = clothgym.Simulation(clothgym.grid(5, 5, 0.3, 0.3), num_envs=2, threads=1, on_divergence="raise")
    x = np.tile(cloth.mesh.rest_positions, (2, 1, 1))
    v = np.zeros_like(x)
    v[1, 0] = 1e6
    cloth.reset(positions=x, velocities=v)
    with pytest.raises(FloatingPointError, match="environment 1"):
        cloth.step(5)
    assert cloth.get_state().steps.tolist() == [1, 1]
    cloth.reset([1])
    cloth.step()


# --- threads ----------------------------------------------------------------------------------------------------------------------


@two_tasks
def test_a_second_thread_is_refused(env_id):
    for env in (make(env_id).unwrapped, make_vec(env_id, 2).unwrapped):
        env.reset(seed=0)
        state, inside, leave, before_step = env.get_state(), threading.Event(), threading.Event(), env.task.before_step

        def waits(actions, inside=inside, leave=leave):
            inside.set()
            assert leave.wait(60)

        env.task.before_step = waits
        other = threading.Thread(target=env.step, args=(still(env),))
        other.start()
        assert inside.wait(60)
        calls = (lambda env=env: env.step(still(env)), env.reset, env.get_state, lambda env=env, s=state: env.set_state(s))
        for call in calls:
            with pytest.raises(RuntimeError, match="another thread"):
                call()
        leave.set()
        other.join(60)
        env.task.before_step = before_step
        # afterwards the turn is anybody's
        env.step(still(env))
        assert env.task.episode["step"].tolist() == [2] * env.task.num_envs


# --- infos, lengths and branches --------------------------------------------------------------------------------------------------


def test_failures_have_their_names_in_the_metadata():
    for env in (make(ANY), make_vec(ANY, 2)):
        assert list(env.metadata["failures"]) == ["", "diverged", "torn", "out_of_bounds"]
    assert (episode.DIVERGED, episode.TORN, episode.OUT_OF_BOUNDS) == (1, 2, 3)


@every_task
def test_infos_are_numbers_with_the_same_keys_at_reset_and_at_each_step(env_id):
    kwargs = {"self_collision": "fast"} | ({} if env_id == "ClothStrain-v0" else {"strain_limit": 0.2})
    env, batch = make(env_id, **kwargs), make_vec(env_id, 2, **kwargs)
    _, info = env.reset(seed=0)
    _, infos = batch.reset(seed=0)
    assert all(type(value) in (int, float, bool) for value in info.values())
    assert {key for key in infos if not key.startswith("_")} == set(info)
    assert not info["failure"] and not any(value for key, value in info.items() if key.startswith("reward/"))
    # what is said of the sheet is said of its start
    strain = env.unwrapped.task.simulation.strain().max()
    assert info["strain_max"] == pytest.approx(max(strain, 0), abs=2e-6)
    keys = {key: np.asarray(value).dtype for key, value in info.items()}
    for _, action in zip(range(3), drawn(env)):
        info = env.step(action)[4]
        assert {key: np.asarray(value).dtype for key, value in info.items()} == keys
        infos = batch.step(np.stack([action, action]))[4]
        for key, value in info.items():
            assert infos[key].shape == (2,) and infos[key].dtype.kind in "fib" and infos[f"_{key}"].all()
            assert infos[key][0] == value, key


@every_task
def test_the_spec_knows_the_longest_episode_and_a_shorter_one_is_truncated(env_id):
    # of the folds the quarter takes longest
    task = make(env_id, **({"fold": "quarter"} if env_id == "ClothFold-v0" else {})).unwrapped.task
    longest = task.acting_steps + task.settling_steps
    assert gym.spec(env_id).max_episode_steps == longest + 1
    native = make_vec(env_id, 2, max_episode_steps=4, autoreset_mode="NextStep")
    sync = gym.make_vec(f"clothgym:{env_id}", num_envs=2, vectorization_mode="sync", max_episode_steps=4)
    native.reset(seed=3), sync.reset(seed=3)
    ends = []
    for _, action in zip(range(11), drawn(native)):
        for one, other in zip(native.step(action)[:4], (last := sync.step(action))[:4]):
            assert np.array_equal(one, other)
        ends.append(bool(last[3].all()))
    assert [k for k, end in enumerate(ends) if end] == [3, 8]
    with pytest.raises(ValueError, match="max_episode_steps=0"):
        make_vec(env_id, 2, max_episode_steps=0)


@two_tasks
def test_one_state_goes_on_in_many_environments(env_id):
    one, many = advanced(make(env_id).unwrapped, 5), make_vec(env_id, 3, autoreset_mode="Disabled").unwrapped
    state = one.get_state()
    many.set_state(state.branch(3))
    for _, action in zip(range(6), drawn(one, 1)):
        rows = np.stack([action, 0 * action, action])
        observation, reward, *_ = many.step(rows)
        expected = one.step(action)
        assert all(np.array_equal(observation[k], expected[0]) and reward[k] == expected[1] for k in (0, 2))
    assert not np.array_equal(observation[0], observation[1])
    # and one of many in one, with its generator
    many.reset(seed=20)
    one.set_state(many.get_state().branch(1, env=2))
    assert np.array_equal(one.reset()[0], many.reset()[0][2])
    for wrong in ({"count": 0}, {"count": 1.5}, {"count": 2, "env": 1}):
        with pytest.raises(ValueError, match=f"{list(wrong)[-1]}"):
            state.branch(**wrong)


def test_every_field_of_a_state_is_branched():
    state = advanced(make(ANY).unwrapped).get_state().branch(4)
    for field in fields(state.simulation):
        if field.name not in ("sheet", "self_contact"):
            assert getattr(state.simulation, field.name).shape[0] == 4, field.name
    assert len(state.generators) == 4

"""An environment that is over goes on saying so: its last answer stands, in every form and from every state, until it is reset."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from test_envs import drawn, every_task, flat, make, make_vec, skip, still, two_tasks

from clothgym import Material, grid
from clothgym.envs import ClothEnv, ClothVectorEnv, Physics, Task, TaskState
from clothgym.envs.episode import OUT_OF_BOUNDS

ENDS = (2, 5, 3, 7)  # the steps after which the environments below are done
RIGHT = (True, False, False, True)  # and whether that is a success
SHEET = grid(5, 5, 0.2, 0.2)


class Count(Task):
    """Done after as many steps as an episode has drawn, with a success in every other of them, so that the truth is known."""

    physics = Physics(
        mesh=SHEET, material=Material(), time_step=1 / 30, integrator="semi_implicit_euler", substeps="auto", attachment_speed=0.5,
        anchors=SHEET.corners[2:], self_collision="strict",
    )  # fmt: skip
    acting_steps, settling_steps = 12, 2
    accounts = (("cost", float), ("so_far", float))

    def remembers(self):
        return [("last", np.int64), ("right", bool)]

    def begin(self, env, rng, options):
        self.episode["last"][env], self.episode["right"][env] = ENDS[env % 4], RIGHT[env % 4]
        return SHEET.rest_positions + (0, 0, 0.3)

    def after_step(self):
        self.info["cost"], self.info["so_far"] = 1.0, self.episode["step"]

    def performance(self):
        return np.minimum(self.episode["step"] / 10, 1.0)

    def success(self):
        return self.episode["right"]

    def done(self):
        return self.episode["step"] >= self.episode["last"]


class CountEnv(ClothEnv):
    task_class = Count


class CountVectorEnv(ClothVectorEnv):
    task_class = Count


def of_last(info, envs):
    """What stands of an info: all but what is of one step alone."""
    alone = {key: value for key, value in info.items() if key.startswith(("reward/", "_reward/"))}
    return {key: np.asarray(value)[envs] for key, value in info.items() if key not in (*alone, "cost", "_cost")}


def assert_the_same(answers, others):
    for one, other in zip(answers, others):
        if isinstance(one, dict):
            assert one.keys() == other.keys()
            assert all(np.array_equal(one[key], other[key]) for key in one)
        else:
            assert np.array_equal(one, other)


def assert_stands(last, again, envs):
    """That ``again`` is the answer ``last`` to the last bit for these environments, and that nothing more is counted."""
    assert_the_same(
        [np.asarray(part)[envs] for part in (flat(last[0]), *last[2:4])],
        [np.asarray(part)[envs] for part in (flat(again[0]), *again[2:4])],
    )
    assert_the_same([of_last(last[4], envs)], [of_last(again[4], envs)])
    assert not np.any(np.asarray(again[1])[envs])
    for key, value in again[4].items():
        if key == "cost" or key.startswith("reward/"):
            assert not np.any(np.asarray(value)[envs]), key


def run(env, actions, begins=None):
    """Step until all are over, by the loop that anybody would write; returns the final answers of each, and the last step's."""
    over, firsts, result = np.zeros(env.num_envs, bool), {}, begins
    for _ in range(400):
        result = env.step(next(actions))
        ended = result[2] | result[3]
        assert ended[over].all(), "an environment that was over says that it is not"
        for i in np.flatnonzero(ended & ~over):
            firsts[i] = result
        for i, first in firsts.items():
            assert_stands(first, result, [i]) if over[i] else None
        over |= ended
        if ended.all():
            return firsts, result
    raise AssertionError("while not terminated.all() never ends")


@every_task
def test_every_id_s_last_answers_stand(env_id):
    """Ends at different steps, one of them with a sheet that has left the arena."""
    env = make_vec(env_id, 4, autoreset_mode="Disabled")
    env.reset(seed=0)
    task = env.unwrapped.task
    for i, left in enumerate((2, 5, 3, 9)):
        skip(task, i, task.acting_steps - left)
    env.step(still(env))
    state = env.unwrapped.get_state()
    state.simulation.positions[3] += task.arena()[1] - state.simulation.positions[3].mean(axis=0) + (0.6, 0, 0)
    state.simulation.velocities[3], state.simulation.holder[3] = 0, -1
    env.unwrapped.set_state(state)
    firsts, (*_, info) = run(env, drawn(env))
    assert firsts[3][4]["failure"][3] == info["failure"][3] == OUT_OF_BOUNDS
    for key in ("is_success", "normalized_performance", "failure", "strain_max"):
        assert info[key].mean() == np.mean([firsts[i][4][key][i] for i in range(4)])
    assert all(mask.all() for key, mask in info.items() if key.startswith("_"))


FORMS = ["native", "statistics", "at once"]


def made(form, num_envs=4, **kwargs):
    settling = {"settling": "at_once"} if form == "at once" else {}
    env = CountVectorEnv(num_envs, autoreset_mode="Disabled", **settling, **kwargs)
    return gym.wrappers.vector.RecordEpisodeStatistics(env) if form == "statistics" else env


@pytest.mark.parametrize("form", FORMS)
def test_a_success_rate_is_that_of_the_episodes(form):
    env = made(form)
    env.reset(seed=0)
    terminated, cost, total = np.zeros(4, bool), np.zeros(4), np.zeros(4)
    for _ in range(30):
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        cost, total = cost + info["cost"], total + reward
        if terminated.all():
            break
    assert terminated.all() and not truncated.any()
    assert info["is_success"].tolist() == list(RIGHT) and info["is_success"].mean() == 0.5
    steps = np.array(ENDS) + 2
    assert info["so_far"].tolist() == steps.tolist() and info["normalized_performance"] == pytest.approx(steps / 10)
    # sums over an episode stop with it: a call that settles at once costs as much as the steps that it stands for
    assert cost.tolist() == steps.tolist()
    assert total == pytest.approx(steps / 10 + 0.25 * np.array(RIGHT))


@pytest.mark.parametrize("limit", [1, 4, 6])
def test_truncated_episodes_stay_truncated(limit):
    env = CountVectorEnv(4, autoreset_mode="Disabled", max_episode_steps=limit)
    env.reset(seed=0)
    firsts, (_, _, terminated, truncated, _) = run(env, drawn(env))
    ends = np.array(ENDS) + 2
    assert terminated.tolist() == (ends <= limit).tolist() and truncated.tolist() == (ends >= limit).tolist()
    # until its reset, alone
    _, info = env.reset(options={"reset_mask": np.array([False, True, False, False])})
    assert info["_so_far"].tolist() == [False, True, False, False]
    result = env.step(still(env))
    assert (result[2] | result[3]).tolist() == [True, limit == 1, True, True] and result[4]["so_far"][1] == 1
    for i in (0, 2, 3):
        assert_stands(firsts[i], result, [i])


def saved(env, path):
    env.get_state().save(path / "state.npz")
    return TaskState.load(path / "state.npz")


def fresh(env, path, state=None):
    other = type(env)(env.num_envs, autoreset_mode="Disabled") if isinstance(env, CountVectorEnv) else type(env)()
    other.reset(seed=99)
    other.set_state(env.get_state() if state is None else state)
    return other


CARRIED = {
    "set_state": fresh,
    "a file": lambda env, path: fresh(env, path, saved(env, path)),
    "deepcopy": lambda env, path: copy.deepcopy(env),
    "pickle": lambda env, path: pickle.loads(pickle.dumps(env)),
}


@pytest.mark.parametrize("carried", CARRIED)
def test_an_answer_goes_with_the_state(carried, tmp_path):
    """In a batch of which some are over, and for one that is: what is restored or copied says the same from its first step on."""
    env = CountVectorEnv(4, autoreset_mode="Disabled")
    env.reset(seed=0)
    for _ in range(5):
        last = env.step(still(env))
    assert last[2].tolist() == [True, False, True, False]
    other = CARRIED[carried](env, tmp_path)
    for _ in range(3):
        one, two = env.step(still(env)), other.step(still(env))
        assert_the_same(one, two)
        assert_stands(last, two, [0, 2])
    single = CountEnv()
    single.reset(seed=0)
    while not (last := single.step(still(single)))[2]:
        pass
    again = CARRIED[carried](single, tmp_path).step(np.ones_like(still(single)))
    assert np.array_equal(again[0], last[0]) and again[1:4] == (0, True, False)
    assert {key: again[4][key] for key in ("is_success", "so_far", "failure", "cost")} == {
        "is_success": True, "so_far": 4, "failure": 0, "cost": 0,
    }  # fmt: skip
    branches = CountVectorEnv(3, autoreset_mode="Disabled")
    branches.reset(seed=1)
    branches.set_state(single.get_state().branch(3))
    assert branches.step(still(branches))[2].all()


@two_tasks
def test_a_single_environment_stepped_after_its_end(env_id):
    env = make(env_id).unwrapped
    env.reset(seed=3)
    skip(env.task, 0, env.task.acting_steps - 2)
    while not (last := env.step(still(env)))[2]:
        pass
    for _ in range(3):
        again = env.step(np.ones_like(still(env)))
        assert np.array_equal(flat(again[0]), flat(last[0])) and again[1:4] == (0, True, False)
        stands = {key: value for key, value in last[4].items() if key != "cost" and not key.startswith("reward/")}
        assert again[4] == stands | {key: 0 for key in last[4].keys() - stands.keys()}
    env.reset()
    assert env.step(still(env))[2] is False


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_batch_that_resets_itself_begins_anew_from_a_state_of_the_end(mode):
    over = CountVectorEnv(2, autoreset_mode="Disabled")
    over.reset(seed=0)
    run(over, drawn(over))
    env = CountVectorEnv(2, autoreset_mode=mode)
    env.reset(seed=1)
    env.set_state(over.get_state())
    _, reward, terminated, _, info = env.step(still(env))
    assert not reward.any() and terminated.tolist() == [mode == "SameStep"] * 2
    if mode == "SameStep":
        assert info["final_info"]["is_success"].tolist() == [True, False]
    assert env.task.episode["step"].tolist() == [0, 0]
    assert not env.step(still(env))[2].any()


def test_an_action_of_several_steps_leaves_the_last_answer():
    env = make_vec("ClothDrapeGripper-v0", 2, action_mode="pick_place", autoreset_mode="Disabled")
    env.reset(seed=8, options={"rumpled": False})
    skip(env.unwrapped.task, 0, 180)
    firsts, last = run(env, drawn(env))
    assert sorted(firsts) == [0, 1] and firsts[0] is not firsts[1]
    assert_stands(last, env.step(still(env)), [0, 1])


@pytest.mark.parametrize("flags", [(True, False, False), (False, True, False), (False, False, True)])
def test_a_state_that_is_over_and_does_not_say_so_is_refused(flags):
    env = CountEnv()
    env.reset(seed=0)
    env.step(still(env))
    state = env.get_state()
    for name, flag in zip(("over", "terminated", "truncated"), flags):
        state.episode[name][:] = flag
    with pytest.raises(ValueError, match="over differs from its terminated and truncated: give what get_state"):
        env.set_state(state)


def test_seeds_and_generators_are_those_of_the_episodes():
    """Of a batch they are tuples, as Gymnasium's own batches have them."""
    batch, sync = CountVectorEnv(3), gym.vector.SyncVectorEnv([CountEnv] * 3)
    for seed in (5, [7, 3, 2**70]):
        batch.reset(seed=seed)
        sync.reset(seed=seed)
        assert batch.np_random_seed == sync.np_random_seed == ((5, 6, 7) if seed == 5 else tuple(seed))
        assert batch.get_attr("np_random_seed") == batch.np_random_seed
        assert [one.random() for one in batch.np_random] == [one.random() for one in sync.np_random]
    assert all(one is other for one, other in zip(batch.np_random, batch.task.generators))
    # a part of them
    batch.reset(seed=[1, None, None], options={"reset_mask": np.array([True, False, False])})
    assert batch.np_random_seed == (1, 3, 2**70)
    state = batch.get_state()
    batch.set_state(state)
    assert batch.np_random_seed == (-1, -1, -1)


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_generator_that_is_read_or_given_is_the_one_that_draws(num_envs):
    class Drawing(Count):
        def begin(self, env, rng, options):
            self.drawn = rng.random()
            return super().begin(env, rng, options)

    kinds = [type("Made", (kind,), {"task_class": Drawing}) for kind in (CountEnv, CountVectorEnv)]
    env = kinds[0]() if num_envs is None else kinds[1](num_envs)
    # read before the first reset, it is what that goes on with
    seeds = env.np_random_seed
    env.reset()
    assert env.np_random_seed == seeds
    last = seeds if num_envs is None else seeds[-1]
    assert env.task.drawn == np.random.Generator(np.random.PCG64(np.random.SeedSequence(last))).random()
    generators = [np.random.default_rng(7 + i) for i in range(num_envs or 1)]
    env.np_random = generators[0] if num_envs is None else generators
    env.reset()
    assert env.task.drawn == np.random.default_rng(7 + len(generators) - 1).random()
    assert env.np_random_seed == (-1 if num_envs is None else (-1, -1))
    with pytest.raises(ValueError, match="np_random"):
        env.np_random = [generators[0]] * 5

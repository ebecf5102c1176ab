"""Every registered environment: conformance, autoreset, bad input, containment.  What is one task's alone is in its own file."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import clothgym
from clothgym.envs import ClothEnv, ClothVectorEnv, Task
from clothgym.envs.answers import key_of
from clothgym.envs.episode import DIVERGED, OUT_OF_BOUNDS
from clothgym.registration import ENVIRONMENTS

every_id = pytest.mark.parametrize("env_id", list(ENVIRONMENTS))
STANDARD = [env_id for env_id in ENVIRONMENTS if "-Hard" not in env_id]
# a harder tier differs in its sheet, its start and what it draws alone, and a goal environment gives parts of its state vector
TASKS = [env_id for env_id in ENVIRONMENTS if "-Hard" not in env_id and "Goal" not in env_id]
every_task = pytest.mark.parametrize("env_id", TASKS)
# of what all tasks share, on a grid and on triangles; and on those whose tasks override a part of it, see OVERRIDDEN
TWO = ["ClothDrape-v0", "ClothHook-v0"]
two_tasks = pytest.mark.parametrize("env_id", TWO)
every_path = pytest.mark.parametrize("env_id", [*TWO, "ClothDrapeGripper-v0", "ClothFoldGoal-v0"])


EXPERT_SEEDS = {"ClothCanonicalize-v0": 2}  # where the expert fails in the episodes of seeds 0 and 1


def make(env_id, **kwargs):
    return gym.make(f"clothgym:{env_id}", **kwargs)


def make_vec(env_id, num_envs, **kwargs):
    return gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, **kwargs)


def still(env):
    """Attachments that stay where they are."""
    return np.zeros(env.action_space.shape, np.float32)


def drawn(env, seed=0):
    """Actions without end, the same for the same shape and seed."""
    rng = np.random.default_rng(seed)
    while True:
        yield rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)


def flat(observation):
    """An observation as one array, of goals as well."""
    return np.concatenate(list(observation.values()), axis=-1) if isinstance(observation, dict) else observation


def length(task):
    """Steps of an episode that goes on to its evaluation."""
    return task.acting_steps + task.settling_steps


def skip(task, env, steps):
    """Take time from an environment's episode, so that it ends before the others."""
    task.episode["step"][env] += steps


# --- what is shared -------------------------------------------------------------------------------------------------------

PATH = {
    Task: "reset step advance move check_ready infos info_of get_state set_state steps_taken most_steps control_steps_taken"
    " commands _checked _checked_options _control_step"
    " _draw _drawn _draw_material _place_colliders _begin _score_and_observe _memory _prepare_records _compile",
    ClothEnv: "reset step render turn get_state set_state expert_action __getstate__ get_keys_to_action",
    ClothVectorEnv: "reset step render turn get_state set_state expert_actions __getstate__ call get_attr set_attr",
}
OVERRIDDEN = {  # macro actions; where grippers begin; another frame; rewards of goals
    "GripperTask": {"commands", "_drawn"},
    "DirectedTask": {"commands"},
    "FoldGoalTask": {"advance"},
}


def derived(cls):
    return [one for child in cls.__subclasses__() for one in (child, *derived(child)) if one.__module__.startswith("clothgym.envs")]


def test_only_listed_tasks_override_shared_methods():
    """Error paths and autoreset are tested on two tasks, and on one of each that overrides a part of that path."""
    found = {}
    for base, path in PATH.items():
        assert all(hasattr(base, name) for name in path.split())
        for cls in derived(base):
            if own := set(vars(cls)) & set(path.split()):
                found[cls.__name__] = own
    assert found == OVERRIDDEN


# --- conformance ----------------------------------------------------------------------------------------------------------


@every_id
def test_gymnasium_checker_passes_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # rendering is checked too; the checker makes the environment again for each render mode
        check_env(make(env_id).unwrapped)


@every_id
def test_stable_baselines3_checker_passes_without_a_warning(env_id):
    check_sb3 = pytest.importorskip("stable_baselines3.common.env_checker").check_env
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3(make(env_id).unwrapped)


@every_id
def test_importing_registers_and_the_spec_is_json(env_id):
    assert env_id in gym.registry
    clothgym.register()
    env = gym.make(env_id, randomize={"density": [0.1, 0.2]}, wind={"speed": [0, 1]}, integrator="xpbd")
    assert "xpbd" in env.spec.to_json()


@pytest.mark.parametrize(
    ("env_id", "obs_mode"), [*[(env_id, "keypoints") for env_id in ENVIRONMENTS], *[(env_id, "particles") for env_id in TWO]]
)
def test_observations_lie_in_their_space_and_are_fresh(env_id, obs_mode):
    env = make(env_id, obs_mode=obs_mode)
    previous, _ = env.reset(seed=0)
    for _, action in zip(range(30), drawn(env)):
        observation, _, terminated, *_ = env.step(action)
        assert observation in env.observation_space
        parts = [(observation, previous)] if isinstance(observation, np.ndarray) else zip(observation.values(), previous.values())
        assert not any(np.shares_memory(*part) for part in parts)
        previous = env.reset()[0] if terminated else observation


@pytest.mark.parametrize(
    ("env_id", "policy"), [*[(env_id, "expert") for env_id in STANDARD], *[(env_id, "random") for env_id in TWO]]
)
def test_info_explains_the_reward_and_the_evaluation(env_id, policy):
    env = make(env_id)
    env.reset(seed=EXPERT_SEEDS.get(env_id, 0))
    of_evaluation = {"normalized_performance", "is_success", *(key_of(name) for name, *_ in env.unwrapped.task.evaluation)}
    steps, terminated, actions = 0, False, drawn(env)
    while not terminated:
        action = next(actions) if policy == "random" else env.unwrapped.expert_action()
        _, reward, terminated, truncated, info = env.step(action)
        steps += 1
        assert not truncated
        assert info.keys() >= of_evaluation | {"strain_max", "settling", "failure", "reward/progress"}
        assert reward == pytest.approx(sum(value for key, value in info.items() if key.startswith("reward/")), abs=1e-12)
        assert isinstance(info["is_success"], bool) and 0 <= info["normalized_performance"] <= 1
        assert terminated or not (info["is_success"] or info["normalized_performance"] or info["failure"])
    assert info["failure"] or steps <= length(env.unwrapped.task)
    assert not (info["failure"] and (info["is_success"] or info["normalized_performance"]))
    assert policy == "random" or info["normalized_performance"] > 0.3


@pytest.mark.parametrize(("env_id", "reward_mode"), [(TWO[0], "delta"), (TWO[0], "sparse"), (TWO[1], "delta")])
def test_the_return_is_within_the_documented_bounds(env_id, reward_mode):
    """Sparse: the performance at the evaluation alone.  Delta: within the potential's span, the bonus and the penalty."""
    env = make_vec(env_id, 3, reward_mode=reward_mode, autoreset_mode="Disabled")
    env.reset(seed=0)
    total = np.zeros(3)
    while (running := ~env.unwrapped.task.episode["over"]).any():
        _, reward, terminated, _, info = env.step(env.unwrapped.expert_actions())
        total += reward
        final = info["normalized_performance"]
        if reward_mode == "sparse":
            assert np.array_equal(reward, np.where(running, final, 0))
    if reward_mode == "delta":
        assert np.all(total <= 1.25) and np.all(total >= -1.5)
    else:
        assert total == pytest.approx(final)


@two_tasks
def test_stepping_before_the_first_reset_is_refused(env_id):
    for env in (make(env_id).unwrapped, make_vec(env_id, 2)):
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            env.step(still(env))


@two_tasks
def test_states_of_another_kind_are_refused(env_id):
    keypoints, particles = make(env_id).unwrapped, make(env_id, obs_mode="particles").unwrapped
    with pytest.raises(ValueError, match="before the first reset"):
        keypoints.set_state(keypoints.get_state())
    keypoints.reset(seed=0)
    particles.reset(seed=0)
    with pytest.raises(ValueError, match="observation"):
        particles.set_state(keypoints.get_state())


@two_tasks
def test_pictures(env_id):
    env = make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8 and first.std() > 10
    depth = make(env_id, render_mode="depth_array")
    depth.reset(seed=0)
    image = depth.render()
    assert image.shape == (480, 480) and np.isfinite(image[400:]).all()


@two_tasks
@pytest.mark.filterwarnings("ignore:.*human")
def test_the_human_window_comes_from_the_gymnasium_wrapper(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    env = make(env_id, render_mode="human")
    env.reset(seed=0)
    env.step(still(env))
    env.close()


# --- bad input and failures -----------------------------------------------------------------------------------------------


@two_tasks
@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"integrator": "leapfrog"}, "xpbd"),
        ({"obs_mode": "pixels"}, "keypoints"),
        ({"reward_mode": "dense"}, "delta"),
        ({"render_mode": "ansi"}, "rgb_array"),
        ({"substeps": 0}, "substeps=0"),
        ({"randomize": {"mass": [1, 2]}}, "density"),
        ({"randomize": {"density": [2, 1]}}, "range"),
        ({"randomize": {"density": [-1, 1]}}, "density=-1"),
        ({"randomize": ["density"]}, "dict"),
        ({"randomize": {"stretch_stiffness": [50, 261.1], "bend_rigidity": [0, 1e-2]}}, "no springs"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_bad_keywords_are_named(env_id, kwargs, name):
    if name == "no springs" and env_id == "ClothHook-v0":
        return  # a triangle mesh bends by its hinges, whatever its springs
    with pytest.raises(ValueError, match=name):
        make(env_id, **kwargs)


@two_tasks
def test_an_unknown_keyword_and_bad_batches_are_named(env_id):
    with pytest.raises(TypeError, match="integrater"):
        make(env_id, integrater="xpbd")
    with pytest.raises(ValueError, match="num_envs=0"):
        make_vec(env_id, 0)
    with pytest.raises(ValueError, match="SameStep"):
        make_vec(env_id, 2, autoreset_mode="Sometimes")


@every_path
@pytest.mark.parametrize("bad", ["nan", "infinite", "too short", "too long", "a number"])
def test_bad_actions_raise_before_anything_moves(env_id, bad):
    env, batch = make(env_id).unwrapped, make_vec(env_id, 2).unwrapped
    for each in (env, batch):
        shape = each.action_space.shape
        action = {
            "nan": np.where(np.arange(shape[-1]) == 1, np.nan, np.zeros(shape)),
            "infinite": np.full(shape, -np.inf),
            "too short": np.zeros((*shape[:-1], shape[-1] - 1)),
            "too long": np.zeros((*shape[:-1], shape[-1] + 1)),
            "a number": 0.5,
        }[bad]
        each.reset(seed=0)
        before = each.get_state()
        with pytest.raises(ValueError, match="action"):
            each.step(action)
        after = each.get_state()
        assert np.array_equal(before.simulation.positions, after.simulation.positions)
        assert np.array_equal(before.simulation.attachment_targets, after.simulation.attachment_targets)
        assert np.array_equal(before.episode["step"], after.episode["step"])


@every_path
@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"materials": "silk"}, "no reset option 'materials': did you mean 'material'"),
        ({"gaol": (0, 0, 1)}, "gaol"),
        ({"material": {"mass": 1}}, "mass"),
        ({"material": {"density": -1}}, "density"),
        ({"material": {"bend_rigidity": 0.1}}, "bend_rigidity"),
        ({"material": "corduroy"}, "corduroy"),
        ({"material": ["cotton"]}, "preset's name"),
    ],
)
def test_bad_reset_options_are_named_and_leave_nothing_behind(env_id, options, name):
    if name == "bend_rigidity" and env_id == "ClothHook-v0":
        return  # a triangle mesh bends by its hinges, whatever its springs
    env = make(env_id).unwrapped
    fresh, _ = env.reset(seed=0)
    properties = env.task.simulation.parameters
    env.reset(seed=1, options={"material": {"density": 0.3}})
    for _ in range(2):
        with pytest.raises(ValueError, match=name):
            env.reset(seed=0, options=options)
    again, _ = env.reset(seed=0)
    assert np.array_equal(flat(again), flat(fresh)) and np.array_equal(env.task.simulation.parameters, properties)


def test_reset_options_of_evaluators_are_ignored_and_those_of_other_tasks_refused():
    env = make("ClothFold-v0")
    fresh, _ = env.reset(seed=0)
    again, _ = env.reset(seed=0, options={"lerobot_new_rollout": True, 3: None})
    assert np.array_equal(flat(again), flat(fresh))
    with pytest.raises(ValueError, match="no reset option 'target' in this task"):
        env.reset(seed=0, options={"target": {"shape": "box"}})


@two_tasks
def test_a_material_is_for_one_episode(env_id):
    env = make(env_id).unwrapped
    env.reset(seed=0, options={"material": {"density": 0.3}})
    assert env.get_state().simulation.parameters[0, 0] == 0.3
    env.reset(seed=0)
    assert env.get_state().simulation.parameters[0, 0] == env.task.physics.material.density != 0.3


@two_tasks
def test_randomized_materials_stay_in_their_range_and_differ(env_id):
    env = make_vec(env_id, 20, randomize={"density": [0.1, 0.2]})
    env.reset(seed=0)
    densities = env.get_state().simulation.parameters[:, 0]
    assert len(set(densities)) == 20 and densities.min() >= 0.1 and densities.max() <= 0.2


@every_task
def test_a_diverged_environment_is_contained(env_id):
    """An explicit step far beyond the bound in one lane: it ends with a penalty and its last finite observation.

    Without self-collision, whose displacement bounds hold such a sheet together until it tears.
    """
    stiff = np.array([False, True, False])
    runs = []
    for spoil in (False, True):
        env = make_vec(env_id, 3, autoreset_mode="Disabled", integrator="semi_implicit_euler", self_collision=False)
        env.reset(seed=0)
        env.step(still(env))
        if spoil:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                env.unwrapped.task.simulation.set_parameters(stiff, stretch_stiffness=261.1 * 1000)
        runs.append([(flat(seen), *brought) for seen, *brought in (env.step(still(env)) for _ in range(12))])
    ends = [step for step, result in enumerate(runs[1]) if result[2][1]]
    # and goes on saying so
    assert ends == list(range(ends[0], 12))
    _, reward, _, truncated, info = runs[1][ends[0]]
    assert info["failure"].tolist() == [0, DIVERGED, 0]
    assert reward[1] < -0.4 and not truncated.any() and not info["is_success"][1]
    if ends[0]:
        assert np.array_equal(runs[1][ends[0]][0][1], runs[1][ends[0] - 1][0][1])
    for sound, spoilt in zip(*runs):
        assert np.isfinite(spoilt[0]).all() and np.isfinite(spoilt[1]).all()
        assert np.array_equal(sound[0][[0, 2]], spoilt[0][[0, 2]])
        assert np.array_equal(sound[1][[0, 2]], spoilt[1][[0, 2]])


@every_task
def test_a_sheet_thrown_out_of_the_arena_ends_the_episode(env_id):
    env = make(env_id).unwrapped
    env.reset(seed=0)
    task = env.task
    high = task.arena()[1]
    state = task.simulation.get_state()
    state.positions[0] += high - state.positions[0].mean(axis=0) + (0.6, 0, 0)
    state.velocities[:], state.holder[:] = 0, -1
    task.simulation.set_state(state)
    *_, terminated, _, info = env.step(still(env))
    assert terminated and info["failure"] == OUT_OF_BOUNDS
    assert info["normalized_performance"] == 0 and not info["is_success"]


@two_tasks
def test_render_color_shows_the_strain(env_id):
    """With strain the picture differs from the fabric's where the sheet is, and nowhere else; a batch shows the same."""
    fabric, hot = (make(env_id, render_mode="rgb_array", render_color=color) for color in ("fabric", "strain"))
    images = []
    for env in (fabric, hot):
        env.reset(seed=3)
        for _ in range(3):
            env.step(env.unwrapped.expert_action())
        images.append(env.render().astype(int))
    differs = np.abs(images[0] - images[1]).max(axis=2) > 40
    assert 0.005 < differs.mean() < 0.5
    batch = make_vec(env_id, num_envs=2, render_mode="rgb_array", render_color="strain")
    batch.reset(seed=3)
    assert len({picture.tobytes() for picture in batch.render()}) == 2
    with pytest.raises(ValueError, match="render_color='heat': must be 'fabric' or 'strain'"):
        make(env_id, render_color="heat")

"""What a task is made of: somebody else's in plain NumPy, its pages, keywords, fabrics and look-up of observations."""

import inspect
import re
import warnings

import gymnasium as gym
import hang_towel
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from test_envs import every_task, two_tasks

import clothgym.envs
from clothgym import Gripper, Material, Plane, grid
from clothgym.cli import main
from clothgym.envs import ClothEnv, ClothVectorEnv, GripperTask, Physics, Task
from clothgym.layout import Layout
from clothgym.playground.gallery import Gallery
from clothgym.registration import ENVIRONMENTS, checked_id

TOWEL = "hang_towel:HangTowel-v0"
SILK = {"density": 0.083, "stretch_stiffness": 102.6, "shear_stiffness": 51.3, "bend_rigidity": 2.77e-7}


def heights(env):
    """Of the middle of the towel [m], in float64: the weights of a grid's border and corners are a half and a quarter."""
    line = np.array([0.5, *[1.0] * 7, 0.5])
    weights = np.outer(line, line).ravel()
    return env.unwrapped.task.simulation.positions[..., 2].astype(float) @ weights / weights.sum()


def lifting(way):
    """Both corners up or down by what is left of the way, (..., 6)."""
    action = np.zeros((*np.shape(way), 6))
    action[..., [2, 5]] = np.clip(6 * np.asarray(way), -1, 1)[..., None]
    return action


# --- somebody else's task -------------------------------------------------------------------------------------------------


def test_the_example_task_is_short_and_has_no_kernel():
    source = inspect.getsource(hang_towel)
    assert len(source.splitlines()) <= 45 and "kernel" not in source and "._" not in source and " _" not in source


def test_gymnasium_checker_passes_for_a_custom_task():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(TOWEL).unwrapped)


def test_a_custom_task_has_its_declared_reward_and_observations():
    env = gym.make(TOWEL).unwrapped
    observation, _ = env.reset(seed=3)
    goal = float(env.task.episode["goal"][0])
    assert 0.5 <= goal <= 0.7 and observation[54] == pytest.approx(goal)
    before, total, terminated, steps = 0.0, 0.0, False, 0
    while not terminated:
        assert observation[55] == pytest.approx(goal - heights(env)[0], abs=1e-6)
        action = lifting(observation[55])
        observation, reward, terminated, truncated, info = env.step(action)
        after = max(1 - abs(goal - heights(env)[0]) / (goal - 0.3), 0)
        effort = 0.001 * (action**2).sum()
        bonus = 0.25 if terminated and abs(goal - heights(env)[0]) < 0.05 else 0
        assert reward == pytest.approx(after - before - effort * (steps < 40) + bonus, abs=1e-5)
        before, total, steps = after, total + reward, steps + 1
        assert not truncated
    assert steps == 40 and info["is_success"] and info["normalized_performance"] == pytest.approx(after, abs=1e-6)
    assert 1.0 < total <= 1.25


def test_its_batch_equals_its_single_environments_and_its_seeds_their_episodes():
    batch = gym.make_vec(TOWEL, num_envs=5, threads=2)
    assert isinstance(batch.unwrapped, ClothVectorEnv)
    first, _ = batch.reset(seed=7)
    again, _ = batch.reset(seed=7)
    assert np.array_equal(first, again) and len({row.tobytes() for row in first}) == 5
    singles = [gym.make(TOWEL) for _ in range(5)]
    assert np.array_equal(first, np.stack([env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]))
    for action in np.random.default_rng(0).uniform(-1, 1, (12, 5, 6)):
        observation, reward, *_ = batch.step(action)
        for i, env in enumerate(singles):
            own, own_reward, *_ = env.step(action[i])
            assert np.array_equal(own, observation[i]) and own_reward == reward[i]


def test_tools_take_it(tmp_path, capsys):
    sb3 = pytest.importorskip("clothgym.adapters.sb3")
    env = sb3.make_sb3_vec_env(TOWEL, 3, seed=0)
    assert env.reset().shape == (3, 56)
    for _ in range(40):
        observation, _, done, infos = env.step(np.zeros((3, 6)))
    assert done.all() and {"normalized_performance", "terminal_observation"} <= infos[0].keys()
    assert main(["export", TOWEL, "--out", str(tmp_path / "a.png"), "--size", "64", "--seconds", "0.1"]) == 0
    assert (tmp_path / "a.png").stat().st_size > 500
    gallery = Gallery()
    assert gallery.open(gallery.checked(TOWEL)).env.task.physics.mesh is hang_towel.TOWEL and TOWEL in gallery.titles


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("CartPole-v1", "'CartPole-v1' is no clothgym environment"),
        ("ClothDrap-v0", "did you mean 'ClothDrape-v0'"),
        ("no_such_module:Towel-v0", "'no_such_module' cannot be imported"),
        ("hang_towel:HangTowel-v7", "no environment 'hang_towel:HangTowel-v7'"),
    ],
)
def test_other_ids_are_refused(env_id, message):
    assert checked_id("ClothDrape-v0") == checked_id("clothgym:ClothDrape-v0") == "ClothDrape-v0"
    with pytest.raises(ValueError, match=re.escape(message)):
        checked_id(env_id)


@pytest.mark.parametrize("missing", ["performance", "success"])
def test_a_task_that_cannot_be_evaluated_is_refused(missing):
    methods = {name: value for name, value in vars(hang_towel.HangTowel).items() if name != missing}
    with pytest.raises(TypeError, match=rf"Towel does not define {missing}\(\)"):
        type("Towel", (Task,), methods)(1)


# --- hooks and their defaults ---------------------------------------------------------------------------------------------


class Counting(Task):
    """A sheet on the floor, of which the hooks are counted."""

    physics = Physics(grid(5, 5, 0.2, 0.2), Material.preset("penava_cotton"), 1 / 30, "semi_implicit_euler", 40, 0.5, anchors=(24,))
    acting_steps = 6
    accounts = (("calls", int),)

    def __init__(self, num_envs, **kwargs):
        self.calls = []
        super().__init__(num_envs, **kwargs)

    def before_step(self, actions):
        self.calls.append(("before", float(actions[0, 2]), self.simulation.get_state().steps[0]))

    def after_step(self):
        self.calls.append(("after", float(self.simulation.attachment_positions[0, 0, 2]), self.simulation.get_state().steps[0]))
        self.info["calls"] = len(self.calls)

    def performance(self):
        return 5 * self.simulation.attachment_positions[:, 0, 2] - 3.0  # beyond [0, 1] on both sides

    def success(self):
        return self.simulation.attachment_positions[:, 0, 2] > 10

    def done(self):
        return self.episode["step"] == 4


class Picking(GripperTask):
    """One gripper above the corner of a sheet that lies on the floor."""

    physics = Physics(
        grid(5, 5, 0.2, 0.2), Material.preset("penava_cotton"), 1 / 30, "semi_implicit_euler", 40, 0.6,
        grippers=(Gripper(position=(0.1, 0.1, 0.03), reach=0.03),),
    )  # fmt: skip
    acting_steps, settling_steps = 30, 5

    def performance(self):
        return 5 * self.simulation.positions[:, 24, 2]

    def success(self):
        return self.simulation.grippers.held[:, 0] > 0


def env_of(task):
    return type("Env", (ClothEnv,), {"task_class": task})()


def test_hooks_are_called_around_the_physics_and_write_info():
    env = env_of(Counting)
    env.reset(seed=0)
    *_, info = env.step([0, 0, 0.5])
    z = 0.01 + 0.5 * 0.5 / 30
    assert env.task.calls == [("before", 0.5, 0), ("after", pytest.approx(z, abs=1e-6), 1)] and info["calls"] == 2


def test_undefined_hooks_have_defaults():
    env = env_of(Counting)
    observation, _ = env.reset(seed=0)
    task = env.task
    assert env.observation_slices == {"keypoints": slice(0, 27), "velocities": slice(27, 54), "time_left": slice(54, 55)}
    assert observation[:3] == pytest.approx([-0.5, -0.5, 0.05]) and observation[54] == 1
    assert not task.expert_actions().any() and task.expert_actions().shape == (1, 3)
    assert [type(one) for one in task.colliders()] == [Plane] and task.solids(0) == []
    low, high = task.arena()
    assert low.tolist() == [-0.4, -0.4, 0.01] and high.tolist() == [0.4, 0.4, 0.4]
    assert env.render_mode is None and task.camera().eye[2] > 0.2
    assert env.step([0, 0, 0])[0][54] == pytest.approx(5 / 6)


def test_an_agent_that_is_done_ends_its_episode_and_the_performance_is_kept_within_0_and_1():
    env = env_of(Counting)
    env.reset(seed=0)
    results = [env.step([0, 0, 1.0]) for _ in range(4)]
    assert [result[2] for result in results] == [False, False, False, True]
    assert results[-1][4]["normalized_performance"] == 0 and [result[1] for result in results] == pytest.approx([-0.001] * 4)


def test_a_gripper_task_picks_up_lifts_and_opens_when_time_is_up():
    env = env_of(Picking)
    env.reset(seed=0)
    assert env.action_space.shape == (4,)
    for _ in range(4):
        env.step([0, 0, -0.5, -1])
    assert env.task.simulation.grippers.held[0, 0] > 0
    for _ in range(20):
        *_, info = env.step([0, 0, 0.2, 0])
    lifted = env.task.simulation.positions[0, 24, 2]
    assert lifted == pytest.approx(0.01 + 20 * 0.2 * 0.6 / 30, abs=0.03)
    results = [env.step([0, 0, 0, 0]) for _ in range(11)]
    assert results[-1][2] and env.task.simulation.grippers.held[0, 0] == 0
    assert len(env.task.markers(0)) == 3


# --- keywords and fabrics -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["ClothDrape-v0", "ClothHook-v0", TOWEL])
def test_a_wrong_keyword_gets_the_list_of_right_ones(env_id):
    for maker in (gym.make, lambda name, **kwargs: gym.make_vec(name, num_envs=2, **kwargs)):
        with pytest.raises(TypeError, match="'integrater'; did you mean 'integrator'.*there are: .*fabric.*threads.*render_color"):
            maker(env_id if ":" in env_id else f"clothgym:{env_id}", integrater="xpbd")


def test_own_keywords_of_a_task_are_listed_as_valid():
    with pytest.raises(TypeError, match="there are: grippers, shapes, slip_force, action_mode, rows, side, fabric"):
        gym.make("clothgym:ClothDrapeGripper-v0", gripers=1)
    with pytest.raises(TypeError, match="there are: threshold, cost_penalty, strain_limit, integrator, rows, side, fabric"):
        gym.make_vec("clothgym:ClothStrain-v0", num_envs=2, treshold=1)
    with pytest.raises(TypeError, match="'garment', which ClothFoldShirt-v0 and ClothFoldShirt-Hard-v0 take .there"):
        gym.make("clothgym:ClothFold-v0", garment="tshirt")


@two_tasks
@pytest.mark.filterwarnings("ignore:.*substeps")
def test_a_fabric_by_name_has_the_measured_properties_and_the_task_air_drag(env_id):
    env, usual = gym.make(f"clothgym:{env_id}", fabric="silk").unwrapped, gym.make(f"clothgym:{env_id}").unwrapped
    own, silk = type(env.task).physics.material, env.task.simulation.material
    assert {name: getattr(silk, name) for name in SILK} == SILK
    assert (silk.air_drag, silk.damping_time) == (own.air_drag, own.damping_time)
    # of all episodes, and of one
    for each, options in ((env, None), (usual, {"material": "silk"})):
        each.reset(seed=0, options=options)
        measured = dict(zip(SILK, each.get_state().simulation.parameters[0, :4].tolist()))
        if each.task.physics.mesh.shape is None:  # its shear follows from its edges
            measured["shear_stiffness"] = SILK["shear_stiffness"]
        assert measured == SILK
    usual.reset(seed=0)
    assert usual.get_state().simulation.parameters[0, 0] == own.density
    assert "silk" in gym.make(f"clothgym:{env_id}", fabric="silk").spec.to_json()


def test_another_fabric_has_automatic_substeps_and_the_default_keeps_its_own():
    # twice as heavy, stiff and damped moves alike
    denim = {"density": 0.4, "stretch_stiffness": 1615.7, "shear_stiffness": 807.8, "bend_rigidity": 5.865e-5, "air_drag": 0.394}
    double = Material(**{name: 2 * value for name, value in denim.items()})
    tuned, own, auto, named, given = (
        gym.make("clothgym:ClothDrape-v0", **kwargs).unwrapped.task.simulation
        for kwargs in ({}, {"fabric": "median"}, {"substeps": "auto"}, {"fabric": "denim"}, {"fabric": double})
    )
    assert tuned.substeps == own.substeps == 50 and tuned.material == own.material
    assert named.substeps == given.substeps > 1.3 * auto.substeps
    assert given.material == double


@pytest.mark.parametrize("fabric", ["velvet", 3, {"density": 1}])
def test_an_unknown_fabric_lists_the_known_ones(fabric):
    known = "median, cotton_broad.*penava_cotton, knit, polyester, silk, wool, denim"
    with pytest.raises(ValueError, match=known):
        gym.make("clothgym:ClothReach-v0", fabric=fabric)
    env = gym.make("clothgym:ClothReach-v0").unwrapped
    if not isinstance(fabric, dict):
        with pytest.raises(ValueError, match=known):
            env.reset(seed=0, options={"material": fabric})


def test_contact_and_air_density_reach_the_simulation():
    kwargs = {}, {"contact": "particles"}, {"physics": "fast"}, {"physics": "fast", "contact": "sheet"}
    tasks = [gym.make("clothgym:ClothDrape-v0", **each).unwrapped.task.simulation for each in kwargs]
    assert [task.contact for task in tasks] == ["sheet", "particles", "particles", "sheet"]
    assert [task.air_density for task in tasks] == [1.2, 1.2, 0, 0]
    assert gym.make("clothgym:ClothDrape-v0", wind={}).unwrapped.task.simulation.air_density == 1.2
    assert gym.make("clothgym:ClothDrape-v0", wind={}, air_density=0.9).unwrapped.task.simulation.air_density == 0.9
    with pytest.raises(ValueError, match="contact='edges'"):
        gym.make("clothgym:ClothDrape-v0", contact="edges")
    with pytest.raises(ValueError, match="air_density=-1"):
        gym.make("clothgym:ClothDrape-v0", air_density=-1)


# --- pages and observations -----------------------------------------------------------------------------------------------


def rows(env_id, heading):
    """Cells of the table under a heading of an id's page."""
    page = getattr(clothgym.envs, f"{ENVIRONMENTS[env_id][0]}Env").__doc__
    lines = inspect.cleandoc(page).split(f"## {heading}\n")[1].split("\n## ")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if line.startswith("|")][2:]


@every_task
def test_the_page_table_has_the_slice_and_bound_of_each_observation(env_id):
    env = gym.make(f"clothgym:{env_id}").unwrapped
    table, space = rows(env_id, "Observation Space"), env.observation_space
    assert [row[1].strip("`") for row in table] == list(env.observation_slices)
    end = 0
    for row in table:
        first, last = (int(row[0].split("-")[k]) for k in (0, -1))
        assert first == end and env.observation_slices[row[1].strip("`")] == slice(first, last + 1)
        end = last + 1
        bounds = {float(bound) for bound in row[4].split(",")}
        assert set(space.high[first:end].tolist()) == bounds and np.array_equal(space.low, -space.high)
    assert space.shape == (end,)
    assert f"``Box`` of {end} numbers" in type(env).__doc__
    particles = gym.make(f"clothgym:{env_id}", obs_mode="particles").unwrapped
    assert (
        f"6 x {len(particles.task.particles)} + {particles.observation_space.shape[0] - 6 * len(particles.task.particles)} for"
        in (type(env).__doc__)
    )


@every_task
def test_the_page_table_has_every_keyword_and_its_default(env_id):
    env = gym.make(f"clothgym:{env_id}").unwrapped
    table = {row[0].strip("`"): row[1:] for row in rows(env_id, "Arguments")}
    simulation = env.task.simulation
    # the garments of an id differ in what they need
    with_garments = "Shirt" in env_id or env_id == "ClothCanonicalize-v0"
    assert table["substeps"][0] == ("auto" if with_garments else str(simulation.substeps))
    assert simulation.integrator.name in table["integrator"][0]
    assert float(table["air_density"][0]) == simulation.air_density
    assert all(len(meaning) > 5 for _, meaning in table.values())
    with pytest.raises(TypeError) as caught:
        gym.make(f"clothgym:{env_id}", nonsense=1)
    known = re.search(r"there are: ([^)]*)\)", str(caught.value)).group(1).split(", ")
    # a mesh that is no grid has one size
    assert set(table) <= set(known) and set(known) - set(table) == (set() if env.task.physics.mesh.shape else {"rows", "side"})


def test_observations_are_found_by_name_in_a_batch_of_any_kind():
    for kwargs, keys in (({}, 9), ({"obs_mode": "particles"}, 289)):
        env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=2, **kwargs)
        observation, _ = env.reset(seed=0)
        slices = env.unwrapped.observation_slices
        points = observation[:, slices[kwargs.get("obs_mode", "keypoints")]].reshape(2, keys, 3)
        x, tops = env.unwrapped.task.simulation.positions, [target.top for target in env.unwrapped.task.targets]
        assert points[:, 0] == pytest.approx((x[:, 0] - tops) / 0.6, abs=1e-5)
        assert observation[:, slices["target_height"]].ravel() == pytest.approx([top[2] / 0.6 for top in tops])
    one = gym.make("clothgym:ClothDrapeGripper-v0", grippers=1).unwrapped
    assert one.observation_slices["grippers"] == slice(67, 74) and one.observation_space.shape == (74,)


def test_a_task_without_a_page_gets_a_generated_one():
    page = hang_towel.HangTowelEnv.__doc__
    assert "| 54 | ``goal`` | its height | m | 1 |" in page and "``fabric``" in page
    assert env_of(Counting).__doc__.startswith("A sheet on the floor")
    # what a page does not ask for is not added
    assert "## Episode End" not in page
    assert (
        type("Env", (ClothEnv,), {"task_class": Counting, "__doc__": "Mine.\n\n## About\nIt."}).__doc__ == "Mine.\n\n## About\nIt."
    )


def test_block_and_lane_of_environments():
    layout = Layout.choose(300, 2, any_order=False, regular=True)
    marked = layout.to_blocks(np.arange(300.0)[:, None], np.dtype(np.float64))
    block, lane = layout.at(np.array([0, 7, 150, 299]))
    assert marked[block, 0, lane].tolist() == [0, 7, 150, 299] and layout.blocks > 1
    assert tuple(map(int, Layout.choose(5, 1, any_order=True, regular=True).at(3))) == (3, 0)

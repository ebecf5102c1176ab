"""Pictures and point clouds as observations: bits, autoreset, states, copies, checkers, learners, and what may be asked for."""

import copy
import json
import pickle
import warnings

import gymnasium as gym
import hang_towel
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from test_envs import TASKS, drawn, make, make_vec, still

from clothgym.envs.episode import DIVERGED

PICTURES = ("heightmap", "pointcloud", "rgb", "depth", "rgbd")
SHAPES = {"heightmap": (64, 64), "pointcloud": (256, 3), "rgb": (64, 64, 3), "depth": (64, 64, 1), "rgbd": (64, 64, 4)}
DRAPE, GRIPPER = "ClothDrape-v0", "ClothDrapeGripper-v0"
every_mode = pytest.mark.parametrize("mode", PICTURES)


def end_soon(task, env):
    """Let an environment's sheet have settled two steps from now."""
    task.episode["settling_since"][env] = task.acting_steps
    task.episode["step"][env] = task.acting_steps + task.settling_steps - 2


# --- what there is --------------------------------------------------------------------------------------------------------


# each task in one mode, and one in all
@pytest.mark.parametrize(("env_id", "mode"), [(GRIPPER, mode) for mode in PICTURES] + list(zip(TASKS, 2 * PICTURES)))
def test_every_task_has_every_mode_and_a_batch_the_pictures_of_its_single_environments(env_id, mode):
    """To the bit, in batches of 1 and 3, on 1 and 2 threads, fresh arrays within their space."""
    batch, pair = make_vec(env_id, 3, obs_mode=mode, threads=1), make_vec(env_id, 9, obs_mode=mode, threads=2)
    single = make(env_id, obs_mode=mode)
    assert single.observation_space.shape == SHAPES[mode] and single.observation_space.dtype == batch.observation_space.dtype
    first, many, one = batch.reset(seed=3)[0], pair.reset(seed=3)[0], single.reset(seed=5)[0]
    assert one.dtype == (np.uint8 if mode == "rgb" else np.float32)
    changed = False
    for actions, _ in zip(drawn(pair), range(6)):
        assert first.shape == (3, *SHAPES[mode]) and one in single.observation_space and first in batch.observation_space
        assert np.array_equal(first[2], one) and np.array_equal(many[:3], first)
        before = one.copy()
        first, many, one = batch.step(actions[:3])[0], pair.step(actions)[0], single.step(actions[2])[0]
        changed |= not np.array_equal(one, before)
    assert changed and not np.shares_memory(first, batch.step(actions[:3])[0])


@pytest.mark.parametrize(("mode", "privileged"), [*[(mode, False) for mode in PICTURES], ("rgbd", True)])
def test_checkers_pass(mode, privileged):
    check_sb3 = pytest.importorskip("stable_baselines3.common.env_checker").check_env
    env = make(DRAPE, obs_mode=mode, privileged=privileged).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)
        # of what is neither a vector nor an image of colors it says that a policy of one's own is needed
        warnings.filterwarnings("ignore", message=".*(unconventional shape|is an image but)")
        check_sb3(env)


def test_a_privileged_observation_has_the_state_vector_of_the_default_mode():
    plain, asymmetric = make_vec(GRIPPER, 2), make_vec(GRIPPER, 2, obs_mode="depth", privileged=True)
    vector, seen = plain.reset(seed=1)[0], asymmetric.reset(seed=1)[0]
    alone = make_vec(GRIPPER, 2, obs_mode="depth")
    picture = alone.reset(seed=1)[0]
    for _, action in zip(range(4), drawn(plain)):
        assert set(seen) == {"observation", "state"}
        assert np.array_equal(seen["state"], vector) and np.array_equal(seen["observation"], picture)
        vector, seen, picture = plain.step(action)[0], asymmetric.step(action)[0], alone.step(action)[0]
    assert asymmetric.unwrapped.observation_slices == plain.unwrapped.observation_slices


def test_colors_and_depths_are_one_picture():
    colors, depths, both = (make(GRIPPER, obs_mode=mode).reset(seed=2)[0] for mode in ("rgb", "depth", "rgbd"))
    assert np.array_equal(np.rint(255 * both[..., :3]).astype(np.uint8), colors) and np.array_equal(both[..., 3:], depths)


def test_edges_of_the_mesh():
    """Of a grid of 13 x 13: 2 x 12 x 13 yarns, each between neighbors."""
    edges = make("ClothStrain-v0").unwrapped.mesh_edges
    assert edges.shape == (2 * 12 * 13, 2) and edges.dtype.kind == "i"
    step = np.abs(edges[:, 1] - edges[:, 0])
    assert np.isin(step, (1, 13)).all() and len({tuple(sorted(edge)) for edge in edges.tolist()}) == len(edges)
    assert np.all((edges // 13)[step == 1, 0] == (edges // 13)[step == 1, 1])
    batch = make_vec("ClothStrain-v0", 2, obs_mode="particles").unwrapped
    assert np.array_equal(batch.mesh_edges, edges) and np.array_equal(batch.get_attr("mesh_edges")[1], edges)


def test_custom_tasks_have_image_observations():
    assert issubclass(hang_towel.HangTowel, object)
    env = gym.make("hang_towel:HangTowel-v0", obs_mode="rgb", image_size=40)
    picture, _ = env.reset(seed=0)
    assert picture.shape == (40, 40, 3) and picture.std() > 5


# --- what they show -------------------------------------------------------------------------------------------------------


def test_a_height_map_is_the_height_of_the_sheet_over_its_place():
    """A flat sheet of 0.6 m held level at 0.3 m: half a side high on the square it covers, and the floor is zero beside it."""
    env = make(GRIPPER, obs_mode="heightmap", image_size=50).unwrapped
    env.reset(seed=0, options={"rumpled": False, "target": {"shape": "post", "radius": 0.05, "height": 0.2, "center": [0.0, 0.0]}})
    task, (middle, half) = env.task, env.task.working_area()
    state = env.get_state()
    state.simulation.positions[0] = task.physics.mesh.rest_positions + (0.12, -0.2, 0.3)
    env.set_state(state)
    heights = task.observed.one(0)
    at = (np.arange(50) + 0.5 - 25) * 2 * half / 50
    x, y = np.meshgrid(middle[0] + at, middle[1] - at)
    # clear of the outline by a rounding
    sheet = (np.abs(x - 0.12) < 0.2999) & (np.abs(y + 0.2) < 0.2999)
    beside = (np.abs(x - 0.12) > 0.3001) | (np.abs(y + 0.2) > 0.3001)
    post = np.hypot(x, y) < 0.06
    assert sheet.sum() > 100 and heights[sheet] == pytest.approx(0.5, abs=1e-6) and np.all(heights[beside & ~post] == 0)


def test_a_point_cloud_lies_on_the_sheet_in_the_units_of_the_key_points():
    env = make(DRAPE, obs_mode="pointcloud", num_points=100, privileged=True).unwrapped
    seen, _ = env.reset(seed=4)
    for _ in range(8):
        seen = env.step(env.expert_action())[0]
    assert seen["observation"].shape == (100, 3)
    corners = seen["state"][env.observation_slices["keypoints"]].reshape(9, 3)
    task = env.task
    x = (task.simulation.positions[0] - task.episode["origin"][0]) / 0.6
    assert corners[0] == pytest.approx(x[0], abs=1e-5)
    away = np.array([distance_to_triangles(point, x[task.physics.mesh.triangles].astype(float)) for point in seen["observation"]])
    assert away.max() < 1e-4
    # spread over all of it, each point once where there are enough pixels
    assert len(np.unique(seen["observation"], axis=0)) == 100
    assert np.ptp(seen["observation"][:, :2], axis=0) == pytest.approx(np.ptp(x[:, :2], axis=0), abs=0.15)


def distance_to_triangles(point, corners):
    """To the nearest of triangles, (triangles, 3, 3): to the plane inside, to the edges outside."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((point - a) * normal).sum(axis=1)
    foot = point - height[:, None] * normal
    inside = np.ones(len(a), bool)
    nearest = np.full(len(a), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(q - p, foot - p) * normal).sum(axis=1) >= 0
        share = np.clip(((point - p) * (q - p)).sum(axis=1) / ((q - p) ** 2).sum(axis=1), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(p + share[:, None] * (q - p) - point, axis=1))
    return np.where(inside, np.abs(height), nearest).min()


def test_a_point_cloud_of_few_pixels_repeats_them_and_of_none_is_zero():
    """Seen from above in 8 x 8 pixels there are fewer than 256; seen from behind the back of the camera there are none."""
    few = make(DRAPE, obs_mode="pointcloud", image_size=8).reset(seed=0)[0]
    different = len(np.unique(few, axis=0))
    assert 1 < different < 64 and few.shape == (256, 3)
    away = {"eye": [0, 0, 1.0], "target": [0, 5.0, 1.5]}
    assert not make(DRAPE, obs_mode="pointcloud", camera=away).reset(seed=0)[0][:, :].any()


def test_grippers_are_seen_and_are_not_in_height_maps():
    """As the films draw them: moved out of the picture, only pixels where they were change."""
    for mode, seen in (("depth", True), ("heightmap", False)):
        env = make(GRIPPER, obs_mode=mode).unwrapped
        before, _ = env.reset(seed=0)
        task = env.task
        task.simulation.grippers.place(np.full((1, 2, 3), 30.0), np.array([0]))
        task.observed.begun(np.array([0]))
        differs = (task.observed.one(0) != before).sum()
        assert (0 < differs < 200) if seen else differs == 0


# --- episodes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep", "Disabled"])
def test_image_observations_match_the_gymnasium_vector_env_in_every_autoreset_mode(autoreset):
    """Pictures beside the state, over an episode that ends before the others, and final ones."""
    kwargs = {"obs_mode": "depth", "privileged": True, "image_size": 24}
    mode = gym.vector.AutoresetMode(autoreset)
    native = make_vec(DRAPE, 2, autoreset_mode=mode, threads=1, **kwargs)
    sync = gym.vector.SyncVectorEnv([lambda: make(DRAPE, **kwargs).unwrapped] * 2, autoreset_mode=mode)
    seen = [env.reset(seed=5)[0] for env in (native, sync)]
    end_soon(native.unwrapped.task, 1)
    end_soon(sync.envs[1].task, 0)
    ended, actions = 0, drawn(native, seed=1)
    for _ in range(6):
        for key in ("observation", "state"):
            assert np.array_equal(seen[0][key], seen[1][key])
        action = next(actions)
        results = [env.step(action) for env in (native, sync)]
        seen = [result[0] for result in results]
        done = results[0][2]
        ended += done.any()
        if autoreset == "SameStep" and done.any():
            last = [result[4]["final_obs"] for result in results]
            assert last[0][0] is None and not np.array_equal(last[0][1]["observation"], seen[0]["observation"][1])
            assert all(np.array_equal(last[0][1][key], last[1][1][key]) for key in ("observation", "state"))
        if autoreset == "Disabled" and done.any():
            seen = [env.reset(options={"reset_mask": done.copy()})[0] for env in (native, sync)]
    assert ended == 1


@pytest.mark.parametrize("mode", ["rgb", "pointcloud"])
def test_states_go_on_with_the_same_pictures(mode):
    """A state of the default mode goes into any picture's environment, and back; copies and pickles too."""
    plain, other = make_vec(GRIPPER, 2), make_vec(GRIPPER, 2, obs_mode=mode, threads=1)
    env = make_vec(GRIPPER, 2, obs_mode=mode, threads=1)
    env.reset(seed=1)
    for action, _ in zip(drawn(env), range(3)):
        last = env.step(action)[0]
    state = env.get_state()
    plain.set_state(state)
    other.set_state(plain.get_state())
    twins = [other, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    assert all(np.array_equal(twin.unwrapped.task.observed.batch(), last) for twin in twins)
    for action, _ in zip(drawn(env, 1), range(3)):
        after = env.step(action)[0]
        assert all(np.array_equal(twin.step(action)[0], after) for twin in twins)
    assert not np.array_equal(after, last)


@pytest.mark.parametrize("mode", ["depth", "pointcloud"])
def test_a_diverged_sheet_keeps_its_last_picture(mode):
    env = make_vec(DRAPE, 3, autoreset_mode="Disabled", integrator="semi_implicit_euler", self_collision=False, obs_mode=mode)
    env.reset(seed=0)
    before = env.step(still(env))[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.unwrapped.task.simulation.set_parameters(np.array([False, True, False]), stretch_stiffness=261.1 * 1e6)
    for _ in range(12):
        after, *_, info = env.step(still(env))
        if info["failure"][1]:
            break
        before = after
    assert info["failure"].tolist() == [0, DIVERGED, 0]
    assert np.array_equal(after[1], before[1]) and not np.array_equal(after[0], before[0])
    again = env.step(still(env))[0]
    assert np.array_equal(again[1], before[1]) and not np.array_equal(again[2], after[2])


def test_images_do_not_change_after_the_end_of_an_episode():
    """The sheet moves on in a batch without autoreset; its last picture stays."""
    env = make_vec(DRAPE, 2, autoreset_mode="Disabled", obs_mode="depth")
    env.reset(seed=0)
    for action, _ in zip(drawn(env), range(4)):
        last = env.step(action)[0]
    end_soon(env.unwrapped.task, 1)
    ended = False
    for action, _ in zip(drawn(env), range(4)):
        after, _, terminated, *_ = env.step(action)
        if terminated[1] and not ended:
            last, ended = after, True
    assert ended and np.array_equal(after[1], last[1]) and not np.array_equal(after[0], last[0])


def test_a_macro_action_brings_the_picture_of_its_end():
    """One picture for each action of 60 steps, and of an episode that ends in it the picture of that end."""
    env = make(GRIPPER, action_mode="pick_place", obs_mode="depth", privileged=True).unwrapped
    env.reset(seed=0)
    env.action_space.seed(0)
    seen, _, terminated, *_ = env.step(env.action_space.sample())
    fresh = copy.deepcopy(env)
    fresh.task.observed.begun(np.array([0]))
    assert not terminated and np.array_equal(fresh.task.observed.one(0)["observation"], seen["observation"])


# --- learners -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "privileged"), [("rgb", False), ("depth", True), ("rgbd", False)])
def test_sb3_trains_on_pictures(mode, privileged):
    sb3 = pytest.importorskip("stable_baselines3")
    from clothgym.adapters.sb3 import make_sb3_vec_env

    env = make_sb3_vec_env(DRAPE, 2, seed=0, obs_mode=mode, image_size=40, privileged=privileged)
    first = env.reset()
    picture = first["observation"] if privileged else first
    assert picture.shape == {"rgb": (2, 40, 40, 3), "rgbd": (2, 4, 40, 40)}.get(mode, (2, 1, 40, 40))
    native = make_vec(DRAPE, 2, autoreset_mode="SameStep", obs_mode=mode, image_size=40)
    own = native.reset(seed=0)[0]
    assert np.array_equal(picture, own if mode == "rgb" else np.moveaxis(own.reshape(2, 40, 40, -1), -1, 1))
    policy = "MultiInputPolicy" if privileged else "CnnPolicy"
    kwargs = {"policy_kwargs": {"normalize_images": mode == "rgb"}}
    model = sb3.PPO(policy, env, n_steps=4, batch_size=8, n_epochs=1, seed=0, device="cpu", **kwargs)
    model.learn(16)
    assert "CNN" in str(model.policy.features_extractor)


# --- what may be asked for ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"obs_mode": "pixels"}, "'heightmap'"),
        ({"image_size": 0, "obs_mode": "rgb"}, "image_size=0"),
        ({"image_size": 64.0, "obs_mode": "rgb"}, "image_size=64.0"),
        ({"image_size": 100_000, "obs_mode": "rgb"}, "at most 1024"),
        ({"num_points": -1, "obs_mode": "pointcloud"}, "num_points=-1"),
        ({"privileged": 1, "obs_mode": "rgb"}, "privileged=1"),
        ({"privileged": True}, "is the state already"),
        ({"camera": "task"}, "takes none"),
        ({"camera": "task", "obs_mode": "heightmap"}, "takes none"),
        ({"camera": "front", "obs_mode": "rgb"}, '"task"'),
        ({"camera": {"eye": [1, 1, 1]}, "obs_mode": "rgb"}, "target"),
        ({"camera": {"eye": [1, 1, 1], "target": [0, 0, 0], "zoom": 2}, "obs_mode": "rgb"}, "zoom"),
        ({"camera": {"eye": [1, 1, 1], "target": [0, 0, np.nan]}, "obs_mode": "rgb"}, "finite"),
        ({"camera": {"eye": [1, 1, -1], "target": [0, 0, 0]}, "obs_mode": "rgb"}, "above the floor"),
    ],
)
def test_bad_keywords_are_named(kwargs, name):
    with pytest.raises(ValueError, match=name):
        make(DRAPE, **kwargs)


def test_cameras_are_json_and_give_other_pictures():
    from_above, from_task, own = (
        make(DRAPE, obs_mode="rgb", camera=camera) for camera in (None, "task", {"eye": [0.3, -1.2, 0.8], "target": [0, 0, 0.2]})
    )
    assert json.loads(own.spec.to_json())["kwargs"]["camera"]["eye"] == [0.3, -1.2, 0.8]
    pictures = [env.reset(seed=0)[0] for env in (from_above, from_task, own)]
    assert len({picture.tobytes() for picture in pictures}) == 3


def test_frames_have_the_size_that_was_asked_for():
    env, batch = (
        make(DRAPE, render_mode="rgb_array", width=96, height=64),
        make_vec(DRAPE, 2, render_mode="depth_array", width=50, height=70),
    )
    env.reset(seed=0)
    batch.reset(seed=0)
    assert env.render().shape == (64, 96, 3) and [frame.shape for frame in batch.render()] == [(70, 50)] * 2
    for made in (make, lambda env_id, **kwargs: make_vec(env_id, 2, **kwargs)):
        with pytest.raises(ValueError, match="height=0"):
            made(DRAPE, height=0)

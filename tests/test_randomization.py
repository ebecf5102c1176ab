"""What an episode draws by ``randomize``: delay and noise beside the same batch without them, and what info says."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clothgym  # noqa: F401
from clothgym.render.quick import FLOOR_COLORS


def batch(num_envs=3, env_id="ClothDrape-v0", **kwargs):
    made = gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, autoreset_mode="Disabled", physics="fast", **kwargs)
    return made.unwrapped


def actions(steps, num_envs=3, size=8):
    return np.random.default_rng(0).uniform(-1, 0, (steps, num_envs, size))


def test_a_delayed_action_is_that_of_some_steps_before():
    late, plain = batch(randomize={"action_delay": [3, 3]}), batch()
    late.reset(seed=5), plain.reset(seed=5)
    given = actions(12)
    for step in range(12):
        found, *_, info = late.step(given[step])
        wanted, *_ = plain.step(given[step - 3] if step >= 3 else np.zeros_like(given[0]))
        assert np.array_equal(found, wanted), step
    assert info["randomization/action_delay"].tolist() == [3, 3, 3]
    # each episode has its own
    late = batch(40, randomize={"action_delay": [0, 2]})
    _, info = late.reset(seed=5)
    assert set(info["randomization/action_delay"]) == {0, 1, 2}


def test_action_noise_is_of_the_velocities():
    """Of anchors that are told to stand still: 0.1 of 1 m/s, 1/30 s long."""
    env = batch(64, randomize={"action_noise": [0.1, 0.1]})
    env.reset(seed=1)
    where = [env.task.simulation.attachment_positions.copy()]
    for _ in range(8):
        env.step(np.zeros((64, 8)))
        where.append(env.task.simulation.attachment_positions.copy())
    moved = np.diff(where, axis=0).ravel() / (env.task.physics.attachment_speed * env.task.physics.time_step)
    assert moved.size == 8 * 64 * 2 * 3
    assert abs(moved.mean()) < 4 * 0.1 / np.sqrt(moved.size) and moved.std() == pytest.approx(0.1, rel=0.05)


def test_a_sheet_that_slides_is_slowed_by_the_friction_that_was_drawn():
    """By mu g (Coulomb), and by a drag c v, of density rho: v = (1 + mu g / b) exp(-b t) - mu g / b with b = c / rho."""
    env = batch(4, "ClothFold-v0", randomize={"friction": [0.1, 0.6]}, air_density=0.0)
    _, info = env.reset(seed=2)
    state = env.get_state()
    state.simulation.velocities[...] = (1.0, 0.0, 0.0)
    env.set_state(state)
    for _ in range(2):
        env.step(np.zeros((4, 8)))
    speed = env.task.simulation.velocities[..., 0].mean(axis=1)
    friction, fabric = info["randomization/friction"], env.task.physics.material
    b, time = fabric.air_drag / fabric.density, 2 / 30
    slowing = friction * 9.81 / b
    assert np.ptp(friction) > 0.1
    assert speed == pytest.approx((1 + slowing) * np.exp(-b * time) - slowing, rel=0.02)


def test_observation_noise_changes_what_is_seen_and_nothing_else():
    noisy, plain = batch(randomize={"observation_noise": [0.02, 0.02]}), batch()
    seen, clear = [noisy.reset(seed=5)[0]], [plain.reset(seed=5)[0]]
    for action in actions(30):
        seen.append(noisy.step(action)[0])
        clear.append(plain.step(action)[0])
        assert np.array_equal(noisy.task.simulation.positions, plain.task.simulation.positions)
    error = (np.array(seen) - np.array(clear)).ravel()
    assert abs(error.mean()) < 4 * 0.02 / np.sqrt(error.size) and error.std() == pytest.approx(0.02, rel=0.03)


def test_what_was_drawn_is_the_same_in_any_batch_and_within_its_ranges():
    ranges = {"density": [0.12, 0.2], "friction": [0.1, 0.9], "action_delay": [0, 4], "action_noise": [0.0, 0.1]}
    ranges["observation_noise"] = [0.0, 0.05]
    many, one = batch(3, randomize=ranges), batch(1, randomize=ranges)
    seen, info = many.reset(seed=7)
    alone, own = one.reset(seed=9)
    assert np.array_equal(seen[2:], alone)
    for name, (low, high) in ranges.items():
        drawn = info[f"randomization/{name}"]
        assert drawn[2] == own[f"randomization/{name}"][0] and (low <= drawn).all() and (drawn <= high).all()
        assert len(set(drawn)) > 1, name
    given = actions(20)
    for step in range(20):
        if step == 10:
            state = many.get_state()
        seen = many.step(given[step])[0]
        assert np.array_equal(seen[2:], one.step(given[step, 2:])[0])
    # and again from a state
    other = batch(3, randomize=ranges)
    other.reset(seed=0)
    other.set_state(state)
    for step in range(10, 20):
        again = other.step(given[step])[0]
    assert np.array_equal(again, seen)
    # a single environment has them as plain numbers
    single = gym.make("clothgym:ClothDrape-v0", physics="fast", randomize=ranges)
    assert single.reset(seed=9)[1]["randomization/action_noise"] == own["randomization/action_noise"][0]


def test_the_last_info_of_an_episode_has_its_own_draws():
    name, ranges = "randomization/action_noise", {"action_noise": [0.0, 0.1]}
    made = gym.make_vec("clothgym:ClothReach-v0", num_envs=2, autoreset_mode="SameStep", physics="fast", randomize=ranges)
    _, info = made.reset(seed=3)
    for _ in range(2):
        drawn = info[name]
        for _ in range(60):
            *_, terminated, truncated, info = made.step(np.zeros((2, 3)))
            if (terminated | truncated).all():
                break
        assert np.array_equal(info["final_info"][name], drawn) and not (info[name] == drawn).any()


def test_noise_leaves_rewards_and_goals_as_they_are():
    noisy, plain = (batch(2, "ClothFoldGoal-v0", randomize=ranges) for ranges in ({"observation_noise": [0.05, 0.05]}, {}))
    seen, clear = noisy.reset(seed=2)[0], plain.reset(seed=2)[0]
    for _ in range(5):
        for name in ("achieved_goal", "desired_goal"):
            assert np.array_equal(seen[name], clear[name]), name
        assert not np.array_equal(seen["observation"], clear["observation"])
        seen, reward, *_ = noisy.step(np.full((2, 8), 0.3))
        clear, wanted, *_ = plain.step(np.full((2, 8), 0.3))
        assert np.array_equal(reward, wanted)


def test_pictures_have_no_noise():
    with pytest.raises(ValueError, match="no observation_noise with obs_mode='depth'"):
        batch(obs_mode="depth", randomize={"observation_noise": [0, 0.1]})


def test_a_drawn_camera_is_the_given_one_turned_about_its_target():
    """Turned by scipy: about the vertical after the picture's horizontal, whose sense raises the eye; and farther away."""
    camera = {"eye": (0.3, -1.2, 0.9), "target": (0.1, 0.0, 0.1), "vertical_fov": 40.0}
    target = np.array(camera["target"])
    back = np.array(camera["eye"]) - target
    right = np.cross(-back, (0, 0, 1))
    turn = Rotation.from_rotvec([0, 0, np.radians(30)]) * Rotation.from_rotvec(-np.radians(12) * right / np.linalg.norm(right))
    eye = target + 1.2 * turn.apply(back)
    assert eye[2] > camera["eye"][2]
    drawn = {"camera_yaw": [30, 30], "camera_tilt": [12, 12], "camera_distance": [1.2, 1.2]}
    seen = batch(2, obs_mode="rgb", image_size=48, camera=camera, randomize=drawn).reset(seed=3)[0]
    wanted = batch(2, obs_mode="rgb", image_size=48, camera={**camera, "eye": tuple(eye)}).reset(seed=3)[0]
    assert (np.abs(seen.astype(int) - wanted).max(axis=-1) > 0).mean() < 0.01
    plain = batch(2, obs_mode="rgb", image_size=48, camera=camera).reset(seed=3)[0]
    assert (np.abs(seen.astype(int) - plain).max(axis=-1) > 0).mean() > 0.1


def test_brightness_multiplies_all_colors_and_hue_turns_those_of_the_cloth():
    plain = batch(2, obs_mode="rgb").reset(seed=3)[0]
    dark, bright = (batch(2, obs_mode="rgb", randomize={"brightness": [b, b]}).reset(seed=3)[0] for b in (0.5, 1.5))
    assert np.array_equal(dark, plain // 2) and np.array_equal(bright, np.minimum(1.5 * plain, 255).astype(np.uint8))
    # by a third of a turn red is green, green blue and blue red; the rest of the scene stays as it is
    turned = batch(2, obs_mode="rgb", randomize={"hue": [120, 120]}).reset(seed=3)[0]
    floor = np.any([(plain == color).all(axis=-1) for color in FLOOR_COLORS], axis=0)
    cloth = (turned != plain).any(axis=-1)
    assert cloth.sum() > 200 and floor.sum() > 5000 and not (cloth & floor).any()
    assert np.abs(turned[cloth].astype(int) - np.roll(plain[cloth], 1, axis=-1)).max() <= 1
    # in shares of 255, and depths as they were
    clear, dark = (batch(2, obs_mode="rgbd", randomize=ranges).reset(seed=3)[0] for ranges in ({}, {"brightness": [0.5, 0.5]}))
    assert dark[..., :3] == pytest.approx(clear[..., :3] / 2, abs=1e-6) and np.array_equal(dark[..., 3], clear[..., 3])


def test_a_tilt_of_the_camera_straight_down_moves_the_eye_toward_the_top_of_the_picture():
    """From there, at a low angle, the floor is near at the top of the picture, and far or beyond the limit at the bottom."""
    plain, tilted = (batch(2, obs_mode="depth", image_size=64, randomize=some) for some in ({}, {"camera_tilt": [60, 60]}))
    seen, other = plain.reset(seed=3)[0][..., 0], tilted.reset(seed=3)[0][..., 0]
    assert np.ptp(seen[:, [1, 62], 2]) < 0.02
    assert (other[:, 1, 2] < 0.8 * seen[:, 1, 2]).all() and (other[:, 62, 2] > 1.2 * seen[:, 62, 2]).all()


def test_drawn_views_are_the_same_in_any_batch_and_from_a_state():
    ranges = {"camera_yaw": [-30, 30], "camera_tilt": [-20, 20], "camera_distance": [0.8, 1.2], "brightness": [0.5, 1.5]}
    ranges["hue"] = [-90, 90]
    many, one = (batch(count, obs_mode="rgbd", image_size=24, randomize=ranges, threads=2) for count in (3, 1))
    seen, info = many.reset(seed=7)
    alone, own = one.reset(seed=9)
    assert np.array_equal(seen[2:], alone) and own["randomization/hue"][0] == info["randomization/hue"][2]
    state, given = many.get_state(), actions(4)
    seen = [many.step(action)[0] for action in given]
    other = batch(3, obs_mode="rgbd", image_size=24, randomize=ranges)
    other.reset(seed=0)
    other.set_state(state)
    assert all(np.array_equal(other.step(action)[0], first) for action, first in zip(given, seen))


@pytest.mark.parametrize(
    "ranges, said",
    [
        ({"softness": [0, 1]}, "no parameter 'softness'"),
        ({"action_delay": [0, 1.5]}, "whole control steps"),
        ({"action_delay": [0, 101]}, "from 0 to 100"),
        ({"observation_noise": [0.2, 0.1]}, "must be a range"),
        ({"action_noise": [0, float("nan")]}, "action_noise"),
        ([0, 1], "must be a dict"),
        ({"camera_yaw": [-5, 5]}, "no camera_yaw with obs_mode='keypoints'; it is for rgb, depth, rgbd, pointcloud"),
        ({"hue": [-200, 5]}, "from -180 to 180"),
        ({"friction": [-0.1, 0.5]}, "friction=.* must be a range .low, high. from 0 to 10"),
    ],
)
def test_ranges_that_cannot_be_are_refused(ranges, said):
    with pytest.raises(ValueError, match=said):
        batch(randomize=ranges)


def test_a_camera_that_could_see_from_below_the_floor_is_refused():
    with pytest.raises(
        ValueError, match=r"camera_tilt=\[-80.0, 10.0\]: the camera would be at z = -.*, below the floor; take a narrower"
    ):
        batch(obs_mode="depth", camera="task", randomize={"camera_tilt": [-80, 10]})
    # neither end of the range is below the floor: at distance sqrt(0.64 + 0.64) the lowest point is 1 - 1.13 high
    low = {"eye": [0, -0.8, 0.2], "target": [0, 0, 1]}
    with pytest.raises(ValueError, match=r"z = -0.131 m"):
        batch(obs_mode="depth", camera=low, randomize={"camera_tilt": [-89, 0]})
    # nor is the tilt: farther away, the eye is at 0.5 - 0.4 d
    with pytest.raises(ValueError, match=r"camera_distance=\[0.8, 1.5\]: the camera would be at z = -0.1 m"):
        batch(obs_mode="depth", camera={"eye": [0, -1.2, 0.1], "target": [0, 0, 0.5]}, randomize={"camera_distance": [0.8, 1.5]})
    with pytest.raises(ValueError, match="no brightness with obs_mode='depth'; it is for rgb, rgbd"):
        batch(obs_mode="depth", randomize={"brightness": [0.5, 1.5]})


def test_motions_of_picks_have_no_delay():
    with pytest.raises(ValueError, match="no action_delay with action_mode='pick_place'"):
        batch(env_id="ClothFold-v0", action_mode="pick_place", randomize={"action_delay": [1, 2]})


def test_friction_needs_a_solid():
    with pytest.raises(ValueError, match="randomize: no friction in a task without solids"):
        gym.make("clothgym:ClothReach-v0", randomize={"friction": [0.1, 0.5]})

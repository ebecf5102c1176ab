"""frame="task": what is seen, and where actions lead, along a task's own direction, against the flat sheet's own coordinates."""

import gymnasium as gym
import numpy as np
import pytest

FOLD, GOAL, SHIRT = "clothgym:ClothFold-v0", "clothgym:ClothFoldGoal-v0", "clothgym:ClothFoldShirt-v0"
HOOKED = "clothgym:ClothHook-Hard-v0"
SIDE, ENVS = 0.6, 20
# 3 x 3 points of a flat sheet about its center, row by row, in sides
FLAT = np.array([[x, y] for y in (-0.5, 0, 0.5) for x in (-0.5, 0, 0.5)])


def batch(env_id, **kwargs):
    """A batch that has been reset, and the state vectors that it returned."""
    env = gym.make_vec(env_id, num_envs=ENVS, frame="task", autoreset_mode="Disabled", **kwargs)
    return env.unwrapped, numbers(env.reset(seed=1_000_000)[0])


def numbers(seen):
    return (
        np.concatenate([seen[name] for name in ("observation", "achieved_goal", "desired_goal")], -1)
        if isinstance(seen, dict)
        else seen
    )


def part(env, seen, name, *shape):
    return seen[:, env.task.observation_slices[name]].reshape(ENVS, *shape).astype(float)


@pytest.mark.parametrize("env_id", [FOLD, GOAL])
def test_a_flat_sheet_lies_straight_however_it_is_turned(env_id):
    env, seen = batch(env_id)
    assert np.abs(np.diff(env.task.heading(), axis=0)).min() > 1e-3  # no two are turned alike
    assert part(env, seen, "keypoints", 9, 3)[..., :2] == pytest.approx(np.tile(FLAT, (ENVS, 1, 1)), abs=1e-3)


def test_a_fold_is_seen_as_if_the_first_edge_were_carried_to_the_last_one():
    env, seen = batch(GOAL)
    corners = FLAT[[0, 2, 6, 8]]
    assert len(set(env.task.episode["carried"][:, 0].tolist())) == 4  # though it is each of the four
    assert part(env, seen, "achieved_goal", 4, 3)[..., :2] == pytest.approx(np.tile(corners, (ENVS, 1, 1)), abs=1e-3)
    goal = part(env, seen, "desired_goal", 4, 3)[..., :2]
    share = goal[:, 0, 1] - corners[0, 1]
    expected = np.tile(corners, (ENVS, 1, 1))
    expected[:, :2, 1] += share[:, None]
    assert goal == pytest.approx(expected, abs=1e-3) and share.min() >= 0.5 - 1e-3 and share.max() <= 1 + 1e-3
    # the first gripper hovers above the first of them, and its way to each is that of both places
    tips = part(env, seen, "grippers", 2, 5)[..., :3]
    assert np.linalg.norm(tips[..., :2] - corners[:2], axis=2).max() <= 0.1 * np.sqrt(2) + 1e-3
    ways = part(env, seen, "ways", 2, 4, 3) / 10
    assert ways == pytest.approx(part(env, seen, "achieved_goal", 1, 4, 3) - tips[:, :, None], abs=1e-3)


@pytest.mark.parametrize("env_id", [FOLD, GOAL, SHIRT, HOOKED])
def test_a_velocity_along_x_of_the_frame_leads_along_x_of_what_is_seen_and_along_the_heading_of_the_world(env_id):
    env, seen = batch(env_id)
    before = env.task.simulation.grippers.positions.astype(float)
    tips = part(env, seen, "grippers", 2, -1)[..., :3]
    actions = np.tile([0.5, 0, 0, 1], (ENVS, 2)).astype(np.float32)
    after = part(env, numbers(env.step(actions)[0]), "grippers", 2, -1)[..., :3]
    step = 0.5 * env.task.physics.attachment_speed * env.task.physics.time_step
    assert after - tips == pytest.approx(np.tile([step / env.task.physics.side, 0, 0], (ENVS, 2, 1)), abs=1e-5)
    heading = env.task.heading()[:, None]
    moved = env.task.simulation.grippers.positions.astype(float) - before
    assert moved[..., :2] == pytest.approx(step * np.tile(heading, (1, 2, 1)), abs=1e-6)


def test_all_arms_point_the_same_way_in_their_frame():
    env, seen = batch(HOOKED)
    assert np.ptp(env.task.heading(), axis=0).min() > 0.1  # though they do not in the world
    arm, hole = (part(env, seen, name, 3) for name in ("arm", "hole_normal"))
    assert arm == pytest.approx(np.tile(arm[0], (ENVS, 1)), abs=1e-5) and arm[0, 0] == pytest.approx(0, abs=1e-5)
    # and the ways of both grippers to their corners are those between the places that are seen
    grippers, points = part(env, seen, "grippers", 2, 8), part(env, seen, "keypoints", -1, 3)
    corners = np.array([np.flatnonzero(env.task.particles == place)[0] for place in env.task.places])
    assert grippers[..., 3:6] / 10 == pytest.approx(points[:, corners] - grippers[..., :3], abs=1e-3)
    assert np.linalg.norm(hole, axis=1) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("env_id", [FOLD, GOAL, HOOKED])
def test_the_expert_s_actions_in_the_frame_are_its_actions_in_the_world(env_id):
    env, _ = batch(env_id)
    world = gym.make_vec(env_id, num_envs=ENVS, autoreset_mode="Disabled").unwrapped
    world.reset(seed=1_000_000)
    for _ in range(30):
        env.step(env.task.expert().astype(np.float32))
        world.step(world.task.expert().astype(np.float32))
    # rounding differs, and where cloth sticks and slips it grows; hands follow the cloth but a little
    hands = [one.task.simulation.grippers.positions for one in (env, world)]
    assert hands[0] == pytest.approx(hands[1], abs=5e-3)
    assert (world.task.simulation.grippers.held > 0).any(axis=1).mean() > 0.5  # there is something to see


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"frame": "sheet"}, "frame='sheet': must be 'world' or 'task'"),
        ({"frame": "task", "action_mode": "pick_place"}, "frame='task': must be 'world' with action_mode='pick_place'"),
        ({"frame": "task", "action_mode": "throw"}, "action_mode='throw': must be 'velocity' or 'pick_place'"),
    ],
)
def test_what_cannot_turn_is_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        gym.make(FOLD, **wrong)


def test_an_action_is_checked_and_limited_in_its_own_frame():
    env, _ = batch(FOLD)
    bad = np.zeros((ENVS, 8))
    bad[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"action\[1\] of environment 3 is nan"):
        env.step(bad)
    before = env.task.simulation.grippers.positions.astype(float)
    bad[...] = 0
    bad[:, 0] = 3.0
    env.step(bad)
    moved = (env.task.simulation.grippers.positions.astype(float) - before)[:, 0]
    step = env.task.physics.attachment_speed * env.task.physics.time_step
    assert moved[:, :2] == pytest.approx(step * env.task.heading(), abs=1e-6)


def test_tasks_without_a_direction_have_no_frame():
    with pytest.raises(TypeError, match="frame"):
        gym.make("clothgym:ClothFlatten-v0", frame="task")

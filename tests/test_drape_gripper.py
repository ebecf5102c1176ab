"""The drape with grippers: its fingers, potential, observation, starts and evaluation, against numbers worked out here."""

from importlib import resources

import gymnasium as gym
import numpy as np
import pytest
import test_drape

from clothgym import grid
from clothgym.envs.draping import PHYSICS
from clothgym.envs.reference import layers_over, reference_coverage

GRIPPER = "clothgym:ClothDrapeGripper-v0"
SIDE, ROWS = 0.6, 17
SHEET = grid(ROWS, ROWS, SIDE, SIDE)
STEP, SPEED, REACH = 1 / 30, 1.0, 0.03
ACTING, STEPS = 100, 160
CORNERS = [ROWS * (ROWS - 1), ROWS * ROWS - 1]  # those of the edge at the target
SHARE = SHEET.area / SHEET.area.sum()
STRUCTURAL = np.abs(SHEET.springs.rest_length - SIDE / (ROWS - 1)) < 1e-6
OPEN, CLOSED = 1.0, -1.0


def start(seed=3, options=None, **kwargs):
    env = gym.make(GRIPPER, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed, options=options)
    return env, observation


def batch(num_envs, seed=0, options=None, **kwargs):
    env = gym.make_vec(GRIPPER, num_envs=num_envs, autoreset_mode="Disabled", **kwargs)
    env.reset(seed=seed, options=options)
    return env


def positions(env):
    return env.unwrapped.task.simulation.positions.astype(float)


def tips(env):
    return env.unwrapped.task.simulation.grippers.positions.astype(float)


def stretch(x):
    """Of the threads between neighbors, length over rest length."""
    ends = x[..., SHEET.springs.particles[STRUCTURAL], :]
    return np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1) * (ROWS - 1) / SIDE


def top(target):
    return np.array([*target.center, target.height])


def potential(env, places=CORNERS):
    """The potential of the manual page, from positions, tips, holds and the target alone, in float64."""
    away = np.linalg.norm(positions(env)[0, places] - tips(env)[0], axis=1)
    held = env.get_state().simulation.holder[0, places] >= 0
    return 0.7 * test_drape.potential(env, 0.4) + 0.3 * np.mean(np.where(held, 1, 0.5 / (1 + (away / (0.15 * SIDE)) ** 2)))


def evaluation(env, index=0):
    """What the drape's page says of the sheet as it lies: performance, success, coverage, distance and speed."""
    task = env.unwrapped.task
    target, x = task.targets[index], positions(env)[index]
    v = task.simulation.velocities[index].astype(float)
    layers = layers_over(target, x, SHEET.triangles, SIDE)
    coverage, spread = np.mean(layers > 0), np.sum(layers == 1) / max(np.sum(layers > 0), 1)
    share = coverage / reference_coverage(target, PHYSICS)
    off = np.linalg.norm(SHARE @ x[:, :2] - target.center) / SIDE
    speed = np.sqrt(SHARE @ np.sum(v**2, axis=1))
    performance = min(share, 1) * spread / (1 + (off / 0.2) ** 2) / (1 + (speed / 0.1) ** 2)
    return performance, share >= 0.9 and spread >= 0.9 and off <= 0.1 and speed < 0.05, coverage, off, speed


def play(env, policy):
    """What the last step of each episode says, as arrays, and the number of steps."""
    last, over, steps = {}, np.zeros(env.num_envs, bool), 0
    while not over.all():
        *_, terminated, _, info = env.step(policy(env, steps))
        last = {k: np.where(terminated, v, last.get(k, v)) for k, v in info.items() if isinstance(v, np.ndarray)}
        over |= terminated
        steps += 1
    return last | {"steps": steps}


def fetched(place):
    """Take both corners as the expert does, and bring them to a place beside the target's top, in sides, holding fast."""

    def policy(env, step):
        task = env.unwrapped.task
        action = task.expert_actions().reshape(env.num_envs, 2, 4)
        held = np.all(task.get_state().simulation.holder[:, CORNERS] >= 0, axis=1)
        goal = np.array([top(target) for target in task.targets])[:, None] + SIDE * np.array(place)
        goal = goal + SHEET.rest_positions[CORNERS] * (1, 0, 0)
        away = goal - tips(env)
        # up first
        away[..., :2] *= (away[..., 2] < 0.05)[..., None]
        carry = np.concatenate([away * 10, np.full((env.num_envs, 2, 1), CLOSED)], axis=2)
        action = np.where(held[:, None, None], carry, action)
        action[..., 3] = np.where(task.episode["picked"].any(axis=1)[:, None], CLOSED, action[..., 3])
        return np.clip(action, -1, 1).reshape(env.num_envs, 8)

    return policy


# --- fingers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("orders", "openings"),
    [
        ([-0.51] * 4, [2 / 3, 1 / 3, 0, 0]),
        ([-0.49] * 4, [1, 1, 1, 1]),
        ([-1, 0, 0, 0], [2 / 3, 1 / 3, 0, 0]),  # goes on as before
        ([-1, -1, -1, 0, 0.49, 0.49], [2 / 3, 1 / 3, 0, 0, 0, 0]),
        ([-1, -1, -1, 0.51, 0, 0, 0], [2 / 3, 1 / 3, 0, 1 / 3, 2 / 3, 1, 1]),
        ([-1, 1, -1, 0], [2 / 3, 1, 2 / 3, 1 / 3]),
    ],
)
def test_fingers_close_below_a_half_open_above_and_else_go_on(orders, openings):
    (env, _), attachment = start(), 1
    for order, opening in zip(orders, openings):
        action = np.zeros((2, 4))
        action[attachment, 3], action[1 - attachment, 3] = order, 0.0
        env.step(action.ravel())
        seen = env.task.simulation.grippers.openings[0]
        assert seen[attachment] == pytest.approx(opening, abs=1e-5) and seen[1 - attachment] == 1


def test_a_new_episode_begins_with_open_fingers_that_were_told_nothing():
    env = gym.make_vec(GRIPPER, num_envs=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    grippers = env.unwrapped.task.simulation.grippers
    for _ in range(40):
        env.step(env.unwrapped.expert_actions())
    assert grippers.held.any() and env.unwrapped.task.episode["picked"].any()
    env.reset(options={"reset_mask": np.array([True, False])})
    assert not grippers.held[0].any() and not env.unwrapped.task.episode["picked"][0].any()
    before = grippers.openings[1].copy()
    env.step(np.zeros((2, 8)))
    assert np.all(grippers.openings[0] == 1) and np.array_equal(grippers.openings[1], before)


def test_fingers_open_after_100_steps_and_the_evaluation_is_at_160():
    env, _ = start()
    for step in range(1, STEPS + 1):
        moves = np.array([0, 0, 0.2, CLOSED, 0, 0, 0.2, CLOSED])
        here = tips(env)[0]
        *_, terminated, truncated, info = env.step(moves)
        late = max(step - ACTING, 0)
        if step > 3:
            assert env.task.simulation.grippers.openings[0] == pytest.approx([min(late / 3, 1)] * 2, abs=1e-5)
        assert info["settling"] == (step >= ACTING) and terminated == (step == STEPS) and not truncated
        assert (tips(env)[0, 0, 2] > here[0, 2] + 1e-3) == (step <= ACTING)


def test_a_gripper_grasps_within_3_cm_and_respects_its_speed_limit():
    env, _ = start(options={"rumpled": False})
    taken = {}
    for _ in range(40):
        x, here = positions(env)[0], tips(env)[0]
        env.step(env.expert_action())
        for attachment in np.flatnonzero(env.task.simulation.grippers.held[0]):
            # what was near when the fingers had closed, as the step began
            taken.setdefault(
                attachment, (env.get_state().simulation.holder[0] == attachment, np.linalg.norm(x - here[attachment], axis=1))
            )
        if len(taken) == 2:
            break
    for attachment, (held, distance) in taken.items():
        assert held[CORNERS[attachment]] and held.sum() < 8
        assert held[distance < 0.999 * REACH].all() and not held[distance > 1.001 * REACH].any()
    for action in ([1, 1, 1], [0, -1, 0], [0.3, 0, 0.4]):
        before = tips(env)[0], positions(env)[0, CORNERS]
        env.step(np.array([*action, CLOSED] * 2, float))
        wanted = np.array(action) / max(1, np.linalg.norm(action)) * SPEED * STEP
        assert tips(env)[0] - before[0] == pytest.approx(np.tile(wanted, (2, 1)), abs=1e-5)
        assert positions(env)[0, CORNERS] - before[1] == pytest.approx(np.tile(wanted, (2, 1)), abs=1e-5)


# --- reward and evaluation -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["expert", "random"])
def test_return_is_performance_minus_initial_potential_with_penalties(policy):
    env, _ = start(seed=4)
    rng, effort, total, terminated, steps = np.random.default_rng(0), 0.0, 0.0, False, 0
    before, held = potential(env), []
    while not terminated:
        action = env.expert_action() if policy == "expert" else rng.uniform(-1, 1, 8)
        effort += 0.001 * np.sum(action.reshape(2, 4)[:, :3].astype(float) ** 2) * (steps < ACTING)
        _, reward, terminated, _, info = env.step(action)
        total += reward
        steps += 1
        held.append(int(np.sum(env.get_state().simulation.holder[0, CORNERS] >= 0)))
        if steps % 7 == 0 and not terminated:
            assert total == pytest.approx(potential(env) - before - effort, abs=2e-5)
    performance, success, *_ = evaluation(env)
    assert info["is_success"] == success == (policy == "expert")
    assert (max(held) == 2 and performance > 0.8) if success else performance < 0.1
    assert total == pytest.approx(performance - before - effort + 0.25 * success, abs=2e-5)


def test_the_potential_of_one_gripper_counts_the_middle_of_the_edge():
    env, _ = start(seed=4, grippers=1)
    middle, effort, total = [CORNERS[0] + 8], 0.0, 0.0
    before, held = potential(env, middle), []
    for _ in range(30):
        action = env.expert_action()
        effort += 0.001 * np.sum(action[:3].astype(float) ** 2)
        total += env.step(action)[1]
        held.append(bool(env.get_state().simulation.holder[0, middle] >= 0))
        assert total == pytest.approx(potential(env, middle) - before - effort, abs=2e-5)
    assert held[-1] and not held[0]


def test_the_evaluation_is_that_of_the_drape_task():
    """On the expert's sheets, and on such as were let go too early."""
    env = batch(12, seed=20)
    last = play(env, lambda env, step: env.unwrapped.expert_actions() if step < 57 else np.tile([0, 0, 0, OPEN] * 2, (12, 1)))
    for i in range(12):
        performance, success, coverage, off, speed = evaluation(env, i)
        assert last["coverage"][i] == coverage
        assert last["coverage_reference"][i] == reference_coverage(env.unwrapped.task.targets[i], PHYSICS)
        assert last["off_center"][i] == pytest.approx(off, abs=1e-5)
        assert last["rms_speed"][i] == pytest.approx(speed, rel=1e-4)
        assert last["normalized_performance"][i] == pytest.approx(performance, abs=1e-5)
        assert last["is_success"][i] == success
    assert np.ptp(last["normalized_performance"]) > 0.2 and 0 < last["is_success"].mean() < 1


@pytest.mark.parametrize(
    ("offset", "speed", "success"), [(0.0, 0.0, True), (0.0, 0.3, False), (0.13, 0.0, False), (0.09, 0.0, True)]
)
def test_success_asks_for_a_centred_sheet_at_rest(offset, speed, success):
    """A flat sheet on a box, which is evaluated at once, without weight: at rest or not, centered or not."""
    env, _ = start(options={"target": {"shape": "box", "radius": 0.12, "center": (0.0, 0.0), "yaw": 0.0}})
    task = env.task
    env.step(np.zeros(8))
    task.simulation.set_parameters(gravity=(0, 0, 0))
    task.simulation.reset(positions=SHEET.rest_positions + (offset * SIDE, 0, 0.246), velocities=(speed, 0, 0))
    task.episode["settling_since"][0], task.episode["step"][0] = ACTING, STEPS - 1
    *_, terminated, _, info = env.step(np.zeros(8))
    performance, *_, off, rms = evaluation(env)
    assert terminated and off == pytest.approx(offset + speed / 60 / SIDE, abs=0.015) and (rms > 0.02) == (speed > 0)
    assert info["coverage"] > 0.9 and info["is_success"] == success
    assert info["normalized_performance"] == pytest.approx(performance, abs=1e-5)


# --- observation, start, arguments ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["sphere", "box", "post"])
def test_observations_match_the_manual_page(shape):
    env, observation = start(seed=8, options={"target": {"shape": shape}})
    assert observation.shape == (82,)
    for _ in range(14):
        observation, *_ = env.step(env.expert_action())
    observation, *_ = env.step(np.array([0.5, 1, 0.2, CLOSED, 0.3, 1, 0, OPEN]))
    state, target = env.get_state().simulation, env.task.targets[0]
    x, origin = state.positions[0].astype(float), top(target)
    points = [0, 8, 16, 136, 144, 152, 272, 280, 288]
    assert observation[:27] == pytest.approx(((x[points] - origin) / SIDE).ravel(), abs=2e-5)
    assert observation[27:54] == pytest.approx(state.velocities[0, points].ravel(), abs=1e-5)
    assert observation[54:57] == pytest.approx((SHARE @ x - origin) / SIDE, abs=2e-5)
    assert observation[57:59].tolist() == [1, 0]
    assert observation[59:62].tolist() == [shape == "sphere", shape == "box", shape == "post"]
    assert observation[62:65] == pytest.approx([target.radius / SIDE, target.height / SIDE, target.yaw * 4 / np.pi], abs=1e-6)
    assert observation[65:68] == pytest.approx([0, 145 / 160, 85 / 100], abs=1e-6)
    for attachment, first in ((0, 68), (1, 75)):
        tip = state.attachment_positions[0, attachment].astype(float)
        assert observation[first : first + 3] == pytest.approx((tip - origin) / SIDE, abs=2e-5)
        assert observation[first + 3 : first + 6] == pytest.approx((x[CORNERS[attachment]] - tip) * 10 / SIDE, abs=2e-4)
        assert observation[first + 6] == pytest.approx([0, 1 / 3][attachment], abs=1e-5)
    for _ in range(ACTING - 15):
        observation, *_ = env.step(np.zeros(8))
    assert observation[65:68] == pytest.approx([1, 60 / 160, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("kwargs", "sizes"),
    [
        ({}, (8, 82)),
        ({"grippers": 1}, (4, 74)),
        ({"obs_mode": "particles"}, (8, 6 * 289 + 28)),
    ],
)
def test_sizes_are_those_of_the_manual_page(kwargs, sizes):
    env, observation = start(**kwargs)
    assert (*env.action_space.shape, *env.observation_space.shape) == sizes and observation.shape == (sizes[1],)
    action = env.expert_action()
    assert action.shape == sizes[:1] and env.step(np.clip(action, -1, 1))[0].shape == (sizes[1],)


def test_a_single_gripper_is_to_take_the_middle_of_the_edge():
    env, observation = start(grippers=1)
    tip, x = tips(env)[0, 0], positions(env)[0]
    assert np.all(np.abs(tip - x[CORNERS[0] + 8]) <= SIDE * np.array([0.1, 0.1, 0.35]) + 1e-6)
    assert observation[67:70] == pytest.approx((tip - top(env.task.targets[0])) / SIDE, abs=2e-5)
    assert observation[70:73] == pytest.approx((x[CORNERS[0] + 8] - tip) * 10 / SIDE, abs=2e-4) and observation[73] == 1


def test_starts_are_drawn_from_the_ranges_of_the_manual_page():
    count = 300
    env = batch(count)
    task, x, tip = env.unwrapped.task, positions(env), tips(env)
    targets = task.targets
    assert x[:, :, 2].min() >= 0.002 - 1e-6 and x[:, :, 2].min(axis=1).max() < 0.0045
    assert all(test_drape.outside(target, sheet).min() > 0.002 for target, sheet in zip(targets, x))
    centers = np.array([target.center for target in targets])
    assert np.linalg.norm(centers, axis=1).max() <= 0.25 * SIDE
    # before the target, whose widest half is sqrt(2) radii
    gap = np.array([t.center[1] - np.sqrt(2) * t.radius for t in targets]) - x[:, :, 1].max(axis=1)
    assert 0.0499 < gap.min() / SIDE < 0.06 and 0.14 < gap.max() / SIDE < 0.1501
    aside = (x[:, :, 0].mean(axis=1) - centers[:, 0]) / SIDE
    assert 0.09 < np.abs(aside).max() < 0.1001 and abs(aside.mean()) < 0.02
    flat = np.ptp(x[:, :, 2], axis=1) < 2e-3
    assert 0.42 < flat.mean() < 0.58
    edge = x[flat][:, CORNERS[1]] - x[flat][:, CORNERS[0]]
    yaw = np.arctan2(edge[:, 1], edge[:, 0])
    assert yaw.min() < -0.19 and yaw.max() > 0.19 and np.abs(yaw).max() <= 0.2 + 1e-4
    assert stretch(x[flat]) == pytest.approx(1, abs=2e-3)
    away = (tip - x[:, CORNERS]) / SIDE
    assert 0.095 < np.abs(away[..., :2]).max() < 0.1001 and np.abs(away[..., :2].mean(axis=(0, 1))).max() < 0.02
    assert 0.1999 < away[..., 2].min() < 0.205 and 0.345 < away[..., 2].max() < 0.3501
    assert np.all(task.simulation.grippers.openings == 1) and not task.simulation.grippers.held.any()


@pytest.mark.parametrize("rumpled", [True, False, np.bool_(True)])
def test_a_sheet_is_rumpled_or_flat_as_asked_for(rumpled):
    env = batch(20, options={"rumpled": rumpled})
    heights = np.ptp(positions(env)[:, :, 2], axis=1)
    assert np.all(heights > 0.03) if rumpled else np.all(heights < 2e-3)


@pytest.mark.parametrize(
    ("name", "value"), [("grippers", 3), ("grippers", 0), ("grippers", "two"), ("slip_force", 0), ("slip_force", -1.0)]
)
def test_bad_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name}={value!r}"):
        gym.make(GRIPPER, **{name: value})


def test_the_rumpled_sheets_lie_on_the_floor_and_are_whole():
    with resources.as_file(resources.files("clothgym.envs").joinpath("rumpled.npz")) as path, np.load(path) as file:
        sheets = file["positions"] * 1e-4
    assert sheets.shape == (64, ROWS * ROWS, 3) and np.isfinite(sheets).all()
    assert sheets[:, :, 2].min() >= 0.002 - 1e-9 and np.all(sheets[:, :, 2].min(axis=1) < 0.0025)
    assert np.all(sheets[:, :, 2].max(axis=1) > 0.03) and sheets[:, :, 2].max() < 0.3
    assert stretch(sheets).min() > 0.5 and stretch(sheets).max() < 1.1
    assert np.abs(sheets.mean(axis=1)[:, :2]).max() < 1e-4 and np.abs(sheets[:, :, :2]).max() < 0.45
    apart = sheets[:, None, :, :] - sheets[None]
    assert np.sort(np.abs(apart).mean(axis=(2, 3)), axis=1)[:, 1].min() > 1e-3  # no two are the same
    # both corners at the target can be taken, one by each gripper
    assert np.all(np.linalg.norm(sheets[:, CORNERS[0]] - sheets[:, CORNERS[1]], axis=1) > SIDE / 2)


def test_a_rumpled_sheet_stays_as_it_lies():
    env = batch(16, options={"rumpled": True})
    before = positions(env)
    for _ in range(15):
        *_, info = env.step(np.zeros((16, 8)))
    moved = np.linalg.norm(positions(env) - before, axis=2)
    assert not any(info["failure"]) and moved.mean() < 8e-3 and info["strain_max"].max() < 0.1


@pytest.mark.parametrize("grasped_at", [0.02, 0.028])
def test_no_gripper_presses_cloth_through_the_floor(grasped_at):
    """They sink as fast as they can, close at a height at which the corner is just in reach, and go on down."""
    env = gym.make(GRIPPER).unwrapped
    env.reset(seed=0, options={"rumpled": False})
    task, held = env.task, False
    for _ in range(60):
        action = task.expert_actions()[0].reshape(2, 4)
        tips = task.simulation.attachment_positions[0, :, 2]
        action[:, 2], action[:, 3] = np.where(tips > 0.08, -1.0, -0.3), np.where(tips < grasped_at + 0.01, CLOSED, OPEN)
        env.step(action.ravel())
        held |= bool(task.simulation.grippers.held.all())
        assert task.simulation.positions[0, :, 2].min() > -0.002
    assert held

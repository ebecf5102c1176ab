"""Hanging on a rail and on a hook: what both have in common, against numbers worked out here; see also test_hang and test_hook."""

import gymnasium as gym
import numpy as np
import pytest

HANG, HANG_HARD = "clothgym:ClothHang-v0", "clothgym:ClothHang-Hard-v0"
HOOK, HOOK_HARD = "clothgym:ClothHook-v0", "clothgym:ClothHook-Hard-v0"
SIDE, RELEASE = 0.6, np.tile([0, 0, 0, 1.0], 2)


def start(env_id, seed=3, options=None, **kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed, options=options)
    return env, observation


def sheet(env):
    """Its particles [m] and their shares of the area."""
    area = env.task.physics.mesh.area
    return env.task.simulation.positions[0].astype(float), area / area.sum()


def ends_of(own, side):
    """Root and tip of the hook's arm [m]: it rises by 30 degrees, and is 0.3 sides long."""
    (c, s), root = own["turn"], own["root"]
    return root, root + 0.3 * side * np.array([np.sqrt(3) / 2 * s, -np.sqrt(3) / 2 * c, 0.5])


def score_on_rail(shares):
    beyond, lying, carried = shares
    return 2 * min(beyond, 1 - beyond) * carried * (1 - lying)


def potential(env):
    """That of the manual page: the mean of the score and of how near the sheet is to where it hangs."""
    (x, share), own, side = sheet(env), env.task.episode[0], env.task.physics.side
    if "rail" in own.dtype.names:
        score, d = score_on_rail(own["hang"]), share @ x - own["rail"]
        along = max(abs(own["turn"] @ d[:2]) - 0.25 * side, 0)
        way = np.linalg.norm([along, own["turn"][0] * d[1] - own["turn"][1] * d[0], d[2] + side / 4])
    else:
        score, (root, tip) = float(own["threaded"]), ends_of(own, side)
        middle = x[env.task.sheet_cut.rim].mean(axis=0)
        way = np.linalg.norm(middle - root) if score else np.linalg.norm(middle - tip) + 0.3 * side
    return (score + 1 / (1 + (way / (0.4 * side)) ** 2)) / 2


@pytest.mark.parametrize("env_id", [HANG, HOOK])
def test_the_return_is_the_performance_and_success_lasts_five_seconds_after_letting_go(env_id):
    env, _ = start(env_id)
    total, effort, before, terminated, steps, held = 0.0, 0.0, potential(env), False, 0, []
    while not terminated:
        action, holds = env.expert_action(), env.task.simulation.attached[0].any()
        effort += 0.001 * np.sum(action.reshape(2, 4)[:, :3].astype(float) ** 2) * holds
        _, reward, terminated, _, info = env.step(action)
        total, steps = total + reward, steps + 1
        held.append(bool(env.task.simulation.attached[0].any()))
        if steps % 7 == 0 and not terminated:
            assert total == pytest.approx(potential(env) - before - effort, abs=2e-5)
        # held in the right place is not yet hanging
        assert info["first_success"] == -1 or not held[-1]
    x, share = sheet(env)
    speed = np.sqrt(share @ np.sum(env.task.simulation.velocities[0].astype(float) ** 2, axis=1))
    assert steps - held.index(False) - 1 == 150 and not any(held[held.index(False) :])
    assert info["is_success"] and info["success_held"] and 0 < info["first_success"] <= held.index(False) + 5
    assert info["rms_speed"] == pytest.approx(speed, rel=1e-3) and speed < 0.02 and info["lying"] == 0
    own = env.task.episode[0]
    if env_id == HANG:
        # both halves hang down, and nothing touches the floor
        side = own["turn"][0] * (x[:, 1] - own["rail"][1]) - own["turn"][1] * (x[:, 0] - own["rail"][0])
        halves = 2 * min(share[side > 0].sum(), share[side <= 0].sum())
        assert info["balance"] == pytest.approx(halves, abs=0.1) and x[:, 2].min() > 0.1 and info["support"] > 0.99
        score = info["balance"] * info["support"]
    else:
        # it hangs from the rim's upper edge: that is at the arm, all else below, and nothing touches the floor
        assert x[:, 2].min() > 0.01 and x[env.task.sheet_cut.rim, 2].max() > own["root"][2] and info["threaded"]
        score = 1
    assert info["best"] >= score - 1e-6
    assert info["normalized_performance"] == pytest.approx(score / (1 + (speed / 0.1) ** 2), abs=1e-5)
    assert total == pytest.approx(info["normalized_performance"] - before - effort + 0.25, abs=2e-5)


def settled(env, x, speed=0.0):
    """Info of an episode that ends with this sheet, let go and at rest so far, and pushed in its last step."""
    env.step(RELEASE)
    task, own = env.task, env.task.episode[0]
    task.simulation.reset(positions=x)
    task.simulation.release()
    own["step"] = own["settling_since"] = task.acting_steps
    for _ in range(149):
        env.step(np.zeros(8))
    state = env.get_state()
    state.simulation.velocities[0, :, :2] += speed * own["turn"]
    env.set_state(state)
    *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated
    return info


@pytest.mark.parametrize(("env_id", "action"), [(HANG, 0 * RELEASE), (HOOK, RELEASE), (HOOK, np.tile([0, 0, 1.0, 0], 2))])
def test_sheets_released_early_or_held_to_the_end_score_zero(env_id, action):
    env, terminated = start(env_id, seed=5)[0], False
    while not terminated:
        *_, terminated, _, info = env.step(action)
    assert info["normalized_performance"] == 0 and not info["is_success"] and info["best"] == 0 and info["first_success"] == -1


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "least"), [(HOOK, 10), (HOOK_HARD, 8)])
def test_the_expert_hangs_it_up(env_id, least):
    env = gym.make_vec(env_id, num_envs=12, autoreset_mode="Disabled").unwrapped
    env.reset(seed=77)
    hung = np.zeros(12, bool)
    for _ in range(env.task.acting_steps + 150):
        hung |= env.step(env.task.expert())[-1]["is_success"]
    assert hung.sum() >= least


@pytest.mark.parametrize("env_id", [HANG, HANG_HARD, HOOK, HOOK_HARD])
def test_observations_match_the_manual_page(env_id):
    env, _ = start(env_id, seed=8)
    for _ in range(5):
        observation, *_ = env.step(env.expert_action())
    task, seen = env.task, {name: observation[where] for name, where in env.observation_slices.items()}
    (x, share), own, side, mesh = sheet(env), task.episode[0], task.physics.side, task.physics.mesh
    if "Hang" in env_id:
        origin, points, corners = own["rail"], [0], mesh.corners[2:]
        assert seen["center"] == pytest.approx((share @ x - origin) / side, abs=2e-5)
        assert seen["rail_height"] == pytest.approx(own["rail"][2] / side) and seen["rail_turn"] == pytest.approx(own["turn"])
        assert seen["hang"] == pytest.approx(own["hang"]) and (seen["hang"][1] > 0.5) == ("Hard" in env_id)
    else:
        (root, origin), cut = ends_of(own, side), task.sheet_cut
        rim, points, corners = x[cut.rim], cut.key, cut.corners[2:]
        assert seen["hole"] == pytest.approx((rim.mean(axis=0) - origin) / side, abs=2e-5)
        assert seen["arm"] == pytest.approx((root - origin) / (0.3 * side), abs=1e-6)
        assert seen["tip_height"] == pytest.approx(origin[2] / side)
        # the plane that fits the rim best
        normal = np.linalg.svd(rim - rim.mean(axis=0))[2][2]
        assert abs(seen["hole_normal"] @ normal) > 0.99 and np.linalg.norm(seen["hole_normal"]) == pytest.approx(1)
        assert seen["threaded"] == 0 and (seen["lying"] > 0.5) == ("Hard" in env_id)
    assert seen["keypoints"].reshape(-1, 3)[: len(points)] == pytest.approx((x[points] - origin) / side, abs=2e-5)
    times = [*seen["settling"], *seen["episode_left"], *seen["acting_left"]]
    assert times == pytest.approx([0, 1 - 5 / (task.acting_steps + 150), 1 - 5 / task.acting_steps])
    if "Hard" in env_id:
        tips = task.simulation.grippers.positions[0].astype(float)
        for k, row in enumerate(seen["grippers"].reshape(2, 8)):
            assert row[:3] == pytest.approx((tips[k] - origin) / side, abs=2e-5)
            assert row[3:6] == pytest.approx((x[corners[k]] - tips[k]) * 10 / side, abs=2e-4) and row[6:].tolist() == [1, 0]
    else:
        assert seen["holds"].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("env_id", "far", "field", "low", "high"), [(HANG_HARD, 0.13, "rail", 0.75, 1.0), (HOOK_HARD, 0.4, "root", 1.15, 1.35)]
)
def test_starts_lie_before_the_stand_and_hands_hover_above_the_corners(env_id, far, field, low, high):
    env = gym.make_vec(env_id, num_envs=24, autoreset_mode="Disabled").unwrapped
    env.reset(seed=0)
    task, side = env.task, 0.8
    x, corners = task.simulation.positions.astype(float), [len(task.physics.mesh.rest_positions) - 21, -1]
    assert np.all(task.in_frame(x)[..., 1].max(axis=1) < -far * side) and np.all(x[..., 2].min(axis=1) > 0)
    assert 4 < (x[..., 2].max(axis=1) < 0.004).sum() < 20
    away = task.simulation.grippers.positions.astype(float) - x[:, corners]
    assert np.all(abs(away[..., :2]) <= 0.1 * side + 1e-5)
    assert np.all((away[..., 2] >= 0.2 * side - 1e-5) & (away[..., 2] <= 0.35 * side))
    assert np.all((low * side <= task.episode[field][:, 2]) & (task.episode[field][:, 2] <= high * side))


@pytest.mark.parametrize("wanted", [{"height": 0.3}, {"yaw": 2.0}, {"center": (1, 1)}, {"radius": 0.1}, 3])
@pytest.mark.parametrize(("env_id", "name"), [(HANG, "rail"), (HOOK, "hook")])
def test_impossible_rails_and_hooks_are_refused(env_id, name, wanted):
    with pytest.raises(ValueError, match=name):
        start(env_id, options={name: wanted})

"""ClothFold-v0: its errors against folds that are made here, and what its expert does to a sheet."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import grid
from clothgym.envs.coverage import covered_area, shared_area
from clothgym.envs.fold import fold_errors, ideals

ID, SIDE = "clothgym:ClothFold-v0", 0.6


def sheet(rows):
    """A grid, its points about the center (particles, 2), and its areas' shares."""
    mesh = grid(rows, rows, SIDE, SIDE)
    flat = mesh.rest_positions[:, :2] - mesh.rest_positions[:, :2].mean(axis=0)
    return mesh, flat, (mesh.area / mesh.area.sum()).astype(np.float32)


def laid(points, height=0.004, turn=0.0, shift=(0.0, 0.0)):
    """Points of the floor, (particles, 2), turned and moved, as a sheet for the kernels, (3, particles)."""
    c, s = np.cos(turn), np.sin(turn)
    x = np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], np.full(len(points), height)])
    return np.ascontiguousarray(x + np.array([*shift, 0.0])[:, None], np.float32)


@pytest.mark.parametrize(("rows", "edge"), [(13, 0), (25, 1), (49, 2), (13, 3)])
def test_half_fold_over_any_edge_at_any_pose_has_zero_error(rows, edge):
    _, flat, share = sheet(rows)
    axis, sign = edge // 2, 1 - 2 * (edge % 2)
    folded = flat.copy()
    folded[:, axis] = sign * abs(folded[:, axis])
    error, worst, height = fold_errors(laid(folded, 0.004, 2.0, (0.3, -0.2)), share, ideals("half", flat))
    assert error < 1e-6 and worst < 1e-6 and height == pytest.approx(0.004, abs=1e-6)


@pytest.mark.parametrize("corner", [0, 1, 2, 3])
def test_a_corner_laid_on_its_opposite_is_a_diagonal_fold(corner):
    _, flat, share = sheet(17)
    away = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)][corner]) / np.sqrt(2)
    # what lies beyond the other diagonal is mirrored at it
    beyond = np.maximum(flat @ away, 0)
    folded = flat - 2 * beyond[:, None] * away
    error, worst, _ = fold_errors(laid(folded, turn=-0.7), share, ideals("diagonal", flat))
    assert error < 1e-6 and worst < 1e-6
    assert fold_errors(laid(folded), share, ideals("half", flat))[0] > 0.05


def test_a_quarter_is_folded_twice_and_half_of_it_is_not_enough():
    _, flat, share = sheet(17)
    quarter, half = abs(flat) * (1, -1), flat * (1, 1)
    half[:, 1] = -abs(half[:, 1])
    assert fold_errors(laid(quarter, turn=1.0), share, ideals("quarter", flat))[1] < 1e-6
    assert fold_errors(laid(half), share, ideals("quarter", flat))[0] > 0.1


@pytest.mark.parametrize("rows", [13, 25, 49])
def test_the_error_of_a_flat_sheet_is_that_of_the_integral(rows):
    """The ideal half fold beside the flat sheet: both centered at their centers of area, no rotation.

    The ideal's points (u, -|v|) have their center at -L/4, so the distance is |v + |v| - L/4|: its mean over the sheet is L/4, that
    of v < 0 where it is L/4, and of v > 0 where it is |2 v - L/4| with the mean (1/64 + 9/64) L / (1/2) = 5/16 L; in all 9/32 L.
    """
    _, flat, share = sheet(rows)
    error, worst, _ = fold_errors(laid(flat), share, ideals("half", flat))
    assert error / SIDE == pytest.approx(9 / 32, abs=0.01)
    assert worst / SIDE == pytest.approx(3 / 4, abs=0.01)


@pytest.mark.parametrize("rows", [13, 25, 49])
def test_areas_are_those_of_the_polygons(rows):
    mesh, flat, _ = sheet(rows)
    triangles, cell = np.array(mesh.triangles, np.int64), SIDE / 256
    for turn in (0.0, 0.3, np.pi / 4):
        x = laid(flat, turn=turn, shift=(0.11, -0.07))
        assert covered_area(x, triangles, cell) == pytest.approx(SIDE**2, rel=5e-3)
        # moved by a quarter along its own edge it shares three quarters, of five in all
        other = laid(flat + (SIDE / 4, 0), turn=turn, shift=(0.11, -0.07))
        both, either = shared_area(x, other, triangles, cell)
        assert both == pytest.approx(0.75 * SIDE**2, rel=1e-2) and either == pytest.approx(1.25 * SIDE**2, rel=1e-2)
    # folded over, a fold covers no area twice
    assert covered_area(laid(flat * (1, 0) - abs(flat) * (0, 1)), triangles, cell) == pytest.approx(SIDE**2 / 2, rel=1e-2)


def episodes(count, seed=1_000_000, still=False, env_id=ID, **kwargs):
    """The last infos of so many episodes, of the expert, or of nobody; and how high the sheet ever was in the last 60 steps [m]."""
    env = gym.make_vec(env_id, num_envs=count, autoreset_mode="Disabled", **kwargs)
    env.reset(seed=seed)
    terminated, highest = np.zeros(count, bool), 0.0
    while not terminated.all():
        actions = np.zeros(env.action_space.shape) if still else env.expert_actions()
        _, _, terminated, _, info = env.step(actions)
        if info["settling"].all():
            highest = max(highest, env.task.simulation.positions[..., 2].max())
    return info, highest


@pytest.mark.slow
@pytest.mark.parametrize("fold, error", [("half", 2), ("diagonal", 12), ("quarter", 22)])
def test_the_expert_folds(fold, error):
    info, _ = episodes(4, fold=fold)
    assert info["is_success"].sum() >= 3 and info["fold_error_mm"].max() < error
    assert np.all(info["first_success"] > 20) and not info["failure"].any()
    assert np.allclose(info["fold_error_mm"], 1000 * SIDE * info["fold_error"])


@pytest.mark.slow
@pytest.mark.parametrize("fold, actions", [("half", 1), ("quarter", 2)])
def test_the_expert_folds_by_picking_and_placing(fold, actions):
    env = gym.make_vec(ID, num_envs=2, autoreset_mode="Disabled", fold=fold, action_mode="pick_place")
    env.reset(seed=1_000_000)
    for _ in range(actions):
        *_, info = env.step(env.expert_actions())
    assert np.all(info["best"] > 0.9) and np.all(info["first_success"] <= 60 * actions)
    # then it lets well alone
    placed = env.expert_actions().reshape(2, 2, 5)
    assert np.all(placed == 1)


@pytest.mark.slow
def test_released_layers_do_not_jump():
    """Impulses that had borne what the fingers pressed threw it up by half a meter."""
    assert episodes(2, seed=1_000_006, fold="quarter")[1] < 0.15


@pytest.mark.slow
def test_the_expert_folds_a_large_sheet_of_silk_twice():
    info, _ = episodes(4, env_id=ID.replace("-v0", "-Hard-v0"))
    assert info["is_success"].sum() >= 3 and info["fold_error_mm"].max() < 45 and not info["failure"].any()
    assert np.allclose(info["fold_error_mm"], 800 * info["fold_error"])


# --- potential, observation and judge, of sheets made here --------------------------------------------------------------------


def start(seed=3):
    env = gym.make(ID).unwrapped
    env.reset(seed=seed)
    return env


def half(env, aside):
    """The sheet folded in half, its crease so far from its middle line [m], the upper layer 8 mm over the lower."""
    rest = env.task.physics.mesh.rest_positions
    over = rest[:, 1] - aside
    return np.stack([rest[:, 0], aside - abs(over), 0.004 + 0.008 * np.clip(over / 0.04, 0, 1)], axis=1)


def errors(env):
    """Mean and largest distance from the nearest half fold, seen from above, in sides: by Kabsch's rotation."""
    mesh, x = env.task.physics.mesh, env.task.simulation.positions[0].astype(float)
    weights, (u, v) = mesh.area / mesh.area.sum(), mesh.rest_positions[:, :2].T
    found = []
    for ideal in ((u, -abs(v)), (u, abs(v)), (-abs(u), v), (abs(u), v)):
        a, b = np.stack(ideal, axis=1), x[:, :2]
        a, b = a - weights @ a, b - weights @ b
        left, _, right = np.linalg.svd((weights[:, None] * b).T @ a)
        turn = left @ np.diag([1, np.linalg.det(left @ right)]) @ right
        away = np.linalg.norm(b - a @ turn.T, axis=1) / SIDE
        found.append((weights @ away, away.max()))
    return min(found), weights @ x[:, 2] / SIDE


@pytest.mark.parametrize(
    ("aside", "raised", "speed", "success"),
    [(0.0, 0.0, 0.0, True), (0.09, 0.0, 0.0, False), (0.0, 0.0, 0.6, False), (0.0, 0.1, 0.338, False)],
)
def test_success_asks_for_a_fold_that_is_near_flat_and_at_rest(aside, raised, speed, success):
    """The last two go up: one lies flat and moves, the other rests for a moment in the air."""
    env = start()
    task, own = env.task, env.task.episode[0]
    # how far a flat sheet's points are from a fold
    task.simulation.reset(positions=task.physics.mesh.rest_positions + (0, 0, 0.004))
    env.step(np.zeros(8))
    unfolded = errors(env)[0][0]
    task.simulation.reset(positions=half(env, aside))
    own["step"] = own["settling_since"] = task.acting_steps
    for _ in range(task.settling_steps - 1):
        env.step(np.zeros(8))
    state = env.get_state()
    state.simulation.positions[0, :, 2] += raised
    state.simulation.velocities[0] = (0, 0, speed)
    env.set_state(state)
    *_, terminated, _, info = env.step(np.zeros(8))
    (error, worst), high = errors(env)
    v = task.simulation.velocities[0].astype(float)
    rms = np.sqrt(task.physics.mesh.area / SIDE**2 @ np.sum(v**2, axis=1))
    assert terminated and info["fold_error"] == pytest.approx(error, abs=1e-4)
    assert info["fold_error_max"] == pytest.approx(worst, abs=1e-3) and info["height"] == pytest.approx(high, abs=1e-5)
    assert [worst <= 0.1, high <= 0.05, rms < 0.02] == [aside == 0, raised == 0, speed != 0.6]
    performance = (1 - error / unfolded) / (1 + (high / 0.05) ** 4) / (1 + (rms / 0.1) ** 2)
    assert info["normalized_performance"] == pytest.approx(performance, abs=5e-3) and info["is_success"] == success
    assert info["overlap"] > 0.97 if aside == 0 else info["overlap"] < 0.9


def test_the_potential_and_the_ways_of_grippers_that_hold_their_places():
    env = start()
    task = env.task
    places = task.rules["places"].ravel().tolist()
    tips = task.simulation.positions[:, places].astype(float) + (0, 0, 0.01)
    # near their places, and when they hold them
    task.simulation.grippers.place(tips + (0, 0, 0.05), np.array([0]))
    task.episode["targets"][:] = tips + (0, 0, 0.05)
    observation, *_ = env.step(np.zeros(8))
    x, at = task.simulation.positions[0].astype(float), task.simulation.grippers.positions[0].astype(float)
    away = np.linalg.norm(x[places] - at, axis=1) / (0.15 * SIDE)
    assert task.episode["potential"][0] == pytest.approx(0.3 * np.mean(0.5 / (1 + away**2)), abs=2e-3)
    ways = observation[env.observation_slices["ways"]].reshape(-1, 3)
    assert ways == pytest.approx((x[places] - at) * 10 / SIDE, abs=1e-4)
    task.simulation.grippers.place(tips, np.array([0]))
    task.episode["targets"][:] = tips
    for _ in range(5):
        env.step(np.tile([0, 0, 0, -1.0], 2))
    assert task.episode["potential"][0] == pytest.approx(0.3, abs=5e-3)


def test_doing_nothing_scores_nothing():
    info, _ = episodes(2, still=True)
    assert not info["is_success"].any() and info["normalized_performance"].max() < 0.02
    assert np.all(info["first_success"] == -1) and not info["success_held"].any()


def test_an_unknown_fold_is_refused():
    with pytest.raises(ValueError, match="fold='thirds': must be 'half' or 'diagonal' or 'quarter'"):
        gym.make(ID, fold="thirds")

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


@pytest.mark.parametrize("rows", [13, 25, 49])
@pytest.mark.parametrize("edge", [0, 1, 2, 3])
def test_a_perfect_half_fold_has_no_error_wherever_it_lies_and_over_whatever_edge(rows, edge):
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


@pytest.mark.parametrize("fold, error", [("half", 2), ("diagonal", 12), ("quarter", 22)])
def test_the_expert_folds(fold, error):
    info, _ = episodes(4, fold=fold)
    assert info["is_success"].sum() >= 3 and info["fold_error_mm"].max() < error
    assert np.all(info["first_success"] > 20) and not info["failure"].any()
    assert np.allclose(info["fold_error_mm"], 1000 * SIDE * info["fold_error"])


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


def test_what_was_pressed_together_does_not_jump_when_it_is_let_go():
    """Impulses that had borne what the fingers pressed threw it up by half a meter."""
    assert episodes(2, seed=1_000_006, fold="quarter")[1] < 0.15


def test_the_expert_folds_a_large_sheet_of_silk_twice():
    info, _ = episodes(4, env_id=ID.replace("-v0", "-Hard-v0"))
    assert info["is_success"].sum() >= 3 and info["fold_error_mm"].max() < 45 and not info["failure"].any()
    assert np.allclose(info["fold_error_mm"], 800 * info["fold_error"])


def test_doing_nothing_scores_nothing():
    info, _ = episodes(2, still=True)
    assert not info["is_success"].any() and info["normalized_performance"].max() < 0.02
    assert np.all(info["first_success"] == -1) and not info["success_held"].any()


def test_an_unknown_fold_is_refused():
    with pytest.raises(ValueError, match="fold='thirds': must be 'half' or 'diagonal' or 'quarter'"):
        gym.make(ID, fold="thirds")

"""Flattening: coverage on a grid of the world, starts, evaluation, expert, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import grid
from clothgym.envs.coverage import CELL, FINE_CELL, covered_area, softgym_area
from clothgym.envs.rumpled import CRUMPLED, CRUMPLED_LARGE, resampled, rumpled_sheets
from clothgym.geometry.intersections import find_intersections
from clothgym.parameters import PROPERTIES

ID = "clothgym:ClothFlatten-v0"
SIDE = 0.6


def area(mesh, x, cell=FINE_CELL):
    return covered_area(np.ascontiguousarray(x.T, np.float32), mesh.triangles.astype(np.int64), cell)


def turned(x, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.concatenate([x[:, :2] @ np.array([[c, s], [-s, c]]), x[:, 2:]], axis=1)


def folded(mesh, at):
    """A sheet folded over a crease that lies on mesh lines of 13, 25 and 49 a side; at: in sides, from the middle."""
    x = mesh.rest_positions.copy()
    over = x[:, 0] > at * SIDE
    x[over, 0] = 2 * at * SIDE - x[over, 0]
    return x


@pytest.mark.parametrize("at", [0.0, 0.25, -1 / 12])
@pytest.mark.parametrize("yaw", [0.1, 0.7, 2.5])
def test_coverage_of_one_surface_at_13_25_and_49_a_side_is_its_area(at, yaw):
    meshes = [grid(rows, rows, SIDE, SIDE) for rows in (13, 25, 49)]
    found = [area(mesh, turned(folded(mesh, at), yaw) + (0.013, -0.021, 0)) / SIDE**2 for mesh in meshes]
    # the wider part hides the other
    assert max(found) - min(found) < 1e-4 and found[0] == pytest.approx(0.5 + abs(at), abs=3e-3)
    assert area(meshes[0], turned(folded(meshes[0], at), yaw), CELL) / SIDE**2 == pytest.approx(0.5 + abs(at), abs=0.012)


def test_coverage_of_crumpled_sheets_resampled_to_finer_grids_stays():
    coarse = grid(17, 17, SIDE, SIDE)
    for x in rumpled_sheets(17, 17, SIDE, CRUMPLED)[:8]:
        # 33 and 49 a side hold every particle of 17: the same surface but for the cells' diagonals
        found = []
        for rows in (33, 49):
            mesh = grid(rows, rows, SIDE, SIDE)
            found.append(area(mesh, resampled(x[None], coarse, mesh)[0]) / SIDE**2)
        assert max(abs(one - area(coarse, x) / SIDE**2) for one in found) < 0.01


def test_layers_count_once_and_what_hangs_counts_as_it_is_seen_from_above():
    mesh = grid(9, 9, 0.4, 0.4)
    upright = mesh.rest_positions[:, [0, 2, 1]]
    assert area(mesh, upright) == 0
    slope = mesh.rest_positions * (1, np.cos(0.8), 1)
    assert area(mesh, turned(slope, 0.3)) == pytest.approx(0.16 * np.cos(0.8), rel=5e-3)


def test_softgym_s_area_is_that_of_cells_near_particles():
    radius, x = 0.05, grid(9, 9, 0.4, 0.4).rest_positions
    points = np.ascontiguousarray(x.T, np.float32)
    assert softgym_area(points, radius) == pytest.approx(0.16, rel=1e-5)
    # particles at the ends of a box, and none between: four squares of (radius / span) cells
    four = np.ascontiguousarray(x[[0, 8, 72, 80]].T, np.float32)
    assert softgym_area(four, radius) == pytest.approx(4 * radius**2, rel=0.1)


@pytest.mark.parametrize("bank", [CRUMPLED, CRUMPLED_LARGE])
def test_starts_are_crumpled_and_free_of_intersections(bank):
    sheets = rumpled_sheets(bank.rows, bank.rows, bank.side, bank)
    mesh = grid(bank.rows, bank.rows, bank.side, bank.side)
    assert sheets.shape == (bank.kept, bank.rows**2, 3) and not len(find_intersections(mesh.triangles, sheets))
    assert max(area(mesh, x) for x in sheets) < 0.5 * bank.side**2
    assert np.all(sheets[:, :, 2].min(axis=1) > 0) and sheets[:, :, 2].max() < 0.7 * bank.side


def test_episodes_draw_sheet_yaw_mirror_image_and_place():
    env = gym.make_vec(ID, num_envs=4, autoreset_mode="Disabled")
    env.reset(seed=[1, 2, 3, 1])
    x = env.unwrapped.task.simulation.positions
    assert np.array_equal(x[0], x[3]) and not np.allclose(x[0], x[1], atol=0.01)
    triangles = env.unwrapped.task.physics.mesh.triangles
    assert not len(find_intersections(triangles, x.astype(float)))


def test_doing_nothing_improves_nothing_and_the_expert_flattens():
    env = gym.make_vec(ID, num_envs=4, autoreset_mode="Disabled")
    env.reset(seed=[1_000_106, 1_000_117, 1_000_127, 5])
    task, over = env.unwrapped.task, np.zeros(4, bool)
    start, rewards = task.infos()["coverage_start"].copy(), np.zeros(4)
    potential = task.episode["potential"].copy()
    while not over.all():
        actions = task.expert_actions()
        actions[3] = 0.0
        _, _, terminated, _, info = env.step(actions)
        rewards += info["reward/progress"]
        over |= terminated
    mesh, x = task.physics.mesh, task.simulation.positions.astype(float)
    coverage = np.array([area(mesh, one) / SIDE**2 for one in x])
    assert info["coverage"] == pytest.approx(np.minimum(coverage, 1))
    improvement = (coverage - start) / (1 - start)
    assert info["normalized_performance"] == pytest.approx(np.where(coverage >= 0.99, 1, np.clip(improvement, 0, 1)))
    assert rewards == pytest.approx(info["normalized_performance"] - potential)
    assert info["is_success"][:3].sum() >= 2 and info["normalized_performance"][3] < 0.05 and not info["is_success"][3]
    assert np.all(info["is_success"] == ((coverage >= 0.95) & (info["rms_speed"] < 0.02)))
    assert np.all(info["best"][:3] >= 0.9) and info["first_success"][3] == -1


def test_the_hard_tier_is_larger_and_of_another_fabric():
    hard = gym.make("clothgym:ClothFlatten-Hard-v0").unwrapped
    hard.reset(seed=0)
    assert hard.task.physics.mesh.grid_shape == (21, 21) and hard.task.physics.side == 0.8
    # 162.9 g/m^2 and 6.57 uN m of rigidity, as Matsudaira and others measured their tropical wool
    properties = dict(zip(PROPERTIES, hard.task.episode["material"][0]))
    assert properties["density"] == 0.1629 and properties["bend_rigidity"] == 6.57e-6

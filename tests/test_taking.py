"""Where a gripper takes a corner of a rumpled sheet, against counting every particle from every direction."""

import gymnasium as gym
import numpy as np
import pytest

import clothgym  # noqa: F401
from clothgym.envs.manipulation import REACH
from clothgym.envs.taking import AWAY, CLEAR, DIRECTIONS, beside_corners, places_to_take
from clothgym.mesh import grid

MESH = grid(17, 17, 0.6, 0.6)


def lying_flat():
    return MESH.rest_positions + (0, 0, 0.004)


def test_a_corner_that_lies_alone_is_taken_from_straight_above():
    places, others = places_to_take(lying_flat()[None], MESH)
    np.testing.assert_allclose(places[0], lying_flat()[list(MESH.corners)] + (0, 0, AWAY), atol=1e-12)
    assert others.tolist() == [[0, 0, 0, 0]]


def test_the_neighbors_of_a_corner_may_be_taken_along_and_no_others():
    # itself, two along the edges, and one across the diagonal of a cell
    beside = beside_corners(MESH)
    assert beside.sum(axis=1).tolist() == [4, 4, 4, 4]
    assert np.flatnonzero(beside[0]).tolist() == [0, 1, 17, 18]


def test_other_cloth_above_a_corner_is_avoided():
    x = lying_flat()
    corner = MESH.corners[0]
    # the middle of the sheet is folded over it, 5 cm up: within reach of a tip above, not of one that lies beside the corner
    x[8 * 17 + 8] = x[corner] + (0.0, 0.0, 0.05)
    places, others = places_to_take(x[None], MESH)
    assert others[0, 0] == 0
    away = places[0, 0] - x[corner]
    assert away[2] < 0.8 * AWAY and np.linalg.norm(away) < REACH
    assert np.linalg.norm(places[0, 0] - x[8 * 17 + 8]) >= CLEAR


def test_where_there_is_no_free_place_the_least_is_taken():
    x = lying_flat()
    # three particles at a corner itself are within reach of whatever tip takes it
    x[[100, 120, 140]] = x[MESH.corners[2]] + (0.0, 0.0, 0.001)
    assert places_to_take(x[None], MESH)[1][0].tolist() == [0, 0, 3, 0]


@pytest.mark.parametrize("env_id", ["ClothFlatten-v0", "ClothFling-v0"])
def test_what_is_observed_is_the_best_of_all_directions(env_id):
    env = gym.make_vec(f"clothgym:{env_id}", num_envs=3)
    seen, _ = env.reset(seed=5)
    for _ in range(12):
        seen, *_ = env.step(env.unwrapped.task.expert().astype(np.float32))
    task = env.unwrapped.task
    slices, side = task.observation_slices, task.physics.side
    takes, crowding = seen[:, slices["takes"]].reshape(3, 2, 4, 3), seen[:, slices["crowding"]]
    assert crowding.max() > 0 or env_id == "ClothFling-v0"
    tips, x = task.simulation.grippers.positions.astype(float), task.simulation.positions.astype(float)
    rest = MESH.rest_positions
    for e in range(3):
        for k, corner in enumerate(MESH.corners):
            others = x[e, np.linalg.norm(rest - rest[corner], axis=1) > 0.06]
            at = x[e, corner] + AWAY * DIRECTIONS
            at[:, 2] = np.maximum(at[:, 2], 0.012)
            counts = (np.linalg.norm(at[:, None] - others, axis=2) < CLEAR).sum(axis=1)
            counts[np.linalg.norm(at - x[e, corner], axis=1) > 0.0285] += 1000
            assert crowding[e, k] == pytest.approx(counts.min() / (1 + counts.min()), abs=1e-6)
            for tip in range(2):
                assert takes[e, tip, k] * side / 10 + tips[e, tip] == pytest.approx(at[counts.argmin()], abs=1e-5)
    env.close()

"""Where a gripper takes a corner of a rumpled sheet, against counting every particle from every direction."""

import gymnasium as gym
import numpy as np
import pytest

import clothgym  # noqa: F401
from clothgym.envs.gripper_task import REACH
from clothgym.envs.taking import AWAY, CLEAR, corner_neighbors, next_edge, next_takes, places_to_take
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
    neighbors = corner_neighbors(MESH)
    assert neighbors.sum(axis=1).tolist() == [4, 4, 4, 4]
    assert np.flatnonzero(neighbors[0]).tolist() == [0, 1, 17, 18]


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


def taken_next(x, tips, holder=None, high=(9, 9, 9), edge_costs=None):
    """Where grippers take hold next, and of how many other particles."""
    holder = np.full(MESH.num_particles, -1) if holder is None else holder
    goals, count = np.full((2, 3), np.nan), np.empty(2, np.int64)
    across = np.ascontiguousarray(x.T)
    next_takes(
        across,
        np.array(MESH.corners),
        corner_neighbors(MESH),
        np.zeros((4, 4)) if edge_costs is None else edge_costs,
        holder,
        np.array(tips, float),
        0.6,
        np.full(3, -9.0),
        np.array(high, float),
        goals,
        count,
    )
    return goals, count.tolist()


def above(x, corner):
    return x[MESH.corners[corner]] + (0, 0, AWAY)


def covered(x, corner):
    """Three particles of the middle lie on a corner."""
    x[[8 * 17 + 7, 8 * 17 + 8, 8 * 17 + 9]] = x[MESH.corners[corner]] + (0, 0, 0.001)
    return x


def test_both_go_to_the_nearest_edge_and_do_not_cross():
    x = lying_flat()
    # above the edge of the corners 1 and 3, at whichever end they are
    ends = x[MESH.corners[1]] + (0.05, 0.1, 0.3), x[MESH.corners[3]] + (0.05, -0.1, 0.3)
    for order in ([0, 1], [1, 0]):
        goals, count = taken_next(x, [ends[i] for i in order])
        assert count == [0, 0]
        np.testing.assert_allclose(goals, [above(x, (1, 3)[i]) for i in order], atol=1e-6)


def test_an_edge_with_a_covered_corner_is_left_for_the_opposite_one():
    x = covered(lying_flat(), 1)
    ends = x[MESH.corners[1]] + (0.05, 0.1, 0.3), x[MESH.corners[3]] + (0.05, -0.1, 0.3)
    goals, count = taken_next(x, ends)
    assert count == [0, 0]
    # of the two edges without corner 1 that of 3 and 2 is as near as that of 2 and 0 is far
    taken = {int(np.linalg.norm(goal - [above(x, i) for i in range(4)], axis=1).argmin()) for goal in goals}
    assert taken == {2, 3}


def test_an_edge_beyond_reach_is_left_as_well():
    x = lying_flat()
    edge = x[MESH.corners[1]], x[MESH.corners[3]]
    # the room ends a centimeter before it
    high = (edge[0][0] - 0.01, 9, 9)
    assert edge[0][0] == edge[1][0]
    goals, count = taken_next(x, [edge[0] + (0.05, 0.1, 0.3), edge[1] + (0.05, -0.1, 0.3)], high=high)
    taken = {int(np.linalg.norm(goal - [above(x, i) for i in range(4)], axis=1).argmin()) for goal in goals}
    assert count == [0, 0] and taken == {0, 2}


def test_of_covered_corners_one_gripper_takes_the_freest():
    x = lying_flat()
    for corner, particles in enumerate(([100, 101, 102], [110, 111, 112], [140, 141, 142], [120, 121])):
        x[particles] = x[MESH.corners[corner]] + (0, 0, 0.001)
    goals, count = taken_next(x, [(0, 0, 0.3), (0.1, 0.1, 0.3)])
    # of corner 3 it takes two others; the other gripper has nothing to take
    assert sorted(count) == [-1, 2]
    one = count.index(2)
    assert np.linalg.norm(goals[one] - x[MESH.corners[3]]) < REACH and np.isnan(goals[1 - one]).all()


def test_while_one_holds_a_corner_the_other_takes_its_nearer_neighbor():
    x, holder = lying_flat(), np.full(MESH.num_particles, -1)
    holder[[0, 1, 17, 18]] = 1
    for nearest, corner in ((1, 1), (2, 2), (3, None)):
        goals, count = taken_next(x, [x[MESH.corners[nearest]] + (0, 0, 0.2), x[0]], holder)
        assert count == [0, -1]
        # never the far end of a diagonal
        expected = [above(x, i) for i in ((corner,) if corner else (1, 2))]
        assert min(np.linalg.norm(goals[0] - one) for one in expected) < 1e-6


def test_what_the_other_gripper_holds_is_not_taken():
    x, holder = lying_flat(), np.full(MESH.num_particles, -1)
    # two corners of an edge in one hand: there is one neighbor of the first that is not held
    holder[[MESH.corners[0], MESH.corners[1]]] = 0
    goals, count = taken_next(x, [x[0], x[MESH.corners[1]] + (0, 0, 0.1)], holder)
    assert count == [-1, 0]
    np.testing.assert_allclose(goals[1], above(x, 2), atol=1e-6)
    # and of three there is none
    holder[MESH.corners[2]] = 0
    assert taken_next(x, [x[0], x[MESH.corners[1]] + (0, 0, 0.1)], holder)[1] == [-1, -1]


def test_no_grasp_point_while_other_cloth_is_held():
    x, holder = lying_flat(), np.full(MESH.num_particles, -1)
    holder[8 * 17 + 8] = 0
    assert taken_next(x, [x[144], (0, 0, 0.3)], holder)[1] == [-1, -1]


def edge_next(x, tips, low=(-9, -9, 0), high=(9, 9, 9)):
    """Where grippers take an edge next, and of how many other particles."""
    goals, count = np.full((2, 3), np.nan), np.empty(2, np.int64)
    room = [np.array(one, float) for one in (low, high)]
    across = np.ascontiguousarray(x.T)
    next_edge(across, np.array(MESH.corners), corner_neighbors(MESH), 17, np.array(tips, float), *room, goals, count)
    return goals, count.tolist()


@pytest.mark.parametrize("quarter", range(4))
def test_the_edge_that_costs_least_is_taken_by_the_left_hand_on_the_left(quarter):
    # turned by quarters and a bit, another edge lies behind along x each time
    angle = quarter * np.pi / 2 + 0.1
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    x = lying_flat() @ turn.T
    order = np.argsort(x[list(MESH.corners), 1])
    front, behind = (sorted(np.array(MESH.corners)[pair], key=lambda p: x[p, 0]) for pair in (order[:2], order[2:]))
    up = (0, 0, AWAY)
    # the hands are crossed above the edge behind: 1.2 m of way, and 1.7 m to the other
    goals, count = edge_next(x, [x[behind[1]] + up, x[behind[0]] + up])
    assert goals == pytest.approx(x[behind] + up) and count == [0, 0]
    # straight above it, 1.2 m from the other: one particle on an end counts for a meter, two for more than the way
    for taken, (ends, others) in enumerate([(behind, [0, 0]), (behind, [1, 0]), (front, [0, 0])]):
        x[[100, 120][:taken]] = x[behind[0]] + (0, 0, 0.001)
        goals, count = edge_next(x, x[behind] + up)
        assert np.linalg.norm(goals - x[ends], axis=1) == pytest.approx([AWAY] * 2, rel=0.15) and count == others


def test_sides_are_taken_where_they_come_within_reach():
    # both edges along x are out of reach; the sixth row of particles is the first that is not
    x = lying_flat()
    goals, count = edge_next(x, [(-0.3, -0.05, 0.1), (0.3, -0.05, 0.1)], (-9, -0.1, 0), (9, 0.1, 9))
    assert goals == pytest.approx(x.reshape(17, 17, 3)[6, [0, 16]] + (0, 0, 0.015)) and count == [1000, 1000]


def test_an_edge_that_is_short_along_x_is_not_taken_nor_one_that_is_out_of_reach():
    tips = [(0, 0, 0.1)] * 2
    assert edge_next(lying_flat() * (0.01, 1, 1), tips)[1] == [-1, -1]
    assert edge_next(lying_flat(), tips, (-9, 2, 0))[1] == [-1, -1]


def test_what_is_observed_says_where_the_expert_goes():
    env = gym.make_vec("clothgym:ClothFlatten-v0", num_envs=8)
    seen, _ = env.reset(seed=5)
    task = env.unwrapped.task
    at = task.observation_slices["next"]
    approached = 0
    for _ in range(20):
        now, wanted = seen[:, at].reshape(8, 2, 4).astype(float), task.expert().reshape(8, 2, 4)
        # an observed length q stands for a way of q/(1 - q) cm; the expert goes there, at most at 0.9 m/s
        length = np.linalg.norm(now[..., :3], axis=2)
        way = 0.01 * now[..., :3] / (1 - length)[..., None]
        speed = np.minimum(15 * np.linalg.norm(way, axis=2), 0.9)[..., None]
        toward = speed * way / np.maximum(np.linalg.norm(way, axis=2), 1e-9)[..., None]
        both = (now[..., 3] == 1).all(axis=1)
        assert toward[both] == pytest.approx(wanted[both][..., :3], abs=2e-3)
        approached += both.sum()
        seen, *_ = env.step(wanted.reshape(8, 8).astype(np.float32))
    assert approached > 30
    env.close()


def test_the_far_edge_is_observed_while_an_edge_is_held():
    env = gym.make_vec("clothgym:ClothFlatten-v0", num_envs=16)
    seen, _ = env.reset(seed=5)
    task = env.unwrapped.task
    slices, corners, found = task.observation_slices, np.array(MESH.corners), 0
    # corners beside each other, going around
    around, rest = [0, 1, 3, 2], MESH.rest_positions[corners]
    for _ in range(60):
        seen, *_ = env.step(task.expert().astype(np.float32))
        simulation = task.simulation
        holder, tips = simulation.grippers.holder, simulation.grippers.positions.astype(float)
        x, v = (part[:, corners].astype(float) for part in (simulation.positions, simulation.velocities))
        for e in range(16):
            held = [next((i for i in range(4) if holder[e, corners[i]] == k), None) for k in range(2)]
            out, far, swing = (seen[e, slices[name]] for name in ("out", "far", "swing"))
            if None in held or sum(held) == 3:
                assert not out.any() and not far.any() and not swing.any()
                continue
            # the neighbor of each corner that the other gripper does not hold
            turns = [around.index(corner) for corner in held]
            adjacent = [next(j for j in (around[i - 1], around[(i + 1) % 4]) if j not in held) for i in turns]
            along = (tips[e, 1] - tips[e, 0]) * (1, 1, 0)
            along /= np.linalg.norm(along)
            # with its front up the sheet lies across the edge as it does at rest
            up = np.sign(np.cross(rest[held[1]] - rest[held[0]], rest[adjacent[0]] - rest[held[0]])[2])
            across = np.cross((0, 0, up), along)
            assert out == pytest.approx(across[:2], abs=1e-5)
            ways = x[e, adjacent] - tips[e]
            expected = np.stack([ways @ along, ways @ across, ways[:, 2]], axis=1) / 0.6
            assert far.reshape(2, 3) == pytest.approx(expected, abs=1e-5)
            assert swing.item() == pytest.approx(v[e, adjacent].mean(axis=0) @ across, abs=1e-5)
            found += 1
    assert found > 50
    env.close()


def test_an_edge_that_costs_more_is_taken_only_where_the_others_are_covered():
    x, holder = lying_flat(), np.full(MESH.num_particles, -1)
    edge_costs = np.zeros((4, 4))
    edge_costs[0, 2] = edge_costs[2, 0] = 2.0
    # above the edge of the corners 0 and 2 both go to another one
    goals, count = taken_next(x, [above(x, 0), above(x, 2)], edge_costs=edge_costs)
    taken = {int(np.linalg.norm(goal - [above(x, i) for i in range(4)], axis=1).argmin()) for goal in goals}
    assert count == [0, 0] and taken in ({0, 1}, {2, 3})
    # who holds corner 0 takes corner 1 instead of the nearer corner 2, unless three particles lie there
    holder[0] = 1
    tips = [above(x, 2), x[0]]
    goals, _ = taken_next(x, tips, holder, edge_costs=edge_costs)
    assert np.linalg.norm(goals[0] - above(x, 1)) < 1e-6
    x[[100, 120, 140]] = x[MESH.corners[1]] + (0.0, 0.0, 0.001)
    goals, _ = taken_next(x, tips, holder, edge_costs=edge_costs)
    assert np.linalg.norm(goals[0] - above(x, 2)) < 1e-6

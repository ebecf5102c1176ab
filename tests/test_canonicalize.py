"""ClothCanonicalize-v0: its evaluation of shirts that lie in the pose or elsewhere, and how far its expert turns an edge."""

import gymnasium as gym
import numpy as np
import pytest
from test_flatten_shirt import REST, SHIRT, TRIANGLES, evaluated, turned

from clothgym.envs.flatten_expert import _aim, _turned
from clothgym.envs.fold_shirt import garment_named

ID = "clothgym:ClothCanonicalize-v0"
CELL = 0.004


def inside(x):
    """Which points of a square grid around the origin, CELL apart, lie below a shirt: half planes of its triangles."""
    axis = np.arange(-0.6, 0.6, CELL) + CELL / 2
    points, found = np.stack(np.meshgrid(axis, axis), axis=-1), np.zeros((len(axis), len(axis)), bool)
    for triangle in x[TRIANGLES][:, :, :2]:
        sides = [np.cross(np.append(b - a, 0), np.dstack([points - a, 0 * points[..., :1]]))[..., 2]
                 for a, b in zip(triangle, np.roll(triangle, -1, axis=0))]  # fmt: skip
        found |= np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
    return found


def test_a_shirt_in_the_canonical_pose_is_a_success():
    info = evaluated(turned(REST, 0.0), env_id=ID)
    assert info["is_success"] and info["normalized_performance"] == 1 and info["face_up"] == pytest.approx(1, abs=0.02)
    assert info["coverage"] == pytest.approx(1, abs=0.01) and info["overlap"] == pytest.approx(1, abs=0.02)
    assert info["peer/funnels"] < 0.01


@pytest.mark.parametrize("name", ["tshirt", "shorts", "trousers"])
def test_a_garment_is_in_the_canonical_pose_one_way_up_and_not_turned_by_half_a_circle(name):
    rest = garment_named(name).mesh.rest_positions
    for yaw, success in ((0.0, True), (np.pi, False)):
        info = evaluated(turned(rest, yaw), env_id=ID, garment=name)
        assert info["coverage"] > 0.8 and info["face_up"] > 0.9 and info["is_success"] == success


def test_a_towel_has_no_canonical_pose():
    with pytest.raises(ValueError, match="garment='towel': must be 'tshirt' or 'shorts' or 'trousers'"):
        gym.make(ID, garment="towel")


@pytest.mark.parametrize(("yaw", "shift", "over"), [(0.0, (0.03, 0.0), False), (0.5, (0.0, 0.1), False), (0.0, (0.0, 0.0), True)])
def test_the_coverage_is_that_of_the_outline_and_the_front_has_to_be_up(yaw, shift, over):
    x = turned(REST, yaw, over) + (*shift, 0)
    here, there = inside(x), inside(REST)
    share, overlap = (here & there).sum() / there.sum(), (here & there).sum() / (here | there).sum()
    info = evaluated(x, env_id=ID)
    assert info["coverage"] == pytest.approx(share, abs=0.015) and info["overlap"] == pytest.approx(overlap, abs=0.02)
    assert info["is_success"] == (share > 0.8 and not over)
    assert info["face_up"] == pytest.approx(0 if over else 1, abs=0.02)


def test_the_expert_turns_an_edge_by_the_angle_that_is_left_to_where_it_should_lie():
    task = gym.make(ID).unwrapped.task
    # the line of the sleeves, its right end in the first gripper, lies toward +y: a quarter turn to -x is left
    aim = _aim(task, 0, np.array([3, 2]), 2, np.array([0.0, 1.0, 0.0]))
    points = {name: REST[particle] for name, particle in SHIRT.key_points.items()}
    assert aim.angle == pytest.approx(np.pi / 2)
    assert _turned(np.array([0.0, 1.0, 0.0]), aim.angle) == pytest.approx([-1, 0, 0])
    assert aim.near == pytest.approx([0, points["sleeve_top_left"][1], 0], abs=1e-6)
    assert aim.far == pytest.approx([0, points["waist_left"][1], 0], abs=1e-6)
    # a larger shirt lies farther out
    large = gym.make(ID, randomize={"size": [1.25, 1.25]}).unwrapped
    large.reset(seed=1)
    assert _aim(large.task, 0, np.array([3, 2]), 2, np.array([0.0, 1.0, 0.0])).near == pytest.approx(1.25 * aim.near)
    square = gym.make("clothgym:ClothFlatten-v0").unwrapped.task
    assert _aim(square, 0, np.array([3, 2]), 2, np.array([0.0, 1.0, 0.0])) is None

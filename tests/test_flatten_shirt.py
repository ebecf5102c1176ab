"""ClothFlattenShirt-v0 and -Hard-v0: starts, evaluation of shirts made here, and edges between the points that the expert takes."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs import garment_scores
from clothgym.envs.flatten_shirt import SHIRT, facing_up
from clothgym.envs.fold_shirt import HARD
from clothgym.envs.rumpled import CRUMPLED_SHIRTS, stored
from clothgym.geometry.intersections import find_intersections

ID = "clothgym:ClothFlattenShirt-v0"
REST, TRIANGLES = SHIRT.mesh.rest_positions, SHIRT.mesh.triangles
AREA = garment_scores.flat_area(SHIRT)


def turned(x, yaw, over=False):
    """Turned about z, and before that turned over about y, and put on the floor [m]."""
    x = x * (-1, 1, -1) if over else x
    c, s = np.cos(yaw), np.sin(yaw)
    x = x @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return x - (0, 0, x[:, 2].min() - 0.003)


def evaluated(x=None, seed=3, steps=25, env_id=ID):
    """Info of the last step of an episode, after so many steps from this shirt, or from the start."""
    env = gym.make(env_id).unwrapped
    env.reset(seed=seed)
    task, own = env.task, env.task.episode[0]
    if x is not None:
        task.simulation.reset(positions=x)
    own["settling_since"], own["step"] = task.acting_steps, task.acting_steps + task.settling_steps - steps
    for _ in range(steps):
        *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated
    return info


@pytest.mark.parametrize("over", [False, True])
def test_a_flat_shirt_is_a_success_whichever_side_is_up(over):
    x = turned(REST, 0.0 if over else 0.7, over) + (0.1, -0.05, 0)
    info = evaluated(x)
    assert info["is_success"] and info["coverage"] == pytest.approx(1, abs=0.01) and info["normalized_performance"] == 1
    assert info["face_up"] == pytest.approx(0 if over else 1, abs=0.02)
    assert info["softgym_coverage"] == pytest.approx(1, abs=0.15)
    # the shape is the goal's, mirrored where the back is up; the pose is away by the shift, or more where it is turned
    root, shift = np.sqrt(AREA), np.hypot(0.1, 0.05)
    assert info["peer/funnels_shape"] < 0.01
    pose = (info["peer/funnels"] - 0.65 * info["peer/funnels_shape"]) / 0.35 * root
    assert pose == pytest.approx(shift, abs=0.005) if over else pose > shift + 0.05


def test_a_crumpled_shirt_at_the_end_is_no_success():
    info = evaluated()
    assert not info["is_success"] and info["normalized_performance"] < 0.1 and info["coverage"] < 0.6
    assert info["peer/funnels_shape"] > 0.1 and 0 < info["face_up"] < 1


def test_the_share_that_looks_up_is_that_of_the_turned_area():
    a, b, c = (REST[TRIANGLES[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * SHIRT.front
    right = REST[TRIANGLES].mean(axis=1)[:, 0] > 0
    # the right half folded over the left one looks down: but for triangles across the middle that is half of the panel
    folded = garment_scores.fold_over(REST, (0, 0), (1, 0), 0.003)
    found = facing_up(np.ascontiguousarray(folded.T), TRIANGLES, area / area.sum())
    assert found == pytest.approx(area[~right].sum() / area.sum(), abs=1e-9)
    assert found == pytest.approx(0.5, abs=0.05)


def test_starts_are_crumpled_shirts_free_of_intersections():
    sheets = stored(CRUMPLED_SHIRTS)
    assert sheets.shape == (CRUMPLED_SHIRTS.kept, len(REST), 3) and not len(find_intersections(TRIANGLES, sheets))
    covered = [garment_scores.coverage(x, TRIANGLES, AREA) for x in sheets]
    assert min(covered) > 0.2 and max(covered) < 0.55
    ends, length, *_ = SHIRT.mesh.springs
    stretch = np.linalg.norm(sheets[:, ends[:, 0]] - sheets[:, ends[:, 1]], axis=2) / length
    assert stretch.max() < 1.15 and np.all(sheets[:, :, 2].min(axis=1) > 0)


def test_a_mirrored_shirt_is_a_shirt_and_not_inside_out():
    task = gym.make(ID).unwrapped.task
    # the shirt at rest is its own mirror image, with the front up
    assert task.mirrored(REST) == pytest.approx(REST, abs=1e-12)
    x = stored(CRUMPLED_SHIRTS)[0]
    assert not len(find_intersections(TRIANGLES, task.mirrored(x)[None]))
    assert task.mirrored(x)[SHIRT.key_points["waist_left"]] == pytest.approx(x[SHIRT.key_points["waist_right"]] * (-1, 1, 1))


def test_edges_between_corners_are_the_hem_the_sides_and_the_line_of_the_sleeves():
    task = gym.make(ID).unwrapped.task
    hem, right, sleeves, left = task.across()
    points = {name: REST[particle] for name, particle in SHIRT.key_points.items()}
    tall = points["sleeve_top_left"][1] - points["waist_left"][1]
    wide = (np.ptp([points["waist_left"][0], points["waist_right"][0]]) + np.ptp(REST[:, 0])) / 2
    assert (hem, sleeves) == pytest.approx((tall, tall), abs=1e-6) and (left, right) == pytest.approx((wide, wide), abs=1e-6)
    corners = ["waist_left", "waist_right", "sleeve_top_left", "sleeve_top_right"]
    assert task.corners.tolist() == [SHIRT.key_points[name] for name in corners]


@pytest.mark.parametrize("env_id", ["clothgym:ClothFlattenShirt-Hard-v0", "clothgym:ClothCanonicalize-Hard-v0"])
def test_a_flat_shirt_of_the_drawn_size_is_a_success_of_the_harder_tasks(env_id):
    env = gym.make_vec(env_id, num_envs=40).unwrapped
    _, info = env.reset(seed=3)
    for name, (low, high) in HARD.items():
        drawn = info[f"randomization/{name}"]
        assert drawn.min() >= low and drawn.max() <= high and np.ptp(drawn) > 0.8 * (high - low), name
    size = info["randomization/size"][0]
    flat = evaluated(turned(REST * size, 0.0), env_id=env_id)
    assert flat["randomization/size"] == size != 1
    assert flat["is_success"] and flat["coverage"] == pytest.approx(1, abs=0.01)
    assert flat["peer/funnels"] < 0.01

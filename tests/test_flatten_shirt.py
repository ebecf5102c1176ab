"""ClothFlattenShirt-v0 and -Hard-v0: starts, evaluation of shirts made here, and edges between the points that the expert takes."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs import garment_scores
from clothgym.envs.flatten_shirt import facing_up
from clothgym.envs.fold_shirt import HARD, TAKEN, garment_named
from clothgym.envs.rumpled import GARMENTS, stored
from clothgym.envs.taking import EDGES
from clothgym.geometry.intersections import find_intersections

ID = "clothgym:ClothFlattenShirt-v0"
SHIRT = garment_named("tshirt")
REST, TRIANGLES = SHIRT.mesh.rest_positions, SHIRT.mesh.triangles
AREA = garment_scores.flat_area(SHIRT)
# shares of the flat area that the stored starts may cover: least and most
COVERED = {"tshirt": (0.2, 0.55), "shorts": (0.2, 0.55), "trousers": (0.2, 0.75), "towel": (0.2, 0.55)}


def turned(x, yaw, over=False):
    """Turned about z, and before that turned over about y, and put on the floor [m]."""
    x = x * (-1, 1, -1) if over else x
    c, s = np.cos(yaw), np.sin(yaw)
    x = x @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return x - (0, 0, x[:, 2].min() - 0.003)


def evaluated(x=None, seed=3, steps=25, env_id=ID, **kwargs):
    """Info of the last step of an episode, after so many steps from this shirt, or from the start."""
    env = gym.make(env_id, **kwargs).unwrapped
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


@pytest.mark.parametrize("name", GARMENTS)
def test_starts_are_crumpled_garments_free_of_intersections(name):
    sheets, garment = stored(GARMENTS[name]), garment_named(name)
    mesh = garment.mesh
    assert sheets.shape == (GARMENTS[name].kept, mesh.num_particles, 3) and not len(find_intersections(mesh.triangles, sheets))
    covered = [garment_scores.coverage(x, mesh.triangles, garment_scores.flat_area(garment)) for x in sheets]
    assert min(covered) > COVERED[name][0] and max(covered) < COVERED[name][1]
    ends, length, *_ = mesh.springs
    stretch = np.linalg.norm(sheets[:, ends[:, 0]] - sheets[:, ends[:, 1]], axis=2) / length
    assert stretch.max() < (1.2 if name == "trousers" else 1.15) and np.all(sheets[:, :, 2].min(axis=1) > 0)


@pytest.mark.parametrize("name", GARMENTS)
def test_a_mirrored_garment_is_one_that_is_not_inside_out(name):
    task, garment = gym.make(ID, garment=name).unwrapped.task, garment_named(name)
    # at rest it is its own mirror image, with the front up
    assert task.mirrored(garment.mesh.rest_positions) == pytest.approx(garment.mesh.rest_positions, abs=1e-12)
    x, points = stored(GARMENTS[name])[0], garment.key_points
    assert not len(find_intersections(garment.mesh.triangles, task.mirrored(x)[None]))
    end = TAKEN[name][1]
    assert task.mirrored(x)[points[f"{end}_left"]] == pytest.approx(x[points[f"{end}_right"]] * (-1, 1, 1))


@pytest.mark.parametrize("name", [name for name in GARMENTS if name != "tshirt"])
def test_another_flat_garment_is_a_success_too(name):
    garment = garment_named(name)
    info = evaluated(turned(garment.mesh.rest_positions, 0.0), garment=name)
    assert info["is_success"] and info["coverage"] == pytest.approx(1, abs=0.01) and info["face_up"] == pytest.approx(1, abs=0.02)
    assert info["softgym_coverage"] == pytest.approx(1, abs=0.15) and info["peer/funnels_shape"] < 0.01
    crumpled = evaluated(garment=name)
    assert not crumpled["is_success"] and crumpled["coverage"] < COVERED[name][1] and crumpled["peer/funnels_shape"] > 0.1


def test_edges_between_corners_are_the_hem_the_sides_and_the_line_of_the_sleeves():
    task = gym.make(ID).unwrapped.task
    hem, right, sleeves, left = task.across()
    points = {name: REST[particle] for name, particle in SHIRT.key_points.items()}
    tall = points["sleeve_top_left"][1] - points["waist_left"][1]
    wide = (np.ptp([points["waist_left"][0], points["waist_right"][0]]) + np.ptp(REST[:, 0])) / 2
    assert (hem, sleeves) == pytest.approx((tall, tall), abs=1e-6) and (left, right) == pytest.approx((wide, wide), abs=1e-6)
    corners = ["waist_left", "waist_right", "sleeve_top_left", "sleeve_top_right"]
    assert task.corners.tolist() == [SHIRT.key_points[name] for name in corners]


def test_trousers_are_taken_by_the_waist_shorts_by_the_legs_too_and_a_towel_by_any_edge():
    for name, taken in (("trousers", {(2, 3)}), ("shorts", {(0, 1), (2, 3)}), ("towel", {(0, 1), (2, 3), (1, 3), (0, 2)})):
        task = gym.make(ID, garment=name).unwrapped.task
        free = {tuple(sorted(edge)) for edge in EDGES.tolist() if task.edge_costs()[tuple(edge)] == 0}
        assert free == taken
        points = task.garment.key_points
        assert task.corners.tolist() == [points[f"{end}_{side}"] for end in TAKEN[name][::-1] for side in ("left", "right")]


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

"""ClothFoldShirt-v0: its ideal folds, the measures of others, and what its expert does to garments."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs import garment_scores
from clothgym.envs.fold_shirt import HARD, SIZES, SPACING, compared, folded, garment_named
from clothgym.garments import random_garment
from clothgym.geometry.intersections import find_intersections

ID = "clothgym:ClothFoldShirt-v0"
HELD_OUT = 1_000_000
ENOUGH_FOR_FOLDNET = 0.001  # [m^2], of its source


def turned(x, angle=0.7, shift=(0.3, -0.2, 0.0)):
    c, s = np.cos(angle), np.sin(angle)
    return x @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + shift


def columns(x):
    return np.ascontiguousarray(x.T, np.float32)


def foldnet(x, goal):
    """FoldNet's error as its source has it: the least over rotations about z, here 4,000 of them."""
    one, two = x - x.mean(axis=0), goal - goal.mean(axis=0)
    return min(np.mean((turned(one, angle, (0, 0, 0)) - two) ** 2) for angle in np.linspace(0, 2 * np.pi, 4000))


@pytest.mark.parametrize("name", SIZES)
def test_ideals_are_the_folds_over_the_middle_line_either_way(name):
    garment = garment_named(name)
    rest, triangles = garment.mesh.rest_positions, garment.mesh.triangles
    goals = folded(garment)
    for goal, away in zip(goals, (-1, 1)):
        over = garment_scores.fold_over(rest, (0, 0), (away, 0), 0.003)
        assert np.abs(goal[:, :2] - over[:, :2]).max() < 1e-9
        assert (away * goal[:, 0]).max() < 1e-9
    # in layers of which none is thicker than the cloth keeps to itself, 4 mm, those of the folded half on top: two of a towel, four
    # of what has two panels
    left, right = goals[0][rest[:, 0] < 0, 2], goals[0][rest[:, 0] > 0, 2]
    bounds = (0.004, 0.0, 0.004) if name == "towel" else (0.008, 0.004, 0.012)
    assert (left.min(), right.max(), left.max()) == pytest.approx(bounds, abs=5e-4)
    # half as wide, and so the area that it covers is half of the flat garment's
    area = garment_scores.flat_area(garment)
    assert garment_scores.coverage(goals[0], triangles, area) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("name", SIZES)
def test_measures_are_those_of_the_sources_in_numpy(name):
    garment, rng = garment_named(name), np.random.default_rng(3)
    goals = folded(garment)
    rest = garment.mesh.rest_positions
    for way, x in ((0, rest), (0, goals[0]), (1, goals[1] + rng.normal(scale=0.02, size=rest.shape))):
        moved = turned(x).astype(np.float32).astype(float)
        distance, square = compared(columns(moved), goals)
        best = min(garment_scores.vertex_distance(moved, goal, 1.0) for goal in goals)
        assert distance == pytest.approx(best, abs=1e-6)
        assert square == pytest.approx(min(foldnet(moved, goal) for goal in goals), rel=1e-3, abs=1e-7)
        assert best == pytest.approx(garment_scores.vertex_distance(moved, goals[way], 1.0)) or x is rest


@pytest.mark.parametrize("name", SIZES)
def test_the_ideal_meets_each_criterion_and_the_flat_garment_none(name):
    # triangles across the crease of an ideal fold pass through each other, which strict contact refuses
    env = gym.make(ID, garment=name, self_collision=False).unwrapped
    task, garment = env.task, garment_named(name)
    env.reset(seed=3)
    task.simulation.reset(positions=turned(folded(garment)[1]) + (0, 0, 0.004))
    own = task.episode[0]
    own["settling_since"], own["step"] = task.acting_steps, task.acting_steps + task.settling_steps - 1
    *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated and info["fold_error_mm"] < 3 and info["fold_error_max"] < 0.02 and info["height"] < 0.05
    assert info["peer/foldnet"] < ENOUGH_FOR_FOLDNET / 10 and info["vertex_distance"] < 0.02 and info["overlap"] > 0.9
    assert compared(columns(garment.mesh.rest_positions), folded(garment))[1] > ENOUGH_FOR_FOLDNET


def episodes(count, still=False, **kwargs):
    """Batch and last infos of so many held-out episodes, of the expert, or of nobody."""
    env = gym.make_vec(ID, num_envs=count, autoreset_mode="Disabled", **kwargs)
    env.reset(seed=HELD_OUT)
    terminated = np.zeros(count, bool)
    while not terminated.all():
        _, _, terminated, _, info = env.step(np.zeros(env.action_space.shape) if still else env.expert_actions())
    return env, info


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_the_expert_folds_without_an_intersection(name):
    env, info = episodes(4, garment=name)
    simulation = env.task.simulation
    assert info["is_success"].all() and info["fold_error_mm"].max() < (35 if name == "towel" else 30) and not info["failure"].any()
    assert info["peer/foldnet"].max() < ENOUGH_FOR_FOLDNET
    # by the count that shares nothing with contact
    assert not len(find_intersections(env.task.physics.mesh.triangles, simulation.positions.astype(np.float64)))
    x = simulation.positions[0].astype(float)
    area = env.task.physics.mesh.area.sum() / (1 if name == "towel" else 2)
    distance = min(garment_scores.vertex_distance(x, goal, area) for goal in folded(garment_named(name)))
    assert info["vertex_distance"][0] == pytest.approx(distance, abs=1e-5)


def test_doing_nothing_scores_nothing():
    _, info = episodes(2, still=True)
    assert not info["is_success"].any() and info["normalized_performance"].max() < 0.02
    assert info["peer/foldnet"].min() > ENOUGH_FOR_FOLDNET and np.all(info["first_success"] == -1)


def test_key_points_of_the_garment_are_observed():
    env = gym.make(ID, garment="shorts").unwrapped
    observation, _ = env.reset(seed=4)
    task, points = env.task, garment_named("shorts").key_points
    x = task.simulation.positions[0].astype(float) - task.episode["origin"][0]
    seen = observation[env.observation_slices["keypoints"]].reshape(-1, 3)
    assert seen == pytest.approx(x[list(points.values())] / task.physics.side, abs=1e-5)


def test_a_garment_without_a_fold_is_refused():
    with pytest.raises(ValueError, match="garment='skirt': must be 'tshirt' or 'shorts' or 'trousers' or 'towel'"):
        gym.make(ID, garment="skirt")


@pytest.mark.parametrize("env_id", [ID, "clothgym:ClothFlattenShirt-v0"])
@pytest.mark.parametrize("sheet", [{"rows": 15}, {"side": 0.6}])
def test_a_towel_has_one_mesh(env_id, sheet):
    with pytest.raises(ValueError, match="(rows=15|side=0.6): a garment has one mesh; leave them out"):
        gym.make(env_id, garment="towel", **sheet)


@pytest.mark.slow
def test_the_expert_folds_shirts_of_other_sizes():
    for seed in (0, 3):
        _, info = episodes(2, sizes=dict(random_garment("tshirt", seed, SPACING).sizes))
        assert info["is_success"].all() and info["fold_error_mm"].max() < 30


def test_sizes_give_the_mesh_and_the_key_points():
    """Those of the random garment with these sizes; and a longer shirt is longer."""
    chosen = random_garment("tshirt", 3, SPACING)
    env = gym.make(ID, sizes=dict(chosen.sizes)).unwrapped
    observation, _ = env.reset(seed=4)
    assert np.array_equal(env.task.physics.mesh.rest_positions, chosen.mesh.rest_positions)
    assert env.task.below == [chosen.key_points["sleeve_top_left"], chosen.key_points["waist_left"]]
    x = env.task.simulation.positions[0].astype(float) - env.task.episode["origin"][0]
    seen = observation[env.observation_slices["keypoints"]].reshape(-1, 3)
    assert seen == pytest.approx(x[list(chosen.key_points.values())] / env.task.physics.side, abs=1e-5)
    short, long = (np.ptp(garment_named("tshirt", {"length": value}).mesh.rest_positions[:, 1]) for value in (0.62, 0.75))
    assert long - short == pytest.approx(0.13, abs=1e-6)


def test_sizes_that_no_garment_has_are_refused():
    with pytest.raises(ValueError, match="no size of tshirt 'lenght'; did you mean 'length'"):
        gym.make(ID, sizes={"lenght": 0.7})
    with pytest.raises(ValueError, match="sizes=0.7: must be a dict"):
        gym.make(ID, sizes=0.7)
    for value in (3.0, [0.7], "a"):
        with pytest.raises(ValueError, match="sizes: length.*must be"):
            gym.make(ID, sizes={"length": value})


def test_the_harder_task_draws_size_and_fabric_and_turns_the_shirt_by_any_angle():
    env = gym.make_vec("clothgym:ClothFoldShirt-Hard-v0", num_envs=40).unwrapped
    _, info = env.reset(seed=1)
    for name, (low, high) in HARD.items():
        drawn = info[f"randomization/{name}"]
        assert drawn.min() >= low and drawn.max() <= high and np.ptp(drawn) > 0.8 * (high - low), name
    # cuff to cuff, as it lies
    ends = env.task.simulation.positions[:, [env.task.garment.key_points[f"sleeve_top_{side}"] for side in ("left", "right")]]
    across = (ends[:, 1] - ends[:, 0])[:, :2]
    rest = np.diff(
        env.task.physics.mesh.rest_positions[
            [env.task.garment.key_points["sleeve_top_left"], env.task.garment.key_points["sleeve_top_right"]]
        ],
        axis=0,
    )
    assert np.linalg.norm(across, axis=1) == pytest.approx(info["randomization/size"] * np.linalg.norm(rest), rel=1e-3)
    angles = np.arctan2(across[:, 1], across[:, 0])
    assert np.histogram(angles, bins=4, range=(-np.pi, np.pi))[0].min() >= 4
    # it is a default: without it the shirt is that of the easier task
    plain = gym.make_vec("clothgym:ClothFoldShirt-Hard-v0", num_envs=1, randomize={}).unwrapped
    assert not [name for name in plain.reset(seed=1)[1] if name.startswith("randomization")]
    assert plain.task.simulation.size.tolist() == [1.0]

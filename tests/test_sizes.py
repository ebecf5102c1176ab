"""Sheets of another size than their mesh: beside a mesh that was made in that size, and in tasks that draw it."""

import gymnasium as gym
import numpy as np
import pytest

import clothgym  # noqa: F401
from clothgym import Material, Plane, Simulation, grid
from clothgym.envs.fold import ideals
from clothgym.envs.fold_shirt import folded
from clothgym.envs.gripper_task import UNEVEN
from clothgym.envs.targets import ON_FLOOR
from clothgym.triangles import triangle_mesh

SIZE = 1.2
SQUARE = grid(6, 7, 0.4, 0.35)
FABRIC = Material.preset("cotton")
METHODS = {"explicit_euler": 300, "semi_implicit_euler": 60, "verlet": 60, "rk4": 60, "implicit_euler": 4, "xpbd": 80, "pbd": 6}


def made(kind, size):
    """The mesh of a kind, made in a size."""
    width, height = (size * side for side in SQUARE.size)
    square = grid(*SQUARE.shape, width, height)
    return square if kind == "grid" else triangle_mesh(square.rest_positions, square.triangles)


def both(kind, num_envs=1, **options):
    """A simulation of a mesh with a size, and one of a mesh that was made in it, hung up by a corner in the wind."""
    common = {"material": FABRIC, "num_envs": num_envs, "anchors": [0], "wind": (1.0, 0.5, 0.2), "dtype": "float64", **options}
    return Simulation(made(kind, 1.0), size=SIZE, **common), Simulation(made(kind, SIZE), **common)


def assert_alike(sized, large):
    """After a fall of some centimeters; rounding aside."""
    assert np.allclose(sized.positions, large.positions, rtol=0, atol=1e-12)
    for simulation in (sized, large):
        simulation.step(6)
    assert np.abs(large.positions - large.mesh.rest_positions).max() > 0.01
    assert np.allclose(sized.positions, large.positions, rtol=0, atol=1e-9)
    assert np.allclose(sized.strain(), large.strain(), rtol=0, atol=1e-7)
    assert np.allclose(sized.pulls(), large.pulls(), rtol=1e-6, atol=1e-9)
    for one, other in zip(sized.energy(), large.energy()):
        assert np.allclose(one, other, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", METHODS)
def test_a_mesh_with_a_size_moves_as_one_that_was_made_in_it(name):
    sized, large = both("grid", integrator=name, substeps=METHODS[name], bending="hinge")
    assert_alike(sized, large)


@pytest.mark.parametrize("bending", ["springs", "quadratic", "hinge"])
@pytest.mark.parametrize(("kind", "num_envs"), [("grid", 1), ("triangles", 1), ("triangles", 17)])
def test_so_it_does_with_any_model_of_bending_and_any_layout(kind, num_envs, bending):
    sized, large = both(kind, num_envs, substeps=60, bending=bending, strain_limit=0.02 if bending == "hinge" else None)
    # the bound of their substeps, too
    assert sized.largest_substep()[0] == pytest.approx(large.largest_substep()[0], rel=1e-6)
    assert_alike(sized, large)


def test_stiff_hinges_need_the_substeps_of_the_sheet_that_was_made_in_the_size():
    stiff = Material.preset("cotton", bend_rigidity=1.0)
    sized, large = both("triangles", material=stiff, substeps="auto", bending="hinge")
    soft, _ = both("triangles", substeps="auto", bending="hinge")
    assert sized.substeps == large.substeps > 1.5 * soft.substeps


@pytest.mark.parametrize("kind", ["grid", "triangles"])
def test_a_mesh_made_in_a_size_is_the_mesh_scaled(kind):
    scaled, large = made(kind, 1.0).scaled(SIZE), made(kind, SIZE)
    for one, other in [*zip(scaled.springs, large.springs), *zip(scaled.hinges, large.hinges)]:
        assert np.allclose(one, other, rtol=1e-9, atol=1e-12)
    assert np.allclose(scaled.area, large.area) and scaled.size == pytest.approx(large.size)
    assert np.allclose(scaled.rest_positions, large.rest_positions)


def test_a_storm_stops_a_large_sheet_relative_to_the_air_as_it_stops_one_that_was_made_large():
    """The bound of the air's force, which follows from the mass and the area at rest."""
    sized, large = both("triangles", substeps=60, wind=(500.0, 0.0, 300.0), on_divergence="ignore")
    for simulation in (sized, large):
        simulation.step()
    assert np.allclose(sized.velocities, large.velocities, rtol=0, atol=1e-6 * np.abs(large.velocities).max())


def test_several_passes_of_xpbd_know_the_size():
    assert_alike(*both("triangles", integrator={"name": "xpbd", "iterations": 3}, substeps=80))


def test_sizes_differ_within_a_batch_and_come_back_with_a_state():
    sizes = [0.8, 1.0, 1.25]
    many = Simulation(SQUARE, FABRIC, num_envs=3, anchors=[0], substeps=60)
    many.set_parameters(size=sizes)
    many.reset()
    width = np.ptp(many.positions[..., 0], axis=1)
    assert width == pytest.approx(np.array(sizes) * SQUARE.size[0], rel=1e-6)
    mass = (1 / many.get_state().free_inverse_mass).sum(axis=1)
    assert mass == pytest.approx(FABRIC.density * SQUARE.area.sum() * np.square(sizes), rel=1e-5)
    many.step(3)
    state = many.get_state()
    many.step(3)
    # each as alone, and as from the state
    for env, size in enumerate(sizes):
        alone = Simulation(SQUARE, FABRIC, anchors=[0], substeps=60, size=size)
        alone.step(6)
        assert np.array_equal(alone.positions[0], many.positions[env])
    fresh = Simulation(SQUARE, FABRIC, num_envs=3, anchors=[0], substeps=60)
    fresh.set_state(state)
    fresh.step(3)
    assert np.array_equal(fresh.positions, many.positions) and fresh.size == pytest.approx(sizes)


@pytest.mark.parametrize(
    ("size", "method", "said"),
    [(0.7, "xpbd", "size=0.7: must be from 0.8 to 1.25"), (np.nan, "xpbd", "size"), (1.1, "projective_dynamics", "make a mesh")],
)
def test_sizes_that_cannot_be_are_refused(size, method, said):
    with pytest.raises(ValueError, match=said):
        Simulation(SQUARE, FABRIC, integrator=method, size=size)
    simulation = Simulation(SQUARE, FABRIC, integrator=method)
    with pytest.raises(ValueError, match=said):
        simulation.set_parameters(size=size)
    assert simulation.size.tolist() == [1.0]


def test_a_size_that_is_refused_leaves_the_fabric_as_it_is():
    simulation = Simulation(SQUARE, FABRIC)
    with pytest.raises(ValueError, match="size=3"):
        simulation.set_parameters(density=0.3, size=3.0)
    assert simulation.parameters[0, 0] == FABRIC.density


def test_sheets_of_other_sizes_come_to_rest_on_the_floor_and_do_not_pass_through_themselves():
    """Folded over, with strict contact and a floor."""
    mesh = grid(9, 9, 0.4, 0.4)
    for size in (0.8, 1.25):
        floor = Plane(friction=0.5, thickness=0.005)
        simulation = Simulation(mesh, FABRIC, size=size, colliders=[floor], self_collision="strict")
        x = size * mesh.rest_positions
        start = np.stack([np.abs(x[:, 0]), x[:, 1], 0.02 + np.where(x[:, 0] < 0, 0.03, 0) + 0.03 * (x[:, 0] == 0) / 2], axis=1)
        simulation.reset(positions=start)
        simulation.step(60)
        assert simulation.intersections().tolist() == [0]
        assert simulation.positions[..., 2].min() > 0.004 and simulation.penetration()[0] == 0
        assert np.abs(simulation.strain()).max() < 0.1


# --- tasks ----------------------------------------------------------------------------------------------------------------------


def batch(env_id="ClothFold-v0", num_envs=3, sizes=(0.8, 1.25), **kwargs):
    options = {"num_envs": num_envs, "autoreset_mode": "Disabled", "physics": "fast", **kwargs}
    return gym.make_vec(f"clothgym:{env_id}", randomize={"size": list(sizes)}, **options).unwrapped


def test_episodes_draw_their_sizes_alike_in_any_batch_and_from_a_state():
    many, one = batch(), batch(num_envs=1)
    _, told = many.reset(seed=[3, 4, 5])
    drawn = told["randomization/size"]
    assert np.ptp(drawn) > 0.05 and ((drawn >= 0.8) & (drawn <= 1.25)).all()
    side = np.linalg.norm(np.diff(many.task.simulation.positions[:, many.task.physics.mesh.corners[:2]], axis=1)[:, 0], axis=1)
    assert side == pytest.approx(drawn * many.task.physics.side, rel=1e-3)
    for env, seed in enumerate((3, 4, 5)):
        _, alone = one.reset(seed=seed)
        assert alone["randomization/size"][0] == drawn[env]
        assert np.array_equal(one.task.simulation.positions[0], many.task.simulation.positions[env])
    # a state has them, and a new episode another
    state = many.get_state()
    many.reset()
    assert not np.array_equal(many.task.sizes(), drawn)
    many.set_state(state)
    assert np.array_equal(many.task.sizes(), drawn) and many.task.simulation.size == pytest.approx(drawn)


@pytest.mark.parametrize("size", [0.8, 1.25])
def test_a_fold_is_measured_by_the_size_of_its_sheet(size):
    """The ideal fold of a sheet of this size has no error, and the flat one that of any size."""
    env = batch(num_envs=1, sizes=(size, size))
    _, flat = env.reset(seed=1)
    usual = gym.make_vec("clothgym:ClothFold-v0", num_envs=1, physics="fast")
    assert flat["fold_error"][0] == pytest.approx(usual.reset(seed=1)[1]["fold_error"][0], rel=0.02)
    state = env.get_state()
    points = env.task.physics.mesh.rest_positions[:, :2]
    state.simulation.positions[0, :, :2] = size * ideals("half", points)[0]
    state.simulation.positions[0, :, 2] = 0.005 + 0.005 * (points[:, 1] > 0)
    env.set_state(state)
    info = env.step(np.zeros((1, 8)))[4]
    assert info["fold_error"][0] < 0.01


@pytest.mark.parametrize("size", [0.8, 1.25])
def test_coverage_is_of_the_flat_sheet_of_that_size(size):
    env = batch("ClothFlatten-v0", num_envs=1, sizes=(size, size))
    env.reset(seed=1)
    state = env.get_state()
    # folded in half over the middle line: half of it is covered
    x = size * env.task.physics.mesh.rest_positions
    state.simulation.positions[0] = np.stack([np.abs(x[:, 0]), x[:, 1], 0.005 + 0.005 * (x[:, 0] > 0)], axis=1)
    state.simulation.velocities[...] = 0
    env.set_state(state)
    env.step(np.ones((1, 8)))
    assert env.task.episode["coverage"][0] == pytest.approx(0.5, abs=0.02)


def test_crumpled_sheets_of_other_sizes_begin_on_the_floor():
    env = batch("ClothFlatten-v0", num_envs=4)
    env.reset(seed=1)
    assert env.task.simulation.positions[..., 2].min(axis=1) == pytest.approx(ON_FLOOR, abs=UNEVEN)


def test_goals_of_a_fold_are_as_far_away_as_the_sheet_is_large():
    env = batch("ClothFoldGoal-v0", num_envs=8)
    env.reset(seed=1)
    own, corners = env.task.episode, env.task.simulation.positions[:, env.task.physics.mesh.corners]
    way = np.linalg.norm((own["goal"] - corners)[..., :2], axis=2).max(axis=1)
    assert np.ptp(env.task.sizes()) > 0.1 and way == pytest.approx(own["width"], rel=1e-4)


def test_the_strain_of_a_sheet_at_rest_is_zero_in_any_size():
    env = batch(num_envs=4)
    _, info = env.reset(seed=1)
    assert np.ptp(info["randomization/size"]) > 0.05 and np.abs(info["strain_max"]).max() < 1e-3


@pytest.mark.parametrize("env_id", ["ClothFold-v0", "ClothFoldGoal-v0", "ClothFoldShirt-v0"])
def test_experts_fold_sheets_of_other_sizes(env_id):
    env = batch(env_id, num_envs=4, physics="true")
    env.reset(seed=5)
    ends = []
    while not env.task.episode["over"].all():
        ends.append(env.step(env.task.expert())[4]["is_success"])
    assert np.any(ends, axis=0).sum() >= 3


@pytest.mark.parametrize("size", [0.8, 1.25])
def test_the_expert_flattens_sheets_of_other_sizes(size):
    env = batch("ClothFlatten-v0", num_envs=4, sizes=(size, size), physics="true")
    env.reset(seed=5)
    covered = np.zeros(4)
    while not env.task.episode["over"].all():
        covered = np.fmax(covered, env.step(env.task.expert())[4]["coverage"])
    assert (covered > 0.9).sum() >= 3


def test_a_fold_of_a_small_shirt_has_the_error_of_its_size_in_real_millimeters():
    env = batch("ClothFoldShirt-v0", num_envs=1, sizes=(0.8, 0.8), settling="at_once")
    env.reset(seed=1)
    assert env.task.episode["error"][0] == pytest.approx(env.task.rules["unfolded"][0], rel=0.01)
    state = env.get_state()
    state.simulation.positions[0] = 0.8 * folded(env.task.garment)[0] + (0, 0, 0.005)
    env.set_state(state)
    env.step(np.zeros((1, 8)))
    assert env.task.episode["error"][0] < 0.02
    # at the end in millimeters, of a shirt of 0.8 L
    info = {}
    while not env.task.episode["over"].all():
        info = env.step(np.zeros((1, 8)))[4]
    side = 0.8 * env.task.physics.side
    assert info["fold_error_mm"][0] == pytest.approx(1000 * side * info["fold_error"][0], rel=1e-6) and info["overlap"][0] > 0.8


def test_substeps_follow_from_the_smallest_sheet_of_the_range():
    usual, small = (batch(sizes=sizes, num_envs=1, physics="true").task.simulation for sizes in ((1, 1.25), (0.8, 1.25)))
    assert small.substeps == pytest.approx(usual.substeps / 0.8, rel=0.05)


def test_a_size_of_the_simulation_is_put_back_by_a_reset():
    env = gym.make_vec("clothgym:ClothFold-v0", num_envs=2, physics="fast").unwrapped
    env.reset(seed=1)
    env.task.simulation.set_parameters(size=[1.1, 0.9], warn=False)
    env.reset(seed=1)
    assert env.task.simulation.size.tolist() == [1.0, 1.0]


def test_a_reset_that_changes_fabric_and_size_is_refused_whole():
    """A rigidity that skip springs can have on a sheet of usual size, and not on a smaller one."""
    stiff = {"material": {"bend_rigidity": 1e-3}}
    batch(sizes=(1.0, 1.0), num_envs=1, bending="springs").reset(seed=2, options=stiff)
    env = batch(sizes=(0.8, 0.8), num_envs=1, bending="springs")
    env.reset(seed=1)
    before = env.get_state()
    with pytest.raises(ValueError, match="no springs on cells"):
        env.reset(seed=2, options=stiff)
    assert np.array_equal(env.get_state().simulation.positions, before.simulation.positions)
    with pytest.raises(ValueError, match="projective_dynamics"):
        batch(sizes=(1.0, 1.2), integrator="projective_dynamics")


def test_tasks_whose_targets_suit_one_sheet_refuse_to_draw_it():
    with pytest.raises(ValueError, match="no size in this task"):
        batch("ClothDrape-v0")
    with pytest.raises(ValueError, match="size=.*from 0.8 to 1.25"):
        batch(sizes=(0.5, 1.0))

"""Flattening: coverage on a grid of the world, starts, evaluation, expert, against numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import grid
from clothgym.envs.coverage import CELL, FINE_CELL, covered_area, softgym_area
from clothgym.envs.rumpled import CRUMPLED, CRUMPLED_LARGE, resampled, rumpled_sheets
from clothgym.envs.throws import Hands, Throw
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


@pytest.mark.parametrize(("at", "yaw"), [(0.0, 0.1), (0.25, 0.7), (-1 / 12, 2.5)])
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


def test_layers_count_once_and_hanging_cloth_counts_by_its_projection():
    mesh = grid(9, 9, 0.4, 0.4)
    upright = mesh.rest_positions[:, [0, 2, 1]]
    assert area(mesh, upright) == 0
    slope = mesh.rest_positions * (1, np.cos(0.8), 1)
    assert area(mesh, turned(slope, 0.3)) == pytest.approx(0.16 * np.cos(0.8), rel=5e-3)


def test_softgym_area_is_the_area_of_cells_near_particles():
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


@pytest.mark.slow
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


# --- potential, observation, accounts and judge, of sheets made here ----------------------------------------------------------


def start(seed=3):
    env = gym.make(ID).unwrapped
    env.reset(seed=seed)
    return env


def on_floor(mesh, at=None):
    """Flat, or folded over a crease with the layers apart [m]: it covers 1/2 + at of its area."""
    x = mesh.rest_positions if at is None else folded(mesh, at)
    over = np.zeros(len(x)) if at is None else np.clip((mesh.rest_positions[:, 0] - at * SIDE) / 0.04, 0, 1)
    return x + np.stack([0 * over, 0 * over, 0.003 + 0.012 * over], axis=1)


def put(env, x):
    """The next step, in which nothing moves, from this sheet."""
    env.task.simulation.reset(positions=x)
    return env.step(np.zeros(8))


@pytest.mark.parametrize(("at", "covered"), [(None, 1.0), (0.0, 0.5), (0.25, 0.75)])
def test_the_potential_is_coverage_plus_nearness_of_the_grippers(at, covered):
    env = start()
    observation, *_ = put(env, on_floor(env.task.physics.mesh, at))
    x, tips = env.task.simulation.positions[0].astype(float), env.task.simulation.grippers.positions[0].astype(float)
    near = [0.5 / (1 + (np.linalg.norm(x - tip, axis=1).min() / (0.15 * SIDE)) ** 2) for tip in tips]
    assert env.task.episode["potential"][0] == pytest.approx(0.9 * covered + 0.1 * np.mean(near), abs=0.015)
    assert observation[env.observation_slices["coverage"]] == pytest.approx(covered, abs=0.015)


def test_observations_include_tips_held_corners_and_heights():
    env = start()
    task, mesh = env.task, env.task.physics.mesh
    task.simulation.reset(positions=on_floor(mesh))
    corners = np.array(mesh.corners)
    tips = task.simulation.positions[:, corners[[1, 2]]].astype(float) + (0, 0, 0.01)
    task.simulation.grippers.place(tips, np.array([0]))
    task.episode["targets"][:] = tips
    close, up, down = (np.tile([0, 0, way, -1.0], 2) for way in (0, 0.5, -1))
    for action in [close] * 5 + [up] * 6 + [down] * 2:
        observation, *_ = env.step(action)
        if action is close:
            low = task.simulation.grippers.positions[0, :, 2].max()
    seen = {name: observation[where] for name, where in env.observation_slices.items()}
    x, tips = task.simulation.positions[0].astype(float), task.simulation.grippers.positions[0].astype(float)
    grippers = seen["grippers"].reshape(2, 5)
    assert grippers[:, :3] == pytest.approx(tips / SIDE, abs=1e-5) and grippers[:, 3:].tolist() == [[0, 1], [0, 1]]
    assert seen["ways"].reshape(2, 4, 3) == pytest.approx((x[corners] - tips[:, None]) * 10 / SIDE, abs=1e-4)
    assert seen["corners_held"].reshape(2, 4).tolist() == [[0, 1, 0, 0], [0, 0, 1, 0]]
    # a tenth of a meter up, and a third of it down again
    assert seen["raised"] * SIDE == pytest.approx([low + 0.1] * 2, abs=2e-3) and tips[:, 2].max() < low + 0.05
    # of the sheet's area: what is on its border stands for less
    inside = np.interp(np.arange(17), [0, 1, 15, 16], [0.5, 1, 1, 0.5])
    share = np.outer(inside, inside).ravel() / 16**2
    v = task.simulation.velocities[0].astype(float)
    assert seen["speed"].item() == pytest.approx(np.sqrt(share @ (v**2).sum(axis=1)), rel=1e-5)
    assert not seen["lifted"].any() and not seen["next"].any()
    held = 0.1 + 0.9 * seen["coverage"].item()
    assert task.episode["potential"][0] == pytest.approx(held, abs=1e-6)


def test_lifted_is_observed_from_its_threshold_height_on():
    env = start()
    task, corners = env.task, np.array(env.task.physics.mesh.corners)
    task.simulation.reset(positions=on_floor(task.physics.mesh))
    tips = task.simulation.positions[:, corners[:2]].astype(float) + (0, 0, 0.01)
    task.simulation.grippers.place(tips, np.array([0]))
    task.episode["targets"][:] = tips
    # one takes its corner and rises, and the other rises with nothing
    seen = []
    for step in range(40):
        rise = 0.8 * (step >= 5)
        observation, *_ = env.step([0, 0, rise, -1, 0, 0, rise, 1.0])
        lifted = observation[env.observation_slices["lifted"]].reshape(2, 2)
        assert not lifted[1].any()
        seen.append((task.simulation.grippers.positions[0, 0, 2] / SIDE, *lifted[0]))
    height, first, second = np.array(seen).T
    assert first.astype(bool).tolist() == (height > 0.9).tolist() and second.astype(bool).tolist() == (height > 1.17).tolist()
    assert first.sum() > second.sum() > 0


@pytest.mark.parametrize(("at", "taken"), [(None, False), (0.46, True), (0.42, True)])
def test_nothing_is_to_be_taken_from_a_sheet_that_covers_enough(at, taken):
    env = start()
    observation, *_ = put(env, on_floor(env.task.physics.mesh, at))
    covered = observation[env.observation_slices["coverage"]].item()
    assert (covered < 0.955) == taken
    assert observation[env.observation_slices["next"]].any() == taken


def test_best_and_first_success_are_kept_and_a_lost_success_stays_lost():
    env = start()
    mesh, begun = env.task.physics.mesh, env.task.infos()["coverage_start"][0]
    *_, info = put(env, on_floor(mesh, 0.42))  # 0.92 is not enough
    assert info["first_success"] == -1 and not info["success_held"]
    assert info["best"] == pytest.approx((0.92 - begun) / (1 - begun), abs=0.02)
    *_, info = put(env, on_floor(mesh))
    assert info["first_success"] == 2 and info["success_held"] and info["best"] == 1
    *_, info = put(env, on_floor(mesh, 0.0))
    assert info["first_success"] == 2 and not info["success_held"] and info["best"] == 1
    *_, info = put(env, on_floor(mesh))
    assert not info["success_held"]


@pytest.mark.parametrize(("at", "speed", "success"), [(None, 0.0, True), (None, 1.0, False), (0.42, 0.0, False)])
def test_success_asks_for_a_flat_sheet_at_rest(at, speed, success):
    env = start()
    task, own = env.task, env.task.episode[0]
    task.simulation.reset(positions=on_floor(task.physics.mesh, at))
    own["step"] = own["settling_since"] = 300
    for _ in range(39):
        env.step(np.zeros(8))
    state = env.get_state()
    state.simulation.velocities[0, :, 2] += speed
    env.set_state(state)
    *_, terminated, _, info = env.step(np.zeros(8))
    assert terminated and info["coverage"] == pytest.approx(1.0 if at is None else 0.9, abs=0.04)
    assert info["is_success"] == success


def test_starts_are_sheets_of_the_bank_mirrored_or_not_turned_and_moved():
    env = gym.make_vec(ID, num_envs=48, autoreset_mode="Disabled").unwrapped
    env.reset(seed=0)
    bank, x = rumpled_sheets(17, 17, SIDE, CRUMPLED), env.task.simulation.positions.astype(float)
    mirrored, yaws, shifts = [], [], []
    for one in x:
        # heights tell which sheet it is
        raised = one[:, 2] - bank[:, :, 2]
        own = np.abs(raised).max(axis=1).argmin()
        assert 0 < np.abs(raised[own]).max() < 1e-3 and raised[own].min() > -1e-6
        a, b = bank[own, :, :2], one[:, :2]
        fit = np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b, rcond=None)[0]
        turn = fit[:2].T
        mirrored.append(np.linalg.det(turn) < 0)
        yaws.append(np.arctan2(turn[1, 0], turn[0, 0]))
        shifts.append(fit[2])
        assert turn @ turn.T == pytest.approx(np.eye(2), abs=1e-4)
    assert 12 < sum(mirrored) < 36 and np.ptp(yaws) > 5
    shifts = np.array(shifts)
    assert np.abs(shifts).max() <= 0.2 * SIDE + 1e-5 and np.abs(shifts).max() > 0.18 * SIDE
    starts = env.task.simulation.grippers.positions.astype(float) / SIDE - [[-0.4, 0, 0.5], [0.4, 0, 0.5]]
    assert np.abs(starts).max() <= 0.1 + 1e-5 and np.abs(starts).max() > 0.09


def test_the_hard_tier_is_larger_and_of_another_fabric():
    hard = gym.make("clothgym:ClothFlatten-Hard-v0").unwrapped
    hard.reset(seed=0)
    assert hard.task.physics.mesh.grid_shape == (21, 21) and hard.task.physics.side == 0.8
    # 162.9 g/m^2 and 6.57 uN m of rigidity, as Matsudaira and others measured their tropical wool
    properties = dict(zip(PROPERTIES, hard.task.episode["material"][0]))
    assert properties["density"] == 0.1629 and properties["bend_rigidity"] == 6.57e-6


def test_a_throw_takes_the_hands_along_out_through_its_places():
    env = gym.make_vec(ID, num_envs=3, action_mode="throw", autoreset_mode="Disabled").unwrapped
    env.reset(seed=1_000_000)
    task = env.task
    assert task.single_action_space.shape == (17,) and task.control_steps == 150 and task.acting_steps == 300
    # slow: five places that lower the sheet a little
    lasting, along, above = [8, 7, 8, 7, 5], [0.3, 0.35, 0.2, 0.05, -0.1, 0.0], [1.2, 1.1, 1.2, 1.1, 0.9, 0.8]
    action = np.concatenate([(np.array(lasting) - 7) / 6, np.array(along) / 0.7, (np.array(above) - 0.635) / 0.615])
    noted, inner = [], task._control_step

    def step(actions):
        ways = task.seen["out"].copy()
        inner(actions)
        middle = task.simulation.grippers.positions.astype(float).mean(axis=1) / SIDE
        both = (task.simulation.grippers.held > 0).all(axis=1) & (np.linalg.norm(ways, axis=1) > 0.5)
        noted.append(np.where(both[:, None], np.stack([(middle[:, :2] * ways).sum(axis=1), middle[:, 2]], axis=1), np.nan))

    task._control_step = step
    task.step(np.tile(action, (3, 1)))
    assert len(noted) == 150
    middles = np.array(noted)  # (steps, envs, 2)
    passed = []
    for place in np.stack([along, above], axis=1)[1:]:
        away = np.linalg.norm(middles - place, axis=2)
        assert np.nanmin(away, axis=0) == pytest.approx(np.zeros(3), abs=0.05), place
        passed.append(np.nanargmin(away, axis=0))
    # from the second place to the last, in the time that the action asks for; before it the edge was lifted, after it let go of
    assert np.abs(passed[-1] - passed[0] - sum(lasting[1:])).max() <= 4
    assert np.nanmax(middles[..., 1], axis=0).min() > 1.17 and np.isnan(middles[passed[-1] + 6, range(3)]).all()


def test_throws_of_a_shirt_with_a_front_go_against_out():
    env = gym.make_vec("clothgym:ClothCanonicalize-v0", num_envs=1, action_mode="throw", autoreset_mode="Disabled").unwrapped
    env.reset(seed=5)
    task = env.task
    along, above = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]), np.array([1.2, 1.1, 1.0, 0.9, 0.9, 0.9])
    noted, inner = [], task._control_step

    def step(actions):
        out = task.seen["out"][0].copy()
        inner(actions)
        if np.all(task.simulation.grippers.held > 0) and np.linalg.norm(out) > 0.5:
            noted.append(task.simulation.grippers.positions[0, :, :2].astype(float).mean(axis=0) @ out / task.physics.side)

    task._control_step = step
    task.step(np.concatenate([np.zeros(5), along / 0.7, (above - 0.635) / 0.615])[None])
    assert not task.simulation.grippers.held.any() and noted[-1] == pytest.approx(-0.5, abs=0.02)


def test_one_throw_in_an_action_and_a_way_that_it_cuts_short_leaves_the_edge_held():
    env = gym.make_vec(ID, num_envs=1, action_mode="throw", autoreset_mode="Disabled").unwrapped
    env.reset(seed=1_000_005)
    task = env.task
    # 65 steps down to half of a side; one corner lies free at the start, so the edge is lifted after more than 150 - 65
    above = np.array([1.2, 1.06, 0.92, 0.78, 0.64, 0.5])
    slow = np.concatenate([np.ones(5), np.zeros(6), (above - 0.635) / 0.615])[None]
    task.step(slow)
    heights = task.simulation.grippers.positions[..., 2] / SIDE
    assert np.all(task.simulation.grippers.held > 0) and np.all((heights > 0.51) & (heights < 1.1))
    # from wherever they are to the first place, and down to where they let go, in 65 steps; there is no second throw
    held, heights, inner = [], [], task._control_step

    def step(actions):
        inner(actions)
        held.append(np.any(task.simulation.grippers.held > 0))
        heights.append(task.simulation.grippers.positions[0, :, 2].astype(float).mean() / SIDE)

    task._control_step = step
    task.step(slow)
    released = held.index(False)
    highest = int(np.argmax(heights[:released]))
    assert heights[highest] > 1.15 and heights[released - 1] == pytest.approx(0.5, abs=0.05)
    assert released - highest == pytest.approx(65, abs=8) and not any(held[released:])


@pytest.mark.parametrize("env_id", [ID, "clothgym:ClothFlatten-Hard-v0"])
def test_the_shortest_and_the_longest_ways_end_with_their_episode(env_id):
    env = gym.make_vec(env_id, num_envs=3, action_mode="throw", settling="at_once", autoreset_mode="Disabled").unwrapped
    env.reset(seed=7)
    # the least and the largest numbers, and both by turns
    extremes = np.stack([-np.ones(17), np.ones(17), np.resize([-1.0, 1.0], 17)])
    highest, inner = np.zeros((3, 2)), env.task._control_step

    def step(velocities):
        inner(velocities)
        both = (env.task.simulation.grippers.held > 0).all(axis=1, keepdims=True)
        highest[:] = np.maximum(highest, both * env.task.simulation.grippers.positions[..., 2])

    env.task._control_step = step
    for action in range(2):
        seen, _, ended, _, info = env.step(extremes)
        assert np.isfinite(seen).all() and ended.all() == (action == 1)
    # all have lifted an edge
    assert np.all(highest > 1.17 * env.task.physics.side)
    assert not env.task.simulation.grippers.held.any() and np.all((info["coverage"] > 0) & (info["coverage"] <= 1))
    assert np.all(info["rms_speed"] < 0.3)


def test_time_of_a_way_stands_still_while_hands_are_far_from_it():
    hands = Hands(Throw((4.0, 8.0), (0.0, 0.0, 0.8), (1.0, 0.2, 0.2)))
    # a side of 0.5 m: 0.06 m behind is too far, 0.04 m is not
    far = hands.velocity(np.array([0.0, 0.56]), 0.5)
    assert far == pytest.approx([0.0, -20 * 0.06]) and hands.begun
    near = [hands.velocity(np.array([0.0, 0.54]), 0.5) for _ in range(2)]
    # each step 0.1 m lower, in a thirtieth of a second, and back; in the second one 0.14 m are missing
    assert near[0] == pytest.approx([0.0, -0.1 * 30 - 20 * 0.04]) and near[1] == pytest.approx([0.0, -20 * 0.14])
    places = [(0, 0.4), (0, 0.3), (0, 0.2), (0, 0.1), (0.1, 0.1), (0.2, 0.1)]
    assert all(hands.velocity(np.array(place), 0.5) is not None for place in places) and not hands.done
    assert (
        hands.velocity(np.array([0.3, 0.1]), 0.5) is not None and hands.velocity(np.array([0.4, 0.1]), 0.5) is None and hands.done
    )


def test_throws_have_the_same_bits_alone_in_a_batch_and_from_a_restored_state():
    actions, seeds = np.random.default_rng(0).uniform(-1, 1, (2, 2, 17)), [5, 6]

    def made(count):
        return gym.make_vec(ID, num_envs=count, action_mode="throw", autoreset_mode="Disabled").unwrapped

    both, alone, restored = made(2), made(1), made(2)
    both.reset(seed=seeds)
    alone.reset(seed=seeds[1:])
    restored.reset(seed=[8, 9])
    for step, action in enumerate(actions):
        if step:
            restored.set_state(both.get_state())
        seen, reward, *_ = both.step(action)
        one, its, *_ = alone.step(action[1:])
        assert np.array_equal(seen[1], one[0]) and reward[1] == its[0]
    again, its, *_ = restored.step(actions[1])
    assert np.array_equal(seen, again) and np.array_equal(reward, its)

"""Flinging: throws and the coverage after each, the box, slow hands against swung ones, by numbers worked out here."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym.envs.fling import held_sheets
from clothgym.envs.rumpled import CRUMPLED, CRUMPLED_LARGE
from clothgym.envs.taking import next_edges_of, next_takes_of

ID, SIDE = "clothgym:ClothFling-v0", 0.6
SEEDS = [1_000_000, 1_000_001, 1_000_002, 1_000_003, 7, 8]
LOW, HIGH = np.array([-0.54, -0.18, 0.01]), np.array([0.54, 0.18, 0.75])  # of the box [m]


def batch(**kwargs):
    return gym.make_vec(ID, **({"num_envs": len(SEEDS)} | kwargs), autoreset_mode="Disabled").unwrapped


def shadow(mesh, x, cell=0.005):
    """Share of its area that a sheet covers: of cells whose centers lie in some triangle, by barycentric coordinates."""
    low = np.floor(x[:, :2].min(axis=0) / cell) * cell
    count = np.ceil((x[:, :2].max(axis=0) - low) / cell).astype(int) + 1
    centers = np.stack(np.meshgrid(*((np.arange(n) + 0.5) * cell + start for n, start in zip(count, low)), indexing="ij"), axis=-1)
    covered = np.zeros(count, bool)
    for a, b, c in x[mesh.triangles][:, :, :2]:
        first, last = (((f(f(a, b), c) - low) / cell).astype(int) for f in (np.minimum, np.maximum))
        window = tuple(slice(i, j + 2) for i, j in zip(first, last))
        p, u, v = centers[window] - a, b - a, c - a
        area = u[0] * v[1] - u[1] * v[0]
        if area != 0:
            s, t = (p[..., 0] * v[1] - p[..., 1] * v[0]) / area, (u[0] * p[..., 1] - u[1] * p[..., 0]) / area
            covered[window] |= (s >= 0) & (t >= 0) & (s + t <= 1)
    return covered.sum() * cell**2 / (mesh.size[0] * mesh.size[1])


def toward(task, goals, grip, speed=2.0):
    """Actions that move the tips to these places [m], (num_envs, 2, 3), at no more than a speed [m/s]."""
    way = (goals - task.episode["targets"]) * 30
    way *= np.minimum(1, speed / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-9))
    return np.concatenate([way / 2, np.full((*way.shape[:2], 1), grip)], axis=2).reshape(len(way), -1)


def test_two_corners_are_held_after_four_steps_for_any_actions():
    env, rng = batch(), np.random.default_rng(0)
    env.reset(seed=SEEDS)
    task = env.task
    before = task.simulation.grippers.positions
    for _ in range(4):
        assert np.array_equal(task.simulation.grippers.positions, before)
        env.step(rng.uniform(-1, 1, (len(SEEDS), 8)) + [0, 0, 0, 2] * 2)
    rest, corners = task.physics.mesh.rest_positions, np.array(task.physics.mesh.corners)
    env.reset(seed=SEEDS)
    for _ in range(4):
        env.step(np.zeros((len(SEEDS), 8)))
    for e in range(len(SEEDS)):
        ends = []
        for k in range(2):
            held = np.flatnonzero(task.simulation.grippers.holder[e] == k)
            away = np.linalg.norm(rest[held][:, None] - rest[corners], axis=2)
            # one corner, and at most what lies beside it in the sheet
            assert away.min() == 0 and (away.min(axis=1) < 1.5 * SIDE / 16).all()
            ends.append(rest[corners[away.min(axis=0).argmin()]])
        assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(SIDE)
    # the first gripper on the left
    assert np.all(before[:, 0, 0] < before[:, 1, 0]) and np.all(np.abs(before[..., 1]) < 0.18)


@pytest.mark.parametrize("bank", [CRUMPLED, CRUMPLED_LARGE])
def test_at_the_starts_nothing_but_a_corner_is_within_reach(bank):
    sheets, starts = held_sheets(bank.rows, bank.rows, bank.side, bank)
    n = bank.rows
    index = np.arange(n * n).reshape(n, n)
    blocks = [index[:2, :2], index[:2, -2:], index[-2:, :2], index[-2:, -2:]]
    assert len({start.sheet for start in starts}) >= 30
    for start in starts:
        for tip in start.tips:
            near = np.flatnonzero(np.linalg.norm(sheets[start.sheet] - tip, axis=1) <= 0.03)
            assert any(set(near) <= set(block.ravel()) for block in blocks) and len(near)


def test_the_tips_stay_in_the_box():
    env = batch()
    env.reset(seed=SEEDS)
    for x, y, z in [(1, 1, 1), (-1, -1, -1), (1, -1, 0.5), (-1, 1, 0)]:
        action = np.tile([x, y, z, -1.0], (len(SEEDS), 2))
        for _ in range(30):
            env.step(action)
            tips = env.task.simulation.grippers.positions
            assert np.all(tips > LOW - 1e-5) and np.all(tips < HIGH + 1e-5)
        for c, wanted in enumerate((x, y, z)):
            if abs(wanted) == 1:
                assert tips[..., c] == pytest.approx(HIGH[c] if wanted > 0 else LOW[c], abs=0.02)


def test_a_gripper_takes_hold_once_in_a_throw_and_there_is_no_fourth_throw():
    env = batch(num_envs=1)
    env.reset(seed=0)
    task = env.task

    def do(left, right, steps=5):
        for _ in range(steps):
            info = env.step(np.array([[0, 0, 0, left, 0, 0, 0, right]]))[4]
        return task.simulation.grippers.held[0] > 0, info["throws"][0]

    assert do(-1, -1)[0].tolist() == [True, True]
    # one lets go, and would take the corner again: not before the other has let go
    assert do(1, -1)[0].tolist() == [False, True]
    taken, throws = do(-1, -1)
    assert taken.tolist() == [False, True] and throws == 0
    taken, throws = do(1, 1)
    assert not taken.any() and throws == 1
    for throw in (2, 3):
        taken, throws = do(-1, -1)
        assert taken.any() and throws == throw - 1
        taken, throws = do(1, 1)
        assert not taken.any() and throws == throw
    taken, throws = do(-1, -1)
    assert not taken.any() and throws == 3 and np.all(task.simulation.grippers.openings == 1)


@pytest.mark.slow
def test_the_expert_flings_and_the_coverage_after_each_throw_is_that_of_the_triangles():
    env = batch()
    env.reset(seed=SEEDS)
    task, mesh = env.task, env.task.physics.mesh
    over, after = np.zeros(len(SEEDS), bool), np.full((len(SEEDS), 3), -1.0)
    start = np.array([shadow(mesh, x) for x in task.simulation.positions])
    assert task.infos()["coverage_start"] == pytest.approx(start, abs=0.02)
    fastest, held, left = np.zeros(len(SEEDS)), np.zeros(len(SEEDS)), env.observation_slices["throws_left"].start
    while not over.all():
        actions = env.expert_actions()
        actions[-1] = 0.0  # one does nothing
        seen, _, terminated, _, info = env.step(actions)
        assert seen[:, left] == pytest.approx(1 - info["throws"] / 3)
        # what is held does not lie spread, however much it covers
        assert not info["best"][info["throws"] == 0].any()
        held = np.maximum(held, np.where(info["throws"] == 0, info["coverage"], 0))
        fastest = np.maximum(fastest, np.linalg.norm(task.simulation.velocities, axis=2).max(axis=1))
        over |= terminated
        free = ~(task.simulation.grippers.held > 0).any(axis=1)
        # of what lies there now, every now and then
        if task.episode["step"][0] % 20 == 0 or over.all():
            for e in np.flatnonzero(free & (info["throws"] > 0)):
                after[e, info["throws"][e] - 1] = shadow(mesh, task.simulation.positions[e].astype(float))
                told = info[f"coverage_after_{info['throws'][e]}"][e]
                assert told == pytest.approx(min(after[e, info["throws"][e] - 1], 1), abs=0.03)
    final = np.array([shadow(mesh, x) for x in task.simulation.positions.astype(float)])
    assert info["coverage"] == pytest.approx(np.minimum(final, 1), abs=0.02)
    assert np.all(info["is_success"] == ((info["coverage"] >= 0.9) & (info["rms_speed"] < 0.02)))
    assert info["is_success"][:-1].sum() >= 4 and np.all(info["throws"] <= 3) and np.all(fastest[:-1] > 2)
    # what does nothing holds the sheet until its time is up: one throw, and no gain
    assert info["throws"][-1] == 1 and info["normalized_performance"][-1] < 0.05 and info["first_success"][-1] == -1
    assert np.all(info["coverage_after_2"][info["throws"] < 2] == -1)
    assert held.max() > start.max()


@pytest.mark.slow
def test_slow_hands_do_not_lay_the_sheet_down():
    env = batch()
    env.reset(seed=SEEDS)
    task, n = env.task, len(SEEDS)
    apart = np.array([-0.295, 0.295])

    def at(y, z):
        goals = np.zeros((n, 2, 3))
        goals[..., 0], goals[..., 1], goals[..., 2] = apart, y, z
        return goals

    # up, taut, at the far end of the box; down until the lower edge lies; back as it goes down; a half of a meter a second at most
    way = [(0.0, 0.5, 40), (0.18, 0.72, 50), (0.18, 0.58, 20), (-0.18, 0.3, 60), (-0.18, 0.02, 40)]
    for y, z, steps in way:
        for _ in range(steps):
            env.step(toward(task, at(y, z), -1.0, speed=0.5))
    for _ in range(40):
        info = env.step(toward(task, at(-0.18, 0.1), 1.0, speed=0.2))[4]
    assert np.all(info["throws"] == 1) and np.all(info["coverage_after_1"] > 0.4)
    assert np.all(info["coverage_after_1"] < 0.85)


def test_an_action_that_is_a_throw_takes_the_hands_through_its_places():
    env = batch(num_envs=3, action_mode="throw")
    env.reset(seed=1_000_000)
    task = env.task
    assert task.single_action_space.shape == (17,) and task.control_steps == 100
    # slow: five places that lower the sheet a little
    lasting, along, above = [8, 7, 8, 7, 5], [0.0, 0.15, 0.1, -0.06, -0.12, 0.0], [1.1, 1.0, 1.1, 1.0, 0.9, 0.8]
    action = np.concatenate([(np.array(lasting) - 7) / 6, np.array(along) / 0.3, (np.array(above) - 0.635) / 0.615])
    middles, inner = [], task._control_step

    def noted(actions):
        inner(actions)
        middles.append(task.simulation.grippers.positions.astype(float).mean(axis=1)[:, 1:] / SIDE)

    task._control_step = noted
    task.step(np.tile(action, (3, 1)))
    assert len(middles) == 100
    # where the sheet is stretched, and then at each place; hands set out after 60 control steps
    places = np.stack([along, above], axis=1)
    for place in places:
        away = [np.linalg.norm(one - place, axis=1) for one in middles[50:]]
        assert np.min(away, axis=0) == pytest.approx(np.zeros(3), abs=0.04), place
    first, last = (np.argmin([np.linalg.norm(one - place, axis=1) for one in middles[50:]], axis=0) for place in places[[1, -1]])
    assert np.abs(last - first - sum(lasting[1:])).max() <= 4
    assert np.abs(50 + last - (60 + sum(lasting))).max() <= 4
    assert np.all(task.info["throws"] == 1) and np.all(task.simulation.grippers.held == 0)


def test_the_expert_s_throw_is_its_own_action():
    """Places and times of the class, as the description says them."""
    env = batch(num_envs=1, action_mode="throw")
    env.reset(seed=0)
    task = env.task
    steps, along, above = np.split(task.expert()[0], [5, 11])
    assert np.cumsum(7 + 6 * steps) == pytest.approx(task.throw.steps)
    assert 0.3 * along == pytest.approx(task.throw.along) and 0.635 + 0.615 * above == pytest.approx(task.throw.above)
    with pytest.raises(ValueError, match="action_repeat=2: must be 1 with action_mode='throw'"):
        batch(action_mode="throw", action_repeat=2)


def test_macro_actions_are_refused_and_the_hard_tier_is_larger():
    with pytest.raises(ValueError, match="action_mode='pick_place': must be 'velocity' or 'throw'"):
        gym.make(ID, action_mode="pick_place")
    hard = gym.make("clothgym:ClothFling-Hard-v0").unwrapped
    hard.reset(seed=0)
    low, high = hard.task.arena()
    assert hard.task.physics.side == 0.8 and high == pytest.approx([0.72, 0.24, 1.0]) and low == pytest.approx([-0.72, -0.24, 0.01])


def test_a_state_in_which_throws_and_coverages_do_not_fit_is_refused():
    env = batch(num_envs=1)
    env.reset(seed=0)
    env.step(np.zeros((1, 8)))
    state = env.get_state()
    state.episode["after"][0, 1] = 0.5
    with pytest.raises(ValueError, match="throws and coverages"):
        env.set_state(state)


def test_a_clock_and_the_next_corners_are_observed():
    env = gym.make_vec("clothgym:ClothFling-v0", num_envs=4)
    seen, _ = env.reset(seed=3)
    task, slices = env.unwrapped.task, env.unwrapped.task.observation_slices
    looked, flat = 0, 0
    for step in range(1, 160):
        seen, *_ = env.step(task.expert().astype(np.float32))
        if step in (1, 7, 35, 100):
            # from 1 down to -1 in the middle of a period, and up again
            waves = [np.interp((step + early) % p, [0, p / 2, p], [1, -1, 1]) for p in (12, 36, 108) for early in (0, p // 4)]
            assert seen[:, slices["clock"]] == pytest.approx(np.tile(waves, (4, 1)), abs=1e-6)
        goals, count = next_takes_of(task)
        edges, others = next_edges_of(task)
        empty = (task.simulation.grippers.held == 0).all(axis=1)
        goals[empty], count[empty] = edges[empty], others[empty]
        ways = goals - task.simulation.grippers.positions
        length = np.linalg.norm(ways, axis=2, keepdims=True)
        free = 1 / (1 + np.maximum(count, 0)[..., None])
        expected = np.concatenate([ways / (length + 0.01), free], axis=2) * (count >= 0)[..., None]
        # what covers enough is left alone
        done = (task.episode["coverage"] >= 0.905) & empty
        expected[done | (task.episode["throws"] == 3)] = 0
        flat += done.sum()
        assert seen[:, slices["next"]].reshape(4, 2, 4) == pytest.approx(expected, abs=1e-4)
        looked += (count >= 0).sum()
    assert looked > 20 and flat > 20
    env.close()

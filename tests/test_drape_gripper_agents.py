"""Who succeeds in the gripper task, and who cheats."""

import numpy as np
import pytest
from test_drape_gripper import ACTING, CORNERS, SIDE, STEPS, batch, evaluation, fetched, play, positions

from clothgym.envs.episode import OUT_OF_BOUNDS

# --- who succeeds, and who cheats -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_expert_succeeds_on_flat_and_on_rumpled_sheets():
    env = batch(30, seed=500)
    rumpled = np.ptp(positions(env)[:, :, 2], axis=1) > 0.01
    last = play(env, lambda env, step: env.unwrapped.expert_actions())
    assert last["steps"] == STEPS and not any(last["failure"])
    assert last["is_success"].mean() >= 0.8 and last["normalized_performance"].mean() > 0.8
    assert last["is_success"][rumpled].mean() > 0.6 and last["is_success"][~rumpled].mean() > 0.6


def test_no_action_scores_zero():
    last = play(batch(8), lambda env, step: np.zeros((8, 8)))
    assert not last["normalized_performance"].any() and not last["is_success"].any() and not any(last["failure"])


@pytest.mark.slow
def test_fingers_that_cannot_hold_the_weight_never_lift_the_sheet():
    env = batch(4, options={"rumpled": False}, slip_force=1e-3)
    height = []

    def policy(env, step):
        height.append(positions(env)[:, :, 2].max())
        return env.unwrapped.expert_actions()

    last = play(env, policy)
    assert max(height) < 0.05 and not last["normalized_performance"].any()
    firm = batch(4, options={"rumpled": False}, slip_force=2.0)
    assert play(firm, lambda env, step: env.unwrapped.expert_actions())["is_success"].any()


@pytest.mark.slow
def test_who_holds_the_sheet_over_the_target_to_the_end_is_evaluated_by_how_it_falls():
    """The fingers open by themselves; nothing that is held is ever evaluated, and the sheet is where it fell."""
    env = batch(6, seed=3)
    heights, hold, policy = [], [], fetched((0.0, 0.25, 0.75))

    def watched(env, step):
        heights.append(positions(env)[:, CORNERS, 2].min(axis=1))
        hold.append(env.unwrapped.task.simulation.grippers.held.all(axis=1))
        return policy(env, step)

    last = play(env, watched)
    tops = np.array([target.height for target in env.unwrapped.task.targets])
    assert np.all(hold[ACTING]) and np.all(heights[ACTING] > tops + 0.6 * SIDE)
    assert not np.any(hold[ACTING + 1 :]) and np.all(positions(env)[:, CORNERS, 2].max(axis=1) < tops + 0.1 * SIDE)
    assert last["steps"] == STEPS
    for i in range(6):
        performance, success, *_ = evaluation(env, i)
        assert last["normalized_performance"][i] == pytest.approx(performance, abs=1e-5) and last["is_success"][i] == success


@pytest.mark.slow
def test_a_sheet_dropped_next_to_the_target_scores_almost_zero():
    env, policy = batch(6, seed=3), fetched((1.0, 0.0, 0.2))
    last = play(env, policy)
    assert last["normalized_performance"].max() < 0.1 and not last["is_success"].any()
    assert np.all(last["off_center"] > 0.5)


@pytest.mark.slow
def test_a_sheet_dragged_to_the_end_of_the_arena_scores_nothing():
    env, policy = batch(6, seed=3), fetched((0.0, -5.0, 0.1))
    last = play(env, policy)
    assert np.all(positions(env)[:, CORNERS, 1].mean(axis=1) < -0.9)
    assert not last["normalized_performance"].any() and not last["is_success"].any()
    assert set(last["failure"]) <= {0, OUT_OF_BOUNDS}

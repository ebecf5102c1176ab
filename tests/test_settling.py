"""``settling="at_once"``: the last step of the agent goes on until the sheet has settled; and steps of some environments."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import Gripper, Plane, Simulation, grid

CASES = (
    ("ClothDrape-v0", {}),
    ("ClothDrapeGripper-v0", {"slip_force": 0.3}),
    ("ClothFlatten-v0", {"action_mode": "pick_place", "slip_force": 3.0}),
)


def ends(env_id, settling, seed, **kwargs):
    """Of each environment's episode under the expert: calls of step, return, and the last observation, positions and info."""
    env = gym.make_vec(f"clothgym:{env_id}", num_envs=3, autoreset_mode="Disabled", settling=settling, **kwargs).unwrapped
    env.reset(seed=seed)
    over, total, found, calls = np.zeros(3, bool), np.zeros(3), {}, 0
    while not over.all():
        seen, reward, terminated, _, info = env.step(env.expert_actions())
        total, calls = total + reward * ~over, calls + 1
        for i in np.flatnonzero(terminated & ~over):
            last = {key: value[i].item() for key, value in info.items() if value.ndim == 1 and not key.startswith(("reward", "_"))}
            found[i] = calls, seen[i], env.task.simulation.positions[i], last
        over |= terminated
    return env, total, found


@pytest.mark.parametrize(("env_id", "kwargs"), CASES)
def test_an_episode_ends_with_the_same_bits_whether_it_settles_in_steps_or_at_once(env_id, kwargs):
    in_steps, at_once = (ends(env_id, settling, 11, **kwargs) for settling in ("steps", "at_once"))
    assert at_once[1] == pytest.approx(in_steps[1], abs=1e-12)
    task = at_once[0].task
    for i in range(3):
        (calls, seen, x, info), (fewer, *rest) = in_steps[2][i], at_once[2][i]
        assert np.array_equal(seen, rest[0]) and np.array_equal(x, rest[1]) and info == rest[2]
        # every call but those in which the sheet settles
        assert fewer <= at_once[0].task.most_steps() < in_steps[0].task.most_steps() and fewer < calls
    assert task.steps_taken().max() == max(found[0] for found in at_once[2].values())


def test_those_that_act_stand_still_while_others_settle():
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=2, autoreset_mode="Disabled", settling="at_once").unwrapped
    env.reset(seed=4)
    lets_go = np.array([[0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0, -1, 0, 0, 0, -1.0]])
    _, reward, terminated, *_ = env.step(lets_go)
    assert terminated.tolist() == [True, False]
    alone = gym.make("clothgym:ClothDrape-v0").unwrapped
    alone.reset(seed=5)
    # the other one has taken one step, as if alone
    seen, gain, *_ = alone.step(lets_go[1])
    assert np.array_equal(env.task.observation[1], seen) and reward[1] == gain and env.task.episode["step"][1] == 1
    assert env.task.episode["step"][0] == 1 + env.task.settling_steps


def test_a_failure_keeps_its_reward_while_another_sheet_settles():
    """In the step in which the agent of environment 0 lets go, the sheet of the last environment has diverged."""
    rewards = {}
    for count in (1, 2):
        env = gym.make_vec(
            "clothgym:ClothDrape-v0", num_envs=count, autoreset_mode="Disabled", physics="fast", settling="at_once"
        ).unwrapped
        env.reset(seed=[5, 6][2 - count :])
        still = np.zeros((count, 8), np.float32)
        still[:, [3, 7]] = -1
        for _ in range(59):
            env.step(still)
        simulation = env.task.simulation
        state = simulation.get_state()
        state.velocities[-1] = 1e20
        simulation.set_state(state)
        _, reward, terminated, _, info = env.step(still)
        assert terminated.all() and info["failure"][-1] > 0
        rewards[count] = reward[-1], info["reward/failure"][-1]
    assert rewards[1][1] < -0.1 and rewards[1] == rewards[2]


def test_a_sheet_whose_environments_advance_together_is_refused():
    with pytest.raises(ValueError, match=r"settling='at_once': with xpbd on this sheet environments advance together"):
        gym.make("clothgym:ClothDrape-v0", integrator="xpbd", settling="at_once")
    with pytest.raises(ValueError, match="settling='later': must be 'steps' or 'at_once'"):
        gym.make("clothgym:ClothDrape-v0", settling="later")


def falling(num_envs, **kwargs):
    mesh = grid(9, 9, 0.4, 0.4)
    return Simulation(
        mesh, num_envs=num_envs, colliders=[Plane()], grippers=(Gripper(position=(0.2, 0.2, 0.3), slip_force=0.05),),
        self_collision="strict", **kwargs,
    )  # fmt: skip


@pytest.mark.parametrize("threads", [1, 2])
def test_named_environments_advance_as_alone_and_the_others_stay(threads):
    batch, alone = falling(4, threads=threads), falling(1)
    x = np.stack([batch.mesh.rest_positions * (1, 1, 1) + (0, 0, 0.1 + 0.05 * k) for k in range(4)])
    batch.reset(positions=x)
    alone.reset(positions=x[2:3])
    for simulation in (batch, alone):
        simulation.grippers.move(simulation.grippers.positions, 0.0)
    batch.step(3, envs=[2])
    alone.step(3)
    assert np.array_equal(batch.positions[2], alone.positions[0]) and np.array_equal(batch.velocities[2], alone.velocities[0])
    assert np.array_equal(batch.positions[[0, 1, 3]], x[[0, 1, 3]].astype(np.float32))
    assert batch.get_state().steps.tolist() == [0, 0, 3, 0]
    # then all, and the one that was ahead stays three steps ahead
    batch.step(2)
    alone.step(2)
    assert np.array_equal(batch.positions[2], alone.positions[0])
    with pytest.raises(ValueError, match="envs"):
        batch.step(envs=[4])
    lanes = Simulation(grid(5, 5, 0.2, 0.2), num_envs=3, integrator="xpbd")
    with pytest.raises(ValueError, match=r"step\(envs=...\): with xpbd on this mesh"):
        lanes.step(envs=[0])


def test_changes_of_task_methods_to_other_environments_are_undone(monkeypatch):
    from clothgym.envs.drape import DrapeTask

    def count(task):
        task.episode["yaw"] += 1.0

    monkeypatch.setattr(DrapeTask, "after_step", count)
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=2, autoreset_mode="Disabled", settling="at_once").unwrapped
    env.reset(seed=4)
    before = env.task.episode["yaw"].copy()
    env.step(np.array([[0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0, -1, 0, 0, 0, -1.0]]))
    assert (env.task.episode["yaw"] - before).tolist() == [1 + env.task.settling_steps, 1]


def test_a_batch_with_autoreset_returns_the_final_results_of_settled_episodes():
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=2, autoreset_mode="SameStep", settling="at_once").unwrapped
    env.reset(seed=4)
    lets_go = np.array([[0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0, -1, 0, 0, 0, -1.0]])
    seen, _, terminated, _, info = env.step(lets_go)
    assert terminated.tolist() == [True, False] and info["_final_info"].tolist() == [True, False]
    assert info["final_info"]["settling"][0] and env.task.episode["step"].tolist() == [0, 1]
    assert not np.array_equal(info["final_obs"][0], seen[0])
    # the number of steps that an episode may take is of those in which the agent acts
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=1, autoreset_mode="Disabled", settling="at_once", max_episode_steps=2)
    env.reset(seed=0)
    ends = [env.step(np.zeros((1, 8)))[2:4] for _ in range(2)]
    assert [(terminated[0], truncated[0]) for terminated, truncated in ends] == [(False, False), (False, True)]

"""What somebody's own task returns and does not fit is refused, with the name of the method that has returned it."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from test_over import SHEET, Count, CountEnv, CountVectorEnv

from clothgym import Box, Plane
from clothgym.envs import Observation

N = 4
FLAT = SHEET.rest_positions + (0, 0, 0.3)


def made(**methods):
    """A batch of a task with these methods and attributes in place of its own, and a single environment."""
    task = type("Mine", (Count,), methods)
    kinds = [type(f"Mine{kind.__name__}", (kind,), {"task_class": task}) for kind in (CountVectorEnv, CountEnv)]
    return kinds[0](N), kinds[1]()


def returning(value):
    return lambda self, *given: value


def of_size(make):
    """Of as many environments as there are."""
    return lambda self, *given: make(self.num_envs)


WRONG = {
    "performance a scalar": ({"performance": returning(0.5)}, r"Mine.performance\(\) has shape \(\): must be \(4,\)"),
    "performance too wide": ({"performance": of_size(lambda n: np.zeros((n, 2)))}, r"Mine.performance\(\) has shape \(4, 2\)"),
    "performance none": ({"performance": returning(None)}, r"Mine.performance\(\)=None: must be an array of numbers, \(4,\)"),
    "performance text": ({"performance": returning("high")}, r"Mine.performance\(\)='high': must be an array of numbers"),
    "success floats": ({"success": of_size(np.ones)}, r"Mine.success\(\) has returned an array of float64: must be \(4,\) of bool"),
    "success one for all": ({"success": returning(np.True_)}, r"Mine.success\(\) has returned an array of shape \(\)"),
    "done floats": ({"done": of_size(np.zeros)}, r"Mine.done\(\) has returned an array of float64"),
    "done too many": ({"done": of_size(lambda n: np.zeros(n + 1, bool))}, r"Mine.done\(\) has returned an array of shape \(5,\)"),
    "begin none": ({"begin": returning(None)}, r"Mine.begin\(\) has returned None: must return the sheet's particles"),
    "begin one short": ({"begin": returning(FLAT[:-1])}, r"Mine.begin\(\) has shape \(24, 3\): .*\(25, 3\)"),
    "begin text": ({"begin": returning("flat")}, r"Mine.begin\(\)='flat': must be numbers"),
    "begin not finite": ({"begin": returning(FLAT * np.nan)}, r"Mine.begin\(\) holds a value that is not finite"),
    "begin sunk": (
        {"begin": returning(FLAT - (0, 0, 0.35))},
        r"Mine.begin\(\) starts environment 0 0.05 m below Plane.*: lift the sheet above it",
    ),
    "begin beyond a wall": (
        {"colliders": returning([Plane(), Plane(point=(0.05, 0, 0), normal=(-2, 0, 0))])},
        r"starts environment 0 0.05 m below Plane.*point=\(0.05",
    ),
    "begin below an episode's floor": (
        {"episode_colliders": returning({0: Plane(point=(0, 0, 0.4))})},
        r"starts environment 0 0.1 m below Plane.*point=\(0",
    ),
    "episode_colliders none": ({"episode_colliders": returning(None)}, r"Mine.episode_colliders\(\)=None: must be a dict"),
    "observation turned": (
        {"observations": (Observation("way", "", (2,), function=lambda task: np.zeros((2, task.num_envs))),)},
        r"Mine's Observation 'way' has shape \(2, 4\): must be \(4, 2\)",
    ),
    "observation none": (
        {"observations": (Observation("way", "", (2,), function=lambda task: None),)},
        r"Mine's Observation 'way'=None: must be an array of numbers, \(4, 2\)",
    ),
}
WRONG_WHEN_MADE = {
    "colliders none": ({"colliders": returning(None)}, ValueError, r"Mine.colliders\(\)=None: must be a sequence of solids"),
    "colliders a solid": ({"colliders": returning(Box())}, ValueError, r"Mine.colliders\(\)=Box.*sequence of solids"),
    "arena a box": ({"arena": returning(1.0)}, ValueError, r"Mine.arena\(\)=1.0: must be two corners"),
    "arena upside down": (
        {"arena": returning(((0, 0, 1), (1, 1, 0)))},
        ValueError,
        r"Mine.arena\(\).*first corner must be below the second",
    ),
    "remembers none": ({"remembers": returning(None)}, TypeError, r"Mine.remembers\(\) is None: must be a list of fields"),
    "remembers names": ({"remembers": returning(["goal"])}, TypeError, r"Mine.remembers\(\) holds 'goal': must be \(name, type\)"),
    "remembers no type": (
        {"remembers": returning([("goal", "a number")])},
        TypeError,
        r"Mine.remembers\(\) holds \('goal', 'a number'\)",
    ),
    "remembers a taken name": ({"remembers": returning([("step", int)])}, TypeError, r"Mine.remembers\(\) names 'step'"),
    "accounts twice": ({"accounts": (("a", float), ("a", float))}, TypeError, r"Mine.accounts names 'a', which there is already"),
    "evaluation a name": ({"evaluation": ("score",)}, TypeError, r"Mine.evaluation holds 'score'"),
    "no steps": ({"acting_steps": None}, TypeError, r"Mine.acting_steps is None: must be a number of control steps"),
    "no physics": ({"physics": None}, TypeError, r"Mine.physics is None: must be a Physics"),
}


@pytest.mark.parametrize("case", WRONG)
def test_invalid_results_of_task_methods_are_refused_by_name(case):
    methods, message = WRONG[case]
    batch, single = made(**methods)
    with pytest.raises(ValueError, match=message):
        batch.reset(seed=0)
    with pytest.raises(ValueError, match=message.split("shape")[0].split(r"\(4")[0]):
        single.reset(seed=0)


@pytest.mark.parametrize("case", WRONG_WHEN_MADE)
def test_invalid_task_definitions_are_refused_at_construction(case):
    methods, error, message = WRONG_WHEN_MADE[case]
    with pytest.raises(error, match=message):
        if case == "no physics":
            type("Mine", (Count,), methods)(N)
        else:
            made(**methods)


def test_a_wrong_shape_of_expert_actions_is_named():
    batch, single = made(expert_actions=returning(np.zeros(3)))
    for env, ask in ((batch, "expert_actions"), (single, "expert_action")):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"Mine.expert_actions\(\) has shape \(3,\): must be \([14], 6\)"):
            getattr(env, ask)()


@pytest.mark.parametrize(
    "methods",
    [
        {"performance": of_size(lambda n: np.ones(n, bool)), "success": of_size(lambda n: [True] * n)},
        {"performance": of_size(lambda n: [0.5] * n), "begin": returning(FLAT.tolist())},
        {"observations": (Observation("right", "", function=lambda task: task.episode["right"]),)},
        {"performance": of_size(lambda n: np.full(n, np.nan))},
        {"begin": returning(FLAT - (0, 0, 0.3))},
        {"colliders": returning([])},
    ],
)
def test_valid_results_of_task_methods_are_accepted(methods):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env in made(**methods):
            env.reset(seed=0)
            observation, reward, *_ = env.step(np.zeros(env.action_space.shape))
            assert np.isfinite(observation).all() and np.isfinite(reward).all()


def test_the_simulation_is_pointed_to():
    for env in (*made(), gym.make("clothgym:ClothReach-v0").unwrapped):
        with pytest.raises(AttributeError, match=r"has no attribute 'simulation': it is env.unwrapped.task.simulation"):
            env.simulation  # noqa: B018
        assert not hasattr(env, "nothing")

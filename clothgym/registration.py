"""Gymnasium ids, the modules of their environments, and the scripted actors.  Strings only: ``make`` imports the rest."""

from __future__ import annotations

import difflib
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym

from clothgym.checks import known

# the name that the classes of an id begin with, and the first line of their manual page
ENVIRONMENTS = {
    "ClothReach-v0": (
        "ClothReach",
        "Bring the free corner of a hanging sheet to rest at a goal.",
    ),
    "ClothDrape-v0": (
        "ClothDrape",
        "Lay a hanging sheet over a target and release it.",
    ),
    "ClothDrapeGripper-v0": (
        "ClothDrapeGripper",
        "Pick up a flat or rumpled sheet next to a target, drape it over the target, and release it.",
    ),
    "ClothHang-v0": (
        "ClothHang",
        "Hang a sheet, held by two corners, over a rail and release it.",
    ),
    "ClothHang-Hard-v0": (
        "ClothHangHard",
        "Pick up a flat or rumpled silk sheet from the floor, hang it over a thin rail, and release it.",
    ),
    "ClothHook-v0": (
        "ClothHook",
        "Hang a sheet, held by two corners, on a hook by its hole and release it.",
    ),
    "ClothHook-Hard-v0": (
        "ClothHookHard",
        "Pick up a flat or rumpled silk sheet from the floor, hang it on a hook by its small hole, and release it.",
    ),
    "ClothStrain-v0": (
        "ClothStrain",
        "Carry a stretchy sheet past a post to a goal, in gusts, without stretching it beyond a threshold.",
    ),
    "ClothFold-v0": (
        "ClothFold",
        "Fold a sheet on the floor in half; with fold=, along its diagonal or twice.",
    ),
    "ClothFold-Hard-v0": (
        "ClothFoldHard",
        "Fold a large silk sheet on the floor, turned by any angle, in half twice.",
    ),
    "ClothFoldGoal-v0": (
        "ClothFoldGoal",
        "Bring the corners of a sheet on the floor to the goals of a random fold, with goal observations for HER.",
    ),
    "ClothFoldGoal-Hard-v0": (
        "ClothFoldGoalHard",
        "Bring the corners of a large silk sheet to the goals of a random fold, with goal observations for HER.",
    ),
    "ClothFoldShirt-v0": (
        "ClothFoldShirt",
        "Fold a T-shirt on the floor in half, left over right, with two grippers.",
    ),
    "ClothFoldShirt-Hard-v0": (
        "ClothFoldShirtHard",
        "Fold a T-shirt of another size and fabric in each episode, turned by any angle, in half, left over right.",
    ),
    "ClothFlatten-v0": (
        "ClothFlatten",
        "Spread a crumpled sheet on the floor with two grippers and release it.",
    ),
    "ClothFlatten-Hard-v0": (
        "ClothFlattenHard",
        "Spread a larger crumpled sheet, of a thinner fabric, on the floor with two grippers and release it.",
    ),
    "ClothFlattenShirt-v0": (
        "ClothFlattenShirt",
        "Spread a crumpled T-shirt on the floor with two grippers and release it.",
    ),
    "ClothFlattenShirt-Hard-v0": (
        "ClothFlattenShirtHard",
        "Spread a crumpled T-shirt on the floor and release it; each episode draws its size and fabric.",
    ),
    "ClothCanonicalize-v0": (
        "ClothCanonicalize",
        "Spread a crumpled T-shirt on the floor in its canonical pose: about the origin, front up, neck toward +y.",
    ),
    "ClothCanonicalize-Hard-v0": (
        "ClothCanonicalizeHard",
        "Spread a crumpled T-shirt in its canonical pose; each episode draws its size and fabric.",
    ),
    "ClothFling-v0": (
        "ClothFling",
        "Swing a crumpled sheet, held by two corners, and lay it flat on a table within three throws.",
    ),
    "ClothFling-Hard-v0": (
        "ClothFlingHard",
        "Swing a larger crumpled sheet, of a thinner fabric, and lay it flat on a table within three throws.",
    ),
}
# length of the longest episode of each id, in steps
LONGEST = {
    "ClothReach-v0": 40, "ClothDrape-v0": 145, "ClothDrapeGripper-v0": 160, "ClothStrain-v0": 150, "ClothFlatten-v0": 340,
    "ClothFlatten-Hard-v0": 360, "ClothFlattenShirt-v0": 680, "ClothFlattenShirt-Hard-v0": 680, "ClothCanonicalize-v0": 680,
    "ClothCanonicalize-Hard-v0": 680, "ClothFold-v0": 210,
    "ClothFold-Hard-v0": 280, "ClothFoldGoal-v0": 120, "ClothFoldGoal-Hard-v0": 150, "ClothFoldShirt-v0": 110,
    "ClothFoldShirt-Hard-v0": 130, "ClothHang-v0": 230, "ClothHang-Hard-v0": 280, "ClothHook-v0": 250, "ClothHook-Hard-v0": 310,
    "ClothFling-v0": 340, "ClothFling-Hard-v0": 360,
}  # fmt: skip
ACTORS = ("noop", "random", "expert")  # in every environment, in addition to policies of training runs


def register() -> None:
    """Register every id once; importing the package again, as worker processes do, changes nothing.

    ``max_episode_steps`` is one more than the longest episode takes: at exactly that length, Gymnasium's ``TimeLimit`` would also
    truncate an episode that is evaluated, and terminates, in its last step.
    """
    if ENVIRONMENTS.keys() != LONGEST.keys():
        raise RuntimeError(f"registration.LONGEST and ENVIRONMENTS differ in {sorted(ENVIRONMENTS.keys() ^ LONGEST.keys())}")
    for env_id, (name, _) in ENVIRONMENTS.items():
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point=f"clothgym.envs:{name}Env",
                vector_entry_point=f"clothgym.envs:{name}VectorEnv",
                max_episode_steps=LONGEST[env_id] + 1,
            )


def _look_here(module: str) -> None:
    """Make modules in the current folder importable; ``python -m clothgym`` finds them, but the command ``clothgym`` does not."""
    top, here = module.partition(".")[0], str(Path.cwd())
    if not sys.flags.safe_path and not {"", here} & set(sys.path) and top.isidentifier() and find_spec(top) is None:
        sys.path.append(here)


def checked_id(env_id: str) -> str:
    """A registered id whose environment is a ``ClothEnv``, as ``gym.make`` takes it, without the prefix "clothgym:".

    env_id: "ClothDrape-v0", "clothgym:ClothDrape-v0", or "module:Id-v0" for an id that importing the module registers.

    Raises:
        ValueError: no such id, or its environment is no ``ClothEnv``.
    """
    bare = env_id.removeprefix("clothgym:")
    module, _, name = bare.rpartition(":")
    if module:
        _look_here(module)
        try:
            import_module(module)
        except ImportError as error:
            raise ValueError(f"no environment {env_id!r}: {module!r} cannot be imported ({error})") from error
    if name not in gym.registry:
        near = difflib.get_close_matches(name, ENVIRONMENTS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        advice = 'a task of your own is registered with gym.register, and named "module:Id-v0"'
        raise ValueError(f"no environment {env_id!r}{hint} (there are: {', '.join(ENVIRONMENTS)}; {advice})")
    if name not in ENVIRONMENTS:
        from gymnasium.envs.registration import load_env_creator

        from clothgym.envs import ClothEnv

        entry = gym.spec(name).entry_point
        creator = load_env_creator(entry) if isinstance(entry, str) else entry
        if not (isinstance(creator, type) and issubclass(creator, ClothEnv)):
            ours = ", ".join(ENVIRONMENTS)
            raise ValueError(
                f"environment {env_id!r} is no clothgym environment ({ours}): its entry point must be a subclass of ClothEnv"
            )
    return bare


def actor_named(name: str, *others: str) -> str:
    """Check that a name is one of ``ACTORS`` or of the others, or an existing path; returns it.

    Raises:
        ValueError: neither; the message lists them.
    """
    if not Path(name).exists():
        known("policy", name, (*ACTORS, *others, "the folder of a training run"))
    return name

"""What the tasks' physics does to the cloth, true and with short cuts: sheets that intersect themselves, solids that poke through.

    python benchmarks/short_cuts.py            # what results/short_cuts.json lacks, and the table; some twenty minutes

For each environment and ``physics``, the scripted expert's episodes, and steps with random actions.  After each step the exact test
of ``clothgym.geometry.intersections``, on which self-collision does not depend, and ``Simulation.penetration``, the depth of the
deepest point of the sheet's triangles in a solid's true surface.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from cases import Row, fill, parsed

from clothgym.envs.physics import PHYSICS
from clothgym.geometry.intersections import count_intersections
from clothgym.registration import ENVIRONMENTS

RESULTS = Path(__file__).parent / "results" / "short_cuts.json"
EPISODES, RANDOM_STEPS, SEED = 100, 20_000, 1_000_000
ACTORS = ("expert", "random")
AT_ONCE = 20  # environments in a batch


def watched(env: str, physics: str, actor: str) -> Row:
    """Shares and depths over an actor's steps; ``success`` of the expert's episodes."""
    batch: Any = gym.make_vec(f"clothgym:{env}", num_envs=AT_ONCE, physics=physics).unwrapped
    batch.reset(seed=SEED)
    rng, task = np.random.default_rng(SEED), batch.task
    frames, crossed, deepest = 0, 0, 0.0
    successes: list[float] = []
    while len(successes) < EPISODES if actor == "expert" else frames < RANDOM_STEPS:
        random = rng.uniform(-1, 1, batch.action_space.shape)
        _, _, terminated, _, info = batch.step(batch.expert_actions() if actor == "expert" else random)
        successes += info["is_success"][terminated].tolist()
        # the step in which an environment is reset shows its new start
        crossed += int(np.count_nonzero(count_intersections(task.physics.mesh.triangles, task.simulation.positions)))
        deepest = max(deepest, float(task.simulation.penetration().max()))
        frames += AT_ONCE
    found = {"steps": frames, "intersecting": crossed / frames, "deepest": deepest / task.physics.side}
    return found | ({"success": float(np.mean(successes[:EPISODES]))} if actor == "expert" else {})


def main() -> None:
    args = parsed(__doc__)
    keys = [{"env": env, "physics": physics, "actor": actor} for env in ENVIRONMENTS for physics in PHYSICS for actor in ACTORS]
    rows = fill(RESULTS, {"rows": [(watched, key) for key in keys]}, args.select, args.fresh, {})["rows"]
    print("| environment | physics | actor | steps | intersecting | deepest, in sides | success |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for row in rows:
        success = f"{row['success']:.2f}" if "success" in row else ""
        print(
            f"| `{row['env']}` | {row['physics']} | {row['actor']} | {row['steps']:,} | {100 * row['intersecting']:.2f} % | "
            f"{100 * row['deepest']:.2f} % | {success} |"
        )


if __name__ == "__main__":
    main()

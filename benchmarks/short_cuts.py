"""What the tasks' physics does to the cloth, true and with short cuts: sheets that intersect themselves, solids that poke through.

    python benchmarks/short_cuts.py            # prints, and writes benchmarks/results/short_cuts.json; some twenty minutes

For each environment and ``physics``, the scripted expert's episodes, and steps with random actions.  After each step the exact test
of ``clothgym.geometry.intersections``, on which self-collision does not depend, and ``Simulation.penetration``, the depth of the
deepest point of the sheet's triangles in a solid's true surface.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from clothgym.envs.physics import PHYSICS
from clothgym.geometry.intersections import count_intersections
from clothgym.lab.bench import machine
from clothgym.registration import ENVIRONMENTS

RESULTS = Path(__file__).parent / "results" / "short_cuts.json"
EPISODES, RANDOM_STEPS, SEED = 100, 20_000, 1_000_000
ACTORS = ("expert", "random")
AT_ONCE = 20  # environments in a batch


def watched(env_id: str, physics: str, actor: str) -> dict[str, Any]:
    """Shares and depths over an actor's steps; ``success`` of the expert's episodes."""
    env: Any = gym.make_vec(f"clothgym:{env_id}", num_envs=AT_ONCE, physics=physics).unwrapped
    env.reset(seed=SEED)
    rng, task = np.random.default_rng(SEED), env.task
    frames, crossed, deepest = 0, 0, 0.0
    successes: list[float] = []
    while len(successes) < EPISODES if actor == "expert" else frames < RANDOM_STEPS:
        random = rng.uniform(-1, 1, env.action_space.shape)
        _, _, terminated, _, info = env.step(env.expert_actions() if actor == "expert" else random)
        successes += info["is_success"][terminated].tolist()
        # the step in which an environment is reset shows its new start
        crossed += int(np.count_nonzero(count_intersections(task.physics.mesh.triangles, task.simulation.positions)))
        deepest = max(deepest, float(task.simulation.penetration().max()))
        frames += AT_ONCE
    found = {"steps": frames, "intersecting": crossed / frames, "deepest": deepest / task.physics.side}
    return found | ({"success": float(np.mean(successes[:EPISODES]))} if actor == "expert" else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=tuple(ENVIRONMENTS), nargs="+", default=tuple(ENVIRONMENTS))
    parser.add_argument("--physics", choices=PHYSICS, nargs="+", default=PHYSICS)
    parser.add_argument("--actor", choices=ACTORS, nargs="+", default=ACTORS)
    wanted = parser.parse_args()
    known = json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else []
    rows = [
        row
        for row in known
        if row["env"] not in wanted.env or row["physics"] not in wanted.physics or row["actor"] not in wanted.actor
    ]
    cases = [(env, physics, actor) for env in wanted.env for physics in wanted.physics for actor in wanted.actor]
    for env_id, physics, actor in tqdm(cases, unit="row"):
        rows.append({"env": env_id, "physics": physics, "actor": actor, **watched(env_id, physics, actor)})
        RESULTS.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
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

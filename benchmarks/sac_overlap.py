"""Speed of training/sac_single_file.py while the environments step beside the updates, and one after the other.

    python benchmarks/sac_overlap.py             # writes benchmarks/results/sac_overlap.json

Both run in turn, three times; the table has medians.  The environments use one thread, and torch another one.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from cases import Case, Row, fill, parsed, table

sys.path.insert(0, str(Path(__file__).parent.parent / "training"))

RESULT = Path(__file__).parent / "results" / "sac_overlap.json"
TASKS = ("ClothReach-v0", "ClothFold-v0", "ClothDrapeGripper-v0")
BATCH_STEPS, FIRST, TIMES = 40, 12, 3  # those timed, those before, and how often
ABOUT = {
    "scene": "SAC from scratch, 32 environments with action_repeat=4, eight updates a step of the batch, control steps a second"
}


class Done:
    """Runs a call at once, in place of an executor that runs it in a thread."""

    def submit(self, call: Callable[[Any], Any], argument: Any) -> Done:
        self.given = call(argument)
        return self

    def result(self) -> Any:
        return self.given


def steps_a_second(env: str, overlaps: bool) -> float:
    """Control steps a second of a new run, after its first updates."""
    import sac_single_file

    kwargs = {"action_repeat": 4, "threads": 1} | ({} if env == "ClothReach-v0" else {"settling": "at_once"})
    config = {"env": env, "seed": 0, "threads": 1, "timesteps": 10**9, "curriculum": {}, "env_kwargs": kwargs}
    run = sac_single_file.Run(config | {"hyperparameters": asdict(sac_single_file.Options(random_decisions=256))}, None)
    if not overlaps:
        run.thread = Done()  # type: ignore[assignment]
    steps = run.steps()
    for _ in itertools.islice(steps, FIRST):
        pass
    begun = time.perf_counter()
    return sum(itertools.islice(steps, BATCH_STEPS)) / (time.perf_counter() - begun)


def measure(env: str) -> Row:
    """Both ways of one task."""
    found = [(steps_a_second(env, False), steps_a_second(env, True)) for _ in range(TIMES)]
    one, both = (median(values) for values in zip(*found))
    return {"one after the other": one, "at the same time": both, "ratio": median(b / a for a, b in found)}


def main() -> None:
    args = parsed(__doc__)
    cases: dict[str, list[Case]] = {"overlap": [(measure, {"env": env}) for env in TASKS]}
    results = fill(RESULT, cases, args.select, args.fresh, ABOUT)
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results["overlap"]))


if __name__ == "__main__":
    main()

"""Whether the ideal passes its own judge: sheets let down flat and centered on random targets of ClothDrape-v0.

    python benchmarks/flat_sheets.py            # prints a table, in some minutes

The task's sheet is let down on 200 targets of each shape from just above their highest points, settles and is evaluated.
fast, true: by the task's argument ``physics``.  doubled: true, and the sheet doubled over along its middle, which must not pass.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from clothgym.envs.draping import ENOUGH_CENTERING, ENOUGH_COVERAGE, ENOUGH_SPREAD
from clothgym.envs.draping import PHYSICS as OWN
from clothgym.envs.scoring import ENOUGH_REST
from clothgym.envs.targets import SHAPES, THICKNESS

TARGETS, SEED = 200, 0
SHEET, SIDE = OWN.mesh, OWN.side
PHYSICS = {"fast": "fast", "true": "true", "doubled": "true"}
APART = 4 * THICKNESS  # of the layers of a sheet that is doubled over [m]


def doubled_over() -> NDArray:
    """The sheet at rest, doubled over along its middle, about the axis [m], (particles, 3)."""
    x = SHEET.rest_positions.copy()
    over = x[:, 1] > 1e-9
    x[over] = x[over] * (1, -1, 1) + (0, 0, APART)
    return x + (0, SIDE / 4, 0)


def evaluated(shape: str, name: str) -> dict[str, NDArray]:
    """What the evaluation says of the sheets, (TARGETS,) each."""
    env = gym.make_vec("clothgym:ClothDrape-v0", num_envs=TARGETS, autoreset_mode="Disabled", physics=PHYSICS[name])
    env.reset(seed=SEED, options={"target": {"shape": shape}})
    sheet = doubled_over() if name == "doubled" else SHEET.rest_positions
    task = env.unwrapped.task
    task.simulation.reset(positions=np.array([sheet + target.top + (0, 0, 2 * THICKNESS) for target in task.targets]))
    task.simulation.release()
    # no episode fails, so all end together
    terminated = np.zeros(TARGETS, bool)
    while not terminated.any():
        *_, terminated, _, info = env.step(np.zeros((TARGETS, 8)))
    return info


def main() -> None:
    rows = [(name, shape) for name in PHYSICS for shape in SHAPES]
    results = [evaluated(shape, name) for name, shape in tqdm(rows, unit="row")]
    columns = ("passes", "covers", "flat", "central", "rests", "coverage", "spread")
    print(f"{'sheet':<10} {'target':<7} " + " ".join(f"{column:>8}" for column in columns))
    for (name, shape), info in zip(rows, results):
        shares = [
            np.mean(info["is_success"]),
            np.mean(info["coverage"] >= ENOUGH_COVERAGE * info["coverage_reference"]),
            np.mean(info["spread"] >= ENOUGH_SPREAD),
            np.mean(info["off_center"] <= ENOUGH_CENTERING),
            np.mean(info["rms_speed"] < ENOUGH_REST),
        ]
        shares += [np.median(info["coverage"]), np.median(info["spread"])]
        print(f"{name:<10} {shape:<7} " + " ".join(f"{share:>8.3f}" for share in shares))


if __name__ == "__main__":
    main()

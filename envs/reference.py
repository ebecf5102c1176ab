"""How sheets that lie on targets are judged, and the coverage that a sheet let down flat and centered reaches.

That reference is simulated with the whole sheet in contact, strict self-collision, rigidity and quadratic air, whatever physics a
task has.  The tasks' own cloths have committed tables (``benchmarks/drape_reference.py``).  That of another size or fabric is
simulated on first use, with fewer particles and targets, and kept with the compiled kernels.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym._jit.cache import cache_folder
from clothgym.collisions import Plane
from clothgym.envs.measures import count_layers
from clothgym.envs.physics import MEASURED, Physics
from clothgym.envs.targets import FRICTION, ON_FLOOR, SIZES, THICKNESS, Target
from clothgym.material import Material
from clothgym.mesh import grid
from clothgym.progress import clear, show
from clothgym.simulation import Simulation

EVALUATED_POINTS = 256
POKING = 0.002  # [m]: a point of the target that sticks out of the sheet by more is not covered
COVERED_WITHIN = 0.05  # in sides: cloth over a point covers it.  With 0.02 a flat sheet of 13 a side fails on boxes
# in sides: cloth over a point counts as a layer.  The bulge at a fold stands off by more than 0.05; with 0.1 to 0.25 a sheet that
# lies doubled over has two layers everywhere, and a flat one has one: its folds around a target do not reach the upper surface
LAYERS_WITHIN = 0.1

ACROSS = {"sphere": "none", "box": "yaws", "post": "heights"}  # parameters of the reference in addition to the width
ROWS, COUNTS = 25, (3, 3)  # of the sheet, and of widths and of yaws or heights, where it is simulated on first use
TIME_STEP, SETTLE, AIR_DRAG = 1 / 60, 4.0, 1.0  # [s], [s], [N s/m^3]
AT_ONCE = 8  # sheets in a batch


def limits(side: float) -> NDArray[np.float64]:
    """What ``count_layers`` takes [m], for a sheet of that side [m]."""
    return np.array([POKING, COVERED_WITHIN * side, LAYERS_WITHIN * side])


def layers_over(target: Target, x: NDArray, triangles: NDArray, side: float) -> NDArray[np.int64]:
    """Layers of a sheet, x [m], (particles, 3), over points of a target; 0 where it is not covered, (EVALUATED_POINTS,)."""
    points, normals = target.upper_surface(EVALUATED_POINTS), target.upper_normals(EVALUATED_POINTS)
    layers = np.zeros(len(points), np.int64)
    sheet, corners = np.ascontiguousarray(x.T, np.float64), np.ascontiguousarray(triangles, np.int64)
    count_layers(sheet, corners, points, normals, limits(side), layers)
    return layers


# --- a table of references ----------------------------------------------------------------------------------------------------


def cloth_of(physics: Physics) -> dict[str, float]:
    """Parameters of the reference: the sheet's side, the measured properties of its fabric, and contact with targets."""
    own = {name: getattr(physics.material, name) for name in MEASURED}
    return {"side": physics.side, **own, "friction": FRICTION, "thickness": THICKNESS}


def grid_of(shape: str, counts: Sequence[int]) -> tuple[list[float], list[float]]:
    """Widths [sides], and yaws [rad] or heights [sides], at which a target's reference is simulated."""
    (narrow, wide), heights = SIZES[shape]
    low, high = heights if heights else (0.0, math.pi / 4 if ACROSS[shape] == "yaws" else 0.0)
    others = np.linspace(low, high, counts[1] if high > low else 1)
    return np.linspace(narrow, wide, counts[0]).round(6).tolist(), others.round(6).tolist()


def target_of(shape: str, width: float, across: float, side: float) -> Target:
    """The target at one place of the table."""
    height = (across if ACROSS[shape] == "heights" else 2 * width) * side
    return Target(shape, width * side, height, (0.0, 0.0), across if ACROSS[shape] == "yaws" else 0.0)


def laid(targets: Sequence[Target], cloth: Mapping[str, float], rows: int) -> tuple[NDArray, NDArray, NDArray]:
    """Sheets let down flat and centered on targets, settled: [m], (targets, particles, 3); their triangles and rms speeds [m/s]."""
    side = cloth["side"]
    mesh, own = grid(rows, rows, side, side), {name: cloth[name] for name in MEASURED}
    fabric = Material(**own, air_drag=AIR_DRAG)  # type: ignore[arg-type]
    floor, solids = Plane(friction=FRICTION, thickness=ON_FLOOR), [target.collider(FRICTION, THICKNESS) for target in targets]
    simulation = Simulation(
        mesh, fabric, num_envs=len(targets), time_step=TIME_STEP, colliders=[floor, solids[0]],
        bending="quadratic", self_collision="strict", contact="sheet", threads=1,
    )  # fmt: skip
    simulation.set_collider(1, solids)
    simulation.reset(positions=np.array([mesh.rest_positions + (*t.center, t.height + 2 * THICKNESS) for t in targets]))
    simulation.step(round(SETTLE / TIME_STEP))
    speeds = np.sqrt(np.mean(np.sum(simulation.velocities.astype(float) ** 2, axis=2), axis=1))
    return simulation.positions.astype(float), mesh.triangles, speeds


def simulated(cloth: Mapping[str, float], rows: int, counts: Sequence[int]) -> dict[str, Any]:
    """A cloth's table, by shape: widths, yaws or heights, the coverage at each pair, and the largest rms speed at the end [m/s]."""
    table = {}
    for shape in SIZES:
        widths, across = grid_of(shape, counts)
        targets = [target_of(shape, width, other, cloth["side"]) for width in widths for other in across]
        coverage, fastest = [], 0.0
        for first in range(0, len(targets), AT_ONCE):
            show(f"of the reference on a {shape}", first, len(targets))
            some = targets[first : first + AT_ONCE]
            sheets, triangles, speeds = laid(some, cloth, rows)
            coverage += [float(np.mean(layers_over(t, x, triangles, cloth["side"]) > 0)) for t, x in zip(some, sheets)]
            fastest = max(fastest, float(speeds.max()))
        rounded = np.array(coverage).reshape(len(widths), len(across)).round(4).tolist()
        table[shape] = {"widths": widths, ACROSS[shape]: across, "coverage": rounded, "rms_speed": round(fastest, 4)}
    clear()
    return table


@cache
def _table(cloth: str) -> dict[str, Any]:
    """The table of a cloth, described in JSON: the committed one; or what this user has simulated before; or simulated now."""
    committed = json.loads(resources.files("clothgym.envs").joinpath("drape_reference.json").read_text())
    for known in committed["cloths"]:
        if json.dumps(known["cloth"], sort_keys=True) == cloth:
            return known["shapes"]
    folder, name = cache_folder(), hashlib.sha256(cloth.encode()).hexdigest()[:16]
    path = folder.path / f"{name}.reference"
    with contextlib.suppress(OSError):
        if (kept := folder.read(path)) is not None:
            return json.loads(bytes(kept))
    where = f", kept in {folder.path}" if folder.writable else ""
    print(f"clothgym: simulating what this cloth can cover (once, some ten seconds){where}", file=sys.stderr, flush=True)
    table = simulated(json.loads(cloth), ROWS, COUNTS)
    if folder.writable:
        with contextlib.suppress(OSError):
            folder.write(path, json.dumps(table).encode())
    return table


def reference_coverage(target: Target, physics: Physics) -> float:
    """Coverage that a sheet of a task's cloth, let down flat and centered, reaches on this target: the ideal of the task.

    Bilinear in the table over width and yaw or height; beyond the table its edge holds.
    """
    table = _table(json.dumps(cloth_of(physics), sort_keys=True))[target.shape]
    side, across = physics.side, ACROSS[target.shape]
    other = {"none": 0.0, "yaws": abs(target.yaw), "heights": target.height / side}[across]
    by_width = [float(np.interp(other, table[across], row)) for row in table["coverage"]]
    return float(np.interp(target.radius / side, table["widths"], by_width))

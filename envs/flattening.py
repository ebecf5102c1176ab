"""What the tasks share that score how much of the floor a sheet covers: the measure after each step, the potential, the judge."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from clothgym._jit import inlined
from clothgym.envs.coverage import CELL, FINE_CELL, covered_area, softgym_area
from clothgym.envs.definition import VELOCITY_BOUND, Observation
from clothgym.envs.episode import Fields
from clothgym.envs.manipulation import ManipulationTask, follow, observe_grippers
from clothgym.envs.measures import FINITE, SPEED2, STRETCH2, squared_distance
from clothgym.envs.taking import beside_corners

HOLDING = 0.1  # share of the potential that is for holding the sheet
HOLD_SCALE = 0.15  # in sides: how that rises as a gripper nears the sheet
ENOUGH_REST = 0.02  # [m/s]
FLAT_ALREADY = 0.99  # coverage of which there is nothing to improve
SANE_STRETCH2 = 4.0  # squared stretch at which a sheet is torn
# heights of a gripper, in sides, above which it has lifted a corner alone, and an edge, high enough
LIFTED = (0.9, 1.17)


@inlined
def improvement(coverage, start):
    """Normalized improvement: share of what was not covered at the start that is covered now, in [0, 1]."""
    if coverage >= FLAT_ALREADY:
        return 1.0
    return 0.0 if start >= FLAT_ALREADY else min(max((coverage - start) / (1 - start), 0.0), 1.0)


@inlined
def measure_coverage(own, rules, sheet):
    """Grips; how high each gripper has been since it took hold; and the coverage, on the coarser grid but for the start."""
    for k in range(sheet.holds.shape[0]):
        own.raised[k] = max(own.raised[k], sheet.attachments[k, 2]) if sheet.holds[k] > 0 else 0.0
    # a sheet that has failed keeps the last one
    if sheet.summary[FINITE] > 0 and sheet.summary[STRETCH2] <= SANE_STRETCH2 and not own.over:
        cell = FINE_CELL if own.step == 0 else CELL
        own.coverage = min(covered_area(sheet.x, sheet.mesh.triangles, cell) / rules.flat_area, 1.0)
        if own.step == 0:
            own.coverage_start = own.coverage


@inlined
def spread_potential(own, rules, sheet):
    """Coverage, and for each gripper 1 if it holds cloth, else at most a half as it nears it."""
    held = 0.0
    for k in range(sheet.holds.shape[0]):
        if sheet.holds[k] > 0:
            held += 1.0
            continue
        nearest = np.inf
        for p in range(sheet.x.shape[1]):
            nearest = min(nearest, squared_distance(sheet.x[:, p], sheet.attachments[k]))
        held += 0.5 / (1 + (np.sqrt(nearest) / (HOLD_SCALE * rules.side)) ** 2)
    return HOLDING * held / sheet.holds.shape[0] + (1 - HOLDING) * own.coverage


@inlined
def evaluate_spread(own, rules, sheet, info):
    """Write how much the sheet covers, and how much at rest it is; returns the normalized improvement."""
    info.coverage = min(covered_area(sheet.x, sheet.mesh.triangles, FINE_CELL) / rules.flat_area, 1.0)
    info.softgym_coverage = softgym_area(sheet.x, rules.particle_radius) / rules.flat_area
    info.rms_speed = np.sqrt(sheet.summary[SPEED2])
    let_go = True
    for k in range(sheet.holds.shape[0]):
        let_go = let_go and sheet.holds[k] == 0
    info.is_success = info.coverage >= rules.enough and info.rms_speed < ENOUGH_REST and let_go
    return improvement(info.coverage, own.coverage_start)


@inlined
def account_spread(own, rules, sheet, info, terms, running, failure):
    """Coverage now and at the start, and what has become of a success; no reward terms."""
    info.coverage, info.coverage_start = own.coverage, own.coverage_start
    score = improvement(own.coverage, own.coverage_start)
    follow(own, info, score, own.coverage >= rules.enough, running, failure)
    return 0.0


@inlined
def observe_spread(own, rules, sheet, seen):
    """Grippers, time, coverage, and how fast the sheet moves."""
    observe_grippers(own, rules, sheet, seen)
    seen.coverage, seen.speed = own.coverage, np.sqrt(sheet.summary[SPEED2])


class SpreadingTask(ManipulationTask):
    """Base of the tasks that end with a sheet spread on the floor.

    Attributes:
        enough: coverage of a success.
    """

    enough: ClassVar[float]
    evaluation = (("softgym_coverage", float), ("rms_speed", float))
    accounts: ClassVar[Fields] = (*ManipulationTask.accounts, ("coverage", float), ("coverage_start", float))
    observations: ClassVar[tuple[Observation, ...]] = (
        *ManipulationTask.observations,
        Observation("coverage", "share of the sheet's area that it covers"),
        Observation("speed", "rms speed of the sheet", (), "m/s", VELOCITY_BOUND),
    )
    ranges: ClassVar = {
        **ManipulationTask.ranges, "coverage": (0.0, 1.0), "coverage_start": (0.0, 1.0), "raised": (0.0, 10.0),
    }  # fmt: skip

    def remembers(self) -> Fields:
        grippers = len(self.physics.grippers)
        return [*super().remembers(), ("coverage", float), ("coverage_start", float), ("raised", float, grippers)]

    def constants(self) -> dict[str, Any]:
        mesh = self.physics.mesh
        own = {"flat_area": mesh.size[0] * mesh.size[1], "particle_radius": max(mesh.spacing), "enough": self.enough}
        taken = {"corners": np.array(mesh.corners), "beside_corners": beside_corners(mesh), "columns": mesh.grid_shape[1]}
        return super().constants() | own | taken

"""One scene, several integrators: the cost of each, and its distance from the converged solution.

The reference is the same sheet with the same material, solved by ``rk4`` in float64 with many substeps.  A run with half as many
shows how well it has converged.  Errors are root-mean-square distances of particles at the end of the scene.  A cost is the
processor time of one thread, the median of several control steps.  The integrators take turns, so that disturbances affect all
alike.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clothgym import files, progress
from clothgym.guards import BURST
from clothgym.lab import compare_pictures
from clothgym.lab.bench import machine
from clothgym.lab.compare_plan import LANES, Plan, Row, Setting, described, sheet_name
from clothgym.lab.compare_plan import plan as plan
from clothgym.lab.compare_scenes import FRAME, SCENES, Scene
from clothgym.simulation import Simulation

VERSION = 1  # of the format of files
SHREDDED = 2.0  # strain of a yarn at which the sheet of an unstable run is pictured
VISITS, AT_LEAST, ENOUGH = 7, 3, 0.5  # timed control steps of each setting; the fewest, once they have taken this long [s]


# --- one setting --------------------------------------------------------------------------------------------------------


def rms_mm(a: NDArray, b: NDArray) -> float:
    """Root-mean-square distance of particles [mm].  a, b: positions [m], (particles, 3)."""
    return float(1e3 * np.sqrt(np.mean(np.sum((a.astype(np.float64) - b) ** 2, axis=1))))


def angular_momentum(s: Simulation) -> NDArray:
    """Angular momentum about the center of mass [kg m^2/s], (3,)."""
    state = s.get_state()
    mass = 1 / state.free_inverse_mass[0].astype(np.float64)
    x, v = (a[0].astype(np.float64) - np.average(a[0], axis=0, weights=mass) for a in (state.positions, state.velocities))
    return np.sum(mass[:, None] * np.cross(x, v), axis=0)


def reference(scene: Scene) -> tuple[NDArray, Row]:
    """The converged sheet [m], (particles, 3), and a description of the run."""
    ends = []
    for substeps in (scene.reference_substeps // 2, scene.reference_substeps):
        s = scene.simulation("rk4", substeps, dtype="float64")
        s.step(scene.frames)
        ends.append(s.positions[0])
    about = {"integrator": "rk4", "dtype": "float64", "substeps": scene.reference_substeps, "seconds": scene.seconds}
    return ends[1], about | {"half_substeps_mm": rms_mm(*ends), "largest_strain": float(s.strain().max())}


def measure(scene: Scene, setting: Setting, truth: NDArray, about: Row) -> tuple[Row, NDArray | None]:
    """A row of the table without costs, and the final sheet [m], (particles, 3), or None if the run was unstable."""
    s = setting.simulation(scene)
    largest, _ = s.largest_substep()
    row: Row = setting._asdict() | {
        "options": dict(setting.options),
        "consistent": s.integrator.order is not None,
        "auto_substeps": s.integrator.automatic_substeps(FRAME, largest) if largest > 0 else None,
    }
    energy, momentum = s.energy().total[0], angular_momentum(s)
    for _ in range(scene.frames):
        s.step()
        if s.diverged[0]:
            return row | {"stable": False}, None
    strain = float(s.strain().max())
    if strain > BURST:
        return row | {"stable": False}, None
    row |= {"stable": True, "error_mm": rms_mm(s.positions[0], truth), "largest_strain": strain}
    if scene.settled:
        row["strain_error"] = strain / about["largest_strain"] - 1
    if scene.conserves:
        row["energy_kept"] = float(s.energy().total[0] / energy)
        row["spin_kept"] = float(angular_momentum(s) @ momentum / (momentum @ momentum))
    return row, s.positions[0]


def shreds(scene: Scene, setting: Setting) -> NDArray:
    """The sheet of an unstable run when a yarn is first stretched by ``SHREDDED`` [m], (particles, 3); soon it is out of sight."""
    s = setting.in_substeps(scene)
    for _ in range(scene.frames * setting.substeps):
        s.step()
        if s.diverged[0] or s.strain().max() > SHREDDED:
            break
    return s.positions[0]


def costs(scene: Scene, settings: Sequence[Setting], num_envs: int) -> list[float]:
    """Median time of a control step of each setting's batch [s].  The batches take turns."""
    batches = [setting.simulation(scene, num_envs) for setting in settings]
    times: list[list[float]] = [[] for _ in batches]
    for s in batches:
        s.step()
    for visit in range(VISITS):
        for s, taken in zip(batches, times):
            if visit < AT_LEAST or sum(taken) < ENOUGH:
                begun = time.thread_time()  # processor time excludes other work of the machine
                s.step()
                taken.append(time.thread_time() - begun)
    return [statistics.median(taken) for taken in times]


def add_costs(scene: Scene, rows: Sequence[Row]) -> None:
    """Measure the costs of these rows together, and add them to the rows."""
    settings = [Setting(*(row[name] for name in Setting._fields)) for row in rows]
    together, alone = costs(scene, settings, LANES), costs(scene, settings, 1)
    for row, setting, batch, single in zip(rows, settings, together, alone):
        s = setting.simulation(scene)
        passes = setting.substeps * (1 if setting.integrator == "implicit_euler" else setting.options.get("iterations", 1))
        elements = s.view.springs.kind.size + s.bending.hinged * scene.mesh.hinges.weight.size
        row |= {
            "ms_batch": 1e3 * batch / (LANES * FRAME),
            "ms_alone": 1e3 * single / FRAME,
            "ns_per_element": 1e9 * batch / (LANES * passes * elements),
        }


# --- all of them --------------------------------------------------------------------------------------------------------


class Record:
    """The results in a folder.  They are written after each row, and the next run reads them."""

    def __init__(self, folder: Path, scene: Scene, fresh: bool) -> None:
        self.path, self.sheets_path = folder / "results.json", folder / "sheets.npz"
        folder.mkdir(parents=True, exist_ok=True)
        self.results: Row = {
            "machine": machine(),
            "scene": json.loads(json.dumps(dataclasses.asdict(scene))),
            "reference": None,
            "rows": [],
        }
        self.sheets: dict[str, NDArray] = {}
        if fresh or not (self.path.exists() and self.sheets_path.exists()):
            return
        try:
            earlier = files.read_json(self.path, "comparison", "it is measured again")
            sheets = files.read_arrays(self.sheets_path, "comparison", VERSION, "it is measured again")
        except ValueError as error:
            print(error, file=sys.stderr)
            return
        # rows of another machine, version or scene cannot be compared
        here = [(r["scene"], {k: v for k, v in r["machine"].items() if k != "date"}) for r in (earlier, self.results)]
        if here[0] != here[1]:
            print(f"{self.path} is of another scene, version or machine: measuring again", file=sys.stderr)
            return
        self.results, self.sheets = earlier, sheets

    def find(self, setting: Setting) -> Row | None:
        return next((row for row in self.results["rows"] if setting.matches(row)), None)

    def write(self) -> None:
        """Write the sheets first, so that each written row has its sheet."""
        files.write_arrays(self.sheets_path, "comparison", VERSION, self.sheets)
        files.write_json(self.path, self.results)


def run(plan: Plan, folder: Path, fresh: bool = False) -> Row:
    """Measure the rows that the folder lacks, draw the pictures, and return the results.

    Raises:
        ImportError: matplotlib is missing; nothing has been measured.
    """
    compare_pictures.pyplot()
    scene, settings, shown = plan.scene, plan.settings(), plan.shown()
    record = Record(folder, scene, fresh)
    if record.results["reference"] is None:
        progress.show(f"{scene.name}: converging the reference")
        record.sheets["reference"], record.results["reference"] = reference(scene)
        record.write()
    for place, setting in enumerate(settings):
        if record.find(setting) is None:
            progress.show(f"{scene.name}: error of {sheet_name(setting)}", place, len(settings))
            row, sheet = measure(scene, setting, record.sheets["reference"], record.results["reference"])
            if setting in shown:
                record.sheets[sheet_name(setting)] = shreds(scene, setting) if sheet is None else sheet
            record.results["rows"].append(row)
            record.write()
    rows = [row for row in map(record.find, settings) if row is not None]
    groups = list(_to_be_timed(rows))
    for place, group in enumerate(groups):
        progress.show(f"{scene.name}: cost of {len(group)} settings with {group[0]['substeps']} substeps", place, len(groups))
        add_costs(scene, group)
        record.write()
    progress.clear()
    results = record.results | {"rows": rows}
    files.write(folder / "table.txt", table(results) + "\n")
    compare_pictures.draw_work_precision(results, folder / "work_precision.png")
    pictured = [(setting, record.find(setting) or {}, record.sheets.get(sheet_name(setting))) for setting in shown]
    compare_pictures.draw_sheets(scene, record.sheets["reference"], pictured, folder / "sheets.png")
    return results


def _to_be_timed(rows: Sequence[Row]) -> Iterator[list[Row]]:
    """Stable rows without costs, in groups with the same substeps."""
    for substeps in sorted({row["substeps"] for row in rows}):
        group = [row for row in rows if row["substeps"] == substeps and row["stable"] and "ms_batch" not in row]
        if group:
            yield group


# --- as text ------------------------------------------------------------------------------------------------------------

COLUMNS = {
    "error_mm": ("error mm", "{:.3g}", 1),
    "largest_strain": ("strain %", "{:.1f}", 100),
    "strain_error": ("its error %", "{:+.1f}", 100),
    "energy_kept": ("energy kept %", "{:.1f}", 100),
    "spin_kept": ("spin kept %", "{:.1f}", 100),
    "ms_batch": ("ms/s batch", "{:.3g}", 1),
    "ms_alone": ("ms/s alone", "{:.3g}", 1),
    "ns_per_element": ("ns/element", "{:.2f}", 1),
}


def table(results: Row) -> str:
    """The rows as text."""
    about, scene, rows = results["reference"], results["scene"], results["rows"]
    columns = {key: column for key, column in COLUMNS.items() if any(key in row for row in rows)}
    lines = [["integrator", "options", "substeps", "auto", "stable", *(title for title, _, _ in columns.values())]]
    for row in rows:
        cells = [
            row["integrator"],
            described(row["options"], row["variant"]),
            str(row["substeps"]),
            str(row["auto_substeps"] or "none"),
        ]
        cells.append(("yes" if row["consistent"] else "inconsistent") if row["stable"] else "NO")
        lines.append(cells + [form.format(scale * row[key]) if key in row else "-" for key, (_, form, scale) in columns.items()])
    widths = [max(map(len, column)) for column in zip(*lines)]
    text = ["  ".join(c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths))) for line in lines]
    return "\n".join(
        [
            f"{scene['name']}: {scene['breaks']}.",
            f"Reference: {about['integrator']} in {about['dtype']} with {about['substeps']} substeps of a 1/60 s step "
            f"({about['half_substeps_mm']:.1g} mm from half as many) after {about['seconds']:g} s; largest strain "
            f"{100 * about['largest_strain']:.1f} %.",
            f"auto: substeps by the method's own bound.  ms/s: processor time per simulated second of a sheet, one of {LANES} or "
            "alone.",
            "ns/element: per spring or hinge, substep and iteration (implicit_euler: substep), in the batch.",
            results["machine"]["processor"] + ", " + results["machine"]["date"],
            "",
            *text,
        ]
    )


def scene_list() -> str:
    """Names and descriptions of the scenes, one on each line."""
    return "\n".join(f"{name:<14} {scene.breaks}" for name, scene in SCENES.items())

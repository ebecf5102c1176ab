"""What ``cloth.js`` needs of a simulation to take the same steps: numbers of its fabric, its springs, its solids and its start.

python docs/demo/sheet.py          # writes docs/demo/sheet.js, the sheet of the page
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import Material, Plane, Simulation, Sphere, grid
from clothgym.collisions.solids.shapes import (
    KIND_PLANE,
    R_AXES,
    R_FRICTION,
    R_HALF,
    R_POINT,
    R_RADIUS,
    R_REACH2,
)

FILE = Path(__file__).parent / "sheet.js"
PIN_SPEED = 6.0  # of what is held on the page [m/s]
MOST_VALUES = 256  # different numbers of an array that a byte can name
SIDE, ROWS, AIR_DRAG = 1.0, 33, 0.2  # of the page's sheet: side [m], particles a side, and drag [1/s]
FABRICS = {"penava_cotton": "Cotton", "silk": "Silk", "wool": "Wool", "knit": "Knit"}
BALL = Sphere(center=(0, 0, 0.35), radius=0.22)


def sheet_of(simulation: Simulation) -> dict[str, Any]:
    """The numbers of a simulation of one sheet, as JSON has them.

    Raises:
        ValueError: it is not of the sort that ``cloth.js`` computes.
    """
    kind, bending, contact = simulation.layout.kind, simulation.bending.name, simulation.contact
    methods = {"semi_implicit_euler": False, "explicit_euler": True}
    if (kind, bending, contact) != ("grid", "quadratic", "particles") or simulation.integrator.name not in methods:
        raise ValueError(
            f"a {kind} with bending={bending!r}, contact={contact!r} and {simulation.integrator.name}: cloth.js has grids, "
            "'quadratic', 'particles', and explicit or semi-implicit Euler"
        )
    simulation._prepare()
    elements, air = simulation._topology.elements, simulation._topology.air
    fabric, schedule = simulation._fabric, simulation._schedule
    rows, cols = simulation.mesh.grid_shape
    return {
        "rows": rows,
        "cols": cols,
        "explicit": methods[simulation.integrator.name],
        "time_step": simulation.time_step,
        "substeps": simulation.substeps,
        "h": float(schedule.h),
        "air_every": schedule.air_every,
        "offset": elements.offset.tolist(),
        "stiffness": fabric.stiffness[0, elements.stiffness, 0].tolist(),
        "rest_length": elements.rest_length.tolist(),
        "weight": [packed(row) for row in elements.weight],
        "curve": [packed(row) for row in elements.curve],
        "rigidity": float(fabric.rigidity[0, 0]),
        "damping_time": float(fabric.damping_time[0, 0]),
        "drag_rate": float(fabric.drag_rate[0, 0]),
        "gravity": fabric.gravity[0, :, 0].tolist(),
        "wind": fabric.wind[0, :, 0].tolist(),
        "resistance": fabric.resistance[0, :, 0].tolist(),
        "even": packed(air.even),
        "shares": [packed(row) for row in air.shares],
        "area": float(air.area[0]),
        "inverse_mass": packed(simulation._free_w[0, :, 0]),
        "pin_speed": float(simulation._attachments.limits[0, 0]) if len(simulation.anchors) else PIN_SPEED,
        "solids": [_solid(*pair) for pair in zip(simulation._solids.shapes.kinds, simulation._solids.rows[0, :, :, 0])],
        "positions": simulation.positions[0].ravel().tolist(),
    }


def packed(row: ArrayLike) -> dict[str, Any]:
    """An array of few different numbers, as these and an index of a byte for each."""
    values, index = np.unique(np.asarray(row), return_inverse=True)
    if len(values) == 1:
        return {"values": values.tolist()}
    if len(values) > MOST_VALUES:
        raise ValueError(f"{len(values)} different numbers: a byte names {MOST_VALUES}")
    return {"values": values.tolist(), "index": base64.b64encode(index.astype(np.uint8).tobytes()).decode()}


def _solid(kind: int, rows: NDArray) -> dict[str, Any]:
    return {
        "plane": bool(kind == KIND_PLANE),
        "point": rows[R_POINT : R_POINT + 3].tolist(),
        "axes": rows[R_AXES : R_AXES + 9].tolist(),
        "half": rows[R_HALF : R_HALF + 3].tolist(),
        "radius": float(rows[R_RADIUS]),
        "reach2": float(rows[R_REACH2]),
        "friction": float(rows[R_FRICTION]),
    }


def written(rows: int) -> str:
    """The file for a sheet of so many particles along a side, in the fabrics of the page."""
    sheets = {}
    for name in FABRICS:
        mesh, fabric = grid(rows, rows, SIDE, SIDE), Material.preset(name, air_drag=AIR_DRAG)
        solids = [Plane(friction=0.5), BALL]
        sheets[name] = sheet_of(Simulation(mesh, fabric, colliders=solids, bending="quadratic", contact="particles"))
        del sheets[name]["positions"]  # the page has starts of its own
    # what all have in common, once
    first = next(iter(sheets.values()))
    common = {key: value for key, value in first.items() if all(sheet[key] == value for sheet in sheets.values())}
    own = {
        name: {"title": FABRICS[name]} | {key: sheet[key] for key in sheet if key not in common} for name, sheet in sheets.items()
    }
    return f"const SHEETS = {json.dumps({'common': {'side': SIDE} | common, 'fabrics': own}, separators=(',', ':'))};\n"


def main() -> None:
    FILE.write_text(written(ROWS))
    print(f"{FILE.name}: {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

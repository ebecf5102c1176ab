"""The demo's sheet, docs/demo/cloth.js, takes the core's steps, bit for bit: run under node, compared as integers."""

import importlib.util
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from clothgym import Box, Material, Plane, Simulation, Sphere, grid

DEMO = Path(__file__).parent.parent / "docs" / "demo"
STEPS = 300
# positions and velocities after some steps, with one pin that goes around and one that is released
RUN = """
const { Cloth } = require(process.argv[1]);
const { sheet, path, released } = JSON.parse(require("fs").readFileSync(0, "utf8"));
const cloth = new Cloth(sheet);
cloth.pin(0, path[0]);
cloth.pin(sheet.cols - 1, sheet.start);
path.forEach((target, k) => {
  cloth.pin(0, target);
  if (k === released) cloth.release(sheet.cols - 1);
  cloth.step();
});
const bits = [...cloth.x, ...cloth.v].map((row) => Array.from(new Uint32Array(row.buffer)));
console.log(JSON.stringify(bits));
"""


def sheet_script():
    spec = importlib.util.spec_from_file_location("sheet", DEMO / "sheet.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize("method", ["semi_implicit_euler", "explicit_euler"])
def test_the_sheet_of_the_page_has_the_bits_of_the_core(method):
    mesh = grid(9, 9, 0.5, 0.5)
    solids = [Plane(point=(0, 0, -0.35), friction=0.4), Sphere(center=(0.1, 0.1, -0.15), radius=0.12)]
    solids.append(Box(center=(-0.2, -0.1, -0.3), half_sides=(0.1, 0.08, 0.12), rotation=(0.9, 0.1, 0.3, 0.3), friction=0.2))
    options = {
        "bending": "quadratic",
        "contact": "particles",
        "wind": (1.5, 0.5, 0.2),
        "integrator": method,
        "on_divergence": "ignore",
    }
    fabric = Material.preset("penava_cotton", air_drag=0.3)
    simulation = Simulation(mesh, fabric, anchors=[0, 8], colliders=solids, time_step=1 / 60, **options)
    assert simulation.substeps > 2
    sheet = sheet_script().sheet_of(simulation)
    start = simulation.positions[0, 8].tolist()
    angles = np.linspace(0, 3, STEPS)
    path = simulation.positions[0, 0] + 0.3 * np.stack([np.sin(angles), np.cos(angles) - 1, -np.sin(angles)], axis=1)
    given = json.dumps({"sheet": sheet | {"start": start}, "path": path.tolist(), "released": 60})
    run = subprocess.run(["node", "-e", RUN, DEMO / "cloth.js"], input=given, capture_output=True, text=True, check=True)
    for step, target in enumerate(path):
        if step == 60:
            simulation.release(anchors=[1])
        simulation.move_anchors([target, start])
        simulation.step()
    expected = np.concatenate([simulation.positions[0].T, simulation.velocities[0].T]).astype(np.float32)
    assert np.ptp(expected[2]) > 0.2 and np.isfinite(expected).all()
    assert np.array_equal(np.array(json.loads(run.stdout), np.uint32), expected.view(np.uint32))

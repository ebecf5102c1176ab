"""A half-meter sheet falls 5 cm onto its edge, in MuJoCo 4 and in clothgym: frames per second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from clothgym.lab.bench_table import beat
from clothgym.material import Material
from clothgym.mesh import grid
from clothgym.starts import EdgeDrop

FRAME, ROWS, SIDE, SECONDS, DROP, THIN = 1 / 60, 25, 0.5, 2.0, 0.05, 0.004
COTTON = Material.preset("penava_cotton")
YOUNG, POISSON, SHEET_THICKNESS = 0.821e6, 0.243, 0.318e-3  # from the source of the preset: [Pa], [m]


def mujoco_model(contact: str, steps: int) -> Any:
    """The scene with MuJoCo's ``ipc`` contacts or its ordinary ones, with ``steps`` steps per frame."""
    import mujoco

    spacing = SIDE / (ROWS - 1)
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco>
          <size memory="200M"/>
          <option timestep="{FRAME / steps!r}" integrator="discrete" solver="Newton" gravity="0 0 -9.81">
            <flag ipc="{"enable" if contact == "ipc" else "disable"}"/>
          </option>
          <worldbody>
            <geom type="plane" size="2 2 0.1"/>
            <flexcomp name="sheet" type="grid" dim="2" count="{ROWS} {ROWS} 1" spacing="{spacing!r} {spacing!r} 1"
                      radius="{THIN / 2!r}" pos="0 0 {SIDE / 2 + DROP!r}" euler="88 0 0">
              <contact selfcollide="auto"/>
              <elasticity young="{YOUNG!r}" poisson="{POISSON!r}" thickness="{SHEET_THICKNESS!r}" damping="{COTTON.damping_time!r}"
                          elastic2d="both"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    for body in spec.bodies[1:]:
        borders = int(np.sum(np.isclose(np.abs(body.pos[:2]), SIDE / 2)))
        body.mass = COTTON.density * spacing**2 / 2**borders
    return spec.compile()


def start_of(model: Any) -> Any:
    """Initial data, with a slightly uneven sheet."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] += np.random.default_rng(0).normal(scale=2e-5, size=model.nq)
    mujoco.mj_forward(model, data)
    return data


def measure_mujoco(contact: str, steps: int, seconds: float = SECONDS) -> float:
    """Frames/s of one sheet on one core."""
    import mujoco

    model = mujoco_model(contact, steps)
    data = start_of(model)
    return 1 / _mean_seconds(f"MuJoCo, {contact}, {steps} a frame", lambda: mujoco.mj_step(model, data, nstep=steps), seconds)


def measure_ours(lanes: int, seconds: float = SECONDS) -> float:
    """Frames/s of a batch in strict mode on one core."""
    contact = {"mode": "strict", "thickness": THIN}
    maneuver = EdgeDrop(grid(ROWS, ROWS, SIDE, SIDE), COTTON, range(lanes), THIN, self_collision=contact, threads=1)
    simulation = maneuver.simulation
    simulation.step()  # loads compiled code
    simulation.reset(positions=maneuver.start - (0, 0, 0.1 * SIDE - DROP))
    return lanes / _mean_seconds(f"falling, {lanes}", simulation.step, seconds)


def _mean_seconds(name: str, frame: Callable[[], object], seconds: float) -> float:
    """Mean processor time of a frame [s], over ``seconds`` of simulated time."""
    count, total = round(seconds / FRAME), 0.0
    for k in range(count):
        begun = time.thread_time()
        frame()
        total += time.thread_time() - begun
        beat(f"{name}: frame {k + 1} of {count}")
    return total / count

"""Floor 5: half of a cold start in a process of its own: what a simulation needs besides contact of the sheet with itself.

Kernels are compiled once for each user and machine, a minute of work for one processor.  Two halves hardly depend on each other:
contact of the sheet with itself, and the rest.  ``start`` runs a process that compiles the rest, by taking a step of a small sheet
with the same integrator, bending, solids and attachments, while its caller compiles self-contact.  The locks of the cache prevent
both from compiling the same kernel, and the caller loads finished kernels.

``CLOTHGYM_COMPILE_PROCESSES=1`` keeps all in one process.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from clothgym import _jit

PROCESSES = "CLOTHGYM_COMPILE_PROCESSES"
_started: list[dict[str, Any]] = []  # scenes whose kernels this process has another compile


def start(scene: dict[str, Any]) -> None:
    """Compile what a scene needs in another process, unless there is one processor or this is that process; see ``run``."""
    wanted = os.environ.get(PROCESSES, "2")
    able = sys.executable and not getattr(sys, "frozen", False) and not _jit.WITHOUT_JIT and _jit.default_threads() > 1
    if wanted == "1" or _started or not able:
        return
    with _jit.cache_folder().only_one("ahead") as alone:
        if not alone:
            return
    paths = filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")])
    surroundings = os.environ | {PROCESSES: "1", "PYTHONPATH": os.pathsep.join(paths)}
    command, quiet = [sys.executable, "-m", "clothgym.ahead", json.dumps(scene)], subprocess.DEVNULL
    # where no more processes are allowed the caller compiles all
    with contextlib.suppress(OSError):
        child = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, env=surroundings)
        threading.Thread(target=child.wait, daemon=True).start()
        _started.append(scene)


def run(scene: dict[str, Any]) -> None:
    """Compile what a scene needs, if no other process does so: by a step of a small sheet like it.

    scene: keywords of ``Simulation`` that are numbers and strings; ``grid``: whether its mesh is one; ``solids``: whether some are
    not planes, None for none; ``anchors``, ``grippers``: whether there are any.
    """
    from clothgym.attachments import Gripper
    from clothgym.collisions import Plane, Sphere
    from clothgym.mesh import grid
    from clothgym.simulation import Simulation
    from clothgym.triangles import triangle_mesh

    mesh = grid(5, 5, 0.4, 0.4)
    if not scene.pop("grid"):
        mesh = triangle_mesh(mesh.rest_positions, mesh.triangles)
    solids, anchored, gripping = scene.pop("solids"), scene.pop("anchors"), scene.pop("grippers")
    floor, ball = Plane(point=(0, 0, -1)), Sphere(center=(0, 0, -2), radius=0.5)
    with _jit.cache_folder().only_one("ahead") as alone:
        if alone:
            Simulation(
                mesh,
                colliders=[] if solids is None else ([floor, ball] if solids else [floor]),
                anchors=[0] if anchored else [],
                grippers=[Gripper()] if gripping else [],
                **scene,
            ).step()


if __name__ == "__main__":
    run(json.loads(sys.argv[1]))

"""Half of a cold start in another process: it compiles what a scene needs, for the same types."""

import json
import subprocess
from typing import ClassVar

import pytest

from clothgym import Capsule, Gripper, Plane, Simulation, _jit, ahead, grid, triangle_mesh

MESH = grid(7, 6, 0.5, 0.4)
FREE = triangle_mesh(MESH.rest_positions, MESH.triangles)
FLOOR, RAIL = Plane(point=(0, 0, -1)), Capsule(center=(0, 0, -0.5), radius=0.03)
SCENES = {
    "a held grid over a rail": (MESH, {"anchors": [0, 5], "colliders": [FLOOR, RAIL]}),
    "triangles on a floor with grippers": (FREE, {"grippers": [Gripper(), Gripper()], "colliders": [FLOOR], "strain_limit": 0.1}),
}


class Process:
    """A process that is not started."""

    scenes: ClassVar = []

    def __init__(self, command, **how):
        self.scenes.append(json.loads(command[-1]))

    def wait(self):
        pass


@pytest.fixture
def started(monkeypatch):
    """The scenes of processes that would be started on a machine of two processors, whose cache is empty."""
    Process.scenes.clear()
    monkeypatch.setattr(ahead, "_started", [])
    monkeypatch.setenv(ahead.PROCESSES, "2")
    monkeypatch.setattr(_jit, "default_threads", lambda: 2)
    monkeypatch.setattr(_jit, "is_kept", lambda kernel: False)
    monkeypatch.setattr(subprocess, "Popen", Process)
    return Process.scenes


@pytest.mark.skipif(_jit.WITHOUT_JIT, reason="nothing is compiled")
@pytest.mark.parametrize("name", SCENES)
def test_what_is_compiled_ahead_is_all_that_the_scene_needs_but_contact_with_itself(name, started):
    from clothgym._jit import numba_internals

    def compiled():
        return {(one, types) for one, kernel in numba_internals._dispatchers.items() for types in kernel.overloads}

    mesh, options = SCENES[name]
    Simulation(mesh, self_collision="fast", **options)
    assert len(started) == 1
    ahead.run(started[0])
    before = compiled()
    Simulation(mesh, **options).step()
    assert compiled() == before


def test_one_process_is_started_and_only_where_it_helps(started, monkeypatch):
    Simulation(MESH)
    assert not started
    for _ in range(2):
        Simulation(MESH, self_collision="fast")
    assert len(started) == 1
    ahead._started.clear()
    monkeypatch.setenv(ahead.PROCESSES, "1")
    Simulation(MESH, self_collision="fast")
    monkeypatch.setenv(ahead.PROCESSES, "2")
    monkeypatch.setattr(_jit, "default_threads", lambda: 1)
    Simulation(MESH, self_collision="fast")
    monkeypatch.setattr(_jit, "default_threads", lambda: 2)
    monkeypatch.setattr(_jit, "is_kept", lambda kernel: True)
    Simulation(MESH, self_collision="fast")
    assert len(started) == 1


def test_a_second_process_leaves_the_work_to_the_first():
    with _jit.cache_folder().only_one("ahead") as first, _jit.cache_folder().only_one("ahead") as second:
        assert first and not second

"""What several tests share: chains of particles whose behavior is known in closed form, and the way to the training scripts."""

import os

import numpy as np
import pytest
from training_runs import ROOT

from clothgym import Material, Simulation
from clothgym.mesh import STRUCTURAL_X, ClothMesh, Springs, colored_hinges

# there is a worker for each processor already
os.environ.setdefault("CLOTHGYM_COMPILE_PROCESSES", "1")


def line_mesh(particles: int, spacing: float = 1.0) -> ClothMesh:
    """Particles along x, joined by structural springs in red-black order."""
    positions = np.stack([np.arange(particles) * spacing, np.zeros(particles), np.zeros(particles)], axis=1)
    ends = np.stack([np.arange(particles - 1), np.arange(1, particles)], axis=1).astype(np.int32)
    ends = np.concatenate([ends[::2], ends[1::2]])
    springs = Springs(ends, np.full(len(ends), spacing), np.full(len(ends), STRUCTURAL_X, np.int32), np.ones(len(ends)))
    triangles = np.zeros((0, 3), np.int32)
    hinges = colored_hinges(positions, triangles)
    return ClothMesh((1.0, 1.0), positions, springs, triangles, np.ones(particles), hinges, (2, particles))


@pytest.fixture
def chain():
    """Make a float64 simulation of a line of masses [kg] and springs [N/m], its stiffness set directly."""

    def make(
        particles,
        integrator,
        h,
        stiffness,
        mass=1.0,
        gravity=(0, 0, 0),
        damping_time=0.0,
        drag_rate=0.0,
        anchors=(0,),
        time_step=None,
        spacing=1.0,
    ):
        time_step = time_step or h
        simulation = Simulation(
            line_mesh(particles, spacing),
            # so soft and so damped that no integrator warns before the properties are set
            Material(stretch_stiffness=1e-9, shear_stiffness=0, bend_rigidity=0, damping_time=1e3),
            integrator=integrator,
            time_step=time_step,
            substeps=round(time_step / h),
            gravity=gravity,
            anchors=anchors,
            dtype="float64",
        )
        state = simulation.get_state()
        state.stiffness[:] = 0
        state.stiffness[:, STRUCTURAL_X] = stiffness
        state.free_inverse_mass[:] = 1 / mass
        state.damping_time[:] = damping_time
        state.drag_rate[:] = drag_rate
        simulation.set_state(state)
        return simulation

    return make


@pytest.fixture
def scripts(monkeypatch):
    """The scripts' folder, to import from."""
    monkeypatch.syspath_prepend(str(ROOT / "training"))

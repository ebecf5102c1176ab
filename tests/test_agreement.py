"""One scene, one material: all consistent methods approach the same motion as the substep shrinks, each at its order."""

from functools import cache

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material, Simulation, grid

CONSISTENT = [name for name, method in INTEGRATORS.items() if method.order is not None]
# a soft sheet, whose fastest modes even explicit Euler follows for a while without damping
SOFT = Material(stretch_stiffness=20, shear_stiffness=8, bend_rigidity=5e-6, damping_time=0.0)
FALL, FRAMES = 0.1, 2  # [s]


@cache
def hanging(name, substeps, bending, damping_time=0.0):
    """A sheet that has swung from two corners, in that many substeps of 0.05 s, (particles, 3)."""
    mesh = grid(5, 5, 0.3, 0.3)
    material = Material(**{**vars(SOFT), "damping_time": damping_time})
    method = {"name": name, "tolerance": 1e-10} if name == "implicit_euler" else name
    simulation = Simulation(
        mesh, material, integrator=method, anchors=[0, 4], time_step=FALL / FRAMES, substeps=substeps, bending=bending,
        air_density=0, dtype="float64",
    )  # fmt: skip
    simulation.step(FRAMES)
    return simulation.positions[0]


def distance(name, substeps, bending, damping_time=0.0):
    """Rms over particles to the reference, rk4 in 4000 substeps [m]."""
    apart = hanging(name, substeps, bending, damping_time) - hanging("rk4", 4000, bending, damping_time)
    return np.sqrt(np.mean(np.sum(apart**2, axis=1)))


CASES = [
    *((name, "springs", damping_time) for name in CONSISTENT for damping_time in (0.0, 2e-3)),
    ("semi_implicit_euler", "hinge", 0.0),
    ("xpbd", "hinge", 0.0),
    ("implicit_euler", "quadratic", 0.0),
    ("projective_dynamics", "quadratic", 0.0),
]


@pytest.mark.filterwarnings("ignore:.*too few for explicit_euler")
@pytest.mark.parametrize(("name", "bending", "damping_time"), CASES)
def test_all_methods_approach_one_motion_at_their_order(name, bending, damping_time):
    """Error at h and h/2; Verlet is of order 1 in its damper."""
    order = 1 if name == "verlet" and damping_time else INTEGRATORS[name].order
    substeps = {1: 2000, 2: 500, 4: 250}[INTEGRATORS[name].order]
    coarse, fine = (distance(name, n, bending, damping_time) for n in (substeps, 2 * substeps))
    print(f"{name}, {bending}: {coarse:.3g} m in {substeps} substeps, order {np.log2(coarse / fine):.3f}")
    assert fine < 1e-5
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def test_the_models_of_bending_are_not_the_same():
    """Else the cases above would say nothing of hinges."""
    assert np.abs(hanging("rk4", 4000, "hinge") - hanging("rk4", 4000, "quadratic")).max() > 1e-6

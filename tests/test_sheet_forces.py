"""Forces on one sheet of any triangles, element by element in rows, against the kernels of lanes: the same bits."""

import numpy as np
import pytest

from clothgym import Simulation, disc, grid
from clothgym.bending import BENDING
from clothgym.elements import BATCH, Elastic, element_arrays, scratch_for_forces, surface_arrays
from clothgym.grid_forces import kernels_of
from clothgym.mesh import NUM_KINDS

MESH = disc(0.3, 6)  # its springs, hinges and triangles fill some batches and leave a rest
NONE = np.zeros(0, np.int64)


def thrown(lanes, real=np.float32):
    """Positions, velocities and forces to add to, (3, particles, lanes): of the last lane, whatever their number."""
    rng, shape = np.random.default_rng(0), (*MESH.rest_positions.shape, 2)
    x = MESH.rest_positions[..., None] + rng.normal(scale=0.01, size=shape)
    arrays = x, rng.normal(size=shape), rng.normal(scale=1e-3, size=shape)
    return [np.ascontiguousarray(np.swapaxes(a, 0, 1)[..., -lanes:].astype(real)) for a in arrays]


def properties(lanes):
    rows = (
        np.linspace(1, 2, NUM_KINDS)[:, None] * [150.0, 80.0],
        np.array([2e-4, 1e-4]),
        np.array([1e-3, 2e-3]),
        np.array([1.0, 0.9]),
    )
    return Elastic(*(part[..., -lanes:].astype(np.float32) for part in rows))


def both(name, model, arguments):
    """Forces of a kernel on the last lane, alone and beside another; arguments: what follows f, for a number of lanes."""
    found = []
    for layout, lanes in (("sheet", 1), ("lanes", 2)):
        x, v, f = thrown(lanes)
        before = f.copy()
        kernels_of(BENDING[model], layout)[name](x, v, f, *arguments(lanes), scratch_for_forces(x, NONE))
        assert np.abs(f - before).max() > 1e-3
        found.append(f[..., -1])
    return found


@pytest.mark.parametrize(
    "model, name", [("springs", "add_spring_forces"), ("hinge", "add_bend_forces"), ("quadratic", "add_bend_forces")]
)
def test_a_single_sheet_has_the_forces_of_a_lane(model, name):
    elements = element_arrays(MESH, np.dtype(np.float32), model != "springs", any_order=True)
    assert min(len(elements.springs.weight), len(MESH.hinges.weight)) > 2 * BATCH
    one, lane = both(name, model, lambda lanes: (elements, properties(lanes)))
    assert np.array_equal(one.view(np.uint32), lane.view(np.uint32))


def test_a_single_sheet_feels_the_wind_of_a_lane():
    surface, resistance, wind = surface_arrays(MESH, np.dtype(np.float32)), [0.7, 0.05, 0.2], [1.0, -2.0, 0.5]

    def arguments(lanes):
        return surface, *(np.repeat(np.array(row, np.float32)[:, None], lanes, 1) for row in (resistance, wind)), np.float32(2e-3)

    one, lane = both("add_air_forces", "springs", arguments)
    assert np.array_equal(one.view(np.uint32), lane.view(np.uint32))


def test_few_sheets_are_laid_out_one_by_one():
    assert Simulation(grid(5, 5, 0.4, 0.4), num_envs=64).layout.kind == "grid"
    assert [Simulation(disc(0.2, 2), num_envs=n).layout.kind for n in (1, 15, 16)] == ["sheet", "sheet", "lanes"]
    assert Simulation(disc(0.2, 2), integrator="xpbd").layout.kind == "lanes"


def test_a_sheet_moves_alike_alone_and_in_any_batch():
    """Bits of one sheet, of the last of 3, which lie one by one, and of the last of 20, which lie in lanes."""
    ends = []
    for envs in (1, 3, 20):
        simulation = Simulation(MESH, num_envs=envs, anchors=[0], bending="hinge", wind=(1, 0, 0))
        simulation.step(3)
        ends.append(simulation.positions[-1])
    assert np.array_equal(ends[0], ends[1]) and np.array_equal(ends[0], ends[2])

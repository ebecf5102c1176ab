"""Sheets on edges: drawn over, hanging, and how deep they are, against closed forms (``tables``)."""

from functools import partial

import numpy as np
import pytest
from solids import box_distance, depth
from tables import edge, largest_share, mesh_edge, pull_back, slid

from clothgym import Box, Capsule, Material, Simulation, grid

BOX = partial(edge, thickness=0.005)


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("radius", [0.0, 0.02, 0.05])
def test_a_sheet_is_drawn_over_an_edge_with_the_belt_s_pull(radius, friction):
    """Euler's and Eytelwein's formula, within a tenth and the noise of one sheet; before, it jammed at 0.3, with 200 times that."""
    result = pull_back(BOX if radius == 0 else edge, 17, friction, radius, speed=0.05, way=0.12)
    assert result["ratio"] == pytest.approx(1, abs=0.12)
    assert result["strain"] < 0.02
    assert result["depth"] < 0.0015


@pytest.mark.parametrize(
    ("particles", "fabric", "make"), [(9, "cotton", BOX), (17, "silk", BOX), (17, "denim", BOX), (17, "cotton", mesh_edge)]
)
def test_the_pull_over_an_edge_is_independent_of_spacing_fabric_and_solid(particles, fabric, make):
    result = pull_back(make, particles, 0.3, fabric=fabric, speed=0.05, way=0.12)
    assert result["ratio"] == pytest.approx(1, abs=0.15)
    assert result["strain"] < 0.03


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_so_much_hangs_over_an_edge_and_no_more(friction):
    """r/(1 + r) with r = mu exp(mu pi/2): 32.5 % at 0.3; before, half the sheet's length hung."""
    share = largest_share(friction)
    assert slid(BOX, 17, friction, share - 0.06) < 0.01
    assert slid(BOX, 17, friction, share + 0.03) > 0.2
    assert slid(BOX, 17, friction, 0.5) > 0.2


@pytest.mark.parametrize("half", [0.1, 1.0, 5.0])
def test_no_deeper_than_the_thickness_however_large_the_solid(half):
    """A sheet that hangs over one corner of a cube; before, it sank by 0.3 % of the cube's width, 30 mm at 10 m."""
    mesh = grid(17, 17, 0.6, 0.6)
    cube = Box(center=(-half, -half, -half), half_sides=(half, half, half), friction=0.6, thickness=0.004)
    simulation = Simulation(mesh, Material.preset("cotton", air_drag=3.0), colliders=[cube], bending="hinge")
    simulation.reset(positions=mesh.rest_positions + (-0.1, -0.1, 0.005))
    deepest = []
    for _ in range(6):
        simulation.step(20)
        deepest.append(depth(simulation.positions[0] + half, mesh.triangles, lambda x: box_distance(x, half, np.eye(3)), pieces=6))
    assert max(deepest) < cube.thickness
    # it does lean on the edges, with triangles
    assert simulation.positions[0, :, 2].min() < -0.1


def test_lanes_touch_as_lone_sheets_do():
    """xpbd in a batch, whose environments lie side by side: the contact of each is that of the sheet alone, to the bit."""
    mesh = grid(9, 9, 0.4, 0.4)
    solids = [*edge(friction=0.3, half=0.2), Capsule(center=(0.1, 0, -0.2), radius=0.03, height=0.4, axis=(0, 1, 0))]
    starts = mesh.rest_positions + np.array([(0.02, 0, 0.01), (0.1, 0.03, 0.02), (0, 0, 3.0)])[:, None]
    ended = {}
    for envs in ([0, 1, 2], [0], [1], [2]):
        simulation = Simulation(mesh, Material.preset("cotton"), len(envs), "xpbd", colliders=solids)
        simulation.reset(positions=starts[envs])
        simulation.step(20)
        ended[len(envs), envs[0]] = simulation.positions
    for env in range(3):
        assert np.array_equal(ended[1, env][0], ended[3, 0][env])

"""Layers slide on layers as Coulomb's law says, flat and curved, whatever their meshes."""

import numpy as np
import pytest
from layers import (
    THICKNESS,
    cut,
    flat_layers,
    speed_along,
    speed_on_slope,
    speed_over_cylinder,
    strip_over_cylinder,
    strip_over_solid,
)

import clothgym

# spacings below and above in thicknesses, turn of the upper sheet [rad]
MESHES = [((4, 4), 0), ((2.5, 6), 0), ((6, 2.5), 0.4), ((5, 5), np.pi / 4)]


@pytest.mark.parametrize("mode", ["strict", "fast"])
@pytest.mark.parametrize(
    ("friction", "degrees", "spacings", "turn"),
    [*((mu, angle, *MESHES[0]) for mu, angle in ((0.0, 10), (0.1, 20), (0.5, 35))), *((0.3, 25, *mesh) for mesh in MESHES)],
)
def test_a_sheet_slides_on_a_sheet_as_a_block_does(friction, degrees, spacings, turn, mode):
    simulation, n = flat_layers(spacings, turn, degrees, mode, friction)
    simulation.step(18)
    v = simulation.velocities[0, n:].mean(axis=0)
    assert v[0] == pytest.approx(speed_on_slope(degrees, friction, 0.3), rel=0.02)
    assert abs(v[1]) < 2e-3
    assert simulation.positions[0, n:, 2].mean() == pytest.approx(THICKNESS, rel=0.02)
    assert simulation.intersections()[0] == 0


@pytest.mark.parametrize(("friction", "degrees"), [(0.3, 15), (0.5, 25)])
def test_a_sheet_stays_where_friction_holds_it(friction, degrees):
    simulation, n = flat_layers((4, 5), 0.3, degrees, "strict", friction)
    start = simulation.positions[0, n:]
    simulation.step(18)
    assert np.abs(simulation.positions[0, n:] - start).max() < 2e-4


@pytest.mark.parametrize("mode", ["strict", "fast"])
@pytest.mark.parametrize(
    ("radius", "spacings", "skew"),
    [(0.1, (0.016, 0.016), 0.0), (0.1, (0.01, 0.024), 0.0), (0.1, (0.024, 0.01), 0.0), (0.1, (0.024, 0.024), 0.0),
     (0.1, (0.016, 0.016), 0.5), (0.05, (0.01, 0.01), 0.0), (0.2, (0.024, 0.024), 0.0)],
)  # fmt: skip
def test_a_strip_slides_over_a_cylinder_without_friction(radius, spacings, skew, mode):
    tails = 0.12, 0.34
    case = strip_over_cylinder(radius, spacings, tails, mode, 0.0, skew)
    case[0].step(12)
    assert speed_along(*case) == pytest.approx(speed_over_cylinder(radius + THICKNESS, tails, 0.2), rel=0.05)
    assert case[0].intersections()[0] == 0


@pytest.mark.parametrize(("friction", "tails"), [(0.1, (0.08, 0.35)), (0.3, (0.12, 1.2)), (0.5, (0.08, 1.2))])
def test_a_strip_slides_over_a_layer_as_over_a_smooth_solid(friction, tails):
    case, smooth = (
        strip_over_cylinder(0.1, (0.016, 0.016), tails, "strict", friction),
        strip_over_solid(0.1, 0.016, tails, friction),
    )
    for simulation, *_ in (case, smooth):
        simulation.step(12)
    assert speed_along(*smooth) > 0.3
    assert speed_along(*case) == pytest.approx(speed_along(*smooth), rel=0.05)


@pytest.mark.parametrize(("friction", "tails"), [(0.3, (0.1, 0.14)), (0.5, (0.1, 0.2))])
def test_a_strip_over_a_cylinder_holds_up_to_the_capstans_law(friction, tails):
    """At least the ratio exp(friction pi) of its tails holds: its weight on top helps."""
    assert tails[1] / tails[0] < np.exp(friction * np.pi)
    case = strip_over_cylinder(0.1, (0.016, 0.016), tails, "strict", friction)
    case[0].step(12)
    assert abs(speed_along(*case)) < 5e-3


@pytest.mark.parametrize("spacings", [(2.5, 2.5), (2.5, 6), (6, 2.5), (4, 4)])
@pytest.mark.parametrize("turn", [0, 0.3])
def test_contacts_of_flat_layers_are_upright_wherever_the_upper_one_lies(spacings, turn):
    """Also over the border of the upper sheet, and where a vertex lies just beside an edge of the other."""
    simulation, _ = flat_layers(spacings, turn, 0, "strict", 0.0, lift=0.97)
    simulation.step()
    state = simulation.get_state()
    count, x = state.self_contact["contacts"][0], simulation.positions[0]
    weights, normals = state.self_contact["coefficients"][0, :count, :4], state.self_contact["coefficients"][0, :count, 4:7]
    assert count > 30
    np.testing.assert_allclose(np.abs(normals[:, 2]), 1, atol=1e-4)
    # and at most a little farther apart than they are high: over the border
    across = np.einsum("ck,ckd->cd", weights, x[state.self_contact["particles"][0, :count]])
    assert np.linalg.norm(across[:, :2], axis=1).max() < THICKNESS
    assert np.median(np.linalg.norm(across[:, :2], axis=1)) < 1e-6


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5])
def test_a_curved_sheet_on_a_curved_one_is_a_thickness_away_wherever_their_particles_are(shift):
    """Two coarse grids around one axis: facets of the upper one are nearer than its particles, by 0.6 mm, and push nothing."""
    spacing, places = 0.02, []
    large, small = cut(0.24, 0.12, spacing), cut(0.12, 0.06, spacing)
    for mesh, radius, by in ((large, 0.1, 0.0), (small, 0.1 + THICKNESS, shift * spacing)):
        angle = (mesh.rest_positions[:, 0] + by) / 0.1
        places.append(np.stack([radius * np.sin(angle), mesh.rest_positions[:, 1] + by, radius * np.cos(angle)], axis=1))
    x, upper = np.vstack(places), np.repeat([0.0, 1.0], [large.num_particles, small.num_particles])
    mesh = clothgym.triangle_mesh(
        x + upper[:, None] * (0, 0, 1), np.vstack([large.triangles, small.triangles + large.num_particles])
    )
    simulation = clothgym.Simulation(
        mesh, gravity=(0, 0, 0), air_density=0, bending="springs", self_collision={"thickness": THICKNESS}
    )
    simulation.reset(positions=x)
    simulation.step(2)
    assert np.abs(simulation.positions[0] - x).max() < 3e-4

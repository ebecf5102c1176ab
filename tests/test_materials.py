"""Presets, and the two laboratory tests as scenes, against the heavy elastica and published drape coefficients."""

import re

import numpy as np
import pytest

from clothgym import Material, disc
from clothgym.lab.scenes import bending_length, cantilever, cusick_drape, elastica_droop, fold_count, projected_area
from clothgym.material import PRESETS, rigidity_percentile

# chord angle of the heavy elastica [deg], solved independently, by G = rho g L^3/B
ELASTICA = {0.1: 0.716, 1: 7.100, 4: 25.531, 8: 41.487, 15: 56.031, 30: 68.566, 100: 80.361}
# published drape coefficients [%], see docs/materials.md
BANDS = {"cotton": (60, 76), "silk": (20, 40), "wool": (40, 70), "denim": (70, 90), "polyester": (20, 40)}


# weight [mg/cm^2] and rigidity [gf cm^2/cm] of Matsudaira et al. 2015
BENT = {
    "cotton_broad": (12.38, 0.118),
    "polyester_tropical": (11.65, 0.077),
    "wool_tropical": (16.29, 0.067),
    "polyester_faille": (10.43, 0.019),
}
SOLID = ("penava_cotton", "knit", "polyester", "silk", "wool", "denim")  # properties follow from a modulus and a thickness


@pytest.mark.parametrize("name", BENT)
def test_fabrics_measured_in_bending_have_that_rigidity_and_weight(name):
    """A gram-force is 9.80665 mN, so 1 gf cm^2/cm is 98.0665 uN m, and 1 mg/cm^2 is 10 g/m^2."""
    weight, rigidity = BENT[name]
    assert PRESETS[name].density == pytest.approx(weight / 100)
    assert PRESETS[name].bend_rigidity == pytest.approx(98.0665e-6 * rigidity, rel=1e-3)
    assert f"{weight} mg/cm^2" in PRESETS[name].source and f"B {rigidity} gf" in PRESETS[name].source


def test_cotton_is_the_measured_one_and_the_median_fabric_is_in_the_middle():
    assert Material.preset("cotton") == Material.preset("cotton_broad")
    assert rigidity_percentile(Material.preset("median").bend_rigidity) == pytest.approx(50, abs=1)


def test_percentiles_of_rigidity_follow_the_618_fabrics():
    """At the extremes and the quartiles 4.12 and 35.9 uN m of the data, of which the table has neither; nothing lies beyond."""
    assert [rigidity_percentile(b) for b in (1e-7, 3.3e-7, 2.66e-4, 1e-3)] == [0, 0, 100, 100]
    assert rigidity_percentile(4.117e-6) == pytest.approx(25, abs=2)
    assert rigidity_percentile(3.594e-5) == pytest.approx(75, abs=2)


@pytest.mark.parametrize("name", SOLID)
def test_a_preset_s_properties_are_those_of_its_source(name):
    """Density, E t, E t/(2 (1 + nu)) and E t^3/(12 (1 - nu^2)) of the numbers that the source names."""
    fabric = PRESETS[name]
    density, thickness, modulus, nu = map(
        float, re.search(r"([\d.]+) k?g/m\^[23], ([\d.]+) mm, ([\d.]+) MPa, nu ([\d.]+)", fabric.source).groups()
    )
    thickness, modulus = 1e-3 * thickness, 1e6 * modulus
    areal = density * thickness if "kg/m^3" in fabric.source else 1e-3 * density
    assert fabric.density == pytest.approx(areal, rel=2e-3)
    assert fabric.stretch_stiffness == pytest.approx(modulus * thickness, rel=2e-3)
    assert fabric.shear_stiffness == pytest.approx(modulus * thickness / (2 * (1 + nu)), rel=2e-3)
    assert fabric.bend_rigidity == pytest.approx(modulus * thickness**3 / (12 * (1 - nu**2)), rel=5e-3)


def test_the_fabrics_that_tasks_rest_on_stay_as_they_are():
    """Properties as they were when the tasks were defined."""
    cotton, knit = Material.preset("penava_cotton"), Material.preset("knit")
    assert (cotton.density, cotton.stretch_stiffness, cotton.shear_stiffness, cotton.bend_rigidity) == (0.1503, 261.1, 105, 2.34e-6)
    assert (knit.density, knit.stretch_stiffness, knit.shear_stiffness, knit.bend_rigidity) == (0.1782, 24.93, 11.64, 2.25e-7)


@pytest.mark.parametrize("weight", ELASTICA)
def test_elastica(weight):
    """Chord angles of a table that another solver made; a light strip's is atan(G/8)."""
    assert elastica_droop(weight) == pytest.approx(ELASTICA[weight], abs=2e-3)
    assert elastica_droop(1e-3) == pytest.approx(np.degrees(1e-3 / 8), rel=1e-4)


@pytest.mark.parametrize("name", PRESETS)
def test_strips_droop_as_the_elastica_does(name):
    """Within 15 %, for the preset's own rigidity and weight; G = rho g L^3/B."""
    fabric = Material.preset(name)
    strip = cantilever(fabric, overhang=0.04, columns=10)
    assert strip.weight == pytest.approx(fabric.density * 9.81 * 0.04**3 / fabric.bend_rigidity)
    assert strip.speed < 1e-3
    assert strip.droop == pytest.approx(strip.elastica, rel=0.15)


def test_a_strip_of_two_bending_lengths_droops_by_41_degrees():
    """The rule of Peirce 1930, by which textile laboratories measure rigidity: G = 8."""
    fabric = Material(density=0.2, stretch_stiffness=2000.0, shear_stiffness=700.0, bend_rigidity=2e-5)
    strip = cantilever(fabric, overhang=2 * bending_length(fabric), columns=16)
    assert strip.weight == pytest.approx(8)
    assert strip.droop == pytest.approx(41.49, rel=0.02)


def test_shadows_are_counted_once():
    """Two unit squares that overlap by half, at different heights, and a flat disc's polygon n/2 R^2 sin(2 pi/n)."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    corners = np.concatenate([square, square + [0.5, 0.25, 1]])
    both = np.concatenate([triangles, triangles[:, ::-1] + 4])
    assert projected_area(corners, both) == pytest.approx(2 - 0.5 * 0.75, rel=1e-3)
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    assert projected_area(corners @ turn.T, both) == pytest.approx(2 - 0.5 * 0.75, rel=1e-5)
    mesh = disc(0.15, 5)
    assert projected_area(mesh.rest_positions, mesh.triangles) == pytest.approx(15 * 0.15**2 * np.sin(np.pi / 15), rel=1e-5)


@pytest.mark.parametrize("folds", [2, 5, 7])
def test_folds_are_counted_around_a_skirt(folds):
    """A rim of radius 0.12 + 0.01 cos(n angle), turned, with ripples of 1 mm that are none; a circle has none."""
    angle = 0.3 + np.arange(90) * 2 * np.pi / 90
    radius = 0.12 + 0.01 * np.cos(folds * angle) + 5e-4 * np.cos(29 * angle)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), -0.05 * np.ones(90)], axis=1)
    assert fold_count(rim, depth=0.003) == folds
    assert fold_count(rim, depth=0.03) == 0
    assert fold_count(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), depth=1e-3) == 0


def test_a_rim_is_a_list_of_points():
    with pytest.raises(ValueError, match=r"rim has shape \(2, 3\).*three points or more"):
        fold_count(np.zeros((2, 3)), depth=0.003)


@pytest.mark.parametrize("name", BANDS)
def test_drape_coefficients_lie_in_the_published_bands(name):
    """Mean of two specimens at rest."""
    drape = cusick_drape(Material.preset(name), rings=10, num_envs=2)
    assert np.all(drape.speed < 1e-3) and drape.folds.shape == (2,)
    assert BANDS[name][0] <= 100 * drape.coefficient.mean() <= BANDS[name][1]


def test_a_board_keeps_its_shadow_and_a_limper_sheet_loses_more_of_it():
    """A plate whose rim sags by rho g l^4/(8 B), a fiftieth of its overhang l, keeps its shadow; a hundredth of B does not."""
    rigid = 50 * 0.2 * 9.81 * 0.06**3 / 8
    stiff, limp = (
        cusick_drape(Material(density=0.2, stretch_stiffness=500.0, shear_stiffness=180.0, bend_rigidity=b), rings=5).coefficient[0]
        for b in (rigid, rigid / 100)
    )
    assert stiff == pytest.approx(1, abs=5e-3)
    assert limp < 0.9


def test_specimens_need_a_ring_on_the_edge():
    with pytest.raises(ValueError, match="rings=12.*multiple of 5"):
        cusick_drape(Material.preset("silk"), rings=12)

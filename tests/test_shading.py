"""Floor 6: what color and light say, against light and colors worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_render import FACING, FAR_AWAY, SIDE, renderer, sheet, upright

from clothgym.collisions import Box, MeshCollider, Sphere
from clothgym.forces import structural_strain
from clothgym.mesh import grid
from clothgym.render import Camera, Drawn
from clothgym.render.heat import heat_colors, largest_at_particles
from clothgym.render.shading import CREAM


def red_over_blue(image):
    middle = image[50:70, 50:70].reshape(-1, 3).astype(float).mean(axis=0)
    return middle[0] / middle[2]


@pytest.mark.parametrize("smooth", [False, True])
def test_front_and_back_differ_in_color(smooth):
    draw = renderer(FACING, smooth=smooth, front=(200, 40, 40), back=(40, 40, 200))
    front = upright()
    back = front * (-1, 1, 1)
    assert red_over_blue(draw.rgb(front)) > 1.33
    assert red_over_blue(draw.rgb(back)) < 0.75


def test_pattern_follows_the_material():
    draw = renderer(FACING, width=240, height=240, check=SIDE / 4, front=(200, 40, 40))
    image = draw.rgb(upright()).astype(float)
    # the sheet's edge is about 67 pixels from the middle: stripes of about 33, in both directions, of 20 yarns each
    one_stripe = image[120 - 30 : 120 - 4, 60:180, 2].mean(axis=0)
    jumps = np.flatnonzero(np.abs(np.diff(one_stripe)) > 15) + 60
    assert np.all(np.min(np.abs(jumps[:, None] - 120 - 33.6 * np.arange(-2, 3)), axis=1) < 3)
    assert len(jumps) >= 3


def test_threads_lie_over_and_under_each_other():
    """Where a colored stripe crosses a light one, up close, yarns of the one and of the other alternate both ways."""
    near = Camera(eye=(0, -0.1, 0.5), target=(0, 0, 0.5), vertical_fov=60)
    image = renderer(near, width=200, height=200, check=SIDE / 12, front=(200, 40, 40)).rgb(upright()).astype(float)
    # the picture shows 0.1155 m: a stripe is 86.6 pixels wide, and has 20 yarns of 4.3
    stripe, yarn = 0.05 / 0.1155 * 200, 0.05 / 20 / 0.1155 * 200
    along, up = ((np.arange(200) - 99.5) / stripe, (99.5 - np.arange(200)) / stripe)
    warp, weft = np.floor(along) % 2, np.floor(up) % 2
    over = (np.floor(along[None] * stripe / yarn) + np.floor(up[:, None] * stripe / yarn)) % 2 == 0
    mixed = warp[None] != weft[:, None]
    light = np.where(over, warp[None], weft[:, None])
    blue = image[..., 2]
    assert np.corrcoef(light[mixed], blue[mixed])[0, 1] > 0.7
    assert np.corrcoef(light[mixed], np.roll(blue, round(yarn), axis=1)[mixed])[0, 1] < 0


def test_cloth_and_solids_darken_the_floor():
    draw = renderer()
    empty = draw.rgb(FAR_AWAY).astype(int)
    shadow = draw.rgb(sheet(z=0.3)).astype(int)
    on_floor = np.isfinite(draw.depth(FAR_AWAY)) & (draw.depth(sheet(z=0.3)) == draw.depth(FAR_AWAY))
    change = (shadow - empty)[on_floor]
    assert np.all(change.min(axis=0) < -20)
    assert change.max() <= 0


def decoded(image):
    """sRGB from 0 to 255 as linear light (IEC 61966-2-1)."""
    c = np.asarray(image) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def linear(image):
    """A picture's light, with the bright end stretched again that the renderer has compressed as it says."""
    c = decoded(image)
    return np.where(c < 0.7, c, 0.7 - 0.3 * np.log(np.maximum(1 - (c - 0.7) / 0.3, 1e-3)))


def test_a_touching_sheet_darkens_the_floor_at_its_edge_and_a_floating_one_does_not():
    """The contact shadow falls off within centimeters, on the side of the lamp as well, where no cast shadow lies."""
    draw = renderer(Camera(eye=(0, 0, 2.5), target=(0, 0, 0), up=(0, 1, 0)), width=240, height=240)
    empty = linear(draw.rgb(FAR_AWAY)).sum(axis=2)
    half = 2.5 * math.tan(math.radians(35) / 2)  # of what is seen [m]
    # to the left of the sheet, as the lamp is
    edge, near, far = (int(120 - (SIDE / 2 + off) / half * 120) for off in (0.012, 0.055, 0.3))
    kept = {z: linear(draw.rgb(sheet(z=z))).sum(axis=2) / empty for z in (0.002, 0.25)}
    assert kept[0.002][120, edge] < 0.58
    assert kept[0.002][120, near] < 0.88
    assert kept[0.25][120, near] > 0.96
    assert kept[0.002][120, far] > 0.99


@pytest.mark.parametrize("at", [(0.3, 0.2), (0.3, -0.2), (-0.3, 0.2)])
def test_a_contact_shadow_lies_where_the_solid_stands(at):
    """Beside a small box, on the side of the lamp; beside its mirror images, where nothing stands, the floor is as it was."""
    draw = renderer(Camera(eye=(0, 0, 2.5), target=(0, 0, 0), up=(0, 1, 0)), width=240, height=240)
    empty = linear(draw.rgb(FAR_AWAY)).sum(axis=2)
    box = [Box(center=(*at, 0.05), half_sides=(0.1, 0.1, 0.05))]
    kept = linear(draw.rgb(FAR_AWAY, box)).sum(axis=2) / empty
    scale = 120 / (2.5 * math.tan(math.radians(35) / 2))  # pixels per meter on the floor

    def beside(x, y):
        return kept[int(120 - scale * y), int(120 + scale * (x - 0.125))]

    assert beside(*at) < 0.8
    for mirrored in ((1, -1), (-1, -1)):
        assert beside(*np.multiply(at, mirrored)) > 0.98


def test_a_shadow_is_softer_the_farther_above_the_floor_its_caster_is():
    draw = renderer(Camera(eye=(0, 0, 1.6), target=(0, 0, 0), up=(0, 1, 0)), width=400, height=400, antialias=2)
    empty = linear(draw.rgb(FAR_AWAY))[..., 0]
    steepest = {}
    for z in (0.15, 0.55):
        plate = [Box(center=(-0.1, 0, z), half_sides=(0.05, 0.05, 0.005))]
        kept = linear(draw.rgb(FAR_AWAY, plate))[..., 0] / empty
        covered = draw.depth(FAR_AWAY, plate) < 1.59
        near = [np.roll(covered, way, axis) for way in (-2, -1, 0, 1, 2) for axis in (0, 1)]
        kept[np.any(near, axis=0)] = np.nan
        steepest[z] = np.nanmax(np.abs(np.diff(kept, axis=1)))
    assert steepest[0.15] > 1.7 * steepest[0.55]


def test_folds_are_darker_in_their_hollows():
    """A corrugated sheet seen from straight above: valleys, though as level as ridges, get less light."""
    n, waves = 49, 4
    x = sheet(n)
    x[:, 2] = 0.5 + 0.012 * np.cos(2 * np.pi * waves * x[:, 1] / SIDE)
    draw = renderer(
        Camera(eye=(0, 0, 2), target=(0, 0, 0.5), up=(0, 1, 0), vertical_fov=20), n, True, width=300, height=300, front=CREAM
    )
    light = linear(draw.rgb(x))[:, 150].sum(axis=1)
    rows = 150 - 150 * np.array([k * SIDE / waves / 2 for k in range(-2, 3)]) / (1.5 * math.tan(math.radians(10)))
    ridges, valleys = light[np.round(rows[::2]).astype(int)], light[np.round(rows[1::2]).astype(int)]
    assert valleys.mean() < 0.95 * ridges.mean()


def test_edges_are_antialiased():
    """Along a slanted edge a pixel's light is the share of it that the sheet covers."""
    c, s = math.cos(0.3), math.sin(0.3)
    x = upright()
    x = np.stack([c * x[:, 0] - s * (x[:, 2] - 0.5), x[:, 1], 0.5 + s * x[:, 0] + c * (x[:, 2] - 0.5)], axis=1)
    jagged, smooth = (linear(renderer(FACING, antialias=a, front=CREAM).rgb(x))[:57, :, 1] for a in (1, 4))
    # the upper half is before the even sky: only two tones, and with antialiasing those between them
    dark, sky = jagged[54:, 55:65].mean(), jagged[:10].mean()

    def between(light):
        return np.count_nonzero((light > dark + 0.2 * (sky - dark)) & (light < dark + 0.8 * (sky - dark)))

    assert between(jagged) == 0
    assert between(smooth) >= 30
    np.testing.assert_allclose(smooth.mean(), jagged.mean(), rtol=0.01)


def test_the_most_strained_place_has_the_color_that_says_so():
    """A level sheet that is stretched more and more towards its middle column, seen from straight above under an even light."""
    matplotlib = pytest.importorskip("matplotlib")
    n = 17
    mesh, x = grid(n, n, SIDE, SIDE), sheet(n, z=0.4)
    cells = 1 + 0.1 * np.exp(-(((np.arange(n - 1) - 7.5) / 3) ** 2))
    columns = np.concatenate([[0], np.cumsum(cells)]) * SIDE / (n - 1)
    x[:, 0] = np.tile(columns - columns.mean(), n)
    # by hand: a particle has the larger of the strains of the cells beside it
    of_columns = np.maximum(np.append(cells, 0), np.insert(cells, 0, 0)) - 1
    given = largest_at_particles(mesh, structural_strain(mesh, x[None]))[0].reshape(n, n)
    np.testing.assert_allclose(given, np.broadcast_to(of_columns, (n, n)), atol=1e-6)
    camera = Camera(eye=(0, 0, 2.4), target=(0, 0, 0.4), up=(0, 1, 0), vertical_fov=20)
    draw = renderer(camera, n, True, width=401, height=401)
    magma = matplotlib.colormaps["magma"]
    for full in (0.1, 0.25):
        light = linear(draw.rgb(x, values=given.ravel() / full))
        white = linear(draw.rgb(x, values=np.zeros(n * n)))
        for column in (8, 5, 2):
            pixel = round(200 + x[column, 0] * 200.5 / (2 * math.tan(math.radians(10))))
            # the same light falls on both pictures: their quotient is that of the two colors
            share = min(of_columns[column] / full, 1)
            hot, cold = (decoded(255 * np.array(magma((248 - 192 * part) / 255)[:3])) for part in (share, 0))
            np.testing.assert_allclose(light[200, pixel] / white[200, pixel], hot / cold, atol=0.04)
    most = np.argmin(draw.rgb(x, values=given.ravel() / 0.1)[200, 60:340, 1]) + 60
    assert abs(most - 200) <= 24  # within a cell of the middle, whose two columns share the largest strain


def test_heat_is_magma():
    matplotlib = pytest.importorskip("matplotlib")
    shares = np.linspace(0, 1, 50)
    truth = 255 * matplotlib.colormaps["magma"](np.interp(shares, [0, 1], [248 / 255, 56 / 255]))[:, :3]
    assert np.abs(heat_colors(2 + 3 * shares, 2, 5) - truth).max() < 4
    assert np.array_equal(heat_colors([-9.0, 9.0]), heat_colors([0.0, 1.0]))
    for wrong in ({"values": [np.nan]}, {"values": [0.0], "low": 1.0}):
        with pytest.raises(ValueError, match="finite"):
            heat_colors(**wrong)


def test_markers_are_spheres_of_their_color():
    draw = renderer(FACING, width=121, height=121)
    image = draw.rgb(FAR_AWAY, (), [((0, 0, 0.5), (20, 200, 20))])
    assert image[60, 60, 1] > 1.5 * image[60, 60, 0]
    large = draw.rgb(FAR_AWAY, (), [(Sphere(center=(0, 0, 0.5), radius=0.1), (20, 200, 20))])
    assert large[60, 70, 1] > 1.5 * large[60, 70, 0]


def test_supersampling_averages_linear_light():
    """Doubling the samples keeps the mean light: what is bright once is not lost to the gamma curve."""
    x, ball = sheet(z=0.2), [Sphere(center=(0, 0, 0.1), radius=0.1)]

    def light(antialias):
        return linear(renderer(antialias=antialias).rgb(x, ball)).mean()

    assert light(3) == pytest.approx(light(1), rel=0.01)


def test_a_mesh_is_smooth_but_at_its_creases():
    trimesh = pytest.importorskip("trimesh")
    ball, cube = trimesh.creation.icosphere(subdivisions=3, radius=0.2), trimesh.creation.box((0.2, 0.2, 0.2))
    shapes = [Drawn(MeshCollider(vertices=m.vertices, triangles=m.faces, resolution=8)) for m in (ball, cube)]
    smooth, edged = (shape.mesh() for shape in shapes)
    np.testing.assert_allclose(smooth.normals, smooth.positions / 0.2, atol=0.02)
    assert np.all(np.sort(np.abs(edged.normals), axis=1) == [0, 0, 1])
    np.testing.assert_allclose(np.linalg.norm(smooth.normals, axis=1), 1, atol=1e-6)

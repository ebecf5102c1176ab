"""Floor 6: pictures and depths against geometry worked out by hand."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from clothgym.collisions import Box, Capsule, Plane, Sphere
from clothgym.mesh import grid
from clothgym.render import Camera, Renderer
from clothgym.render.surface import push_out

SIDE = 0.6
CAMERA = Camera(eye=(0.5, -1.1, 0.7), target=(0, 0, 0.13))
FACING = Camera(eye=(0, -2, 0.5), target=(0, 0, 0.5), vertical_fov=30)  # level, looking along +y


def renderer(camera=CAMERA, n=9, smooth=False, **options):
    mesh = grid(n, n, SIDE, SIDE)
    options = {"width": 120, "height": 120, "antialias": 1, **options}
    return Renderer(mesh.triangles, mesh.rest_positions[:, :2], camera, grid_shape=(n, n) if smooth else None, **options)


def sheet(n=9, z=0.001, shift=(0.0, 0.0)):
    x = grid(n, n, SIDE, SIDE).rest_positions.copy()
    x[:, :2] += shift
    x[:, 2] = z
    return x


def upright(n=9, y=0.0, width=SIDE, height=SIDE):
    """A sheet in the plane y = const around the height 0.5 m, its front towards -y."""
    x = grid(n, n, width, height).rest_positions
    return np.stack([x[:, 0], np.full(len(x), y), x[:, 1] + 0.5], axis=1)


FAR_AWAY = sheet(shift=(50.0, -50.0))  # behind the eye of both cameras: leaves the stage to the solids


def test_rays_of_a_wide_picture():
    # 15 degrees up and down, and twice that slope to the sides
    eye, corner, right, down = np.array(FACING.view(200, 100).rays)
    t = math.tan(math.radians(15))
    np.testing.assert_allclose(eye, (0, -2, 0.5))
    np.testing.assert_allclose(corner, (-2 * t, 1, t), atol=1e-12)
    np.testing.assert_allclose(corner + 200 * right + 100 * down, (2 * t, 1, -t), atol=1e-12)


# depth


@pytest.mark.parametrize("size", [(64, 64), (100, 60)])
def test_floor_depth_is_the_rays_distance_along_the_view_axis(size):
    width, height = size
    depth = renderer(width=width, height=height).depth(FAR_AWAY)
    eye, target = np.array(CAMERA.eye), np.array(CAMERA.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    tangent = math.tan(math.radians(35) / 2)
    for row, column in ((height - 1, 0), (height // 2, width // 2), (height - 3, width - 1)):
        a = (2 * (column + 0.5) / width - 1) * tangent * width / height
        b = (1 - 2 * (row + 0.5) / height) * tangent
        ray = forward + a * right + b * up
        assert depth[row, column] == pytest.approx(-eye[2] / ray[2], rel=1e-4)


def test_sky_is_infinitely_far():
    depth = renderer(FACING).depth(FAR_AWAY)
    assert np.all(np.isinf(depth[:60]))
    assert np.all(np.isfinite(depth[62:]))


@pytest.mark.parametrize(
    ("solid", "nearest"),
    [
        (Sphere(center=(0, 0, 0.5), radius=0.2, thickness=0.05), 1.8),
        (Box(center=(0, 0.1, 0.5), half_sides=(0.1, 0.3, 0.2)), 1.8),
        (Box(center=(0, 0.1, 0.5), half_sides=(0.3, 0.1, 0.2), yaw=math.pi / 2), 1.8),
        (Capsule(center=(0, 0, 0.4), radius=0.1, height=0.6), 1.9),
        (Capsule(center=(0, 0.3, 0.5), radius=0.1, height=0.6, axis=(0, 1, 0)), 2.0),
    ],
)
def test_depth_of_solids_in_the_middle(solid, nearest):
    depth = renderer(FACING, width=121, height=121).depth(FAR_AWAY, [solid])
    assert depth[60, 60] == pytest.approx(nearest, abs=1e-3)
    assert depth[:61].min() == pytest.approx(nearest, abs=1e-3)


def test_sphere_depth_off_the_middle():
    # ray (0.05, 1, 0) from 2 m before a ball of radius 0.2: (1 + s^2) t^2 - 4 t + 4 - r^2 = 0
    camera_depth = renderer(FACING, width=401, height=401).depth(FAR_AWAY, [Sphere(center=(0, 0, 0.5), radius=0.2)])
    scale = 200.5 / math.tan(math.radians(15))
    column = 200 + round(0.05 * scale)
    s = (column - 200) / scale
    truth = (4 - math.sqrt(16 - 4 * (1 + s * s) * (4 - 0.04))) / (2 * (1 + s * s))
    assert camera_depth[200, column] == pytest.approx(truth, abs=1e-3)


def test_cloth_depth_has_no_bias():
    depth = renderer(FACING, width=121, height=121).depth(upright(y=0.25))
    assert depth[60, 60] == pytest.approx(2.25, abs=1e-5)
    smooth = renderer(FACING, width=121, height=121, smooth=True).depth(upright(y=0.25))
    np.testing.assert_allclose(smooth, depth, rtol=1e-5)


def test_perspective_depth_inside_one_large_triangle():
    # a plane that leans away, y = z - 0.5: on the ray (0, 1, s) it lies at depth 2 / (1 - s)
    triangle = np.array([[-3, -1, -0.5], [3, -1, -0.5], [0, 2, 2.5]])
    depth = Renderer([[0, 1, 2]], triangle[:, :2], FACING, 101, 101, 1).depth(triangle)
    scale = 50.5 / math.tan(math.radians(15))
    for row in (10, 50, 80):
        assert depth[row, 50] == pytest.approx(2 / (1 - (50 - row) / scale), rel=1e-4)


# coverage and order


def test_square_covers_its_projected_area():
    side = 0.5
    size = 400
    x = upright(width=side, height=side)
    depth = renderer(FACING, width=size, height=size).depth(x)
    seen = np.count_nonzero(np.abs(depth - 2) < 1e-4)
    truth = (side / 2 * (size / 2) / math.tan(math.radians(15))) ** 2
    assert seen == pytest.approx(truth, rel=0.01)


def test_triangles_leave_no_gap_along_common_edges():
    rng = np.random.default_rng(0)
    x = upright(33)
    inner = (np.abs(x[:, 0]) < 0.29) & (np.abs(x[:, 2] - 0.5) < 0.29)
    x[inner] += rng.uniform(-0.006, 0.006, (inner.sum(), 3)) * (1, 0, 1)
    depth = renderer(FACING, n=33, width=300, height=300).depth(x)
    np.testing.assert_allclose(depth[80:220, 80:220], 2, atol=1e-4)


def test_the_nearer_surface_wins():
    draw = renderer(FACING, width=121, height=121)
    ball = Sphere(center=(0, 0.4, 0.5), radius=0.2)
    before = draw.depth(upright(y=0.1), [ball])[60, 60]
    behind = draw.depth(upright(y=0.7), [ball])[60, 60]
    assert before == pytest.approx(2.1, abs=1e-4)
    assert behind == pytest.approx(2.2, abs=1e-3)


def test_cloth_resting_on_a_solid_hides_it():
    # the cloth lies 2 mm inside the front of the box, as chords between resting particles do
    box = (Box(center=(0, 0.2, 0.5), half_sides=(0.25, 0.2, 0.25)), (20, 20, 200))
    draw = renderer(FACING)
    image = draw.rgb(upright(y=0.002), [box]).astype(float)[35:85, 35:85]
    assert np.all(image[..., 0] > image[..., 2])
    inside = draw.rgb(upright(y=0.02), [box]).astype(float)[35:85, 35:85]
    assert np.all(inside[..., 0] < inside[..., 2])


def test_smooth_cloth_is_lifted_out_of_solids():
    """A few millimeters inside: onto the surface, along its normal; deep inside or outside: left alone."""
    half, yaw, lift = (0.1, 0.2, 0.3), math.pi / 2, 0.004

    def pushed(point, half, radius):
        x = np.array([point], np.float32)
        push_out(x, 1, (1.0, 0.0, 0.0), math.cos(yaw), math.sin(yaw), half, radius, lift, 0.03)
        return x[0]

    box, capsule = (half, 0.0), ((0.0, 0.0, 0.2), 0.1)
    # turned by a right angle, the box is 0.4 wide along x and 0.2 along y
    np.testing.assert_allclose(pushed((1.19, 0.05, 0.1), *box), (1.204, 0.05, 0.1), atol=1e-6)
    np.testing.assert_allclose(pushed((1.1, -0.09, 0.1), *box), (1.1, -0.104, 0.1), atol=1e-6)
    np.testing.assert_allclose(pushed((1.1, 0.01, -0.302), *box), (1.1, 0.01, -0.304), atol=1e-6)
    np.testing.assert_allclose(pushed((1.06, 0.08, 0.2 - 0.01), *capsule), np.array((1.0624, 0.0832, 0.19)), atol=1e-6)
    for untouched in ((1.15, 0.01, 0.1), (1.21, 0.0, 0.0)):
        np.testing.assert_array_equal(pushed(untouched, *box), np.float32(untouched))


def test_a_surface_before_the_near_plane_is_not_drawn():
    draw = renderer(Camera(eye=(0, -2, 0.5), target=(0, 0, 0.5), near=1.5))
    assert np.array_equal(draw.depth(upright(y=-1.0)), draw.depth(FAR_AWAY))


def test_smooth_surface_passes_through_the_particles():
    # y = x^3 on a coarse grid: the bicubic surface keeps every particle where it is
    x = upright(7)
    x[:, 1] = 5 * x[:, 0] ** 3
    draw = renderer(FACING, n=7, smooth=True, width=601, height=601)
    depth = draw.depth(x)
    scale = 300.5 / math.tan(math.radians(15))
    for particle in (16, 24, 31, 32):
        z = x[particle, 1] + 2
        column, row = 300 + x[particle, 0] / z * scale, 300 - (x[particle, 2] - 0.5) / z * scale
        assert depth[round(row), round(column)] == pytest.approx(z, abs=2e-3)


# sameness


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_batch_equals_single_pictures(threads):
    draw = renderer(smooth=True, threads=threads, width=64, height=48, antialias=2)
    rng = np.random.default_rng(1)
    x = np.stack([sheet(z=0.1 + 0.1 * i) + rng.normal(0, 0.01, (81, 3)) for i in range(5)])
    solids = [[Sphere(center=(0, 0, 0.1), radius=0.1)] * (i % 3) for i in range(5)]
    markers = [[(x[i, 0], (250, 250, 250))] for i in range(5)]
    images, depths = draw.rgb_batch(x, solids, markers), draw.depth_batch(x, solids, markers)
    hot = rng.uniform(0, 1, (5, 81))
    heated = draw.rgb_batch(x, solids, markers, hot)
    assert images.shape == (5, 48, 64, 3) and images.dtype == np.uint8
    assert depths.shape == (5, 48, 64) and depths.dtype == np.float32
    for i in range(5):
        assert np.array_equal(images[i], draw.rgb(x[i], solids[i], markers[i]))
        assert np.array_equal(heated[i], draw.rgb(x[i], solids[i], markers[i], hot[i]))
        assert np.array_equal(depths[i], draw.depth(x[i], solids[i], markers[i]))


def test_the_same_call_gives_the_same_pixels():
    draw, x = renderer(smooth=True, antialias=2), sheet(z=0.2)
    first = draw.rgb(x)
    draw.rgb(sheet(z=0.3))
    assert np.array_equal(draw.rgb(x), first)
    assert np.array_equal(renderer(smooth=True, antialias=2).rgb(x), first)
    assert np.array_equal(draw.rgb(x.astype(np.float32)), first)


# what must not harm


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_positions_that_are_not_finite_are_refused(value):
    x = sheet()
    x[7, 1] = value
    with pytest.raises(ValueError, match=r"positions\[7\]=.*last finite state"):
        renderer().rgb(x)
    with pytest.raises(ValueError, match=r"positions\[1, 7\]="):
        renderer().depth_batch(np.stack([sheet(), x]))


@pytest.mark.parametrize("far", [1e5, 1e10, 1e37])
def test_positions_far_out_are_harmless(far):
    x = sheet()
    x[::7] *= far
    for smooth in (False, True):
        assert renderer(smooth=smooth).rgb(x).shape == (120, 120, 3)


def test_a_collapsed_cloth_is_harmless():
    draw = renderer(smooth=True)
    assert np.array_equal(draw.depth(np.full((81, 3), 0.2)), draw.depth(FAR_AWAY))
    assert draw.rgb(np.zeros((81, 3))).shape == (120, 120, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width=0"),
        ({"height": 2.5}, "height=2.5"),
        ({"antialias": 0}, "antialias=0"),
        ({"threads": 0}, "threads=0"),
        ({"check": -1.0}, "check=-1.0"),
        ({"front": (300, 0, 0)}, r"front=\(300, 0, 0\)"),
        ({"grid_shape": (3, 3)}, r"grid_shape=\(3, 3\)"),
        ({"camera": Camera(eye=(1, 1, -1), target=(0, 0, 0))}, "above the floor"),
        ({"uv": np.zeros((4, 3))}, "uv has shape"),
        ({"triangles": [[0, 1, 99]]}, "0 to 99"),
        ({"triangles": [[0.5, 1, 2]]}, "integers"),
    ],
)
def test_wrong_renderers_are_refused(options, message):
    mesh = grid(4, 4, SIDE, SIDE)
    arguments = {"triangles": mesh.triangles, "uv": mesh.rest_positions[:, :2], "camera": CAMERA, **options}
    with pytest.raises(ValueError, match=message):
        Renderer(**arguments)


@pytest.mark.parametrize(
    ("solid", "message"),
    [
        ("ball", "'ball' cannot be drawn: must be a Sphere, Capsule, Box or MeshCollider"),
        ((0, 0, 0), r"\(0, 0, 0\) cannot be drawn"),
        (Plane(), "Plane.* cannot be drawn: .* the floor z = 0 is always drawn"),
        ((Sphere(), (1, 2)), r"color of Sphere.*=\(1, 2\): must be three numbers from 0 to 255"),
        (((0, math.nan, 0), (1, 2, 3)), "center holds a value that is not finite"),
    ],
)
def test_what_cannot_be_drawn_is_refused(solid, message):
    for things in ({"solids": [solid]}, {"markers": [solid]}):
        with pytest.raises(ValueError, match=message):
            renderer().depth(sheet(), **things)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"eye": (0, math.nan, 1)}, "eye"),
        ({"eye": (0, 0, 0)}, "must differ from its target"),
        ({"eye": (0, 0, 1)}, "up"),
        ({"vertical_fov": 180.0}, "vertical_fov=180.0"),
        ({"near": 0.0}, "near=0.0"),
    ],
)
def test_wrong_cameras_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{"eye": (1, 1, 1), "target": (0, 0, 0), **arguments})


def test_wrong_scenes_are_refused():
    with pytest.raises(ValueError, match=r"positions have shape \(80, 3\)"):
        renderer().rgb(sheet()[1:])
    with pytest.raises(ValueError, match=r"needs \('environments', 81, 3\)"):
        renderer().rgb_batch(sheet())
    with pytest.raises(ValueError, match="solids has 1 entries for 2 environments"):
        renderer().rgb_batch(np.stack([sheet(), sheet()]), [[]])
    for values in (np.zeros(80), np.full(81, np.nan)):
        with pytest.raises(ValueError, match=r"values have shape .* one for each particle"):
            renderer().rgb(sheet(), values=values)


def test_import_is_light():
    code = "import sys, clothgym.render; print({'PIL', 'imageio', 'imageio_ffmpeg', 'matplotlib', 'trimesh'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"

"""The pictures that are observed, against rays that are cast here: exact intersections in float64, without the code under test."""

import numpy as np
import pytest

from clothgym import Box, Capsule, Plane, Sphere, grid
from clothgym.collisions import MeshCollider
from clothgym.render import Camera, quick, quick_solids

SIZE = 64
CAMERA = Camera(eye=(0.7, -1.1, 0.9), target=(0.0, 0.0, 0.1), vertical_fov=45.0)
ABOVE = Camera(eye=(0.05, -0.1, 1.5), target=(0.05, -0.1, 0.0), up=(0.0, 1.0, 0.0), vertical_fov=50.0)
CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([(a, *pair) for a, b, c, d in QUADS for pair in ((b, c), (c, d))])
TURN = (0.9, 0.2, -0.3, 0.25)  # a quaternion
SOLIDS = {
    "sphere": Sphere(center=(0.25, 0.1, 0.2), radius=0.17),
    "capsule": Capsule(center=(-0.25, 0.05, 0.25), radius=0.06, height=0.4, axis=(1.0, 0.5, 0.8)),
    "box": Box(center=(0.1, -0.3, 0.15), half_sides=(0.12, 0.05, 0.1), yaw=0.4, rotation=TURN),
    "mesh": MeshCollider(vertices=0.1 * CUBE, triangles=FACES, center=(0.3, 0.35, 0.2), rotation=TURN, resolution=16),
    "plane": Plane(point=(0.0, 0.6, 0.0), normal=(0.1, -1.0, 0.4)),
}


def rumpled(seed=0, rows=17):
    """A sheet with waves, folds over itself and noise [m], and its mesh."""
    mesh, rng = grid(rows, rows, 0.6, 0.6), np.random.default_rng(seed)
    x = mesh.rest_positions + (0, 0, 0.12)
    x[:, 2] += 0.08 * np.sin(9 * x[:, 0] + 5 * x[:, 1]) + 0.01 * rng.normal(size=len(x))
    x[:, 0] += 0.12 * np.sin(11 * x[:, 1])
    return mesh, np.float32(x)


# --- rays -----------------------------------------------------------------------------------------------------------------


def rays(camera):
    """Of the middles of the pixels: eye and directions of length 1 along the view axis, (pixels, 3)."""
    forward = np.subtract(camera.target, camera.eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    up, half = np.cross(right, forward), np.tan(np.radians(camera.vertical_fov) / 2)
    a = (2 * (np.arange(SIZE) + 0.5) / SIZE - 1) * half
    return np.array(camera.eye), (forward + a[None, :, None] * right - a[:, None, None] * up).reshape(-1, 3)


def to_triangles(eye, directions, corners):
    """Moeller and Trumbore (1997): t of the first triangle, (triangles, 3, 3), that each ray meets."""
    a, e, f = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    first = np.full(len(directions), np.inf)
    eyes = np.broadcast_to(eye, directions.shape)
    for p, u, v in zip(a, e, f):
        h = np.cross(directions, v)
        det = h @ u
        with np.errstate(all="ignore"):
            s = eyes - p
            alpha = (s * h).sum(axis=1) / det
            q = np.cross(s, u)
            beta = (directions * q).sum(axis=1) / det
            t = q @ v / det
        hit = (alpha >= 0) & (beta >= 0) & (alpha + beta <= 1) & (t > 0)
        first = np.where(hit & (t < first), t, first)
    return first


def marched(eye, directions, distance):
    """t at which a signed distance, of (points, 3), becomes negative: steps of that length, then halving."""
    t = np.zeros(len(directions))
    speed = np.linalg.norm(directions, axis=1)
    for _ in range(400):
        t = np.minimum(t + np.maximum(distance(eye + t[:, None] * directions), 0) / speed, 20.0)
    near = distance(eye + t[:, None] * directions) < 1e-5
    return np.where(near, t, np.inf)


def axes_of(quaternion):
    """Columns: the turned x, y and z axes; by Rodrigues's formula for the rotation vector."""
    w, *v = np.array(quaternion) / np.linalg.norm(quaternion)
    angle, axis = 2 * np.arccos(w), np.array(v) / np.linalg.norm(v)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def depth_of(name, eye, directions):
    """t of the first point of a solid that each ray meets."""
    solid = SOLIDS[name]
    if name == "plane":
        normal = np.array(solid.normal)
        with np.errstate(all="ignore"):
            t = (np.array(solid.point) - eye) @ normal / (directions @ normal)
        return np.where((directions @ normal < 0) & (t > 0), t, np.inf)
    center = np.array(solid.center)
    if name == "sphere":
        return marched(eye, directions, lambda x: np.linalg.norm(x - center, axis=1) - solid.radius)
    if name == "capsule":
        axis = np.array(solid.axis) / np.linalg.norm(solid.axis)
        half = solid.height / 2 - solid.radius

        def distance(x):
            along = np.clip((x - center) @ axis, -half, half)
            return np.linalg.norm(x - center - along[:, None] * axis, axis=1) - solid.radius

        return marched(eye, directions, distance)
    turn = axes_of(TURN)
    if name == "box":
        c, s = np.cos(solid.yaw), np.sin(solid.yaw)
        turn = turn @ np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)])
    corners = (CUBE * (solid.half_sides if name == "box" else 0.1)) @ turn.T + center
    return to_triangles(eye, directions, corners[FACES])


# --- pictures -------------------------------------------------------------------------------------------------------------


def picture(kind, sight, x, mesh, names=(), **numbers):
    """One environment's, by the kernel that draws batches."""
    colliders = [SOLIDS[name] for name in names]
    surfaces = quick.surfaces_of(mesh.triangles, [one.surface if isinstance(one, MeshCollider) else None for one in colliders])
    shapes = np.array([quick_solids.shape_of(one) for one in colliders], np.int64)
    rows = quick_solids.hidden(1, len(colliders))
    for k, one in enumerate(colliders):
        own = one.rows()
        rows[0, k, : quick_solids.RADIUS] = own[:15]
        rows[0, k, quick_solids.RADIUS] = getattr(one, "radius", 0.0)
        rows[0, k, quick_solids.COLOR :] = (196, 189, 178)
    zero = np.zeros(1, np.int64)
    size = {quick.RGB: 3, quick.RGBD: 4}.get(kind, 1) * SIZE * SIZE
    colors, values = np.zeros((1, size), np.uint8), np.zeros((1, size), np.float32)
    block = np.ascontiguousarray(x.T[None, :, :, None])
    quick.draw_pictures(
        0, 1, kind, zero, (zero, zero), block, surfaces, (shapes, rows), quick.views_from(sight),
        (np.zeros((1, 3), np.float32), numbers.get("per_side", 1.0), numbers.get("bound", 20.0)), (colors, values),
    )  # fmt: skip
    return (colors if kind == quick.RGB else values)[0].reshape(SIZE, SIZE, -1)


@pytest.mark.parametrize("camera", [CAMERA, ABOVE])
@pytest.mark.parametrize("names", [(), *((name,) for name in SOLIDS), tuple(SOLIDS)])
def test_depths_are_those_of_cast_rays(camera, names):
    """Within a tenth of a millimeter at each of 4096 pixels; the promise is one."""
    mesh, x = rumpled()
    eye, directions = rays(camera)
    expected = to_triangles(eye, directions, x[mesh.triangles].astype(float))
    cloth = np.isfinite(expected).sum()
    for name in names:
        solid = depth_of(name, eye, directions)
        assert (solid < np.inf).sum() > 20
        expected = np.minimum(expected, solid)
    with np.errstate(all="ignore"):
        floor = np.where(directions[:, 2] < 0, -eye[2] / directions[:, 2], np.inf)
    expected = np.minimum(np.minimum(expected, floor), 20.0)
    depth = picture(quick.DEPTH, quick.sight_of(camera, SIZE), x, mesh, names).ravel()
    assert cloth > 300 and np.abs(depth - expected).max() < 1e-4


@pytest.mark.parametrize("names", [(), tuple(SOLIDS)])
def test_heights_are_those_of_rays_from_straight_above(names):
    mesh, x = rumpled(1)
    sight = quick.straight_down(np.array([0.05, -0.02]), 0.5, SIZE)
    at = (np.arange(SIZE) + 0.5 - SIZE / 2) / SIZE
    px, py = np.meshgrid(0.05 + at, -0.02 - at)
    eyes = np.stack([px, py, np.full_like(px, 5.0)], axis=-1).reshape(-1, 3)
    down = np.broadcast_to((0.0, 0.0, -1.0), eyes.shape)
    expected = to_triangles(eyes, down, x[mesh.triangles].astype(float))
    for name in names:
        if name == "plane":
            plane = SOLIDS[name]
            solid = ((eyes - plane.point) @ plane.normal) / plane.normal[2]
        else:
            solid = depth_of(name, eyes, down)
        expected = np.minimum(expected, solid)
    heights = picture(quick.HEIGHTS, sight, x, mesh, names, per_side=2.0).ravel()
    assert np.abs(heights - np.maximum(2 * (5.0 - expected), 0)).max() < 2e-4


def test_no_pixel_falls_between_two_triangles():
    """A flat sheet across samples that lie exactly on its edges, from straight above: all of its square is cloth."""
    mesh = grid(17, 17, 0.5, 0.5)
    x = np.float32(mesh.rest_positions + (0, 0, 0.25))
    # particles every 2 pixels, on the middles of pixels
    sight = quick.straight_down(np.array([0.5 / 64, -0.5 / 64]), 0.5, SIZE)
    heights = picture(quick.HEIGHTS, sight, x, mesh)[..., 0]
    assert (heights == 0.25).sum() == 33 * 33 and set(np.unique(heights)) == {0, 0.25}


def test_both_sides_have_their_color_and_lambert_s_law_their_brightness():
    """A level sheet, from above and turned over, and one upright to the light: shares of 0.45 + 0.55 cos."""
    mesh = grid(5, 5, 0.8, 0.8)
    flat = np.float32(mesh.rest_positions + (0, 0, 0.3))
    over = flat * np.float32([-1, 1, 1])
    light = np.array(quick_solids.SUN)
    assert np.linalg.norm(light) == pytest.approx(1, abs=1e-3)
    sight = quick.sight_of(ABOVE, SIZE)
    for x, color in ((flat, quick.CORAL), (over, quick.INDIGO)):
        middle = picture(quick.RGB, sight, x, mesh)[32, 32]
        assert middle.tolist() == pytest.approx(np.array(color) * (0.45 + 0.55 * light[2]), abs=1)
    # a ball is brightest where it faces the light, and has the sky's share where it does not
    lit = picture(quick.RGB, quick.sight_of(CAMERA, SIZE), flat + np.float32((50, 0, 0)), mesh, ("sphere",))
    eye, directions = rays(CAMERA)
    t = depth_of("sphere", eye, directions)
    hit = np.isfinite(t)
    normals = (eye + t[hit, None] * directions[hit] - SOLIDS["sphere"].center) / 0.17
    expected = np.outer(0.45 + 0.55 * np.maximum(normals @ light, 0), (196, 189, 178))
    assert hit.sum() > 100 and np.abs(lit.reshape(-1, 3)[hit] - expected).max() < 2


def test_points_behind_the_camera_and_nonfinite_points_are_not_drawn():
    mesh, x = rumpled()
    sight = quick.sight_of(CAMERA, SIZE)
    empty = picture(quick.RGB, sight, x + np.float32((9, -15, 9)), mesh)
    assert np.array_equal(empty, sight.color)
    x[40] = np.nan
    assert not np.array_equal(picture(quick.RGB, sight, x, mesh), empty)
    assert np.array_equal(picture(quick.RGB, sight, np.full_like(x, np.nan), mesh), empty)


def test_a_mesh_is_no_marker():
    with pytest.raises(ValueError, match="cannot be a marker"):
        quick_solids.solid_row(SOLIDS["mesh"])

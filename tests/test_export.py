"""Floor 6: what is written to a file is what was simulated, by readers that are not ours."""

from __future__ import annotations

import json
import struct
import subprocess
import sys

import numpy as np
import pytest

from clothgym import Simulation, Sphere, grid
from clothgym.render import MeshSequence, write_animation, write_meshes, write_picture, write_video

trimesh = pytest.importorskip("trimesh")

MESH = grid(6, 5, 0.5, 0.4)
UV = MESH.rest_positions[:, :2] / 0.5 + 0.5
BALL = Sphere(center=(0.0, 0.0, 0.1), radius=0.1)


@pytest.fixture(scope="module")
def simulated():
    """Frames of a sheet that falls on to a ball [m], (5, particles, 3) float32."""
    cloth = Simulation(MESH, colliders=[Sphere(center=BALL.center, radius=BALL.radius)])
    cloth.reset(positions=MESH.rest_positions + [0, 0, 0.22])
    frames = []
    for _ in range(5):
        cloth.step(3)
        frames.append(cloth.positions[0])
    return np.stack(frames)


def read(path):
    """Meshes of a file by name, as trimesh reads them, with its vertices as they stand there."""
    scene = trimesh.load_scene(path, process=False, maintain_order=True, split_objects=True)
    return scene, scene.geometry


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_meshes_are_the_simulated_positions_to_the_bit(simulated, tmp_path, kind):
    files = write_meshes(tmp_path / "sheet", simulated, MESH.triangles, UV, kind)
    assert [file.name for file in files] == [f"frame_{k:05d}.{kind}" for k in range(5)]
    assert sorted((tmp_path / "sheet").iterdir()) == files
    for file, frame in zip(files, simulated):
        (mesh,) = read(file)[1].values()
        np.testing.assert_array_equal(mesh.vertices.astype(np.float32), frame)
        np.testing.assert_array_equal(mesh.faces, MESH.triangles)
        np.testing.assert_allclose(mesh.visual.uv, UV, atol=1e-7)


def test_glb_stands_upright_and_brings_the_solids(simulated, tmp_path):
    (path,) = write_meshes(tmp_path, simulated[:1], MESH.triangles, kind="glb", solids=[[BALL]])
    scene, meshes = read(path)
    assert list(meshes) == ["cloth", "sphere_0"]
    turn = scene.graph.get("cloth")[0]
    # glTF is y up: the height becomes y, and what is right stays right
    np.testing.assert_array_equal(turn[:3, :3] @ [0, 0, 1], [0, 1, 0])
    np.testing.assert_array_equal(turn[:3, :3] @ [1, 0, 0], [1, 0, 0])
    assert np.linalg.det(turn[:3, :3]) == 1
    assert np.linalg.norm(meshes["sphere_0"].vertices - BALL.center, axis=1) == pytest.approx(BALL.radius, abs=1e-6)
    assert meshes["sphere_0"].volume == pytest.approx(4 / 3 * np.pi * BALL.radius**3, rel=0.02)  # its faces turn outwards


def test_obj_brings_the_solids_too(simulated, tmp_path):
    (path,) = write_meshes(tmp_path, simulated[:1], MESH.triangles, UV, solids=[[BALL]])
    meshes = read(path)[1]
    assert set(meshes) == {"cloth", "sphere_0"}
    np.testing.assert_array_equal(meshes["cloth"].vertices.astype(np.float32), simulated[0])
    assert meshes["sphere_0"].volume == pytest.approx(4 / 3 * np.pi * BALL.radius**3, rel=0.02)


def chunks(path):
    """The JSON and the binary part of a .glb, read by the letter of the standard."""
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    second, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, 28 + length + second) == (b"BIN\0", total) and length % 4 == second % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def accessor(document, binary, number):
    one = document["accessors"][number]
    view = document["bufferViews"][one["bufferView"]]
    shape = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,)}[one["type"]]
    values = np.frombuffer(
        binary, {5126: "<f4", 5125: "<u4"}[one["componentType"]], one["count"] * (shape or (1,))[0], view["byteOffset"]
    )
    values = values.reshape(one["count"], *shape)
    for name, bound in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
        assert name not in one or np.array_equal(np.float32(one[name]), np.atleast_1d(bound))
    return values


def test_an_animation_gives_each_frame_back_at_its_time(simulated, tmp_path):
    path = tmp_path / "film.glb"
    moved = [[Sphere(center=(0.1 * k, 0.0, 0.1), radius=0.1), BALL] for k in range(5)]
    write_animation(path, simulated, MESH.triangles, UV, fps=20, solids=moved)
    np.testing.assert_array_equal(read(path)[1]["cloth"].vertices.astype(np.float32), simulated[0])
    document, binary = chunks(path)
    channels = document["animations"][0]["channels"]
    assert [document["nodes"][c["target"]["node"]]["name"] for c in channels] == ["cloth", "sphere_0"]  # the second ball rests
    for channel, start in zip(channels, (simulated[:, 0], np.array([things[0].center for things in moved]) + [0, 0, 0.1])):
        sampler = document["animations"][0]["samplers"][channel["sampler"]]
        primitive = document["meshes"][document["nodes"][channel["target"]["node"]]["mesh"]]["primitives"][0]
        times = accessor(document, binary, sampler["input"])
        weights = accessor(document, binary, sampler["output"]).reshape(len(times), len(primitive["targets"]))
        base = accessor(document, binary, primitive["attributes"]["POSITION"])
        targets = np.stack([accessor(document, binary, target["POSITION"]) for target in primitive["targets"]])
        np.testing.assert_allclose(times, np.arange(5) / 20, rtol=1e-6)
        shown = base + np.einsum("tk,kvc->tvc", weights, targets)
        np.testing.assert_allclose(shown[:, 0], start, atol=1e-6)
        if base.shape == simulated[0].shape:
            np.testing.assert_allclose(shown, simulated, atol=1e-7)


def test_a_sequence_goes_on_and_never_mixes(simulated, tmp_path):
    sequence = MeshSequence(tmp_path, MESH.triangles, kind="glb")
    sequence.add(simulated[0])
    broken = simulated[1].copy()
    broken[7] = np.nan
    with pytest.raises(ValueError, match=r"particle 7 in frame 0 are \[nan.*last finite frame"):
        sequence.add(broken)
    sequence.add(simulated[2])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["frame_00000.glb", "frame_00001.glb"]
    for kind in ("obj", "glb"):
        with pytest.raises(FileExistsError, match=r"holds 2 frames already \(frame_00000.glb to frame_00001.glb\)"):
            write_meshes(tmp_path, simulated, MESH.triangles, kind=kind)


def test_wrong_meshes_are_refused_before_anything_is_written(simulated, tmp_path):
    late = simulated.copy()
    late[3, 2, 1] = np.inf
    cases = [
        ({"positions": late}, "particle 2 in frame 3"),
        ({"positions": simulated[0]}, r"positions have shape \(30, 3\)"),
        ({"positions": simulated[:, :9]}, r"at least 30"),
        ({"positions": simulated[:, :, :2]}, r"must be \(frames, particles, 3\)"),
        ({"uv": UV[:8]}, r"uv have shape \(8, 2\)"),
        ({"triangles": MESH.triangles + 0.5}, "triangles have shape"),
        ({"kind": "fbx"}, "mesh kind='fbx': must be 'obj' or 'glb'"),
        ({"solids": [[BALL]]}, "solids has 1 entries for 5 frames"),
    ]
    for wrong, message in cases:
        arguments = {"positions": simulated, "triangles": MESH.triangles, **wrong}
        with pytest.raises(ValueError, match=message):
            write_meshes(tmp_path / "new", **arguments)
    with pytest.raises(ValueError, match=r"must end in \.glb"):
        write_animation(tmp_path / "a.fbx", simulated, MESH.triangles)
    with pytest.raises(ValueError, match="change in number or kind"):
        write_animation(tmp_path / "a.glb", simulated[:2], MESH.triangles, solids=[[BALL], []])
    assert not list(tmp_path.iterdir())


def test_a_picture_keeps_its_pixels(tmp_path):
    iio = pytest.importorskip("imageio.v3")
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    write_picture(tmp_path / "a.png", image)
    np.testing.assert_array_equal(iio.imread(tmp_path / "a.png"), image)
    for path, picture, message in (
        (tmp_path / "a.jpg", image, r"must end in \.png"),
        (tmp_path / "a.png", image[..., 0], "image has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            write_picture(path, picture)


# video


def frames():
    return [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(5)]


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_films_keep_frames_and_loop(tmp_path, ending):
    image = pytest.importorskip("PIL.Image")
    write_video(tmp_path / f"a.{ending}", frames(), fps=10)
    with image.open(tmp_path / f"a.{ending}") as film:
        film.seek(4)
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - 80).max() <= 4
        assert (film.n_frames, film.size, film.info["loop"], film.info["duration"]) == (5, (48, 32), 0, 100)


def test_a_webp_keeps_the_rate_of_thirty_a_second(tmp_path):
    """33 or 34 ms each, so that three of them are a tenth of a second."""
    image = pytest.importorskip("PIL.Image")
    write_video(tmp_path / "a.webp", [np.full((8, 8, 3), 40 * i, np.uint8) for i in range(6)], fps=30)
    with image.open(tmp_path / "a.webp") as film:
        durations = []
        for k in range(film.n_frames):
            film.seek(k)
            film.load()
            durations.append(film.info["duration"])
    assert durations == [33, 34, 33, 33, 34, 33]


def test_a_small_thing_keeps_its_color_in_a_gif(tmp_path):
    """A green dot on 0.02 % of a picture of greys and reds."""
    pytest.importorskip("PIL.Image")
    down, across = np.mgrid[:240, :240] / 240
    image = np.stack([120 + 130 * down, 120 + 130 * down - 12 * across, 120 + 130 * down - 30 * across], axis=2).astype(np.uint8)
    image[:, :80] = image[:, :80] * (1.0, 0.4, 0.3)
    image[60:63, 60:63] = (40, 160, 80)
    write_video(tmp_path / "a.gif", [image] * 2, fps=10)
    np.testing.assert_allclose(shown(tmp_path / "a.gif", 240, 240)[0, 60:63, 60:63].mean(axis=(0, 1)), (40, 160, 80), atol=16)


def shown(path, height, width):
    """The frames of a film as other programs read them, (frames, height, width, 3)."""
    if path.suffix == ".gif":
        with pytest.importorskip("PIL.Image").open(path) as gif:
            return np.stack([np.asarray(page.convert("RGB")) for page in pytest.importorskip("PIL.ImageSequence").Iterator(gif)])
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [ffmpeg, "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


def test_mp4_keeps_frames(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    write_video(str(tmp_path / "a.mp4"), [np.full((31, 47, 3), 90, np.uint8)] * 6, fps=30)
    # a row and a column more: players want even numbers
    film = shown(tmp_path / "a.mp4", 32, 48)
    assert len(film) == 6
    assert np.abs(film.astype(int) - 90).max() <= 8


def test_wrong_videos_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in .webp, .gif or .mp4"):
        write_video(tmp_path / "a.avi", frames())
    with pytest.raises(ValueError, match="empty"):
        write_video(tmp_path / "a.gif", [])
    with pytest.raises(ValueError, match="fps=0"):
        write_video(tmp_path / "a.gif", frames(), fps=0)
    with pytest.raises(ValueError, match="frame 1 has shape"):
        write_video(tmp_path / "a.gif", [frames()[0], np.zeros((3, 3, 3), np.uint8)])


@pytest.mark.parametrize(("ending", "package"), [("gif", "PIL"), ("webp", "PIL"), ("mp4", "imageio_ffmpeg")])
def test_a_missing_package_names_the_extra(tmp_path, monkeypatch, ending, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r"clothgym\[video\]"):
        write_video(tmp_path / f"a.{ending}", frames())


@pytest.mark.parametrize(("ending", "package"), [("gif", "PIL"), ("webp", "PIL"), ("mp4", "imageio_ffmpeg")])
def test_an_error_on_the_way_keeps_the_frames_before_it(tmp_path, ending, package):
    pytest.importorskip(package)

    def cut_short():
        yield from frames()[:3]
        raise RuntimeError("the simulation has diverged")

    before = tmp_path / f"film.{ending}"
    before.write_bytes(b"what was there")
    with pytest.raises(RuntimeError, match="diverged") as caught:
        write_video(before, cut_short(), fps=10)
    assert f"film.part.{ending}" in caught.value.__notes__[0]
    assert before.read_bytes() == b"what was there"
    kept = shown(tmp_path / f"film.part.{ending}", 32, 48)
    np.testing.assert_allclose(kept[:, 16, 24, 0], [0, 20, 40], atol=6)

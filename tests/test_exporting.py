"""Floor 8: ``python -m clothgym export``, against the simulation run by hand."""

from __future__ import annotations

import numpy as np
import pytest
from test_export import read, shown

from clothgym.cli import main
from clothgym.collisions import Sphere
from clothgym.playground import exporting
from clothgym.playground.exporting import lasting, moments, painter, stage_named, strain_shares
from clothgym.playground.scenes import FRAME, drive, scene_named
from clothgym.render import Drawn

SHORT = ["--seconds", "0.2"]  # six frames


def export(*arguments):
    assert main(["export", *map(str, arguments)]) == 0


STILL = ("--set", "gravity=9.81", "wind=0", "gust=0")


def by_hand(frames):
    """The pinned patch under gravity in still air, two control steps a frame [m], (frames, particles, 3)."""
    scene = scene_named("patch")
    simulation = scene.simulation(scene.settings.changed(gravity=9.81))
    positions = [simulation.positions[0]]
    for step in range(2 * (frames - 1)):
        drive(simulation, scene, step * FRAME)
        simulation.step()
        if step % 2:
            positions.append(simulation.positions[0])
    return np.stack(positions)


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_a_folder_of_meshes_is_the_simulation_to_the_bit(tmp_path, kind):
    pytest.importorskip("trimesh")
    export("patch", "--out", tmp_path / "meshes", "--kind", kind, *STILL, *SHORT)
    files = sorted((tmp_path / "meshes").iterdir())
    assert [file.name for file in files] == [f"frame_{k:05d}.{kind}" for k in range(6)]
    for file, truth in zip(files, by_hand(6)):
        (mesh,) = read(file)[1].values()
        np.testing.assert_array_equal(mesh.vertices.astype(np.float32), truth)


def test_films_and_pictures_have_the_frames_and_pixels_asked_for(tmp_path):
    pytest.importorskip("PIL")
    export("patch", "--out", tmp_path / "a.gif", "--size", 64, "--color", "strain", *SHORT)
    assert shown(tmp_path / "a.gif", 64, 64).shape == (6, 64, 64, 3)
    export("patch", "--out", tmp_path / "b.gif", "--size", 64, "--fps", 10, *SHORT)
    assert len(shown(tmp_path / "b.gif", 64, 64)) == 2
    export("ClothReach-v0", "--out", tmp_path / "c.png", "--size", 64, "--seed", 3, "--policy", "noop", *SHORT)
    picture = pytest.importorskip("PIL.Image").open(tmp_path / "c.png")
    stage = stage_named("ClothReach-v0", 3, "noop")
    for _ in range(round(0.2 / stage.recording.time_step)):
        stage.advance()
    np.testing.assert_array_equal(np.asarray(picture), painter(stage.recording, 64, 3)(stage.frame))


def test_an_episode_is_told_to_its_end_and_plays_as_one_mesh(tmp_path):
    pytest.importorskip("trimesh")
    export("ClothReach-v0", "--out", tmp_path / "reach.glb", "--seed", 3)
    stage = stage_named("ClothReach-v0", 3)
    frames = list(moments(stage))
    assert stage.over and len(frames) == stage.env.task.acting_steps + 1
    meshes = read(tmp_path / "reach.glb")[1]
    np.testing.assert_array_equal(meshes["cloth"].vertices.astype(np.float32), frames[0].positions[0])


def test_animated_meshes_exclude_solids_that_appear_or_disappear():
    ball, pin = (Drawn(Sphere(center=(0, 0, 1), radius=radius)) for radius in (0.2, 0.01))
    there = Drawn(Sphere(center=(0, 1, 1), radius=0.2))
    assert lasting([[pin, ball, pin], [there, pin]]) == [[ball], [there]]


def test_the_strain_of_a_particle_is_the_largest_of_its_threads():
    stage = stage_named("patch")
    for _ in range(8):
        stage.advance()
    recording, x = stage.recording, stage.frame.positions[0].astype(float)
    mesh = recording.mesh
    rows, columns = mesh.shape
    grid = x.reshape(rows, columns, 3)
    truth = np.zeros((rows, columns))
    for axis, spacing in ((0, 0.6 / (rows - 1)), (1, 0.6 / (columns - 1))):
        strain = np.linalg.norm(np.diff(grid, axis=axis), axis=2) / spacing - 1
        before, after = ([(0, 0), (0, 0)] for _ in range(2))
        before[axis], after[axis] = (1, 0), (0, 1)
        beside = np.maximum(np.pad(strain, before, constant_values=-1), np.pad(strain, after, constant_values=-1))
        truth = beside if axis == 0 else np.maximum(truth, beside)
    shares = strain_shares(recording, stage.frame.positions[0]).reshape(rows, columns)
    np.testing.assert_allclose(shares * recording.strained, truth, atol=1e-5)
    assert truth.ravel()[shares.argmax()] == pytest.approx(truth.max(), rel=1e-4) and truth.max() > 0.02


@pytest.mark.parametrize("ending", ["gif", "glb"])
def test_an_export_of_a_diverging_scene_explains_and_keeps_earlier_frames(tmp_path, ending):
    pytest.importorskip("PIL")
    with pytest.raises(SystemExit) as caught:
        main(
            ["export", "patch", "--out", str(tmp_path / f"a.{ending}"), "--size", "64"]
            + ["--set", "integrator=explicit_euler", "substeps=2", "stretch_stiffness=5000"]
        )
    assert "Explicit Euler burst" in caught.value.code and f"a.part.{ending}" in caught.value.code
    assert [file.name for file in tmp_path.iterdir()] == [f"a.part.{ending}"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 100.0}, "fps=100.0: patch has 30 frames a second"),
        ({"seconds": -1.0}, "seconds=-1.0: must be positive"),
        ({"size": 0}, "size=0: must be an integer"),
        ({"color": "heat"}, "color='heat': must be 'fabric' or 'strain'"),
        ({"kind": "stl"}, "kind='stl': must be 'obj' or 'glb'"),
        ({"policy": "nobody"}, "no policy 'nobody'"),
        ({"settings": {"gravty": 1}}, "no setting 'gravty'"),
    ],
)
def test_wrong_options_are_refused_before_a_stage_is_made(tmp_path, monkeypatch, options, message):
    monkeypatch.setattr(exporting, "SceneStage", None)
    with pytest.raises(ValueError, match=message):
        exporting.export("patch", tmp_path / "a.gif", **options)
    assert not list(tmp_path.iterdir())


def test_settings_of_an_environment_are_refused(tmp_path):
    with pytest.raises(ValueError, match="are of scenes; ClothReach-v0 has its own"):
        exporting.export("ClothReach-v0", tmp_path / "a.gif", settings={"gravity": 1.0})
    assert not list(tmp_path.iterdir())


def test_a_folder_that_holds_frames_and_a_missing_library_are_told_before_a_stage_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "SceneStage", None)
    (tmp_path / "frame_00000.obj").touch()
    with pytest.raises(FileExistsError, match="holds 1 frames already"):
        exporting.export("patch", tmp_path)
    monkeypatch.setattr(exporting, "find_spec", lambda name: None)
    for ending, library in (("gif", "PIL"), ("mp4", "imageio_ffmpeg")):
        with pytest.raises(ImportError, match=f"needs {library}: pip install"):
            exporting.export("patch", tmp_path / f"a.{ending}")

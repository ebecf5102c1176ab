"""Recordings of the playground as files: what is loaded equals what was saved, and other files are refused."""

import json
import zipfile

import numpy as np
import pytest
from stages import advanced

from clothgym.playground.episode import EpisodeStage, Replay
from clothgym.playground.recording import Recording
from clothgym.playground.stage import SceneStage


@pytest.mark.parametrize(
    "make", [lambda: SceneStage("pawn"), lambda: EpisodeStage("ClothDrapeGripper-v0")], ids=["scene", "episode"]
)
def test_a_replay_equals_the_recording_to_the_bit(make, tmp_path):
    stage = advanced(make(), 12)
    stage.recording.save(tmp_path / "it.npz")
    replay = Replay(Recording.load(tmp_path / "it.npz"))
    frames = replay.recording.frames
    assert len(frames) == 13 and replay.over and replay.advance() is frames[-1]
    for mine, theirs in zip(frames, stage.recording.frames):
        assert np.array_equal(mine.positions, theirs.positions) and mine.positions.dtype == np.float32
        assert mine.solids == theirs.solids and mine.terms == theirs.terms
        assert all(np.array_equal(mine.readings[name], theirs.readings[name]) for name in theirs.readings)
    mesh, given = replay.recording.mesh, stage.recording.mesh
    assert np.array_equal(mesh.springs.particles, given.springs.particles) and mesh.shape == given.shape


def test_files_that_are_no_recordings_are_refused_and_nothing_is_unpickled(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickle.npz", about=np.array([{"a": 1}], dtype=object))
    (tmp_path / "text.npz").write_text("cloth")
    stage = advanced(SceneStage("patch"), 2)
    stage.recording.save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "broken.npz", **(arrays | {"positions": arrays["positions"][:, :, :5]}))
    np.savez(tmp_path / "twice.npz", **(arrays | {"positions": np.repeat(arrays["positions"], 2, axis=1)}))
    for name in ("other", "pickle", "text", "broken", "twice"):
        with pytest.raises(ValueError, match="is no recording") as caught:
            Recording.load(tmp_path / f"{name}.npz")
        assert "unsafely" not in str(caught.value)
    with pytest.raises(FileNotFoundError):
        Recording.load(tmp_path / "nowhere.npz")
    assert zipfile.is_zipfile(tmp_path / "good.npz") and json.loads(str(arrays["about"]))["title"] == "Pinned patch"

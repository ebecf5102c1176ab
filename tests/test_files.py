"""Files and states of strangers, damaged ones, and a full disk: a sentence each, and nothing half done."""

import copy
import errno
import io
import itertools
import os
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from clothgym import Simulation, Sphere, State, files, grid
from clothgym.envs.episode import TaskState
from clothgym.playground.recording import Recording
from clothgym.state import VERSION

READERS = [Recording.load, State.load, TaskState.load, lambda path: files.read_json(path, "object", "give another")]


def made(env_id="ClothReach-v0", **kwargs):
    """An environment in mid-episode."""
    env = gym.make(f"clothgym:{env_id}", **kwargs).unwrapped
    env.reset(seed=3)
    for _ in range(3):
        env.step(np.full(env.action_space.shape, 0.3, np.float32))
    return env


def contents(state):
    """All that a state holds, to be compared."""
    physics = getattr(state, "simulation", state)
    tables = [physics.arrays(), {} if physics is state else state.episode]
    return [{name: np.asarray(array).tobytes() for name, array in one.items()} for one in tables], getattr(
        state, "generators", None
    )


# --- writing --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("place", ["write_bytes", "replace"])
def test_a_full_disk_and_ctrl_c_leave_the_previous_file_and_no_other(tmp_path, monkeypatch, error, place):
    simulation = Simulation(grid(4, 4, 0.1, 0.1))
    simulation.get_state().save(tmp_path / "state.npz")
    whole, real = (tmp_path / "state.npz").read_bytes(), getattr(Path, place)

    def full(path, argument):
        real(path, argument[:100] if place == "write_bytes" else path.with_name("elsewhere.part"))
        raise error

    monkeypatch.setattr(Path, place, full)
    simulation.step()
    with pytest.raises(type(error)) as caught:
        simulation.get_state().save(tmp_path / "state.npz")
    (tmp_path / "elsewhere.part").unlink(missing_ok=True)
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"] and (tmp_path / "state.npz").read_bytes() == whole
    if isinstance(error, OSError):
        said = str(caught.value)
        assert caught.value.errno == errno.ENOSPC and said.startswith(f"'{tmp_path}/state.npz' could not be written (No space")
        assert "is whole" in said and "do it again" in said


def test_the_one_before_is_kept_and_devices_are_not_replaced(tmp_path):
    for content in (b"one", b"two", b"three"):
        with files.replacing(tmp_path / "it", tmp_path / "before") as part:
            part.write_bytes(content)
    assert (tmp_path / "it").read_bytes() == b"three" and (tmp_path / "before").read_bytes() == b"two"
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", "/dev/null"):
        with pytest.raises(ValueError, match="is no regular file: name one"):
            files.write(path, "text")


def test_a_film_that_ffmpeg_could_not_finish_is_none(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    from clothgym.render import export

    frames = [np.zeros((16, 16, 3), np.uint8)] * 3
    export.write_video(tmp_path / "good.mp4", frames)
    good = (tmp_path / "good.mp4").read_bytes()
    assert b"moov" in good and good.index(b"mdat") < good.index(b"moov")
    assert export._is_whole(tmp_path / "good.mp4")
    (tmp_path / "cut.mp4").write_bytes(good[: good.index(b"moov") - 4])
    assert not export._is_whole(tmp_path / "cut.mp4")
    (tmp_path / "cut.mp4").unlink()
    monkeypatch.setattr(export, "_is_whole", lambda path: False)
    with pytest.raises(OSError, match="bad.mp4' could not be written .ffmpeg could not finish"):
        export.write_video(tmp_path / "bad.mp4", frames)
    assert [path.name for path in tmp_path.iterdir()] == ["good.mp4"]


# --- reading --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", READERS)
def test_special_files_are_refused_at_once(read, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "empty").touch()
    for path in ("/dev/zero", tmp_path / "pipe", tmp_path, tmp_path / "empty"):
        with pytest.raises(ValueError, match=f"{str(path)!r} is no (recording|state|task state|object) .*: give "):
            read(path)
    with open(tmp_path / "vast", "wb") as file:
        file.truncate(2**40)
    with pytest.raises(ValueError, match="larger than"):
        read(tmp_path / "vast")
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "nowhere")


@pytest.mark.parametrize("shape", [(10**12,), (2**62, 4), (-1,), (10**6, 10**6, 3)])
def test_a_header_is_held_against_the_file_before_memory_is_taken(shape, tmp_path):
    buffer, header = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("positions.npy", header.getvalue() + bytes(64))
    (tmp_path / "it.npz").write_bytes(files.marked(buffer.getvalue(), "state", VERSION))
    with pytest.raises(ValueError, match=r"it.npz' is no state .positions.npy has another size than its shape"):
        State.load(tmp_path / "it.npz")


def test_kind_version_and_pickles_are_told_apart(tmp_path):
    path = tmp_path / "it.npz"
    files.write_arrays(path, "recording", 1, {"a": np.arange(3)})
    with pytest.raises(ValueError, match="it is a recording"):
        State.load(path)
    files.write_arrays(path, "state", VERSION + 1, {"a": np.arange(3)})
    with pytest.raises(ValueError, match=f"its format has version {VERSION + 1}, this clothgym reads version {VERSION}"):
        State.load(path)
    np.savez(path, a=np.arange(3))
    with pytest.raises(ValueError, match="lacks the mark"):
        State.load(path)
    buffer = io.BytesIO()
    np.savez(buffer, a=np.array([{}]))
    path.write_bytes(files.marked(buffer.getvalue(), "state", VERSION))
    with pytest.raises(ValueError, match="is no state"):
        State.load(path)
    with pytest.raises(ValueError, match="numbers and text only"):
        files.write_arrays(path, "state", 1, {"a": np.array([{}])})


def test_every_flipped_bit_of_an_object_and_of_an_archive_is_seen(tmp_path):
    path = tmp_path / "it"
    files.write_json(path, {"rate": 0.25, "names": ["a", "b"], "none": None})
    files.write_arrays(tmp_path / "arrays", "state", 1, {"a": np.arange(3)})
    content = path.read_bytes(), (tmp_path / "arrays").read_bytes()
    readers = READERS[3], lambda path: files.read_arrays(path, "state", 1, "give another")
    for whole, read in zip(content, readers):
        for place, bit in itertools.product(range(len(whole.rstrip())), (0, 5)):
            flipped = bytearray(whole)
            flipped[place] ^= 1 << bit
            path.write_bytes(flipped)
            with pytest.raises(ValueError, match="/it' is no"):
                read(path)


# --- states ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "name", "value", "said"),
    [
        ("ClothReach-v0", "potential", np.nan, "potential holds a value that is not finite"),
        ("ClothReach-v0", "goal", np.inf, "goal holds a value that is not finite"),
        ("ClothReach-v0", "distance", 0.0, "distance holds 0: it must be from 0.12"),
        ("ClothReach-v0", "step", 41, "step holds 41: it must be from 0 to 40"),
        ("ClothStrain-v0", "next", 3, "next holds 3: it must be from 0 to 2"),
        ("ClothDrape-v0", "solid", -1, "solid holds -1: it must be from 0 to 2"),
        ("ClothDrape-v0", "radius", 0.7, "target radius=0.7: must be at most 0.6"),
        ("ClothReach-v0", "material", -1.0, "density=-1.0: must be positive"),
        ("ClothReach-v0", "observation", 1e9, "observation holds 1e"),
        ("ClothReach-v0", "simulation.stiffness", -1.0, "stiffness holds -1: it must be from 0"),
        ("ClothReach-v0", "simulation.attachment_positions", 1e35, r"attachment_positions holds 1e\+35"),
        ("ClothDrape-v0", "simulation.colliders", 0.0, "no unit vectors at right angles"),
        ("ClothReach-v0", "simulation.holder", 0, "anchor 0 holds particle 0, which is not its own"),
        ("ClothReach-v0", "simulation.parameters", 0.0, "density=0.0: must be positive"),
        ("ClothReach-v0", "generators", '{"bit_generator": "PCG64"}', "no PCG64 generator"),
        ("ClothReach-v0", "task", "DrapeTask", "the state's task is 'DrapeTask', this environment's 'ReachTask': give"),
    ],
)
def test_a_state_that_no_episode_can_have_is_refused_whole(env_id, name, value, said):
    env = made(env_id)
    before = contents(env.get_state())
    state = made(env_id).get_state()
    state.simulation.positions[:] += 0.1  # what would be seen, had anything been taken over
    state.episode["targets"][:] += 0.1
    if name == "generators":
        state.generators[0] = value
    elif name == "task":
        state.task["task"] = value
    else:
        table, _, field = name.rpartition(".")
        array = getattr(state.simulation, field) if table else state.episode[field]
        array[...] = value
    with pytest.raises(ValueError, match=said):
        env.set_state(state)
    assert contents(env.get_state()) == before


def test_a_state_of_another_kind_of_numbers_is_refused():
    env = made()
    for name, kind in (("step", float), ("over", int), ("potential", complex), ("goal", str)):
        state = env.get_state()
        state.episode[name] = state.episode[name].astype(kind)
        with pytest.raises(ValueError, match=f"the state's {name} is no array of"):
            env.set_state(state)


@pytest.mark.parametrize("env_id", ["ClothReach-v0", "ClothDrapeGripper-v0"])
def test_a_state_from_a_file_goes_on_bit_for_bit(env_id, tmp_path):
    env, other = made(env_id), gym.make(f"clothgym:{env_id}").unwrapped
    env.get_state().save(tmp_path / "state.npz")
    other.set_state(TaskState.load(tmp_path / "state.npz"))
    action = np.full(env.action_space.shape, -0.4, np.float32)
    for _ in range(4):
        (seen, reward, *_), (again, same, *_) = env.step(action), other.step(action)
        assert np.array_equal(seen, again) and reward == same
    # the generator too
    assert np.array_equal(env.reset()[0], other.reset()[0])


def test_a_state_of_other_arguments_or_another_id_is_refused_by_name(tmp_path):
    made("ClothStrain-v0", threshold=0.05).get_state().save(tmp_path / "state.npz")
    state = TaskState.load(tmp_path / "state.npz")
    made("ClothStrain-v0", threshold=0.05, cost_penalty=1.0).set_state(state)
    with pytest.raises(ValueError, match="the state's digest of the arguments is .*made with the same arguments"):
        made("ClothStrain-v0").set_state(state)
    with pytest.raises(ValueError, match="observation mode is 'keypoints', this environment's 'particles'"):
        made("ClothStrain-v0", threshold=0.05, obs_mode="particles").set_state(state)
    with pytest.raises(ValueError, match="task is 'StrainTask', this environment's 'ReachTask'"):
        made().set_state(state)
    mesh = copy.deepcopy(state)
    mesh.simulation.sheet = mesh.simulation.sheet + np.uint64(1)
    with pytest.raises(ValueError, match="of a sheet of another shape or size"):
        made("ClothStrain-v0", threshold=0.05).set_state(mesh)


def test_a_state_next_to_a_round_solid_is_accepted():
    """Axes and sizes in float32 are what colliders have."""
    simulation = Simulation(grid(5, 5, 0.2, 0.2), colliders=[Sphere(center=(0, 0, -0.2))])
    simulation.step(2)
    state = simulation.get_state()
    simulation.step()
    simulation.set_state(state)
    np.testing.assert_array_equal(simulation.positions, state.positions)

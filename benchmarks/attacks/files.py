"""Damaged and hostile files: each ends in a sentence with its name, or in what was written.

An attack takes a file of one of KINDS as we write it.  It is damaged: bytes flipped, cut off, overwritten or added.  Or it is
forged: something in it is exchanged, and its checksum made anew, as a stranger would who has read how.
"""

from __future__ import annotations

import copy
import importlib.util
import io
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from attacks.states import WHOLE, _other, digest
from numpy.typing import NDArray

import clothgym
from clothgym import files
from clothgym.adapters import runs
from clothgym.envs.episode import TaskState
from clothgym.playground.recording import Recording
from clothgym.playground.stage import SceneStage

ARCHIVES = {"state": 1, "task state": 1, "recording": 2}  # their versions
OBJECTS = ("configuration",)
KINDS = (*ARCHIVES, *OBJECTS, *(["checkpoint", "policy"] if importlib.util.find_spec("torch") else []))
SPECIAL = ("/dev/zero", "/dev/null", "/dev/random", "/proc/self/mem", "folder", "pipe", "empty", "link to itself")
CONFIG = {
    "clothgym": clothgym.__version__, "env": "ClothReach-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": {},
    "hyperparameters": {"policy_kwargs": {"net_arch": [8]}}, "num_envs": 4, "timesteps": 100, "seed": 0, "threads": 1,
}  # fmt: skip


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        form = [damaged, damaged, forged, special][rng.integers(4)]
        kind, seed = str(rng.choice(KINDS)), int(rng.integers(2**31))
        yield f"attacks.files.{form.__name__}({kind!r}, {seed})", lambda form=form, kind=kind, seed=seed: form(kind, seed)  # type: ignore[misc]


def damaged(kind: str, seed: int) -> None:
    """Damage a file, and read it.

    Raises:
        ValueError: what the reader says.
        AssertionError: it has read something else than was written.
    """
    rng, (content, read, sound) = np.random.default_rng(seed), _sample(kind)
    changed = damage(content, rng)
    seen = _read(kind, changed, read)
    assert changed == content or seen == sound, "a damaged file was read as something else"


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes with one kind of damage."""
    data, form = bytearray(content), rng.integers(7)
    where = int(rng.integers(len(data)))
    if form <= 1:  # flipped bits, mostly one
        for place in rng.integers(len(data), size=1 if form else rng.integers(1, 9)):
            data[place] ^= 1 << rng.integers(8)
    elif form == 2:  # cut off
        del data[where:]
    elif form == 3:  # overwritten
        data[where : where + 64] = rng.bytes(min(64, len(data) - where))
    elif form == 4:  # a block that was never written
        data[where : where + 512] = bytes(min(512, len(data) - where))
    elif form == 5:  # more than there was
        data[where:where] = rng.bytes(int(rng.integers(1, 99)))
    else:  # one half twice
        data = data[:where] + data[:where]
    return bytes(data)


def forged(kind: str, seed: int) -> None:
    """Exchange something in a file, make its checksum anew, and read it.

    Raises:
        ValueError: what the reader says.
    """
    rng, (content, read, _) = np.random.default_rng(seed), _sample(kind)
    if kind in ARCHIVES:
        _read(kind, files.marked(_forged_archive(content, rng), kind, ARCHIVES[kind]), read)
    elif kind in OBJECTS:
        plain = files.checked_out(json.loads(content))
        plain[str(rng.choice(list(plain)))] = [*WHOLE[:7], -1, 0, 10**30, True, [[]], {"env": 1}, "x" * 99][rng.integers(14)]
        _read(kind, json.dumps(files.checked_in(plain)).encode(), read)
    else:
        _read(kind, _forged_tensors(content, rng), read)


def special(kind: str, seed: int) -> None:
    """Read what is no regular file.

    Raises:
        ValueError, FileNotFoundError: what the reader says.
    """
    name = SPECIAL[seed % len(SPECIAL)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        if name == "pipe":
            os.mkfifo(path)
        elif name == "folder":
            path.mkdir()
        elif name == "empty":
            path.touch()
        else:
            path.symlink_to(path if name == "link to itself" else name)
        _sample(kind)[1](path)


# --- what there is to be read -------------------------------------------------------------------------------------------------


def _read(kind: str, content: bytes, read: Callable[[Path], Any]) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(content)
        return read(path)


@cache
def _sample(kind: str) -> tuple[bytes, Callable[[Path], Any], Any]:
    """A file as we write it, its reader, and what that gives: something that can be compared."""
    makers: dict[str, tuple[Callable[[Path], object], Callable[[Path], Any]]] = {
        "state": (lambda path: _simulation().get_state().save(path), lambda path: digest(clothgym.State.load(path))),
        "task state": (lambda path: _environment().get_state().save(path), lambda path: digest(TaskState.load(path))),
        "recording": (lambda path: _stage().recording.save(path), _recorded),
        "configuration": (lambda path: files.write_json(path, CONFIG), _configured),
        "checkpoint": (_save_checkpoint, lambda path: _tensors(runs.load_tensors(path))),
        "policy": (_save_checkpoint, _acted),
    }
    write, read = makers[kind]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        write(path)
        return path.read_bytes(), read, read(path)


def _simulation() -> clothgym.Simulation:
    simulation = clothgym.Simulation(clothgym.grid(5, 5, 0.3, 0.3), num_envs=2, anchors=[0, 4], colliders=[clothgym.Plane()])
    simulation.step(3)
    return simulation


def _environment() -> Any:
    env: Any = gym.make("ClothReach-v0").unwrapped
    env.reset(seed=0)
    return env


@cache
def _stage() -> SceneStage:
    stage = SceneStage("pawn")
    for _ in range(2):
        stage.advance()
    return stage


def _recorded(path: Path) -> Any:
    """All frames, of a recording that can be shown."""
    recording = Recording.load(path)
    assert all(np.isfinite(frame.positions).all() and frame.solids is not None for frame in recording.frames)
    frames = [(frame.time, frame.positions.tobytes(), len(frame.solids)) for frame in recording.frames]
    return recording.title, recording.time_step, recording.camera, list(recording.labels), frames


def _configured(path: Path) -> Any:
    """The configuration in the folder of a run."""
    path.rename(path.with_name(runs.CONFIG))
    return runs.read_config(path.parent, begun=False)


@cache
def _policy() -> Any:
    import torch
    from stable_baselines3.common.policies import ActorCriticPolicy

    torch.set_num_threads(1)  # the threads of OpenMP are lost in a fork, and waited for
    env: Any = gym.make("ClothReach-v0")
    return ActorCriticPolicy(env.observation_space, env.action_space, lambda _: 1e-3, net_arch=[8])


def _save_checkpoint(path: Path) -> None:
    policy = _policy()
    more = {"optimizer": {"policy.optimizer": policy.optimizer.state_dict()}, "variables": {}, "constraint": {}, "times": {}}
    runs.save_tensors(path, {"policy": policy.state_dict(), **more, "num_timesteps": 100, "num_updates": 3})


def _tensors(state: dict[str, Any]) -> Any:
    return state["num_timesteps"], {name: tensor.numpy().tobytes() for name, tensor in state["policy"].items()}


def _acted(path: Path) -> bytes:
    """What a run with this checkpoint does."""
    path.rename(path.with_name(runs.CHECKPOINT))
    files.write_json(path.with_name(runs.CONFIG), CONFIG)
    action = runs.learned(path.parent, "ClothReach-v0")(None, np.zeros((1, 58), np.float32))
    assert np.isfinite(action).all(), "the action is not finite"
    return action.tobytes()


# --- forgeries ----------------------------------------------------------------------------------------------------------------


def _forged_archive(content: bytes, rng: np.random.Generator) -> bytes:
    """An archive of which one array is another; without a mark."""
    with np.load(io.BytesIO(content)) as file:
        arrays = dict(file)
    name = str(rng.choice(list(arrays)))
    buffer, form = io.BytesIO(), rng.integers(8)
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, array in arrays.items():
            changed = _other(_about(array, rng) if each == "about" else array, rng) if each == name and form > 2 else array
            data = _written(changed)
            if each == name and form == 0:
                data = _header_only(rng)
            if not (each == name and form == 1):
                archive.writestr(f"{each}.npy", data)
            if each == name and form == 2:
                archive.writestr(f"{each}.npy" if rng.random() < 0.5 else "../more.npy", data)
    return buffer.getvalue()


def _about(array: NDArray, rng: np.random.Generator) -> str:
    """The description of a recording with another entry."""
    about = json.loads(str(array))
    about[str(rng.choice(list(about)))] = [None, -1, 0, [], [10**6, 10**6], "text", 1e308, {"path": "/dev/zero"}][rng.integers(8)]
    return json.dumps(about)


def _written(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array))
    return buffer.getvalue()


def _header_only(rng: np.random.Generator) -> bytes:
    """The header of an array that is as large as one likes, and a little of it."""
    shape = [(10**12,), (2**62, 4), (10**6, 10**6, 3), (-1,), (0, 2**63), (2**31,)][rng.integers(6)]
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue() + bytes(64)


def _forged_tensors(content: bytes, rng: np.random.Generator) -> bytes:
    """A checkpoint of which something is missing, of another kind, or of another network."""
    import torch

    state = torch.load(io.BytesIO(content), weights_only=True)
    part = str(rng.choice(list(state)))
    name = str(rng.choice(list(state["policy"])))
    changes: list[Callable[[], Any]] = [
        lambda: state.pop(part),
        lambda: state.update({part: copy.copy(WHOLE[rng.integers(7)])}),
        lambda: state["policy"].pop(name),
        lambda: state["policy"].update({name: torch.zeros(int(rng.integers(9)))}),
        lambda: state["policy"].update({name: state["policy"][name] * float("nan")}),
        lambda: state["policy"].update({name: 3}),
        lambda: state.update({"num_timesteps": -1}),
    ]
    changes[rng.integers(len(changes))]()
    buffer = io.BytesIO()
    torch.save(state if rng.random() < 0.95 else [state], buffer)
    return files.marked(buffer.getvalue(), "checkpoint", runs.VERSION)

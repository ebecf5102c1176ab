"""Input that nobody expects: refused by an error of the package's own with nothing changed, or taken, and all is finite.

EXAMPLES=5000 python -m pytest tests/test_hostile.py      # a long campaign, with other examples each time
"""

import contextlib
import copy
import functools
import io
import json
import os
import traceback
import warnings
import zipfile
from fractions import Fraction
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from test_files import contents, made

import clothgym.envs
from clothgym import Box, Gripper, Material, MeshCollider, Plane, Simulation, Sphere, State, Wind, files, grid
from clothgym.adapters import runs
from clothgym.envs.episode import TaskState
from clothgym.playground.recording import Recording
from clothgym.playground.stage import SceneStage
from clothgym.starts import ZFold

pytest.importorskip("hypothesis")
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

PACKAGES = [Path(package.__file__).resolve().parent for package in (clothgym, clothgym.envs)]
MANY = int(os.environ.get("EXAMPLES", "0"))


def examples(count):
    """Always the same examples, or many others."""
    return settings(
        max_examples=MANY or count, derandomize=not MANY, deadline=None, database=None, suppress_health_check=HealthCheck
    )


REFUSED = object()


def attempt(call):
    """What a call returns, or REFUSED by a statement of the package's own."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return call()
    except (ValueError, TypeError, FileNotFoundError) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        if not any(Path(last.filename).resolve().is_relative_to(folder) for folder in PACKAGES) or "raise" not in last.line:
            raise AssertionError(f"an error by accident, in {last.filename}:{last.lineno}: {error}") from error
        return REFUSED


# --- hostile values -----------------------------------------------------------------------------------------------------------


class Useless:
    """An object that can neither be compared, counted nor made a number of."""

    def _refuse(self, *ignored):
        raise RuntimeError("no")

    __len__ = __float__ = __iter__ = __eq__ = __bool__ = _refuse
    __hash__ = None


LOOP = [0.0, 0.0]
LOOP.append(LOOP)
NUMBERS = (
    None, True, 0, -0.0, 0.5, 1.5, 10**9, 2**31 - 1, 2**31, 2**53 + 1, 2**63, -(2**63), 10**400, 5e-324, 1e-30, 1e29, 1e300,
    float("nan"), float("inf"), -float("inf"), 1j, Fraction(1, 2), np.float32(0.5), np.float16("inf"), np.longdouble("1e4000"),
    np.uint64(2**63), np.bool_(True), np.complex64(1), np.datetime64("2026-01-01"), np.ma.masked,
)  # fmt: skip
WORDS = ("", "1", "nan", "auto", "cotton", "xpbd", "strict", "no such", "\0", "x" * 10**6, b"1", np.str_("1"))
ARRAYS = (
    np.array(2), np.array([]), np.array([0, 0, 1]), np.array([0.5, 1, 2], np.float32), np.array(["1", "2", "3"]),
    np.array([1j, 0, 0]), np.array([None, 1, 2]), np.zeros((3, 3)), np.zeros((0, 3)), np.full(3, np.nan), np.zeros(3, "M8[s]"),
    np.zeros((9,) * 6), np.zeros(3, [("a", "f8")]), np.ma.array([1.0, 2, 3], mask=True),
)  # fmt: skip
MADE = (
    lambda: iter([1, 2, 3]), lambda: range(10**12), lambda: {1, 2}, object, lambda: object, lambda: len, lambda: ..., Useless,
    lambda: LOOP, Plane, Material, lambda: [Plane()], lambda: [Plane], lambda: slice(3), lambda: [[1, 2], [3]],
)  # fmt: skip
with contextlib.suppress(ImportError):
    import torch

    MADE += (
        lambda: torch.tensor(0.5, requires_grad=True), lambda: torch.zeros(3, device="meta"), lambda: torch.zeros(3).to_sparse(),
        lambda: torch.tensor(0.5, dtype=torch.bfloat16), lambda: torch.tensor(1j),
    )  # fmt: skip
numbers = st.integers(-5, 40) | st.floats() | st.sampled_from(NUMBERS)
words = st.text(max_size=5) | st.sampled_from(WORDS)
plausible = st.integers(0, 5) | st.floats(0, 2) | st.lists(st.floats(-1, 1), min_size=2, max_size=4)
hostile = numbers | st.one_of(
    words,
    st.sampled_from(ARRAYS).map(np.copy),
    st.sampled_from(MADE).map(lambda make: make()),
    st.lists(numbers | words | st.lists(numbers, max_size=3), max_size=4),
    st.dictionaries(st.sampled_from(["name", "density", "a", None]), numbers | words, max_size=2),
)


# --- arguments ----------------------------------------------------------------------------------------------------------------


def mesh():
    return grid(5, 5, 0.3, 0.3)


def body():
    """A simulation whose methods are called."""
    return Simulation(
        mesh(), num_envs=2, colliders=[Plane(point=(0, 0, -0.2))], contact="particles", anchors=[0], grippers=[Gripper()],
        substeps=20, on_divergence="ignore", threads=1,
    )  # fmt: skip


SURFACE = {"friction": 0.3, "thickness": 0.001, "velocity": (0, 0, 1)}
TURN = {"center": (0, 0, 0), "rotation": (1, 0, 0, 0)}
CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
SIDES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
ENV = {
    "rows": 7, "side": 0.3, "fabric": "silk", "integrator": "semi_implicit_euler", "substeps": 50, "bending": "hinge",
    "strain_limit": 0.1, "self_collision": "fast", "contact": "particles", "air_density": 1.2, "obs_mode": "particles",
    "reward_mode": "sparse", "randomize": {"density": [0.1, 0.2]}, "wind": {"speed": [0, 2], "gust": 0.5}, "threads": 1,
}  # fmt: skip
# what is called, arguments that are always given, and others
CALLS = {
    "grid": (grid, {"rows": 5, "cols": 5, "width": 0.3, "height": 0.3}, {}),
    "disc": (clothgym.disc, {"radius": 0.2, "rings": 2}, {}),
    "triangle_mesh": (clothgym.triangle_mesh, {"vertices": CORNERS[:3], "triangles": [[0, 1, 2]]}, {}),
    "load_mesh": (clothgym.load_mesh, {"path": "no such file.obj"}, {}),
    "Material": (Material, {}, {"density": 0.2, "stretch_stiffness": 200.0, "shear_stiffness": 50.0, "bend_rigidity": 1e-6,
                                "damping_time": 1e-4, "drag_coefficient": 1.2, "skin_friction": 0.02, "air_drag": 0.1}),
    "preset": (Material.preset, {"name": "cotton"}, {"density": 0.2}),
    "Wind": (Wind, {}, {"speed": (0, 2), "direction": (0, 1), "gust": 0.5, "gust_time": 0.5}),
    "Gripper": (Gripper, {}, {"position": (0, 0, 0.5), "speed": 1.0, "reach": 0.03, "span": 0.06, "closing_time": 0.1}),
    "Plane": (Plane, {}, {"point": (0, 0, 0), "normal": (0, 0, 1), **SURFACE}),
    "Sphere": (Sphere, {}, {"center": (0, 0, 0), "radius": 0.1, **SURFACE}),
    "Box": (Box, {}, {"half_sides": (0.1, 0.1, 0.1), "yaw": 0.1, **TURN, **SURFACE}),
    "MeshCollider": (MeshCollider, {"vertices": CORNERS, "triangles": SIDES}, {"scale": 0.1, "resolution": 4, **TURN, **SURFACE}),
    "Simulation": (lambda **world: Simulation(mesh(), **world), {}, {
        "material": Material(), "num_envs": 2, "integrator": "semi_implicit_euler", "time_step": 1 / 60, "substeps": 20,
        "gravity": (0, 0, -9.81), "wind": (1, 0, 0), "air_density": 1.2, "colliders": [Plane()], "anchors": [0, 4],
        "anchor_speed": 10.0, "grippers": [Gripper()], "contact": "particles", "self_collision": False, "strain_limit": None,
        "dtype": "float32", "threads": 1,
    }),
    "ClothDrape": (clothgym.envs.ClothDrapeEnv, {}, {"shapes": ("box", "post"), **ENV}),
    "ClothStrain": (clothgym.envs.ClothStrainEnv, {}, {"threshold": 0.1, "cost_penalty": 0.5, **ENV}),
    "ClothReach": (clothgym.envs.ClothReachVectorEnv, {"num_envs": 2}, {"autoreset_mode": "SameStep", **ENV}),
}  # fmt: skip
METHODS = {
    "step": ({}, {"n": 1}),
    "largest_substep": ({}, {"env": 1}),
    "move_anchors": ({"targets": np.zeros((2, 1, 3))}, {}),
    "release": ({}, {"envs": [0], "anchors": [0]}),
    "attach": ({}, {"envs": [0], "anchors": [0]}),
    "set_wind": ({"wind": (1, 0, 0)}, {"envs": [1]}),
    "reset": ({}, {"envs": [0], "positions": mesh().rest_positions, "velocities": np.zeros(3)}),
    "set_parameters": ({}, {"envs": [0], "density": 0.2, "bend_rigidity": [1e-6], "gravity": (0, 0, -1), "warn": False}),
    "set_collider": ({"index": 0, "colliders": [Plane()]}, {"envs": [1]}),
    "move_colliders": ({"index": 0}, {"targets": np.zeros((1, 3)), "velocities": np.zeros((1, 3)), "envs": [0]}),
    "set_state": ({"state": None}, {}),
}


def drawn_arguments(data, needed, more):
    """Sound arguments, of which one or two are exchanged."""
    chosen = needed | {name: value for name, value in more.items() if data.draw(st.booleans(), name)}
    exchanged = data.draw(st.lists(st.sampled_from(list(needed | more)), min_size=1, max_size=2), "exchanged")
    return chosen | {name: data.draw(plausible | hostile, name) for name in exchanged}


def check(made):
    """What has been made is finite."""
    if isinstance(made, clothgym.ClothMesh):
        assert np.isfinite(made.rest_positions).all() and np.isfinite(made.springs.rest_length).all()
        assert all(np.isfinite(field).all() for field in made.hinges)
    elif isinstance(made, Material):
        assert all(np.isfinite(value) for name, value in vars(made).items() if name != "source")
    elif isinstance(made, Wind):
        assert np.isfinite(made.series(np.random.default_rng(0), 5, 1 / 60)).all()
    elif isinstance(made, Simulation):
        made.step(2)
        check_sheets(made)
    elif isinstance(made, gym.Env | gym.vector.VectorEnv):
        check_play(made, made.reset(seed=0)[0], 2)
    elif hasattr(made, "rows"):
        assert np.isfinite(made.rows()).all()


def check_sheets(simulation):
    finite = np.isfinite(simulation.positions).all(axis=(1, 2)) & np.isfinite(simulation.velocities).all(axis=(1, 2))
    assert (finite | simulation.diverged).all(), "a sheet is not finite, and is not reported as diverged"


def check_play(env, observation, steps):
    """A few steps: observations within their space, finite rewards."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        assert env.observation_space.contains(observation)
        observation, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        assert np.isfinite(reward).all() and np.abs(reward).max() < 1e6
        check_sheets(env.unwrapped.task.simulation)


@examples(150)
@given(name=st.sampled_from(list(CALLS)), data=st.data())
def test_arguments(name, data):
    call, needed, more = CALLS[name]
    arguments = drawn_arguments(data, needed, more)
    attempt(lambda: check(call(**arguments)))


@examples(100)
@given(name=st.sampled_from(list(METHODS)), data=st.data())
def test_methods_of_a_simulation(name, data):
    simulation = body()
    arguments = drawn_arguments(data, *METHODS[name])
    assume(
        name != "step" or not isinstance(arguments.get("n"), int | np.integer) or arguments["n"] < 100
    )  # it takes as long as asked
    before = contents(simulation.get_state())
    if attempt(lambda: getattr(simulation, name)(**arguments)) is REFUSED:
        assert contents(simulation.get_state()) == before
    attempt(lambda: simulation.step(2))
    check_sheets(simulation)


# --- environments -------------------------------------------------------------------------------------------------------------


@functools.cache
def victim(name):
    """A single environment, or a batch of three."""
    env_id, _, batch = name.partition(" x ")
    env = gym.make_vec(env_id, num_envs=3, threads=1).unwrapped if batch else gym.make(env_id).unwrapped
    env.reset(seed=0)
    return env


VICTIMS = st.sampled_from(["ClothReach-v0", "ClothReach-v0 x 3", "ClothDrape-v0 x 3"])
SHAPED = {
    "of a type": lambda shape, data: np.zeros(shape).astype(data.draw(st.sampled_from(["i8", "?", "c16", "U1", "O", "M8[s]"]))),
    "of a number": lambda shape, data: np.full(shape, data.draw(numbers)),
    "with one number": lambda shape, data: np.r_[data.draw(numbers), np.zeros(int(np.prod(shape)) - 1)].reshape(shape),
    "transposed": lambda shape, data: np.zeros(shape).T,
    "shorter": lambda shape, data: np.zeros(shape)[..., :-1],
    "longer": lambda shape, data: np.zeros((*shape, 1)),
    "a list": lambda shape, data: np.full(shape, data.draw(st.floats())).tolist(),
    "hostile": lambda shape, data: data.draw(hostile),
}


@examples(100)
@given(name=VICTIMS, form=st.sampled_from(list(SHAPED)), data=st.data())
def test_actions(name, form, data):
    env = victim(name)
    env.reset(seed=0)
    try:
        with np.errstate(all="ignore"):
            action = SHAPED[form](env.action_space.shape, data)
    except (TypeError, ValueError, OverflowError):
        return  # NumPy makes no such array
    before = contents(env.get_state())
    brought = attempt(lambda: env.step(action))
    if brought is REFUSED:
        assert contents(env.get_state()) == before
    else:
        check_play(env, brought[0], 2)


@examples(100)
@given(
    name=VICTIMS,
    seed=st.integers(0, 9) | hostile | st.lists(st.integers(-1, 5) | st.none(), min_size=3, max_size=3),
    data=st.data(),
)
def test_seeds_and_options(name, seed, data):
    env = victim(name)
    own = [*env.task.reset_options, "reset_mask"]
    inner = st.sampled_from(["shape", "radius", "yaw", "center", "density"])
    values = plausible | hostile | st.just([True, False, True]) | st.dictionaries(inner, plausible | hostile, max_size=2)
    options = data.draw(st.none() | hostile | st.dictionaries(st.sampled_from(own), values, max_size=2), "options")
    before = contents(env.get_state())
    brought = attempt(lambda: env.reset(seed=seed, options=options))
    if brought is REFUSED:
        assert contents(env.get_state()) == before
    else:
        check_play(env, brought[0], 2)


# --- states -------------------------------------------------------------------------------------------------------------------

REPLACED = (None, 0, [], {}, "state", 1e300, [1, 2, 3], np.zeros(0), np.zeros((1, 1, 1, 1)), np.array(None), np.array("text"))
TEXTS = st.sampled_from(["", "{}", "[]", "null", "{" * 5000, "1" * 5000, '{"bit_generator": "MT19937"}', "NaN", None, 3])
VALUES = st.sampled_from([np.nan, np.inf, 1e35, -1e30, 5e-324, 0.0, -1.0, 0.5, 99.0, 1e9]) | st.floats()
WHOLES = st.sampled_from([-1, 0, 1, 7, 99, 2**31, -(2**63)])


def edited(data, old):
    """Something in the place of an array or a text."""
    if isinstance(old, str):
        return data.draw(TEXTS | st.integers(0, len(old)).map(lambda cut: old[:cut]))
    if not isinstance(old, np.ndarray | np.generic) or old.dtype.kind not in "fiub":
        return data.draw(st.sampled_from(REPLACED))
    new, form = np.array(old), data.draw(st.sampled_from(["type", "shape", "one", "all", "whole"]))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if form == "type":
            return new.astype(data.draw(st.sampled_from(["f8", "f4", "f2", "i8", "i1", "u8", "?", "c16", "U8", "O"])))
        if form == "shape":
            return data.draw(st.sampled_from([new[..., None], new[None], new.ravel(), new.ravel()[:0], new.T]))
        value = data.draw(VALUES if new.dtype.kind == "f" else WHOLES)
        wide = new.astype(np.float64 if new.dtype.kind == "f" else np.int64)
        if form == "one" and new.size:
            wide.flat[data.draw(st.integers(0, new.size - 1))] = value
        elif form == "all":
            wide = wide * value
        if form in ("one", "all"):
            return wide.astype(old.dtype) if data.draw(st.booleans()) else wide
    return data.draw(st.sampled_from(REPLACED))


@functools.cache
def folded():
    """A simulation of sheets that touch themselves."""
    maneuver = ZFold(grid(9, 9, 0.3, 0.3), seeds=range(2), self_collision="strict")
    for _ in range(25):
        maneuver.step()
    return maneuver.simulation, maneuver.simulation.get_state()


@examples(120)
@given(name=VICTIMS | st.just("folded"), data=st.data())
def test_states(name, data):
    if name == "folded":
        target, sound = folded()
        target.set_state(sound)
    else:
        target = victim(name)
        target.reset(seed=0)
    state = target.get_state()
    physics = state if name == "folded" else state.simulation
    tables = {"physics": vars(physics), "contact": physics.self_contact or {}}
    if name != "folded":
        tables |= {"episode": state.episode, "task": state.task, "generators": dict(enumerate(state.generators))}
    places = [(table, key) for table, entries in tables.items() for key in entries if key != "self_contact"]
    for table, key in data.draw(st.lists(st.sampled_from(places), min_size=1, max_size=3)):
        tables[table][key] = edited(data, tables[table][key])
    if name != "folded":
        state.generators = list(tables["generators"].values())
    before = contents(target.get_state())
    if attempt(lambda: target.set_state(state)) is REFUSED:
        assert contents(target.get_state()) == before
    elif name == "folded":
        attempt(lambda: target.step(3))
        check_sheets(target)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check_play(target, target.step(np.zeros(target.action_space.shape, np.float32))[0], 2)


# --- files --------------------------------------------------------------------------------------------------------------------

CONFIG = {
    "clothgym": clothgym.__version__, "env": "ClothReach-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": {},
    "hyperparameters": {"policy_kwargs": {"net_arch": [8]}}, "num_envs": 4, "timesteps": 100, "seed": 0, "threads": 1,
}  # fmt: skip


def read_config(path):
    path.rename(path.with_name(runs.CONFIG))
    return runs.read_config(path.parent, begun=False)


def read_checkpoint(path):
    """What a run with this checkpoint does."""
    path.rename(path.with_name(runs.CHECKPOINT))
    files.write_json(path.with_name(runs.CONFIG), CONFIG)
    action = runs.learned(path.parent, "ClothReach-v0")(None, np.zeros((1, 58), np.float32))
    assert np.isfinite(action).all()
    return action.tobytes()


def read_recording(path):
    recording = Recording.load(path)
    assert all(np.isfinite(frame.positions).all() for frame in recording.frames)
    return [(frame.time, frame.positions.tobytes()) for frame in recording.frames]


def write_checkpoint(path):
    torch = pytest.importorskip("torch")
    from stable_baselines3.common.policies import ActorCriticPolicy

    torch.manual_seed(0)
    env = victim("ClothReach-v0")
    policy = ActorCriticPolicy(env.observation_space, env.action_space, lambda _: 1e-3, net_arch=[8])
    more = {"optimizer": {}, "variables": {}, "constraint": {}, "times": {}, "num_timesteps": 100, "num_updates": 3}
    runs.save_tensors(path, {"policy": policy.state_dict(), **more})


def write_recording(path):
    stage = SceneStage("pawn")
    stage.advance()
    stage.recording.save(path)


KINDS = {  # writers, and readers whose results can be compared
    "state": (lambda path: body().get_state().save(path), lambda path: contents(State.load(path))),
    "task state": (lambda path: made().get_state().save(path), lambda path: contents(TaskState.load(path))),
    "recording": (write_recording, read_recording),
    "configuration": (lambda path: files.write_json(path, CONFIG), read_config),
    "checkpoint": (write_checkpoint, read_checkpoint),
}


@functools.cache
def sample(kind, folder):
    path = folder / "sample"
    KINDS[kind][0](path)
    content = path.read_bytes()
    return content, KINDS[kind][1](path)


def read(kind, content, folder):
    """What a reader makes of some bytes, or REFUSED in a sentence with the file's name."""
    place = folder / "damaged"
    place.mkdir(exist_ok=True)
    for old in place.iterdir():
        old.unlink()
    (place / "file").write_bytes(content)
    try:
        return KINDS[kind][1](place / "file")
    except ValueError as error:
        assert str(place) in str(error)
        return REFUSED


@examples(150)
@given(kind=st.sampled_from(list(KINDS)), form=st.sampled_from(["flip", "cut", "blank", "insert", "double"]), data=st.data())
def test_damaged_files(tmp_path_factory, kind, form, data):
    folder = tmp_path_factory.getbasetemp()
    content, sound = sample(kind, folder)
    at = data.draw(st.integers(0, len(content) - 1))
    flipped = bytes([content[at] ^ 1 << data.draw(st.integers(0, 7))])
    damaged = {
        "flip": content[:at] + flipped + content[at + 1 :],
        "cut": content[:at],
        "blank": content[:at] + bytes(len(content[at : at + 512])) + content[at + 512 :],
        "insert": content[:at] + data.draw(st.binary(min_size=1, max_size=99)) + content[at:],
        "double": content[:at] + content[:at],
    }[form]
    found = read(kind, damaged, folder)
    assert found is REFUSED or found == sound


@examples(120)
@given(kind=st.sampled_from(list(KINDS)), data=st.data())
def test_forged_files(tmp_path_factory, kind, data):
    """One thing is exchanged, and the checksum is made anew, as a stranger would."""
    folder = tmp_path_factory.getbasetemp()
    content, _ = sample(kind, folder)
    if kind == "configuration":
        plain = files.checked_out(json.loads(content))
        plain[data.draw(st.sampled_from(list(plain)))] = data.draw(
            st.sampled_from([None, -1, 10**30, True, "x" * 99, [[]], {"env": 1}])
        )
        read(kind, json.dumps(files.checked_in(plain)).encode(), folder)
    elif kind == "checkpoint":
        state = copy.deepcopy(torch.load(io.BytesIO(content), weights_only=True))
        where = data.draw(st.sampled_from([state, state["policy"]]))
        name = data.draw(st.sampled_from(list(where)))
        where[name] = data.draw(st.sampled_from([None, -1, {}, 3, torch.zeros(7), torch.full((8, 58), torch.nan)]))
        buffer = io.BytesIO()
        torch.save(state, buffer)
        read(kind, files.marked(buffer.getvalue(), "checkpoint", runs.VERSION), folder)
    else:
        with np.load(io.BytesIO(content)) as file:
            arrays = dict(file)
        name = data.draw(st.sampled_from(list(arrays)))
        arrays[name] = edited(data, str(arrays[name]) if arrays[name].dtype.kind == "U" and not arrays[name].ndim else arrays[name])
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for each, array in arrays.items():
                with archive.open(f"{each}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asarray(array))
        version = {"state": clothgym.state.VERSION, "task state": 1, "recording": 1}[kind]
        read(kind, files.marked(buffer.getvalue(), kind, version), folder)

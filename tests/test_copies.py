"""Copies and pickles of environments and simulations, in the middle of an episode: they go on with the same bits."""

import copy
import pickle
import subprocess
import sys

import numba
import numpy as np
import pytest
from gymnasium.utils.play import play
from gymnasium.wrappers import RecordVideo
from test_envs import drawn, every_id, flat, make, make_vec, still, two_tasks

import clothgym
from clothgym import INTEGRATORS, Plane, Simulation, Sphere
from clothgym.attachments import Gripper

WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}
every_way = pytest.mark.parametrize("way", WAYS)


def same(one, other):
    """Whether two steps have brought the same."""
    alike = all(np.array_equal(flat(a), flat(b)) for a, b in zip(one[:4], other[:4]))
    return alike and one[4].keys() == other[4].keys() and all(np.array_equal(one[4][key], other[4][key]) for key in one[4])


@every_id
def test_a_copy_of_an_environment_goes_on_with_the_same_bits(env_id):
    # single environments are pickled, batches copied
    kwargs = {"self_collision": "strict", "randomize": {"density": [0.1, 0.2]}}
    for way, env in (("pickle", make(env_id, **kwargs)), ("deepcopy", make_vec(env_id, 3, autoreset_mode="NextStep", **kwargs))):
        env.reset(seed=4)
        actions = drawn(env, 2)
        for _ in range(5):
            env.step(next(actions))
        twin, task = WAYS[way](env), env.unwrapped.task
        assert twin.unwrapped.task is not task
        # nothing is shared: what the one does, the other does not feel
        before = task.simulation.positions
        ahead = WAYS[way](env)
        for _ in range(3):
            ahead.step(still(env))
        assert np.array_equal(task.simulation.positions, before)
        # through the end of an episode, if it is a batch
        task.episode["step"] += task.acting_steps + task.settling_steps - 12
        twin.unwrapped.task.episode["step"] += task.acting_steps + task.settling_steps - 12
        for step in range(10 if task.num_envs == 1 else 16):
            action = next(actions)
            assert same(env.step(action), twin.step(action)), step
        # and into the next, by the same generators
        assert np.array_equal(flat(env.reset()[0]), flat(twin.reset()[0]))
        if task.num_envs == 1:
            assert twin.unwrapped.np_random is twin.unwrapped.task.generators[0]


@every_way
@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_copy_of_a_simulation_goes_on_with_the_same_bits(way, name):
    # what is copied of solids does not depend on the method
    solids = (Plane((0, 0, -0.05)), Sphere(center=(0, 0, -0.06), radius=0.05)) if name == "semi_implicit_euler" else ()
    cloth = Simulation(
        clothgym.grid(7, 7, 0.3, 0.3), num_envs=2, integrator=name, threads=1, substeps=300, anchors=(0,),
        grippers=(Gripper(position=(0.15, 0.15, 0.0)),), on_divergence="ignore", colliders=solids,
    )  # fmt: skip
    cloth.grippers.move(np.array([0.1, 0.1, 0.05]), np.zeros(1))
    cloth.step(4)
    twin = WAYS[way](cloth)
    assert twin.integrator == cloth.integrator and twin.bending is cloth.bending
    for each in (cloth, twin):
        if name != "pbd":
            each.set_parameters(density=0.2, warn=False)
        each.grippers.move(np.array([0.1, 0.0, 0.1]), np.ones(1))
        each.step(4)
    assert all(np.array_equal(a, b) for a, b in zip(cloth.get_state().arrays().values(), twin.get_state().arrays().values()))


@every_way
def test_a_copy_needs_no_kernels_of_its_own(way):
    """What they are given has the types of the original's arrays; read-only ones would be of another type."""
    for mesh in (clothgym.grid(4, 4, 0.3, 0.3), clothgym.disc(0.2, 2)):
        cloth = Simulation(mesh, self_collision="fast", bending="hinge", colliders=[Plane()])
        one, twin = (numba.typeof((s._topology, s._contact.sheet, s._fabric, s._solids.shapes)) for s in (cloth, WAYS[way](cloth)))
        assert one == twin and "readonly" not in str(one)


def test_methods_are_copied_with_their_options():
    for method in (*INTEGRATORS.values(), INTEGRATORS["xpbd"].with_options(iterations=3)):
        for way in WAYS.values():
            again = way(method)
            assert again == method and dict(again.options) == dict(method.options) and again.substep is method.substep


def test_another_process_goes_on_from_a_pickle(tmp_path):
    """It knows the package alone, and compiles nothing of what is cached."""
    env = make("ClothReach-v0")
    env.reset(seed=1)
    env.step(env.action_space.low)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    code = (
        "import pickle, sys; env = pickle.load(open(sys.argv[1], 'rb'));print(env.step(env.action_space.high)[0].tobytes().hex())"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "env")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "compiling" not in done.stderr, done.stderr
    assert done.stdout.strip() == env.step(env.action_space.high)[0].tobytes().hex()


# --- play and films ---------------------------------------------------------------------------------------------------------------


@two_tasks
def test_keys_move_all_attachments(env_id):
    env = make(env_id).unwrapped
    keys, count = env.get_keys_to_action(), env.task.num_attachments
    assert all(action in env.action_space for action in keys.values())
    moves = {key: action.reshape(count, -1) for key, action in keys.items()}
    assert not keys[""].any() and len(keys) == 2 ** (6 if env.task.actions_per_attachment == 3 else 8)
    assert np.array_equal(moves["d"][:, :3], [[1, 0, 0]] * count) and np.array_equal(moves["sq"][:, :3], [[0, -1, -1]] * count)
    if env.task.actions_per_attachment == 4:
        assert moves["o"][:, 3].tolist() == [1] * count and moves["wc"][:, 3].tolist() == [-1] * count


@pytest.mark.parametrize("env_id", ["ClothDrape-v0", "ClothReach-v0", "ClothFling-v0"])
def test_gymnasium_plays_it(env_id, monkeypatch):
    """e is held for two steps: all attachments have risen by two steps at full speed, and are then still.  Then d: along x.

    Nothing is held in the first four steps, in which the grippers of a fling close and take no other command.
    """
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    env, places = make(env_id, render_mode="rgb_array", width=96, height=96), []
    keys = {5: (pygame.KEYDOWN, "e"), 7: (pygame.KEYUP, "e"), 8: (pygame.KEYDOWN, "d"), 9: (pygame.KEYUP, "d")}

    def watch(before, after, action, reward, terminated, truncated, info):
        places.append(env.unwrapped.task.episode["targets"][0].copy())
        if len(places) in keys:
            kind, key = keys[len(places)]
            pygame.event.post(pygame.event.Event(kind, key=ord(key)))
        elif len(places) == 10:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    play(env, seed=0, callback=watch, fps=1000)
    way = env.unwrapped.task.physics.attachment_speed * env.unwrapped.task.physics.time_step
    steps = np.diff(places[4:], axis=0)
    assert steps.shape == (5, env.unwrapped.task.num_attachments, 3)
    for step, along in zip(steps, [(0, 0, way), (0, 0, way), (0, 0, 0), (way, 0, 0), (0, 0, 0)]):
        assert step == pytest.approx(np.broadcast_to(along, step.shape), abs=1e-6)


@two_tasks
def test_depths_as_gray_pictures(env_id):
    depths, gray = make(env_id, render_mode="depth_array"), make(env_id, render_mode="rgb_array", render_color="depth")
    for env in (depths, gray):
        env.reset(seed=0)
    far, picture = depths.render(), gray.render()
    assert picture.shape == (*far.shape, 3) and picture.dtype == np.uint8
    camera = gray.unwrapped.task.camera()
    expected = 255 * (2 - np.clip(far / camera.distance, 0.5, 2)) / 1.5
    assert np.abs(picture.astype(float) - expected[..., None]).max() <= 0.51
    assert len(np.unique(picture)) > 30 and make_vec(env_id, 2, render_color="depth", render_mode="rgb_array")


@pytest.mark.filterwarnings("ignore")
def test_a_film_of_depths(tmp_path):
    pytest.importorskip("moviepy")
    env = RecordVideo(make("ClothReach-v0", render_mode="rgb_array", render_color="depth"), str(tmp_path), video_length=3)
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    assert film.stat().st_size > 500

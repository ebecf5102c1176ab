"""How the package is met outside a checkout: without a compiler, from other folders, at a prompt, under a policy's tensors."""

import os
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from test_over import CountEnv, CountVectorEnv

import clothgym
from clothgym import Material, Plane, Simulation, files, folders, grid
from clothgym.checks import number, numbers
from clothgym.render import MeshSequence, write_picture

ROOT = Path(__file__).parent.parent
MESH = grid(3, 3, 0.1, 0.1)


def run(code, cwd=None, arguments=(), **environment):
    """What a process prints, and what it says beside that."""
    env = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA", "XDG"))} | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "-P", "-c", textwrap.dedent(code), *arguments]
    done = subprocess.run(command, env=env | environment, cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


# --- without a compiler -----------------------------------------------------------------------------------------------------------

SCENES = """
    import sys
    import gymnasium as gym
    import numpy as np
    import clothgym

    mesh = clothgym.grid(3, 3, 0.1, 0.1)
    solids = [clothgym.Plane(), clothgym.Box(center=(0, 0, -0.1), half_sides=(0.05, 0.05, 0.09))]

    def simulated(mesh=mesh, **options):
        one = clothgym.Simulation(mesh, num_envs=2, colliders=solids, time_step=0.01, **options)
        one.reset(positions=mesh.rest_positions + (0, 0, 0.02))
        one.step(2)
        one.strain(), one.energy(), one.contacts(), one.intersections(), one.penetration()
        return one.positions

    def environment(env_id, **kwargs):
        env = gym.make(f"clothgym:{env_id}", **{"rows": 5, "physics": "fast", "substeps": 60, **kwargs}).unwrapped
        env.reset(seed=0)
        seen = env.step(env.expert_action())[0]
        return (env.render(), seen)[1]

    few = sys.argv[2] == "few"
    methods = ("semi_implicit_euler", "xpbd") if few else clothgym.INTEGRATORS
    made = {name: simulated(integrator=name, anchors=mesh.corners[2:]) for name in methods}
    made["strict"] = simulated(self_collision="strict")
    made["gripper"] = simulated(grippers=[clothgym.Gripper(position=(0, 0, 0.03))])
    made["ClothReach-v0"] = environment("ClothReach-v0", substeps=30, render_mode="rgb_array", width=8, height=8)
    if few:
        np.savez(sys.argv[1], **made)
        sys.exit()
    made |= {"fast": simulated(self_collision="fast"), "limited": simulated(strain_limit=0.1)}
    made |= {"hinge": simulated(bending="hinge"), "points": simulated(contact="particles")}
    made["disc"] = simulated(clothgym.disc(0.1, rings=2), bending="hinge")
    for env_id in ("ClothStrain-v0", "ClothFold-v0"):
        made[env_id] = environment(env_id, render_mode="rgb_array", width=8, height=8)
    made["depth"] = environment("ClothReach-v0", obs_mode="depth", image_size=8, render_mode="depth_array", width=8, height=8)
    np.savez(sys.argv[1], **made)
"""


@pytest.mark.parametrize("scenes", ["few", pytest.param("all", marks=pytest.mark.slow)])
def test_without_a_compiler_everything_moves_as_with_it(tmp_path, scenes):
    """``NUMBA_DISABLE_JIT=1`` is how debuggers step into kernels, and how coverage sees their lines."""
    _, said = run(SCENES, NUMBA_DISABLE_JIT="1", arguments=[tmp_path / "plain.npz", scenes])
    assert said == ""
    run(SCENES, arguments=[tmp_path / "compiled.npz", scenes])
    plain, compiled = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("plain", "compiled"))
    assert plain.keys() == compiled.keys()
    for name in plain:
        assert np.allclose(plain[name], compiled[name], rtol=0, atol=2e-5), name


# --- folders ----------------------------------------------------------------------------------------------------------------------

MOVED = """
    import os, sys
    import clothgym
    os.makedirs("run", exist_ok=True)
    os.chdir("run")
    from clothgym._jit import cache_folder
    print(cache_folder().path.parent, cache_folder().path.is_dir())
    if len(sys.argv) == 1:
        import subprocess
        code = "import clothgym; from clothgym._jit import cache_folder; print(cache_folder().path.parent)"
        print(subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True).stdout.strip())
"""


@pytest.mark.parametrize(("given", "meant"), [("./a/../kernels", "{here}/kernels"), ("~/kernels", "{here}/home/kernels")])
def test_cache_folder_is_resolved_at_import(given, meant, tmp_path):
    """A program that goes into a folder of its own, as Hydra's do, and what it starts there, use one cache."""
    where = {"HOME": str(tmp_path / "home"), "CLOTHGYM_CACHE_DIR": given.format(here=tmp_path)}
    out, said = run(MOVED, cwd=tmp_path, **where)
    wanted = meant.format(here=tmp_path)
    assert out.splitlines() == [f"{wanted} True", wanted] and said == ""
    assert not list(tmp_path.glob("**/~*")) and not (tmp_path / "run" / "kernels").exists()


@pytest.mark.parametrize(("variable", "rest"), [("NUMBA_CACHE_DIR", "clothgym"), ("XDG_CACHE_HOME", "clothgym/kernels")])
def test_other_variables_that_name_a_folder(variable, rest, tmp_path):
    where = {"HOME": str(tmp_path / "home"), "CLOTHGYM_CACHE_DIR": "", variable: "~/cache"}
    out, _ = run(MOVED, cwd=tmp_path, arguments=["alone"], **where)
    assert out == f"{tmp_path}/home/cache/{rest} True" and not list(tmp_path.glob("**/~*"))


def test_a_home_in_a_path_is_the_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    env = CountEnv()
    env.reset(seed=0)
    env.get_state().save("~/state.npz")
    files.read("~/state.npz")
    write_picture("~/a.png", np.zeros((4, 4, 3), np.uint8))
    MeshSequence("~/meshes", MESH.triangles).add(MESH.rest_positions)
    assert sorted(path.name for path in (tmp_path / "home").iterdir()) == ["a.png", "meshes", "state.npz"]
    assert not list((tmp_path / "work").iterdir())


def test_script_arguments_expand_the_home_folder(monkeypatch, scripts):
    import evaluate
    import train

    monkeypatch.setenv("HOME", "/home/somebody")
    assert train.Args(env="ClothReach-v0", run=Path("~/runs/a")).folder == Path("/home/somebody/runs/a")
    assert evaluate.Args(json=Path("~/a.json")).json == Path("/home/somebody/a.json")


def test_without_a_home_the_variable_is_left(monkeypatch):
    monkeypatch.setenv("CLOTHGYM_CACHE_DIR", "~nobody_of_this_name/kernels")
    folders.keep()
    assert os.environ["CLOTHGYM_CACHE_DIR"] == "~nobody_of_this_name/kernels"
    with pytest.raises(RuntimeError):
        folders.named("CLOTHGYM_CACHE_DIR")


def test_the_command_finds_a_module_in_the_current_folder(tmp_path):
    """As ``python -m clothgym`` does; the command's own folder is another."""
    (tmp_path / "towel_drag.py").write_text((ROOT / "tests" / "hang_towel.py").read_text().replace("hang_towel", "towel_drag"))
    code = "import sys; from clothgym.cli import main; sys.path = [p for p in sys.path if p]; raise SystemExit(main(sys.argv[1:]))"
    arguments = ["export", "towel_drag:HangTowel-v0", "--out", "a.glb", "--seconds", "0.1", "--policy", "noop"]
    env = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"} | {"PYTHONPATH": str(ROOT)}
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "clothgym").write_text(code)
    command = [sys.executable, str(tmp_path / "bin" / "clothgym"), *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "3 frames" in done.stdout and (tmp_path / "a.glb").is_file()


# --- names ------------------------------------------------------------------------------------------------------------------------


def test_star_import_gives_the_core_names():
    names = {}
    exec("from clothgym import *", names)
    assert {name for name in names if not name.startswith("__")} == {*clothgym._HOMES, "policies"} == set(clothgym.__all__)
    assert names["Simulation"] is Simulation and names["grid"] is grid


def test_an_import_loads_nothing_and_packages_when_they_are_used():
    out, _ = run("""
        import sys
        import clothgym
        print(*(name in sys.modules for name in ("numba", "scipy", "clothgym.envs", "clothgym.simulation", "clothgym.render")))
        print(clothgym.envs.Task.__name__, clothgym.render.Camera.__name__, clothgym.adapters.__name__, "torch" in sys.modules)
        print(clothgym.adapters.sb3.make_sb3_vec_env.__name__, {"envs", "Simulation"} <= set(dir(clothgym)))
    """)
    assert out.splitlines() == ["False False False False False", "Task Camera clothgym.adapters False", "make_sb3_vec_env True"]
    for module, name in ((clothgym, "adaptors"), (clothgym.adapters, "sb4")):
        with pytest.raises(AttributeError, match=f"has no attribute '{name}'"):
            getattr(module, name)


# --- tensors ----------------------------------------------------------------------------------------------------------------------

torch = pytest.importorskip("torch")
KINDS = [torch.bfloat16, torch.float16, torch.float8_e4m3fn, torch.float32, torch.float64, torch.int8, torch.int64]


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("form", ["plain", "strided", "reversed", "with gradients"])
def test_tensors_of_any_real_type_are_actions(kind, form):
    values = torch.tensor([0.0, 1.0, -1.0, 1.0, 0.0, -1.0]).to(kind)
    if form == "with gradients" and kind in (torch.int8, torch.int64):
        return
    action = {
        "plain": lambda: values,
        "strided": lambda: torch.stack([values, values], dim=1)[:, 0],
        "reversed": lambda: torch.stack([values, values]).T.contiguous().T[1],
        "with gradients": lambda: values.clone().requires_grad_(),
    }[form]()
    single, batch = CountEnv(), CountVectorEnv(2)
    for env, given in ((single, action), (batch, torch.stack([action, action]))):
        env.reset(seed=0)
        env.step(given)
    assert np.array_equal(single.task.outcome["moves"][0].ravel(), [0, 1, -1, 1, 0, -1])
    assert np.array_equal(batch.task.outcome["moves"][1].ravel(), [0, 1, -1, 1, 0, -1])
    assert number("x", action[1]) == 1.0


def test_an_array_of_a_type_that_a_library_adds():
    ml_dtypes = pytest.importorskip("ml_dtypes")
    assert np.array_equal(numbers("x", np.array([0.5, 1.0], ml_dtypes.bfloat16), (2,)), [0.5, 1.0])


@pytest.mark.parametrize("kind", ["complex64", "bool", "U1"])
def test_a_type_that_is_no_number_is_named_with_the_remedy(kind):
    array = np.zeros(6, kind)
    env = CountEnv()
    env.reset(seed=0)
    for given in (array, *([] if kind == "U1" else [torch.from_numpy(array)])):
        with pytest.raises(ValueError, match=rf"action=.*, not of .*{kind}.*: convert it to float32"):
            env.step(given)


# --- warnings ---------------------------------------------------------------------------------------------------------------------


def too_few():
    Simulation(MESH, Material(), substeps=1, time_step=0.1)


def too_few_by_gymnasium():
    gym.make("clothgym:ClothReach-v0", rows=5, physics="fast", substeps=1)


def too_few_of_a_batch():
    gym.make_vec("clothgym:ClothReach-v0", num_envs=2, rows=5, physics="fast", substeps=1)


def too_few_for_an_option():
    env = CountEnv(substeps=20)
    env.reset(options={"material": {"stretch_stiffness": 1e6}})


def an_option_of_another():
    Simulation(MESH, Material(), integrator={"name": "semi_implicit_euler", "iterations": 3})


def diverges():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        one = Simulation(MESH, Material(stretch_stiffness=1e5), substeps=1, time_step=0.1, colliders=[Plane()], anchors=[0])
    one.reset(velocities=np.random.default_rng(0).normal(size=(9, 3)) * 100)
    one.step(20)


def rendered_without_a_mode():
    gym.make("clothgym:ClothReach-v0", rows=5, physics="fast").unwrapped.render()


SPOKEN = [too_few, too_few_by_gymnasium, too_few_of_a_batch, too_few_for_an_option, an_option_of_another, diverges]


@pytest.mark.parametrize("speak", [*SPOKEN, rendered_without_a_mode], ids=lambda speak: speak.__name__)
def test_warnings_point_at_the_caller_line(speak):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        speak()
    assert said, "nothing was said"
    first = speak.__code__.co_firstlineno
    for one in said:
        assert Path(one.filename) == Path(__file__), f"{one.filename}:{one.lineno}: {one.message}"
        assert first < one.lineno < first + 8


def test_a_warning_at_the_import_points_at_the_import(tmp_path):
    (tmp_path / "mine.py").write_text("import os\nimport clothgym\n\nclothgym.Simulation\n")
    (tmp_path / "file").write_text("")
    env = os.environ | {"PYTHONPATH": str(ROOT), "CLOTHGYM_CACHE_DIR": str(tmp_path / "file")}
    done = subprocess.run([sys.executable, str(tmp_path / "mine.py")], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and f"{tmp_path}/mine.py:4: UserWarning: clothgym cannot use its kernel cache" in done.stderr

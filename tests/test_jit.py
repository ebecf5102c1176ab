"""How kernels are compiled: plainly where numba is not known, and in a folder whose name tells all sources."""

import os
import shutil
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from clothgym import bending
from clothgym._jit import WITHOUT_JIT, inlined, kernel, merged, placeholder, specialize
from clothgym._jit.cache import ABOVE_CORE, WITHOUT_KERNELS, cache_folder, source_digest
from clothgym._jit.merging import _merged_in_python
from clothgym.bending import add_bend_forces
from clothgym.integrators import INTEGRATORS

ROOT = Path(__file__).parent.parent


def run(code, **environment):
    """What a process prints, and what it says beside that."""
    env = {key: value for key, value in os.environ.items() if not key.startswith(("CLOTHGYM", "NUMBA"))} | environment
    done = subprocess.run([sys.executable, "-P", "-c", textwrap.dedent(code)], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def copy_package(folder, linked):
    """The package as it lies in a checkout, where ``clothgym/envs`` is a link, or in a wheel."""
    skip = shutil.ignore_patterns("envs", "__pycache__")
    shutil.copytree(ROOT / "clothgym", folder / "clothgym", ignore=skip)
    shutil.copytree(ROOT / "envs", folder / ("envs" if linked else "clothgym/envs"), ignore=skip)
    if linked:
        (folder / "clothgym" / "envs").symlink_to("../envs")


@pytest.mark.parametrize("linked", [True, False], ids=["checkout", "wheel"])
def test_an_edit_of_any_module_with_kernels_names_another_folder(linked, tmp_path):
    """numba alone would run the old code."""
    copy_package(tmp_path, linked)

    def names():
        code = "from clothgym._jit import cache_folder as f; print(f().path.name, f().core.name)"
        return run(code, PYTHONPATH=str(tmp_path), CLOTHGYM_CACHE_DIR=str(tmp_path / "cache"))[0].split()

    found = [names()]
    for edited in ("forces.py", "collisions/solids/contact_law.py", "envs/measures.py", "render/raster.py"):
        path = tmp_path / "clothgym" / edited
        path.write_text(path.read_text() + "\nMORE = 1\n")
        found.append(names())
    (tmp_path / "clothgym" / "cli.py").write_text("")
    every, core = zip(*found)
    assert len(set(every)) == 5 and names() == found[-1]
    # tasks and pictures lie above the core, whose kernels hold nothing of them
    assert len(set(core[:3])) == 3 and set(core[2:]) == {core[2]} and not set(core) & set(every)


@pytest.mark.parametrize(
    "module, of_the_core",
    [("clothgym.forces", True), ("clothgym.integrators.verlet", True), ("clothgym.envs.stepping", False), ("mine", False)],
)
def test_kernels_above_the_core_are_kept_apart(module, of_the_core):
    folder = cache_folder()
    assert folder.folder_of(module) == (folder.core if of_the_core else folder.path)


def test_the_core_imports_nothing_that_its_folder_s_name_leaves_out():
    for path in (ROOT / "clothgym").rglob("*.py"):
        if path.relative_to(ROOT / "clothgym").parts[0].removesuffix(".py") not in {*ABOVE_CORE, "__init__", "registration"}:
            above = {name for name in ABOVE_CORE if f"clothgym.{name} import" in path.read_text()}
            assert not above, path


def test_two_sources_of_one_name_are_told_apart(tmp_path):
    for folder, text in (("a", "one"), ("b", "two")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "law.py").write_text(text)
    before = source_digest({"clothgym": tmp_path})
    (tmp_path / "a" / "law.py").write_text("two")
    (tmp_path / "b" / "law.py").write_text("one")
    assert source_digest({"clothgym": tmp_path}) != before


def test_what_the_digest_leaves_out_has_no_kernels():
    for path in (ROOT / "clothgym").rglob("*.py"):
        if path.relative_to(ROOT / "clothgym").parts[0].removesuffix(".py") in WITHOUT_KERNELS:
            assert "_jit" not in path.read_text(), path


# --- plain numba ----------------------------------------------------------------------------------------------------------

SPECIALIZED = """
from clothgym._jit import kernel, placeholder, specialize
step = placeholder("step", "of (x): the next")
@kernel
def one(x):
    return x + 1.0
@kernel
def two(x):
    return x + 2.0
def twice(x):
    return step(step(x))
first, second = specialize(twice, "twice", step=one), specialize(twice, "twice", step=two)
print(first(1.0), second(1.0), sum((first.stats.cache_hits + second.stats.cache_hits).values()))
"""


@pytest.mark.parametrize("plain", ["0", "1"])
def test_two_specializations_of_one_function_stay_two_in_a_second_process(plain, tmp_path):
    """They share a file, a line and a name; numba's own key is file, line and name."""
    (tmp_path / "mine.py").write_text(SPECIALIZED)
    place = {"PYTHONPATH": f"{tmp_path}:{ROOT}", "CLOTHGYM_CACHE_DIR": str(tmp_path), "CLOTHGYM_PLAIN_NUMBA": plain}
    assert run("import mine", **place)[0] == "3.0 5.0 0"
    assert run("import mine", **place)[0] == "3.0 5.0 2"
    # a callee that is edited, in a module whose name and lines stay
    (tmp_path / "mine.py").write_text(SPECIALIZED.replace("x + 2.0", "x + 3.0"))
    assert run("import mine", **place)[0] == "3.0 7.0 0"


SURPRISES = {
    "another version": "import numba; numba.version_info = numba.version_info._replace(short=(0, 99))",
    "a class that is gone": "import numba.core.caching as c; del c._SourceFileBackedLocatorMixin",
    "a method that is gone": "import numba.core.caching as c; del c.IndexDataCacheFile._load_index",
    "a class of another kind": "import numba.core.caching as c; c.CompileResultCacheImpl = 3",
}


@pytest.mark.parametrize("surprise", SURPRISES)
def test_a_numba_that_is_not_known_costs_one_sentence(surprise, tmp_path):
    out, err = run(SURPRISES[surprise] + SPECIALIZED, PYTHONPATH=str(ROOT), CLOTHGYM_CACHE_DIR=str(tmp_path))
    assert out == "3.0 5.0 0"
    assert err.count("UserWarning") == 1 and "CLOTHGYM_PLAIN_NUMBA" in err


SMOKE = """
from clothgym import Simulation, grid
from clothgym.triangles import disc
for mesh in (grid(4, 4, 0.3, 0.3), disc(0.2, 2)):
    simulation = Simulation(mesh, num_envs=2, contact="particles")
    simulation.reset(positions=1.1 * mesh.rest_positions)
    simulation.step(5)
    print(simulation.positions.tobytes().hex())
"""


def test_plain_numba_for_any_processor_gives_the_same_bits(tmp_path):
    """A grid, whose particles lie side by side, and a mesh of triangles, whose environments do; without this processor's own
    instructions."""
    environment = {"CLOTHGYM_CACHE_DIR": str(tmp_path), "CLOTHGYM_PLAIN_NUMBA": "1", "NUMBA_CPU_NAME": "generic"}
    plain, err = run(SMOKE, PYTHONPATH=str(ROOT), **environment)
    assert err == ""
    environment = {"CLOTHGYM_CACHE_DIR": os.environ["CLOTHGYM_CACHE_DIR"]} if "CLOTHGYM_CACHE_DIR" in os.environ else {}
    assert plain == run(SMOKE, PYTHONPATH=str(ROOT), **environment)[0]
    assert list(tmp_path.rglob("plain/*/*/*.nbc"))


# --- names that are bound -------------------------------------------------------------------------------------------------

next_of = placeholder("next_of", "of (x): the number after x")


@kernel
def after(x):
    return x + 1.0


@kernel
def before(x):
    return x - 1.0


def one_on(x):
    return next_of(x)


@kernel
def helper(x):
    return next_of(x)


@inlined
def part(x):
    return next_of(x)


def by_helper(x):
    return next_of(x) + helper(x)


def by_part(x):
    return next_of(x) + part(x)


@kernel
def bends(x):
    add_bend_forces(x, x, x, x, x, x)


@kernel
def bends_by_module(x):
    bending.add_bend_forces(x, x, x, x, x, x)


def test_a_placeholder_is_what_it_is_bound_to():
    assert specialize(one_on, "one_on", next_of=after)(5.0) == 6.0
    assert specialize(one_on, "one_on", next_of=before)(5.0) == 4.0


@pytest.mark.parametrize("code", [by_helper, by_part])
def test_a_helper_of_a_bound_function_is_not_bound_with_it(code):
    with pytest.raises(TypingError, match=r"next_of is a placeholder for a kernel \(of \(x\): the number after x\)"):
        specialize(code, code.__name__, next_of=after)(5.0)


@pytest.mark.parametrize("unbound", [bends, bends_by_module])
def test_bending_is_not_lost_without_a_word(unbound):
    with pytest.raises(TypingError, match="add_bend_forces"):
        unbound(1.0)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_an_integrator_calls_forces_by_placeholders_alone(name):
    substep = INTEGRATORS[name].substep.py_func
    called = [substep.__globals__[n] for n in substep.__code__.co_names if n.startswith(("add_spring", "add_bend", "project_bend"))]
    assert called
    for force in called:
        with pytest.raises(TypeError, match="placeholder"):
            force()


def test_a_name_that_is_not_used_cannot_be_bound():
    with pytest.raises(ValueError, match="one_on does not use nextof, .* it uses next_of"):
        specialize(one_on, "one_on", nextof=after)


def add(x, y):
    return x + y


@pytest.mark.skipif(WITHOUT_JIT, reason="nothing is compiled")
def test_threads_that_make_the_first_call_together_leave_one_entry(monkeypatch):
    """With two that fit, numba would look for code, and add it, in every call."""
    from clothgym._jit import numba_internals

    one = kernel(add)
    calls, compile_entry = [], one._compile_for_args
    together = threading.Barrier(4, timeout=20)

    def counted(*args):
        calls.append(args)
        if len(calls) <= 4:
            together.wait()
        return compile_entry(*args)

    monkeypatch.setattr(one, "_compile_for_args", counted)
    threads = [threading.Thread(target=one, args=(1.0, 2.0)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 4
    assert one(1.0, 2.0) == add(1.0, 2.0)
    assert len(calls) == 4
    assert numba_internals.is_kept(one)


# --- views ------------------------------------------------------------------------------------------------------------------


@kernel
def _write_merged(a):
    row = merged(a)
    row[..., -1] = 7.0
    return row


@pytest.mark.parametrize("shape", [(3, 5, 1), (2, 3, 4), (6, 1)])
@pytest.mark.parametrize("view", [_write_merged, numba.njit(_merged_in_python)])
def test_merged_is_a_view_with_the_last_two_axes_joined(shape, view):
    a = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    before, row = a.copy(), view(a)
    assert np.shares_memory(row, a) and row.flags.c_contiguous
    expected = before.reshape(shape[:-2] + (-1,))
    if view is _write_merged:
        expected[..., -1] = 7.0
        assert a[(*[0] * (len(shape) - 2), -1, -1)] == 7.0
    assert np.array_equal(row, expected)


def test_merged_refuses_what_is_not_contiguous():
    with pytest.raises(TypingError, match="C-contiguous"):
        _write_merged(np.zeros((4, 6))[:, ::2])

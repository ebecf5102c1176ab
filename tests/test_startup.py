"""Cold and warm starts: each kernel compiled once between processes, a folder that cannot be written, light imports."""

import os
import shutil
import subprocess
import sys
import textwrap

import pytest

SIMULATE = """
import numpy as np
from clothgym import Simulation, grid
import clothgym.simulation as simulation
s = Simulation(grid(3, 3, 0.1, 0.1), anchors=[0], contact="particles")
s.step(3)
compiled = s._advance.kernel.stats.cache_misses
print(sum(compiled.values()), s.positions.sum())
"""

# a kernel that is compiled in a second
ONE_KERNEL = """
import numpy as np
from clothgym.envs.measures import soft_coverage
share = soft_coverage(np.zeros((3, 1), np.float32), np.array([[0.0, 0.1, 0.0]]), 0.1)
print(sum(soft_coverage.stats.cache_misses.values()), round(float(share), 6))
"""


def start(code, **environment):
    env = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"} | environment
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A cold cache that four processes have filled at once, and what they said."""
    folder = tmp_path_factory.mktemp("cache")
    processes = [start(SIMULATE, CLOTHGYM_CACHE_DIR=str(folder)) for _ in range(4)]
    outputs = [process.communicate(timeout=300) for process in processes]
    assert all(process.returncode == 0 for process in processes), outputs
    return folder, outputs


def test_four_processes_on_a_cold_cache_compile_each_kernel_once_between_them(filled):
    _, outputs = filled
    compiled = [int(out.split()[0]) for out, _ in outputs]
    assert sum(compiled) == 1
    assert len({out.split()[1] for out, _ in outputs}) == 1
    # a step has two kernels, of the attachments and of the main loop: one process may have compiled both, or two one each
    announced = [err for _, err in outputs if err]
    assert 1 <= len(announced) <= 2 and all(err.count("\n") == 1 and "compiling kernels" in err for err in announced)


def test_a_folder_that_cannot_be_written_costs_a_sentence(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    out, err = start(ONE_KERNEL, CLOTHGYM_CACHE_DIR=str(blocked)).communicate(timeout=300)
    assert out == "1 0.5\n"
    assert "cannot use its kernel cache" in err and "CLOTHGYM_CACHE_DIR" in err


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"torch", "stable_baselines3", "matplotlib", "imageio", "numba", "scipy.sparse"}
    out, err = start(f"import sys, clothgym; print({heavy} & set(sys.modules))").communicate(timeout=60)
    assert out == "set()\n", err


def test_the_folder_envs_refuses_its_bare_name():
    root = os.path.dirname(os.path.dirname(__file__))
    out, err = start(f"import sys; sys.path.insert(0, {root!r}); import envs").communicate(timeout=60)
    assert "clothgym.envs" in err and "ImportError" in err


TWO_THREADS = """
import threading
from clothgym import _jit
@_jit.apart
def shared(x):
    return 2.0 * x
@_jit.kernel
def left(x):
    return shared(x) + 1.0
@_jit.kernel
def right(x):
    return shared(x) + 2.0
def go():
    said = []
    threads = [threading.Thread(target=lambda run=run: said.append(run(3.0))) for run in (left, right)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    print(len(_jit.cache_folder().held), *sorted(said))
"""


def test_two_threads_that_compile_at_once_leave_the_lock_free(tmp_path):
    (tmp_path / "two.py").write_text(TWO_THREADS)
    cache = {
        "CLOTHGYM_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": f"{tmp_path}:{os.path.dirname(os.path.dirname(__file__))}",
    }
    out, err = start("import two; two.go()", **cache).communicate(timeout=300)
    assert out.strip() == "0 7.0 8.0", err


def test_a_folder_that_vanishes_costs_a_sentence(tmp_path):
    code = "import shutil, os\nfrom clothgym import _jit\n_jit.cache_folder()\nshutil.rmtree(os.environ['CLOTHGYM_CACHE_DIR'])\n"
    out, err = start(code + ONE_KERNEL, CLOTHGYM_CACHE_DIR=str(tmp_path / "cache")).communicate(timeout=300)
    assert out == "1 0.5\n", err


MINE = """
from dataclasses import replace
from clothgym import INTEGRATORS, Simulation, grid
from clothgym._jit import kernel
@kernel
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    x += h * v
def go():
    s = Simulation(grid(3, 3, 0.1, 0.1), integrator=replace(INTEGRATORS["semi_implicit_euler"], name="mine", substep=substep))
    s.step()
    print(s.positions.sum())
if __name__ == "__main__":
    go()
"""


def test_custom_integrators_run_from_scripts_modules_and_prompts(filled, tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    cache = {"CLOTHGYM_CACHE_DIR": str(shutil.copytree(filled[0], tmp_path / "cache")), "PYTHONPATH": str(tmp_path)}
    codes = [f"import runpy; runpy.run_path({str(tmp_path / 'mine.py')!r}, run_name='__main__')", "import mine; mine.go()", MINE]
    outputs = [start(code, **cache).communicate(timeout=300) for code in codes]
    assert len({out for out, _ in outputs}) == 1 and outputs[0][0], outputs


def test_a_callee_that_stays_apart_is_compiled_once_and_its_callers_anew_when_it_has_changed(filled, tmp_path):
    """Two main loops call one substep's code; its symbol is another when a process compiles it that did other things before."""
    folder, outputs = filled
    cache = shutil.copytree(folder, tmp_path / "cache")
    more = SIMULATE + "from clothgym import Plane\nSimulation(grid(3, 3, 0.1, 0.1), colliders=[Plane()]).step()\n"
    out, err = start(more, CLOTHGYM_CACHE_DIR=str(cache)).communicate(timeout=300)
    total = outputs[0][0].split()[1]
    assert out.split() == ["0", total], err
    assert len(list(cache.rglob("main_loop.advance_semi*.nbc"))) == 2
    substep = list(cache.rglob("*.semi_implicit_euler_springs*"))
    assert len([path for path in substep if path.suffix == ".nbc"]) == 1
    for path in substep:
        path.unlink()
    other = "from clothgym import Simulation, grid\nSimulation(grid(3, 3, 0.1, 0.1), integrator='verlet').step()\n"
    out, err = start(other + SIMULATE, CLOTHGYM_CACHE_DIR=str(cache)).communicate(timeout=300)
    assert out.split() == ["1", total], err

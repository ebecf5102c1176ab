"""Imports only go down, optional libraries stay out of module level, and files stay readable: read from the source."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = {
    "clothgym._jit": 0,
    "clothgym.checks": 0,
    "clothgym.exclusive": 0,
    "clothgym.files": 0,
    "clothgym.folders": 0,
    "clothgym.progress": 0,
    "clothgym.warning": 0,
    "clothgym.layout": 1,
    "clothgym.mesh": 1,
    "clothgym.mesh_files": 1,
    "clothgym.mesh_repair": 1,
    "clothgym.triangles": 1,
    "clothgym.material": 1,
    "clothgym.geometry": 1,
    "clothgym.wind": 1,
    "clothgym.elements": 2,
    "clothgym.contact_memory": 2,
    "clothgym.state": 2,
    "clothgym.parameters": 2,
    "clothgym.bending": 3,
    "clothgym.forces": 3,
    "clothgym.grid_forces": 3,
    "clothgym.integrators": 4,
    "clothgym.collisions": 4,
    "clothgym.attachments": 4,
    "clothgym.guards": 4,
    "clothgym.limiting": 4,
    "clothgym.ahead": 5,
    "clothgym.main_loop": 5,
    "clothgym.simulation": 5,
    "clothgym.render": 6,
    "clothgym.starts": 6,
    "clothgym.envs": 7,
    "clothgym.adapters": 8,
    "clothgym.cli": 8,
    "clothgym.lab": 8,
    "clothgym.playground": 8,
    "clothgym.policies": 8,
    "clothgym.__main__": 8,
}
STRINGS_ONLY = {"clothgym", "clothgym.registration"}
LOWEST = {"gymnasium": 7, "stable_baselines3": 8, "torch": 8, "matplotlib": 8}
NEVER_AT_MODULE_LEVEL = {"imageio", "trimesh", "viser", "scipy", "mujoco", "PIL", "matplotlib"}


def _source_files():
    for path in sorted([*(ROOT / "clothgym").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]):
        if "clothgym/envs" in path.as_posix():
            continue  # the editor's link to envs/
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        yield ("clothgym." + name if name.split(".")[0] == "envs" else name), path


SOURCES = list(_source_files())


def floor(module):
    return next((level for prefix, level in FLOORS.items() if module == prefix or module.startswith(prefix + ".")), None)


def imports(tree):
    """(module, whether at module level and not for type checking only) of every import."""
    deferred = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            deferred |= set(ast.walk(node))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node not in deferred
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, "imports are absolute"
            if node.module in ("clothgym", "clothgym.envs"):
                yield from ((f"{node.module}.{alias.name}", node not in deferred) for alias in node.names)
            else:
                yield node.module, node not in deferred


@pytest.mark.parametrize(("name", "path"), SOURCES, ids=lambda v: v if isinstance(v, str) else "")
def test_imports_go_down(name, path):
    for module, at_top in imports(ast.parse(path.read_text())):
        top = module.split(".")[0]
        if top == "clothgym" and name not in STRINGS_ONLY:
            own, other = floor(name), floor(module)
            assert own is not None, f"{name} has no floor"
            if other is None:
                assert module in ("clothgym", "clothgym.registration"), f"{name} must import {module} from its own module"
                continue
            assert other <= own, f"{name} (floor {own}) imports {module} (floor {other})"
            pair = {name.split(".")[1], module.split(".")[1]}
            assert pair != {"integrators", "collisions"}, "integrators and collisions meet in simulation only"
        if top in LOWEST and name not in STRINGS_ONLY:
            assert floor(name) >= LOWEST[top], f"{name} imports {top}"
        if at_top:
            assert top not in NEVER_AT_MODULE_LEVEL, f"{name} imports {top} at module level"


@pytest.mark.parametrize(("name", "path"), SOURCES, ids=lambda v: v if isinstance(v, str) else "")
def test_files_can_be_read_in_one_sitting(name, path):
    assert len(path.read_text().splitlines()) <= 600


def test_no_kernel_uses_fast_math_or_numba_directly():
    for name, path in SOURCES:
        text = path.read_text()
        assert "fastmath=True" not in text
        if not name.startswith("clothgym._jit"):
            assert "njit" not in text and "prange" not in text, name
            assert "F821" not in text, f"{name}: declare what specialize binds with placeholder"


def test_main_loop_fits_a_screen():
    tree = ast.parse((ROOT / "clothgym" / "main_loop.py").read_text())
    for loop in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
        assert loop.end_lineno - loop.lineno <= 30, loop.name

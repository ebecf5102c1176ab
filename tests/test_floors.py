"""Imports only go down, optional libraries stay out of module level, and functions stay readable: read from the source."""

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
    "clothgym.garments": 1,
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
    "clothgym.sheet_forces": 3,
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
    "clothgym.evaluation": 8,
    "clothgym.__main__": 8,
}
# functions of more than 60 lines or 12 parameters, by module; this list may only shrink
OUT_OF_HAND = {
    "adapters.lagrange": "__init__",
    "attachments": "bar_blocks",
    "bending": "_first_normal _rates _second_normal",
    "cli": "_parser",
    "collisions.self.broad_phase": "_enclose_leaves",
    "collisions.self.contact_normals": "on_edges on_vertex owns weights_of",
    "collisions.self.impulses": "_correct _push",
    "collisions.self.narrow_phase": "constrain_layers vertex_contacts write_constraint write_contact",
    "collisions.self.near_pairs": "_come_close_at",
    "collisions.solids.contact_law": "contact_change edge_change touch_change",
    "collisions.solids.particle_contact": "_respond _respond_at_edges _respond_to_plane",
    "collisions.solids.triangle_contact": "find_touches",
    "forces": "_multiply _pull",
    "grid_forces": "_air_force _first_triangles _gather _gather_from _product_kind _second_triangles _spring_and_curve_kind"
    " _spring_kind",
    "integrators.implicit_euler": "substep",
    "integrators.pbd": "_project_rigid",
    "integrators.xpbd": "_project _project_with_memory",
    "render.shading": "shade_surfaces",
    "simulation": "__init__",
    "envs.stepping": "finish_one finish_step",
    "envs.task": "__init__",
}
STRINGS_ONLY = {"clothgym", "clothgym.registration"}
LOWEST = {"gymnasium": 7, "stable_baselines3": 8, "torch": 8, "matplotlib": 8}
NEVER_AT_MODULE_LEVEL = {"imageio", "trimesh", "websockets", "scipy", "mujoco", "PIL", "matplotlib"}


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


def functions_out_of_hand(path):
    """Functions of a file that are longer than 60 lines or have more than 12 parameters, ``self`` apart."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            names = [one.arg for one in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            if len(names) - ("self" in names) > 12 or node.end_lineno - node.lineno >= 60:
                found.add(node.name)
    return found


@pytest.mark.parametrize(("name", "path"), SOURCES, ids=lambda v: v if isinstance(v, str) else "")
def test_functions_are_short_and_take_few_parameters(name, path):
    """But for those that are listed, most of them rows of vectorized loops; the list may only shrink."""
    listed = set(OUT_OF_HAND.get(name.removeprefix("clothgym."), "").split())
    found = functions_out_of_hand(path)
    assert found <= listed, "cut it into parts that have names of their own"
    assert listed <= found, "take it from the list"


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


def test_listed_modules_exist():
    names = {name.removeprefix("clothgym.") for name, _ in SOURCES}
    assert set(OUT_OF_HAND) <= names
    assert all(any(name == one or name.startswith(one + ".") for name, _ in SOURCES) for one in FLOORS)

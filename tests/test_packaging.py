"""The wheel holds clothgym and nothing else."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import clothgym

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, so that no build folder is left in the repository."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (source / name).write_text((ROOT / name).read_text())
    for part in ("clothgym", "envs", "tests", "training"):
        for path in (ROOT / part).rglob("*"):
            inside = path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in path.parts and inside.parts[:2] != ("clothgym", "envs"):
                (source / inside).parent.mkdir(parents=True, exist_ok=True)
                (source / inside).write_bytes(path.read_bytes())
    options = ("--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder))
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(source)], check=True, timeout=120)
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_wheel_ships_clothgym_only(wheel):
    names = wheel.namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"clothgym"}
    assert "clothgym/envs/drape.py" in names and "clothgym/envs/drape_reference.json" in names and "clothgym/py.typed" in names
    assert not any("test" in name for name in names)
    # with all files of the playground's page
    web = {path.relative_to(ROOT).as_posix() for path in (ROOT / "clothgym" / "playground" / "web").iterdir()}
    assert len(web) == 7 and web <= set(names)
    # each package of the source is listed in pyproject.toml
    packages = {path.parent.relative_to(ROOT) for path in (ROOT / "clothgym").rglob("__init__.py")}
    assert {f"{package.as_posix()}/__init__.py" for package in packages} <= set(names)
    metadata = wheel.read(f"clothgym-{clothgym.__version__}.dist-info/METADATA").decode()
    assert f"\nVersion: {clothgym.__version__}\n" in metadata
    assert sum(member.compress_size for member in wheel.infolist()) < 3.2e6


@pytest.mark.slow
def test_the_readme_runs_from_the_wheel(wheel, tmp_path):
    """As somebody does who has no repository: each script, in an empty folder; the training for fewer steps."""
    pytest.importorskip("stable_baselines3")
    from test_samples import PYTHON, SHORTER

    installed, empty = tmp_path / "installed", tmp_path / "empty"
    wheel.extractall(installed)
    empty.mkdir()
    scripts = PYTHON["README.md"]
    for long, short in SHORTER:
        scripts[1] = re.sub(long, short, scripts[1])
    where = f"import clothgym\nassert clothgym.__file__.startswith({str(installed)!r}), clothgym.__file__\n"
    for script in scripts:
        command = [sys.executable, "-W", "error::UserWarning", "-c", script + where]
        done = subprocess.run(command, cwd=empty, env=os.environ | {"PYTHONPATH": str(installed)}, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert {path.name for path in empty.iterdir()} == {"reach.zip"}

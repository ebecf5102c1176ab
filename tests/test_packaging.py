"""The wheel holds clothgym and nothing else."""

import subprocess
import sys
import zipfile
from pathlib import Path

import clothgym

ROOT = Path(__file__).parent.parent


def test_wheel_ships_clothgym_only(tmp_path):
    # built from a copy, so that no build folder is left in the repository
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (source / name).write_text((ROOT / name).read_text())
    for folder in ("clothgym", "envs", "tests", "training"):
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in path.parts and inside.parts[:2] != ("clothgym", "envs"):
                (source / inside).parent.mkdir(parents=True, exist_ok=True)
                (source / inside).write_bytes(path.read_bytes())
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(tmp_path),
        str(source),
    ]
    subprocess.run(command, check=True, timeout=120)
    wheel = zipfile.ZipFile(next(tmp_path.glob("*.whl")))
    names = wheel.namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"clothgym"}
    assert "clothgym/envs/drape.py" in names and "clothgym/envs/drape_reference.json" in names and "clothgym/py.typed" in names
    assert not any("test" in name for name in names)
    metadata = wheel.read(f"clothgym-{clothgym.__version__}.dist-info/METADATA").decode()
    assert f"\nVersion: {clothgym.__version__}\n" in metadata
    assert sum(member.compress_size for member in wheel.infolist()) < 3e6

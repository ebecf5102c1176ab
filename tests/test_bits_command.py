"""The command that tells whether digests have changed."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def bits(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import bits

    return bits


def test_differences_are_reported_by_row(bits):
    before = {"a": {"digest": "1", "parts": {"positions": "1", "infos": "2"}}, "b": {"digest": "2", "parts": {}}}
    now = {"a": {"digest": "3", "parts": {"positions": "1", "infos": "4"}}, "c": {"digest": "2", "parts": {}}}
    assert bits.differences(before, before) == []
    assert bits.differences(now, before) == ["a: 1 before, 3 now; infos", "c: only now", "b: only before"]


def test_digests_tell_bits_shapes_and_parts(bits):
    def digest(**parts):
        made = bits.Digest()
        made.add(**parts)
        return made.row()

    x = np.zeros(6, np.float32)
    same, negative = digest(x=x, info={"a": x}), digest(x=x, info={"a": -x})
    assert digest(x=x.copy(), info={"a": x}) == same and same["digest"] != negative["digest"]
    assert same["parts"]["x"] == negative["parts"]["x"] and same["parts"]["info"] != negative["parts"]["info"]
    assert digest(x=x.reshape(2, 3))["digest"] != digest(x=x)["digest"] != digest(x=x.astype(np.float64))["digest"]


def test_the_command_compares_with_a_file(tmp_path):
    def run(*arguments):
        command = [sys.executable, str(BENCHMARKS / "bits.py"), "--select", "wind, 3 x 3", *arguments]
        return subprocess.run(command, capture_output=True, text=True)

    file = tmp_path / "bits.json"
    assert run("--json", str(file)).returncode == 0
    assert "0 of 1 rows differ" in run("--compare", str(file)).stdout
    written = json.loads(file.read_text())
    written["rows"]["wind, 3 x 3"]["parts"]["velocities"] = "0"
    file.write_text(json.dumps(written))
    found = run("--compare", str(file))
    assert found.returncode == 1 and "velocities" in found.stdout

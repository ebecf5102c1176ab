"""The command line."""

import json

import pytest

from clothgym import bench
from clothgym.cli import main


def test_list_names_what_there_is(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("ClothDrape-v0", "semi_implicit_euler", "xpbd", "cotton"))


def test_warmup_says_when_it_is_done(capsys):
    assert main(["warmup"]) == 0
    assert "all kernels are ready" in capsys.readouterr().out


def test_bench_writes_what_it_prints(tmp_path, capsys, monkeypatch):
    """The measurements themselves are stood in for: a test must not depend on a clock."""
    monkeypatch.setattr(bench, "_process_seconds", lambda code, runs, **environment: 1.0)
    monkeypatch.setattr(bench, "seconds_per_call", lambda call, budget=0.5: (call(), 0.5)[1])
    assert main(["bench", "--quick", "--json", str(tmp_path / "bench.json")]) == 0
    results = json.loads((tmp_path / "bench.json").read_text())
    out = capsys.readouterr().out
    assert results["machine"]["versions"]["clothgym"] and "ns/spring" in out
    row = next(row for row in results["core"] if row["grid"] == "25x25" and row["envs"] == 64)
    assert row["frames/s"] == 128
    assert row["ns/spring"] == pytest.approx(0.5 * row["threads"] / (64 * row["substeps"] * 3502) * 1e9)


def test_a_wrong_command_lists_the_right_ones(capsys):
    with pytest.raises(SystemExit):
        main(["fold"])
    assert "warmup" in capsys.readouterr().err

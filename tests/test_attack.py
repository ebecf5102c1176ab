"""The campaign: a short run of it, and that it tells every outcome from the others."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
KEPT = (("constructors", 120), ("resets", 150), ("actions", 150))
# a family with an attack of each outcome, one after the other, whoever goes on with it
FAMILY = """
import os, time
from pathlib import Path
import clothgym
COUNT = Path(__file__).with_name("count")
def broken():
    assert clothgym.grid(2, 2, 1, 1) is None, "nonsense"
OUTCOMES = [
    ("fine", lambda: clothgym.grid(rows=2, cols=2, width=1, height=1)),
    ("clear: rows", lambda: clothgym.grid(rows=-1, cols=2, width=1, height=1)),
    ("obscure: of numpy", lambda: clothgym.grid(2, 2, 1, 1).rest_positions.reshape(5)),
    ("obscure: by accident", lambda: clothgym.grid(2, 2, 1, 1).corners[9]),
    ("nonsense", broken),
    ("hang", lambda: time.sleep(60)),
    ("crash", os.abort),
]
def attacks(rng):
    while True:
        done = len(COUNT.read_text()) if COUNT.exists() else 0
        COUNT.write_text("." * (done + 1))
        yield OUTCOMES[done]
"""


@pytest.fixture
def campaign(monkeypatch):
    """The module of the campaign."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import attack

    return attack


@pytest.mark.parametrize(("family", "most"), KEPT)
def test_nothing_breaks_in_a_short_campaign(campaign, family, most):
    """Seeded attacks, here and not in a process of their own: none is obscure, and none makes nonsense."""
    import importlib

    attacks = importlib.import_module(f"attacks.{family}").attacks(np.random.default_rng(18))
    found = [(text, *campaign.tried(text, attack)) for _, (text, attack) in zip(range(most), attacks)]
    assert [one for one in found if one[1] not in ("fine", "clear")] == []
    assert {"fine", "clear"} == {one[1] for one in found}


def test_each_outcome_is_told(campaign, monkeypatch, tmp_path):
    """Attacks whose outcomes are their names, in workers: a hang and a crash end only themselves."""
    (tmp_path / "attacks").mkdir()
    (tmp_path / "attacks" / "disk.py").write_text(FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path))
    findings = campaign.findings("disk", 0, limit=3.0)
    found = [next(findings) for _ in range(7)]
    findings.close()
    assert [outcome for _, outcome, _ in found] == [text.partition(":")[0] for text, _, _ in found]
    assert {outcome for _, outcome, _ in found} == set(campaign.OUTCOMES)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("clothgym.grid(rows='9', cols=2, width=1, height=1)", "rows='9'"),
        ("clothgym.grid(9, 2**31, 1, 1)", "cols="),
        ("clothgym.disc(1e5, 2**63)", "rings="),
        ("clothgym.load_mesh('x' * 10**6)", "there is no such file"),
        ("clothgym.Material(density='0.2')", "density='0.2'"),
        ("clothgym.Wind(gust='1')", "gust='1'"),
        ("clothgym.Sphere(radius=np.ma.masked)", "Sphere radius"),
        ("clothgym.Simulation(clothgym.grid(3, 3, 1, 1), anchors=None)", "anchors=None"),
        ("clothgym.Simulation(clothgym.grid(3, 3, 1, 1), substeps=10**9)", "substeps=1000000000"),
        ("clothgym.Simulation(clothgym.grid(3, 3, 1, 1), time_step=1e9)", "shorter time_step"),
        ("clothgym.Simulation(clothgym.grid(3, 3, 1, 1)).largest_substep(3)", "env=3"),
        ("gym.make_vec('ClothReach-v0', num_envs=10**9)", "num_envs=1000000000"),
        ("gym.make('ClothReach-v0').reset(seed=1.5)", "seed=1.5"),
        ("gym.make_vec('ClothReach-v0', num_envs=2).reset(seed=[[1], [2, 3]])", r"seed=\[1\]"),
        ("attacks.actions.step('ClothReach-v0', lambda S: [[1], [2, 3]])", "action="),
        ("attacks.actions.step('ClothReach-v0', lambda S: np.full(S, '1'))", "action="),
        ("attacks.actions.step('ClothReach-v0', lambda S: np.zeros(S, complex))", "action="),
    ],
)
def test_what_was_obscure_is_a_sentence(campaign, text, error):
    """The reproductions of the first campaign."""
    with pytest.raises(ValueError, match=error):
        campaign.run(text)


def test_a_missing_file_is_a_clear_refusal_and_an_error_of_the_system_is_none(campaign, tmp_path):
    from clothgym.adapters import runs

    assert campaign.tried("", lambda: runs.read_config(tmp_path))[0] == "clear"
    assert campaign.tried("", lambda: (tmp_path / "none").read_text())[0] == "obscure"


def test_tensors_and_lists_are_arrays(campaign):
    torch = pytest.importorskip("torch")
    from attacks.resets import victim

    env = victim("ClothReach-v0 x 3")
    plain = np.linspace(-1, 1, 9, dtype=np.float32).reshape(3, 3)
    seen = []
    for actions in (plain, plain.tolist(), torch.tensor(plain), torch.tensor(plain, requires_grad=True)):
        env.reset(seed=3)
        seen.append(env.step(actions)[0])
    assert all(np.array_equal(seen[0], other) for other in seen[1:])
    with pytest.raises(ValueError, match="action="):
        env.step(torch.zeros((3, 3), device="meta"))


def test_findings_of_one_line_of_code_are_counted_and_a_few_kept(campaign, monkeypatch):
    found = [("f()", "obscure", "KeyError: 1  [a.py:1]")] * 50 + [("g()", "obscure", "KeyError: 2  [a.py:2]"), ("h()", "fine", "")]
    monkeypatch.setattr(campaign, "findings", lambda *_: (one for one in found))

    class Bar:
        def update(self):
            pass

    row = campaign.attacked("actions", 0, 60.0, Bar(), most=len(found))
    assert row["counts"]["obscure"] == 51 and row["counts"]["fine"] == 1
    assert [one["attack"] for one in row["findings"]] == ["f()"] * 20 + ["g()"]
    assert "... and 31 more of actions" in campaign.table({"families": {"actions": row}})


def test_the_command_writes_its_results(campaign, tmp_path):
    out = tmp_path / "attack.json"
    command = [sys.executable, FOLDER / "attack.py", "--minutes", "0.001", "--only", "actions", "--json", out]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    results = json.loads(out.read_text())
    assert {"machine", "seed", "minutes", "families"} == set(results)
    assert sum(results["families"]["actions"]["counts"].values()) > 0
    assert said.split("\n")[1].startswith("actions")

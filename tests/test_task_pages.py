"""docs/tasks/: a page for each id, which is what ``python docs/task_pages.py`` makes of the docstrings and the committed scores."""

import json
import re

import gymnasium as gym
import pytest
from scipy.stats import trim_mean
from training_runs import ROOT

from clothgym import files
from clothgym.registration import ENVIRONMENTS

PAGES = ROOT / "docs" / "tasks"


@pytest.fixture
def task_pages(monkeypatch):
    """The script, to import from."""
    monkeypatch.syspath_prepend(str(ROOT / "training"))
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import task_pages

    return task_pages


def row_of(env_id, policy, score, **more):
    """A row as a suite's file has it, of 500 episodes."""
    row = {"env": env_id, "policy": policy, "seed": 1_000_000, "env_kwargs": {}, "settings": {}, "episodes": 500}
    row |= {"normalized_performance": score, "normalized_performance_ci95": [score - 0.01, score + 0.01], "seconds": 12.34}
    row |= {"success_rate": 0.5, "success_rate_ci95": [0.456, 0.544], "return": 1.0, "return_ci95": [0.9, 1.1], "digest": "now"}
    return row | {"mean_length": 40.0, "diverged": 0, "torn": 3, "out_of_bounds": 0} | more


def test_committed_pages_are_up_to_date(task_pages):
    made = task_pages.all_pages(task_pages.read_scores())
    committed = {path.name: path.read_text() for path in PAGES.glob("*.md")}
    stale = sorted(name for name in {*made, *committed} if made.get(name) != committed.get(name))
    assert not stale, f"python docs/task_pages.py  makes others of {', '.join(stale)}"
    assert set(made) == {"README.md", *(f"{env_id}.md" for env_id in ENVIRONMENTS)}


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_page_has_all_sections(env_id):
    text = (PAGES / f"{env_id}.md").read_text()
    assert text.startswith(f"# {env_id}\n\n{ENVIRONMENTS[env_id][1]}\n")
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    for heading in ("Description", "Action Space", "Observation Space", "Evaluation", "Arguments", "Scores"):
        assert heading in headings, heading
    # the last observation ends where the space does
    space = gym.make(env_id).observation_space
    if isinstance(space, gym.spaces.Box) and len(space.shape) == 1:
        table = text[text.index("## Observation Space") :]
        places = re.findall(r"^\| (\d+)(?:-(\d+))? \| ``", table, re.MULTILINE)
        assert int(places[-1][1] or places[-1][0]) + 1 == space.shape[0]


def test_what_was_learned_is_what_the_printed_command_gives(task_pages):
    """The best learner's mean without the best and the worst quarter of its seeds, and without runs on another fold or on pictures;
    of safe episodes where there is a cost."""
    best = {"ClothFold-v0": ("sac_scratch", "success_rate"), "ClothStrain-v0": ("ppo_lagrange", "safe_success_rate")}
    for env_id, (learner, name) in best.items():
        runs = [
            json.loads(path.read_text()) for path in ROOT.glob(f"benchmarks/results/training/{env_id}_{learner}_*/evaluation.json")
        ]
        assert len(runs) == len({run["seed"] for run in runs})
        [(_, text)] = task_pages._from_scratch(env_id)
        assert f"{trim_mean([run[name] for run in runs], 0.25):.3f}" in text and "fold=" not in text
        assert ("--algo ppo_lagrange" in text) == (learner == "ppo_lagrange")


def test_scores_are_those_of_the_file(task_pages, tmp_path, monkeypatch):
    """Rows of the id and no others, a column where a row has something; what is of other code is marked."""
    now = {"ClothReach-v0": "now", 'ClothDrape-v0 {"physics": "fast"}': "another"}
    monkeypatch.setattr(task_pages.results, "read_digests", lambda: now)
    rows = [
        row_of("ClothReach-v0", "expert", 0.875, best=0.9, best_ci95=[0.88, 0.92]),
        row_of("ClothReach-v0", "cem", 0.75, about="64 x 4", model_steps=123456),
        row_of("ClothDrape-v0", "expert", 0.625, env_kwargs={"physics": "fast"}),
    ]
    path = tmp_path / "suite.json"
    files.write_json(path, {"machine": {"processor": "an abacus", "date": "2026-01-02"}, "rows": rows})
    pages = task_pages.all_pages(task_pages.read_scores(path))
    reach = pages["ClothReach-v0.md"]
    assert (
        "| expert | 500 | 0.875 ± 0.010 | 0.500 [0.456, 0.544] | 0.900 ± 0.020 | 3 torn | 1.000 ± 0.100 | 40.0 |  | 12.3 |" in reach
    )
    assert "| cem, 64 x 4 | 500 | 0.750 ± 0.010 |" in reach and "| 123,456 |" in reach
    assert "0.625" not in reach and "an abacus, 2026-01-02" in reach and "`python training/plan.py`" in reach
    assert "first success" not in reach and "| cost |" not in reach
    drape = pages["ClothDrape-v0.md"]
    assert "| expert physics=fast **(old)** | 500 | 0.625 ± 0.010 |" in drape and "training/plan.py" not in drape
    assert "None are committed yet" in pages["ClothStrain-v0.md"]
    # the table of all has the expert of the id's own arguments
    lines = {line.split("`")[1]: line for line in pages["README.md"].splitlines() if line.startswith("| [`")}
    assert "0.875 ± 0.010" in lines["ClothReach-v0"] and "0.625" not in lines["ClothDrape-v0"]
    assert task_pages.read_scores(tmp_path / "none.json")["rows"] == []

"""Tables of scores: committed ones are what the command makes, rows of other code are marked; statistics are those of rliable."""

import json
import re

import numpy as np
import pytest
from training_runs import ROOT

from clothgym import files
from clothgym.lab.digests import digest_of, name_of
from clothgym.registration import ENVIRONMENTS

DIGESTS = files.read_json(ROOT / "benchmarks" / "results" / "digests.json", "list", "")["digests"]


@pytest.fixture
def report(scripts):
    """The script, to import from."""
    import report

    return report


@pytest.fixture
def results(scripts):
    import results

    return results


def result(rate, seed=0, env_id="ClothReach-v0", **more):
    row = {"env": env_id, "env_kwargs": {}, "learner": "ppo", "seed": seed, "success_rate": rate, "normalized_performance": rate}
    row |= {
        "success_rate_ci95": [rate - 0.1, rate + 0.1],
        "timesteps": 400_000,
        "training_seconds": 60.0 + seed,
        "core_seconds": 90.0,
    }
    return row | {"torn": 1, "diverged": 0, "digest": "now", "run": f"run_{seed}", "episodes": 500} | more


@pytest.mark.parametrize("name", DIGESTS)
def test_committed_digests_match_the_environments(name):
    """Where they are not, ``python training/report.py --digests`` notes them, and marks the rows that are old."""
    env_id, _, kwargs = name.partition(" ")
    assert digest_of(env_id, json.loads(kwargs or "{}")) == DIGESTS[name]


def test_every_environment_has_a_digest_without_irrelevant_arguments():
    assert set(ENVIRONMENTS) <= set(DIGESTS) and len(set(DIGESTS.values())) == len(DIGESTS)
    assert name_of("clothgym:ClothReach-v0", {"threads": 2, "settling": "at_once"}) == "ClothReach-v0"
    assert name_of("ClothReach-v0", {"action_repeat": 1}) == "ClothReach-v0" != name_of("ClothReach-v0", {"action_repeat": 2})
    assert name_of("ClothReach-v0", {"rows": 7, "physics": "fast"}) == 'ClothReach-v0 {"physics": "fast", "rows": 7}'


def test_committed_pages_are_up_to_date(report):
    stale = [str(path) for path, text in report.pages().items() if path.read_text() != text]
    assert not stale, f"python training/report.py  makes others of {', '.join(stale)}"


def test_rows_of_other_code_are_marked(report):
    digests = {"ClothReach-v0": "now"}
    rows = [result(0.9), result(0.8, seed=1)]
    assert "old" not in report.table_of("ClothReach-v0", rows, [], digests)
    # one seed of another code is enough, and so is a row that does not say
    for wrong in ({"digest": "then"}, {"digest": None}, {"env_kwargs": {"rows": 9}}):
        assert "PPO" in report.table_of("ClothReach-v0", [rows[0], result(0.8, seed=1) | wrong], [], digests)
        assert "**(old)**" in report.table_of("ClothReach-v0", [rows[0], result(0.8, seed=1) | wrong], [], digests)
    scripted = result(0.5) | {"policy": "expert"}
    table = report.table_of("ClothReach-v0", [], [scripted, scripted | {"policy": "noop", "digest": "then"}], digests)
    assert "`noop` **(old)**" in table and "`expert` |" in table


def test_a_row_summarizes_its_seeds(report):
    rates = [0.95, 0.70, 0.90, 0.80, 0.99]
    table = report.table_of("ClothReach-v0", [result(rate, seed) for seed, rate in enumerate(rates)], [], {"ClothReach-v0": "now"})
    cells = [cell.strip() for cell in table.splitlines()[-1].split("|")]
    # the middle three of five: (0.80 + 0.90 + 0.95) / 3
    assert cells[1:3] == ["PPO", "5"] and cells[3].startswith("0.883 [") and cells[4:6] == ["0.900", "0.700"]
    low, high = report.bootstrap(rates)
    assert 0.70 <= low < 0.8833 < high <= 0.99
    assert report.bootstrap([0.5, 0.5, 0.5]) == (0.5, 0.5)
    assert report.interquartile_mean([3, 1, 2]) == pytest.approx(2) and report.interquartile_mean([0, 1, 2, 30]) == pytest.approx(
        1.5
    )


def test_learners_with_other_arguments_are_other_rows(report, results):
    same = [result(0.9, env_kwargs={"settling": "at_once"}), result(0.8, seed=1)]
    assert [len(rows) for rows in results.groups(same).values()] == [2]
    other = [*same, result(0.1, env_kwargs={"physics": "fast"}), result(0.2, learner="sac")]
    assert [label for _, label in results.groups(other)] == ["PPO", "PPO, `physics='fast'`", results.LABELS["sac"]]
    begun = [result(0.2), result(0.9, started_from={"env": "ClothFlatten-v0", "seed": 0, "sha256": "0"})]
    assert [label for _, label in results.groups(begun)] == ["PPO", "PPO, `starts_from='ClothFlatten-v0'`"]
    felt = [result(0.9, env_kwargs={"obs_mode": "depth"}, feels=["grippers", "acting_left"])]
    assert [label for _, label in results.groups(felt)] == ["PPO, `obs_mode='depth'`, `feels='grippers, acting_left'`"]
    now = {"ClothReach-v0": "now"}
    assert report.best_of("ClothReach-v0", other, now, from_scratch=True) == "PPO: 0.85 (worst of 2 seeds: 0.80) in 2 min"
    expert = report.best_of("ClothReach-v0", other, now, from_scratch=False)
    assert expert == "SAC, started with expert episodes: 0.20 in 2 min"
    # who always arrives, and never at no cost, is not the best
    careless = [result(1.0, learner="sac_scratch", cost=70.0, safe_success_rate=0.0)]
    safe = [result(0.9, seed=seed, cost=0.3, safe_success_rate=rate) for seed, rate in enumerate((0.80, 0.85, 0.87))]
    assert (
        report.best_of("ClothReach-v0", [*careless, *safe], now, True) == "PPO: 0.84 at no cost (worst of 3 seeds: 0.80) in 2 min"
    )
    assert report.best_of("ClothDrape-v0", other, now, True) == "–"
    assert report.best_of("ClothReach-v0", other, {"ClothReach-v0": "later"}, True).endswith("2 min **(old)**")
    # what is learned from states goes before a better score from pictures, and what is of this code before any of older code
    seeing = result(0.95, learner="sac_scratch", env_kwargs={"obs_mode": "depth"})
    pictures = {**now, 'ClothReach-v0 {"obs_mode": "depth"}': "now"}
    assert report.best_of("ClothReach-v0", [result(0.9), seeing], pictures, True) == "PPO: 0.90 in 2 min"
    assert report.best_of("ClothReach-v0", [seeing], pictures, True) == "SAC, `obs_mode='depth'`: 0.95 in 2 min"
    # a variant of the task does not stand for its id
    variant = result(0.99, env_kwargs={"fold": "diagonal"})
    assert report.best_of("ClothReach-v0", [result(0.9), variant], now, True) == "PPO: 0.90 in 2 min"
    assert report.best_of("ClothReach-v0", [variant], now, True) == "–"
    mixed = [result(0.9), result(0.7, learner="sac_scratch", digest="later")]
    assert report.best_of("ClothReach-v0", mixed, {"ClothReach-v0": "later"}, True) == "SAC: 0.70 in 2 min"


def test_the_figure_shows_the_best_rows_where_their_numbers_are(report):
    now = {"ClothStrain-v0": "now"}
    strain = {"env_id": "ClothStrain-v0", "episodes": 100}
    learned = [result(rate, seed, learner="bc", **strain) for seed, rate in enumerate((0.5, 0.6, 0.7))]
    # better scores that do not count: of older code, and with a cost
    learned += [result(0.9, learner="ppo", **strain, digest="then"), result(0.4, learner="sac_scratch", **strain)]
    learned += [result(1.0, learner="ppo_penalty", **strain, safe_success_rate=0.1), result(0.8, learner="sac", **strain)]
    scripted = [result(0.0, **strain) | {"policy": name} for name in ("noop", "random")]
    scripted[1]["digest"] = "then"
    scores = report.scores_of("ClothStrain-v0", learned, scripted, now)
    assert [one["policy"] for one in scores] == ["random", "bc", "scratch"]
    assert [one["present"] for one in scores] == [False, True, True]
    # Wilson's interval of 0 and of 40 of 100, z = 1.96, by hand: (p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n)
    assert scores[0]["success"] == pytest.approx((0, 0, 3.8416 / 103.8416))
    assert scores[2]["success"] == pytest.approx((0.4, 0.309400, 0.497999), abs=1e-6)
    assert scores[1]["success"] == pytest.approx((0.6, 0.5, 0.7))  # the mean of three seeds, and their range
    picture = report.scores_figure([scores])
    dots = re.findall(r'M([\d.]+) \d+H([\d.]+)".*?cx="([\d.]+)".*?fill="(#\w+)" stroke="(#\w+)"', picture)
    low, high, mean = ([(float(dot[i]) - 12) / 376 for dot in dots] for i in range(3))
    assert low == pytest.approx([0, 0.5, 0.3094], abs=2e-4) and high == pytest.approx([0.0370, 0.7, 0.4980], abs=2e-4)
    assert mean == pytest.approx([0, 0.6, 0.4], abs=2e-4) and [fill == edge for *_, fill, edge in dots] == [False, True, True]
    assert "ClothStrain-v0, behavior cloning: 0.600 [0.500, 0.700]" in picture
    # one seed more in the best row, and the dot moves with the table
    more = report.scores_of("ClothStrain-v0", [*learned, result(0.8, 1, learner="sac_scratch", **strain)], scripted, now)
    assert more[2]["success"] == pytest.approx((0.6, 0.4, 0.8))


def test_controls_are_rows_by_what_was_changed(report):
    def control(rate, repeat, normalize=True):
        made = result(rate, env_kwargs={"action_repeat": repeat}) | {"with_noise": {"success_rate": rate / 2}}
        return made | {"hyperparameters": {"gamma": 0.9, "normalize": normalize, "updates": 8, "n_envs": 32}}

    rows = [control(0.8, 4), control(0.6, 4), control(0.0, 1), control(0.1, 4, normalize=False)]
    table = report.controls_table(rows, {'ClothReach-v0 {"action_repeat": 4}': "now"})
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    head, found = lines[0], [dict(zip(lines[0], line)) for line in lines[2:]]
    assert head[0] == "environment" and [(one["`action_repeat`"], one["normalized"]) for one in found] == [
        ("1", "yes"), ("4", "no"), ("4", "yes"),
    ]  # fmt: skip
    assert [one["success"] for one in found] == ["0.000", "0.100", "0.700"] and found[2]["seeds"] == "2"
    assert found[2]["with noise"] == "0.350"
    # only the environment whose present behavior is known to be the same is not old
    assert ["old" in one["environment"] for one in found] == [True, False, False]


def test_of_several_seeds_the_policy_is_kept_that_was_best_on_other_episodes(results, tmp_path, monkeypatch):
    from clothgym import policies

    monkeypatch.setattr(results, "RUNS", tmp_path / "results")
    monkeypatch.setattr(results, "COMMITTED", tmp_path / "committed")
    (tmp_path / "committed").mkdir()
    for seed, chosen_by in enumerate((0.7, 0.9, 0.8)):
        folder = tmp_path / f"ClothReach-v0_{seed}"
        folder.mkdir()
        for name in results.KEPT:
            (folder / name).write_text('{"env": "ClothReach-v0"}')
        about = {"env": "ClothReach-v0", "env_kwargs": {}, "learner": "ppo", "seed": seed, "chosen_by": chosen_by, "digest": "now"}
        policies.Policy([(np.ones((3, 2)), np.zeros(2))], about=about).save(folder / "policy.npz")
    results.add(sorted(tmp_path.glob("ClothReach-v0_*")))
    assert policies.read(tmp_path / "committed" / "ClothReach-v0_ppo.npz").about["seed"] == 1
    assert sorted(path.name for path in (tmp_path / "results" / "ClothReach-v0_0").iterdir()) == sorted(results.KEPT)
    # the same seed again, and worse: what is committed is what its row says
    about = {"env": "ClothReach-v0", "env_kwargs": {}, "learner": "ppo", "seed": 1, "chosen_by": 0.1, "digest": "now"}
    policies.Policy([(np.ones((3, 2)), np.ones(2))], about=about).save(tmp_path / "ClothReach-v0_1" / "policy.npz")
    results.add([tmp_path / "ClothReach-v0_1"])
    assert policies.read(tmp_path / "committed" / "ClothReach-v0_ppo.npz").about["chosen_by"] == 0.1
    # nor is the policy of a variant kept
    about |= {"env_kwargs": {"fold": "diagonal"}, "seed": 2, "chosen_by": 1.0, "digest": "other"}
    policies.Policy([(np.ones((3, 2)), np.ones(2))], about=about).save(tmp_path / "ClothReach-v0_2" / "policy.npz")
    results.add([tmp_path / "ClothReach-v0_2"])
    assert policies.read(tmp_path / "committed" / "ClothReach-v0_ppo.npz").about["seed"] == 1
    with pytest.raises(ValueError, match="holds no finished run, it lacks evaluation.json"):
        results.add([tmp_path])

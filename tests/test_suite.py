"""``evaluate.py --suite``: every policy on every id that it is for, in one table and one file that keeps what is finished."""

import gymnasium as gym
import numpy as np
import pytest

from clothgym import files
from clothgym.registration import ENVIRONMENTS

HELD_OUT = 1_000_000
ENV = "ClothReach-v0"


def test_a_suite_is_every_id_unless_some_are_named(scripts):
    import evaluate
    import suite

    assert evaluate.Args(suite=True).env == tuple(ENVIRONMENTS) and evaluate.Args().env == ("ClothDrape-v0",)
    rows = suite.rows_of(ENVIRONMENTS, ("noop", "careless"), 7, {"threads": 1})
    assert [row["env"] for row in rows if row["policy"] == "noop"] == list(ENVIRONMENTS)
    assert [row["env"] for row in rows if row["policy"] == "careless"] == ["ClothStrain-v0"]
    assert [row["env"] for row in rows] == sorted((row["env"] for row in rows), key=list(ENVIRONMENTS).index)
    with pytest.raises(ValueError, match="'careless' is for none of ClothReach-v0"):
        evaluate.Args(suite=True, env=(ENV,), policy=("careless",))


def test_its_scores_are_those_of_the_single_environment(scripts, tmp_path, capsys):
    import evaluate

    path = tmp_path / "suite.json"
    evaluate.main(evaluate.Args(suite=True, env=(ENV,), policy=("noop", "expert"), episodes=5, json=path, threads=1))
    rows = files.read_json(path, "", "")["rows"]
    env = gym.make(ENV)
    for row, act in zip(rows, (lambda: np.zeros(3), lambda: env.unwrapped.expert_action())):
        scores, returns, successes = [], [], 0
        for seed in range(HELD_OUT, HELD_OUT + 5):
            env.reset(seed=seed)
            terminated, total = False, 0.0
            while not terminated:
                _, reward, terminated, _, info = env.step(act())
                total += reward
            scores.append(info["normalized_performance"])
            returns.append(total)
            successes += info["is_success"]
        assert row["normalized_performance"] == pytest.approx(sum(scores) / 5, abs=1e-12)
        assert row["return"] == pytest.approx(sum(returns) / 5, abs=1e-12)
        assert row["success_rate"] == successes / 5 and row["episodes"] == 5 and row["seconds"] > 0
        # a normal interval, written out
        deviation = (sum((one - sum(scores) / 5) ** 2 for one in scores) / 4) ** 0.5
        half = (row["normalized_performance_ci95"][1] - row["normalized_performance_ci95"][0]) / 2
        assert half == pytest.approx(1.96 * deviation / 5**0.5, abs=1e-12)
    assert rows[0]["success_rate"] == 0 and rows[1]["success_rate"] == 1
    assert sum(line.startswith(ENV) for line in capsys.readouterr().out.splitlines()) == 2


def test_the_interval_of_a_rate_is_wilson_s(scripts):
    """Two rates from the literature: Newcombe 1998, table I."""
    from scoring import wilson

    assert np.round(wilson(81, 263, 1.959964), 4).tolist() == [0.2553, 0.3662]
    assert np.round(wilson(0, 20, 1.959964), 4).tolist() == [0, 0.1611]


def test_success_that_has_to_last_is_counted_where_a_task_has_it(scripts):
    from scoring import score

    episodes = {
        "return": np.array([1.0, 0.5, 0.2, 0.1]),
        "normalized_performance": np.array([0.9, 0.6, 0.3, 0.2]),
        "is_success": np.array([True, True, False, False]),
        "success_held": np.array([True, False, False, False]),
        "best": np.array([0.9, 0.9, 0.5, 0.1]),
        "first_success": np.array([20, 30, 40, -1]),
        "failure": np.array([0, 0, 2, 2]),
        "length": np.array([50, 50, 10, 20]),
    }
    row = score(episodes)
    assert row["success_rate"] == 0.5 and row["success_held_rate"] == 0.25 and row["ever_success_rate"] == 0.75
    assert row["best"] == pytest.approx(0.6) and row["first_success"] == 30
    assert row["torn"] == 2 and row["diverged"] == 0 and row["mean_length"] == 32.5
    assert score(episodes | {"first_success": np.full(4, -1)})["first_success"] is None


# --- interrupted, and called again --------------------------------------------------------------------------------------------


def test_an_interrupted_suite_goes_on(scripts, tmp_path, monkeypatch):
    import evaluate
    import suite

    path = tmp_path / "suite.json"
    args = evaluate.Args(suite=True, env=(ENV,), policy=("noop", "random", "expert"), episodes=2, json=path, threads=1)
    evaluate.main(evaluate.Args(**(vars(args) | {"json": tmp_path / "whole.json"})))
    run_episodes, begun = suite.run_episodes, []

    def interrupted(env_id, policy, seeds, **kwargs):
        begun.append(env_id)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return run_episodes(env_id, policy, seeds, **kwargs)

    monkeypatch.setattr(suite, "run_episodes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        evaluate.main(args)
    assert [row["policy"] for row in files.read_json(path, "", "")["rows"]] == ["noop"]
    evaluate.main(args)
    assert len(begun) == 4  # of three rows one was there
    rows, whole = (files.read_json(one, "", "")["rows"] for one in (path, tmp_path / "whole.json"))
    assert [{**row, "seconds": 0} for row in rows] == [{**row, "seconds": 0} for row in whole]
    # the scores of one id are no suite, and do not take the place of one
    with pytest.raises(ValueError, match=r"suite.json: holds a suite's rows, which would be lost: add --suite"):
        evaluate.Args(env=(ENV,), policy=("noop",), json=path)


def test_rows_of_another_machine_or_file_are_not_added_to(scripts, tmp_path):
    import suite

    path = tmp_path / "suite.json"
    row = {"env": ENV, "policy": "noop", "seed": 0, "env_kwargs": {}, "settings": {}}
    suite.keep(path, row)
    assert suite.load(path) == [row] and suite.load(tmp_path / "none.json") == []
    content = files.read_json(path, "", "")
    for wrong, said in (
        (content | {"machine": content["machine"] | {"processor": "an abacus"}}, "its rows are of an abacus"),
        (content | {"rows": [{"env": ENV}]}, "a row of it lacks one of env, policy"),
        ({"scores": 1}, "suite.json' is no file of a suite's scores"),
    ):
        files.write_json(path, wrong)
        before = path.read_bytes()
        with pytest.raises(ValueError, match=said):
            suite.keep(path, row)
        assert path.read_bytes() == before

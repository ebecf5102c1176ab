"""The search for hyperparameters: where it begins, and that a study goes on."""

import importlib

import pytest
import yaml
from training_runs import ROOT, call, run

optuna = pytest.importorskip("optuna")


@pytest.fixture
def tune(scripts):
    return importlib.import_module("tune")


@pytest.mark.parametrize("env", yaml.safe_load((ROOT / "training" / "hyperparams" / "ppo.yml").read_text()))
def test_the_first_trial_is_the_committed_configuration(tune, env):
    config = tune.Args(env=env, timesteps=1000).config
    again = tune.proposed(optuna.trial.FixedTrial(tune.starting_point(config)), config)
    # what the file leaves to SB3 is said; and trials do not begin with other arguments
    assert again["hyperparameters"].pop("clip_range") == 0.2
    assert again == config and config["curriculum"] == {}


def test_tuned_hyperparameters_can_be_used_for_training(tune):
    config = tune.Args(env="ClothReach-v0", timesteps=1000).config
    trial = tune.starting_point(config) | {"n_envs": 16, "minibatches": 8, "n_steps": 20, "learning_rate": 0.00123456}
    found = yaml.safe_load(tune.as_yaml(tune.proposed(optuna.trial.FixedTrial(trial), config)))["ClothReach-v0"]
    assert (found["n_envs"], found["n_timesteps"], found["n_steps"], found["batch_size"]) == (16, 1000, 20, 40)
    assert found["learning_rate"] == "lin_0.00123" and found["policy_kwargs"]["net_arch"] == [64, 64]


@pytest.mark.slow
def test_a_study_goes_on(scripts, tmp_path):
    journal = tmp_path / "study.log"
    common = ("--env", "ClothReach-v0", "--timesteps", 640, "--episodes", 2, "--seeds", 1, "--study", journal)
    first = call("tune.py", *common, "--trials", 1)
    # in another process
    done = run("tune.py", *common, "--trials", 2, cwd=tmp_path)
    assert first.returncode == done.returncode == 0, first.stderr + done.stderr
    refused = call("tune.py", *common[:3], 650, *common[4:])
    assert refused.returncode == 2 and "have --timesteps 640 --episodes 2 --seeds 1" in refused.stderr
    backend = optuna.storages.journal.JournalFileBackend(str(journal))
    study = optuna.load_study(study_name="ClothReach-v0", storage=optuna.storages.JournalStorage(backend))
    first, second = study.trials
    assert first.params["n_envs"] == 32 and second.params != first.params
    assert (tmp_path / "study.png").stat().st_size > 5000 and "ClothReach-v0:" in done.stdout

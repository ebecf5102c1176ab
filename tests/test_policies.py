"""Committed policies: what a network gives beside torch and NumPy, files, refusals, and the scores that they say they have."""

import itertools
import json

import gymnasium as gym
import numpy as np
import pytest

import clothgym
from clothgym import files, policies
from clothgym.policies.network import forward
from clothgym.registration import ENVIRONMENTS

HELD_OUT = 1_000_000


def random_layers(sizes, seed=0):
    rng = np.random.default_rng(seed)
    return [(rng.normal(size=(a, b)) / np.sqrt(a), rng.normal(size=b) / 3) for a, b in itertools.pairwise(sizes)]


def policy_of(sizes=(6, 16, 3), **kwargs):
    return policies.Policy(random_layers(sizes), about={"env": "ClothReach-v0", "env_kwargs": {}}, **kwargs)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("squashed", [False, True])
def test_a_network_gives_what_numpy_gives_in_double_precision(activation, squashed):
    x = 3 * np.random.default_rng(1).normal(size=(50, 6)).astype(np.float32)
    policy = policy_of((6, 32, 32, 3), activation=activation, squashed=squashed)
    want = x.astype(float)
    for number, (weight, bias) in enumerate(policy.layers):
        want = want @ weight.astype(float) + bias
        if number < 2:
            want = np.tanh(want) if activation == "tanh" else np.maximum(want, 0)
    want = np.clip(np.tanh(want) if squashed else want, -1, 1)
    assert np.abs(policy(x) - want).max() < 3e-6


def test_normalized_observations_are_part_of_the_network(tmp_path):
    rng = np.random.default_rng(4)
    x, shift, factor = rng.normal(5, 0.1, (60, 6)).astype(np.float32), rng.normal(5, 0.1, 6), rng.uniform(8, 200, 6)
    plain, policy = policy_of(), policy_of(normalization=(shift, factor))
    want = np.clip((x.astype(float) - shift) * factor, -8, 8)
    assert (np.abs(want) == 8).any() and np.abs(policy(x) - plain(want)).max() < 1e-3
    assert all(np.array_equal(policy(x[i]), policy(x)[i]) for i in range(0, 60, 7))
    policy.save(tmp_path / "it.npz")
    assert np.array_equal(policies.read(tmp_path / "it.npz")(x), policy(x))
    for wrong, said in (
        ((shift, factor[1:]), r"shapes \(6,\) and \(5,\), its network takes 6"),
        ((shift, factor * np.inf), "not finite"),
    ):
        with pytest.raises(ValueError, match=said):
            policy_of(normalization=wrong)


def test_its_tanh_is_that_of_numpy():
    x = np.linspace(-12, 12, 100_001, dtype=np.float32)[None]
    identity = [(np.eye(1, dtype=np.float32), np.zeros(1, np.float32))]
    found = forward(x.T, identity, "tanh", squashed=True)[:, 0]
    assert np.abs(found - np.tanh(x[0].astype(float))).max() < 1e-7


def test_one_observation_has_the_same_bits_alone_and_in_a_batch():
    policy, x = policy_of(), np.random.default_rng(2).normal(size=(300, 6)).astype(np.float32)
    whole = policy(x)
    assert whole.shape == (300, 3) and all(np.array_equal(policy(x[i]), whole[i]) for i in range(0, 300, 17))
    action, state = policy.predict(x[0], state="any", deterministic=True)
    assert np.array_equal(action, whole[0]) and state == "any"


@pytest.mark.parametrize("learner", ["ppo", "sac"])
def test_an_exported_learner_acts_as_it_did(scripts, learner):
    """In half precision, and so by a thousandth or so."""
    from learners import exported
    from stable_baselines3 import PPO, SAC

    from clothgym.adapters.sb3 import make_sb3_vec_env

    env, kwargs = make_sb3_vec_env("ClothReach-v0", 2), {"policy_kwargs": {"net_arch": [32, 32]}, "device": "cpu", "seed": 0}
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=16, **kwargs) if learner == "ppo" else SAC("MlpPolicy", env, **kwargs)
    seen = np.random.default_rng(3).normal(size=(40, 58)).astype(np.float32)
    policy = exported(model, {"env": "ClothReach-v0", "env_kwargs": {}, "algo": learner, "seed": 0}, {})
    assert policy.activation == ("tanh" if learner == "ppo" else "relu")
    assert np.abs(policy(seen) - model.predict(seen, deterministic=True)[0]).max() < 4e-3


def test_a_learner_of_another_activation_is_not_exported_as_what_it_is_not(scripts):
    import torch
    from learners import exported
    from stable_baselines3 import PPO

    from clothgym.adapters.sb3 import make_sb3_vec_env

    kwargs = {"net_arch": [8], "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", make_sb3_vec_env("ClothReach-v0", 2), n_steps=8, batch_size=16, policy_kwargs=kwargs, device="cpu")
    assert exported(model, {"env": "ClothReach-v0", "env_kwargs": {}, "algo": "ppo", "seed": 0}, {}) is None


def test_a_file_holds_all_of_it_and_needs_no_pickle(tmp_path):
    policy = policy_of((9, 8, 2), activation="relu", squashed=True, keys=("achieved_goal", "observation"))
    policy.save(tmp_path / "it.npz")
    again = policies.read(tmp_path / "it.npz")
    parts = {"observation": np.ones((2, 4)), "achieved_goal": np.zeros((2, 5)), "desired_goal": np.ones((2, 5))}
    assert np.array_equal(again(parts), policy(parts)) and not np.array_equal(
        again(parts), again(parts | {"observation": np.zeros((2, 4))})
    )
    assert again.about == policy.about and again.keys == policy.keys and again.activation == "relu" and again.squashed
    with np.load(tmp_path / "it.npz", allow_pickle=False) as arrays:
        assert np.array_equal(arrays["weight_0"].astype(np.float32), policy.layers[0][0])


def test_what_is_no_policy_is_a_sentence(tmp_path):
    path = tmp_path / "it.npz"
    policy = policy_of()
    policy.save(path)
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="it.npz' is no policy .it is damaged.*: name another file"):
        policies.read(path)
    arrays = {
        "about": json.dumps({"env": "ClothReach-v0", "env_kwargs": {}}),
        "activation": "tanh",
        "squashed": False,
        "keys": "[]",
    }
    weights = {"weight_0": np.zeros((4, 3)), "bias_0": np.zeros(3), "weight_1": np.zeros((2, 1)), "bias_1": np.zeros(1)}
    for wrong, said in (
        (arrays, "it has 0 layers"),
        (arrays | weights, "layer 1 takes 2 numbers, the one before it gives 3"),
        (arrays | {"weight_0": np.full((4, 3), np.nan), "bias_0": np.zeros(3)}, "layer 0 has a value that is not finite"),
        (arrays | {"weight_0": np.zeros((4, 3)), "bias_0": np.zeros(2)}, r"biases of \(2,\)"),
        (arrays | {"weight_0": np.zeros((4, 3)), "bias_0": np.zeros(3), "about": "{}"}, "for which environment"),
    ):
        files.write_arrays(path, "policy", 1, wrong)
        with pytest.raises(ValueError, match=said):
            policies.read(path)
    for wrong, said in ((np.zeros(5), r"shape \(5,\): must be \(6,\)"), (np.zeros((1, 2, 6)), "must be")):
        with pytest.raises(ValueError, match=said):
            policy(wrong)
    with pytest.raises(ValueError, match="deterministic=False"):
        policy.predict(np.zeros(6), deterministic=False)
    with pytest.raises(ValueError, match="must be a dict with observation"):
        policy_of(keys=("observation",))(np.zeros(6))
    with pytest.raises(ValueError, match="did you mean 'ClothDrape-v0'"):
        policies.load("ClothDrap-v0")
    with pytest.raises(ValueError, match="learner='dqn'"):
        policies.load("ClothDrape-v0", "dqn")


def test_three_lines_play_a_committed_policy():
    policy = policies.load("clothgym:ClothDrape-v0")
    env = policy.make()
    action, _ = policy.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action) and policy.about["env"] == "ClothDrape-v0"
    assert isinstance(policy.make_vec(2), gym.vector.VectorEnv)
    assert clothgym.policies is policies


def test_of_several_learners_the_best_is_loaded_and_where_steps_cost_the_one_that_is_safe(tmp_path, monkeypatch):
    monkeypatch.setattr(policies, "FOLDER", tmp_path)
    scores = {"ppo": (1.0, 0.0), "bc": (0.9, 0.6), "sac": (0.8, 0.7)}
    for learner, (success, safe) in scores.items():
        for env_id, score in (("ClothReach-v0", {}), ("ClothStrain-v0", {"safe_success_rate": safe})):
            policy = policy_of()
            policy.about |= {"env": env_id, "learner": learner, "success_rate": success, **score}
            policy.save(tmp_path / f"{env_id}_{learner}.npz")
    assert policies.available() == {"ClothReach-v0": ["ppo", "bc", "sac"], "ClothStrain-v0": ["sac", "bc", "ppo"]}
    assert policies.load("ClothStrain-v0").about["learner"] == "sac" and policies.load("ClothReach-v0").about["learner"] == "ppo"


COMMITTED = [(env_id, learner) for env_id, learners in policies.available().items() for learner in learners]


def test_every_task_at_its_standard_tier_has_one():
    standard = {env_id for env_id in ENVIRONMENTS if "-Hard-" not in env_id}
    assert {env_id for env_id, _ in COMMITTED} == standard
    assert max(path.stat().st_size for path in policies.FOLDER.glob("*.npz")) < 100_000


# that of the fastest task in the fast tier
@pytest.mark.parametrize(
    ("env_id", "learner"),
    [
        pytest.param(*one, id=" ".join(one), marks=[] if one == ("ClothReach-v0", "sac_scratch") else [pytest.mark.slow])
        for one in COMMITTED
    ],
)
def test_a_committed_policy_scores_what_it_says(env_id, learner, scripts):
    """On the first hundred of the held-out episodes, to the episode; of one of older code, what is noted of it on this code."""
    import results

    about, digests = policies.load(env_id, learner).about, results.read_digests()
    successes = results.first_successes(env_id, learner)
    if results.is_present(about, digests):
        assert successes == about["first_successes"]
        # which is what the whole of them says, within what a hundred can tell
        p = about["success_rate"]
        assert abs(successes / 100 - p) < 4 * np.sqrt(max(p * (1 - p), 0.01) / 100)
    else:
        noted = files.read_json(results.TODAY, "list of policies", "")["policies"][f"{env_id} {learner}"]
        digest = digests[results.name_of(env_id, about["env_kwargs"])]
        assert noted == {"digest": digest, "first_successes": successes}


def test_what_committed_policies_say_is_in_the_table(scripts):
    import results

    table = results.learned()
    for env_id, learner in COMMITTED:
        about = policies.load(env_id, learner).about
        same = (env_id, learner, about["seed"], about["env_kwargs"])
        rows = [row for row in table if (row["env"], row["learner"], row["seed"], row["env_kwargs"]) == same]
        assert [(row["success_rate"], row["digest"]) for row in rows] == [(about["success_rate"], about["digest"])], env_id
        assert rows[0].get("safe_success_rate") == about.get("safe_success_rate")

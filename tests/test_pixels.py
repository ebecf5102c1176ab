"""A policy that sees depth: who sees what, what its encoder finds, and runs that are read again."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import clothgym
from clothgym import files
from clothgym.adapters.pixels import DepthEncoder, DepthPolicy
from clothgym.adapters.runs import learned
from clothgym.adapters.sb3 import channels_first, make_sb3_vec_env

KWARGS = {"obs_mode": "depth", "image_size": 32, "privileged": True}
NET = {"net_arch": [16]}


@pytest.fixture(scope="module")
def env():
    return make_sb3_vec_env("ClothReach-v0", 4, seed=0, **KWARGS)


@pytest.fixture(scope="module")
def model(env):
    return PPO(DepthPolicy, env, n_steps=8, batch_size=32, n_epochs=1, policy_kwargs=NET, seed=0, device="cpu")


def decided(model, observations):
    tensors = {name: torch.as_tensor(part) for name, part in observations.items()}
    with torch.no_grad():
        mean = model.policy.get_distribution(tensors).distribution.mean
        return mean.numpy(), model.policy.predict_values(tensors).numpy()


def test_the_actor_sees_the_picture_alone_and_the_critic_the_state_alone(model, env):
    seen = env.reset()
    action, value = decided(model, seen)
    other_action, other_value = decided(model, seen | {"state": seen["state"][::-1].copy()})
    assert np.array_equal(action, other_action) and np.abs(value - other_value).max() > 1e-4
    other_action, other_value = decided(model, seen | {"observation": seen["observation"] - 0.2})
    assert np.array_equal(value, other_value) and np.abs(action - other_action).max() > 1e-4


@pytest.mark.parametrize(
    ("scale", "height"), [(0, 1.0), (1, 0.002)], ids=["a box", "a sheet on the floor, on the saturating scale"]
)
def test_its_places_are_where_a_feature_is_and_its_weights_know_no_resolution(scale, height):
    spaces = [gym.spaces.Dict(observation=gym.spaces.Box(0.0, 4.0, (1, n, n)), state=gym.spaces.Box(-1, 1, (3,))) for n in (32, 64)]
    assert len({sum(p.numel() for p in DepthEncoder(space).parameters()) for space in spaces}) == 1
    encoder = DepthEncoder(spaces[1])
    # the first layer passes heights on, averaged over 8 x 8 pixels; the second makes them sharp, and the last reads out the places
    first, second = encoder.convolutions[0], encoder.convolutions[2]
    with torch.no_grad():
        for layer in (first, second, encoder.linear[0]):
            layer.weight.zero_()
            layer.bias.zero_()
        first.weight[0, scale], second.weight[0, 0, 1, 1] = 1.0, 100.0
        encoder.linear[0].weight[0, 0] = encoder.linear[0].weight[1, 1] = 1.0
        depth = torch.full((1, 1, 64, 64), 2.0)
        depth[0, 0, 8:16, 40:48] -= height
        features = encoder({"observation": depth})[0]
    # the block's middle is at column 43.5 and row 11.5 of 0 to 63; the grid of features has 16 steps from -1 to 1
    assert np.arctanh(features[:2].numpy()) == pytest.approx([43.5 / 31.5 - 1, 11.5 / 31.5 - 1], abs=0.06)
    assert not features[2:].any()


def test_it_learns_and_its_run_is_read_again(model, env, scripts, tmp_path):
    from learners import save_checkpoint
    from learning import acting_of

    model.learn(64)
    config = {
        "env": "ClothReach-v0", "algo": "ppo", "clone": {}, "curriculum": {}, "env_kwargs": KWARGS, "num_envs": 4, "timesteps": 64,
        "hyperparameters": {"policy": "DepthPolicy", "policy_kwargs": NET}, "seed": 0, "threads": 1,
        "clothgym": clothgym.__version__,
    }  # fmt: skip
    files.write_json(tmp_path / "config.json", config)
    save_checkpoint(tmp_path, model, {})
    native = gym.make_vec("clothgym:ClothReach-v0", num_envs=3, **KWARGS)
    seen, _ = native.reset(seed=7)
    assert seen["observation"].shape == (3, 32, 32, 1)
    expected = model.predict(channels_first("depth", seen), deterministic=True)[0]
    assert np.array_equal(learned(tmp_path, "ClothReach-v0")(native, seen), expected)
    assert np.array_equal(acting_of(model)(native, seen), expected) and np.ptp(expected, axis=0).max() > 0


def test_behavior_cloning_also_fits_the_encoder(model, env, scripts):
    from clone import clone, demonstrations

    before = model.policy.pi_features_extractor.convolutions[0].weight.detach().clone()
    critic = [parameter.detach().clone() for parameter in model.policy.vf_features_extractor.parameters()]
    seen, actions = demonstrations(env, 1, 0.2, seed=0)
    error = clone(model, seen, actions, epochs=40, batch_size=64, learning_rate=0.003)
    assert error < 0.5 * actions.var(axis=0).mean()
    assert not torch.equal(before, model.policy.pi_features_extractor.convolutions[0].weight)
    assert all(torch.equal(one, other) for one, other in zip(critic, model.policy.vf_features_extractor.parameters()))


def test_it_is_refused_where_there_are_not_both():
    env = make_sb3_vec_env("ClothReach-v0", 1, seed=0)
    with pytest.raises(ValueError, match="make the environment with obs_mode='depth', privileged=True"):
        PPO(DepthPolicy, env, n_steps=2, batch_size=2)

"""Stable-Baselines3 trains on a native batch (pip install stable-baselines3)."""

import pytest
from page import run


@pytest.mark.filterwarnings("ignore")
def test_it_learns():
    pytest.importorskip("stable_baselines3")
    names = run("Stable-Baselines3")
    assert names["model"].num_timesteps == 1280
    actions, _ = names["model"].predict(names["env"].reset())
    assert actions.shape == (32, 3) and names["env"].action_space.contains(actions[0])

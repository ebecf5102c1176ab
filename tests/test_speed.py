"""benchmarks/speed.py: each kind of measurement, in few and short steps."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def speed(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import speed

    for name, value in {"ROUNDS": 1, "VISITS": 20_000, "MANY": 2}.items():
        monkeypatch.setattr(speed, name, value)
    return speed


def test_its_groups_measure(speed):
    rows = speed.springs() + speed.drape()
    assert all(np.isfinite(row["now"]) for row in rows) and len({row["what"] for row in rows}) == len(rows)
    us = speed.play({"true": {}, "fast": {"physics": "fast"}}, expert=True, num_envs=2, steps=2, rounds=1)
    assert us.keys() == {"true", "fast"} and min(us.values()) > 0
    assert speed.without_physics("ClothReach-v0", 1, 2) > 0 < speed.without_physics("ClothReach-v0", 2, 2)
